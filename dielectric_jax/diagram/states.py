"""Single states: `equilibrium`, flat films, the filling of a chamber; and points as records."""

import math
import typing

import jax
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import root_scalar

from ..model import (
    MOST_STEPS,
    Chamber,
    ConstantPressure,
    ConstantVoltage,
    Membrane,
    OutOfReach,
    Points,
    PrescribedVolume,
    Scene,
    Shooting,
    ShootingMethod,
    State,
    Units,
    Window,
    as_scalar,
    cached_scan,
    capacitance,
    field_on,
    is_concrete,
    largest_load,
    map_nodes,
    mechanical,
    other_loading,
    require_float64,
    shooting_of,
    stretch_shares,
    voltage_of,
)
from ..numerics import Code, SceneError, check_positive, shown
from ..surface import Surface, pressure_and_volume
from .resolution import FLATTEST, MOST_STATE_ERROR, NEAR_EXTREME, NEAREST_CONE, WRINKLED

__all__ = ["filling", "flat_state", "membrane_states", "states_of"]


def check_request(points: int, tolerance: float) -> None:
    if not (isinstance(points, int) and 8 <= points <= 100_000):
        raise ValueError(f"`points` must be a whole number from 8 to 100000, but is {points!r}.")
    if not 1e-12 <= tolerance <= 1e-3:
        raise ValueError(f"`tolerance` must lie between 1e-12 and 0.001, but is {shown(tolerance)}.")
    require_float64()


def check_surface(surface, membrane: Membrane, method: ShootingMethod | None = None) -> None:
    if surface is not None and method is not None:
        raise ValueError("`method` must be left out with a surface, on which nothing is integrated.")
    if surface is not None and not (isinstance(surface, Surface) and surface.belongs_to(membrane)):
        raise ValueError(f"`surface` must be built for the membrane of the scene, but is {surface!r}.")


def check_concrete(scene) -> None:
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves(scene)):
        raise ValueError(
            "`scene` must hold numbers here, but is being transformed by JAX; diagrams are built outside "
            "transformations, derivatives of states come from `shoot`."
        )


def states_of(points: Points, tolerance: float) -> list[State]:
    """The lanes as records."""
    q = points.u[2]
    with np.errstate(invalid="ignore"):
        charge = points.charge_per_voltage * voltage_of(q)
        ratio = np.where(q >= 0, np.sqrt(np.abs(q) * points.field), np.nan)
    return [
        State(
            voltage_squared=float(q[i]),
            pressure=float(points.u[1, i]),
            volume=float(points.volume[i]),
            apex_stretch=float(points.u[0, i]),
            height=float(points.height[i]),
            charge=float(charge[i]),
            breakdown_ratio=float(ratio[i]),
            index=int(points.index[i]) if points.index[i] >= 0 else None,
            error_estimate=float(points.error[i]),
            flags=("error_above_tolerance",) * (not points.error[i] <= tolerance)
            + ("index_not_valid",) * bool(points.index[i] < 0)
            + ("hoop_tension_lost",) * bool(points.hoop[i] < -WRINKLED),
        )
        for i in range(len(points))
    ]


def flat_state(membrane: Membrane, q: float) -> State:
    """λ1 = λ2 = λ0, p = V = 0: charge π Φ C(λ0, λ0), π Φ λ0⁴ where e = 1."""
    stretch = float(membrane.prestretch)
    phi = math.sqrt(q) if q >= 0 else math.nan
    ratio = phi * stretch**2 / float(field_on(membrane.breakdown, stretch)) if q >= 0 else math.nan
    charge = math.pi * phi * float(capacitance(membrane.material, stretch, stretch))
    return State(q, 0.0, 0.0, stretch, 0.0, charge, ratio, 0, 1e-13)


def filling(scene: Scene, tolerance: float, method: ShootingMethod | None = None) -> tuple[float | None, float | None]:
    """(p_0, V_0) of a chamber at zero voltage, (0, 0) for a flat film, (None, None) without a chamber."""
    loading, membrane = mechanical(scene.loading), scene.membrane
    if isinstance(loading, ConstantPressure):
        filled = float(loading.pressure) > 0
    elif isinstance(loading, PrescribedVolume):
        filled = float(loading.volume) > 0
    elif not isinstance(loading, Chamber):
        raise other_loading(loading, Chamber, ConstantPressure, PrescribedVolume)
    elif loading.initial_volume is not None:
        filled = float(loading.initial_volume) > 0
    else:
        filled = float(typing.cast(float, loading.initial_pressure)) > 0
    if not filled:
        if float(membrane.prestretch) == 1.0:
            raise SceneError(Code.flat_unstretched)
        return 0.0, 0.0
    if not isinstance(loading, Chamber):
        return None, None
    name = "initial_volume" if loading.initial_volume is not None else "initial_pressure"
    wanted = float(getattr(loading, name))
    filled = _filled_state(membrane, name.removeprefix("initial_"), wanted, tolerance, method)
    if filled is None:
        if too_flat(membrane, name.removeprefix("initial_"), wanted):
            raise SceneError(Code.near_flat)
        most = _reach(membrane, name.removeprefix("initial_"))
        what = "what the membrane reaches at zero voltage up to its largest stretch"
        raise OutOfReach(name, most, what, wanted, scene.units)
    return (filled[0], wanted) if name == "initial_volume" else (wanted, filled[1])


def _zero_load_line(membrane: Membrane):
    """λa, p and V of the scan interpolated to zero load: starts for Newton at zero voltage."""
    limits = Scene(membrane, ConstantVoltage(0.0)).limits()
    chart = cached_scan(membrane, limits[0], limits[2])
    first = int(np.clip(np.searchsorted(chart.load_fraction, 0.0) - 2, 0, len(chart.load_fraction) - 4))
    near = slice(first, first + 4)
    weights = np.linalg.solve(np.vander(chart.load_fraction[near], increasing=True).T, [1.0, 0.0, 0.0, 0.0])
    pressure, volume = (np.exp(np.log(field[:, near]) @ weights) for field in (chart.pressure, chart.volume))
    return chart.apex_stretch, pressure, volume


def _filled_state(
    membrane: Membrane, quantity: str, wanted: float, tolerance: float, method: ShootingMethod | None
) -> tuple[float, float] | None:
    """p and V of the state of smallest volume at zero voltage with the wanted pressure or volume."""
    apex, pressure, volume = _zero_load_line(membrane)
    value = np.log((pressure if quantity == "pressure" else volume) / wanted)
    crossing = np.flatnonzero(value[:-1] * value[1:] <= 0)
    if len(crossing) and not _touches(value[: crossing[0] + 1]):
        guess = _crossing_state(apex, pressure, value, float(membrane.prestretch), int(crossing[0]))
        row = [[np.nan] * 3] if quantity == "volume" else [[0.0, 1.0, 0.0]]
        engine = shooting_of(membrane, ConstantVoltage(0.0).condition(), method)
        found = engine.corrected_points(np.array(guess), np.array(row), np.array([wanted]), tolerance=tolerance / 100)
        if found.ok[0] and found.error[0] <= tolerance:
            return float(found.u[1, 0]), float(found.volume[0])
    try:  # near the peak of the pressure, or at the window's edge: the fine search
        state = membrane_states(membrane, voltage=0.0, tolerance=tolerance, method=method, **{quantity: wanted})[0]  # pyright: ignore[reportArgumentType]
    except (SceneError, ValueError):
        return None
    return state.pressure, state.volume


def _touches(value: np.ndarray) -> bool:
    """Whether a function may vanish between nodes that all have one sign: near a turn its nodes come as near as they change."""
    change, inner = np.diff(np.abs(value)), np.abs(value[1:-1])
    least = (change[:-1] <= 0) & (change[1:] >= 0)
    return bool((least & (inner <= np.maximum(-change[:-1], change[1:]))).any())


def too_flat(membrane: Membrane, quantity: str, wanted: float, q: float = 0.0) -> bool:
    """Whether a value belongs to a tense membrane nearer to flat than the first of the scan's stretches."""
    apex, pressure, volume = _zero_load_line(membrane)
    first = {"pressure": pressure, "volume": volume, "apex_stretch": apex}[quantity][0]
    return bool(wanted < first and q <= float(largest_load(membrane.material, float(membrane.prestretch))))


def _crossing_state(apex, pressure, value, prestretch: float, i: int) -> list:
    """λa, p, q = 0 where `value` vanishes between nodes i and i + 1, by quintics through six nodes."""
    first = min(max(i - 2, 0), len(value) - 6)
    near = slice(first, first + 6)
    logs = np.stack([value[near], np.log(apex[near] - prestretch), np.log(pressure[near])])
    if not np.isfinite(logs).all():
        return [[apex[i]], [pressure[i]], [0.0]]
    along = make_interp_spline(np.arange(6.0), logs, k=5, axis=1)
    place = root_scalar(lambda x: along(x)[0], bracket=(i - first, i - first + 1)).root
    _, stretch, log_p = along(place)
    return [[prestretch + math.exp(stretch)], [math.exp(log_p)], [0.0]]


def _reach(membrane: Membrane, quantity: str) -> float:
    return float(np.nanmax(_zero_load_line(membrane)[1 if quantity == "pressure" else 2]))


def membrane_states(
    membrane: Membrane,
    *,
    voltage: float = 0.0,
    pressure: float | None = None,
    volume: float | None = None,
    apex_stretch: float | None = None,
    tolerance: float = 1e-9,
    window: Window | None = None,
    surface: Surface | None = None,
    method: ShootingMethod | None = None,
) -> list[State]:
    """The equilibria of a membrane at a voltage and one of pressure, volume or apex stretch, by volume; see `equilibrium`."""
    check_request(8, tolerance)
    given = {
        n: v for n, v in (("pressure", pressure), ("volume", volume), ("apex_stretch", apex_stretch)) if v is not None
    }
    if len(given) != 1:
        raise ValueError(
            f"`pressure`, `volume` or `apex_stretch` must be given, one of the three, but {len(given)} are."
        )
    ((name, wanted),) = given.items()
    wanted, voltage = float(as_scalar(wanted)), float(as_scalar(voltage))
    check_positive(name, wanted, zero=name != "apex_stretch")
    check_positive("voltage", voltage, zero=True)
    scene = Scene(membrane, ConstantVoltage(voltage), window or Window())
    check_concrete(scene)
    limits = scene.limits()
    prestretch = float(membrane.prestretch)
    if name == "apex_stretch" and not prestretch <= wanted <= limits[0][1]:
        raise ValueError(
            f"`apex_stretch` must lie between the prestretch {prestretch:g} and the end of the window "
            f"{limits[0][1]:.6g}, but is {wanted!r}."
        )
    if (name == "apex_stretch" and wanted == prestretch) or wanted == 0:
        return [_flat_equilibrium(membrane, voltage)]
    condition = scene.loading.condition()
    check_surface(surface, membrane)
    engine = shooting_of(membrane, condition, method)
    found, extremes = _starts(membrane, voltage**2, name, wanted, limits, surface)
    results = [_beside_extreme(engine, extreme, name, wanted, tolerance) for extreme in extremes]
    if found.size:
        rows = {"apex_stretch": [1.0, 0, 0], "pressure": [0, 1.0, 0], "volume": [np.nan] * 3}[name]
        lanes = found.shape[1]
        plane = np.tile(rows, (lanes, 1)), np.full(lanes, wanted)
        results.append(engine.corrected_points(found, *plane, tolerance=tolerance, reach=1.0))
    states, vague = _distinct_states(membrane, results, tolerance)
    if not states:
        if name == "volume":
            check_reachable(membrane, wanted)
        flat = too_flat(membrane, name, wanted, voltage**2)
        raise SceneError(Code.near_flat if flat else Code.beyond_tolerance if vague else Code.no_equilibrium)
    return sorted(states, key=lambda s: s.volume)


def _distinct_states(membrane: Membrane, results: list[Points], tolerance: float) -> tuple[list[State], bool]:
    """The states of points, each once, and whether some were left out because their error is too large."""
    states: list[State] = []
    vague = False
    for result in results:
        for state in states_of(result.take(np.flatnonzero(result.ok)), tolerance):
            # an unstretched film's tension comes from λa − λ0 alone, which rounding leaves no digits of
            prestretch = float(membrane.prestretch)
            unstretched = prestretch - 1 < FLATTEST and state.apex_stretch - prestretch < FLATTEST
            if unstretched or not state.error_estimate <= MOST_STATE_ERROR:
                vague = True
            elif not any(_same(state, other) for other in states):
                states.append(state)
    return states, vague


def check_reachable(membrane: Membrane, volume: float, units: Units | None = None) -> None:
    """Refuses a volume that the membrane does not reach."""
    most = _reach(membrane, "volume")
    if volume > most:
        raise OutOfReach("volume", most, "what the membrane reaches up to its largest stretch", volume, units)
    if too_flat(membrane, "volume", volume):
        raise SceneError(Code.near_flat)


def _beside_extreme(engine: Shooting, extreme, name: str, wanted: float, tolerance: float) -> Points:
    """The two states, or none, whose p or V is very near an extreme on a line of the chart.

    There the value tells λa badly, but λa the value well: exact states at seven stretches give a polynomial, its roots the
    stretches.
    """
    top, reach, pressure, load = extreme

    def exact(apex):
        u = np.stack([apex, np.full(len(apex), pressure), np.full(len(apex), load)])
        return engine.corrected_points(u, np.tile([1.0, 0, 0], (len(apex), 1)), apex, tolerance=tolerance / 100)

    x = np.cos(np.pi * (np.arange(7) + 0.5) / 7)
    points = exact(top + reach * x)
    value = points.u[1] if name == "pressure" else points.volume
    if not points.ok.all():
        return points.take(slice(0, 0))
    roots = (np.polynomial.Polynomial(np.linalg.solve(np.vander(x, increasing=True), value)) - wanted).roots()
    roots = roots[np.isreal(roots) & (np.abs(roots) <= 1)].real
    return exact(top + reach * roots) if len(roots) else points.take(slice(0, 0))


def _same(one: State, other: State) -> bool:
    """Whether two starts have led to one state: beside a fold λa is less exact, but there the indices of two differ."""
    near = abs(one.apex_stretch / other.apex_stretch - 1)
    return near < 1e-9 or (near < 1e-6 and one.index == other.index)


def _flat_equilibrium(membrane: Membrane, voltage: float) -> State:
    stretch = float(membrane.prestretch)
    if stretch == 1.0:
        raise SceneError(Code.flat_unstretched)
    if voltage**2 > float(largest_load(membrane.material, stretch)):
        raise SceneError(Code.no_equilibrium, "The flat film is slack at this voltage.")
    return flat_state(membrane, voltage**2)


def _line_states(membrane: Membrane, apex, fraction, surface: Surface | None):
    """p, V and the map's mark of validity at points (λa, t): by the surface in its domain, by the explicit map elsewhere."""
    values = np.full((3, len(apex)), np.nan)
    if surface is not None:
        values[:2] = pressure_and_volume(surface, apex, fraction)
        values[2] = -1.0
    rest = ~np.isfinite(values).all(axis=0)
    if rest.any():
        rim = float(membrane.prestretch)
        for which, steps in ((rest & (fraction <= 0.9), 96.0), (rest & (fraction > 0.9), float(MOST_STEPS))):
            if which.any():
                values[:, which] = map_nodes(membrane.material, apex[which], fraction[which], rim, steps)
    return values


def _towards_cones(membrane, q: float, apex: np.ndarray) -> np.ndarray:
    """The stretches with more of them, geometrically closer, towards those at which q is q_max(λa)."""

    def excess(stretch):
        return q / largest_load(membrane.material, stretch) - 1

    over = excess(apex) >= 0
    more = [apex]
    for i in np.flatnonzero(over[:-1] != over[1:]):
        cone = root_scalar(excess, bracket=(apex[i], apex[i + 1]), xtol=1e-15).root
        side = -1 if over[i + 1] else 1
        reach = apex[np.clip(i + 12 * side, 0, len(apex) - 1)] - cone
        more.append(cone + reach * np.geomspace(1.0, 1e-6, 160))
    return np.unique(np.concatenate(more))


class _Line(typing.NamedTuple):
    """States on a line of the chart at one load, by rising λa; `rows` numbers them along the line, as some may be missing."""

    load: float
    apex: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    rows: np.ndarray


def _line_at_load(membrane, q: float, limits, wanted_apex: float | None, surface) -> _Line:
    """Tensile states at load q over the window, on nodes that crowd at its ends; one of them at `wanted_apex`, if given."""
    (low, high), _, loads = limits
    prestretch = float(membrane.prestretch)
    share = stretch_shares(max((low - prestretch) / (high - prestretch), 1e-9), 640)
    apex = np.minimum(prestretch + (high - prestretch) * share, high)
    if wanted_apex is not None:
        apex = np.sort(np.append(apex, wanted_apex))
    apex = _towards_cones(membrane, q, apex)
    fraction = q / largest_load(membrane.material, apex)
    inside = (fraction <= min(loads[1], 1 - NEAREST_CONE)) & (fraction >= loads[0])
    if not inside.any():
        nothing = np.zeros(0)
        return _Line(q, nothing, nothing, nothing, np.zeros(0, int))
    pressure, volume, slope = _line_states(membrane, apex[inside], fraction[inside], surface)
    ok = (slope < 0) & np.isfinite(pressure) & np.isfinite(volume) & (pressure > 0) & (volume > 0)
    return _Line(q, apex[inside][ok], pressure[ok], volume[ok], np.flatnonzero(inside)[ok])


def _beside_extremes(line: _Line, value: np.ndarray) -> tuple[list[np.ndarray], list[tuple]]:
    """Pairs of λa about an extreme of `value` between nodes that crosses zero, and extremes close to zero themselves.

    The quintic through six neighbours gives the height of an extreme, which is its λa, the reach of λa about it, p and q.
    """
    apex, joined = line.apex, np.diff(line.rows) == 1
    guesses, extremes = list[np.ndarray](), list[tuple]()
    for i in np.flatnonzero(np.diff(value)[:-1] * np.diff(value)[1:] < 0) + 1:
        first = min(max(i - 2, 0), len(value) - 6)
        if first < 0 or not joined[i - 1 : i + 1].all():
            continue
        reach = apex[i + 1] - apex[i - 1]
        x = (apex[first : first + 6] - apex[i]) / reach
        quintic = np.polynomial.Polynomial(np.linalg.solve(np.vander(x, increasing=True), value[first : first + 6]))
        slope, bend = quintic.deriv(), quintic.deriv(2)
        top = 0.0
        for _ in range(8):
            top -= float(np.clip(slope(top) / bend(top), -0.25, 0.25))
        if not -1 <= top <= 1:
            continue
        depth, curvature = quintic(top), bend(top)
        if abs(depth) < NEAR_EXTREME:
            extremes.append((apex[i] + reach * top, reach, float(line.pressure[i]), line.load))
        elif value[i - 1] * value[i] > 0 and value[i] * value[i + 1] > 0 and depth * curvature < 1e-9 * curvature**2:
            half = min(math.sqrt(max(-2 * depth / curvature, 1e-9)), 1.0)
            guesses.append(np.clip(apex[i] + reach * np.array([top - half, top + half]), apex[0], apex[-1]))
    return guesses, extremes


def _starts(membrane, q, name, wanted, limits, surface=None) -> tuple[np.ndarray, list[tuple]]:
    """Guesses (3, n) for every state at load q with the wanted value, from a line of the chart; and near extremes."""
    prestretch = float(membrane.prestretch)
    line = _line_at_load(membrane, q, limits, wanted if name == "apex_stretch" else None, surface)
    apex, pressure = line.apex, line.pressure
    if len(apex) < 2:
        return np.zeros((3, 0)), []
    if name == "apex_stretch":
        i = int(np.argmin(np.abs(apex - wanted)))
        there = abs(apex[i] - wanted) < 1e-12
        return (np.array([[apex[i]], [pressure[i]], [q]]) if there else np.zeros((3, 0))), []
    value = np.log((pressure if name == "pressure" else line.volume) / wanted)
    guesses, extremes = _beside_extremes(line, value)
    crossed = np.flatnonzero((value[:-1] * value[1:] <= 0) & (np.diff(line.rows) == 1))
    with np.errstate(invalid="ignore"):
        share = np.nan_to_num(value[crossed] / (value[crossed] - value[crossed + 1]), nan=0.5)
    single = apex[crossed] + share * np.diff(apex)[crossed]
    for top, reach, *_ in extremes:
        single = single[np.abs(single - top) > reach]
    logs = np.log(pressure)
    places = np.concatenate([single, *guesses])
    out = [[a, p, q] for a, p in zip(places, np.exp(np.interp(places, apex, logs)), strict=True)]
    if value[0] > 0 and line.rows[0] == 0:
        # below the first node: p and V are powers of λa − λ0 at the flat end
        rise = np.log((apex[1] - prestretch) / (apex[0] - prestretch)) / (value[1] - value[0])
        fall = -value[0] * rise
        slope = (logs[1] - logs[0]) / np.log((apex[1] - prestretch) / (apex[0] - prestretch))
        out.append([prestretch + (apex[0] - prestretch) * math.exp(fall), math.exp(logs[0] + slope * fall), q])
    return (np.array(out).T if out else np.zeros((3, 0))), extremes
