"""Compiled programs for many loadings at once, each lane with a membrane and a loading of its own.

`march_program` advances continuations a few passes, `correct_program` makes events exact: states at a given load or volume,
at breakdown, and folds. What lanes share is the number of steps, so lanes that need another grid go through another call.
"""

import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    SCALE,
    UNKNOWNS,
    ClosingEquation,
    GridChange,
    estimated_error,
    field_ratio_squared,
    index_of,
    integrate_membrane,
    largest_load,
)
from ..numerics import Code, Walk, advance, cached_jit
from .resolution import MARCH_CONTROL, PASSES, SETTLED, SETTLED_FOLD, TANGENT_ERROR, TANGENTS_APART
from .tracing import TraceGrid, branch_problem

__all__ = [
    "correct_program",
    "limits_program",
    "march_program",
    "new_walks",
]


_SCALE = SCALE[:, None]


def new_walks(u: np.ndarray, headings: np.ndarray) -> Walk:
    """Walks about to begin at u (lanes, 3) towards `headings`, as arrays of NumPy."""
    at, way = u / SCALE, headings / SCALE
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    lanes = len(u)
    places = {"base": at, "trial": at, "origin": at, "tangent": way, "heading": way, "bend": np.zeros((lanes, 2, 3))}
    numbers = {"step": np.zeros(lanes), "last": np.full(lanes, np.inf), "watched": np.zeros((lanes, 1))}
    counts = {name: np.zeros(lanes, int) for name in ("tries", "count", "code", "evaluations")}
    copies: dict[str, typing.Any] = {name: value.copy() for name, value in (places | numbers | counts).items()}
    return Walk(**copies)


@cached_jit
def march_program(membrane, condition, limits, walk, peak, grid: TraceGrid):
    """Walks after a few passes, a bound of the highest q on them, and after every pass: base, tangent, and whether it is new.

    A walk ends with `Code.breakdown` beyond breakdown at the apex, at a load higher than any before on it.
    """
    material = membrane.material

    def one(material, prestretch, condition, limits, walk):
        problem = branch_problem(material, prestretch, condition, limits, grid, MARCH_CONTROL)
        return advance(problem, walk)

    def one_pass(state, _):
        walk, peak = state
        before = walk
        walk, accept = jax.vmap(one)(material, membrane.prestretch, condition, limits, walk)
        apex, q = walk.base[:, 0] * SCALE[0], walk.base[:, 2] * SCALE[2]
        broken = accept & (q * field_ratio_squared(membrane.breakdown, apex, apex) > 1) & (q >= peak)
        code = jnp.where(broken, int(Code.breakdown), walk.code)
        # a fold's load lies above those of its neighbours, and below the control points of the cubic between them
        third = jnp.linalg.norm(walk.base - before.base, axis=1) / 3
        rise, fall = third * before.tangent[:, 2], -third * walk.tangent[:, 2]
        between = jnp.maximum(before.base[:, 2] + rise, walk.base[:, 2] + fall) * SCALE[2]
        highest = jnp.where((rise > 0) & (fall > 0), jnp.maximum(between, q), q)
        peak = jnp.where(accept, jnp.maximum(peak, highest), peak)
        return (walk._replace(code=code), peak), (walk.base, walk.tangent, accept)

    (walk, peak), passed = jax.lax.scan(one_pass, (walk, peak), length=PASSES)
    return tuple(walk), peak, passed


def _system(membrane, condition, u, shot):
    """Residuals (2, lanes) of rim and loading, and their gradients (2, 3, lanes) in scaled unknowns."""
    by_p, by_v, by_q = condition.slopes(shot.volume)
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


class _Newton(typing.NamedTuple):
    """A state of Newton's method on points, lanes last.

    `secant` holds of d(dq)/ds its value, the distance along the tangent that it rests on, and how wrong it may be. `last` is
    the point before and dq along its tangent. `move`, `matrix` (the equations' gradients), `sensitivities`, `volume` and
    `zeros` (of the sensitivity along the membrane) are those of the step that led to `u`.
    """

    u: typing.Any
    tangent: typing.Any
    secant: typing.Any
    last: tuple
    move: typing.Any
    matrix: typing.Any
    sensitivities: typing.Any
    volume: typing.Any
    zeros: typing.Any

    @staticmethod
    def begin(u, tangents, slopes) -> "_Newton":
        lanes = u.shape[1]
        secant = jnp.stack([slopes, jnp.full(lanes, 1e-3), jnp.ones(lanes)])
        nothing = jnp.zeros((3, lanes)), jnp.zeros((3, 3, lanes)), jnp.zeros((3, 2, lanes))
        numbers = jnp.zeros(lanes), jnp.zeros(lanes, int)
        return _Newton(u, tangents, secant, (u, jnp.full(lanes, jnp.nan)), *nothing, *numbers)


def _settle(membrane, condition, goals: Goals, grid, newton: _Newton, residual, volume):
    """What `correct_program` returns, from the end of Newton and the residuals (3, lanes) and V on the fine grid."""
    coarse, fine, contraction = grid
    u, move, matrix, sensitivities = newton.u, newton.move, newton.matrix, newton.sensitivities
    slope, _, doubt = newton.secant
    good = jnp.all(jnp.isfinite(matrix), axis=(0, 1))
    step = -jnp.where(good, _solve3(matrix[0], matrix[1], matrix[2], residual), jnp.nan)
    u = u + step * _SCALE
    null = jnp.cross(matrix[0], matrix[1], axis=0)
    null = null / jnp.linalg.norm(null, axis=0)
    shift = volume - newton.volume
    volume = volume + jnp.sum(sensitivities[:, 1] * step * _SCALE, axis=0)
    # the method is of order eight: the change of the residual gives the error left on the finer grid
    left = (2 * coarse / fine) ** 8
    jacobian = jnp.moveaxis(matrix[:2] / _SCALE, -1, 0)
    relative = jnp.max(jnp.abs(step * _SCALE) / jnp.maximum(jnp.abs(u), 1e-3), axis=0)
    change, by_v = GridChange(left * residual[:2].T, left * jnp.abs(shift)), condition.slopes(volume)[1]
    error = estimated_error(
        u, volume, jacobian, sensitivities, change, by_v, membrane.prestretch, relative * contraction
    )
    rate = jnp.sum(sensitivities[:, 1] * null * _SCALE, axis=0)
    fold, size = goals.folds, jnp.linalg.norm(step, axis=0)
    along = jnp.abs(jnp.sum(move * null, axis=0)) * doubt + TANGENT_ERROR * size / jnp.abs(slope)
    of_load = jnp.abs(slope) * along**2 * SCALE[2] / jnp.maximum(jnp.abs(u[2]), 1e-3)
    error = error + jnp.where(fold, of_load, 0.0)
    spread = jnp.where(fold, jnp.abs(rate) * along / jnp.maximum(jnp.abs(volume), 1e-3), 0.0)
    settled = (size < SETTLED) & (jnp.linalg.norm(move, axis=0) < jnp.where(fold, SETTLED_FOLD, 30 * SETTLED))
    settled &= jnp.all(jnp.isfinite(u), axis=0) & jnp.isfinite(error)
    index = index_of(newton.zeros, jacobian, sensitivities, volume, condition)
    return u, volume, null, rate, index, error, spread, settled, slope, jnp.linalg.norm(move, axis=0)


def _newton_step(membrane, condition, goals: Goals, steps, state: _Newton) -> _Newton:
    """One step on a grid of `steps`; folds follow a secant of dq along the tangent."""
    u, (last_u, last_g) = state.u, state.last
    slope, last_apart, _ = state.secant
    shot = integrate_membrane(membrane.material, u[0], u[1], u[2], steps, sensitivities=UNKNOWNS, trail="sensitivity")
    value, jacobian, sensitivities = _system(membrane, condition, u, shot)
    tangent = _null(jacobian, state.tangent)
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
    volume = shot.volume + jnp.sum(sensitivities[:, 1] * move * _SCALE, axis=0)
    matrix = jnp.concatenate([jacobian, gradient[None]])
    zeros = _zeros(shot.trail)
    return _Newton(u + move * _SCALE, tangent, known, (u, tangent[2]), move, matrix, sensitivities, volume, zeros)


@cached_jit
def correct_program(membrane, condition, begin, goals: Goals, rounds, grid):
    """States on loadings that satisfy `goals`, from `begin` = u (3, lanes), unit tangents, and slopes d(dq)/ds of folds.

    Newton on the coarse grid, `rounds` times, then one move by the residuals on the fine one with its Jacobian. `grid` is
    the steps of both, and how much of a chord step's move may be left. Returns, with lanes last, u, V, unit tangents in
    scaled unknowns, dV along them, the index, the errors of a `Corrected`, whether Newton has settled, the slopes of folds,
    and the length of Newton's last move.
    """
    coarse, fine, _ = grid

    def step(_, state):
        return _newton_step(membrane, condition, goals, coarse, state)

    state = jax.lax.fori_loop(0, rounds, step, _Newton.begin(*begin))
    u = state.u
    shot = integrate_membrane(membrane.material, u[0], u[1], u[2], fine)
    g = jnp.where(goals.folds, 0.0, goals.excess(membrane, u, shot.volume, state.sensitivities)[0])
    stretch_change = shot.stretch_change - (membrane.prestretch - u[0])
    residual = jnp.stack([stretch_change, condition.residual(u[1], shot.volume, u[2]), g])
    return _settle(membrane, condition, goals, grid, state, residual, shot.volume)
