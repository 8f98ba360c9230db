"""Many loadings at once on fixed rows of a surface: where each row of λa meets each loading's condition.

A row is one apex stretch. Along it p and V are polynomials of t on four panels, and a chamber's condition

    (p + p_atm) (w V + V_C)ⁿ = κ        (w = 1; constant pressure: w = 0, V_C = 1, p_atm = 0, κ = p, n = 1)

changes sign where the chamber's contour crosses the row. The crossing is found by Newton's method from the secant of the
bracket. Rows are even in y = √((λa − λ0)/(λ_end − λ0)), in which all quantities are smooth down to the flat membrane, so
that along a contour they may be interpolated between rows.
"""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import largest_load
from ..numerics import cached_jit
from .resolution import (
    LOWEST_ROW,
    ROW_ABOVE_BREAKDOWN,
    ROW_BRACKETS,
    ROW_LANES,
    ROW_NEWTON,
    ROW_PANELS,
    ROW_TERMS,
    ROWS,
)
from .surface import ById, Surface

__all__ = ["Conditions", "Rows", "crossings", "rows_of"]


class Conditions(eqx.Module):
    """Loadings as (p + p_atm) (w V + V_C)ⁿ = κ, arrays (loadings,); w is 1, or 0 for a constant pressure."""

    weight: Float[Array, " n"]
    chamber_volume: Float[Array, " n"]
    constant: Float[Array, " n"]
    atmospheric_pressure: Float[Array, " n"]
    exponent: Float[Array, " n"]
    polytropic: bool = eqx.field(static=True)  # else all exponents are 1, and no power is taken

    def power(self, room):
        """roomⁿ and its slope."""
        if not self.polytropic:
            return room, jnp.ones_like(room)
        power = room**self.exponent
        return power, self.exponent * power / room

    def pressure(self, volume):
        """p of the loading at a volume of the membrane."""
        room = self.weight * volume + self.chamber_volume
        return self.constant / self.power(room)[0] - self.atmospheric_pressure


class Rows(eqx.Module):
    """p and V of a surface on its rows, and what an event needs to know of a row.

    `end` is the largest λa of the surface.
    `polynomials` (rows, panels, 2, terms) hold the monomial coefficients of p and V in the panel's own unit −1…1, highest
    last; `bracket_pressure`, `bracket_volume` (rows, brackets + 1) the values at the ends of the brackets; `bottom`, `top`
    (rows,) the loads t between which a row lies, `largest_load` q_max, `breakdown_load` q_b, `flat_pressure` and
    `flat_volume` the state at q = 0, `error` (rows,) what is left of the polynomials.
    """

    surface: Surface
    end: Float[Array, ""]
    apex_stretch: Float[Array, " rows"]
    bottom: Float[Array, " rows"]
    top: Float[Array, " rows"]
    largest_load: Float[Array, " rows"]
    breakdown_load: Float[Array, " rows"]
    polynomials: Float[Array, "rows panels 2 terms"]
    bracket_pressure: Float[Array, "rows brackets"]
    bracket_volume: Float[Array, "rows brackets"]
    flat_pressure: Float[Array, " rows"]
    flat_volume: Float[Array, " rows"]
    error: Float[Array, " rows"]

    def apex_at(self, place):
        """λa at a place between rows, counted in rows from the first."""
        rim = self.surface.membrane.prestretch
        return rim + (self.end - rim) * (LOWEST_ROW + (1 - LOWEST_ROW) * place / (ROWS - 1)) ** 2 * (1 - 1e-12)

    def place_of(self, apex_stretch):
        """The place between rows of a λa, the inverse of `apex_at`."""
        rim = self.surface.membrane.prestretch
        y = jnp.sqrt((apex_stretch - rim) / ((self.end - rim) * (1 - 1e-12)))
        return (y - LOWEST_ROW) / (1 - LOWEST_ROW) * (ROWS - 1)


def _panel_polynomials(panel_values):
    """Monomial coefficients (…, terms), highest last, of values (…, terms) at the Chebyshev–Gauss nodes; their tail."""
    vander = np.polynomial.chebyshev.chebvander(_nodes(), ROW_TERMS - 1)
    chebyshev = np.linalg.solve(vander, panel_values[..., None])[..., 0]
    powers = np.zeros((ROW_TERMS, ROW_TERMS))
    for k in range(ROW_TERMS):
        powers[: k + 1, k] = np.polynomial.chebyshev.cheb2poly(np.eye(ROW_TERMS)[k])[: k + 1]
    tail = np.abs(chebyshev[..., -2:]).max(axis=-1) / np.abs(panel_values).min(axis=-1)
    return chebyshev @ powers.T, tail


def _nodes():
    return -np.cos(np.pi * (np.arange(ROW_TERMS) + 0.5) / ROW_TERMS)


@cached_jit
def _values(surface: Surface, apex, load):
    """p and V (2, rows, places) at places t (rows, places) of some rows."""
    return jnp.stack(surface.at_load_fraction(apex[:, None], load, ("pressure", "volume")))


@functools.lru_cache(maxsize=32)
def rows_of(key: ById) -> Rows:
    """The rows of a surface."""
    surface = key.value
    material = surface.membrane.material
    rim, end = float(surface.membrane.prestretch), float(surface.apex_edges[-1])
    apex = rim + (end - rim) * np.linspace(LOWEST_ROW, 1.0, ROWS) ** 2 * (1 - 1e-12)
    limit = largest_load(material, apex)
    broken = np.asarray(surface.breakdown_load(apex))
    boxes = np.asarray(surface.boxes)
    covered = [boxes[(boxes[:, 0] <= a) & (a <= boxes[:, 1])] for a in apex]
    bottom = np.array([own[:, 2].min(initial=0.0) for own in covered])
    top = np.array([own[:, 3].max(initial=0.0) for own in covered])
    top = np.minimum(top, ROW_ABOVE_BREAKDOWN * np.nan_to_num(broken / limit, nan=1.0))
    panels = list(itertools.pairwise(ROW_PANELS))
    inner = [low + (high - low) * (_nodes() + 1) / 2 for low, high in panels]
    ends = [np.linspace(low, high, ROW_BRACKETS + 1)[1:] for low, high in panels]
    shares = np.minimum(np.concatenate([*inner, [0.0], *ends]), 1 - 1e-12)
    load = np.concatenate([bottom[:, None] + (top - bottom)[:, None] * shares, np.zeros((ROWS, 1))], axis=1)
    parts = [_values(surface, apex[i : i + ROW_LANES], load[i : i + ROW_LANES]) for i in range(0, ROWS, ROW_LANES)]
    values = np.concatenate([np.asarray(v) for v in parts], axis=1)  # p and V (2, rows, places)
    inside, bracket, flat = np.split(values, [len(panels) * ROW_TERMS, -1], axis=2)
    polynomials, tails = _panel_polynomials(inside.reshape(2, ROWS, len(panels), ROW_TERMS))
    return Rows(
        surface=surface,
        end=jnp.asarray(end),
        apex_stretch=jnp.asarray(apex),
        bottom=jnp.asarray(bottom),
        top=jnp.asarray(top),
        largest_load=jnp.asarray(limit),
        breakdown_load=jnp.asarray(broken),
        polynomials=jnp.asarray(np.moveaxis(polynomials, 0, 2)),
        bracket_pressure=jnp.asarray(bracket[0]),
        bracket_volume=jnp.asarray(bracket[1]),
        flat_pressure=jnp.asarray(flat[0, :, 0]),
        flat_volume=jnp.asarray(flat[1, :, 0]),
        error=jnp.asarray(np.max(tails, axis=(0, 2))),
    )


def _chosen(values, panel):
    """The value of each lane's panel."""
    value = values[0]
    for k in range(1, len(ROW_PANELS) - 1):
        value = jnp.where(panel >= k, values[k], value)
    return value


def crossings(rows: Rows, conditions: Conditions):
    """q and V at the first crossing of every row, whether there is one, and whether there are more: (rows, loadings).

    Rows that the surface does not cover have no crossing. The last result tells of a row without crossing whether the
    contour lies above it, or nowhere, for p falls with the load; else below.
    """
    weight, room, outside = conditions.weight, conditions.chamber_volume, conditions.atmospheric_pressure

    def condition(p, v):
        return (p + outside) * conditions.power(weight * v + room)[0] - conditions.constant

    def one(polynomials, pressure, volume):
        values = [condition(pressure[j], volume[j]) for j in range(len(pressure))]
        positive = values[0] > 0
        still, again = jnp.ones_like(positive), jnp.zeros_like(positive)
        low = high = values[0]
        begin = panel = jnp.zeros_like(room)
        first, width = jnp.zeros_like(room), jnp.ones_like(room)  # of the panel, as shares of the row
        for j, value in enumerate(values[1:]):
            same = (value > 0) == positive
            crossed = still & ~same
            high = jnp.where(crossed, value, high)
            begin = jnp.where(crossed, -1 + 2 * (j % ROW_BRACKETS) / ROW_BRACKETS, begin)
            own = j // ROW_BRACKETS
            panel = jnp.where(crossed, float(own), panel)
            first = jnp.where(crossed, ROW_PANELS[own], first)
            width = jnp.where(crossed, ROW_PANELS[own + 1] - ROW_PANELS[own], width)
            still = still & same
            again = again | (same & ~still)
            low = jnp.where(still, value, low)
        x = begin + 2 / ROW_BRACKETS * low / (low - high)

        for _ in range(ROW_NEWTON):
            # the barrier keeps the panel's terms from being stored for the next pass: to choose them anew is cheaper
            x, panel = jax.lax.optimization_barrier((x, panel))
            p_terms, v_terms = ([_chosen(polynomials[:, i, term], panel) for term in range(ROW_TERMS)] for i in (0, 1))
            p, v = p_terms[-1], v_terms[-1]
            p_rate = v_rate = jnp.zeros_like(x)
            for p_term, v_term in zip(p_terms[-2::-1], v_terms[-2::-1], strict=True):
                p_rate, p = p_rate * x + p, p * x + p_term
                v_rate, v = v_rate * x + v, v * x + v_term
            power, power_rate = conditions.power(weight * v + room)
            rate = p_rate * power + (p + outside) * power_rate * weight * v_rate
            move = (conditions.constant - (p + outside) * power) / rate
            x, volume = x + move, v + v_rate * move

        share = first + width * (x + 1) / 2
        return share, volume, ~still & (jnp.abs(move) < 1e-7), again, positive

    share, volume, found, again, above = jax.vmap(one)(rows.polynomials, rows.bracket_pressure, rows.bracket_volume)
    load = rows.bottom[:, None] + (rows.top - rows.bottom)[:, None] * share
    return load * rows.largest_load[:, None], volume, found, again, above
