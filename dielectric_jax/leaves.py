"""Scenes told by the numbers in the leaves of their pytrees: how a transformed function hands many of them to the host."""

import dataclasses
import typing
from collections.abc import Sequence

import jax
import numpy as np

from .results import Code
from .scene import Scene
from .surface import Surface

__all__ = ["Scenes"]


@dataclasses.dataclass(frozen=True)
class Scenes(Sequence):
    """Scenes of one kind as rows of the numbers in their leaves (scenes, leaves); built one by one when asked for."""

    tree: typing.Any
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, which) -> typing.Any:
        if isinstance(which, (int, np.integer)):
            return jax.tree.unflatten(self.tree, [np.float64(v) for v in self.rows[which]])
        return Scenes(self.tree, self.rows[which])

    def columns(self) -> Scene:
        """One scene whose leaves are columns."""
        return jax.tree.unflatten(self.tree, list(self.rows.T))

    def admissible(self, surface: Surface | None) -> np.ndarray:
        """For each the code of what is wrong with its numbers, which were unknown when it was written down."""
        code = np.full(len(self), int(Code.ok))
        if surface is not None:
            own = np.array([np.asarray(v).item() for v in jax.tree.leaves(surface.membrane)])
            same = jax.tree.structure(surface.membrane) == jax.tree.structure(self[0].membrane)
            code[~(same & (self.rows[:, : len(own)] == own).all(axis=1))] = int(Code.other_membrane)
        return np.where(self._valid(surface), code, int(Code.no_equilibrium))

    def _valid(self, surface: Surface | None) -> np.ndarray:
        good: typing.Any = np.isfinite(self.rows).all(axis=1)
        loading = self.columns().loading
        for name in loading.__dataclass_fields__:
            value = getattr(loading, name)
            if value is not None:
                good &= (value >= 0) if name in ("atmospheric_pressure", "voltage") else (value > 0)
        if surface is None:  # else the membrane is the surface's
            for i in np.flatnonzero(good):
                good[i] = _constructed(self[i])
        return good


def _constructed(scene: Scene) -> bool:
    """Whether the constructors take the scene's membrane."""
    try:
        for module in (scene.membrane.material, scene.membrane.breakdown, scene.membrane):
            check = getattr(module, "__check_init__", None)
            if check is not None:
                check()
    except ValueError:
        return False
    return True
