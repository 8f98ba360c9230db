"""The surface: every tensile equilibrium of one membrane as a function of (λa, q), with a known error.

Built once from a few thousand shots (seconds), it gives pressure, volume, height, charge and elastic energy of any state in
microseconds, differentiably to any order. Chambers, pressures and fillings only draw contours on it.
"""

import hashlib
import io
import json
import pathlib
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .cache import cache_folder
from .kept import of_this_package
from .materials import largest_load
from .membrane import Membrane
from .results import check_positive
from .scene import SCANNED_LOAD
from .sheet import NODES, QUANTITIES, Element, build_elements, edge_factors

__all__ = ["ById", "SheetState", "Surface"]

_FORMAT = "dielectric_jax surface 1"
_BOTTOM = -0.75
_ABOVE_BREAKDOWN = 1.3
_BOUND = 4.0  # times the largest error seen at the fresh states of an element
_LEAST_BOUND = 3e-12  # what independent methods can tell


class SheetState(typing.NamedTuple):
    """What the surface gives for a state, arrays of one shape; NaN outside its domain. `charge` is NaN where q < 0."""

    pressure: Array
    volume: Array
    height: Array
    charge: Array
    energy: Array


def _chebyshev(x, count: int):
    """T_0(x) … T_{count−1}(x), stacked on the last axis."""
    terms = [jnp.ones_like(x), x]
    for _ in range(count - 2):
        terms.append(2 * x * terms[-1] - terms[-2])
    return jnp.stack(terms, axis=-1)


class Surface(eqx.Module):
    """Piecewise Chebyshev polynomials of a membrane's states on the chart (λa, t), t = q/q_max(λa).

    `apex_edges` (columns + 1,) and `load_edges` (rows + 1,) cut the chart into cells; `cells` (columns, rows) names the
    element that covers each, −1 outside the domain. `boxes` (elements, 4) holds the edges of the elements,
    `coefficients` (elements, 5, 16, 20) their polynomials, `errors` (elements,) the largest relative error seen at fresh
    states. Build one with `Surface.build`.

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
        check_positive("tolerance", tolerance)
        if not 1e-11 <= tolerance <= 1e-3:
            raise ValueError(f"`tolerance` of a surface must lie between 1e-11 and 0.001, but is {tolerance!r}.")
        path = _cached_path(membrane, tolerance) if cache else None
        if path is not None and path.exists():
            try:
                return cls.load(path, membrane)
            except ValueError:
                path.unlink()  # damaged: built again below
        high = membrane.lock_up_stretch()[0]
        law = membrane.breakdown

        def top(apex):
            with np.errstate(all="ignore"):
                load = np.asarray(law.field(apex)) ** 2 / apex**4 / np.asarray(largest_load(membrane.material, apex))
            return np.minimum(SCANNED_LOAD, _ABOVE_BREAKDOWN * np.nan_to_num(load, nan=1.0, posinf=1.0))

        elements = build_elements(membrane, (float(membrane.prestretch), high), _BOTTOM, top, tolerance)
        if not elements:
            raise ValueError(
                f"`tolerance` must be looser for this membrane: no part of its chart was met to {tolerance:g}."
            )
        surface = cls(membrane=membrane, **_pack(elements), tolerance=tolerance)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            surface.save(path)
        return surface

    def locate(self, apex_stretch, load_fraction):
        """The element that covers points of the chart, −1 outside the domain."""
        column = jnp.searchsorted(self.apex_edges, apex_stretch, side="right") - 1
        row = jnp.searchsorted(self.load_edges, load_fraction, side="right") - 1
        columns, rows = self.cells.shape
        # the far edges belong to the last cells
        column = jnp.where(apex_stretch == self.apex_edges[-1], columns - 1, column)
        row = jnp.where(load_fraction == self.load_edges[-1], rows - 1, row)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cell = self.cells[jnp.clip(column, 0, columns - 1), jnp.clip(row, 0, rows - 1)]
        return jnp.where(inside, cell, -1)

    def at_load_fraction(self, apex_stretch, load_fraction, wanted: tuple = QUANTITIES):
        """The `wanted` quantities at (λa, t): a list of arrays of one shape; NaN outside the domain."""
        apex, t = jnp.broadcast_arrays(jnp.asarray(apex_stretch, float), jnp.asarray(load_fraction, float))
        which = [QUANTITIES.index(name) for name in wanted]
        element = self.locate(apex, t)
        box = self.boxes[element]
        x = 2 * (apex - box[..., 0]) / (box[..., 1] - box[..., 0]) - 1
        y = 2 * (t - box[..., 2]) / (box[..., 3] - box[..., 2]) - 1
        along, across = _chebyshev(x, NODES[0]), _chebyshev(y, NODES[1])
        logs = jnp.einsum("...qij,...i,...j->q...", self.coefficients[:, jnp.array(which)][element], along, across)
        rim = self.membrane.prestretch
        inside = (element >= 0) & (apex > rim)
        factors = edge_factors(self.membrane.material, jnp.where(inside, apex, rim + 1), t, rim)
        values = factors[jnp.array(which)] * jnp.exp(logs)
        return list(jnp.where(inside, values, jnp.nan))

    def __call__(self, apex_stretch, voltage_squared) -> SheetState:
        """The state at (λa, q), elementwise over arrays of one shape; differentiable to any order, also in q."""
        q = jnp.asarray(voltage_squared, float)
        t = q / largest_load(self.membrane.material, apex_stretch)
        p, v, z, c, u = self.at_load_fraction(apex_stretch, t)
        root = jnp.sqrt(jnp.where(q > 0, q, 1.0))
        return SheetState(p, v, z, c * jnp.where(q > 0, root, jnp.where(q == 0, 0.0, jnp.nan)), u)

    def covers(self, apex_stretch, voltage_squared):
        """Whether the domain holds the states (λa, q)."""
        t = voltage_squared / largest_load(self.membrane.material, apex_stretch)
        return (self.locate(jnp.asarray(apex_stretch, float), t) >= 0) & (apex_stretch > self.membrane.prestretch)

    def error_bound(self, apex_stretch, voltage_squared):
        """The bound of the relative error |error|/max(|value|, 1e-3) at (λa, q); inf outside the domain."""
        t = voltage_squared / largest_load(self.membrane.material, apex_stretch)
        element = self.locate(jnp.asarray(apex_stretch, float), t)
        return jnp.where(element >= 0, jnp.maximum(_BOUND * self.errors[element], _LEAST_BOUND), jnp.inf)

    def breakdown_load(self, apex_stretch):
        """q_b(λa) = (E_EB(λa)/λa²)², the load at which the field of the apex reaches the breakdown law."""
        apex = jnp.asarray(apex_stretch, float)
        return (self.membrane.breakdown.field(apex) / apex**2) ** 2

    def belongs_to(self, membrane: Membrane) -> bool:
        """Whether it was built for a membrane equal to this one."""
        own, other = jax.tree.flatten(self.membrane), jax.tree.flatten(membrane)
        return own[1] == other[1] and all(np.array_equal(a, b) for a, b in zip(own[0], other[0], strict=True))

    def save(self, path) -> None:
        """Writes the surface to a file of NumPy arrays (.npz), with a checksum and the membrane's fingerprint."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        header = {"format": _FORMAT, "tolerance": self.tolerance, "checksum": _checksum(arrays)}
        buffer = io.BytesIO()
        more = {"header": np.array(json.dumps(header)), "fingerprint": _fingerprint(self.membrane)}
        np.savez(buffer, **typing.cast(typing.Any, arrays | more))
        path = pathlib.Path(path)
        partial = path.with_name(path.name + ".part")
        partial.write_bytes(buffer.getvalue())
        partial.replace(path)

    @classmethod
    def load(cls, path, membrane: Membrane) -> "Surface":
        """The surface in a file, for the membrane it was built for.

        Raises ValueError in one sentence for a damaged file, one of another format, or another membrane's.
        """
        try:
            with open(path, "rb") as file:
                data = dict(np.load(file, allow_pickle=False))
            header = json.loads(str(data["header"]))
            arrays = {name: data[name] for name in _ARRAYS}
        except FileNotFoundError:
            raise ValueError(f"`path` must name a surface file, but there is no file {str(path)!r}.") from None
        except Exception:
            raise ValueError(f"`path` must hold a surface, but {str(path)!r} is damaged or of another kind.") from None
        if header.get("format") != _FORMAT:
            raise ValueError(
                f"`path` must hold a surface of the format {_FORMAT!r}, but {str(path)!r} has {header.get('format')!r}."
            )
        if header["checksum"] != _checksum(arrays):
            raise ValueError(f"`path` must hold a surface, but {str(path)!r} is damaged: its checksum differs.")
        own = _fingerprint(membrane)
        if own.shape != data["fingerprint"].shape or not np.allclose(data["fingerprint"], own, rtol=1e-13, atol=0):
            raise ValueError(f"`membrane` must be the one the surface was built for, but {str(path)!r} is another's.")
        parts: dict[str, typing.Any] = {name: jnp.asarray(arrays[name]) for name in _ARRAYS}
        return cls(membrane=membrane, **parts, tolerance=float(header["tolerance"]))

    def __repr__(self) -> str:
        worst = float(np.max(np.asarray(self.errors)))
        return (
            f"Surface({len(self.errors)} elements, prestretch={float(self.membrane.prestretch):g}, error {worst:.1e})"
        )


class ById:
    """A surface as a key of caches: the object itself, not its arrays."""

    def __init__(self, value: Surface):
        self.value = value

    def __hash__(self):
        return id(self.value)

    def __eq__(self, other):
        return self.value is other.value


_ARRAYS = ("apex_edges", "load_edges", "cells", "boxes", "coefficients", "errors")


def _pack(elements: list[Element]) -> dict[str, typing.Any]:
    """The arrays of a surface."""
    boxes = np.array([[*e.apex, *e.load] for e in elements], float)
    apex, load = np.unique(boxes[:, :2]), np.unique(boxes[:, 2:])
    cells = np.full((len(apex) - 1, len(load) - 1), -1)
    for k, (a0, a1, t0, t1) in enumerate(boxes):
        columns = slice(np.searchsorted(apex, a0), np.searchsorted(apex, a1))
        cells[columns, np.searchsorted(load, t0) : np.searchsorted(load, t1)] = k
    polynomials = np.stack([e.coefficients for e in elements])
    errors = np.array([e.error for e in elements])
    arrays = (apex, load, cells, boxes, polynomials, errors)
    return {name: jnp.asarray(v) for name, v in zip(_ARRAYS, arrays, strict=True)}


def _checksum(arrays: dict) -> str:
    digest = hashlib.sha256()
    for name in _ARRAYS:
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _fingerprint(membrane: Membrane) -> np.ndarray:
    """Numbers that tell membranes apart: prestretch, lock-up, energies and breakdown fields at some stretches."""
    rim, high = float(membrane.prestretch), membrane.lock_up_stretch()[0]
    l1 = 1 + (high - 1) * np.array([0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.93])
    l2 = l1[[2, 0, 1, 4, 3, 6, 5]]
    probes = [membrane.material.energy(jnp.asarray(l1), jnp.asarray(v)) for v in (l1, l2)]
    return np.concatenate(
        [[rim, high], *map(np.asarray, probes), np.asarray(membrane.breakdown.field(jnp.asarray(l1)))]
    )


def _cached_path(membrane: Membrane, tolerance: float) -> pathlib.Path | None:
    """Where the surface of a membrane is kept; None with the cache off, or for a material outside this package."""
    folder = cache_folder()
    if folder is None or not of_this_package(membrane):
        return None
    kinds = f"{_FORMAT} {type(membrane.material).__name__} {type(membrane.breakdown).__name__} {tolerance!r}"
    key = hashlib.sha256(kinds.encode() + _fingerprint(membrane).tobytes()).hexdigest()[:32]
    return folder / "surfaces" / f"{key}.npz"
