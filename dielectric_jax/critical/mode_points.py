"""Where modes turn neutral: the points of a diagram's branches at which the lowest eigenvalue of a number vanishes.

Modes of number n ≥ 1 change neither the volume nor the charge to first order, so whether they lower the energy depends on the
state alone, whatever its loading. Along every branch the sign of the lowest eigenvalue is looked at at some points; where it changes
the eigenvalue is a test function, whose root the diagram locates like its other special points.
"""

import dataclasses
import warnings
from collections.abc import Iterable

import numpy as np

from ..diagram import Diagram, mesh_of, points_where, pressure_volume, voltage_volume
from ..model import ConstantVoltage, Membrane, Points, Scene, SpecialPoint, describe
from ..modes import checked_numbers, lowest_eigenvalues, unstable_numbers
from .resolution import MODE_SAMPLES

__all__ = ["neutral_modes"]


@dataclasses.dataclass(frozen=True, eq=False)
class _Eigenvalue:
    """The lowest eigenvalue of a number as a test function along a branch."""

    membrane: Membrane
    number: int

    def __call__(self, points: Points) -> np.ndarray:
        return self.at(points.u)

    def at(self, u: np.ndarray) -> np.ndarray:
        """The eigenvalue (lanes,) at points (3, lanes)."""
        return lowest_eigenvalues(self.membrane, u, self.number, 1)[:, 0]


def neutral_modes(
    scene: Scene, numbers: Iterable[int] = range(1, 25), *, diagram: Diagram | None = None
) -> list[SpecialPoint]:
    """The points at which the lowest mode of one of the `numbers` is neutral, on all branches of a scene's diagram.

    Each is a special point of kind "mode" with its `number`, in order along each branch. An eigenvalue that touches zero and
    turns back between two of some forty sampled points of a branch is not seen. As n grows without bound the points come to
    the branch's `hoop_tension_loss`.

    Args:
        scene: a scene; at `ConstantVoltage` its pressure–volume curve is looked at.
        numbers: circumferential numbers, whole, from 1. Axisymmetric modes (n = 0) are neutral at folds.
        diagram: the scene's diagram, if it is already known.

    Raises:
        ValueError: for bad input.
        SceneError: where the scene has no diagram.

    >>> from dielectric_jax import Chamber
    >>> scene = Scene(Membrane(), Chamber(volume=25000.0, initial_volume=2.42))
    >>> [(p.number, round(p.voltage, 8)) for p in neutral_modes(scene, numbers=[10])]
    [(10, 0.11644846)]
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    asked = checked_numbers(numbers, 1)
    if diagram is not None and not (diagram.engine == "continuation" and describe(diagram.scene) == describe(scene)):
        raise ValueError(
            "`diagram` must be the scene's own, by continuation, but is that of another scene or on a surface."
        )
    if diagram is None and isinstance(scene.loading, ConstantVoltage):
        diagram = pressure_volume(scene.membrane, float(scene.loading.voltage), window=scene.window)
    elif diagram is None:
        diagram = voltage_volume(scene)
    wanted = []
    for branch, mesh in enumerate(mesh_of(diagram)):
        for test, interval in _changes(scene.membrane, mesh, asked):
            wanted.append((test, branch, interval))
    found = points_where(diagram, wanted) if wanted else []
    for point, (test, branch, _) in zip(found, wanted, strict=True):
        if point is None:
            warnings.warn(
                f"A mode of number {test.number} turns neutral on branch {branch}, but was not located.", stacklevel=2
            )
    located = [
        dataclasses.replace(point, number=test.number, index=point.index)
        for point, (test, *_) in zip(found, wanted, strict=True)
        if point is not None
    ]
    return sorted(located, key=lambda p: (p.branch, p.position))


def _changes(membrane: Membrane, mesh: np.ndarray, numbers: tuple[int, ...]) -> list[tuple[_Eigenvalue, int]]:
    """Lowest eigenvalues that change their sign along exact points (3, points) of a branch, and between which neighbours."""
    chosen = np.unique(np.linspace(0, mesh.shape[1] - 1, MODE_SAMPLES).round().astype(int))
    unstable = unstable_numbers(membrane, mesh[:, chosen], numbers)
    found = []
    for k, number in enumerate(numbers):
        test = _Eigenvalue(membrane, number)
        for i in np.flatnonzero(unstable[1:, k] != unstable[:-1, k]):
            found.append((test, _between(test, mesh, int(chosen[i]), int(chosen[i + 1]))))
    return found


def _between(test: _Eigenvalue, mesh: np.ndarray, low: int, high: int) -> int:
    """The mesh point after which the test function changes its sign, between two of different sign."""
    first = test.at(mesh[:, low : low + 1])[0] < 0
    while high - low > 1:
        middle = (low + high) // 2
        if (test.at(mesh[:, middle : middle + 1])[0] < 0) == first:
            low = middle
        else:
            high = middle
    return low
