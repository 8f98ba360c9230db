"""The ramp of one loading on rows of a surface: the way up through snaps to breakdown, and the way down.

Written for one loading, to be vmapped; its events are told between rows and, where that is too rough, met on the surface.
"""

import jax
import jax.numpy as jnp
import numpy as np

from ..model import ClosingEquation, Outcome
from ..numerics import cached_jit
from ..surface import ROWS, Conditions, Rows, Surface
from .ramps import APEX, LOAD, SLOTS, Slot
from .row_points import ContourOnRows, Events, Marks, first_place, last_place, meet_on_surface

__all__ = ["corrector_program", "ramp_program", "snap_program"]

_SNAPS = 2
_MOST_ERROR = 1e-4  # between rows, of a ramp that is told
_AMBIGUOUS = 1e-8  # a snap or landing this near to breakdown is not told
_SOON = 20  # rows
_ULP = 2.3e-16


def _span(start: Events, plain):
    """The row of the start, and the first and last of the plain rows around it."""
    at = jnp.arange(ROWS)
    begin = jnp.where(start.seen(), start.place, 0.0).astype(int)
    hole, ends = first_place(~plain & (at > begin))
    last = jnp.where(ends, hole - 1, ROWS - 1)
    hole, begins = last_place(~plain & (at <= begin))
    return begin, jnp.where(begins, hole + 1, 0), last


def _ramp(rows: Rows, condition: Conditions, start: Events, q, v, found, again, above):
    """The ramp and special points of one loading from its q and V on the rows."""
    at = jnp.arange(ROWS)
    begin, first, last = _span(start, found & ~again)
    after = jnp.minimum(last + 1, ROWS - 1)
    marks = Marks.of(ContourOnRows(rows, q, v, first, last), ~found[after] & ~again[after] & above[after])
    folds, peak = marks.folds, marks.peak

    def breakdown_load(event):
        return rows.surface.breakdown_load(rows.apex_at(event.place))

    # the way up
    ahead = folds.after(start.place)
    climbs = jnp.where(ahead.seen(), jnp.any(peak & (folds.place == ahead.place)), q[last] > 0)
    nowhere = start.take((), False)
    moving, here, failure = climbs, start, nowhere
    lost = broken = jnp.asarray(False)
    doubt = ~ahead.seen() & (last <= begin)  # the contour leaves the surface before the next row
    snaps, landings = [], []
    for stage in range(_SNAPS + 1):
        index, turns = first_place((folds.place > here.place) & peak)
        snap, failing = folds.take(index, turns), marks.breaks.after(here.place)
        failure = failure.unless(moving, failing)
        snapping = moving & turns & (snap.place < failing.place)
        if stage == _SNAPS:
            doubt |= snapping
            break
        landing = marks.jumps.take(index, snapping)
        limit = breakdown_load(landing)
        for bound in (limit, breakdown_load(snap)):
            doubt |= snapping & (jnp.abs(snap.load - bound) <= _AMBIGUOUS * bound)
        doubt |= snapping & marks.rivalled[index]
        lost |= snapping & ~landing.seen()
        broken |= snapping & landing.seen() & (snap.load >= limit)
        snaps.append(nowhere.unless(snapping, snap))
        landings.append(landing)
        moving = snapping & landing.seen() & (snap.load < limit)
        here = here.unless(moving, landing)
    survives = climbs & ~lost & ~broken & failure.seen()
    failure = failure.take((), survives)
    doubt |= jnp.where(survives, failure.place, ROWS) > marks.unlisted
    # another branch further on matters where it may hold an unbroken state at the load of a snap without landing, on a
    # row or between two: a row without crossing has it above or below
    level = jnp.where(snaps[1].seen(), snaps[1].load, snaps[0].load)
    over = jnp.where(found, q > 1.02 * level, above) & ~again
    under = jnp.where(found, 1.02 * q < level, ~above) & ~again
    bearing = (rows.breakdown_load > level) & (at > last)
    beside = bearing[1:] | (bearing[:-1] & (at[1:] > last))
    apart = (over[1:] & over[:-1]) | (under[1:] & under[:-1]) | ~beside | (at[:-1] <= last)
    # so may the contour itself, where it leaves the surface unbroken, rises fast enough to be back at that load soon,
    # and would be so below breakdown
    rise = q[last] - q[jnp.maximum(last - 1, 0)]
    bearable = jnp.max(jnp.where(at >= last, rows.breakdown_load, 0.0))
    onward = (jnp.maximum(q[last], level) < bearable) & (_SOON * rise > level - q[last])
    lost &= jnp.all(apart) & ~onward

    # the way down, from the last landing
    descends = survives & snaps[0].seen()
    rest = start.take((), survives & ~snaps[0].seen())
    backs, returns = [], []
    for stage in range(_SNAPS + 1):
        index, turns = last_place((folds.place < here.place) & folds.seen() & ~peak)
        back, zero = folds.take(index, turns), marks.zeros.before(here.place)
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

    told = [start, *snaps, *landings, failure, *backs, *returns, rest]
    told = jax.tree.map(lambda *v: jnp.stack(v), *told)
    decided = ~climbs | lost | broken | survives
    fair = (
        start.seen()
        & decided
        & ~marks.hidden
        & ~doubt
        & (jnp.max(jnp.where(told.seen(), told.error, 0.0)) < _MOST_ERROR)
    )
    outcome = jnp.where(broken, int(Outcome.breakdown_in_snap), int(Outcome.breakdown_on_branch))
    outcome = jnp.where(lost, int(Outcome.no_landing), outcome)
    outcome = jnp.where(climbs, outcome, int(Outcome.start_unstable))
    outcome = jnp.where(fair, outcome, int(Outcome.unresolved))

    def points(events, known):
        there = events.seen() & known
        apex = rows.apex_at(jnp.where(there, events.place, 1.0))
        row = jnp.where(there, events.place, 0.0).astype(int)
        error = events.error + rows.surface.error_bound(apex, events.load) + rows.error[row] + _ULP * ROWS
        error = jnp.where(jnp.isnan(error), jnp.inf, error)
        values = jnp.stack([apex, condition.pressure(events.volume), events.load, events.volume])
        values = jnp.where(there & (error < _MOST_ERROR), values, jnp.nan)
        return jnp.concatenate([values, jnp.where(there, error, jnp.nan)[None]])

    return (
        points(told, fair),
        [points(e, start.seen()) for e in (folds, marks.zeros, marks.breaks)],
        jnp.where(fair, sum(s.seen().astype(int) for s in snaps), 0),
        outcome,
        # folds show on three rows
        jnp.where(start.seen(), rows.apex_stretch[jnp.stack([first + 1, last - 1])], jnp.nan),
    )


@cached_jit
def ramp_program(rows: Rows, start: Events, conditions: Conditions, q, v, found, again, above):
    """Many loadings: their events (loadings, 5, 11), special points (loadings, 5, count), snaps, outcomes, reach."""
    return jax.vmap(_ramp, in_axes=(None, 0, 0, 1, 1, 1, 1, 1))(rows, conditions, start, q, v, found, again, above)


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
    fair = start.seen() & turns & (q[begin + 1] > 0) & ~jnp.any(slow) & (error < _MOST_ERROR)
    met, size = meet_on_surface(rows.surface, condition, ClosingEquation.fold, 0.0, rows.apex_at(place), load)
    bound = rows.surface.error_bound(met[APEX], met[LOAD]) + jnp.where(size < 1e-6, size**2, jnp.inf)
    fair &= bound < _MOST_ERROR
    apex = rows.apex_at(start.place)
    zero = rows.surface.error_bound(apex, 0.0) + start.error
    pressure = condition.pressure(start.volume)
    return jnp.where(
        fair, jnp.stack([jnp.stack([apex, pressure, 0.0 * apex, start.volume, zero]), jnp.append(met, bound)]), jnp.nan
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
def corrector_program(surface: Surface, conditions: Conditions, told):
    """The events (lanes, 5, 11) of some ramps met on the surface."""

    def one(condition, told):
        def meet_all(_, told):
            targets = jnp.zeros(len(_KINDS)).at[_JUMPS].set(told[LOAD, _FROM])
            correct = jax.vmap(lambda *v: meet_on_surface(surface, condition, *v))
            found, size = correct(jnp.asarray(_KINDS), targets, told[APEX], told[LOAD])
            bound = surface.error_bound(found[:, APEX], found[:, LOAD]) + jnp.where(size < 1e-6, size**2, jnp.inf)
            return jnp.concatenate([found, jnp.where(jnp.isnan(told[APEX]), jnp.nan, bound)[:, None]], axis=1).T

        return jax.lax.fori_loop(0, 2, meet_all, told)  # first the folds, then the jumps from them

    return jax.vmap(one)(conditions, told)
