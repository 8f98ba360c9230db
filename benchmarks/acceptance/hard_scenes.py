"""What becomes of a hundred thousand random scenes, and do the engines agree where one of them decides?

Random membranes (prestretch 1 to 3, limiting stretch J from 50 to 1000) with random chambers and pressures, all on the
surface ramps; each outcome is counted. Of a sample the continuation draws the whole diagram: of the scenes that the surface
decides the two are compared as in `ensemble.py`, of those it leaves `unresolved` the continuation's own end is counted. Codes
at the ends of branches, flags, refusals and diagrams that are not complete are counted too.

    python -m benchmarks.acceptance.hard_scenes [--scenes 100000] [--sample 300] [--membranes 10] [--seed 0] [--json FILE|-] [--quick]
"""

import argparse
import collections
import math
import sys
import time

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.acceptance.ensemble import ALLOWED, batches, difference, random_loadings
from benchmarks.harness import machine, write
from dielectric_jax import SceneError
from dielectric_jax.model import Outcome, describe

jax.config.update("jax_enable_x64", True)

compiled = {"seconds": 0.0}


def _listen(event, seconds, **_):
    if event == "/jax/core/compile/backend_compile_duration":
        compiled["seconds"] += seconds


jax.monitoring.register_event_duration_secs_listener(_listen)


def draw(count: int, random) -> list:
    """Random membranes; the first is that of the paper."""
    drawn = zip(
        random.uniform(1, 3, count - 1), np.exp(random.uniform(np.log(50), np.log(1000), count - 1)), strict=True
    )
    return [dj.Membrane(), *(dj.Membrane(prestretch=w, material=dj.Gent(stretch_limit=j)) for w, j in drawn)]


class Continuation:
    """What the continuation says of the sample, counted."""

    def __init__(self):
        self.counts = {
            name: collections.Counter()
            for name in ("ends", "flags", "refusals", "reasons_resolved", "reasons_unresolved")
        }
        self.differing: list[dict] = []
        self.worst = self.seconds = 0.0
        self.compared = self.incomplete = self.drawn = 0

    def decide(self, membrane, loading, ramps, i: int) -> None:
        """Draws one diagram and compares it with the surface's ramp where there is one."""
        outcome = Outcome(int(ramps.outcome[i]))
        begin = time.perf_counter()
        try:
            diagram = dj.voltage_volume(dj.Scene(membrane, loading))
        except (SceneError, ValueError) as refusal:
            code = getattr(getattr(refusal, "code", None), "name", "ValueError")
            self.counts["refusals"][f"{outcome.name}: {code}"] += 1
            if outcome is not Outcome.unresolved:
                self.note(membrane, loading, outcome, math.inf, [str(refusal)])
            return
        finally:
            self.seconds += time.perf_counter() - begin
            self.drawn += 1
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
        print(entry, file=sys.stderr, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=100_000, help="number of random scenes")
    parser.add_argument("--sample", type=int, default=300, help="scenes that the continuation decides")
    parser.add_argument("--membranes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="64 scenes of one membrane, a sample of 4")
    options = parser.parse_args()
    scenes, sample, count = (64, 4, 1) if options.quick else (options.scenes, options.sample, options.membranes)
    print(f"seed {options.seed}, {scenes} scenes, {count} membranes, {sample} by continuation", file=sys.stderr)
    random = np.random.default_rng(options.seed)
    outcomes, continuation = collections.Counter(), Continuation()
    bounds, seconds, build, nan_numbers = [], 0.0, 0.0, 0
    for number, membrane in enumerate(draw(count, random)):
        begin = time.perf_counter()
        surface = dj.Surface.build(membrane, cache=False)
        build += time.perf_counter() - begin
        loadings = random_loadings(membrane, max(1, scenes // count), random)
        list(batches(surface, [*loadings[:1], *loadings[-1:]]))  # compiles
        begin = time.perf_counter()
        done = list(batches(surface, loadings))
        seconds += time.perf_counter() - begin
        for ramps, part in done:
            outcomes.update(Outcome(int(o)).name for o in ramps.outcome)
            decided = ramps.outcome != Outcome.unresolved
            bounds.append(float(np.max(ramps.error[decided], initial=0.0)))
            # a scene that is told has a start, and one that is not has no number at all
            told = np.isfinite(ramps.start.volume)
            nan_numbers += int((decided & ~told).sum() + (~decided & np.isfinite(ramps.area_strain)).sum())
            share = max(1, round(sample * len(part) / len(loadings) / count))
            lost = np.flatnonzero(~decided)
            known = np.flatnonzero(decided)
            third = min(len(lost), share // 3)
            some = [*random.permutation(known)[: share - third], *random.permutation(lost)[:third]]
            for i in some:
                continuation.decide(membrane, part[int(i)], ramps, int(i))
        print(
            f"membrane {number + 1} of {count}: {dict(outcomes)}, worst {continuation.worst:.1e}",
            file=sys.stderr,
            flush=True,
        )
        total = sum(outcomes.values())
        common = {"parameters": {"scenes": scenes, "sample": sample, "membranes": count, "seed": options.seed}}
        records = [
            {
                "name": "hard_scenes: ramps",
                "engine": "surface",
                "error": max(bounds),
                "seconds_per_diagram": seconds / total,
                "build_seconds": build,
                "compile_seconds": compiled["seconds"],
                "counts": {"scenes": total, **{o.name: outcomes[o.name] for o in Outcome}, "half_told": nan_numbers},
                "machine": machine(),
            },
            {
                "name": "hard_scenes: sample",
                "engine": "continuation",
                "error": continuation.worst,
                "seconds_per_diagram": continuation.seconds / max(continuation.drawn, 1),
                "compile_seconds": compiled["seconds"],
                "counts": {
                    "diagrams": continuation.drawn,
                    "compared": continuation.compared,
                    "differing": len(continuation.differing),
                    "not_complete": continuation.incomplete,
                    **{name: dict(counter) for name, counter in continuation.counts.items()},
                },
                "differing": continuation.differing,
                "machine": machine(),
            },
        ]
        document = {"name": "hard_scenes", "records": [{**r, **common} for r in records]}
        write(document, options.json, partial=True)
    write(document, options.json)
    for r in records:
        print(r["name"], r["counts"], f"error {r['error']:.1e}", file=sys.stderr)
    wrong = bool(continuation.differing) or nan_numbers > 0
    print("FAILED" if wrong else "PASSED", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
