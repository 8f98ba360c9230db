"""Exact boundaries between regimes: equations on the manifold of equilibria, solved by Newton between two different designs.

c(λa, q) = p(λa, q) − p_gas(V(λa, q)) is the loading condition on the chart, λs the start (V = V_0 at q = 0), and a prime
denotes the derivative by λa at fixed q. Between two designs a and b, with parameters a + s (b − a):

    start unstable            c′(λs, 0) = 0
    two folds merge           c = c′ = c″ = 0 at (λ1, q1)
    a fold at breakdown       c = c′ = 0 at (λ1, q1), q1 = q_b(λ1)
    a landing at breakdown    c = c′ = 0 at (λ1, q1), c(λ2, q1) = 0, q1 = q_b(λ2)
    a snap-back at zero       c = c′ = 0 at (λ1, 0)
    a landing leaves          c = c′ = 0 at (λ1, q1), c(λ2, q1) = 0, q1 = 0.9 q_max(λ2), the edge of the scanned window

The last lies beyond the surface's domain: its state at λ2 is computed by shooting.
"""

import dataclasses

import numpy as np

from ..diagram import landings_on, loading_arrays
from ..model import SCANNED_LOAD, SNAPPING, Regime, Scene
from ..surface import Surface
from .conditions import FarStates, System, solve_on_surface
from .designs import Designs, designs_of
from .resolution import FAR_STEPS, LANES

__all__ = [
    "FOLD_BREAKS",
    "LANDING_BREAKS",
    "LANDING_LOST",
    "MERGING",
    "REST",
    "START",
    "completed",
    "guesses",
    "has_event",
    "kind_between",
    "located",
    "with_landing",
]

START, MERGING, FOLD_BREAKS, LANDING_BREAKS, REST, LANDING_LOST = (
    "start unstable",
    "two folds merge",
    "fold at breakdown",
    "landing at breakdown",
    "snap-back at zero voltage",
    "landing leaves the window",
)


def kind_between(one: Regime, other: Regime) -> str | None:
    """The equations that hold on the boundary between two regimes; None if no such equations are known."""
    pair = {Regime(one), Regime(other)}
    if pair & {Regime.undetermined, Regime.not_decided}:
        return None
    if Regime.start_unstable in pair:
        return START
    if Regime.no_snap in pair:
        # snaps begin small: next to another regime the grid has missed a narrow one
        return MERGING if pair & {Regime.returns, Regime.breaks_before_snap} else None
    if Regime.breaks_before_snap in pair:
        return FOLD_BREAKS
    if pair == {Regime.stays, Regime.returns}:
        return REST
    if Regime.breaks_in_snap in pair:
        return LANDING_LOST if Regime.no_landing in pair else LANDING_BREAKS
    return None


def has_event(kind: str, regime: np.ndarray) -> np.ndarray:
    """Which designs have the event that ends at a boundary of this kind."""
    snaps = np.isin(regime, [int(r) for r in SNAPPING])
    if kind == START:
        return regime != Regime.start_unstable
    if kind == REST:
        return regime == Regime.returns
    if kind in (MERGING, FOLD_BREAKS):
        return snaps | (regime == Regime.breaks_before_snap)
    if kind == LANDING_LOST:
        return regime == Regime.breaks_in_snap
    return snaps & ~np.isin(regime, [int(Regime.no_landing), int(Regime.breaks_in_snap)])


def guesses(kind: str, designs: Designs, which: np.ndarray) -> np.ndarray:
    """Starting values of Newton (n, unknowns without s) from the ramps of designs; NaN where these do not provide them."""
    ramps = designs.ramps
    start = ramps.start.apex_stretch[which]
    last = np.maximum(ramps.snaps[which] - 1, 0)
    snap, load = (v[which, last] for v in (ramps.snap.apex_stretch, ramps.snap.voltage_squared))
    if kind == START:
        return start[:, None]
    if kind == LANDING_LOST:
        return np.stack([start, snap, load], axis=1)
    if kind == LANDING_BREAKS:
        return np.stack([start, snap, load, ramps.landing.apex_stretch[which, last]], axis=1)
    if kind == REST:
        back = ramps.snap_back.apex_stretch[which, 0]
        return np.stack([start, back], axis=1)
    folds, at = ramps.folds.apex_stretch[which], ramps.folds.voltage_squared[which]
    # the first fold is a maximum, the next a minimum; they merge about halfway
    if kind == MERGING:
        return np.stack([start, (folds[:, 0] + folds[:, 1]) / 2, (at[:, 0] + at[:, 1]) / 2], axis=1)
    return np.stack([start, folds[:, 0], at[:, 0]], axis=1)


def with_landing(surface: Surface, scene: Scene, names: tuple, values: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Guesses (start, snap, load) of designs with λa and p of the landings, as the scan of the membrane shows them."""
    loading = designs_of(scene, dict(zip(names, values.T, strict=True))).loading
    return np.concatenate([guess, landings_on(surface, loading_arrays(loading, surface), guess[:, 1:])], axis=1)


def completed(guess: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Guesses, with missing ones replaced by that of the nearest design that has one."""
    there = np.isfinite(guess).all(axis=1)
    if there.all() or not there.any():
        return guess
    scaled = places / np.abs(places).max(axis=0)
    missing = np.flatnonzero(~there)
    distance = np.abs(scaled[missing][:, None] - scaled[there][None]).max(axis=2)
    guess = guess.copy()
    guess[missing] = guess[there][np.argmin(distance, axis=1)]
    return guess


def _start(on, u):
    return [on.filled, on.slope(0, u[0], 0.0)], []


def _rest(on, u):
    return [on.filled, on.excess(1, u[1], 0.0), on.slope(1, u[1], 0.0)], []


def _fold(on, u) -> list:
    return [on.filled, on.excess(1, u[1], u[2]), on.slope(1, u[1], u[2])]


def _merging(on, u):
    return [*_fold(on, u), on.bend(1, u[1], u[2])], []


def _fold_breaks(on, u):
    return [*_fold(on, u), on.field(u[1], u[2])], []


def _landing_breaks(on, u):
    return [*_fold(on, u), on.excess(2, u[3], u[2]), on.field(u[3], u[2])], []


def _landing_lost(on, u):
    edge = u[2] / (SCANNED_LOAD * on.membrane.largest_load(u[3])) - 1
    return [*_fold(on, u), on.excess(2, u[3], u[2]), edge], []


#: the equations of each kind, and the points at which they evaluate the surface
_EQUATIONS = {
    START: (_start, ((0, -1),)),
    REST: (_rest, ((0, -1), (1, -1))),
    MERGING: (_merging, ((0, -1), (1, 2))),
    FOLD_BREAKS: (_fold_breaks, ((0, -1), (1, 2))),
    LANDING_BREAKS: (_landing_breaks, ((0, -1), (1, 2), (3, 2))),
    LANDING_LOST: (_landing_lost, ((0, -1), (1, 2), (3, 2))),
}


def located(
    kind: str, surface: Surface, scene: Scene, names: tuple, begin, end, guess, beyond
) -> tuple[np.ndarray, np.ndarray]:
    """Where a boundary of a kind lies between designs `begin` and `end` (n, parameters): s (n,), NaN if it is not found.

    s lies in 0 … 1, or up to `beyond` (n,) outside. Also the size of the last Newton step, a measure of the error of s.
    """
    share, error = np.full(len(begin), np.nan), np.full(len(begin), np.nan)
    todo = np.flatnonzero(np.isfinite(guess).all(axis=1))
    if len(todo):
        equations, points = _EQUATIONS[kind]
        system = System(equations, points, surface, scene, names, lanes=LANES)
        unknowns, off = guess[todo], np.zeros((len(todo), 1))
        ends = begin[todo], end[todo]
        halfway = np.full((len(todo), 1), 0.5)
        if kind == LANDING_LOST:
            first, unknowns = unknowns[:, 4], unknowns[:, :4]
            for steps in FAR_STEPS:
                far = FarStates(surface.membrane, first, steps)
                at = np.append(unknowns, halfway, axis=1)
                found = solve_on_surface(dataclasses.replace(system, far=far), at, *ends, last_move=1e-9)
                unknowns, first = found.unknowns[:, :-1], far.pressure
                off, halfway = np.abs(found.unknowns[:, -1:] - halfway), found.unknowns[:, -1:]
        else:
            at = np.append(unknowns, halfway, axis=1)
            found = solve_on_surface(system, at, *ends, last_move=1e-13)
        place = found.unknowns[:, -1]
        with np.errstate(invalid="ignore"):
            good = (found.size < 1e-8) & (np.abs(place - 0.5) <= 0.5 + 1e-6 + beyond[todo])
        share[todo] = np.where(good, place, np.nan)
        error[todo] = found.size + off[:, 0]
    return share, np.where(np.isfinite(share), error, np.nan)
