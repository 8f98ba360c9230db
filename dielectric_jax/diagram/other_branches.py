"""Which scenes have a contour below breakdown besides the line that was traced: another branch.

Seen on the scan of the membrane: cells of its grid in which the loading's residual changes sign, and in whose
neighbourhood the line has no point.
"""

import jax
import numpy as np

from ..model import SCALE, ConstantVoltage, Membrane, Scene, cached_scan
from .polylines import Polylines
from .scene_batch import Crowd, pick

__all__ = ["have_others"]

_DENSE = 6, 16, 200  # points on an interval of a line: closer where cells are left, as rows crowd towards lock-up
_TOGETHER = 32  # scenes that are looked at together, in the cache
_EVERY = 3  # node of the scan is enough to see another branch


def _spread(cells: np.ndarray) -> np.ndarray:
    """Cells (…, rows, columns) and their neighbours."""
    rows = cells.copy()
    rows[:, 1:] |= cells[:, :-1]
    rows[:, :-1] |= cells[:, 1:]
    both = rows.copy()
    both[..., 1:] |= rows[..., :-1]
    both[..., :-1] |= rows[..., 1:]
    return both


def have_others(membrane: Membrane, own: np.ndarray, crowd: Crowd, lines: Polylines) -> np.ndarray:
    """Which of the scenes `own`, all with one membrane, have a contour below breakdown away from their line."""
    found = np.zeros(len(own), bool)
    stretches, _, loads = Scene(membrane, ConstantVoltage(0.0)).limits()
    chart = cached_scan(membrane, stretches, loads)
    columns = np.flatnonzero(chart.load_fraction >= -0.02)[::_EVERY]
    rows = np.arange(0, len(chart.apex_stretch), _EVERY)
    apex, t = chart.apex_stretch[rows], chart.load_fraction[columns]
    p, v = (field[np.ix_(rows, columns)] for field in (chart.pressure, chart.volume))
    q = t * chart.largest_load[rows, None]
    breaks = crowd.limits(apex, np.full(len(apex), own[0]))[0]
    known = np.isfinite(p) & np.isfinite(v)
    known = known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]
    known &= (q[:-1, :-1] <= breaks[:-1, None]) & (t[:-1] >= 0)
    nodes = np.flatnonzero(_spread(np.pad(known, ((0, 1), (0, 1)))[None]))
    at_nodes = [field.ravel()[nodes] for field in (p, v, q)]
    for i in range(0, len(own), _TOGETHER):
        some = own[i : i + _TOGETHER]
        contour = jax.tree.map(lambda leaf: leaf[:, None], pick(crowd.contour, some))
        sign = np.zeros((len(some), *p.shape), bool)
        with np.errstate(invalid="ignore"):
            sign.reshape(len(some), -1)[:, nodes] = contour.residual(*at_nodes) < 0
        along, across = sign[..., 1:] ^ sign[..., :-1], sign[:, 1:] ^ sign[:, :-1]
        away = known & (along[:, 1:] | along[:, :-1] | across[..., 1:])
        for most in _DENSE:
            which = np.flatnonzero(away.any(axis=(1, 2)))
            if not len(which):
                break
            dense = lines.take(some[which]).dense(most) * SCALE
            there = np.isfinite(dense[..., 0])
            line, x = np.nonzero(there)[0], dense[there]
            limit = np.interp(x[:, 0], chart.apex_stretch, chart.largest_load)
            row = np.clip(np.searchsorted(apex, x[:, 0]) - 1, 0, len(apex) - 2)
            column = np.clip(np.searchsorted(t, x[:, 2] / limit) - 1, 0, len(t) - 2)
            near = np.zeros((len(which), *known.shape), bool)
            near[line, row, column] = True
            away[which] &= ~_spread(near)
        found[i : i + _TOGETHER] = away.any(axis=(1, 2))
    return found
