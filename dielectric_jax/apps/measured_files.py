"""What `dielectric-jax calibrate` reads: one measured file or several, as curves of pressure or as tests of films."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from ..design import Calibration, FilmCalibration, FilmMeasurement, Measurement
from ..model import Maxwell, Membrane, NeoHookean, Viscoelastic

__all__ = ["fit_files", "notices_of"]

_FILM_WORDS = ("stretch", "strain", "stress", "λ", "lambda", "σ", "ε")
_FILM_COLUMNS = ("time", "stretch", "strain", "stress", "true stress")


def fit_files(
    dj: Any, args: argparse.Namespace, membrane: Membrane, units: Any
) -> tuple[Calibration | FilmCalibration, Membrane, list[str]]:
    """The calibration from the files of the options, the membrane with its constants, and the notices about the files."""
    tables = [_table(dj, args, file) for file in args.data]
    for table, file in zip(tables, args.data, strict=True):
        if table.in_si and units is None:
            raise ValueError(f"--si must be given with a DATA.csv that names units, but is not with {file}.")
    notices = notices_of(args.data, tables)
    curves = [table for table in tables if isinstance(table, Measurement)]
    films = [table for table in tables if isinstance(table, FilmMeasurement)]
    if curves and films:
        raise ValueError("`data` must be files of one kind, but are curves of pressures and tests of films.")
    if curves:
        found = _fit_curves(dj, args, curves, membrane, units)
        return found, found.membrane, notices
    found = _fit_films(dj, args, films, membrane, units)
    return found, Membrane(found.material, breakdown=membrane.breakdown), notices


def notices_of(files: list[str], tables: list[Any]) -> list[str]:
    """The notices about every file, with its name if there are several."""
    start = [f"{file}: " if len(files) > 1 else "" for file in files]
    return [first + said for first, table in zip(start, tables, strict=True) for said in table.notices]


def _columns(args: argparse.Namespace) -> Any:
    """The columns of the options, by the names of their quantities if these are given."""
    if args.columns is None:
        return None
    named = dict(column for column in args.columns if isinstance(column, tuple))
    if named and len(named) < len(args.columns):
        raise ValueError("`columns` must all be QUANTITY=COLUMN, or none, but are mixed or not all different.")
    return named or list(args.columns)


def _table(dj: Any, args: argparse.Namespace, file: str) -> Measurement | FilmMeasurement:
    """The file as a test of a film if its columns are those of one, otherwise as a curve of pressures."""
    columns = _columns(args)
    read = {"columns": columns, "column_units": args.column_units, "branch": args.branch}
    named = isinstance(columns, dict)
    if columns is not None and not (set(columns) & set(_FILM_COLUMNS) if named else len(columns) == 3):
        for name in ("relaxation_times", "mode"):
            if getattr(args, name) is not None:
                raise ValueError(
                    f"`{name}` must be left out with --columns of pressures, but is {getattr(args, name)!r}; the columns of a "
                    "film are stretch=1 stress=2, for example."
                )
        return dj.design.read_measurement(file, **read, atmospheric_pressure=args.atmospheric_pressure)
    asked = columns is not None or args.relaxation_times is not None or args.mode is not None
    try:
        return dj.design.read_film_measurement(file, **read)
    except ValueError as error:
        if asked:
            raise
        of_film = error
    try:
        return dj.design.read_measurement(file, **read, atmospheric_pressure=args.atmospheric_pressure)
    except ValueError as error:
        # the reason that concerns the columns which are there
        named = str(of_film).partition(" names ")[2].lower()
        about_film = "have columns named" not in str(of_film) or any(w in named for w in _FILM_WORDS)
        raise of_film if about_film else error from None


def _fit_curves(
    dj: Any, args: argparse.Namespace, tables: list[Measurement], membrane: Membrane, units: Any
) -> Calibration:
    if len({table.height is None for table in tables}) > 1:
        raise ValueError("`data` must be files of one kind, but some are of volumes and some of heights.")
    if len({table.in_si for table in tables}) > 1:
        raise ValueError("`data` must all name units, or none of them, but only some do.")
    voltage = np.concatenate([_voltage(args, k, table) for k, table in enumerate(tables)])
    at = np.concatenate([t.volume if t.height is None else t.height for t in tables])  # pyright: ignore[reportCallIssue, reportArgumentType]
    place = {"volume" if tables[0].height is None else "height": at}
    asked = {n: getattr(args, n) for n in ("over", "loss", "noise", "level")}
    pressure = np.concatenate([table.pressure for table in tables])
    return dj.calibrate(**place, pressure=pressure, membrane=membrane, units=units, voltage=voltage, **asked)


def _voltage(args: argparse.Namespace, k: int, table: Measurement) -> np.ndarray:
    """The voltages of a file: those of the option, which come first, or of its column."""
    given = args.voltage or []
    if len(given) not in (0, 1, len(args.data)):
        raise ValueError(
            f"`voltage` must be one number, or one for each of the {len(args.data)} files, but is {len(given)} numbers."
        )
    count = len(table.pressure)
    if given:
        return np.full(count, given[min(k, len(given) - 1)])
    return np.zeros(count) if table.voltage is None else table.voltage


def _fit_films(
    dj: Any, args: argparse.Namespace, tables: list[FilmMeasurement], membrane: Membrane, units: Any
) -> FilmCalibration:
    without = {"atmospheric_pressure": None, "voltage": None, "prestretch": 1.0}
    for name in (name for name, value in without.items() if getattr(args, name) != value):
        raise ValueError(f"`{name}` must be left out for a test of time, stretch and stress, but is given.")
    times = [table.time for table in tables if table.time is not None]
    if 0 < len(times) < len(tables):
        raise ValueError("`data` must be files of one kind, but only some of the tests have times.")
    material = membrane.material
    if times:
        longest = max(float(time[-1] - time[0]) for time in times)
        branches = [Maxwell(NeoHookean(), 1.0, time) for time in args.relaxation_times or [longest / 20]]
        material = Viscoelastic(material, branches)
    elif args.relaxation_times is not None:
        raise ValueError("`relaxation_times` must be left out for a test without times, but is given.")
    modes = args.mode or ["uniaxial"]
    asked = {n: getattr(args, n) for n in ("over", "loss", "noise", "level")}
    return dj.design.calibrate_film(
        times or None,
        [table.stretch for table in tables],
        [table.stress for table in tables],
        material=material,
        units=units,
        mode=modes[0] if len(modes) == 1 else modes,
        **asked,
    )
