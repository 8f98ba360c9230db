"""Ramps of many chambers on one membrane's surface: start, snap, landing, breakdown and area strain, nothing stepped.

A chamber draws one contour on the chart. On a fixed table of the surface (stretches × loads) its condition
p − p_gas(V) changes sign once in every row while the contour is a function t(λa); the folds of q along it, the landing and
the breakdown are then roots on the surface, met by Newton. Where a row shows several crossings, or none before breakdown,
or two folds nearly merge, the chamber is left to `voltage_volume`: its code says so, and its numbers are NaN.
"""

import enum
import functools
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .loading import Contour
from .materials import largest_load
from .programs import threads
from .results import check_positive
from .surface import ById, Surface

__all__ = ["Outcome", "Ramps", "chamber_ramps"]

_ROWS, _LOADS = 256, 48
_CHUNK = 256
_NEWTON = 6
_MERGING = 2e-3  # a slope of q between rows below this share of its typical size may hide two folds


class Outcome(enum.IntEnum):
    """How a ramp up ends, as `Ramps.outcome` holds it."""

    breakdown_on_branch = 0
    breakdown_in_snap = 1
    no_unbroken_landing = 2  # no landing, or one at more than the domain's margin above breakdown
    start_unstable = 3
    unresolved = 4  # ask `voltage_volume` for this chamber


class Ramps(typing.NamedTuple):
    """Ramps up of many chambers, arrays of one shape (chambers,); NaN where there is no such event.

    A point holds apex stretch, pressure, volume and voltage; `snap` and `landing` belong to the snap, `snaps`
    is 1 where there is one, else 0 (a ramp with two snaps is left unresolved). `area_strain` is (λa at breakdown / λa at the start)² − 1, or with breakdown in the snap that of the last
    unbroken state. `error` bounds the relative error of the voltages and volumes.
    """

    start: "Point"
    snap: "Point"
    landing: "Point"
    landing_ratio: np.ndarray
    breakdown: "Point"
    area_strain: np.ndarray
    snaps: np.ndarray
    outcome: np.ndarray
    error: np.ndarray


class Point(typing.NamedTuple):
    """States of many chambers, arrays (chambers,)."""

    apex_stretch: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    voltage: np.ndarray


class _Table(eqx.Module):
    """p, V and q of the surface at rows of λa × loads (rows, loads), q_max and the breakdown load of each row."""

    apex: jax.Array
    load: jax.Array
    pressure: jax.Array
    volume: jax.Array
    limit: jax.Array
    broken: jax.Array


@functools.lru_cache(maxsize=16)
def _table_of(key: ById) -> _Table:
    surface = key.value
    rim, high = float(surface.membrane.prestretch), float(surface.apex_edges[-1])
    # rows crowd towards the flat end
    apex = rim + (high - rim) * np.linspace(0.003, 1.0 - 1e-9, _ROWS) ** 2
    boxes = np.asarray(surface.boxes)
    tops = np.array([boxes[(boxes[:, 0] <= a) & (a <= boxes[:, 1]), 3].max(initial=0.0) for a in apex])
    share = np.linspace(0.0, 1.0, _LOADS)
    bottom = float(surface.load_edges[0])
    load = bottom + (tops - bottom)[:, None] * share * (1 - 1e-12)
    p, v = jax.jit(lambda s, a, t: s.at_load_fraction(a, t, ("pressure", "volume")))(surface, apex[:, None], load)
    limit = largest_load(surface.membrane.material, apex)
    return _Table(jnp.asarray(apex), jnp.asarray(load), p, v, limit, surface.breakdown_load(apex))


def _newton(function, start, valid, room: typing.Any = jnp.inf):
    """Newton for function(x) = 0 in two unknowns; returns x and the size of the last move.

    The size is infinite where the root lies farther than `room` in λa from the start: it is then another one.
    """

    def step(_, state):
        x, _ = state
        value, slope = function(x), jax.jacfwd(function)(x)
        move = -jnp.linalg.solve(slope, value)
        move = jnp.clip(jnp.where(valid, move, 0.0), -0.3, 0.3)
        return x + move, jnp.max(jnp.abs(move))

    # a loop, not unrolled: it compiles in a fraction of the time
    x, size = jax.lax.fori_loop(0, _NEWTON, step, (start, jnp.asarray(jnp.inf)))
    return x, jnp.where(jnp.abs(x[0] - start[0]) <= room, size, jnp.inf)


def _cubic_root(f, load, at):
    """The load in [load[at], load[at + 1]] of each row at which the cubic through four neighbours of f vanishes."""
    first = jnp.clip(at - 1, 0, f.shape[1] - 4)
    near = first[:, None] + jnp.arange(4)
    y = jnp.take_along_axis(f, near, axis=1)
    spacing = load[:, 1] - load[:, 0]  # the loads of a row are evenly spaced
    d1 = y[:, 1] - y[:, 0]
    d2 = y[:, 2] - 2 * y[:, 1] + y[:, 0]
    d3 = y[:, 3] - 3 * y[:, 2] + 3 * y[:, 1] - y[:, 0]
    begin = (at - first).astype(float)
    f0, f1 = (jnp.take_along_axis(f, (at + k)[:, None], axis=1)[:, 0] for k in (0, 1))
    x = begin + f0 / (f0 - f1)
    for _ in range(3):
        value = y[:, 0] + x * (d1 + (x - 1) / 2 * (d2 + (x - 2) / 3 * d3))
        slope = d1 + (x - 0.5) * d2 + (3 * x * x - 6 * x + 2) / 6 * d3
        x = jnp.clip(x - value / slope, begin, begin + 1)
    return jnp.take_along_axis(load, first[:, None], axis=1)[:, 0] + x * spacing


@jax.jit
def _ramps(surface: Surface, table: _Table, chamber, v0, atmosphere, exponent):
    """The ramp of one chamber; every number NaN-safe, `unresolved` where the table does not decide."""
    material = surface.membrane.material

    def on_surface(x):
        p, v = surface.at_load_fraction(x[0], x[1], ("pressure", "volume"))
        return p, v, x[1] * largest_load(material, x[0])

    # the filling: V(λa, q = 0) = V_0 at the smallest λa
    flat_v = surface.at_load_fraction(table.apex, jnp.zeros_like(table.apex), ("volume",))[0]
    first = jnp.argmax(flat_v >= v0)
    reach = (flat_v[first] >= v0) & (first > 0)
    before = jnp.maximum(first - 1, 0)
    share = jnp.log(v0 / flat_v[before]) / jnp.log(flat_v[first] / flat_v[before])
    guess = table.apex[before] + share * (table.apex[first] - table.apex[before])
    zero = jnp.zeros(())

    def filled(x):
        return jnp.stack([jnp.log(on_surface(x)[1] / v0), x[1]])

    start, start_size = _newton(filled, jnp.stack([jnp.where(reach, guess, 2.0), zero]), reach)
    p0 = on_surface(start)[0]
    gas = Contour(
        pressure_weight=1.0,
        load_weight=0.0,
        load=0.0,
        chamber_volume=chamber,
        initial_pressure=p0,
        initial_volume=v0,
        atmospheric_pressure=atmosphere,
        exponent=exponent,
    )

    def condition(x):
        p, v, _ = on_surface(x)
        return p - gas.gas_pressure(v)

    # one crossing in every row
    f = table.pressure - gas.gas_pressure(table.volume)
    rising = (f[:, :-1] < 0) != (f[:, 1:] < 0)
    count = jnp.sum(rising, axis=1)
    at = jnp.argmax(rising, axis=1)
    rows = jnp.arange(len(at))
    t = _cubic_root(f, table.load, at)
    q = t * table.limit
    begin = jnp.argmax(table.apex > start[0])
    here = rows >= begin
    # the contour ends where a row has no crossing; by then it is beyond breakdown
    ends = here & (count == 0)
    last = jnp.where(jnp.any(ends), jnp.argmax(ends), len(at)) - 1
    along = here & (rows <= last)
    single = jnp.all(jnp.where(along, count == 1, True)) & (last > begin + 3)

    # q is known to the table's interpolation here: enough to order the events
    change = jnp.diff(q)
    pairs = along[:-1] & along[1:]
    size = jnp.where(pairs, jnp.abs(change), 0.0)
    turns = (change[:-1] > 0) & (change[1:] < 0) & along[:-2] & along[2:]  # maxima at row i + 1
    ratio = q / table.broken
    breaks = pairs & (ratio[:-1] < 1) & (ratio[1:] >= 1)
    peak_row = jnp.where(jnp.any(turns), jnp.argmax(turns) + 1, len(at))
    break_row = jnp.where(jnp.any(breaks), jnp.argmax(breaks), len(at))
    # no turn, and yet nearly flat in between: two folds may hide between rows
    alike = (change[:-2] * change[1:-1] > 0) & (change[1:-1] * change[2:] > 0)
    dip = alike & (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < _MERGING * jnp.max(size))
    hidden = jnp.any(dip & pairs[:-2] & pairs[2:])

    def fold(x):
        df = jax.grad(condition)(x)
        dq = jax.grad(lambda x: on_surface(x)[2])(x)
        # scaled so that both rows are of one size
        return jnp.stack([condition(x), (df[0] * dq[1] - df[1] * dq[0]) / (jnp.abs(df[1] * dq[1]) + 1e-300) * 0.1])

    snaps_first = jnp.any(turns) & (peak_row <= break_row)
    peak = jnp.clip(peak_row, 1, len(at) - 2)
    room = 2 * jnp.max(jnp.diff(table.apex))
    fold_x, fold_size = _newton(fold, jnp.stack([table.apex[peak], t[peak]]), snaps_first & single, room)
    fold_q = on_surface(fold_x)[2]

    # another branch further on matters where it may hold a state at the fold's load
    other = (rows > last) & (count > 0)
    final_at = rising.shape[1] - 1 - jnp.argmax(rising[:, ::-1], axis=1)
    both = jnp.stack([q, _cubic_root(f, table.load, final_at) * table.limit])
    above = jnp.all(jnp.where(other, both > 1.02 * fold_q, True))
    below = jnp.all(jnp.where(other, both < fold_q / 1.02, True))
    clear = (above | below) & jnp.all(jnp.where(other, count <= 2, True))

    # the landing: the first rise of q through the fold's load beyond the valley
    after = (rows[:-1] > peak) & pairs
    lands = after & (q[:-1] < fold_q) & (q[1:] >= fold_q)
    has_landing = jnp.any(lands) & snaps_first
    row = jnp.clip(jnp.argmax(lands), 0, len(at) - 2)
    s = (fold_q - q[row]) / (q[row + 1] - q[row])
    land_x, land_size = _newton(
        lambda x: jnp.stack([condition(x), (on_surface(x)[2] - fold_q) / 0.02]),
        jnp.stack([table.apex[row] + s * (table.apex[row + 1] - table.apex[row]), t[row] + s * (t[row + 1] - t[row])]),
        has_landing & single,
        room,
    )
    land_ratio = jnp.sqrt(fold_q / surface.breakdown_load(land_x[0]))
    # on from there, or from the start: breakdown before another fold
    floor = jnp.where(snaps_first, row, begin)
    later = breaks & (rows[:-1] >= floor)
    break_at = jnp.clip(jnp.where(jnp.any(later), jnp.argmax(later), len(at) - 2), 0, len(at) - 2)
    again = jnp.any(turns & (rows[1:-1] > floor + 1) & (rows[1:-1] < break_at))
    s = (1 - ratio[break_at]) / (ratio[break_at + 1] - ratio[break_at])
    break_x, break_size = _newton(
        lambda x: jnp.stack([condition(x), on_surface(x)[2] / surface.breakdown_load(x[0]) - 1]),
        jnp.stack(
            [
                table.apex[break_at] + s * (table.apex[break_at + 1] - table.apex[break_at]),
                t[break_at] + s * (t[break_at + 1] - t[break_at]),
            ]
        ),
        jnp.any(later) & single,
        room,
    )

    broken_landing = has_landing & (land_ratio >= 1)
    lost = snaps_first & ~has_landing
    unstable = q[begin + 1] < q[begin]
    settled = (start_size < 1e-9) & jnp.where(snaps_first, (fold_size < 1e-7) & (lost | (land_size < 1e-9)), True)
    settled &= (lost & clear) | broken_landing | (jnp.any(later) & (break_size < 1e-9) & ~again)
    near_edge = jnp.abs(land_ratio - 1) < 1e-8
    fair = reach & single & ~hidden & (unstable | (settled & ~near_edge))
    outcome = jnp.where(broken_landing, int(Outcome.breakdown_in_snap), int(Outcome.breakdown_on_branch))
    outcome = jnp.where(lost, int(Outcome.no_unbroken_landing), outcome)
    outcome = jnp.where(unstable, int(Outcome.start_unstable), outcome)
    outcome = jnp.where(fair, outcome, int(Outcome.unresolved))
    moving = fair & ~unstable
    snap_seen, land_seen = moving & snaps_first, moving & has_landing
    falls = broken_landing | lost
    break_seen = moving & ~falls

    def point(x, seen):
        p, v, q = on_surface(x)
        return [jnp.where(seen, w, jnp.nan) for w in (x[0], p, v, jnp.sqrt(jnp.maximum(q, 0.0)))]

    final = jnp.where(falls, fold_x[0], break_x[0])
    strain = jnp.where(moving, (final / start[0]) ** 2 - 1, jnp.nan)
    bounds = [
        jnp.where(seen, surface.error_bound(x[0], on_surface(x)[2]), 0.0)
        for x, seen in ((start, fair), (fold_x, snap_seen), (land_x, land_seen), (break_x, break_seen))
    ]
    return (
        point(start, fair),
        point(fold_x, snap_seen),
        point(land_x, land_seen),
        jnp.where(land_seen, land_ratio, jnp.nan),
        point(break_x, break_seen),
        strain,
        snap_seen.astype(int),
        outcome,
        jnp.where(fair, functools.reduce(jnp.maximum, bounds), jnp.nan),
    )


_many = jax.jit(jax.vmap(_ramps, in_axes=(None, None, 0, 0, 0, 0)))


def chamber_ramps(
    surface: Surface, chamber_volume, initial_volume, *, atmospheric_pressure=50.0, polytropic_exponent=1.0
) -> Ramps:
    """The ramp up of every chamber in arrays of one shape (or numbers, broadcast), on one membrane's surface.

    Chambers that the surface alone does not decide have outcome `Outcome.unresolved` and NaN; `voltage_volume` decides
    them. Raises ValueError for numbers that are not positive and finite.

    >>> from dielectric_jax import Membrane
    >>> ramps = chamber_ramps(Surface.build(Membrane()), [800.0, 1600.0], 2.42)
    >>> [round(float(v), 9) for v in ramps.snap.voltage]
    [0.097199007, 0.07649536]
    >>> round(float(ramps.area_strain[1]), 4)
    16.1219
    """
    given = {"chamber_volume": chamber_volume, "initial_volume": initial_volume}
    given |= {"atmospheric_pressure": atmospheric_pressure, "polytropic_exponent": polytropic_exponent}
    columns = dict(zip(given, np.broadcast_arrays(*(np.asarray(v, float) for v in given.values())), strict=True))
    for name, values in columns.items():
        wrong = ~(np.isfinite(values) & ((values > 0) | ((values == 0) & (name == "atmospheric_pressure"))))
        if wrong.any():
            check_positive(name, float(values[wrong].flat[0]), zero=name == "atmospheric_pressure")
    shape = columns["chamber_volume"].shape
    flat = [values.ravel() for values in columns.values()]
    table = _table_of(ById(surface))
    if not flat[0].size:
        raise ValueError("`chamber_volume` must hold at least one chamber, but is empty.")

    def work(i):
        chunk = [np.pad(v[i : i + _CHUNK], (0, max(0, i + _CHUNK - v.size)), mode="edge") for v in flat]
        return jax.tree.map(np.asarray, _many(surface, table, *chunk))

    begins = range(0, flat[0].size, _CHUNK)
    parts = [work(0), *threads().map(work, begins[1:])]  # the first alone: it compiles
    joined = jax.tree.map(lambda *v: np.concatenate(v)[: flat[0].size].reshape(shape), *parts)
    start, snap, landing, ratio, breakdown, *rest = joined
    return Ramps(Point(*start), Point(*snap), Point(*landing), ratio, Point(*breakdown), *rest)
