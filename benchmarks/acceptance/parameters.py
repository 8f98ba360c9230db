"""Does every verb take every parameter of every kind of scene, and agree with an independent answer, or say why it does not?

    python -m benchmarks.acceptance.parameters [--quick] [--json FILE|-] [--scenes NAME ...] [--parameters NAME ...] [--verbs NAME ...]

Scenes are all materials, breakdown laws and loadings. What a verb says of two values of a parameter is compared with the whole
diagram of each, a derivative with a central difference. A verb may refuse only for the reasons in `REASONS`.
"""

import contextlib
import functools
import io
import itertools
import math
import pathlib
import re
import sys
import tempfile
import typing

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.harness import Stopwatch, arguments, finish, machine, say, write
from dielectric_jax.apps.design_files import read_design_file
from dielectric_jax.apps.options import MATERIAL_CONSTANTS, BadInput, read_arguments
from dielectric_jax.design import regime_edges
from dielectric_jax.diagram import MembraneKey
from dielectric_jax.model import (
    PARAMETERS,
    Change,
    CustomBreakdown,
    change_of,
    describe_in_units,
    parameter_of,
    scene_of,
)
from dielectric_jax.sweeps import read_specification

jax.config.update("jax_enable_x64", True)

AIR = {"atmospheric_pressure": 40.0, "polytropic_exponent": 1.2}
FILLED = dj.Chamber(volume=1600.0, initial_volume=2.3, **AIR)
UNITS = ("shear_modulus", "thickness", "radius", "permittivity")


class Yeoh(dj.AbstractMaterial):
    """A user's material, W = I/2 + c3 I³ with I = λ1² + λ2² + λ3² − 3, whose constant is a parameter too."""

    c3: float = 1e-4

    def energy(self, l1, l2):
        rise = l1**2 + l2**2 + (l1 * l2) ** -2 - 3
        return rise / 2 + self.c3 * rise**3

    def admissible(self, l1, l2):
        return (l1 > 0) & (l2 > 0)

    def lock_up_stretch(self, prestretch):
        return 12 * prestretch, False


class EveryConstant(dj.AbstractMaterial):
    """A user's material with every published constant that is a number: Mooney–Rivlin, Gent and eight-chain springs side by side.

    The eight chains are the first two terms of their series, which compile quickly.
    """

    c1: float = 0.43
    c2: float = 0.02
    stretch_limit: float = 300.0
    chain_links: float = 150.0

    def energy(self, l1, l2):
        first = l1**2 + l2**2 + (l1 * l2) ** -2
        chains = (first - 3) / 2 + (first**2 - 9) / (20 * self.chain_links)
        rubber = dj.MooneyRivlin(self.c1, self.c2).energy(l1, l2)
        return rubber + (dj.Gent(self.stretch_limit).energy(l1, l2) + chains) / 20

    def admissible(self, l1, l2):
        return dj.Gent(self.stretch_limit).admissible(l1, l2)

    def lock_up_stretch(self, prestretch):
        return dj.Gent(self.stretch_limit).lock_up_stretch(prestretch)


def scene_of_everything() -> dj.Scene:
    """A chamber with every published parameter that is a number, but for the pressure or volume of other loadings."""
    rubber = dj.Electrostrictive(EveryConstant(), 0.01, -0.02)
    chamber = dj.Chamber(volume=40e-3, initial_volume=27e-6, atmospheric_pressure=100e3, polytropic_exponent=1.2)
    return dj.Scene.from_si(membrane_of(rubber, dj.VHBBreakdown(0.9)), chamber, dj.Units(thickness=0.8e-3))


def _law(stretch):
    return 2.0 * stretch**0.9


def membrane_of(material, law=None) -> dj.Membrane:
    """A prestretched membrane; every parameter of it can go up and down."""
    return dj.Membrane(material, 1.1, dj.VHBBreakdown(0.9) if law is None else law)


def scenes() -> dict[str, dj.Scene]:
    """A scene of every material, every breakdown law and every loading."""
    elastic = {
        "gent": dj.Gent(120.0),
        "neo-hookean": dj.NeoHookean(),
        "arruda-boyce": dj.ArrudaBoyce(80.0),
        "mooney-rivlin": dj.MooneyRivlin(0.48, 0.02),
        "ogden": dj.Ogden((1.0, 0.02), (1.8, 3.0)),
        "ogden of one term": dj.Ogden((1.0,), (2.0,)),
        "user's": Yeoh(),
    }
    gent = membrane_of(elastic["gent"])
    pressure, volume = dj.ConstantPressure(1.6), dj.PrescribedVolume(3.0)
    in_si = dj.Chamber(volume=18e-3, initial_volume=27e-6, atmospheric_pressure=100e3)
    made = {name: dj.Scene(membrane_of(material), FILLED) for name, material in elastic.items()}
    made |= {
        "chamber by its pressure": dj.Scene(gent, dj.Chamber(volume=1600.0, initial_pressure=1.6, **AIR)),
        "constant pressure": dj.Scene(gent, pressure),
        "everything": scene_of_everything(),
        "with units": dj.Scene.from_si(membrane_of(elastic["gent"]), in_si, dj.Units(thickness=0.8e-3)),
        "constant field": dj.Scene(membrane_of(elastic["gent"], dj.ConstantBreakdown(5.0, 0.9)), FILLED),
        "user's field": dj.Scene(membrane_of(elastic["gent"], CustomBreakdown(_law, 0.9)), FILLED),
        "prescribed volume": dj.Scene(gent, volume),
        "constant voltage": dj.Scene(gent, dj.ConstantVoltage(0.05)),
    }
    for loading in (FILLED, pressure, volume):
        made[f"charge, {type(loading).__name__}"] = dj.Scene(gent, dj.ChargeControl(loading))
    for name, material in elastic.items():
        rubber = dj.Electrostrictive(material, 0.01, -0.02)
        made[f"electrostrictive {name}"] = dj.Scene(membrane_of(rubber), FILLED)
    branches = [dj.Maxwell(dj.Gent(60.0), 0.6, 0.1), dj.Maxwell(elastic["ogden"], 0.4, 10.0)]
    made["viscoelastic"] = dj.Scene(membrane_of(dj.Viscoelastic(elastic["gent"], branches)), FILLED)
    return made


def described(scene: dj.Scene) -> dict:
    """The parameters of a scene as it gives them."""
    return describe_in_units(scene)["scene"]


def numbers_of(scene: dj.Scene) -> dict:
    """The description of a scene, in SI with units, with those of its branches under their published names."""
    said = described(scene)
    branches = said.pop("branches", [])
    for name in ("modulus_ratio", "relaxation_time") if branches else ():
        said[name] = [own.pop(name) for own in branches]
    return said | {f"branches[{k}].{n}": v for k, own in enumerate(branches) for n, v in own.items()}


def value_of(scene: dj.Scene, name: str):
    """The value of a parameter; None of the filling that another gives."""
    return scene.value_of(name)


def limits_of(scene: dj.Scene, name: str) -> tuple[float, float]:
    """A small range about the scene's value, or that of the first entry of a list."""
    if not scene.has(name):
        return 1.5, 2.5
    value = value_of(scene, name)
    value = scene.in_units({"initial_volume": 2.3, "initial_pressure": 1.5}[name], name) if value is None else value
    low, high = sorted(share * float(np.atleast_1d(value)[0]) for share in (0.97, 1.04))
    return (low, high) if math.isinf(parameter_of(name).least) else (max(low, parameter_of(name).least), high)


@functools.lru_cache(maxsize=256)
def _diagram(key: MembraneKey):
    return dj.voltage_volume(typing.cast(dj.Scene, key.membrane))


def diagram_of(scene: dj.Scene):
    """The whole diagram, computed once."""
    return _diagram(MembraneKey.of(typing.cast(dj.Membrane, scene)))


def at(scene: dj.Scene, name: str, limits: tuple[float, float]) -> list[dj.Scene]:
    """The scenes at both limits of a parameter."""
    return [scene.replace(**{name: value}) for value in limits]


def regime_of(scene: dj.Scene) -> dj.Regime:
    """The regime by the whole diagram."""
    return dj.diagram.regimes.regime_of_diagram(diagram_of(scene))


def snap_of(scene: dj.Scene) -> float:
    """The voltage of the first snap of the diagram's ramp, NaN where there is none."""
    snaps = diagram_of(scene).ramp()["snap"]
    return scene.in_units(snaps[0].state.voltage, "voltage") if snaps else math.nan


class Differs(Exception):
    """An answer that is not the independent one."""


def compare(what: str, found, known, tolerance: float = 0.0) -> float:
    """The relative difference of two numbers, or 0 for what is equal; raises Differs where it exceeds the tolerance."""
    if not isinstance(found, (float, np.ndarray, np.generic)):
        if found != known:
            raise Differs(f"{what} is {found}, but {known} by the independent answer.")
        return 0.0
    apart = float(abs(found - known) / max(abs(known), 1e-3)) if np.isfinite([found, known]).any() else 0.0
    if not apart <= tolerance:
        raise Differs(f"{what} is {float(found)!r}, but {float(known)!r} by the independent answer.")
    return apart


# the verbs: each takes a scene, a parameter and a range, and returns its largest difference from the independent answer


def replaced(scene, name, limits) -> float:
    """`replace`, `has` and `describe`: the value, and back."""
    many, own = parameter_of(name).many, value_of(scene, name)
    compare("has", scene.has(name), True)
    value = (limits[1], *own[1:]) if many else limits[1]
    changed, before = scene.replace(**{name: value}), numbers_of(scene)
    said = numbers_of(changed)
    apart = compare(name, np.float64(np.ravel(said[name])[0]), limits[1], 1e-14)
    others = {n for n in {*said, *before} if said.get(n) != before.get(n)} - {name}
    if name.startswith("initial_"):
        others -= {"initial_volume", "initial_pressure"}
    if parameter_of(name).path[0] != "units":
        compare("another parameter that changes", others, set())
    if own is not None:
        for n, v in numbers_of(changed.replace(**{name: own})).items():
            apart = max(apart, compare(n, v, before[n], 1e-14))
    return apart


def compare_scenes(found: dj.Scene, known: dj.Scene) -> float:
    """The largest difference of the parameters of two scenes; a round trip through SI rounds."""
    mine, other = described(found), described(known)
    tolerance = 0.0 if known.units is None else 1e-14
    compare("the names", list(mine), list(other))
    return max(compare(n, np.float64(v) if isinstance(v, float) else v, other[n], tolerance) for n, v in mine.items())


def _parts(scene: dj.Scene) -> tuple[dict, dict]:
    """The description of a scene, and its constants of the units apart."""
    said = described(scene)
    return {n: v for n, v in said.items() if n not in UNITS}, {n: v for n, v in said.items() if n in UNITS}


def documented(scene, name, limits) -> float:
    """`describe` and back by `scene_of`."""
    many = parameter_of(name).many
    changed = scene.replace(**{name: (limits[1], *value_of(scene, name)[1:]) if many else limits[1]})
    return compare_scenes(scene_of(*_parts(changed)), changed)


def _value(value) -> str:
    """A value of TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{n} = {_value(v)}" for n, v in value.items()) + "}"
    return f"[{', '.join(map(_value, value))}]" if isinstance(value, list) else repr(value)


def _toml(scene: dj.Scene, *tables: str) -> str:
    parts = zip(("scene", "units"), _parts(scene), strict=True)
    lines = [(f"[{table}]", *(f"{n} = {_value(v)}" for n, v in own.items())) for table, own in parts if own]
    return "\n".join([*itertools.chain(*lines), *tables])


def written(scene, name, limits) -> float:
    """A file of TOML in which the parameter varies: of a sweep, a map and an optimisation."""
    key = name if name.isidentifier() else f'"{name}"'
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "spec.toml"
        path.write_text(_toml(scene, "[product]", f"{key} = {list(limits)}"), encoding="utf-8")
        made, axes, _ = read_specification(path)
        wanted = scene.replace(**{name: limits[1]})
        compare("the axis", axes[0].columns[name].tolist(), list(limits))
        compare_scenes(made.replace(**{name: limits[1]}), wanted)
        for command in ("regimes", "optimise"):
            tables = "[over]", f"{key} = {list(limits)}"
            path.write_text(_toml(scene, *tables, *(("[uncertain]", f"{key} = 0.1") if command == "optimise" else ())), encoding="utf-8")  # fmt: skip
            made, over, options = read_design_file(str(path), command)
            compare("the range", over, {name: limits})
            compare("what is uncertain", options.get("uncertain"), {name: 0.1} if command == "optimise" else None)
            compare_scenes(made.replace(**{name: limits[1]}), wanted)
    return 0.0


@functools.cache
def _help() -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        read_arguments(["voltage-volume", "--help"])
    return " ".join(text.getvalue().split())


def typed(scene, name, limits) -> float:
    """The option of the command line, and its help."""
    many = parameter_of(name).many
    said, constants = _parts(scene.replace(**{name: (limits[1], *value_of(scene, name)[1:]) if many else limits[1]}))
    if constants:
        said |= constants
        said["relative_permittivity"] = said.pop("permittivity") / dj.model.VACUUM_PERMITTIVITY
    given = {n: v for n, v in said.items() if n == name or n not in ("elastic", "breakdown_field_scale")}
    words = ["voltage-volume", *(["--si"] if constants else [])]
    for option, value in given.items():
        words += ["--" + option.replace("_", "-"), *map(str, value if isinstance(value, list) else [value])]
    own = "relative_permittivity" if name == "permittivity" else name
    compare(own, getattr(read_arguments(words), own), given[own])
    compare("in the help", f"--{own.replace('_', '-')} " in _help(), True)
    return 0.0


def classified(scene, name, limits) -> float:
    """`classify_designs` against the regimes of diagrams."""
    found = dj.classify_designs(scene, {name: list(limits)})
    return compare(
        "regimes", [dj.Regime(int(r)) for r in found.regime], [regime_of(s) for s in at(scene, name, limits)]
    )


def swept(engine: str, scene, name, limits) -> float:
    """`sweep` against the snaps, regimes and area strains of diagrams."""
    data = dj.sweep(scene, engine=engine, resolve=True, progress=False, **{name: list(limits)})
    apart = 0.0
    for i, own in enumerate(at(scene, name, limits)):
        row, ramp = data.isel({name: i}), diagram_of(own).ramp()
        compare("regime", dj.Regime(int(row.regime)), regime_of(own))
        apart = max(apart, compare("snap voltage", np.float64(row.snap_voltage.values[0]), snap_of(own), 1e-6))
        if ramp.area_strain_reason != "window":
            strain = math.nan if ramp.area_strain is None else ramp.area_strain
            apart = max(apart, compare("area strain", np.float64(row.area_strain), strain, 1e-6))
    return apart


def differentiated(scene, name, limits) -> float:
    """`jax.grad` of `snap_voltage` against a central difference of fourth order."""
    many, x = parameter_of(name).many, sum(limits) / 2

    def snap(value):
        return dj.snap_voltage(scene.replace(**{name: (value, *value_of(scene, name)[1:]) if many else value}))

    slope, step = float(jax.grad(snap)(x)), 1e-3 * abs(x)
    values = {k: float(snap(x + k * step)) for k in (-2, -1, 1, 2)}
    known = (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12 * step)
    # of a parameter that the snap does not depend on, both are rounding
    scale = max(abs(known), 1e-6 * values[1] / abs(x))
    return compare("slope over its size", np.float64(slope / scale), known / scale, 1e-5)


def edges_found(scene, name, limits) -> float:
    """`regime_edges` against the regimes of diagrams at both ends, and at both sides of the first edge."""
    found = regime_edges(scene, {name: limits}, points=3)
    ends = [regime_of(s) for s in at(scene, name, limits)]
    regimes = [found[0].below, *(e.above for e in found)] if found else ends[:1]
    compare("regimes at the ends", [regimes[0], regimes[-1]], ends)
    if found:
        edge = found[0]
        step = max(10 * edge.error * abs(edge.value), 1e-6 * (limits[1] - limits[0]))
        sides = at(scene, name, (edge.value - step, edge.value + step))
        compare(f"regimes beside {edge.value!r}", [edge.below, edge.above], [regime_of(s) for s in sides])
    return 0.0


def _beside(scene: dj.Scene, name: str) -> str:
    """Another parameter that the scene has."""
    return next(n for n in ("chamber_volume", "pressure", "breakdown_field_scale", "prestretch") if n != name and scene.has(n))  # fmt: skip


def mapped(scene, name, limits) -> float:
    """`regime_map` with another parameter against the regimes of diagrams in two corners."""
    other = _beside(scene, name)
    beside = limits_of(scene, other)
    found = dj.regime_map(scene, {name: limits, other: beside}, points=3)
    for x, y in zip(limits, beside, strict=True):
        compare("regime", found.at(x, y), regime_of(scene.replace(**{name: x, other: y})))
    return 0.0


@contextlib.contextmanager
def none_may_survive(scene, name, limits, margin: float):
    """Lets `maximise_area_strain` refuse a range in which no diagram's ramp breaks down on its branch after landings with a margin."""
    try:
        yield
    except ValueError as error:
        if "must contain a design that satisfies the constraints" not in str(error):
            raise
        for value in np.linspace(*limits, 5):
            ramp = diagram_of(scene.replace(**{name: value})).ramp()
            landed = max([e.state.breakdown_ratio for e in ramp["landing"]], default=0.0)
            fair = ramp.area_strain_reason == "breakdown on the branch" and landed <= 1 - margin - 1e-6
            compare(f"whether {name} = {value!r} survives", fair, False)


def maximised(scene, name, limits) -> float:
    """`maximise_area_strain` over the parameter against the diagram of its design and a scan."""
    best = None
    with none_may_survive(scene, name, limits, 0.05):
        best = dj.maximise_area_strain(scene, {name: limits}, survival_margin=0.05, compare=16)
    if best is None:
        return 0.0
    assert best.diagram is not None and best.scan is not None
    compare("worse than the scan", bool(best.scan["gain"] < -1e-9), False)
    # the diagram is that of the design moved inwards by 1e-7 of the range
    return compare("area strain", np.float64(best.area_strain), best.diagram.ramp().area_strain, 1e-5)


def made_robust(scene, name, limits) -> float:
    """`maximise_area_strain` with the parameter uncertain against the worst of the diagrams in the box."""
    sought, share = _beside(scene, ""), 0.02
    over = {sought: limits_of(scene, sought)}
    best = None
    with none_may_survive(scene, sought, over[sought], 0.0):
        best = dj.maximise_area_strain(scene, over, uncertain={name: share}, check=False)
    if best is None:
        return 0.0
    chosen = scene.replace(**best.parameters)
    values = [float(value_of(chosen, name)) * f for f in (1 - share, 1.0, 1 + share)]
    strains = [diagram_of(chosen.replace(**{name: v})).ramp().area_strain for v in values]
    return compare("worst area strain", np.float64(best.area_strain), min(strains), 1e-6)


def followed(scene, name, limits) -> float:
    """`fold_curves` against the folds of diagrams at both ends."""
    found = dj.fold_curves(scene, name, limits, kinds=("fold",), samples=2)
    compare("doubts", found.doubts, ())
    apart = 0.0
    for value, own in zip(limits, at(scene, name, limits), strict=True):
        if isinstance(own.loading, dj.ConstantVoltage):
            column = "pressure"
            known = float(dj.critical.pressure_peak(own.membrane, float(own.loading.voltage)).pressure)  # without units
        else:
            column, known = "voltage", snap_of(own)
        ends = [getattr(c, column)[np.abs(c.parameter / value - 1) < 1e-12] for c in found.curves]
        near = min(np.concatenate([*ends, [math.inf]]), key=lambda v: abs(v - known))
        if math.isfinite(known):
            apart = max(apart, compare(f"fold at {value!r}", np.float64(near), known, 1e-7))
    return apart


VERBS: dict[str, typing.Callable] = {
    "replace": replaced,
    "document": documented,
    "file": written,
    "option": typed,
    "classify_designs": classified,
    "sweep, surface": functools.partial(swept, "surface"),
    "sweep, continuation": functools.partial(swept, "continuation"),
    "grad": differentiated,
    "regime_edges": edges_found,
    "regime_map": mapped,
    "maximise": maximised,
    "uncertain": made_robust,
    "fold_curves": followed,
}
CHEAP = ("replace", "document", "file", "option")
COMPUTED = tuple(v for v in VERBS if v not in CHEAP)


def _not_chamber_or_pressure(scene: dj.Scene, name: str) -> bool:
    return not isinstance(scene.loading, (dj.Chamber, dj.ConstantPressure))


def _without_words(scene: dj.Scene, name: str) -> bool:
    """Whether documents or options have no words for a scene."""
    said = described(scene)
    custom = said["material"] not in MATERIAL_CONSTANTS or said["breakdown"] == "CustomBreakdown"
    return custom or _not_chamber_or_pressure(scene, name)


#: why a verb may refuse: which verbs, when, and what the sentence says; verbs that compute do refuse then
REASONS: list[tuple[tuple[str, ...], typing.Callable[[dj.Scene, str], bool], str]] = [
    (tuple(VERBS), lambda s, n: not s.has(n), "must be (a parameter of this scene, but|one of .*, but is not a)"),
    (
        ("file",),
        lambda s, n: not s.has(n),
        r"`pressure` (or `chamber_volume` )?must be given|`\w+`( in \[scene\])? must (be left out|be one of|have a \[units\])",
    ),
    (
        tuple(v for v in COMPUTED if v != "fold_curves"),
        _not_chamber_or_pressure,
        r"`loading` must be a Chamber or a ConstantPressure here, but is a \w+\.$",
    ),
    (
        ("fold_curves",),
        lambda s, n: _not_chamber_or_pressure(s, n) and not isinstance(s.loading, dj.ConstantVoltage),
        r"`loading` must be a Chamber, a ConstantPressure or a ConstantVoltage here, but is a \w+\.$",
    ),
    (("document", "file", "option"), _without_words, r"^(`\w+` in \[scene\]|--\w+|One of --pressure.*) must be "),
    (("option",), lambda s, n: n == "breakdown_field_scale", "is not known here; `dielectric-jax --help` lists"),
    (
        ("file", *(v for v in COMPUTED if v != "grad")),
        lambda s, n: parameter_of(n).many and "branches" not in parameter_of(n).path,
        "must not vary.*, because its value is a list",
    ),
    (
        ("file", *(v for v in COMPUTED if v != "grad")),
        lambda s, n: "branches" in parameter_of(n).path,
        "must not vary here, because the membrane at rest does not depend on it; `dj.follow`, `dj.bounds` and sweeps with|"
        "`dimension` must be a name of letters and digits",
    ),
    (
        ("maximise",),
        lambda s, n: change_of(n) is Change.MATERIAL,
        "must be held, because every value of it needs its own surface",
    ),
    (
        ("uncertain",),
        lambda s, n: s.has(n) and value_of(s, n) is None,
        "must be a parameter of this scene, but it has none of that name",
    ),
]


def reasons(scene: dj.Scene, name: str, verb: str) -> list[str]:
    """What the sentences may say in which a verb refuses a parameter of a scene."""
    return [said for verbs, applies, said in REASONS if verb in verbs and applies(scene, name)]


def ask(scene: dj.Scene, name: str, verb: str) -> dict:
    """One row: whether a verb agrees with the independent answer, refuses for a reason that is known, or is wrong."""
    row: dict[str, typing.Any] = {"parameter": name, "verb": verb, "answer": "agrees", "said": ""}
    watch = Stopwatch()
    try:
        with watch:
            row["difference"] = VERBS[verb](scene, name, limits_of(scene, name))
        if verb in COMPUTED and (why := reasons(scene, name, verb)):
            row |= {"answer": "wrong", "said": f"It must be refused ({why[0]}), but is not."}
    except (ValueError, BadInput) as error:
        said = str(error)
        known = any(re.search(reason, said) for reason in reasons(scene, name, verb))
        row |= {"answer": "refused" if known and "\n" not in said else "wrong", "said": said}
    except Exception as error:  # listed with its scene, so that one row does not end the run
        row |= {"answer": "wrong", "said": f"{type(error).__name__}: {error}"}
    return row | {"seconds": watch.cpu_seconds}


def names_of(scene: dj.Scene) -> list[str]:
    """Every published parameter, those that the scene does not have too, and the constants of a user's material."""
    said = numbers_of(scene)
    numbers = [n for n, v in said.items() if isinstance(v, float) and scene.has(n)]
    return list(dict.fromkeys((*PARAMETERS, *numbers)))


QUICK = {"scenes": ["gent"], "parameters": ["breakdown_field_scale", "c1"], "verbs": [*CHEAP, "classify_designs"]}


def main() -> int:
    parser = arguments(__doc__, "one scene, two parameters, few verbs")
    every = scenes()
    parser.add_argument("--scenes", nargs="+", metavar="NAME", choices=every, default=list(every))
    parser.add_argument("--parameters", nargs="+", metavar="NAME")
    parser.add_argument("--verbs", nargs="+", metavar="NAME", choices=VERBS, default=list(VERBS))
    options = parser.parse_args()
    if options.quick:
        vars(options).update(QUICK)
    rows: list[dict] = []
    record = {"name": "parameters", "machine": machine(), "quick": options.quick, "counts": {}, "records": rows}
    for label in options.scenes:
        scene = every[label]
        for name, verb in itertools.product(options.parameters or names_of(scene), options.verbs):
            row = {"scene": label} | ask(scene, name, verb)
            rows.append(row)
            record["counts"] = {w: sum(r["answer"] == w for r in rows) for w in ("agrees", "refused", "wrong")}
            if row["answer"] == "wrong" or verb in COMPUTED:
                say(f"{label:24} {name:22} {verb:20} {row['answer']:8} {row['seconds']:6.1f}  {row.get('difference', row['said'])}")  # fmt: skip
            write(record, options.json, partial=True)
        jax.clear_caches()  # hundreds of programs would reach the system's limit of memory maps
    say(record["counts"])
    return finish(record, options.json, not record["counts"]["wrong"])


if __name__ == "__main__":
    sys.exit(main())
