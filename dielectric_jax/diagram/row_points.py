"""Special points of one loading's contour on rows: folds, zero-voltage states, breakdowns, and the jumps from folds.

Between rows q and V are the polynomials through fourteen of them; what the inner twelve would give differently is
the error. Written for one loading, to be vmapped.
"""

import typing

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..model import ClosingEquation, largest_load
from ..numerics import root_find
from ..surface import ROWS, Conditions, Rows, Surface
from .ramps import LISTED
from .resolution import (
    ALIKE_FOLDS,
    BEND_NEWTON,
    CLOSE_NEWTON,
    DIPS,
    EVENT_NEWTON,
    MERGING_FOLDS,
    NEARLY_BROKEN,
    STENCIL,
    STILL,
    STRETCH_WEIGHT,
)

__all__ = [
    "ContourOnRows",
    "Events",
    "Marks",
    "event_on_surface",
    "first_place",
    "last_place",
]

_FOLDS, _ZEROS, _BREAKS = LISTED.values()
_KINDS = np.repeat([ClosingEquation.fold, ClosingEquation.level, ClosingEquation.breakdown], [_FOLDS, _ZEROS, _BREAKS])


def _stencil_matrices():
    """From values at even rows to monomial coefficients about their middle, and from all but the outer two."""
    unit = (np.arange(STENCIL) - (STENCIL - 1) / 2) / (STENCIL / 2)
    full = np.linalg.inv(np.vander(unit, increasing=True))
    inner = np.zeros_like(full)
    inner[:-2, 1:-1] = np.linalg.inv(np.vander(unit[1:-1], increasing=True))
    return full, inner


_FULL, _INNER = _stencil_matrices()


def _horner(coefficients, x):
    """The polynomial, its slope and its bend (second derivative)."""
    value, slope, bend = coefficients[-1], jnp.zeros_like(x), jnp.zeros_like(x)
    for k in range(len(coefficients) - 2, -1, -1):
        bend = bend * x + 2 * slope
        slope = slope * x + value
        value = value * x + coefficients[k]
    return value, slope, bend


def first_place(mask):
    """The first place where a mask holds, and whether it does anywhere."""
    return jnp.argmax(mask), jnp.any(mask)


def last_place(mask):
    """The last place where a mask holds, and whether it does anywhere."""
    return len(mask) - 1 - jnp.argmax(mask[::-1]), jnp.any(mask)


def _places(mask, count: int):
    """The first `count` places where a mask holds, and how many of them there are."""
    order = jnp.cumsum(mask)
    return jnp.sum(order[None] <= jnp.arange(count)[:, None], axis=1), order[-1]


class ContourOnRows(eqx.Module):
    """One loading's contour: q and V on the rows, valid from row `first` to row `last`."""

    rows: Rows
    load: Float[Array, " rows"]
    volume: Float[Array, " rows"]
    first: Int[Array, ""]
    last: Int[Array, ""]

    def _polynomials(self, row):
        """Polynomials of q and V about a row, and without the outer two rows, in x; the scale of q; place(x)."""
        base = jnp.clip(row - (STENCIL // 2 - 1), self.first, jnp.maximum(self.last - STENCIL + 1, self.first))
        base = jnp.clip(base, 0, ROWS - STENCIL)
        load, volume = (jax.lax.dynamic_slice(v, (base,), (STENCIL,)) for v in (self.load, self.volume))
        scale = jnp.max(jnp.abs(load)) + 1e-300
        values = jnp.stack([load / scale, volume])
        middle = base + (STENCIL - 1) / 2
        return values @ _FULL.T, values @ _INNER.T, scale, lambda x: middle + STENCIL / 2 * x

    def correct(self, row, kind, target):
        """The event that begins at a row: ClosingEquation.fold of q, ClosingEquation.level q = target, or ClosingEquation.breakdown q = q_b(λa).

        Gives its place in rows, q and V there, and the error of both, for folds a fifth of that of λa − λ0 too; the error is
        infinite where Newton ends elsewhere.
        """
        (q_all, v_all), (q_less, v_less), scale, place_of = self._polynomials(row)
        fold = kind == ClosingEquation.fold

        def broken(x):
            return self.rows.surface.breakdown_load(self.rows.apex_at(place_of(x))) / scale

        def function(x, coefficients):
            value, slope, _ = _horner(coefficients, x)
            limit = jnp.where(kind == ClosingEquation.breakdown, broken(x), target / scale)
            return jnp.where(fold, slope, value - limit)

        begin = (row + jnp.where(fold, 0.0, 0.5) - place_of(0.0)) / (STENCIL / 2)
        x = root_find(function, begin, q_all, steps=EVENT_NEWTON, tolerance=None, lower=-1.0, upper=1.0).value
        value, slope = jax.jvp(lambda x: function(x, q_all), (x,), (jnp.ones_like(x),))
        (q, q_slope, _), (v, v_slope, _) = _horner(q_all, x), _horner(v_all, x)
        # what two rows less would change, of the place and at it
        shift = jnp.abs((function(x, q_less) - value) / slope) + jnp.abs(value / slope)
        q_error = jnp.abs(_horner(q_less, x)[0] - q) + jnp.where(
            kind == ClosingEquation.breakdown, jnp.abs(q_slope) * shift, 0.0
        )
        v_error = jnp.abs(_horner(v_less, x)[0] - v) + jnp.abs(v_slope) * shift
        q = jnp.where(kind == ClosingEquation.level, target, q * scale)
        q_error = jnp.where(kind == ClosingEquation.level, 0.0, q_error * scale)
        relative = jnp.maximum(q_error / jnp.maximum(jnp.abs(q), 1e-3), v_error / jnp.maximum(jnp.abs(v), 1e-3))
        # a stiff chamber holds V at its fold, but not λa, which the area strain is made of
        apex, apex_slope = jax.jvp(lambda x: self.rows.apex_at(place_of(x)), (x,), (jnp.ones_like(x),))
        stretched = apex - self.rows.surface.membrane.prestretch
        relative = jnp.maximum(relative, jnp.where(fold, STRETCH_WEIGHT * jnp.abs(apex_slope) * shift / stretched, 0.0))
        near = jnp.abs(x - begin) <= 1.5 / (STENCIL / 2)
        wide = self.last - self.first >= STENCIL - 1
        return place_of(x), q, v, jnp.where(near & wide, relative, jnp.inf)

    def stands_still(self, row):
        """Whether two folds hide about the step from a row to the next, where q changes less than beside it."""
        (q, _), _, _, place_of = self._polynomials(row)
        slope = q[1:] * jnp.arange(1, STENCIL)
        middle = (row + 0.5 - place_of(0.0)) / (STENCIL / 2)
        reach = 1.5 / (STENCIL / 2)

        def bend(x, _):
            return _horner(slope, x)[1]

        bounds = {"lower": middle - reach, "upper": middle + reach}
        x = root_find(bend, middle, steps=BEND_NEWTON, tolerance=None, **bounds).value
        least = _horner(slope, x)[0]
        # against the way from row to row: at the middle the slope may have turned already
        return ~(least * (self.load[row + 1] - self.load[row]) > 0) | ~(jnp.abs(least) > STILL)


class Events(eqx.Module):
    """Events along a contour by rising place, arrays (count,); the place is infinite where there is none."""

    place: Float[Array, " count"]
    load: Float[Array, " count"]
    volume: Float[Array, " count"]
    error: Float[Array, " count"]

    def take(self, index, present: typing.Any = True):
        """One of them, or a part; none where it is not `present`."""
        place, error = (jnp.where(present, v[index], w) for v, w in ((self.place, jnp.inf), (self.error, 0.0)))
        return Events(place, self.load[index], self.volume[index], error)

    def unless(self, change, other):
        """Itself, or `other` where `change` holds."""
        return jax.tree.map(lambda old, new: jnp.where(change, new, old), self, other)

    def after(self, place):
        return self.take(*first_place(self.place > place))

    def before(self, place):
        return self.take(*last_place(self.place < place))

    def seen(self):
        return jnp.isfinite(self.place)


def _events(contour: ContourOnRows, rows, present, kinds, targets) -> Events:
    place, q, v, error = jax.vmap(contour.correct)(rows, kinds, targets)
    return Events(jnp.where(present, place, jnp.inf), q, v, jnp.where(present, error, 0.0))


class Marks(eqx.Module):
    """The special points of a contour, and the jump from each of its folds.

    `peak` tells which folds are maxima of q. `jumps` holds for a peak the next state beyond at its load, for a valley the
    next before it, `rivalled` whether the jump passes a fold of nearly that load. From `unlisted` on the contour may hold
    more than is listed; `hidden` tells that folds may hide between rows.
    """

    folds: Events
    zeros: Events
    breaks: Events
    peak: Bool[Array, " folds"]
    jumps: Events
    rivalled: Bool[Array, " folds"]
    unlisted: Float[Array, ""]
    hidden: Bool[Array, ""]

    @classmethod
    def of(cls, contour: ContourOnRows, above: typing.Any = False) -> "Marks":
        """Those of a contour; `above` tells that it lies above the row after its last, at a load that the surface lacks."""
        q, at = contour.load, jnp.arange(ROWS)
        pairs = (at[:-1] >= contour.first) & (at[1:] <= contour.last)
        rising = q[1:] > q[:-1]
        between = pairs[:-1] & pairs[1:]
        turns = jnp.pad(between & (rising[:-1] != rising[1:]), 1)
        ratio = q / contour.rows.breakdown_load
        # where it does breakdown lies between the two rows if the surface holds it there: the polynomial goes on to it
        ahead = ratio[:-1] + jnp.pad(ratio[1:-1] - ratio[:-2], (1, 0))
        held = contour.rows.top * contour.rows.largest_load > contour.rows.breakdown_load
        leaving = above & (at[:-1] == contour.last) & held[1:] & held[:-1] & (ratio[:-1] < 1) & (ahead > NEARLY_BROKEN)
        masks = (
            turns[:-1],
            pairs & ((q[:-1] < 0) != (q[1:] < 0)),
            leaving | (pairs & ((ratio[:-1] < 1) != (ratio[1:] < 1))),
        )
        counts = _FOLDS, _ZEROS, _BREAKS
        listed = [_places(mask, count) for mask, count in zip(masks, counts, strict=True)]
        begin = jnp.concatenate([rows for rows, _ in listed])
        present = jnp.concatenate([jnp.arange(c) < total for c, (_, total) in zip(counts, listed, strict=True)])
        every = _events(contour, begin, present, jnp.asarray(_KINDS), jnp.zeros(len(begin)))
        marks = [every.take(slice(a, b)) for a, b in ((0, _FOLDS), (_FOLDS, _FOLDS + _ZEROS), (-_BREAKS, None))]
        folds, breaks = marks[0], marks[2]
        beyond = (breaks.place > contour.last) & ((breaks.place > contour.last + 1) | ~jnp.isfinite(breaks.error))
        marks[2] = breaks.take((), ~beyond)
        unlisted = [
            jnp.where(total > count, jnp.max(jnp.where(e.seen(), e.place, 0.0)), jnp.inf)
            for e, count, (_, total) in zip(marks, counts, listed, strict=True)
        ]
        peak = folds.seen() & rising[jnp.clip(listed[0][0] - 1, 0, ROWS - 2)]

        def jump(place, load, up):
            """The row before the next upward crossing of a fold's load, beyond a peak or before a valley."""
            crossing = pairs & (q[:-1] < load) & (q[1:] >= load)
            beyond, before = first_place(crossing & (at[:-1] > place)), last_place(crossing & (at[1:] < place))
            return jax.tree.map(lambda a, b: jnp.where(up, a, b), beyond, before)

        rows, lands = jax.vmap(jump)(folds.place, folds.load, peak)
        lands &= folds.seen()
        jumps = _events(contour, rows, lands, jnp.full(_FOLDS, ClosingEquation.level), folds.load)
        # a jump without landing passes all that lies that way
        low, high = (jnp.where(peak, a, b) for a, b in ((folds.place, jumps.place), (jumps.place, folds.place)))
        low = jnp.where(peak | lands, low, -jnp.inf)
        passed = (
            (folds.place[None] > low[:, None]) & (folds.place[None] < high[:, None]) & (peak[:, None] == peak[None])
        )
        alike = jnp.abs(folds.load[None] - folds.load[:, None]) <= ALIKE_FOLDS * jnp.abs(folds.load[:, None])
        size = jnp.where(pairs, jnp.abs(q[1:] - q[:-1]), 0.0)
        one_way = (rising[:-2] == rising[1:-1]) & (rising[1:-1] == rising[2:]) & between[:-1] & between[1:]
        least = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & (size[1:-1] < MERGING_FOLDS * jnp.max(size))
        dips, total = _places(one_way & least, DIPS)
        still = jax.vmap(contour.stands_still)(dips + 1) & (jnp.arange(DIPS) < total)
        return cls(
            folds=folds,
            zeros=marks[1],
            breaks=marks[2],
            peak=peak,
            jumps=jumps,
            rivalled=jnp.any(passed & alike & folds.seen()[None], axis=1),
            unlisted=jnp.min(jnp.stack(unlisted)),
            hidden=jnp.any(still) | (total > DIPS),
        )


def event_on_surface(surface: Surface, condition: Conditions, kind, target, apex, load):
    """An event found by Newton on the surface itself from a start close by: (λa, p, q, V), and the size of the last move.

    ClosingEquation.fold of q along the loading's contour, ClosingEquation.level q = target, or ClosingEquation.breakdown q = q_b(λa).
    """
    material = surface.membrane.material

    def state(x):
        p, v = surface.at_load_fraction(x[0], x[1], ("pressure", "volume"))
        return jnp.stack([p, v, x[1] * largest_load(material, x[0])])

    def equations(x, _):
        p, v, q = state(x)
        by_p, by_v, by_q = jax.jacfwd(state)(x)
        inside, outside = condition.weight * v + condition.chamber_volume, condition.atmospheric_pressure
        gas = jnp.log(p + outside) + condition.exponent * jnp.log(inside) - jnp.log(condition.constant)
        by_gas = by_p / (p + outside) + condition.exponent * condition.weight * by_v / inside
        size = jax.lax.stop_gradient(jnp.abs(by_gas[1] * by_q[1])) + 1e-300
        fold = (by_gas[0] * by_q[1] - by_gas[1] * by_q[0]) / size
        level = (q - target) / jax.lax.stop_gradient(by_q[1])
        last = jnp.where(
            kind == ClosingEquation.fold,
            fold,
            jnp.where(kind == ClosingEquation.level, level, q / surface.breakdown_load(x[0]) - 1),
        )
        return jnp.stack([gas, last])

    start = jnp.stack([apex, load / largest_load(material, apex)])
    root = root_find(equations, start, steps=CLOSE_NEWTON, tolerance=None)
    x = root.value
    p, v, q = state(x)
    return jnp.stack([x[0], p, q, v]), jnp.where(jnp.abs(x[0] - apex) < 0.1, root.move, jnp.inf)
