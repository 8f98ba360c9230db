"""From traced lines of many scenes to their special points and ramps."""

import dataclasses
import typing

import jax
import numpy as np

from ..model import (
    SCALE,
    SCANNED_LOAD,
    ClosingEquation,
    ConstantVoltage,
    Corrected,
    FoldAhead,
    Membrane,
    Outcome,
    PointKind,
    RampEvent,
    Scene,
    SceneBatch,
    cached_scan,
    pick,
)
from .polylines import Places, Polylines
from .ramp import ENDS, Step, Stop, follow
from .ramps import LISTED, SLOTS, RampArrays, Slot
from .resolution import (
    AMBIGUOUS_ON_LINES,
    CLEAR_DIP,
    DENSE_POINTS,
    EVENT_REACH,
    LOOKS,
    OTHER_BRANCH_STRIDE,
    SCENES_TOGETHER,
)

__all__ = ["Assembly", "Events", "assemble", "have_others", "ramps_on_lines"]


_PLACE = ("line", "interval", "share")


@dataclasses.dataclass
class Events:
    """Exact points on lines, in any order: `line`, place along it, the state there, and for crossings the fold they belong to."""

    line: np.ndarray
    position: np.ndarray
    corrected: Corrected
    of_fold: np.ndarray

    def take(self, which) -> "Events":
        """The events `which`."""
        return Events(
            self.line[which], self.position[which], Corrected(*(v[which] for v in self.corrected)), self.of_fold[which]
        )


def _meet_places(
    scene_batch: SceneBatch, owner, lines: Polylines, places: Places, targets, kinds, tolerance: float
) -> Corrected:
    """Exact states at places of lines: on planes across them (NaN as target), at loads, or at breakdown."""
    at, tangent, _ = lines.at(places)
    across = np.isnan(targets)
    rows = np.where(across[:, None], tangent / SCALE, np.array([0.0, 0.0, 1.0]))
    targets = np.where(across, (tangent * at).sum(axis=1), targets)
    reach = EVENT_REACH * lines.lengths[places.line, places.interval] + 1e-6
    which = owner[places.line]
    corrected = scene_batch.correct(which, at * SCALE, rows, targets, kinds, tolerance=tolerance, reach=reach)
    sign = np.where((corrected.tangent * tangent).sum(axis=1) < 0, -1.0, 1.0)
    return corrected._replace(tangent=corrected.tangent * sign[:, None], volume_rate=corrected.volume_rate * sign)


def _exact(scene_batch: SceneBatch, owner, lines: Polylines, which: np.ndarray, tolerance: float):
    """Makes every point of the lines `which` exact, in place; the lines and points where that failed."""
    line, point = np.nonzero(np.isfinite(lines.points[which, :, 0]))
    line = which[line]
    at, way = lines.points[line, point], lines.tangents[line, point]
    kinds = np.full(len(line), ClosingEquation.level)
    corrected = scene_batch.correct(
        owner[line], at * SCALE, way / SCALE, (way * at).sum(axis=1), kinds, tolerance=100 * tolerance, reach=0.1
    )
    sign = np.where((corrected.tangent * way).sum(axis=1) < 0, -1.0, 1.0)
    good = corrected.ok
    lines.points[line[good], point[good]] = corrected.u[good] / SCALE
    lines.tangents[line[good], point[good]] = corrected.tangent[good] * sign[good, None]
    return line[~good], point[~good]


def _find_folds(scene_batch: SceneBatch, owner, lines: Polylines, tolerance: float):
    """The lines with points between which q turns once or not at all, those turns as exact folds, and up to where.

    The last are positions (lines,) beyond which a fold may be missing, infinite where there is no doubt.

    Where an interpolant hides a pair of turns, or a turn is not found, the points of the line are made exact first, which
    traced points are not, and then more are put where its slope dips towards zero.
    """
    sure = np.full(len(owner), np.inf)
    inexact = np.ones(len(owner), bool)
    done = Corrected.nothing(0), Places(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    todo = np.arange(len(owner))
    for _ in range(LOOKS):
        turns, dips = lines.turns(2)
        turns, dips = (p.take(np.isin(p.line, todo)) for p in (turns, dips))
        at, tangent, bend = lines.at(turns)
        reach = EVENT_REACH * lines.lengths[turns.line, turns.interval] + 1e-6
        start = owner[turns.line], at * SCALE, tangent, bend[:, 2]
        corrected = scene_batch.correct_folds(*start, tolerance=tolerance, reach=reach)
        sign = np.where((corrected.tangent * tangent).sum(axis=1) < 0, -1.0, 1.0)
        corrected = corrected._replace(
            tangent=corrected.tangent * sign[:, None], volume_rate=corrected.volume_rate * sign
        )
        again = np.unique(np.concatenate([turns.line[~corrected.ok], dips.line[~_harmless(lines, dips, inexact)]]))
        keep = np.flatnonzero(corrected.ok & ~np.isin(turns.line, again))
        done = (
            Corrected(*(np.concatenate([a, b[keep]]) for a, b in zip(done[0], corrected, strict=True))),
            Places(*(np.concatenate([getattr(p, n) for p in (done[1], turns.take(keep))]) for n in _PLACE)),
        )
        if not len(again):
            break
        todo = again
        fresh = again[inexact[again]]
        if len(fresh):
            failed, point = _exact(scene_batch, owner, lines, fresh, tolerance)
            np.minimum.at(sure, failed, point - 1.0)
            inexact[fresh] = False
            continue
        more = [p.take(np.isin(p.line, again)) for p in (turns.take(~corrected.ok), dips)]
        more = Places(*(np.concatenate([getattr(p, n) for p in more]) for n in _PLACE))
        middle = Places(more.line, more.interval, np.clip(more.share, 0.25, 0.75))
        kinds = np.full(len(middle), ClosingEquation.level)
        found = _meet_places(scene_batch, owner, lines, middle, np.full(len(middle), np.nan), kinds, 100 * tolerance)
        ok = np.flatnonzero(found.ok)
        lines, moved = lines.insert(middle.take(ok), found.u[ok] / SCALE, found.tangent[ok])
        done[1].interval[:] = moved[done[1].line, done[1].interval]
        sure = _moved(sure, moved)
        lost = more.take(np.flatnonzero(~found.ok))
        np.minimum.at(sure, lost.line, moved[lost.line, lost.interval].astype(float))
    else:
        # what was not settled on the last lines
        turns, dips = (p.take(np.isin(p.line, todo)) for p in lines.turns(2))
        open_ = dips.take(np.flatnonzero(~_harmless(lines, dips, inexact)))
        kept = set(zip(done[1].line.tolist(), done[1].interval.tolist(), strict=True))
        rest = [
            k
            for k, (i, j) in enumerate(zip(turns.line.tolist(), turns.interval.tolist(), strict=True))
            if (i, j) not in kept
        ]
        for places in (open_, turns.take(np.array(rest, int))):
            np.minimum.at(sure, places.line, places.interval.astype(float))
    corrected, places = done
    order = np.lexsort((places.position, places.line))
    return lines, places.take(order), Corrected(*(v[order] for v in corrected)), sure


def _moved(position: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Positions (lines,) after the points of the lines have moved to other places."""
    known = np.flatnonzero(np.isfinite(position))
    old = np.clip(position[known].astype(int), 0, moved.shape[1] - 1)
    out = position.copy()
    out[known] = moved[known, old]
    return out


def _harmless(lines: Polylines, dips: Places, inexact: np.ndarray) -> np.ndarray:
    """Which dips of q's slope, between exact points, are far from zero or so short that no pair of folds fits in."""
    _, tangent, _ = lines.at(dips)
    ends = [lines.tangents[dips.line, dips.interval + k, 2] for k in (0, 1)]
    least = np.where(ends[0] > 0, tangent[:, 2], -tangent[:, 2])
    return ~inexact[dips.line] & (least > CLEAR_DIP * np.minimum(*np.abs(ends)))


def assemble(scene_batch: SceneBatch, owner: np.ndarray, lines: Polylines, tolerance: float) -> "Assembly":
    """The folds of q among the points of the lines, and their other events."""
    lines, places, corrected, sure = _find_folds(scene_batch, owner, lines, tolerance)
    lines, moved = lines.insert(places, corrected.u / SCALE, corrected.tangent)
    sure = _moved(sure, moved)
    position = moved[places.line, places.interval] + 1.0
    folds = Events(places.line, position, corrected, np.full(len(places), -1))

    valid = np.isfinite(lines.points[..., 0])
    line, point = np.nonzero(valid)
    q, along = lines.points[..., 2] * SCALE[2], lines.tangents[..., 2] * SCALE[2]
    broken, slope = np.full_like(q, np.nan), np.full_like(q, np.nan)
    broken[line, point], slope[line, point], _ = scene_batch.limits(lines.points[line, point, 0], owner[line])
    everything = np.arange(len(owner))
    # at a fold its own load is touched, not crossed
    own_load = folds.corrected.u[:, 2]
    of_fold, on = np.nonzero(owner[folds.line][:, None] == owner[None])
    at_load = q[on] - own_load[of_fold][:, None]
    same = on == folds.line[of_fold]
    at_load[same, folds.position[of_fold[same]].astype(int)] = np.nan
    zero, none = np.zeros(len(owner)), np.full(len(owner), -1)
    rows = [
        (q, along, everything, zero, ClosingEquation.level, none),
        (q - broken, along - slope * lines.tangents[..., 0], everything, zero, ClosingEquation.breakdown, none),
        (at_load, along[on], on, own_load[of_fold], ClosingEquation.level, of_fold),
    ]
    found, targets, kinds, sets, belongs = [], [], [], [], []
    for k, (values, rates, which, target, kind, of) in enumerate(rows):
        row, cross = lines.crossings(values, rates, which)
        found.append(cross)
        targets.append(target[row])
        kinds.append(np.full(len(row), kind))
        sets.append(np.full(len(row), k))
        belongs.append(of[row])
    places = Places(*(np.concatenate([getattr(p, n) for p in found]) for n in ("line", "interval", "share")))
    sets, belongs = np.concatenate(sets), np.concatenate(belongs)
    corrected = _meet_places(
        scene_batch, owner, lines, places, np.concatenate(targets), np.concatenate(kinds), tolerance
    )
    np.minimum.at(sure, places.line[~corrected.ok], places.interval[~corrected.ok].astype(float))
    # the load of a crossing is as wrong as its fold's, and where q hardly changes along the branch the place is vague
    vague = np.maximum(np.abs(corrected.u[:, 2]), 1e-3) * corrected.error
    crossing = sets == 2
    of = folds.corrected
    vague[crossing] += (of.error * np.maximum(np.abs(of.u[:, 2]), 1e-3))[belongs[crossing]]
    with np.errstate(all="ignore"):
        far = (
            np.abs(corrected.volume_rate / (corrected.tangent[:, 2] * SCALE[2]))
            * vague
            / np.maximum(np.abs(corrected.volume), 1e-3)
        )
    corrected = corrected._replace(spread=np.where(sets == 1, 0.0, far))
    # in the order of the states found: beside each other their guesses on the cubic may be in another
    begin, chord = (lines.points[places.line, places.interval + k] for k in (0, 1))
    chord = chord - begin
    share = ((corrected.u / SCALE - begin) * chord).sum(axis=1) / (chord**2).sum(axis=1)
    events = Events(places.line, places.interval + np.clip(share, 0.0, 1.0), corrected, belongs)
    kept = [events.take(np.flatnonzero(corrected.ok & (sets == k))) for k in range(3)]
    kept[0].corrected.u[:, 2] = 0.0
    return Assembly(lines, folds, kept[0], kept[1], kept[2], sure)


@dataclasses.dataclass
class Assembly:
    """Lines with their folds among the points, their events, and the positions beyond which something may be missing."""

    lines: Polylines
    folds: Events
    zeros: Events
    breaks: Events
    crossings: Events
    sure: np.ndarray


_SNAPS = 2


def _values(corrected: Corrected) -> np.ndarray:
    """States (states, 5), columns as in `States`."""
    return np.column_stack([corrected.u, corrected.volume, np.maximum(corrected.error, corrected.spread)])


def _along_lines(events: Events, start: np.ndarray | None, lines: int, count: int) -> np.ndarray:
    """Values (lines, 5, count) of the first events on every line, `start` (lines, 5) before them; NaN where there are fewer."""
    line, position, values = events.line, events.position, _values(events.corrected)
    if start is not None:
        own = np.flatnonzero(np.isfinite(start[:, 0]))
        line, position = np.concatenate([own, line]), np.concatenate([np.full(len(own), -1.0), position])
        values = np.concatenate([start[own], values])
    order = np.lexsort((position, line))
    rank = np.arange(len(line)) - np.searchsorted(line[order], line[order])
    which = order[rank < count]
    marks = np.full((lines, 5, count), np.nan)
    marks[line[which], :, rank[rank < count]] = values[which]
    return marks


class _Lists:
    """The events of an assembly as lists: of each kind their positions and values, those of a line, crossings of a fold."""

    def __init__(self, of: Assembly):
        self.positions, self.values, self.on_line, self.of_fold = {}, {}, {}, {}
        for kind in ("folds", "zeros", "breaks", "crossings"):
            events = getattr(of, kind)
            self.positions[kind], self.values[kind] = events.position.tolist(), _values(events.corrected)
            self.on_line[kind] = {}
            for i, line in enumerate(events.line.tolist()):
                self.on_line[kind].setdefault(line, []).append(i)
        for i, fold in enumerate(of.crossings.of_fold.tolist()):
            self.of_fold.setdefault(fold, []).append(i)


class _NotDecided(Exception):
    """The lines do not show how a ramp goes on."""


class _Place(typing.NamedTuple):
    """An event on a line, one of `kind` of an assembly; without a kind the start. `rises` is the side on which q does."""

    line: int
    position: float
    rises: int
    kind: str | None
    event: int


class _OnLines:
    """The events of one scene along its lines, for `follow`.

    `limits` are those of the membrane at the crossings, see `SceneBatch.limits`; `top` is the largest stretch of the window.
    """

    def __init__(self, of: Assembly, lists: _Lists, main: int, limits: np.ndarray, top: float):
        self.of, self.lists, self.main, self.limits, self.top = of, lists, main, limits, top
        self.start = _Place(main, 0.0, 1, None, -1)

    def next(self, kind: str, line: int, position: float, side: float) -> tuple[float, int | None]:
        """How far it is to the next event of a kind along a line, and its index; None where there is none."""
        at = self.lists.positions[kind]
        ahead = [(side * (at[i] - position), i) for i in self.lists.on_line[kind].get(line, ())]
        return min((near for near in ahead if near[0] > 1e-9), default=(np.inf, None))

    def next_stop(self, here: _Place, rising: bool) -> Stop:
        """The next fold, breakdown or zero voltage along the line of `here`."""
        line, position, rises, *_ = here
        side = float(rises if rising else -rises)
        other = "breaks" if rising else "zeros"
        (to_fold, fold), (to_other, stop) = (self.next(kind, line, position, side) for kind in ("folds", other))
        if fold is None and stop is None:
            if not rising and line == self.main and side < 0:  # back at the start
                return Stop(PointKind.zero_voltage, self.start, side)
            raise _NotDecided
        kind, event = ("folds", fold) if to_fold <= to_other else (other, stop)
        assert event is not None
        at = getattr(self.of, kind)
        if rising and at.corrected.u[event, 0] > self.top:
            raise _NotDecided
        named = {"folds": PointKind.fold, "breaks": PointKind.breakdown, "zeros": PointKind.zero_voltage}[kind]
        return Stop(named, _Place(line, float(at.position[event]), rises, kind, event), side)

    def landing(self, fold: Stop) -> _Place | None:
        """The stable state at a fold's load nearest in volume in the direction of the jump, on the lines of the scene."""
        corrected, crossings = self.of.folds.corrected, self.of.crossings
        event, found = fold.at.event, crossings.corrected
        way = fold.side * np.sign(corrected.volume_rate[event])
        jumps = [
            (way * (found.volume[i] - corrected.volume[event]), i)
            for i in self.lists.of_fold.get(event, ())
            if found.index[i] == 0 and found.u[i, 2] <= SCANNED_LOAD * self.limits[2, i]
        ]
        _, i = min((jump for jump in jumps if jump[0] > 0), default=(0.0, None))
        if i is None:
            return None
        rises = 1 if found.tangent[i, 2] > 0 else -1
        return _Place(int(crossings.line[i]), float(crossings.position[i]), rises, "crossings", i)

    def loss(self, here: _Place) -> str | None:
        """The lines of a batch are not asked for their modes."""
        return None

    def is_broken(self, landing: _Place) -> bool:
        """Whether a landing lies at breakdown or beyond, which nearest to it the lines do not show."""
        load, limit = self.of.crossings.corrected.u[landing.event, 2], self.limits[0, landing.event]
        if abs(load - limit) <= AMBIGUOUS_ON_LINES * limit:
            raise _NotDecided
        return bool(load >= limit)


class _Ramp:
    """The way up and down of one scene over the events of its lines, in the slots of `RampArrays`."""

    def __init__(self, lines: _OnLines, start: np.ndarray):
        self.lines = lines
        self.events = np.full((5, SLOTS), np.nan)
        self.events[:, Slot.start] = start
        self.snaps = 0
        self.broken_at: int | None = None
        self.last = 0.0  # position of the last event of the way up on the first line
        self.returns = False  # whether the way down was followed

    def is_sure(self) -> bool:
        """Whether nothing that the ramp says depends on a part of a line where an event may be missing.

        Where it breaks down, or snaps to no landing on its own lines, only the way to there counts.
        """
        sure = self.lines.of.sure[self.lines.main]
        return bool(np.isinf(sure)) if self.snaps > 1 or self.returns else bool(self.last < sure)

    def _put(self, slot: int, place: _Place) -> None:
        values = self.events[:, Slot.start] if place.kind is None else self.lines.lists.values[place.kind][place.event]
        self.events[:, slot] = values

    def _put_jumps(self, steps: list[Step], folds: slice, landings: slice) -> None:
        jumps = [step for step in steps if step.event in (RampEvent.snap, RampEvent.snap_back)]
        arrivals = [step for step in steps if step.event == RampEvent.landing]
        if len(jumps) > _SNAPS:
            raise _NotDecided
        for slots, those in ((folds, jumps), (landings, arrivals)):
            for slot, step in enumerate(those, slots.start):
                self._put(slot, step.at)

    def run(self) -> Outcome:
        """Follows the way up and returns how it ends; where it survives, also the way down."""
        try:
            return self._up()
        except _NotDecided:
            return Outcome.unresolved

    def _up(self) -> Outcome:
        steps = follow(self.lines, self.lines.start, rising=True, most=_SNAPS + 1)
        self._put_jumps(steps, Slot.snaps, Slot.landings)
        end = steps[-1]
        turns = [s.at for s in steps if s.event == RampEvent.snap]
        self.snaps = len(turns)
        outcome = ENDS.get(end.reason or "", Outcome.unresolved)
        if outcome == Outcome.breakdown_on_branch:
            self._put(Slot.breakdown, end.at)
            self.broken_at = end.at.event
            turns = [*turns, end.at]
        self.last = max((place.position for place in turns), default=0.0)
        if outcome == Outcome.breakdown_on_branch:
            self._down(steps)
        return outcome

    def _down(self, steps: list[Step]) -> None:
        """The way down from the last landing, if there is one."""
        landings = [s.at for s in steps if s.event == RampEvent.landing]
        if not landings:
            self.events[:, Slot.rest] = self.events[:, Slot.start]
            return
        self.returns = True
        steps = follow(self.lines, landings[-1], rising=False, most=_SNAPS + 1)
        if steps[-1].reason != "zero voltage":
            raise _NotDecided
        self._put_jumps(steps, Slot.snap_backs, Slot.landings_back)
        self._put(Slot.rest, steps[-1].at)

    def fold_ahead(self, fractions: np.ndarray, left: bool) -> FoldAhead:
        """Whether the line of a ramp that breaks without a snap has a fold further on, in the scanned window."""
        if self.broken_at is None or self.snaps:
            return FoldAhead.unknown
        lines, of = self.lines, self.lines.of
        _, fold = lines.next("folds", lines.main, float(of.breaks.position[self.broken_at]), 1)
        reached = np.inf if fold is None else float(of.folds.position[fold])
        if not (reached < of.sure[lines.main] or np.isinf(of.sure[lines.main])):
            return FoldAhead.unknown
        if fold is None:
            return FoldAhead.none if left else FoldAhead.unknown
        return FoldAhead.fold if fractions[fold] <= SCANNED_LOAD else FoldAhead.none


def ramps_on_lines(
    scene_batch: SceneBatch, owner: np.ndarray, of: Assembly, start: Corrected, ends: typing.Any
) -> RampArrays:
    """The ramps of scenes as far as their lines show them; the branch from the start of scene k is line k.

    `no_landing` means that no line of the scene has a landing. `ends.limits` (scenes, 5) are the windows, `ends.left` says of
    which scenes the line ends where it leaves the window.
    """
    scenes, lists, begin = len(ends.left), _Lists(of), _values(start)
    all_events = np.full((scenes, 5, SLOTS), np.nan)
    outcome, snaps = np.full(scenes, int(Outcome.unresolved)), np.zeros(scenes, int)
    ahead = np.full(scenes, int(FoldAhead.unknown))
    stable = start.ok & (start.index == 0)
    unstable = start.ok & ~stable
    outcome[unstable], all_events[unstable, :, Slot.start] = int(Outcome.start_unstable), begin[unstable]
    limits = scene_batch.limits(of.crossings.corrected.u[:, 0], owner[of.crossings.line])
    # the last step of a march may leave the window of the stretch: what lies there does not count
    limits[2, of.crossings.corrected.u[:, 0] > ends.limits[owner[of.crossings.line], 1]] = 0.0
    fold = owner[of.folds.line]
    fractions = of.folds.corrected.u[:, 2] / scene_batch.limits(of.folds.corrected.u[:, 0], fold)[2]
    fractions[of.folds.corrected.u[:, 0] > ends.limits[fold, 1]] = np.inf
    for k in np.flatnonzero(stable).tolist():
        ramp = _Ramp(_OnLines(of, lists, k, limits, float(ends.limits[k, 1])), begin[k])
        ended = ramp.run()
        if ended is not Outcome.unresolved and ramp.is_sure():
            all_events[k], outcome[k], snaps[k] = ramp.events, int(ended), ramp.snaps
            ahead[k] = int(ramp.fold_ahead(fractions, bool(ends.left[k])))
    begin = np.where(stable[:, None], begin, np.nan)
    marks = [
        _along_lines(events, begin if events is of.zeros else None, scenes, count)
        for events, count in zip((of.folds, of.zeros, of.breaks), LISTED.values(), strict=True)
    ]
    for mark in marks:  # where the start is unstable only the start is known
        mark[~stable] = np.nan
    folds, zeros, breaks = marks
    return RampArrays(all_events, folds, zeros, breaks, snaps, outcome, np.full((scenes, 2), np.nan), ahead)


def _spread(cells: np.ndarray) -> np.ndarray:
    """Cells (…, rows, columns) and their neighbours."""
    rows = cells.copy()
    rows[:, 1:] |= cells[:, :-1]
    rows[:, :-1] |= cells[:, 1:]
    both = rows.copy()
    both[..., 1:] |= rows[..., :-1]
    both[..., :-1] |= rows[..., 1:]
    return both


def have_others(membrane: Membrane, own: np.ndarray, scene_batch: SceneBatch, lines: Polylines) -> np.ndarray:
    """Which of the scenes `own`, all with one membrane, have a contour below breakdown away from their line."""
    found = np.zeros(len(own), bool)
    stretches, _, loads = Scene(membrane, ConstantVoltage(0.0)).limits()
    chart = cached_scan(membrane, stretches, loads)
    columns = np.flatnonzero(chart.load_fraction >= -0.02)[::OTHER_BRANCH_STRIDE]
    rows = np.arange(0, len(chart.apex_stretch), OTHER_BRANCH_STRIDE)
    apex, t = chart.apex_stretch[rows], chart.load_fraction[columns]
    p, v = (field[np.ix_(rows, columns)] for field in (chart.pressure, chart.volume))
    q = t * chart.largest_load[rows, None]
    breaks = scene_batch.limits(apex, np.full(len(apex), own[0]))[0]
    known = np.isfinite(p) & np.isfinite(v)
    known = known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]
    known &= (q[:-1, :-1] <= breaks[:-1, None]) & (t[:-1] >= 0)
    nodes = np.flatnonzero(_spread(np.pad(known, ((0, 1), (0, 1)))[None]))
    at_nodes = [field.ravel()[nodes] for field in (p, v, q)]
    for i in range(0, len(own), SCENES_TOGETHER):
        some = own[i : i + SCENES_TOGETHER]
        condition = jax.tree.map(lambda leaf: leaf[:, None], pick(scene_batch.condition, some))
        sign = np.zeros((len(some), *p.shape), bool)
        with np.errstate(invalid="ignore"):
            sign.reshape(len(some), -1)[:, nodes] = condition.residual(*at_nodes) < 0
        along, across = sign[..., 1:] ^ sign[..., :-1], sign[:, 1:] ^ sign[:, :-1]
        away = known & (along[:, 1:] | along[:, :-1] | across[..., 1:])
        for most in DENSE_POINTS:
            which = np.flatnonzero(away.any(axis=(1, 2)))
            if not len(which):
                break
            dense = lines.take(some[which]).dense(most) * SCALE
            there = np.isfinite(dense[..., 0])
            line, x = np.nonzero(there)[0], dense[there]
            limit = np.interp(x[:, 0], chart.apex_stretch, chart.largest_load)
            row = np.clip(np.searchsorted(apex, x[:, 0]) - 1, 0, len(apex) - 2)
            column = np.clip(np.searchsorted(t, x[:, 2] / limit) - 1, 0, len(t) - 2)
            near = np.zeros((len(which), *known.shape), bool)
            near[line, row, column] = True
            away[which] &= ~_spread(near)
        found[i : i + SCENES_TOGETHER] = away.any(axis=(1, 2))
    return found
