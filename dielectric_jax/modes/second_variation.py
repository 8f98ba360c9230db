"""The second variation of the energy of an inflated membrane for displacements of circumferential number n.

A displacement U cos nΘ e_r + V sin nΘ e_Θ + W cos nΘ e_z (z downward) of a state with radius r(R), height z(R), slope θ and
stretches λ1, λ2 has, along the meridian (1) and the hoop (2), the gradients

    G_t1 = c U' + s W',   G_ν1 = s U' − c W',   G_Θ1 = V',
    G_Θ2 = (U + nV)/R,    G_t2 = −(c (nU + V) + s n W)/R,    G_ν2 = −(s (nU + V) − c n W)/R,      c = cos θ, s = sin θ,

and with w(λ1, λ2) = W − q e (λ1 λ2)²/2 at fixed q, w_i and w_ij its derivatives,

    Q_n = ∫ { w11 G_t1² + 2 w12 G_t1 G_Θ2 + w22 G_Θ2² + (w1/λ1) G_ν1² + (w2/λ2) G_ν2²
              + C12 (G_Θ1² + G_t2²) + 2 D12 G_Θ1 G_t2 } R dR − p ∫ { 2 r U W' + z' (U² + 2n UV + V²) − 2n r' V W } dR,

    C12, D12 = (M ± P)/2,   P = (w1 + w2)/(λ1 + λ2),   M = (w1 − w2)/(λ1 − λ2).

The integrand is a quadratic form of (U, V, W, U', V', W') whose matrix is a polynomial of second degree in n: three
matrices serve every n. Displacements are polynomials on elements along R, continuous from one to the next.
"""

import functools
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp

from ..model import apex_series, capacitance, eighth_order_step, integrate_membrane, slopes, stresses
from .basis import gauss, lagrange, lobatto
from .resolution import MEAN_NODES, MORE_POINTS, NEAR_APEX, NEAR_EQUAL

__all__ = ["Assembled", "assembled", "edges_of"]


class Assembled(typing.NamedTuple):
    """The second variation on the nodes of the elements, of one state or with lanes in front.

    `stiffness` (3, N, 3, N, 3) holds the coefficients of 1, n, n²; `mass` (N, N) is ∫ φ φ R dR; `volume` and `charge` (N, 3)
    are the first variations of V and of `capacitance`, C = Q/Φ, for n = 0.
    """

    stiffness: jax.Array
    mass: jax.Array
    volume: jax.Array
    charge: jax.Array
    capacitance: jax.Array


class _Base(typing.NamedTuple):
    """The state at points along the radius: arrays (points, lanes)."""

    radius: jax.Array
    l1: jax.Array
    l2: jax.Array
    sine: jax.Array
    cosine: jax.Array


def edges_of(material, u, elements: int):
    """The edges (elements + 1, lanes) of the elements: even up to the radius of a sharp apex, then growing."""
    scale = jnp.minimum(1 / apex_series(material, *u)[2], 1.0)
    edges = scale * jnp.sinh(jnp.linspace(0.0, 1.0, elements + 1)[:, None] * jnp.arcsinh(1 / scale))
    return edges.at[-1].set(1.0)


def _base(material, u, steps, radius) -> tuple[_Base, jax.Array]:
    """The state at radii (points, lanes), and λ2(1) − λa: the nodes of a shot, and from them one step each."""
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, trail="profile")
    times, values, along = shot.trail
    done = jnp.isfinite(times)
    nodes = along.rows(times, jnp.where(done[:, None, None], values, 0.0))[0]
    nodes = jnp.where(done[:, None], nodes, jnp.inf)

    def before(nodes, values, radius):
        i = jnp.maximum(jnp.searchsorted(nodes, radius) - 1, 0)
        return nodes[i], values[i].T

    start, y = jax.vmap(before, in_axes=(1, 2, 1), out_axes=(1, 2))(nodes, values, radius)

    def rates(radius, y):
        return jnp.stack(slopes(material, radius, apex + y[0], apex + y[1], y[2], p, q))

    y = eighth_order_step(rates, start, radius - start, y)
    a, b, kappa = apex_series(material, apex, p, q)
    y = jnp.where(radius < nodes[0], jnp.stack([a * radius**2, b * radius**2, kappa * radius]), y)
    return _Base(radius, apex + y[0], apex + y[1], jnp.sin(y[2]), jnp.cos(y[2])), shot.stretch_change


def _moduli(material, l1, l2, q) -> list:
    """w1, w2, w11, w12, w22, C12, D12; nothing cancels where λ1 and λ2 are nearly equal.

    There M = (w1 − w2)/(λ1 − λ2) is the mean of w11 − w12 over the stretches between (λ1, λ2) and (λ2, λ1).
    """
    w1, w2, w11, w12 = stresses(material, l1, l2, q)
    w22 = stresses(material, l2, l1, q)[2]
    middle, half = (l1 + l2) / 2, (l1 - l2) / 2
    nodes, weights = gauss(MEAN_NODES)

    def difference(share):
        _, _, w11, w12 = stresses(material, middle + half * share, middle - half * share, q)
        return w11 - w12

    near = sum(w * difference(2 * x - 1) for x, w in zip(nodes, weights, strict=True))
    far = (w1 - w2) / jnp.where(half == 0, 1.0, 2 * half)
    mean = jnp.where(jnp.abs(half) < NEAR_EQUAL * middle, near, far)
    total = (w1 + w2) / (2 * middle)
    return [w1, w2, w11, w12, w22, (mean + total) / 2, (mean - total) / 2]


def _table(rows) -> jax.Array:
    return jnp.stack([jnp.stack(row) for row in rows])


def _forms(base: _Base) -> tuple[jax.Array, jax.Array]:
    """G_t1, G_ν1, G_Θ1, G_Θ2, G_t2, G_ν2 by (U, V, W, U', V', W'): the coefficients (6, 6, points, lanes) of 1 and of n."""
    c, s, per = base.cosine, base.sine, 1 / base.radius
    o, i = jnp.zeros_like(c), jnp.ones_like(c)
    zeroth = [[o, o, o, c, o, s], [o, o, o, s, o, -c], [o, o, o, o, i, o]]
    zeroth += [[per, o, o, o, o, o], [o, -c * per, o, o, o, o], [o, -s * per, o, o, o, o]]
    first = [[o] * 6] * 3 + [[o, per, o, o, o, o], [-c * per, o, -s * per, o, o, o], [-s * per, o, c * per, o, o, o]]
    return _table(zeroth), _table(first)


def _integrand(material, base: _Base, p, q) -> jax.Array:
    """The matrix of the integrand by (U, V, W, U', V', W'): the coefficients (3, 6, 6, points, lanes) of 1, n, n²."""
    w1, w2, w11, w12, w22, shear, twist = _moduli(material, base.l1, base.l2, q)
    o = jnp.zeros_like(w1)
    moduli = [[w11, o, o, w12, o, o], [o, w1 / base.l1, o, o, o, o], [o, o, shear, o, twist, o]]
    moduli += [[w12, o, o, w22, o, o], [o, o, twist, o, shear, o], [o, o, o, o, o, w2 / base.l2]]
    zeroth, first = _forms(base)

    def product(a, b):
        return jnp.einsum("kigl,kmgl,mjgl->ijgl", a, _table(moduli), b) * base.radius

    r, of_r, of_z = base.radius * base.l2, base.l1 * base.cosine, base.l1 * base.sine
    none = jnp.zeros((6, 6, *o.shape))
    still = none.at[0, 5].set(r).at[5, 0].set(r).at[0, 0].set(of_z).at[1, 1].set(of_z)
    turning = none.at[0, 1].set(of_z).at[1, 0].set(of_z).at[1, 2].set(-of_r).at[2, 1].set(-of_r)
    mixed = product(zeroth, first)
    mixed = mixed + jnp.swapaxes(mixed, 0, 1)
    return jnp.stack([product(zeroth, zeroth) - p * still, mixed - p * turning, product(first, first)])


def _gathered(parts, elements: int, degree: int, axes: tuple[int, ...]):
    """The sum of the parts of every element, first axis, on the nodes that they share; `axes` of a part count its nodes."""
    count = elements * degree + 1
    shape = [count if k in axes else size for k, size in enumerate(parts.shape[1:])]
    whole = jnp.zeros(shape)
    for e in range(elements):
        own = slice(e * degree, (e + 1) * degree + 1)
        whole = whole.at[tuple(own if k in axes else slice(None) for k in range(len(shape)))].add(parts[e])
    return whole


def assembled(elements: int, degree: int) -> Callable:
    """`assemble(material, u, steps)` of states u (3, lanes): `Assembled` with lanes in front, λ2(1) − λa, and R and σ2.

    R and σ2 (lanes, points) are those of the apex, of the Gauss points and of the rim.
    """
    nodes, weights = gauss(degree + MORE_POINTS)
    values, rates = lagrange(lobatto(degree), nodes)

    def assemble(material, u, steps):
        edges = edges_of(material, u, elements)
        size = edges[1:] - edges[:-1]
        radius = edges[:-1, None] + size[:, None] * nodes[:, None]  # (elements, points, lanes)
        flat = radius.reshape(-1, radius.shape[-1])
        apex, rim = jnp.full_like(flat[:1], NEAR_APEX), jnp.ones_like(flat[:1])
        whole, stretch_change = _base(material, u, steps, jnp.concatenate([apex, flat, rim]))
        hoop = whole.l2 * stresses(material, whole.l1, whole.l2, u[2])[1]
        base = jax.tree.map(lambda v: v[1:-1], whole)
        weight = weights[:, None] * size[:, None]
        basis = jnp.stack(
            [
                jnp.broadcast_to(values[..., None], (elements, *values.shape, flat.shape[1])),
                rates[..., None] / size[:, None, None],
            ]
        )  # the functions and their slopes: (2, elements, points, nodes, lanes)
        form = _integrand(material, base, *u[1:]).reshape(3, 2, 3, 2, 3, *radius.shape)
        local = jnp.einsum("eql,deqal,ndifjeql,feqbl->elnaibj", weight, basis, form, basis)
        stiffness = _gathered(local, elements, degree, (2, 4))
        mass = _gathered(jnp.einsum("eql,qa,qb->elab", weight * radius, values, values), elements, degree, (1, 2))
        gather = functools.partial(_functional, weight=2 * jnp.pi * weight, basis=basis)
        r = flat * base.l2
        volume = gather([r * base.l1 * base.sine, None], [None, r**2 / 2])
        c1, c2 = jax.grad(lambda a, b: jnp.sum(capacitance(material, a, b)), argnums=(0, 1))(base.l1, base.l2)
        charge = gather([c2, c1 * base.cosine * flat], [None, c1 * base.sine * flat])
        local = capacitance(material, base.l1, base.l2).reshape(radius.shape)
        total = 2 * jnp.pi * jnp.sum(weight * radius * local, axis=(0, 1))
        return Assembled(stiffness, mass, volume, charge, total), stretch_change, (whole.radius.T, hoop.T)

    return assemble


def _functional(radial, vertical, *, weight, basis):
    """∫ (a U + b U' + c W + d W') dR as coefficients (lanes, N, 3), of `radial` (a, b) and `vertical` (c, d), None for 0."""
    elements, points, lanes = weight.shape
    degree = basis.shape[3] - 1

    def on_nodes(pair):
        terms = [
            jnp.einsum("eql,eqal->ela", weight * f.reshape(elements, points, lanes), basis[k])
            for k, f in enumerate(pair)
            if f is not None
        ]
        return _gathered(sum(terms), elements, degree, (1,))

    along, up = on_nodes(radial), on_nodes(vertical)
    return jnp.stack([along, jnp.zeros_like(along), up], axis=-1)
