"""The options of the command line: their names, their allowed values, and one sentence for each refusal."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..model import LARGEST_FIELD, PARAMETERS, quantity
from ..numerics import LARGEST, shown, whole_range

__all__ = [
    "CHAMBER_OPTIONS",
    "DOTS_PER_INCH",
    "FIGURE_SUFFIXES",
    "MATERIAL_CONSTANTS",
    "PICTURES",
    "PROGRAM",
    "UNIT_CONSTANTS",
    "BadInput",
    "Parser",
    "make_parser",
    "one_of",
    "option_names",
    "read_arguments",
]


PROGRAM = "dielectric-jax"
FIGURE_SUFFIXES = ("eps", "jpg", "jpeg", "pdf", "png", "svg")
#: formats of the paper's figures, and the least and largest resolution of a png
PICTURES = ("pdf", "png", "svg")
DOTS_PER_INCH = (30, 1200)
CHAMBER_OPTIONS = ("initial_volume", "initial_pressure", "atmospheric_pressure", "polytropic_exponent")

#: the material's own constants, as options and as arguments of its class
MATERIAL_CONSTANTS = {
    "gent": ("stretch_limit",),
    "neo-hookean": (),
    "arruda-boyce": ("chain_links",),
    "mooney-rivlin": ("c1", "c2"),
    "ogden": ("moduli", "exponents"),
}

_DESCRIPTION = """Equilibria and bifurcation diagrams of a dielectric elastomer membrane on an air chamber.
Quantities are dimensionless: lengths in A, pressures in μH/A, volumes in A³, voltages in H√(μ/ε); with --si all
quantities of options and JSON are in SI (Pa, m³, V, V/m for --breakdown), and tables and figures in mbar, ml, kV.
Quantities with a unit, such as "0.5 l" or "4 kV", imply --si."""

#: the constants of the units, given with --si only: option, symbol, meaning, and the default
UNIT_CONSTANTS = {
    "shear_modulus": ("PA", "shear modulus μ in Pa (45e3)", "stress"),
    "thickness": ("M", "undeformed thickness H in m (1e-3)", "length"),
    "radius": ("M", "undeformed radius A in m (22.5e-3)", "length"),
    "opening_radius": ("M", "radius of the opening a = λ0 A in m, in place of A", "length"),
    "relative_permittivity": ("E", "relative permittivity (4.7)", ""),
}
#: the options that are dimensionless without --si; those of `_OPTION_KINDS` are of parameters
_DIMENSIONAL = ("voltage", "pressure", "volume", *("chamber_volume", "initial_volume", "initial_pressure"))
_DIMENSIONAL += ("atmospheric_pressure", "breakdown", "noise")
_OPTION_KINDS = ("pressure", "volume")


class InUnits(float):
    """A number in SI that was given with its unit."""


def _with_unit(text: str, kind: str) -> float:
    """The number of a text with a unit of this kind; raises `argparse.ArgumentTypeError` for others."""
    try:
        return InUnits(quantity(text, kind))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _number(check: Callable[[float], bool], what: str, kind: str = "") -> Callable[[str], float]:
    """A parser of numbers that pass `check`, with a unit of the `kind` if there is one; `what` describes the allowed ones."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = _with_unit(text, kind) if kind and re.match(r"\s*[+-]?\.?\d", text) else math.nan
        if not (math.isfinite(value) and check(value)):
            raise argparse.ArgumentTypeError(f"must be {what}, but is {shown(text)}.")
        if abs(value) > LARGEST:
            raise argparse.ArgumentTypeError(f"must be at most {LARGEST:g} in size, but is {shown(text)}.")
        return value

    return read


def _positive_of(kind: str) -> Callable[[str], float]:
    return _number(lambda v: v > 0, "a positive finite number", kind)


def _not_negative_of(kind: str) -> Callable[[str], float]:
    return _number(lambda v: v >= 0, "zero or a positive finite number", kind)


def _constant_of(kind: str) -> Callable[[str], float]:
    """A parser of constants of the units, by which a division must not overflow."""
    allowed = f"a positive finite number from {1 / LARGEST:g} to {LARGEST:g}"
    return _number(lambda v: 1 / LARGEST <= v <= LARGEST, allowed, kind)


_finite = _number(lambda v: True, "a finite number")
_positive = _positive_of("")
_share = _number(lambda v: 0 < v < 1, "a number between 0 and 1")
_prestretch = _number(lambda v: v >= 1, "a finite number of at least 1")


def _whole(least: int, most: int) -> Callable[[str], int]:
    """A parser of whole numbers between limits."""

    def read(text: str) -> int:
        # not int(text) directly: Python refuses thousands of digits with its own message
        value = int(text) if re.fullmatch(r"[0-9]{1,18}", text) else -1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"must be a whole number from {least} to {most}, but is {shown(text)}.")
        return value

    return read


_points = _whole(2, 1_000_000)
_count = _whole(1, 10_000)


def _breakdown(text: str) -> str | float:
    if text == "vhb":
        return text
    return _number(lambda v: v > 0, "vhb or a positive field, in units of √(μ/ε), with --si in V/m", "field")(text)


_ASCII = str.maketrans({"₀": "0", "₁": "1", "₂": "2", "ᵢ": "", "μ": "M", "α": "A", "λ": "L", "_": ""})


def _add_parameter(group, name: str, whose: str = "", value: float | None = None) -> None:
    """Adds the option of a parameter as the table of parameters describes it; `value` is its default."""
    row = PARAMETERS[name]
    many = {"nargs": "+"} if row.many else {}
    of = _not_negative_of if row.closed else _positive_of
    kind = (
        _finite
        if math.isinf(row.least)
        else _prestretch
        if row.least
        else of(row.kind if row.kind in _OPTION_KINDS else "")
    )
    default = "" if row.default is None else f" ({row.default:g})"
    symbol = row.symbol.translate(_ASCII).upper()
    group.add_argument(
        _option(name), type=kind, default=value, metavar=symbol, help=f"{row.label}{whose}{default}", **many
    )


def _film() -> Parser:
    """The options of every command about one membrane: the membrane, and its units."""
    film = Parser(add_help=False)
    group = film.add_argument_group("membrane")
    group.add_argument("--material", choices=list(MATERIAL_CONSTANTS), default="gent", help="free energy (gent)")
    for material, names in MATERIAL_CONSTANTS.items():
        for name in names:
            _add_parameter(group, name, f" of {material}")
    _add_parameter(group, "prestretch", value=1.0)
    group.add_argument(
        "--breakdown", type=_breakdown, default="vhb", metavar="vhb|FIELD", help="law of the breakdown field (vhb)"
    )
    group = film.add_argument_group("units")
    group.add_argument("--si", action="store_true", help="options and results in SI")
    for name, (symbol, what, kind) in UNIT_CONSTANTS.items():
        group.add_argument(_option(name), type=_constant_of(kind), metavar=symbol, help=what)
    return film


def _common() -> Parser:
    """The options of every command that answers about one membrane: the membrane, its units, and the output."""
    common = Parser(add_help=False, parents=[_film()])
    group = common.add_argument_group("answer")
    group.add_argument("--json", metavar="FILE|-", help="write JSON to a file, or to standard output with -")
    group.add_argument("--figure", metavar="FILE", help=f"draw a figure ({', '.join(FIGURE_SUFFIXES)})")
    group.add_argument("--tolerance", type=_positive, default=1e-9, metavar="TOL", help="largest error (1e-9)")
    group.add_argument("--points", type=_points, metavar="N", help="points of a branch (256)")
    group.add_argument(
        "--stretch-window", type=_positive, nargs=2, metavar=("A", "B"), help="window of the apex stretch"
    )
    group.add_argument(
        "--load-window", type=_finite, nargs=2, metavar=("A", "B"), help="window of the load q/q_max (-1 1)"
    )
    return common


def _add_state(command: Parser) -> Any:
    """The options that ask for one state; returns the group of which one is given."""
    command.add_argument("--voltage", type=_not_negative_of("voltage"), default=0.0, metavar="PHI", help="voltage (0)")
    given = command.add_mutually_exclusive_group(required=True)
    given.add_argument("--pressure", type=_not_negative_of("pressure"), metavar="P", help="prescribed pressure")
    given.add_argument("--volume", type=_not_negative_of("volume"), metavar="V", help="prescribed volume")
    given.add_argument("--apex-stretch", type=_positive, metavar="L", help="prescribed stretch of the apex")
    return given


def _add_filling(command: Parser) -> None:
    """The options of a chamber's gas."""
    filling = command.add_mutually_exclusive_group()
    for name in ("initial_volume", "initial_pressure"):
        _add_parameter(filling, name)
    for name in ("atmospheric_pressure", "polytropic_exponent"):
        _add_parameter(command, name)


def _add_equilibrium(commands, common: Parser) -> None:
    one = commands.add_parser(
        "equilibrium",
        parents=[common],
        help="single states",
        description=_DESCRIPTION + "\nWith --chamber-volume the states of a chamber at the voltage.",
    )
    _add_parameter(_add_state(one), "chamber_volume")
    _add_filling(one)
    one.add_argument("--all", action="store_true", help="every state in the window, not only that of smallest volume")


def _numbers(text: str) -> tuple[int, ...]:
    """Circumferential numbers: one, or a range 0:12 that includes both ends."""
    try:
        return whole_range("", text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("`` ")) from None


def _add_modes(commands, common: Parser) -> None:
    modes = commands.add_parser(
        "modes",
        parents=[common],
        help="modes of every circumferential number",
        description=_DESCRIPTION
        + """
For n = 0 pressure and voltage are held; with --chamber-volume the gas of the chamber answers.""",
    )
    _add_parameter(_add_state(modes), "chamber_volume")
    _add_filling(modes)
    modes.add_argument("--numbers", type=_numbers, default=tuple(range(13)), metavar="A:B", help="numbers n (0:12)")
    modes.add_argument("--count", type=_whole(1, 12), default=3, metavar="N", help="eigenvalues of each number (3)")
    modes.add_argument(
        "--density", type=_constant_of("density"), metavar="RHO", help="density in kg/m3, for frequencies; with --si"
    )


def _add_pressure_volume(commands, common: Parser) -> None:
    curve = commands.add_parser(
        "pressure-volume", parents=[common], help="curves at fixed voltage", description=_DESCRIPTION
    )
    curve.add_argument(
        "--voltage",
        type=_not_negative_of("voltage"),
        nargs="+",
        action="extend",
        metavar="PHI",
        help="one or more voltages (0)",
    )
    _add_csv(curve)


def _add_voltage_volume(commands, common: Parser) -> None:
    scene = commands.add_parser(
        "voltage-volume", parents=[common], help="the diagram of a loading", description=_DESCRIPTION
    )
    loading = scene.add_mutually_exclusive_group(required=True)
    for name in ("pressure", "chamber_volume", "volume"):
        _add_parameter(loading, name)
    _add_filling(scene)
    scene.add_argument(
        "--control", choices=["voltage", "charge"], default="voltage", help="what a ramp changes (voltage)"
    )
    scene.add_argument(
        "--engine", choices=["continuation", "surface"], default="continuation", help="how it is computed"
    )
    scene.add_argument(
        "--modes", type=_numbers, metavar="A:B", help="numbers n from 1 of modes that end the ramp, such as 1:24"
    )
    scene.add_argument("--shapes", action="store_true", help="also draw the shapes of the membrane; with --figure")
    _add_csv(scene)


def _add_csv(parser: Parser) -> None:
    parser.add_argument("--csv", metavar="FILE", help="write the points of all branches as a table")


def _add_explore(commands) -> None:
    page = commands.add_parser(
        "explore",
        parents=[_film()],
        help="sliders and diagrams in a browser",
        description=_DESCRIPTION
        + """
Serves a page with sliders to this machine only, until Ctrl-C; the options are where its sliders begin.""",
    )
    loading = page.add_mutually_exclusive_group()
    for name in ("pressure", "chamber_volume"):
        _add_parameter(loading, name)
    _add_filling(page)
    page.add_argument("--port", type=_whole(1, 65535), metavar="N", help="port of the page (a free one)")
    page.add_argument("--no-browser", action="store_true", help="do not open the page, only print its address")


def _add_explain(commands) -> None:
    words = commands.add_parser(
        "explain", help="what a word of the results means", description="Explains words of results, such as returns."
    )
    words.add_argument("words", nargs="*", metavar="WORD", help="the words; all of the glossary if there is none")


def _add_paper(commands) -> None:
    paper = commands.add_parser(
        "paper",
        help="the computed figures of Li et al. (2013), and its statements compared with what the equations give",
        description="Writes figure_3.png, figure_3.json, … and statements.md, and prints the statements.\n"
        "Figures are 183 mm wide, two columns of a journal, or half of it.",
    )
    paper.add_argument(
        "--output", required=True, metavar="DIR", help="folder to write to; created if its parent exists"
    )
    paper.add_argument("--only", nargs="+", action="extend", metavar="FIGURE", help="numbers of figures (all)")
    paper.add_argument("--format", choices=PICTURES, default="png", help="of the figures (png)")
    least, most = DOTS_PER_INCH
    paper.add_argument(
        "--dpi", type=_whole(least, most), metavar="N", help=f"dots per inch of a png, from {least} to {most} (300)"
    )


def _add_sweep(commands) -> None:
    many = commands.add_parser("sweep", help="many scenes, saved in a store", description=_DESCRIPTION)
    many.add_argument("specification", metavar="SPEC.toml", help="which scenes, and with which engine")
    many.add_argument("--output", metavar="STORE.zarr", required=True, help="the store, written block by block")
    many.add_argument("--resume", action="store_true", help="continue an existing store")
    many.add_argument("--accept-versions", action="store_true", help="… even if other versions began it")
    where = many.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_count, metavar="N", help="compute in N processes (in this one)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="… on the cluster of a Dask scheduler")
    many.add_argument("--export", metavar="FILE", help="finally also write a .nc (NetCDF) or .csv file")
    many.add_argument(
        "--json", metavar="FILE|-", help="write a summary as JSON to a file, or to standard output with -"
    )


_COLUMN_NAMES = ("volume", "height", "pressure", "voltage", "time", "stretch", "strain", "stress", "true stress")


def _column(text: str) -> str | tuple[str, str]:
    """A column by heading or position, or the quantity and the column of QUANTITY=COLUMN."""
    name, sign, column = text.partition("=")
    name = name.strip().lower().replace("_", " ")
    return (name, column.strip()) if sign and name in _COLUMN_NAMES else text


def _add_calibrate(commands, common: Parser) -> None:
    fit = commands.add_parser(
        "calibrate",
        parents=[common],
        help="constants from measured pressures, or from tests of films",
        description=_DESCRIPTION,
    )
    columns = (
        "columns volume and pressure, or height and pressure, and voltage if there is one; or stretch and stress of a film, and "
        "time of a viscoelastic one; --si if the first line has units; several files are fitted together"
    )
    fit.add_argument("data", nargs="+", metavar="DATA.csv", help=columns)
    fit.add_argument(
        "--relaxation-times",
        nargs="+",
        type=_positive,
        metavar="T",
        help="of a test in time: one neo-Hookean branch for each, starting there (a twentieth of the test)",
    )
    fit.add_argument(
        "--mode",
        nargs="+",
        choices=["uniaxial", "equal_biaxial", "pure_shear"],
        help="of a test of a film: how it is stretched, one for all files or for each (uniaxial)",
    )
    fit.add_argument(
        "--columns",
        nargs="+",
        type=_column,
        metavar="COLUMN",
        help="columns of volume and pressure by heading or position, others as height=1 pressure=2 voltage=4 (by name)",
    )
    fit.add_argument("--column-units", nargs="+", metavar="UNIT", help="their units, such as ml kPa (from headings)")
    fit.add_argument(
        "--branch",
        choices=["loading", "unloading", "all"],
        help="part used if the volume or the stretch rises and falls (loading)",
    )
    fit.add_argument(
        "--atmospheric-pressure",
        type=_not_negative_of("pressure"),
        metavar="PATM",
        help="subtract it from absolute pressures (0)",
    )
    fit.add_argument(
        "--voltage",
        type=_not_negative_of("voltage"),
        nargs="+",
        metavar="PHI",
        help="voltage of the measurement, one for all files or for each (from the column of voltages, or 0)",
    )
    fit.add_argument("--over", nargs="+", metavar="NAME", help="constants to fit (those of the material, and μ in SI)")
    fit.add_argument("--loss", choices=["linear", "huber", "soft_l1"], default="linear", help="of residuals (linear)")
    fit.add_argument(
        "--noise",
        type=_positive_of("pressure"),
        metavar="P",
        help="standard deviation of a pressure or stress (from residuals)",
    )
    fit.add_argument("--level", type=_share, default=0.95, metavar="P", help="level of the confidence intervals (0.95)")


def _add_specified(commands) -> None:
    """Commands whose only input is a file."""
    for name, what, holds in (
        ("regimes", "a map of two parameters", "scene, ranges and constraints"),
        ("optimise", "the design of largest area strain", "scene, ranges and constraints"),
        ("follow", "a viscoelastic membrane in time", "scene, and what is prescribed in time"),
    ):
        asked = commands.add_parser(name, help=what, description=_DESCRIPTION)
        asked.add_argument("specification", metavar="SPEC.toml", help=holds)
        asked.add_argument("--json", metavar="FILE|-", help="write JSON to a file, or to standard output with -")
        asked.add_argument("--figure", metavar="FILE", help=f"draw a figure ({', '.join(FIGURE_SUFFIXES)})")


def make_parser() -> Parser:
    """The parser of the whole program, with one parser for each command."""
    parser = Parser(prog=PROGRAM, description=_DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {_version()}")
    shells = ("bash", "zsh", "fish")
    parser.add_argument(
        "--print-completion", action=_PrintCompletion, choices=shells, help="print the completions of a shell"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    common = _common()
    _add_equilibrium(commands, common)
    _add_pressure_volume(commands, common)
    _add_voltage_volume(commands, common)
    _add_modes(commands, common)
    _add_paper(commands)
    _add_sweep(commands)
    _add_calibrate(commands, common)
    _add_specified(commands)
    _add_explore(commands)
    _add_explain(commands)
    return parser


class _PrintCompletion(argparse.Action):
    """Prints the completions of a shell, a script without Python in it, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        try:
            import shtab
        except ImportError:
            raise BadInput('--print-completion needs shtab: `pip install "dielectric-jax[completion]"`.') from None
        parsers = [parser]
        for one in parsers:
            for action in one._actions:
                if isinstance(action, argparse._SubParsersAction):
                    parsers += action.choices.values()
                    for command in action._choices_actions:  # a shell shows one line for each
                        action.choices[command.dest].description = command.help
                elif isinstance(action.metavar, str) and re.match(r"FILE|DIR|[A-Z]+\.", action.metavar):
                    action.complete = shtab.DIRECTORY if action.metavar == "DIR" else shtab.FILE  # pyright: ignore
        print(shtab.complete(parser, values))
        parser.exit()


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("dielectric-jax")
    except PackageNotFoundError:
        return "(not installed)"


def _check(args: argparse.Namespace) -> None:
    """Refuses combinations of options that are allowed individually."""
    if args.command == "explain":
        return
    if args.command == "paper":
        _check_paper(args)
        return
    _check_files(args)
    if args.command in ("regimes", "optimise", "follow"):
        return
    if args.command == "sweep":
        _check_sweep(args)
        return
    _choose_units(args)
    for owner, names in MATERIAL_CONSTANTS.items():
        for name in names:
            if getattr(args, name) is not None and owner != args.material:
                raise BadInput(
                    f"{_option(name)} must be given with --material {owner} only, but the material is {args.material}."
                )
    if (args.moduli is None) != (args.exponents is None):
        raise BadInput("--moduli and --exponents must be given together, but one is missing.")
    if args.radius is not None and args.opening_radius is not None:
        raise BadInput("--opening-radius must not be given together with --radius.")
    for name in UNIT_CONSTANTS:
        if getattr(args, name) is not None and not args.si:
            raise BadInput(f"{_option(name)} must be given with --si only.")
    if args.breakdown != "vhb" and (args.breakdown < LARGEST_FIELD) == args.si:
        unit = "V/m with --si, at least" if args.si else "units of √(μ/ε) without --si, at most"
        raise BadInput(f"--breakdown must be in {unit} {LARGEST_FIELD:g}, but is {args.breakdown:g}.")
    for name in ("stretch_window", "load_window"):
        window = getattr(args, name, None)
        if window is not None and not window[0] < window[1]:
            raise BadInput(f"{_option(name)} must be two numbers A < B, but is {window[0]:g} {window[1]:g}.")
    if args.command in ("voltage-volume", "modes", "equilibrium", "explore"):
        given = [name for name in CHAMBER_OPTIONS if getattr(args, name) is not None]
        held = ("pressure", "volume", "apex_stretch")
        others = [f", not with {_option(name)}" for name in held if getattr(args, name, None) is not None]
        if args.chamber_volume is None and given:
            raise BadInput(f"{_option(given[0])} must be given with --chamber-volume only{''.join(others[:1])}.")
        if args.chamber_volume is not None and args.initial_volume is None and args.initial_pressure is None:
            raise BadInput(
                "--initial-volume or --initial-pressure must be given with --chamber-volume, but neither is."
            )
        if args.command == "voltage-volume" and args.control == "charge" and args.engine == "surface":
            raise BadInput("--engine must be continuation with --control charge, but is surface.")
        if args.command == "voltage-volume" and args.shapes and args.figure is None:
            raise BadInput("--shapes must be given with --figure only.")
        if args.command == "voltage-volume" and args.modes is not None:
            if args.engine == "surface":
                raise BadInput("--engine must be continuation with --modes, but is surface.")
            if args.modes[0] < 1:
                raise BadInput(f"--modes must be whole numbers from 1, but begins at {args.modes[0]}.")
    own = {"calibrate": _check_calibrate, "modes": _check_modes, "pressure-volume": _check_pressure_volume}
    if args.command in own:
        own[args.command](args)
    if args.command == "equilibrium" and args.points is not None and args.figure is None:
        raise BadInput("--points must be given with --figure only for equilibrium, because a state has no branch.")


def _check_calibrate(args: argparse.Namespace) -> None:
    if args.columns is not None and len(args.columns) < 2:
        raise BadInput(
            f"--columns must be 2 values, or more with names such as height=1 pressure=2, but is {shown(args.columns[0])}."
        )


def _check_pressure_volume(args: argparse.Namespace) -> None:
    if args.csv is not None and len(args.voltage or ()) > 1:
        raise BadInput(f"--csv must be given with one --voltage, but {len(args.voltage)} are given.")


def _check_modes(args: argparse.Namespace) -> None:
    if args.density is not None and not args.si:
        raise BadInput("--density must be given with --si only.")
    if args.points is not None:
        raise BadInput("--points must be left out for modes, because a state has no branch.")
    if args.figure is not None:
        raise BadInput("--figure must be left out for modes, which has no figure.")


def _choose_units(args: argparse.Namespace) -> None:
    """Chooses SI where quantities were given with units; then all of them must be."""

    def given(name: str) -> list[Any]:
        value = getattr(args, name, None)
        return value if isinstance(value, list) else [value]

    named = [n for n in (*_DIMENSIONAL, *UNIT_CONSTANTS, "density") if any(isinstance(v, InUnits) for v in given(n))]
    if not named or args.si:
        return
    for name in _DIMENSIONAL:
        if any(type(v) is float and v != 0 for v in given(name)):
            raise BadInput(f"{_option(name)} must be given with a unit, as {_option(named[0])} is, or with --si.")
    args.si = True


def _check_files(args: argparse.Namespace) -> None:
    """Refuses invalid file names and files that cannot be written."""
    files = [("SPEC.toml", getattr(args, "specification", None))]
    files += [("DATA.csv", file) for file in getattr(args, "data", ())]
    for said, file in files:
        if file is not None and not _can_be(file):
            raise BadInput(f"{said} must be the name of a file, but is {shown(file)}.")
    if getattr(args, "json", None) not in (None, "-"):
        _check_file("--json", args.json)
    if getattr(args, "csv", None) is not None:
        if args.csv == "-":
            raise BadInput("--csv must be the name of a file, but is '-'.")
        _check_file("--csv", args.csv)
    if getattr(args, "figure", None) is not None:
        _check_file("--figure", args.figure)
        if Path(args.figure).suffix[1:].lower() not in FIGURE_SUFFIXES:
            raise BadInput(
                f"--figure must be a file name ending in {one_of(FIGURE_SUFFIXES)}, but is {shown(args.figure)}."
            )
    written = {}
    for option in ("json", "csv", "figure"):
        file = getattr(args, option, None)
        if file is not None and written.setdefault(os.path.abspath(file), option) != option:
            raise BadInput(
                f"--{option} must name another file than --{written[os.path.abspath(file)]}, but both name {shown(file)}."
            )


def _check_paper(args: argparse.Namespace) -> None:
    _check_folder("--output", args.output)
    if args.dpi is not None and args.format != "png":
        raise BadInput(f"--dpi must be given with --format png only, but the format is {args.format}.")


def _check_sweep(args: argparse.Namespace) -> None:
    if not _writable(args.output, lambda path: path.parent):
        raise BadInput(f"--output must be in a folder that exists and can be written, but is {shown(args.output)}.")
    if args.accept_versions and not args.resume:
        raise BadInput("--accept-versions must be given with --resume only.")
    if args.export is not None:
        _check_file("--export", args.export)
        if Path(args.export).suffix not in (".nc", ".csv"):
            raise BadInput(f"--export must be a file name ending in .nc or .csv, but is {shown(args.export)}.")


def _writable(name: str, folder_of: Callable[[Path], Path | None]) -> bool:
    """Whether the folder that a name refers to, if it refers to one, exists and is writable."""
    if not _can_be(name):
        return False
    folder = folder_of(Path(name))
    return folder is not None and folder.is_dir() and os.access(folder, os.W_OK)


def _can_be(name: str) -> bool:
    """Whether a file of that name is possible, whether or not it exists."""
    try:
        os.lstat(name)
    except (FileNotFoundError, NotADirectoryError):
        return bool(name)
    except (OSError, ValueError):  # too long, a loop of links, a NUL, characters that the file system does not support
        return False
    return True


def _check_file(option: str, name: str) -> None:
    if not _writable(name, lambda path: None if path.is_dir() else path.parent):
        raise BadInput(f"{option} must be a file in a folder that exists and can be written, but is {shown(name)}.")


def _check_folder(option: str, name: str) -> None:
    def folder(path: Path) -> Path | None:
        return path if path.is_dir() else None if path.exists() else path.parent

    if not _writable(name, folder):
        raise BadInput(
            f"{option} must be a folder that can be written, or made in one that exists, but is {shown(name)}."
        )


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def option_names(message: str, args: argparse.Namespace, *, in_si: bool = False) -> str:
    """The library's message with the names of its arguments replaced by those of the options.

    Numbers of other messages than those `in_si` are dimensionless, which is said where options are in SI.
    """
    aliases = {
        "load_fraction": "--load-window",
        "field": "--breakdown",
        "constant_field": "--breakdown",
        "SPEC": "SPEC.toml",
        "data": "DATA.csv",
        "executor": "--workers or --scheduler",
    }
    if getattr(args, "apex_stretch", None) is None:
        aliases["apex_stretch"] = "--stretch-window"

    def option(found: re.Match[str]) -> str:
        name = found[1]
        if name in aliases:
            return aliases[name]
        return _option(name) if hasattr(args, name) else found[0]

    said = re.sub(r"`(\w+)`", option, " ".join(message.split()))
    if getattr(args, "si", False) and not in_si and re.search(r"\d", said):
        said += (
            " (These numbers are dimensionless: lengths in A, pressures in μH/A, volumes in A³, voltages in H√(μ/ε).)"
        )
    return said


def read_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """The options of `argv` (the process's own when None); raises `BadInput` if they are not well formed."""
    argv = sys.argv[1:] if argv is None else argv
    for word in argv:
        if re.fullmatch(r"--[a-z0-9-]+=--", word):  # argparse removes the two dashes and leaves no value at all
            raise BadInput(f"{word[:-3]} must be followed by a value, but is followed by '--'.")
    args = make_parser().parse_args(argv)
    _check(args)
    return args


class BadInput(Exception):
    """Refused input; the message is the sentence to print."""


class Parser(argparse.ArgumentParser):
    """An argparse parser whose errors are `BadInput`, and that reads -1e-3 and -inf as numbers."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(*args, allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d|inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise BadInput(_sentence_of(message, self.prog))


def _sentence_of(message: str, prog: str) -> str:
    """Argparse's message as one sentence that names the option, the value and what is allowed."""
    found = re.match(r"argument (\S+): (.*)", message, re.DOTALL)
    if found is None:
        unknown = re.match(r"unrecognized arguments: (.*)", message, re.DOTALL)
        if unknown:
            return f"{shown(unknown[1])} is not known here; `{prog} --help` lists what is allowed."
        missing = re.match(r"the following arguments are required: (.*)", message)
        if missing:
            return f"{missing[1]} must be given; `{prog} --help` lists what is allowed."
        missing = re.match(r"one of the arguments (.*) is required", message)
        if missing:
            return f"One of {', '.join(missing[1].split())} must be given, but none is."
        return message[0].upper() + message[1:].rstrip(".") + "."
    option, said = found.groups()
    other = re.match(r"not allowed with argument (\S+)", said)
    if other:
        return f"{option} must not be given together with {other[1]}."
    choice = re.match(r"invalid choice: (.*) \(choose from (.*)\)", said, re.DOTALL)
    if choice:
        allowed = [c.strip().strip("'") for c in choice[2].split(",")]
        return f"{option} must be {one_of(allowed)}, but is {_cut(choice[1])}."
    expected = re.match(r"expected (.*?) arguments?$", said)
    if expected:
        return f"{option} must be followed by {expected[1]} value{'' if 'one' in expected[1] else 's'}."
    ignored = re.match(r"ignored explicit argument (.*)", said, re.DOTALL)
    if ignored:
        return f"{option} must be given without a value, but is followed by {_cut(ignored[1])}."
    return f"{option} {said}"


def _cut(text: str) -> str:
    """A quoted value, shortened if it is long, as `codes.shown` does."""
    return text if len(text) <= 100 else f"{text[:40]} ... {text[-40:]}"


def one_of(words: Sequence[str]) -> str:
    """Words with commas and an "or" between them."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"
