"""One step in time: the Radau IIA method of order 5, whose three stages are balanced shapes of the membrane.

The film is a differential-algebraic system, x' = f(λ, x) m' under the balance. Its independent variable is σ = m + κ V, in which
a snap, an instantaneous fold and a long rest are all smooth; the time m is an unknown, and with it the system has index 2. A
collocation method of stage order 3 keeps its order 5 there. Singly diagonally implicit methods do not: Kvaerno's 5(4) located a fold to
1e-5 at a tolerance of 1e-8, this method to 1e-10.
"""

import typing

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from ..model import FLOW, capacitance
from .balance import Balance, Grid, Shape, Step, log_stress, newton, stretches, tangent, volume_of
from .resolution import FAILED_STEP

__all__ = ["Instant", "Radau5", "advance", "instant_of"]


class Instant(typing.NamedTuple):
    """A state in time: `shape` and dashpots x (K, 2, G), their derivatives by σ, and `work` (2,) up to it: ∫ D dt and ∫ p dV − ∫ Q dΦ."""

    shape: Shape
    x: jax.Array
    shape_rate: Shape
    x_rate: jax.Array
    work: jax.Array


_ROOT = np.sqrt(6.0)
A = np.array(
    [
        [(88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225],
        [(296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225],
        [(16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9],
    ]
)
C = np.array([(4 - _ROOT) / 10, (4 + _ROOT) / 10, 1.0])
INVERSE = np.linalg.inv(A)
# the real eigenvalue of A, and the weights of the stages in the error of the embedded method (Hairer and Wanner, IV.8)
GAMMA = float(1 / np.linalg.eigvals(INVERSE).real.max())
ERROR = GAMMA / 3 * np.array([-13 - 7 * _ROOT, -13 + 7 * _ROOT, -1.0])


def dissipation(balance: Balance, shape: Shape, x, grid: Grid):
    """D = 2π Σ g_k/(3 τ_k) ∫ (T1² − T1 T2 + T2²) R dR, the power that the dashpots take."""
    a, _, l1 = stretches(balance, shape, grid)
    logs = jnp.stack([jnp.log(l1), jnp.log(jnp.abs(a))])
    total = jnp.zeros(a.shape[:-1])
    for k, branch in enumerate(balance.branches):
        t = log_stress(branch.material, logs - jnp.moveaxis(x[..., k, :, :], -2, 0), 0.0)[0]
        power = jnp.einsum("i...,ij,j...->...", t, FLOW, t)
        total += branch.modulus_ratio / branch.relaxation_time * (power @ grid.weights)
    return np.pi * balance.flows * total


def _charge(balance: Balance, shape: Shape, grid: Grid):
    """Q/Φ = π ∫ C ds."""
    a, _, l1 = stretches(balance, shape, grid)
    return np.pi * capacitance(balance.spring, l1, a) @ grid.weights


def instant_of(balance: Balance, shape: Shape, x, grid: Grid, work) -> Instant:
    """A balanced shape with its derivatives by σ."""
    return Instant(shape, x, *tangent(balance, shape, x, grid), work)


def advance(balance: Balance, grid: Grid, begin, stop, y0: Instant) -> tuple[Instant, Instant, jax.Array]:
    """The instant at σ = `stop` from that at `begin` by one step, its error, and whether Newton's method converged."""
    h = stop - begin
    ahead = h * jnp.asarray(C)

    def spread(value, rate):
        return value + ahead.reshape(-1, *[1] * jnp.ndim(value)) * rate

    trial = jax.tree.map(spread, y0.shape, y0.shape_rate)
    step = Step(y0.x, y0.shape.moment, begin + ahead, INVERSE)
    found = newton(balance, trial, spread(y0.x, y0.x_rate), step, grid)
    moved = INVERSE @ (found.shape.moment - y0.shape.moment)
    expanded = INVERSE @ (volume_of(balance, found.shape, grid) - volume_of(balance, y0.shape, grid))
    charged = INVERSE @ (balance.load(found.shape.moment) - balance.load(y0.shape.moment)) / 2  # Q dΦ = (Q/Φ) dq/2
    powers = jnp.stack(
        [
            moved * dissipation(balance, found.shape, found.x, grid),
            found.shape.pressure * expanded - charged * _charge(balance, found.shape, grid),
        ]
    )
    done = y0.work + powers @ A[2]
    shape, x = jax.tree.map(lambda v: v[-1], (found.shape, found.x))
    end = instant_of(balance, shape, x, grid, done)
    good = found.good & jnp.isfinite(end.shape_rate.moment)

    def embedded(stages, value, rate):
        return GAMMA * h * rate + jnp.tensordot(jnp.asarray(ERROR), stages - value, 1)

    lost = jnp.where(good, 0.0, FAILED_STEP)
    m = embedded(found.shape.moment, y0.shape.moment, y0.shape_rate.moment) / jnp.maximum(
        jnp.abs(balance.volume_weight), 1e-300
    )
    none = jax.tree.map(jnp.zeros_like, y0)
    error = none._replace(
        x=jnp.where(good, embedded(found.x, y0.x, y0.x_rate), lost),
        shape=none.shape._replace(moment=jnp.where(good, m, lost)),
    )
    return jax.tree.map(lambda new, old: jnp.where(good, new, old), end, y0), error, good


class Radau5(diffrax.AbstractAdaptiveSolver):
    """`advance` as a solver of diffrax: the terms carry nothing, `args` are the balance and the grid, and the state is the begin of the last step.

    A step in which Newton's method does not converge has a large error, so that it is tried again, shorter.
    """

    term_structure: typing.ClassVar = diffrax.ODETerm
    interpolation_cls: typing.ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """5."""
        return 5

    def error_order(self, terms):
        """4, of the embedded method."""
        return 4

    def init(self, terms, t0, t1, y0, args):
        """The first step begins at the start."""
        return t0, y0

    def step(self, terms, t0, t1, y0: Instant, args, solver_state, made_jump):
        """One step."""
        balance, grid = args
        end, error, _ = advance(balance, grid, t0, t1, y0)
        return end, error, {"y0": y0, "y1": end}, (t0, y0), diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        """Not a vector field: the derivatives by σ are those of the instant."""
        return y0
