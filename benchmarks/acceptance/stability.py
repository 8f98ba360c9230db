"""Is the stability index of a state the number of negative eigenvalues of the energy's second variation?

Random states of random Gent membranes, each under prescribed pressure, in a chamber and at prescribed volume, at controlled
voltage and at controlled charge: the package's `stability_of` against a Ritz discretisation that shares no code
with it (`ritz.py`). Where the two differ the Ritz count is taken again on three times as many elements, and nine.

    python -m benchmarks.acceptance.stability [--states 10000] [--seed 0] [--first 0] [--json FILE|-] [--quick]
"""

import argparse
import collections
import sys
import time

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.harness import machine, write
from benchmarks.truth import extended_precision as truth
from benchmarks.truth.ritz import ELEMENTS, Ritz
from dielectric_jax.model.stability import judge, survey

jax.config.update("jax_enable_x64", True)
dj.enable_compilation_cache()

EACH = 20  # states of a membrane
CROWDS = ("even", "towards the cone", "flat end", "lock-up")
HELD = ("pressure", "chamber", "volume")
_UNSURE = 1e-9  # an eigenvalue of the scaled matrix below which its sign is not told
_DEFECT = 1e-5  # of λ2 at the rim
_RESOLVED = 1e-9  # change of the pressure from a coarser grid


def draw(count: int, seed: int) -> dict:
    """Random states (count,): `EACH` of each membrane and chamber."""
    random = np.random.default_rng(seed)
    membranes = -(-count // EACH)
    rim = np.repeat(random.uniform(1, 3, membranes), EACH)[:count]
    limit = np.repeat(np.exp(random.uniform(np.log(50), np.log(1000), membranes)), EACH)[:count]
    chamber = np.repeat(np.exp(random.uniform(np.log(10), np.log(25000), membranes)), EACH)[:count]
    scene_batch = random.choice(len(CROWDS), count, p=[0.55, 0.25, 0.1, 0.1])
    t = random.uniform(-1, 0.9, count)
    t = np.where(scene_batch == 1, 1 - np.exp(random.uniform(np.log(1e-2), np.log(0.3), count)), t)
    share = random.uniform(1e-3, 0.97, count)
    share = np.where(scene_batch == 2, np.exp(random.uniform(np.log(1e-4), np.log(0.1), count)), share)
    share = np.where(scene_batch == 3, random.uniform(0.9, 0.999, count), share)
    apex = rim + share * (np.array([truth.lock_up(j) for j in limit]) - rim)
    return {"prestretch": rim, "stretch_limit": limit, "chamber_volume": chamber, "crowd": scene_batch} | {
        "apex_stretch": apex,
        "q": t * truth.largest_load(apex, limit),
        "t": t,
    }


@jax.jit
def _map(limit, apex, q, rim, steps):
    return dj.model.explicit_map(dj.Gent(limit), apex, q, rim, steps)


def equilibria(states: dict) -> dict:
    """The states with pressure and volume by the explicit map; NaN where it does not resolve them."""
    names = ("stretch_limit", "apex_stretch", "q", "prestretch")
    count, chunk = len(states["q"]), 256
    out = []
    for i in range(0, count, chunk):
        part = [np.pad(states[n][i : i + chunk], (0, max(0, i + chunk - count)), mode="edge") for n in names]
        coarse, (p, v, slope) = ([np.asarray(w)[: count - i] for w in _map(*part, steps)] for steps in (200.0, 320.0))
        with np.errstate(all="ignore"):
            good = (slope < 0) & (p > 0) & np.isfinite(v) & (np.abs(coarse[0] / p - 1) < _RESOLVED)
        out.append(np.where(good, np.stack([p, v]), np.nan))
    pressure, volume = np.concatenate(out, axis=1)
    return states | {"pressure": pressure, "volume": volume}


def loadings(chamber: float) -> dict:
    """The loadings of a membrane by what is held and what is controlled."""
    held = {
        "pressure": dj.ConstantPressure(1.0),
        "chamber": dj.Chamber(volume=chamber, initial_volume=1.0),
        "volume": dj.PrescribedVolume(1.0),
    }
    return {
        (h, c): dj.ChargeControl(held[h]) if c == "charge" else held[h] for h in HELD for c in ("voltage", "charge")
    }


def ours(states: dict, which: np.ndarray) -> dict:
    """The package's answers for the states of one membrane: a list for every loading."""
    i = which[0]
    membrane = dj.Membrane(dj.Gent(float(states["stretch_limit"][i])), float(states["prestretch"][i]))
    nothing = {"height": 0.0, "charge": 0.0, "breakdown_ratio": 0.0, "index": None, "error_estimate": 0.0}
    records = [
        dj.model.State(
            voltage_squared=float(states["q"][k]),
            pressure=float(states["pressure"][k]),
            volume=float(states["volume"][k]),
            apex_stretch=float(states["apex_stretch"][k]),
            **nothing,
        )
        for k in which
    ]
    seen = survey(membrane, records)
    every = loadings(float(states["chamber_volume"][i]))
    return {name: judge(dj.Scene(membrane, loading), records, seen) for name, loading in every.items()}


def ritz_of(states: dict, which: np.ndarray, elements: int = ELEMENTS) -> dict:
    """Ritz counts and the eigenvalues nearest to zero for the states `which`, for every loading."""
    given = (states[n][which] for n in ("apex_stretch", "pressure", "q", "stretch_limit"))
    with np.errstate(all="ignore"):
        found = Ritz(*given, elements=elements)
        stiffness = (states["pressure"][which] + 50.0) / (states["volume"][which] + states["chamber_volume"][which])
        out = {}
        for held in HELD:
            for control in ("voltage", "charge"):
                index, least = found.index(
                    stiffness=stiffness if held == "chamber" else None,
                    held_volume=held == "volume",
                    charged=control == "charge",
                )
                least = np.where(np.abs(found.rim - states["prestretch"][which]) < _DEFECT, least, np.nan)
                out[held, control] = index, least
    return out


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="the first state that is judged")
    parser.add_argument("--json", metavar="FILE|-")
    parser.add_argument("--quick", action="store_true", help="two membranes")
    args = parser.parse_args(argv)
    count = 2 * EACH if args.quick else args.states
    begin = time.perf_counter()

    def report(text):
        print(f"[{time.perf_counter() - begin:7.1f} s] {text}", file=sys.stderr, flush=True)

    states = equilibria(draw(count, args.seed))
    counts = collections.Counter(states=count - args.first)
    by_index, reasons = collections.Counter(), collections.Counter()
    differing = []
    for start in range(args.first, count, EACH):
        which = np.arange(start, min(start + EACH, count))
        reached = np.isfinite(states["pressure"][which])
        counts["not_resolved"] += int((~reached).sum())
        which = which[reached]
        if not len(which):
            continue
        answers, truths = ours(states, which), ritz_of(states, which)
        for name, answer in answers.items():
            index, least = truths[name]
            for k, one in enumerate(answer):
                counts["answers"] += 1
                reasons.update(one.reasons)
                if not one.valid:
                    counts["not_valid"] += 1
                    continue
                counts["valid"] += 1
                counts["wrinkled"] += one.wrinkled
                if one.index == index[k] and least[k] > _UNSURE:
                    counts["equal"] += 1
                    by_index[one.index] += 1
                    continue
                i = int(which[k])
                for factor in (3, 9):  # towards the cone eigenvalues still fall at three times the elements
                    finer, sharper = (v[0] for v in ritz_of(states, which[k : k + 1], factor * ELEMENTS)[name])
                    if finer == one.index:
                        break
                record = {n: states[n][i] for n in states} | {"held": name[0], "control": name[1], "ours": one.index}
                record |= {"ritz": index[k], "finer": finer, "eigenvalue": least[k], "finer_eigenvalue": sharper}
                sure = sharper > _UNSURE
                verdict = "ritz_unsure" if not sure else "equal_on_finer" if finer == one.index else "wrong"
                counts[verdict] += 1
                if verdict == "equal_on_finer":
                    by_index[one.index] += 1
                differing.append(record | {"verdict": verdict})
        if start // EACH % 25 == 0:
            report(f"{start + EACH} of {count} states: {dict(counts)}")
    names = ("states", "not_resolved", "answers", "not_valid", "valid", "wrinkled", "equal")
    names += ("equal_on_finer", "ritz_unsure", "wrong")
    document = {
        "benchmark": "stability",
        "machine": machine(),
        "seed": args.seed,
        "seconds": time.perf_counter() - begin,
        "counts": {n: counts[n] for n in names},
        "index": {str(k): v for k, v in sorted(by_index.items())},
        "reasons": dict(reasons),
        "differing": differing,
    }
    report(f"{document['counts']}\nindices met: {document['index']}\nnot valid for: {document['reasons']}")
    for record in [r for r in differing if r["verdict"] == "wrong"][:20]:
        report(f"wrong: {record}")
    write(document, args.json)
    return 0 if counts["wrong"] == 0 and counts["valid"] else 1


if __name__ == "__main__":
    sys.exit(main())
