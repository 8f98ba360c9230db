"""A glance at a scene: its diagram read off the rows of a surface in some thousandths of a second, ready for the plots.

What `voltage_volume` finds by continuation or by contours, exact to the surface's error, but no farther than the rows go (1.2
times the load of breakdown), and one state a row: where a stretch of the apex has several the curve has a gap. Ramps that
the surface alone does not decide are left out.
"""

import dataclasses
import typing

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import PPoly, make_interp_spline

from ..model import (
    Branch,
    Chamber,
    ConstantPressure,
    ConstantVoltage,
    Event,
    Outcome,
    PointKind,
    RampEvent,
    Regime,
    Scene,
    SpecialPoint,
    State,
    events_table,
    other_loading,
    points_table,
)
from ..numerics import Code, SceneError, cached_jit, root_find, run_lanes
from ..plot import plot_diagram
from ..surface import ById, Rows, Surface, rows_of
from .ramps import LOAD
from .resolution import GLANCE_NEWTON, GLANCE_REACH, MOST_PRESSURE_POINTS
from .states import check_concrete, check_surface
from .surface_ramps import Curves, Ramps, curves_and_ramps, filling_volumes

__all__ = ["Glance", "glance"]

_NOTHING = "The rows of the surface hold no state of this scene; voltage_volume and pressure_volume look farther."


@dataclasses.dataclass(frozen=True)
class Glance:
    """What the plots need of a `Diagram`: `kind`, branches, special points, events of the ramp; and its regime.

    Along branches `index` is 0 where the control rises with the stretch of the apex and 1 elsewhere; of points it is unknown.
    `outcome` is None for a pressure–volume curve. `several` says whether the curve has gaps where a stretch of the apex
    belongs to several states.
    """

    kind: str
    scene: Scene
    branches: list[Branch]
    special_points: list[SpecialPoint]
    events: tuple[Event, ...]
    voltage: float | None
    outcome: Outcome | None
    regime: Regime
    area_strain: float
    several: bool

    def gas_pressure(self, volume) -> np.ndarray | None:
        """The pressure of the chamber's gas at `volume`; None where there is no chamber or no event of its ramp."""
        if not isinstance(self.scene.loading, Chamber) or not self.events:
            return None
        start = self.events[0].state
        return np.asarray(
            self.scene.loading.condition(start.pressure, start.volume).gas_pressure(np.asarray(volume, float))
        )

    def plot(self, **options):
        """Draws the diagram, or two of its columns with `x=` and `y=` (`plot(x="apex_stretch", y="pressure")`), on your axes with `ax=`.

        Returns the axes given, or else the new figure. Options are those of `plot.plot_diagram`.
        """
        return plot_diagram(self, **options)

    def _repr_html_(self) -> str:
        units = self.scene.units
        table = points_table(self.special_points, f"{self.kind}, read off a surface", units)
        return table + (events_table(self.events, self.regime.name, units) if self.events else "")

    def __repr__(self) -> str:
        path = " → ".join(event.event for event in self.events)
        lines = [f"Glance({self.kind}, regime={self.regime.name}, area_strain={self.area_strain:.6g}"]
        lines += [f"  {entry!r}" for entry in (*self.branches, *self.special_points)]
        return "\n".join([*lines, f"  ramps: {path}"] if path else lines) + ")"


def glance(scene: Scene, surface: Surface) -> Glance:
    """The diagram of a scene as far as the rows of its membrane's surface tell it, in milliseconds.

    The scene holds a chamber, a pressure, or a voltage; its window is not looked at. Special points and events carry bounds
    of their relative errors. Raises ValueError for another loading or the surface of another membrane, and SceneError where
    the surface holds no state of the scene.

    >>> from dielectric_jax import Chamber, Membrane, Scene
    >>> seen = glance(Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42)), Surface.build(Membrane()))
    >>> [event.event for event in seen.events if event.direction == "up"], seen.regime.name
    (['start', 'snap', 'landing', 'breakdown'], 'stays')
    >>> round(seen.events[1].state.voltage, 9)
    0.07649536
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    check_concrete(scene)
    if not isinstance(surface, Surface):
        raise ValueError(f"`surface` must be a Surface, but is a {type(surface).__name__}.")
    check_surface(surface, scene.membrane)
    loading = scene.loading
    if isinstance(loading, ConstantVoltage):
        return _pressure_volume(scene, surface, float(loading.voltage))
    if isinstance(loading, ConstantPressure):
        given = {"pressure": float(loading.pressure)}
    elif isinstance(loading, Chamber):
        names = ("atmospheric_pressure", "polytropic_exponent")
        given = {"chamber_volume": float(loading.volume), "initial_volume": _filling(loading, surface)}
        given |= {n: float(getattr(loading, n)) for n in names}
    else:
        raise other_loading(loading, Chamber, ConstantPressure, ConstantVoltage)
    return _voltage_volume(scene, surface, *curves_and_ramps(surface, given))


def _filling(chamber: Chamber, surface: Surface) -> float:
    """V_0, given or that of p_0."""
    if chamber.initial_volume is not None:
        return float(chamber.initial_volume)
    volume = float(filling_volumes(surface, chamber.initial_pressure))
    if np.isnan(volume):
        at = f"`initial_pressure` = {float(typing.cast(float, chamber.initial_pressure)):g}"
        raise SceneError(
            Code.surface_edge, f"The surface does not tell which state at {at} fills the chamber; voltage_volume does."
        )
    return volume


def _voltage_volume(scene: Scene, surface: Surface, curves: Curves, ramps: Ramps) -> Glance:
    rows = rows_of(ById(surface))
    q = curves.voltage_squared
    branches = _branches(rows, q, curves.pressure, curves.volume, q)
    if not branches:
        raise SceneError(Code.surface_edge, _NOTHING)
    outcome = Outcome(int(ramps.outcome))
    marks = [
        (PointKind.fold, ramps.folds),
        (PointKind.zero_voltage, ramps.zero_voltage),
        (PointKind.breakdown, ramps.breakdowns),
    ]
    points = [p for kind, found in marks for p in _points(rows, kind, found, branches)]
    events = () if outcome == Outcome.unresolved else tuple(_events(rows, ramps, outcome))
    regime = Regime(int(ramps.regime))
    strain = float(ramps.area_strain)
    parts = _Parts("voltage-volume", scene, branches, points, None)
    return parts.glance(
        events=events, outcome=outcome, regime=regime, area_strain=strain, several=bool(curves.several.any())
    )


class _Parts(typing.NamedTuple):
    """What both kinds of diagram have."""

    kind: str
    scene: Scene
    branches: list
    special_points: list
    voltage: float | None

    def glance(self, **more) -> Glance:
        return Glance(**self._asdict(), **more)


def _branches(rows: Rows, q, pressure, volume, control) -> list[Branch]:
    """One branch for every run of rows with a state; stable where the control rises with the stretch of the apex."""
    apex = np.asarray(rows.apex_stretch)
    with np.errstate(invalid="ignore"):
        ratio = np.sqrt(q / np.asarray(rows.breakdown_load))
    found = np.isfinite(q) & np.isfinite(pressure) & np.isfinite(volume)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], found.astype(np.int8), [0]])))
    branches = []
    for run in (slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)):
        if run.stop - run.start < 3:
            continue
        nothing = np.full(run.stop - run.start, np.nan)
        branches.append(
            Branch(
                *(q[run], pressure[run], volume[run], apex[run], nothing, nothing),
                ratio[run],
                (np.gradient(control[run], apex[run]) < 0).astype(int),
                *(nothing, Code.surface_edge, Code.surface_edge),
            )
        )
    return branches


@cached_jit
def _breakdown_load(surface: Surface, apex):
    return surface.breakdown_load(apex)


def _states(rows: Rows, found, make=State, **more) -> list:
    """The records of those of some points (arrays of one shape) that are there."""
    values = np.array([np.atleast_1d(v) for v in found])
    with np.errstate(invalid="ignore"):
        # a fold below zero voltage has no place in the picture
        apex, pressure, q, volume, error = values[:, np.isfinite(values[:4]).all(axis=0) & (values[LOAD] >= 0)]
    count = len(apex)
    if not count:
        return []
    limit = run_lanes(lambda part: _breakdown_load(rows.surface, part), apex, sizes=MOST_PRESSURE_POINTS)
    columns = {"voltage_squared": q, "pressure": pressure, "volume": volume, "apex_stretch": apex}
    columns |= {"breakdown_ratio": np.sqrt(q / limit), "error_estimate": error}
    rest = {"height": np.nan, "charge": np.nan, "index": None} | more
    return [make(**{name: float(values[k]) for name, values in columns.items()}, **rest) for k in range(count)]


def _points(rows: Rows, kind: str, found, branches: list[Branch]) -> list[SpecialPoint]:
    points = []
    for point in _states(rows, found, SpecialPoint, kind=kind):
        branch = [k for k, b in enumerate(branches) if b.apex_stretch[0] <= point.apex_stretch <= b.apex_stretch[-1]]
        points.append(dataclasses.replace(point, branch=branch[0] if branch else 0))
    return points


def _events(rows: Rows, ramps: Ramps, outcome: Outcome) -> typing.Iterator[Event]:
    """The events of the way up, then of the way down."""
    one = {name: _states(rows, getattr(ramps, name)) for name in ("start", "breakdown", "rest")}
    jumps = {
        name: [_states(rows, [v[k] for v in getattr(ramps, name)]) for k in range(2)]
        for name in ("snap", "landing", "snap_back", "landing_back")
    }
    for start in one["start"]:
        yield Event(RampEvent.start, "up", start, "start_unstable" if outcome == Outcome.start_unstable else None)
    for snap, landing in zip(jumps["snap"], jumps["landing"], strict=True):
        yield from (Event(RampEvent.snap, "up", s) for s in snap)
        yield from (Event(RampEvent.landing, "up", s) for s in landing)
        if snap and not landing:
            yield Event(RampEvent.no_landing, "up", snap[0], "no landing")
        elif landing and outcome == Outcome.breakdown_in_snap and landing[0].breakdown_ratio >= 1:
            yield Event(RampEvent.breakdown, "up", landing[0], "breakdown in the snap")
    yield from (Event(RampEvent.breakdown, "up", s, "breakdown on the branch") for s in one["breakdown"])
    for snap, landing in zip(jumps["snap_back"], jumps["landing_back"], strict=True):
        yield from (Event(RampEvent.snap_back, "down", s) for s in snap)
        yield from (Event(RampEvent.landing, "down", s) for s in landing)
    yield from (Event(RampEvent.end, "down", s, "zero voltage") for s in one["rest"])


@cached_jit
def _on_surface(surface: Surface, apex, q):
    """p, V, the bound of their error, and E/E_EB at (λa, q)."""
    state = surface(apex, q)
    ratio = jnp.sqrt(q / surface.breakdown_load(apex))
    return state.pressure, state.volume, surface.error_bound(apex, q), ratio


@cached_jit
def _located(surface: Surface, apex, q):
    """From λa near the extremes of p at q, and near breakdown: those λa by Newton's method, of one shape each."""

    def slope(a, q):
        return jax.jvp(lambda x: surface(x, q).pressure, (a,), (jnp.ones_like(a),))[1]

    def excess(a, q):
        return surface.breakdown_load(a) - q

    how: dict = {"steps": GLANCE_NEWTON, "tolerance": None, "elementwise": True}
    return root_find(slope, apex[0], q, **how).value, root_find(excess, apex[1], q, **how).value


def _pressure_volume(scene: Scene, surface: Surface, voltage: float) -> Glance:
    rows = rows_of(ById(surface))
    apex = np.asarray(rows.apex_stretch)
    q = np.full_like(apex, voltage**2)
    pressure, volume, *_ = map(np.asarray, _on_surface(rows.surface, apex, q))
    branches = _branches(rows, q, pressure, volume, pressure)
    if not branches:
        raise SceneError(Code.surface_edge, _NOTHING)
    points = [p for k, b in enumerate(branches) if len(b) > 6 for p in _extremes(rows.surface, b, k)]
    parts = _Parts("pressure-volume", scene, branches, points, voltage)
    return parts.glance(events=(), outcome=None, regime=Regime.not_decided, area_strain=np.nan, several=False)


def _extremes(surface: Surface, branch: Branch, number: int) -> typing.Iterator[SpecialPoint]:
    """Folds of the pressure and breakdown along a branch: guessed by splines through its rows, located on the surface."""
    place = np.arange(len(branch), dtype=float)
    q = branch.voltage_squared[0]
    rising = make_interp_spline(place, branch.pressure, k=5).derivative()
    excess = make_interp_spline(place, np.nan_to_num(branch.breakdown_ratio) - 1, k=5)
    apex = make_interp_spline(place, branch.apex_stretch, k=5)
    guesses = [apex(PPoly.from_spline(line).roots(extrapolate=False)) for line in (rising, excess)]
    packed = np.stack(
        [
            np.pad(g[:MOST_PRESSURE_POINTS], (0, max(0, MOST_PRESSURE_POINTS - len(g))), constant_values=np.nan)
            for g in guesses
        ]
    )
    located = np.stack(_located(surface, packed, q))
    pressure, volume, error, ratio = map(np.asarray, _on_surface(surface, located, np.full_like(located, q)))
    with np.errstate(invalid="ignore"):
        found = np.isfinite(pressure) & (np.abs(located - packed) < GLANCE_REACH)
    for kind, row in ((PointKind.fold, 0), (PointKind.breakdown, 1)):
        for k in np.flatnonzero(found[row]):
            a, p, v, e, r = (float(values[row, k]) for values in (located, pressure, volume, error, ratio))
            yield SpecialPoint(float(q), p, v, a, np.nan, np.nan, r, None, e, kind=kind, branch=number)
