"""What does the V_C = 1600 diagram cost here, and what does AUTO-07p take for its main branch?

Both in one process run, warm, turn by turn, error beside time. The ratio of the times is what carries over to another
machine, not the seconds. The rows do not hold the same:

- AUTO-07p (collocation, Fortran): one branch from a given state at zero voltage to breakdown, with its folds. Its seconds
  are those that it prints, without the start of its process (which is in the record) and without compiling the equations.
  It prints eleven digits, so its errors below 3e-13 are chance; folds are two, and one that is missing was not located.
- `voltage_volume`: every branch in the window and an independent scan for missed ones, 256 points or more a branch, all
  special points, stability, error estimates, the ramp up and down. On a surface the surface's building is apart.
- `glance`: one chamber alone on the surface: what the next row holds, as records ready to be drawn (no
  folds below zero voltage).
- `chamber_ramps`: one chamber out of a batch, its branch through the start on 256 stretches as far as it is alone there, with
  its special points and the events of the ramp, up and down.

`auto_peer.py` finds and runs AUTO; without it its rows are left out. Its settings here are those of a
careful user; `batch_diagrams.py` seeks the quickest.

    AUTO_DIR=… python -m benchmarks.speed.peers [--json FILE|-] [--quick]
"""

import sys
import tempfile

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.speed import one_chamber
from benchmarks.truth import auto_peer

jax.config.update("jax_enable_x64", True)

ALLOWED = 1e-9
# mesh intervals, tolerance of Newton, longest step; the last draws its branch about as finely as ours
SETTINGS = [(n, eps, 1.0) for n in (10, 20, 40, 80) for eps in (1e-8, 1e-11)] + [(20, 1e-8, 0.03)]


def auto_runs(folder: str, settings) -> dict:
    """Continuations by AUTO, as functions without arguments."""
    runs = {}
    for setting in settings:
        constants = "NTST={0}, EPSL={1}, EPSU={1}, DSMAX={2}".format(*setting)
        name = "AUTO-07p, NTST {}, EPS {:g}, DSMAX {:g}".format(*setting)
        runs[name] = lambda constants=constants: auto_peer.run(folder, "chamber", constants)
    return runs


def of_auto(timing: harness.Timing) -> dict:
    """The record of one continuation by AUTO: what stands in its file of the branch."""
    done = timing.value
    folds, stops = ([row[0] for row in done.of_type(kind)] for kind in (auto_peer.FOLD, auto_peer.STOP))
    return {
        "holds": "branch to breakdown",
        "process_seconds": min(run.process_seconds for run in timing.values),
        "points": len(done.points),
        "folds": len(folds),
        "snap": max([q for q in folds if q > 0], default=float("nan")) ** 0.5,
        "breakdown": stops[0] ** 0.5 if stops else float("nan"),
    }


def of_diagram(found) -> dict:
    """The record of one of our diagrams, or of a glance."""
    out = {
        "holds": "branch and all events",
        "branches": len(found.branches),
        "points": sum(len(b) for b in found.branches),
        "folds": sum(p.kind == "fold" for p in found.special_points),
        **one_chamber.voltages(found),
    }
    if isinstance(found, dj.diagram.Diagram):
        out["holds"] = "diagram and ramps" if found.complete else "diagram on the surface"
        out |= {"special_points": len(found.special_points), "complete": found.complete}
    return out


def of_ramps(ramps: dj.diagram.Ramps) -> dict:
    """The record of the ramps of many chambers, the last of which is judged."""
    return {
        "holds": "branch and all events",
        "points": 256,
        "chambers": len(ramps.outcome),
        "unresolved": int((ramps.outcome == dj.model.Outcome.unresolved).sum()),
        "folds": int(np.isfinite(ramps.folds.volume[-1]).sum()),
        "snap": ramps.snap.voltage[-1, 0],
        "breakdown": ramps.breakdown.voltage[-1],
    }


def our_runs(surface: dj.Surface, quick: bool) -> dict:
    """Our engines, as functions without arguments."""
    volumes = np.append(np.geomspace(256.0, 25000.0, 11 if quick else 1999), 1600.0)
    ramps = {f"ramp, one of {len(volumes)}": lambda: dj.diagram.chamber_ramps(surface, volumes, 2.42)}
    return one_chamber.engines(surface) | ramps


def record(name: str, timing: harness.Timing) -> dict:
    """The record of one engine."""
    found, lanes = timing.value, 1
    if isinstance(found, auto_peer.Run):
        read = of_auto(timing)
    elif isinstance(found, dj.diagram.Ramps):
        read, lanes = of_ramps(found), len(found.outcome)
    else:
        read = of_diagram(found)
    return {
        "engine": name,
        **read,
        "seconds": timing.best / lanes,
        "median_seconds": timing.median / lanes,
        "first_seconds": timing.first / lanes,
        **one_chamber.errors(read["snap"], read["breakdown"]),
    }


def print_table(records: list[dict]) -> None:
    """The records, on standard error."""
    head = f"{'':41}{'holds':23}{'ms':>8}{'median':>9}{'AUTO/this':>11}{'points':>8}{'folds':>7}{'error: snap':>13}{'breakdown':>11}"
    harness.say(head)
    for r in records:
        ratio = "–" if r["auto_over_this"] is None else f"{r['auto_over_this']:.3g}"
        harness.say(
            f"{r['engine']:41}{r['holds']:23}{r['seconds'] * 1e3:8.2f}{r['median_seconds'] * 1e3:9.2f}{ratio:>11}"
            f"{r.get('points', '–'):>8}{r['folds']:>7}{r['fold_error']:13.1e}{r['breakdown_error']:11.1e}"
        )


def main() -> int:
    parser = harness.arguments(__doc__, "one round, 12 chambers, two settings of AUTO")
    options = parser.parse_args()
    build = harness.Stopwatch()
    surface = build.time(dj.Surface.build, one_chamber.scene().membrane, cache=False)
    with tempfile.TemporaryDirectory() as folder:
        said = auto_peer.prepare(folder)
        if said:
            harness.say(said)
        engines = {} if said else auto_runs(folder, SETTINGS[:2] if options.quick else SETTINGS)
        timings = harness.timed_in_turn(
            engines | our_runs(surface, options.quick),
            1 if options.quick else 7,
            reported=lambda found: found.seconds if isinstance(found, auto_peer.Run) else None,
        )
    records = [record(name, timing) for name, timing in timings.items()]
    # AUTO at its best: its quickest run that finds both folds and is right at both points
    right = [r for r in records[: len(engines)] if r["folds"] == 2 and r["fold_error"] + r["breakdown_error"] < ALLOWED]
    best = min(right, key=lambda r: r["seconds"], default=None)
    for r in records:
        r["auto_over_this"] = best["seconds"] / r["seconds"] if best else None
    calibration = harness.calibrate()
    document = {
        "name": "peers",
        "parameters": one_chamber.PARAMETERS,
        "auto": said or "AUTO-07p: installed",
        "auto_threads": auto_peer.threads(),
        "auto_compared": best["engine"] if best else None,
        "surface_build_seconds": build.seconds,
        "calibration_seconds": calibration,
        "records": records,
        "machine": harness.machine(),
    }
    print_table(records)
    if best:
        harness.say(f"AUTO/this: AUTO's quickest right run ({best['engine'].split(', ', 1)[1]}) over this row")
    harness.say(f"surface built in {build.seconds:.1f} s with compiling; calibration loop {calibration:.3f} s")
    wrong = [r["engine"] for r in records[len(engines) :] if not max(r["fold_error"], r["breakdown_error"]) < ALLOWED]
    if wrong:
        harness.say("not right: " + "; ".join(wrong))
    return harness.finish(document, options.json, not wrong)


if __name__ == "__main__":
    sys.exit(main())
