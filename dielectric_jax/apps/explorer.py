"""Sliders beside a diagram of a chamber, a pressure or a voltage, which is redrawn while a slider moves.

The diagram is evaluated on the surface of each prestretch by `glance`; the axes are kept as a picture, and only the lines on them
are redrawn. The picture is a PNG, which every front end of Jupyter can show.
"""

from __future__ import annotations

import contextlib
import html
import io
import itertools
import math
import types
from typing import TYPE_CHECKING, Any

import numpy as np

from ..design import surface_for
from ..diagram import Diagram, Glance, curves_and_ramps, glance, pressure_volume, regime_of_diagram, voltage_volume
from ..model import (
    Chamber,
    ConstantPressure,
    ConstantVoltage,
    Event,
    Membrane,
    PointKind,
    RampEvent,
    Regime,
    Scene,
    Window,
    parameter_of,
)
from ..numerics import SceneError, need
from ..plot import (
    event_entries,
    line_entries,
    plot_pressure_volume,
    plot_voltage_volume,
    point_entries,
    viewed,
    voltage_text,
)

if TYPE_CHECKING:
    from ..surface import Surface, SurfaceFamily

__all__ = ["Explorer", "explore"]

#: what a loading holds fixed, as on its button, and its sliders besides the prestretch
_LOADINGS = {
    "closed chamber": ("chamber_volume", "initial_volume"),
    "constant pressure": ("pressure",),
    "constant voltage": ("voltage",),
}
_WORDS = {name: parameter_of(name).label for name in ("chamber_volume", "initial_volume", "pressure", "prestretch")}
_WORDS["voltage"] = "voltage Φ / (H√(μ/ε))"
# least, largest, step, and the value if the scene gives none
_RANGES = {
    "initial_volume": (0.1, 8.0, 0.02, 2.42),
    "pressure": (0.1, 2.5, 0.01, 1.82),
    "voltage": (0.0, 0.25, 0.005, 0.05),
}
_DECADES = (1.0, 4.4, 0.02, 1600.0)  # the chamber volume's: least, largest and step are powers of ten
_ROUND = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.4, 8.0, 10.0)  # ends of axes, times powers of ten
_MOST_FRAMES = 64  # pictures of empty axes that are kept; beyond, the oldest is drawn again when it is needed
_WHOLE = "Press “whole diagram” to follow it by shooting."


def explore(
    scene: Scene | None = None,
    *,
    prestretches: Any = (1.0, 1.5, 2.0, 2.5, 3.0),
    surface: SurfaceFamily | Surface | None = None,
    size: tuple[float, float] = (7.6, 4.6),
    dpi: float = 90.0,
) -> Explorer:
    """Sliders for chamber, filling, pressure, voltage and prestretch beside the resulting diagram, for Jupyter.

    Everything is prepared first: a surface for each prestretch (some seconds each, or read from the cache folder), and the
    compiled programs that evaluate it. Needs the extra `interactive`.

    Args:
        scene: the initial values of the sliders, and everything they do not change: material, breakdown law, atmospheric
            pressure, units. The paper's membrane on V_C = 1600, V_0 = 2.42 when None.
        prestretches: the values of the prestretch slider; that of the scene is added.
        surface: a `SurfaceFamily` over the prestretches, or the `Surface` of a single one; built if not given.
        size: size of the picture in inches.
        dpi: pixels per inch.

    Returns:
        The explorer; Jupyter shows it if it is the last value of a cell.

    Raises:
        ValueError: for invalid arguments.
        ImportError: if ipywidgets is not installed.
    """
    need("ipywidgets", "interactive")
    if scene is None:
        scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    loading = scene.loading
    if not isinstance(loading, (Chamber, ConstantPressure, ConstantVoltage)):
        raise ValueError(
            f"`loading` must be a Chamber, a ConstantPressure or a ConstantVoltage, but is a {type(loading).__name__}."
        )
    if isinstance(loading, Chamber) and loading.initial_volume is None:
        raise ValueError("`initial_volume` must be given for a Chamber here, but is left out.")
    if scene.window != Window():
        raise ValueError("`window` must be left out here, because a surface has its own.")
    try:
        values = sorted({float(scene.membrane.prestretch), *map(float, prestretches)})
    except TypeError:
        raise ValueError(f"`prestretches` must be numbers, but is {prestretches!r}.") from None
    for value in values:
        scene.replace(prestretch=value)
    for name, number in zip(("size", "size", "dpi"), (*size, dpi), strict=True):
        if not 0 < number < math.inf:
            raise ValueError(f"`{name}` must be positive and finite, but is {number!r}.")
    return Explorer(scene, values, surface, size, dpi)


class Explorer:
    """The widget of `explore`: `controls` by name, the `scene` they select, its result `seen`, and the `axes` it is drawn on.

    `seen` is a `Glance`, or a `Diagram` after the button "whole diagram". `picture` and `message` are the widgets that
    show and describe it.
    """

    def __init__(self, scene: Scene, prestretches: list[float], surface: Any, size: tuple[float, float], dpi: float):
        self._base = scene
        self._surfaces = {w: surface_for(scene.replace(prestretch=w).membrane, surface) for w in prestretches}
        self._frame = _Frame(size, dpi)
        self.axes = self._frame.axes
        self.scene = scene
        self.seen: Glance | Diagram | None = None
        widgets = need("ipywidgets", "interactive")
        self.controls = _controls(widgets, scene, prestretches)
        wide = {"width": f"{round(size[0] * dpi)}px", "max_width": "100%", "align_self": "flex-start"}
        self.picture = widgets.Image(format="png", layout=wide)
        self.message = widgets.HTML()
        button = widgets.Button(
            description="whole diagram", tooltip="All branches, followed beyond the surface by shooting"
        )
        self.controls["whole"] = button
        self._warm_up()
        for name, control in self.controls.items():
            if name != "whole":
                control.observe(lambda change: self.draw(), names="value")
        button.on_click(lambda _: self.draw(whole=True))
        self.widget = widgets.VBox([*self.controls.values(), self.picture, self.message])
        self.draw()

    def draw(self, whole: bool = False) -> None:
        """Draws the diagram for the controls; errors are shown in `message`."""
        held = _LOADINGS[self.controls["loading"].value]
        for name, words in _WORDS.items():
            if name in self.controls and words:
                self.controls[name].layout.display = None if name in (*held, "prestretch") else "none"
        try:
            self.scene = self._given_scene()
            self.seen = self._see(self.scene, whole)
            self.message.value = _story(self.seen)
        except (ValueError, SceneError) as error:
            self.seen = None
            self.message.value = f"<b>{html.escape(str(error))}</b>"
        self.picture.value = self._frame.draw(self.seen)

    def _given_scene(self) -> Scene:
        """The scene selected by the controls."""
        film = self._base.replace(prestretch=self.controls["prestretch"].value)
        values = {n: control.value / _unit(n, film) for n, control in self.controls.items() if n in _WORDS}
        kind, given = self.controls["loading"].value, film.loading
        if kind == "constant pressure":
            loading: Any = ConstantPressure(values["pressure"])
        elif kind == "constant voltage":
            loading = ConstantVoltage(values["voltage"])
        else:
            air = given if isinstance(given, Chamber) else Chamber(volume=1.0, initial_volume=1.0)
            loading = Chamber(
                volume=values["chamber_volume"],
                initial_volume=values["initial_volume"],
                atmospheric_pressure=air.atmospheric_pressure,
                polytropic_exponent=air.polytropic_exponent,
            )
        return Scene(film.membrane, loading, units=film.units)

    def _see(self, scene: Scene, whole: bool) -> Glance | Diagram:
        surface = self._surfaces[float(scene.membrane.prestretch)]
        if not whole:
            return glance(scene, surface)
        if isinstance(scene.loading, ConstantVoltage):
            return pressure_volume(scene.membrane, float(scene.loading.voltage), surface=surface)
        return voltage_volume(scene, surface=surface)

    def _warm_up(self) -> None:
        """Compiles the programs and builds the rows of every surface; uses many chambers, since some need an extra program."""
        chambers = {"chamber_volume": np.geomspace(20.0, 20000.0, 24), "initial_volume": 2.42}
        air = {"atmospheric_pressure": 50.0, "polytropic_exponent": 1.0}
        given = self._base.loading
        if isinstance(given, Chamber):
            air = {name: float(getattr(given, name)) for name in air}
        for prestretch, surface in self._surfaces.items():
            film = self._base.replace(prestretch=prestretch).membrane
            curves_and_ramps(surface, chambers | air)
            for loading in (ConstantPressure(1.0), ConstantVoltage(0.05)):
                with contextlib.suppress(SceneError):
                    glance(Scene(film, loading), surface)

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)

    def __repr__(self) -> str:
        return f"Explorer({self.controls['loading'].value}, prestretches {', '.join(f'{w:g}' for w in self._surfaces)})"


def _unit(name: str, scene: Scene) -> float:
    """What a dimensionless value is multiplied with on its slider, which shows kV, ml, L and mbar on a scene with units."""
    return 1.0 if scene.units is None or name == "prestretch" else float(scene.units.read(1.0, name))


def _words_of(name: str, scene: Scene) -> str:
    """The description of a slider."""
    if scene.units is None or name == "prestretch":
        return _WORDS[name]
    symbol = "voltage Φ" if name == "voltage" else f"{parameter_of(name).words} {parameter_of(name).symbol}"
    return f"{symbol} / {scene.units.read_name(name)}"


def _controls(widgets: Any, scene: Scene, prestretches: list[float]) -> dict[str, Any]:
    """The buttons of the loading and the sliders, set to the values of a scene."""
    loading = scene.loading
    kinds = dict(zip(_LOADINGS, (Chamber, ConstantPressure, ConstantVoltage), strict=True))
    kind = next(word for word, cls in kinds.items() if isinstance(loading, cls))
    given = {"chamber_volume": "volume"} | {name: name for name in _RANGES}
    known = {name: float(getattr(loading, own)) for name, own in given.items() if hasattr(loading, own)}
    wide = {"style": {"description_width": "12em"}, "layout": {"width": "34em"}}
    controls = {"loading": widgets.ToggleButtons(options=list(_LOADINGS), value=kind)}
    low, high, step, value = _DECADES
    unit = _unit("chamber_volume", scene)
    value = unit * known.get("chamber_volume", value)
    ends = _ends(low + math.log10(unit), high + math.log10(unit), step, math.log10(value))
    controls["chamber_volume"] = widgets.FloatLogSlider(
        value=value, description=_words_of("chamber_volume", scene), readout_format=".5g", **ends, **wide
    )
    for name, (low, high, step, value) in _RANGES.items():
        unit = _unit(name, scene)
        value = unit * known.get(name, value)
        ends = _ends(unit * low, unit * high, unit * step, value)
        controls[name] = widgets.FloatSlider(
            value=value, description=_words_of(name, scene), readout_format=".3f", **ends, **wide
        )
    controls["prestretch"] = widgets.SelectionSlider(
        options=[(f"{w:g}", w) for w in prestretches],
        value=float(scene.membrane.prestretch),
        description=_WORDS["prestretch"],
        **wide,
    )
    return controls


def _ends(low: float, high: float, step: float, value: float) -> dict[str, float]:
    """The limits of a slider that has `value` on one of its steps, because browsers round to steps."""
    first = value - step * max(0, math.floor((value - low) / step))
    return {"min": max(first, min(low, value)), "max": max(high, value), "step": step}


class _Frame:
    """Axes whose ticks and labels are drawn once for each set of limits, and lines that are drawn on that picture."""

    def __init__(self, size: tuple[float, float], dpi: float):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.figure = Figure(figsize=size, dpi=dpi)
        self.canvas = FigureCanvasAgg(self.figure)
        self.axes = self.figure.add_axes((0.1, 0.13, 0.61, 0.84))
        self.figure.legend(
            *zip(*_every_entry(), strict=True),
            loc="center left",
            bbox_to_anchor=(0.72, 0.55),
            frameon=False,
            fontsize="small",
        )
        self._pictures: dict[tuple, Any] = {}

    def draw(self, seen: Any) -> bytes:
        """The PNG of a result; of empty axes for None."""
        axes = self.axes
        for artist in [*axes.lines, *axes.texts]:
            artist.remove()
        if seen is not None:
            plot = plot_voltage_volume if seen.kind == "voltage-volume" else plot_pressure_volume
            plot(seen, ax=axes, legend=False)
            for end, limit in ((axes.get_xlim()[1], axes.set_xlim), (axes.get_ylim()[1], axes.set_ylim)):
                limit(-0.015 * _rounded(end), _rounded(end))
        artists = sorted([*axes.lines, *axes.texts], key=lambda a: a.get_zorder())
        key = (*axes.get_xlim(), *axes.get_ylim(), axes.get_xlabel(), axes.get_ylabel())
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
        for artist in artists:
            axes.draw_artist(artist)
        return _png(np.asarray(self.canvas.buffer_rgba()))


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
    return [*line_entries(styles), *point_entries(kinds), *event_entries(events)]


def _story(seen: Any) -> str:
    """The events of the ramp, or the folds of the pressure, as a line of HTML."""
    view, units = viewed(seen)
    if seen.kind == "pressure-volume":
        name = "" if units is None else f" {units.read_name('pressure')}"
        folds = [p for p in view.special_points if p.kind == PointKind.fold]
        folds_in_words = [f"p = {p.pressure:.6g}{name} at V = {p.volume:.5g}" for p in folds]
        return (
            "Folds of the pressure: " + "; ".join(folds_in_words) + "."
            if folds_in_words
            else "The pressure has no fold."
        )
    pairs = itertools.zip_longest(view.events, view.events[1:])
    parts = [words for event, following in pairs if (words := _words(event, following, units))]
    whole = isinstance(seen, Diagram)
    regime = regime_of_diagram(seen) if whole else seen.regime
    if regime == Regime.start_unstable:
        return "The ramp cannot start: the state at zero voltage is not stable."
    if seen.area_strain is not None and np.isfinite(seen.area_strain):
        parts.append(f"area strain {seen.area_strain:.5g}")
    if regime not in (Regime.undetermined, Regime.not_decided):
        parts.append(f"regime: <b>{regime.words}</b>")
    if not whole and regime == Regime.not_decided:
        parts.append(f"the surface alone cannot decide this ramp. {_WHOLE}")
    elif not whole and seen.several:
        parts.append(f"the curve has gaps where several states have the same apex stretch. {_WHOLE}")
    text = "; ".join(parts)
    return text[:1].upper() + text[1:]


def _words(event: Event, following: Event | None, units: Any) -> str:
    """An event in words."""
    state = event.state
    landed = following is not None and following.event == RampEvent.landing
    if event.event in (RampEvent.snap, RampEvent.snap_back):
        to = f" from V = {state.volume:.4g} to {following.state.volume:.4g}" if landed and following else ""
        ratio = (
            f" (E/E_EB = {following.state.breakdown_ratio:.3g})"
            if landed and following and event.event == RampEvent.snap
            else ""
        )
        return f"{event.event.replace('_', ' ').replace('snap', 'snaps', 1)} at {voltage_text(state.voltage, units)}{to}{ratio}"
    if event.event == RampEvent.breakdown:
        return f"breaks down at {voltage_text(state.voltage, units)}"
    return ""
