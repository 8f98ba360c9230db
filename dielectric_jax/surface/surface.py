"""The surface: every tensile equilibrium of one membrane as a function of (λa, q), with a known error.

Built once from a few thousand shots (seconds), it gives pressure, volume, height, charge and elastic energy of any state in
microseconds, differentiably to any order. Chambers, pressures and fillings only draw contours on it.
"""

import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..model import (
    SCANNED_LOAD,
    AbstractBreakdown,
    AbstractMaterial,
    Membrane,
    field_on,
    field_ratio_squared,
    largest_load,
)
from ..numerics import check_positive, elementwise
from .build import QUANTITIES, build_elements, edge_factors
from .elements import Element, chebyshev, locate, pack, padded, unit_place, used
from .files import cached_or_none, cached_path, fingerprint, keep, read_archive, same_fingerprint, write_archive
from .resolution import ABOVE_BREAKDOWN, BLOCK, BOTTOM, BOUND_FACTOR, LEAST_BOUND, NODES, TOLERANCES

__all__ = ["ById", "Surface", "SurfaceState", "pressure_and_volume"]

_FORMAT = "dielectric_jax surface 1"


class SurfaceState(typing.NamedTuple):
    """What the surface gives for a state, arrays of one shape; NaN outside its domain. `charge` is NaN where q < 0."""

    pressure: Array
    volume: Array
    height: Array
    charge: Array
    energy: Array


def arrays_of(values) -> SurfaceState:
    """The state of five arrays, of NumPy outside transformations."""
    return SurfaceState(*(jax.device_put(v) if isinstance(v, np.ndarray) else v for v in values))


def with_charge(values, q) -> SurfaceState:
    """The state of p, V, z, C = Q/Φ, U at loads q."""
    p, v, z, c, u = values
    root = jnp.sqrt(jnp.where(q > 0, q, 1.0))
    return SurfaceState(p, v, z, c * jnp.where(q > 0, root, jnp.where(q == 0, 0.0, jnp.nan)), u)


def bound_of(errors, element):
    """The bound of the relative error in an element; inf outside the domain."""
    return jnp.where(element >= 0, jnp.maximum(BOUND_FACTOR * errors[element], LEAST_BOUND), jnp.inf)


def check_tolerance(tolerance: float, noun: str) -> None:
    """Refuses a tolerance that no state meets, or that is none."""
    check_positive("tolerance", tolerance)
    least, largest = TOLERANCES
    if not least <= tolerance <= largest:
        raise ValueError(f"`tolerance` of a {noun} must lie between {least:g} and {largest:g}, but is {tolerance!r}.")


def top_load(material: AbstractMaterial, law: AbstractBreakdown, apex) -> np.ndarray:
    """The largest t of the domain at λa: 1.3 times that of breakdown at the apex, at most 0.9."""
    with np.errstate(all="ignore"):
        load = field_on(law, apex) ** 2 / apex**4 / largest_load(material, apex)
    return np.minimum(SCANNED_LOAD, ABOVE_BREAKDOWN * np.nan_to_num(load, nan=1.0, posinf=1.0))


class Surface(eqx.Module):
    """Piecewise Chebyshev polynomials of a membrane's states on the chart (λa, t), t = q/q_max(λa).

    `apex_edges` (columns + 1,) and `load_edges` (rows + 1,) cut the chart into cells; `cells` (columns, rows) names the
    element that covers each, −1 outside the domain. `boxes` (elements, 4) holds the edges of the elements,
    `coefficients` (elements, 5, 16, 20) their polynomials, `errors` (elements,) the largest relative error seen at fresh
    states; the last edges and elements are repeated to sizes that most surfaces share. Build one with `Surface.build`.

    Its numbers are differentiable to any order by λa, q and t, but they belong to one material. By a constant m of the
    material the implicit rule at the shot tells them: at fixed (λa, q) the rim condition l(λa, p, q; m) = λ0 − λa, l = λ2(1) − λa, gives
    dp/dm = −(∂l/∂m)/(∂l/∂p), and dV/dm = ∂V/∂m + (∂V/∂p) dp/dm, all four from `shoot`; or build surfaces anew.

    >>> import jax
    >>> surface = Surface.build(Membrane(), tolerance=1e-9)
    >>> state = surface(2.26310592942, 0.0)
    >>> round(float(state.pressure), 9), round(float(state.volume), 7)
    (1.908684829, 2.9634068)
    >>> slope = jax.grad(lambda stretch: surface(stretch, 0.0).pressure)
    >>> bool(abs(slope(2.26310592942)) < 1e-8)      # the peak of the pressure
    True
    """

    membrane: Membrane
    apex_edges: Float[Array, " columns_1"]
    load_edges: Float[Array, " rows_1"]
    cells: Int[Array, "columns rows"]
    boxes: Float[Array, "elements 4"]
    coefficients: Float[Array, "elements 5 16 20"]
    errors: Float[Array, " elements"]
    tolerance: float = eqx.field(static=True)

    @classmethod
    def build(cls, membrane: Membrane, *, tolerance: float = 1e-9, cache: bool = True) -> "Surface":
        """The surface of a membrane, from λ0 to the end of its default window, up to 1.3 times the load of breakdown.

        The domain is t from −0.75 to min(0.9, 1.3 t at breakdown); parts where cutting does not bring the measured error
        below `tolerance` (relative, as in error estimates) are left out of it. With `cache` a surface built before is read
        from the user's cache folder (see `enable_compilation_cache`); a material written by the user is built afresh.
        """
        if not isinstance(membrane, Membrane):
            raise ValueError(f"`membrane` must be a Membrane, but is a {type(membrane).__name__}.")
        check_tolerance(tolerance, "surface")
        path = cls.path_of(membrane, tolerance) if cache else None
        known = cached_or_none(lambda path: cls.load(path, membrane), path)
        if known is not None:
            return known
        high = membrane.lock_up_stretch()[0]

        def top(apex):
            return top_load(membrane.material, membrane.breakdown, apex)

        elements = build_elements(membrane, high, BOTTOM, top, tolerance)
        if not elements:
            raise ValueError(
                f"`tolerance` must be looser for this membrane: no part of its chart reached {tolerance:g}."
            )
        surface = cls.of_elements(membrane, elements, tolerance)
        keep(surface.save, path)
        return surface

    @classmethod
    def path_of(cls, membrane: Membrane, tolerance: float):
        """Where the cache keeps the surface of a membrane; None where it does not, see `files.cached_path`."""
        return cached_path("surfaces", _FORMAT, membrane, fingerprint(membrane), tolerance)

    @classmethod
    def of_elements(cls, membrane: Membrane, elements: list[Element], tolerance: float) -> "Surface":
        """The surface that elements make up."""
        edges, arrays = padded(*pack(elements), BLOCK)
        return cls(membrane, *map(jax.device_put, (*edges, *arrays)), tolerance=tolerance)

    def locate(self, apex_stretch, load_fraction):
        """The element that covers points of the chart, −1 outside the domain."""
        return locate((self.apex_edges, self.load_edges), self.cells, (apex_stretch, load_fraction))

    def at_load_fraction(self, apex_stretch, load_fraction, wanted: tuple = QUANTITIES):
        """The `wanted` quantities at (λa, t): a list of arrays of one shape; NaN outside the domain."""
        apex, t = jnp.broadcast_arrays(jnp.asarray(apex_stretch, float), jnp.asarray(load_fraction, float))
        which = [QUANTITIES.index(name) for name in wanted]
        element = self.locate(apex, t)
        box = self.boxes[element]
        along = chebyshev(unit_place(box[..., 0], box[..., 1], apex), NODES[0])
        across = chebyshev(unit_place(box[..., 2], box[..., 3], t), NODES[1])
        logs = jnp.einsum("...qij,...i,...j->q...", self.coefficients[:, jnp.array(which)][element], along, across)
        rim = self.membrane.prestretch
        inside = (element >= 0) & (apex > rim)
        factors = edge_factors(self.membrane.material, jnp.where(inside, apex, rim + 1), t, rim)
        values = factors[jnp.array(which)] * jnp.exp(logs)
        return list(jnp.where(inside, values, jnp.nan))

    def __call__(self, apex_stretch, voltage_squared) -> SurfaceState:
        """The state at (λa, q), elementwise over arrays of one shape; differentiable to any order, also in q."""
        return arrays_of(_state(self, apex_stretch, voltage_squared))

    def covers(self, apex_stretch, voltage_squared):
        """Whether the domain holds the states (λa, q)."""
        return _covered(self, apex_stretch, voltage_squared)

    def error_bound(self, apex_stretch, voltage_squared):
        """The bound of the relative error |error|/max(|value|, 1e-3) at (λa, q); inf outside the domain."""
        return _bound(self, apex_stretch, voltage_squared)

    def breakdown_load(self, apex_stretch):
        """q_b(λa) = (E_EB(λa)/λa²)², the load at which the field of the apex reaches the breakdown law."""
        return 1 / field_ratio_squared(self.membrane.breakdown, apex_stretch, apex_stretch)

    def belongs_to(self, membrane: Membrane) -> bool:
        """Whether it was built for a membrane equal to this one."""
        own, other = jax.tree.flatten(self.membrane), jax.tree.flatten(membrane)
        return own[1] == other[1] and all(np.array_equal(a, b) for a, b in zip(own[0], other[0], strict=True))

    def save(self, path) -> None:
        """Writes the surface to a file of NumPy arrays (.npz), with a checksum and the membrane's fingerprint."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        write_archive(path, _FORMAT, arrays, fingerprint(self.membrane), tolerance=self.tolerance)

    @classmethod
    def load(cls, path, membrane: Membrane) -> "Surface":
        """The surface in a file, for the membrane it was built for.

        Raises ValueError in one sentence for a damaged file, one of another format, or another membrane's.
        """
        header, arrays, built_for = read_archive(path, _FORMAT, "surface", _ARRAYS)
        if not same_fingerprint(built_for, fingerprint(membrane)):
            raise ValueError(f"`membrane` must be the one the surface was built for, but {str(path)!r} is another's.")
        own = [arrays[name] for name in _ARRAYS]
        edges, rest = padded(own[:2], own[2:], BLOCK)
        return cls(membrane, *map(jax.device_put, (*edges, *rest)), tolerance=float(header["tolerance"]))

    def __repr__(self) -> str:
        worst = float(np.max(np.asarray(self.errors)))
        return f"Surface({len(used(self.cells))} elements, prestretch={float(self.membrane.prestretch):g}, error {worst:.1e})"


def _element(surface: Surface, apex, q):
    return surface.locate(jnp.asarray(apex, float), q / largest_load(surface.membrane.material, apex))


@elementwise
def _state(surface: Surface, apex, q) -> tuple:
    t = q / largest_load(surface.membrane.material, apex)
    return tuple(with_charge(surface.at_load_fraction(apex, t), jnp.asarray(q, float)))


@elementwise
def _covered(surface: Surface, apex, q):
    return (_element(surface, apex, q) >= 0) & (apex > surface.membrane.prestretch)


@elementwise
def _bound(surface: Surface, apex, q):
    return bound_of(surface.errors, _element(surface, apex, q))


@elementwise
def pressure_and_volume(surface: Surface, apex, load):
    """p and V (2, …) at points (λa, t) of a surface, elementwise."""
    return jnp.stack(surface.at_load_fraction(apex, load, ("pressure", "volume")))


class ById:
    """A surface, or a family, as a key of caches: the object itself, not its arrays."""

    def __init__(self, value: typing.Any):
        self.value = value

    def __hash__(self):
        return id(self.value)

    def __eq__(self, other):
        return self.value is other.value


_ARRAYS = ("apex_edges", "load_edges", "cells", "boxes", "coefficients", "errors")
