"""Ramps of many chambers on the surface against the continuation: do they agree, and what does each cost?

Random chambers at several prestretches; every chamber that the surface decides is compared with `voltage_volume` of the same
scene: the way the ramp ends, snap and breakdown voltages, the landing's volume, the area strain. Both are timed in the same
run, warm, the surface's time beside its error.

    python benchmarks/ensemble.py [--scenes 10000] [--seed 0] [--json FILE|-] [--quick]
"""

import argparse
import sys
import time

import jax
import numpy as np
from records import machine, write

import dielectric_jax as dj
from dielectric_jax import Outcome

jax.config.update("jax_enable_x64", True)

ALLOWED = 1e-8
REASONS = {
    Outcome.breakdown_on_branch: ("breakdown on the branch",),
    Outcome.breakdown_in_snap: ("breakdown in the snap",),
    Outcome.no_unbroken_landing: ("no landing", "breakdown in the snap"),
    Outcome.start_unstable: ("start_unstable",),
}


def largest_filling(membrane) -> float:
    """The volume at the peak of the pressure at zero voltage, or a tenth of the largest where there is none."""
    curve = dj.pressure_volume(membrane)
    folds = [p.volume for p in curve.special_points if p.kind == "fold"]
    return min(folds) if folds else 0.1 * float(max(b.volume.max() for b in curve.branches))


def difference(ramps, i: int, up) -> tuple[float, bool]:
    """The largest relative difference of one chamber's ramp, and whether both tell the same story."""
    outcome = Outcome(int(ramps.outcome[i]))
    alike = up.area_strain_reason in REASONS[outcome] and len(up["snap"]) >= ramps.snaps[i]
    pairs = []
    if outcome is not Outcome.start_unstable:
        pairs.append((ramps.area_strain[i], up.area_strain))
    for event, points, name in (
        ("snap", ramps.snap, "voltage"),
        ("landing", ramps.landing, "volume"),
        ("breakdown", ramps.breakdown, "voltage"),
    ):
        mine = getattr(points, name)[i]
        if np.isfinite(mine):
            theirs = up[event]
            alike &= bool(theirs)
            pairs += [(mine, getattr(theirs[0].state, name))] if theirs else []
    with np.errstate(all="ignore"):
        apart = [abs(a / b - 1) if a is not None and b else np.inf for a, b in pairs]
    return max(apart, default=0.0), alike


def one_prestretch(prestretch: float, count: int, random, records: list) -> dict:
    """Compares `count` chambers of one membrane; appends those that differ to `records`."""
    membrane = dj.Membrane(prestretch=prestretch)
    begin = time.perf_counter()
    surface = dj.Surface.build(membrane, cache=False)
    build = time.perf_counter() - begin
    chambers = np.exp(random.uniform(np.log(10), np.log(25000), count))
    fillings = random.uniform(0.01, 1, count) * largest_filling(membrane)
    dj.chamber_ramps(surface, chambers, fillings)
    begin = time.perf_counter()
    ramps = dj.chamber_ramps(surface, chambers, fillings)
    seconds = time.perf_counter() - begin
    worst, compared, spent = 0.0, 0, 0.0
    for i in np.flatnonzero(ramps.outcome != Outcome.unresolved):
        scene = dj.Scene(membrane, dj.Chamber(volume=chambers[i], initial_volume=fillings[i]))
        begin = time.perf_counter()
        diagram = dj.voltage_volume(scene)
        spent += time.perf_counter() - begin
        apart, alike = difference(ramps, i, diagram.ramp())
        compared += 1
        if alike:
            worst = max(worst, apart)
        if not (alike and apart <= ALLOWED):
            told = {"difference": apart, "alike": alike, "reason": diagram.area_strain_reason}
            told |= {"prestretch": prestretch, "chamber_volume": chambers[i], "initial_volume": fillings[i]}
            records.append(told | {"outcome": Outcome(int(ramps.outcome[i])).name, "complete": diagram.complete})
    return {
        "prestretch": prestretch,
        "elements": len(surface.errors),
        "build_seconds": build,
        "chambers": count,
        "unresolved": int((ramps.outcome == Outcome.unresolved).sum()),
        "compared": compared,
        "largest_difference": worst,
        "microseconds_per_chamber": seconds / count * 1e6,
        "microseconds_per_diagram_by_continuation": spent / max(compared, 1) * 1e6,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10_000, help="number of random chambers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="12 chambers of one membrane")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    prestretches = [1.0] if options.quick else [1.0, *random.uniform(1, 3, 9)]
    count = 12 if options.quick else max(1, options.scenes // len(prestretches))
    print(f"seed {options.seed}, {count * len(prestretches)} chambers", file=sys.stderr)
    differing: list[dict] = []
    groups = []
    for prestretch in prestretches:
        groups.append(one_prestretch(float(prestretch), count, random, differing))
        print(groups[-1], file=sys.stderr, flush=True)
        document = {
            "name": "ensemble",
            "engine": "surface against continuation",
            "parameters": {"scenes": options.scenes, "seed": options.seed},
            "compared": sum(g["compared"] for g in groups),
            "unresolved": sum(g["unresolved"] for g in groups),
            "differing": differing,
            "largest_difference": max(g["largest_difference"] for g in groups),
            "groups": groups,
            "machine": machine(),
        }
        write(document, options.json)
    for record in differing:
        print(record, file=sys.stderr)
    print("FAILED" if differing else "PASSED", file=sys.stderr)
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
