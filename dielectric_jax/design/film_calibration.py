"""Constants of a viscoelastic material from tests of films in time: relaxation, loading and unloading."""

import dataclasses
import functools
import typing
from collections.abc import Callable, Sequence

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..model import (
    FILM_MODES,
    AbstractMaterial,
    FilmState,
    Maxwell,
    NeoHookean,
    Sampled,
    Units,
    Viscoelastic,
    film_of,
    film_states,
    spring_and_branches,
)
from ..numerics import cached_jit, shown
from .calibration import Fit, best_fit, check_intervals, check_options, finite_or_none, intervals_of, misfit_warnings
from .free_parameters import AbstractModel
from .material_constants import as_arrays, sought_constants, value_of, with_constants
from .resolution import FARTHEST_START, FILM_TOLERANCE, MODEL_SIZES, MODULI, MOST_SAMPLES

__all__ = ["FilmCalibration", "calibrate_film"]

_STARTS = ("fresh", "relaxed")
Rows: typing.TypeAlias = tuple[np.ndarray, ...]


@dataclasses.dataclass(frozen=True)
class FilmCalibration:
    """The constants of a material that fit tests of films in time best, and their uncertainty.

    `parameters` are the constants, `intervals` their confidence intervals at `level`, `correlation` (m, m) that of the estimates in
    the order of `parameters`. `time`, `stretch`, `stress` and `fit` hold an array for each test: the samples that were fitted and
    the model at their times, in the units of the measurement. `noise` is the estimated standard deviation of one stress; `material`
    has the fitted constants, `units` the fitted shear modulus. `warnings` are sentences on what makes the constants doubtful.
    """

    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    level: float
    correlation: np.ndarray
    noise: float
    time: Rows
    stretch: Rows
    stress: Rows
    fit: Rows
    material: AbstractMaterial
    units: Units | None
    warnings: tuple[str, ...] = ()

    @property
    def residuals(self) -> Rows:
        """stress − fit of each test."""
        return tuple(s - f for s, f in zip(self.stress, self.fit, strict=True))

    def plot(self, *, axes: typing.Any = None) -> typing.Any:
        """Draws stresses and fits over the time and over the stretch; returns the figure.

        `axes` are two axes to draw on; new ones when None.
        """
        from ..plot import axis_label, new_figure

        if axes is None:
            axes = new_figure(8.0, 3.6).subplots(1, 2, sharey=True)
        scale = 1.0 if self.units is None else 1e3
        for ax, columns in zip(axes, (self.time, self.stretch), strict=True):
            for k, (x, stress, fit) in enumerate(zip(columns, self.stress, self.fit, strict=True)):
                ax.plot(x, stress / scale, ".", color="#0072B2", label=None if k else "measured")
                ax.plot(x, fit / scale, "-", color="#D55E00", label=None if k else "fit")
        axes[0].set_ylabel(axis_label("nominal_stress", self.units))
        axes[0].set_xlabel(axis_label("time"))
        axes[1].set_xlabel(axis_label("stretch"))
        axes[0].legend()
        return axes[0].figure

    def to_json(self) -> dict:
        """Everything but the material as a JSON document, with null for numbers that are not finite."""
        rows = {n: [v.tolist() for v in getattr(self, n)] for n in ("time", "stretch", "stress", "fit", "residuals")}
        document = {
            "units": "dimensionless" if self.units is None else "SI",
            "parameters": self.parameters,
            "intervals": {name: list(pair) for name, pair in self.intervals.items()},
            "level": self.level,
            "correlation": self.correlation.tolist(),
            "noise": self.noise,
        }
        return finite_or_none(document | rows | {"warnings": list(self.warnings)})


@functools.cache
def _model(names: tuple[str, ...], logs: tuple[bool, ...], mode: str, start: str) -> Callable:
    """The compiled stresses (n,) of one test and their Jacobian (n, m) by free parameters of these names."""

    def stresses_and_slopes(free, material, time, stretch):
        def model(free):
            values = {n: jnp.exp(f) if log else f for n, f, log in zip(names, free, logs, strict=True)}
            shear = values.pop("shear_modulus", jnp.ones(()))
            film = film_of(
                with_constants(material, values), Sampled(time, stretch), None, prescribed="stretch", mode=mode
            )
            first = film.given_logs(time[0])
            x = jnp.broadcast_to(first if start == "relaxed" else 0.0, (len(film.branches), 2))
            begin = FilmState(time[0], first, x)
            states, good = film_states(film, begin, time, FILM_TOLERANCE, diffrax.ForwardMode())
            stress = shear * jax.vmap(lambda s: film.stress(*s)[0])(states) / stretch
            stress = jnp.where(good, stress, jnp.nan)
            return stress, stress

        jacobian, stress = jax.jacfwd(model, has_aux=True)(free)
        return stress, jacobian

    return cached_jit(stresses_and_slopes)


class FilmModel(AbstractModel):
    """The nominal stresses of a film in tests of given stretches, as a function of free parameters."""

    def __init__(
        self, material: AbstractMaterial, names: Sequence[str], tests: Sequence[tuple], shear: float, how: tuple
    ):
        self.material = typing.cast(AbstractMaterial, as_arrays(material))
        start = {n: shear if n == "shear_modulus" else value_of(self.material, n) for n in names}
        self._tests, self._how = [(len(t), *_padded(t, s)) for t, s in tests], how
        self._largest = max(float(s.max()) for _, s in tests)
        super().__init__(names, start, "stress")

    def material_of(self, values: dict) -> AbstractMaterial:
        """The material with these constants."""
        own = {n: v for n, v in values.items() if n != "shear_modulus"}
        return jax.tree.map(np.asarray, with_constants(self.material, own))

    def allows(self, values: dict) -> bool:
        """Whether the material and all its springs are allowed to have these constants."""
        try:
            _check(self.material_of(values))
        except (ValueError, ArithmeticError):
            return False
        return True

    def _reaches(self, values: dict) -> bool:
        stretch = self._largest
        spring, branches = spring_and_branches(self.material_of(values))
        logs = film_of(spring, lambda _: stretch, None, prescribed="stretch", mode=self._how[0]).given_logs(0.0)
        l1, l2 = (float(v) for v in np.exp(logs))
        return all(bool(s.admissible(l1, l2)) for s in (spring, *(b.material for b in branches)))

    def reachable_start(self) -> dict[str, float]:
        """Starting values with which no spring is beyond its limit: positive constants are raised until it is so."""
        if self._reaches(self.start):
            return dict(self.start)
        factor = 2.0
        while factor <= FARTHEST_START:
            limits = {
                n: factor * v for n, v in self.start.items() if n.rpartition(".")[2] in ("stretch_limit", "chain_links")
            }
            if self._reaches(self.start | limits):
                return self.start | limits
            factor *= 2
        raise ValueError(
            f"`material` must reach the largest measured stretch, {self._largest:.4g}, but a spring of it is at its limit before; "
            "also fit its limit, raise it, or check the stretches."
        )

    def scaled(self, values: dict[str, float], measured: np.ndarray) -> dict[str, float]:
        """The constants with a shear modulus matched to the stresses, which are proportional to it."""
        if "shear_modulus" not in self.names:
            return values
        fit = self(self.free_of(values))[0]
        upper = fit >= np.median(fit)
        ratio = float(np.median(measured[upper] / fit[upper])) if upper.any() else 1.0
        return values | {"shear_modulus": values["shear_modulus"] * ratio} if ratio > 0 else values

    def refine(self, values: dict) -> bool:
        """The steps in time adapt to the constants."""
        return False

    def __call__(self, free) -> tuple[np.ndarray, np.ndarray]:
        values = self.values_of(free)
        if all(np.isfinite(v) for v in values.values()) and self.allows(values):
            program = _model(self.names, self.logs, *self._how)
            found = [program(np.asarray(free, float), self.material, *rows) for _, *rows in self._tests]
            parts = [[np.asarray(v)[:n] for v in pair] for (n, *_), pair in zip(self._tests, found, strict=True)]
            stress, jacobian = (np.concatenate(column) for column in zip(*parts, strict=True))
            if np.isfinite(stress).all() and np.isfinite(jacobian).all():
                return stress, jacobian
        count = sum(n for n, *_ in self._tests)
        return np.full(count, np.nan), np.full((count, len(self.names)), np.nan)


def _check(module) -> None:
    """Runs the checks of the constructors of a module and of all modules in it."""
    for kind in type(module).__mro__:
        check = vars(kind).get("__check_init__")
        if check is not None:
            check(module)
    for value in vars(module).values():
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, eqx.Module):
                _check(part)


def _padded(time: np.ndarray, stretch: np.ndarray) -> Rows:
    """Samples up to a number for which programs are compiled: the last stretch is held on."""
    size = next(s for s in MODEL_SIZES if s >= len(time))
    more = time[-1] + (time[-1] - time[0]) / len(time) * np.arange(1, size - len(time) + 1)
    return np.concatenate([time, more]), np.concatenate([stretch, np.full(len(more), stretch[-1])])


def _thinned(time: np.ndarray, stretch: np.ndarray) -> np.ndarray:
    """Which samples are fitted: all, or `MOST_SAMPLES` of them, evenly by the stretch and by the logarithm of the time."""
    if len(time) <= MOST_SAMPLES:
        return np.arange(len(time))
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(stretch)))])
    passed = np.log1p((time - time[0]) / np.median(np.diff(time)))
    along = passed / passed[-1] + (travel / travel[-1] if travel[-1] else 0.0) + np.arange(len(time)) / len(time)
    places = np.searchsorted(along, np.linspace(0.0, along[-1], MOST_SAMPLES))
    return np.unique(np.clip(places, 0, len(time) - 1))


def calibrate_film(
    time: typing.Any,
    stretch: typing.Any,
    stress: typing.Any,
    *,
    material: AbstractMaterial | None = None,
    over: Sequence[str] | None = None,
    units: Units | None = None,
    mode: str = "uniaxial",
    start: str = "fresh",
    loss: str = "linear",
    noise: float | None = None,
    level: float = 0.95,
) -> FilmCalibration:
    """Constants of a viscoelastic material from tests of films: the stretch and the nominal stress over the time.

    Minimises Σ ρ((s_i − s(t_i; θ))/σ) over θ as `calibrate` does, with the stresses of the film whose stretch passes the samples,
    linearly between them (`rates.film_stress`). The intervals are those of linearised least squares in log θ with Student's t.

    Args:
        time: rising times (n,) of a test in the unit of the relaxation times, or a sequence of them, one for each test.
        stretch: λ1 at these times, likewise.
        stress: nominal stresses at these times, likewise: in units of μ, or with `units` in Pa.
        material: the kind of material and the fixed constants; the constants to fit are starting values. By default a neo-Hookean
            spring beside one neo-Hookean branch.
        over: names of the constants to fit, such as "relaxation_time", with several branches
            "material.branches[0].relaxation_time"; with `units` also "shear_modulus", that of the equilibrium spring. By default all
            of them except exponents.
        units: if given, stresses are in Pa, and its shear modulus is a starting value.
        mode: "uniaxial", "equal_biaxial" or "pure_shear".
        start: "fresh" or "relaxed" at the first sample of each test.
        loss: "linear", "huber" or "soft_l1".
        noise: standard deviation of one stress, if known; otherwise it is estimated from the residuals.
        level: level of the confidence intervals.

    Raises:
        ValueError: for bad input; if no fit is found; for constants that the tests do not determine, such as a relaxation time far
            beyond the end of the tests; for tests that do not match the material at all.

    >>> from dielectric_jax.model import Maxwell, NeoHookean, Viscoelastic
    >>> from dielectric_jax.rates import film_stress
    >>> rubber = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), modulus_ratio=2.0, relaxation_time=5.0)])
    >>> time = np.linspace(0.0, 20.0, 21)
    >>> stretch = np.minimum(1 + time, 2.0)
    >>> found = calibrate_film(time, stretch, film_stress(rubber, time, stretch, mode="uniaxial"))
    >>> {name: round(value, 4) for name, value in found.parameters.items()}
    {'modulus_ratio': 2.0, 'relaxation_time': 5.0}
    """
    if material is None:
        material = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), modulus_ratio=1.0, relaxation_time=1.0)])
    if mode not in FILM_MODES:
        raise ValueError(f"`mode` must be one of {', '.join(FILM_MODES)}, but is {mode!r}.")
    if start not in _STARTS:
        raise ValueError(f'`start` must be "fresh" or "relaxed", but is {start!r}.')
    check_options(loss, level, 0.0, noise)
    tests = _tests(time, stretch, stress)
    names = _sought(material, over, units is not None)
    kept = [_thinned(t, s) for t, s, _ in tests]
    tests = [tuple(column[k] for column in test) for test, k in zip(tests, kept, strict=True)]
    measured = np.concatenate([s for _, _, s in tests])
    if len(measured) <= len(names):
        raise ValueError(
            f"`time` must hold more samples than constants to fit, {len(names)}, but holds {len(measured)}."
        )
    # the unit of stresses that "shear_modulus" multiplies
    of_stress = 1.0 if units is None or "shear_modulus" in names else float(units.shear_modulus)
    shear = 1.0 if units is None else float(units.shear_modulus)
    model = FilmModel(material, names, [(t, s) for t, s, _ in tests], shear, (mode, start))
    fit = best_fit(model, measured / of_stress, loss, None if noise is None else noise / of_stress)
    found = _result(model, fit, level, tests, of_stress, units)
    advice = "measure for several relaxation times, and at rates that differ"
    warnings = check_intervals(found.intervals, found.parameters, level, advice) + _doubtful(found.parameters, tests)
    warnings += misfit_warnings(
        np.arange(len(measured)),
        measured,
        np.concatenate(found.fit),
        robust=loss != "linear",
        noise=noise,
        unit="" if units is None else " Pa",
        advice="use more branches or other springs, or check the units, the cross-section and the start.",
        measured="stress",
    )
    return dataclasses.replace(found, warnings=tuple(warnings))


def _result(model: FilmModel, fit: Fit, level: float, tests: list[tuple], of_stress: float, units) -> FilmCalibration:
    """The constants with their intervals, and the material and units with these constants."""
    values = model.values_of(fit.free)
    intervals, correlation = intervals_of(model, fit, level)
    if units is not None and "shear_modulus" in values:
        units = eqx.tree_at(lambda u: u.shear_modulus, units, np.asarray(values["shear_modulus"]))
    ends = np.cumsum([len(t) for t, *_ in tests])[:-1]
    time, stretch, stress = zip(*tests, strict=True)
    return FilmCalibration(
        parameters=values,
        intervals=intervals,
        level=level,
        correlation=correlation,
        noise=fit.noise * of_stress,
        time=time,
        stretch=stretch,
        stress=stress,
        fit=tuple(np.split(fit.pressure * of_stress, ends)),
        material=model.material_of(values),
        units=units,
    )


def _sought(material, over, with_shear_modulus: bool) -> list[str]:
    names = sought_constants(material, over, with_shear_modulus)
    if "prestretch" in names:
        raise ValueError("`over` must name constants of the material, but holds 'prestretch', which a film has not.")
    return names


def _tests(time, stretch, stress) -> list[tuple]:
    """The three columns of each test, checked."""
    given = {"time": time, "stretch": stretch, "stress": stress}
    many = {n: [np.asarray(v, float) for v in c] if np.ndim(c[0]) else [np.asarray(c, float)] for n, c in given.items()}
    if len({len(v) for v in many.values()}) > 1:
        counts = " and ".join(str(len(v)) for v in many.values())
        raise ValueError(f"`time`, `stretch` and `stress` must hold as many tests, but hold {counts}.")
    tests = list(zip(*many.values(), strict=True))
    for k, test in enumerate(tests):
        where = f" in test {k}" if len(tests) > 1 else ""
        for name, values in zip(given, test, strict=True):
            if values.ndim != 1 or len(values) < 2 or values.shape != test[0].shape:
                raise ValueError(
                    f"`{name}` must be one row of numbers, two or more, as long as the others, but has shape {values.shape}{where}."
                )
            good = np.isfinite(values) & ((values > 0) | (name != "stretch"))
            if not good.all():
                wrong = int(np.flatnonzero(~good)[0])
                allowed = "positive and finite" if name == "stretch" else "finite"
                raise ValueError(
                    f"`{name}` must be {allowed}, but is {float(values[wrong])!r} at sample {wrong}{where}."
                )
        if not np.all(np.diff(test[0]) > 0):
            wrong = int(np.flatnonzero(np.diff(test[0]) <= 0)[0])
            raise ValueError(
                f"`time` must rise, but is {shown(test[0][wrong : wrong + 2].tolist())} at sample {wrong}{where}."
            )
    return tests


def _doubtful(values: dict[str, float], tests: list[tuple]) -> list[str]:
    """Warnings about relaxation times that the tests do not see, and about a modulus that no elastomer has."""
    longest = max(float(t[-1] - t[0]) for t, *_ in tests)
    shortest = min(float(np.diff(t).min()) for t, *_ in tests)
    said = []
    for name, value in values.items():
        if name.endswith("relaxation_time") and value > longest:
            said.append(f"The {name}, {value:.4g}, is longer than the longest test, {longest:.4g}: measure for longer.")
        if name.endswith("relaxation_time") and value < shortest:
            said.append(
                f"The {name}, {value:.4g}, is shorter than the time between samples, {shortest:.4g}: sample faster."
            )
    low, high = MODULI
    shear = values.get("shear_modulus", 0.5 * (low + high))
    if not low < shear < high:
        said.append(
            f"The shear modulus, {shear:.3g} Pa, is not that of an elastomer; check the units and the cross-section."
        )
    return said
