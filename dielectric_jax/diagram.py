"""Diagrams: branches, special points, and the ramp an experiment would see.

`pressure_volume` holds the voltage, `voltage_volume` holds a chamber's filling or the pressure; `equilibrium` asks for
single states. All computing is dimensionless.
"""

import dataclasses
import math

import equinox as eqx
import jax
import numpy as np

from .branches import Curve, cached_scan, find_curves
from .critical import Located, brackets, fold_events, locate, special_points
from .equilibria import Points, polish
from .loading import Chamber, ConstantPressure, ConstantVoltage, Contour
from .materials import is_concrete, largest_load
from .membrane import Membrane, require_float64
from .ramp import build_ramp, build_way_back
from .records import Branch, Ramp, SpecialPoint, State, plain, voltage_of
from .results import Code, SceneError, check_positive
from .scene import SCANNED_LOAD, Scene, Window, describe

__all__ = ["Diagram", "equilibrium", "pressure_volume", "voltage_volume"]


@dataclasses.dataclass(frozen=True)
class Diagram:
    """All branches of a scene in its window, their special points, and the ramp.

    `complete` says whether scan and continuation agree on the branches of the scanned window.
    """

    kind: str
    scene: Scene
    branches: list[Branch]
    special_points: list[SpecialPoint]
    complete: bool
    tolerance: float
    limits: tuple
    engine: str = "continuation"
    voltage: float | None = None
    contour: Contour | None = None
    _up: Ramp | None = None
    _down: Ramp | None = None
    _solver: object = None

    def ramp(self, direction: str = "up", start: State | None = None) -> Ramp:
        """What a slow ramp of the voltage does: "up" from zero, or "down" from `start`.

        By default the way down starts halfway in voltage between the last landing (else the start) and the end of the way up.
        Raises ValueError for a pressure–volume curve, and where there is no way down.
        """
        if direction not in ("up", "down"):
            raise ValueError(f"`direction` must be 'up' or 'down', but is {direction!r}.")
        if self._up is None:
            raise ValueError("`ramp` must be asked of a voltage–volume diagram; a pressure–volume curve has none.")
        if direction == "up":
            if start is not None:
                raise ValueError("`start` must be left out on the way up, which starts at zero voltage.")
            return self._up
        if start is not None:
            return build_way_back(self._solver, start)
        if self._down is None:
            raise ValueError("`direction` must be 'up' here: the way up ends without an unbroken state to come back from.")
        return self._down

    @property
    def events(self) -> tuple:
        """Events of the way up, then of the way down."""
        return (self._up.events if self._up else ()) + (self._down.events if self._down else ())

    @property
    def area_strain(self) -> float | None:
        """(λa at breakdown / λa at the start)² − 1 of the ramp up, see `Ramp`."""
        return self._up.area_strain if self._up else None

    @property
    def area_strain_reason(self) -> str | None:
        """Why the area strain is taken where it is."""
        return self._up.area_strain_reason if self._up else None

    def gas_pressure(self, volume) -> np.ndarray | None:
        """The pressure of the chamber's gas at `volume`; None where the pressure is held."""
        if not isinstance(self.scene.loading, Chamber) or self.contour is None:
            return None
        return np.asarray(self.contour.gas_pressure(np.asarray(volume, float)))

    def plot(self, **options):
        """The diagram as a matplotlib figure, see `plotting.plot_diagram`."""
        from .plotting import plot_diagram

        return plot_diagram(self, **options)

    def to_json(self) -> dict:
        """The JSON document of the contract."""
        stretches, _, loads = self.limits
        ramp = None if self._up is None else [e.to_json() for e in self.events]
        return plain(
            {
                "scene": describe(self.scene),
                "units": "dimensionless",
                "engine": self.engine,
                "window": {
                    "apex_stretch": list(stretches),
                    "load_fraction": list(loads),
                    "scanned_load_fraction": [loads[0], min(loads[1], SCANNED_LOAD)],
                },
                "complete": self.complete,
                "tolerance": self.tolerance,
                "branches": [b.to_json() for b in self.branches],
                "special_points": [p.to_json() for p in self.special_points],
                "ramp": ramp,
                "area_strain": self.area_strain,
                "area_strain_reason": self.area_strain_reason,
            }
        )

    def __repr__(self) -> str:
        lines = [f"Diagram({self.kind}, engine={self.engine}, complete={self.complete}"]
        lines += [f"  {b!r}" for b in self.branches]
        lines += [f"  {p!r}" for p in self.special_points]
        if self._up is not None:
            strain = "none" if self.area_strain is None else f"{self.area_strain:.6g}"
            path = " → ".join(e.event for e in self._up.events)
            lines.append(f"  ramp: {path}; area strain {strain} ({self.area_strain_reason})")
        return "\n".join(lines) + ")"


def _check(points: int, tolerance: float) -> None:
    if not (isinstance(points, int) and 8 <= points <= 100_000):
        raise ValueError(f"`points` must be a whole number from 8 to 100000, but is {points!r}.")
    if not (math.isfinite(tolerance) and 1e-12 <= tolerance <= 1e-3):
        raise ValueError(f"`tolerance` must lie between 1e-12 and 0.001, but is {tolerance!r}.")
    require_float64()


def _concrete(scene) -> None:
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
            index=int(points.index[i]),
            error_estimate=float(points.error[i]),
            flags=("error_above_tolerance",) if not points.error[i] <= tolerance else (),
        )
        for i in range(len(points))
    ]


def _branch(curve: Curve, tolerance: float) -> Branch:
    states = states_of(curve.points, tolerance)
    columns = {f: np.array([getattr(s, f) for s in states]) for f in State.__dataclass_fields__ if f != "flags"}
    columns["index"] = columns["index"].astype(int)
    return Branch(**columns, start=curve.start, end=curve.end, flags=curve.flags)


def _special(located: Located, tolerance: float) -> SpecialPoint:
    state = states_of(located.point, tolerance)[0]
    kind = "fold" if located.kind == "pressure_fold" else located.kind
    values = {f: getattr(state, f) for f in State.__dataclass_fields__}
    values["index"] = None if kind == "fold" else state.index
    values["error_estimate"] = located.error
    if kind == "zero_voltage":
        values |= {"voltage_squared": 0.0, "charge": 0.0, "breakdown_ratio": 0.0}
    values["flags"] = ("error_above_tolerance",) if not located.error <= tolerance else ()
    return SpecialPoint(**values, kind=kind, branch=located.branch, position=located.position)


@dataclasses.dataclass
class Solved:
    """What ramps need of a scene: membrane, contour, exact branches, located points."""

    membrane: Membrane
    contour: Contour
    curves: list[Curve]
    located: list[Located]
    tolerance: float

    def states_at_load(self, voltage_squared: float) -> list[Located]:
        """All states at one q, on all branches."""
        wanted = [
            ("load", b, int(i), voltage_squared)
            for b, curve in enumerate(self.curves)
            for i in brackets(curve, "load", voltage_squared)
        ]
        return locate(self.membrane, self.contour, self.curves, wanted, self.tolerance)

    def state(self, located: Located) -> State:
        """The record of a located state."""
        return _special(located, self.tolerance)


def _solve(membrane, contour, limits, kinds, points, tolerance) -> tuple[Solved, bool]:
    curves, complete = find_curves(membrane, contour, limits, count=points, tolerance=tolerance)
    fold = kinds[0]
    curves = [fold_events(fold, membrane, contour, c, tolerance) for c in curves]
    located = special_points(membrane, contour, curves, kinds, tolerance)
    return Solved(membrane, contour, curves, located, tolerance), complete


def _flat_state(membrane: Membrane, q: float) -> State:
    """λ1 = λ2 = λ0, p = V = 0: charge π Φ λ0⁴."""
    stretch = float(membrane.prestretch)
    phi = math.sqrt(q) if q >= 0 else math.nan
    ratio = phi * stretch**2 / float(membrane.breakdown.field(stretch)) if q >= 0 else math.nan
    return State(q, 0.0, 0.0, stretch, 0.0, math.pi * phi * stretch**4, ratio, 0, 1e-13)


def pressure_volume(
    membrane: Membrane, voltage: float = 0.0, *, points: int = 256, tolerance: float = 1e-9, window: Window | None = None
) -> Diagram:
    """The pressure–volume curve of a membrane at a fixed voltage: branches and folds in pressure.

    Arguments: `voltage` Φ in units of H√(μ/ε); `points` a branch; `tolerance` of the error estimate.
    Raises ValueError for bad input and SceneError where no tensile equilibrium lies in the window.

    >>> curve = pressure_volume(Membrane(), voltage=0.0)
    >>> [round(p.pressure, 9) for p in curve.special_points if p.kind == "fold"]
    [1.908684829, 1.361703319]
    """
    _check(points, tolerance)
    scene = Scene(membrane, ConstantVoltage(voltage), window or Window())
    _concrete(scene)
    limits = scene.limits()
    contour = scene.loading.contour()
    solved, complete = _solve(
        membrane, contour, limits, ("pressure_fold", "breakdown", "hoop_tension_loss"), points, tolerance
    )
    if not solved.curves:
        raise SceneError(Code.no_equilibrium)
    branches = [_branch(c, tolerance) for c in solved.curves]
    special = [_special(p, tolerance) for p in solved.located]
    return Diagram(
        "pressure-volume", scene, branches, special, complete, tolerance, limits, voltage=float(voltage), contour=contour
    )


def voltage_volume(scene: Scene, *, points: int = 256, tolerance: float = 1e-9) -> Diagram:
    """The voltage–volume diagram of a membrane on a chamber or at constant pressure, with its special points and ramp.

    Raises ValueError for bad input and SceneError where no tensile equilibrium lies in the window.

    >>> from dielectric_jax import Chamber
    >>> scene = Scene(membrane=Membrane(), loading=Chamber(volume=1600.0, initial_volume=2.42))
    >>> diagram = voltage_volume(scene)
    >>> [event.event for event in diagram.ramp().events]
    ['start', 'snap', 'landing', 'breakdown']
    >>> round(diagram.ramp()["snap"][0].state.voltage, 9), round(diagram.area_strain, 4)
    (0.07649536, 16.1215)
    """
    _check(points, tolerance)
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is {scene!r}.")
    _concrete(scene)
    loading = scene.loading
    if isinstance(loading, ConstantVoltage):
        raise ValueError("`loading` must be a Chamber or a ConstantPressure here; see pressure_volume for a fixed voltage.")
    limits = scene.limits()
    filling = _filling(scene, tolerance)
    if filling == (0.0, 0.0):
        return _flat_diagram(scene, limits, points, tolerance)
    contour = loading.contour(*filling)
    kinds = ("fold", "zero_voltage", "breakdown", "hoop_tension_loss")
    solved, complete = _solve(scene.membrane, contour, limits, kinds, points, tolerance)
    if not solved.curves:
        raise SceneError(Code.no_equilibrium)
    branches = [_branch(c, tolerance) for c in solved.curves]
    special = [_special(p, tolerance) for p in solved.located]
    volume = filling[1] if isinstance(loading, Chamber) else None
    up, down = build_ramp(solved, volume)
    return Diagram(
        "voltage-volume", scene, branches, special, complete, tolerance, limits, contour=contour, _up=up, _down=down, _solver=solved
    )


def _filling(scene: Scene, tolerance: float) -> tuple[float | None, float | None]:
    """(p_0, V_0) of a chamber at zero voltage, (0, 0) for a flat film, (None, None) without a chamber."""
    loading, membrane = scene.loading, scene.membrane
    flat = (0.0, 0.0)
    if isinstance(loading, ConstantPressure):
        filled = float(loading.pressure) > 0
    elif loading.initial_volume is not None:
        filled = float(loading.initial_volume) > 0
    else:
        filled = float(loading.initial_pressure) > 0
    if not filled:
        if float(membrane.prestretch) == 1.0:
            raise SceneError(Code.flat_unstretched)
        return flat
    if isinstance(loading, ConstantPressure):
        return None, None
    name = "initial_volume" if loading.initial_volume is not None else "initial_pressure"
    wanted = float(getattr(loading, name))
    state = _filled_state(membrane, name.removeprefix("initial_"), wanted, tolerance)
    if state is None:
        most = _reach(membrane, name.removeprefix("initial_"))
        raise ValueError(
            f"`{name}` must lie between 0 and {most:.6g}, what the membrane reaches at zero voltage up to its lock-up, "
            f"but is {wanted!r}."
        )
    return (state.pressure, wanted) if name == "initial_volume" else (wanted, state.volume)


def _zero_load_line(membrane: Membrane):
    """λa, p and V of the scan at its load nearest to zero: starts for Newton at zero voltage."""
    limits = Scene(membrane, ConstantVoltage(0.0)).limits()
    chart = cached_scan(membrane, limits[0], limits[2])
    j = int(np.argmin(np.abs(chart.load_fraction)))
    return chart.apex_stretch, chart.pressure[:, j], chart.volume[:, j]


def _filled_state(membrane: Membrane, quantity: str, wanted: float, tolerance: float) -> State | None:
    """The state of smallest volume at zero voltage with the wanted pressure or volume."""
    apex, pressure, volume = _zero_load_line(membrane)
    value = np.log((pressure if quantity == "pressure" else volume) / wanted)
    crossing = np.flatnonzero(value[:-1] * value[1:] <= 0)
    if len(crossing):
        i = int(crossing[0])
        s = value[i] / (value[i] - value[i + 1])
        guess = [[apex[i] + s * (apex[i + 1] - apex[i])], [pressure[i] + s * (pressure[i + 1] - pressure[i])], [0.0]]
        row = [[np.nan] * 3] if quantity == "volume" else [[0.0, 1.0, 0.0]]
        contour = ConstantVoltage(0.0).contour()
        found = polish(membrane, contour, np.array(guess), np.array(row), np.array([wanted]), tolerance=tolerance / 4)
        if found.ok[0] and found.error[0] <= tolerance:
            return states_of(found, tolerance)[0]
    try:  # near the peak of the pressure, or at the window's edge: the fine search
        return equilibrium(membrane, voltage=0.0, tolerance=tolerance, **{quantity: wanted})
    except SceneError:
        return None


def _reach(membrane: Membrane, quantity: str) -> float:
    _, pressure, volume = _zero_load_line(membrane)
    return float(np.nanmax(pressure if quantity == "pressure" else volume))


def _flat_diagram(scene: Scene, limits, points: int, tolerance: float) -> Diagram:
    """λ0 > 1 without pressure: one flat branch from the load window to the load at which the film goes slack."""
    membrane = scene.membrane
    stretch = float(membrane.prestretch)
    slack = float(largest_load(membrane.material, stretch))
    low, high = limits[2]
    loads = np.linspace(low, min(high, 1.0), points) * slack
    states = [_flat_state(membrane, float(q)) for q in loads]
    columns = {f: np.array([getattr(s, f) for s in states]) for f in State.__dataclass_fields__ if f != "flags"}
    columns["index"] = columns["index"].astype(int)
    ends_slack = high >= 1.0
    branch = Branch(
        **columns, start=Code.window_load, end=Code.window_load, flags=("ends_slack",) if ends_slack else ()
    )
    limit = float(membrane.breakdown.field(stretch)) ** 2 / stretch**4
    marks = [("zero_voltage", 0.0)] if low <= 0 <= high else []
    marks += [("breakdown", limit)] if limit <= min(high, 1.0) * slack else []
    marks += [("slack", slack)] if ends_slack else []
    special = [
        SpecialPoint(**dataclasses.asdict(_flat_state(membrane, q)) | {"flags": ()}, kind=kind, branch=0, position=q)
        for kind, q in sorted(marks, key=lambda m: m[1])
    ]
    from .ramp import flat_ramp

    return Diagram(
        "voltage-volume", scene, [branch], special, True, tolerance, limits, _up=flat_ramp(special, states[-1])
    )


def equilibrium(
    membrane: Membrane,
    *,
    voltage: float = 0.0,
    pressure: float | None = None,
    volume: float | None = None,
    apex_stretch: float | None = None,
    all: bool = False,  # noqa: A002 (the name of the published interface)
    tolerance: float = 1e-9,
    window: Window | None = None,
):
    """The equilibrium at a voltage and one of pressure, volume or apex stretch: the one of smallest volume, stable or not.

    With `all=True` a list of every one in the window, ordered by volume. The index is that of prescribed pressure.
    Raises ValueError for bad input and SceneError where there is none.

    >>> state = equilibrium(Membrane(), voltage=0.0, volume=2.42)
    >>> round(state.pressure, 9), state.index
    (1.886612680, 0)
    """
    _check(8, tolerance)
    given = {n: v for n, v in (("pressure", pressure), ("volume", volume), ("apex_stretch", apex_stretch)) if v is not None}
    if len(given) != 1:
        raise ValueError(
            f"`pressure`, `volume` or `apex_stretch` must be given, one of the three, but {len(given)} are."
        )
    ((name, wanted),) = given.items()
    wanted = float(wanted)
    check_positive(name, wanted, zero=name != "apex_stretch")
    check_positive("voltage", float(voltage), zero=True)
    scene = Scene(membrane, ConstantVoltage(voltage), window or Window())
    _concrete(scene)
    limits = scene.limits()
    prestretch = float(membrane.prestretch)
    if name == "apex_stretch" and not prestretch <= wanted <= limits[0][1]:
        raise ValueError(
            f"`apex_stretch` must lie between the prestretch {prestretch:g} and the end of the window "
            f"{limits[0][1]:.6g}, but is {wanted!r}."
        )
    if (name == "apex_stretch" and wanted == prestretch) or wanted == 0:
        return _flat_equilibrium(membrane, float(voltage), all)
    contour = scene.loading.contour()
    found = _starts(membrane, float(voltage) ** 2, name, wanted, limits)
    states: list[State] = []
    if len(found):
        rows = {"apex_stretch": [1.0, 0, 0], "pressure": [0, 1.0, 0], "volume": [np.nan] * 3}[name]
        lanes = found.shape[1]
        result = polish(
            membrane, contour, found, np.tile(rows, (lanes, 1)), np.full(lanes, wanted), tolerance=tolerance, reach=1.0
        )
        for state in states_of(result.take(np.flatnonzero(result.ok)), tolerance):
            if not any(abs(state.apex_stretch / other.apex_stretch - 1) < 1e-9 for other in states):
                states.append(state)
    if not states:
        raise SceneError(Code.no_equilibrium)
    states.sort(key=lambda s: s.volume)
    return states if all else states[0]


def _flat_equilibrium(membrane: Membrane, voltage: float, every: bool):
    stretch = float(membrane.prestretch)
    if stretch == 1.0:
        raise SceneError(Code.flat_unstretched)
    if voltage**2 > float(largest_load(membrane.material, stretch)):
        raise SceneError(Code.no_equilibrium, "The flat film is slack at this voltage.")
    state = _flat_state(membrane, voltage**2)
    return [state] if every else state


@eqx.filter_jit
def _line_of_chart(material, apex, q, prestretch):
    from .chart import explicit_map

    return explicit_map(material, apex, q, prestretch, 128.0)


def _starts(membrane, q, name, wanted, limits) -> np.ndarray:
    """Guesses (3, n) for every state at load q with the wanted value, from the explicit map on a line of the chart."""
    from .chart import _map_nodes, _stretch_share

    (low, high), _, loads = limits
    prestretch = float(membrane.prestretch)
    share = _stretch_share(max((low - prestretch) / (high - prestretch), 1e-9), 640)
    apex = np.minimum(prestretch + (high - prestretch) * share, high)
    if name == "apex_stretch":
        apex = np.sort(np.append(apex, wanted))
    fraction = q / np.asarray(largest_load(membrane.material, apex))
    top = min(loads[1], 0.97)
    inside = (fraction <= top) & (fraction >= loads[0])
    if not inside.any():
        return np.zeros((3, 0))
    pressure, volume, slope = _map_nodes(membrane.material, apex[inside], fraction[inside], prestretch, 96.0)
    apex = apex[inside]
    ok = (slope < 0) & np.isfinite(pressure) & np.isfinite(volume) & (pressure > 0) & (volume > 0)
    rows = np.flatnonzero(inside)[ok]
    apex, pressure, volume = apex[ok], pressure[ok], volume[ok]
    if len(apex) < 2:
        return np.zeros((3, 0))
    if name == "apex_stretch":
        i = int(np.argmin(np.abs(apex - wanted)))
        return np.array([[apex[i]], [pressure[i]], [q]]) if abs(apex[i] - wanted) < 1e-12 else np.zeros((3, 0))
    value = {"pressure": np.log(pressure / wanted), "volume": np.log(volume / wanted)}[name]
    joined = np.diff(rows) == 1
    guesses = []
    for i in np.flatnonzero((value[:-1] * value[1:] <= 0) & joined):
        s = value[i] / (value[i] - value[i + 1]) if value[i] != value[i + 1] else 0.5
        guesses.append((i, s))
    # a local extremum between nodes may hide a pair: try both sides of one that comes close
    for i in np.flatnonzero((np.diff(value)[:-1] * np.diff(value)[1:] < 0)) + 1:
        near = abs(value[i]) < 4 * max(abs(value[i] - value[i - 1]), abs(value[i] - value[i + 1]))
        if near and value[i - 1] * value[i] > 0 and value[i] * value[i + 1] > 0:
            a, b, c = value[i - 1], value[i], value[i + 1]
            curvature = a - 2 * b + c
            vertex = (a - c) / (2 * curvature)
            depth = b - curvature * vertex**2 / 2
            if depth * b <= 0 or abs(depth) < 1e-6 * abs(curvature):
                half = math.sqrt(max(-2 * depth / curvature, 1e-8))
                guesses += [(i, vertex - half), (i, vertex + half)]
    logs = np.log(pressure)
    out = []
    for i, s in guesses:
        k = i if s >= 0 else i - 1
        k = min(max(k, 0), len(apex) - 2)
        s = s if s >= 0 else 1 + s
        out.append([apex[k] + s * (apex[k + 1] - apex[k]), math.exp(logs[k] + s * (logs[k + 1] - logs[k])), q])
    return np.array(out).T if out else np.zeros((3, 0))
