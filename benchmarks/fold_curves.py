"""Where folds lie as two parameters change, and what their derivatives look like: figures and known numbers.

    python benchmarks/fold_curves.py [--quick] [--json FILE|-] [--figures DIR]

Draws `fold_curves.png`: folds of the voltage over the chamber's volume, the filling and the prestretch, folds of the pressure over
the prestretch, with cusps; and `derivatives.png`: the snap voltage with its tangents, and states at a given voltage.
"""

import argparse
import pathlib
import sys

import jax
import numpy as np
from records import machine, write

import dielectric_jax as dj
from dielectric_jax.load_lines import pressure_extremes

jax.config.update("jax_enable_x64", True)

FILLING, PRESSURE = 2.42, 1.0
# numbers that other methods agree on, and half of their last digit
KNOWN = {
    "cusp_1": (484.04966, 5e-6),
    "cusp_2": (551.39914, 5e-6),
    "bistability": (1455.896262457, 5e-9),
    "prestretch_of_the_pressure_cusp": (2.110288, 5e-7),
}


def chamber(volume: float, filling: float = FILLING) -> dj.Scene:
    """The paper's membrane on a chamber."""
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=volume, initial_volume=filling))


def known_numbers() -> dict:
    """Cusps and the onset of bistability."""
    scene = chamber(1600.0)
    cusps = [dj.cusp(scene, k, within=(300.0, 5000.0)) for k in (0, 1)]
    onset = dj.bistability_point(scene)
    merged = dj.pressure_cusp(dj.Membrane(), within=(1.8, 2.6))
    points = dict(zip(KNOWN, [*cusps, onset, merged], strict=True))
    return {
        name: {n: float(getattr(p, n)) for n in ("parameter", "voltage", "pressure", "volume", "apex_stretch")}
        for name, p in points.items()
    }


def voltage_folds(surface, volumes, fillings) -> tuple[np.ndarray, np.ndarray]:
    """Fold voltages (scenes, 6) by rising λa, and the first breakdown voltage, of chambers."""
    ramps = dj.chamber_ramps(surface, volumes, fillings)
    return ramps.folds.voltage, ramps.breakdowns.voltage[:, 0]


def pressure_folds(prestretches, voltage: float) -> np.ndarray:
    """Peak and valley of the pressure (prestretches, 2)."""
    rows = [pressure_extremes(dj.Membrane(prestretch=float(w)), voltage**2) for w in prestretches]
    return np.array([[row["peak"][1], row["valley"][1]] for row in rows])


def held_folds(prestretches) -> np.ndarray:
    """Fold voltages (prestretches, 6) at constant pressure."""
    scenes = [dj.Scene(dj.Membrane(prestretch=float(w)), dj.ConstantPressure(PRESSURE)) for w in prestretches]
    return dj.continue_scenes(scenes).ramps.folds.voltage


def draw_curves(axes, data: dict, known: dict) -> None:
    """The four panels of fold curves."""
    (one, two), (three, four) = axes
    for ax, name in ((one, "chamber_volume"), (two, "initial_volume")):
        x, folds, broken = (np.asarray(v) for v in data[name])
        ax.plot(x, folds, ".", color="C0", ms=2)
        ax.plot(x, broken, color="C3", lw=1)
        ax.plot([], [], ".", color="C0", label="folds")
        ax.plot([], [], color="C3", lw=1, label="electric breakdown")
        ax.set_ylabel(r"voltage $\Phi$")
    for name in ("cusp_1", "cusp_2"):
        one.plot(known[name]["parameter"], known[name]["voltage"], "k^", ms=5)
    one.plot([], [], "k^", ms=5, label="cusps")
    one.plot(known["bistability"]["parameter"], 0.0, "ko", ms=5, label="onset of bistability", clip_on=False)
    one.set_xscale("log")
    one.set_xlabel(r"chamber volume $V_C$ at $V_0 = 2.42$")
    two.set_xlabel(r"filling $V_0$ at $V_C = 1600$")
    for k, (voltage, (x, folds)) in enumerate(data["pressure"].items()):
        folds = np.asarray(folds)
        three.plot(x, folds[:, 0], color=f"C{k}", label=rf"peak and valley at $\Phi = {voltage}$")
        three.plot(x, folds[:, 1], color=f"C{k}", ls="--")
    cusp = known["prestretch_of_the_pressure_cusp"]
    three.plot(cusp["parameter"], cusp["pressure"], "k^", ms=5, label=r"cusp at $\Phi = 0$")
    three.set_xlabel(r"prestretch $\lambda_0$")
    three.set_ylabel(r"pressure $p$")
    x, folds = (np.asarray(v) for v in data["prestretch"])
    four.plot(x, folds, ".", color="C0", ms=3)
    four.set_xlabel(rf"prestretch $\lambda_0$ at $p = {PRESSURE:g}$")
    four.set_ylabel(r"voltage $\Phi$")
    for ax in (one, two, three):
        ax.legend(fontsize=7)
    for ax in (one, two, four):
        ax.set_ylim(bottom=0)


def draw_derivatives(axes, surface) -> dict:
    """Left: snap voltage with tangents. Right: apex stretch before and after the snap, and on the branch at a voltage."""
    left, right = axes
    volumes = np.geomspace(551.5, 4000.0, 300)
    ramps = dj.chamber_ramps(surface, volumes, FILLING)
    left.plot(volumes, ramps.snap.voltage[:, 0], color="C0", label=r"snap voltage $\Phi_s(V_C)$")
    at = np.array([620.0, 900.0, 1600.0, 3000.0])
    value, slope = jax.vmap(
        jax.value_and_grad(lambda v: dj.snap_voltage(chamber(1600.0).replace(chamber_volume=v), surface=surface))
    )(at)
    for x, y, rate in zip(at, np.asarray(value), np.asarray(slope), strict=True):
        reach = np.array([-0.18, 0.18]) * x
        left.plot(x + reach, y + rate * reach, color="k", lw=1)
    left.plot([], [], color="k", lw=1, label="tangents by jax.grad")
    left.set_xlabel(r"chamber volume $V_C$")
    left.set_ylabel(r"voltage $\Phi$")
    load = float(value[2]) ** 2
    near = 1600.0 - np.geomspace(1e-3, 900.0, 200)[::-1]
    held = []
    for v in near:  # the stable state at the voltage at which V_C = 1600 snaps
        curve = dj.chamber_curves(surface, float(v), FILLING)
        q, apex = curve.voltage_squared, curve.apex_stretch
        start = int(np.argmax(q > 0))
        i = start + int(np.argmax(q[start:] > load))
        share = (load - q[i - 1]) / (q[i] - q[i - 1])
        held.append(apex[i - 1] + share * (apex[i] - apex[i - 1]))
    fold = float(ramps.snap.apex_stretch[np.argmin(np.abs(volumes - 1600.0)), 0])
    right.plot(near, held, color="C0", label=rf"stable state at $\Phi = {np.sqrt(load):.4f}$")
    right.plot(volumes, ramps.snap.apex_stretch[:, 0], color="C1", label="fold")
    right.plot(volumes, ramps.landing.apex_stretch[:, 0], color="C2", label="landing")
    right.plot(1600.0, fold, "ko", ms=4)
    right.set_xlabel(r"chamber volume $V_C$")
    right.set_ylabel(r"apex stretch $\lambda_a$")
    for ax in axes:
        ax.legend(fontsize=8)
    return {"chamber_volume": at, "snap_voltage": np.asarray(value), "slope": np.asarray(slope)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    parser.add_argument("--figures", type=pathlib.Path)
    options = parser.parse_args()
    dj.enable_compilation_cache()
    many, some = (24, 3) if options.quick else (1200, 41)
    surface = dj.Surface.build(dj.Membrane())
    known = known_numbers()
    volumes, fillings = np.geomspace(300.0, 25000.0, many), np.linspace(0.3, 2.95, many)
    prestretches = np.linspace(1.0, 2.2, some)
    data = {
        "chamber_volume": (volumes, *voltage_folds(surface, volumes, FILLING)),
        "initial_volume": (fillings, *voltage_folds(surface, 1600.0, fillings)),
        "pressure": {f"{v:g}": (prestretches, pressure_folds(prestretches, v)) for v in (0.0, 0.1)},
        "prestretch": (np.linspace(1.0, 3.0, some), held_folds(np.linspace(1.0, 3.0, some))),
    }
    errors = {name: abs(known[name]["parameter"] - value) / digit for name, (value, digit) in KNOWN.items()}
    record = {
        "machine": machine(),
        "quick": options.quick,
        "known": known,
        "errors_in_last_digits": errors,
        "curves": data,
    }
    if options.figures:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        options.figures.mkdir(parents=True, exist_ok=True)
        figure, axes = plt.subplots(2, 2, figsize=(9, 7), constrained_layout=True)
        draw_curves(axes, data, known)
        figure.savefig(options.figures / "fold_curves.png", dpi=110)
        figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
        record["tangents"] = draw_derivatives(axes, surface)
        figure.savefig(options.figures / "derivatives.png", dpi=110)
    write(record, options.json)
    for name, error in errors.items():
        print(
            f"{name:34} {known[name]['parameter']:.9f}  differs by {error:.2f} of half the last known digit",
            file=sys.stderr,
        )
    return 0 if max(errors.values()) <= 1 else 1


if __name__ == "__main__":
    sys.exit(main())
