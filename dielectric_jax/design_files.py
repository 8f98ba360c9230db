"""Questions about designs written down: a file of TOML with a scene, the parameters that vary, and what is wished for."""

import tomllib
import typing

from .loading import Chamber, ConstantPressure
from .materials import ArrudaBoyce, ConstantBreakdown, Gent, NeoHookean, VHBBreakdown
from .membrane import Membrane
from .scene import PARAMETERS, Scene
from .units import Units

__all__ = ["read_design_file"]

_MATERIALS = {"gent": Gent, "neo-hookean": NeoHookean, "arruda-boyce": ArrudaBoyce}
_CONSTANTS = ("shear_modulus", "thickness", "radius", "permittivity")
_WISHES = {
    "regimes": {"points": (int, list)},
    "optimise": {
        "survival_margin": (int, float),
        "operating_margin": (int, float),
        "must_snap": (bool,),
        "way_down": (str,),
        "quantile": (int, float),
        "compare": (int,),
        "check": (bool,),
    },
}


def _table(document: dict, name: str) -> dict:
    given = document.get(name, {})
    if not isinstance(given, dict):
        raise ValueError(f"`{name}` must be a table, but is {given!r}.")
    return given


def _refuse(table: str, given: typing.Iterable[str], allowed: typing.Iterable[str]) -> None:
    for name in given:
        if name not in allowed:
            raise ValueError(f"`{name}` in [{table}] must be one of {', '.join(allowed)}, but is none of them.")


def _numbers(table: str, given: dict) -> dict[str, float]:
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"`{name}` in [{table}] must be a number, but is {value!r}.")
    return {name: float(value) for name, value in given.items()}


def _scene(given: dict, constants: dict) -> Scene:
    """The scene of parameters by their published names, with `material` and `breakdown` ("vhb" or a field)."""
    _refuse("scene", given, ("material", "breakdown", *(n for n in PARAMETERS if n not in _CONSTANTS)))
    _refuse("units", constants, _CONSTANTS)
    words = {n: given[n] for n in ("material", "breakdown") if n in given}
    numbers = _numbers("scene", {n: v for n, v in given.items() if n not in words})
    material = words.get("material", "gent")
    if material not in _MATERIALS:
        raise ValueError(f"`material` must be one of {', '.join(_MATERIALS)}, but is {material!r}.")
    units = Units(**typing.cast(typing.Any, _numbers("units", constants))) if constants else None
    law: typing.Any = words.get("breakdown", "vhb")
    if law == "vhb":
        own = {} if units is None else {n: getattr(units, n) for n in ("shear_modulus", "relative_permittivity")}
        law = VHBBreakdown(**own)
    else:
        law = ConstantBreakdown(_numbers("scene", {"breakdown": law})["breakdown"])
    loading = (
        ConstantPressure(numbers.pop("pressure"))
        if "pressure" in numbers
        else Chamber(
            volume=numbers.pop("chamber_volume", float("nan")),
            **{n: numbers.pop(n) for n in ("initial_volume", "initial_pressure") if n in numbers},
        )
    )
    scene = Scene(Membrane(_MATERIALS[material](), breakdown=law), loading, units=units)
    return scene.replace(**numbers)


def read_design_file(path: str, command: str) -> tuple[Scene, dict, dict]:
    """The scene, the ranges of [over], and the options of a file, for "regimes" or "optimise".

    Raises ValueError in one sentence for a file that cannot be read, or holds what is not known.
    """
    try:
        with open(path, "rb") as file:
            document = tomllib.load(file)
    except OSError as error:
        raise ValueError(f"`SPEC` must be a file that can be read, but {path!r} is not: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"`SPEC` must be a file of TOML, but {path!r} is not: {error}.") from None
    _refuse("", document, ("scene", "units", "over", command, *(("uncertain",) if command == "optimise" else ())))
    over = {}
    for name, limits in _table(document, "over").items():
        if not (isinstance(limits, list) and len(limits) == 2):
            raise ValueError(f"`{name}` in [over] must be a pair [low, high], but is {limits!r}.")
        over[name] = tuple(_numbers("over", {name: v})[name] for v in limits)
    options = dict(_table(document, command))
    _refuse(command, options, _WISHES[command])
    for name, value in options.items():
        if not isinstance(value, _WISHES[command][name]) or (
            isinstance(value, bool) and bool not in _WISHES[command][name]
        ):
            raise ValueError(f"`{name}` in [{command}] must be of another type, but is {value!r}.")
    if isinstance(options.get("points"), list):
        options["points"] = tuple(options["points"])
    if "uncertain" in document:
        options["uncertain"] = _numbers("uncertain", _table(document, "uncertain"))
    return _scene(_table(document, "scene"), _table(document, "units")), over, options
