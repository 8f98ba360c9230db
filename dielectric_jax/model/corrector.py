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

from .loading import LoadingCondition
from .materials import largest_load
from .membrane import Membrane
from .programs import (
    await_programs,
    careful_program,
    charge_program,
    jacobian_program,
    run_chunks,
    value_program,
)
from .scene import SCANNED_LOAD
from .stability import control_rate, index_of

__all__ = ["Points", "Shooting", "corrected_points", "load_fraction", "locking_stretch"]

SCALE = np.array([1.0, 0.2, 0.02])  # of (λa, p, q)
# steps: of Newton, then of the residual; where an inner layer forms (a high load near lock-up, or near the cone) Newton
# needs more, and more again where the layer is thin
GRIDS = ((16.0, 32.0, 64.0, 128.0), (24.0, 48.0, 96.0, 192.0, 320.0), (80.0, 160.0, 320.0))
_REFINED = (48.0, 144.0, 240.0)  # steps of a refined tangent
_NEAR_FOLD = (
    1e-3  # component of the tangent along the control below which a tangent is refined: the index turns on its sign
)
CONTRACTION = (2e-4, 3e-3, 1e-3)  # of a chord step: the error of Newton's Jacobian, measured
_TRIES = (9, 6, 9)  # of Newton
_MOST_MOVE = 3e-9  # relative: height and charge are not moved along with the state
ADAPTIVE = (10.0, 12.0, 13.0)  # exponents of the tolerance of the careful path
_HOPELESS = 1e-3  # estimates of the finest grid beyond which the careful path is not tried
SAFETY = 16.0
LEAST_ESTIMATE = 1e-13
_ROUNDING = 5e-15  # relative to λa − λ0, p and V; measured
_FEW_ULPS = 2e-16  # relative to λa


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
        """By what states of a loading are told apart: the volume, or the apex stretch where the volume is held."""
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


def estimated_error(u, volume, jacobian, sensitivities, change, change_of_volume, by_v, rim, chord: typing.Any = 0.0):
    """Estimate of the largest relative error of p, V and q at fixed λa, (lanes,), never below `LEAST_ESTIMATE`.

    Of states u (3, lanes) from what the residuals (lanes, 2) and V changed by when the steps were halved last, the Jacobian
    (lanes, 2, 3) and columns (3, 2, lanes), and what rounding can do; `by_v` is the loading's slope in V.
    """
    xp = jnp if isinstance(volume, jax.Array) else np
    rim_off = abs(change[:, 0]) / SAFETY + _ROUNDING * abs(u[0] - rim) + _FEW_ULPS * abs(u[0])
    condition_off = abs(change[:, 1]) / SAFETY + _ROUNDING * (abs(u[1]) + abs(by_v * volume))
    of_rim, of_condition = abs(jacobian[:, 0]), abs(jacobian[:, 1])
    with np.errstate(all="ignore"):
        determinant = abs(jacobian[:, 0, 1] * jacobian[:, 1, 2] - jacobian[:, 0, 2] * jacobian[:, 1, 1])
        of_p = (of_condition[:, 2] * rim_off + of_rim[:, 2] * condition_off) / determinant
        of_q = (of_condition[:, 1] * rim_off + of_rim[:, 1] * condition_off) / determinant
        of_volume = abs(sensitivities[1, 1]) * of_p + abs(sensitivities[2, 1]) * of_q
        of_volume = of_volume + _ROUNDING * abs(volume) + change_of_volume / SAFETY
        error = xp.stack([of_p, of_volume, of_q]) / xp.maximum(abs(xp.stack([u[1], volume, u[2]])), 1e-3)
        error = error.max(axis=0) + chord
    return xp.maximum(xp.where(xp.isnan(error), np.inf, error), LEAST_ESTIMATE)


def locking_stretch(membrane: Membrane) -> float:
    """λa beyond which an inner layer forms at a high load."""
    return 0.72 * membrane.lock_up_stretch()[0]


def difficulty(locks_from, apex_stretch: np.ndarray, load_fraction: np.ndarray) -> np.ndarray:
    """Which ladder of grids resolves the membrane, an index of `GRIDS` for each lane; see `locking_stretch`."""
    locking = apex_stretch > locks_from
    return (
        (locking & (load_fraction > 0.7)).astype(int)
        + (locking & (load_fraction > 0.86))
        + 2 * (~locking & (load_fraction > 0.93))
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
        parts = u[:, which], rows[which], targets[which], tolerance, reach, k, refined[which]
        return _corrected_points(membrane, condition, *parts)

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


def _corrected_points(membrane, condition, u, rows, targets, tolerance, reach, level, refine) -> Points:
    """`corrected_points` of lanes that share one ladder of grids."""
    ladder = GRIDS[level]
    coarse = ladder[0]
    u = np.array(u, float)
    lanes = u.shape[1]
    rim = float(membrane.prestretch)
    start = u.copy()
    by_volume = ~np.isfinite(rows).all(axis=1)

    def system(part, stretch_change, volume, sensitivities):
        at = u[:, part]
        residual, jacobian = _assemble(at, stretch_change, volume, sensitivities, rim, condition)
        last_row = np.where(by_volume[part, None], sensitivities[:, 1].T, rows[part])
        last = np.where(by_volume[part], volume, np.einsum("ij,ji->i", np.nan_to_num(rows[part]), at)) - targets[part]
        return np.concatenate([residual, last[:, None]], axis=1), np.concatenate([jacobian, last_row[:, None]], axis=1)

    matrix = np.full((lanes, 3, 3), np.nan)
    sensitivities = np.full((3, 2, lanes), np.nan)
    zeros = np.zeros(lanes, int)
    volume = np.full(lanes, np.nan)
    active = np.arange(lanes)
    settled = np.zeros(lanes, bool)

    def newton(active, steps, tries):
        size = np.full(lanes, np.inf)
        for _ in range(tries):
            if not len(active):
                break
            stretch_change, volume[active], sensitivities[..., active], zeros[active] = run_chunks(
                lambda part: jacobian_program(membrane.material, part, steps), u[:, active]
            )
            right, matrix[active] = system(active, stretch_change, volume[active], sensitivities[..., active])
            move = -_solve(matrix[active], right)
            length = np.linalg.norm(move / SCALE, axis=1)
            with np.errstate(all="ignore"):
                move = move * np.minimum(1.0, 0.5 * reach / length)[:, None]
                # stay among tensile states: neither p nor λa − λ0 shrinks below three tenths in one move
                room = np.stack([u[0, active] - rim, u[1, active]], axis=1)
                share = np.where(move[:, :2] < -0.7 * room, -0.7 * room / move[:, :2], 1.0).min(axis=1)
                move = move * np.where(share > 0, share, 1.0)[:, None]
                length = np.where(share < 1, np.maximum(length, 1e-3), length)
            u[:, active] += move.T
            volume[active] += np.einsum("il,li->l", sensitivities[:, 1][:, active], move)
            before, size[active] = size[active], length
            drift = np.linalg.norm((u[:, active] - start[:, active]).T / SCALE, axis=1)
            with np.errstate(all="ignore"):
                # the next move, where Newton converges squared
                ahead = np.where(length < 1e-3, length * (length / before) ** 2, np.inf)
            settled[active] = ((length < 1e-5) | (ahead < 1e-9)) & (_relative(move, u[:, active]) < 1e-4)
            active = active[~settled[active] & np.isfinite(length) & (drift < 3 * reach)]

    newton(active, coarse, _TRIES[level])
    settled &= np.isfinite(u).all(axis=0)
    result = [volume.copy(), *(np.full(lanes, np.nan) for _ in range(4))]
    admissible, elliptic = np.zeros(lanes, bool), np.zeros(lanes, bool)
    charge_slopes = np.full((3, lanes), np.nan)
    change_of_volume = np.full(lanes, np.nan)
    chord = np.zeros(lanes)  # what is left of the chord steps, relative
    discretisation = np.full((lanes, 2), np.nan)  # change of (rim condition, condition) from the coarser grid
    estimate = np.full(lanes, np.inf)

    def correct(active, steps, *, adaptive=False, last=True):
        """Deferred correction on one grid: the residual there at first, and the state moved to make it zero.

        Where it is not the `last` grid, lanes whose estimate sends them to the next one are moved only once.
        """
        first = np.full((lanes, 2), np.nan)
        working = active
        for round_ in range(6):
            program = careful_program if adaptive else value_program
            stretch_change, vol, *rest = run_chunks(lambda part, run=program: run(membrane, part, steps), u[:, working])
            right, _ = system(working, stretch_change, vol, sensitivities[..., working])
            move = -_solve(matrix[working], right)
            begin = np.isnan(first[working, 0])
            first[working[begin]] = right[begin, :2]
            change_of_volume[working[begin]] = np.abs(vol - result[0][working])[begin]
            u[:, working] += move.T
            vol = vol + np.einsum("il,li->l", sensitivities[:, 1][:, working], move)
            for store, values in zip([*result, admissible, elliptic], [vol, *rest], strict=False):
                store[working] = values
            # what the next chord step would move is smaller by the error of the Jacobian
            moved = _relative(move, u[:, working])
            again = ~((moved <= _MOST_MOVE) & (moved * CONTRACTION[level] <= 0.01 * tolerance))
            if round_ == 0 and not last:
                discretisation[working], chord[working] = np.abs(right[:, :2]), 0.0
                estimate_errors(working)
                again &= ~(estimate[working] > tolerance)
            chord[working] = moved * CONTRACTION[level]
            working = working[again]
            if not len(working):
                break
        return first[active]

    def estimate_errors(active):
        state = u[:, active], result[0][active], matrix[active, :2], sensitivities[..., active]
        changes = discretisation[active], change_of_volume[active]
        rounding = condition.slopes(result[0][active])[1], rim
        estimate[active] = estimated_error(*state, *changes, *rounding, chord[active])

    active = np.flatnonzero(settled)
    for steps in ladder[1:]:
        if not len(active):
            break
        discretisation[active] = np.abs(correct(active, steps, last=steps == ladder[-1]))
        estimate_errors(active)
        # stresses along the membrane want one grid more than the state
        enough = (estimate[active] <= tolerance) & ~(refine[active] & (steps == ladder[1]))
        active = active[~enough]
    if level and len(active):
        # within the scanned loads only: beyond them a branch ends where the estimate does
        active = active[(load_fraction(membrane, u[:, active]) <= SCANNED_LOAD) & (estimate[active] < _HOPELESS)]
        for exponent in ADAPTIVE:
            if not len(active):
                break
            discretisation[active] = np.abs(correct(active, exponent, adaptive=True))
            if exponent != ADAPTIVE[0]:
                estimate_errors(active)
                active = active[~(estimate[active] <= tolerance)]
    control = condition.control

    def points() -> Points:
        tangent, charge = tangents(matrix[:, :2]), (u[2], result[2], charge_slopes) if control == 3 else None
        index = index_of(zeros, matrix, sensitivities, result[0], condition, charge)
        drift = np.linalg.norm((u - start).T / SCALE, axis=1)
        ok = settled & np.isfinite(u).all(axis=0) & np.isfinite(result[0]) & (drift < 2 * reach) & admissible
        known = np.where(elliptic, index, -1)
        return Points(u, *result[:3], charge_slopes, *result[3:], tangent, known, estimate, ok)  # pyright: ignore[reportCallIssue]

    def measure_charge(which, steps):
        if control == 3 and len(which):
            _, charge_slopes[:, which] = run_chunks(
                lambda part: charge_program(membrane.material, part, steps), u[:, which]
            )

    measure_charge(np.flatnonzero(settled), coarse)
    with np.errstate(invalid="ignore"):
        refine = refine | (np.abs(points().control_slope(control)) < _NEAR_FOLD)
    which = np.flatnonzero(settled & refine)
    if len(which):
        steps = _REFINED[level]
        stretch_change, vol, sensitivities[..., which], zeros[which] = run_chunks(
            lambda part: jacobian_program(membrane.material, part, steps), u[:, which]
        )
        _, matrix[which] = system(which, stretch_change, vol, sensitivities[..., which])
        measure_charge(which, steps)
    return points()
