"""How a membrane that hardly flows passes the fold at rest: laws of slow passage, with their constants."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from ..diagram import voltage_volume
from ..model import Chamber, ConstantPressure, Scene, capacitance, other_loading, profile, spring_and_branches
from ..numerics import Code, SceneError, cached_jit, check_between, lapack_alone
from .balance import Balance, Grid, Shape, balanced, grid_of, stretches, tangent, volume_of
from .phases import begun, setting_of, trial_of
from .requests import serve
from .resolution import LANDING_TOLERANCE, MESHES
from .runs import at_rest, at_start

__all__ = ["SlowPassage", "slow_passage"]

_AIRY = 2.338107410459767  # minus the first zero of Airy's function Ai


@dataclasses.dataclass(frozen=True)
class SlowPassage:
    """The passage of the fold at rest, (Φ*, V*), in the limit of slow ramps and of voltages just beyond it.

    Along the null vector φ of the stiffness at the fold the amplitude a obeys c a' = α (q − q*) + β a², with

        α = −φ·∂Π_u/∂q,   β = −½ φ·D³Π[φ, φ],   c = Σ 4 g_k τ_k ∫ (e1² + e1 e2 + e2²) ds,   e_i = δ ln λ_i along φ.

    Hence a ramp Φ = r t passes at Φ* + `ramp_constant` r^(2/3), and a held voltage after `delay_constant` / √(q − q*):

        k_ramp = 2.338107 (c²/(2 α β Φ*))^(1/3),   k_delay = π c/√(α β).

    They are asymptotes. At rates of the laboratory they are poor: a check, and no shortcut.
    """

    voltage: float
    volume: float
    ramp_constant: float
    delay_constant: float

    def snap_voltage(self, rate: float) -> float:
        """Φ* + k_ramp r^(2/3), but for terms of order r."""
        check_between("rate", rate, 0.0, math.inf)
        return self.voltage + self.ramp_constant * rate ** (2 / 3)

    def delay(self, voltage: float) -> float:
        """k_delay/√(q − q*), but for a constant."""
        if not voltage > self.voltage:
            raise ValueError(f"`voltage` must be above that of the fold at rest, {self.voltage!r}, but is {voltage!r}.")
        return self.delay_constant / math.sqrt(voltage**2 - self.voltage**2)


@functools.cache
def _program(mesh: tuple[int, int]):
    """`(balance, branches, condition, shape, volume)`: q and α, β, c at the state of this volume."""
    grid = grid_of(*mesh)

    def run(balance: Balance, branches, condition, shape: Shape, volume):
        none = jnp.zeros((0, 2, len(grid.s)))
        found = balanced(balance, shape, none, volume, grid)
        along, _ = tangent(balance, found.shape, none, grid)
        constants = _constants(balance, branches, condition, found.shape, along, grid)
        return jnp.stack([found.shape.moment, *constants, found.good])

    return cached_jit(run)


def _constants(balance: Balance, branches, condition, shape: Shape, along: Shape, grid: Grid):
    q, spring = shape.moment, balance.spring

    def moved(share):
        return shape._replace(
            coefficients=shape.coefficients + share * along.coefficients, slope=shape.slope + share * along.slope
        )

    def film(share):
        a, _, l1 = stretches(balance, moved(share), grid)
        return l1, jnp.abs(a)

    def volume(share):
        return volume_of(balance, moved(share), grid)

    def energy(share):
        l1, l2 = film(share)
        return grid.weights @ (spring.energy(l1, l2) - q * capacitance(spring, l1, l2) / 2)

    def force(share):
        expands = jax.grad(volume)(share)
        return jax.grad(energy)(share) - condition.gas_pressure(volume(share)) * expands / np.pi

    _, changes = jax.jvp(lambda share: jnp.log(jnp.stack(film(share))), (0.0,), (1.0,))
    e1, e2 = changes
    viscosity = sum(b.modulus_ratio * b.relaxation_time for b in branches)
    alpha = jax.grad(lambda share: grid.weights @ capacitance(spring, *film(share)))(0.0) / 2
    beta = -jax.grad(jax.grad(force))(0.0) / 2
    return alpha, beta, 4 * viscosity * (grid.weights @ (e1**2 + e1 * e2 + e2**2))


def slow_passage(scene: Scene) -> SlowPassage:
    """The laws of slow passage of a scene's first fold at rest, dimensionless, with times in the unit of the relaxation times.

    Raises ValueError for bad input, and SceneError where the diagram at rest has no snap.

    >>> from dielectric_jax import Membrane
    >>> from dielectric_jax.model import Gent, Maxwell, Viscoelastic
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> law = slow_passage(Scene(Membrane(rubber), ConstantPressure(1.82)))
    >>> round(law.ramp_constant, 6), round(law.delay_constant, 6)
    (3.39455, 2.630716)
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    if not isinstance(scene.loading, (Chamber, ConstantPressure)):
        raise other_loading(scene.loading, Chamber, ConstantPressure)
    snaps = voltage_volume(at_rest(scene)).ramp()["snap"]
    if not snaps:
        raise SceneError(Code.no_fold)
    fold = snaps[0].state
    branches = spring_and_branches(scene.membrane.material)[1]
    elastic = dataclasses.replace(scene, membrane=at_start(scene.membrane, "relaxed"))
    setting = setting_of(elastic, {}, {}, MESHES[1], LANDING_TOLERANCE)
    setting, _ = serve([begun(setting, "relaxed", {})])[0]
    balance = setting.free({}, "voltage", 1.0)
    trial = trial_of(float(elastic.membrane.prestretch), fold, profile(elastic.membrane, fold), setting.grid)._replace(
        moment=fold.voltage**2
    )
    arguments = jax.tree.map(lambda v: np.asarray(v, float), (balance, branches, setting.condition, trial, fold.volume))
    with lapack_alone():
        q, alpha, beta, c, good = map(float, _program(setting.mesh)(*arguments))
    if not good:
        raise SceneError(Code.not_converged)
    voltage = math.sqrt(q)
    ramp = _AIRY * (c * c / (2 * alpha * beta * voltage)) ** (1 / 3)
    return SlowPassage(voltage, fold.volume, ramp, math.pi * c / math.sqrt(alpha * beta))
