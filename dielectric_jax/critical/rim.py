"""Two engines that compute the rim's residual and the volume with all derivatives: shooting, and a surface."""

import functools
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..model import Membrane, shoot
from ..numerics import cached_jit
from ..surface import Surface

__all__ = ["AbstractRim", "ShotRim", "SurfaceRim", "entries", "jets", "perturbed"]


class AbstractRim(eqx.Module):
    """Computes the rim's residual, which is zero in equilibrium, and the volume, at (λa, p, q)."""

    def rim(self, membrane: Membrane, u):
        """The quantity from which the residual r is computed, and V, at u = (λa, p, q), an array (2,)."""
        raise NotImplementedError

    def residual(self, membrane: Membrane, u, given):
        """r from the first result of `rim`."""
        raise NotImplementedError

    def own_leaves(self, membrane: Membrane) -> int:
        """The number of leading leaves of the membrane that `rim` depends on."""
        raise NotImplementedError


class ShotRim(AbstractRim):
    """By shooting with `steps` steps: r = λ2(1) − λ0."""

    steps: typing.Any

    def rim(self, membrane, u):
        end = shoot(membrane.material, u[0], u[1], u[2], steps=self.steps)
        return jnp.stack([end.stretch_change, end.volume])

    def residual(self, membrane, u, given):
        return given - (membrane.prestretch - u[0])

    def own_leaves(self, membrane):
        return len(jax.tree.leaves(membrane.material))


class SurfaceRim(AbstractRim):
    """By a surface: r = p − p(λa, q). Its derivatives with respect to the membrane are those of the shot."""

    surface: Surface
    steps: typing.Any

    def rim(self, membrane, u):
        own = membrane.material, membrane.prestretch
        return _on_surface(own, jnp.stack([u[0], u[2]]), 0, self)

    def residual(self, membrane, u, given):
        return u[1] - given

    def own_leaves(self, membrane):
        return len(jax.tree.leaves(membrane.material)) + 1


def _derivatives(function, order: int):
    """The derivatives of an order of a function of one array."""
    for _ in range(order):
        function = jax.jacfwd(function)
    return function


@eqx.filter_custom_jvp
def _on_surface(own, place, order, engine):
    """The derivatives of an order of p and V by `place` (λa, q): an array (2, 2, …).

    A surface belongs to one membrane. The derivatives with respect to `own`, material and prestretch, come from the shot, at
    every order, so that mixed derivatives are available.
    """

    def read(place):
        t = place[1] / engine.surface.membrane.largest_load(place[0])
        return jnp.stack(engine.surface.at_load_fraction(place[0], t, ("pressure", "volume")))

    return _derivatives(read, order)(place)


@_on_surface.def_jvp
def _(primals, tangents):
    (own, place, order, engine), (of_own, of_place, _, _) = primals, tangents
    value = _on_surface(own, place, order, engine)
    moved = jnp.zeros_like(value)
    if of_place is not None:
        moved = moved + _on_surface(own, place, order + 1, engine) @ of_place
    leaves, tree = jax.tree.flatten(own)
    for k, move in zip(*perturbed(of_own), strict=True):
        leaf = jnp.asarray(leaves[k], float)
        for entry, share in zip(entries(leaf), jnp.ravel(move), strict=True):

            def by_leaf(place, k=k, leaf=leaf, entry=entry):
                """∂p/∂m = −(∂r/∂m)/(∂r/∂p), r the rim's residual, and ∂V/∂m at given (λa, q)."""
                p = _on_surface(own, place, 0, engine)[0]

                def shot(p, size):
                    material, prestretch = tree.unflatten([*leaves[:k], leaf + size * entry, *leaves[k + 1 :]])
                    end = shoot(material, place[0], p, place[1], steps=engine.steps)
                    return jnp.stack([end.stretch_change - (prestretch - place[0]), end.volume])

                of_p, of_leaf = jax.jacfwd(shot, (0, 1))(p, 0.0)
                by_p = -of_leaf[0] / of_p[0]
                return jnp.stack([by_p, of_leaf[1] + of_p[1] * by_p])

            moved = moved + _derivatives(by_leaf, order)(place) * share
    return value, moved


def entries(leaf) -> list[np.ndarray]:
    """The unit directions of a leaf, one for each of its numbers."""
    shape = jnp.shape(leaf)
    return list(np.eye(max(int(np.prod(shape)), 1)).reshape(-1, *shape))


def perturbed(tangents) -> tuple:
    """The leaves that vary: their positions and their tangents."""
    moves = jax.tree.leaves(tangents, is_leaf=lambda v: v is None)
    which = tuple(k for k, move in enumerate(moves) if move is not None)
    return which, [moves[k] for k in which]


def _jets(engine: AbstractRim, membrane, u, order: int):
    """`rim` and its derivatives by u up to an order: arrays (2,), (2, 3), (2, 3, 3), …"""
    if order == 0:
        return (engine.rim(membrane, u),)

    def lower(u):
        values = _jets(engine, membrane, u, order - 1)
        return values[-1], values

    highest, values = jax.jacfwd(lower, has_aux=True)(u)
    return (*values, highest)


@functools.cache
def _jets_program(order: int):
    def jets(engine, membrane, u):
        return _jets(engine, membrane, u, order)

    jets.__name__ = f"jets_{order}"
    return cached_jit(jets)


@functools.cache
def _jets_by_leaf_program(order: int, k: int):
    """The derivatives of the jets by leaf k of the membrane, with a last axis over the numbers of the leaf."""

    def jets_by_leaf(engine, membrane, u):
        leaves, tree = jax.tree.flatten(membrane)

        def of_leaf(leaf):
            return _jets(engine, tree.unflatten([*leaves[:k], leaf, *leaves[k + 1 :]]), u, order)

        leaf = jnp.asarray(leaves[k], float)
        columns = [jax.jvp(of_leaf, (leaf,), (jnp.asarray(entry),))[1] for entry in entries(leaf)]
        return jax.tree.map(lambda *v: jnp.stack(v, axis=-1), *columns)

    jets_by_leaf.__name__ = f"jets_{order}_by_{k}"
    return cached_jit(jets_by_leaf)


def _held(membrane: Membrane) -> Membrane:
    """The membrane without its breakdown law, on which no shot depends."""
    return eqx.tree_at(lambda m: m.breakdown, membrane, None)


def jets(engine: AbstractRim, membrane: Membrane, u, order: int, leaves: tuple):
    """`rim` and its derivatives by u up to order + 1, and for each of the membrane's leaves those up to order by it."""
    held = _held(membrane)
    rims = _jets_program(order + 1)(engine, held, u)
    own = [k for k in leaves if k < engine.own_leaves(held)]
    return tuple(rims), {k: tuple(_jets_by_leaf_program(order, k)(engine, held, u)) for k in own}
