"""Special points of a branch, located to solver tolerance: roots of event functions between neighbouring points.

Each event function is bracketed by neighbours (a pair of roots hidden in one interval is looked for in the Hermite
interpolant of q or p and split first). The root is then found by a secant method that keeps its bracket, on planes across
the chord, every trial an exact point of the branch; the roots of one kind advance together.
"""

import concurrent.futures
import dataclasses

import numpy as np

from .branches import Curve, between, hermite, scaled, solve_between
from .equilibria import SCALE, Points, polish

__all__ = ["Located", "fold_events", "locate", "special_points"]


_QUICK_ROUNDS, _ROUNDS = 2, 16
_PROFILE_STEPS = 192.0
_CLOSE, _EXACT = 1e-7, 1e-10  # changes of the share of an interval at which a root is close, and done


@dataclasses.dataclass
class Located:
    """One root on a branch: its kind, the arclength of the branch there, the state (one lane), its error estimate."""

    kind: str
    branch: int
    position: float
    point: Points
    error: float


def event_values(kind: str, points: Points, target: float = 0.0) -> np.ndarray:
    """The function of an event on points (lanes,): it vanishes at the event."""
    if kind == "fold":
        return points.tangent[:, 2]
    if kind == "pressure_fold":
        return points.tangent[:, 1]
    if kind == "zero_voltage":
        return points.u[2] / 0.02
    if kind == "load":
        return (points.u[2] - target) / 0.02
    if kind == "breakdown":
        return points.u[2] * points.field - 1
    if kind == "hoop_tension_loss":
        return points.hoop
    raise ValueError(f"`kind` must be the name of an event, but is {kind!r}.")


def fold_events(kind: str, membrane, contour, curve: Curve, tolerance: float) -> Curve:
    """The curve with points added where q (or p) on one interval has a hidden pair of folds."""
    column = 2 if kind == "fold" else 1
    for _ in range(3):
        x, t = scaled(curve.points.u.T)[:, column], curve.points.tangent[:, column]
        gap = np.diff(curve.position)
        share = np.linspace(0, 1, 9)[1:-1, None]
        step = 1e-4
        slope = hermite(x[:-1], x[1:], t[:-1], t[1:], gap, share + step) - hermite(
            x[:-1], x[1:], t[:-1], t[1:], gap, share - step
        )
        hidden = (t[:-1] * t[1:] > 0) & ((slope * np.sign(t[:-1])) < 0).any(axis=0)
        if not hidden.any():
            break
        i = np.flatnonzero(hidden)
        middle = solve_between(membrane, contour, curve.points, i, np.full(len(i), 0.5), tolerance=tolerance)
        ok = np.flatnonzero(middle.ok)
        place = np.concatenate([np.arange(len(curve.points)), i[ok] + 0.5])
        points = Points.join([curve.points, middle.take(ok)]).take(np.argsort(place, kind="stable"))
        gap = np.linalg.norm(np.diff(scaled(points.u.T), axis=0), axis=1)
        curve = dataclasses.replace(curve, points=points, position=np.concatenate([[0.0], np.cumsum(gap)]))
        if not len(ok):
            break
    return curve


def brackets(curve: Curve, kind: str, target: float = 0.0) -> np.ndarray:
    """Indices i with a sign change of the event function between points i and i + 1."""
    f = event_values(kind, curve.points, target)
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(((f[:-1] < 0) != (f[1:] < 0)) & np.isfinite(f[:-1]) & np.isfinite(f[1:]))


def locate(membrane, contour, curves: list[Curve], wanted: list[tuple], tolerance: float) -> list[Located]:
    """Roots for `wanted` = (kind, branch, interval, target); those that fail are left out.

    A given load is a row of Newton's system and takes one solve; the other events, and a load that this fails for, take
    the secant method.
    """
    linear = [w for w in wanted if w[0] in ("zero_voltage", "load")]
    found, missed = _locate_loads(membrane, contour, curves, linear, tolerance)
    rest = [w for w in wanted if w not in linear] + missed
    # folds want exact tangents, an extreme along the membrane a fine profile: apart, and side by side
    groups = [[w for w in rest if "fold" in w[0]], [w for w in rest if w[0] == "hoop_tension_loss"]]
    groups.append([w for w in rest if w not in groups[0] and w not in groups[1]])
    with concurrent.futures.ThreadPoolExecutor(len(groups)) as pool:
        jobs = [pool.submit(_locate_roots, membrane, contour, curves, g, tolerance) for g in groups if g]
    return found + [root for job in jobs for root in job.result()]


def _hermite_roots(x0, x1, t0, t1, gap, target) -> np.ndarray:
    """Share of each interval at which the cubic Hermite interpolant takes the target between its ends; by bisection."""
    low, high = np.zeros_like(x0), np.ones_like(x0)
    sign = np.where(x0 < target, 1.0, -1.0)
    for _ in range(40):
        middle = (low + high) / 2
        below = (hermite(x0, x1, t0, t1, gap, middle) - target) * sign < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


def _quadratic_root(c0, c1, c2, default) -> np.ndarray:
    """The root in (0, 1) of c0 + c1 s + c2 s², or the default where there is none."""
    with np.errstate(all="ignore"):
        q = -(c1 + np.where(c1 >= 0, 1, -1) * np.sqrt(c1 * c1 - 4 * c0 * c2)) / 2
        roots = np.stack([q / c2, c0 / q])
        inside = np.isfinite(roots) & (roots > 0) & (roots < 1)
    return np.where(inside[0], roots[0], np.where(inside[1], roots[1], default))


def _locate_loads(membrane, contour, curves, wanted, tolerance):
    """States at given loads by one Newton solve each; and the wanted ones it failed for."""
    if not wanted:
        return [], []
    ends = Points.join([curves[b].points.take(np.array([i, i + 1])) for _, b, i, _ in wanted])
    first = 2 * np.arange(len(wanted))
    x, t = scaled(ends.u.T), ends.tangent
    gap = np.linalg.norm(x[first + 1] - x[first], axis=1)
    target = np.array([w[3] for w in wanted])
    share = _hermite_roots(x[first, 2], x[first + 1, 2], t[first, 2], t[first + 1, 2], gap, target / SCALE[2])
    at, normal, _ = between(ends, first, share)
    rows = np.tile([0.0, 0.0, 1.0], (len(wanted), 1))
    points = polish(membrane, contour, (at * SCALE).T, rows, target, tolerance=tolerance / 4, reach=0.5)
    points.tangent = points.tangent * np.where((points.tangent * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    along = (normal * (scaled(points.u.T) - x[first])).sum(axis=1)
    ok = points.ok & (along > -1e-6) & (along < gap + 1e-6) & (points.error <= tolerance)
    found = [
        Located(kind, b, float(curves[b].position[i] + along[n]), points.take(np.array([n])), float(points.error[n]))
        for n, (kind, b, i, _) in enumerate(wanted)
        if ok[n]
    ]
    return found, [w for n, w in enumerate(wanted) if not ok[n]]


def _locate_roots(membrane, contour, curves, wanted, tolerance) -> list[Located]:
    """Roots of event functions by a secant method that keeps its brackets."""
    if not wanted:
        return []
    chord_points = Points.join([curves[b].points.take(np.array([i, i + 1])) for _, b, i, _ in wanted])
    lanes = np.arange(len(wanted))
    ends = 2 * lanes

    def values(points):
        return np.array([event_values(k, points.take(np.array([n])), x)[0] for n, (k, _, _, x) in enumerate(wanted)])

    low, high = np.zeros(len(wanted)), np.ones(len(wanted))
    f_low, f_high = values(chord_points.take(ends)), values(chord_points.take(ends + 1))
    share = -f_low / (f_high - f_low)
    x, t = scaled(chord_points.u.T), chord_points.tangent
    chords = np.linalg.norm(x[ends + 1] - x[ends], axis=1)
    for kind, column in (("fold", 2), ("pressure_fold", 1)):
        # the extremum of the Hermite cubic of q (or p): a quadratic's root
        which = np.array([w[0] == kind for w in wanted])
        if which.any():
            a, b = ends[which], ends[which] + 1
            rise, d0, d1 = (x[b] - x[a])[:, column] / chords[which], t[a, column], t[b, column]
            share[which] = _quadratic_root(d0, 6 * rise - 4 * d0 - 2 * d1, 3 * (d0 + d1 - 2 * rise), share[which])
    last_share = np.full(len(wanted), np.nan)
    last_f = np.full(len(wanted), np.nan)
    change = np.full(len(wanted), np.inf)
    slopes = np.full(len(wanted), np.nan)
    results: list[Points | None] = [None] * len(wanted)
    active = lanes
    for round_ in range(_ROUNDS):
        quick = round_ < _QUICK_ROUNDS
        # an extreme inside the membrane is a minimum over nodes: it needs a fine grid of its own
        hoop = any(wanted[n][0] == "hoop_tension_loss" and change[n] < 1e-2 for n in active)
        found = solve_between(
            membrane,
            contour,
            chord_points,
            ends[active],
            share[active],
            tolerance=tolerance / 4,
            quick=quick,
            refine=not quick and any("fold" in wanted[n][0] for n in active),
            profile_steps=_PROFILE_STEPS if hoop else 0.0,
        )
        f = np.array(
            [event_values(wanted[n][0], found.take(np.array([k])), wanted[n][3])[0] for k, n in enumerate(active)]
        )
        at = share[active]
        below = ((f < 0) == (f_low[active] < 0)) & np.isfinite(f)
        above = ~below & np.isfinite(f)
        low[active[below]], f_low[active[below]] = at[below], f[below]
        high[active[above]], f_high[active[above]] = at[above], f[above]
        with np.errstate(all="ignore"):
            # values of the coarse and the fine grid differ: their secants do not mix
            fresh = np.isnan(last_f[active]) | (round_ == _QUICK_ROUNDS)
            chord = (f_high - f_low)[active] / (high - low)[active]
            secant = (f - last_f[active]) / (at - last_share[active])
            slope = np.where(
                np.isfinite(secant) & (secant != 0) & ~fresh,
                secant,
                np.where(fresh, slopes[active], chord) if round_ else chord,
            )
            new = at - f / slope
            slopes[active] = slope
        good = np.isfinite(new) & (new > -0.05) & (new < 1.05)
        new = np.where(good, new, (low[active] + high[active]) / 2)
        change[active] = np.abs(new - at)
        last_share[active], last_f[active] = at, f
        for k, n in enumerate(active):
            results[n] = found.take(np.array([k]))
        done = change[active] < (_CLOSE if quick else _EXACT)
        if not hoop:
            done &= np.array([wanted[n][0] != "hoop_tension_loss" for n in active])
        if quick:
            share[active] = new
            if round_ == _QUICK_ROUNDS - 1 or done.all():
                continue
        else:
            active, new = active[~done], new[~done]
            if not len(active):
                break
            share[active] = new
    gap = np.linalg.norm(np.diff(scaled(chord_points.u.T), axis=0), axis=1)[ends]
    out = []
    for n, (kind, branch, i, _) in enumerate(wanted):
        point = results[n]
        assert point is not None
        if not point.ok[0] or not change[n] < 1e-5:
            continue
        # what the remaining step along the branch would change in the located quantity
        along = change[n] * gap[n] * np.abs(point.tangent[0] * [1.0, 0.2, 0.02])
        if kind in ("fold", "pressure_fold"):
            along = along * change[n]
        column = {"pressure_fold": 1}.get(kind, 2)
        rest = along[column] / max(abs(point.u[column, 0]), 1e-3) if kind != "zero_voltage" else 0.0
        position = curves[branch].position[i] + share[n] * gap[n]
        out.append(Located(kind, branch, float(position), point, float(max(point.error[0], rest))))
    return out


def special_points(membrane, contour, curves: list[Curve], kinds: tuple[str, ...], tolerance: float) -> list[Located]:
    """All special points of the named kinds on all branches, in order along each branch."""
    wanted = [
        (kind, branch, int(i), 0.0)
        for branch, curve in enumerate(curves)
        for kind in kinds
        for i in brackets(curve, kind)
    ]
    found = locate(membrane, contour, curves, wanted, tolerance)
    return sorted(found, key=lambda p: (p.branch, p.position))
