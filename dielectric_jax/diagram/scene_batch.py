"""Many scenes as columns of numbers, and their points made exact: the grids that each needs, its error, its index."""

import dataclasses
import typing

import jax
import numpy as np

from ..model import CONTRACTION, SCALE, ClosingEquation, LoadingCondition, Membrane, difficulty
from ..numerics import calls_of, lanes_of_a_call, run_lanes
from .batch_programs import Goals, correct_program, limits_program
from .resolution import MOST_SPREAD, NEWTON_ROUNDS, SPLIT, STRETCHES_TOGETHER, TURNS, WORSE

__all__ = ["LANES", "Corrected", "SceneBatch"]

LANES, FEW = 256, 32  # of one call: what fits the cache; where no more are left


def pick(tree, which):
    """The lanes `which` of a module whose leaves are columns."""
    return jax.tree.map(lambda v: v[which], tree)


def _sizes() -> tuple[int, int]:
    return lanes_of_a_call(FEW), lanes_of_a_call(LANES)


def calls(which: np.ndarray):
    """The lanes of one call after the other: each is padded to one of two sizes, each compiled once."""
    for begin, size in calls_of(len(which), _sizes(), SPLIT / LANES) if len(which) else ():
        yield which[begin : begin + size]


def padded(which: np.ndarray) -> np.ndarray:
    """The lanes of one call, and the last of them again up to the size that is compiled."""
    size = next(s for s in _sizes() if len(which) <= s)
    return np.pad(which, (0, size - len(which)), mode="edge")


class Corrected(typing.NamedTuple):
    """Exact points of many lanes, arrays (lanes, …); `ok` says whether Newton converged and the estimate is within the tolerance.

    `error` is that of p, V, q at fixed λa; `spread` the relative error of V that comes of not knowing where on its branch an
    event lies; of a fold its square is in the error of q.
    """

    u: np.ndarray
    volume: np.ndarray
    tangent: np.ndarray
    volume_rate: np.ndarray
    index: np.ndarray
    error: np.ndarray
    spread: np.ndarray
    ok: np.ndarray

    @staticmethod
    def nothing(lanes: int) -> "Corrected":
        none = np.full(lanes, np.nan)
        three = np.full((lanes, 3), np.nan)
        index = np.full(lanes, -1)
        numbers = {n: none.copy() for n in ("volume", "volume_rate", "spread")}
        return Corrected(u=three, tangent=three.copy(), index=index, error=none + np.inf, ok=index > 0, **numbers)


# level of difficulty, steps of Newton, of the last residual, in the order in which they are tried
_GRIDS = [
    (0, 12.0, 36.0),
    (0, 24.0, 80.0),
    (0, 48.0, 128.0),
    (1, 24.0, 64.0),
    (1, 64.0, 160.0),
    (1, 160.0, 320.0),
    (2, 80.0, 200.0),
    (2, 160.0, 320.0),
]
_LEVELS = 3
_FIRST = [next((i for i, g in enumerate(_GRIDS) if g[0] == k), len(_GRIDS)) for k in range(_LEVELS + 1)]


@dataclasses.dataclass
class SceneBatch:
    """Scenes as columns: leaves of shape (scenes,); `locks_from` is where an inner layer may form, see `locking_stretch`.

    With `alone` there is one scene, and calls have one lane.
    """

    membrane: Membrane
    condition: LoadingCondition
    locks_from: np.ndarray
    alone: bool = False

    def limits(self, apex: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Breakdown load at the apex, its slope, and the largest load (3, points) at stretches of scenes `which`."""
        count = len(apex)
        if self.alone and count == 1:
            return np.stack(limits_program(pick(self.membrane, which), apex))
        if not count:
            return np.empty((3, 0))

        def limits(part):
            return limits_program(pick(self.membrane, part[0]), part[1])

        return np.stack(run_lanes(limits, (which, apex), sizes=STRETCHES_TOGETHER, parallel=False))

    def correct(self, which, u, rows, targets, kinds, *, tolerance: float, reach) -> Corrected:
        """States of scenes `which` from u (lanes, 3) with row·u = target, or what `kinds` says."""

        def run(now, u, grid):
            own = which[now]
            nothing = np.tile([[0.0], [0.0], [1.0]], (1, len(now))), np.ones(len(now))
            goals = Goals(rows[now].T, targets[now], kinds[now])
            scenes = pick(self.membrane, own), pick(self.condition, own)
            return correct_program(*scenes, (u[now].T, *nothing), goals, NEWTON_ROUNDS[0], grid)

        return self._correct(run, which, u, tolerance, reach)

    def correct_folds(self, which, u, tangents, slopes, *, tolerance: float, reach) -> Corrected:
        """Folds of q of scenes `which` from u (lanes, 3), unit tangents there, and d(dq)/ds along them."""
        slopes = slopes.copy()

        def run(now, u, grid):
            own, lanes = which[now], len(now)
            goals = Goals(np.zeros((3, lanes)), np.zeros(lanes), np.full(lanes, ClosingEquation.fold))
            scenes = pick(self.membrane, own), pick(self.condition, own)
            return correct_program(*scenes, (u[now].T, tangents[now].T, slopes[now]), goals, NEWTON_ROUNDS[1], grid)

        return self._correct(run, which, u, tolerance, reach, slopes)

    def _correct(self, run, which, u, tolerance, reach, slopes=None) -> Corrected:
        """Newton on one pair of grids after the other until the estimate meets the tolerance; lanes that fail end."""
        lanes = len(which)
        corrected, start, u = Corrected.nothing(lanes), u, u.copy()
        if not lanes:
            return corrected
        load = u[:, 2] / self.limits(u[:, 0], which)[2]
        stage = np.array(_FIRST)[difficulty(self.locks_from[which], u[:, 0], np.nan_to_num(load))]
        turns, strayed, last = np.zeros(lanes, int), np.zeros(lanes, bool), np.full(lanes, np.inf)
        reach = np.broadcast_to(reach, (lanes,))
        while (stage < len(_GRIDS)).any():
            s = int(stage.min())
            level, coarse, fine = _GRIDS[s]
            todo = np.flatnonzero(stage == s)
            now = next(calls(todo[np.argsort(turns[todo], kind="stable")]))  # who goes on rides along with fresh ones
            found = run(now if self.alone else padded(now), u, (coarse, fine, CONTRACTION[level]))
            *parts, slope, move = (np.asarray(v).T[: len(now)] for v in found)
            u[now] = parts[0]
            for store, values in zip(corrected, parts, strict=True):
                store[now] = values
            if slopes is not None:
                slopes[now] = np.where(np.isfinite(slope), slope, slopes[now])
            with np.errstate(invalid="ignore"):
                lost = ~np.isfinite(u[now]).all(axis=1)
                lost |= ~(np.linalg.norm((u[now] - start[now]) / SCALE, axis=1) <= reach[now])
            settled = ~lost & corrected.ok[now]
            good = settled & (corrected.error[now] <= tolerance) & (corrected.spread[now] <= MOST_SPREAD)
            turns[now] += 1
            again = ~lost & ~settled & (turns[now] < TURNS) & (move < last[now] / 2)  # Newton is under way
            last[now] = np.where(again, move, np.inf)
            u[now[lost]] = start[now[lost]]
            # who is lost is so for want of resolution, if at all: once more, on the next level
            ends = s + 1 in _FIRST
            later = np.where(lost, np.where(strayed[now], len(_GRIDS), _FIRST[level + 1]), s + 1)
            good |= settled & ends & (corrected.error[now] <= WORSE * tolerance)
            strayed[now] |= lost
            stage[now] = np.where(good, len(_GRIDS), np.where(again, s, later))
            turns[now[~again]] = 0
            corrected.ok[now] = good
        return corrected
