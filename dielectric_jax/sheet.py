"""The sheet of all tensile equilibria of one membrane, as piecewise Chebyshev polynomials of (λa, t).

On the chart (λa, t = q/q_max(λa)) every quantity of a state is smooth once its behaviour at the edges is divided out: with
m = √(λa − λ0) and the tension of the apex s_a = W_1(λa, λa)(1 − t),

    log p/(m s_a),   log V/m,   log z/m,   log C,   log U/(λa − 1)²

(C = Q/Φ, z the height, U the elastic energy 2π ∫ W R dR) are analytic down to the flat membrane. The chart is cut into
columns of λa, each column into elements of t, and cut again where the tails of the coefficients ask for it.

The states are shots: from a pressure that is right to a few digits the membrane is integrated to R = 1, and a short step
of the solver goes on to the radius R* where λ2 = λ0; by the scaling (R, r, z, p) → (cR, cr, cz, p/c) that is the state with
p R*, V/R*³, z/R*, C/R*². The energy comes from the scaling identity at the rim.
"""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np

from .chart import map_nodes
from .kept import kept_jit
from .materials import AbstractMaterial, largest_load, stresses
from .membrane import Membrane, slopes
from .programs import run_chunks
from .shooting import eighth_order_step, integrate_membrane

__all__ = ["QUANTITIES", "Element", "build_elements", "coefficients", "sheet_states"]

QUANTITIES = ("pressure", "volume", "height", "charge_per_voltage", "energy")
NODES = (16, 20)  # of an element, along λa and t
_MAP_STEPS = 28.0  # of the explicit map, which only starts the first shots
_COLUMNS = (0.0, 0.04, 0.12, 0.25, 0.4, 0.55, 0.7, 0.82, 0.91, 0.965, 1.0)  # shares of the stretch, to begin with
_PANELS = (-0.3, 0.2, 0.55, 0.78)  # of t, to begin with
_ROUNDS = 7
_FRESH = 6  # states of an element that measure its error


@kept_jit
def _sheet_program(material: AbstractMaterial, u, rim, steps):
    """p, V, z, C, U at (λa, q) from a pressure right to a few digits; u holds (λa, guess of p, q)."""
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, outputs=True, trail="profile")
    times, values, _ = shot.trail
    last = values[jnp.sum(jnp.isfinite(times)) - 1]
    end = jnp.stack([last[0], last[1], last[2], shot.volume, shot.height, shot.charge])

    def rates(radius, y):
        l1, l2, theta = apex + y[0], apex + y[1], y[2]
        rate1, rate2, bend = slopes(material, radius, l1, l2, theta, p, q)
        rise = l1 * jnp.sin(theta)
        ring = 2 * jnp.pi * radius * (l1 * l2) ** 2
        return jnp.stack([rate1, rate2, bend, jnp.pi * (radius * l2) ** 2 * rise, rise, ring])

    radius = jnp.ones_like(apex)
    for _ in range(2):  # Newton for λ2(R*) = λ0
        move = (rim - apex - end[1]) / rates(radius, end)[1]
        end = eighth_order_step(rates, radius, move, end)
        radius = radius + move
    l1, l2, theta = apex + end[0], rim, end[2]
    pressure, volume = p * radius, end[3] / radius**3
    charge = end[5] / radius**2
    sine, cosine = jnp.sin(theta), jnp.cos(theta)
    s1 = stresses(material, l1, l2, q)[0]
    density = material.energy(l1, l2) - q * (l1 * l2) ** 2 / 2
    at_rim = density - pressure * rim**2 * l1 * sine / 2 + (rim - l1 * cosine) * s1 * cosine
    energy = jnp.pi * at_rim + 1.5 * pressure * volume + q * charge / 2
    return pressure, volume, end[4] / radius, charge, energy, jnp.abs(radius - 1)


def sheet_states(membrane: Membrane, apex, load, guess, steps: float) -> np.ndarray:
    """p, V, z, C, U of states (λa, t), shape (5, n), from guesses of their pressures; NaN where a guess was too far."""
    rim = float(membrane.prestretch)
    limit = run_chunks(lambda part: [largest_load(membrane.material, part[0])], np.stack([apex, load, guess]))[0]
    u = np.stack([apex, guess, load * limit])
    *values, away = run_chunks(lambda part: _sheet_program(membrane.material, part, rim, steps), u)
    return np.where(away < 0.05, np.stack(values), np.nan)


def edge_factors(material: AbstractMaterial, apex, load, rim):
    """What is divided out of each quantity, shape (5, …): the behaviour at the flat membrane and at the cone."""
    m = jnp.sqrt(apex - rim)
    tension = largest_load(material, apex) * apex**3 * (1 - load)
    return jnp.stack([m * tension, m, m, jnp.ones_like(m), (apex - 1) ** 2])


def relative_error(value, exact) -> np.ndarray:
    """|value − exact|/max(|exact|, 1e-3), the measure of error estimates; inf where a state is missing."""
    with np.errstate(all="ignore"):
        error = np.abs(value - exact) / np.maximum(np.abs(exact), 1e-3)
    return np.nan_to_num(error, nan=np.inf)


@dataclasses.dataclass(frozen=True)
class Element:
    """One rectangle of the chart: its edges, the coefficients (5, 16, 20), the steps of its shots, its measured error."""

    apex: tuple[float, float]
    load: tuple[float, float]
    coefficients: np.ndarray
    steps: float
    error: float = np.inf


def _unit_nodes(count: int) -> np.ndarray:
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


def _to_coefficients(count: int) -> np.ndarray:
    """The matrix from values at Chebyshev–Gauss nodes to coefficients."""
    matrix = 2 / count * np.cos(np.outer(np.arange(count), np.pi - np.pi * (np.arange(count) + 0.5) / count))
    matrix[0] /= 2
    return matrix


def coefficients(values: np.ndarray) -> np.ndarray:
    """Chebyshev coefficients (…, n, m) of values at the nodes (…, n, m) of an element."""
    return np.einsum("ia,jb,...ab->...ij", _to_coefficients(NODES[0]), _to_coefficients(NODES[1]), values)


def _points(apex: tuple, load: tuple, x: np.ndarray, y: np.ndarray):
    """(λa, t) of local coordinates in [−1, 1]."""
    a = apex[0] + (apex[1] - apex[0]) * (x + 1) / 2
    return a, load[0] + (load[1] - load[0]) * (y + 1) / 2


def _local(element: Element, apex, load) -> np.ndarray:
    """The five interpolated logarithms (5, n) of an element at points inside it."""
    x = 2 * (apex - element.apex[0]) / (element.apex[1] - element.apex[0]) - 1
    y = 2 * (load - element.load[0]) / (element.load[1] - element.load[0]) - 1
    along = np.polynomial.chebyshev.chebvander(x, NODES[0] - 1)
    across = np.polynomial.chebyshev.chebvander(y, NODES[1] - 1)
    return np.einsum("qij,ni,nj->qn", element.coefficients, along, across)


def _first_steps(load_top: float) -> float:
    return 48.0 if load_top <= 0.56 else 80.0 if load_top <= 0.8 else 128.0


def _tails(c: np.ndarray) -> tuple[float, float]:
    """The size of the last coefficients along λa and along t."""
    along = np.abs(c[:, -2:]).max(axis=(1, 2)).max()
    across = np.abs(c[..., -2:]).max(axis=(1, 2)).max()
    return float(along), float(across)


def _halves(edges: tuple[float, float]):
    middle = (edges[0] + edges[1]) / 2
    return (edges[0], middle), (middle, edges[1])


class _Builder:
    """Samples rectangles of the chart and cuts them until the tails of their coefficients are small."""

    def __init__(self, membrane: Membrane, tolerance: float):
        self.membrane, self.tolerance = membrane, tolerance
        self.rim = float(membrane.prestretch)

    def sample(self, tasks: list["_Task"]) -> list[Element]:
        """The elements of rectangles of the chart."""
        x, y = (v.ravel() for v in np.meshgrid(_unit_nodes(NODES[0]), _unit_nodes(NODES[1]), indexing="ij"))
        points = [_points(task.apex, task.load, x, y) for task in tasks]
        factors = [np.asarray(edge_factors(self.membrane.material, a, t, self.rim)) for a, t in points]
        guesses: list = [None] * len(tasks)
        for k, task in enumerate(tasks):
            if task.parent is not None:
                guesses[k] = np.exp(_local(task.parent, *points[k])[0]) * factors[k][0]
        new = [k for k, guess in enumerate(guesses) if guess is None]
        if new:
            a, t = (np.concatenate([points[k][i] for k in new]) for i in (0, 1))
            mapped = map_nodes(self.membrane.material, a, t, self.rim, _MAP_STEPS)[0]
            for k, p in zip(new, np.split(mapped, len(new)), strict=True):
                guesses[k] = p
        found = self._states([t.steps for t in tasks], points, guesses)
        with np.errstate(all="ignore"):
            logs = [np.log(v / f).reshape(len(QUANTITIES), *NODES) for v, f in zip(found, factors, strict=True)]
        return [Element(t.apex, t.load, coefficients(v), t.steps) for t, v in zip(tasks, logs, strict=True)]

    def _states(self, steps: list, points: list, guesses: list) -> list[np.ndarray]:
        """The states of many sets of points, those of equal steps together."""
        out: list = [None] * len(points)
        for n in sorted(set(steps)):
            which = [k for k in range(len(points)) if steps[k] == n]
            a, t = (np.concatenate([points[k][i] for k in which]) for i in (0, 1))
            found = sheet_states(self.membrane, a, t, np.concatenate([guesses[k] for k in which]), n)
            for k, values in zip(which, np.split(found, len(which), axis=1), strict=True):
                out[k] = values
        return out

    def measure(self, elements: list[Element], seed: int) -> list[Element]:
        """The elements with the largest relative error at fresh states."""
        random = np.random.default_rng(seed)
        places = random.uniform(-1, 1, (2, len(elements), _FRESH))
        places[:, :, 0] = np.sign(places[:, :, 0]) * 0.999  # a corner: there the error is often largest
        points = [_points(e.apex, e.load, *places[:, k]) for k, e in enumerate(elements)]
        factors = [np.asarray(edge_factors(self.membrane.material, a, t, self.rim)) for a, t in points]
        values = [np.exp(_local(e, *xy)) * f for e, xy, f in zip(elements, points, factors, strict=True)]
        exact = self._states([1.5 * e.steps for e in elements], points, [v[0] for v in values])
        errors = [float(relative_error(v, x).max()) for v, x in zip(values, exact, strict=True)]
        return [dataclasses.replace(e, error=error) for e, error in zip(elements, errors, strict=True)]


@dataclasses.dataclass(frozen=True)
class _Task:
    """A rectangle to be sampled, with the element that guesses its pressures."""

    apex: tuple[float, float]
    load: tuple[float, float]
    steps: float
    parent: Element | None = None


def build_elements(membrane: Membrane, stretches, bottom: float, top, tolerance: float) -> list[Element]:
    """Elements over λ0…stretches[1] and t from `bottom` to `top(λa)`, each below `tolerance` at fresh states.

    Those that cutting does not bring there are left out; the surface's domain is what remains.
    """
    builder = _Builder(membrane, tolerance)
    rim, high = float(membrane.prestretch), stretches[1]
    edges = rim + (high - rim) * np.array(_COLUMNS)

    def panels(apex):
        limit = top(np.linspace(apex[0], apex[1], 9)).max()
        inner = [x for x in _PANELS if bottom + 0.05 < x < limit - 0.05]
        marks = [bottom, *inner, limit]
        return [(apex, load) for load in itertools.pairwise(marks)]

    columns = itertools.pairwise(edges)
    todo = [_Task(apex, load, _first_steps(load[1])) for a in columns for apex, load in panels(a)]
    done: list[Element] = []
    for round_ in range(_ROUNDS):
        if not todo:
            break
        settled, cut = [], []
        for e in builder.sample(todo):
            (settled if max(_tails(e.coefficients)) <= 0.1 * tolerance else cut).append(e)
        todo = [task for e in cut for task in _cut(e, 0.1 * tolerance)]
        for e in builder.measure(settled, round_):
            if e.error <= 0.5 * tolerance:
                done.append(e)
            elif e.steps < 160:  # smooth, and yet in error: the shots are
                todo.append(_Task(e.apex, e.load, 1.6 * e.steps, e))
            else:
                todo += _cut(e, 0.0)
    return done


def _cut(element: Element, least: float) -> list[_Task]:
    """The rectangles an element is cut into: across the directions whose tails exceed `least`."""
    along, across = _tails(element.coefficients)
    known = np.isfinite(along)
    columns = _halves(element.apex) if not along <= least else (element.apex,)
    rows = _halves(element.load) if not across <= least else (element.load,)
    return [_Task(a, t, element.steps, element if known else None) for a in columns for t in rows]
