"""Critical points as solutions of small systems of equations, and their derivatives by the implicit function theorem.

A state is u = (λa, p, q). Its equations are the rim's r(u) = λ2(1) − λ0 = 0, the loading's g(p, V(u), q) = 0, and a third that
tells the point: a given load; breakdown; zero voltage; or a fold, det ∂(r, g)/∂(λa, p) = 0. With F(u, θ) = 0 the three, and
θ the parameters of membrane and loading, du = −F_u⁻¹ F_θ dθ.

The load of a fold needs less: with ψ the left null vector of ∂(r, g)/∂(λa, p), dq = −(ψ·(r, g)_θ)/(ψ·(r, g)_q) dθ, first
derivatives only, for the load is stationary along the branch.

Every rule builds its matrices in forward mode from values that are themselves differentiable by the same rule, and is linear in
dθ: so jvp, grad, vmap, and forward mode over either, nest.
"""

import functools
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .kept import kept_jit
from .loading import Contour
from .membrane import Membrane, field_ratio_squared
from .shooting import shoot
from .surface import Surface

__all__ = [
    "AbstractEngine",
    "ByShooting",
    "Conditions",
    "OnSheet",
    "Solution",
    "attach",
    "attach_free",
    "correction",
]

LEVEL, BREAKDOWN, FOLD, VOLUME, PRESSURE = "level", "breakdown", "fold", "volume", "pressure"
PRESSURE_FOLD, ONSET, CUSP, PRESSURE_CUSP = "pressure_fold", "onset", "cusp", "pressure_cusp"
#: the order of the derivatives of r and V that the equations of a kind hold
_ORDER = {FOLD: 1, PRESSURE_FOLD: 1, ONSET: 1, CUSP: 2, PRESSURE_CUSP: 2}
#: kinds with a parameter among their unknowns: in place of q, which is then given, or beside it
_INSTEAD, _BESIDE = (ONSET, PRESSURE_CUSP), (CUSP,)


class AbstractEngine(eqx.Module):
    """Gives the rim's residual, zero in equilibrium, and the volume, at (λa, p, q)."""

    def rim(self, membrane: Membrane, u):
        """What the residual r is made of, and V, at u = (λa, p, q), an array (2,)."""
        raise NotImplementedError

    def residual(self, membrane: Membrane, u, given):
        """r from the first result of `rim`."""
        raise NotImplementedError

    def own_leaves(self, membrane: Membrane) -> int:
        """How many of the membrane's leaves, the first ones, `rim` depends on."""
        raise NotImplementedError


class ByShooting(AbstractEngine):
    """By shooting with `steps` steps: r = λ2(1) − λ0."""

    steps: typing.Any = 48.0

    def rim(self, membrane, u):
        end = shoot(membrane.material, u[0], u[1], u[2], steps=self.steps)
        return jnp.stack([end.lag, end.volume])

    def residual(self, membrane, u, given):
        return given - (membrane.prestretch - u[0])

    def own_leaves(self, membrane):
        return len(jax.tree.leaves(membrane.material))


class OnSheet(AbstractEngine):
    """By a surface: r = p − p(λa, q). Its derivatives by the membrane are those of the shot."""

    surface: Surface
    steps: typing.Any = 48.0

    def rim(self, membrane, u):
        own = membrane.material, membrane.prestretch
        return jnp.stack(_on_sheet(own, u[0], u[2], self))

    def residual(self, membrane, u, given):
        return u[1] - given

    def own_leaves(self, membrane):
        return len(jax.tree.leaves(membrane.material)) + 1


def _read(engine: OnSheet, apex, q):
    t = q / engine.surface.membrane.largest_load(apex)
    return tuple(engine.surface.at_load_fraction(apex, t, ("pressure", "volume")))


@eqx.filter_custom_jvp
def _on_sheet(own, apex, q, engine):
    return _read(engine, apex, q)


@_on_sheet.def_jvp
def _(primals, tangents):
    (own, apex, q, engine), (of_own, of_apex, of_q, _) = primals, tangents
    p, v = _on_sheet(own, apex, q, engine)
    moves = [jnp.zeros_like(p), jnp.zeros_like(v)]
    one, zero = jnp.ones_like(p), jnp.zeros_like(p)
    for direction, move in ((one, zero), of_apex), ((zero, one), of_q):
        if move is not None:
            rates = jax.jvp(lambda a, q: _read(engine, a, q), (apex, q), direction)[1]
            moves = [m + rate * move for m, rate in zip(moves, rates, strict=True)]
    leaves, tree = jax.tree.flatten(own)
    which, wanted = _perturbed(of_own)
    if which:

        def shot(p, leaves):
            material, prestretch = tree.unflatten(leaves)
            end = shoot(material, apex, p, q, steps=engine.steps)
            return end.lag - (prestretch - apex), end.volume

        slope = jax.jvp(lambda p: shot(p, leaves), (p,), (one,))[1]
        for k, move in zip(which, wanted, strict=True):
            leaf = jnp.asarray(leaves[k], float)
            rate = jax.jvp(
                lambda leaf, k=k: shot(p, [*leaves[:k], leaf, *leaves[k + 1 :]]), (leaf,), (jnp.ones_like(leaf),)
            )[1]
            by_p = -rate[0] / slope[0]
            moves = [moves[0] + by_p * move, moves[1] + (rate[1] + slope[1] * by_p) * move]
    return (p, v), tuple(moves)


class Conditions(eqx.Module):
    """The equations of a kind of point: membrane, loading, and the target of kinds that have one (a load, V or p)."""

    membrane: Membrane
    contour: Contour
    target: typing.Any = 0.0


def _towers(engine: AbstractEngine, membrane, u, order: int):
    """`rim` and its derivatives by u up to an order: arrays (2,), (2, 3), (2, 3, 3), …"""
    if order == 0:
        return (engine.rim(membrane, u),)

    def lower(u):
        values = _towers(engine, membrane, u, order - 1)
        return values[-1], values

    highest, values = jax.jacfwd(lower, has_aux=True)(u)
    return (*values, highest)


@functools.cache
def _towers_program(order: int):
    def towers(engine, membrane, u):
        return _towers(engine, membrane, u, order)

    towers.__name__ = f"towers_{order}"
    return kept_jit(towers)


@functools.cache
def _towers_by_leaf_program(order: int, k: int):
    """The derivatives of the towers by leaf k of the membrane."""

    def towers_by_leaf(engine, membrane, u):
        leaves, tree = jax.tree.flatten(membrane)

        def of_leaf(leaf):
            return _towers(engine, tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]]), u, order)

        leaf = jnp.asarray(leaves[k], float)
        return jax.jvp(of_leaf, (leaf,), (jnp.ones_like(leaf),))[1]

    towers_by_leaf.__name__ = f"towers_{order}_by_{k}"
    return kept_jit(towers_by_leaf)


def _held(membrane: Membrane) -> Membrane:
    """The membrane without its breakdown law, which no shot depends on."""
    return eqx.tree_at(lambda m: m.breakdown, membrane, None)


def _equations(kind: str, engine: AbstractEngine, rims, u, theta: Conditions):
    """F(u, θ) and V, from `rim` and as many of its derivatives as the kind needs."""
    contour = theta.contour

    def determinant(rim, slopes, u):
        """det ∂(r, g)/∂(λa, p), and ∂r/∂(λa, p)."""
        by_r = jax.jvp(lambda g, u: engine.residual(theta.membrane, u, g), (rim[0], u), (slopes[0, 0], _AXES[0]))[1]
        by_p = jax.jvp(lambda g, u: engine.residual(theta.membrane, u, g), (rim[0], u), (slopes[0, 1], _AXES[1]))[1]
        of_p, of_v, _ = contour.slopes(rim[1])
        return by_r * (of_p + of_v * slopes[1, 1]) - by_p * of_v * slopes[1, 0], by_r, by_p

    rim = rims[0]
    residual = engine.residual(theta.membrane, u, rim[0])
    if kind == VOLUME:
        rows = [residual, rim[1] - theta.target, u[2]]
    elif kind == PRESSURE:
        rows = [residual, u[1] - theta.target, u[2]]
    elif kind in (PRESSURE_FOLD, PRESSURE_CUSP):
        rows = [residual, determinant(rim, rims[1], u)[1]]
        if kind == PRESSURE_FOLD:
            rows.append(u[2] - theta.target)
        else:
            push = rims[1] @ _AXES[0], rims[2] @ _AXES[0], _AXES[0]
            rows.append(jax.jvp(lambda *v: determinant(*v)[1], (rim, rims[1], u), push)[1])
    else:
        rows = [residual, contour.residual(u[1], rim[1], u[2])]
        if kind == LEVEL:
            rows.append(u[2] - theta.target)
        elif kind == BREAKDOWN:
            rows.append(u[2] * field_ratio_squared(theta.membrane.breakdown, u[0], u[0]) - 1)
        else:
            value, by_r, by_p = determinant(rim, rims[1], u)
            rows.append(value)
            if kind == CUSP:
                null = jnp.stack([-by_p, by_r, jnp.zeros_like(by_r)])
                push = rims[1] @ null, rims[2] @ null, null
                rows.append(jax.jvp(lambda *v: determinant(*v)[0], (rim, rims[1], u), push)[1])
    return jnp.stack([*rows, rim[1]])


_AXES = np.eye(3)


@functools.partial(jax.jit, static_argnames=("kind", "wanted"))
def _assemble(kind: str, wanted: tuple, engine, u, theta: Conditions, rims, by_leaf: dict):
    """F and V (k,), and their derivatives by u (k, 3) and by the leaves of θ in `wanted` (k, wanted).

    `rims` holds one derivative more than the equations do, `by_leaf` the derivatives of all but that by leaves.
    """
    leaves, tree = jax.tree.flatten(theta)
    known, above = rims[:-1], rims[1:]

    def of(rims, u, theta):
        return _equations(kind, engine, rims, u, theta)

    value = of(known, u, theta)
    by_u = [
        jax.jvp(lambda rims, u: of(rims, u, theta), (known, u), (tuple(v[..., k] for v in above), jnp.asarray(_AXES[k])))[1]
        for k in range(3)
    ]
    columns = []
    for k in wanted:

        def of_leaf(rims, leaf, k=k):
            return of(rims, u, tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]]))

        leaf = jnp.asarray(leaves[k], float)
        push = by_leaf[k] if k in by_leaf else tuple(map(jnp.zeros_like, known))
        columns.append(jax.jvp(of_leaf, (known, leaf), (push, jnp.ones_like(leaf)))[1])
    by_theta = jnp.stack(columns, axis=1) if columns else jnp.zeros((len(value), 0))
    return value, jnp.stack(by_u, axis=1), by_theta


def _matrices(kind: str, wanted: tuple, engine: AbstractEngine, u, theta: Conditions):
    """`_assemble`, with the shots it needs."""
    order, held = _ORDER.get(kind, 0), _held(theta.membrane)
    rims = _towers_program(order + 1)(engine, held, u)
    own = [k for k in wanted if k < engine.own_leaves(held)]
    by_leaf = {k: tuple(_towers_by_leaf_program(order, k)(engine, held, u)) for k in own}
    return _assemble(kind, wanted, engine, u, theta, tuple(rims), by_leaf)


def _unknowns(kind: str, free: int | None, by_u, by_theta):
    """The columns of a kind's unknowns: λa, p, and q or the free parameter, which is the last column of θ, or both."""
    if kind in _INSTEAD:
        return jnp.concatenate([by_u[:, :2], by_theta[:, -1:]], axis=1)
    if kind in _BESIDE:
        return jnp.concatenate([by_u, by_theta[:, -1:]], axis=1)
    return by_u


def _solve(matrix, right):
    """x (n, k) with matrix x = right, rows scaled; 3 × 3 by cross products, which vmap to plain arithmetic."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=1, keepdims=True))
    matrix, right = matrix / size, right / size
    if len(matrix) != 3:
        return jnp.linalg.solve(matrix, right)
    a, b, c = matrix
    inverse = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1) / (a @ jnp.cross(b, c))
    return inverse @ right


@functools.partial(jax.jit, static_argnames=("kind", "free"))
def _move(kind: str, free, value, by_u, by_theta):
    return -_solve(_unknowns(kind, free, by_u, by_theta)[:-1], value[:-1, None])[:, 0]


def correction(kind: str, engine: AbstractEngine, u, theta: Conditions, free: int | None = None):
    """F(u, θ), Newton's move −F_x⁻¹ F of the unknowns x of a kind of point, and V.

    The unknowns are (λa, p, q), or with a `free` leaf of θ (λa, p, leaf) or (λa, p, q, leaf).
    """
    value, by_u, by_theta = _matrices(kind, () if free is None else (free,), engine, u, theta)
    return value[:-1], _move(kind, free, value, by_u, by_theta), value[-1]


@functools.partial(jax.jit, static_argnames=("kind", "free"))
def _rates(kind: str, free, by_u, by_theta):
    """Derivatives of λa, p, q, V, and of the free parameter, by the other leaves."""
    asked = by_theta if free is None else by_theta[:, :-1]
    move = -_solve(_unknowns(kind, free, by_u, by_theta)[:-1], asked[:-1])
    zero = jnp.zeros_like(move[:1])
    of_u = jnp.concatenate([move[:2], zero]) if kind in _INSTEAD else move[:3]
    of_free = zero if free is None else move[-1:]
    volume = asked[-1:] + by_u[-1:] @ of_u
    if free is not None:
        volume = volume + by_theta[-1:, -1:] @ of_free
    return jnp.concatenate([of_u, volume, of_free])


@functools.partial(jax.jit, static_argnames=("free",))
def _free_rates(free, by_u, by_theta):
    """Derivatives of what a fold is a fold of, q or the free parameter, by the other leaves: first derivatives only."""
    one, two = by_u[:2, 0], by_u[:2, 1]
    scale = jax.lax.stop_gradient(jnp.abs(by_u[:2, :2]).max(axis=0))
    one, two = one / scale[0], two / scale[1]
    column = jnp.where(jnp.abs(one).max() > jnp.abs(two).max(), one, two)
    left = jnp.stack([column[1], -column[0]])
    asked, own = (by_theta, by_u[:, 2]) if free is None else (by_theta[:, :-1], by_theta[:, -1])
    return -(left @ asked[:2]) / (left @ own[:2])


def _perturbed(tangents) -> tuple:
    """The leaves that move: their places, and their tangents."""
    moves = jax.tree.leaves(tangents, is_leaf=lambda v: v is None)
    which = tuple(k for k, move in enumerate(moves) if move is not None)
    return which, [moves[k] for k in which]


class Solution(typing.NamedTuple):
    """λa, p, q and V of a state, and the value of its free parameter, 0 where there is none."""

    apex_stretch: Float[Array, ""]
    pressure: Float[Array, ""]
    voltage_squared: Float[Array, ""]
    volume: Float[Array, ""]
    free: typing.Any = 0.0


def _with_free(theta: Conditions, free: int | None, value) -> Conditions:
    """θ with its free leaf at a value."""
    if free is None:
        return theta
    leaves, tree = jax.tree.flatten(theta)
    return tree.unflatten([*leaves[:free], value, *leaves[free + 1 :]])


def attach(state: Solution, theta: Conditions, kind: str, engine: AbstractEngine, free: int | None = None) -> Solution:
    """The `state`, known to solve the equations of `kind` at θ, with its derivatives by θ.

    `free` names the leaf of θ that is an unknown itself; its value is the state's.
    """
    return _attach(state, theta, kind, engine, free)


def attach_free(value, state: Solution, theta: Conditions, engine: AbstractEngine, free: int | None = None):
    """What a known fold is a fold of, its load q or with `free` that leaf of θ, with its derivatives by θ."""
    return _attach_free(value, state, theta, engine, free)


@eqx.filter_custom_jvp
def _attach(state, theta, kind, engine, free):
    return Solution(*map(jnp.asarray, state))


@_attach.def_jvp
def _(primals, tangents):
    state, theta, kind, engine, free = primals
    state = _attach(state, theta, kind, engine, free)
    which, moves = _perturbed(tangents[1])
    moves = [move for k, move in zip(which, moves, strict=True) if k != free]
    which = tuple(k for k in which if k != free)
    if not which:
        return state, Solution(*map(jnp.zeros_like, state))
    at = _with_free(theta, free, state.free)
    wanted = which if free is None else (*which, free)
    _, by_u, by_theta = _matrices(kind, wanted, engine, jnp.stack(state[:3]), at)
    rates = _rates(kind, free, by_u, by_theta)
    total = sum(rates[:, i] * move for i, move in enumerate(moves))
    return state, Solution(*typing.cast(Array, total))


@eqx.filter_custom_jvp
def _attach_free(value, state, theta, engine, free):
    return jnp.asarray(value)


@_attach_free.def_jvp
def _(primals, tangents):
    value, state, theta, engine, free = primals
    which, moves = _perturbed(tangents[2])
    moves = [move for k, move in zip(which, moves, strict=True) if k != free]
    which = tuple(k for k in which if k != free)
    value = _attach_free(value, state, theta, engine, free)
    if not which:
        return value, jnp.zeros_like(value)
    at = _attach(state, theta, FOLD if free is None else ONSET, engine, free)
    wanted = which if free is None else (*which, free)
    # at a given load: the equations without their third
    _, by_u, by_theta = _matrices(LEVEL, wanted, engine, jnp.stack(at[:3]), _with_free(theta, free, at.free))
    rates = _free_rates(free, by_u, by_theta)
    return value, typing.cast(Array, sum(rates[i] * move for i, move in enumerate(moves)))
