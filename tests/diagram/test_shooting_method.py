"""A user's own solver, step size controller and root finder in `equilibrium` and `voltage_volume`."""

import math

import diffrax as dfx
import optimistix as optx
import pytest

import dielectric_jax as dj
from dielectric_jax.model import ShootingMethod

METHOD = ShootingMethod(
    solver=dfx.Tsit5(),
    stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
    root_finder=optx.Newton(rtol=1e-11, atol=1e-11),
)
ARTICLE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


def error(value, expected):
    """The measure of `error_estimate`: |error|/max(|value|, 1e-3)."""
    return abs(value - expected) / max(abs(expected), 1e-3)


def test_reference_states(reference):
    """States by the method are right within their error estimates, which say how far they are from ours."""
    moderate = [ref for ref in reference if ref["apex_stretch"] < 5 and ref["voltage_squared"] >= 0][::8]
    assert len(moderate) > 3
    for ref in moderate:
        membrane = dj.Membrane(prestretch=ref["prestretch"])
        given = {"voltage": math.sqrt(ref["voltage_squared"]), "volume": ref["volume"], "tolerance": 1e-6}
        found = dj.equilibrium(membrane, all=True, method=METHOD, **given)
        state = min(found, key=lambda s: abs(s.apex_stretch - ref["apex_stretch"]))
        assert state not in dj.equilibrium(membrane, all=True, **given)
        assert state.error_estimate <= 1e-6
        for name in ("pressure", "apex_stretch"):
            assert error(getattr(state, name), ref[name]) <= 3 * state.error_estimate + 1e-9, (ref["label"], name)


def test_a_coarse_method_says_how_coarse_it_is(membrane):
    """With four digits of a step the state is wrong in the fourth or fifth, and says so."""
    coarse = ShootingMethod(
        solver=dfx.Tsit5(),
        stepsize_controller=dfx.PIDController(rtol=1e-4, atol=1e-4),
        root_finder=optx.Newton(rtol=1e-6, atol=1e-6),
    )
    state = dj.equilibrium(membrane, volume=2.42, method=coarse, tolerance=1e-3)
    wrong = error(state.pressure, 1.8866126802449061)
    assert 1e-7 < wrong <= 2 * state.error_estimate
    assert 1e-7 < state.error_estimate < 1e-2


def test_a_diagram():
    """The article's chamber by the method: the same branch, special points and ramp."""
    ours = dj.voltage_volume(ARTICLE)
    diagram = dj.voltage_volume(ARTICLE, method=METHOD, tolerance=1e-6)
    assert diagram.complete
    assert [p.kind for p in diagram.special_points] == [p.kind for p in ours.special_points]
    for point, other in zip(diagram.special_points, ours.special_points, strict=True):
        assert error(point.voltage_squared, other.voltage_squared) < 1e-7
    assert [e.event for e in diagram.ramp().events] == [e.event for e in ours.ramp().events]
    assert diagram.area_strain == pytest.approx(ours.area_strain, rel=1e-6)


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"solver": 8}, "`solver` must be a solver of diffrax, but is 8"),
        ({"stepsize_controller": dfx.Tsit5()}, "`stepsize_controller` must be a step size controller of diffrax"),
        ({"root_finder": "newton"}, "`root_finder` must be a root finder"),
        ({"stepsize_controller": dfx.ConstantStepSize()}, "`dt0` must be given with a ConstantStepSize, but is None"),
        ({"max_steps": 0}, "`max_steps` must be a positive whole number, but is 0"),
    ],
)
def test_other_kinds_are_refused(given, name):
    with pytest.raises(ValueError, match=name):
        ShootingMethod(**given)


def test_a_method_is_no_string(membrane):
    with pytest.raises(ValueError, match="`method` must be a ShootingMethod, but is 'Tsit5'"):
        dj.equilibrium(membrane, volume=2.42, method="Tsit5")
    with pytest.raises(ValueError, match="`method` must be a ShootingMethod"):
        dj.voltage_volume(ARTICLE, method="Tsit5")
