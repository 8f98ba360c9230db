"""Units by which people write quantities: the size of a unit in SI, and numbers with units as text, such as "0.5 l"."""

import itertools
import math
import re
import unicodedata

from ..numerics import LARGEST, shown

__all__ = ["VACUUM_PERMITTIVITY", "example_units", "is_unit_absolute", "quantity", "unit_size"]

VACUUM_PERMITTIVITY = 8.854e-12  # F/m, with the digits of the paper

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
_UNITS["strain"] = {"%": 0.01, "percent": 0.01, "pct": 0.01}
_UNITS["true stress"] = _UNITS["pressure"]
_UNITS["length"] = {
    **_with_prefixes("|d|c|m|μ|u|n", "m"),
    **{"inch": _INCH, "inches": _INCH, "mil": _INCH / 1000, "micron": 1e-6, "microns": 1e-6},
}
_UNITS["height"] = _UNITS["length"]
_UNITS["voltage"] = _with_prefixes("M|k||m", "V")
_UNITS["field"] = {
    f"{volt}/{metre}": size / length
    for volt, size in _with_prefixes("M|k|", "V").items()
    for metre, length in _with_prefixes("|c|m|μ|u", "m").items()
}
_UNITS["permittivity"] = {"F/m": 1.0, "pF/m": 1e-12} | dict.fromkeys(("ε0", "eps0"), VACUUM_PERMITTIVITY)
_UNITS["density"] = {"kg/m3": 1.0, "g/cm3": 1e3, "g/cc": 1e3, "g/ml": 1e3, "kg/L": 1e3, "kg/l": 1e3}
_ENDINGS = ("(g)", "(a)", "g", "a", "gauge", "gage", "absolute", "abs", "rel")
# for this package's own dimensionless numbers
_NONE = {
    "volume": ("-", "1", "a3"),
    "pressure": ("-", "1", "μh/a", "uh/a"),
    "time": ("-", "1", "τ"),
    "stretch": ("-", "1", "mm/mm", "m/m"),
    "strain": ("-", "1", "mm/mm", "m/m"),
    "stress": ("-", "1", "μ"),
    "true stress": ("-", "1", "μ"),
    "height": ("-", "1", "a"),
    "voltage": ("-", "1"),
}
_EXAMPLES = {
    "volume": "m³, L, ml, µl, cm³, mm³",
    "pressure": "Pa, hPa, kPa, bar, mbar, psi, mmHg",
    "time": "s, ms, min, h",
    "stretch": "- or mm/mm (a strain is not a stretch)",
    "strain": "-, mm/mm or %",
    "stress": "Pa, kPa, MPa, N/mm², psi",
    "true stress": "Pa, kPa, MPa, N/mm², psi",
    "height": "m, cm, mm, µm",
    "length": "m, cm, mm, µm",
    "voltage": "V, kV",
    "field": "V/m, MV/m, kV/mm, V/µm",
    "permittivity": "F/m, pF/m, eps0",
    "density": "kg/m³, g/cm³",
}


def example_units(kind: str) -> str:
    """Examples of units of a kind of quantity, for messages."""
    return _EXAMPLES[kind]


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
    if unit.lower() in _NONE.get(quantity, ()):
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


def is_unit_absolute(text: str) -> bool:
    """Whether a unit says that a pressure is absolute, such as "bar(a)" or "psia"."""
    unit = _plain(text).lower()
    stem = next((unit.removesuffix(e) for e in ("(a)", "a") if unit.endswith(e)), "")
    return unit != "pa" and stem in (n.lower() for n in _UNITS["pressure"])


def quantity(text: str, kind: str) -> float:
    """A number with its unit, in SI; `kind` is "volume", "pressure", "length", "voltage", "field", "stress", "permittivity", "density".

    Raises ValueError for a text that is none, with units that are allowed.

    >>> quantity("0.5 l", "volume"), quantity("22mbar", "pressure"), quantity("80 MV/m", "field")
    (0.0005, 2200.0, 80000000.0)
    """
    found = re.fullmatch(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*(\D.*?)\s*", text)
    try:
        size = found and unit_size(found[2], kind)
    except ValueError as error:
        raise ValueError(f"must be a number with a unit of {kind}, but in {shown(text)} {error}.") from None
    if not found or not size or (kind == "pressure" and is_unit_absolute(found[2])):
        raise ValueError(f"must be a number with a unit such as {_EXAMPLES[kind]}, but is {shown(text)}.")
    value = float(f"{found[1]}") * size
    if not (math.isfinite(value) and abs(value) <= LARGEST):
        raise ValueError(f"must be finite and at most {LARGEST:g} in size, but is {shown(text)}.")
    return value
