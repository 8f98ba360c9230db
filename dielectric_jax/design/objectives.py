"""Designs for any objective: a function of a scene that JAX can differentiate, of critical points or anything else."""

import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from ..model import Scene
from .constrained_search import axis_of
from .regime_maps import even
from .resolution import ACTIVE, AT_END, LOST_OBJECTIVE, OBJECTIVE_SCAN, STARTS

__all__ = ["Optimum", "maximise"]


class Optimum(typing.NamedTuple):
    """Parameters, the objective there, the names of constraints and bounds that hold with equality, and the scene."""

    parameters: dict[str, float]
    value: float
    active: tuple[str, ...]
    scene: Scene


def _climb(both: Callable, low: np.ndarray, high: np.ndarray, start: np.ndarray, limits: int, size: float) -> dict:
    """Runs SLSQP from a design: values and slopes of all designs computed, by the bytes of the design in [0, 1]; None for NaN.

    `both(x)` returns the objective and the constraints, and their derivatives; `size` is the size of the objective.
    """
    seen: dict = {}

    def at(z):
        key = z.tobytes()
        if key not in seen:
            value, slope = (np.asarray(v) for v in both(low + z * (high - low)))
            good = np.isfinite(value).all() and np.isfinite(slope).all()
            seen[key] = (value, slope * (high - low)) if good else None
        return seen[key]

    def value_of(z, rows):
        found = at(z)
        return np.full(limits + 1, -size)[rows] if found is None else found[0][rows]

    def slope_of(z, rows):
        found = at(z)
        return np.zeros((limits + 1, len(z)))[rows] if found is None else found[1][rows]

    own = {"type": "ineq", "fun": lambda z: value_of(z, slice(1, None)), "jac": lambda z: slope_of(z, slice(1, None))}
    scipy.optimize.minimize(
        lambda z: -value_of(z, 0),
        (start - low) / (high - low),
        jac=lambda z: -slope_of(z, 0),
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(low),
        constraints=[own] if limits else [],
        options={"ftol": 1e-13 * size / LOST_OBJECTIVE, "maxiter": 80},
    )
    return seen


def maximise(
    objective: Callable, scene: Scene, over: dict, *, constraints: dict[str, Callable] | None = None
) -> Optimum:
    """The design that maximises `objective(scene)`, a number, subject to every function of `constraints` being at least zero.

    The functions are differentiated by JAX; NaN means that there is no such point, and the design is discarded. SciPy's SLSQP
    starts from the best four designs of a scan of some dozen. Raises ValueError if no design of the scan has an objective. For
    the area strain `maximise_area_strain` is faster and handles the boundaries of regimes.

    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> found = maximise(lambda s: -((s.loading.volume - 700.0) ** 2), scene, {"chamber_volume": (500.0, 1000.0)})
    >>> round(found.parameters["chamber_volume"], 3), found.active
    (700.0, ())
    """
    if not over:
        raise ValueError("`over` must name at least one parameter, but is empty.")
    axes = [axis_of(name, limits, scene) for name, limits in over.items()]
    names, limits = tuple(over), list((constraints or {}).items())
    low, high = (np.array([getattr(a, side) for a in axes]) for side in ("low", "high"))

    def all_of(x):
        own = scene.with_values(**dict(zip(names, x, strict=True)))
        return jnp.stack([jnp.asarray(f(own), float) for f in (objective, *(f for _, f in limits))])

    both = jax.jit(lambda x: (all_of(x), jax.jacrev(all_of)(x)))
    count = OBJECTIVE_SCAN.get(len(axes), 4)
    ticks = [even(a.name, (a.low, a.high), count) for a in axes]
    grid = np.stack([g.ravel() for g in np.meshgrid(*ticks, indexing="ij")], axis=1)
    values = np.asarray(jax.vmap(all_of)(grid))
    known: np.ndarray = np.all(np.isfinite(values), axis=1)
    if not known.any():
        raise ValueError(
            "`objective` must be a number somewhere in these ranges, but is NaN at every design of the scan."
        )
    size = LOST_OBJECTIVE * np.abs(values[known, 0]).max() + 1.0
    # infeasible designs come after all feasible ones
    order = np.lexsort((-values[:, 0], -np.minimum(values[:, 1:].min(axis=1, initial=0.0), 0.0)))
    best: tuple | None = None
    for start in grid[[k for k in order if known[k]][:STARTS]]:
        seen = _climb(both, low, high, start, len(limits), size)
        for key, found in seen.items():
            if found is None or found[0][1:].min(initial=0.0) <= -1e-9:
                continue
            if best is None or found[0][0] > best[1][0]:
                best = np.frombuffer(key), found[0]
    if best is None:
        raise ValueError("`constraints` must be satisfied by some design in these ranges, but none was found.")
    z, value = best
    active = [name for (name, _), v in zip(limits, value[1:], strict=True) if abs(v) < ACTIVE]
    active += [f"{a.name}_lower" for a, v in zip(axes, z, strict=True) if v < AT_END]
    active += [f"{a.name}_upper" for a, v in zip(axes, z, strict=True) if v > 1 - AT_END]
    parameters = dict(zip(names, (low + z * (high - low)).tolist(), strict=True))
    return Optimum(parameters, float(value[0]), tuple(active), scene.with_values(**parameters))
