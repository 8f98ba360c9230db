"""Contours on the surface: states of a loading found by Newton on the surface's polynomials, nothing integrated or stepped.

`OnSurface` stands in for `Shooting`: it meets the same planes across a branch, in microseconds, and hands the lanes that
lie outside the surface's domain, or that it does not know to the tolerance, to shooting. `surface_lines` finds every
contour inside the domain.
"""

import dataclasses
import functools
from collections.abc import Callable

import contourpy
import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    CHUNK,
    GRIDS,
    LEAST_ESTIMATE,
    SCALE,
    SCANNED_LOAD,
    LoadingCondition,
    Membrane,
    PointKind,
    Points,
    Shooting,
    difficulty,
    field_ratio_squared,
    largest_load,
    load_fraction,
    locking_stretch,
    value_program,
)
from ..numerics import Code, cached_jit, root_find, run_lanes
from ..surface import ById, Surface, pressure_and_volume
from .resolution import (
    AT_EDGE,
    CONTOUR_GRID,
    CONTOUR_VERTICES,
    SAME_ON_SURFACE,
    SURFACE_CONVERGED,
    SURFACE_MOVE,
    SURFACE_NEWTON,
)

__all__ = ["OnSurface", "margins", "surface_branches"]

_ULP = 2.3e-16


@cached_jit
def _meet_program(surface: Surface, condition: LoadingCondition, lanes):
    """States on the contour and on planes: lanes (7, n) hold a start u, a row (NaN asks for a volume) and its target.

    Gives u, V, z, C, tangent (3), error at fixed λa, (E/E_EB)²/q at the apex, and the size of Newton's last move.
    """
    material = surface.membrane.material

    def one(lane):
        row, target = lane[3:6], lane[6]
        by_volume = ~jnp.all(jnp.isfinite(row))
        row = jnp.where(by_volume, 0.0, row)

        def state(x):
            p, v = surface.at_load_fraction(x[0], x[1], ("pressure", "volume"))
            return jnp.stack([x[0], p, x[1] * largest_load(material, x[0]), v])

        def equations(x, _):
            a, p, q, v = state(x)
            last = jnp.where(by_volume, v, row @ jnp.stack([a, p, q])) - target
            return jnp.stack([condition.residual(p, v, q), last])

        start = jnp.stack([lane[0], lane[2] / largest_load(material, lane[0])])
        root = root_find(equations, start, steps=SURFACE_NEWTON, tolerance=0.0, most_move=SURFACE_MOVE)
        x = root.value
        a, p, q, v = state(x)
        z, c = surface.at_load_fraction(x[0], x[1], ("height", "charge_per_voltage"))
        slopes = jax.jacfwd(state)(x)  # of (λa, p, q, V) by (λa, t)
        by_p, by_v, by_q = condition.slopes(v)
        of_stretch, of_load = by_p * slopes[1] + by_v * slopes[3] + by_q * slopes[2]
        tangent = slopes[:3] @ jnp.stack([-of_load, of_stretch]) / SCALE
        tangent = tangent / jnp.linalg.norm(tangent)
        # what the surface's error, and rounding of λa at the flat end, do to the condition is made up for by the load
        rim = surface.membrane.prestretch
        bound = surface.error_bound(a, q) + _ULP * a / (a - rim)
        size_p, size_v, size_q = (jnp.maximum(jnp.abs(w), 1e-3) for w in (p, v, q))
        shift = bound * (jnp.abs(by_p) * size_p + jnp.abs(by_v) * size_v) / jnp.abs(of_load)
        moved = jnp.abs(slopes[1:, 1]) * shift / jnp.stack([size_p, size_q, size_v])
        error = jnp.max(moved + bound * jnp.array([1.0, 0.0, 1.0]))
        field = field_ratio_squared(surface.membrane.breakdown, a, a)
        return jnp.concatenate([jnp.stack([a, p, q, v, z, c]), tangent, jnp.stack([error, field, root.move])])

    return jax.vmap(one, in_axes=1, out_axes=1)(lanes)


@dataclasses.dataclass(frozen=True)
class OnSurface:
    """The engine that finds states on a surface: the same `corrected_points` as `Shooting`, to which it leaves what it cannot do.

    `alone` it leaves nothing to shooting: such lanes have ok = False.

    Its points know neither the least hoop tension nor the index, NaN and −1, until `complete`.
    """

    surface: Surface
    condition: LoadingCondition
    alone: bool = False

    @property
    def membrane(self) -> Membrane:
        """The membrane of the surface."""
        return self.surface.membrane

    @property
    def shot_kinds(self) -> tuple[str, ...]:
        """The special points that need profiles along the membrane."""
        return _shot_kinds(ById(self.surface))

    @property
    def shooting(self) -> Shooting:
        """The engine for what the surface does not hold."""
        return Shooting(self.membrane, self.condition)

    def correct(self, u, rows, targets, *, tolerance=1e-9, reach=1.0) -> Points:
        """`corrected_points` by the surface alone: lanes it does not hold to the tolerance have ok = False."""
        u, rows, targets = np.asarray(u, float), np.asarray(rows, float), np.asarray(targets, float)
        packed = np.concatenate([u, rows.T, targets[None]])
        found = run_lanes(lambda part: _meet_program(self.surface, self.condition, part), packed, sizes=CHUNK)
        error = np.maximum(np.nan_to_num(found[9], nan=np.inf), LEAST_ESTIMATE)
        away = np.linalg.norm((found[:3] - u).T / SCALE, axis=1)
        with np.errstate(invalid="ignore"):
            ok = (
                np.isfinite(found[:10]).all(axis=0)
                & (found[11] < SURFACE_CONVERGED)
                & (error <= tolerance)
                & (away < reach)
            )
        unknown = np.full(u.shape[1], np.nan)
        index = np.full(u.shape[1], -1)
        return Points(
            *(found[:3], found[3], found[4], found[5], np.full_like(u, np.nan)),
            *(unknown, found[10], found[6:9].T.copy(), index, error, ok),
        )

    def corrected_points(self, u, rows, targets, *, tolerance=1e-9, reach=1.0, refine=False) -> Points:
        """States near `u` on the loading's contour with rows·u = targets; see `model.corrected_points`."""
        u, rows, targets = np.asarray(u, float), np.asarray(rows, float), np.asarray(targets, float)
        found = self.correct(u, rows, targets, tolerance=tolerance, reach=reach)
        lost = np.flatnonzero(~found.ok)
        if self.alone or not len(lost):
            return found
        options = {"tolerance": tolerance, "reach": reach, "refine": np.broadcast_to(refine, u.shape[1:])[lost]}
        shot = self.shooting.corrected_points(u[:, lost], rows[lost], targets[lost], **options)
        kept = np.flatnonzero(found.ok)
        return Points.join([found.take(kept), shot]).take(np.argsort(np.concatenate([kept, lost])))

    def complete(self, points: Points) -> Points:
        """The points of a branch, in order, with hoop tension, field and index of those the surface gave, by shots.

        The index changes at the folds of the control only: one shot between two folds tells it; where none does, it
        stays −1.
        """
        todo = np.flatnonzero(points.index < 0)
        if not len(todo):
            return points
        points = dataclasses.replace(
            points, hoop=points.hoop.copy(), field=points.field.copy(), index=points.index.copy()
        )
        level = difficulty(locking_stretch(self.membrane), points.u[0], load_fraction(self.membrane, points.u))
        for k, (_, grids) in enumerate(GRIDS):
            which = todo[level[todo] == k]
            if len(which):
                values = run_lanes(
                    lambda part, n=grids[0]: value_program(self.membrane, part, n), points.u[:, which], sizes=CHUNK
                )
                points.hoop[which], points.field[which] = values[4:6]
        control = points.tangent[:, self.condition.control]
        rising = control > 0
        run = np.concatenate([[0], np.cumsum(rising[1:] != rising[:-1])])
        runs = [todo[run[todo] == k] for k in np.unique(run[todo])]
        # where the control changes fastest the index is clearest
        shot = self._shoot(points, np.array([which[np.argmax(np.abs(control[which]))] for which in runs]))
        for which, index, ok in zip(runs, shot.index, shot.ok, strict=True):
            if not ok:
                every = self._shoot(points, which)
                index = every.index[np.argmax(every.ok)] if every.ok.any() else -1
            points.index[which] = index
        return points

    def _shoot(self, points: Points, which: np.ndarray) -> Points:
        """The points `which` by shooting, on planes across the branch."""
        rows = points.tangent[which] / SCALE
        return self.shooting.corrected_points(points.u[:, which], rows, np.einsum("ij,ji->i", rows, points.u[:, which]))


@functools.lru_cache(maxsize=16)
def _shot_kinds(key: ById) -> tuple[str, ...]:
    """Hoop tension loss; breakdown too where a law makes another place than the apex break first."""
    surface = key.value
    stretch = np.linspace(1.0, float(surface.apex_edges[-1]), 400)
    ratio = np.asarray(field_ratio_squared(surface.membrane.breakdown, stretch, stretch))
    return (
        (PointKind.hoop_tension_loss,)
        if (np.diff(ratio) > 0).all()
        else (PointKind.hoop_tension_loss, PointKind.breakdown)
    )


@functools.lru_cache(maxsize=16)
def _grid_of(key: ById):
    """λa (rows,), t (loads,), p and V (rows, loads) of a surface, NaN outside its domain."""
    surface = key.value
    rim, high = float(surface.membrane.prestretch), float(surface.apex_edges[-1])
    apex = rim + (high - rim) * np.linspace(1e-3, 1.0, CONTOUR_GRID[0]) ** 2
    apex[-1] = high
    load = np.linspace(float(surface.load_edges[0]), min(float(surface.load_edges[-1]), SCANNED_LOAD), CONTOUR_GRID[1])
    p, v = pressure_and_volume(surface, apex[:, None], load[None])
    return apex, load, p, v, largest_load(surface.membrane.material, apex)


def _longest_run(good: np.ndarray) -> np.ndarray:
    """Indices of the longest run of True."""
    runs = np.split(np.arange(len(good)), np.flatnonzero(np.diff(good)) + 1)
    return max((run for run in runs if good[run[0]]), key=len, default=np.zeros(0, int))


def surface_lines(solver: OnSurface) -> list[tuple[np.ndarray, np.ndarray]]:
    """Every contour inside the surface's domain: exact points u (n, 3) in order, and unit tangents in scaled unknowns."""
    apex, load, p, v, limit = _grid_of(ById(solver.surface))
    value = np.ma.masked_invalid(solver.condition.residual(p, v, load * limit[:, None]))
    rows, columns = np.arange(len(apex)), np.arange(len(load))
    found = []
    for line in contourpy.contour_generator(columns, rows, value, name="serial").lines(0.0):
        assert isinstance(line, np.ndarray)
        closed = np.allclose(line[0], line[-1])
        gap = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        places = np.linspace(0.0, gap[-1], min(CONTOUR_VERTICES, max(4, len(line))))
        j, i = (np.interp(places, gap, line[:, k]) for k in (0, 1))
        a, t = np.interp(i, rows, apex), np.interp(j, columns, load)
        q = t * largest_load(solver.membrane.material, a)
        u = np.stack([a, pressure_and_volume(solver.surface, a, t)[0], q])
        way = np.gradient(u / SCALE[:, None], axis=1)
        normal = (way / np.linalg.norm(way, axis=0)).T
        rows_ = normal / SCALE
        points = solver.correct(u, rows_, np.einsum("ij,ji->i", rows_, u), tolerance=1e-6, reach=2.0)
        good = _longest_run(points.ok)
        if len(good) < 3:
            continue
        closed = closed and bool(points.ok.all())
        tangents = points.tangent * np.where((points.tangent * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        x, tangents = points.u.T[good], tangents[good]
        if closed:
            x, tangents = np.concatenate([x, x[:1]]), np.concatenate([tangents, tangents[:1]])
        found.append((x, tangents))
    return found


def surface_branches(solver: OnSurface, box: np.ndarray, follow: Callable | None) -> list[tuple]:
    """Branches that run through the surface's domain: points u (n, 3), unit tangents in scaled unknowns, codes of the ends.

    `box` is (λa, λa, t, t), the window. `follow(u, direction)` continues a branch by shooting from where it leaves the
    domain: points, tangents and why they end; where they come to the end of another contour the two are one branch.
    Without it branches end there.
    """
    pieces = [piece for line in surface_lines(solver) for piece in _windowed(solver, line, box)]
    links: dict[tuple, tuple] = {}
    tails: dict[tuple, tuple] = {}
    ends = [(k, side) for k in range(len(pieces)) for side in (0, -1)]
    open_ends = [end for end in ends if margins(solver.membrane, pieces[end[0]][0][end[1]], box).min() >= 0]
    for end in open_ends:
        if end in links:
            continue
        k, side = end
        u, tangents = pieces[k]
        if follow is None:
            near = margins(solver.membrane, u[side], box).min() < AT_EDGE
            tails[end] = u[:0], tangents[:0], _edge(solver, u[side], box) if near else Code.surface_edge
            continue
        outward = tangents[side] * (1.0 if side else -1.0)
        path, along, code = follow(u[side], outward * SCALE)
        others = [other for other in open_ends if other != end and other not in links]
        meetings = [(i, other) for other in others if (i := _meets(path, along, pieces, other)) is not None]
        if meetings:
            i, other = min(meetings)
            links[end] = other, path[1 : i + 1], along[1 : i + 1]
            links[other] = end, path[i:0:-1], -along[i:0:-1]
            tails.pop(other, None)
        else:
            tails[end] = path[1:], along[1:], code
    branches = []
    used: set[int] = set()
    for end in [e for e in ends if e not in links] + ends:  # those in a loop have only linked ends
        if end[0] in used:
            continue
        looped = end in links
        code = (
            Code.closed if looped else tails[end][2] if end in tails else _edge(solver, pieces[end[0]][0][end[1]], box)
        )
        parts = []
        if end in tails:
            path, along, _ = tails[end]
            parts.append((path[::-1], -along[::-1]))
        while True:
            k, side = end
            used.add(k)
            u, tangents = pieces[k]
            parts.append((u, tangents) if side == 0 else (u[::-1], -tangents[::-1]))
            last = (k, -1 - side)
            if last not in links:
                if last in tails:
                    parts.append(tails[last][:2])
                final = tails[last][2] if last in tails else _edge(solver, pieces[k][0][last[1]], box)
                break
            end, path, along = links[last]
            parts.append((path, along))
            if end[0] in used:
                first = parts[0]
                parts.append((first[0][:1], first[1][:1]))
                final = Code.closed
                break
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        branches.append((*joined, (code, final)))
    return branches


def margins(membrane: Membrane, u: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far inside the edges of the window (λa, λa, t, t) a point is; negative outside."""
    fraction = u[2] / float(largest_load(membrane.material, u[0]))
    return np.array([u[0] - box[0], box[1] - u[0], fraction - box[2], box[3] - fraction])


def _edge(solver: OnSurface, u: np.ndarray, box: np.ndarray) -> Code:
    """The edge of the window at which a branch ends."""
    codes = (Code.window_stretch, Code.lock_up, Code.window_load, Code.window_load)
    return codes[int(np.argmin(margins(solver.membrane, u, box)))]


def _windowed(solver: OnSurface, line: tuple, box: np.ndarray) -> list[tuple]:
    """The runs of a line inside the window, each with the first point outside at either end."""
    u, tangents = line
    fraction = u[:, 2] / largest_load(solver.membrane.material, u[:, 0])
    inside = (u[:, 0] >= box[0]) & (u[:, 0] <= box[1]) & (fraction >= box[2]) & (fraction <= box[3])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.view(np.int8), [0]])))
    runs = [slice(max(a - 1, 0), b + 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(u[run], tangents[run]) for run in runs if len(u[run]) > 2]


def _meets(path: np.ndarray, along: np.ndarray, pieces: list, end: tuple) -> int | None:
    """After which point of a traced path the end of a piece lies on it, running the same way; None where it does not."""
    (u, tangents), side = pieces[end[0]], end[1]
    inward = tangents[side] * (-1.0 if side else 1.0)
    if len(path) < 2:
        return None
    x, target = path / SCALE, u[side] / SCALE
    chord = np.diff(x, axis=0)
    share = ((target - x[:-1]) * chord).sum(axis=1) / np.maximum((chord**2).sum(axis=1), 1e-300)
    away = np.linalg.norm(target - x[:-1] - np.clip(share, 0, 1)[:, None] * chord, axis=1)
    hit = np.flatnonzero((away < SAME_ON_SURFACE) & (along[:-1] @ inward > 0.8) & (share > 0) & (share <= 1))
    return int(hit[0]) if len(hit) else None
