"""The design of largest area strain: known optima, gradients, constraints, scans."""

import json
import pathlib

import jax
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.apps.cli import main
from dielectric_jax.design.constrained_search import Kind, begin_of, measure

DOCS = pathlib.Path(__file__).parents[2] / "docs"
CHAMBERS = {"chamber_volume": (500.0, 25000.0)}


def test_the_bound_is_active(scene, surface):
    """At V_0 = 2.42 the strain grows with the chamber: 25.567264 at V_C = 25000."""
    best = dj.maximise_area_strain(scene, CHAMBERS, surface=surface)
    assert best.parameters["chamber_volume"] == 25000.0 and best.active == ("chamber_volume_upper",)
    assert abs(best.area_strain / 25.567264 - 1) < 2e-8
    assert abs(best.diagram.area_strain / best.area_strain - 1) < 1e-5  # of the design moved inwards
    # one unit of chamber more
    slope = jax.grad(lambda v: dj.area_strain(scene.replace(chamber_volume=v), surface=surface))(25000.0)
    assert abs(best.multipliers["chamber_volume_upper"] / slope - 1) < 1e-6


def test_survival_is_active(scene, surface):
    """At V_0 = 2.3 membranes on larger chambers break down in the snap: V_C = 7699.2058, strain 23.480988."""
    own = scene.replace(initial_volume=2.3)
    best = dj.maximise_area_strain(own, CHAMBERS, surface=surface, check=False)
    assert abs(best.parameters["chamber_volume"] / 7699.2058 - 1) < 2e-9 and best.active == ("survival_margin",)
    assert abs(best.area_strain / 23.480988 - 1) < 2e-8
    at = own.replace(chamber_volume=best.parameters["chamber_volume"])
    assert abs(dj.critical.landing_point(at).breakdown_ratio - 1) < 1e-10  # by shooting
    assert best.regime == dj.Regime.stays


def test_margins_and_ways_down(scene, surface):
    """Each constraint holds with equality where it limits the design."""
    best = dj.maximise_area_strain(scene, CHAMBERS, survival_margin=0.2, surface=surface, check=False)
    at = scene.replace(**best.parameters)
    assert best.active == ("survival_margin",) and abs(dj.critical.landing_point(at).breakdown_ratio - 0.8) < 1e-9
    # relaxing the margin by 1e-4 gains the multiplier times that
    more = dj.maximise_area_strain(scene, CHAMBERS, survival_margin=0.1999, surface=surface, check=False)
    gain = (more.area_strain - best.area_strain) / 1e-4
    assert abs(gain / best.multipliers["survival_margin"] - 1) < 1e-2
    best = dj.maximise_area_strain(scene, CHAMBERS, way_down="returns", surface=surface, check=False)
    assert abs(best.parameters["chamber_volume"] / 1455.896262454 - 1) < 1e-8 and best.active == ("returns",)
    best = dj.maximise_area_strain(scene, CHAMBERS, operating_margin=0.1, surface=surface, check=False)
    at = scene.replace(**best.parameters)
    # taken where E/E_EB is 0.9: the breakdown of a film with nine tenths of the field
    weaker = dj.voltage_volume(at.replace(breakdown_field_scale=0.9), surface=None)
    assert abs(weaker.area_strain / best.area_strain - 1) < 1e-8


def test_no_design_of_a_scan_is_better(scene, surface):
    """Chamber and filling at once, against 2500 designs."""
    over = CHAMBERS | {"initial_volume": (2.2, 2.9)}
    best = dj.maximise_area_strain(scene, over, survival_margin=0.1, surface=surface, check=False, compare=2500)
    assert best.scan is not None and best.scan["designs"] == 2500
    assert 0 <= best.scan["gain"] < 1.0


def test_worst_case(scene, surface):
    """With V_0 known within 2 % the design is that of the least filling, at which the landing is closest to breakdown."""
    own = scene.replace(initial_volume=2.35)
    best = dj.maximise_area_strain(own, CHAMBERS, uncertain={"initial_volume": 0.02}, surface=surface, check=False)
    least = own.replace(initial_volume=2.35 * 0.98, **best.parameters)
    assert "survival_margin" in best.active
    assert abs(dj.critical.landing_point(least).breakdown_ratio - 1) < 1e-8
    # one scenario in ten may fail: a larger chamber
    loose = dj.maximise_area_strain(
        own, CHAMBERS, uncertain={"initial_volume": 0.02}, quantile=0.1, surface=surface, check=False
    )
    assert loose.parameters["chamber_volume"] > best.parameters["chamber_volume"]


@pytest.mark.parametrize("name", ["radius", "shear_modulus"])
def test_another_film_leaves_the_chamber_what_it_is_in_si(name):
    """The worst case over an uncertain film is that of diagrams in which the optimised chamber keeps its litres."""
    chamber = dj.Chamber(volume=18e-3, initial_volume=27e-6, atmospheric_pressure=100e3)
    scene = dj.Scene.from_si(dj.Membrane(dj.Gent(120.0)), chamber, dj.Units(thickness=0.8e-3))
    limits = {"chamber_volume": ("17.1 l", "19.3 l")}
    best = dj.maximise_area_strain(scene, limits, uncertain={name: 0.02}, check=False)
    chosen = scene.replace(**best.parameters)
    nominal = float(getattr(chosen.units, name))
    films = [chosen.replace(**{name: nominal * share}) for share in (0.98, 1.0, 1.02)]
    worst = min(float(dj.critical.area_strain(film)) for film in films)
    assert float(best.area_strain) == pytest.approx(worst, rel=1e-8)


def test_the_other_filling_of_a_chamber(scene, surface):
    """A scene that is filled to a volume is optimised over its pressure too."""
    best = dj.maximise_area_strain(scene, {"initial_pressure": (1.87, 1.9)}, surface=surface, check=False)
    own = scene.replace(**best.parameters)
    assert own.loading.initial_volume is None
    assert float(best.area_strain) == pytest.approx(float(dj.critical.area_strain(own)), rel=1e-8)


def test_slopes(scene, surface):
    """Derivatives by the implicit function theorem, against central differences of the ramps."""
    ramps = dj.diagram.chamber_ramps(surface, 1600.0 + np.array([-0.5, 0.0, 0.5]), 2.42)
    found = measure(
        Kind(1, False), ("chamber_volume",), surface, scene, [[1600.0]], begin_of(Kind(1, False), ramps, np.array([1]))
    )
    slope = dict(zip(found.names, found.slopes[0, :, 0], strict=True))
    growth, landing = np.log1p(ramps.area_strain), 2 * np.log(ramps.landing_ratio[:, 0])
    assert abs(slope["growth"] / (growth[2] - growth[0]) - 1) < 1e-6
    assert abs(slope["landing_0"] / (landing[2] - landing[0]) - 1) < 1e-6


def test_an_objective_of_ones_own(scene, surface):
    """The area strain as a user's own function, with its landing at 0.8: the same result as `maximise_area_strain`."""
    best = dj.maximise_area_strain(scene, CHAMBERS, survival_margin=0.2, surface=surface, check=False)
    found = dj.maximise(
        lambda s: dj.area_strain(s, surface=surface),
        scene,
        {"chamber_volume": (6000.0, 15000.0)},
        constraints={
            "landing": lambda s: 0.8 - dj.critical.landing_point(s, surface=surface, throw=False).breakdown_ratio
        },
    )
    assert found.active == ("landing",) and abs(found.value / best.area_strain - 1) < 1e-6
    with pytest.raises(ValueError, match="`objective` must be a number somewhere"):
        dj.maximise(lambda s: s.loading.volume * np.nan, scene, CHAMBERS)


def test_refusals(scene):
    with pytest.raises(ValueError, match="`over` must name at least one"):
        dj.maximise_area_strain(scene, {})
    with pytest.raises(ValueError, match="`survival_margin` must lie between"):
        dj.maximise_area_strain(scene, CHAMBERS, survival_margin=1.5)
    with pytest.raises(ValueError, match="`stretch_limit` must be held"):
        dj.maximise_area_strain(scene, {"stretch_limit": (100.0, 300.0)})
    with pytest.raises(ValueError, match="`way_down` must be"):
        dj.maximise_area_strain(scene, CHAMBERS, way_down="up")
    with pytest.raises(ValueError, match="`uncertain` must name a parameter"):
        dj.maximise_area_strain(scene, CHAMBERS, quantile=0.1)


@pytest.mark.parametrize(("command", "name"), [("optimise", "design"), ("regimes", "regimes")])
def test_examples_of_the_documentation(command, name, capsys, tmp_path):
    text = (DOCS / f"example_{name}.toml").read_text(encoding="utf-8").replace("points = 100", "points = 20")
    path = tmp_path / "spec.toml"
    path.write_text(text, encoding="utf-8")
    figure = tmp_path / "figure.png"
    assert main([command, str(path), "--json", "-", "--figure", str(figure)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert figure.stat().st_size > 10_000
    if command == "optimise":
        assert document["active"] == ["survival_margin"] and document["area_strain"] > 20
    else:
        assert np.shape(document["regimes"]) == (20, 20) and document["boundaries"]
    path.write_text(text.replace("points = 20", "points = 6"), encoding="utf-8")
    assert main([command, str(path)]) == 0
    assert "survival_margin" in (said := capsys.readouterr().out) or "stays" in said


def test_refusals_of_files(tmp_path, capsys):
    path = tmp_path / "spec.toml"
    for text, said in (
        ("[scene", "must be a file of TOML"),
        ("[scene]\nspeed = 1.0", "`speed` in [scene] must be one of"),
        ("[over]\nchamber_volume = 3", "must be a pair"),
    ):
        path.write_text(text, encoding="utf-8")
        assert main(["optimise", str(path)]) == 2
        assert said in capsys.readouterr().err
    assert main(["regimes", str(tmp_path / "none.toml")]) == 2
