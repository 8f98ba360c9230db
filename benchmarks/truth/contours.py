"""Curves and turning points of Gent membranes from nothing but `truth.py`: nothing here is shared with the package."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from benchmarks.truth import extended_precision as truth

__all__ = ["Gas", "Held", "loads", "moderate", "of_volume", "pressure_folds", "sharp", "turning"]


@dataclasses.dataclass(frozen=True)
class Gas:
    """The closed chamber (24), isothermal: p − p_gas(V)."""

    chamber: float
    filling: float
    pressure: float
    outside: float = 50.0

    def __call__(self, p, v):
        growth = (self.filling - v) / (v + truth.EXTENDED(self.chamber))
        return p - self.pressure - (truth.EXTENDED(self.pressure) + self.outside) * growth


@dataclasses.dataclass(frozen=True)
class Held:
    """Constant pressure."""

    pressure: float

    def __call__(self, p, v):
        return p - self.pressure + 0 * v


def sharp(apex, pressure, q, limit, rim, target=1e-12):
    """`truth.exact` with as many steps as make it known to `target`, and the uncertainty that is left."""
    apex, pressure, q, limit, rim = (np.array(x, float) for x in np.broadcast_arrays(apex, pressure, q, limit, rim))
    p, v, unsure = truth.exact(apex, pressure, q, limit, rim, steps=280)
    for steps in (800, 2400):
        again = ~(unsure <= target)
        if not again.any():
            break
        with np.errstate(all="ignore"):
            more = truth.exact(apex[again], pressure[again], q[again], limit[again], rim[again], steps=steps)
        p[again], v[again], unsure[again] = more
    return p, v, unsure


def moderate(apex, pressure, volume, q, limit, rim):
    """|error|/max(|value|, 1e-3) of answered p and V at their λa and q, the larger, and its uncertainty; arrays."""
    with np.errstate(all="ignore"):
        p, v, unsure = sharp(apex, pressure, q, limit, rim)
        pairs = ((p, pressure), (v, volume))
        error = np.max([np.abs(a - b) / np.maximum(np.abs(a), 1e-3) for a, b in pairs], axis=0)
    return error.astype(float), unsure


def of_volume(volume: float, limit: float, rim: float, low: float, high: float, q: float = 0.0) -> tuple[float, float]:
    """λa and p of the state at load q with a volume, between two stretches that bracket it."""
    for _ in range(12):
        apex = np.linspace(low, high, 9)
        p, v, _ = truth.states(apex, q, limit, rim, steps=280)
        i = int(np.flatnonzero((v[:-1] < volume) & (v[1:] >= volume))[0])
        low, high = apex[i], apex[i + 1]
        if high - low < 1e-4 * high:
            break
    x = (apex - apex[i]) / (high - low)
    near = slice(max(i - 3, 0), i + 5)
    lines = [np.polynomial.Polynomial.fit(x[near], np.asarray(w[near] - w[i], float), 5) for w in (v, p)]
    share = brentq(lambda s: lines[0](s) - float(volume - v[i]), 0, 1, xtol=1e-15)
    return float(apex[i] + share * (high - low)), float(p[i] + lines[1](share))


def turning(function: Callable, middle: float, half: float, count: int = 14) -> list[tuple[float, float]]:
    """Where a function (vectorised) turns within middle ± half, and its values there, by Chebyshev interpolation."""
    x = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    y = function(middle + half * x)
    line = np.polynomial.Chebyshev.fit(x, np.asarray(y - y[0], float), count - 1, domain=[-1, 1])
    roots = line.deriv().roots()
    roots = np.sort(roots[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) < 1)].real)
    return [(middle + half * r, float(y[0] + line(r))) for r in roots]


def least_slope(function: Callable, middle: float, half: float, count: int = 16) -> tuple[float, float]:
    """The least slope of a function within middle ± half, and where."""
    x = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    y = function(middle + half * x)
    slope = np.polynomial.Chebyshev.fit(x, np.asarray(y - y[0], float), count - 1, domain=[-1, 1]).deriv()
    fine = np.linspace(-1, 1, 20001)
    values = slope(fine) / half
    return float(values.min()), float(middle + half * fine[values.argmin()])


def loads(condition, apex, start: float, limit: float, rim: float, guess: float | None = None):
    """The true q at which the state of each λa meets a loading's condition, near `start`; with p and V. Arrays (lanes,)."""
    apex = np.asarray(apex, float)
    p = truth.rim_pressure(apex, start, limit, rim)
    p = np.asarray(truth.exact(apex, p, start, limit, rim, steps=140)[0], float)
    old, new = np.full(apex.shape, truth.EXTENDED(start)), np.full(apex.shape, truth.EXTENDED(start) + 1e-6)
    _, v, _ = p_true = truth.exact(apex, p, old, limit, rim, steps=280)
    before = condition(p_true[0], v)
    for _ in range(6):
        # lanes of `exact` are doubles: the load is rounded first, so that what is solved is what is returned
        new = new.astype(float).astype(truth.EXTENDED)
        p_new, v, _ = truth.exact(apex, p, new, limit, rim, steps=280)
        p = np.asarray(p_new, float)
        value = condition(p_new, v)
        with np.errstate(all="ignore"):
            move = np.nan_to_num(-value * (new - old) / (value - before))
        old, before, new = new, value, new + move
        if np.abs(move).max() < 1e-14:
            break
    return new, p_new, v


def pressure_folds(q: float, limit: float, rim: float, count: int, cone: float = 1e-3):
    """Folds of p(λa) at load q: lists of (λa, p, 1 − t) by pieces of the chart, up to 1 − t = `cone`; and their λa ranges.

    Scanned on graded stretches, each fold then by Chebyshev interpolation about it.
    """
    end = truth.lock_up(limit)
    line = np.linspace(rim + 1e-6, end, 20001)

    def fraction(apex):
        return q / truth.largest_load(apex, limit)

    inside = fraction(line) < 1
    edges = np.flatnonzero(inside[1:] != inside[:-1])
    cones = [brentq(lambda a: fraction(a) - 1, line[i], line[i + 1], xtol=1e-15) for i in edges]
    bounds = [rim, *cones, end]
    pieces = []
    for low, high in itertools.pairwise(bounds):
        if not fraction((low + high) / 2) < 1:
            continue
        s = np.linspace(-np.log(1e5), np.log(1e5), count)
        apex = low + (high - low) / (1 + np.exp(-s))
        apex = apex[(1 - fraction(apex) > cone) & (apex - rim > 1e-3)]
        with np.errstate(all="ignore"):
            p, _, unsure = truth.states(apex, q, limit, rim, steps=280)
        known = unsure < 1e-6
        apex, p = apex[known], p[known]
        rise = np.diff(p) > 0
        at = np.flatnonzero(rise[1:] != rise[:-1]) + 1
        places, half = apex[at], np.minimum(np.diff(apex)[at - 1], np.diff(apex)[at])
        values = np.full(len(at), np.nan)
        x = np.cos(np.pi * (np.arange(10) + 0.5) / 10)
        for width in (half, half / 10) if len(at) else ():  # the second for the digits; all folds in one call
            around = places[:, None] + width[:, None] * x
            there = truth.states(around.ravel(), q, limit, rim, steps=400)[0].reshape(around.shape)
            for k in range(len(at)):
                found = turning(lambda _, k=k, there=there: there[k], places[k], width[k], 10)
                nearest = min(found, key=lambda f, k=k: abs(f[0] - places[k]), default=(places[k], np.nan))
                places[k], values[k] = nearest
        folds = [(float(a), float(v), float(1 - fraction(a))) for a, v in zip(places, values, strict=True)]
        pieces.append({"range": (float(apex[0]), float(apex[-1])), "folds": folds})
    return pieces
