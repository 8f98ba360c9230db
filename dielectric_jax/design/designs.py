"""Many designs at once: their ramps on the surfaces of their membranes, and the regime of each.

The surface gives the ramps of most designs. Designs that it cannot decide are decided by batched continuation, and those that
continuation leaves open by whole diagrams.
"""

import contextlib
import dataclasses
import functools
import itertools
import typing

import jax
import numpy as np

from ..diagram import MembraneKey, Ramps, chamber_ramps, continue_scenes, loading_arrays, pressure_ramps, regime_of
from ..model import (
    Chamber,
    Change,
    ConstantPressure,
    Membrane,
    Regime,
    Scene,
    change_of,
    field_on,
    other_loading,
)
from ..numerics import SceneError
from ..surface import ById, Surface, SurfaceFamily
from .resolution import MOST_BUILT, MOST_SECTIONS, TYPICAL_STRETCH

__all__ = [
    "Designs",
    "by_continuation",
    "by_diagrams",
    "check_loading",
    "classify_designs",
    "designs_on_surfaces",
    "surface_for",
    "surface_over",
]


class Designs(typing.NamedTuple):
    """Many designs: their scenes as one whose leaves are columns, their regimes, and the ramps of those on a surface.

    `ramps` are in the order of the designs; `membrane_number` says which membrane each has.
    """

    scenes: Scene
    regime: np.ndarray
    ramps: Ramps
    membrane_number: np.ndarray


def check_loading(scene: Scene) -> None:
    """Raises ValueError for a loading whose ramps the surface does not know."""
    if not isinstance(scene.loading, (Chamber, ConstantPressure)):
        raise other_loading(scene.loading, Chamber, ConstantPressure)


def designs_of(scene: Scene, parameters: dict) -> Scene:
    """One scene whose leaves are columns: `scene` with the named parameters at the values of arrays (n,).

    Raises ValueError for names or values that the scene does not take.
    """
    names = tuple(parameters)
    for name in names:
        scene.check_varies(name)
    values = [np.asarray(parameters[n], float) for n in names]
    ends = {f(v) for v in np.stack(values, axis=1).tolist() for f in (tuple,)} if len(values[0]) <= 4 else set()
    for own in ends or {tuple(v.min() for v in values), tuple(v.max() for v in values)}:
        scene.with_values(**dict(zip(names, own, strict=True)))
    replace = jax.vmap(lambda *own: scene.with_values(**dict(zip(names, own, strict=True))))
    stacked_scenes = replace(*values)
    return jax.tree.map(lambda v: np.broadcast_to(np.asarray(v, float), values[0].shape), stacked_scenes)


def _row(stacked_scenes, which):
    return jax.tree.map(lambda v: v[which], stacked_scenes)


def surface_over(scene: Scene, over: dict, given: typing.Any) -> Surface | SurfaceFamily | None:
    """One surface or family for all designs over ranges of parameters, or None if one is not enough."""
    if given is not None or any(change_of(n) is Change.MATERIAL for n in over):
        return given
    if "prestretch" in over:
        low, high = over["prestretch"]
        law = scene.membrane.breakdown
        return SurfaceFamily.build(scene.membrane.material, prestretch=(low, high), breakdown=law)
    # the breakdown law determines the extent of the surface: use the strongest of the corners
    corners = [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]
    films = [scene.with_values(**corner).membrane for corner in corners]
    return _built(MembraneKey.of(max(films, key=lambda film: float(field_on(film.breakdown, TYPICAL_STRETCH)))))


def surface_for(membrane: Membrane, given: typing.Any) -> Surface:
    """The surface of a membrane, given, taken from a family, or built, with the membrane's own breakdown law."""
    if isinstance(given, SurfaceFamily):
        key = MembraneKey.of(Membrane(given.material, float(membrane.prestretch), given.breakdown))
        found = _section(ById(given), key)
    elif given is None:
        found = _built(MembraneKey.of(membrane))
    else:
        found = given
        mine, other = (jax.tree.leaves((m.material, m.prestretch)) for m in (membrane, found.membrane))
        if not (len(mine) == len(other) and all(np.array_equal(a, b) for a, b in zip(mine, other, strict=True))):
            raise ValueError(
                "`surface` must be that of the scenes' membrane, but is another's; leave it out, or give a SurfaceFamily."
            )
    if found.belongs_to(membrane):
        return found
    return _with_law(ById(found), MembraneKey.of(membrane))


@functools.lru_cache(maxsize=MOST_SECTIONS)
def _section(family: ById, key: MembraneKey) -> Surface:
    return family.value.surface(float(key.membrane.prestretch))


@functools.lru_cache(maxsize=MOST_BUILT)
def _built(key: MembraneKey) -> Surface:
    return Surface.build(key.membrane)


@functools.lru_cache(maxsize=MOST_SECTIONS)
def _with_law(surface: ById, key: MembraneKey) -> Surface:
    """The same surface with another breakdown law."""
    return dataclasses.replace(surface.value, membrane=key.membrane)


def classify_designs(
    scene: Scene, parameters: dict, *, surface: Surface | SurfaceFamily | None = None, whole: bool = True
) -> Designs:
    """The regimes of many designs: `scene` with the named parameters at the values of arrays of one shape (n,).

    With `whole=False`, designs that the surface cannot decide stay `not_decided`. A `surface` of the membrane (or a family,
    if the prestretch varies) is built if none is given. Raises ValueError for parameters that the scene does not have.

    >>> from dielectric_jax import Membrane, Regime
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> found = classify_designs(scene, {"chamber_volume": [460.0, 475.0, 500.0, 800.0, 1600.0]})
    >>> [Regime(int(r)).name for r in found.regime]
    ['breaks_in_snap', 'returns', 'no_snap', 'returns', 'stays']
    """
    parameters = {name: scene.numbers_of(name, values) for name, values in parameters.items()}
    scene.check_in_si(parameters)
    found = designs_on_surfaces(scene, parameters, surface=surface)
    if whole:
        by_continuation(found)
        by_diagrams(found)
    return found


def designs_on_surfaces(scene: Scene, parameters: dict, *, surface: Surface | SurfaceFamily | None) -> Designs:
    """Designs, decided as far as the surfaces of their membranes can."""
    check_loading(scene)
    stacked_scenes = designs_of(scene, parameters)
    count = len(stacked_scenes.membrane.prestretch)
    keys: dict = {}
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(stacked_scenes.membrane)]
    for i in range(count):
        keys.setdefault(tuple(leaf[i] for leaf in leaves), []).append(i)
    parts, order, numbers = [], [], np.zeros(count, int)
    for number, own in enumerate(keys.values()):
        own = np.array(own)
        numbers[own] = number
        membrane = jax.tree.map(lambda v, i=own[0]: np.float64(v[i]), stacked_scenes.membrane)
        surface_of = surface_for(membrane, surface)
        given = loading_arrays(_row(stacked_scenes.loading, own), surface_of)
        parts.append(pressure_ramps(surface_of, **given) if "pressure" in given else chamber_ramps(surface_of, **given))
        order.append(own)
    back = np.argsort(np.concatenate(order))
    ramps: Ramps = jax.tree.map(lambda *v: np.concatenate(v)[back], *parts)
    return Designs(stacked_scenes, ramps.regime.astype(int), ramps, numbers)


def _left(found: Designs) -> np.ndarray:
    return np.flatnonzero(found.regime == Regime.not_decided)


def by_continuation(found: Designs) -> None:
    """Determines in place the regimes of designs that no surface decides, by batched continuation."""
    left = _left(found)
    if len(left):
        batch = continue_scenes([jax.tree.map(lambda v, i=i: np.float64(v[i]), found.scenes) for i in left])
        found.regime[left] = batch.ramps.regime


def by_diagrams(found: Designs) -> None:
    """Determines in place the regimes that continuation leaves open, by whole diagrams one after the other."""
    for i in _left(found):
        with contextlib.suppress(SceneError):
            found.regime[i] = int(regime_of(jax.tree.map(lambda v, i=i: np.float64(v[i]), found.scenes)))
