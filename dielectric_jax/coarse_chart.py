"""A coarse chart of a membrane's whole window: regimes of the loadings that its surface does not decide.

Snaps next to the cone and landings far above breakdown lie beyond the surface's domain. The contour of the loading on a grid of
the explicit map tells what becomes of them, but not where exactly.
"""

import dataclasses
import functools

import contourpy
import numpy as np
from scipy.interpolate import RectBivariateSpline

from .batch import ByLeaves
from .chart import map_nodes
from .materials import largest_load
from .membrane import Membrane, field_ratio_squared
from .regimes import Regime
from .scene import SCANNED_LOAD

__all__ = ["CoarseChart", "coarse_chart"]

_ROWS, _LOADS = 260, 90  # nodes of the coarse chart
_LINE, _FINE = 1500, 400  # places in the stretch and the load between which landings are sought
_ROOT = np.sqrt(1.7)  # of 1 − t at the lowest load
_TOP = 0.995  # its largest load fraction
_STEPS = 128.0
_BESIDE = 0.2  # of the stretch at a fold: nearer to it no landing is read from the coarse chart
_PRESSURE = 1e3  # no state of the window comes near it
_PROMINENCE = 2e-4  # of a maximum of q on the coarse chart, as a share


@dataclasses.dataclass(frozen=True)
class CoarseChart:
    """p and V on a coarse grid (rows of λa, columns of t) of the whole window, and what the loads of its rows are."""

    membrane: Membrane
    apex: np.ndarray
    fraction: np.ndarray
    limit: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    breaks: np.ndarray
    line: tuple
    fine: tuple

    def regime(self, given: dict, snap=None) -> Regime:
        """The regime of one loading by its contours on the grid, or only what follows a known `snap` (λa, q)."""
        start, gas = self._loading(given)
        if start is None:
            return Regime.undetermined
        excess = self.pressure - gas(self.volume)
        if snap is not None:
            return self._after_snap(gas, *snap)[0]
        lines = _Lines(self, excess)
        here = lines.nearest(start[0], 0.0)
        if here is None:
            return Regime.undetermined
        first = True
        for _ in range(3):
            kind, apex, q, further = lines.climb(here, self)
            if kind == "unstable" and first:
                return Regime.start_unstable
            if kind == "breaks":
                if first:
                    return Regime.breaks_before_snap if further else Regime.no_snap
                return lines.descend(here)
            if kind != "snap":
                return Regime.undetermined
            first = False
            end, landing = self._after_snap(gas, apex, q)
            if landing is None:
                return end
            here = lines.nearest(float(landing), q)
            if here is None:
                return Regime.undetermined
        return Regime.undetermined

    def landing(self, given: dict, snap) -> tuple[float, float]:
        """λa and p of the state on which a snap from (λa, q) lands, broken or not; NaN where there is none."""
        start, gas = self._loading(given)
        found = None if start is None else self._first_landing(gas, *snap)
        return (np.nan, np.nan) if found is None else found

    def _loading(self, given: dict):
        """λa and pressure of the start, None where there is none, and the pressure of the gas at a volume."""
        if "pressure" in given:
            return self._start(self.pressure, given["pressure"]), lambda v: given["pressure"] + 0 * v
        start = self._start(self.volume, given["initial_volume"])
        p0 = np.nan if start is None else start[1]
        outside, n = given["atmospheric_pressure"], given["polytropic_exponent"]
        room = given["initial_volume"] + given["chamber_volume"]
        return start, lambda v: (p0 + outside) * (room / (v + given["chamber_volume"])) ** n - outside

    def _start(self, field, wanted):
        """λa and pressure of the smallest state at zero voltage."""
        j = int(np.argmin(np.abs(self.fraction)))
        values = field[:, j]
        reached = np.flatnonzero(values >= wanted)
        if not len(reached) or reached[0] == 0:
            return None
        i = reached[0]
        share = (wanted - values[i - 1]) / (values[i] - values[i - 1])
        return tuple(float(v[i - 1] + share * (v[i] - v[i - 1])) for v in (self.apex, self.pressure[:, j]))

    def _after_snap(self, gas, apex: float, q: float):
        """What becomes of a snap from (λa, q): its regime, and the λa of an unbroken landing else None."""
        found = self._first_landing(gas, apex, q)
        if found is None:
            return Regime.no_landing, None
        if q >= np.interp(found[0], self.apex, self.breaks):
            return Regime.breaks_in_snap, None
        return Regime.undetermined, found[0]

    def _first_landing(self, gas, apex: float, q: float) -> tuple[float, float] | None:
        """λa and p where a snap from (λa, q) lands.

        At a given q the membrane grows while its pressure lacks behind the gas: it lands where that ends.
        """
        line, limit = self.line
        # beside the fold, where the excess touches zero, its sign is noise
        first = int(np.searchsorted(line, apex + _BESIDE * (apex - float(self.membrane.prestretch))))
        line, t = line[first:], q / limit[first:]
        column = (_ROOT - np.sqrt(np.maximum(1 - t, 0.0))) / (_ROOT - np.sqrt(1 - _TOP)) * (_FINE - 1)
        j = np.clip(column.astype(int), 0, _FINE - 2)
        rows, share = np.arange(first, _LINE), column - j
        pressure, volume = (f[rows, j] + share * (f[rows, j + 1] - f[rows, j]) for f in self.fine)
        value = np.where(t <= SCANNED_LOAD + 0.02, pressure - gas(volume), np.nan)
        value = _cut(value, t)
        # beyond the scanned window, towards the cone, states are unstable and the chart is vague
        with np.errstate(invalid="ignore"):
            lands = np.flatnonzero((value[:-1] < 0) & (value[1:] >= 0)) + 1
        if not len(lands):
            return None
        i = lands[0]
        share = value[i - 1] / (value[i - 1] - value[i])
        landing, reached = (f[i - 1] + share * (f[i] - f[i - 1]) for f in (line, pressure))
        return float(landing), float(reached)


@functools.lru_cache(maxsize=16)  # 10 MB each
def coarse_chart(key: ByLeaves) -> CoarseChart:
    """The chart of a membrane."""
    membrane = key.membrane
    rim, high = float(membrane.prestretch), membrane.lock_up_stretch()[0]
    apex = rim + (high - rim) * np.linspace(0.02, 1.0, _ROWS) ** 2
    # even in the root of 1 − t, with zero among them
    roots = np.linspace(_ROOT, np.sqrt(1 - _TOP), _LOADS)
    fraction = 1 - roots**2
    fraction[np.argmin(np.abs(fraction))] = 0.0
    grid = np.meshgrid(apex, fraction, indexing="ij")
    p, v, slope = map_nodes(membrane.material, grid[0].ravel(), grid[1].ravel(), rim, _STEPS)
    # no membrane of this stretch encloses more than a sphere of it
    with np.errstate(invalid="ignore"):
        good = (slope < 0) & (p > 0) & (p < _PRESSURE) & (v > 0) & (v < 4.2 * high**3)
    p, v = (np.where(good, values, np.nan).reshape(grid[0].shape) for values in (p, v))
    limit = largest_load(membrane.material, apex)
    breaks = 1 / np.asarray(field_ratio_squared(membrane.breakdown, apex, apex))
    # splines in the variables in which the nodes are even
    place, depth = np.sqrt((apex - rim) / (high - rim)), -np.sqrt(1 - fraction)
    whole = [_completed(f) for f in (p, v)]
    line = np.linspace(apex[0], apex[-1], _LINE)
    even = np.linspace(-_ROOT, -np.sqrt(1 - _TOP), _FINE), np.sqrt((line - rim) / (high - rim))
    fine = tuple(RectBivariateSpline(place, depth, f)(even[1], even[0]) for f in whole)
    limits = line, largest_load(membrane.material, line)
    return CoarseChart(membrane, apex, fraction, limit, p, v, breaks, limits, fine)


def _completed(field: np.ndarray) -> np.ndarray:
    """The field with the few nodes that the map did not reach, beside the cone, from their neighbours in the stretch."""
    filled = field.copy()
    nodes = np.arange(len(field))
    for column in filled.T:
        there = np.isfinite(column)
        column[~there] = np.interp(nodes[~there], nodes[there], column[there])
    return filled


def _cut(value: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Values along a line within the scanned window; those next to its edge are the values on the edge itself."""
    inside = t <= SCANNED_LOAD
    cut = np.where(inside, value, np.nan)
    for step in (1, -1):
        edge = np.flatnonzero(inside & ~np.roll(inside, -step))
        edge = edge[(edge + step >= 0) & (edge + step < len(t))]
        share = (SCANNED_LOAD - t[edge]) / (t[edge + step] - t[edge])
        cut[edge + step] = value[edge] + share * (value[edge + step] - value[edge])
    return cut


class _Lines:
    """The contours of one loading on the coarse chart, as λa and q along each."""

    def __init__(self, chart: CoarseChart, excess: np.ndarray):
        masked = np.ma.masked_invalid(excess)
        drawn = contourpy.contour_generator(z=masked, name="serial").lines(0.0)
        self.lines = []
        for line in drawn:
            column, row = np.asarray(line).T
            apex = np.interp(row, np.arange(_ROWS), chart.apex)
            limit = np.interp(row, np.arange(_ROWS), chart.limit)
            fraction = np.interp(column, np.arange(_LOADS), chart.fraction)
            self.lines.append((apex, fraction * limit, fraction))

    def nearest(self, apex: float, q: float):
        """The line and place on it nearest to a state."""
        best = None
        for k, (a, load, _) in enumerate(self.lines):
            distance = np.abs(a - apex) / apex + np.abs(load - q) / (0.01 + q)
            i = int(np.argmin(distance))
            if best is None or distance[i] < best[0]:
                best = distance[i], k, i
        return None if best is None or best[0] > 0.1 else best[1:]

    def climb(self, here, chart: CoarseChart):
        """Along rising q: "breaks", "snap" or "end", where, and whether a fold lies further on."""
        k, i = here
        apex, q, _ = self.lines[k]
        # the stable branch grows with the load
        side = 1 if apex[min(i + 2, len(apex) - 1)] > apex[max(i - 2, 0)] else -1
        apex, q = apex[i::side], q[i::side]
        if len(q) < 4:
            return "end", np.nan, np.nan, False
        if q[min(3, len(q) - 1)] < q[0]:
            return "unstable", np.nan, np.nan, False
        top = np.maximum.accumulate(q)
        falls = np.flatnonzero(top - q > _PROMINENCE * (np.abs(top) + 1e-3))
        broken = np.flatnonzero(q >= np.interp(apex, chart.apex, chart.breaks))
        fold = int(np.argmax(q[: falls[0] + 1])) if len(falls) else len(q)
        if len(broken) and broken[0] <= fold:
            return "breaks", apex[broken[0]], q[broken[0]], bool(len(falls))
        return ("snap", apex[fold], q[fold], True) if len(falls) else ("end", apex[-1], q[-1], False)

    def descend(self, here) -> Regime:
        """Along falling q from a landing: whether zero comes before a fold."""
        k, i = here
        apex, q, _ = self.lines[k]
        side = -1 if apex[min(i + 2, len(apex) - 1)] > apex[max(i - 2, 0)] else 1
        q = q[i::side]
        zero = np.flatnonzero(q <= 0)
        low = np.minimum.accumulate(q)
        rises = np.flatnonzero(q - low > _PROMINENCE * (np.abs(low) + 1e-3))
        if len(zero) and (not len(rises) or zero[0] < rises[0]):
            return Regime.stays
        return Regime.returns if len(rises) else Regime.undetermined
