"""The stores for the blocks of a sweep: memory, or a zarr store that stays valid if its writer is killed.

A block is a chunk of every variable. Its chunks are written first, each by an atomic rename, then its checksum, then its
`block_done` flag: whatever happens, a block is either complete or not done.
"""

import contextlib
import json
import os
import pathlib
import shutil
import typing
import warnings
import zlib

import numpy as np

from ..model import parameter_of
from ..numerics import Locked, StoreError, alone, need
from .axes import Design
from .resolution import LONGEST_CHUNK
from .variables import Variable, described, described_in_si

__all__ = ["Memory", "ZarrStore", "compare", "held", "make_store", "open_group"]

_FORMAT = "dielectric_jax sweep 2"


def checksum(arrays: dict[str, np.ndarray]) -> int:
    """A number by which damaged arrays of a block are detected."""
    value = 0
    for name in sorted(arrays):
        value = zlib.crc32(np.ascontiguousarray(arrays[name]).data.cast("B"), zlib.crc32(name.encode(), value))
    return value


def coordinates_of(design: Design) -> dict[str, tuple[str, np.ndarray, dict]]:
    """The coordinates of a design: dimension, values and attributes; a dimension without a parameter is numbered."""
    found: dict = {}
    for axis in design.axes:
        for name, values in axis.columns.items():
            attributes = described(parameter_of(name).words, parameter_of(name).unit)
            if design.scene.units is not None:
                attributes = described_in_si(attributes)
            found[name] = axis.dimension, values, attributes
        if axis.dimension not in axis.columns:
            found[axis.dimension] = (
                axis.dimension,
                np.arange(axis.size),
                {"long_name": f"number along {axis.dimension}"},
            )
    return found


class Memory:
    """Stores the blocks of a sweep in arrays."""

    def __init__(self, design: Design, chunk: tuple[int, ...], variables: list[Variable]):
        self.chunk, self.parts = chunk, design.blocks(chunk)
        self.done = np.zeros(len(self.parts), bool)
        self._variables = variables
        self._arrays = {
            v.name: np.full((*design.shape, *v.dims.values()), v.fill, v.dtype) for v in variables
        }  # fmt: skip
        self._design = design

    def known(self, number: int) -> np.ndarray:
        """Which scenes of a block are known before it is computed: none."""
        return np.zeros([s.stop - s.start for s in self.parts[number]], bool).ravel()

    def with_known(self, number: int, answer: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The variables of a whole block: those that were computed."""
        return answer

    def write(self, number: int, answer: dict[str, np.ndarray]) -> None:
        """Stores the variables of a block."""
        for name, array in self._arrays.items():
            target = array[self.parts[number]]
            target[...] = answer[name].reshape(target.shape)
        self.done[number] = True

    def dataset(self, attributes: dict):
        """All blocks as an `xarray.Dataset`."""
        xarray = need("xarray")
        dims = self._design.dimensions
        data = {v.name: ((*dims, *v.dims), self._arrays[v.name], v.attributes) for v in self._variables}
        coordinates = {name: (dim, values, more) for name, (dim, values, more) in coordinates_of(self._design).items()}
        return xarray.Dataset(data, coordinates, attributes)


class ZarrStore:
    """Stores the blocks of a sweep in a zarr store; open one with `ZarrStore.create` or `ZarrStore.resume`."""

    def __init__(self, path: pathlib.Path, group, design: Design, variables: list[Variable]):
        self.path, self._group, self._design, self._variables = path, group, design, variables
        self.chunk = tuple(int(c) for c in group.attrs["block_shape"])
        self.parts = design.blocks(self.chunk)
        self.done = np.asarray(group["block_done"][:])
        self._known = np.asarray(group["scene_known"][:])
        self._opened = {v.name: group[v.name] for v in variables}

    @staticmethod
    @contextlib.contextmanager
    def create(path, design: Design, chunk: tuple[int, ...], variables: list[Variable], attributes: dict):
        """A new store, locked against other writers and created atomically."""
        zarr = need("zarr")
        path = pathlib.Path(path)
        part = path.with_name(path.name + ".part")
        part.mkdir(parents=True, exist_ok=True)
        with held(part, path):
            if path.exists():
                raise StoreError(f"{str(path)!r} is there already; resume it, or name another store.")
            make_store(zarr, part, design, chunk, variables, attributes)
            os.rename(part, path)
            yield ZarrStore(path, zarr.open_group(str(path), mode="r+", use_consolidated=False), design, variables)

    @staticmethod
    @contextlib.contextmanager
    def resume(path, design: Design, variables: list[Variable], attributes: dict, accept_versions: bool):
        """An existing store that matches the sweep, locked against other writers. Damaged blocks are marked as not done."""
        zarr = need("zarr")
        path = pathlib.Path(path)
        with held(path, path):
            group = open_group(path, mode="r+")
            compare(path, dict(group.attrs), attributes, accept_versions)
            for half in path.rglob("*.partial"):  # left by a killed writer
                half.unlink(missing_ok=True)
            store = ZarrStore(path, group, design, variables)
            history = f"{group.attrs['history']}\n{attributes['history']}"
            group.attrs.update({"history": history, "versions": attributes["versions"]})
            _consolidate(zarr, path)
            yield store

    def damaged(self) -> list[int]:
        """The blocks whose numbers, or those of the scenes that were known before, are not those that were written."""
        sums, known_sums = (np.asarray(self._group[name][:]) for name in ("block_checksum", "known_checksum"))
        found = []
        for number in range(len(self.done)):
            if not (self.done[number] or self.known(number).any()):
                continue
            try:
                whole = (
                    checksum(self._of_block(number)) == sums[number]
                    if self.done[number]
                    else self.checksum_of_known(number) == known_sums[number]
                )
            except Exception:  # the decoder may raise anything for damaged bytes
                whole = False
            if not whole:
                found.append(number)
        return found

    def _of_block(self, number: int) -> dict[str, np.ndarray]:
        return {name: np.asarray(array[self.parts[number]]) for name, array in self._opened.items()}

    def checksum_of_known(self, number: int) -> int:
        """The checksum of the scenes of a block that are known from before the axes were extended."""
        known = self._known[self.parts[number]]
        return checksum({name: values[known] for name, values in self._of_block(number).items()})

    def forget(self, numbers: list[int]) -> None:
        """Marks blocks as not done, and their scenes as not known."""
        for number in numbers:
            self._group["block_done"][number] = False
            self._group["scene_known"][self.parts[number]] = False
            self._known[self.parts[number]] = False
            self.done[number] = False

    def stored(self, name: str, part: tuple[slice, ...]) -> np.ndarray:
        """The values of a variable in a part of the grid."""
        return np.asarray(self._opened[name][part])

    def known(self, number: int) -> np.ndarray:
        """Which scenes of a block are known from before the axes were extended, in grid order."""
        return self._known[self.parts[number]].ravel()

    def with_known(self, number: int, answer: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The variables of a whole block from those of the scenes that were not known."""
        known = self.known(number)
        if not known.any():
            return answer
        whole = {}
        for v in self._variables:
            whole[v.name] = self.stored(v.name, self.parts[number]).reshape(known.size, *v.dims.values())
            if not known.all():
                whole[v.name][~known] = answer[v.name]
        return whole

    def write(self, number: int, answer: dict[str, np.ndarray]) -> None:
        """Stores the variables of a block, all or nothing."""
        part, arrays = self.parts[number], {}
        lengths = [s.stop - s.start for s in part]
        try:
            for v in self._variables:
                arrays[v.name] = np.ascontiguousarray(answer[v.name].reshape(*lengths, *v.dims.values()), v.dtype)
                self._opened[v.name][part] = arrays[v.name]
            self._group["block_checksum"][number] = checksum(arrays)
            self._group["block_done"][number] = True
        except OSError as error:
            raise StoreError(
                f"{str(self.path)!r} could not be written: {error.strerror or error}; what is finished is kept, resume continues."
            ) from error
        self.done[number] = True


@contextlib.contextmanager
def held(folder: pathlib.Path, path: pathlib.Path):
    """Holds the lock of a folder of the store at `path`; raises StoreError where another process holds it."""
    try:
        with alone(folder, wait=False):
            yield
    except Locked:
        raise StoreError(f"{str(path)!r} is being written by another process.") from None


def make_store(zarr, path: pathlib.Path, design: Design, chunk, variables: list[Variable], attributes: dict) -> None:
    """Writes the metadata of every variable, and the coordinates, into a folder that is emptied first."""
    for old in path.iterdir():
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    group = zarr.create_group(str(path), attributes={"format": _FORMAT, "block_shape": list(chunk), **attributes})
    blocks = len(design.blocks(chunk))
    names = []
    for name, (dim, values, more) in coordinates_of(design).items():
        size = min(len(values), LONGEST_CHUNK)
        options = {"dimension_names": (dim,), "attributes": more}
        group.create_array(name, shape=values.shape, chunks=(size,), dtype=values.dtype, **options)[:] = values
        names += [name] if name != dim else []
    if names:
        group.attrs["coordinates"] = " ".join(names)
    for v in variables:
        attributes = {
            k: value.tolist() if isinstance(value, np.ndarray) else value for k, value in v.attributes.items()
        }
        group.create_array(
            v.name,
            shape=(*design.shape, *v.dims.values()),
            chunks=(*chunk, *v.dims.values()),
            dtype=v.dtype,
            fill_value=v.fill,
            dimension_names=(*design.dimensions, *v.dims),
            attributes=attributes,
        )
    for name, dtype, words in (
        ("block_done", "bool", "whether the block is written"),
        ("block_checksum", "uint32", "CRC-32 of the variables of the block"),
        ("known_checksum", "uint32", "CRC-32 of the scenes of the block that were known before the axes were extended"),
    ):
        options = {"dimension_names": ("block",), "attributes": {"long_name": words}}
        group.create_array(name, shape=(blocks,), chunks=(1,), dtype=dtype, fill_value=0, **options)
    options = {"dimension_names": design.dimensions, "attributes": {"long_name": "known before the axes were extended"}}
    group.create_array("scene_known", shape=design.shape, chunks=chunk, dtype="bool", fill_value=False, **options)
    _consolidate(zarr, path)


def _consolidate(zarr, path: pathlib.Path) -> None:
    """Consolidates all metadata, so that other programs open the store quickly."""
    with warnings.catch_warnings():
        # zarr warns that consolidated metadata is an extension of the format
        warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
        zarr.consolidate_metadata(str(path))


def open_group(path, mode: typing.Literal["r", "r+"] = "r"):
    """The zarr group of a sweep; raises ValueError with one sentence if there is none."""
    zarr = need("zarr")
    try:
        group = zarr.open_group(str(path), mode=mode, use_consolidated=False)
        kept = group.attrs.get("format")
    except Exception:
        raise ValueError(f"`path` must hold the store of a sweep, but {str(path)!r} does not.") from None
    if kept != _FORMAT:
        raise ValueError(
            f"`path` must hold the store of a sweep of the format {_FORMAT!r}, but {str(path)!r} has {kept!r}."
        )
    return group


def compare(path: pathlib.Path, kept: dict, wanted: dict, accept_versions: bool, *, but: str = "") -> None:
    """Refuses to continue a store of another sweep, one that differs in more than `but`, or of other versions."""
    old, new = (json.loads(a["specification"]) for a in (kept, wanted))
    orders = [", ".join(what.get("axes", ())) for what in (new, old)]
    if orders[0] != orders[1] and set(new["axes"]) == set(old["axes"]):
        raise StoreError(f"{str(path)!r} has the axes {orders[1]}, but they are given in another order: {orders[0]}.")
    for key in sorted(
        new | old, key=lambda key: key == "axes"
    ):  # another value on an axis may only follow from the rest
        if key != but and old.get(key) != new.get(key):
            raise StoreError(
                f"{str(path)!r} holds another sweep: `{key}` is {new.get(key)!r} here and {old.get(key)!r} there."
            )
    old, new = (json.loads(a["versions"]) for a in (kept, wanted))
    changed = [f"{k} {old.get(k)} is now {new.get(k)}" for k in new | old if old.get(k) != new.get(k)]
    if changed and not accept_versions:
        raise StoreError(
            f"{str(path)!r} was begun with other versions ({', '.join(changed)}), which may differ in the last digits; "
            "accept the versions to continue it."
        )
