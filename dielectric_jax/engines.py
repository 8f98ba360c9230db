"""Two engines that give the rim's residual and the volume with all derivatives: shooting, and a surface."""

import functools
import typing

import equinox as eqx
import jax
import jax.numpy as jnp

from .kept import kept_jit
from .membrane import Membrane
from .shooting import shoot
from .surface import Surface

__all__ = ["AbstractEngine", "ByShooting", "OnSheet", "perturbed", "towers"]


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
    which, wanted = perturbed(of_own)
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


def perturbed(tangents) -> tuple:
    """The leaves that move: their places, and their tangents."""
    moves = jax.tree.leaves(tangents, is_leaf=lambda v: v is None)
    which = tuple(k for k, move in enumerate(moves) if move is not None)
    return which, [moves[k] for k in which]


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


def towers(engine: AbstractEngine, membrane: Membrane, u, order: int, leaves: tuple):
    """`rim` and its derivatives by u up to order + 1, and for each of the membrane's leaves those up to order by it."""
    held = _held(membrane)
    rims = _towers_program(order + 1)(engine, held, u)
    own = [k for k in leaves if k < engine.own_leaves(held)]
    return tuple(rims), {k: tuple(_towers_by_leaf_program(order, k)(engine, held, u)) for k in own}
