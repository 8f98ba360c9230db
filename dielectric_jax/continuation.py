"""Pseudo-arclength continuation of residual(u, args) = 0 with n − 1 equations for n unknowns; knows no membrane.

Predictor: along the unit tangent (null vector of the exact Jacobian, in scaled unknowns), bent as between the last two. Corrector: Newton on the
residual bordered with the hyperplane through the prediction. The loop is flat, one linearisation a pass, so that
lanes under `vmap` never wait for another lane's Newton; a lane that has ended changes nothing.

A step is accepted when the remainder of Newton (the square of the last correction) is below the tolerance times the
square of the step, Newton contracted, and the tangent turned by less than the largest turn; else it is halved. The turn bound is what keeps folds
from being stepped over: two folds on one step turn the tangent out of and back into one direction, so the middle
differs, and the middle is seen by the mismatch of prediction and correction, bounded by `most_correction`. Where folds
accumulate towards a point without the tangent turning much, a monitor bounds the step by the distance to that point.
"""

import dataclasses
import math
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .results import Code

__all__ = ["Steps", "Trace", "trace"]


@dataclasses.dataclass(frozen=True)
class Steps:
    """Step control of a continuation, in scaled unknowns.

    Argument `most_points` bounds the points a lane may hold (a shape, so it is compiled in); `largest`, `smallest` and
    `first` bound the step length, `most_turn` the angle between tangents of neighbours in radians, `most_correction` the
    distance between prediction and corrected point as a fraction of the step, `most_change` the change of a monitor,
    `most_residual` the residual at which a last Newton step may begin.
    """

    first: float = 0.1
    largest: float = 1.0
    smallest: float = 1e-7
    most_turn: float = 0.35
    most_correction: float = 0.15
    most_change: float = 0.4
    most_residual: float = math.inf
    tolerance: float = 1e-6
    most_points: int = 400

    def __post_init__(self):
        for name in (
            "first",
            "largest",
            "smallest",
            "most_turn",
            "most_correction",
            "most_change",
            "most_residual",
            "tolerance",
            "most_points",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"`{name}` must be positive, but is {getattr(self, name)!r}.")
        if not self.largest <= 2:
            raise ValueError(f"`largest` must be at most 2 in scaled unknowns, but is {self.largest!r}.")
        if not self.smallest <= self.first <= self.largest:
            raise ValueError(
                f"`first` must lie between `smallest` {self.smallest:g} and `largest` {self.largest:g}, but is {self.first!r}."
            )
        if not self.tolerance <= 1e-3:
            raise ValueError(f"`tolerance` must be at most 0.001, but is {self.tolerance!r}.")
        if not self.most_turn <= 1.0:
            raise ValueError(f"`most_turn` must be at most 1 radian, but is {self.most_turn!r}.")
        if not self.most_correction <= 0.5:
            raise ValueError(f"`most_correction` must be at most 0.5, but is {self.most_correction!r}.")


class Trace(typing.NamedTuple):
    """Points of one lane in order, NaN after `count`; `code` (a `Code`) says why it ended.

    Shapes: points and tangents (most_points, n), the rest (). With a code of the window the last point lies outside:
    the boundary is crossed between the last two.
    """

    points: Float[Array, "most n"]
    tangents: Float[Array, "most n"]
    count: Int[Array, ""]
    code: Int[Array, ""]
    evaluations: Int[Array, ""]


def trace(
    residual: Callable,
    start: Float[Array, " n"],
    direction: Float[Array, " n"],
    args: typing.Any = None,
    *,
    scale: Float[Array, " n"],
    margins: Callable,
    codes: tuple[Code, ...],
    steps: Steps = Steps(),
    linearise: Callable | None = None,
    monitors: Callable | None = None,
    lengths: typing.Any = None,
    active: typing.Any = True,
) -> Trace:
    """Follows the curve through `start` on the side of `direction` until a margin turns negative or it closes.

    `margins(u, args)` returns one number for each of `codes`, positive inside the box; both sides of every variable
    belong in it. `linearise(u, args)` gives value and Jacobian where a cheaper way than jacfwd of `residual` is known.
    `monitors(u, args)` returns quantities that may change by at most `most_change` a step, such as the logarithm of the
    distance to a point at which folds accumulate. `lengths` holds the smallest and largest step in place of those of
    `steps`, and how far from `start` the curve may be met (by default the largest step), without compiling anew; a lane
    that meets the curve farther away ends at once. `active=False` ends the lane at once too (padding). Under `jax.vmap`
    every lane has its own step.

    >>> import jax.numpy as jnp
    >>> circle = lambda u, args: jnp.array([u @ u - 1.0])
    >>> found = trace(circle, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), scale=jnp.ones(2),
    ...               margins=lambda u, args: jnp.array([2.0 - jnp.abs(u[0])]), codes=(Code.window_load,))
    >>> Code(int(found.code)).name
    'closed'
    """
    n = start.shape[0]
    start = jnp.asarray(start, float)
    smallest, largest, farthest = (steps.smallest, steps.largest, steps.largest) if lengths is None else lengths

    def linear(v):
        if linearise is not None:
            value, jacobian = linearise(v * scale, args)
            return value, jacobian * scale

        def both(v):
            value = residual(v * scale, args)
            return value, value

        jacobian, value = jax.jacfwd(both, has_aux=True)(v)
        return value, jacobian

    def watch(v):
        return jnp.atleast_1d(monitors(v * scale, args)) if monitors is not None else jnp.zeros(1)

    border = jnp.zeros(n).at[-1].set(1.0)
    begin = start / scale
    heading = direction / scale

    def newton(v, value, jacobian, normal, anchor):
        matrix = jnp.concatenate([jacobian, normal[None]])
        right = jnp.concatenate([-value, -(normal @ (v - anchor))[None]])
        both = jnp.linalg.solve(matrix, jnp.stack([right, border], axis=1))
        tangent = both[:, 1] / jnp.linalg.norm(both[:, 1])
        return both[:, 0], tangent

    heading = heading / jnp.linalg.norm(heading)
    initial = dict(
        base=begin,
        tangent=heading,
        bend=jnp.zeros(n),
        watched=watch(begin),
        step=jnp.asarray(0.0),
        trial=begin,
        last=jnp.asarray(jnp.inf),
        tries=jnp.asarray(0),
        points=jnp.full((steps.most_points, n), jnp.nan),
        tangents=jnp.full((steps.most_points, n), jnp.nan),
        count=jnp.asarray(0),
        code=jnp.where(jnp.asarray(active), int(Code.ok), int(Code.not_converged)),
        evaluations=jnp.asarray(0),
    )

    def going(s):
        return s["code"] == int(Code.ok)

    def body(s):
        first = s["count"] == 0
        anchor = s["base"] + s["step"] * s["tangent"] + s["step"] ** 2 / 2 * s["bend"]
        value, jacobian = linear(s["trial"])
        move, tangent = newton(s["trial"], value, jacobian, s["tangent"], anchor)
        size = jnp.linalg.norm(move)
        tangent = tangent * jnp.where(tangent @ s["tangent"] < 0, -1.0, 1.0)
        corrected = s["trial"] + move
        settled = size**2 <= steps.tolerance * jnp.where(first, 1.0, jnp.minimum(s["step"], 1.0) ** 2)
        settled &= jnp.max(jnp.abs(value)) <= steps.most_residual
        turn = jnp.arccos(jnp.clip(tangent @ s["tangent"], -1.0, 1.0))
        offset = jnp.linalg.norm(corrected - anchor)
        change = jnp.max(jnp.abs(watch(corrected) - s["watched"]))
        change = jnp.where(jnp.isfinite(change), change, jnp.inf)
        straight = (
            (change <= steps.most_change) & (turn <= steps.most_turn) & (offset <= steps.most_correction * s["step"])
        )
        straight = jnp.where(first, offset <= farthest, straight)
        finite = jnp.all(jnp.isfinite(corrected)) & jnp.all(jnp.isfinite(tangent))
        accept = finite & settled & straight
        failing = ~finite | (settled & ~straight) | (size > 0.5 * s["last"]) | (s["tries"] >= 6)
        # the first point is only corrected: it has no step to shorten
        failing = jnp.where(first, ~finite | (settled & ~straight) | (s["tries"] >= 20), failing & ~accept)

        inside = jnp.where(jnp.isfinite(corrected), corrected, 0.0) * scale
        margin = margins(inside, args)
        outside = jnp.any(margin < 0)
        which = jnp.argmin(margin)
        travelled = jnp.linalg.norm(corrected - s["points"][0])
        closed = (
            (s["count"] > 3)
            & (travelled <= jnp.linalg.norm(corrected - s["base"]))
            & (tangent @ s["tangents"][0] > 0.5)
            & ((corrected - s["points"][0]) @ s["tangents"][0] >= 0)
        )

        slot = jnp.minimum(s["count"], steps.most_points - 1)
        points = s["points"].at[slot].set(jnp.where(accept, corrected, s["points"][slot]))
        tangents = s["tangents"].at[slot].set(jnp.where(accept, tangent, s["tangents"][slot]))
        count = s["count"] + accept

        ease = jnp.minimum(
            0.5 * steps.most_turn / (turn + 1e-12), 0.5 * steps.most_correction * s["step"] / (offset + 1e-300)
        )
        ease = jnp.minimum(ease, (0.6 * steps.most_change / (change + 1e-12)) ** 2)
        grown = jnp.clip(s["step"] * jnp.clip(jnp.sqrt(ease), 0.5, 2.0), smallest, largest)
        step = jnp.where(accept, jnp.where(first, steps.first, grown), jnp.where(failing, 0.5 * s["step"], s["step"]))
        base = jnp.where(accept, corrected, s["base"])
        ahead = jnp.where(accept, tangent, s["tangent"])
        # dt/ds from the last two tangents; no bend from a step that was never taken
        bend = (tangent - s["tangent"]) / jnp.where(first, jnp.inf, jnp.linalg.norm(corrected - s["base"]))
        bend = jnp.where(accept, jnp.where(jnp.all(jnp.isfinite(bend)), bend, 0.0), s["bend"])
        restart = accept | failing
        trial = jnp.where(restart, base + step * ahead + step**2 / 2 * bend, corrected)

        code = jnp.asarray(int(Code.ok))
        code = jnp.where(count >= steps.most_points, int(Code.too_many_points), code)
        code = jnp.where(accept & closed, int(Code.closed), code)
        code = jnp.where(accept & outside, jnp.asarray([int(c) for c in codes])[which], code)
        code = jnp.where(failing & (first | (step < smallest)), int(Code.step_too_small), code)
        new = dict(
            base=base,
            tangent=ahead,
            bend=bend,
            watched=jnp.where(accept, watch(corrected), s["watched"]),
            step=step,
            trial=trial,
            last=jnp.where(restart, jnp.inf, size),
            tries=jnp.where(restart, 0, s["tries"] + 1),
            points=points,
            tangents=tangents,
            count=count,
            code=code,
            evaluations=s["evaluations"] + 1,
        )
        return jax.tree.map(lambda a, b: jnp.where(going(s), a, b), new, s)

    end = jax.lax.while_loop(going, body, initial)
    return Trace(end["points"] * scale, end["tangents"] * scale, end["count"], end["code"], end["evaluations"])
