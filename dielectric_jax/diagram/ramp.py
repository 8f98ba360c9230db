"""The ramp an experiment sees: along the stable branch, over folds to the landing, until breakdown or the window ends.

Words as in the documentation: the way up starts at zero voltage; at a fold the membrane snaps to the state of index 0 at
the same voltage that is nearest in volume in the direction of the jump; the way down is the same with the voltage falling.
Under charge control the same is said of the charge, and where the volume is held of the apex stretch for the volume.
`follow` is this rule, over whatever knows the events along branches: a diagram, or the traced lines of a batch.
"""

import math
import typing

import numpy as np

from ..model import SCANNED_LOAD, Event, Outcome, PointKind, Ramp, RampEvent, SpecialPoint, State, largest_load
from .mode_points import NOT_DECIDED, loss_at
from .resolution import MOST_JUMPS, SAME_STRETCH
from .states import states_of

__all__ = ["ENDS", "LOSSES", "NOT_LOCATED", "Step", "Stop", "build_ramp", "build_way_back", "flat_ramp", "follow"]

#: why the area strain is taken where it is, and the way of ending that it stands for
ENDS = {
    "breakdown on the branch": Outcome.breakdown_on_branch,
    "breakdown in the snap": Outcome.breakdown_in_snap,
    "no landing": Outcome.no_landing,
    "start_unstable": Outcome.start_unstable,
}
#: how a ramp ends where the membrane loses its axisymmetry, where that is asked
LOSSES = {PointKind.hoop_tension_loss: "wrinkles", PointKind.mode: "bulges"}


#: why a ramp ends at a fold beside a cusp, whose landing is there but too near to tell from the fold
NOT_LOCATED = "landing not located"


class LandingNotLocated(Exception):
    """A stable state at a fold's control was seen and not located, and it may be the landing."""


class Stop(typing.NamedTuple):
    """What a branch comes to as the control rises or falls: the `kind` of the point, the point, and the side of the branch on which it lies.

    The kind is that of a fold of the control, breakdown, zero voltage, or a loss of axisymmetry; None where the branch leaves the window.
    `undecided` where the sign of a mode's eigenvalue is not known.
    """

    kind: PointKind | None
    at: typing.Any
    side: float
    undecided: bool = False


class Step(typing.NamedTuple):
    """An event of a ramp, where, and why the ramp ends with it. At the window's edge `at` is the `Stop`."""

    event: RampEvent
    at: typing.Any
    reason: str | None = None


class Branches(typing.Protocol):
    """What knows the events along branches."""

    def next_stop(self, here, rising: bool) -> Stop:
        """What the branch comes to from the point `here` as the control rises or falls."""
        ...

    def landing(self, fold: Stop) -> typing.Any:
        """The stable state at a fold's control nearest in volume in the direction of the jump, or None. Raises `LandingNotLocated`."""
        ...

    def is_broken(self, landing) -> bool:
        """Whether a landing lies at breakdown or beyond."""
        ...

    def loss(self, here) -> str | None:
        """How the state `here` has lost its axisymmetry, where that is asked; None where it has not."""
        ...


def follow(branches: Branches, here, rising: bool, most: int = MOST_JUMPS) -> list[Step]:
    """The events of a ramp from the point `here` as the control rises or falls, up to the one with which it ends."""
    steps: list[Step] = []
    if loss := branches.loss(here):
        return [Step(RampEvent.end, here, loss)]
    jump = RampEvent.snap if rising else RampEvent.snap_back
    for _ in range(most):
        stop = branches.next_stop(here, rising)
        if stop.undecided:
            return [*steps, Step(RampEvent.end, stop.at, NOT_DECIDED)]
        if stop.kind is None:
            return [*steps, Step(RampEvent.end, stop, "window")]
        if stop.kind == PointKind.breakdown:
            return [*steps, Step(RampEvent.breakdown, stop.at, "breakdown on the branch")]
        if stop.kind == PointKind.zero_voltage:
            return [*steps, Step(RampEvent.end, stop.at, "zero voltage")]
        if stop.kind in LOSSES:
            return [*steps, Step(RampEvent.end, stop.at, LOSSES[stop.kind])]
        steps.append(Step(jump, stop.at))
        try:
            here = branches.landing(stop)
        except LandingNotLocated:
            return [*steps, Step(RampEvent.end, stop.at, NOT_LOCATED)]
        if here is None:
            return [*steps, Step(RampEvent.no_landing, stop.at, "no landing")]
        steps.append(Step(RampEvent.landing, here))
        if rising and branches.is_broken(here):
            return [*steps, Step(RampEvent.breakdown, here, "breakdown in the snap")]
        if loss := branches.loss(here):
            return [*steps, Step(RampEvent.end, here, loss)]
    return [*steps, Step(RampEvent.end, steps[-2].at, "too many jumps")]


def _control_of(solved, state: State) -> float:
    """The voltage, or the charge where that is controlled."""
    return state.charge if solved.control == 3 else state.voltage


def _strain(state: State, start: State) -> float:
    return (state.apex_stretch / start.apex_stretch) ** 2 - 1


class _OfDiagram:
    """The branches of a diagram, its special points and the states at its folds' controls."""

    def __init__(self, solved):
        self.solved = solved

    def next_stop(self, here, rising: bool) -> Stop:
        """The next fold, breakdown or zero voltage along the branch of `here`; the side is the direction in arclength."""
        solved, curve = self.solved, self.solved.curves[here.branch]
        slope = here.point.control_slope(solved.control)[0]
        side = 1.0 if (slope > 0) == rising else -1.0
        near = 1e-9 * (1 + abs(here.position))
        on_branch = [p for p in (*solved.located, *solved.undecided) if p.branch == here.branch]
        ahead = [p for p in on_branch if (p.position - here.position) * side > near]
        ahead.sort(key=lambda p: (p.position - here.position) * side)
        if curve.start.name == "closed":
            behind = [p for p in on_branch if p not in ahead and p is not here]
            ahead += sorted(behind, key=lambda p: p.position * side)
        stops = (solved.fold_kind, PointKind.breakdown if rising else PointKind.zero_voltage)
        stops += tuple(LOSSES) if solved.numbers else ()
        for p in ahead:
            if p.kind in stops and p is not here:
                return Stop(p.kind, p, side, undecided=any(p is other for other in solved.undecided))
        return Stop(None, here, side)

    def landing(self, fold: Stop):
        """It lies in the scanned window, t ≤ 0.9: beyond, branches are followed only as far as their errors allow."""
        solved, at = self.solved, fold.at
        curve, condition = solved.curves[at.branch], solved.solver.condition
        i = int(np.clip(np.searchsorted(curve.position, at.position), 1, len(curve.position) - 1))
        direction = fold.side * np.sign(np.diff(curve.points.place(condition)[i - 1 : i + 1])[0])
        material, found = solved.solver.membrane.material, []
        known = len(solved.missed)
        for other in solved.states_at(solved.control_at(at)):
            jump = (solved.place(other) - solved.place(at)) * direction
            same = other.branch == at.branch and abs(other.position - at.position) < 1e-4
            scanned = other.point.u[2, 0] <= SCANNED_LOAD * largest_load(material, other.point.u[0])[0]
            if jump > 0 and not same and other.point.index[0] == 0 and scanned:
                found.append((jump, other))
        nearest, landing = min(found, key=lambda f: f[0], default=(math.inf, None))
        for _, branch, n, _ in solved.missed[known:]:
            ends = solved.curves[branch].points.take(slice(n, n + 2))
            jumps = (ends.place(condition) - solved.place(at)) * direction
            if 0 < jumps.max() and jumps.min() < nearest and 0 in ends.index and (branch, n + 1) != (at.branch, i):
                raise LandingNotLocated
        return landing

    def is_broken(self, landing) -> bool:
        return self.solved.state(landing).breakdown_ratio >= 1

    def loss(self, here) -> str | None:
        return loss_at(self.solved, here, self.solved.numbers) if self.solved.numbers else None

    def state(self, step: Step) -> State:
        """The record of the state of a step; where the branch leaves the window, its last."""
        if not isinstance(step.at, Stop):
            return self.solved.state(step.at)
        points = self.solved.curves[step.at.at.branch].points
        end = np.array([len(points) - 1 if step.at.side > 0 else 0])
        return states_of(points.take(end), self.solved.tolerance)[0]

    def events(self, direction: str, start, steps: list[Step]) -> list[Event]:
        """The events of a ramp from `start`."""
        first = Event(RampEvent.start, direction, self.solved.state(start))
        return [first, *(Event(step.event, direction, self.state(step), step.reason) for step in steps)]


def build_ramp(solved, initial_volume: float | None) -> tuple[Ramp, Ramp | None]:
    """The way up from zero voltage and, where there is an unbroken state to come back from, the way down."""
    zeros = [p for p in solved.located if p.kind == PointKind.zero_voltage]
    if initial_volume is not None:
        start = min(zeros, key=lambda p: abs(p.point.volume[0] / initial_volume - 1), default=None)
        if start is None or not abs(start.point.volume[0] / initial_volume - 1) < 1e-5:
            start = solved.start_beside_fold(initial_volume)
    else:
        zeros.sort(key=solved.place)
        stable = [p for p in zeros if p.point.index[0] == 0]
        start = stable[0] if stable else zeros[0] if zeros else None
    if start is None:
        return Ramp((), None, "no state at zero voltage in the window"), None
    first = solved.state(start)
    if first.index != 0:
        return Ramp((Event(RampEvent.start, "up", first, "start_unstable"),), None, "start_unstable"), None
    branches = _OfDiagram(solved)
    steps = follow(branches, start, rising=True)
    events = branches.events("up", start, steps)
    end, jumps = events[-1], [e for e in events if e.event == RampEvent.snap]
    held = end.reason in ("window", "breakdown on the branch", "zero voltage", NOT_DECIDED, *LOSSES.values())
    last_held = end if held else jumps[-1]
    up = Ramp(tuple(events), _strain(last_held.state, first), end.reason)
    landings = [i for i, step in enumerate(steps) if step.event == RampEvent.landing]
    last = steps[landings[-1]].at if landings else start
    return up, _way_down(branches, last, events[-1].state) if held else None


def _way_down(branches: _OfDiagram, last, end: State) -> Ramp | None:
    """The way down from halfway in the control between the last landing (else the start) and the end of the way up."""
    solved = branches.solved
    first, final = (_control_of(solved, s) for s in (solved.state(last), end))
    middle = (first + final) / 2
    if not (math.isfinite(middle) and middle > first):
        return None
    side = branches.next_stop(last, True).side
    ahead = [
        p for p in solved.states_at(middle**2) if p.branch == last.branch and (p.position - last.position) * side > 0
    ]
    return _way_back(branches, min(ahead, key=lambda p: (p.position - last.position) * side)) if ahead else None


def _way_back(branches: _OfDiagram, here) -> Ramp:
    return Ramp(tuple(branches.events("down", here, follow(branches, here, rising=False))))


def build_way_back(solved, start: State) -> Ramp:
    """The way down from a given state of the diagram.

    Raises ValueError where `start` is not an equilibrium of the diagram.
    """
    if solved is None or not start.voltage > 0:
        raise ValueError(f"`start` must be an equilibrium at a positive voltage, but is {start!r}.")
    near = [
        p
        for p in solved.states_at(_control_of(solved, start) ** 2)
        if abs(p.point.volume[0] / start.volume - 1) < 1e-6
        and abs(p.point.u[0, 0] / start.apex_stretch - 1) < SAME_STRETCH
    ]
    if not near:
        raise ValueError(f"`start` must be an equilibrium of this diagram, but is {start!r}.")
    return _way_back(_OfDiagram(solved), near[0])


def flat_ramp(special: list[SpecialPoint], last: State) -> Ramp:
    """The ramp of a flat film: it stays flat until it breaks down or goes slack."""
    start = next((p for p in special if p.kind == PointKind.zero_voltage), None)
    if start is None:
        return Ramp((), None, "no state at zero voltage in the window")
    events = [Event(RampEvent.start, "up", start)]
    stop = next((p for p in special if p.kind in (PointKind.breakdown, PointKind.slack)), None)
    if stop is not None and stop.kind == PointKind.breakdown:
        events.append(Event(RampEvent.breakdown, "up", stop, "breakdown on the branch"))
        return Ramp(tuple(events), 0.0, "breakdown on the branch")
    events.append(Event(RampEvent.end, "up", stop or last, "window" if stop is None else "slack"))
    return Ramp(tuple(events), 0.0, events[-1].reason)
