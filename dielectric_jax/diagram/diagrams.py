"""Diagrams: branches, special points, and the ramp an experiment would see.

`pressure_volume` holds the voltage, `voltage_volume` a chamber's filling or the pressure. All computing is dimensionless.
"""

import csv
import dataclasses
import os
import typing
from collections.abc import Iterable, Mapping

import numpy as np

from ..model import (
    QUANTITIES,
    SCANNED_LOAD,
    Branch,
    Chamber,
    ChargeControl,
    ConstantPressure,
    ConstantVoltage,
    LoadingCondition,
    Membrane,
    PointKind,
    PrescribedVolume,
    Ramp,
    Scene,
    Shooting,
    ShootingMethod,
    SpecialPoint,
    State,
    Units,
    Window,
    as_scalar,
    control_of,
    describe,
    events_table,
    field_on,
    largest_load,
    mechanical,
    plain,
    points_table,
    shooting_of,
)
from ..modes import checked_numbers
from ..numerics import Code, SceneError, check_positive, need
from ..plot import plot_diagram
from ..surface import Surface
from .branches import Solved, find_curves, special_record
from .json_documents import fields_from_json, read_json
from .mesh import Curve
from .mode_points import neutral_points
from .ramp import build_ramp, build_way_back, flat_ramp
from .resolution import MESH_POINTS
from .special_points import fold_events, special_points
from .states import (
    check_concrete,
    check_reachable,
    check_request,
    check_surface,
    flat_state,
    membrane_states,
    states_of,
    too_flat,
)
from .states import filling as filling_of
from .surface_contours import OnSurface
from .tracing import warm_up

__all__ = ["Diagram", "equilibrium", "pressure_volume", "voltage_volume"]


@dataclasses.dataclass(frozen=True)
class Diagram:
    """All branches of a scene in its window, their special points, and the ramp.

    `complete` says whether scan and continuation agree on the branches of the scanned window, and each of these was followed
    to the edge of the window.
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
    condition: LoadingCondition | None = None
    _up: Ramp | None = None
    _down: Ramp | None = None
    _solver: object = None
    _was_read: bool = False

    def ramp(self, direction: str = "up", start: State | None = None) -> Ramp:
        """What a slow ramp of the control, voltage or charge, does: "up" from zero, or "down" from `start`.

        By default the way down starts halfway in the control between the last landing (else the start) and the end of the way up.
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
            return self._solved_anew().ramp("down", start) if self._was_read else build_way_back(self._solver, start)
        if self._down is None:
            raise ValueError(
                "`direction` must be 'up' here: the way up ends without an unbroken state to come back from."
            )
        return self._down

    @property
    def control(self) -> str:
        """What a ramp changes: "voltage" or "charge"; "pressure" for a pressure–volume curve."""
        return control_of(self.scene.loading)

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
        if not isinstance(mechanical(self.scene.loading), Chamber) or self.condition is None:
            return None
        return np.asarray(self.condition.gas_pressure(np.asarray(volume, float)))

    def states_at(self, voltage: float) -> list[State]:
        """The states at a voltage on all branches of a diagram whose control is the voltage, by volume."""
        if self.control != "voltage":
            raise ValueError(
                f"`states_at` must be asked of a diagram over the voltage, but its control is the {self.control}."
            )
        if self._was_read:
            return self._solved_anew().states_at(voltage)
        q = float(voltage) ** 2
        if not isinstance(self._solver, Solved):
            loads = self.branches[0].voltage_squared
            return [flat_state(self.scene.membrane, q)] if q <= loads.max() else []
        solved = dataclasses.replace(self._solver, missed=[])
        return sorted((solved.state(p) for p in solved.states_at(q)), key=lambda s: s.volume)

    def _solved_anew(self) -> "Diagram":
        """The diagram of the scene, computed; what was read holds no more than its document."""
        return voltage_volume(self.scene, tolerance=self.tolerance)

    def plot(self, **options):
        """Draws the diagram, or two of its columns with `x=` and `y=` (`plot(x="apex_stretch", y="pressure")`), on your axes with `ax=`.

        Returns the axes given, or else the new figure. Options are those of `plot.plot_diagram`.
        """
        return plot_diagram(self, **options)

    def to_json(self, units: Units | None = None) -> dict:
        """The JSON document of the contract; with `units` its quantities are in SI, named under "unit_names"."""
        stretches, _, loads = self.limits
        ramp = None if self._up is None else [e.to_json(self.control) for e in self.events]
        control = {"control": "charge"} if self.control == "charge" else {}
        document = plain(
            {
                "scene": describe(self.scene),
                **control,
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
        return document if units is None else units.to_document(document)

    @classmethod
    def from_json(cls, document: Mapping[str, typing.Any] | str | os.PathLike, scene: Scene | None = None) -> "Diagram":
        """The diagram of a document of `to_json` or of `dielectric-jax … --json`, or of a file that holds one; in SI or dimensionless.

        A `scene` is needed where the material or the breakdown law is a function of the user's own. Special points and events come
        back with the digits of the document; other ramps and `states_at` compute the diagram anew. Raises ValueError for what is
        not the document of one diagram.

        >>> from dielectric_jax import Chamber
        >>> diagram = voltage_volume(Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42)))
        >>> Diagram.from_json(diagram.to_json()).to_json() == diagram.to_json()
        True
        """
        return cls(**fields_from_json(read_json(document), scene), _was_read=True)

    def to_dataframe(self, units: Units | None = None):
        """The points of all branches as a `pandas.DataFrame`: `branch`, `voltage` and the columns of `Branch`.

        In SI with `units`, by default those of the scene; `attrs["units"]` names them. NaN where a quantity has no meaning; an
        index that is not valid is missing.
        """
        pandas = need("pandas")
        table = pandas.DataFrame(self.columns(units))
        table["index"] = table["index"].astype("Int64").mask(table["index"] < 0)
        table.attrs["units"] = self._units_of_columns(units)
        return table

    def to_csv(self, path: str | os.PathLike, units: Units | None = None) -> None:
        """Writes the table of `to_dataframe`, a line for each point, with units in the names of the columns."""
        columns, names = self.columns(units), self._units_of_columns(units)
        heads = [f"{name} [{names[name]}]" if name in names else name for name in columns]
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(heads)
            for row in zip(*columns.values(), strict=True):
                writer.writerow(
                    ["" if v != v or (n == "index" and v < 0) else v for n, v in zip(columns, row, strict=True)]
                )

    def columns(self, units: Units | None = None) -> dict[str, np.ndarray]:
        """The points of all branches: the number of the `branch`, `voltage` and the columns of `Branch`, in SI with `units`."""
        units = units or self.scene.units
        branches = self.branches if units is None else [units.to_si(b) for b in self.branches]
        out = {"branch": np.concatenate([np.full(len(b), k) for k, b in enumerate(branches)])}
        for name in ("voltage", *QUANTITIES):
            out[name] = np.concatenate([getattr(b, name) for b in branches])
        return out

    def _units_of_columns(self, units: Units | None) -> dict[str, str]:
        names = Units.names() if units or self.scene.units else {}
        return {n: names[n] for n in ("voltage", *QUANTITIES) if n in names}

    def _repr_html_(self) -> str:
        units = self.scene.units
        title = f"{self.kind}, {len(self.branches)} branches, {'complete' if self.complete else 'not complete'}"
        table = points_table(self.special_points, title, units)
        strain = "" if self.area_strain is None else f"area strain {self.area_strain:.6g} ({self.area_strain_reason})"
        return table + (events_table(self.events, strain, units) if self.events else "")

    def __repr__(self) -> str:
        lines = [f"Diagram({self.kind}, engine={self.engine}, complete={self.complete}"]
        lines += [f"  {b!r}" for b in self.branches]
        lines += [f"  {p!r}" for p in self.special_points]
        if self._up is not None:
            strain = "none" if self.area_strain is None else f"{self.area_strain:.6g}"
            path = " → ".join(e.event for e in self._up.events)
            lines.append(f"  ramp: {path}; area strain {strain} ({self.area_strain_reason})")
        return "\n".join(lines) + ")"


def _branches(solved: Solved, points: int) -> list[Branch]:
    """The records of all branches; one on which a special point is known to lie but was not located says so."""
    lost = {branch for _, branch, *_ in solved.missed}
    flags = [("special_point_lost",) if k in lost else () for k in range(len(solved.curves))]
    return [_branch(c, solved.tolerance, points, more) for c, more in zip(solved.curves, flags, strict=True)]


def _branch(curve: Curve, tolerance: float, points: int, more_flags: tuple) -> Branch:
    """The record of a branch; fewer points than the mesh has are thinned out of it."""
    chosen = np.arange(len(curve.points))
    if points < MESH_POINTS and len(chosen) > points:
        chosen = np.unique(np.linspace(0, len(chosen) - 1, points).round().astype(int))
    states = states_of(curve.points.take(chosen), tolerance)
    columns = {f: np.array([getattr(s, f) for s in states]) for f in State.__dataclass_fields__ if f != "flags"}
    columns["index"] = np.array([-1 if s.index is None else s.index for s in states])
    return Branch(**columns, start=curve.start, end=curve.end, flags=curve.flags + more_flags)


def _solver(membrane: Membrane, condition: LoadingCondition, surface, method) -> Shooting | OnSurface:
    """The engine of a diagram."""
    return shooting_of(membrane, condition, method) if surface is None else OnSurface(surface, condition)


def _solve(solver, limits, kinds, points, tolerance, certify: bool, extend: bool, modes) -> tuple[Solved, bool]:
    count = max(points, MESH_POINTS)
    curves, complete = find_curves(solver, limits, count=count, tolerance=tolerance, extend=extend)
    if not curves:
        raise SceneError(Code.no_equilibrium)
    curves = [fold_events(kinds[0], solver, c, tolerance) for c in curves]
    curves = [dataclasses.replace(c, points=solver.complete(c.points)) for c in curves]
    located, missed = special_points(solver, curves, kinds, tolerance, certify=certify)
    solved = Solved(solver, curves, located, missed, tolerance, certify, modes)
    if modes:
        neutral = neutral_points(solved, modes)
        located = sorted(located + neutral.found, key=lambda p: (p.branch, p.position))
        missed = missed + neutral.missed
        solved = dataclasses.replace(solved, located=located, missed=missed, undecided=neutral.undecided)
    return solved, complete


def _numbers(modes: Iterable[int] | None, surface) -> tuple[int, ...]:
    """The circumferential numbers of modes that a diagram looks at."""
    if modes is None:
        return ()
    if surface is not None:
        raise ValueError("`surface` must be left out with `modes`, whose states are those of continuation.")
    return checked_numbers(modes, 1, "modes")


def pressure_volume(
    membrane: Membrane,
    voltage: float = 0.0,
    *,
    points: int = 256,
    tolerance: float = 1e-9,
    window: Window | None = None,
    surface: Surface | None = None,
    certify: bool = True,
    extend: bool = True,
    method: ShootingMethod | None = None,
    modes: Iterable[int] | None = None,
) -> Diagram:
    """The pressure–volume curve of a membrane at a fixed voltage: branches and folds in pressure.

    Arguments: `voltage` Φ in units of H√(μ/ε); `points` a branch; `tolerance` of the error estimate; `surface`, `certify`,
    `extend`, `method` and `modes` as in `voltage_volume`.
    Raises ValueError for bad input and SceneError where no tensile equilibrium lies in the window.

    >>> curve = pressure_volume(Membrane(), voltage=0.0)
    >>> sorted(round(p.pressure, 9) for p in curve.special_points if p.kind == "fold")
    [1.361703319, 1.908684829]
    """
    check_request(points, tolerance)
    scene = Scene(membrane, ConstantVoltage(voltage), window or Window())
    check_concrete(scene)
    check_surface(surface, membrane, method)
    numbers = _numbers(modes, surface)
    kinds = (PointKind.pressure_fold, PointKind.breakdown, PointKind.hoop_tension_loss)
    solver = _solver(membrane, scene.loading.condition(), surface, method)
    warm_up(membrane)
    solved, complete = _solve(solver, scene.limits(), kinds, points, tolerance, certify, extend, numbers)
    return _diagram("pressure-volume", scene, solved, complete, points, voltage=float(voltage))


def voltage_volume(
    scene: Scene,
    *,
    points: int = 256,
    tolerance: float = 1e-9,
    surface: Surface | None = None,
    certify: bool = True,
    extend: bool = True,
    method: ShootingMethod | None = None,
    modes: Iterable[int] | None = None,
) -> Diagram:
    """The voltage–volume diagram of a membrane under a loading, with its special points and ramp.

    The loading is a chamber, a constant pressure or a prescribed volume; under `ChargeControl` folds, indices and the ramp
    are those of the charge.
    Arguments: `points` a branch; `tolerance` of the error estimate, from 1e-12 to 1e-3. With a `surface` of the scene's
    membrane, branches are contours on it, found by Newton without stepping; where they leave its domain shooting goes on,
    or with `extend=False` they end there. `certify` corrects special points by shooting; the correction is part of their
    error. Both mean nothing without a surface. A `method` makes the states exact by a solver, step size controller and root
    finder of your own; how far they are from ours is part of the error, so `tolerance` must be as wide as they are exact.
    With `modes`, circumferential numbers from 1 such as `range(1, 25)`, the points at which a mode of one of them turns
    neutral are special points too, of kind "mode" with their `number`, and the ramp ends where the membrane loses its
    axisymmetry: with the reason "bulges" where a mode turns unstable, with "wrinkles" where hoop tension is lost, and with "modes not
    decided" where it comes to a state at which the sign of a mode's eigenvalue is not known. A flat film's modes are not looked at.
    Raises ValueError for bad input and SceneError where no tensile equilibrium lies in the window.

    >>> from dielectric_jax import Chamber
    >>> scene = Scene(membrane=Membrane(), loading=Chamber(volume=1600.0, initial_volume=2.42))
    >>> diagram = voltage_volume(scene)
    >>> [event.event for event in diagram.ramp().events]
    ['start', 'snap', 'landing', 'breakdown']
    >>> round(diagram.ramp()["snap"][0].state.voltage, 9), round(diagram.area_strain, 4)
    (0.07649536, 16.1219)
    """
    check_request(points, tolerance)
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    check_concrete(scene)
    loading = scene.loading
    if isinstance(loading, ConstantVoltage):
        raise ValueError("`loading` must not hold the voltage here, but is a ConstantVoltage; see pressure_volume.")
    check_surface(surface, scene.membrane, method)
    numbers = _numbers(modes, surface)
    if surface is not None and isinstance(loading, ChargeControl):
        raise ValueError("`surface` must be left out under charge control, which continuation follows.")
    limits = scene.limits()
    warm_up(scene.membrane)
    filling = filling_of(scene, tolerance, method)
    if filling == (0.0, 0.0):
        return _flat_diagram(scene, limits, points, tolerance)
    fold = PointKind.charge_fold if isinstance(loading, ChargeControl) else PointKind.fold
    kinds = (fold, PointKind.zero_voltage, PointKind.breakdown, PointKind.hoop_tension_loss)
    solver = _solver(scene.membrane, loading.condition(*filling), surface, method)
    try:
        solved, complete = _solve(solver, limits, kinds, points, tolerance, certify, extend, numbers)
    except SceneError:
        held = mechanical(loading)
        if isinstance(held, ConstantPressure) and too_flat(scene.membrane, "pressure", float(held.pressure)):
            raise SceneError(Code.near_flat) from None
        if isinstance(held, PrescribedVolume):
            check_reachable(scene.membrane, float(held.volume), scene.units)
        raise
    up, down = build_ramp(solved, filling[1] if isinstance(mechanical(loading), Chamber) else None)
    return _diagram("voltage-volume", scene, solved, complete, points, _up=up, _down=down)


def _diagram(kind: str, scene: Scene, solved: Solved, complete: bool, points: int, **more) -> Diagram:
    """The diagram of what was solved."""
    engine = "surface" if isinstance(solved.solver, OnSurface) else "continuation"
    special = [special_record(p, solved.tolerance) for p in solved.located]
    fixed = {
        "tolerance": solved.tolerance,
        "limits": scene.limits(),
        "condition": solved.solver.condition,
        "engine": engine,
    }
    return Diagram(kind, scene, _branches(solved, points), special, complete, _solver=solved, **fixed, **more)


def _flat_point(membrane: Membrane, q: float, kind: PointKind) -> SpecialPoint:
    values = vars(flat_state(membrane, q))
    return SpecialPoint(**values, kind=kind, branch=0, position=q)


def _flat_diagram(scene: Scene, limits, points: int, tolerance: float) -> Diagram:
    """λ0 > 1 without pressure: one flat branch from the load window to the load at which the film goes slack."""
    membrane = scene.membrane
    stretch = float(membrane.prestretch)
    slack = float(largest_load(membrane.material, stretch))
    low, high = limits[2]
    loads = np.linspace(low, min(high, 1.0), points) * slack
    states = [flat_state(membrane, float(q)) for q in loads]
    columns = {f: np.array([getattr(s, f) for s in states]) for f in State.__dataclass_fields__ if f != "flags"}
    columns["index"] = np.array([-1 if s.index is None else s.index for s in states])
    ends_slack = high >= 1.0
    branch = Branch(
        **columns, start=Code.window_load, end=Code.window_load, flags=("ends_slack",) if ends_slack else ()
    )
    limit = float(field_on(membrane.breakdown, stretch)) ** 2 / stretch**4
    marks = [(PointKind.zero_voltage, 0.0)] if low <= 0 <= high else []
    marks += [(PointKind.breakdown, limit)] if limit <= min(high, 1.0) * slack else []
    marks += [(PointKind.slack, slack)] if ends_slack else []
    special = [_flat_point(membrane, q, kind) for kind, q in sorted(marks, key=lambda m: m[1])]
    return Diagram(
        "voltage-volume", scene, [branch], special, True, tolerance, limits, _up=flat_ramp(special, states[-1])
    )


def equilibrium(
    membrane: Membrane | Scene,
    *,
    voltage: float | str = 0.0,
    pressure: float | None = None,
    volume: float | None = None,
    apex_stretch: float | None = None,
    all: bool = False,
    tolerance: float = 1e-9,
    window: Window | None = None,
    surface: Surface | None = None,
    method: ShootingMethod | None = None,
) -> typing.Any:
    """The equilibrium at a voltage and one of pressure, volume or apex stretch: the one of smallest volume, stable or not.

    Of a `Scene` only the voltage is given, in V or as a text such as "2 kV" where it carries units: its loading says the rest, and the
    index is that under this loading. Of a membrane it is
    that of prescribed pressure. With `all=True` a list of every state in the window up to t = 0.9997, ordered by volume: beyond,
    folds go on without end.
    A `surface` of the membrane gives the starts inside its domain, which shooting makes exact; the explicit map the others. A
    `method` makes them exact by a solver, step size controller and root finder of your own, see `model.ShootingMethod`.
    Raises ValueError for bad input and SceneError where there is none.

    >>> from dielectric_jax import Chamber
    >>> state = equilibrium(Membrane(), voltage=0.0, volume=2.42)
    >>> round(state.pressure, 9), state.index
    (1.88661268, 0)
    >>> chamber = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> [(round(s.volume, 4), s.index) for s in equilibrium(chamber, voltage=0.05, all=True)]
    [(2.5538, 0), (4.6044, 1), (15.5632, 0)]
    """
    given = {"pressure": pressure, "volume": volume, "apex_stretch": apex_stretch, "window": window}
    if isinstance(membrane, Scene):
        for name, value in given.items():
            if value is not None:
                raise ValueError(f"`{name}` must be left out with a Scene, which says it, but is {value!r}.")
        states = _states_of_scene(
            membrane, float(as_scalar(membrane.number_of("voltage", voltage))), tolerance, surface, method
        )
    else:
        if isinstance(voltage, str):
            raise ValueError(f"`voltage` must be a number, because a membrane carries no units, but is {voltage!r}.")
        states = membrane_states(
            membrane, voltage=voltage, tolerance=tolerance, surface=surface, method=method, **typing.cast(dict, given)
        )
    return states if all else states[0]


def _states_of_scene(scene: Scene, voltage: float, tolerance: float, surface, method) -> list[State]:
    """The states of a scene at a voltage, by volume."""
    check_positive("voltage", voltage, zero=True)
    voltage = scene.dimensionless(voltage, "voltage")
    states = voltage_volume(scene, tolerance=tolerance, surface=surface, method=method).states_at(voltage)
    if not states:
        raise SceneError(Code.no_equilibrium)
    return states
