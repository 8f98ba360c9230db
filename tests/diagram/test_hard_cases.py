"""Hard cases: no wrong answer without a flag; the cases and their references are in benchmarks/acceptance/hard_cases.py."""

import numpy as np
import pytest

import dielectric_jax as dj
from benchmarks.acceptance import hard_cases, parameters
from benchmarks.truth import contours as contour_truth
from benchmarks.truth import extended_precision as truth
from dielectric_jax import SceneError
from dielectric_jax.model import Outcome
from dielectric_jax.numerics import Code

CUSP_RADIUS = 0.021873874899382924  # of the film of the scene of everything: above it the ramp snaps


@pytest.mark.parametrize("number", hard_cases.CASES)
def test_case(number):
    """Every row of the case in its quick setting is correct, and most without a flag."""
    rows = list(hard_cases.CASES[number][1](True))
    assert rows
    wrong = [
        f"{r.asked}: {r.true}, but {r.answered} (error {r.error:.1e}, {r.estimate:.0e})" for r in rows if not r.right
    ]
    assert not wrong
    assert any(not r.flag for r in rows)


def test_a_pair_of_states_between_two_stations():
    """p just below the peak: the two zero-voltage states lie between neighbouring points of the branch."""
    diagram = hard_cases.voltage_volume(dj.ConstantPressure(hard_cases.PEAK_PRESSURE * (1 - 1e-8))).value
    zeros = sorted(p.volume for p in diagram.special_points if p.kind == "zero_voltage")
    assert len(zeros) == 3
    # p = p_peak − p'' δ²/2: the two states agree with extended precision
    states = [p for p in diagram.special_points if p.kind == "zero_voltage" and p.volume < 3]
    assert [p.index for p in sorted(states, key=lambda p: p.volume)] == [0, 1]
    assert diagram.ramp().events[0].state.volume == pytest.approx(zeros[0])


def test_states_towards_the_cone():
    """At Φ = 0.3 the pressure 1.2911981 occurs once between each two folds; no state near t = 1 is missed."""
    states = dj.equilibrium(dj.Membrane(), voltage=0.3, pressure=1.2911981, all=True)
    stretches = [s.apex_stretch for s in sorted(states, key=lambda s: s.apex_stretch)]
    folds = [1.823782785, 2.842038517, 3.255793719, 3.404189858, 3.451755287, 3.465533699]  # by `contour_truth`
    for low, high in zip([1.0, *folds[:-1]], folds, strict=True):
        assert sum(low < s < high for s in stretches) == 1
    assert all(s.error_estimate < 1e-9 for s in states)


def test_codes_where_nothing_is_flat():
    """A film beyond slack is not "near flat", but a stretch that equals λ0 in double precision is."""
    with pytest.raises(SceneError) as refusal:
        dj.equilibrium(dj.Membrane(prestretch=3.0), voltage=0.36, pressure=1e-8)
    assert refusal.value.code is Code.no_equilibrium
    with pytest.raises(SceneError) as refusal:
        dj.equilibrium(dj.Membrane(), apex_stretch=1 + 1e-12)
    assert refusal.value.code is Code.near_flat
    # λ0 = 1 + 1e-6 at p = 1e-4 has one state; another, without any accuracy, was once listed
    states = dj.equilibrium(dj.Membrane(prestretch=1 + 1e-6), pressure=1e-4, all=True)
    assert len(states) == 1 and states[0].error_estimate < 1e-9


@pytest.mark.parametrize("limit", [1e4, 1e6])
def test_a_scan_with_nodes_that_no_grid_resolves(limit):
    """Almost neo-Hookean: the peak is that of the neo-Hookean membrane, 1.879173468756, plus c/J."""
    state = dj.equilibrium(dj.Membrane(dj.Gent(limit)), pressure=1.8)
    p, v, _ = truth.exact([state.apex_stretch], [1.8], [0.0], [limit], [1.0], steps=280)
    assert abs(float(p[0]) - 1.8) < 1e-9 and abs(float(v[0]) / state.volume - 1) < 1e-9


def test_folds_about_the_middle_of_two_rows():
    """Just below the cusp V_C = 484.04966 two folds lie between rows: found, or left to the continuation, never denied."""
    volumes = hard_cases.CUSPS[0] - np.array([1e-1, 1e-2, 3e-3, 2e-3, 1e-3])
    ramps = dj.diagram.chamber_ramps(hard_cases.surface_of(), volumes, hard_cases.FILLING)
    decided = ramps.outcome != Outcome.unresolved
    assert (ramps.snaps[decided] == 1).all() and decided.any()


def test_a_landing_too_near_to_its_fold():
    """Beyond a cusp the ramp snaps and lands beside the fold; where the landing is lost in rounding, it is not denied."""
    scene = parameters.scene_of_everything()
    reasons = [
        dj.voltage_volume(scene.replace(radius=CUSP_RADIUS * (1 + beyond))).area_strain_reason
        for beyond in (1e-7, 1e-6)
    ]
    assert reasons == ["landing not located", "breakdown on the branch"]
    assert dj.regime_of(scene.replace(radius=CUSP_RADIUS * (1 + 1e-7))).name == "not_decided"


def test_the_truth_of_contours():
    """The benchmark's own reference against numbers that share nothing with it."""
    ((place, peak),) = contour_truth.turning(lambda a: truth.states(a, 0.0, 270.0, 1.0)[0], 2.263, 0.05)
    assert abs(peak - 1.908684829414) < 2e-12 and abs(place - 2.26310592942) < 1e-9
    gas = contour_truth.Gas(1600.0, 2.42, hard_cases.START_PRESSURE)
    ((_, load),) = contour_truth.turning(lambda a: contour_truth.loads(gas, a, 0.00585, 270.0, 1.0)[0], 2.397, 0.04, 8)
    assert abs(np.sqrt(load) - 0.0764953595449) < 1e-12


def test_a_row_is_wrong_where_it_should_be():
    """The measure itself: ten times the estimate, a flag, a refusal."""
    row = hard_cases.Row("asked", "true", "known", "answered", 1e-8, 1e-9)
    assert row.right
    row.error = 2e-8
    assert not row.right
    row.flag = "error_above_tolerance"
    assert row.right
    answer = hard_cases.ask(dj.equilibrium, dj.Membrane(), volume=500.0)
    assert not hard_cases.refused(answer, "V = 500", "none", "", "no such words").right
    assert "NO" in hard_cases.table([hard_cases.Row("a", "b", "c", "d", np.inf, case="6 volume at lock-up")])
