"""Changing constants or the number of scenes compiles nothing new, and the number of cached programs is bounded."""

import collections

import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import dielectric_jax as dj
from dielectric_jax.numerics import cache
from dielectric_jax.numerics import compiled as kept

compiled = collections.Counter()


def _listen(event, _, fun_name="?", **__):
    if event == "/jax/core/compile/backend_compile_duration":
        compiled[fun_name] += 1


jax.monitoring.register_event_duration_secs_listener(_listen)


def film(share):
    """Membranes of one kind that take the same paths through the code, with different constants."""
    law = dj.VHBBreakdown(scale=1 + 0.02 * share)
    return dj.Membrane(dj.Gent(stretch_limit=270.0 + 20 * share), 1.2 + 0.03 * share, law)


def scene(share, chamber=1600.0):
    air = {"atmospheric_pressure": 50.0 + share, "volume": chamber + 50 * share}
    return dj.Scene(film(share), dj.Chamber(initial_volume=2.42 - 0.05 * share, **air))


def curves(share, _):
    dj.pressure_volume(film(share), 0.05 + 0.001 * share)
    dj.voltage_volume(scene(share))


def states(share, _):
    state = dj.equilibrium(film(share), voltage=0.05 + 0.001 * share, volume=2.42)
    dj.profile(film(share), state)
    dj.model.stability_of(scene(share), state)


def batches(share, count):
    membranes = [film(share + 0.01 * k) for k in range(2)]
    loadings = [dj.Chamber(volume=1000.0 + 100 * k, initial_volume=2.4) for k in range(count)]
    dj.continue_scenes([dj.Scene(membranes[k % 2], loading) for k, loading in enumerate(loadings)])


def surfaces(share, count):
    surface = dj.Surface.build(film(share), tolerance=1e-5, cache=False)
    dj.glance(scene(share), surface)
    dj.diagram.chamber_ramps(surface, np.linspace(1000.0, 2000.0, count), 2.4)
    surface(np.linspace(2.0, 2.5, count), 0.001)
    surface.error_bound(np.linspace(2.0, 2.5, count), 0.001)


def points(share, _):
    jax.value_and_grad(lambda v: dj.snap_voltage(scene(share).replace(chamber_volume=v)))(1600.0 + 50 * share)
    dj.area_strain(scene(share))
    dj.critical.pressure_peak(film(share), 0.01)


def shots(share, count):
    stretch = np.linspace(1.5, 2.5, count)
    dj.model.stresses(film(share).material, stretch, stretch, 0.0)
    dj.model.shoot(film(share).material, 2.0, 1.8 + 0.01 * share, 0.0)
    dj.model.explicit_map(film(share).material, 2.0, 0.001 * share, 1.2)
    film(share).check_breaks_at_apex()


def test_other_constants_and_counts_compile_nothing(monkeypatch):
    monkeypatch.setattr(kept, "_PROGRAMS", kept.Programs(most_live=1e9))  # nothing is released here
    ways = curves, states, batches, surfaces, points, shots
    for share, count in ((0.0, 3), (0.5, 17)):  # the second takes the code paths that the first did not
        for ask in ways:
            ask(share, count)
    for share, count in ((0.3, 5), (0.4, 3)):
        for ask in ways:
            before = compiled.copy()
            ask(share, count)
            assert compiled - before == {}, ask.__name__


def stress_program(most_live, monkeypatch):
    """∂W/∂λ1 at equal stretches as a separate program, with a small limit on programs."""
    programs = kept.Programs(most_live=most_live)
    monkeypatch.setattr(kept, "_PROGRAMS", programs)

    def first_stress(material, stretch):
        return [jax.vmap(jax.grad(material.energy))(stretch, stretch)]

    return kept.cached_jit(first_stress), programs


STRETCH = np.array([1.5, 2.0, 3.0])
STRESSES = (
    (dj.NeoHookean(), STRETCH - STRETCH**-5),
    (dj.MooneyRivlin(0.45, 0.05), 0.9 * (STRETCH - STRETCH**-5) + 0.1 * (STRETCH**3 - STRETCH**-3)),
    (dj.Gent(100.0), (STRETCH - STRETCH**-5) / (1 - (2 * STRETCH**2 + STRETCH**-4 - 3) / 100)),
)


@pytest.mark.parametrize("packed", [True, False])
def test_programs_out_of_use_are_given_up_and_come_back(packed, monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_enabled", None if packed else tmp_path)
    program, programs = stress_program(1.0, monkeypatch)  # one program is already too many
    monkeypatch.setattr(kept, "_read_from_cache", [])
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None if packed else folder)
    compilation_cache.reset_cache()  # JAX remembers the folder it started with
    try:
        for _ in range(2):
            before = compiled.total()
            for material, exact in STRESSES:
                np.testing.assert_allclose(program(material, STRETCH)[0], exact, rtol=1e-13)
                assert programs.count() == 1
        # the serialised programs need no compilation the second time
        assert (compiled.total() - before == 0) == packed
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()


def test_the_programs_of_a_users_functions_are_bounded(monkeypatch):
    program, programs = stress_program(2e4, monkeypatch)
    counts = []
    for k in range(12):
        material = dj.CustomMaterial(lambda a, b, c=(k + 1) / 4: c * (a**2 + b**2 + 1 / (a * b) ** 2 - 3), 10.0)
        np.testing.assert_allclose(program(material, STRETCH)[0], (k + 1) / 2 * (STRETCH - STRETCH**-5), rtol=1e-13)
        counts.append(programs.count())
    assert max(counts) < 12 and counts[-1] == max(counts)
