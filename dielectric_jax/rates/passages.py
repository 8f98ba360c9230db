"""One leg of a run: from where the membrane is to what happens next, as a generator of requests."""

import dataclasses
import math
import typing
from collections.abc import Callable, Generator

import equinox as eqx
import jax
import numpy as np

from ..model import LoadingCondition, Membrane, Scene, spring_and_branches
from .balance import Balance, Grid, Shape, grid_of
from .programs import EVENTS, Seen, Start, signs_of
from .protocols import Linear
from .requests import Request
from .resolution import FIRST_STEP, LANDING_TOLERANCE, MOST_CALLS, MOST_SECTIONS
from .runs import Row, RunEvent, event_of
from .stepping import Instant

__all__ = ["Now", "Passed", "Setting", "passed"]

T = typing.TypeVar("T")
Asking: typing.TypeAlias = Generator[Request, typing.Any, T]

# what is watched for, of `EVENTS`: while a value leaps, while it changes, while it is held, up to a peak of the pressure, in a
# jump, and by rising volume
_WATCHED = {
    "leap": (1, 1, 1, 1, 0, 0),
    "flow": (1, 1, 1, 1, 0, 0),
    "hold": (1, 1, 1, 1, 1, 0),
    "rise": (1, 1, 1, 1, 0, 1),
    "jump": (0, 1, 0, 0, 0, 0),
    "frozen": (0, 0, 1, 1, 0, 0),
}


class Load(eqx.Module):
    """q = Φ² of a course of the voltage; along a jump q = ±m, which may be negative on the way."""

    course: typing.Any
    share: float

    def __call__(self, moment):
        return self.course(moment) ** 2 + self.share * moment


class Setting(typing.NamedTuple):
    """What a run has throughout: `driven` is what is prescribed, `protocol` how, and `again` is the same run, finer."""

    scene: Scene | Membrane
    membrane: Membrane
    condition: LoadingCondition
    driven: str
    mesh: tuple[int, int]
    tolerance: float
    protocol: dict
    again: Callable[[], Generator]

    @property
    def grid(self) -> Grid:
        """The mesh along the radius."""
        return grid_of(*self.mesh)

    def balance(self, courses: dict, *, flows: bool, kappa: float) -> Balance:
        """The balance under courses of what is prescribed, of σ = m + κ V."""
        spring, branches = spring_and_branches(self.membrane.material)
        prescribed = courses.get("pressure"), courses.get("volume")
        load = Load(courses["voltage"], 0.0)
        return Balance(
            spring, branches, self.membrane.prestretch, self.condition, load, *prescribed, kappa, 1.0, float(flows)
        )

    def free(self, courses: dict, driver: str, sense: float) -> Balance:
        """The balance with frozen dashpots at prescribed volumes, σ = ±V by the `sense`, in which m is ±q or ±p."""
        balance = self.balance(courses | {driver: Linear(0.0, 0.0, 0.0)}, flows=False, kappa=sense)
        freed = Linear(0.0, sense, 0.0)
        changes = {"load": Load(balance.load.course, sense)} if driver == "voltage" else {"pressure": freed}
        return dataclasses.replace(balance, moment_weight=0.0, **changes)


class Passed(typing.NamedTuple):
    """How a leg ended: an event of `EVENTS`, "lost" or "unfinished"; the instant, what is seen of it, and the steps."""

    event: str
    instant: Instant
    seen: Seen
    rows: list[Seen]
    sigma: list[float]
    instants: list[Instant]


@dataclasses.dataclass
class Now:
    """Where a run is: shape and dashpots; and what it has seen so far."""

    shape: Shape
    x: typing.Any
    rows: list[Row] = dataclasses.field(default_factory=list)
    events: list[RunEvent] = dataclasses.field(default_factory=list)
    defects: list[float] = dataclasses.field(default_factory=list)

    def note(self, phase: str, found: Passed, time: float | None) -> None:
        """Keeps the steps of a leg, all at one `time`, or at their own."""
        number = self.rows[-1].leg + 1 if self.rows else 0
        for sigma, seen, instant in zip(found.sigma, found.rows, found.instants, strict=True):
            self.rows.append(Row(float(seen.time) if time is None else time, phase, number, sigma, seen, instant))


class _Leg(typing.NamedTuple):
    """What a leg is followed with: the balance, where m ends, what is watched, and the unit of σ."""

    balance: Balance
    limit: float
    phase: str
    unit: float

    @property
    def watched(self) -> np.ndarray:
        return np.array(_WATCHED[self.phase], bool)

    @property
    def flows(self) -> bool:
        return self.phase in ("flow", "hold", "rise")


def _at(tree, k):
    return jax.tree.map(lambda v: v[k], tree)


def passed(setting: Setting, now: Now, balance: Balance, limit: float, phase: str, unit: float) -> Asking[Passed]:
    """Follows a leg from `now` until something happens in it; `now.shape.moment` is where m begins."""
    leg = _Leg(balance, limit, phase, unit)
    shape, x, work, first = now.shape, now.x, np.zeros(2), FIRST_STEP * unit
    rows: list[Seen] = []
    sigmas: list[float] = []
    instants: list[Instant] = []
    tolerance = setting.tolerance if leg.flows else LANDING_TOLERANCE
    energy = None
    for _ in range(MOST_CALLS):
        a = float(balance.prestretch) + setting.grid.functions[0] @ np.asarray(shape.coefficients)
        volume = np.pi * np.sum(setting.grid.weights * setting.grid.s * a**2 * shape.slope)
        sigma = float(balance.moment_weight * shape.moment + balance.volume_weight * volume)
        start = Start(balance, shape, x, work, limit, leg.watched.astype(float), sigma, unit, first)
        ys, ts, seen = yield Request("evolve", setting.mesh, (setting.membrane.breakdown, start), (tolerance,))
        known = int(np.sum(np.isfinite(ts)))
        seen = Seen(*(v[:known] for v in seen))
        energy = seen.energy[0] if energy is None else energy
        happened = float(np.max(np.where(leg.watched, signs_of(seen, limit, np)[-1], -np.inf)))
        smooth = known - 1 if happened > 0 else known
        yield from _noticed(setting, now, leg, _at(ys, slice(smooth)), ts, _at(seen, slice(smooth)))
        again = int(bool(rows))  # a further call begins where the one before ended
        rows += [Seen(*(v[k] for v in seen)) for k in range(again, smooth)]
        sigmas += [float(s) for s in ts[again:smooth]]
        instants += [_at(ys, k) for k in range(again, smooth)]
        last = _at(ys, known - 1)
        if happened > 0 and known > 1:
            begin = _at(ys, known - 2)
            event, instant, there, place = yield from _located(setting, leg, begin, ts[known - 2 : known], happened)
            if leg.flows:
                gained, dissipated, given = there.energy - energy, *instant.work
                largest = max(abs(gained), abs(dissipated), abs(given), 1e-3)
                now.defects.append(float(abs(gained + dissipated - given) / largest))
            return Passed(event, instant, there, [*rows, there], [*sigmas, place], [*instants, instant])
        if happened > 0:  # at the start
            signs = np.where(leg.watched, signs_of(seen, limit, np)[-1], -np.inf)
            there = Seen(*(v[-1] for v in seen))
            return Passed(EVENTS[int(np.argmax(signs))], last, there, [there], [sigma], [last])
        if known < 2 or ts[known - 1] - ts[known - 2] < 1e-9 * unit:
            return Passed("lost", last, rows[-1], rows, sigmas, instants)
        shape, x, work, first = last.shape, last.x, last.work, ts[known - 1] - ts[known - 2]
    return Passed("unfinished", last, rows[-1], rows, sigmas, instants)


def _located(setting: Setting, leg: _Leg, y0, ends, last: float) -> Asking[tuple[str, Instant, Seen, float]]:
    """The first event between two values of σ, and where it is."""
    watched = leg.watched.astype(float)
    arguments = setting.membrane.breakdown, leg.balance, y0, np.asarray(ends), last, leg.limit, watched
    instant, seen, signs, place = yield Request("locate", setting.mesh, arguments)
    if not np.isfinite(signs).any():
        return "lost", y0, Seen(*seen), float(ends[0])
    return EVENTS[int(np.argmax(np.where(leg.watched, signs, -np.inf)))], instant, Seen(*seen), float(place)


def _restep(setting: Setting, leg: _Leg, y0, begin: float, sigma: float) -> Request:
    """One step from an instant to another σ."""
    arguments = setting.membrane.breakdown, leg.balance, y0, begin, sigma, leg.limit
    return Request("restep", setting.mesh, arguments)


def _noticed(setting: Setting, now: Now, leg: _Leg, ys, ts, seen: Seen) -> Asking[None]:
    """Notes what does not end a leg.

    That is the fastest point of an expansion, or the peaks of the pressure where the volume is prescribed, or those of the load
    by rising volume.
    """
    if len(seen.time) < 2 or leg.phase in ("leap", "jump", "rise"):
        return
    if leg.phase == "frozen" or setting.driven == "volume":
        frozen = leg.phase == "frozen"
        rate, of = (seen.time_rate, "load") if frozen else (seen.pressure_rate, "pressure")
        for k in np.flatnonzero((rate[:-1] > 0) & (rate[1:] <= 0)):
            there = yield from _greatest(setting, leg, _at(ys, k), ts[k : k + 2], of)
            kind = "instantaneous_fold" if frozen else "peak_pressure"
            now.events.append(event_of(kind, there, 0.0 if frozen else float(there.time)))
        return
    speed = seen.volume_rate / seen.time_rate
    inner = np.flatnonzero((speed[1:-1] > np.maximum(speed[:-2], 0.0)) & (speed[1:-1] >= speed[2:])) + 1
    if len(inner):
        k = int(inner[np.argmax(speed[inner])])
        around = []
        for step in (k - 1, k):
            around.append((yield from _greatest(setting, leg, _at(ys, step), ts[step : step + 2], "speed")))
        best = max(around, key=lambda s: s.volume_rate / s.time_rate)
        now.events.append(event_of("fastest", best, float(best.time)))


def _greatest(setting: Setting, leg: _Leg, y0, ends, of: str) -> Asking[Seen]:
    """What is seen at the greatest pressure, load or speed dV/dm between two values of σ, by golden sections."""
    low, high = map(float, ends)
    begin = low
    share = (math.sqrt(5) - 1) / 2

    def asked(sigma) -> Asking[tuple[Seen, float]]:
        _, seen, _ = yield _restep(setting, leg, y0, begin, sigma)
        seen = Seen(*seen)
        values = {"pressure": seen.pressure, "speed": seen.volume_rate / seen.time_rate, "load": seen.load}
        return seen, float(np.nan_to_num(values[of], nan=-np.inf))

    first, second = high - share * (high - low), low + share * (high - low)
    left = yield from asked(first)
    right = yield from asked(second)
    for _ in range(MOST_SECTIONS):
        if left[1] > right[1]:
            high, second, right = second, first, left
            first = high - share * (high - low)
            left = yield from asked(first)
        else:
            low, first, left = first, second, right
            second = low + share * (high - low)
            right = yield from asked(second)
    return max(left, right, key=lambda v: v[1])[0]
