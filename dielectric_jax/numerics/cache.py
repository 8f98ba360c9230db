"""The persistent compilation cache: the second process starts in seconds.

What is kept is run, or read as numbers, so it must come from this user. As OpenSSH does for keys, a folder or a file is used
only if it and every folder above it belong to this user or to root, and nobody else may write to them.
"""

import os
import pathlib
import stat
import sys
import typing
import warnings

__all__ = ["cache_folder", "enable_compilation_cache", "enabled_folder", "is_own", "make_folder", "say", "write_own"]

_UNDECIDED = pathlib.Path()
_enabled: pathlib.Path | None = _UNDECIDED
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_refused: set[str] = set()


def _stranger(status: os.stat_result) -> bool:
    """Whether a file belongs to somebody other than this user and root, who may do anything anyway."""
    return status.st_uid not in (0, os.getuid())


def _fault(place: pathlib.Path, status: os.stat_result, *, above: bool) -> str | None:
    """Why others could change what is kept, as the middle of a sentence; `above` for a folder on the way to it."""
    if _stranger(status):
        return f"{str(place)!r} belongs to another user"
    # in a sticky folder, such as /tmp, nobody renames or removes what is another's; a link has no permissions of its own
    safe = stat.S_ISLNK(status.st_mode) or (above and status.st_mode & stat.S_ISVTX)
    return None if safe or not status.st_mode & _OTHERS_WRITE else f"others may write to {str(place)!r}"


def _fault_of(path: pathlib.Path) -> str | None:
    """The first fault of a path and the folders above it, as it is written and as its links resolve."""
    for own in dict.fromkeys((path.absolute(), pathlib.Path(os.path.realpath(path)))):
        for place in (*reversed(own.parents), own):
            try:
                status = os.lstat(place)
            except FileNotFoundError:  # and nothing below it either
                break
            fault = _fault(place, status, above=place != own)
            if fault:
                return fault
    return None


def _fault_inside(folder: pathlib.Path) -> str | None:
    """The first fault of what lies in a folder that has none itself, as when others could write to it once."""
    private = not folder.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    with os.scandir(folder) as entries:
        for entry in entries:
            status = entry.stat(follow_symlinks=False)
            # JAX leaves permissions of files to the umask; nobody else enters a private folder
            fault = None if private and not _stranger(status) else _fault(pathlib.Path(entry.path), status, above=False)
            if fault:
                return fault
    return None


def _refuse(path: pathlib.Path, fault: str) -> None:
    """Says once for each path that it is not used, and why."""
    if str(path) not in _refused:
        _refused.add(str(path))
        warnings.warn(
            f"The cache {str(path)!r} must be this user's alone, but {fault}, so it is not used; remove it, or name another "
            "folder with DIELECTRIC_JAX_CACHE.",
            RuntimeWarning,
            stacklevel=3,
        )


def is_own(path: pathlib.Path) -> bool:
    """Whether only this user and root can change a file or folder of the cache, or put one there; warns once if not.

    Always True on systems without numbers of users, such as Windows, whose profile folders are the user's own.
    """
    if not hasattr(os, "getuid"):
        return True
    try:
        fault = _fault_of(path)
    except OSError as error:
        fault = f"it cannot be examined: {error.strerror}"
    if fault:
        _refuse(path, fault)
    return not fault


def make_folder(path: pathlib.Path) -> None:
    """Makes a folder of the cache, and those above it, for this user alone."""
    for place in (*reversed(path.absolute().parents), path):
        if not place.is_dir():
            place.mkdir(mode=0o700, exist_ok=True)


def write_own(path: pathlib.Path, content: bytes) -> None:
    """Writes a file that only this user may read or write, whatever the umask."""
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0), 0o600), "wb") as file:
        file.write(content)


def cache_folder(directory: str | os.PathLike | None = None) -> pathlib.Path | None:
    """The folder of this package in the user's cache folder, or `directory`; None where others could change it.

    The environment variable DIELECTRIC_JAX_CACHE names another folder, or switches the cache off with "off" (None).
    """
    path = _asked_folder(directory)
    return path if path is not None and is_own(path) else None


def _asked_folder(directory: str | os.PathLike | None) -> pathlib.Path | None:
    asked = os.environ.get("DIELECTRIC_JAX_CACHE", "")
    if asked == "off":
        return None
    if directory is not None:
        return pathlib.Path(directory)
    if asked:
        return pathlib.Path(asked)
    if sys.platform == "darwin":
        base = pathlib.Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = pathlib.Path(os.environ.get("LOCALAPPDATA", pathlib.Path.home()))
    else:
        base = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
    return base / "dielectric_jax"


def setting(name: str) -> typing.Any:
    """A setting of JAX as it is in this thread."""
    import jax

    return getattr(jax.config, name)


def enable_compilation_cache(directory: str | os.PathLike | None = None) -> pathlib.Path | None:
    """Keeps programs, traced and compiled, in `directory` (default: dielectric_jax in the user's cache folder).

    A later process reads them instead of making them. The first computation calls it; a call of your own names another folder.

    The environment variable DIELECTRIC_JAX_CACHE names another folder, or switches the cache off with "off". A folder that
    another user owns or may write to is refused with a warning, and so is one that cannot be made. Returns the folder, None
    where it is off or refused. Where JAX has a cache already, as by JAX_COMPILATION_CACHE_DIR, it keeps that one for what is
    compiled, with its settings, and the folder holds traces and surfaces.
    """
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    global _enabled
    before, asked = _enabled, cache_folder(directory)
    new = asked is not None and not asked.exists()
    path = _enabled = _usable(asked)
    if path is not None and setting("jax_compilation_cache_dir") in (None, str(before), str(path)):
        jax.config.update("jax_compilation_cache_dir", str(path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        compilation_cache.reset_cache()  # JAX looks for a folder once, with the first program of the process
    if path is not None and new:
        say(f"Compiled programs are kept in {path}; DIELECTRIC_JAX_CACHE=off switches this off.")
    return path


def _usable(path: pathlib.Path | None) -> pathlib.Path | None:
    """The folder, made where it is not there; None, with a warning, where it cannot be or holds what is another user's."""
    if path is None:
        return None
    try:
        make_folder(path)
        # JAX reads the files of this folder without looking whose they are
        fault = _fault_inside(path) if hasattr(os, "getuid") else None
    except OSError as error:
        fault = f"it cannot be made or read: {error.strerror}"
    if fault:
        _refuse(path, fault)
    return None if fault else path


def enabled_folder() -> pathlib.Path | None:
    """The folder of kept programs, None where the cache is off; the first call enables the default one."""
    return enable_compilation_cache() if _enabled is _UNDECIDED else _enabled


def say(text: str) -> None:
    """Writes a line about what is being done to standard error, where a person is likely to watch: a terminal or a notebook."""
    if sys.stderr.isatty() or _in_notebook():
        print(text, file=sys.stderr, flush=True)


def _in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")
