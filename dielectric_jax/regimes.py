"""Regimes: what a slow ramp of the voltage does to a design, an exclusive list."""

import enum
import typing

import numpy as np

from .diagram import Diagram, voltage_volume
from .ensemble import Outcome, Ramps
from .records import SpecialPoint
from .scene import SCANNED_LOAD, Scene
from .surface import Surface

__all__ = ["REGIME_COLOURS", "SNAPPING", "Regime", "regime_of", "regime_of_diagram", "regimes_of_ramps"]


class Regime(enum.IntEnum):
    """What a slow ramp of the voltage does, up to breakdown and down from the last landing; the regimes exclude each other."""

    undetermined = 0
    start_unstable = 1
    no_snap = 2
    breaks_before_snap = 3
    no_landing = 4
    breaks_in_snap = 5
    no_unbroken_landing = 6  # one of the two before; where an engine does not tell which
    stays = 7
    returns = 8

    @property
    def words(self) -> str:
        """The name as people read it."""
        return self.name.replace("_", " ")


#: on maps: pale where nothing breaks, told apart in grey too
REGIME_COLOURS = {
    Regime.undetermined: "#FFFFFF",
    Regime.start_unstable: "#DDDDDD",
    Regime.no_snap: "#F5E9B8",
    Regime.breaks_before_snap: "#E8B8A0",
    Regime.no_landing: "#A9A9B8",
    Regime.breaks_in_snap: "#CC7A68",
    Regime.no_unbroken_landing: "#BB9290",
    Regime.stays: "#9CC7E0",
    Regime.returns: "#BFE3C5",
}
#: regimes in which the ramp snaps
SNAPPING = (Regime.no_landing, Regime.breaks_in_snap, Regime.stays, Regime.returns)


def regime_of(scene: Scene, *, surface: Surface | None = None) -> Regime:
    """The regime of one design, by its whole diagram.

    >>> from dielectric_jax import Chamber, Membrane
    >>> regime_of(Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))).name
    'stays'
    """
    return regime_of_diagram(voltage_volume(scene, surface=surface))


def regime_of_diagram(diagram: Diagram) -> Regime:
    """The regime that a voltage–volume diagram shows."""
    up = diagram.ramp()
    reason = up.area_strain_reason
    ends: dict = {
        "start_unstable": Regime.start_unstable,
        "no landing": Regime.no_landing,
        "breakdown in the snap": Regime.breaks_in_snap,
    }
    if up["landing"]:
        # branches are followed a little beyond the scanned window, as far as their errors allow
        last = up["landing"][-1].state
        limit = float(diagram.scene.membrane.largest_load(last.apex_stretch))
        if last.voltage_squared > SCANNED_LOAD * limit:
            return Regime.no_landing
    if reason in ends:
        return ends[reason]
    if not up["landing"]:
        if reason != "breakdown on the branch":
            return Regime.undetermined
        end = typing.cast(SpecialPoint, _point_of(diagram, "breakdown", up["breakdown"][0].state))
        start = typing.cast(SpecialPoint, _point_of(diagram, "zero_voltage", up["start"][0].state))
        rising = np.sign(end.position - start.position)
        ahead = [p for p in diagram.special_points if p.kind == "fold" and p.branch == end.branch]
        further = any((p.position - end.position) * rising > 0 for p in ahead)
        return Regime.breaks_before_snap if further else Regime.no_snap
    down = [e for e in diagram.events if e.direction == "down"]
    if any(e.event == "snap_back" for e in down):
        return Regime.returns
    return Regime.stays if down and down[-1].reason == "zero voltage" else Regime.undetermined


def _point_of(diagram: Diagram, kind: str, state):
    near = [p for p in diagram.special_points if p.kind == kind]
    return min(near, key=lambda p: abs(p.apex_stretch - state.apex_stretch))


def regimes_of_ramps(ramps: Ramps) -> np.ndarray:
    """The regimes that ramps on the surface tell; undetermined where they tell none."""
    outcome = np.asarray(ramps.outcome)
    survives = outcome == Outcome.breakdown_on_branch
    with np.errstate(invalid="ignore"):
        further = np.any(ramps.folds.apex_stretch > ramps.breakdown.apex_stretch[..., None], axis=-1)
    back = np.isfinite(ramps.snap_back.volume).any(axis=-1)
    cases = [
        (outcome == Outcome.start_unstable, Regime.start_unstable),
        (outcome == Outcome.breakdown_in_snap, Regime.breaks_in_snap),
        (survives & (ramps.snaps == 0) & ~further, Regime.no_snap),
        (survives & (ramps.snaps == 0) & further, Regime.breaks_before_snap),
        (survives & (ramps.snaps > 0) & ~back, Regime.stays),
        (survives & (ramps.snaps > 0) & back, Regime.returns),
    ]
    return np.select([c for c, _ in cases], [int(r) for _, r in cases], int(Regime.undetermined))
