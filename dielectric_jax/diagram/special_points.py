"""Special points of a branch, located to solver tolerance: roots of event functions between neighbouring points.

Each event function is bracketed by neighbours (a pair of roots hidden in one interval is looked for in the Hermite
interpolant of q or p and split first). A cubic through four neighbours predicts the root and the slope there; a secant
method that keeps its bracket goes on from it, on planes across the chord, every trial an exact point of the branch. All
roots advance together.
"""

import concurrent.futures
import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import root_scalar

from ..model import SCALE, PointKind, Points
from .mesh import Curve, between, hermite, scaled, solve_between
from .resolution import ROOT_CLOSE, ROOT_EXACT, ROOT_ROUNDS, ROOT_SMALL
from .surface_contours import OnSurface

__all__ = [
    "FOLDS",
    "Located",
    "TestFunction",
    "brackets",
    "control_line",
    "event_values",
    "fold_events",
    "loads_beside_folds",
    "locate",
    "special_points",
]


FOLDS = {
    PointKind.pressure_fold: 1,
    PointKind.fold: 2,
    PointKind.charge_fold: 3,
}  # and the column of the control that turns there


class TestFunction:
    """A function of a state that vanishes at a special point, beside those of the kinds of `PointKind`."""

    @staticmethod
    def of_each(tests: Sequence, points: Points) -> np.ndarray:
        """The values (lanes,) of test functions of one class at points, one of each."""
        raise NotImplementedError


def event_values(kind: PointKind, points: Points, target: float = 0.0) -> np.ndarray:
    """The function of an event on points (lanes,): it vanishes at the event."""
    if kind in FOLDS:
        return points.control_slope(FOLDS[kind])
    if kind == PointKind.zero_voltage:
        return points.u[2] / 0.02
    if kind == PointKind.load:
        return (points.u[2] - target) / 0.02
    if kind == PointKind.charge:
        return (points.control(3) - target) / 0.02
    if kind == PointKind.breakdown:
        return points.u[2] * points.field - 1
    if kind == PointKind.hoop_tension_loss:
        return points.hoop
    raise ValueError(f"`kind` must be a PointKind with a test function, but is {kind!r}.")


def control_line(points: Points, column: int):
    """A control along a branch and its slope by the arclength, in scaled units."""
    if column != 3:
        return points.u[column] / SCALE[column], points.control_slope(column)
    return points.control(3) / SCALE[2], points.control_slope(3) * points.charge_per_voltage**2


def brackets(curve: Curve, kind: PointKind, target: float = 0.0) -> np.ndarray:
    """Indices i with a sign change of the event function between points i and i + 1."""
    f = event_values(kind, curve.points, target)
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(((f[:-1] < 0) != (f[1:] < 0)) & np.isfinite(f[:-1]) & np.isfinite(f[1:]))


@dataclasses.dataclass
class Located:
    """One root on a branch: its kind, the arclength of the branch there, the state (one lane), its error estimate."""

    kind: PointKind
    branch: int
    position: float
    point: Points
    error: float
    number: int | None = None  # the circumferential number of a neutral mode


def fold_events(kind: PointKind, solver, curve: Curve, tolerance: float) -> Curve:
    """The curve with points added where the control on one interval has a hidden pair of folds."""
    for _ in range(3):
        x, t = control_line(curve.points, FOLDS[kind])
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
        middle = solve_between(solver, curve.points, i, np.full(len(i), 0.5), tolerance=tolerance)
        ok = np.flatnonzero(middle.ok & (middle.error <= tolerance))
        place = np.concatenate([np.arange(len(curve.points)), i[ok] + 0.5])
        points = Points.join([curve.points, middle.take(ok)]).take(np.argsort(place, kind="stable"))
        gap = np.linalg.norm(np.diff(scaled(points.u.T), axis=0), axis=1)
        curve = dataclasses.replace(curve, points=points, position=np.concatenate([[0.0], np.cumsum(gap)]))
        if not len(ok):
            break
    return curve


def locate(solver, curves: list[Curve], wanted: list[tuple], tolerance: float, *, certify: bool = True):
    """Roots for `wanted` = (kind, branch, interval, target), and those of `wanted` that were not located to tolerance.

    On a surface, roots are located there first; with `certify` shooting then starts from them, and what it corrects is part
    of their error.
    """
    if not isinstance(solver, OnSurface):
        found, missed = _locate(solver, curves, wanted, tolerance, {})
        return list(found.values()), missed
    easy = [w for w in wanted if w[0] not in solver.shot_kinds]
    near, _ = _locate(dataclasses.replace(solver, alone=True), curves, easy, tolerance, {})
    shot = wanted if certify else [w for w in wanted if w not in near]
    found, missed = _locate(solver.shooting, curves, shot, tolerance, near)
    for w, root in near.items():
        if w in found:
            column = 1 if w[0] == PointKind.pressure_fold else 2
            seen, exact = (
                r.point.volume[0] if w[0] == PointKind.zero_voltage else r.point.u[column, 0] for r in (root, found[w])
            )
            found[w].error = max(found[w].error, abs(float(seen - exact)) / max(abs(float(exact)), 1e-3))
        elif not certify:
            found[w] = dataclasses.replace(root, point=_with_index(curves[w[1]], w[2], root, solver.condition.control))
    return list(found.values()), missed


def _with_index(curve: Curve, interval: int, root: Located, control: int) -> Points:
    """The point of a root with what its neighbour on the same side of any fold knows: index and least hoop tension."""
    ends = curve.points.take(slice(interval, interval + 2))
    same = root.point.tangent[0, control] * ends.tangent[0, control] > 0 or root.kind in FOLDS
    return dataclasses.replace(root.point, index=ends.index[[0 if same else 1]], hoop=ends.hoop[[0 if same else 1]])


def _locate(solver, curves, wanted, tolerance, near: dict):
    """Roots by their place in `wanted`, and those not located; `near` holds roots to start from.

    A given load is a row of Newton's system and takes one solve; the other events, and a load that this fails for, take
    the secant method.
    """
    loads = [w for w in wanted if w[0] in (PointKind.zero_voltage, PointKind.load)]
    rest = [w for w in wanted if w not in loads]
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        job = pool.submit(_locate_loads, solver, curves, loads, tolerance)
        roots, missed = _locate_roots(solver, curves, rest, tolerance, near)
        found, again = job.result()
    more, lost = _locate_roots(solver, curves, again, tolerance, near)
    return found | roots | more, missed + lost


def _root_between(function, low: float = 0.0, high: float = 1.0) -> float | None:
    """The root of a scalar function between two places by Brent's method; None where it has one sign at both."""
    first, last = float(function(low)), float(function(high))
    return root_scalar(function, bracket=(low, high), xtol=1e-15).root if first * last <= 0 else None


def _hermite_roots(x0, x1, t0, t1, gap, target) -> np.ndarray:
    """Share of each interval at which the cubic Hermite interpolant takes the target between its ends."""

    def share(level, a, b, t0, t1, gap):
        found = _root_between(lambda s: hermite(a, b, t0, t1, gap, s) - level)
        # an end that is the level but for rounding
        return (0.0 if abs(a - level) < abs(b - level) else 1.0) if found is None else found

    return np.array([share(*own) for own in np.broadcast(target, x0, x1, t0, t1, gap)])


def _predict(curve: Curve, kind: PointKind, interval: int, target: float):
    """Root and slope, in shares of the interval, of the cubic through the event function at four neighbours.

    An event function may be a least value that changes from one place of the membrane to another on the interval: the root
    then belongs to the side where the function is negative, and so do the four.
    """
    count = len(curve.points)
    values = event_values(kind, curve.points.take(slice(max(interval - 3, 0), interval + 5)), target)
    start = max(interval - 3, 0)
    f0, f1 = values[interval - start], values[interval + 1 - start]
    chord = -f0 / (f1 - f0), f1 - f0
    gap = curve.position[interval + 1] - curve.position[interval]

    def cubic(first):
        if first < 0 or first + 4 > count or not np.isfinite(values[first - start : first - start + 4]).all():
            return None
        x = (curve.position[first : first + 4] - curve.position[interval]) / gap
        matrix = np.vander(x, increasing=True)
        return np.polynomial.Polynomial(np.linalg.solve(matrix, values[first - start : first - start + 4]))

    def root(poly):
        place = _root_between(poly)
        if place is None:  # one sign at both ends: beyond one of them
            place = 1.0 if (poly(0.5) < 0) == (f0 < 0) else 0.0
        return place, poly.deriv()(place)

    centred, sided = cubic(interval - 1), cubic(interval + 1 if f1 < 0 else interval - 3)
    if sided is not None:
        seen = sided(0.0) - f0 if f1 < 0 else sided(1.0) - f1
        if centred is None or seen > 0.1 * abs(f1 - f0):
            return root(sided)
    return chord if centred is None else root(centred)


def _fold_share(curve: Curve, kind: PointKind, interval: int) -> tuple[float, float] | None:
    """Share of the interval at which the control turns, and the slope of the tangent's component there by the share.

    From ten neighbours; None where they do not run one way.

    Their coordinates are exact and analytic in each other, while tangents carry the error of Newton's grid.
    """
    first = min(max(interval - 4, 0), len(curve.points) - 10)
    if first < 0:
        return None
    x = scaled(curve.points.u[:, first : first + 10].T)
    column = FOLDS[kind]
    along = max((c for c in range(3) if c != column), key=lambda c: abs(curve.points.tangent[interval, c]))
    if column == 3:
        near = curve.points.take(slice(first, first + 10))
        x = np.column_stack([x, near.control(3) / (near.charge_per_voltage[interval - first] ** 2 * SCALE[2])])
    middle, half = (x[0, along] + x[-1, along]) / 2, (x[-1, along] - x[0, along]) / 2
    s = (x[:, along] - middle) / half
    if not (np.diff(s) > 0).all():
        return None
    line = [np.polynomial.Polynomial(c) for c in np.linalg.solve(np.vander(s, increasing=True), x).T]
    slope, i = line[column].deriv(), interval - first
    if not slope(s[i]) * slope(s[i + 1]) < 0:
        return None
    chord = x[i + 1, :3] - x[i, :3]
    root = _root_between(slope, s[i], s[i + 1])
    if root is None:
        return None
    at, rate = (np.array([f(root) for f in lines[:3]]) for lines in (line, [f.deriv() for f in line]))
    per_share = (chord @ chord) / (rate @ chord)
    return float((at - x[i, :3]) @ chord / (chord @ chord)), float(
        slope.deriv()(root) / np.linalg.norm(rate) * per_share * np.sign(per_share)
    )


def _shifted(curve: Curve, interval: int, point: Points, share: float, move: float) -> Points:
    """The state of one lane at a share of the interval moved a little, along its tangent and its neighbours' slopes."""
    first = min(max(interval - 1, 0), len(curve.points) - 4)
    gap = curve.position[interval + 1] - curve.position[interval]
    x = (curve.position[first : first + 4] - curve.position[interval]) / gap
    weights = np.linalg.solve(np.vander(x, increasing=True).T, [0.0, 1.0, 2 * share, 3 * share**2])
    chord = scaled(curve.points.u[:, interval + 1] - curve.points.u[:, interval])
    rate = gap * gap / (point.tangent[0] @ chord)
    moved = {"u": point.u + move * rate * (point.tangent * SCALE).T}
    for name in ("volume", "height", "charge_per_voltage", "hoop", "field"):
        moved[name] = getattr(point, name) + move * (getattr(curve.points, name)[first : first + 4] @ weights)
    return dataclasses.replace(point, **moved)


def _locate_loads(solver, curves, wanted, tolerance):
    """States at given loads by one Newton solve each; and the wanted ones it failed for."""
    if not wanted:
        return {}, []
    ends = Points.join([curves[b].points.take(np.array([i, i + 1])) for _, b, i, _ in wanted])
    first = 2 * np.arange(len(wanted))
    x, t = scaled(ends.u.T), ends.tangent
    gap = np.linalg.norm(x[first + 1] - x[first], axis=1)
    target = np.array([w[3] for w in wanted])
    share = _hermite_roots(x[first, 2], x[first + 1, 2], t[first, 2], t[first + 1, 2], gap, target / SCALE[2])
    at, normal, _ = between(ends, first, share)
    rows = np.tile([0.0, 0.0, 1.0], (len(wanted), 1))
    points = solver.corrected_points((at * SCALE).T, rows, target, tolerance=tolerance / 2, reach=0.5)
    points.tangent = points.tangent * np.where((points.tangent * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    along = (normal * (scaled(points.u.T) - x[first])).sum(axis=1)
    ok = points.ok & (along > -1e-6) & (along < gap + 1e-6) & (points.error <= tolerance)
    found = {
        w: Located(
            w[0],
            w[1],
            float(curves[w[1]].position[w[2]] + along[n] / gap[n] * np.diff(curves[w[1]].position[w[2] : w[2] + 2])[0]),
            points.take(np.array([n])),
            float(points.error[n]),
        )
        for n, w in enumerate(wanted)
        if ok[n]
    }
    return found, [w for n, w in enumerate(wanted) if not ok[n]]


class _Brackets:
    """Roots of test functions on intervals of branches, each kept in a bracket of shares of its interval.

    A root is one of `wanted` = (kind, branch, interval, target). Rows of the arrays are the roots.
    """

    def __init__(self, curves: list[Curve], wanted: list[tuple], near: dict):
        self.curves, self.wanted = curves, wanted
        count = len(wanted)
        self.ends = Points.join([curves[b].points.take(np.array([i, i + 1])) for _, b, i, _ in wanted])
        self.gap = np.array([curves[b].position[i + 1] - curves[b].position[i] for _, b, i, _ in wanted])
        self.low, self.high = np.zeros(count), np.ones(count)
        first, lanes = 2 * np.arange(count), np.arange(count)
        self.f_low, self.f_high = (
            self.values(self.ends.take(first), lanes),
            self.values(self.ends.take(first + 1), lanes),
        )
        self.share, self.slope = np.array([self._predicted(n) for n in range(count)]).T
        for n, (kind, branch, i, _) in enumerate(wanted):
            if kind in FOLDS and (better := _fold_share(curves[branch], kind, i)) is not None:
                self.share[n], self.slope[n] = better
            if wanted[n] in near:
                self.share[n] = (near[wanted[n]].position - curves[branch].position[i]) / self.gap[n]
        self.last, self.f_last = np.full(count, np.nan), np.full(count, np.nan)
        self.change = np.full(count, np.inf)
        # a least value along the membrane has kinks: its neighbours may show nothing
        self.smooth = np.array(
            [kind != PointKind.hoop_tension_loss and len(curves[b].points) >= 4 for kind, b, _, _ in wanted]
        )
        self.trials: list[list[Points]] = [[] for _ in wanted]

    def _predicted(self, n: int) -> tuple[float, float]:
        """The share of the interval at which a root is expected, and the slope there; a test function is not asked once more."""
        kind, branch, interval, target = self.wanted[n]
        if isinstance(kind, TestFunction):
            rise = self.f_high[n] - self.f_low[n]
            return -self.f_low[n] / rise, rise
        return _predict(self.curves[branch], kind, interval, target)

    def values(self, points: Points, which) -> np.ndarray:
        """The test functions of the roots `which` at points, one of each."""
        kinds = [self.wanted[n][0] for n in which]
        found = np.empty(len(kinds))
        tests = np.array([isinstance(kind, TestFunction) for kind in kinds], bool)
        if tests.any():
            own = np.flatnonzero(tests)
            found[own] = kinds[own[0]].of_each([kinds[k] for k in own], points.take(own))
        for k in np.flatnonzero(~tests):
            found[k] = event_values(kinds[k], points.take(np.array([k])), self.wanted[which[k]][3])[0]
        return found

    def step(self, solver, active: np.ndarray, tolerance: float) -> np.ndarray:
        """One trial of each of the `active` roots; returns which of them go on."""
        at = self.share[active]
        fine = np.array([_is_fine(self.wanted[n][0]) for n in active])
        found = solve_between(solver, self.ends, 2 * active, at, tolerance=tolerance / 2, refine=fine)
        f = self.values(found, active)
        below = ((f < 0) == (self.f_low[active] < 0)) & np.isfinite(f)
        above = ~below & np.isfinite(f)
        self.low[active[below]], self.f_low[active[below]] = at[below], f[below]
        self.high[active[above]], self.f_high[active[above]] = at[above], f[above]
        with np.errstate(all="ignore"):
            secant = (f - self.f_last[active]) / (at - self.last[active])
            apart = np.isfinite(secant) & (secant != 0) & (np.abs(at - self.last[active]) > ROOT_CLOSE)
            self.slope[active] = np.where(apart, secant, self.slope[active])
            new = at - f / self.slope[active]
        # a step that leaves the bracket is a bisection
        low, high = self.low[active], self.high[active]
        fair = np.isfinite(new) & (new >= low - ROOT_CLOSE) & (new <= high + ROOT_CLOSE)
        new = np.where(fair, new, (low + high) / 2)
        self.change[active] = np.abs(new - at)
        for k, n in enumerate(active):
            self.trials[n] = [*self.trials[n][-1:], found.take(np.array([k]))]
        first_try, later = (np.where(self.smooth[active], limit, ROOT_EXACT) for limit in (ROOT_SMALL, ROOT_CLOSE))
        done = self.change[active] < np.where(np.isfinite(self.last[active]), later, first_try)
        for k in np.flatnonzero(done):
            self._finish(active[k], at[k], new[k])
        self.last[active], self.f_last[active] = at, f
        self.share[active[~done]] = new[~done]
        return active[~done]

    def _finish(self, n: int, at: float, new: float) -> None:
        """Moves a root's last trial the rest of the way, from the share `at` to `new`."""
        if not self.change[n] > ROOT_EXACT:
            return
        if len(self.trials[n]) > 1:
            before, latest = self.trials[n]
            apart = at - self.last[n]
            self.trials[n][-1] = _line(before, latest, (new - self.last[n]) / apart)
            self.change[n] *= abs(apart) + self.change[n]
        else:
            _, branch, i, _ = self.wanted[n]
            self.trials[n][-1] = _shifted(self.curves[branch], i, self.trials[n][-1], at, new - at)
            self.change[n] *= 1e-2  # slopes are right to a few digits
        self.share[n] = new

    def root(self, n: int) -> Located | None:
        """A root with its error estimate; None where it was not found."""
        kind, branch, i, _ = self.wanted[n]
        point, change, gap = self.trials[n][-1], self.change[n], self.gap[n]
        if not point.ok[0] or not change < 1e-5:
            return None
        # what the remaining step along the branch would change in the located quantity
        along = change * gap * np.abs(point.tangent[0] * SCALE) / np.maximum(np.abs(point.u[:, 0]), 1e-3)
        if kind in FOLDS:
            rest = along[min(FOLDS[kind], 2)] * change
        else:
            rest = along[1] if kind == PointKind.zero_voltage else along[1:].max()
        position = self.curves[branch].position[i] + self.share[n] * gap
        return Located(kind, branch, float(position), point, float(max(point.error[0], rest)))


def _locate_roots(solver, curves, wanted, tolerance, near: dict):
    """Roots of test functions by a secant method that keeps its brackets; and the wanted ones it failed for."""
    if not wanted:
        return {}, []
    search, active = _Brackets(curves, wanted, near), np.arange(len(wanted))
    for _ in range(ROOT_ROUNDS):
        active = search.step(solver, active, tolerance)
        if not len(active):
            break
    roots = {w: search.root(n) for n, w in enumerate(wanted)}
    return {w: root for w, root in roots.items() if root is not None}, [w for w in wanted if roots[w] is None]


def _is_fine(kind: PointKind) -> bool:
    """Whether an event's function wants a finer grid than the state: the slope of a fold, a stress along the membrane."""
    return kind in FOLDS or kind == PointKind.hoop_tension_loss


def _line(before: Points, last: Points, along: float) -> Points:
    """The states of one lane on the line through two of them: `along` is 0 at the one before and 1 at the last."""
    moved = {}
    for f in dataclasses.fields(Points):
        a, b = getattr(before, f.name), getattr(last, f.name)
        moved[f.name] = a + along * (b - a) if f.name not in ("index", "error", "ok") else b
    return Points(**moved)


def special_points(
    solver, curves: list[Curve], kinds: tuple[PointKind, ...], tolerance: float, *, certify: bool = True
):
    """All special points of the named kinds on all branches, in order along each branch; and (kind, branch, …) missed."""
    wanted = [
        (kind, branch, int(i), 0.0)
        for branch, curve in enumerate(curves)
        for kind in kinds
        for i in brackets(curve, kind)
    ]
    found, missed = locate(solver, curves, wanted, tolerance, certify=certify)
    if PointKind.zero_voltage in kinds:
        more = loads_beside_folds(solver, curves, found, PointKind.zero_voltage, 0.0, tolerance, certify=certify)
        found, missed = found + more[0], missed + more[1]
    return sorted(found, key=lambda p: (p.branch, p.position)), missed


def loads_beside_folds(
    solver, curves, located, kind: PointKind, target: float, tolerance: float, *, certify: bool = True
):
    """States at a load that two neighbours do not bracket, but a located fold between them does; and those not located.

    A fold nearer to zero voltage than its own error does not say whether there are such states: it counts as not located.
    """
    lines, wanted, missed = list(curves), [], []
    for fold in located:
        if fold.kind not in (PointKind.fold, PointKind.charge_fold):
            continue
        line, column = lines[fold.branch], FOLDS[fold.kind]
        load = float(fold.point.control(column)[0])
        i = int(np.searchsorted(line.position, fold.position)) - 1
        if not 0 <= i < len(line.position) - 1:
            continue
        above = line.points.control(column)[i : i + 2] > target
        doubt = fold.error * max(abs(load), 1e-3)
        if above[0] != above[1]:
            continue
        if abs(load - target) <= doubt:
            missed += [(kind, fold.branch, i, target)] if kind == PointKind.zero_voltage else []
        if abs(load - target) <= doubt or above[0] == (load > target):
            continue
        points = Points.join([line.points.take(slice(0, i + 1)), fold.point, line.points.take(slice(i + 1, None))])
        position = np.insert(line.position, i + 1, fold.position)
        lines[fold.branch] = dataclasses.replace(line, points=points, position=position)
        wanted = [(k, b, n + (b == fold.branch and n > i), at) for k, b, n, at in wanted]
        wanted += [(kind, fold.branch, i, target), (kind, fold.branch, i + 1, target)]
    if not wanted:
        return [], missed
    found, lost = locate(solver, lines, wanted, tolerance, certify=certify)
    return found, missed + lost
