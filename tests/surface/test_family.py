"""The family of prestretches against reference equilibria, shooting, energy identities, single surfaces, and its own file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.model.materials import largest_load
from dielectric_jax.surface.build import relative_error


@pytest.fixture(scope="module")
def family():
    return dj.surface.SurfaceFamily.build(dj.Gent(), prestretch=(1.0, 3.0), tolerance=1e-7, cache=False)


def test_reference_states(family, reference):
    names = (
        "apex_stretch",
        "voltage_squared",
        "prestretch",
        "pressure",
        "volume",
        "height",
        "breakdown_ratio",
        "charge",
    )
    rows = {n: np.array([r[n] if r[n] is not None else np.nan for r in reference], float) for n in names}
    place = [rows[n] for n in names[:3]]
    inside = np.asarray(family.covers(*place))
    # states outside lie beyond the domain, which ends at 1.3 times the load of breakdown
    assert (rows["breakdown_ratio"][~inside] ** 2 > 1.29).all()
    assert all((inside & (place[2] == rim)).sum() >= least for rim, least in ((1.0, 40), (2.0, 15)))
    found, bound = family(*place), np.asarray(family.error_bound(*place))
    for name in ("pressure", "volume", "height"):
        value = np.asarray(getattr(found, name))
        assert (relative_error(value, rows[name]) <= bound + 1e-11)[inside].all(), name
        assert np.isnan(value[~inside]).all()
    loaded = inside & (place[1] >= 0)
    assert (relative_error(np.asarray(found.charge), rows["charge"]) <= bound + 1e-11)[loaded].all()


def test_random_prestretches_by_shooting(family):
    random = np.random.default_rng(3)
    for _ in range(6):
        rim = random.uniform(1, 3)
        apex = rim + (11.5 - rim) * random.uniform() ** 2
        voltage = 0.6 * np.sqrt(min(float(largest_load(dj.Gent(), apex)), (6.6 / apex**2) ** 2))
        state = dj.equilibrium(dj.Membrane(prestretch=rim), voltage=voltage, apex_stretch=apex)
        found = family(apex, voltage**2, rim)
        bound = float(family.error_bound(apex, voltage**2, rim))
        assert bound < 4e-7
        for name, own in (("pressure", 1e-10), ("volume", 1e-10), ("height", 1e-8), ("charge", 1e-8)):  # of the shot
            assert relative_error(float(getattr(found, name)), getattr(state, name)) <= bound + own, (name, rim, apex)


def test_slope_by_the_prestretch_against_shooting(family):
    apex, q, rim, step = 4.0, 0.01, 1.7, 1e-3

    def shot(rim):
        state = dj.equilibrium(dj.Membrane(prestretch=rim), voltage=q**0.5, apex_stretch=apex)
        return np.array([state.pressure, state.volume])

    far, near = ((shot(rim + h) - shot(rim - h)) / (2 * h) for h in (2 * step, step))
    exact = (4 * near - far) / 3  # the error of the differences falls as the fourth power
    slope = jax.jacrev(lambda rim: jnp.stack(family(apex, q, rim)[:2]))(rim)
    assert np.allclose(slope, exact, rtol=1e-6)


def test_energy_identities_and_maxwell(family):
    """dH = p dV − (C/2) dq at fixed λ0, H = U − qC/2; and ∂V/∂q|p = (∂C/∂p|q)/2."""

    def quantities(x):
        p, v, _, c, u = family.at_load_fraction(x[0], x[1] / largest_load(dj.Gent(), x[0]), x[2])
        return jnp.stack([p, v, c, u - x[1] * c / 2])

    values = jax.jit(lambda x: (quantities(x), jax.jacfwd(quantities)(x)))
    for point in ((2.0, 0.01, 1.2), (5.0, 0.005, 2.6), (8.0, 0.004, 1.0 + 1e-6), (3.0, -0.02, 2.9), (10.5, 0.003, 2.0)):
        (p, _, c, _), (dp, dv, dc, dh) = values(jnp.array(point))
        assert np.allclose(dh[0], p * dv[0], rtol=1e-5)
        assert np.allclose(dh[1], p * dv[1] - c / 2, rtol=1e-5, atol=1e-4)
        assert np.allclose(dv[1] - dv[0] * dp[1] / dp[0], dc[0] / dp[0] / 2, rtol=1e-4)


def test_energy_by_the_prestretch(family):
    """At fixed q and λa the pressure and the force at the rim do the work: ∂H/∂λ0 = p ∂V/∂λ0 + 2π s1 cos θ.

    The force is read from a profile of the shooting engine, not from the family.
    """
    apex, q, rim = 3.0, 0.01, 1.5

    def quantities(rim):
        p, v, _, c, u = family.at_load_fraction(apex, q / largest_load(dj.Gent(), apex), rim)
        return jnp.stack([p, v, u - q * c / 2])

    (p, _, _), (_, dv, dh) = quantities(rim), jax.jacfwd(quantities)(rim)
    membrane = dj.Membrane(prestretch=rim)
    state = dj.equilibrium(membrane, voltage=q**0.5, apex_stretch=apex)
    own = dj.profile(membrane, state)
    force = own.stress_1[-1] / own.stretch_1[-1] * np.cos(own.theta[-1])
    assert abs(float(dh - p * dv) - 2 * np.pi * force) < 1e-5 * abs(force)


@pytest.mark.parametrize("rim", [1.003, 2.0])
def test_surfaces_of_the_family(family, rim):
    surface, built = family.surface(rim), dj.Surface.build(dj.Membrane(prestretch=rim), tolerance=1e-7, cache=False)
    assert surface.belongs_to(built.membrane)
    random = np.random.default_rng(4)
    apex, t = random.uniform(rim + 0.01, 11.6, 2000), random.uniform(-0.75, 0.9, 2000)
    q = t * np.asarray(largest_load(dj.Gent(), apex))
    both = np.asarray(surface.covers(apex, q) & built.covers(apex, q))
    assert both.sum() > 0.98 * np.asarray(built.covers(apex, q)).sum() > 500
    bound = np.asarray(surface.error_bound(apex, q))
    assert (bound[both] >= np.asarray(family.error_bound(apex, q, rim))[both]).all() and bound[both].max() <= 4e-7
    allowed = bound + np.asarray(built.error_bound(apex, q))
    jitted = jax.jit(lambda surface: surface.at_load_fraction(apex, t))
    for value, exact in zip(jitted(surface), jitted(built), strict=True):
        assert (relative_error(np.asarray(value), np.asarray(exact)) <= allowed)[both].all()


def test_domain_and_shapes(family):
    for outside in ((12.0, 0.0, 2.0), (2.0, 0.0, 3.01), (2.0, 0.0, 2.0), (1.0, 0.0, 1.0), (2.0, 0.0, 0.9)):
        assert not bool(family.covers(*outside)) and float(family.error_bound(*outside)) == np.inf
        assert all(np.isnan(v) for v in family(*outside))
    for inside in ((2.0, 0.0, 1.0), (11.6, 0.0, 3.0), (1.0001, 0.0, 1.0), (3.5, 0.0, 3.0)):
        assert bool(family.covers(*inside))
    state = family(jnp.full((40, 1), 4.0), 0.0, jnp.linspace(1, 3, 3))
    # vectorised lanes and the remaining ones may differ by rounding
    assert state.volume.shape == (40, 3) and np.allclose(state.volume, state.volume[0], rtol=1e-15, atol=0)
    assert family(jnp.zeros(0), 0.0, 1.0).volume.shape == (0,)
    each = jax.vmap(lambda rim: family(4.0, 0.0, rim).volume)(jnp.linspace(1, 3, 3))
    assert np.allclose(each, state.volume[0], rtol=1e-14)
    assert np.isnan(float(family(2.0, -0.01, 1.0).charge)) and float(family(2.0, 0.0, 1.0).charge) == 0


def test_file(family, tmp_path):
    path = tmp_path / "family.npz"
    family.save(path)
    again = dj.surface.SurfaceFamily.load(path, dj.Gent())
    assert again.prestretch == family.prestretch and again.tolerance == family.tolerance
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(np.asarray(a) == np.asarray(b))), family, again))
    with pytest.raises(ValueError, match="`material` and `breakdown` must be those"):
        dj.surface.SurfaceFamily.load(path, dj.Gent(271.0))
    with pytest.raises(ValueError, match="`material` and `breakdown` must be those"):
        dj.surface.SurfaceFamily.load(path, dj.Gent(), breakdown=dj.ConstantBreakdown(5.0))
    with pytest.raises(ValueError, match="must hold a surface of the format"):
        dj.Surface.load(path, dj.Membrane())
    with pytest.raises(ValueError, match="no file"):
        dj.surface.SurfaceFamily.load(tmp_path / "none.npz", dj.Gent())
    whole = path.read_bytes()
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 16
    for content in (bytes(damaged), whole[: len(whole) // 2], b"nothing"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="damaged"):
            dj.surface.SurfaceFamily.load(path, dj.Gent())


def test_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", str(tmp_path))
    options = {"prestretch": (1.0, 1.1), "tolerance": 1e-3}
    first = dj.surface.SurfaceFamily.build(dj.Gent(10.0), **options)
    (kept,) = tmp_path.rglob("*.npz")
    monkeypatch.setattr("dielectric_jax.surface.family.build_trajectory_elements", None)  # now read from the file
    second = dj.surface.SurfaceFamily.build(dj.Gent(10.0), **options)
    assert np.array_equal(first.coefficients, second.coefficients)
    kept.write_bytes(b"broken")
    with pytest.raises(TypeError):  # a damaged file is built again
        dj.surface.SurfaceFamily.build(dj.Gent(10.0), **options)


def test_bad_input(family):
    for wrong in ((0.9, 2.0), (2.0, 1.0), (1.0, 1.0), 2.0, (1.0, float("nan")), (1.0, 2.0, 3.0)):
        with pytest.raises(ValueError, match="`prestretch` must be two rising numbers"):
            dj.surface.SurfaceFamily.build(dj.Gent(), prestretch=wrong)
    with pytest.raises(ValueError, match="below the material's largest stretch"):
        dj.surface.SurfaceFamily.build(dj.Gent(), prestretch=(1.0, 12.0))
    with pytest.raises(ValueError, match="`tolerance`"):
        dj.surface.SurfaceFamily.build(dj.Gent(), tolerance=1e-14)
    with pytest.raises(ValueError, match="`material` must be a material"):
        dj.surface.SurfaceFamily.build(dj.Membrane())
    for wrong in (0.99, 3.2):
        with pytest.raises(ValueError, match="`prestretch` must lie between 1 and 3"):
            family.surface(wrong)
