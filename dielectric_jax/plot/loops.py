"""Pictures of membranes followed in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import voltage_of
from .drawing import COLOURS, axis_label, columns, labelled, mathtext, new_axes, new_figure, sequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_courses", "plot_follow", "plot_runs", "plot_snap_voltages"]


def _reader(runs: Sequence[Any], units: Any) -> tuple[Any, Any]:
    """The units given, or those that the scenes carry, and the function `(values, name)` that reads values in them."""
    units = (
        next((u for run in runs if (u := getattr(run.scene, "units", None)) is not None), None)
        if units is None
        else units
    )
    return units, (lambda values, name: values) if units is None else units.read


def _draw_bounds(ax: Axes, bounds: Sequence[Any], read: Any) -> None:
    """The diagram at rest in black, and that at frozen dashpots in grey."""
    slow, fast = bounds
    held = fast.dense()
    volume, load, *_ = columns(slow.branches[0], "voltage_squared", slow.special_points)
    lines = (
        (volume, voltage_of(load), "black", "at rest"),
        (held.volume.values, held.voltage.values, "0.6", "dashpots frozen"),
    )
    for volume, voltage, colour, label in lines:
        ax.plot(read(volume, "volume"), read(voltage, "voltage"), color=colour, linewidth=0.9, label=label)


def plot_runs(
    runs: Sequence[Any],
    *,
    bounds: Sequence[Any] = (),
    labels: Sequence[str] = (),
    units: Any = None,
    ax: Axes | None = None,
) -> Axes:
    """Draws the voltage of runs over the volume, or the pressure where the volume is prescribed; jumps are dotted.

    Args:
        runs: what `follow` returns, for several rates.
        bounds: what `bounds` returns for the scene: the diagram at rest is drawn in black, that at frozen dashpots in grey.
        labels: names of the runs.
        units: the `Units` to draw in; by default those the scenes carry, else dimensionless.
        ax: axes to draw on; new ones when None.

    Returns:
        The axes.

    >>> import dielectric_jax as dj
    >>> film = dj.Membrane(dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), 1.0, 1.0)]))
    >>> run = dj.follow(dj.Scene(film, dj.ConstantPressure(1.82)), voltage=dj.Ramp(rate=0.01))
    >>> len(plot_runs([run], labels=["0.01"]).lines)
    2
    """
    ax = new_axes(ax)
    units, read = _reader(runs, units)
    driven = all(np.ptp(run.dataset.voltage.values) == 0 for run in runs)
    name = "pressure" if driven else "voltage"
    if bounds:
        _draw_bounds(ax, bounds, read)
    names = list(labels) or [f"run {k + 1}" for k in range(len(runs))]
    for run, label, colour in zip(runs, names, sequence(len(runs)), strict=True):
        curve = run.dense()
        for k, event in enumerate(run.events):
            if event.kind == "landing":
                fold = run.events[k - 1]
                volumes = read(np.array([fold.volume, event.volume]), "volume")
                levels = read(np.array([getattr(fold, name), getattr(event, name)]), name)
                ax.plot(volumes, levels, ":", color=colour, linewidth=1.0)
        ax.plot(
            read(curve.volume.values, "volume"),
            read(curve[name].values, name),
            color=colour,
            linewidth=1.3,
            label=label,
        )
    if bounds:  # the diagram at rest goes on to the stretch limit
        ax.set_xlim(0.0, 1.3 * read(max(float(run.dataset.volume.max()) for run in runs), "volume"))
    ax.set_xlabel(axis_label("volume", units))
    ax.set_ylabel(axis_label(name, units))
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def plot_courses(run: Any, *, units: Any = None, time_unit: str = "", figure: Figure | None = None) -> Figure:
    """Draws volume, pressure and E/E_EB of a run over the time, above each other.

    `units` are those to draw in, by default those the scene carries; `time_unit` names the unit of the relaxation times, such as "s".

    >>> import dielectric_jax as dj
    >>> film = dj.Membrane(dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), 1.0, 1.0)]))
    >>> run = dj.follow(dj.Scene(film, dj.ConstantPressure(1.82)), voltage=dj.Hold(0.13))
    >>> len(plot_courses(run).axes)
    3
    """
    figure = new_figure(6.0, 6.0) if figure is None else figure
    units, read = _reader([run], units)
    rows = (
        ("volume", axis_label("volume", units)),
        ("pressure", axis_label("pressure", units)),
        ("breakdown_ratio", mathtext("E/E_EB")),
    )

    def of(values, name):
        return values if name == "breakdown_ratio" else read(values, name)

    curve = run.dense()
    for ax, (name, label) in zip(figure.subplots(len(rows), sharex=True), rows, strict=True):
        data = curve if name in curve else run.dataset
        ax.plot(data.time, of(data[name].values, name), color="C0", linewidth=1.2)
        for event in run.events:
            if event.kind in ("landing", "fastest", "breakdown"):
                ax.plot(event.time, of(getattr(event, name), name), "o", color="C1", markersize=4)
        ax.set_ylabel(label)
    figure.axes[-1].set_xlabel(labelled("time", "t", time_unit, dimensionless=False))
    return figure


def plot_follow(
    runs: Sequence[Any],
    *,
    bounds: Sequence[Any] = (),
    labels: Sequence[str] = (),
    units: Any = None,
    time_unit: str = "",
    figure: Figure | None = None,
) -> Figure:
    """The figure of the command `follow`: `plot_runs`, and for a single run `plot_courses` beside it; arguments as there.

    >>> import dielectric_jax as dj
    >>> film = dj.Membrane(dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), 1.0, 1.0)]))
    >>> run = dj.follow(dj.Scene(film, dj.ConstantPressure(1.82)), voltage=dj.Hold(0.13))
    >>> len(plot_follow([run]).axes)
    4
    """
    if len(runs) > 1:
        figure = new_figure(8.0) if figure is None else figure
        plot_runs(runs, bounds=bounds, labels=labels, units=units, ax=figure.add_subplot())
        return figure
    figure = new_figure(12.0, 5.4) if figure is None else figure
    panels: Any = figure.subfigures(1, 2, width_ratios=[1.2, 1.0])
    left, right = panels
    ax = plot_runs(runs, bounds=bounds, labels=labels or ["run"], units=units, ax=left.add_subplot())
    ax.legend(frameon=False)
    plot_courses(runs[0], units=units, time_unit=time_unit, figure=right)
    return figure


def plot_snap_voltages(
    runs: Sequence[Any], *, bounds: Sequence[Any] = (), units: Any = None, time_unit: str = "", ax: Axes | None = None
) -> Axes:
    """Draws the voltage at the snap over the rate of the ramp: full circles are jumps, open ones creep through.

    Args:
        runs: ramps of the voltage, as `follow` returns them; those without a snap are left out.
        bounds: what `bounds` returns for the scene: the voltages of an infinitely slow and an infinitely fast ramp are drawn as lines.
        units: the `Units` to draw in; by default those the scenes carry, else dimensionless.
        time_unit: the unit of the relaxation times, such as "s".
        ax: axes to draw on; new ones when None.

    Returns:
        The axes.

    Raises:
        ValueError: for a run that is no ramp of the voltage.

    >>> import dielectric_jax as dj
    >>> film = dj.Membrane(dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), 1.0, 1.0)]))
    >>> scene = dj.Scene(film, dj.ConstantPressure(1.82))
    >>> runs = [dj.follow(scene, voltage=dj.Ramp(rate=rate)) for rate in (0.01, 0.1)]
    >>> [round(float(y), 4) for line in plot_snap_voltages(runs).lines for y in line.get_ydata()]
    [0.1833, 0.2484]
    """
    for run in runs:
        if run.protocol.get("voltage", {}).get("protocol") != "ramp":
            raise ValueError(f"`runs` must be ramps of the voltage, but one is {run.protocol!r}.")
    ax = new_axes(ax)
    units, read = _reader(runs, units)
    for kind, face, label in (("jump", COLOURS[0], "jump"), ("creep_through", "white", "creep-through")):
        own = [run for run in runs if run.snap is not None and run.snap.kind == kind]
        if own:
            rates = np.array([abs(run.protocol["voltage"]["rate"]) for run in own])
            rates = rates if units is None else units.to_si(rates, "voltage")
            snaps = read(np.array([run.snap.at.voltage for run in own]), "voltage")
            ax.plot(rates, snaps, "o", color=COLOURS[0], markerfacecolor=face, label=label)
    if bounds:
        slow, fast = bounds
        snapped, fold = slow.ramp()["snap"], fast.event("instantaneous_fold")
        levels = [(snapped[0].state.voltage, "-", "black", "infinitely slow")] if snapped else []
        levels += [(fold.voltage, "-", "0.6", "infinitely fast")] if fold else []
        for level, dash, colour, label in levels:
            ax.axhline(read(level, "voltage"), linestyle=dash, color=colour, linewidth=0.9, label=label)
    ax.set_xscale("log")
    volts = mathtext("H√(μ/ε)") if units is None else "V"
    unit = f"{volts}/{time_unit}" if time_unit else volts if units is None else f"{volts} per unit of time"
    ax.set_xlabel(labelled("rate", "dΦ/dt", f"({unit})", dimensionless=False))
    ax.set_ylabel(axis_label("voltage", units).replace("Voltage", "Voltage at the snap"))
    ax.legend(frameon=False)
    return ax
