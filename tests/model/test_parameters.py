"""The table of parameters against the classes that hold them, and every function that takes parameters by name."""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np
import pytest

import dielectric_jax as dj
from benchmarks.acceptance import parameters as acceptance
from dielectric_jax.apps.options import read_arguments
from dielectric_jax.design import regime_edges
from dielectric_jax.model import PARAMETERS, Change, describe, parameter_of, scene_of
from dielectric_jax.model.scene import constants_of
from dielectric_jax.sweeps import zipped

AIR = {"atmospheric_pressure": 40.0, "polytropic_exponent": 1.2}
FILLED = dj.Chamber(volume=1600.0, initial_volume=2.3, **AIR)
GENT = dj.Scene(dj.Membrane(dj.Gent(120.0), 1.1, dj.VHBBreakdown(0.9)), FILLED)
MOONEY = dj.Scene(dj.Membrane(dj.MooneyRivlin(0.48, 0.02)), FILLED)
OGDEN = dj.Scene(dj.Membrane(dj.Ogden((1.0, 0.02), (1.8, 3.0))), FILLED)
CHAIN = dj.Scene(dj.Membrane(dj.ArrudaBoyce(80.0)), FILLED)
DIELECTRIC = dj.Scene(dj.Membrane(dj.Electrostrictive(dj.Gent(120.0), 0.01, -0.02)), FILLED)
BRANCHES = [dj.Maxwell(dj.Gent(55.0), 0.6, 0.1), dj.Maxwell(dj.Ogden((1.0, 0.02), (1.8, 3.0)), 0.4, 10.0)]
VISCOELASTIC = dj.Scene(dj.Membrane(dj.Viscoelastic(dj.Gent(110.0), BRANCHES), 1.1), FILLED)
IN_SI = dj.Scene.from_si(
    dj.Membrane(),
    dj.Chamber(volume=18e-3, initial_volume=27e-6, atmospheric_pressure=100e3),
    dj.Units(thickness=0.8e-3),
)
IN_A_RING = dj.Scene.from_si(
    dj.Membrane(prestretch=1.5), IN_SI.units.to_si(IN_SI.loading), dj.Units.for_opening("30 mm", prestretch=1.5)
)
# for every parameter a scene that has it, and another value
CASES = {
    "chamber_volume": (GENT, 900.0),
    "initial_volume": (GENT, 2.0),
    "initial_pressure": (dj.Scene(GENT.membrane, dj.Chamber(volume=1600.0, initial_pressure=1.5, **AIR)), 1.4),
    "atmospheric_pressure": (GENT, 60.0),
    "polytropic_exponent": (GENT, 1.4),
    "pressure": (dj.Scene(GENT.membrane, dj.ConstantPressure(1.5)), 1.6),
    "volume": (dj.Scene(GENT.membrane, dj.PrescribedVolume(3.0)), 4.0),
    "prestretch": (GENT, 1.3),
    "breakdown_field_scale": (GENT, 0.7),
    "stretch_limit": (GENT, 150.0),
    "chain_links": (CHAIN, 60.0),
    "c1": (MOONEY, 0.47),
    "c2": (MOONEY, 0.03),
    "moduli": (OGDEN, (1.02, 0.02)),
    "exponents": (OGDEN, (1.7, 3.2)),
    "thickness_coefficient": (DIELECTRIC, 0.02),
    "stretch_coefficient": (DIELECTRIC, -0.01),
    "modulus_ratio": (VISCOELASTIC, (0.5, 0.3)),
    "relaxation_time": (VISCOELASTIC, (0.2, 8.0)),
    "shear_modulus": (IN_SI, 60e3),
    "thickness": (IN_SI, 0.5e-3),
    "radius": (IN_SI, 20e-3),
    "opening_radius": (IN_A_RING, 20e-3),
    "permittivity": (IN_SI, 3e-11),
}


def test_every_row_has_a_case_and_every_constant_a_row():
    assert set(CASES) == set(PARAMETERS)
    for material in (dj.Gent(), dj.MooneyRivlin(), dj.Ogden(), dj.ArrudaBoyce(), DIELECTRIC.membrane.material):
        assert set(constants_of(material)) <= set(PARAMETERS)


@pytest.mark.parametrize("name", PARAMETERS)
def test_replace_changes_what_the_row_says(name):
    scene, value = CASES[name]
    row = PARAMETERS[name]
    assert scene.has(name)
    changed = scene.replace(**{name: value})
    said, before = acceptance.numbers_of(changed), acceptance.numbers_of(scene)
    np.testing.assert_allclose(said[name], value, rtol=1e-15)

    def differ(part):
        pairs = zip(jax.tree.leaves(part(scene)), jax.tree.leaves(part(changed)), strict=True)
        return any(float(a) != float(b) for a, b in pairs)

    assert differ(lambda s: s.membrane.material) == (row.change is Change.MATERIAL)
    assert differ(lambda s: s.membrane.prestretch) == (row.change is Change.PRESTRETCH)
    assert differ(lambda s: s.membrane.breakdown) == (row.change is Change.BREAKDOWN)
    # only what follows from the parameter changes in the description
    told = {n for n, v in said.items() if not (v == before[n] or np.allclose(v, before[n], rtol=1e-14, atol=0))}
    assert told == {name} | ({"radius"} if name == "opening_radius" else set())


@pytest.mark.parametrize(
    "name", [n for n in PARAMETERS if CASES[n][0] not in (DIELECTRIC, IN_SI, IN_A_RING) and n != "volume"]
)
def test_documents_give_the_scene_back(name):
    scene, value = CASES[name]
    changed = scene.replace(**{name: value})
    described = describe(changed)
    assert describe(scene_of(described)) == described
    assert eqx.tree_equal(scene_of(described), changed)


def test_entries_of_lists_and_constants_of_branches():
    """One number of a list, and those of a branch's own spring, each at its place in the film."""
    names = ("modulus_ratio[1]", "relaxation_time[0]", "branches[0].stretch_limit", "branches[1].moduli[0]")
    changed = VISCOELASTIC.replace(**dict(zip(names, (0.3, 0.2, 60.0, 1.01), strict=True)), stretch_limit=90.0)
    first = dj.Maxwell(dj.Gent(60.0), 0.6, 0.2)
    second = dj.Maxwell(dj.Ogden((1.01, 0.02), (1.8, 3.0)), 0.3, 10.0)
    assert eqx.tree_equal(changed.membrane.material, dj.Viscoelastic(dj.Gent(90.0), [first, second]))
    assert [float(changed.value_of(name)) for name in names] == [0.3, 0.2, 60.0, 1.01]
    assert float(OGDEN.replace(**{"moduli[1]": 0.01}).membrane.material.moduli[1]) == 0.01
    assert not VISCOELASTIC.has("relaxation_time[2]") and not GENT.has("relaxation_time")
    assert parameter_of("relaxation_time[1]").label == "relaxation time of a Maxwell branch τ[1]"
    one = VISCOELASTIC.replace(**{"branches[0].stretch_limit": 60.0})
    with pytest.raises(ValueError, match=r"`modulus_ratio` must be one number for each branch, 2, but is 0.5"):
        one.replace(modulus_ratio=0.5)
    with pytest.raises(ValueError, match=r"`branches\[2\].c1` must be one of .*branches\[0\].stretch_limit"):
        one.replace(**{"branches[2].c1": 0.5})


def test_what_acts_in_time_alone_is_refused_by_verbs_that_know_no_time():
    """Diagrams are those of the equilibrium spring: parameters of branches must not vary there, and cannot be fitted."""
    for name in ("relaxation_time[0]", "branches[0].stretch_limit"):
        with pytest.raises(ValueError, match=r"must not vary here, because the membrane at rest .* `dj.follow`"):
            regime_edges(VISCOELASTIC, {name: (0.5, 1.0)})
    with pytest.raises(ValueError, match="`membrane` must have an elastic material"):
        dj.calibrate([0.5, 1.0, 2.0], [1.0, 1.4, 1.8], membrane=VISCOELASTIC.membrane)


def test_documents_of_viscoelastic_scenes_that_are_refused():
    scene = {"chamber_volume": 1600.0, "initial_volume": 2.42, "material": "viscoelastic"}
    branch = {"modulus_ratio": 1.0, "relaxation_time": 2.0}
    for words, more in (
        (r"`branches` must be tables \[\[scene.branches\]\]", {}),
        ("`modulus_ratio` must be given in .scene.branches.0..", {"branches": [{}]}),
        ("`relaxation_tme` in .scene.branches.0.. must be one of", {"branches": [{**branch, "relaxation_tme": 1.0}]}),
        ("`c1` in .scene.branches.0.. must be left out", {"branches": [{**branch, "c1": 1.0}]}),
        (
            "`relaxation_time` must be positive and finite, but is -1.0",
            {"branches": [{**branch, "relaxation_time": -1}]},
        ),
        ("`elastic` in .scene. must be one of gent", {"branches": [branch], "elastic": "rubber"}),
        (
            "`branches` in .scene. must be given with `material` viscoelastic",
            {"branches": [branch], "material": "gent"},
        ),
    ):
        with pytest.raises(ValueError, match=words):
            scene_of(scene | more)


# a field scale, permittivities of stretch and branches are not options, and units are by --si
NO_OPTIONS = {
    "breakdown_field_scale",
    "thickness_coefficient",
    "stretch_coefficient",
    "modulus_ratio",
    "relaxation_time",
}


@pytest.mark.parametrize("name", [n for n, r in PARAMETERS.items() if n not in NO_OPTIONS and r.path[0] != "units"])
def test_options(name):
    """Every parameter of the command line's scenes is an option, with the bounds of the row."""
    scene, value = CASES[name]
    material = describe(scene)["material"]
    row = PARAMETERS[name]
    words = [f"{v:g}" for v in np.atleast_1d(value)]
    loading = {"pressure": [], "volume": [], "chamber_volume": ["--initial-volume", "2"]}.get(name)
    if loading is None:
        loading = ["--chamber-volume", "1600", *([] if name.startswith("initial_") else ["--initial-volume", "2"])]
    option = f"--{name.replace('_', '-')}"
    more = {"moduli": ["--exponents", "1.8", "3"], "exponents": ["--moduli", "1", "0.02"]}.get(name, [])
    given = ["voltage-volume", "--material", material, *loading, *more, option, *words]
    np.testing.assert_allclose(getattr(read_arguments(given), name), value if row.many else float(words[0]))
    if np.isfinite(row.least):
        with pytest.raises(Exception, match=option):
            read_arguments([*given[: -len(words)], f"{row.least - 1:g}"])


@pytest.mark.parametrize("name", PARAMETERS)
def test_axes(name):
    row = PARAMETERS[name]
    if row.many and "branches" not in row.path:  # a sweep in time gives every branch the same number
        with pytest.raises(ValueError, match="its value is a list"):
            zipped(**{name: [1.0, 2.0]})
        return
    assert zipped(**{name: [1.5, 2.5]}).size == 2
    if np.isfinite(row.least):
        assert row.allowed
        with pytest.raises(ValueError, match=f"`{name}` must be {row.allowed} and"):
            zipped(**{name: [row.least - 0.5, 2.0]})
    if row.closed:
        assert zipped(**{name: [row.least]}).size == 1
    elif row.least == 0:
        with pytest.raises(ValueError, match=f"`{name}` must be positive"):
            zipped(**{name: [0.0]})


def test_defaults_are_those_of_the_classes():
    owners = {
        "atmospheric_pressure": dj.Chamber,
        "polytropic_exponent": dj.Chamber,
        "prestretch": dj.Membrane,
        "breakdown_field_scale": dj.VHBBreakdown,
        "stretch_limit": dj.Gent,
        "chain_links": dj.ArrudaBoyce,
        "c1": dj.MooneyRivlin,
        "c2": dj.MooneyRivlin,
    }
    known = {name: row.default for name, row in PARAMETERS.items() if row.default is not None}
    assert set(known) == set(owners)
    for name, owner in owners.items():
        fields = {f.name: f.default for f in dataclasses.fields(owner)}
        assert fields[PARAMETERS[name].path[-1]] == known[name]


def test_designs_over_a_constant_of_a_material():
    """Every value has its own surface, and each design agrees with its own diagram."""
    found = dj.classify_designs(MOONEY, {"c1": [0.47, 0.49]})
    scenes = [MOONEY.replace(c1=value) for value in (0.47, 0.49)]
    regimes = [dj.regime_of(scene) for scene in scenes]
    assert [dj.Regime(int(r)) for r in found.regime] == regimes
    assert regime_edges(MOONEY, {"c1": (0.47, 0.471)}, points=2) == []


def test_the_derivative_by_a_constant_of_the_elasticity_of_a_dielectric():
    """J of the Gent material inside, by central differences."""
    slope = jax.grad(lambda limit: dj.snap_voltage(DIELECTRIC.replace(stretch_limit=limit)))(120.0)
    h = 0.05
    up, down = (dj.snap_voltage(DIELECTRIC.replace(stretch_limit=120.0 + s * h)) for s in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-6)


SCENES = acceptance.scenes()


@pytest.mark.parametrize("label", SCENES)
def test_every_parameter_in_documents_files_and_options(label):
    """Of every material, breakdown law and loading: replaced and described, in TOML and back, as an option and in its help."""
    scene = SCENES[label]
    rows = [acceptance.ask(scene, n, v) for n in acceptance.names_of(scene) for v in acceptance.CHEAP]
    assert [r for r in rows if r["answer"] == "wrong"] == []
    replaced = {r["parameter"] for r in rows if r["verb"] == "replace" and r["answer"] == "agrees"}
    assert replaced == {n for n in acceptance.names_of(scene) if scene.has(n)}


@pytest.mark.parametrize("verb", acceptance.COMPUTED)
def test_what_a_verb_does_not_take_is_refused_in_a_sentence(verb):
    """Parameters of other loadings and materials, loadings that a verb does not take, and lists of numbers."""
    asked = [
        (label, n)
        for label, scene in SCENES.items()
        for n in acceptance.names_of(scene)
        if acceptance.reasons(scene, n, verb)
    ]
    assert len(asked) > 200
    rows = [{"scene": label} | acceptance.ask(SCENES[label], n, verb) for label, n in asked]
    assert [r for r in rows if r["answer"] != "refused"] == []


# one scene that has every parameter that is a number, so that one compiled program of each verb serves them all; what each verb
# says of each material's own is in benchmarks/acceptance/parameters.py
EVERYTHING = acceptance.scene_of_everything()
VARIED = [n for n in PARAMETERS if EVERYTHING.has(n) and n != "initial_pressure"]
UNITS = [n for n in VARIED if PARAMETERS[n].path[0] == "units"]
LIMITS = {name: acceptance.limits_of(EVERYTHING, name) for name in VARIED}


def between(share: float, place: str = "") -> dict[str, float]:
    """A value between its limits of every parameter that is not in the given part of the scene."""
    own = {name: limits for name, limits in LIMITS.items() if PARAMETERS[name].path[0] != place}
    return {name: low + share * (high - low) for name, (low, high) in own.items()}


@functools.cache
def snap_of_everything(share: float, place: str = "") -> float:
    """The snap voltage by continuation, with the parameters `between` at a share of their ranges."""
    return float(dj.snap_voltage(EVERYTHING.replace(**between(share, place))))


def test_every_number_is_a_parameter_of_the_scene_of_everything():
    lists, other_loadings = {n for n, row in PARAMETERS.items() if row.many}, {"initial_pressure", "pressure", "volume"}
    assert set(VARIED) == set(PARAMETERS) - lists - other_loadings - {"opening_radius"}


@pytest.mark.parametrize("left_out", ["units", "loading"])
def test_sweeps_and_designs_over_every_parameter_at_once(left_out):
    """On surfaces, against the snaps of continuation; the loading and its units not together."""
    both = [between(share, left_out) for share in (0.2, 0.6)]
    columns = {name: [one[name] for one in both] for name in both[0]}
    snaps = [snap_of_everything(share, left_out) for share in (0.2, 0.6)]
    assert abs(snaps[0] / snaps[1] - 1) > 1e-3
    designs = dj.classify_designs(EVERYTHING, columns)
    volts = [EVERYTHING.replace(**one).in_units(1.0, "voltage") for one in both]
    np.testing.assert_allclose(designs.ramps.snap.voltage[:, 0] * volts, snaps, rtol=1e-8)
    data = dj.sweep(EVERYTHING, zipped(**columns), progress=False)
    np.testing.assert_allclose(data.snap_voltage.sel(jump=0), snaps, rtol=1e-8)
    np.testing.assert_array_equal(data.regime, designs.regime)


def test_the_derivative_by_every_parameter_at_once():
    """Their sum along the ranges, by central differences."""

    def snap(*values):
        return dj.snap_voltage(EVERYTHING.replace(**dict(zip(VARIED, values, strict=True))))

    slopes = jax.grad(snap, range(len(VARIED)))(*between(0.4).values())
    along = sum(float(s) * (high - low) for s, (low, high) in zip(slopes, LIMITS.values(), strict=True))
    h = 0.01
    snaps = [snap_of_everything(0.4 + k * h) for k in (-2, -1, 1, 2)]
    np.testing.assert_allclose(along, (8 * (snaps[2] - snaps[1]) - (snaps[3] - snaps[0])) / (12 * h), rtol=1e-6)
    # the law of breakdown does not move the snap
    assert [n for n, slope in zip(VARIED, slopes, strict=True) if float(slope) == 0] == ["breakdown_field_scale"]


def test_the_derivative_by_units_alone():
    """The chamber stays what it is in SI, so that its dimensionless numbers change with μ, H and A."""

    def snap(*shares):
        at = {n: LIMITS[n][0] + share * (LIMITS[n][1] - LIMITS[n][0]) for n, share in zip(UNITS, shares, strict=True)}
        return dj.snap_voltage(EVERYTHING.replace(**at))

    place, h = [0.4] * len(UNITS), 0.01
    slopes = jax.grad(snap, range(len(UNITS)))(*place)
    snaps = [float(snap(*(x + k * h for x in place))) for k in (-2, -1, 1, 2)]
    np.testing.assert_allclose(sum(slopes), (8 * (snaps[2] - snaps[1]) - (snaps[3] - snaps[0])) / (12 * h), rtol=1e-6)
    # of a voltage that is counted in H√(μ/ε) the permittivity changes nothing but the unit
    at = EVERYTHING.replace(**{n: LIMITS[n][0] + 0.4 * (LIMITS[n][1] - LIMITS[n][0]) for n in UNITS})
    share = LIMITS["permittivity"][1] - LIMITS["permittivity"][0]
    by_permittivity = -float(dj.snap_voltage(at)) / (2 * float(at.units.permittivity)) * share
    np.testing.assert_allclose(slopes[UNITS.index("permittivity")], by_permittivity, rtol=1e-9)


@pytest.mark.parametrize("name", ["chamber_volume", "stretch_limit", "shear_modulus"])
def test_regime_edges_over_a_parameter_of_each_part(name):
    low, high = LIMITS[name]
    ends = dj.classify_designs(EVERYTHING, {name: [low, high]}).regime.tolist()
    found = regime_edges(EVERYTHING, {name: (low, high)}, points=2)
    regimes = [found[0].below, *(edge.above for edge in found)] if found else ends[:1]
    assert [regimes[0], regimes[-1]] == ends
    assert all(low <= edge.value <= high for edge in found)


@pytest.mark.parametrize("name", ["stretch_limit"])
def test_designs_that_are_uncertain_in_a_parameter(name):
    """A constant of the elasticity of a dielectric: the worst of the box."""
    over = {"chamber_volume": LIMITS["chamber_volume"]}
    best = dj.maximise_area_strain(EVERYTHING, over, uncertain={name: 0.02}, check=False)
    chosen = EVERYTHING.replace(**best.parameters)
    value = float(acceptance.value_of(chosen, name))
    box = dj.classify_designs(chosen, {name: [0.98 * value, value, 1.02 * value]})
    np.testing.assert_allclose(best.area_strain, box.ramps.area_strain.min(), rtol=1e-7)
