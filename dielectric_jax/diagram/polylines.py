"""Many curves at once as points with unit tangents: their cubic Hermite interpolants, turning points and crossings.

All in the scaled unknowns of the arclength, NumPy arrays of shape (lines, points, 3), NaN after the last point of a line.
"""

import dataclasses

import numpy as np

from .mesh import hermite
from .resolution import CLEAR_DIP, LONG_INTERVAL, NEAR_TURN

__all__ = ["Places", "Polylines"]


@dataclasses.dataclass
class Places:
    """Places on lines: line, interval and share in [0, 1] of the interval, arrays of one shape."""

    line: np.ndarray
    interval: np.ndarray
    share: np.ndarray

    def __len__(self) -> int:
        return len(self.line)

    @property
    def position(self) -> np.ndarray:
        """A number that rises along a line."""
        return self.interval + self.share

    def take(self, which) -> "Places":
        """The places `which`."""
        return Places(self.line[which], self.interval[which], self.share[which])


class Polylines:
    """Lines through `points` with unit `tangents`, (lines, points, 3) each, of which the first `count` are meant."""

    def __init__(self, points: np.ndarray, tangents: np.ndarray, count: np.ndarray):
        self.points, self.tangents, self.count = points, tangents, count

    def take(self, which) -> "Polylines":
        """The lines `which`."""
        return Polylines(self.points[which], self.tangents[which], self.count[which])

    @property
    def lengths(self) -> np.ndarray:
        """The chord of every interval, (lines, points − 1); NaN beyond the last."""
        gap = np.linalg.norm(np.diff(self.points, axis=1), axis=2)
        return np.where(np.arange(gap.shape[1]) < self.count[:, None] - 1, gap, np.nan)

    def _ends(self, places: Places):
        line, i = places.line, places.interval
        x0, x1, t0, t1 = (v[line, k] for v in (self.points, self.tangents) for k in (i, i + 1))
        return x0, x1, t0, t1, np.linalg.norm(x1 - x0, axis=1)[:, None]

    def at(self, places: Places):
        """Points, unit tangents and d(tangent)/ds of the interpolants, (places, 3) each."""
        x0, x1, t0, t1, gap = self._ends(places)
        s = places.share[:, None]
        point = hermite(x0, x1, t0, t1, gap, s)
        rate = 6 * s * (1 - s) * (x1 - x0) + gap * ((1 - s) * (1 - 3 * s) * t0 + s * (3 * s - 2) * t1)
        bend = 6 * (1 - 2 * s) * (x1 - x0) + gap * ((6 * s - 4) * t0 + (6 * s - 2) * t1)
        speed = np.linalg.norm(rate, axis=1)[:, None]
        tangent = rate / speed
        return point, tangent, (bend - (bend * tangent).sum(axis=1)[:, None] * tangent) / speed**2

    def turns(self, column: int) -> tuple[Places, Places]:
        """Where the interpolants of one unknown turn, and intervals whose ends do not tell whether they turn twice.

        The second are places to look at: the middle of the dip of the slope.
        """
        with np.errstate(all="ignore"):
            gap = self.lengths
            rise = np.diff(self.points[..., column], axis=1)
            d0, d1 = gap * self.tangents[:, :-1, column], gap * self.tangents[:, 1:, column]
            # slope = d0 + b s + a s²
            a, b = 3 * (d0 + d1) - 6 * rise, 6 * rise - 4 * d0 - 2 * d1
            root = np.sqrt(np.maximum(b * b - 4 * a * d0, 0.0))
            far = -0.5 * (b + np.where(b < 0, -root, root))
            first, second = far / a, d0 / far
            inside = (first >= 0) & (first <= 1)
            share = np.where(inside, first, second)
            once = (d0 < 0) != (d1 < 0)
            once &= np.isfinite(gap)
            dip = -b / (2 * a)
            low = d0 + dip * (b + a * dip)
            both = np.sign(d0)
            least, most = np.minimum(np.abs(d0), np.abs(d1)), np.maximum(np.abs(d0), np.abs(d1))
            hidden = ~once & (dip > 0) & (dip < 1)
            clear = np.where(gap > LONG_INTERVAL, CLEAR_DIP, 0.0)
            hidden &= low * both < np.maximum(NEAR_TURN * most, clear * least)
            hidden &= np.isfinite(gap)
        found = [np.nonzero(which) for which in (once, hidden)]
        share = np.clip(np.nan_to_num(share, nan=0.5), 0.0, 1.0)
        turning, dipping = (Places(w[0], w[1], s[w]) for w, s in zip(found, (share, dip), strict=True))
        return turning, dipping

    def insert(self, places: Places, points: np.ndarray, tangents: np.ndarray) -> tuple["Polylines", np.ndarray]:
        """The lines with more points on their intervals, and where each old point went, (lines, points)."""
        lines, most, _ = self.points.shape
        order = np.lexsort((places.position, places.line))
        line = places.line[order]
        added = np.bincount(line, minlength=lines)
        size = most + int(added.max(initial=0))
        index = np.broadcast_to(np.arange(most), (lines, most))
        shift = np.zeros((lines, most), int)
        np.add.at(shift, (line, np.minimum(places.interval[order] + 1, most - 1)), 1)
        index = index + np.cumsum(shift, axis=1)
        rank = np.arange(len(line)) - np.concatenate([[0], np.cumsum(added)])[line]
        own = places.interval[order] + 1 + rank
        out = []
        for old, new in ((self.points, points), (self.tangents, tangents)):
            whole = np.full((lines, size, 3), np.nan)
            np.put_along_axis(whole, index[..., None], old, axis=1)
            whole[line, own] = new[order]
            out.append(whole)
        return Polylines(out[0], out[1], self.count + added), index

    def crossings(self, values: np.ndarray, rates: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, Places]:
        """Where functions along `lines` change sign: rows, and places at the root of the cubic on the interval.

        `values` and their `rates` along the arclength are (rows, points), those of line `lines[row]`; NaN is on no side.
        """
        with np.errstate(invalid="ignore"):
            below = values < 0
            change = (below[:, 1:] != below[:, :-1]) & np.isfinite(values[:, 1:]) & np.isfinite(values[:, :-1])
        row, i = np.nonzero(change)
        gap = self.lengths[lines[row], i]
        f0, f1, d0, d1 = values[row, i], values[row, i + 1], gap * rates[row, i], gap * rates[row, i + 1]
        low, high = np.zeros(len(row)), np.ones(len(row))
        share = f0 / (f0 - f1)
        for _ in range(6):
            f = hermite(f0, f1, d0, d1, 1.0, share)
            slope = 6 * share * (1 - share) * (f1 - f0)
            slope += (1 - share) * (1 - 3 * share) * d0 + share * (3 * share - 2) * d1
            same = (f < 0) == (f0 < 0)
            low, high = np.where(same, share, low), np.where(same, high, share)
            with np.errstate(all="ignore"):
                new = share - f / slope
            share = np.where((new > low) & (new < high), new, (low + high) / 2)
        return row, Places(lines[row], i, share)

    def dense(self, most: int) -> np.ndarray:
        """`most` points on every interval, its end included, (lines, intervals × most, 3); NaN where there is none."""
        shares = np.arange(1, most + 1)[:, None] / most
        x, t = self.points[:, :, None], self.tangents[:, :, None]
        gap = self.lengths[..., None, None]
        return hermite(x[:, :-1], x[:, 1:], t[:, :-1], t[:, 1:], gap, shares).reshape(len(gap), -1, 3)
