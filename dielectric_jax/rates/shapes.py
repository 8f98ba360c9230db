"""The shape of the membrane at an instant of a run, along its radius."""

import functools
import typing

import jax.numpy as jnp
import numpy as np
from numpy.polynomial import legendre

from ..model import Membrane, Profile, field_on, spring_and_branches
from .balance import Shape, grid_of, log_stress
from .resolution import CROWDING, PROFILE_POINTS

__all__ = ["profile_of"]


class _Reading(typing.NamedTuple):
    """Points `radius` (P,), and the matrices (P, G) that give values and ∫ ds from the apex there, of values at Gauss points."""

    radius: np.ndarray
    values: np.ndarray
    integral: np.ndarray


@functools.cache
def _reading(functions: int, points: int) -> _Reading:
    grid = grid_of(functions, points)
    radius = np.linspace(0.0, 1.0, PROFILE_POINTS)
    place = 2 * np.log1p(radius**2 * np.expm1(CROWDING)) / CROWDING - 1  # of the coordinate from −1 to 1
    nodes, weights = legendre.leggauss(points)
    orders = np.arange(points)
    # coefficients in Legendre polynomials of the interpolant, the polynomials, and their integrals from −1
    coefficients = (orders + 0.5)[:, None] * (legendre.legvander(nodes, points - 1) * weights[:, None]).T
    values = legendre.legvander(place, points - 1) @ coefficients
    integrals = np.stack([legendre.legval(place, legendre.legint(row, lbnd=-1)) for row in np.eye(points)], axis=1)
    return _Reading(radius, values, integrals @ coefficients * (grid.weights / weights))


def profile_of(membrane: Membrane, shape: Shape, x: typing.Any, load: float) -> Profile:
    """The profile of a balanced shape with dashpots x (K, 2, G) at the load q: true stresses are those of spring and branches."""
    spring, branches = spring_and_branches(membrane.material)
    mesh = len(shape.coefficients), len(shape.slope)
    grid, (radius, look, integral) = grid_of(*mesh), _reading(*mesh)
    a, b = (look @ (float(membrane.prestretch) + f @ shape.coefficients) for f in grid.functions)
    slope = look @ np.asarray(shape.slope)
    l1 = np.sqrt(b**2 + (2 * radius * slope) ** 2)
    logs = jnp.log(jnp.stack([l1, a]))
    stress = log_stress(spring, logs, load)[0]
    for branch, own in zip(branches, x, strict=True):
        stress += branch.modulus_ratio * log_stress(branch.material, logs - np.asarray(own) @ look.T, 0.0)[0]
    field = np.sqrt(max(load, 0.0)) * l1 * a
    limit = np.asarray(field_on(membrane.breakdown, np.sqrt(l1 * a)))
    return Profile(
        radius=radius,
        r=radius * a,
        z=integral @ np.asarray(shape.slope),
        theta=np.arctan2(2 * radius * slope, b),
        stretch_1=l1,
        stretch_2=a,
        stress_1=np.asarray(stress[0]),
        stress_2=np.asarray(stress[1]),
        field=field,
        breakdown_ratio=field / limit,
        pressure=float(shape.pressure),
        voltage_squared=load,
    )
