"""Pictures of membranes followed in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .drawing import axis_label, new_axes, new_figure, sequence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_courses", "plot_runs"]


def plot_runs(
    runs: Sequence[Any], *, bounds: Sequence[Any] = (), labels: Sequence[str] = (), ax: Axes | None = None
) -> Axes:
    """Draws the voltage of runs over the volume, or the pressure where the volume is prescribed; jumps are dotted.

    Args:
        runs: what `follow` returns, for several rates.
        bounds: what `bounds` returns for the scene: the diagram at rest is drawn in black, that at frozen dashpots in grey.
        labels: names of the runs.
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
    driven = all(np.ptp(run.dataset.voltage.values) == 0 for run in runs)
    name = "pressure" if driven else "voltage"
    if bounds:
        slow, fast = bounds
        branch = slow.branches[0]
        keep = branch.voltage_squared >= 0
        ax.plot(
            branch.volume[keep], np.sqrt(branch.voltage_squared[keep]), color="black", linewidth=0.9, label="at rest"
        )
        held = fast.dense()
        ax.plot(held.volume, held.voltage, color="0.6", linewidth=0.9, label="dashpots frozen")
    names = list(labels) or [f"run {k + 1}" for k in range(len(runs))]
    for run, label, colour in zip(runs, names, sequence(len(runs)), strict=True):
        curve = run.dense()
        for k, event in enumerate(run.events):
            if event.kind == "landing":
                fold = run.events[k - 1]
                levels = [getattr(fold, name), getattr(event, name)]
                ax.plot([fold.volume, event.volume], levels, ":", color=colour, linewidth=1.0)
        ax.plot(curve.volume, curve[name], color=colour, linewidth=1.3, label=label)
    ax.set_xlabel(axis_label("volume"))
    ax.set_ylabel(axis_label(name))
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def plot_courses(run: Any, *, figure: Figure | None = None) -> Figure:
    """Draws volume, pressure and E/E_EB of a run over the time, above each other.

    >>> import dielectric_jax as dj
    >>> film = dj.Membrane(dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), 1.0, 1.0)]))
    >>> run = dj.follow(dj.Scene(film, dj.ConstantPressure(1.82)), voltage=dj.Hold(0.13))
    >>> len(plot_courses(run).axes)
    3
    """
    figure = new_figure(6.0, 6.0) if figure is None else figure
    rows = (("volume", axis_label("volume")), ("pressure", axis_label("pressure")), ("breakdown_ratio", "E/E_EB"))
    for ax, (name, label) in zip(figure.subplots(len(rows), sharex=True), rows, strict=True):
        ax.plot(run.dataset.time, run.dataset[name], color="C0", linewidth=1.2)
        for event in run.events:
            if event.kind in ("landing", "fastest", "breakdown"):
                ax.plot(event.time, getattr(event, name), "o", color="C1", markersize=4)
        ax.set_ylabel(label)
    figure.axes[-1].set_xlabel("time")
    return figure
