"""Ramps as paths: the states a slow ramp holds in order, the loop it draws, and animations of the balloon, also in time."""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..model import Profile, RampEvent, State, Units, profile, voltage_of
from .drawing import (
    COLOURS,
    GAS,
    add_legend,
    axis_label,
    draw_events,
    event_entries,
    mathtext,
    new_axes,
    new_figure,
    viewed,
)
from .loops import plot_runs
from .states import plot_cross_section

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["animate_ramp", "animate_run", "plot_ramp", "ramp_path"]

_QUANTITIES = ("voltage_squared", "pressure", "volume", "apex_stretch", "breakdown_ratio")
_JUMPS = ("snap", "snap_back")


def _between(diagram: Any, one: State, other: State) -> np.ndarray:
    """The states of a branch from one of its states to another, both included; shape (quantities, points)."""
    ends = [np.array([getattr(s, n) for n in _QUANTITIES]) for s in (one, other)]
    best = None
    for branch in diagram.branches:
        places, offs = [], []
        for state in (one, other):
            off = np.hypot(
                branch.apex_stretch - state.apex_stretch, 10 * (branch.voltage_squared - state.voltage_squared)
            )
            places.append(int(np.argmin(off)))
            offs.append(float(off.min()))
        if best is None or sum(offs) < best[0]:
            best = (sum(offs), branch, *places)
    if best is None:
        return np.stack(ends, axis=1)
    _, branch, first, last = best
    step = 1 if last >= first else -1
    inner = np.arange(first, last + step, step)
    rows = np.stack([getattr(branch, n)[inner] for n in _QUANTITIES])
    # the nearest points may lie just outside the two states
    low, high = sorted((one.apex_stretch, other.apex_stretch))
    rows = rows[:, (rows[3] > low) & (rows[3] < high) & (rows[0] >= 0)]
    return np.concatenate([ends[0][:, None], rows, ends[1][:, None]], axis=1)


def ramp_path(diagram: Any, direction: str = "up") -> dict[str, np.ndarray]:
    """The states along a ramp, in order: columns of one shape, and `leg`, which numbers the pieces between jumps.

    Raises ValueError for a pressure–volume curve, or if there is no such ramp.
    """
    events = diagram.ramp(direction).events
    pieces, legs = [], []
    for one, other in itertools.pairwise(events):
        if one.event in _JUMPS or other.event == RampEvent.no_landing or other.reason == "breakdown in the snap":
            continue
        pieces.append(_between(diagram, one.state, other.state))
        legs.append(np.full(pieces[-1].shape[1], sum(e.event in _JUMPS for e in events[: events.index(one) + 1])))
    landed = [e.state for e in events if e.event == RampEvent.landing]
    if landed and diagram.area_strain_reason == "breakdown in the snap" and direction == "up":
        pieces.append(np.array([[getattr(landed[-1], n)] for n in _QUANTITIES]))
        legs.append(np.array([legs[-1][-1] + 1 if legs else 0]))
    columns = np.concatenate(pieces, axis=1) if pieces else np.zeros((len(_QUANTITIES), 0))
    return dict(zip(_QUANTITIES, columns, strict=True)) | {"leg": np.concatenate(legs) if legs else np.zeros(0, int)}


def plot_ramp(diagram: Any, *, ax: Axes | None = None, units: Units | None = None, legend: bool = True) -> Axes:
    """Draws the loop of a ramp up and back: only the states that the ramp goes through, and the jumps between them.

    Args:
        diagram: a `Diagram` of kind "voltage-volume".
        ax: the axes to draw on; new ones when None.
        units: the `Units` to draw in; by default those the scene carries, else dimensionless.
        legend: whether to add a legend.

    Returns:
        The axes.
    """
    view, units = viewed(diagram, units)
    ax = new_axes(ax)
    ways = {e.direction for e in diagram.events}
    for way, colour, dash in (("up", COLOURS[5], "-"), ("down", COLOURS[4], GAS)):
        if way in ways:
            path = ramp_path(diagram, way)
            shown = path if units is None else units.read(path)
            for leg in np.unique(path["leg"]):
                on = path["leg"] == leg
                ax.plot(
                    shown["volume"][on],
                    voltage_of(shown["voltage_squared"][on]),
                    linestyle=dash,
                    color=colour,
                    linewidth=2.2,
                )
    draw_events(ax, view.events, "voltage")
    ax.set_xlabel(axis_label("volume", units))
    ax.set_ylabel(axis_label("voltage", units))
    if legend:
        add_legend(ax, event_entries(view.events))
    return ax


def animate_ramp(
    diagram: Any,
    path: str | pathlib.Path,
    *,
    direction: str = "up",
    units: Units | None = None,
    frames: int = 40,
    seconds: float = 6.0,
) -> pathlib.Path:
    """Writes an animation of the balloon, coloured by E/E_EB, beside its position on the loop: GIF, or MP4 with ffmpeg.

    Frames are evenly spaced in the logarithm of the apex stretch; jumps are cuts.

    Args:
        diagram: a `Diagram` of kind "voltage-volume".
        path: a file name ending in .gif or .mp4.
        direction: "up" or "down".
        units: the `Units` to draw in; by default those the scene carries, else dimensionless.
        frames: the number of frames, at least 2.
        seconds: the duration of the animation.

    Returns:
        The path.

    Raises:
        ValueError: for another ending, fewer frames, or MP4 without ffmpeg.
    """
    path = _checked(path, frames)
    _, units = viewed(diagram, units)
    states = ramp_path(diagram, direction)
    jump = np.concatenate([[False], np.diff(states["leg"]) != 0])
    steps = np.abs(np.diff(np.log(states["apex_stretch"]), prepend=np.log(states["apex_stretch"][0])))
    chosen = _evenly(np.where(jump, 0.0, steps), jump, frames)
    film = diagram.scene.membrane
    figure = new_figure(11.0, 4.8)
    left, right = figure.subplots(1, 2)
    plot_ramp(diagram, ax=right, units=units)
    shown = states if units is None else units.read(states)
    places: list[tuple[Any, Any]] = [(shown["volume"][i], voltage_of(shown["voltage_squared"][i])) for i in chosen]
    profiles = [profile(film, _state(states, i), steps=96) for i in chosen]
    titles = [f"{mathtext('E/E_EB')} = {states['breakdown_ratio'][i]:.2f} at its largest" for i in chosen]
    return _written(path, _Film(left, right, profiles, places, titles), units, seconds)


def animate_run(
    run: Any,
    path: str | pathlib.Path,
    *,
    bounds: Sequence[Any] = (),
    units: Units | None = None,
    time_unit: str = "",
    frames: int = 40,
    seconds: float = 6.0,
) -> pathlib.Path:
    """Writes an animation of the balloon in time, coloured by E/E_EB, beside its position on the curve of `plot_runs`.

    Between two frames, the share of the time and that of the logarithm of the volume are together the same, so that what is slow and
    what is sudden are both seen; the title holds the time. Jumps are cuts.

    Args:
        run: what `follow` returns.
        path: a file name ending in .gif or .mp4.
        bounds: what `bounds` returns for the scene, to be drawn with the curve.
        units: the `Units` to draw in; by default those the scene carries, else dimensionless.
        time_unit: the unit of the relaxation times, such as "s".
        frames: about the number of frames, at least 2.
        seconds: the duration of the animation.

    Returns:
        The path.

    Raises:
        ValueError: for another ending, fewer frames, or MP4 without ffmpeg.
    """
    path = _checked(path, frames)
    units = getattr(run.scene, "units", None) if units is None else units
    curve = run.dense()
    known = np.isfinite(curve.step.values)
    steps, time, volume = (curve[n].values[known] for n in ("step", "time", "volume"))
    jump = np.diff(run.dataset.leg.values[np.floor(steps).astype(int)], prepend=0) != 0
    ways = []
    for value in (time, np.log(volume - min(volume.min(), 0.0) + 1e-3)):
        moves = np.where(jump, 0.0, np.abs(np.diff(value, prepend=value[0])))
        ways.append(moves / max(float(moves.sum()), 1e-300))
    chosen = _evenly(ways[0] + ways[1], jump, frames)
    figure = new_figure(11.0, 4.8)
    left, right = figure.subplots(1, 2)
    plot_runs([run], bounds=bounds, labels=["run"], units=units, ax=right).legend(frameon=False)
    name = "voltage" if np.ptp(run.dataset.voltage.values) else "pressure"
    levels = curve[name].values[known]
    if units is not None:
        volume, levels = units.read(volume, "volume"), units.read(levels, name)
    profiles = [run.profile(float(steps[i])) for i in chosen]
    unit = f" {time_unit}" if time_unit else ""
    titles = [
        f"{mathtext('t')} = {time[i]:.4g}{unit}, {mathtext('E/E_EB')} = {np.max(p.breakdown_ratio):.2f} at its largest"
        for i, p in zip(chosen, profiles, strict=True)
    ]
    places = [(volume[i], levels[i]) for i in chosen]
    return _written(path, _Film(left, right, profiles, places, titles), units, seconds)


class _Film(NamedTuple):
    """Frames: the axes of the balloon and of the curve, and for each frame its profile, place on the curve and title."""

    left: Axes
    right: Axes
    profiles: list[Profile]
    places: list[tuple[Any, Any]]
    titles: list[str]


def _evenly(steps: np.ndarray, jump: np.ndarray, frames: int) -> np.ndarray:
    """The points of frames, evenly spaced along the sum of `steps`, with both sides of every jump."""
    way = np.cumsum(steps)
    chosen = np.unique(np.abs(way[None] - np.linspace(0, way[-1], frames)[:, None]).argmin(axis=1))
    return np.unique(np.concatenate([chosen, np.flatnonzero(jump), np.flatnonzero(jump) - 1, [len(way) - 1]]))


_WRITERS = {".gif": "pillow", ".mp4": "ffmpeg"}


def _checked(path: str | pathlib.Path, frames: int) -> pathlib.Path:
    """The path of an animation; raises ValueError where it or the number of frames is no good."""
    from matplotlib import animation

    path = pathlib.Path(path)
    if path.suffix not in _WRITERS:
        raise ValueError(f"`path` must end in .gif or .mp4, but is {str(path)!r}.")
    if not animation.writers.is_available(_WRITERS[path.suffix]):
        raise ValueError(
            f"`path` must end in .gif where {_WRITERS[path.suffix]} is not installed, but is {str(path)!r}."
        )
    if frames < 2:
        raise ValueError(f"`frames` must be at least 2, but is {frames!r}.")
    return path


def _written(path: pathlib.Path, film: _Film, units: Units | None, seconds: float) -> pathlib.Path:
    """Draws the frames into a file."""
    import matplotlib.pyplot as plt
    from matplotlib import animation

    (dot,) = film.right.plot([], [], "o", color="black", markersize=9, zorder=9)
    drawn = film.profiles if units is None else units.read(film.profiles)
    width, top = 1.15 * max(float(p.r.max()) for p in drawn), 1.1 * max(float(p.z[-1]) for p in drawn)

    def draw(number: int):
        film.left.clear()
        plot_cross_section(
            film.profiles[number], ax=film.left, units=units, limits=(0.0, 1.0), colourbar=False, dimensions=False
        )
        film.left.set_xlim(-width, width)
        film.left.set_ylim(-0.05 * top, top)
        film.left.set_title(film.titles[number], fontsize="medium")
        x, y = film.places[number]
        dot.set_data([x], [y])
        return []

    figure: Any = film.left.figure
    made = animation.FuncAnimation(figure, draw, frames=len(film.profiles))
    made.save(path, writer=_WRITERS[path.suffix], fps=max(1, round(len(film.profiles) / seconds)), dpi=80)
    plt.close(figure)
    return path


def _state(states: dict[str, np.ndarray], i: int) -> State:
    """The record of a state that `profile` needs: λa, p and q."""
    q, p, volume, apex, ratio = (float(states[n][i]) for n in _QUANTITIES)
    return State(q, p, volume, apex, np.nan, np.nan, ratio, 0, np.nan)
