"""Jacobi's condition for modes of a number n ≥ 1, by integration of their equations from the apex: a certificate of the spectrum.

With the momenta π of the displacement y = (U, V, W) the Euler–Lagrange equations of Q_n are six of first order. Of the basis of
`spectrum` nothing is used, only the moduli. Let N_Θ = (1, n, 0), N_t = −(cn, c, sn), N_ν = (−sn, −s, cn), so that the gradients
along the hoop are N·y/R. Then

    π_t = c π_U + s π_W + p r s U,   π_ν = s π_U − c π_W − p r c U,
    G_t1 = (π_t − w12 N_Θ·y)/(w11 R),   G_Θ1 = (π_V − D12 N_t·y)/(C12 R),   G_ν1 = π_ν λ1/(w1 R),
    U' = c G_t1 + s G_ν1,   V' = G_Θ1,   W' = s G_t1 − c G_ν1,
    π' = N_Θ f_Θ + N_t f_t + N_ν f_ν + p (−r W' − z'(U + nV), −z'(V + nU) + n r' W, n r' V),
    f_Θ = w22 N_Θ·y/R + w12 G_t1,   f_t = C12 N_t·y/R + D12 G_Θ1,   f_ν = (w2/λ2) N_ν·y/R.

Three solutions are regular at the apex. Where their displacements become dependent, D(R) = det (y1, y2, y3) = 0, R is conjugate to
the apex. The index is the number of conjugate points in 0 < R < 1 (where w1, w11, C12 > 0), and the mode is neutral where D(1) = 0.
Solutions of different growth become parallel to rounding, so they are made orthonormal after every step.
"""

import dataclasses
import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from ..model import Membrane, State, apex_series, slopes
from ..numerics import cached_jit
from .resolution import JACOBI_START, JACOBI_STEPS
from .second_variation import moduli
from .spectrum import checked_numbers

__all__ = ["ConjugatePoints", "conjugate_points"]


@dataclasses.dataclass(frozen=True)
class ConjugatePoints:
    """The `radii` R conjugate to the apex for modes of a `number`, and `determinant`, D(1) of orthonormal solutions.

    `index` is how many there are: the negative eigenvalues of the second variation, the pair cos and sin counted once.
    """

    number: int
    radii: np.ndarray
    determinant: float

    @property
    def index(self) -> int:
        return len(self.radii)


def _gradients(place, y, momenta, n, p):
    """G_t1, G_ν1, G_Θ1 and the vectors N, of one solution."""
    radius, _, l2, sine, cosine, (w1, _, w11, w12, _, shear, twist), l1 = place
    along = jnp.stack([jnp.ones_like(n), n, 0 * n])
    across = -jnp.stack([cosine * n, cosine, sine * n])
    outward = jnp.stack([-sine * n, -sine, cosine * n])
    r = radius * l2
    of_t = cosine * momenta[0] + sine * momenta[2] + p * r * sine * y[0]
    of_normal = sine * momenta[0] - cosine * momenta[2] - p * r * cosine * y[0]
    gt = (of_t - w12 * (along @ y)) / (w11 * radius)
    gh = (momenta[1] - twist * (across @ y)) / (shear * radius)
    return gt, of_normal * l1 / (w1 * radius), gh, along, across, outward


def _rates(place, y, momenta, n, p):
    """dy/dR and dπ/dR of one solution."""
    radius, of_r, l2, sine, cosine, (_, w2, _, w12, w22, shear, twist), l1 = place
    gt, gn, gh, along, across, outward = _gradients(place, y, momenta, n, p)
    of_y = jnp.stack([cosine * gt + sine * gn, gh, sine * gt - cosine * gn])
    forces = along * (w22 * (along @ y) / radius + w12 * gt)
    forces = forces + across * (shear * (across @ y) / radius + twist * gh)
    forces = forces + outward * (w2 / l2) * (outward @ y) / radius
    of_z, r = l1 * sine, radius * l2
    push = jnp.stack(
        [
            -r * of_y[2] - of_z * (y[0] + n * y[1]),
            -of_z * (y[1] + n * y[0]) + n * of_r * y[2],
            n * of_r * y[1],
        ]
    )
    return of_y, forces + p * push


def _place(material, radius, base, u):
    """Radius, r', λ2, sin θ, cos θ, the moduli, and λ1 of a state (λ1 − λa, λ2 − λa, θ)."""
    l1, l2 = u[0] + base[0], u[0] + base[1]
    sine, cosine = jnp.sin(base[2]), jnp.cos(base[2])
    return radius, l1 * cosine, l2, sine, cosine, moduli(material, l1, l2, u[2]), l1


def _starts(material, u, n):
    """The state and the three regular solutions (6, 3) at the first radius, divided by R^(n − 1)."""
    radius = JACOBI_START
    a, b, kappa = apex_series(material, *u)
    base = jnp.stack([a * radius**2, b * radius**2, kappa * radius])
    place = _place(material, radius, base, u)
    _, _, l2, sine, cosine, (w1, _, w11, w12, _, shear, twist), l1 = place
    mixed = (w11 - w12 + w1 / l1) / 2
    share = (n + 1) * (mixed - w11) / (mixed + w11)
    values = jnp.array([[1.0, -1.0, 0.0], [0.0, 0.0, radius], [0.0, 0.0, 0.0]])
    values = values.at[2].set(jnp.stack([1 + share, 1 - share, 0.0]) * radius**2)
    powers = jnp.stack([n - 1, n, n + 1])

    def with_momenta(y, power):
        of_y = power * y / radius
        gt, gn = cosine * of_y[0] + sine * of_y[2], sine * of_y[0] - cosine * of_y[2]
        along, across = y[0] + n * y[1], -(cosine * (n * y[0] + y[1]) + sine * n * y[2])
        of_t = w11 * radius * gt + w12 * along
        of_normal = w1 / l1 * radius * gn
        of_hoop = shear * radius * of_y[1] + twist * across
        below = sine * of_t - cosine * of_normal - u[1] * radius * l2 * y[0]
        return jnp.concatenate([y, jnp.stack([cosine * of_t + sine * of_normal, of_hoop, below])])

    return base, jax.vmap(with_momenta)(values, powers).T


@functools.cache
def _program(steps: int):
    """R (steps,) and D(R) after every step in ln R, as a compiled program of a material, a state (λa, p, q) and a number."""
    ends = np.linspace(np.log(JACOBI_START), 0.0, steps + 1)
    solver = diffrax.Dopri8()

    def determinants(material, u, n):
        def field(log_radius, carried, args):
            base, solutions = carried
            radius = jnp.exp(log_radius)
            place = _place(material, radius, base, u)
            of_base = jnp.stack(slopes(material, radius, u[0] + base[0], u[0] + base[1], base[2], u[1], u[2]))
            of_y, of_momenta = jax.vmap(lambda v: _rates(place, v[:3], v[3:], n, u[1]), in_axes=1, out_axes=1)(
                solutions
            )
            of_solutions = jnp.concatenate([of_y, of_momenta]) * radius - (n - 1) * solutions
            return of_base * radius, of_solutions

        term = diffrax.ODETerm(field)

        def step(carried, between):
            carried, *_ = solver.step(term, between[0], between[1], carried, None, (jnp.asarray(True), carried), True)
            base, solutions = carried
            frame, factor = jnp.linalg.qr(solutions)
            frame = frame * jnp.sign(jnp.diagonal(factor))
            return (base, frame), jnp.linalg.det(frame[:3])

        start = _starts(material, u, n)
        (base, _), values = jax.lax.scan(step, start, (jnp.asarray(ends[:-1]), jnp.asarray(ends[1:])))
        return values, u[0] + base[1]

    return cached_jit(determinants), np.exp(ends[1:])


def conjugate_points(membrane: Membrane, state: State, number: int, *, steps: int = JACOBI_STEPS) -> ConjugatePoints:
    """The points conjugate to the apex for modes of a `number` from 1, by `steps` steps of Dopri8 in ln R.

    A step must resolve the growth like R^(2n): `steps` at least 10 n. Raises ValueError for bad input.

    >>> from dielectric_jax.diagram import equilibrium
    >>> film = Membrane()
    >>> conjugate_points(film, equilibrium(film, pressure=1.0), 2).index
    0
    """
    (n,) = checked_numbers([number], 1)
    if not (isinstance(steps, int) and steps >= 10 * n):
        raise ValueError(f"`steps` must be a whole number from {10 * n} for this number, but is {steps!r}.")
    program, radii = _program(steps)
    u = np.array([state.apex_stretch, state.pressure, state.voltage_squared])
    values = np.asarray(program(membrane.material, u, float(n))[0])
    before = np.flatnonzero(values[1:] * values[:-1] < 0)
    share = values[before] / (values[before] - values[before + 1])
    return ConjugatePoints(n, radii[before] + share * (radii[before + 1] - radii[before]), float(values[-1]))
