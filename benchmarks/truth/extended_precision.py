"""Equilibria of Gent membranes from code that shares nothing with the package.

The stresses are written out by hand, the equations integrated from the apex series at the pressure of a given
state. That state's defect at the rim then gives the true pressure and volume: (R, r, z, p) → (cR, cr, cz, p/c) leaves the
equations unchanged, so the state that meets the prestretch at R* instead of 1 has the true pressure p R* and the true
volume V(R*)/R*³. `exact` does so in extended precision on a fixed grid and again on one twice as fine; `exact_scipy`
with SciPy's adaptive integrator in double precision.
"""

import numpy as np
from scipy.integrate import DOP853, solve_ivp

EXTENDED = np.longdouble
_FIRST = 1e-4  # R of the start in units of the apex's radius of curvature; the series leaves its fourth power


def gent(l1, l2, q, limit):
    """s1, s2, ∂s1/∂λ1, ∂s1/∂λ2 of the Gent material at fixed q = Φ²."""
    c = 1 / (l1 * l2) ** 2
    g = 1 - (l1 * l1 + l2 * l2 + c - 3) / limit
    a1, a2 = l1 - c / l1, l2 - c / l2
    return (
        a1 / g - q * l1 * l2**2,
        a2 / g - q * l1**2 * l2,
        (1 + 3 * c / l1**2) / g + 2 * a1**2 / (limit * g**2) - q * l2**2,
        2 * c / (l1 * l2) / g + 2 * a1 * a2 / (limit * g**2) - 2 * q * l1 * l2,
    )


def largest_load(apex, limit):
    """q_max(λa), where the tension of the apex vanishes."""
    return (apex**-2 - apex**-8) / (1 - (2 * apex**2 + apex**-4 - 3) / limit)


def lock_up(limit):
    """The apex stretch at which the Gent denominator is 0.01."""
    low, high = 1.0, np.sqrt(limit + 3)
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if 2 * middle**2 + middle**-4 - 3 < 0.99 * limit else (low, middle)
    return low


def _rates(radius, y, apex, pressure, q, limit):
    """d/dR of λ1 − λa, λ2 − λa, θ, V."""
    l1, l2, theta = apex + y[0], apex + y[1], y[2]
    s1, s2, s11, s12 = gent(l1, l2, q, limit)
    sine, cosine = np.sin(theta), np.cos(theta)
    lean = y[0] - y[1] - 2 * l1 * np.sin(theta / 2) ** 2  # λ1 cos θ − λ2
    return np.stack(
        [
            (s2 * cosine - s1 - s12 * lean) / (radius * s11),
            lean / radius,
            -(s2 / s1) * sine / radius + pressure * l1 * l2 / s1,
            np.pi * (radius * l2) ** 2 * l1 * sine,
        ]
    )


def _start(apex, pressure, q, limit):
    s0, _, s11, s12 = gent(apex, apex, q, limit)
    kappa = pressure * apex**2 / (2 * s0)
    kinematic, force = apex * kappa**2 / 2, -s0 * kappa**2 / 2
    of_a, of_b = 3 * s11 - s12, 3 * s12 - s11
    b = (force - of_a * kinematic) / (of_b + 3 * of_a)
    radius = _FIRST * np.minimum(1 / kappa, 1)
    more1, more2 = (kinematic + 3 * b) * radius**2, b * radius**2
    l1, l2 = apex + more1, apex + more2
    theta = np.arcsin(pressure * radius * l2**2 / (2 * gent(l1, l2, q, limit)[0]))
    return radius, np.minimum(1 / kappa, 1), np.stack([more1, more2, theta, np.pi / 4 * apex**3 * kappa * radius**4])


def _correct(end, rate, pressure, rise):
    """True p and V from the end of a shot at almost the right pressure, and the correction of log R; `rise` is λ0 − λa."""
    shift = (rise - end[1]) / rate[1]
    return pressure * np.exp(shift), (end[3] + rate[3] * shift) * np.exp(-3 * shift), shift


def shoot(apex, pressure, q, limit, steps=280):
    """λ1 − λa, λ2 − λa, θ, V at R = 1 of the shot from (λa, p, q), in the precision of its arguments.

    Half of the steps grow geometrically towards the apex's radius of curvature, half are even in asinh beyond it.
    """
    first, scale, y = _start(apex, pressure, q, limit)
    args = (apex, pressure, q, limit)
    joint = 0.25 * scale
    phases = ((np.log(first), np.log(joint), lambda u: (np.exp(u), np.exp(u))),)
    phases += ((np.arcsinh(joint / scale), np.arcsinh(1 / scale), lambda u: (scale * np.sinh(u), scale * np.cosh(u))),)
    for begin, end, position in phases:
        h = (end - begin) / (steps // 2)

        def slope(u, y, position=position):
            radius, stretching = position(u)
            return stretching * _rates(radius, y, *args)

        for n in range(steps // 2):
            y = _step(slope, begin + n * h, h, y)
    return y


def _step(slope, at, h, y):
    """y(at + h) by one step of the eighth-order method of Dormand and Prince."""
    k = [slope(at, y)]
    for row, c in zip(DOP853.A[1:], DOP853.C[1:], strict=True):
        k.append(slope(at + c * h, y + h * sum(a * v for a, v in zip(row, k, strict=False) if a != 0)))
    return y + h * sum(b * v for b, v in zip(DOP853.B, k, strict=True) if b != 0)


def shoot_on_fixed_grid(apex, pressure, q, limit, rim, steps):
    """True p and V, and the correction of log R, from a shot in so many steps."""
    y = shoot(apex, pressure, q, limit, steps)
    return _correct(y, _rates(np.ones_like(apex), y, apex, pressure, q, limit), pressure, rim - apex)


def rim_pressure(apex, q, limit, rim, rise=0.04):
    """A guess of the pressure of the one state at (λa, q), to a thousandth or better; NaN where λ2 does not come to λ0.

    With p = 1 the shots run on in log R, in steps of `rise`, until λ2 = λ0; there R is the pressure. Arrays (lanes,).
    """
    apex, q, limit, rim = (np.array(v, float) for v in np.broadcast_arrays(apex, q, limit, rim))
    guess = np.full(apex.shape, np.nan)
    with np.errstate(all="ignore"):
        radius, _, y = _start(apex, 1.0, q, limit)
        todo = np.arange(len(apex))
        at = np.log(radius)
        for _ in range(1200):

            def slope(u, y, lanes=todo):
                return np.exp(u) * _rates(np.exp(u), y, apex[lanes], 1.0, q[lanes], limit[lanes])

            after = _step(slope, at, rise, y)
            gap, left = rim[todo] - apex[todo] - y[1], rim[todo] - apex[todo] - after[1]
            passed = left >= 0
            guess[todo[passed]] = np.exp(at[passed] + rise * (gap / (gap - left))[passed])
            on = ~passed & np.isfinite(left)
            todo, at, y = todo[on], at[on] + rise, after[:, on]
            if not len(todo):
                break
    return guess


def states(apex, q, limit, rim, steps=140):
    """True p, V of the one state at (λa, q) of each lane and their uncertainty, from nothing but these."""
    apex, q, limit, rim = np.broadcast_arrays(apex, q, limit, rim)
    guess = rim_pressure(apex, q, limit, rim)
    near = np.asarray(exact(apex, guess, q, limit, rim, steps=steps // 2)[0], float)
    return exact(apex, np.where(np.isfinite(near), near, guess), q, limit, rim, steps=steps)


def exact(apex, pressure, q, limit, rim, steps=140):
    """True p, V at (λa, q) and their uncertainty (the change from half the steps); `pressure` is a close guess.

    All arguments are arrays of one shape (lanes,).
    """
    lanes = [EXTENDED(np.asarray(v, float)) for v in np.broadcast_arrays(apex, pressure, q, limit, rim)]
    with np.errstate(all="ignore"):
        p1, v1, shift = shoot_on_fixed_grid(*lanes, steps // 2)
        lanes[1] = np.where(np.abs(shift) < 1e-2, p1, lanes[1])
        p2, v2, shift = shoot_on_fixed_grid(*lanes, steps)
        again = ~(np.abs(shift) < 1e-8)
        if again.any():
            part = [v[again] for v in lanes]
            part[1] = np.where(np.abs(shift[again]) < 1e-1, p2[again], part[1])
            p2[again], v2[again], shift[again] = shoot_on_fixed_grid(*part, steps)
    uncertain = np.maximum(
        np.abs(p2 - p1) / np.maximum(np.abs(p2), 1e-3), np.abs(v2 - v1) / np.maximum(np.abs(v2), 1e-3)
    )
    bad = ~(np.abs(shift) < 1e-6)
    return [np.where(bad, np.nan, v).astype(v.dtype) for v in (p2, v2)] + [
        np.where(bad, np.inf, uncertain).astype(float)
    ]


def exact_scipy(apex, pressure, q, limit, rim):
    """True p, V of one state by SciPy's DOP853 at a tolerance of 1e-13."""
    args = (apex, pressure, q, limit)
    first, _, y = _start(apex, pressure, q, limit)
    end = solve_ivp(_rates, (first, 1.0), y, method="DOP853", rtol=1e-13, atol=1e-17, args=args).y[:, -1]
    return _correct(end, _rates(1.0, end, *args), pressure, rim - apex)[:2]


def map_scipy(apex, q, limit, rim):
    """True p, V of the one state at (λa, q) by SciPy: with p = 1 integrated to the radius where λ2 = λ0, then scaled."""
    first, _, y = _start(apex, 1.0, q, limit)

    def at_rim(radius, y, *args):
        return apex + y[1] - rim

    at_rim.terminal = True
    args = (apex, 1.0, q, limit)
    found = solve_ivp(_rates, (first, 50.0), y, method="DOP853", rtol=1e-12, atol=1e-15, args=args, events=at_rim)
    if not len(found.t_events[0]):
        return np.nan, np.nan
    radius = found.t_events[0][0]
    return radius, found.y_events[0][0][3] / radius**3
