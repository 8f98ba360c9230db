"""Critical points as solutions of small systems of equations, and their derivatives by the implicit function theorem.

A state is u = (λa, p, q). Its equations are the rim's r(u) = λ2(1) − λ0 = 0, the loading's g(p, V(u), q) = 0, and a third that
tells the point: a given load; breakdown; zero voltage; or a fold, det ∂(r, g)/∂(λa, p) = 0. With F(u, θ) = 0 the three, and
θ the parameters of membrane and loading, du = −F_u⁻¹ F_θ dθ.

The load of a fold needs less: with ψ the left null vector of ∂(r, g)/∂(λa, p), dq = −(ψ·(r, g)_θ)/(ψ·(r, g)_q) dθ, first
derivatives only, for the load is stationary along the branch.

Every rule builds its matrices in forward mode from values that are themselves differentiable by the same rule, and is linear in
dθ: so jvp, grad, vmap, and forward mode over either, nest.
"""

import typing

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .loading import Contour
from .membrane import Membrane, field_ratio_squared
from .shooting import shoot
from .surface import Surface

__all__ = [
    "AbstractEngine",
    "ByShooting",
    "Conditions",
    "OnSheet",
    "State4",
    "attach",
    "attach_load",
    "correction",
]

LEVEL, BREAKDOWN, FOLD, VOLUME, PRESSURE, PRESSURE_FOLD = (
    "level",
    "breakdown",
    "fold",
    "volume",
    "pressure",
    "pressure_fold",
)
_FOLDS = (FOLD, PRESSURE_FOLD)  # whose equations hold first derivatives


class AbstractEngine(eqx.Module):
    """Gives the rim's residual, zero in equilibrium, and the volume, at (λa, p, q)."""

    def rim(self, membrane: Membrane, u):
        """r and V at u = (λa, p, q), an array (2,)."""
        raise NotImplementedError


class ByShooting(AbstractEngine):
    """By shooting with `steps` steps: r = λ2(1) − λ0."""

    steps: typing.Any = 48.0

    def rim(self, membrane, u):
        end = shoot(membrane.material, u[0], u[1], u[2], steps=self.steps)
        return jnp.stack([end.lag - (membrane.prestretch - u[0]), end.volume])


class OnSheet(AbstractEngine):
    """By a surface: r = p − p(λa, q). Its derivatives by the membrane are those of the shot."""

    surface: Surface
    steps: typing.Any = 48.0

    def rim(self, membrane, u):
        held = eqx.tree_at(lambda m: m.breakdown, membrane, None)
        pressure, volume = _on_sheet(held, u[0], u[2], self)
        return jnp.stack([u[1] - pressure, volume])


@eqx.filter_custom_jvp
def _on_sheet(membrane, apex, q, engine):
    t = q / engine.surface.membrane.largest_load(apex)
    return tuple(engine.surface.at_load_fraction(apex, t, ("pressure", "volume")))


@_on_sheet.def_jvp
def _(primals, tangents):
    (membrane, apex, q, engine), (of_membrane, of_apex, of_q, _) = primals, tangents
    p, v = _on_sheet(membrane, apex, q, engine)
    moves = [jnp.zeros_like(p), jnp.zeros_like(v)]
    one, zero = jnp.ones_like(p), jnp.zeros_like(p)

    def along(of_apex, of_q):
        def plain(apex, q):
            t = q / engine.surface.membrane.largest_load(apex)
            return tuple(engine.surface.at_load_fraction(apex, t, ("pressure", "volume")))

        return jax.jvp(plain, (apex, q), (of_apex, of_q))[1]

    for direction, move in ((one, zero), of_apex), ((zero, one), of_q):
        if move is not None:
            moves = [m + rate * move for m, rate in zip(moves, along(*direction), strict=True)]
    leaves, tree = jax.tree.flatten(membrane, is_leaf=lambda v: v is None)
    wanted = [
        (k, move)
        for k, move in enumerate(jax.tree.leaves(of_membrane, is_leaf=lambda v: v is None))
        if move is not None
    ]
    if wanted:
        shots = ByShooting(engine.steps)
        at = jnp.stack([apex, p, q])
        slope = jax.jvp(lambda p: shots.rim(membrane, jnp.stack([apex, p, q])), (p,), (one,))[1]
        for k, move in wanted:

            def of_leaf(leaf, k=k):
                return shots.rim(tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]]), at)

            leaf = jnp.asarray(leaves[k], float)
            rate = jax.jvp(of_leaf, (leaf,), (jnp.ones_like(leaf),))[1]
            by_p = -rate[0] / slope[0]
            moves = [moves[0] + by_p * move, moves[1] + (rate[1] + slope[1] * by_p) * move]
    return (p, v), tuple(moves)


class Conditions(eqx.Module):
    """The equations of a kind of point: membrane, loading, and the target of kinds that have one (a load, V or p)."""

    membrane: Membrane
    contour: Contour
    target: typing.Any = 0.0


def _equations(kind: str, rim, slopes, u, theta: Conditions):
    """F(u, θ) (3,) from r and V (2,) and, for folds, their slopes (2, 3)."""
    contour, (residual, volume) = theta.contour, rim
    if kind == VOLUME:
        return jnp.stack([residual, volume - theta.target, u[2]])
    if kind == PRESSURE:
        return jnp.stack([residual, u[1] - theta.target, u[2]])
    if kind == PRESSURE_FOLD:
        return jnp.stack([residual, slopes[0, 0], u[2] - theta.target])
    condition = contour.residual(u[1], volume, u[2])
    if kind == LEVEL:
        last = u[2] - theta.target
    elif kind == BREAKDOWN:
        last = u[2] * field_ratio_squared(theta.membrane.breakdown, u[0], u[0]) - 1
    else:
        by_p, by_v, _ = contour.slopes(volume)
        last = slopes[0, 0] * (by_p + by_v * slopes[1, 1]) - slopes[0, 1] * by_v * slopes[1, 0]
    return jnp.stack([residual, condition, last])


def _bundle(kind: str, engine: AbstractEngine, membrane, u):
    """r and V (2,), and for folds their slopes by u (2, 3)."""
    if kind not in _FOLDS:
        return engine.rim(membrane, u), None

    def both(u):
        value = engine.rim(membrane, u)
        return value, value

    slopes, value = jax.jacfwd(both, has_aux=True)(u)
    return value, slopes


def _matrices(kind: str, wanted: tuple, engine: AbstractEngine, u, theta: Conditions):
    """F, F_u (3, 3), V_u (3,), and for every leaf of θ in `wanted` F_θ (3,) and V_θ."""
    leaves, tree = jax.tree.flatten(theta)
    shot = len(jax.tree.leaves((theta.membrane.material, theta.membrane.prestretch)))

    def at(u, theta, known=None):
        rim, slopes = known if known is not None else _bundle(kind, engine, theta.membrane, u)
        value = _equations(kind, rim, slopes, u, theta)
        return jnp.concatenate([value, rim[1:]]), (value, rim, slopes)

    by_u, (value, rim, slopes) = jax.jacfwd(at, has_aux=True)(u, theta)
    columns = []
    for k in wanted:
        # the leaves of the membrane come first, its breakdown law after what is shot
        known = None if k < shot else (rim, slopes)

        def of_leaf(leaf, k=k, known=known):
            return at(u, tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]]), known)[0]

        leaf = jnp.asarray(leaves[k], float)
        columns.append(jax.jvp(of_leaf, (leaf,), (jnp.ones_like(leaf),))[1])
    by_theta = jnp.stack(columns, axis=1) if columns else jnp.zeros((4, 0))
    return value, by_u[:3], by_u[3], by_theta[:3], by_theta[3]


def _solve(matrix, right):
    """x with matrix x = right, for 3 × 3: by cross products, which vmap to plain arithmetic; right is (3, k)."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=1, keepdims=True))
    a, b, c = matrix / size
    inverse = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1) / (a @ jnp.cross(b, c))
    return inverse @ (right / size)


@eqx.filter_jit
def correction(kind: str, engine: AbstractEngine, u, theta: Conditions):
    """F(u, θ) and Newton's move −F_u⁻¹ F of a kind of point."""
    value, by_u, of_volume, _, _ = _matrices(kind, (), engine, u, theta)
    return value, -_solve(by_u, value[:, None])[:, 0], of_volume


@eqx.filter_jit
def _sensitivity(kind: str, wanted: tuple, engine, u, theta):
    """∂(λa, p, q, V)/∂θ (4, wanted)."""
    _, by_u, volume_by_u, by_theta, volume_by_theta = _matrices(kind, wanted, engine, u, theta)
    move = -_solve(by_u, by_theta)
    return jnp.concatenate([move, (volume_by_theta + volume_by_u @ move)[None]])


@eqx.filter_jit
def _load_sensitivity(wanted: tuple, engine, u, theta):
    """∂q/∂θ (wanted,) of a fold of q."""
    # at a given load: the equations without their third
    _, by_u, _, by_theta, _ = _matrices(LEVEL, wanted, engine, u, theta)
    # null vector of the larger column's entries, so that neither may vanish
    one, two = by_u[:2, 0], by_u[:2, 1]
    scale = jax.lax.stop_gradient(jnp.abs(by_u[:2, :2]).max(axis=0))
    one, two = one / scale[0], two / scale[1]
    column = jnp.where(jnp.abs(one).max() > jnp.abs(two).max(), one, two)
    left = jnp.stack([column[1], -column[0]])
    return -(left @ by_theta[:2]) / (left @ by_u[:2, 2])


def _perturbed(tangents) -> tuple:
    """The leaves that move: their places, and their tangents."""
    moves = jax.tree.leaves(tangents, is_leaf=lambda v: v is None)
    which = tuple(k for k, move in enumerate(moves) if move is not None)
    return which, [moves[k] for k in which]


class State4(typing.NamedTuple):
    """λa, p, q and V of a state."""

    apex_stretch: Float[Array, ""]
    pressure: Float[Array, ""]
    voltage_squared: Float[Array, ""]
    volume: Float[Array, ""]


@eqx.filter_custom_jvp
def attach(state, theta, kind, engine):
    """The `state` (λa, p, q, V), known to solve the equations of `kind` at θ, with its derivatives by θ."""
    return state


@attach.def_jvp
def _(primals, tangents):
    state, theta, kind, engine = primals
    state = attach(state, theta, kind, engine)
    which, moves = _perturbed(tangents[1])
    if not which:
        return state, State4(*map(jnp.zeros_like, state))
    rates = _sensitivity(kind, which, engine, jnp.stack(state[:3]), theta)
    total = sum(rates[:, i] * move for i, move in enumerate(moves))
    return state, State4(*typing.cast(Array, total))


@eqx.filter_custom_jvp
def attach_load(load, state, theta, engine):
    """The load of a fold of q at a known state, with its derivatives by θ."""
    return load


@attach_load.def_jvp
def _(primals, tangents):
    load, state, theta, engine = primals
    which, moves = _perturbed(tangents[2])
    load = attach_load(load, state, theta, engine)
    if not which:
        return load, jnp.zeros_like(load)
    at = attach(state, theta, FOLD, engine)
    rates = _load_sensitivity(which, engine, jnp.stack(at[:3]), theta)
    return load, typing.cast(Array, sum(rates[i] * move for i, move in enumerate(moves)))
