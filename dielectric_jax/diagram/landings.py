"""What lies beyond breakdown: where a snap lands in the scanned window, and whether a branch has a fold further on.

A surface ends a little above breakdown and a march ends at it, but both questions need the whole scanned window. The scan
of the membrane holds p and V there, right to about 1e-6, and to 1e-3 on the cliff towards lock-up: how well is measured at
random states. A question that it answers clearly is answered from it; the others are settled by exact states from shooting,
or stay open.
"""

import dataclasses
import enum
import functools
import typing

import numpy as np

from ..model import (
    LOAD_PANELS,
    SCANNED_LOAD,
    ClosingEquation,
    ConstantVoltage,
    Corrected,
    FoldAhead,
    LoadingCondition,
    Membrane,
    Scan,
    Scene,
    SceneBatch,
    cached_scan,
    map_nodes,
    pick,
)
from ..surface import ById
from .ramps import LOAD, VOLUME
from .resolution import (
    ABOUT_BREAKDOWN,
    CHORDS,
    CLOSE_ROWS,
    ENOUGH_CHORDS,
    EXACT_MAP_STEPS,
    FALL,
    LANDING_REACH,
    LANDING_TOLERANCE,
    LANES_TOGETHER,
    LEAP,
    LOAD_PER_NOISE,
    NOISE_BAND,
    NOISE_SAFETY,
    NOISE_SAMPLES,
    SCAN_NODES,
    SCAN_NOISE,
    SCAN_STRIDE,
    SETTLED_CROSSING,
    SLOW_RISE,
    TURNING,
)

__all__ = ["Landing", "Landings", "folds_ahead", "landings"]


class Landing(enum.IntEnum):
    """Where a snap lands in the scanned window."""

    unknown = 0
    none = 1
    broken = 2
    unbroken = 3


class Landings(typing.NamedTuple):
    """The landings of many snaps: `kind` (n,) as `Landing`, `state` (n, 5) with λa, p, V, q, error.

    `guess` (n, 2) is λa and p as the scan shows them; NaN where there is no landing. `state` is NaN where the landing was
    not located exactly.
    """

    kind: np.ndarray
    state: np.ndarray
    guess: np.ndarray


@dataclasses.dataclass(frozen=True)
class _Field:
    """The scan of a membrane as functions of the load on some of its rows."""

    apex: np.ndarray
    limit: np.ndarray
    fraction: np.ndarray
    logs: np.ndarray  # (2, rows, loads): of p/(1 − t) and V
    weights: np.ndarray  # (loads − 3, 4), barycentric
    noise: np.ndarray  # (bands, panels): relative error of p and V

    def noise_at(self, row, t) -> np.ndarray:
        """What the scan leaves unclear of a pressure, relative, on rows at load fractions, arrays of one shape."""
        return self.noise[np.asarray(row) // NOISE_BAND, np.searchsorted(LOAD_PANELS, np.nan_to_num(t))]

    def at(self, row, t):
        """p and V on rows at load fractions t, arrays of one shape; NaN outside the scan."""
        first = np.clip(np.searchsorted(self.fraction, t) - SCAN_NODES // 2, 0, len(self.fraction) - SCAN_NODES)
        near = first[..., None] + np.arange(SCAN_NODES)
        with np.errstate(all="ignore"):
            gap = t[..., None] - self.fraction[near]
            gap = np.where(np.abs(gap) < 1e-14, 1e-14, gap)
            weight = self.weights[first] / gap
            weight /= weight.sum(axis=-1, keepdims=True)
            values = (self.logs[:, np.asarray(row)[..., None], near] * weight).sum(axis=-1)
            inside = (t <= SCANNED_LOAD + 1e-12) & (t >= self.fraction[0])
            p, v = np.where(inside, np.exp(values), np.nan)
        return p * (1 - t), v


@functools.lru_cache(maxsize=16)
def _field(scan: ById) -> _Field:
    whole: Scan = scan.value
    rows = np.unique([*range(0, len(whole.apex_stretch), SCAN_STRIDE), len(whole.apex_stretch) - 1])
    t = whole.load_fraction
    with np.errstate(all="ignore"):
        logs = np.log(np.stack([whole.pressure[rows] / (1 - t), whole.volume[rows]]))
    field = _Field(whole.apex_stretch[rows], whole.largest_load[rows], t, logs, _weights(t), np.zeros(0))
    return dataclasses.replace(field, noise=_measured_noise(field, whole.membrane))


def _weights(t: np.ndarray) -> np.ndarray:
    gaps = np.stack([t[i : len(t) - SCAN_NODES + 1 + i] for i in range(SCAN_NODES)], axis=1)
    apart = gaps[:, :, None] - gaps[:, None] + np.eye(SCAN_NODES)
    return 1 / apart.prod(axis=2)


def _measured_noise(field: _Field, membrane: Membrane) -> np.ndarray:
    """The error of the scan at random states against the explicit map, (bands, panels), at least `SCAN_NOISE`."""
    random = np.random.default_rng(0)
    edges = np.array([field.fraction[0], *LOAD_PANELS, SCANNED_LOAD])
    bands, panels = -(-len(field.apex) // NOISE_BAND), len(LOAD_PANELS) + 1
    shape = bands, panels, NOISE_SAMPLES
    row = np.arange(bands)[:, None, None] * NOISE_BAND + random.integers(0, NOISE_BAND, shape)
    row = np.minimum(row, len(field.apex) - 2).ravel()  # the last is the edge of the window
    low, high = edges[:-1], edges[1:]
    t = (low[:, None] + (high - low)[:, None] * random.uniform(0, 1, shape)).ravel()
    p, v = field.at(row, t)
    exact = map_nodes(membrane.material, field.apex[row], t, float(membrane.prestretch), EXACT_MAP_STEPS)
    with np.errstate(all="ignore"):
        error = np.maximum(np.abs(p / exact[0] - 1), np.abs(v / exact[1] - 1)).reshape(shape)
    return np.maximum(
        NOISE_SAFETY * np.nan_to_num(error, nan=0.0).max(axis=2), SCAN_NOISE
    )  # a state that is not there has no error


def _field_of(membrane: Membrane) -> _Field:
    stretches, _, loads = Scene(membrane, ConstantVoltage(0.0)).limits()
    return _field(ById(cached_scan(membrane, stretches, loads)))


class _Line(typing.NamedTuple):
    """The states at the load of a fold along the stretch, on lanes (lanes, rows): residual, its noise, the pressure.

    `inside` are the rows beyond the fold in the scanned window. `edge` (lanes, rows − 1) is the residual where the load
    fraction passes the edge of the window between two rows, NaN elsewhere, and `edge_apex` λa there.
    """

    residual: np.ndarray
    noise: np.ndarray
    pressure: np.ndarray
    inside: np.ndarray
    edge: np.ndarray
    edge_apex: np.ndarray
    holed: np.ndarray  # (lanes,): the scan lacks a state of the window beyond the fold, so nothing can be excluded


def _line(field: _Field, condition: LoadingCondition, apex: np.ndarray, load: np.ndarray) -> _Line:
    own = {name: np.asarray(value)[:, None] for name, value in vars(condition).items()}
    condition = dataclasses.replace(condition, **own)
    t = load[:, None] / field.limit
    rows = np.broadcast_to(np.arange(len(field.apex)), t.shape)
    p, v = field.at(rows, t)
    residual = condition.residual(p, v, load[:, None])
    inside = np.isfinite(residual) & (field.apex > apex[:, None])
    # the edge between a row inside and one beyond the window
    passes = (t[:, :-1] <= SCANNED_LOAD) != (t[:, 1:] <= SCANNED_LOAD)
    share = np.where(passes, (SCANNED_LOAD - t[:, :-1]) / np.where(passes, t[:, 1:] - t[:, :-1], 1.0), 0.0)
    top = field.at(np.arange(len(field.apex)), np.full(len(field.apex), SCANNED_LOAD))
    at_top = condition.residual(top[0], top[1], load[:, None])
    edge = at_top[:, :-1] + share * (at_top[:, 1:] - at_top[:, :-1])
    edge_apex = field.apex[:-1] + share * np.diff(field.apex)
    edge = np.where(passes & (edge_apex > apex[:, None]), edge, np.nan)
    holed = ((t <= SCANNED_LOAD) & (field.apex > apex[:, None]) & ~np.isfinite(residual)).any(axis=1)
    return _Line(residual, field.noise_at(rows, t) * np.abs(p), p, inside, edge, edge_apex, holed)


def _first(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first place along the last axis where a mask holds, and whether it does."""
    return np.argmax(mask, axis=-1), np.asarray(mask.any(axis=-1))


def _side(value: np.ndarray, noise) -> np.ndarray:
    """−1, 0 (within the noise, or not known) or 1."""
    with np.errstate(invalid="ignore"):
        return np.where(value > noise, 1, np.where(value < -noise, -1, 0))


def _clear(line: _Line, field: _Field, apex: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether the line shows clearly where the membrane lands: (clear, lands, λa and p there).

    Beyond the fold the pressure of the membrane falls behind that of the gas, and the membrane grows until it no longer
    does. Clear is one fall and one rise of the residual, with no other sign change in the window.
    """
    lanes, count = line.residual.shape
    at = np.arange(count)
    side = np.where(line.inside, _side(line.residual, line.noise), 0)
    edge = _side(line.edge, np.nan_to_num(np.maximum(line.noise[:, :-1], line.noise[:, 1:])))
    first, _ = _first(field.apex > apex[:, None])
    stop, ends = _first((at >= first[:, None]) & ~line.inside)
    stop = np.where(ends, stop, count)
    here = (at >= first[:, None]) & (at < stop[:, None])
    fell, falls = _first(here & (side < 0))
    rose, rises = _first(here & (side > 0) & (at > fell[:, None]) & falls[:, None])
    rises &= falls
    last = np.maximum(stop - 1, 0)
    own = np.arange(lanes)
    at_edge = np.where(stop < count, edge[own, np.minimum(last, count - 2)], -1)
    outside = stop == first  # the fold lies at the edge of the window, or beyond it
    at_edge = np.where(outside, -1, at_edge)
    lands = rises | (~rises & falls & (at_edge > 0))
    end = np.where(rises, rose, last)
    way = (at >= first[:, None]) & (at <= end[:, None])
    # one fall and one rise
    least = np.argmin(np.where(way, line.residual, np.inf), axis=1)
    step = np.diff(np.where(way, line.residual, np.nan), axis=1)
    loose = np.maximum(line.noise[:, :-1], line.noise[:, 1:])
    with np.errstate(invalid="ignore"):
        down = (step > loose) & (at[:-1] < least[:, None])
        up = (step < -loose) & (at[:-1] >= least[:, None])
    # rows within the noise lie beside the fold or the landing, not between
    below = here & (side < 0)
    lowest = count - 1 - np.argmax((below & (at <= end[:, None]))[:, ::-1], axis=1)
    touching = (way & (side == 0) & (at > fell[:, None]) & (at < lowest[:, None])).any(axis=1)
    before = (here & (side > 0) & (at < fell[:, None])).any(axis=1)
    # beyond a gap in which the load exceeds the window's nothing rises through zero where all is of one sign
    later = line.inside & (at >= stop[:, None])
    later_edges = np.isfinite(line.edge) & (at[:-1] >= stop[:, None])
    above = (later & (side >= 0)).any(axis=1) | (later_edges & (edge >= 0)).any(axis=1)
    below_it = (later & (side <= 0)).any(axis=1) | (later_edges & (edge <= 0)).any(axis=1)
    one_way = falls & ~before & ~touching & ~down.any(axis=1) & ~up.any(axis=1)
    clear = ~line.holed & (one_way | outside) & (lands | ((at_edge < 0) & ~(above & below_it)))
    # where
    one = np.clip(end - 1, 0, count - 1)
    r0, r1 = line.residual[own, one], line.residual[own, end]
    apex0, apex1, p0, p1 = field.apex[one], field.apex[end], line.pressure[own, one], line.pressure[own, end]
    edge_value = line.edge[own, np.minimum(last, count - 2)]
    off = ~rises
    r0, r1 = np.where(off, line.residual[own, last], r0), np.where(off, edge_value, r1)
    apex0, p0 = np.where(off, field.apex[last], apex0), np.where(off, line.pressure[own, last], p0)
    apex1, p1 = np.where(off, line.edge_apex[own, np.minimum(last, count - 2)], apex1), np.where(off, p0, p1)
    with np.errstate(all="ignore"):
        share = np.clip(-r0 / (r1 - r0), 0.0, 1.0)
    where = np.stack([apex0 + share * (apex1 - apex0), p0 + share * (p1 - p0)], axis=1)
    return clear, lands, np.where((clear & lands)[:, None], where, np.nan)


def _candidates(line: _Line, field: _Field, k: int) -> tuple[np.ndarray, bool]:
    """(λa, p) of every rising crossing of a line, and whether it may have more than those, within the noise."""
    found = []
    residual, noise, inside = line.residual[k], line.noise[k], line.inside[k]
    for i in range(len(residual) - 1):
        if inside[i] and inside[i + 1] and residual[i] < 0 <= residual[i + 1]:
            found.append(_between(field, line, k, i))
        elif np.isfinite(line.edge[k, i]) and (inside[i] or inside[i + 1]):
            row = i if inside[i] else i + 1
            rising = (residual[row] < noise[row]) if inside[i] else (residual[row] > -noise[row])
            rising &= (line.edge[k, i] > -noise[row]) if inside[i] else (line.edge[k, i] < noise[row])
            if rising:
                found.append([line.edge_apex[k, i], line.pressure[k, row]])
    inner = inside[:-2] & inside[1:-1] & inside[2:] & (np.abs(residual) < noise)[1:-1]
    with np.errstate(invalid="ignore"):
        turns = (residual[1:-1] - residual[:-2]) * (residual[2:] - residual[1:-1]) < 0
    beside_fold = np.flatnonzero(inside)[:3]
    touches = np.setdiff1d(np.flatnonzero(inner & turns) + 1, beside_fold)
    return np.reshape(found, (-1, 2)), bool(len(touches)) or bool(line.holed[k])


def _between(field: _Field, line: _Line, k: int, i: int) -> list[float]:
    """(λa, p) where a line crosses zero between rows i and i + 1, by the cubic through four rows, by two where it ends."""
    rows = np.arange(max(i - 1, 0), min(i + 3, len(field.apex)))
    if len(rows) < 4 or not line.inside[k, rows].all():
        rows = np.array([i, i + 1])
    apex, logs = field.apex[rows], np.log(line.pressure[k, rows])
    # p falls by half within a hundredth of the stretch towards lock-up: the residual relative to it is the smoother
    relative = line.residual[k, rows] / line.pressure[k, rows]
    shape = [np.polynomial.Polynomial.fit(apex, values, len(rows) - 1) for values in (relative, logs)]
    low, high = field.apex[i], field.apex[i + 1]
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if shape[0](middle) < 0 else (low, middle)
    return [low, float(np.exp(shape[1](low)))]


def _nearest(corrected: Corrected, fraction: np.ndarray, volume: float) -> np.ndarray | None:
    """The stable state (columns as in `States`) in the window nearest in volume above `volume`; None where there is none."""
    good = np.flatnonzero((corrected.index == 0) & (corrected.volume > volume) & (fraction <= SCANNED_LOAD))
    if not len(good):
        return None
    i = good[np.argmin(corrected.volume[good])]
    return np.array(
        [
            *corrected.u[i],
            corrected.volume[i],
            max(corrected.error[i], corrected.spread[i]),
        ]
    )


def landings(
    scene_batch: SceneBatch, membrane: Membrane, which: np.ndarray, folds: np.ndarray, *, exact: bool
) -> Landings:
    """Where snaps of scenes `which` of one `membrane` land that leave from `folds` (n, 5), each λa, p, V, q, error.

    A landing is the stable state at the fold's load, t ≤ 0.9, nearest in volume towards larger ones. With `exact` every
    landing is located by shooting; else only those that the scan does not show clearly.
    """
    count = len(which)
    found = Landings(np.zeros(count, int), np.full((count, 5), np.nan), np.full((count, 2), np.nan))
    field = _field_of(membrane)
    seeds: list[tuple[int, np.ndarray]] = []  # of the snaps that exact states settle
    for i in range(0, count, LANES_TOGETHER):
        part = np.arange(i, min(i + LANES_TOGETHER, count))
        line = _line(field, pick(scene_batch.condition, which[part]), folds[part, 0], folds[part, LOAD])
        clear, lands, found.guess[part] = _clear(line, field, folds[part, 0])
        found.kind[part[clear & ~lands]] = Landing.none
        for k in np.flatnonzero(~clear | (exact & lands)):
            candidates, vague = (found.guess[part[k]][None], False) if clear[k] else _candidates(line, field, int(k))
            if not vague:
                seeds.append((int(part[k]), candidates))
        found.kind[part] = np.where(clear & lands, Landing.broken, found.kind[part])
    there = np.flatnonzero(found.kind == Landing.broken)
    if len(there):
        ratio = folds[there, LOAD] / scene_batch.limits(found.guess[there, 0], which[there])[0]
        found.kind[there[ratio < 1]] = Landing.unbroken
        about = np.abs(ratio - 1) < ABOUT_BREAKDOWN
        found.kind[there[about]] = Landing.unknown
        known = {k for k, _ in seeds}
        seeds += [(int(k), found.guess[k][None]) for k in there[about] if int(k) not in known]
    _settle_by_states(scene_batch, which, folds, seeds, found)
    return found


def _settle_by_states(
    scene_batch: SceneBatch, which, folds, seeds: list[tuple[int, np.ndarray]], found: Landings
) -> None:
    """Settles in place the landings of snaps by exact states at the candidates (λa, p) of each."""
    snap = np.repeat([k for k, _ in seeds], [len(c) for _, c in seeds]).astype(int)
    if len(snap):
        load, lanes = folds[snap, LOAD], which[snap]
        u = np.column_stack([np.concatenate([c for _, c in seeds]), load])
        rows, kinds = np.tile([0.0, 0.0, 1.0], (len(snap), 1)), np.full(len(snap), ClosingEquation.level)
        corrected = scene_batch.correct(lanes, u, rows, load, kinds, tolerance=LANDING_TOLERANCE, reach=LANDING_REACH)
        again = np.flatnonzero(~corrected.ok)  # once more from where Newton was
        if len(again):
            begin = np.where(np.isfinite(corrected.u[again]), corrected.u[again], u[again])
            given = begin, rows[again], load[again], kinds[again]
            second = scene_batch.correct(lanes[again], *given, tolerance=LANDING_TOLERANCE, reach=LANDING_REACH)
            for store, values in zip(corrected, second, strict=True):
                store[again] = values
        limits = scene_batch.limits(np.nan_to_num(corrected.u[:, 0], nan=2.0), lanes)
        with np.errstate(divide="ignore", invalid="ignore"):  # where Newton left the chart; such a state is not used
            fraction = load / limits[2]
    for k, candidates in seeds:
        own = np.flatnonzero(snap == k)
        if not len(candidates):
            found.kind[k] = Landing.none
            continue
        state = None
        if corrected.ok[own].all():
            state = _nearest(Corrected(*(v[own] for v in corrected)), fraction[own], float(folds[k, VOLUME]))
        if state is None:
            # a clear landing whose state is another is a contradiction
            certain = corrected.ok[own].all() and not np.isfinite(found.guess[k, 0])
            found.kind[k] = Landing.none if certain else Landing.unknown
            continue
        found.state[k] = state
        limit = scene_batch.limits(state[:1], which[k : k + 1])[0, 0]
        found.kind[k] = Landing.broken if folds[k, LOAD] >= limit else Landing.unbroken


def folds_ahead(membrane: Membrane, condition: LoadingCondition, apex: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Whether the branches of one `membrane` that rise through (λa, q) turn in q further on: `FoldAhead` (lanes,).

    Each branch is followed from row to row of the scan, up to the edge of the scanned window. Where it does not go on
    from row to row, or turns by less than the scan can show, the answer is unknown.
    """
    field = _field_of(membrane)
    answer = np.full(len(apex), int(FoldAhead.unknown))
    going = np.flatnonzero(np.isfinite(apex) & np.isfinite(load))
    walk = _Walk(apex.copy(), load / np.interp(apex, field.apex, field.limit), load.copy(), np.zeros(len(apex)))
    rise, doubt = np.full(len(apex), np.nan), np.zeros(len(apex), bool)
    for row in range(len(field.apex)):
        new = going[field.apex[row] > walk.apex[going]]
        if not len(new):
            continue
        own = pick(condition, new)
        guess = walk.fraction[new] + walk.slope[new] * (field.apex[row] - walk.apex[new])
        found, settled = _crossing(field, own, row, guess, walk.load[new])
        lost = ~settled | ~(np.abs(found - walk.fraction[new]) < LEAP)
        leaves = ~lost & (found > SCANNED_LOAD)
        # where the branch is next: on the row, or at the edge of the window before it
        apex, here = np.full(len(new), field.apex[row]), found * field.limit[row]
        if leaves.any():
            apex[leaves], here[leaves] = _edge_crossing(field, pick(own, leaves), row, walk.apex[new[leaves]])
            lost |= leaves & ~np.isfinite(apex)
        stretch = apex - walk.apex[new]
        # between places that lie close together the noise of the scan is the larger
        clear = stretch > CLOSE_ROWS * walk.apex[new]
        least = np.maximum(FALL, LOAD_PER_NOISE * field.noise_at(np.full(len(new), row), found))
        with np.errstate(all="ignore"):
            per = np.where(clear | ~leaves, (here - walk.load[new]) / stretch, rise[new])
            falls = ~lost & (here < walk.load[new] * (1 - least))
            turning = leaves & ~falls & ~(per > TURNING * rise[new])
            doubt[new] |= ~lost & ~falls & clear & (per * walk.apex[new] < SLOW_RISE * walk.load[new])
        sure = ~doubt[new] & ~turning & ~lost
        answer[new[falls & ~doubt[new]]] = FoldAhead.fold
        answer[new[leaves & ~falls & sure]] = FoldAhead.none
        keep = ~(lost | leaves | falls)
        walk.slope[new[keep]] = (found[keep] - walk.fraction[new[keep]]) / stretch[keep]
        walk.fraction[new[keep]], walk.load[new[keep]] = found[keep], here[keep]
        walk.apex[new[keep]], rise[new[keep]] = apex[keep], per[keep]
        going = np.setdiff1d(going, new[~keep], assume_unique=True)
        if not len(going):
            break
    answer[going[~doubt[going]]] = FoldAhead.none
    return answer


def _edge_crossing(
    field: _Field, condition: LoadingCondition, row: int, low: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(λa, q) where contours (lanes,) leave the scanned window between λa = `low` and a row; NaN where they do not.

    The residual along the edge t = 0.9 is a cubic through four rows.
    """
    rows = np.clip(row - 2, 0, len(field.apex) - 4) + np.arange(4)
    limit = SCANNED_LOAD * field.limit[rows]
    p, v = field.at(rows, np.full(4, SCANNED_LOAD))
    condition = dataclasses.replace(condition, **{name: np.asarray(x)[:, None] for name, x in vars(condition).items()})
    residual = condition.residual(p, v, limit) / p
    nodes = field.apex[rows]

    def at(apex, values):
        """The cubic through `values` (…, 4) at the rows."""
        weight = [np.prod([(apex - b) / (a - b) for b in nodes if b != a], axis=0) for a in nodes]
        return sum(w * value for w, value in zip(weight, np.moveaxis(values, -1, 0), strict=True))

    high = np.full(len(low), field.apex[row])
    first = at(low, residual)
    crosses = first * at(high, residual) < 0
    low = low.copy()
    for _ in range(40):
        middle = (low + high) / 2
        same = at(middle, residual) * first > 0
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.where(crosses, low, np.nan), np.where(crosses, at(low, limit), np.nan)


class _Walk(typing.NamedTuple):
    """Where branches are under way: λa, t, q and dt/dλa, arrays (lanes,)."""

    apex: np.ndarray
    fraction: np.ndarray
    load: np.ndarray
    slope: np.ndarray


def _crossing(field: _Field, condition: LoadingCondition, row: int, t: np.ndarray, q: np.ndarray):
    """t at which contours (lanes,) cross a row near the load fractions t, by chord steps; and whether they do."""
    rows = np.full(len(t), row)

    def residual(t):
        # a little beyond the window the last polynomial goes on
        p, v = field.at(rows, np.clip(t, -0.9, SCANNED_LOAD))
        return condition.residual(p, v, q) / p

    here = np.clip(t, -0.9, SCANNED_LOAD - 2e-3)
    h = np.where(here > 0.5, -1e-3, 1e-3)
    with np.errstate(all="ignore"):
        value = residual(here)
        slope = (residual(here + h) - value) / h
        found = here - value / slope
        for _ in range(CHORDS):
            new = np.clip(found, -0.9, SCANNED_LOAD)
            again = residual(new)
            slope = np.where(np.abs(new - here) > 1e-5, (again - value) / (new - here), slope)
            # beyond the edge the chord goes on
            last, here, value, found = again / slope, new, again, new - again / slope
            if np.all(np.nan_to_num(np.abs(last), nan=0.0) < ENOUGH_CHORDS):
                break
        settled = np.isfinite(found) & ((np.abs(last) < SETTLED_CROSSING) | (found > SCANNED_LOAD))
    return found, settled
