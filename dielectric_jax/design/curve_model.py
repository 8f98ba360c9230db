"""Pressures of a membrane at measured volumes, and their exact derivatives by its constants.

The pressure at a volume is that of the equilibrium at the voltage of the experiment, from the explicit map: λa by Newton on
V(λa; θ) = V_i, then p(λa; θ). Its derivatives by the constants θ follow from the implicit function theorem,
dp/dθ = ∂p/∂θ − (∂p/∂λa) (∂V/∂θ)/(∂V/∂λa), with forward-mode autodiff of the map.
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
from .free_parameters import AbstractModel
from .material_constants import as_arrays, check_membrane, constants_of, value_of, with_constants
from .resolution import ACCURATE, FARTHEST_START, FLATTEST, MODEL_SIZES, MODEL_STEPS, NODES, ROUNDS

__all__ = ["CurveModel"]


def _logs(above, material, prestretch, q, steps):
    """log V and log p at λa = λ0 + e^above, elementwise."""
    p, v = explicit_map(material, prestretch + jnp.exp(above), q, prestretch, steps)[:2]
    return jnp.stack([jnp.log(v), jnp.log(p)])


@cached_jit
def _table(membrane, q, top, steps):
    """log(λa − λ0) of nodes, and log V and log p there (2, nodes); NaN beyond the material's limits."""
    nodes = jnp.linspace(jnp.log(FLATTEST), jnp.log(top), NODES)
    apex = membrane.prestretch + jnp.exp(nodes)
    logs = _logs(nodes, membrane.material, membrane.prestretch, q, steps)
    return nodes, jnp.where(membrane.material.admissible(apex, apex), logs, jnp.nan)


def _pressures(material, prestretch, volume, q, near, steps):
    """p of the equilibria at the volumes (n,) and load q, where V rises with λa, and log(λa − λ0) there.

    `near` is log(λa − λ0) to start from. NaN where there is no state. Differentiable in the material's constants, the
    prestretch and q, in forward mode.
    """
    goal, frozen = jnp.log(volume), jax.lax.stop_gradient((material, prestretch, q))

    def newton(state):
        above, _, k, _ = state
        value, slope = jax.jvp(lambda x: _logs(x, *frozen, steps), (above,), (jnp.ones_like(above),))[:2]
        move = jnp.clip((goal - value[0]) / slope[0], -0.5, 0.5)
        return above + move, slope, k + 1, jnp.max(jnp.abs(move))

    def going(state):
        return (state[2] < ROUNDS) & ~(state[3] < 1e-7)

    begin = near, jnp.ones((2, *near.shape)), 0, jnp.asarray(jnp.inf)
    above, slope, *_ = jax.lax.stop_gradient(jax.lax.while_loop(going, newton, begin))
    value = _logs(above, material, prestretch, q, steps)
    apex = jax.lax.stop_gradient(prestretch + jnp.exp(above))
    found = (jnp.abs(value[0] - goal) < 1e-4) & (slope[0] > 0) & jax.lax.stop_gradient(material).admissible(apex, apex)
    # a last Newton step with fixed slopes: its derivative is that of the implicit function
    pressure = jnp.exp(value[1] + slope[1] / slope[0] * (goal - value[0]))
    return jnp.where(found, pressure, jnp.nan), above


def _put(membrane: Membrane, values: dict):
    """Material and prestretch with these constants."""
    own = {n: v for n, v in values.items() if n not in ("prestretch", "shear_modulus")}
    return with_constants(membrane.material, own), values.get("prestretch", membrane.prestretch)


@functools.cache
def _model(names: tuple[str, ...], logs: tuple[bool, ...]) -> Callable:
    """The compiled model of free parameters of these `names`, each the logarithm of its constant where `logs` says so.

    It returns the pressures (n,), their Jacobian (n, m) by the free parameters, and log(λa − λ0). If a shear modulus μ is
    among the names, pressures are in units of H/A, and q = q_scale/μ.
    """

    def pressures_and_slopes(free, membrane, volume, q_scale, near, steps):
        def model(free):
            values = {n: jnp.exp(f) if log else f for n, f, log in zip(names, free, logs, strict=True)}
            material, prestretch = _put(membrane, values)
            shear = values.get("shear_modulus", jnp.asarray(1.0))
            pressure, above = _pressures(material, prestretch, volume, q_scale / shear, near, steps)
            return shear * pressure, (shear * pressure, jax.lax.stop_gradient(above))

        jacobian, (pressure, above) = jax.jacfwd(model, has_aux=True)(free)
        return pressure, jacobian, above

    return cached_jit(pressures_and_slopes)


class CurveModel(AbstractModel):
    """The pressures of a membrane at given volumes, as a function of free parameters: its constants or their logarithms.

    For more than 256 volumes, the states at 256 nodes are interpolated by quintic
    splines in log V, whose error is far below that of a gauge.
    """

    def __init__(self, membrane: Membrane, names: Sequence[str], volume: np.ndarray, q_scale: float, shear: float):
        self.membrane = Membrane(as_arrays(membrane.material), membrane.prestretch, membrane.breakdown)
        super().__init__(names, {n: self._start_of(n, shear) for n in names}, "pressure")
        self._q_scale, self._largest = q_scale, float(volume.max())
        self._x = np.log(volume)
        size = next((s for s in MODEL_SIZES if len(volume) <= s), None)
        if size is not None:
            self._nodes = np.concatenate([self._x, np.full(size - len(volume), self._x[-1])])
        else:
            self._nodes = np.linspace(self._x.min(), self._x.max(), MODEL_SIZES[-1])
        self._interpolates = size is None
        self._near, self._steps = np.zeros(0), MODEL_STEPS[0]

    def _start_of(self, name: str, shear: float) -> float:
        if name == "shear_modulus":
            return shear
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

    def _states(self, values: dict, steps: float) -> tuple[np.ndarray, np.ndarray]:
        """log(λa − λ0) of nodes (n,), and log V and log p (2, n) of the states there; NaN where there is no state."""
        material, prestretch = _put(self.membrane, values)
        film = eqx.tree_at(
            lambda m: (m.material, m.prestretch), self.membrane, (material, jnp.asarray(prestretch, float))
        )
        q = self._q_scale / values.get("shear_modulus", 1.0)
        top = 2.0 + 12.0 * self._largest ** (1 / 3)
        nodes, logs = _table(film, *(np.asarray(x) for x in (q, top, steps)))
        return np.asarray(nodes), np.asarray(logs)

    def largest_volume(self, values: dict) -> float:
        """The largest volume at which the membrane has a state; 0 if there is none. Keeps the states as starting values."""
        nodes, (volumes, _) = self._states(values, self._steps)
        good = np.isfinite(volumes)
        if good.sum() < 2:
            return 0.0
        rising = np.maximum.accumulate(volumes[good])
        self._near = np.interp(self._nodes, rising, nodes[good])
        return float(np.exp(rising[-1]))

    def refine(self, values: dict) -> bool:
        """Sets the number of steps that these constants need; true if it is larger than before."""
        before = self._steps
        for self._steps in MODEL_STEPS[MODEL_STEPS.index(before) :]:
            once, twice = (self._states(values, n * self._steps)[1] for n in (1, 2))
            used = ~(once[0] > np.log(self._largest) + 0.2)
            change = np.abs(once - twice)[:, used]
            if not np.nanmax(change, initial=0.0) > ACCURATE:
                break
        return self._steps > before

    def reachable_start(self) -> dict[str, float]:
        """Starting values for which every measured volume has a state: the membrane's own values if possible.

        Otherwise the positive constants are raised, one after another, until the material reaches the largest volume.
        Raises ValueError if that does not help.
        """
        reached = self.largest_volume(self.start)
        if reached > self._largest:
            return dict(self.start)
        factor = 2.0
        while factor <= FARTHEST_START:
            for name, log in zip(self.names, self.logs, strict=True):
                values = self.start | {name: factor * self.start[name]}
                if log and self.allows({n: v for n, v in values.items() if n != "shear_modulus"}):
                    # margin beyond the largest volume, where the film would be at its limit
                    if self.largest_volume(values) > 1.3 * self._largest:
                        return values
            factor *= 2
        raise ValueError(self._unreachable(reached))

    def scaled(self, values: dict[str, float], pressure: np.ndarray) -> dict[str, float]:
        """The constants with a shear modulus matched to the measured pressures, which at zero voltage are proportional to it."""
        if "shear_modulus" not in self.names or self._q_scale:
            return values
        fit = self(self.free_of(values))[0]
        upper = fit >= np.median(fit)
        ratio = float(np.median(pressure[upper] / fit[upper])) if upper.any() else 1.0
        return values | {"shear_modulus": values["shear_modulus"] * ratio} if ratio > 0 else values

    def _unreachable(self, reached: float) -> str:
        names = constants_of(self.membrane.material)
        held = [n for n in names if n not in self.names]
        starting = ", ".join(f"{n} {value_of(self.membrane.material, n):.6g}" for n in names)
        state = f"has states up to {reached:.4g} A³ only" if reached else "has no state at this voltage"
        return (
            f"`membrane` must have states up to the largest measured volume, {self._largest:.4g} A³, but with {starting or 'this material'} "
            f"it {state}; "
            + (f"also fit {' or '.join(held)}, raise it, or " if held else "")
            + "check the units of the volumes and the membrane's radius and prestretch."
        )

    def __call__(self, free) -> tuple[np.ndarray, np.ndarray]:
        """Pressures (n,) and their Jacobian (n, m); NaN where a volume has no state or a constant is not allowed."""
        values = self.values_of(free)
        count = len(self._x)
        lost = np.full(count, np.nan), np.full((count, len(self.names)), np.nan)
        if not all(np.isfinite(v) for v in values.values()) or not self.allows(values):
            return lost
        args = self.membrane, np.exp(self._nodes), np.asarray(self._q_scale), self._near, np.asarray(self._steps)
        found = _model(self.names, self.logs)(np.asarray(free, float), *args)
        pressure, jacobian, above = (np.asarray(v) for v in found)
        if not (np.isfinite(pressure).all() and np.isfinite(jacobian).all()):
            return lost
        self._near = above
        if self._interpolates:
            both = make_interp_spline(self._nodes, np.column_stack([pressure, jacobian]), k=5)(self._x)
            return both[:, 0], both[:, 1:]
        return pressure[:count], jacobian[:count]
