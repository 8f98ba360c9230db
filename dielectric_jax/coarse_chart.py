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

__all__ = ["CoarseChart", "coarse_chart"]

_ROWS, _LOADS = 260, 90  # nodes of the coarse chart
_LINE = 1500  # places along a given load at which landings are sought
_TOP = 0.995  # its largest load fraction
_STEPS = 128.0
_BESIDE = 0.2  # of the stretch at a fold: nearer to it no landing is read from the coarse chart
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
    splines: tuple

    def regime(self, given: dict, snap=None) -> Regime:
        """The regime of one loading by its contours on the grid, or only what follows a known `snap` (λa, q)."""
        if "pressure" in given:
            gas, start = (lambda v: given["pressure"] + 0 * v), self._start(self.pressure, given["pressure"])
        else:
            start = self._start(self.volume, given["initial_volume"])
            if start is None:
                return Regime.undetermined
            outside, n = given["atmospheric_pressure"], given["polytropic_exponent"]
            p0, room = start[1], given["initial_volume"] + given["chamber_volume"]

            def gas(v):
                return (p0 + outside) * (room / (v + given["chamber_volume"])) ** n - outside

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

    def _read(self, apex, t) -> tuple[np.ndarray, np.ndarray]:
        """p and V at places between the nodes."""
        row = np.interp(apex, self.apex, np.arange(_ROWS))
        column = np.interp(t, self.fraction, np.arange(_LOADS))
        p, v = (spline.ev(row, column) for spline in self.splines)
        return p, v

    def _after_snap(self, gas, apex: float, q: float):
        """What becomes of a snap from (λa, q): its regime, and the λa of an unbroken landing else None.

        At a given q the membrane grows while its pressure lacks behind the gas: it lands where that ends.
        """
        # beside the fold, where the excess touches zero, its sign is noise
        beyond = apex + _BESIDE * (apex - float(self.membrane.prestretch))
        line = np.linspace(beyond, self.apex[-1], _LINE)
        t = q / np.asarray(self.membrane.largest_load(line))
        pressure, volume = self._read(line, t)
        value = np.where(t <= self.fraction[-1], pressure - gas(volume), np.nan)
        # beside the cone, t = 1, states are unstable: a change of sign across what the chart leaves out is no landing
        with np.errstate(invalid="ignore"):
            lands = np.flatnonzero((value[:-1] < 0) & (value[1:] >= 0)) + 1
        if not len(lands):
            return Regime.no_landing, None
        i = lands[0]
        share = value[i - 1] / (value[i - 1] - value[i])
        landing = line[i - 1] + share * (line[i] - line[i - 1])
        if q >= np.interp(landing, self.apex, self.breaks):
            return Regime.breaks_in_snap, None
        return Regime.undetermined, landing


@functools.lru_cache(maxsize=64)
def coarse_chart(key: ByLeaves) -> CoarseChart:
    """The chart of a membrane."""
    membrane = key.membrane
    rim, high = float(membrane.prestretch), membrane.lock_up_stretch()[0]
    apex = rim + (high - rim) * np.linspace(0.02, 1.0, _ROWS) ** 2
    # even in the root of 1 − t, with zero among them
    roots = np.linspace(np.sqrt(1.7), np.sqrt(1 - _TOP), _LOADS)
    fraction = 1 - roots**2
    fraction[np.argmin(np.abs(fraction))] = 0.0
    grid = np.meshgrid(apex, fraction, indexing="ij")
    p, v, slope = map_nodes(membrane.material, grid[0].ravel(), grid[1].ravel(), rim, _STEPS)
    good = (slope < 0) & np.isfinite(p) & np.isfinite(v)
    p, v = (np.where(good, values, np.nan).reshape(grid[0].shape) for values in (p, v))
    limit = np.asarray(largest_load(membrane.material, apex))
    breaks = 1 / np.asarray(field_ratio_squared(membrane.breakdown, apex, apex))
    nodes = np.arange(_ROWS), np.arange(_LOADS)
    whole = [np.where(np.isfinite(f), f, np.nan_to_num(np.nanmean(f, axis=0))) for f in (p, v)]
    splines = tuple(RectBivariateSpline(*nodes, f) for f in whole)
    return CoarseChart(membrane, apex, fraction, limit, p, v, breaks, splines)


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
