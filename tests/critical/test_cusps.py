"""Extremes of the pressure, zero-voltage states, the onset of bistability and cusps: known numbers, closed-form slopes."""

import jax
import numpy as np
import pytest

import dielectric_jax as dj


@pytest.fixture(scope="module")
def scene():
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


def test_extremes_of_the_pressure(membrane):
    peak, valley = dj.critical.pressure_peak(membrane), dj.critical.pressure_valley(membrane)
    assert abs(float(peak.pressure) - 1.908684829414) < 2e-12
    assert abs(float(peak.volume) / 2.9634068291 - 1) < 1e-10
    assert abs(float(valley.pressure) - 1.361703319141) < 2e-12
    assert abs(float(valley.apex_stretch) / 8.2681508078 - 1) < 1e-10
    with pytest.raises(dj.SceneError, match="no_pressure_fold"):
        dj.critical.pressure_peak(dj.Membrane(prestretch=2.5))
    assert np.isnan(dj.critical.pressure_peak(dj.Membrane(prestretch=2.5), throw=False).pressure)


def test_the_peak_falls_with_the_voltage_as_the_energy_says(membrane, slope_by_differences):
    """Where ∂p/∂V = 0, dp/dq = ∂p/∂q|V = −½ ∂C/∂V|q, C = Q/Φ by differences of states."""
    slope = jax.grad(lambda f: dj.critical.pressure_peak(membrane, f).pressure)(0.05) / (2 * 0.05)
    peak = dj.critical.pressure_peak(membrane, 0.05)

    def state(apex):
        return dj.equilibrium(membrane, voltage=0.05, apex_stretch=apex)

    apex = float(peak.apex_stretch)
    charge, volume = (
        slope_by_differences(lambda a, n=name: getattr(state(a), n), apex, 1e-2) for name in ("charge", "volume")
    )
    assert abs(float(slope) / (-0.5 * charge / 0.05 / volume) - 1) < 1e-7


def test_zero_voltage_states(scene, slope_by_differences):
    volumes = [float(dj.critical.zero_voltage_point(scene, k).volume) for k in (0, 1, 2)]
    assert np.allclose(volumes, [2.42, 6.04157957, 11.7561689651], rtol=1e-8)
    assert abs(float(dj.critical.zero_voltage_point(scene, -1).pressure) / 1.58605717915 - 1) < 1e-11
    with pytest.raises(dj.SceneError, match="no_such_state"):
        dj.critical.zero_voltage_point(scene, 3)

    def of(volume):
        return dj.critical.zero_voltage_point(scene.replace(initial_volume=volume), -1).volume

    assert abs(float(jax.grad(of)(2.42)) / slope_by_differences(of, 2.42, 1e-3) - 1) < 1e-8


def test_the_onset_of_bistability(scene, slopes_of_gas):
    """p(V, 0) = p_gas(V; V_C, θ) with equal slopes: dV_C/dθ = −(∂p_gas/∂θ)/(∂p_gas/∂V_C) at the V of the tangency."""
    onset = dj.critical.bistability_point(scene)
    assert abs(float(onset.parameter) / 1455.896262454 - 1) < 1e-11
    gas = slopes_of_gas(float(onset.volume), float(onset.parameter))
    for name, value in (("initial_volume", 2.42), ("atmospheric_pressure", 50.0), ("polytropic_exponent", 1.0)):
        found = jax.grad(lambda v, name=name: dj.critical.bistability_onset(scene.replace(**{name: v})))(value)
        assert abs(float(found) / (-gas[name] / gas["chamber_volume"]) - 1) < 1e-8
    assert float(jax.grad(lambda v: dj.critical.bistability_onset(scene.replace(chamber_volume=v)))(1600.0)) == 0


def test_cusps(scene, membrane, slope_by_differences):
    first, second = (dj.critical.cusp(scene, k, within=(300.0, 3000.0)) for k in (0, 1))
    assert abs(float(first.parameter) - 484.04966) < 5e-6
    assert abs(float(second.parameter) - 551.39914) < 5e-6
    with pytest.raises(dj.SceneError, match="no_cusp"):
        dj.critical.cusp(scene, 2, within=(300.0, 3000.0))
    merged = dj.critical.pressure_cusp(membrane, within=(2.0, 2.2))
    assert abs(float(merged.parameter) - 2.110288) < 5e-7
    assert abs(float(merged.pressure) - 1.048697) < 5e-7
    assert abs(float(merged.apex_stretch) - 5.7409) < 5e-5

    def of(outside):
        return dj.critical.cusp(scene.replace(atmospheric_pressure=outside), 1, within=(300.0, 3000.0)).parameter

    assert abs(float(jax.grad(of)(50.0)) / slope_by_differences(of, 50.0, 0.1) - 1) < 1e-7

    def by_voltage(voltage):
        return dj.critical.pressure_cusp(membrane, voltage, within=(2.0, 2.5)).parameter

    assert abs(float(jax.grad(by_voltage)(0.05)) / slope_by_differences(by_voltage, 0.05, 1e-3) - 1) < 1e-7


def test_states_at_a_voltage_and_their_derivatives():
    """Against the states of diagrams, p(V; θ) against `equilibrium`, and slopes against differences."""
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
    known = dj.equilibrium(scene, voltage=0.05, all=True)
    found = [dj.critical.state_point(scene, 0.05, k) for k in range(3)]
    assert [float(s.volume) for s in found] == pytest.approx([s.volume for s in known], rel=1e-9)
    assert [float(s.pressure) for s in found] == pytest.approx([s.pressure for s in known], rel=1e-9)

    def pressure(limit, volume, voltage):
        held = dj.Scene(dj.Membrane(dj.Gent(limit)), dj.PrescribedVolume(volume))
        return dj.critical.state_point(held, voltage).pressure

    place = np.array([120.0, 3.0, 0.05])
    assert float(pressure(*place)) == pytest.approx(
        dj.equilibrium(dj.Membrane(dj.Gent(120.0)), voltage=0.05, volume=3.0).pressure, rel=1e-9
    )
    slopes = jax.grad(pressure, (0, 1, 2))(*place)
    for k, slope in enumerate(slopes):
        step = 1e-3 * place[k] * np.eye(3)[k]
        difference = float(pressure(*(place + step)) - pressure(*(place - step))) / (2 * step[k])
        assert float(slope) == pytest.approx(difference, rel=2e-5)
    many = jax.vmap(jax.grad(pressure), (None, 0, None))(120.0, np.array([2.0, 3.0]), 0.05)
    assert float(many[1]) == pytest.approx(float(slopes[0]), rel=1e-12)
    with pytest.raises(dj.SceneError, match="no_such_state"):
        dj.critical.state_point(scene, 0.2)
    with pytest.raises(ValueError, match="`voltage` must be zero or positive"):
        dj.critical.state_point(scene, -0.1)
