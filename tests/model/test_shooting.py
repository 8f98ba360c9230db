"""The shot from apex to rim: its order, the adaptive integration, its derivatives, and an integration by SciPy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dielectric_jax as dj
from dielectric_jax.model.shooting import integrate_membrane

# near equilibria of λ0 = 1 to 2 (λa, p, q, J): flat, near the peak, past it, high load, q < 0, towards lock-up
POINTS = np.array(
    [
        [1.21821490, 1.06799454, 0.0, 270.0],
        [2.26310593, 1.90868483, 0.0, 270.0],
        [3.50428752, 1.69747385, 0.01, 270.0],
        [4.22113622, 1.08504416, 0.0, 180.0],
        [7.69534566, 1.20522719, 0.01, 270.0],
        [6.43964178, 1.82, -0.01825027831, 270.0],
        [10.25694895, 1.82, 0.003, 270.0],
    ]
)


def both(x, steps=192.0):
    """(λ2(1) − λa, V) at x = (λa, p, q, J)."""
    return jnp.stack(dj.model.shoot(dj.Gent(stretch_limit=x[3]), x[0], x[1], x[2], steps=steps))


value = jax.jit(jax.vmap(both, in_axes=(0, None)))
jacobian = jax.jit(jax.jacfwd(both))


def central(function, x, k):
    """Sixth-order central difference in entry k."""
    h = np.zeros_like(x)
    h[k] = 5e-4 * max(abs(x[k]), 0.05)
    at = [np.asarray(function(x + i * h)) for i in (-3, -2, -1, 1, 2, 3)]
    return (45 * (at[3] - at[2]) - 9 * (at[4] - at[1]) + (at[5] - at[0])) / (60 * h[k])


@pytest.mark.parametrize("x", POINTS, ids=lambda x: f"{x[0]:.3f}")
def test_jacobian_is_the_central_difference(x):
    """All columns: apex stretch, pressure (by scaling), load, and the material's constant.

    The grid moves with the apex' curvature and the scaling rule holds for the exact solution, so the two agree to the
    error of the grid: 192 steps leave 3e-13.
    """
    exact = np.asarray(jacobian(x))
    for k in range(4):
        rough = central(lambda x: value(x[None], 192.0)[0], x, k)
        np.testing.assert_allclose(exact[:, k], rough, rtol=1e-8, atol=1e-9 * abs(exact).max() / max(abs(x[k]), 0.05))


def test_every_transformation_gives_the_same_derivative():
    exact = np.stack([np.asarray(jacobian(x)) for x in POINTS])
    x = jnp.asarray(POINTS[2])
    way, weights = jnp.array([0.3, -0.2, 0.01, 5.0]), jnp.array([0.7, -1.3])

    @jax.jit
    def others(x):
        return jax.jvp(both, (x,), (way,))[1], jax.vjp(both, x)[1](weights)[0], jax.grad(lambda x: both(x)[0])(x)

    moved, pulled, stretch_change = others(x)
    np.testing.assert_allclose(moved, exact[2] @ way, rtol=1e-12)
    np.testing.assert_allclose(pulled, exact[2].T @ weights, rtol=1e-12)
    np.testing.assert_allclose(stretch_change, exact[2, 0], rtol=1e-12)
    volumes = jax.jit(jax.vmap(jax.grad(lambda x: both(x)[1])))(POINTS)
    np.testing.assert_allclose(volumes, exact[:, 1], rtol=1e-10)


def test_only_the_asked_derivatives_are_needed():
    """grad by the pressure alone is the scaling rule; by the material alone a module of gradients."""
    a, p, q, j = POINTS[4]
    exact = np.asarray(jacobian(POINTS[4]))
    by_pressure = jax.jit(jax.grad(lambda p: dj.model.shoot(dj.Gent(stretch_limit=j), a, p, q, steps=192.0).volume))(p)
    assert float(by_pressure) == pytest.approx(exact[1, 1], rel=1e-10)
    by_material = jax.jit(jax.grad(lambda m: dj.model.shoot(m, a, p, q, steps=192.0).stretch_change))(
        dj.Gent(stretch_limit=j)
    )
    assert float(by_material.stretch_limit) == pytest.approx(exact[0, 3], rel=1e-10)


def test_second_derivatives():
    """The Hessian in (λa, q) is symmetric and the central difference of the gradient."""
    x = POINTS[2]

    def volume(y):
        return dj.model.shoot(dj.Gent(), y[0], x[1], y[1], steps=192.0).volume

    y = np.array([x[0], x[2]])
    hessian = np.asarray(jax.jit(jax.hessian(volume))(y))
    gradient = jax.jit(jax.grad(volume))
    rough = np.stack([central(gradient, y, k) for k in range(2)], axis=1)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-10)
    np.testing.assert_allclose(hessian, rough, rtol=1e-7)


def test_order_of_the_grid():
    """Dormand and Prince's method is of order eight: doubling divides the error by 2⁸; 2⁶ is asked."""
    exact = np.asarray(value(POINTS, 320.0))
    size = np.maximum(abs(exact), 1.0)
    errors = {n: (abs(np.asarray(value(POINTS, n)) - exact) / size).max(axis=1) for n in (16.0, 32.0, 64.0, 128.0)}
    easy, stiff = slice(0, 6), slice(6, 7)  # the last point, towards lock-up, needs more steps to show the order
    assert (errors[32.0][easy] <= errors[16.0][easy] / 2**6).all()
    assert (errors[64.0][easy] <= np.maximum(errors[32.0][easy] / 2**6, 1e-14)).all()
    assert (errors[128.0][stiff] <= errors[64.0][stiff] / 2**6).all()
    # the order on which the library's choice of grids relies
    assert errors[16.0][easy].max() < 5e-9 and errors[32.0][easy].max() < 3e-11 and errors[64.0].max() < 3e-9


def test_the_careful_path_agrees_with_the_grid():
    careful = jax.jit(lambda a, p, q, steps: integrate_membrane(dj.Gent(), a, p, q, steps, adaptive=True))
    fixed = jax.jit(lambda a, p, q, steps: integrate_membrane(dj.Gent(), a, p, q, steps))
    lanes = POINTS[POINTS[:, 3] == 270.0, :3].T
    fine = fixed(*lanes, 256.0)
    for exponent, size in ((10.0, 1e-8), (13.0, 2e-12)):
        shot = careful(*lanes, exponent)
        np.testing.assert_allclose(shot.stretch_change, fine.stretch_change, rtol=size, atol=size)
        np.testing.assert_allclose(shot.volume, fine.volume, rtol=size)


def gent_by_hand(apex, p, q, limit):
    """(λ2(1) − λa, V) by SciPy's DOP853 from R = 1e-3, Gent's stresses and tangents written out."""

    def stress(l1, l2):
        g = 1 - (l1**2 + l2**2 + (l1 * l2) ** -2 - 3) / limit
        f1, f2 = l1 - l1**-3 * l2**-2, l2 - l2**-3 * l1**-2
        return (
            f1 / g - q * l1 * l2**2,
            f2 / g - q * l2 * l1**2,
            (1 + 3 * l1**-4 * l2**-2) / g + 2 * f1**2 / (limit * g**2) - q * l2**2,
            2 * l1**-3 * l2**-3 / g + 2 * f1 * f2 / (limit * g**2) - 2 * q * l1 * l2,
        )

    def rates(radius, y):
        l1, l2, theta, _ = y
        s1, s2, s11, s12 = stress(l1, l2)
        lean = l1 * math.cos(theta) - l2
        return [
            (s2 * math.cos(theta) - s1 - s12 * lean) / (radius * s11),
            lean / radius,
            -(s2 / s1) * math.sin(theta) / radius + p * l1 * l2 / s1,
            math.pi * (radius * l2) ** 2 * l1 * math.sin(theta),
        ]

    s0, _, s11, s12 = stress(apex, apex)
    kappa = p * apex**2 / (2 * s0)
    a, b = np.linalg.solve([[1, -3], [3 * s11 - s12, 3 * s12 - s11]], [apex * kappa**2 / 2, -s0 * kappa**2 / 2])
    first = 1e-3
    l1, l2 = apex + a * first**2, apex + b * first**2
    start = [l1, l2, math.asin(p * first * l2**2 / (2 * stress(l1, l2)[0])), math.pi / 4 * apex**3 * kappa * first**4]
    end = solve_ivp(rates, (first, 1.0), start, method="DOP853", rtol=2e-13, atol=1e-15).y[:, -1]
    return end[1] - apex, end[3]


@pytest.mark.parametrize("x", POINTS[:6], ids=lambda x: f"{x[0]:.3f}")
def test_another_integrator_finds_the_same(x):
    # the series of the start leaves R⁴ relative to the apex' curvature
    np.testing.assert_allclose(value(x[None], 128.0)[0], gent_by_hand(*x), rtol=1e-10)


def test_scaling_leaves_the_equations_unchanged():
    """(R, r, z, p) → (cR, cr, cz, p/c): the rim of (λa, p) is a point inside the membrane of (λa, p/c)."""
    membrane = dj.Membrane(prestretch=1.0)
    state = dj.equilibrium(membrane, voltage=0.1, volume=20.0)
    shape = dj.profile(membrane, state, steps=192)
    for i in (60, 120, 170):
        c = shape.radius[i]
        stretch_change, _ = value(np.array([[state.apex_stretch, state.pressure * c, 0.01, 270.0]]), 128.0)[0]
        assert float(stretch_change) == pytest.approx(shape.stretch_2[i] - state.apex_stretch, rel=1e-9)
