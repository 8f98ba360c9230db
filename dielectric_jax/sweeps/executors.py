"""The executors of a sweep: this process, worker processes, a Dask cluster, or any executor; and the progress bar.

The calling process distributes blocks and stores the results; workers only compute.
"""

import concurrent.futures
import contextlib
import gc
import multiprocessing
import os
import signal
import sys
import threading
import typing
from collections.abc import Callable, Iterator, Sequence

from ..numerics import WorkersLost, cores, need, shown
from .resolution import MOST_DEATHS

__all__ = ["Progress", "executor_of", "run_blocks"]


def _begin_worker(share: int) -> None:
    """Sets up a worker process: its share of the cores; it ignores interrupts, and ends with its parent."""
    os.environ["DIELECTRIC_JAX_CORES"] = str(share)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch():
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class _Processes:
    """Worker processes that are replaced when they die."""

    def __init__(self, workers: int):
        self.workers = workers
        self.executor = self._new()

    def _new(self) -> concurrent.futures.Executor:
        context = multiprocessing.get_context("spawn")
        share = max(1, cores() // self.workers)
        return concurrent.futures.ProcessPoolExecutor(
            self.workers, context, initializer=_begin_worker, initargs=(share,)
        )

    def replace(self) -> None:
        self.executor.shutdown(wait=False, cancel_futures=True)
        self.executor = self._new()


class _Given:
    """An executor given by the caller, which cannot be replaced."""

    def __init__(self, executor: concurrent.futures.Executor, workers: int):
        self.executor, self.workers = executor, workers

    def replace(self) -> None:
        raise WorkersLost("The executor broke, as when a worker is killed; what is finished is kept.") from None


def _refuse_fork(executor) -> None:
    """Raises ValueError for an executor whose workers are forks of this process.

    JAX has threads, which a fork does not copy, while it copies the locks that they hold: such workers wait forever.
    """
    context = getattr(executor, "_mp_context", None) or getattr(
        executor, "_context", None
    )  # the second is that of loky
    method = getattr(context, "get_start_method", lambda: None)()
    if method == "fork":
        raise ValueError(
            f"`executor` must start its worker processes by spawn or forkserver, but this {type(executor).__name__} forks them, "
            "and forks of a process that has used JAX hang; make it with "
            'mp_context=multiprocessing.get_context("spawn").'
        )


@contextlib.contextmanager
def executor_of(what) -> Iterator[_Processes | _Given]:
    """The executor for `what`: None for this process, a number of worker processes, a Dask address, or an executor."""
    if what is None:
        # one thread: the block uses all cores by itself, and this thread writes meanwhile
        own = _Given(concurrent.futures.ThreadPoolExecutor(1), 1)
    elif isinstance(what, int) and not isinstance(what, bool):
        if what < 1:
            raise ValueError(f"`executor` must be at least one worker process, but is {what!r}.")
        own = _Processes(what)
    elif isinstance(what, str):
        distributed = need("distributed", extra="distributed")
        # a client that found no scheduler is closed when it is garbage-collected, which must not happen while the next one
        # starts: both hold the lock of distributed's loop
        gc.collect()
        try:
            client = distributed.Client(what, timeout="10s", set_as_default=False)
        except (OSError, ValueError, TimeoutError):
            raise ValueError(
                f"`executor` must be the address of a Dask scheduler, but none answers at {shown(what)}."
            ) from None
        with client, client.get_executor() as executor:
            yield _Given(executor, max(1, sum(client.nthreads().values())))
        return
    elif callable(getattr(what, "get_executor", None)):  # a Dask client, whose own futures are of another type
        client = typing.cast(typing.Any, what)
        with client.get_executor() as executor:
            yield _Given(executor, max(1, sum(client.nthreads().values())))
        return
    elif isinstance(what, concurrent.futures.Executor) or callable(getattr(what, "submit", None)):
        _refuse_fork(what)
        yield _Given(typing.cast(concurrent.futures.Executor, what), 4 * cores())
        return
    else:
        raise ValueError(
            f"`executor` must be None, a number of processes, the address of a Dask scheduler, or an executor, but is {what!r}."
        )
    try:
        yield own
    finally:
        own.executor.shutdown(wait=True, cancel_futures=True)


def _result(future: concurrent.futures.Future):
    try:
        return future.result()
    except concurrent.futures.BrokenExecutor:
        raise
    except Exception as error:
        raise WorkersLost(
            f"A worker could not compute a block ({type(error).__name__}: {' '.join(str(error).split())}); "
            "what is finished is kept."
        ) from error


def run_blocks(pool: _Processes | _Given, function: Callable, tasks: Sequence[tuple], keep: Callable) -> None:
    """Computes `function(*arguments)` of tasks (key, make arguments) and calls `keep(key, result)` as each is done.

    Only as many tasks are submitted at a time as keep the workers busy. Tasks of workers that died are submitted again.
    """
    waiting = list(reversed(tasks))
    running: dict[concurrent.futures.Future, tuple] = {}
    deaths = 0
    window = 2 * pool.workers + (pool.workers > 1)
    try:
        while waiting or running:
            try:
                while waiting and len(running) < window:
                    task = waiting[-1]
                    running[pool.executor.submit(function, *task[1]())] = task
                    waiting.pop()
                done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
                for future in done:
                    result = _result(future)
                    keep(running.pop(future)[0], result)
                    deaths = 0
            except concurrent.futures.BrokenExecutor:
                deaths += 1
                if deaths > MOST_DEATHS:
                    raise WorkersLost(
                        f"Worker processes died {deaths} times without finishing a block between; what is finished is kept."
                    ) from None
                waiting += running.values()
                running.clear()
                pool.replace()
    finally:
        for future in running:
            future.cancel()


def _in_notebook() -> bool:
    """Whether this process is the kernel of a notebook, not merely one that has imported Jupyter's packages."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


class Progress:
    """A progress bar on a terminal or in a notebook, with rate, failures and remaining time; nothing elsewhere.

    `show` True or False overrides this.
    """

    def __init__(self, total: int, done: int, show: bool | None = None):
        if show is None:
            show = sys.stderr.isatty() or _in_notebook()
        self._failed = 0
        self._bar = None
        if show:
            tqdm = need("tqdm.auto")
            self._bar = tqdm.tqdm(total=total, initial=done, unit="scene", unit_scale=True, smoothing=0.1)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            self._bar.close()

    def add(self, scenes: int, failed: int) -> None:
        """Counts more finished scenes, of which `failed` have no answer."""
        self._failed += failed
        if self._bar is not None:
            self._bar.set_postfix(without_answer=self._failed, refresh=False)
            self._bar.update(scenes)
