"""The second variation of the energy of an inflated membrane for displacements of circumferential number n.

A displacement U cos nΘ e_r + V sin nΘ e_Θ + W cos nΘ e_z (z downward) of a state with radius r(R), height z(R), slope θ and
stretches λ1, λ2 has, along the meridian (1) and the hoop (2), the gradients

    G_t1 = c U' + s W',   G_ν1 = s U' − c W',   G_Θ1 = V',
    G_Θ2 = (U + nV)/R,    G_t2 = −(c (nU + V) + s n W)/R,    G_ν2 = −(s (nU + V) − c n W)/R,      c = cos θ, s = sin θ,

and with w(λ1, λ2) = W − q e (λ1 λ2)²/2 at fixed q, w_i and w_ij its derivatives,

    Q_n = ∫ { w11 G_t1² + 2 w12 G_t1 G_Θ2 + w22 G_Θ2² + (w1/λ1) G_ν1² + (w2/λ2) G_ν2²
              + C12 (G_Θ1² + G_t2²) + 2 D12 G_Θ1 G_t2 } R dR − p ∫ { 2 r U W' + z' (U² + 2n UV + V²) − 2n r' V W } dR,

    C12, D12 = (M ± P)/2,   P = (w1 + w2)/(λ1 + λ2),   M = (w1 − w2)/(λ1 − λ2).

The integrand is a quadratic form of (U, V, W, U', V', W') whose matrix is a polynomial of second degree in n: on the basis of
a parity of n (see `basis`) three matrices serve every n.
"""

import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..model import apex_series, capacitance, eighth_order_step, integrate_membrane, slopes, stresses
from .basis import Tables, coordinate, gauss
from .resolution import APEX_RADII, MEAN_NODES, NEAR_APEX, NEAR_EQUAL

__all__ = ["Assembled", "Sampled", "assembled", "moduli", "sampled"]

# U, V, W and their derivatives by A, B, W and theirs
_HALVES = np.kron(np.eye(2), np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, np.sqrt(2.0)]]) / np.sqrt(2.0))


class Sampled(typing.NamedTuple):
    """A state at the Gauss points of the basis, lanes in front, for displacements A, B, W.

    `form` (lanes, 3, 2, 3, 2, 3, points) is the integrand of the second variation: the coefficients of 1, n, n² by the slope and
    component of one and the other function of ξ, with the weights of the points; `volume` and `charge`
    (lanes, 2, 3, points) are those of the first variations of V and of `capacitance` (lanes,), C = Q/Φ, for n = 0.
    `hoop` (lanes, points + 2) is the true hoop stress from the apex to the rim, `sharpness` the length s of the coordinate,
    and `stretch_change` λ2(1) − λa.
    """

    form: jax.Array
    volume: jax.Array
    charge: jax.Array
    capacitance: jax.Array
    hoop: jax.Array
    sharpness: jax.Array
    stretch_change: jax.Array


class Assembled(typing.NamedTuple):
    """The second variation of one state on the N functions of a parity, whose mass is the identity.

    `stiffness` (3, N, N) holds the coefficients of 1, n, n²; `volume` and `charge` (N,) are first variations.
    """

    stiffness: jax.Array
    volume: jax.Array
    charge: jax.Array


class _Base(typing.NamedTuple):
    """The state at points along the radius: arrays (points, lanes)."""

    radius: jax.Array
    l1: jax.Array
    l2: jax.Array
    sine: jax.Array
    cosine: jax.Array


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


def moduli(material, l1, l2, q) -> list:
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
    w1, w2, w11, w12, w22, shear, twist = moduli(material, base.l1, base.l2, q)
    o = jnp.zeros_like(w1)
    matrix = [[w11, o, o, w12, o, o], [o, w1 / base.l1, o, o, o, o], [o, o, shear, o, twist, o]]
    matrix += [[w12, o, o, w22, o, o], [o, o, twist, o, shear, o], [o, o, o, o, o, w2 / base.l2]]
    zeroth, first = _forms(base)

    def product(a, b):
        return jnp.einsum("kigl,kmgl,mjgl->ijgl", a, _table(matrix), b) * base.radius

    r, of_r, of_z = base.radius * base.l2, base.l1 * base.cosine, base.l1 * base.sine
    none = jnp.zeros((6, 6, *o.shape))
    still = none.at[0, 5].set(r).at[5, 0].set(r).at[0, 0].set(of_z).at[1, 1].set(of_z)
    turning = none.at[0, 1].set(of_z).at[1, 0].set(of_z).at[1, 2].set(-of_r).at[2, 1].set(-of_r)
    mixed = product(zeroth, first)
    mixed = mixed + jnp.swapaxes(mixed, 0, 1)
    return jnp.stack([product(zeroth, zeroth) - p * still, mixed - p * turning, product(first, first)])


def sampled(points: int):
    """`sample(material, u, steps)` of states u (3, lanes): `Sampled` at Gauss points."""
    x, weights = gauss(points)
    xi = np.sqrt(x)[:, None]

    def sample(material, u, steps) -> Sampled:
        sharpness = jnp.minimum(APEX_RADII / apex_series(material, *u)[2], 1.0)
        at = coordinate(sharpness, xi)
        apex, rim = jnp.full_like(at.radius[:1], NEAR_APEX), jnp.ones_like(at.radius[:1])
        whole, stretch_change = _base(material, u, steps, jnp.concatenate([apex, at.radius, rim]))
        hoop = whole.l2 * stresses(material, whole.l1, whole.l2, u[2])[1]
        base = jax.tree.map(lambda v: v[1:-1], whole)
        # a function is φ = h/√m, φ' = (h (1/√m)' + h'/√m)/R'
        o = jnp.zeros_like(at.scale)
        change = jnp.stack([jnp.stack([at.scale, o]), jnp.stack([at.scale_rate, at.scale]) / at.rate])
        weight = weights[:, None] * at.rate / (2 * xi)
        form = jnp.einsum("ki,nklxs,lj->nijxs", _HALVES, _integrand(material, base, *u[1:]), _HALVES) * weight
        form = form.reshape(3, 2, 3, 2, 3, *weight.shape)
        form = jnp.einsum("dexs,ndifjxs,fcxs->sneicjx", change, form, change)

        def functional(radial, vertical):
            zero = [jnp.zeros_like(weight)] * 2
            by_u, by_w = ([o if f is None else f for f in pair] for pair in (radial, vertical))
            rows = jnp.stack([jnp.stack(v) for v in zip(by_u, zero, by_w, strict=True)]) * 2 * jnp.pi * weight
            rows = jnp.einsum("dixs,ij->djxs", rows, _HALVES[:3, :3])
            return jnp.einsum("dexs,dixs->seix", change, rows)

        r = base.radius * base.l2
        volume = functional([r * base.l1 * base.sine, None], [None, r**2 / 2])
        c1, c2 = jax.grad(lambda a, b: jnp.sum(capacitance(material, a, b)), argnums=(0, 1))(base.l1, base.l2)
        charge = functional([c2, c1 * base.cosine * base.radius], [None, c1 * base.sine * base.radius])
        total = 2 * jnp.pi * jnp.sum(weight * base.radius * capacitance(material, base.l1, base.l2), axis=0)
        return Sampled(form, volume, charge, total, hoop.T, sharpness, stretch_change)

    return sample


def assembled(parts: Sampled, tables: Tables) -> Assembled:
    """The second variation on a basis, with the lanes of `parts` in front."""
    many = tables.basis.shape[2]
    form = parts.form[:, :, :, tables.order][:, :, :, :, :, tables.order]
    rows: list = [[None] * 3 for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            right = jnp.einsum("snecx,chx->snexh", form[:, :, :, i, :, j], tables.basis[j])
            rows[i][j] = jnp.einsum("egx,snexh->sngh", tables.basis[i], right)
            rows[j][i] = jnp.swapaxes(rows[i][j], -1, -2)
    # the second and third component have one function less
    kept = [many, many - 1, many - 1]
    stiffness = jnp.concatenate(
        [jnp.concatenate([b[..., :g, :h] for b, h in zip(row, kept, strict=True)], axis=-1) for row, g in zip(rows, kept, strict=True)],
        axis=-2,
    )  # fmt: skip

    def functional(rows):
        by_function = jnp.einsum("seix,iegx->sig", rows[:, :, tables.order], tables.basis)
        return jnp.concatenate([by_function[:, i, :g] for i, g in enumerate(kept)], axis=-1)

    return Assembled(stiffness, functional(parts.volume), functional(parts.charge))
