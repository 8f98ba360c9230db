"""The sheets of all prestretches at once: piecewise Chebyshev polynomials of (λa, t, s), s the share of the fall of λ2.

Integrated from the apex at a fixed pressure, λ2 falls strictly along R and passes every prestretch λ0 = λa − s (λa − 1),
0 < s ≤ 1; where it does, the trajectory is the equilibrium of that prestretch but for its scale (see `build`). So one
trajectory of (λa, q) serves every prestretch: from the grid point nearest to each wanted s, one step of the solver with
ξ = √s as its variable, dR/dξ = −2 (λa − 1) ξ R/(λ1 cos θ − λ2), lands on it.

With m = √(s (λa − 1)) the logarithms of `build` are analytic in s down to the flat membrane s = 0, for R/ξ is even in ξ.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    CHUNK,
    AbstractMaterial,
    eighth_order_step,
    integrate_membrane,
    largest_load,
    slopes,
    threads,
    window_end,
)
from ..numerics import kept_jit
from .build import AbstractBuilder, columns, element, logarithms, rim_state, state_rates
from .elements import NODES, Element, Task, marks, node_points, refine

__all__ = ["build_trajectory_elements", "prestretch_at", "share_of"]

_SHARES = (0.5, 0.8)  # where s is cut, to begin with: towards s = 1 the states change fastest
_START = 1e-4  # where the apex series hands over: its error in λ2 weighs most at small shares
_MARGIN = 1e-9  # so that rounding of s does not leave the edges of the domain


def share_of(apex, rim):
    """s = (λa − λ0)/(λa − 1)."""
    return (apex - rim) / (apex - 1)


def prestretch_at(apex, share):
    """λ0 = λa − s (λa − 1)."""
    return apex - share * (apex - 1)


@kept_jit
def _trajectory_program(material: AbstractMaterial, u, steps):
    """R (rows, lanes) and λ1 − λa, λ2 − λa, θ, V, z, C (rows, 6, lanes) after every step; and how many rows there are."""
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, outputs=True, trail="states", start=_START)
    times, values, along = shot.trail
    done = jnp.isfinite(times)
    return jax.vmap(along.position)(jnp.where(done, times, 1.0))[0], values, jnp.sum(done)


@kept_jit
def _states_program(material: AbstractMaterial, u, shares, radius, values, count):
    """p, V, z, C, U (5, shares, lanes) where the trajectories of u = (λa, p, q) pass the shares; NaN beyond their ends."""
    apex, p, q = u
    fall = apex - 1
    reached = jnp.sqrt(jnp.maximum(-values[:, 1], 0.0) / fall)
    reached = jnp.where(jnp.arange(len(reached))[:, None] < count, reached, jnp.inf)
    wanted = jnp.sqrt(shares)[:, None] * jnp.ones_like(apex)
    below = jnp.clip(jnp.sum(reached[None] <= wanted[:, None], axis=1) - 1, 0, count - 1)
    above = jnp.minimum(below + 1, count - 1)
    low, high = (jnp.take_along_axis(reached, k, axis=0) for k in (below, above))
    nearest = jnp.where(wanted - low < high - wanted, below, above)
    begin = jnp.take_along_axis(reached, nearest, axis=0)
    start = jnp.moveaxis(jnp.take_along_axis(values, nearest[:, None], axis=0), 1, 0)
    start = start.at[1].set(jnp.take_along_axis(radius, nearest, axis=0))

    def rates(xi, y):
        """d/dξ of λ1 − λa, R, θ, V, z, C."""
        l1, radius, theta, l2 = apex + y[0], y[1], y[2], apex - fall * xi**2
        rate1, rate2, bend = slopes(material, radius, l1, l2, theta, p, q)
        per_xi = -2 * fall * xi / rate2
        return per_xi * state_rates(material, radius, l1, l2, theta, (rate1, jnp.ones_like(radius), bend))

    end = eighth_order_step(rates, begin, wanted - begin, start)
    rim = prestretch_at(apex, shares[:, None])
    found = jnp.stack(rim_state(material, p, q, rim, (end[1], apex + end[0], *end[2:])))
    return jnp.where(wanted <= 1.1 * jnp.take(reached, count - 1, axis=0), found, jnp.nan)


def _trajectory_states(material: AbstractMaterial, apex, load, pressure, sets: list, steps: float) -> list[np.ndarray]:
    """The states (5, shares, n) along the trajectories of (λa, t, p) at each of several sets of 16 shares."""
    u = np.stack([apex, pressure, load * largest_load(material, apex)])
    u = np.pad(u, ((0, 0), (0, -apex.size % CHUNK)), mode="edge")

    def work(i):
        part = u[:, i : i + CHUNK]
        trajectory = _trajectory_program(material, part, steps)
        return [np.asarray(_states_program(material, part, shares, *trajectory)) for shares in sets]

    parts = [work(0), *threads().map(work, range(CHUNK, u.shape[1], CHUNK))]
    return [np.concatenate(pieces, axis=-1)[..., : apex.size] for pieces in zip(*parts, strict=True)]


class _Builder(AbstractBuilder):
    """Elements of (λa, t, s), from one trajectory for all nodes and all elements over a node (λa, t)."""

    fresh = 48

    def __init__(self, material: AbstractMaterial):
        self.material = material

    def rims(self, places):
        return prestretch_at(places[0], places[2])

    def sample(self, tasks):
        def rectangle(task):
            return task.edges[:2], task.steps

        found = []
        for (edges, steps), group in itertools.groupby(sorted(tasks, key=rectangle), key=rectangle):
            found += self._over(edges, steps, list(group))
        return found

    def _over(self, rectangle, steps, tasks: list[Task]) -> list[Element]:
        """The elements of tasks over one rectangle (λa, t)."""
        last = max(tasks, key=lambda task: task.edges[2][1])  # its rim is the end of the trajectories
        apex, load = node_points(rectangle)
        ends = np.stack([apex, load, np.full_like(apex, last.edges[2][1])])
        (pressure,) = self.guesses([last], [ends])
        sets = [node_points((*rectangle, task.edges[2]))[2, : NODES[2]] for task in tasks]
        states = _trajectory_states(self.material, apex, load, pressure, sets, steps)
        made = []
        for task, found in zip(tasks, states, strict=True):
            found = np.moveaxis(found, 1, 2).reshape(len(found), -1)
            logs = logarithms(found, self.factors(node_points(task.edges)))
            made.append(element(task.edges, logs.reshape(-1, *NODES), steps))
        return made


def build_trajectory_elements(
    material: AbstractMaterial, prestretch: tuple[float, float], bottom: float, top, tolerance: float
) -> list[Element]:
    """Elements over all λa of the windows of a range of prestretches, t from `bottom` to `top(λa)`, and those prestretches.

    Each is below `tolerance` at fresh states; those that cutting does not bring there are left out.
    """
    low, high = prestretch
    least = np.linspace(low, high, 65)
    windows = np.array([window_end(material, float(x))[0] for x in least])
    todo = []
    for task in columns(low, float(windows.max()), bottom, top):
        a0, a1 = task.edges[0]
        own = least[np.argmax(windows >= min(a0, windows.max()))]  # the least prestretch whose window holds the column
        begin = max(share_of(a0, high) - _MARGIN, 0.0) if a0 > high else 0.0
        end = min(share_of(a1, own) + _MARGIN, 1.0)
        todo += [Task((*task.edges, share), task.steps) for share in marks(begin, _SHARES, end, 0.08)]
    return refine(_Builder(material), todo, tolerance)
