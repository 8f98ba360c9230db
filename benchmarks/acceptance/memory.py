"""Does a process that draws many scenes stay small? Random scenes of all materials, one after another, in one process.

Every scene has a membrane of its own: Gent (J from 5 to 1000), neo-Hookean, Mooney–Rivlin, Ogden of one to three terms,
eight-chain, electrostrictive films of these. Each is asked for its curve and its diagram; every few scenes also in other ways:
batches by continuation, a surface with a glance and ramps on it, sweeps with both engines, critical points and their
derivatives, cusps, regimes, fold curves, designs, fits. After every block a line gives the memory of the process, its memory maps
(Linux allows 65 530), the programs that are alive, and what was compiled anew.

    python -m benchmarks.acceptance.memory [--scenes 1000] [--block 25] [--seed 0] [--ways NAME …] [--json FILE|-] [--quick]
"""

import collections
import gc
import pathlib
import sys
import warnings

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.random_scenes import log_uniform, uniform, wide_scene
from dielectric_jax import SceneError

jax.config.update("jax_enable_x64", True)

MOST_GIGABYTES, MOST_MAPS = 1.5, 20_000


def maps() -> int:
    return pathlib.Path("/proc/self/maps").read_bytes().count(b"\n")


def programs() -> int:
    """Compiled programs that are alive."""
    return len(jax.devices()[0].client.live_executables())


def batch(scene, random):
    """Other scenes beside it, some with its membrane, of any number."""
    others = [wide_scene(random) for _ in range(int(random.integers(1, 12)))]
    loadings = [s.loading for s in others]
    dj.continue_scenes([scene, *others, *(dj.Scene(scene.membrane, loading) for loading in loadings)])


def chambers_of(scene, random) -> dj.Scene:
    if isinstance(scene.loading, dj.Chamber):
        return scene
    return dj.Scene(scene.membrane, dj.Chamber(volume=log_uniform(random, 10, 25000), initial_volume=1.5))


def surface(scene, random):
    surface = dj.Surface.build(scene.membrane, cache=False, tolerance=1e-6)
    dj.glance(scene, surface)
    dj.voltage_volume(scene, surface=surface)
    count = int(random.integers(1, 40))
    dj.diagram.chamber_ramps(surface, np.geomspace(10.0, 25000.0, count), random.uniform(0.5, 3.0, count))
    dj.diagram.pressure_ramps(surface, random.uniform(0.2, 2.0, count))
    dj.diagram.chamber_curves(surface, 1600.0, random.uniform(0.5, 3.0, count))


def sweep(engine):
    def run(scene, random):
        chamber = chambers_of(scene, random)
        volumes = np.geomspace(10.0, 25000.0, int(random.integers(2, 12)))
        options = {"tolerance": 1e-6} if engine == "surface" else {}
        dj.sweep(chamber, chamber_volume=volumes, engine=engine, progress=False, **options)

    return run


def critical(scene, random):
    dj.snap_voltage(scene)
    dj.area_strain(scene)
    dj.critical.breakdown_point(scene)
    dj.critical.landing_point(scene)
    dj.critical.snap_back_voltage(scene)


def derivatives(scene, random):
    name = "chamber_volume" if isinstance(scene.loading, dj.Chamber) else "pressure"
    value = float(scene.loading.volume if name == "chamber_volume" else scene.loading.pressure)
    with np.errstate(all="ignore"):
        jax.value_and_grad(lambda x: dj.snap_voltage(scene.replace(**{name: x})))(value)
        jax.value_and_grad(lambda x: dj.area_strain(scene.replace(**{name: x})))(value)
        jax.grad(lambda x: dj.snap_voltage(scene.replace(prestretch=x)))(float(scene.membrane.prestretch))


def turning(scene, random):
    dj.critical.pressure_peak(scene.membrane, 0.01, throw=False)
    dj.critical.zero_voltage_point(scene, throw=False)
    chamber = chambers_of(scene, random)
    dj.critical.bistability_point(chamber, throw=False)
    dj.critical.pressure_cusp(scene.membrane, throw=False)


def states(scene, random):
    state = dj.equilibrium(scene.membrane, voltage=0.02, pressure=uniform(random, 0.2, 1.0))
    dj.model.stability_of(scene.membrane, state)
    dj.profile(scene.membrane, state)
    dj.equilibrium(scene.membrane, voltage=0.02, volume=1.0, all=True)


def regimes(scene, random):
    chamber = chambers_of(scene, random)
    dj.regime_of(chamber)
    count = int(random.integers(3, 60))
    dj.classify_designs(chamber, {"chamber_volume": random.uniform(50, 5000, count)})


def map_of(scene, random):
    over = {"chamber_volume": (100.0, 25000.0), "initial_volume": (0.5, 2.9)}
    chamber = dj.Scene(scene.membrane, dj.Chamber(volume=100.0, initial_volume=1.0))
    dj.regime_map(chamber, over, points=(12, 12))


def folds(scene, random):
    chamber = chambers_of(scene, random)
    dj.fold_curves(chamber, "chamber_volume", (250.0, 25000.0))


def designs(scene, random):
    chamber = chambers_of(scene, random)
    dj.maximise_area_strain(chamber, over={"chamber_volume": (500.0, 25000.0)}, survival_margin=0.1)


def fit(scene, random):
    curve = dj.pressure_volume(scene.membrane)
    branch = max(curve.branches, key=lambda b: len(b.volume))
    chosen = np.flatnonzero((branch.pressure > 0.05) & (branch.volume < 20))
    chosen = chosen[:: max(1, len(chosen) // int(random.integers(10, 40)))]
    film = dj.Membrane(type(scene.membrane.material)(), float(scene.membrane.prestretch))
    dj.calibrate(branch.volume[chosen], branch.pressure[chosen], membrane=film)


#: each way, and in one of how many scenes
WAYS = {
    "curve": (1, lambda scene, random: dj.pressure_volume(scene.membrane, uniform(random, 0, 0.1))),
    "diagram": (1, lambda scene, random: dj.voltage_volume(scene)),
    "batch": (5, batch),
    "surface": (10, surface),
    "sweep": (20, sweep("continuation")),
    "sweep on the surface": (20, sweep("surface")),
    "critical points": (5, critical),
    "derivatives": (10, derivatives),
    "turning points": (10, turning),
    "states": (5, states),
    "regimes": (10, regimes),
    "map": (50, map_of),
    "folds": (50, folds),
    "designs": (50, designs),
    "fit": (20, fit),
}


def ask(way, scene, random, refused: collections.Counter) -> None:
    """One way, where a scene may have no answer."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            way(scene, random)
    except (SceneError, ValueError) as refusal:
        refused[f"{type(refusal).__name__}: {str(refusal)[:60]}"] += 1


def main() -> int:
    quick = "4 scenes of Gent films, curves and diagrams only"
    parser = harness.arguments(__doc__, quick, seed=True)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--block", type=int, default=25, help="scenes between two lines")
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), help="only these")
    options = parser.parse_args()
    scenes, block = (4, 2) if options.quick else (options.scenes, options.block)
    ways = {w: WAYS[w] for w in ("curve", "diagram")} if options.quick else WAYS
    if options.ways:
        ways = {w: WAYS[w] for w in options.ways}
    random = np.random.default_rng(options.seed)
    harness.say(f"seed {options.seed}, {scenes} scenes")
    compiled = harness.Compilations()
    blocks, refused = [], collections.Counter()
    for done in range(0, scenes, block):
        before, watches = compiled.functions.copy(), {name: harness.Stopwatch() for name in ways}
        for i in range(done, min(done + block, scenes)):
            scene = wide_scene(random, "gent" if options.quick else None)
            for name, (every, way) in ways.items():
                if i % every == 0:
                    watches[name].time(ask, way, scene, random, refused)
        gc.collect()
        count = min(block, scenes - done)
        new = compiled.functions - before
        seconds = {name: watch.seconds for name, watch in watches.items()}
        block_record = {
            "scenes": done + count,
            "gigabytes": harness.gigabytes(),
            "maps": maps(),
            "programs": programs(),
            "seconds_per_scene": sum(seconds.values()) / count,
            "seconds": seconds,
            "compiled": new.total(),
            "most_compiled": dict(new.most_common(12)),
        }
        blocks.append(block_record)
        harness.say(
            "{scenes:5d} scenes {gigabytes:5.2f} GB {maps:6d} maps {programs:5d} programs {seconds_per_scene:6.2f} s a scene,"
            " {compiled:4d} compiled: ".format(**block_record)
            + ", ".join(f"{n} {k}" for k, n in block_record["most_compiled"].items())
        )
    last = blocks[-1]
    good = last["gigabytes"] < MOST_GIGABYTES and last["maps"] < MOST_MAPS
    record = {
        "name": "memory",
        "parameters": {"scenes": scenes, "seed": options.seed, "ways": list(ways)},
        "blocks": blocks,
        "compiled": dict(compiled.functions.most_common()),
        "refused": dict(refused),
        "machine": harness.machine(),
    }
    return harness.finish(record, options.json, good)


if __name__ == "__main__":
    sys.exit(main())
