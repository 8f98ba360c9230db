"""Pictures of modes: the balloon deformed by one, and eigenvalues over the circumferential number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import Profile
from .drawing import labelled, mathtext, new_axes, new_figure, sequence, voltage_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_mode", "plot_spectra"]

_AROUND = 181


def plot_mode(profile: Profile, shape: Any, *, amplitude: float = 0.15, ax: Axes | None = None) -> Axes:
    """Draws the balloon deformed by a mode, in three dimensions, coloured by the displacement along its normal.

    Args:
        profile: the `Profile` of the state, dimensionless.
        shape: a `ModeShape` of its spectrum, `spectrum.shape(n)`.
        amplitude: the largest displacement, of the balloon's largest radius.
        ax: three-dimensional axes to draw on; new ones when None.

    Returns:
        The axes.

    >>> import dielectric_jax as dj
    >>> film = dj.Membrane()
    >>> state = dj.equilibrium(film, pressure=1.0)
    >>> spectrum = dj.mode_spectrum(film, state, numbers=[2], count=1)
    >>> plot_mode(dj.profile(film, state), spectrum.shape(2)).get_title()
    '$n$ = 2, $Λ$ = 14'
    """
    if not 0 < amplitude <= 1:
        raise ValueError(f"`amplitude` must lie between 0 and 1, but is {amplitude!r}.")
    import matplotlib

    ax = new_figure(5.0).add_subplot(projection="3d") if ax is None else ax
    along, down = (np.interp(shape.radius, profile.radius, v) for v in (profile.r, profile.z))
    theta = np.interp(shape.radius, profile.radius, profile.theta)
    size = max(np.abs(v).max() for v in (shape.radial, shape.hoop, shape.vertical))
    u, v, w = (amplitude * profile.r.max() / size * f[:, None] for f in (shape.radial, shape.hoop, shape.vertical))
    angle = np.linspace(0.0, 2 * np.pi, _AROUND)
    cosine, sine = np.cos(shape.number * angle), np.sin(shape.number * angle)
    outward, around, height = along[:, None] + u * cosine, v * sine, down[:, None] + w * cosine
    x = outward * np.cos(angle) - around * np.sin(angle)
    y = outward * np.sin(angle) + around * np.cos(angle)
    normal = (np.sin(theta)[:, None] * u - np.cos(theta)[:, None] * w) * cosine
    largest = max(float(np.abs(normal).max()), 1e-300)
    colours = matplotlib.colormaps["RdBu_r"]((normal / largest + 1) / 2)
    surface: Any = ax
    surface.plot_surface(
        x, y, height.max() - height, facecolors=colours, rstride=2, cstride=2, linewidth=0, antialiased=False
    )
    surface.set_aspect("equal")
    surface.set_axis_off()
    ax.set_title(f"{mathtext('n')} = {shape.number}, {mathtext('Λ')} = {shape.eigenvalue:.4g}")
    return ax


def plot_spectra(spectra: Any, *, labels: Sequence[str] = (), ax: Axes | None = None) -> Axes:
    """Draws the lowest eigenvalue over the circumferential number, of one `ModeSpectrum` or of several.

    A filled mark is a stable mode, an open one lowers the energy. `labels` name the spectra, by default by their voltage.
    """
    ax = new_axes(ax)
    many = list(spectra) if isinstance(spectra, Sequence) else [spectra]
    names = list(labels) or [voltage_label(s.state.voltage) for s in many]
    for spectrum, name, colour in zip(many, names, sequence(len(many)), strict=True):
        values, numbers = spectrum.eigenvalues[:, 0], np.asarray(spectrum.numbers)
        ax.plot(numbers, values, "-", linewidth=1.0, color=colour, label=name)
        for own, fill in ((values >= 0, colour), (values < 0, "white")):
            ax.plot(numbers[own], values[own], "o", color=colour, markerfacecolor=fill, markersize=4)
    ax.axhline(0.0, color="0.5", linewidth=0.8)
    ax.set_yscale("symlog", linthresh=1.0)
    ax.set_xlabel(labelled("circumferential number", "n"))
    ax.set_ylabel(labelled("lowest eigenvalue", "Λ", "μ/(ρA²)"))
    ax.legend(frameon=False)
    return ax
