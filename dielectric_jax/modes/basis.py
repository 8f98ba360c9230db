"""Displacements on one element from the apex to the rim: polynomials of the parity that regularity asks for.

With U = (A + B)/√2, V = (A − B)/√2 a regular displacement of circumferential number n ≥ 1 is

    A = R^(n+1) a(R²),   B = R^(n−1) b(R²),   W = R^n w(R²):

for even n A and B are odd and W is even in R, for odd n A and B are even and W is odd. A polynomial of that parity serves every n,
and only its value at the apex depends on n: W there is free for n = 0, B for n = 1, and nothing for n ≥ 2. Polynomials are
taken in a coordinate ξ that is fine at a sharp apex, R = s sinh(ξ arsinh(1/s)), and divided by √m,
m = R R'/ξ, so that ∫ φ_i φ_j R dR = δ_ij: the mass is the identity.
"""

import functools
import typing

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import legendre
from scipy.special import eval_jacobi

__all__ = ["Coordinate", "Tables", "apex_sample", "coordinate", "functions", "gauss", "tables"]


def gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Legendre nodes and weights on [0, 1].

    >>> nodes, weights = gauss(3)
    >>> round(float(weights @ nodes**4), 12)
    0.2
    """
    nodes, weights = legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


def functions(power: int, count: int, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """h_k = ξ^power (1 − ξ²) P_k(ξ²), k < count, with ∫ h_j h_k ξ dξ = δ_jk on [0, 1], and h_k': arrays (count, points).

    The P_k are Jacobi polynomials. Power 0 gives even functions, 1 odd ones, 2 even ones that vanish at the apex.

    >>> x, weights = gauss(12)
    >>> values, _ = functions(1, 5, np.sqrt(x))
    >>> bool(np.allclose((values * weights / 2) @ values.T, np.eye(5)))
    True
    """
    x = xi**2

    def jacobi(x):
        return np.stack([eval_jacobi(k, 2, power, 2 * x - 1) for k in range(count)])

    nodes, weights = gauss(count + 4)
    norm = np.sqrt(np.sum((jacobi(nodes) * (1 - nodes)) ** 2 * nodes**power * weights / 2, axis=1))[:, None]
    slopes = np.stack(
        [(k + power + 3) * eval_jacobi(k - 1, 3, power + 1, 2 * x - 1) if k else np.zeros_like(x) for k in range(count)]
    )
    rise = (power * xi ** (power - 1) if power else 0.0) * (1 - x) - 2 * xi ** (power + 1)
    return xi**power * (1 - x) * jacobi(x) / norm, (rise * jacobi(x) + xi**power * (1 - x) * slopes * 2 * xi) / norm


class Tables(typing.NamedTuple):
    """The basis of one parity at Gauss points of x = ξ².

    `order` says which of A, B, W comes first: it has one function more, the last, which alone does not vanish at the apex.
    `basis` (3, 2, size + 1, points) are the functions of each and their slopes by ξ, 0 where there is none. `free`
    (size + 1, size + 1) takes coefficients of the first component's functions to those of even polynomials of rising degree.
    """

    order: np.ndarray
    basis: np.ndarray
    free: np.ndarray


@functools.cache
def tables(size: int, points: int, odd: bool) -> Tables:
    """The basis of a parity of n, `size` functions for each of A, B, W and one more for the first, at Gauss points."""
    x, _ = gauss(points)
    xi = np.sqrt(x)

    def padded(power):
        return np.pad(np.stack(functions(power, size, xi)), ((0, 0), (0, 1), (0, 0)))

    nodes, weights = gauss(2 * size + 6)
    rising = functions(0, size + 1, np.sqrt(nodes))[0]
    overlap = rising * (weights / 2) @ functions(2, size, np.sqrt(nodes))[0].T
    at_apex = functions(0, size + 1, np.zeros(1))[0]  # orthogonal to all that vanish there
    free = np.concatenate([overlap, at_apex / np.linalg.norm(at_apex)], axis=1)
    first = np.einsum("fg,cfx->cgx", free, np.stack(functions(0, size + 1, xi)))
    order = np.array([1, 0, 2] if odd else [2, 0, 1])
    basis = np.stack([first, padded(2), padded(1)] if odd else [first, padded(1), padded(1)])
    return Tables(order, basis, free)


class Coordinate(typing.NamedTuple):
    """R(ξ), R'(ξ), and 1/√m and its derivative by ξ, at points."""

    radius: jax.Array
    rate: jax.Array
    scale: jax.Array
    scale_rate: jax.Array


def coordinate(sharpness, xi) -> Coordinate:
    """R = s sinh(ξ arsinh(1/s)) at points 0 < ξ of a length s."""
    wave = jnp.arcsinh(1 / sharpness)
    radius, rate = sharpness * jnp.sinh(wave * xi), sharpness * wave * jnp.cosh(wave * xi)
    scale = jnp.sqrt(xi / (radius * rate))
    growth = rate / radius + wave**2 * radius / rate - 1 / xi  # m'/m
    return Coordinate(radius, rate, scale, -growth / 2 * scale)


def apex_sample(sharpness: float, radius: np.ndarray) -> np.ndarray:
    """ξ of radii."""
    return np.arcsinh(radius / sharpness) / np.arcsinh(1 / sharpness)
