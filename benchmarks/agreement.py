"""Do diagrams hold every branch, fold, zero-voltage state and breakdown that a finer scan of the chart shows, and no other?

Random scenes; each diagram against contours of the loading's condition on a spline through the explicit map on more than
four times the package's own nodes, in other variables. The comparison covers the window up to t = 0.9.

    python benchmarks/agreement.py [--scenes 1000] [--seed 0] [--first 0] [--json FILE|-] [--quick]
"""

import argparse
import math
import sys
import time
import traceback

import jax

jax.config.update("jax_enable_x64", True)

import contourpy
import numpy as np
import truth
from records import machine, write
from scipy.interpolate import RectBivariateSpline

import dielectric_jax as dj

SCALE = np.array([1.0, 0.2, 0.02])  # distances are measured in these units of (λa, p, q)
NODES = (200, 84)  # of the chart, along the stretch and the load
FINE = (1400, 500)  # of the contoured grid
TOP, BOTTOM = 0.9, -1.0
EDGE = 0.01  # in t, and as a share of the stretch: what lies this close to the window's edge is only noted
NOISE = 2e-6  # an extremum of q less prominent than this, relative to max(|q|, 1e-3), is near-degenerate
NEAR = 0.03  # distance at which a branch counts as the same
POSITION = 2e-5  # allowed difference of a special point's q, relative to max(|q|, 1e-3)


@jax.jit
def _map(limit, apex, q, rim, steps):
    return dj.explicit_map(dj.Gent(limit), apex, q, rim, steps)


def explicit(limit, apex, q, rim, steps, chunk=640):
    """The explicit map over arrays of one shape (n,)."""
    out = []
    for i in range(0, len(apex), chunk):
        a, b = (np.pad(v[i : i + chunk], (0, max(0, i + chunk - len(v))), mode="edge") for v in (apex, q))
        out.append(np.stack(_map(limit, a, b, rim, steps))[:, : len(apex) - i])
    return np.concatenate(out, axis=1)


class Chart:
    """Splines of log p/(1 − t) and log V in (x, y), where λa(x) crowds at both ends and t(y) towards t = 0.9."""

    def __init__(self, limit: float, rim: float):
        self.limit, self.rim, self.end = limit, rim, truth.lock_up(limit)
        x, y = np.linspace(0, 1, NODES[0]), np.linspace(0, 1, NODES[1])
        apex, t = (v.ravel() for v in np.meshgrid(self.apex(x), self.load(y), indexing="ij"))
        q = t * truth.largest_load(apex, limit)
        p, v, slope = explicit(limit, apex, q, rim, 64.0)
        hard = (t > 0.4) & (apex - rim > 0.4 * (self.end - rim))
        p[hard], v[hard], slope[hard] = explicit(limit, apex[hard], q[hard], rim, 200.0)
        good = (slope < 0) & np.isfinite(p) & np.isfinite(v) & (p > 0) & (v > 0)
        self.invalid_nodes = int((~good).sum())
        with np.errstate(all="ignore"):
            fields = [np.log(p / (1 - t)), np.log(v)]
        self.log_p, self.log_v = (
            RectBivariateSpline(x, y, np.where(good, f, 0.0).reshape(NODES), kx=5, ky=5) for f in fields
        )

    def apex(self, x):
        """λa from (flat end + 2e-5 of the span) at x = 0 to lock-up at x = 1; powers crowd the flat end."""
        share = 2e-5 + (1 - 2e-5) * x**3 * (1 + 1.6 * (1 - x)) if False else 2e-5 + (1 - 2e-5) * _crowd(x)
        return self.rim + (self.end - self.rim) * share

    def load(self, y):
        """T from −1 at y = 0 to 0.9 at y = 1, crowding towards 0.9."""
        return 1.15 - (1.15 - BOTTOM) * ((1.15 - TOP) / (1.15 - BOTTOM)) ** y
