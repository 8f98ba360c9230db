"""Equations on the manifold of equilibria, for many designs at once: folds, landings, breakdown, and Newton's method for them.

With the loading condition c(λa, q) = p(λa, q) − p_gas(V(λa, q)), of a loading that fills the membrane to its start, folds have
c = c′ = 0, and cusps also c″ = 0, where a prime is the derivative by λa at fixed q. The equations use the surface's Taylor
polynomials of third order at each of their points, so that one compiled program evaluates the surface for all of them, and
derivatives of equations up to that order are exact.
"""

import dataclasses
import functools
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    CHUNK,
    Chamber,
    ConstantPressure,
    Membrane,
    Scene,
    field_ratio_squared,
    jacobian_program,
    largest_load,
    other_loading,
)
from ..numerics import cached_jit, run_lanes
from ..surface import ById, Surface, SurfaceFamily, rows_of
from .resolution import BLOCKS_OF_POINTS, FAR_ITERATIONS, FAR_SETTLED, ITERATIONS

__all__ = ["FarStates", "Solved", "SurfaceConditions", "System", "solve_on_surface"]


class FarStates:
    """p and V at given (λa, q) of one membrane, by Newton's method in p from the pressures of the call before.

    `pressure` (n,) are the first guesses, `steps` the number of steps of the shots. States that do not converge are NaN.
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
        for _ in range(FAR_ITERATIONS):
            if not len(todo):
                break
            u = np.stack([apex[todo], p[todo], load[todo]])
            stretch_change, volume[todo], sensitivities, _ = run_lanes(
                lambda part: jacobian_program(self.membrane.material, part, self.steps), u, sizes=CHUNK
            )
            of_stretch[:, todo], of_volume[:, todo] = sensitivities[:, 0], sensitivities[:, 1]
            of_stretch[0, todo] += 1.0
            with np.errstate(all="ignore"):
                move = -(stretch_change - (rim - u[0])) / of_stretch[1, todo]
                move = np.clip(move, -0.5 * u[1], u[1])
            p[todo] += move
            volume[todo] += of_volume[1, todo] * move
            todo = todo[~(np.abs(move) <= FAR_SETTLED * p[todo])]
        p[todo] = np.nan
        self.pressure = np.where(np.isfinite(p), p, self.pressure)
        with np.errstate(all="ignore"):
            slope = -of_stretch[[0, 2]] / of_stretch[1]
            slopes = np.stack([slope, of_volume[[0, 2]] + of_volume[1] * slope])
        return np.stack([p, np.where(np.isfinite(p), volume, np.nan)], axis=1), np.moveaxis(slopes, -1, 0)


class SurfaceConditions:
    """The loading condition of a scene near the points of a design; point 0 is its start.

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
        #: zero if `start` is the state to which the loading fills the membrane
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
    """The same at places (n, 3), also with derivatives by the prestretch."""

    def state(x):
        t = x[1] / largest_load(family.material, x[0])
        return jnp.stack(family.at_load_fraction(x[0], t, x[2], ("pressure", "volume")))

    return jax.vmap(lambda x: _jet(state, x, 3))(places)


def _jets(surface: Surface | SurfaceFamily, places: np.ndarray) -> list[np.ndarray]:
    def jets(lanes):
        if isinstance(surface, SurfaceFamily):
            return _jets_in_family(surface, lanes)
        return _jets_on_surface(rows_of(ById(surface)).surface, lanes)

    flat = places.reshape(-1, places.shape[-1])
    found = run_lanes(jets, flat, sizes=BLOCKS_OF_POINTS, axis=0, out_axis=0, parallel=False)
    return [v.reshape(*places.shape[:-1], *v.shape[1:]) for v in found]


@functools.cache
def _program(equations: Callable, names: tuple, segment: bool) -> Callable:
    """Equations and measures (n, …) of designs, and their Jacobians by (u, θ), as a program.

    Its arguments are the scene and, for every design, the jets of the surface at its points, those points, the parameters at
    the two ends of its segment, and its unknowns. Without a `segment` both ends are the design itself.
    """

    def linearised(scene, jets, places, begin, end, u):
        def one(jets, places, begin, end, u):
            def both(x):
                u, values = x[: len(x) - len(begin)], x[len(x) - len(begin) :]
                if segment:
                    values = values + u[-1] * (end - begin)
                design = scene.with_values(**dict(zip(names, values, strict=True)))
                rows, measured = equations(SurfaceConditions(jets, places, design, u[0]), u)
                value = jnp.concatenate([jnp.stack(rows), jnp.stack(measured) if measured else jnp.zeros(0)])
                return value, value

            jacobian, value = jax.jacfwd(both, has_aux=True)(jnp.concatenate([u, begin]))
            return value, jacobian

        return jax.vmap(one)(jets, places, begin, end, u)

    return cached_jit(linearised)


@dataclasses.dataclass(frozen=True)
class System:
    """Equations for the unknowns u of designs, and the surface that they evaluate.

    `equations(conditions, u)` gives the rows that vanish and further measures; `points` says where they evaluate the surface: pairs
    (unknown that is λa, unknown that is q or −1 for q = 0). A design θ is the `scene` with the parameters `names` at its
    values. Whole blocks of `lanes` designs share one compiled program. `far` reads the last of the points where it is given,
    to first order: equations may take its state, no slopes.
    """

    equations: Callable
    points: tuple
    surface: Surface | SurfaceFamily
    scene: Scene
    names: tuple
    lanes: int = 1
    far: FarStates | None = None

    def places(self, u: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The points of designs θ on the surface: (λa, q), on a family (λa, q, λ0); an array (n, points, 2 or 3)."""
        apex = np.stack([u[:, a] for a, _ in self.points], axis=1)
        load = np.stack([u[:, q] if q >= 0 else np.zeros(len(u)) for _, q in self.points], axis=1)
        columns = [apex, load]
        if isinstance(self.surface, SurfaceFamily):
            rim = (
                theta[:, self.names.index("prestretch")]
                if "prestretch" in self.names
                else np.full(len(u), float(self.scene.membrane.prestretch))
            )
            columns.append(np.broadcast_to(rim[:, None], apex.shape))
        return np.stack(columns, axis=-1)

    def jets(self, places: np.ndarray) -> list[np.ndarray]:
        """The Taylor coefficients of (p, V) at places (n, points, …), by order; those of a far point beyond the first are 0."""
        if self.far is None:
            return _jets(self.surface, places)
        jets = _jets(self.surface, places[:, :-1])
        value, slopes = self.far.linear(places[:, -1, :2])
        rest = [np.pad(slopes, ((0, 0), (0, 0), (0, places.shape[-1] - 2)))]
        rest += [np.zeros((len(places), *t.shape[2:])) for t in jets[2:]]
        return [np.concatenate([t, v[:, None]], axis=1) for t, v in zip(jets, [value, *rest], strict=True)]

    def linearised(self, u: np.ndarray, begin: np.ndarray, end: np.ndarray | None) -> list[np.ndarray]:
        """Equations and measures (n, …) of designs, and their Jacobians by (u, θ).

        With `end` the last unknown s is the place between two designs, θ = begin + s (end − begin).
        """
        theta = begin if end is None else begin + u[:, -1:] * (end - begin)
        places = self.places(u, theta)
        jets = self.jets(places)
        program = _program(self.equations, self.names, end is not None)
        designs = jets, places, begin, begin if end is None else end, u
        one_call = {"sizes": self.lanes, "axis": 0, "out_axis": 0, "parallel": False}
        return list(run_lanes(lambda part: program(self.scene, *part), designs, **one_call))


class Solved(typing.NamedTuple):
    """Unknowns (n, k), measures (n, m), the derivatives of both by θ (n, …, parameters), and the size of the last Newton step."""

    unknowns: np.ndarray
    measures: np.ndarray
    rates: np.ndarray
    slopes: np.ndarray
    size: np.ndarray


def solve_on_surface(
    system: System, guess: np.ndarray, begin: np.ndarray, end: np.ndarray | None = None, *, last_move: float = 1e-8
) -> Solved:
    """Solves a system for designs θ (n, parameters) by Newton's method from guesses of the unknowns.

    With `end` the last unknown s is the position between two designs, θ = begin + s (end − begin). Newton stops when its steps
    are below `last_move`; the remaining error is of the order of their square. The result is NaN where Newton leaves the
    surface.
    """
    u, count = np.array(guess, float), len(guess)
    scale = np.maximum(np.abs(u), 1e-3)
    if end is not None:
        scale[:, -1] = 1.0
    size = np.full(count, np.inf)
    value = jacobian = np.empty(0)
    unknowns = u.shape[1]
    for _ in range(ITERATIONS):
        value, jacobian = system.linearised(u, begin, end)
        matrix = jacobian[:, :unknowns, :unknowns] * scale[:, None, :]
        move, good = _solved(matrix, -value[:, :unknowns, None])
        move = np.where(good[:, None], move[..., 0], np.nan)
        with np.errstate(invalid="ignore"):
            size = np.abs(move).max(axis=1)
            move *= np.minimum(1.0, 0.3 / np.maximum(size, 1e-300))[:, None]
        u = u + move * scale
        if not np.any(size > last_move):
            break
    value, jacobian = system.linearised(u, begin, end)
    by_u, by_theta = jacobian[..., :unknowns], jacobian[..., unknowns:]
    rate, good = _solved(by_u[:, :unknowns] * scale[:, None, :], -by_theta[:, :unknowns])
    rates = rate * scale[:, :, None]
    slopes = by_theta[:, unknowns:] + by_u[:, unknowns:] @ rates
    return Solved(u, value[:, unknowns:], rates, slopes, np.where(good, size, np.nan))


def _solved(matrix, right) -> tuple[np.ndarray, np.ndarray]:
    """x with matrix x = right, rows scaled, and which systems have a solution."""
    with np.errstate(all="ignore"):
        size = np.abs(matrix).max(axis=2, keepdims=True)
        matrix, right = matrix / size, right / size
        good = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2))
        good &= np.abs(np.linalg.det(np.where(good[:, None, None], matrix, np.eye(matrix.shape[1])))) > 1e-14
    matrix = np.where(good[:, None, None], matrix, np.eye(matrix.shape[1]))
    return np.linalg.solve(matrix, np.where(good[:, None, None], right, 0.0)), good
