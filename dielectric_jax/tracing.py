"""Continuation of a membrane's branches from many seeds at once, one compiled program for every loading."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from .continuation import Steps, trace
from .equilibria import SCALE
from .loading import ConstantVoltage
from .materials import largest_load
from .membrane import Membrane
from .programs import compile_ahead
from .results import Code
from .shooting import rim_with_columns

__all__ = ["run_traces", "warm_up"]

_LANES = 8
_STEPS = Steps(first=0.05, largest=1.0, smallest=2e-5, most_turn=0.35, most_correction=0.2, tolerance=1e-4)
_TRACE_STEPS = (
    16.0,
    44.0,
    128.0,
)  # grids of the continuation: the usual one, where an inner layer forms, the last resort
_TOP_NEAR_LOCK_UP = 0.94


@functools.partial(jax.jit, static_argnames="steps")
def _trace_program(material, prestretch, contour, limits, seeds, directions, active, accuracy, steps):
    def linearise(u, args):
        material, prestretch, contour, accuracy = args
        lag, volume, columns = rim_with_columns(material, u, accuracy)
        by_p, by_v, by_q = contour.slopes(volume)
        rim = columns[:, 0].at[0].add(1.0)
        condition = by_v * columns[:, 1] + jnp.stack([jnp.zeros_like(by_p), by_p, by_q])
        value = jnp.stack([lag - (prestretch - u[0]), contour.residual(u[1], volume, u[2])])
        return value, jnp.stack([rim, condition])

    def residual(u, args):
        return linearise(u, args)[0]

    def margins(u, args):
        fraction = u[2] / largest_load(args[0], u[0])
        # where the grid of this accuracy ends: towards lock-up at a high load, and towards the cone
        resolved = jnp.where(
            args[3] >= _TRACE_STEPS[1],
            1.0,
            jnp.maximum(jnp.minimum(0.93 - fraction, limits[4] - u[0]), 0.72 - fraction),
        )
        # towards lock-up no grid resolves the membrane much beyond the scanned loads
        top = jnp.where(u[0] < limits[4], limits[3], jnp.minimum(limits[3], _TOP_NEAR_LOCK_UP))
        box = [u[0] - limits[0], limits[1] - u[0], fraction - limits[2], limits[3] - fraction, top - fraction]
        return jnp.stack([*box, resolved])

    codes = (
        Code.window_stretch,
        Code.lock_up,
        Code.window_load,
        Code.window_load,
        Code.apex_cone,
        Code.beyond_tolerance,
    )

    def lane(seed, direction, active):
        return trace(
            residual,
            seed,
            direction,
            (material, prestretch, contour, accuracy),
            scale=jnp.asarray(SCALE),
            margins=margins,
            codes=codes,
            steps=steps,
            linearise=linearise,
            monitors=lambda u, args: jnp.log(jnp.maximum(1 - u[2] / largest_load(args[0], u[0]), 1e-6)),
            active=active,
        )

    return jax.vmap(lane)(seeds, directions, active)


def run_traces(membrane, contour, limits, seeds, directions, level=0):
    """Traces from many seeds, in groups of one compiled shape: a list of (points, tangents, code).

    A lane that leaves the region its grid resolves goes on from there on the finer grid.
    """
    found = []
    for i in range(0, len(seeds), _LANES):
        part, heading = np.array(seeds[i : i + _LANES]), np.array(directions[i : i + _LANES])
        pad = _LANES - len(part)
        active = np.arange(_LANES) < len(part)
        part, heading = (np.pad(v, ((0, pad), (0, 0)), mode="edge") for v in (part, heading))
        done = _trace_program(
            membrane.material, membrane.prestretch, contour, limits, part, heading, active, _TRACE_STEPS[level], _STEPS
        )
        points, tangents, count, code = (np.asarray(v) for v in done[:4])
        for k in range(int(active.sum())):
            found.append((points[k, : count[k]], tangents[k, : count[k]], Code(int(code[k]))))
    if level + 1 < len(_TRACE_STEPS):
        stuck = (Code.beyond_tolerance, Code.step_too_small)
        more = [k for k, lane in enumerate(found) if lane[2] in stuck and len(lane[0]) > 1]
        alone = [k for k, lane in enumerate(found) if lane[2] in stuck and len(lane[0]) <= 1]
        # go on from the last point inside; a lane that never began starts again at its seed
        starts = [found[k][0][-2] for k in more] + [seeds[k] for k in alone]
        ways = [found[k][1][-2] for k in more] + [directions[k] for k in alone]
        if starts:
            finer = run_traces(membrane, contour, limits, starts, ways, level + 1)
            for k, (points, tangents, code) in zip(more + alone, finer, strict=True):
                if k in more and len(points) < 2:
                    found[k] = (found[k][0][:-1], found[k][1][:-1], Code.step_too_small)
                    continue
                head = found[k][0][:-2] if k in more else found[k][0][:0]
                head_t = found[k][1][:-2] if k in more else found[k][1][:0]
                found[k] = np.concatenate([head, points]), np.concatenate([head_t, tangents]), code
    return found


def warm_up(membrane: Membrane) -> None:
    """Starts compiling what a diagram of this kind of membrane needs, all programs side by side."""
    contour = ConstantVoltage(0.0).contour()
    nothing = np.zeros((_LANES, 3))

    def trace_nothing():
        idle = np.zeros(_LANES, bool)
        limits = np.ones(5)
        _trace_program(
            membrane.material, membrane.prestretch, contour, limits, nothing, nothing, idle, _TRACE_STEPS[0], _STEPS
        )

    compile_ahead(membrane, (trace_nothing,))
