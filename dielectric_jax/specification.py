"""Sweeps written down: a file of TOML that says which scene, which parameters vary and how, and with which engine."""

import pathlib
import tomllib
import typing

import numpy as np

from .axes import Axis, axes_of, read_scenes, samples, zipped
from .elastomers import MooneyRivlin, Ogden
from .loading import Chamber, ConstantPressure
from .materials import ArrudaBoyce, ConstantBreakdown, Gent, NeoHookean, VHBBreakdown
from .membrane import Membrane
from .scene import PARAMETERS, Scene, Window

__all__ = ["read_specification", "scene_of"]

_MATERIALS = {
    "gent": Gent,
    "neo-hookean": NeoHookean,
    "arruda-boyce": ArrudaBoyce,
    "mooney-rivlin": MooneyRivlin,
    "ogden": Ogden,
}
_LISTS = ("moduli", "exponents")
_PLACES = ("loading", "membrane", "breakdown", "material")
_OPTIONS = {"engine": str, "resolve": bool, "curves": bool, "tolerance": float, "block": int}
_TABLES = ("scene", "product", "zip", "samples", "table")
_DISTRIBUTIONS = {
    "uniform": ("from", "to"),
    "loguniform": ("from", "to"),
    "normal": ("mean", "standard_deviation"),
    "lognormal": ("median", "factor"),
    "triangular": ("from", "to", "mode"),
}


def _refuse(table: str, given: typing.Iterable[str], allowed: typing.Iterable[str]) -> None:
    for name in given:
        if name not in allowed:
            raise ValueError(f"`{name}` in [{table}] must be one of {', '.join(allowed)}, but is none of them.")


def _table(name: str, value: typing.Any) -> dict:
    if not isinstance(value, dict):
        raise ValueError(f"`{name}` must be a table, but is {value!r}.")
    return value


def _number(table: str, name: str, value: typing.Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"`{name}` in [{table}] must be a number, but is {value!r}.")
    return float(value)


def scene_of(given: dict[str, typing.Any]) -> Scene:
    """The scene of parameters by their published names, `material` and `breakdown` ("vhb" or a field), and windows.

    The inverse of `describe`. Raises ValueError for names that a scene does not have.

    >>> scene = scene_of({"material": "neo-hookean", "pressure": 1.5, "prestretch": 1.2})
    >>> float(scene.loading.pressure), float(scene.membrane.prestretch)
    (1.5, 1.2)
    """
    names = [n for n, path in PARAMETERS.items() if path[-2] in _PLACES and n != "volume"]
    _refuse("scene", given, ("material", "breakdown", "stretch_window", "load_window", *names))
    material = given.get("material", "gent")
    if material not in _MATERIALS:
        raise ValueError(f"`material` must be one of {', '.join(_MATERIALS)}, but is {material!r}.")
    numbers = {
        n: _values("scene", n, v) if n in _LISTS else _number("scene", n, v)
        for n, v in given.items()
        if n in PARAMETERS
    }
    parts: dict[str, dict[str, typing.Any]] = {place: {} for place in _PLACES}
    for name, value in numbers.items():
        parts[PARAMETERS[name][-2]][PARAMETERS[name][-1]] = value
    breakdown = given.get("breakdown", "vhb")
    field = () if breakdown == "vhb" else (_number("scene", "breakdown", breakdown),)
    try:
        law = (ConstantBreakdown if field else VHBBreakdown)(*field, **parts["breakdown"])
        film = _MATERIALS[material](**parts["material"])
    except TypeError:
        own = ", ".join(n for n in numbers if PARAMETERS[n][-2] in ("breakdown", "material"))
        raise ValueError(f"`material` and `breakdown` must have the parameters {own}, but one does not.") from None
    membrane = Membrane(film, breakdown=law, **parts["membrane"])
    loading = parts["loading"]
    if ("pressure" in loading) == ("volume" in loading):
        raise ValueError("`pressure` or `chamber_volume` must be given, one of the two, but both or neither are.")
    if "pressure" in loading and len(loading) > 1:
        raise ValueError("`pressure` must be given without the parameters of a chamber, but some are given.")
    window = Window(given.get("stretch_window"), given.get("load_window", (-1.0, 1.0)))
    if "pressure" in loading:
        return Scene(membrane, ConstantPressure(loading["pressure"]), window)
    return Scene(membrane, Chamber(**typing.cast(typing.Any, loading)), window)


def _values(table: str, name: str, given: typing.Any) -> np.ndarray:
    """The values of a parameter: a list, or {from, to, count, spacing = "linear" or "log"}."""
    if isinstance(given, list):
        return np.array([_number(table, name, v) for v in given])
    own = _table(name, given)
    _refuse(f"{table}.{name}", own, ("from", "to", "count", "spacing"))
    missing = [key for key in ("from", "to", "count") if key not in own]
    if missing:
        raise ValueError(f"`{missing[0]}` must be given for `{name}` in [{table}], but is not.")
    low, high = (_number(table, key, own[key]) for key in ("from", "to"))
    count, spacing = own["count"], own.get("spacing", "linear")
    if isinstance(count, bool) or not (isinstance(count, int) and count > 0):
        raise ValueError(f"`count` must be a positive whole number for `{name}` in [{table}], but is {count!r}.")
    if spacing not in ("linear", "log"):
        raise ValueError(f"`spacing` must be linear or log for `{name}` in [{table}], but is {spacing!r}.")
    if spacing == "log" and not min(low, high) > 0:
        raise ValueError(f"`from` and `to` must be positive with spacing log for `{name}` in [{table}].")
    return (np.geomspace if spacing == "log" else np.linspace)(low, high, count)


def _distribution(table: str, name: str, given: typing.Any):
    """A distribution of scipy.stats by its name and numbers."""
    from scipy import stats

    own = dict(_table(name, given))
    kind = own.pop("distribution", "uniform")
    if kind not in _DISTRIBUTIONS:
        raise ValueError(f"`distribution` must be one of {', '.join(_DISTRIBUTIONS)}, but is {kind!r} for `{name}`.")
    keys = _DISTRIBUTIONS[kind]
    _refuse(f"{table}.{name}", own, keys)
    missing = [key for key in keys if key not in own]
    if missing:
        raise ValueError(f"`{missing[0]}` must be given for `{name}` in [{table}], but is not.")
    a, b, *more = (_number(table, key, own[key]) for key in keys)
    rising = kind in ("normal", "lognormal") or a < b
    inside = not more or a <= more[0] <= b
    positive = {"loguniform": a > 0, "normal": b > 0, "lognormal": a > 0 and b > 1}.get(kind, True)
    if not (rising and inside and positive):
        told = ", ".join(f"{key} {value:g}" for key, value in zip(keys, (a, b, *more), strict=True))
        raise ValueError(f"`{name}` in [{table}] must have a {kind} distribution, but {told} make none.")
    return {
        "uniform": lambda: stats.uniform(a, b - a),
        "loguniform": lambda: stats.loguniform(a, b),
        "normal": lambda: stats.norm(a, b),
        "lognormal": lambda: stats.lognorm(np.log(b), scale=a),
        "triangular": lambda: stats.triang((more[0] - a) / (b - a), a, b - a),
    }[kind]()


def _axes(document: dict, folder: pathlib.Path) -> list[Axis]:
    product = {n: _values("product", n, v) for n, v in _table("product", document.get("product", {})).items()}
    axes = list(axes_of(product))
    for dimension, columns in _table("zip", document.get("zip", {})).items():
        table = f"zip.{dimension}"
        axes.append(zipped(dimension, **{n: _values(table, n, v) for n, v in _table(table, columns).items()}))
    for dimension, given in _table("samples", document.get("samples", {})).items():
        table, own = f"samples.{dimension}", dict(_table(f"samples.{dimension}", given))
        if "count" not in own:
            raise ValueError(f"`count` must be given in [{table}], but is not.")
        options: dict[str, typing.Any] = {key: own.pop(key) for key in ("method", "seed") if key in own}
        count = own.pop("count")
        drawn: dict[str, typing.Any] = {name: _distribution(table, name, v) for name, v in own.items()}
        axes.append(samples(count, dimension, **options, **drawn))
    for dimension, given in _table("table", document.get("table", {})).items():
        own = _table(f"table.{dimension}", given)
        _refuse(f"table.{dimension}", own, ("file",))
        axes.append(read_scenes(folder / str(own.get("file", "")), dimension))
    return axes


def read_specification(path) -> tuple[Scene, list[Axis], dict[str, typing.Any]]:
    """The scene, the axes and the options (keyword arguments of `sweep`) that a file of TOML asks for.

    [scene] gives the scene, [product] lists of values, [zip.NAME] parameters that vary together, [samples.NAME]
    distributions, [table.NAME] a CSV file; `engine`, `resolve`, `curves`, `tolerance` and `block` stand above them.
    Raises ValueError in one sentence that names what is wrong.
    """
    path = pathlib.Path(path)
    try:
        with open(path, "rb") as file:
            document = tomllib.load(file)
    except OSError:
        raise ValueError(f"`SPEC` must be a file that can be read, but is {str(path)!r}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"`SPEC` must hold TOML, but {str(path)!r} does not: {error}.") from None
    for name in document:
        if name not in (*_OPTIONS, *_TABLES):
            allowed = ", ".join((*_OPTIONS, *(f"[{t}]" for t in _TABLES)))
            raise ValueError(f"`{name}` in {str(path)!r} must be one of {allowed}, but is none of them.")
    options = {name: document[name] for name in _OPTIONS if name in document}
    for name, value in options.items():
        kind = _OPTIONS[name]
        good = isinstance(value, (int, float)) if kind is float else isinstance(value, kind)
        if not good or (isinstance(value, bool) and kind is not bool):
            what = {str: "a text", bool: "true or false", float: "a number", int: "a whole number"}[kind]
            raise ValueError(f"`{name}` in {str(path)!r} must be {what}, but is {value!r}.")
    axes = _axes(document, path.parent)
    given = dict(_table("scene", document.get("scene", {})))
    varied = {name: float(values[0]) for axis in axes for name, values in axis.columns.items()}
    if any(name.startswith("initial_") for name in varied):
        given = {name: value for name, value in given.items() if not name.startswith("initial_")}
    return scene_of(given | varied), axes, options
