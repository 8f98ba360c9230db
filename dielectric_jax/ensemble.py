"""Ramps of many chambers, or pressures, on one membrane's surface: all their special points and events, nothing stepped.

A loading crosses each row of λa at one load (`rows`), so that its contour is q(λa) on even rows: folds are the extremes of
the polynomial through ten rows, zero-voltage states its zeros, breakdown where it meets q_b(λa), landings where it meets
the fold's q again. Where a row shows several crossings the contour ends; a ramp that is not decided by then, or by the
edge of the surface's domain, is left to `voltage_volume`: its outcome says so, and its numbers are NaN.
"""

import enum
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .kept import kept_jit
from .marks import LEVEL, ContourOnRows, Events, Marks, first_place, last_place
from .programs import threads
from .results import check_positive
from .rows import ROWS, Conditions, Rows, crossings, rows_of
from .surface import ById, Surface

__all__ = ["Curves", "Outcome", "Point", "Ramps", "chamber_curves", "chamber_ramps", "pressure_ramps"]

_CHUNK = 256
_SNAPS = 2
_MOST_ERROR = 1e-7  # of a ramp that is told
_AMBIGUOUS = 1e-8  # a snap or landing this near to breakdown is not told
_ULP = 2.3e-16


class Outcome(enum.IntEnum):
    """How a ramp up ends, as `Ramps.outcome` holds it."""

    breakdown_on_branch = 0
    breakdown_in_snap = 1
    no_unbroken_landing = 2  # no landing, or one at a load more than a fifth above breakdown
    start_unstable = 3
    unresolved = 4  # ask `voltage_volume` for this loading


class Point(typing.NamedTuple):
    """States of many loadings, arrays of one shape; NaN where there is none, and for the voltage of q < 0."""

    apex_stretch: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    voltage: np.ndarray


class Ramps(typing.NamedTuple):
    """Ramps of many loadings; NaN where there is no such event.

    The arrays have the shape of the loadings; those of `snap`, `landing`, `snap_back` and `landing_back` have a last axis
    more, of two, for ramps that snap twice. The way up: `start`, `snaps` snaps with their landings (`landing_ratio` is
    E/E_EB there), `breakdown`; `area_strain` is (λa at breakdown / λa at the start)² − 1, with breakdown in the snap that of
    the last unbroken state. The way down from the last landing: `snap_backs`, and `rest`, the zero-voltage state in which it
    ends. `error` bounds the relative error of the voltages and volumes of the ramp.

    Special points of the contour through the start, by rising λa along a last axis: `folds` (of q, six), `zero_voltage`
    (five), `breakdowns` (three), as far as the surface reaches.
    """

    start: Point
    snap: Point
    landing: Point
    landing_ratio: np.ndarray
    breakdown: Point
    area_strain: np.ndarray
    snaps: np.ndarray
    snap_back: Point
    landing_back: Point
    rest: Point
    folds: Point
    zero_voltage: Point
    breakdowns: Point
    outcome: np.ndarray
    error: np.ndarray


class Curves(typing.NamedTuple):
    """Voltage–volume curves of many loadings at common apex stretches (256,); the others are (loadings…, 256).

    NaN where the surface holds no state, or several at one λa (then `several` is True).
    """

    apex_stretch: np.ndarray
    voltage_squared: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    several: np.ndarray


def _ramp(rows: Rows, condition: Conditions, start: Events, q, v, found, again):
    """The ramp and special points of one loading from its q and V on the rows."""
    at = jnp.arange(ROWS)
    plain = found & ~again
    begin = jnp.where(start.seen(), start.place, 0.0).astype(int)
    hole, ends = first_place(~plain & (at > begin))
    last = jnp.where(ends, hole - 1, ROWS - 1)
    hole, begins = last_place(~plain & (at <= begin))
    first = jnp.where(begins, hole + 1, 0)
    marks = Marks.of(ContourOnRows(rows, q, v, first, last))
    folds, peak = marks.folds, marks.peak

    def breakdown_load(event):
        return rows.surface.breakdown_load(rows.apex_at(event.place))

    # the way up
    ahead = folds.after(start.place)
    climbs = jnp.where(ahead.seen(), jnp.any(peak & (folds.place == ahead.place)), q[last] > 0)
    nowhere = start.take((), False)
    moving, here, failure = climbs, start, nowhere
    lost = broken = doubt = jnp.asarray(False)
    snaps, landings, ratios = [], [], []
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
        ratios.append(jnp.sqrt(snap.load / limit))
        moving = snapping & landing.seen() & (snap.load < limit)
        here = here.unless(moving, landing)
    survives = climbs & ~lost & ~broken & failure.seen()
    failure = failure.take((), survives)
    doubt |= jnp.where(survives, failure.place, ROWS) > marks.unlisted
    # another branch further on matters where it may hold a state at the load of a snap without landing
    level = jnp.where(snaps[1].seen(), snaps[1].load, snaps[0].load)
    other = (at > last) & (found | again)
    above, below = (jnp.all(~other | (plain & way)) for way in (q > 1.02 * level, 1.02 * q < level))
    lost &= above | below

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
    bound = rows.surface.error_bound(rows.apex_at(told.place), told.load)
    error = jnp.max(jnp.where(told.seen(), told.error + bound, 0.0)) + rows.error[begin] + _ULP * ROWS
    decided = ~climbs | lost | broken | survives
    fair = start.seen() & decided & ~marks.hidden & ~doubt & (error < _MOST_ERROR)
    outcome = jnp.where(broken, int(Outcome.breakdown_in_snap), int(Outcome.breakdown_on_branch))
    outcome = jnp.where(lost, int(Outcome.no_unbroken_landing), outcome)
    outcome = jnp.where(climbs, outcome, int(Outcome.start_unstable))
    outcome = jnp.where(fair, outcome, int(Outcome.unresolved))

    def points(events, known):
        seen = events.seen() & known
        apex = rows.apex_at(jnp.where(events.seen(), events.place, 1.0))
        voltage = jnp.where(events.load >= 0, jnp.sqrt(jnp.maximum(events.load, 0.0)), jnp.nan)
        values = apex, condition.pressure(events.volume), events.volume, voltage
        return jnp.where(seen, jnp.stack(values), jnp.nan)

    final = jnp.where(survives, failure.place, jnp.where(snaps[1].seen(), snaps[1].place, snaps[0].place))
    final = rows.apex_at(jnp.where(jnp.isfinite(final), final, 1.0))
    strain = jnp.where(fair & climbs, (final / rows.apex_at(start.place)) ** 2 - 1, jnp.nan)
    return (
        points(told, fair),
        [points(e, start.seen()) for e in (folds, marks.zeros, marks.breaks)],
        jnp.where(fair & jnp.stack([e.seen() for e in landings]), jnp.stack(ratios), jnp.nan),
        strain,
        jnp.where(fair, sum(s.seen().astype(int) for s in snaps), 0),
        outcome,
        jnp.where(fair, error, jnp.nan),
    )


def _start(rows: Rows, values, others, target):
    """Where the state at zero voltage first reaches a volume (or pressure), among its values on the rows."""
    reached, any_ = first_place(values >= target)
    present = any_ & (reached > 0)
    whole = ContourOnRows(rows, values, others, jnp.asarray(0), jnp.asarray(ROWS - 1))
    place, value, other, error = whole.meet(jnp.maximum(reached - 1, 0), LEVEL, target)
    return Events(jnp.where(present, place, jnp.inf), value, other, error)


def _conditions(rows: Rows, lanes, kind: str):
    """The starts and conditions of a chunk of chambers (V_C, V_0, p_atm, n), or of pressures."""
    if kind == "pressure":
        (pressure,) = lanes
        start = jax.vmap(lambda p: _start(rows, rows.flat_pressure, rows.flat_volume, p))(pressure)
        one, zero = jnp.ones_like(pressure), jnp.zeros_like(pressure)
        conditions = Conditions(zero, one, pressure, zero, one, polytropic=False)
        return Events(start.place, zero, start.volume, start.error), conditions
    chamber, filling, outside, exponent = lanes
    start = jax.vmap(lambda v: _start(rows, rows.flat_volume, rows.flat_pressure, v))(filling)
    pressure = jnp.where(jnp.isfinite(start.place), start.volume, jnp.nan)  # the other value of a start is its pressure
    given = jnp.ones_like(chamber), chamber, jnp.ones_like(chamber), outside, exponent
    conditions = Conditions(*given, polytropic=kind == "polytropic")
    constant = (pressure + outside) * conditions.power(filling + chamber)[0]
    conditions = eqx.tree_at(lambda c: c.constant, conditions, constant)
    return Events(start.place, jnp.zeros_like(filling), filling, start.error), conditions


def _crossing_program(kind: str):
    def crossings_of(rows, lanes):
        start, conditions = _conditions(rows, lanes, kind)
        q, v, found, again = crossings(rows, conditions)
        return jax.tree.leaves(start), jax.tree.leaves(conditions), (q, conditions.pressure(v), v, found, again)

    crossings_of.__name__ = f"crossings_{kind}"
    return kept_jit(crossings_of)


_CROSSINGS = {kind: _crossing_program(kind) for kind in ("isothermal", "polytropic", "pressure")}


# a program of its own: fused with the crossings it would find them anew for every use
@kept_jit
def _ramp_program(rows: Rows, start: Events, conditions: Conditions, q, v, found, again):
    return jax.vmap(_ramp, in_axes=(None, 0, 0, 1, 1, 1, 1))(rows, conditions, start, q, v, found, again)


def _ramps_chunk(rows: Rows, lanes, kind: str):
    start, conditions, crossed = _CROSSINGS[kind](rows, lanes)
    q, _, *rest = crossed
    return _ramp_program(rows, Events(*start), Conditions(*conditions, polytropic=kind == "polytropic"), q, *rest)


def _curves_chunk(rows: Rows, lanes, kind: str):
    return _CROSSINGS[kind](rows, lanes)[2]


def _run(chunk, surface: Surface, columns: list[np.ndarray], kind: str, axis: int):
    """`chunk` on many loadings, some at a time on all cores: arrays with the shape of the loadings first.

    `axis` is where the results of `chunk` count the loadings.
    """
    shape, rows = columns[0].shape, rows_of(ById(surface))
    flat = [values.ravel() for values in columns]
    count = flat[0].size

    def work(i):
        part = tuple(np.pad(v[i : i + _CHUNK], (0, max(0, i + _CHUNK - v.size)), mode="edge") for v in flat)
        return jax.tree.map(np.asarray, chunk(rows, part, kind))

    begins = range(0, count, _CHUNK)
    parts = [work(0), *threads().map(work, begins[1:])]  # the first alone: it compiles

    def join(*v):
        whole = np.moveaxis(np.concatenate(v, axis), axis, 0)[:count]
        return whole.reshape(*shape, *whole.shape[1:])

    return jax.tree.map(join, *parts)


def _chambers(surface, chamber_volume, initial_volume, atmospheric_pressure, polytropic_exponent):
    """The columns of chambers, checked, and the kind of program they need."""
    given = {"chamber_volume": chamber_volume, "initial_volume": initial_volume}
    given |= {"atmospheric_pressure": atmospheric_pressure, "polytropic_exponent": polytropic_exponent}
    columns = _columns(surface, given)
    return columns, "isothermal" if np.all(columns[3] == 1) else "polytropic"


def _columns(surface, given: dict) -> list[np.ndarray]:
    if not isinstance(surface, Surface):
        raise ValueError(f"`surface` must be a Surface, but is a {type(surface).__name__}.")
    columns = dict(zip(given, np.broadcast_arrays(*(np.asarray(v, float) for v in given.values())), strict=True))
    for name, values in columns.items():
        if not values.size:
            raise ValueError(f"`{name}` must hold at least one loading, but is empty.")
        wrong = ~(np.isfinite(values) & ((values > 0) | ((values == 0) & (name == "atmospheric_pressure"))))
        if wrong.any():
            check_positive(name, float(values[wrong].flat[0]), zero=name == "atmospheric_pressure")
    return list(columns.values())


def _ramps_of(told, marks, landing_ratio, area_strain, snaps, outcome, error) -> Ramps:
    """The answer of the program, by names; points have an axis of λa, p, V, Φ, then one of events."""
    one, pair = (
        (lambda k: Point(*np.moveaxis(told[..., k], -1, 0))),
        (lambda k: Point(*np.moveaxis(told[..., k : k + 2], -2, 0))),
    )
    folds, zeros, breaks = (Point(*np.moveaxis(m, -2, 0)) for m in marks)
    return Ramps(
        start=one(0),
        snap=pair(1),
        landing=pair(3),
        landing_ratio=landing_ratio,
        breakdown=one(5),
        area_strain=area_strain,
        snaps=snaps,
        snap_back=pair(6),
        landing_back=pair(8),
        rest=one(10),
        folds=folds,
        zero_voltage=zeros,
        breakdowns=breaks,
        outcome=outcome,
        error=error,
    )


def chamber_ramps(
    surface: Surface, chamber_volume, initial_volume, *, atmospheric_pressure=50.0, polytropic_exponent=1.0
) -> Ramps:
    """The ramps, up and down, of every chamber in arrays of one shape (or numbers, broadcast), on a membrane's surface.

    Chambers that the surface alone does not decide have outcome `Outcome.unresolved` and NaN; `voltage_volume` decides
    them. Raises ValueError for numbers that are not positive and finite.

    >>> from dielectric_jax import Membrane
    >>> ramps = chamber_ramps(Surface.build(Membrane()), [800.0, 1600.0], 2.42)
    >>> [round(float(v), 9) for v in ramps.snap.voltage[:, 0]]
    [0.097199007, 0.07649536]
    >>> round(float(ramps.area_strain[1]), 4)
    16.1219
    """
    given = chamber_volume, initial_volume, atmospheric_pressure, polytropic_exponent
    columns, kind = _chambers(surface, *given)
    return _ramps_of(*_run(_ramps_chunk, surface, columns, kind, 0))


def pressure_ramps(surface: Surface, pressure) -> Ramps:
    """The ramps at constant pressures, from the state at zero voltage of the smallest volume; as `chamber_ramps`.

    >>> from dielectric_jax import Membrane
    >>> ramps = pressure_ramps(Surface.build(Membrane()), [1.0, 1.82])
    >>> ramps.outcome.tolist() == [Outcome.no_unbroken_landing] * 2
    True
    """
    return _ramps_of(*_run(_ramps_chunk, surface, _columns(surface, {"pressure": pressure}), "pressure", 0))


def chamber_curves(
    surface: Surface, chamber_volume, initial_volume, *, atmospheric_pressure=50.0, polytropic_exponent=1.0
) -> Curves:
    """Voltage–volume curves of every chamber at the 256 apex stretches of the surface's rows; as `chamber_ramps`.

    >>> from dielectric_jax import Membrane
    >>> curves = chamber_curves(Surface.build(Membrane()), [800.0, 1600.0], 2.42)
    >>> curves.voltage_squared.shape
    (2, 256)
    """
    given = chamber_volume, initial_volume, atmospheric_pressure, polytropic_exponent
    columns, kind = _chambers(surface, *given)
    q, p, v, found, again = _run(_curves_chunk, surface, columns, kind, 1)
    for values in (q, p, v):
        values[~found | again] = np.nan
    return Curves(np.asarray(rows_of(ById(surface)).apex_stretch), q, p, v, again)
