"""Programs whose trace is kept in the cache folder: a later process neither traces nor compiles them."""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import pathlib
import threading
from collections.abc import Callable

import jax
import jax.core
import jax.export
import numpy as np

from .cache import enabled_folder, is_own, make_folder, write_own

__all__ = ["kept_jit", "of_this_package", "source_digest"]

# the widest vectors that the processor has; XLA would take half of them on many
_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
_PACKAGE = __name__.split(".")[0]


def of_this_package(value) -> bool:
    """Whether `value` holds nothing but numbers, arrays, and objects of this package without functions.

    Its class and structure then tell all but the numbers; a class or function of the user's may change between processes.
    """
    if value is None or isinstance(value, (bool, int, float, str, np.ndarray, np.generic, jax.Array)):
        return True
    if isinstance(value, (tuple, list)):
        return all(map(of_this_package, value))
    own = type(value).__module__.split(".")[0] == _PACKAGE and hasattr(value, "__dict__")
    return own and all(map(of_this_package, vars(value).values()))


@functools.cache
def source_digest() -> str:
    """A digest of the package's sources."""
    digest = hashlib.sha256()
    for path in sorted(pathlib.Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _versions() -> bytes:
    """What a traced program depends on besides its arguments: the package's source, and what it is traced with."""
    digest = hashlib.sha256(jax.default_backend().encode())
    digest.update(source_digest().encode())
    for name in ("jax", "jaxlib", "equinox", "diffrax"):
        digest.update(f"{name} {importlib.metadata.version(name)}".encode())
    return digest.digest()


def kept_jit(function: Callable) -> Callable:
    """`jax.jit(function)`, whose trace is kept in the cache folder while the cache is enabled.

    Kept are traces for arguments `of_this_package`; others, and calls inside a transformation, go through `jax.jit`. The
    result of `function` is made of tuples, lists and arrays.
    """
    plain = jax.jit(function)  # inside other programs no options are allowed
    direct = jax.jit(function, compiler_options=_OPTIONS)
    programs: dict = {}
    lock = threading.Lock()

    @functools.wraps(function)
    def call(*args):
        folder = enabled_folder()
        leaves, tree = jax.tree.flatten(args)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return plain(*args)
        if folder is None:
            return direct(*args)
        arrays = [leaf if hasattr(leaf, "dtype") else np.asarray(leaf) for leaf in leaves]
        key = tree, tuple((leaf.shape, leaf.dtype) for leaf in arrays)
        with lock:
            entry = programs.setdefault(key, {"lock": threading.Lock()})
        with entry["lock"]:
            if "program" not in entry:
                entry["program"] = _kept(plain, folder / "programs", key) if of_this_package(args) else None
        return direct(*args) if entry["program"] is None else entry["program"](*arrays)

    return call


def _kept(plain, folder: pathlib.Path, key) -> Callable | None:
    """The program as a function of the leaves of its arguments, read or traced and written; None where it cannot be."""
    tree, shapes = key
    name = hashlib.sha256(_versions() + repr((plain.__name__, str(tree), shapes)).encode()).hexdigest()[:32]
    path = folder / f"{plain.__name__.strip('_')}-{name}"
    own = is_own(folder)  # what others may have written is neither run nor joined
    with contextlib.suppress(OSError, ValueError):
        content = path.read_bytes() if own and is_own(path) else b""
        digest, content = content[:32], content[32:]
        if hashlib.sha256(content).digest() == digest:
            return jax.jit(jax.export.deserialize(bytearray(content)).call, compiler_options=_OPTIONS)

    def of_leaves(*leaves):
        return plain(*jax.tree.unflatten(tree, leaves))

    try:
        exported = jax.export.export(jax.jit(of_leaves))(*[jax.ShapeDtypeStruct(*shape) for shape in shapes])
        content = bytes(exported.serialize())
    except (ValueError, NotImplementedError):  # a callback to the host, a result of an unknown class
        return None
    with contextlib.suppress(OSError):
        if not own:
            raise PermissionError
        make_folder(folder)
        part = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}")
        write_own(part, hashlib.sha256(content).digest() + content)
        part.replace(path)
    return jax.jit(exported.call, compiler_options=_OPTIONS)
