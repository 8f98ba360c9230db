"""Where does the time go from the start of a process to its first diagram, with and without the compile cache?

The V_C = 1600 diagram in new processes: with the cache switched off, with an empty one, and with a filled one (in its second
process, which reads both the traced and the compiled programs). Of each: starting Python, importing jax and the package,
the first diagram, and the same diagram again. Tracing, lowering, compiling and loading run in threads side by side: their
seconds are sums over the threads, and together more than the first diagram's.

    python -m benchmarks.speed.cold_start [--json FILE|-] [--quick]
"""

import argparse
import sys
import tempfile

from benchmarks.harness import machine, write
from benchmarks.speed.first_diagram import calibrate, run

UNKNOWNS = {
    "python": "start_seconds",
    "jax": "import_jax_seconds",
    "package": "import_package_seconds",
    "first": "first_call_seconds",
    "again": "warm_seconds",
    "trace": "trace",
    "lower": "lower",
    "compile": "compile",
    "load": "load",
}


def staged(cache: str, repeats: int) -> dict:
    """The record of one process."""
    one = run(cache, repeats)
    stages = one.pop("stages")
    stages["compile"] = max(0.0, stages.pop("compile_or_load") - stages["load"])
    inside = one["import_seconds"] + one["first_call_seconds"] + sum(one["warm_all_seconds"])
    return one | {
        # what Python takes before the first line and after the last
        "start_seconds": max(0.0, one["process_seconds"] - inside),
        "import_package_seconds": one["import_seconds"] - one["import_jax_seconds"],
        "stages_summed_over_threads": stages,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="the cache empty and filled, one warm diagram")
    options = parser.parse_args()
    repeats = 1 if options.quick else 3
    with tempfile.TemporaryDirectory() as folder:
        cases = {"empty cache": folder, "filled cache": folder}
        cases = cases if options.quick else {"no cache": "off", **cases}
        found = {name: staged(cache, repeats) for name, cache in cases.items()}
    records = [
        {
            "name": f"cold_start: {name}",
            "engine": "continuation",
            "parameters": {"chamber_volume": 1600.0, "cache": name},
            "error": max(one["fold_error"], one["breakdown_error"]),
            "seconds_per_diagram": one["first_call_seconds"],
            "machine": machine(),
            **one,
        }
        for name, one in found.items()
    ]
    write({"name": "cold_start", "calibration_seconds": calibrate(), "records": records}, options.json)
    print(f"{'':14}" + "".join(f"{head:>9}" for head in UNKNOWNS) + f"{'error':>10}", file=sys.stderr)
    for name, one in found.items():
        values = one | one["stages_summed_over_threads"]
        cells = "".join(f"{values[key]:9.2f}" for key in UNKNOWNS.values())
        print(f"{name:14}{cells}{max(one['fold_error'], one['breakdown_error']):10.1e}", file=sys.stderr)
    print("seconds; the last four are sums over threads, most of which belong to the first diagram", file=sys.stderr)
    return 0 if all(r["error"] < 1e-9 for r in records) else 1


if __name__ == "__main__":
    sys.exit(main())
