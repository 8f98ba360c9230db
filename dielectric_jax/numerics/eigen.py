"""The lowest eigenpairs of many small symmetric matrices, and the signs of their eigenvalues.

LAPACK's full eigensolver finds every vector of every matrix, one matrix after the other. Here LAPACK reduces each to a
tridiagonal matrix T, Sturm sequences count and bracket the eigenvalues of all of them side by side, and inverse iteration on T
gives the few vectors that are asked for: four pairs of 43 take 0.6 times as long, of 79 a quarter, with the same
error (benchmarks/speed/eigenpairs.py).
"""

import contextlib
import functools
import threading
import typing
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.lax import linalg
from threadpoolctl import ThreadpoolController

from .resolution import BISECTIONS, INVERSE_ITERATIONS, UNROLLED

__all__ = ["Eigenpairs", "Tridiagonal", "lapack_alone", "lowest_eigenpairs", "number_below", "tridiagonal"]


_ONE_PROGRAM = threading.Lock()


@functools.cache
def _libraries() -> ThreadpoolController:
    assert scipy.linalg  # whose LAPACK XLA calls on the CPU: it must be loaded before it is looked for
    return ThreadpoolController()


@contextlib.contextmanager
def lapack_alone() -> Iterator[None]:
    """Run compiled programs that call LAPACK in here, to their end.

    XLA splits a batch of LAPACK calls over its threads and waits for them on one of these threads: two such programs
    at once, on two threads, wait for each other forever. And OpenBLAS starts threads of its own for matrices of 64 and more:
    on two busy cores a spectrum of 121 functions then takes 18 times as long.
    """
    with _ONE_PROGRAM, _libraries().limit(limits=1, user_api="blas"):
        yield


class Tridiagonal(typing.NamedTuple):
    """T = Qᵀ A Q of matrices A: its diagonal (m, n) and the one beside it (m, n − 1), and Q as reflectors."""

    diagonal: jax.Array
    beside: jax.Array
    reflectors: jax.Array
    scales: jax.Array

    def rotated(self, vectors: jax.Array) -> jax.Array:
        """Q times vectors (m, n, k), one reflector after the other; LAPACK's own routine takes twice as long."""
        n = self.diagonal.shape[1]
        columns = jnp.moveaxis(jnp.tril(self.reflectors[:, :, :-1], -2) + np.eye(n, n - 1, -1), 0, 2)
        scales = self.scales.T

        def reflect(i, vectors):
            v = columns[:, n - 2 - i][:, None]
            return vectors - v * (scales[n - 2 - i] * jnp.sum(v * vectors, axis=0))

        return jnp.moveaxis(jax.lax.fori_loop(0, n - 1, reflect, jnp.moveaxis(vectors, 0, 2)), 2, 0)


class Eigenpairs(typing.NamedTuple):
    """The lowest `values` (m, k), first the lowest, and orthonormal `vectors` (m, n, k)."""

    values: jax.Array
    vectors: jax.Array


def tridiagonal(matrices: jax.Array) -> Tridiagonal:
    """The reduction of symmetric matrices (m, n, n)."""
    reflectors, diagonal, beside, scales = linalg.tridiagonal(matrices, lower=True)
    return Tridiagonal(diagonal, beside, reflectors, scales)


def number_below(t: Tridiagonal, bounds: jax.Array) -> jax.Array:
    """How many eigenvalues lie below each of the bounds (k, m): the negative pivots of T − x, by Sylvester's law of inertia.

    >>> t = tridiagonal(jnp.array([[[2.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, -3.0]]]))
    >>> number_below(t, jnp.array([[0.0], [9.0]])).tolist()
    [[2], [3]]
    """
    coupling = jnp.pad(t.beside, ((0, 0), (1, 0))) ** 2

    def eliminate(carry, row):
        pivot, count = carry
        diagonal, squared = row
        pivot = diagonal - bounds - squared / jnp.where(jnp.abs(pivot) < 1e-300, -1e-300, pivot)
        return (pivot, count + (pivot < 0)), None

    start = jnp.ones_like(bounds), jnp.zeros(bounds.shape, int)
    return jax.lax.scan(eliminate, start, (t.diagonal.T, coupling.T), unroll=UNROLLED)[0][1]


def _bisected(t: Tridiagonal, count: int) -> jax.Array:
    """The lowest eigenvalues (count, m) of T, between a Gershgorin bound and the `count`-th of its diagonal."""
    aside = jnp.abs(jnp.pad(t.beside, ((0, 0), (1, 0)))) + jnp.abs(jnp.pad(t.beside, ((0, 0), (0, 1))))
    low = jnp.min(t.diagonal - aside, axis=1)
    high = jnp.sort(t.diagonal, axis=1)[:, count - 1] + 1e-9 * jnp.max(jnp.abs(t.diagonal), axis=1)
    order = jnp.arange(count)[:, None]

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        above = number_below(t, middle) > order
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    ends = tuple(jnp.broadcast_to(v, (count, *v.shape)) for v in (low, high))
    low, high = jax.lax.fori_loop(0, BISECTIONS, halve, ends)
    return (low + high) / 2


def _orthonormal(vectors: jax.Array) -> jax.Array:
    """Gram–Schmidt, twice, on the columns of vectors (m, n, k)."""
    found: list[jax.Array] = []
    for k in range(vectors.shape[-1]):
        own = vectors[..., k]
        for other in found * 2:
            own = own - jnp.sum(own * other, axis=-1, keepdims=True) * other
        found.append(own / jnp.linalg.norm(own, axis=-1, keepdims=True))
    return jnp.stack(found, axis=-1)


def lowest_eigenpairs(matrices: jax.Array, t: Tridiagonal, count: int) -> Eigenpairs:
    """The `count` lowest eigenpairs of symmetric matrices (m, n, n), reduced to `t`.

    Values are Rayleigh quotients on the matrices themselves: their rounding is not that of the largest eigenvalue.

    >>> a = jnp.array([[[2.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 1.0, 2.0]]])
    >>> lowest_eigenpairs(a, tridiagonal(a), 2).values.round(12).tolist()
    [[0.585786437627, 2.0]]
    """
    m, n = t.diagonal.shape
    around = _bisected(t, count).T
    size = jnp.max(jnp.abs(t.diagonal), axis=1)[:, None]
    shifted = (t.diagonal[:, None] - around[..., None]).reshape(-1, n)
    # an exact eigenvalue would leave a singular matrix
    shifted = shifted - jnp.repeat(4e-16 * size, count, axis=0)
    below, above = (jnp.repeat(jnp.pad(t.beside, ((0, 0), ends)), count, axis=0) for ends in ((1, 0), (0, 1)))
    # any start that no eigenvector is orthogonal to
    start = np.random.default_rng(0).standard_normal((count, n))
    vectors = jnp.broadcast_to(start, (m, count, n))
    for _ in range(INVERSE_ITERATIONS):
        solved = linalg.tridiagonal_solve(below, shifted, above, vectors.reshape(-1, n, 1))
        columns = _orthonormal(jnp.swapaxes(solved.reshape(m, count, n), 1, 2))
        vectors = jnp.swapaxes(columns, 1, 2)
    whole = t.rotated(jnp.swapaxes(vectors, 1, 2))
    return Eigenpairs(jnp.sum(whole * (matrices @ whole), axis=1), whole)
