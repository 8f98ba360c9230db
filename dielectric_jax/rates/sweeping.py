"""Ramps and holds in time as an engine of sweeps: many runs, their regimes and events, as variables of a dataset."""

import dataclasses
import math
import typing

import numpy as np

from ..model import Scene
from ..numerics import NamedCode, check_positive, shown
from .following import follow
from .phases import filling_of
from .protocols import Hold, Ramp, number_of
from .runs import Run, RunEvent, estimate_errors

__all__ = ["InTime", "RunOutcome", "TimeRegime", "regime_in_time"]


class RunOutcome(NamedCode):
    """How a run in time ends: the values of `outcome`; those of scenes without an answer are numbered as in other sweeps."""

    not_computed = -1
    end_of_protocol = 0
    at_rest = 1
    breakdown_on_branch = 2
    breakdown_in_snap = 3
    not_followed = 4  # a landing was not found, or the run did not converge
    hoop_tension_lost = 5
    no_answer = 6  # the scene has no start
    invalid_scene = 7  # its parameters are incompatible
    failed = 8  # its computation raised an error


class TimeRegime(NamedCode):
    """What a membrane does in time, by the first thing that happens to it."""

    not_decided = -1
    survives = 0  # the protocol, or comes to rest
    snaps = 1  # at an instantaneous fold, and lands unbroken
    creeps_through = 2  # where it would snap at rest
    breaks_down = 3  # before any snap
    breaks_in_snap = 4
    goes_slack = 5  # before any snap


_OUTCOMES = {
    "end of the protocol": RunOutcome.end_of_protocol,
    "at rest": RunOutcome.at_rest,
    "breakdown on the branch": RunOutcome.breakdown_on_branch,
    "breakdown in the snap": RunOutcome.breakdown_in_snap,
    "hoop tension lost": RunOutcome.hoop_tension_lost,
}
_ENDS = {
    RunOutcome.breakdown_on_branch: TimeRegime.breaks_down,
    RunOutcome.hoop_tension_lost: TimeRegime.goes_slack,
}


def _outcome(run: Run) -> RunOutcome:
    return _OUTCOMES.get(run.reason, RunOutcome.not_followed)


def regime_in_time(run: Run) -> TimeRegime:
    """The regime of a run: what happens first.

    >>> from dielectric_jax.model import ConstantPressure, Gent, Maxwell, Membrane, Viscoelastic
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> regime_in_time(follow(Scene(Membrane(rubber), ConstantPressure(1.82)), voltage=Ramp(rate=0.01))).name
    'breaks_in_snap'
    """
    snap = run.snap
    if snap is not None and snap.kind == "creep_through":
        return TimeRegime.creeps_through
    if snap is not None:
        broken = snap.landing is not None and snap.landing.breakdown_ratio >= 1
        landed = TimeRegime.breaks_in_snap if broken else TimeRegime.snaps
        return landed if snap.landing is not None else TimeRegime.not_decided
    if _outcome(run) is RunOutcome.not_followed:
        return TimeRegime.not_decided
    return _ENDS.get(_outcome(run), TimeRegime.survives)


_POINTS = {
    "snap": "in which the membrane snaps, or creeps through at its fastest",
    "landing": "on which the jump lands",
    "breakdown": "of electric breakdown",
    "end": "in which the run ends",
}
_QUANTITIES = {
    "time": ("time", "relaxation_time"),
    "voltage": ("voltage", "H sqrt(mu / epsilon)"),
    "pressure": ("pressure", "mu H / A"),
    "volume": ("volume below the membrane", "A^3"),
    "apex_stretch": ("stretch of the apex", "1"),
    "breakdown_ratio": ("E/E_EB, largest along the membrane,", "1"),
}
_WORDS = {"outcome": "how the run ends", "regime": "what happens first in the run"}


@dataclasses.dataclass(frozen=True)
class InTime:
    """An engine of `dj.sweep` that follows every scene in time under a ramp or a held voltage.

    Axes may be `rate`, dΦ/dt of a ramp from zero, or `held_voltage`, besides every parameter of the scene, the constants of its
    branches included; what does not vary is given here. With `units` of the scene voltages are in V, else everything is dimensionless;
    times are in the unit of the relaxation times.

    Args:
        rate: dΦ/dt of the ramp, where it is no axis.
        held_voltage: Φ that is held from t = 0 on, where it is no axis.
        duration: when a run ends at the latest; a membrane that has not snapped or broken by then survives.
        start: "relaxed" or "fresh", as of `follow`.
        tolerance: about the relative error of events.
        check: estimate the errors by a finer run of every scene, which takes twice as long; `error` is NaN otherwise.

    >>> import dielectric_jax as dj
    >>> rubber = dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> scene = Scene(dj.Membrane(rubber), dj.ConstantPressure(1.82))
    >>> data = dj.sweep(scene, rate=[0.01, 0.1], engine=InTime(check=False), progress=False)
    >>> [round(float(v), 6) for v in data.snap_voltage]
    [0.183281, 0.248437]
    """

    rate: float | None = None
    held_voltage: float | None = None
    duration: float | None = None
    start: str = "relaxed"
    tolerance: float = 1e-6
    check: bool = True
    parameters: typing.ClassVar[tuple[str, ...]] = ("rate", "held_voltage")
    block: typing.ClassVar[int] = 64

    def __post_init__(self):
        number_of("tolerance", self.tolerance, 1e-10, 1e-2)
        if self.rate is not None and self.held_voltage is not None:
            raise ValueError("`rate` or `held_voltage` must be given, at most one of the two, but both are.")
        for name in ("rate", "held_voltage", "duration"):
            if getattr(self, name) is not None:
                check_positive(name, number_of(name, getattr(self, name)), zero=name == "held_voltage")
        if self.start not in ("relaxed", "fresh"):
            raise ValueError(f"`start` must be 'relaxed' or 'fresh', but is {shown(self.start)}.")
        if not isinstance(self.check, bool):
            raise ValueError(f"`check` must be True or False, but is {shown(self.check)}.")

    def check_axes(self, scene: Scene, columns: dict[str, np.ndarray]) -> None:
        """Raises ValueError unless exactly one of `rate` and `held_voltage` is given, here or as an axis, and the scene has a filling."""
        filling_of(scene.loading)
        for name in set(self.parameters) & set(columns):
            check_positive(name, float(np.min(columns[name])), zero=name == "held_voltage")
        given = [n for n in self.parameters if n in columns or getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(
                f"`rate` or `held_voltage` must be given, one of the two, but {'both are' if given else 'none is'}."
            )

    def document(self) -> dict[str, typing.Any]:
        """The settings, as JSON."""
        return {"engine": "in time"} | dataclasses.asdict(self)

    def variables(self) -> list[tuple]:
        """`outcome` and `regime` with their flags, then time, voltage, pressure, … of snap, landing, breakdown and end."""
        rows: list[tuple] = []
        for name, flags in (("outcome", RunOutcome), ("regime", TimeRegime)):
            numbers = np.array([int(m) for m in flags], "int8")
            said = {"flag_values": numbers, "flag_meanings": " ".join(m.name for m in flags)}
            rows.append((name, {}, "int8", -1, {"long_name": _WORDS[name]} | said))
        for point, where in _POINTS.items():
            for name, (words, unit) in _QUANTITIES.items():
                known = {"long_name": f"{words} of the state {where}", "units": "1", "ancillary_variables": "error"}
                rows.append((f"{point}_{name}", {}, "float64", math.nan, known | {"counted_in": unit}))
        error = {"long_name": "largest relative difference of the events from those of a finer run", "units": "1"}
        return [*rows, ("error", {}, "float64", math.nan, error)]

    def _protocols(self, columns: dict[str, np.ndarray], count: int) -> list[Ramp | Hold]:
        """The protocol of every scene."""
        fixed = {n: getattr(self, n) for n in self.parameters if getattr(self, n) is not None}
        name, values = next(iter((fixed | columns).items()))
        return [Ramp(rate=float(v)) if name == "rate" else Hold(float(v)) for v in np.broadcast_to(values, count)]

    def answers(self, scenes: list[Scene], columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The variables of scenes that are followed side by side."""
        protocols = self._protocols(columns, len(scenes))
        options = {"start": self.start, "duration": self.duration, "tolerance": self.tolerance}
        runs = follow(scenes, voltage=protocols, **options)
        errors = estimate_errors(runs) if self.check else [math.nan] * len(runs)
        found = {name: np.full(len(runs), fill, dtype) for name, _, dtype, fill, _ in self.variables()}
        found["error"][:] = errors
        for i, run in enumerate(runs):
            if not isinstance(run, Run):
                found["outcome"][i] = RunOutcome.no_answer
                continue
            found["outcome"][i], found["regime"][i] = _outcome(run), regime_in_time(run)
            for point, event in _events(run).items():
                for name in _QUANTITIES if event is not None else ():
                    found[f"{point}_{name}"][i] = getattr(event, name)
        return found


def _events(run: Run) -> dict[str, RunEvent | None]:
    snap = run.snap
    landing = None if snap is None else snap.landing
    at = None if snap is None else snap.at
    return {"snap": at, "landing": landing, "breakdown": run.event("breakdown"), "end": run.events[-1]}
