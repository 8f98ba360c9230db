"""How a ramp ends, and the regime of a design: one list of each, and one rule that leads from the first to the second.

Every engine fills in what it knows of a ramp; what it does not know leaves the regime `not_decided`, never another regime.
"""

import numpy as np

from ..numerics import NamedCode

__all__ = ["REGIME_COLOURS", "SNAPPING", "FoldAhead", "Outcome", "Regime", "regimes_of"]


class Outcome(NamedCode):
    """How a ramp up ends, as `Ramps.outcome` holds it."""

    breakdown_on_branch = 0
    breakdown_in_snap = 1
    no_landing = 2
    start_unstable = 3
    unresolved = 4  # the engine could not determine it; `voltage_volume` can


class FoldAhead(NamedCode):
    """Whether a branch that reaches breakdown has a fold further on, in the scanned window (t ≤ 0.9)."""

    unknown = 0
    none = 1
    fold = 2


class Regime(NamedCode):
    """What a slow ramp of the voltage does, up to breakdown and down from the last landing; the regimes exclude each other.

    `undetermined` is an answer: the window ends the ramp. `not_decided` is none: the engine could not determine the regime.
    Folds and landings count where they lie in the scanned window, t ≤ 0.9.
    """

    undetermined = 0
    start_unstable = 1
    no_snap = 2
    breaks_before_snap = 3
    no_landing = 4
    breaks_in_snap = 5
    not_decided = 6
    stays = 7
    returns = 8
    wrinkles = 9  # these two only where modes are asked for
    bulges = 10

    @property
    def words(self) -> str:
        """The name as people read it."""
        return self.name.replace("_", " ")


#: on maps: pale where nothing breaks, distinguishable in grey too
REGIME_COLOURS = {
    Regime.undetermined: "#EEEEEE",
    Regime.start_unstable: "#DDDDDD",
    Regime.no_snap: "#F5E9B8",
    Regime.breaks_before_snap: "#E8B8A0",
    Regime.no_landing: "#A9A9B8",
    Regime.breaks_in_snap: "#CC7A68",
    Regime.not_decided: "#FFFFFF",
    Regime.stays: "#9CC7E0",
    Regime.returns: "#BFE3C5",
    Regime.wrinkles: "#D9C7E8",
    Regime.bulges: "#B39CD0",
}
#: regimes in which the ramp snaps
SNAPPING = (Regime.no_landing, Regime.breaks_in_snap, Regime.stays, Regime.returns)


def regimes_of(outcome, snaps, snaps_back, ahead) -> np.ndarray:
    """The regime of every ramp, `Regime` as numbers: arrays of one shape.

    `outcome` is an `Outcome`, `snaps` counts the snaps of the way up, `snaps_back` says whether the way down from the last
    landing snaps back, `ahead` is a `FoldAhead`, which matters where the way up ends on its first branch.
    """
    outcome, snaps, ahead = np.asarray(outcome), np.asarray(snaps), np.asarray(ahead)
    on_branch = outcome == Outcome.breakdown_on_branch
    before = on_branch & (snaps == 0)
    cases = [
        (outcome == Outcome.start_unstable, Regime.start_unstable),
        (outcome == Outcome.no_landing, Regime.no_landing),
        (outcome == Outcome.breakdown_in_snap, Regime.breaks_in_snap),
        (before & (ahead == FoldAhead.none), Regime.no_snap),
        (before & (ahead == FoldAhead.fold), Regime.breaks_before_snap),
        (on_branch & (snaps > 0) & ~np.asarray(snaps_back), Regime.stays),
        (on_branch & (snaps > 0) & np.asarray(snaps_back), Regime.returns),
    ]
    return np.select([c for c, _ in cases], [int(r) for _, r in cases], int(Regime.not_decided)).astype("int8")
