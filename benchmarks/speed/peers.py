"""What does the V_C = 1600 diagram cost here, and what does AUTO-07p take for its main branch?

Both in one process run, warm, turn by turn, error beside time. The ratio of the times is what carries over to another
machine, not the seconds. The rows do not hold the same:

- AUTO-07p (collocation, Fortran): one branch from a given state at zero voltage to breakdown, with its folds. Its seconds
  are those that it prints, without the start of its process (which is in the record) and without compiling the equations.
  It prints eleven digits, so its errors below 3e-13 are chance; folds are two, and one that is missing was not located.
- `voltage_volume`: every branch in the window and an independent scan for missed ones, 256 points or more a branch, all
  special points, stability, error estimates, the ramp up and down. On a surface the surface's building is apart.
- `glance`: one chamber alone on the surface: what the next row tells, as records ready to be drawn (no
  folds below zero voltage).
- `chamber_ramps`: one chamber out of a batch, its branch through the start on 256 stretches as far as it is alone there, with
  its special points and the events of the ramp, up and down.

How AUTO is found and run is told in `auto_peer.py`; without it its rows are left out. Its settings here are those of a
careful user; `batch_diagrams.py` seeks the quickest.

    AUTO_DIR=… python -m benchmarks.speed.peers [--json FILE|-] [--quick]
"""

import argparse
import sys
import tempfile
import time

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.harness import machine, write
from benchmarks.speed.first_diagram import BREAKDOWN, FOLD, calibrate
from benchmarks.truth import auto_peer

jax.config.update("jax_enable_x64", True)
dj.enable_compilation_cache()

ALLOWED = 1e-9
# mesh intervals, tolerance of Newton, longest step; the last draws its branch about as finely as ours
SETTINGS = [(n, eps, 1.0) for n in (10, 20, 40, 80) for eps in (1e-8, 1e-11)] + [(20, 1e-8, 0.03)]


def run_auto(folder: str, intervals: int, tolerance: float, step: float) -> dict:
    """One continuation by AUTO: its seconds, and what stands in its file of the branch."""
    constants = f"NTST={intervals}, EPSL={tolerance}, EPSU={tolerance}, DSMAX={step}"
    done = auto_peer.run(folder, "chamber", constants)
    folds = [row[0] for row in done.of_type(auto_peer.FOLD)]
    stops = [row[0] for row in done.of_type(auto_peer.STOP)]
    return {
        "holds": "branch to breakdown",
        "seconds": done.seconds,
        "process_seconds": done.process_seconds,
        "points": len(done.points),
        "folds": len(folds),
        "snap": max([q for q in folds if q > 0], default=float("nan")) ** 0.5,
        "breakdown": stops[0] ** 0.5 if stops else float("nan"),
    }


def run_diagram(scene: dj.Scene, **options) -> dict:
    """One diagram of ours."""
    begin = time.perf_counter()
    found = dj.voltage_volume(scene, **options)
    seconds = time.perf_counter() - begin
    ramp = found.ramp()
    return {
        "holds": "diagram and ramps" if found.complete else "diagram on the surface",
        "seconds": seconds,
        "branches": len(found.branches),
        "points": sum(len(b) for b in found.branches),
        "folds": sum(p.kind == "fold" for p in found.special_points),
        "special_points": len(found.special_points),
        "complete": found.complete,
        "snap": ramp["snap"][0].state.voltage,
        "breakdown": ramp["breakdown"][0].state.voltage,
    }


def run_glance(scene: dj.Scene, surface: dj.Surface) -> dict:
    """One chamber at a glance."""
    begin = time.perf_counter()
    seen = dj.glance(scene, surface)
    seconds = time.perf_counter() - begin
    up = {e.event: e.state.voltage for e in seen.events if e.direction == "up"}
    return {
        "holds": "branch and all events",
        "seconds": seconds,
        "branches": len(seen.branches),
        "points": sum(len(b) for b in seen.branches),
        "folds": sum(p.kind == "fold" for p in seen.special_points),
        "snap": up["snap"],
        "breakdown": up["breakdown"],
    }


def run_ramps(surface: dj.Surface, chambers: np.ndarray) -> dict:
    """The ramps of many chambers, the last of which is judged; seconds of one."""
    begin = time.perf_counter()
    ramps = dj.diagram.chamber_ramps(surface, chambers, 2.42)
    seconds = time.perf_counter() - begin
    return {
        "holds": "branch and all events",
        "seconds": seconds / len(chambers),
        "points": 256,
        "chambers": len(chambers),
        "unresolved": int((ramps.outcome == dj.model.Outcome.unresolved).sum()),
        "folds": int(np.isfinite(ramps.folds.volume[-1]).sum()),
        "snap": ramps.snap.voltage[-1, 0],
        "breakdown": ramps.breakdown.voltage[-1],
    }


def contestants(quick: bool) -> tuple[dict, float]:
    """Our engines, as functions without arguments, and the seconds of building the surface."""
    membrane = dj.Membrane(material=dj.Gent(270.0))
    scene = dj.Scene(membrane, dj.Chamber(volume=1600.0, initial_volume=2.42, atmospheric_pressure=50.0))
    begin = time.perf_counter()
    surface = dj.Surface.build(membrane, cache=False)
    build = time.perf_counter() - begin
    chambers = np.append(np.geomspace(256.0, 25000.0, 11 if quick else 1999), 1600.0)
    return {
        "continuation": lambda: run_diagram(scene),
        "surface, certified": lambda: run_diagram(scene, surface=surface),
        "surface alone": lambda: run_diagram(scene, surface=surface, certify=False, extend=False),
        "glance": lambda: run_glance(scene, surface),
        f"ramp, one of {len(chambers)}": lambda: run_ramps(surface, chambers),
    }, build


def measure(engines: dict, rounds: int) -> list[dict]:
    """A record of each: once to compile, then all turn by turn, so that a drift of the machine's speed meets each alike."""
    told = {name: [run()] for name, run in engines.items()}
    for _ in range(rounds):
        for name, run in engines.items():
            told[name].append(run())
    records = []
    for name, runs in told.items():
        seconds = [r["seconds"] for r in runs[1:]]
        record = {"engine": name, **runs[-1], "seconds": min(seconds), "median_seconds": float(np.median(seconds))}
        record["first_seconds"] = runs[0]["seconds"]
        if "process_seconds" in record:
            record["process_seconds"] = min(r["process_seconds"] for r in runs[1:])
        record["fold_error"] = abs(record["snap"] - FOLD)
        record["breakdown_error"] = abs(record["breakdown"] - BREAKDOWN)
        records.append(record)
    return records


def print_table(records: list[dict]) -> None:
    """The records, on standard error."""
    head = f"{'':41}{'holds':23}{'ms':>8}{'median':>9}{'AUTO/this':>11}{'points':>8}{'folds':>7}{'error: snap':>13}{'breakdown':>11}"
    print(head, file=sys.stderr)
    for r in records:
        ratio = "–" if r["auto_over_this"] is None else f"{r['auto_over_this']:.3g}"
        print(
            f"{r['engine']:41}{r['holds']:23}{r['seconds'] * 1e3:8.2f}{r['median_seconds'] * 1e3:9.2f}{ratio:>11}"
            f"{r.get('points', '–'):>8}{r['folds']:>7}{r['fold_error']:13.1e}{r['breakdown_error']:11.1e}",
            file=sys.stderr,
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="one round, 12 chambers, two settings of AUTO")
    options = parser.parse_args()
    ours, build = contestants(options.quick)
    engines = {}
    with tempfile.TemporaryDirectory() as folder:
        said = auto_peer.prepare(folder)
        if said is None:
            for setting in SETTINGS[:2] if options.quick else SETTINGS:
                name = "AUTO-07p, NTST {}, EPS {:g}, DSMAX {:g}".format(*setting)
                engines[name] = lambda setting=setting: run_auto(folder, *setting)
        if said:
            print(said, file=sys.stderr)
        records = measure(engines | ours, 1 if options.quick else 7)
    # AUTO at its best: its quickest run that finds both folds and is right at both points
    right = [r for r in records[: len(engines)] if r["folds"] == 2 and r["fold_error"] + r["breakdown_error"] < ALLOWED]
    best = min(right, key=lambda r: r["seconds"], default=None)
    for r in records:
        r["auto_over_this"] = best["seconds"] / r["seconds"] if best else None
    calibration = calibrate()
    document = {
        "name": "peers",
        "parameters": {"chamber_volume": 1600.0, "initial_volume": 2.42, "stretch_limit": 270.0, "prestretch": 1.0},
        "auto": said or "AUTO-07p: installed",
        "auto_threads": auto_peer.threads(),
        "auto_compared": best["engine"] if best else None,
        "surface_build_seconds": build,
        "calibration_seconds": calibration,
        "records": records,
        "machine": machine(),
    }
    write(document, options.json)
    print_table(records)
    if best:
        print(
            f"AUTO/this: AUTO's quickest right run ({best['engine'].split(', ', 1)[1]}) over this row", file=sys.stderr
        )
    print(f"surface built in {build:.1f} s with compiling; calibration loop {calibration:.3f} s", file=sys.stderr)
    wrong = [r["engine"] for r in records[len(engines) :] if not max(r["fold_error"], r["breakdown_error"]) < ALLOWED]
    print("FAILED: " + "; ".join(wrong) if wrong else "PASSED", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
