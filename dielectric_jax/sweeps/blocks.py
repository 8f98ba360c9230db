"""The work of one worker of a sweep: a block of scenes, from its parameters to its variables.

A block is computed by itself, in calls of fixed shapes, so that its numbers do not depend on which worker computes it, or when.
"""

import collections
import dataclasses
import math
import threading
import typing

import jax
import numpy as np

from ..diagram import (
    chamber_curves,
    chamber_ramps,
    continue_scenes,
    filling_volumes,
    pressure_curves,
    pressure_ramps,
    voltage_volume,
)
from ..model import PARAMETERS, Chamber, ConstantPressure, Membrane, Regime, Scene, Units, place_of
from ..numerics import SceneError, alone, enable_compilation_cache, enabled_folder
from ..surface import Surface, SurfaceFamily
from .engines import Engine, job_variables, parameters_of
from .resolution import BLOCK_OF_CONTINUATION, BLOCK_OF_SURFACE, BLOCK_WITH_MORE, BLOCKS, MOST_SURFACES
from .variables import Answer, Source, answer_of_diagram, answers_of, empty_answer, kinds_in_si, unanswered

__all__ = ["Job", "compute_block", "surface_of"]


@dataclasses.dataclass(frozen=True)
class Job:
    """The settings that all blocks of a sweep have in common.

    `family` is the range of prestretches of the family from which the surfaces are taken; None if each is built separately.
    """

    scene: Scene
    engine: str | Engine = "surface"
    resolve: bool = False
    curves: bool = False
    tolerance: float = 1e-9
    family: tuple[float, float] | None = None
    cache: str | None = None
    modes: tuple[int, ...] = ()


def make_ready(job: Job) -> None:
    """Configures a worker process like the process that started the sweep: float64, and the cache folder of programs."""
    if not jax.config.read("jax_enable_x64"):
        jax.config.update("jax_enable_x64", True)
    if job.cache is not None and str(enabled_folder()) != job.cache:
        enable_compilation_cache(job.cache)


_surfaces: collections.OrderedDict = collections.OrderedDict()
_lock = threading.RLock()


def _remembered(key, make):
    """`make()`, or a recent result of it for the same key."""
    with _lock:
        if key not in _surfaces:
            _surfaces[key] = make()
            while len(_surfaces) > MOST_SURFACES:
                _surfaces.popitem(last=False)
        _surfaces.move_to_end(key)
        return _surfaces[key]


def _once(path, build):
    """`build()`, which saves its result in a file: of several processes one builds, the others read."""
    if path is None or path.exists():
        return build()
    with alone(path.with_suffix(".lock")):
        return build()


def _numbers(what) -> tuple:
    """The numbers that distinguish two membranes or materials."""
    leaves, tree = jax.tree.flatten(what)
    return tree, tuple(np.asarray(v, float).tobytes() for v in leaves)


def surface_of(membrane: Membrane, tolerance: float, family: tuple[float, float] | None = None) -> Surface:
    """The surface of a membrane, cached in the process and, if the cache is enabled, in the cache folder.

    With `family` it is taken from the family of that range of prestretches.
    """
    key = (*_numbers(membrane), tolerance, family)

    def alone_built():
        path = Surface.path_of(membrane, tolerance)
        return _once(path, lambda: Surface.build(membrane, tolerance=tolerance))

    def from_family():
        material, law, own = membrane.material, membrane.breakdown, typing.cast(tuple, family)
        whole_key = (*_numbers((material, law)), tolerance, own, "family")

        def build():
            path = SurfaceFamily.path_of(material, own, law, tolerance)
            options = {"prestretch": own, "breakdown": law, "tolerance": tolerance}
            return _once(path, lambda: SurfaceFamily.build(material, **options))

        return _remembered(whole_key, build).surface(float(membrane.prestretch))

    return _remembered(key, alone_built if family is None else from_family)


def _groups(names: list[str], columns: dict[str, np.ndarray], count: int):
    """The scenes of each membrane: their positions, and the parameter values of the membrane."""
    own = [name for name in names if place_of(name)[0] != "loading"]
    if not own:
        yield np.arange(count), {}
        return
    table = np.stack([columns[name] for name in own], axis=1)
    values, which = np.unique(table, axis=0, return_inverse=True)
    for i, row in enumerate(values):
        yield np.flatnonzero(which.ravel() == i), dict(zip(own, row.tolist(), strict=True))


class _Block:
    """The scenes of a block, and their results as they are computed."""

    def __init__(self, job: Job, columns: dict[str, np.ndarray]):
        self.job, self.columns = job, columns
        self.count = len(next(iter(columns.values())))
        self.answer = unanswered(self.count, job_variables(job.engine, job.curves, bool(job.modes)))
        self.groups: list[tuple[np.ndarray, Scene]] = []
        self.of_engine = {name: columns[name] for name in parameters_of(job.engine) or () if name in columns}
        for which, values in _groups([n for n in columns if n not in self.of_engine], columns, self.count):
            try:
                self.groups.append((which, job.scene.with_values(**values)))
            except ValueError:
                self.answer["outcome"][which] = int(Answer.invalid_scene)

    def loadings(self, which: np.ndarray) -> dict[str, np.ndarray]:
        """The varied parameters of the loading, for some of the scenes."""
        names = [n for n in self.columns if n not in self.of_engine and place_of(n)[0] == "loading"]
        return {n: self.columns[n][which] for n in names}

    def scenes(self, which: np.ndarray) -> list[Scene]:
        """The scenes at some positions, in order."""
        places = {int(i): scene for own, scene in self.groups for i in np.intersect1d(own, which)}
        given = self.loadings(which)
        return [
            places[int(i)].with_values(**{name: float(column[k]) for name, column in given.items()})
            for k, i in enumerate(which)
        ]

    def put(self, which: np.ndarray, found: dict[str, np.ndarray]) -> None:
        for name, values in found.items():
            self.answer[name][which] = values

    def halved(self, compute, which: np.ndarray) -> None:
        """Stores the results of `compute(which)`; if computing the scenes together raises an error, those of each half."""
        if not which.size:
            return
        try:
            self.put(which, compute(which))
        except _ERRORS:
            if len(which) == 1:
                self.answer["outcome"][which] = int(Answer.failed)
                return
            for own in np.array_split(which, 2):
                self.halved(compute, own)

    def by_surface(self) -> None:
        for which, scene in self.groups:
            self.halved(lambda own, scene=scene: _on_surface(self.job, scene, self.loadings(own), len(own)), which)

    def by_engine(self, engine: Engine, which: np.ndarray) -> None:
        def compute(own):
            return engine.answers(self.scenes(own), {name: column[own] for name, column in self.of_engine.items()})

        self.halved(compute, which)

    def by_continuation(self, which: np.ndarray) -> None:
        def compute(own):
            batch = continue_scenes(self.scenes(own), tolerance=self.job.tolerance)
            return answers_of(batch.ramps, Source.continuation, batch.code)

        self.halved(compute, which)

    def by_diagrams(self, which: np.ndarray) -> None:
        def compute(own):
            try:
                diagram = voltage_volume(
                    self.scenes(own)[0], tolerance=self.job.tolerance, modes=self.job.modes or None
                )
                return answer_of_diagram(diagram, bool(self.job.modes))
            except SceneError as error:
                return {"outcome": np.int8(Answer.no_answer), "code": np.int8(error.code)}

        for i in which:
            self.halved(compute, np.array([i]))

    def in_units(self) -> dict[str, np.ndarray]:
        """The results, in SI where the scenes carry units, each scene's own."""
        kinds = kinds_in_si(job_variables(self.job.engine, self.job.curves, bool(self.job.modes)))
        for which, scene in self.groups if self.job.scene.units is not None else ():
            for name, kind in kinds.items():
                self.answer[name][which] *= float(typing.cast(Units, scene.units).scale(kind))
        return self.answer

    def left(self) -> np.ndarray:
        """The scenes that no engine has decided so far."""
        ended = np.isin(self.answer["outcome"], [int(Answer.unresolved), int(Answer.breakdown_on_branch)])
        return np.flatnonzero(ended & (self.answer["regime"] == int(Regime.not_decided)))


_ERRORS = ValueError, ArithmeticError, LookupError, RuntimeError, TypeError


def compute_block(job: Job, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The variables of a block of scenes: arrays (scenes, …).

    `columns` are the varied parameters. A scene that is invalid, or whose computation raises an error, is reported as such;
    other scenes are unaffected.
    """
    make_ready(job)
    block = _Block(job, columns)
    valid = np.sort(np.concatenate([np.array([], int), *(which for which, _ in block.groups)]))
    if not isinstance(job.engine, str):
        block.by_engine(job.engine, valid)
    elif job.engine == "surface":
        block.by_surface()
    elif job.modes:
        block.by_diagrams(valid)
    else:
        block.by_continuation(valid)
    if job.resolve:
        if job.engine == "surface":
            block.by_continuation(block.left())
        block.by_diagrams(block.left())
    return block.in_units()


def _on_surface(job: Job, scene: Scene, loadings: dict, count: int) -> dict[str, np.ndarray]:
    """The variables of loadings on one membrane, from its surface."""
    found = empty_answer(count, job.curves)
    found["outcome"][:] = int(Answer.unresolved)
    try:
        surface = surface_of(scene.membrane, job.tolerance, job.family)
    except ValueError:  # no part of the chart reaches the tolerance
        return found
    given = _columns_of(scene, loadings, count)
    if "initial_pressure" in given:
        filling = given.pop("initial_pressure")
        volumes = filling_volumes(surface, np.where(filling > 0, filling, 1.0))
        given["initial_volume"] = np.where(filling > 0, volumes, np.nan)
    # the states of a flat film are not on the surface
    good = np.all([np.isfinite(v) & ((v > 0) | (n == "atmospheric_pressure")) for n, v in given.items()], axis=0)
    which = np.flatnonzero(good)
    if not which.size:
        return found
    given = {name: values[which] for name, values in given.items()}
    if isinstance(scene.loading, Chamber):
        lanes = given.pop("chamber_volume"), given.pop("initial_volume")
        ramps, curves = chamber_ramps(surface, *lanes, **given), None
        if job.curves:
            curves = chamber_curves(surface, *lanes, **given)
    else:
        ramps = pressure_ramps(surface, given["pressure"])
        curves = pressure_curves(surface, given["pressure"]) if job.curves else None
    for name, values in answers_of(ramps, Source.surface).items():
        found[name][which] = values
    if curves is not None:
        apex = np.broadcast_to(curves.apex_stretch, curves.pressure.shape)
        error = np.asarray(surface.error_bound(apex, np.nan_to_num(curves.voltage_squared)))
        known = np.isfinite(curves.volume)
        found["curve_apex_stretch"][which] = np.where(known, apex, np.nan)
        found["curve_error"][which] = np.where(known, error, np.nan)
        for name in ("voltage_squared", "pressure", "volume"):
            found[f"curve_{name}"][which] = getattr(curves, name)
    return found


def _columns_of(scene: Scene, loadings: dict, count: int) -> dict[str, typing.Any]:
    """Every parameter of the loading as a column: those that vary, and those of the scene."""
    loading, found = scene.loading, {}
    names = [n for n, row in PARAMETERS.items() if row.path[0] == "loading" and scene.has(n)]
    filled = [name for name in ("initial_volume", "initial_pressure") if name in loadings]
    for name in names:
        value = loadings.get(name, getattr(loading, place_of(name)[-1]))
        if value is None or (filled and name.startswith("initial_") and name not in filled):
            continue
        column = np.broadcast_to(np.asarray(value, float), (count,))
        found[name] = scene.as_held(name, column) if name in loadings else column
    if isinstance(loading, ConstantPressure):
        return {"pressure": found["pressure"]}
    return found


def block_size(job: Job, count: int) -> int:
    """The number of scenes in a block: about a sixteenth of `count`, within limits of speed and memory; a power of two.

    It depends on the sweep alone, so that two runs of one sweep have the same layout of their stores.
    """
    if not isinstance(job.engine, str):
        return job.engine.block
    if job.engine == "continuation":
        least, most = BLOCK_OF_CONTINUATION
    else:
        least, most = BLOCK_WITH_MORE if job.curves or job.resolve else BLOCK_OF_SURFACE
    return int(min(max(2 ** round(math.log2(max(count / BLOCKS, 1.0))), least), most))
