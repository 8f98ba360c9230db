"""The uncertainty of a design: the scenarios in which it must work, each with its scene, factors and surface."""

import dataclasses
import itertools

import numpy as np
import scipy.stats

from ..model import Scene, place_of
from ..numerics import check_between
from ..surface import Surface, SurfaceFamily
from .designs import surface_for
from .resolution import MOST_UNCERTAIN, SAMPLES

__all__ = ["Scenario", "scenarios_of"]


@dataclasses.dataclass(frozen=True)
class Scenario:
    """One scenario: the scene with its values of the uncertain parameters, and the factors of the optimised parameters.

    The breakdown field of `scene` is the operating field, that of `real` is that of the law. `surface` is the surface or family
    of the states; `given` is the one that the caller passed.
    """

    scene: Scene
    real: Scene
    factors: np.ndarray
    surface: Surface | SurfaceFamily
    given: Surface | SurfaceFamily | None


def value_of(scene: Scene, name: str) -> float:
    """The value of a parameter of a scene; raises ValueError if it has none of that name."""
    scene.check_varies(name)
    part = scene.value_of(name)
    if part is None:
        raise ValueError(f"`{name}` must be a parameter of this scene, but it has none of that name.")
    return float(part)


def operated(scene: Scene, margin: float) -> Scene:
    """The scene whose breakdown field is the operating field, 1 − margin times that of the law."""
    if margin == 0:
        return scene
    return scene.replace(breakdown_field_scale=value_of(scene, "breakdown_field_scale") * (1 - margin))


def scenarios_of(
    scene: Scene, axes: list, uncertain: dict, quantile: float | None, surface, margin: float
) -> list[Scenario]:
    """The centre of the box first, then its corners or, with a quantile, evenly spread samples of it."""
    names = tuple(a.name for a in axes)
    for name, share in uncertain.items():
        check_between(f"uncertain[{name}]", float(share), 0.0, 0.9)
        value_of(scene, name)
    if quantile is not None:
        check_between("quantile", quantile, 0.0, 0.9)
        if not uncertain:
            raise ValueError("`uncertain` must name a parameter if `quantile` is given, but names none.")
    if len(uncertain) > MOST_UNCERTAIN:
        raise ValueError(f"`uncertain` must name at most {MOST_UNCERTAIN} parameters, but names {len(uncertain)}.")
    surfaces: dict = {}
    made = []
    for factors in _factors(uncertain, quantile):
        changes = {n: value_of(scene, n) * f for n, f in factors.items() if n not in names}
        own = scene.with_values(**changes)
        key = tuple(f for n, f in factors.items() if place_of(n)[:2] == ("membrane", "material"))
        given = surface if all(f == 1 for f in key) else None
        if "prestretch" in changes:
            key, given = (*key, changes["prestretch"]), surface if isinstance(surface, SurfaceFamily) else None
        if key not in surfaces:
            surfaces[key] = _on_surface(own, axes, factors, given)
        own_factors = np.array([factors.get(n, 1.0) for n in names])
        made.append(Scenario(operated(own, margin), own, own_factors, surfaces[key], given))
    return made


def _factors(uncertain: dict, quantile: float | None) -> list[dict]:
    """The factors of the uncertain parameters, scenario by scenario."""
    if not uncertain:
        return [{}]
    names = list(uncertain)
    shares = np.array([float(uncertain[n]) for n in names])
    if quantile is None:
        sides = np.array([(0,) * len(names), *itertools.product((-1, 1), repeat=len(names))], float)
    else:
        sides = 2 * scipy.stats.qmc.Sobol(len(names), scramble=False).random(SAMPLES) - 1
    return [dict(zip(names, 1 + side * shares, strict=True)) for side in sides]


def _on_surface(scene: Scene, axes: list, factors: dict, given) -> Surface | SurfaceFamily:
    """The surface of a scene, or the family over the prestretches if these are optimised."""
    sought = [a for a in axes if a.name == "prestretch"]
    if not sought:
        return surface_for(scene.membrane, given)
    (axis,) = sought
    spread = abs(factors.get("prestretch", 1.0) - 1.0)
    low, high = max(1.0, axis.low * (1 - spread)), axis.high * (1 + spread)
    if isinstance(given, SurfaceFamily):
        if not (given.prestretch[0] <= low and high <= given.prestretch[1]):
            raise ValueError(
                f"`surface` must be a family that covers the prestretches {low:g} to {high:g}, but covers "
                f"{given.prestretch[0]:g} to {given.prestretch[1]:g}."
            )
        return given
    if given is not None:
        raise ValueError("`surface` must be a SurfaceFamily if the prestretch is optimised, but is a Surface.")
    return SurfaceFamily.build(scene.membrane.material, prestretch=(low, high), breakdown=scene.membrane.breakdown)
