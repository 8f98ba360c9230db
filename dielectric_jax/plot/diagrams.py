"""Figures of diagrams: `plot_*(data, *, ax=None, ...) -> Axes`, and whole figures laid out like the paper's.

Solid lines are stable states, dashed lines unstable ones, pale lines states beyond electric breakdown. States with
Φ² < 0, which connect branches but cannot be reached by any voltage, are left out of voltage–volume plots.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import (
    QUANTITIES,
    Chamber,
    Event,
    PointKind,
    PrescribedVolume,
    Profile,
    RampEvent,
    SpecialPoint,
    control_of,
    mechanical,
    voltage_of,
)
from ..numerics import shown
from .drawing import (
    BRANCHES,
    GAS,
    add_legend,
    axis_label,
    columns,
    draw_cones,
    draw_events,
    draw_line,
    draw_points,
    line_entry,
    new_axes,
    new_figure,
    same_state,
    seen_entries,
    sequence,
    viewed,
    voltage_label,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "chamber_voltages",
    "plot_chamber",
    "plot_chamber_curves",
    "plot_diagram",
    "plot_membrane_curves",
    "plot_pressure_volume",
    "plot_voltage_volume",
]


def plot_voltage_volume(
    diagram: Any,
    *,
    ax: Axes | None = None,
    units: Any = None,
    vertical: str | None = None,
    whole: bool = False,
    legend: bool = True,
) -> Axes:
    """Draws Φ, or the charge, against V: every branch, the special points, and the ramp up and down with its snaps.

    If the volume is held, the apex stretch is drawn in its place.

    Args:
        diagram: a `Diagram` of kind "voltage-volume".
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in, as kV, ml and mbar; by default those the scene carries, else dimensionless.
        vertical: "voltage" or "charge"; the one that the scene controls when None.
        whole: show every branch in full; otherwise the limits frame the ramp.
        legend: whether to add a legend.

    Returns:
        The axes.
    """
    _require_kind(diagram, "voltage-volume")
    vertical = control_of(diagram.scene.loading) if vertical is None else vertical
    if vertical not in ("voltage", "charge"):
        raise ValueError(f"Argument `vertical` must be 'voltage' or 'charge', but is {vertical!r}.")
    across = "apex_stretch" if _held_volume(diagram) is not None else "volume"
    diagram, units = viewed(diagram, units)
    ax = new_axes(ax)
    for number, branch in enumerate(diagram.branches):
        points = [p for p in diagram.special_points if p.branch == number]
        place, squared, broken, stable = columns(branch, f"{vertical}_squared", points, across)
        colour = BRANCHES[number % len(BRANCHES)]
        draw_line(ax, place, voltage_of(squared), stable, broken, colour=colour)
        draw_cones(ax, [branch], vertical, colour, across)
    shown = [p for p in diagram.special_points if p.voltage_squared >= 0]
    marked = [e.state for e in diagram.events if e.event not in (RampEvent.snap, RampEvent.snap_back)]
    draw_points(ax, [p for p in shown if not any(same_state(s, p) for s in marked)], vertical, across)
    draw_events(ax, diagram.events, vertical, across=across)
    _label(ax, vertical, units, across)
    _frame_control(ax, diagram, shown, whole, vertical, across)
    if legend:
        add_legend(ax, seen_entries(ax))
    return ax


def plot_pressure_volume(
    diagrams: Any,
    *,
    ax: Axes | None = None,
    units: Any = None,
    gas_line: Callable[[np.ndarray], np.ndarray] | None = None,
    stability: bool = True,
    whole: bool = False,
    legend: bool = True,
) -> Axes:
    """Draws p against V for one diagram, or for several at different voltages.

    Args:
        diagrams: a `Diagram` of kind "pressure-volume", or a sequence of them.
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in, as kV, ml and mbar; by default those the scene carries, else dimensionless.
        gas_line: the pressure of the air as a function of an array of volumes, drawn as a dashed black line.
        stability: draw states that are unstable under prescribed pressure as dashed lines, and mark the special points.
            Otherwise the lines are solid, as is appropriate if another loading determines the stability.
        whole: show every curve up to lock-up; otherwise the limits frame the folds.
        legend: whether to add a legend.

    Returns:
        The axes.
    """
    diagrams = list(diagrams) if isinstance(diagrams, Iterable) else [diagrams]
    if not diagrams:
        raise ValueError("Argument `diagrams` must hold at least one diagram, but is empty.")
    for diagram in diagrams:
        _require_kind(diagram, "pressure-volume")
    diagrams, (units, *_) = zip(*(viewed(d, units) for d in diagrams), strict=True)
    ax = new_axes(ax)
    colours = sequence(len(diagrams))
    for diagram, colour in zip(diagrams, colours, strict=True):
        _draw_curve(ax, diagram, colour, stability)
        if stability:
            draw_points(ax, diagram.special_points, "pressure")
    entries = _voltage_entries(diagrams, colours, units)
    _label(ax, "pressure", units)
    _frame_pressure(ax, diagrams, whole)
    if gas_line is not None:
        volume = np.linspace(0, ax.get_xlim()[1], 400)
        ax.plot(volume, gas_line(volume), color="black", linestyle=GAS, linewidth=1.2, zorder=2.5)
        entries.append(line_entry("air", colour="black", linestyle=GAS))
    if legend:
        add_legend(ax, [*entries, *(e for e in seen_entries(ax) if stability or e[1] != "stable")])
    return ax


def _draw_curve(ax: Axes, diagram: Any, colour: Any, stability: bool = True) -> None:
    """Draws p against V, converted already, with or without dashes where states are unstable."""
    for number, branch in enumerate(diagram.branches):
        points = [p for p in diagram.special_points if p.branch == number]
        volume, pressure, broken, stable = columns(branch, "pressure", points)
        draw_line(ax, volume, pressure, stable if stability else np.ones_like(stable), broken, colour=colour)
    draw_cones(ax, diagram.branches, "pressure", colour)


def _voltage_entries(diagrams: Iterable[Any], colours: Iterable[Any], units: Any) -> list[tuple[Any, str]]:
    return [line_entry(voltage_label(d.voltage, units), colour=k) for d, k in zip(diagrams, colours, strict=True)]


def plot_membrane_curves(
    diagram: Any, curves: Sequence[Any], colours: Sequence[Any], *, ax: Axes, units: Any = None
) -> None:
    """Draws p against V at fixed voltages, dashed where the states are unstable under the loading of a diagram.

    A chamber resists a change of volume like a spring of stiffness k = n(p + p_atm)/(V + V_C), a held volume without limit, a held pressure not
    at all. One unstable direction fewer is left where -k < dp/dV < 0 along the curve.

    Args:
        diagram: a `Diagram` of kind "voltage-volume", whose scene has the loading.
        curves: diagrams of kind "pressure-volume" of its membrane.
        colours: one for each curve.
        ax: the axes to draw on.
        units: the `Units` to draw in; by default those the scene carries, else dimensionless.
    """
    for curve, colour in zip(curves, colours, strict=True):
        restated = types.SimpleNamespace(
            kind=curve.kind,
            scene=curve.scene,
            voltage=curve.voltage,
            branches=[_under(mechanical(diagram.scene.loading), b) for b in curve.branches],
            special_points=curve.special_points,
            events=(),
        )
        _draw_curve(ax, viewed(restated, units)[0], colour)


def _under(loading: Any, branch: Any) -> Any:
    """A curve at fixed voltage with the index of its states under a loading in place of a held pressure."""
    rise, growth = np.gradient(branch.pressure), np.gradient(branch.volume)
    stiffness = np.zeros(len(rise))
    if isinstance(loading, PrescribedVolume):
        stiffness = np.full(len(rise), np.inf)
    elif isinstance(loading, Chamber):
        outside = branch.pressure + float(loading.atmospheric_pressure)
        stiffness = float(loading.polytropic_exponent) * outside / (branch.volume + float(loading.volume))
    falling = (rise * growth < 0) & (np.abs(rise) < stiffness * np.abs(growth))
    # beside a peak the difference of two points may still rise where the index says that the curve falls
    flat = (stiffness > 0) & (np.abs(rise) < 0.02 * np.minimum(stiffness, 1.0) * np.abs(growth))
    return dataclasses.replace(
        branch, index=np.where((branch.index > 0) & (falling | flat), branch.index - 1, branch.index)
    )


def plot_chamber(
    diagram: Any,
    curves: Sequence[Any] = (),
    *,
    figure: Figure | None = None,
    units: Any = None,
    shapes: Sequence[tuple[Event, Profile]] = (),
) -> Figure:
    """Draws the paper's figure of one scene: membrane curves with the line of the air, and voltage against volume.

    The states of the scene are the crossings of the pressure–volume line of the air, or of the held volume (long dashes), with the
    curves of the membrane, which are dashed where they are unstable under the scene's loading. Under charge control the left panel shows voltage against volume, with the folds of the charge.

    Args:
        diagram: a `Diagram` of kind "voltage-volume".
        curves: diagrams of kind "pressure-volume" of the same membrane; `chamber_voltages` suggests their voltages. Empty
            under charge control, where the states do not follow a curve of constant voltage.
        figure: the figure to draw on; a new one when None.
        units: the `Units` to draw in, as kV, ml and mbar; by default those the scene carries, else dimensionless.
        shapes: events and the profiles of their states, drawn below at one scale.

    Returns:
        The figure.
    """
    _require_kind(diagram, "voltage-volume")
    if shapes:
        figure = new_figure(11.0 if curves else 6.0, 6.2) if figure is None else figure
        halves: Any = figure.subfigures(2, 1, height_ratios=(2.6, 1))
        above, below = halves
        _draw_shapes(below, shapes, viewed(diagram, units)[1])
        plot_chamber(diagram, curves, figure=above, units=units)
        return figure
    charged = control_of(diagram.scene.loading) == "charge"
    if charged and curves:
        raise ValueError("Argument `curves` must be empty for a diagram under charge control, but is not.")
    figure = new_figure(11.0 if curves or charged else 6.0) if figure is None else figure
    if charged:
        for ax, vertical in zip(figure.subplots(1, 2), ("voltage", "charge"), strict=True):
            plot_voltage_volume(diagram, ax=ax, units=units, vertical=vertical, legend=vertical == "charge")
        return figure
    if not curves:
        plot_voltage_volume(diagram, ax=figure.add_subplot(), units=units)
        return figure
    left, right = figure.subplots(1, 2)
    plot_voltage_volume(diagram, ax=right, units=units)
    plot_chamber_curves(diagram, curves, ax=left, units=units, limits=right.get_xlim())
    return figure


def plot_chamber_curves(
    diagram: Any,
    curves: Sequence[Any],
    *,
    ax: Axes | None = None,
    units: Any = None,
    limits: tuple[float, float] | None = None,
    legend: bool = True,
) -> Axes:
    """Draws p against V: curves of the membrane, the line of the air or of what is held, and the events of the ramp.

    The curves are dashed where they are unstable under the scene's loading.

    Args:
        diagram: a `Diagram` of kind "voltage-volume".
        curves: diagrams of kind "pressure-volume" of the same membrane; `chamber_voltages` suggests their voltages.
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in, as kV, ml and mbar; by default those the scene carries, else dimensionless.
        limits: of the volume, unless the scene holds it; those of the curves when None.
        legend: whether to add a legend.

    Returns:
        The axes.
    """
    _require_kind(diagram, "voltage-volume")
    ax = new_axes(ax)
    colours, computed = sequence(len(curves)), diagram
    diagram, units = viewed(diagram, units)
    plot_membrane_curves(computed, curves, colours, ax=ax, units=units)  # curves may carry no units of their own
    _label(ax, "pressure", units)
    curves = [viewed(c, units)[0] for c in curves]
    held = _held_volume(diagram)
    if held is not None:
        limits = (0.0, 2.2 * held)
    if limits is not None:
        ax.set_xlim(limits)
    _frame_chamber(ax, diagram, curves)
    entries = [*_voltage_entries(curves, colours, units), _draw_condition(ax, diagram, held)]
    if legend:
        add_legend(ax, entries)
    return ax


def _draw_condition(ax: Axes, diagram: Any, held: float | None) -> tuple[Any, str]:
    """Draws the line of the air, of the pressure or of the volume, with the events on it; returns its entry of a legend."""
    style: dict[str, Any] = {"color": "black", "linestyle": GAS, "linewidth": 1.2, "zorder": 2.5}
    if held is not None:
        ax.axvline(held, **style)
        draw_events(ax, diagram.events, "pressure")
        return line_entry("held volume", colour="black", linestyle=GAS)

    def gas_line(volume: np.ndarray) -> np.ndarray:
        pressure = diagram.gas_pressure(volume)
        return np.full_like(volume, float(diagram.scene.loading.pressure)) if pressure is None else np.asarray(pressure)

    volume = np.linspace(0, ax.get_xlim()[1], 400)
    ax.plot(volume, gas_line(volume), **style)
    draw_events(ax, diagram.events, "pressure", gas_line=gas_line)
    constant = diagram.gas_pressure(volume) is None
    return line_entry("pressure held" if constant else "air", colour="black", linestyle=GAS)


#: the columns of a diagram, as in its JSON
COLUMNS = ("voltage", *QUANTITIES)


def plot_columns(
    diagram: Any,
    x: str,
    y: str,
    *,
    ax: Axes | None = None,
    units: Any = None,
    whole: bool = False,
    legend: bool = True,
) -> Axes:
    r"""Draws one column of a diagram against another: every branch, the special points, and the ramp with its snaps.

    Args:
        diagram: a `Diagram` of either kind.
        x: the column along the horizontal axis, by its name in the JSON document: "voltage", "voltage_squared", "pressure", "volume",
            "apex_stretch", "height", "charge", "breakdown_ratio", "index" or "error_estimate".
        y: the column along the vertical axis.
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in, as kV, ml and mbar; by default those the scene carries, else dimensionless.
        whole: show every branch in full; otherwise the limits frame the ramp, or the folds of a diagram without one.
        legend: whether to add a legend.

    Returns:
        The axes.

    Raises:
        ValueError: for another column, or the same twice.

    >>> import dielectric_jax as dj
    >>> ax = plot_columns(dj.pressure_volume(dj.Membrane()), "apex_stretch", "pressure")
    >>> print(ax.get_xlabel(), "|", ax.get_ylabel())
    Apex stretch $λ_{\mathrm{a}}$ | Pressure $p$ / ($μH/A$)
    """
    for argument, name in (("x", x), ("y", y)):
        if name not in COLUMNS:
            raise ValueError(f"`{argument}` must be one of {', '.join(COLUMNS)}, but is {shown(name)}.")
    if x == y:
        raise ValueError(f"`x` and `y` must be two columns, but both are {x!r}.")
    diagram, units = viewed(diagram, units)
    ax = new_axes(ax)
    counted = "index" in (x, y)  # no special point and no event has a place on an axis that counts
    for number, branch in enumerate(diagram.branches):
        points = [] if counted else [p for p in diagram.special_points if p.branch == number]
        # the square of a voltage or charge is smooth where that begins
        smooth = [f"{name}_squared" if name in ("voltage", "charge") else name for name in (y, x)]
        across, up, broken, stable = columns(branch, smooth[0], points, smooth[1])
        across, up = (voltage_of(v) if n in ("voltage", "charge") else v for n, v in ((x, across), (y, up)))
        colour = BRANCHES[number % len(BRANCHES)]
        draw_line(ax, across, up, stable, broken, colour=colour)
        draw_cones(ax, [branch], y, colour, x)
    if not counted:
        marked = [e.state for e in diagram.events if e.event not in (RampEvent.snap, RampEvent.snap_back)]
        free = [p for p in diagram.special_points if not any(same_state(s, p) for s in marked)]
        draw_points(ax, free, y, x)
        draw_events(ax, diagram.events, y, across=x)
    _label(ax, y, units, x)
    _frame_columns(ax, diagram, x, y, whole)
    if legend:
        add_legend(ax, seen_entries(ax))
    return ax


def _frame_columns(ax: Axes, diagram: Any, x: str, y: str, whole: bool) -> None:
    """Sets limits that show the ramp, or the folds without one, or else everything; below zero only where these are."""
    states = [e.state for e in diagram.events] or [p for p in diagram.special_points if p.kind == PointKind.fold]
    for name, limits in ((x, ax.set_xlim), (y, ax.set_ylim)):
        values = [np.asarray(getattr(record, name), float) for record in (diagram.branches if whole else states)]
        known = np.concatenate([v.ravel() for v in values]) if values and name != "index" else np.zeros(0)
        known = known[np.isfinite(known)]
        if known.size and known.max() > 0:
            room = 1.04 if whole else 1.3
            below = min(
                [float(known.min()), *(float(getattr(p, name)) for p in diagram.special_points if getattr(p, name) < 0)]
            )
            limits(min(room * below, -0.02 * float(known.max())), room * float(known.max()))


def plot_diagram(
    diagram: Any,
    curves: Sequence[Any] = (),
    *,
    x: str | None = None,
    y: str | None = None,
    ax: Axes | None = None,
    figure: Figure | None = None,
    units: Any = None,
) -> Figure | Axes:
    """Draws the figure for the kind of the diagram on a `figure`, or what fits into one panel on `ax`; returns the one that is drawn on.

    `curves` and `units` are as in `plot_chamber`; curves need a second panel, and so a figure. With `x` and `y`, two columns as in
    `plot_columns`, these are drawn instead.
    """
    if x is not None or y is not None:
        if x is None or y is None:
            raise ValueError(f"`x` and `y` must be given together, but `{'x' if x is None else 'y'}` is missing.")
        if curves:
            raise ValueError("`curves` must be left out where `x` and `y` are given, but is not.")
        if ax is not None:
            return plot_columns(diagram, x, y, ax=ax, units=units)
        figure = new_figure(6.0) if figure is None else figure
        plot_columns(diagram, x, y, ax=figure.add_subplot(), units=units)
        return figure
    if ax is not None:
        if curves or figure is not None:
            raise ValueError(f"`ax` must be left out where `{'curves' if curves else 'figure'}` is given, but is not.")
        plot = plot_voltage_volume if diagram.kind == "voltage-volume" else plot_pressure_volume
        return plot(diagram, ax=ax, units=units)
    if diagram.kind == "voltage-volume":
        return plot_chamber(diagram, curves, figure=figure, units=units)
    if curves:
        raise ValueError("Argument `curves` must be empty for a diagram of kind 'pressure-volume', but is not.")
    figure = new_figure(6.0) if figure is None else figure
    plot_pressure_volume(diagram, ax=figure.add_subplot(), units=units)
    return figure


def _draw_shapes(figure: Any, shapes: Sequence[tuple[Event, Profile]], units: Any) -> None:
    """Cross-sections of the membrane in a row, at one scale, each named by its event and voltage."""
    rows = figure.subplots(1, len(shapes), squeeze=False)[0]
    width = max(float(shape.r.max()) for _, shape in shapes)
    top = max(float(shape.z[-1]) for _, shape in shapes)
    for ax, (event, shape) in zip(rows, shapes, strict=True):
        across, up = np.concatenate([-shape.r[::-1], shape.r]), shape.z[-1] - shape.z
        up = np.concatenate([up[::-1], up])
        ax.fill(across, up, color="0.93")
        ax.plot(across, up, color="0.25", linewidth=1.8)
        for side in (-1, 1):
            ax.plot([side * shape.r[-1], side * 1.15 * width], [0, 0], color="0.6", linewidth=1.2)
        ax.set(xlim=(-1.15 * width, 1.15 * width), ylim=(-0.04 * top, 1.06 * top), aspect="equal")
        voltage = event.state.voltage if units is None else units.read(event.state.voltage, "voltage")
        ax.set_title(f"{str(event.event).replace('_', ' ')}\n{voltage_label(voltage, units)}", fontsize=9)
        ax.axis("off")


def chamber_voltages(diagram: Any) -> list[float]:
    """The voltages whose pressure–volume curves illustrate a ramp best: zero, at each snap up, and at its end."""
    voltages = [0.0]
    for event in diagram.events:
        if event.direction == "up" and event.event in (RampEvent.snap, RampEvent.breakdown, RampEvent.end):
            phi = event.state.voltage
            if all(abs(phi - other) > 1e-6 for other in voltages):
                voltages.append(phi)
    return sorted(voltages)


def _require_kind(diagram: Any, kind: str) -> None:
    if diagram.kind != kind:
        raise ValueError(f"Argument `diagram` must be of kind {kind!r}, but is of kind {diagram.kind!r}.")


def _held_volume(diagram: Any) -> float | None:
    """The volume prescribed by the scene of a diagram, None if it prescribes none."""
    held = mechanical(diagram.scene.loading)
    return float(held.volume) if isinstance(held, PrescribedVolume) else None


def _label(ax: Axes, vertical: str, units: Any, across: str = "volume") -> None:
    ax.set_xlabel(axis_label(across, units))
    ax.set_ylabel(axis_label(vertical, units))


def _frame_control(
    ax: Axes, diagram: Any, points: Sequence[SpecialPoint], whole: bool, vertical: str, across: str
) -> None:
    """Sets limits that show the ramp and the special points in about the same range."""

    def places(what):
        return [(getattr(s, across), getattr(s, vertical)) for s in what]

    reached = [place for place in places(e.state for e in diagram.events) if np.isfinite(place[1])]
    if whole or len(reached) < 2:
        for columns_ in places(diagram.branches):
            reached += [(v, y) for v, y in zip(*columns_, strict=True) if np.isfinite(y)]
        far = places(points)
    else:
        v_max, phi_max = max(v for v, _ in reached), max(phi for _, phi in reached)
        far = [(v, y) for v, y in places(points) if v <= 1.6 * v_max and y <= 2 * phi_max]
    if not reached:
        return
    v_max, phi_max = (max(column) for column in zip(*reached, *far, strict=True))
    room = 1.04 if whole else 1.3
    _limit(ax, room * v_max, room * phi_max)


def _limit(ax: Axes, right: float, top: float) -> None:
    """Sets limits that start slightly below zero, so that markers on an axis are not clipped."""
    right, top = right if right > 0 else 1.0, top if top > 0 else 1.0
    ax.set_xlim(-0.02 * right, right)
    ax.set_ylim(-0.03 * top, top)


def _frame_pressure(ax: Axes, diagrams: Sequence[Any], whole: bool) -> None:
    """Sets limits that show the folds or, without folds, the curves up to half of their largest volume."""
    folds = [p for d in diagrams for p in d.special_points if p.kind == PointKind.fold]
    branches = [b for d in diagrams for b in d.branches]
    if not branches:
        return
    v_end = max(float(np.max(b.volume)) for b in branches)
    if whole:
        v_max, p_max = v_end, max(float(np.max(b.pressure)) for b in branches)
    elif folds:
        v_max = min(2.2 * max(p.volume for p in folds), v_end)
        p_max = 1.25 * max(p.pressure for p in folds)
    else:
        v_max = 0.5 * v_end
        inside = [np.asarray(b.pressure)[np.asarray(b.volume) <= v_max] for b in branches]
        p_max = max((float(np.max(p)) for p in inside if len(p)), default=1.0)
    _limit(ax, v_max, p_max)


def _frame_chamber(ax: Axes, diagram: Any, curves: Sequence[Any]) -> None:
    """Sets pressure limits for volumes that are already framed: the curves' peaks there, and the events."""
    v_max = ax.get_xlim()[1]
    top = [e.state.pressure for e in diagram.events]
    top += [p.pressure for c in curves for p in c.special_points if p.kind == PointKind.fold and p.volume <= v_max]
    if top:
        _limit(ax, v_max, 1.2 * max(top))
