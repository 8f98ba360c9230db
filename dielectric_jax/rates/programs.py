"""The compiled programs: a leg from one instant to the step in which something happens, and what is read off a step."""

import functools
import typing

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.interpolate import BarycentricInterpolator

from ..model import AbstractBreakdown, capacitance
from ..numerics import cached_jit
from .balance import Balance, Grid, Shape, balanced, grid_of, log_stress, stretches, volume_of
from .resolution import FIRST_STEP, LOOK_POINTS, STEPS_OF_A_CALL, STOPPED
from .stepping import Instant, Radau5, advance, instant_of

__all__ = [
    "EVENTS",
    "Film",
    "Seen",
    "Start",
    "evolve_program",
    "restep_program",
    "settle_program",
    "signs_of",
]

# what ends a leg, in the order of `Film.signs`
EVENTS = ("fold", "end", "breakdown", "hoop_tension_loss", "at_rest")


class Seen(typing.NamedTuple):
    """What is measured of an instant: quantities of the diagram, derivatives by σ, and the largest dx/dσ."""

    time: typing.Any
    load: typing.Any
    pressure: typing.Any
    volume: typing.Any
    apex_stretch: typing.Any
    height: typing.Any
    charge: typing.Any
    hoop_tension: typing.Any
    breakdown_ratio: typing.Any
    energy: typing.Any
    time_rate: typing.Any
    load_rate: typing.Any
    volume_rate: typing.Any
    pressure_rate: typing.Any
    speed: typing.Any


def signs_of(seen: Seen, end, xp):
    """One number an event of `EVENTS`, (…, 5), positive once it has happened; `xp` is NumPy or jax.numpy."""
    moving = xp.where(seen.time_rate > 0, seen.speed / xp.where(seen.time_rate > 0, seen.time_rate, 1.0), xp.inf)
    rows = [-seen.time_rate, seen.time - end, seen.breakdown_ratio - 1, -seen.hoop_tension, STOPPED - moving]
    return xp.stack(rows, axis=-1)


@functools.cache
def _look(functions: int, points: int):
    """Points from the apex to the rim, and what interpolates values at Gauss points there."""
    grid = grid_of(functions, points)
    return np.asarray(BarycentricInterpolator(grid.share, np.eye(points))(np.linspace(0.0, 1.0, LOOK_POINTS)))


class Start(typing.NamedTuple):
    """A leg: the balance, where it begins (shape, dashpots, energy dissipated), where m ends, and what is watched (5,)."""

    balance: Balance
    shape: Shape
    x: typing.Any
    work: typing.Any
    end: typing.Any
    watched: typing.Any
    sigma: typing.Any
    first: typing.Any


class Film(eqx.Module):
    """What an instant is measured by: the balance and the breakdown law."""

    balance: Balance
    breakdown: AbstractBreakdown

    def seen(self, grid: Grid, y: Instant) -> Seen:
        """The measured quantities of one instant."""
        balance, shape = self.balance, y.shape
        a, _, l1 = stretches(balance, shape, grid)
        logs = jnp.stack([jnp.log(l1), jnp.log(jnp.abs(a))])
        q, load_rate = jax.jvp(balance.load, (shape.moment,), (y.shape_rate.moment,))
        stress = log_stress(balance.spring, logs, q)[0]
        energy = balance.spring.energy(l1, a) - q * capacitance(balance.spring, l1, a) / 2
        for branch, x in zip(balance.branches, y.x, strict=True):
            own = logs - x
            stress += branch.modulus_ratio * log_stress(branch.material, own, 0.0)[0]
            energy += branch.modulus_ratio * branch.material.energy(*jnp.exp(own))
        look = _look(grid.functions.shape[2], len(grid.s))
        product = look @ (l1 * a)
        apex = look[0] @ a
        ratio = jnp.max(jnp.sqrt(jnp.maximum(q, 0.0)) * product / self.breakdown.field(jnp.sqrt(jnp.abs(product))))
        (volume, rate) = jax.jvp(lambda s: volume_of(balance, s, grid), (shape,), (y.shape_rate,))
        return Seen(
            shape.moment,
            q,
            shape.pressure,
            volume,
            apex,
            grid.weights @ shape.slope,
            jnp.sqrt(jnp.maximum(q, 0.0)) * np.pi * (grid.weights @ capacitance(balance.spring, l1, a)),
            jnp.min(look @ stress[1]),
            ratio,
            np.pi * (grid.weights @ energy),
            y.shape_rate.moment,
            load_rate,
            rate,
            y.shape_rate.pressure,
            jnp.max(jnp.abs(y.x_rate)) if y.x.size else jnp.zeros(()),
        )

    def signs(self, grid: Grid, y: Instant, end) -> jax.Array:
        """One number an event, positive once it has happened: those of `EVENTS`."""
        seen = self.seen(grid, y)
        return signs_of(seen, end, jnp)


def _watched(signs, watched):
    return jnp.where(watched > 0, signs, -1.0)


@functools.cache
def evolve_program(functions: int, points: int):
    """`(breakdown, start, tolerance)` of one leg: the instants after its steps, their σ, and what is seen of them."""
    grid = grid_of(functions, points)

    def run(breakdown, start: Start, tolerance):
        film = Film(start.balance, breakdown)
        y0 = instant_of(start.balance, start.shape, start.x, grid, start.work)

        def happened(t, y, args, **_):
            return jnp.any(_watched(film.signs(grid, y, start.end), start.watched) > 0)

        control = diffrax.PIDController(rtol=0.0, atol=tolerance, norm=optx.max_norm, dtmin=1e-12 * start.first)
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: y),
            Radau5(),
            start.sigma,
            start.sigma + 1e9 * start.first,
            FIRST_STEP * start.first,
            y0,
            args=(start.balance, grid),
            stepsize_controller=control,
            event=diffrax.Event(happened),
            saveat=diffrax.SaveAt(steps=True, t0=True),
            max_steps=STEPS_OF_A_CALL,
            throw=False,
            adjoint=diffrax.ForwardMode(),
        )
        seen = jax.vmap(lambda y: film.seen(grid, y))(found.ys)
        return found.ys, found.ts, seen

    return cached_jit(jax.vmap(run, in_axes=(0, 0, None)))


@functools.cache
def restep_program(functions: int, points: int):
    """`(breakdown, balance, begin, σ of begin, σ, end)`: the instant at σ by one step, what is seen there, and the signs of events, NaN where Newton's method failed."""
    grid = grid_of(functions, points)

    def run(breakdown, balance, y0, begin, stop, end):
        film = Film(balance, breakdown)
        y, _, good = advance(balance, grid, begin, stop, y0)
        return y, film.seen(grid, y), jnp.where(good, film.signs(grid, y, end), jnp.nan)

    return cached_jit(jax.vmap(run))


@functools.cache
def settle_program(functions: int, points: int):
    """`(balance, shape, x, σ)`: the balanced shape with frozen dashpots, and whether Newton's method converged."""
    grid = grid_of(functions, points)

    def run(balance, shape, x, sigma):
        found = balanced(balance, shape, x, sigma, grid)
        a, _, l1 = stretches(balance, found.shape, grid)
        return found.shape, jnp.stack([jnp.log(l1), jnp.log(jnp.abs(a))]), found.good

    return cached_jit(jax.vmap(run))
