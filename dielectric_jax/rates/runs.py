"""Records of a run in time: events, the first snap, the steps."""

import dataclasses
import functools
import math
import typing
from collections.abc import Generator, Sequence

import jax
import numpy as np
import xarray
from scipy.interpolate import CubicHermiteSpline

from ..diagram import voltage_volume
from ..model import Membrane, Profile, Scene, Units, Unrelaxed, Viscoelastic, describe, plain, spring_and_branches
from ..numerics import check_whole
from .programs import Seen
from .requests import serve
from .shapes import profile_of
from .stepping import Instant

__all__ = [
    "Row",
    "Run",
    "RunEvent",
    "Snap",
    "at_rest",
    "at_start",
    "converted",
    "dataset_of",
    "estimate_errors",
    "event_of",
    "slopes_of",
]


class Row(typing.NamedTuple):
    """A step of a run: the time, the phase and number of its leg, σ, what is seen, and the instant."""

    time: float
    phase: str
    leg: int
    sigma: float
    seen: Seen
    instant: Instant


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

    def to_json(self, error_estimate: float | None = None) -> dict:
        """The event as the JSON document of a run lists it."""
        out = {"event": self.kind} | {n: v for n, v in vars(self).items() if n not in ("kind", "reason")}
        return plain(out | {"error_estimate": error_estimate, "reason": self.reason or None})


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
    apex_stretch, height, charge, hoop_tension (the least true hoop stress), breakdown_ratio, energy, volume_rate = dV/dt, σ, the number of their `leg`, and
    its `phase`: flow, hold, or leap (what is prescribed changes at once). A jump begins a new leg. `energy_defect` is the largest
    |ΔU − ∫ p dV + ∫ Q dΦ + ∫ D dt| of a leg over its largest term: a check, and no estimate of the error, which
    `error_estimate` is. `protocol` is what was asked for, as the JSON document carries it.
    """

    scene: Scene | Membrane
    events: tuple[RunEvent, ...]
    dataset: xarray.Dataset
    energy_defect: float
    protocol: dict
    _slopes: dict = dataclasses.field(repr=False, compare=False)
    _instants: tuple[Instant, ...] = dataclasses.field(repr=False, compare=False)
    _again: typing.Callable[[], Generator] = dataclasses.field(repr=False, compare=False)

    @property
    def reason(self) -> str:
        """Why the run ended."""
        return self.events[-1].reason

    def dense(self, per_step: int = 8) -> xarray.Dataset:
        """Time, volume, pressure and voltage between the steps, by cubic Hermite interpolation in σ; NaN where a leg ends.

        The steps are few, as the method is of order 5; this is for figures. `step` counts the steps, between two a fraction.
        """
        check_whole("per_step", per_step, 1, 1000)
        data, sigma = self.dataset, self.dataset.sigma.values
        ends = np.flatnonzero(np.diff(data.leg.values)) + 1
        found: dict[str, list] = {name: [] for name in ("step", *self._slopes)}
        for part in np.split(np.arange(len(sigma)), ends):
            share = np.linspace(0.0, 1.0, per_step, endpoint=False)
            places = np.append(
                (sigma[part[:-1], None] + np.diff(sigma[part])[:, None] * share).ravel(), sigma[part[-1]]
            )
            for name, slopes in self._slopes.items():
                values = data.voltage.values[part] ** 2 if name == "load" else data[name].values[part]
                curve = values if len(part) < 2 else CubicHermiteSpline(sigma[part], values, slopes[part])(places)
                found[name] += [*np.atleast_1d(curve), np.nan]
            found["step"] += [*(part[0] + np.arange(len(places)) / per_step), np.nan]
        columns = {n: np.array(found[n]) for n in ("step", "time", "volume", "pressure")}
        columns["voltage"] = np.sqrt(np.maximum(found["load"], 0.0))
        return xarray.Dataset({name: ("point", values) for name, values in columns.items()})

    def profile(self, step: float) -> Profile:
        """Shape, stretches, true stresses, field and E/E_EB along the radius at a step, or between two by its fraction.

        `step` counts the steps of `dataset`, as the column of `dense` does; between two steps of a leg the shape and the dashpots
        are interpolated by cubic Hermite polynomials in σ. Raises ValueError for a step that is not there, or between two legs.

        >>> from dielectric_jax import ConstantPressure, Gent, Maxwell
        >>> from dielectric_jax.rates import Ramp, follow
        >>> film = Membrane(Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)]))
        >>> run = follow(Scene(film, ConstantPressure(1.82)), voltage=Ramp(rate=0.01))
        >>> bool(abs(run.profile(12.5).first_integral_defect()).max() < 1e-4)
        True
        """
        count, leg = len(self._instants), self.dataset.leg.values
        first = math.floor(step) if 0 <= step <= count - 1 else -1
        last = min(first + (step > first), count - 1)
        if first < 0 or leg[first] != leg[last]:
            raise ValueError(f"`step` must be from 0 to {count - 1} and not between two legs, but is {step!r}.")
        membrane = self.scene.membrane if isinstance(self.scene, Scene) else self.scene
        ends, share = (first, last), step - first
        loads = self.dataset.voltage.values[[first, last]] ** 2
        if first == last:
            return profile_of(membrane, self._instants[first].shape, self._instants[first].x, float(loads[0]))
        h = float(self.dataset.sigma[last] - self.dataset.sigma[first])
        values = [(self._instants[k].shape, self._instants[k].x, loads[i]) for i, k in enumerate(ends)]
        rates = [(self._instants[k].shape_rate, self._instants[k].x_rate, self._slopes["load"][k]) for k in ends]
        shape, x, load = jax.tree.map(functools.partial(_hermite, share, h), *values, *rates)
        return profile_of(membrane, shape, x, float(load))

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
    def _finer(self) -> "Run":
        """The same run with more functions and a smaller tolerance."""
        return serve([self._again()])[0]

    @property
    def error_estimates(self) -> tuple[float, ...]:
        """For every event the largest relative difference of its time, voltage, pressure and volume from those of a finer run.

        That run has more functions and a smaller tolerance. Infinite where its events are others. The time of an end "at rest" is
        left out: it is the first step at which nothing moves any more, within the tolerance, or the protocol's end comes first.
        """
        finer, ends = self._finer, (self.reason, self._finer.reason)
        kinds = [e.kind for e in finer.events], [e.kind for e in self.events]
        if kinds[0] != kinds[1] or not (ends[0] == ends[1] or set(ends) == set(_UNBROKEN)):
            return (math.inf,) * len(self.events)

        def apart(a: RunEvent, b: RunEvent) -> float:
            names = [n for n in _COMPARED if n != "time" or "at rest" not in (a.reason, b.reason)]
            return max(abs(getattr(a, n) - getattr(b, n)) / max(abs(getattr(b, n)), 1e-3) for n in names)

        return tuple(apart(a, b) for a, b in zip(self.events, finer.events, strict=True))

    @property
    def error_estimate(self) -> float:
        """The largest of `error_estimates`."""
        return max(self.error_estimates)

    def to_json(self, units: Units | None = None, *, check: bool = True, read: bool = False) -> dict:
        """The JSON document of `dielectric-jax follow`; null stands for what is infinite, unknown or not there.

        With `units` its quantities are in SI, named under "unit_names", or with `read` in kV, ml and mbar; times and energies
        per volume keep their units. Without `check` no finer run is made, and error estimates are null.
        """
        errors = self.error_estimates if check else (None,) * len(self.events)
        events = [e.to_json(error) for e, error in zip(self.events, errors, strict=True)]
        snap = None
        if self.snap is not None:
            places = (self.snap.at, self.snap.landing)
            at, landing = (None if e is None else events[self.events.index(e)] for e in places)
            snap = {"kind": self.snap.kind, "at": at, "landing": landing}
        columns = ("time", "leg", "phase", "voltage", *_COLUMNS)
        document = {
            "scene": describe(self.scene),
            "units": "dimensionless",
            "protocol": self.protocol,
            "snap": snap,
            "events": events,
            "path": {name: self.dataset[name].values for name in columns},
        }
        if units is None:
            return plain(document)
        convert = units.read if read else units.to_si
        told = {n: converted(v, functools.partial(convert, name=n)) for n, v in self.protocol.items()}
        return units.to_document(plain(document), read=read) | {"protocol": plain(told)}


def _hermite(share: float, h: float, begin, end, begin_rate, end_rate):
    """Between two values and derivatives, h apart, by the cubic."""
    back = 1 - share
    kept = back**2 * (1 + 2 * share) * begin + share**2 * (1 + 2 * back) * end
    return kept + h * share * back * (back * begin_rate - share * end_rate)


_UNBROKEN = ("at rest", "end of the protocol")
_COMPARED = ("time", "voltage", "pressure", "volume")


def converted(protocol: typing.Any, convert: typing.Callable[[float], float]) -> typing.Any:
    """A protocol with its values and rates converted; what is no protocol stays."""
    if not isinstance(protocol, dict):
        return protocol
    out = {n: convert(v) if isinstance(v, float) and n != "duration" else v for n, v in protocol.items()}
    steps = [[convert(value), duration] for value, duration in protocol.get("steps", ())]
    return out | ({"steps": steps} if steps else {})


def estimate_errors(runs: Sequence[Run | Exception]) -> list[float]:
    """The `error_estimate` of runs, whose finer runs are followed side by side; NaN for the error of a scene without a run.

    >>> estimate_errors([])
    []
    """
    followed = [run for run in runs if isinstance(run, Run)]
    new = [run for run in followed if "_finer" not in vars(run)]
    for run, finer in zip(new, serve([run._again() for run in new]), strict=True):
        vars(run)["_finer"] = finer
    return [run.error_estimate if isinstance(run, Run) else math.nan for run in runs]


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


def slopes_of(rows: list[Row]) -> dict[str, np.ndarray]:
    """The derivatives by σ at the steps."""
    names = {"time": "time_rate", "volume": "volume_rate", "pressure": "pressure_rate", "load": "load_rate"}
    found = {name: np.array([float(getattr(row.seen, rate)) for row in rows]) for name, rate in names.items()}
    found["time"][[row.phase not in ("flow", "hold") for row in rows]] = 0.0  # no time passes in a leap
    return found


_COLUMNS = ("pressure", "volume", "apex_stretch", "height", "charge", "hoop_tension", "breakdown_ratio", "energy")


def dataset_of(rows: list[Row]) -> xarray.Dataset:
    """The steps as columns."""
    seen = [row.seen for row in rows]
    stacked = {name: np.array([float(getattr(row, name)) for row in seen]) for name in Seen._fields}
    with np.errstate(divide="ignore", invalid="ignore"):  # at an instantaneous fold the speed is infinite
        speed = stacked["volume_rate"] / stacked["time_rate"]
    columns = {
        "time": np.array([row.time for row in rows]),
        "voltage": np.sqrt(np.maximum(stacked["load"], 0.0)),
        "volume_rate": speed,
        "sigma": np.array([row.sigma for row in rows]),
        "phase": np.array([row.phase for row in rows]),
        "leg": np.array([row.leg for row in rows]),
    } | {name: stacked[name] for name in _COLUMNS}
    return xarray.Dataset({name: ("step", values) for name, values in columns.items()})
