"""Ramps of many chambers on the surface: known numbers, and the continuation of the same scenes."""

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import Outcome, chamber_ramps


@pytest.fixture(scope="module")
def surface():
    return dj.Surface.build(dj.Membrane(), cache=False)


def test_reference_numbers(surface):
    """Snap, landing, breakdown and area strain at V_0 = 2.42, from methods that share no code."""
    ramps = chamber_ramps(surface, [500.0, 800.0, 1600.0, 25000.0], 2.42)
    assert (ramps.outcome == Outcome.breakdown_on_branch).all()
    assert np.isnan(ramps.snap.voltage[0]) and list(ramps.snaps) == [0, 1, 1, 1]
    assert np.allclose(ramps.snap.voltage[1:3], [0.0971990067469, 0.0764953595449], rtol=1e-10)
    assert np.allclose(ramps.landing.volume[1:3], [9.07429967742, 19.9533292542], rtol=1e-10)
    assert np.allclose(ramps.breakdown.voltage[1:3], [0.115172761046, 0.100970094106], rtol=1e-10)
    assert abs(ramps.landing_ratio[2] - 0.568782) < 1e-6
    assert abs(ramps.breakdown.apex_stretch[2] / 8.10285526922 - 1) < 1e-10
    assert np.allclose(ramps.area_strain, [12.6847453, 14.0104827, 16.1218889, 25.567264], rtol=1e-7)
    assert np.allclose(ramps.start.pressure, 1.886612680245, rtol=1e-11)
    assert (ramps.error < 1e-9).all()


def test_known_edges_of_regimes(surface):
    """Breaks in the snap below V_C = 467.850181739; no snap between the cusps 484.04966 and 551.39914 (V_0 = 2.42)."""
    ramps = chamber_ramps(surface, [467.84, 467.86, 484.0, 486.0, 550.0, 552.0], 2.42)
    assert list(ramps.outcome[:2]) == [Outcome.breakdown_in_snap, Outcome.breakdown_on_branch]
    decided = ramps.outcome != Outcome.unresolved
    assert decided.sum() >= 4
    assert list(ramps.snaps[decided]) == list(np.array([1, 1, 1, 0, 0, 1])[decided])
    # at V_C = 25000 the membrane survives the snap only when filled beyond V_0 = 2.361001148
    ramps = chamber_ramps(surface, 25000.0, [2.36100, 2.36101])
    assert list(ramps.outcome) == [Outcome.breakdown_in_snap, Outcome.breakdown_on_branch]


@pytest.mark.parametrize(("prestretch", "most"), [(1.0, 2.9), (2.0, 15.0)])
def test_the_continuation_of_the_same_scenes(prestretch, most, surface):
    """Fillings up to about the volume at the peak of the pressure; unresolved chambers are left out, and are few."""
    membrane = dj.Membrane(prestretch=prestretch)
    surface = surface if prestretch == 1 else dj.Surface.build(membrane, cache=False)
    random = np.random.default_rng(3)
    chambers, fillings = np.exp(random.uniform(np.log(10), np.log(25000), 5)), random.uniform(0.1, most, 5)
    ramps = chamber_ramps(surface, chambers, fillings)
    reasons = {
        Outcome.breakdown_on_branch: ("breakdown on the branch",),
        Outcome.breakdown_in_snap: ("breakdown in the snap",),
        Outcome.no_unbroken_landing: ("no landing", "breakdown in the snap"),
        Outcome.start_unstable: ("start_unstable",),
    }
    assert (ramps.outcome != Outcome.unresolved).sum() >= 3
    for i in np.flatnonzero(ramps.outcome != Outcome.unresolved):
        chamber = dj.Chamber(volume=chambers[i], initial_volume=fillings[i])
        up = dj.voltage_volume(dj.Scene(membrane, chamber)).ramp()
        assert up.area_strain_reason in reasons[Outcome(int(ramps.outcome[i]))]
        assert abs(ramps.area_strain[i] / up.area_strain - 1) < 1e-8
        snaps = up["snap"]
        assert len(snaps) == ramps.snaps[i]
        if snaps:
            assert abs(ramps.snap.voltage[i] / snaps[0].state.voltage - 1) < 1e-8
        if np.isfinite(ramps.landing.volume[i]):
            assert abs(ramps.landing.volume[i] / up["landing"][0].state.volume - 1) < 1e-8


def test_a_chamber_does_not_depend_on_its_neighbours(surface):
    chambers = np.geomspace(20.0, 25000.0, 300)
    together = chamber_ramps(surface, chambers, 2.0)
    alone = chamber_ramps(surface, chambers[::37], 2.0)
    assert np.array_equal(together.area_strain[::37], alone.area_strain, equal_nan=True)
    shaped = chamber_ramps(surface, chambers[:6].reshape(2, 3), 2.0)
    assert shaped.snap.voltage.shape == (2, 3)
    assert np.array_equal(shaped.outcome.ravel(), together.outcome[:6])


def test_unresolved_chambers_hold_no_numbers(surface):
    ramps = chamber_ramps(surface, np.geomspace(10, 25000, 200), np.linspace(0.02, 2.9, 200))
    lost = ramps.outcome == Outcome.unresolved
    assert np.isnan(ramps.area_strain[lost]).all() and np.isnan(ramps.snap.voltage[lost]).all()
    assert np.isfinite(ramps.area_strain[~lost & (ramps.outcome != Outcome.start_unstable)]).all()
    # a filling that the membrane does not reach
    assert chamber_ramps(surface, 1000.0, 500.0).outcome == Outcome.unresolved


def test_bad_input(surface):
    with pytest.raises(ValueError, match="`chamber_volume` must be positive and finite"):
        chamber_ramps(surface, [100.0, -1.0], 2.0)
    with pytest.raises(ValueError, match="`initial_volume` must be positive and finite, but is nan"):
        chamber_ramps(surface, 100.0, float("nan"))
    with pytest.raises(ValueError, match="`polytropic_exponent`"):
        chamber_ramps(surface, 100.0, 2.0, polytropic_exponent=0.0)
    with pytest.raises(ValueError, match="empty"):
        chamber_ramps(surface, [], 2.0)
