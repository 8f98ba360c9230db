"""What the tests of designs share: the paper's chamber of 1600 A³, and the surface of its membrane."""

import pytest

import dielectric_jax as dj


@pytest.fixture(scope="session")
def surface():
    return dj.Surface.build(dj.Membrane())


@pytest.fixture(scope="session")
def scene():
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
