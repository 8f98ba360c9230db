"""Where does the time of one chamber in a batch by continuation go? Why it is not less than it is.

The 256 chambers of `batch_diagrams.py` on one core, call by call: marching along the branch, events by Newton and the
residual on a finer grid, reading breakdown loads, and the host's own work. What a right-hand side costs inside such a call and in
a batch of states alone is the least that each phase can take. The error of the snaps against `data/chambers.csv` stands beside.

    DIELECTRIC_JAX_CORES=1 taskset -c 0 python -m benchmarks.speed.lane_profile [--json FILE|-] [--quick]
"""

import functools
import os
import sys

os.environ.setdefault("DIELECTRIC_JAX_CORES", "1")

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.speed.batch_diagrams import scenes_of
from benchmarks.speed.shots import MATERIAL, SHORTEST, States
from benchmarks.truth import chambers
from dielectric_jax.diagram import batch
from dielectric_jax.diagram.resolution import PASSES
from dielectric_jax.model import scene_batch
from dielectric_jax.model.shooting import UNKNOWNS, integrate_membrane
from dielectric_jax.numerics.compiled import cached_jit

jax.config.update("jax_enable_x64", True)

STAGES = 13  # right-hand sides of a step of Dopri8
LANES = 256


class Meter:
    """Seconds, calls, lanes with their padding, and linearisations' right-hand sides of one program."""

    def __init__(self, module, name: str, sides):
        self.module, self.name, self.sides = module, name, sides
        self.program = getattr(module, name)
        self.reset()

    def reset(self) -> None:
        self.watch, self.lanes, self.evaluations = harness.Stopwatch(), 0, 0.0

    def __enter__(self):
        setattr(self.module, self.name, functools.wraps(self.program)(self))
        return self

    def __exit__(self, *_):
        setattr(self.module, self.name, self.program)

    def __call__(self, *args):
        found = self.watch.time(self.program, *args)
        count, sides = self.sides(*args)
        self.lanes, self.evaluations = self.lanes + count, self.evaluations + count * sides
        return found


def march_sides(membrane, condition, limits, walk, peak, grid):
    return len(peak), PASSES * grid.steps * STAGES


def correction_sides(membrane, condition, begin, goals, rounds, grid):
    # without derivatives the residual costs two fifths
    return begin[0].shape[1], (rounds * grid[0] + grid[1] / 2.6) * STAGES


def right_hand_side() -> float:
    """Seconds of one right-hand side with three derivatives, in a batch of states alone."""
    states = States(LANES)
    u = np.stack([states.apex, states.p, states.q])

    @cached_jit  # as the batch's programs are compiled
    def program(u, steps):
        shot = integrate_membrane(MATERIAL, *u, steps, sensitivities=UNKNOWNS)
        return [shot.sensitivities[name] for name in UNKNOWNS]

    return harness.timed(lambda: program(u, 48.0), 5, shortest=SHORTEST).best / (LANES * 48 * STAGES)


def main() -> int:
    parser = harness.arguments(__doc__, "32 chambers, one round")
    options = parser.parse_args()
    known = chambers.reference()
    volumes = sorted(known)[:: 8 if options.quick else 1]
    scenes = scenes_of(volumes)
    meters = {
        "march": Meter(batch, "march_program", march_sides),
        "events": Meter(scene_batch, "correct_program", correction_sides),
        "loads": Meter(scene_batch, "limits_program", lambda membrane, apex: (len(apex), 0)),
    }

    def continued():
        for meter in meters.values():
            meter.reset()
        found = dj.continue_scenes(scenes)
        return found, {n: (m.watch.seconds, m.watch.count, m.lanes, m.evaluations) for n, m in meters.items()}

    with meters["march"], meters["events"], meters["loads"]:
        timing = harness.timed(continued, 1 if options.quick else 5)
    whole, (found, best) = timing.best, timing.value_of_best
    side, count = right_hand_side(), len(scenes)
    records = [
        {
            "phase": name,
            "ms_a_diagram": 1e3 * seconds / count,
            "share": seconds / whole,
            "calls": calls,
            "lanes_with_padding": padded,
            "right_hand_sides_a_diagram": evaluations / count,
            "ms_a_diagram_of_right_hand_sides_alone": 1e3 * evaluations * side / count,
        }
        for name, (seconds, calls, padded, evaluations) in best.items()
    ]
    rest = whole - sum(seconds for seconds, *_ in best.values())
    records.append({"phase": "host", "ms_a_diagram": 1e3 * rest / count, "share": rest / whole})
    snaps = [known[v].folds[0][0] ** 0.5 if known[v].folds else np.nan for v in volumes]
    error = float(np.nanmax(np.abs(found.ramps.snap.voltage[:, 0] - snaps)))
    document = {
        "name": "lane_profile",
        "parameters": {"chambers": count, "cores": os.environ["DIELECTRIC_JAX_CORES"]},
        "ms_a_diagram": 1e3 * whole / count,
        "error": error,
        "right_hand_side_us": 1e6 * side,
        "records": records,
        "machine": harness.machine(),
    }
    harness.say(f"{1e3 * whole / count:.2f} ms a diagram; largest error of a snap's voltage {error:.1e}")
    harness.say(f"a right-hand side with three derivatives, states alone: {1e6 * side:.3f} µs")
    harness.say(f"{'':10}{'ms':>8}{'share':>8}{'calls':>8}{'lanes':>9}{'sides':>9}{'ms alone':>10}")
    for r in records:
        line = f"{r['phase']:10}{r['ms_a_diagram']:8.2f}{r['share']:8.2f}"
        if "calls" in r:
            line += f"{r['calls']:8d}{r['lanes_with_padding']:9d}{r['right_hand_sides_a_diagram']:9.0f}"
            line += f"{r['ms_a_diagram_of_right_hand_sides_alone']:10.2f}"
        harness.say(line)
    return harness.finish(document, options.json, error < 1e-8)


if __name__ == "__main__":
    sys.exit(main())
