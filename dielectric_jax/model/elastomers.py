"""More materials: Mooney–Rivlin, Ogden, and permittivities that depend on stretch.

As in `materials` a material is its energy W(λ1, λ2) in units of the shear modulus, and stresses come from autodiff of it.
A dielectric whose permittivity is ε e(λ1, λ2) stores, at fixed voltage, w = W − q C/2 with the capacitance
C = e (λ1 λ2)² per reference area in units of ε/H: stresses are the derivatives of that w at fixed q, and the charge
is Q = 2πΦ ∫ C R dR. e = 1 is the ideal dielectric.
"""

import abc
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import LARGEST, check_positive, elementwise
from .energies import check_modulus, check_permittivity
from .materials import (
    AbstractDielectric,
    AbstractMaterial,
    Elementwise,
    Gent,
    capacitance,
    first_invariant_minus_3,
)
from .units import Scalar, as_scalar, is_concrete

__all__ = ["CustomPermittivity", "Electrostrictive", "MooneyRivlin", "Ogden"]

# terms of Ogden's energy that are summed one by one, as runs fastest; the compile time of more would grow with their number
_UNROLLED = 6
_MOST_TERMS = 100
_LARGEST_EXPONENT = 1e3
_LEAST = 1e-2  # stretches below are not met by a membrane in tension; the powers stay finite


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
        a, b = jnp.maximum(l1, _LEAST), jnp.maximum(l2, _LEAST)
        second = a**-2 + b**-2 + (a * b) ** 2 - 3
        return self.c1 * first_invariant_minus_3(a, b) + self.c2 * second

    def admissible(self, l1, l2):
        return (l1 > _LEAST) & (l2 > _LEAST)

    def lock_up_stretch(self, prestretch):
        return 12 * prestretch, False


def _column(values, dimensions: int):
    """Scalars, or lanes of them, along a first axis, beside arrays of so many dimensions."""
    column = jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(v, float) for v in values)))
    return column.reshape(len(values), *(1,) * (dimensions + 1 - column.ndim), *column.shape[1:])


def _terms(values) -> tuple:
    return tuple(as_scalar(v) for v in values) if np.ndim(values) else (as_scalar(values),)


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
        if len(self.moduli) > _MOST_TERMS:
            raise ValueError(f"`moduli` must be at most {_MOST_TERMS} numbers, but are {len(self.moduli)}.")
        if not all(is_concrete(v) for v in (*self.moduli, *self.exponents)):
            return
        for name in ("moduli", "exponents"):
            values = np.asarray(getattr(self, name))
            most = LARGEST if name == "moduli" else _LARGEST_EXPONENT
            wrong = ~(np.abs(values) <= most) | ((name == "exponents") & (np.abs(values) < 1 / _LARGEST_EXPONENT))
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
        a, b = jnp.maximum(l1, _LEAST), jnp.maximum(l2, _LEAST)
        logs = jnp.log(a), jnp.log(b), -jnp.log(a) - jnp.log(b)

        def term(m, x):
            return m / x * sum(jnp.expm1(x * log) for log in logs)

        if len(self.moduli) <= _UNROLLED:
            return sum(map(term, self.moduli, self.exponents))
        m, x = (_column(values, jnp.ndim(logs[2])) for values in (self.moduli, self.exponents))
        return jnp.sum(term(m, x), axis=0)

    def admissible(self, l1, l2):
        return (l1 > _LEAST) & (l2 > _LEAST)

    def lock_up_stretch(self, prestretch):
        return 12 * prestretch, False


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
