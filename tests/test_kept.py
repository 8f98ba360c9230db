"""Traced programs are kept in the cache folder, for what only this package defines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import cache, kept


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_enabled", tmp_path)
    return tmp_path / "programs"


def fresh():
    """A program that no process has seen, of a material and stretches; and how often it was traced."""
    traces = []

    def first_stress(material, stretch):
        traces.append(1)
        return [jax.vmap(jax.grad(material.energy))(stretch, stretch)]

    return kept.kept_jit(first_stress), traces


def gent_stress(stretch_limit, stretch):
    """∂W/∂λ1 of a Gent membrane at equal stretches."""
    return (stretch - stretch**-5) / (1 - (2 * stretch**2 + stretch**-4 - 3) / stretch_limit)


def test_a_later_program_is_read_not_traced(folder):
    stretch = jnp.array([1.5, 2.0, 3.0])
    for expected in (1, 0):
        program, traces = fresh()
        for limit in (270.0, 40.0):  # numbers are arguments: one program for both
            np.testing.assert_allclose(program(dj.Gent(limit), stretch)[0], gent_stress(limit, stretch), rtol=1e-13)
        assert len(traces) == expected
    assert len(list(folder.iterdir())) == 1


def test_a_damaged_program_is_made_anew(folder):
    stretch = jnp.array([2.0])
    fresh()[0](dj.Gent(), stretch)
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    for broken in (whole[:-1] + b"x", b"", whole[: len(whole) // 2]):
        path.write_bytes(broken)
        for expected in (1, 0):
            program, traces = fresh()
            np.testing.assert_allclose(program(dj.Gent(), stretch)[0], gent_stress(270.0, stretch), rtol=1e-13)
            assert len(traces) == expected


def test_kinds_and_shapes_have_programs_of_their_own(folder):
    program, _ = fresh()
    for material in (dj.Gent(), dj.NeoHookean()):
        for count in (1, 2):
            program(material, jnp.full(count, 2.0))
    assert len(list(folder.iterdir())) == 4


def test_a_users_function_is_never_kept(folder):
    program, _ = fresh()
    stretch = jnp.array([2.0])
    for factor in (0.5, 1.0):  # two functions of one name: a kept program would answer for the other
        material = dj.CustomMaterial(lambda a, b, c=factor: c * (a**2 + b**2 + 1 / (a * b) ** 2 - 3), 10.0)
        np.testing.assert_allclose(program(material, stretch)[0], 2 * factor * (stretch - stretch**-5), rtol=1e-13)
    assert not folder.exists()

    class Mine(dj.Gent):
        pass

    assert kept.of_this_package(dj.Gent())
    assert kept.of_this_package(dj.Surface.build(dj.Membrane(dj.Gent(10.0)), tolerance=1e-5, cache=False))
    assert not kept.of_this_package(Mine())


def test_inside_a_transformation_it_is_plain_jit(folder):
    program, _ = fresh()
    slope = jax.grad(lambda limit: program(dj.Gent(limit), jnp.array([3.0]))[0][0])(270.0)
    invariant = 2 * 3.0**2 + 3.0**-4 - 3
    exact = -(3 - 3.0**-5) * invariant / 270.0**2 / (1 - invariant / 270.0) ** 2
    assert float(slope) == pytest.approx(exact, rel=1e-12)
    assert not folder.exists()


def test_without_a_folder_nothing_is_written(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_enabled", None)
    monkeypatch.chdir(tmp_path)
    fresh()[0](dj.Gent(), jnp.array([2.0]))
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_exported_still_runs(folder):
    def with_callback(material, stretch):
        shape = jax.ShapeDtypeStruct(stretch.shape, stretch.dtype)
        return [jax.pure_callback(lambda x: np.asarray(2 * x), shape, stretch)]

    program = kept.kept_jit(with_callback)
    assert float(program(dj.Gent(), jnp.array([2.0]))[0][0]) == 4.0
    assert not folder.exists()
