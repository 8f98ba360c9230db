"""The persistent compilation cache: the second process starts in seconds."""

import os
import pathlib
import sys

__all__ = ["cache_folder", "enable_compilation_cache", "enabled_folder"]

_enabled: pathlib.Path | None = None


def cache_folder(directory: str | os.PathLike | None = None) -> pathlib.Path | None:
    """The folder of this package in the user's cache folder, or `directory`.

    The environment variable DIELECTRIC_JAX_CACHE names another folder, or switches the cache off with "off" (None).
    """
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


def enable_compilation_cache(directory: str | os.PathLike | None = None) -> pathlib.Path | None:
    """Keeps programs, traced and compiled, in `directory` (default: dielectric_jax in the user's cache folder).

    A later process reads them instead of making them.

    The environment variable DIELECTRIC_JAX_CACHE names another folder, or switches the cache off with "off". Returns the
    folder, None where it is off.
    """
    import jax

    global _enabled
    path = _enabled = cache_folder(directory)
    if path is None:
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return path


def enabled_folder() -> pathlib.Path | None:
    """The folder `enable_compilation_cache` was called with; None before and where it is off."""
    return _enabled
