"""Following folds and breakdown as a parameter changes: pseudo-arclength continuation in (λa, p, q, θ), see `two_parameters`.

Steps are those of `numerics.continuation`, which is given the equations' value and Jacobian; each new point is then corrected on
a finer grid, and searched for what lies between it and the last.
"""

import functools
import math
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from ..diagram import hermite
from ..model import (
    SCALE,
    Chamber,
    ConstantPressure,
    ConstantVoltage,
    PointKind,
    Scene,
    difficulty,
    field_ratio_squared,
    largest_load,
    locking_stretch,
)
from ..numerics import Code, Problem, SceneError, Walk, begin, cached_jit, shorter, stepped
from .critical_points import Found, find, start_of
from .fixed_load import zero_states
from .point_systems import Conditions, Solution, linearised
from .resolution import (
    AGREED,
    CURVE_STEPS,
    GRIDS,
    LARGEST_LOAD,
    LEAP,
    LEAST_ERROR_ON_CURVE,
    LOG_FROM,
    ON_LEVEL,
    OVER_CORNER,
    ROOT,
    SAFETY,
    SETTLED,
)
from .rim import ShotRim
from .searches import filling_state

__all__ = ["ConditionsOver", "Followed", "Lost", "Place", "System", "follow"]


class Place(typing.NamedTuple):
    """A point of a curve: scaled unknowns, unit tangent, V, E/E_EB, t = q/q_max(λa), and the error of the located quantity.

    `filling` is λa of the state that fills the chamber.
    """

    z: np.ndarray
    tangent: np.ndarray
    volume: float
    ratio: float
    fraction: float
    error: float
    filling: float


class Lost(RuntimeError):
    """Newton has not converged to the curve."""


class _NoFilling(Lost):
    """No state near the last one fills the chamber."""


@functools.cache
def _conditions_program(name: str) -> Callable:
    """`_conditions_at` of a parameter, as a compiled program."""

    def conditions_at(scene, start, value):
        return _conditions_at(name, scene, start, value)

    return cached_jit(conditions_at)


def _conditions_at(name: str, scene: Scene, start: Found | None, value):
    """θ at a value of a parameter, from the state that fills the chamber there, and its derivative by the parameter."""

    def conditions(value):
        own = scene.with_values(**{name: value})
        if isinstance(own.loading, ConstantVoltage):
            load = jnp.asarray(own.loading.voltage, float) ** 2
            return _floats(Conditions(own.membrane, own.loading.condition(), load))
        if start is not None:
            return _floats(start_of(own, start, None)[1])
        return _floats(Conditions(own.membrane, own.loading.condition()))

    return jax.jvp(conditions, (value,), (jnp.ones_like(value),))


class ConditionsOver:
    """θ, the parameters of the equations, of a scene as a function of one scene parameter, and its derivative."""

    def __init__(self, scene: Scene, name: str):
        self.scene, self.name = scene, name
        path = scene.path_of(name)
        own = scene.loading
        self.filled = isinstance(own, Chamber)
        still = path[0] == "loading" and not name.startswith("initial")
        self.moves = not (still or path[:2] == ("membrane", "breakdown"))
        self.start: Found | None = None
        self.value = math.nan
        self._known: dict = {}
        self._fillings: dict[float, Found] = {}

    def begin_anew(self) -> None:
        """Discards the last filling, which may be on another branch; a filling that does not depend on the parameter stays."""
        if self.moves:
            self.start, self._known = None, {}

    @property
    def filling(self) -> float:
        """λa of the state that fills the chamber, NaN without one."""
        return math.nan if self.start is None else float(self.start.state.apex_stretch)

    def check_filling(self) -> None:
        """Raises if the followed state no longer fills the chamber: of several states at p_0 the one of smallest volume does."""
        if self.start is None or not self.moves:
            return
        scene = self.scene.with_values(**{self.name: self.value})
        target = typing.cast(Chamber, scene.loading).initial_pressure
        if target is None:
            return
        smallest = zero_states(scene.membrane, ConstantPressure(float(target)).condition())
        if not (smallest and abs(smallest[0][0] - self.filling) < 1e-6):
            self.begin_anew()
            raise _NoFilling

    def at(self, value: float, steps: float):
        """θ and dθ as (leaves that change, their rates).

        The filling is computed by shots with the same number of steps, so that Newton's steps from grid to grid include its
        discretisation error.
        """
        if self.value != value:
            self.value, self._known = value, {}
        if steps not in self._known:
            self._known[steps] = self._at(float(value), steps)
        return self._known[steps]

    def _at(self, value: float, steps: float):
        start = self._filled(value, steps) if self.filled else None
        theta, rate = _conditions_program(self.name)(self.scene, start, value)
        rates = [np.ravel(np.asarray(r)) for r in jax.tree.leaves(rate)]
        moving = tuple(k for k, r in enumerate(rates) if np.any(r != 0))
        return theta, moving, np.concatenate([rates[k] for k in moving]) if moving else np.zeros(0)

    def _filled(self, value: float, steps: float) -> Found:
        """The state that fills the chamber, found from the last one."""
        if not self.moves and steps in self._fillings:
            return self._fillings[steps]
        scene = self.scene.with_values(**{self.name: value})
        loading = typing.cast(Chamber, scene.loading)
        by_volume = loading.initial_volume is not None
        kind, target = (
            (PointKind.volume, loading.initial_volume) if by_volume else (PointKind.pressure, loading.initial_pressure)
        )
        held = _floats(Conditions(scene.membrane, ConstantVoltage(0.0).condition(), target))
        state = None if self.start is None else _settled(kind, self.start.state, held, steps)
        if state is None:
            self.start = _fill(scene)
            state = _settled(kind, self.start.state, held, steps)
        if self.start is None or state is None:
            raise _NoFilling
        self.start = self._fillings[steps] = self.start._replace(state=state)
        return self.start


def _settled(kind: PointKind, last: Solution, held: Conditions, steps: float) -> Solution | None:
    """The state of a kind near the last one, by shots of so many steps; None if Newton does not converge."""
    u, engine = np.array([float(v) for v in last[:3]]), ShotRim(np.asarray(steps))
    for _ in range(8):
        value, by_u = (np.asarray(v) for v in linearised(kind, (), engine, u, held)[:2])
        move = -np.linalg.solve(by_u[:3], value[:3])
        u, size = u + move, float(np.abs(move / SCALE).max())
        if not size < 0.5:
            return None
        if size < 1e-8:
            apex, pressure, load, volume = (jnp.asarray(float(v)) for v in (*u, value[-1] + by_u[-1] @ move))
            return Solution(apex, pressure, load, volume)
    return None


def _fill(scene: Scene) -> Found:
    """The state that fills a chamber at zero voltage."""
    found = find(("start",), scene, None, filling_state)["start"]
    if not np.isfinite(float(found.state.apex_stretch)):
        raise _NoFilling
    return found


def _floats(theta: Conditions) -> Conditions:
    """The same conditions with arrays for leaves, so that compiled programs are shared."""
    return jax.tree.map(lambda v: jnp.asarray(v, float), theta)


class System:
    """The equations of a kind of curve in scaled unknowns z = (λa, p, q, w), with w the parameter scaled to its bounds."""

    def __init__(self, kind: PointKind, conditions: ConditionsOver, within: tuple[float, float]):
        self.kind, self.conditions, self.within = kind, conditions, within
        self.logarithmic = within[0] > 0 and within[1] / within[0] > LOG_FROM
        self.control = 1 if kind == PointKind.pressure_fold else 2
        self.membrane = conditions.scene.membrane

    def value(self, w: float) -> float:
        low, high = self.within
        return float(low * (high / low) ** w if self.logarithmic else low + w * (high - low))

    def rate(self, w: float) -> float:
        low, high = self.within
        return self.value(w) * math.log(high / low) if self.logarithmic else high - low

    def linear(self, z: np.ndarray, steps: float):
        """F (3,), its Jacobian (3, 4) by z, with rows scaled, and V with its slopes (4,)."""
        theta, moving, rates = self.conditions.at(self.value(z[3]), steps)
        self.membrane = theta.membrane
        value, by_u, by_theta = linearised(self.kind, moving, ShotRim(np.asarray(steps)), z[:3] * SCALE, theta)
        value, by_u, by_theta = (np.asarray(v) for v in (value, by_u, by_theta))
        along = by_theta @ rates * self.rate(z[3]) if moving else np.zeros(len(value))
        *jacobian, slopes = np.concatenate([by_u * SCALE, along[:, None]], axis=1)
        size = np.abs(jacobian).max(axis=1)
        return value[:3] / size, jacobian / size[:, None], (float(value[3]), slopes)

    def _fraction(self, u) -> float:
        return float(u[2] / largest_load(self.membrane.material, u[:1])[0])

    def grids(self, z: np.ndarray, finer: int = 0) -> tuple:
        """The pairs of grids that resolve the membrane at z, the next ones for `finer`."""
        u = z[:3] * SCALE
        hard = int(difficulty(locking_stretch(self.membrane), u[:1], np.array([self._fraction(u)]))[0])
        return GRIDS[min(hard + finer, 2) :]

    def correct(self, z: np.ndarray, row: np.ndarray, towards, reach=0.3, finer=0, known=0.0) -> Place:
        """The point of the curve near z in the plane through it normal to `row`; its tangent points `towards`. Raises Lost.

        The tangent is the one before Newton's last step. `finer` moves on to finer grids, which make that step smaller.
        On the grid of `known` steps z is the point.
        """
        start, row = z, row / float(np.linalg.norm(row))
        target = float(row @ z)
        for coarse, fine in self.grids(z, finer):
            size = 0.0 if coarse == known else math.inf
            for steps in (*[coarse] * 7, fine):
                if steps == coarse and size < SETTLED:
                    continue
                if not (np.isfinite(z).all() and z[0] * SCALE[0] > 1.0 and np.abs(z - start).max() < reach):
                    raise Lost
                value, jacobian, (volume, slopes) = self.linear(z, steps)
                try:
                    move = np.linalg.solve(np.vstack([jacobian, row]), -np.append(value, row @ z - target))
                    tangent = np.linalg.svd(jacobian)[2][3]
                except np.linalg.LinAlgError:
                    raise Lost from None
                z, volume, size = z + move, volume + float(slopes @ move), float(np.abs(move).max())
            if size < AGREED:  # the finer grid shows the remaining Newton step and the error of the coarser grid
                # what the finer grid leaves is smaller by the order of the method, eight
                gain = min(SAFETY, (fine / coarse) ** 8 - 1)
                return self._place(z, tangent * (-1.0 if tangent @ towards < 0 else 1.0), volume, move / gain)
        raise Lost

    def relative(self, z: np.ndarray, move: np.ndarray) -> float:
        """The relative change of the control or of the parameter for a step of z, whichever is larger."""
        k = self.control
        of_control = abs(move[k]) * SCALE[k] / max(abs(z[k] * SCALE[k]), 1e-3)
        return max(of_control, abs(move[3] * self.rate(z[3]) / self.value(z[3])))

    def _place(self, z, tangent, volume: float, change) -> Place:
        """A point of the curve; `change` is the error that is left of z."""
        self.conditions.check_filling()
        u = z[:3] * SCALE
        error = self.relative(z, change) + LEAST_ERROR_ON_CURVE
        ratio = float(field_ratio_squared(self.membrane.breakdown, u[0], u[0]) * u[2])
        return Place(z, tangent, volume, math.sqrt(max(ratio, 0.0)), self._fraction(u), error, self.conditions.filling)


def _between(system: System, one: Place, other: Place, function: typing.Any) -> Place:
    """The point between two points of a curve at which a function of a place vanishes.

    A pair (unknown, value) stands for the level of one unknown, which is reached by Newton; other functions are solved by
    Brent's method.
    """
    if isinstance(function, tuple):
        column, level = function
        share = (level - one.z[column]) / (other.z[column] - one.z[column])
        guess = one.z + share * (other.z - one.z)
        guess[column] = level
        return system.correct(guess, np.eye(4)[column], one.tangent, 2.0)
    chord = other.z - one.z
    slopes = [p.tangent * (chord @ chord / (p.tangent @ chord)) for p in (one, other)]
    known = {0.0: one, 1.0: other}

    def value(s: float) -> float:
        if s not in known:
            guess = hermite(one.z, other.z, slopes[0], slopes[1], 1.0, s)
            known[s] = system.correct(guess, chord, one.tangent, finer=1)
        return float(function(known[s]))

    s = float(brentq(value, 0.0, 1.0, xtol=ROOT))  # pyright: ignore[reportArgumentType]
    value(s)
    return known[s]._replace(error=known[s].error + system.relative(known[s].z, ROOT * chord))


class Followed(typing.NamedTuple):
    """A curve: its places in order, why it ends on either side, places at levels of the parameter, and special points by kind."""

    places: list[Place]
    ends: tuple[str, str]
    crossings: list[tuple[int, Place]]
    points: list[tuple[str, Place]]


def follow(system: System, start: Place, levels: np.ndarray, largest_ratio: float) -> Followed:
    """The curve through `start` in both directions, with exact places where w takes one of `levels`."""
    ahead, end, crossed, special = _one_way(system, start, 1.0, levels, largest_ratio)
    if end == "closed":
        return Followed(ahead, (end, end), crossed, special)
    behind, begin, more, others = _one_way(system, start, -1.0, levels, largest_ratio)
    return Followed([*reversed(behind[1:]), *ahead], (begin, end), crossed + more, special + others)


#: walks in scaled unknowns, which end outside the parameter's bounds
_WALKS = Problem(
    None,
    np.ones(4),
    lambda z, args: jnp.stack([z[3] + ON_LEVEL, 1 + ON_LEVEL - z[3]]),
    (Code.window_load, Code.window_load),
    steps=CURVE_STEPS,
)


@cached_jit
def _step_program(walk, value, jacobian):
    """One pass of a walk, and whether it arrives at a point."""
    walk, accept = stepped(_WALKS, Walk(*walk), value, jacobian)
    return tuple(walk), accept


def _begun(place: Place) -> Walk:
    """A walk that stands on a place, which is corrected already, and heads along its tangent."""
    walk = begin(_WALKS, place.z, place.tangent)
    # `shorter` halves the step
    walk = shorter(walk._replace(count=walk.count + 1, step=jnp.asarray(2 * CURVE_STEPS.first)))
    return jax.tree.map(np.asarray, walk)


def _one_way(system: System, start: Place, sense: float, levels: np.ndarray, largest_ratio: float):
    """The places from `start` on, why the curve ends, the crossings and the special points."""
    places, crossings, points = [start._replace(tangent=sense * start.tangent)], [], []
    walk, lost = _begun(places[0]), "step_too_small"
    while True:
        here, before = places[-1], walk
        passed = None
        try:
            walk, there, end = _ahead(system, here, before)
            if there is not None:
                passed = _passed(system, here, there, levels, largest_ratio, end)
            elif end:
                return places, end, crossings, points
        except (Lost, SceneError, ValueError) as error:  # the curve or scene does not exist there: a shorter step
            walk = _retreat(before)
            lost = "no_filling" if isinstance(error, _NoFilling) else "step_too_small"
        if passed is not None:
            more, crossed, special, end = passed
            places += more
            crossings += crossed
            points += special
            if walk.code == Code.closed:
                places[-1] = places[0]
            if end or walk.code != Code.ok:
                return places, end or Code(int(walk.code)).name, crossings, points
            lost = "step_too_small"
        elif walk.code == Code.step_too_small:
            cornered = system.kind == PointKind.breakdown and walk.count > 1 and before.code == Code.ok
            if not cornered or lost == "no_filling":
                leapt = abs(system.conditions.filling - here.filling) > LEAP
                return places, "no_filling" if leapt else lost, crossings, points
        elif walk.step < before.step:
            system.conditions.begin_anew()


def _retreat(walk: Walk) -> Walk:
    """The walk with half its step, ended if that is too small."""
    walk = shorter(walk)
    code = Code.step_too_small if walk.step < CURVE_STEPS.smallest else Code.ok
    return walk._replace(code=jnp.asarray(int(code)))


def _ahead(system: System, here: Place, walk: Walk) -> tuple[Walk, Place | None, str]:
    """The walk one pass further, the place it arrives at, if any, and the bound that the curve ends at, if it is reached."""
    if walk.code == Code.step_too_small:  # a breakdown law may have a kink, and its curve a corner: over it
        there = system.correct(here.z + OVER_CORNER * here.tangent, here.tangent, here.tangent, 4 * OVER_CORNER)
        return _begun(there)._replace(origin=walk.origin, heading=walk.heading), there, ""
    if not 0 <= walk.trial[3] <= 1:
        return walk, *_to_bound(system, here, np.asarray(walk.trial), 2 * float(walk.step))
    steps = system.grids(here.z)[0][0]
    value, jacobian, _ = system.linear(np.asarray(walk.trial), steps)
    after, accept = _step_program(tuple(walk), value, jacobian)
    after = Walk(*jax.tree.map(np.asarray, after))
    if not accept:
        return after, None, ""
    near, reach = np.asarray(after.base), 2 * float(walk.step)
    if after.code == Code.window_load:
        return walk, *_to_bound(system, here, near, reach)
    return after, system.correct(near, here.tangent, here.tangent, reach, known=steps), ""


def _to_bound(system: System, here: Place, outside: np.ndarray, reach: float) -> tuple[Place | None, str]:
    """The place at the bound of the parameter on the way to a point outside it; None if the curve is there already."""
    end, bound = ("lower_bound", 0.0) if outside[3] < 0 else ("upper_bound", 1.0)
    if abs(here.z[3] - bound) < ON_LEVEL:
        return None, end
    guess = here.z + (outside - here.z) * (bound - here.z[3]) / (outside[3] - here.z[3])
    guess[3] = bound
    return system.correct(guess, np.eye(4)[3], here.tangent, reach), end


def _passed(system: System, here: Place, there: Place, levels: np.ndarray, largest_ratio: float, end: str):
    """The places between two, and the second, in order; crossings, special points, and why the curve ends there, if it does."""
    control = system.control
    found: list[Place] = []
    crossings: list[tuple[int, Place]] = []
    points: list[tuple[str, Place]] = []
    # the end of the curve comes first: nothing beyond it is reported
    for reason, function in (
        ("zero_voltage", lambda p: p.z[2]),
        ("largest_ratio", lambda p: largest_ratio - p.ratio),
        ("largest_load", lambda p: LARGEST_LOAD - p.fraction),
    ):
        if system.kind == PointKind.pressure_fold and reason == "zero_voltage":
            continue
        if function(there) < 0 and function(here) < ON_LEVEL:
            return [], [], [], reason
        if function(there) < 0:
            level = (2, 0.0) if reason == "zero_voltage" else function
            there, end = _between(system, here, there, level), reason
    for i, w in enumerate(levels):
        before, after = here.z[3] - w, there.z[3] - w
        if abs(after) < ON_LEVEL or (before * after < 0 and abs(before) > ON_LEVEL):
            place = there if abs(after) < ON_LEVEL else _between(system, here, there, (3, w))
            found.append(place)
            crossings.append((i, place))
    if system.kind != PointKind.breakdown:
        if here.tangent[3] * there.tangent[3] < 0:
            both = here.tangent[control] * there.tangent[control] < 0
            points.append(("cusp" if both else "merger", _between(system, here, there, lambda p: p.tangent[3])))
        if (here.ratio < 1) != (there.ratio < 1):
            points.append(("fold_at_breakdown", _between(system, here, there, lambda p: p.ratio - 1)))
        if end == "zero_voltage":
            points.append((end, there))
    chord = there.z - here.z
    found += [place for _, place in points]
    found = [place for place in found if place is not there]
    return [*sorted(found, key=lambda p: float((p.z - here.z) @ chord)), there], crossings, points, end
