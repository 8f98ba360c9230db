"""Ramps of many chambers on the surface against the continuation: do they agree, and what does each cost?

Random scenes of membranes with prestretch 1 to 3 and limiting stretch J from 50 to 1000, four of five on a chamber, the rest at
constant pressure. Every scene that the surface decides is compared with continuation: the way the ramp ends, voltage and
volume of every event up and down, the area strain, and the special points of the branch. First with `continue_scenes`; what
that does not decide, or where it differs by more than 1e-8, and a random sample of the rest are compared with `voltage_volume`,
which has the last word. All are timed in the same run, warm, the surface's time beside its error.

    python -m benchmarks.acceptance.ensemble [--scenes 10000] [--membranes 10] [--sample 300] [--seed 0] [--json FILE|-] [--quick]
"""

import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.random_scenes import film_loadings, gent_films
from dielectric_jax.model import Outcome

jax.config.update("jax_enable_x64", True)

ALLOWED = 1e-8
REASONS = {
    Outcome.breakdown_on_branch: ("breakdown on the branch",),
    Outcome.breakdown_in_snap: ("breakdown in the snap",),
    Outcome.no_landing: ("no landing",),
    Outcome.start_unstable: ("start_unstable",),
}


def pairs_of(ramps, i: int, diagram):
    """Pairs of numbers that should be equal: (name, surface, continuation); None where one side has no such event."""
    ramp = diagram.ramp()
    outcome = Outcome(int(ramps.outcome[i]))
    if outcome is not Outcome.start_unstable:
        yield "area strain", ramps.area_strain[i], ramp.area_strain
    up, survived = ramp.events, outcome is Outcome.breakdown_on_branch
    down = diagram.ramp("down").events if survived and ramp["breakdown"] else ()
    seen = {name: [e.state for e in up if e.event == name] for name in ("snap", "landing", "breakdown")}
    if outcome is Outcome.breakdown_in_snap:
        seen["breakdown"] = []
        if not np.isfinite(ramps.landing.volume[i]).any():  # beyond the surface: there, but not located
            seen["landing"] = []
    seen["snap_back"] = [e.state for e in down if e.event == "snap_back"]
    seen["landing_back"] = [e.state for e in down if e.event == "landing"]
    if outcome is not Outcome.start_unstable:
        for name, states in seen.items():
            points = getattr(ramps, name)
            for field in ("voltage", "volume"):
                mine = np.atleast_1d(getattr(points, field)[i])
                mine = [v for v in mine if np.isfinite(v)]
                theirs = [getattr(s, field) for s in states]
                for k in range(max(len(mine), len(theirs))):
                    yield name, *(v[k] if k < len(v) else None for v in (mine, theirs))
    yield from special_pairs(ramps, i, diagram, ramp)


def special_pairs(ramps, i: int, diagram, ramp):
    """The same of the special points on the branch of the start, where the surface holds it alone."""
    low, high = ramps.reach[i]
    start = ramp.events[0].state
    for kind, points in (("fold", ramps.folds), ("zero_voltage", ramps.zero_voltage), ("breakdown", ramps.breakdowns)):
        mine = sorted(zip(points.apex_stretch[i], points.volume[i], points.error[i], strict=True))
        mine = [(a, v, e) for a, v, e in mine if np.isfinite(a) and e <= ALLOWED]
        own = [p for p in diagram.special_points if p.kind == kind and p.branch == branch_of(diagram, start)]
        # a curve that was followed twice, and says so by `complete`, has its points twice
        if not diagram.complete:
            own = [p for i, p in enumerate(own) if all(abs(p.apex_stretch - o.apex_stretch) > 1e-9 for o in own[:i])]
        for apex, volume, _ in mine:
            near = min(own, key=lambda p: abs(p.apex_stretch - apex), default=None)
            yield kind, volume, near.volume if near is not None else None
        vague = np.isinf(points.error[i]) | (points.error[i] > ALLOWED)
        inside = [p for p in own if low < p.apex_stretch < high]
        if len(inside) > len(mine) + vague.sum() and len(mine) < len(points.error[i]):
            yield kind, None, inside[-1].volume


def branch_of(diagram, state) -> int:
    """The branch that passes a state."""
    away = [np.min(np.abs(b.apex_stretch - state.apex_stretch) + np.abs(b.voltage_squared)) for b in diagram.branches]
    return int(np.argmin(away))


def difference(ramps, i: int, diagram) -> tuple[float, list[str]]:
    """The largest relative difference of one chamber, and what one side has and the other has not."""
    alike = diagram.area_strain_reason in REASONS[Outcome(int(ramps.outcome[i]))]
    missing, worst = [] if alike else ["reason"], 0.0
    for name, mine, theirs in pairs_of(ramps, i, diagram):
        if mine is None or theirs is None:
            missing.append(name)
        else:
            worst = max(worst, abs(mine - theirs) / max(abs(theirs), 1e-3))
    return worst, missing


def batches(surface, loadings: list):
    """(ramps, loadings) of the chambers and of the constant pressures."""
    chambers = [x for x in loadings if isinstance(x, dj.Chamber)]
    if chambers:
        columns = [[x.volume for x in chambers], [x.initial_volume for x in chambers]]
        yield dj.diagram.chamber_ramps(surface, *columns), chambers
    pressures = [x for x in loadings if isinstance(x, dj.ConstantPressure)]
    if pressures:
        yield dj.diagram.pressure_ramps(surface, [x.pressure for x in pressures]), pressures


def apart(mine, theirs) -> np.ndarray:
    """Relative differences in the measure of `error_estimate`."""
    return np.abs(mine - theirs) / np.maximum(np.abs(theirs), 1e-3)


def agree(ramps, i: int, others, j: int) -> tuple[bool, float]:
    """Whether the surface and `continue_scenes` agree on one scene, and the largest difference of their loads.

    The places of folds are vague in lanes, which say so in their error: volumes may differ by ten times that.
    """
    outcome, other = Outcome(int(ramps.outcome[i])), Outcome(int(others.outcome[j]))
    if other is not outcome:
        return False, np.inf
    worst, alike = 0.0, True
    names = ["snap", "landing", "breakdown", "snap_back", "landing_back"]
    if outcome is Outcome.breakdown_in_snap and not np.isfinite(ramps.landing.volume[i]).any():
        names = ["snap"]
    if outcome is Outcome.start_unstable:
        names = []
    for name in names:
        points, their = getattr(ramps, name), getattr(others, name)
        there = [np.atleast_1d(np.isfinite(p.apex_stretch[k])) for p, k in ((points, i), (their, j))]
        if (there[0] != there[1]).any():
            return False, np.inf
        for field in ("voltage", "volume"):
            mine, expected, error = (
                np.atleast_1d(v)[there[0]]
                for v in (getattr(points, field)[i], getattr(their, field)[j], their.error[j])
            )
            away = apart(mine, expected)
            if field == "voltage":
                worst = max(worst, *away, 0.0)
            else:
                alike &= bool((away <= np.maximum(ALLOWED, 10 * error)).all())
    low, high = ramps.reach[i]
    for kind in ("folds", "zero_voltage", "breakdowns"):
        points, their = getattr(ramps, kind), getattr(others, kind)
        known = np.flatnonzero(points.error[i] <= ALLOWED)
        for k in np.flatnonzero((low < their.apex_stretch[j]) & (their.apex_stretch[j] < high)):
            places = apart(points.volume[i][known], their.volume[j, k])
            if not known.size or places.min() > max(ALLOWED, 10 * their.error[j, k]):
                return False, np.inf
            if kind == "folds":
                worst = max(worst, float(apart(points.voltage[i][known[places.argmin()]], their.voltage[j, k])))
    return alike and bool(worst <= ALLOWED), float(worst)


def one_membrane(membrane, count: int, sample: int, random, records: list) -> dict:
    """Compares `count` scenes of one membrane; appends those that differ to `records`."""
    build, by_batch, by_single = (harness.Stopwatch() for _ in range(3))
    surface = build.time(dj.Surface.build, membrane, cache=False)
    loadings = film_loadings(random, membrane, count)
    on_surface = harness.timed(lambda: list(batches(surface, loadings)), 1)
    tally = {"by_batch": 0, "by_single": 0, "unresolved": 0, "largest_difference": 0.0}
    for ramps, part in on_surface.value:
        tally["unresolved"] += int((ramps.outcome == Outcome.unresolved).sum())
        decided = np.flatnonzero(ramps.outcome != Outcome.unresolved)
        if not decided.size:
            continue
        scenes = [dj.Scene(membrane, part[i]) for i in decided]
        others = by_batch.time(dj.continue_scenes, scenes).ramps
        chosen = set(random.permutation(decided)[: -(-sample * len(decided) // count)].tolist())
        for j, i in enumerate(decided.tolist()):
            alike, apart = agree(ramps, i, others, j)
            tally["by_batch"] += alike
            if alike:
                tally["largest_difference"] = max(tally["largest_difference"], apart)
            if alike and i not in chosen:
                continue
            diagram = by_single.time(dj.voltage_volume, scenes[j])
            tally["by_single"] += 1
            apart, missing = difference(ramps, i, diagram)
            tally["largest_difference"] = max(tally["largest_difference"], apart)
            if missing or apart > ALLOWED:
                seen = {"difference": apart, "missing": missing, "reason": diagram.area_strain_reason}
                seen |= {"scene": dj.model.describe(scenes[j]), "batch": Outcome(int(others.outcome[j])).name}
                records.append(seen | {"outcome": Outcome(int(ramps.outcome[i])).name, "complete": diagram.complete})
    return {
        "prestretch": float(membrane.prestretch),
        "stretch_limit": float(membrane.material.stretch_limit),
        "elements": len(surface.errors),
        "build_seconds": build.seconds,
        "scenes": count,
        "compared": count - tally["unresolved"],
        **tally,
        "microseconds_per_scene": on_surface.best / count * 1e6,
        "microseconds_per_scene_by_batch": by_batch.seconds / max(count - tally["unresolved"], 1) * 1e6,
        "microseconds_per_diagram_by_continuation": by_single.seconds / max(tally["by_single"], 1) * 1e6,
    }


def main() -> int:
    parser = harness.arguments(__doc__, "12 scenes of one membrane, 4 of them by voltage_volume", seed=True)
    parser.add_argument("--scenes", type=int, default=10_000, help="number of random scenes")
    parser.add_argument("--membranes", type=int, default=10)
    parser.add_argument("--sample", type=int, default=300, help="scenes compared with voltage_volume in any case")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    membranes = gent_films(random, 1 if options.quick else options.membranes)
    if options.quick:
        options.sample = 4
    count = 12 if options.quick else max(1, options.scenes // len(membranes))
    harness.say(f"seed {options.seed}, {count * len(membranes)} scenes")
    differing: list[dict] = []
    groups = []
    for membrane in membranes:
        groups.append(one_membrane(membrane, count, -(-options.sample // len(membranes)), random, differing))
        harness.say(groups[-1])
        document = {
            "name": "ensemble",
            "engine": "surface against continuation",
            "parameters": {"scenes": options.scenes, "seed": options.seed},
            **{k: sum(g[k] for g in groups) for k in ("compared", "by_batch", "by_single", "unresolved")},
            "differing": differing,
            "largest_difference": max(g["largest_difference"] for g in groups),
            "groups": groups,
            "machine": harness.machine(),
        }
        harness.write(document, options.json, partial=True)
    for record in differing:
        harness.say(record)
    return harness.finish(document, options.json, not differing)


if __name__ == "__main__":
    sys.exit(main())
