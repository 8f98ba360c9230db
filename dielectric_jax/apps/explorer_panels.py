"""The pictures of the explorer: the diagram, pressure against volume, and the shape of the membrane.

A panel's axes are kept as a picture, and only what lies on them is redrawn while a slider moves. Pictures are PNGs, which
every front end of Jupyter can show.
"""

from __future__ import annotations

import io
import math
import types
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import Profile, voltage_of
from ..plot import (
    columns,
    event_entries,
    line_entries,
    line_entry,
    plot_chamber_curves,
    plot_cross_section,
    plot_pressure_volume,
    plot_voltage_volume,
    point_entries,
    viewed,
    voltage_text,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CurvePanel", "DiagramPanel", "ShapePanel", "whole_figure"]

_ROUND = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.4, 8.0, 10.0)  # ends of axes, times powers of ten
_MOST_FRAMES = 64  # pictures of empty axes that are kept; beyond, the oldest is drawn again when it is needed
_GHOST = "0.8"
_MARK = "#CC79A7"


class Panel:
    """One axes whose ticks and labels are drawn once for each set of limits, and what is drawn on that picture."""

    def __init__(self, size: tuple[float, float], dpi: float, place: tuple[float, float, float, float]):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.figure = Figure(figsize=size, dpi=dpi)
        self.canvas = FigureCanvasAgg(self.figure)
        self.axes = self.figure.add_axes(place)
        self._pictures: dict[tuple, Any] = {}

    def clear(self) -> None:
        """Removes what was drawn on the axes."""
        for artist in self._artists():
            artist.remove()

    def write(self, title: str) -> None:
        """Writes a caption above the axes, which is drawn with the lines."""
        self.axes.text(0.5, 1.03, title, transform=self.axes.transAxes, ha="center", fontsize="small")

    def _artists(self) -> list[Any]:
        return [*self.axes.lines, *self.axes.texts, *self.axes.collections]

    def png(self) -> bytes:
        """The picture as a PNG."""
        axes = self.axes
        artists = sorted(self._artists(), key=lambda a: a.get_zorder())
        key = (*axes.get_xlim(), *axes.get_ylim(), axes.get_xlabel(), axes.get_ylabel(), axes.get_title())
        if key not in self._pictures:
            if len(self._pictures) >= _MOST_FRAMES:
                self._pictures.pop(next(iter(self._pictures)))
            for artist in artists:
                artist.set_visible(False)
            self.canvas.draw()
            for artist in artists:
                artist.set_visible(True)
            self._pictures[key] = self.canvas.copy_from_bbox(self.figure.bbox)
        self.canvas.restore_region(self._pictures[key])
        axes.apply_aspect()
        for artist in artists:
            axes.draw_artist(artist)
        return _png(np.asarray(self.canvas.buffer_rgba()))


class DiagramPanel(Panel):
    """The diagram, with a legend of everything that it can show."""

    def __init__(self, size: tuple[float, float], dpi: float):
        super().__init__(size, dpi, (0.1, 0.13, 0.61, 0.84))
        add_whole_legend(self.figure, (0.72, 0.55))

    def draw(self, seen: Any, ghost: Any = None) -> bytes:
        """The PNG of a result on round axes, over the curve of another; of empty axes for None."""
        self.clear()
        if seen is not None:
            draw_diagram(self.axes, seen, ghost)
            axes = self.axes
            for end, limit in ((axes.get_xlim()[1], axes.set_xlim), (axes.get_ylim()[1], axes.set_ylim)):
                limit(-0.015 * _rounded(end), _rounded(end))
        return self.png()


class CurvePanel(Panel):
    """The membrane's pressure–volume curves at no voltage and at that of a state, with the line of the air."""

    def __init__(self, size: tuple[float, float], dpi: float):
        super().__init__(size, dpi, (0.17, 0.22, 0.8, 0.68))

    def draw(self, seen: Any, curves: list[Any], state: Any, limits: tuple[float, float]) -> bytes:
        """The PNG for a ramp over the limits of the volume; of empty axes without curves."""
        self.clear()
        if curves:
            draw_curves(self.axes, seen, curves, state, limits)
            top = _rounded(self.axes.get_ylim()[1])
            self.axes.set_ylim(-0.015 * top, top)
            self.write(_key_of(curves))
        return self.png()


class ShapePanel(Panel):
    """The cross-section of the membrane, coloured by E/E_EB."""

    def __init__(self, size: tuple[float, float], dpi: float):
        super().__init__(size, dpi, (0.17, 0.22, 0.62, 0.7))
        add_colour_bar(self.figure, self.axes, self.figure.add_axes((0.82, 0.22, 0.035, 0.7)))

    def draw(self, shape: Profile | None, units: Any, title: str) -> bytes:
        """The PNG of a profile with its title; of empty axes for None."""
        self.clear()
        if shape is not None:
            draw_shape(self.axes, shape, units)
            width, top = (_rounded(end) for end in (self.axes.get_xlim()[1], self.axes.get_ylim()[1]))
            self.axes.set(xlim=(-width, width), ylim=(-0.06 * top, top))
        self.write(title)
        return self.png()


def draw_diagram(axes: Any, seen: Any, ghost: Any = None, legend: bool = False) -> None:
    """Draws a result, and in light grey the curve of an earlier one of the same kind."""
    if seen.kind == "voltage-volume":
        plot_voltage_volume(seen, ax=axes, legend=legend)
        vertical = "voltage_squared"
    else:
        plot_pressure_volume(seen, ax=axes, legend=legend)
        vertical = "pressure"
    if ghost is None or ghost.kind != seen.kind:
        return
    limits = axes.get_xlim(), axes.get_ylim()
    before, _ = viewed(ghost)
    for branch in before.branches:
        volume, value, *_ = columns(branch, vertical, before.special_points)
        value = voltage_of(value) if vertical == "voltage_squared" else value
        axes.plot(volume, value, color=_GHOST, linewidth=1.6, zorder=1)
    axes.set(xlim=limits[0], ylim=limits[1])


def draw_curves(
    axes: Any, seen: Any, curves: list[Any], state: Any, limits: tuple[float, float], legend: bool = False
) -> None:
    """Draws pressure–volume curves with the ramp of a diagram, and marks one state."""
    plot_chamber_curves(seen, curves, ax=axes, limits=limits, legend=legend)
    if state is not None:
        units = seen.scene.units
        shown = state if units is None else units.read(state)
        ring = {"markersize": 11, "markerfacecolor": "none", "markeredgewidth": 2.0, "zorder": 6}
        axes.plot(shown.volume, shown.pressure, "o", color=_MARK, **ring)


def _key_of(curves: list[Any]) -> str:
    """What the lines of `draw_curves` are, from dark to light."""
    shown = [viewed(c) for c in curves]
    voltages = [voltage_text(c.voltage, units) for c, units in shown]
    return "; ".join(
        [f"{word} {text}" for word, text in zip(("dark", "light"), voltages, strict=False)] + ["dashed: air"]
    )


def draw_shape(axes: Any, shape: Profile, units: Any) -> None:
    """Draws a cross-section whose colours reach from 0 to breakdown."""
    plot_cross_section(shape, ax=axes, units=units, limits=(0.0, 1.0), colourbar=False)


def whole_figure(seen: Any, curves: list[Any], state: Any, shape: Profile | None, title: str) -> Figure:
    """The pictures of the explorer as one figure."""
    from matplotlib.figure import Figure

    if not curves:
        figure = Figure(figsize=(7.6, 4.6), layout="constrained")
        axes = figure.add_subplot()
        draw_diagram(axes, seen, legend=True)
        return figure
    figure = Figure(figsize=(11.0, 4.8), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.7, 1))
    axes, above, below = (figure.add_subplot(place) for place in (grid[:, 0], grid[0, 1], grid[1, 1]))
    draw_diagram(axes, seen, legend=True)
    draw_curves(above, seen, curves, state, axes.get_xlim(), legend=True)
    if shape is not None:
        draw_shape(below, shape, seen.scene.units)
        add_colour_bar(figure, below)
    below.set_title(title, fontsize="small")
    return figure


def add_colour_bar(figure: Any, axes: Any, own: Any = None) -> None:
    """Adds the colour bar of `draw_shape` beside some axes, or on axes of its own."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    bar = figure.colorbar(ScalarMappable(Normalize(0.0, 1.0), "cividis"), cax=own, ax=axes)
    bar.set_label("E/E_EB")


def add_whole_legend(figure: Any, place: tuple[float, float]) -> None:
    """Adds the legend of everything that a diagram can show, with its left middle at a place."""
    how: dict[str, Any] = {"loc": "center left", "frameon": False, "fontsize": "small"}
    figure.legend(*zip(*_every_entry(), strict=True), bbox_to_anchor=place, **how)


def _png(pixels: np.ndarray) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels[..., :3]).save(file, format="png", compress_level=1)
    return file.getvalue()


def _rounded(end: float) -> float:
    """The next round number, so that the axes do not change with every move of a slider."""
    power = 10.0 ** math.floor(math.log10(end))
    return next(step for step in _ROUND if step * power >= end * (1 - 1e-9)) * power


def _every_entry() -> list:
    """The legend of everything that a diagram can show."""
    kinds: Any = [types.SimpleNamespace(kind=kind) for kind in ("fold", "zero_voltage", "breakdown")]
    events: Any = [
        types.SimpleNamespace(event=e, direction="up") for e in ("start", "landing", "breakdown", "no_landing", "snap")
    ]
    events += [
        types.SimpleNamespace(event="snap_back", direction="down"),
        types.SimpleNamespace(event="end", direction="down"),
    ]
    styles: Any = [types.SimpleNamespace(index=[0, 1], breakdown_ratio=[0, 1])]
    before = line_entry("before the change", colour=_GHOST)
    return [*line_entries(styles), before, *point_entries(kinds), *event_entries(events)]
