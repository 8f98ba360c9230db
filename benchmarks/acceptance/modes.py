"""Are the modes of a state right? Random states of all materials, their spectra against those of many more functions.

Each state is asked for the lowest eigenvalues of the numbers 0 to 12 and 24, with error estimates; then of 40
functions a component and a grid of 240 steps. An index is wrong where it differs from that one though the spectrum calls it decided; an
estimate is honest where the true error is at most ten times as large. The time is that of the states side by side, warm.

    python -m benchmarks.acceptance.modes [--states 500] [--seed 0] [--json FILE|-] [--quick]
"""

import contextlib
import math
import sys
import warnings

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.random_scenes import film_of
from dielectric_jax.modes.resolution import SIZES
from dielectric_jax.modes.spectrum import Asked, level_of

jax.config.update("jax_enable_x64", True)

KINDS = "gent,neo-hookean,mooney-rivlin,ogden,eight-chain,electrostrictive"
NUMBERS = (*range(13), 24)
ALLOWED_RATIO, VOLTAGES, EACH = 10.0, 4, 64


def states_of(membrane: dj.Membrane, random) -> list:
    """Equilibria of a membrane at random voltages, stable or not, anywhere along their branches."""
    found = []
    for voltage in random.uniform(0, 0.3, VOLTAGES):
        with warnings.catch_warnings(), contextlib.suppress(dj.SceneError):
            warnings.simplefilter("ignore")
            for branch in dj.pressure_volume(membrane, float(voltage), points=EACH).branches:
                columns = zip(branch.pressure, branch.volume, branch.apex_stretch, branch.error_estimate, strict=True)
                for p, v, apex, error in columns:
                    found.append(dj.model.State(voltage**2, p, v, apex, math.nan, math.nan, math.nan, None, error))
    return found


def judged(membrane: dj.Membrane, states: list) -> tuple[dict, float]:
    """Wrong and undecided indices, and the largest ratio of true error and estimate; and the seconds of a state."""
    timing = harness.timed(lambda: dj.mode_spectrum(membrane, states, NUMBERS), 1)
    u = np.array([[s.apex_stretch, s.pressure, s.voltage_squared] for s in states])
    fine = level_of(membrane, (u, np.zeros((len(u), 4))), Asked(np.tile(NUMBERS, (len(u), 1)), 3, 1e-8), len(SIZES) - 1)
    counts = {"states": len(states), "indices": 0, "wrong": 0, "undecided": 0, "ratio": 0.0}
    for k, spectrum in enumerate(timing.value):
        exact, negative = fine.values[k][:, :3], fine.below[k][:, 1]
        decided = ~spectrum.index.mask
        counts["indices"] += len(NUMBERS)
        counts["undecided"] += int((~decided).sum())
        counts["wrong"] += int((decided & (np.asarray(spectrum.index.data) != negative)).sum())
        error = np.max(np.abs(spectrum.eigenvalues - exact) / np.maximum(np.abs(exact), 1e-3), axis=1)
        counts["ratio"] = max(counts["ratio"], float(np.max(error / spectrum.error_estimate)))
    return counts, timing.best / max(len(states), 1)


def main() -> int:
    parser = harness.arguments(__doc__, "the states of one Gent film", seed=True)
    parser.add_argument("--states", type=int, default=500)
    options = parser.parse_args()
    random, kinds = np.random.default_rng(options.seed), KINDS.split(",")[: 1 if options.quick else None]
    if options.quick:
        options.states = 1
    harness.say(f"seed {options.seed}")
    records, done, members = [], 0, 0
    while done < options.states:
        kind = kinds[members % len(kinds)]
        members += 1
        membrane = film_of(kind, random)
        states = states_of(membrane, random)[:: 16 if options.quick else 1]
        if not states:
            continue
        counts, seconds = judged(membrane, states)
        done += len(states)
        records.append({"material": kind, "milliseconds_per_state": 1e3 * seconds, **counts})
        harness.say(records[-1])
    wrong = sum(r["wrong"] for r in records)
    ratio = max(r["ratio"] for r in records)
    document = {
        "name": "modes",
        "parameters": {"states": done, "seed": options.seed, "numbers": list(NUMBERS)},
        "wrong_indices": wrong,
        "largest_ratio": ratio,
        "records": records,
        "machine": harness.machine(),
    }
    harness.say(f"{done} states, {wrong} wrong indices, largest true error / estimate {ratio:.2f}")
    return harness.finish(document, options.json, not wrong and ratio <= ALLOWED_RATIO)


if __name__ == "__main__":
    sys.exit(main())
