"""Critical points against reference numbers, and their derivatives against differences of the same numbers."""

import jax
import numpy as np
import pytest

import dielectric_jax as dj


@pytest.fixture(scope="module")
def scene():
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


def slope_by_differences(function, x, step):
    """Fourth-order central difference."""
    near, far = (float(function(x + k * step)) - float(function(x - k * step)) for k in (1, 2))
    return (8 * near - far) / (12 * step)


def test_reference_numbers(scene):
    """V_C = 1600, from methods that share no code."""
    assert abs(float(dj.snap_voltage(scene)) / 0.0764953595449 - 1) < 1e-11
    assert abs(float(dj.landing_point(scene).volume) / 19.9533292542 - 1) < 1e-10
    broken = dj.breakdown_point(scene)
    assert abs(float(broken.voltage) / 0.100970094106 - 1) < 1e-11
    assert abs(float(broken.apex_stretch) / 8.10285526922 - 1) < 1e-11
    assert abs(float(broken.breakdown_ratio) - 1) < 1e-11
    assert abs(float(dj.area_strain(scene)) - 16.1218889) < 1e-7


def test_the_gradient_of_the_snap_voltage(scene):
    def snap(volume):
        return dj.snap_voltage(scene.replace(chamber_volume=volume))

    slope = slope_by_differences(snap, 1600.0, 8.0)
    found = jax.grad(snap)(1600.0)
    assert abs(float(found) / slope - 1) < 1e-6
    assert float(jax.jit(jax.grad(snap))(1600.0)) == pytest.approx(float(found), rel=1e-12)
    # where there is no fold the neighbours still have their slopes
    many = np.asarray(jax.vmap(jax.grad(snap))(np.array([500.0, 1600.0])))
    assert np.isnan(many[0]) and many[1] == pytest.approx(float(found), rel=1e-9)


def test_what_does_not_exist_is_said(scene):
    none = scene.replace(chamber_volume=500.0)
    with pytest.raises(dj.SceneError, match="no_fold"):
        dj.snap_voltage(none)
    point = dj.snap_point(none, throw=False)
    assert np.isnan(point.voltage) and dj.Code(int(point.code)) is dj.Code.no_fold
