"""Modules whose `repr` shows the values of their numbers."""

import dataclasses
import typing

import equinox as eqx
import jax
import jax.core
import numpy as np

__all__ = ["Readable"]


def _text(value: typing.Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"({', '.join(map(_text, value))})"
    if isinstance(value, jax.core.Tracer) or not isinstance(value, (np.ndarray, np.generic, jax.Array)):
        return repr(value)
    return f"{float(value):.10g}" if np.ndim(value) == 0 else f"{value.dtype}{list(np.shape(value))}"


class Readable(eqx.Module):
    """An equinox module that shows its numbers; fields that are None are left out.

    >>> class Spring(Readable):
    ...     stiffness: np.ndarray
    ...     damping: float | None = None
    >>> Spring(np.asarray(2.5))
    Spring(stiffness=2.5)
    """

    def __repr__(self) -> str:
        given = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        return f"{type(self).__name__}({', '.join(f'{n}={_text(v)}' for n, v in given if v is not None)})"
