"""Continuation of a membrane's branches from many seeds at once, one compiled program for every loading."""

import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    SCALE,
    ConstantVoltage,
    Membrane,
    compile_ahead,
    field_ratio_squared,
    largest_load,
    rim_with_sensitivities,
)
from ..numerics import Code, Problem, Steps, Trace, Walk, advance, cached_jit, threads, trace
from .resolution import (
    FLAT_END,
    LARGEST_LOAD_NEAR_LOCK_UP,
    LARGEST_RESTART,
    MARCH_CONTROL,
    MOST_PARTS,
    PASSES,
    TRACE_CONTROL,
    TRACE_LOAD_LIMITS,
    TRACE_STEPS,
)

__all__ = ["TraceGrid", "march_program", "new_walks", "run_trace", "run_traces", "warm_up"]


_CODES = (
    Code.window_stretch,
    Code.lock_up,
    Code.window_load,
    Code.window_load,
    Code.apex_cone,
    Code.beyond_tolerance,
)


class TraceGrid(typing.NamedTuple):
    """How finely a branch is traced.

    `steps` of each shot, `load_limits`, the load fractions up to which that suffices near lock-up and elsewhere, and
    `lengths` (3,): the smallest and largest step along the branch, and how far its first point may be from the seed.
    """

    steps: typing.Any
    load_limits: typing.Any
    lengths: typing.Any


def branch_problem(material, prestretch, condition, limits, grid: TraceGrid, steps: Steps = TRACE_CONTROL) -> Problem:
    """A loading's branches as a continuation problem in u = (λa, p, q).

    `limits` is (λa, λa, t, t, λa from which it is near lock-up).
    """

    def linearise(u, args):
        material, prestretch, condition = args
        stretch_change, volume, sensitivities = rim_with_sensitivities(material, u, grid.steps)
        by_p, by_v, by_q = condition.slopes(volume)
        rim = sensitivities[:, 0].at[0].add(1.0)
        along = by_v * sensitivities[:, 1] + jnp.stack([jnp.zeros_like(by_p), by_p, by_q])
        value = jnp.stack([stretch_change - (prestretch - u[0]), condition.residual(u[1], volume, u[2])])
        return value, jnp.stack([rim, along])

    def residual(u, args):
        return linearise(u, args)[0]

    def margins(u, args):
        fraction = u[2] / largest_load(args[0], u[0])
        # where the grid of this accuracy ends: towards lock-up at a high load, and towards the cone
        locking, elsewhere = grid.load_limits
        resolved = jnp.where(u[0] > limits[4], locking, elsewhere) - fraction
        # towards lock-up no grid resolves the membrane much beyond the scanned loads
        top = jnp.where(u[0] < limits[4], limits[3], jnp.minimum(limits[3], LARGEST_LOAD_NEAR_LOCK_UP))
        box = [u[0] - limits[0], limits[1] - u[0], fraction - limits[2], limits[3] - fraction, top - fraction]
        return jnp.stack([*box, resolved])

    return Problem(
        residual,
        jnp.asarray(SCALE),
        margins,
        _CODES,
        args=(material, prestretch, condition),
        steps=steps,
        linearise=linearise,
        monitors=lambda u, args: jnp.log(jnp.maximum(1 - u[2] / largest_load(args[0], u[0]), 1e-6)),
        lengths=grid.lengths,
    )


@cached_jit
def _trace_program(membrane, condition, limits, start, active, grid: TraceGrid):
    problem = branch_problem(membrane.material, membrane.prestretch, condition, limits, grid)
    seed, direction = start
    return tuple(trace(problem, seed, direction, active))


def run_traces(membrane, condition, limits, seeds, directions, **options):
    """Traces from many seeds, each on a core of its own while there are any: a list of (points, tangents, code)."""

    def one(seed, direction):
        return run_trace(membrane, condition, limits, seed, direction, **options)

    return list(threads().map(one, seeds, directions))


def run_trace(membrane, condition, limits, seed, direction, *, level=0, largest=TRACE_CONTROL.largest):
    """One trace, from the grid `level` on (−1 is the finest): points, unit tangents in scaled unknowns, code.

    `largest` bounds the step; a shorter one tells branches apart that nearly meet.
    """
    level %= len(TRACE_STEPS)
    start = np.asarray(seed), np.asarray(direction)
    points, tangents, code = _run_trace(
        membrane, condition, limits, start, level, (largest, TRACE_CONTROL.largest), MOST_PARTS
    )
    return points, tangents / SCALE, code


def _run_trace(membrane, condition, limits, start, level, bounds, parts):
    """One trace from `start` = (seed, direction), its steps and the distance of its first point within `bounds`; where it leaves the region its grid resolves it goes on from there on the finer grid.

    Where it is as long as a compiled trace can be it goes on with another, of `parts` in all.
    """
    # at the flat end everything shrinks with λa − λ0; elsewhere a shorter step only meets the noise about a cone
    flat = start[0][0] - float(membrane.prestretch) < FLAT_END
    lengths = np.array([TRACE_CONTROL.smallest * (1e-2 if flat else 1.0), *bounds])
    grid = TraceGrid(TRACE_STEPS[level], np.array(TRACE_LOAD_LIMITS[level]), lengths)
    done = Trace(*_trace_program(membrane, condition, limits, start, True, grid))
    count, code = int(done.count), Code(int(done.code))
    points, tangents = np.asarray(done.points)[:count], np.asarray(done.tangents)[:count]
    long = code is Code.too_many_points and parts > 1
    lost = code in (Code.beyond_tolerance, Code.step_too_small) and level + 1 < len(TRACE_STEPS)
    if not (long or lost):
        return points, tangents, code
    if count <= 1:  # it never began
        return _run_trace(membrane, condition, limits, start, level + 1, bounds, parts)
    # on from the last point inside
    further = level + lost, (bounds[0], LARGEST_RESTART), parts - long
    finer = _run_trace(membrane, condition, limits, (points[-2], tangents[-2]), *further)
    if len(finer[0]) < 2:
        return points[:-1], tangents[:-1], code if long else Code.step_too_small
    return np.concatenate([points[:-2], finer[0]]), np.concatenate([tangents[:-2], finer[1]]), finer[2]


def new_walks(u: np.ndarray, headings: np.ndarray) -> Walk:
    """Walks about to begin at u (lanes, 3) towards `headings`, as arrays of NumPy."""
    at, way = u / SCALE, headings / SCALE
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    lanes = len(u)
    places = {"base": at, "trial": at, "origin": at, "tangent": way, "heading": way, "bend": np.zeros((lanes, 2, 3))}
    numbers = {"step": np.zeros(lanes), "last": np.full(lanes, np.inf), "watched": np.zeros((lanes, 1))}
    counts = {name: np.zeros(lanes, int) for name in ("tries", "count", "code", "evaluations")}
    copies: dict[str, typing.Any] = {name: value.copy() for name, value in (places | numbers | counts).items()}
    return Walk(**copies)


@cached_jit
def march_program(membrane, condition, limits, walk, peak, grid: TraceGrid):
    """Walks after a few passes, a bound of the highest q on them, and after every pass: base, tangent, and whether it is new.

    A walk ends with `Code.breakdown` beyond breakdown at the apex, at a load higher than any before on it.
    """
    material = membrane.material

    def one(material, prestretch, condition, limits, walk):
        problem = branch_problem(material, prestretch, condition, limits, grid, MARCH_CONTROL)
        return advance(problem, walk)

    def one_pass(state, _):
        walk, peak = state
        before = walk
        walk, accept = jax.vmap(one)(material, membrane.prestretch, condition, limits, walk)
        apex, q = walk.base[:, 0] * SCALE[0], walk.base[:, 2] * SCALE[2]
        broken = accept & (q * field_ratio_squared(membrane.breakdown, apex, apex) > 1) & (q >= peak)
        code = jnp.where(broken, int(Code.breakdown), walk.code)
        # a fold's load lies above those of its neighbours, and below the control points of the cubic between them
        third = jnp.linalg.norm(walk.base - before.base, axis=1) / 3
        rise, fall = third * before.tangent[:, 2], -third * walk.tangent[:, 2]
        between = jnp.maximum(before.base[:, 2] + rise, walk.base[:, 2] + fall) * SCALE[2]
        highest = jnp.where((rise > 0) & (fall > 0), jnp.maximum(between, q), q)
        peak = jnp.where(accept, jnp.maximum(peak, highest), peak)
        return (walk._replace(code=code), peak), (walk.base, walk.tangent, accept)

    (walk, peak), passed = jax.lax.scan(one_pass, (walk, peak), length=PASSES)
    return tuple(walk), peak, passed


def warm_up(membrane: Membrane) -> None:
    """Starts compiling what a diagram of this kind of membrane needs, all programs side by side."""
    condition = ConstantVoltage(0.0).condition()
    nothing = np.zeros(3)

    def trace_nothing():
        grid = TraceGrid(TRACE_STEPS[0], np.array(TRACE_LOAD_LIMITS[0]), np.ones(3))
        _trace_program(membrane, condition, np.ones(5), (nothing, nothing), False, grid)

    compile_ahead(membrane, (trace_nothing,))
