"""Many runs side by side: each is a generator that asks for the results of compiled programs, and equal requests go together."""

import typing
from collections.abc import Generator, Sequence

import jax
import numpy as np

from ..numerics import SceneError, lapack_alone, run_lanes
from .programs import evolve_program, locate_program, restep_program, settle_program
from .resolution import RUNS_TOGETHER

__all__ = ["Request", "serve"]

_PROGRAMS = {
    "settle": settle_program,
    "evolve": evolve_program,
    "locate": locate_program,
    "restep": restep_program,
}


class Request(typing.NamedTuple):
    """A call of a program: its name, the mesh (functions, points), the arguments of one lane, and what all lanes share."""

    program: str
    mesh: tuple[int, int]
    arguments: tuple
    shared: tuple = ()


def _key(request: Request):
    leaves, tree = jax.tree.flatten(request.arguments)
    return request.program, request.mesh, request.shared, tree, tuple(np.shape(v) for v in leaves)


def _answered(requests: list[Request]) -> list:
    """The results of requests of one kind.

    On a CPU they are as many calls, on all cores: there lanes of one program wait for the slowest, and in `diffeqsolve` copy
    what all have saved at every step. On other devices they are lanes.
    """
    first = requests[0]
    many = jax.default_backend() != "cpu"
    program = _PROGRAMS[first.program](*first.mesh, many)
    stacked = jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *(r.arguments for r in requests))

    def of_one(part):
        found = program(*jax.tree.map(lambda v: v[0], part), *first.shared)
        return jax.tree.map(lambda v: np.asarray(v)[None], found)

    def of_many(part):
        return jax.block_until_ready(program(*part, *first.shared))

    run, sizes = (of_many, RUNS_TOGETHER) if many else (of_one, 1)
    with lapack_alone():
        found = run_lanes(run, stacked, sizes=sizes, axis=0, out_axis=0, parallel=not many)
    return [jax.tree.map(lambda v, i=i: v[i], found) for i in range(len(requests))]


def serve(runs: Sequence[Generator[Request, typing.Any, typing.Any]], *, keep_errors: bool = False) -> list:
    """What the generators return, when every request has been answered.

    With `keep_errors` the SceneError or ValueError of a run stands in its place, and the others go on.
    """
    kept = (SceneError, ValueError) if keep_errors else ()
    results: list = [None] * len(runs)
    waiting: dict[int, Request] = {}

    def resume(i, answer):
        try:
            waiting[i] = runs[i].send(answer)
        except StopIteration as stop:
            results[i] = stop.value
        except kept as error:
            results[i] = error

    for i in range(len(runs)):
        resume(i, None)
    while waiting:
        groups: dict = {}
        for i, request in waiting.items():
            groups.setdefault(_key(request), []).append(i)
        todo, waiting = waiting, {}
        for members in groups.values():
            for i, answer in zip(members, _answered([todo[i] for i in members]), strict=True):
                resume(i, answer)
    return results
