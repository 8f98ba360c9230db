"""What does a ramp in time cost, and how wrong is it?

Ramps of the voltage at constant pressure (M1 of tests/data/rates.json, rates over three decades) to their jump and landing, one by
one and side by side; the voltage of the jump alone, and with its derivative by the rate. The error is the largest relative
difference of the jumps' voltages from those at a tolerance of 1e-10; that of the derivative is r dΦ/dr − τ dΦ/dτ, which is zero.

    python -m benchmarks.speed.rates [--json FILE|-] [--quick]
"""

import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from dielectric_jax import rates
from dielectric_jax.model import Maxwell, Viscoelastic

jax.config.update("jax_enable_x64", True)

RAMPS, TOLERANCE, PRESSURE = 256, 1e-6, 1.82


def scene(time=1.0) -> dj.Scene:
    film = Viscoelastic(dj.Gent(270.0), [Maxwell(dj.Gent(270.0), 1.0, time)])
    return dj.Scene(dj.Membrane(film), dj.ConstantPressure(PRESSURE))


def main() -> int:
    options = harness.arguments(__doc__, "4 ramps, no derivative").parse_args()
    speeds, rounds = np.geomspace(1e-3, 1.0, 4 if options.quick else RAMPS), 1 if options.quick else 3
    given, ramps, one = [scene()] * len(speeds), [rates.Ramp(rate=r) for r in speeds], float(speeds[len(speeds) // 2])
    runs = {
        "one ramp": lambda: rates.follow(given[0], voltage=rates.Ramp(rate=one), tolerance=TOLERANCE),
        "ramps side by side": lambda: rates.follow(given, voltage=ramps, tolerance=TOLERANCE),
        "voltage of a jump": lambda: rates.snap_voltage(given[0], one, tolerance=TOLERANCE),
    }
    if not options.quick:
        slopes = jax.value_and_grad(lambda r, time: rates.snap_voltage(scene(time), r, tolerance=TOLERANCE), (0, 1))
        runs["and its derivatives"] = lambda: slopes(one, 1.0)
    timings = harness.timed_in_turn(runs, rounds)
    records = []
    exact = {r: float(rates.snap_voltage(given[0], r, tolerance=1e-10)) for r in {*speeds[::8].tolist(), one}}
    for name, timing in timings.items():
        many = len(speeds) if name == "ramps side by side" else 1
        record = {"name": name, "count": many, "seconds": timing.best, "first_seconds": timing.first}
        if name == "and its derivatives":
            by_rate, by_time = (float(s) for s in timing.value[1])
            record["error"] = abs(one * by_rate - by_time) / abs(by_time)
        else:
            found = {one: timing.value}
            if name == "ramps side by side":
                found = {r: run for r, run in zip(speeds.tolist(), timing.value, strict=True) if r in exact}
            values = {r: v.snap.at.voltage if isinstance(v, rates.Run) else float(v) for r, v in found.items()}
            record["error"] = max(abs(v / exact[r] - 1) for r, v in values.items())
        records.append(record)
        harness.say(record)
    good = all(r["error"] <= 10 * TOLERANCE for r in records)
    return harness.finish({"name": "rates", "records": records, "machine": harness.machine()}, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
