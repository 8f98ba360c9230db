"""Ramps of many chambers, or pressures, on one membrane's surface: all their special points and events, nothing stepped.

A loading crosses each row of λa at one load (`rows`), so that its contour is q(λa) on even rows: folds are the extremes of
the polynomial through neighbouring rows, zero-voltage states its zeros, breakdown where it meets q_b(λa), landings where it meets
the fold's q again. Where a row shows several crossings the contour ends; a ramp that is not decided by then, or by the
edge of the surface's domain, is left to `voltage_volume`: its outcome says so, and its numbers are NaN.
"""

import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    Chamber,
    ClosingEquation,
    ConstantPressure,
    FoldAhead,
    LoadingCondition,
    Outcome,
    SceneBatch,
    locking_stretch,
)
from ..numerics import cached_jit, check_positive, root_find, run_lanes
from ..surface import ROWS, ById, Conditions, Rows, Surface, crossings, rows_of
from .landings import Landing, folds_ahead, landings
from .ramps import APEX, ERROR, LOAD, PRESSURE, RampArrays, Ramps, Slot, ramps_of
from .resolution import (
    CLOSE_NEWTON,
    CORRECTED_FROM,
    CORRECTED_TOGETHER,
    FEW_LOADINGS,
    FLAT_MAXIMUM,
    LARGEST_RAMP_ERROR,
    LOADINGS_TOGETHER,
)
from .row_points import ContourOnRows, Events, first_place
from .row_ramp import Crossed, corrector_program, ramp_program, snap_program

__all__ = [
    "Curves",
    "chamber_curves",
    "chamber_ramps",
    "filling_volumes",
    "largest_start",
    "loading_arrays",
    "pressure_curves",
    "pressure_ramps",
]


class Curves(typing.NamedTuple):
    """Voltage–volume curves of many loadings at common apex stretches (256,); the others are (loadings…, 256).

    NaN where the surface holds no state, or several at one λa (then `several` is True).
    """

    apex_stretch: np.ndarray
    voltage_squared: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    several: np.ndarray


def _start(rows: Rows, values, others, target, order: int):
    """Where the state at zero voltage first reaches a volume (or with `order` −1 a pressure), from values on the rows."""
    reached, any_ = first_place(values >= target)
    # a maximum between two rows may reach it before
    before, here, after = values[:-2], values[1:-1], values[2:]
    bend = before - 2 * here + after
    over = jnp.where(bend < 0, (after - before) ** 2 / (-8 * bend), 0.0)
    near = (here >= before) & (here >= after) & (here + 1.5 * over + FLAT_MAXIMUM * jnp.abs(here) >= target)
    present = any_ & (reached > 0) & ~jnp.any(near & (jnp.arange(1, ROWS - 1) < reached))
    whole = ContourOnRows(rows, values, others, jnp.asarray(0), jnp.asarray(ROWS - 1))
    place, *_ = whole.correct(jnp.maximum(reached - 1, 0), ClosingEquation.level, target)

    wanted, rest = ("volume", "pressure")[::order]

    def on_surface(apex, name):
        return rows.surface.at_load_fraction(apex, 0.0, (name,))[0]

    begin = rows.apex_at(place)
    root = root_find(lambda x, _: on_surface(x, wanted) - target, begin, steps=CLOSE_NEWTON, tolerance=None)
    apex, other, size = root.value, on_surface(root.value, rest), root.move
    place = jnp.where(present & (size < 1e-5), rows.place_of(apex), jnp.inf)
    return Events(place, target, other, jnp.where(size < 1e-7, 0.0, size))


def _conditions(rows: Rows, lanes, kind: str):
    """The starts and conditions of a chunk of chambers (V_C, V_0, p_atm, n), or of pressures."""
    if kind == "pressure":
        (pressure,) = lanes
        start = jax.vmap(lambda p: _start(rows, rows.flat_pressure, rows.flat_volume, p, -1))(pressure)
        one, zero = jnp.ones_like(pressure), jnp.zeros_like(pressure)
        conditions = Conditions(zero, one, pressure, zero, one, polytropic=False)
        return Events(start.place, zero, start.volume, start.error), conditions
    chamber, filling, outside, exponent = lanes
    start = jax.vmap(lambda v: _start(rows, rows.flat_volume, rows.flat_pressure, v, 1))(filling)
    pressure = jnp.where(jnp.isfinite(start.place), start.volume, jnp.nan)  # the other value of a start is its pressure
    given = jnp.ones_like(chamber), chamber, jnp.ones_like(chamber), outside, exponent
    conditions = Conditions(*given, polytropic=kind == "polytropic")
    constant = (pressure + outside) * conditions.power(filling + chamber)[0]
    conditions = eqx.tree_at(lambda c: c.constant, conditions, constant)
    return Events(start.place, jnp.zeros_like(filling), filling, start.error), conditions


def _crossing_program(kind: str):
    def crossings_of(rows, lanes):
        start, conditions = _conditions(rows, lanes, kind)
        q, v, found, again, above = crossings(rows, conditions)
        q, v = (jnp.where(found & ~again, w, jnp.nan) for w in (q, v))
        return jax.tree.leaves(start), jax.tree.leaves(conditions), (q, conditions.pressure(v), v, found, again, above)

    crossings_of.__name__ = f"crossings_{kind}"
    return cached_jit(crossings_of)


_CROSSINGS = {kind: _crossing_program(kind) for kind in ("isothermal", "polytropic", "pressure")}


def _ramps_chunk(rows: Rows, lanes, kind: str):
    start, conditions, crossed = _CROSSINGS[kind](rows, lanes)
    return _ramps_of_crossings(rows, start, conditions, crossed, kind)


def _ramps_of_crossings(rows: Rows, start, conditions, crossed, kind: str):
    q, _, *crossed = crossed
    conditions = Conditions(*conditions, polytropic=kind == "polytropic")
    # a program of its own: fused with the crossings it would find them anew for every use
    answer = ramp_program(rows, Events(*start), conditions, Crossed(q, *crossed))
    events, special, snaps, outcome, reach = (jax.tree.map(np.array, part) for part in answer)

    def worst():
        return np.max(np.nan_to_num(events[:, ERROR], nan=0.0), axis=1)

    rough = np.flatnonzero(worst() > CORRECTED_FROM)
    if len(rough):
        own = jax.tree.map(lambda v: np.asarray(v)[rough], (conditions, events))
        one_call = {"sizes": CORRECTED_TOGETHER, "axis": 0, "out_axis": 0, "parallel": False}
        events[rough] = run_lanes(lambda part: corrector_program(rows.surface, *part), own, **one_call)
    vague = worst() > LARGEST_RAMP_ERROR
    events[vague], snaps[vague], outcome[vague] = np.nan, 0, int(Outcome.unresolved)
    return events, *special, snaps, outcome, reach


def _snaps_chunk(rows: Rows, lanes, kind: str):
    start, conditions, (q, _, *crossed, _) = _CROSSINGS[kind](rows, lanes)
    return (snap_program(rows, Events(*start), Conditions(*conditions, polytropic=kind == "polytropic"), q, *crossed),)


def first_folds_on(surface: Surface, given: dict) -> np.ndarray:
    """Start and first fold, columns as in `States`, of many chambers or pressures: (…, 2, 5); NaN where not decided.

    `given` names the columns as the arguments of `chamber_ramps`, or the pressure.
    """
    loadings, kind = _loadings(surface, given)
    return _run(_snaps_chunk, surface, loadings, kind, 0)[0]


@cached_jit
def _filling_program(rows: Rows, pressure):
    start = jax.vmap(lambda p: _start(rows, rows.flat_pressure, rows.flat_volume, p, -1))(pressure)
    return jnp.where(start.seen(), start.volume, jnp.nan)


def _filling_chunk(rows: Rows, lanes, kind: str):
    return _filling_program(rows, *lanes)


def _curves_chunk(rows: Rows, lanes, kind: str):
    q, p, v, _, again, _ = _CROSSINGS[kind](rows, lanes)[2]
    return q, p, v, again


def _glance_chunk(rows: Rows, lanes, kind: str):
    start, conditions, crossed = _CROSSINGS[kind](rows, lanes)
    q, p, v, _, again, _ = (np.asarray(values).T for values in crossed)
    return [q, p, v, again, *_ramps_of_crossings(rows, start, conditions, crossed, kind)]


def curves_and_ramps(surface: Surface, given: dict) -> tuple[Curves, Ramps]:
    """Curves and ramps of a few loadings, at once and without the padding that large batches have; as `chamber_ramps`.

    `given` names the columns as the arguments of `chamber_ramps`, or the pressure.
    """
    loadings, kind = _loadings(surface, given)
    q, p, v, again, *arrays = _run(_glance_chunk, surface, loadings, kind, 0, FEW_LOADINGS)
    curves = Curves(np.asarray(rows_of(ById(surface)).apex_stretch), q, p, v, again)
    return curves, _answer(surface, loadings, kind, arrays, exact=True)


def _answer(surface: Surface, loadings: list[np.ndarray], kind: str, arrays: list, *, exact: bool = False) -> Ramps:
    """The ramps that the program found on the surface, with what lies beyond it: landings, and folds further on.

    With `exact` landings beyond the surface are located; else their numbers are NaN and only the outcome says that they
    are there.
    """
    events, folds, zeros, breaks, snaps, outcome, reach = arrays
    shape = outcome.shape
    flat = [np.reshape(v, (-1, *v.shape[len(shape) :])) for v in (events, folds, snaps, outcome)]
    ahead = _decide_beyond(surface, [v.ravel() for v in loadings], kind, *flat, exact=exact).reshape(shape)
    events, folds, snaps, outcome = (
        np.reshape(v, w.shape) for v, w in zip(flat, (events, folds, snaps, outcome), strict=True)
    )
    return ramps_of(surface.breakdown_load, RampArrays(events, folds, zeros, breaks, snaps, outcome, reach, ahead))


def _decide_beyond(surface: Surface, loadings, kind: str, events, folds, snaps, outcome, *, exact: bool) -> np.ndarray:
    """Settles in place the ramps whose end lies beyond the surface; returns their `FoldAhead`."""
    ahead = np.full(len(outcome), int(FoldAhead.unknown))
    broken = events[:, APEX, Slot.breakdown]
    with np.errstate(invalid="ignore"):
        ahead[(folds[:, APEX] > broken[:, None]).any(axis=1)] = FoldAhead.fold
    first = outcome == Outcome.breakdown_on_branch
    open_ = np.flatnonzero(first & (snaps == 0) & (ahead == FoldAhead.unknown))
    if len(open_):
        condition = _loading_conditions(loadings, kind, events, open_)
        ahead[open_] = folds_ahead(surface.membrane, condition, broken[open_], events[open_, LOAD, Slot.breakdown])
    lost = np.flatnonzero(outcome == Outcome.no_landing)
    if len(lost):
        last = np.maximum(snaps[lost], 1)
        scene_batch = _scene_batch(surface, _loading_conditions(loadings, kind, events, lost))
        found = landings(scene_batch, surface.membrane, np.arange(len(lost)), events[lost, :, last], exact=exact)
        outcome[lost[found.kind == Landing.broken]] = Outcome.breakdown_in_snap
        events[lost, :, Slot.landings.start - 1 + last] = found.state
        undecided = lost[(found.kind == Landing.unknown) | (found.kind == Landing.unbroken)]
        events[undecided], snaps[undecided], outcome[undecided] = np.nan, 0, Outcome.unresolved
    return ahead


def _loading_conditions(loadings, kind: str, events, which: np.ndarray) -> LoadingCondition:
    """The conditions of loadings, as columns."""
    own = [v[which] for v in loadings]
    example = ConstantPressure(1.0) if kind == "pressure" else Chamber(volume=1.0, initial_volume=1.0)
    loading = jax.tree.unflatten(jax.tree.structure(example), own)
    filling = () if kind == "pressure" else (events[which, PRESSURE, Slot.start], own[1])
    return jax.tree.map(lambda v: np.broadcast_to(np.asarray(v, float), len(which)), loading.condition(*filling))


def landings_on(surface: Surface, given: dict, folds: np.ndarray) -> np.ndarray:
    """λa and p (n, 2) of the states on which snaps of loadings (n,) land, from folds (λa, q) (n, 2), as the scan shows them.

    `given` names the columns as the arguments of `chamber_ramps`, or the pressure. NaN where there is none, or none is clear.
    """
    count = len(folds)
    given = {name: np.broadcast_to(np.asarray(v, float), count) for name, v in given.items()}
    loadings, kind = _loadings(surface, given)
    starts = np.moveaxis(first_folds_on(surface, given)[:, :1], 1, 2)  # (n, values, events)
    # of a fold the pressure does not matter, and the volume only where a landing lies below it
    known = np.column_stack([folds[:, 0], np.zeros(count), folds[:, 1], np.zeros((count, 2))])
    which = np.flatnonzero(np.isfinite(folds).all(axis=1) & np.isfinite(starts[:, PRESSURE, Slot.start]))
    guess = np.full((count, 2), np.nan)
    if len(which):
        scene_batch = _scene_batch(surface, _loading_conditions(loadings, kind, starts, which))
        found = landings(scene_batch, surface.membrane, np.arange(len(which)), known[which], exact=False)
        guess[which] = np.where(np.isfinite(found.state[:, :2]), found.state[:, :2], found.guess)
    return guess


def _scene_batch(surface: Surface, condition: LoadingCondition) -> SceneBatch:
    count = len(condition.pressure_weight)
    membrane = jax.tree.map(lambda v: np.full(count, float(v)), surface.membrane)
    return SceneBatch(membrane, condition, np.full(count, locking_stretch(surface.membrane)))


def _run(chunk, surface: Surface, loadings: list[np.ndarray], kind: str, axis: int, some: int = LOADINGS_TOGETHER):
    """`chunk` on many loadings, some at a time on all cores: a list of arrays with the shape of the loadings first.

    `axis` is where the results of `chunk` count the loadings, 0 or 1 of two.
    """
    shape, rows = loadings[0].shape, rows_of(ById(surface))
    flat = tuple(values.ravel() for values in loadings)
    found = run_lanes(lambda part: chunk(rows, part, kind), flat, sizes=some, out_axis=axis)
    wholes = [np.moveaxis(v, axis, 0) for v in jax.tree.leaves(found)]
    return [whole.reshape((*shape, *whole.shape[1:])) for whole in wholes]


def _loadings(surface, given: dict):
    """The columns of chambers or pressures by name, checked, and the kind of program they need."""
    return (_checked_loadings(surface, given), "pressure") if "pressure" in given else _chambers(surface, **given)


def _chambers(surface, chamber_volume, initial_volume, atmospheric_pressure, polytropic_exponent):
    """The columns of chambers, checked, and the kind of program they need."""
    given = {"chamber_volume": chamber_volume, "initial_volume": initial_volume}
    given |= {"atmospheric_pressure": atmospheric_pressure, "polytropic_exponent": polytropic_exponent}
    loadings = _checked_loadings(surface, given)
    return loadings, "isothermal" if np.all(loadings[3] == 1) else "polytropic"


def _checked_loadings(surface, given: dict) -> list[np.ndarray]:
    if not isinstance(surface, Surface):
        raise ValueError(f"`surface` must be a Surface, but is a {type(surface).__name__}.")
    surface.membrane.check_breaks_at_apex()
    loadings = dict(zip(given, np.broadcast_arrays(*(np.asarray(v, float) for v in given.values())), strict=True))
    for name, values in loadings.items():
        if not values.size:
            raise ValueError(f"`{name}` must hold at least one loading, but is empty.")
        wrong = ~(np.isfinite(values) & ((values > 0) | ((values == 0) & (name == "atmospheric_pressure"))))
        if wrong.any():
            check_positive(name, float(values[wrong].flat[0]), zero=name == "atmospheric_pressure")
    return list(loadings.values())


def chamber_ramps(
    surface: Surface, chamber_volume, initial_volume, *, atmospheric_pressure=50.0, polytropic_exponent=1.0
) -> Ramps:
    """The ramps, up and down, of every chamber in arrays of one shape (or numbers, broadcast), on a membrane's surface.

    If the surface cannot determine what a chamber does, its outcome is `Outcome.unresolved` and its numbers are NaN;
    `voltage_volume` decides it. A snap may land beyond the surface, above breakdown: then the outcome is
    `breakdown_in_snap` and the numbers of the landing are NaN. Raises ValueError for numbers that are not positive and finite.

    >>> from dielectric_jax import Membrane
    >>> ramps = chamber_ramps(Surface.build(Membrane()), [800.0, 1600.0], 2.42)
    >>> [round(float(v), 9) for v in ramps.snap.voltage[:, 0]]
    [0.097199007, 0.07649536]
    >>> round(float(ramps.area_strain[1]), 4)
    16.1219
    """
    given = chamber_volume, initial_volume, atmospheric_pressure, polytropic_exponent
    loadings, kind = _chambers(surface, *given)
    return _answer(surface, loadings, kind, _run(_ramps_chunk, surface, loadings, kind, 0))


def pressure_ramps(surface: Surface, pressure) -> Ramps:
    """The ramps at constant pressures, from the state at zero voltage of the smallest volume; as `chamber_ramps`.

    >>> from dielectric_jax import Membrane
    >>> ramps = pressure_ramps(Surface.build(Membrane()), [1.0, 1.82])
    >>> [Outcome(int(o)).name for o in ramps.outcome]
    ['breakdown_in_snap', 'breakdown_in_snap']
    """
    loadings = _checked_loadings(surface, {"pressure": pressure})
    return _answer(surface, loadings, "pressure", _run(_ramps_chunk, surface, loadings, "pressure", 0))


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
    return _curves(surface, *_chambers(surface, *given))


def pressure_curves(surface: Surface, pressure) -> Curves:
    """Voltage–volume curves at constant pressures, as `chamber_curves`.

    >>> from dielectric_jax import Membrane
    >>> curves = pressure_curves(Surface.build(Membrane()), [1.0, 1.82])
    >>> bool(np.nanmax(abs(curves.pressure[1] - 1.82)) < 1e-12)
    True
    """
    return _curves(surface, _checked_loadings(surface, {"pressure": pressure}), "pressure")


def _curves(surface: Surface, loadings: list[np.ndarray], kind: str) -> Curves:
    q, p, v, again = _run(_curves_chunk, surface, loadings, kind, 1)
    return Curves(np.asarray(rows_of(ById(surface)).apex_stretch), q, p, v, again)


def filling_volumes(surface: Surface, pressure) -> np.ndarray:
    """The volumes V_0 of chambers that are filled to pressures p_0: the state at zero voltage of the smallest volume.

    NaN where the surface holds none.

    >>> from dielectric_jax import Membrane
    >>> round(float(filling_volumes(Surface.build(Membrane()), 1.886612680245)), 9)
    2.42
    """
    (volume,) = _run(_filling_chunk, surface, _checked_loadings(surface, {"initial_pressure": pressure}), "pressure", 0)
    return volume


def largest_start(loading: Chamber | ConstantPressure, surface: Surface) -> float:
    """The largest V_0 of a chamber, or the largest p, below which a ramp starts from a stable state at zero voltage.

    At zero voltage (p + p_atm)(V + V_C)ⁿ, or p itself, rises along the rows of the surface up to that filling. The answer is a
    row's and lies before the maximum, up to two rows below it; it is the end of the surface where there is no maximum.

    >>> from dielectric_jax import Membrane
    >>> surface = Surface.build(Membrane())
    >>> 1.90 < largest_start(ConstantPressure(1.0), surface) < 1.908684829414    # the peak of the pressure
    True
    """
    rows = rows_of(ById(surface))
    p, v = (np.asarray(values) for values in (rows.flat_pressure, rows.flat_volume))
    known = np.isfinite(p) & np.isfinite(v)
    p, v = p[known], v[known]
    if isinstance(loading, Chamber):
        held = np.log(p + loading.atmospheric_pressure) + loading.polytropic_exponent * np.log(v + loading.volume)
    else:
        held = p
    falls = np.flatnonzero(np.diff(held) <= 0)
    last = max(int(falls[0]) - 1, 0) if len(falls) else len(v) - 1
    return float((v if isinstance(loading, Chamber) else p)[last])


def loading_arrays(loading, surface: Surface) -> dict:
    """The columns of a loading under the names of `chamber_ramps`, or the pressure."""
    if isinstance(loading, ConstantPressure):
        return {"pressure": loading.pressure}
    assert isinstance(loading, Chamber)
    filling = loading.initial_volume
    if filling is None:
        start = pressure_ramps(surface, loading.initial_pressure).start.volume
        filling = np.where(np.isfinite(start), start, 1e-300)  # too little for any state: not decided
    gas = {n: getattr(loading, n) for n in ("atmospheric_pressure", "polytropic_exponent")}
    return {"chamber_volume": loading.volume, "initial_volume": filling} | gas
