"""The explorer: sliders change the diagram, and it shows what the equations give.

The sliders are moved by setting their values, as a user's browser does; no browser is needed.
"""

import io
import sys

import matplotlib.image
import numpy as np
import pytest

pytest.importorskip("ipywidgets")

import dielectric_jax as dj

PEAK = 1.908684829414, 2.9634068291
VALLEY = 1.361703319141, 59.066473804
SNAPS = {1600.0: 0.0764953595449, 800.0: 0.0971990067469}  # section 4 of the model, V_0 = 2.42
BREAKDOWNS = {1600.0: 0.100970094106, 800.0: 0.115172761046}


@pytest.fixture(scope="module")
def explorer():
    return dj.apps.explore(prestretches=(1.0, 2.0))


@pytest.fixture
def paper(explorer):
    """The explorer with its sliders back at the paper's chamber."""
    values = {"loading": "closed chamber", "prestretch": 1.0, "chamber_volume": 1600.0, "initial_volume": 2.42}
    for name, value in (values | {"pressure": 1.82, "voltage": 0.05}).items():
        explorer.controls[name].value = value
    return explorer


def drawn(explorer):
    """The points of all lines on the axes, (n, 2)."""
    return np.concatenate([np.array(line.get_xydata()) for line in explorer.axes.lines])


def has(explorer, x, y):
    """Whether a marker or a line of the picture has a point there."""
    return bool(np.any(np.all(np.isclose(drawn(explorer), (x, y), rtol=1e-9, atol=1e-12), axis=1)))


@pytest.mark.parametrize("volume", list(SNAPS))
def test_the_snap_and_breakdown_are_where_the_model_has_them(paper, volume):
    paper.controls["chamber_volume"].value = volume
    (snap,) = [e.state for e in paper.seen.events if e.event == "snap"]
    assert abs(snap.voltage - SNAPS[volume]) < 1e-11
    assert has(paper, snap.volume, SNAPS[volume])
    (end,) = [e.state for e in paper.seen.events if e.event == "breakdown"]
    assert abs(end.voltage - BREAKDOWNS[volume]) < 1e-10
    assert has(paper, end.volume, BREAKDOWNS[volume])
    assert f"{SNAPS[volume]:.4g}" in paper.message.value
    assert {1600.0: "stays", 800.0: "returns"}[volume] in paper.message.value


@pytest.mark.parametrize(
    ("name", "value"),
    [("chamber_volume", 700.0), ("initial_volume", 2.3), ("prestretch", 2.0), ("loading", "constant pressure")],
)
def test_a_slider_redraws(paper, name, value):
    before, points = paper.picture.value, drawn(paper)
    paper.controls[name].value = value
    assert paper.picture.value != before
    after = drawn(paper)
    assert after.shape != points.shape or not np.allclose(after, points)
    pixels = matplotlib.image.imread(io.BytesIO(paper.picture.value))
    assert np.ptp(pixels) > 0.9  # black on white


def test_the_lines_obey_the_equation_of_the_gas(paper):
    """(24): every state has (p + 50)(V + V_C) = (p_0 + 50)(V_0 + V_C), here at V_0 = 2.42, p_0 = 1.886612680245."""
    branch = paper.seen.branches[0]
    held = (branch.pressure + 50) * (branch.volume + 1600) / ((1.886612680245 + 50) * (2.42 + 1600))
    assert np.max(np.abs(held - 1)) < 1e-11


def test_no_fold_below_zero_voltage_is_drawn(paper):
    """V_C = 1600 has a second fold, at q = −0.0011, which no voltage reaches."""
    assert len([p for p in paper.seen.special_points if p.kind == "fold"]) == 1


@pytest.mark.parametrize(
    "loading",
    [
        dj.Chamber(volume=800.0, initial_volume=2.42),
        dj.Chamber(volume=25000.0, initial_volume=2.42),
        dj.ConstantPressure(1.82),
        dj.ConstantVoltage(0.1),
    ],
    ids=["800", "25000", "pressure", "voltage"],
)
def test_a_glance_agrees_with_continuation(membrane, loading):
    """Stability along the lines, special points, and the events up to a landing beyond the rows."""
    scene = dj.Scene(membrane, loading)
    if isinstance(loading, dj.ConstantVoltage):
        diagram, place = dj.pressure_volume(membrane, float(loading.voltage)), "pressure"
    else:
        diagram, place = dj.voltage_volume(scene), "voltage"
    seen = dj.glance(scene, dj.Surface.build(membrane))
    for point in seen.special_points:
        near = [
            p for p in diagram.special_points if p.kind == point.kind and abs(p.volume - point.volume) < 1e-7 * p.volume
        ]
        assert len(near) == 1
        assert abs(getattr(near[0], place) - getattr(point, place)) < 1e-8
    folds = np.array([p.volume for p in diagram.special_points if p.kind == "fold"])
    assert len(folds) == 2 and "fold" in [p.kind for p in seen.special_points]
    edges = np.sort(folds)
    for branch in seen.branches:
        (other,) = diagram.branches
        clear = np.min(np.abs(branch.volume[:, None] / folds - 1), axis=1) > 0.02
        clear &= (branch.volume > other.volume.min()) & (branch.volume < other.volume.max())
        assert clear.sum() > 50
        # between two folds the diagram has one index
        for side in range(3):
            own = clear & (np.searchsorted(edges, branch.volume) == side)
            known = set(other.index[np.searchsorted(edges, other.volume) == side])
            assert len(known) == 1 and set(branch.index[own]) <= known
    if place == "voltage":
        ups = zip(seen.events, diagram.events, strict=False)
        for mine, known in until_lost(ups):
            assert mine.event == known.event
            assert abs(mine.state.voltage - known.state.voltage) < 1e-9


def test_a_glance_at_a_chamber_filled_to_a_pressure(membrane):
    """p_0 = 1.886612680245 fills the chamber to V_0 = 2.42."""
    surface = dj.Surface.build(membrane)
    by_pressure, by_volume = (
        dj.glance(dj.Scene(membrane, dj.Chamber(volume=1600.0, **filling)), surface)
        for filling in ({"initial_pressure": 1.886612680245}, {"initial_volume": 2.42})
    )
    snaps = [seen.events[1].state.voltage for seen in (by_pressure, by_volume)]
    assert abs(snaps[0] - snaps[1]) < 1e-9 and abs(snaps[1] - 0.07649536) < 1e-8
    assert by_volume.gas_pressure(2.42) == pytest.approx(1.886612680245, abs=1e-9)
    assert by_volume.gas_pressure([100.0])[0] == pytest.approx((1.886612680245 + 50) * 1602.42 / 1700 - 50, abs=1e-9)


def test_a_glance_is_shown_and_drawn(membrane):
    seen = dj.glance(dj.Scene(membrane, dj.Chamber(volume=1600.0, initial_volume=2.42)), dj.Surface.build(membrane))
    assert "<td>snap</td>" in seen._repr_html_() and "<td>fold</td>" in seen._repr_html_()
    assert repr(seen).startswith("Glance(voltage-volume, regime=stays, area_strain=16.1219")
    figure = seen.plot()
    assert len(figure.axes[0].lines) >= 2


@pytest.mark.parametrize(
    ("loading", "prestretch", "said"),
    [
        (dj.PrescribedVolume(3.0), 1.0, "`loading` must be a Chamber, a ConstantPressure or a ConstantVoltage"),
        (dj.ConstantPressure(1.0), 2.0, "`surface` must be built for the membrane of the scene"),
    ],
)
def test_a_glance_refuses(membrane, loading, prestretch, said):
    film = dj.Membrane(prestretch=prestretch)
    with pytest.raises(ValueError, match=said):
        dj.glance(dj.Scene(film, loading), dj.Surface.build(membrane))


@pytest.mark.parametrize("pressure", [30.0, 1.908684829414 * (1 - 1e-6), 1.908684829414 * (1 + 1e-6)])
def test_a_glance_that_cannot_tell_the_filling_says_so(membrane, pressure):
    """p_0 = 30 is reached near lock-up only, beyond the surface; beside the peak its rows cannot decide."""
    scene = dj.Scene(membrane, dj.Chamber(volume=1600.0, initial_pressure=pressure))
    with pytest.raises(dj.SceneError, match=r"The (surface does not tell|rows of the surface hold no state)") as told:
        dj.glance(scene, dj.Surface.build(membrane))
    assert told.value.code is dj.numerics.Code.surface_edge


def until_lost(pairs):
    """Pairs of events up, until a landing is not reported because it lies beyond the rows."""
    for mine, known in pairs:
        if mine.event == "no_landing" or mine.direction == "down":
            return
        yield mine, known


def test_the_extremes_of_the_pressure(paper):
    paper.controls["loading"].value = "constant voltage"
    paper.controls["voltage"].value = 0.0
    assert has(paper, PEAK[1], PEAK[0]) and has(paper, VALLEY[1], VALLEY[0])
    assert paper.axes.get_ylabel().startswith("Pressure")
    shown = {name: paper.controls[name].layout.display for name in ("voltage", "pressure", "chamber_volume")}
    assert shown == {"voltage": None, "pressure": "none", "chamber_volume": "none"}


def test_a_bad_value_is_said_and_the_next_is_drawn(paper):
    paper.controls["chamber_volume"].value = float("nan")
    assert "must be positive and finite, but is nan" in paper.message.value
    assert paper.seen is None and not len(paper.axes.lines)
    paper.controls["chamber_volume"].value = 800.0
    assert "returns" in paper.message.value and len(paper.axes.lines)


def test_a_start_that_is_not_stable_is_said(paper):
    """At V_C = 25000 the air is nearly a constant pressure, under which V = 6, past the peak at V = 2.96, is unstable."""
    paper.controls["chamber_volume"].value = 25000.0
    paper.controls["initial_volume"].value = 6.0
    assert "not stable" in paper.message.value


def test_the_surface_and_the_whole_diagram_say_the_same(paper):
    """p = 1.82 breaks down in the snap (section 5 of the model), at a state far beyond the surface's domain."""
    paper.controls["loading"].value = "constant pressure"
    shown = []
    for _ in range(2):
        assert "breaks in snap" in paper.message.value
        (snap,) = [e.state for e in paper.seen.events if e.event == "snap"]
        assert abs(snap.voltage - 0.114568360882) < 1e-11
        (landing,) = [e.state for e in paper.seen.events if e.event == "landing" and e.direction == "up"]
        shown.append((landing.apex_stretch, landing.volume, landing.breakdown_ratio))
        paper.controls["whole"].click()
    assert isinstance(paper.seen, dj.diagram.Diagram)
    assert np.allclose(*shown, rtol=1e-8, atol=0)


def test_what_the_surface_does_not_decide_is_left_to_the_whole_diagram(paper):
    """Just below the peak of the pressure at V = 2.963 the start lies between two rows of the surface."""
    paper.controls["loading"].value = "constant pressure"
    paper.controls["pressure"].value = PEAK[0] * (1 - 1e-10)
    assert "whole diagram" in paper.message.value
    assert paper.seen is None or paper.seen.regime == dj.Regime.not_decided


def test_units_are_those_of_the_scene():
    membrane, units = dj.model.vhb_4910()
    chamber = dj.Chamber(
        volume=units.to_si(1600.0, "volume"), initial_volume=units.to_si(2.42, "volume"), atmospheric_pressure=100e3
    )
    seen = dj.apps.explore(dj.Scene.from_si(membrane, chamber, units), prestretches=[1.0])
    assert "kV" in seen.axes.get_ylabel() and "ml" in seen.axes.get_xlabel()
    assert f"Φ = {0.0764953595449 * 32.88422182218:.4g} kV" in seen.message.value  # H = 1 mm, times 32.88 MV/m
    sliders = {name: seen.controls[name] for name in ("chamber_volume", "initial_volume", "pressure", "voltage")}
    units_of_sliders = [slider.description.rsplit(" / ", 1)[1] for slider in sliders.values()]
    assert units_of_sliders == ["L", "ml", "mbar", "kV"]
    assert sliders["chamber_volume"].value == pytest.approx(18.225, rel=1e-9)
    sliders["initial_volume"].value = 26.0  # ml
    assert seen.scene.value_of("initial_volume") == pytest.approx(26e-6, rel=1e-9)


def test_an_opening_stays_as_the_prestretch_changes():
    air = dj.Chamber(volume=18.225e-3, initial_volume=12e-6, atmospheric_pressure=100e3)
    scene = dj.Scene.from_si(dj.Membrane(), air, dj.Units.for_opening("22.5 mm"))
    seen = dj.apps.explore(scene, prestretches=[1.0, 1.5])
    seen.controls["prestretch"].value = 1.5
    assert float(seen.scene.units.radius) == pytest.approx(15e-3, rel=1e-12)
    assert seen.scene.value_of("chamber_volume") == pytest.approx(18.225e-3, rel=1e-9)
    assert seen.scene.value_of("atmospheric_pressure") == pytest.approx(100e3, rel=1e-12)


def test_it_is_shown_by_its_widget(paper):
    assert "application/vnd.jupyter.widget-view+json" in paper._repr_mimebundle_()
    assert repr(paper) == "Explorer(closed chamber, prestretches 1, 2)"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"scene": dj.Membrane()}, "`scene` must be a Scene, but is a Membrane"),
        (
            {"scene": dj.Scene(dj.Membrane(), dj.PrescribedVolume(3.0))},
            "`loading` must be a Chamber, .* PrescribedVolume",
        ),
        (
            {"scene": dj.Scene(dj.Membrane(), dj.Chamber(volume=9.0, initial_pressure=1.0))},
            "`initial_volume` must be given",
        ),
        (
            {"scene": dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0), dj.model.Window((1.0, 3.0)))},
            "`window` must be left out",
        ),
        ({"prestretches": 1.0}, "`prestretches` must be numbers, but is 1.0"),
        ({"prestretches": [0.5]}, "`prestretch` must"),
        ({"dpi": 0.0}, "`dpi` must be positive and finite, but is 0.0"),
        ({"size": (4.0, -1.0)}, "`size` must be positive and finite, but is -1.0"),
    ],
)
def test_refusals(given, words):
    with pytest.raises(ValueError, match=words):
        dj.apps.explore(**given)


def test_without_the_extra_one_sentence_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=r'`ipywidgets` must be installed .*"dielectric-jax\[interactive\]"'):
        dj.apps.explore()
