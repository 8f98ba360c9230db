"""The functions along a branch whose roots are its special points."""

import numpy as np

from ..model import SCALE, Points
from .mesh import Curve

__all__ = ["FOLDS", "brackets", "control_line", "event_values"]

FOLDS = {"pressure_fold": 1, "fold": 2, "charge_fold": 3}  # and the column of the control that turns there


def event_values(kind: str, points: Points, target: float = 0.0) -> np.ndarray:
    """The function of an event on points (lanes,): it vanishes at the event."""
    if kind in FOLDS:
        return points.control_slope(FOLDS[kind])
    if kind == "zero_voltage":
        return points.u[2] / 0.02
    if kind == "load":
        return (points.u[2] - target) / 0.02
    if kind == "charge":
        return (points.control(3) - target) / 0.02
    if kind == "breakdown":
        return points.u[2] * points.field - 1
    if kind == "hoop_tension_loss":
        return points.hoop
    raise ValueError(f"`kind` must be the name of an event, but is {kind!r}.")


def control_line(points: Points, column: int):
    """A control along a branch and its slope by the arclength, in scaled units."""
    if column != 3:
        return points.u[column] / SCALE[column], points.control_slope(column)
    return points.control(3) / SCALE[2], points.control_slope(3) * points.charge_per_voltage**2


def brackets(curve: Curve, kind: str, target: float = 0.0) -> np.ndarray:
    """Indices i with a sign change of the event function between points i and i + 1."""
    f = event_values(kind, curve.points, target)
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(((f[:-1] < 0) != (f[1:] < 0)) & np.isfinite(f[:-1]) & np.isfinite(f[1:]))
