"""What does each addition to a scene cost? Warm times as ratios to the plainest scene of their table, error beside them.

- Integration: 128 random states under voltage in one batch, 32 steps. What is added is what a program of the package adds:
  derivatives, their trail for the index, height and charge, the fields along the membrane, their extremes for breakdown.
- Equilibrium: one call of `equilibrium`, and what comes on top of it.
- Diagram: one call of `pressure_volume` or `voltage_volume` with the same count of points a branch.

A state's error is against the extended-precision integration of `truth.py`, a diagram's that of its folds, under charge
control that of its breakdown.

    python -m benchmarks.speed.cost_of_a_scene [--json FILE|-] [--quick]
"""

import functools
import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.speed import curves, one_chamber
from benchmarks.speed.shots import MATERIAL, SHORTEST, States
from benchmarks.truth import extended_precision as truth
from benchmarks.truth.chambers import INITIAL_VOLUME, STRETCH_LIMIT
from dielectric_jax.model.programs import jacobian_program, value_program
from dielectric_jax.model.shooting import UNKNOWNS, integrate_membrane

jax.config.update("jax_enable_x64", True)

MEMBRANE = dj.Membrane(MATERIAL)
STEPS = 32.0
COMPILED = {"compiler_options": {"xla_cpu_prefer_vector_width": 512}}  # as the package compiles its programs
SNAP_AT_PRESSURE = 1.82, 0.114568360882  # and its snap voltage, from a spectral-element discretisation of the energy
PRESSURE_FOLDS = 1.908684829414, 1.361703319141  # at zero voltage


def record(table: str, name: str, seconds: float, error: float | None, **more) -> dict:
    return {"name": f"cost_of_a_scene: {table}", "scene": name, "seconds": seconds, "error": error, **more}


def integration(quick: bool) -> list[dict]:
    states = States(8 if quick else 128)
    lanes = np.stack([states.apex, states.p, states.q])

    def shot(**options):
        @functools.partial(jax.jit, **COMPILED)
        def run(lanes, steps):
            found = integrate_membrane(MATERIAL, *lanes, steps, **options)
            return (
                found.stretch_change,
                found.volume,
                found.height,
                found.charge,
                found.sensitivities,
                found.trail and found.trail[:2],
            )

        return run

    @functools.partial(jax.jit, **COMPILED)
    def estimated(lanes, steps):
        fine, coarse = (integrate_membrane(MATERIAL, *lanes, n) for n in (steps, steps / 2))
        return (
            fine.stretch_change,
            fine.volume,
            fine.stretch_change - coarse.stretch_change,
            fine.volume - coarse.volume,
        )

    @functools.partial(jax.jit, **COMPILED)
    def no_voltage(lanes, steps):
        found = integrate_membrane(MATERIAL, lanes[0], lanes[1], 0.0, steps)
        return found.stretch_change, found.volume

    programs = {
        "no voltage": no_voltage,
        "voltage": shot(),
        "+ error estimate (half the steps again)": estimated,
        "+ ∂/∂λa (pressure given)": shot(sensitivities=UNKNOWNS[:1]),
        "+ ∂/∂λa, ∂/∂p (volume given)": shot(sensitivities=UNKNOWNS[:2]),
        "+ ∂/∂λa, ∂/∂p, ∂/∂q (chamber)": shot(sensitivities=UNKNOWNS),
        "+ these and the index": lambda lanes, steps: jacobian_program(MATERIAL, lanes, steps),
        "+ height and charge": shot(outputs=True),
        "+ profile along the membrane": shot(outputs=True, trail="profile", heights=True),
        "+ breakdown and hoop tension": lambda lanes, steps: value_program(MEMBRANE, lanes, steps),
    }
    runs = {name: lambda p=program: p(lanes, STEPS) for name, program in programs.items()}
    timings = harness.timed_in_turn(runs, 1 if quick else 100, shortest=SHORTEST)
    out = []
    for name, timing in timings.items():
        of_rim, volume = (np.asarray(w) for w in timing.value[:2])
        error = None if name == "no voltage" else states.shot_error(of_rim, volume)
        row = record("integration", name, timing.best / states.count, error, compile_seconds=timing.compile_seconds)
        out.append(row)
    return out


def state_error(state) -> float:
    """The relative error of p and V at the state's (λa, q)."""
    p, v, _ = truth.exact(
        [state.apex_stretch], [state.pressure], [state.voltage_squared], STRETCH_LIMIT, 1.0, steps=280
    )
    return float(max(abs(state.pressure / p[0] - 1), abs(state.volume / v[0] - 1)))


def equilibria(quick: bool) -> list[dict]:
    def call(**options):
        return lambda: dj.equilibrium(MEMBRANE, **options)

    def with_profile():
        state = dj.equilibrium(MEMBRANE, voltage=0.05, pressure=1.5)
        dj.profile(MEMBRANE, state)
        return state

    calls = {
        "apex stretch given, no voltage": call(apex_stretch=2.0),
        "pressure given, no voltage": call(pressure=1.5),
        "pressure given, voltage": call(voltage=0.05, pressure=1.5),
        "volume given, voltage": call(voltage=0.05, volume=INITIAL_VOLUME),
        "pressure given, voltage, tolerance 1e-12": call(voltage=0.05, pressure=1.5, tolerance=1e-12),
        "pressure given, voltage, profile": with_profile,
        "pressure given, voltage, all states": lambda: call(voltage=0.05, pressure=1.5, all=True)()[0],
    }
    some = list(calls)[1:4:2] if quick else list(calls)
    return records_of("equilibrium", {name: (calls[name], state_error) for name in some}, 1 if quick else 7)


def records_of(table: str, calls: dict, rounds: int) -> list[dict]:
    """The records of calls, warm and turn by turn, each with the error of what it returns."""
    timings = harness.timed_in_turn({name: run for name, (run, _) in calls.items()}, rounds)
    return [
        record(table, name, timing.best, calls[name][1](timing.value), compile_seconds=timing.compile_seconds)
        for name, timing in timings.items()
    ]


def pressure_error(true):
    def error(diagram):
        folds = sorted((p for p in diagram.special_points if p.kind == "fold"), key=lambda p: p.volume)
        return max(abs(p.pressure - t) for p, t in zip(folds, true, strict=True))

    return error


def snap_error(true):
    def error(found):
        return abs(next(e.state.voltage for e in found.events if (e.event, e.direction) == ("snap", "up")) - true)

    return error


def breakdown_error(diagram):
    return min(abs(p.voltage - one_chamber.BREAKDOWN) for p in diagram.special_points if p.kind == "breakdown")


def diagrams(quick: bool) -> list[dict]:
    chamber = one_chamber.scene()
    charged = dj.Scene(MEMBRANE, dj.ChargeControl(chamber.loading))
    held = dj.Scene(MEMBRANE, dj.ConstantPressure(SNAP_AT_PRESSURE[0]))
    ours = one_chamber.engines(None if quick else dj.Surface.build(MEMBRANE))

    def with_profiles():
        found = dj.voltage_volume(chamber)
        for point in found.special_points:
            dj.profile(MEMBRANE, point)
        return found

    at_voltage = pressure_error(curves.reference())
    at_pressure, at_chamber = snap_error(SNAP_AT_PRESSURE[1]), snap_error(one_chamber.FOLD)
    calls = {
        "no voltage: p–V": (lambda: dj.pressure_volume(MEMBRANE), pressure_error(PRESSURE_FOLDS)),
        "voltage: p–V": (lambda: dj.pressure_volume(MEMBRANE, curves.VOLTAGE), at_voltage),
        "pressure given: Φ–V": (lambda: dj.voltage_volume(held), at_pressure),
        "chamber: Φ–V": (ours["continuation"], at_chamber),
        "chamber, charge controlled": (lambda: dj.voltage_volume(charged), breakdown_error),
        "chamber, tolerance 1e-6": (lambda: dj.voltage_volume(chamber, tolerance=1e-6), at_chamber),
        "chamber, tolerance 1e-12": (lambda: dj.voltage_volume(chamber, tolerance=1e-12), at_chamber),
        "chamber, profiles at special points": (with_profiles, at_chamber),
        "chamber, way down as well": (lambda: _with_way_down(dj.voltage_volume(chamber)), at_chamber),
        "chamber, modes 1 to 24": (lambda: dj.voltage_volume(chamber, modes=range(1, 25)), at_chamber),
        "chamber on a surface, certified": (ours["surface, certified"], at_chamber),
        "chamber at a glance": (ours["glance"], at_chamber),
        "chamber on a surface alone": (ours["surface alone"], at_chamber),
    }
    some = ["no voltage: p–V", "chamber: Φ–V"] if quick else list(calls)
    return records_of("diagram", {name: calls[name] for name in some}, 1 if quick else 5)


def _with_way_down(diagram):
    diagram.ramp("down")
    return diagram


def main() -> int:
    parser = harness.arguments(__doc__, "8 states, two scenes a table")
    options = parser.parse_args()
    if not options.quick:
        harness.without_cache()
    document = {"name": "cost_of_a_scene", "records": [], "machine": harness.machine()}
    for table in (integration, equilibria, diagrams):
        records = table(options.quick)
        base = records[0]["seconds"]
        unit, factor = ("µs a state", 1e6) if table is integration else ("ms", 1e3)
        harness.say(f"\n{table.__name__:44}{unit:>12}{'ratio':>9}{'error':>10}")
        for r in records:
            r["ratio"] = r["seconds"] / base
            error = f"{r['error']:.1e}" if r["error"] is not None else "–"
            harness.say(f"{r['scene']:44}{r['seconds'] * factor:12.4g}{r['ratio']:9.2f}{error:>10}")
        document["records"] += records
        harness.write(document, options.json, partial=True)
    document["calibration_seconds"] = harness.calibrate()
    good = all(r["error"] is None or r["error"] < 1e-9 for r in document["records"])
    return harness.finish(document, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
