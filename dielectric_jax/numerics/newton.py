"""Roots of one, two or three equations, one root a lane of `vmap`: Newton's method with bounds.

It is a root finder of optimistix, so that roots are differentiated by the implicit function theorem: of f(x, θ) = 0,
dx/dθ = −f_x⁻¹ f_θ. The linear systems are solved in closed form, since an LU decomposition in every lane costs more than the
equations. Lanes neither raise nor wait for the host: `Root.code` says whether a lane converged.
"""

import typing
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .codes import Code

__all__ = ["Root", "SmallSystem", "root_find", "solve_small"]


class Root(eqx.Module):
    """A root, the size of the last move towards it, and the `Code` as an integer: `ok` or `not_converged`.

    Size and code are numbers; for elementwise roots they are arrays of the root's shape.
    """

    value: Float[Array, "*unknowns"]
    move: Float[Array, "*lanes"]
    code: Int[Array, "*lanes"]


def solve_small(matrix: Float[Array, "k k"], right: Float[Array, " k"]) -> Float[Array, " k"]:
    """x with matrix x = right, for one, two or three unknowns, by determinants; infinite or NaN where it is singular.

    Raises ValueError for more unknowns.

    >>> solve_small(jnp.array([[2.0, 1.0], [0.0, 4.0]]), jnp.array([5.0, 4.0])).tolist()
    [2.0, 1.0]
    """
    size = len(right)
    if size == 1:
        return right / matrix[0]
    if size == 2:
        (a, b), (c, d) = matrix
        f, g = right
        return jnp.stack([d * f - b * g, a * g - c * f]) / (a * d - b * c)
    if size == 3:
        a, b, c = matrix.T
        across = jnp.cross(b, c)
        return jnp.stack([right @ across, a @ jnp.cross(right, c), a @ jnp.cross(b, right)]) / (a @ across)
    raise ValueError(f"`right` must hold 1, 2 or 3 numbers, but holds {size}.")


class SmallSystem(lx.AbstractLinearSolver):
    """`solve_small` as a solver of lineax; unknowns and equations have one structure, of 1 to 3 numbers in all.

    >>> operator = lx.MatrixLinearOperator(jnp.array([[2.0, 1.0], [0.0, 4.0]]))
    >>> lx.linear_solve(operator, jnp.array([5.0, 4.0]), SmallSystem()).value.tolist()
    [2.0, 1.0]
    """

    def init(self, operator, options):
        """The matrix; raises ValueError if unknowns and equations differ in structure."""
        if operator.in_structure() != operator.out_structure():
            raise ValueError("`operator` must have unknowns and equations of one structure, but they differ.")
        return operator.as_matrix()

    def compute(self, state, vector, options):
        """The solution."""
        flat, restore = ravel_pytree(vector)
        return restore(solve_small(state, flat)), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        """The matrix of the transposed system."""
        return state.T, options

    def conj(self, state, options):
        """The matrix of the conjugate system."""
        return state.conj(), options

    def assume_full_rank(self):
        """True: singular systems have no solution."""
        return True


class _Moved(eqx.Module):
    """The size of the last move of a root finder."""

    size: Array


class _Newton(optx.AbstractRootFinder):
    """Newton's method whose moves are at most `most_move` in each unknown; `options` may hold `lower` and `upper`.

    With `elementwise` each unknown is the root of its own equation.
    """

    rtol: float
    atol: float
    most_move: float
    elementwise: bool
    norm: typing.ClassVar[Callable] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return _Moved(jnp.full(y.shape if self.elementwise else (), jnp.inf, y.dtype))

    def step(self, fn, y, args, options, state, tags):
        def both(x):
            value, aux = fn(x, args)
            return value, (value, aux)

        if y.ndim == 0 or self.elementwise:
            value, slope, aux = jax.jvp(lambda x: fn(x, args), (y,), (jnp.ones_like(y),), has_aux=True)
            move = value / slope
        else:
            matrix, (value, aux) = jax.jacfwd(both, has_aux=True)(y)
            move = solve_small(matrix, value)
        if self.most_move < np.inf:
            move = jnp.clip(move, -self.most_move, self.most_move)
        new = y - move
        if options:
            new = jnp.clip(new, options.get("lower"), options.get("upper"))
        # a move cut short by a bound counts in full: a point held at a bound is not a root
        size = jnp.abs(move)
        if not self.elementwise:
            return new, _Moved(jnp.max(size)), aux
        # a lost lane stays where it is, so that the others can go on; its move stays infinite or NaN
        return jnp.where(jnp.isfinite(new), new, y), _Moved(size), aux

    def terminate(self, fn, y, args, options, state, tags):
        return jnp.all(state.size <= self.atol), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, *rest):
        return y, aux, {}


def _every_step(cond_fun, body_fun, init_val, *, max_steps):
    """A loop that always makes `max_steps`: masking finished lanes of `vmap` would cost more than a step of a cheap function."""
    return jax.lax.fori_loop(0, max_steps, lambda _, carry: body_fun(carry), init_val)


def _in_every_step(inputs):
    *inputs, iterate, _ = inputs
    return iterate((*inputs, _every_step))


class _EveryStep(optx.ImplicitAdjoint):
    """The derivatives of a root that is found in a fixed number of steps."""

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        return super().apply(_in_every_step, rewrite_fn, (*inputs, primal_fn), tags)


def _found(function, finder, start, args, options, steps: int) -> Root:
    every, elementwise = np.isinf(finder.atol), finder.elementwise
    linear = lx.Diagonal(well_posed=True) if elementwise else SmallSystem()
    solution = optx.root_find(
        function,
        finder,
        start,
        args,
        options,
        max_steps=steps,
        adjoint=(_EveryStep if every else optx.ImplicitAdjoint)(linear),
        tags=frozenset({lx.diagonal_tag} if elementwise else ()),
        throw=False,
    )
    move = solution.state.size
    if every or elementwise:
        good = move <= (np.finfo(float).max if every else finder.atol)
    else:
        good = solution.result == optx.RESULTS.successful
    return Root(solution.value, move, jnp.where(good, int(Code.ok), int(Code.not_converged)))


def root_find(
    function: Callable,
    start,
    args: typing.Any = None,
    *,
    steps: int,
    tolerance: float | None,
    most_move: float = np.inf,
    lower: typing.Any = None,
    upper: typing.Any = None,
    elementwise: bool = False,
) -> Root:
    """A root of f(x, args) = 0 near `start` by Newton's method, x ← x − f_x⁻¹ f, with the derivatives of f by autodiff.

    For one lane; `jax.vmap` gives many. Derivatives of the root by `args`, and by what `function` closes over, are those of
    the implicit function theorem, forward and reverse.

    Args:
        function: f(x, args) of the shape of x, and differentiable.
        start: a number, or one to three, shape (k,).
        args: what `function` takes besides x.
        steps: the largest number of moves.
        tolerance: a lane stops after a move of at most this size in every unknown; the error left is of the order of its
            square. None makes all moves in every lane, which costs less where the function is cheap.
        most_move: the largest move of each unknown.
        lower: lower bounds of the unknowns, where moves end.
        upper: upper bounds of the unknowns.
        elementwise: whether f acts on each element of x alone, so that x may have any shape, and is as many roots. They are
            found together, with fewer operations than under `jax.vmap`.

    Returns:
        The root, the size of its last move, not shortened by the bounds, and a code: `Code.ok`, or `Code.not_converged` if the
        last of `steps` moves was larger than the tolerance, or is not finite.

    Raises ValueError for more than three unknowns.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> root = root_find(lambda x, square: x * x - square, 1.0, 2.0, steps=8, tolerance=1e-8)
    >>> round(float(root.value), 12), int(root.code) == Code.ok
    (1.414213562373, True)
    >>> slope = jax.grad(lambda square: root_find(lambda x, a: x * x - a, 1.0, square, steps=8, tolerance=1e-8).value)(2.0)
    >>> round(float(slope), 12)  # 1/(2 √2)
    0.353553390593
    """
    start = jnp.asarray(start, float)
    if not elementwise and (start.ndim > 1 or not 1 <= start.size <= 3):
        raise ValueError(f"`start` must be a number or hold 1, 2 or 3, but has the shape {start.shape}.")
    options = {name: bound for name, bound in (("lower", lower), ("upper", upper)) if bound is not None}
    finder = _Newton(0.0, np.inf if tolerance is None else tolerance, most_move, elementwise)
    options = jax.lax.stop_gradient(options)
    if not elementwise:
        return _found(function, finder, start, args, options, steps)
    there = jnp.isfinite(start)
    root = _found(function, finder, jnp.where(there, start, 0.0), args, options, steps)
    there &= jnp.isfinite(root.move)
    value, code = jnp.where(there, root.value, jnp.nan), jnp.where(there, root.code, int(Code.not_converged))
    return Root(value, root.move, code)
