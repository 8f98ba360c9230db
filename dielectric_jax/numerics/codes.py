"""Result codes as sentences that say what to try, and the errors raised at the edge.

Traced code carries the integer of a `Code`; outside, `Code(i).sentence` reads it, and `SceneError` carries it.
Bad input is a `ValueError` whose one sentence names the argument, its value and what is allowed.
"""

import enum
import math
import numbers
import re

from .resolution import LARGEST

__all__ = [
    "Code",
    "NamedCode",
    "SceneError",
    "StoreError",
    "WorkersLost",
    "check_between",
    "check_positive",
    "check_whole",
    "shown",
    "whole_range",
]


class NamedCode(enum.IntEnum):
    """A number that prints as its name."""

    def __str__(self) -> str:
        return self.name


class Code(NamedCode):
    """Why a branch ended, a solve stopped or a scene has no answer."""

    ok = 0
    window_stretch = 1
    window_load = 2
    lock_up = 3
    apex_cone = 4
    closed = 5
    step_too_small = 6
    too_many_points = 7
    not_converged = 8
    no_equilibrium = 9
    flat_unstretched = 10
    no_fold = 11
    beyond_tolerance = 12
    near_flat = 13
    surface_edge = 14
    breakdown = 15
    no_landing = 20
    start_unstable = 21
    no_breakdown = 22
    no_snap_back = 23
    no_pressure_fold = 24
    no_zero_voltage_state = 25
    no_bistability = 26
    no_cusp = 27
    flat_film = 28
    other_membrane = 29
    no_neutral_mode = 30
    no_jump = 31
    no_such_state = 32

    @property
    def sentence(self) -> str:
        """What happened and what to try."""
        return _SENTENCES[self]


_SENTENCES = {
    Code.ok: "The solve succeeded.",
    Code.window_stretch: (
        "The branch left the stretch window; a wider stretch window follows it further, up to the material's largest stretch."
    ),
    Code.window_load: (
        "The branch left the load window; a wider load window, at most from -20 to 1, follows it further."
    ),
    Code.lock_up: (
        "The apex reached the lock-up of the material, where its `stretch_limit` or `chain_links` sets the limit."
    ),
    Code.apex_cone: (
        "The apex sharpens to a cone, where the tension vanishes, and the error estimate exceeds the tolerance; "
        "loosen the tolerance to follow the branch a little further."
    ),
    Code.closed: "The branch is an isolated loop and returned to its first point.",
    Code.step_too_small: "The continuation step shrank below its minimum, `smallest` of `Steps`.",
    Code.too_many_points: (
        "The branch is longer than the continuation follows; a narrower stretch window or load window shows a part of it whole."
    ),
    Code.not_converged: "Newton did not converge; try a start nearer to an equilibrium.",
    Code.no_equilibrium: (
        "No tensile equilibrium of this scene lies in the window; try a lower voltage, or a wider stretch window or load window."
    ),
    Code.flat_unstretched: (
        "The membrane is flat and unstretched, so it carries no tension; ask for a positive pressure or volume, "
        "or a prestretch above 1."
    ),
    Code.no_fold: "The ramp up has no fold of a stable branch in the window, so there is no snap.",
    Code.breakdown: "The apex reached electric breakdown; no membrane survives beyond it.",
    Code.near_flat: (
        "The pressure or volume is so small that double precision does not tell the membrane from a flat one; "
        "ask for a larger one, or for 0, the flat membrane."
    ),
    Code.surface_edge: "The branch leaves the domain of the surface; `extend=True` of `voltage_volume` follows it further by shooting.",
    Code.no_landing: "The ramp up ends in a snap: the window holds no stable state at that voltage to land on.",
    Code.start_unstable: "The state at zero voltage is not stable, so no ramp starts from it.",
    Code.no_breakdown: (
        "The ramp up ends at the window's edge without electric breakdown; a wider stretch window or load window follows it "
        "further."
    ),
    Code.no_snap_back: "The ramp down meets no fold above zero voltage, so there is no snap-back.",
    Code.no_pressure_fold: "The pressure-volume curve at this voltage has no such fold in the window.",
    Code.no_neutral_mode: "No mode of this number turns neutral on a stable state in the window.",
    Code.no_jump: (
        "The membrane does not come to an instantaneous fold: it creeps through, rests or breaks down; `follow` shows which."
    ),
    Code.no_such_state: "The window holds no such state at this voltage.",
    Code.no_zero_voltage_state: "The window holds no such state at zero voltage.",
    Code.no_bistability: "No chamber, however large, has a second stable state at zero voltage with this filling.",
    Code.no_cusp: "No two folds merge within the range that was searched; try another range, `within`.",
    Code.flat_film: "The film is flat at zero voltage and stays so; ask for a positive pressure or volume.",
    Code.other_membrane: "The surface was built for another membrane than that of the scene; build one for it.",
    Code.beyond_tolerance: "The error estimate exceeds the tolerance; ask for a looser tolerance.",
}


class SceneError(RuntimeError):
    """A scene without an answer: `code` says why, the message what to try."""

    def __init__(self, code: Code, detail: str = ""):
        self.code = code
        super().__init__(f"{code.name}: {detail + ' ' if detail else ''}{code.sentence}")


class StoreError(OSError):
    """A store that cannot be written, or goes with another sweep; the message is one sentence."""


class WorkersLost(RuntimeError):
    """Workers died again and again, or could not compute a block; the message is one sentence."""


def check_positive(name: str, value: float, *, zero: bool = False) -> None:
    """Raises `ValueError` unless `value` is positive (or zero, with `zero=True`), and at most `LARGEST`."""
    allowed = "zero or positive" if zero else "positive"
    if not (math.isfinite(value) and (value > 0 or (zero and value == 0))):
        raise ValueError(f"`{name}` must be {allowed} and finite, but is {value!r}.")
    if value > LARGEST:
        raise ValueError(f"`{name}` must be {allowed} and at most {LARGEST:g}, but is {value!r}.")


def check_whole(name: str, value, least: int, most: int, *, where: str = "") -> None:
    """Raises `ValueError` unless `value` is a whole number (Python's or NumPy's) from `least` to `most`; `where` it stands."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not (whole and least <= int(value) <= most):
        place = f" in [{where}]" if where else ""
        raise ValueError(f"`{name}`{place} must be a whole number from {least} to {most}, but is {shown(value)}.")


def whole_range(name: str, text: str) -> tuple[int, ...]:
    """The whole numbers of a text such as "5", or "0:12" with both ends; raises `ValueError` by the name otherwise.

    >>> whole_range("modes", "2:4")
    (2, 3, 4)
    """
    ends = text.split(":")
    if len(ends) > 2 or not all(re.fullmatch(r"[0-9]{1,3}", end) for end in ends) or int(ends[0]) > int(ends[-1]):
        raise ValueError(
            f"`{name}` must be a whole number or a range such as 0:12, of at most three digits, but is {shown(text)}."
        )
    return tuple(range(int(ends[0]), int(ends[-1]) + 1))


def shown(value) -> str:
    """A value as a message quotes it, shortened where it is long.

    >>> len(shown("a" * 200))
    85
    """
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python writes
        return "a whole number of thousands of digits"
    return text if len(text) <= 100 else f"{text[:40]} ... {text[-40:]}"


def check_between(name: str, value: float, low: float, high: float, *, what: str = "") -> None:
    """Raises `ValueError` unless `low <= value <= high`; `what` explains the limits."""
    if not low <= value <= high:
        raise ValueError(
            f"`{name}` must lie between {low:g} and {high:g}{what and ' (' + what + ')'}, but is {value!r}."
        )
