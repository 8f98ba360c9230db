"""A film that flows: a spring beside Maxwell branches, each a spring in series with a Newtonian dashpot."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..numerics import Readable, check_positive
from .materials import AbstractDielectric, AbstractMaterial, Scalar, as_scalar, is_concrete
from .resolution import MOST_BRANCHES

__all__ = ["FLOW", "Maxwell", "Unrelaxed", "Viscoelastic", "spring_and_branches"]

#: of a Newtonian dashpot, dx/dt = FLOW T/τ with the true stresses T of its spring
FLOW = np.array([[1.0, -0.5], [-0.5, 1.0]]) / 3


class Maxwell(Readable):
    """A spring in series with a dashpot: g W_k(λ1/ξ1, λ2/ξ2), with ξ1, ξ2 the stretches of the dashpot.

    `modulus_ratio` g = μ_k/μ multiplies the energy W_k of the spring `material`; `relaxation_time` is τ = η/μ_k, in the unit
    of time in which protocols are written. With T_i = λe_i ∂W_k/∂λe_i and λe_i = λ_i/ξ_i the dashpot flows by

        d(ln ξ1)/dt = (T1 − T2/2)/(3τ),    d(ln ξ2)/dt = (T2 − T1/2)/(3τ).

    Raises ValueError for a number that is not positive and finite.

    >>> from dielectric_jax.model import Gent
    >>> Maxwell(Gent(55.0), modulus_ratio=0.5, relaxation_time=10.0).relaxation_time
    array(10.)
    """

    material: AbstractMaterial
    modulus_ratio: Scalar = eqx.field(converter=as_scalar)
    relaxation_time: Scalar = eqx.field(converter=as_scalar)

    def __check_init__(self):
        if not isinstance(self.material, AbstractMaterial) or isinstance(self.material, AbstractDielectric):
            raise ValueError(
                f"`material` of a Maxwell branch must be an elastic material such as Gent(), but is {self.material!r}."
            )
        for name in ("modulus_ratio", "relaxation_time"):
            if is_concrete(value := getattr(self, name)):
                check_positive(name, float(value), zero=name == "modulus_ratio")


def _as_tuple(branches: Iterable[Maxwell]) -> tuple[Maxwell, ...]:
    return tuple(branches)


class Viscoelastic(AbstractDielectric):
    """The `equilibrium` spring beside Maxwell `branches`: W(λ1, λ2) + Σ g_k W_k(λ1/ξ1k, λ2/ξ2k).

    At rest the branches carry nothing: all verbs that know no time answer for the `equilibrium` spring alone. `rates.follow`
    follows the membrane in time. Source: Hong, J. Mech. Phys. Solids 59 (2011) 637, doi 10.1016/j.jmps.2010.12.003.

    >>> from dielectric_jax.model import Gent
    >>> rubber = Viscoelastic(Gent(110.0), [Maxwell(Gent(55.0), modulus_ratio=2.33, relaxation_time=1.0)])
    >>> len(rubber.branches), float(rubber.energy(2.0, 2.0)) == float(Gent(110.0).energy(2.0, 2.0))
    (1, True)
    """

    equilibrium: AbstractMaterial
    branches: tuple[Maxwell, ...] = eqx.field(converter=_as_tuple)

    def __check_init__(self):
        if not isinstance(self.equilibrium, AbstractMaterial) or isinstance(self.equilibrium, Viscoelastic):
            raise ValueError(f"`equilibrium` must be an elastic material such as Gent(), but is {self.equilibrium!r}.")
        if len(self.branches) > MOST_BRANCHES:
            raise ValueError(f"`branches` must be at most {MOST_BRANCHES}, but are {len(self.branches)}.")
        for branch in self.branches:
            if not isinstance(branch, Maxwell):
                raise ValueError(f"`branches` must be Maxwell branches, but hold {branch!r}.")

    def energy(self, l1, l2):
        return self.equilibrium.energy(l1, l2)

    def admissible(self, l1, l2):
        return self.equilibrium.admissible(l1, l2)

    def lock_up_stretch(self, prestretch):
        return self.equilibrium.lock_up_stretch(prestretch)

    def permittivity(self, l1, l2):
        own = self.equilibrium
        return own.permittivity(l1, l2) if isinstance(own, AbstractDielectric) else jnp.ones_like(l1 * l2)


class Unrelaxed(AbstractDielectric):
    """A viscoelastic film whose dashpots have not moved: all springs side by side, W + Σ g_k W_k."""

    film: Viscoelastic

    def energy(self, l1, l2):
        branches = (b.modulus_ratio * b.material.energy(l1, l2) for b in self.film.branches)
        return sum(branches, self.film.energy(l1, l2))

    def admissible(self, l1, l2):
        fair = self.film.admissible(l1, l2)
        for branch in self.film.branches:
            fair = fair & branch.material.admissible(l1, l2)
        return fair

    def lock_up_stretch(self, prestretch):
        springs = (self.film, *(b.material for b in self.film.branches))
        return min(spring.lock_up_stretch(prestretch) for spring in springs)

    def permittivity(self, l1, l2):
        return self.film.permittivity(l1, l2)


def spring_and_branches(material: AbstractMaterial) -> tuple[AbstractMaterial, tuple[Maxwell, ...]]:
    """The equilibrium spring of a material, and its branches: none of an elastic one."""
    return (material.equilibrium, material.branches) if isinstance(material, Viscoelastic) else (material, ())
