"""The controls of the explorer: what can be moved for a scene, over which range, in which unit, and the scene they select."""

from __future__ import annotations

import math
from typing import Any

from ..model import (
    PARAMETERS,
    Chamber,
    Change,
    ConstantPressure,
    ConstantVoltage,
    Scene,
    parameter_of,
)

__all__ = ["LOADINGS", "SHAPES", "Sliders"]

#: what a loading holds fixed, as on its button, and its sliders
LOADINGS = {
    "closed chamber": ("chamber_volume", "initial_volume"),
    "constant pressure": ("pressure",),
    "constant voltage": ("voltage",),
}
_KINDS = dict(zip(LOADINGS, (Chamber, ConstantPressure, ConstantVoltage), strict=True))
#: the points of a ramp whose shape can be shown
SHAPES = ("start", "before the snap", "landing", "breakdown")
# least, largest, step, and the value if the scene gives none
_RANGES = {
    "initial_volume": (0.1, 8.0, 0.02, 2.42),
    "pressure": (0.1, 2.5, 0.01, 1.82),
    "voltage": (0.0, 0.25, 0.005, 0.05),
}
_DECADES = (1.0, 4.4, 0.02, 1600.0)  # the chamber volume's: least, largest and step are powers of ten
_SPAN = {Change.MATERIAL: (0.5, 2.0), Change.BREAKDOWN: (0.5, 1.5)}  # ends of the range of a constant, as shares of it
_WIDE = {"style": {"description_width": "17em"}, "layout": {"width": "37em"}}


def constants_of_film(scene: Scene) -> list[str]:
    """The constants of the film that get a slider: positive numbers of the table of parameters."""
    names = [n for n, row in PARAMETERS.items() if row.change in _SPAN and row.path[0] == "membrane" and not row.many]
    return [n for n in names if scene.has(n) and float(scene.value_of(n)) > 0]


class Sliders:
    """The sliders of a scene: the widgets by name, their limits, and the scene that they select.

    Sliders show kV, ml, L and mbar on a scene with units; `number` gives dimensionless values.
    """

    def __init__(self, widgets: Any, scene: Scene, prestretches: list[float]):
        self._base = scene
        self.constants = constants_of_film(scene)
        kind = next(word for word, cls in _KINDS.items() if isinstance(scene.loading, cls))
        self.widgets: dict[str, Any] = {"loading": widgets.ToggleButtons(options=list(LOADINGS), value=kind)}
        self._add_chamber_volume(widgets)
        self._largest: dict[str, float] = {}
        for name in _RANGES:
            self._add_load(widgets, name)
        self.widgets["prestretch"] = widgets.SelectionSlider(
            options=[(f"{w:g}", w) for w in prestretches],
            value=float(scene.membrane.prestretch),
            description=self._words("prestretch"),
            continuous_update=False,
            **_WIDE,
        )
        for name in self.constants:
            self._add_constant(widgets, name)
        self._initial = {name: widget.value for name, widget in self.widgets.items()}

    def _add_chamber_volume(self, widgets: Any) -> None:
        low, high, step, value = _DECADES
        unit = self._unit("chamber_volume", self._base)
        value = unit * self._known("chamber_volume", value)
        ends = _ends(low + math.log10(unit), high + math.log10(unit), step, math.log10(value))
        self.widgets["chamber_volume"] = widgets.FloatLogSlider(
            value=value, description=self._words("chamber_volume"), readout_format=".5g", **ends, **_WIDE
        )

    def _add_load(self, widgets: Any, name: str) -> None:
        low, high, step, value = _RANGES[name]
        unit = self._unit(name, self._base)
        value = unit * self._known(name, value)
        ends = _ends(unit * low, unit * high, unit * step, value)
        self._largest[name] = ends["max"]
        self.widgets[name] = widgets.FloatSlider(
            value=value, description=self._words(name), readout_format=".3f", **ends, **_WIDE
        )

    def _add_constant(self, widgets: Any, name: str) -> None:
        """A slider about the scene's value; one that asks for another surface acts when it is released."""
        value, change = float(self._base.value_of(name)), parameter_of(name).change
        low, high = (share * value for share in _SPAN[change])
        step = 10.0 ** math.floor(math.log10(value)) / (10 if change is Change.MATERIAL else 50)
        self.widgets[name] = widgets.FloatSlider(
            value=value,
            description=self._words(name),
            readout_format=".4g",
            continuous_update=change is Change.BREAKDOWN,
            **_ends(low, high, step, value),
            **_WIDE,
        )

    def _known(self, name: str, value: float) -> float:
        """The dimensionless value that the scene gives a load, else `value`."""
        own = {"chamber_volume": "volume"}.get(name, name)
        given = getattr(self._base.loading, own, None)
        return value if given is None else float(given)

    def _unit(self, name: str, scene: Scene) -> float:
        """What a dimensionless value is multiplied with on its slider."""
        units = scene.units
        return 1.0 if units is None or not _has_unit(name) else float(units.read(1.0, name))

    def _words(self, name: str) -> str:
        """The description of a slider: words, symbol and unit."""
        units = self._base.units
        if units is None or not _has_unit(name):
            return "voltage Φ / (H√(μ/ε))" if name == "voltage" else parameter_of(name).label
        symbol = "voltage Φ" if name == "voltage" else f"{parameter_of(name).words} {parameter_of(name).symbol}"
        return f"{symbol} / {units.read_name(name)}"

    @property
    def film_names(self) -> list[str]:
        """The sliders of the film."""
        return ["prestretch", *self.constants]

    @property
    def loading(self) -> str:
        """The button of the loading that is pressed."""
        return self.widgets["loading"].value

    def film(self) -> Scene:
        """The base scene with the prestretch and the constants of the sliders; its loading stays."""
        return self._base.replace(**{name: self.widgets[name].value for name in self.film_names})

    def number(self, name: str, film: Scene) -> float:
        """The dimensionless value of a slider of the loading."""
        return self.widgets[name].value / self._unit(name, film)

    def loading_on(self, film: Scene) -> Chamber | ConstantPressure | ConstantVoltage:
        """The loading that the sliders select."""
        if self.loading == "constant pressure":
            return ConstantPressure(self.number("pressure", film))
        if self.loading == "constant voltage":
            return ConstantVoltage(self.number("voltage", film))
        given = film.loading
        air = given if isinstance(given, Chamber) else Chamber(volume=1.0, initial_volume=1.0)
        return Chamber(
            volume=self.number("chamber_volume", film),
            initial_volume=self.number("initial_volume", film),
            atmospheric_pressure=air.atmospheric_pressure,
            polytropic_exponent=air.polytropic_exponent,
        )

    def limit(self, largest: float, film: Scene) -> bool:
        """Lets the slider of the filling, or of the pressure, go no farther than a dimensionless value.

        Returns whether it had to move.
        """
        name = LOADINGS[self.loading][-1]
        slider = self.widgets[name]
        steps = math.floor((largest * self._unit(name, film) - slider.min) / slider.step)
        before = slider.value
        slider.max = min(self._largest[name], slider.min + max(steps, 0) * slider.step)
        return slider.value != before

    def show(self) -> None:
        """Shows the sliders of the loading that is pressed, and hides the others'."""
        shown = LOADINGS[self.loading]
        for names in LOADINGS.values():
            for name in names:
                self.widgets[name].layout.display = None if name in shown else "none"

    def reset(self) -> None:
        """Moves every slider to the value of the scene that was given."""
        for name, value in self._initial.items():
            if name in self._largest:
                self.widgets[name].max = self._largest[name]
            self.widgets[name].value = value

    def widest(self, film: Scene) -> Scene:
        """The film with the strongest breakdown law of its slider, whose surface serves every weaker one."""
        name = "breakdown_field_scale"
        return film.replace(**{name: self.widgets[name].max}) if name in self.widgets else film


def _has_unit(name: str) -> bool:
    return name == "voltage" or parameter_of(name).kind in ("pressure", "volume")


def _ends(low: float, high: float, step: float, value: float) -> dict[str, float]:
    """The limits of a slider that has `value` on one of its steps, because browsers round to steps."""
    first = value - step * max(0, math.floor((value - low) / step + 1e-9))
    first = 0.0 if abs(first) < 1e-9 * step else first
    return {"min": max(first, min(low, value)), "max": max(high, value), "step": step}
