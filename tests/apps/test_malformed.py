"""Malformed command lines and TOML files: every one is refused with a sentence, whatever is wrong with it.

Each option of each command, and each key of each table, is given invalid values. Input that passes all checks is stopped where the
computation would begin, so that thousands of cases take seconds.
"""

import argparse
import contextlib
import functools
import io
import random
import re

import pytest

import dielectric_jax as dj
from dielectric_jax.apps import explorer_page, paper
from dielectric_jax.apps import options as arguments
from dielectric_jax.apps.cli import main
from dielectric_jax.design import area_strain as design
from dielectric_jax.design import regime_maps
from dielectric_jax.diagram import diagrams as diagram
from dielectric_jax.diagram import states
from dielectric_jax.rates import following
from dielectric_jax.sweeps import sweeps

LONG = "9" * 5000
VALUES = [
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "1e400", "0", "-0.0", "-1", "1.5", "", " ", "text", "9" * 400, LONG, "-" + LONG,
    "\0", "1\0", "λ≠", "½", "\ud800", "a\nb", "1,5", "0x10", "1e", "--", "-", "/", "/dev/null/x", "a" * 300, "None", "True", "[1]", "5 ml", "3kV", "1e999 l",
]  # fmt: skip
NO_NUMBERS = ("nan", "inf", "-inf", "1e400", "", "text", "\0", "λ≠", "1,5", "0x10", "1e", "a\nb", "[1]")
COMMANDS = {
    "equilibrium": ["--volume", "2.42"],
    "pressure-volume": [],
    "voltage-volume": ["--chamber-volume", "1600", "--initial-volume", "2.42"],
    "modes": ["--pressure", "1"],
    "sweep": ["sweep.toml", "--output", "s.zarr"],
    "calibrate": ["data.csv"],
    "regimes": ["regimes.toml"],
    "optimise": ["design.toml"],
    "follow": ["follow.toml"],
    "explore": [],
    "paper": ["--output", "paper"],
}


class Reached(Exception):
    """Raised when all checks are passed and the computation would begin."""


@pytest.fixture
def stopped(monkeypatch, tmp_path):
    """Stops every command where its computation would begin, in a folder with the files that the commands read."""

    def reach(*_, **__):
        raise Reached

    for module, name in (
        (states, "_starts"),
        (states, "_flat_equilibrium"),
        (diagram, "warm_up"),
        (sweeps, "_run"),
        (regime_maps, "surface_over"),
        (design, "scan_designs"),
        (following, "serve"),
        (paper, "Paper"),
        (explorer_page, "serve"),
        (dj, "calibrate"),
        (dj.Surface, "build"),
        (dj.surface.SurfaceFamily, "build"),
        (sweeps.ZarrStore, "create"),
    ):
        monkeypatch.setattr(module, name, reach, raising=name != "calibrate")
    monkeypatch.setattr(arguments, "make_parser", functools.cache(arguments.make_parser))  # half of the time of a line
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", "off")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data.csv").write_text("volume,pressure\n0.5,1.0\n1.0,1.4\n2.0,1.8\n")
    for name, text in TOML.items():
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def ran(argv: list[str]) -> tuple[int | str, str, str]:
    """The exit status of a command line, or "reached", and what it wrote."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            status: int | str = main(argv)
        except Reached:
            status = "reached"
        except SystemExit as stop:
            status = "help" if stop.code == 0 else f"exit {stop.code!r}"
        except BaseException as error:
            status = f"{type(error).__name__}: {str(error)[:200]}"
    return status, out.getvalue(), err.getvalue()


def fault(status, out: str, err: str) -> str | None:
    """What is wrong with the outcome of a malformed command line; None for one clear sentence, or for well-formed input."""
    if status in ("reached", "help"):
        return None if err == "" else f"{status}, but says {err[:200]!r}"
    if status not in (1, 2):
        return f"{status}"
    if out or not re.fullmatch(r"dielectric-jax: [^\n]+\.\)?\n", err):
        return f"no sentence: {out[:100]!r} {err[:300]!r}"
    if "Traceback" in err or len(err) > 1200:
        return f"no plain sentence: {err[:300]!r}"
    return None


@functools.cache
def options(command: str) -> list[argparse.Action]:
    """The options of a command and its operands, as the parser knows them."""
    (commands,) = (a for a in arguments.make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return [a for a in commands.choices[command]._actions if a.dest != "help"] if command in commands.choices else []


def without(argv: list[str], option: str) -> list[str]:
    """A command line without an option and its value."""
    if option not in argv:
        return argv
    i = argv.index(option)
    return argv[:i] + argv[i + 2 :]


def command_lines():
    """(argv, option, value): every option with every value, once, missing, twice, and beside all others."""
    for command, base in COMMANDS.items():
        every = options(command)
        for action in every:
            option = action.option_strings[0] if action.option_strings else action.dest
            for value in VALUES:
                if action.option_strings:
                    count = action.nargs if isinstance(action.nargs, int) else 1
                    own = [option, *[value] * count] if action.nargs != 0 else [option, value]
                    yield [command, *without(base, option), *own], option, value
                    yield [command, *without(base, option), f"{option}={value}"], option, value if count == 1 else None
                else:
                    yield [command, value, *base[1:]], option, value
            if action.option_strings:
                yield [command, *base, option], option, None
                yield [command, *without(base, option), option, "1", option, "2"], option, None
                yield [command, *without(base, option)], option, None
        for one in every:
            for other in every:
                if one.option_strings and other.option_strings:
                    pair = [a for o in (one, other) for a in (o.option_strings[0], *["1"] * (o.nargs != 0))]
                    yield [command, *base, *pair], one.option_strings[0], None
    yield from (([word], "COMMAND", word) for word in VALUES)


TOML = {
    "sweep": """
tolerance = 1e-9
block = 64
engine = "continuation"
resolve = false
curves = false
[units]
shear_modulus = 45e3
thickness = 1e-3
[scene]
material = "gent"
stretch_limit = 270.0
breakdown = "vhb"
initial_volume = "27.5 ml"
atmospheric_pressure = 100e3
polytropic_exponent = 1.0
stretch_window = [1.0, 11.0]
load_window = [-1.0, 1.0]
[product]
prestretch = [1.0, 1.25]
breakdown_field_scale = { from = 0.8, to = 1.2, count = 3, spacing = "log" }
[zip.case]
chamber_volume = [0.018, "20 l"]
[samples.drawn]
method = "sobol"
count = 4
seed = 0
stretch_limit = { distribution = "triangular", from = 100.0, to = 300.0, mode = 200.0 }
""",
    "design": """
[scene]
chamber_volume = 1600.0
initial_volume = 2.42
[over]
chamber_volume = [500.0, 25000.0]
[optimise]
survival_margin = 0.2
operating_margin = 0.1
must_snap = true
way_down = "returns"
quantile = 0.1
compare = 0
check = false
[uncertain]
initial_volume = 0.01
""",
    "regimes": """
[scene]
material = "mooney-rivlin"
c1 = 0.45
c2 = 0.05
prestretch = 1.5
breakdown = 5.0
chamber_volume = 1600.0
initial_pressure = 0.5
[over]
chamber_volume = [100.0, 25000.0]
initial_pressure = [0.3, 0.6]
[regimes]
points = [40, 40]
""",
    "follow": """
[scene]
material = "viscoelastic"
elastic = "gent"
stretch_limit = 110.0
branches = [{ modulus_ratio = 1.0, relaxation_time = 2.0 }]
chamber_volume = 18.2e-3
initial_volume = 27.5e-6
[units]
thickness = "1 mm"
opening_radius = 22.5e-3
[voltage]
protocol = "ramp"
rate = [300.0, 3000.0]
start = 0.0
stop = 9000.0
[follow]
start = "fresh"
until = 10.0
tolerance = 1e-5
check = false
""",
}
LITERALS = [
    "nan", "inf", "-inf", "-1", "-1.5", "0", "0.0", "1", "1.5", "1e308", "-1e308", "1e-308", "1e400", "9" * 400, "-" + "9" * 400, LONG,
    "1000000000000", '""', '"text"', '"1"', r'"\u0000"', '"λ"', "[]", "{}", '[1, "a"]', "[[1.0]]", "[nan, 1.0]", "[1.0, inf]", "[2.0, 1.0]",
    "[1.0, 1.0]", "[1.0, 1e308]", "[true, false]", "[0, 5]", "[-3.0, 2.0]", "[" + "9" * 400 + "]", "{ a = 1 }", "{ from = 1 }", "true", "false",
    "'3 kV'", "'5 ml'", "'1e999 l'", "1979-05-27", "1979-05-27T07:32:00Z", "07:32:00", "{ from = 1.0, to = 2.0, count = 1000000000000 }", "{ from = nan, to = 2.0, count = 3 }",
    "{ from = 1.0, to = inf, count = 3 }", "{ from = 1.0, to = 2.0, count = -1 }", "{ from = 1.0, to = 2.0, count = true }",
    "{ from = -1.0, to = 2.0, count = 3, spacing = 'log' }", "{ from = 1.0, to = 2.0, count = 3, spacing = [] }",
    "{ distribution = [], from = 1.0, to = 2.0 }", "{ distribution = 'normal', mean = 1.0, standard_deviation = 1e308 }",
    "{ distribution = 'lognormal', median = 1e308, factor = 2.0 }", "{ from = " + "9" * 400 + ", to = 2.0 }", "'a\nb'", "=", "[", "\0", "\ud800",
]  # fmt: skip
STRANGERS = [
    "stranger = 1", "[stranger]", "[scene.deeper]\na = 1", "[zip.'a b']\nprestretch = [1.0]", "[zip.jump]\nprestretch = [1.0, 2.0]",
    "[zip.outcome]\nprestretch = [1.0, 2.0]", "[zip.case2]", "[samples.more]\ncount = 2", "[table.scene]", "[table.scene]\nfile = 1",
    "[table.scene]\nfile = 'none.csv'", "[table.scene]\nfile = '.'", "[table.scene]\nfile = 'sweep.toml'", r"""[table.scene]
file = "\u0000" """, "[samples.more]\ncount = 2\nseed = nan\nchamber_volume = {from = 1.0, to = 2.0}",
    "[zip.case3]\nprestretch = [1.0]\nstretch_limit = [1.0, 2.0]", "[over]\nchamber_size = [1.0, 2.0]", "x = " + "[" * 10000,
    "[zip.x]\nmoduli = [1.0]", "[zip.x]\nthickness = [1e-3]\npressure = [1.0]", "[scene]\nchamber_volume = 1.0", "[samples]\nx = 1",
    "[zip.x]\nthickness = [1e-3, 2e-3]\natmospheric_pressure = [40.0, 50.0]", "[units]\nradius = nan", "[uncertain]\nx = 1", "\ufeff", "\x7f",
]  # fmt: skip


def documents():
    """(command, text, key, literal): every key with every value, without it, with unknown keys beside it, and truncated."""
    for name, text in TOML.items():
        lines = text.splitlines()
        for i, line in enumerate(lines):
            key, equals, _ = line.partition(" = ")
            rest = lines[:i], lines[i + 1 :]
            if equals:
                yield name, "\n".join([*rest[0], *rest[1]]), key, None
                for literal in LITERALS:
                    yield name, "\n".join([*rest[0], f"{key} = {literal}", *rest[1]]), key, literal
            for inner, value in re.findall(r"(\w+) = ([^,{}]+?)(?=[ ,}])", line) if "{" in line else ():
                for literal in LITERALS:
                    yield name, text.replace(f"{inner} = {value}", f"{inner} = {literal}"), inner, literal
            yield name, text[: text.index(line) + len(line) // 2], key, None
        for stranger in STRANGERS:
            yield name, stranger + "\n" + text, "stranger", None
            yield name, text + "\n" + stranger, "stranger", None


@pytest.mark.parametrize("seed", [19])
def test_malformed_command_lines_are_refused_in_a_sentence(stopped, seed):
    every = list(command_lines())
    found, counts = [], {}
    for argv, option, value in random.Random(seed).sample(every, 1600):
        status, out, err = ran(argv)
        wrong = fault(status, out, err)
        numeric = any(a.type is not None for a in options(argv[0]) if option in a.option_strings)
        if wrong is None and numeric and value in NO_NUMBERS and argv[-1] != f"{option}=":
            # the option by name, and the value as it was given, in a form that fits on a line
            if status != 2 or option not in err or repr(value) not in err:
                wrong = f"does not name {option} and {value!r}: {status} {err!r}"
        counts[status] = counts.get(status, 0) + 1
        if wrong:
            found.append((argv if len(str(argv)) < 300 else str(argv)[:300], wrong))
    assert found == []
    assert counts[2] > 1000 and counts["reached"] > 100  # both results of the checks occurred


@pytest.mark.parametrize("seed", [19])
def test_malformed_files_are_refused_in_a_sentence(stopped, seed):
    every = list(documents())
    found, counts = [], {}
    for name, text, key, literal in random.Random(seed).sample(every, 600):
        (stopped / "x.toml").write_bytes(text.encode("utf-8", "surrogatepass"))
        more = ["--output", "s.zarr"] if name == "sweep" else []
        status, out, err = ran([{"design": "optimise"}.get(name, name), "x.toml", *more])
        wrong = fault(status, out, err)
        counts[status] = counts.get(status, 0) + 1
        if wrong:
            found.append((name, key, literal and literal[:60], text[-80:] if key == "stranger" else "", wrong))
    assert found == []
    assert counts[2] > 400 and counts["reached"] > 20


def test_the_files_are_well_formed_before_anything_is_changed(stopped):
    for command, base in COMMANDS.items():
        assert ran([command, *base])[0] == "reached", command
