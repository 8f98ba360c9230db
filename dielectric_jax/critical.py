"""Special points of a branch, located to solver tolerance: roots of event functions between neighbouring points.

Each event function is bracketed by neighbours (a pair of roots hidden in one interval is looked for in the Hermite
interpolant of q or p and split first). The root is then found by a secant method that keeps its bracket, on planes across
the chord, every trial an exact point of the branch with its exact tangent; all roots of a diagram advance together.
"""

import dataclasses

import numpy as np

from .branches import Curve, between, hermite, scaled, solve_between
from .equilibria import Points

__all__ = ["Located", "fold_events", "locate", "special_points"]


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
    if kind == "apex_stretch":
        return points.u[0] - target
    if kind == "pressure":
        return points.u[1] - target
    if kind == "volume":
        return np.log(points.volume / target)
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
    """Roots for `wanted` = (kind, branch, interval, target), advanced together; those that fail are left out."""
    if not wanted:
        return []
    chord_points = Points.join([curves[b].points.take(np.array([i, i + 1])) for _, b, i, _ in wanted])
    lanes = np.arange(len(wanted))
    ends = 2 * lanes

    def values(points):
        return np.array([event_values(k, points.take(np.array([n])), x)[0] for n, (k, _, _, x) in enumerate(wanted)])

    low, high = np.zeros(len(wanted)), np.ones(len(wanted))
    f_low, f_high = values(chord_points.take(ends)), values(chord_points.take(ends + 1))
    share = low - f_low * (high - low) / (f_high - f_low)
    older = None
    change = np.full(len(wanted), np.inf)
    found: Points | None = None
    for round_ in range(12):
        quick = round_ < 3
        found = solve_between(membrane, contour, chord_points, ends, share, tolerance=tolerance / 4, quick=quick)
        f = values(found)
        # keep the bracket, unless the trial sits on the root to rounding
        below = (f < 0) == (f_low < 0)
        bad = ~np.isfinite(f)
        low, f_low = np.where(below & ~bad, share, low), np.where(below & ~bad, f, f_low)
        high, f_high = np.where(~below & ~bad, share, high), np.where(~below & ~bad, f, f_high)
        with np.errstate(all="ignore"):
            if older is None:
                slope = (f_high - f_low) / (high - low)
            else:
                slope = (f - older[1]) / (share - older[0])
            new = share - f / slope
            inside = np.isfinite(new) & (new > low - 1e-6) & (new < high + 1e-6)
        new = np.where(inside, new, (low + high) / 2)
        change = np.abs(new - share)
        older = (share, f)
        if not quick and (change < 1e-11).all():
            break
        if round_ >= 4 and (change < 1e-9).all():
            break
        # a trial equal to the last one would make the next slope 0/0
        share = np.where(change < 1e-13, share + 1e-9, new) if round_ < 3 else np.where(change < 1e-12, share, new)
        if not quick and (share == older[0]).all():
            break
    assert found is not None
    _, _, target = between(chord_points, ends, share)
    del target
    gap = np.linalg.norm(np.diff(scaled(chord_points.u.T), axis=0), axis=1)[ends]
    out = []
    for n, (kind, branch, i, _) in enumerate(wanted):
        point = found.take(np.array([n]))
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
