"""The manifold of all tensile equilibria of one membrane, as piecewise Chebyshev polynomials of (λa, t).

On the chart (λa, t = q/q_max(λa)) every quantity of a state is smooth once its behaviour at the edges is divided out: with
m = √(λa − λ0) and the tension of the apex s_a = W_1(λa, λa)(1 − t),

    log p/(m s_a),   log V/m,   log z/m,   log C,   log U/(λa − 1)²

(C = Q/Φ, z the height, U the elastic energy 2π ∫ W R dR) are analytic down to the flat membrane. The chart is cut into
columns of λa, each column into elements of t, and cut again where the tails of the coefficients ask for it.

The states are shots: from a pressure that is right to a few digits the membrane is integrated to R = 1, and a short step
of the solver goes on to the radius R* where λ2 = λ0; by the scaling (R, r, z, p) → (cR, cr, cz, p/c) that is the state with
p R*, V/R*³, z/R*, C/R*². The energy comes from the scaling identity at the rim.
"""

import abc
import dataclasses
import itertools
import typing

import jax.numpy as jnp
import numpy as np

from ..model import (
    CHUNK,
    AbstractMaterial,
    Membrane,
    capacitance,
    eighth_order_step,
    integrate_membrane,
    largest_load,
    map_nodes,
    slopes,
    stresses,
)
from ..numerics import cached_jit, elementwise, run_lanes, sine_cosine
from .elements import Element, Sampler, Task, coefficients, fresh_places, marks, node_points, read, refine
from .resolution import COLUMNS, FRESH, LOAD_MARKS, MAP_STEPS, NODES

__all__ = ["QUANTITIES", "build_elements", "columns", "edge_factors", "element", "rim_state", "surface_states"]

QUANTITIES = ("pressure", "volume", "height", "charge_per_voltage", "energy")


def rim_state(material: AbstractMaterial, p, q, rim, end):
    """p, V, z, C, U of the state whose rim is where λ2 = `rim`: there `end` holds R, λ1, θ, V, z, C of a pressure p."""
    radius, l1, theta, volume, height, charge = end
    pressure, volume, charge = p * radius, volume / radius**3, charge / radius**2
    sine, cosine = sine_cosine(theta)
    s1 = stresses(material, l1, rim, q)[0]
    density = material.energy(l1, rim) - q * capacitance(material, l1, rim) / 2
    at_rim = density - pressure * rim**2 * l1 * sine / 2 + (rim - l1 * cosine) * s1 * cosine
    energy = jnp.pi * at_rim + 1.5 * pressure * volume + q * charge / 2
    return pressure, volume, height / radius, charge, energy


def state_rates(material: AbstractMaterial, radius, l1, l2, theta, bends):
    """d/dR of λ1, λ2, θ (`bends`), V, z, C."""
    rise = l1 * sine_cosine(theta)[0]
    ring = 2 * jnp.pi * radius * capacitance(material, l1, l2)
    return jnp.stack([*bends, jnp.pi * (radius * l2) ** 2 * rise, rise, ring])


@cached_jit
def _surface_program(material: AbstractMaterial, u, steps):
    """p, V, z, C, U at (λa, q) from a pressure right to a few digits; u holds (λa, guess of p, q, λ0)."""
    apex, p, q, rim = u
    shot = integrate_membrane(material, apex, p, q, steps, outputs=True, trail="profile")
    times, values, _ = shot.trail
    last = values[jnp.sum(jnp.isfinite(times)) - 1]
    end = jnp.stack([last[0], last[1], last[2], shot.volume, shot.height, shot.charge])

    def rates(radius, y):
        l1, l2, theta = apex + y[0], apex + y[1], y[2]
        return state_rates(material, radius, l1, l2, theta, slopes(material, radius, l1, l2, theta, p, q))

    radius = jnp.ones_like(apex)
    for _ in range(2):  # Newton for λ2(R*) = λ0
        move = (rim - apex - end[1]) / rates(radius, end)[1]
        end = eighth_order_step(rates, radius, move, end)
        radius = radius + move
    state = rim_state(material, p, q, rim, (radius, apex + end[0], *end[2:]))
    return *state, jnp.abs(radius - 1)


def surface_states(material: AbstractMaterial, apex, load, rim, guess, steps: float) -> np.ndarray:
    """p, V, z, C, U of states (λa, t, λ0), shape (5, n), from guesses of their pressures.

    All are arrays of shape (n,), or numbers; NaN where a guess was too far.
    """
    apex, load, rim, guess = np.broadcast_arrays(apex, load, rim, guess)
    u = np.stack([apex, guess, load * largest_load(material, apex), rim])
    *values, away = run_lanes(lambda part: _surface_program(material, part, steps), u, sizes=CHUNK)
    return np.where(away < 0.05, np.stack(values), np.nan)


@elementwise
def edge_factors(material: AbstractMaterial, apex, load, rim):
    """What is divided out of each quantity, shape (5, …): the behaviour at the flat membrane and at the cone."""
    m = jnp.sqrt(apex - rim)
    tension = stresses(material, apex, apex, 0.0)[0] * (1 - load)
    return jnp.stack([m * tension, m, m, jnp.ones_like(m), (apex - 1) ** 2])


def relative_error(value, exact) -> np.ndarray:
    """|value − exact|/max(|exact|, 1e-3), the measure of error estimates; inf where a state is missing."""
    with np.errstate(all="ignore"):
        error = np.abs(value - exact) / np.maximum(np.abs(exact), 1e-3)
    return np.nan_to_num(error, nan=np.inf)


def logarithms(values: np.ndarray, factors) -> np.ndarray:
    """What the polynomials interpolate, from the quantities (5, …); NaN where a state is missing."""
    with np.errstate(all="ignore"):
        return np.log(values / np.asarray(factors))


def element(edges, logs: np.ndarray, steps: float) -> Element:
    """The element through the logarithms (5, n, m[, k]) at its nodes."""
    return Element(edges, coefficients(logs), steps, found=float(np.isfinite(logs).mean()))


class AbstractBuilder(Sampler):
    """Samples boxes with shots, and measures the error of elements at fresh ones."""

    material: AbstractMaterial
    fresh: typing.ClassVar[int]  # states of an element that measure its error

    @abc.abstractmethod
    def rims(self, places: np.ndarray) -> np.ndarray:
        """The prestretches (n,) at points (axes, n)."""

    def factors(self, places: np.ndarray) -> np.ndarray:
        """The edge factors (5, n) at points (axes, n)."""
        return edge_factors(self.material, places[0], places[1], self.rims(places))

    def shots(self, steps: list, places: list, guesses: list) -> list[np.ndarray]:
        """The states at many sets of points, those of equal steps together."""
        out: list = [None] * len(places)
        for n in sorted(set(steps)):
            which = [k for k in range(len(places)) if steps[k] == n]
            x, guess = np.concatenate([places[k] for k in which], 1), np.concatenate([guesses[k] for k in which])
            found = surface_states(self.material, x[0], x[1], self.rims(x), guess, n)
            for k, values in zip(which, np.split(found, len(which), axis=1), strict=True):
                out[k] = values
        return out

    def guesses(self, tasks: list[Task], places: list[np.ndarray]) -> list[np.ndarray]:
        """Pressures right to a few digits at points of boxes: from their parents, or from the explicit map."""
        out: list = [None] * len(tasks)
        for k, task in enumerate(tasks):
            if task.parent is not None:
                out[k] = np.exp(read(task.parent, places[k])[0]) * self.factors(places[k])[0]
        new = [k for k, guess in enumerate(out) if guess is None]
        if new:
            x = np.concatenate([places[k] for k in new], axis=1)
            mapped = map_nodes(self.material, x[0], x[1], self.rims(x), MAP_STEPS)[0]
            for k, p in zip(new, np.split(mapped, len(new)), strict=True):
                out[k] = p
        return out

    def measure(self, elements: list[Element], seed: int) -> list[Element]:
        places = fresh_places(elements, seed, self.fresh)
        values = [np.exp(read(e, x)) * self.factors(x) for e, x in zip(elements, places, strict=True)]
        exact = self.shots([1.5 * e.steps for e in elements], places, [v[0] for v in values])
        errors = [float(relative_error(v, x).max()) for v, x in zip(values, exact, strict=True)]
        return [dataclasses.replace(e, error=error) for e, error in zip(elements, errors, strict=True)]


class _Builder(AbstractBuilder):
    """Elements of (λa, t) for one membrane, from one shot a node."""

    fresh = FRESH

    def __init__(self, membrane: Membrane):
        self.material, self.rim = membrane.material, float(membrane.prestretch)

    def rims(self, places):
        return np.full(places.shape[1], self.rim)

    def sample(self, tasks):
        places = [node_points(task.edges) for task in tasks]
        found = self.shots([t.steps for t in tasks], places, self.guesses(tasks, places))
        logs = [logarithms(v, self.factors(x)).reshape(-1, *NODES[:2]) for v, x in zip(found, places, strict=True)]
        return [element(t.edges, v, t.steps) for t, v in zip(tasks, logs, strict=True)]


def _first_steps(load_top: float) -> float:
    return 48.0 if load_top <= 0.56 else 80.0 if load_top <= 0.8 else 128.0


def columns(low: float, high: float, bottom: float, top) -> list[Task]:
    """The rectangles (λa, t) to begin with: λa from `low` to `high`, t from `bottom` to `top(λa)`."""
    found = []
    for apex in itertools.pairwise(low + (high - low) * np.array(COLUMNS)):
        limit = top(np.linspace(*apex, 65)).max()
        found += [Task((apex, load), _first_steps(load[1])) for load in marks(bottom, LOAD_MARKS, limit, 0.05)]
    return found


def build_elements(membrane: Membrane, high: float, bottom: float, top, tolerance: float) -> list[Element]:
    """Elements over λ0…`high` and t from `bottom` to `top(λa)`, each below `tolerance` at fresh states.

    Those that cutting does not bring there are left out; the surface's domain is what remains.
    """
    return refine(_Builder(membrane), columns(float(membrane.prestretch), high, bottom, top), tolerance)
