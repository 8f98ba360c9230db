"""The explorer: sliders change the diagram, and it shows what the equations give.

The sliders are moved by setting their values, as a user's browser does; no browser is needed.
"""

import io
import sys

import equinox as eqx
import jax
import matplotlib.image
import numpy as np
import pytest

pytest.importorskip("ipywidgets")

import ipywidgets

import dielectric_jax as dj
from dielectric_jax.apps.explorer_controls import Sliders
from dielectric_jax.apps.explorer_story import story
from dielectric_jax.apps.scene_code import code_of

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
    explorer.reset()
    explorer.controls["shape"].value = "start"
    return explorer


def state_of(explorer, event):
    """The first state of an event on the way up."""
    return next(e.state for e in explorer.seen.events if e.event == event and e.direction == "up")


def line_of(panel, colour):
    """The points of the longest line of a colour on a panel's axes."""
    return max((np.array(k.get_xydata()) for k in panel.axes.lines if k.get_color() == colour), key=len)


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


@pytest.mark.parametrize("volume", [50.0, 1600.0, 25000.0])
def test_the_filling_ends_where_a_ramp_can_start(paper, volume):
    """Stable at zero voltage is dp/dV of the film > dp/dV of the air; at V_C = 25000 that ends beside the peak, at V = 2.963."""
    paper.controls["chamber_volume"].value = volume
    slider = paper.controls["initial_volume"]
    slider.value = slider.max
    assert "start" in [e.event for e in paper.seen.events] and "cannot" not in paper.message.value
    air = (50 + paper.seen.events[0].state.pressure) / (volume + slider.value)
    step = 2 * slider.step
    p = [dj.equilibrium(dj.Membrane(), volume=slider.value + k * step).pressure for k in (0, 1, 2)]
    assert p[1] - p[0] > -air * step  # stable at the end of the slider
    assert slider.value == 8.0 or p[2] - p[1] < -0.9 * air * step  # and hardly any farther
    if volume == 25000.0:
        assert 2.9 < slider.value < PEAK[1]


def test_nearly_flat_films_are_followed_by_shooting(paper):
    """The rows of the surface hold hardly a state of so little gas beside a film that is nearly flat."""
    paper.controls["chamber_volume"].value = 10.0
    slider = paper.controls["initial_volume"]
    slider.value = slider.min
    assert isinstance(paper.seen, dj.diagram.Diagram) and "<b>" not in paper.message.value
    assert paper.seen.events[0].state.volume == pytest.approx(slider.min, rel=1e-8)


def test_no_position_of_a_load_is_an_error(paper):
    for loading, name in (("constant pressure", "pressure"), ("constant voltage", "voltage")):
        paper.controls["loading"].value = loading
        slider = paper.controls[name]
        for value in (slider.max, slider.min):
            slider.value = value
            assert paper.seen is not None and "<b>The" not in paper.message.value
    assert paper.controls["pressure"].max < PEAK[0]


def test_a_slider_that_must_give_way_says_so(paper):
    paper.controls["initial_volume"].value = 3.2
    paper.controls["chamber_volume"].value = 25000.0
    assert paper.controls["initial_volume"].value < PEAK[1] and "went back" in paper.message.value
    paper.controls["chamber_volume"].value = 24000.0
    assert "went back" not in paper.message.value


def test_another_breakdown_law_needs_no_other_surface(paper, monkeypatch):
    """E_EB twice as large is twice as much breakdown load at each state; no snap moves."""
    before = state_of(paper, "breakdown").voltage
    monkeypatch.setattr(dj.Surface, "build", None)
    for scale in (0.6, 1.5):
        paper.controls["breakdown_field_scale"].value = scale
        assert abs(state_of(paper, "snap").voltage - SNAPS[1600.0]) < 1e-11
        end = state_of(paper, "breakdown")
        known = dj.equilibrium(paper.scene, voltage=end.voltage, all=True)[-1]
        assert abs(known.breakdown_ratio - 1) < 1e-9 and abs(known.volume / end.volume - 1) < 1e-9
        assert (end.voltage < before) == (scale < 1)


def test_another_stretch_limit_is_another_film(paper):
    """The picture of the old film stays while the surface is built, and the snap is that of the new film's diagram."""
    shown = []
    picture = paper.picture.value
    paper.message.observe(lambda change: shown.append((change["new"], paper.picture.value)), names="value")
    paper.controls["stretch_limit"].value = 200.0
    assert shown[0][0].startswith("Building the surface") and shown[0][1] == picture
    assert float(paper.scene.membrane.material.stretch_limit) == 200.0
    snap = state_of(paper, "snap")
    known = dj.equilibrium(paper.scene, voltage=snap.voltage * (1 - 1e-9), all=True)
    assert min(abs(k.volume - snap.volume) for k in known) < 1e-3
    assert all(
        abs(k.volume - snap.volume) > 1
        for k in dj.equilibrium(paper.scene, voltage=snap.voltage * (1 + 1e-6), all=True)
    )
    shown.clear()
    paper.reset()
    assert abs(state_of(paper, "snap").voltage - SNAPS[1600.0]) < 1e-11
    assert not [said for said, _ in shown if "Building" in said]
    paper.message.unobserve_all()


def test_the_constants_of_a_film_have_sliders():
    film = dj.Membrane(dj.model.MooneyRivlin(c1=0.45, c2=0.05), breakdown=dj.ConstantBreakdown(2.0))
    sliders = Sliders(ipywidgets, dj.Scene(film, dj.ConstantPressure(0.5)), [1.0])
    assert sliders.film_names == ["prestretch", "breakdown_field_scale", "c1", "c2"]
    assert sliders.widgets["c1"].description == "Mooney–Rivlin constant C₁ / μ"
    sliders.widgets["c2"].value = 0.07
    assert float(sliders.film().membrane.material.c2) == 0.07


def test_the_panels_show_the_state_on_its_curve_and_its_shape(paper):
    """The ring lies on the line of the air; the outline of the membrane encloses the volume of the state."""
    _, curves, shape = paper._panels
    for word, event in (("before the snap", "snap"), ("landing", "landing"), ("breakdown", "breakdown")):
        paper.controls["shape"].value = word
        state = state_of(paper, event)
        ring = curves.axes.lines[-1].get_xydata()
        assert np.allclose(ring, [[state.volume, state.pressure]], rtol=1e-12)
        assert (state.pressure + 50) * (state.volume + 1600) == pytest.approx(51.886612680245 * 1602.42, rel=1e-9)
        (outline,) = [c for c in shape.axes.collections if len(c.get_segments()) > 100]
        points = np.array([s[0] for s in outline.get_segments()] + [outline.get_segments()[-1][1]])
        half = points[points[:, 0] >= 0]
        r, z = half[np.argsort(half[:, 1])].T
        assert np.trapezoid(np.pi * half[::-1, 0] ** 2, half[::-1, 1]) == pytest.approx(state.volume, rel=2e-3)
        assert r.min() >= 0 and z.max() > 1
    paper.controls["loading"].value = "constant voltage"
    assert paper.curves.layout.display == paper.shape.layout.display == "none"


def test_a_ramp_without_the_point_says_so(paper):
    paper.controls["chamber_volume"].value = 50.0  # too stiff to snap
    paper.controls["shape"].value = "landing"
    assert "this ramp has no landing" in [t.get_text() for t in paper._panels[2].axes.texts]
    assert not paper._panels[2].axes.collections


def test_the_curve_before_stays_in_grey(paper):
    """One move of a slider in many steps keeps the curve from before its first step."""
    before = paper.seen.branches[0]
    for volume in (1500.0, 1400.0):
        paper.controls["chamber_volume"].value = volume
    grey = line_of(paper._panels[0], "0.8")
    inside = (before.volume > 3) & (before.volume < 20) & (before.voltage_squared > 1e-4)
    gaps = [np.nanmin(np.hypot(*(grey - point).T)) for point in np.stack([before.volume, before.voltage], 1)[inside]]
    assert len(gaps) > 10 and max(gaps) < 1e-12
    paper.controls["initial_volume"].value = 2.3  # another slider
    assert state_of(paper, "start").volume == pytest.approx(2.3, rel=1e-9)
    assert not np.array_equal(line_of(paper._panels[0], "0.8"), grey)


def test_reset_returns_to_the_scene_that_was_given(paper):
    given, end = paper.scene, paper.controls["initial_volume"].max
    for name, value in (("chamber_volume", 25000.0), ("initial_volume", 2.0), ("breakdown_field_scale", 0.7)):
        paper.controls[name].value = value
    paper.controls["loading"].value = "constant pressure"
    paper.controls["reset"].click()
    assert eqx.tree_equal(paper.scene, given) and paper.controls["initial_volume"].max == end


@pytest.mark.parametrize("suffix", ["png", "pdf"])
def test_a_picture_is_saved(paper, tmp_path, suffix):
    paper.controls["file"].value = str(tmp_path / f"picture.{suffix}")
    paper.controls["save"].click()
    assert f"Saved {tmp_path}" in paper.message.value
    assert (tmp_path / f"picture.{suffix}").read_bytes()[:4] in (b"\x89PNG", b"%PDF")


@pytest.mark.parametrize(
    ("name", "words"), [("picture.doc", "must be a name ending in"), ("/no/folder/a.pdf", "can be written")]
)
def test_a_picture_that_cannot_be_saved_is_said(paper, name, words):
    paper.controls["file"].value = name
    paper.controls["save"].click()
    assert words in paper.message.value


SCENES = {
    "chamber": dj.Scene(dj.Membrane(dj.Gent(200.0), 1.5), dj.Chamber(volume=1600.0, initial_pressure=1.0)),
    "ogden": dj.Scene(
        dj.Membrane(dj.model.Ogden((0.3, 0.2), (2.0, 4.0)), breakdown=dj.ConstantBreakdown(3.0)),
        dj.ConstantVoltage(0.1),
    ),
    "si": dj.Scene.from_si(
        dj.Membrane(dj.model.Electrostrictive(dj.Gent(90.0), 0.02), breakdown=dj.VHBBreakdown(1.2)),
        dj.ConstantPressure(800.0),
        dj.Units.for_opening("22.5 mm", 1.0, thickness=0.5e-3),
    ),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=list(SCENES))
def test_the_code_of_a_scene_makes_it(scene):
    made = {}
    exec(code_of(scene, diagram=False), made)
    assert jax.tree.structure(made["scene"]) == jax.tree.structure(scene)
    assert np.allclose(jax.tree.leaves(made["scene"]), jax.tree.leaves(scene), rtol=1e-11, atol=0)


def test_the_code_of_the_sliders_makes_their_diagram(paper):
    paper.controls["chamber_volume"].value = 800.0
    paper.controls["code"].value = True
    made = {}
    exec(paper.controls["lines"].value, made)
    paper.controls["code"].value = False
    assert made["diagram"].ramp()["snap"][0].state.voltage == pytest.approx(SNAPS[800.0], rel=1e-9)


def test_a_material_of_functions_has_no_code():
    film = dj.Membrane(dj.CustomMaterial(lambda a, b: (a**2 + b**2 + (a * b) ** -2) / 2, largest_stretch=9.0))
    with pytest.raises(ValueError, match="must be made of numbers"):
        code_of(dj.Scene(film, dj.ConstantPressure(1.0)))


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


def test_what_the_surface_does_not_decide_is_left_to_the_whole_diagram(membrane):
    """Just below the peak of the pressure at V = 2.963 the start lies between two rows of the surface."""
    scene = dj.Scene(membrane, dj.ConstantPressure(PEAK[0] * (1 - 1e-7)))
    seen = dj.glance(scene, dj.Surface.build(membrane))
    assert seen.regime == dj.Regime.not_decided and "whole diagram" in story(seen)


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
    seen = dj.apps.explore(scene, prestretches=[1.0, 2.0])
    seen.controls["prestretch"].value = 2.0
    assert float(seen.scene.units.radius) == pytest.approx(11.25e-3, rel=1e-12)
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
