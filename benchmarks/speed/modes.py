"""What does a spectrum of modes cost, and what do modes add to a diagram?

The states of the default film along its pressure–volume curve at Φ = 0.05, up to the loss of hoop tension: the lowest eigenvalue of the
numbers 0 to 12 of all of them, to a tolerance, beside a shot of each of them to the rim (`integrate_membrane`, 48 steps), turn
by turn in one process. The error is the largest |difference|/max(|Λ|, 1) from the largest basis. And the diagram of a
chamber of 1600 without modes and with 24 numbers.

    python -m benchmarks.speed.modes [--json FILE|-] [--quick]
"""

import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from dielectric_jax.model import integrate_membrane
from dielectric_jax.modes.resolution import SIZES
from dielectric_jax.modes.spectrum import Asked, level_of
from dielectric_jax.numerics import cached_jit

jax.config.update("jax_enable_x64", True)

VOLTAGE, STATES, NUMBERS, STEPS = 0.05, 256, range(13), 48.0
TOLERANCES = (1e-4, 1e-6, 1e-8)


def states_of(membrane: dj.Membrane, count: int) -> list:
    """Equilibria along the curve, evenly over its points."""
    (branch,) = dj.pressure_volume(membrane, VOLTAGE).branches
    columns = zip(branch.pressure, branch.volume, branch.apex_stretch, branch.error_estimate, strict=True)
    nan = float("nan")
    found = [dj.model.State(VOLTAGE**2, *row[:3], nan, nan, nan, None, row[3]) for row in columns]
    tense = [s for s, m in zip(found, dj.mode_spectrum(membrane, found, [0], 1), strict=True) if not m.wrinkled]
    return [tense[k] for k in np.linspace(0, len(tense) - 1, count).round().astype(int)]


def main() -> int:
    options = harness.arguments(__doc__, "16 states, one tolerance").parse_args()
    film, rounds = dj.Membrane(dj.Gent(270.0)), 1 if options.quick else 5
    states = states_of(film, 16 if options.quick else STATES)
    u = np.array([[s.apex_stretch, s.pressure, s.voltage_squared] for s in states])
    shot = cached_jit(lambda material, u: integrate_membrane(material, *u, STEPS).stretch_change)
    runs = {"shot": lambda: shot(film.material, u.T)}
    for tolerance in TOLERANCES[-1:] if options.quick else TOLERANCES:
        runs[f"{tolerance:g}"] = lambda t=tolerance: dj.mode_spectrum(film, states, NUMBERS, 1, tolerance=t)
    timings = harness.timed_in_turn(runs, rounds)
    asked = Asked(np.tile(NUMBERS, (len(u), 1)), 1, 1e-8)
    fine = level_of(film, (u, np.zeros((len(u), 4))), asked, len(SIZES) - 1).values[:, :, 0]
    records = []
    for name, timing in timings.items():
        record = {"name": name, "microseconds_per_state": 1e6 * timing.best / len(u), "states": len(u)}
        if name != "shot":
            values = np.array([s.eigenvalues[:, 0] for s in timing.value])
            record["error"] = float(np.max(np.abs(values - fine) / np.maximum(np.abs(fine), 1)))
            record["shots"] = timing.best / timings["shot"].best
        records.append(record)
        harness.say(record)
    if not options.quick:
        scene = dj.Scene(film, dj.Chamber(volume=1600.0, initial_volume=2.42))
        pair = {
            "diagram": lambda: dj.voltage_volume(scene),
            "with modes": lambda: dj.voltage_volume(scene, modes=range(1, 25)),
        }
        for name, timing in harness.timed_in_turn(pair, 2).items():
            records.append({"name": name, "seconds": timing.best, "first_seconds": timing.first})
            harness.say(records[-1])
    good = all(r.get("error", 0.0) <= 10 * float(r["name"]) for r in records if "error" in r)
    return harness.finish({"name": "modes", "records": records, "machine": harness.machine()}, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
