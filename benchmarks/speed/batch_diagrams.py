"""What does a batch of 256 chambers cost, and how exact is it, by our engines and by their peers?

The default membrane (Gent, J = 270, λ0 = 1) filled to V_0 = 2.42 on chambers from V_C = 300 to 25000; of each its
voltage–volume diagram from the filling at zero voltage to breakdown, with its folds, zero-voltage states, breakdown and
landing. Errors are against `data/chambers.csv` (see `make_references.py`), good to 1e-12. All in one process run, error beside
time; what carries over to another machine are ratios. Compiling, building a surface and starting a process are counted apart.

- `continuation`: ours by shooting and pseudo-arclength, at several tolerances: all lanes in one batch, and single diagrams
  (with every branch of the whole window and an independent scan) of some lanes. The best of fifteen rounds of the whole
  batch, for AUTO has the best of its rounds lane by lane.
- `surface`: `chamber_ramps` on surfaces of several tolerances. What the surface does not decide is a wrong lane here.
- `scipy_shooting`, `scipy_solve_bvp`: SciPy's DOP853 and `solve_bvp` under a continuation in NumPy, stepping at given
  apex stretches (natural) or along the arc, on some of the lanes.
- `jaxcont`: the package of that name, all lanes in one `vmap`, with our explicit map as its residual.
- `auto`: AUTO-07p, one process a lane, of which the seconds that it prints are counted, the best of the rounds lane by
  lane; no landing, which needs another run. Many settings compete on some lanes; of those that find all folds and no other
  and are right at breakdown to 1e-6, the quickest within an error of 1e-6, 1e-8, 1e-10 and 1e-12 are shown. What others are
  compared with is the quickest within 1e-8.

    AUTO_DIR=… python -m benchmarks.speed.batch_diagrams [--json FILE|-] [--quick] [--engines continuation,surface,…]
"""

import dataclasses
import importlib.util
import itertools
import sys
import tempfile
from collections.abc import Callable

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.truth import auto_peer, chambers, scipy_peers
from benchmarks.truth.chambers import Found

jax.config.update("jax_enable_x64", True)

ALLOWED = 1e-8  # error of AUTO's fold voltages in the comparison
BOUNDS = (1e-6, ALLOWED, 1e-10, 1e-12)
_FINALISTS = 3  # settings of AUTO a bound that run on all lanes
MEMBRANE = dj.Membrane(material=dj.Gent(chambers.STRETCH_LIMIT))


@dataclasses.dataclass
class Entry:
    """One row: `run` is timed and returns what it found on its lanes, the seconds that it reports or None, and counts.

    Where that has to be read from what `run` returns, and the reading is not part of the time, `read` does it.
    """

    engine: str
    parameters: dict
    lanes: list[float]
    run: Callable
    read: Callable[[object], tuple[dict[float, Found], float | None, dict]] = lambda value: value
    rounds: int = 3
    more: dict = dataclasses.field(default_factory=dict)


def measure(entry: Entry, truth: dict[float, Found]) -> dict:
    """The record of one entry: a first run, which may compile, then warm ones."""
    timing = harness.timed(entry.run, entry.rounds, reported=lambda value: entry.read(value)[1])
    found, _, counts = entry.read(timing.value)
    judged = chambers.judge(found, truth)
    return {
        "name": "batch_diagrams",
        "engine": entry.engine,
        "parameters": entry.parameters,
        **judged,
        "seconds_per_diagram": timing.best / len(entry.lanes),
        "median_seconds_per_diagram": timing.median / len(entry.lanes),
        "compile_seconds": timing.compile_seconds,
        **entry.more,
        "counts": judged["counts"] | counts,
    }


def of_diagram(diagram: dj.diagram.Diagram) -> Found:
    """The special points of the branch through the filling, up to breakdown."""
    ramp = diagram.ramp()
    start = ramp.events[0].state
    at = {}
    for p in diagram.special_points:
        at.setdefault(p.kind, []).append(p)
    branch = diagram.branches[
        min((abs(b.apex_stretch - start.apex_stretch).min(), k) for k, b in enumerate(diagram.branches))[1]
    ]
    number = diagram.branches.index(branch)
    own = {kind: [p for p in points if p.branch == number] for kind, points in at.items()}
    first = start.apex_stretch * (1 + 1e-9)
    broken = min((p for p in own.get("breakdown", ()) if p.apex_stretch > first), key=lambda p: p.apex_stretch)
    inside = [
        [
            p
            for p in sorted(own.get(kind, ()), key=lambda p: p.apex_stretch)
            if first < p.apex_stretch < broken.apex_stretch
        ]
        for kind in ("fold", "zero_voltage")
    ]
    landing = next((e.state.volume for e in ramp.events if e.event == "landing"), chambers.NAN)
    return Found(
        [(p.voltage_squared, p.volume) for p in inside[0]],
        [p.volume for p in inside[1]],
        broken.voltage_squared,
        landing,
    )


def scenes_of(lanes: list[float]) -> list[dj.Scene]:
    """The chambers of the batch."""
    given = {"initial_volume": chambers.INITIAL_VOLUME, "atmospheric_pressure": chambers.ATMOSPHERE}
    return [dj.Scene(MEMBRANE, dj.Chamber(volume=chamber, **given)) for chamber in lanes]


def one_by_one(lanes: list[float], tolerance: float, **options) -> dict[float, Found]:
    """Single diagrams, one after the other."""
    scenes = zip(lanes, scenes_of(lanes), strict=True)
    return {chamber: of_diagram(dj.voltage_volume(scene, tolerance=tolerance, **options)) for chamber, scene in scenes}


def continuation_entries(lanes, quick):
    scenes = scenes_of(lanes)
    for tolerance in (1e-8,) if quick else (1e-6, 1e-8, 1e-10):

        def run(tolerance=tolerance):
            batch = dj.continue_scenes(scenes, tolerance=tolerance)
            return of_ramps(lanes, batch.ramps), None, {"unresolved": unresolved(batch.ramps)}

        yield Entry("continuation", {"tolerance": tolerance, "batched": True}, lanes, run, rounds=2 if quick else 15)
    some = chambers.spread(lanes, 2 if quick else 8)
    for tolerance in () if quick else (1e-6, 1e-9, 1e-12):
        yield Entry(
            "continuation",
            {"tolerance": tolerance, "batched": False, "extrapolated_from_lanes": len(some)},
            some,
            lambda tolerance=tolerance: (one_by_one(some, tolerance), None, {}),
            rounds=2,
        )


def unresolved(ramps: dj.diagram.Ramps) -> int:
    """How many lanes the engine leaves to `voltage_volume`."""
    return int((ramps.outcome == dj.model.Outcome.unresolved).sum())


def of_ramps(lanes: list[float], ramps: dj.diagram.Ramps) -> dict[float, Found]:
    """The special points of every lane, up to its first breakdown."""
    found = {}
    folds, zeros, breaks = ramps.folds, ramps.zero_voltage, ramps.breakdowns
    for k, chamber in enumerate(lanes):
        first = ramps.start.apex_stretch[k] * (1 + 1e-9)
        apex = breaks.apex_stretch[k]
        ahead = np.flatnonzero(apex > first)
        broken = ahead[np.argmin(apex[ahead])] if ahead.size else None
        last = apex[broken] if broken is not None else np.inf

        def inside(point, k=k, first=first, last=last):
            return np.flatnonzero((point.apex_stretch[k] > first) & (point.apex_stretch[k] < last))

        found[chamber] = Found(
            [(folds.voltage[k, i] ** 2, folds.volume[k, i]) for i in inside(folds)],
            [zeros.volume[k, i] for i in inside(zeros)],
            breaks.voltage[k, broken] ** 2 if broken is not None else chambers.NAN,
            ramps.landing.volume[k, 0],
        )
    return found


def surface_entries(lanes, quick):
    for tolerance in (1e-7,) if quick else (1e-5, 1e-7, 1e-9):
        build = harness.Stopwatch()
        surface = build.time(dj.Surface.build, MEMBRANE, tolerance=tolerance, cache=quick)

        def run(surface=surface):
            ramps = dj.diagram.chamber_ramps(surface, lanes, chambers.INITIAL_VOLUME)
            return ramps, unresolved(ramps)

        yield Entry(
            "surface",
            {"tolerance": tolerance},
            lanes,
            run,
            lambda found: (of_ramps(lanes, found[0]), None, {"unresolved": found[1]}),
            rounds=5,
            more={"build_seconds": build.seconds},
        )
    if not quick:
        yield Entry(
            "surface",
            {"tolerance": tolerance, "unresolved": "by voltage_volume"},
            lanes,
            lambda: resolved(surface, lanes),
            lambda found: (
                of_ramps(lanes, found[0]) | found[1],
                None,
                {"unresolved": 0, "by_voltage_volume": len(found[1])},
            ),
        )


def resolved(surface, lanes):
    """The ramps, and diagrams on the surface, certified by shooting, of the lanes that they leave unresolved."""
    ramps = dj.diagram.chamber_ramps(surface, lanes, chambers.INITIAL_VOLUME)
    rest = [c for c, outcome in zip(lanes, ramps.outcome, strict=True) if outcome == dj.model.Outcome.unresolved]
    return ramps, one_by_one(rest, 1e-9, surface=surface)


def scipy_entries(solver, settings, lanes, count):
    """SciPy's rows: settings are (tolerance, natural stepping)."""
    some = chambers.spread(lanes, count)
    for tolerance, natural in settings:

        def run(tolerance=tolerance, natural=natural):
            found, points, solves, failed = {}, 0, 0, 0
            for chamber in some:
                try:
                    found[chamber], work = scipy_peers.diagram(solver(scipy_peers.Gas(chamber), tolerance), natural)
                    points, solves = points + work["points"], solves + work["solves"]
                except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError):
                    found[chamber] = Found([], [], chambers.NAN, chambers.NAN)
                    failed += 1
            counts = {"points": points, "solves": solves, "failed": failed}
            return found, None, counts

        name = {scipy_peers.Shooting: "scipy_shooting", scipy_peers.Collocation: "scipy_solve_bvp"}[solver]
        parameters = {"tolerance": tolerance, "stepping": "natural" if natural else "arclength"}
        yield Entry(name, parameters | {"extrapolated_from_lanes": len(some)}, some, run, rounds=0)


def shooting_entries(lanes, quick):
    settings = [(1e-7, True)] if quick else list(itertools.product((1e-6, 1e-8, 1e-10, 1e-12), (True, False)))
    return scipy_entries(scipy_peers.Shooting, settings, lanes, 1 if quick else 8)


def solve_bvp_entries(lanes, quick):
    # at 1e-8 it asks for more than 20 000 nodes
    slow = [(1e-4, False), (1e-6, False)]
    settings = [(1e-5, True)] if quick else [(1e-4, True), (1e-5, True), (1e-6, True), *slow]
    return scipy_entries(scipy_peers.Collocation, settings, lanes, 1 if quick else 4)


def jaxcont_entries(lanes, quick):
    if importlib.util.find_spec("jaxcont") is None:
        return "jaxcont: not installed"
    from benchmarks.truth import jaxcont_peer

    def entries():
        for steps, tolerance in ((24, 1e-9),) if quick else ((16, 1e-7), (24, 1e-9), (48, 1e-11)):
            batch = jaxcont_peer.Batch(lanes, steps, tolerance)
            parameters = {"steps_of_a_shot": steps, "newton_tolerance": tolerance, "batched": True}
            yield Entry("jaxcont", parameters, lanes, batch.run, rounds=1 if quick else 2)

    return entries()


def auto_constants(intervals, collocation, tolerance, first, longest) -> str:
    return (
        f"NTST={intervals}, NCOL={collocation}, EPSL={tolerance}, EPSU={tolerance}, EPSS=1e-6, DS={first}, DSMAX={longest}, "
        "UZR={'q': 0.0}"
    )


def auto_lanes(folder: str, constants: str, lanes, rounds: int):
    """AUTO's diagrams of the lanes, the best seconds of the rounds lane by lane, summed."""
    found, seconds, process, points = {}, 0.0, 0.0, 0
    for chamber in lanes:
        runs = [auto_peer.run(folder, "chamber", f"{constants}, PAR={{6: {chamber!r}}}") for _ in range(rounds)]
        best = min(runs, key=lambda r: r.seconds)
        seconds, process = seconds + best.seconds, process + min(r.process_seconds for r in runs)
        points += len(best.points)
        # columns: q, norm, two maxima, p, λa, V, (E/E_EB)²
        marks = best.of_type(auto_peer.STOP)
        found[chamber] = Found(
            folds=[(row[0], row[6]) for row in best.of_type(auto_peer.FOLD)],
            zero_voltage=[row[6] for row in marks if abs(row[7] - 1) > 1e-3],
            breakdown=next((row[0] for row in marks if abs(row[7] - 1) <= 1e-3), chambers.NAN),
        )
    return found, seconds, {"points": points, "process_seconds": process}


def is_right(judged: dict, bound: float) -> bool:
    """Whether every fold is within the bound, and no lane is wrong."""
    counts = judged["counts"]
    return judged["error"] <= bound and not counts["missing_folds"] + counts["false_folds"] + counts["wrong_lanes"]


def screened(folder, lanes, truth) -> list[tuple]:
    """Of many settings those that are right on some lanes, as (seconds, judgement, setting), quickest first."""
    # the lanes next to the chambers without a fold are the hardest: two folds nearly meet there
    bare = [k for k, c in enumerate(lanes) if not truth[c].folds]
    hard = [lanes[k] for k in sorted({k + d for k in (bare[0], bare[-1]) for d in (-2, -1, 0, 1, 2)})] if bare else []
    some = sorted({*chambers.spread(lanes, 8), *hard})
    right = []
    steps = ((1e-3, 1.0), (0.1, 1.0), (0.1, 0.6), (0.1, 0.4))
    for setting in itertools.product((4, 5, 6, 8, 10, 20), (4, 5), (1e-4, 1e-5, 1e-6, 1e-8), steps):
        intervals, collocation, tolerance, (first, longest) = setting
        if intervals * collocation > 80 or (tolerance < 1e-7 and intervals * collocation < 40):
            continue
        setting = (intervals, collocation, tolerance, first, longest)
        found, seconds, _ = auto_lanes(folder, auto_constants(*setting), some, 1)
        judged = chambers.judge(found, truth)
        if is_right(judged, BOUNDS[0]):
            right.append((seconds, judged, setting))
    return sorted(right, key=lambda row: row[0])


def auto_settings(folder, lanes, truth) -> list[tuple]:
    """The quickest setting that is right on all lanes, for each bound of the error."""
    candidates, chosen = screened(folder, lanes, truth), []
    harness.say(f"AUTO-07p: {len(candidates)} settings were right on some lanes")
    for bound in BOUNDS:
        able = [row[2] for row in candidates if is_right(row[1], bound)][:_FINALISTS]
        timed = []
        for setting in able:
            found, seconds, _ = auto_lanes(folder, auto_constants(*setting), lanes, 1)
            if is_right(chambers.judge(found, truth), bound):
                timed.append((seconds, setting))
        if timed and min(timed)[1] not in chosen:
            chosen.append(min(timed)[1])
    return chosen


def auto_entries(lanes, quick, truth, folder):
    """AUTO's rows, and beside them the setting that `peers.py` compares with."""
    chosen = [(10, 4, 1e-6, 0.1, 0.4)] if quick else auto_settings(folder, lanes, truth)
    if not quick and (10, 4, 1e-8, 1e-3, 1.0) not in chosen:
        chosen.append((10, 4, 1e-8, 1e-3, 1.0))
    names = ("NTST", "NCOL", "EPS", "DS", "DSMAX")
    for setting in chosen:
        yield Entry(
            "auto",
            dict(zip(names, setting, strict=True)) | {"threads": auto_peer.threads()},
            lanes,
            lambda setting=setting: auto_lanes(folder, auto_constants(*setting), lanes, 1 if quick else 3),
            rounds=0,
        )


def label(record: dict) -> str:
    parameters = [f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in record["parameters"].items()]
    return f"{record['engine']}: {', '.join(parameters)}"


def print_record(record: dict) -> None:
    counts = record["counts"]

    def small(value):
        return f"{value:9.1e}" if value is not None else f"{'–':>9}"

    harness.say(
        f"{label(record)[:88]:90}{counts['lanes']:5}{record['seconds_per_diagram'] * 1e3:11.3f}"
        f"{small(record['error'])}{small(record['breakdown_error'])}{small(record['landing_error'])}"
        f"{counts['missing_folds']:5}{counts['false_folds']:5}{counts['wrong_lanes']:5}{record['compile_seconds']:9.1f}"
    )


ENGINES = ("auto", "surface", "continuation", "scipy_shooting", "scipy_solve_bvp", "jaxcont")


def entries_of(engine: str, lanes, quick: bool, truth, folder: str):
    """The rows of one engine, or a sentence why there are none."""
    if engine == "auto":
        return auto_peer.prepare(folder) or auto_entries(lanes, quick, truth, folder)
    makers = {
        "continuation": continuation_entries,
        "surface": surface_entries,
        "scipy_shooting": shooting_entries,
        "scipy_solve_bvp": solve_bvp_entries,
        "jaxcont": jaxcont_entries,
    }
    return makers[engine](lanes, quick)


def main() -> int:
    parser = harness.arguments(__doc__, "four chambers, one setting an engine")
    parser.add_argument("--engines", default=",".join(ENGINES), help="some of %(default)s")
    options = parser.parse_args()
    engines = options.engines.split(",")
    if wrong := [e for e in engines if e not in ENGINES]:
        parser.error(f"--engines must be some of {', '.join(ENGINES)}, but holds {wrong[0]!r}")
    if not options.quick:
        harness.without_cache()
    truth = chambers.reference()
    lanes = chambers.spread(list(truth), 4) if options.quick else list(truth)
    document = {
        "name": "batch_diagrams",
        "missing": [],
        "compared_with": None,
        "records": [],
        "machine": harness.machine(),
    }
    harness.say(
        f"{'':90}{'lanes':>5}{'ms/diagram':>11}{'fold':>9}{'break':>9}{'landing':>9}{'miss':>5}{'false':>5}{'wrong':>5}{'compile':>9}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for engine in engines:
            entries = entries_of(engine, lanes, options.quick, truth, folder)
            if isinstance(entries, str):
                harness.say(entries)
                document["missing"].append(entries)
                continue
            for entry in entries:
                record = measure(entry, truth)
                record["machine"] = document["machine"]
                document["records"].append(record)
                print_record(record)
                harness.write(document, options.json, partial=True)
    best = best_of_auto(document["records"])
    for record in document["records"]:
        record["auto_over_this"] = best["seconds_per_diagram"] / record["seconds_per_diagram"] if best else None
    document["compared_with"] = label(best) if best else None
    for record in sorted(document["records"], key=lambda r: r["seconds_per_diagram"]) if best else ():
        harness.say(f"AUTO-07p over this {record['auto_over_this']:10.3g}  {label(record)}")
    ours = [r for r in document["records"] if r["engine"] in ("continuation", "surface")]
    good = all(r["counts"]["false_folds"] == 0 and r["error"] < 1e-6 for r in ours)
    return harness.finish(document, options.json, good)


def best_of_auto(records: list[dict]) -> dict | None:
    """AUTO's quickest row with every fold right to the allowed error and no false one."""

    rows = [r for r in records if r["engine"] == "auto" and is_right(r, ALLOWED)]
    return min(rows, key=lambda r: r["seconds_per_diagram"], default=None)


if __name__ == "__main__":
    sys.exit(main())
