"""Critical points on lines of the chart at one load: extremes of the pressure, zero-voltage states, bistability, cusps.

At a given q the states form one curve over λa. The explicit map gives it on nodes, splines between the nodes locate the point, and
Newton on the equations of `point_systems` makes it exact. Nothing here is differentiated.
"""

import dataclasses
import functools
import itertools

import jax
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

from ..diagram import MembraneKey
from ..model import (
    SCALE,
    Chamber,
    ConstantVoltage,
    LoadingCondition,
    Membrane,
    PointKind,
    largest_load,
    map_nodes,
    stretch_shares,
)
from ..numerics import Code
from .point_systems import Conditions, correction
from .resolution import (
    EXPLICIT_STEPS,
    FINE,
    GRIDS,
    LEAST_ERROR,
    LINE_LOAD,
    MOST_LINES,
    NODES,
    PRESTRETCH_SPACING,
    SAFETY,
)
from .rim import ShotRim

__all__ = ["chamber_cusps", "onset", "pressure_cusp", "pressure_extremes", "settle", "states_at", "zero_states"]


class Line:
    """p and V of a membrane at the load q over λa, as splines over the node number."""

    def __init__(self, membrane: Membrane, q: float):
        self.membrane, self.q = membrane, float(q)
        rim, high = float(membrane.prestretch), membrane.lock_up_stretch()[0]
        apex = rim + (high - rim) * stretch_shares(1e-6, NODES)
        t = self.q / largest_load(membrane.material, apex)
        p, v, slope = map_nodes(membrane.material, apex, np.clip(t, -20, LINE_LOAD), rim, EXPLICIT_STEPS)
        good = np.isfinite(p) & np.isfinite(v) & (slope < 0) & (t < LINE_LOAD) & (p > 0) & (v > 0)
        # one piece: the longest run of nodes
        ends = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
        runs = ends.reshape(-1, 2)
        self.length = 0
        if not len(runs):
            return
        a, b = runs[np.argmax(runs[:, 1] - runs[:, 0])]
        if b - a < 8:
            return
        self.length = int(b - a)
        logs = np.stack([np.log(apex[a:b] - rim), np.log(p[a:b]), np.log(v[a:b])])
        self.spline = make_interp_spline(np.arange(b - a), logs, k=5, axis=1)
        self.fine = np.linspace(0, b - a - 1, (b - a - 1) * FINE + 1)

    def at(self, place):
        """λa, p, V at positions on the line."""
        stretch, p, v = np.exp(self.spline(place))
        return float(self.membrane.prestretch) + stretch, p, v

    def roots(self, function) -> list[float]:
        """Positions where a function of the position vanishes, in order."""
        values = function(self.fine)
        crossing = np.flatnonzero(np.isfinite(values[:-1]) & np.isfinite(values[1:]) & (values[:-1] * values[1:] < 0))
        return [brentq(function, self.fine[i], self.fine[i + 1], xtol=1e-12) for i in crossing]  # pyright: ignore


@functools.lru_cache(maxsize=MOST_LINES)
def _line(key: MembraneKey, q: float) -> Line:
    return Line(key.membrane, q)


def line_of(membrane: Membrane, q: float) -> Line:
    """The line of a membrane at a load; recent lines are cached because chambers share them."""
    return _line(MembraneKey.of(membrane), float(q))


def settle(kind: PointKind, u, theta: Conditions, free: int | None = None, value: float = 0.0):
    """Newton on the equations of a kind from u = (λa, p, q) and the free leaf's value; then again on a finer grid.

    Returns (λa, p, q, V, error, code, free), NaN with a code if it does not converge.
    """
    scale = np.concatenate([SCALE, [abs(value) or 1.0]])
    x, begin = np.array([*u, value], float), np.array([*u, value], float)
    leaves, tree = jax.tree.flatten(theta)
    which = (
        [0, 1, 3]
        if kind == PointKind.onset
        else [0, 1, 2, 3]
        if kind in (PointKind.cusp, PointKind.pressure_cusp)
        else [0, 1, 2]
    )
    move, volume = np.full(4, np.inf), np.nan

    def step(steps):
        at = theta if free is None else tree.unflatten([*leaves[:free], x[3], *leaves[free + 1 :]])
        _, found, volume = correction(kind, ShotRim(np.asarray(steps)), x[:3], at, free)
        move = np.zeros(4)
        move[which] = np.asarray(found)
        return move, float(volume)

    coarse, fine = GRIDS[0]
    for _ in range(12):
        move, volume = step(coarse)
        size = np.abs(move / scale).max()
        if not size < 3:
            break
        x = x + move * min(1.0, 0.2 / max(size, 1e-300))
        if size < 1e-9:
            break
    if not np.abs(move / scale).max() < 1e-7 or not np.abs((x - begin) / scale).max() < 1:
        return np.array([np.nan] * 5 + [float(Code.not_converged), np.nan])
    move, volume = step(fine)
    x = x + move
    located = 3 if free is not None else 2 if kind == PointKind.load else 1
    error = np.abs(move[located]) / SAFETY / max(abs(x[located]), 1e-3) + LEAST_ERROR
    return np.array([*x[:3], volume, error, float(Code.ok), x[3] if free is not None else np.nan])


def none(code: Code) -> np.ndarray:
    """The row of a point that does not exist, with the code that says why."""
    return np.array([np.nan] * 5 + [float(code), np.nan])


def pressure_extremes(membrane: Membrane, q: float) -> dict[str, np.ndarray]:
    """The first peak of the pressure along λa at a load, and the first valley after it."""
    line = line_of(membrane, q)
    found = {"peak": none(Code.no_pressure_fold), "valley": none(Code.no_pressure_fold)}
    if not line.length:
        return found
    slope = line.spline.derivative()
    theta = Conditions(membrane, ConstantVoltage(0.0).condition(), np.asarray(float(q)))
    begun = False
    for place in line.roots(lambda s: slope(s)[1]):
        peak = slope(place - 1e-3)[1] > 0
        name = "peak" if peak else "valley"
        if np.isfinite(found[name][0]) or (not peak and not begun):
            continue
        begun |= bool(peak)
        apex, p, _ = line.at(place)
        found[name] = settle(PointKind.pressure_fold, (apex, p, float(q)), theta)
    return found


def states_at(membrane: Membrane, condition: LoadingCondition, q: float) -> list[np.ndarray]:
    """Every state at a load under a loading, in order of λa."""
    line = line_of(membrane, q)
    if not line.length:
        return []
    roots = line.roots(lambda s: np.asarray(condition.residual(*line.at(s)[1:], q)))
    theta = Conditions(membrane, condition, np.asarray(float(q)))
    return [settle(PointKind.load, (*line.at(place)[:2], float(q)), theta) for place in roots]


def zero_states(membrane: Membrane, condition: LoadingCondition) -> list[np.ndarray]:
    """Every state at zero voltage under a loading, in order of λa."""
    return states_at(membrane, condition, 0.0)


def leaf_of(theta: Conditions, name: str) -> int:
    """The number of the leaf of θ that holds a parameter: the membrane's prestretch or one of its loading condition."""
    if name == "prestretch":
        return len(jax.tree.leaves(theta.membrane.material))
    fields = [field.name for field in dataclasses.fields(LoadingCondition)]
    return len(jax.tree.leaves(theta.membrane)) + fields.index(name)


def _volume_through(loading: Chamber, filled, p, v):
    """The chamber volume for which (p, V) satisfies the loading condition with the filling (p_0, V_0)."""
    outside, power = float(loading.atmospheric_pressure), 1 / float(loading.polytropic_exponent)
    a0, a = (filled[0] + outside) ** power, (p + outside) ** power
    with np.errstate(all="ignore"):
        return (a0 * filled[1] - a * v) / (a - a0)


def onset(membrane: Membrane, loading: Chamber, filled) -> np.ndarray:
    """The smallest chamber volume with a second stable state at zero voltage: a tangency at q = 0."""
    line = line_of(membrane, 0.0)
    if not line.length:
        return none(Code.no_bistability)

    def chamber(place):
        _, p, v = line.at(place)
        volume = _volume_through(loading, filled, p, v)
        return np.where((volume > 0) & (v > filled[1]), volume, np.nan)

    values = chamber(line.fine)
    with np.errstate(invalid="ignore"):
        low = np.flatnonzero((values[1:-1] < values[:-2]) & (values[1:-1] <= values[2:])) + 1
    if not len(low):
        return none(Code.no_bistability)
    i = low[np.argmin(values[low])]
    apex, p, _ = line.at(line.fine[i])
    theta = Conditions(membrane, loading.condition(*filled), np.asarray(0.0))
    return settle(
        PointKind.onset, (float(apex), float(p), 0.0), theta, leaf_of(theta, "chamber_volume"), float(values[i])
    )


def pressure_cusp(membrane: Membrane, q: float, within: tuple[float, float]) -> np.ndarray:
    """The prestretch at which peak and valley of the pressure merge at a load."""
    low, high = within

    def gap(rim: float):
        """The least slope of log p between peak and valley, and where it occurs."""
        own = Membrane(membrane.material, rim, membrane.breakdown)
        line = line_of(own, q)
        if not line.length:
            return np.nan, None
        # by log λa: a smooth parametrisation, unlike the graded nodes
        rate = line.spline.derivative()(line.fine)
        apex, p, _ = line.at(line.fine)
        slope = rate[1] / (rate[0] * (apex - rim) / apex)
        inner = slice(2 * FINE, -2 * FINE)
        least = np.flatnonzero((slope[inner][1:-1] < slope[inner][:-2]) & (slope[inner][1:-1] <= slope[inner][2:]))
        if not len(least):
            return np.nan, None
        i = least[np.argmin(slope[inner][1:-1][least])] + 1 + 2 * FINE
        return slope[i], (float(apex[i]), float(p[i]))

    rims = np.linspace(low, high, int(np.clip(np.ceil((high - low) / PRESTRETCH_SPACING) + 1, 5, 25)))
    values = np.array([gap(float(r))[0] for r in rims])
    change = np.flatnonzero(
        np.isfinite(values[:-1]) & np.isfinite(values[1:]) & ((values[:-1] < 0) != (values[1:] < 0))
    )
    if not len(change):
        return none(Code.no_cusp)
    rim = float(brentq(lambda r: gap(r)[0], rims[change[0]], rims[change[0] + 1], xtol=1e-6))  # pyright: ignore
    place = gap(rim)[1]
    if place is None:
        return none(Code.no_cusp)
    theta = Conditions(
        Membrane(membrane.material, rim, membrane.breakdown), ConstantVoltage(0.0).condition(), np.asarray(q)
    )
    return settle(PointKind.pressure_cusp, (*place, q), theta, leaf_of(theta, "prestretch"), rim)


def chamber_cusps(membrane: Membrane, loading: Chamber, filled, within: tuple[float, float]) -> list[np.ndarray]:
    """Cusps of the folds over the chamber's volume, in order of volume.

    For each state at a given q there is one chamber volume whose loading condition it satisfies, a function of λa. Where it
    has an extremum, that chamber has a fold; where two extrema merge as q changes, two folds merge.
    """
    low, high = within
    top = float(largest_load(membrane.material, np.array([float(membrane.lock_up_stretch()[0]) * 0.9]))[0])
    loads = np.linspace(-0.3, 1.0, 80) * min(top, 0.05)
    found: list[np.ndarray] = []
    before = None
    for q in loads:
        line = line_of(membrane, float(q))
        extremes = []
        if line.length:
            apex, p, v = line.at(line.fine)
            share = 1 / _volume_through(loading, filled, p, v)  # smooth where the chamber is infinite
            valid = (share > 0.5 / high) & (share < 2 / low) & (v > filled[1] * 1.0001)
            rise = np.diff(share)
            turn = np.flatnonzero((rise[:-1] * rise[1:] < 0) & valid[:-2] & valid[1:-1] & valid[2:]) + 1
            extremes = [(float(apex[i]), float(p[i]), float(share[i])) for i in turn]
        if before is not None and abs(len(extremes) - len(before[1])) == 2:
            more = max((extremes, before[1]), key=len)
            at = q if more is extremes else before[0]
            pairs = sorted(itertools.pairwise(more), key=lambda ab: abs(ab[0][2] / ab[1][2] - 1))
            (a0, p0, s0), (a1, p1, s1) = pairs[0]
            theta = Conditions(membrane, loading.condition(*filled), np.asarray(0.0))
            guess = ((a0 + a1) / 2, (p0 + p1) / 2, float(at))
            point = settle(PointKind.cusp, guess, theta, leaf_of(theta, "chamber_volume"), 2 / (s0 + s1))
            if point[5] == int(Code.ok) and low <= point[6] <= high:
                found.append(point)
        before = q, extremes
    return sorted(found, key=lambda point: point[6])
