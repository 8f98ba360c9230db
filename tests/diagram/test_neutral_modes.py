"""Neutral modes along branches against reference points."""

import json
import pathlib

import matplotlib.pyplot as plt
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.diagram import mode_points
from dielectric_jax.modes import lowest_of_numbers

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "modes.json").read_text(encoding="utf-8"))
LOADINGS = {
    "chamber 25000": dj.Chamber(volume=25000.0, initial_volume=2.42),
    "chamber 1600": dj.Chamber(volume=1600.0, initial_volume=2.42),
    "chamber 20 L": dj.Chamber(volume=1755.8299039780522, initial_volume=2.42),
    "pressure 1.82": dj.ConstantPressure(1.82),
    "pressure 2": dj.ConstantPressure(2.0),
}


@pytest.mark.parametrize("name", LOADINGS)
def test_reference_points(name, membrane):
    known = {c["n"]: c for c in REFERENCE["critical"] if c["scene"] == name and c["kind"] == "mode neutral"}
    found = dj.neutral_modes(dj.Scene(membrane, LOADINGS[name]), sorted(known))
    assert sorted(p.number for p in found) == sorted(known)
    for point in found:
        assert point.kind == "mode" and point.to_json()["number"] == point.number
        for quantity in ("voltage", "pressure", "volume", "apex_stretch"):
            # some points of the reference are known to seven digits
            exact = 3 * 10.0 ** -min(known[point.number]["digits"], 8.5)
            assert getattr(point, quantity) == pytest.approx(known[point.number][quantity], rel=exact)


@pytest.mark.parametrize("prestretch", [1.0, 1.5, 2.0, 3.0])
def test_reference_points_at_an_apex_stretch(prestretch):
    """Modes are neutral at the states of the reference, whatever holds these."""
    film = dj.Membrane(dj.Gent(270.0), prestretch)
    known = [
        c
        for c in REFERENCE["critical"]
        if c["kind"] == "mode neutral" and "apex stretch" in c["scene"] and c["prestretch"] == prestretch
    ]
    states = [
        dj.equilibrium(film, apex_stretch=c["apex_stretch"], voltage=float(np.sqrt(c["voltage_squared"])))
        for c in known
    ]
    for entry, state in zip(known, states, strict=True):
        assert state.pressure == pytest.approx(entry["pressure"], rel=1e-8)
        spectrum = dj.mode_spectrum(film, state, [entry["n"]], count=1)
        # the eigenvalue changes by some 1e4 of the relative change of the load
        assert abs(spectrum.eigenvalues[0, 0]) < 1e-5, entry["scene"]


def test_a_ramp_ends_where_the_membrane_loses_its_axisymmetry():
    """Of a large chamber mode 11 comes first, of 20 L hoop tension is lost first, if the film does not break down before."""
    membrane = dj.Membrane(dj.Gent(270.0), breakdown=dj.VHBBreakdown(3.0))
    for chamber, reason, numbers in ((25000.0, "bulges", {11}), (1755.8299039780522, "wrinkles", {None})):
        scene = dj.Scene(membrane, dj.Chamber(volume=chamber, initial_volume=2.42))
        plain, asked = dj.voltage_volume(scene), dj.voltage_volume(scene, modes=range(1, 25))
        ramp = asked.ramp()
        assert ramp.area_strain_reason == reason and ramp.events[-1].reason == reason
        assert dj.regime_of(scene, modes=range(1, 25)).name == reason
        others = [p for p in asked.special_points if p.kind != "mode"]
        ax = asked.plot(x="volume", y="voltage").axes[0]
        stars = sum(np.size(line.get_xdata()) for line in ax.lines if line.get_marker() == "*")
        plt.close("all")
        # the event of the ramp's end stands in place of the mode that turns there
        assert stars == len(asked.special_points) - len(others) - (reason == "bulges")
        assert [p.to_json() for p in others] == [p.to_json() for p in plain.special_points]
        ends = [p for p in asked.special_points if p.apex_stretch == ramp.events[-1].state.apex_stretch]
        assert {p.number for p in ends} == numbers
    modes = [p for p in asked.special_points if p.kind == "mode"]
    assert modes and min(p.voltage for p in modes) > ramp.events[-1].state.voltage


def hidden(where, monkeypatch):
    """The signs of eigenvalues are not known `where(apex stretch, values)` holds."""

    def lowest(film, u, numbers):
        values = lowest_of_numbers(film, u, numbers)
        return np.ma.MaskedArray(values.data, mask=where(u[0][:, None], values.data))

    monkeypatch.setattr(mode_points, "lowest_of_numbers", lowest)


@pytest.mark.parametrize("from_stretch", [1.0, 6.0])
def test_an_undecided_mode_is_not_taken_for_a_stable_one(from_stretch, membrane, monkeypatch):
    """Neither in the start nor on the way to breakdown, at a stretch of 10.2."""
    scene = dj.Scene(membrane, dj.Chamber(volume=1600.0, initial_volume=2.42))
    whole = dj.voltage_volume(scene)
    hidden(lambda apex, values: (apex > from_stretch) & (values < np.inf), monkeypatch)
    diagram = dj.voltage_volume(scene, modes=[2])
    up = [e for e in diagram.events if e.direction == "up"]
    assert up[-1].event == "end" and up[-1].reason == diagram.area_strain_reason == "modes not decided"
    assert from_stretch < up[-1].state.apex_stretch < whole.ramp()["breakdown"][0].state.apex_stretch
    assert dj.regime_of(scene, modes=[2]) == dj.Regime.not_decided


def test_a_mode_that_turns_where_its_sign_is_not_known_is_found(membrane, monkeypatch):
    scene = dj.Scene(membrane, dj.Chamber(volume=25000.0, initial_volume=2.42))
    exact = dj.neutral_modes(scene, [10])
    hidden(lambda apex, values: np.abs(values) < 0.3, monkeypatch)
    assert [p.to_json() for p in dj.neutral_modes(scene, [10])] == [p.to_json() for p in exact] != []


def test_breakdown_comes_before_any_mode_in_the_article_s_chamber(membrane):
    scene = dj.Scene(membrane, dj.Chamber(volume=1600.0, initial_volume=2.42))
    plain, asked = dj.voltage_volume(scene), dj.voltage_volume(scene, modes=range(1, 13))
    assert [e.event for e in asked.events] == [e.event for e in plain.events]
    assert asked.area_strain == plain.area_strain
    assert dj.regime_of(scene, modes=range(1, 13)) == dj.regime_of(scene)


def test_bad_input_is_refused(membrane):
    with pytest.raises(ValueError, match="`numbers` must be whole numbers from 1"):
        dj.neutral_modes(dj.Scene(membrane, dj.ConstantPressure(1.0)), [0])
    with pytest.raises(ValueError, match="`scene` must be a Scene"):
        dj.neutral_modes(membrane)
    with pytest.raises(ValueError, match="`modes` must be whole numbers from 1"):
        dj.voltage_volume(dj.Scene(membrane, dj.ConstantPressure(1.0)), modes=[1.5])


def test_a_neutral_point_that_is_not_located_ends_the_ramp(monkeypatch):
    """Of a large chamber mode 10 turns unstable at 0.116448; where it is seen and not located the ramp does not go on."""
    membrane = dj.Membrane(breakdown=dj.VHBBreakdown(3.0))
    scene = dj.Scene(membrane, dj.Chamber(volume=25000.0, initial_volume=2.42))
    monkeypatch.setattr(mode_points, "locate", lambda solver, curves, asked, tolerance: ([], asked))
    ramp = dj.voltage_volume(scene, modes=[10]).ramp()
    assert ramp.area_strain_reason == "modes not decided"
    assert 0.113 < ramp.events[-1].state.voltage < 0.116448  # at the last point of the mesh before it
