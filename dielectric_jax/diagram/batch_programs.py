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
    GridChange,
    estimated_error,
    field_ratio_squared,
    index_of,
    integrate_membrane,
    largest_load,
)
from ..numerics import Code, Steps, Walk, advance, cached_jit
from .tracing import branch_problem

__all__ = [
    "BREAKDOWN",
    "FOLD",
    "LEVEL",
    "VOLUME",
    "correct_program",
    "limits_program",
    "march_program",
    "new_walks",
]

LEVEL, VOLUME, BREAKDOWN, FOLD = range(4)  # row·u = target; V = target; q = q_b(λa); dq = 0
_PASSES = 4
_APART = 1e-5  # of points whose tangents tell how fast q turns
_STEPS = Steps(
    first=0.2,
    largest=2.0,
    smallest=2e-5,
    most_turn=0.5,
    most_correction=0.2,
    tolerance=1e-4,
    most_residual=0.1,
    cubic=True,
)
_SCALE = SCALE[:, None]
_SETTLED = 3e-4  # last move of Newton whose remainder a chord step on the finer grid removes
_SETTLED_FOLD = 1e-4  # there the secant converges more slowly
_OF_TANGENT = 10  # a tangent's error by that of the residual on the same grid, measured


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
def march_program(membrane, condition, limits, walk, peak, accuracy, load_limits, lengths):
    """Walks after a few passes, a bound of the highest q on them, and after every pass: base, tangent, and whether it is new.

    A walk ends with `Code.breakdown` beyond breakdown at the apex, at a load higher than any before on it.
    """
    material = membrane.material

    def one(material, prestretch, condition, limits, walk):
        problem = branch_problem(material, prestretch, condition, limits, accuracy, load_limits, lengths, _STEPS)
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

    (walk, peak), passed = jax.lax.scan(one_pass, (walk, peak), length=_PASSES)
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


def _settle(membrane, condition, kinds, grid, newton, residual, volume):
    """What `correct_program` returns, from the end of Newton and the residuals (3, lanes) and V on the fine grid."""
    coarse, fine, contraction = grid
    u, (slope, _, doubt), move, matrix, sensitivities, before, zeros = newton
    good = jnp.all(jnp.isfinite(matrix), axis=(0, 1))
    step = -jnp.where(good, _solve3(matrix[0], matrix[1], matrix[2], residual), jnp.nan)
    u = u + step * _SCALE
    null = jnp.cross(matrix[0], matrix[1], axis=0)
    null = null / jnp.linalg.norm(null, axis=0)
    shift = volume - before
    volume = volume + jnp.sum(sensitivities[:, 1] * step * _SCALE, axis=0)
    # the method is of order eight: what the residual changed by tells the error left on the finer grid
    left = (2 * coarse / fine) ** 8
    jacobian = jnp.moveaxis(matrix[:2] / _SCALE, -1, 0)
    relative = jnp.max(jnp.abs(step * _SCALE) / jnp.maximum(jnp.abs(u), 1e-3), axis=0)
    change, by_v = GridChange(left * residual[:2].T, left * jnp.abs(shift)), condition.slopes(volume)[1]
    error = estimated_error(
        u, volume, jacobian, sensitivities, change, by_v, membrane.prestretch, relative * contraction
    )
    rate = jnp.sum(sensitivities[:, 1] * null * _SCALE, axis=0)
    fold, size = kinds == FOLD, jnp.linalg.norm(step, axis=0)
    along = jnp.abs(jnp.sum(move * null, axis=0)) * doubt + _OF_TANGENT * size / jnp.abs(slope)
    of_load = jnp.abs(slope) * along**2 * SCALE[2] / jnp.maximum(jnp.abs(u[2]), 1e-3)
    error = error + jnp.where(fold, of_load, 0.0)
    spread = jnp.where(fold, jnp.abs(rate) * along / jnp.maximum(jnp.abs(volume), 1e-3), 0.0)
    settled = (size < _SETTLED) & (jnp.linalg.norm(move, axis=0) < jnp.where(fold, _SETTLED_FOLD, 30 * _SETTLED))
    settled &= jnp.all(jnp.isfinite(u), axis=0) & jnp.isfinite(error)
    index = index_of(zeros, jacobian, sensitivities, volume, condition)
    return u, volume, null, rate, index, error, spread, settled, slope, jnp.linalg.norm(move, axis=0)


@cached_jit
def correct_program(membrane, condition, u, tangents, slopes, rows, targets, kinds, rounds, grid):
    """States on loadings where row·u = target, V = target, breakdown, or a fold of q, from u (3, lanes).

    Newton on the coarse grid, `rounds` times, then one move by the residuals on the fine one with its Jacobian. At a fold
    the moves along the tangent follow a secant that begins with the `slopes` d(dq)/ds. `grid` is the steps of both, and how
    much of a chord step's move may be left. Returns, with lanes last, u, V, unit tangents in scaled unknowns, dV along
    them, the index, the errors of a `Corrected`, whether Newton has settled, the slopes of folds, and the length of Newton's last move.
    """
    coarse, fine, _ = grid

    def goal(u, volume, sensitivities):
        broken, slope = _excess_load(membrane, u)
        value = jnp.where(kinds == VOLUME, volume - targets, jnp.sum(rows * u, axis=0) - targets)
        gradient = jnp.where(kinds == VOLUME, sensitivities[:, 1], rows) * _SCALE
        return jnp.where(kinds == BREAKDOWN, broken, value), jnp.where(kinds == BREAKDOWN, slope, gradient)

    def newton(_, state):
        u, tangent, (slope, last_apart, _), last_u, last_g = state[:5]
        shot = integrate_membrane(
            membrane.material, u[0], u[1], u[2], coarse, sensitivities=UNKNOWNS, trail="sensitivity"
        )
        value, jacobian, sensitivities = _system(membrane, condition, u, shot)
        tangent = _null(jacobian, tangent)
        apart = jnp.sum((u - last_u) / _SCALE * tangent, axis=0)
        secant = (tangent[2] - last_g) / apart
        fair = (jnp.abs(apart) > _APART) & (secant * slope > 0)  # nearer points tell the noise
        # the change of the slope tells how wrong the one before was; the new one is better as its points are nearer
        doubt = jnp.abs(1 - slope / secant) * jnp.minimum(1.0, jnp.abs(apart / last_apart))
        known = jnp.where(fair, jnp.stack([secant, apart, doubt]), state[2])
        g, gradient = goal(u, shot.volume, sensitivities)
        g, gradient = jnp.where(kinds == FOLD, tangent[2] / known[0], g), jnp.where(kinds == FOLD, tangent, gradient)
        move = -_solve3(jacobian[0], jacobian[1], gradient, jnp.concatenate([value, g[None]]))
        volume = shot.volume + jnp.sum(sensitivities[:, 1] * move * _SCALE, axis=0)
        matrix = jnp.concatenate([jacobian, gradient[None]])
        return u + move * _SCALE, tangent, known, u, tangent[2], move, matrix, sensitivities, volume, _zeros(shot.trail)

    lanes = u.shape[1]
    known = jnp.stack([slopes, jnp.full(lanes, 1e-3), jnp.ones(lanes)])
    nothing = jnp.zeros((3, lanes)), jnp.zeros((3, 3, lanes)), jnp.zeros((3, 2, lanes))
    begin = u, tangents, known, u, jnp.full(lanes, jnp.nan), *nothing, jnp.zeros(lanes), jnp.zeros(lanes, int)
    state = jax.lax.fori_loop(0, rounds, newton, begin)
    u = state[0]
    shot = integrate_membrane(membrane.material, u[0], u[1], u[2], fine)
    g = jnp.where(kinds == FOLD, 0.0, goal(u, shot.volume, state[7])[0])
    stretch_change = shot.stretch_change - (membrane.prestretch - u[0])
    residual = jnp.stack([stretch_change, condition.residual(u[1], shot.volume, u[2]), g])
    return _settle(membrane, condition, kinds, grid, (u, state[2], *state[5:]), residual, shot.volume)
