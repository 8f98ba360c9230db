"""Files of NumPy arrays that know what they hold: a format, a checksum, and the fingerprint of what they were built for."""

import hashlib
import io
import json
import pathlib
import typing

import numpy as np

from ..model import Membrane, energy_on, field_on
from ..numerics import cache_folder, is_own, make_folder, of_this_package

__all__ = ["cached_or_none", "cached_path", "fingerprint", "keep", "read_archive", "same_fingerprint", "write_archive"]


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in arrays.values():
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def write_archive(path, kind: str, arrays: dict[str, np.ndarray], own: np.ndarray, **more) -> None:
    """Writes arrays to a file (.npz) with its format, their checksum, a fingerprint, and `more` numbers."""
    header = {"format": kind, **more, "checksum": _checksum(arrays)}
    buffer = io.BytesIO()
    extra = {"header": np.array(json.dumps(header)), "fingerprint": own}
    np.savez(buffer, **typing.cast(typing.Any, arrays | extra))
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(buffer.getbuffer())
    partial.replace(path)


def read_archive(path, kind: str, noun: str, names: tuple[str, ...]) -> tuple[dict, dict[str, np.ndarray], np.ndarray]:
    """The header, the arrays and the fingerprint of a file.

    Raises ValueError in one sentence for a damaged file or one of another format.
    """
    try:
        with open(path, "rb") as file:
            data = dict(np.load(file, allow_pickle=False))
        header = json.loads(str(data["header"]))
        kept = header.get("format")
    except FileNotFoundError:
        raise ValueError(f"`path` must name a {noun} file, but there is no file {str(path)!r}.") from None
    except Exception:
        raise ValueError(f"`path` must hold a {noun}, but {str(path)!r} is damaged or of another kind.") from None
    if kept != kind:
        raise ValueError(f"`path` must hold a {noun} of the format {kind!r}, but {str(path)!r} has {kept!r}.")
    if not {*names, "fingerprint"} <= data.keys() or "checksum" not in header:
        raise ValueError(f"`path` must hold a {noun}, but {str(path)!r} is damaged: parts are missing.")
    arrays = {name: data[name] for name in names}
    if header["checksum"] != _checksum(arrays):
        raise ValueError(f"`path` must hold a {noun}, but {str(path)!r} is damaged: its checksum differs.")
    return header, arrays, data["fingerprint"]


def same_fingerprint(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two fingerprints are equal but for rounding."""
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-13, atol=0)


def fingerprint(membrane: Membrane) -> np.ndarray:
    """Numbers that tell membranes apart: prestretch, lock-up, energies and breakdown fields at some stretches."""
    rim, high = float(membrane.prestretch), membrane.lock_up_stretch()[0]
    l1 = 1 + (high - 1) * np.array([0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.93])
    l2 = l1[[2, 0, 1, 4, 3, 6, 5]]
    probes = [energy_on(membrane.material, l1, v) for v in (l1, l2)]
    return np.concatenate([[rim, high], *probes, field_on(membrane.breakdown, l1)])


def cached_path(folder_name: str, kind: str, membrane: Membrane, own: np.ndarray, tolerance: float):
    """Where what was built for a membrane is kept, in a folder that is there; None for a material outside this package.

    None also with the cache off, or where others could change what is kept.
    """
    folder = cache_folder()
    if folder is None or not of_this_package(membrane):
        return None
    folder = folder / folder_name
    if not is_own(folder):
        return None
    kinds = f"{kind} {type(membrane.material).__name__} {type(membrane.breakdown).__name__} {tolerance!r}"
    key = hashlib.sha256(kinds.encode() + own.tobytes()).hexdigest()[:32]
    try:
        make_folder(folder)
    except OSError:
        return None
    return folder / f"{key}.npz"


def keep(save, path) -> None:
    """`save(path)` of a file in the cache, which is this user's alone; nothing where there is no path."""
    if path is not None:
        save(path)
        path.chmod(0o600)


def cached_or_none(load, path):
    """`load(path)` of a file in the cache; None where there is none, another user's, or a damaged one, which is removed."""
    if path is None or not path.exists() or not is_own(path):
        return None
    try:
        return load(path)
    except ValueError:
        path.unlink()
        return None
