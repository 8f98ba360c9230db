"""The regime of one scene, by its whole diagram."""

import typing
from collections.abc import Iterable

import numpy as np

from ..model import SCANNED_LOAD, FoldAhead, Outcome, PointKind, RampEvent, Regime, Scene, SpecialPoint, regimes_of
from ..surface import Surface
from .diagrams import Diagram, voltage_volume
from .mode_points import NOT_DECIDED
from .ramp import ENDS, LOSSES, NOT_LOCATED

__all__ = ["regime_of", "regime_of_diagram"]


def regime_of(scene: Scene, *, surface: Surface | None = None, modes: Iterable[int] | None = None) -> Regime:
    """The regime of one design, by its whole diagram.

    With `modes`, as in `voltage_volume`, it is `wrinkles` or `bulges` where the ramp up loses its axisymmetry.

    >>> from dielectric_jax import Chamber, Membrane
    >>> regime_of(Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))).name
    'stays'
    """
    return regime_of_diagram(voltage_volume(scene, surface=surface, modes=modes))


def regime_of_diagram(diagram: Diagram) -> Regime:
    """The regime that a voltage–volume diagram shows; `undetermined` where the window ends its ramp."""
    if (loss := diagram.area_strain_reason) in LOSSES.values():
        return Regime[str(loss)]
    if loss in (NOT_DECIDED, NOT_LOCATED):
        return Regime.not_decided
    up, down = diagram.ramp(), [e for e in diagram.events if e.direction == "down"]
    outcome = ENDS.get(up.area_strain_reason or "", Outcome.unresolved)
    if outcome == Outcome.unresolved:
        return Regime.undetermined
    back = any(e.event == RampEvent.snap_back for e in down)
    snaps = len(up["snap"])
    if (
        snaps
        and outcome == Outcome.breakdown_on_branch
        and not back
        and not (down and down[-1].reason == "zero voltage")
    ):
        return Regime.undetermined
    ahead = FoldAhead.unknown
    if not snaps and outcome == Outcome.breakdown_on_branch:
        ahead = _fold_ahead(diagram, up["start"][0].state, up["breakdown"][0].state)
    return Regime(int(regimes_of(outcome, snaps, back, ahead)))


def _fold_ahead(diagram: Diagram, start, broken) -> FoldAhead:
    """Whether the branch of the ramp has a fold beyond breakdown that it reaches within the scanned window."""
    end = typing.cast(SpecialPoint, _point_of(diagram, "breakdown", broken))
    begin = typing.cast(SpecialPoint, _point_of(diagram, "zero_voltage", start))
    rising = np.sign(end.position - begin.position)
    ahead = [p for p in diagram.special_points if p.kind == PointKind.fold and p.branch == end.branch]
    ahead = [p for p in ahead if (p.position - end.position) * rising > 0]
    if not ahead:
        return FoldAhead.none
    fold = min(ahead, key=lambda p: (p.position - end.position) * rising)
    branch, largest = diagram.branches[end.branch], diagram.scene.membrane.largest_load
    # the branch between the two may leave the window and come back
    low, high = sorted((end.apex_stretch, fold.apex_stretch))
    between = (
        (branch.apex_stretch > low) & (branch.apex_stretch < high) & (branch.voltage_squared >= end.voltage_squared)
    )
    apex = np.append(branch.apex_stretch[between], fold.apex_stretch)
    load = np.append(branch.voltage_squared[between], fold.voltage_squared)
    return FoldAhead.fold if np.all(load <= SCANNED_LOAD * np.asarray(largest(apex))) else FoldAhead.none


def _point_of(diagram: Diagram, kind: str, state):
    near = [p for p in diagram.special_points if p.kind == kind]
    return min(near, key=lambda p: abs(p.apex_stretch - state.apex_stretch))
