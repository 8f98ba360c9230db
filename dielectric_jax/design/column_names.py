"""The headings of columns in measurement files: the quantity a heading names, and the size of its unit in SI."""

import dataclasses
import re
import unicodedata

from ..model import is_unit_absolute, unit_size
from .resolution import LONGEST_HEAD

__all__ = ["Head", "is_absolute", "read_head"]

_NAMES = {
    "volume": ("volume", "vol", "volumen", "volym", "volumes", "体积", "容积", "體積", "体積"),
    "pressure": (
        *("pressure", "press", "pres", "druck", "überdruck", "ueberdruck", "pression", "presión", "presion"),
        *("pressione", "pressão", "pressao", "tryck", "压力", "压强", "气压", "壓力", "圧力"),
    ),
    "time": ("time", "zeit", "temps", "tiempo", "tempo", "tid", "时间", "時間"),
    "stretch": ("stretch", "stretch ratio", "lambda", "streckung", "étirement", "拉伸比"),
    "stress": ("stress", "spannung", "contrainte", "tensión", "sforzo", "应力", "応力"),
}
_SHORT = {"volume": "v", "pressure": "p", "time": "t", "stretch": "λ", "stress": "s"}
# a column with one of these words is another quantity, although its heading names a volume or a pressure
_OTHER_WORDS = (
    *(
        "rate",
        "flow",
        "std",
        "sd",
        "stdev",
        "error",
        "err",
        "uncertainty",
        "chamber",
        "reservoir",
        "tank",
        "setpoint",
        "target",
    ),
    *("atmospheric", "ambient", "barometric", "supply", "source", "initial", "temperature", "voltage", "time"),
)
# the stress on the deformed cross-section is another than the nominal one
_OTHER = {
    quantity: re.compile(
        rf"(?<![a-z])({'|'.join(w for w in (*_OTHER_WORDS, 'true', 'cauchy') if w != quantity)})(?![a-z])"
    )
    for quantity in _NAMES
}
_ABSOLUTE = re.compile(r"(?<![a-z])(abs|absolute)(?![a-z])")


def is_absolute(text: str) -> bool:
    """Whether a heading or a unit of pressure says that it is absolute."""
    return bool(_ABSOLUTE.search(text.lower())) or is_unit_absolute(text)


@dataclasses.dataclass(frozen=True)
class Head:
    """The content of a column's heading: its `quantity`, its `unit` as written (None without), and its `size` in SI.

    `size` is None for an unknown unit, and 0 for dimensionless numbers and if no unit is named; `rank` orders headings of
    one quantity: 0 is its name alone, 1 its symbol with a unit, 2 a heading that contains its name, 3 the symbol alone.
    `absolute` says whether pressures are absolute.
    """

    quantity: str
    unit: str | None = None
    size: float | None = 0.0
    rank: int = 0
    absolute: bool = False


def _label_and_unit(text: str, quantity: str) -> tuple[str, str | None]:
    """The label and the unit of a heading: in brackets, after a slash, comma, colon or `in`, or as the last word."""
    own = re.fullmatch(r"(.*?)\s*(?:A\s*/\s*\(?\s*[μµu]\s*H\s*\)?|/\s*A(?:³|\^?3))", text)
    if own:  # this package's own dimensionless numbers
        return own[1], "-"
    brackets = re.findall(r"[\[({<]([^\[\](){}<>]*(?:\([^()]*\))?)[\])}>]", text)
    label = re.sub(r"[\[({<].*?[\])}>]\)?", " ", text).strip()
    if brackets:
        known = [b for b in brackets if unit_size(b, quantity) is not None]
        if known or not re.fullmatch(r"[\w\s]*(gauge|rel|relative|abs|absolute)[\w\s]*", brackets[-1].lower()):
            unit = known[-1] if known else brackets[-1]
            return " ".join([label, *(b for b in brackets if b != unit)]), unit.strip()
        return " ".join([label, *brackets]), None
    for pattern in (r"(.*?)\s*[/,;:|]\s*(.+)", r"(.+?)\s+in\s+(.+)", r"(.*?)[\s_.\-]+(\S+)", r"(.*)[\s_.\-]+(\S+)"):
        found = re.fullmatch(pattern, text, re.IGNORECASE)
        if found and unit_size(found[2], quantity) and found[1].strip():
            return found[1].strip(), found[2].strip()
    named = re.fullmatch(r"(\w+)\s*(?:[/,;|]|\s+in\s)\s*(.+)", text)  # with an unknown unit
    return (named[1], named[2]) if named and named[1].lower() in _NAMES[quantity] else (text, None)


def read_head(text: str) -> list[Head]:
    """The possible meanings of a column's heading: no quantity, or one or more.

    Raises ValueError as `unit_size` does.

    >>> read_head("Volume injected (mL)")
    [Head(quantity='volume', unit='mL', size=1e-06, rank=2, absolute=False)]
    >>> read_head("V [kV]"), read_head("Volume flow [ml/min]")
    ([], [])
    """
    found = []
    if len(text) > LONGEST_HEAD:
        return found
    text = unicodedata.normalize("NFC", text.strip().lstrip("#%").strip().strip("\"'").strip())
    for quantity, names in _NAMES.items():
        try:
            label, unit = _label_and_unit(text, quantity)
            size = 0.0 if unit is None else unit_size(unit, quantity)
            wrong = None
        except ValueError as error:
            label, unit, size, wrong = text, None, None, error
        plain = re.sub(r"[\s_.\-]+", " ", label.lower()).strip()
        words = [w for w in names if re.search(rf"(?<![a-zà-ÿ]){w}(?![a-zà-ÿ])" if w.isascii() else w, plain)]
        short = re.fullmatch(rf"(δ|d|delta )?\s*{_SHORT[quantity]}( ?(gauge|g|rel|abs|inj|injected|mem|film))?", plain)
        if not (
            words or (short and (size or (unit is None and not short[1]) or (quantity == "stretch" and size == 0)))
        ) or _OTHER[quantity].search(plain):
            continue
        if wrong is not None:
            raise wrong
        rank = (0 if plain in names else 2) if words else (1 if unit else 3)
        found.append(
            Head(quantity, unit, size, rank, quantity == "pressure" and (is_absolute(plain) or is_absolute(unit or "")))
        )
    return found
