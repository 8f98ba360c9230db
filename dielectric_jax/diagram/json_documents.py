"""Diagrams from their JSON documents."""

import json
import os
import pathlib
import typing
from collections.abc import Mapping

import numpy as np

from ..model import (
    Branch,
    Chamber,
    ConstantVoltage,
    Event,
    LoadingCondition,
    Ramp,
    Scene,
    SpecialPoint,
    Units,
    Window,
    described_scene,
    mechanical,
)
from ..numerics import shown

__all__ = ["fields_from_json", "read_json"]

_NEEDED = ("scene", "units", "engine", "window", "complete", "tolerance", "branches", "special_points", "ramp")


def read_json(document: typing.Any) -> Mapping[str, typing.Any]:
    """The document of a diagram, from itself or from a file; raises ValueError with one sentence for anything else."""
    name = "it"
    if isinstance(document, (str, os.PathLike)):
        name = shown(os.fspath(document))
        try:
            document = json.loads(pathlib.Path(document).read_text(encoding="utf-8-sig"))
        except OSError as error:
            raise ValueError(
                f"`document` must be a file of JSON that can be read, but {name} is not: {error.strerror}."
            ) from None
        except (ValueError, RecursionError) as error:
            raise ValueError(f"`document` must be a file of JSON, but {name} is not: {error}.") from None
    if isinstance(document, Mapping) and "diagrams" in document:
        raise ValueError(
            '`document` must be that of one diagram, such as one of the list "diagrams", but holds the list.'
        )
    missing = [n for n in _NEEDED if not (isinstance(document, Mapping) and n in document)]
    if missing:
        raise ValueError(f'`document` must be that of a diagram, but {name} has no "{missing[0]}".')
    if document["units"] not in ("SI", "dimensionless"):
        raise ValueError(f"`document` must be in SI or dimensionless, but its units are {shown(document['units'])}.")
    return document


def _scene_of(document: Mapping[str, typing.Any], given: Scene | None) -> Scene:
    """The scene of a dimensionless document, in its window."""
    if given is not None:
        return given
    try:
        scene = described_scene(document["scene"] | ({"control": "charge"} if "control" in document else {}))
    except ValueError as error:
        raise ValueError(f"`scene` must be given with this document: {error}") from None
    window = [tuple(document["window"][name]) for name in ("apex_stretch", "load_fraction")]
    stretches, _, loads = scene.limits()
    if np.allclose([stretches, loads], window, rtol=1e-12, atol=0.0):
        return scene
    return Scene(scene.membrane, scene.loading, Window(*window), scene.units)


def _condition(scene: Scene, start: Event | None) -> LoadingCondition | None:
    """The loading's condition; that of a chamber needs the state at which it was closed."""
    if not isinstance(mechanical(scene.loading), Chamber):
        return scene.loading.condition()
    if start is None or start.state.volume == 0:  # of a flat film there is no line of the air
        return None
    return scene.loading.condition(start.state.pressure, start.state.volume)


def fields_from_json(document: Mapping[str, typing.Any], scene: Scene | None) -> dict[str, typing.Any]:
    """The fields of a `Diagram` from its document.

    Raises ValueError for a document that is not whole, and for a scene that is not that of the document.
    """
    if scene is not None and not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    try:
        return _fields(document, scene)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(
            f"`document` must be that of a diagram, but is not whole ({type(error).__name__}: {error})."
        ) from None


def _fields(document: Mapping[str, typing.Any], scene: Scene | None) -> dict[str, typing.Any]:
    if document["units"] == "SI":
        constants = {n: document["scene"][n] for n in Units.__dataclass_fields__ if n in document["scene"]}
        document = Units(**constants).reduce({n: v for n, v in document.items() if n != "unit_names"})
    scene = _scene_of(document, scene)
    branches = [Branch.from_json(b) for b in document["branches"]]
    special_points = [SpecialPoint.from_json(p) for p in document["special_points"]]
    if not branches or any(not 0 <= p.branch < len(branches) for p in special_points):
        raise ValueError("`document` must have the branches on which its special points lie, but has not.")
    events = [Event.from_json(e) for e in document["ramp"] or ()]
    ways = {direction: tuple(e for e in events if e.direction == direction) for direction in ("up", "down")}
    strain = document.get("area_strain"), document.get("area_strain_reason")
    loading = scene.loading
    voltage = float(loading.voltage) if isinstance(loading, ConstantVoltage) else None
    return {
        "kind": "voltage-volume" if voltage is None else "pressure-volume",
        "scene": scene,
        "branches": branches,
        "special_points": special_points,
        "complete": document["complete"],
        "tolerance": document["tolerance"],
        "limits": scene.limits(),
        "engine": document["engine"],
        "voltage": voltage,
        "condition": _condition(scene, ways["up"][0] if ways["up"] else None),
        "_up": None if document["ramp"] is None else Ramp(ways["up"], *strain),
        "_down": Ramp(ways["down"]) if ways["down"] else None,
    }
