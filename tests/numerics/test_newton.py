"""Roots of small systems, against roots in closed form and their derivatives."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from dielectric_jax.numerics import Code, SmallSystem, root_find, solve_small

ULP = np.finfo(float).eps


def circle_and_line(x, args):
    """x² + y² = r² and y = m x: the root is r (1, m)/√(1 + m²)."""
    radius, slope = args
    return jnp.stack([x[0] ** 2 + x[1] ** 2 - radius**2, x[1] - slope * x[0]])


def crossing(radius, slope):
    return radius * np.array([1.0, slope]) / np.sqrt(1 + slope**2)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_small_systems_are_those_of_numpy(size):
    rng = np.random.default_rng(size)
    matrix, right = rng.normal(size=(256, size, size)), rng.normal(size=(256, size))
    found = jax.vmap(solve_small)(matrix, right)
    exact = np.linalg.solve(matrix, right[..., None])[..., 0]
    condition = np.linalg.cond(matrix)[:, None]
    assert np.all(np.abs(found - exact) <= 20 * ULP * condition * np.abs(exact).max(axis=1, keepdims=True))


def test_a_larger_system_is_refused():
    with pytest.raises(ValueError, match="must hold 1, 2 or 3 numbers, but holds 4"):
        solve_small(jnp.eye(4), jnp.ones(4))
    with pytest.raises(ValueError, match=r"must be a number or hold 1, 2 or 3, but has the shape \(4,\)"):
        root_find(lambda x, _: x, jnp.ones(4), steps=2, tolerance=0.0)


def test_lineax_takes_the_closed_form_and_its_transpose():
    matrix, right = jnp.array([[2.0, 1.0, 0.5], [0.0, 4.0, -1.0], [1.0, 0.0, 3.0]]), jnp.array([1.0, 2.0, 3.0])
    operator = lx.MatrixLinearOperator(matrix)
    for own, other in ((operator, matrix), (operator.T, matrix.T)):
        found = lx.linear_solve(own, right, SmallSystem()).value
        assert np.allclose(found, np.linalg.solve(other, right), rtol=4 * ULP, atol=0)
    with pytest.raises(ValueError, match="unknowns and equations of one structure"):
        lx.linear_solve(lx.MatrixLinearOperator(jnp.ones((2, 3))), jnp.ones(2), SmallSystem())


def test_a_scalar_root_and_its_derivatives():
    def root(a):
        return root_find(lambda x, a: x**3 - a, 1.5, a, steps=20, tolerance=1e-9).value

    a = 5.0
    assert abs(root(a) - a ** (1 / 3)) < 4 * ULP
    assert abs(jax.grad(root)(a) - a ** (-2 / 3) / 3) < 4 * ULP
    assert abs(jax.jacfwd(root)(a) - a ** (-2 / 3) / 3) < 4 * ULP
    assert abs(jax.grad(jax.grad(root))(a) + 2 / 9 * a ** (-5 / 3)) < 8 * ULP


@pytest.mark.parametrize("tolerance", [1e-9, None])
def test_256_lanes_of_two_equations_and_their_derivatives(tolerance):
    radius, slope = np.meshgrid(np.linspace(0.5, 3.0, 16), np.linspace(-2.0, 2.0, 16))
    args = jnp.array(radius.ravel()), jnp.array(slope.ravel())

    def root(*args):
        return root_find(circle_and_line, jnp.array([1.0, 0.0]), args, steps=12, tolerance=tolerance)

    found = jax.jit(jax.vmap(root))(*args)
    exact = np.array([crossing(r, m) for r, m in zip(*map(np.asarray, args), strict=True)])
    assert (found.code == int(Code.ok)).all()
    assert np.abs(found.value - exact).max() < 1e-14
    by_radius, by_slope = jax.vmap(jax.jacrev(lambda *args: root(*args).value, argnums=(0, 1)))(*args)
    r, m = (np.asarray(v)[:, None] for v in args)
    assert np.abs(by_radius - exact / r).max() < 1e-13
    exact_slope = r * np.concatenate([-m, np.ones_like(m)], axis=1) / (1 + m**2) ** 1.5
    assert np.abs(by_slope - exact_slope).max() < 1e-13


def test_three_equations():
    def equations(x, total):  # x + y + z, x y + y z + z x, x y z of 1, 2, 3
        a, b, c = x
        return jnp.stack([a + b + c - total, a * b + b * c + c * a - 11.0, a * b * c - 6.0])

    def root(total):
        return root_find(equations, jnp.array([0.9, 2.1, 3.2]), total, steps=20, tolerance=1e-10)

    assert np.abs(root(6.0).value - np.array([1.0, 2.0, 3.0])).max() < 1e-14
    # of the roots x of x³ − s x² + 11 x − 6: dx/ds = x²/(3 x² − 2 s x + 11)
    assert np.abs(jax.jacfwd(lambda s: root(s).value)(6.0) - np.array([0.5, -4.0, 4.5])).max() < 1e-12


def test_derivatives_reach_what_a_function_closes_over():
    def root(a):
        return root_find(lambda x, _: jnp.exp(x) - a, 0.0, steps=20, tolerance=1e-10).value

    assert abs(jax.grad(root)(3.0) - 1 / 3) < 4 * ULP


def test_bounds_are_kept_and_what_they_hold_is_no_root():
    def root(lower, upper):
        return root_find(
            lambda x, _: x * x - 4.0, 0.5, steps=30, tolerance=1e-9, lower=jnp.asarray(lower), upper=jnp.asarray(upper)
        )

    inside, outside = root(0.1, 3.0), root(0.1, 1.5)
    assert inside.value == 2.0 and inside.code == int(Code.ok)
    assert outside.value == 1.5 and outside.code == int(Code.not_converged)


def test_moves_are_no_longer_than_allowed():
    one = root_find(lambda x, _: x - 10.0, 0.0, steps=1, tolerance=None, most_move=0.5)
    assert one.value == 0.5 and one.move == 0.5
    assert root_find(lambda x, _: x - 10.0, 0.0, steps=3, tolerance=1e-9, most_move=0.5).code == int(Code.not_converged)


@pytest.mark.parametrize("elementwise", [False, True])
def test_lanes_that_fail_say_so_and_leave_the_others_alone(elementwise):
    # x² = a: without a root for a < 0, undefined for NaN
    squares = jnp.array([4.0, -1.0, 9.0, jnp.nan, 2.0])

    def root(start, square):
        return root_find(lambda x, a: x * x - a, start, square, steps=40, tolerance=1e-9, elementwise=elementwise)

    found = (root if elementwise else jax.vmap(root))(jnp.ones(5), squares)
    good = np.array([True, False, True, False, True])
    assert ((np.asarray(found.code) == int(Code.ok)) == good).all()
    assert (np.asarray(found.code)[~good] == int(Code.not_converged)).all()
    assert np.abs(found.value[good] - np.sqrt(squares[good])).max() < 4 * ULP
    assert np.isnan(found.value[3])


@pytest.mark.parametrize("tolerance", [1e-9, None])
def test_elementwise_roots_and_their_derivatives(tolerance):
    squares = jnp.linspace(0.5, 40.0, 256)

    def roots(squares):
        start = jnp.full_like(squares, 2.0)
        return root_find(lambda x, a: x * x - a, start, squares, steps=12, tolerance=tolerance, elementwise=True)

    assert np.abs(roots(squares).value / np.sqrt(squares) - 1).max() < 4 * ULP
    slope = jax.jvp(lambda a: roots(a).value, (squares,), (jnp.ones_like(squares),))[1]
    assert np.abs(slope * 2 * np.sqrt(squares) - 1).max() < 8 * ULP
    assert np.abs(jax.grad(lambda a: roots(a).value.sum())(squares) - slope).max() < 4 * ULP
    start = (
        roots(jnp.array([4.0, 9.0])),
        root_find(
            lambda x, a: x * x - a, jnp.array([2.0, jnp.nan]), 4.0, steps=12, tolerance=tolerance, elementwise=True
        ),
    )
    assert start[0].value.tolist() == [2.0, 3.0]
    assert start[1].code.tolist() == [int(Code.ok), int(Code.not_converged)] and np.isnan(start[1].value[1])
