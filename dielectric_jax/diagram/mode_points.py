"""Where modes turn neutral: the points of a diagram's branches at which the lowest eigenvalue of a number vanishes.

Modes of number n ≥ 1 change neither the volume nor the charge to first order, so whether they lower the energy depends on the
state alone, whatever its loading. Along every branch the lowest eigenvalue of each number is taken at some points, and at all
points of the mesh where it comes near to zero and turns back; where it changes its sign it is a test function, whose root is
located like other special points.
"""

import dataclasses
import typing
from collections.abc import Sequence

import numpy as np

from ..model import Membrane, PointKind, Points
from ..modes import lowest_eigenvalues, lowest_of_numbers
from .branches import Solved
from .mesh import Curve
from .resolution import MODE_SAMPLES, NEAR_NEUTRAL
from .special_points import Located, TestFunction, locate

__all__ = ["NOT_DECIDED", "loss_at", "neutral_points"]

#: why a ramp ends at a state whose modes no basis resolves
NOT_DECIDED = "modes not decided"


@dataclasses.dataclass(frozen=True, eq=False)
class _Eigenvalue(TestFunction):
    """The lowest eigenvalue of a number as a test function along a branch."""

    membrane: Membrane
    number: int

    @staticmethod
    def of_each(tests: Sequence["_Eigenvalue"], points: Points) -> np.ndarray:
        return lowest_eigenvalues(tests[0].membrane, points.u, np.array([t.number for t in tests]))


class NeutralPoints(typing.NamedTuple):
    """The points of all branches at which the lowest mode of a number is neutral.

    `missed` are those that were not located: (test function, branch, interval, target), as of `locate`; `undecided` are points
    of the mesh beside these, or at which the sign of an eigenvalue is not known, nor that it changes once between its neighbours.
    """

    found: list[Located]
    missed: list[tuple]
    undecided: list[Located]


def neutral_points(solved: Solved, numbers: Sequence[int]) -> NeutralPoints:
    """The neutral points of a diagram's branches for modes of the numbers."""
    membrane = solved.solver.membrane
    changes = [_changes(membrane, curve, numbers) for curve in solved.curves]
    asked = [(test, branch, interval, 0.0) for branch, (turns, _) in enumerate(changes) for test, interval in turns]
    found, missed = locate(solved.solver, solved.curves, asked, solved.tolerance) if asked else ([], [])
    kept = [w for w in asked if w not in missed]
    unknown = [(branch, i) for branch, (_, places) in enumerate(changes) for i in places]
    unknown += [(branch, interval) for _, branch, interval, _ in missed]
    undecided = [_located(branch, solved.curves[branch], i) for branch, i in unknown]
    points = [
        dataclasses.replace(point, kind=PointKind.mode, number=test.number)
        for point, (test, *_) in zip(found, kept, strict=True)
    ]
    return NeutralPoints(sorted(points, key=lambda p: (p.branch, p.position)), missed, undecided)


def _located(branch: int, curve: Curve, i: int) -> Located:
    """A point of a branch's mesh."""
    point = curve.points.take(slice(i, i + 1))
    return Located(PointKind.mode, branch, float(curve.position[i]), point, float(point.error[0]))


def loss_at(solved: Solved, here: Located, numbers: Sequence[int]) -> str | None:
    """How a state has lost its axisymmetry: "wrinkles" without hoop tension, "bulges" by a mode of one of the numbers; or None.

    `NOT_DECIDED` where no mode is known to lower the energy, but the sign of one is not known either.
    """
    if here.point.hoop[0] < 0:
        return "wrinkles"
    lowest = lowest_of_numbers(solved.solver.membrane, here.point.u, numbers)
    if (lowest.compressed() < 0).any():
        return "bulges"
    return NOT_DECIDED if np.ma.getmaskarray(lowest).any() else None


def _changes(
    membrane: Membrane, curve: Curve, numbers: Sequence[int]
) -> tuple[list[tuple[_Eigenvalue, int]], list[int]]:
    """Lowest eigenvalues that change their sign along a branch, and after which points of its mesh; and where signs are not known."""
    u = curve.points.u
    chosen = np.unique(np.linspace(0, u.shape[1] - 1, MODE_SAMPLES).round().astype(int))
    values = lowest_of_numbers(membrane, u[:, chosen], numbers)
    more = np.setdiff1d(_near_turns(chosen, values), chosen)
    if len(more):
        whole = np.concatenate([chosen, more])
        order = np.argsort(whole)
        chosen = whole[order]
        values = np.ma.concatenate([values, lowest_of_numbers(membrane, u[:, more], numbers)])[order]
    unknown = np.ma.getmaskarray(values).copy()
    turns = [(k, *ends) for k in range(len(numbers)) for ends in _turns(values[:, k])]
    for k, i, j in turns:
        unknown[i : j + 1, k] = False
    undecided = [int(chosen[i]) for i in np.flatnonzero(unknown.any(axis=1))]
    if not turns:
        return [], undecided
    inside = np.unique(np.concatenate([np.arange(int(chosen[i]), int(chosen[j]) + 1) for _, i, j in turns]))
    exact = np.ma.masked_all((u.shape[1], len(numbers)))
    exact[inside] = lowest_of_numbers(membrane, u[:, inside], numbers)
    found = []
    for k, i, j in turns:
        begin = int(chosen[i])
        own = exact[begin : chosen[j] + 1, k]
        found += [(_Eigenvalue(membrane, numbers[k]), begin + _crossing(own.data, *ends)) for ends in _turns(own)]
    return found, undecided


def _turns(values: np.ma.MaskedArray) -> list[tuple[int, int]]:
    """Between which values the sign changes: each is decided, and none between them is."""
    known = np.flatnonzero(~np.ma.getmaskarray(values))
    signs = np.sign(values.data[known])
    return [(int(known[i]), int(known[i + 1])) for i in np.flatnonzero(signs[1:] * signs[:-1] < 0)]


def _crossing(values: np.ndarray, begin: int, end: int) -> int:
    """After which of the values from `begin` to `end` the sign changes; between them errors are as large as values."""
    return begin + int(np.flatnonzero(values[begin:end] * values[begin + 1 : end + 1] <= 0)[0])


def _near_turns(chosen: np.ndarray, values: np.ma.MaskedArray) -> np.ndarray:
    """The points of the mesh around samples at which an eigenvalue is nearest to zero and might cross it between samples.

    A parabola through three samples goes on by at most a share of their change.
    """
    known = values.filled(np.nan)
    before, here, after = (np.abs(known[k : len(known) - 2 + k]) for k in range(3))
    same = (np.sign(known[:-2]) == np.sign(known[1:-1])) & (np.sign(known[2:]) == np.sign(known[1:-1]))
    change = np.maximum(before, after) - here
    near = same & (here <= before) & (here <= after) & (here < NEAR_NEUTRAL * change)
    found = [np.arange(chosen[i] + 1, chosen[i + 2]) for i in np.flatnonzero(near.any(axis=1))]
    return np.unique(np.concatenate(found)) if found else np.zeros(0, int)
