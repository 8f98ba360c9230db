"""The lowest eigenpairs of many small symmetric matrices: time and error of this package's way and of LAPACK's full solver.

Matrices whose eigenvalues rise like the fourth power of their order, as those of a spectral basis do, some of them negative, in
random orthonormal bases. The error is the largest |difference| from `numpy.linalg.eigvalsh` over the matrix' norm, and the
largest residual |A x − Λ x| over it; LAPACK's own rounding is a few 1e-16. Both ways run turn by turn in one process.

    python -m benchmarks.speed.eigenpairs [--json FILE|-] [--quick]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from dielectric_jax.numerics import lowest_eigenpairs, tridiagonal

jax.config.update("jax_enable_x64", True)

COUNT, MATRICES, ALLOWED = 4, 112, 1e-13


def matrices_of(size: int) -> np.ndarray:
    """Random symmetric matrices of one size."""
    random = np.random.default_rng(0)
    values = np.arange(size) ** 4 / 3 + random.uniform(-3, 10, (MATRICES, size))
    bases = np.linalg.qr(random.standard_normal((MATRICES, size, size)))[0]
    whole = np.einsum("mik,mk,mjk->mij", bases, values, bases)
    return (whole + whole.swapaxes(1, 2)) / 2


def by_bisection(matrices):
    return lowest_eigenpairs(matrices, tridiagonal(matrices), COUNT)


def by_lapack(matrices):
    values, vectors = jnp.linalg.eigh(matrices)
    return values[:, :COUNT], vectors[:, :, :COUNT]


def error_of(matrices: np.ndarray, found) -> float:
    """The largest error of a value or residual of a pair, over the norm."""
    values, vectors = map(np.asarray, found)
    norm = np.abs(np.linalg.eigvalsh(matrices)).max(axis=1)
    apart = np.abs(values - np.linalg.eigvalsh(matrices)[:, :COUNT]).max(axis=1) / norm
    residual = np.abs(matrices @ vectors - vectors * values[:, None]).max(axis=(1, 2)) / norm
    return float(max(apart.max(), residual.max()))


def main() -> int:
    options = harness.arguments(__doc__, "one size, two rounds").parse_args()
    records = []
    for size in (25,) if options.quick else (25, 43, 55, 79):
        matrices = matrices_of(size)
        ways = {"bisection": jax.jit(by_bisection), "lapack": jax.jit(by_lapack)}
        runs = {name: lambda way=way, m=matrices: way(m) for name, way in ways.items()}
        for name, timing in harness.timed_in_turn(runs, 2 if options.quick else 9).items():
            each = {"microseconds": 1e6 * timing.best / MATRICES, "compile_seconds": timing.compile_seconds}
            records.append({"way": name, "size": size, **each, "error": error_of(matrices, timing.value)})
            harness.say(records[-1])
    document = {"name": "eigenpairs", "count": COUNT, "records": records, "machine": harness.machine()}
    return harness.finish(document, options.json, all(r["error"] < ALLOWED for r in records))


if __name__ == "__main__":
    sys.exit(main())
