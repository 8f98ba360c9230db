"""Free energies of two in-plane stretches, and the fields at which they break down.

A material is its energy W(λ1, λ2) per reference volume in units of the shear modulus μ; every stress and tangent comes
from autodiff of it (`stresses`). All functions are elementwise, so they take scalars or arrays of one shape.
Beyond the limiting stretch the energies go on as their own second-order Taylor polynomial: finite derivatives there,
and `admissible` is False.
"""

import abc
import dataclasses
import functools
import math
import typing
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import LARGEST, Readable, check_positive, elementwise, log1p, of_this_package, reciprocal
from .energies import check_energy, check_modulus, check_permittivity
from .quantities import VACUUM_PERMITTIVITY
from .resolution import (
    LARGEST_EXPONENT,
    LARGEST_LIMIT,
    LEAST_LIMIT,
    LEAST_STRETCH,
    LOCKED_CHAIN,
    MOST_TERMS,
    UNLIMITED_STRETCH,
    UNROLLED_TERMS,
)
from .units import VHB_4910, Scalar, as_scalar, is_concrete

__all__ = [
    "AbstractBreakdown",
    "AbstractDielectric",
    "AbstractMaterial",
    "ArrudaBoyce",
    "ConstantBreakdown",
    "CustomBreakdown",
    "CustomMaterial",
    "CustomPermittivity",
    "Electrostrictive",
    "Gent",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "VHBBreakdown",
    "capacitance",
    "stresses",
]


Elementwise: typing.TypeAlias = typing.Any  # floats of any one shape ("...",): numbers, arrays or tracers


def first_invariant_minus_3(l1, l2):
    """λ1² + λ2² + λ3² − 3 of an incompressible membrane, λ3 = 1/(λ1 λ2)."""
    l3 = reciprocal(l1 * l2)
    return l1 * l1 + l2 * l2 + l3 * l3 - 3


class AbstractMaterial(Readable):
    """A free energy W(λ1, λ2) of your own: a subclass with these three methods is a material everywhere.

    Its fields that are numbers are its constants, which `Scene.replace`, sweeps, derivatives and `continue_scenes` know by
    their names. The energy is written with jax.numpy, elementwise, in units of the shear modulus. On construction it is
    checked: W(λ1, λ2) = W(λ2, λ1), W is stationary at λ1 = λ2 = 1, and the modulus (W_11 + W_12)/6 there lies between 0.1
    and 10. Raises ValueError where it is not. The window ends at `lock_up_stretch`, or before it where the membrane has
    stiffened, see `Window`.

    >>> class Yeoh(AbstractMaterial):
    ...     c3: float = 1e-4
    ...
    ...     def _rise(self, l1, l2):
    ...         return l1**2 + l2**2 + (l1 * l2) ** -2 - 3
    ...
    ...     def energy(self, l1, l2):
    ...         return self._rise(l1, l2) / 2 + self.c3 * self._rise(l1, l2) ** 3
    ...
    ...     def admissible(self, l1, l2):
    ...         return (l1 > 0) & (l2 > 0)
    ...
    ...     def lock_up_stretch(self, prestretch):
    ...         return 12 * prestretch, False
    >>> round(float(stresses(Yeoh(c3=0.0), 2.0, 2.0, 0.0)[0]), 6)  # neo-Hookean: λ − λ⁻⁵
    1.96875
    """

    def __check_init__(self):
        if of_this_package(self):  # known to be sound
            return
        for field in dataclasses.fields(self):  # as by the converters of the package's own
            value = getattr(self, field.name)
            if (isinstance(value, (int, float)) or not is_concrete(value)) and not field.metadata.get("static", False):
                object.__setattr__(self, field.name, as_scalar(value))
        if all(map(is_concrete, jax.tree.leaves(self))):  # what is traced is not known yet
            check_energy(self, "function" if isinstance(self, CustomMaterial) else "energy")

    @abc.abstractmethod
    def energy(self, l1: Elementwise, l2: Elementwise) -> Elementwise:
        """W(λ1, λ2) in units of the shear modulus, elementwise."""

    @abc.abstractmethod
    def admissible(self, l1: Elementwise, l2: Elementwise) -> Elementwise:
        """Whether the stretches lie within the material's limits, elementwise."""

    @abc.abstractmethod
    def lock_up_stretch(self, prestretch: float) -> tuple[float, bool]:
        """The largest apex stretch of the default window, and whether it is a lock-up of the material."""


class AbstractDielectric(AbstractMaterial):
    """A material whose permittivity is ε e(λ1, λ2); any other is an ideal dielectric, e = 1. See `elastomers`."""

    @abc.abstractmethod
    def permittivity(self, l1: Elementwise, l2: Elementwise) -> Elementwise:
        """e(λ1, λ2), elementwise."""


@elementwise
def capacitance(material: AbstractMaterial, l1, l2):
    """C(λ1, λ2) = e (λ1 λ2)², capacitance per reference area in units of ε/H; elementwise."""
    ideal = (l1 * l2) ** 2
    return material.permittivity(l1, l2) * ideal if isinstance(material, AbstractDielectric) else ideal


def _root_of_limit(limit: float) -> float:
    """λ with 2λ² + λ⁻⁴ − 3 = limit > 0, λ ≥ 1; of d = λ² − 1, d² (3 + 2d)/(1 + d)² = limit, where nothing cancels."""
    most = (limit + 1) / 2
    d = min(most, math.sqrt(limit / 3) * (1 + most))  # not below the root: Newton falls to it, the left side is convex
    for _ in range(60):
        g = 1 / (1 + d)
        step = ((d * g) ** 2 * (3 + 2 * d) - limit) / (2 * d * g * (1 + g + g * g))
        d -= step
        if abs(step) < 1e-15 * d:
            break
    return math.sqrt(1 + d)


class Gent(AbstractMaterial):
    """Gent's free energy, W = −(J/2) log(1 − (λ1² + λ2² + λ3² − 3)/J).

    `stretch_limit` is J, the value of the invariant at which the chains are straight (J = 2λ² + λ⁻⁴ − 3 in
    equal-biaxial tension). Source: eq. (5) of doi 10.1016/j.jmps.2012.09.006.

    >>> s1, s2, s11, s12 = stresses(Gent(stretch_limit=270.0), 2.0, 2.0, 0.0)
    >>> round(float(s1), 9), bool(abs(s1 - s2) < 1e-12)
    (2.006369427, True)
    """

    stretch_limit: Scalar = eqx.field(default=270.0, converter=as_scalar)

    def __check_init__(self):
        if is_concrete(self.stretch_limit):
            value = float(self.stretch_limit)
            check_positive("stretch_limit", value)
            if not LEAST_LIMIT <= value <= LARGEST_LIMIT:
                raise ValueError(
                    f"`stretch_limit` must be from {LEAST_LIMIT:g} to {LARGEST_LIMIT:g} (a material without a limit is "
                    f"NeoHookean), but is {value!r}."
                )

    def energy(self, l1, l2):
        x = first_invariant_minus_3(l1, l2) / self.stretch_limit
        top = 1 - 1e-9
        x_safe = jnp.minimum(x, top)
        d = jnp.where(x > top, x - top, 0.0) / (1 - top)
        return -(self.stretch_limit / 2) * (log1p(-x_safe) - d - d * d / 2)

    def admissible(self, l1, l2):
        return first_invariant_minus_3(l1, l2) < (1 - 1e-9) * self.stretch_limit

    def lock_up_stretch(self, prestretch):
        return _root_of_limit(0.99 * float(self.stretch_limit)), True


class NeoHookean(AbstractMaterial):
    """The neo-Hookean free energy, W = (λ1² + λ2² + λ3² − 3)/2; it has no limiting stretch."""

    def energy(self, l1, l2):
        return first_invariant_minus_3(l1, l2) / 2

    def admissible(self, l1, l2):
        return (l1 > 0) & (l2 > 0)

    def lock_up_stretch(self, prestretch):
        return UNLIMITED_STRETCH * prestretch, False


# Taylor coefficients of the Langevin function L(b) = coth b − 1/b in odd powers of b
_LANGEVIN_SERIES = (
    1 / 3,
    -1 / 45,
    2 / 945,
    -1 / 4725,
    2 / 93555,
    -1382 / 638512875,
    4 / 18243225,
    -3617 / 162820783125,
    87734 / 38979295480125,
)


def _langevin_series(b):
    b2 = b * b
    return b * functools.reduce(lambda total, c: total * b2 + c, reversed(_LANGEVIN_SERIES))


def _langevin_slope(b):
    """L'(b) = 1/b² − 1/sinh² b, by its series where the difference would cancel."""
    small = jnp.abs(b) < 0.5
    b_large = jnp.where(small, 1.0, b)
    e = jnp.exp(-2 * b_large)  # 1/sinh² = 4 e^{-2b}/(1 − e^{-2b})²
    b_small = jnp.where(small, b, 0.0)
    series = jax.jvp(_langevin_series, (b_small,), (jnp.ones_like(b_small),))[1]
    return jnp.where(small, series, 1 / b_large**2 - 4 * e / (1 - e) ** 2)


def _langevin(b):
    small = jnp.abs(b) < 0.5
    b_large = jnp.where(small, 1.0, b)
    b_small = jnp.where(small, b, 0.0)
    return jnp.where(small, _langevin_series(b_small), 1 / jnp.tanh(b_large) - 1 / b_large)


@jax.custom_jvp
def inverse_langevin(x):
    """β with coth β − 1/β = x for 0 ≤ x < 1: a rational start, then Newton to rounding."""
    # start: Jedynak, Math. Mech. Solids 22 (2017) 1949, good to 0.1 %
    b = x * (3 - 1.00651 * x**2 - 0.962251 * x**4 + 1.47353 * x**6 - 0.48953 * x**8) / ((1 - x) * (1 + 1.01524 * x))
    for _ in range(3):
        b = b - (_langevin(b) - x) / _langevin_slope(b)
    return b


@inverse_langevin.defjvp
def _(primals, tangents):
    b = inverse_langevin(primals[0])
    return b, tangents[0] / _langevin_slope(b)


@jax.custom_jvp
def _chain_energy(x):
    """x β + log(β/sinh β) with β = L⁻¹(x); its derivative is β."""
    b = inverse_langevin(x)
    small = b < 1e-2
    b_safe = jnp.where(small, 1.0, b)
    log_ratio = jnp.log(2 * b_safe) - b_safe - jnp.log1p(-jnp.exp(-2 * b_safe))
    return x * b + jnp.where(small, -b * b / 6 + b**4 / 180, log_ratio)


@_chain_energy.defjvp
def _(primals, tangents):
    return _chain_energy(primals[0]), inverse_langevin(primals[0]) * tangents[0]


class ArrudaBoyce(AbstractMaterial):
    """Arruda and Boyce's eight-chain energy, W = n (ρ β + log(β/sinh β)), ρ² = (λ1² + λ2² + λ3²)/(3n).

    β is the exact inverse Langevin function of ρ and `chain_links` is n. The unit of W is the prefactor, the rubber
    modulus NkT. Source: Arruda and Boyce, J. Mech. Phys. Solids 41 (1993) 389.

    >>> s1 = stresses(ArrudaBoyce(chain_links=125.0), 2.0, 2.0, 0.0)[0]
    >>> round(float(s1), 6)
    1.994673
    """

    chain_links: Scalar = eqx.field(default=125.0, converter=as_scalar)

    def __check_init__(self):
        # the window ends at ρ = 0.995, and ρ² = 1/n where nothing is stretched
        if is_concrete(self.chain_links) and not LOCKED_CHAIN**-2 < float(self.chain_links) <= LARGEST_LIMIT:
            raise ValueError(
                f"`chain_links` must be above {LOCKED_CHAIN**-2:.5g}, so that an unstretched chain is below {LOCKED_CHAIN:g} of its "
                f"full length, and at most {LARGEST_LIMIT:g}, but is {float(self.chain_links)!r}."
            )

    def _extension(self, l1, l2):
        return jnp.sqrt((first_invariant_minus_3(l1, l2) + 3) / (3 * self.chain_links))

    def energy(self, l1, l2):
        x = self._extension(l1, l2)
        top = 1 - 1e-6
        x_safe = jnp.minimum(x, top)
        d = jnp.where(x > top, x - top, 0.0)
        beyond = d * inverse_langevin(top) + d * d / 2 / _langevin_slope(inverse_langevin(top))
        return self.chain_links * (_chain_energy(x_safe) + beyond)

    def admissible(self, l1, l2):
        return self._extension(l1, l2) < 1 - 1e-6

    def lock_up_stretch(self, prestretch):
        return _root_of_limit(3 * (float(self.chain_links) * LOCKED_CHAIN**2 - 1)), True


class CustomMaterial(AbstractMaterial):
    """A user's free energy: `function(l1, l2)` written with jax.numpy, elementwise; `largest_stretch` ends the window.

    The function is part of the compiled programs, and so are the numbers in it: constants that are to be swept, fitted or
    differentiated are fields of a subclass of `AbstractMaterial`, which says what is checked on construction.

    >>> mooney = CustomMaterial(lambda a, b: 0.45 * (a**2 + b**2 + 1/(a*b)**2 - 3)
    ...                         + 0.05 * (a**-2 + b**-2 + (a*b)**2 - 3), largest_stretch=8.0)
    >>> round(float(stresses(mooney, 2.0, 2.0, 0.0)[0]), 6)
    2.559375
    """

    function: Callable = eqx.field(static=True)
    largest_stretch: float = eqx.field(static=True)

    def __check_init__(self):
        if not callable(self.function):
            raise ValueError(f"`function` must be a function of two stretches, but is {self.function!r}.")
        if not (isinstance(self.largest_stretch, (int, float, np.number)) and 1 < self.largest_stretch < math.inf):
            raise ValueError(f"`largest_stretch` must be above 1 and finite, but is {self.largest_stretch!r}.")

    def energy(self, l1, l2):
        return self.function(l1, l2)

    def admissible(self, l1, l2):
        return jnp.isfinite(self.function(l1, l2))

    def lock_up_stretch(self, prestretch):
        return float(self.largest_stretch), False


@elementwise
def stresses(material: AbstractMaterial, l1, l2, q):
    """Nominal stresses and their slopes at fixed q: s1, s2, ∂s1/∂λ1, ∂s1/∂λ2.

    si = ∂w/∂λi with w = W(λ1, λ2) − q C(λ1, λ2)/2, the energy at fixed voltage, see `capacitance`; true stresses are
    λi si. Elementwise over arrays of one shape.
    """
    l1, l2 = jnp.broadcast_arrays(jnp.asarray(l1, float), jnp.asarray(l2, float))
    one, zero = jnp.ones_like(l1), jnp.zeros_like(l1)

    def slopes_of(energy):
        def gradient(l1, l2):
            return jax.vjp(energy, l1, l2)[1](one)

        return jax.jvp(gradient, (l1, l2), (one, zero))

    (w1, w2), (w11, w12) = slopes_of(material.energy)
    if isinstance(material, AbstractDielectric):
        (c1, c2), (c11, c12) = slopes_of(lambda l1, l2: capacitance(material, l1, l2))
        return w1 - q * c1 / 2, w2 - q * c2 / 2, w11 - q * c11 / 2, w12 - q * c12 / 2
    return w1 - q * l1 * l2**2, w2 - q * l1**2 * l2, w11 - q * l2**2, w12 - 2 * q * l1 * l2


@elementwise
def largest_load(material: AbstractMaterial, apex_stretch):
    """q_max(λa) = 2 W_1/C_1 at (λa, λa), at which the tension of the apex vanishes; W_1/λa³ where e = 1; elementwise."""
    a = jnp.asarray(apex_stretch, float)
    tension = stresses(material, a, a, 0.0)[0]
    if isinstance(material, AbstractDielectric):
        return tension / (tension - stresses(material, a, a, 1.0)[0])
    return tension / a**3


@elementwise
def energy_on(material: AbstractMaterial, l1, l2):
    """W(λ1, λ2) of a material, elementwise."""
    return material.energy(l1, l2)


@elementwise
def field_on(breakdown: "AbstractBreakdown", stretch):
    """E_EB(λ) of a breakdown law, elementwise."""
    return breakdown.field(stretch)


def check_scale(scale) -> None:
    """Refuses a breakdown field that is not multiplied by a positive number."""
    if is_concrete(scale):
        check_positive("breakdown_field_scale", float(scale))


class AbstractBreakdown(Readable):
    """The true electric field at which the dielectric fails, as a law of the stretch λ = √(λ1 λ2)."""

    @abc.abstractmethod
    def field(self, stretch: Elementwise) -> Elementwise:
        """E_EB(λ) in units of √(μ/ε), elementwise."""


class VHBBreakdown(AbstractBreakdown):
    """The fit of Koh et al. to VHB 4910: 30.6 λ^1.13 MV/m up to the plateau of 218 MV/m, made continuous (λ = 5.684).

    The law owns its unit √(μ/ε); `scale` multiplies the field. Source: eq. (8) of doi 10.1016/j.jmps.2012.09.006.

    >>> law = VHBBreakdown()
    >>> round(float(law.field(1.0)), 9), round(float(law.field(7.0)), 9)
    (0.930537452, 6.629319106)
    """

    scale: Scalar = eqx.field(default=1.0, converter=as_scalar)
    shear_modulus: Scalar = eqx.field(default=VHB_4910["inflation"]["shear_modulus"], converter=as_scalar)
    relative_permittivity: Scalar = eqx.field(default=4.7, converter=as_scalar)

    def __check_init__(self):
        for name in ("scale", "shear_modulus", "relative_permittivity"):
            if is_concrete(getattr(self, name)):
                check_positive(name if name != "scale" else "breakdown_field_scale", float(getattr(self, name)))

    def field(self, stretch):
        unit = jnp.sqrt(self.shear_modulus / (self.relative_permittivity * VACUUM_PERMITTIVITY))
        return self.scale * jnp.minimum(30.6e6 * stretch**1.13, 218e6) / unit


class ConstantBreakdown(AbstractBreakdown):
    """A breakdown field that does not depend on the stretch, in units of √(μ/ε); in V/m for `Scene.from_si`."""

    constant_field: Scalar = eqx.field(converter=as_scalar)
    scale: Scalar = eqx.field(default=1.0, converter=as_scalar)

    def __check_init__(self):
        if is_concrete(self.constant_field):
            check_positive("breakdown", float(self.constant_field))
        check_scale(self.scale)

    def field(self, stretch):
        return self.scale * self.constant_field * jnp.ones_like(stretch)


class CustomBreakdown(AbstractBreakdown):
    """A user's law: `function(stretch)` gives E_EB in units of √(μ/ε), elementwise, written with jax.numpy."""

    function: Callable = eqx.field(static=True)
    scale: Scalar = eqx.field(default=1.0, converter=as_scalar)

    def __check_init__(self):
        check_scale(self.scale)

    def field(self, stretch):
        return self.scale * self.function(stretch)


class MooneyRivlin(AbstractMaterial):
    """W = c1 (λ1² + λ2² + λ3² − 3) + c2 (λ1⁻² + λ2⁻² + λ3⁻² − 3), λ3 = 1/(λ1 λ2).

    c1 and c2 are in units of the shear modulus, which is 2(c1 + c2) = 1 where μ is that at small strain. Sources: Mooney,
    J. Appl. Phys. 11 (1940) 582; Rivlin, Phil. Trans. R. Soc. A 241 (1948) 379.

    >>> from dielectric_jax.model import stresses
    >>> s1 = stresses(MooneyRivlin(c1=0.45, c2=0.05), 2.0, 2.0, 0.0)[0]
    >>> round(float(s1), 6)
    2.559375
    """

    c1: Scalar = eqx.field(default=0.45, converter=as_scalar)
    c2: Scalar = eqx.field(default=0.05, converter=as_scalar)

    def __check_init__(self):
        for name in ("c1", "c2"):
            value = getattr(self, name)
            if is_concrete(value):
                check_positive(name, float(value), zero=True)
        if is_concrete(self.c1) and is_concrete(self.c2):
            if not float(self.c1) + float(self.c2) > 0:
                raise ValueError("`c1` or `c2` must be positive, but both are 0.0.")
            check_modulus("`c1` and `c2`", 2 * (float(self.c1) + float(self.c2)))

    def energy(self, l1, l2):
        a, b = jnp.maximum(l1, LEAST_STRETCH), jnp.maximum(l2, LEAST_STRETCH)
        second = a**-2 + b**-2 + (a * b) ** 2 - 3
        return self.c1 * first_invariant_minus_3(a, b) + self.c2 * second

    def admissible(self, l1, l2):
        return (l1 > LEAST_STRETCH) & (l2 > LEAST_STRETCH)

    def lock_up_stretch(self, prestretch):
        return UNLIMITED_STRETCH * prestretch, False


def _column(values, dimensions: int):
    """Scalars, or lanes of them, along a first axis, beside arrays of so many dimensions."""
    column = jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in values)))
    return column.reshape(len(values), *(1,) * (dimensions + 1 - column.ndim), *column.shape[1:])


def _terms(values) -> tuple:
    # a tuple may hold traced numbers, which NumPy must not read
    many = isinstance(values, (tuple, list)) or jnp.ndim(values) > 0
    return tuple(as_scalar(v) for v in values) if many else (as_scalar(values),)


class Ogden(AbstractMaterial):
    """W = Σ (μ_k/α_k) (λ1^α_k + λ2^α_k + λ3^α_k − 3), up to 100 terms.

    `moduli` are the μ_k in units of the shear modulus, `exponents` the α_k; the modulus at small strain is ½ Σ μ_k α_k,
    1 where μ is that. Source: Ogden, Proc. R. Soc. A 326 (1972) 565, whose three terms for rubber are the default, scaled so.

    >>> from dielectric_jax.model import stresses
    >>> s1 = stresses(Ogden(moduli=(0.9, -0.1), exponents=(2.0, -2.0)), 2.0, 2.0, 0.0)[0]
    >>> round(float(s1), 6)
    2.559375
    """

    # 6.3, 0.012 and −0.1 kg/cm² over their ½ Σ μ_k α_k
    moduli: tuple[Scalar, ...] = eqx.field(default=(6.3 / 4.225, 0.012 / 4.225, -0.1 / 4.225), converter=_terms)
    exponents: tuple[Scalar, ...] = eqx.field(default=(1.3, 5.0, -2.0), converter=_terms)

    def __check_init__(self):
        if len(self.moduli) != len(self.exponents) or not self.moduli:
            raise ValueError(
                f"`moduli` must be as many numbers as `exponents`, but are {len(self.moduli)} and {len(self.exponents)}."
            )
        if len(self.moduli) > MOST_TERMS:
            raise ValueError(f"`moduli` must be at most {MOST_TERMS} numbers, but are {len(self.moduli)}.")
        if not all(is_concrete(v) for v in (*self.moduli, *self.exponents)):
            return
        for name in ("moduli", "exponents"):
            values = np.asarray(getattr(self, name))
            most = LARGEST if name == "moduli" else LARGEST_EXPONENT
            wrong = ~(np.abs(values) <= most) | ((name == "exponents") & (np.abs(values) < 1 / LARGEST_EXPONENT))
            if wrong.any():
                allowed = f"at most {most:g}" if name == "moduli" else f"not zero, from {1 / most:g} to {most:g}"
                raise ValueError(
                    f"`{name}` must be finite and {allowed} in size, but one is {float(values[wrong][0])!r}."
                )
        modulus = float(np.dot(self.moduli, self.exponents)) / 2
        if not modulus > 0:
            raise ValueError(f"`moduli` must give a positive shear modulus ½ Σ μ_k α_k, but give {modulus!r}.")
        check_modulus("`moduli`", modulus)

    def energy(self, l1, l2):
        a, b = jnp.maximum(l1, LEAST_STRETCH), jnp.maximum(l2, LEAST_STRETCH)
        logs = jnp.log(a), jnp.log(b), -jnp.log(a) - jnp.log(b)

        def term(m, x):
            return m / x * sum(jnp.expm1(x * log) for log in logs)

        if len(self.moduli) <= UNROLLED_TERMS:
            return sum(map(term, self.moduli, self.exponents))
        m, x = (_column(values, jnp.ndim(logs[2])) for values in (self.moduli, self.exponents))
        return jnp.sum(term(m, x), axis=0)

    def admissible(self, l1, l2):
        return (l1 > LEAST_STRETCH) & (l2 > LEAST_STRETCH)

    def lock_up_stretch(self, prestretch):
        return UNLIMITED_STRETCH * prestretch, False


@elementwise
def _sound(material: AbstractDielectric, stretch):
    """Where e > 0 and C rises with equal-biaxial stretch, so that a voltage pulls the membrane wider."""
    rise = jax.jvp(lambda s: capacitance(material, s, s), (stretch,), (jnp.ones_like(stretch),))[1]
    return (material.permittivity(stretch, stretch) > 0) & (rise > 0)


class _Dielectric(AbstractDielectric):
    """What permittivities have in common: the elasticity of another material, and a window in which C rises."""

    elastic: eqx.AbstractVar[AbstractMaterial]

    def energy(self, l1, l2):
        return self.elastic.energy(l1, l2)

    def admissible(self, l1, l2):
        return self.elastic.admissible(l1, l2) & (self.permittivity(l1, l2) > 0)

    def lock_up_stretch(self, prestretch):
        limit, locks = self.elastic.lock_up_stretch(prestretch)
        stretch = np.linspace(1.0, limit, 1024)
        bad = np.flatnonzero(~_sound(self, stretch))
        if not len(bad):
            return limit, locks
        # the chart needs a load at which the apex goes slack: the window ends before C falls
        return float(stretch[max(bad[0] - 1, 0)]), False

    @abc.abstractmethod
    def permittivity(self, l1: Elementwise, l2: Elementwise) -> Elementwise:
        """e(λ1, λ2), 1 at λ1 = λ2 = 1 where ε is that of the unstretched material; elementwise."""


def _check_elastic(elastic) -> None:
    if not isinstance(elastic, AbstractMaterial) or isinstance(elastic, AbstractDielectric):
        raise ValueError(f"`elastic` must be a material without a permittivity of its own, but is {elastic!r}.")


class Electrostrictive(_Dielectric):
    """The elasticity of `elastic` with e = 1 + a (λ3 − 1) + b (λ1 + λ2 + λ3 − 3), λ3 = 1/(λ1 λ2).

    `thickness_coefficient` is a, `stretch_coefficient` is b. The window ends where e (λ1 λ2)² stops to rise with equal-biaxial
    stretch. Source: Zhao and Suo, J. Appl. Phys. 104 (2008) 123530.

    >>> rubber = Electrostrictive(Gent(), thickness_coefficient=0.1, stretch_coefficient=-0.01)
    >>> round(float(rubber.permittivity(2.0, 2.0)), 6)
    0.9125
    """

    elastic: AbstractMaterial = eqx.field(default_factory=Gent)
    thickness_coefficient: Scalar = eqx.field(default=0.0, converter=as_scalar)
    stretch_coefficient: Scalar = eqx.field(default=0.0, converter=as_scalar)

    def __check_init__(self):
        _check_elastic(self.elastic)
        for name in ("thickness_coefficient", "stretch_coefficient"):
            if is_concrete(value := getattr(self, name)) and not math.isfinite(value):
                raise ValueError(f"`{name}` must be finite, but is {float(value)!r}.")

    def permittivity(self, l1, l2):
        l3 = 1 / (l1 * l2)
        return 1 + self.thickness_coefficient * (l3 - 1) + self.stretch_coefficient * (l1 + l2 + l3 - 3)


class CustomPermittivity(_Dielectric):
    """The elasticity of `elastic` with a user's e(λ1, λ2): `function(l1, l2)` written with jax.numpy, elementwise, symmetric.

    e is about 1 at λ1 = λ2 = 1, where ε is that of the unstretched membrane. Raises ValueError where it is not.
    """

    elastic: AbstractMaterial
    function: Callable = eqx.field(static=True)

    def __check_init__(self):
        _check_elastic(self.elastic)
        if not callable(self.function):
            raise ValueError(f"`function` must be a function of two stretches, but is {self.function!r}.")
        if all(map(is_concrete, jax.tree.leaves(self.elastic))):
            check_permittivity(self, self.elastic.lock_up_stretch(1.0)[0])

    def permittivity(self, l1, l2):
        return self.function(l1, l2)
