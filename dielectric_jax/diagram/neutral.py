"""Neutral modes of a scene."""

from collections.abc import Iterable

from ..model import ConstantVoltage, Scene, SpecialPoint
from ..modes import checked_numbers
from .diagrams import pressure_volume, voltage_volume

__all__ = ["neutral_modes"]


def neutral_modes(scene: Scene, numbers: Iterable[int] = range(1, 25)) -> list[SpecialPoint]:
    """The points at which the lowest mode of one of the `numbers` is neutral, on all branches of a scene's diagram.

    Each is a special point of kind "mode" with its `number`, in order along each branch; `voltage_volume` with `modes` has them
    among its special points. As n grows without bound the points come to the branch's `hoop_tension_loss`.

    Args:
        scene: a scene; at `ConstantVoltage` its pressure–volume curve is looked at.
        numbers: circumferential numbers, whole, from 1. Axisymmetric modes (n = 0) are neutral at folds.

    Raises:
        ValueError: for bad input.
        SceneError: where the scene has no diagram.

    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=25000.0, initial_volume=2.42))
    >>> [(p.number, round(p.voltage, 8)) for p in neutral_modes(scene, numbers=[10])]
    [(10, 0.11644846)]
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    asked = checked_numbers(numbers, 1)
    if isinstance(scene.loading, ConstantVoltage):
        held = float(scene.loading.voltage)
        diagram = pressure_volume(scene.membrane, held, window=scene.window, modes=asked)
    else:
        diagram = voltage_volume(scene, modes=asked)
    return [p for p in diagram.special_points if p.kind == "mode"]
