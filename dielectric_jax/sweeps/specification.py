"""Specifications of sweeps: a TOML file with the scene, the parameters that vary and how, and the engine."""

import dataclasses
import pathlib
import typing
from collections.abc import Mapping

import numpy as np

from ..model import (
    Scene,
    check_sizes,
    number,
    one_of,
    other_filling_left_out,
    place_of,
    read_toml,
    refuse,
    scene_of,
    table,
    values,
)
from ..numerics import shown, whole_range
from .axes import Axis, axes_of, read_scenes, samples, zipped

__all__ = ["read_specification"]

_OPTIONS = {"engine": str, "resolve": bool, "curves": bool, "tolerance": float, "block": int, "modes": str}
_TABLES = ("scene", "units", "product", "zip", "samples", "table")
_DISTRIBUTIONS = {
    "uniform": ("from", "to"),
    "loguniform": ("from", "to"),
    "normal": ("mean", "standard_deviation"),
    "lognormal": ("median", "factor"),
    "triangular": ("from", "to", "mode"),
}


def _distribution(where: str, name: str, given: typing.Any):
    """A distribution of scipy.stats by its name and parameters."""
    from scipy import stats

    own = dict(table(name, given))
    kind = one_of(f"{where}.{name}", "distribution", own.pop("distribution", "uniform"), _DISTRIBUTIONS)
    keys = _DISTRIBUTIONS[kind]
    refuse(f"{where}.{name}", own, keys)
    missing = [key for key in keys if key not in own]
    if missing:
        raise ValueError(f"`{missing[0]}` must be given for `{name}` in [{where}], but is not.")
    a, b, *more = (number(where, key, own[key]) for key in keys)
    rising = kind in ("normal", "lognormal") or a < b
    inside = not more or a <= more[0] <= b
    positive = {"loguniform": a > 0, "normal": b > 0, "lognormal": a > 0 and b > 1}.get(kind, True)
    if not (rising and inside and positive):
        given = ", ".join(f"{key} {value:g}" for key, value in zip(keys, (a, b, *more), strict=True))
        raise ValueError(f"`{name}` in [{where}] must have a {kind} distribution, but {given} make none.")
    return {
        "uniform": lambda: stats.uniform(a, b - a),
        "loguniform": lambda: stats.loguniform(a, b),
        "normal": lambda: stats.norm(a, b),
        "lognormal": lambda: stats.lognorm(np.log(b), scale=a),
        "triangular": lambda: stats.triang((more[0] - a) / (b - a), a, b - a),
    }[kind]()


def _axes(document: dict, folder: pathlib.Path) -> list[Axis]:
    product = {n: values("product", n, v) for n, v in table("product", document.get("product", {})).items()}
    axes = list(axes_of(product))
    for dimension, columns in table("zip", document.get("zip", {})).items():
        where = f"zip.{dimension}"
        axes.append(zipped(dimension, **{n: values(where, n, v) for n, v in table(where, columns).items()}))
    for dimension, given in table("samples", document.get("samples", {})).items():
        where, own = f"samples.{dimension}", dict(table(f"samples.{dimension}", given))
        if "count" not in own:
            raise ValueError(f"`count` must be given in [{where}], but is not.")
        options: dict[str, typing.Any] = {key: own.pop(key) for key in ("method", "seed") if key in own}
        count = own.pop("count")
        drawn: dict[str, typing.Any] = {name: _distribution(where, name, v) for name, v in own.items()}
        axes.append(samples(count, dimension, **options, **drawn))
    for dimension, given in table("table", document.get("table", {})).items():
        own = table(f"table.{dimension}", given)
        refuse(f"table.{dimension}", own, ("file",))
        file = own.get("file")
        if not (isinstance(file, str) and file):
            raise ValueError(f"`file` must name a CSV file in [table.{dimension}], but is {shown(file)}.")
        axes.append(read_scenes(folder / file, dimension))
    return axes


def _own_engine(document: dict, engines: Mapping[str, type]) -> tuple[typing.Any, tuple[str, ...]]:
    """The engine whose table the document holds, None without one, and the names of axes that only it knows."""
    named = [name for name in engines if name in document]
    if not named:
        return None, ()
    for name in (*named[1:], *(n for n in _OPTIONS if n != "block" and n in document)):
        raise ValueError(f"`{name}` must be left out beside [{named[0]}].")
    kind, given = engines[named[0]], table(named[0], document[named[0]])
    refuse(named[0], given, [field.name for field in dataclasses.fields(kind)])
    return kind(**given), tuple(kind.parameters)


def read_specification(
    path, engines: Mapping[str, type] | None = None
) -> tuple[Scene, list[Axis], dict[str, typing.Any]]:
    """The scene, the axes and the options (keyword arguments of `sweep`) in a TOML file.

    [scene] gives the scene, [units] the constants in SI that it carries, if any, [product] lists of values, [zip.NAME]
    parameters that vary together, [samples.NAME] distributions, [table.NAME] a CSV file; `engine`, `resolve`, `curves`,
    `tolerance`, `block` and `modes` (such as "1:24") are placed above the tables. A table of the name of one of
    the `engines`, dataclasses such as `{"in_time": dj.rates.InTime}`, holds the fields of that engine. Raises ValueError with one
    sentence that says what is wrong.
    """
    path = pathlib.Path(path)
    document = read_toml(path)
    engines = engines or {}
    for name in document:
        if name not in (*_OPTIONS, *_TABLES, *engines):
            allowed = ", ".join((*_OPTIONS, *(f"[{t}]" for t in (*_TABLES, *engines))))
            raise ValueError(f"`{name}` in {str(path)!r} must be one of {allowed}, but is none of them.")
    options = {name: document[name] for name in _OPTIONS if name in document}
    for name, value in options.items():
        kind = _OPTIONS[name]
        good = isinstance(value, (int, float)) if kind is float else isinstance(value, kind)
        if not good or (isinstance(value, bool) and kind is not bool):
            what = {str: "a text", bool: "true or false", float: "a number", int: "a whole number"}[kind]
            raise ValueError(f"`{name}` in {str(path)!r} must be {what}, but is {shown(value)}.")
        if kind is float:
            options[name] = number("", name, value)
        if name == "modes":
            options[name] = whole_range(name, str(value))
    axes = _axes(document, path.parent)
    engine, of_engine = _own_engine(document, engines)
    if engine is not None:
        options["engine"] = engine
    columns = {n: column for axis in axes for n, column in axis.columns.items() if n not in of_engine}
    # constants of branches stay as their own tables give them
    varied = {n: float(column[0]) for n, column in columns.items() if "branches" not in place_of(n)}
    given = other_filling_left_out(table("scene", document.get("scene", {})), varied)
    constants = dict(table("units", document.get("units", {})))
    of_units = [n for n in varied if place_of(n)[0] == "units"]
    if of_units and not constants:
        raise ValueError(f"`{of_units[0]}` must have a [units] table of the scene's own constants, but there is none.")
    scene = scene_of(given | {n: v for n, v in varied.items() if n not in of_units}, constants)
    check_sizes(given | columns, constants)
    for name in columns.keys() - varied.keys() if engine is None else ():
        scene.check_varies(name)
    return scene, axes, options
