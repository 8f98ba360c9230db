"""Sweeps in time against single runs, the identity of rate and relaxation time, and what they refuse."""

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import rates
from dielectric_jax.apps.cli import main
from dielectric_jax.rates import InTime, RunOutcome, TimeRegime

RUBBER = dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
SCENE = dj.Scene(dj.Membrane(RUBBER), dj.Chamber(volume=1600.0, initial_volume=2.42))
FAST = InTime(check=False)
SPECIFICATION = """
[scene]
material = "viscoelastic"
chamber_volume = 1600.0
initial_volume = 2.42
[[scene.branches]]
modulus_ratio = 1.0
relaxation_time = 1.0
[in_time]
check = false
[product]
rate = [1e-5, 0.01, 0.1]
relaxation_time = [1.0, 10.0]
"""


def test_rates_and_relaxation_times(tmp_path):
    """Only r τ enters; a slow ramp creeps through, a fast one jumps at the voltage of `rates.snap_voltage`."""
    options = {"rate": [1e-5, 0.01, 0.1], "relaxation_time": [1.0, 10.0], "engine": FAST, "progress": False}
    data = dj.sweep(SCENE, **options)
    of_both = data.snap_voltage.values  # (rate, relaxation time)
    assert of_both[1, 1] == pytest.approx(of_both[2, 0], rel=1e-5)
    assert of_both[1, 0] == pytest.approx(float(rates.snap_voltage(SCENE, 0.01)), rel=1e-6)
    assert float(data.snap_time.sel(rate=0.01, relaxation_time=1.0)) == pytest.approx(100 * of_both[1, 0])
    assert (data.regime.values[0] == TimeRegime.creeps_through).all()
    run = rates.follow(SCENE, voltage=rates.Ramp(rate=0.01))
    known = data.sel(rate=0.01, relaxation_time=1.0)
    assert rates.regime_in_time(run) == int(known.regime) == TimeRegime.breaks_in_snap
    assert float(known.landing_volume) == pytest.approx(run.snap.landing.volume, rel=1e-6)
    assert int(known.outcome) == RunOutcome.breakdown_in_snap and run.reason == "breakdown in the snap"
    assert dj.sweeps.count_sweep(data)["regime"]["creeps_through"] == 2
    (tmp_path / "spec.toml").write_text(SPECIFICATION)
    assert main(["sweep", str(tmp_path / "spec.toml"), "--output", str(tmp_path / "s.zarr"), "--json", "-"]) == 0
    stored = dj.sweeps.open_sweep(tmp_path / "s.zarr")
    assert stored.snap_voltage.values.tobytes() == of_both.tobytes()


def test_held_voltages_and_scenes_without_a_start():
    """A membrane that holds a voltage for a time and not for ten; a filling beyond the membrane leaves the others alone."""
    when = float(rates.delay(SCENE, 0.1))
    engine = InTime(held_voltage=0.1, check=False, duration=0.5 * when)
    short = dj.sweep(SCENE, initial_volume=[2.42, 1e9], engine=engine, progress=False)
    np.testing.assert_array_equal(short.outcome, [RunOutcome.end_of_protocol, RunOutcome.no_answer])
    np.testing.assert_array_equal(short.regime, [TimeRegime.survives, TimeRegime.not_decided])
    long = dj.sweep(SCENE, held_voltage=[0.05, 0.1], engine=InTime(duration=10 * when), progress=False)
    assert float(long.snap_time[1]) == pytest.approx(when, rel=1e-5)
    assert int(long.regime[0]) == TimeRegime.survives and int(long.regime[1]) != TimeRegime.survives
    assert (long.error < 1e-4).all()


def test_bad_input():
    for words, options in (
        ("`engine` must be 'surface', 'continuation' or an engine", {"engine": InTime, "rate": [1.0]}),
        ("`rate` or `held_voltage` must be given, one of the two, but none", {"engine": FAST, "stretch_limit": [90.0]}),
        ("one of the two, but both", {"engine": InTime(rate=1.0), "held_voltage": [1.0]}),
        ("`resolve` must be left out with the engine InTime", {"engine": FAST, "rate": [1.0], "resolve": True}),
        ("`tolerance` must be left out with the engine", {"engine": FAST, "rate": [1.0], "tolerance": 1e-6}),
        ("`rate` must be positive", {"engine": FAST, "rate": [1.0, 0.0]}),
        ("`held_voltage` must be zero or positive", {"engine": FAST, "held_voltage": [-0.1]}),
        ("`wrong` must be one of", {"engine": FAST, "rate": [1.0], "wrong": [1.0]}),
        ("`relaxation_time` must not vary here", {"relaxation_time": [1.0]}),
    ):
        with pytest.raises(ValueError, match=words):
            dj.sweep(SCENE, **options)
    for wrong in (
        {"tolerance": 1.0},
        {"start": "warm"},
        {"duration": 0.0},
        {"check": "no"},
        {"held_voltage": "high"},
        {"tolerance": "fine"},
    ):
        with pytest.raises(ValueError, match=f"`{next(iter(wrong))}` must"):
            InTime(**wrong)


def test_files_are_refused(tmp_path):
    for line, words in (
        ('engine = "surface"', "`engine` must be left out beside \\[in_time\\]"),
        ("curves = true", "`curves` must be left out beside"),
        ("", "`speed` in \\[in_time\\] must be one of rate, held_voltage, duration"),
    ):
        text = line + SPECIFICATION if line else SPECIFICATION.replace("check = false", "speed = 1")
        (tmp_path / "spec.toml").write_text(text)
        with pytest.raises(ValueError, match=words):
            dj.sweeps.read_specification(tmp_path / "spec.toml", {"in_time": InTime})
    (tmp_path / "spec.toml").write_text(SPECIFICATION)
    with pytest.raises(ValueError, match=r"`in_time` in .* must be one of"):  # without its engine
        dj.sweeps.read_specification(tmp_path / "spec.toml")


def test_scenes_without_an_answer_have_the_numbers_of_other_sweeps():
    """The blocks of a sweep write these numbers, whatever its engine."""
    for name in ("not_computed", "no_answer", "invalid_scene", "failed"):
        assert RunOutcome[name] == dj.sweeps.Answer[name]
    assert RunOutcome.not_followed == dj.sweeps.Answer.unresolved


def test_rates_in_si():
    """In V and m³, by a sweep and by `rates.snap_voltage`, against the same ramp without units."""
    rubber = dj.Viscoelastic(dj.Gent(270.0), [dj.Maxwell(dj.Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    free = dj.Scene(dj.Membrane(rubber), dj.Chamber(volume=1600.0, initial_volume=2.42))
    units = dj.Units()
    made = dj.Scene.from_si(free.membrane, units.to_si(free.loading), units)
    volt = float(units.to_si(1.0, "voltage"))
    known = dj.follow(free, voltage=dj.Ramp(rate=0.01)).snap.at
    data = dj.sweep(made, rate=[0.01 * volt], engine=dj.rates.InTime(check=False), progress=False)
    assert float(data.snap_voltage[0]) == pytest.approx(known.voltage * volt, rel=1e-6)
    assert float(data.snap_volume[0]) == pytest.approx(float(units.to_si(known.volume, "volume")), rel=1e-6)
    assert data.snap_voltage.attrs["units"] == "V"
    assert float(dj.rates.snap_voltage(made, 0.01 * volt)) == pytest.approx(known.voltage * volt, rel=1e-6)
