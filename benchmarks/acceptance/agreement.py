"""Do diagrams hold every branch, fold, zero-voltage state and breakdown that a finer scan of the chart shows, and no other?

Random scenes; each diagram against contours of the loading's condition on a spline through the explicit map on more than
four times the package's own nodes, in other variables. The comparison covers the window up to t = 0.9.

    python -m benchmarks.acceptance.agreement [--scenes 1000] [--seed 0] [--first 0] [--json FILE|-] [--quick]
"""

import copy
import math
import sys
import traceback

import contourpy
import jax
import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline, make_interp_spline
from scipy.spatial import cKDTree

import dielectric_jax as dj
from benchmarks import explicit, harness
from benchmarks.random_scenes import film_scenes
from benchmarks.truth import extended_precision as truth

jax.config.update("jax_enable_x64", True)

SCALE = np.array([1.0, 0.2, 0.02])  # distances are measured in these units of (λa, p, q)
NODES = (280, 96)  # of the chart, along the stretch and the load
FINE = (1400, 500)  # of the contoured grid
TOP, BOTTOM = 0.9, -1.0
EDGE = 0.01  # in t, and as a share of the stretch: what lies this close to the window's edge is only noted
NOISE = 2e-6  # an extremum of q less prominent than this, relative to max(|q|, 1e-3), is near-degenerate
SPLINE = 1e-6  # where splines and explicit map differ more than this, a contour is mended by the map
NEAR = 0.03  # distance at which a branch counts as the same
POSITION = 2e-5  # allowed difference of a special point's q, relative to max(|q|, 1e-3)


def mapped(limit, apex, q, rim, steps, size=640):
    """p, V and the slope at the rim of the explicit map at states (n,) of one film."""
    return explicit.in_chunks(lambda a, b: explicit.of_gent(limit, a, b, rim, steps), (apex, q), size)


def _crowded(first=1e-6):
    """share(x) of the stretch span: geometric from `first`, even, denser again towards lock-up."""
    share = np.concatenate([np.geomspace(first, 1e-2, 300)[:-1], np.linspace(1e-2, 1, 600)])
    density = np.log(share) + 16 * share - 3 * np.log(1.04 - share)
    x = (density - density[0]) / (density[-1] - density[0])
    return make_interp_spline(x, np.log(share), k=5)


_SHARE = _crowded()


class Chart:
    """Splines of log p/(1 − t) and log V in (x, y), where λa(x) crowds at both ends and t(y) towards t = 0.9."""

    def __init__(self, limit: float, rim: float):
        self.limit, self.rim, self.end = limit, rim, truth.lock_up(limit)
        x, y = np.linspace(0, 1, NODES[0]), np.linspace(0, 1, NODES[1])
        apex, t = (v.ravel() for v in np.meshgrid(self.apex(x), self.load(y), indexing="ij"))
        q = t * truth.largest_load(apex, limit)
        p, v, slope = mapped(limit, apex, q, rim, 48.0)
        hard = (t > 0.4) & (apex - rim > 0.4 * (self.end - rim))
        p[hard], v[hard], slope[hard] = mapped(limit, apex[hard], q[hard], rim, 160.0)
        good = (slope < 0) & np.isfinite(p) & np.isfinite(v) & (p > 0) & (v > 0)
        self.invalid_nodes = int((~good).sum())
        with np.errstate(all="ignore"):
            fields = [np.log(p / (1 - t)), np.log(v)]
        self.log_p, self.log_v = (
            RectBivariateSpline(x, y, np.where(good, f, 0.0).reshape(NODES), kx=5, ky=5) for f in fields
        )

    def apex(self, x):
        """λa(x)."""
        return self.rim + (self.end - self.rim) * np.exp(_SHARE(np.clip(x, 0, 1)))

    def load(self, y):
        """The load fraction, from −1 at y = 0 to 0.9 at y = 1, crowding towards 0.9."""
        return 1.15 - (1.15 - BOTTOM) * ((1.15 - TOP) / (1.15 - BOTTOM)) ** np.asarray(y)

    def state(self, x, y):
        """λa, p, V, q, t at points of one shape."""
        apex, t = self.apex(x), self.load(y)
        p = np.exp(self.log_p.ev(x, y)) * (1 - t)
        return apex, p, np.exp(self.log_v.ev(x, y)), t * truth.largest_load(apex, self.limit), t

    def mapped(self, x, y):
        """The same as `state`, by the explicit map itself instead of the splines."""
        apex, t = self.apex(x), self.load(y)
        q = t * truth.largest_load(apex, self.limit)
        p, v, _ = mapped(self.limit, apex, q, self.rim, 300.0, size=160)
        return apex, p, v, q, t

    def unloaded(self):
        """λa, p, V along zero voltage."""
        x = np.linspace(0, 1, 8000)
        y = np.log(1.15 / (1.15 - BOTTOM)) / np.log((1.15 - TOP) / (1.15 - BOTTOM))
        return self.state(x, np.full_like(x, y))[:3]

    def lines(self, condition):
        """Contours of condition(p, V) = 0: arrays (n, 2) of (x, y) on the spline."""
        x, y = np.linspace(0, 1, FINE[0]), np.linspace(0, 1, FINE[1])
        t = self.load(y)
        value = condition(np.exp(self.log_p(x, y)) * (1 - t), np.exp(self.log_v(x, y)))
        found = contourpy.contour_generator(y, x, value, name="serial").lines(0.0)
        return [self.onto(line[:, ::-1], condition) for line in found if len(line) > 2]

    def onto(self, points, condition, state=None):
        """Points (n, 2) moved onto the contour along the gradient."""
        points = np.array(points)
        state, h = state or self.state, 1e-6

        def value(x, y):
            return condition(*state(x, y)[1:3])

        for _ in range(4):
            x, y = points.T
            g = value(x, y)
            slope = np.stack([value(x + h, y) - g, value(x, y + h) - g], axis=1) / h
            with np.errstate(all="ignore"):
                move = -(g / (slope**2).sum(axis=1))[:, None] * slope
            move = np.where(np.isfinite(move) & (np.abs(move) < 0.01), move, 0.0)
            points = np.clip(points + move, 0, 1 - h)
        return points


def resolve(scene: dict, chart: Chart):
    """The loading of a scene and its condition(p, V); V_0 is a share of the volume at the peak of p at zero voltage.

    Where p has no peak, of the volume at which it rises most slowly.
    """
    if "pressure" in scene:
        return dj.ConstantPressure(scene["pressure"]), lambda p, v: p - scene["pressure"]
    _, p, v = chart.unloaded()
    rising = np.diff(p) > 0
    peak = int(np.argmin(rising)) if not rising.all() else int(np.argmin(np.diff(p) / np.diff(v)))
    scene["peak"] = bool(not rising.all())
    scene["initial_volume"] = v0 = scene["fill"] * float(v[peak])
    near = np.clip(np.searchsorted(v, v0), 3, len(v) - 4)
    p0 = float(make_interp_spline(np.log(v[near - 3 : near + 4]), p[near - 3 : near + 4], k=5)(math.log(v0)))
    total = p0 + 50.0
    chamber = scene["chamber_volume"]
    return dj.Chamber(
        volume=chamber, initial_volume=v0, atmospheric_pressure=50.0
    ), lambda p, v: p - p0 - total * (v0 - v) / (v + chamber)


def scaled(*columns):
    """Points (n, 3) of (λa, p, q) in the units of distances."""
    return np.stack(columns, axis=-1) / SCALE


def distances(points, line):
    """Distance of each of (n, 3) points to a polyline (m, 3)."""
    best = np.full(len(points), np.inf)
    near = cKDTree(line).query(points)[1]
    for shift in (-1, 0):
        i = np.clip(near + shift, 0, len(line) - 2)
        a, d = line[i], line[i + 1] - line[i]
        along = np.clip(((points - a) * d).sum(axis=1) / np.maximum((d * d).sum(axis=1), 1e-300), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - along[:, None] * d, axis=1))
    return best


def turning_points(q, least):
    """Indices of the interior extrema of a sequence whose swings on both sides exceed `least` (an array)."""
    found, high, low, way = [], 0, 0, 0
    for i in range(1, len(q)):
        if way >= 0 and q[i] > q[high]:
            high = i
        if way <= 0 and q[i] < q[low]:
            low = i
        if way >= 0 and q[high] - q[i] > least[i]:
            if way > 0 or high > 0:
                found.append(high)
            way, low = -1, i
        elif way <= 0 and q[i] - q[low] > least[i]:
            if way < 0 or low > 0:
                found.append(low)
            way, high = 1, i
    return found


class Line:
    """One contour of the scan: its states, and what is special on it."""

    def __init__(self, chart: Chart, points, condition, breakdown):
        self.closed = bool(np.allclose(points[0], points[-1], atol=1e-9))
        q = chart.state(*points.T)[3]
        if self.closed:
            points = points[:-1]
            points = np.roll(points, -int(np.argmin(q[:-1])) + len(points) // 7, axis=0)
            points = np.concatenate([points, points[: len(points) // 5]])  # overlaps, so that no extremum is at an end
        self.chart, self.points, self.condition, self.breakdown = chart, points, condition, breakdown
        self.apex, self.p, self.v, self.q, self.t = chart.state(*points.T)
        self.unresolved = self._resolve()
        self.x = scaled(self.apex, self.p, self.q)
        self.length = float(np.linalg.norm(np.diff(self.x, axis=0), axis=1).sum())

    def _resolve(self):
        """Mends vertices where the splines err (the chart has a cliff towards lock-up above t = 0.6); those mended."""
        steep = np.flatnonzero((self.t > 0.4) & (self.apex - self.chart.rim > 0.4 * (self.chart.end - self.chart.rim)))
        mended = np.zeros(len(self.t), bool)
        if not len(steep):
            return mended
        p, v = self.chart.mapped(*self.points[steep].T)[1:3]
        with np.errstate(all="ignore"):
            wrong = ~(np.maximum(np.abs(p / self.p[steep] - 1), np.abs(v / self.v[steep] - 1)) < SPLINE)
        which = steep[wrong]
        if len(which):
            mended[which] = True
            self.points[which] = self.chart.onto(self.points[which], self.condition, self.chart.mapped)
            columns = self.chart.mapped(*self.points[which].T)
            size = np.abs(self.condition(*columns[1:3])) / columns[1]
            for own, values in zip((self.apex, self.p, self.v, self.q, self.t), columns, strict=True):
                own[which] = np.where(size < 1e-4, values, np.nan)  # not a contour at all
        return mended

    def _between(self, i, j):
        share = np.linspace(0, 1, 41)[:, None]
        state = self.chart.mapped if self.unresolved[i : j + 1].any() else self.chart.state
        points = self.chart.onto(self.points[i] * (1 - share) + self.points[j] * share, self.condition, state)
        return state(*points.T)

    def _fold(self, i):
        apex, p, v, q, t = self._between(max(i - 2, 0), min(i + 2, len(self.q) - 1))
        sign = 1 if q[20] >= max(q[0], q[-1]) or q[20] > (q[0] + q[-1]) / 2 else -1
        k = int(np.clip(np.argmax(sign * q), 1, 39))
        a, b, c = q[k - 1 : k + 2]
        curvature = a - 2 * b + c
        s = (a - c) / (2 * curvature) if curvature else 0.0
        m = k + (1 if s > 0 else -1)
        state = [w[k] + abs(s) * (w[m] - w[k]) for w in (apex, p, v)]
        return *state, b - curvature * s * s / 2, t[k]

    def special(self) -> list[dict]:
        """Folds, zero-voltage states and breakdown as records; `weak` folds are near-degenerate."""
        size = np.maximum(np.abs(self.q), 1e-3)
        # mended vertices carry the error of the map itself at the cliff
        strong = set(turning_points(self.q, np.where(self.unresolved, 1e-3, NOISE) * size))
        found = []
        for i in sorted(strong | set(turning_points(self.q, 1e-2 * NOISE * size))):
            found.append(("fold", i not in strong, self._fold(i)))
        for kind, f in (("zero_voltage", lambda a, q: q), ("breakdown", lambda a, q: q * self._ratio(a) - 1)):
            value = f(self.apex, self.q)
            for i in np.flatnonzero((value[:-1] < 0) != (value[1:] < 0)):
                apex, p, v, q, t = self._between(i, i + 1)
                fine = f(apex, q)
                k = np.flatnonzero((fine[:-1] < 0) != (fine[1:] < 0))
                if not len(k):
                    continue
                k = int(k[0])
                s = fine[k] / (fine[k] - fine[k + 1])
                found.append((kind, False, tuple(w[k] + s * (w[k + 1] - w[k]) for w in (apex, p, v, q, t))))
            gap = np.abs(value[turning_points(value, 1e-9 + 0 * value)])
            if len(gap) and gap.min() < 1e-6:
                found.append((kind, True, (np.nan,) * 5))
        names = ("apex_stretch", "pressure", "volume", "voltage_squared", "load_fraction")
        records = [{"kind": k, "weak": w} | dict(zip(names, map(float, s), strict=True)) for k, w, s in found]
        if self.closed:  # the overlap shows some of them twice
            unique = []
            for r in records:
                if not any(_apart(r, o) < 1e-3 and r["kind"] == o["kind"] for o in unique):
                    unique.append(r)
            records = unique
        return records

    def pieces(self) -> "list[Line]":
        """The runs of vertices that lie on a contour, as lines."""
        good = np.isfinite(self.q)
        if good.all():
            return [self]
        out = []
        for run in _runs(good):
            if run.stop - run.start > 3:
                piece = copy.copy(self)
                piece.closed = False
                for name in ("points", "apex", "p", "v", "q", "t", "x", "unresolved"):
                    setattr(piece, name, getattr(self, name)[run])
                piece.length = float(np.linalg.norm(np.diff(piece.x, axis=0), axis=1).sum())
                out.append(piece)
        return out

    def _ratio(self, apex):
        return (apex**2 / np.asarray(self.breakdown.field(apex))) ** 2


def _apart(a: dict, b: dict) -> float:
    names = ("apex_stretch", "pressure", "voltage_squared")
    return float(np.linalg.norm([(a[n] - b[n]) / s for n, s in zip(names, SCALE, strict=True)]))


def _runs(inside) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(inside).view(np.int8), [0]])))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _dense(branch):
    """A branch as a polyline (λa, p, q) between its points by a cubic spline over the chord length."""
    x = np.stack([branch.apex_stretch, branch.pressure, branch.voltage_squared], axis=1) / SCALE
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(arc) > 1e-12])
    x, arc = x[keep], arc[keep]
    if len(x) < 4:
        return x
    where = np.unique(
        np.concatenate([arc[i] + (arc[i + 1] - arc[i]) * np.arange(8) / 8 for i in range(len(arc) - 1)] + [arc[-1:]])
    )
    return CubicSpline(arc, x)(where)


def _pieces(polylines, chart: Chart, top: float) -> int:
    """How many connected pieces of some length lie in the window up to t = top; loops that begin inside count once."""
    count = 0
    for x in polylines:
        apex, q = x[:, 0] * SCALE[0], x[:, 2] * SCALE[2]
        t = q / truth.largest_load(apex, chart.limit)
        share = (apex - chart.rim) / (chart.end - chart.rim)
        runs = _runs((t < top) & (t > BOTTOM + EDGE) & (share > 1e-3) & (share < 1 - EDGE))
        runs = [r for r in runs if r.stop - r.start > 1 and np.linalg.norm(np.diff(x[r], axis=0), axis=1).sum() > 0.1]
        loop = len(runs) > 1 and np.linalg.norm(x[0] - x[-1]) < 1e-3 and runs[0].start == 0 and runs[-1].stop == len(x)
        count += len(runs) - bool(loop)
    return count


def _real(branch, which, chart: Chart, condition) -> bool:
    """Whether points of a branch are equilibria of the loading, by shooting in extended precision."""
    apex, own, q = branch.apex_stretch[which], branch.pressure[which], branch.voltage_squared[which]
    p, v, unsure = truth.exact(apex, own, q, np.full_like(q, chart.limit), np.full_like(q, chart.rim), steps=400)
    p, v = np.asarray(p, float), np.asarray(v, float)
    good = (np.abs(p / own - 1) < 1e-6) & (np.abs(condition(p, v)) < 1e-6 * p) & (np.asarray(unsure) < 1e-6)
    return bool(good.all())


def _off(record: dict, chart: Chart, condition) -> float:
    """How far a state is from the loading's contour, relative to its pressure, by SciPy's adaptive map."""
    p, v = truth.map_scipy(record["apex_stretch"], record["voltage_squared"], chart.limit, chart.rim)
    return float(np.nan_to_num(abs(condition(p, v)) / p, nan=np.inf))


def drawn_points(diagram, limit: float) -> list[dict]:
    """The folds, zero-voltage states and breakdowns of a diagram."""
    points = [p for p in diagram.special_points if p.kind in ("fold", "zero_voltage", "breakdown")]
    names = ("kind", "branch", "apex_stretch", "pressure", "volume", "voltage_squared", "error_estimate")
    return [
        {name: getattr(p, name) for name in names}
        | {"load_fraction": p.voltage_squared / float(truth.largest_load(p.apex_stretch, limit))}
        for p in points
    ]


class Comparison:
    """A diagram beside the contours of the finer scan: what is `wrong`, and what is only `noted` as near-degenerate."""

    def __init__(self, chart: Chart, condition, diagram):
        self.chart, self.condition, self.diagram = chart, condition, diagram
        law = diagram.scene.membrane.breakdown
        lines = [Line(chart, points, condition, law) for points in chart.lines(condition)]
        self.lines = [piece for line in lines for piece in line.pieces() if piece.length > 1e-2]
        self.branches = [_dense(b) for b in diagram.branches]
        self.scanned = [point for line in self.lines for point in line.special()]
        self.drawn = drawn_points(diagram, chart.limit)
        self.wrong, self.noted, self.largest = [], [], 0.0

    def inner(self, t, apex):
        """Where states are off the edges of the window."""
        share = (apex - self.chart.rim) / (self.chart.end - self.chart.rim)
        return (t < TOP - EDGE) & (t > BOTTOM + EDGE) & (share > 1e-3) & (share < 1 - EDGE)

    def add(self, entry: dict, wrong: bool) -> None:
        (self.wrong if wrong else self.noted).append(entry)

    def load_fraction(self, branch):
        return branch.voltage_squared / truth.largest_load(branch.apex_stretch, self.chart.limit)

    def seek_missed_branches(self) -> None:
        """Pieces of contour that are on no branch."""
        for line in self.lines:
            away = [distances(line.x, b) for b in self.branches]
            away = np.min(away, axis=0) if away else np.full(len(line.x), np.inf)
            for run in _runs((away > NEAR) & self.inner(line.t, line.apex)):
                length = float(np.linalg.norm(np.diff(line.x[run], axis=0), axis=1).sum())
                k = run.start + int(np.argmax(away[run]))
                at = {"apex_stretch": line.apex[k], "pressure": line.p[k], "volume": line.v[k], "t": line.t[k]}
                entry = {"what": "branch missed", "closed": line.closed, "away": away[k]} | at | {"length": length}
                self.add(entry, length > NEAR)

    def seek_invented_branches(self) -> None:
        """Pieces of branches that are on no contour."""
        for number, branch in enumerate(self.diagram.branches):
            t = self.load_fraction(branch)
            own = np.stack([branch.apex_stretch, branch.pressure, branch.voltage_squared], axis=1) / SCALE
            away = [distances(own, line.x) for line in self.lines]
            away = np.min(away, axis=0) if away else np.full(len(own), np.inf)
            for run in _runs((away > NEAR) & self.inner(t, branch.apex_stretch)):
                k = run.start + int(np.argmax(away[run]))
                at = {"apex_stretch": branch.apex_stretch[k], "pressure": branch.pressure[k], "t": t[k]}
                entry = {"what": "branch invented", "points": run.stop - run.start, "away": away[k], "branch": number}
                self.add(entry | at, not _real(branch, run, self.chart, self.condition))

    def count_pieces(self) -> tuple[int, int]:
        """The numbers of connected pieces of contour and of branches, which should be equal."""
        lines = [line.x for line in self.lines]
        counts = [(_pieces(lines, self.chart, t), _pieces(self.branches, self.chart, t)) for t in (0.895, 0.885, 0.87)]
        if any(a != b for a, b in counts):
            entry = {"what": "number of branches", "scan, diagram at t < 0.895, 0.885, 0.87": counts}
            self.add(entry, not any(a == b for a, b in counts))
        return counts[0]

    def pair_points(self) -> None:
        """Special points of the scan with those of the diagram, the weak ones last."""
        free = list(range(len(self.drawn)))
        for s in sorted(self.scanned, key=lambda s: s["weak"]):
            if not math.isfinite(s["apex_stretch"]):
                self.add({"what": f"{s['kind']} nearly tangent"}, False)
                continue
            apart = [(_apart(s, self.drawn[k]), k) for k in free if self.drawn[k]["kind"] == s["kind"]]
            if apart and min(apart)[0] < 0.1:
                k = min(apart)[1]
                free.remove(k)
                if not s["weak"]:
                    self.judge_pair(s, self.drawn[k])
            else:
                self.add({"what": f"{s['kind']} missed", "scan": s}, self.is_missed(s))
        for d in (self.drawn[k] for k in free):
            if d["load_fraction"] < TOP:
                hard = self.inner(d["load_fraction"], d["apex_stretch"])
                self.add({"what": f"{d['kind']} invented", "diagram": d}, hard)

    def judge_pair(self, s: dict, d: dict) -> None:
        """How far a point of the scan is from that of the diagram."""
        difference = abs(d["voltage_squared"] - s["voltage_squared"]) / max(abs(s["voltage_squared"]), 1e-3)
        if s["kind"] == "zero_voltage":
            difference = abs(d["volume"] / s["volume"] - 1)
        self.largest = max(self.largest, difference)
        if difference > POSITION and self.inner(s["load_fraction"], s["apex_stretch"]):
            # a state that is not on the contour to this precision cannot say where the fold is
            off = [_off(r, self.chart, self.condition) for r in (s, d)]
            entry = {"what": f"{s['kind']} elsewhere", "difference": difference, "scan": s, "diagram": d}
            self.add(entry, not (off[0] > POSITION and off[1] < 1e-6))

    def is_missed(self, s: dict) -> bool:
        """Whether the diagram lacks a point that the scan shows without doubt."""
        hard = self.inner(s["load_fraction"], s["apex_stretch"]) and not s["weak"]
        # at the cliff the fixed grid of the scan's map may err, and its line waver about the diagram's: where a state is
        # not on the contour by an adaptive map, it cannot say where q turns
        place = scaled(*(np.array([s[n]]) for n in ("apex_stretch", "pressure", "voltage_squared")))
        along = any(distances(place, b)[0] < 0.05 for b in self.branches)
        off = _off(s, self.chart, self.condition) if hard else 0.0
        hard = hard and off < (POSITION if along else 1e-3)
        # or shows one fold twice, on both sides of where its line is torn
        return hard and not any(d["kind"] == s["kind"] and _apart(s, d) < 0.01 for d in self.drawn)

    def forgive_the_scan(self) -> None:
        """The scan erred somewhere, or is the coarser: where the whole diagram is real, so is what the scan lacks."""
        invented = [w for w in self.wrong if w["what"].endswith("invented") or w["what"] == "number of branches"]
        if not invented:
            return
        windows = [self.inner(self.load_fraction(b), b.apex_stretch) for b in self.diagram.branches]
        pairs = zip(self.diagram.branches, windows, strict=True)
        if all(_real(b, w, self.chart, self.condition) for b, w in pairs):
            self.noted += invented
            self.wrong = [w for w in self.wrong if w not in invented]


def compare(chart: Chart, condition, diagram) -> dict:
    """What differs between a diagram and the contours of the finer scan."""
    both = Comparison(chart, condition, diagram)
    both.seek_missed_branches()
    both.seek_invented_branches()
    pieces = both.count_pieces()
    both.pair_points()
    both.forgive_the_scan()
    sure = [s["kind"] for s in both.scanned if not s["weak"]]
    return {
        "lines": len(both.lines),
        "mended_vertices": int(sum(line.unresolved.sum() for line in both.lines)),
        "branches": len(both.branches),
        "pieces": pieces,
        "scan": {kind: sure.count(kind) for kind in ("fold", "zero_voltage", "breakdown")},
        "largest_difference": both.largest,
        "invalid_nodes": chart.invalid_nodes,
        "disagreements": both.wrong,
        "near_degenerate": both.noted,
    }


def estimates(diagram, limit: float) -> dict:
    """Error estimates above the tolerance, and flags."""
    out = {"states_above_tolerance": 0, "largest_estimate": 0.0, "special_points_above_tolerance": []}
    for branch in diagram.branches:
        t = branch.voltage_squared / truth.largest_load(np.maximum(branch.apex_stretch, 1 + 1e-12), limit)
        error = branch.error_estimate[t <= TOP]
        out["states_above_tolerance"] += int((~(error <= diagram.tolerance)).sum())
        out["largest_estimate"] = max(out["largest_estimate"], float(np.max(error, initial=0.0)))
    for p in diagram.special_points:
        t = p.voltage_squared / float(truth.largest_load(p.apex_stretch, limit))
        if t <= TOP and not p.error_estimate <= diagram.tolerance:
            entry = {"kind": p.kind, "apex_stretch": p.apex_stretch, "t": t, "error_estimate": p.error_estimate}
            out["special_points_above_tolerance"].append(entry)
    out["flags"] = sorted(
        {f for b in diagram.branches for f in b.flags} | {f for p in diagram.special_points for f in p.flags}
    )
    out["ends"] = sorted({c.name for b in diagram.branches for c in (b.start, b.end)})
    return out


def one(scene: dict) -> dict:
    """The record of a scene; never raises."""
    record: dict = {"scene": scene, "status": "agreement"}
    scan, engine = harness.Stopwatch(), harness.Stopwatch()
    try:
        with scan:
            chart = Chart(scene["stretch_limit"], scene["prestretch"])
            loading, condition = resolve(scene, chart)
        record["scan_seconds"] = scan.seconds
        membrane = dj.Membrane(dj.Gent(scene["stretch_limit"]), scene["prestretch"])
        diagram = engine.time(dj.voltage_volume, dj.Scene(membrane, loading))
        record["diagram_seconds"] = engine.seconds
        diagram.to_json()
        record["complete"] = diagram.complete
        record |= estimates(diagram, scene["stretch_limit"])
        record["ramp"] = [e.event for e in diagram.events]
        record["area_strain_reason"] = diagram.area_strain_reason
        record |= compare(chart, condition, diagram)
        if record["disagreements"]:
            record["status"] = "disagreement"
    except Exception as error:  # listed with its scene, so that one scene does not end the run
        record["status"] = "exception"
        record["error"] = f"{type(error).__name__}: {error}"
        record["where"] = [f"{f.name}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)][-4:]
    return record


def summary(records: list[dict], options, seconds: float) -> dict:
    """Counts, and every record that is not a plain agreement in full."""
    done = [r for r in records if r["status"] != "exception"]
    times = [r["diagram_seconds"] for r in done]
    return {
        "name": "agreement",
        "engine": "continuation",
        "parameters": {"scenes": options.scenes, "seed": options.seed, "first": options.first},
        "counts": {
            "scenes": len(records),
            "agreement": sum(r["status"] == "agreement" for r in records),
            "disagreement": sum(r["status"] == "disagreement" for r in records),
            "exception": sum(r["status"] == "exception" for r in records),
            "not_complete": sum(not r["complete"] for r in done),
            "with_states_above_tolerance": sum(r["states_above_tolerance"] > 0 for r in done),
            "with_special_points_above_tolerance": sum(bool(r["special_points_above_tolerance"]) for r in done),
            "with_near_degenerate": sum(bool(r.get("near_degenerate")) for r in done),
            "branches": sum(r.get("branches", 0) for r in done),
            **{k: sum(r.get("scan", {}).get(k, 0) for r in done) for k in ("fold", "zero_voltage", "breakdown")},
        },
        "largest_difference": max((r.get("largest_difference", 0.0) for r in done), default=None),
        "diagram_seconds": {"median": float(np.median(times)), "max": max(times)} if times else {},
        "seconds": seconds,
        "machine": harness.machine(),
        "records": records,
    }


def main() -> int:
    parser = harness.arguments(__doc__, "2 scenes", seed=True)
    parser.add_argument("--scenes", type=int, default=1000, help="number of random scenes")
    parser.add_argument("--first", type=int, default=0, help="start at this scene of the sequence")
    options = parser.parse_args()
    if options.quick:
        options.scenes = 2
    report = harness.Progress()
    harness.say(f"seed {options.seed}, {options.scenes} scenes")
    records: list[dict] = []
    for number, scene in enumerate(film_scenes(options.seed, options.first + options.scenes)):
        if number < options.first:
            continue
        record = {"number": number} | one(scene)
        records.append(record)
        text = f"{number:4} {record['status']}"
        if record["status"] == "exception":
            text += f" {record['error']}"
        else:
            text += f" complete={record['complete']} {record['diagram_seconds']:.1f} s, {record['branches']} branches {record['scan']}"
            for d in record["disagreements"]:
                text += f"\n             {d}"
        report(text)
        harness.write(summary(records, options, report.seconds), options.json, partial=True)
    document = summary(records, options, report.seconds)
    for name, value in document["counts"].items():
        harness.say(f"{name:36} {value}")
    counts = document["counts"]
    good = not (counts["disagreement"] or counts["exception"] or counts["not_complete"])
    return harness.finish(document, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
