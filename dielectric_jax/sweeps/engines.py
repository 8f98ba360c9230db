"""Engines of sweeps besides the surface and continuation: what a sweep asks of them."""

import typing

import numpy as np

from ..model import Scene
from ..numerics import shown
from .variables import Variable, variables_of

__all__ = ["Engine", "check_engine", "job_variables", "parameters_of"]


@typing.runtime_checkable
class Engine(typing.Protocol):
    """Computes the scenes of a sweep in a way of its own, such as `dj.rates.InTime`.

    `parameters` are names of axes that are no parameters of a scene. Two of the variables are `outcome`, with the numbers of
    `Answer` for scenes without an answer, and `regime`. An engine must pickle where workers are processes.
    """

    parameters: tuple[str, ...]
    block: int  # scenes in a block

    def check_axes(self, scene: Scene, columns: dict[str, np.ndarray]) -> None:
        """Raises ValueError, with one sentence, for a scene, or for axes or their values, that it cannot sweep."""
        ...

    def variables(self) -> list[tuple]:
        """The variables of the dataset, each as (name, further dimensions, dtype, fill value, attributes)."""
        ...

    def answers(self, scenes: list[Scene], columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The variables of scenes; `columns` are the values of its own `parameters` that vary."""
        ...

    def document(self) -> dict[str, typing.Any]:
        """Its settings as they stand in the attributes of the dataset."""
        ...


def check_engine(engine: typing.Any, **options: typing.Any) -> None:
    """Raises ValueError for what is no engine, or for options given that an engine of one's own does not take."""
    if isinstance(engine, str) and engine not in ("surface", "continuation"):
        raise ValueError(f"`engine` must be 'surface' or 'continuation', but is {engine!r}.")
    if options.get("modes") is not None and isinstance(engine, str) and engine == "surface":
        raise ValueError("`engine` must be 'continuation' with `modes`, which no surface knows, but is 'surface'.")
    if isinstance(engine, str):
        return
    if isinstance(engine, type) or not isinstance(engine, Engine):
        raise ValueError(f"`engine` must be 'surface', 'continuation' or an engine, but is {shown(engine)}.")
    for name, given in options.items():
        if given is not None and given is not False:
            raise ValueError(f"`{name}` must be left out with the engine {type(engine).__name__}.")


def parameters_of(engine: str | Engine) -> tuple[str, ...] | None:
    """The names of axes that only the engine knows; None of the surface and continuation, which know a membrane at rest alone."""
    return None if isinstance(engine, str) else tuple(engine.parameters)


def job_variables(engine: str | Engine, curves: bool, modes: bool) -> list[Variable]:
    """The variables of a sweep with an engine."""
    return variables_of(curves, modes) if isinstance(engine, str) else [Variable(*row) for row in engine.variables()]
