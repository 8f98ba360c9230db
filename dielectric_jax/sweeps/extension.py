"""Longer axes for a stored sweep: its scenes keep their numbers, and only the others are computed."""

import json
import os
import pathlib
import shutil
from collections.abc import Sequence

import numpy as np

from ..numerics import StoreError, need
from .axes import Axis, Design
from .resolution import SAME_VALUE
from .store import ZarrStore, compare, held, make_store, open_group
from .variables import Variable

__all__ = ["extend_store", "has_other_axes", "undo_half_extension"]


def _aside(path: pathlib.Path) -> pathlib.Path:
    """Where the old store stands while the new one takes its place."""
    return path.with_name(f".{path.name}.before_extension")


def _is_store(path: pathlib.Path) -> bool:
    try:
        open_group(path)
    except ValueError:
        return False
    return True


def undo_half_extension(path: pathlib.Path) -> None:
    """Puts the old store back where a killed process left none."""
    if path.name and not path.exists() and _is_store(_aside(path)):
        os.rename(_aside(path), path)


def has_other_axes(path: pathlib.Path, attributes: dict) -> bool:
    """Whether the store holds the same sweep, on the same axes in the same order, with other values."""
    old, new = (json.loads(a["specification"]) for a in (dict(open_group(path).attrs), attributes))
    differ = [key for key in new | old if old.get(key) != new.get(key)]
    names = [[(d, sorted(c)) for d, c in what["axes"].items()] for what in (old, new)]
    return differ == ["axes"] and names[0] == names[1]


def _places(path: pathlib.Path, old: Axis, new: Axis) -> np.ndarray:
    """Where the values of an axis stand on the longer one, to rounding."""
    names = list(old.columns)
    stored, given = (np.stack([axis.columns[name] for name in names], axis=1) for axis in (old, new))
    equal = {tuple(row): i for i, row in reversed(list(enumerate(given.tolist())))}
    places = np.empty(len(stored), int)
    for i, row in enumerate(stored):
        exact = equal.get(tuple(row.tolist()))
        near = np.isclose(given, row, rtol=SAME_VALUE, atol=0.0).all(axis=1) if exact is None else None
        same = [exact] if near is None else np.flatnonzero(near)
        if not len(same):
            what = ", ".join(f"`{name}` {float(value)!r}" for name, value in zip(names, row, strict=True))
            raise StoreError(
                f"{str(path)!r} holds {what}, which the axes do not; they must hold every value of a store that they extend."
            )
        places[i] = same[0]
    return places


def _copy(old: ZarrStore, part: pathlib.Path, design: Design, places: Sequence[np.ndarray], variables) -> None:
    """Copies the scenes of all whole blocks, and others that are known, into the store at `part`, and marks them as known."""
    old.forget(old.damaged())
    group = need("zarr").open_group(str(part), mode="r+", use_consolidated=False)
    for number, block in enumerate(old.parts):
        lengths = [s.stop - s.start for s in block]
        known = np.ones(lengths, bool) if old.done[number] else old.known(number).reshape(lengths)
        if not known.any():
            continue
        target = tuple(own[s] for own, s in zip(places, block, strict=True))
        for v in variables:
            more = tuple(slice(None) for _ in v.dims)
            group[v.name].oindex[(*target, *more)] = old.stored(v.name, block)
        group["scene_known"].oindex[target] = known
    new = ZarrStore(part, group, design, variables)
    sums = [new.checksum_of_known(number) if new.known(number).any() else 0 for number in range(len(new.parts))]
    group["known_checksum"][:] = np.array(sums, "uint32")


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
    the axes, for a folder that cannot be written, and as for `ZarrStore.resume`.
    """
    path = path.resolve()  # of a link, the store that it names is extended
    part, aside = path.with_name(path.name + ".part"), _aside(path)
    if aside.exists() and not _is_store(aside):
        raise StoreError(f"{str(aside)!r} must not be there, because the store stands there while it is extended.")
    try:
        part.mkdir(exist_ok=True)
        with held(path, path), held(part, path):
            _make(path, part, design, chunk, variables, attributes, accept_versions)
            shutil.rmtree(aside, ignore_errors=True)
            os.rename(path, aside)
            os.rename(part, path)
            shutil.rmtree(aside, ignore_errors=True)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(
            f"{str(path)!r} could not be extended: {error.strerror or error}; what it holds is kept."
        ) from error


def _make(path, part, design: Design, chunk, variables, attributes: dict, accept_versions: bool) -> None:
    """The extended store, at `part`."""
    group = open_group(path)
    kept = dict(group.attrs)
    compare(path, kept, attributes, accept_versions, but="axes")
    try:
        columns = [{name: np.asarray(group[name][:]) for name in axis.columns} for axis in design.axes]
        axes = tuple(Axis(axis.dimension, own) for axis, own in zip(design.axes, columns, strict=True))
    except Exception:  # the decoder may raise anything for damaged bytes
        raise StoreError(f"{str(path)!r} has a damaged coordinate, and cannot be extended.") from None
    places = [_places(path, *pair) for pair in zip(axes, design.axes, strict=True)]
    old = ZarrStore(path, open_group(path, mode="r+"), Design(design.scene, axes, design.of_engine), variables)
    attributes = attributes | {"history": f"{kept['history']}\n{attributes['history']}"}
    make_store(need("zarr"), part, design, chunk, variables, attributes)
    _copy(old, part, design, places, variables)
