"""Critical points against reference numbers; their derivatives against energy identities, differences and the surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj


@pytest.fixture(scope="module")
def scene():
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


@pytest.fixture(scope="module")
def surface(scene):
    return dj.Surface.build(scene.membrane)


def test_reference_numbers(scene):
    """V_C = 1600, from methods that share no code."""
    assert abs(float(dj.snap_voltage(scene)) / 0.0764953595449 - 1) < 1e-11
    assert abs(float(dj.critical.landing_point(scene).volume) / 19.9533292542 - 1) < 1e-10
    broken = dj.critical.breakdown_point(scene)
    assert abs(float(broken.voltage) / 0.100970094106 - 1) < 1e-11
    assert abs(float(broken.apex_stretch) / 8.10285526922 - 1) < 1e-11
    assert abs(float(broken.breakdown_ratio) - 1) < 1e-11
    assert abs(float(dj.area_strain(scene)) - 16.1218889) < 1e-7
    back = dj.critical.snap_back_point(scene.replace(chamber_volume=800.0))
    assert abs(float(back.voltage) / 0.0890347141691 - 1) < 1e-10
    held = dj.Scene(scene.membrane, dj.ConstantPressure(1.82))
    assert abs(float(dj.snap_voltage(held)) / 0.114568360882 - 1) < 1e-10


def test_the_snap_load_moves_as_the_energy_says(scene, surface, slopes_of_gas):
    """At the fold p(V, q) = p_gas(V; θ) with equal slopes, and ∂p/∂q|V = −½ ∂C/∂V|q: dq/dθ = −2 (∂p_gas/∂θ)/(∂C/∂V)."""
    fold = dj.snap_point(scene)

    def charge_and_volume(apex):
        state = surface(apex, fold.voltage_squared)
        return jnp.stack([state.charge / fold.voltage, state.volume])

    by_c, by_v = jax.jacfwd(charge_and_volume)(fold.apex_stretch)
    gas = slopes_of_gas(float(fold.volume))
    for name in gas:
        value = {"polytropic_exponent": 1.0, "atmospheric_pressure": 50.0, "initial_volume": 2.42}.get(name, 1600.0)
        found = jax.grad(lambda v, name=name: dj.snap_point(scene.replace(**{name: v})).voltage_squared)(value)
        assert abs(float(found) / float(-2 * gas[name] / (by_c / by_v)) - 1) < 2e-8


@pytest.mark.parametrize(("name", "value", "step"), [("stretch_limit", 270.0, 1.0), ("prestretch", 1.02, 1e-3)])
def test_derivatives_by_the_membrane(name, value, step, scene, slope_by_differences):
    """By shots at other membranes: differences of the snap voltage, which share no derivative."""

    def snap(v):
        return dj.snap_voltage(scene.replace(**{name: v}))

    assert abs(float(jax.grad(snap)(value)) / slope_by_differences(snap, value, step) - 1) < 1e-7


def test_the_surface_gives_the_same(scene, surface, slope_by_differences):
    def snap(name, **options):
        return lambda v: dj.snap_point(scene.replace(**{name: v}), **options).volume

    for name, value in (("chamber_volume", 1600.0), ("stretch_limit", 270.0)):
        shot, seen = jax.grad(snap(name))(value), jax.grad(snap(name, surface=surface))(value)
        assert abs(float(seen / shot) - 1) < 1e-6
    curve = jax.hessian(lambda v: dj.snap_voltage(scene.replace(chamber_volume=v), surface=surface))(1600.0)
    slope = jax.grad(lambda v: dj.snap_voltage(scene.replace(chamber_volume=v), surface=surface))
    assert abs(float(curve) / slope_by_differences(slope, 1600.0, 8.0) - 1) < 1e-6


def test_breakdown_moves_with_its_law(scene, slope_by_differences):
    """At breakdown on the branch q = s² q_b(λa); held pressure: p(λa, q) = const. Differences of the strain."""
    for function in (
        dj.area_strain,
        dj.critical.breakdown_voltage,
        lambda s: dj.critical.landing_point(s).breakdown_ratio,
    ):

        def of(scale, function=function):
            return function(scene.replace(breakdown_field_scale=scale))

        assert abs(float(jax.grad(of)(1.0)) / slope_by_differences(of, 1.0, 1e-3) - 1) < 1e-8


def test_in_batches_and_compiled(scene, surface):
    def snap(volume, **options):
        return dj.snap_voltage(scene.replace(chamber_volume=volume), **options)

    volumes = np.array([500.0, 800.0, 1600.0])
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(lambda v: snap(v, surface=surface))))(volumes)
    assert np.isnan(value[0]) and np.isnan(slope[0])  # no fold there, and the other members of the batch are unaffected
    assert np.allclose(value[1:], [0.0971990067469, 0.0764953595449], rtol=1e-10)
    assert np.allclose(slope[1:], [float(jax.grad(snap)(v)) for v in volumes[1:]], rtol=1e-8)
    both = jax.jacfwd(lambda x: snap(x[0] * x[1]))(jnp.array([800.0, 2.0]))
    assert np.allclose(both, [2 * slope[2], 800 * slope[2]], rtol=1e-8)


def test_breakdown_in_the_snap(scene, surface, slope_by_differences):
    """V_C = 467.84 breaks down in the snap, so its strain is that of the fold; 467.86 breaks down on the branch."""
    broken = scene.replace(chamber_volume=467.84)
    landing = dj.critical.breakdown_point(broken, surface=surface)
    assert float(landing.breakdown_ratio) > 1
    assert float(landing.voltage) == pytest.approx(float(dj.snap_voltage(broken, surface=surface)), rel=1e-9)
    fold, start = dj.snap_point(broken, surface=surface), dj.equilibrium(scene.membrane, volume=2.42)
    strain = (float(fold.apex_stretch) / start.apex_stretch) ** 2 - 1
    assert float(dj.area_strain(broken, surface=surface)) == pytest.approx(strain, rel=1e-8)

    def of(volume):
        return dj.area_strain(scene.replace(chamber_volume=volume), surface=surface)

    assert abs(float(jax.grad(of)(467.0)) / slope_by_differences(of, 467.0, 0.05) - 1) < 1e-6


def test_what_does_not_exist_is_said(scene, surface):
    none = scene.replace(chamber_volume=500.0)
    with pytest.raises(dj.SceneError, match="no_fold"):
        dj.snap_voltage(none)
    point = dj.snap_point(none, throw=False)
    assert np.isnan(point.voltage) and dj.numerics.Code(int(point.code)) is dj.numerics.Code.no_fold
    with pytest.raises(dj.SceneError, match="no_snap_back"):
        dj.critical.snap_back_voltage(scene)  # it stays in the snapped state
    other = dj.snap_point(scene.replace(prestretch=1.5), surface=surface, throw=False)
    assert dj.numerics.Code(int(other.code)) is dj.numerics.Code.other_membrane
    with pytest.raises(ValueError, match="initial_volume"):
        dj.snap_voltage(scene.replace(initial_volume=900.0))
    wrong = jax.vmap(lambda v: dj.snap_voltage(scene.replace(chamber_volume=v), surface=surface))
    assert list(np.isnan(wrong(np.array([-3.0, 1600.0])))) == [True, False]
    with pytest.raises(ValueError, match="`scene` must be a Scene"):
        dj.snap_voltage(scene.membrane)
    with pytest.raises(ValueError, match="`loading` must be a Chamber"):
        dj.snap_voltage(dj.Scene(scene.membrane, dj.ConstantVoltage(0.1)))
