"""The ramp of one loading on rows of a surface: the way up through snaps to breakdown, and the way down.

Written for one loading, to be vmapped; its events are known between rows and, where that is too rough, corrected on the surface.
"""

import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..model import ClosingEquation, Outcome
from ..numerics import cached_jit
from ..surface import ROWS, Conditions, Rows, Surface
from .ramps import APEX, LOAD, SLOTS, Slot
from .resolution import AMBIGUOUS_ON_ROWS, MOST_ROW_ERROR, SOON
from .row_points import ContourOnRows, Events, Marks, event_on_surface, first_place, last_place

__all__ = ["Crossed", "corrector_program", "ramp_program", "snap_program"]

_SNAPS = 2
_ULP = 2.3e-16


def _span(start: Events, plain):
    """The row of the start, and the first and last of the plain rows around it."""
    at = jnp.arange(ROWS)
    begin = jnp.where(start.seen(), start.place, 0.0).astype(int)
    hole, ends = first_place(~plain & (at > begin))
    last = jnp.where(ends, hole - 1, ROWS - 1)
    hole, begins = last_place(~plain & (at <= begin))
    return begin, jnp.where(begins, hole + 1, 0), last


class Crossed(typing.NamedTuple):
    """Where rows meet a loading's condition: q and V, whether there is a crossing, another one, and where none is, on which side."""

    q: typing.Any
    v: typing.Any
    found: typing.Any
    again: typing.Any
    above: typing.Any

    @property
    def plain(self):
        """The rows with one crossing."""
        return self.found & ~self.again


class _Way(typing.NamedTuple):
    """A way along the branch: its snaps and landings, where it is at last, how it ends, and whether that is in doubt."""

    folds: list[Events]
    landings: list[Events]
    here: Events
    end: Events
    lost: typing.Any  # a snap without landing
    broken: typing.Any  # a landing beyond breakdown
    doubt: typing.Any


def _way_up(rows: Rows, marks: Marks, start: Events, climbs) -> _Way:
    """From the start over maxima of q, each with a jump, to breakdown."""

    def breakdown_load(event):
        return rows.surface.breakdown_load(rows.apex_at(event.place))

    nowhere = start.take((), False)
    moving, here, failure = climbs, start, nowhere
    lost = broken = doubt = jnp.asarray(False)
    snaps, landings = [], []
    for stage in range(_SNAPS + 1):
        index, turns = first_place((marks.folds.place > here.place) & marks.peak)
        snap, failing = marks.folds.take(index, turns), marks.breaks.after(here.place)
        failure = failure.unless(moving, failing)
        snapping = moving & turns & (snap.place < failing.place)
        if stage == _SNAPS:
            doubt |= snapping
            break
        landing = marks.jumps.take(index, snapping)
        limit = breakdown_load(landing)
        for bound in (limit, breakdown_load(snap)):
            doubt |= snapping & (jnp.abs(snap.load - bound) <= AMBIGUOUS_ON_ROWS * bound)
        doubt |= snapping & marks.rivalled[index]
        lost |= snapping & ~landing.seen()
        broken |= snapping & landing.seen() & (snap.load >= limit)
        snaps.append(nowhere.unless(snapping, snap))
        landings.append(landing)
        moving = snapping & landing.seen() & (snap.load < limit)
        here = here.unless(moving, landing)
    return _Way(snaps, landings, here, failure, lost, broken, doubt)


def _way_down(marks: Marks, here: Events, descends, rest: Events) -> _Way:
    """From the last landing over minima of q, each with a jump, to the zero-voltage state; else `rest`."""
    nowhere, doubt = here.take((), False), jnp.asarray(False)
    backs, returns = [], []
    for stage in range(_SNAPS + 1):
        index, turns = last_place((marks.folds.place < here.place) & marks.folds.seen() & ~marks.peak)
        back, zero = marks.folds.take(index, turns), marks.zeros.before(here.place)
        backing = descends & turns & (back.place > jnp.where(zero.seen(), zero.place, -1.0))
        rest = rest.unless(descends & ~backing, zero)
        doubt |= descends & ~backing & ~zero.seen()
        if stage == _SNAPS:
            doubt |= backing
            break
        landing = marks.jumps.take(index, backing)
        doubt |= backing & (~landing.seen() | marks.rivalled[index])
        backs.append(nowhere.unless(backing, back))
        returns.append(landing)
        descends = backing & landing.seen()
        here = here.unless(descends, landing)
    return _Way(backs, returns, here, rest, False, False, doubt)


def _surely_lost(rows: Rows, crossed: Crossed, last, level):
    """Whether no unbroken state at the load of a snap without landing, `level`, lies further on.

    Another branch may hold one, on a row or between two: a row without crossing has it above or below. So may the branch
    itself, where it leaves the surface unbroken, rises fast enough to be back at that load soon, and would be so below
    breakdown.
    """
    q, found, again, above = crossed.q, crossed.found, crossed.again, crossed.above
    at = jnp.arange(ROWS)
    over = jnp.where(found, q > 1.02 * level, above) & ~again
    under = jnp.where(found, 1.02 * q < level, ~above) & ~again
    bearing = (rows.breakdown_load > level) & (at > last)
    beside = bearing[1:] | (bearing[:-1] & (at[1:] > last))
    apart = (over[1:] & over[:-1]) | (under[1:] & under[:-1]) | ~beside | (at[:-1] <= last)
    rise = q[last] - q[jnp.maximum(last - 1, 0)]
    bearable = jnp.max(jnp.where(at >= last, rows.breakdown_load, 0.0))
    onward = (jnp.maximum(q[last], level) < bearable) & (SOON * rise > level - q[last])
    return jnp.all(apart) & ~onward


def _states_at(rows: Rows, condition: Conditions, events: Events, known):
    """Events as columns (5, events), in the order of `States`; NaN where there is none, or its error is too large."""
    there = events.seen() & known
    apex = rows.apex_at(jnp.where(there, events.place, 1.0))
    row = jnp.where(there, events.place, 0.0).astype(int)
    error = events.error + rows.surface.error_bound(apex, events.load) + rows.error[row] + _ULP * ROWS
    error = jnp.where(jnp.isnan(error), jnp.inf, error)
    values = jnp.stack([apex, condition.pressure(events.volume), events.load, events.volume])
    values = jnp.where(there & (error < MOST_ROW_ERROR), values, jnp.nan)
    return jnp.concatenate([values, jnp.where(there, error, jnp.nan)[None]])


def _ramp(rows: Rows, condition: Conditions, start: Events, crossed: Crossed):
    """The ramp and special points of one loading from its q and V on the rows."""
    begin, first, last = _span(start, crossed.plain)
    after = jnp.minimum(last + 1, ROWS - 1)
    contour = ContourOnRows(rows, crossed.q, crossed.v, first, last)
    marks = Marks.of(contour, ~crossed.found[after] & ~crossed.again[after] & crossed.above[after])
    ahead = marks.folds.after(start.place)
    climbs = jnp.where(ahead.seen(), jnp.any(marks.peak & (marks.folds.place == ahead.place)), crossed.q[last] > 0)
    up = _way_up(rows, marks, start, climbs)
    survives = climbs & ~up.lost & ~up.broken & up.end.seen()
    failure = up.end.take((), survives)
    snaps = up.folds
    level = jnp.where(snaps[1].seen(), snaps[1].load, snaps[0].load)
    lost = up.lost & _surely_lost(rows, crossed, last, level)
    down = _way_down(marks, up.here, survives & snaps[0].seen(), start.take((), survives & ~snaps[0].seen()))
    doubt = ~ahead.seen() & (last <= begin)  # the branch leaves the surface before the next row
    doubt |= up.doubt | down.doubt | (jnp.where(survives, failure.place, ROWS) > marks.unlisted)

    listed = [start, *snaps, *up.landings, failure, *down.folds, *down.landings, down.end]
    events = jax.tree.map(lambda *v: jnp.stack(v), *listed)
    decided = ~climbs | lost | up.broken | survives
    largest = jnp.max(jnp.where(events.seen(), events.error, 0.0))
    fair = start.seen() & decided & ~marks.hidden & ~doubt & (largest < MOST_ROW_ERROR)
    outcome = jnp.where(up.broken, int(Outcome.breakdown_in_snap), int(Outcome.breakdown_on_branch))
    outcome = jnp.where(lost, int(Outcome.no_landing), outcome)
    outcome = jnp.where(climbs, outcome, int(Outcome.start_unstable))
    outcome = jnp.where(fair, outcome, int(Outcome.unresolved))
    return (
        _states_at(rows, condition, events, fair),
        [_states_at(rows, condition, e, start.seen()) for e in (marks.folds, marks.zeros, marks.breaks)],
        jnp.where(fair, sum(s.seen().astype(int) for s in snaps), 0),
        outcome,
        # folds show on three rows
        jnp.where(start.seen(), rows.apex_stretch[jnp.stack([first + 1, last - 1])], jnp.nan),
    )


@cached_jit
def ramp_program(rows: Rows, start: Events, conditions: Conditions, crossed: Crossed):
    """Many loadings: their events (loadings, 5, 11), special points (loadings, 5, count), snaps, outcomes, reach."""
    return jax.vmap(_ramp, in_axes=(None, 0, 0, 1))(rows, conditions, start, crossed)


def _snap(rows: Rows, condition: Conditions, start: Events, q, v, found, again):
    """The start and the first fold of one loading, columns as in `States`, found on the surface; NaN where not decided.

    Decided is a contour that rises from its start on plain rows to a maximum, without another dip on the way.
    """
    at = jnp.arange(ROWS)
    begin, first, last = _span(start, found & ~again)
    contour = ContourOnRows(rows, q, v, first, last)
    rise = q[1:] - q[:-1]
    row, turns = first_place((at[1:-1] > begin) & (at[1:-1] < last) & (rise[:-1] > 0) & (rise[1:] <= 0))
    row = row + 1
    place, load, _, error = contour.correct(row, ClosingEquation.fold, 0.0)
    way = (at[:-1] > begin) & (at[:-1] < row)
    # a slow rise amid faster ones may hide two folds
    slow = way[1:-1] & (rise[1:-1] < rise[:-2]) & (rise[1:-1] < rise[2:]) & (at[1:-2] < row - 1)
    fair = start.seen() & turns & (q[begin + 1] > 0) & ~jnp.any(slow) & (error < MOST_ROW_ERROR)
    fold, size = event_on_surface(rows.surface, condition, ClosingEquation.fold, 0.0, rows.apex_at(place), load)
    bound = rows.surface.error_bound(fold[APEX], fold[LOAD]) + jnp.where(size < 1e-6, size**2, jnp.inf)
    fair &= bound < MOST_ROW_ERROR
    apex = rows.apex_at(start.place)
    zero = rows.surface.error_bound(apex, 0.0) + start.error
    pressure = condition.pressure(start.volume)
    return jnp.where(
        fair, jnp.stack([jnp.stack([apex, pressure, 0.0 * apex, start.volume, zero]), jnp.append(fold, bound)]), jnp.nan
    )


@cached_jit
def snap_program(rows: Rows, start: Events, conditions: Conditions, q, v, found, again):
    """`_snap` of many loadings: (loadings, 2, 5)."""
    return jax.vmap(_snap, in_axes=(None, 0, 0, 1, 1, 1, 1))(rows, conditions, start, q, v, found, again)


_KINDS = np.full(SLOTS, ClosingEquation.level)
_KINDS[Slot.snaps] = _KINDS[Slot.snap_backs] = ClosingEquation.fold
_KINDS[Slot.breakdown] = ClosingEquation.breakdown
_SLOT = np.arange(SLOTS)
_JUMPS = np.concatenate([_SLOT[Slot.landings], _SLOT[Slot.landings_back]])
_FROM = np.concatenate([_SLOT[Slot.snaps], _SLOT[Slot.snap_backs]])


@cached_jit
def corrector_program(surface: Surface, conditions: Conditions, events):
    """The events (ramps, 5, `SLOTS`) of some ramps, corrected on the surface itself."""

    def one(condition, events):
        def correct_all(_, events):
            targets = jnp.zeros(len(_KINDS)).at[_JUMPS].set(events[LOAD, _FROM])
            correct = jax.vmap(lambda *v: event_on_surface(surface, condition, *v))
            found, size = correct(jnp.asarray(_KINDS), targets, events[APEX], events[LOAD])
            bound = surface.error_bound(found[:, APEX], found[:, LOAD]) + jnp.where(size < 1e-6, size**2, jnp.inf)
            return jnp.concatenate([found, jnp.where(jnp.isnan(events[APEX]), jnp.nan, bound)[:, None]], axis=1).T

        return jax.lax.fori_loop(0, 2, correct_all, events)  # first the folds, then the jumps from them

    return jax.vmap(one)(conditions, events)
