"""Traced programs are cached in the cache folder, if only this package defines what they depend on."""

import os
import pathlib
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.numerics import cache
from dielectric_jax.numerics import compiled as kept


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_enabled", tmp_path)
    monkeypatch.setattr(cache, "_refused", set())
    return tmp_path / "programs"


_TRACES: list = []


def fresh():
    """A new program of a material and stretches, and a count of how often it was traced."""
    _TRACES.clear()

    def first_stress(material, stretch):
        _TRACES.append(1)
        return [jax.vmap(jax.grad(material.energy))(stretch, stretch)]

    return kept.cached_jit(first_stress), _TRACES


def power_program(power):
    """A program whose name does not say what it closes over."""

    def program(material, stretch):
        return [material.energy(stretch, stretch) * 0.0 + stretch**power]

    return kept.cached_jit(program)


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


def test_programs_of_one_factory_do_not_answer_for_each_other(folder):
    """They share name, arguments and shapes; they are distinguished by what they close over, or they are not cached."""
    stretch = jnp.array([2.0])
    for _ in range(2):  # traced, then read
        for power in (2, 3):
            assert float(power_program(power)(dj.Gent(), stretch)[0][0]) == 2.0**power
    assert len(list(folder.iterdir())) == 2
    for power in (jnp.asarray(2.0), jnp.asarray(3.0)):  # an array has no name
        assert float(power_program(power)(dj.Gent(), stretch)[0][0]) == pytest.approx(2.0 ** float(power))
    assert len(list(folder.iterdir())) == 2


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
    for factor in (0.5, 1.0):  # two functions of one name: a cached program would be used for the other
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

    program = kept.cached_jit(with_callback)
    assert float(program(dj.Gent(), jnp.array([2.0]))[0][0]) == 4.0
    assert not folder.exists()


posix = pytest.mark.skipif(not hasattr(os, "getuid"), reason="no numbers of users")
NOBODY = 65534


def given_away(path):
    """Makes another user the owner, as only root may."""
    os.chown(path, NOBODY, -1)


root = pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives files away")


def crafted(path, factor):
    """Puts a program of the same name and a valid digest in a program's place, whose answers are `factor` times the right ones."""
    content = path.read_bytes()[32:]
    exported = jax.export.deserialize(bytearray(content))
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in exported.in_avals]
    wrong = jax.export.export(jax.jit(lambda *leaves: [factor * v for v in exported.call(*leaves)]))(*shapes)
    content = bytes(wrong.serialize())
    cache.write_own(path, kept.hashlib.sha256(content).digest() + content)


WRITABLE = {"folder": 0o777, "group": 0o775, "file": 0o666}


@posix
@pytest.mark.parametrize("who", ["nobody else", *WRITABLE, pytest.param("owner", marks=root)])
def test_a_program_that_others_may_have_written_is_not_run(folder, who):
    stretch = jnp.array([2.0])
    fresh()[0](dj.Gent(), stretch)
    (path,) = folder.iterdir()
    assert (path.stat().st_mode & 0o777, folder.stat().st_mode & 0o777) == (0o600, 0o700)
    crafted(path, 2.0)
    if who in WRITABLE:
        (path if who == "file" else folder).chmod(WRITABLE[who])
    elif who == "owner":
        given_away(path)
    program, traces = fresh()
    if who == "nobody else":  # the attack works: a cached program is run
        assert float(program(dj.Gent(), stretch)[0][0]) == pytest.approx(2 * gent_stress(270.0, 2.0), rel=1e-13)
        return
    with pytest.warns(RuntimeWarning, match="must be this user's alone") as said:
        found = program(dj.Gent(), stretch)[0][0]
    assert float(found) == pytest.approx(gent_stress(270.0, 2.0), rel=1e-13)
    assert len(traces) == 1 and len(said) == 1 and str(said[0].message).count(". ") == 0
    with warnings.catch_warnings(action="error"):  # the warning appears once
        fresh()[0](dj.Gent(), jnp.array([2.0]))


@posix
@pytest.mark.parametrize("who", ["folder", "file inside", "parent", "link", pytest.param("owner", marks=root)])
def test_a_folder_that_others_may_change_is_refused(monkeypatch, tmp_path, who):
    monkeypatch.delenv("DIELECTRIC_JAX_CACHE", raising=False)
    monkeypatch.setattr(cache, "_enabled", None)
    monkeypatch.setattr(cache, "_refused", set())
    jax_folder = jax.config.jax_compilation_cache_dir
    own = tmp_path / "shared" / "cache"
    try:
        assert dj.numerics.enable_compilation_cache(own) == cache.enabled_folder() == own
        assert own.stat().st_mode & 0o777 == 0o700
        os.chmod(own.parent, 0o1777)  # like /tmp: others may not rename files of this user
        assert dj.numerics.enable_compilation_cache(own) == own
        if who == "folder":
            own.chmod(0o770)
        elif who == "parent":
            own.parent.chmod(0o777)
        elif who == "file inside":
            own.chmod(0o755)
            (own / "jit_f-cache").touch()
            (own / "jit_f-cache").chmod(0o666)
        elif who == "owner":
            given_away(own)
        else:  # this user's own link, to where others may write
            own.chmod(0o777)
            (tmp_path / "link").symlink_to(own)
            own = tmp_path / "link"
        with pytest.warns(RuntimeWarning, match="is not used"):
            assert dj.numerics.enable_compilation_cache(own) is None
        assert cache.enabled_folder() is None
        monkeypatch.setenv("DIELECTRIC_JAX_CACHE", str(own))
        if who != "file inside":  # a file of JAX does not affect the surfaces beside it
            assert dj.Surface.path_of(dj.Membrane(), 1e-9) is None
    finally:
        jax.config.update("jax_compilation_cache_dir", jax_folder)


@root
def test_a_surface_of_another_user_is_built_anew(monkeypatch, tmp_path):
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_refused", set())
    membrane = dj.Membrane(dj.Gent(10.0))
    right = dj.Surface.build(membrane, tolerance=1e-5)
    path = dj.Surface.path_of(membrane, 1e-5)
    # the logarithms of all quantities moved, with the right fingerprint and a valid checksum
    eqx.tree_at(lambda surface: surface.coefficients, right, right.coefficients + 0.1).save(path)
    assert float(dj.Surface.build(membrane, tolerance=1e-5)(1.5, 0.0).pressure) != float(right(1.5, 0.0).pressure)
    given_away(path)
    with pytest.warns(RuntimeWarning, match="belongs to another user"):
        found = dj.Surface.build(membrane, tolerance=1e-5)
    assert float(found(1.5, 0.0).pressure) == float(right(1.5, 0.0).pressure)
    assert path.stat().st_uid == 0 and path.stat().st_mode & 0o777 == 0o600  # it replaced the other file


def test_a_cache_of_the_users_for_compiled_programs_stays(monkeypatch, tmp_path):
    monkeypatch.delenv("DIELECTRIC_JAX_CACHE", raising=False)
    monkeypatch.setattr(cache, "_enabled", None)
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
        assert dj.numerics.enable_compilation_cache(tmp_path / "ours") == cache.enabled_folder() == tmp_path / "ours"
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "theirs")
        jax.config.update("jax_compilation_cache_dir", None)
        for name in ("ours", "others"):  # our own folder follows the last call
            dj.numerics.enable_compilation_cache(tmp_path / name)
            assert jax.config.jax_compilation_cache_dir == str(tmp_path / name)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_without_numbers_of_users_nothing_is_asked(folder, monkeypatch):
    monkeypatch.delattr(os, "getuid", raising=False)
    folder.mkdir(mode=0o777)
    folder.chmod(0o777)
    assert cache.is_own(pathlib.Path(folder))


def test_a_folder_that_cannot_be_made_is_refused(monkeypatch, tmp_path):
    monkeypatch.delenv("DIELECTRIC_JAX_CACHE", raising=False)
    monkeypatch.setattr(cache, "_enabled", None)
    monkeypatch.setattr(cache, "_refused", set())
    (tmp_path / "file").touch()
    with pytest.warns(RuntimeWarning, match="is not used"):
        assert dj.numerics.enable_compilation_cache(tmp_path / "file" / "cache") is None
