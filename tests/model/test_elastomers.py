"""Mooney–Rivlin, Ogden and permittivities of stretch: reductions, closed forms, and the energy route."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.apps.cli import main
from dielectric_jax.model.chart import scan
from dielectric_jax.model.materials import capacitance, largest_load

L1, L2 = np.meshgrid(np.linspace(0.7, 9.0, 9), np.linspace(0.7, 9.0, 9))
MOONEY = dj.MooneyRivlin(c1=0.4, c2=0.1)
RUBBER = dj.Electrostrictive(dj.Gent(), thickness_coefficient=0.1, stretch_coefficient=-0.01)


def assert_same(one, other, rtol=1e-13):
    for a, b in zip(dj.model.stresses(one, L1, L2, 0.05), dj.model.stresses(other, L1, L2, 0.05), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-12)
    np.testing.assert_allclose(one.energy(L1, L2), other.energy(L1, L2), rtol=rtol, atol=1e-13)


def test_sixty_terms_are_the_sum_of_their_own():
    """Also with a leaf that differs from lane to lane, as batches of scenes have."""
    exponents = np.linspace(-3.0, 5.0, 60)
    moduli = 2 / 60 / exponents
    s1, _, s11, _ = dj.model.stresses(dj.Ogden(moduli=moduli, exponents=exponents), L1, L2, 0.0)
    m, x, a, b = moduli[:, None], exponents[:, None], np.ravel(L1), np.ravel(L2)
    np.testing.assert_allclose(np.ravel(s1), (m * (a ** (x - 1) - (a * b) ** -x / a)).sum(axis=0), rtol=1e-12)
    slope = m * ((x - 1) * a ** (x - 2) + (x + 1) * (a * b) ** -x / a**2)
    np.testing.assert_allclose(np.ravel(s11), slope.sum(axis=0), rtol=1e-12)
    energies = m / x * (a**x + b**x + (a * b) ** -x - 3)
    first = np.linspace(0.9, 1.1, a.size)
    lanes = dj.Ogden(moduli=moduli, exponents=exponents)
    lanes = eqx.tree_at(lambda film: film.moduli[0], lanes, first * moduli[0])
    expected = energies.sum(axis=0) + (first - 1) * energies[0]
    np.testing.assert_allclose(lanes.energy(a, b), expected, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (dj.MooneyRivlin(c1=0.5, c2=0.0), dj.NeoHookean()),
        (dj.Ogden(moduli=1.0, exponents=2.0), dj.NeoHookean()),
        (dj.Ogden(moduli=(0.8, -0.2), exponents=(2.0, -2.0)), MOONEY),
        (dj.Ogden(moduli=(0.5, 0.5), exponents=(2.0, 2.0)), dj.NeoHookean()),
        (dj.Electrostrictive(dj.Gent()), dj.Gent()),
        (dj.model.CustomPermittivity(dj.Ogden(), lambda a, b: 1.0 + 0 * a * b), dj.Ogden()),
    ],
)
def test_reductions(one, other):
    if isinstance(other, dj.Gent):  # within its limit
        a, b = np.minimum(L1, 4.0), np.minimum(L2, 4.0)
        for v, w in zip(dj.model.stresses(one, a, b, 0.05), dj.model.stresses(other, a, b, 0.05), strict=True):
            np.testing.assert_allclose(v, w, rtol=1e-12, atol=1e-12)
    else:
        assert_same(one, other)


def test_mooney_rivlin_by_hand():
    """s1 = 2 (λ1 − λ1⁻³ λ2⁻²)(c1 + c2 λ2²), Rivlin's form."""
    s1, s2, s11, _ = dj.model.stresses(MOONEY, L1, L2, 0.0)
    np.testing.assert_allclose(s1, 2 * (L1 - L1**-3 * L2**-2) * (0.4 + 0.1 * L2**2), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(s2, 2 * (L2 - L2**-3 * L1**-2) * (0.4 + 0.1 * L1**2), rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(s11, 2 * (1 + 3 * L1**-4 * L2**-2) * (0.4 + 0.1 * L2**2), rtol=1e-13)


def test_constants_of_an_ogden_film_of_one_term_are_differentiable():
    """W is linear in μ1."""
    energy, slope = jax.value_and_grad(lambda m: dj.Ogden((m,), (2.0,)).energy(1.5, 1.2))(0.8)
    assert float(slope) == pytest.approx(float(energy) / 0.8, rel=1e-14)


def test_ogden_by_hand():
    """s1 = Σ μ_k (λ1^(α_k − 1) − (λ1 λ2)^(−α_k)/λ1); rubber in uniaxial tension, λ2 = λ^(−1/2), has s2 = 0."""
    rubber = dj.Ogden()
    moduli, exponents = np.array(rubber.moduli), np.array(rubber.exponents)
    assert moduli @ exponents / 2 == pytest.approx(1.0, rel=1e-14)
    s1 = sum(m * (L1 ** (x - 1) - (L1 * L2) ** -x / L1) for m, x in zip(moduli, exponents, strict=True))
    np.testing.assert_allclose(dj.model.stresses(rubber, L1, L2, 0.0)[0], s1, rtol=1e-12, atol=1e-13)
    stretch = np.array([1.5, 3.0, 6.0])
    np.testing.assert_allclose(dj.model.stresses(rubber, stretch, stretch**-0.5, 0.0)[1], 0, atol=1e-12)
    by_width = dj.plot.tension_curves(rubber, stretch)["uniaxial"]
    np.testing.assert_allclose(by_width, dj.model.stresses(rubber, stretch, stretch**-0.5, 0.0)[0], rtol=1e-12)


def test_beyond_limits():
    for material in (MOONEY, dj.Ogden()):
        assert dj.Membrane(material, prestretch=1.5).lock_up_stretch() == (18.0, False)
        assert not bool(material.admissible(jnp.asarray(-1.0), jnp.asarray(1.0)))
        assert np.isfinite(np.asarray(material.energy(jnp.asarray(-1.0), jnp.asarray(1e3))))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dj.MooneyRivlin(c1=-1.0), "`c1` must be zero or positive and finite, but is -1.0"),
        (lambda: dj.MooneyRivlin(c1=0.0, c2=0.0), "`c1` or `c2` must be positive"),
        (lambda: dj.Ogden(moduli=(1.0, 2.0), exponents=2.0), "`moduli` must be as many numbers as `exponents`"),
        (lambda: dj.Ogden(moduli=1.0, exponents=0.0), "`exponents` must be finite and not zero"),
        (lambda: dj.Ogden(moduli=-1.0, exponents=2.0), "`moduli` must give a positive shear modulus"),
        (lambda: dj.Ogden(moduli=1e308, exponents=1e308), "`moduli` must be finite and at most 1e.50"),
        (lambda: dj.Ogden(moduli=1.0, exponents=1e308), "`exponents` must be finite and not zero, from 0.001 to 1000"),
        (
            lambda: dj.Ogden(moduli=[0.01] * 101, exponents=[2.0] * 101),
            "`moduli` must be at most 100 numbers, but are 101",
        ),
        (lambda: dj.Electrostrictive(RUBBER), "`elastic` must be a material without a permittivity of its own"),
        (lambda: dj.Electrostrictive(stretch_coefficient=math.nan), "`stretch_coefficient` must be finite"),
        # C falls from the start: no window is left
        (lambda: dj.Membrane(dj.Electrostrictive(stretch_coefficient=-9.0), 1.2), "`prestretch` must be below"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_load_of_the_slack_film():
    """s1(λ, λ) = W_1 − q C_1/2 with C = e λ1² λ2², e = 1 + a (λ3 − 1) + b (λ1 + λ2 + λ3 − 3), derivatives by hand."""
    s, a, b = 2.0, 0.1, -0.01
    e = 1 + a * (s**-2 - 1) + b * (2 * s + s**-2 - 3)
    slope = -a * s**-3 + b * (1 - s**-3)  # ∂e/∂λ1
    rise = 2 * e * s**3 + slope * s**4
    tension = (s - s**-5) / (1 - (2 * s**2 + s**-4 - 3) / 270)
    assert float(capacitance(RUBBER, s, s)) == pytest.approx(e * s**4, rel=1e-14)
    assert float(largest_load(RUBBER, s)) == pytest.approx(2 * tension / rise, rel=1e-13)
    assert float(dj.model.stresses(RUBBER, s, s, 0.03)[0]) == pytest.approx(tension - 0.03 * rise / 2, rel=1e-13)
    flat = dj.equilibrium(dj.Membrane(RUBBER, s), voltage=0.1, pressure=0.0)
    assert flat.charge == pytest.approx(math.pi * 0.1 * e * s**4, rel=1e-13)


def test_a_window_that_ends_before_the_capacitance_falls():
    """e = 1 − b' (2λ + λ⁻² − 3): C = e λ⁴ is largest where 4 e = b' (2λ − 2 λ⁻²); the window ends within a step below."""
    film = dj.Membrane(dj.Electrostrictive(dj.Gent(), stretch_coefficient=-0.1))
    end, locks = film.lock_up_stretch()
    low, high = 1.0, 11.0
    for _ in range(60):
        s = (low + high) / 2
        rising = 4 * (1 - 0.1 * (2 * s + s**-2 - 3)) > 0.1 * (2 * s - 2 * s**-2)
        low, high = (s, high) if rising else (low, s)
    assert not locks and 0 <= low - end < 0.02


@functools.cache
def state(volume, voltage):
    film = dj.Membrane(RUBBER, 1.2)
    found = dj.equilibrium(film, volume=volume, voltage=voltage, tolerance=1e-11)
    return found, dj.model.energy(film, dj.profile(film, found)), film


def difference(values, h):
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)


def test_the_energy_route():
    """dU = p dV at fixed Φ and ∂U/∂Φ|V = −Q with the capacitance of stretch in U and in Q; the scaling identity."""
    volume, voltage, h = 3.0, 0.08, 1e-3
    here, _, film = state(volume, voltage)
    by_volume = difference([state(volume + k * h, voltage)[1] for k in (-2, -1, 1, 2)], h)
    by_voltage = difference([state(volume, voltage + k * h)[1] for k in (-2, -1, 1, 2)], h)
    assert by_volume == pytest.approx(here.pressure, rel=1e-8)
    assert by_voltage == pytest.approx(-here.charge, rel=1e-8)
    assert abs(dj.model.scaling_defect(film, dj.profile(film, here))) < 1e-10
    # the ideal dielectric gives a different value
    other = dj.equilibrium(dj.Membrane(prestretch=1.2), volume=volume, voltage=voltage)
    assert abs(other.charge / here.charge - 1) > 0.05


def test_names_and_options(capsys):
    scene = dj.Scene(dj.Membrane(RUBBER), dj.ConstantPressure(1.0))
    changed = scene.replace(stretch_limit=100.0, thickness_coefficient=0.2)
    told = dj.model.describe(changed)
    assert (told["elastic"], told["stretch_limit"], told["thickness_coefficient"]) == ("gent", 100.0, 0.2)
    ogden = dj.Scene(dj.Membrane(dj.Ogden()), dj.ConstantPressure(1.0)).replace(moduli=(1.0, 0.1, -0.02))
    assert dj.model.describe(ogden)["moduli"] == [1.0, 0.1, -0.02]
    for argv, sentence in [
        (["--c1", "1"], "--c1 must be given with --material mooney-rivlin only, but the material is gent."),
        (["--material", "ogden", "--moduli", "1"], "--moduli and --exponents must be given together"),
        (["--material", "ogden", "--moduli", "1", "2", "--exponents", "2"], "--moduli must be as many numbers"),
        (["--material", "mooney-rivlin", "--c1", "0", "--c2", "0"], "--c1 or --c2 must be positive"),
    ]:
        assert main(["equilibrium", "--volume", "1", *argv]) == 2
        assert sentence in capsys.readouterr().err


def test_loads_without_states_take_nothing_from_the_scan_below():
    """At high loads some states of Ogden's rubber are not in tension; those at low ones agree with the explicit map."""
    film = dj.Membrane(dj.Ogden())
    stretches, _, loads = dj.Scene(film, dj.ConstantVoltage(0.0)).limits()
    chart = scan(film, stretches, loads)
    assert not np.isfinite(chart.pressure).all()
    low = chart.load_fraction < 0.4
    assert np.isfinite(chart.pressure[:, low]).all()
    column = int(np.argmin(np.abs(chart.load_fraction)))
    rows = np.flatnonzero((chart.apex_stretch > 1.6) & (chart.apex_stretch < 3.2))
    load = chart.load_fraction[column] * chart.largest_load[rows]
    known, _, _ = dj.model.explicit_map(film.material, chart.apex_stretch[rows], load, 1.0, 96.0)
    assert np.max(np.abs(chart.pressure[rows, column] / known - 1)) < 1e-4
