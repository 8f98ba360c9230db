"""A million chambers on one machine: all special points and both ramps, at sixteen prestretches; and what they cost.

Random V_C (10 to 25000, log-uniform) and V_0 (up to the volume at the peak of the pressure). The family of surfaces is built
once, each prestretch has its surface from it. Times are warm, beside their errors: of curves against shots at random points,
of events by their own bound and by `voltage_volume` at some chambers (benchmarks/acceptance/ensemble.py compares many).

    python -m benchmarks.speed.sweep [--chambers 1000000] [--seed 0] [--json FILE|-] [--quick]
"""

import argparse
import resource
import sys
import time

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.acceptance.ensemble import ALLOWED, difference, largest_filling
from benchmarks.harness import machine, write
from benchmarks.speed.first_diagram import calibrate
from dielectric_jax.model import Outcome

jax.config.update("jax_enable_x64", True)
dj.enable_compilation_cache()

LIMIT_SECONDS, LIMIT_GIGABYTES = 180.0, 2.0


def gigabytes() -> float:
    """The most memory that this process has held so far."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1 << 30 if sys.platform == "darwin" else 1 << 20)


def timed(function, *args):
    """What a function returns, and its seconds."""
    begin = time.perf_counter()
    found = function(*args)
    return found, time.perf_counter() - begin


def random_chambers(membrane, count: int, random) -> tuple[np.ndarray, np.ndarray]:
    chambers = np.exp(random.uniform(np.log(10), np.log(25000), count))
    return chambers, random.uniform(0.01, 1, count) * largest_filling(membrane)


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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chambers", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="512 chambers at two prestretches, a small family")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    count = 2 if options.quick else 16
    total = 512 if options.quick else options.chambers
    span, tolerance = ((1.5, 1.6), 1e-8) if options.quick else ((1.0, 3.0), 1e-9)
    material = dj.Gent(270.0)
    build = timed(lambda: dj.surface.SurfaceFamily.build(material, prestretch=span, tolerance=tolerance, cache=False))
    family, groups, seconds = build[0], [], 0.0
    outcomes, largest_bound = np.zeros(len(Outcome), int), 0.0
    for prestretch in np.linspace(*span, count):
        surface, made = timed(family.surface, prestretch)
        chambers, fillings = random_chambers(surface.membrane, total // count, random)
        some = chambers[:256], fillings[:256]
        dj.diagram.chamber_ramps(surface, *some)  # compiles once for all prestretches
        dj.diagram.chamber_curves(surface, *some)
        ramps, spent = timed(dj.diagram.chamber_ramps, surface, chambers, fillings)
        few = slice(0, 8192)  # the curves of all would not be kept
        curves, drawn = timed(dj.diagram.chamber_curves, surface, chambers[few], fillings[few])
        seconds += made + spent
        outcomes += np.bincount(ramps.outcome, minlength=len(Outcome))
        largest_bound = max(largest_bound, float(np.nanmax(ramps.error)))
        decided = np.flatnonzero(ramps.outcome != Outcome.unresolved)[: 1 if options.quick else 2]
        apart, missing = [0.0], []
        for i in decided:
            scene = dj.Scene(surface.membrane, dj.Chamber(volume=chambers[i], initial_volume=fillings[i]))
            told = difference(ramps, i, dj.voltage_volume(scene))
            apart.append(told[0])
            missing += told[1]
        groups.append(
            {
                "prestretch": float(prestretch),
                "surface_seconds": made,
                "microseconds_per_ramp": spent / len(chambers) * 1e6,
                "microseconds_per_curve": drawn / len(curves.volume) * 1e6,
                "curve_error": curve_error(surface.membrane, curves, random, 4 if options.quick else 20),
                "difference": max(apart),
                "missing": missing,
            }
        )
        print(groups[-1], file=sys.stderr, flush=True)
    document = {
        "name": "sweep",
        "parameters": {"chambers": total, "prestretches": count, "seed": options.seed},
        "family_seconds": build[1],
        "seconds": seconds,
        "limit_seconds": LIMIT_SECONDS,
        "gigabytes": gigabytes(),
        "limit_gigabytes": LIMIT_GIGABYTES,
        "outcomes": {outcome.name: int(outcomes[outcome]) for outcome in Outcome},
        "largest_error_bound": largest_bound,
        "largest_curve_error": max(g["curve_error"] for g in groups),
        "calibration_seconds": calibrate(),
        "groups": groups,
        "machine": machine(),
    }
    write(document, options.json)
    print({k: v for k, v in document.items() if k not in ("groups", "machine")}, file=sys.stderr)
    wrong = [g for g in groups if g["missing"] or max(g["difference"], g["curve_error"]) > ALLOWED]
    print("FAILED" if wrong else "PASSED", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
