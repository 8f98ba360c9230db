"""Neutral points of modes as differentiable functions of every continuous parameter of a scene.

At a point where the lowest eigenvalue Λ_n of a number vanishes the equations are the rim condition, the loading condition, and
Λ_n(u) = 0. Derivatives of Λ_n are those of the eigenvalues of its matrix, dΛ = eᵀ dH e, with the state as a function of u too.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..diagram import voltage_volume
from ..model import PointKind, Scene, State
from ..modes import checked_numbers, lowest_eigenvalue
from ..numerics import Code, cached_jit
from .critical_points import CriticalPoint, check, engine_of, find, point_of, start_of
from .fixed_load import none
from .point_systems import Conditions, Solution, linearised, rates_of
from .rim import entries, perturbed

__all__ = ["mode_point"]


def mode_point(scene: Scene, number: int, *, throw: bool = True) -> CriticalPoint:
    """The point of least voltage at which the lowest mode of a `number` is neutral on an axisymmetrically stable state.

    It is the first of the `neutral_modes` of that number on the stable parts of the branches. Raises SceneError if there is none;
    inside transformations, or with `throw=False`, its numbers are NaN instead. First derivatives in forward and reverse mode.

    >>> import jax
    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=25000.0, initial_volume=2.42))
    >>> round(float(mode_point(scene, 10).voltage), 8)
    0.11644846
    """
    check(scene, None)
    (n,) = checked_numbers([number], 1, "number")
    found = find(("start", "mode"), scene, None, functools.partial(_search, number=n))
    _, theta = start_of(scene, found["start"], None)
    of = found["mode"]
    state = _attach(of.state, theta, n, engine_of(None, of.steps))
    return point_of(scene, of, state, throw)


def _search(scene: Scene, number: int) -> list[np.ndarray]:
    """The start of the ramp, and the neutral point."""
    diagram = voltage_volume(scene, modes=[number])
    starts = diagram.ramp()["start"]
    points = [p for p in diagram.special_points if p.kind == "mode" and p.index == 0 and p.voltage_squared > 0]
    found = [_row(min(points, key=lambda p: p.voltage)) if points else none(Code.no_neutral_mode)]
    return [_row(starts[0].state) if starts else none(Code.no_equilibrium), *found]


def _row(state: State) -> np.ndarray:
    u = state.apex_stretch, state.pressure, state.voltage_squared
    return np.array([*u, state.volume, state.error_estimate, float(Code.ok), np.nan])


@functools.cache
def _slopes(number: int, wanted: tuple):
    """∂Λ_n/∂u (3,) and ∂Λ_n/∂ the numbers of the wanted leaves of the membrane's material, as a compiled program."""

    def slopes(material, u):
        leaves, tree = jax.tree.flatten(material)
        columns = []
        for k in wanted:
            leaf = jnp.asarray(leaves[k], float)

            def of_leaf(leaf, k=k):
                changed = tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]])
                return lowest_eigenvalue(changed, u, number)

            columns += [jax.jvp(of_leaf, (leaf,), (jnp.asarray(entry),))[1] for entry in entries(leaf)]
        return jax.jacfwd(lambda u: lowest_eigenvalue(material, u, number))(u), jnp.array(columns)

    return cached_jit(slopes)


@eqx.filter_custom_jvp
def _attach(state: Solution, theta: Conditions, number: int, engine) -> Solution:
    """The `state`, known to be neutral for modes of the number, with its derivatives by θ."""
    return Solution(*map(jnp.asarray, state))


@_attach.def_jvp
def _(primals, tangents):
    state, theta, number, engine = primals
    state = _attach(state, theta, number, engine)
    which, moves = perturbed(tangents[1])
    if not which:
        return state, Solution(*map(jnp.zeros_like, state))
    u = jnp.stack(state[:3])
    _, by_u, by_theta = linearised(PointKind.load, which, engine, u, theta)
    # the leaves of the material are the first of θ; the eigenvalue depends on no other
    own = len(jax.tree.leaves(theta.membrane.material))
    of_u, of_material = _slopes(number, tuple(k for k in which if k < own))(theta.membrane.material, u)
    sizes = [jnp.size(move) for move in moves]
    rest = sum(size for k, size in zip(which, sizes, strict=True) if k >= own)
    by_u = by_u.at[2].set(of_u)
    by_theta = by_theta.at[2].set(jnp.concatenate([of_material, jnp.zeros(rest)]))
    rates = rates_of(by_u, by_theta)
    return state, Solution(*(rates @ jnp.concatenate([jnp.ravel(move) for move in moves])))
