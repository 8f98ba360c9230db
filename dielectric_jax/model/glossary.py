"""What the words of results mean, in one place: `explain` for the command line and the glossary of the documentation."""

import difflib
import re
import typing

from ..numerics import Code, shown
from .kinds import PointKind, RampEvent
from .outcomes import Regime
from .parameters import PARAMETERS

__all__ = ["GLOSSARY", "explain"]

_REGIMES = {
    Regime.no_snap: "The voltage rises until the membrane breaks down, and the branch of equilibria has no fold, so the membrane never snaps.",
    Regime.breaks_before_snap: "The membrane breaks down on its first branch, before it reaches the fold at which it would snap.",
    Regime.breaks_in_snap: "The membrane snaps, and the state that it would land on lies at breakdown or beyond.",
    Regime.no_landing: "The membrane snaps, and the window holds no stable state at that voltage for it to land on.",
    Regime.stays: (
        "The membrane snaps, survives, and stays expanded when the voltage is lowered to zero. It returns only if gas is released."
    ),
    Regime.returns: "The membrane snaps, survives, and snaps back when the voltage is lowered.",
    Regime.start_unstable: "The state at zero voltage is not stable, so no ramp starts from it.",
    Regime.undetermined: (
        "The ramp ends before breakdown, at the edge of the window or where a flat film goes slack. A wider window may show how it goes on."
    ),
    Regime.not_decided: "The computation did not decide between regimes. This says nothing about the membrane; `voltage_volume` of the scene shows how far the computation got.",
    Regime.wrinkles: "The membrane loses its hoop tension before anything else and wrinkles. Reported only if modes are requested.",
    Regime.bulges: "A mode that is not axisymmetric turns unstable before anything else. Reported only if modes are requested.",
}
_EVENTS = {
    RampEvent.start: "The state at zero voltage from which the ramp starts.",
    RampEvent.snap: "The voltage (or charge) can rise no further on this branch: the membrane jumps at constant voltage (or charge).",
    RampEvent.landing: "The stable state that the membrane jumps to.",
    RampEvent.snap_back: "On the way down: the fold at which the membrane jumps back.",
    RampEvent.breakdown: "The true electric field at the apex reaches the breakdown field.",
    RampEvent.no_landing: _REGIMES[Regime.no_landing],
    RampEvent.end: "The ramp ends without breakdown; `reason` says why.",
}
_POINTS = {
    PointKind.fold: (
        "A point at which the control (voltage, pressure or charge) has a maximum or minimum along a branch (a limit point, LP in AUTO). "
        "Stability changes there, and a slow ramp snaps."
    ),
    PointKind.zero_voltage: "A state without voltage.",
    PointKind.breakdown: _EVENTS[RampEvent.breakdown],
    PointKind.hoop_tension_loss: (
        "The hoop stress falls to zero somewhere on the membrane. Beyond this point the membrane wrinkles, and the axisymmetric "
        "states of the diagram are not what an experiment shows."
    ),
    PointKind.slack: "The stress of a flat film falls to zero: more voltage makes it slack.",
    PointKind.mode: "A mode with `number` waves around the axis is neutral: its lowest eigenvalue is zero.",
    PointKind.cusp: "Two folds merge. Beyond a cusp these two folds, and the snap between them, no longer exist.",
    PointKind.onset: "The onset of bistability: a fold lies exactly at zero voltage, and beyond this value of the parameter a second stable state exists without voltage.",
}
_QUANTITIES = {
    "voltage": "The voltage Φ across the film: in units of H√(μ/ε), or in the unit that the table names.",
    "voltage_squared": "The electrostatic load q = Φ². It is negative on parts of branches that no voltage reaches.",
    "pressure": "The gauge pressure p (inside minus outside): in units of μH/A, or in the unit that the table names.",
    "volume": (
        "The volume V between the flat and the inflated membrane, without the chamber: in units of A³, or in the unit that the table names."
    ),
    "apex_stretch": "The stretch λa of the film at the apex, relative to the undeformed film.",
    "height": "The height of the apex above the rim, in units of A.",
    "charge": "The charge on an electrode, in units of A²√(εμ).",
    "breakdown_ratio": "The true field at the apex over the breakdown field, E/E_EB. Breakdown is at 1.",
    "index": (
        "The number of unstable axisymmetric directions under the scene's own loading: 0 is stable. Empty at a fold, where it changes, "
        "and where it is not valid."
    ),
    "error_estimate": (
        "The estimated relative error of pressure, volume and voltage squared at the same apex stretch; for a special point, that of the quantity that was located."
    ),
    "hoop_tension": "The least true hoop stress along the membrane, in units of μ. Negative means wrinkles.",
    "area_strain": (
        "The growth of the area at the apex on the ramp up, relative to the inflated start and not to the flat film: (λa at the end / λa at "
        "the start)² − 1. The end is breakdown, or the fold before a snap that the membrane does not survive, or where the ramp is followed no further."
    ),
    "complete": "Whether scan and continuation agree on the branches, and each was followed to the edge of the window or is a closed loop.",
    "window": "The part of the (apex stretch, load) plane that is searched for equilibria.",
    "branch": "A curve of equilibria without a break.",
    "prestretch": "The stretch λ₀ of the flat film at its rim, relative to the undeformed film.",
}
_FLAGS = {
    "error_above_tolerance": "The error estimate exceeds the tolerance that was asked for.",
    "points_lost": "The branch has a gap between its points.",
    "end_lost": "The branch ends inside the scanned window without having reached an edge.",
    "special_point_lost": "A special point is known to lie on the branch but could not be located.",
    "ends_slack": "The branch of a flat film ends where the film goes slack.",
}
_ENDS = {
    "breakdown on the branch": "The ramp ends at breakdown, on a stable branch.",
    "breakdown in the snap": _REGIMES[Regime.breaks_in_snap],
    "no landing": _REGIMES[Regime.no_landing],
    "zero voltage": "The way down reaches zero voltage.",
    "too many jumps": "The ramp has more jumps than the computation is set to follow.",
    "landing not located": "Near a cusp, the landing is too close to the fold for the two to be distinguished.",
    "modes not decided": "The ramp comes to a state at which the sign of a mode's eigenvalue is not known.",
    "bulges": _REGIMES[Regime.bulges],
    "wrinkles": _REGIMES[Regime.wrinkles],
    "lost axisymmetry": "A mode turned unstable, or hoop tension was lost. Reported only if modes are requested.",
    "breakdown_in_snap": _REGIMES[Regime.breaks_in_snap],
    "breakdown_on_branch": "The ramp ends at breakdown, on a stable branch.",
    "unresolved": "The engine did not determine how the ramp ends; `voltage_volume` of the scene can.",
    "ended_by_window": "The ramp reaches the edge of the window, or the film goes slack, before breakdown.",
    "no_answer": "The scene has no answer; `code` says why.",
    "invalid_scene": "The parameters of the scene are incompatible, such as a prestretch beyond the limiting stretch.",
    "failed": "The computation of this scene raised an error.",
    "not_computed": "The scene has not been computed yet.",
}
_IN_TIME = {
    "survives": "In a run of `follow`: the protocol ends, or the membrane comes to rest, without a snap.",
    "snaps": "In a run of `follow`: the membrane reaches an instantaneous fold, jumps and lands unbroken.",
    "creeps_through": "In a run of `follow`: the membrane creeps past the fold at which it would snap at rest, without a jump.",
    "breaks_down": "In a run of `follow`: the membrane breaks down before any snap.",
    "goes_slack": "In a run of `follow`: the film loses its tension before any snap.",
    "jump": "In a run of `follow`: the membrane jumps at an instantaneous fold.",
    "creep_through": "In a run of `follow`: the membrane creeps past the fold at which it would snap at rest, without a jump.",
    "instantaneous_fold": "In a run of `follow`: a fold with the dashpots frozen: beyond it there is no equilibrium nearby, and the membrane jumps.",
    "fastest": "In a run of `follow`: the moment at which a creep-through is fastest.",
    "relaxed": "In a run of `follow`: the membrane starts fully relaxed: its Maxwell branches carry no stress.",
    "fresh": "In a run of `follow`: the membrane starts just after a fast inflation: its Maxwell branches have not relaxed yet.",
    "end of the protocol": "In a run of `follow`: the protocol was completed.",
    "end_of_protocol": "In a run of `follow`: the protocol was completed.",
    "at rest": "In a run of `follow`: the membrane no longer moves.",
    "hoop tension lost": "In a run of `follow`: the hoop stress falls to zero somewhere on the membrane.",
    "not_followed": "In a run of `follow`: a landing was not found, or the run did not converge.",
}


def _key(word: str) -> str:
    return re.sub(r"[\s_\-–]+", " ", word).strip().casefold()


def _parameters() -> dict[str, str]:
    found = {}
    for name, row in PARAMETERS.items():
        allowed = f", {row.allowed}" if row.allowed else ""
        default = "" if row.default is None else f"; the default is {row.default:g}"
        in_si = " In SI on a scene with units." if row.kind in ("pressure", "volume") else ""
        found[name] = f"A parameter: {row.label}{allowed}{default}.{in_si}"
    return found


def _entries() -> dict[str, str]:
    groups: list[dict[typing.Any, str]] = [
        {code: code.sentence for code in Code},
        _IN_TIME,
        _ENDS,
        _FLAGS,
        _parameters(),
        _QUANTITIES,
        _POINTS,
        _EVENTS,
        _REGIMES,
    ]
    named = {str(getattr(word, "name", word)): text for group in groups for word, text in group.items()}
    return {_key(name): text for name, text in sorted(named.items(), key=lambda item: _key(item[0]))}


#: what every word of a result means, by the word in lower case with spaces
GLOSSARY = _entries()


def explain(word: str) -> str:
    """What a word of a result means: a regime, event, special point, column, flag, code or parameter.

    Raises ValueError for an unknown word, with those that resemble it.

    >>> explain("breaks_in_snap")
    'The membrane snaps, and the state that it would land on lies at breakdown or beyond.'
    """
    found = GLOSSARY.get(_key(word))
    if found is None:
        near = difflib.get_close_matches(_key(word), GLOSSARY, n=4, cutoff=0.5)
        hint = f"resembles {', '.join(near)}" if near else "resembles none of them"
        raise ValueError(f"`word` must be a word of the glossary, but {shown(word)} {hint}.")
    return found
