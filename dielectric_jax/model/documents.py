"""Scenes as documents, in TOML or JSON: tables of parameters by their published names; mistakes are refused in one sentence."""

import dataclasses
import os
import re
import tomllib
import typing

import numpy as np

from ..numerics import LARGEST, check_whole, shown
from .loading import Chamber, ChargeControl, ConstantPressure, ConstantVoltage, PrescribedVolume
from .materials import ArrudaBoyce, ConstantBreakdown, Gent, MooneyRivlin, NeoHookean, Ogden, VHBBreakdown
from .membrane import Membrane
from .parameters import PARAMETERS, parameter_of, place_of
from .quantities import VACUUM_PERMITTIVITY
from .resolution import MOST_VALUES
from .scene import Scene, Window, law_in
from .units import ATMOSPHERE, Units, from_text, refuse_dimensionless, refuse_si
from .viscoelastic import Maxwell, Viscoelastic

__all__ = [
    "check_sizes",
    "described_scene",
    "number",
    "one_of",
    "other_filling_left_out",
    "read_toml",
    "refuse",
    "scene_of",
    "table",
    "values",
]

_MATERIALS = {
    "gent": Gent,
    "neo-hookean": NeoHookean,
    "arruda-boyce": ArrudaBoyce,
    "mooney-rivlin": MooneyRivlin,
    "ogden": Ogden,
}
_PLACES = ("loading", "membrane", "breakdown", "material")


def read_toml(path: str | os.PathLike) -> dict[str, typing.Any]:
    """The content of a TOML file, texts with units as numbers; raises ValueError if it cannot be read or is not TOML."""
    name = os.fspath(path)
    try:
        with open(path, "rb") as file:
            document = tomllib.load(file)
    except OSError as error:
        raise ValueError(
            f"`SPEC` must be a file that can be read, but {shown(name)} is not: {error.strerror}."
        ) from None
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, or a name or number that Python refuses
        raise ValueError(f"`SPEC` must be a file of TOML, but {shown(name)} is not: {error}.") from None
    return _in_numbers(document)


def _in_numbers(document: dict[str, typing.Any]) -> dict[str, typing.Any]:
    """The document with its texts with units, such as "0.5 l", as numbers in SI."""
    made = dict(document)
    if isinstance(document.get("units"), dict):
        own = {n: from_text(n, v) if isinstance(v, str) else v for n, v in document["units"].items()}
        if "relative_permittivity" in own:
            if "permittivity" in own:
                raise ValueError("`permittivity` or `relative_permittivity` must be given in [units], but both are.")
            relative = number("units", "relative_permittivity", own.pop("relative_permittivity"))
            own["permittivity"] = relative * VACUUM_PERMITTIVITY
        made["units"] = own
    in_si = bool(made.get("units"))
    for name in ("scene", "product", "over"):
        if isinstance(document.get(name), dict):
            made[name] = {n: _number_in(n, v, in_si) for n, v in document[name].items()}
    if isinstance(document.get("zip"), dict):
        made["zip"] = {
            d: {n: _number_in(n, v, in_si) for n, v in columns.items()} if isinstance(columns, dict) else columns
            for d, columns in document["zip"].items()
        }
    return made


def _number_in(name: str, value: typing.Any, in_si: bool) -> typing.Any:
    """A value, or the values of a list or range, with texts with units as numbers; what is no quantity stays as it is."""
    if isinstance(value, list):
        return [_number_in(name, v, in_si) for v in value]
    if isinstance(value, dict):
        return {key: _number_in(name, v, in_si) if key in ("from", "to") else v for key, v in value.items()}
    if not (
        isinstance(value, str) and re.match(r"\s*[+-]?\.?\d", value) and (name in PARAMETERS or name == "breakdown")
    ):
        return value
    number_of_text = from_text(name, value)
    if not in_si:
        raise ValueError(f"`{name}` must be a number where there is no [units] table, but is {shown(value)}.")
    return number_of_text


def refuse(where: str, given: typing.Iterable[str], allowed: typing.Iterable[str]) -> None:
    """Raises ValueError for a name of the table `where` that is not allowed."""
    for name in given:
        if name not in allowed:
            place = f" in [{where}]" if where else ""
            raise ValueError(f"`{name}`{place} must be one of {', '.join(allowed)}, but is none of them.")


def table(name: str, value: typing.Any) -> dict:
    """The value, if it is a table."""
    if not isinstance(value, dict):
        raise ValueError(f"`{name}` must be a table, but is {shown(value)}.")
    return value


def number(where: str, name: str, value: typing.Any) -> float:
    """The value, if it is a finite number."""
    place = f" in [{where}]" if where else ""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"`{name}`{place} must be a number, but is {shown(value)}.")
    if not abs(value) <= LARGEST:  # also false for integers too large for a float
        raise ValueError(f"`{name}`{place} must be finite and at most {LARGEST:g} in size, but is {shown(value)}.")
    return float(value)


def one_of(where: str, name: str, value: typing.Any, allowed: typing.Iterable[str]) -> str:
    """The value, if it is one of the allowed words."""
    if not (isinstance(value, str) and value in allowed):
        raise ValueError(f"`{name}` in [{where}] must be one of {', '.join(allowed)}, but is {shown(value)}.")
    return value


def _pair(name: str, value: typing.Any) -> tuple[float, float] | None:
    """The two numbers of a window; None if it is not given."""
    if value is None:
        return None
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(f"`{name}` in [scene] must be a pair [low, high], but is {shown(value)}.")
    return number("scene", name, value[0]), number("scene", name, value[1])


def _elastic(where: str, key: str, material: str, constants: dict) -> typing.Any:
    """A material by its name, with its own constants; `key` is what names it in the table `where`."""
    for name in constants:
        if name not in {constant.name for constant in dataclasses.fields(_MATERIALS[material])}:
            raise ValueError(f"`{name}` in [{where}] must be left out, because the `{key}` {material!r} has none.")
    return _MATERIALS[material](**constants)


def _branch(where: str, given: typing.Any) -> Maxwell:
    """A Maxwell branch: `modulus_ratio`, `relaxation_time`, and its `material` with its constants."""
    own = dict(table(where, given))
    constants = [n for n, row in PARAMETERS.items() if row.path[:2] == ("membrane", "material") and len(row.path) == 3]
    refuse(where, own, ("material", "modulus_ratio", "relaxation_time", *constants))
    material = one_of(where, "material", own.pop("material", "gent"), _MATERIALS)
    numbers = {
        n: values(where, n, v) if parameter_of(n).many and n in constants else number(where, n, v)
        for n, v in own.items()
    }
    for name in ("modulus_ratio", "relaxation_time"):
        if name not in numbers:
            raise ValueError(f"`{name}` must be given in [{where}], but is not.")
    both = {n: numbers.pop(n) for n in ("modulus_ratio", "relaxation_time")}
    return Maxwell(_elastic(where, "material", material, numbers), **both)


def _film(given: dict[str, typing.Any], constants: dict) -> typing.Any:
    """The material of a scene, with branches where it is viscoelastic: then `elastic` names the equilibrium spring."""
    kind = one_of("scene", "material", given.get("material", "gent"), (*_MATERIALS, "viscoelastic"))
    if kind != "viscoelastic":
        for name in ("elastic", "branches"):
            if name in given:
                raise ValueError(
                    f"`{name}` in [scene] must be given with `material` viscoelastic only, but it is {kind!r}."
                )
        return _elastic("scene", "material", kind, constants)
    elastic = one_of("scene", "elastic", given.get("elastic", "gent"), _MATERIALS)
    branches = given.get("branches")
    if not isinstance(branches, list):
        what = "is missing" if branches is None else f"is {shown(branches)}"
        raise ValueError(f"`branches` must be tables [[scene.branches]] of a viscoelastic material, but {what}.")
    made = [_branch(f"scene.branches[{k}]", own) for k, own in enumerate(branches)]
    return Viscoelastic(_elastic("scene", "elastic", elastic, constants), made)


def scene_of(given: dict[str, typing.Any], constants: dict[str, typing.Any] | None = None) -> Scene:
    """The scene with parameters by their published names, `material` and `breakdown` ("vhb" or a field), and windows.

    A viscoelastic material has an `elastic` spring, whose constants stand beside it, and `branches`, a list of tables with
    `modulus_ratio`, `relaxation_time` and their own `material` and constants. `constants` (shear_modulus, thickness, radius or opening_radius,
    permittivity, in SI) are those of the units that the scene carries; then its pressures, its volumes and a breakdown field are in SI
    too. Without them this is the inverse of `describe`. Raises ValueError for names that a scene does not have.

    >>> scene = scene_of({"material": "neo-hookean", "pressure": 1.5, "prestretch": 1.2})
    >>> float(scene.loading.pressure), float(scene.membrane.prestretch)
    (1.5, 1.2)
    """
    names = [n for n, row in PARAMETERS.items() if row.path[-2] in _PLACES and n != "volume"]
    words = ("material", "elastic", "branches", "breakdown", "stretch_window", "load_window")
    refuse("scene", given, (*words, *names))
    numbers = {
        n: values("scene", n, v) if parameter_of(n).many else number("scene", n, v)
        for n, v in given.items()
        if n in PARAMETERS
    }
    parts: dict[str, dict[str, typing.Any]] = {place: {} for place in _PLACES}
    for name, value in numbers.items():
        *_, part, field = place_of(name)
        parts[part][field] = value
    breakdown = given.get("breakdown", "vhb")
    if isinstance(breakdown, str) and breakdown != "vhb":
        raise ValueError(f"`breakdown` in [scene] must be 'vhb' or a field, but is {shown(breakdown)}.")
    field = () if breakdown == "vhb" else (number("scene", "breakdown", breakdown),)
    constants = {} if constants is None else constants
    refuse("units", constants, [n for n, row in PARAMETERS.items() if row.path[0] == "units"])
    units = units_of(constants, parts["membrane"].get("prestretch", 1.0)) if constants else None
    law = (ConstantBreakdown if field else VHBBreakdown)(*field, **parts["breakdown"])
    membrane = Membrane(_film(given, parts["material"]), breakdown=law, **parts["membrane"])
    loading = parts["loading"]
    if ("pressure" in loading) == ("volume" in loading):
        raise ValueError("`pressure` or `chamber_volume` must be given, one of the two, but both or neither are.")
    if "pressure" in loading and len(loading) > 1:
        raise ValueError("`pressure` must be given without the parameters of a chamber, but some are given.")
    window = Window(*(_pair(name, given.get(name)) for name in ("stretch_window", "load_window")))
    if units is not None and "volume" in loading:
        loading = {"atmospheric_pressure": ATMOSPHERE} | loading
    made = (
        ConstantPressure(loading["pressure"]) if "pressure" in loading else Chamber(**typing.cast(typing.Any, loading))
    )
    return Scene(membrane, made, window) if units is None else Scene.from_si(membrane, made, units, window=window)


def described_scene(described: dict[str, typing.Any]) -> Scene:
    """The scene that `describe` describes, also one whose voltage or volume is held, under charge control, or with units.

    Raises ValueError for a material or breakdown law of the user's own, which has no description.

    >>> from dielectric_jax.model import describe
    >>> scene = Scene(Membrane(), ChargeControl(ConstantPressure(1.82)), units=Units())
    >>> describe(described_scene(describe(scene))) == describe(scene)
    True
    """
    own = dict(described)
    charge = own.pop("control", None) == "charge"
    held = {name: own.pop(name) for name in ("voltage", "volume") if name in own}
    constants = {n: own.pop(n) for n in Units.__dataclass_fields__ if n in own}
    scene = scene_of(own | ({"pressure": 1.0} if held else {}))
    loading = scene.loading
    for name, value in held.items():
        loading = (ConstantVoltage if name == "voltage" else PrescribedVolume)(number("scene", name, value))
    loading = ChargeControl(loading) if charge else loading
    if not constants:
        return dataclasses.replace(scene, loading=loading)
    units, membrane = Units(**constants), scene.membrane
    membrane = dataclasses.replace(membrane, breakdown=law_in(membrane.breakdown, units))
    return Scene(membrane, loading, scene.window, units)


def other_filling_left_out(given: dict[str, typing.Any], varied: typing.Iterable[str]) -> dict[str, typing.Any]:
    """The parameters of a scene without its filling, where the other way to give a filling varies.

    >>> other_filling_left_out({"chamber_volume": 1600.0, "initial_volume": 2.42}, ["initial_pressure"])
    {'chamber_volume': 1600.0}
    """
    varied = set(varied)
    fillings = {"initial_volume", "initial_pressure"}
    left_out = fillings - varied if fillings & varied else set()
    return {name: value for name, value in given.items() if name not in left_out}


def units_of(constants: dict[str, typing.Any], prestretch: float) -> Units:
    """The units of a table [units] for a film of this prestretch."""
    numbers = {n: number("units", n, v) for n, v in constants.items()}
    if "opening_radius" not in numbers:
        return Units(**numbers)
    if "radius" in numbers:
        raise ValueError("`radius` or `opening_radius` must be given in [units], but both are.")
    return Units.for_opening(numbers.pop("opening_radius"), prestretch, **numbers)


def check_sizes(given: dict[str, typing.Any], constants: dict[str, typing.Any]) -> None:
    """Refuses numbers of a scene, or lists of them, that are not in the unit of the document.

    With `constants` of units the document is in SI, and one number that looks dimensionless is enough; without them it is
    dimensionless, and two that look like SI are needed, judged by the membrane of the paper.
    """
    units = units_of(constants, 1.0)
    if constants:
        refuse_dimensionless(given, units)
    else:
        refuse_si(given, units, least=2)


def values(where: str, name: str, given: typing.Any) -> np.ndarray:
    """The values of a parameter: a list, or {from, to, count, spacing = "linear" or "log"}."""
    if isinstance(given, list):
        return np.array([number(where, name, v) for v in given])
    own = table(name, given)
    refuse(f"{where}.{name}", own, ("from", "to", "count", "spacing"))
    missing = [key for key in ("from", "to", "count") if key not in own]
    if missing:
        raise ValueError(f"`{missing[0]}` must be given for `{name}` in [{where}], but is not.")
    low, high = (number(where, key, own[key]) for key in ("from", "to"))
    count, spacing = own["count"], own.get("spacing", "linear")
    check_whole("count", count, 1, MOST_VALUES, where=f"{where}.{name}")
    one_of(f"{where}.{name}", "spacing", spacing, ("linear", "log"))
    if spacing == "log" and not min(low, high) > 0:
        raise ValueError(f"`from` and `to` must be positive with spacing log for `{name}` in [{where}].")
    return (np.geomspace if spacing == "log" else np.linspace)(low, high, count)
