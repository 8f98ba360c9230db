"""Any number of lanes through a compiled program of few shapes, on all cores.

A lane is one entry along an axis that all arguments of a vectorised program share: a state, a chamber, a design. XLA compiles
a program for each number of lanes, so lanes go through it in calls of one or a few sizes, the last call filled up with its
last lane. On a CPU a call should fit into the cache; on other devices it is made larger.
"""

import concurrent.futures
import functools
import itertools
import os
import typing
from collections.abc import Callable, Iterator

import jax
import numpy as np

from .resolution import DEVICE_LANES

__all__ = ["calls_of", "cores", "lanes_of_a_call", "run_lanes", "threads"]


def cores() -> int:
    """How many cores batches use: the environment variable DIELECTRIC_JAX_CORES, else those this process may run on."""
    asked = os.environ.get("DIELECTRIC_JAX_CORES", "")
    if not asked:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not asked.isdecimal() or int(asked) < 1:
        raise ValueError(f"`DIELECTRIC_JAX_CORES` must be a number of cores, at least 1, but is {asked!r}.")
    return int(asked)


@functools.cache
def threads() -> concurrent.futures.ThreadPoolExecutor:
    """One thread a core, for work that waits for no other of these threads."""
    return concurrent.futures.ThreadPoolExecutor(cores())


def lanes_of_a_call(size: int) -> int:
    """The lanes of one call: `size` on a CPU, `DEVICE_LANES` times as many elsewhere."""
    return size if jax.default_backend() == "cpu" else size * DEVICE_LANES


def calls_of(count: int, sizes: tuple[int, ...], fill: float = 0.0) -> Iterator[tuple[int, int]]:
    """Where each call begins, and its size: the largest of the rising `sizes` that is not too large for the lanes left.

    A size is too large where the one before it holds them all, or where they fill no more than the share `fill` of it.

    >>> list(calls_of(70, (8, 32)))
    [(0, 32), (32, 32), (64, 8)]
    """
    begin = 0
    while True:
        left = count - begin
        size = sizes[0]
        for smaller, larger in itertools.pairwise(sizes):
            size = larger if left > max(smaller, fill * larger) else size
        yield begin, size
        begin += size
        if begin >= count:
            return


def _part(values: np.ndarray, axis: int, begin: int, size: int) -> np.ndarray:
    """`size` entries along an axis from `begin` on, the last one again beyond the end; ones where there is none."""
    where: list[typing.Any] = [slice(None)] * values.ndim
    where[axis] = slice(begin, begin + size)
    part = values[tuple(where)]
    missing = size - part.shape[axis]
    if not missing:
        return part
    widths = [(0, 0)] * values.ndim
    widths[axis] = (0, missing)
    return np.pad(part, widths, mode="edge") if missing < size else np.pad(part, widths, constant_values=1)


def _with_lanes(shape: tuple, axis: int, count: int) -> tuple:
    sizes = list(shape)
    sizes[axis] = count
    return tuple(sizes)


def run_lanes(
    program: Callable,
    arguments: typing.Any,
    *,
    sizes: int | tuple[int, ...],
    axis: int = -1,
    out_axis: int = -1,
    parallel: bool = True,
) -> typing.Any:
    """`program(arguments)` for any number of lanes, in calls of the compiled `sizes`.

    `arguments` is an array, or a tree of arrays, whose `axis` counts the lanes; `program` takes one of the same structure
    with as many lanes as one of the sizes, and returns a tree of arrays whose `out_axis` counts them. The first call is made
    alone, as it may compile; the others are made on all cores, or with `parallel=False` one after the other.
    Returns the tree of all lanes, as arrays of NumPy.

    >>> roots, squares = run_lanes(lambda x: (np.sqrt(x), x * x), np.arange(5.0), sizes=2)
    >>> squares
    array([ 0.,  1.,  4.,  9., 16.])
    """
    leaves, tree = jax.tree.flatten(arguments)
    leaves = [np.asarray(v) for v in leaves]
    count = leaves[0].shape[axis]
    sizes = (sizes,) if isinstance(sizes, int) else sizes
    calls = list(calls_of(count, tuple(map(lanes_of_a_call, sizes))))

    def work(call):
        return program(jax.tree.unflatten(tree, [_part(v, axis, *call) for v in leaves]))

    first, out_tree = jax.tree.flatten(work(calls[0]))
    first = [np.asarray(v) for v in first]
    wholes = [np.empty(_with_lanes(v.shape, out_axis, count), v.dtype) for v in first]
    views = [np.moveaxis(whole, out_axis, 0) for whole in wholes]

    def keep(call, parts):
        begin, size = call
        for view, part in zip(views, parts, strict=True):
            view[begin : begin + size] = np.moveaxis(np.asarray(part), out_axis, 0)[: count - begin]

    def work_and_keep(call):
        keep(call, jax.tree.leaves(work(call)))

    keep(calls[0], first)
    list((threads().map if parallel else map)(work_and_keep, calls[1:]))
    return jax.tree.unflatten(out_tree, wholes)
