"""What a membrane followed in time is told as: events, the first snap, the steps."""

import dataclasses
import functools
import math
import typing

import numpy as np
import xarray

from ..diagram import voltage_volume
from ..model import Membrane, Scene, Unrelaxed, Viscoelastic, spring_and_branches
from .programs import Seen

__all__ = ["Run", "RunEvent", "Snap", "at_rest", "at_start", "event_of"]


@dataclasses.dataclass(frozen=True)
class RunEvent:
    """Something that happens: its kind, when, and the state there; `reason` says why a run ends."""

    kind: str
    time: float
    voltage: float
    pressure: float
    volume: float
    apex_stretch: float
    breakdown_ratio: float
    hoop_tension: float
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Snap:
    """A snap: "jump" at an instantaneous fold, with its `landing`, or "creep_through", the fastest point of a smooth expansion."""

    kind: str
    at: RunEvent
    landing: RunEvent | None = None


@dataclasses.dataclass(frozen=True)
class Run:
    """A membrane followed in time.

    `events`, in the order of time: start, instantaneous_fold, landing, fastest (of dV/dt), peak_pressure (where the volume is
    prescribed), breakdown, hoop_tension_loss, end with a `reason`. `dataset` holds the steps: time, voltage, pressure, volume,
    apex_stretch, height, charge, hoop_tension (the least true hoop stress), breakdown_ratio, energy, volume_rate = dV/dt, and
    their `phase`: flow, hold, or leap (what is prescribed changes at once). `energy_defect` is the largest
    |ΔU − ∫ p dV + ∫ Q dΦ + ∫ D dt| of a leg over its largest term: a check, and no estimate of the error, which
    `error_estimate` is.
    """

    scene: Scene | Membrane
    events: tuple[RunEvent, ...]
    dataset: xarray.Dataset
    energy_defect: float
    _again: "typing.Callable[[], Run]" = dataclasses.field(repr=False, compare=False)

    @property
    def reason(self) -> str:
        """Why the run ended."""
        return self.events[-1].reason

    def event(self, kind: str) -> RunEvent | None:
        """The first event of a kind, None where there is none."""
        return next((e for e in self.events if e.kind == kind), None)

    @functools.cached_property
    def snap(self) -> Snap | None:
        """The first snap, None where there is none.

        Without a fold, the fastest point is that of a creep-through if the membrane would snap at rest (`voltage_volume`).
        """
        for k, event in enumerate(self.events):
            if event.kind == "instantaneous_fold":
                after = self.events[k + 1]
                return Snap("jump", event, after if after.kind == "landing" else None)
        fastest = self.event("fastest")
        if fastest is None or not isinstance(self.scene, Scene):
            return None
        return Snap("creep_through", fastest) if voltage_volume(at_rest(self.scene)).ramp()["snap"] else None

    @functools.cached_property
    def error_estimate(self) -> float:
        """The largest relative difference of the events' times, voltages, pressures and volumes from a finer run.

        That run has more functions and a smaller tolerance. Infinite where its events are others.
        """
        finer = self._again()
        if [e.kind for e in finer.events] != [e.kind for e in self.events] or finer.reason != self.reason:
            return math.inf
        names = ("time", "voltage", "pressure", "volume")
        pairs = [(getattr(a, n), getattr(b, n)) for a, b in zip(self.events, finer.events, strict=True) for n in names]
        return max(abs(x - y) / max(abs(y), 1e-3) for x, y in pairs)


def event_of(kind: str, seen: Seen, time: float, reason: str = "") -> RunEvent:
    """An event from what is seen of an instant."""
    voltage = math.sqrt(max(float(seen.load), 0.0))
    named = ("pressure", "volume", "apex_stretch", "breakdown_ratio", "hoop_tension")
    state = {name: float(getattr(seen, name)) for name in named}
    return RunEvent(kind, float(time), voltage, **state, reason=reason)


def at_start(membrane: Membrane, start: str) -> Membrane:
    """The elastic membrane that a start is an equilibrium of: of the equilibrium spring alone, or of all springs."""
    film = membrane.material
    material = spring_and_branches(film)[0]
    if start == "fresh" and isinstance(film, Viscoelastic):
        material = Unrelaxed(film)
    return Membrane(material, membrane.prestretch, membrane.breakdown)


def at_rest(scene: Scene) -> Scene:
    """The scene whose branches carry nothing."""
    return dataclasses.replace(scene, membrane=at_start(scene.membrane, "relaxed"))


_COLUMNS = ("pressure", "volume", "apex_stretch", "height", "charge", "hoop_tension", "breakdown_ratio", "energy")


def dataset_of(rows: list[tuple[float, str, Seen]]) -> xarray.Dataset:
    """The steps (time, phase, what is seen) as columns."""
    times, phases, seen = zip(*rows, strict=True)
    stacked = {name: np.array([float(getattr(row, name)) for row in seen]) for name in Seen._fields}
    with np.errstate(divide="ignore", invalid="ignore"):  # at an instantaneous fold the speed is infinite
        speed = stacked["volume_rate"] / stacked["time_rate"]
    columns = {
        "time": np.array(times),
        "voltage": np.sqrt(np.maximum(stacked["load"], 0.0)),
        "volume_rate": speed,
        "phase": np.array(phases),
    } | {name: stacked[name] for name in _COLUMNS}
    return xarray.Dataset({name: ("step", values) for name, values in columns.items()})
