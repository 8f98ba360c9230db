"""Diagrams on a surface against continuation, which shares neither its states nor its branches, and what it refuses."""

import itertools

import numpy as np
import pytest

import dielectric_jax as dj


@pytest.fixture(scope="module")
def surface():
    return dj.Surface.build(dj.Membrane())


def agree(found, expected, below=0.9):
    """Same special points up to a load fraction, same ramp, both complete."""
    assert found.engine == "surface" and expected.engine == "continuation"
    assert found.complete == expected.complete and len(found.branches) == len(expected.branches)
    membrane = expected.scene.membrane

    def low(diagram):
        # towards a cone folds continue as far as the error estimates allow
        limit = [float(membrane.largest_load(p.apex_stretch)) for p in diagram.special_points]
        return [p for p, q in zip(diagram.special_points, limit, strict=True) if p.voltage_squared < below * q]

    ours, theirs = low(found), low(expected)
    assert [p.kind for p in ours] == [p.kind for p in theirs]
    for a, b in zip(ours, theirs, strict=True):
        for name in ("voltage_squared", "pressure", "volume", "apex_stretch"):
            assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-8, abs=1e-11), (a, b)
        assert a.index == b.index
        assert a.error_estimate <= 1e-9 or "error_above_tolerance" in a.flags
    assert [e.event for e in found.events] == [e.event for e in expected.events]
    if expected.area_strain is not None:
        assert found.area_strain == pytest.approx(expected.area_strain, rel=1e-8)
    for a, b in zip(found.branches, expected.branches, strict=True):
        assert (a.start, a.end) == (b.start, b.end)
        assert indices(a, membrane) == indices(b, membrane)


def indices(branch, membrane, below=0.9):
    """The index of one section after the other, as far along as the branches extend."""
    low = branch.voltage_squared < below * np.asarray(membrane.largest_load(branch.apex_stretch))
    return [int(k) for k, _ in itertools.groupby(branch.index[low])]


@pytest.mark.parametrize("volume", [100.0, 484.0, 1600.0, 25000.0])
def test_chambers(surface, chamber, volume):
    found = dj.voltage_volume(dj.Scene(dj.Membrane(), dj.Chamber(volume=volume, initial_volume=2.42)), surface=surface)
    agree(found, chamber(volume))


@pytest.mark.parametrize("pressure", [0.4, 1.2, 1.5, 1.85])
def test_constant_pressure_isolated_branches_included(surface, held, pressure):
    found = dj.voltage_volume(dj.Scene(dj.Membrane(), dj.ConstantPressure(pressure)), surface=surface)
    agree(found, held(pressure))


@pytest.mark.parametrize("voltage", [0.0, 0.1, 0.15])
def test_pressure_volume_curves(surface, curve, voltage):
    found = dj.pressure_volume(dj.Membrane(), voltage, surface=surface)
    agree(found, curve(voltage))


def test_another_prestretch():
    scene = dj.Scene(dj.Membrane(prestretch=2.0), dj.Chamber(volume=300.0, initial_volume=4.0))
    agree(dj.voltage_volume(scene, surface=dj.Surface.build(scene.membrane)), dj.voltage_volume(scene))


def test_the_surface_alone(surface, chamber):
    """Without certification and extension: the same points and ramp, and the branch ends where the surface does."""
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
    found, expected = dj.voltage_volume(scene, surface=surface, certify=False, extend=False), chamber(1600.0)
    assert [p.kind for p in found.special_points] == [p.kind for p in expected.special_points[:6]]
    for a, b in zip(found.special_points, expected.special_points, strict=False):
        assert a.voltage_squared == pytest.approx(b.voltage_squared, rel=1e-8, abs=1e-11)
        assert a.volume == pytest.approx(b.volume, rel=1e-8) and a.index == b.index
    (branch,) = found.branches
    assert branch.start is branch.end is dj.numerics.Code.surface_edge
    # the diagram does not claim parts of the scanned window that it does not cover
    assert not found.complete
    assert found.area_strain == pytest.approx(expected.area_strain, rel=1e-8)
    assert (np.diff(branch.index[[0, -1]]) == 0).all() and branch.index.max() == 1


def test_single_states(surface):
    for given in ({"volume": 2.42}, {"pressure": 1.5}, {"apex_stretch": 4.0}):
        ours = dj.equilibrium(dj.Membrane(), voltage=0.05, **given, all=True, surface=surface)
        theirs = dj.equilibrium(dj.Membrane(), voltage=0.05, **given, all=True)
        assert len(ours) == len(theirs)
        for a, b in zip(ours, theirs, strict=True):
            assert a.volume == pytest.approx(b.volume, rel=1e-9) and a.index == b.index


def test_a_surface_of_another_membrane_is_refused(surface):
    scene = dj.Scene(dj.Membrane(prestretch=1.1), dj.ConstantPressure(1.0))
    flat = dj.Scene(dj.Membrane(prestretch=1.1), dj.ConstantPressure(0.0))
    for ask in (
        lambda: dj.voltage_volume(scene, surface=surface),
        lambda: dj.voltage_volume(flat, surface=surface),
        lambda: dj.pressure_volume(scene.membrane, 0.1, surface=surface),
        lambda: dj.equilibrium(scene.membrane, volume=2.0, surface=surface),
    ):
        with pytest.raises(ValueError, match="`surface` must be built for the membrane of the scene"):
            ask()
