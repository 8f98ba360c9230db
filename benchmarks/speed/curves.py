"""Work and precision of one pressure–volume diagram: at Φ = 0.05 through both folds to V = 450.

Our diagrams hold every branch of the window, with a scan for missed ones (not on a surface), special points, stability and
error estimates; a glance the one branch that the surface's rows hold, beyond V = 450, with its folds and breakdown;
AUTO-07p and SciPy one branch from V = 2.42 with its folds. The error is the larger of those of the two fold
pressures against `data/pressure_volume.csv`.
"""

import csv
import functools
import itertools
import tempfile

import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.truth import auto_peer, chambers, scipy_peers

VOLTAGE, VOLUME = 0.05, 450.0


def reference() -> list[float]:
    """The pressures of peak and valley."""
    with (chambers.DATA / "pressure_volume.csv").open() as file:
        return [float(r["pressure"]) for r in csv.DictReader(file) if r["kind"] == f"fold at voltage {VOLTAGE:g}"]


def error_of(folds: list[float]) -> float:
    """The largest error of the pressures; infinite where there are not two."""
    true = reference()
    return max(abs(a - b) for a, b in zip(folds, true, strict=True)) if len(folds) == len(true) else float("inf")


def timed(engine: str, parameters: dict, run, rounds: int) -> dict:
    """The record of `run`, which returns pressures of folds, its own seconds or None, and counts."""
    timing = harness.timed(run, rounds, reported=lambda found: found[1])
    folds, _, counts = timing.value
    return {
        "name": "pressure_volume",
        "engine": engine,
        "parameters": parameters,
        "error": error_of(folds),
        "seconds": timing.best,
        "compile_seconds": timing.compile_seconds,
        "counts": counts | {"folds": len(folds)},
    }


def ours(engine: str, parameters: dict, rounds: int, make) -> dict:
    def run():
        found = make()
        folds = sorted((p for p in found.special_points if p.kind == "fold"), key=lambda p: p.volume)
        counts = {"points": sum(map(len, found.branches)), "branches": len(found.branches)}
        return [p.pressure for p in folds if p.volume < VOLUME], None, counts

    return timed(engine, parameters, run, rounds)


def records(quick: bool) -> list[dict]:
    rounds = 1 if quick else 5
    membrane = dj.Membrane(material=dj.Gent(chambers.STRETCH_LIMIT))
    scene = dj.Scene(membrane, dj.ConstantVoltage(VOLTAGE))

    def diagram(**options):
        return functools.partial(dj.pressure_volume, membrane, VOLTAGE, **options)

    out = [
        ours("dielectric_jax, continuation", {"tolerance": tolerance}, rounds, diagram(tolerance=tolerance))
        for tolerance in ((1e-9,) if quick else (1e-4, 1e-6, 1e-8, 1e-10, 1e-12))
    ]
    for tolerance in (1e-9,) if quick else (1e-5, 1e-7, 1e-9):
        surface = dj.Surface.build(membrane, tolerance=tolerance)
        for certify in () if quick else (True, False):
            engine = f"dielectric_jax, surface {'certified' if certify else 'alone'}"
            options = {"surface": surface, "certify": certify, "extend": certify, "tolerance": max(tolerance, 1e-9)}
            out.append(ours(engine, {"tolerance": tolerance}, rounds, diagram(**options)))
        look = functools.partial(dj.glance, scene, surface)
        out.append(ours("dielectric_jax, glance at a surface", {"tolerance": tolerance}, 4 * rounds, look))
    out += auto_records(rounds, quick) + scipy_records(quick)
    return out


def auto_records(rounds: int, quick: bool) -> list[dict]:
    out = []
    with tempfile.TemporaryDirectory() as folder:
        if said := auto_peer.prepare(folder):
            harness.say(said)
            return out
        sizes = ((10, 4),) if quick else ((4, 4), (4, 5), (5, 5), (8, 5), (10, 6), (20, 4), (40, 4))
        for (intervals, collocation), tolerance in itertools.product(sizes, (1e-6,) if quick else (1e-5, 1e-6, 1e-8)):
            parameters = {"NTST": intervals, "NCOL": collocation, "EPS": tolerance, "DS": 0.1, "DSMAX": 1.0}
            constants = ", ".join(f"{k}={v}" for k, v in parameters.items() if k != "EPS")
            constants += f", EPSL={tolerance}, EPSU={tolerance}, PAR={{1: {VOLTAGE**2}}}"

            def run(constants=constants):
                done = auto_peer.run(folder, "pressure", constants)
                folds = [row[0] for row in done.of_type(auto_peer.FOLD)]
                return folds, done.seconds, {"points": len(done.points)}

            out.append(timed("AUTO-07p", parameters | {"threads": auto_peer.threads()}, run, rounds))
    return out


def scipy_records(quick: bool) -> list[dict]:
    out = []
    shooting = (scipy_peers.Shooting, "SciPy DOP853 shooting", (1e-6,) if quick else (1e-6, 1e-8, 1e-10, 1e-12))
    collocation = (scipy_peers.Collocation, "SciPy solve_bvp", (1e-4,) if quick else (1e-4, 1e-5, 1e-6))
    for solver, engine, tolerances in (shooting, collocation):
        for tolerance in tolerances:

            def run(solver=solver, tolerance=tolerance):
                try:
                    own = solver(scipy_peers.Voltage(VOLTAGE), tolerance)
                    return scipy_peers.pressure_volume(own, True, VOLUME)[0], None, {}
                except (ArithmeticError, np.linalg.LinAlgError):
                    return [], None, {}

            parameters = {"tolerance": tolerance, "stepping": "natural"}
            out.append(timed(engine, parameters, run, 1))
    return out
