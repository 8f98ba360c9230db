"""The headings of columns in measurement files: the quantity a heading names, and the size of its unit in SI."""

import dataclasses
import re
import unicodedata

from ..model import is_unit_absolute, unit_size
from .resolution import LONGEST_HEAD

__all__ = ["Head", "is_absolute", "read_head", "unit_of_column"]

_NAMES = {
    "volume": ("volume", "vol", "volumen", "volym", "volumes", "объем", "объём", "体积", "容积", "體積", "体積"),
    "height": ("height", "deflection", "sag", "höhe", "hauteur", "altura", "altezza", "höjd", "高度", "高さ"),
    "pressure": (
        *("pressure", "press", "pres", "druck", "überdruck", "ueberdruck", "pression", "presión", "presion"),
        *("pressione", "pressão", "pressao", "tryck", "давление", "压力", "压强", "气压", "壓力", "圧力"),
    ),
    "voltage": ("voltage", "hv", "spannung", "spänning", "voltaje", "напряжение", "电压", "電壓", "電圧"),
    "time": ("time", "zeit", "temps", "tiempo", "tempo", "tid", "时间", "時間"),
    "stretch": ("stretch", "stretch ratio", "lambda", "streckung", "étirement", "拉伸比"),
    "strain": ("strain", "dehnung", "déformation", "deformación", "deformazione", "töjning", "应变", "ひずみ"),
    "stress": ("stress", "spannung", "contrainte", "tensión", "sforzo", "напряжение", "应力", "応力"),
    "true stress": ("true stress", "cauchy stress", "true cauchy stress", "wahre spannung", "真应力"),
}
_SHORT = {"volume": "v", "height": "h", "pressure": "p", "voltage": "[uvφ]", "time": "t", "stretch": "λ"}
# σ is not among them: it may be either stress
_SHORT |= {"strain": "[εe]", "stress": "s", "true stress": "(?!)"}
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
# further words that make a column another quantity: the stress on the deformed cross-section is another than the nominal one
_MORE_WORDS = {
    "stretch": ("rate",),
    "strain": ("true", "logarithmic", "log", "hencky", "shear", "area", "green", "lagrange"),
    "stress": ("true", "cauchy", "shear", "kirchhoff"),
    "true stress": ("shear", "kirchhoff"),
    "voltage": (
        "sensor",
        "output",
        "monitor",
        "transducer",
        "signal",
        "gauge",
        "pump",
        "control",
        "breakdown",
        "pressure",
    ),
    "height": ("initial", "chamber"),
}
_OTHER = {
    quantity: re.compile(
        rf"(?<![a-z])({'|'.join(w for w in (*_OTHER_WORDS, *_MORE_WORDS.get(quantity, ('true', 'cauchy'))) if w != quantity)})(?![a-z])"
    )
    for quantity in _NAMES
}
# a symbol that stands for several quantities says by its unit which one it is
_SHORT_BY_UNIT = ("height", "voltage", "strain")
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


def _plain(text: str) -> str:
    """A heading in composed letters, without marks of remarks and quotes around it."""
    # full-width brackets and letters are those of a Chinese or Japanese keyboard
    text = re.sub(r"[！-～]", lambda c: unicodedata.normalize("NFKC", c[0]), unicodedata.normalize("NFC", text))
    return unicodedata.normalize("NFC", text.strip().lstrip("#%").strip().strip("\"'").strip())


def unit_of_column(text: str, quantity: str) -> str | None:
    """The unit in the heading of a column that is known to hold `quantity`, whatever the heading calls it; None without.

    Raises ValueError as `unit_size` does.

    >>> unit_of_column("Gauge 2 (mbar)", "pressure"), unit_of_column("X", "height"), unit_of_column("mm", "height")
    ('mbar', None, 'mm')
    """
    if len(text) > LONGEST_HEAD:
        return None
    text = _plain(text)
    unit = _label_and_unit(text, quantity)[1]
    return text if unit is None and unit_size(text, quantity) else unit


def read_head(text: str) -> list[Head]:
    """The possible meanings of a column's heading: no quantity, or one or more.

    Raises ValueError as `unit_size` does.

    >>> read_head("Volume injected (mL)")
    [Head(quantity='volume', unit='mL', size=1e-06, rank=2, absolute=False)]
    >>> read_head("V [kV]"), read_head("Volume flow [ml/min]")
    ([Head(quantity='voltage', unit='kV', size=1000.0, rank=1, absolute=False)], [])
    """
    found = []
    if len(text) > LONGEST_HEAD:
        return found
    text = _plain(text)
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
        if unit is None and quantity in _SHORT_BY_UNIT:
            short = None
        if not (
            words
            or (
                short and (size or (unit is None and not short[1]) or (quantity in ("stretch", "strain") and size == 0))
            )
        ) or _OTHER[quantity].search(plain):
            continue
        if wrong is not None:
            raise wrong
        rank = (0 if plain in names else 2) if words else (1 if unit else 3)
        found.append(
            Head(quantity, unit, size, rank, quantity == "pressure" and (is_absolute(plain) or is_absolute(unit or "")))
        )
    # of the meanings of one name, such as the German Spannung, those that the unit allows
    return [head for head in found if head.size is not None] or found
