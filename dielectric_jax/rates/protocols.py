"""How a voltage, a volume or a pressure is prescribed in time."""

import abc
import math
import typing
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..model import plain
from ..numerics import check_between, shown

__all__ = [
    "AbstractProtocol",
    "Hold",
    "Leg",
    "Linear",
    "Phase",
    "Ramp",
    "Steps",
    "Triangle",
    "document_of",
    "legs_of",
    "number_of",
    "phases_of",
]


class Linear(eqx.Module):
    """value + rate (m − origin)."""

    value: typing.Any
    rate: typing.Any
    origin: typing.Any

    def __call__(self, moment):
        return self.value + self.rate * (moment - self.origin)

    def times(self, factor: float) -> "Linear":
        """The course in another unit."""
        return Linear(self.value * factor, self.rate * factor, self.origin)


class Given(eqx.Module):
    """A user's function of time, written with jax.numpy."""

    function: Callable = eqx.field(static=True)
    factor: float = 1.0

    def __call__(self, moment):
        return self.factor * jnp.asarray(self.function(moment), float)

    def times(self, factor: float) -> "Given":
        """The course in another unit."""
        return Given(self.function, self.factor * factor)


class Leg(typing.NamedTuple):
    """A stretch of time from `begin` to `end` in which a quantity follows a smooth `course`."""

    begin: float
    end: float
    course: Linear | Given

    def at(self, time: float) -> float:
        """The value at a time."""
        return float(self.course(time))


def number_of(name: str, value, low=-math.inf, high=math.inf) -> float:
    """The value as a number; raises ValueError by its name where it is none, or outside the limits."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"`{name}` must be a number, but is {shown(value)}.") from None
    if not (math.isfinite(number) or number == high):
        raise ValueError(f"`{name}` must be finite, but is {number!r}.")
    check_between(name, number, low, high)
    return number


class AbstractProtocol(abc.ABC):
    """A course in time, by its legs; a value may jump from one leg to the next."""

    @abc.abstractmethod
    def legs(self) -> list[Leg]:
        """The legs, from time 0."""

    @abc.abstractmethod
    def to_json(self) -> dict:
        """The kind of `protocol` and its numbers, as in the files of the command `follow`."""


class Ramp(AbstractProtocol):
    """`start` + `rate` t, until `stop` is reached; without `stop` until something happens.

    >>> Ramp(rate=0.01).legs()[0].at(3.0)
    0.03
    """

    def __init__(self, rate: float, start: float = 0.0, stop: float | None = None):
        self.rate, self.start = number_of("rate", rate), number_of("start", start)
        if self.rate == 0:
            raise ValueError("`rate` must not be zero (that is a Hold), but is 0.0.")
        self.stop = None if stop is None else number_of("stop", stop)
        if self.stop is not None and not (self.stop - self.start) * self.rate > 0:
            raise ValueError(f"`stop` must lie ahead of the start {self.start!r}, but is {self.stop!r}.")

    def legs(self):
        """One leg."""
        end = math.inf if self.stop is None else (self.stop - self.start) / self.rate
        return [Leg(0.0, end, Linear(self.start, self.rate, 0.0))]

    def to_json(self):
        """The rate, and where the ramp starts and stops."""
        return {"protocol": "ramp", "rate": self.rate, "start": self.start, "stop": self.stop}


class Steps(AbstractProtocol):
    """Values, each held for a time: pairs (value, duration).

    >>> [leg.at(leg.begin) for leg in Steps([(0.1, 5.0), (0.0, 20.0)]).legs()]
    [0.1, 0.0]
    """

    def __init__(self, steps: Sequence[tuple[float, float]]):
        self.steps = [(number_of("value", v), number_of("duration", d, 0.0)) for v, d in steps]
        if not self.steps:
            raise ValueError("`steps` must hold at least one pair (value, duration), but is empty.")

    def legs(self):
        """One leg a value."""
        ends = np.cumsum([d for _, d in self.steps])
        begins = [0.0, *ends[:-1]]
        return [
            Leg(float(b), float(e), Linear(v, 0.0, float(b)))
            for (v, _), b, e in zip(self.steps, begins, ends, strict=True)
        ]

    def to_json(self):
        """The pairs (value, duration)."""
        return {"protocol": "steps", "steps": [list(step) for step in self.steps]}


class Hold(AbstractProtocol):
    """One value from time 0 on, for a `duration`; without it until nothing moves any more.

    >>> Hold(0.12, duration=100.0).legs()[0].end
    100.0
    """

    def __init__(self, value: float, duration: float | None = None):
        self.value = number_of("value", value)
        self.duration = math.inf if duration is None else number_of("duration", duration, 0.0)

    def legs(self):
        """One leg."""
        return [Leg(0.0, self.duration, Linear(self.value, 0.0, 0.0))]

    def to_json(self):
        """The value, and for how long."""
        return {"protocol": "hold", "value": self.value, "duration": plain(self.duration)}


class Triangle(AbstractProtocol):
    """From `start` to `turn` and back to `stop`, all at the speed `rate`.

    >>> [leg.end for leg in Triangle(0.5, 8.0, 4.0, rate=0.5).legs()]
    [15.0, 23.0]
    """

    def __init__(self, start: float, turn: float, stop: float, *, rate: float):
        self.corners = tuple(number_of(n, v) for n, v in (("start", start), ("turn", turn), ("stop", stop)))
        self.rate = number_of("rate", rate, 0.0)
        if self.corners[0] == self.corners[1] or self.corners[1] == self.corners[2] or self.rate == 0:
            raise ValueError(f"`turn` must differ from start and stop, at a positive `rate`, but is {turn!r}.")

    def legs(self):
        """Two legs."""
        first, turn, last = self.corners
        middle, end = abs(turn - first) / self.rate, (abs(turn - first) + abs(last - turn)) / self.rate
        return [
            Leg(0.0, middle, Linear(first, math.copysign(self.rate, turn - first), 0.0)),
            Leg(middle, end, Linear(turn, math.copysign(self.rate, last - turn), middle)),
        ]

    def to_json(self):
        """The three values, and the rate."""
        return (
            {"protocol": "triangle"}
            | dict(zip(("start", "turn", "stop"), self.corners, strict=True))
            | {"rate": self.rate}
        )


def document_of(protocol) -> dict:
    """`to_json` of a protocol, of a number that is held, or the word for a function."""
    if isinstance(protocol, AbstractProtocol):
        return protocol.to_json()
    return {"protocol": "function"} if callable(protocol) else Hold(protocol).to_json()


def legs_of(name: str, protocol, end: float = math.inf) -> list[Leg]:
    """The legs of a protocol, of a function of time, or of a number that is held, up to the time `end`."""
    if isinstance(protocol, AbstractProtocol):
        legs = protocol.legs()
    elif callable(protocol):
        legs = [Leg(0.0, math.inf, Given(protocol))]
    elif isinstance(protocol, (int, float, np.number)):
        legs = Hold(float(protocol)).legs()
    else:
        raise ValueError(
            f"`{name}` must be a Ramp, Hold, Steps, Triangle, a function of time or a number, but is {shown(protocol)}."
        )
    return [leg._replace(end=min(leg.end, end)) for leg in legs if leg.begin < end]


class Phase(typing.NamedTuple):
    """A part of a run with smooth courses of what is prescribed, from m = `begin` to `end`; in a "leap" m is no time.

    `falls` says whether what drives the run is held after it has leapt down.
    """

    kind: str
    courses: dict
    begin: float
    end: float
    falls: bool = False


def phases_of(legs: dict[str, list[Leg]], driven: str) -> list[Phase]:
    """The legs in which every quantity has one course, and before each the leap to its first values."""
    last = min(own[-1].end for own in legs.values())
    ends = sorted({leg.end for own in legs.values() for leg in own if leg.end <= last})
    found: list[Phase] = []
    values, begin = {n: 0.0 if n == "voltage" else own[0].at(0.0) for n, own in legs.items()}, 0.0
    for end in ends:
        courses = {n: next(leg.course for leg in own if leg.end >= end) for n, own in legs.items()}
        target = {n: float(c(begin)) for n, c in courses.items()}
        if any(not math.isclose(target[n], values[n], rel_tol=1e-12, abs_tol=1e-300) for n in target):
            leaps = {n: Linear(values[n], target[n] - values[n], 0.0) for n in target}
            found.append(Phase("leap", leaps, 0.0, 1.0))
        still = all(isinstance(c, Linear) and not c.rate for c in courses.values())
        falls = abs(target[driven]) < abs(values[driven])
        found.append(Phase("hold" if still else "flow", courses, begin, end, falls))
        values = {n: float(c(end)) for n, c in courses.items()} if math.isfinite(end) else target
        begin = end
    return found
