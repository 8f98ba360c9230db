"""Is the optimiser's design ever worse than a brute-force scan, in eleven different problems, and how long does it take?

Each scan is an even grid of at least 10⁵ designs on the surface, each with its whole ramp; the optimiser sees none of it. A
design is good when its area strain is at least that of the best of the scan, less 1e-9. Times are those of a second run: the
first compiles.
"""

import sys

import jax

import dielectric_jax as dj
from benchmarks import harness

jax.config.update("jax_enable_x64", True)

CHAMBER = {"chamber_volume": (500.0, 25000.0)}
FILLED = CHAMBER | {"initial_volume": (2.0, 2.9)}
ALL = {"chamber_volume": (500.0, 25000.0), "initial_volume": (1.5, 2.9), "prestretch": (1.0, 1.5)}
SCAN, QUICK = 100_000, 1000


def problems() -> dict:
    """Name: scene, ranges, wishes."""

    def scene(filling=2.42, limit=270.0):
        return dj.Scene(dj.Membrane(dj.Gent(limit)), dj.Chamber(volume=1600.0, initial_volume=filling))

    return {
        "chamber": (scene(), CHAMBER, {}),
        "chamber, less filling": (scene(2.3), CHAMBER, {}),
        "chamber, margin 0.2": (scene(), CHAMBER, {"survival_margin": 0.2}),
        "chamber and filling": (scene(), FILLED, {"survival_margin": 0.1}),
        "stays": (scene(), FILLED, {"way_down": "stays", "survival_margin": 0.2}),
        "returns": (scene(), FILLED, {"way_down": "returns"}),
        "operating margin": (scene(), FILLED, {"operating_margin": 0.1}),
        "all three, margin 0.2": (scene(), ALL, {"survival_margin": 0.2}),
        "limit 1000": (scene(limit=1000.0), FILLED, {"survival_margin": 0.1}),
        "limit 100": (scene(limit=100.0), FILLED, {"survival_margin": 0.1}),
        "robust over the filling": (scene(), CHAMBER, {"uncertain": {"initial_volume": 0.02}}),
    }


def solve(scene, over, wishes, compare: int, rounds: int) -> dict:
    """One problem: the design, the scan, the seconds."""
    surface = None
    if "prestretch" in over:
        surface = dj.surface.SurfaceFamily.build(scene.membrane.material, prestretch=(1.0, 3.0))

    def optimise(**more):
        return dj.maximise_area_strain(scene, over, surface=surface, check=False, **wishes, **more)

    timing = harness.timed(optimise, rounds)
    found = optimise(compare=compare)
    assert timing.value is not None and found.scan is not None
    return {
        "parameters": found.parameters,
        "area_strain": found.area_strain,
        "active": list(found.active),
        "regime": found.regime.name,
        "scan": found.scan,
        "good": bool(found.scan["gain"] >= -1e-9),
        "seconds": timing.best,
        "processor_seconds": timing.best_cpu,
    }


def main() -> int:
    """Runs the problems and writes the record after each."""
    parser = harness.arguments(__doc__, "two problems, small scans")
    parser.add_argument("--only", nargs="+", metavar="PROBLEM")
    args = parser.parse_args()
    every = problems()
    chosen = args.only or (["chamber, less filling", "chamber, margin 0.2"] if args.quick else list(every))
    record: dict = {"name": "design_problems", "machine": harness.machine(), "problems": {}}
    for name in chosen:
        scene, over, wishes = every[name]
        found = solve(scene, over, wishes, QUICK if args.quick else SCAN, 0 if args.quick else 2)
        record["problems"][name] = found
        harness.say(
            f"{name}: {found['area_strain']:.9g} ({', '.join(found['active'])}; {found['regime']}), best of "
            f"{found['scan']['designs']} {found['scan']['area_strain']:.9g}, {found['seconds']:.2f} s "
            f"({found['processor_seconds']:.2f} s of a processor)"
        )
        record["good"] = all(p["good"] for p in record["problems"].values())
        harness.write(record, args.json, partial=True)
    return harness.finish(record, args.json, record["good"])


if __name__ == "__main__":
    sys.exit(main())
