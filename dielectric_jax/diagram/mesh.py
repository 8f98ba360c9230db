"""A traced branch as exact points: a mesh along it, Newton at each of its points, refinement where it turns, and how it ends."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..model import SCALE, SCANNED_LOAD, Points, largest_load, load_fraction, locking_stretch
from ..numerics import Code
from .resolution import ASTRAY, CONE_WEIGHT, LOST_LOAD, MOST_APPROACH, MOST_TURN, THIN_LAYER_LOAD, WIDEST_HOLE

__all__ = ["Curve", "between", "clip_to_window", "exact_curve", "hermite", "scaled", "solve_between"]


@dataclasses.dataclass
class Curve:
    """A branch as exact points in order, with arclength `position` in scaled unknowns, and why it starts and ends."""

    points: Points
    position: np.ndarray
    start: Code
    end: Code
    flags: tuple[str, ...] = ()


def scaled(u: np.ndarray) -> np.ndarray:
    """Points (…, 3) in the units of the arclength."""
    return u / SCALE


def hermite(x0, x1, t0, t1, length, share):
    """Cubic Hermite interpolant at `share` in (0, 1) of intervals of `length`; arrays broadcast."""
    s, c = share, 1 - share
    return c * c * (1 + 2 * s) * x0 + s * c * c * length * t0 + s * s * (3 - 2 * s) * x1 - s * s * c * length * t1


def _cone_measure(membrane, line) -> np.ndarray:
    """−log(1 − t): it counts the folds that accumulate towards the cone at the apex."""
    fraction = line[:, 2] * SCALE[2] / largest_load(membrane.material, line[:, 0])
    return -CONE_WEIGHT * np.log(np.maximum(1 - fraction, 1e-6))


def _resample(membrane, line, tangents, count):
    """`count` mesh points on the traced points: predictions (count, 3) and plane normals, scaled.

    They are equally spaced in what a reader sees, closer where the apex sharpens to a cone.
    """
    gap = np.linalg.norm(np.diff(line, axis=0), axis=1)
    # fewer mesh points where the pressure shoots up at lock-up and where q < 0, which no voltage reaches
    q = line[:, 2]
    seen = np.stack(
        [
            line[:, 0],
            5 * np.arcsinh(line[:, 1] / 5),
            np.where(q > 0, 2, 0.5) * np.arcsinh(q),
            _cone_measure(membrane, line),
        ]
    )
    fraction = q * SCALE[2] / largest_load(membrane.material, line[:, 0])
    # and where an inner layer makes each of them dear
    dear = (line[1:, 0] > locking_stretch(membrane)) & (fraction[1:] > THIN_LAYER_LOAD)
    length = np.linalg.norm(np.diff(seen), axis=0) * np.where(dear, 0.5, 1.0)
    measure = np.concatenate([[0.0], np.cumsum(length)])
    s = np.linspace(0.0, measure[-1], count)
    i = np.clip(np.searchsorted(measure, s, side="right") - 1, 0, len(gap) - 1)
    share = ((s - measure[i]) / (measure[i + 1] - measure[i]))[:, None]
    at = hermite(line[i], line[i + 1], tangents[i], tangents[i + 1], gap[i][:, None], share)
    normal = (1 - share) * tangents[i] + share * tangents[i + 1]
    return at, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def clip_to_window(line, tangents, inside, end):
    """Moves the outermost point, which lies outside, back onto the boundary along the Hermite curve."""
    if inside(line[end] * SCALE) >= 0:
        return
    inner = -2 if end == -1 else 1
    low, high = 0.0, 1.0
    gap = np.linalg.norm(line[end] - line[inner])
    sign = 1.0 if end == -1 else -1.0
    for _ in range(50):
        middle = (low + high) / 2
        at = hermite(line[inner], line[end], sign * tangents[inner], sign * tangents[end], gap, middle)
        low, high = (middle, high) if inside(at * SCALE) >= 0 else (low, middle)
    line[end] = hermite(line[inner], line[end], sign * tangents[inner], sign * tangents[end], gap, low)
    tangents[end] = (1 - low) * tangents[inner] + low * tangents[end]
    tangents[end] /= np.linalg.norm(tangents[end])


def _mesh_points(solver, line, tangents, count, tolerance, chart) -> tuple[Points, np.ndarray, np.ndarray]:
    """Exact points on the mesh of a traced line (scaled), which of them are good, and the loads where they were looked for."""
    at, normal = _resample(solver.membrane, line, tangents, count)
    # at the flat end p falls like a power of λa − λ0, which no Hermite cubic follows: start on the scan
    flat = at[:, 0] - float(solver.membrane.prestretch) < 0.02
    if flat.any():
        load = at[flat, 2] * SCALE[2] / largest_load(solver.membrane.material, at[flat, 0])
        at[flat, 1] = chart.pressure_of(at[flat, 0], load) / SCALE[1]
    target = (normal * at).sum(axis=1)
    points = solver.corrected_points((at * SCALE).T, normal / SCALE, target, tolerance=tolerance, reach=0.5)
    points.tangent = points.tangent * np.where((points.tangent * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    # one that went astray has left its place by more than its neighbours are apart
    apart = np.linalg.norm(np.diff(at, axis=0, prepend=2 * at[:1] - at[1:2]), axis=1)
    near = np.linalg.norm(scaled(points.u.T) - at, axis=1) <= np.maximum(ASTRAY, apart)
    # within the scanned loads rounding at the flat end may exceed the tolerance: such points stay, with a flag
    fair = (points.error <= tolerance) | (
        (load_fraction(solver.membrane, points.u) <= SCANNED_LOAD) & (points.error < 1e-6)
    )
    return points, points.ok & fair & near, load_fraction(solver.membrane, (at * SCALE).T)


def exact_curve(solver, line, tangents, codes, count, tolerance, chart, retrace: Callable) -> tuple[Curve | None, bool]:
    """The traced branch (scaled) as exact points, and whether it goes as far as it should.

    `retrace(u, direction)` follows the branch from an exact point on the finest grid: a scaled line, its tangents and the
    code of its end. It is used where mesh points are lost inside the scanned window.
    """
    points, good, sought = _mesh_points(solver, line, tangents, count, tolerance, chart)
    if good.sum() < 2:
        return None, False
    kept = np.flatnonzero(good)
    ends_lost = kept[0] > 0, kept[-1] < len(points) - 1
    points, gaps = points.take(kept), np.flatnonzero(np.diff(kept) > 1)
    # beyond the scanned loads a lost point is missed only where the refinement below wants it
    gaps = gaps[load_fraction(solver.membrane, points.u)[gaps] < SCANNED_LOAD]
    missing = ~good & (sought < SCANNED_LOAD)
    missing[: kept[0]] = missing[kept[-1] :] = False
    runs = np.split(missing, np.flatnonzero(np.diff(missing)) + 1)
    hole = any(run.all() and len(run) >= WIDEST_HOLE for run in runs)
    flags = []
    if hole:
        flags.append("points_lost")
    if len(gaps):  # lanes that Newton lost between good ones: once more, from better starts
        before = len(points)
        points = _insert(solver, points, gaps, tolerance)
        if len(points) < before + len(gaps) and not hole:
            flags.append("points_lost")
    codes, whole = list(codes), True
    for end, lost in enumerate(ends_lost):
        if not lost:
            continue
        points, code = _extend(solver, points, end, max(count // 4, 32), tolerance, chart, retrace)
        fraction = load_fraction(solver.membrane, points.take(np.array([-end])).u)[0]
        # beyond the scanned loads a branch is followed only as far as its error estimate allows
        codes[end] = code or (Code.apex_cone if fraction > 0.5 else Code.beyond_tolerance)
        whole &= code is not None or bool(fraction >= LOST_LOAD)
    if not whole:
        flags.append("end_lost")
    whole &= not hole
    if (points.error > tolerance).any():
        flags.append("error_above_tolerance")
    for _ in range(4):
        turn = (points.tangent[1:] * points.tangent[:-1]).sum(axis=1)
        approach = np.abs(np.diff(_cone_measure(solver.membrane, scaled(points.u.T)))) / CONE_WEIGHT
        wide = np.flatnonzero((turn < np.cos(MOST_TURN)) | (approach > MOST_APPROACH))
        if not len(wide) or len(points) > 4 * count:
            break
        before = len(points)
        points = _insert(solver, points, wide, tolerance)
        if len(points) == before:
            break
    place = points.place(solver.condition)
    if place[0] > place[-1]:  # a branch begins at its smaller volume
        points = _reversed(points)
        codes.reverse()
    gap = np.linalg.norm(np.diff(scaled(points.u.T), axis=0), axis=1)
    return Curve(points, np.concatenate([[0.0], np.cumsum(gap)]), codes[0], codes[1], tuple(flags)), whole


def _reversed(points: Points) -> Points:
    points = points.take(slice(None, None, -1))
    points.tangent = -points.tangent
    return points


def _extend(solver, points, end, count, tolerance, chart, retrace) -> tuple[Points, Code | None]:
    """Points with those that a trace on the finest grid finds beyond an end (0 or 1), and why it ended.

    No code where points were lost again. Only below the load to which the scan goes.
    """
    if end == 0:
        found, code = _extend(solver, _reversed(points), 1, count, tolerance, chart, retrace)
        return _reversed(found), code
    if not load_fraction(solver.membrane, points.take(np.array([-1])).u)[0] < LOST_LOAD:
        return points, None
    line, tangents, code = retrace(points.u[:, -1], points.tangent[-1] * SCALE)
    if len(line) < 3:
        return points, None
    more, good, _ = _mesh_points(solver, line, tangents, count, tolerance, chart)
    reached = int(np.argmin(np.append(good[1:], False)))  # good points in a row after the first, which is known
    more = more.take(np.arange(1, reached + 1))
    joined = Points.join([points, more]) if reached else points
    return joined, code if reached == len(good) - 1 else None


def between(points: Points, i: np.ndarray, share: np.ndarray):
    """Prediction (scaled), plane normal and target at `share` of the chords from points i to i + 1."""
    x = scaled(points.u.T)
    x0, x1 = x[i], x[i + 1]
    gap = np.linalg.norm(x1 - x0, axis=1, keepdims=True)
    normal = (x1 - x0) / gap
    at = hermite(x0, x1, points.tangent[i], points.tangent[i + 1], gap, share[:, None])
    return at, normal, (normal * x0).sum(axis=1) + share * gap[:, 0]


def solve_between(solver, points, i, share, **options) -> Points:
    """Exact points on the planes across the chords from points i to i + 1, oriented like the branch."""
    at, normal, target = between(points, i, share)
    found = solver.corrected_points((at * SCALE).T, normal / SCALE, target, reach=0.5, **options)
    found.tangent = found.tangent * np.where((found.tangent * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return found


def _insert(solver, points, wide, tolerance) -> Points:
    """Points with the middles of the intervals `wide` added where Newton finds them."""
    middle = solve_between(solver, points, wide, np.full(len(wide), 0.5), tolerance=tolerance)
    good = np.flatnonzero(middle.ok & (middle.error <= tolerance))
    place = np.concatenate([np.arange(len(points)), wide[good] + 0.5])
    joined = Points.join([points, middle.take(good)])
    return joined.take(np.argsort(place, kind="stable"))
