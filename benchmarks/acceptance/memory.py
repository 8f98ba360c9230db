"""Does a process that draws many scenes stay small? Random scenes of all materials, one after another, in one process.

Every scene has a membrane of its own: Gent (J from 5 to 1000), neo-Hookean, Mooney–Rivlin, Ogden of one to three terms,
eight-chain, electrostrictive films of these. Each is asked for its curve and its diagram; every few scenes also in other ways:
batches by continuation, a surface with a glance and ramps on it, sweeps with both engines, critical points and their
derivatives, cusps, regimes, fold curves, designs, fits. After every block a line tells the process's memory, its memory maps
(Linux allows 65 530), the programs that are alive, and what was compiled anew.

    python -m benchmarks.acceptance.memory [--scenes 1000] [--block 25] [--seed 0] [--ways NAME …] [--json FILE|-] [--quick]
"""

import argparse
import collections
import gc
import math
import pathlib
import sys
import time
import warnings

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks.harness import machine, write
from dielectric_jax import SceneError

jax.config.update("jax_enable_x64", True)

MOST_GIGABYTES, MOST_MAPS = 1.5, 20_000
COMPILED = "/jax/core/compile/backend_compile_duration"
compiled: collections.Counter = collections.Counter()


def _listen(event, seconds, fun_name="?", **_):
    if event == COMPILED:
        compiled[fun_name] += 1


jax.monitoring.register_event_duration_secs_listener(_listen)


def gigabytes() -> float:
    """The memory that the process holds now."""
    for line in pathlib.Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 2**20
    return math.nan


def maps() -> int:
    return pathlib.Path("/proc/self/maps").read_bytes().count(b"\n")


def programs() -> int:
    """Compiled programs that are alive."""
    return len(jax.devices()[0].client.live_executables())


def uniform(random, low, high) -> float:
    return float(random.uniform(low, high))


def log_uniform(random, low, high) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def ogden(terms: int):
    """Terms of both signs, scaled to a small-strain modulus of one."""

    def draw(random):
        exponents = np.array([uniform(random, 1.2, 2.4), -uniform(random, 1.2, 2.4), uniform(random, 3.0, 5.0)])[:terms]
        shares = np.array([1.0, *random.uniform(0.01, 0.1, 2)])[:terms]
        return dj.Ogden(moduli=tuple(2 * shares / shares.sum() / exponents), exponents=tuple(exponents))

    return draw


def electrostrictive(random):
    elastic = (gent, neo_hookean, mooney_rivlin)[int(random.integers(3))](random)
    return dj.Electrostrictive(elastic, uniform(random, 0, 0.2), uniform(random, -0.01, 0.01))


def gent(random):
    return dj.Gent(stretch_limit=log_uniform(random, 5, 1000))


def neo_hookean(random):
    return dj.NeoHookean()


def mooney_rivlin(random):
    second = log_uniform(random, 1e-4, 0.3)
    return dj.MooneyRivlin(c1=0.5 - second / 2, c2=second / 2)


def eight_chain(random):
    return dj.ArrudaBoyce(chain_links=log_uniform(random, 5, 500))


MATERIALS = (gent, neo_hookean, mooney_rivlin, ogden(1), ogden(2), ogden(3), eight_chain, electrostrictive)


def draw_scene(random, material=None) -> dj.Scene:
    """A chamber in three of four scenes, filled to a volume or a pressure, else a constant pressure."""
    material = MATERIALS[int(random.integers(len(MATERIALS)))] if material is None else material
    stretch = 1.0 if random.random() < 0.2 else uniform(random, 1.0, 2.5)
    law = dj.VHBBreakdown(scale=uniform(random, 0.5, 1.5)) if random.random() < 0.7 else dj.ConstantBreakdown(1.0)
    elastomer = material(random)
    largest = float(np.ravel(dj.Membrane(elastomer).lock_up_stretch())[0])
    film = dj.Membrane(elastomer, min(stretch, 0.9 * largest), law)
    pressure = uniform(random, 0.2, 1.5)
    air = {
        "volume": log_uniform(random, 1, 25000),
        "atmospheric_pressure": uniform(random, 0, 200),
        "polytropic_exponent": 1.0 if random.random() < 0.7 else 1.4,
    }
    kind = random.random()
    if kind < 0.25:
        return dj.Scene(film, dj.ConstantPressure(pressure))
    if kind < 0.5:
        return dj.Scene(film, dj.Chamber(initial_pressure=pressure, **air))
    return dj.Scene(film, dj.Chamber(initial_volume=uniform(random, 0.2, 4), **air))


def batch(scene, random):
    """Other scenes beside it, some with its membrane, of any number."""
    others = [draw_scene(random) for _ in range(int(random.integers(1, 12)))]
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
    dj.stability_of(scene.membrane, state)
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--block", type=int, default=25, help="scenes between two lines")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), help="only these")
    parser.add_argument("--json", metavar="FILE", help='"-" is standard output')
    parser.add_argument("--quick", action="store_true", help="4 scenes of Gent films, curves and diagrams only")
    options = parser.parse_args()
    scenes, block = (4, 2) if options.quick else (options.scenes, options.block)
    ways = {w: WAYS[w] for w in ("curve", "diagram")} if options.quick else WAYS
    if options.ways:
        ways = {w: WAYS[w] for w in options.ways}
    dj.enable_compilation_cache()
    random = np.random.default_rng(options.seed)
    print(f"seed {options.seed}, {scenes} scenes", file=sys.stderr)
    blocks, refused = [], collections.Counter()
    for done in range(0, scenes, block):
        before, seconds = compiled.copy(), dict.fromkeys(ways, 0.0)
        for i in range(done, min(done + block, scenes)):
            scene = draw_scene(random, gent if options.quick else None)
            for name, (every, way) in ways.items():
                if i % every == 0:
                    begin = time.perf_counter()
                    ask(way, scene, random, refused)
                    seconds[name] += time.perf_counter() - begin
        gc.collect()
        count = min(block, scenes - done)
        new = compiled - before
        told = {
            "scenes": done + count,
            "gigabytes": gigabytes(),
            "maps": maps(),
            "programs": programs(),
            "seconds_per_scene": sum(seconds.values()) / count,
            "seconds": seconds,
            "compiled": new.total(),
            "most_compiled": dict(new.most_common(12)),
        }
        blocks.append(told)
        print(
            "{scenes:5d} scenes {gigabytes:5.2f} GB {maps:6d} maps {programs:5d} programs {seconds_per_scene:6.2f} s a scene,"
            " {compiled:4d} compiled: ".format(**told)
            + ", ".join(f"{n} {k}" for k, n in told["most_compiled"].items()),
            file=sys.stderr,
            flush=True,
        )
    last = blocks[-1]
    good = last["gigabytes"] < MOST_GIGABYTES and last["maps"] < MOST_MAPS
    record = {
        "name": "memory",
        "parameters": {"scenes": scenes, "seed": options.seed, "ways": list(ways)},
        "blocks": blocks,
        "compiled": dict(compiled.most_common()),
        "refused": dict(refused),
        "machine": machine(),
    }
    write(record, options.json)
    print("PASSED" if good else "FAILED", file=sys.stderr)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
