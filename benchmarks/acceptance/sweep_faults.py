"""Is anything lost when a sweep is killed? SIGKILL at random moments and in the middle of random writes, then on with it.

Each kill strikes a process that writes a store: half of them after a random time, half in a random write, of which half of
the bytes have arrived. After each, every block that was done is still done and bit for bit that of a run nobody
disturbed; in the end so is the whole store. Runs go on with none, one or two worker processes in turn.

    python -m benchmarks.acceptance.sweep_faults [--kills 50] [--seed 0] [--json FILE|-] [--quick]
"""

import itertools
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile

import numpy as np

from benchmarks import harness

SPECIFICATION = """
engine = "surface"
tolerance = 1e-6
block = 16

[scene]
initial_volume = 2.42

[product]
chamber_volume = { from = 300.0, to = 25000.0, count = 48, spacing = "log" }
prestretch = [1.0, 1.5]
"""
ROOT = pathlib.Path(__file__).parents[2]


def interrupted(number: int, fails: str) -> None:
    """From here on the write of this number ends half way: by SIGKILL, or with an error as on a full disk."""
    import zarr.storage._local as local

    counter = itertools.count(1)
    put = local._put

    def half(path, value, *args, **options):
        if next(counter) != number:
            return put(path, value, *args, **options)
        data = bytes(value.as_buffer_like())
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".0.partial").write_bytes(data[: len(data) // 2])
        if fails == "full":
            raise OSError(28, "No space left on device")
        os.kill(os.getpid(), signal.SIGKILL)

    local._put = half


def child(arguments: list[str]) -> int:
    """The command line, of which a write may fail: NUMBER kill|full ARGUMENTS…"""
    from dielectric_jax.apps.cli import main as command

    number, fails, *rest = arguments
    if int(number):
        interrupted(int(number), fails)
    return command(rest)


def start(store, specification, *more, at: int = 0, fails: str = "kill") -> subprocess.Popen:
    """A process that sweeps, whose write number `at` fails."""
    arguments = ["--child", str(at), fails, "sweep", str(specification), "--output", str(store), *more]
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.acceptance.sweep_faults", *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def contents(store) -> dict[str, np.ndarray]:
    """All arrays of a store; empty where there is none yet."""
    import zarr

    if not pathlib.Path(store).exists():
        return {}
    group = zarr.open_group(str(store), mode="r", use_consolidated=False)
    return {name: np.asarray(array[...]) for name, array in group.arrays()}


def same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


def lost(found: dict[str, np.ndarray], whole: dict[str, np.ndarray], before: np.ndarray | None) -> list[str]:
    """What is wrong with an unfinished store: blocks that were done and are not, and done ones that differ."""
    if not found:
        return [] if before is None or not before.any() else ["the store is gone"]
    done = found["block_done"]
    wrong = [] if before is None or not (before & ~done).any() else ["a finished block is not done any more"]
    # a done block's scenes have an outcome, and differ nowhere from the undisturbed run; others are not decided
    scenes = found["outcome"] != -1
    sure = np.zeros_like(scenes)
    grid = [-(-n // c) for n, c in zip(scenes.shape, CHUNK, strict=True)]
    for number in np.flatnonzero(done):
        place = np.unravel_index(number, grid)
        sure[tuple(slice(i * c, (i + 1) * c) for i, c in zip(place, CHUNK, strict=True))] = True
    for name, array in whole.items():
        if array.shape[: scenes.ndim] == scenes.shape and not same(found[name][sure], array[sure]):
            wrong.append(f"{name} differs in a finished block")
    return wrong


CHUNK = (16, 1)


class Undisturbed:
    """A store that nobody disturbed: its arrays, the files that were written, and the seconds of its process."""

    def __init__(self, folder: str, spec: pathlib.Path):
        first = start(f"{folder}/first.zarr", spec)
        said = first.communicate()[1]
        if first.returncode:
            raise SystemExit(said)
        watch = harness.Stopwatch()
        with watch:
            start(f"{folder}/whole.zarr", spec).communicate()
        self.seconds, self.arrays = watch.seconds, contents(f"{folder}/whole.zarr")
        self.writes = sum(path.is_file() for path in pathlib.Path(f"{folder}/whole.zarr").rglob("*"))
        again = contents(f"{folder}/first.zarr")
        self.repeats = all(same(array, self.arrays[name]) for name, array in again.items())

    def ends_in(self, found: dict[str, np.ndarray]) -> list[str]:
        """What is wrong with a store that was disturbed and then finished."""
        differing = [n for n, array in self.arrays.items() if n not in found or not same(array, found[n])]
        return [f"{name} differs in the end" for name in differing]


def disturbed(folder: str, spec: pathlib.Path, undisturbed: Undisturbed, kills: int, chance: random.Random):
    """Kills processes until `kills` of them died, and lets the last store end: records, what is wrong, stores finished."""
    records, wrong, finished = [], [], 0
    store = f"{folder}/0.zarr"
    while len(records) < kills or pathlib.Path(store).exists():
        known = contents(store).get("block_done")
        workers = chance.choice([[], ["--workers", "1"], ["--workers", "2"]])
        more = ["--resume", *workers] if known is not None or chance.random() < 0.5 else workers
        striking = len(records) < kills
        by_write = chance.random() < 0.5
        at = chance.randrange(1, undisturbed.writes) if striking and by_write else 0
        process = start(store, spec, *more, at=at)
        if striking and not by_write:
            try:
                process.wait(chance.uniform(0.3, 1.0) * undisturbed.seconds)
            except subprocess.TimeoutExpired:
                process.kill()
        said = process.communicate()[1]
        found = contents(store)
        wrong += lost(found, undisturbed.arrays, known)
        if process.returncode == -signal.SIGKILL:
            done = int(found["block_done"].sum()) if found else 0
            records.append({"in_a_write": by_write, "workers": len(workers) and int(workers[1]), "blocks_done": done})
            harness.say(f"kill {len(records)}: {records[-1]}")
            continue
        if process.returncode != 0:
            wrong.append(f"exit {process.returncode}: {said}")
        finished += 1
        wrong += undisturbed.ends_in(found)
        store = f"{folder}/{finished}.zarr"
        if wrong:
            break
    return records, wrong, finished


def main() -> int:
    if sys.argv[1:2] == ["--child"]:
        return child(sys.argv[2:])
    parser = harness.arguments(__doc__, "three kills", seed=True)
    parser.add_argument("--kills", type=int, default=50)
    options = parser.parse_args()
    kills = 3 if options.quick else options.kills
    with tempfile.TemporaryDirectory() as folder:
        os.environ.setdefault("DIELECTRIC_JAX_CACHE", f"{folder}/cache")
        spec = pathlib.Path(folder) / "spec.toml"
        spec.write_text(SPECIFICATION)
        undisturbed = Undisturbed(folder, spec)
        records, wrong, finished = disturbed(folder, spec, undisturbed, kills, random.Random(options.seed))
    if not undisturbed.repeats:
        wrong.insert(0, "two undisturbed runs differ")
    document = {
        "name": "sweep_faults",
        "parameters": {"kills": kills, "seed": options.seed},
        "kills": len(records),
        "in_a_write": sum(r["in_a_write"] for r in records),
        "with_some_blocks_done": sum(r["blocks_done"] > 0 for r in records),
        "stores_finished": finished,
        "blocks_of_a_store": len(undisturbed.arrays["block_done"]),
        "seconds_of_an_undisturbed_run": undisturbed.seconds,
        "wrong": wrong,
        "records": records,
        "machine": harness.machine(),
    }
    harness.say(json.dumps({k: v for k, v in document.items() if k not in ("records", "machine")}))
    return harness.finish(document, options.json, not wrong)


if __name__ == "__main__":
    sys.exit(main())
