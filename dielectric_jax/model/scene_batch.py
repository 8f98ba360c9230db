"""Scenes as columns of numbers, and their points made exact: the grids that each point needs, its error, its index."""

import dataclasses
import typing

import jax
import numpy as np

from ..numerics import calls_of, lanes_of_a_call, run_lanes
from .corrector import Correction, Goals, Linearised, Start, correct_program, limits_program, newton_program
from .kinds import ClosingEquation
from .loading import LoadingCondition
from .materials import largest_load
from .membrane import Membrane
from .resolution import (
    CHUNK,
    CONE_LOAD,
    CONTRACTION,
    GRIDS,
    GRIDS_ANEW,
    LAYER_LOADS,
    LAYER_STRETCH,
    MOST_SPREAD,
    NEWTON_ROUNDS,
    SCALE,
    SETTLED,
    SETTLED_SHARES,
    SPLIT,
    STRETCHES_TOGETHER,
    TURNS,
    WORSE,
)

__all__ = ["LANES", "Corrected", "SceneBatch", "calls", "difficulty", "load_fraction", "locking_stretch", "pick"]

LANES = 256  # of one call of a batch: what fits the cache


def pick(tree, which):
    """The lanes `which` of a module whose leaves are columns."""
    return jax.tree.map(lambda v: v[which], tree)


def calls(which: np.ndarray, sizes: tuple[int, ...] = (CHUNK, LANES)):
    """The lanes of one call of a batch after the other."""
    sizes = tuple(map(lanes_of_a_call, sizes))
    for begin, size in calls_of(len(which), sizes, SPLIT / LANES) if len(which) else ():
        yield which[begin : begin + size]


def padded(which: np.ndarray) -> np.ndarray:
    """The lanes of one call of a batch, and the last of them again up to the size that is compiled."""
    size = next(s for s in map(lanes_of_a_call, (CHUNK, LANES)) if len(which) <= s)
    return np.pad(which, (0, size - len(which)), mode="edge")


def locking_stretch(membrane: Membrane) -> float:
    """λa beyond which an inner layer forms at a high load."""
    return LAYER_STRETCH * membrane.lock_up_stretch()[0]


def difficulty(locks_from, apex_stretch: np.ndarray, load_fraction: np.ndarray) -> np.ndarray:
    """Which sequence of grids resolves the membrane, an index of `GRIDS` for each lane; see `locking_stretch`."""
    locking = apex_stretch > locks_from
    return (
        (locking & (load_fraction > LAYER_LOADS[0])).astype(int)
        + (locking & (load_fraction > LAYER_LOADS[1]))
        + 2 * (~locking & (load_fraction > CONE_LOAD))
    )


def load_fraction(membrane: Membrane, u: np.ndarray) -> np.ndarray:
    """t = q/q_max(λa) of points (3, lanes)."""
    return u[2] / largest_load(membrane.material, np.nan_to_num(u[0], nan=2.0))


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

    def store(self, now, found: Correction) -> None:
        """Keeps what was found for the lanes `now`."""
        for column, values in zip(self, found, strict=False):  # what is left belongs to Newton
            column[now] = values.T

    @staticmethod
    def nothing(lanes: int) -> "Corrected":
        """Lanes of which nothing is known yet."""
        none = np.full(lanes, np.nan)
        three = np.full((lanes, 3), np.nan)
        index = np.full(lanes, -1)
        numbers = {n: none.copy() for n in ("volume", "volume_rate", "spread")}
        return Corrected(u=three, tangent=three.copy(), index=index, error=none + np.inf, ok=index > 0, **numbers)


# difficulty and steps of the grids in the order in which they are tried, and where each difficulty begins
_STAGES = [(level, *pair) for level, pairs in enumerate(GRIDS_ANEW) for pair in pairs]
_FIRST = np.searchsorted([level for level, *_ in _STAGES], np.arange(len(GRIDS_ANEW) + 1))


def _begin(u, rows, targets, kinds) -> tuple[Start, Goals]:
    """Where Newton begins, and for what, from u (lanes, 3) and rows (lanes, 3)."""
    lanes = len(u)
    return Start(u.T.copy(), np.tile([[0.0], [0.0], [1.0]], (1, lanes)), np.ones(lanes)), Goals(rows.T, targets, kinds)


def _rounds(steps: tuple) -> tuple[np.ndarray, int]:
    """The grids of steps of Newton as `newton_program` is compiled for them, and their number."""
    return np.pad(np.array(steps, float), (0, max(NEWTON_ROUNDS) - len(steps))), len(steps)


@dataclasses.dataclass
class SceneBatch:
    """Scenes as columns: leaves of shape (scenes,); `locks_from` is where an inner layer may form, see `locking_stretch`.

    `sizes` are the lanes of its calls, which are made one after the other, as batches have threads of their own. A scene
    `alone` keeps its numbers as scalars, which its programs use faster, and its calls are made side by side.
    """

    membrane: Membrane
    condition: LoadingCondition
    locks_from: np.ndarray
    sizes: tuple[int, ...] = (CHUNK, LANES)
    alone: bool = False

    @staticmethod
    def of_one(membrane: Membrane, condition: LoadingCondition) -> "SceneBatch":
        """The batch of one scene."""
        return SceneBatch(membrane, condition, np.array([locking_stretch(membrane)]), (CHUNK,), alone=True)

    def limits(self, apex: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Breakdown load at the apex, its slope, and the largest load (3, points) at stretches of scenes `which`."""
        if not len(apex):
            return np.empty((3, 0))

        def limits(part):
            return limits_program(pick(self.membrane, part[0]), part[1])

        return np.stack(run_lanes(limits, (which, apex), sizes=STRETCHES_TOGETHER, parallel=False))

    def load_fraction(self, u: np.ndarray, which: np.ndarray) -> np.ndarray:
        """t = q/q_max(λa) at u (lanes, 3) of scenes `which`."""
        apex = np.nan_to_num(u[:, 0], nan=2.0)
        largest = largest_load(self.membrane.material, apex) if self.alone else self.limits(apex, which)[2]
        return np.nan_to_num(u[:, 2] / largest)

    def correct(self, which, u, rows, targets, kinds, *, tolerance: float, reach) -> Corrected:
        """States of scenes `which` from u (lanes, 3) with row·u = target, or what `kinds` says."""
        return self._correct(which, *_begin(u, rows, targets, kinds), NEWTON_ROUNDS[0], tolerance, reach)

    def newton(self, which, u, rows, targets, kinds, *, level: int, reach: float) -> tuple[Linearised, np.ndarray]:
        """Newton alone on the grids of a difficulty, then on the last of them while it goes on: states, and which have converged.

        `reach` bounds the distance from u in scaled unknowns.
        """
        (start, goals), steps = _begin(u, rows, targets, kinds), GRIDS[level][0]
        active, last = np.arange(len(which)), np.full(len(which), np.inf)
        converged = np.zeros(len(which), bool)
        found = self._newton(which, start, goals, active, steps)
        for turn in range(TURNS):
            grids = (steps[-1],) * len(steps)
            at = self._newton(which, start, goals, active, grids) if turn else jax.tree.map(np.copy, found)
            for store, values in zip(found, at, strict=True):
                store[..., active] = values
            start.u[:, active] = at.u
            with np.errstate(invalid="ignore", divide="ignore"):
                near = np.linalg.norm((at.u.T - u[active]) / SCALE, axis=1) <= reach
                size = np.linalg.norm(at.move, axis=0)
                # towards the flat state the equations bend at the scale of λa − λ0 and p themselves
                room = np.stack([at.u[0] - self.membrane.prestretch, at.u[1]])
                share = np.max(np.abs(at.move[:2] * SCALE[:2, None] / room), axis=0)
                converged[active] = near & (size < SETTLED) & (share < SETTLED_SHARES[level])
                going = near & ~converged[active] & (size < last[active])
            last[active] = size
            active = active[going]
            if not len(active):
                break
        return found, converged

    def linearise(self, which, u, steps: float) -> Linearised:
        """Newton's linearisation at exact points u (lanes, 3) on a grid of `steps`."""
        lanes = len(which)
        start, goals = _begin(u, np.tile([0.0, 0.0, 1.0], (lanes, 1)), u[:, 2], np.full(lanes, ClosingEquation.level))
        return self._newton(which, start, goals, np.arange(lanes), (steps,))

    def _newton(self, which, start: Start, goals: Goals, now, steps: tuple) -> Linearised:
        """Newton on the lanes `now`, one step on each of the grids of `steps`."""

        def run(part):
            scenes = self._scenes(which[part])
            return newton_program(*scenes, *jax.tree.map(lambda v: v[..., part], (start, goals)), *_rounds(steps))

        return run_lanes(run, now, sizes=self.sizes, parallel=self.alone)

    def correct_folds(self, which, u, tangents, slopes, *, tolerance: float, reach) -> Corrected:
        """Folds of q of scenes `which` from u (lanes, 3), unit tangents there, and d(dq)/ds along them."""
        lanes = len(which)
        goals = Goals(np.zeros((3, lanes)), np.zeros(lanes), np.full(lanes, ClosingEquation.fold))
        start = Start(u.T.copy(), tangents.T, slopes.copy())
        return self._correct(which, start, goals, NEWTON_ROUNDS[1], tolerance, reach)

    def _scenes(self, own):
        return (self.membrane, self.condition) if self.alone else (pick(self.membrane, own), pick(self.condition, own))

    def _correct(self, which, start: Start, goals: Goals, rounds: int, tolerance, reach) -> Corrected:
        """Newton on one pair of grids after the other until the estimate meets the tolerance; lanes that fail end."""
        lanes, end = len(which), len(_STAGES)
        corrected, first = Corrected.nothing(lanes), start.u.copy()
        if not lanes:
            return corrected

        def run(part, grid):
            at, goal = jax.tree.map(lambda v: v[..., part], (start, goals))
            return correct_program(*self._scenes(which[part]), at, goal, rounds, grid)

        stage = _FIRST[difficulty(self.locks_from[which], first[0], self.load_fraction(first.T, which))]
        turns, strayed, last = np.zeros(lanes, int), np.zeros(lanes, bool), np.full(lanes, np.inf)
        reach = np.broadcast_to(reach, (lanes,))
        while (stage < end).any():
            s = int(stage.min())
            level, coarse, fine = _STAGES[s]
            todo = np.flatnonzero(stage == s)
            # who goes on rides along with fresh ones
            now = next(calls(todo[np.argsort(turns[todo], kind="stable")], self.sizes))
            grid = coarse, fine, CONTRACTION[level]
            found = run_lanes(lambda part, grid=grid: run(part, grid), now, sizes=self.sizes, parallel=self.alone)
            corrected.store(now, found)
            start.u[:, now], start.slope[now] = (
                found.u,
                np.where(np.isfinite(found.slope), found.slope, start.slope[now]),
            )
            with np.errstate(invalid="ignore"):
                lost = ~np.isfinite(found.u).all(axis=0)
                lost |= ~(np.linalg.norm((found.u - first[:, now]) / SCALE[:, None], axis=0) <= reach[now])
            settled = ~lost & found.settled
            good = settled & (found.error <= tolerance) & (found.spread <= MOST_SPREAD)
            turns[now] += 1
            again = ~lost & ~settled & (turns[now] < TURNS) & (found.size < last[now] / 2)  # Newton is under way
            last[now] = np.where(again, found.size, np.inf)
            start.u[:, now[lost]] = first[:, now[lost]]
            # who is lost is so for want of resolution, if at all: once more, on the next level
            later = np.where(lost, np.where(strayed[now], end, _FIRST[level + 1]), s + 1)
            good |= settled & (s + 1 in _FIRST) & (found.error <= WORSE * tolerance)
            strayed[now] |= lost
            stage[now] = np.where(good, end, np.where(again, s, later))
            turns[now[~again]] = 0
            corrected.ok[now] = good
        return corrected
