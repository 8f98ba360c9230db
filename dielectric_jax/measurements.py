"""Measured pressure–volume curves from files."""

import csv
import pathlib
import re
from collections.abc import Mapping

import numpy as np

__all__ = ["read_measurement"]

_SI = {
    "volume": {
        "m³": 1.0,
        "m3": 1.0,
        "L": 1e-3,
        "l": 1e-3,
        "ml": 1e-6,
        "cm³": 1e-6,
        "cm3": 1e-6,
        "mm³": 1e-9,
        "mm3": 1e-9,
    },
    "pressure": {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3, "bar": 1e5, "psi": 6894.757293168},
}


def read_measurement(file: str | pathlib.Path) -> tuple[np.ndarray, np.ndarray, bool]:
    """Volumes and pressures of a CSV file, and whether its header names units; then they are converted to SI.

    The first line names the columns: `volume,pressure`, or with units `volume [ml],pressure [mbar]`; further columns and
    lines that begin with # are left out.
    Raises ValueError for a file that holds no such columns, or something that is no number.
    """
    path = pathlib.Path(file)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"`data` must be a readable CSV file, but {path} is not: {error}.") from None
    rows = [(i + 1, row) for i, row in enumerate(csv.reader(lines)) if row and not row[0].lstrip().startswith("#")]
    heads = [re.fullmatch(r"\s*(\w+)\s*(?:\[(.+)\])?\s*", h) for h in rows[0][1]] if rows else []
    columns: dict[str, tuple[int, float | None]] = {}
    for k, head in enumerate(heads):
        if head and (name := head[1].lower()) in _SI:
            unit = head[2] and head[2].strip()
            if unit and unit not in _SI[name]:
                raise ValueError(
                    f"`data` must give the {name} in one of {', '.join(_SI[name])}, but {path} says {unit!r}."
                )
            columns[name] = k, _SI[name][unit] if unit else None
    if set(columns) != set(_SI):
        raise ValueError(f"`data` must have columns named volume and pressure, but {path} does not.")
    if (columns["volume"][1] is None) != (columns["pressure"][1] is None):
        raise ValueError(f"`data` must give units of both columns or of neither, but {path} does not.")
    found: Mapping[str, list[float]] = {name: [] for name in _SI}
    for number, row in rows[1:]:
        for name, (k, factor) in columns.items():
            try:
                found[name].append(float(row[k]) * (factor or 1.0))
            except (ValueError, IndexError):
                raise ValueError(f"`data` must hold numbers, but line {number} of {path} does not.") from None
    return np.array(found["volume"]), np.array(found["pressure"]), columns["volume"][1] is not None
