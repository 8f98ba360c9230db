"""Material constants from measured pressures at volumes or pole heights, by least squares with exact Jacobians (`curve_model`)."""

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.stats import t as student

from ..model import VACUUM_PERMITTIVITY, ConstantBreakdown, Membrane, Units, VHBBreakdown, Viscoelastic
from ..numerics import check_positive
from .curve_model import CurveModel, equivalent_volume
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
    "COLORS",
    "Calibration",
    "Fit",
    "best_fit",
    "calibrate",
    "check_determined",
    "check_intervals",
    "check_optimal",
    "check_options",
    "constants_text",
    "finite_or_none",
    "intervals_of",
    "looks_absolute",
    "misfit_warnings",
    "plural",
]


Curve: typing.TypeAlias = tuple[float, np.ndarray, np.ndarray]
_LOSSES = ("linear", "huber", "soft_l1")
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_MAD = 0.6744897501960817  # median absolute deviation of the standard normal distribution


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The constants that fit a measured pressure–volume curve best, and their uncertainty.

    `parameters` are the constants, `intervals` their confidence intervals at `level`, `correlation` (m, m) that of the
    estimates in the order of `parameters`. `volume` or `height` (the other is None), `voltage`, `pressure` and `fit` (n,) are the
    measurement and the model at its points, in the units of the measurement (SI with `units`); `residuals` = pressure − fit;
    `noise` is the estimated standard deviation of one pressure; `membrane` is the membrane with the fitted constants, `units` the units with the fitted shear
    modulus and permittivity, and `model` computes `curves`. `warnings` are sentences on what makes the constants doubtful, above all a misfit that is not noise.
    """

    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    level: float
    correlation: np.ndarray
    noise: float
    volume: np.ndarray | None
    height: np.ndarray | None
    voltage: np.ndarray
    pressure: np.ndarray
    fit: np.ndarray
    membrane: Membrane
    units: Units | None
    model: Callable[[], tuple[Curve, ...]] = dataclasses.field(repr=False)
    warnings: tuple[str, ...] = ()

    @functools.cached_property
    def curves(self) -> tuple[Curve, ...]:
        """The smooth model curves: (voltage, volumes or heights, pressures) for each voltage, or for nine of more."""
        return self.model()

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
        at = np.asarray(self.volume if self.height is None else self.height)
        of_at = 1e-6 if self.height is None else 1e-3
        of_pressure, of_voltage = 100.0, 1e3
        if self.units is None:
            of_at = of_pressure = of_voltage = 1.0
        one = len(self.curves) == 1
        colors = [("#0072B2", "#D55E00")] if one else [(c, c) for c in COLORS]
        nearest = np.abs(self.voltage[:, None] - [voltage for voltage, *_ in self.curves]).argmin(1)
        lower.axhspan(-2, 2, color="0.9")
        lower.axhline(0.0, color="0.5", linewidth=0.8)
        for k, (voltage, x, pressure) in enumerate(self.curves):
            own = np.flatnonzero(nearest == k)
            dots, line = colors[k % len(colors)]
            said = "measured" if one else f"{voltage / of_voltage:.4g}{' kV' if self.units is not None else ''}"
            said = said if one or self.units is not None else f"Φ = {said}"
            upper.plot(at[own] / of_at, self.pressure[own] / of_pressure, "o", color=dots, label=said, markersize=4)
            # drawn above the points, which would hide the curve
            upper.plot(
                x / of_at,
                pressure / of_pressure,
                "-",
                color=line,
                label=constants_text(self.parameters, self.units) if one else None,
            )
            lower.plot(at[own] / of_at, self.residuals[own] / max(self.noise, 1e-300), "o", color=dots, markersize=4)
        upper.set_ylabel(axis_label("pressure", self.units))
        upper.legend(title=None if one else constants_text(self.parameters, self.units))
        lower.set_ylabel(
            "Residual / noise"
            if self.units is None
            else f"Residual / noise\n(noise {self.noise / of_pressure:.3g} mbar)"
        )
        lower.set_xlabel(axis_label("volume" if self.height is None else "height", self.units))
        return upper.figure

    def to_json(self) -> dict:
        """Everything but the membrane and the curves as a JSON document, with null for numbers that are not finite."""
        return finite_or_none(self._document())

    def _document(self) -> dict:
        at = {n: v.tolist() for n, v in (("volume", self.volume), ("height", self.height)) if v is not None}
        return {
            "units": "dimensionless" if self.units is None else "SI",
            "parameters": self.parameters,
            "intervals": {name: list(pair) for name, pair in self.intervals.items()},
            "level": self.level,
            "correlation": self.correlation.tolist(),
            "noise": self.noise,
            "noise_unit": "μH/A" if self.units is None else "Pa",
            **at,
            "voltage": self.voltage.tolist(),
            "pressure": self.pressure.tolist(),
            "fit": self.fit.tolist(),
            "residuals": self.residuals.tolist(),
            "warnings": list(self.warnings),
        }


def constants_text(parameters: Mapping[str, float], units: Units | None) -> str:
    """The fitted constants for a legend, one on a line."""
    text = []
    for name, value in parameters.items():
        size, unit = {"shear_modulus": (1e3, " kPa"), "pressure_offset": (100.0, " mbar")}.get(name, (1.0, ""))
        size, unit = (size, unit) if units is not None else (1.0, "")
        text.append(f"{name.replace('_', ' ')} {value / size:.4g}{unit}")
    return "fit: " + ",\n".join(text)


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
    volume: ArrayLike | None = None,
    pressure: ArrayLike | None = None,
    *,
    height: ArrayLike | None = None,
    membrane: Membrane | None = None,
    over: Sequence[str] | None = None,
    units: Units | None = None,
    voltage: ArrayLike = 0.0,
    loss: str = "linear",
    noise: float | None = None,
    level: float = 0.95,
) -> Calibration:
    """Constants of a membrane from its measured pressure–volume curve, at one voltage or several, or from pressures at pole heights.

    Minimises Σ ρ((p_i − p(V_i, Φ_i; θ))/σ) over θ, with ρ(x) = x²/2 ("linear"), Huber's function, or √(1 + x²) − 1 ("soft_l1");
    the last two are robust against outliers. The intervals are those of linearised least squares in log θ (in θ itself for
    the prestretch and for constants of either sign) with Student's t; under a robust loss the covariance is that of an
    M-estimator. If the starting values do not reach the largest volume, positive constants are raised until they do.

    Args:
        volume: measured volumes (n,) under the membrane; None with heights.
        pressure: measured gauge pressures (n,).
        height: measured heights (n,) of the pole above the rim, in place of the volumes.
        membrane: material, prestretch and the fixed constants; the constants to fit are starting values.
        over: names of the constants to fit: those of the material (`moduli` for a whole tuple, or `moduli[0]`),
            "prestretch", "pressure_offset" (of a gauge that is not zeroed), and with `units` "shear_modulus", under voltage also
            "relative_permittivity". By default the shear modulus, if there are units, and every
            elastic constant except exponents; without the shear modulus if it is the unit of the constants, as in
            MooneyRivlin.
        units: if given, the measurement is in SI (m³ or m, Pa, and `voltage` in V); its shear modulus and permittivity are starting
            values.
        voltage: Φ during the measurement: one number, or one for each point (n,).
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
    if isinstance(membrane.material, Viscoelastic):
        raise ValueError(
            "`membrane` must have an elastic material, because a curve without times says nothing about branches; fit the spring "
            f"{type(membrane.material.equilibrium).__name__} alone."
        )
    data = _measured(volume, height, pressure, voltage)
    charged = ["relative_permittivity"] * bool(units is not None and data.voltage.any())
    names = sought_constants(membrane.material, over, units is not None, ("prestretch", "pressure_offset", *charged))
    check_options(loss, level, noise)
    data, warnings = _usable(data, units)
    if len(data.at) <= len(names):
        raise ValueError(
            f"`{data.given}` must hold more points than constants to fit, {len(names)}, but holds {len(data.at)}."
        )
    # dimensionless volumes, pressures in the unit that "shear_modulus" multiplies, and Φ² times the fixed constants of q
    of_at, of_pressure, of_load = _scales(names, units, data.given)
    start = {"shear_modulus": 1.0, "relative_permittivity": 1.0, "pressure_offset": 0.0}
    if units is not None:
        start |= {"shear_modulus": float(units.shear_modulus)}
        start |= {"relative_permittivity": float(units.permittivity) / VACUUM_PERMITTIVITY}
    curve = CurveModel(membrane, names, data.at / of_at, of_load * data.voltage**2, start, data.given)
    try:
        fit = best_fit(curve, data.pressure / of_pressure, loss, None if noise is None else noise / of_pressure)
        found = _result(curve, fit, level, data, (of_at, of_pressure, of_load), units)
        bounded = {n: pair for n, pair in found.intervals.items() if n != "pressure_offset"}  # it may well be zero
        warnings += check_intervals(bounded, found.parameters, level)
        seek = "" if "prestretch" in names else "fit more constants, such as the prestretch, "
        warnings += misfit_warnings(
            data.order(),
            data.pressure,
            found.fit,
            robust=loss != "linear",
            noise=noise,
            unit="" if units is None else " Pa",
            advice=f"{seek}use another material, or check the units, the radius and the zero of the pressures.",
        )
    except ValueError as error:
        if units is not None and looks_absolute(data.at, data.pressure):
            low, high = float(data.pressure.min()), float(data.pressure.max())
            raise ValueError(_ABSOLUTE.format(given=data.given, low=low, high=high)) from error
        raise
    return dataclasses.replace(found, warnings=tuple(warnings + _doubtful(found, data)))


_ABSOLUTE = (
    "`pressure` must be a gauge pressure, but is {low:.6g} to {high:.6g} Pa from the smallest {given} on, which looks "
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


def _result(
    curve: CurveModel, fit: Fit, level, data: "_Data", scales: tuple[float, float, float], units
) -> Calibration:
    """The constants with their intervals, and the membrane and units with these constants."""
    of_pressure = scales[1]
    names, values = curve.names, curve.values_of(fit.free)
    intervals, correlation = intervals_of(curve, fit, level)
    membrane = curve.membrane_of(values)
    if units is not None:
        before = units
        units = eqx.tree_at(
            lambda u: (u.shear_modulus, u.permittivity),
            units,
            (
                np.asarray(values.get("shear_modulus", units.shear_modulus)),
                np.asarray(values["relative_permittivity"] * VACUUM_PERMITTIVITY)
                if "relative_permittivity" in names
                else units.permittivity,
            ),
        )
        membrane = Membrane(membrane.material, membrane.prestretch, _law_in(membrane.breakdown, before, units))
    if "pressure_offset" in names:
        values["pressure_offset"] *= of_pressure
        low, high = intervals["pressure_offset"]
        intervals["pressure_offset"] = low * of_pressure, high * of_pressure
    return Calibration(
        parameters=values,
        intervals=intervals,
        level=level,
        correlation=correlation,
        noise=fit.noise * of_pressure,
        volume=data.at if data.given == "volume" else None,
        height=data.at if data.given == "height" else None,
        voltage=data.voltage,
        pressure=data.pressure,
        fit=fit.pressure * of_pressure,
        membrane=membrane,
        units=units,
        model=functools.partial(_curves, curve, fit.free, scales),
    )


def _curves(curve: CurveModel, free: np.ndarray, scales: tuple[float, float, float]) -> tuple[Curve, ...]:
    """Voltages, volumes and pressures of the model's smooth curves, in the units of the measurement."""
    of_at, of_pressure, of_load = scales
    return tuple((float(np.sqrt(q / of_load)), x * of_at, p * of_pressure) for q, x, p in curve.dense(free))


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
        known = units.permittivity == before.permittivity
        relative = law.relative_permittivity if known else units.permittivity / VACUUM_PERMITTIVITY
        return VHBBreakdown(law.scale, units.shear_modulus, relative)
    return units.reduce(before.to_si(law)) if isinstance(law, ConstantBreakdown) else law


def _scales(names: Sequence[str], units: Units | None, given: str) -> tuple[float, float, float]:
    """The units of the curve's volumes or heights and of its pressures, and the part of q/Φ² that is not fitted."""
    if units is None:
        return 1.0, 1.0, 1.0
    shear = 1.0 if "shear_modulus" in names else float(units.shear_modulus)
    permittivity = VACUUM_PERMITTIVITY if "relative_permittivity" in names else float(units.permittivity)
    of_at = float(units.scale("volume") if given == "volume" else units.radius)
    of_pressure = float(units.thickness / units.radius) * shear
    return of_at, of_pressure, permittivity / (float(units.thickness) ** 2 * shear)


def _doubtful(found: Calibration, data: "_Data") -> list[str]:
    """Further warnings about the constants."""
    said = []
    if len({rises for *_, rises in runs_of(data.at)}) > 1:
        said.append(
            f"The {data.given} rises and falls: loading and unloading are fitted together; use only one of them."
        )
    low, high = MODULI
    shear = found.parameters.get("shear_modulus", 0.5 * (low + high))
    if not low < shear < high:
        said.append(
            f"The shear modulus, {shear:.3g} Pa, is not that of an elastomer; check the units, the thickness and the radius."
        )
    return said


def check_options(loss: str, level: float, noise: float | None) -> None:
    """Refuses an unknown loss, and a level or noise that is none."""
    if loss not in _LOSSES:
        raise ValueError(f"`loss` must be one of {', '.join(_LOSSES)}, but is {loss!r}.")
    if not 0 < level < 1:
        raise ValueError(f"`level` must lie between 0 and 1, but is {level!r}.")
    if noise is not None:
        check_positive("noise", float(noise))


@dataclasses.dataclass(frozen=True)
class _Data:
    """A measurement: `at` (n,) are volumes or heights, as `given` says, with the pressures and voltages (n,) there."""

    given: str
    at: np.ndarray
    pressure: np.ndarray
    voltage: np.ndarray

    def order(self) -> np.ndarray:
        """Numbers (n,) that put the points in the order of their voltages, and of the volumes at about one voltage."""
        about = np.round(20 * self.voltage / max(float(self.voltage.max()), 1e-300))
        return about + 0.5 * self.at / self.at.max()


def _measured(volume, height, pressure, voltage) -> _Data:
    if (volume is None) == (height is None) or pressure is None:
        raise ValueError(
            "`volume` or `height` must be given, and not both, with `pressure`, but given are "
            + (
                _and([n for n, v in (("volume", volume), ("height", height), ("pressure", pressure)) if v is not None])
                or "none"
            )
            + "."
        )
    given = "volume" if height is None else "height"
    at, pressure = np.asarray(volume if height is None else height, float), np.asarray(pressure, float)
    for name, values in ((given, at), ("pressure", pressure)):
        if values.ndim != 1 or values.shape != at.shape or not values.size:
            raise ValueError(
                f"`{name}` must be one row of numbers, as long as the other, but has shape {values.shape}."
            )
        least = (
            -BELOW_ZERO * max(np.max(values, initial=0.0, where=np.isfinite(values)), 0.0)
            if name == "pressure"
            else 0.0
        )
        good = np.isfinite(values) & ((values > 0) | (values > least))
        if not good.all():
            wrong = int(np.flatnonzero(~good)[0])
            raise ValueError(
                f"`{name}` must be positive and finite, but is {float(values[wrong])!r} at point {wrong}."
                + (f" (Down to −{100 * BELOW_ZERO:g} % of the largest counts as noise.)" if name == "pressure" else "")
            )
    return _Data(given, at, pressure, _voltages(voltage, at.shape))


def _voltages(voltage, shape: tuple[int, ...]) -> np.ndarray:
    """The voltage of every point."""
    voltage = np.asarray(voltage, float)
    if voltage.shape not in ((), shape):
        raise ValueError(
            f"`voltage` must be one number, or one for each of the {shape[0]} points, but has shape {voltage.shape}."
        )
    for value in np.unique(voltage):
        check_positive("voltage", float(value), zero=True)
    return np.broadcast_to(voltage, shape)


def _usable(data: _Data, units: Units | None) -> tuple[_Data, list[str]]:
    """The points whose volume is that of an inflated film, and a notice about the others."""
    unit = "" if units is None else f" of a film of radius {float(units.radius):.4g} m"
    share = data.at / _scales((), units, data.given)[0]
    inflation = share if data.given == "volume" else equivalent_volume(share)
    if not LEAST_LARGEST < inflation.max() < MOST_LARGEST:
        # a height is compared as the volume of a spherical cap
        about = "" if data.given == "volume" else f", about {inflation.max():.3g} A³"
        raise ValueError(
            f"`{data.given}` must be that of an inflated film, but the largest is {share.max():.3g} {'A' if about else 'A³'}{about}{unit}, "
            f"where {LEAST_LARGEST} to {MOST_LARGEST:g} A³ are possible; check the unit of the {data.given}s and the radius."
        )
    keep = inflation >= LEAST_VOLUME
    said = f"{np.sum(~keep)} points are left out whose volume is below {LEAST_VOLUME:g} A³, where the film is flat."
    kept = _Data(data.given, data.at[keep], data.pressure[keep], data.voltage[keep])
    return kept, [] if keep.all() else [said]


def _and(names: Sequence[str]) -> str:
    return "".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


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
        advice += " (`over` may name pressure_offset.)" if measured == "pressure" else ""
    if misfit > np.sqrt(0.5) * np.std(pressure):
        raise ValueError(f"`{measured}` must be a curve that the material can follow, but {said}; {advice}")
    return [f"T{said[1:]}: the material does not follow the curve, and the intervals are too narrow; {advice}"]


def _offset(pressure, fit, misfit: float) -> float:
    """The offset of the pressures that explains most of a misfit; 0 if none does."""
    both = np.column_stack([np.ones_like(fit), fit])
    offset = np.linalg.lstsq(both, pressure, rcond=None)[0]
    left = float(np.sqrt(np.mean((pressure - both @ offset) ** 2)))
    return float(offset[0]) if left < 0.5 * misfit and abs(offset[0]) > 3 * left else 0.0
