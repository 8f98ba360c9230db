"""Points made exact: batched Newton onto a loading's contour, every quantity of a state, and its error estimate.

The unknowns of a lane are u = (λa, p, q), the equations λ2(1) = λ0, the loading's condition, and one row that says
where on the contour: a hyperplane, or a value. Newton runs with exact Jacobians on a coarse grid; then the residual alone
is taken on finer grids (deferred correction), doubling the steps until the estimate meets the tolerance, at last
adaptively. Going from n/2 to n steps moves a state by δ; the method is of order eight, so the error left is about δ/256,
and δ/16 is reported, plus what rounding can do.
"""

import concurrent.futures
import dataclasses
import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import run_lanes
from .loading import LoadingCondition
from .materials import largest_load
from .membrane import Membrane
from .programs import (
    await_programs,
    careful_program,
    charge_program,
    jacobian_program,
    value_program,
)
from .resolution import (
    ADAPTIVE,
    CHUNK,
    CONE_LOAD,
    CONTRACTION,
    FEW_ULPS,
    GRIDS,
    HOPELESS,
    LAYER_LOADS,
    LAYER_STRETCH,
    LEAST_ESTIMATE,
    MOST_MOVE,
    NEAR_FOLD,
    NEWTON_TRIES,
    REFINED,
    ROUNDING,
    SAFETY,
    SCALE,
    SCANNED_LOAD,
)
from .stability import control_rate, index_of

__all__ = ["Points", "Shooting", "corrected_points", "load_fraction", "locking_stretch"]


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


def _assemble(u, stretch_change, volume, sensitivities, rim, condition):
    """Residual (lanes, 2) and Jacobian (lanes, 2, 3) of rim condition and loading."""
    by_p, by_v, by_q = condition.slopes(volume)
    residual = np.stack([stretch_change - (rim - u[0]), condition.residual(u[1], volume, u[2])], axis=1)
    of_stretch = sensitivities[:, 0].copy()
    of_stretch[0] += 1.0
    of_condition = by_v * sensitivities[:, 1]
    of_condition[1] += by_p
    of_condition[2] += by_q
    return residual, np.stack([of_stretch.T, of_condition.T], axis=1)


def _relative(move: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Largest of |move|/max(|value|, 1e-3) over λa, p, q; move (lanes, 3), u (3, lanes)."""
    return np.max(np.abs(move) / np.maximum(np.abs(u.T), 1e-3), axis=1)


def _solve(matrix, right):
    """Batched solve that gives NaN, not an exception, where a matrix is singular."""
    with np.errstate(all="ignore"):
        good = np.isfinite(matrix).all(axis=(1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(matrix))) > 1e-300)
        out = np.linalg.solve(np.where(good[:, None, None], matrix, np.eye(matrix.shape[-1])), right[..., None])
    return np.where(good[:, None], out[..., 0], np.nan)


def tangents(jacobian: np.ndarray) -> np.ndarray:
    """Unit null vectors (lanes, 3) of (lanes, 2, 3) Jacobians, in scaled unknowns."""
    a, b = (jacobian * SCALE)[:, 0], (jacobian * SCALE)[:, 1]
    null = np.cross(a, b)
    with np.errstate(all="ignore"):
        return null / np.linalg.norm(null, axis=1, keepdims=True)


class GridChange(typing.NamedTuple):
    """By how much the residuals (lanes, 2) of rim condition and loading, and V (lanes,), changed when the steps were last halved."""

    residual: typing.Any
    volume: typing.Any


def estimated_error(u, volume, jacobian, sensitivities, change: GridChange, by_v, rim, chord: typing.Any = 0.0):
    """Estimate of the largest relative error of p, V and q at fixed λa, (lanes,), never below `LEAST_ESTIMATE`.

    Of states u (3, lanes) from the `change` caused by halving the steps, the Jacobian (lanes, 2, 3), the sensitivities
    (3, 2, lanes), and what rounding can do; `by_v` is the loading's slope in V, `chord` an error that is added.
    """
    xp = jnp if isinstance(volume, jax.Array) else np
    rim_off = abs(change.residual[:, 0]) / SAFETY + ROUNDING * abs(u[0] - rim) + FEW_ULPS * abs(u[0])
    condition_off = abs(change.residual[:, 1]) / SAFETY + ROUNDING * (abs(u[1]) + abs(by_v * volume))
    of_rim, of_condition = abs(jacobian[:, 0]), abs(jacobian[:, 1])
    with np.errstate(all="ignore"):
        determinant = abs(jacobian[:, 0, 1] * jacobian[:, 1, 2] - jacobian[:, 0, 2] * jacobian[:, 1, 1])
        of_p = (of_condition[:, 2] * rim_off + of_rim[:, 2] * condition_off) / determinant
        of_q = (of_condition[:, 1] * rim_off + of_rim[:, 1] * condition_off) / determinant
        of_volume = abs(sensitivities[1, 1]) * of_p + abs(sensitivities[2, 1]) * of_q
        of_volume = of_volume + ROUNDING * abs(volume) + change.volume / SAFETY
        error = xp.stack([of_p, of_volume, of_q]) / xp.maximum(abs(xp.stack([u[1], volume, u[2]])), 1e-3)
        error = error.max(axis=0) + chord
    return xp.maximum(xp.where(xp.isnan(error), np.inf, error), LEAST_ESTIMATE)


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


def corrected_points(
    membrane: Membrane,
    condition: LoadingCondition,
    u,
    rows,
    targets,
    *,
    tolerance=1e-9,
    reach=1.0,
    refine=False,
) -> Points:
    """Newton from `u` (3, lanes) onto the contour, with rows·u = targets; `rows` is (lanes, 3).

    A row of NaN asks for a volume: V = target. `reach` bounds the total correction in scaled unknowns: farther means not
    converged. `refine`, one for all or each lane, takes the state from the third grid at least, tangent and index from a
    finer one at the end, as is done near folds anyway. Lanes that fail have ok = False and never disturb the others.
    """
    await_programs(membrane)
    u, rows, targets = np.array(u, float), np.asarray(rows, float), np.asarray(targets, float)
    refined = np.broadcast_to(refine, u.shape[1:])
    level = difficulty(locking_stretch(membrane), u[0], load_fraction(membrane, u))

    def solve(which, k):
        goal = _Goal(rows[which], targets[which])
        return _Newton(membrane, condition, goal, u[:, which], k, tolerance, reach).solve(refined[which])

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


class _Goal(typing.NamedTuple):
    """The last equation of each lane: rows·u = target with `rows` (lanes, 3), or V = target where the row is NaN."""

    rows: np.ndarray
    targets: np.ndarray

    def equation(self, which, u, volume, sensitivities):
        """Residual (lanes,) and gradient (lanes, 3) at states u (3, lanes) of the lanes `which`."""
        rows = self.rows[which]
        by_volume = ~np.all(np.isfinite(rows), axis=1)
        gradient = np.where(by_volume[:, None], sensitivities[:, 1].T, rows)
        value = np.where(by_volume, volume, np.einsum("ij,ji->i", np.nan_to_num(rows), u)) - self.targets[which]
        return value, gradient


class _Newton:
    """Newton on lanes that share one sequence of grids: their states, linearisations and error estimates so far.

    `matrix` (lanes, 3, 3) is the Jacobian of rim condition, loading and goal, `sensitivities` (3, 2, lanes) and `zeros` are
    those of `jacobian_program`. `change` is what the last finer grid changed, `chord` what the chord steps leave, relative.
    """

    def __init__(self, membrane, condition, goal: _Goal, u, level: int, tolerance: float, reach: float):
        self.membrane, self.condition, self.goal = membrane, condition, goal
        self.level, self.tolerance, self.reach = level, tolerance, reach
        self.rim = float(membrane.prestretch)
        self.u = np.array(u, float)
        self.start = self.u.copy()
        lanes = self.u.shape[1]
        self.matrix = np.full((lanes, 3, 3), np.nan)
        self.sensitivities = np.full((3, 2, lanes), np.nan)
        self.zeros = np.zeros(lanes, int)
        self.volume, self.height, self.charge, self.hoop, self.field = (np.full(lanes, np.nan) for _ in range(5))
        self.charge_slopes = np.full((3, lanes), np.nan)
        self.settled, self.admissible, self.elliptic = (np.zeros(lanes, bool) for _ in range(3))
        self.change = GridChange(np.full((lanes, 2), np.nan), np.full(lanes, np.nan))
        self.chord = np.zeros(lanes)
        self.estimate = np.full(lanes, np.inf)

    def solve(self, refine) -> Points:
        """The points of all lanes; `refine` (lanes,) as in `corrected_points`."""
        self.newton()
        self.climb(refine)
        self.refine_tangents(refine)
        return self.points()

    def _system(self, which, stretch_change, volume, sensitivities):
        """Residual (lanes, 3) and Jacobian (lanes, 3, 3) of the lanes `which`."""
        at = self.u[:, which]
        residual, jacobian = _assemble(at, stretch_change, volume, sensitivities, self.rim, self.condition)
        last, last_row = self.goal.equation(which, at, volume, sensitivities)
        return np.concatenate([residual, last[:, None]], axis=1), np.concatenate([jacobian, last_row[:, None]], axis=1)

    def _linearise(self, which, steps):
        """Residual and V of the lanes `which` on a grid; what `jacobian_program` and `_system` give is kept."""
        stretch_change, volume, self.sensitivities[..., which], self.zeros[which] = run_lanes(
            lambda part: jacobian_program(self.membrane.material, part, steps), self.u[:, which], sizes=CHUNK
        )
        residual, self.matrix[which] = self._system(which, stretch_change, volume, self.sensitivities[..., which])
        return residual, volume

    def _volume_change(self, which, move):
        """dV of moves (lanes, 3)."""
        return np.einsum("il,li->l", self.sensitivities[:, 1][:, which], move)

    def _drift(self, which: typing.Any = slice(None)):
        """The distance from the start in scaled unknowns."""
        return np.linalg.norm((self.u[:, which] - self.start[:, which]).T / SCALE, axis=1)

    def _damped(self, which, move):
        """Newton's moves (lanes, 3), shortened to half of `reach` and to stay among tensile states; and their lengths."""
        length = np.linalg.norm(move / SCALE, axis=1)
        with np.errstate(all="ignore"):
            move = move * np.minimum(1.0, 0.5 * self.reach / length)[:, None]
            # neither p nor λa − λ0 shrinks below three tenths in one move
            room = np.stack([self.u[0, which] - self.rim, self.u[1, which]], axis=1)
            share = np.where(move[:, :2] < -0.7 * room, -0.7 * room / move[:, :2], 1.0).min(axis=1)
            move = move * np.where(share > 0, share, 1.0)[:, None]
            return move, np.where(share < 1, np.maximum(length, 1e-3), length)

    def newton(self) -> None:
        """Newton with exact Jacobians on the coarsest grid; lanes that converge are `settled`."""
        active = np.arange(len(self.settled))
        size = np.full(len(active), np.inf)
        for _ in range(NEWTON_TRIES[self.level]):
            if not len(active):
                break
            residual, self.volume[active] = self._linearise(active, GRIDS[self.level][0])
            move, length = self._damped(active, -_solve(self.matrix[active], residual))
            self.u[:, active] += move.T
            self.volume[active] += self._volume_change(active, move)
            before, size[active] = size[active], length
            with np.errstate(all="ignore"):
                # the next move, where Newton converges squared
                ahead = np.where(length < 1e-3, length * (length / before) ** 2, np.inf)
            self.settled[active] = ((length < 1e-5) | (ahead < 1e-9)) & (_relative(move, self.u[:, active]) < 1e-4)
            active = active[~self.settled[active] & np.isfinite(length) & (self._drift(active) < 3 * self.reach)]
        self.settled &= np.isfinite(self.u).all(axis=0)

    def climb(self, refine) -> None:
        """Deferred correction of the settled lanes on finer and finer grids, until their estimates meet the tolerance."""
        grids = GRIDS[self.level]
        active = np.flatnonzero(self.settled)
        for steps in grids[1:]:
            if not len(active):
                break
            self._correct(active, steps, last=steps == grids[-1])
            self._estimate_errors(active)
            # stresses along the membrane want one grid more than the state
            enough = (self.estimate[active] <= self.tolerance) & ~(refine[active] & (steps == grids[1]))
            active = active[~enough]
        if self.level and len(active):
            self._correct_adaptively(active)

    def _correct_adaptively(self, active) -> None:
        """Deferred correction with adaptive steps of lanes that the finest grid has not resolved."""
        # within the scanned loads only: beyond them a branch ends where the estimate does
        scanned = load_fraction(self.membrane, self.u[:, active]) <= SCANNED_LOAD
        active = active[scanned & (self.estimate[active] < HOPELESS)]
        for exponent in ADAPTIVE:
            if not len(active):
                break
            self._correct(active, exponent, adaptive=True)
            if exponent != ADAPTIVE[0]:
                self._estimate_errors(active)
                active = active[~(self.estimate[active] <= self.tolerance)]

    def _correct(self, active, steps, *, adaptive=False, last=True) -> None:
        """Deferred correction on one grid: the residual there at first is kept, and the state moved to make it zero.

        Where it is not the `last` grid, lanes whose estimate sends them to the next one are moved only once.
        """
        program = careful_program if adaptive else value_program
        first = np.full((len(self.settled), 2), np.nan)
        working = active
        for round_ in range(6):
            stretch_change, volume, *rest = run_lanes(
                lambda part: program(self.membrane, part, steps), self.u[:, working], sizes=CHUNK
            )
            residual, _ = self._system(working, stretch_change, volume, self.sensitivities[..., working])
            move = -_solve(self.matrix[working], residual)
            if round_ == 0:
                first[working] = residual[:, :2]
                self.change.volume[working] = np.abs(volume - self.volume[working])
            self.u[:, working] += move.T
            self.volume[working] = volume + self._volume_change(working, move)
            stores = self.height, self.charge, self.hoop, self.field, self.admissible, self.elliptic
            for store, values in zip(stores, rest, strict=False):  # adaptive steps give the first two
                store[working] = values
            # what the next chord step would move is smaller by the error of the Jacobian
            moved = _relative(move, self.u[:, working])
            left = moved * CONTRACTION[self.level]
            again = ~((moved <= MOST_MOVE) & (left <= 0.01 * self.tolerance))
            if round_ == 0 and not last:
                self.change.residual[working], self.chord[working] = np.abs(residual[:, :2]), 0.0
                self._estimate_errors(working)
                again &= ~(self.estimate[working] > self.tolerance)
            self.chord[working] = left
            working = working[again]
            if not len(working):
                break
        self.change.residual[active] = np.abs(first[active])

    def _estimate_errors(self, which) -> None:
        volume, change = self.volume[which], GridChange(*(v[which] for v in self.change))
        linear = self.matrix[which, :2], self.sensitivities[..., which]
        slope = self.condition.slopes(volume)[1]
        self.estimate[which] = estimated_error(
            self.u[:, which], volume, *linear, change, slope, self.rim, self.chord[which]
        )

    def _measure_charge(self, which, steps) -> None:
        """The derivatives of C on a grid, where the charge is controlled."""
        if self.condition.control == 3 and len(which):
            _, self.charge_slopes[:, which] = run_lanes(
                lambda part: charge_program(self.membrane.material, part, steps), self.u[:, which], sizes=CHUNK
            )

    def refine_tangents(self, refine) -> None:
        """The linearisation anew on a finer grid, where asked for and near folds."""
        self._measure_charge(np.flatnonzero(self.settled), GRIDS[self.level][0])
        with np.errstate(invalid="ignore"):
            refine = refine | (np.abs(self.points().control_slope(self.condition.control)) < NEAR_FOLD)
        which = np.flatnonzero(self.settled & refine)
        if len(which):
            self._linearise(which, REFINED[self.level])
            self._measure_charge(which, REFINED[self.level])

    def points(self) -> Points:
        """The lanes as they are."""
        charge = (self.u[2], self.charge, self.charge_slopes) if self.condition.control == 3 else None
        index = index_of(self.zeros, self.matrix, self.sensitivities, self.volume, self.condition, charge)
        finite = np.isfinite(self.u).all(axis=0) & np.isfinite(self.volume)
        return Points(
            u=self.u,
            volume=self.volume,
            height=self.height,
            charge_per_voltage=self.charge,
            charge_slopes=self.charge_slopes,
            hoop=self.hoop,
            field=self.field,
            tangent=tangents(self.matrix[:, :2]),
            index=np.where(self.elliptic, index, -1),
            error=self.estimate,
            ok=self.settled & finite & (self._drift() < 2 * self.reach) & self.admissible,
        )
