"""One membrane: its equilibrium equations at any electrostatic load, the series at its apex, its identities.

Symbols: R radius of a point before deformation; r, z its place after; θ slope; l1 = λ1, l2 = λ2 = r/R stretches;
q = Φ² electrostatic load; p pressure. All functions are elementwise: scalars, or arrays of one shape.
Source: Li et al., doi 10.1016/j.jmps.2012.09.006, equations (10), (11), (13), (16), (17), (21), (22).
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import Readable, elementwise, reciprocal, sine_cosine
from .energies import require_float64
from .materials import (
    AbstractBreakdown,
    AbstractMaterial,
    ArrudaBoyce,
    Gent,
    NeoHookean,
    VHBBreakdown,
    field_on,
    largest_load,
    stresses,
)
from .resolution import LARGEST_PRESTRETCH, STIFF_PRESSURE, STIFF_SLOPE, STIFFENING_NODES
from .units import VHB_4910, Scalar, Units, as_scalar, is_concrete

__all__ = ["Membrane", "Profile", "vhb_4910"]


@functools.lru_cache(maxsize=512)
def _stiffening(tree, numbers: tuple, largest: float) -> float:
    """The largest stretch up to `largest` below which the equal-biaxial tension s of a material keeps its bounds."""
    material = jax.tree.unflatten(tree, numbers)
    low, high = 1.0, largest
    even = np.linspace(0.0, 1.0, STIFFENING_NODES + 1)[1:]
    for shares in (even**2, even, even, even):  # down to rounding
        stretch = low + (high - low) * shares
        tension, _, s11, s12 = map(np.asarray, stresses(material, stretch, stretch, 0.0))
        with np.errstate(all="ignore"):
            good = (tension > 0) & (2 * tension <= STIFF_PRESSURE * stretch**2)
            good &= (stretch - 1) * (s11 + s12) <= STIFF_SLOPE * tension
        if good.all():
            return high
        last = int(np.argmin(good))
        low, high = (stretch[last - 1] if last else low), stretch[last]
    return float(low)


def window_end(material: AbstractMaterial, prestretch: float) -> tuple[float, bool]:
    """The largest apex stretch of the default window, and whether it is a lock-up of the material.

    It is the material's own, or where the membrane has stiffened before: where the equal-biaxial tension s(λ) is lost, the
    pressure 2s/λ² of a balloon exceeds 100, or (λ − 1) s'/s exceeds 210, which no Gent film does before it locks.
    """
    largest, locks = material.lock_up_stretch(prestretch)
    if isinstance(material, (Gent, NeoHookean, ArrudaBoyce)):
        return largest, locks
    leaves, tree = jax.tree.flatten(material)
    end = _stiffening(tree, tuple(float(v) for v in leaves), float(largest))
    return (largest, locks) if end >= largest else (end, False)


class Membrane(Readable):
    """A circular membrane, clamped at R = 1 to r = `prestretch`.

    >>> Membrane(material=Gent(stretch_limit=270.0), prestretch=1.5).prestretch
    array(1.5)
    """

    material: AbstractMaterial = eqx.field(default_factory=Gent)
    prestretch: Scalar = eqx.field(default=1.0, converter=as_scalar)
    breakdown: AbstractBreakdown = eqx.field(default_factory=VHBBreakdown)

    def __check_init__(self):
        require_float64()
        if not isinstance(self.material, AbstractMaterial):
            raise ValueError(f"`material` must be a material such as Gent(), but is {self.material!r}.")
        if not isinstance(self.breakdown, AbstractBreakdown):
            raise ValueError(f"`breakdown` must be a breakdown law such as VHBBreakdown(), but is {self.breakdown!r}.")
        if is_concrete(self.prestretch):
            prestretch = float(self.prestretch)
            if not prestretch >= 1:
                raise ValueError(f"`prestretch` must be at least 1, but is {prestretch!r}.")
            if prestretch > LARGEST_PRESTRETCH:
                raise ValueError(f"`prestretch` must be at most {LARGEST_PRESTRETCH:g}, but is {prestretch!r}.")
            leaves = jax.tree.leaves(self.material)
            if all(is_concrete(leaf) for leaf in leaves):
                limit, _ = window_end(self.material, prestretch)
                if not prestretch < limit:
                    raise ValueError(
                        f"`prestretch` must be below the material's largest stretch {limit:.6g}, but is {prestretch!r}."
                    )

    def lock_up_stretch(self) -> tuple[float, bool]:
        """The largest apex stretch of the default window, and whether it is a lock-up."""
        return window_end(self.material, float(self.prestretch))

    def check_breaks_at_apex(self) -> None:
        """Refuses a breakdown law under which a place other than the apex may be the first to break.

        The apex has the largest λ1 λ2, and is the first where λ²/E_EB(λ) does not fall with λ in the window.
        """
        stretch = np.linspace(float(self.prestretch), self.lock_up_stretch()[0], 400)
        ratio = stretch**2 / field_on(self.breakdown, stretch)
        falls = np.flatnonzero(~(np.diff(ratio) >= -1e-12 * ratio[1:]))
        if falls.size:
            raise ValueError(
                "`breakdown` must be a law E_EB(λ) under which λ²/E_EB does not fall, so that the apex breaks first, "
                f"but at λ = {stretch[falls[0]]:.6g} it falls; `voltage_volume` looks at the whole membrane."
            )

    def largest_load(self, apex_stretch):
        """q_max(λa), see `materials.largest_load`."""
        return largest_load(self.material, apex_stretch)


def vhb_4910(
    fit: str = "inflation",
    *,
    model: str = "gent",
    prestretch: float = 1.0,
    thickness: float = 1e-3,
    radius: float = 22.5e-3,
) -> tuple[Membrane, Units]:
    """A membrane of VHB 4910 and its units, by one of the two fits of section 3 of the paper.

    Args:
        fit: "inflation" (μ = 45 kPa, J = 270, used in the paper's analyses) or "tension" (μ = 68 kPa, J = 372, n = 125).
        model: "gent", or for the tension fit also "arruda-boyce".
        prestretch: stretch of the rim.
        thickness: undeformed thickness H in m.
        radius: undeformed radius A in m.

    Raises:
        ValueError: for another fit or model.

    >>> membrane, units = vhb_4910("tension", model="arruda-boyce")
    >>> float(membrane.material.chain_links), float(units.shear_modulus)
    (125.0, 68000.0)
    """
    if fit not in VHB_4910:
        raise ValueError(f"`fit` must be one of {', '.join(VHB_4910)}, but is {fit!r}.")
    constants = VHB_4910[fit]
    materials = {"gent": (Gent, "stretch_limit"), "arruda-boyce": (ArrudaBoyce, "chain_links")}
    allowed = [name for name, (_, constant) in materials.items() if constant in constants]
    if model not in allowed:
        raise ValueError(f"`model` must be {' or '.join(allowed)} for the {fit} fit, but is {model!r}.")
    kind, constant = materials[model]
    units = Units(shear_modulus=constants["shear_modulus"], thickness=thickness, radius=radius)
    law = VHBBreakdown(shear_modulus=units.shear_modulus, relative_permittivity=units.relative_permittivity)
    return Membrane(kind(constants[constant]), prestretch, law), units


@jax.jit
def slopes(material: AbstractMaterial, radius, l1, l2, theta, pressure, q):
    """dλ1/dR (17), dλ2/dR = (λ1 cos θ − λ2)/R, dθ/dR (16)."""
    s1, s2, s11, s12 = stresses(material, l1, l2, q)
    sine, cosine = sine_cosine(theta)
    lean = l1 * cosine - l2
    per_radius = 1 / radius
    return (
        (s2 * cosine - s1 - s12 * lean) * reciprocal(s11) * per_radius,
        lean * per_radius,
        (pressure * l1 * l2 - s2 * sine * per_radius) / s1,
    )


@jax.jit
def apex_series(material: AbstractMaterial, apex_stretch, pressure, q):
    """λ1 = λa + a R², λ2 = λa + b R², θ = κ R near the apex: returns a, b, κ.

    With κ = p λa²/(2 s0): a − 3b = λa κ²/2 and a(3 s11 − s12) + b(3 s12 − s11) = −s0 κ²/2.
    """
    s0, _, s11, s12 = stresses(material, apex_stretch, apex_stretch, q)
    kappa = pressure * apex_stretch**2 / (2 * s0)
    kinematic, force = apex_stretch * kappa**2 / 2, -s0 * kappa**2 / 2
    of_a, of_b = 3 * s11 - s12, 3 * s12 - s11
    b = (force - of_a * kinematic) / (of_b + 3 * of_a)
    return kinematic + 3 * b, b, kappa


@elementwise
def field_ratio_squared(breakdown: AbstractBreakdown, l1, l2):
    """(E/E_EB)² per unit of q: (λ1 λ2 / E_EB(√(λ1 λ2)))²; elementwise."""
    area = l1 * l2
    return (area / breakdown.field(jnp.sqrt(area))) ** 2


@dataclasses.dataclass(frozen=True)
class Profile:
    """The membrane along its radius, arrays of shape (points,), dimensionless.

    `radius` is R; `r`, `z` the deformed place, z measured downward from the apex; `field` the true electric field
    (None where q < 0); stresses are true stresses.
    """

    radius: np.ndarray
    r: np.ndarray
    z: np.ndarray
    theta: np.ndarray
    stretch_1: np.ndarray
    stretch_2: np.ndarray
    stress_1: np.ndarray
    stress_2: np.ndarray
    field: np.ndarray | None
    breakdown_ratio: np.ndarray | None
    pressure: float
    voltage_squared: float

    def first_integral_defect(self) -> np.ndarray:
        """R s1 sin θ − p r²/2, zero at every R in equilibrium (13)."""
        s1 = self.stress_1 / self.stretch_1
        return self.radius * s1 * np.sin(self.theta) - self.pressure * self.r**2 / 2
