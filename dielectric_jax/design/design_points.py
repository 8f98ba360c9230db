"""The events of a ramp on the sheet as functions of a design, with their derivatives by the implicit function theorem.

Unknowns of a ramp with n snaps: the start λs, for each snap its fold (λ1, q1) and landing λ2, breakdown λb, and where the way
down is asked about the fold (λf, qf) that a snap-back leaves from. They solve F(u; θ) = 0, so that du/dθ = −F_u⁻¹ F_θ.
"""

import functools
import typing

import jax.numpy as jnp
import numpy as np

from ..diagram import Ramps
from ..model import Scene
from .conditions import System, solve_on_surface

__all__ = ["Kind", "Measures", "begin_of", "measure"]


class Kind(typing.NamedTuple):
    """The shape of a ramp: how many snaps, and whether the way down has a fold that is asked about."""

    snaps: int
    back: bool


class Measures(typing.NamedTuple):
    """What an optimisation asks of designs: numbers (n,) and their derivatives (n, parameters), in pairs.

    `growth` is 2 log(λb/λs); `start` the slope c′ at the start, positive where it is stable; for each snap `fold`, log (E/E_EB)²
    at it, `landing`, the same where it lands, `sharpness`, −c″ at it, zero where it merges with another; `back` the q of the
    snap-back. `rates` are the derivatives of the `unknowns`.
    """

    names: tuple
    values: np.ndarray
    slopes: np.ndarray
    unknowns: np.ndarray
    rates: np.ndarray
    fair: np.ndarray


def measures_of(kind: Kind) -> tuple:
    """The names of the measures of ramps of a kind."""
    names = ["growth", "start"]
    for k in range(kind.snaps):
        names += [f"fold_{k}", f"landing_{k}", f"sharpness_{k}"]
    return (*names, "back") if kind.back else tuple(names)


def begin_of(kind: Kind, ramps: Ramps, which: np.ndarray) -> np.ndarray:
    """The unknowns (n, …) from ramps; NaN where a ramp is of another kind."""
    columns = [ramps.start.apex_stretch[which]]
    for k in range(kind.snaps):
        snap = ramps.snap
        columns += [snap.apex_stretch[which, k], snap.voltage[which, k] ** 2, ramps.landing.apex_stretch[which, k]]
    broken = ramps.breakdown.apex_stretch[which]
    last = ramps.landing.apex_stretch[which, kind.snaps - 1] if kind.snaps else broken
    columns.append(np.where(np.isfinite(broken), broken, last))
    columns.append(np.nan_to_num(ramps.breakdown.voltage[which] ** 2, nan=0.01))
    if kind.back:
        # the last minimum of q below the landing, also where q is negative there
        folds, volume = ramps.folds.apex_stretch[which], ramps.folds.voltage[which] ** 2
        below = np.where(folds < columns[3 * kind.snaps][:, None], folds, -np.inf)
        place = np.argmax(below, axis=1)
        rows = np.arange(len(place))
        columns += [np.where(np.isfinite(below[rows, place]), folds[rows, place], np.nan)]
        columns += [np.nan_to_num(volume[rows, place], nan=-1e-3)]
    return np.stack(columns, axis=1)


def _points(kind: Kind) -> tuple:
    """The points of the sheet that the equations read."""
    points: list = [(0, -1)]
    for k in range(kind.snaps):
        points += [(1 + 3 * k, 2 + 3 * k), (3 + 3 * k, 2 + 3 * k)]
    end = 1 + 3 * kind.snaps
    points.append((end, end + 1))
    return (*points, (end + 2, end + 3)) if kind.back else tuple(points)


def _equations(kind: Kind, on, u):
    end = 1 + 3 * kind.snaps
    rows = [on.filled]
    measured = [2 * jnp.log(u[end] / u[0]), on.slope(0, u[0], 0.0)]
    for k in range(kind.snaps):
        fold, q, landing = u[1 + 3 * k], u[2 + 3 * k], u[3 + 3 * k]
        rows += [on.excess(1 + 2 * k, fold, q), on.slope(1 + 2 * k, fold, q), on.excess(2 + 2 * k, landing, q)]
        measured += [on.field(fold, q), on.field(landing, q), -on.bend(1 + 2 * k, fold, q)]
    last = 1 + 2 * kind.snaps
    rows += [on.excess(last, u[end], u[end + 1]), on.field(u[end], u[end + 1])]
    if kind.back:
        rows += [on.excess(last + 1, u[end + 2], u[end + 3]), on.slope(last + 1, u[end + 2], u[end + 3])]
        measured.append(u[end + 3])
    return rows, measured


_EQUATIONS = {
    Kind(snaps, back): functools.partial(_equations, Kind(snaps, back)) for snaps in (0, 1, 2) for back in (False, True)
}


def measure(kind: Kind, names: tuple, surface, scene: Scene, theta, guess) -> Measures:
    """Measures of designs θ (n, parameters) from guesses of their unknowns (n, …); `fair` says where Newton converged."""
    theta, guess = np.atleast_2d(theta), np.atleast_2d(guess)
    found = solve_on_surface(System(_EQUATIONS[kind], _points(kind), surface, scene, names), guess, theta)
    with np.errstate(invalid="ignore"):
        fair = (found.size < 1e-8) & np.isfinite(found.slopes).all(axis=(1, 2))
    return Measures(measures_of(kind), found.measures, found.slopes, found.unknowns, found.rates, fair)
