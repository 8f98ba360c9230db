"""Points of one membrane under one loading, made exact, with every quantity of a state.

`SceneBatch` finds them by Newton on two coarse grids; then the residual alone is taken on finer grids (deferred correction),
doubling the steps until the estimate meets the tolerance, at last adaptively. Height, charge and what is least or largest
along the membrane come with the residual.
"""

import collections
import concurrent.futures
import dataclasses
import typing
from collections.abc import Callable

import jax
import numpy as np

from ..numerics import lanes_of_a_call, run_lanes
from .corrector import GridChange, estimated_error, rim_rounding
from .kinds import ClosingEquation
from .loading import ConstantVoltage, LoadingCondition
from .membrane import Membrane
from .programs import careful_program, charge_program, value_program
from .resolution import (
    ADAPTIVE,
    CHUNK,
    CONTRACTION,
    FEW_ULPS,
    GRIDS,
    HOPELESS,
    MOST_KINDS,
    NEAR_FOLD,
    REFINED,
    SCALE,
    SCANNED_LOAD,
)
from .scene_batch import SceneBatch, difficulty, load_fraction, locking_stretch
from .stability import control_rate, index_of, under_charge

__all__ = ["Points", "Shooting", "compile_ahead", "corrected_points"]


@dataclasses.dataclass
class Points:
    """States of many lanes as columns of shape (lanes,), with what locating special points needs.

    `u` is (3, lanes), `tangent` the unit null vector in scaled unknowns (lanes, 3), `error` the relative error of p, V, q
    at fixed λa, `ok` whether Newton converged. `charge_slopes` (3, lanes) are the derivatives of C = Q/Φ by (λa, p, q), NaN
    unless the charge is controlled. `index` is −1 where it is not known or not valid.
    """

    u: np.ndarray
    volume: np.ndarray
    height: np.ndarray
    charge_per_voltage: np.ndarray
    charge_slopes: np.ndarray
    hoop: np.ndarray
    field: np.ndarray
    tangent: np.ndarray
    index: np.ndarray
    error: np.ndarray
    ok: np.ndarray

    def __len__(self) -> int:
        return self.u.shape[1]

    def control(self, column: int) -> np.ndarray:
        """A control: λa, p or q, column 0 to 2, or Q² = q C² as column 3."""
        return self.u[2] * self.charge_per_voltage**2 if column == 3 else self.u[column]

    def control_slope(self, column: int) -> np.ndarray:
        """Its slope along the tangent in scaled units; that of Q² without its factor C²."""
        if column != 3:
            return self.tangent[:, column]
        along = (self.tangent * SCALE).T
        return control_rate(self.u[2], along, self.charge_per_voltage, self.charge_slopes) / SCALE[2]

    def take(self, which) -> "Points":
        """The lanes `which`, an index array or slice."""
        return Points(
            **{
                f.name: getattr(self, f.name)[..., which] if f.name != "tangent" else self.tangent[which]
                for f in dataclasses.fields(self)
            }
        )

    def place(self, condition: LoadingCondition) -> np.ndarray:
        """By what states of a loading are distinguished: the volume, or the apex stretch where the volume is held."""
        return self.u[0] if float(condition.volume_weight) != 0 else self.volume

    @staticmethod
    def join(parts: list["Points"]) -> "Points":
        """All lanes of several sets, in order."""
        return Points(
            **{
                f.name: np.concatenate([getattr(p, f.name) for p in parts], axis=0 if f.name == "tangent" else -1)
                for f in dataclasses.fields(Points)
            }
        )


def corrected_points(
    membrane: Membrane, condition: LoadingCondition, u, rows, targets, *, tolerance=1e-9, reach=1.0, refine=False
) -> Points:
    """Newton from `u` (3, lanes) onto the contour, with rows·u = targets; `rows` is (lanes, 3).

    A row of NaN asks for a volume: V = target. `reach` bounds the total correction in scaled unknowns: farther means not
    converged. `refine`, one for all or each lane, takes the state from the third grid at least, tangent and index from a
    finer one at the end, as is done near folds anyway. Lanes that fail have ok = False and never disturb the others.
    """
    _await_programs(membrane)
    u, rows, targets = np.array(u, float), np.asarray(rows, float), np.asarray(targets, float)
    refined = np.broadcast_to(refine, u.shape[1:])
    level = difficulty(locking_stretch(membrane), u[0], load_fraction(membrane, u))

    def solve(which, k):
        goal = rows[which], targets[which]
        return _Climb(membrane, condition, goal, u[:, which], k, reach).points(refined[which], tolerance)

    todo = [np.flatnonzero(level == k) for k in range(len(GRIDS))]
    order, done = [], []
    while any(len(which) for which in todo):
        groups = [(which, k) for k, which in enumerate(todo) if len(which)]
        with concurrent.futures.ThreadPoolExecutor(len(groups)) as pool:
            solved = list(pool.map(solve, *zip(*groups, strict=True)))
        todo = [np.zeros(0, int) for _ in GRIDS]
        for (which, k), points in zip(groups, solved, strict=True):
            # what a grid does not resolve goes on to the next; the finer two end at the same grid
            failed = ~points.ok | ((points.error > tolerance) & (k == 0))
            if k + 1 < len(GRIDS) and failed.any():
                todo[k + 1] = which[failed]
                which, points = which[~failed], points.take(np.flatnonzero(~failed))
            order.append(which)
            done.append(points)
    return Points.join(done).take(np.argsort(np.concatenate(order)))


class _Climb:
    """States that Newton has found on the coarse grids of one difficulty, moved by the residuals on its finer ones.

    The chord steps take Newton's Jacobian: `matrix` (lanes, 3, 3) of rim condition, loading and goal, `sensitivities`
    (3, 2, lanes). `change` is what the last finer grid changed, `chord` what the chord steps leave, relative.
    """

    def __init__(self, membrane: Membrane, condition: LoadingCondition, goal, u, level: int, reach: float):
        self.membrane, self.condition, self.level = membrane, condition, level
        self.rows, self.targets = goal
        self.by_volume = ~np.isfinite(self.rows).all(axis=1)
        self.start, self.reach, lanes = u, reach, u.shape[1]
        self.batch, self.scene = SceneBatch.of_one(membrane, condition), np.zeros(lanes, int)
        kinds = np.where(self.by_volume, ClosingEquation.volume, ClosingEquation.level)
        goals = np.nan_to_num(self.rows), self.targets, kinds
        self.at, self.settled = self.batch.newton(self.scene, u.T, *goals, level=level, reach=2 * reach)
        self.u, self.volume, self.sensitivities = self.at.u, self.at.volume, self.at.sensitivities
        self.matrix = np.moveaxis(self.at.matrix / SCALE[:, None], -1, 0)
        self.height, self.charge, self.hoop, self.field = (np.full(lanes, np.nan) for _ in range(4))
        self.charge_slopes = np.full((3, lanes), np.nan)
        self.admissible, self.elliptic = (np.zeros(lanes, bool) for _ in range(2))
        self.change = GridChange(np.full((lanes, 2), np.nan), np.full(lanes, np.nan))
        self.chord = np.zeros(lanes)
        self.estimate = np.full(lanes, np.inf)

    def points(self, refine: np.ndarray, tolerance: float) -> Points:
        """The points of all lanes; `refine` (lanes,) as in `corrected_points`."""
        self._climb(refine, tolerance)
        return self._with_tangents(refine)

    def _climb(self, refine, tolerance: float) -> None:
        """Deferred correction of the settled lanes on finer and finer grids, until their estimates meet the tolerance."""
        newton, grids = GRIDS[self.level]
        active = np.flatnonzero(self.settled)
        before = np.full(len(self.settled), newton[-1])  # steps of the grid before
        for steps in grids:
            # stresses along the membrane want one grid more than the state
            now = active[~refine[active]] if steps == grids[0] else active
            if len(now):
                # the method is of order eight
                self._correct(now, steps, tolerance, left=(2 * before[now] / steps) ** 8, last=steps == grids[-1])
                self._estimate_errors(now)
                before[now] = steps
            active = active[~(self.estimate[active] <= tolerance)]
        if self.level and len(active):
            self._correct_adaptively(active, tolerance)

    def _correct_adaptively(self, active, tolerance: float) -> None:
        """Deferred correction with adaptive steps of lanes that the finest grid has not resolved."""
        # within the scanned loads only: beyond them a branch ends where the estimate does
        scanned = load_fraction(self.membrane, self.u[:, active]) <= SCANNED_LOAD
        active = active[scanned & (self.estimate[active] < HOPELESS)]
        for exponent in ADAPTIVE:
            if not len(active):
                break
            self._correct(active, exponent, tolerance, adaptive=True)
            if exponent != ADAPTIVE[0]:
                self._estimate_errors(active)
                active = active[~(self.estimate[active] <= tolerance)]

    def _residual(self, which, steps, adaptive=False):
        """The residuals (lanes, 3) of rim condition, loading and goal, and V; what comes with them is kept."""
        program = careful_program if adaptive else value_program
        u = self.u[:, which]
        stretch_change, volume, *rest = run_lanes(lambda part: program(self.membrane, part, steps), u, sizes=CHUNK)
        stores = self.height, self.charge, self.hoop, self.field, self.admissible, self.elliptic
        for store, values in zip(stores, rest, strict=False):  # adaptive steps give the first two
            store[which] = values
        rim = stretch_change - (float(self.membrane.prestretch) - u[0])
        level = np.einsum("ij,ji->i", np.nan_to_num(self.rows[which]), u)
        goal = np.where(self.by_volume[which], volume, level) - self.targets[which]
        return np.stack([rim, self.condition.residual(u[1], volume, u[2]), goal], axis=1), volume

    def _correct(self, active, steps, tolerance, *, left: typing.Any = 1.0, adaptive=False, last=True) -> None:
        """Deferred correction on one grid: the residual there at first is kept, and the state moved to make it zero.

        `left` (lanes,) is the error that is left where the grid before had not half its steps, by that if it had. Where it is
        not the `last` grid, lanes whose estimate sends them to the next one are moved only once.
        """
        first = np.full((len(self.settled), 2), np.nan)
        working = active
        for round_ in range(6):
            residual, volume = self._residual(working, steps, adaptive)
            move = -_solve(self.matrix[working], residual)
            if round_ == 0:
                first[working] = np.reshape(left, (-1, 1)) * residual[:, :2]
                self.change.volume[working] = left * np.abs(volume - self.volume[working])
            self.u[:, working] += move.T
            self.volume[working] = volume + np.einsum("il,li->l", self.sensitivities[:, 1][:, working], move)
            # height and charge are not moved along; what the next chord step would move is smaller by the Jacobian's error
            moved = np.max(np.abs(move) / self._sizes(working), axis=1)
            chord = moved * CONTRACTION[self.level]
            again = ~((moved <= tolerance) & (chord <= 0.01 * tolerance))
            if round_ == 0 and not last:
                self.change.residual[working], self.chord[working] = np.abs(first[working]), 0.0
                self._estimate_errors(working)
                again &= ~(self.estimate[working] > tolerance)
            self.chord[working] = chord
            working = working[again]
            if not len(working):
                break
        self.change.residual[active] = np.abs(first[active])

    def _sizes(self, which) -> np.ndarray:
        """By what moves (lanes, 3) are relative: λa − λ0, of which p is a function, and p and q."""
        apex, pressure, load = self.u[:, which]
        rise = np.maximum(np.abs(apex - float(self.membrane.prestretch)), FEW_ULPS * apex)
        return np.stack([rise, *(np.maximum(np.abs(v), 1e-3) for v in (pressure, load))], axis=1)

    def _estimate_errors(self, which) -> None:
        u, volume, change = self.u[:, which], self.volume[which], GridChange(*(v[which] for v in self.change))
        linear = self.matrix[which, :2], self.sensitivities[..., which]
        slope, rounding = self.condition.slopes(volume)[1], np.asarray(rim_rounding(self.membrane, u))
        self.estimate[which] = estimated_error(u, volume, *linear, change, slope, rounding, self.chord[which])

    def _measure_charge(self, points: Points, which, steps) -> None:
        """The derivatives of C on a grid, where the charge is controlled."""
        if self.condition.control == 3 and len(which):
            _, points.charge_slopes[:, which] = run_lanes(
                lambda part: charge_program(self.membrane.material, part, steps), self.u[:, which], sizes=CHUNK
            )

    def _with_tangents(self, refine) -> Points:
        """The points, their tangents and indices from Newton's grid, and from a finer one where asked for and near folds."""
        finite = np.isfinite(self.u).all(axis=0) & np.isfinite(self.volume)
        near = np.linalg.norm((self.u - self.start).T / SCALE, axis=1) < 2 * self.reach
        index = np.asarray(index_of(self.at.zeros, self.matrix, self.sensitivities, self.volume, self.condition))
        points = Points(
            *(self.u, self.volume, self.height, self.charge, self.charge_slopes, self.hoop, self.field),
            *(self.at.tangent.T.copy(), index, self.estimate),
            ok=self.settled & finite & near & self.admissible,
        )
        settled = np.flatnonzero(points.ok)
        self._measure_charge(points, settled, GRIDS[self.level][0][0])
        with np.errstate(invalid="ignore"):
            refine = refine | (np.abs(points.control_slope(self.condition.control)) < NEAR_FOLD)
        which = settled[refine[settled]]
        if len(which):
            fine = self.batch.linearise(self.scene[which], self.u[:, which].T, REFINED[self.level])
            matrix = np.moveaxis(fine.matrix / SCALE[:, None], -1, 0)
            points.tangent[which] = fine.tangent.T
            points.index[which] = index_of(fine.zeros, matrix, fine.sensitivities, self.volume[which], self.condition)
            self._measure_charge(points, which, REFINED[self.level])
        if self.condition.control == 3:
            along = (points.tangent * SCALE).T
            points.index[:] = under_charge(points.index, along, self.u[2], self.charge, points.charge_slopes)
        points.index[~self.elliptic] = -1
        return points


def _solve(matrix, right):
    """Batched solve that gives NaN, not an exception, where a matrix is singular."""
    with np.errstate(all="ignore"):
        good = np.isfinite(matrix).all(axis=(1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(matrix))) > 1e-300)
        out = np.linalg.solve(np.where(good[:, None, None], matrix, np.eye(matrix.shape[-1])), right[..., None])
    return np.where(good[:, None], out[..., 0], np.nan)


@dataclasses.dataclass(frozen=True)
class Shooting:
    """The engine that finds states by shooting: `corrected_points` for one membrane and one loading."""

    membrane: Membrane
    condition: LoadingCondition

    def corrected_points(self, u, rows, targets, **options) -> Points:
        """States near `u` on the loading's contour with rows·u = targets; see `corrected_points`."""
        return corrected_points(self.membrane, self.condition, u, rows, targets, **options)

    def complete(self, points: Points) -> Points:
        """The points with everything a diagram shows: here they are."""
        return points


_compiling: collections.OrderedDict = collections.OrderedDict()


def compile_ahead(membrane: Membrane, more: tuple[Callable, ...] = ()) -> None:
    """Starts compiling the programs of this kind of membrane side by side, and `more`; `corrected_points` waits for its own."""
    key = jax.tree.structure(membrane)
    if key not in _compiling:
        lanes = lanes_of_a_call(CHUNK)
        u = np.tile(np.array([[float(membrane.prestretch) + 0.1], [0.1], [0.0]]), (1, lanes))
        batch = SceneBatch.of_one(membrane, ConstantVoltage(0.0).condition())
        jobs = (
            *more,
            lambda: batch.linearise(np.zeros(lanes, int), u.T, 2.0),
            lambda: value_program(membrane, u, 2.0),
        )
        pool = concurrent.futures.ThreadPoolExecutor(len(jobs))
        _compiling[key] = [pool.submit(job) for job in jobs]
        pool.shutdown(wait=False)
        while len(_compiling) > MOST_KINDS:
            _compiling.popitem(last=False)


def _await_programs(membrane: Membrane) -> None:
    for job in _compiling.get(jax.tree.structure(membrane), ()):
        job.result()
