"""The computed figures of Li et al. (2013), in the paper's layout; `paper` computes their data."""

from __future__ import annotations

import string
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import VHB_4910, ArrudaBoyce, Chamber, ConstantPressure, Gent, PointKind, stresses
from ..plot import (
    COLOURS,
    GAS,
    add_colour_bar,
    add_legend,
    axis_label,
    columns,
    draw_line,
    line_entries,
    line_entry,
    mathtext,
    new_figure,
    plot_chamber,
    plot_cross_section,
    plot_distribution,
    plot_membrane_curves,
    plot_pressure_volume,
    plot_voltage_volume,
    seen_entries,
    sequence,
    voltage_label,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["FIGURES", "PRINTED", "fits"]

#: matplotlib's settings for print: text of 8 points at the width of two columns, kept as text
PRINTED: dict[Any, Any] = {
    "font.size": 8.0,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}
_WIDTH = 7.2  # inches, 183 mm
_TANGENT = "#882255"


def _letters(axes: Iterable[Axes], titles: Sequence[str] = ()) -> None:
    """Writes (a), (b), … over the panels, with a title for each."""
    for number, ax in enumerate(axes):
        words = titles[number] if number < len(titles) else ""
        ax.set_title(f"({string.ascii_lowercase[number]})  {words}".rstrip(), loc="left", fontsize="medium")


def _states(axes: Sequence[Axes], diagram: Any) -> None:
    """Writes the paper's letters: A start, B snap, C landing, D the stable state without voltage that is expanded."""
    events = {(e.direction, e.event): e.state for e in diagram.events}
    places = {"A": ("up", "start"), "B": ("up", "snap"), "C": ("up", "landing")}
    states = {letter: events[place] for letter, place in places.items() if place in events}
    resting = [p for p in diagram.special_points if p.kind == PointKind.zero_voltage and p.index == 0]
    states["D"] = max(resting, key=lambda p: p.volume)
    # beside the curves on either side
    offsets = {"Apressure": (-14, -8), "Bpressure": (-1, 7), "Cpressure": (-3, 12), "Dpressure": (-6, 7)}
    offsets |= {"Bvoltage": (-4, 7), "Cvoltage": (7, -11)}
    style: dict[str, Any] = {"fontweight": "bold", "textcoords": "offset points", "zorder": 7}
    for ax, name in zip(axes, ("pressure", "voltage"), strict=True):
        for letter, state in states.items():
            at = (state.volume, getattr(state, name))
            ax.annotate(letter, at, xytext=offsets.get(letter + name, (6, 6)), **style)
        if name == "pressure" and not any(e.event == "end" for e in diagram.events):
            ax.plot(
                states["D"].volume,
                states["D"].pressure,
                "s",
                color="black",
                markerfacecolor="white",
                markersize=4,
                zorder=4,
            )


_BREAK = 8.0  # A³: the folds of the membrane without prestretch lie below, its expanded states far beyond
_NEAR = 0.4  # of the axis, for the volumes below


def _broken(ax: Axes) -> None:
    """Stretches the part of a long volume axis in which the membrane snaps; a dotted line shows where the scale changes."""
    right = ax.get_xlim()[1]
    low, high = _NEAR / _BREAK, (1 - _NEAR) / (right - _BREAK)

    def forward(volume: Any) -> np.ndarray:
        volume = np.asarray(volume, float)
        return np.where(volume < _BREAK, low * volume, _NEAR + high * (volume - _BREAK))

    def inverse(place: Any) -> np.ndarray:
        place = np.asarray(place, float)
        return np.where(place < _NEAR, place / low, _BREAK + (place - _NEAR) / high)

    ax.set_xscale("function", functions=(forward, inverse))
    ax.set_xlim(-0.02 / low, right)
    ax.set_xticks([0, 2, 4, 6, 8, *range(100, int(right), 100)])
    ax.axvline(_BREAK, color="0.6", linestyle=":", linewidth=0.9, zorder=0.5)


def _row(part: Any, paper: Any, diagram: Any, prestretch: float, voltages: Sequence[float]) -> Any:
    """Draws a row; returns the colour of its curve at the voltage of the snap, None where it has none."""
    curves = [paper.curve(v, prestretch) for v in voltages]
    plot_chamber(diagram, curves, figure=part)
    left, right = part.axes
    near = [b.pressure[b.volume < 0.75 * left.get_xlim()[1]] for b in curves[0].branches]
    left.set_ylim(top=max(left.get_ylim()[1], *(1.05 * float(np.max(p, initial=0)) for p in near)))
    snaps = [e.state.voltage for e in diagram.events if (e.event, e.direction) == ("snap", "up")]
    tangents = [paper.curve(v, prestretch) for v in snaps[:1] if isinstance(diagram.scene.loading, Chamber)]
    plot_membrane_curves(diagram, tangents, [_TANGENT] * len(tangents), ax=left)
    if left.get_xlim()[1] > 25 * _BREAK and prestretch == 1:
        for ax in (left, right):
            _broken(ax)
    for ax in (left, right):
        ax.get_legend().remove()
    return tangents


def _rows(paper: Any, scenes: Sequence[tuple[str, Any, float]], voltages: Sequence[float]) -> Figure:
    """A row for each scene: membrane curves with the line of the air, and voltage against volume; one legend below."""
    count = len(scenes)
    foot_height = 0.8
    figure = new_figure(_WIDTH, 2.3 * count + foot_height)
    rows: Any = figure.subfigures(count + 1, 1, height_ratios=[*[2.3] * count, foot_height])
    *parts, foot = rows
    axes, tangents = [], []
    for part, (_, diagram, prestretch) in zip(parts, scenes, strict=True):
        tangents += _row(part, paper, diagram, prestretch, voltages)
        axes += part.axes
    entries = [line_entry(voltage_label(v), colour=k) for v, k in zip(voltages, sequence(len(voltages)), strict=True)]
    if tangents:
        words = voltage_label(tangents[0].voltage) if count == 1 else f"{mathtext('Φ')} of the snap"
        entries.append(line_entry(f"{words}, tangent", colour=_TANGENT))
    held = isinstance(scenes[0][1].scene.loading, ConstantPressure)
    entries.append(line_entry("pressure held" if held else "air", colour="black", linestyle=GAS))
    entries += seen_entries(*axes)
    style = {
        "ncols": 5 if tangents else 6,
        "frameon": False,
        "fontsize": "small",
        "columnspacing": 1.2,
        "handlelength": 1.8,
    }
    foot.legend(*zip(*entries, strict=True), loc="upper center", **style)
    _letters(axes, [words for title, *_ in scenes for words in (title, "")])
    return figure


def fits(share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Equal-biaxial stretches up to a fraction of the limit, and nominal stresses of Gent and eight-chain (tension fit) in μ."""
    constants = VHB_4910["tension"]
    limit = np.sqrt((constants["stretch_limit"] + 3) / 2)
    stretch = np.linspace(1.0, share * limit, 400)
    gent, chain = Gent(constants["stretch_limit"]), ArrudaBoyce(constants["chain_links"])
    one, other = (np.asarray(stresses(m, stretch, stretch, 0.0)[0]) for m in (gent, chain))
    return stretch, one, other


def figure_3(paper: Any) -> Figure:
    """Gent against eight-chain, and the pressure–volume curve of the model."""
    figure = new_figure(_WIDTH, 3.0)
    left, right = figure.subplots(1, 2)
    modulus = VHB_4910["tension"]["shear_modulus"] / 1e3
    stretch, gent, chain = fits(0.985)
    mu, limit, links, volts = (mathtext(symbol) for symbol in ("μ", "J", "n", "Φ"))
    left.plot(stretch, modulus * gent, color=COLOURS[0], label=f"Gent, {mu} = 68 kPa, {limit} = 372")
    left.plot(stretch, modulus * chain, "--", color=COLOURS[5], label=f"eight-chain, {mu} = 68 kPa, {links} = 125")
    left.set_xlabel(f"{axis_label('stretch')} (equal-biaxial)")
    left.set_ylabel(axis_label("nominal_stress", paper.units))
    left.set_ylim(0, 6000)
    left.legend(frameon=False)
    plot_pressure_volume(paper.curve(0.0), ax=right, units=paper.units)
    _letters([left, right], ["", f"model alone: Gent, {mu} = 45 kPa, {limit} = 270, {volts} = 0"])
    return figure


def _held(pressure: float) -> str:
    return f"{mathtext('p')} = {pressure:g}"


def _chamber(volume: float) -> str:
    return f"{mathtext('V_C')} = {volume:g}, {mathtext('V₀')} = 2.42"


def figure_5(paper: Any) -> Figure:
    """Shapes, stretches and stresses of the membrane at p = 1.82, before the voltage and where it lands."""
    profiles = paper.profiles()
    figure = new_figure(_WIDTH, 8.5)
    panels = figure.subplots(3, 2).ravel()
    plot_cross_section(profiles["start"], ax=panels[0])
    plot_cross_section(profiles["landing"], ax=panels[1], colourbar=False)
    # the same shape of both panels, each at its own scale; the bar takes its space from all panels, which stay aligned
    scale = panels[0].get_xlim()[1] / panels[1].get_xlim()[1]
    panels[0].set_ylim(*(scale * height for height in panels[1].get_ylim()))
    add_colour_bar(panels[1], "breakdown_ratio", beside=list(panels), shrink=0.3, anchor=(0.0, 1.0), pad=0.02)
    for ax, name in zip(panels[2:], ("stretch_1", "stretch_2", "stress_1", "stress_2"), strict=True):
        labels = [f"{word}, {voltage_label(p.voltage_squared**0.5)}" for word, p in profiles.items()]
        plot_distribution(list(profiles.values()), name, ax=ax, labels=labels)
        ax.set_yscale("log" if name.startswith("stress") else "linear")
    _letters(
        panels, [f"{_held(1.82)}, {voltage_label(profiles[w].voltage_squared ** 0.5)}" for w in ("start", "landing")]
    )
    return figure


def _marked(paper: Any, title: str, diagram: Any) -> Figure:
    figure = _rows(paper, [(title, diagram, 1.0)], paper.voltages)
    _states(figure.axes, diagram)
    return figure


def figure_6(paper: Any) -> Figure:
    """Constant pressure 1.82."""
    return _marked(paper, _held(1.82), paper.held(1.82))


def figure_7(paper: Any) -> Figure:
    """Several pressures; the initial volumes are in the titles."""
    scenes = [(p, paper.held(p)) for p in (1.2, 1.5, 1.9, 2.0)]
    starts = [d.ramp().events[0].state.volume for _, d in scenes]
    return _rows(
        paper,
        [(f"{_held(p)}, {mathtext('V₀')} = {v:.4g}", d, 1.0) for (p, d), v in zip(scenes, starts, strict=True)],
        paper.voltages,
    )


def figure_8(paper: Any) -> Figure:
    """The chamber of volume 1600."""
    return _marked(paper, _chamber(1600.0), paper.chamber(1600.0))


def figure_9(paper: Any) -> Figure:
    """Chambers of four volumes."""
    volumes = (30.0, 800.0, 1600.0, 25000.0)
    return _rows(paper, [(_chamber(v), paper.chamber(v), 1.0) for v in volumes], paper.voltages)


def figure_10(paper: Any) -> Figure:
    """The model's pressure–volume curves at three prestretches on one opening, in mbar and ml."""
    figure = new_figure(_WIDTH / 2, 2.8)
    ax = figure.add_subplot()
    entries, branches = [], []
    for prestretch, colour in zip((1.0, 2.0, 3.0), COLOURS, strict=False):
        curve, units = paper.curve(0.0, prestretch), paper.units_at(prestretch)
        for number, branch in enumerate(units.read(curve.branches)):
            points = [p for p in units.read(curve.special_points) if p.branch == number]
            volume, pressure, broken, stable = columns(branch, "pressure", points)
            draw_line(ax, volume, pressure, stable, broken, colour=colour)
            branches.append(branch)
        entries.append(line_entry(f"prestretch {mathtext('λ₀')} = {prestretch:g}", colour=colour))
    add_legend(ax, [*entries, *line_entries(branches)])
    ax.set(
        xlim=(0, 400),
        ylim=(0, 60),
        xlabel=axis_label("volume", paper.units),
        ylabel=axis_label("pressure", paper.units),
    )
    ax.set_title(f"The model at {voltage_label(0.0)}, opening of radius 22.5 mm", loc="left", fontsize="medium")
    return figure


def figure_11(paper: Any) -> Figure:
    """Three prestretches."""
    cases = [(1.0, 1.82), (2.0, 1.0), (3.0, 0.5)]
    return _rows(
        paper, [(f"{mathtext('λ₀')} = {w:g}, {_held(p)}", paper.held(p, w), w) for w, p in cases], (0.0, 0.1, 0.2)
    )


def figure_12(paper: Any) -> Figure:
    """The model's predictions for the experiment's chambers, in kV and ml; (a), not drawn, only shows the experiment over time."""
    figure = new_figure(_WIDTH, 3.3)
    rows: Any = figure.subfigures(2, 1, height_ratios=[2.6, 0.6])
    axes = rows[0].subplots(1, 3)
    for ax, letter, litres in zip(axes, "bcd", (0.35, 20.0, 300.0), strict=True):
        plot_voltage_volume(paper.experiment(litres), ax=ax, legend=False)
        ax.set_title(f"({letter})  {litres:g} L", loc="left", fontsize="medium")
    entries = seen_entries(*axes)
    rows[1].legend(*zip(*entries, strict=True), loc="upper center", ncols=5, frameon=False, fontsize="small")
    rows[0].suptitle(
        f"The model's prediction with {mathtext('V₀')} = 12 ml (22.8 mbar in the model; the paper reports 19 mbar)",
        fontsize="medium",
    )
    return figure


FIGURES = {
    "3": figure_3,
    "5": figure_5,
    "6": figure_6,
    "7": figure_7,
    "8": figure_8,
    "9": figure_9,
    "10": figure_10,
    "11": figure_11,
    "12": figure_12,
}
