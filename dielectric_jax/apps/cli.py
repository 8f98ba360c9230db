"""The command line `dielectric-jax`: single states and diagrams as a table, JSON or a figure.

Bad input gives one sentence on standard error and exit status 2; a scene without an answer gives the sentence of its result code
and exit status 1. Slow imports happen only after the input has been found to be well formed.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..numerics import SceneError, StoreError, WorkersLost, say
from .options import (
    CHAMBER_OPTIONS,
    MATERIAL_CONSTANTS,
    PROGRAM,
    UNIT_CONSTANTS,
    BadInput,
    option_names,
    read_arguments,
)
from .plain_text import readable_streams
from .summaries import summary

__all__ = ["main"]


def _membrane(dj: Any, args: argparse.Namespace) -> Any:
    kinds = {"gent": dj.Gent, "neo-hookean": dj.NeoHookean, "arruda-boyce": dj.ArrudaBoyce}
    kinds |= {"mooney-rivlin": dj.MooneyRivlin, "ogden": dj.Ogden}
    given = {name: getattr(args, name) for name in MATERIAL_CONSTANTS[args.material]}
    material = kinds[args.material](**{name: value for name, value in given.items() if value is not None})
    own = {} if args.units is None else {n: getattr(args.units, n) for n in ("shear_modulus", "relative_permittivity")}
    breakdown = dj.VHBBreakdown(**own) if args.breakdown == "vhb" else dj.ConstantBreakdown(args.breakdown)
    return dj.Membrane(material=material, prestretch=args.prestretch, breakdown=breakdown)


def _units(dj: Any, args: argparse.Namespace) -> Any:
    """The units of --si, None without it; converts the quantities of the options to dimensionless numbers."""
    if not getattr(args, "si", False):
        return None
    from ..model import ATMOSPHERE, VACUUM_PERMITTIVITY

    given = {n: getattr(args, n) for n in UNIT_CONSTANTS if getattr(args, n) is not None}
    if "relative_permittivity" in given:
        given["permittivity"] = given.pop("relative_permittivity") * VACUUM_PERMITTIVITY
    opening = given.pop("opening_radius", None)
    units = dj.Units(**given) if opening is None else dj.Units.for_opening(opening, args.prestretch, **given)
    if getattr(args, "chamber_volume", None) is not None and args.atmospheric_pressure is None:
        args.atmospheric_pressure = ATMOSPHERE
    vars(args).update(units.from_si(vars(args)))
    return units


def _window(dj: Any, args: argparse.Namespace) -> Any:
    def pair(window: list[float] | None) -> tuple[float, float] | None:
        return None if window is None else (window[0], window[1])

    return dj.model.Window(apex_stretch=pair(args.stretch_window), load_fraction=pair(args.load_window))


def _scene(dj: Any, args: argparse.Namespace) -> Any:
    if args.pressure is not None:
        loading = dj.ConstantPressure(pressure=args.pressure)
    elif args.volume is not None:
        loading = dj.PrescribedVolume(volume=args.volume)
    else:
        given = {name: getattr(args, name) for name in CHAMBER_OPTIONS if getattr(args, name) is not None}
        loading = dj.Chamber(volume=args.chamber_volume, **given)
    if args.control == "charge":
        loading = dj.ChargeControl(loading)
    return dj.Scene(_membrane(dj, args), loading, _window(dj, args), args.units)


def _curves(
    dj: Any, args: argparse.Namespace, membrane: Any, voltages: Sequence[float], surface: Any = None
) -> list[Any]:
    curves, options = [], {"points": args.points, "tolerance": args.tolerance, "window": _window(dj, args)}
    for voltage in voltages:
        say(f"pressure–volume curve at voltage {voltage:.6g} …")
        curves.append(dj.pressure_volume(membrane, voltage=voltage, surface=surface, **options))
    return curves


def _states(dj: Any, args: argparse.Namespace) -> tuple[Any, list[Any]]:
    """The scene of a chamber or the membrane alone, and its states at the asked voltage, by volume."""
    if args.chamber_volume is not None:
        args.control = "voltage"
        scene = _scene(dj, args)
        voltage = scene.in_units(args.voltage, "voltage")
        return scene, dj.equilibrium(scene, voltage=voltage, all=True, tolerance=args.tolerance)
    membrane = _membrane(dj, args)
    names = ("pressure", "volume", "apex_stretch")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    options = {"tolerance": args.tolerance, "window": _window(dj, args)}
    return membrane, dj.equilibrium(membrane, voltage=args.voltage, **given, **options, all=True)


def _run_equilibrium(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    say("equilibrium …")
    what, states = _states(dj, args)
    membrane = getattr(what, "membrane", what)
    states = states if args.all else states[:1]
    document = {"scene": dj.model.describe(what), "units": "dimensionless", "states": [s.to_json() for s in states]}

    def draw() -> Any:
        from ..plot import plot_diagram

        figure: Any = plot_diagram(_curves(dj, args, membrane, [args.voltage])[0], units=args.units)
        (ax,) = figure.axes
        right, top = ax.get_xlim()[1], ax.get_ylim()[1]
        for state in states if args.units is None else args.units.read(states):
            ax.plot(state.volume, state.pressure, "*", color="#D55E00", markersize=11, zorder=6)
            right, top = max(right, 1.1 * state.volume), max(top, 1.1 * state.pressure)
        ax.set_xlim(right=right)
        ax.set_ylim(top=top)
        return figure

    return document, draw


def _run_pressure_volume(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    curves = _curves(dj, args, _membrane(dj, args), args.voltage or [0.0])
    documents = [c.to_json() for c in curves]
    args.diagram = curves[0]

    def draw() -> Any:
        from ..plot import plot_diagram, plot_pressure_volume

        if len(curves) == 1:
            return plot_diagram(curves[0], units=args.units)
        return plot_pressure_volume(curves, units=args.units).figure

    return documents[0] if len(documents) == 1 else {"diagrams": documents}, draw


def _run_voltage_volume(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    scene = _scene(dj, args)
    surface = None
    if args.engine == "surface":
        say("surface of the membrane …")
        surface = dj.Surface.build(scene.membrane)
    say("voltage–volume diagram …")
    found = dj.report(scene, points=args.points, tolerance=args.tolerance, surface=surface, modes=args.modes)
    args.sentences, args.diagram = found.lines, found.diagram

    def draw() -> Any:
        say("pressure–volume curves …")
        return found.plot(shapes=args.shapes, surface=surface, points=args.points, tolerance=args.tolerance)

    return found.diagram.to_json(), draw


def _run_modes(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    say("modes …")
    what, states = _states(dj, args)
    found = dj.mode_spectrum(what, states[0], args.numbers, args.count)
    units = args.units
    if units is not None and args.density is not None:
        units = dataclasses.replace(units, density=args.density)
    document = {"scene": dj.model.describe(what), "units": "dimensionless"} | found.to_json(units)
    return document, lambda: None


def _run_sweep(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    from ..sweeps import read_specification

    scene, axes, options = read_specification(args.specification, {"in_time": dj.rates.InTime})
    options |= {"output": args.output, "resume": args.resume, "accept_versions": args.accept_versions}
    executor = args.scheduler if args.workers is None else args.workers
    begin = time.perf_counter()
    try:
        data = dj.sweep(scene, *axes, **options, executor=executor)
    except KeyboardInterrupt:
        if os.path.exists(args.output):
            print(f"{PROGRAM}: {args.output!r} keeps what is finished, --resume continues.", file=sys.stderr)
        raise
    seconds = time.perf_counter() - begin
    if args.export is not None:
        dj.sweeps.export_sweep(data, args.export)
        say(f"wrote {args.export}")
    return dj.sweeps.count_sweep(data) | {"seconds": seconds, "store": args.output}, lambda: None


def _run_regimes(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    from .design_files import read_design_file

    scene, over, options = read_design_file(args.specification, "regimes")
    say("regimes …")
    found = dj.regime_map(scene, over, **options)
    return found.to_json(), lambda: found.plot().figure


def _run_follow(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    from .follow_files import read_follow_file

    asked = read_follow_file(args.specification)
    count = max(map(len, asked.protocols.values()))
    say("runs …" if count > 1 else "run …")
    found = dj.follow([asked.scene] * count, **asked.protocols, **asked.options)
    followed = [run for run in found if not isinstance(run, Exception)]
    if not followed:
        raise found[0]
    if asked.check:
        dj.rates.estimate_errors(followed)

    def document(run: Any, **read: Any) -> dict:
        if isinstance(run, Exception):
            return {"error": str(run)}
        return run.to_json(asked.units, check=asked.check, **read)

    documents = [document(run) for run in found]
    readable = [document(run, read=True) for run in found]
    args.readable = readable[0] if count == 1 else {"runs": readable}

    def draw() -> Any:
        from ..plot import plot_follow

        bounds = ()
        if "volume" not in asked.protocols and "pressure" not in asked.protocols:
            bounds = dj.bounds(asked.scene, start=asked.options.get("start", "relaxed"))
        labels = [label for label, run in zip(asked.labels, found, strict=False) if run in followed]
        return plot_follow(followed, bounds=bounds, labels=labels, units=asked.units)

    return documents[0] if count == 1 else {"runs": documents}, draw


def _run_optimise(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    from .design_files import read_design_file

    scene, over, options = read_design_file(args.specification, "optimise")
    say("design …")
    found = dj.maximise_area_strain(scene, over, **options)

    def draw() -> Any:
        return (found.diagram or dj.voltage_volume(found.scene)).plot()

    return found.to_json(), draw


def _run_calibrate(dj: Any, args: argparse.Namespace) -> tuple[dict, Callable[[], Any]]:
    from .measured_files import fit_files

    units, membrane = args.units, _membrane(dj, args)
    # voltage, noise and atmospheric pressure of a measurement stay in the units of the pressures, like the document
    if units is not None:
        for name in ("atmospheric_pressure", "voltage"):
            setattr(args, name, units.to_si(getattr(args, name), name))
    args.units, args.si = None, False
    found, membrane, notices = fit_files(dj, args, membrane, units)
    document = {"scene": dj.model.describe(membrane), **found.to_json(), "notices": notices}
    document |= {n: [option_names(v, args) for v in document[n]] for n in ("notices", "warnings")}
    if args.json is not None or args.figure is not None:
        for sentence in (*document["notices"], *document["warnings"]):
            print(f"{PROGRAM}: {sentence}", file=sys.stderr, flush=True)
    return document, found.plot


_COMMANDS = {
    "calibrate": _run_calibrate,
    "follow": _run_follow,
    "sweep": _run_sweep,
    "regimes": _run_regimes,
    "optimise": _run_optimise,
    "equilibrium": _run_equilibrium,
    "modes": _run_modes,
    "pressure-volume": _run_pressure_volume,
    "voltage-volume": _run_voltage_volume,
}


def _in_units(document: dict, units: Any, *, read: bool = False) -> dict:
    """The document in SI, or in the display units; unchanged without units."""
    if units is None:
        return document
    if "diagrams" in document:
        return {"diagrams": [units.to_document(d, read=read) for d in document["diagrams"]]}
    return units.to_document(document, read=read)


def _write(document: dict, draw: Callable[[], Any], args: argparse.Namespace) -> None:
    if args.json is not None:
        text = json.dumps(_in_units(document, args.units), allow_nan=False) + "\n"
        if args.json == "-":
            sys.stdout.write(text)
            sys.stdout.flush()
        else:
            Path(args.json).write_text(text, encoding="utf-8")
            say(f"wrote {args.json}")
    if getattr(args, "csv", None) is not None:
        args.diagram.to_csv(args.csv, args.units)
        say(f"wrote {args.csv}")
    figure = getattr(args, "figure", None)
    if figure is not None:
        import matplotlib

        matplotlib.use("Agg")
        draw().savefig(figure, dpi=150)
        say(f"wrote {figure}")
    if args.json != "-":
        readable = getattr(args, "readable", None) or _in_units(document, args.units, read=True)
        sentences = getattr(args, "sentences", ())
        print("\n".join([*sentences, *([""] if sentences else []), summary(readable)]), flush=True)


def _run_paper(args: argparse.Namespace) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from .paper import reproduce
    from .paper_statements import statements_table

    Path(args.output).mkdir(exist_ok=True)
    try:
        made = reproduce(args.output, args.only, format=args.format, dpi=args.dpi, say=say)
        print(statements_table(made), flush=True)
    except ValueError as error:
        raise BadInput(option_names(str(error), args)) from error


def _run_explore(dj: Any, args: argparse.Namespace) -> None:
    from .explorer_page import serve

    args.volume, args.control = None, "voltage"
    args.stretch_window = args.load_window = None
    if args.pressure is None and args.chamber_volume is None:
        args.chamber_volume, args.initial_volume = 1600.0, 2.42
        if args.units is not None:
            args.atmospheric_pressure = args.units.reduce(dj.model.ATMOSPHERE, "atmospheric_pressure")
    _say_doubt(dj, args)
    serve(_scene(dj, args), port=args.port, browser=not args.no_browser)


def _run_explain(args: argparse.Namespace) -> None:
    from ..model import GLOSSARY, explain

    for word in args.words or GLOSSARY:
        try:
            print(f"{word}: {explain(word)}" if len(args.words) != 1 else explain(word))
        except ValueError as error:
            raise BadInput(str(error).replace("`word`", "WORD")) from error


def _say_doubt(dj: Any, args: argparse.Namespace) -> None:
    """Says where the breakdown law of VHB serves another film."""
    units = getattr(args, "units", None)
    doubt = dj.model.doubt_of_vhb(dj.VHBBreakdown(), units) if units is not None and args.breakdown == "vhb" else None
    if doubt:
        print(f"{PROGRAM}: {doubt}".replace("`breakdown`", "--breakdown"), file=sys.stderr)


def _answer(args: argparse.Namespace) -> None:
    """Computes and writes the results that well-formed options request."""
    if args.command == "explain":
        return _run_explain(args)
    import jax

    jax.config.update("jax_enable_x64", True)
    import dielectric_jax as dj

    if args.command == "paper":
        return _run_paper(args)
    if getattr(args, "points", 0) is None:
        args.points = 256
    try:
        args.units = _units(dj, args) if hasattr(args, "si") else None
        if args.command == "explore":
            return _run_explore(dj, args)
        document, draw = _COMMANDS[args.command](dj, args)
    except dj.model.OutOfReach as error:
        raise BadInput(option_names(str(error.in_units(args.units)), args, in_si=True)) from error
    except (ValueError, ImportError, StoreError) as error:
        raise BadInput(option_names(str(error), args)) from error
    _say_doubt(dj, args)
    _write(document, draw, args)


def _status(argv: Sequence[str] | None) -> int:
    """Runs the program and returns its exit status; refusals are one sentence on standard error."""
    try:
        _answer(read_arguments(argv))
    except BadInput as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 2
    except (SceneError, WorkersLost) as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # the reader of standard output has closed it; Python must not try to flush to it at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"{PROGRAM}: {error.filename or 'a file'} could not be written: {error.strerror}.", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{PROGRAM}: stopped.", file=sys.stderr)
        return 130
    return 0


@contextlib.contextmanager
def _warnings_as_sentences() -> Iterator[None]:
    """Prints this package's warnings as sentences on standard error, and ignores overflow in NumPy's arrays, which ends as
    NaN that the result reports.
    """

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        print(f"{PROGRAM}: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* encountered in ", category=RuntimeWarning)
        warnings.showwarning = show
        yield


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the program on `argv` (the process's own arguments when None) and returns its exit status.

    >>> main(["equilibrium", "--volume", "-1"])
    2
    """
    with readable_streams(), _warnings_as_sentences():
        return _status(argv)


if __name__ == "__main__":
    sys.exit(main())
