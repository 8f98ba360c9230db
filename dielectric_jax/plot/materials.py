"""A one-page summary of a material: its curves in tension, as a balloon, and as a dielectric."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..model import AbstractBreakdown, AbstractMaterial, VHBBreakdown, field_on, largest_load, stresses, window_end
from .drawing import COLOURS, axis_label, labelled, mathtext, new_figure, voltage_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["balloon_pressure", "plot_material", "tension_curves"]

_BISECTIONS = 60  # of the width between λ1⁻¹ and 1: more than a double's 53 bits


def _free_width(material: AbstractMaterial, stretch: np.ndarray) -> np.ndarray:
    """λ2 at which s2 vanishes, for each λ1 ≥ 1, by bisection between λ1⁻¹ and 1, where s2 rises with λ2."""
    low, high = 1 / stretch, np.ones_like(stretch)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        pulled = np.asarray(stresses(material, stretch, middle, 0.0)[1]) > 0
        low, high = np.where(pulled, low, middle), np.where(pulled, middle, high)
    return (low + high) / 2


def tension_curves(material: AbstractMaterial, stretch: ArrayLike) -> dict[str, np.ndarray]:
    """Nominal stresses s1 at Φ = 0 against λ1, in units of μ.

    Args:
        material: the free energy.
        stretch: λ1 ≥ 1, shape (n,).

    Returns:
        "uniaxial" (λ2 with s2 = 0), "pure shear" (λ2 = 1) and "equal-biaxial" (λ2 = λ1), each of shape (n,); NaN beyond the
        material's limits.

    >>> from dielectric_jax import NeoHookean
    >>> curves = tension_curves(NeoHookean(), [2.0])  # λ − λ⁻², λ − λ⁻³, λ − λ⁻⁵
    >>> [round(float(curves[name][0]), 6) for name in ("uniaxial", "pure shear", "equal-biaxial")]
    [1.75, 1.875, 1.96875]
    """
    stretch = np.asarray(stretch, float)
    widths = {"uniaxial": _free_width(material, stretch), "pure shear": np.ones_like(stretch), "equal-biaxial": stretch}
    out = {}
    for name, width in widths.items():
        inside = np.asarray(material.admissible(stretch, width))
        out[name] = np.where(inside, np.asarray(stresses(material, stretch, width, 0.0)[0]), np.nan)
    return out


def balloon_pressure(material: AbstractMaterial, stretch, voltage: float = 0.0) -> np.ndarray:
    """p R0/(μH) = 2 s1(λ, λ)/λ² of a spherical balloon of undeformed radius R0, shape of `stretch`.

    >>> from dielectric_jax import NeoHookean
    >>> round(float(balloon_pressure(NeoHookean(), 7 ** (1 / 6))), 6)
    1.239463
    """
    stretch = np.asarray(stretch, float)
    return 2 * np.asarray(stresses(material, stretch, stretch, voltage**2)[0]) / stretch**2


def plot_material(
    material: AbstractMaterial,
    *,
    breakdown: AbstractBreakdown | None = None,
    units: Any = None,
    largest_stretch: float | None = None,
    figure: Figure | None = None,
) -> Figure:
    """Draws four panels: tension, the spherical balloon, the free film under voltage, and the energy of in-plane stretches.

    The panel of the film shows the voltage that holds it at an equal-biaxial stretch, and the voltage at which it breaks down.

    Args:
        material: the free energy.
        breakdown: the law of the breakdown field; `VHBBreakdown()` when None, in these units if they are given.
        units: the `Units` to draw in (kPa, kV); dimensionless when None.
        largest_stretch: where the curves end; 95 % of the window's default end when None.
        figure: the figure to draw on; a new one when None.

    Returns:
        The figure.
    """
    if breakdown is None:
        constants = () if units is None else (1.0, units.shear_modulus, units.relative_permittivity)
        breakdown = VHBBreakdown(*constants)
    end = 0.95 * window_end(material, 1.0)[0] if largest_stretch is None else largest_stretch
    stretch = 1 + (end - 1) * np.linspace(0.0, 1.0, 500)[1:] ** 2  # denser where balloon and film begin
    figure = new_figure(11.0, 8.4) if figure is None else figure
    panels: Any = figure.subplots(2, 2)
    stress, volt = (1.0, 1.0) if units is None else (units.read(1.0, "stress"), units.read(1.0, "voltage"))
    tension, balloon, film, energy = panels.ravel()
    for (name, values), colour in zip(tension_curves(material, stretch).items(), COLOURS, strict=False):
        tension.plot(stretch, stress * values, "--" if name == "pure shear" else "-", color=colour, label=name)
    tension.set(xlabel=labelled("stretch", "λ₁"), ylabel=axis_label("nominal_stress", units))
    tension.legend(frameon=False)
    for voltage, colour in zip((0.0, 0.1, 0.2), COLOURS, strict=False):
        words = voltage_label(volt * voltage, units)
        balloon.plot(stretch, balloon_pressure(material, stretch, voltage), color=colour, label=words)
    balloon.set(xlabel=f"Stretch {mathtext('λ')} of a spherical balloon", ylabel=labelled("pressure", "p", "μH/R₀"))
    balloon.set_ylim(bottom=0)
    balloon.legend(frameon=False)
    held = np.sqrt(np.maximum(largest_load(material, stretch), 0))
    broken = field_on(breakdown, stretch) / stretch**2
    film.plot(stretch, volt * held, color=COLOURS[0], label="equilibrium of a free film")
    film.plot(stretch, volt * broken, "--", color=COLOURS[5], label="breakdown")
    film.set(xlabel=f"Stretch {mathtext('λ')} (equal-biaxial)", ylabel=axis_label("voltage", units))
    film.set_ylim(0, 1.3 * volt * float(held.max()))
    film.legend(frameon=False)
    _energy_panel(energy, material, end)
    return figure


def _energy_panel(ax: Any, material: AbstractMaterial, end: float) -> None:
    """Draws contours of log W over the two stretches, blank beyond the material's limits."""
    axis = np.linspace(0.5, end, 160)
    one, other = np.meshgrid(axis, axis)
    values = np.asarray(material.energy(one, other))
    inside = np.asarray(material.admissible(one, other)) & (values > 0)
    logs = np.where(inside, np.log10(np.where(inside, values, 1.0)), np.nan)
    filled = ax.contourf(one, other, logs, levels=14, cmap="cividis")
    ax.figure.colorbar(filled, ax=ax, label=r"$\log_{10}(W/μ)$")
    ax.set(xlabel=labelled("stretch", "λ₁"), ylabel=labelled("stretch", "λ₂"), aspect="equal")
