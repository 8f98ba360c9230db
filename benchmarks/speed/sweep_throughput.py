"""Scenes a second of labelled sweeps into a store, beside their errors: both engines, every kind of executor, 10² to 10⁶ scenes.

Executors are warm: each has computed a small sweep before. Errors are those of the voltages of folds and breakdown against the
references of `chambers.py` (extended precision), which share no code with the package; the same sweep is timed with more scenes.

    python -m benchmarks.speed.sweep_throughput [--scenes 32768] [--largest 1000000] [--json FILE|-] [--quick]
"""

import argparse
import concurrent.futures
import contextlib
import multiprocessing
import pathlib
import sys
import tempfile
import time

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.harness import machine, write
from benchmarks.speed.first_diagram import calibrate
from benchmarks.speed.sweep import gigabytes
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
        told = data.isel(chamber_volume=i)
        if int(told.outcome) == dj.sweeps.Answer.unresolved:
            continue
        decided += 1
        known = told.fold_voltage.values
        for q, _ in one.folds:
            if q > 0:
                apart = np.abs(known - voltage(q))
                worst = max(worst, float(np.nanmin(apart)) if np.isfinite(apart).any() else np.inf)
        if np.isfinite(told.breakdown_voltage):
            worst = max(worst, abs(float(told.breakdown_voltage) - voltage(one.breakdown)))
    return {"error": worst, "decided": decided, "references": len(truth)}


def drawn(count: int):
    from scipy import stats

    return dj.sweeps.samples(
        count, chamber_volume=stats.loguniform(300, 25000), initial_volume=stats.uniform(2.0, 0.8), method="random"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32768)
    parser.add_argument("--largest", type=int, default=1_000_000)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="few scenes, fewer executors")
    options = parser.parse_args()
    dj.enable_compilation_cache()
    kinds = [("in process", 1), ("processes", 1), ("processes", 2), ("dask", 1), ("dask", 2)]
    if options.quick:
        kinds = kinds[:2]
    counts = {"surface": 512 if options.quick else options.scenes, "continuation": 32 if options.quick else 2048}
    sizes = [100, 1000] if options.quick else [n for n in (10**2, 10**3, 10**4, 10**5, 10**6) if n <= options.largest]
    records = []
    with tempfile.TemporaryDirectory() as folder:
        number = iter(range(10**6))

        def timed(count: int, **given) -> tuple[float, object]:
            begin = time.perf_counter()
            data = dj.sweep(SCENE, drawn(count), output=pathlib.Path(folder) / f"{next(number)}.zarr", **given)
            return time.perf_counter() - begin, data

        settings = [("surface", 1e-9), ("surface", 1e-6), ("continuation", 1e-8)]
        for engine, tolerance in settings:
            given = {"engine": engine, "tolerance": tolerance, "progress": False}
            known = errors(dj.sweep(SCENE, chamber_volume=list(reference()), **given))
            for kind, workers in kinds if tolerance != 1e-6 else kinds[:1]:
                with executor(kind, workers) as pool:
                    given["executor"] = pool
                    block = max(32, counts[engine] // 16)
                    timed(block * workers, block=block, **given)
                    seconds, _ = timed(counts[engine], block=block, **given)
                records.append(
                    {
                        "name": "sweep_throughput: executors",
                        "engine": engine,
                        "tolerance": tolerance,
                        "executor": kind,
                        "workers": workers,
                        "scenes": counts[engine],
                        "seconds": seconds,
                        "scenes_per_second": counts[engine] / seconds,
                        **known,
                    }
                )
                print(records[-1], file=sys.stderr, flush=True)
        for count in sizes:
            seconds, data = timed(count, progress=False)
            records.append(
                {
                    "name": "sweep_throughput: sizes",
                    "engine": "surface",
                    "tolerance": 1e-9,
                    "executor": "in process",
                    "workers": 1,
                    "scenes": count,
                    "seconds": seconds,
                    "scenes_per_second": count / seconds,
                    "gigabytes": gigabytes(),
                    "outcomes": dj.sweeps.count_sweep(data)["outcome"],
                    **{key: records[0][key] for key in ("error", "decided", "references")},
                }
            )
            print(records[-1], file=sys.stderr, flush=True)
    wrong = [r for r in records if not r["error"] < max(ALLOWED, 10 * r["tolerance"])]
    document = {
        "name": "sweep_throughput",
        "records": records,
        "calibration_seconds": calibrate(),
        "machine": machine(),
    }
    write(document, options.json)
    print("FAILED" if wrong else "PASSED", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
