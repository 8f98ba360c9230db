"""Pictures of single states: the cross-section of the balloon, and quantities along its radius."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import Profile
from .drawing import axis_label, new_axes, sequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["add_colour_bar", "breakdown_latitudes", "plot_cross_section", "plot_distribution"]

_LATITUDE = "#D55E00"
_DASHES = ("-", (0, (5, 1.5)), (0, (2, 1.2)), (0, (6, 1.5, 1.5, 1.5)))


def breakdown_latitudes(profile: Profile) -> list[float]:
    """The undeformed radii at which E = E_EB, by linear interpolation; empty if the field stays on one side of it.

    >>> from dielectric_jax import Membrane, equilibrium, profile
    >>> membrane = Membrane()
    >>> breakdown_latitudes(profile(membrane, equilibrium(membrane, volume=2.42, voltage=0.05)))
    []
    """
    ratio = profile.breakdown_ratio
    if ratio is None:
        return []
    over = ratio >= 1
    return [
        float(np.interp(1.0, np.sort(ratio[i : i + 2]), profile.radius[i : i + 2][np.argsort(ratio[i : i + 2])]))
        for i in np.flatnonzero(over[1:] != over[:-1])
    ]


def plot_cross_section(
    profile: Profile,
    *,
    ax: Axes | None = None,
    units: Any = None,
    colour_by: str | None = "breakdown_ratio",
    limits: tuple[float, float] | None = None,
    colourbar: bool = True,
    reference: bool = True,
    dimensions: bool = True,
) -> Axes:
    """Draws the cross-section of a balloon, coloured by a quantity, with its undeformed and its prestretched shape.

    A dashed line marks the latitude above (or below) which the field exceeds the breakdown field.

    Args:
        profile: a `Profile`, dimensionless.
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in (mm, MV/m, kPa); dimensionless when None.
        colour_by: a quantity of the profile such as "breakdown_ratio", "field", "stretch_1" or "stress_1"; None for a plain
            line. The first two need a voltage; a state without one is drawn as a plain line.
        limits: smallest and largest value of the colours; those of the profile when None.
        colourbar: whether to add a colour bar.
        reference: whether to draw the undeformed film, and the prestretched one.
        dimensions: whether to write the height and the largest width.

    Returns:
        The axes.

    Raises:
        ValueError: for a quantity that a profile does not have.
    """
    from matplotlib.collections import LineCollection

    shown = profile if units is None else units.read(profile)
    height = shown.z[-1] - shown.z
    ax = new_axes(ax, 5.2)
    values = None if colour_by is None else _quantity(shown, colour_by)
    across = np.concatenate([-shown.r[::-1], shown.r[1:]])
    up = np.concatenate([height[::-1], height[1:]])
    if values is None or (profile.voltage_squared == 0 and colour_by in ("field", "breakdown_ratio")):
        ax.plot(across, up, color="0.25", linewidth=2.5, solid_capstyle="round")
    else:
        middle = (values[1:] + values[:-1]) / 2
        points = np.stack([across, up], axis=1)
        segments = np.stack([points[:-1], points[1:]], axis=1)
        low, high = limits or (float(values.min()), float(values.max()))
        lines = LineCollection(list(segments), cmap="cividis", linewidth=4, capstyle="round")
        lines.set_array(np.concatenate([middle[::-1], middle]))
        lines.set_clim(low, high)
        ax.add_collection(lines)
        if colourbar:
            add_colour_bar(ax, str(colour_by), units, shrink=0.8)
    width, top = float(shown.r.max()), float(height.max())
    for latitude in breakdown_latitudes(profile):
        r, h = (float(np.interp(latitude, profile.radius, v)) for v in (shown.r, height))
        ax.plot([-1.15 * r - 0.1 * width, 1.15 * r + 0.1 * width], [h, h], "--", color=_LATITUDE, linewidth=1.4)
    if reference:
        one = 1.0 if units is None else units.read(1.0, "r")
        ax.plot([-one, one], [0, 0], color="0.6", linewidth=3, solid_capstyle="butt", zorder=1)
        if shown.r[-1] > one * (1 + 1e-9):
            ax.plot([-shown.r[-1], shown.r[-1]], [0, 0], color="0.6", linewidth=1, zorder=1)
    ax.set_xlabel(axis_label("r", units))
    ax.set_ylabel(axis_label("height", units))
    ax.set_aspect("equal")
    room = 0.08 * max(2 * width, top)
    ax.set_xlim(-width - 2 * room, width + 2 * room)
    ax.set_ylim(-room, top + 2 * room)
    if dimensions:
        _dimensions(ax, shown, height, room, "" if units is None else f" {units.read_name('r')}")
    return ax


def _dimensions(ax: Axes, shown: Profile, height: np.ndarray, room: float, unit: str) -> None:
    """Writes the height beside the axis, and the width at the widest point."""
    style = {"arrowstyle": "<->", "color": "0.35", "linewidth": 1, "shrinkA": 0, "shrinkB": 0}
    words: dict[str, Any] = {"fontsize": "small", "color": "0.2"}
    top, widest = float(height.max()), int(np.argmax(shown.r))
    r, level = float(shown.r[widest]), float(height[widest])
    if top > 0:
        ax.annotate("", xy=(0, top), xytext=(0, 0), arrowprops=style)
        ax.text(0.15 * room, 0.55 * top if abs(level - 0.55 * top) > room else 0.75 * top, f"{top:.3g}{unit}", **words)
    ax.annotate("", xy=(r, level), xytext=(-r, level), arrowprops=style)
    ax.text(-0.95 * r, level + 0.15 * room, f"{2 * r:.3g}{unit}", va="bottom", **words)


def add_colour_bar(ax: Axes, name: str, units: Any = None, *, beside: Any = None, **place: Any) -> Any:
    """Adds the colour bar of a cross-section, with a line at E/E_EB = 1 in the colour of the latitude of breakdown; returns it.

    Args:
        ax: the axes of the cross-section.
        name: the quantity that the colours show.
        units: the units of the label.
        beside: the axes whose space it takes; `ax` when None.
        place: options of matplotlib's `colorbar`.
    """
    (lines,) = ax.collections
    bar = ax.figure.colorbar(lines, ax=ax if beside is None else beside, label=axis_label(name, units), **place)
    low, high = lines.get_clim()
    if name == "breakdown_ratio" and low < 1 < high:
        bar.ax.axhline(1.0, color=_LATITUDE, linewidth=2.0)
    return bar


def plot_distribution(
    profiles: Profile | Sequence[Profile],
    quantity: str | Sequence[str] = ("stretch_1", "stretch_2"),
    *,
    ax: Axes | None = None,
    units: Any = None,
    labels: Sequence[str] | None = None,
    legend: bool = True,
) -> Axes:
    """Draws quantities along the undeformed radius R: one colour for each profile, one line style for each quantity.

    Args:
        profiles: one `Profile` or several, dimensionless.
        quantity: "stretch_1", "stretch_2", "stress_1", "stress_2", "field", "breakdown_ratio", "r", "z", or several of one kind.
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in; dimensionless when None.
        labels: names of the profiles in the legend.
        legend: whether to add a legend if there is more than one line.

    Returns:
        The axes.

    Raises:
        ValueError: for a quantity that a profile does not have, or labels that do not match.
    """
    profiles = [profiles] if isinstance(profiles, Profile) else list(profiles)
    names = [quantity] if isinstance(quantity, str) else list(quantity)
    if labels is not None and len(labels) != len(profiles):
        raise ValueError(f"`labels` must be one for each of {len(profiles)} profiles, but are {len(labels)}.")
    ax = new_axes(ax, 5.2)
    for number, (profile, colour) in enumerate(zip(profiles, sequence(len(profiles)), strict=True)):
        shown = profile if units is None else units.read(profile)
        for name, dash in zip(names, _DASHES, strict=False):
            values = _quantity(shown, name)
            if values is None:
                continue
            words = [] if labels is None else [labels[number]]
            words += [axis_label(name, units).split(" / ")[0]] if len(names) > 1 else []
            ax.plot(shown.radius, values, color=colour, linestyle=dash, linewidth=1.6, label=", ".join(words))
    ax.set_xlabel(axis_label("radius", units))
    kinds = {name.partition("_")[0] for name in names}
    ax.set_ylabel(axis_label(names[0] if len(names) == 1 else kinds.pop(), units))
    ax.set_xlim(0, None)
    if legend and (len(names) > 1 or labels is not None):
        ax.legend(frameon=False, fontsize="small")
    return ax


def _quantity(profile: Profile, name: str) -> np.ndarray | None:
    known = [n for n, v in vars(profile).items() if isinstance(v, np.ndarray) or n in ("field", "breakdown_ratio")]
    if name not in known:
        raise ValueError(f"`quantity` must be one of {', '.join(known)}, but is {name!r}.")
    return getattr(profile, name)
