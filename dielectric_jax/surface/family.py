"""The family: every tensile equilibrium of a material at every prestretch of a range, as a function of (λa, q, λ0).

A `Surface` belongs to one prestretch; the family holds those of a whole range, is differentiable in the prestretch too,
and hands out the surface of any of them in a fraction of a second.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..model import (
    CHUNK,
    AbstractBreakdown,
    AbstractMaterial,
    Membrane,
    VHBBreakdown,
    eighth_order_step,
    integrate_membrane,
    largest_load,
    slopes,
    window_end,
)
from ..numerics import cached_jit, check_between, elementwise, run_lanes
from .build import QUANTITIES, AbstractBuilder, columns, edge_factors, element, logarithms, rim_state, state_rates
from .elements import (
    Element,
    Sampler,
    Task,
    basis,
    chebyshev,
    coefficients,
    fresh_places,
    locate,
    marks,
    node_points,
    pack,
    padded,
    read,
    refine,
    unit_place,
    used,
)
from .files import cached_or_none, cached_path, fingerprint, keep, read_archive, same_fingerprint, write_archive
from .resolution import (
    BOTTOM,
    FAMILY_BLOCK,
    FAMILY_FRESH,
    FAMILY_LANES,
    FRESH,
    NODES,
    SHARE_MARGIN,
    SHARE_MARKS,
    TRAJECTORY_START,
)
from .surface import Surface, SurfaceState, arrays_of, bound_of, check_tolerance, top_load, with_charge

__all__ = ["SurfaceFamily", "build_trajectory_elements", "prestretch_at", "share_of"]


def share_of(apex, rim):
    """s = (λa − λ0)/(λa − 1)."""
    return (apex - rim) / (apex - 1)


def prestretch_at(apex, share):
    """λ0 = λa − s (λa − 1)."""
    return apex - share * (apex - 1)


@cached_jit
def _trajectory_program(material: AbstractMaterial, u, steps):
    """R (rows, lanes) and λ1 − λa, λ2 − λa, θ, V, z, C (rows, 6, lanes) after every step; and how many rows there are."""
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, outputs=True, trail="states", start=TRAJECTORY_START)
    times, values, along = shot.trail
    done = jnp.isfinite(times)
    return jax.vmap(along.position)(jnp.where(done, times, 1.0))[0], values, jnp.sum(done)


@cached_jit
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

    def states(part):
        trajectory = _trajectory_program(material, part, steps)
        return [_states_program(material, part, shares, *trajectory) for shares in sets]

    return run_lanes(states, u, sizes=CHUNK)


class _Builder(AbstractBuilder):
    """Elements of (λa, t, s), from one trajectory for all nodes and all elements over a node (λa, t)."""

    fresh = FAMILY_FRESH

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
        begin = max(share_of(a0, high) - SHARE_MARGIN, 0.0) if a0 > high else 0.0
        end = min(share_of(a1, own) + SHARE_MARGIN, 1.0)
        todo += [Task((*task.edges, share), task.steps) for share in marks(begin, SHARE_MARKS, end, 0.08)]
    return refine(_Builder(material), todo, tolerance)


_FORMAT = "dielectric_jax surface family 1"
_ARRAYS = ("apex_edges", "load_edges", "share_edges", "cells", "boxes", "coefficients", "errors")


@functools.cache
def _program(which: tuple) -> Callable:
    """`_quantities` of some of them, as a function of a family and points."""

    def quantities(family, apex, t, rim):
        return _quantities(family, apex, t, rim, which)

    return elementwise(quantities, lanes=FAMILY_LANES)


def _quantities(family: "SurfaceFamily", apex, t, rim, which):
    """The quantities `which` at (λa, t, λ0), elementwise; NaN outside the domain."""
    apex, t, rim = jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in (apex, t, rim)))
    element = family.locate(apex, t, rim)
    inside = element >= 0
    apex = jnp.where(inside, apex, rim + 1)
    box = jnp.moveaxis(family.boxes[element], -1, 0)
    point = jnp.stack([apex, t, share_of(apex, rim)])
    unit = jnp.where(inside, unit_place(box[0::2], box[1::2], point), 0.0)
    bases = [chebyshev(x.ravel(), count) for x, count in zip(unit, NODES, strict=True)]
    wanted = jnp.array(which)

    @jax.checkpoint  # a reverse pass fetches the polynomials again instead of keeping 200 kB a point
    def read_one(known):
        k, *bases = known
        return jnp.einsum("qijk,i,j,k->q", family.coefficients[k, wanted], *bases)

    logs = jax.lax.map(read_one, (element.ravel(), *bases), batch_size=FAMILY_LANES).T
    factors = edge_factors(family.material, apex, t, rim)[wanted]
    return jnp.where(inside, factors * jnp.exp(logs.reshape(factors.shape)), jnp.nan)


class SurfaceFamily(eqx.Module):
    """Piecewise Chebyshev polynomials of a material's states in (λa, t, s), t = q/q_max(λa), s = (λa − λ0)/(λa − 1).

    `apex_edges`, `load_edges` and `share_edges` cut the domain into cells; `cells` names the element that covers each, −1
    outside the domain. `boxes` (elements, 6) holds the edges of the elements, `coefficients` (elements, 5, 16, 20, 16) their
    polynomials, `errors` (elements,) the largest relative error seen at fresh states. Build one with `SurfaceFamily.build`.

    >>> import jax
    >>> from dielectric_jax import Gent
    >>> family = SurfaceFamily.build(Gent(10.0), prestretch=(1.0, 1.2), tolerance=1e-5)
    >>> state = family(1.5, 0.0, 1.1)
    >>> surface = family.surface(1.1)
    >>> bool(abs(surface(1.5, 0.0).pressure - state.pressure) < 1e-5)
    True
    >>> slope = jax.grad(lambda prestretch: family(1.5, 0.0, prestretch).pressure)(1.1)
    >>> bool(slope < 0)      # at a given stretch of the apex
    True
    """

    material: AbstractMaterial
    breakdown: AbstractBreakdown
    apex_edges: Float[Array, " columns_1"]
    load_edges: Float[Array, " rows_1"]
    share_edges: Float[Array, " layers_1"]
    cells: Int[Array, "columns rows layers"]
    boxes: Float[Array, "elements 6"]
    coefficients: Float[Array, "elements 5 16 20 16"]
    errors: Float[Array, " elements"]
    prestretch: tuple[float, float] = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        material: AbstractMaterial,
        *,
        prestretch: tuple[float, float] = (1.0, 4.0),
        breakdown: AbstractBreakdown | None = None,
        tolerance: float = 1e-9,
        cache: bool = True,
    ) -> "SurfaceFamily":
        """The family of a material over a range of prestretches, each to the end of its default window.

        The domain in t is that of `Surface.build`, the same at every prestretch; parts where cutting does not bring the
        measured error below `tolerance` (relative, as in error estimates) are left out of it. With `cache` a family built
        before is read from the user's cache folder; a material written by the user is built afresh. Takes about ten times
        as long as one surface. Raises ValueError where an argument is not one of these, or nothing meets `tolerance`.
        """
        breakdown = VHBBreakdown() if breakdown is None else breakdown
        low, high = _check_range(prestretch)
        check_tolerance(tolerance, "surface family")
        path = cls.path_of(material, (low, high), breakdown, tolerance) if cache else None
        known = cached_or_none(lambda path: cls.load(path, material, breakdown=breakdown), path)
        if known is not None:
            return known

        def top(apex):
            return top_load(material, breakdown, apex)

        elements = build_trajectory_elements(material, (low, high), BOTTOM, top, tolerance)
        if not elements:
            raise ValueError(f"`tolerance` must be looser for this material: no part reached {tolerance:g}.")
        edges, arrays = padded(*pack(elements), FAMILY_BLOCK)
        parts = map(jax.device_put, (*edges, *arrays))
        family = cls(material, breakdown, *parts, prestretch=(low, high), tolerance=tolerance)
        keep(family.save, path)
        return family

    @classmethod
    def path_of(cls, material: AbstractMaterial, prestretch, breakdown: AbstractBreakdown, tolerance: float):
        """Where the cache keeps the family of a material; None where it does not, see `files.cached_path`."""
        own = _fingerprint(material, prestretch, breakdown)
        return cached_path("families", _FORMAT, Membrane(material, prestretch[0], breakdown), own, tolerance)

    def locate(self, apex_stretch, load_fraction, prestretch):
        """The element that covers points (λa, t, λ0), −1 outside the domain."""
        edges = self.apex_edges, self.load_edges, self.share_edges
        element = locate(edges, self.cells, (apex_stretch, load_fraction, share_of(apex_stretch, prestretch)))
        low, high = self.prestretch
        asked = (apex_stretch > prestretch) & (low <= prestretch) & (prestretch <= high)
        return jnp.where(asked, element, -1)

    def at_load_fraction(self, apex_stretch, load_fraction, prestretch, wanted: tuple = QUANTITIES):
        """The `wanted` quantities at (λa, t, λ0): a list of arrays of one shape; NaN outside the domain."""
        which = tuple(QUANTITIES.index(name) for name in wanted)
        return list(_program(which)(self, apex_stretch, load_fraction, prestretch))

    def __call__(self, apex_stretch, voltage_squared, prestretch) -> SurfaceState:
        """The state at (λa, q, λ0), elementwise over arrays of one shape; differentiable to any order in all three."""
        return arrays_of(_state(self, apex_stretch, voltage_squared, prestretch))

    def covers(self, apex_stretch, voltage_squared, prestretch):
        """Whether the domain holds the states (λa, q, λ0)."""
        return _covered(self, apex_stretch, voltage_squared, prestretch)

    def error_bound(self, apex_stretch, voltage_squared, prestretch):
        """The bound of the relative error |error|/max(|value|, 1e-3) at (λa, q, λ0); inf outside the domain.

        It is that of the states of the stretches as given: closer to the flat membrane than λa − λ0 = 1e-5 the last digit of
        the stretches moves a state by more.
        """
        return _bound(self, apex_stretch, voltage_squared, prestretch)

    def surface(self, prestretch: float) -> Surface:
        """The `Surface` of one prestretch, from these polynomials instead of shots.

        Its `errors` are the interpolation errors measured against the family plus the family's own, so that its bound
        holds the family's. Raises ValueError for a prestretch outside the range.
        """
        rim = float(prestretch)
        check_between("prestretch", rim, *self.prestretch, what="the range of the family")
        own = used(self.cells)
        boxes = np.asarray(self.boxes)[own].reshape(-1, 3, 2)
        polynomials, errors = np.asarray(self.coefficients)[own], np.asarray(self.errors)[own]
        sources = [
            Element(tuple((low, high) for low, high in box.tolist()), c, math.inf, float(error))
            for box, c, error in zip(boxes, polynomials, errors, strict=True)
        ]
        section = _Section(sources, rim)
        # the errors of the family, at most half of its tolerance, are in those that `refine` halves its tolerance for
        elements = refine(section, section.begin(), 2 * self.tolerance)
        if not elements:
            raise ValueError(f"`prestretch` must have a part of the domain of the family, but {rim!r} has none.")
        return Surface.of_elements(Membrane(self.material, rim, self.breakdown), elements, self.tolerance)

    def save(self, path) -> None:
        """Writes the family to a file of NumPy arrays (.npz), with a checksum and the material's fingerprint."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        own = _fingerprint(self.material, self.prestretch, self.breakdown)
        write_archive(path, _FORMAT, arrays, own, tolerance=self.tolerance, prestretch=self.prestretch)

    @classmethod
    def load(cls, path, material: AbstractMaterial, *, breakdown: AbstractBreakdown | None = None) -> "SurfaceFamily":
        """The family in a file, for the material and the breakdown law it was built for.

        Raises ValueError in one sentence for a damaged file, one of another format, or another material's.
        """
        breakdown = VHBBreakdown() if breakdown is None else breakdown
        header, arrays, built_for = read_archive(path, _FORMAT, "surface family", _ARRAYS)
        low, high = header["prestretch"]
        if not same_fingerprint(built_for, _fingerprint(material, (low, high), breakdown)):
            raise ValueError(
                f"`material` and `breakdown` must be those the family was built for, but {str(path)!r} is another's."
            )
        own = [arrays[name] for name in _ARRAYS]
        edges, rest = padded(own[:3], own[3:], FAMILY_BLOCK)
        parts = map(jax.device_put, (*edges, *rest))
        return cls(material, breakdown, *parts, prestretch=(low, high), tolerance=float(header["tolerance"]))

    def __repr__(self) -> str:
        worst = float(np.max(np.asarray(self.errors)))
        low, high = self.prestretch
        return f"SurfaceFamily({len(used(self.cells))} elements, prestretch={low:g} to {high:g}, error {worst:.1e})"


@functools.partial(elementwise, lanes=FAMILY_LANES)
def _state(family: SurfaceFamily, apex, q, rim) -> tuple:
    t = q / largest_load(family.material, apex)
    return tuple(with_charge(family.at_load_fraction(apex, t, rim), jnp.asarray(q, float)))


def _element(family: SurfaceFamily, apex, q, rim):
    apex, rim = jnp.asarray(apex, float), jnp.asarray(rim, float)
    return family.locate(apex, q / largest_load(family.material, apex), rim)


@elementwise
def _covered(family: SurfaceFamily, apex, q, rim):
    return _element(family, apex, q, rim) >= 0


@elementwise
def _bound(family: SurfaceFamily, apex, q, rim):
    return bound_of(family.errors, _element(family, apex, q, rim))


def _check_range(prestretch) -> tuple[float, float]:
    """The two ends of a range of prestretches."""
    try:
        low, high = (float(v) for v in prestretch)
    except (TypeError, ValueError):
        low = high = math.nan
    if not 1 <= low < high:
        raise ValueError(f"`prestretch` must be two rising numbers of at least 1, but is {prestretch!r}.")
    return low, high


def _fingerprint(material: AbstractMaterial, prestretch, breakdown: AbstractBreakdown) -> np.ndarray:
    """Numbers that tell families apart."""
    return np.concatenate([fingerprint(Membrane(material, end, breakdown)) for end in prestretch])


class _Section(Sampler):
    """Samples the polynomials of a family along s = (λa − λ0)/(λa − 1), one prestretch."""

    def __init__(self, sources: list[Element], rim: float):
        self.rim = rim
        self.sources = [e for e in sources if self._stretches(e)]
        self._boxes = np.array([e.edges for e in self.sources])

    def _stretches(self, source: Element) -> tuple[float, float] | None:
        """The stretches of the apex at which this prestretch lies in an element; None where it does nowhere."""
        (a0, a1), _, (s0, s1) = source.edges
        low = max(a0, (self.rim - s0) / (1 - s0))
        high = min(a1, (self.rim - s1) / (1 - s1)) if s1 < 1 else a1
        return (low, high) if low < high else None

    def begin(self) -> list[Task]:
        """The part of every element: inside one element the states are smooth, from one to the next they jump by its error."""
        return [Task((own, e.edges[1]), math.inf) for e in self.sources if (own := self._stretches(e))]

    def _source(self, edges) -> Element:
        apex, load = ((low + high) / 2 for low, high in edges)
        middle = np.array([apex, load, share_of(apex, self.rim)])
        return self.sources[
            int(np.argmax(((self._boxes[..., 0] <= middle) & (middle <= self._boxes[..., 1])).all(axis=1)))
        ]

    def sample(self, tasks):
        made = []
        for task in tasks:
            source = self._source(task.edges)
            apex = node_points(task.edges)[0, :: NODES[1]]
            # along t the box is the element's own, and so are the coefficients
            along = basis(source, 0, apex)[:, :, None] * basis(source, 2, share_of(apex, self.rim))[:, None]
            values = np.einsum("qijk,nik->qnj", source.coefficients, along, optimize=True)
            made.append(Element(task.edges, coefficients(values, axes=(1,)), task.steps))
        return made

    def measure(self, elements, seed):
        measured = []
        for e, x in zip(elements, fresh_places(elements, seed, FRESH), strict=True):
            source = self._source(e.edges)
            known = read(source, np.concatenate([x, share_of(x[:1], self.rim)]))
            error = float(np.abs(np.expm1(read(e, x) - known)).max()) + source.error
            measured.append(dataclasses.replace(e, error=error))
        return measured
