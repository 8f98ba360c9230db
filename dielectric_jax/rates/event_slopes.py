"""The derivatives of an event in time by every number of its scene and protocol.

A run takes steps at fixed values of σ. Each step is the root of a system of equations, and one more step of Newton's method from
the root has the derivatives of the root: those of the matrix multiply a residual of zero. At an instantaneous fold dt/dσ = 0, and
at a peak dp/dσ = 0: the derivative of the time, or of the pressure, at a fixed σ is that of the event.
"""

import dataclasses
import functools
import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Chamber, ConstantPressure, Membrane, spring_and_branches
from ..numerics import cached_jit, lapack_alone
from .balance import ONE, Balance, Grid, Shape, Step, grid_of, linearised, newton, solution_of, stretches, volume_of
from .passages import Load
from .phases import filling_of
from .protocols import Linear
from .stepping import INVERSE, C, Instant

__all__ = ["Given", "Record", "slopes_of_event"]


class Given(typing.NamedTuple):
    """What an event depends on: the membrane, what it rests on, and the value and the rate of what is prescribed.

    `loading` is None where the volume is prescribed.
    """

    membrane: Membrane
    loading: Chamber | ConstantPressure | None
    value: typing.Any
    rate: typing.Any


class Record(typing.NamedTuple):
    """A leg as it was followed: the shapes and dashpots at rest and after the voltage's leap, κ, the instants from which steps
    went, padded by the last, the σ where they ended, and how many there are.
    """

    rest: Shape
    x: typing.Any
    leapt: Shape
    kappa: typing.Any
    instants: Instant
    sigma: typing.Any
    steps: typing.Any


def _refined(balance: Balance, shape: Shape, x, step: Step, grid: Grid) -> tuple[Shape, jax.Array]:
    """A root with its derivatives, by a step of Newton's method."""
    shape, x = jax.lax.stop_gradient((shape, x))
    change, dx = solution_of(linearised(balance, shape, x, step, grid), grid)
    return jax.tree.map(jnp.add, shape, change), x + dx


def _balanced(balance: Balance, shape: Shape, x, grid: Grid) -> Shape:
    """The shape with frozen dashpots, with its derivatives."""
    staged = jax.tree.map(lambda v: jnp.asarray(v)[None], shape)
    found, _ = _refined(balance, staged, x[None], Step(x, shape.moment, jnp.zeros(1), ONE), grid)
    return jax.tree.map(lambda v: v[0], found)


class _Courses(typing.NamedTuple):
    """What is prescribed while the membrane flows."""

    load: Load
    volume: Linear | None


def _courses(given: Given) -> _Courses:
    value, rate = jnp.asarray(given.value, float), jnp.asarray(given.rate, float)
    if given.loading is None:
        return _Courses(Load(Linear(0.0, 0.0, 0.0), 0.0), Linear(value, rate, 0.0))
    return _Courses(Load(Linear(value, rate, 0.0), 0.0), None)


def _start(given: Given, record: Record, relaxed: bool, grid: Grid) -> tuple[Balance, jax.Array, jax.Array]:
    """The balance under which the membrane flows, the dashpots at the start, and the volume where the flow begins."""
    spring, branches = spring_and_branches(given.membrane.material)
    name, value = ("volume", given.value) if given.loading is None else filling_of(given.loading)
    held = {"pressure": None, "volume": None, name: Linear(jnp.asarray(value, float), 0.0, 0.0)}
    none = ConstantPressure(0.0).condition()
    stretch, still = given.membrane.prestretch, Load(Linear(0.0, 0.0, 0.0), 0.0)
    springs = () if relaxed else branches
    rest = Balance(spring, springs, stretch, none, still, held["pressure"], held["volume"], 0.0, 1.0, 0.0)
    shape = _balanced(rest, record.rest, record.x[: len(rest.branches)], grid)
    volume = volume_of(rest, shape, grid)
    x = record.x
    if relaxed:
        a, _, l1 = stretches(rest, shape, grid)
        x = jnp.broadcast_to(jnp.stack([jnp.log(l1), jnp.log(jnp.abs(a))]), x.shape)
    load, course = _courses(given)
    condition = none if given.loading is None else given.loading.condition(shape.pressure, volume)
    flow = Balance(spring, branches, stretch, condition, load, None, course, record.kappa, 1.0, 1.0)
    if given.loading is not None:
        frozen = dataclasses.replace(flow, volume_weight=0.0, flows=0.0)
        volume = volume_of(frozen, _balanced(frozen, record.leapt, x, grid), grid)
    return flow, x, volume


def _last(given: Given, record: Record, relaxed: bool, grid: Grid) -> Shape:
    """The shape at the end of the recorded steps."""
    flow, x, volume = _start(given, record, relaxed, grid)
    begins = jnp.concatenate([jnp.zeros(1), record.sigma[:-1]])

    def step(carry, k):
        moment, x, _ = carry
        y0 = jax.tree.map(lambda v: v[k], record.instants)
        begin = jnp.where(k == 0, record.kappa * volume, begins[k])
        ahead = (record.sigma[k] - begin) * jnp.asarray(C)
        fixed = jax.lax.stop_gradient(ahead)
        trial, logs = jax.tree.map(
            lambda v, rate: v + fixed.reshape(-1, *[1] * jnp.ndim(v)) * rate,
            (y0.shape, y0.x),
            (y0.shape_rate, y0.x_rate),
        )
        now = Step(x, moment, begin + ahead, INVERSE)
        found = newton(*jax.lax.stop_gradient((flow, trial, logs, now)), grid)
        shape, dashpots = _refined(flow, found.shape, found.x, now, grid)
        shape = jax.tree.map(lambda v: v[-1], shape)
        new = shape.moment, dashpots[-1], shape
        return jax.tree.map(lambda a, b: jnp.where(k < record.steps, a, b), new, carry), None

    first = jax.tree.map(lambda v: v[0], record.instants.shape)
    carry = (jnp.zeros(()), x, first)
    return jax.lax.scan(step, carry, jnp.arange(len(record.sigma)))[0][2]


@functools.cache
def _program(mesh: tuple[int, int], relaxed: bool, of: str):
    """`(given, record)`: the time or the pressure at the end of the steps, and its derivatives by every number of `given`."""
    grid = grid_of(*mesh)

    def value(given: Given, record: Record):
        return getattr(_last(given, record, relaxed, grid), of)

    def both(given: Given, record: Record):
        found, slopes = jax.value_and_grad(value)(given, record)
        return found, tuple(jax.tree.leaves(slopes))

    return cached_jit(both)


def slopes_of_event(given: Given, record: Record, mesh: tuple[int, int], relaxed: bool, of: str):
    """The "moment" or the "pressure" of an event, and its derivatives by every leaf of `given`."""
    given, record = jax.tree.map(lambda v: np.asarray(v, float), (given, record))
    with lapack_alone():
        value, slopes = _program(mesh, relaxed, of)(given, record)
    return float(value), [np.asarray(v) for v in slopes]
