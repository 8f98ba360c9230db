"""The computed figures of Li et al. (2013), in the paper's layout; `paper` computes their data."""

from __future__ import annotations

import string
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..model import VHB_4910, ArrudaBoyce, Gent, stresses
from ..plot import (
    COLOURS,
    add_legend,
    axis_label,
    columns,
    draw_line,
    event_entries,
    line_entries,
    line_entry,
    mathtext,
    new_figure,
    plot_chamber,
    plot_cross_section,
    plot_distribution,
    plot_pressure_volume,
    plot_voltage_volume,
    point_entries,
    voltage_label,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["FIGURES", "PRINTED", "fits"]

#: matplotlib's settings for print: text of 8 points at the width of two columns, kept as text
PRINTED: dict[Any, Any] = {"font.size": 8.0, "pdf.fonttype": 42, "svg.fonttype": "none"}
_WIDTH = 7.2  # inches, 183 mm


def _letters(axes: Iterable[Axes], titles: Sequence[str] = ()) -> None:
    """Writes (a), (b), … over the panels, with a title for each."""
    for number, ax in enumerate(axes):
        words = titles[number] if number < len(titles) else ""
        ax.set_title(f"({string.ascii_lowercase[number]})  {words}".rstrip(), loc="left", fontsize="medium")


def _states(axes: Sequence[Axes], diagram: Any) -> None:
    """Writes the paper's letters at the states of a ramp: A start, B snap, C landing, D zero voltage on the way back."""
    events = {(e.direction, e.event): e.state for e in diagram.events}
    places = {"A": ("up", "start"), "B": ("up", "snap"), "C": ("up", "landing"), "D": ("down", "end")}
    below = (
        "Apressure",
        "Cvoltage",
    )  # A and B lie close together on the line of the air; C lies beside markers of the curve
    style: dict[str, Any] = {"fontweight": "bold", "textcoords": "offset points", "zorder": 7}
    for ax, name in zip(axes, ("pressure", "voltage"), strict=True):
        for letter, place in places.items():
            if place in events:
                at = (events[place].volume, getattr(events[place], name))
                ax.annotate(letter, at, xytext=(8, -14) if letter + name in below else (6, 7), **style)


def _rows(paper: Any, scenes: Sequence[tuple[str, Any, float]], voltages: Sequence[float]) -> Figure:
    """A row for each scene: membrane curves with the line of the air, and voltage against volume; one legend below."""
    count = len(scenes)
    figure = new_figure(_WIDTH, 2.5 * count + 0.6)
    rows: Any = figure.subfigures(count + 1, 1, height_ratios=[*[2.5] * count, 0.6])
    *parts, foot = rows
    axes = []
    for part, (_, diagram, prestretch) in zip(parts, scenes, strict=True):
        curves = [paper.curve(v, prestretch) for v in voltages]
        plot_chamber(diagram, curves, figure=part)
        left = part.axes[0]
        near = [b.pressure[b.volume < 0.75 * left.get_xlim()[1]] for b in curves[0].branches]
        left.set_ylim(top=max(left.get_ylim()[1], *(1.05 * float(np.max(p, initial=0)) for p in near)))
        axes += part.axes
    for ax in axes[1::2]:
        ax.get_legend().remove()
    diagrams = [diagram for _, diagram, _ in scenes]
    entries = [
        *line_entries([b for d in diagrams for b in d.branches]),
        *point_entries([p for d in diagrams for p in d.special_points]),
        *event_entries([e for d in diagrams for e in d.events]),
    ]
    foot.legend(*zip(*entries, strict=True), loc="center", ncols=6, frameon=False, fontsize="small")
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
    plot_cross_section(profiles["landing"], ax=panels[1])
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
    ax.set_title(
        f"The model's prediction, {voltage_label(0.0)}, opening of radius 22.5 mm", loc="left", fontsize="medium"
    )
    return figure


def figure_11(paper: Any) -> Figure:
    """Three prestretches."""
    cases = [(1.0, 1.82), (2.0, 1.0), (3.0, 0.5)]
    return _rows(
        paper, [(f"{mathtext('λ₀')} = {w:g}, {_held(p)}", paper.held(p, w), w) for w, p in cases], (0.0, 0.1, 0.2)
    )


def figure_12(paper: Any) -> Figure:
    """The model's predictions for the experiment's chambers, in kV and ml; (a), not drawn, only shows the experiment over time."""
    figure = new_figure(_WIDTH, 2.8)
    axes = figure.subplots(1, 3)
    for ax, letter, litres in zip(axes, "bcd", (0.35, 20.0, 300.0), strict=True):
        plot_voltage_volume(paper.experiment(litres), ax=ax)
        ax.set_title(f"({letter})  {litres:g} L", loc="left", fontsize="medium")
    figure.suptitle(
        f"The model's prediction with {mathtext('V₀')} = 12 ml (22.8 mbar in the model; the paper reports 19 mbar)"
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
