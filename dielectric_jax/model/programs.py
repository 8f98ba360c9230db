"""The compiled programs of one membrane, each for a fixed number of lanes: values, Jacobians, charge."""

import jax
import jax.numpy as jnp

from ..numerics import cached_jit
from .materials import ArrudaBoyce, Gent, NeoHookean, stresses
from .membrane import field_ratio_squared, slopes
from .resolution import LEAST_NEWTON, TRAIL_BLOCK
from .shooting import UNKNOWNS, eighth_order_step, integrate_membrane

__all__ = ["careful_program", "charge_program", "jacobian_program", "value_program"]


@cached_jit
def jacobian_program(material, u, steps):
    """λ2(1) − λa, V, their columns by (λa, p, q), and the number of zeros of ∂λ2/∂λa in 0 < R < 1."""
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, sensitivities=UNKNOWNS, trail="sensitivity")
    times, sensitivity = shot.trail
    change = jnp.isfinite(times[1:])[:, None] & (sensitivity[1:] * sensitivity[:-1] < 0)
    sensitivities = jnp.stack([jnp.stack(shot.sensitivities[c]) for c in UNKNOWNS])
    return shot.stretch_change, shot.volume, sensitivities, jnp.sum(change, axis=0)


@cached_jit
def charge_program(material, u, steps):
    """C = Q/Φ and its derivatives (3, lanes) by (λa, p, q)."""
    apex, p, q = u
    shot = integrate_membrane(material, apex, p, q, steps, sensitivities=UNKNOWNS, outputs=True)
    return shot.charge, jnp.stack([shot.sensitivities[c][2] for c in UNKNOWNS])


def _least_inside(values, rates):
    """The least of the quintic Hermite interpolants about each inner node that is lower than its neighbours.

    `values` and `rates` (per step) are (nodes, lanes) at equal steps. Returns the value (+inf where there is none), the
    node it belongs to, and its place in steps from that node.
    """
    before, here, after = values[:-2], values[1:-1], values[2:]
    low = (here <= before) & (here <= after) & jnp.isfinite(before) & jnp.isfinite(after)
    before, after = jnp.where(low, before, here), jnp.where(low, after, here)
    slope = rates[1:-1]
    even, odd = (after + before) / 2 - here, (after - before) / 2 - slope
    rise, lift = (rates[2:] - rates[:-2]) / 2, (rates[2:] + rates[:-2]) / 2 - slope
    a4, a5 = (rise - 2 * even) / 2, (lift - 3 * odd) / 2
    a2, a3 = even - a4, odd - a5
    x = jnp.zeros_like(here)  # written out: with `root_find` the program took a tenth longer to compile
    for _ in range(LEAST_NEWTON):
        first = slope + x * (2 * a2 + x * (3 * a3 + x * (4 * a4 + x * 5 * a5)))
        second = 2 * a2 + x * (6 * a3 + x * (12 * a4 + x * 20 * a5))
        x = jnp.clip(x - first / jnp.where(low & (second != 0), second, 1.0), -1.0, 1.0)
    least = here + x * (slope + x * (a2 + x * (a3 + x * (a4 + x * a5))))
    least = jnp.where(low, jnp.minimum(least, here), jnp.inf)
    node = jnp.argmin(least, axis=0)
    return jnp.min(least, axis=0), node + 1, jnp.take_along_axis(x, node[None], axis=0)[0]


@cached_jit
def careful_program(membrane, u, exponent):
    """λ2(1) − λa, V, height and C = Q/Φ by adaptive steps."""
    apex, p, q = u
    shot = integrate_membrane(membrane.material, apex, p, q, exponent, outputs=True, adaptive=True)
    return shot.stretch_change, shot.volume, shot.height, shot.charge


@cached_jit
def value_program(membrane, u, steps):
    """λ2(1) − λa, V, height, C = Q/Φ, least σ2 and largest (E/E_EB)²/q along the membrane, stretches admissible, and elliptic."""
    apex, p, q = u
    material = membrane.material
    shot = integrate_membrane(material, apex, p, q, steps, outputs=True, trail="profile")
    times, values, along = shot.trail
    # blocks overlap by two nodes, so that every inner node has both neighbours in one
    padding = -(len(times) - 2) % TRAIL_BLOCK
    times = jnp.pad(times, (0, padding), constant_values=jnp.inf)
    values = jnp.pad(values, ((0, padding), (0, 0), (0, 0)))

    def hoop(l1, l2):
        return l2 * stresses(material, l1, l2, q)[1]

    def field(l1, l2):
        return -field_ratio_squared(membrane.breakdown, l1, l2)

    functions = (hoop, field)

    def is_elliptic(l1, l2):
        # W(I1) with W' > 0 and W'' ≥ 0 is elliptic wherever it is in tension
        if isinstance(material, (Gent, NeoHookean, ArrudaBoyce)):
            return jnp.ones_like(l1, bool)
        s1, _, s11, _ = stresses(material, l1, l2, q)
        return (s1 > 0) & (s11 > 0)

    def search(block, found):
        least, places, admissible, elliptic = found
        begin = block * TRAIL_BLOCK
        tau = jax.lax.dynamic_slice_in_dim(times, begin, TRAIL_BLOCK + 2)
        rows = jax.lax.dynamic_slice_in_dim(values, begin, TRAIL_BLOCK + 2)
        done = jnp.isfinite(tau)[:, None]
        radius, stretching, l1, l2, theta = along.rows(tau, jnp.where(done[..., None], rows, 0.0))
        rate1, rate2, _ = slopes(material, radius, l1, l2, theta, p, q)
        new_least, new_places = [], []
        for function, old, (old_node, old_x) in zip(functions, least, places, strict=True):
            value, rate = jax.jvp(function, (l1, l2), (rate1, rate2))
            value = jnp.where(done, value, jnp.inf)
            inner, node, x = _least_inside(value, jnp.where(done, rate * stretching / steps, 0.0))
            at_node = jnp.min(value, axis=0)
            best = jnp.minimum(old, jnp.minimum(inner, at_node))
            node = jnp.where(inner < at_node, begin + node, 0)
            new_places.append((jnp.where(best < old, node, old_node), jnp.where(best < old, x, old_x)))
            new_least.append(best)
        inside = jnp.all(material.admissible(l1, l2) | ~done, axis=0)
        elliptic &= jnp.all(is_elliptic(l1, l2) | ~done, axis=0)
        return new_least, new_places, admissible & inside, elliptic

    count = jnp.sum(jnp.isfinite(times))
    nowhere = (jnp.zeros(apex.shape, int), jnp.zeros(apex.shape))
    begin = [f(apex, apex) for f in functions], [nowhere] * 2, material.admissible(apex, apex), is_elliptic(apex, apex)
    least, places, admissible, elliptic = jax.lax.fori_loop(
        0, (count - 2 + TRAIL_BLOCK - 1) // TRAIL_BLOCK, search, begin
    )

    def rates(tau, y):
        radius, stretching = along.position(tau)
        rate1, rate2, bend = slopes(material, radius, apex + y[0], apex + y[1], y[2], p, q)
        return stretching * jnp.stack([rate1, rate2, bend])

    # at an inner extreme the interpolant only says where: one step of the solver from the node says how much
    for k, (function, (node, x)) in enumerate(zip(functions, places, strict=True)):
        inner = node > 0
        tau = jnp.where(inner, times[node], 0.5)
        y = jnp.take_along_axis(values, node[None, None], axis=0)[0]
        y = eighth_order_step(rates, tau, jnp.where(inner, x / steps, 0.0), y)
        least[k] = jnp.where(inner, function(apex + y[0], apex + y[1]), least[k])
    return shot.stretch_change, shot.volume, shot.height, shot.charge, least[0], -least[1], admissible, elliptic
