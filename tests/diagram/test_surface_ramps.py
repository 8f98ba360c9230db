"""Ramps of many chambers on the surface: known numbers, and the continuation of the same scenes."""

import csv
import pathlib

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import Regime
from dielectric_jax.diagram import chamber_curves, chamber_ramps, pressure_ramps
from dielectric_jax.diagram.regimes import regime_of_diagram
from dielectric_jax.model import Outcome


@pytest.fixture(scope="module")
def surface():
    return dj.Surface.build(dj.Membrane(), cache=False)


def test_reference_numbers(surface):
    """Snap, landing, breakdown and area strain at V_0 = 2.42, from methods that share no code."""
    ramps = chamber_ramps(surface, [500.0, 800.0, 1600.0, 25000.0], 2.42)
    assert (ramps.outcome == Outcome.breakdown_on_branch).all()
    assert np.isnan(ramps.snap.voltage[0]).all() and list(ramps.snaps) == [0, 1, 1, 1]
    assert np.allclose(ramps.snap.voltage[1:3, 0], [0.0971990067469, 0.0764953595449], rtol=1e-10)
    assert np.allclose(ramps.landing.volume[1:3, 0], [9.07429967742, 19.9533292542], rtol=1e-10)
    assert np.allclose(ramps.breakdown.voltage[1:3], [0.115172761046, 0.100970094106], rtol=1e-10)
    assert abs(ramps.landing_ratio[2, 0] - 0.568782) < 1e-6
    assert abs(ramps.breakdown.apex_stretch[2] / 8.10285526922 - 1) < 1e-10
    assert np.allclose(ramps.area_strain, [12.6847453, 14.0104827, 16.1218889, 25.567264], rtol=1e-7)
    assert np.allclose(ramps.start.pressure, 1.886612680245, rtol=1e-11)
    assert (ramps.error < 1e-9).all()
    # 500 has no fold, 800 and 1600 two; 1600 and 25000 dip below zero voltage, so that the membrane stays snapped on the way down
    assert list(np.isfinite(ramps.folds.volume).sum(axis=1)) == [0, 2, 2, 2]
    assert list(np.isfinite(ramps.zero_voltage.volume).sum(axis=1)) == [1, 1, 3, 3]
    assert list(np.isfinite(ramps.snap_back.voltage[:, 0])) == [False, True, False, False]
    stays = np.abs(ramps.rest.apex_stretch / ramps.start.apex_stretch - 1) > 1e-9
    assert list(stays) == [False, False, True, True]


def test_breakdown_between_the_last_rows_of_a_stiff_branch(surface):
    """Near lock-up the load rises from below breakdown to beyond the surface from one row to the next.

    The breakdown voltages are those of `benchmarks/truth/data/chambers.csv`, in extended precision.
    """
    path = pathlib.Path(__file__).parents[2] / "benchmarks" / "truth" / "data" / "chambers.csv"
    with path.open(encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if r["kind"] == "breakdown" and float(r["chamber_volume"]) > 9000]
    ramps = chamber_ramps(surface, [float(r["chamber_volume"]) for r in rows], 2.42)
    assert len(rows) == 59 and (ramps.outcome == Outcome.breakdown_on_branch).all() and (ramps.error < 1e-8).all()
    known = np.sqrt([float(r["voltage_squared"]) for r in rows])
    assert np.max(np.abs(ramps.breakdown.voltage - known)) < 1e-10


def test_a_snap_between_the_last_row_and_breakdown_is_not_passed_over():
    """V_C = 19.947 at λ0 = 2.283, J = 60.54: a fold at E/E_EB = 0.9934, beyond the surface; continuation finds no landing."""
    film = dj.Membrane(dj.Gent(60.54045108005528), prestretch=2.282916441756461)
    scene = dj.Scene(film, dj.Chamber(volume=19.947003252761082, initial_volume=4.517466025936198))
    assert dj.voltage_volume(scene).area_strain_reason == "no landing"
    ramps = chamber_ramps(dj.Surface.build(film), scene.loading.volume, scene.loading.initial_volume)
    assert ramps.outcome in (Outcome.unresolved, Outcome.no_landing)


def test_known_edges_of_regimes(surface):
    """Breakdown in the snap below V_C = 467.850181739; no snap between the cusps 484.04966 and 551.39914 (V_0 = 2.42)."""
    ramps = chamber_ramps(surface, [467.84, 467.86, 484.0, 484.1, 551.3, 552.0], 2.42)
    assert list(ramps.outcome[:2]) == [Outcome.breakdown_in_snap, Outcome.breakdown_on_branch]
    decided = ramps.outcome != Outcome.unresolved
    assert decided.all()
    assert list(ramps.snaps) == [1, 1, 1, 0, 0, 1]
    # at V_C = 25000 the membrane survives the snap only when filled beyond V_0 = 2.361001148
    ramps = chamber_ramps(surface, 25000.0, [2.36100, 2.36101])
    assert list(ramps.outcome) == [Outcome.breakdown_in_snap, Outcome.breakdown_on_branch]
    # bistable from V_C = 1455.896262454, so that the membrane stays snapped on the way down
    ramps = chamber_ramps(surface, [1455.89, 1455.91], 2.42)
    assert list(np.isfinite(ramps.snap_back.voltage[:, 0])) == [True, False]


def agrees(points, i, states, field="volume"):
    """The numbers of a kind of event, compared with the states of a diagram's ramp."""
    mine = np.atleast_1d(getattr(points, field)[i])
    mine = mine[np.isfinite(mine)]
    return len(mine) == len(states) and np.allclose(mine, [getattr(s, field) for s in states], rtol=1e-8, atol=1e-11)


@pytest.mark.parametrize(("prestretch", "most"), [(1.0, 2.9), (2.0, 15.0)])
def test_the_continuation_of_the_same_scenes(prestretch, most, surface):
    """Fillings up to about the volume at the peak of the pressure; unresolved chambers are left out, and are few."""
    membrane = dj.Membrane(prestretch=prestretch)
    surface = surface if prestretch == 1 else dj.Surface.build(membrane, cache=False)
    random = np.random.default_rng(3)
    chambers, fillings = np.exp(random.uniform(np.log(10), np.log(25000), 5)), random.uniform(0.1, most, 5)
    ramps = chamber_ramps(surface, chambers, fillings, polytropic_exponent=1.2)
    reasons = {
        Outcome.breakdown_on_branch: ("breakdown on the branch",),
        Outcome.breakdown_in_snap: ("breakdown in the snap",),
        Outcome.no_landing: ("no landing",),
        Outcome.start_unstable: ("start_unstable",),
    }
    assert (ramps.outcome != Outcome.unresolved).sum() >= 3
    for i in np.flatnonzero(ramps.outcome != Outcome.unresolved):
        chamber = dj.Chamber(volume=chambers[i], initial_volume=fillings[i], polytropic_exponent=1.2)
        diagram = dj.voltage_volume(dj.Scene(membrane, chamber))
        up = diagram.ramp()
        assert up.area_strain_reason in reasons[Outcome(int(ramps.outcome[i]))]
        assert abs(ramps.area_strain[i] / up.area_strain - 1) < 1e-8
        snaps = [e.state for e in up["snap"]]
        assert agrees(ramps.snap, i, snaps) and agrees(ramps.snap, i, snaps, "voltage")
        if ramps.outcome[i] != Outcome.breakdown_in_snap or np.isfinite(ramps.landing.volume[i]).any():
            assert agrees(ramps.landing, i, [e.state for e in up["landing"]])
        assert Regime(int(ramps.regime[i])) in (Regime.not_decided, regime_of_diagram(diagram))
        if ramps.outcome[i] == Outcome.breakdown_on_branch:
            down = diagram.ramp("down")
            assert agrees(ramps.snap_back, i, [e.state for e in down["snap_back"]], "voltage")
            assert agrees(ramps.landing_back, i, [e.state for e in down["landing"]])
            assert agrees(ramps.breakdown, i, [e.state for e in up["breakdown"]])
        own = [p for p in diagram.special_points if ramps.reach[i, 0] < p.apex_stretch < ramps.reach[i, 1]]
        for kind, points in (
            ("fold", ramps.folds),
            ("zero_voltage", ramps.zero_voltage),
            ("breakdown", ramps.breakdowns),
        ):
            theirs = np.array([p.volume for p in own if p.kind == kind])
            mine = points.volume[i][(points.error[i] < 1e-8)]
            assert len(mine) <= len(theirs) or not len(own)
            assert all(np.min(np.abs(theirs / v - 1)) < 1e-8 for v in mine)


def test_constant_pressure(surface):
    """At constant pressure the paper's p = 1.82 and 1.5 break down in the snap; everything is compared with the diagram."""
    pressures = [1.0, 1.5, 1.82]
    ramps = pressure_ramps(surface, pressures)
    assert (ramps.regime == Regime.breaks_in_snap).all()
    for i, pressure in enumerate(pressures):
        up = dj.voltage_volume(dj.Scene(surface.membrane, dj.ConstantPressure(pressure))).ramp()
        assert up.area_strain_reason == "breakdown in the snap"
        assert agrees(ramps.start, i, [up.events[0].state])
        assert agrees(ramps.snap, i, [e.state for e in up["snap"]], "voltage")


def test_a_start_just_below_the_peak_of_the_pressure_is_not_passed_over(surface):
    """The peak of 1.908684829414 lies at V = 2.9634 between two rows; beyond it the only state is at V = 224.6."""
    shares = np.array([-1e-3, -1e-4, -1e-5, -1e-6, -1e-8, -1e-10])
    fillings = dj.diagram.filling_volumes(surface, 1.908684829414 * (1 + shares))
    ramps = pressure_ramps(surface, 1.908684829414 * (1 + shares))
    told = np.isfinite(fillings)
    assert told[:2].all() and (fillings[told] < 2.9634).all()
    assert (ramps.outcome[~told] == Outcome.unresolved).all()
    assert np.allclose(ramps.start.volume[told], fillings[told], rtol=1e-9)
    assert abs(dj.diagram.filling_volumes(surface, 1.908684829414 * (1 + 1e-4)) - 224.6) < 0.1


def test_curves_are_states(surface):
    """Points of the curves against the explicit map, and against the chamber's law."""
    curves = chamber_curves(surface, [300.0, 1600.0], [2.0, 2.42])
    assert curves.volume.shape == (2, 256)
    for lane, (chamber, filling) in enumerate(((300.0, 2.0), (1600.0, 2.42))):
        seen = np.flatnonzero(np.isfinite(curves.volume[lane]))
        assert len(seen) > 60
        p, v, q = (w[lane, seen] for w in (curves.pressure, curves.volume, curves.voltage_squared))
        constant = (p + 50) * (v + chamber)
        assert np.allclose(constant, constant[0], rtol=1e-13)
        start = float(chamber_ramps(surface, chamber, filling).start.pressure)
        assert np.allclose(constant, (start + 50) * (filling + chamber), rtol=1e-13)
        exact = dj.model.explicit_map(surface.membrane.material, curves.apex_stretch[seen], q, 1.0, 320.0)
        small = curves.apex_stretch[seen] - 1 < 0.02  # rounding of λa at the flat end
        assert np.allclose(np.asarray(exact[0])[~small], p[~small], rtol=2e-9)
        assert np.allclose(np.asarray(exact[1])[~small], v[~small], rtol=2e-9)


def test_a_chamber_does_not_depend_on_its_neighbours(surface):
    chambers = np.geomspace(20.0, 25000.0, 300)
    together = chamber_ramps(surface, chambers, 2.0)
    alone = chamber_ramps(surface, chambers[::37], 2.0)
    assert np.array_equal(together.area_strain[::37], alone.area_strain, equal_nan=True)
    shaped = chamber_ramps(surface, chambers[:6].reshape(2, 3), 2.0)
    assert shaped.snap.voltage.shape == (2, 3, 2) and shaped.start.volume.shape == (2, 3)
    assert np.array_equal(shaped.outcome.ravel(), together.outcome[:6])


def test_unresolved_chambers_hold_no_numbers(surface):
    ramps = chamber_ramps(surface, np.geomspace(10, 25000, 200), np.linspace(0.02, 2.9, 200))
    lost = ramps.outcome == Outcome.unresolved
    assert np.isnan(ramps.area_strain[lost]).all() and np.isnan(ramps.snap.voltage[lost]).all()
    assert np.isfinite(ramps.area_strain[~lost & (ramps.outcome != Outcome.start_unstable)]).all()
    # one that is stable, but leaves the surface between two rows
    assert chamber_ramps(surface, 82.55037842939616, 0.12816651427897252).outcome == Outcome.unresolved
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
    with pytest.raises(ValueError, match="`pressure` must be positive"):
        pressure_ramps(surface, 0.0)
    with pytest.raises(ValueError, match="`surface` must be a Surface"):
        chamber_ramps(surface.membrane, 100.0, 2.0)
