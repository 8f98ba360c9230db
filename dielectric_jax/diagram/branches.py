"""From a scene to its branches: scan, continuation from a seed on every contour, points made exact.

The scan says which branches exist; continuation follows each one independently of the scan's values; the two are then
compared, and a contour that no branch covers is a new seed. Folds are not stepped over: the step is bounded by the turn of
the tangent, the final points are refined until neighbours turn by less than `_MOST_TURN`, and between neighbours the
Hermite interpolant of every event function is searched for a hidden pair of roots.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..model import (
    MOST_STEPS,
    SCALE,
    SCANNED_LOAD,
    LoadingCondition,
    Membrane,
    PointKind,
    Scan,
    Shooting,
    SpecialPoint,
    State,
    cached_scan,
    largest_load,
    load_fraction,
    locking_stretch,
    map_nodes,
)
from ..numerics import Code
from .mesh import Curve, clip_to_window, exact_curve, hermite, scaled
from .resolution import CONTOUR_STRIDE, COSTLY_LOAD, LARGEST_STEPS, NEAR_ON_SCAN, SAME_ON_SCAN, SCAN_MARGIN
from .special_points import FOLDS, Located, brackets, loads_beside_folds, locate
from .states import states_of
from .surface_contours import OnSurface, margins, surface_branches
from .tracing import run_trace, run_traces

__all__ = ["Solved", "find_curves", "special_record"]


_GAVE_UP = (Code.too_many_points, Code.step_too_small, Code.not_converged, Code.beyond_tolerance)


def _on_chart(membrane: Membrane, u: np.ndarray) -> np.ndarray:
    """Points (n, 3) as (λa, t) in tenths of the chart's extent, in which branches are distinguished."""
    span = membrane.lock_up_stretch()[0] - float(membrane.prestretch)
    fraction = u[:, 2] / largest_load(membrane.material, u[:, 0])
    return 10 * np.stack([(u[:, 0] - float(membrane.prestretch)) / span, fraction], axis=1)


def _distance_to_polyline(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance from each of the points (n, d) to a polyline (m, d)."""
    a, d = line[:-1], np.diff(line, axis=0)
    length2 = np.maximum((d * d).sum(axis=1), 1e-300)
    best = np.full(len(points), np.inf)
    for i in range(0, len(points), 256):
        part = points[i : i + 256, None] - a[None]
        along = np.clip((part * d).sum(axis=2) / length2, 0, 1)
        best[i : i + 256] = np.sqrt(((part - along[..., None] * d) ** 2).sum(axis=2)).min(axis=1)
    return best


def find_curves(solver, limits, *, count: int, tolerance: float, extend: bool = True):
    """All branches of a solver's loading in the window, and whether scan and engine agree on the scanned part.

    `limits` is `Scene.limits()`. Without `extend` an engine on a surface draws what its domain holds, and no more.
    """
    membrane, condition = solver.membrane, solver.condition
    stretches, locks, loads = limits
    box = np.array([*stretches, *loads])
    box[0] = max(box[0], float(membrane.prestretch) + 1e-8 * (box[1] - box[0]))
    limits = np.array([*box, locking_stretch(membrane)])

    def inside(u):
        return margins(membrane, u, box).min()

    def follow(u, direction, **options):
        return run_trace(membrane, condition, limits, u, direction, **options)

    def retrace(u, direction):
        line, tangents, code = follow(u, direction, level=-1)
        line, tangents = scaled(line), np.array(tangents)
        if len(line) > 1:
            clip_to_window(line, tangents, inside, -1)
        return line, tangents, _name_end(code, locks, membrane, line[-1] * SCALE) if len(line) else code

    lines = surface_branches(solver, box, follow if extend else None) if isinstance(solver, OnSurface) else []
    chart = cached_scan(membrane, stretches, loads)
    contours = chart.contours(condition)
    more, pending = _traced(membrane, condition, limits, contours, lines, chart, len(LARGEST_STEPS) if extend else 0)
    curves, complete = [], True
    for line, tangents, codes in lines + more:
        x = scaled(line)
        for end in (0, -1):
            clip_to_window(x, tangents, inside, end)
        codes = [_name_end(c, locks, membrane, x[end] * SCALE) for c, end in zip(codes, (0, -1), strict=True)]
        curve, whole = exact_curve(solver, x, tangents, codes, count, tolerance, chart, retrace)
        complete &= whole
        if curve is None:
            continue
        complete &= _agrees(membrane, curve, contours, chart) and _ended(membrane, curve)
        curves.append(curve)
    if pending:  # by the traces; a curve may come farther than its trace did
        shadows = [_on_chart(membrane, _dense(c.points.u.T, c.points.tangent)) for c in curves]
        complete &= all(_uncovered(membrane, c, shadows, chart.load_fraction[-1]) is None for c in pending)
    curves = _distinct(membrane, curves)
    curves.sort(key=lambda c: c.points.place(condition).min())
    return curves, bool(complete)


def _traced(membrane, condition, limits, contours, known: list, chart: Scan, rounds: int):
    """The branches that the scan shows and the `known` lines do not cover, by continuation; and what is left of them."""
    lines: list = []
    shadows = [_on_chart(membrane, _dense(line, tangents)) for line, tangents, _ in known]
    top = chart.load_fraction[-1]
    pending = [c for c in contours if _long_enough(membrane, c)]
    if known:
        pending = [part for c in pending if (part := _uncovered(membrane, c, shadows, top, 0.0)) is not None]
    # a coarse grid or a long step may join branches that nearly meet: what is still uncovered is tried on finer ones
    for level, largest in tuple(enumerate(LARGEST_STEPS))[:rounds]:
        seeds, headings = [], []
        for vertices in pending:
            seed, heading = _seed(membrane, vertices)
            seeds += [seed, seed]
            headings += [heading, -heading]
        if not seeds:
            break
        traced = run_traces(membrane, condition, limits, seeds, headings, level=level, largest=largest)
        for k in range(0, len(traced), 2):
            joined = _join(traced[k], traced[k + 1])
            if joined is None:
                continue
            line, tangents, codes = joined
            shadow = _on_chart(membrane, _dense(line, tangents))
            middle = len(shadow) // 2
            if any(_distance_to_polyline(shadow[middle : middle + 1], other)[0] < SAME_ON_SCAN for other in shadows):
                continue
            lines.append((line, tangents, codes))
            shadows.append(shadow)
        left = [_uncovered(membrane, c, shadows, top) for c in pending]
        pending = []
        for vertices in (_confirmed(membrane, condition, c) for c in left if c is not None):
            again = _uncovered(membrane, vertices, shadows, top) if len(vertices) > 2 else None
            if again is not None:
                pending.append(again)
        if not pending:
            break
    return lines, pending


def _name_end(code: Code, locks: bool, membrane: Membrane, u: np.ndarray) -> Code:
    """Why a trace that ended at u = (λa, p, q) did so; a step that shrank to nothing is named by the place."""
    if code is Code.lock_up and not locks:
        return Code.window_stretch
    if code not in (Code.step_too_small, Code.not_converged):
        return code
    if u[0] - float(membrane.prestretch) < 1e-3 * (membrane.lock_up_stretch()[0] - float(membrane.prestretch)):
        return Code.window_stretch  # the flat end, where p falls like a power of λa − λ0
    return Code.apex_cone if u[2] > 0.5 * float(largest_load(membrane.material, u[0])) else Code.beyond_tolerance


def _long_enough(membrane, vertices) -> bool:
    shadow = _on_chart(membrane, vertices)
    return len(vertices) > 2 and bool(np.linalg.norm(np.diff(shadow, axis=0), axis=1).sum() > 0.02)


def _dense(line, tangents) -> np.ndarray:
    """A traced line (n, 3) with five points of its Hermite curve on every interval."""
    x, gap = scaled(line), np.linalg.norm(np.diff(scaled(line), axis=0), axis=1)[:, None]
    parts = [hermite(x[:-1], x[1:], tangents[:-1], tangents[1:], gap, s) for s in np.linspace(0, 1, 6)[:-1]]
    return np.concatenate([np.stack(parts, axis=1).reshape(-1, 3), x[-1:]]) * SCALE


def _seed(membrane, vertices):
    """A vertex from which both directions cost a trace about the same, and the direction of the contour there.

    That is the middle, or where a contour with one end near lock-up comes to the region of the costly grids.
    """
    x = scaled(vertices)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1))])
    middle = np.searchsorted(arc, arc[-1] / 2)
    dear = (vertices[:, 0] > locking_stretch(membrane)) & (_on_chart(membrane, vertices)[:, 1] > 10 * COSTLY_LOAD)
    if dear[0] != dear[-1]:
        middle = np.argmin(dear) if dear[0] else np.argmax(dear)
    i = int(np.clip(middle, 1, len(x) - 2))
    heading = (x[i + 1] - x[i - 1]) * SCALE
    return vertices[i], heading


def _join(ahead, behind):
    """One polyline from the two directions of a seed; a closed lane alone is the whole loop."""
    if ahead[2] is Code.closed:
        return ahead[0], ahead[1], (Code.closed, Code.closed)
    if min(len(ahead[0]), len(behind[0])) < 1 or len(ahead[0]) + len(behind[0]) < 4:
        return None
    line = np.concatenate([behind[0][:0:-1], ahead[0]])
    tangents = np.concatenate([-behind[1][:0:-1], ahead[1]])
    return line, tangents, (behind[2], ahead[2])


def _uncovered(membrane, vertices, shadows, top, margin=SCAN_MARGIN):
    """The longest run of a contour's vertices that no traced line comes near, or None."""
    here = _on_chart(membrane, vertices)
    away = np.full(len(vertices), np.inf)
    for shadow in shadows:
        away = np.minimum(
            away, np.repeat(_distance_to_polyline(here[::CONTOUR_STRIDE], shadow), CONTOUR_STRIDE)[: len(here)]
        )
    far = (away > NEAR_ON_SCAN) & (here[:, 1] < 10 * (top - margin))
    if not far.any():
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[0], far.view(np.int8), [0]])))
    begin, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda e: e[1] - e[0])
    part = vertices[begin:end]
    return part if _long_enough(membrane, part) else None


def _distinct(membrane, curves: list[Curve]) -> list[Curve]:
    """The curves without those that run along a longer one: two seeds may have led to the same branch."""
    shadows = [_on_chart(membrane, _dense(c.points.u.T, c.points.tangent)) for c in curves]
    lengths = [np.linalg.norm(np.diff(shadow, axis=0), axis=1).sum() for shadow in shadows]
    kept: list[int] = []
    for i in np.argsort(lengths)[::-1]:
        sample = _on_chart(membrane, curves[i].points.u.T)[5:-5:10]
        if not any((_distance_to_polyline(sample, shadows[j]) < 0.005).mean() > 0.5 for j in kept):
            kept.append(int(i))
    return [curves[i] for i in kept]


def _confirmed(membrane, condition: LoadingCondition, vertices: np.ndarray) -> np.ndarray:
    """Those vertices of a contour that lie near a state of the explicit map itself, moved onto it along the load.

    Near lock-up at a high load the chart has a cliff that the scan's interpolation may miss by much.
    """
    vertices = vertices[:: max(1, len(vertices) // 40)]
    apex, limit = vertices[:, 0], largest_load(membrane.material, vertices[:, 0])
    rim = float(membrane.prestretch)

    def value(load):
        pressure, volume, _ = map_nodes(membrane.material, apex, load, rim, float(MOST_STEPS))
        return pressure, condition.residual(pressure, volume, load * limit)

    first = vertices[:, 2] / limit
    old, new = first - 1e-4, first
    f_old = value(old)[1]
    pressure = vertices[:, 1]
    for _ in range(8):
        pressure, f_new = value(new)
        with np.errstate(all="ignore"):
            move = -f_new * (new - old) / (f_new - f_old)
        move = np.clip(np.nan_to_num(move), -0.01, 0.01)
        old, f_old, new = new, f_new, np.minimum(new + move, 0.98)
        if np.abs(move).max() < 1e-9:
            break
    good = np.isfinite(pressure) & (np.abs(new - old) < 1e-6) & (np.abs(new - first) < 0.05)
    return np.stack([apex, pressure, new * limit], axis=1)[good]


def _ended(membrane, curve: Curve) -> bool:
    """Whether both ends of a curve lie at an edge of the window or beyond the scanned loads, and not where its trace gave up."""
    fraction = load_fraction(membrane, curve.points.u[:, [0, -1]])
    ends = zip((curve.start, curve.end), fraction, strict=True)
    return all(code not in _GAVE_UP or t > SCANNED_LOAD - SCAN_MARGIN for code, t in ends)


def _agrees(membrane, curve: Curve, contours, chart: Scan) -> bool:
    """Whether every point of the curve inside the scanned window lies on a contour of the scan."""
    u = curve.points.u.T
    here = _on_chart(membrane, u)
    load = here[:, 1] / 10
    inside = (load < chart.load_fraction[-1] - 0.02) & (load > chart.load_fraction[0] + 0.02)
    inside &= (u[:, 0] > chart.apex_stretch[2]) & (u[:, 0] < chart.apex_stretch[-3])
    if not inside.any():
        return True
    away = np.full(int(inside.sum()), np.inf)
    for vertices in contours:
        few = vertices[::CONTOUR_STRIDE] if len(vertices) > CONTOUR_STRIDE else vertices
        away = np.minimum(away, _distance_to_polyline(here[inside], _on_chart(membrane, few)))
    return bool((away < NEAR_ON_SCAN).all())


def special_record(located: Located, tolerance: float) -> SpecialPoint:
    """The record of a located point."""
    state = states_of(located.point, tolerance)[0]
    kind = PointKind.fold if located.kind in FOLDS else located.kind
    values = {f: getattr(state, f) for f in State.__dataclass_fields__}
    values["index"] = None if kind == PointKind.fold else state.index
    values["error_estimate"] = located.error
    if kind == PointKind.zero_voltage:
        values |= {"voltage_squared": 0.0, "charge": 0.0, "breakdown_ratio": 0.0}
    values["flags"] = tuple(f for f in state.flags if f != "error_above_tolerance")
    values["flags"] += ("error_above_tolerance",) if not located.error <= tolerance else ()
    return SpecialPoint(**values, kind=kind, branch=located.branch, position=located.position, number=located.number)


@dataclasses.dataclass
class Solved:
    """What ramps need of a scene: the engine, exact branches, located points."""

    solver: Shooting | OnSurface
    curves: list[Curve]
    located: list[Located]
    missed: list[tuple]
    tolerance: float
    certify: bool = True
    numbers: tuple[int, ...] = ()  # the circumferential numbers of modes that are looked at
    undecided: Sequence[Located] = ()  # points of the mesh at which a mode's sign is not known

    @property
    def control(self) -> int:
        """The column of the control, see `Points.control`."""
        return self.solver.condition.control

    @property
    def fold_kind(self) -> str:
        """The event at which the control turns."""
        return next(kind for kind, column in FOLDS.items() if column == self.control)

    def control_at(self, located: Located) -> float:
        """The control, squared, of a located state: q, or Q² where the charge is controlled."""
        return float(located.point.control(self.control)[0])

    def place(self, located: Located) -> float:
        """By what states at one control are distinguished: the volume, or the apex stretch where the volume is held."""
        return float(located.point.place(self.solver.condition)[0])

    def states_at(self, squared: float) -> list[Located]:
        """All states at one value of the control, q or Q², on all branches."""
        kind = PointKind.charge if self.control == 3 else PointKind.load
        wanted = [
            (kind, b, int(i), squared) for b, curve in enumerate(self.curves) for i in brackets(curve, kind, squared)
        ]
        found, missed = locate(self.solver, self.curves, wanted, self.tolerance, certify=self.certify)
        beside = (self.solver, self.curves, self.located, kind, squared, self.tolerance)
        more, lost = loads_beside_folds(*beside, certify=self.certify)
        self.missed.extend(missed + lost)
        return found + more

    def start_beside_fold(self, volume: float) -> Located | None:
        """The start of a chamber of this volume at zero voltage where it is nearer to a fold than the fold's own error.

        Its index tells on which side it lies.
        """
        near = [p for p in self.located if p.kind == self.fold_kind and abs(float(p.point.u[2, 0])) < 1e-9]
        fold = min(near, key=lambda p: abs(p.point.volume[0] - volume), default=None)
        if fold is None:
            return None
        engine = self.solver.shooting if isinstance(self.solver, OnSurface) else self.solver
        row = np.full((1, 3), np.nan)
        point = engine.corrected_points(fold.point.u, row, np.array([volume]), tolerance=self.tolerance, reach=0.1)
        if not (point.ok[0] and abs(point.u[2, 0]) < 1e-9):
            return None
        curve = self.curves[fold.branch]
        i = int(np.clip(np.searchsorted(curve.position, fold.position), 1, len(curve.position) - 1))
        side = 1.0 if curve.points.index[i - 1] == 0 else -1.0  # along which the stable states come to the fold
        point.tangent[0, 2] = side * abs(point.tangent[0, 2])
        position = fold.position - 1e-6 * side
        return Located(PointKind.zero_voltage, fold.branch, position, point, float(point.error[0]))

    def state(self, located: Located) -> State:
        """The record of a located state."""
        return special_record(located, self.tolerance)
