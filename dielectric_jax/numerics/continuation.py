"""Pseudo-arclength continuation of residual(u, args) = 0 with n − 1 equations for n unknowns; knows no membrane.

Predictor: along the unit tangent (null vector of the exact Jacobian, in scaled unknowns), bent as between the last two, or
the cubic through the last two points and tangents, which makes longer steps and is less forgiving of noise.
Corrector: Newton on the residual bordered with the hyperplane through the prediction. `advance` is one pass with one
linearisation, `stepped` the same where that is computed elsewhere, `trace` a loop of passes; so lanes under `vmap` never wait for another lane's Newton, and many lanes may be
advanced a few passes at a time, those that have ended making room for others. A walk that has ended changes nothing.

A step is accepted when the remainder of Newton (the square of the last correction) is below the tolerance times the
square of the step, Newton contracted, and the tangent turned by less than the largest turn; else it is halved. The turn bound is what keeps folds
from being stepped over: two folds on one step turn the tangent out of and back into one direction, so the middle
differs, and the middle is seen by the mismatch of prediction and correction, bounded by `most_correction`. Where folds
accumulate towards a point without the tangent turning much, a monitor bounds the step by the distance to that point.
"""

import dataclasses
import enum
import math
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from .codes import Code, check_positive
from .resolution import FIRST_TRIES, FOLD_STEPS, LEAST_GROWTH, MOST_CONTRACTION, MOST_GROWTH, NEWTON_TRIES, OWN_CODES

__all__ = [
    "Fold",
    "Problem",
    "Steps",
    "Trace",
    "Walk",
    "advance",
    "begin",
    "locate_folds",
    "shorter",
    "stepped",
    "trace",
]


@dataclasses.dataclass(frozen=True)
class Steps:
    """Step control of a continuation, in scaled unknowns.

    Argument `most_points` bounds the points a lane may hold (a shape, so it is compiled in); `largest`, `smallest` and
    `first` bound the step length, `most_turn` the angle between tangents of neighbours in radians, `most_correction` the
    distance between prediction and corrected point as a fraction of the step, `most_change` the change of a monitor,
    `most_residual` the residual at which a last Newton step may begin. `cubic` takes the cubic predictor.
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
    cubic: bool = False

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


class Fold(typing.NamedTuple):
    """A point at which one of the unknowns turns, between two points of a trace: `after` counts the first of the two.

    `code` is `Code.ok`, or `Code.not_converged` where Newton's method did not reach it.
    """

    point: np.ndarray
    after: int
    code: Code


class Walk(typing.NamedTuple):
    """A continuation under way, in scaled unknowns; `code` is `Code.ok` while it goes on, then says why it ended."""

    base: Float[Array, " n"]
    tangent: Float[Array, " n"]
    bend: Float[Array, "2 n"]
    trial: Float[Array, " n"]
    origin: Float[Array, " n"]
    heading: Float[Array, " n"]
    watched: Float[Array, " k"]
    step: Float[Array, ""]
    last: Float[Array, ""]
    tries: Int[Array, ""]
    count: Int[Array, ""]
    code: Int[Array, ""]
    evaluations: Int[Array, ""]


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


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is continued: `residual(u, args)` with n − 1 components, `scale` of the n unknowns, and where it ends.

    `residual` may be None where `stepped` is given its value and Jacobian.
    `margins(u, args)` returns one number for each of `codes`, positive inside the box; both sides of every variable
    belong in it. Codes are members of `Code`, or of an `enum.IntEnum` of your own whose numbers are from 1000, so that they
    mean nothing else; `reason` gives the member back. `linearise(u, args)` gives value and Jacobian where a cheaper way than jacfwd of `residual` is known.
    `monitors(u, args)` returns quantities that may change by at most `most_change` a step, such as the logarithm of the
    distance to a point at which folds accumulate. `lengths` holds the smallest and largest step in place of those of
    `steps`, and how far from its start the curve may lie (by default the largest step), without compiling anew; a walk
    that finds the curve farther away ends at once.
    """

    residual: Callable | None
    scale: typing.Any
    margins: Callable
    codes: tuple[enum.IntEnum, ...]
    args: typing.Any = None
    steps: Steps = Steps()
    linearise: Callable | None = None
    monitors: Callable | None = None
    lengths: typing.Any = None

    def __post_init__(self):
        if not self.codes:
            raise ValueError("`codes` must hold one code for each margin, but is empty.")
        for code in self.codes:
            if not (isinstance(code, Code) or (isinstance(code, enum.IntEnum) and OWN_CODES <= code < 2**31)):
                raise ValueError(
                    f"`codes` must hold members of Code, or of an IntEnum with numbers from {OWN_CODES}, but holds {code!r}."
                )

    def reason(self, code) -> enum.IntEnum:
        """The member that the number of a `Trace` or `Walk` stands for."""
        return next((own for own in self.codes if int(own) == int(code)), None) or Code(int(code))

    def linear(self, v):
        """Value and Jacobian at scaled unknowns."""
        if self.linearise is not None:
            value, jacobian = self.linearise(v * self.scale, self.args)
            return value, jacobian * self.scale
        residual = self.residual
        if residual is None:
            raise ValueError("`residual` must be a function, but is None.")

        def both(v):
            value = residual(v * self.scale, self.args)
            return value, value

        jacobian, value = jax.jacfwd(both, has_aux=True)(v)
        return value, jacobian

    def watch(self, v):
        """The monitors at scaled unknowns."""
        return jnp.atleast_1d(self.monitors(v * self.scale, self.args)) if self.monitors is not None else jnp.zeros(1)


def _bordered(jacobian, value, normal, excess):
    """Newton's move with normal·move = −excess, and the unit tangent on the side of `normal`."""
    if len(normal) == 3:
        columns = [jnp.cross(jacobian[1], normal), jnp.cross(normal, jacobian[0]), jnp.cross(*jacobian)]
        determinant = jacobian[0] @ columns[0]
        move = -(value[0] * columns[0] + value[1] * columns[1] + excess * columns[2]) / determinant
        tangent = columns[2] / determinant
    else:
        matrix = jnp.concatenate([jacobian, normal[None]])
        right = jnp.concatenate([-value, -excess[None]])
        border = jnp.zeros(len(normal)).at[-1].set(1.0)
        move, tangent = jnp.linalg.solve(matrix, jnp.stack([right, border], axis=1)).T
    return move, tangent / jnp.linalg.norm(tangent)


def _bend(before, here, tangent_before, tangent, cubic):
    """Second and third derivative by the arclength, at the second of two points, of the predictor through both."""
    length = jnp.linalg.norm(here - before)
    chord = (here - before) / length
    second = jnp.where(cubic, 2 * tangent_before + 4 * tangent - 6 * chord, tangent - tangent_before) / length
    return jnp.stack([second, jnp.where(cubic, 6 * (tangent_before + tangent - 2 * chord), 0.0) / length**2])


def _predict(base, tangent, bend, step):
    return base + step * tangent + step**2 / 2 * bend[0] + step**3 / 6 * bend[1]


def begin(problem: Problem, start, direction, active: typing.Any = True) -> Walk:
    """A walk about to begin near `start` on the side of `direction`; with `active=False` one that has ended (padding)."""
    at = jnp.asarray(start, float) / problem.scale
    heading = direction / problem.scale
    heading = heading / jnp.linalg.norm(heading)
    return Walk(
        base=at,
        tangent=heading,
        bend=jnp.zeros((2, *at.shape)),
        trial=at,
        origin=at,
        heading=heading,
        watched=problem.watch(at),
        step=jnp.asarray(0.0),
        last=jnp.asarray(jnp.inf),
        tries=jnp.asarray(0),
        count=jnp.asarray(0),
        code=jnp.where(jnp.asarray(active), int(Code.ok), int(Code.not_converged)),
        evaluations=jnp.asarray(0),
    )


class _Corrected(typing.NamedTuple):
    """The trial point after one step of Newton, and what step control asks of it.

    `size` is the length of the step, `settled` whether Newton has converged; `turn` is the angle between the tangents,
    `offset` the distance from the prediction, `change` that of the monitors `watched` since the last point.
    """

    point: Array
    tangent: Array
    size: Array
    settled: Array
    turn: Array
    offset: Array
    watched: Array
    change: Array


class _Verdict(typing.NamedTuple):
    """Whether the walk goes on, whether its trial is accepted as a point, and whether its step has failed."""

    going: Array
    accept: Array
    failing: Array


class _Place(typing.NamedTuple):
    """Where a point lies: outside which margin, and whether it closes a loop; origin and heading of the walk."""

    outside: Array
    margin: Array
    origin: Array
    heading: Array
    closed: Array


def _correct(problem: Problem, s: Walk, linear, first) -> _Corrected:
    steps = problem.steps
    anchor = _predict(s.base, s.tangent, s.bend, s.step)
    value, jacobian = linear
    move, tangent = _bordered(jacobian, value, s.tangent, s.tangent @ (s.trial - anchor))
    size = jnp.linalg.norm(move)
    tangent = tangent * jnp.where(tangent @ s.tangent < 0, -1.0, 1.0)
    corrected = s.trial + move
    settled = size**2 <= steps.tolerance * jnp.where(first, 1.0, jnp.minimum(s.step, 1.0) ** 2)
    settled &= jnp.max(jnp.abs(value)) <= steps.most_residual
    turn = jnp.arccos(jnp.clip(tangent @ s.tangent, -1.0, 1.0))
    offset = jnp.linalg.norm(corrected - anchor)
    watched = problem.watch(corrected)
    change = jnp.max(jnp.abs(watched - s.watched))
    change = jnp.where(jnp.isfinite(change), change, jnp.inf)
    return _Corrected(corrected, tangent, size, settled, turn, offset, watched, change)


def _judge(steps: Steps, s: Walk, new: _Corrected, first, farthest) -> _Verdict:
    straight = (new.change <= steps.most_change) & (new.turn <= steps.most_turn)
    straight = straight & (new.offset <= steps.most_correction * s.step)
    straight = jnp.where(first, new.offset <= farthest, straight)
    finite = jnp.all(jnp.isfinite(new.point)) & jnp.all(jnp.isfinite(new.tangent))
    going = s.code == int(Code.ok)
    accept = going & finite & new.settled & straight
    failing = ~finite | (new.settled & ~straight) | (new.size > MOST_CONTRACTION * s.last) | (s.tries >= NEWTON_TRIES)
    # the first point is only corrected: it has no step to shorten
    failing = jnp.where(first, ~finite | (new.settled & ~straight) | (s.tries >= FIRST_TRIES), failing & ~accept)
    return _Verdict(going, accept, failing)


def _place(problem: Problem, s: Walk, new: _Corrected, first) -> _Place:
    inside = jnp.where(jnp.isfinite(new.point), new.point, 0.0) * problem.scale
    margin = problem.margins(inside, problem.args)
    outside = jnp.any(margin < 0)
    which = jnp.argmin(margin)
    origin, heading = (jnp.where(first, a, b) for a, b in ((new.point, s.origin), (new.tangent, s.heading)))
    travelled = jnp.linalg.norm(new.point - origin)
    closed = (
        (s.count > 3)
        & (travelled <= jnp.linalg.norm(new.point - s.base))
        & (new.tangent @ heading > 0.5)
        & ((new.point - origin) @ heading >= 0)
    )
    return _Place(outside, which, origin, heading, closed)


def _grown(steps: Steps, s: Walk, new: _Corrected, smallest, largest):
    """The length of the step after an accepted one: so that turn, offset and change come to half of their bounds or so."""
    ease = jnp.minimum(
        0.5 * steps.most_turn / (new.turn + 1e-12), 0.5 * steps.most_correction * s.step / (new.offset + 1e-300)
    )
    ease = jnp.minimum(ease, (0.6 * steps.most_change / (new.change + 1e-12)) ** 2)
    return jnp.clip(s.step * jnp.clip(jnp.sqrt(ease), LEAST_GROWTH, MOST_GROWTH), smallest, largest)


def advance(problem: Problem, s: Walk) -> tuple[Walk, Array]:
    """One pass: the walk after one linearisation, and whether it now stands on a new point (its `base`)."""
    return stepped(problem, s, *problem.linear(s.trial))


def shorter(s: Walk) -> Walk:
    """The walk back on its last point, from where it goes half as far."""
    step = 0.5 * s.step
    return s._replace(
        step=step, trial=_predict(s.base, s.tangent, s.bend, step), last=jnp.asarray(jnp.inf), tries=jnp.asarray(0)
    )


def stepped(problem: Problem, s: Walk, value, jacobian) -> tuple[Walk, Array]:
    """`advance` with value and Jacobian (n − 1, n) at the walk's `trial`, all in scaled unknowns; NaN means that there is none."""
    steps = problem.steps
    given = (steps.smallest, steps.largest, steps.largest) if problem.lengths is None else problem.lengths
    smallest, largest, farthest = given
    first = s.count == 0
    new = _correct(problem, s, (value, jacobian), first)
    going, accept, failing = _judge(steps, s, new, first, farthest)
    place = _place(problem, s, new, first)
    count = s.count + accept

    grown = _grown(steps, s, new, smallest, largest)
    step = jnp.where(accept, jnp.where(first, steps.first, grown), jnp.where(failing, 0.5 * s.step, s.step))
    base = jnp.where(accept, new.point, s.base)
    ahead = jnp.where(accept, new.tangent, s.tangent)
    # no bend from a step that was never taken
    bend = jnp.where(first, 0.0, _bend(s.base, new.point, s.tangent, new.tangent, steps.cubic))
    bend = jnp.where(accept, jnp.where(jnp.all(jnp.isfinite(bend)), bend, 0.0), s.bend)
    restart = accept | failing
    trial = jnp.where(restart, _predict(base, ahead, bend, step), new.point)

    code = jnp.asarray(int(Code.ok))
    code = jnp.where(count >= steps.most_points, int(Code.too_many_points), code)
    code = jnp.where(accept & place.closed, int(Code.closed), code)
    code = jnp.where(accept & place.outside, jnp.asarray([int(c) for c in problem.codes])[place.margin], code)
    code = jnp.where(failing & (first | (step < smallest)), int(Code.step_too_small), code)
    after = Walk(
        base=base,
        tangent=ahead,
        bend=bend,
        trial=trial,
        origin=jnp.where(accept, place.origin, s.origin),
        heading=jnp.where(accept, place.heading, s.heading),
        watched=jnp.where(accept, new.watched, s.watched),
        step=step,
        last=jnp.where(restart, jnp.inf, new.size),
        tries=jnp.where(restart, 0, s.tries + 1),
        count=count,
        code=code,
        evaluations=s.evaluations + 1,
    )
    return jax.tree.map(lambda a, b: jnp.where(going, a, b), after, s), accept


def trace(
    problem: Problem, start: Float[Array, " n"], direction: Float[Array, " n"], active: typing.Any = True
) -> Trace:
    """Follows the curve through `start` on the side of `direction` until a margin turns negative or it closes.

    `active=False` ends it at once (padding). Under `jax.vmap` every lane has its own step.

    >>> import jax.numpy as jnp
    >>> circle = Problem(lambda u, args: jnp.array([u @ u - 1.0]), scale=jnp.ones(2),
    ...                margins=lambda u, args: jnp.array([2.0 - jnp.abs(u[0])]), codes=(Code.window_load,))
    >>> found = trace(circle, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    >>> Code(int(found.code)).name
    'closed'
    """
    most, n = problem.steps.most_points, len(start)
    nothing = jnp.full((most, n), jnp.nan)

    def body(state):
        walk, points, tangents = state
        slot = jnp.minimum(walk.count, most - 1)
        walk, accept = advance(problem, walk)
        points, tangents = (
            store.at[slot].set(jnp.where(accept, v, store[slot]))
            for store, v in ((points, walk.base), (tangents, walk.tangent))
        )
        return walk, points, tangents

    initial = begin(problem, start, direction, active), nothing, nothing
    end, points, tangents = jax.lax.while_loop(lambda s: s[0].code == int(Code.ok), body, initial)
    return Trace(points * problem.scale, tangents * problem.scale, end.count, end.code, end.evaluations)


def locate_folds(problem: Problem, found: Trace, unknown: int, tolerance: float = 1e-12) -> list[Fold]:
    """The folds of one lane of `trace`: points at which du_k = 0 along the curve for the unknown k, exact by Newton's method.

    A fold is a root of F(u) = 0 and det(∂F/∂u without column k) = 0, whose starts are the changes of sign of the tangent's
    entry k; so folds must not be closer to each other than the points are. Outside transformations only.

    Args:
        problem: what was continued, with a `residual`.
        found: the points and tangents of one lane.
        unknown: k, from 0 to n − 1.
        tolerance: of the last move of Newton's method, relative and absolute in scaled unknowns.

    Raises ValueError for a problem without a residual, a number that is no unknown's, and a tolerance that is not positive.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> circle = Problem(lambda u, args: jnp.array([u @ u - 2.0]), scale=jnp.ones(2),
    ...                margins=lambda u, args: jnp.array([2.0 - jnp.abs(u[0])]), codes=(Code.window_load,))
    >>> folds = locate_folds(circle, trace(circle, jnp.array([1.0, 1.0]), jnp.array([-1.0, 1.0])), 1)
    >>> [(fold.point.round(12) + 0.0).tolist() for fold in folds]
    [[0.0, 1.414213562373], [0.0, -1.414213562373]]
    """
    if found.points.ndim != 2:
        raise ValueError("`found` must be one lane of a trace, but holds several.")
    if problem.residual is None:
        raise ValueError("`problem` must have a residual for its folds to be located, but has None.")
    count, size = int(found.count), found.points.shape[-1]
    if not (isinstance(unknown, int) and not isinstance(unknown, bool) and 0 <= unknown < size):
        raise ValueError(f"`unknown` must be a number from 0 to {size - 1}, but is {unknown!r}.")
    check_positive("tolerance", tolerance)
    heading = np.asarray(found.tangents)[:count, unknown]
    after = np.flatnonzero((heading[:-1] * heading[1:] <= 0) & (heading[:-1] != 0))
    if not len(after):
        return []
    points = np.asarray(found.points / problem.scale)
    share = (heading[after] / (heading[after] - heading[after + 1]))[:, None]
    starts = points[after] + share * (points[after + 1] - points[after])

    def equations(v, _):
        value, jacobian = problem.linear(v)
        return jnp.append(value, jnp.linalg.det(jnp.delete(jacobian, unknown, axis=1, assume_unique_indices=True)))

    finder = optx.Newton(rtol=tolerance, atol=tolerance)
    solve = jax.vmap(lambda start: optx.root_find(equations, finder, start, max_steps=FOLD_STEPS, throw=False))
    solved = jax.jit(solve)(starts)
    reached = np.asarray(solved.result == optx.RESULTS.successful)
    codes = [Code.ok if ok else Code.not_converged for ok in reached]
    return [
        Fold(point, int(k), code)
        for point, k, code in zip(np.asarray(solved.value * problem.scale), after, codes, strict=True)
    ]
