"""Many runs side by side: each is a generator that asks for the results of compiled programs, and equal requests go together."""

import typing
from collections.abc import Generator, Sequence

import jax
import numpy as np

from ..numerics import lapack_alone, run_lanes
from .programs import evolve_program, restep_program, settle_program
from .resolution import RUNS_TOGETHER

__all__ = ["Request", "serve"]

_PROGRAMS = {"settle": settle_program, "evolve": evolve_program, "restep": restep_program}


class Request(typing.NamedTuple):
    """A call of a program: its name, the mesh (functions, points), the arguments of one lane, and what all lanes share."""

    program: str
    mesh: tuple[int, int]
    arguments: tuple
    shared: tuple = ()


def _key(request: Request):
    leaves, tree = jax.tree.flatten(request.arguments)
    return request.program, request.mesh, request.shared, tree, tuple(np.shape(v) for v in leaves)


def _answered(requests: list[Request], together: int) -> list:
    """The results of requests of one kind, so many in a call."""
    first = requests[0]
    program = _PROGRAMS[first.program](*first.mesh)
    stacked = jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *(r.arguments for r in requests))

    def run(part):
        with lapack_alone():
            return jax.block_until_ready(program(*part, *first.shared))

    found = run_lanes(run, stacked, sizes=together, axis=0, out_axis=0, parallel=False)
    return [jax.tree.map(lambda v, i=i: v[i], found) for i in range(len(requests))]


def serve(runs: Sequence[Generator[Request, typing.Any, typing.Any]]) -> list:
    """What the generators return, when every request has been answered."""
    results: list = [None] * len(runs)
    waiting: dict[int, Request] = {}

    def resume(i, answer):
        try:
            waiting[i] = runs[i].send(answer)
        except StopIteration as stop:
            results[i] = stop.value

    for i in range(len(runs)):
        resume(i, None)
    together = RUNS_TOGETHER if len(runs) > 1 else 1  # one size, as every size is compiled
    while waiting:
        groups: dict = {}
        for i, request in waiting.items():
            groups.setdefault(_key(request), []).append(i)
        todo, waiting = waiting, {}
        for members in groups.values():
            for i, answer in zip(members, _answered([todo[i] for i in members], together), strict=True):
                resume(i, answer)
    return results
