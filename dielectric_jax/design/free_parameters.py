"""The free parameters of a fit: constants by name, or the logarithms of those that must be positive."""

import abc
from collections.abc import Sequence

import numpy as np

__all__ = ["APPARATUS", "POSITIVE", "AbstractModel"]

#: constants that are not the material's: those of the units, the membrane, and the gauge
APPARATUS = ("shear_modulus", "relative_permittivity", "prestretch", "pressure_offset")
#: those of them that are positive and fitted by their logarithm
POSITIVE = ("shear_modulus", "relative_permittivity")


class AbstractModel(abc.ABC):
    """What is measured, as a function of free parameters: constants or their logarithms.

    A constant that is refused when negative is fitted by its logarithm, unless it starts at zero; `lowest` are the lower limits of
    the free parameters. `measured` is the word for what is measured, in messages.
    """

    names: tuple[str, ...]
    start: dict[str, float]
    logs: tuple[bool, ...]
    lowest: np.ndarray
    measured: str

    def __init__(self, names: Sequence[str], start: dict[str, float], measured: str):
        self.names, self.start, self.measured = tuple(names), start, measured
        self.logs = tuple(n in POSITIVE or (v > 0 and self._is_positive(n)) for n, v in start.items())
        self.lowest = np.array([self._lowest(n, log) for n, log in zip(names, self.logs, strict=True)])

    def _is_positive(self, name: str) -> bool:
        """Whether a negative value of the constant is refused."""
        return name not in APPARATUS and not self.allows({name: -max(abs(self.start[name]), 1e-3)})

    def _lowest(self, name: str, log: bool) -> float:
        """The lower limit of a free parameter."""
        if name == "prestretch":
            return 1.0
        if log or not self._is_positive(name):
            return -np.inf
        self.start[name] = 1e-2  # for a positive constant that starts at zero
        return 0.0

    def free_of(self, values: dict) -> np.ndarray:
        """The free parameters of constants by name."""
        return np.array([np.log(values[n]) if log else values[n] for n, log in zip(self.names, self.logs, strict=True)])

    def values_of(self, free) -> dict[str, float]:
        """The constants of free parameters."""
        with np.errstate(over="ignore"):
            pairs = zip(self.names, self.logs, free, strict=True)
            return {n: float(np.exp(x)) if log else float(x) for n, log, x in pairs}

    @abc.abstractmethod
    def allows(self, values: dict) -> bool:
        """Whether constants are allowed."""

    @abc.abstractmethod
    def reachable_start(self) -> dict[str, float]:
        """Starting values for which the model gives what was measured, or ValueError."""

    @abc.abstractmethod
    def scaled(self, values: dict[str, float], measured: np.ndarray) -> dict[str, float]:
        """The constants with a shear modulus matched to the measurement, which is proportional to it."""

    @abc.abstractmethod
    def refine(self, values: dict) -> bool:
        """Makes the model as fine as these constants need; true if it was coarser before."""

    @abc.abstractmethod
    def __call__(self, free) -> tuple[np.ndarray, np.ndarray]:
        """The model (n,) and its Jacobian (n, m); NaN where it has no answer."""
