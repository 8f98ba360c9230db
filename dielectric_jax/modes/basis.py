"""Polynomials on the unit interval: Gauss–Lobatto nodes, and the Lagrange basis on them."""

import numpy as np
from numpy.polynomial import legendre

__all__ = ["gauss", "lagrange", "lobatto"]


def gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Legendre nodes and weights on [0, 1].

    >>> nodes, weights = gauss(3)
    >>> round(float(weights @ nodes**4), 12)
    0.2
    """
    nodes, weights = legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


def lobatto(degree: int) -> np.ndarray:
    """The degree + 1 Gauss–Lobatto nodes on [0, 1].

    >>> lobatto(2)
    array([0. , 0.5, 1. ])
    """
    inner = legendre.legroots(legendre.legder(np.eye(degree + 1)[degree]))
    return (np.concatenate([[-1.0], np.sort(inner.real), [1.0]]) + 1) / 2


def lagrange(nodes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and derivatives (points, nodes) of the Lagrange polynomials on nodes in [0, 1].

    >>> values, slopes = lagrange(lobatto(2), np.array([0.25]))
    >>> bool(np.allclose(values.sum(), 1)), bool(np.allclose(slopes @ lobatto(2) ** 2, 0.5))
    (True, True)
    """
    most = len(nodes) - 1
    inverse = np.linalg.inv(legendre.legvander(2 * nodes - 1, most))
    slopes = [2 * legendre.legval(2 * points - 1, legendre.legder(np.eye(most + 1)[k])) for k in range(most + 1)]
    return legendre.legvander(2 * points - 1, most) @ inverse, np.stack(slopes, axis=1) @ inverse
