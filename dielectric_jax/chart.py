"""The explicit map (apex stretch, q) → equilibrium, and the scan that finds every branch of a loading.

With p = 1 the equations are integrated once from the apex; λ2 = r/R falls strictly along R and meets the prestretch at
one R*, which is an equilibrium with p = R*, V = V*/R*³. The independent variable is λ2 itself,
λ2 = λa − (λa − λ0) ξ², so there is no event and no root to find. (λa, t), t = q/q_max(λa), is therefore a global chart
of all tensile states, and every branch of every loading is a contour of its condition on it.
"""

import dataclasses
import itertools

import contourpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from scipy.interpolate import make_interp_spline

from .loading import Contour
from .materials import AbstractMaterial, largest_load, stresses
from .membrane import Membrane, apex_series, slopes
from .results import Code
from .scene import SCANNED_LOAD
from .shooting import MOST_STEPS, graded_map, integrate

__all__ = ["Scan", "explicit_map", "scan"]

_START = 1e-3
_NODES = (110, (16, 12, 16))  # of the scan: along the stretch; along the load on the panels between `_PANELS`
_PANELS = (0.45, 0.75)
_REFINEMENT = 4


def explicit_map(material: AbstractMaterial, apex_stretch, voltage_squared, prestretch, steps=48.0, *, outputs=False):
    """Pressure and volume of the one equilibrium at (λa, q); elementwise over arrays of one shape, λa > λ0, q < q_max.

    The third result is negative where the map is valid (dλ2/dR < 0 all along the way). With `outputs` a fourth holds the
    height, C = Q/Φ, and the elastic energy 2π ∫ W R dR.

    >>> from dielectric_jax import Gent
    >>> p, v, slope = explicit_map(Gent(), 2.26310592942, 0.0, 1.0, 64.0)
    >>> round(float(p), 8), round(float(v), 7), bool(slope < 0)
    (1.90868483, 2.9634068, True)
    """
    apex, q, rim = jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in (apex_stretch, voltage_squared, prestretch)))
    one = jnp.ones_like(apex)
    a, b, kappa = apex_series(material, apex, one, q)
    fall = apex - rim
    rate = jnp.sqrt(fall / -b)  # R = rate ξ near the apex
    edge = jax.lax.stop_gradient(1 / (kappa * rate))
    scale = 2 * jnp.minimum(edge, 0.5)
    first = _START * jnp.minimum(edge, 1.0)
    position = graded_map(scale, first)
    radius0 = rate * first
    l1, l2 = apex + a * radius0**2, apex - fall * first**2
    slope0 = jnp.arcsin(radius0 * l2**2 / (2 * stresses(material, l1, l2, q)[0]))
    start = [jnp.log(rate), slope0, a * radius0**2, jnp.pi / 4 * apex**3 * kappa * radius0**4, -one]
    if outputs:
        area = jnp.pi * radius0**2
        start += [apex * kappa * radius0**2 / 2, area * apex**4, area * material.energy(apex, apex)]

    def field(tau, y):
        xi, stretching = position(tau)
        radius, l1, l2 = jnp.exp(y[0]) * xi, apex + y[2], apex - fall * xi**2
        rate1, rate2, rate_slope = slopes(material, radius, l1, l2, y[1], one, q)
        per_xi = -2 * fall * xi / rate2  # dR/dξ
        rate_volume = jnp.pi * (radius * l2) ** 2 * l1 * jnp.sin(y[1])
        # the last entry integrates the indicator of dλ2/dR ≥ 0, so it stays at −1 where the map is valid
        wrong = jnp.where(rate2 < 0, 0.0, 10.0)
        rates = [per_xi / radius - 1 / xi, per_xi * rate_slope, per_xi * rate1, per_xi * rate_volume, wrong]
        if outputs:
            ring = per_xi * 2 * jnp.pi * radius
            rates += [per_xi * l1 * jnp.sin(y[1]), ring * (l1 * l2) ** 2, ring * material.energy(l1, l2)]
        return stretching * jnp.stack(rates)

    end, _ = integrate(field, jnp.stack(start), steps)
    pressure = jnp.exp(end[0])
    found = pressure, end[3] / pressure**3, end[4]
    return (*found, (end[5] / pressure, end[6] / pressure**2, end[7] / pressure**2)) if outputs else found


@dataclasses.dataclass(frozen=True)
class Scan:
    """Pressure and volume interpolated on a fine grid of the chart, shape (stretches, loads), and contours on it."""

    apex_stretch: np.ndarray
    load_fraction: np.ndarray
    largest_load: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray

    def voltage_squared(self) -> np.ndarray:
        """q = t q_max(λa) on the grid."""
        return self.load_fraction[None] * self.largest_load[:, None]

    def contours(self, contour: Contour) -> list[np.ndarray]:
        """All contours of a loading's condition: arrays (vertices, 3) of (λa, p, q), one a connected branch."""
        rows, columns = np.arange(len(self.apex_stretch)), np.arange(len(self.load_fraction))
        value = contour.residual(self.pressure, self.volume, self.voltage_squared())
        value = np.ma.masked_invalid(value)
        lines = contourpy.contour_generator(columns, rows, value, name="serial").lines(0.0)
        found = []
        for line in lines:
            assert isinstance(line, np.ndarray)
            if len(line) < 2:
                continue
            apex = np.interp(line[:, 1], rows, self.apex_stretch)
            load = np.interp(line[:, 0], columns, self.load_fraction)
            limit = np.exp(np.interp(line[:, 1], rows, np.log(np.maximum(self.largest_load, 1e-300))))
            found.append(np.stack([apex, self._pressure_at(line), load * limit], axis=1))
        return found

    def pressure_of(self, apex_stretch: np.ndarray, load_fraction: np.ndarray) -> np.ndarray:
        """The pressure interpolated at points of the chart, a start for Newton."""
        i = np.interp(apex_stretch, self.apex_stretch, np.arange(len(self.apex_stretch)))
        j = np.interp(load_fraction, self.load_fraction, np.arange(len(self.load_fraction)))
        return self._pressure_at(np.stack([j, i], axis=1))

    def _pressure_at(self, line) -> np.ndarray:
        j, i = np.minimum(line.astype(int), [len(self.load_fraction) - 2, len(self.apex_stretch) - 2]).T
        u, v = line[:, 0] - j, line[:, 1] - i
        logs = np.log(self.pressure)
        return np.exp(
            (1 - v) * ((1 - u) * logs[i, j] + u * logs[i, j + 1])
            + v * ((1 - u) * logs[i + 1, j] + u * logs[i + 1, j + 1])
        )


_CHUNK = 640


@jax.jit
def _map_chunk(material, apex_stretch, load, prestretch, steps):
    return explicit_map(material, apex_stretch, load * largest_load(material, apex_stretch), prestretch, steps)


def map_nodes(material, apex_stretch, load, prestretch, steps):
    """The explicit map at (λa, t), chunk by chunk through one compiled program."""
    count = len(apex_stretch)
    padding = -count % _CHUNK
    apex, t = (np.pad(v, (0, padding), mode="edge") for v in (apex_stretch, load))
    parts = [
        _map_chunk(material, apex[i : i + _CHUNK], t[i : i + _CHUNK], prestretch, steps)
        for i in range(0, count + padding, _CHUNK)
    ]
    return [np.concatenate([np.asarray(part[k]) for part in parts])[:count] for k in range(3)]


def _panel_matrix(panels, nodes, refinement: int):
    """Chebyshev–Lobatto nodes on each panel, points `refinement` times as many, and the barycentric matrix to them."""
    x, fine, rows = [], [], []
    for (low, high), count in zip(itertools.pairwise(panels), nodes, strict=True):
        own = -np.cos(np.pi * np.arange(count) / (count - 1))
        ask = -np.cos(np.pi * np.linspace(0, 1, refinement * (count - 1) + 1))[1 if x else 0 :]
        weight = (-1.0) ** np.arange(count)
        weight[[0, -1]] /= 2
        gap = ask[:, None] - own[None]
        exact = np.abs(gap) < 1e-14
        matrix = weight / np.where(exact, 1.0, gap)
        matrix /= matrix.sum(axis=1, keepdims=True)
        hit = exact.any(axis=1)
        matrix[hit] = exact[hit]
        for values, unit in ((x, own), (fine, ask)):
            values.append(np.clip(low + (high - low) * (unit + 1) / 2, low, high))
        rows.append(matrix)
    return np.concatenate(x), np.concatenate(fine), scipy.linalg.block_diag(*rows)


def stretch_shares(first: float, count: int) -> np.ndarray:
    """Shares y of the stretch span, from `first` to 1: geometric at the flat end, even, finer again at lock-up."""
    lock = 0.02

    def density(y):
        return 0.6 * np.log(y) + 12 * y + 40 * np.maximum(y - 0.6, 0) ** 2 - np.log(1 + lock - y)

    y = np.linspace(max(first, 1e-2), 1.0, 4000)
    if first < 1e-2:
        y = np.concatenate([np.geomspace(first, 1e-2, 400)[:-1], y])
    share = np.interp(np.linspace(density(first), density(1.0), count), density(y), y)
    share[[0, -1]] = first, 1.0
    return share


def _valid(pressure, volume, slope) -> np.ndarray:
    finite = np.isfinite(pressure) & np.isfinite(volume) & (slope < 0)
    return finite & (np.nan_to_num(pressure) > 0) & (np.nan_to_num(volume) > 0)


def scan(membrane: Membrane, stretches, loads, refinement: int = _REFINEMENT) -> Scan:
    """Samples the chart over stretches × loads (pairs of limits) and interpolates it on a fine grid.

    Nodes crowd towards the flat end, where p and V behave like powers of √(λa − λ0); logarithms of p/(1 − t) and V are
    interpolated, by quintic splines along the stretch and Chebyshev polynomials along the load.
    """
    low, high = stretches
    prestretch = float(membrane.prestretch)
    span = high - prestretch
    first = max((low - prestretch) / span, 1e-8)
    count = refinement * (_NODES[0] - 1) + 1
    fine_share = stretch_shares(first, count)
    fine_s = np.linspace(0.0, 1.0, count)
    s, share = fine_s[::refinement], fine_share[::refinement]

    def stretch_of(share):
        return np.minimum(prestretch + span * share, high)

    bottom, top = loads[0], min(loads[1], SCANNED_LOAD)
    panels, counts = [bottom], []
    for edge, count in zip((*_PANELS, top), _NODES[1], strict=True):
        if edge == top or panels[-1] + 0.05 < edge < top - 0.05:
            panels.append(edge)
            counts.append(count)
    x, fine_t, matrix = _panel_matrix(panels, counts, refinement)

    apex, t = (v.ravel() for v in np.meshgrid(stretch_of(share), x, indexing="ij"))
    pressure, volume, slope = map_nodes(membrane.material, apex, t, prestretch, 28.0)
    # towards lock-up at a high load the equations are stiffer; elsewhere 28 steps leave 1e-6
    stiff = (t > 0.4) & ((apex - prestretch) > 0.5 * span)
    for values, better in zip(
        (pressure, volume, slope), map_nodes(membrane.material, apex[stiff], t[stiff], prestretch, 128.0), strict=True
    ):
        values[stiff] = better
    # an inner layer forms there
    stiff = (t > 0.8) & ((apex - prestretch) > 0.7 * span)
    if stiff.any():
        better = map_nodes(membrane.material, apex[stiff], t[stiff], prestretch, float(MOST_STEPS))
        for values, node in zip((pressure, volume, slope), better, strict=True):
            values[stiff] = node
    wrong = ~_valid(pressure, volume, slope)
    if wrong.any():
        better = map_nodes(membrane.material, apex[wrong], t[wrong], prestretch, float(MOST_STEPS))
        for values, node in zip((pressure, volume, slope), better, strict=True):
            values[wrong] = node
    valid = _valid(pressure, volume, slope).reshape(len(share), len(x))
    with np.errstate(invalid="ignore", divide="ignore"):
        fields = np.stack([np.log(pressure / (1 - t)), np.log(volume)]).reshape(2, *valid.shape)
    fine = np.full((2, len(fine_s), len(fine_t)), np.nan)
    if valid.all():
        smooth = make_interp_spline(s, fields, k=5, axis=1)(fine_s)
        fine = smooth @ matrix.T
    elif valid.sum(axis=0).min() >= 6:
        # a node that no step count resolves is left to its column's neighbours, and the cells about it to nobody
        columns = [
            make_interp_spline(s[ok], column[:, ok], k=5, axis=1)(fine_s)
            for ok, column in zip(valid.T, np.moveaxis(fields, 2, 0), strict=True)
        ]
        fine = np.stack(columns, axis=2) @ matrix.T
        for row, column in np.argwhere(~valid):
            near = np.abs(fine_s - s[row]) < s[1] - s[0]
            beside = x[max(column - 1, 0)], x[min(column + 1, len(x) - 1)]
            inside = (fine_t >= min(beside)) & (fine_t <= max(beside))
            fine[np.ix_(np.arange(2), np.flatnonzero(near), np.flatnonzero(inside))] = np.nan
    apex = stretch_of(fine_share)
    return Scan(
        apex,
        fine_t,
        np.asarray(largest_load(membrane.material, apex)),
        np.exp(fine[0]) * (1 - fine_t),
        np.exp(fine[1]),
    )


def edge_code(state: np.ndarray, stretches, loads, locks: bool, fraction: float) -> Code:
    """Which limit of the window a state (λa, p, q) with load fraction t = `fraction` is nearest to."""
    low, high = stretches
    gaps = {
        Code.lock_up if locks else Code.window_stretch: (high - state[0]) / (high - low),
        Code.window_stretch: (state[0] - low) / (high - low),
        Code.window_load: min(fraction - loads[0], loads[1] - fraction) / (loads[1] - loads[0]),
    }
    return min(gaps, key=lambda code: gaps[code])
