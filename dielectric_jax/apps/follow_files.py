"""Specifications of runs in time in TOML files: a scene, what is prescribed, and how."""

import typing

from ..model import Membrane, Scene, Units, check_sizes, number, one_of, read_toml, refuse, scene_of, table
from ..numerics import shown
from ..rates import AbstractProtocol, Hold, Ramp, Steps, Triangle, converted

__all__ = ["FollowFile", "read_follow_file"]

# what each protocol must have, and what it may have
_PROTOCOLS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "ramp": (("rate",), ("start", "stop")),
    "hold": (("value",), ("duration",)),
    "steps": (("steps",), ()),
    "triangle": (("start", "turn", "stop", "rate"), ()),
}
_DRIVEN = ("voltage", "volume", "pressure")
_OPTIONS = ("start", "until", "tolerance", "check")
_LOADING = ("pressure", "chamber_volume")


class FollowFile(typing.NamedTuple):
    """What a file asks for: the scene or membrane, its units, one list of protocols a quantity, options of `follow`.

    `labels` name the runs where there are several; `check` says whether their errors are estimated.
    """

    scene: Scene | Membrane
    units: Units | None
    protocols: dict[str, list[AbstractProtocol]]
    options: dict[str, typing.Any]
    labels: list[str]
    check: bool


def _made(where: str, kind: str, given: dict[str, typing.Any]) -> AbstractProtocol:
    """The protocol of a table whose names are known to be good."""
    if kind == "steps":
        steps = given["steps"]
        if not (isinstance(steps, list) and steps and all(isinstance(s, list) and len(s) == 2 for s in steps)):
            raise ValueError(f"`steps` in [{where}] must be pairs [value, duration], but is {shown(steps)}.")
        return Steps([(number(where, "value", v), number(where, "duration", d)) for v, d in steps])
    numbers = {name: number(where, name, value) for name, value in given.items()}
    if kind == "ramp":
        return Ramp(**numbers)
    return Hold(**numbers) if kind == "hold" else Triangle(**numbers)


def _protocols(where: str, given: typing.Any) -> tuple[list[AbstractProtocol], list[str]]:
    """The protocols of a table, several where its `rate` or `value` is a list, and their labels."""
    own = dict(table(where, given))
    if "protocol" not in own:
        raise ValueError(f"`protocol` must be given in [{where}], one of {', '.join(_PROTOCOLS)}, but is not.")
    kind = one_of(where, "protocol", own.pop("protocol"), _PROTOCOLS)
    needed, more = _PROTOCOLS[kind]
    refuse(where, own, (*needed, *more))
    missing = [name for name in needed if name not in own]
    if missing:
        raise ValueError(f"`{missing[0]}` must be given for the protocol {kind} in [{where}], but is not.")
    listed = next((name for name in ("rate", "value") if isinstance(own.get(name), list)), None)
    if listed is None:
        return [_made(where, kind, own)], []
    if not own[listed]:
        raise ValueError(f"`{listed}` in [{where}] must be a number or a list of numbers, but is an empty list.")
    made = [_made(where, kind, own | {listed: value}) for value in own[listed]]
    return made, [f"{listed} {value:g}" for value in own[listed]]


def _options(given: typing.Any) -> tuple[dict[str, typing.Any], bool]:
    """The options of `follow` in [follow], and whether errors are estimated."""
    own = dict(table("follow", given))
    refuse("follow", own, _OPTIONS)
    check = own.pop("check", True)
    if not isinstance(check, bool):
        raise ValueError(f"`check` in [follow] must be true or false, but is {shown(check)}.")
    options: dict[str, typing.Any] = {}
    if "start" in own:
        options["start"] = one_of("follow", "start", own["start"], ("relaxed", "fresh"))
    for name, argument in (("until", "duration"), ("tolerance", "tolerance")):
        if name in own:
            options[argument] = number("follow", name, own[name])
    if "duration" in options and not options["duration"] > 0:
        raise ValueError(f"`until` in [follow] must be positive, but is {options['duration']!r}.")
    return options, check


def read_follow_file(path: str) -> FollowFile:
    """The runs that a file asks for.

    [scene] and [units] are as in all files; [voltage], and [volume] or [pressure] in place of a loading in [scene], hold a
    `protocol` with its numbers; [follow] holds `start`, `until`, `tolerance` and `check`. Raises ValueError with one sentence for a
    file that cannot be read, or that holds unknown entries.
    """
    document = read_toml(path)
    refuse("", document, ("scene", "units", *_DRIVEN, "follow"))
    given, constants = (table(name, document.get(name, {})) for name in ("scene", "units"))
    driven = [name for name in _DRIVEN if name in document]
    if not driven:
        raise ValueError("`voltage`, `volume` or `pressure` must be given as a table with a `protocol`, but none is.")
    if {"volume", "pressure"} <= set(driven):
        raise ValueError("`volume` or `pressure` must be given as a table, at most one of the two, but both are.")
    protocols, labels = {}, []
    for name in driven:
        protocols[name], own = _protocols(name, document[name])
        if own and labels:
            raise ValueError(
                f"`{own[0].split()[0]}` must be a list in one table only, but is in [{driven[0]}] and [{name}]."
            )
        labels = labels or own
    held = next((name for name in driven if name != "voltage"), None)
    loading = next((name for name in _LOADING if name in given), None)
    if held and loading:
        raise ValueError(f"`{loading}` in [scene] must be left out where [{held}] is given, which takes its place.")
    # the membrane alone is followed where its volume or pressure is prescribed
    scene = scene_of(given | ({"pressure": 1e3} if held else {}), constants)
    check_sizes(given, constants)
    count = max(map(len, protocols.values()))
    each = {name: own * (count // len(own)) for name, own in protocols.items()}
    options, check = _options(document.get("follow", {}))
    if not held:
        return FollowFile(scene, scene.units, each, options, labels, check)
    if scene.units is not None:  # which the membrane alone does not carry
        each = {n: [_times(p, 1 / float(scene.units.scale(n))) for p in own] for n, own in each.items()}
    return FollowFile(scene.membrane, scene.units, each, options, labels, check)


def _times(protocol: AbstractProtocol, factor: float) -> AbstractProtocol:
    """The protocol in another unit."""
    document = converted(protocol.to_json(), lambda value: value * factor)
    kinds = {"ramp": Ramp, "hold": Hold, "steps": Steps, "triangle": Triangle}
    return kinds[document.pop("protocol")](**document)
