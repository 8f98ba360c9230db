"""Where folds and breakdown lie as two parameters change, and what their derivatives look like: figures and known numbers.

    python -m benchmarks.acceptance.fold_curves [--quick] [--json FILE|-] [--figures DIR]

Draws `fold_curves.png`: folds and breakdown over the chamber's volume, the filling and the prestretch, with cusps; and
`derivatives.png`: the snap voltage with its tangents, and states at a given voltage. Known numbers are found twice, by the search
for one point and on the curve; folds along the first curve are compared with those of chambers on the surface.
"""

import pathlib
import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness

jax.config.update("jax_enable_x64", True)

FILLING, PRESSURE = 2.42, 1.0
# numbers that other methods agree on, and half of their last digit; that of bistability is where the line of the air touches
# the curve of the membrane, by Chebyshev interpolation of `truth.states` at q = 0: 1455.8962624543
KNOWN = {
    "cusp_1": (484.04966, 5e-6),
    "cusp_2": (551.39914, 5e-6),
    "bistability": (1455.896262454, 5e-9),
    "prestretch_of_the_pressure_cusp": (2.110288, 5e-7),
}


def chamber(volume: float, filling: float = FILLING) -> dj.Scene:
    """The paper's membrane on a chamber."""
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=volume, initial_volume=filling))


def known_numbers(quick: bool) -> dict:
    """Cusps and the onset of bistability, by the search for each."""
    scene = chamber(1600.0)
    if quick:
        return {"bistability": dj.critical.bistability_point(scene)}
    cusps = [dj.critical.cusp(scene, k, within=(300.0, 5000.0)) for k in (0, 1)]
    onset = dj.critical.bistability_point(scene)
    merged = dj.critical.pressure_cusp(dj.Membrane(), within=(1.8, 2.6))
    return dict(zip(KNOWN, [*cusps, onset, merged], strict=True))


def curves(quick: bool) -> dict:
    """The curves of the figure's four panels."""
    if quick:
        return {
            "chamber_volume": dj.fold_curves(chamber(1600.0), "chamber_volume", (450.0, 1500.0), samples=2),
            "prestretch": dj.fold_curves(
                dj.Scene(dj.Membrane(), dj.ConstantVoltage(0.0)), "prestretch", (2.0, 2.2), samples=2
            ),
        }
    held = dj.Scene(dj.Membrane(), dj.ConstantPressure(PRESSURE))
    return {
        "chamber_volume": dj.fold_curves(chamber(1600.0), "chamber_volume", (250.0, 25000.0)),
        "initial_volume": dj.fold_curves(chamber(1600.0), "initial_volume", (0.5, 2.95)),
        "prestretch": dj.fold_curves(dj.Scene(dj.Membrane(), dj.ConstantVoltage(0.0)), "prestretch", (1.0, 2.3)),
        "prestretch_held": dj.fold_curves(held, "prestretch", (1.0, 3.0)),
    }


def on_curves(found: dict) -> dict:
    """The known numbers as the curves give them."""
    over = found["chamber_volume"]
    cusps = [p.parameter for p in over.named("cusp") if p.breakdown_ratio < 1]
    numbers = *cusps, over.named("zero_voltage")[0].parameter, found["prestretch"].named("cusp")[0].parameter
    return dict(zip(KNOWN, numbers, strict=True))


def apart_from_surface(surface, over) -> tuple[float, int]:
    """The largest relative difference of Φ between curves and chambers on the surface, and how many points have it."""
    worst, compared = 0.0, 0
    for curve in over.curves:
        ramps = dj.diagram.chamber_ramps(surface, curve.parameter, FILLING)
        points = ramps.folds if curve.kind == "fold" else ramps.breakdowns
        inside = (curve.breakdown_ratio < 1.1) & (curve.voltage > 0.02)
        for k in np.flatnonzero(inside):
            places, loads = (np.atleast_1d(v[k]) for v in (points.apex_stretch, points.voltage))
            if not np.isfinite(places).any():
                continue  # two folds that merge here: the surface finds none
            near = int(np.nanargmin(np.abs(places - curve.apex_stretch[k])))
            if abs(places[near] - curve.apex_stretch[k]) < 1e-3:
                worst, compared = max(worst, abs(loads[near] / curve.voltage[k] - 1)), compared + 1
    return worst, compared


def draw_derivatives(axes, surface) -> dict:
    """Left: snap voltage with tangents. Right: apex stretch before and after the snap, and on the branch at a voltage."""
    left, right = axes
    volumes = np.geomspace(551.5, 4000.0, 300)
    ramps = dj.diagram.chamber_ramps(surface, volumes, FILLING)
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
        curve = dj.diagram.chamber_curves(surface, float(v), FILLING)
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
    parser = harness.arguments(__doc__, "few samples of two curves")
    parser.add_argument("--figures", type=pathlib.Path)
    options = parser.parse_args()
    surface = dj.Surface.build(dj.Membrane())
    known = {name: float(p.parameter) for name, p in known_numbers(options.quick).items()}
    found = curves(options.quick)
    on_curve = on_curves(found)
    twice = max(abs(on_curve[name] / value - 1) for name, value in known.items())
    apart, compared = apart_from_surface(surface, found["chamber_volume"])
    errors = {name: abs(on_curve[name] - value) / digit for name, (value, digit) in KNOWN.items()}
    record = {
        "name": "fold_curves",
        "machine": harness.machine(),
        "quick": options.quick,
        "by_search": known,
        "on_curves": on_curve,
        "errors_in_last_digits": errors,
        "difference_between_search_and_curve": twice,
        "difference_from_surface": apart,
        "compared_with_surface": compared,
        "curves": {name: one.to_dict() for name, one in found.items()},
    }
    if options.figures:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        options.figures.mkdir(parents=True, exist_ok=True)
        figure, axes = plt.subplots(2, 2, figsize=(10, 7.5), constrained_layout=True)
        for one, ax in zip(found.values(), axes.flat, strict=False):
            one.plot(ax=ax)
            if one.control == "pressure":
                ax.set_title("at zero voltage", fontsize=9)
        axes.flat[-1].set_title(f"at p = {PRESSURE:g}", fontsize=9)
        figure.savefig(options.figures / "fold_curves.png", dpi=110)
        figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
        record["tangents"] = draw_derivatives(axes, surface)
        figure.savefig(options.figures / "derivatives.png", dpi=110)
    for name, error in errors.items():
        harness.say(f"{name:34} {on_curve[name]:.9f}  differs by {error:.2f} of half the last known digit")
    harness.say(f"search and curve differ by {twice:.1e}, curve and surface by {apart:.1e} at {compared} points")
    for name, one in found.items():
        harness.say(f"{name}: {len(one.curves)} curves, {len(one.points)} points {' '.join(one.doubts)}")
    complete = all(one.complete for one in found.values())
    good = max(errors.values()) <= 1 and complete and max(twice, apart) < 1e-9
    return harness.finish(record, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
