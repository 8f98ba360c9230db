"""Reports say in words what the diagram holds in numbers."""

import matplotlib
import matplotlib.pyplot
import numpy as np
import pytest

import dielectric_jax as dj

SCENES = {
    "stays": dj.Chamber(volume=1600.0, initial_volume=2.42),
    "no_landing": dj.Chamber(volume=30.0, initial_volume=2.42),
    "breaks_in_snap": dj.ConstantPressure(1.5),
    "no_snap": dj.PrescribedVolume(10.0),
    "start_unstable": dj.Chamber(volume=1600.0, initial_volume=5.0),
}
SENTENCES = {
    "stays": ("snaps at a voltage of 0.0765 from", "and survives", "It then breaks down", "area strain 1612 %"),
    "no_landing": ("snaps at", "and finds no stable state to land on", "area strain 111 % before the snap"),
    "breaks_in_snap": ("snaps at", "and breaks down there (E/E_EB = 4.96)", "before the snap"),
    "no_snap": ("The membrane breaks down at", "without a snap"),
    "start_unstable": ("not stable at zero voltage", "no ramp starts"),
}


@pytest.fixture(scope="module")
def si():
    chamber = dj.Chamber(volume=18.225e-3, initial_volume=27.565e-6, atmospheric_pressure=100e3)
    return dj.report(dj.Scene.from_si(dj.Membrane(), chamber))


@pytest.mark.parametrize("regime", SCENES)
def test_the_first_sentence_says_what_happens(regime):
    scene = dj.Scene(dj.Membrane(), SCENES[regime])
    found = dj.report(scene)
    assert found.regime == dj.regime_of(scene) == dj.Regime[regime]
    assert all(part in found.sentences[0] for part in SENTENCES[regime]), found.sentences[0]
    assert str(found).startswith(found.sentences[0]) and found.scene is scene
    assert found.regime.words in found.lines[-1]


def test_numbers_are_those_of_the_paper_in_its_units(si):
    """Section 6 of the paper: the snap at 2.5 kV, breakdown, 1692 % by its own reading of the figure."""
    assert "snaps at 2.516 kV from a volume of 35.93 ml to 227.3 ml" in si.sentences[0]
    assert si.sentences[1] == "If the voltage is instead lowered to zero after the snap, the membrane stays expanded."
    text = str(si)
    assert "voltage / kV" in text and "breakdown (up)" in text and "37.7322" in text
    assert "<p>The membrane snaps" in si._repr_html_() and "kV" in si._repr_html_()


def test_a_report_draws_on_the_axes_given(si):
    figure = matplotlib.figure.Figure()
    ax = figure.add_subplot()
    assert si.plot(ax=ax) is ax and ax.get_ylabel() == "Voltage $Φ$ / kV"
    with pytest.raises(ValueError, match="`ax` must be left out with `shapes`"):
        si.plot(ax=ax, shapes=True)


def test_other_ways_of_loading():
    charged = dj.report(dj.Scene(dj.Membrane(), dj.ChargeControl(SCENES["stays"])))
    assert (
        "snaps at a charge of 2.703" in charged.sentences[0] and "the charge is instead lowered" in charged.sentences[1]
    )
    head, first, *_ = str(charged).split("\n\n")[1].splitlines()
    assert head.split()[:2] == ["voltage", "charge"] and first.split()[:2] == ["start", "(up)"]
    flat = dj.report(dj.Scene(dj.Membrane(prestretch=2.0), dj.ConstantPressure(0.0)))
    assert "goes slack at a voltage of 0.5008" in flat.sentences[0] and "starts flat" in flat.sentences[1]
    held = dj.report(dj.Scene(dj.Membrane(), dj.ConstantVoltage(0.0)))
    assert held.regime is None and held.sentences[0].startswith("The pressure has a peak of 1.909")
    assert (
        held.sentences[1].startswith("The pressure has a minimum of 1.362") and held.diagram.kind == "pressure-volume"
    )


def test_the_way_back_and_a_fold_after_breakdown():
    back = dj.report(dj.Scene(dj.Membrane(), dj.Chamber(volume=1000.0, initial_volume=2.42)))
    assert (
        back.regime == dj.Regime.returns
        and back.sentences[1] == "If the voltage is instead lowered after the snap, the membrane snaps back at 0.06917."
    )
    early = dj.Membrane(breakdown=dj.VHBBreakdown(scale=0.6))
    before = dj.report(dj.Scene(early, dj.Chamber(volume=30.0, initial_volume=2.42)))
    assert before.regime == dj.Regime.breaks_before_snap and "before it would snap" in before.sentences[0]


def test_pictures(si):
    matplotlib.use("Agg")
    figure = si.plot(shapes=True, points=40)
    above, below = figure.subfigs
    assert [ax.get_title().split("\n")[0] for ax in below.axes] == ["start", "snap", "landing", "breakdown"]
    # the curve at zero voltage passes through the start, 27.565 ml at 37.73 mbar
    start = si.diagram.scene.units.read(si.diagram.ramp().events[0].state)
    drawn = [
        line.get_data() for line in above.axes[0].lines if line.get_color() != "black" and len(line.get_xdata()) > 9
    ]
    apart = [np.hypot(x / start.volume - 1, y / start.pressure - 1) for x, y in drawn]
    assert min(map(np.nanmin, apart)) < 0.05
    labels = [text.get_text() for text in above.axes[1].get_legend().get_texts()]
    assert "fold" in labels and "hoop tension lost" not in labels  # which lies outside the frame
    assert dj.report(dj.Scene(dj.Membrane(), dj.ConstantVoltage(0.0))).plot().axes
    matplotlib.pyplot.close("all")
