"""Scenes represented by the leaves of their pytrees, as a transformed function passes many of them to the host."""

import dataclasses
import typing
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from ..model import AbstractLoading, Scene
from ..numerics import Code
from ..surface import Surface

__all__ = ["Scenes"]


@dataclasses.dataclass(frozen=True)
class Scenes(Sequence):
    """Scenes of one kind: for every leaf of their pytree an array whose first axis runs over the scenes.

    A scene is built when it is indexed.
    """

    tree: typing.Any
    leaves: list[np.ndarray]

    @staticmethod
    def of(tree, shapes: list[tuple], leaves) -> tuple["Scenes", tuple]:
        """The scenes of leaves (…, *shape) with common leading axes, and the shape of those axes."""
        leaves = [np.asarray(leaf, float) for leaf in leaves]
        leading = np.broadcast_shapes(
            *(leaf.shape[: leaf.ndim - len(s)] for leaf, s in zip(leaves, shapes, strict=True))
        )
        flat = [np.broadcast_to(v, (*leading, *s)).reshape(-1, *s) for v, s in zip(leaves, shapes, strict=True)]
        return Scenes(tree, flat), leading

    def __len__(self) -> int:
        return len(self.leaves[0])

    def __getitem__(self, which) -> typing.Any:
        if isinstance(which, (int, np.integer)):
            return jax.tree.unflatten(self.tree, [np.asarray(leaf[which]) for leaf in self.leaves])
        return Scenes(self.tree, [leaf[which] for leaf in self.leaves])

    def stacked(self) -> Scene:
        """One scene whose leaves are columns over the scenes."""
        return jax.tree.unflatten(self.tree, self.leaves)

    def admissible(self, surface: Surface | None) -> np.ndarray:
        """For each scene the code of what is wrong with its numbers, which were traced when the scene was constructed."""
        code = np.full(len(self), int(Code.ok))
        if surface is not None:
            own, tree = jax.tree.flatten(surface.membrane)
            seen, same = jax.tree.flatten(self.stacked().membrane)
            if tree != same:
                code[:] = int(Code.other_membrane)
            else:
                for value, column in zip(own, seen, strict=True):
                    equal = (column == np.asarray(value)).reshape(len(self), -1).all(axis=1)
                    code[~equal] = int(Code.other_membrane)
        return np.where(self._valid(surface), code, int(Code.no_equilibrium))

    def _valid(self, surface: Surface | None) -> np.ndarray:
        finite = [np.isfinite(leaf).reshape(len(self), -1).all(axis=1) for leaf in self.leaves]
        good: typing.Any = np.all(finite, axis=0)
        for name, value in _numbers_of(self.stacked().loading):
            if value is not None:
                good &= (value >= 0) if name in ("atmospheric_pressure", "voltage") else (value > 0)
        if surface is None:  # otherwise the membrane is that of the surface
            for i in np.flatnonzero(good):
                good[i] = _constructed(self[i])
        return good


def _numbers_of(loading: AbstractLoading) -> Iterator[tuple[str, typing.Any]]:
    """The names and values of a loading's numbers, and those of the loading that it holds."""
    for name in loading.__dataclass_fields__:
        value = getattr(loading, name)
        if isinstance(value, AbstractLoading):
            yield from _numbers_of(value)
        else:
            yield name, value


def _constructed(scene: Scene) -> bool:
    """Whether the constructors accept the scene's membrane."""
    try:
        for module in (scene.membrane.material, scene.membrane.breakdown, scene.membrane):
            check = getattr(module, "__check_init__", None)
            if check is not None:
                check()
    except ValueError:
        return False
    return True
