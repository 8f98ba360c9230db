"""Sweeps: many scenes in one labelled dataset, in memory or in a store that stays valid if its writer is killed."""

import contextlib
import dataclasses
import datetime
import functools
import hashlib
import importlib.metadata
import json
import math
import os
import pathlib
import pickle
import platform
import sys
import typing
from collections.abc import Iterable

import numpy as np

from ..diagram import check_request
from ..model import Chamber, ConstantPressure, Scene, describe, other_loading, require_float64
from ..modes import checked_numbers
from ..numerics import StoreError, check_whole, enabled_folder, need, source_digest
from ..surface import check_tolerance, fingerprint
from .axes import Axis, Design, axes_of
from .blocks import Job, block_size, compute_block
from .engines import Engine, check_engine, job_variables, parameters_of
from .executors import Progress, executor_of, run_blocks
from .extension import extend_store, has_other_axes, undo_half_extension
from .resolution import FAMILY_FROM, MOST_BLOCKS
from .store import Memory, ZarrStore, open_group
from .variables import Answer, described_in_si

__all__ = ["open_sweep", "sweep"]

_PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "numpy", "scipy")
_UNANSWERED = (Answer.unresolved, Answer.no_answer, Answer.invalid_scene, Answer.failed)


def sweep(
    scene: Scene,
    *axes: Axis,
    output: str | os.PathLike | None = None,
    resume: bool = False,
    accept_versions: bool = False,
    engine: str | Engine = "surface",
    resolve: bool = False,
    curves: bool = False,
    tolerance: float | None = None,
    modes: Iterable[int] | None = None,
    block: int | None = None,
    executor: typing.Any = None,
    progress: bool | None = None,
    **parameters: typing.Any,
) -> typing.Any:
    """The ramps and special points of many scenes: an `xarray.Dataset` on the product of all axes.

    Each parameter (`PARAMETERS`) given as a list forms an axis of that name; `zipped`, `samples` and `read_scenes` make axes
    along which several parameters vary together. All other parameters are those of `scene`.

    Args:
        scene: the scene whose parameters are varied.
        *axes: axes of several parameters.
        output: a zarr store to write block by block; the result is then read from it lazily. In memory when None.
        resume: continue the store if it exists, with its own block size. Where the axes, named in the same order, hold more values
            than the store, its scenes keep their numbers and only the others are computed.
        accept_versions: continue a store that was begun by other versions.
        engine: "surface", or "continuation", which does not need a surface of each membrane; or an engine with variables of its
            own, such as `dj.rates.InTime`, which does not take `resolve`, `curves`, `modes` and `tolerance`.
        resolve: decide scenes left open by the engine with continuation and whole diagrams.
        curves: also compute the curves of voltage against volume, 256 states each (surface only).
        tolerance: largest error of the surface, or of continuation; 1e-9 when None.
        modes: circumferential numbers of modes, such as `range(1, 25)`, that end a ramp as in `voltage_volume` (continuation
            only). Every scene then takes a whole diagram, some seconds with 24 numbers.
        block: scenes in a block; when None a sixteenth of all, from 256 to 8192 (surface) or 32 to 128 (continuation).
        executor: None, a number of worker processes, the address of a Dask scheduler, or a `concurrent.futures.Executor`.
        progress: show a progress bar; on a terminal and in a notebook when None.
        **parameters: lists of values of parameters; with `units` of the scene also texts such as "0.5 l".

    Returns:
        The dataset; `outcome` and `regime` are codes (see their `flag_meanings`), and every value comes with its error.

    Raises:
        ValueError: for bad input, with one sentence.
        OSError: for a store that cannot be written, already exists, is being written, or holds another sweep.

    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> data = sweep(scene, chamber_volume=[800.0, 1600.0])
    >>> [round(float(v), 9) for v in data.snap_voltage.sel(jump=0)]
    [0.097199007, 0.07649536]
    """
    require_float64()
    check_engine(engine, resolve=resolve, curves=curves, modes=modes, tolerance=tolerance)
    design = Design(scene, (*axes, *axes_of(parameters, scene)), parameters_of(engine))
    numbers = () if modes is None else checked_numbers(modes, 1, "modes")
    job = _job(design, engine, resolve, curves, 1e-9 if tolerance is None else tolerance)
    job = dataclasses.replace(job, modes=numbers)
    if block is not None:
        check_whole("block", block, 1, 2**31 - 1)
    if resume and output is None:
        raise ValueError("`resume` must be given with `output` only, because memory holds nothing to resume.")
    need("xarray")
    if isinstance(executor, int) and executor is not True:
        _check_pickle(job)
    variables = job_variables(engine, curves, bool(numbers))
    if scene.units is not None:
        variables = [dataclasses.replace(v, attributes=described_in_si(v.attributes)) for v in variables]
    _check_names(design, variables)
    attributes = _attributes(design, job)
    path = None if output is None else pathlib.Path(output)
    with executor_of(executor) as pool, contextlib.ExitStack() as stack:
        if path is not None and resume:
            undo_half_extension(path)
        if path is not None and resume and path.exists():
            chunk = design.chunk(block or block_size(job, design.count))
            what = design, variables, attributes
            store = stack.enter_context(_resumed(path, what, chunk, accept_versions))
        elif path is not None and path.exists():
            raise StoreError(f"{str(path)!r} is there already; resume it, or name another store.")
        else:
            chunk = design.chunk(block or block_size(job, design.count))
            _check_size(design, chunk, variables, path is None)
            if path is None:
                store = Memory(design, chunk, variables)
            else:
                store = stack.enter_context(ZarrStore.create(path, design, chunk, variables, attributes))
        _run(pool, job, design, store, progress)
        if isinstance(store, Memory):
            return store.dataset(attributes)
    return open_sweep(typing.cast(pathlib.Path, path))


@contextlib.contextmanager
def _resumed(
    path: pathlib.Path, what: tuple, chunk: tuple[int, ...], accept_versions: bool
) -> typing.Iterator[ZarrStore]:
    """The store of a sweep, of `what` (design, variables, attributes), whose damaged blocks are not done; extended where the axes
    are longer.
    """
    design, variables, attributes = what
    if has_other_axes(path, attributes):
        _check_size(design, chunk, variables, False)
        extend_store(path, design, chunk, variables, attributes, accept_versions)
    with ZarrStore.resume(path, design, variables, attributes, accept_versions) as store:
        damaged = store.damaged()
        store.forget(damaged)
        for number in damaged:
            _say(f"Block {number} of {str(path)!r} is damaged and computed again.")
        yield store


def _job(design: Design, engine: str | Engine, resolve: bool, curves: bool, tolerance: float) -> Job:
    folder = enabled_folder()
    cache = None if folder is None else str(folder)
    if not isinstance(engine, str):
        engine.check_axes(design.scene, {n: column for axis in design.axes for n, column in axis.columns.items()})
        return Job(design.scene, engine, cache=cache)
    if engine == "surface":
        check_tolerance(tolerance, "surface")
    check_request(8, tolerance)
    if curves and engine != "surface":
        raise ValueError("`curves` must be asked for with the engine 'surface' only, not with 'continuation'.")
    if not isinstance(design.scene.loading, (Chamber, ConstantPressure)):
        raise other_loading(design.scene.loading, Chamber, ConstantPressure)
    windows = design.scene.window.apex_stretch is not None or design.scene.window.load_fraction != (-1.0, 1.0)
    if windows and engine == "surface":
        raise ValueError(
            "`scene` must have the default window with the engine 'surface'; 'continuation' takes another."
        )
    stretches = [axis.columns["prestretch"] for axis in design.axes if "prestretch" in axis.columns]
    family = None
    if engine == "surface" and stretches and len(np.unique(stretches[0])) >= FAMILY_FROM:
        family = float(stretches[0].min()), float(stretches[0].max())
    return Job(design.scene, engine, resolve, curves, tolerance, family, cache)


def _check_size(design: Design, chunk, variables, in_memory: bool) -> None:
    """Refuses a sweep with too many blocks or, in memory, with too many numbers."""
    blocks = math.prod(-(-size // own) for size, own in zip(design.shape, chunk, strict=True))
    if blocks > MOST_BLOCKS:
        raise ValueError(
            f"`block` must be larger for {design.count} scenes, of which {blocks} blocks would be made; at most "
            f"{MOST_BLOCKS} can be."
        )
    needed = design.count * sum(np.dtype(v.dtype).itemsize * math.prod(v.dims.values()) for v in variables)
    if in_memory and needed > memory():
        raise ValueError(
            f"`output` must name a store for {design.count} scenes, which take {needed / 2**30:.3g} GiB in memory, "
            f"of which there are {memory() / 2**30:.3g} GiB."
        )


def _check_names(design: Design, variables) -> None:
    """Refuses an axis with the name of a variable or of another dimension of the dataset."""
    taken = {
        "block",
        "block_done",
        "block_checksum",
        "known_checksum",
        "scene_known",
        *(v.name for v in variables),
        *(d for v in variables for d in v.dims),
    }
    for name in design.dimensions:
        if name in taken:
            raise ValueError(
                f"`{name}` must not be the name of an axis, because the dataset holds a variable of that name."
            )


def memory() -> int:
    """The memory of this machine in bytes; 16 GiB if the system does not report it."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 2**34


def _check_pickle(job: Job) -> None:
    try:
        pickle.dumps(job)
    except Exception:
        raise ValueError(
            "`scene` must be sent to worker processes, but holds what cannot be, such as a function without a module; "
            "compute in this process."
        ) from None


def _run(pool, job: Job, design: Design, store: Memory | ZarrStore, show: bool | None) -> None:
    """Computes and stores the blocks that are not done."""
    sizes = [int(np.prod([s.stop - s.start for s in part])) for part in store.parts]
    done = sum(size for size, known in zip(sizes, store.done, strict=True) if known)
    left = [int(i) for i in design.order(store.chunk) if not store.done[i]]
    tasks = [(i, functools.partial(_arguments, job, design, store, i)) for i in left if not store.known(i).all()]
    with Progress(design.count, done, show) as bar:

        def keep(number, answer):
            answer = store.with_known(number, answer)
            store.write(number, answer)
            bar.add(sizes[number], int(np.isin(answer["outcome"], [int(a) for a in _UNANSWERED]).sum()))

        for number in set(left) - {number for number, _ in tasks}:
            keep(number, {})
        # one worker fills the caches of programs and surfaces, from which the others read
        alone = 1 if pool.workers > 1 else 0
        run_blocks(pool, compute_block, tasks[:alone], keep)
        run_blocks(pool, compute_block, tasks[alone:], keep)


def _arguments(job: Job, design: Design, store: Memory | ZarrStore, number: int) -> tuple:
    new = ~store.known(number)
    return job, {name: column[new] for name, column in design.columns(store.parts[number]).items()}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _attributes(design: Design, job: Job) -> dict[str, str]:
    """The provenance of the numbers: the sweep itself, versions, machine."""
    versions = {"dielectric_jax": f"{importlib.metadata.version('dielectric-jax')}" if _installed() else "source"}
    versions |= {"sources": source_digest()[:12]}
    versions |= {name: importlib.metadata.version(name) for name in _PACKAGES}
    axes = {
        axis.dimension: {
            name: f"{values.size} values {hashlib.sha256(values.tobytes()).hexdigest()[:12]}"
            for name, values in axis.columns.items()
        }
        for axis in design.axes
    }
    scene = describe(design.scene)
    for axis in design.axes:  # parameters that vary do not belong to the scene
        for name in axis.columns:
            scene.pop(name, None)
            if name.startswith("initial_"):
                scene.pop("initial_volume", None)
                scene.pop("initial_pressure", None)
    if "custom" in str(scene["material"]) or not isinstance(scene["breakdown"], (str, float)):
        scene["energies"] = hashlib.sha256(np.round(fingerprint(design.scene.membrane), 9).tobytes()).hexdigest()[:12]
    window = design.scene.window
    specification = {
        "scene": scene,
        "window": [window.apex_stretch and list(window.apex_stretch), list(window.load_fraction)],
        "axes": axes,
        "engine": job.engine if isinstance(job.engine, str) else job.engine.document(),
        "resolve": job.resolve,
        "curves": job.curves,
        "tolerance": job.tolerance,
        **({"modes": job.modes} if job.modes else {}),
        "surfaces": "alone"
        if job.family is None
        else f"of a family for prestretch {job.family[0]!r} to {job.family[1]!r}",
    }
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    return {
        "Conventions": "CF-1.11",
        "title": "Ramps and special points of a dielectric elastomer membrane",
        "source": "dielectric_jax",
        "references": "https://doi.org/10.1016/j.jmps.2012.09.006",
        "specification": json.dumps(specification),
        "versions": json.dumps(versions),
        "machine": machine,
        "history": f"{now} sweep with dielectric_jax {versions['dielectric_jax']} on {machine}",
    }


def _installed() -> bool:
    try:
        importlib.metadata.version("dielectric-jax")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def open_sweep(path, *, chunks: typing.Any = None):
    """The dataset in a store, read lazily, also of an unfinished sweep.

    Scenes that are not yet computed have `outcome` `not_computed` and NaN. `chunks` as in `xarray.open_zarr`: with a
    value other than None the variables are Dask arrays. Raises ValueError for a path that is not the store of a sweep.
    """
    xarray = need("xarray")
    group = open_group(path)
    data = xarray.open_zarr(str(path), chunks=chunks)
    done = int(np.asarray(group["block_done"][:]).sum())
    data = data.drop_vars(["block_done", "block_checksum", "known_checksum", "scene_known"])
    for name in ("format", "block_shape"):
        data.attrs.pop(name, None)
    return data.assign_attrs(blocks_done=done, blocks=int(group["block_done"].shape[0]))
