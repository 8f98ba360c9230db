"""Second variations of the energy of Gent membranes by the method of Ritz: their negative eigenvalues are the Morse index.

No code of the package and no derivative of a shot enters. The profile of a state (λa, p, q) comes from the equations of
`truth.py` at the points of the quadrature; the energy 2π ∫ w R dR − p V is discretised by spectral elements in R for
variations of (r, z), the rim held, and its matrix has a closed form in the derivatives of w = W − q (λ1 λ2)²/2. A loading
adds to it: a chamber k δV², charge control (q/C) δC², a prescribed volume the constraint δV = 0.
"""

import numpy as np

from benchmarks.truth import extended_precision as truth

ELEMENTS, DEGREE, POINTS = 12, 8, 12  # and points of Gauss in an element
_LARGEST = 0.3  # step of log R


def second_derivatives(l1, l2, q, limit):
    """w1, w2, w11, w12, w22 of w = W − q (λ1 λ2)²/2, by hand."""
    s1, s2, w11, w12 = truth.gent(l1, l2, q, limit)
    w22 = truth.gent(l2, l1, q, limit)[2]  # W is symmetric
    return s1, s2, w11, w12, w22


def _lobatto(degree: int):
    """Nodes of Gauss and Lobatto on [−1, 1], and values and slopes of their polynomials at the points of Gauss."""
    inner = np.polynomial.legendre.Legendre.basis(degree).deriv().roots()
    nodes = np.concatenate([[-1.0], np.sort(inner.real), [1.0]])
    points, weights = np.polynomial.legendre.leggauss(POINTS)
    inverse = np.linalg.inv(np.polynomial.legendre.legvander(nodes, degree))
    values = np.polynomial.legendre.legvander(points, degree) @ inverse
    slopes = np.stack([np.polynomial.legendre.Legendre(column).deriv()(points) for column in inverse.T], axis=1)
    return points, weights, values, slopes


def _edges(apex, pressure, q, limit, elements: int):
    """Edges (elements + 1, lanes), crowded about the apex where it is sharp."""
    s0 = truth.gent(apex, apex, q, limit)[0]
    scale = np.minimum(2 * s0 / (pressure * apex**2), 1.0)
    edges = scale * np.sinh(np.linspace(0, 1, elements + 1)[:, None] * np.arcsinh(1 / scale))
    edges[-1] = 1.0
    return edges


def profile(apex, pressure, q, limit, radius):
    """λ1, λ2, θ at rising radii (points, lanes) of the shot from (λa, p, q), then λ2 at the last radius."""
    first, _, y = truth._start(apex, pressure, q, limit)
    at = np.log(first)
    found = []
    for target in np.log(radius):
        steps = max(1, int(np.ceil(np.max(target - at) / _LARGEST)))
        h = (target - at) / steps
        before = target < at  # the series itself serves nearer to the apex than its start

        def slope(u, y):
            return np.exp(u) * truth._rates(np.exp(u), y, apex, pressure, q, limit)

        for n in range(steps):
            y = np.where(before, y, truth._step(slope, at + n * h, np.where(before, 0.0, h), y))
        at = np.where(before, at, target)
        found.append(np.stack([apex + y[0], apex + y[1], y[2]]))
    return np.stack(found, axis=1)


class Ritz:
    """Matrices of many states, arrays (lanes,) of λa, p, q, J: `second` (lanes, n, n), `of_volume` and `of_charge` (lanes, n).

    `charge` is C = Q/Φ, `rim` λ2 at R = 1, which says whether a state is an equilibrium.
    """

    def __init__(self, apex, pressure, q, limit, elements: int = ELEMENTS):
        points, weights, values, slopes = _lobatto(DEGREE)
        edges = _edges(apex, pressure, q, limit, elements)
        half = (edges[1:] - edges[:-1]) / 2
        radius = edges[:-1, None] + half[:, None] * (1 + points[:, None])  # (elements, points, lanes)
        lanes = len(apex)
        rows = np.concatenate([radius.reshape(-1, lanes), np.ones((1, lanes))])
        l1, l2, theta = profile(apex, pressure, q, limit, rows)
        self.rim = l2[-1]
        l1, l2, theta = (v[:-1].reshape(radius.shape) for v in (l1, l2, theta))
        w1, _, w11, w12, w22 = second_derivatives(l1, l2, q, limit)
        sine, cosine = np.sin(theta), np.cos(theta)
        weight = weights[:, None] * half[:, None]
        value = np.broadcast_to(values[None, :, :, None], (elements, POINTS, DEGREE + 1, lanes))
        slope = slopes[None, :, :, None] / half[:, None, None]
        zero = np.zeros_like(value)

        def both(of_r, of_z):
            return np.concatenate([of_r, of_z], axis=2)

        def wide(v):
            return v[:, :, None]

        d1 = both(wide(cosine) * slope, wide(sine) * slope)  # δλ1
        d2 = both(value / wide(radius), zero)  # δλ2
        turn = both(-wide(sine) * slope, wide(cosine) * slope)  # λ1 times the turn of the meridian
        of_r, of_slope = both(value, zero), both(zero, slope)  # δr, δz'

        def form(weights_, a, b):
            return np.einsum("egl,egil,egjl->leij", weights_, a, b, optimize=True)

        ring = 2 * np.pi * radius * weight
        local = form(ring * w11, d1, d1) + form(ring * w22, d2, d2) + form(ring * w1 / l1, turn, turn)
        cross = form(ring * w12, d1, d2) - 2 * np.pi * form(pressure * weight * radius * l2, of_r, of_slope)
        local += cross + np.swapaxes(cross, 2, 3)
        local -= 2 * np.pi * form(pressure * weight * l1 * sine, of_r, of_r)
        area = l1 * l2
        volume = np.pi * np.einsum("egl,egil->lei", weight * 2 * radius * area * sine, of_r)
        volume += np.pi * np.einsum("egl,egil->lei", weight * (radius * l2) ** 2, of_slope)
        charge = np.einsum("egl,egil->lei", 2 * ring * area * l2, d1)
        charge += np.einsum("egl,egil->lei", 2 * ring * area * l1, d2)
        self.charge = (ring * area**2).sum(axis=(0, 1))
        nodes = elements * DEGREE + 1
        local_nodes = np.arange(elements)[:, None] * DEGREE + np.arange(DEGREE + 1)
        place = np.concatenate([local_nodes, nodes + local_nodes], axis=1)
        kept = np.concatenate(
            [np.arange(1, nodes - 1), np.arange(nodes, 2 * nodes - 1)]
        )  # r held at both ends, z at the rim
        whole = np.zeros((lanes, 2 * nodes, 2 * nodes))
        loads = np.zeros((2, lanes, 2 * nodes))
        for e in range(elements):
            whole[:, place[e][:, None], place[e]] += local[:, e]
            for load, part in zip(loads, (volume, charge), strict=True):
                load[:, place[e]] += part[:, e]
        second = whole[:, kept[:, None], kept]
        # a congruence changes no sign but evens out the sizes
        size = 1 / np.sqrt(np.abs(np.einsum("lii->li", second)))
        self.second = second * size[:, :, None] * size[:, None]
        self.of_volume, self.of_charge = (load[:, kept] * size for load in loads)
        self.q = np.asarray(q)

    def index(self, *, stiffness=None, held_volume: bool = False, charged: bool = False):
        """Negative eigenvalues under a loading (lanes,), and the eigenvalue nearest to zero.

        `stiffness` k = −dp_gas/dV of a chamber (lanes,); without it the pressure is prescribed, or with `held_volume` the
        volume. `charged` is charge control.
        """
        matrix = self.second
        if stiffness is not None:
            matrix = matrix + _outer(self.of_volume, stiffness)
        if charged:
            matrix = matrix + _outer(self.of_charge, self.q / self.charge)
        if held_volume:
            border = self.of_volume / np.linalg.norm(self.of_volume, axis=1, keepdims=True)
            matrix = np.concatenate([matrix, border[:, None]], axis=1)
            matrix = np.concatenate([matrix, np.pad(border, ((0, 0), (0, 1)))[:, :, None]], axis=2)
        values = np.full(matrix.shape[:2], np.nan)
        good = np.isfinite(matrix).all(axis=(1, 2))
        values[good] = np.linalg.eigvalsh(matrix[good])
        # a border adds one negative eigenvalue to those on the constraint
        return (values < 0).sum(axis=1) - int(held_volume), np.abs(values).min(axis=1)


def _outer(vectors, weights):
    return weights[:, None, None] * vectors[:, :, None] * vectors[:, None]
