"""The parts of figures: lines by stability, markers of points and events, entries of a legend."""

from __future__ import annotations

import itertools
import re
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import Branch, Event, PointKind, RampEvent, SpecialPoint, State, parameter_of
from ..numerics import Code

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "BRANCHES",
    "COLOURS",
    "GAS",
    "add_legend",
    "axis_label",
    "columns",
    "draw_cones",
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
    "same_state",
    "seen_entries",
    "sequence",
    "viewed",
    "voltage_label",
    "voltage_text",
]

# Okabe and Ito's colours, which colour-blind readers can distinguish
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000")
_UP, _DOWN = "#D55E00", "#56B4E9"
# branches take colours that stay visible where they are pale, and that no ramp has
BRANCHES = ("#0072B2", "#009E73", "#AA4499", "#000000")
_PALE = 0.45
_UNSTABLE = (0, (3.2, 1.8))
GAS = (0, (7.0, 3.0))

# quantities of results that are no parameters: words, symbol, dimensionless unit
_QUANTITIES = {
    "voltage": ("voltage", "Φ", "H√(μ/ε)"),
    "voltage_squared": ("voltage squared", "Φ²", "H²μ/ε"),
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
    "index": ("number of unstable directions", "", ""),
    "error_estimate": ("estimated relative error", "", ""),
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
    "mode": ("*", "white", "neutral mode"),
}
# event of a ramp: (marker, label)
_EVENTS = {
    "start": ("o", "start"),
    "landing": ("D", "landing"),
    "breakdown": ("X", "breakdown of the ramp"),
    "no_landing": ("^", "snap without landing"),
    "end": (">", "end of the ramp"),
}
_JUMPS = {"snap": "snap", "snap_back": "snap back"}
_CONE = "end at a conical apex"


def new_figure(width: float, height: float = 4.6) -> Figure:
    """A new figure of a size in inches, which pyplot shows, and a notebook shows once."""
    import matplotlib.pyplot as plt

    from .notebook_figure import NotebookFigure

    return plt.figure(FigureClass=NotebookFigure, figsize=(width, height), layout="constrained")


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

    `name` and `across` may be any two columns of a branch. The located folds and the onset of breakdown are inserted, because
    otherwise two line styles would join beside the turn. Near q = 0 the states are evenly spaced in q, so that Φ = √q would
    begin as a straight chord: that cell is refined, which is accurate enough because V is smooth in q.
    """
    volume, value = _values(branch, across), _values(branch, name)
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
    load = {name: value, across: volume}
    for q in (load[n] for n in ("voltage_squared", "charge_squared") if n in load):
        for cell in np.flatnonzero((q[1:] >= 0) != (q[:-1] >= 0)).tolist():
            zero = q[cell] / (q[cell] - q[cell + 1])
            reached = 1.0 if q[cell + 1] >= 0 else 0.0
            for s in zero + (reached - zero) * np.linspace(0, 1, 12)[:-1] ** 2:
                state = _between(cell, s, volume, value)
                at.append(cell + s)
                extra.append(tuple(max(v, 0.0) if w is q else v for v, w in zip(state, (volume, value), strict=True)))
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
            place, height = (p.charge**2 if n == "charge_squared" else float(getattr(p, n)) for n in (across, name))
            if not np.isfinite([place, height]).all():
                break
            return cell + before / ((before + after) or 1.0), place, height
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
            alpha=_PALE if broken[start] else 1.0,
            label=_named("stable" if stable[start] else "unstable", *["beyond breakdown"] * bool(broken[start])),
        )


def draw_cones(ax: Axes, branches: Iterable[Branch], name: str, colour: Any, across: str = "volume") -> None:
    """Marks the ends of branches at which the apex sharpens to a cone: there are no states to draw further on.

    A film that is nearly flat, stable and below breakdown, has no cone to show: its curve only begins there.
    """
    for branch in branches:
        for place, code in ((0, branch.start), (-1, branch.end)):
            if code == Code.apex_cone and (branch.breakdown_ratio[place] >= 1 or branch.index[place] > 0):
                at = (getattr(branch, across)[place], getattr(branch, name)[place])
                ax.plot(*at, ".", color=colour, alpha=_PALE, markersize=_size(6), zorder=2.4, label=_named(_CONE))


def _named(*words: str) -> str:
    """The label of an artist whose meaning `seen_entries` explains; matplotlib's own legends leave it out."""
    return "_" + ", ".join(words)


def _size(points: float) -> float:
    """A size of a marker, which follows that of the text."""
    import matplotlib

    return points * matplotlib.rcParams["font.size"] / 10


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
        size = _size(7 if p.kind == PointKind.breakdown else 5)
        style |= {"markersize": size, "markeredgewidth": 1.0, "zorder": 4, "label": _named(_POINTS[p.kind][2])}
        ax.plot(getattr(p, across), getattr(p, name), marker, **style)


def draw_events(
    ax: Axes,
    events: Sequence[Event],
    name: str,
    *,
    across: str = "volume",
    gas_line: Callable[[np.ndarray], np.ndarray] | None = None,
) -> None:
    """Draws markers at the events and an arrow for each jump: horizontal in voltage, along the line of the air in pressure."""
    shown = [e for e in events if e.event in _EVENTS and (e.event, e.direction) != (RampEvent.start, "down")]
    for event, following in itertools.zip_longest(events, events[1:]):
        jumps = event.event in (RampEvent.snap, RampEvent.snap_back)
        if jumps and following is not None and following.event == RampEvent.landing:
            _draw_jump(ax, event, following, name, across, gas_line)
    for number, event in enumerate(shown):
        # the marker of a state with several events is a ring around the next one
        more = sum(same_state(event.state, other.state) for other in shown[number + 1 :])
        colour = _colour(event)
        marker, word = _EVENTS[event.event]
        ax.plot(
            *(getattr(event.state, across), getattr(event.state, name)),
            marker,
            color=colour,
            markerfacecolor="white" if more else colour,
            markeredgecolor=colour if more else "white",
            markeredgewidth=1.0 if more else 0.7,
            markersize=_size((9 if event.event == RampEvent.breakdown else 6.5) + 5 * more),
            zorder=3.9 - 0.01 * more if more else 5,
            label=_named(word if event.direction == "up" else f"{word} down" if word == "end of the ramp" else word),
        )


def same_state(one: State, other: State) -> bool:
    """Whether two records are of the same state."""
    near = abs(one.apex_stretch - other.apex_stretch) <= 1e-6 * other.apex_stretch
    return near and abs(one.volume - other.volume) <= 1e-6 * max(one.volume, other.volume)


def _colour(event: Event) -> str:
    return _UP if event.direction == "up" else _DOWN


def _draw_jump(
    ax: Axes,
    snap: Event,
    landed: Event,
    name: str,
    across: str,
    gas_line: Callable[[np.ndarray], np.ndarray] | None,
) -> None:
    state, landing, colour = snap.state, landed.state, _colour(snap)
    volume = np.linspace(getattr(state, across), getattr(landing, across), 60)
    if gas_line is None:
        level = np.linspace(getattr(state, name), getattr(landing, name), 60)
    else:
        level = np.asarray(gas_line(volume))
    ax.plot(volume, level, color=colour, linewidth=_size(2.0), zorder=3, label=_named(_JUMPS[snap.event]))
    style = {
        "arrowstyle": "-|>",
        "color": colour,
        "linewidth": _size(2.0),
        "shrinkA": 0,
        "shrinkB": 0,
        "mutation_scale": _size(14),
    }
    ax.annotate("", xy=(volume[36], level[36]), xytext=(volume[33], level[33]), arrowprops=style, zorder=3)


def line_entry(label: str, **style: Any) -> tuple[Any, str]:
    """An entry of a legend: a handle and its label."""
    from matplotlib.lines import Line2D

    colour = style.pop("colour", "0.25")
    return Line2D([], [], color=colour, **style), label


def _entries() -> dict[str, Any]:
    """The handles of everything that a legend explains, by its words."""
    handles: dict[str, dict[str, Any]] = {
        "stable": {},
        "unstable": {"linestyle": _UNSTABLE},
        "beyond breakdown": {"alpha": _PALE},
        _CONE: {"marker": ".", "linestyle": "None", "markersize": _size(6), "alpha": _PALE},
    }
    for marker, face, word in _POINTS.values():
        handles[word] = {"colour": "black", "marker": marker, "linestyle": "None", "markersize": _size(5)}
        handles[word] |= {} if face is None else {"markerfacecolor": face}
    markers = {"linestyle": "None", "markersize": _size(6.5)}
    for marker, word in _EVENTS.values():
        handles[word] = {"colour": _UP, "marker": marker} | markers
    handles["snap"], handles["snap back"] = {"colour": _UP}, {"colour": _DOWN}
    handles["end of the ramp down"] = {"colour": _DOWN, "marker": _EVENTS["end"][0]} | markers
    return {word: line_entry(word, **style)[0] for word, style in handles.items()}


def _chosen(words: Iterable[str]) -> list[tuple[Any, str]]:
    """The entries of these words, in the order of `_entries`."""
    wanted = set(words)
    return [(handle, word) for word, handle in _entries().items() if word in wanted]


def seen_entries(*axes: Axes) -> list[tuple[Any, str]]:
    """The entries of the lines and markers that lie inside the limits of these axes."""
    words = set()
    for ax in axes:
        for line in ax.lines:
            label = str(line.get_label())
            if label.startswith("_") and _inside(ax, line):
                words.update(label[1:].split(", "))
    return _chosen(words)


def _inside(ax: Axes, line: Any) -> bool:
    """Whether a line has a point inside the limits of its axes."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    return bool(np.any((left <= x) & (x <= right) & (bottom <= y) & (y <= top)))


def line_entries(branches: Sequence[Branch]) -> list[tuple[Any, str]]:
    """The line styles that these branches use."""
    index = np.concatenate([np.asarray(b.index, float) for b in branches]) if branches else np.zeros(0)
    ratio = np.concatenate([np.asarray(b.breakdown_ratio, float) for b in branches]) if branches else np.zeros(0)
    used = {"stable": index == 0, "unstable": index > 0, "beyond breakdown": ratio >= 1}
    return _chosen(word for word, there in used.items() if np.any(there))


def point_entries(points: Sequence[SpecialPoint]) -> list[tuple[Any, str]]:
    """The markers that these special points use."""
    return _chosen(_POINTS[p.kind][2] for p in points)


def event_entries(events: Sequence[Event]) -> list[tuple[Any, str]]:
    """The markers and lines that these events use."""
    words = [_JUMPS[e.event] for e in events if e.event in _JUMPS]
    words += [_EVENTS[e.event][1] for e in events if e.event in _EVENTS and e.direction == "up"]
    down = [f"{_EVENTS['end'][1]} down" for e in events if e.event == RampEvent.end and e.direction == "down"]
    return _chosen([*words, *down])


def add_legend(ax: Axes, entries: Sequence[tuple[Any, str]]) -> None:
    """Adds the legend of these entries: in the axes where no curve is in its way, and otherwise beside them."""
    handles, labels = zip(*entries, strict=True) if entries else ((), ())
    legend = ax.legend(handles, labels, frameon=False, fontsize="small", loc="best")
    if labels and _covers(ax, legend):
        ax.legend(handles, labels, frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _covers(ax: Axes, legend: Any) -> bool:
    """Whether a legend lies on a line or a marker of its axes."""
    from matplotlib.path import Path

    drawn: Any = ax.figure
    drawn.canvas.figure.draw_without_rendering()  # the whole figure, also where the axes are on a part of it
    box = legend.get_window_extent()
    for line in ax.lines:
        places = line.get_transform().transform(np.asarray(line.get_xydata(), float))
        for run in np.ma.clump_unmasked(np.ma.masked_invalid(places.sum(axis=1))):
            if Path(places[run]).intersects_bbox(box, filled=False):
                return True
    return False
