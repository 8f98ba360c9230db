"""The balance of the membrane at the stages of a step in time, with the flow of its dashpots eliminated.

Unknown are r = R a(s) and the slope c = dz/ds of the height, s = R². With b = a + 2 s a' the stretches are λ1² = b² + 4 s c²
and λ2 = a, and with w = W − q e (λ1 λ2)²/2 + Σ g W_k(λ1/ξ1k, λ2/ξ2k) the energy is

    Π/π = ∫ (w − p s a² c) ds,        V/π = ∫ s a² c ds.

a(s) = λ0 + (1 − s) times a polynomial (Galerkin); c and x = ln ξ live at Gauss points, where nothing couples them to their
neighbours. A step from x̂, m̂ by a collocation method of matrix A has S stages with the equations, B = A⁻¹,

    Σ_j B_ij (x_j − x̂) = Σ_j B_ij (m_j − m̂) f(λ_i, x_i)       at every point and branch,
    ∂Π/∂c = 0                                                   at every point,
    ∂Π/∂a = 0,   the loading,   m_i + κ V_i = σ_i               N + 2 equations a stage,

of which Newton's method eliminates the first two kinds point by point. m is the time, an unknown as V is: at an instantaneous
fold dm/dσ = 0 and nothing is singular. One stage with B = 1 is a balance with frozen dashpots, if they do not flow.
"""

import functools
import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import legendre

from ..model import FLOW, AbstractMaterial, LoadingCondition, Maxwell, capacitance, stresses
from .resolution import CROWDING, MOST_NEWTON_STEPS, NEWTON_STEP

__all__ = [
    "ONE",
    "Balance",
    "Grid",
    "Shape",
    "Solved",
    "Step",
    "balanced",
    "grid_of",
    "linearised",
    "log_stress",
    "newton",
    "solution_of",
    "stretches",
    "tangent",
    "volume_of",
]


class Grid(typing.NamedTuple):
    """Gauss points `s` and `weights` (G,) of ∫ ds, and `functions` (2, G, N): the values of a and of b.

    `share` are the points in the coordinate η from 0 to 1, s = (exp(k η) − 1)/(exp(k) − 1), which crowds them at the apex.
    """

    share: np.ndarray
    s: np.ndarray
    weights: np.ndarray
    functions: np.ndarray


@functools.cache
def grid_of(functions: int, points: int) -> Grid:
    """Legendre polynomials of η times 1 − η at Gauss points of η."""
    x, weights = legendre.leggauss(points)
    eta = (1 + x) / 2
    s = np.expm1(CROWDING * eta) / np.expm1(CROWDING)
    pace = CROWDING * np.exp(CROWDING * eta) / np.expm1(CROWDING)  # ds/dη
    p = legendre.legvander(x, functions - 1)
    change = np.stack([2 * legendre.legval(x, legendre.legder(row)) for row in np.eye(functions)], axis=1)
    size = np.sqrt(2 * np.arange(functions) + 1)
    values = (1 - eta)[:, None] * p * size
    slopes = ((1 - eta)[:, None] * change - p) * size / pace[:, None]
    return Grid(eta, s, weights / 2 * pace, np.stack([values, values + 2 * s[:, None] * slopes]))


class Shape(typing.NamedTuple):
    """States, with the stages in front: `coefficients` (N,) of a, `slope` c (G,), `pressure`, and the time `moment` m."""

    coefficients: typing.Any
    slope: typing.Any
    pressure: typing.Any
    moment: typing.Any


class Balance(eqx.Module):
    """What is balanced: the film, the loading, and how both depend on m.

    `load(m)` is q; `pressure(m)` or `volume(m)` is prescribed where it is given, else `condition` holds. The last equation is
    `moment_weight` m + `volume_weight` V = σ. Dashpots flow where `flows` is 1 and are frozen where it is 0.
    """

    spring: AbstractMaterial
    branches: tuple[Maxwell, ...]
    prestretch: typing.Any
    condition: LoadingCondition
    load: typing.Any
    pressure: typing.Any
    volume: typing.Any
    volume_weight: typing.Any
    moment_weight: typing.Any
    flows: typing.Any

    def row(self, pressure, volume, moment):
        """The loading: zero where pressure and volume fit each other."""
        if self.pressure is not None:
            return pressure - self.pressure(moment)
        if self.volume is not None:
            return volume - self.volume(moment)
        return self.condition.residual(pressure, volume, 0.0)


class Step(typing.NamedTuple):
    """Where a step begins, x̂ (K, 2, G) and m̂, where its stages are, σ (S,), and B = A⁻¹ (S, S)."""

    x: jax.Array
    moment: jax.Array
    sigma: jax.Array
    inverse: np.ndarray


def stretches(balance: Balance, shape: Shape, grid: Grid) -> jax.Array:
    """a, b and λ1 at the Gauss points, (3, …, G)."""
    a, b = (balance.prestretch + shape.coefficients @ f.T for f in grid.functions)
    return jnp.stack([a, b, jnp.sqrt(b * b + 4 * grid.s * shape.slope**2)])


def volume_of(balance: Balance, shape: Shape, grid: Grid) -> jax.Array:
    """V = π ∫ s a² c ds."""
    a = balance.prestretch + shape.coefficients @ grid.functions[0].T
    return np.pi * (grid.s * a**2 * shape.slope) @ grid.weights


def log_stress(material, logs, q) -> tuple[jax.Array, jax.Array]:
    """T_i = λ_i ∂w/∂λ_i (2, …) and ∂T_i/∂ln λ_j (2, 2, …) at logarithms of stretches (2, …)."""
    l1, l2 = jnp.exp(logs)
    s1, s2, s11, s12 = stresses(material, l1, l2, q)
    s22 = stresses(material, l2, l1, q)[2]
    t1, t2, mixed = l1 * s1, l2 * s2, l1 * l2 * s12
    return jnp.stack([t1, t2]), jnp.stack(
        [jnp.stack([l1 * l1 * s11 + t1, mixed]), jnp.stack([mixed, l2 * l2 * s22 + t2])]
    )


def _load_stress(material, logs) -> jax.Array:
    """∂T_i/∂q (2, …)."""
    l1, l2 = jnp.exp(logs)
    c1, c2 = jax.grad(lambda u, v: jnp.sum(capacitance(material, u, v)), argnums=(0, 1))(l1, l2)
    return jnp.stack([-l1 * c1 / 2, -l2 * c2 / 2])


def _eliminated(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """The solutions (n, r, …) of small systems (n, n, …) at many points, by elimination without pivots."""
    n = len(matrix)
    rows = jnp.concatenate([matrix, right], axis=1)
    for k in range(n):
        row = rows[k] / rows[k, k]
        rows = (rows - rows[:, k, None] * row).at[k].set(row)
    return rows[:, n:]


def _on_diagonal(values: jax.Array) -> jax.Array:
    """(S, n, m, G) as blocks (S, n, S, m, G) that couple no stages."""
    return jnp.eye(len(values))[:, None, :, None, None] * values[:, :, None]


class _Stress(typing.NamedTuple):
    """Log stress (S, 2, G), its derivatives by logarithms (S, 2, S, 2, G) and moments (S, 2, S, G), and what residuals add."""

    value: jax.Array
    by_logs: jax.Array
    by_moment: jax.Array
    correction: jax.Array


def _branch(branch: Maxwell, logs, x, begin, moved, flows, inverse) -> tuple[_Stress, jax.Array]:
    """A branch at the stages with the flow of its dashpot eliminated, and the columns of dx (S, 2, 2S + S + 1, G).

    `logs` and `x` are (S, 2, G), `begin` (2, G), and `moved` (S,) = Σ_j B_ij (m_j − m̂).
    """
    stages = len(logs)
    value, change = log_stress(branch.material, jnp.moveaxis(logs - x, 1, 0), 0.0)
    change = jax.lax.stop_gradient(change)
    value, change = jnp.moveaxis(value, 1, 0), jnp.moveaxis(change, 2, 0)  # (S, 2, G), (S, 2, 2, G)
    rate = jnp.asarray(FLOW) / branch.relaxation_time
    flowing = flows * jnp.einsum("ij,sjg->sig", rate, value)
    implicit = flows * moved[:, None, None, None] * jnp.einsum("ij,sjkg->sikg", rate, change)
    coupled = jnp.asarray(inverse)[:, None, :, None, None] * jnp.eye(2)[:, None, :, None]
    matrix = coupled + _on_diagonal(implicit)
    residual = jnp.einsum("st,tig->sig", inverse, x - begin) - moved[:, None, None] * flowing
    by_logs = _on_diagonal(implicit)
    by_moment = jnp.asarray(inverse)[:, None, :, None] * flowing[:, :, None]
    points = logs.shape[-1]
    size = 2 * stages
    right = [
        by_logs.reshape(size, size, points),
        by_moment.reshape(size, stages, points),
        -residual.reshape(size, 1, points),
    ]
    dx = _eliminated(matrix.reshape(size, size, points), jnp.concatenate(right, axis=1))
    dx = dx.reshape(stages, 2, size + stages + 1, points)
    g = branch.modulus_ratio
    answer = -g * jnp.einsum("sikg,skcg->sicg", change, dx)
    by_own = _on_diagonal(g * change) + answer[:, :, :size].reshape(stages, 2, stages, 2, points)
    return _Stress(g * value, by_own, answer[:, :, size:-1], answer[:, :, -1]), dx


class _Linear(typing.NamedTuple):
    """One Newton step: matrix and residual of the condensed unknowns, (coefficients, p, m) of every stage, and what gives back the rest.

    `slope` (S, 4S + 1, G) are the columns of dc by (a, b) of every stage, p, m, and the residual; `dashpots` those of dx;
    `logs_by` (S, 2, 3, G) the derivatives of the logarithms of the stretches by (a, b, c).
    """

    matrix: jax.Array
    residual: jax.Array
    slope: jax.Array
    dashpots: list
    logs_by: jax.Array


def _energy_forms(balance: Balance, shape: Shape, stress: _Stress, grid: Grid):
    """First and second derivatives of the energy density by (a, b, c): (S, 3, G), (S, 3, S, 3, G), by p and by moments."""
    a, b, l1 = stretches(balance, shape, grid)
    s, c, p = grid.s, shape.slope, shape.pressure[:, None]
    h1b, h1c, zero = b / l1**2, 4 * s * c / l1**2, jnp.zeros_like(a)
    logs_by = jnp.stack([jnp.stack([zero, h1b, h1c], 1), jnp.stack([1 / a, zero, zero], 1)], 1)
    by_p = -s * jnp.stack([2 * a * c, zero, a * a], 1)
    first = jnp.einsum("sig,sikg->skg", stress.value + stress.correction, logs_by) + p[:, None] * by_p
    t1, t2 = stress.value[:, 0], stress.value[:, 1]
    bc, ac = -2 * t1 * h1b * h1c, -2 * p * s * a
    bb, cc = t1 * (1 / l1**2 - 2 * h1b**2), t1 * (4 * s / l1**2 - 2 * h1c**2)
    aa = -t2 / a**2 - 2 * p * s * c
    own = jnp.stack([jnp.stack([aa, zero, ac], 1), jnp.stack([zero, bb, bc], 1), jnp.stack([ac, bc, cc], 1)], 1)
    second = jnp.einsum("sikg,sitjg,tjlg->sktlg", logs_by, stress.by_logs, logs_by) + _on_diagonal(own)
    by_m = jnp.einsum("sikg,sitg->sktg", logs_by, stress.by_moment)
    return logs_by, first, second, by_p, by_m


def linearised(balance: Balance, shape: Shape, x, step: Step, grid: Grid) -> _Linear:
    """The equations at a trial, shapes of S stages and x (S, K, 2, G), condensed.

    For `solution_of` at a root, whose derivatives need none of the matrix, its stiffnesses have no derivatives.
    """
    stages = len(shape.coefficients)
    a, _, l1 = stretches(balance, shape, grid)
    logs = jnp.stack([jnp.log(l1), jnp.log(jnp.abs(a))], 1)
    q, q_rate = jax.jvp(balance.load, (shape.moment,), (jnp.ones_like(shape.moment),))
    value, change = log_stress(balance.spring, jnp.moveaxis(logs, 1, 0), q[:, None])
    change = jax.lax.stop_gradient(change)
    by_load = jnp.moveaxis(_load_stress(balance.spring, jnp.moveaxis(jax.lax.stop_gradient(logs), 1, 0)), 1, 0)
    by_load *= q_rate[:, None, None]
    stress = _Stress(
        jnp.moveaxis(value, 1, 0),
        _on_diagonal(jnp.moveaxis(change, 2, 0)),
        jnp.eye(stages)[:, None, :, None] * by_load[:, :, None],
        jnp.zeros_like(by_load),
    )
    moved = step.inverse @ (shape.moment - step.moment)
    dashpots = []
    for k, branch in enumerate(balance.branches):
        own, dx = _branch(branch, logs, x[:, k], step.x[k], moved, balance.flows, step.inverse)
        stress = jax.tree.map(jnp.add, stress, own)
        dashpots.append(dx)
    logs_by, first, second, by_p, by_m = _energy_forms(balance, shape, stress, grid)
    points = len(grid.s)
    by_p = jnp.eye(stages)[:, None, :, None] * by_p[:, :, None]  # (S, 3, S, G)
    columns = jnp.concatenate(
        [second[:, :, :, :2].reshape(stages, 3, 2 * stages, points), by_p, by_m, first[:, :, None]], axis=2
    )
    across = second[:, :, :, 2]  # (S, 3, S, G)
    slope = -_eliminated(across[:, 2], columns[:, 2])
    rows = columns[:, :2] + jnp.einsum("sitg,tcg->sicg", across[:, :2], slope)
    volume_rows = np.pi * grid.s * a[:, None] ** 2 * slope
    own = 2 * np.pi * grid.s * a * shape.slope
    stage = np.arange(stages)
    volume_rows = volume_rows.at[stage, 2 * stage].add(own)
    return _Linear(*_assembled(balance, shape, step, rows, volume_rows, grid), slope, dashpots, logs_by)


def _assembled(balance: Balance, shape: Shape, step: Step, rows, volume_rows, grid: Grid):
    """Matrix and residual from the derivatives at points: `rows` (S, 2, 4S + 1, G) of the energy, and those of V (S, 4S + 1, G)."""
    stages, many = shape.coefficients.shape
    w, f = grid.weights, jnp.asarray(grid.functions)
    ends = 2 * stages
    left = (f * w[:, None]).transpose(0, 2, 1)  # (2, N, G)
    by_shape = rows[:, :, :ends].reshape(stages, 2, stages, 2, -1)
    right = jnp.einsum("sitjg,jgm->sitgm", by_shape, f)
    stiffness = jnp.einsum("ing,sitgm->sntm", left, right)
    sides = jnp.einsum("ing,sicg->snc", left, rows[:, :, ends:])  # by p, by m, residual
    volume_by = jnp.einsum("stjg,g,jgm->stm", volume_rows[:, :ends].reshape(stages, stages, 2, -1), w, f)
    volume_sides = volume_rows[:, ends:] @ w  # (S, 2S + 1)
    volume = volume_of(balance, shape, grid)
    value, slopes = jax.vmap(jax.value_and_grad(balance.row, argnums=(0, 1, 2)))(shape.pressure, volume, shape.moment)
    row_p, row_v, row_m = slopes
    eye = jnp.eye(stages)
    volume_p, volume_m, volume_residual = volume_sides[:, :stages], volume_sides[:, stages:-1], volume_sides[:, -1]
    loading = [
        row_v[:, None, None] * volume_by,
        row_v[:, None] * volume_p + row_p[:, None] * eye,
        row_v[:, None] * volume_m + row_m[:, None] * eye,
    ]
    kappa = balance.volume_weight
    last = [kappa * volume_by, kappa * volume_p, kappa * volume_m + balance.moment_weight * eye]
    force = [stiffness, sides[:, :, :stages], sides[:, :, stages:-1]]
    blocks = [jnp.concatenate([force[0], force[1][..., None], force[2][..., None]], axis=3)]
    blocks += [jnp.concatenate([v[0], v[1][..., None], v[2][..., None]], axis=2)[:, None] for v in (loading, last)]
    matrix = jnp.concatenate(blocks, axis=1)
    gap = balance.moment_weight * shape.moment + kappa * (volume + volume_residual) - step.sigma
    residual = jnp.concatenate([sides[:, :, -1], (value + row_v * volume_residual)[:, None], gap[:, None]], axis=1)
    size = stages * (many + 2)
    return matrix.reshape(size, size), residual.reshape(size)


def _expanded(linear: _Linear, found: jax.Array, grid: Grid, residual: float) -> tuple[Shape, jax.Array]:
    """The changes of shapes and dashpots that belong to a solution of the condensed equations."""
    stages = len(linear.slope)
    found = found.reshape(stages, -1)
    coefficients, p, m = found[:, :-2], found[:, -2], found[:, -1]
    ab = jnp.einsum("jgn,sn->sjg", grid.functions, coefficients)
    points = ab.shape[-1]
    rest = jnp.full((1, points), residual)
    spread = jnp.concatenate(
        [ab.reshape(2 * stages, points), *(jnp.repeat(v[:, None], points, 1) for v in (p, m)), rest]
    )
    slope = jnp.einsum("scg,cg->sg", linear.slope, spread)
    logs = jnp.einsum("sikg,skg->sig", linear.logs_by, jnp.concatenate([ab, slope[:, None]], axis=1))
    spread = jnp.concatenate([logs.reshape(2 * stages, points), jnp.repeat(m[:, None], points, 1), rest])
    dx = [jnp.einsum("sicg,cg->sig", columns, spread) for columns in linear.dashpots]
    empty = jnp.zeros((stages, 0, 2, points))
    return Shape(coefficients, slope, p, m), jnp.stack(dx, axis=1) if dx else empty


def solution_of(linear: _Linear, grid: Grid) -> tuple[Shape, jax.Array]:
    """The changes of shapes and dashpots by one step of Newton's method."""
    return _expanded(linear, jnp.linalg.solve(linear.matrix, -linear.residual), grid, 1.0)


class Solved(typing.NamedTuple):
    """Balanced shapes of the stages, their dashpots (S, K, 2, G), whether Newton's method converged, and in how many steps."""

    shape: Shape
    x: jax.Array
    good: jax.Array
    steps: typing.Any


def newton(balance: Balance, shape: Shape, x, step: Step, grid: Grid) -> Solved:
    """Newton's method from a trial: shapes of S stages and x (S, K, 2, G)."""

    def go_on(carry):
        _, _, last, count = carry
        return (last > NEWTON_STEP) & (last < 1e3) & (count < MOST_NEWTON_STEPS)

    def improve(carry):
        shape, x, _, count = carry
        change, dx = solution_of(linearised(balance, shape, x, step, grid), grid)
        new = jax.tree.map(jnp.add, shape, change)
        moved = jnp.max(jnp.abs(change.coefficients @ grid.functions[0].T))
        moved += jnp.max(jnp.abs(change.pressure) / (0.1 + jnp.abs(shape.pressure)))
        moved += jnp.max(jnp.abs(dx), initial=0.0)
        fair = jnp.isfinite(moved) & (jnp.min(stretches(balance, new, grid)[0]) > 0)
        return new, x + dx, jnp.where(fair, moved, jnp.inf), count + 1

    shape, x, last, count = jax.lax.while_loop(go_on, improve, (shape, x, jnp.asarray(1.0), 0))
    return Solved(shape, x, last <= NEWTON_STEP, count)


ONE = np.ones((1, 1))


def _staged(tree):
    return jax.tree.map(lambda v: jnp.asarray(v)[None], tree)


def balanced(balance: Balance, shape: Shape, x, sigma, grid: Grid) -> Solved:
    """The shape at σ with dashpots x (K, 2, G) where they are; `balance.flows` is to be 0."""
    found = newton(balance, _staged(shape), x[None], Step(x, shape.moment, jnp.reshape(sigma, (1,)), ONE), grid)
    return found._replace(shape=jax.tree.map(lambda v: v[0], found.shape), x=x)


def tangent(balance: Balance, shape: Shape, x, grid: Grid) -> tuple[Shape, jax.Array]:
    """The derivatives of a balanced shape and of its dashpots by σ."""
    step = Step(x, shape.moment, jnp.zeros(1), ONE)
    linear = linearised(balance, _staged(shape), x[None], step, grid)
    right = jnp.zeros_like(linear.residual).at[-1].set(1.0)
    change, dx = _expanded(linear, jnp.linalg.solve(linear.matrix, right), grid, 0.0)
    return jax.tree.map(lambda v: v[0], change), dx[0]
