"""Locks between processes: one at a time writes a store, or builds what is kept in the cache folder.

The system gives a lock back when its process ends, however it ends. For local file systems.
"""

import contextlib
import os
import pathlib
from collections.abc import Iterator

__all__ = ["Locked", "alone"]


class Locked(OSError):
    """Another process holds the lock."""


@contextlib.contextmanager
def alone(path, *, wait: bool = True) -> Iterator[None]:
    """Holds the lock of a file, which is made where it is not there, or of a folder that is there.

    With `wait=False` raises `Locked` at once where another process holds it.
    """
    path = pathlib.Path(path)
    try:
        import fcntl
    except ImportError:  # Windows locks bytes of files
        with _bytes_locked(path, wait):
            yield
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise Locked(f"{str(path)!r} is held by another process") from None
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def _bytes_locked(path: pathlib.Path, wait: bool) -> Iterator[None]:
    import msvcrt

    path = path.with_name(path.name + ".lock") if path.is_dir() else path
    with open(path, "ab") as file:
        mode = getattr(msvcrt, "LK_LOCK" if wait else "LK_NBLCK")
        while True:
            try:
                getattr(msvcrt, "locking")(file.fileno(), mode, 1)  # noqa: B009
                break
            except OSError:
                if not wait:
                    raise Locked(f"{str(path)!r} is held by another process") from None
        yield
