"""Neutral points of modes as differentiable functions."""

import jax
import pytest

import dielectric_jax as dj
from dielectric_jax.critical import mode_point


def test_derivatives_are_those_of_differences(membrane):
    scene = dj.Scene(membrane, dj.Chamber(volume=25000.0, initial_volume=2.42))

    def voltage(share):
        """Over the chamber and the material together."""
        return mode_point(scene.replace(chamber_volume=25000.0 * share, stretch_limit=270.0 * share), 10).voltage

    assert float(voltage(1.0)) == pytest.approx(0.116448455, abs=1e-9)
    step = 1e-3
    known = (float(voltage(1 + step)) - float(voltage(1 - step))) / (2 * step)
    assert float(jax.grad(voltage)(1.0)) == pytest.approx(known, rel=1e-5)


def test_a_number_that_is_never_neutral(membrane):
    scene = dj.Scene(membrane, dj.ConstantPressure(1.2))
    with pytest.raises(dj.SceneError, match="No mode of this number turns neutral"):
        mode_point(scene, 1)
    with pytest.raises(ValueError, match="`number` must be"):
        mode_point(scene, 0)
