"""A scene's branches as they were solved, and the states at one control that its ramps ask for."""

import dataclasses

import numpy as np

from ..model import Shooting, SpecialPoint, State
from .events import FOLDS, brackets
from .mesh import Curve
from .special_points import Located, loads_beside_folds, locate
from .states import states_of
from .surface_contours import OnSurface

__all__ = ["Solved", "special_record"]


def special_record(located: Located, tolerance: float) -> SpecialPoint:
    """The record of a located point."""
    state = states_of(located.point, tolerance)[0]
    kind = "fold" if located.kind in FOLDS else located.kind
    values = {f: getattr(state, f) for f in State.__dataclass_fields__}
    values["index"] = None if kind == "fold" else state.index
    values["error_estimate"] = located.error
    if kind == "zero_voltage":
        values |= {"voltage_squared": 0.0, "charge": 0.0, "breakdown_ratio": 0.0}
    values["flags"] = tuple(f for f in state.flags if f != "error_above_tolerance")
    values["flags"] += ("error_above_tolerance",) if not located.error <= tolerance else ()
    return SpecialPoint(**values, kind=kind, branch=located.branch, position=located.position)


@dataclasses.dataclass
class Solved:
    """What ramps need of a scene: the engine, exact branches, located points."""

    solver: Shooting | OnSurface
    curves: list[Curve]
    located: list[Located]
    missed: list[tuple]
    tolerance: float
    certify: bool = True

    @property
    def control(self) -> int:
        """The column of the control, see `Points.control`."""
        return self.solver.contour.control

    @property
    def fold_kind(self) -> str:
        """The event at which the control turns."""
        return next(kind for kind, column in FOLDS.items() if column == self.control)

    def control_at(self, located: Located) -> float:
        """The control, squared, of a located state: q, or Q² where the charge is controlled."""
        return float(located.point.control(self.control)[0])

    def place(self, located: Located) -> float:
        """By what states at one control are told apart: the volume, or the apex stretch where the volume is held."""
        return float(located.point.place(self.solver.contour)[0])

    def states_at(self, squared: float) -> list[Located]:
        """All states at one value of the control, q or Q², on all branches."""
        kind = "charge" if self.control == 3 else "load"
        wanted = [
            (kind, b, int(i), squared) for b, curve in enumerate(self.curves) for i in brackets(curve, kind, squared)
        ]
        found, missed = locate(self.solver, self.curves, wanted, self.tolerance, certify=self.certify)
        beside = (self.solver, self.curves, self.located, kind, squared, self.tolerance)
        more, lost = loads_beside_folds(*beside, certify=self.certify)
        self.missed.extend(missed + lost)
        return found + more

    def start_beside_fold(self, volume: float) -> Located | None:
        """The start of a chamber of this volume at zero voltage where it is nearer to a fold than the fold's own error.

        Its index tells on which side it lies.
        """
        near = [p for p in self.located if p.kind == self.fold_kind and abs(float(p.point.u[2, 0])) < 1e-9]
        fold = min(near, key=lambda p: abs(p.point.volume[0] - volume), default=None)
        if fold is None:
            return None
        engine = self.solver.shooting if isinstance(self.solver, OnSurface) else self.solver
        row = np.full((1, 3), np.nan)
        point = engine.polish(fold.point.u, row, np.array([volume]), tolerance=self.tolerance, reach=0.1)
        if not (point.ok[0] and abs(point.u[2, 0]) < 1e-9):
            return None
        curve = self.curves[fold.branch]
        i = int(np.clip(np.searchsorted(curve.position, fold.position), 1, len(curve.position) - 1))
        side = 1.0 if curve.points.index[i - 1] == 0 else -1.0  # along which the stable states come to the fold
        point.tangent[0, 2] = side * abs(point.tangent[0, 2])
        position = fold.position - 1e-6 * side
        return Located("zero_voltage", fold.branch, position, point, float(point.error[0]))

    def state(self, located: Located) -> State:
        """The record of a located state."""
        return special_record(located, self.tolerance)
