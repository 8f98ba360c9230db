"""Scenes a second of labelled sweeps into a store, beside their errors: both engines, every kind of executor, 10² to 10⁶ scenes.

Executors are warm: each has computed a small sweep before. Errors are those of the voltages of folds and breakdown against the
references of `chambers.py` (extended precision), which share no code with the package; the same sweep is timed with more scenes.

    python -m benchmarks.speed.sweep_throughput [--scenes 32768] [--largest 1000000] [--json FILE|-] [--quick]
"""

import concurrent.futures
import contextlib
import multiprocessing
import pathlib
import sys
import tempfile

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.truth.chambers import INITIAL_VOLUME, reference, voltage

jax.config.update("jax_enable_x64", True)

SCENE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=INITIAL_VOLUME))
ALLOWED = 1e-8


@contextlib.contextmanager
def executor(kind: str, workers: int):
    """An executor of a kind, or None."""
    if kind == "in process":
        yield None
    elif kind == "processes":
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(workers, context) as pool:
            yield pool
    else:
        import dask.distributed as distributed

        options = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
        with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
            yield client.get_executor()


def errors(data) -> dict:
    """The largest errors of the sweep of the references, and how many of them were decided."""
    truth, worst, decided = reference(), 0.0, 0
    for i, one in enumerate(truth.values()):
        found = data.isel(chamber_volume=i)
        if int(found.outcome) == dj.sweeps.Answer.unresolved:
            continue
        decided += 1
        known = found.fold_voltage.values
        for q, _ in one.folds:
            if q > 0:
                apart = np.abs(known - voltage(q))
                worst = max(worst, float(np.nanmin(apart)) if np.isfinite(apart).any() else np.inf)
        if np.isfinite(found.breakdown_voltage):
            worst = max(worst, abs(float(found.breakdown_voltage) - voltage(one.breakdown)))
    return {"error": worst, "decided": decided, "references": len(truth)}


def drawn(count: int):
    from scipy import stats

    return dj.sweeps.samples(
        count, chamber_volume=stats.loguniform(300, 25000), initial_volume=stats.uniform(2.0, 0.8), method="random"
    )


class Sweeps:
    """Sweeps of random scenes into new stores of a folder."""

    def __init__(self, folder: str):
        self.folder, self.count = pathlib.Path(folder), 0

    def run(self, count: int, **given) -> tuple[float, object]:
        """The seconds of one sweep, and its data."""
        self.count += 1
        watch = harness.Stopwatch()
        data = watch.time(dj.sweep, SCENE, drawn(count), output=self.folder / f"{self.count}.zarr", **given)
        return watch.seconds, data


def record(name: str, engine: str, tolerance: float, kind: str, workers: int, scenes: int, seconds: float) -> dict:
    """What one sweep took."""
    return {
        "name": f"sweep_throughput: {name}",
        "engine": engine,
        "tolerance": tolerance,
        "executor": kind,
        "workers": workers,
        "scenes": scenes,
        "seconds": seconds,
        "scenes_per_second": scenes / seconds,
    }


def of_executors(sweeps: Sweeps, kinds: list, counts: dict):
    """The records of both engines with every executor, warm."""
    for engine, tolerance in (("surface", 1e-9), ("surface", 1e-6), ("continuation", 1e-8)):
        given = {"engine": engine, "tolerance": tolerance, "progress": False}
        known = errors(dj.sweep(SCENE, chamber_volume=list(reference()), **given))
        for kind, workers in kinds if tolerance != 1e-6 else kinds[:1]:
            with executor(kind, workers) as pool:
                given["executor"] = pool
                block = max(32, counts[engine] // 16)
                sweeps.run(block * workers, block=block, **given)
                seconds, _ = sweeps.run(counts[engine], block=block, **given)
            yield record("executors", engine, tolerance, kind, workers, counts[engine], seconds) | known


def of_sizes(sweeps: Sweeps, sizes: list):
    """The records of sweeps of more and more scenes."""
    for count in sizes:
        seconds, data = sweeps.run(count, progress=False)
        more = {"gigabytes": harness.most_gigabytes(), "outcomes": dj.sweeps.count_sweep(data)["outcome"]}
        yield record("sizes", "surface", 1e-9, "in process", 1, count, seconds) | more


def main() -> int:
    parser = harness.arguments(__doc__, "few scenes, fewer executors")
    parser.add_argument("--scenes", type=int, default=32768)
    parser.add_argument("--largest", type=int, default=1_000_000)
    options = parser.parse_args()
    kinds = [("in process", 1), ("processes", 1), ("processes", 2), ("dask", 1), ("dask", 2)]
    if options.quick:
        kinds = kinds[:2]
    counts = {"surface": 512 if options.quick else options.scenes, "continuation": 32 if options.quick else 2048}
    sizes = [100, 1000] if options.quick else [n for n in (10**2, 10**3, 10**4, 10**5, 10**6) if n <= options.largest]
    records = []
    with tempfile.TemporaryDirectory() as folder:
        sweeps = Sweeps(folder)
        for one in of_executors(sweeps, kinds, counts):
            records.append(one)
            harness.say(one)
        for one in of_sizes(sweeps, sizes):
            records.append(one | {key: records[0][key] for key in ("error", "decided", "references")})
            harness.say(records[-1])
    good = all(r["error"] < max(ALLOWED, 10 * r["tolerance"]) for r in records)
    document = {
        "name": "sweep_throughput",
        "records": records,
        "calibration_seconds": harness.calibrate(),
        "machine": harness.machine(),
    }
    return harness.finish(document, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
