"""Equations on the sheet of states, for many designs at once: folds, landings, breakdown, and Newton's method for them.

With c(λa, q) = p(λa, q) − p_gas(V(λa, q)), the condition of a loading that fills the membrane to its start, folds have
c = c′ = 0 and cusps c″ = 0 too, a dash being the derivative by λa at fixed q. Equations see the sheet as its Taylor polynomial
of third order at each of their points, so that one compiled program reads the surface for all of them, and derivatives of
equations up to that order are exact.
"""

import functools
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    Chamber,
    ConstantPressure,
    Membrane,
    Scene,
    field_ratio_squared,
    jacobian_program,
    largest_load,
    other_loading,
    run_chunks,
)
from ..numerics import cached_jit
from ..surface import ById, Surface, SurfaceFamily, rows_of

__all__ = ["FarStates", "Solved", "SurfaceConditions", "solve_on_surface"]


_TRIES, _SETTLED = 12, 1e-8  # Newton's last move of p as a share, squared in what is left


class FarStates:
    """p and V at given (λa, q) of one membrane, by Newton's method in p from the pressures of the call before.

    `pressure` (n,) are the first guesses, `steps` those of the shots. What does not converge is NaN.
    """

    def __init__(self, membrane: Membrane, pressure: np.ndarray, steps: float):
        self.membrane, self.pressure, self.steps = membrane, np.array(pressure, float), steps

    def linear(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(p, V) at places (n, 2), and their derivatives (n, 2, 2) by (λa, q).

        From λ2(1) = λ0 at the rim, r(λa, p, q) = 0: ∂p/∂x = −r_x/r_p, and V_x + V_p ∂p/∂x.
        """
        apex, load = places.T
        p, rim = self.pressure.copy(), float(self.membrane.prestretch)
        volume, of_stretch, of_volume = (
            np.full(len(p), np.nan),
            np.full((3, len(p)), np.nan),
            np.full((3, len(p)), np.nan),
        )
        todo = np.flatnonzero(np.isfinite(places).all(axis=1) & (p > 0))
        p[np.setdiff1d(np.arange(len(p)), todo)] = np.nan
        for _ in range(_TRIES):
            if not len(todo):
                break
            u = np.stack([apex[todo], p[todo], load[todo]])
            stretch_change, volume[todo], sensitivities, _ = run_chunks(
                lambda part: jacobian_program(self.membrane.material, part, self.steps), u
            )
            of_stretch[:, todo], of_volume[:, todo] = sensitivities[:, 0], sensitivities[:, 1]
            of_stretch[0, todo] += 1.0
            with np.errstate(all="ignore"):
                move = -(stretch_change - (rim - u[0])) / of_stretch[1, todo]
                move = np.clip(move, -0.5 * u[1], u[1])
            p[todo] += move
            volume[todo] += of_volume[1, todo] * move
            todo = todo[~(np.abs(move) <= _SETTLED * p[todo])]
        p[todo] = np.nan
        self.pressure = np.where(np.isfinite(p), p, self.pressure)
        with np.errstate(all="ignore"):
            slope = -of_stretch[[0, 2]] / of_stretch[1]
            slopes = np.stack([slope, of_volume[[0, 2]] + of_volume[1] * slope])
        return np.stack([p, np.where(np.isfinite(p), volume, np.nan)], axis=1), np.moveaxis(slopes, -1, 0)


_POINTS = (8, 32)  # of one call: few, and many
_ITERATIONS = 14


class SurfaceConditions:
    """The condition of a scene's loading near the points of a design; point 0 is its start.

    `jets` are the Taylor coefficients of (p, V) at every point, `places` the points themselves, (λa, q) or (λa, q, λ0).
    """

    def __init__(self, jets, places, scene: Scene, start):
        self.jets, self.places, self.membrane = jets, places, scene.membrane
        loading = scene.loading
        p0, v0 = self.state(0, start, 0.0)
        if isinstance(loading, ConstantPressure):
            filled, self.condition = p0 - loading.pressure, loading.condition()
        elif not isinstance(loading, Chamber):
            raise other_loading(loading, Chamber, ConstantPressure)
        elif loading.initial_volume is not None:
            filled = v0 - loading.initial_volume
            self.condition = loading.condition(p0, loading.initial_volume)
        else:
            filled = p0 - loading.initial_pressure
            self.condition = loading.condition(loading.initial_pressure, v0)
        #: zero where `start` is the state that the loading fills the membrane to
        self.filled = filled

    def state(self, k: int, apex, q):
        """p and V near point k."""
        at = [apex, q, self.membrane.prestretch][: self.places.shape[-1]]
        x = jnp.stack([jnp.asarray(v, float) for v in at]) - self.places[k]
        zeroth, first, second, third = (t[k] for t in self.jets)
        value = zeroth + first @ x + (second @ x) @ x / 2 + ((third @ x) @ x) @ x / 6
        return value[0], value[1]

    def excess(self, k: int, apex, q):
        """c."""
        p, v = self.state(k, apex, q)
        return self.condition.residual(p, v, q)

    def slope(self, k: int, apex, q):
        """c′."""
        return jax.jvp(lambda a: self.excess(k, a, q), (apex,), (jnp.ones_like(apex),))[1]

    def bend(self, k: int, apex, q):
        """c″."""
        return jax.jvp(lambda a: self.slope(k, a, q), (apex,), (jnp.ones_like(apex),))[1]

    def field(self, apex, q):
        """log (E/E_EB)² at the apex."""
        return jnp.log(q * field_ratio_squared(self.membrane.breakdown, apex, apex))


def _jet(function: Callable, x, order: int):
    if order == 0:
        return (function(x),)

    def lower(x):
        values = _jet(function, x, order - 1)
        return values[-1], values

    highest, values = jax.jacfwd(lower, has_aux=True)(x)
    return (*values, highest)


@cached_jit
def _jets_on_surface(surface: Surface, places):
    """(p, V) at places (n, 2) and their derivatives up to the third."""

    def state(x):
        t = x[1] / surface.membrane.largest_load(x[0])
        return jnp.stack(surface.at_load_fraction(x[0], t, ("pressure", "volume")))

    return jax.vmap(lambda x: _jet(state, x, 3))(places)


@cached_jit
def _jets_in_family(family: SurfaceFamily, places):
    """The same at places (n, 3), by the prestretch too."""

    def state(x):
        t = x[1] / largest_load(family.material, x[0])
        return jnp.stack(family.at_load_fraction(x[0], t, x[2], ("pressure", "volume")))

    return jax.vmap(lambda x: _jet(state, x, 3))(places)


def _jets(surface: Surface | SurfaceFamily, places: np.ndarray) -> list[np.ndarray]:
    flat = places.reshape(-1, places.shape[-1])
    parts = []
    size = _POINTS[len(flat) > _POINTS[0]]
    for i in range(0, len(flat), size):
        own = flat[i : i + size]
        lanes = np.pad(own, ((0, size - len(own)), (0, 0)), mode="edge")
        if isinstance(surface, SurfaceFamily):
            found = _jets_in_family(surface, lanes)
        else:
            found = _jets_on_surface(rows_of(ById(surface)).surface, lanes)
        parts.append([np.asarray(v)[: len(own)] for v in found])
    return [np.concatenate(v).reshape(*places.shape[:-1], *v[0].shape[1:]) for v in zip(*parts, strict=True)]


@functools.cache
def _program(equations: Callable, names: tuple, segment: bool) -> Callable:
    """`_linearised` of some equations, as a program."""

    def linearised(*args):
        return _linearised(equations, names, segment, *args)

    return cached_jit(linearised)


def _linearised(equations, names, segment, scene, jets, places, begin, end, u):
    """Equations and measures (n, …) of designs, and their derivatives by (u, θ)."""

    def one(jets, places, begin, end, u):
        def both(x):
            u, values = x[: len(x) - len(begin)], x[len(x) - len(begin) :]
            if segment:
                values = values + u[-1] * (end - begin)
            design = scene.replace(**dict(zip(names, values, strict=True)))
            rows, measured = equations(SurfaceConditions(jets, places, design, u[0]), u)
            value = jnp.concatenate([jnp.stack(rows), jnp.stack(measured) if measured else jnp.zeros(0)])
            return value, value

        jacobian, value = jax.jacfwd(both, has_aux=True)(jnp.concatenate([u, begin]))
        return value, jacobian

    return jax.vmap(one)(jets, places, begin, end, u)


class Solved(typing.NamedTuple):
    """Unknowns (n, k), measures (n, m), the derivatives of both by θ (n, …, parameters), and the size of Newton's last move."""

    unknowns: np.ndarray
    measures: np.ndarray
    rates: np.ndarray
    slopes: np.ndarray
    size: np.ndarray


def solve_on_surface(
    equations: Callable,
    points: tuple,
    surface: Surface | SurfaceFamily,
    scene: Scene,
    names: tuple,
    guess: np.ndarray,
    begin: np.ndarray,
    end: np.ndarray | None = None,
    *,
    lanes: int = 1,
    last_move: float = 1e-8,
    far: FarStates | None = None,
) -> Solved:
    """Solves `equations(conditions, u) = rows, measures` for designs θ (n, parameters) by Newton's method.

    `points` says where they read the sheet: pairs (unknown that is λa, unknown that is q or −1 for q = 0). With `end` the
    last unknown s is the place between two designs, θ = begin + s (end − begin). Whole blocks of `lanes` designs share one
    compiled program. `far` reads the last of the points where it is given, to first order: equations may take its state,
    no slopes. Newton ends with moves below `last_move`, what is left being their square. NaN where it leaves the sheet.
    """
    segment = end is not None
    u, count = np.array(guess, float), len(guess)
    scale = np.maximum(np.abs(u), 1e-3)
    if segment:
        scale[:, -1] = 1.0
    size = np.full(count, np.inf)
    value = jacobian = np.empty(0)
    unknowns = u.shape[1]
    for _ in range(_ITERATIONS):
        value, jacobian = _evaluated(equations, points, surface, scene, names, u, begin, end, lanes, far)
        matrix = jacobian[:, :unknowns, :unknowns] * scale[:, None, :]
        move, good = _solved(matrix, -value[:, :unknowns, None])
        move = np.where(good[:, None], move[..., 0], np.nan)
        with np.errstate(invalid="ignore"):
            size = np.abs(move).max(axis=1)
            move *= np.minimum(1.0, 0.3 / np.maximum(size, 1e-300))[:, None]
        u = u + move * scale
        if not np.any(size > last_move):
            break
    value, jacobian = _evaluated(equations, points, surface, scene, names, u, begin, end, lanes, far)
    by_u, by_theta = jacobian[..., :unknowns], jacobian[..., unknowns:]
    rate, good = _solved(by_u[:, :unknowns] * scale[:, None, :], -by_theta[:, :unknowns])
    rates = rate * scale[:, :, None]
    slopes = by_theta[:, unknowns:] + by_u[:, unknowns:] @ rates
    return Solved(u, value[:, unknowns:], rates, slopes, np.where(good, size, np.nan))


def _solved(matrix, right) -> tuple[np.ndarray, np.ndarray]:
    """x with matrix x = right, rows scaled, and which systems have one."""
    with np.errstate(all="ignore"):
        size = np.abs(matrix).max(axis=2, keepdims=True)
        matrix, right = matrix / size, right / size
        good = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2))
        good &= np.abs(np.linalg.det(np.where(good[:, None, None], matrix, np.eye(matrix.shape[1])))) > 1e-14
    matrix = np.where(good[:, None, None], matrix, np.eye(matrix.shape[1]))
    return np.linalg.solve(matrix, np.where(good[:, None, None], right, 0.0)), good


def _evaluated(equations, points, surface, scene, names, u, begin, end, lanes, far):
    theta = begin if end is None else begin + u[:, -1:] * (end - begin)
    apex = np.stack([u[:, a] for a, _ in points], axis=1)
    load = np.stack([u[:, q] if q >= 0 else np.zeros(len(u)) for _, q in points], axis=1)
    columns = [apex, load]
    if isinstance(surface, SurfaceFamily):
        rim = (
            theta[:, names.index("prestretch")]
            if "prestretch" in names
            else np.full(len(u), float(scene.membrane.prestretch))
        )
        columns.append(np.broadcast_to(rim[:, None], apex.shape))
    places = np.stack(columns, axis=-1)
    near = places if far is None else places[:, :-1]
    jets = _jets(surface, near)
    if far is not None:
        value, slopes = far.linear(places[:, -1, :2])
        rest = [np.pad(slopes, ((0, 0), (0, 0), (0, places.shape[-1] - 2)))]
        rest += [np.zeros((len(u), *t.shape[2:])) for t in jets[2:]]
        jets = [np.concatenate([t, v[:, None]], axis=1) for t, v in zip(jets, [value, *rest], strict=True)]
    end = begin if end is None else end
    parts = []
    for i in range(0, len(u), lanes):
        own = np.minimum(np.arange(i, i + lanes), len(u) - 1)
        args = [t[own] for t in jets], places[own], begin[own], end[own], u[own]
        found = _program(equations, names, end is not begin)(scene, *args)
        parts.append([np.asarray(v)[: len(u) - i] for v in found])
    return [np.concatenate(v) for v in zip(*parts, strict=True)]
