"""Integration from the apex to the rim with diffrax, its exact Jacobian, its derivative rule, and its error estimate.

**Grid.** The equations are singular at R = 0 (modes R⁰ and R⁻²), and a sharpening apex has the length scale
R_c = 2 s0/(p λa²). The radius is R = A sinh(w softplus(s)) with A = min(R_c, 1): steps uniform in s grow
geometrically where R ≪ A w, evenly up to R_c, and geometrically again towards the rim. The step count is data, not
code: one compiled program serves the coarse, the fine and the careful grid.

**Jacobian.** The variational equations are integrated beside the state on the same grid, their right-hand side by
autodiff; this is the exact derivative of the discrete map
on a grid held fixed. The column of the pressure needs none: (R, r, z, p) →
(cR, cr, cz, p/c) leaves the equations unchanged, so ∂/∂p is (R/p) d/dR.

All functions take scalars or arrays of one shape (one lane each); the loop over steps is shared by the lanes.
"""

import typing
from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics import cached_jit, sine_cosine, softplus
from .materials import AbstractMaterial, capacitance, is_concrete, stresses
from .membrane import apex_series, slopes
from .resolution import FEW_RATES, GRID_WIDTH, MOST_ADAPTIVE_STEPS, MOST_STEPS, SERIES_RADIUS

__all__ = ["Rim", "Shot", "shoot"]

UNKNOWNS = ("apex_stretch", "pressure", "voltage_squared")


class EvenSteps(dfx.ConstantStepSize):
    """A number of equal steps that may be traced (a traced `dt0` would bring a host callback with its check)."""

    steps: Float[Array, ""]

    def init(self, terms, t0, t1, y0, dt0, *args, **kwargs):
        return super().init(terms, t0, t1, y0, (t1 - t0) / self.steps, *args, **kwargs)


class EighthOrder(dfx.AbstractSolver):
    """Dormand and Prince's eighth-order method with diffrax' coefficients, for steps that are given.

    The stages run in one rolled loop without an error estimate: it compiles in seconds and costs about half of the
    embedded pair.
    """

    term_structure: typing.ClassVar = dfx.ODETerm
    interpolation_cls: typing.ClassVar = dfx.LocalLinearInterpolation

    def order(self, terms):
        return 8

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = eighth_order_step(lambda t, y: terms.vf(t, y, args), t0, t1 - t0, y0)
        return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful


def eighth_order_step(field: Callable, t, h, y):
    """y(t + h) of dy/dt = field(t, y) by one step; t and h are scalars, or one for each lane of y (states, lanes)."""
    nodes, matrix, weights = (jnp.asarray(v) for v in _TABLEAU)

    def stage(i, k):
        rates = field(t + nodes[i] * h, y + h * jnp.tensordot(matrix[i], k, 1))
        if len(rates) > FEW_RATES:
            return k.at[i].set(rates)
        for j, rate in enumerate(rates):  # XLA would compute them all in one loop without vectors
            k = k.at[i, j].set(rate)
        return k

    k = jax.lax.fori_loop(0, len(nodes), stage, jnp.zeros((len(nodes), *y.shape)))
    return y + h * jnp.tensordot(weights, k, 1)


def _square_tableau(tableau):
    """c, A and b of an explicit method, without the last stage, which only its embedded error uses."""
    stages = len(tableau.b_sol) - 1
    matrix = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower[: stages - 1]):
        matrix[i + 1, : i + 1] = row
    return np.concatenate([[0.0], tableau.c[: stages - 1]]), matrix, np.array(tableau.b_sol[:stages])


_TABLEAU = _square_tableau(dfx.Dopri8.tableau)


def graded_map(scale, start):
    """x(τ) = A sinh(w softplus(s(τ))) from `start` at τ = 0 to 1 at τ = 1, and dx/dτ, with A = `scale`."""

    def inverse(x):
        u = jnp.arcsinh(x / scale) / GRID_WIDTH
        return u + jnp.log(-jnp.expm1(-u))

    first = inverse(start)
    span = inverse(jnp.ones_like(scale)) - first

    def position(tau):
        soft, rate = softplus(first + span * tau)
        rise = jnp.expm1(GRID_WIDTH * soft)
        e = 1 + rise  # sinh and cosh from one exponential: this runs at every stage
        return scale * (rise + rise / e) / 2, scale * (e + 1 / e) / 2 * (GRID_WIDTH * span) * rate

    return position


def integrate(
    field: Callable,
    start: Array,
    steps,
    *,
    trail: Callable | None = None,
    adaptive: bool = False,
    method: typing.Any = None,
):
    """y(1) of dy/dτ = field(τ, y), y(0) = start, and `trail(τ, y)` after every step (padded with inf).

    Eighth-order Dormand–Prince; `steps` equal steps, or with `adaptive` a PID controller at tolerance 10^-steps; or the
    solver and the step size controller of a `ShootingMethod`.
    """
    controller: dfx.AbstractStepSizeController
    solver: dfx.AbstractSolver = dfx.Dopri8(scan_kind="lax") if adaptive else EighthOrder()
    most = MOST_ADAPTIVE_STEPS if adaptive else MOST_STEPS + 1
    if method is not None:
        solver, controller, most = method.solver, method.stepsize_controller, method.max_steps
    elif adaptive:
        tolerance = 10.0 ** (-jnp.asarray(steps, float))
        controller = dfx.PIDController(
            rtol=tolerance, atol=tolerance, norm=lambda y: jnp.max(jnp.abs(y)), dtmax=0.05, factormax=2.0
        )
    else:
        controller = EvenSteps(jnp.asarray(steps, float))
    subs = [dfx.SubSaveAt(t1=True)]
    if trail is not None:
        subs.append(dfx.SubSaveAt(t0=True, steps=True, fn=lambda t, y, args: (t, trail(y))))
    solution = dfx.diffeqsolve(
        dfx.ODETerm(lambda t, y, args: field(t, y)),
        solver,
        0.0,
        1.0,
        None if method is None else method.dt0,
        start,
        saveat=dfx.SaveAt(subs=subs),
        adjoint=dfx.ForwardMode(),
        stepsize_controller=controller,
        max_steps=most,
        throw=False,
    )
    assert solution.ys is not None
    end = solution.ys[0][-1]
    return (end, solution.ys[1]) if trail is not None else (end, None)


class Along(typing.NamedTuple):
    """Reads the raw values that a trail holds: `position` is R and dR/dτ at τ, `apex` the stretch they start from."""

    position: Callable
    apex: Array

    def rows(self, tau, values):
        """R, dR/dτ, λ1, λ2, θ at times τ (rows,) with raw values (rows, 3, lanes)."""
        radius, stretching = jax.vmap(self.position)(jnp.where(jnp.isfinite(tau), tau, 1.0))
        return radius, stretching, self.apex + values[:, 0], self.apex + values[:, 1], values[:, 2]


class Shot(typing.NamedTuple):
    """What a shot returns; every entry has the shape of a lane, columns a leading axis of the asked directions.

    `stretch_change` is λ2(1) − λa without cancellation, `height` z(1), `charge` C = Q/Φ. `sensitivities` maps a direction to
    (∂stretch_change, ∂volume), with `outputs` (∂stretch_change, ∂volume, ∂C). `trail` holds what was recorded after every step: times τ
    (inf once done) and ∂λ2/∂λa; or times, raw values, and the `Along` that reads them.
    """

    stretch_change: Array
    volume: Array
    height: typing.Any
    charge: typing.Any
    sensitivities: dict
    trail: typing.Any


class Rim(typing.NamedTuple):
    """λ2(1) − λa and V, each of the shape of a lane."""

    stretch_change: Array
    volume: Array


class _Inputs(typing.NamedTuple):
    """What a shot depends on: the leaves of the material, and λa, p, q. A direction names one of them.

    It is a name of `UNKNOWNS`, or the index of a leaf.
    """

    leaves: list
    unknowns: list

    def entry(self, direction):
        """The value that a direction changes."""
        if isinstance(direction, str):
            return self.unknowns[UNKNOWNS.index(direction)]
        return jnp.asarray(self.leaves[direction], float)

    def replace(self, direction, value) -> "_Inputs":
        """The inputs with another value there."""
        which, k = (1, UNKNOWNS.index(direction)) if isinstance(direction, str) else (0, direction)
        changed = [*self[which][:k], value, *self[which][k + 1 :]]
        return _Inputs(self.leaves, changed) if which else _Inputs(changed, self.unknowns)


class _Equations(typing.NamedTuple):
    """The equations of a kind of material for y = (λ1 − λa, λ2 − λa, θ, V[, z, C]), the last two with `outputs`.

    `first` is the radius at which the series at the apex hands over.
    """

    material: typing.Any  # its tree structure
    first: Array
    outputs: bool

    def at_first(self, inputs: _Inputs) -> list:
        """y at the radius `first`, by the series at the apex."""
        first, (apex, p, q) = self.first, inputs.unknowns
        material = self.material.unflatten(inputs.leaves)
        a, b, k = apex_series(material, apex, p, q)
        l1, l2 = apex + a * first**2, apex + b * first**2
        s1 = stresses(material, l1, l2, q)[0]
        slope = jnp.arcsin(p * first * l2**2 / (2 * s1))  # first integral (13)
        y = [a * first**2, b * first**2, slope, jnp.pi / 4 * apex**3 * k * first**4]
        if self.outputs:
            y += [apex * k * first**2 / 2, jnp.pi * capacitance(material, apex, apex) * first**2]
        return y

    def rates(self, radius, y, inputs: _Inputs) -> list:
        """dy/dR."""
        apex, p, q = inputs.unknowns
        material = self.material.unflatten(inputs.leaves)
        l1, l2, slope = apex + y[0], apex + y[1], y[2]
        rise = l1 * sine_cosine(slope)[0]
        rate = [*slopes(material, radius, l1, l2, slope, p, q), jnp.pi * (radius * l2) ** 2 * rise]
        if self.outputs:
            rate += [rise, 2 * jnp.pi * capacitance(material, l1, l2) * radius]
        return rate


class _Variation(typing.NamedTuple):
    """The state and its derivatives in `directions` as one system: y (states, …), then as many rows for each direction."""

    equations: _Equations
    inputs: _Inputs
    directions: list

    @property
    def states(self) -> int:
        return 6 if self.equations.outputs else 4

    def _derivative(self, function: Callable, y, tangent, direction):
        """function(y, inputs) and its derivative along `tangent` and by the one input that the direction names."""

        def changed(y, value):
            return function(y, self.inputs.replace(direction, value))

        value = self.inputs.entry(direction)
        return jax.jvp(changed, (y, value), (tangent, jnp.ones_like(value)))

    def _stack(self, rows: list):
        shape = self.inputs.unknowns[0].shape
        return jnp.stack([jnp.broadcast_to(v, shape) for v in rows])

    def start(self):
        """The values at the first radius."""
        zero = [jnp.zeros(self.inputs.unknowns[0].shape)] * self.states
        rows = self.equations.at_first(self.inputs)
        for direction in self.directions:
            rows = rows + self._derivative(lambda y, inputs: self.equations.at_first(inputs), zero, zero, direction)[1]
        return self._stack(rows)

    def rates(self, radius, y):
        """d/dR of the values."""
        n = self.states
        state, out = [y[i] for i in range(n)], []
        for i, direction in enumerate(self.directions):
            tangent = [y[n * (i + 1) + j] for j in range(n)]
            value, change = self._derivative(
                lambda y, inputs: self.equations.rates(radius, y, inputs), state, tangent, direction
            )
            out += change if i else value + change
        return self._stack(out or self.equations.rates(radius, state, self.inputs))

    def recorded(self, trail: str | None, heights: bool) -> Callable | None:
        """What of the values a `trail` of `integrate_membrane` holds."""
        if trail == "sensitivity":
            row = self.states * (1 + self.directions.index("apex_stretch")) + 1
            return lambda y: 1.0 + y[row]
        return {
            None: None,
            "profile": lambda y: jnp.concatenate([y[:3], y[4:5]]) if heights else y[:3],
            "states": lambda y: y[: self.states],
            "all": lambda y: y,
        }[trail]

    def sensitivities(self, end, pressure: bool) -> dict:
        """The derivatives of λ2, V[, C] at the rim in every direction, and with `pressure` those by p, which scaling gives."""
        wanted = (1, 3, 5) if self.equations.outputs else (1, 3)
        found = {d: tuple(end[self.states * (i + 1) + j] for j in wanted) for i, d in enumerate(self.directions)}
        if pressure:
            apex, p, _ = self.inputs.unknowns
            rate = self.equations.rates(jnp.ones(apex.shape), [end[i] for i in range(self.states)], self.inputs)
            # scaling: λ2 depends on pR alone, V p³ and C p² likewise; at p = 0 the limits are 0 and V/p, which no lane asks for
            powers = {1: 0, 3: 3, 5: 2}
            found["pressure"] = tuple((rate[j] - powers[j] * end[j]) / p for j in wanted)
        return found


def integrate_membrane(
    material: AbstractMaterial,
    apex_stretch: typing.Any,
    pressure: typing.Any,
    q: typing.Any,
    steps: typing.Any,
    *,
    sensitivities: tuple = (),
    outputs: bool = False,
    trail: str | None = None,
    heights: bool = False,
    adaptive: bool = False,
    method: typing.Any = None,
    start: float = SERIES_RADIUS,
) -> Shot:
    """One integration from apex to rim at R = 1.

    `sensitivities` lists the wanted derivatives: names of `UNKNOWNS`, or the index of a leaf of `material`. `outputs` adds
    height and charge to the state and to the derivatives, `trail` the values after every step: "sensitivity", "profile"
    (with z as its last entry where `heights` is asked for), the whole "states", or "all" with the columns. A `ShootingMethod`
    replaces the stepping, and `steps` then mean nothing. `start` is where the apex series hands over, as a share of A.
    """
    inputs = jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in (apex_stretch, pressure, q)))
    kappa = jax.lax.stop_gradient(apex_series(material, *inputs)[2])
    scale = jnp.minimum(1 / kappa, 1.0)
    first = start * scale
    position = graded_map(scale, first)
    leaves, structure = jax.tree.flatten(material)
    directions = [d for d in sensitivities if d != "pressure"]
    system = _Variation(_Equations(structure, first, outputs), _Inputs(leaves, list(inputs)), directions)

    def field(tau, y):
        radius, stretching = position(tau)
        return stretching * system.rates(radius, y)

    end, marks = integrate(
        field, system.start(), steps, trail=system.recorded(trail, heights), adaptive=adaptive, method=method
    )
    found = system.sensitivities(end, "pressure" in sensitivities)
    if marks is not None and trail != "sensitivity":
        marks = (*marks, Along(position, inputs[0]))
    height, charge = (end[4], end[5]) if outputs else (None, None)
    return Shot(end[1], end[3], height, charge, found, marks)


def shoot(material: AbstractMaterial, apex_stretch, pressure, voltage_squared, *, steps: float = 32.0) -> Rim:
    """λ2(1) − λa and V of the membrane shot from (apex_stretch, pressure, voltage_squared) to R = 1.

    An equilibrium has stretch_change = prestretch − apex_stretch. Differentiable in every argument by jvp, jacfwd, grad and their
    vmap (and once more in forward mode, so `jax.hessian` works): the rule builds the columns of the Jacobian that are
    asked for and multiplies by them, so it is linear in the tangent and transposes. `steps` is the number of steps of
    the graded grid; a state of `equilibrium` carries an error estimate, a shot none.

    >>> import jax
    >>> from dielectric_jax import Gent
    >>> change = lambda p: shoot(Gent(), 2.0, p, 0.0).stretch_change
    >>> bool(abs(jax.grad(change)(1.9) - (change(1.9 + 1e-5) - change(1.9 - 1e-5)) / 2e-5) < 1e-8)
    True
    """
    inputs = material, apex_stretch, pressure, voltage_squared
    if all(map(is_concrete, jax.tree.leaves((inputs, steps)))):
        return Rim(*_shoot_program(inputs, steps))
    return _shoot(inputs, steps)


@cached_jit
def _shoot_program(inputs, steps):
    return tuple(_shoot(inputs, steps))


@eqx.filter_custom_jvp
def _shoot(inputs, steps):
    material, apex_stretch, pressure, q = inputs
    shot = integrate_membrane(material, apex_stretch, pressure, q, steps)
    return Rim(shot.stretch_change, shot.volume)


@_shoot.def_jvp
def _(primals, tangents):
    (inputs, steps), (moves, _) = primals, tangents
    wanted, weights = [], []
    for column, move in zip(UNKNOWNS, moves[1:], strict=True):
        if move is not None:
            wanted.append(column)
            weights.append(move)
    for leaf, move in enumerate(jax.tree.leaves(moves[0], is_leaf=lambda v: v is None)):
        if move is not None:
            wanted.append(leaf)
            weights.append(move)
    material, apex_stretch, pressure, q = inputs
    shot = integrate_membrane(material, apex_stretch, pressure, q, steps, sensitivities=tuple(wanted))
    stretch_change, volume = (
        jnp.asarray(sum(shot.sensitivities[c][i] * w for c, w in zip(wanted, weights, strict=True))) for i in (0, 1)
    )
    return Rim(shot.stretch_change, shot.volume), Rim(stretch_change, volume)


@jax.jit
def _rim_with_sensitivities(material, apex_stretch, pressure, q, steps):
    shot = integrate_membrane(material, apex_stretch, pressure, q, steps, sensitivities=UNKNOWNS)
    return shot.stretch_change, shot.volume, jnp.stack([jnp.stack(shot.sensitivities[c]) for c in UNKNOWNS])


@jax.custom_batching.custom_vmap
def rim_with_sensitivities(material, point, steps):
    """λ2(1) − λa, V and their derivatives (3, 2) at point (3,) = (λa, p, q); under vmap one loop serves all lanes."""
    return _rim_with_sensitivities(material, *point, steps)


@rim_with_sensitivities.def_vmap
def _(lanes, batched, material, point, steps):
    in_material, in_point, in_steps = batched
    if in_steps:
        raise NotImplementedError("`steps` must be the same for all lanes of a batch.")
    del in_material  # leaves of shape () or (lanes,): the integration is elementwise
    rows = point.T if in_point else jnp.broadcast_to(point[:, None], (3, lanes))
    stretch_change, volume, sensitivities = _rim_with_sensitivities(material, *rows, steps)
    return (stretch_change, volume, jnp.moveaxis(sensitivities, -1, 0)), (True, True, True)
