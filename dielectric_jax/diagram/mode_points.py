"""Where modes turn neutral: the points of a diagram's branches at which the lowest eigenvalue of a number vanishes.

Modes of number n ≥ 1 change neither the volume nor the charge to first order, so whether they lower the energy depends on the
state alone, whatever its loading. Along every branch the lowest eigenvalue of each number is taken at some points, and at all
points of the mesh where it comes near to zero and turns back; where it changes its sign it is a test function, whose root is
located like other special points.
"""

import dataclasses
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


def neutral_points(solved: Solved, numbers: Sequence[int]) -> tuple[list[Located], list[tuple]]:
    """The points of all branches at which the lowest mode of a number is neutral, and those that were not located.

    Those that were not are (test function, branch, interval, target), as of `locate`.
    """
    membrane = solved.solver.membrane
    asked = [
        (test, branch, interval, 0.0)
        for branch, curve in enumerate(solved.curves)
        for test, interval in _changes(membrane, curve, numbers)
    ]
    found, missed = locate(solved.solver, solved.curves, asked, solved.tolerance) if asked else ([], [])
    kept = [w for w in asked if w not in missed]
    points = [
        dataclasses.replace(point, kind=PointKind.mode, number=test.number)
        for point, (test, *_) in zip(found, kept, strict=True)
    ]
    return sorted(points, key=lambda p: (p.branch, p.position)), missed


def loss_at(solved: Solved, here: Located, numbers: Sequence[int]) -> str | None:
    """How a state has lost its axisymmetry: "wrinkles" without hoop tension, "bulges" by a mode of one of the numbers; or None.

    `NOT_DECIDED` where no mode is known to lower the energy, but the sign of one is not known either.
    """
    if here.point.hoop[0] < 0:
        return "wrinkles"
    lowest = lowest_of_numbers(solved.solver.membrane, here.point.u, numbers)
    if (lowest < 0).any():
        return "bulges"
    return NOT_DECIDED if np.isnan(lowest).any() else None


def _changes(membrane: Membrane, curve: Curve, numbers: Sequence[int]) -> list[tuple[_Eigenvalue, int]]:
    """Lowest eigenvalues that change their sign along a branch, and after which points of its mesh."""
    u = curve.points.u
    chosen = np.unique(np.linspace(0, u.shape[1] - 1, MODE_SAMPLES).round().astype(int))
    values = lowest_of_numbers(membrane, u[:, chosen], numbers)
    more = np.setdiff1d(_near_turns(chosen, values), chosen)
    if len(more):
        whole = np.concatenate([chosen, more])
        order = np.argsort(whole)
        chosen = whole[order]
        values = np.concatenate([values, lowest_of_numbers(membrane, u[:, more], numbers)])[order]
    turns = [(k, i) for k in range(len(numbers)) for i in _turns(values[:, k])]
    if not turns:
        return []
    inside = np.unique(np.concatenate([np.arange(int(chosen[i]), int(chosen[i + 1]) + 1) for _, i in turns]))
    exact = np.full((u.shape[1], len(numbers)), np.nan)
    exact[inside] = lowest_of_numbers(membrane, u[:, inside], numbers)
    found = []
    for k, i in turns:
        own = exact[chosen[i] : chosen[i + 1] + 1, k]
        found += [(_Eigenvalue(membrane, numbers[k]), int(chosen[i] + j)) for j in _turns(own)]
    return found


def _turns(values: np.ndarray) -> np.ndarray:
    """After which of the values the sign changes, where both are decided."""
    return np.flatnonzero(values[1:] * values[:-1] < 0)


def _near_turns(chosen: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The points of the mesh around samples at which an eigenvalue is nearest to zero and might cross it between samples.

    A parabola through three samples goes on by at most a share of their change.
    """
    before, here, after = (np.abs(values[k : len(values) - 2 + k]) for k in range(3))
    same = (np.sign(values[:-2]) == np.sign(values[1:-1])) & (np.sign(values[2:]) == np.sign(values[1:-1]))
    change = np.maximum(before, after) - here
    near = same & (here <= before) & (here <= after) & (here < NEAR_NEUTRAL * change)
    found = [np.arange(chosen[i] + 1, chosen[i + 2]) for i in np.flatnonzero(near.any(axis=1))]
    return np.unique(np.concatenate(found)) if found else np.zeros(0, int)
