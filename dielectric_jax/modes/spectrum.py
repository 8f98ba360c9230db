"""The lowest modes of a state for each circumferential number: eigenvalues, index, shapes, frequencies."""

import dataclasses
import functools
import threading
import typing
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

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
from ..numerics import cached_jit, run_lanes
from .basis import lagrange, lobatto
from .resolution import (
    COUNTS,
    ELEMENTS,
    EQUILIBRIUM,
    LARGEST_NUMBER,
    NEUTRAL_TOLERANCE,
    NUMBERS_TOGETHER,
    PROFILE_STEPS,
    ROUNDING,
    SHAPE_POINTS,
    SIGN_TOLERANCE,
    STATE_ERROR,
    STATES_TOGETHER,
)
from .second_variation import Assembled, assembled, edges_of

__all__ = ["ModeShape", "ModeSpectrum", "checked_numbers", "lowest_eigenvalues", "mode_spectrum", "unstable_numbers"]

# on the CPU two programs that hold eigensolvers wait for each other forever where XLA has two threads
_ONE_AT_A_TIME = threading.Lock()


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
    _edges: np.ndarray = dataclasses.field(repr=False)

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
        vector = self._vectors[k, which]
        elements = len(self._edges) - 1
        degree = (len(vector) - 1) // elements
        radius = np.linspace(0.0, 1.0, SHAPE_POINTS)
        e = np.clip(np.searchsorted(self._edges, radius, side="right") - 1, 0, elements - 1)
        share = (radius - self._edges[e]) / (self._edges[e + 1] - self._edges[e])
        values, _ = lagrange(lobatto(degree), share)
        local = vector[e[:, None] * degree + np.arange(degree + 1)]
        u, v, w = np.einsum("ka,kai->ik", values, local)
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
    found = _spectra(scene, membrane, states, Asked(given, count, tolerance))
    return found[0] if isinstance(state, State) else found


def checked_numbers(numbers: Iterable[int], least: int) -> tuple[int, ...]:
    """Circumferential numbers, whole and from `least`; raises ValueError for others."""
    given = tuple(numbers)
    wrong = [n for n in given if not (isinstance(n, (int, np.integer)) and least <= n <= LARGEST_NUMBER)]
    if wrong or not given:
        raise ValueError(
            f"`numbers` must be whole numbers from {least} to {LARGEST_NUMBER}, at least one, but are {wrong or given!r}."
        )
    return tuple(map(int, given))


class _Level(typing.NamedTuple):
    """What one mesh gives of states: arrays with the states in front, then the numbers; the last of the values is not exact."""

    values: np.ndarray
    negative: np.ndarray
    vectors: np.ndarray
    edges: np.ndarray
    stretch_change: np.ndarray
    radius: np.ndarray
    hoop: np.ndarray


class Asked(typing.NamedTuple):
    """What is asked of every state."""

    numbers: tuple[int, ...]
    count: int
    tolerance: float
    counted: bool = True  # whether two meshes must have as many negative modes


def _spectra(scene, membrane: Membrane, states: list[State], asked: Asked) -> list:
    u = np.array([[s.apex_stretch, s.pressure, s.voltage_squared] for s in states]).reshape(-1, 3)
    holds = np.array([_held(scene, s) for s in states]).reshape(-1, 3)
    pairs = _converged(membrane, u, holds, asked)
    return [_judged(membrane, state, asked, *pair) for state, pair in zip(states, pairs, strict=True)]


def _converged(membrane: Membrane, u: np.ndarray, holds: np.ndarray, asked: Asked) -> list[tuple[_Level, _Level]]:
    """Of each state (λa, p, q), rows of `u`, the first two meshes that agree to the tolerance, or the two finest."""
    last: dict[int, _Level] = {}
    found: list = [None] * len(u)
    todo = list(range(len(u)))
    for level in range(len(ELEMENTS)):
        if not todo:
            break
        here = level_of(membrane, (u[todo], holds[todo]), asked, level)
        for k, i in enumerate(todo):
            one = _Level(*(v[k] for v in here))
            found[i] = (last[i], one) if i in last else None
            last[i] = one
        todo = [i for i in todo if found[i] is None or not _agree(*found[i], asked)]
    return found


def _agree(coarse: _Level, fine: _Level, asked: Asked) -> bool:
    """Whether two meshes give the same eigenvalues, to the tolerance, and the same indices."""
    values, others = (level.values[:, : asked.count] for level in (fine, coarse))
    with np.errstate(invalid="ignore"):
        near = np.abs(values - others) <= asked.tolerance * np.maximum(np.abs(values), 1.0)
    return bool(near.all() and (not asked.counted or (fine.negative == coarse.negative).all()))


def lowest_eigenvalues(membrane: Membrane, u: np.ndarray, number: int, count: int) -> np.ndarray:
    """The `count` lowest eigenvalues (states, count) of a number n ≥ 1 at equilibria u (3, states): λa, p, q."""
    asked = Asked((number,), count, NEUTRAL_TOLERANCE, counted=False)
    pairs = _converged(membrane, np.asarray(u, float).T, np.zeros((u.shape[1], 3)), asked)
    return np.array([fine.values[0, :count] for _, fine in pairs]).reshape(-1, count)


def unstable_numbers(membrane: Membrane, u: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
    """Whether a mode of each number n ≥ 1 lowers the energy, (states, numbers), at equilibria u (3, states): λa, p, q."""
    asked = Asked(tuple(numbers), 1, SIGN_TOLERANCE, counted=False)
    pairs = _converged(membrane, np.asarray(u, float).T, np.zeros((u.shape[1], 3)), asked)
    return np.array([fine.values[:, 0] < 0 for _, fine in pairs]).reshape(-1, len(asked.numbers))


def _judged(membrane: Membrane, state: State, asked: Asked, coarse: _Level, fine: _Level) -> ModeSpectrum:
    """The spectrum of a state from two meshes."""
    count = asked.count
    values, more = fine.values[:, :count], fine.values[:, : count + 1]
    defect = abs(float(fine.stretch_change) - (float(membrane.prestretch) - state.apex_stretch))
    if not defect <= EQUILIBRIUM * state.apex_stretch and np.isfinite(values).all():
        raise ValueError(f"`state` must be an equilibrium of the membrane, but is {state!r}.")
    with np.errstate(invalid="ignore"):
        error = np.abs(more - coarse.values[:, : count + 1])
        error += (ROUNDING + STATE_ERROR * state.error_estimate) * np.abs(more[:, -1:])
        near = (fine.negative != coarse.negative) | ~(np.abs(more) > error).all(axis=1)
    estimate = np.max(error[:, :count] / np.maximum(np.abs(values), 1e-3), axis=1)
    index = np.ma.MaskedArray(fine.negative.astype(int), mask=near)
    hoop = least_along(fine.radius, fine.hoop)[0]
    kept = {"_vectors": fine.vectors[:, :count], "_edges": fine.edges}
    return ModeSpectrum(asked.numbers, values, index, estimate, hoop, state, **kept)


def _held(scene: Scene | Membrane, state: State) -> list[float]:
    """What a loading adds to the second variation for n = 0: the gas stiffness k, whether V is held, and q where Q is held."""
    loading = mechanical(scene.loading) if isinstance(scene, Scene) else None
    stiffness = 0.0
    if isinstance(loading, Chamber):
        stiffness = float(loading.condition(state.pressure, state.volume).gas_stiffness(state.volume))
    charged = isinstance(scene, Scene) and isinstance(scene.loading, ChargeControl)
    return [stiffness, float(isinstance(loading, PrescribedVolume)), state.voltage_squared if charged else 0.0]


def level_of(membrane: Membrane, lanes: tuple, asked: Asked, level: int) -> _Level:
    """One mesh for states (λa, p, q) and what their loadings hold."""
    program, blocks = _program(*ELEMENTS[level], next(n for n in COUNTS if n >= asked.count)), []
    steps = np.asarray(PROFILE_STEPS[level])
    for first in range(0, len(asked.numbers), NUMBERS_TOGETHER):
        own = np.array(asked.numbers[first : first + NUMBERS_TOGETHER], float)
        padded = np.pad(own, (0, NUMBERS_TOGETHER - len(own)), mode="edge")

        def modes(part, n=padded):
            with _ONE_AT_A_TIME:
                return jax.block_until_ready(program(membrane.material, *part, n, steps))

        found = run_lanes(modes, lanes, sizes=STATES_TOGETHER, axis=0, out_axis=0, parallel=False)
        blocks.append([v[:, : len(own)] for v in found[:3]])
    return _Level(*(np.concatenate(parts, axis=1) for parts in zip(*blocks, strict=True)), *found[3:])


@functools.cache
def _program(elements: int, degree: int, count: int):
    """The lowest modes of states and numbers on one mesh, as a compiled program; the fields of `_Level`."""
    assemble = assembled(elements, degree)

    def modes(material, u, holds, numbers, steps):
        parts, stretch_change, hoop = assemble(material, u.T, steps)
        edges = jnp.moveaxis(edges_of(material, u.T, elements), -1, 0)
        lowest = functools.partial(_modes_of, count)
        each = jax.vmap(jax.vmap(lowest, in_axes=(None, None, 0)), in_axes=(0, 0, None))
        found = each(parts, holds, numbers)
        return (*found, edges, stretch_change, *hoop)

    return cached_jit(modes)


def _modes_of(count: int, parts: Assembled, holds, n):
    """The `count` lowest modes of one state and number n: eigenvalues and the next one, how many are negative, and nodal vectors.

    At the apex U = V = 0 for n = 0, U + V = 0 and W = 0 for n = 1, and all vanish beyond: one unknown stands for what is left
    there, a spring where nothing is.
    """
    nodes = len(parts.mass)
    free = jnp.where(n == 0, jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, -1.0, 0.0]) / jnp.sqrt(2.0))
    apex = jnp.where(n <= 1, free, 0.0)
    stiffness = parts.stiffness[0] + n * parts.stiffness[1] + n**2 * parts.stiffness[2]
    mass = jnp.einsum("ab,ij->aibj", parts.mass, jnp.eye(3))

    def reduced(whole):
        inner = whole[1:-1, :, 1:-1, :].reshape(3 * (nodes - 2), -1)
        side = jnp.einsum("i,ibj->bj", apex, whole[0, :, 1:-1, :]).reshape(-1)
        corner = apex @ whole[0, :, 0, :] @ apex
        return jnp.block([[corner[None, None], side[None]], [side[:, None], inner]])

    matrix, weight = reduced(stiffness), reduced(mass)
    pinned = jnp.where(n <= 1, 0.0, 1.0)
    weight = weight.at[0, 0].add(pinned)
    matrix = matrix.at[0, 0].add(pinned * jnp.abs(matrix[1, 1] / weight[1, 1]))
    volume, charge = (
        jnp.where(n == 0, jnp.concatenate([(apex @ f[0])[None], f[1:-1].reshape(-1)]), 0.0)
        for f in (parts.volume, parts.charge)
    )
    # what a gas and a held charge add: k (δV)²/(2π) and (q/C)(δC)²/(2π)
    gas, electric = holds[0], holds[2] / parts.capacitance
    matrix = matrix + (gas * jnp.outer(volume, volume) + electric * jnp.outer(charge, charge)) / (2 * jnp.pi)
    root = jnp.linalg.cholesky(weight)
    scaled = _conjugated(root, matrix)
    # a held volume: the direction of δV out of the space
    line = jax.scipy.linalg.solve_triangular(root, volume, lower=True)
    line = holds[1] * line / jnp.maximum(jnp.linalg.norm(line), 1e-300)
    across = jnp.eye(len(line)) - jnp.outer(line, line)
    scaled = across @ scaled @ across + jnp.max(jnp.abs(jnp.diag(scaled))) * jnp.outer(line, line)
    values, vectors = jnp.linalg.eigh(scaled)
    modes = jax.scipy.linalg.solve_triangular(root.T, vectors[:, :count], lower=False)
    # rounding of the eigensolver is that of the largest eigenvalue; that of the quotient is not
    exact = jnp.einsum("ik,ij,jk->k", modes, matrix, modes)
    negative = jnp.sum(values[count:] < 0) + jnp.sum(exact < 0)
    inner = modes[1:].T.reshape(count, nodes - 2, 3)
    ends = modes[0][:, None, None] * apex, jnp.zeros((count, 1, 3))
    return jnp.append(exact, values[count]), negative, jnp.concatenate([ends[0], inner, ends[1]], axis=1)


def _conjugated(root, matrix):
    """L⁻¹ A L⁻ᵀ, symmetric."""
    half = jax.scipy.linalg.solve_triangular(root, matrix, lower=True)
    whole = jax.scipy.linalg.solve_triangular(root, half.T, lower=True)
    return (whole + whole.T) / 2
