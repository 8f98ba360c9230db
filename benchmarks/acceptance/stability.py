"""Is the stability index of a state the number of negative eigenvalues of the energy's second variation?

Random states of random Gent membranes, each under prescribed pressure, in a chamber and at prescribed volume, at controlled
voltage and at controlled charge: the package's `stability_of` against a Ritz discretisation that shares no code
with it (`ritz.py`). Where the two differ the Ritz count is taken again on three times as many elements, and nine.

    python -m benchmarks.acceptance.stability [--states 10000] [--seed 0] [--first 0] [--json FILE|-] [--quick]
"""

import collections
import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import explicit, harness
from benchmarks.random_scenes import film_states
from benchmarks.truth.ritz import ELEMENTS, Ritz
from dielectric_jax.model.stability import judge, survey

jax.config.update("jax_enable_x64", True)

EACH = 20  # states of a membrane
STRATA = {"even": 0.55, "towards the cone": 0.25, "flat end": 0.1, "lock-up": 0.1}  # shares of the states
HELD = ("pressure", "chamber", "volume")
_UNSURE = 1e-9  # an eigenvalue of the scaled matrix below which its sign is not known
_DEFECT = 1e-5  # of λ2 at the rim
_RESOLVED = 1e-9  # change of the pressure from a coarser grid


def equilibria(states: dict) -> dict:
    """The states with pressure and volume by the explicit map; NaN where it does not resolve them."""
    columns = [states[n] for n in ("stretch_limit", "apex_stretch", "q", "prestretch")]
    coarse, (p, v, slope) = (
        explicit.in_chunks(lambda *part, n=steps: explicit.of_gent(*part, n), columns, 256) for steps in (200.0, 320.0)
    )
    with np.errstate(all="ignore"):
        good = (slope < 0) & (p > 0) & np.isfinite(v) & (np.abs(coarse[0] / p - 1) < _RESOLVED)
    return states | {"pressure": np.where(good, p, np.nan), "volume": np.where(good, v, np.nan)}


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


class Tally:
    """The package's answers beside the Ritz counts, counted, and those that differ."""

    NAMES = ("states", "not_resolved", "answers", "not_valid", "valid", "wrinkled", "equal")
    NAMES += ("equal_on_finer", "ritz_unsure", "wrong")

    def __init__(self, states: dict):
        self.states = states
        self.counts, self.by_index, self.reasons = (collections.Counter() for _ in range(3))
        self.differing: list[dict] = []

    def add(self, which: np.ndarray) -> None:
        """Judges the states `which` of one membrane."""
        self.counts["states"] += len(which)
        reached = np.isfinite(self.states["pressure"][which])
        self.counts["not_resolved"] += int((~reached).sum())
        which = which[reached]
        if not len(which):
            return
        answers, truths = ours(self.states, which), ritz_of(self.states, which)
        for name, answer in answers.items():
            index, least = truths[name]
            for k, one in enumerate(answer):
                self.counts["answers"] += 1
                self.reasons.update(one.reasons)
                if not one.valid:
                    self.counts["not_valid"] += 1
                    continue
                self.counts["valid"] += 1
                self.counts["wrinkled"] += one.wrinkled
                if one.index == index[k] and least[k] > _UNSURE:
                    self.counts["equal"] += 1
                    self.by_index[one.index] += 1
                else:
                    self.differ(which[k : k + 1], name, one.index, {"ritz": index[k], "eigenvalue": least[k]})

    def differ(self, which: np.ndarray, name: tuple, index: int, ritz: dict) -> None:
        """One state again on more elements, under the loading of that name."""
        finer = sharper = None
        for factor in (3, 9):  # towards the cone eigenvalues still fall at three times the elements
            finer, sharper = (v[0] for v in ritz_of(self.states, which, factor * ELEMENTS)[name])
            if finer == index:
                break
        verdict = "ritz_unsure" if not sharper > _UNSURE else "equal_on_finer" if finer == index else "wrong"
        self.counts[verdict] += 1
        if verdict == "equal_on_finer":
            self.by_index[index] += 1
        record = {n: values[which[0]] for n, values in self.states.items()}
        record |= {"held": name[0], "control": name[1], "ours": index}
        self.differing.append(record | ritz | {"finer": finer, "finer_eigenvalue": sharper, "verdict": verdict})


def main() -> int:
    parser = harness.arguments(__doc__, "two membranes", seed=True)
    parser.add_argument("--states", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="the first state that is judged")
    args = parser.parse_args()
    count = 2 * EACH if args.quick else args.states
    report = harness.Progress()
    tally = Tally(equilibria(film_states(args.seed, count, EACH, STRATA)))
    for start in range(args.first, count, EACH):
        tally.add(np.arange(start, min(start + EACH, count)))
        if start // EACH % 25 == 0:
            report(f"{start + EACH} of {count} states: {dict(tally.counts)}")
    document = {
        "name": "stability",
        "machine": harness.machine(),
        "seed": args.seed,
        "seconds": report.seconds,
        "counts": {n: tally.counts[n] for n in Tally.NAMES},
        "index": {str(k): v for k, v in sorted(tally.by_index.items())},
        "reasons": dict(tally.reasons),
        "differing": tally.differing,
    }
    report(f"{document['counts']}\nindices found: {document['index']}\nwhy not valid: {document['reasons']}")
    for record in [r for r in tally.differing if r["verdict"] == "wrong"][:20]:
        report(f"wrong: {record}")
    return harness.finish(document, args.json, tally.counts["wrong"] == 0 and tally.counts["valid"] > 0)


if __name__ == "__main__":
    sys.exit(main())
