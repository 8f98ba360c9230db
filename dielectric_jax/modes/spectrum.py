"""The lowest modes of a state for each circumferential number: eigenvalues, index, shapes, frequencies."""

import dataclasses
import functools
import typing
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BarycentricInterpolator

from ..model import (
    Chamber,
    ChargeControl,
    Membrane,
    PrescribedVolume,
    Scene,
    State,
    Units,
    least_along,
    mechanical,
    plain,
)
from ..numerics import cached_jit, lapack_alone, lowest_eigenpairs, number_below, run_lanes, shown, tridiagonal
from .basis import Tables, apex_sample, coordinate, functions, gauss, tables
from .resolution import (
    COUNTS,
    DROPPED,
    EQUILIBRIUM,
    GAUSS_POINTS,
    HOOP_POINTS,
    LARGEST_NUMBER,
    NEAR_APEX,
    NEUTRAL_TOLERANCE,
    NUMBERS_TOGETHER,
    PROFILE_STEPS,
    ROUNDING,
    SHAPE_POINTS,
    SIGN_SHARE,
    SIZES,
    STATE_ERROR,
    STATES_TOGETHER,
)
from .second_variation import Assembled, Sampled, assembled, sampled

__all__ = [
    "ModeShape",
    "ModeSpectrum",
    "checked_numbers",
    "lowest_eigenvalue",
    "lowest_eigenvalues",
    "lowest_of_numbers",
    "mode_spectrum",
]


@dataclasses.dataclass(frozen=True)
class ModeShape:
    """The displacement U cos nΘ e_r + V sin nΘ e_Θ + W cos nΘ e_z of a mode, z downward: arrays (points,) along R.

    `eigenvalue` is Λ; ∫ (U² + V² + W²) R dR = 1, and the largest of |U|, |V|, |W| is positive.
    """

    number: int
    eigenvalue: float
    radius: np.ndarray
    radial: np.ndarray
    hoop: np.ndarray
    vertical: np.ndarray


@dataclasses.dataclass(frozen=True)
class ModeSpectrum:
    """The lowest eigenvalues of the second variation of a state, for each of the circumferential `numbers`.

    `eigenvalues` (numbers, count) are Λ, lowest first, in μ/(ρA²): squared angular frequencies of a film of density ρ without
    the mass of the air. `index` (numbers,) counts the negative ones, the pair cos and sin once; it is masked where an eigenvalue
    is nearer to zero than its error. `error_estimate` (numbers,) is the largest |error|/max(|Λ|, 1e-3) of a number's eigenvalues.
    `hoop_tension` is the least true hoop stress: where it is negative modes of large n are unstable, as a membrane
    does not resist bending.
    """

    numbers: tuple[int, ...]
    eigenvalues: np.ndarray
    index: np.ma.MaskedArray
    error_estimate: np.ndarray
    hoop_tension: float
    state: State
    _vectors: np.ndarray = dataclasses.field(repr=False)
    _sharpness: float = dataclasses.field(repr=False)

    @property
    def wrinkled(self) -> bool:
        """Whether hoop tension is lost somewhere."""
        return self.hoop_tension < 0

    @property
    def stable(self) -> bool | None:
        """Whether no mode of the `numbers` lowers the energy; None where that is not decided."""
        if (np.asarray(self.index.filled(0)) > 0).any():
            return False
        return None if np.ma.getmaskarray(self.index).any() else True

    def frequency(self, units: Units) -> np.ndarray:
        """√Λ √(μ/ρ)/(2πA) in Hz, (numbers, count); NaN where Λ < 0. Raises ValueError for `units` without a density."""
        if not isinstance(units, Units) or units.density is None:
            raise ValueError(f"`units` must be Units with a density, but is {units!r}.")
        scale = float(np.sqrt(units.shear_modulus / units.density) / (2 * np.pi * units.radius))
        with np.errstate(invalid="ignore"):
            return scale * np.sqrt(np.where(self.eigenvalues >= 0, self.eigenvalues, np.nan))

    def shape(self, number: int, which: int = 0) -> ModeShape:
        """The displacement of the mode of a number, the lowest or the `which`-th above it."""
        if number not in self.numbers:
            raise ValueError(f"`number` must be one of {self.numbers}, but is {number!r}.")
        if not (isinstance(which, int) and 0 <= which < self.eigenvalues.shape[1]):
            raise ValueError(
                f"`which` must be a whole number from 0 to {self.eigenvalues.shape[1] - 1}, but is {which!r}."
            )
        k = self.numbers.index(number)
        radius = np.linspace(0.0, 1.0, SHAPE_POINTS)
        u, v, w = _displacement(self._vectors[k, which], number, self._sharpness, radius)
        largest = max((u, v, w), key=lambda x: np.abs(x).max())
        sign = np.sign(largest[np.argmax(np.abs(largest))])
        return ModeShape(number, float(self.eigenvalues[k, which]), radius, sign * u, sign * v, sign * w)

    def to_json(self, units: Units | None = None) -> dict:
        """State and modes under the names of the JSON contract; frequencies in Hz where `units` carry a density."""
        hertz = None if units is None or units.density is None else self.frequency(units)
        open_ = np.ma.getmaskarray(self.index)
        modes = [
            {
                "number": n,
                "index": None if open_[k] else int(self.index[k]),
                "eigenvalues": self.eigenvalues[k],
                "frequency": None if hertz is None else hertz[k],
                "error_estimate": self.error_estimate[k],
            }
            for k, n in enumerate(self.numbers)
        ]
        return plain({"state": self.state.to_json(), "modes": modes, "hoop_tension": self.hoop_tension})


def mode_spectrum(
    scene: Scene | Membrane,
    state: State | Sequence[State],
    numbers: Iterable[int] = range(13),
    count: int = 3,
    *,
    tolerance: float = 1e-8,
) -> typing.Any:
    """The lowest modes of an equilibrium for each circumferential number n, axisymmetric ones (n = 0) and twist included.

    A mode is an eigenvector of the second variation of the energy against the mass of the film. Modes of n ≥ 1 do not depend on
    the loading; those of n = 0 do: with a `Membrane` pressure and voltage are held, with a `Scene` what its loading holds.

    Args:
        scene: the scene, or the membrane alone.
        state: one equilibrium, or a sequence of them, which are computed side by side.
        numbers: the circumferential numbers, whole, from 0.
        count: how many eigenvalues of each.
        tolerance: relative error of the eigenvalues, |error|/max(|Λ|, 1), up to which the mesh is refined.

    Returns:
        A `ModeSpectrum`, or a list of them.

    Raises:
        ValueError: for bad input, and for a state that is no equilibrium of the membrane.

    >>> from dielectric_jax.model import Gent
    >>> from dielectric_jax.diagram import equilibrium
    >>> film = Membrane(Gent(270.0))
    >>> spectrum = mode_spectrum(film, equilibrium(film, pressure=1.0), numbers=range(3), count=1)
    >>> spectrum.index.tolist(), spectrum.stable
    ([0, 0, 0], True)
    """
    membrane = scene.membrane if isinstance(scene, Scene) else scene
    if not isinstance(membrane, Membrane):
        raise ValueError(f"`scene` must be a Scene or a Membrane, but is a {type(scene).__name__}.")
    given = checked_numbers(numbers, 0)
    if not (isinstance(count, int) and 1 <= count <= COUNTS[-1]):
        raise ValueError(f"`count` must be a whole number from 1 to {COUNTS[-1]}, but is {count!r}.")
    if not 1e-12 <= tolerance <= 1e-2:
        raise ValueError(f"`tolerance` must lie between 1e-12 and 0.01, but is {tolerance!r}.")
    states = [state] if isinstance(state, State) else list(state)
    for s in states:
        if not isinstance(s, State):
            raise ValueError(f"`state` must be a State or a sequence of them, but holds a {type(s).__name__}.")
    found = _spectra(scene, membrane, states, Asked(np.tile(given, (len(states), 1)), count, tolerance))
    return found[0] if isinstance(state, State) else found


def checked_numbers(numbers: Iterable[int], least: int, name: str = "numbers") -> tuple[int, ...]:
    """Circumferential numbers, whole and from `least`; raises ValueError for others."""
    given = tuple(numbers)
    wrong = [n for n in given if not (isinstance(n, (int, np.integer)) and least <= n <= LARGEST_NUMBER)]
    if wrong or not given:
        what = f"one is {shown(wrong[0])}" if wrong else "none is given"
        raise ValueError(f"`{name}` must be whole numbers from {least} to {LARGEST_NUMBER}, but {what}.")
    return tuple(map(int, given))


def _displacement(vector: np.ndarray, number: int, sharpness: float, radius: np.ndarray) -> tuple:
    """U, V, W at radii, of a mode on the functions of its basis."""
    size = (len(vector) - 1) // 3
    odd = bool(number % 2)
    basis = tables(size, GAUSS_POINTS[0], odd)
    xi = np.maximum(apex_sample(sharpness, radius), NEAR_APEX)
    first = (basis.free @ vector[: size + 1]) @ functions(0, size + 1, xi)[0]
    second = vector[size + 1 : 2 * size + 1] @ functions(2 if odd else 1, size, xi)[0]
    third = vector[2 * size + 1 :] @ functions(1, size, xi)[0]
    parts = np.stack([first, second, third]) * np.asarray(coordinate(sharpness, xi).scale)
    a, b, w = parts[np.argsort(basis.order)]
    return (a + b) / np.sqrt(2), (a - b) / np.sqrt(2), w


class _Level(typing.NamedTuple):
    """What one basis gives of states: arrays with the states in front, then the numbers.

    `values` and `error`, that of the basis, hold one eigenvalue more than asked for; `below` counts the eigenvalues below −δ, 0 and
    δ, the largest error with that of the state.
    """

    values: np.ndarray
    error: np.ndarray
    below: np.ndarray
    vectors: np.ndarray
    hoop: np.ndarray
    sharpness: np.ndarray
    stretch_change: np.ndarray


class Asked(typing.NamedTuple):
    """What is asked of states: the numbers of each, (states, numbers), how many eigenvalues, and how exact; or only the lowest's sign."""

    numbers: np.ndarray
    count: int
    tolerance: float | None

    def of(self, states: list[int]) -> "Asked":
        """What is asked of some of the states."""
        return self._replace(numbers=self.numbers[states])


def _spectra(scene, membrane: Membrane, states: list[State], asked: Asked) -> list:
    u = np.array([[s.apex_stretch, s.pressure, s.voltage_squared] for s in states]).reshape(-1, 3)
    holds = np.array([[*_held(scene, s), s.error_estimate] for s in states]).reshape(-1, 4)
    found = _converged(membrane, u, holds, asked)
    return [_judged(membrane, *own) for own in zip(states, asked.numbers, found, strict=True)]


def _converged(membrane: Membrane, u: np.ndarray, holds: np.ndarray, asked: Asked) -> list[_Level]:
    """Of each state (λa, p, q), rows of `u`, the first basis that is right to the tolerance, or the largest."""
    found: list = [None] * len(u)
    todo = list(range(len(u)))
    for level in range(len(SIZES)):
        if not todo:
            break
        here = level_of(membrane, (u[todo], holds[todo]), asked.of(todo), level)
        again = []
        for k, i in enumerate(todo):
            before = found[i]
            found[i] = _compared(before, jax.tree.map(lambda v, k=k: v[k], here))
            if not _is_right(before, found[i], asked):
                again.append(i)
        todo = again
    return found


def _compared(before: _Level | None, level: _Level) -> _Level:
    """A level whose error is at least its difference from the one before, where hoop tension is lost.

    There a layer under compression may be thinner than what a basis resolves, which its own last functions do not show.
    """
    if level.hoop.min() >= 0:
        return level
    apart = np.inf if before is None else np.abs(level.values - before.values)
    return level._replace(error=np.maximum(level.error, apart))


def _is_right(before: _Level | None, level: _Level, asked: Asked) -> bool:
    """Whether eigenvalues are right to the tolerance, and all negative ones are among them or as many on the basis before."""
    values, error = (v[:, : asked.count] for v in (level.values, level.error))
    if asked.tolerance is None:
        return bool((error <= SIGN_SHARE * np.abs(values)).all())
    with np.errstate(invalid="ignore"):
        near = error <= asked.tolerance * np.maximum(np.abs(values), 1.0)
    negative = level.below[:, 1]
    counted = (negative <= asked.count) | (before is not None and negative == before.below[:, 1])
    return bool(near.all() and counted.all())


def lowest_eigenvalues(membrane: Membrane, u: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """The lowest eigenvalue (states,) of a number n ≥ 1 of each of the equilibria u (3, states): λa, p, q."""
    found = np.empty(u.shape[1])
    for odd in (0, 1):
        own = np.flatnonzero(np.asarray(numbers) % 2 == odd)
        if len(own):
            asked = Asked(np.asarray(numbers)[own, None], 1, NEUTRAL_TOLERANCE)
            levels = _converged(membrane, u.T[own], np.zeros((len(own), 4)), asked)
            found[own] = [level.values[0, 0] for level in levels]
    return found


def lowest_eigenvalue(material, u: jax.Array, number: int) -> jax.Array:
    """The lowest eigenvalue of a number n ≥ 1 at u = (λa, p, q), on the largest basis, to be differentiated.

    By LAPACK's full solver, whose derivatives JAX knows.
    """
    size, points = SIZES[-1], GAUSS_POINTS[-1]
    states = sampled(points)(material, u[:, None], np.asarray(PROFILE_STEPS[-1]))
    parts = jax.tree.map(lambda v: v[0], assembled(states, tables(size, points, bool(number % 2))))
    matrix = _matrices(parts, jnp.zeros(5).at[4].set(1.0), jnp.array([float(number)]))[0]
    return jnp.linalg.eigh(matrix)[0][0]


def lowest_of_numbers(membrane: Membrane, u: np.ndarray, numbers: Sequence[int]) -> np.ma.MaskedArray:
    """The lowest eigenvalue of each number n ≥ 1, (states, numbers), at equilibria u (3, states), masked where its sign is not decided.

    Near the cone to which an apex sharpens no basis resolves the modes.
    """
    asked = Asked(np.tile(np.asarray(numbers), (u.shape[1], 1)), 1, None)
    levels = _converged(membrane, np.asarray(u, float).T, np.zeros((u.shape[1], 4)), asked)
    values, error = (
        np.array([v[:, 0] for v in rows])
        for rows in zip(*((level.values, level.error) for level in levels), strict=True)
    )
    return np.ma.MaskedArray(values, mask=~(error <= SIGN_SHARE * np.abs(values)))


def _judged(membrane: Membrane, state: State, numbers: np.ndarray, level: _Level) -> ModeSpectrum:
    """The spectrum of a state from one basis, which gives one eigenvalue more than asked for."""
    count = level.values.shape[1] - 1
    whole = level.error + STATE_ERROR * state.error_estimate * np.abs(level.values[:, -1:])
    values, error = level.values[:, :count], whole[:, :count]
    defect = abs(float(level.stretch_change) - (float(membrane.prestretch) - state.apex_stretch))
    if not defect <= EQUILIBRIUM * state.apex_stretch and np.isfinite(values).all():
        raise ValueError(f"`state` must be an equilibrium of the membrane, but is {state!r}.")
    estimate = np.max(error / np.maximum(np.abs(values), 1e-3), axis=1)
    near = (level.below[:, 0] != level.below[:, 2]) | ~(whole < np.abs(level.values)).all(axis=1)
    index = np.ma.MaskedArray(level.below[:, 1].astype(int), mask=near)
    kept = {"_vectors": level.vectors[:, :count], "_sharpness": float(level.sharpness)}
    return ModeSpectrum(tuple(map(int, numbers)), values, index, estimate, _least(level.hoop), state, **kept)


def _least(hoop: np.ndarray) -> float:
    """The least hoop stress, of the polynomial in ξ² through the apex, the Gauss points and the rim."""
    x = np.concatenate([[0.0], gauss(len(hoop) - 2)[0], [1.0]])
    along = BarycentricInterpolator(x, hoop)
    points = np.linspace(0.0, 1.0, HOOP_POINTS)
    return least_along(points, np.asarray(along(points**2)))[0]


def _held(scene: Scene | Membrane, state: State) -> list[float]:
    """What a loading adds to the second variation for n = 0: the gas stiffness k, whether V is held, and q where Q is held."""
    loading = mechanical(scene.loading) if isinstance(scene, Scene) else None
    stiffness = 0.0
    if isinstance(loading, Chamber):
        stiffness = float(loading.condition(state.pressure, state.volume).gas_stiffness(state.volume))
    charged = isinstance(scene, Scene) and isinstance(scene.loading, ChargeControl)
    return [stiffness, float(isinstance(loading, PrescribedVolume)), state.voltage_squared if charged else 0.0]


def level_of(membrane: Membrane, lanes: tuple, asked: Asked, level: int) -> _Level:
    """One basis for states (λa, p, q) and what their loadings hold; numbers of one column have one parity."""
    size, points, together = SIZES[level], GAUSS_POINTS[level], STATES_TOGETHER[level]
    steps = np.asarray(PROFILE_STEPS[level])
    u, holds = lanes
    sample, modes = _sampling(points), _modes(size, next(n for n in COUNTS if n >= asked.count))
    states = run_lanes(
        lambda u: sample(membrane.material, u.T, steps), u, sizes=together, axis=0, out_axis=0, parallel=False
    )
    blocks, places = [], []
    width = next(w for w in NUMBERS_TOGETHER if w >= min(asked.numbers.shape[1], NUMBERS_TOGETHER[-1]))
    for odd in (False, True):
        own = np.flatnonzero(asked.numbers[0] % 2 == odd)
        basis = tables(size, points, odd)
        for first in range(0, len(own), width):
            part = own[first : first + width]
            numbers = np.pad(asked.numbers[:, part].astype(float), ((0, 0), (0, width - len(part))), mode="edge")

            def run(own, basis=basis):
                with lapack_alone():
                    return jax.block_until_ready(modes(*own, basis))

            found = run_lanes(run, (states, holds, numbers), sizes=together, axis=0, out_axis=0, parallel=False)
            places += list(part)
            blocks.append([v[:, : len(part)] for v in found])
    back = np.argsort(places)
    values, error, below, vectors = (np.concatenate(v, axis=1)[:, back] for v in zip(*blocks, strict=True))
    values, error = (v[:, :, : asked.count + 1] for v in (values, error))
    return _Level(values, error, below, vectors, states.hoop, states.sharpness, states.stretch_change)


@functools.cache
def _sampling(points: int):
    """States at Gauss points, as a compiled program."""
    return cached_jit(sampled(points))


@functools.cache
def _modes(size: int, count: int):
    """The lowest modes of states and numbers of one parity, as a compiled program: the first fields of `_Level`."""

    def modes(states: Sampled, holds, numbers, basis: Tables):
        parts = assembled(states, basis)
        lanes, many = numbers.shape
        holds = jnp.concatenate([holds, states.capacitance[:, None]], axis=1)
        matrices = jax.vmap(_matrices)(parts, holds, numbers)
        matrices = matrices.reshape(lanes * many, *matrices.shape[2:])
        t = tridiagonal(matrices)
        values, vectors = lowest_eigenpairs(matrices, t, count + 1)
        few, more = (_truncated(d * DROPPED, matrices, values, vectors, numbers.ravel(), basis) for d in (1, 2))
        # the error falls with the functions like a geometric sequence; half of the next ratio is kept as a margin
        error = few * jnp.sqrt(jnp.minimum(few / jnp.maximum(more, 1e-300), 1.0))
        error = error + ROUNDING * jnp.abs(values[:, -1:])
        # no basis lessens what the state's own error does
        own = STATE_ERROR * jnp.repeat(holds[:, 3], many)[:, None] * jnp.abs(values[:, -1:])
        largest = jnp.max(error + own, axis=1)
        below = number_below(t, jnp.stack([-largest, jnp.zeros_like(largest), largest])).T
        found = values, error, below, jnp.swapaxes(vectors, 1, 2)
        return tuple(v.reshape(lanes, many, *v.shape[1:]) for v in found)

    return cached_jit(modes)


def _truncated(dropped: int, matrices, values, vectors, numbers, basis: Tables):
    """How much an eigenvalue rises without the last functions of each component: tᵀ(A − Λ)t of what they hold of its vector."""
    size = basis.basis.shape[2] - 1
    many = np.array([size + 1, size, size])
    last = np.concatenate([np.arange(m) >= m - dropped for m in many])
    # for n ≤ 1 the first component is free at the apex
    free = jnp.einsum("fg,mgk->mfk", basis.free, vectors[:, : size + 1])
    free = jnp.einsum("fg,mfk->mgk", basis.free, jnp.where(last[: size + 1, None], free, 0.0))
    pinned = np.arange(size + 1) >= size - dropped
    first = jnp.where((numbers > 1)[:, None, None], jnp.where(pinned[:, None], vectors[:, : size + 1], 0.0), free)
    kept = jnp.concatenate([first, jnp.where(last[size + 1 :, None], vectors[:, size + 1 :], 0.0)], axis=1)
    return jnp.abs(jnp.sum(kept * (matrices @ kept), axis=1) - values * jnp.sum(kept**2, axis=1))


def _matrices(parts: Assembled, holds, numbers):
    """The second variation (numbers, N, N) of one state.

    For n ≥ 2 the first component vanishes at the apex too, and a spring takes the place of the function that does not.
    """
    k, n = parts.stiffness, numbers[:, None, None]
    stiffness = k[0] + n * k[1] + n**2 * k[2]
    size = (k.shape[-1] - 1) // 3
    spring = jnp.max(jnp.diagonal(k[0]))
    unit = np.zeros(k.shape[-1])
    unit[size] = 1.0
    held = jnp.where(numbers > 1, 0.0, 1.0)[:, None, None]
    without = stiffness * (1 - unit[:, None]) * (1 - unit)
    stiffness = jnp.where(held == 0, without + spring * np.outer(unit, unit), stiffness)
    return stiffness + jnp.where(n == 0, _held_forms(parts, holds, stiffness[0]), 0.0)


def _held_forms(parts: Assembled, holds, stiffness):
    """What gas, a held charge and a held volume add for n = 0: k (δV)²/(2π), (q/C)(δC)²/(2π), and δV out of the space."""
    gas, electric = holds[0], holds[2] / holds[4]
    added = (gas * jnp.outer(parts.volume, parts.volume) + electric * jnp.outer(parts.charge, parts.charge)) / (
        2 * jnp.pi
    )
    line = holds[1] * parts.volume / jnp.maximum(jnp.linalg.norm(parts.volume), 1e-300)
    across = jnp.eye(len(line)) - jnp.outer(line, line)
    whole = stiffness + added
    stiff = jnp.max(jnp.abs(jnp.diag(whole)))
    return across @ whole @ across + stiff * jnp.outer(line, line) - stiffness
