"""Longer axes for a stored sweep: its scenes keep their numbers, and only the others are computed."""

import json
import os
import pathlib
import shutil
from collections.abc import Sequence

import numpy as np

from ..numerics import StoreError, need
from .axes import Axis, Design
from .store import ZarrStore, compare, held, make_store, open_group
from .variables import Variable

__all__ = ["extend_store", "has_other_axes", "undo_half_extension"]


def _aside(path: pathlib.Path) -> pathlib.Path:
    """Where the old store stands while the new one takes its place."""
    return path.with_name(path.name + ".old")


def undo_half_extension(path: pathlib.Path) -> None:
    """Puts the old store back where a killed process left none."""
    if not path.exists() and _aside(path).exists():
        os.rename(_aside(path), path)


def has_other_axes(path: pathlib.Path, attributes: dict) -> bool:
    """Whether the store holds the same sweep, on the same axes with other values."""
    old, new = (json.loads(a["specification"]) for a in (dict(open_group(path).attrs), attributes))
    differ = [key for key in new | old if old.get(key) != new.get(key)]
    return differ == ["axes"] and {d: set(c) for d, c in old["axes"].items()} == {
        d: set(c) for d, c in new["axes"].items()
    }


def _places(path: pathlib.Path, old: Axis, new: Axis) -> np.ndarray:
    """Where the values of an axis stand on the longer one."""
    names = list(old.columns)
    rows = {row: i for i, row in reversed(list(enumerate(zip(*(new.columns[n] for n in names), strict=True))))}
    wanted = list(zip(*(old.columns[n] for n in names), strict=True))
    missing = next((row for row in wanted if row not in rows), None)
    if missing is not None:
        what = ", ".join(f"`{name}` {float(value)!r}" for name, value in zip(names, missing, strict=True))
        raise StoreError(
            f"{str(path)!r} holds {what}, which the axes do not; they must hold every value of a store that they extend."
        )
    return np.array([rows[row] for row in wanted])


def _copy(old: ZarrStore, new, places: Sequence[np.ndarray], variables: list[Variable]) -> None:
    """Copies the scenes of all whole blocks into the arrays of the group `new`, and marks them as known."""
    old.forget(old.damaged())
    for number in np.flatnonzero(old.done):
        part = old.parts[number]
        target = tuple(own[s] for own, s in zip(places, part, strict=True))
        for v in variables:
            more = tuple(slice(None) for _ in v.dims)
            new[v.name].oindex[(*target, *more)] = old.stored(v.name, part)
        new["scene_known"].oindex[target] = np.ones([len(t) for t in target], bool)


def extend_store(
    path: pathlib.Path,
    design: Design,
    chunk: tuple[int, ...],
    variables: list[Variable],
    attributes: dict,
    accept_versions: bool,
) -> None:
    """Makes the store one of a design whose axes hold more values, in any order; its scenes are kept.

    The new store is complete before it takes the place of the old one. Raises StoreError if a value that is stored is not on
    the axes, and as for `ZarrStore.resume`.
    """
    zarr = need("zarr")
    part, aside = path.with_name(path.name + ".part"), _aside(path)
    part.mkdir(exist_ok=True)
    with held(path, path), held(part, path):
        group = open_group(path)
        kept = dict(group.attrs)
        compare(path, kept, attributes, accept_versions, but="axes")
        axes = tuple(
            Axis(axis.dimension, {name: np.asarray(group[name][:]) for name in axis.columns}) for axis in design.axes
        )
        places = [_places(path, *pair) for pair in zip(axes, design.axes, strict=True)]
        old = ZarrStore(path, open_group(path, mode="r+"), Design(design.scene, axes, design.of_engine), variables)
        attributes = attributes | {"history": f"{kept['history']}\n{attributes['history']}"}
        make_store(zarr, part, design, chunk, variables, attributes)
        new = zarr.open_group(str(part), mode="r+", use_consolidated=False)
        _copy(old, new, places, variables)
        shutil.rmtree(aside, ignore_errors=True)
        os.rename(path, aside)
        os.rename(part, path)
        shutil.rmtree(aside)
