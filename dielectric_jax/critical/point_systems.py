"""Critical points as solutions of small systems of equations, and their derivatives by the implicit function theorem.

A state is u = (λa, p, q). Its equations are the rim condition r(u) = λ2(1) − λ0 = 0, the loading condition g(p, V(u), q) = 0, and
a third that selects the point: a given load; breakdown; zero voltage; or a fold, det ∂(r, g)/∂(λa, p) = 0. If F(u, θ) = 0 are the
three equations and θ the parameters of membrane and loading, then du = −F_u⁻¹ F_θ dθ.

The load of a fold needs less: with ψ the left null vector of ∂(r, g)/∂(λa, p), dq = −(ψ·(r, g)_θ)/(ψ·(r, g)_q) dθ needs first
derivatives only, because the load is stationary along the branch.

Every rule builds its matrices in forward mode from values that are themselves differentiable by the same rule, and is linear in
dθ. Therefore jvp, grad, vmap, and forward mode over either can be nested.
"""

import functools
import typing
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import LoadingCondition, Membrane, PointKind, field_ratio_squared
from ..numerics import cached_jit
from .rim import AbstractRim, entries, jets, perturbed

__all__ = [
    "Conditions",
    "Solution",
    "attach",
    "attach_free",
    "correction",
    "linearised",
    "rates_of",
]

#: the order of the derivatives of r and V in the equations of a kind
_ORDER = {
    PointKind.fold: 1,
    PointKind.pressure_fold: 1,
    PointKind.onset: 1,
    PointKind.cusp: 2,
    PointKind.pressure_cusp: 2,
}
#: kinds with a parameter among their unknowns: in place of q, which is then given, or beside it
_INSTEAD, _BESIDE = (PointKind.onset,), (PointKind.cusp, PointKind.pressure_cusp)


class Conditions(eqx.Module):
    """The equations of a kind of point: membrane, loading, and the target of kinds that have one (a load, V or p)."""

    membrane: Membrane
    condition: LoadingCondition
    target: typing.Any = 0.0


def _equations(kind: PointKind, engine: AbstractRim, rims, u, theta: Conditions):
    """F(u, θ) and V, from `rim` and the derivatives of it that the kind needs."""
    condition = theta.condition

    def determinant(rim, slopes, u):
        """det ∂(r, g)/∂(λa, p), and ∂r/∂(λa, p)."""
        by_r = jax.jvp(lambda g, u: engine.residual(theta.membrane, u, g), (rim[0], u), (slopes[0, 0], _AXES[0]))[1]
        by_p = jax.jvp(lambda g, u: engine.residual(theta.membrane, u, g), (rim[0], u), (slopes[0, 1], _AXES[1]))[1]
        of_p, of_v, _ = condition.slopes(rim[1])
        return by_r * (of_p + of_v * slopes[1, 1]) - by_p * of_v * slopes[1, 0], by_r, by_p

    rim = rims[0]
    residual = engine.residual(theta.membrane, u, rim[0])
    if kind == PointKind.volume:
        rows = [residual, rim[1] - theta.target, u[2]]
    elif kind == PointKind.pressure:
        rows = [residual, u[1] - theta.target, u[2]]
    elif kind in (PointKind.pressure_fold, PointKind.pressure_cusp):
        rows = [residual, determinant(rim, rims[1], u)[1], u[2] - theta.target]
        if kind == PointKind.pressure_cusp:
            push = rims[1] @ _AXES[0], rims[2] @ _AXES[0], _AXES[0]
            rows.append(jax.jvp(lambda *v: determinant(*v)[1], (rim, rims[1], u), push)[1])
    else:
        rows = [residual, condition.residual(u[1], rim[1], u[2])]
        if kind == PointKind.load:
            rows.append(u[2] - theta.target)
        elif kind == PointKind.breakdown:
            rows.append(u[2] * field_ratio_squared(theta.membrane.breakdown, u[0], u[0]) - 1)
        else:
            value, by_r, by_p = determinant(rim, rims[1], u)
            rows.append(value)
            if kind == PointKind.cusp:
                null = jnp.stack([-by_p, by_r, jnp.zeros_like(by_r)])
                push = rims[1] @ null, rims[2] @ null, null
                rows.append(jax.jvp(lambda *v: determinant(*v)[0], (rim, rims[1], u), push)[1])
    return jnp.stack([*rows, rim[1]])


_AXES = np.eye(3)


@functools.cache
def _program(function: Callable, *fixed) -> Callable:
    """A function with its first arguments fixed, as a compiled program; the number of kinds of points is small."""

    def program(*args):
        return function(*fixed, *args)

    program.__name__ = function.__name__.strip("_")
    return cached_jit(program)


def _assemble(kind: PointKind, wanted: tuple, engine, u, theta: Conditions, rims, by_leaf: dict):
    """F and V (k,), and their derivatives by u (k, 3) and by the numbers in the leaves of θ in `wanted` (k, numbers).

    `rims` holds one derivative more than the equations contain; `by_leaf` holds the derivatives of all others by leaves.
    """
    leaves, tree = jax.tree.flatten(theta)
    known, above = rims[:-1], rims[1:]

    def of(rims, u, theta):
        return _equations(kind, engine, rims, u, theta)

    value = of(known, u, theta)
    by_u = [
        jax.jvp(
            lambda rims, u: of(rims, u, theta), (known, u), (tuple(v[..., k] for v in above), jnp.asarray(_AXES[k]))
        )[1]
        for k in range(3)
    ]
    columns = []
    for k in wanted:

        def of_leaf(rims, leaf, k=k):
            return of(rims, u, tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]]))

        leaf = jnp.asarray(leaves[k], float)
        for j, entry in enumerate(entries(leaf)):
            push = tuple(v[..., j] for v in by_leaf[k]) if k in by_leaf else tuple(map(jnp.zeros_like, known))
            columns.append(jax.jvp(of_leaf, (known, leaf), (push, jnp.asarray(entry)))[1])
    by_theta = jnp.stack(columns, axis=1) if columns else jnp.zeros((len(value), 0))
    return value, jnp.stack(by_u, axis=1), by_theta


def linearised(kind: PointKind, wanted: tuple, engine: AbstractRim, u, theta: Conditions):
    """F and V (k,), their derivatives by u (k, 3), and by the numbers in the leaves of θ in `wanted` (k, numbers)."""
    rims, by_leaf = jets(engine, theta.membrane, u, _ORDER.get(kind, 0), wanted)
    return _program(_assemble, kind, wanted)(engine, u, theta, rims, by_leaf)


def _unknowns(kind: PointKind, by_u, by_theta):
    """The columns of a kind's unknowns: λa, p, and q or the free parameter, which is the last column of θ, or both."""
    if kind in _INSTEAD:
        return jnp.concatenate([by_u[:, :2], by_theta[:, -1:]], axis=1)
    if kind in _BESIDE:
        return jnp.concatenate([by_u, by_theta[:, -1:]], axis=1)
    return by_u


def _solve(matrix, right):
    """x (n, k) with matrix x = right, rows scaled; 3 × 3 systems by cross products, which become plain arithmetic under vmap."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=1, keepdims=True))
    matrix, right = matrix / size, right / size
    if len(matrix) != 3:
        return jnp.linalg.solve(matrix, right)
    a, b, c = matrix
    inverse = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1) / (a @ jnp.cross(b, c))
    return inverse @ right


def _moved(kind: PointKind, value, by_u, by_theta):
    """The Newton step, and V after it."""
    columns = _unknowns(kind, by_u, by_theta)
    move = -_solve(columns[:-1], value[:-1, None])[:, 0]
    return move, value[-1] + columns[-1] @ move


def correction(kind: PointKind, engine: AbstractRim, u, theta: Conditions, free: int | None = None):
    """F(u, θ), the Newton step −F_x⁻¹ F of the unknowns x of a kind of point, and V after it, to first order.

    The unknowns are (λa, p, q), or with a `free` leaf of θ (λa, p, leaf) or (λa, p, q, leaf).
    """
    value, by_u, by_theta = linearised(kind, () if free is None else (free,), engine, u, theta)
    return value[:-1], *_program(_moved, kind)(value, by_u, by_theta)


def _rates(kind: PointKind, free, by_u, by_theta):
    """Derivatives of λa, p, q, V, and of the free parameter, by the other leaves."""
    asked = by_theta if free is None else by_theta[:, :-1]
    move = -_solve(_unknowns(kind, by_u, by_theta)[:-1], asked[:-1])
    zero = jnp.zeros_like(move[:1])
    of_u = jnp.concatenate([move[:2], zero]) if kind in _INSTEAD else move[:3]
    of_free = zero if free is None else move[-1:]
    volume = asked[-1:] + by_u[-1:] @ of_u
    if free is not None:
        volume = volume + by_theta[-1:, -1:] @ of_free
    return jnp.concatenate([of_u, volume, of_free])


def rates_of(by_u, by_theta):
    """Derivatives of λa, p, q, V, and 0, by the leaves of θ, of a point that three equations determine."""
    return _program(_rates, PointKind.load, None)(by_u, by_theta)


def _free_rates(free, by_u, by_theta):
    """Derivatives of the control of a fold, q or the free parameter, by the other leaves, from first derivatives only."""
    one, two = by_u[:2, 0], by_u[:2, 1]
    scale = jax.lax.stop_gradient(jnp.abs(by_u[:2, :2]).max(axis=0))
    one, two = one / scale[0], two / scale[1]
    column = jnp.where(jnp.abs(one).max() > jnp.abs(two).max(), one, two)
    left = jnp.stack([column[1], -column[0]])
    asked, own = (by_theta, by_u[:, 2]) if free is None else (by_theta[:, :-1], by_theta[:, -1])
    return -(left @ asked[:2]) / (left @ own[:2])


class Solution(typing.NamedTuple):
    """λa, p, q and V of a state, and the value of its free parameter, 0 if there is none."""

    apex_stretch: Float[Array, ""]
    pressure: Float[Array, ""]
    voltage_squared: Float[Array, ""]
    volume: Float[Array, ""]
    free: typing.Any = 0.0


def _with_free(theta: Conditions, free: int | None, value) -> Conditions:
    """θ with its free leaf set to a value."""
    if free is None:
        return theta
    leaves, tree = jax.tree.flatten(theta)
    return tree.unflatten([*leaves[:free], value, *leaves[free + 1 :]])


def attach(
    state: Solution, theta: Conditions, kind: PointKind, engine: AbstractRim, free: int | None = None
) -> Solution:
    """The `state`, known to solve the equations of `kind` at θ, with its derivatives by θ.

    `free` names the leaf of θ that is itself an unknown; its value is taken from the state.
    """
    return _attach(state, theta, kind, engine, free)


def attach_free(value, state: Solution, theta: Conditions, engine: AbstractRim, free: int | None = None):
    """The control of a known fold, its load q or with `free` that leaf of θ, with its derivatives by θ."""
    return _attach_free(value, state, theta, engine, free)


@eqx.filter_custom_jvp
def _attach(state, theta, kind, engine, free):
    return Solution(*map(jnp.asarray, state))


@_attach.def_jvp
def _(primals, tangents):
    state, theta, kind, engine, free = primals
    state = _attach(state, theta, kind, engine, free)
    which, moves = perturbed(tangents[1])
    moves = [move for k, move in zip(which, moves, strict=True) if k != free]
    which = tuple(k for k in which if k != free)
    if not which:
        return state, Solution(*map(jnp.zeros_like, state))
    at = _with_free(theta, free, state.free)
    wanted = which if free is None else (*which, free)
    _, by_u, by_theta = linearised(kind, wanted, engine, jnp.stack(state[:3]), at)
    rates = _program(_rates, kind, free)(by_u, by_theta)
    return state, Solution(*(rates @ _numbers(moves)))


@eqx.filter_custom_jvp
def _attach_free(value, state, theta, engine, free):
    return jnp.asarray(value)


@_attach_free.def_jvp
def _(primals, tangents):
    value, state, theta, engine, free = primals
    which, moves = perturbed(tangents[2])
    moves = [move for k, move in zip(which, moves, strict=True) if k != free]
    which = tuple(k for k in which if k != free)
    value = _attach_free(value, state, theta, engine, free)
    if not which:
        return value, jnp.zeros_like(value)
    at = _attach(state, theta, PointKind.fold if free is None else PointKind.onset, engine, free)
    wanted = which if free is None else (*which, free)
    # at a given load: the equations without the third one
    _, by_u, by_theta = linearised(PointKind.load, wanted, engine, jnp.stack(at[:3]), _with_free(theta, free, at.free))
    rates = _program(_free_rates, free)(by_u, by_theta)
    return value, rates @ _numbers(moves)


def _numbers(moves):
    """The numbers of several leaves, one after the other."""
    return jnp.concatenate([jnp.ravel(move) for move in moves])
