"""Neutral modes along branches against reference points."""

import json
import pathlib

import pytest

import dielectric_jax as dj

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "modes.json").read_text(encoding="utf-8"))
LOADINGS = {
    "chamber 25000": dj.Chamber(volume=25000.0, initial_volume=2.42),
    "pressure 1.82": dj.ConstantPressure(1.82),
}


@pytest.mark.parametrize("name", LOADINGS)
def test_reference_points(name, membrane):
    known = {c["n"]: c for c in REFERENCE["critical"] if c["scene"] == name and c["kind"] == "mode neutral"}
    found = dj.neutral_modes(dj.Scene(membrane, LOADINGS[name]), sorted(known))
    assert sorted(p.number for p in found) == sorted(known)
    for point in found:
        assert point.kind == "mode" and point.to_json()["number"] == point.number
        for quantity in ("voltage", "pressure", "volume", "apex_stretch"):
            assert getattr(point, quantity) == pytest.approx(known[point.number][quantity], rel=1e-8)


def test_bad_input_is_refused(membrane):
    with pytest.raises(ValueError, match="`numbers` must be whole numbers from 1"):
        dj.neutral_modes(dj.Scene(membrane, dj.ConstantPressure(1.0)), [0])
    with pytest.raises(ValueError, match="`scene` must be a Scene"):
        dj.neutral_modes(membrane)
    other = dj.pressure_volume(membrane)
    with pytest.raises(ValueError, match="`diagram` must be the scene's own"):
        dj.neutral_modes(dj.Scene(membrane, dj.ConstantVoltage(0.1)), diagram=other)
