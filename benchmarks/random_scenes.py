"""Random films, loadings, scenes and states: the one place where the benchmarks draw them.

Each script keeps the distribution that its published numbers belong to; what distributions have in common stands once.
`random` is a NumPy generator, and a seed gives the same scenes again.
"""

import numpy as np

import dielectric_jax as dj
from benchmarks.truth import extended_precision as truth

# numbers


def uniform(random, low, high) -> float:
    return float(random.uniform(low, high))


def log_uniform(random, low, high, count: int | None = None):
    """Numbers whose logarithm is even: a float, or an array of shape (count,)."""
    drawn = np.exp(random.uniform(np.log(low), np.log(high), count))
    return float(drawn) if count is None else drawn


def chamber_volumes(random, count: int | None = None):
    """V_C from 10 to 25 000."""
    return log_uniform(random, 10, 25000, count)


# Gent films of prestretch 1 to 3 and limiting stretch J from 50 to 1000


def gent_parameters(random, count: int | None = None) -> tuple:
    """Prestretch and limiting stretch: floats, or arrays of shape (count,)."""
    return random.uniform(1, 3, count), log_uniform(random, 50, 1000, count)


def gent_films(random, count: int) -> list:
    """Films, the first of which is the default one."""
    drawn = zip(*gent_parameters(random, count - 1), strict=True)
    return [dj.Membrane(), *(dj.Membrane(prestretch=w, material=dj.Gent(stretch_limit=j)) for w, j in drawn)]


def largest_filling(membrane) -> float:
    """The volume at the peak of the pressure at zero voltage, or a tenth of the largest where there is none."""
    curve = dj.pressure_volume(membrane)
    folds = [p.volume for p in curve.special_points if p.kind == "fold"]
    return min(folds) if folds else 0.1 * float(max(b.volume.max() for b in curve.branches))


def filled_chambers(random, membrane, count: int) -> tuple[np.ndarray, np.ndarray]:
    """V_C and V_0 up to the largest filling."""
    return chamber_volumes(random, count), random.uniform(0.01, 1, count) * largest_filling(membrane)


def film_loadings(random, membrane, count: int) -> list:
    """Chambers, and for the last fifth constant pressures."""
    held = count // 5
    pairs = zip(*filled_chambers(random, membrane, count - held), strict=True)
    loadings = [dj.Chamber(volume=float(c), initial_volume=float(v)) for c, v in pairs]
    return [*loadings, *(dj.ConstantPressure(float(p)) for p in random.uniform(0.4, 2.0, held))]


def film_scenes(seed: int, count: int) -> list[dict]:
    """Parameters of scenes, three of five on a chamber; `fill` is the share of the volume at the peak of the pressure."""
    random = np.random.default_rng(seed)
    scenes = []
    for _ in range(count):
        scene = dict(zip(("prestretch", "stretch_limit"), gent_parameters(random), strict=True))
        chamber, fill = chamber_volumes(random), random.uniform(0, 1)
        pressure, closed = random.uniform(0.4, 2.0), random.uniform() < 0.6
        scenes.append(scene | ({"chamber_volume": chamber, "fill": fill} if closed else {"pressure": pressure}))
    return scenes


# states of such films: where the apex is, as a share of the way from the rim to lock-up, and the load fraction t = q/q_max


def _with_strata(even, stratum, strata) -> np.ndarray:
    """The `even` numbers, replaced where `stratum` is one of the members of a pair (members, numbers)."""
    for members, numbers in strata:
        even = np.where(np.isin(stratum, members), numbers, even)
    return even


def _at(rim, limit, share, t) -> dict:
    """λa and q of states."""
    apex = rim + share * (np.array([truth.lock_up(j) for j in limit]) - rim)
    return {"apex_stretch": apex, "q": t * truth.largest_load(apex, limit), "t": t}


def loaded_states(seed: int, count: int, kinds: dict, strata: dict, top: float) -> dict:
    """States (count,) of as many films, each under a kind of loading, some strata of them near the load fraction `top`.

    `kinds` and `strata` give the shares of each kind of loading and of each stratum: even, near `top`, flat, towards
    lock-up, and there near `top`.
    """
    random = np.random.default_rng(seed)
    rim, limit = gent_parameters(random, count)
    stratum = random.choice(len(strata), count, p=list(strata.values()))
    t = random.uniform(-1, top, count)
    t = _with_strata(t, stratum, [((1, 4), top - log_uniform(random, 1e-4, 0.2, count))])
    share = random.uniform(1e-4, 1, count)
    flat, locked = log_uniform(random, 1e-4, 0.1, count), random.uniform(0.93, 1, count)
    share = _with_strata(share, stratum, [((2,), flat), ((3, 4), locked)])
    kind = random.choice(len(kinds), count, p=list(kinds.values()))
    chamber = chamber_volumes(random, count)
    film = {"prestretch": rim, "stretch_limit": limit, "chamber_volume": chamber}
    return film | {"stratum": stratum, "kind": kind} | _at(rim, limit, share, t)


def film_states(seed: int, count: int, each: int, strata: dict) -> dict:
    """States (count,), `each` of every film and chamber; `strata` gives the shares: even, towards the cone, flat, lock-up."""
    random = np.random.default_rng(seed)
    films = -(-count // each)
    drawn = *gent_parameters(random, films), chamber_volumes(random, films)
    rim, limit, chamber = (np.repeat(values, each)[:count] for values in drawn)
    stratum = random.choice(len(strata), count, p=list(strata.values()))
    t = random.uniform(-1, 0.9, count)
    t = _with_strata(t, stratum, [((1,), 1 - log_uniform(random, 1e-2, 0.3, count))])
    share = random.uniform(1e-3, 0.97, count)
    flat, locked = log_uniform(random, 1e-4, 0.1, count), random.uniform(0.9, 0.999, count)
    share = _with_strata(share, stratum, [((2,), flat), ((3,), locked)])
    film = {"prestretch": rim, "stretch_limit": limit, "chamber_volume": chamber}
    return film | {"stratum": stratum} | _at(rim, limit, share, t)


# materials of all kinds, each with a small-strain shear modulus of 1


def _mooney_rivlin(second: float):
    """`second` is the share of the second term."""
    return dj.MooneyRivlin(c1=0.5 - second / 2, c2=second / 2)


def _ogden(shares, exponents):
    """`shares` are those of the modulus ½ Σ μ_k α_k."""
    return dj.Ogden(moduli=tuple(2 * np.asarray(shares) / np.asarray(exponents)), exponents=tuple(exponents))


def _wide_ogden(terms: int):
    """Terms of both signs."""

    def draw(random):
        exponents = np.array([uniform(random, 1.2, 2.4), -uniform(random, 1.2, 2.4), uniform(random, 3.0, 5.0)])[:terms]
        shares = np.array([1.0, *random.uniform(0.01, 0.1, 2)])[:terms]
        return _ogden(shares / shares.sum(), exponents)

    return draw


def _wide_gent(random):
    return dj.Gent(stretch_limit=log_uniform(random, 5, 1000))


def _neo_hookean(_):
    return dj.NeoHookean()


def _wide_mooney_rivlin(random):
    return _mooney_rivlin(log_uniform(random, 1e-4, 0.3))


def _wide_electrostrictive(random):
    elastic = (_wide_gent, _neo_hookean, _wide_mooney_rivlin)[int(random.integers(3))](random)
    return dj.Electrostrictive(elastic, uniform(random, 0, 0.2), uniform(random, -0.01, 0.01))


WIDE_MATERIALS = {
    "gent": _wide_gent,
    "neo-hookean": _neo_hookean,
    "mooney-rivlin": _wide_mooney_rivlin,
    "ogden, one term": _wide_ogden(1),
    "ogden, two terms": _wide_ogden(2),
    "ogden, three terms": _wide_ogden(3),
    "eight-chain": lambda random: dj.ArrudaBoyce(chain_links=log_uniform(random, 5, 500)),
    "electrostrictive": _wide_electrostrictive,
}


def wide_scene(random, material: str | None = None) -> dj.Scene:
    """A chamber in three of four scenes, filled to a volume or a pressure, else a constant pressure; any breakdown law."""
    name = list(WIDE_MATERIALS)[int(random.integers(len(WIDE_MATERIALS)))] if material is None else material
    stretch = 1.0 if random.random() < 0.2 else uniform(random, 1.0, 2.5)
    law = dj.VHBBreakdown(scale=uniform(random, 0.5, 1.5)) if random.random() < 0.7 else dj.ConstantBreakdown(1.0)
    elastomer = WIDE_MATERIALS[name](random)
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


def material_of(kind: str, random):
    """A material of a kind; that of another name is electrostrictive."""
    share = random.uniform(0.0, 0.3)
    if kind == "gent":
        return _wide_gent(random)
    if kind == "neo-hookean":
        return dj.NeoHookean()
    if kind == "mooney-rivlin":
        return _mooney_rivlin(float(share / 10))
    if kind == "ogden":
        stiff = random.uniform(3.0, 6.0)
        return _ogden([1 - share / 30, share / 30], [1.8, stiff])
    if kind == "eight-chain":
        return dj.ArrudaBoyce(log_uniform(random, 5, 200))
    gent = dj.Gent(log_uniform(random, 50, 500))
    return dj.Electrostrictive(gent, stretch_coefficient=uniform(random, -0.05, 0.0))


def film_of(kind: str, random) -> dj.Membrane:
    """A membrane of prestretch 1 to 4, at most two thirds of the way to lock-up."""
    material = material_of(kind, random)
    most = min(4.0, 1 + (dj.Membrane(material).lock_up_stretch()[0] - 1) * 2 / 3)
    return dj.Membrane(material, prestretch=uniform(random, 1.0, most) if random.uniform() < 0.8 else 1.0)


def _peak(membrane: dj.Membrane) -> tuple[float, float]:
    """Volume and pressure at the first maximum of the pressure at zero voltage, or half way to lock-up without one."""
    rim, top = float(membrane.prestretch), membrane.lock_up_stretch()[0]
    apex = rim + (top - rim) * np.linspace(0.01, 0.99, 256) ** 2
    p, v, slope = (np.asarray(x) for x in dj.model.explicit_map(membrane.material, apex, 0.0, rim, 64.0))
    good = np.isfinite(p) & np.isfinite(v) & (slope < 0)
    p, v = p[good], v[good]
    falls = np.flatnonzero(np.diff(p) < 0)
    i = falls[0] if len(falls) else len(p) // 2
    return float(v[i]), float(p[i])


def _loading_about(k: int, volume: float, pressure: float, polytropic: bool, random):
    """The k-th loading: by V_0, every third by p_0, every sixth a constant pressure."""
    if k % 6 == 5:
        return dj.ConstantPressure(float(random.uniform(0.1, 1.1) * pressure))
    filling = {"initial_volume": float(random.uniform(0.1, 1.6) * volume)}
    if k % 3 == 1:
        filling = {"initial_pressure": float(random.uniform(0.1, 0.999) * pressure)}
    outside = 0.0 if random.uniform() < 0.1 else log_uniform(random, 0.5, 1000)
    size = log_uniform(random, 0.02, 25000)
    exponent = 1.0 if k % 2 or not polytropic else 1.4
    return dj.Chamber(size, **filling, atmospheric_pressure=outside, polytropic_exponent=exponent)


def scenes_of(membrane, count: int, polytropic: bool, random) -> list:
    """Scenes of one membrane, filled or held up to and beyond the peak of its pressure."""
    volume, pressure = _peak(membrane)
    return [dj.Scene(membrane, _loading_about(k, volume, pressure, polytropic, random)) for k in range(count)]
