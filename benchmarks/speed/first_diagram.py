"""How long does the first diagram take in a new process, where does that time go, and how long does the next one take?

The V_C = 1600 diagram with all branches, special points and ramp, in new processes: with the compile cache switched off,
with an empty one, and with a filled one (in its second process, which reads both the traced and the compiled programs);
and warm (best of five), beside a fixed calibration loop of plain NumPy and the error against reference values. Of each
process: starting Python, importing jax and the package, the first diagram, and the same diagram again. Tracing,
lowering, compiling and loading run in threads side by side: their seconds are sums over the threads, and together more than
the first diagram's. Two more processes without a cache compile all programs with XLA's fusion emitters, and none: what the package
chooses, program by program, rests on the seconds of their first diagram, of the next, and of a scan.

    python -m benchmarks.speed.first_diagram [--json FILE|-] [--quick]
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

from benchmarks import harness

ROOT = pathlib.Path(__file__).parents[2]
LIMITS = {"empty cache": 15.0, "filled cache": 5.0, "warm": 0.3}
COLUMNS = {
    "python": "start_seconds",
    "jax": "import_jax_seconds",
    "package": "import_package_seconds",
    "first": "first_call_seconds",
    "again": "warm_seconds",
    "scan": "scan_seconds",
    "trace": "trace",
    "lower": "lower",
    "compile": "compile",
    "load": "load",
}


def force(options: dict) -> None:
    """Every program is compiled with these options of XLA, whatever the package asks for."""
    import jax

    compile_one = jax.stages.Lowered.compile

    def compile_all(self, compiler_options=None):
        return compile_one(self, (compiler_options or {}) | options)

    jax.stages.Lowered.compile = compile_all


def child(repeats: int, emitters: str | None) -> None:
    """One process: import, first diagram, warm diagrams, scans; prints a JSON object."""
    importing, of_jax, first = (harness.Stopwatch() for _ in range(3))
    with importing:
        with of_jax:
            import jax
        jax.config.update("jax_enable_x64", True)
        if emitters is not None:
            force({"xla_cpu_use_fusion_emitters": emitters == "all"})
        compiled = harness.Compilations()
        import dielectric_jax as dj

        dj.numerics.enable_compilation_cache()

    from benchmarks.speed import one_chamber

    def diagram():
        return dj.voltage_volume(one_chamber.scene())

    first.time(diagram)
    programs, stages = compiled.programs, dict(compiled.stages)
    warm = harness.timed(diagram, repeats, warm_up=False)
    found = warm.value
    from dielectric_jax.model import chart

    stretches, _, loads = one_chamber.scene().limits()
    scan = harness.timed(lambda: chart.scan(one_chamber.scene().membrane, stretches, loads), repeats, warm_up=False)
    out = {
        "import_seconds": importing.seconds,
        "import_jax_seconds": of_jax.seconds,
        "stages": stages,
        "first_call_seconds": first.seconds,
        "warm_seconds": warm.best,
        "warm_all_seconds": warm.seconds,
        "scan_seconds": scan.best,
        "scan_all_seconds": scan.seconds,
        # with a filled cache these are the loads from it
        "compile_seconds": stages["compile_or_load"],
        **one_chamber.errors(**one_chamber.voltages(found)),
        "counts": {
            "compiled_programs": programs,
            "compiled_programs_warm": compiled.programs - programs,
            "branches": len(found.branches),
            "points": sum(len(b) for b in found.branches),
            "special_points": len(found.special_points),
            "events": len(found.events),
        },
        "complete": found.complete,
    }
    print(json.dumps(out))


def run(cache: str, repeats: int, emitters: str | None = None) -> dict:
    """The child's record, with the seconds of the whole process as seen from outside."""
    forced = ["--emitters", emitters] if emitters else []
    process = harness.Stopwatch()
    with process:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.speed.first_diagram", "--child", str(repeats), *forced],
            cwd=ROOT,
            # a cache that JAX has already would not be empty
            env={k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
            | {"DIELECTRIC_JAX_CACHE": cache},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    one = json.loads(done.stdout)
    stages = one.pop("stages")
    stages["compile"] = max(0.0, stages.pop("compile_or_load") - stages["load"])
    inside = one["import_seconds"] + one["first_call_seconds"] + sum(one["warm_all_seconds"])
    inside += sum(one["scan_all_seconds"])
    return one | {
        "process_seconds": process.seconds,
        # what Python takes before the first line and after the last
        "start_seconds": max(0.0, process.seconds - inside),
        "import_package_seconds": one["import_seconds"] - one["import_jax_seconds"],
        "stages_summed_over_threads": stages,
    }


def record(name: str, one: dict, calibration: float) -> dict:
    """The record of a process, or of its warm diagrams."""
    from benchmarks.speed import one_chamber

    # of a first call: what a user waits for, import included
    seconds = one["warm_seconds"] if name == "warm" else one["import_seconds"] + one["first_call_seconds"]
    return {
        "name": f"first_diagram: {name}",
        "engine": "continuation",
        "parameters": one_chamber.PARAMETERS,
        "error": max(one["fold_error"], one["breakdown_error"]),
        "seconds_per_diagram": seconds,
        "limit_seconds": LIMITS.get(name),
        "calibration_seconds": calibration,
        **one,
        "compile_seconds": 0.0 if name == "warm" else one["compile_seconds"],
        "machine": harness.machine(),
    }


def print_table(runs: dict, calibration: float) -> None:
    """The stages of every process, on standard error."""
    harness.say(f"{'':14}" + "".join(f"{head:>9}" for head in COLUMNS) + f"{'limit':>7}{'error':>10}")
    for name, one in runs.items():
        values = one | one["stages_summed_over_threads"]
        cells = "".join(f"{values[key]:9.2f}" for key in COLUMNS.values())
        error = max(one["fold_error"], one["breakdown_error"])
        harness.say(f"{name:14}{cells}{LIMITS.get(name, float('nan')):7.1f}{error:10.1e}")
    harness.say("seconds; the limit is that of jax, package and first together; trace to load are sums over threads,")
    harness.say(
        f"most of which belong to the first diagram; again: limit {LIMITS['warm']} s; calibration loop {calibration:.3f} s"
    )


def main() -> int:
    parser = harness.arguments(__doc__, "one warm diagram instead of five, and none with the cache switched off")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--emitters", choices=("all", "none"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        child(options.child, options.emitters)
        return 0
    repeats = 1 if options.quick else 5
    calibration = harness.calibrate()
    with tempfile.TemporaryDirectory() as folder:
        caches = {"empty cache": folder, "filled cache": folder}
        caches = caches if options.quick else {"no cache": "off", **caches}
        runs = {name: run(cache, repeats) for name, cache in caches.items()}
        if not options.quick:
            runs |= {f"emitters: {which}": run("off", repeats, which) for which in ("all", "none")}
    records = [record(name, one, calibration) for name, one in (runs | {"warm": runs["filled cache"]}).items()]
    print_table(runs, calibration)
    good = all(r["error"] < 1e-9 and r["seconds_per_diagram"] <= (r["limit_seconds"] or float("inf")) for r in records)
    return harness.finish({"name": "first_diagram", "records": records}, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
