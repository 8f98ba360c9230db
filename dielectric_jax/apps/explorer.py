"""Sliders beside a diagram of a chamber, a pressure or a voltage, which is redrawn while a slider moves.

The diagram is evaluated on the surface of the film by `glance`. A surface is built when its film is first asked for; the
breakdown law is no part of it.
"""

from __future__ import annotations

import contextlib
import html
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..design import surface_for
from ..diagram import (
    Diagram,
    Glance,
    curves_and_ramps,
    equilibrium,
    glance,
    largest_start,
    pressure_volume,
    voltage_volume,
)
from ..model import Chamber, ConstantPressure, ConstantVoltage, Membrane, RampEvent, Scene, Window, profile
from ..numerics import SceneError, need
from ..plot import voltage_text
from ..surface import SurfaceFamily
from .explorer_controls import SHAPES, Sliders
from .explorer_panels import CurvePanel, DiagramPanel, ShapePanel, whole_figure
from .explorer_story import story
from .options import FIGURE_SUFFIXES, one_of
from .scene_code import code_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..surface import Surface

__all__ = ["Explorer", "explore"]

_PRESTRETCHES = (1.0, 1.5, 2.0, 2.5, 3.0)
_PAUSE = 3.0  # seconds without a change, after which the curve that is shown becomes the one to compare with
_SIDE = (3.9, 2.3)  # inches of the two small pictures
_EVENTS = dict(zip(SHAPES, (RampEvent.start, RampEvent.snap, RampEvent.landing, RampEvent.breakdown), strict=True))
_BUILDING = "Building the surface of this film, which takes some seconds …"
_SHOOTING = "Following the branches by shooting, which takes some seconds …"
_MOVED = "The slider went back to where a ramp can start."


def explore(
    scene: Scene | None = None,
    *,
    prestretches: Any = None,
    surface: SurfaceFamily | Surface | None = None,
    size: tuple[float, float] = (7.2, 4.4),
    dpi: float = 90.0,
) -> Explorer:
    """Sliders for a film, its chamber and its loading beside the resulting diagram, for Jupyter.

    Sliders change the chamber, its filling, the pressure or the voltage, the prestretch, the constants of the material and
    the scale of the breakdown field. Small pictures show pressure against volume and the shape of the membrane. The surface
    of a film is built (some seconds), or read from the cache folder, when its prestretch or its constants are first chosen.
    Needs the extra `interactive`.

    Args:
        scene: the initial values of the sliders, and everything they do not change: the kind of material and of breakdown
            law, atmospheric pressure, units. The paper's membrane on V_C = 1600, V_0 = 2.42 when None.
        prestretches: the values of the prestretch slider; that of the scene is added. 1, 1.5, 2, 2.5 and 3 when None, as far
            as the film can be stretched.
        surface: a `SurfaceFamily` over the prestretches, or the `Surface` of the scene's own film; built if not given.
        size: size of the picture of the diagram in inches.
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
    if scene.window != Window():
        raise ValueError("`window` must be left out here, because a surface has its own.")
    values = _prestretches(scene, prestretches)
    for name, number in zip(("size", "size", "dpi"), (*size, dpi), strict=True):
        if not 0 < number < math.inf:
            raise ValueError(f"`{name}` must be positive and finite, but is {number!r}.")
    return Explorer(_with_volume(scene), values, surface, size, dpi)


def _prestretches(scene: Scene, given: Any) -> list[float]:
    """The values of the prestretch slider; raises ValueError for others than the film can have."""
    own = float(scene.membrane.prestretch)
    if given is None:
        given = [w for w in _PRESTRETCHES if _can_have(scene, w)]
    try:
        values = sorted({own, *map(float, given)})
    except TypeError:
        raise ValueError(f"`prestretches` must be numbers, but is {given!r}.") from None
    for value in values:
        scene.replace(prestretch=value)
    return values


def _can_have(scene: Scene, prestretch: float) -> bool:
    try:
        return bool(scene.replace(prestretch=prestretch))
    except ValueError:
        return False


def _with_volume(scene: Scene) -> Scene:
    """The scene with the initial volume of its chamber, where an initial pressure is given."""
    loading = scene.loading
    if not isinstance(loading, Chamber) or loading.initial_volume is not None:
        return scene
    filled = equilibrium(scene.membrane, pressure=float(loading.initial_pressure or 0.0), voltage=0.0)
    return scene.with_values(initial_volume=scene.in_units(filled.volume, "volume"))


class Explorer:
    """The widget of `explore`: `controls` by name, the `scene` they select, its result `seen`, and the `axes` it is drawn on.

    `seen` is a `Glance`, or a `Diagram` after the button "whole diagram". `picture` and `message` are the widgets that
    show and describe it; `curves` and `shape` those of the small pictures.
    """

    def __init__(self, scene: Scene, prestretches: list[float], surface: Any, size: tuple[float, float], dpi: float):
        widgets = need("ipywidgets", "interactive")
        self._base, self._given = scene, surface
        self._surfaces: dict[tuple, Surface] = {}
        self._sliders = Sliders(widgets, scene, prestretches)
        self._panels = DiagramPanel(size, dpi), CurvePanel(_SIDE, dpi), ShapePanel(_SIDE, dpi)
        self.axes = self._panels[0].axes
        self.scene = scene
        self.seen: Glance | Diagram | None = None
        self._ghost: Glance | Diagram | None = None
        self._moving, self._moved_at, self._quiet = "", -math.inf, False
        self.controls = self._sliders.widgets | _buttons(widgets)
        self.message = widgets.HTML()
        self.picture, self.curves, self.shape = (
            widgets.Image(format="png", layout=_wide(panel.figure.get_figwidth() * dpi)) for panel in self._panels
        )
        self.widget = self._arranged(widgets)
        self._surface_on(self._sliders.film())  # here, where a surface of another film is refused
        self._listen()
        self.draw()

    def _arranged(self, widgets: Any) -> Any:
        """Sliders and buttons above, the pictures below, side by side where the page is wide enough."""
        own = self.controls
        rows = [["whole", "reset", "code"], ["file", "save"]]
        buttons = [widgets.HBox([own[name] for name in names]) for names in rows]
        side = widgets.VBox([self.curves, own["shape"], self.shape])
        wrap = widgets.Layout(flex_flow="row wrap")
        columns = [
            widgets.VBox([w for n, w in self._sliders.widgets.items() if n not in self._sliders.film_names]),
            widgets.VBox([*(self._sliders.widgets[n] for n in self._sliders.film_names), *buttons]),
        ]
        pictures = widgets.Box([self.picture, side], layout=wrap)
        return widgets.VBox([widgets.Box(columns, layout=wrap), self.message, own["lines"], pictures])

    def _listen(self) -> None:
        own = self.controls
        for name, slider in self._sliders.widgets.items():
            slider.observe(lambda change, name=name: self._changed(name), names="value")
        own["shape"].observe(lambda change: self._paint_sides(), names="value")
        own["code"].observe(lambda change: self._show_code(), names="value")
        own["whole"].on_click(lambda _: self.draw(whole=True))
        own["reset"].on_click(lambda _: self.reset())
        own["save"].on_click(lambda _: self._save())

    def _changed(self, name: str) -> None:
        """Redraws after a slider moved; a new move keeps the curve that was shown in grey."""
        if self._quiet:
            return
        now = time.monotonic()
        if (name != self._moving or now - self._moved_at > _PAUSE) and self.seen is not None:
            self._ghost = self.seen
        self._moving = name
        self.draw()
        self._moved_at = time.monotonic()

    @contextlib.contextmanager
    def _unheard(self) -> Iterator[None]:
        """Moves sliders without a redraw."""
        before, self._quiet = self._quiet, True
        try:
            yield
        finally:
            self._quiet = before

    def reset(self) -> None:
        """Moves all sliders back to the scene that was given."""
        with self._unheard():
            self._sliders.reset()
        self._changed("reset")

    def draw(self, whole: bool = False) -> None:
        """Draws the diagram for the controls; errors are shown in `message`."""
        self._sliders.show()
        try:
            self.scene, note = self._selected()
            self.seen = self._see(self.scene, whole)
            self.message.value = f"{story(self.seen)}{note}"
        except (ValueError, SceneError) as error:
            self.seen = None
            self.message.value = f"<b>{html.escape(str(error))}</b>"
        self.picture.value = self._panels[0].draw(self.seen, self._ghost)
        self._paint_sides()
        self._show_code()

    def _selected(self) -> tuple[Scene, str]:
        """The scene selected by the controls, the filling at most where a ramp can start, and a note if it was not."""
        film = self._sliders.film()
        loading, note = self._sliders.loading_on(film), ""
        if not isinstance(loading, ConstantVoltage):
            largest = largest_start(loading, self._surface_on(film))
            with self._unheard():
                moved = self._sliders.limit(largest, film)
            if moved:
                loading, note = self._sliders.loading_on(film), f" {_MOVED}"
        return Scene(film.membrane, loading, units=film.units), note

    def _surface_on(self, film: Scene) -> Surface:
        """The surface of a film, built for the strongest breakdown law of its slider, with the film's own law."""
        own = film.membrane.material, float(film.membrane.prestretch)
        key = (
            own[1],
            *(float(film.value_of(name)) for name in self._sliders.constants if name != "breakdown_field_scale"),
        )
        if key not in self._surfaces:
            self.message.value = _BUILDING
            same = own[0] == self._base.membrane.material
            fits = isinstance(self._given, SurfaceFamily) or own[1] == float(self._base.membrane.prestretch)
            surface = surface_for(self._sliders.widest(film).membrane, self._given if same and fits else None)
            self._warm_up(surface, film)
            self._surfaces[key] = surface
        return surface_for(film.membrane, self._surfaces[key])

    def _see(self, scene: Scene, whole: bool) -> Glance | Diagram:
        surface = self._surface_on(scene)
        if not whole:
            try:
                return glance(scene, surface)
            except SceneError:  # its rows are too few near the flat film
                self.message.value = _SHOOTING
        if isinstance(scene.loading, ConstantVoltage):
            return pressure_volume(scene.membrane, float(scene.loading.voltage), surface=surface)
        return voltage_volume(scene, surface=surface)

    def _warm_up(self, surface: Surface, film: Scene) -> None:
        """Compiles the programs and builds the rows of a surface; uses many chambers, since some need an extra program."""
        chambers = {"chamber_volume": np.geomspace(20.0, 20000.0, 24), "initial_volume": 2.42}
        air = {"atmospheric_pressure": 50.0, "polytropic_exponent": 1.0}
        given = self._base.loading
        if isinstance(given, Chamber):
            air = {name: float(getattr(given, name)) for name in air}
        curves_and_ramps(surface, chambers | air)
        for loading in (ConstantPressure(1.0), ConstantVoltage(0.05)):
            with contextlib.suppress(SceneError):
                glance(Scene(surface.membrane, loading), surface)

    def _chosen(self) -> Any:
        """The event whose shape is shown, None if the ramp has none."""
        wanted = _EVENTS[self.controls["shape"].value]
        events = () if self.seen is None else self.seen.events
        return next((e for e in events if e.direction == "up" and e.event == wanted), None)

    def _side_results(self) -> tuple[list[Any], Any, Any]:
        """The pressure–volume curves beside the diagram, the event that is shown, and its profile."""
        event, membrane = self._chosen(), self.scene.membrane
        if self.seen is None or not self.seen.events:
            return [], None, None
        voltages = sorted({0.0, 0.0 if event is None else float(event.state.voltage)})
        surface, curves = self._surface_on(self.scene), []
        for voltage in voltages:
            with contextlib.suppress(SceneError):
                curves.append(glance(Scene(membrane, ConstantVoltage(voltage), units=self.scene.units), surface))
        return curves, event, None if event is None else profile(membrane, event.state)

    def _paint_sides(self) -> None:
        curves, event, shape = self._side_results()
        shown = None if self.seen is None or not self.seen.events else ""
        for widget in (self.curves, self.shape, self.controls["shape"]):
            widget.layout.display = "none" if shown is None else None
        if shown is None:
            return
        state = None if event is None else event.state
        self.curves.value = self._panels[1].draw(self.seen, curves, state, self.axes.get_xlim())
        self.shape.value = self._panels[2].draw(shape, self.scene.units, self._title(event))

    def _title(self, event: Any) -> str:
        """The caption of the shape."""
        word = self.controls["shape"].value
        if event is None:
            return f"this ramp has no {word.removeprefix('before the ')}"
        units = self.scene.units
        voltage = event.state.voltage
        return f"{word}, {voltage_text(voltage if units is None else units.read(voltage, 'voltage'), units)}"

    def figure(self) -> Figure:
        """The pictures as one matplotlib figure, without the grey curve; raises ValueError where there is no diagram."""
        if self.seen is None:
            raise ValueError("`scene` must have a diagram to be drawn, but has none.")
        curves, event, shape = self._side_results()
        return whole_figure(self.seen, curves, None if event is None else event.state, shape, self._title(event))

    def save(self, name: str) -> Path:
        """Saves `figure` as a PDF, PNG, SVG, … and returns where; raises ValueError for a name that cannot be."""
        path = Path(name).expanduser()
        if path.suffix[1:].lower() not in FIGURE_SUFFIXES:
            raise ValueError(f"`file` must be a name ending in {one_of(FIGURE_SUFFIXES)}, but is {name!r}.")
        try:
            self.figure().savefig(path, dpi=150)
        except OSError as error:
            raise ValueError(f"`file` must be one that can be written, but is {name!r}: {error.strerror}.") from None
        return path.resolve()

    def _save(self) -> None:
        try:
            self.message.value = f"Saved {html.escape(str(self.save(self.controls['file'].value)))}."
        except ValueError as error:
            self.message.value = f"<b>{html.escape(str(error))}</b>"

    @property
    def code(self) -> str:
        """The lines of Python that make the scene; raises ValueError for a material of the user's own."""
        return code_of(self.scene)

    def _show_code(self) -> None:
        lines, shown = self.controls["lines"], self.controls["code"].value
        lines.layout.display = None if shown else "none"
        if shown:
            try:
                lines.value = self.code
            except ValueError as error:
                lines.value = f"# {error}"

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)

    def __repr__(self) -> str:
        prestretches = ", ".join(label for label, _ in self.controls["prestretch"].options)
        return f"Explorer({self._sliders.loading}, prestretches {prestretches})"


def _buttons(widgets: Any) -> dict[str, Any]:
    """What is no slider."""
    hidden = {"width": "98%", "height": "17em", "display": "none"}
    return {
        "whole": widgets.Button(
            description="whole diagram", tooltip="All branches, followed beyond the surface by shooting"
        ),
        "reset": widgets.Button(description="reset", tooltip="All sliders back to where they began"),
        "code": widgets.ToggleButton(description="copy as code", tooltip="The lines of Python that make this scene"),
        "file": widgets.Text(value="explorer.pdf", description="file", layout={"width": "22em"}),
        "save": widgets.Button(description="save picture", tooltip="To this file, as PDF, PNG or SVG"),
        "shape": widgets.ToggleButtons(options=list(SHAPES), style={"button_width": "auto"}),
        "lines": widgets.Textarea(disabled=False, layout=hidden),
    }


def _wide(pixels: float) -> dict[str, str]:
    return {"width": f"{round(pixels)}px", "max_width": "100%", "align_self": "flex-start"}
