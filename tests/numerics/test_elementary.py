"""Elementary functions against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dielectric_jax.numerics.elementary import log1p, reciprocal, sine_cosine, softplus

ULP = np.finfo(float).eps


def test_sine_and_cosine_are_right_to_rounding():
    angle = np.concatenate([np.linspace(-20, 20, 40001), np.geomspace(1e-300, 1, 601), [0.0, 1e5, -1e6]])
    sine, cosine = sine_cosine(angle)
    assert np.max(np.abs(sine - np.sin(angle))) < 2 * ULP
    assert np.max(np.abs(cosine - np.cos(angle))) < 2 * ULP
    small = np.abs(angle) < 1
    assert np.allclose(sine[small], np.sin(angle[small]), rtol=2 * ULP, atol=0)


def test_sine_and_cosine_of_nothing_are_nothing():
    assert np.isnan(sine_cosine(np.array([np.nan, np.inf, -np.inf]))).all()


def test_derivatives_of_sine_and_cosine():
    angle = jnp.linspace(-7.0, 7.0, 57)
    for k, exact in ((0, [jnp.cos, lambda x: -jnp.sin(x)]), (1, [lambda x: -jnp.sin(x), lambda x: -jnp.cos(x)])):
        first = jax.vmap(jax.grad(lambda x, k=k: sine_cosine(x)[k]))
        second = jax.vmap(jax.grad(jax.grad(lambda x, k=k: sine_cosine(x)[k])))
        assert np.allclose(first(angle), exact[0](angle), atol=3 * ULP)
        assert np.allclose(second(angle), exact[1](angle), atol=3 * ULP)


def test_softplus_and_its_slope():
    x = np.concatenate([np.linspace(-700, 700, 20001), np.linspace(-2, 2, 4001)])
    value, slope = softplus(x)
    assert np.allclose(value, np.logaddexp(0, x), rtol=4 * ULP, atol=0)
    assert np.allclose(slope, np.exp(-np.logaddexp(0, -x)), rtol=2e-13, atol=0)


@pytest.mark.parametrize(("function", "exact"), [(reciprocal, lambda x: 1 / x), (log1p, jnp.log1p)])
def test_derivatives_of_reciprocal_and_logarithm(function, exact):
    x = jnp.array([-0.999, -0.5, 0.25, 3.0, 40.0])
    for order in range(4):
        ours, theirs = function, exact
        for _ in range(order):
            ours, theirs = jax.grad(ours), jax.grad(theirs)
        assert np.allclose(jax.vmap(ours)(x), jax.vmap(theirs)(x), rtol=1e-14, atol=0)
