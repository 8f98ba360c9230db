"""What the benchmarks share: their arguments, a stopwatch, what JAX compiles, the machine, and the record that each writes.

Nothing but the standard library is imported until it is needed: `speed/first_diagram.py` times the import of JAX.
"""

import argparse
import collections
import json
import math
import os
import pathlib
import platform
import sys
import time

_STAGES = {
    "trace": "/jax/core/compile/jaxpr_trace_duration",
    "lower": "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "compile_or_load": "/jax/core/compile/backend_compile_duration",
    "load": "/jax/compilation_cache/cache_retrieval_time_sec",
}


def arguments(description: str, quick: str, *, seed: bool = False) -> argparse.ArgumentParser:
    """The arguments of every benchmark: --json, --quick (with what it leaves) and, where it draws at random, --seed."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help='where the record goes; "-" is standard output')
    parser.add_argument("--quick", action="store_true", help=quick)
    if seed:
        parser.add_argument("--seed", type=int, default=0)
    return parser


def without_cache() -> None:
    """Makes every program anew, for what is measured with an empty cache; to be called before the first computation."""
    os.environ["DIELECTRIC_JAX_CACHE"] = "off"


def say(*what) -> None:
    """A line on standard error: standard output holds the record and nothing else."""
    print(*what, file=sys.stderr, flush=True)


class Progress:
    """Lines on standard error, each with the seconds since the start."""

    def __init__(self):
        self._begin = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._begin

    def __call__(self, text: str) -> None:
        say(f"[{self.seconds:7.1f} s] {text}")


def _ready(value):
    """The value, once its JAX arrays are computed."""
    jax = sys.modules.get("jax")
    return value if jax is None else jax.block_until_ready(value)


class Stopwatch:
    """Wall and CPU seconds of the blocks that run under it (`with watch:`), summed, and the number of blocks."""

    def __init__(self):
        self.seconds, self.cpu_seconds, self.count = 0.0, 0.0, 0

    def __enter__(self):
        self._begin = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_):
        self.seconds += time.perf_counter() - self._begin[0]
        self.cpu_seconds += time.process_time() - self._begin[1]
        self.count += 1

    def time(self, function, *args, **options):
        """What a function returns, timed until its JAX arrays are computed."""
        with self:
            return _ready(function(*args, **options))


class Timing:
    """The rounds of one call: the value and the seconds of each, apart from a first call that may have compiled."""

    def __init__(self):
        self.first: float | None = None
        self.values, self.seconds, self.cpu_seconds = [], [], []

    def add(self, value, seconds: float, cpu_seconds: float) -> None:
        """One more round."""
        self.values.append(value)
        self.seconds.append(seconds)
        self.cpu_seconds.append(cpu_seconds)

    @property
    def value(self):
        """What the last call returned."""
        return self.values[-1]

    @property
    def value_of_best(self):
        """What the quickest round returned."""
        return self.values[self.seconds.index(self.best)]

    @property
    def best(self) -> float:
        """The least seconds of a warm round."""
        return min(self.seconds)

    @property
    def median(self) -> float:
        ordered, half = sorted(self.seconds), len(self.seconds) // 2
        return ordered[half] if len(ordered) % 2 else (ordered[half - 1] + ordered[half]) / 2

    @property
    def best_cpu(self) -> float:
        """The least CPU seconds of a warm round, summed over the threads of this process."""
        return min(self.cpu_seconds)

    @property
    def compile_seconds(self) -> float:
        """What the first call took beyond a warm round."""
        return max(0.0, self.first - self.best) if self.first is not None else 0.0


def timed_in_turn(runs: dict, rounds: int, *, warm_up: bool = True, shortest: float = 0.0, reported=None) -> dict:
    """The `Timing` of every call, by name, timed turn by turn: a drift of the machine's speed affects all alike.

    Each runs once before, to compile (`warm_up`); without later rounds that call is the round. A round repeats a call
    until it takes about `shortest` seconds. `reported(value)` is the seconds that a call itself reports, such as those of a peer
    in a process of its own, or None.
    """
    timings = {name: Timing() for name in runs}
    repeats = dict.fromkeys(runs, 1)

    def once(name: str) -> tuple:
        watch, value = Stopwatch(), None
        with watch:
            for _ in range(repeats[name]):
                value = _ready(runs[name]())
        own = reported(value) if reported else None
        return value, watch.seconds / repeats[name] if own is None else own, watch.cpu_seconds / repeats[name]

    if warm_up:
        for name, timing in timings.items():
            value, timing.first, cpu = once(name)
            if not rounds:
                timing.add(value, timing.first, cpu)
            elif shortest:
                repeats[name] = max(1, int(shortest / once(name)[1]))
    for _ in range(rounds):
        for name, timing in timings.items():
            timing.add(*once(name))
    return timings


def timed(run, rounds: int, **options) -> Timing:
    """The `Timing` of one call; the options are those of `timed_in_turn`."""
    return timed_in_turn({"": run}, rounds, **options)[""]


def calibrate() -> float:
    """Seconds of a fixed loop of plain NumPy, best of five: the speed of the machine in this run."""
    import numpy as np

    def loop():
        x = np.linspace(0.0, 1.0, 1000)
        for _ in range(20_000):
            x = x + 1e-6 * np.sin(x)

    return timed(loop, 5, warm_up=False).best


class Compilations:
    """What JAX compiles from now on: seconds of each stage, and how many programs of each function.

    Seconds are sums over the threads that work side by side; a trace inside another counts in both. With a filled cache
    the stage `compile_or_load` is the loading of programs.
    """

    def __init__(self):
        import jax

        self.stages = dict.fromkeys(_STAGES, 0.0)
        self.functions: collections.Counter = collections.Counter()
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event, seconds, fun_name="?", **_):
        for stage, name in _STAGES.items():
            if event == name:
                self.stages[stage] += seconds
        if event == _STAGES["compile_or_load"]:
            self.functions[fun_name] += 1

    @property
    def seconds(self) -> float:
        return self.stages["compile_or_load"]

    @property
    def programs(self) -> int:
        return self.functions.total()


def most_gigabytes() -> float:
    """The most memory that this process has held so far."""
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1 << 30 if sys.platform == "darwin" else 1 << 20)


def gigabytes() -> float:
    """The memory that this process holds now; NaN where the system does not say (only Linux does)."""
    status = pathlib.Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmRSS")), math.nan)


def machine() -> dict:
    """Processor, cores and versions."""
    import jax
    import numpy as np

    name = platform.processor() or platform.machine()
    info = pathlib.Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        name = names[0] if names else name
    return {
        "processor": name,
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
    }


def plain(value):
    """The value as JSON has it, without NaN."""
    value = value.tolist() if hasattr(value, "tolist") else value  # arrays and NumPy's scalars
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def write(document: dict, where: str | None, *, partial: bool = False) -> None:
    """The document to a file (replaced at once, so that it is whole at any time) or, for "-", to standard output.

    A `partial` document, written so that an interrupted run loses nothing, goes to a file only: standard output gets one.
    """
    if where is None or (partial and where == "-"):
        return
    text = json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if where == "-":
        sys.stdout.write(text)
        return
    path = pathlib.Path(where)
    half = path.with_name(path.name + ".part")
    half.write_text(text)
    half.replace(path)


def finish(document: dict, where: str | None, passed: bool) -> int:
    """Writes the whole document, says whether the answer is good, and returns the exit status."""
    write(document, where)
    say("PASSED" if passed else "FAILED")
    return 0 if passed else 1
