"""The shape and the fields along the membrane of one state, computed only when asked for."""

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import make_interp_spline

from ..numerics import cached_jit
from .materials import capacitance, energy_on, field_on, stresses
from .membrane import Membrane, Profile
from .records import State
from .shooting import integrate_membrane

__all__ = ["energy", "profile", "scaling_defect"]


@cached_jit
def _profile_program(membrane, apex, pressure, q, steps):
    shot = integrate_membrane(membrane.material, apex, pressure, q, steps, outputs=True, trail="profile", heights=True)
    times, values, along = shot.trail
    radius, _, l1, l2, theta = along.rows(times, values[:, :3])
    s1, s2, _, _ = stresses(membrane.material, l1, l2, q)
    area = l1 * l2
    return (
        jnp.isfinite(times),
        radius,
        l1,
        l2,
        theta,
        values[:, 3],
        l1 * s1,
        l2 * s2,
        membrane.breakdown.field(jnp.sqrt(area)),
    )


def profile(membrane: Membrane, state: State, *, steps: int = 192) -> Profile:
    """Shape, stretches, true stresses, true field and E/E_EB along the radius of an equilibrium.

    `steps` + 2 points: the apex, and every step of the integration; crowded where the apex is sharp.

    >>> from dielectric_jax import equilibrium
    >>> membrane = Membrane()
    >>> shape = profile(membrane, equilibrium(membrane, volume=2.42))
    >>> float(shape.r[-1].round(9)), bool(abs(shape.first_integral_defect()).max() < 1e-11)
    (1.0, True)
    """
    apex, p, q = state.apex_stretch, state.pressure, state.voltage_squared
    if p == 0:
        radius = np.linspace(0.0, 1.0, steps + 2)
        flat = np.ones_like(radius)
        zero = np.zeros_like(radius)
        s1, s2 = (apex * float(s) * flat for s in stresses(membrane.material, apex, apex, q)[:2])
        limit = float(field_on(membrane.breakdown, apex)) * flat
        columns = [radius, apex * flat, apex * flat, zero, zero, s1, s2, limit]
    else:
        done, *rest = (np.asarray(v) for v in _profile_program(membrane, apex, p, q, float(steps)))
        columns = [v[done] for v in rest]
        s0 = apex * float(stresses(membrane.material, apex, apex, q)[0])
        at_apex = [0.0, apex, apex, 0.0, 0.0, s0, s0, float(field_on(membrane.breakdown, apex))]
        columns = [np.concatenate([[a], v]) for a, v in zip(at_apex, columns, strict=True)]
    radius, l1, l2, theta, z, s1, s2, limit = columns
    field = np.sqrt(q) * l1 * l2 if q >= 0 else None
    return Profile(
        radius=radius,
        r=radius * l2,
        z=z,
        theta=theta,
        stretch_1=l1,
        stretch_2=l2,
        stress_1=s1,
        stress_2=s2,
        field=field,
        breakdown_ratio=None if field is None else field / limit,
        pressure=p,
        voltage_squared=q,
    )


def _energy_density(membrane: Membrane, shape: Profile) -> np.ndarray:
    """w = W − q C/2 along the membrane."""
    l1, l2 = shape.stretch_1, shape.stretch_2
    return energy_on(membrane.material, l1, l2) - shape.voltage_squared * capacitance(membrane.material, l1, l2) / 2


def energy(membrane: Membrane, shape: Profile) -> float:
    """U = 2π ∫ R w dR, the energy at fixed voltage; along equilibria dU = p dV at fixed Φ and ∂U/∂Φ|V = −Q."""
    return 2 * np.pi * _integral(shape.radius, shape.radius * _energy_density(membrane, shape))


def _integral(radius: np.ndarray, values: np.ndarray) -> float:
    return float(make_interp_spline(radius, values, k=5).integrate(0.0, 1.0))


def scaling_defect(membrane: Membrane, shape: Profile) -> float:
    """Defect of the scaling identity at R = 1, zero in equilibrium.

    w − p r² z'/2 + (r − r') s1 cos θ = ∫ (2R w − (3/2) p r² z') dR, primes d/dR, s1 the nominal stress.
    """
    w = _energy_density(membrane, shape)
    sine, cosine = np.sin(shape.theta), np.cos(shape.theta)
    l1, r, p = shape.stretch_1, shape.r, shape.pressure
    left = w[-1] - p * r[-1] ** 2 * l1[-1] * sine[-1] / 2
    left += (r[-1] - l1[-1] * cosine[-1]) * shape.stress_1[-1] / l1[-1] * cosine[-1]
    return float(left - _integral(shape.radius, 2 * shape.radius * w - 1.5 * p * r**2 * l1 * sine))
