"""What an answer is made of: states along branches, special points, events of a ramp.

Plain NumPy on the host, the same shape whichever engine computed it, and the JSON of it.
"""

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from ..numerics import Code
from .kinds import PointKind, RampEvent

__all__ = [
    "QUANTITIES",
    "Branch",
    "Event",
    "Ramp",
    "SpecialPoint",
    "State",
    "column_heads",
    "events_table",
    "html_table",
    "number_text",
    "points_table",
    "text_table",
]


def _cell(value: Any) -> str:
    return html.escape(number_text(value, 6))


def html_table(heads: Sequence[str], rows: Sequence[Sequence[Any]], caption: str = "") -> str:
    """A table with its heads; numbers with six digits, what is missing as a dash.

    >>> html_table(["kind", "pressure"], [["fold", 1.9086848]])
    '<table><thead><tr><th>kind</th><th>pressure</th></tr></thead><tbody><tr><td>fold</td><td>1.90868</td></tr></tbody></table>'
    """
    head = "".join(f"<th>{_cell(h)}</th>" for h in heads)
    body = "".join("<tr>" + "".join(f"<td>{_cell(v)}</td>" for v in row) + "</tr>" for row in rows)
    title = f"<caption>{_cell(caption)}</caption>" if caption else ""
    return f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def text_table(heads: Sequence[str], rows: Sequence[Sequence[Any]], digits: int = 10) -> str:
    """A table with its heads as lines of text, columns as wide as necessary; what is missing as a dash.

    >>> print(text_table(["kind", "pressure"], [["fold", 1.9086848]]))
      kind  pressure
      fold  1.9086848
    """
    cells = [list(heads), *([number_text(v, digits) for v in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  " + "  ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)).rstrip() for r in cells)


def number_text(value: Any, digits: int = 10) -> str:
    """A number with its digits, a dash for what is missing, anything else as text.

    >>> number_text(1 / 3, 3), number_text(None), number_text("fold")
    ('0.333', '–', 'fold')
    """
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


#: the columns of a branch, in the order of the JSON document
QUANTITIES = (
    "voltage_squared",
    "pressure",
    "volume",
    "apex_stretch",
    "height",
    "charge",
    "breakdown_ratio",
    "index",
    "error_estimate",
)
# what tables of states show
_SHOWN = ("voltage", *QUANTITIES[1:])


def plain(value: Any) -> Any:
    """A JSON value: NaN and infinity become None, NumPy scalars Python's."""
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return [plain(v) for v in value.tolist()]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return value


def _number_of(value: Any) -> float:
    """A number of a document, NaN for null."""
    return math.nan if value is None else float(value)


def voltage_of(voltage_squared):
    """Φ = √q; NaN where q < 0, which no voltage reaches."""
    q = np.asarray(voltage_squared, dtype=float)
    return np.sqrt(np.where(q >= 0, q, np.nan))


@dataclasses.dataclass(frozen=True)
class State:
    """One equilibrium, dimensionless. `index` is None where it is not defined (at a fold) or not valid."""

    voltage_squared: float
    pressure: float
    volume: float
    apex_stretch: float
    height: float
    charge: float
    breakdown_ratio: float
    index: int | None
    error_estimate: float
    flags: tuple[str, ...] = ()

    @property
    def voltage(self) -> float:
        """Φ = √q, NaN where q < 0."""
        return float(voltage_of(self.voltage_squared))

    def to_json(self) -> dict:
        """The state under the names of the JSON contract; null where a quantity has no meaning."""
        out: dict[str, Any] = {"voltage_squared": self.voltage_squared, "voltage": self.voltage}
        for name in QUANTITIES[1:]:
            out[name] = getattr(self, name)
        out["flags"] = list(self.flags)
        return plain(out)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The state of a document of `to_json`; NaN where a quantity has no meaning, or is not in the document."""
        values: dict[str, Any] = {name: _number_of(document.get(name)) for name in QUANTITIES if name != "index"}
        if "voltage_squared" not in document:
            values["voltage_squared"] = _number_of(document["voltage"]) ** 2
        values |= {"index": document.get("index"), "flags": tuple(document.get("flags", ()))}
        return cls(**values, **cls._more_from_json(document))

    @classmethod
    def _more_from_json(cls, document: Mapping[str, Any]) -> dict[str, Any]:
        """What a subclass has besides."""
        return {}

    def _repr_html_(self) -> str:
        heads = ("kind", *_SHOWN) if isinstance(self, SpecialPoint) else _SHOWN
        return html_table([h.replace("_", " ") for h in heads], [[getattr(self, n) for n in heads]])

    def __repr__(self) -> str:
        index = "" if self.index is None else f", index={self.index}"
        return (
            f"{type(self).__name__}(voltage={self.voltage:.8g}, pressure={self.pressure:.8g}, volume={self.volume:.8g}, "
            f"apex_stretch={self.apex_stretch:.8g}{index}, error_estimate={self.error_estimate:.1e})"
        )


@dataclasses.dataclass(frozen=True, repr=False)
class SpecialPoint(State):
    """A located point of a branch: `kind` is fold, zero_voltage, breakdown, hoop_tension_loss, slack or mode.

    `number` is the circumferential number of a neutral mode, None for other kinds.
    """

    kind: PointKind = dataclasses.field(kw_only=True)
    branch: int = 0
    #: arclength along the branch, for ordering; not part of the JSON
    position: float = 0.0
    number: int | None = None

    def to_json(self) -> dict:
        """Kind and branch, of a mode also its number, then the state."""
        number = {} if self.number is None else {"number": self.number}
        return {"kind": self.kind, "branch": self.branch} | number | super().to_json()

    @classmethod
    def _more_from_json(cls, document: Mapping[str, Any]) -> dict[str, Any]:
        kind = PointKind(document["kind"])
        return {"kind": kind, "branch": document["branch"], "number": document.get("number")}

    def __repr__(self) -> str:
        number = "" if self.number is None else f"number={self.number}, "
        return super().__repr__().replace("(", f"({self.kind!r}, branch={self.branch}, {number}", 1)


@dataclasses.dataclass(frozen=True, repr=False)
class Branch:
    """A curve of equilibria: one array of shape (points,) for each of `QUANTITIES`, and why it starts and ends.

    `flags` lists what a reader must know of the branch as a whole: "error_above_tolerance"; "points_lost", a gap between
    mesh points; "end_lost", an end inside the scanned window that was not reached; "special_point_lost", a special point that is bracketed but was not located.
    `index` is -1 where it is not valid.
    """

    voltage_squared: np.ndarray
    pressure: np.ndarray
    volume: np.ndarray
    apex_stretch: np.ndarray
    height: np.ndarray
    charge: np.ndarray
    breakdown_ratio: np.ndarray
    index: np.ndarray
    error_estimate: np.ndarray
    start: Code
    end: Code
    flags: tuple[str, ...] = ()

    @property
    def voltage(self) -> np.ndarray:
        """Φ = √q, NaN where q < 0."""
        return voltage_of(self.voltage_squared)

    def __len__(self) -> int:
        return len(self.pressure)

    def to_json(self) -> dict:
        """Columns under the names of the JSON contract."""
        out: dict[str, Any] = {name: getattr(self, name) for name in QUANTITIES}
        out["index"] = [None if i < 0 else int(i) for i in self.index]
        return plain(out | {"start": self.start.name, "end": self.end.name, "flags": list(self.flags)})

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The branch of a document of `to_json`."""
        columns = {n: np.array([_number_of(v) for v in document[n]]) for n in QUANTITIES if n != "index"}
        columns["index"] = np.array([-1 if i is None else i for i in document["index"]])
        if len({len(column) for column in columns.values()}) != 1:
            raise ValueError("The columns of a branch must have one length, but have several.")
        start, end = Code[document["start"]], Code[document["end"]]
        return cls(**columns, start=start, end=end, flags=tuple(document["flags"]))

    def __repr__(self) -> str:
        v, q = self.volume, self.voltage_squared
        return (
            f"Branch({len(self)} points, volume {v.min():.6g} to {v.max():.6g}, voltage_squared {q.min():.6g} to "
            f"{q.max():.6g}, from {self.start.name} to {self.end.name})"
        )


@dataclasses.dataclass(frozen=True)
class Event:
    """One event of a ramp: start, snap, landing, snap_back, breakdown, no_landing or end."""

    event: RampEvent
    direction: str
    state: State
    reason: str | None = None

    def to_json(self, control: str = "voltage") -> dict:
        """The event under the names of the JSON contract, with the charge where that is the control."""
        s = self.state
        controls = {"charge": s.charge} if control == "charge" else {}
        return plain(
            {"event": self.event, "direction": self.direction, "voltage": s.voltage, **controls, "pressure": s.pressure}
            | {"volume": s.volume, "apex_stretch": s.apex_stretch, "breakdown_ratio": s.breakdown_ratio}
            | {"error_estimate": s.error_estimate, "reason": self.reason}
        )

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The event of a document of `to_json`; of its state the height, and the charge unless it is the control, are not known."""
        state = State.from_json(document)
        return cls(RampEvent(document["event"]), document["direction"], state, document["reason"])


@dataclasses.dataclass(frozen=True)
class Ramp:
    """What an experiment sees as its control rises (or falls) slowly: events in order, and the area strain."""

    events: tuple[Event, ...]
    area_strain: float | None = None
    area_strain_reason: str | None = None

    def __getitem__(self, name: str) -> list[Event]:
        """All events of one name, such as `ramp["landing"]`."""
        return [e for e in self.events if e.event == name]

    def _repr_html_(self) -> str:
        strain = "" if self.area_strain is None else f"area strain {self.area_strain:.6g} ({self.area_strain_reason})"
        return events_table(self.events, strain)

    def to_json(self) -> list[dict]:
        """The events in order."""
        return [e.to_json() for e in self.events]


def points_table(points: list[SpecialPoint], caption: str = "", units: Any = None) -> str:
    """Special points as an HTML table, in the units' reading where they are given."""
    names = ("voltage", "pressure", "volume", "apex_stretch", "breakdown_ratio", "index")
    shown = points if units is None else units.read(points)
    rows = [[p.kind, p.branch, *(getattr(p, n) for n in names)] for p in shown]
    return html_table(["kind", "branch", *column_heads(names, units)], rows, caption)


def column_heads(names: tuple[str, ...], units: Any) -> list[str]:
    """The heads of columns, with the units in which people read them."""
    named = {} if units is None else units.names(read=True)
    return [n.replace("_", " ") + (f" / {named[n]}" if n in named else "") for n in names]


def events_table(events: tuple[Event, ...], caption: str = "", units: Any = None) -> str:
    """The events of ramps as an HTML table, in the units' reading where they are given."""
    names = ("voltage", "pressure", "volume", "apex_stretch", "breakdown_ratio")
    shown = events if units is None else units.read(events)
    rows = [[e.event, e.direction, *(getattr(e.state, n) for n in names), e.reason or ""] for e in shown]
    return html_table(["event", "direction", *column_heads(names, units), "reason"], rows, caption)
