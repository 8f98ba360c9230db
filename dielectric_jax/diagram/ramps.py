"""Ramps of many loadings as arrays: their states, the events of each in fixed slots, and the special points listed."""

import typing
from collections.abc import Callable

import numpy as np

from ..model import Outcome, regimes_of

__all__ = [
    "APEX",
    "ERROR",
    "LISTED",
    "LOAD",
    "PRESSURE",
    "SLOTS",
    "VOLUME",
    "RampArrays",
    "Ramps",
    "Slot",
    "States",
    "ramps_of",
]


class States(typing.NamedTuple):
    """States of many loadings, arrays of one shape; NaN where there is none.

    Where they are rows of one array, this is the order of its columns (`APEX`, …): the unknowns (λa, p, q) of the
    equations first. `error` bounds the relative error |error|/max(|value|, 1e-3) of volume and q; beside NaN it stands for
    a point that exists but was not located.
    """

    apex_stretch: np.ndarray
    pressure: np.ndarray
    voltage_squared: np.ndarray
    volume: np.ndarray
    error: np.ndarray

    @property
    def voltage(self) -> np.ndarray:
        """Φ = √q; NaN where q < 0."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.voltage_squared)


APEX, PRESSURE, LOAD, VOLUME, ERROR = range(5)


class Slot:
    """Where the events of a ramp stand along an axis of length `SLOTS`: at most two snaps on the way up and two down."""

    start = 0
    snaps = slice(1, 3)
    landings = slice(3, 5)
    breakdown = 5
    snap_backs = slice(6, 8)
    landings_back = slice(8, 10)
    rest = 10


SLOTS = 11
LISTED = {"folds": 6, "zero_voltage": 5, "breakdowns": 3}  # special points of a branch, at most


class RampArrays(typing.NamedTuple):
    """Ramps as an engine leaves them: columns as in `States`, `events` (scenes, 5, `SLOTS`), special points (scenes, 5, count).

    `reach` (scenes, 2) are the λa between which all special points of the branch are listed.
    """

    events: np.ndarray
    folds: np.ndarray
    zeros: np.ndarray
    breaks: np.ndarray
    snaps: np.ndarray
    outcome: np.ndarray
    reach: np.ndarray
    ahead: np.ndarray


class Ramps(typing.NamedTuple):
    """Ramps of many loadings; NaN where there is no such event.

    The arrays have the shape of the loadings; `snap`, `landing`, `snap_back` and `landing_back` have one more axis at the
    end, of length two, for ramps that snap twice.

    The way up: `start`, `snaps` snaps with their landings (`landing_ratio` is E/E_EB there; if it is at least 1 the ramp
    ends in it), and `breakdown` on the branch. `area_strain` is (λa at breakdown / λa at the start)² − 1; with breakdown in
    the snap, that of the last unbroken state. The way down from the last landing: `snap_back`, `landing_back`, and `rest`,
    the zero-voltage state in which it ends. `error` bounds the relative error of q and of the volumes of the ramp.

    Special points of the branch through the start, by rising λa along a last axis: `folds` (of q, six), `zero_voltage`
    (five), `breakdowns` (three); all there are between the two λa of `reach` (…, 2), where the surface holds the branch alone.
    `outcome` holds an `Outcome` for each ramp, `ahead` a `FoldAhead`: whether a branch that breaks down has a fold further on.
    """

    start: States
    snap: States
    landing: States
    landing_ratio: np.ndarray
    breakdown: States
    area_strain: np.ndarray
    snaps: np.ndarray
    snap_back: States
    landing_back: States
    rest: States
    folds: States
    zero_voltage: States
    breakdowns: States
    reach: np.ndarray
    outcome: np.ndarray
    error: np.ndarray
    ahead: np.ndarray

    @property
    def regime(self) -> np.ndarray:
        """The `Regime` of every ramp as numbers; `not_decided` where the engine could not determine it."""
        back = np.isfinite(self.snap_back.volume).any(axis=-1)
        return regimes_of(self.outcome, self.snaps, back, self.ahead)


def ramps_of(breakdown_load: Callable, arrays: RampArrays) -> Ramps:
    """Ramps by names; `breakdown_load` gives q_b of stretches at the apex."""

    def at(which):
        return States(*np.moveaxis(arrays.events[..., which], arrays.events.ndim - 2, 0))

    landing, start, breakdown = at(Slot.landings), at(Slot.start), at(Slot.breakdown)
    snap = at(Slot.snaps).apex_stretch
    with np.errstate(invalid="ignore"):
        ratio = landing.voltage / np.sqrt(np.asarray(breakdown_load(landing.apex_stretch)))
    unbroken = np.where(np.isnan(snap[..., 1]), snap[..., 0], snap[..., 1])
    final = np.where(np.isnan(breakdown.apex_stretch), unbroken, breakdown.apex_stretch)
    worst = np.max(np.nan_to_num(arrays.events[..., ERROR, :], nan=0.0), axis=-1)
    folds, zeros, breaks = (
        States(*np.moveaxis(points, -2, 0)) for points in (arrays.folds, arrays.zeros, arrays.breaks)
    )
    return Ramps(
        start=start,
        snap=at(Slot.snaps),
        landing=landing,
        landing_ratio=ratio,
        breakdown=breakdown,
        area_strain=(final / start.apex_stretch) ** 2 - 1,
        snaps=arrays.snaps,
        snap_back=at(Slot.snap_backs),
        landing_back=at(Slot.landings_back),
        rest=at(Slot.rest),
        folds=folds,
        zero_voltage=zeros,
        breakdowns=breaks,
        reach=arrays.reach,
        outcome=arrays.outcome,
        error=np.where(arrays.outcome == Outcome.unresolved, np.nan, worst),
        ahead=arrays.ahead,
    )
