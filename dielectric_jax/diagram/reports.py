"""What a scene does, in words: the report that the command line prints first, with its tables and its picture."""

import dataclasses
import html
import itertools
import typing
from collections.abc import Iterable

import numpy as np

from ..model import (
    ConstantVoltage,
    Event,
    PointKind,
    PrescribedVolume,
    RampEvent,
    Regime,
    Scene,
    SpecialPoint,
    Units,
    column_heads,
    control_of,
    explain,
    mechanical,
    profile,
    text_table,
)
from ..numerics import SceneError
from ..plot import chamber_voltages, plot_chamber, plot_diagram
from ..surface import Surface
from .diagrams import Diagram, pressure_volume, voltage_volume
from .regimes import regime_of_diagram

__all__ = ["Report", "report", "report_of"]


class _Words:
    """Numbers of a scene in words: four digits and the unit in which people read the quantity."""

    def __init__(self, units: Units | None):
        self.units = units

    def __call__(self, record: typing.Any, name: str) -> str:
        value = getattr(record, name)
        if self.units is None:
            return f"{value:.4g}"
        unit = self.units.read_name(name)
        return f"{self.units.read(float(value), name):.4g} {unit}" if unit else f"{value:.4g}"


def _percent(strain: float) -> str:
    return f"{100 * strain:.3g} %" if abs(strain) < 10 else f"{100 * strain:.0f} %"


def _clauses(diagram: Diagram, up: tuple[Event, ...], words: _Words) -> list[str]:
    """One clause for each event of the way up after the start."""
    control = control_of(diagram.scene.loading)
    held = isinstance(mechanical(diagram.scene.loading), PrescribedVolume)
    across = "apex_stretch" if held else "volume"
    named = "an apex stretch" if held else "a volume"
    at = "at a charge of" if control == "charge" else "at" if words.units else "at a voltage of"
    clauses = []
    for before, event in itertools.pairwise(up):
        state = event.state
        here = f"{at} {words(state, control)}"
        if event.event == RampEvent.snap:
            clauses.append(f"snaps {here}")
        elif event.event == RampEvent.landing:
            ratio = state.breakdown_ratio
            jump = f"from {named} of {words(before.state, across)} to {words(state, across)}"
            clauses[-1] += f" {jump}" + (f" and survives (E/E_EB = {ratio:.3g})" if ratio < 1 else "")
        elif event.event == RampEvent.no_landing:
            clauses[-1] += " and finds no stable state to land on"
        elif event.reason == "breakdown in the snap":
            clauses[-1] += f" and breaks down there (E/E_EB = {state.breakdown_ratio:.3g})"
        elif event.event == RampEvent.breakdown:
            clauses.append(f"breaks down {here}")
        elif event.reason == "wrinkles":
            clauses.append(f"loses its hoop tension and wrinkles {here}")
        elif event.reason == "bulges":
            clauses.append(f"loses its axisymmetry and bulges {here}")
        elif event.reason == "slack":
            clauses.append(f"goes slack {here}")
        else:
            clauses.append(f"is stable up to the end of the computation {here} ({event.reason})")
    return clauses


def _back(down: list[Event], control: str, words: _Words) -> str:
    """What happens on the way down, as a sentence."""
    jumps = [e for e in down if e.event == RampEvent.snap_back]
    if jumps:
        places = " and ".join(words(e.state, control) for e in jumps)
        return f"If the {control} is instead lowered after the snap, the membrane snaps back at {places}."
    if down and down[-1].reason == "zero voltage":
        return f"If the {control} is instead lowered to zero after the snap, the membrane stays expanded."
    return ""


def _describe_ramp(diagram: Diagram) -> list[str]:
    """What the ramp of a voltage–volume diagram does, in sentences.

    Numbers are in the units of the scene, as people read them, or dimensionless.
    """
    words = _Words(diagram.scene.units)
    control = control_of(diagram.scene.loading)
    up = diagram.ramp().events
    if not up:
        return [f"There is no ramp: {diagram.area_strain_reason}."]
    start = up[0].state
    if up[0].reason == "start_unstable":
        return [f"The membrane is not stable at zero voltage (volume {words(start, 'volume')}), so no ramp starts."]
    regime = regime_of_diagram(diagram)
    clauses = _clauses(diagram, up, words)
    if regime == Regime.breaks_before_snap:
        clauses[-1] += ", before it would snap"
    elif regime == Regime.no_snap:
        clauses[-1] += " without a snap"
    strain = "" if diagram.area_strain is None else f"; area strain {_percent(diagram.area_strain)}"
    if diagram.area_strain_reason in ("breakdown in the snap", "no landing"):
        strain += " before the snap"
    snapped = any(e.event == RampEvent.landing for e in up)
    said = ". It then ".join(clauses)
    back = _back([e for e in diagram.events if e.direction == "down"], control, words) if snapped else ""
    volume = "flat" if start.volume == 0 else f"with a volume of {words(start, 'volume')}"
    begin = f"It starts {volume} at a pressure of {words(start, 'pressure')}."
    return [f"The membrane {said}{strain}.", *([back] if back else []), begin]


def _describe_curve(diagram: Diagram) -> list[str]:
    """What the pressure of a pressure–volume curve does, in sentences."""
    words = _Words(diagram.scene.units)
    folds = sorted(
        (p for p in diagram.special_points if p.kind == PointKind.fold), key=lambda p: (p.branch, p.position)
    )
    sentences = []
    for fold in folds:
        branch = diagram.branches[fold.branch]
        near = np.argmin(np.abs(branch.volume - fold.volume))
        around = branch.pressure[max(near - 2, 0) : near + 3]
        kind = "peak" if around.mean() < fold.pressure else "minimum"
        place = f"{words(fold, 'pressure')} at a volume of {words(fold, 'volume')}"
        sentences.append(f"The pressure has a {kind} of {place}.")
    sentences = sentences or ["The pressure has no peak in the window."]
    broken = [p for p in diagram.special_points if p.kind == PointKind.breakdown]
    return sentences + [f"The field reaches breakdown at a volume of {words(p, 'volume')}." for p in broken]


@dataclasses.dataclass(frozen=True)
class Report:
    """What a scene does: `sentences`, the most important first, its `regime`, and the `diagram` that they were read from.

    `print` shows sentences, regime, and the events of the ramp or the special points; a notebook shows the same as tables.
    """

    diagram: Diagram
    regime: Regime | None
    sentences: tuple[str, ...]

    @property
    def scene(self) -> Scene:
        """The scene of the report."""
        return self.diagram.scene

    @property
    def lines(self) -> tuple[str, ...]:
        """The sentences, and the regime with what it means."""
        if self.regime is None:
            return self.sentences
        return (*self.sentences, f"Regime: {self.regime.words}. {explain(self.regime.name)}")

    def _rows(self) -> tuple[list[str], list[list[typing.Any]]]:
        charge = ("charge",) if self.diagram.control == "charge" else ()
        names = ("voltage", *charge, "pressure", "volume", "apex_stretch", "breakdown_ratio")
        units = self.scene.units
        records: typing.Any = self.diagram.events or self.diagram.special_points
        shown = records if units is None else units.read(records)
        rows = []
        for record in shown:
            special = isinstance(record, SpecialPoint)
            what = record.kind if special else f"{record.event} ({record.direction})"
            state = record if special else record.state
            rows.append([str(what), *(getattr(state, n) for n in names)])
        return ["", *column_heads(names, units)], rows

    def __str__(self) -> str:
        return "\n".join([*self.lines, "", text_table(*self._rows(), digits=6)])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return "".join(f"<p>{html.escape(line)}</p>" for line in self.lines) + self.diagram._repr_html_()

    def plot(self, *, ax: typing.Any = None, shapes: bool = False, surface: Surface | None = None, **curve_options):
        """The picture of the scene as a matplotlib figure: curves of the membrane with the line of the air, and voltage against volume.

        With `shapes`, insets show the membrane at the events of the ramp. The curves at the ramp's voltages are computed here,
        with a `surface` of the membrane if one is given; further options are those of `pressure_volume`. On your axes `ax` only the
        diagram is drawn; returns them, or else the new figure.
        """
        if ax is not None and shapes:
            raise ValueError("`ax` must be left out with `shapes`, which need more than one panel, but is not.")
        if ax is not None or self.diagram.kind == "pressure-volume":
            return plot_diagram(self.diagram, ax=ax)
        curves = []
        voltages = chamber_voltages(self.diagram) if self.diagram.control == "voltage" else []
        for voltage in voltages:
            try:
                curves.append(pressure_volume(self.scene.membrane, voltage, surface=surface, **curve_options))
            except SceneError:
                # a flat film can have a voltage at which no inflated state exists: there is no curve to draw
                continue
        drawn = [e for e in self.diagram.events if e.direction == "up"] if shapes else []
        profiles = [(e, profile(self.scene.membrane, e.state)) for e in drawn if e.state.volume > 0]
        return plot_chamber(self.diagram, curves, shapes=profiles)


def report(
    scene: Scene,
    *,
    tolerance: float = 1e-9,
    points: int = 256,
    surface: Surface | None = None,
    modes: Iterable[int] | None = None,
) -> Report:
    """What happens to a membrane as the voltage rises slowly from zero, in words, with its regime, its table and its picture.

    The scene is one of `voltage_volume`, whose options these are; at a constant voltage the report describes the pressure. Numbers in the sentences
    are in the units of the scene (kV, ml, mbar), dimensionless where it carries none. `dielectric-jax explain WORD` explains the
    words. Raises what `voltage_volume` raises.

    >>> from dielectric_jax import Chamber, Membrane
    >>> found = report(Scene.from_si(Membrane(), Chamber(volume=18.225e-3, initial_volume=27.565e-6, atmospheric_pressure=100e3)))
    >>> print(found.sentences[0])
    The membrane snaps at 2.516 kV from a volume of 35.93 ml to 227.3 ml and survives (E/E_EB = 0.569). It then breaks down at 3.32 kV; area strain 1612 %.
    >>> found.regime.name
    'stays'
    """
    if isinstance(scene, Scene) and isinstance(scene.loading, ConstantVoltage):
        voltage = float(scene.loading.voltage)
        options = {"points": points, "tolerance": tolerance, "surface": surface, "modes": modes}
        curve = pressure_volume(scene.membrane, voltage, window=scene.window, **options)
        diagram = dataclasses.replace(curve, scene=scene)
        return Report(diagram, None, tuple(_describe_curve(diagram)))
    diagram = voltage_volume(scene, points=points, tolerance=tolerance, surface=surface, modes=modes)
    return report_of(diagram)


def report_of(diagram: Diagram) -> Report:
    """The report of a voltage–volume diagram."""
    up = diagram.ramp().events
    return Report(diagram, regime_of_diagram(diagram) if up else None, tuple(_describe_ramp(diagram)))
