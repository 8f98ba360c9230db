"""Points made exact: a compiled Newton on many lanes, each with a membrane and a loading of its own, and their error estimate.

The unknowns of a lane are u = (λa, p, q), the equations λ2(1) = λ0, the loading's condition, and a third one that says
which point of the contour: `Goals`. Newton runs with exact Jacobians on a coarse grid; then the residual alone is taken on a
finer grid (deferred correction). Going from n/2 to n steps moves a state by δ; the method is of order eight, so the error
left is about δ/256, and δ/16 is reported, plus what rounding can do. What lanes share is the number of steps, so lanes that
need another grid go through another call; `SceneBatch` chooses it.
"""

import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import cached_jit
from .kinds import ClosingEquation
from .materials import largest_load
from .membrane import field_ratio_squared
from .resolution import (
    FEW_ULPS,
    LARGEST_MOVE,
    LEAST_ESTIMATE,
    ROUNDING,
    SAFETY,
    SCALE,
    SETTLED,
    SETTLED_FOLD,
    TANGENT_ERROR,
    TANGENTS_APART,
)
from .shooting import UNKNOWNS, integrate_membrane
from .stability import index_of

__all__ = [
    "Correction",
    "Goals",
    "Linearised",
    "Start",
    "correct_program",
    "estimated_error",
    "limits_program",
    "newton_program",
    "rim_rounding",
]


_SCALE = SCALE[:, None]


class GridChange(typing.NamedTuple):
    """By how much the residuals (lanes, 2) of rim condition and loading, and V (lanes,), changed when the steps were last halved."""

    residual: typing.Any
    volume: typing.Any


def rim_rounding(membrane, u):
    """What rounding can do to λ2(1) of a shot from u (3, lanes).

    Towards the largest load the tension is the small difference of two stresses, and rounding counts for more.
    """
    slack = 1 - u[2] / largest_load(membrane.material, u[0])
    xp = jnp if isinstance(slack, jax.Array) else np
    return ROUNDING * abs(u[0] - membrane.prestretch) + FEW_ULPS * abs(u[0]) / xp.sqrt(xp.clip(slack, 1e-4, 1.0))


def estimated_error(u, volume, jacobian, sensitivities, change: GridChange, by_v, rounding, chord: typing.Any = 0.0):
    """Estimate of the largest relative error of p, V and q at fixed λa, (lanes,), never below `LEAST_ESTIMATE`.

    Of states u (3, lanes) from the `change` caused by halving the steps, the Jacobian (lanes, 2, 3), the sensitivities
    (3, 2, lanes), and the `rounding` of λ2(1); `by_v` is the loading's slope in V, `chord` an error that is added.
    """
    xp = jnp if isinstance(volume, jax.Array) else np
    rim_off = abs(change.residual[:, 0]) / SAFETY + rounding
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


def _system(membrane, condition, u, shot):
    """Residuals (2, lanes) of rim and loading, and their gradients (2, 3, lanes) in scaled unknowns."""
    by_p, by_v, by_q = (jnp.broadcast_to(slope, u.shape[1:]) for slope in condition.slopes(shot.volume))
    sensitivities = jnp.stack([jnp.stack(shot.sensitivities[c]) for c in UNKNOWNS])
    rim = sensitivities[:, 0].at[0].add(1.0)
    along = by_v * sensitivities[:, 1] + jnp.stack([jnp.zeros_like(by_p), by_p, by_q])
    value = jnp.stack([shot.stretch_change - (membrane.prestretch - u[0]), condition.residual(u[1], shot.volume, u[2])])
    return value, jnp.stack([rim * _SCALE, along * _SCALE]), sensitivities


def _solve3(first, second, third, right):
    """x (3, lanes) with first·x = right[0], second·x = right[1], third·x = right[2]."""
    columns = [jnp.cross(second, third, axis=0), jnp.cross(third, first, axis=0), jnp.cross(first, second, axis=0)]
    determinant = jnp.sum(first * columns[0], axis=0)
    return sum(r * c for r, c in zip(right, columns, strict=True)) / determinant


def _null(jacobian, before):
    """Unit null vectors on the side of `before`."""
    null = jnp.cross(*jacobian, axis=0)
    null = null / jnp.linalg.norm(null, axis=0)
    return null * jnp.where(jnp.sum(null * before, axis=0) < 0, -1.0, 1.0)


def _breakdown_load(membrane, apex):
    """q_b(λa), at which the apex breaks down, and its slope."""

    def of(apex):
        return 1.0 / field_ratio_squared(membrane.breakdown, apex, apex)

    return jax.jvp(of, (apex,), (jnp.ones_like(apex),))


def _excess_load(membrane, u):
    """q − q_b(λa) and its gradient in scaled unknowns: where the apex breaks down."""
    limit, rate = _breakdown_load(membrane, u[0])
    return u[2] - limit, jnp.stack([-rate, jnp.zeros_like(rate), jnp.ones_like(rate)]) * _SCALE


@cached_jit
def limits_program(membrane, apex):
    """q of breakdown at the apex, its slope by λa, and the largest load, at stretches (lanes,)."""
    return *_breakdown_load(membrane, apex), largest_load(membrane.material, apex)


def _zeros(trail):
    """How often ∂λ2/∂λa changes sign inside: the index under prescribed pressure, but for its parity at the rim."""
    times, sensitivity = trail
    change = jnp.isfinite(times[1:])[:, None] & (sensitivity[1:] * sensitivity[:-1] < 0)
    return jnp.sum(change, axis=0)


class Goals(typing.NamedTuple):
    """The third equation of points: `kinds` (lanes,) of `ClosingEquation`, for a level `rows` (3, lanes) and `targets`."""

    rows: typing.Any
    targets: typing.Any
    kinds: typing.Any

    def excess(self, membrane, u, volume, sensitivities):
        """By how much points miss their goal, and the gradient of that in scaled unknowns; of a fold neither."""
        broken, slope = _excess_load(membrane, u)
        of_volume, breaks = self.kinds == ClosingEquation.volume, self.kinds == ClosingEquation.breakdown
        value = jnp.where(of_volume, volume - self.targets, jnp.sum(self.rows * u, axis=0) - self.targets)
        gradient = jnp.where(of_volume, sensitivities[:, 1], self.rows) * _SCALE
        return jnp.where(breaks, broken, value), jnp.where(breaks, slope, gradient)

    @property
    def folds(self):
        return self.kinds == ClosingEquation.fold


class Start(typing.NamedTuple):
    """Where Newton begins, lanes last: u (3, lanes), unit tangents in scaled unknowns, and slopes d(dq)/ds along them.

    Tangents and slopes are those of folds; others need none.
    """

    u: typing.Any
    tangent: typing.Any
    slope: typing.Any


class Linearised(typing.NamedTuple):
    """States u (3, lanes) that a step of Newton has led to, and what that step has shown, lanes last.

    Unit tangents and `move` (3, lanes) in scaled unknowns, the `matrix` of the equations' gradients in them,
    `sensitivities` (3, 2, lanes), V, and the zeros of the sensitivity along the membrane.
    """

    u: typing.Any
    tangent: typing.Any
    move: typing.Any
    matrix: typing.Any
    sensitivities: typing.Any
    volume: typing.Any
    zeros: typing.Any


class _Newton(typing.NamedTuple):
    """A state of Newton's method on points, lanes last.

    `secant` holds of d(dq)/ds its value, the distance along the tangent that it rests on, and how wrong it may be. `before`
    is the point before and dq along its tangent.
    """

    at: Linearised
    secant: typing.Any
    before: tuple

    @staticmethod
    def begin(start: Start) -> "_Newton":
        lanes = start.u.shape[1]
        nothing = jnp.zeros((3, lanes)), jnp.zeros((3, 3, lanes)), jnp.zeros((3, 2, lanes))
        at = Linearised(start.u, start.tangent, *nothing, jnp.zeros(lanes), jnp.zeros(lanes, int))
        secant = jnp.stack([start.slope, jnp.full(lanes, 1e-3), jnp.ones(lanes)])
        return _Newton(at, secant, (start.u, jnp.full(lanes, jnp.nan)))


class Correction(typing.NamedTuple):
    """Corrected points, lanes last: u, V, unit tangents in scaled unknowns, dV along them, the index, the errors of `Corrected`.

    `settled` says whether Newton has; `slope` is that of a fold, `size` the length of Newton's last move.
    """

    u: typing.Any
    volume: typing.Any
    tangent: typing.Any
    volume_rate: typing.Any
    index: typing.Any
    error: typing.Any
    spread: typing.Any
    settled: typing.Any
    slope: typing.Any
    size: typing.Any


def _settle(membrane, condition, goals: Goals, grid, newton: _Newton, residual, volume) -> Correction:
    """What `correct_program` returns, from the end of Newton and the residuals (3, lanes) and V on the fine grid."""
    coarse, fine, contraction = grid
    u, _, move, matrix, sensitivities, volume_before, zeros = newton.at
    slope, _, doubt = newton.secant
    good = jnp.all(jnp.isfinite(matrix), axis=(0, 1))
    step = -jnp.where(good, _solve3(matrix[0], matrix[1], matrix[2], residual), jnp.nan)
    u = u + step * _SCALE
    null = jnp.cross(matrix[0], matrix[1], axis=0)
    null = null / jnp.linalg.norm(null, axis=0)
    shift = volume - volume_before
    volume = volume + jnp.sum(sensitivities[:, 1] * step * _SCALE, axis=0)
    # the method is of order eight: the change of the residual gives the error left on the finer grid
    left = (2 * coarse / fine) ** 8
    jacobian = jnp.moveaxis(matrix[:2] / _SCALE, -1, 0)
    relative = jnp.max(jnp.abs(step * _SCALE) / jnp.maximum(jnp.abs(u), 1e-3), axis=0)
    change, by_v = GridChange(left * residual[:2].T, left * jnp.abs(shift)), condition.slopes(volume)[1]
    error = estimated_error(
        u, volume, jacobian, sensitivities, change, by_v, rim_rounding(membrane, u), relative * contraction
    )
    rate = jnp.sum(sensitivities[:, 1] * null * _SCALE, axis=0)
    fold, size = goals.folds, jnp.linalg.norm(step, axis=0)
    along = jnp.abs(jnp.sum(move * null, axis=0)) * doubt + TANGENT_ERROR * size / jnp.abs(slope)
    of_load = jnp.abs(slope) * along**2 * SCALE[2] / jnp.maximum(jnp.abs(u[2]), 1e-3)
    error = error + jnp.where(fold, of_load, 0.0)
    spread = jnp.where(fold, jnp.abs(rate) * along / jnp.maximum(jnp.abs(volume), 1e-3), 0.0)
    last = jnp.linalg.norm(move, axis=0)
    settled = (size < SETTLED) & (last < jnp.where(fold, SETTLED_FOLD, 30 * SETTLED))
    settled &= jnp.all(jnp.isfinite(u), axis=0) & jnp.isfinite(error)
    index = index_of(zeros, jacobian, sensitivities, volume, condition)
    return Correction(u, volume, null, rate, index, error, spread, settled, slope, last)


def _newton_step(membrane, condition, goals: Goals, steps, state: _Newton) -> _Newton:
    """One step on a grid of `steps`; folds follow a secant of dq along the tangent."""
    u, (last_u, last_g) = state.at.u, state.before
    slope, last_apart, _ = state.secant
    shot = integrate_membrane(membrane.material, u[0], u[1], u[2], steps, sensitivities=UNKNOWNS, trail="sensitivity")
    value, jacobian, sensitivities = _system(membrane, condition, u, shot)
    tangent = _null(jacobian, state.at.tangent)
    apart = jnp.sum((u - last_u) / _SCALE * tangent, axis=0)
    secant = (tangent[2] - last_g) / apart
    fair = (jnp.abs(apart) > TANGENTS_APART) & (secant * slope > 0)  # nearer points show the noise
    # the change of the slope shows how wrong the one before was; the new one is better as its points are nearer
    doubt = jnp.abs(1 - slope / secant) * jnp.minimum(1.0, jnp.abs(apart / last_apart))
    known = jnp.where(fair, jnp.stack([secant, apart, doubt]), state.secant)
    g, gradient = goals.excess(membrane, u, shot.volume, sensitivities)
    g = jnp.where(goals.folds, tangent[2] / known[0], g)
    gradient = jnp.where(goals.folds, tangent, gradient)
    move = -_solve3(jacobian[0], jacobian[1], gradient, jnp.concatenate([value, g[None]]))
    move = _damped(u, membrane.prestretch, move)
    volume = shot.volume + jnp.sum(sensitivities[:, 1] * move * _SCALE, axis=0)
    matrix = jnp.concatenate([jacobian, gradient[None]])
    at = Linearised(u + move * _SCALE, tangent, move, matrix, sensitivities, volume, _zeros(shot.trail))
    return _Newton(at, known, (u, tangent[2]))


def _damped(u, rim, move):
    """Moves (3, lanes) in scaled unknowns, shortened to `LARGEST_MOVE` and to stay among tensile states."""
    move = move * jnp.minimum(1.0, LARGEST_MOVE / jnp.linalg.norm(move, axis=0))
    # neither λa − λ0 nor p shrinks below three tenths in one move
    room, change = jnp.stack([u[0] - rim, u[1]]), (move * _SCALE)[:2]
    share = jnp.min(jnp.where(change < -0.7 * room, -0.7 * room / change, 1.0), axis=0)
    return move * jnp.where(share > 0, share, 1.0)


@cached_jit
def newton_program(membrane, condition, start: Start, goals: Goals, steps, rounds) -> Linearised:
    """Newton from `start` towards `goals`: one step on each of the first `rounds` grids of `steps`."""

    def step(i, state):
        return _newton_step(membrane, condition, goals, steps[i], state)

    return jax.lax.fori_loop(0, rounds, step, _Newton.begin(start)).at


@cached_jit
def correct_program(membrane, condition, start: Start, goals: Goals, rounds, grid) -> Correction:
    """States on loadings that satisfy `goals`, from `start`.

    Newton on the coarse grid, `rounds` times, then one move by the residuals on the fine one with its Jacobian. `grid` is
    the steps of both, and how much of a chord step's move may be left.
    """
    coarse, fine, _ = grid

    def step(_, state):
        return _newton_step(membrane, condition, goals, coarse, state)

    newton = jax.lax.fori_loop(0, rounds, step, _Newton.begin(start))
    u = newton.at.u
    shot = integrate_membrane(membrane.material, u[0], u[1], u[2], fine)
    g = jnp.where(goals.folds, 0.0, goals.excess(membrane, u, shot.volume, newton.at.sensitivities)[0])
    stretch_change = shot.stretch_change - (membrane.prestretch - u[0])
    residual = jnp.stack([stretch_change, condition.residual(u[1], shot.volume, u[2]), g])
    return _settle(membrane, condition, goals, grid, newton, residual, shot.volume)
