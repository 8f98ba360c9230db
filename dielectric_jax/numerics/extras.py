"""Packages that are not always installed."""

import importlib
import typing

__all__ = ["need"]


def need(module: str, extra: str = "io") -> typing.Any:
    """The imported module; raises ImportError with one sentence that names the extra that provides it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise ImportError(
            f'`{package}` must be installed for this, but is not: pip install "dielectric-jax[{extra}]".'
        ) from None
