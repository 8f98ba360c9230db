"""A million chambers on one machine: all special points and both ramps, at sixteen prestretches; and what they cost.

Random V_C (10 to 25000, log-uniform) and V_0 (up to the volume at the peak of the pressure). The family of surfaces is built
once, each prestretch has its surface from it. Times are warm, beside their errors: of curves against shots at random points,
of events by their own bound and by `voltage_volume` at some chambers (benchmarks/acceptance/ensemble.py compares many).

    python -m benchmarks.speed.sweep [--chambers 1000000] [--seed 0] [--json FILE|-] [--quick]
"""

import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.acceptance.ensemble import ALLOWED, difference
from benchmarks.random_scenes import filled_chambers
from dielectric_jax.model import Outcome

jax.config.update("jax_enable_x64", True)

LIMIT_SECONDS, LIMIT_GIGABYTES = 180.0, 2.0


def curve_error(membrane, curves, random, count: int) -> float:
    """The largest relative error of p and V of some points of curves, against shots."""
    lanes, rows = np.nonzero(np.isfinite(curves.volume) & (curves.apex_stretch - float(membrane.prestretch) > 0.01))
    some = random.choice(len(lanes), min(count, len(lanes)), replace=False)
    worst = 0.0
    for lane, row in zip(lanes[some], rows[some], strict=True):
        q = curves.voltage_squared[lane, row]
        if q < 0:
            continue
        state = dj.equilibrium(membrane, voltage=float(np.sqrt(q)), apex_stretch=float(curves.apex_stretch[row]))
        for name in ("pressure", "volume"):
            exact = getattr(state, name)
            worst = max(worst, abs(getattr(curves, name)[lane, row] - exact) / max(abs(exact), 1e-3))
    return worst


class Prestretch:
    """All chambers at one prestretch: surface, ramps and some curves, the first two counted in the cost of the sweep."""

    def __init__(self, family, prestretch: float, count: int, random, quick: bool):
        made, ramped, drawn = (harness.Stopwatch() for _ in range(3))
        surface = made.time(family.surface, prestretch)
        chambers, fillings = filled_chambers(random, surface.membrane, count)
        some = chambers[:256], fillings[:256]
        dj.diagram.chamber_ramps(surface, *some)  # compiles once for all prestretches
        dj.diagram.chamber_curves(surface, *some)
        self.ramps = ramped.time(dj.diagram.chamber_ramps, surface, chambers, fillings)
        few = slice(0, 8192)  # the curves of all would not be kept
        curves = drawn.time(dj.diagram.chamber_curves, surface, chambers[few], fillings[few])
        self.seconds = made.seconds + ramped.seconds
        decided = np.flatnonzero(self.ramps.outcome != Outcome.unresolved)[: 1 if quick else 2]
        apart, missing = [0.0], []
        for i in decided:
            scene = dj.Scene(surface.membrane, dj.Chamber(volume=chambers[i], initial_volume=fillings[i]))
            largest, lacking = difference(self.ramps, i, dj.voltage_volume(scene))
            apart.append(largest)
            missing += lacking
        self.record = {
            "prestretch": float(prestretch),
            "surface_seconds": made.seconds,
            "microseconds_per_ramp": ramped.seconds / len(chambers) * 1e6,
            "microseconds_per_curve": drawn.seconds / len(curves.volume) * 1e6,
            "curve_error": curve_error(surface.membrane, curves, random, 4 if quick else 20),
            "difference": max(apart),
            "missing": missing,
        }


def main() -> int:
    parser = harness.arguments(__doc__, "512 chambers at two prestretches, a small family", seed=True)
    parser.add_argument("--chambers", type=int, default=1_000_000)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    count = 2 if options.quick else 16
    total = 512 if options.quick else options.chambers
    span, tolerance = ((1.5, 1.6), 1e-8) if options.quick else ((1.0, 3.0), 1e-9)
    build, groups, seconds = harness.Stopwatch(), [], 0.0
    family = build.time(
        dj.surface.SurfaceFamily.build, dj.Gent(270.0), prestretch=span, tolerance=tolerance, cache=False
    )
    outcomes, largest_bound = np.zeros(len(Outcome), int), 0.0
    for prestretch in np.linspace(*span, count):
        one = Prestretch(family, prestretch, total // count, random, options.quick)
        seconds += one.seconds
        outcomes += np.bincount(one.ramps.outcome, minlength=len(Outcome))
        largest_bound = max(largest_bound, float(np.nanmax(one.ramps.error)))
        groups.append(one.record)
        harness.say(one.record)
    document = {
        "name": "sweep",
        "parameters": {"chambers": total, "prestretches": count, "seed": options.seed},
        "family_seconds": build.seconds,
        "seconds": seconds,
        "limit_seconds": LIMIT_SECONDS,
        "gigabytes": harness.most_gigabytes(),
        "limit_gigabytes": LIMIT_GIGABYTES,
        "outcomes": {outcome.name: int(outcomes[outcome]) for outcome in Outcome},
        "largest_error_bound": largest_bound,
        "largest_curve_error": max(g["curve_error"] for g in groups),
        "calibration_seconds": harness.calibrate(),
        "groups": groups,
        "machine": harness.machine(),
    }
    harness.say({k: v for k, v in document.items() if k not in ("groups", "machine")})
    wrong = [g for g in groups if g["missing"] or max(g["difference"], g["curve_error"]) > ALLOWED]
    return harness.finish(document, options.json, not wrong)


if __name__ == "__main__":
    sys.exit(main())
