"""The headings of columns in measurement files: the quantity a heading names, and the size of its unit in SI."""

import dataclasses
import itertools
import re
import unicodedata

from .resolution import LONGEST_HEAD

__all__ = ["Head", "is_absolute", "names_text", "read_head", "unit_size"]

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

_PREFIXES = {
    **{"T": 1e12, "G": 1e9, "M": 1e6, "k": 1e3, "h": 1e2, "da": 1e1, "": 1.0},
    **{"d": 1e-1, "c": 1e-2, "m": 1e-3, "μ": 1e-6, "u": 1e-6, "n": 1e-9},
}
_PREFIX_WORDS = {
    **{"mega": 1e6, "kilo": 1e3, "hecto": 1e2, "": 1.0, "deci": 1e-1, "centi": 1e-2, "milli": 1e-3},
    **{"micro": 1e-6, "nano": 1e-9},
}


def _with_prefixes(prefixes: str, base: str, power: int = 1, size: float = 1.0) -> dict[str, float]:
    return {p + base: size * _PREFIXES[p] ** power for p in prefixes.split("|")}


def _in_words() -> dict[str, dict[str, float]]:
    words: dict[str, dict[str, float]] = {"volume": {}, "pressure": {}}
    for (prefix, size), plural in itertools.product(_PREFIX_WORDS.items(), ("", "s")):
        for base, value in (("litre", 1e-3), ("liter", 1e-3)):
            words["volume"][prefix + base + plural] = size * value
        for base in ("metre", "meter"):
            for cubic in ("cubic", "cu"):
                words["volume"][cubic + prefix + base + plural] = size**3
        for base, value in (("pascal", 1.0), ("bar", 1e5)):
            words["pressure"][prefix + base + plural] = size * value
    return words


_MMHG, _INCH, _PSI, _CMH2O = 133.322387415, 0.0254, 6894.757293168, 98.0665
# spelled as returned by `_plain`: without blanks, superscripts or carets, μ for every micro sign
_UNITS = {
    "volume": {
        **_with_prefixes("|d|c|m|μ|u", "m3", 3),
        **_with_prefixes("|d|c|m|μ|u|n", "L", 1, 1e-3),
        **_with_prefixes("|d|c|m|μ|u|n", "l", 1, 1e-3),
        **{"cc": 1e-6, "ccm": 1e-6, "cmm": 1e-9, "in3": _INCH**3, "cuin": _INCH**3},
    },
    "pressure": {
        **_with_prefixes("G|M|k|h|da||m|μ|u", "Pa"),
        **_with_prefixes("|m|μ|u", "bar", 1, 1e5),
        **{"psi": _PSI, "lbf/in2": _PSI, "lb/in2": _PSI, "ksi": 1e3 * _PSI, "atm": 101325.0},
        **{"mmHg": _MMHG, "cmHg": 10 * _MMHG, "inHg": 25.4 * _MMHG, "Torr": 101325 / 760, "mTorr": 101.325 / 760},
        **{"mmH2O": _CMH2O / 10, "cmH2O": _CMH2O, "mH2O": 100 * _CMH2O, "inH2O": 2.54 * _CMH2O},
        **{"mmWC": _CMH2O / 10, "cmWC": _CMH2O, "inWC": 2.54 * _CMH2O, "mmWS": _CMH2O / 10, "mmAq": _CMH2O / 10},
        **{"N/m2": 1.0, "Nm-2": 1.0, "kN/m2": 1e3, "N/mm2": 1e6, "N/cm2": 1e4, "dyn/cm2": 0.1, "kgf/cm2": 98066.5},
    },
}
for _quantity, _words in _in_words().items():
    _UNITS[_quantity] |= _words
_SECONDS = ("sec", "secs", "second", "seconds"), ("minute", "minutes"), ("hr", "hour", "hours")
_UNITS["time"] = {**_with_prefixes("|m|μ|u", "s"), "min": 60.0, "h": 3600.0}
for _sizes, _words in zip((1.0, 60.0, 3600.0), _SECONDS, strict=True):
    _UNITS["time"] |= dict.fromkeys(_words, _sizes)
_UNITS["stress"] = _UNITS["pressure"]
_UNITS["stretch"] = {}
_ENDINGS = ("(g)", "(a)", "g", "a", "gauge", "gage", "absolute", "abs", "rel")
# for this package's own dimensionless numbers
_NONE = {
    "volume": ("-", "1", "a3"),
    "pressure": ("-", "1", "μh/a", "uh/a"),
    "time": ("-", "1", "τ"),
    "stretch": ("-", "1", "mm/mm", "m/m"),
    "stress": ("-", "1", "μ"),
}


def names_text(quantity: str) -> str:
    """Examples of units of a quantity, for messages."""
    return {
        "volume": "m³, L, ml, µl, cm³, mm³",
        "pressure": "Pa, hPa, kPa, bar, mbar, psi, mmHg",
        "time": "s, ms, min, h",
        "stretch": "- or mm/mm (a strain is not a stretch)",
        "stress": "Pa, kPa, MPa, N/mm², psi",
    }[quantity]


def _plain(text: str) -> str:
    """Normalises superscripts, micro signs, full-width letters, carets and blanks."""
    plain = unicodedata.normalize("NFKC", text).replace("µ", "μ")
    plain = re.sub(r"\^|\*\*|\s|·|\.$", "", plain)
    return plain.replace("⋅", "")


def unit_size(text: str, quantity: str) -> float | None:
    """The size of a unit in SI, 0 for the unit of dimensionless numbers, None if the text is not a unit of the quantity.

    Upper and lower case matter only where they distinguish two units. Raises ValueError for a unit that may be two.

    >>> unit_size("mL", "volume"), unit_size("KPA", "pressure"), unit_size("V", "volume"), unit_size("A³", "volume")
    (1e-06, 1000.0, None, 0.0)
    """
    unit, units = _plain(text), _UNITS[quantity]
    if unit.lower() in _NONE[quantity]:
        return 0.0
    for ending in ("", *(_ENDINGS if quantity == "pressure" else ())):
        if not unit.lower().endswith(ending):
            continue
        stem = unit[: len(unit) - len(ending)]
        sizes = {units[stem]} if stem in units else {s for n, s in units.items() if n.lower() == stem.lower()}
        if len(sizes) > 1:
            both = sorted({n for n in units if n.lower() == stem.lower()})
            raise ValueError(f"the unit {text!r} may be {' or '.join(both)}")
        if sizes:
            return sizes.pop()
    return None


def is_absolute(text: str) -> bool:
    """Whether a heading or a unit of pressure says that it is absolute."""
    unit = _plain(text).lower()
    stem = next((unit.removesuffix(e) for e in ("(a)", "a") if unit.endswith(e)), "")
    return bool(_ABSOLUTE.search(text.lower())) or (unit != "pa" and stem in (n.lower() for n in _UNITS["pressure"]))


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
