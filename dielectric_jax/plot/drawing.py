"""The parts of figures: lines by stability, markers of points and events, entries of a legend."""

from __future__ import annotations

import itertools
import re
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import Branch, Event, PointKind, RampEvent, SpecialPoint, State, parameter_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "GAS",
    "add_legend",
    "axis_label",
    "columns",
    "draw_events",
    "draw_line",
    "draw_points",
    "event_entries",
    "labelled",
    "line_entries",
    "line_entry",
    "mathtext",
    "new_axes",
    "new_figure",
    "parameter_axis",
    "point_entries",
    "sequence",
    "viewed",
    "voltage_label",
    "voltage_text",
]

# Okabe and Ito's colours, which colour-blind readers can distinguish
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000")
_UP, _DOWN = "#D55E00", "#56B4E9"
_UNSTABLE = (0, (3.2, 1.8))
GAS = (0, (7.0, 3.0))

# quantities of results that are no parameters: words, symbol, dimensionless unit
_QUANTITIES = {
    "voltage": ("voltage", "Φ", "H√(μ/ε)"),
    "charge": ("charge", "Q", "A²√(εμ)"),
    "radius": ("undeformed radius", "R", "A"),
    "r": ("radius", "r", "A"),
    "z": ("depth below the apex", "z", "A"),
    "height": ("height", "", "A"),
    "stretch": ("stretch", "λ", ""),
    "stretch_1": ("meridional stretch", "λ₁", ""),
    "stretch_2": ("hoop stretch", "λ₂", ""),
    "stress": ("true stress", "σ", "μ"),
    "stress_1": ("meridional stress", "σ₁", "μ"),
    "stress_2": ("hoop stress", "σ₂", "μ"),
    "nominal_stress": ("nominal stress", "s", "μ"),
    "field": ("electric field", "E", "√(μ/ε)"),
    "breakdown_ratio": ("breakdown ratio", "E/E_EB", ""),
    "apex_stretch": ("apex stretch", "λ_a", ""),
    "time": ("time", "t", ""),
    "rate": ("rate", "dΦ/dt", ""),
}
_SMALL = str.maketrans({"²": "^2", "³": "^3", "₀": "_0", "₁": "_1", "₂": "_2", "ᵢ": "_i"})

# kind of a special point: (marker, face, label)
_POINTS = {
    "fold": ("o", "white", "fold"),
    "zero_voltage": ("s", "white", "zero voltage"),
    "breakdown": ("x", None, "breakdown"),
    "hoop_tension_loss": ("v", "white", "hoop tension lost"),
    "slack": ("D", "white", "slack"),
}
# event of a ramp: (marker, label)
_EVENTS = {
    "start": ("o", "start"),
    "landing": ("D", "landing"),
    "breakdown": ("X", "breakdown of the ramp"),
    "no_landing": ("^", "snap without landing"),
    "end": (">", "end of the ramp"),
}


def new_figure(width: float, height: float = 4.6) -> Figure:
    """A new figure of a size in inches."""
    import matplotlib.pyplot as plt

    return plt.figure(figsize=(width, height), layout="constrained")


def new_axes(ax: Axes | None, width: float = 6.0) -> Axes:
    """The axes to draw on; new ones when None."""
    return new_figure(width).add_subplot() if ax is None else ax


def mathtext(text: str) -> str:
    r"""A symbol or a dimensionless unit as matplotlib's mathtext; words, such as the names of a user's constants, stay words.

    >>> print(mathtext("V_C"), mathtext("H√(μ/ε)"), mathtext("A³"), mathtext("my_constant"))
    $V_{\mathrm{C}}$ $H\sqrt{μ/ε}$ $A^3$ my_constant
    """
    symbol, of, owner = text.partition(" of ")
    if not symbol or re.match(r"[a-z]{2}", symbol):
        return text
    words = re.sub(r"(?<![a-z_])([a-z]{3,})", r"\\mathrm{\1}", symbol)
    upright = re.sub(r"_(\w+)", r"_{\\mathrm{\1}}", words)
    rooted = re.sub(r"√\((.*?)\)", r"\\sqrt{\1}", upright)
    return f"${rooted.translate(_SMALL)}$" + of + owner


def labelled(words: str, symbol: str = "", unit: str = "", *, dimensionless: bool = True) -> str:
    r"""The label of an axis: words, symbol, and unit; a `dimensionless` unit is a symbol itself.

    >>> print(labelled("chamber volume", "V_C", "L", dimensionless=False))
    Chamber volume $V_{\mathrm{C}}$ / L
    """
    if unit and dimensionless:
        unit = f"({mathtext(unit)})" if re.search("[/√]", unit) else mathtext(unit)
    known = symbol and symbol.replace("_", " ") != words  # the constant of a user's material has its name only
    named = f"{words} {mathtext(symbol)}" if known else words
    return named[0].upper() + named[1:] + (f" / {unit}" if unit else "")


def axis_label(name: str, units: Any = None) -> str:
    """Name, symbol and unit of a quantity."""
    if name in _QUANTITIES:
        words, symbol, unit = _QUANTITIES[name]
    else:
        row = parameter_of(name)
        words, symbol, unit = row.words, row.symbol, row.figure_unit
    read = "" if units is None else units.read_name("stress" if "stress" in name else name)
    return labelled(words, symbol, read or unit, dimensionless=not read)


def parameter_axis(name: str, units: Any = None) -> tuple[str, float]:
    """The label of a parameter's axis, and what its values are multiplied with to be in the unit of the label.

    With `units` a pressure or a volume, which is then in SI, is shown as people read it, in mbar, ml or L.
    """
    row = parameter_of(name)
    if units is not None and row.kind in ("pressure", "volume"):
        label = labelled(row.words, row.symbol, units.read_name(name), dimensionless=False)
        return label, float(units.read(1.0, name) / units.to_si(1.0, name))
    return labelled(row.words, row.symbol, row.figure_unit, dimensionless=row.unit != row.figure_unit), 1.0


def voltage_text(voltage: float, units: Any = None) -> str:
    """Φ = … of a voltage that is already converted to the units shown, in plain text."""
    return f"Φ = {voltage:.4g}" + ("" if units is None else f" {units.read_name('voltage')}")


def voltage_label(voltage: float, units: Any = None) -> str:
    """`voltage_text` for a figure."""
    return voltage_text(voltage, units).replace("Φ", mathtext("Φ"))


def viewed(diagram: Any, units: Any = None) -> tuple[Any, Any]:
    """The diagram converted to the units to be shown, and these units: those given, or else those of the scene."""
    units = getattr(diagram.scene, "units", None) if units is None else units
    if units is None:
        return diagram, None
    loading = diagram.scene.loading

    def gas_pressure(volume: np.ndarray) -> np.ndarray | None:
        held = diagram.gas_pressure(volume / units.read(1.0, "volume"))
        return None if held is None else units.read(held, "pressure")

    view = types.SimpleNamespace(
        kind=diagram.kind,
        scene=types.SimpleNamespace(loading=units.read(loading), units=units),
        branches=units.read(diagram.branches),
        special_points=units.read(diagram.special_points),
        events=units.read(diagram.events),
        voltage=None if diagram.voltage is None else units.read(float(diagram.voltage), "voltage"),
        gas_pressure=gas_pressure,
    )
    return view, units


def sequence(count: int) -> list[Any]:
    """Colours for an ordered quantity, from dark to light."""
    import matplotlib

    colours = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.82, max(count, 2)))
    return [tuple(c) for c in colours[:count]]


def columns(
    branch: Branch, name: str, points: Sequence[SpecialPoint], across: str = "volume"
) -> tuple[np.ndarray, ...]:
    """Volume and q, Q² or p along a branch, and for each cell between two points whether it is beyond breakdown and stable.

    `across` names another quantity in place of the volume. The located folds and the onset of breakdown are inserted, because
    otherwise two line styles would join beside the turn. Near q = 0 the states are evenly spaced in q, so that Φ = √q would
    begin as a straight chord: that cell is refined, which is accurate enough because V is smooth in q.
    """
    volume, value = np.asarray(getattr(branch, across), float), _values(branch, name)
    ratio = np.nan_to_num(np.asarray(branch.breakdown_ratio, float))
    broken, stable = ratio >= 1, np.asarray(branch.index, float) == 0
    at, extra = list(np.arange(len(volume), dtype=float)), []
    turns, onsets = np.full((2, max(len(volume) - 1, 0)), np.nan)
    for cell in np.flatnonzero(stable[1:] != stable[:-1]).tolist():
        turns[cell], *state = _turn(branch, cell, name, points, volume, value, across)
        at.append(turns[cell])
        extra.append(state)
    for cell in np.flatnonzero(broken[1:] != broken[:-1]).tolist():
        s = (1 - ratio[cell]) / (ratio[cell + 1] - ratio[cell])
        onsets[cell] = cell + s
        at.append(onsets[cell])
        extra.append(_between(cell, s, volume, value))
    if name in ("voltage_squared", "charge_squared"):
        for cell in np.flatnonzero((value[1:] >= 0) != (value[:-1] >= 0)).tolist():
            zero = value[cell] / (value[cell] - value[cell + 1])
            reached = 1.0 if value[cell + 1] >= 0 else 0.0
            for s in zero + (reached - zero) * np.linspace(0, 1, 12)[:-1] ** 2:
                v, q = _between(cell, s, volume, value)
                at.append(cell + s)
                extra.append((v, max(q, 0.0)))
    order = np.argsort(at, kind="stable")
    at = np.asarray(at)[order]
    middle = (at[1:] + at[:-1]) / 2
    volume = np.concatenate([volume, [e[0] for e in extra]])[order]
    value = np.concatenate([value, [e[1] for e in extra]])[order]
    return volume, value, _side(broken, onsets, middle), _side(stable, turns, middle)


def _values(branch: Branch, name: str) -> np.ndarray:
    """A quantity along a branch; "charge_squared" is q C², where for q ≤ 0 C is taken from the nearest state with q > 0."""
    if name != "charge_squared":
        return np.asarray(getattr(branch, name), float)
    q, charge = np.asarray(branch.voltage_squared, float), np.asarray(branch.charge, float)
    known = q > 0
    if not known.any():
        return q
    place = np.arange(len(q), dtype=float)
    return q * np.interp(place, place[known], charge[known] ** 2 / q[known])


def _side(values: np.ndarray, changes: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The value at fractional positions: that of one end of the cell, depending on the side of the change in the cell."""
    cell = np.floor(middle).astype(int)
    return np.where(middle < changes[cell], values[cell], values[cell + 1])


def _between(cell: int, s: float, *columns: np.ndarray) -> tuple[float, ...]:
    return tuple(float((1 - s) * c[cell] + s * c[cell + 1]) for c in columns)


def _turn(
    branch: Branch,
    cell: int,
    name: str,
    points: Sequence[SpecialPoint],
    volume: np.ndarray,
    value: np.ndarray,
    across: str,
) -> tuple[float, float, float]:
    """Position, volume and value where the stability changes: the located fold if the cell has one, or else its middle."""
    ends = np.array([[branch.volume[i], branch.apex_stretch[i]] for i in (cell, cell + 1)], float)
    room = 1e-9 * (1 + np.abs(ends).max(axis=0))
    low, high = ends.min(axis=0) - room, ends.max(axis=0) + room
    for p in points:
        here = np.array([p.volume, p.apex_stretch])
        if p.kind == PointKind.fold and np.all(low <= here) and np.all(here <= high):
            before, after = (float(np.linalg.norm(here - end)) for end in ends)
            height = p.charge**2 if name == "charge_squared" else float(getattr(p, name))
            if not np.isfinite(height):
                break
            return cell + before / ((before + after) or 1.0), float(getattr(p, across)), height
    v, y = _between(cell, 0.5, volume, value)
    return cell + 0.5, v, y


def draw_line(ax: Axes, x: np.ndarray, y: np.ndarray, stable: np.ndarray, broken: np.ndarray, *, colour: Any) -> None:
    """Draws runs of cells in one style; `stable` and `broken` refer to cells, one fewer than points."""
    for start, stop in _runs(2 * stable.astype(int) + broken.astype(int)):
        ax.plot(
            x[start : stop + 1],
            y[start : stop + 1],
            color=colour,
            linestyle="-" if stable[start] else _UNSTABLE,
            alpha=0.35 if broken[start] else 1.0,
            linewidth=1.6,
        )


def _runs(keys: np.ndarray) -> Iterator[tuple[int, int]]:
    """Start and stop of each run of equal keys."""
    edges = [0, *(np.flatnonzero(np.diff(keys)) + 1), len(keys)]
    return ((int(a), int(b)) for a, b in itertools.pairwise(edges) if b > a)


def draw_points(ax: Axes, points: Iterable[SpecialPoint], name: str, across: str = "volume") -> None:
    """Draws the marker of each special point; `name` is the quantity on the vertical axis, `across` on the horizontal one."""
    for p in points:
        marker, face, _ = _POINTS[p.kind]
        style: dict[str, Any] = (
            {"color": "black"} if face is None else {"markerfacecolor": face, "markeredgecolor": "black"}
        )
        size = 7 if p.kind == PointKind.breakdown else 5
        ax.plot(getattr(p, across), getattr(p, name), marker, markersize=size, markeredgewidth=1.2, zorder=4, **style)


def draw_events(
    ax: Axes,
    events: Sequence[Event],
    name: str,
    *,
    across: str = "volume",
    gas_line: Callable[[np.ndarray], np.ndarray] | None = None,
) -> None:
    """Draws markers at the events and an arrow for each jump: horizontal in voltage, along the line of the air in pressure."""
    for event, following in itertools.zip_longest(events, events[1:]):
        colour = _UP if event.direction == "up" else _DOWN
        state = event.state
        if (
            event.event in (RampEvent.snap, RampEvent.snap_back)
            and following is not None
            and following.event == RampEvent.landing
        ):
            _draw_jump(ax, state, following.state, name, across, colour, gas_line)
        if event.event in _EVENTS and not (event.event == RampEvent.start and event.direction == "down"):
            size = 9 if event.event == RampEvent.breakdown else 6.5
            ax.plot(
                *(getattr(state, across), getattr(state, name)),
                _EVENTS[event.event][0],
                color=colour,
                markeredgecolor="white",
                markeredgewidth=0.7,
                markersize=size,
                zorder=5,
            )


def _draw_jump(
    ax: Axes,
    state: State,
    landing: State,
    name: str,
    across: str,
    colour: str,
    gas_line: Callable[[np.ndarray], np.ndarray] | None,
) -> None:
    volume = np.linspace(getattr(state, across), getattr(landing, across), 60)
    if gas_line is None:
        level = np.linspace(getattr(state, name), getattr(landing, name), 60)
    else:
        level = np.asarray(gas_line(volume))
    ax.plot(volume, level, color=colour, linewidth=2.2, zorder=3)
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.2, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 15}
    ax.annotate("", xy=(volume[36], level[36]), xytext=(volume[33], level[33]), arrowprops=style, zorder=3)


def line_entry(label: str, **style: Any) -> tuple[Any, str]:
    """An entry of a legend: a handle and its label."""
    from matplotlib.lines import Line2D

    colour = style.pop("colour", "0.25")
    return Line2D([], [], color=colour, linewidth=1.6, **style), label


def line_entries(branches: Sequence[Branch]) -> list[tuple[Any, str]]:
    """The line styles that these branches use."""
    index = np.concatenate([np.asarray(b.index, float) for b in branches]) if branches else np.zeros(0)
    ratio = np.concatenate([np.asarray(b.breakdown_ratio, float) for b in branches]) if branches else np.zeros(0)
    entries = []
    if np.any(index == 0):
        entries.append(line_entry("stable"))
    if np.any(index > 0):
        entries.append(line_entry("unstable", linestyle=_UNSTABLE))
    if np.any(ratio >= 1):
        entries.append(line_entry("beyond breakdown", alpha=0.35))
    return entries


def point_entries(points: Sequence[SpecialPoint]) -> list[tuple[Any, str]]:
    """The markers that these special points use."""
    entries = []
    for kind, (marker, face, word) in _POINTS.items():
        if any(p.kind == kind for p in points):
            entry = line_entry(word, colour="black", marker=marker, linestyle="None", markersize=5)
            if face is not None:
                entry[0].set_markerfacecolor(face)
            entries.append(entry)
    return entries


def event_entries(events: Sequence[Event]) -> list[tuple[Any, str]]:
    """The markers and lines that these events use."""
    entries = []
    for name, (marker, word) in _EVENTS.items():
        if any(e.event == name and e.direction == "up" for e in events):
            entries.append(line_entry(word, colour=_UP, marker=marker, linestyle="None", markersize=6.5))
    if any(e.event == RampEvent.snap for e in events):
        entries.append(line_entry("snap", colour=_UP))
    if any(e.event == RampEvent.snap_back for e in events):
        entries.append(line_entry("snap back", colour=_DOWN))
    if any(e.event == RampEvent.end and e.direction == "down" for e in events):
        entries.append(line_entry("end of the ramp down", colour=_DOWN, marker=">", linestyle="None", markersize=6.5))
    return entries


def add_legend(ax: Axes, entries: Sequence[tuple[Any, str]]) -> None:
    """Adds the legend of these entries."""
    handles, labels = zip(*entries, strict=True) if entries else ((), ())
    ax.legend(handles, labels, frameon=False, fontsize="small", loc="best")
