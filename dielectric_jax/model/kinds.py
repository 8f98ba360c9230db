"""What a point can be: kinds of special points, events of a ramp, and the equations that determine a point."""

import enum

__all__ = ["ClosingEquation", "PointKind", "RampEvent"]


class PointKind(enum.StrEnum):
    """Kinds of points, each the root of a test function along a branch or of a system of equations.

    Special points of a diagram are `fold`, `zero_voltage`, `breakdown`, `hoop_tension_loss`, `slack` and `mode`. A fold is one of
    the control: `pressure_fold` and `charge_fold` say which, where a computation has to know; diagrams list both as `fold`.
    The rest are points at which a quantity has a given value, and points of codimension two.
    """

    fold = "fold"  # of the load q
    pressure_fold = "pressure_fold"
    charge_fold = "charge_fold"
    zero_voltage = "zero_voltage"
    breakdown = "breakdown"
    hoop_tension_loss = "hoop_tension_loss"
    slack = "slack"
    mode = "mode"  # a mode of some circumferential number is neutral
    load = "load"
    charge = "charge"
    volume = "volume"
    pressure = "pressure"
    onset = "onset"  # of bistability: a fold at a given load, with a parameter unknown
    cusp = "cusp"
    pressure_cusp = "pressure_cusp"

    __repr__ = str.__repr__  # type: ignore[assignment]

    @property
    def is_fold(self) -> bool:
        """Whether a control turns there."""
        return self in (PointKind.fold, PointKind.pressure_fold, PointKind.charge_fold)


class RampEvent(enum.StrEnum):
    """What happens on a ramp, in the words of the JSON document."""

    start = "start"
    snap = "snap"
    landing = "landing"
    snap_back = "snap_back"
    breakdown = "breakdown"
    no_landing = "no_landing"
    end = "end"

    __repr__ = str.__repr__  # type: ignore[assignment]


class ClosingEquation(enum.IntEnum):
    """The third equation of a point, beside the rim's and the loading's; numbers, because compiled programs choose by it."""

    level = 0  # row · (λa, p, q) = target
    volume = 1  # V = target
    breakdown = 2  # q = q_b(λa)
    fold = 3  # dq = 0 along the branch
