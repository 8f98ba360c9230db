"""Material constants from a measured pressure–volume curve, by least squares with exact Jacobians.

The model of a measurement (V_i, p_i) is the equilibrium of that volume at the voltage of the experiment, from the explicit
map: λa by Newton on V(λa; θ) = V_i, then p(λa; θ). Its derivatives by the constants θ follow from the implicit rule,
dp/dθ = ∂p/∂θ − (∂p/∂λa) (∂V/∂θ)/(∂V/∂λa), through forward-mode autodiff of the map.
"""

import dataclasses
import typing
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.stats import t as student

from .chart import explicit_map
from .membrane import Membrane
from .results import check_positive
from .units import Units

__all__ = ["Calibration", "calibrate"]

_NODES, _ROUNDS, _STEPS = 64, 15, 24.0
_LOSSES = ("linear", "huber", "soft_l1")
_MOST_STEPS = 200
_ROUNDS_OF_SCALE = 12
_HUBER = 1.345  # 95 % as efficient as least squares where the noise is normal
_MAD = 0.6744897501960817  # of a normal distribution's absolute deviations, the median


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Constants that fit a measured pressure–volume curve best, and how well they are known.

    `parameters` are the constants, `intervals` their confidence intervals at `level`, `correlation` (m, m) that of the
    estimates in the order of `parameters`. `volume`, `pressure`, `fit` (n,) are the measurement and the model at its
    volumes, in the units of the measurement; `residuals` = pressure − fit; `noise` is the estimated standard deviation of
    one pressure; `membrane` is the membrane with the constants put in, `units` the units with the shear modulus.
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

    @property
    def residuals(self) -> np.ndarray:
        """pressure − fit, (n,)."""
        return self.pressure - self.fit

    def plot(self, *, axes: typing.Any = None) -> typing.Any:
        """Draws measurement and fit, and the residuals in units of the noise; returns the figure.

        `axes` are two to draw on, else new ones.
        """
        import matplotlib.pyplot as plt

        if axes is None:
            _, axes = plt.subplots(2, 1, figsize=(5.5, 5.5), sharex=True, height_ratios=(3, 1), layout="constrained")
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
        upper.set_ylabel("Pressure p A / (μH)" if self.units is None else "Pressure p / mbar")
        upper.legend()
        lower.axhspan(-2, 2, color="0.9")
        lower.axhline(0.0, color="0.5", linewidth=0.8)
        lower.plot(volume, self.residuals[order] / max(self.noise, 1e-300), "o", color="#0072B2")
        lower.set_ylabel("Residual / noise")
        lower.set_xlabel("Volume V / A³" if self.units is None else "Volume V / ml")
        return upper.figure

    def to_json(self) -> dict:
        """Everything but the membrane as a JSON document."""
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
        }


def _logs(above, material, prestretch, q):
    """log V and log p at λa = λ0 + e^above, elementwise."""
    p, v = explicit_map(material, prestretch + jnp.exp(above), q, prestretch, _STEPS)[:2]
    return jnp.stack([jnp.log(v), jnp.log(p)])


@eqx.filter_jit
def _table(membrane, q, top):
    nodes = jnp.linspace(jnp.log(1e-4), jnp.log(top), _NODES)
    return nodes, _logs(nodes, membrane.material, membrane.prestretch, q)[0]


def _nearest(membrane: Membrane, volume, q, top) -> np.ndarray:
    """log(λa − λ0) about the volumes, from a table; the flat end under voltage and the far end may hold no states."""
    nodes, logs = (np.asarray(v) for v in _table(membrane, q, top))
    good = np.isfinite(logs)
    if good.sum() < 2:
        raise ValueError(f"`membrane` must have states at this voltage, but {membrane!r} has none.")
    return np.interp(np.log(volume), np.maximum.accumulate(logs[good]), nodes[good])


def _pressures(material, prestretch, volume, q, near):
    """p of the equilibria at the volumes (n,) and load q, where V rises with λa; `near` is log(λa − λ0) to start from.

    Differentiable in the material's constants, the prestretch and q, in forward mode.
    """
    goal, frozen = jnp.log(volume), jax.lax.stop_gradient((material, prestretch, q))

    def newton(state):
        above, _, k, _ = state
        value, slope = jax.jvp(lambda x: _logs(x, *frozen), (above,), (jnp.ones_like(above),))[:2]
        move = jnp.clip((goal - value[0]) / slope[0], -0.5, 0.5)
        return above + move, slope, k + 1, jnp.max(jnp.abs(move))

    def going(state):
        return (state[2] < _ROUNDS) & ~(state[3] < 1e-7)

    begin = near, jnp.ones((2, *near.shape)), 0, jnp.asarray(jnp.inf)
    above, slope, *_ = jax.lax.stop_gradient(jax.lax.while_loop(going, newton, begin))
    value = _logs(above, material, prestretch, q)
    # the last step of Newton, with the slopes held: its derivative is that of the implicit function
    return jnp.exp(value[1] + slope[1] / slope[0] * (goal - value[0]))


def _to_free(name: str, value):
    return jnp.log(value - 1) if name == "prestretch" else jnp.log(value)


def _from_free(name: str, free):
    return 1 + jnp.exp(free) if name == "prestretch" else jnp.exp(free)


def _put(membrane: Membrane, names: Sequence[str], values):
    """Material and prestretch with the constants put in."""
    material, prestretch = membrane.material, membrane.prestretch
    for name, value in zip(names, values, strict=True):
        if name == "prestretch":
            prestretch = value
        elif name != "shear_modulus":
            material = eqx.tree_at(lambda m, name=name: getattr(m, name), material, jnp.asarray(value, float))
    return material, prestretch


@eqx.filter_jit
def _model(free, membrane, volume, q_scale, near, names):
    """The model's pressures (n,) and their exact Jacobian (n, m) by the free parameters, whose `names` are static.

    With a shear modulus μ among the names pressures are in units of H/A, and q = q_scale/μ.
    """

    def model(free):
        values = [_from_free(n, f) for n, f in zip(names, free, strict=True)]
        material, prestretch = _put(membrane, names, values)
        shear = values[names.index("shear_modulus")] if "shear_modulus" in names else jnp.asarray(1.0)
        pressure = shear * _pressures(material, prestretch, volume, q_scale / shear, near)
        return pressure, pressure

    jacobian, pressure = jax.jacfwd(model, has_aux=True)(free)
    return pressure, jacobian


def _minimum(model: Callable, free: np.ndarray, pressure: np.ndarray, loss: str, scale: float) -> np.ndarray:
    """The free parameters of the least loss, with residuals in units of `scale`, by SciPy's trust region."""
    known: dict = {}

    def at(x):
        if known.get("x") is None or (known["x"] != x).any():
            value, jacobian = (np.asarray(v) for v in model(jnp.asarray(x)))
            # where the material locks before the largest volume there is no state: far from the data
            value = np.where(np.isfinite(value), value, 1e3 * pressure)
            known.update(x=np.array(x), residual=(value - pressure) / scale, jacobian=np.nan_to_num(jacobian) / scale)
        return known

    found = least_squares(
        lambda x: at(x)["residual"],
        free,
        jac=lambda x: at(x)["jacobian"],  # pyright: ignore[reportArgumentType]
        loss=loss,
        f_scale=_HUBER if loss == "huber" else 1.0,
        x_scale="jac",
        ftol=1e-13,
        xtol=1e-11,
        gtol=1e-13,
        max_nfev=_MOST_STEPS,
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

    Minimises Σ ρ((p_i − p(V_i; θ))/σ) over θ, with ρ(x) = x²/2 ("linear"), Huber's, or √(1 + x²) − 1 ("soft_l1"), which
    an outlier hardly moves. The intervals are those of linearised least squares in log θ (log(λ0 − 1) for the prestretch)
    with Student's t; under a robust loss the covariance is that of an M-estimator.

    Args:
        volume: measured volumes (n,) under the membrane.
        pressure: measured pressures (n,).
        membrane: material, prestretch and the constants that stay; those sought are starting values.
        over: names of the constants: those of the material, "prestretch", and with `units` "shear_modulus". By default the
            shear modulus, where there are units, and every constant of the material.
        units: where given, the measurement is in SI (m³, Pa, and `voltage` in V); its shear modulus is a starting value.
        voltage: Φ during the measurement.
        loss: "linear", "huber" or "soft_l1".
        noise: standard deviation of one pressure, if known; else it is estimated from the residuals.
        level: of the confidence intervals.

    Raises:
        ValueError: for bad input, and where no fit is found.

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
    names = _names(membrane, over, units)
    if len(volume) <= len(names):
        raise ValueError(
            f"`volume` must hold more points than constants are sought, {len(names)}, but holds {len(volume)}."
        )
    if loss not in _LOSSES:
        raise ValueError(f"`loss` must be one of {', '.join(_LOSSES)}, but is {loss!r}.")
    if not 0 < level < 1:
        raise ValueError(f"`level` must lie between 0 and 1, but is {level!r}.")
    check_positive("voltage", float(voltage), zero=True)
    if noise is not None:
        check_positive("noise", float(noise))
    start = {n: _start_of(n, membrane, units) for n in names}
    # volumes without unit, pressures in units of the one that "shear_modulus" multiplies, q times that
    of_volume, of_pressure, q_scale = 1.0, 1.0, float(voltage) ** 2
    if units is not None:
        of_volume = float(units.scale("volume"))
        of_pressure = float(units.thickness / units.radius)
        q_scale = float(voltage**2 * units.permittivity / units.thickness**2)
        if "shear_modulus" not in names:
            of_pressure, q_scale = float(units.scale("pressure")), float(voltage**2 / units.scale("voltage_squared"))
    v, p = volume / of_volume, pressure / of_pressure
    top = 2.0 + 4.0 * float(v.max()) ** (1 / 3)
    near = _nearest(membrane, v, np.asarray(q_scale / start.get("shear_modulus", 1.0)), np.asarray(top))
    free = np.array([float(_to_free(n, start[n])) for n in names])
    # arrays, as plain numbers would be compiled in
    given = membrane, v, np.asarray(q_scale), near, tuple(names)
    scale = 0.02 * float(np.median(p)) if noise is None else noise / of_pressure

    def model(free):
        return _model(free, *given)

    free = _minimum(model, free, p, "linear", scale)
    for _ in range(_ROUNDS_OF_SCALE if loss != "linear" else 0):
        if noise is None:  # the scale of a robust loss is that of its own residuals
            scale = max(float(np.median(np.abs(p - np.asarray(model(jnp.asarray(free))[0])))) / _MAD, 1e-9 * p.mean())
        free, before = _minimum(model, free, p, loss, scale), free
        if np.abs(free - before).max() < 1e-9:
            break
    fit, jacobian = (np.asarray(x) for x in model(jnp.asarray(free)))
    if not (np.isfinite(fit).all() and np.isfinite(jacobian).all()):
        raise ValueError(
            f"`pressure` must be a curve that the material can follow, but no fit of {', '.join(names)} was found from "
            f"{ {n: float(s) for n, s in start.items()} }; start elsewhere, or seek fewer constants."
        )
    residual, freedom = p - fit, len(p) - len(names)
    spread = _noise(residual, freedom, loss, scale, noise is not None)
    try:
        covariance = np.linalg.inv(jacobian.T @ jacobian) * spread**2
    except np.linalg.LinAlgError:
        covariance = np.full((len(names), len(names)), np.inf)
    error = np.sqrt(np.diag(covariance))
    reach = student.ppf((1 + level) / 2, freedom) * error
    with np.errstate(all="ignore"):
        correlation = covariance / np.outer(error, error)
        ends = [[float(_from_free(n, x + s * r)) for s in (-1, 1)] for n, x, r in zip(names, free, reach, strict=True)]
    values = [float(_from_free(n, x)) for n, x in zip(names, free, strict=True)]
    material, prestretch = _put(membrane, names, values)
    if units is not None and "shear_modulus" in names:
        units = eqx.tree_at(lambda u: u.shear_modulus, units, np.asarray(values[names.index("shear_modulus")]))
    return Calibration(
        parameters=dict(zip(names, values, strict=True)),
        intervals={n: (e[0], e[1]) for n, e in zip(names, ends, strict=True)},
        level=level,
        correlation=correlation,
        noise=float(np.sqrt(residual @ residual / freedom) if loss == "linear" else scale) * of_pressure,
        volume=volume,
        pressure=pressure,
        fit=fit * of_pressure,
        membrane=Membrane(jax.tree.map(np.asarray, material), float(prestretch), membrane.breakdown),
        units=units,
    )


def _noise(residual, freedom: int, loss: str, scale: float, known: bool) -> float:
    """The factor on (JᵀJ)^-½ of the estimates' errors, Huber's for M-estimators: s √(Σψ²/(n − m)) / mean ψ'."""
    if loss == "linear":
        return scale if known else float(np.sqrt(residual @ residual / freedom))
    x = residual / scale
    if loss == "huber":
        psi, rate = np.clip(x, -_HUBER, _HUBER), np.abs(x) < _HUBER
    else:
        psi, rate = x / np.sqrt(1 + x**2), (1 + x**2) ** -1.5
    return float(scale * np.sqrt(psi @ psi / freedom) / np.mean(rate))


def _measured(volume, pressure) -> tuple[np.ndarray, np.ndarray]:
    volume, pressure = np.asarray(volume, float), np.asarray(pressure, float)
    for name, values in (("volume", volume), ("pressure", pressure)):
        if values.ndim != 1 or values.shape != volume.shape:
            raise ValueError(
                f"`{name}` must be one row of numbers, as long as the other, but has shape {values.shape}."
            )
        wrong = np.flatnonzero(~(np.isfinite(values) & (values > 0)))
        if wrong.size:
            raise ValueError(
                f"`{name}` must be positive and finite, but is {float(values[wrong[0]])!r} at point {wrong[0]}."
            )
    return volume, pressure


def _names(membrane: Membrane, over, units) -> list[str]:
    own = [
        f.name
        for f in dataclasses.fields(membrane.material)
        if eqx.is_inexact_array(getattr(membrane.material, f.name))
    ]
    own = [n for n in own if np.ndim(getattr(membrane.material, n)) == 0]
    allowed = own + ["prestretch"] + ["shear_modulus"] * (units is not None)
    names = ["shear_modulus"] * (units is not None) + own if over is None else list(over)
    for name in names:
        if name not in allowed:
            raise ValueError(f"`over` must name some of {', '.join(allowed)}, but holds {name!r}.")
    if not names or len(set(names)) < len(names):
        raise ValueError(f"`over` must name one constant or more, each once, but is {names!r}.")
    return names


def _start_of(name: str, membrane: Membrane, units: Units | None) -> float:
    if name == "shear_modulus":
        return float(typing.cast(Units, units).shear_modulus)
    if name == "prestretch":
        return max(float(membrane.prestretch), 1.02)
    return float(getattr(membrane.material, name))
