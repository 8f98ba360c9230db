"""Elementary functions in forms that XLA makes fast on CPUs.

Sines, cosines and logarithms in float64 it leaves to the C library, one number after the other, which took more time in a
shot than everything else; polynomials become vector instructions. Divisions it keeps from being computed twice, so that
their number and place decide how much else is.
"""

import math

import jax
import jax.numpy as jnp

__all__ = ["log1p", "reciprocal", "sine_cosine", "softplus"]

_QUARTER = 1.5707963267341256, 6.077100506506192e-11  # π/2, whose first part holds 33 bits
# Taylor coefficients in x²: of sin x/x and cos x for |x| ≤ π/4, of artanh x/x for |x| ≤ 1/3; the next is below rounding
_SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(8)]
_COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(9)]
_ARTANH = [1 / (2 * k + 1) for k in range(17)]


def _polynomial(coefficients: list[float], x):
    value = jnp.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value


@jax.custom_jvp
def sine_cosine(angle):
    """sin and cos of an angle (any shape), right to rounding for |angle| < 10⁶.

    >>> s, c = sine_cosine(jnp.float64(2.0))
    >>> bool(abs(s - math.sin(2)) < 2e-16), bool(abs(c - math.cos(2)) < 2e-16)
    (True, True)
    """
    turns = jnp.floor(angle * (2 / math.pi) + 0.5)
    x = (angle - turns * _QUARTER[0]) - turns * _QUARTER[1]
    short, long = x * _polynomial(_SINE, x * x), _polynomial(_COSINE, x * x)
    half = jnp.floor(turns / 2)
    odd = 2 * half != turns
    sign = 1 - 2 * (half - 2 * jnp.floor(half / 2))
    one = sign * (
        short * short + long * long
    )  # but for rounding; the division keeps XLA from doing all this for every use
    return jnp.where(odd, long, short) / one, jnp.where(odd, -short, long) / one


@sine_cosine.defjvp
def _(primals, tangents):
    (tangent,) = tangents
    sine, cosine = sine_cosine(*primals)
    return (sine, cosine), (cosine * tangent, -sine * tangent)


@jax.custom_jvp
def reciprocal(x):
    """1/x (any shape); its derivatives divide no more."""
    return 1 / x


@reciprocal.defjvp
def _(primals, tangents):
    value = reciprocal(*primals)
    return value, -value * value * tangents[0]


@jax.custom_jvp
def log1p(x):
    """log(1 + x) (any shape), whose derivatives divide once."""
    return jnp.log1p(x)


@log1p.defjvp
def _(primals, tangents):
    return log1p(*primals), tangents[0] * reciprocal(1 + primals[0])


def softplus(x):
    """log(1 + eˣ) and its derivative 1/(1 + e⁻ˣ), any shape, right to rounding."""
    e = jnp.exp(-jnp.abs(x))
    z = e / (2 + e)  # log(1 + e) = 2 artanh z
    return jnp.maximum(x, 0.0) + 2 * z * _polynomial(_ARTANH, z * z), jnp.where(x > 0, 1.0, e) / (1 + e)
