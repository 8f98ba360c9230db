"""Batched continuation: known numbers, the extended-precision references, and single diagrams of the same scenes."""

import csv
import itertools
import math
import pathlib

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import continue_scenes
from dielectric_jax.diagram.polylines import Places, Polylines
from dielectric_jax.model import Outcome

DATA = pathlib.Path(__file__).parents[2] / "benchmarks" / "truth" / "data" / "chambers.csv"
FILM = dj.Membrane()


def chamber(volume, filling=2.42, membrane=FILM):
    return dj.Scene(membrane, dj.Chamber(volume=volume, initial_volume=filling))


def finite(values):
    return values[np.isfinite(values)]


def test_reference_numbers():
    """Snap, landing, breakdown and area strain at V_0 = 2.42, from methods that share no code."""
    ramps = continue_scenes([chamber(v) for v in (500.0, 800.0, 1600.0, 25000.0)]).ramps
    assert (ramps.outcome == Outcome.breakdown_on_branch).all() and list(ramps.snaps) == [0, 1, 1, 1]
    assert np.allclose(ramps.snap.voltage[1:3, 0], [0.0971990067469, 0.0764953595449], rtol=1e-9)
    assert np.allclose(ramps.landing.volume[1:3, 0], [9.07429967742, 19.9533292542], rtol=1e-8)
    assert np.allclose(ramps.breakdown.voltage[1:3], [0.115172761046, 0.100970094106], rtol=1e-9)
    assert np.allclose(ramps.area_strain, [12.6847453, 14.0104827, 16.1218889, 25.567264], rtol=1e-7)
    assert np.allclose(ramps.start.pressure, 1.886612680245, rtol=1e-10)
    # from V_C = 1455.896 on the membrane stays snapped on the way down
    assert list(np.isfinite(ramps.snap_back.voltage[:, 0])) == [False, True, False, False]
    assert [len(finite(v)) for v in ramps.zero_voltage.volume] == [1, 1, 3, 3]
    assert [len(finite(v)) for v in ramps.folds.volume] == [0, 2, 2, 2]


def test_every_eighth_chamber_of_the_references():
    """Folds, zero-voltage states, breakdown and landing of 32 chambers, computed without the package in extended precision."""
    with DATA.open() as file:
        groups = itertools.groupby(csv.DictReader(file), key=lambda row: float(row["chamber_volume"]))
        truth = {
            volume: [(r["kind"], float(r["voltage_squared"]), float(r["volume"])) for r in g] for volume, g in groups
        }
    some = list(truth)[::8]
    batch = continue_scenes([chamber(v) for v in some])
    assert (batch.code == dj.numerics.Code.breakdown).all()
    for i, volume in enumerate(some):
        of = {kind: [row[1:] for row in truth[volume] if row[0] == kind] for kind, _, _ in truth[volume]}
        folds = batch.ramps.folds
        # the references end at breakdown, ours at a load higher than any before
        before = finite(folds.volume[i][folds.volume[i] < of["breakdown"][0][1]])
        assert len(before) == len(of.get("fold", []))
        for k, (q, v) in enumerate(of.get("fold", [])):
            if q > 0:
                assert abs(folds.voltage[i, k] - math.sqrt(q)) < 1e-8
            assert abs(folds.volume[i, k] / v - 1) < 10 * folds.error[i, k] < 1e-3
        zero = finite(batch.ramps.zero_voltage.volume[i])
        np.testing.assert_allclose(zero, [v for _, v in of["zero_voltage"]], rtol=1e-7)
        assert abs(batch.ramps.breakdowns.voltage[i, 0] - math.sqrt(of["breakdown"][0][0])) < 1e-9
        if "landing" in of:
            landing = batch.ramps.landing
            assert abs(landing.volume[i, 0] / of["landing"][0][1] - 1) < 10 * landing.error[i, 0] < 1e-6


def test_no_fold_where_there_is_none():
    """Between the cusps V_C = 484.04966 and 551.39914 at V_0 = 2.42 the voltage rises all along the branch."""
    inside = continue_scenes([chamber(v) for v in np.linspace(484.1, 551.3, 20)]).ramps
    assert np.isnan(inside.folds.volume).all() and (inside.snaps == 0).all()
    outside = continue_scenes([chamber(v) for v in (470.0, 480.0, 560.0, 580.0)]).ramps
    assert [len(finite(v)) for v in outside.folds.volume] == [2] * 4


def test_lanes_do_not_disturb_each_other():
    """Easy, hard and impossible scenes give the same results together as alone."""
    other = dj.Membrane(prestretch=2.0, material=dj.Gent(stretch_limit=120.0))
    scenes = [
        chamber(800.0),
        chamber(1600.0, 1e4),  # more than the membrane holds
        chamber(484.05),
        dj.Scene(FILM, dj.ConstantPressure(1e5)),  # more than the membrane can carry
        chamber(1000.0, 20.0, other),
        dj.Scene(FILM, dj.ConstantPressure(1.82)),
        chamber(1e-3),
        chamber(1e9),
    ]
    together = continue_scenes(scenes)
    assert [int(c) for c in together.code[[1, 3]]] == [dj.numerics.Code.no_equilibrium] * 2
    assert (together.ramps.outcome[[1, 3]] == Outcome.unresolved).all()
    assert np.isnan(together.ramps.start.volume[[1, 3]]).all() and np.isnan(together.branches[[1, 3]]).all()
    for i, scene in enumerate(scenes):
        alone = continue_scenes([scene])
        assert alone.ramps.outcome[0] == together.ramps.outcome[i] and alone.code[0] == together.code[i]
        for name in ("start", "snap", "landing", "breakdown", "rest"):
            for field in ("voltage", "volume"):
                mine, theirs = (getattr(getattr(r, name), field)[k] for r, k in ((alone.ramps, 0), (together.ramps, i)))
                np.testing.assert_allclose(mine, theirs, rtol=1e-12)


def test_single_diagrams_of_random_scenes():
    """A batch agrees with `voltage_volume`: the same end of the ramp, and the same events within the errors."""
    random = np.random.default_rng(4)
    membranes = [FILM, dj.Membrane(prestretch=1.6, material=dj.Gent(stretch_limit=200.0))]
    scenes = []
    for membrane in membranes:
        peak = min(p.volume for p in dj.pressure_volume(membrane).special_points if p.kind == "fold")
        for _ in range(4):
            sizes = float(np.exp(random.uniform(np.log(30), np.log(25000)))), float(random.uniform(0.5, 1) * peak)
            scenes.append(chamber(*sizes, membrane))
    ramps = continue_scenes(scenes).ramps
    told = np.flatnonzero(ramps.outcome != Outcome.unresolved)
    assert len(told) >= 4
    reasons = {
        Outcome.breakdown_on_branch: ("breakdown on the branch",),
        Outcome.breakdown_in_snap: ("breakdown in the snap",),
        Outcome.no_landing: ("no landing",),
    }
    for i in told:
        ramp = dj.voltage_volume(scenes[i]).ramp()
        assert ramp.area_strain_reason in reasons[Outcome(int(ramps.outcome[i]))]
        assert abs(ramps.area_strain[i] / ramp.area_strain - 1) < 1e-5
        snaps = [e.state.voltage for e in ramp.events if e.event == "snap"]
        np.testing.assert_allclose(finite(ramps.snap.voltage[i]), snaps, rtol=1e-8)


def test_landings_about_breakdown_are_decided():
    """From V_C = 250 to 480 snaps land beyond breakdown, then near it, then below: E/E_EB there falls through 1."""
    volumes = [270.95, 288.39, 406.38, 454.19, 467.87, 468.14]
    scenes = [chamber(volume, 2.42) for volume in volumes]
    ramps = continue_scenes(scenes).ramps
    expected = [Outcome.breakdown_in_snap] * 4 + [Outcome.breakdown_on_branch] * 2
    assert list(ramps.outcome) == expected
    for i in (2, 5):
        ramp = dj.voltage_volume(scenes[i]).ramp()
        (landing,) = [e.state for e in ramp.events if e.event == "landing" and e.direction == "up"]
        assert (landing.breakdown_ratio > 1) == (expected[i] == Outcome.breakdown_in_snap)
        assert abs(ramps.landing.volume[i, 0] / landing.volume - 1) < 1e-9


def test_every_kind_of_chamber_and_breakdown_law():
    """Filling given by a pressure, a polytropic gas, thin outside air, a user's breakdown law, compared with single diagrams."""
    strong = dj.Membrane(breakdown=dj.model.CustomBreakdown(lambda stretch: 1.2 * stretch**0.9))
    weak = dj.Membrane(breakdown=dj.ConstantBreakdown(4.0))
    loadings = [
        dj.Chamber(volume=1200.0, initial_pressure=1.85),
        dj.Chamber(volume=900.0, initial_volume=2.2, polytropic_exponent=1.4),
        dj.Chamber(volume=300.0, initial_volume=2.5, atmospheric_pressure=8.0),
    ]
    scenes = [dj.Scene(FILM, x) for x in loadings] + [chamber(1600.0, 2.42, m) for m in (strong, weak)]
    ramps = continue_scenes(scenes).ramps
    assert (ramps.outcome != Outcome.unresolved).all()
    for i, scene in enumerate(scenes):
        events = dj.voltage_volume(scene).ramp().events
        for name in ("snap", "landing"):
            alone = [e.state for e in events if e.event == name]
            points = getattr(ramps, name)
            np.testing.assert_allclose(finite(points.voltage[i]), [s.voltage for s in alone], rtol=1e-8)
        broken = [e.state.voltage for e in events if e.event == "breakdown"]
        if ramps.outcome[i] == Outcome.breakdown_on_branch:
            np.testing.assert_allclose(ramps.breakdown.voltage[i], broken, rtol=1e-8)


def test_a_law_under_which_another_place_breaks_first_is_refused():
    """λ²/E_EB falls where the law rises faster than λ²: the rim, stretched less than the apex, breaks first."""
    steep = dj.Membrane(breakdown=dj.model.CustomBreakdown(lambda stretch: 0.05 * stretch**2.5))
    with pytest.raises(ValueError, match="`breakdown` must be a law"):
        continue_scenes([chamber(800.0), chamber(800.0, 2.42, steep)])
    diagram = dj.voltage_volume(chamber(800.0, 2.42, steep))
    broken = [p for p in diagram.special_points if p.kind == "breakdown"]
    for point in broken:  # E/E_EB = 1 somewhere, but less at the apex
        apex = point.voltage * point.apex_stretch**2 / (0.05 * point.apex_stretch**2.5)
        assert abs(point.breakdown_ratio - 1) < 1e-8 and apex < 0.999
    assert broken


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="`scenes` must hold at least one"):
        continue_scenes([])
    with pytest.raises(ValueError, match="`scenes` must be scenes with a Chamber"):
        continue_scenes([dj.Scene(FILM, dj.ConstantVoltage(0.1))])
    with pytest.raises(ValueError, match="tolerance"):
        continue_scenes([chamber(800.0)], tolerance=2.0)


def sine_lines(count):
    """Two lines (s, 0, sin s) and (s, 0, cos s), with unit tangents."""
    s = np.linspace(0.1, 6.1, count)
    points = np.stack([np.stack([s, 0 * s, f(s)], axis=1) for f in (np.sin, np.cos)])
    slopes = np.stack([np.stack([1 + 0 * s, 0 * s, f(s)], axis=1) for f in (np.cos, lambda x: -np.sin(x))])
    tangents = slopes / np.linalg.norm(slopes, axis=2, keepdims=True)
    return Polylines(points, tangents, np.full(2, count)), s


def test_turns_and_crossings_of_known_curves():
    """Turning points of sine and cosine at π/2, 3π/2 and π; zeros at π, and at π/2 and 3π/2."""
    lines, _ = sine_lines(49)
    turns, dips = lines.turns(2)
    at, tangent, bend = lines.at(turns)
    np.testing.assert_allclose(at[:, 0], [np.pi / 2, 3 * np.pi / 2, np.pi], atol=2e-4)
    np.testing.assert_allclose(tangent[:, 2], 0, atol=1e-10)
    np.testing.assert_allclose(bend[:, 2], [-1, 1, 1], rtol=2e-2)
    assert not len(dips)
    row, zeros = lines.crossings(lines.points[..., 2], lines.tangents[..., 2], np.arange(2))
    assert list(row) == [0, 1, 1]
    np.testing.assert_allclose(lines.at(zeros)[0][:, 0], [np.pi, np.pi / 2, 3 * np.pi / 2], atol=2e-4)


def test_points_are_put_where_they_belong():
    lines, s = sine_lines(7)
    places = Places(np.array([1, 0, 0]), np.array([2, 4, 0]), np.array([0.5, 0.25, 0.5]))
    at, tangent, _ = lines.at(places)
    more, moved = lines.insert(places, at, tangent)
    assert list(more.count) == [9, 8]
    for line in range(2):
        x = more.points[line, : more.count[line], 0]
        assert (np.diff(x) > 0).all()
        np.testing.assert_array_equal(x[moved[line]], s)


def test_a_line_that_goes_on_on_a_finer_grid_keeps_nothing_of_the_coarser():
    """Towards the cone a line is restarted on a finer grid: its points are in order, without gaps, and NaN after its end."""
    batch = continue_scenes([chamber(1000.0, 0.5), chamber(20.0, 1.0), chamber(1600.0)])
    assert list(batch.code) == [dj.numerics.Code.apex_cone, dj.numerics.Code.apex_cone, dj.numerics.Code.breakdown]
    for line in batch.branches:
        there = np.isfinite(line[:, 0])
        count = int(there.sum())
        assert count > 10 and there[:count].all()
        chords = np.diff(line[:count] / [1.0, 0.2, 0.02], axis=0)
        length = np.linalg.norm(chords, axis=1)
        assert 0 < length.min() and length.max() < 2.1
        # towards the cone the oscillations of the load shrink: neighbouring chords do not turn back
        assert ((chords[1:] * chords[:-1]).sum(axis=1) > 0).all()


def test_two_folds_in_one_step_of_the_march():
    """An eight-chain film in thin air: the whole diagram, which scans, and the surface know both folds."""
    membrane = dj.Membrane(dj.ArrudaBoyce(6.547882701322623), 1.0686666282877064)
    air = {"atmospheric_pressure": 0.0, "polytropic_exponent": 1.4}
    chamber = dj.Chamber(volume=1231.0694198451758, initial_volume=1.015436763748196, **air)
    found = dj.continue_scenes([dj.Scene(membrane, chamber)]).ramps
    assert found.snap.voltage[0, 0] == pytest.approx(0.4495331072, abs=1e-9)
    assert dj.Regime(int(found.regime[0])) == dj.Regime.breaks_in_snap
