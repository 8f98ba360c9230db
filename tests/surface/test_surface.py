"""The surface against reference equilibria, energy identities, new shots, and its own file."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.model.chart import explicit_map
from dielectric_jax.surface.elements import chebyshev


@pytest.fixture(scope="module")
def surface():
    return dj.Surface.build(dj.Membrane(), cache=False)


def off(value, reference):
    """The measure of error estimates."""
    return np.abs(np.asarray(value) - reference) / np.maximum(np.abs(reference), 1e-3)


def columns(reference, prestretch):
    rows = [r for r in reference if r["prestretch"] == prestretch]
    names = ("apex_stretch", "voltage_squared", "pressure", "volume", "height", "charge", "breakdown_ratio")
    return {n: np.array([r[n] if r[n] is not None else np.nan for r in rows], float) for n in names}


@pytest.mark.parametrize("prestretch", [1.0, 2.0])
def test_reference_states(reference, prestretch):
    surface = dj.Surface.build(dj.Membrane(prestretch=prestretch), cache=False)
    ref = columns(reference, prestretch)
    inside = np.asarray(surface.covers(ref["apex_stretch"], ref["voltage_squared"]))
    # states outside lie beyond the domain, which ends at 1.3 times the load of breakdown
    assert (ref["breakdown_ratio"][~inside] ** 2 > 1.29).all()
    assert inside.sum() >= 15
    found = surface(ref["apex_stretch"], ref["voltage_squared"])
    bound = np.asarray(surface.error_bound(ref["apex_stretch"], ref["voltage_squared"]))
    for name in ("pressure", "volume", "height"):
        error = off(getattr(found, name), ref[name])
        assert (error[inside] < 1e-10).all(), name
        assert (error[inside] <= bound[inside] + 1e-11).all(), name
        assert np.isnan(np.asarray(getattr(found, name))[~inside]).all()
    loaded = inside & (ref["voltage_squared"] >= 0)
    assert (off(found.charge, ref["charge"])[loaded] < 1e-10).all()


def test_fresh_states_of_the_explicit_map(surface):
    random = np.random.default_rng(1)
    apex, t = random.uniform(1.01, 11.6, 3000), random.uniform(-0.75, 0.9, 3000)
    q = t * np.asarray(surface.membrane.largest_load(apex))
    inside = np.asarray(surface.covers(apex, q))
    p, v, _, (z, c, u) = jax.jit(lambda a, q: explicit_map(dj.Gent(), a, q, 1.0, 319.0, outputs=True))(apex, q)
    values = surface.at_load_fraction(apex, t)
    bound = np.asarray(surface.error_bound(apex, q))
    assert inside.sum() > 500
    for value, exact in zip(values, (p, v, z, c, u), strict=True):
        assert (off(value, np.asarray(exact))[inside] <= bound[inside]).all()
    assert float(np.max(bound[inside])) < 4e-9


def test_energy_identities_and_maxwell(surface):
    """dU = p dV + (q C/2)' …: with H = U − qC/2, dH = p dV − C/2 dq; and ∂V/∂q|p = (∂C/∂p|q)/2."""

    def quantities(x):
        p, v, _, c, u = surface.at_load_fraction(x[0], x[1] / dj.model.materials.largest_load(dj.Gent(), x[0]))
        return jnp.stack([p, v, c, u - x[1] * c / 2])

    for point in ((2.0, 0.01), (5.0, 0.005), (8.0, 0.004), (3.0, -0.02), (10.5, 0.003)):
        x = jnp.array(point)
        p, _, c, _ = quantities(x)
        dp, dv, dc, dh = jax.jacfwd(quantities)(x)
        assert np.allclose(dh[0], p * dv[0], rtol=1e-7)
        assert np.allclose(dh[1], p * dv[1] - c / 2, rtol=1e-7, atol=1e-6)
        # along p = const: dλa = −(p_q/p_a) dq; at q = const ∂C/∂p = C_a/p_a
        assert np.allclose(dv[1] - dv[0] * dp[1] / dp[0], dc[0] / dp[0] / 2, rtol=1e-6)


def test_second_derivatives_are_symmetric_and_match_differences(surface):
    def pressure(x):
        return surface(x[0], x[1]).pressure

    x = jnp.array([6.0, 0.004])
    hessian = jax.hessian(pressure)(x)
    assert np.allclose(hessian, hessian.T, rtol=1e-12)
    step = 1e-4
    slope = jax.grad(pressure)
    difference = (slope(x + jnp.array([step, 0])) - slope(x - jnp.array([step, 0]))) / (2 * step)
    assert np.allclose(difference, hessian[0], rtol=1e-5)


def test_domain_and_breakdown_curve(surface):
    assert bool(surface.covers(2.0, 0.0)) and not bool(surface.covers(0.9, 0.0)) and not bool(surface.covers(12.0, 0.0))
    outside = surface(12.0, 0.0)
    assert all(np.isnan(v) for v in outside)
    assert float(surface.error_bound(12.0, 0.0)) == np.inf
    apex = 8.10285526922  # breakdown of V_C = 1600
    assert abs(float(surface.breakdown_load(apex)) / 0.100970094106**2 - 1) < 1e-9
    assert np.isnan(float(surface(2.0, -0.01).charge)) and float(surface(2.0, 0.0).charge) == 0


def test_material_derivatives_by_the_implicit_rule_and_by_rebuilding(surface):
    """dp/dJ and dV/dJ at fixed (λa, q): the formula in the docstring, differences of the explicit map, and of other surfaces."""
    step = 0.5
    others = [dj.Surface.build(dj.Membrane(dj.Gent(270.0 + d)), cache=False) for d in (-step, step)]
    for apex, q in ((2.4, 0.005), (6.0, 0.01), (9.5, 0.003)):
        state = surface(apex, q)

        def shot(limit, pressure, apex=apex, q=q):
            rim = dj.model.shoot(dj.Gent(limit), apex, pressure, q, steps=64.0)
            return jnp.stack([rim.stretch_change, rim.volume])

        by_limit, by_pressure = jax.jacfwd(shot, argnums=(0, 1))(270.0, state.pressure)
        pressure_rate = -by_limit[0] / by_pressure[0]
        volume_rate = by_limit[1] + by_pressure[1] * pressure_rate
        mapped = [dj.model.explicit_map(dj.Gent(270.0 + d), apex, q, 1.0, 128.0) for d in (-step, step)]
        rebuilt = [(o(apex, q).pressure, o(apex, q).volume) for o in others]
        for pair in (mapped, rebuilt):
            for k, (rate, value) in enumerate(((pressure_rate, state.pressure), (volume_rate, state.volume))):
                # both ends are right to 1e-9; the step's own error is (step/distance of J to lock-up)², up to 3e-5 here
                by_difference = float(pair[1][k] - pair[0][k]) / (2 * step)
                assert abs(by_difference - rate) < 2e-9 / (2 * step) * abs(value) + 1e-4 * abs(rate)


def test_file(surface, tmp_path):
    path = tmp_path / "surface.npz"
    surface.save(path)
    again = dj.Surface.load(path, dj.Membrane())
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(np.asarray(a) == np.asarray(b))), surface, again))
    with pytest.raises(ValueError, match="`membrane` must be the one"):
        dj.Surface.load(path, dj.Membrane(prestretch=1.01))
    with pytest.raises(ValueError, match="`membrane` must be the one"):
        dj.Surface.load(path, dj.Membrane(dj.Gent(271.0)))
    with pytest.raises(ValueError, match="no file"):
        dj.Surface.load(tmp_path / "none.npz", dj.Membrane())
    whole = path.read_bytes()
    for place in (len(whole) // 3, len(whole) // 2, len(whole) - 4000):
        damaged = bytearray(whole)
        damaged[place] ^= 16
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged"):
            dj.Surface.load(path, dj.Membrane())
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="damaged"):
        dj.Surface.load(path, dj.Membrane())


def test_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", str(tmp_path))
    membrane = dj.Membrane(dj.Gent(40.0), prestretch=1.5)
    first = dj.Surface.build(membrane, tolerance=1e-6)
    kept = list(tmp_path.rglob("*.npz"))
    assert len(kept) == 1
    kept[0].write_bytes(b"broken")
    second = dj.Surface.build(membrane, tolerance=1e-6)  # a damaged file is built again
    assert np.array_equal(first.coefficients, second.coefficients)
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", "off")
    dj.Surface.build(membrane, tolerance=1e-6)
    assert len(list(tmp_path.rglob("*.npz"))) == 1


@pytest.mark.parametrize(
    "material", [dj.NeoHookean(), dj.ArrudaBoyce(chain_links=40.0)], ids=["neo-Hookean", "8-chain"]
)
def test_other_materials(material):
    surface = dj.Surface.build(dj.Membrane(material), tolerance=1e-8, cache=False)
    apex = np.linspace(1.2, 0.95 * dj.Membrane(material).lock_up_stretch()[0], 40)
    p, v, _ = explicit_map(material, apex, np.zeros(40), 1.0, 200.0)
    found = surface(apex, np.zeros(40))
    assert (off(found.pressure, np.asarray(p)) < 1e-8).all() and (off(found.volume, np.asarray(v)) < 1e-8).all()


def test_bad_input():
    with pytest.raises(ValueError, match="`membrane` must be a Membrane, but is a Gent"):
        dj.Surface.build(dj.Gent())
    for wrong in (-1.0, 0.0, 1e-14, float("nan")):
        with pytest.raises(ValueError, match="`tolerance`"):
            dj.Surface.build(dj.Membrane(), tolerance=wrong)


def test_derivatives_of_the_basis_to_any_order():
    """T_k and its derivatives are NumPy's, forward and reverse, alone and side by side."""
    x = np.linspace(-1.0, 1.0, 7)
    exact = [
        np.polynomial.chebyshev.chebval(x, np.polynomial.chebyshev.chebder(np.eye(20), order)) for order in range(4)
    ]
    function, scale = functools.partial(chebyshev, count=20), (1.0, 19.0**2, 19.0**4, 19.0**6)
    for order in range(4):
        found = jax.vmap(function)(x)
        np.testing.assert_allclose(found.T, exact[order], rtol=0, atol=1e-15 * scale[order])
        function = jax.jacfwd(function)
    backward = jax.vmap(jax.jacrev(functools.partial(chebyshev, count=20)))(x)
    np.testing.assert_allclose(backward.T, exact[1], rtol=0, atol=1e-15 * scale[1])
