"""SI and dimensionless numbers: `Units` converts parameters, records, loadings and JSON documents both ways.

All computing is dimensionless. A quantity is known by its name: the published parameters of a scene, the columns of
states, branches and profiles, the keys of a document. Lengths are measured in A, stresses in μ, pressures in μH/A,
volumes in A³, voltages in H√(μ/ε), fields in √(μ/ε), charges in A²√(εμ), energies in μHA² (eq. 23 of
doi 10.1016/j.jmps.2012.09.006).
"""

import dataclasses
import math
import typing
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import LARGEST, Readable, check_positive, shown
from .parameters import PARAMETERS
from .quantities import VACUUM_PERMITTIVITY, quantity

__all__ = [
    "ATMOSPHERE",
    "VHB_4910",
    "OutOfReach",
    "Scalar",
    "Units",
    "as_scalar",
    "from_text",
    "is_concrete",
    "refuse_dimensionless",
    "refuse_si",
]

Scalar: typing.TypeAlias = typing.Any  # a number, or the array or tracer that stands for one

#: the two fits to VHB 4910 of the paper's section 3: to inflation (used in its analyses), and to tension
VHB_4910 = {
    "inflation": {"shear_modulus": 45e3, "stretch_limit": 270.0},
    "tension": {"shear_modulus": 68e3, "stretch_limit": 372.0, "chain_links": 125.0},
}

# what kind of quantity a name of a record is; names that are missing have no unit
_KINDS = {
    "voltage": ("voltage",),
    "voltage_squared": ("voltage_squared",),
    "length": ("height", "radius", "r", "z"),
    "charge": ("charge",),
    "field": ("field", "constant_field", "breakdown"),
    "stress": ("stress", "stress_1", "stress_2", "hoop_tension"),
    "energy": ("energy",),
}
_KIND = {row.name: row.kind for row in PARAMETERS.values() if row.kind in ("pressure", "volume")}
_KIND |= {name: kind for kind, names in _KINDS.items() for name in names}
_SI_NAMES = {
    "pressure": "Pa",
    "volume": "m³",
    "voltage": "V",
    "voltage_squared": "V²",
    "length": "m",
    "charge": "C",
    "field": "V/m",
    "stress": "Pa",
    "energy": "J",
}
# the units in which people read a kind, or one name of it: (name, its size in SI)
_READ = {
    "pressure": ("mbar", 100.0),
    "volume": ("ml", 1e-6),
    "chamber_volume": ("L", 1e-3),
    "voltage": ("kV", 1e3),
    "voltage_squared": ("kV²", 1e6),
    "length": ("mm", 1e-3),
    "charge": ("μC", 1e-6),
    "field": ("MV/m", 1e6),
    "stress": ("kPa", 1e3),
    "energy": ("mJ", 1e-3),
}
# the usual ranges of the dimensionless numbers of chambers and films
_USUAL = {
    "chamber_volume": (0.1, 1e7),
    "initial_volume": (1e-3, 1e4),
    "initial_pressure": (1e-3, 100.0),
    "pressure": (1e-3, 100.0),
    "atmospheric_pressure": (1e-2, 5e3),
    "breakdown": (1e-2, 1e4),
}
# the usual ranges in SI: a larger chamber, or a pressure of less than 0.1 mbar, is rather a dimensionless number
_USUAL_IN_SI = {
    "chamber_volume": (0.0, 1.0),
    "initial_volume": (0.0, 0.1),
    "initial_pressure": (10.0, LARGEST),
    "pressure": (10.0, LARGEST),
    "atmospheric_pressure": (1e3, LARGEST),
}
# the constants of the units themselves, in SI wherever they stand
_CONSTANTS = {row.name: row.kind for row in PARAMETERS.values() if row.path[0] == "units"}
_DIMENSIONLESS_ATMOSPHERE = 50.0  # the default of a chamber
ATMOSPHERE = 100e3  # Pa, the default of files and commands in SI: 50 μH/A for the membrane of the paper


def is_concrete(value) -> bool:
    """Whether a value can be checked now, that is, no transformation is tracing it."""
    return not isinstance(value, jax.core.Tracer)  # pyright: ignore[reportAttributeAccessIssue]


def as_scalar(value: Scalar):
    """A float64 scalar, or the tracer that stands for one."""
    if not is_concrete(value):
        return jnp.asarray(value, dtype=float)
    try:
        return np.asarray(value, dtype=np.float64)
    except OverflowError:  # an integer beyond floats, which checks refuse as they refuse infinity
        return np.asarray(math.inf if value > 0 else -math.inf)


def _constant(name: str) -> Callable:
    """A converter of a constant of the units: a number in SI, or a text with a unit such as "0.3 MPa"."""
    return lambda value: as_scalar(from_text(name, value) if isinstance(value, str) else value)


def _or_none(name: str) -> Callable:
    """The converter of a constant that need not be given."""
    return lambda value: None if value is None else _constant(name)(value)


class Units(Readable):
    """What one means in SI: shear modulus μ [Pa], undeformed thickness H [m], radius A [m], permittivity ε [F/m].

    Each is a number in SI, or a text with its unit such as "0.3 MPa", "0.2 mm", "2.8 eps0".

    By default the membrane of the paper's analyses: VHB 4910 with μ = 45 kPa, H = 1 mm, A = 22.5 mm, ε = 4.7 ε0. The
    field's unit √(μ/ε) is also that of the breakdown law, which must be given the same μ and ε; `Scene` checks it, and
    `Scene.from_si` does it. A film is mounted on an opening of radius a = λ0 A; `Units.for_opening` gives A by a, and a scene with such
    units keeps the opening as its prestretch changes. The `density` ρ [kg/m³] of the film, none by default, is needed for frequencies only.

    >>> units = Units()
    >>> round(units.to_si(0.1, "voltage"), 6), round(units.to_si(2.42, "volume") / 1e-6, 6)  # V, ml
    (3288.422182, 27.565312)
    >>> round(units.from_si(100e3, "atmospheric_pressure"), 12)
    50.0
    >>> round(units.read(0.1, "voltage"), 9), units.read_name("voltage")
    (3.288422182, 'kV')
    """

    shear_modulus: Scalar = eqx.field(
        default=VHB_4910["inflation"]["shear_modulus"], converter=_constant("shear_modulus")
    )
    thickness: Scalar = eqx.field(default=1e-3, converter=_constant("thickness"))
    radius: Scalar = eqx.field(default=22.5e-3, converter=_constant("radius"))
    permittivity: Scalar = eqx.field(default=4.7 * VACUUM_PERMITTIVITY, converter=_constant("permittivity"))
    density: Scalar | None = eqx.field(default=None, converter=_or_none("density"))
    opening_radius: Scalar | None = eqx.field(default=None, converter=_or_none("opening_radius"))

    def __check_init__(self):
        if self.density is not None and is_concrete(self.density):
            check_positive("density", float(self.density))
        for name in _CONSTANTS:
            if getattr(self, name) is not None and is_concrete(getattr(self, name)):
                value = float(getattr(self, name))
                check_positive(name, value)
                if value < 1 / LARGEST:  # what is divided by it must not overflow
                    raise ValueError(f"`{name}` must be at least {1 / LARGEST:g}, but is {value!r}.")

    @classmethod
    def for_opening(cls, opening_radius: Scalar | str, prestretch: Scalar = 1.0, **constants) -> "Units":
        """The units of a film that is mounted with a prestretch λ0 on an opening of radius a [m]: A = a/λ0.

        >>> units = Units.for_opening("15 mm", prestretch=1.2, thickness="0.2 mm")
        >>> round(float(units.radius), 9)
        0.0125
        """
        opening = _constant("opening_radius")(opening_radius)
        return cls(radius=opening / prestretch, opening_radius=opening, **constants)

    @property
    def relative_permittivity(self):
        """ε/ε0."""
        return self.permittivity / VACUUM_PERMITTIVITY

    def scale(self, name: str):
        """The size in SI of the unit in which the quantity `name` is measured; 1 for what has no unit."""
        mu, h, a, eps = self.shear_modulus, self.thickness, self.radius, self.permittivity
        kind = _KIND.get(name)
        if kind == "voltage_squared":
            return h * h * mu / eps
        field = (mu / eps) ** 0.5
        return {
            None: 1.0,
            "length": a,
            "stress": mu,
            "pressure": mu * h / a,
            "volume": a**3,
            "voltage": h * field,
            "field": field,
            "charge": a * a * eps * field,
            "energy": mu * h * a * a,
        }[kind]

    def to_si(self, what: typing.Any, name: str | None = None) -> typing.Any:
        """Dimensionless numbers in SI.

        Args:
            what: a number or array, with its `name`; or a record (`State`, `Branch`, `Event`, `Ramp`, `Profile`, the ramps
                of an ensemble), a loading, or a JSON document: every quantity in it is converted, and what comes back is of
                the same type. It is there to be read; the package computes with dimensionless records only.
            name: which quantity a number is, such as "voltage", "pressure", "volume", "height", "field", "charge".

        Raises:
            ValueError: for a name without unit, or a number without name.
        """
        return self._convert(what, name, self.scale)

    def from_si(self, what: typing.Any, name: str | None = None) -> typing.Any:
        """Numbers in SI made dimensionless; arguments as in `to_si`.

        >>> from dielectric_jax import Chamber
        >>> chamber = Units().from_si(Chamber(volume=20e-3, initial_volume=12e-6, atmospheric_pressure=100e3))
        >>> round(float(chamber.volume), 4), round(float(chamber.initial_volume), 6)
        (1755.8299, 1.053498)
        """
        pressure = getattr(what, "atmospheric_pressure", None)
        if pressure is not None and is_concrete(pressure) and np.all(pressure == _DIMENSIONLESS_ATMOSPHERE):
            raise ValueError(
                "`atmospheric_pressure` must be given in Pa for a chamber in SI, but is 50.0, the dimensionless default."
            )
        return self.reduce(what, name)

    def reduce(self, what: typing.Any, name: str | None = None) -> typing.Any:
        """`from_si` for loadings that are known to be in SI: a pressure of 50.0 Pa outside is no slip."""
        return self._convert(what, name, lambda n: 1 / self.scale(n))

    def read(self, what: typing.Any, name: str | None = None) -> typing.Any:
        """Dimensionless numbers in the units people read: kV, ml (chambers in L), mbar, mm, MV/m, kPa, μC; as `to_si`."""
        return self._convert(what, name, lambda n: self.scale(n) / _read(n)[1])

    @staticmethod
    def read_name(name: str) -> str:
        """The unit in which `read` gives the quantity; "" for what has none."""
        return _read(name)[0]

    @staticmethod
    def names(*, read: bool = False) -> dict[str, str]:
        """The unit of every name that has one: SI, or with `read=True` those of `read`."""
        known = {n: k for n, k in _KIND.items() if n not in (*_CONSTANTS, "r", "z")}
        return {n: _read(n)[0] if read else _SI_NAMES[k] for n, k in known.items()} | _CONSTANTS

    def to_document(self, document: dict, *, read: bool = False) -> dict:
        """A JSON document in SI: "units" is "SI", "unit_names" names the unit of every quantity it may hold.

        With `read=True` the units of `read` instead, for people. The scene lists the constants of the units, always in SI.
        """
        constants = {n: float(getattr(self, n)) for n in _CONSTANTS if getattr(self, n) is not None}
        out = self.read(document) if read else self.to_si(document)
        names = {"units": "kV, ml, mbar" if read else "SI", "unit_names": self.names(read=read)}
        out = {k: names.pop(k) if k == "units" else v for k, v in out.items()}
        out["scene"] = out["scene"] | constants
        return out | names

    @staticmethod
    def _convert(what, name: str | None, factor: Callable) -> typing.Any:
        if name is not None:
            if name not in _KIND:
                raise ValueError(f"`name` must be one of {', '.join(_KIND)}, but is {name!r}.")
            return _times(what, factor(name))
        if isinstance(what, (int, float, np.ndarray, jax.Array)):
            raise ValueError("`name` must be given with a number, such as 'voltage' or 'pressure', but is not.")
        return _converted(what, factor)


class OutOfReach(ValueError):
    """A pressure or volume that the membrane does not reach; the message is dimensionless, or in SI with `units`.

    >>> error = OutOfReach("volume", 455.315, "what the membrane reaches", 500.0)
    >>> str(error)
    '`volume` must lie between 0 and 455.315, what the membrane reaches, but is 500.'
    >>> str(error.in_units(Units()))
    '`volume` must lie between 0 and 0.00518632 m³, what the membrane reaches, but is 0.0056953125 m³.'
    """

    def __init__(self, name: str, most: float, what: str, value: float, units: Units | None = None):
        self.about, self.units = (name, most, what, value), units
        if units is not None:
            most, value = (float(units.to_si(v, name)) for v in (most, value))
        unit = "" if units is None else f" {units.names()[name]}"
        super().__init__(f"`{name}` must lie between 0 and {most:.6g}{unit}, {what}, but is {value:.10g}{unit}.")

    def in_units(self, units: Units | None) -> "OutOfReach":
        """The same in SI."""
        return OutOfReach(*self.about, units)

    def __reduce__(self):
        return OutOfReach, (*self.about, self.units)


_KINDS_OF_CONSTANTS = {"Pa": "stress", "m": "length", "F/m": "permittivity"}


def from_text(name: str, text: str) -> float:
    """The number in SI of a parameter that a text with a unit stands for, such as "0.5 l".

    Raises ValueError for a parameter without unit, and for what is no number with its unit.

    >>> from_text("chamber_volume", "18.225 l"), from_text("thickness", "0.2 mm")
    (0.018225, 0.0002)
    """
    kind = "density" if name == "density" else _KINDS_OF_CONSTANTS.get(_CONSTANTS.get(name, ""), _KIND.get(name))
    if kind is None:
        raise ValueError(f"`{name}` must be a number, but is {shown(text)}.")
    try:
        return quantity(text, kind)
    except ValueError as error:
        raise ValueError(f"`{name}` {error}") from None


def refuse_si(given: Mapping[str, typing.Any], units: Units, *, least: int = 1) -> None:
    """Raises ValueError if `least` of the named dimensionless numbers, or lists of them, look like SI.

    A number does if it is far outside its usual range and would be inside if it were in SI.

    >>> refuse_si({"chamber_volume": 0.018}, Units())
    Traceback (most recent call last):
    ValueError: `chamber_volume` must be dimensionless, but 0.018 looks like SI: 0.018 m³ would be 1580.25; `Units.from_si` converts it.
    """
    found = []
    for name, size, scale in _concrete(given, units):
        low, high = _USUAL[name]
        with np.errstate(all="ignore"):
            usual, usual_in_si = ((v >= low) & (v <= high) for v in (size, size / scale))
        if (usual_in_si & ~usual).all():
            found.append((name, float(size[0]), float(size[0]) / scale))
    if len(found) >= least:
        name, value, would_be = found[0]
        raise ValueError(
            f"`{name}` must be dimensionless, but {value:g} looks like SI: {value:g} {Units.names()[name]} would be "
            f"{would_be:.6g}; `Units.from_si` converts it."
        )


def refuse_dimensionless(given: Mapping[str, typing.Any], units: Units) -> None:
    """Raises ValueError for numbers in SI, or lists of them, that are so far from usual sizes that they look dimensionless.

    >>> refuse_dimensionless({"chamber_volume": 1600.0}, Units())
    Traceback (most recent call last):
    ValueError: `chamber_volume` must be in m³, because the scene carries units, but 1600 looks dimensionless: 1600 A³ would be 0.018225 m³.
    """
    for name, size, scale in _concrete(given, units):
        low, high = _USUAL_IN_SI.get(name, (0.0, LARGEST))
        doubtful = size[(size != 0) & ((size < low) | (size > high))]
        if doubtful.size:
            value, unit = float(doubtful[0]), Units.names()[name]
            kind = {"volume": "A³", "pressure": "μH/A"}[_KIND[name]]
            raise ValueError(
                f"`{name}` must be in {unit}, because the scene carries units, but {value:g} looks dimensionless: "
                f"{value:g} {kind} would be {value * scale:.6g} {unit}."
            )


def _concrete(given: Mapping[str, typing.Any], units: Units):
    """The given quantities that have usual ranges, as arrays, with the scales of the units."""
    for name in _USUAL:
        value = given.get(name)
        if value is None or isinstance(value, str) or not (is_concrete(value) and is_concrete(units.scale(name))):
            continue
        size = np.atleast_1d(np.asarray(value, float))
        if size.size:
            yield name, size, float(units.scale(name))


def _read(name: str) -> tuple[str, float]:
    return _READ.get(name) or _READ.get(_KIND.get(name, ""), ("", 1.0))


def _times(value, factor):
    """The product; None, words and truths stay, and plain numbers stay plain."""
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, (list, tuple)):
        return type(value)(_times(v, factor) for v in value)
    product = value * factor
    return float(product) if isinstance(value, (int, float)) and is_concrete(product) else product


def _converted(what, factor: Callable):
    """A copy whose named quantities are converted, at any depth."""
    if isinstance(what, Mapping):
        return {k: _member(v, "" if k in _CONSTANTS else str(k), factor) for k, v in what.items()}
    if hasattr(what, "_fields"):
        return type(what)(*(_member(getattr(what, n), n, factor) for n in what._fields))
    if isinstance(what, (list, tuple)):
        return type(what)(_converted(v, factor) for v in what)
    if dataclasses.is_dataclass(what) and not isinstance(what, type):
        fields = [f.name for f in dataclasses.fields(what)]
        if any(n.startswith("_") or n == "units" for n in fields):
            raise ValueError(
                f"A {type(what).__name__} must be converted part by part, its records or its loading, or as the document "
                "of its `to_json(units=...)`."
            )
        return type(what)(**{n: _member(getattr(what, n), n, factor) for n in fields})
    return what


def _member(value, name: str, factor: Callable):
    nested = isinstance(value, Mapping) or dataclasses.is_dataclass(value) or hasattr(value, "_fields")
    if name in _KIND and not nested:
        return _times(value, factor(name))
    return _converted(value, factor)
