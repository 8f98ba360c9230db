"""How pressure, volume and electrostatic load are tied together: a loading draws one contour on the chart.

Every loading becomes values of one `LoadingCondition`, so that one compiled program serves them all.
"""

import abc
import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..numerics import Readable, check_positive
from .materials import Scalar, as_scalar, is_concrete

__all__ = [
    "AbstractLoading",
    "Chamber",
    "ChargeControl",
    "ConstantPressure",
    "ConstantVoltage",
    "LoadingCondition",
    "PrescribedVolume",
    "control_of",
    "mechanical",
    "other_loading",
]


def _namespace(*values):
    """NumPy for NumPy values, so that host code compiles nothing; else jax.numpy."""
    return np if all(isinstance(v, (np.ndarray, np.generic, float, int)) for v in values) else jnp


class LoadingCondition(eqx.Module):
    """The condition a (p − p_gas(V)) + b (q − q*) + c (V − V*) = 0 with the gas of a closed chamber, eq. (24).

    (p_gas + p_atm)(V + V_C)ⁿ = (p_0 + p_atm)(V_0 + V_C)ⁿ; an exponent n = 0 is a gas of constant pressure. Charge
    control draws the same contour; `charge` is 1 for it, else 0: it decides which points are folds, and the index.
    """

    pressure_weight: Scalar
    load_weight: Scalar
    load: Scalar
    chamber_volume: Scalar
    initial_pressure: Scalar
    initial_volume: Scalar
    atmospheric_pressure: Scalar
    exponent: Scalar
    volume_weight: Scalar
    volume: Scalar
    charge: Scalar

    def gas_pressure(self, volume):
        """p_gas(V), written so that nothing cancels for a huge chamber; elementwise."""
        xp = _namespace(volume, *vars(self).values())
        volume = xp.clip(volume, -0.5 * self.chamber_volume, 1e12)  # a trial far off stays finite
        share = (self.initial_volume - volume) / (volume + self.chamber_volume)
        if xp is np and np.all(self.exponent == 1):
            return self.initial_pressure + (self.initial_pressure + self.atmospheric_pressure) * share
        growth = xp.log1p(share)
        return self.initial_pressure + (self.initial_pressure + self.atmospheric_pressure) * xp.expm1(
            self.exponent * growth
        )

    def gas_stiffness(self, volume):
        """k = −dp_gas/dV = n (p_gas + p_atm)/(V + V_C), the rank-one term a chamber adds to the second variation."""
        pressure = self.gas_pressure(volume) + self.atmospheric_pressure
        return self.pressure_weight * self.exponent * pressure / (volume + self.chamber_volume)

    @property
    def control(self) -> int:
        """Which of (λa, p, q, Q²) is the control, at whose folds the index changes: p where the voltage is held."""
        return 1 if float(self.load_weight) != 0 else 3 if float(self.charge) != 0 else 2

    def residual(self, pressure, volume, voltage_squared):
        """The condition; elementwise."""
        value = self.pressure_weight * (pressure - self.gas_pressure(volume))
        on_host = _namespace(pressure, volume, voltage_squared, *vars(self).values()) is np
        if not (on_host and not np.any(self.load_weight)):
            value = value + self.load_weight * (voltage_squared - self.load)
        if not (on_host and not np.any(self.volume_weight)):
            value = value + self.volume_weight * (volume - self.volume)
        return value

    def slopes(self, volume):
        """Derivatives of the residual by p, V and q."""
        return self.pressure_weight, self.gas_stiffness(volume) + self.volume_weight, self.load_weight


class AbstractLoading(Readable):
    """A loading; `condition` gives its values, with the filling of a chamber already known on both sides."""

    @abc.abstractmethod
    def condition(self, initial_pressure=None, initial_volume=None) -> LoadingCondition:
        """The values of the loading's condition; a chamber needs its filling (p_0, V_0)."""


def _contour(**values) -> LoadingCondition:
    names = [f.name for f in dataclasses.fields(LoadingCondition)]
    return LoadingCondition(**{n: as_scalar(values.get(n, 0.0 if n != "chamber_volume" else 1.0)) for n in names})


class ConstantVoltage(AbstractLoading):
    """The voltage is held and the pressure controlled: the pressure–volume curve."""

    voltage: Scalar = eqx.field(default=0.0, converter=as_scalar)

    def __check_init__(self):
        if is_concrete(self.voltage):
            check_positive("voltage", float(self.voltage), zero=True)

    def condition(self, initial_pressure=None, initial_volume=None):
        return _contour(load_weight=10.0, load=self.voltage**2)


class ConstantPressure(AbstractLoading):
    """The pressure is held and the voltage controlled: p = `pressure`."""

    pressure: Scalar = eqx.field(converter=as_scalar)

    def __check_init__(self):
        if is_concrete(self.pressure):
            check_positive("pressure", float(self.pressure), zero=True)

    def condition(self, initial_pressure=None, initial_volume=None):
        return _contour(pressure_weight=1.0, initial_pressure=self.pressure)


class Chamber(AbstractLoading):
    """A closed chamber of air: (p + p_atm)(V + V_C)ⁿ = (p_0 + p_atm)(V_0 + V_C)ⁿ, eq. (24) with n = 1.

    `volume` is V_C. Give the filling by `initial_volume` V_0 or by `initial_pressure` p_0 (then the state of smallest
    volume at zero voltage is meant), not both; a scene works out the other from its membrane.
    `polytropic_exponent` n is 1 for an isothermal gas.
    """

    volume: Scalar = eqx.field(converter=as_scalar)
    initial_volume: Scalar | None = eqx.field(default=None, converter=lambda v: None if v is None else as_scalar(v))
    initial_pressure: Scalar | None = eqx.field(default=None, converter=lambda v: None if v is None else as_scalar(v))
    atmospheric_pressure: Scalar = eqx.field(default=50.0, converter=as_scalar)
    polytropic_exponent: Scalar = eqx.field(default=1.0, converter=as_scalar)

    def __check_init__(self):
        given = [n for n in ("initial_volume", "initial_pressure") if getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(
                f"`initial_volume` or `initial_pressure` must be given, one of the two, but {len(given)} are."
            )
        checks = {"volume": False, "polytropic_exponent": False, "atmospheric_pressure": True, given[0]: True}
        for name, zero in checks.items():
            value = getattr(self, name)
            if is_concrete(value):
                check_positive("chamber_volume" if name == "volume" else name, float(value), zero=zero)

    def condition(self, initial_pressure=None, initial_volume=None):
        return _contour(
            pressure_weight=1.0,
            chamber_volume=self.volume,
            initial_pressure=initial_pressure,
            initial_volume=initial_volume,
            atmospheric_pressure=self.atmospheric_pressure,
            exponent=self.polytropic_exponent,
        )


class PrescribedVolume(AbstractLoading):
    """The volume under the membrane is held and the voltage controlled: V = `volume`, as with a liquid beneath it.

    The pressure is what the membrane needs.
    """

    volume: Scalar = eqx.field(converter=as_scalar)

    def __check_init__(self):
        if is_concrete(self.volume):
            check_positive("volume", float(self.volume), zero=True)

    def condition(self, initial_pressure=None, initial_volume=None):
        return _contour(volume_weight=1 / self.volume, volume=self.volume)


class ChargeControl(AbstractLoading):
    """The charge Q on the electrodes is controlled instead of the voltage; `loading` is what the membrane rests on.

    Equilibria are those of `loading` under voltage. Other points are folds, the extremes of Q, and more states are
    stable: U + Q²/(2C) takes the place of U − CΦ²/2, with C = Q/Φ.

    >>> ChargeControl(ConstantPressure(1.0)).loading.pressure
    array(1.)
    """

    loading: AbstractLoading

    def __check_init__(self):
        if not isinstance(self.loading, (Chamber, ConstantPressure, PrescribedVolume)):
            raise ValueError(
                "`loading` of a ChargeControl must be a Chamber, a ConstantPressure or a PrescribedVolume, but is a "
                f"{type(self.loading).__name__}."
            )

    def condition(self, initial_pressure=None, initial_volume=None):
        return dataclasses.replace(self.loading.condition(initial_pressure, initial_volume), charge=as_scalar(1.0))


def other_loading(loading, *kinds: type) -> ValueError:
    """The error for a loading that is none of the kinds that are taken.

    >>> str(other_loading(PrescribedVolume(3.0), Chamber, ConstantPressure))
    '`loading` must be a Chamber or a ConstantPressure here, but is a PrescribedVolume.'
    """
    *others, last = (f"a {kind.__name__}" for kind in kinds)
    allowed = f"{', '.join(others)} or {last}" if others else last
    return ValueError(f"`loading` must be {allowed} here, but is a {type(loading).__name__}.")


def mechanical(loading: AbstractLoading) -> AbstractLoading:
    """How pressure and volume answer, whatever is controlled on the electrodes."""
    return loading.loading if isinstance(loading, ChargeControl) else loading


def control_of(loading: AbstractLoading) -> str:
    """What a ramp changes: "pressure", "voltage" or "charge"."""
    if isinstance(loading, ConstantVoltage):
        return "pressure"
    return "charge" if isinstance(loading, ChargeControl) else "voltage"
