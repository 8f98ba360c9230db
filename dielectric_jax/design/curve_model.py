"""Pressures of a membrane at measured volumes or pole heights, and their exact derivatives by its constants.

The pressure at a volume is that of the equilibrium at the voltage of the point, from the explicit map: λa by Newton on
V(λa; θ) = V_i, then p(λa; θ). Its derivatives by the constants θ follow from the implicit function theorem,
dp/dθ = ∂p/∂θ − (∂p/∂λa) (∂V/∂θ)/(∂V/∂λa), with forward-mode autodiff of the map. A measured height takes the place of the volume.
"""

import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import make_interp_spline

from ..model import Membrane, explicit_map
from ..numerics import cached_jit
from .free_parameters import APPARATUS, AbstractModel
from .material_constants import as_arrays, check_membrane, constants_of, value_of, with_constants
from .resolution import ACCURATE, DENSE, FARTHEST_START, FLATTEST, MODEL_SIZES, MODEL_STEPS, MOST_LOADS, NODES, ROUNDS

__all__ = ["CurveModel", "Nodes", "equivalent_volume"]


def equivalent_volume(height):
    """The volume in A³ of a spherical cap of that height in A: how far a film with this height is inflated."""
    return np.pi / 6 * height * (3 + height**2)


def _logs(above, material, prestretch, q, steps, against: str):
    """log V (or the log of the height, as `against` says) and log p at λa = λ0 + e^above, elementwise."""
    found = explicit_map(material, prestretch + jnp.exp(above), q, prestretch, steps, outputs=against == "height")
    return jnp.stack([jnp.log(found[-1][0] if against == "height" else found[1]), jnp.log(found[0])])


@functools.cache
def _table(against: str) -> Callable:
    """The compiled table of log(λa − λ0) of nodes, and log V and log p there (2, nodes); NaN beyond the material's limits."""

    def table(membrane, q, top, steps):
        nodes = jnp.linspace(jnp.log(FLATTEST), jnp.log(top), NODES)
        apex = membrane.prestretch + jnp.exp(nodes)
        logs = _logs(nodes, membrane.material, membrane.prestretch, q, steps, against)
        return nodes, jnp.where(membrane.material.admissible(apex, apex), logs, jnp.nan)

    return cached_jit(table)


def _pressures(material, prestretch, point, near, steps, against):
    """p of the equilibria at the volumes and loads q of `point`, each (n,), where V rises with λa, and log(λa − λ0) there.

    `near` is log(λa − λ0) to start from. NaN where there is no state. Differentiable in the material's constants, the
    prestretch and q, in forward mode.
    """
    volume, q = point
    goal, frozen = jnp.log(volume), jax.lax.stop_gradient((material, prestretch, q))

    def newton(state):
        above, _, k, _ = state
        value, slope = jax.jvp(lambda x: _logs(x, *frozen, steps, against), (above,), (jnp.ones_like(above),))[:2]
        move = jnp.clip((goal - value[0]) / slope[0], -0.5, 0.5)
        return above + move, slope, k + 1, jnp.max(jnp.abs(move))

    def going(state):
        return (state[2] < ROUNDS) & ~(state[3] < 1e-7)

    begin = near, jnp.ones((2, *near.shape)), 0, jnp.asarray(jnp.inf)
    above, slope, *_ = jax.lax.stop_gradient(jax.lax.while_loop(going, newton, begin))
    value = _logs(above, material, prestretch, q, steps, against)
    apex = jax.lax.stop_gradient(prestretch + jnp.exp(above))
    found = (jnp.abs(value[0] - goal) < 1e-4) & (slope[0] > 0) & jax.lax.stop_gradient(material).admissible(apex, apex)
    # a last Newton step with fixed slopes: its derivative is that of the implicit function
    pressure = jnp.exp(value[1] + slope[1] / slope[0] * (goal - value[0]))
    return jnp.where(found, pressure, jnp.nan), above


def _put(membrane: Membrane, values: dict):
    """Material and prestretch with these constants."""
    own = {n: v for n, v in values.items() if n not in APPARATUS}
    return with_constants(membrane.material, own), values.get("prestretch", membrane.prestretch)


def _load(values: dict, q_scale):
    """q of q_scale = Φ² times the units' constants that are fitted: the shear modulus below, the permittivity above."""
    return q_scale * values.get("relative_permittivity", 1.0) / values.get("shear_modulus", 1.0)


@functools.cache
def _model(names: tuple[str, ...], logs: tuple[bool, ...], against: str) -> Callable:
    """The compiled model of free parameters of these `names`, each the logarithm of its constant where `logs` says so.

    It returns the pressures (n,), their Jacobian (n, m) by the free parameters, and log(λa − λ0). If a shear modulus μ is
    among the names, pressures are in units of H/A.
    """

    def pressures_and_slopes(free, membrane, volume, q_scale, near, steps):
        def model(free):
            values = {n: jnp.exp(f) if log else f for n, f, log in zip(names, free, logs, strict=True)}
            material, prestretch = _put(membrane, values)
            point = volume, _load(values, q_scale)
            pressure, above = _pressures(material, prestretch, point, near, steps, against)
            pressure = values.get("shear_modulus", 1.0) * pressure + values.get("pressure_offset", 0.0)
            return pressure, (pressure, jax.lax.stop_gradient(above))

        jacobian, (pressure, above) = jax.jacfwd(model, has_aux=True)(free)
        return pressure, jacobian, above

    return cached_jit(pressures_and_slopes)


class Nodes:
    """The states that are computed for points (log V, q_scale): the points themselves, or 256 nodes of a voltage with more of them.

    Between the nodes of a voltage quintic splines in log V interpolate.
    """

    def __init__(self, x: np.ndarray, q: np.ndarray):
        self.count, most = len(x), MODEL_SIZES[-1]
        _, place, many = np.unique(q, return_inverse=True, return_counts=True)
        own = np.flatnonzero(many[place] <= most)
        parts: list[tuple[np.ndarray, np.ndarray | None]] = [(own, None)]
        for k in np.flatnonzero(many > most):
            here = np.flatnonzero(place == k)
            parts.append((here, np.linspace(x[here].min(), x[here].max(), most)))
        self._parts = [part for part in parts if len(part[0])]
        self._points = x
        self.x = np.concatenate([x[here] if nodes is None else nodes for here, nodes in self._parts])
        self.q = np.concatenate(
            [q[here] if nodes is None else np.full(most, q[here[0]]) for here, nodes in self._parts]
        )

    def at_points(self, values: np.ndarray) -> np.ndarray:
        """Values (nodes, …) interpolated at the points (n, …)."""
        found, first = np.empty((self.count, *values.shape[1:])), 0
        for here, nodes in self._parts:
            size = len(here) if nodes is None else len(nodes)
            own, first = values[first : first + size], first + size
            found[here] = own if nodes is None else make_interp_spline(nodes, own, k=5)(self._points[here])
        return found


class CurveModel(AbstractModel):
    """The pressures of a membrane at given volumes, or heights, as a function of free parameters: its constants or their logarithms.

    `q_scale` (n,) or a number is Φ² times the units' constants that are not fitted. For more than 256 volumes at one voltage, the
    states at 256 nodes are interpolated by quintic splines in log V, whose error is far below that of a gauge.
    """

    def __init__(
        self, membrane: Membrane, names: Sequence[str], at: np.ndarray, q_scale, units: dict, against: str = "volume"
    ):
        self.membrane, self._units = (
            Membrane(as_arrays(membrane.material), membrane.prestretch, membrane.breakdown),
            units,
        )
        super().__init__(names, {n: self._start_of(n) for n in names}, "pressure")
        self.against, x = against, np.log(at)
        self._q = np.broadcast_to(np.asarray(q_scale, float), at.shape)
        self._nodes = Nodes(x, self._q)
        # few loads stand for all of them: starting values at a near load are good enough
        loads = np.unique(self._q)
        if len(loads) > MOST_LOADS:
            bins = np.digitize(self._q, np.linspace(loads[0], loads[-1], MOST_LOADS + 1)[1:-1])
            loads = np.array([np.median(self._q[bins == k]) for k in np.unique(bins)])
        self._loads = [float(load) for load in loads]
        self._nearest = np.abs(self._nodes.q[:, None] - loads).argmin(1)
        self._largest = [np.exp(self._nodes.x[self._nearest == k].max(initial=-np.inf)) for k in range(len(loads))]
        self._near, self._steps = np.zeros(len(self._nodes.x)), MODEL_STEPS[0]

    def _start_of(self, name: str) -> float:
        if name in self._units:
            return self._units[name]
        if name == "prestretch":
            return max(float(self.membrane.prestretch), 1.02)
        return value_of(self.membrane.material, name)

    def allows(self, values: dict) -> bool:
        """Whether the material and the membrane are allowed to have these constants."""
        material, prestretch = _put(self.membrane, values)
        try:
            numbers = jax.tree.map(np.asarray, (material, prestretch), is_leaf=lambda x: isinstance(x, jax.Array))
            check_membrane(eqx.tree_at(lambda m: (m.material, m.prestretch), self.membrane, numbers))
        except ValueError:
            return False
        return True

    def membrane_of(self, values: dict) -> Membrane:
        """The membrane with these constants."""
        material, prestretch = _put(self.membrane, values)
        return Membrane(jax.tree.map(np.asarray, material), float(prestretch), self.membrane.breakdown)

    def _states(self, values: dict, q_scale: float, largest: float, steps: float) -> tuple[np.ndarray, np.ndarray]:
        """log(λa − λ0) of nodes (n,), and log V and log p (2, n) of the states there; NaN where there is no state."""
        material, prestretch = _put(self.membrane, values)
        film = eqx.tree_at(
            lambda m: (m.material, m.prestretch), self.membrane, (material, jnp.asarray(prestretch, float))
        )
        # a height is at most about the radius of the balloon, half of its circumference over π
        top = 2.0 + 12.0 * (largest if self.against == "height" else largest ** (1 / 3))
        nodes, logs = _table(self.against)(film, *(np.asarray(x) for x in (_load(values, q_scale), top, steps)))
        return np.asarray(nodes), np.asarray(logs)

    def reach(self, values: dict) -> tuple[float, float]:
        """The largest volume at which the membrane has a state (0 if there is none) and the largest measured one.

        Of several voltages those at the one where the first is the smallest part of the second. Keeps the states as starting values.
        """
        found = []
        for k, (load, largest) in enumerate(zip(self._loads, self._largest, strict=True)):
            own = self._nearest == k
            nodes, (volumes, _) = self._states(values, load, largest, self._steps)
            good = np.isfinite(volumes)
            if not own.any() or good.sum() < 2:
                found += [(0.0, largest)] if own.any() else []
                continue
            rising = np.maximum.accumulate(volumes[good])
            self._near[own] = np.interp(self._nodes.x[own], rising, nodes[good])
            found.append((float(np.exp(rising[-1])), float(largest)))
        return min(found, key=lambda pair: pair[0] / pair[1])

    def refine(self, values: dict) -> bool:
        """Sets the number of steps that these constants need; true if it is larger than before."""
        before = self._steps
        for self._steps in MODEL_STEPS[MODEL_STEPS.index(before) :]:
            if not max(self._change(values, *pair) for pair in zip(self._loads, self._largest, strict=True)) > ACCURATE:
                break
        return self._steps > before

    def _change(self, values: dict, load: float, largest: float) -> float:
        """The relative change of volumes and pressures at a load when the number of steps is doubled."""
        if not largest:
            return 0.0
        once, twice = (self._states(values, load, largest, n * self._steps)[1] for n in (1, 2))
        used = ~(once[0] > np.log(largest) + 0.2)
        return float(np.nanmax(np.abs(once - twice)[:, used], initial=0.0))

    def reachable_start(self) -> dict[str, float]:
        """Starting values for which every measured volume has a state: the membrane's own values if possible.

        Otherwise the positive constants are raised, one after another, until the material reaches the largest volume.
        Raises ValueError if that does not help.
        """
        if self._has_states(self.start, 1.0):
            return dict(self.start)
        factor = 2.0
        while factor <= FARTHEST_START:
            for name, log in zip(self.names, self.logs, strict=True):
                values = self.start | {name: factor * self.start[name]}
                if log and self.allows(values):
                    # margin beyond the largest volume, where the film would be at its limit
                    if self._has_states(values, 1.3):
                        return values
            factor *= 2
        raise ValueError(self._unreachable(*self.reach(self.start)))

    def _has_states(self, values: dict, margin: float) -> bool:
        """Whether the membrane reaches the largest volume times `margin`, and under voltage has a state at every volume before."""
        reached, largest = self.reach(values)
        return reached > margin * largest and (
            not self._q.any() or bool(np.isfinite(self(self.free_of(values))[0]).all())
        )

    def scaled(self, values: dict[str, float], pressure: np.ndarray) -> dict[str, float]:
        """The constants with a shear modulus matched to the measured pressures, which at zero voltage are proportional to it."""
        if "shear_modulus" not in self.names or self._q.any():
            return values
        fit = self(self.free_of(values))[0]
        upper = fit >= np.median(fit)
        ratio = float(np.median(pressure[upper] / fit[upper])) if upper.any() else 1.0
        return values | {"shear_modulus": values["shear_modulus"] * ratio} if ratio > 0 else values

    def _unreachable(self, reached: float, largest: float) -> str:
        names = constants_of(self.membrane.material)
        held = [n for n in names if n not in self.names]
        starting = ", ".join(f"{n} {value_of(self.membrane.material, n):.6g}" for n in names)
        unit = "A" if self.against == "height" else "A³"
        state = f"has states up to {reached:.4g} {unit} only" if reached else "has no state at this voltage"
        if reached > largest:
            state = f"has no state at some of the {self.against}s and voltages"
        return (
            f"`membrane` must have states up to the largest measured {self.against}, {largest:.4g} {unit}, but with {starting or 'this material'} "
            f"it {state}; "
            + (f"also fit {' or '.join(held)}, raise it, or " if held else "")
            + f"check the units of the {self.against}s and the membrane's radius and prestretch."
        )

    def __call__(self, free) -> tuple[np.ndarray, np.ndarray]:
        """Pressures (n,) and their Jacobian (n, m); NaN where a volume has no state or a constant is not allowed."""
        found = self._at(free, self._nodes, self._near)
        if found is None:
            return np.full(self._nodes.count, np.nan), np.full((self._nodes.count, len(self.names)), np.nan)
        pressure, jacobian, self._near = found
        both = self._nodes.at_points(np.column_stack([pressure, jacobian]))
        return both[:, 0], both[:, 1:]

    def _at(self, free, nodes: Nodes, near: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Pressures, Jacobian and log(λa − λ0) at the nodes, in calls of one compiled program; None where one has no state."""
        values = self.values_of(free)
        if not all(np.isfinite(v) for v in values.values()) or not self.allows(values):
            return None
        program, free = _model(self.names, self.logs, self.against), np.asarray(free, float)
        size = next((s for s in MODEL_SIZES if self._nodes.count <= s), MODEL_SIZES[-1])
        parts = []
        for first in range(0, len(nodes.x), size):
            rows = [v[first : first + size] for v in (np.exp(nodes.x), nodes.q, near)]
            count = len(rows[0])
            volume, q, start = (np.concatenate([row, np.full(size - count, row[-1])]) for row in rows)
            found = program(free, self.membrane, volume, q, start, np.asarray(self._steps))
            parts.append([np.asarray(v)[:count] for v in found])
        pressure, jacobian, above = (np.concatenate(column) for column in zip(*parts, strict=True))
        return (pressure, jacobian, above) if np.isfinite(pressure).all() and np.isfinite(jacobian).all() else None

    def dense(self, free) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """q_scale, volumes and pressures (k,) of a smooth curve for each of few loads, from its smallest to its largest volume."""
        curves = []
        for k, load in enumerate(self._loads):
            own = self._nodes.x[self._nearest == k]
            if not own.size:
                continue
            low, high = np.exp([own.min(), own.max()])
            x = np.log(np.unique(np.concatenate([np.linspace(low, high, DENSE), np.geomspace(low, high, DENSE)])))
            order = np.argsort(own, kind="stable")
            near = np.interp(x, own[order], self._near[self._nearest == k][order])
            found = self._at(free, Nodes(x, np.full(len(x), load)), near)
            if found is not None:
                curves.append((load, np.exp(x), found[0]))
        return curves
