"""The explicit map and the scan: against the reference states, against shooting, and the branches of p = 1.2."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.diagram.landings import _field_of as scan_field
from dielectric_jax.model.chart import cached_scan, scan
from dielectric_jax.model.materials import largest_load

mapped = jax.jit(dj.model.explicit_map)
shot = jax.jit(lambda material, a, p, q: dj.model.shoot(material, a, p, q, steps=192.0))


def test_the_map_meets_every_reference_state(reference):
    columns = ("apex_stretch", "voltage_squared", "prestretch", "pressure", "volume")
    apex, q, rim, pressure, volume = (np.array([r[name] for r in reference]) for name in columns)
    p, v, slope = mapped(dj.Gent(), apex, q, rim, 192.0)
    assert (np.asarray(slope) < 0).all()
    np.testing.assert_allclose(p, pressure, rtol=1e-9)
    np.testing.assert_allclose(v, volume, rtol=1e-9)


def random_chart(material, count, most=0.85, seed=7):
    rng = np.random.default_rng(seed)
    rim = rng.uniform(1.0, 3.0, count)
    top = material.lock_up_stretch(1.0)[0]
    apex = rim + (top - rim) * rng.uniform(0.02, 0.97, count)
    return apex, rng.uniform(-1.0, most, count) * np.asarray(largest_load(material, apex)), rim


def test_the_map_is_an_equilibrium_of_shooting():
    """Two integrations with different independent variables: λ2 and R."""
    material = dj.Gent(stretch_limit=200.0)
    apex, q, rim = random_chart(material, 200)
    p, v, _ = mapped(material, apex, q, rim, 256.0)
    stretch_change, volume = shot(material, apex, p, q)
    np.testing.assert_allclose(np.asarray(stretch_change) + apex, rim, rtol=2e-10)
    np.testing.assert_allclose(volume, v, rtol=1e-9)


def test_the_map_of_a_user_s_material():
    material = dj.CustomMaterial(
        lambda a, b: 0.45 * (a**2 + b**2 + (a * b) ** -2 - 3) + 0.05 * (a**-2 + b**-2 + (a * b) ** 2 - 3), 8.0
    )
    apex, q, rim = np.array([1.5, 3.0, 6.0]), np.array([0.0, 0.02, -0.01]), np.array([1.0, 1.0, 2.0])
    p, v, slope = jax.jit(lambda *x: dj.model.explicit_map(material, *x))(apex, q, rim, 256.0)
    assert (np.asarray(slope) < 0).all()
    stretch_change, volume = jax.jit(lambda *x: dj.model.shoot(material, *x, steps=192.0))(apex, p, q)
    np.testing.assert_allclose(np.asarray(stretch_change) + apex, rim, rtol=1e-10)
    np.testing.assert_allclose(volume, v, rtol=1e-9)


def test_the_map_is_differentiable():
    """dV and dp by (λa, q): of the map by jvp, by central differences, and of the equilibrium by the implicit function theorem."""
    apex, q = 3.5, 0.01

    def pv(x):
        return jnp.stack(dj.model.explicit_map(dj.Gent(), x[0], x[1], 1.0, 128.0)[:2])

    x = np.array([apex, q])
    p, _ = pv(x)
    jacobian = np.asarray(jax.jit(jax.jacfwd(pv))(x))
    program = jax.jit(pv)
    for k, h in enumerate((1e-3, 1e-4)):
        e = np.eye(2)[k] * h
        rough = (8 * (program(x + e) - program(x - e)) - (program(x + 2 * e) - program(x - 2 * e))) / (12 * h)
        np.testing.assert_allclose(jacobian[:, k], rough, rtol=1e-7, atol=1e-9)
    # λ2(1) = 1 along the chart: G_a da + G_p dp + G_q dq = 0
    by = np.asarray(
        jax.jacfwd(lambda y: jnp.stack(dj.model.shoot(dj.Gent(), y[0], y[1], y[2], steps=128.0)))(
            jnp.array([apex, p, q])
        )
    )
    g, w = by[0] + np.array([1.0, 0, 0]), by[1]
    slope = np.array([-g[0] / g[1], -g[2] / g[1]])
    np.testing.assert_allclose(jacobian[0], slope, rtol=1e-8)
    np.testing.assert_allclose(jacobian[1], w[[0, 2]] + w[1] * slope, rtol=1e-8)


@pytest.fixture(scope="module")
def sampled(membrane):
    return scan(membrane, (1.0, membrane.lock_up_stretch()[0]), (-1.0, 1.0))


FILMS = {
    "Gent, with a cliff towards lock-up": dj.Membrane(),
    "Gent, stretched to half of its limit": dj.Membrane(dj.Gent(50.0), 2.0),
    "neo-Hookean": dj.Membrane(dj.NeoHookean()),
    "Mooney-Rivlin, whose pressure falls gently": dj.Membrane(dj.MooneyRivlin(0.4866, 0.0134), 3.54),
    "eight-chain": dj.Membrane(dj.ArrudaBoyce(10.0), 1.1),
}


@pytest.mark.parametrize("name", FILMS)
def test_the_scan_interpolates_the_map(name):
    """To 5e-3 everywhere and to 1e-6 in the median, and nearly everywhere to the noise level that `beyond` assumes."""
    film = FILMS[name]
    stretches, _, loads = dj.Scene(film, dj.ConstantVoltage(0.0)).limits()
    sampled = cached_scan(film, stretches, loads)
    rng = np.random.default_rng(3)
    i = rng.integers(20, len(sampled.apex_stretch) - 1, 1000)
    j = rng.integers(0, len(sampled.load_fraction), 1000)
    apex, q = sampled.apex_stretch[i], sampled.voltage_squared()[i, j]
    p, v, _ = mapped(film.material, apex, q, np.full(1000, float(film.prestretch)), 320.0)
    got = np.stack([sampled.pressure[i, j], sampled.volume[i, j]])
    error = np.abs(got / np.stack([p, v]) - 1).max(axis=0)
    assert np.median(error) < 1e-6
    assert error.max() < 5e-3
    assert (error > noise_of(film, apex, sampled.load_fraction[j])).mean() < 0.01


def noise_of(film, apex, fraction):
    field = scan_field(film)
    row = np.minimum(np.searchsorted(field.apex, apex), len(field.apex) - 1)
    return field.noise_at(row, fraction)


def test_steps_of_the_map_beyond_its_limit_are_refused():
    """More steps than the integration allows would end it before the rim."""
    with pytest.raises(ValueError, match=r"`steps` must be between 1 and 320, but is 512\.0"):
        dj.model.explicit_map(dj.Gent(), 2.0, 0.0, 1.0, 512.0)


def test_every_state_of_the_chart_is_inflated(sampled):
    """Every state of the window has p > 0 and 0 < V < 468.911, the volume at the limiting stretch."""
    assert np.isfinite(sampled.pressure).all() and (sampled.pressure > 0).all()
    assert (sampled.volume > 0).all() and (sampled.volume < 468.911).all()


def long(contours):
    return [c for c in contours if np.ptp(c[:, 0]) > 0.05]


def distance(line, point):
    """From a point to a polyline."""
    step = np.diff(line, axis=0)
    along = np.clip(((point - line[:-1]) * step).sum(axis=1) / (step**2).sum(axis=1), 0, 1)
    return np.linalg.norm(line[:-1] + along[:, None] * step - point, axis=1).min()


def test_two_branches_at_p_1_2(sampled, reference):
    """The main branch and the isolated one; every reference state of p = 1.2 lies on one of them."""
    found = long(sampled.contours(dj.ConstantPressure(1.2).condition()))
    assert len(found) == 2
    found.sort(key=lambda c: c[:, 0].min())
    for ref in reference:
        if ref["constant_pressure"] == 1.2:
            line = found["isolated" in ref["label"]][:, [0, 2]] / [1.0, 0.02]
            assert distance(line, np.array([ref["apex_stretch"], ref["voltage_squared"] / 0.02])) < 0.01
    for line in found:
        # contours are linear between the points of the fine grid
        np.testing.assert_allclose(line[:, 1], 1.2, rtol=5e-3)


@pytest.mark.parametrize(("pressure", "count"), [(1.82, 1), (0.8, 2), (1.9, 1)])
def test_branches_at_other_pressures(sampled, pressure, count):
    """Two where the p–V valley at Φ = 0 (p 1.3617) lies above the pressure; one where all three states at Φ = 0 are joined."""
    assert len(long(sampled.contours(dj.ConstantPressure(pressure).condition()))) == count


def test_two_loads_at_one_apex_stretch(sampled):
    """p = 1.2 has two q at one λa between 7.7 and 10.1."""
    isolated = max(long(sampled.contours(dj.ConstantPressure(1.2).condition())), key=lambda c: c[:, 0].max())
    crossings = np.diff(isolated[:, 0] > 9.0) != 0
    assert crossings.sum() == 2
    assert np.ptp(isolated[:-1][crossings][:, 2]) > 0.01
