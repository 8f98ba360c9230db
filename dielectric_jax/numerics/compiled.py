"""Compiled programs: the last ones used stay in memory, and their traces in the cache folder.

A program belongs to a function and to the kind and shapes of its arguments; numbers are arguments. A process that sees many
kinds of material would otherwise fill its memory: one program takes up to 30 MB and 500 memory maps.
"""

import collections
import contextlib
import ctypes
import functools
import hashlib
import importlib.metadata
import inspect
import itertools
import os
import pathlib
import threading
import typing
import zlib
from collections.abc import Callable

import jax
import jax.core
import jax.export
import numpy as np
from jax.experimental import serialize_executable

from .cache import enabled_folder, is_own, make_folder, say, setting, write_own
from .lanes import run_lanes
from .resolution import FUSION_EMITTERS, LANES, MADE_TOGETHER, MOST_LIVE, MOST_SHELVED, VECTOR_WIDTH

__all__ = ["cached_jit", "elementwise", "of_this_package", "source_digest"]

# how XLA compiles for the CPU; a backend or a release that does not know an option compiles without them
_OPTIONS: typing.Any = {"xla_cpu_prefer_vector_width": VECTOR_WIDTH}
_PACKAGE = __name__.split(".")[0]
_PATIENCE = 2.0  # seconds


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
    for path in sorted(pathlib.Path(__file__).parent.parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _versions() -> bytes:
    """What a traced program depends on besides its arguments: the package's source, and what it is traced with."""
    digest = hashlib.sha256(jax.default_backend().encode())
    digest.update(source_digest().encode())
    for name in ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax"):
        digest.update(f"{name} {importlib.metadata.version(name)}".encode())
    return digest.digest()


_read_from_cache: list[str] = []  # whether JAX's own cache has given this process a program


def _listen(event: str, **_) -> None:
    if event == "/jax/compilation_cache/cache_hits" and not _read_from_cache:
        _read_from_cache.append(event)


jax.monitoring.register_event_listener(_listen)


class _Live:
    """A program that is being made, or is there."""

    def __init__(self):
        self.lock = threading.Lock()
        self.program: Callable | None = None
        self.size = 0


class Programs:
    """The programs used last, within a total size; others are packed if that is possible, or made anew when asked for."""

    def __init__(self, most_live: float = MOST_LIVE, most_shelved: float = MOST_SHELVED):
        self.most_live, self.most_shelved = most_live, most_shelved
        self._live: collections.OrderedDict = collections.OrderedDict()
        self._shelf: collections.OrderedDict = collections.OrderedDict()
        self._lock = threading.Lock()
        self._made = itertools.count(1)

    def of(self, key, make: Callable) -> Callable:
        """The program of a key, which `make()` compiles where it is neither alive nor packed."""
        with self._lock:
            live = self._live.get(key)
            if live is None:
                live = self._live[key] = _Live()
            else:
                self._live.move_to_end(key)
        program = live.program
        if program is None:
            with live.lock:
                program = live.program
                if program is None:
                    program = live.program = self._unpacked(key) or make()
                    self._admit(live, _size(program))
        return program

    def count(self) -> int:
        """How many programs are alive."""
        return len(self._live)

    def _admit(self, live: _Live, size: int) -> None:
        """Counts a new program, and takes out those used longest ago."""
        with self._lock:
            live.size = size
            total = sum(other.size for other in self._live.values())
            old = []
            for key, other in self._live.items():
                if total <= self.most_live:
                    break
                if other is not live and other.size:
                    old.append(key)
                    total -= other.size
            out = [(key, self._live.pop(key).program) for key in old]
        for key, program in out:
            self._pack(key, program)
        del out
        if next(self._made) % MADE_TOGETHER == 0:
            _forget_traces()
        _return_memory()

    def _pack(self, key, program) -> None:
        # what JAX's own cache holds is read from there, and what came from there cannot be packed: its code is missing
        if key in self._shelf or setting("jax_compilation_cache_dir") or _read_from_cache:
            return
        with contextlib.suppress(Exception):  # some backends cannot
            content, *trees = serialize_executable.serialize(program)
            with self._lock:
                self._shelf[key] = zlib.compress(content, 1), *trees
                while sum(len(packed[0]) for packed in self._shelf.values()) > self.most_shelved:
                    self._shelf.popitem(last=False)

    def _unpacked(self, key) -> Callable | None:
        packed = self._shelf.get(key)
        if packed is None:
            return None
        content, *trees = packed
        return serialize_executable.deserialize_and_load(zlib.decompress(content), *trees)


def _size(program) -> int:
    """The size of a program in XLA's own format, in bytes."""
    modules = program.runtime_executable().hlo_modules()
    return sum(len(module.as_serialized_hlo_module_proto()) for module in modules)


def _forget_traces() -> None:
    """Empties JAX's caches of traces and lowered programs, which hold up to 2048 each, 1 to 2 MB a program.

    They refer weakly to the functions and equations that they know, but to results that often hold the same equations, so that those of
    programs long gone are never freed. Programs that users have compiled stay; only tracing a function anew takes its time again.
    """
    with contextlib.suppress(ImportError, AttributeError):  # `jax.clear_caches` would also clear the programs of users
        from jax._src import util

        util.clear_all_caches()


def _return_memory() -> None:
    """Gives back to the system what the compiler has freed: 0.3 GB after a large program, which glibc would keep."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


_PROGRAMS = Programs()


def cached_jit(function: Callable, *, fusion_emitters: bool = FUSION_EMITTERS) -> Callable:
    """`jax.jit(function)`, of whose programs the last ones used are kept in memory, and traces in the cache folder.

    The folder holds, while the cache is enabled, traces for arguments `of_this_package`. Inside a transformation it is
    `jax.jit`. The result of `function` is made of tuples, lists and arrays. `fusion_emitters` is an option of XLA for the
    CPU: longer to compile, and faster for a long chain of elementwise operations.
    """
    plain = jax.jit(function)  # inside other programs no options are allowed

    @functools.wraps(function)
    def call(*args):
        leaves, tree = jax.tree.flatten(args)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return plain(*args)
        folder = enabled_folder()
        arrays = [leaf if hasattr(leaf, "dtype") else np.asarray(leaf) for leaf in leaves]
        shapes = tuple((leaf.shape, leaf.dtype) for leaf in arrays)
        key = function, folder, setting("jax_default_device"), tree, shapes

        def make():
            with _announced():
                return compiled()

        def compiled():
            own = folder / "programs" if folder is not None and of_this_package(args) else None
            lowered = _lowered(function, tree, shapes, own)
            return _compiled(lowered, _OPTIONS | {"xla_cpu_use_fusion_emitters": fusion_emitters})

        return _PROGRAMS.of(key, make)(*arrays)

    return call


@contextlib.contextmanager
def _announced():
    """Says once in a process that it compiles, where that takes longer than people wait without a word."""
    timer = threading.Timer(_PATIENCE, _say_compiling)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@functools.cache
def _say_compiling() -> None:
    where = "" if enabled_folder() is None else "; later processes read the programs from the cache"
    say(f"compiling … (the first results take up to a minute{where})")


def elementwise(function: Callable, *, lanes: int = LANES) -> Callable:
    """`function(module, *values)` of numbers and arrays of any shapes, elementwise, by one compiled program of so many lanes.

    Results are arrays of NumPy, of the common shape of the values, and further axes of the function before it. Inside a
    transformation it is `jax.jit(function)`.
    """
    plain, program = jax.jit(function), cached_jit(function)
    names = list(inspect.signature(function).parameters)

    @functools.wraps(function)
    def call(*args, **named):
        args = (*args, *(named[name] for name in names[len(args) :] if name in named))
        if len(args) != len(names) or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(args)):
            return plain(*args)
        module, *values = args
        given = np.broadcast_arrays(*(np.asarray(v, float) for v in values))
        shape, flat = given[0].shape, [v.ravel() for v in given]
        found = run_lanes(lambda part: program(module, *part), flat, sizes=lanes, parallel=False)
        return jax.tree.map(lambda v: v.reshape((*v.shape[:-1], *shape)), found)

    return call


def identity(function: Callable) -> str | None:
    """What a function is in any process: its module and name, and what it closes over; None where that has no name.

    Two functions made by one factory share their name, so their traces must not share a file.
    """
    parts = [f"{function.__module__}.{function.__qualname__}"]
    if function.__defaults__ or function.__kwdefaults__:
        parts.append(repr((function.__defaults__, function.__kwdefaults__)))
    for cell in function.__closure__ or ():
        value = cell.cell_contents
        own = identity(value) if inspect.isfunction(value) else repr(value) if _has_name(value) else None
        if own is None:
            return None
        parts.append(own)
    return f"({' '.join(parts)})"


def _has_name(value) -> bool:
    """Whether `repr` says all of a value: text, numbers, and tuples of them."""
    if isinstance(value, tuple):
        return all(map(_has_name, value))
    return value is None or isinstance(value, (str, bool, int, float))


def _compiled(lowered: jax.stages.Lowered, options: dict):
    """The compiled program, without the options where they are not known here."""
    try:
        return lowered.compile(compiler_options=options)
    except jax.errors.JaxRuntimeError as error:
        if "compile option" not in str(error):
            raise
        return lowered.compile()


def _lowered(function: Callable, tree, shapes, folder: pathlib.Path | None) -> jax.stages.Lowered:
    """A function of the leaves of its arguments, ready to compile; its trace is read from the folder, or written there."""

    def of_leaves(*leaves):
        return function(*jax.tree.unflatten(tree, leaves))

    arguments = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
    name = identity(function)
    exported = None
    if folder is not None and name is not None:
        path = folder / f"{function.__name__.strip('_')}-{_digest(name, tree, shapes)}"
        exported = _kept(path, of_leaves, arguments)
    run = of_leaves if exported is None else exported.call

    def named(*leaves):
        return run(*leaves)

    named.__name__ = function.__name__
    return jax.jit(named).lower(*arguments)


def _digest(name: str, tree, shapes) -> str:
    return hashlib.sha256(_versions() + repr((name, str(tree), shapes)).encode()).hexdigest()[:32]


def _kept(path: pathlib.Path, of_leaves: Callable, arguments: list):
    """The exported program, read or traced and written; None where it cannot be."""
    folder = path.parent
    own = is_own(folder)  # what others may have written is neither run nor joined
    with contextlib.suppress(OSError, ValueError):
        content = path.read_bytes() if own and is_own(path) else b""
        digest, content = content[:32], content[32:]
        if hashlib.sha256(content).digest() == digest:
            return jax.export.deserialize(bytearray(content))
    try:
        exported = jax.export.export(jax.jit(of_leaves))(*arguments)
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
    return exported
