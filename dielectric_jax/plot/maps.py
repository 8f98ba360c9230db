"""Figures over two parameters: regime maps with exact curves between regimes, and curves of folds and breakdown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import REGIME_COLOURS, PointKind, Regime
from .drawing import axis_label, new_axes, parameter_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_fold_curves", "plot_regime_map"]

_LEAST_SHARE = 0.01  # fraction of the map: smaller areas are named in the legend


def plot_regime_map(data: Any, *, ax: Axes | None = None, designs: Any = (), legend: bool = True) -> Axes:
    """Draws a `RegimeMap`: each regime as an area labelled with its name, the boundaries as black lines.

    Args:
        data: a `RegimeMap`.
        ax: the axes to draw on; new ones when None.
        designs: points (x, y) to mark with a star, such as an optimum.
        legend: whether to name areas that are too small for a label in a legend.

    Returns:
        The axes.
    """
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    ax = new_axes(ax, 6.4)
    units = data.scene.units
    labels, factors = zip(*(parameter_axis(name, units) for name in data.names), strict=True)
    x, y = (values * factor for values, factor in zip(data.values, factors, strict=True))
    codes = sorted(int(r) for r in Regime)
    colours = ListedColormap([REGIME_COLOURS[Regime(c)] for c in codes])
    norm = BoundaryNorm([c - 0.5 for c in codes] + [codes[-1] + 0.5], len(codes))
    ax.pcolormesh(x, y, data.regimes, cmap=colours, norm=norm, shading="nearest", rasterized=True)
    for values, scale in ((x, ax.set_xscale), (y, ax.set_yscale)):
        if _logarithmic(values):
            scale("log")
    for curve in data.boundaries:
        ax.plot(*(curve.points * factors).T, color="black", linewidth=1.0, solid_joinstyle="round")
    small = []
    for code in np.unique(data.regimes):
        regime = Regime(int(code))
        spot = _widest_spot(data.regimes == code)
        share = np.mean(data.regimes == code)
        if share >= _LEAST_SHARE and spot[2] >= 0.055:
            words = regime.words.replace(" ", "\n") if spot[2] < 0.16 else regime.words
            ax.text(x[spot[1]], y[spot[0]], words, ha="center", va="center", fontsize=8, linespacing=0.95)
        else:
            small.append(Patch(facecolor=REGIME_COLOURS[regime], edgecolor="black", linewidth=0.5, label=regime.words))
    for point in designs:
        ax.plot(*(np.asarray(point) * factors), "*", color="black", markersize=12, markeredgecolor="white", zorder=5)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[0], y[-1])
    if legend and small:
        ax.legend(
            handles=small, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(small), fontsize=8, frameon=False
        )
    return ax


#: kind of a point of fold curves: marker, label
_MARKS = {
    "cusp": ("^", "cusp"),
    "merger": ("D", "branches merge"),
    "fold_at_breakdown": ("X", "fold at breakdown"),
    "zero_voltage": ("o", "fold at zero voltage"),
}


def plot_fold_curves(data: Any, *, ax: Axes | None = None, legend: bool = True) -> Axes:
    """Draws `FoldCurves`: the control at folds and at breakdown against the parameter, with cusps, mergers and crossings.

    Args:
        data: a `FoldCurves`.
        ax: the axes to draw on; new ones when None.
        legend: whether to add a legend.

    Returns:
        The axes. Folds beyond electric breakdown are dotted.
    """
    ax = new_axes(ax, 6.4)
    styles = {
        "folds": {"color": "#0072B2", "linewidth": 1.6},
        "folds beyond breakdown": {"color": "#0072B2", "linewidth": 1.0, "linestyle": ":"},
        "electric breakdown": {"color": "#D55E00", "linewidth": 1.2},
    }
    units = data.scene.units
    label, factor = parameter_axis(data.parameter, units)
    rise = 1.0 if units is None else units.read(1.0, data.control) / units.to_si(1.0, data.control)
    drawn = {}
    for curve in data.curves:
        x, pressure, voltage, ratio = curve.line.T
        x, y = x * factor, rise * (voltage if data.control == "voltage" else pressure)
        if curve.kind == PointKind.breakdown:
            drawn["electric breakdown"] = ax.plot(x, y, **styles["electric breakdown"])[0]
            continue
        unbroken = ratio <= 1 + 1e-9
        # a piece beyond breakdown includes the point it shares with its neighbour
        beyond = ~unbroken | np.append(~unbroken[1:], False) | np.append(False, ~unbroken[:-1])
        for name, there in (("folds", unbroken), ("folds beyond breakdown", beyond)):
            if there.any() and (name == "folds" or not unbroken.all()):
                drawn[name] = ax.plot(np.where(there, x, np.nan), np.where(there, y, np.nan), **styles[name])[0]
    for kind, (marker, word) in _MARKS.items():
        points = data.named(kind)
        if points:
            x, y = [factor * p.parameter for p in points], [rise * getattr(p, data.control) for p in points]
            style = {"color": "black", "markersize": 6, "clip_on": False, "zorder": 4}
            drawn[word] = ax.plot(x, y, marker, **style)[0]
    low, high = (factor * v for v in data.within)
    if low > 0 and high / low > 10:
        ax.set_xscale("log")
    ax.set_xlim(low, high)
    ax.set(xlabel=label, ylabel=axis_label(data.control, units))
    if data.control == "voltage":
        ax.set_ylim(bottom=0)
    if legend and drawn:
        ax.legend([*drawn.values()], [*drawn], fontsize=8)
    return ax


def _logarithmic(values: np.ndarray) -> bool:
    return bool(values[0] > 0 and np.diff(values)[-1] > 2 * np.diff(values)[0])


def _widest_spot(mask: np.ndarray) -> tuple[int, int, float]:
    """The centre of the largest square in an area: row, column, and its width as a fraction of the map."""
    padded = np.pad(mask.astype(int), 1)
    size = np.zeros_like(padded)
    for i in range(1, padded.shape[0]):
        for j in np.flatnonzero(padded[i]):
            size[i, j] = 1 + min(size[i - 1, j], size[i, j - 1], size[i - 1, j - 1])
    i, j = np.unravel_index(int(np.argmax(size)), size.shape)
    width = int(size[i, j])
    return int(i - 1 - width // 2), int(j - 1 - width // 2), width / mask.shape[1]
