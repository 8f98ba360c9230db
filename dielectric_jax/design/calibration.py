"""Material constants from a measured pressure–volume curve, by least squares with exact Jacobians (`curve_model`)."""

import dataclasses
import math
import typing
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.stats import t as student

from ..model import ConstantBreakdown, Membrane, Units, VHBBreakdown, Viscoelastic
from ..numerics import check_positive
from .curve_model import CurveModel
from .free_parameters import AbstractModel
from .material_constants import sought_constants
from .measurements import runs_of
from .resolution import (
    BELOW_ZERO,
    ENDLESS,
    EXACT_FIT,
    FELT,
    HUBER,
    INDEPENDENT,
    LEAST_LARGEST,
    LEAST_VOLUME,
    MODULI,
    MOST_FIT_STEPS,
    MOST_LARGEST,
    OPTIMAL,
    ROUNDS_OF_SCALE,
    VISIBLE_MISFIT,
    WIDE,
)

__all__ = [
    "Calibration",
    "Fit",
    "best_fit",
    "calibrate",
    "check_determined",
    "check_intervals",
    "check_optimal",
    "check_options",
    "finite_or_none",
    "intervals_of",
    "looks_absolute",
    "misfit_warnings",
    "plural",
]


_LOSSES = ("linear", "huber", "soft_l1")
_MAD = 0.6744897501960817  # median absolute deviation of the standard normal distribution


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The constants that fit a measured pressure–volume curve best, and their uncertainty.

    `parameters` are the constants, `intervals` their confidence intervals at `level`, `correlation` (m, m) that of the
    estimates in the order of `parameters`. `volume`, `pressure`, `fit` (n,) are the measurement and the model at its
    volumes, in the units of the measurement; `residuals` = pressure − fit; `noise` is the estimated standard deviation of
    one pressure; `membrane` is the membrane with the fitted constants, `units` the units with the fitted shear modulus.
    `warnings` are sentences on what makes the constants doubtful, above all a misfit that is not noise.
    """

    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    level: float
    correlation: np.ndarray
    noise: float
    volume: np.ndarray
    pressure: np.ndarray
    fit: np.ndarray
    membrane: Membrane
    units: Units | None
    warnings: tuple[str, ...] = ()

    @property
    def residuals(self) -> np.ndarray:
        """pressure − fit, (n,)."""
        return self.pressure - self.fit

    def plot(self, *, axes: typing.Any = None) -> typing.Any:
        """Draws measurement and fit, and the residuals in units of the noise; returns the figure.

        `axes` are two axes to draw on; new ones when None.
        """
        from ..plot import axis_label, new_figure

        if axes is None:
            axes = new_figure(5.5, 5.5).subplots(2, 1, sharex=True, height_ratios=(3, 1))
        upper, lower = axes
        scale = (lambda name: 1.0) if self.units is None else (lambda name: {"volume": 1e-6, "pressure": 100.0}[name])
        order = np.argsort(self.volume)
        volume = self.volume[order] / scale("volume")
        upper.plot(volume, self.pressure[order] / scale("pressure"), "o", color="#0072B2", label="measured")
        text = [f"{n.replace('_', ' ')} {v:.4g}" for n, v in self.parameters.items()]
        if self.units is not None and "shear_modulus" in self.parameters:
            place = list(self.parameters).index("shear_modulus")
            text[place] = f"shear modulus {self.parameters['shear_modulus'] / 1e3:.4g} kPa"
        upper.plot(volume, self.fit[order] / scale("pressure"), "-", color="#D55E00", label="fit: " + ", ".join(text))
        upper.set_ylabel(axis_label("pressure", self.units))
        upper.legend()
        lower.axhspan(-2, 2, color="0.9")
        lower.axhline(0.0, color="0.5", linewidth=0.8)
        lower.plot(volume, self.residuals[order] / max(self.noise, 1e-300), "o", color="#0072B2")
        lower.set_ylabel("Residual / noise")
        lower.set_xlabel(axis_label("volume", self.units))
        return upper.figure

    def to_json(self) -> dict:
        """Everything but the membrane as a JSON document, with null for numbers that are not finite."""
        return finite_or_none(self._document())

    def _document(self) -> dict:
        return {
            "units": "dimensionless" if self.units is None else "SI",
            "parameters": self.parameters,
            "intervals": {name: list(pair) for name, pair in self.intervals.items()},
            "level": self.level,
            "correlation": self.correlation.tolist(),
            "noise": self.noise,
            "volume": self.volume.tolist(),
            "pressure": self.pressure.tolist(),
            "fit": self.fit.tolist(),
            "residuals": self.residuals.tolist(),
            "warnings": list(self.warnings),
        }


def finite_or_none(value: typing.Any) -> typing.Any:
    """The document without infinities and NaN, which do not exist in JSON."""
    if isinstance(value, dict):
        return {name: finite_or_none(v) for name, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_none(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _minimum(curve: AbstractModel, free: np.ndarray, pressure: np.ndarray, loss: str, scale: float) -> np.ndarray:
    """The free parameters of least loss, with residuals in units of `scale`, by SciPy's trust-region method."""
    known: dict = {}
    far = 1e3 * float(np.abs(pressure).max())

    def at(x):
        if known.get("x") is None or (known["x"] != x).any():
            value, jacobian = curve(x)
            # without a state, or with a forbidden constant: far from the data, so that the step is rejected
            value = np.where(np.isfinite(value), value, far)
            known.update(x=np.array(x), residual=(value - pressure) / scale, jacobian=np.nan_to_num(jacobian) / scale)
        return known

    found = least_squares(
        lambda x: at(x)["residual"],
        free,
        jac=lambda x: at(x)["jacobian"],  # pyright: ignore[reportArgumentType]
        bounds=(curve.lowest, np.inf),
        loss=loss,
        f_scale=HUBER if loss == "huber" else 1.0,
        x_scale="jac",
        ftol=1e-13,
        xtol=1e-11,
        gtol=1e-13,
        max_nfev=MOST_FIT_STEPS,
    )
    return found.x


def calibrate(
    volume: ArrayLike,
    pressure: ArrayLike,
    *,
    membrane: Membrane | None = None,
    over: Sequence[str] | None = None,
    units: Units | None = None,
    voltage: float = 0.0,
    loss: str = "linear",
    noise: float | None = None,
    level: float = 0.95,
) -> Calibration:
    """Constants of a membrane from its measured pressure–volume curve.

    Minimises Σ ρ((p_i − p(V_i; θ))/σ) over θ, with ρ(x) = x²/2 ("linear"), Huber's function, or √(1 + x²) − 1 ("soft_l1");
    the last two are robust against outliers. The intervals are those of linearised least squares in log θ (in θ itself for
    the prestretch and for constants of either sign) with Student's t; under a robust loss the covariance is that of an
    M-estimator. If the starting values do not reach the largest volume, positive constants are raised until they do.

    Args:
        volume: measured volumes (n,) under the membrane.
        pressure: measured gauge pressures (n,).
        membrane: material, prestretch and the fixed constants; the constants to fit are starting values.
        over: names of the constants to fit: those of the material (`moduli` for a whole tuple, or `moduli[0]`),
            "prestretch", and with `units` "shear_modulus". By default the shear modulus, if there are units, and every
            elastic constant except exponents; without the shear modulus if it is the unit of the constants, as in
            MooneyRivlin.
        units: if given, the measurement is in SI (m³, Pa, and `voltage` in V); its shear modulus is a starting value.
        voltage: Φ during the measurement.
        loss: "linear", "huber" or "soft_l1".
        noise: standard deviation of one pressure, if known; otherwise it is estimated from the residuals.
        level: level of the confidence intervals.

    Raises:
        ValueError: for bad input; if no fit is found; for constants that the curve does not determine; for a curve that
            does not match the material at all.

    >>> import numpy as np
    >>> from dielectric_jax import Gent, equilibrium
    >>> film = Membrane(Gent(stretch_limit=120.0))
    >>> volume = np.geomspace(0.5, 60.0, 12)
    >>> pressure = np.array([equilibrium(film, volume=v).pressure for v in volume])
    >>> round(calibrate(volume, pressure, membrane=Membrane()).parameters["stretch_limit"], 4)
    120.0
    """
    membrane = Membrane() if membrane is None else membrane
    volume, pressure = _measured(volume, pressure)
    if isinstance(membrane.material, Viscoelastic):
        raise ValueError(
            "`membrane` must have an elastic material, because a curve without times says nothing about branches; fit the spring "
            f"{type(membrane.material.equilibrium).__name__} alone."
        )
    names = sought_constants(membrane.material, over, units is not None)
    check_options(loss, level, voltage, noise)
    volume, pressure, warnings = _usable(volume, pressure, units)
    if len(volume) <= len(names):
        raise ValueError(
            f"`volume` must hold more points than constants to fit, {len(names)}, but holds {len(volume)}."
        )
    # dimensionless volumes, pressures in the unit that "shear_modulus" multiplies, and q times the shear modulus
    of_volume, of_pressure, q_scale = _scales(names, units, float(voltage))
    shear = 1.0 if units is None else float(units.shear_modulus)
    curve = CurveModel(membrane, names, volume / of_volume, q_scale, shear)
    try:
        fit = best_fit(curve, pressure / of_pressure, loss, None if noise is None else noise / of_pressure)
        found = _result(curve, fit, level, volume, pressure, of_pressure, units)
        warnings += check_intervals(found.intervals, found.parameters, level)
        seek = "" if "prestretch" in names else "fit more constants, such as the prestretch, "
        warnings += misfit_warnings(
            volume,
            pressure,
            found.fit,
            robust=loss != "linear",
            noise=noise,
            unit="" if units is None else " Pa",
            advice=f"{seek}use another material, or check the units, the radius and the zero of the pressures.",
        )
    except ValueError as error:
        if units is not None and looks_absolute(volume, pressure):
            raise ValueError(_ABSOLUTE.format(low=float(pressure.min()), high=float(pressure.max()))) from error
        raise
    return dataclasses.replace(found, warnings=tuple(warnings + _doubtful(found)))


_ABSOLUTE = (
    "`pressure` must be a gauge pressure, but is {low:.6g} to {high:.6g} Pa from the smallest volume on, which looks "
    "absolute, and no fit matches it; subtract the atmospheric pressure, about 101.3 kPa."
)


@dataclasses.dataclass(frozen=True)
class Fit:
    """The best free parameters (m,), the model's pressures there (n,), their Jacobian (n, m), and their noise.

    `spread` is the factor by which (JᵀJ)^-½ is scaled to give the errors of the estimates.
    """

    free: np.ndarray
    pressure: np.ndarray
    jacobian: np.ndarray
    noise: float
    spread: float


def best_fit(curve: AbstractModel, pressure: np.ndarray, loss: str, noise: float | None) -> Fit:
    """The best fit, checked to be a minimum whose constants the curve determines."""
    start = curve.reachable_start()
    free = np.maximum(curve.free_of(curve.scaled(start, pressure)), curve.lowest)
    largest = float(np.abs(pressure).max())
    scale = 0.02 * largest if noise is None else noise
    curve.refine(start)
    free = _minimum(curve, free, pressure, "linear", scale)
    if curve.refine(curve.values_of(free)):
        free = _minimum(curve, free, pressure, "linear", scale)
    for _ in range(ROUNDS_OF_SCALE if loss != "linear" else 0):
        if noise is None:  # a robust loss is scaled by its own residuals
            scale = max(float(np.median(np.abs(pressure - curve(free)[0]))) / _MAD, 1e-9 * largest)
        free, before = _minimum(curve, free, pressure, loss, scale), free
        if np.abs(free - before).max() < 1e-9:
            break
    fit, jacobian = curve(free)
    values, residual = curve.values_of(free), pressure - fit
    if not np.isfinite(fit).all():
        raise ValueError(
            f"`{curve.measured}` must be a curve that the material can follow, but no fit of {', '.join(curve.names)} was found from "
            f"{ {n: float(s) for n, s in curve.start.items()} }; choose other starting values, or fit fewer constants."
        )
    check_determined(curve.start, values, jacobian, pressure, curve.measured)
    pull = residual if loss == "linear" else scale * _psi(residual / scale, loss)[0]
    check_optimal(curve.start, values, jacobian, pull, pressure, free - curve.lowest < 1e-3, curve.measured)
    freedom = len(pressure) - len(free)
    spread = _spread(residual, freedom, loss, scale, noise is not None)
    own = float(np.sqrt(residual @ residual / freedom)) if loss == "linear" else scale
    return Fit(free, fit, jacobian, own, spread)


def _result(curve: CurveModel, fit: Fit, level, volume, pressure, of_pressure: float, units) -> Calibration:
    """The constants with their intervals, and the membrane and units with these constants."""
    names, values = curve.names, curve.values_of(fit.free)
    intervals, correlation = intervals_of(curve, fit, level)
    membrane = curve.membrane_of(values)
    if units is not None and "shear_modulus" in names:
        before = units
        units = eqx.tree_at(lambda u: u.shear_modulus, units, np.asarray(values["shear_modulus"]))
        membrane = Membrane(membrane.material, membrane.prestretch, _law_in(membrane.breakdown, before, units))
    return Calibration(
        parameters=values,
        intervals=intervals,
        level=level,
        correlation=correlation,
        noise=fit.noise * of_pressure,
        volume=volume,
        pressure=pressure,
        fit=fit.pressure * of_pressure,
        membrane=membrane,
        units=units,
    )


def intervals_of(curve: AbstractModel, fit: Fit, level: float) -> tuple[dict[str, tuple[float, float]], np.ndarray]:
    """The confidence intervals of the constants by name, and the correlation (m, m) of the estimates."""
    # by QR decomposition: JᵀJ would square the condition number of the Jacobian
    inverse = np.linalg.inv(np.linalg.qr(fit.jacobian, mode="r"))
    covariance = inverse @ inverse.T * fit.spread**2
    error = np.sqrt(np.diag(covariance))
    reach = student.ppf((1 + level) / 2, len(fit.pressure) - len(fit.free)) * error
    low, high = (curve.values_of(np.maximum(fit.free + s * reach, curve.lowest)) for s in (-1, 1))
    return {n: (low[n], high[n]) for n in curve.names}, covariance / np.outer(error, error)


def _psi(x, loss: str):
    """ψ = ρ' of a robust loss, and its derivative."""
    if loss == "huber":
        return np.clip(x, -HUBER, HUBER), np.abs(x) < HUBER
    return x / np.sqrt(1 + x**2), (1 + x**2) ** -1.5


def _spread(residual, freedom: int, loss: str, scale: float, known: bool) -> float:
    """The factor that scales (JᵀJ)^-½ to the errors of the estimates, Huber's for M-estimators: s √(Σψ²/(n − m)) / mean ψ'."""
    if loss == "linear":
        return scale if known else float(np.sqrt(residual @ residual / freedom))
    psi, rate = _psi(residual / scale, loss)
    return float(scale * np.sqrt(psi @ psi / freedom) / np.mean(rate))


def _law_in(law, before: Units, units: Units):
    """The breakdown law with the same field in V/m, in the new unit √(μ/ε)."""
    if isinstance(law, VHBBreakdown):
        return VHBBreakdown(law.scale, units.shear_modulus, law.relative_permittivity)
    return units.reduce(before.to_si(law)) if isinstance(law, ConstantBreakdown) else law


def _scales(names: Sequence[str], units: Units | None, voltage: float) -> tuple[float, float, float]:
    """The units of the curve's volumes and pressures, and q times the shear modulus if that is fitted."""
    if units is None:
        return 1.0, 1.0, voltage**2
    of_volume = float(units.scale("volume"))
    if "shear_modulus" in names:
        return (
            of_volume,
            float(units.thickness / units.radius),
            float(voltage**2 * units.permittivity / units.thickness**2),
        )
    return of_volume, float(units.scale("pressure")), float(voltage**2 / units.scale("voltage_squared"))


def _doubtful(found: Calibration) -> list[str]:
    """Further warnings about the constants."""
    said = []
    if len(runs_of(found.volume)) > 1:
        said.append("The volume rises and falls: loading and unloading are fitted together; use only one of them.")
    low, high = MODULI
    shear = found.parameters.get("shear_modulus", 0.5 * (low + high))
    if not low < shear < high:
        said.append(
            f"The shear modulus, {shear:.3g} Pa, is not that of an elastomer; check the units, the thickness and the radius."
        )
    return said


def check_options(loss: str, level: float, voltage: float, noise: float | None) -> None:
    """Refuses an unknown loss, and a level, voltage or noise that is none."""
    if loss not in _LOSSES:
        raise ValueError(f"`loss` must be one of {', '.join(_LOSSES)}, but is {loss!r}.")
    if not 0 < level < 1:
        raise ValueError(f"`level` must lie between 0 and 1, but is {level!r}.")
    check_positive("voltage", float(voltage), zero=True)
    if noise is not None:
        check_positive("noise", float(noise))


def _measured(volume, pressure) -> tuple[np.ndarray, np.ndarray]:
    volume, pressure = np.asarray(volume, float), np.asarray(pressure, float)
    for name, values in (("volume", volume), ("pressure", pressure)):
        if values.ndim != 1 or values.shape != volume.shape or not values.size:
            raise ValueError(
                f"`{name}` must be one row of numbers, as long as the other, but has shape {values.shape}."
            )
        least = (
            0.0 if name == "volume" else -BELOW_ZERO * max(np.max(values, initial=0.0, where=np.isfinite(values)), 0.0)
        )
        good = np.isfinite(values) & ((values > 0) | (values > least))
        if not good.all():
            wrong = int(np.flatnonzero(~good)[0])
            raise ValueError(
                f"`{name}` must be positive and finite, but is {float(values[wrong])!r} at point {wrong}."
                + ("" if name == "volume" else f" (Down to −{100 * BELOW_ZERO:g} % of the largest counts as noise.)")
            )
    return volume, pressure


def _usable(volume, pressure, units: Units | None) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The points whose volume is that of an inflated film, and a notice about the others."""
    cube = 1.0 if units is None else float(units.scale("volume"))
    unit = "" if units is None else f" of a film of radius {float(units.radius):.4g} m"
    share = volume / cube
    if not LEAST_LARGEST < share.max() < MOST_LARGEST:
        raise ValueError(
            f"`volume` must be that of an inflated film, but the largest is {share.max():.3g} A³{unit}, where {LEAST_LARGEST} to "
            f"{MOST_LARGEST:g} A³ are possible; check the unit of the volumes and the radius."
        )
    keep = share >= LEAST_VOLUME
    said = f"{np.sum(~keep)} points are left out whose volume is below {LEAST_VOLUME:g} A³, where the film is flat."
    return volume[keep], pressure[keep], [] if keep.all() else [said]


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def plural(measured: str) -> str:
    """Pressures, stresses."""
    return measured + ("es" if measured.endswith("s") else "s")


def check_determined(
    start: Mapping[str, float], values: Mapping[str, float], jacobian, pressure, measured: str = "pressure"
) -> None:
    """Refuses constants that the curve does not depend on, or that can change together without changing it.

    `jacobian` (n, m) is that of the free parameters; `start` and `values` are the constants before and after the fit.
    """
    names, length = list(values), np.linalg.norm(jacobian, axis=0)
    felt = length > FELT * np.linalg.norm(pressure)
    for name, good in zip(names, felt, strict=True):
        if not good:
            raise ValueError(
                f"`over` must name constants that the curve depends on, but a change of {name} does not change the {plural(measured)} "
                f"(it started at {start[name]:.4g} and ended at {values[name]:.4g}); leave it out of `over`."
            )
    _, sizes, rows = np.linalg.svd(jacobian / length, full_matrices=False)
    if len(names) > 1 and sizes[-1] < INDEPENDENT * sizes[0]:
        joined = [n for n, share in zip(names, np.abs(rows[-1]), strict=True) if share > 0.05]
        raise ValueError(
            f"`over` must name constants that the curve can separate, but {_and(joined)} can change together without changing "
            f"the {plural(measured)}; leave one of them out of `over`."
        )


def check_optimal(
    start: Mapping[str, float],
    values: Mapping[str, float],
    jacobian,
    pull,
    pressure,
    at_limit,
    measured: str = "pressure",
) -> None:
    """Refuses constants at which the loss could still be lowered: the search has stopped before a minimum.

    `pull` (n,) are the derivatives of the loss by the residuals; `at_limit` (m,) says which parameters are at their lower limit.
    """
    if np.abs(pull).max() < EXACT_FIT * np.abs(pressure).max():
        return
    slope = jacobian.T @ pull / (np.linalg.norm(jacobian, axis=0) * np.linalg.norm(pull))
    # a parameter at its lower limit may be pushed against it
    slope = np.where(at_limit & (slope < 0), 0.0, slope)
    if np.abs(slope).max() < OPTIMAL:
        return
    moved = ", ".join(f"{n} {values[n]:.4g} (from {start[n]:.4g})" for n in values)
    raise ValueError(
        f"`{measured}` must be a curve that the material can follow, but no best fit was found: the search stopped at {moved}; "
        "choose other starting values, fit fewer constants, or check the units, the thickness and the radius."
    )


def check_intervals(
    intervals: Mapping[str, tuple[float, float]],
    values: Mapping[str, float],
    level: float,
    advice: str = "measure larger volumes, where the film stiffens",
) -> list[str]:
    """Refuses unbounded intervals, saying what to measure, and returns warnings about wide ones."""
    said = []
    for name, (low, high) in intervals.items():
        stated = f"the {100 * level:g} % interval of {name}, {values[name]:.4g}, is {low:.3g} to {high:.3g}"
        endless = not (np.isfinite(low) and np.isfinite(high)) or (low > 0 and high > ENDLESS * low)
        if endless or (low == 0 and values[name] > 0 and name != "prestretch" and high > ENDLESS * values[name]):
            raise ValueError(
                f"`over` must name constants that the curve determines, but {stated}; leave it out of `over`, or "
                f"{advice}."
            )
        if low > 0 and high > WIDE * low:
            said.append(f"The curve hardly determines {name}: {stated}.")
    return said


def looks_absolute(volume, pressure) -> bool:
    """Whether pressures in Pa are about atmospheric at all volumes, from the smallest on."""
    small = pressure[volume <= 2 * volume.min()]
    return bool(70e3 < pressure.min() < 115e3 and small.min() < 115e3 and pressure.max() < 3 * pressure.min())


def misfit_warnings(
    volume, pressure, fit, *, robust: bool, noise: float | None, unit: str, advice: str, measured: str = "pressure"
) -> list[str]:
    """Warnings about a misfit that is not noise; refuses a fit that leaves more than half of the variance of the pressures.

    The noise is estimated from differences between residuals at neighbouring volumes, which a systematic misfit hardly
    changes (von Neumann's ratio), unless it is known as `noise`.
    """
    residual = (pressure - fit)[np.argsort(volume, kind="stable")]
    steps = np.diff(residual) / np.sqrt(2)
    if robust:
        misfit, jumps = (float(np.median(np.abs(v))) / _MAD for v in (residual, steps))
    else:
        misfit, jumps = (float(np.sqrt(np.mean(v**2))) for v in (residual, steps))
    expected = jumps if noise is None else noise
    # for pure noise the ratio of the two variances scatters by 1/√n
    allowed = 1 / np.sqrt(max(1 - 3 / np.sqrt(len(residual)), 0.05))
    if not (misfit > allowed * expected and misfit > VISIBLE_MISFIT * np.ptp(pressure)):
        return []
    said = f"the misfit, {misfit:.3g}{unit}, is {misfit / expected:.3g} times the noise of the {plural(measured)}, {expected:.3g}{unit}"
    offset = _offset(pressure, fit, misfit)
    if offset:
        advice = f"an offset of the {plural(measured)} of {offset:.4g}{unit} would explain it: is the gauge zeroed?"
    if misfit > np.sqrt(0.5) * np.std(pressure):
        raise ValueError(f"`{measured}` must be a curve that the material can follow, but {said}; {advice}")
    return [f"T{said[1:]}: the material does not follow the curve, and the intervals are too narrow; {advice}"]


def _offset(pressure, fit, misfit: float) -> float:
    """The offset of the pressures that explains most of a misfit; 0 if none does."""
    both = np.column_stack([np.ones_like(fit), fit])
    offset = np.linalg.lstsq(both, pressure, rcond=None)[0]
    left = float(np.sqrt(np.mean((pressure - both @ offset) ** 2)))
    return float(offset[0]) if left < 0.5 * misfit and abs(offset[0]) > 3 * left else 0.0
