"""Are the derivatives of critical points exact? Every kind of point by every parameter, against differences of its values.

    python -m benchmarks.acceptance.gradient_audit [--quick] [--json FILE|-] [--only KIND ...]

The reference is Richardson's extrapolation of two fourth-order central differences; what the two differ by tells its own
uncertainty. A row also holds what a gradient costs, in units of the value, both warm and at fresh numbers.
"""

import itertools
import sys

import jax

import dielectric_jax as dj
from benchmarks import harness

jax.config.update("jax_enable_x64", True)

CHAMBER = {
    "chamber_volume": 800.0,
    "initial_volume": 2.42,
    "atmospheric_pressure": 50.0,
    "polytropic_exponent": 1.0,
    "prestretch": 1.02,
    "stretch_limit": 270.0,
    "breakdown_field_scale": 1.0,
}
FULLER = CHAMBER | {"initial_volume": 2.7}  # where the two cusps are far apart
HELD = {"pressure": 1.82, "prestretch": 1.02, "stretch_limit": 270.0, "breakdown_field_scale": 1.0}
FILM = {"prestretch": 1.02, "stretch_limit": 270.0, "voltage": 0.05}
LINKS = {"chain_links": 90.0, "chamber_volume": 800.0}
_GAS = ("chamber_volume", "initial_volume", "atmospheric_pressure", "polytropic_exponent")


def scene_of(**values) -> dj.Scene:
    """A scene of the given parameters."""
    links = "chain_links" in values
    scene = dj.Scene(dj.Membrane(dj.ArrudaBoyce(90.0) if links else dj.Gent()), dj.Chamber(800.0, 2.42))
    if "pressure" in values:
        scene = dj.Scene(scene.membrane, dj.ConstantPressure(1.82))
    return scene.replace(**values)


def film_of(**values) -> dj.Membrane:
    """A membrane of the given parameters."""
    return dj.Membrane(dj.Gent(values["stretch_limit"]), values["prestretch"])


def filled(**values) -> dj.Scene:
    """The scene of a chamber given its pressure in place of its volume."""
    return scene_of(**{n: v for n, v in values.items() if n != "initial_volume"})


KINDS = {
    "snap voltage": (CHAMBER, lambda **v: dj.snap_voltage(scene_of(**v))),
    "snap volume": (CHAMBER, lambda **v: dj.snap_point(scene_of(**v)).volume),
    "snap voltage, p_0 given": (
        CHAMBER | {"initial_pressure": 1.85},
        lambda **v: dj.snap_voltage(filled(**v)),
    ),
    "snap voltage, eight-chain": (LINKS, lambda **v: dj.snap_voltage(scene_of(**v))),
    "snap voltage, held pressure": (HELD, lambda **v: dj.snap_voltage(scene_of(**v))),
    "snap-back voltage": (CHAMBER, lambda **v: dj.critical.snap_back_voltage(scene_of(**v))),
    "snap-back volume": (CHAMBER, lambda **v: dj.critical.snap_back_point(scene_of(**v)).volume),
    "landing volume": (CHAMBER, lambda **v: dj.critical.landing_point(scene_of(**v)).volume),
    "landing breakdown ratio": (CHAMBER, lambda **v: dj.critical.landing_point(scene_of(**v)).breakdown_ratio),
    "breakdown voltage": (CHAMBER, lambda **v: dj.critical.breakdown_voltage(scene_of(**v))),
    "breakdown stretch": (CHAMBER, lambda **v: dj.critical.breakdown_point(scene_of(**v)).apex_stretch),
    "area strain": (CHAMBER, lambda **v: dj.area_strain(scene_of(**v))),
    "area strain, held pressure": (HELD, lambda **v: dj.area_strain(scene_of(**v))),
    "zero-voltage volume": (
        CHAMBER | {"chamber_volume": 2500.0},  # bistable at this prestretch from some 1675 on
        lambda **v: dj.critical.zero_voltage_point(scene_of(**v), -1).volume,
    ),
    "peak pressure": (FILM, lambda voltage, **v: dj.critical.pressure_peak(film_of(**v), voltage).pressure),
    "peak volume": (FILM, lambda voltage, **v: dj.critical.pressure_peak(film_of(**v), voltage).volume),
    "valley pressure": (FILM, lambda voltage, **v: dj.critical.pressure_valley(film_of(**v), voltage).pressure),
    "valley volume": (FILM, lambda voltage, **v: dj.critical.pressure_valley(film_of(**v), voltage).volume),
    "onset of bistability": (CHAMBER, lambda **v: dj.critical.bistability_onset(scene_of(**v))),
    "cusp's chamber": (FULLER, lambda **v: dj.critical.cusp(scene_of(**v)).parameter),
    "cusp's load": (FULLER, lambda **v: dj.critical.cusp(scene_of(**v)).voltage_squared),
    "cusp's prestretch": (
        FILM,
        lambda voltage, **v: dj.critical.pressure_cusp(film_of(**v), voltage, within=(1.8, 2.6)).parameter,
    ),
}
# a point that is one of a parameter does not depend on it, and q of breakdown alone on the breakdown law
_NONE = {
    "onset of bistability": ("chamber_volume", "breakdown_field_scale"),
    "cusp's chamber": ("chamber_volume", "breakdown_field_scale"),
    "cusp's load": ("chamber_volume", "breakdown_field_scale"),
    "cusp's prestretch": ("prestretch",),
    "snap voltage, p_0 given": ("initial_volume",),
}
_LAW = ("breakdown", "area", "ratio")
QUICK = {
    "snap voltage": ("chamber_volume",),
    "area strain": ("breakdown_field_scale",),
}


def pairs(kind: str, values: dict):
    """The parameters that a kind of point depends on."""
    for name in values:
        law = name == "breakdown_field_scale"
        if name not in _NONE.get(kind, ()) and (not law or any(word in kind for word in _LAW)):
            yield name


def differences(function, x: float, step: float) -> tuple[float, float]:
    """The slope by Richardson's extrapolation, and its uncertainty."""
    values = {k: float(function(x + k * step)) for k in (-4, -2, -1, 1, 2, 4)}
    near = (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12 * step)
    far = (8 * (values[2] - values[-2]) - (values[4] - values[-4])) / (24 * step)
    return near + (near - far) / 15, abs(near - far) / 15


def seconds(functions: dict, x: float) -> dict:
    """The least seconds of each function over five calls in turn, each call at a number of its own."""

    def at_new_numbers(function):
        numbers = itertools.count(1)
        return lambda: function(x * (1 + 1e-5 * next(numbers)))

    runs = {name: at_new_numbers(function) for name, function in functions.items()}
    return {name: timing.best for name, timing in harness.timed_in_turn(runs, 5, warm_up=False).items()}


def audit(kind: str, name: str, timed: bool) -> dict:
    """One row: the derivative of a kind of point by a parameter."""
    values, function = KINDS[kind]
    x = values[name]

    def of(value):
        return function(**(values | {name: value}))

    slope = float(jax.grad(of)(x))
    reference, doubt = differences(of, x, (2e-4 if name in ("prestretch", "initial_volume") else 1e-3) * x)
    row = {"kind": kind, "parameter": name, "value": float(of(x)), "derivative": slope, "differences": reference}
    size = max(abs(reference), 1e-9 * abs(row["value"] / x))  # some points do not depend on some parameters
    row["relative_difference"] = abs(slope - reference) / size
    row["relative_doubt"] = doubt / size
    if timed:
        row |= seconds({"seconds_of_value": of, "seconds_of_value_and_gradient": jax.value_and_grad(of)}, x)
        row["cost"] = row["seconds_of_value_and_gradient"] / row["seconds_of_value"]
    return row


def main() -> int:
    parser = harness.arguments(__doc__, "two rows, without their cost")
    parser.add_argument("--only", nargs="*", metavar="KIND")
    options = parser.parse_args()
    records = []
    document = {"name": "gradient_audit", "machine": harness.machine(), "quick": options.quick, "records": records}
    for kind, (values, _) in KINDS.items():
        if (options.only and kind not in options.only) or (options.quick and kind not in QUICK):
            continue
        jax.clear_caches()  # hundreds of programs would reach the limit of memory maps
        for name in QUICK[kind] if options.quick else pairs(kind, values):
            row = audit(kind, name, timed=not options.quick)
            records.append(row)
            cost = f", gradient {row['cost']:.1f} values" if "cost" in row else ""
            say = f"{kind:28} {name:22} {row['derivative']:+.9e}  differs {row['relative_difference']:.1e}"
            harness.say(f"{say} (doubt {row['relative_doubt']:.0e}){cost}")
            harness.write(document, options.json, partial=True)
    bad = [r for r in records if not r["relative_difference"] < 1e-6 + 3 * r["relative_doubt"]]
    return harness.finish(document, options.json, not bad)


if __name__ == "__main__":
    sys.exit(main())
