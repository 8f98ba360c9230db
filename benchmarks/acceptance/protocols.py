"""Do runs in time end with an event and a reason, and do finer runs agree? Random protocols on random viscoelastic scenes.

Springs: Gent, neo-Hookean, Mooney–Rivlin and eight-chain, at rest and in one to three branches whose relaxation times differ by up to
10⁴; prestretch 1 to 4; chambers and constant pressures as in `one_answer`. Protocols: ramps of the voltage over eight decades of the
rate, held voltages, steps, triangles of the volume. Half of the runs start fresh. Every run is followed again with more functions and a
thirtieth of the tolerance: it must have the same events and the same reason, and events within `ALLOWED`. A run that says that it could not go on ("not converged", "landing not
found", …) is counted as open, and its scene is listed.

    python -m benchmarks.acceptance.protocols [--runs 200] [--each 5] [--kinds NAME,…] [--seed 0] [--json FILE|-] [--quick]
"""

import collections
import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.random_scenes import film_of, log_uniform, material_of, scenes_of
from dielectric_jax import rates
from dielectric_jax.model import Maxwell, Viscoelastic, describe

jax.config.update("jax_enable_x64", True)

KINDS = "gent,neo-hookean,mooney-rivlin,eight-chain"
TOLERANCE, ALLOWED = 1e-6, 1e-4
ENDS = (
    "end of the protocol",
    "at rest",
    "breakdown on the branch",
    "breakdown in the snap",
    "hoop tension lost",
    "fold at a prescribed volume",
)


def membrane_of(kind: str, branches: int, random) -> dj.Membrane:
    """A membrane whose branches have springs of the kind of the equilibrium spring."""
    film, times = film_of(kind, random), log_uniform(random, 1e-2, 1e2, branches)
    own = [Maxwell(material_of(kind, random), log_uniform(random, 0.1, 3.0) / branches, float(t)) for t in times]
    return dj.Membrane(Viscoelastic(film.material, own), film.prestretch)


PROTOCOLS = "ramp", "ramp", "hold", "steps", "triangle"


def protocol_of(kind: str, random) -> dict:
    """The protocol of a run, as the arguments of `follow`."""
    if kind == "ramp":
        return {"voltage": rates.Ramp(rate=log_uniform(random, 1e-6, 1e2))}
    level = log_uniform(random, 0.02, 0.4)
    if kind == "hold":
        return {"voltage": rates.Hold(level), "duration": 1e4}
    if kind == "steps":
        return {"voltage": rates.Steps([(level, log_uniform(random, 0.1, 100)), (0.5 * level, 10.0)])}
    low = log_uniform(random, 0.3, 3)
    return {"volume": rates.Triangle(low, low + log_uniform(random, 0.5, 20), low, rate=log_uniform(random, 1e-4, 1e2))}


def judged(run) -> dict:
    """What becomes of a run: "open", "agrees" or "differs" from a finer one, with the largest difference."""
    record = {
        "reason": run.reason,
        "events": [e.kind for e in run.events],
        "defect": run.energy_defect,
        "asked": run.protocol,
    }
    if run.reason not in ENDS:
        return record | {"found": "open"}
    error = max(rates.estimate_errors([run]))
    return record | {"found": "agrees" if error <= ALLOWED else "differs", "error": error}


def main() -> int:
    parser = harness.arguments(__doc__, "2 ramps of a Gent film of one branch", seed=True)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--each", type=int, default=5, help="runs of a membrane")
    parser.add_argument("--kinds", default=KINDS)
    options = parser.parse_args()
    kinds = ["gent"] if options.quick else options.kinds.split(",")
    count, each = (2, 2) if options.quick else (options.runs, options.each)
    protocols = PROTOCOLS[:1] if options.quick else PROTOCOLS
    random, records, members = np.random.default_rng(options.seed), [], 0
    harness.say(f"seed {options.seed}, {count} runs")
    while len(records) < count:
        kind = kinds[members % len(kinds)]
        branches = 1 if options.quick else 1 + members // len(kinds) % 3
        membrane = membrane_of(kind, branches, random)
        at_rest = dj.Membrane(membrane.material.equilibrium, membrane.prestretch)
        members += 1
        for elastic in scenes_of(at_rest, min(each, count - len(records)), True, random):
            scene, own = dj.Scene(membrane, elastic.loading), protocol_of(str(random.choice(protocols)), random)
            own |= {"start": str(random.choice(["relaxed", "fresh"])), "tolerance": TOLERANCE}
            try:
                record = judged(rates.follow(scene.membrane if "volume" in own else scene, **own))
            except (ValueError, dj.SceneError) as refusal:  # such as a volume or a filling that no membrane has
                record = {"found": "refused", "reason": str(refusal)[:120]}
            records.append(record | {"scene": describe(scene)})
            if record["found"] in ("open", "differs"):
                harness.say(records[-1])
        counts = collections.Counter(r["found"] for r in records)
        harness.say(f"{len(records)} runs, {dict(counts)}")
    differing = [r for r in records if r["found"] == "differs"]
    errors = [r["error"] for r in records if r["found"] == "agrees"]
    document = {
        "name": "protocols",
        "parameters": {"runs": count, "seed": options.seed, "kinds": kinds, "allowed": ALLOWED},
        "counts": dict(collections.Counter(r["found"] for r in records)),
        "reasons": dict(collections.Counter(r["reason"] for r in records if r["found"] != "refused")),
        "largest_error": max(errors, default=0.0),
        "median_error": float(np.median(errors)) if errors else None,
        "largest_energy_defect": max((r["defect"] for r in records if r["found"] == "agrees"), default=0.0),
        "open": [r for r in records if r["found"] == "open"],
        "differing": differing,
        "machine": harness.machine(),
    }
    return harness.finish(document, options.json, not differing)


if __name__ == "__main__":
    sys.exit(main())
