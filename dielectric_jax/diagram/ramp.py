"""The ramp an experiment sees: along the stable branch, over folds to the landing, until breakdown or the window ends.

Words as in the documentation: the way up starts at zero voltage; at a fold the membrane snaps to the state of index 0 at
the same voltage that is nearest in volume in the direction of the jump; the way down is the same with the voltage falling.
Under charge control the same is said of the charge, and where the volume is held of the apex stretch for the volume.
"""

import math

import numpy as np

from ..model import SCANNED_LOAD, Event, Outcome, PointKind, Ramp, RampEvent, SpecialPoint, State, largest_load
from .resolution import MOST_JUMPS, SAME_STRETCH
from .states import states_of

__all__ = ["ENDS", "build_ramp", "build_way_back", "flat_ramp"]

#: why the area strain is taken where it is, and the way of ending that it stands for
ENDS = {
    "breakdown on the branch": Outcome.breakdown_on_branch,
    "breakdown in the snap": Outcome.breakdown_in_snap,
    "no landing": Outcome.no_landing,
    "start_unstable": Outcome.start_unstable,
}


def _control_of(solved, state: State) -> float:
    """The voltage, or the charge where that is controlled."""
    return state.charge if solved.control == 3 else state.voltage


def _strain(state: State, start: State) -> float:
    return (state.apex_stretch / start.apex_stretch) ** 2 - 1


def _walk(solved, here, rising: bool):
    """Events along the branch of `here` with the control rising or falling: the next fold, breakdown, zero, or None.

    Returns (kind, located or None, side): side is the direction in arclength.
    """
    curve = solved.curves[here.branch]
    slope = here.point.control_slope(solved.control)[0]
    side = 1.0 if (slope > 0) == rising else -1.0
    ahead = [
        p
        for p in solved.located
        if p.branch == here.branch and (p.position - here.position) * side > 1e-9 * (1 + abs(here.position))
    ]
    closed = curve.start.name == "closed"
    ahead.sort(key=lambda p: (p.position - here.position) * side)
    if closed:
        behind = [p for p in solved.located if p.branch == here.branch and p not in ahead and p is not here]
        ahead += sorted(behind, key=lambda p: p.position * side)
    stops = (solved.fold_kind, PointKind.breakdown if rising else PointKind.zero_voltage)
    for p in ahead:
        if p.kind in stops and p is not here:
            return p.kind, p, side
    return "window", None, side


def _end_of(solved, here, side) -> State:
    points = solved.curves[here.branch].points
    return states_of(points.take(np.array([len(points) - 1 if side > 0 else 0])), solved.tolerance)[0]


def _land(solved, fold, side):
    """The index-0 state at the fold's control nearest in volume in the direction of the jump, or None.

    It lies in the scanned window, t ≤ 0.9: beyond, branches are followed only as far as their errors allow.
    """
    curve = solved.curves[fold.branch]
    i = int(np.clip(np.searchsorted(curve.position, fold.position), 1, len(curve.position) - 1))
    direction = side * np.sign(np.diff(curve.points.place(solved.solver.condition)[i - 1 : i + 1])[0])
    found = []
    for other in solved.states_at(solved.control_at(fold)):
        jump = (solved.place(other) - solved.place(fold)) * direction
        same = other.branch == fold.branch and abs(other.position - fold.position) < 1e-4
        scanned = (
            other.point.u[2, 0] <= SCANNED_LOAD * largest_load(solved.solver.membrane.material, other.point.u[0])[0]
        )
        if jump > 0 and not same and other.point.index[0] == 0 and scanned:
            found.append((jump, other))
    return min(found, key=lambda f: f[0])[1] if found else None


def _follow(solved, here, rising: bool, events: list, direction: str):
    """Walks from `here` until the ramp ends; appends events. Returns (last held state, reason, last landing, located)."""
    held = solved.state(here)
    last = here
    landing = None
    jump = RampEvent.snap if rising else RampEvent.snap_back
    for _ in range(MOST_JUMPS):
        kind, stop, side = _walk(solved, last, rising)
        if kind == "window":
            state = _end_of(solved, last, side)
            events.append(Event(RampEvent.end, direction, state, "window"))
            return state, "window", landing, last
        state = solved.state(stop)
        if kind == PointKind.breakdown:
            events.append(Event(RampEvent.breakdown, direction, state, "breakdown on the branch"))
            return state, "breakdown on the branch", landing, last
        if kind == PointKind.zero_voltage:
            events.append(Event(RampEvent.end, direction, state, "zero voltage"))
            return state, "zero voltage", landing, last
        held = state
        events.append(Event(jump, direction, state))
        landed = _land(solved, stop, side)
        if landed is None:
            events.append(Event(RampEvent.no_landing, direction, state, "no landing"))
            return held, "no landing", landing, None
        state = solved.state(landed)
        events.append(Event(RampEvent.landing, direction, state))
        landing = state
        if rising and state.breakdown_ratio >= 1:
            events.append(Event(RampEvent.breakdown, direction, state, "breakdown in the snap"))
            return held, "breakdown in the snap", landing, None
        last = landed
    events.append(Event(RampEvent.end, direction, held, "too many jumps"))
    return held, "too many jumps", landing, None


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
    events = [Event(RampEvent.start, "up", first)]
    state, reason, landing, last = _follow(solved, start, True, events, "up")
    up = Ramp(tuple(events), _strain(state, first), reason)
    down = None
    if last is not None:
        begin = landing or first
        first, last_held = (_control_of(solved, s) for s in (begin, events[-1].state))
        middle = (first + last_held) / 2
        if math.isfinite(middle) and middle > first:
            _, _, side = _walk(solved, last, True)
            ahead = [
                p
                for p in solved.states_at(middle**2)
                if p.branch == last.branch and (p.position - last.position) * side > 0
            ]
            if ahead:
                down = _way_back(solved, min(ahead, key=lambda p: (p.position - last.position) * side))
    return up, down


def _way_back(solved, here) -> Ramp:
    events = [Event(RampEvent.start, "down", solved.state(here))]
    _follow(solved, here, False, events, "down")
    return Ramp(tuple(events))


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
    return _way_back(solved, near[0])


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
