"""Events in time as differentiable numbers: against differences, an exact identity, the diagram, and the laws of slow passage."""

import jax
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import rates
from dielectric_jax.model import Maxwell, Viscoelastic

TIGHT = {"tolerance": 1e-9}


def scene(volume=1600.0, filling=2.42, ratio=1.0, time=1.0) -> dj.Scene:
    film = Viscoelastic(dj.Gent(270.0), [Maxwell(dj.Gent(270.0), ratio, time)])
    return dj.Scene(dj.Membrane(film), dj.Chamber(volume=volume, initial_volume=filling))


def differences(function, at, steps) -> list[float]:
    """Central differences by every argument."""
    found = []
    for k, step in enumerate(steps):
        ends = [[x + sign * step * (i == k) for i, x in enumerate(at)] for sign in (1, -1)]
        found.append(float(function(*ends[0]) - function(*ends[1])) / (2 * step))
    return found


def test_derivatives_of_a_snap():
    """By rate, chamber, filling, modulus and relaxation time; of the last two the rate's, as only r τ enters, is exact."""

    def snap(rate, volume, filling, ratio, time):
        return rates.snap_voltage(scene(volume, filling, ratio, time), rate, **TIGHT)

    at = 0.01, 1600.0, 2.42, 1.0, 1.0
    slopes = [float(s) for s in jax.grad(snap, argnums=range(5))(*at)]
    known = differences(lambda *four: snap(*four, 1.0), at[:4], [1e-5, 1.0, 1e-4, 1e-4])
    np.testing.assert_allclose(slopes[:4], known, rtol=2e-6)
    assert slopes[4] == pytest.approx(0.01 * slopes[0], rel=1e-7)
    forwards = jax.jacfwd(lambda rate: rates.snap_voltage(scene(), rate, **TIGHT))(0.01)
    assert float(forwards) == pytest.approx(slopes[0], rel=1e-9)


def test_derivatives_of_a_delay():
    """By voltage and relaxation time; a delay is a multiple of the relaxation time."""

    def delayed(voltage, time):
        return rates.delay(scene(time=time), voltage, **TIGHT)

    at = 0.1, 2.0
    value, slopes = jax.value_and_grad(delayed, argnums=(0, 1))(*at)
    assert float(slopes[1]) == pytest.approx(float(value) / 2.0, rel=1e-7)
    assert float(slopes[0]) == pytest.approx(differences(lambda v: delayed(v, 2.0), at[:1], [1e-5])[0], rel=2e-6)


def test_derivatives_of_a_peak_of_the_pressure():
    """By rate and modulus; without branches it is the peak of the elastic film."""

    def peak(rate, ratio):
        return rates.peak_pressure(scene(ratio=ratio).membrane, rate, initial_volume=0.5, **TIGHT)

    at = 0.5, 1.0
    known = differences(peak, at, [1e-4, 1e-4])
    np.testing.assert_allclose([float(s) for s in jax.grad(peak, argnums=(0, 1))(*at)], known, rtol=1e-6)
    assert float(peak(0.5, 0.0)) == pytest.approx(1.908684829414, rel=1e-9)


def test_numbers_are_those_of_runs():
    """The same jump asked for as a number, and read off a run."""
    run = rates.follow(scene(), voltage=rates.Ramp(rate=0.01), tolerance=1e-8)
    assert float(rates.snap_voltage(scene(), 0.01)) == pytest.approx(run.snap.at.voltage, rel=1e-10)
    held = rates.follow(scene(), voltage=rates.Hold(0.1), tolerance=1e-8)
    assert float(rates.delay(scene(), 0.1)) == pytest.approx(held.snap.at.time, rel=1e-10)


def test_many_at_once_and_none():
    """Under vmap and jit; NaN where there is no jump, which outside transformations is an error in a sentence."""
    snaps = jax.jit(jax.vmap(lambda rate: rates.snap_voltage(scene(), rate)))(np.array([0.01, -1.0, 0.1]))
    assert float(snaps[0]) == pytest.approx(float(rates.snap_voltage(scene(), 0.01)), rel=1e-12)
    assert np.isnan(snaps[1]) and snaps[2] > snaps[0]
    with pytest.raises(ValueError, match="`rate` must be positive"):
        rates.snap_voltage(scene(), -1.0)
    with pytest.raises(dj.SceneError, match="at_rest"):
        rates.delay(scene(), 0.05)
    assert float(rates.delay(scene(), 0.3)) == 0.0  # as the voltage is applied


def test_delays_tend_to_the_law_of_slow_passage():
    """Delays minus the law tend to a constant; numbers by another method."""
    film = Viscoelastic(dj.Gent(270.0), [Maxwell(dj.Gent(270.0), 1.0, 1.0)])
    held = dj.Scene(dj.Membrane(film), dj.ConstantPressure(1.82))
    law = rates.slow_passage(held)
    rest = [float(rates.delay(held, v)) - law.delay(v) for v in (0.115, 0.12, 0.13)]
    np.testing.assert_allclose(rest, [-18.664, -18.096, -17.24], atol=6e-3)
