"""Is a surface as exact as it says? Fresh random states of its whole domain against the true pressure and volume.

Half of the states are spread evenly over the stretch of the apex, half crowd towards the flat membrane; t is even over the
domain. The truth is the integration in extended precision of `truth.py`, which shares no code with the package; states where it
is itself uncertain by more than a tenth of the bound are counted apart. With --family the surfaces come from a
`SurfaceFamily` over the prestretches instead of shots.

    python -m benchmarks.acceptance.surface_error [--states 100000] [--seed 0] [--family] [--json FILE|-] [--quick]
"""

import sys

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.truth.extended_precision import exact
from dielectric_jax.model.materials import largest_load

jax.config.update("jax_enable_x64", True)

ALLOWED = 10.0  # times the bound
LIMITS = (50.0, 270.0, 1000.0)
_PART = 2000


def surfaces(quick: bool, family: bool, random):
    """The surfaces, with the limit of their material and the seconds of building each."""
    for limit in LIMITS[1:2] if quick else LIMITS:
        rims = [1.0] if quick else [1.0, *random.uniform(1, 3, 3)]
        material = dj.Gent(limit)
        if family:
            span = (1.0, 1.2) if quick else (1.0, 3.0)
            whole = dj.surface.SurfaceFamily.build(
                material, prestretch=span, cache=False, tolerance=1e-7 if quick else 1e-9
            )
        for rim in rims:
            watch = harness.Stopwatch()
            with watch:
                if family:
                    surface = whole.surface(rim)
                else:
                    surface = dj.Surface.build(dj.Membrane(material, prestretch=rim), cache=False)
            yield limit, surface, watch.seconds


def draw(surface, count: int, random):
    """Random (λa, t) of the domain."""
    rim, end = float(surface.membrane.prestretch), float(surface.apex_edges[-1])
    found = np.zeros((2, 0))
    while found.shape[1] < count:
        share = random.uniform(size=count)
        share = np.where(random.uniform(size=count) < 0.5, share, 10 ** random.uniform(-6, 0, count))
        apex = rim + (end - rim) * share
        t = random.uniform(float(surface.load_edges[0]), float(surface.load_edges[-1]), count)
        inside = np.asarray(surface.locate(apex, t)) >= 0
        found = np.concatenate([found, np.stack([apex, t])[:, inside]], axis=1)
    return found[:, :count]


def judge(limit: float, surface, count: int, random) -> dict:
    """The errors of one surface over its bounds."""
    apex, t = draw(surface, count, random)
    q = t * np.asarray(largest_load(surface.membrane.material, apex))
    p, v = (np.asarray(w) for w in surface.at_load_fraction(apex, t, ("pressure", "volume")))
    bound = np.asarray(surface.error_bound(apex, q))
    rim = float(surface.membrane.prestretch)
    parts = [exact(*(w[i : i + _PART] for w in (apex, p, q)), limit, rim, steps=280) for i in range(0, count, _PART)]
    true_p, true_v, uncertain = (np.concatenate([np.asarray(x[k], float) for x in parts]) for k in range(3))
    error = np.maximum(*(np.abs(a - b) / np.maximum(np.abs(b), 1e-3) for a, b in ((p, true_p), (v, true_v))))
    sharp = uncertain < 0.1 * bound  # never where the truth is NaN
    # λa is a double: the state of its neighbour is as good
    rounding = 2.3e-16 * apex / (apex - rim)
    ratio = np.where(sharp, np.maximum(error - rounding, 0.0) / bound, np.nan)
    worst = int(np.nanargmax(ratio))
    return {
        "stretch_limit": limit,
        "prestretch": rim,
        "elements": len(surface.errors),
        "states": count,
        "not_sharp": int((~sharp).sum()),
        "largest_error": float(np.max(error[sharp])),
        "largest_bound": float(np.max(bound)),
        "largest_ratio": float(ratio[worst]),
        "above_bound": int(np.sum(ratio > 1)),
        "worst": {"apex_stretch": float(apex[worst]), "load_fraction": float(t[worst]), "error": float(error[worst])},
    }


def main() -> int:
    parser = harness.arguments(__doc__, "200 states of one membrane", seed=True)
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--family", action="store_true", help="surfaces from a family of prestretches")
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    count = 200 if options.quick else -(-options.states // (4 * len(LIMITS)))
    groups = []
    for limit, surface, seconds in surfaces(options.quick, options.family, random):
        groups.append(judge(limit, surface, count, random) | {"build_seconds": seconds})
        harness.say(groups[-1])
    document = {
        "name": "surface_error",
        "parameters": {"states": options.states, "seed": options.seed, "family": options.family},
        "states": sum(g["states"] for g in groups),
        "not_sharp": sum(g["not_sharp"] for g in groups),
        "largest_ratio": max(g["largest_ratio"] for g in groups),
        "allowed_ratio": ALLOWED,
        "above_bound": sum(g["above_bound"] for g in groups),
        "largest_error": max(g["largest_error"] for g in groups),
        "groups": groups,
        "machine": harness.machine(),
    }
    harness.say({k: v for k, v in document.items() if k not in ("groups", "machine")})
    return harness.finish(document, options.json, document["largest_ratio"] <= ALLOWED)


if __name__ == "__main__":
    sys.exit(main())
