"""Measured curves of pressure against volume or height, and tests of films, from files."""

import dataclasses
import pathlib
import re
from collections.abc import Iterator, Sequence

import numpy as np

from ..numerics import shown
from .column_names import read_head
from .resolution import BELOW_ZERO, LARGEST_STRAIN, NOISE_OF_VOLUME, SHORTEST_RUN, TURN
from .text_tables import CURVES, FILMS, NUMBER, Columns, Line, Table, bare, full, split, table_of

__all__ = ["BRANCHES", "FilmMeasurement", "Measurement", "read_film_measurement", "read_measurement", "runs_of"]

BRANCHES = ("loading", "unloading", "all")

_MISSING = {"", "-", "--", "?", "na", "n/a", "nan", "null", "none", "nil", "#n/a", "#value!", "#div/0!", "missing", "."}
_MISSING |= {"ol", "overload", "overrange"}  # a gauge beyond its range


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Volumes or pole heights, and pressures (n,) of a file, in the order of its lines, and notices about what was left out.

    Iterating gives `volume`, `pressure`, `in_si`: whether the file names units, so that the numbers are in SI (m³, m, Pa, V).
    `lines` (n,) are the points' lines in the file; `notices` are sentences on what was left out or assumed. `volume` is None in a
    file of heights, `height` in one of volumes, and `voltage` (n,) where no column names it.
    """

    volume: np.ndarray | None
    pressure: np.ndarray
    in_si: bool
    lines: np.ndarray
    notices: tuple[str, ...]
    height: np.ndarray | None = None
    voltage: np.ndarray | None = None

    def __iter__(self) -> Iterator:
        return iter((self.volume, self.pressure, self.in_si))


def read_measurement(
    file: str | pathlib.Path,
    *,
    columns: Columns | None = None,
    column_units: Sequence[str] | None = None,
    branch: str | None = None,
    atmospheric_pressure: float | None = None,
) -> Measurement:
    """Volumes or pole heights, pressures and voltages of a text file, converted to SI where it names units.

    A line above the numbers names the columns: `volume,pressure`, or with units `volume [ml],pressure [mbar]`; it may be a
    remark, and units may be in the next line. Columns are separated by commas, semicolons, tabs, bars or blanks; decimal
    commas are accepted if the file is unambiguous. Other columns, remarks (`#`, `%`, `//`) and lines that lack one of the two
    numbers are left out, and so are points at zero volume. A column of heights, `height [mm]`, is read where there is no volume,
    and a column of voltages, `voltage [kV]`, beside them. See docs/calibration.md.

    Args:
        file: path of the file.
        columns: the columns of volume and pressure, by their full headings or their positions (1 is the first); those of other
            quantities by name, {"height": 1, "pressure": 2, "voltage": 4}. Only these are read.
        column_units: their units, such as ("ml", "kPa"), if the file does not name them.
        atmospheric_pressure: subtracted from absolute pressures; in Pa if there are units.
        branch: "loading" or "unloading" if the volume rises and falls, or "all"; by default loading.

    Raises:
        ValueError: for a file without such columns, or with an entry that is not a number, with its line.
    """
    path = pathlib.Path(file)
    _check_branch(branch)
    table, found, where, notices = _columns_of(path, columns, column_units, CURVES)
    given = "volume" if "volume" in found else "height"
    size, pressure = found[given], found["pressure"]
    in_si = bool(table.heads[0].size)
    absolute = any(head.absolute for head in table.heads)
    if absolute and atmospheric_pressure is None:
        raise ValueError(
            f"`data` must hold gauge pressures, but {path} names absolute ones; give `atmospheric_pressure` to subtract it."
        )
    pressure = pressure - (atmospheric_pressure or 0.0)
    positive, said = _positive(path, given, size, pressure, where)
    notices += said
    keep = np.flatnonzero(positive)
    on_branch, said = _on_branch(given, size[keep], where[keep], branch)
    keep = keep[on_branch]
    voltage = np.abs(found["voltage"][keep]) if "voltage" in found else None
    if voltage is not None and np.any(voltage):
        low, high = (float(v) for v in (voltage.min(), voltage.max()))
        span = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
        said.append(f"The voltages are those of the column of voltages, {span}{' V' if in_si else ''}.")
    volume, height = (size[keep] if given == name else None for name in ("volume", "height"))
    return Measurement(volume, pressure[keep], in_si, where[keep], tuple(notices + said), height, voltage)


@dataclasses.dataclass(frozen=True)
class FilmMeasurement:
    """Times, stretches and nominal stresses (n,) of a film's test, in the order of the lines, and notices about what was left out.

    `time` is None in a file without times. Times are in seconds where the file names their unit; stresses are in Pa, `in_si`, where
    it names theirs. `lines` (n,) are the samples' lines in the file.
    """

    time: np.ndarray | None
    stretch: np.ndarray
    stress: np.ndarray
    in_si: bool
    lines: np.ndarray
    notices: tuple[str, ...]


def read_film_measurement(
    file: str | pathlib.Path,
    *,
    columns: Columns | None = None,
    column_units: Sequence[str] | None = None,
    branch: str | None = None,
) -> FilmMeasurement:
    """Times, stretches and nominal stresses of a text file: `time [s],stretch,stress [kPa]`, or without units.

    What is accepted is what `read_measurement` accepts. The column of times may be missing: the test is then one of an elastic film.
    A column `strain`, of engineering strains ε (also in %), gives the stretches 1 + ε; a column `true stress` the nominal stresses
    σ/λ.

    Args:
        file: path of the file.
        columns: the columns of time, stretch and stress, by their full headings or their positions (1 is the first); those of other
            quantities by name, {"strain": 3, "stress": 4}. Only these are read.
        column_units: their units, such as ("s", "-", "kPa"), if the file does not name them.
        branch: "loading" or "unloading" if the stretches of a test without times rise and fall, or "all"; by default loading.

    Raises:
        ValueError: for a file without such columns, with an entry that is not a number, or with times that do not rise, with its
            line.
    """
    path = pathlib.Path(file)
    _check_branch(branch)
    table, found, where, notices = _columns_of(path, columns, column_units, FILMS)
    if len(where) < 2:
        raise ValueError(f"`data` must hold two samples or more, but {path} holds {len(where)}.")
    time, in_si = found.get("time"), bool(table.heads[-1].size)
    strain = found.get("strain")
    stretch = found["stretch"] if strain is None else 1 + strain
    _check_samples(path, where, time, stretch, strain)
    stress = found["stress"] if "stress" in found else found["true stress"] / stretch
    if time is not None:
        if branch is not None:
            raise ValueError(f"`branch` must be left out for a test with times, but is {shown(branch)}.")
        return FilmMeasurement(time, stretch, stress, in_si, where, tuple(notices))
    keep, said = _on_branch("stretch", stretch, where, branch)
    return FilmMeasurement(None, stretch[keep], stress[keep], in_si, where[keep], tuple(notices + said))


def _check_samples(path, where, time, stretch, strain) -> None:
    """Refuses times that do not rise, stretches that are none, and strains in per cent without their unit."""
    checks = [] if time is None else [(np.diff(time, prepend=-np.inf) <= 0, "rising times", time)]
    if strain is not None:
        checks.append((strain > LARGEST_STRAIN, "strains of rubber (those in per cent need the unit %)", strain))
    for wrong, said, values in (*checks, (stretch <= 0, "stretches above zero", stretch)):
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(f"`data` must hold {said}, but line {where[k]} of {path} has {float(values[k]):.6g}.")


def _check_branch(branch: str | None) -> None:
    if branch is not None and branch not in BRANCHES:
        raise ValueError(f"`branch` must be one of {', '.join(BRANCHES)}, but is {shown(branch)}.")


# ---- numbers


def _columns_of(path, columns, column_units, kind) -> tuple[Table, dict[str, np.ndarray], np.ndarray, list[str]]:
    """The table, its columns in SI by their quantities, the lines of the rows, and notices."""
    lines, table, notices = table_of(path, columns, column_units, kind)
    cells, texts = _cells(path, lines[table.first :], table)
    values, where, left = _numbers(path, cells, table.quantities)
    sizes = np.array([head.size or 1.0 for head in table.heads])
    return table, dict(zip(table.quantities, values * sizes[:, None], strict=True)), where, [*notices, *texts, *left]


def _cells(path, lines: list[Line], table: Table) -> tuple[tuple[list[tuple[str, ...]], list[int]], list[str]]:
    """The cells of every row that are sought, without blanks, with the numbers of their lines; and a notice about lines of text."""
    cells, where, texts = [], [], []
    for line in lines:
        if line.remark:
            continue
        row = split(line.text, table.separator)
        if _is_text(row, table):
            texts.append(line)
            continue
        if full(row) > table.width:
            raise ValueError(
                f"`data` must hold a number in each cell, but line {line.number} of {path} has {full(row)} cells under "
                f"{table.width} headings, as if a comma in a number were also the separator."
            )
        row += [""] * (max(table.places) + 1 - len(row))
        cells.append(tuple(bare(row[place]) for place in table.places))
        where.append(line.number)
    said = (
        f"Left out: {_lines_text([t.number for t in texts])}, text such as {shown(texts[0].text.strip())}."
        if texts
        else ""
    )
    return (cells, where), [said] if texts else []


def _is_text(row: list[str], table: Table) -> bool:
    """Whether a row is a sentence or a title: no cell is a number, a missing one or a heading."""
    cells = [bare(cell) for cell in row if cell]
    if any(NUMBER.fullmatch(c) or _is_missing(c) or re.search(r"\binf", c, re.IGNORECASE) for c in cells):
        # a sentence that is split at its blanks may hold a number; it begins with letters, and has too many cells
        words = sum(bool(re.fullmatch(r"[^\W\d_]{2,}[:,.]?", c)) for c in cells)
        return (
            "blanks" in table.separator
            and 2 * words > len(cells) > len(table.places)
            and not NUMBER.fullmatch(cells[0])
        )
    return bool(cells) and not any(read_head(cell) for cell in cells)


def _is_missing(cell: str) -> bool:
    return cell.lower() in _MISSING


def _decimal_sign(path, cells, where) -> str:
    """The decimal sign of the file, "." or ","; refuses files that use both, and ambiguous ones."""
    seen: dict[str, int] = {}
    unclear = 0
    for pair, number in zip(cells, where, strict=True):
        for digits in (m[1].lstrip("+-") for m in map(NUMBER.fullmatch, pair) if m):
            signs = re.sub(r"\d", "", digits)
            if not signs:
                continue
            last, groups = signs[-1], re.split(r"[.,]", digits)
            grouped = all(len(g) == 3 for g in groups[1:]) and 1 <= len(groups[0]) <= 3 and groups[0] != "0"
            if len(set(signs)) == 2 and signs.count(last) == 1:
                seen.setdefault(last, number)
            elif len(set(signs)) == 1 and len(signs) > 1 and grouped:
                seen.setdefault("." if last == "," else ",", number)
            elif len(signs) == 1 and not grouped:
                seen.setdefault(last, number)
            elif last == ",":
                unclear = unclear or number
    if len(seen) == 2:
        point, comma = seen["."], seen[","]
        raise ValueError(
            f"`data` must use one decimal sign, but line {point} of {path} has a decimal point and line {comma} a decimal comma."
        )
    if not seen and unclear:
        raise ValueError(
            f"`data` must use a decimal sign that is clear, but the comma in line {unclear} of {path} may separate thousands "
            "or decimals; write a decimal point."
        )
    return next(iter(seen), ".")


def _value(cell: str, sign: str) -> float | None:
    """The number in a cell; None if it is not a number."""
    found = NUMBER.fullmatch(cell)
    if not found:
        return None
    whole, _, rest = found[1].partition(sign)
    other = "," if sign == "." else "."
    if re.search(r"[.,]", rest) or (other in whole and not re.fullmatch(rf"[+-]?\d{{1,3}}(\{other}\d{{3}})+", whole)):
        return None
    return float(f"{whole.replace(other, '')}.{rest or '0'}e{found[2] or '0'}")


def _numbers(path, rows, quantities: Sequence[str]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Numbers (a row for each quantity, n), their lines, and notices about the lines left out."""
    cells, where = rows
    sign = _decimal_sign(path, cells, where)
    values, kept, empty = [], [], []
    for pair, number in zip(cells, where, strict=True):
        if any(map(_is_missing, pair)) and all(_is_missing(c) or NUMBER.fullmatch(c) for c in pair):
            empty += [] if all(c == "" for c in pair) else [number]
            continue
        found = [_value(c, sign) for c in pair]
        for quantity, cell, value in zip(quantities, pair, found, strict=True):
            if value is None or not np.isfinite(value):
                raise ValueError(
                    f"`data` must hold numbers, but line {number} of {path} has {shown(cell)} as its {quantity}."
                )
        values.append(found)
        kept.append(number)
    absent = " or ".join(f"a {quantity}" for quantity in quantities)
    notices = [] if not empty else [f"Left out: {_lines_text(empty)}, without {absent}."]
    return np.array(values, float).reshape(-1, len(quantities)).T, np.array(kept, int), notices


def _lines_text(numbers: Sequence[int]) -> str:
    """Line 5; lines 5 and 7; lines 5 to 8, 12 and 3 more."""
    spans: list[list[int]] = []
    for n in numbers:
        if spans and n == spans[-1][-1] + 1:
            spans[-1] = [spans[-1][0], n]
        else:
            spans.append([n])
    words = [f"{s[0]} to {s[-1]}" if len(s) > 1 else str(s[0]) for s in spans]
    if len(words) > 6:
        words = [*words[:5], f"{len(words) - 5} more groups"]
    many = len(numbers) > 1
    return ("lines " if many else "line ") + (
        " and ".join([", ".join(words[:-1]), words[-1]]) if words[1:] else words[0]
    )


# ---- points


def _positive(path, given: str, volume, pressure, where) -> tuple[np.ndarray, list[str]]:
    """Which points have a volume (or height, as `given` says) above zero; volumes far below zero are refused."""
    if not len(volume):
        raise ValueError(f"`data` must hold points, but {path} has no line with a {given} and a pressure.")
    least = -NOISE_OF_VOLUME * volume.max()
    wrong = np.flatnonzero(volume < least) if volume.max() > 0 else np.array([0])
    if wrong.size:
        raise ValueError(
            f"`data` must hold {given}s above zero, but line {where[wrong[0]]} of {path} has {float(volume[wrong[0]]):.6g}."
        )
    keep = volume > 0
    said = [f"Left out: {_lines_text(where[~keep])}, where the {given} is zero or less."] if not keep.all() else []
    low = np.flatnonzero(keep & (pressure < -BELOW_ZERO * pressure.max()))
    if low.size:
        raise ValueError(
            f"`data` must hold pressures above zero, up to noise, but line {where[low[0]]} of {path} has "
            f"{float(pressure[low[0]]):.6g}."
        )
    return keep, said


def runs_of(volume: np.ndarray) -> list[tuple[int, int, bool]]:
    """Runs of points (first, one past the last, whether the volume rises) between reversals larger than the noise.

    A single run if the points are not in order of time.

    >>> runs_of(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 4.0, 3.0, 2.0, 1.0]))
    [(0, 5, True), (5, 10, False)]
    """
    begin = peak = sign = 0  # the run's first point, its extremum so far, and 1 if it rises, −1 if it falls
    step, runs = TURN * float(np.max(volume, initial=0.0)), []
    for i, v in enumerate(volume):
        if sign == 0:
            if abs(v - volume[0]) > step:
                sign, peak = (1 if v > volume[0] else -1), i
        elif sign * (v - volume[peak]) > 0:
            peak = i
        elif sign * (volume[peak] - v) > step:
            if peak > begin or not runs:
                runs.append((begin, peak + 1, sign > 0))
                begin = peak + 1
            # else a jump to the first point of the next run: only one direction was recorded
            peak, sign = i, -sign
    runs.append((begin, len(volume), sign >= 0))
    return runs if len(volume) >= SHORTEST_RUN * len(runs) else [(0, len(volume), True)]


def _on_branch(given: str, volume: np.ndarray, where: np.ndarray, branch: str | None) -> tuple[np.ndarray, list[str]]:
    """Which points are on the requested branch of the `given` quantity, and notices about the others."""
    runs = runs_of(volume)
    keep = np.ones(len(volume), bool)
    directions = {rises for *_, rises in runs}
    if branch == "all" or (len(directions) == 1 and (branch is None or directions == {branch == "loading"})):
        return keep, []
    rising = branch != "unloading"
    for first, behind, rises in runs:
        keep[first:behind] = rises == rising
    if not keep.any():
        raise ValueError(
            f"`branch` must be one that the data contain, but the {given} never {'rises' if rising else 'falls'}."
        )
    turns = _lines_text([int(where[first]) for first, _, _ in runs[1:]])
    kind, other = ("loading", "unloading") if rising else ("unloading", "loading")
    return keep, [
        f"The {given} turns at {turns}: {keep.sum()} points of {kind} are used and {(~keep).sum()} of {other} are left out; "
        f"choose with `branch`."
    ]
