"""Tables in text files as written by instruments and people: encodings, separators, columns of known quantities."""

import csv
import dataclasses
import io
import itertools
import pathlib
import re
import typing
from collections.abc import Iterator, Mapping, Sequence

from ..model import example_units, unit_size
from ..numerics import shown
from .column_names import Head, is_absolute, read_head, unit_of_column

__all__ = ["CURVES", "FILMS", "NUMBER", "Columns", "Kind", "Line", "Table", "bare", "full", "split", "table_of"]


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of table: the sets of quantities of which it must have one, the preferred first, and those it may have."""

    text: str
    sets: tuple[tuple[str, ...], ...]
    optional: tuple[str, ...] = ()


CURVES = Kind("a curve of volume and gauge pressure", (("volume", "pressure"), ("height", "pressure")), ("voltage",))
_PAIRS = tuple(itertools.product(("stretch", "strain"), ("stress", "true stress")))
FILMS = Kind("a test of time, stretch and nominal stress", (*(("time", *pair) for pair in _PAIRS), *_PAIRS))
#: headings or positions of columns, in the order of the quantities or by their names
Columns: typing.TypeAlias = Sequence[str | int] | Mapping[str, str | int]
_COUNTS = {1: "one", 2: "two", 3: "three", 4: "four"}
_ENCODINGS = ("utf-8-sig", "cp1252", "gb18030", "shift_jis", "big5", "latin-1")
_MARKS = (
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)
_SEPARATORS = (";", "\t", ",", "|", "two or more blanks", "blanks")
_DIGITS = r"[+-]?(?:\d+(?:[.,]\d*)*|[.,]\d+)"
NUMBER = re.compile(rf"({_DIGITS})(?:[eEdD]([+-]?\d+))?", re.ASCII)
_WITH_UNIT = re.compile(rf"{_DIGITS}(?:[eE][+-]?\d+)?\s*[a-zA-Zµμ%°][\w³/^]*")


@dataclasses.dataclass(frozen=True)
class Line:
    """One line: its number in the file, its text, and whether it is a remark."""

    number: int
    text: str
    remark: bool


def _text_of(path: pathlib.Path) -> list[tuple[str, str]]:
    """The file's text in every possible encoding, the most likely first, with their names."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"`data` must be a readable CSV file, but {path} is not: {error.strerror}.") from None
    if data[:4] in (b"PK\x03\x04", b"\xd0\xcf\x11\xe0"):
        raise ValueError(f"`data` must be a readable CSV file, but {path} is a spreadsheet; save it as CSV.")
    marked = [name for mark, name in _MARKS if data.startswith(mark)][:1]
    if not marked and len(data) > 3 and b"\0" in data[:4]:
        marked = ["utf-16-le" if data[1] == 0 else "utf-16-be"]
    texts = []
    for encoding in marked or _ENCODINGS:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            texts.append((encoding, text))
            if encoding == "utf-8-sig":
                break
    if not texts:
        raise ValueError(f"`data` must be a readable CSV file, but {path} is not text in a known encoding.")
    return texts


def _lines(text: str) -> list[Line]:
    """The lines that are not blank; a quoted cell of a heading may span several."""
    raw, lines, i = re.split(r"\r\n|\r|\n", text), [], 0
    while i < len(raw):
        line, behind = raw[i], i + 1
        if line.count('"') % 2:  # the quote is closed in one of the next lines, or stands for inches
            closing = next((k for k in range(behind, min(behind + 3, len(raw))) if raw[k].count('"') % 2), i)
            line, behind = " ".join(raw[i : closing + 1]), closing + 1
        stripped = line.strip()
        if stripped.strip(",;|\t "):
            lines.append(Line(i + 1, line, bool(re.match(r"#(?![a-z]+[!/])|%|//", stripped, re.IGNORECASE))))
        i = behind
    return lines


def split(text: str, separator: str) -> list[str]:
    """The cells of a line, without blanks and quotes around them."""
    if separator == "two or more blanks":
        return re.split(r"\s{2,}|\t+", text.strip())
    if separator == "blanks":
        return [c.strip('"') for c in re.findall(r'"[^"]*"|\S+', text)]
    try:
        row = next(csv.reader(io.StringIO(text.strip(" \r\n")), delimiter=separator, skipinitialspace=True))
    except (csv.Error, StopIteration):
        return [text]
    return [c.strip().strip("'").strip() for c in row]


def _split_head(text: str, separator: str) -> list[str]:
    """Column headings; if blanks separate them, a unit in brackets belongs to the heading before it."""
    text = re.sub(r"^\s*(#|%|//)+", "", text)
    if separator != "blanks":
        return split(text, separator)
    return [c.strip('"') for c in re.findall(r'"[^"]*"|[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?', text)]


def full(row: Sequence[str]) -> int:
    """The number of cells of a row up to its last one that is not empty."""
    return max((i + 1 for i, c in enumerate(row) if c), default=0)


# ---- columns


@dataclasses.dataclass(frozen=True)
class Table:
    """The layout of the numbers: the separator, positions and headings of the quantities, and the first line of numbers."""

    separator: str
    places: tuple[int, ...]
    heads: tuple[Head, ...]
    width: int
    first: int

    @property
    def quantities(self) -> tuple[str, ...]:
        """What the columns are."""
        return tuple(head.quantity for head in self.heads)


@dataclasses.dataclass(frozen=True)
class Wanted:
    """The sets of quantities of which one is sought, those that may be there, and their headings or positions and units."""

    kind: Kind
    sets: tuple[tuple[str, ...], ...]
    optional: tuple[str, ...]
    columns: tuple[str | int, ...] | None
    units: Sequence[str] | None

    @property
    def text(self) -> str:
        """Volume and pressure; time, stretch and stress."""
        return f"{', '.join(self.sets[0][:-1])} and {self.sets[0][-1]}"


def _wanted(kind: Kind, columns: Columns | None, units: Sequence[str] | None) -> Wanted:
    """What is sought; refuses columns of other quantities, and another number of units."""
    allowed = "; or ".join(", ".join(names) for names in dict.fromkeys(kind.sets))
    more = f", and of {', '.join(kind.optional)} if there is one" if kind.optional else ""
    if columns is None:
        counts = {len(names) for names in kind.sets}
        sought = Wanted(kind, kind.sets, kind.optional, None, units)
    else:
        if isinstance(columns, Mapping):
            names, places = tuple(columns), tuple(columns.values())
        else:
            places = tuple(columns)
            names = next((names for names in kind.sets if len(names) == len(places)), ())
        if frozenset(names) - set(kind.optional) not in {frozenset(own) for own in kind.sets}:
            given = list(columns) if not isinstance(columns, Mapping) else dict(columns)
            raise ValueError(
                f"`columns` must be {_COUNTS[len(kind.sets[0])]}, of {' and '.join(kind.sets[0])}, or name their quantities, of {allowed}{more}, "
                f"but are {shown(given)}."
            )
        counts, sought = {len(names)}, Wanted(kind, (names,), (), places, units)
    if units is not None and len(units) not in counts:
        raise ValueError(
            f"`column_units` must be {_COUNTS[max(counts)]}, of {' and '.join(sought.sets[0])}, but are {shown(list(units))}."
        )
    return sought


def _is_numeric(cell: str) -> bool:
    return bool(NUMBER.fullmatch(bare(cell)))


def bare(cell: str) -> str:
    """The text of a number without blanks and apostrophes between groups of digits, with an ASCII minus sign."""
    return re.sub(r"(?<=\d)[\s'’\u00a0\u202f](?=\d{3})", "", cell.strip().strip("'\"")).replace("−", "-")


def _numeric_row(text: str, separator: str) -> list[str]:
    """The cells of a line, if it may be a row of numbers: at least two, and half of it if blanks also separate words."""
    row = split(text, separator)
    count = sum(map(_is_numeric, row))
    return row if count >= 2 and ("blanks" not in separator or 2 * count >= len(row)) else []


def _first_row(lines: Sequence[Line]) -> int:
    """The first line that is a row of numbers, however it is split."""
    for i, line in enumerate(lines):
        if not line.remark and any(_numeric_row(line.text, s) for s in _SEPARATORS):
            return i
    return len(lines)


def table_of(
    path, columns: Columns | None, column_units: Sequence[str] | None, kind: Kind = CURVES
) -> tuple[list[Line], Table, list[str]]:
    """The lines of the file and the table found in them, in the first encoding in which columns are found."""
    wanted = _wanted(kind, columns, column_units)
    texts, refused = _text_of(path), None
    for encoding, text in texts:
        lines = _lines(text)
        if lines and re.fullmatch(r'"?sep=.?"?', lines[0].text.strip(), re.IGNORECASE):
            lines = lines[1:]
        try:
            table = _find_table(path, lines, wanted)
        except ValueError as error:
            refused = refused or error
            continue
        plain = encoding == "utf-8-sig" or text.isascii()
        return lines, table, [] if plain else [f"The file is not UTF-8; it was read as {encoding}."]
    raise refused or ValueError(f"`data` must be a readable CSV file, but {path} is not.")


def _find_table(path, lines: list[Line], wanted: Wanted) -> Table:
    first = _first_row(lines)
    if first == len(lines):
        raise ValueError(_no_numbers(path, lines, wanted))
    if wanted.columns is not None and all(re.fullmatch(r"[0-9]{1,9}", str(c)) for c in wanted.columns):
        return _by_place(path, lines, first, [int(c) for c in wanted.columns], wanted)
    above = [line for line in reversed(lines[:first])]
    wrong: ValueError | None = None
    for head in sorted(above, key=lambda line: line.remark):
        try:
            found = _by_head(lines, first, head, wanted)
        except ValueError as error:
            wrong = wrong or ValueError(f"`data` must be {wanted.kind.text}, but {error}.")
            continue
        if found is not None:
            return _with_units(path, lines, head, found, wanted)
    raise wrong or ValueError(_no_columns(path, lines, first, wanted))


def _no_numbers(path, lines: list[Line], wanted: Wanted) -> str:
    """Why no line is a row of numbers: numbers that carry their units, or none at all."""
    for line in lines:
        row = [cell for s in _SEPARATORS[:4] for cell in split(line.text, s)]
        if not line.remark and sum(bool(_WITH_UNIT.fullmatch(bare(c))) for c in row) >= 2:
            return (
                f"`data` must name units once, above the numbers, but line {line.number} of {path} has {shown(line.text)}; remove "
                "the units from the cells."
            )
    return f"`data` must have columns named {wanted.text} with numbers, but {path} has no numbers."


def _no_columns(path, lines: list[Line], first: int, wanted: Wanted) -> str:
    if wanted.columns is not None:
        return f"`columns` must be headings of one column each in {path}, but {' and '.join(map(shown, wanted.columns))} are not."
    head = next((line for line in reversed(lines[:first]) if not line.remark), None)
    advice = "name them and their units in the first line, or give `columns` and `column_units`"
    if head is None and any(
        read_head(split(lines[first].text, s)[0]) and len(_numeric_row(lines[first].text, s)) > 2
        for s in _SEPARATORS[:4]
    ):
        return (
            f"`data` must have one point in each line, but line {lines[first].number} of {path} has a heading and then numbers; "
            "exchange lines and columns."
        )
    if head is None:
        return f"`data` must have columns named {wanted.text}, but {path} begins with numbers; {advice}."
    text = " ".join(head.text.split())[:120]
    sigma = "; σ may be the nominal or the true stress" if wanted.kind is FILMS and "σ" in text else ""
    said = f"but line {head.number} of {path} names {shown(text)}{sigma}"
    return f"`data` must have columns named {wanted.text}, {said}; {advice}."


def _ways(lines: list[Line], first: int) -> Iterator[tuple[str, int]]:
    """The ways to split the first row of numbers, with the number of cells."""
    for separator in _SEPARATORS:
        row = _numeric_row(lines[first].text, separator)
        if row:
            yield separator, len(row)


def _by_head(lines: list[Line], first: int, head: Line, wanted: Wanted) -> Table | None:
    """The table under a heading line; None if the line does not name all columns."""
    unclear: ValueError | None = None
    found: list[tuple[bool, Table]] = []
    for (separator, width), of_head in itertools.product(_ways(lines, first), _SEPARATORS):
        cells = _split_head(head.text, of_head)
        if len(cells) < 2 or (separator in ("blanks", "two or more blanks") and len(cells) != width):
            continue
        # fewer headings than cells only if the same sign separates both: the row is refused later, with its line
        if separator != of_head and full(split(lines[first].text, separator)) > len(cells):
            continue
        try:
            places, heads = _choose(cells, wanted)
        except ValueError as error:
            unclear = unclear or ValueError(f"line {head.number}: {error}")
            continue
        if places and max(places) < width:
            found.append(
                (separator != of_head or len(cells) < width, Table(separator, places, heads, len(cells), first))
            )
    if found:
        return min(found, key=lambda pair: pair[0])[1]
    if unclear is not None:
        raise unclear
    return None


def _choose(cells: list[str], wanted: Wanted) -> tuple:
    """Positions and headings of the columns; empty if one is missing."""
    if wanted.columns is not None:
        named = [
            [i for i, c in enumerate(cells) if c.strip().lower() == str(n).strip().lower()] for n in wanted.columns
        ]
        if any(len(w) != 1 for w in named):
            return (), ()
        places = tuple(w[0] for w in named)
        return places, tuple(_head_of(cells[i], q) for q, i in zip(wanted.sets[0], places, strict=True))
    known = [(i, h) for i, c in enumerate(cells) for h in read_head(c)]
    quantities = next((own for own in wanted.sets if set(own) <= {h.quantity for _, h in known}), None)
    if quantities is None:
        return (), ()
    quantities += tuple(q for q in wanted.optional if q in {h.quantity for _, h in known})
    chosen = []
    for quantity in quantities:
        own = [(i, h) for i, h in known if h.quantity == quantity]
        if len({h.size is None for _, h in own}) == 2:
            own = [(i, h) for i, h in own if h.size is not None]
        best = [pair for pair in own if pair[1].rank == min(h.rank for _, h in own)]
        if len(best) > 1:
            names = " and ".join(repr(cells[i]) for i, _ in best)
            raise ValueError(f"the columns {names} may both be the {quantity}; give `columns`")
        chosen += best
    return tuple(i for i, _ in chosen), tuple(h for _, h in chosen)


def _head_of(cell: str, quantity: str) -> Head:
    """The heading of a column that was chosen for a quantity: its unit counts, whatever name stands beside it."""
    own = [h for h in read_head(cell) if h.quantity == quantity]
    return dataclasses.replace(own[0], rank=0) if own else Head(quantity, unit_of_column(cell, quantity))


def _by_place(path, lines, first: int, places: list[int], wanted: Wanted) -> Table:
    separator, width = next(_ways(lines, first))
    for place in places:
        if not 1 <= place <= width:
            raise ValueError(f"`columns` must be positions from 1 to {width} in {path}, but holds {place}.")
    heads = tuple(map(Head, wanted.sets[0]))
    table = Table(separator, tuple(place - 1 for place in places), heads, width, first)
    named = [line for line in lines[:first] if not line.remark]
    if named and wanted.units is None:
        cells = _split_head(named[-1].text, separator)
        if len(cells) >= width:
            own = [_head_of(cells[p - 1], q) for p, q in zip(places, wanted.sets[0], strict=True)]
            return _with_units(path, lines, named[-1], dataclasses.replace(table, heads=tuple(own)), wanted)
    return _with_units(path, lines, None, table, wanted)


def _with_units(path, lines, head: Line | None, table: Table, wanted: Wanted) -> Table:
    """The table with the units that are given, or those in the heading or in the line below it."""
    heads = list(table.heads)
    between = [] if head is None else [line for line in lines[: table.first] if line.number > head.number]
    rows = [split(line.text, table.separator) for line in between]
    numbers = [any(_is_numeric(row[p]) for p in table.places if p < len(row)) for row in rows]
    if any(numbers):  # rows that lack one of the numbers
        table = dataclasses.replace(table, first=table.first - len(rows) + numbers.index(True))
        rows = rows[: numbers.index(True)]
    units = dict(enumerate(wanted.units or ()))  # those of columns that may be there are in the heading
    for k, (quantity, place) in enumerate(zip(table.quantities, table.places, strict=True)):
        unit = units.get(k, heads[k].unit)
        below = [re.sub(r"^[\[(]|[\])]$", "", row[place]) for row in rows if len(row) > place]
        if unit is None and any(below):
            unit = next(u for u in below if u)
        if unit is None and heads[k].rank == 3 and quantity in ("volume", "pressure"):
            raise ValueError(
                f"`data` must have columns named volume and pressure, or V and p with units, but {path} names the {quantity} by "
                "its symbol alone."
            )
        try:
            size = 0.0 if unit is None else unit_size(unit, quantity)
        except ValueError as error:
            raise ValueError(f"`data` must give the {quantity} in a unit, but in {path} {error}.") from None
        if size is None:
            raise ValueError(
                f"`data` must give the {quantity} in a unit such as {example_units(quantity)}, but {path} says {shown(unit)}."
            )
        absolute = quantity == "pressure" and (heads[k].absolute or is_absolute(unit or ""))
        heads[k] = Head(quantity, unit, size, 0, absolute)
    if wanted.kind is CURVES and len({bool(head.size) for head in heads}) > 1:
        which = "both columns or of neither" if len(heads) == 2 else "all columns or of none"
        without = next(head.quantity for head in heads if not head.size)
        raise ValueError(
            f"`data` must give units of {which}, but {path} gives none of the {without}; name them in its first line, or "
            "give `column_units`; `columns` chooses the columns that are read."
        )
    return dataclasses.replace(table, heads=tuple(heads))
