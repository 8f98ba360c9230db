"""What does each addition to a scene cost? Warm times as ratios to the plainest scene of their table, error beside them.

- Integration: 128 random states under voltage in one batch, 32 steps. What is added is what a program of the package adds:
  derivatives, their trail for the index, height and charge, the fields along the membrane, their extremes for breakdown.
- Equilibrium: one call of `equilibrium`, and what comes on top of it.
- Diagram: one call of `pressure_volume` or `voltage_volume` with the same count of points a branch.

A state's error is against the extended-precision integration of `truth.py`, a diagram's that of its folds, under charge
control that of its breakdown.

    python -m benchmarks.speed.cost_of_a_scene [--json FILE|-] [--quick]
"""

import argparse
import functools
import sys
import time

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.harness import machine, write
from benchmarks.speed import curves
from benchmarks.speed.first_diagram import BREAKDOWN, FOLD, calibrate
from benchmarks.speed.shots import MATERIAL, States, seconds_of
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
    out = []
    for name, program in programs.items():
        found = program(lanes, STEPS)
        error = None if name == "no voltage" else states.shot_error(np.asarray(found[0]), np.asarray(found[1]))
        best, first = seconds_of(lambda p=program: jax.block_until_ready(p(lanes, STEPS)), 1 if quick else 100)
        out.append(record("integration", name, best / states.count, error, compile_seconds=first))
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
    return [timed("equilibrium", name, calls[name], state_error, 1 if quick else 7) for name in some]


def timed(table: str, name: str, run, error, rounds: int) -> dict:
    """The record of a call, warm, with the error of what it returns."""
    begin = time.perf_counter()
    found = run()
    first = time.perf_counter() - begin
    best = float("inf")
    for _ in range(rounds):
        begin = time.perf_counter()
        found = run()
        best = min(best, time.perf_counter() - begin)
    return record(table, name, best, error(found), compile_seconds=max(0.0, first - best))


def pressure_error(true):
    def error(diagram):
        folds = sorted((p for p in diagram.special_points if p.kind == "fold"), key=lambda p: p.volume)
        return max(abs(p.pressure - t) for p, t in zip(folds, true, strict=True))

    return error


def snap_error(true):
    return lambda diagram: abs(diagram.ramp()["snap"][0].state.voltage - true)


def breakdown_error(diagram):
    return min(abs(p.voltage - BREAKDOWN) for p in diagram.special_points if p.kind == "breakdown")


def glance_error(seen):
    return abs(next(e.state.voltage for e in seen.events if e.event == "snap") - FOLD)


def diagrams(quick: bool) -> list[dict]:
    chamber = dj.Scene(MEMBRANE, dj.Chamber(volume=1600.0, initial_volume=INITIAL_VOLUME))
    charged = dj.Scene(MEMBRANE, dj.ChargeControl(chamber.loading))
    held = dj.Scene(MEMBRANE, dj.ConstantPressure(SNAP_AT_PRESSURE[0]))
    surface = None if quick else dj.Surface.build(MEMBRANE)

    def with_profiles():
        found = dj.voltage_volume(chamber)
        for point in found.special_points:
            dj.profile(MEMBRANE, point)
        return found

    at_voltage = pressure_error(curves.reference())
    at_pressure, at_chamber = snap_error(SNAP_AT_PRESSURE[1]), snap_error(FOLD)
    calls = {
        "no voltage: p–V": (lambda: dj.pressure_volume(MEMBRANE), pressure_error(PRESSURE_FOLDS)),
        "voltage: p–V": (lambda: dj.pressure_volume(MEMBRANE, curves.VOLTAGE), at_voltage),
        "pressure given: Φ–V": (lambda: dj.voltage_volume(held), at_pressure),
        "chamber: Φ–V": (lambda: dj.voltage_volume(chamber), at_chamber),
        "chamber, charge controlled": (lambda: dj.voltage_volume(charged), breakdown_error),
        "chamber, tolerance 1e-6": (lambda: dj.voltage_volume(chamber, tolerance=1e-6), at_chamber),
        "chamber, tolerance 1e-12": (lambda: dj.voltage_volume(chamber, tolerance=1e-12), at_chamber),
        "chamber, profiles at special points": (with_profiles, at_chamber),
        "chamber, way down as well": (lambda: _with_way_down(dj.voltage_volume(chamber)), at_chamber),
        "chamber on a surface, certified": (lambda: dj.voltage_volume(chamber, surface=surface), at_chamber),
        "chamber at a glance": (lambda: dj.glance(chamber, surface), glance_error),
        "chamber on a surface alone": (
            lambda: dj.voltage_volume(chamber, surface=surface, certify=False, extend=False),
            at_chamber,
        ),
    }
    some = ["no voltage: p–V", "chamber: Φ–V"] if quick else list(calls)
    return [timed("diagram", name, *calls[name], 1 if quick else 5) for name in some]


def _with_way_down(diagram):
    diagram.ramp("down")
    return diagram


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="8 states, two scenes a table")
    options = parser.parse_args()
    if options.quick:
        dj.enable_compilation_cache()
    document = {"name": "cost_of_a_scene", "records": [], "machine": machine()}
    out = sys.stderr
    for table in (integration, equilibria, diagrams):
        records = table(options.quick)
        base = records[0]["seconds"]
        unit, factor = ("µs a state", 1e6) if table is integration else ("ms", 1e3)
        print(f"\n{table.__name__:44}{unit:>12}{'ratio':>9}{'error':>10}", file=out)
        for r in records:
            r["ratio"] = r["seconds"] / base
            error = f"{r['error']:.1e}" if r["error"] is not None else "–"
            print(f"{r['scene']:44}{r['seconds'] * factor:12.4g}{r['ratio']:9.2f}{error:>10}", file=out, flush=True)
        document["records"] += records
        write(document, options.json, partial=True)
    document["calibration_seconds"] = calibrate()
    write(document, options.json)
    good = all(r["error"] is None or r["error"] < 1e-9 for r in document["records"])
    print("\nPASSED" if good else "\nFAILED", file=out)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
