"""What becomes of a hundred thousand random scenes, and do the engines agree where one of them decides?

Random membranes (prestretch 1 to 3, limiting stretch J from 50 to 1000) with random chambers and pressures, all on the
surface ramps; each outcome is counted. Of a sample the continuation draws the whole diagram: of the scenes that the surface
decides the two are compared as in `ensemble.py`, of those it leaves `unresolved` the continuation's own end is counted. Codes
at the ends of branches, flags, refusals and diagrams that are not complete are counted too.

    python -m benchmarks.acceptance.hard_scenes [--scenes 100000] [--sample 300] [--membranes 10] [--seed 0] [--json FILE|-] [--quick]
"""

import collections
import math
import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.acceptance.ensemble import ALLOWED, batches, difference
from benchmarks.random_scenes import film_loadings, gent_films
from dielectric_jax import SceneError
from dielectric_jax.model import Outcome, describe

jax.config.update("jax_enable_x64", True)


class Continuation:
    """What the continuation says of the sample, counted."""

    def __init__(self):
        self.counts = {
            name: collections.Counter()
            for name in ("ends", "flags", "refusals", "reasons_resolved", "reasons_unresolved")
        }
        self.differing: list[dict] = []
        self.worst, self.watch = 0.0, harness.Stopwatch()
        self.compared = self.incomplete = 0

    def decide(self, membrane, loading, ramps, i: int) -> None:
        """Draws one diagram and compares it with the surface's ramp where there is one."""
        outcome = Outcome(int(ramps.outcome[i]))
        try:
            diagram = self.watch.time(dj.voltage_volume, dj.Scene(membrane, loading))
        except (SceneError, ValueError) as refusal:
            code = getattr(getattr(refusal, "code", None), "name", "ValueError")
            self.counts["refusals"][f"{outcome.name}: {code}"] += 1
            if outcome is not Outcome.unresolved:
                self.note(membrane, loading, outcome, math.inf, [str(refusal)])
            return
        self.incomplete += not diagram.complete
        for branch in diagram.branches:
            self.counts["ends"].update([branch.start.name, branch.end.name])
            self.counts["flags"].update(branch.flags)
        decided = outcome is not Outcome.unresolved
        self.counts["reasons_resolved" if decided else "reasons_unresolved"][diagram.area_strain_reason] += 1
        if decided:
            apart, missing = difference(ramps, i, diagram)
            self.compared += 1
            self.worst = max(self.worst, apart)
            if missing or apart > ALLOWED:
                self.note(membrane, loading, outcome, apart, missing)

    def note(self, membrane, loading, outcome, apart: float, missing: list) -> None:
        scene = describe(dj.Scene(membrane, loading))
        entry = {"scene": scene, "outcome": outcome.name, "difference": apart, "missing": missing}
        self.differing.append(entry)
        harness.say(entry)


class OnSurface:
    """What the surfaces say of all scenes, counted."""

    def __init__(self):
        self.outcomes: collections.Counter = collections.Counter()
        self.build, self.watch = harness.Stopwatch(), harness.Stopwatch()
        self.largest_bound, self.half_decided = 0.0, 0

    def ramps(self, membrane, loadings: list) -> list:
        """(ramps, loadings) of the chambers and of the constant pressures on one membrane."""
        surface = self.build.time(dj.Surface.build, membrane, cache=False)
        list(batches(surface, [*loadings[:1], *loadings[-1:]]))  # compiles
        done = self.watch.time(lambda: list(batches(surface, loadings)))
        for ramps, _ in done:
            self.outcomes.update(Outcome(int(o)).name for o in ramps.outcome)
            decided = ramps.outcome != Outcome.unresolved
            self.largest_bound = max(self.largest_bound, float(np.max(ramps.error[decided], initial=0.0)))
            # a scene that is decided has a start, and one that is not has no number at all
            started = np.isfinite(ramps.start.volume)
            self.half_decided += int((decided & ~started).sum() + (~decided & np.isfinite(ramps.area_strain)).sum())
        return done


def sample_of(ramps, count: int, random) -> list:
    """Lanes of ramps: a third of them, as far as there are so many, of those that the surface leaves unresolved."""
    decided = ramps.outcome != Outcome.unresolved
    lost, known = np.flatnonzero(~decided), np.flatnonzero(decided)
    third = min(len(lost), count // 3)
    return [*random.permutation(known)[: count - third], *random.permutation(lost)[:third]]


def records_of(on_surface: OnSurface, continuation: Continuation, compile_seconds: float) -> list[dict]:
    """The record of the surfaces, and that of the sample."""
    total, watch = sum(on_surface.outcomes.values()), continuation.watch
    outcomes = {o.name: on_surface.outcomes[o.name] for o in Outcome}
    return [
        {
            "name": "hard_scenes: ramps",
            "engine": "surface",
            "error": on_surface.largest_bound,
            "seconds_per_diagram": on_surface.watch.seconds / total,
            "build_seconds": on_surface.build.seconds,
            "compile_seconds": compile_seconds,
            "counts": {"scenes": total, **outcomes, "half_decided": on_surface.half_decided},
            "machine": harness.machine(),
        },
        {
            "name": "hard_scenes: sample",
            "engine": "continuation",
            "error": continuation.worst,
            "seconds_per_diagram": watch.seconds / max(watch.count, 1),
            "compile_seconds": compile_seconds,
            "counts": {
                "diagrams": watch.count,
                "compared": continuation.compared,
                "differing": len(continuation.differing),
                "not_complete": continuation.incomplete,
                **{name: dict(counter) for name, counter in continuation.counts.items()},
            },
            "differing": continuation.differing,
            "machine": harness.machine(),
        },
    ]


def main() -> int:
    parser = harness.arguments(__doc__, "64 scenes of one membrane, a sample of 4", seed=True)
    parser.add_argument("--scenes", type=int, default=100_000, help="number of random scenes")
    parser.add_argument("--sample", type=int, default=300, help="scenes that the continuation decides")
    parser.add_argument("--membranes", type=int, default=10)
    options = parser.parse_args()
    scenes, sample, count = (64, 4, 1) if options.quick else (options.scenes, options.sample, options.membranes)
    harness.say(f"seed {options.seed}, {scenes} scenes, {count} membranes, {sample} by continuation")
    common = {"parameters": {"scenes": scenes, "sample": sample, "membranes": count, "seed": options.seed}}
    random = np.random.default_rng(options.seed)
    compiled, on_surface, continuation = harness.Compilations(), OnSurface(), Continuation()
    document: dict = {"name": "hard_scenes", "records": []}
    for number, membrane in enumerate(gent_films(random, count)):
        loadings = film_loadings(random, membrane, max(1, scenes // count))
        for ramps, part in on_surface.ramps(membrane, loadings):
            share = max(1, round(sample * len(part) / len(loadings) / count))
            for i in sample_of(ramps, share, random):
                continuation.decide(membrane, part[int(i)], ramps, int(i))
        outcomes = dict(on_surface.outcomes)
        harness.say(f"membrane {number + 1} of {count}: {outcomes}, worst {continuation.worst:.1e}")
        document["records"] = [r | common for r in records_of(on_surface, continuation, compiled.seconds)]
        harness.write(document, options.json, partial=True)
    for r in document["records"]:
        harness.say(r["name"], r["counts"], f"error {r['error']:.1e}")
    return harness.finish(document, options.json, not continuation.differing and on_surface.half_decided == 0)


if __name__ == "__main__":
    sys.exit(main())
