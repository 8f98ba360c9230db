"""The paper reproduced: its computed figures as scenes and pictures, and its statements compared with the equations.

Li, Keplinger, Baumgartner, Bauer, Yang and Suo, J. Mech. Phys. Solids 61 (2013) 611, doi 10.1016/j.jmps.2012.09.006.
If the text gives no voltages or pressures, those of `paper_figures` are used. Nothing is tuned to match a statement.
"""

import json
import pathlib
import typing

from ..diagram import Diagram, pressure_volume, voltage_volume
from ..model import Chamber, ConstantPressure, Membrane, Profile, Scene, Units, profile
from ..numerics import shown
from .options import DOTS_PER_INCH, PICTURES, one_of
from .paper_figures import FIGURES, PRINTED
from .paper_statements import STATEMENTS, Statement, statements_table

__all__ = ["Paper", "reproduce"]


class Paper:
    """The diagrams behind the figures, each computed when it is first requested."""

    voltages = (0.0, 0.05, 0.1, 0.15)

    def __init__(self) -> None:
        self.units = Units()
        self._known: dict[tuple, Diagram] = {}
        self._used: dict[tuple, Diagram] = {}

    def _once(self, key: tuple, build: typing.Callable) -> Diagram:
        if key not in self._known:
            self._known[key] = build()
        self._used[key] = self._known[key]
        return self._known[key]

    def curve(self, voltage: float, prestretch: float = 1.0) -> Diagram:
        """Pressure against volume."""
        return self._once(("curve", voltage, prestretch), lambda: pressure_volume(_film(prestretch), voltage))

    def held(self, pressure: float, prestretch: float = 1.0) -> Diagram:
        """Voltage against volume at constant pressure."""
        scene = Scene(_film(prestretch), ConstantPressure(pressure))
        return self._once(("held", pressure, prestretch), lambda: voltage_volume(scene))

    def chamber(self, volume: float) -> Diagram:
        """Voltage against volume on a chamber filled to V_0 = 2.42."""
        scene = Scene(_film(1.0), Chamber(volume=volume, initial_volume=2.42))
        return self._once(("chamber", volume), lambda: voltage_volume(scene))

    def units_at(self, prestretch: float) -> Units:
        """The units of a film that is stretched over the experiment's opening, 22.5 mm in radius."""
        return Units.for_opening(self.units.radius, prestretch)

    def experiment(self, litres: float) -> Diagram:
        """The experiment's chamber, filled with 12 ml."""
        chamber = Chamber(volume=litres * 1e-3, initial_volume=12e-6, atmospheric_pressure=100e3)
        scene = Scene.from_si(_film(1.0), chamber, self.units)
        return self._once(("experiment", litres), lambda: voltage_volume(scene))

    def profiles(self) -> dict[str, Profile]:
        """Profiles of the membrane at p = 1.82: before the voltage, at the snap, and at its landing."""
        events = {str(e.event): e.state for e in self.held(1.82).ramp().events}
        return {word: profile(_film(1.0), events[word]) for word in ("start", "snap", "landing")}

    def used(self) -> list[Diagram]:
        """The diagrams requested since the last call."""
        used, self._used = list(self._used.values()), {}
        return used


def _film(prestretch: float) -> Membrane:
    return Membrane(prestretch=prestretch)


def reproduce(
    folder: str | pathlib.Path,
    only: typing.Iterable[str | int] | None = None,
    *,
    format: str = "png",
    dpi: int | None = None,
    say: typing.Callable[[str], None] = lambda text: None,
) -> list[Statement]:
    """Writes the paper's computed figures, the scenes behind them, and the statements, to an existing folder.

    Args:
        folder: for `figure_3.png` …, `figure_3.json` … (the documents of the diagrams a figure shows or is based on)
            and `statements.md`.
        only: numbers of figures; all when None. The statements are those about these figures.
        format: "pdf", "png" or "svg". Figures are 183 mm wide, two columns of a journal, or half of it; pdf and svg keep text as text.
        dpi: dots per inch of a png, from 30 to 1200; 300 when None.
        say: called with a text about the progress.

    Returns:
        The statements.

    Raises:
        ValueError: for a figure that the model does not compute, another format, and a resolution that is out of range or not of a png.
    """
    import matplotlib

    _check_picture(format, dpi)
    wanted = list(FIGURES) if only is None else list(dict.fromkeys(str(name) for name in only))
    for name in wanted:
        if name not in FIGURES:
            raise ValueError(
                f"`only` must be numbers of computed figures, {', '.join(FIGURES)}, but holds {shown(name)}."
            )
    folder, paper, statements = pathlib.Path(folder), Paper(), []
    for name in wanted:
        say(f"figure {name} …")
        with matplotlib.rc_context(PRINTED):
            figure = FIGURES[name](paper)
            figure.savefig(folder / f"figure_{name}.{format}", dpi=dpi or 300)
        _close(figure)
        statements += STATEMENTS[name](paper)
        text = json.dumps({"diagrams": [d.to_json() for d in paper.used()]}, allow_nan=False)
        (folder / f"figure_{name}.json").write_text(text + "\n", encoding="utf-8")
    (folder / "statements.md").write_text(statements_table(statements) + "\n", encoding="utf-8")
    return statements


def _check_picture(format: str, dpi: int | None) -> None:
    if format not in PICTURES:
        raise ValueError(f"`format` must be {one_of(PICTURES)}, but is {shown(format)}.")
    if dpi is None:
        return
    least, most = DOTS_PER_INCH
    if not (type(dpi) is int and least <= dpi <= most):
        raise ValueError(f"`dpi` must be a whole number from {least} to {most}, but is {shown(dpi)}.")
    if format != "png":
        raise ValueError(f"`dpi` must be given with the format png only, but the format is {format}.")


def _close(figure: typing.Any) -> None:
    import matplotlib.pyplot as plt

    plt.close(figure)
