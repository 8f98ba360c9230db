"""Constants of a material from tests of films: relaxation and loops in time, or stresses at stretches of an elastic film."""

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
    Gent,
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
from .calibration import (
    COLORS,
    Fit,
    best_fit,
    check_intervals,
    check_options,
    constants_text,
    finite_or_none,
    intervals_of,
    misfit_warnings,
)
from .free_parameters import AbstractModel
from .material_constants import as_arrays, sought_constants, value_of, with_constants
from .resolution import DENSE, FARTHEST_START, FILM_TOLERANCE, MODEL_SIZES, MODULI, MOST_SAMPLES

__all__ = ["FilmCalibration", "calibrate_film"]

_STARTS = ("fresh", "relaxed")
Rows: typing.TypeAlias = tuple[np.ndarray, ...]


@dataclasses.dataclass(frozen=True)
class FilmCalibration:
    """The constants of a material that fit tests of films best, and their uncertainty.

    `parameters` are the constants, `intervals` their confidence intervals at `level`, `correlation` (m, m) that of the estimates in
    the order of `parameters`. `time`, `stretch`, `stress` and `fit` hold an array for each test: the samples that were fitted and
    the model at their times, in the units of the measurement. For an elastic film `time` is empty, and `curves` holds stretches and
    stresses of a smooth model curve for each test. `modes` are the modes of the tests. `noise` is the estimated standard deviation of one stress; `material`
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
    modes: tuple[str, ...]
    curves: tuple[tuple[np.ndarray, np.ndarray], ...]
    material: AbstractMaterial
    units: Units | None
    warnings: tuple[str, ...] = ()

    @property
    def residuals(self) -> Rows:
        """stress − fit of each test."""
        return tuple(s - f for s, f in zip(self.stress, self.fit, strict=True))

    def plot(self, *, axes: typing.Any = None) -> typing.Any:
        """Draws stresses and fits over the time and over the stretch; returns the figure.

        Without times the stresses over the stretch, and the residuals in units of the noise. `axes` are two axes to draw on; new ones
        when None.
        """
        from ..plot import axis_label, new_figure

        if not self.time:
            return self._plot_elastic(axes)
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

    def _plot_elastic(self, axes: typing.Any) -> typing.Any:
        """Stresses over the stretch, a color for each test, with the smooth curves; below, the residuals."""
        from ..plot import axis_label, new_figure

        if axes is None:
            axes = new_figure(5.5, 5.5).subplots(2, 1, sharex=True, height_ratios=(3, 1))
        upper, lower = axes
        scale = 1.0 if self.units is None else 1e3
        lower.axhspan(-2, 2, color="0.9")
        lower.axhline(0.0, color="0.5", linewidth=0.8)
        rows = zip(self.modes, self.stretch, self.stress, self.residuals, self.curves, strict=True)
        for k, (mode, stretch, stress, residual, curve) in enumerate(rows):
            color = COLORS[k % len(COLORS)]
            upper.plot(stretch, stress / scale, "o", color=color, label=mode.replace("_", " "), markersize=4)
            upper.plot(curve[0], curve[1] / scale, "-", color=color)
            lower.plot(stretch, residual / max(self.noise, 1e-300), "o", color=color, markersize=4)
        upper.set_ylabel(axis_label("nominal_stress", self.units))
        upper.legend(title=constants_text(self.parameters, self.units))
        lower.set_ylabel(
            "Residual / noise" if self.units is None else f"Residual / noise\n(noise {self.noise / scale:.3g} kPa)"
        )
        lower.set_xlabel(axis_label("stretch"))
        return upper.figure

    def to_json(self) -> dict:
        """Everything but the material and the curves as a JSON document, with null for numbers that are not finite."""
        rows = {n: [v.tolist() for v in getattr(self, n)] for n in ("time", "stretch", "stress", "fit", "residuals")}
        document = {
            "units": "dimensionless" if self.units is None else "SI",
            "parameters": self.parameters,
            "intervals": {name: list(pair) for name, pair in self.intervals.items()},
            "level": self.level,
            "correlation": self.correlation.tolist(),
            "noise": self.noise,
            "noise_unit": "μ" if self.units is None else "Pa",
        }
        return finite_or_none(document | {"modes": list(self.modes)} | rows | {"warnings": list(self.warnings)})


@functools.cache
def _model(names: tuple[str, ...], logs: tuple[bool, ...], mode: str, start: str) -> Callable:
    """The compiled stresses (n,) of one test and their Jacobian (n, m) by free parameters of these names."""

    def stresses_and_slopes(free, material, time, stretch):
        def model(free):
            values = {n: jnp.exp(f) if log else f for n, f, log in zip(names, free, logs, strict=True)}
            shear = values.pop("shear_modulus", jnp.ones(()))
            own = with_constants(material, values)
            if start == "elastic":
                film = film_of(own, lambda s: s, None, prescribed="stretch", mode=mode)
                stress = shear * jax.vmap(lambda s: film.stress(s, film.given_logs(s), ())[0])(stretch) / stretch
                return stress, stress
            film = film_of(own, Sampled(time, stretch), None, prescribed="stretch", mode=mode)
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
    """The nominal stresses of a film in tests of given stretches, as a function of free parameters.

    `tests` are (times, stretches, mode); `start` is "fresh", "relaxed", or "elastic" for a film that does not know the time.
    """

    def __init__(
        self, material: AbstractMaterial, names: Sequence[str], tests: Sequence[tuple], shear: float, start: str
    ):
        self.material = typing.cast(AbstractMaterial, as_arrays(material))
        first = {n: shear if n == "shear_modulus" else value_of(self.material, n) for n in names}
        self._tests, self._start = [(len(t), mode, *_padded(t, s)) for t, s, mode in tests], start
        self._extremes = [(mode, float(v)) for _, s, mode in tests for v in (s.max(), s.min())]
        super().__init__(names, first, "stress")

    @property
    def elastic(self) -> bool:
        """Whether the film does not know the time."""
        return self._start == "elastic"

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
        spring, branches = spring_and_branches(self.material_of(values))
        for mode, stretch in self._extremes:
            l1, l2 = stretch, stretch ** FILM_MODES[mode].ratio
            if not all(bool(s.admissible(l1, l2)) for s in (spring, *(b.material for b in branches))):
                return False
        return True

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
            f"`material` must reach the largest measured stretch, {max(s for _, s in self._extremes):.4g}, but a spring of it is at its limit before; "
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
            found = [self._at(free, mode, *rows) for _, mode, *rows in self._tests]
            parts = [[np.asarray(v)[:n] for v in pair] for (n, *_), pair in zip(self._tests, found, strict=True)]
            stress, jacobian = (np.concatenate(column) for column in zip(*parts, strict=True))
            if np.isfinite(stress).all() and np.isfinite(jacobian).all():
                return stress, jacobian
        count = sum(n for n, *_ in self._tests)
        return np.full(count, np.nan), np.full((count, len(self.names)), np.nan)

    def _at(self, free, mode: str, time: np.ndarray, stretch: np.ndarray) -> tuple:
        program = _model(self.names, self.logs, mode, self._start)
        return program(np.asarray(free, float), self.material, time, stretch)

    def dense(self, free) -> list[tuple[np.ndarray, np.ndarray]]:
        """Stretches and stresses (k,) of a smooth curve for each test of an elastic film."""
        curves = []
        for count, mode, time, stretch in self._tests:
            # in parts of a size for which there is a program
            x = np.linspace(stretch[:count].min(), stretch[:count].max(), -(-2 * DENSE // len(time)) * len(time))
            parts = [self._at(free, mode, time, part)[0] for part in x.reshape(-1, len(time))]
            curves.append((x, np.concatenate([np.asarray(part) for part in parts])))
        return curves


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
    size = next((s for s in MODEL_SIZES if s >= len(time)), 1 << (len(time) - 1).bit_length())
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
    time: typing.Any | None,
    stretch: typing.Any,
    stress: typing.Any,
    *,
    material: AbstractMaterial | None = None,
    over: Sequence[str] | None = None,
    units: Units | None = None,
    mode: str | Sequence[str] = "uniaxial",
    start: str = "fresh",
    loss: str = "linear",
    noise: float | None = None,
    level: float = 0.95,
) -> FilmCalibration:
    """Constants of a material from tests of films: the stretch and the nominal stress over the time, or without times.

    Minimises Σ ρ((s_i − s(t_i; θ))/σ) over θ as `calibrate` does, with the stresses of the film whose stretch passes the samples,
    linearly between them (`rates.film_stress`). Without times the film is elastic, and the stress is s = dW(λ, λ^r)/dλ with r = −½
    or 0 in uniaxial tension and pure shear, and half of that with r = 1 in equal-biaxial tension. The intervals are those of linearised least squares in log θ with Student's t.

    Args:
        time: rising times (n,) of a test in the unit of the relaxation times, or a sequence of them, one for each test; None
            for an elastic film.
        stretch: λ1 at these times, likewise.
        stress: nominal stresses at these times, likewise: in units of μ, or with `units` in Pa.
        material: the kind of material and the fixed constants; the constants to fit are starting values. By default a neo-Hookean
            spring beside one neo-Hookean branch, without times a Gent material.
        over: names of the constants to fit, such as "relaxation_time", with several branches
            "material.branches[0].relaxation_time"; with `units` also "shear_modulus", that of the equilibrium spring. By default all
            of them except exponents.
        units: if given, stresses are in Pa, and its shear modulus is a starting value.
        mode: "uniaxial", "equal_biaxial" or "pure_shear", or a sequence of them, one for each test.
        start: "fresh" or "relaxed" at the first sample of each test; with times only.
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

    Two tests of an elastic film without times, of a Mooney–Rivlin material with c1 = 0.4 and c2 = 0.1:

    >>> from dielectric_jax import MooneyRivlin
    >>> a = np.linspace(1.1, 3.0, 9)
    >>> uniaxial, biaxial = 2 * (a - a**-2) * (0.4 + 0.1 / a), 2 * (a - a**-5) * (0.4 + 0.1 * a**2)
    >>> found = calibrate_film(
    ...     None, [a, a], [uniaxial, biaxial], material=MooneyRivlin(), mode=["uniaxial", "equal_biaxial"]
    ... )
    >>> {name: round(value, 4) for name, value in found.parameters.items()}
    {'c1': 0.4, 'c2': 0.1}
    """
    elastic = time is None
    if material is None:
        branches = [Maxwell(NeoHookean(), modulus_ratio=1.0, relaxation_time=1.0)]
        material = Gent() if elastic else Viscoelastic(NeoHookean(), branches)
    if start not in _STARTS:
        raise ValueError(f'`start` must be "fresh" or "relaxed", but is {start!r}.')
    if elastic and (start != "fresh" or isinstance(material, Viscoelastic)):
        name, given = ("start", repr(start)) if start != "fresh" else ("material", "viscoelastic")
        raise ValueError(f"`time` must be given with a {name} that is {given}, but is None.")
    check_options(loss, level, noise)
    tests, modes = _tests(time, stretch, stress), _modes(mode, stretch)
    names = _sought(material, over, units is not None)
    if not elastic:
        kept = [_thinned(t, s) for t, s, _ in tests]
        tests = [tuple(column[k] for column in test) for test, k in zip(tests, kept, strict=True)]
    measured = np.concatenate([s for _, _, s in tests])
    if len(measured) <= len(names):
        raise ValueError(
            f"`{'stretch' if elastic else 'time'}` must hold more samples than constants to fit, {len(names)}, but holds {len(measured)}."
        )
    # the unit of stresses that "shear_modulus" multiplies
    of_stress = 1.0 if units is None or "shear_modulus" in names else float(units.shear_modulus)
    shear = 1.0 if units is None else float(units.shear_modulus)
    given = [(t, s, mode) for (t, s, _), mode in zip(tests, modes, strict=True)]
    model = FilmModel(material, names, given, shear, "elastic" if elastic else start)
    fit = best_fit(model, measured / of_stress, loss, None if noise is None else noise / of_stress)
    found = _result(model, fit, level, tests, of_stress, units)
    found = dataclasses.replace(found, modes=modes, time=() if elastic else found.time)
    advice = "measure for several relaxation times, and at rates that differ"
    advice = "measure larger stretches, or another mode of deformation as well" if elastic else advice
    warnings = check_intervals(found.intervals, found.parameters, level, advice) + _doubtful(found)
    springs = "use another material" if elastic else "use more branches or other springs"
    warnings += misfit_warnings(
        np.concatenate(
            [2 * k + (s / s.max() if elastic else np.linspace(0, 1, len(s))) for k, (_, s, _) in enumerate(tests)]
        ),
        measured,
        np.concatenate(found.fit),
        robust=loss != "linear",
        noise=noise,
        unit="" if units is None else " Pa",
        advice=f"{springs}, or check the units, the cross-section and the start.",
        measured="stress",
    )
    return dataclasses.replace(found, warnings=tuple(warnings))


def _modes(mode: str | Sequence[str], stretch) -> tuple[str, ...]:
    """The mode of each test."""
    count = len(stretch) if np.ndim(stretch[0]) else 1
    modes = (mode,) * count if isinstance(mode, str) else tuple(mode)
    if len(modes) != count:
        raise ValueError(f"`mode` must be one for all tests, or one for each of the {count}, but holds {len(modes)}.")
    for own in modes:
        if own not in FILM_MODES:
            raise ValueError(f"`mode` must be one of {', '.join(FILM_MODES)}, but is {own!r}.")
    return modes


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
        modes=(),
        curves=tuple((x, s * of_stress) for x, s in model.dense(fit.free)) if model.elastic else (),
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
    numbered = time is None
    if numbered:  # the samples are numbered in place of times
        time = [np.arange(len(s)) for s in stretch] if np.ndim(stretch[0]) else np.arange(len(stretch))
    given = {"time": time, "stretch": stretch, "stress": stress}
    many = {n: [np.asarray(v, float) for v in c] if np.ndim(c[0]) else [np.asarray(c, float)] for n, c in given.items()}
    if len({len(v) for v in many.values()}) > 1:
        counts = " and ".join(str(len(v)) for v in many.values())
        raise ValueError(f"`time`, `stretch` and `stress` must hold as many tests, but hold {counts}.")
    tests = list(zip(*many.values(), strict=True))
    for k, test in enumerate(tests):
        where = f" in test {k}" if len(tests) > 1 else ""
        for name, values in list(zip(given, test, strict=True))[numbered:]:
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


def _doubtful(found: FilmCalibration) -> list[str]:
    """Warnings about relaxation times that the tests do not see, and about a modulus that no elastomer has."""
    values = found.parameters
    longest = max((float(t[-1] - t[0]) for t in found.time), default=0.0)
    shortest = min((float(np.diff(t).min()) for t in found.time), default=0.0)
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
