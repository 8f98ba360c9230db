"""Pseudo-arclength continuation of residual(u, args) = 0 with n − 1 equations for n unknowns; knows no membrane.

Predictor: along the unit tangent (null vector of the exact Jacobian, in scaled unknowns). Corrector: Newton on the
residual bordered with the hyperplane through the prediction. The loop is flat, one linearisation a pass, so that
lanes under `vmap` never wait for another lane's Newton; a lane that has ended changes nothing.

A step is accepted when the remainder of Newton (the square of the last correction) is below the tolerance, Newton
contracted, and the tangent turned by less than the largest turn; else it is halved. The turn bound is what keeps folds
from being stepped over: two folds on one step turn the tangent out of and back into one direction, so the middle
differs, and the middle is seen by the mismatch of prediction and correction, bounded by `most_correction`.
"""

import dataclasses
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
    distance between prediction and corrected point as a fraction of the step.
    """

    first: float = 0.1
    largest: float = 1.0
    smallest: float = 1e-7
    most_turn: float = 0.35
    most_correction: float = 0.15
    tolerance: float = 1e-6
    most_points: int = 400

    def __post_init__(self):
        for name in ("first", "largest", "smallest", "most_turn", "most_correction", "tolerance", "most_points"):
            if not getattr(self, name) > 0:
                raise ValueError(f"`{name}` must be positive, but is {getattr(self, name)!r}.")
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
    active: typing.Any = True,
) -> Trace:
    """Follows the curve through `start` on the side of `direction` until a margin turns negative or it closes.

    `margins(u, args)` returns one number for each of `codes`, positive inside the box; both sides of every variable
    belong in it. `start` need only be near the curve. `active=False` ends the lane at once (padding). Under `jax.vmap`
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

    def linearise(v):
        def scaled(v):
            return residual(v * scale, args)

        # one pass for value and Jacobian
        def both(v):
            value = scaled(v)
            return value, value

        jacobian, value = jax.jacfwd(both, has_aux=True)(v)
        return value, jacobian

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
        anchor = s["base"] + s["step"] * s["tangent"]
        value, jacobian = linearise(s["trial"])
        move, tangent = newton(s["trial"], value, jacobian, s["tangent"], anchor)
        size = jnp.linalg.norm(move)
        tangent = tangent * jnp.where(tangent @ s["tangent"] < 0, -1.0, 1.0)
        corrected = s["trial"] + move
        settled = size**2 <= steps.tolerance
        turn = jnp.arccos(jnp.clip(tangent @ s["tangent"], -1.0, 1.0))
        offset = jnp.linalg.norm(corrected - anchor)
        straight = first | ((turn <= steps.most_turn) & (offset <= steps.most_correction * s["step"]))
        finite = jnp.all(jnp.isfinite(corrected)) & jnp.all(jnp.isfinite(tangent))
        accept = finite & settled & straight
        failing = ~finite | (settled & ~straight) | (size > 0.5 * s["last"]) | (s["tries"] >= 6)
        # the first point is only corrected: it has no step to shorten
        failing = jnp.where(first, ~finite | (s["tries"] >= 20), failing & ~accept)

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

        ease = jnp.minimum(0.5 * steps.most_turn / (turn + 1e-12), 0.5 * steps.most_correction * s["step"] / (offset + 1e-300))
        grown = jnp.clip(s["step"] * jnp.clip(jnp.sqrt(ease), 0.5, 2.0), steps.smallest, steps.largest)
        step = jnp.where(accept, jnp.where(first, steps.first, grown), jnp.where(failing, 0.5 * s["step"], s["step"]))
        base = jnp.where(accept, corrected, s["base"])
        ahead = jnp.where(accept, tangent, s["tangent"])
        restart = accept | failing
        trial = jnp.where(restart, base + step * ahead, corrected)

        code = jnp.asarray(int(Code.ok))
        code = jnp.where(count >= steps.most_points, int(Code.too_many_points), code)
        code = jnp.where(accept & closed, int(Code.closed), code)
        code = jnp.where(accept & outside, jnp.asarray([int(c) for c in codes])[which], code)
        code = jnp.where(failing & (first | (step < steps.smallest)), int(Code.step_too_small), code)
        new = dict(
            base=base,
            tangent=ahead,
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
