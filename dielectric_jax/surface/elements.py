"""Elements: boxes, each with its Chebyshev polynomials, cut until every one is exact enough; and how they are read.

The axes are (λa, t), and for a family of prestretches a third; see `build` and `trajectories`.
"""

import abc
import dataclasses
import functools
import itertools
import typing

import jax
import jax.numpy as jnp
import numpy as np

from .resolution import EDGE_ROUNDS, MOST_SHOT_STEPS, NODES, ROUNDS, STIFF_ROUNDS

__all__ = [
    "Element",
    "Sampler",
    "Task",
    "basis",
    "chebyshev",
    "coefficients",
    "fresh_places",
    "locate",
    "marks",
    "node_points",
    "pack",
    "padded",
    "points",
    "read",
    "refine",
    "unit_place",
    "used",
]


Edges: typing.TypeAlias = tuple[tuple[float, float], ...]


@dataclasses.dataclass(frozen=True)
class Element:
    """One box: its edges along each axis, the coefficients (5, 16, 20[, 16]), the steps of its shots, its error.

    `found` is the share of its nodes at which a state was found.
    """

    edges: Edges
    coefficients: np.ndarray
    steps: float
    error: float = np.inf
    found: float = 1.0


@dataclasses.dataclass(frozen=True)
class Task:
    """A box to be sampled, with the element that guesses its pressures."""

    edges: Edges
    steps: float
    parent: Element | None = None


class Sampler(abc.ABC):
    """What `refine` asks: polynomials for boxes, and their errors."""

    @abc.abstractmethod
    def sample(self, tasks: list[Task]) -> list[Element]:
        """The elements of boxes; coefficients are NaN where a state was not found."""

    @abc.abstractmethod
    def measure(self, elements: list[Element], seed: int) -> list[Element]:
        """The elements with the largest relative error at fresh states."""


def _unit_nodes(count: int) -> np.ndarray:
    return -np.cos(np.pi * (np.arange(count) + 0.5) / count)


def _to_coefficients(count: int) -> np.ndarray:
    """The matrix from values at Chebyshev–Gauss nodes to coefficients."""
    matrix = 2 / count * np.cos(np.outer(np.arange(count), np.pi - np.pi * (np.arange(count) + 0.5) / count))
    matrix[0] /= 2
    return matrix


def coefficients(values: np.ndarray, axes=None) -> np.ndarray:
    """Chebyshev coefficients (5, n, m, …) of values at the nodes (5, n, m, …) of an element, along `axes` (all)."""
    for axis in range(1, values.ndim) if axes is None else axes:
        values = np.moveaxis(np.tensordot(_to_coefficients(values.shape[axis]), values, (1, axis)), 0, axis)
    return values


def points(edges: Edges, unit: np.ndarray) -> np.ndarray:
    """Points of a box from local coordinates in [−1, 1], both (axes, …)."""
    return np.stack([low + (high - low) * (x + 1) / 2 for (low, high), x in zip(edges, unit, strict=True)])


def node_points(edges: Edges) -> np.ndarray:
    """The nodes of a box, (axes, n m …)."""
    units = [_unit_nodes(count) for count in NODES[: len(edges)]]
    return points(edges, np.stack([v.ravel() for v in np.meshgrid(*units, indexing="ij")]))


def unit_place(low, high, x):
    """The local coordinate in [−1, 1] of x between two edges."""
    return 2 * (x - low) / (high - low) - 1


def basis(element: Element, axis: int, x: np.ndarray) -> np.ndarray:
    """The Chebyshev polynomials (n, degrees) of an axis of an element at coordinates (n,)."""
    degree = element.coefficients.shape[1 + axis] - 1
    return np.polynomial.chebyshev.chebvander(unit_place(*element.edges[axis], x), degree)


def read(element: Element, places: np.ndarray) -> np.ndarray:
    """The five interpolated logarithms (5, n) of an element at points (axes, n) inside it."""
    bases = [basis(element, axis, x) for axis, x in enumerate(places)]
    values = np.moveaxis(np.tensordot(element.coefficients, bases[-1], (-1, 1)), -1, 0)
    for own in bases[-2::-1]:
        values = np.einsum("n...k,nk->n...", values, own)
    return values.T


def _tails(c: np.ndarray) -> list[float]:
    """The size of the last coefficients along each axis."""
    return [float(np.abs(np.moveaxis(c, axis, 0)[-2:]).max()) for axis in range(1, c.ndim)]


def _cut(element: Element, least: float) -> list[Task]:
    """The boxes an element is cut into: across the axes whose tails exceed `least`."""
    tails = _tails(element.coefficients)
    known = bool(np.isfinite(tails[0]))
    pieces = []
    for (low, high), tail in zip(element.edges, tails, strict=True):
        middle = (low + high) / 2
        pieces.append(((low, high),) if tail <= least else ((low, middle), (middle, high)))
    return [Task(edges, element.steps, element if known else None) for edges in itertools.product(*pieces)]


def fresh_places(elements: list[Element], seed: int, count: int) -> list[np.ndarray]:
    """Random points (axes, count) of each element, many near its faces: there the error is often largest."""
    random = np.random.default_rng(seed)
    axes = len(elements[0].edges) if elements else 0
    unit = random.uniform(-1, 1, (len(elements), axes, count))
    near = random.uniform(size=unit.shape) < 1 / 3
    near[..., 0] = True  # a corner
    unit = np.where(near, np.sign(unit) * 0.999, unit)
    return [points(e.edges, x) for e, x in zip(elements, unit, strict=True)]


def refine(sampler: Sampler, todo: list[Task], tolerance: float) -> list[Element]:
    """Elements over the boxes of `todo`, each with an error of at most half of `tolerance` at fresh states.

    Those that cutting does not bring there are left out: boxes without a state at once, boxes across the edge of the states
    after `EDGE_ROUNDS` cuts.
    """
    done: list[Element] = []
    for round_ in range(ROUNDS):
        if not todo:
            break
        settled, cut = [], []
        for e in sampler.sample(todo):
            if e.found == 0.0 or (e.found < 1.0 and round_ >= EDGE_ROUNDS):
                continue
            (settled if max(_tails(e.coefficients)) <= 0.1 * tolerance else cut).append(e)
        todo = [task for e in cut for task in _cut(e, 0.1 * tolerance)]
        for e in sampler.measure(settled, round_):
            rough = max(_tails(e.coefficients)) > 0.02 * tolerance
            if e.error <= 0.5 * tolerance:
                done.append(e)
            elif rough:
                todo += _cut(e, 0.02 * tolerance)
            elif e.steps < MOST_SHOT_STEPS:  # smooth, and yet in error: the shots are
                todo.append(Task(e.edges, 1.6 * e.steps, e))
            elif round_ < STIFF_ROUNDS:  # a part of it may do
                todo += _cut(e, 0.0)
    return done


def marks(low: float, inner, high: float, gap: float) -> list[tuple[float, float]]:
    """The intervals from `low` to `high` between the `inner` marks that lie at least `gap` inside."""
    return list(itertools.pairwise([low, *(x for x in inner if low + gap < x < high - gap), high]))


def padded(edges: list[np.ndarray], arrays: list[np.ndarray], block: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """What `pack` gives, with edges and elements to multiples of `block`: sizes that most share, as programs have sizes.

    The last edge, its cells and the last element are repeated, so that the domain and every value stay what they are.
    """
    more = [-len(v) % block for v in edges]
    cells, *columns = arrays
    rest = -len(columns[0]) % block
    edges = [np.pad(v, (0, n), mode="edge") for v, n in zip(edges, more, strict=True)]
    columns = [np.pad(v, ((0, rest), *((0, 0),) * (v.ndim - 1)), mode="edge") for v in columns]
    return edges, [np.pad(cells, [(0, n) for n in more], mode="edge"), *columns]


def used(cells) -> np.ndarray:
    """The numbers of the elements that cover a cell."""
    return np.unique(np.asarray(cells)[np.asarray(cells) >= 0])


def pack(elements: list[Element]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The edges that cut the domain into cells, one array an axis; and cells, boxes, coefficients, errors.

    A cell holds the number of the element that covers it, −1 outside the domain.
    """
    boxes = np.array([np.ravel(e.edges) for e in elements], float)
    edges = [np.unique(boxes[:, i : i + 2]) for i in range(0, boxes.shape[1], 2)]
    cells = np.full([len(v) - 1 for v in edges], -1)
    for k, box in enumerate(boxes):
        low_high = [np.searchsorted(v, box[2 * i : 2 * i + 2]) for i, v in enumerate(edges)]
        cells[tuple(slice(*ends) for ends in low_high)] = k
    polynomials = np.stack([e.coefficients for e in elements])
    return edges, [cells, boxes, polynomials, np.array([e.error for e in elements])]


def locate(edges, cells, point):
    """The element that covers a point (one array an axis), −1 outside the domain."""
    inside, index = True, []
    for own, x, count in zip(edges, point, cells.shape, strict=True):
        place = jnp.searchsorted(own, x, side="right") - 1
        place = jnp.where(x == own[-1], count - 1, place)  # the far edge belongs to the last cell
        inside &= (place >= 0) & (place < count)
        index.append(jnp.clip(place, 0, count - 1))
    return jnp.where(inside, cells[tuple(index)], -1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def chebyshev(x, count: int):
    """T_0(x) … T_{count−1}(x), stacked on the last axis.

    Derivatives of any order are products with the matrix of T_k′ = Σ D_kj T_j: third derivatives of a surface compile in a quarter of
    the time that the derivatives of the recurrence take, and run twice as fast.
    """
    terms = [jnp.ones_like(x), x]
    for _ in range(count - 2):
        terms.append(2 * x * terms[-1] - terms[-2])
    return jnp.stack(terms, axis=-1)


@chebyshev.defjvp
def _(count: int, primals, tangents):
    (x,), (move,) = primals, tangents
    values = chebyshev(x, count)
    return values, values @ _derivative(count).T * move[..., None]


def _derivative(count: int) -> np.ndarray:
    """The matrix D of T_k′ = Σ D_kj T_j."""
    k, j = np.indices((count, count))
    return np.where((j < k) & ((k - j) % 2 == 1), np.where(j == 0, 1.0, 2.0) * k, 0.0)
