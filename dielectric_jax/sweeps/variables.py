"""The variables of a sweep: their names, dimensions, units and meanings; and the results of the engines as such variables.

Every value has an error estimate, named by the attribute `ancillary_variables` of the CF conventions; codes have
`flag_values` and `flag_meanings`.
"""

import dataclasses
import typing

import numpy as np

from ..diagram import (
    ENDS,
    LISTED,
    LOSSES,
    NOT_DECIDED,
    NOT_LOCATED,
    SLOTS,
    Diagram,
    RampArrays,
    Ramps,
    Slot,
    ramps_of,
    regime_of_diagram,
)
from ..model import FoldAhead, Outcome, PointKind, Ramp, RampEvent, Regime, State, field_on
from ..numerics import Code, NamedCode
from ..surface import ROWS

__all__ = [
    "Answer",
    "Variable",
    "answers_of",
    "empty_answer",
    "unanswered",
    "variables_of",
]


class Answer(NamedCode):
    """The values of the variable `outcome`: those of `Outcome`, and further results a scene can have."""

    not_computed = -1
    breakdown_on_branch = 0
    breakdown_in_snap = 1
    no_landing = 2
    start_unstable = 3
    unresolved = 4
    ended_by_window = 5  # the ramp reached the window's end, or the film went slack, before breakdown
    no_answer = 6  # the scene has no answer: `code` says why
    invalid_scene = 7  # its parameters are incompatible, such as a prestretch beyond the limiting stretch
    failed = 8  # its computation raised an error
    lost_axisymmetry = 9  # a mode turned unstable, or hoop tension was lost; with `modes` only


class Source(NamedCode):
    """The engine that answered a scene."""

    none = -1
    surface = 0
    continuation = 1
    diagram = 2


@dataclasses.dataclass(frozen=True)
class Variable:
    """One variable of a sweep: `dims` are its dimensions besides those of the scenes, with their sizes."""

    name: str
    dims: dict[str, int]
    dtype: str
    fill: float
    attributes: dict[str, typing.Any]


_ANSWER_WORDS = {
    "outcome": "how the ramp up ends",
    "regime": "what a slow ramp of the voltage does: the way up, then the way down from the last landing",
    "code": "why continuation ended or the scene has no answer, as in `dielectric_jax.numerics.Code`",
    "answered_by": "which engine answered: the surface, batched continuation, or a whole diagram",
}
_FLAGS = {"outcome": Answer, "regime": Regime, "code": Code, "answered_by": Source}

#: points of a ramp: the field of `Ramps`, the dimension of its last axis and its size, and the meaning of the point
_POINTS = {
    "start": (None, 0, "in which the ramp begins, at zero voltage"),
    "snap": ("jump", 2, "at the fold from which the membrane snaps"),
    "landing": ("jump", 2, "on which the snap lands"),
    "breakdown": (None, 0, "of electric breakdown on the branch"),
    "snap_back": ("jump", 2, "at the fold from which the membrane snaps back on the way down"),
    "landing_back": ("jump", 2, "on which the snap back lands"),
    "rest": (None, 0, "in which the way down ends, at zero voltage"),
    "fold": ("fold_number", 6, "of a fold of the branch through the start, in order of apex stretch"),
    "zero_voltage": (
        "zero_number",
        5,
        "of the branch through the start at zero voltage, in order of apex stretch",
    ),
    "breakdown_crossing": ("crossing_number", 3, "at which the branch through the start reaches breakdown"),
}
#: the point that only a sweep with modes has
_LOSS = "axisymmetry_loss", "at which a mode turns unstable or hoop tension is lost"
_FIELDS = {"fold": "folds", "breakdown_crossing": "breakdowns"}
_AT_ZERO = ("start", "rest", "zero_voltage")
_QUANTITIES = {
    "apex_stretch": ("stretch of the apex", "1"),
    "pressure": ("pressure", "mu H / A"),
    "volume": ("volume below the membrane", "A^3"),
    "voltage": ("voltage", "H sqrt(mu / epsilon)"),
}
_ERROR = "bound of the relative error |error|/max(|value|, 1e-3) of the volume and of the squared voltage"

_SI = ("Pa", "m", "F m-1")
#: units of dimensionless numbers: the unit in SI, and the quantity whose scale is between them
_IN_SI = {
    "mu H / A": ("Pa", "pressure"),
    "A^3": ("m3", "volume"),
    "H sqrt(mu / epsilon)": ("V", "voltage"),
    "H^2 mu / epsilon": ("V2", "voltage_squared"),
}


def described(long_name: str, unit: str, **more) -> dict[str, typing.Any]:
    """Attributes of a quantity: its CF unit is 1, and `counted_in` names the unit of the dimensionless number."""
    if unit in _SI:
        return {"long_name": long_name, "units": unit, **more}
    return {"long_name": long_name, "units": "1", "counted_in": unit, **more}


def described_in_si(attributes: dict[str, typing.Any]) -> dict[str, typing.Any]:
    """The attributes of a quantity that is converted to SI."""
    unit = _IN_SI.get(attributes.get("counted_in", ""))
    if unit is None:
        return attributes
    return {n: unit[0] if n == "units" else v for n, v in attributes.items() if n != "counted_in"}


def kinds_in_si(variables: list["Variable"]) -> dict[str, str]:
    """The quantities of the variables that have a unit in SI, by their names."""
    counted = {v.name: v.attributes.get("counted_in", "") for v in variables}
    return {name: _IN_SI[unit][1] for name, unit in counted.items() if unit in _IN_SI}


def flags_of(name: str) -> dict[str, typing.Any]:
    """Attributes of a variable of codes."""
    members = list(_FLAGS[name])
    meanings = " ".join(member.name for member in members)
    values = np.array([int(member) for member in members], "int8")
    return {"long_name": _ANSWER_WORDS[name], "flag_values": values, "flag_meanings": meanings}


def variables_of(curves: bool, modes: bool = False) -> list[Variable]:
    """The variables of a sweep, codes first."""
    found = [
        Variable("outcome", {}, "int8", int(Answer.not_computed), flags_of("outcome")),
        Variable("regime", {}, "int8", int(Regime.not_decided), flags_of("regime")),
        Variable("code", {}, "int8", int(Code.ok), flags_of("code")),
        Variable("answered_by", {}, "int8", int(Source.none), flags_of("answered_by")),
        Variable("snaps", {}, "int8", 0, {"long_name": "snaps of the way up", "units": "1"}),
    ]

    def number(name, dims, long_name, unit, error=None, **more):
        attributes = described(long_name, unit, **more)
        if error:
            attributes["ancillary_variables"] = error
        found.append(Variable(name, dims, "float64", np.nan, attributes))

    strain = "(apex stretch at breakdown / apex stretch at the start)^2 - 1; without breakdown on the branch that of the last unbroken state"
    number("area_strain", {}, "area strain of the apex", "1", "ramp_error", description=strain)
    number("ramp_error", {}, "largest error of the events of the ramp", "1", description=_ERROR)
    number("landing_ratio", {"jump": 2}, "E/E_EB at the landing, largest along the membrane", "1", "landing_error")
    reach = "the branch is known between these stretches: all special points there are listed"
    number("reach", {"end": 2}, "apex stretches between which the branch is known", "1", description=reach)
    for point, (dim, size, words) in _POINTS.items():
        dims = {} if dim is None else {dim: size}
        for quantity, (long_name, unit) in _QUANTITIES.items():
            if quantity != "voltage" or point not in _AT_ZERO:
                number(f"{point}_{quantity}", dims, f"{long_name} of the state {words}", unit, f"{point}_error")
        number(f"{point}_error", dims, f"error of the state {words}", "1", description=_ERROR)
    if modes:
        for quantity, (long_name, unit) in _QUANTITIES.items():
            number(f"{_LOSS[0]}_{quantity}", {}, f"{long_name} of the state {_LOSS[1]}", unit, f"{_LOSS[0]}_error")
        number(f"{_LOSS[0]}_error", {}, f"error of the state {_LOSS[1]}", "1", description=_ERROR)
        words = "circumferential number of the mode that turns unstable, 0 where none does"
        found.append(Variable("mode_number", {}, "int16", 0, {"long_name": words, "units": "1"}))
    if curves:
        dims = {"curve_point": ROWS}
        for quantity, (long_name, unit) in _QUANTITIES.items():
            own = ("voltage_squared", "squared voltage", "H^2 mu / epsilon") if quantity == "voltage" else None
            name, long_name, unit = own or (quantity, long_name, unit)
            number(f"curve_{name}", dims, f"{long_name} along the curve of voltage against volume", unit, "curve_error")
        number("curve_error", dims, "error of the states of the curve", "1", description=_ERROR)
    return found


def empty_answer(count: int, curves: bool) -> dict[str, np.ndarray]:
    """The variables of `count` scenes that are not answered yet."""
    return unanswered(count, variables_of(curves))


def unanswered(count: int, variables: list[Variable]) -> dict[str, np.ndarray]:
    """Arrays (count, …) of the fill values of variables."""
    return {v.name: np.full((count, *v.dims.values()), v.fill, v.dtype) for v in variables}


def answers_of(ramps: Ramps, source: Source, code: typing.Any = Code.ok) -> dict[str, np.ndarray]:
    """The variables of ramps (without curves), with loadings along one axis."""
    found = {
        "outcome": np.asarray(ramps.outcome, "int8"),
        "regime": ramps.regime,
        "code": np.broadcast_to(np.asarray(code, "int8"), ramps.outcome.shape),
        "answered_by": np.where(ramps.outcome == Outcome.unresolved, int(Source.none), int(source)).astype("int8"),
        "snaps": np.asarray(ramps.snaps, "int8"),
        "area_strain": ramps.area_strain,
        "ramp_error": ramps.error,
        "landing_ratio": ramps.landing_ratio,
        "reach": ramps.reach,
    }
    for point in _POINTS:
        states = getattr(ramps, _FIELDS.get(point, point))
        for quantity in (*_QUANTITIES, "error"):
            if quantity != "voltage" or point not in _AT_ZERO:
                found[f"{point}_{quantity}"] = getattr(states, quantity)
    return found


def answer_of_diagram(diagram: Diagram, modes: bool = False) -> dict[str, np.ndarray]:
    """The variables of one scene from its whole diagram, arrays of length 1."""
    up = diagram.ramp()
    down = [e for e in diagram.events if e.direction == "down"]
    events = np.full((1, 5, SLOTS), np.nan)
    kinds = PointKind.fold, PointKind.zero_voltage, PointKind.breakdown
    special = {kind: np.full((1, 5, size), np.nan) for kind, size in zip(kinds, LISTED.values(), strict=True)}

    def put(columns, i: int, state: State) -> None:
        columns[0, :, i] = (
            state.apex_stretch, state.pressure, state.voltage_squared, state.volume, state.error_estimate
        )  # fmt: skip

    starts = [e.state for e in up["start"]]
    begin = starts[0] if starts else None
    for first, states in (
        (Slot.start, starts),
        (Slot.snaps.start, [e.state for e in up["snap"]][:2]),
        (Slot.landings.start, [e.state for e in up["landing"]][:2]),
        (Slot.breakdown, [e.state for e in up["breakdown"] if e.reason == "breakdown on the branch"]),
        (Slot.snap_backs.start, [e.state for e in down if e.event == RampEvent.snap_back][:2]),
        (Slot.landings_back.start, [e.state for e in down if e.event == RampEvent.landing][:2]),
        (Slot.rest, [e.state for e in down if e.event == RampEvent.end and e.reason == "zero voltage"]),
    ):
        for i, state in enumerate(states):
            put(events, first + i, state)
    branch = [p.branch for p in diagram.special_points if begin is not None and _same(p, begin)]
    own = [p for p in diagram.special_points if branch and p.branch == branch[0]]
    for kind, columns in special.items():
        states = sorted((p for p in own if p.kind == kind), key=lambda p: p.apex_stretch)
        for i, state in enumerate(states[: columns.shape[2]]):
            put(columns, i, state)
    outcome = int(_outcome(up))
    snaps = np.array([len(up["snap"])])
    law = diagram.scene.membrane.breakdown

    def breakdown_load(apex):
        return (field_on(law, np.nan_to_num(apex, nan=2.0)) / apex**2) ** 2

    reach = np.full((1, 2), np.nan)
    if branch:
        apex = diagram.branches[branch[0]].apex_stretch
        reach[0] = np.nanmin(apex), np.nanmax(apex)
        folds, zeros, breaks = special.values()
    unknown = np.array([FoldAhead.unknown])
    arrays = RampArrays(events, folds, zeros, breaks, snaps, np.array([outcome]), reach, unknown)
    ramps = ramps_of(breakdown_load, arrays)
    found = answers_of(ramps, Source.diagram) | {"area_strain": np.array([up.area_strain], float)}
    landings = [e.state.breakdown_ratio for e in up["landing"]][:2]
    found["landing_ratio"] = np.full((1, 2), np.nan)
    found["landing_ratio"][0, : len(landings)] = landings
    found["regime"] = np.array([int(regime_of_diagram(diagram))], "int8")
    return found | (_loss_of_axisymmetry(diagram) if modes else {})


def _outcome(up: Ramp) -> Answer:
    """How the ramp up of a whole diagram ends."""
    reason = up.area_strain_reason or ""
    if reason in ENDS:
        return Answer(int(ENDS[reason]))
    if reason in LOSSES.values():
        return Answer.lost_axisymmetry
    if reason in (NOT_DECIDED, NOT_LOCATED):
        return Answer.unresolved
    return Answer.ended_by_window if up.events else Answer.no_answer


def _loss_of_axisymmetry(diagram: Diagram) -> dict[str, np.ndarray]:
    """The variables of the state in which the ramp up loses its axisymmetry, NaN where it does not."""
    up = diagram.ramp()
    state = up["end"][0].state if _outcome(up) is Answer.lost_axisymmetry else None
    numbers = [p.number for p in diagram.special_points if p.kind == PointKind.mode and state and _same(p, state)]
    values = {name: np.nan if state is None else getattr(state, name) for name in _QUANTITIES}
    values["error"] = np.nan if state is None else state.error_estimate
    found = {f"{_LOSS[0]}_{name}": np.array([value], float) for name, value in values.items()}
    return found | {"mode_number": np.array([numbers[0] if numbers else 0], "int16")}


def _same(point: State, state: State) -> bool:
    return abs(point.volume - state.volume) <= 1e-9 * (1 + abs(state.volume)) and (
        abs(point.voltage_squared - state.voltage_squared) <= 1e-12
    )
