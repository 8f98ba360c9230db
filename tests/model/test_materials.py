"""Free energies and breakdown laws against closed forms and finite differences."""

import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dielectric_jax as dj
from dielectric_jax.model.materials import first_invariant_minus_3, inverse_langevin, largest_load

FIELD_UNIT = 32.88422182218  # √(μ/ε) in MV/m for μ = 45 kPa, ε = 4.7·8.854e-12 F/m


def mooney(l1, l2):
    return 0.45 * first_invariant_minus_3(l1, l2) + 0.05 * (l1**-2 + l2**-2 + (l1 * l2) ** 2 - 3)


def ogden(l1, l2):
    l3 = 1 / (l1 * l2)
    return 0.8 * (l1**1.3 + l2**1.3 + l3**1.3 - 3) + 0.01 * (l1**5 + l2**5 + l3**5 - 3)


CUSTOM = {
    "mooney": dj.CustomMaterial(mooney, largest_stretch=8.0),
    "ogden": dj.CustomMaterial(ogden, largest_stretch=5.0),
}

CHAIN = dj.Scene(dj.Membrane(dj.ArrudaBoyce()), dj.ConstantPressure(1.0))

energies = jax.jit(lambda material, l1, l2: material.energy(l1, l2))
four = jax.jit(dj.model.stresses)

materials = st.one_of(
    st.floats(math.log(50), math.log(1000)).map(lambda x: dj.Gent(stretch_limit=math.exp(x))),
    st.floats(math.log(20), math.log(400)).map(lambda x: dj.ArrudaBoyce(chain_links=math.exp(x))),
    st.just(dj.NeoHookean()),
    st.sampled_from(list(CUSTOM.values())),
)


def limit_of(material):
    """The value of λ1² + λ2² + λ3² − 3 at which the material locks (a large number where it does not)."""
    if isinstance(material, dj.Gent):
        return float(material.stretch_limit)
    return 3 * float(material.chain_links) - 3 if isinstance(material, dj.ArrudaBoyce) else 50.0


@functools.cache
def inside(limit):
    """Pairs of stretches from compression to 90 % of the limiting invariant."""
    top = math.sqrt((0.9 * limit + 3) / 2)
    return st.tuples(st.floats(0.7, top), st.floats(0.7, top)).filter(
        lambda lam: first_invariant_minus_3(*lam) < 0.9 * limit
    )


def difference(function, x, h):
    """Sixth-order central difference."""
    return (
        45 * (function(x + h) - function(x - h))
        - 9 * (function(x + 2 * h) - function(x - 2 * h))
        + (function(x + 3 * h) - function(x - 3 * h))
    ) / (60 * h)


@given(st.data(), materials, st.floats(-0.05, 0.2))
def test_stresses_are_derivatives_of_the_energy(data, material, q):
    l1, l2 = data.draw(inside(limit_of(material)))
    h = 1e-3

    def w(a, b):
        return float(energies(material, a, b)) - q * (a * b) ** 2 / 2

    def s(a, b):
        return float(four(material, a, b, q)[0])

    s1, s2, s11, s12 = (float(v) for v in four(material, l1, l2, q))
    size = max(abs(w(l1, l2)), abs(s1), abs(s2), 1.0)
    assert s1 == pytest.approx(difference(lambda a: w(a, l2), l1, h), abs=1e-9 * size)
    assert s2 == pytest.approx(difference(lambda b: w(l1, b), l2, h), abs=1e-9 * size)
    size = max(abs(s11), abs(s12), size)
    assert s11 == pytest.approx(difference(lambda a: s(a, l2), l1, h), abs=1e-9 * size)
    assert s12 == pytest.approx(difference(lambda b: s(l1, b), l2, h), abs=1e-9 * size)


@given(st.data(), materials)
def test_an_energy_is_symmetric_and_free_of_stress_at_rest(data, material):
    l1, l2 = data.draw(inside(limit_of(material)))
    s1, s2, *_ = four(material, l1, l2, 0.0)
    t1, t2, *_ = four(material, l2, l1, 0.0)
    np.testing.assert_allclose([s1, s2], [t2, t1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(four(material, 1.0, 1.0, 0.0)[:2], 0.0, atol=1e-14)
    assert bool(material.admissible(jnp.asarray(l1), jnp.asarray(l2)))


@pytest.mark.parametrize("limit", [50.0, 270.0, 1000.0])
def test_gent_equal_biaxial(limit):
    lam = np.linspace(0.8, 0.99 * math.sqrt(limit / 2), 40)
    s1, s2, *_ = four(dj.Gent(stretch_limit=limit), lam, lam, 0.0)
    exact = (lam - lam**-5) / (1 - (2 * lam**2 + lam**-4 - 3) / limit)
    np.testing.assert_allclose(s1, exact, rtol=3e-13, atol=1e-15)
    np.testing.assert_allclose(s2, exact, rtol=3e-13, atol=1e-15)


def test_gent_tangent_in_closed_form():
    """∂s1/∂λ1 = σ1/λ1² + 4 λ1² ∂²W/∂(λ1²)², both terms written out by hand."""
    l1, l2, j, q = 3.0, 2.0, 270.0, 0.01
    g = 1 - (l1**2 + l2**2 + (l1 * l2) ** -2 - 3) / j
    first = l1 - l1**-3 * l2**-2  # half the slope of the invariant
    s1, s2, s11, s12 = four(dj.Gent(stretch_limit=j), l1, l2, q)
    assert float(s1) == pytest.approx(first / g - q * l1 * l2**2, rel=1e-14)
    assert float(s11) == pytest.approx((1 + 3 * l1**-4 * l2**-2) / g + 2 * first**2 / (j * g**2) - q * l2**2, rel=1e-14)
    second = l2 - l2**-3 * l1**-2
    assert float(s12) == pytest.approx(
        2 * l1**-3 * l2**-3 / g + 2 * first * second / (j * g**2) - 2 * q * l1 * l2, rel=1e-14
    )
    assert float(s2) == pytest.approx(second / g - q * l1**2 * l2, rel=1e-14)


def test_gent_without_limit_is_neo_hookean():
    """To first order in 1/J stresses differ by the share (I − 3)/J ≤ 72/J here, tangents by twice that."""
    l1, l2 = np.meshgrid(np.linspace(0.7, 6, 12), np.linspace(0.7, 6, 12))
    for limit in (1e8, 1e14):  # at 1e14 log1p keeps what log(1 − x) would lose
        for gent, neo in zip(
            four(dj.Gent(stretch_limit=limit), l1, l2, 0.0), four(dj.NeoHookean(), l1, l2, 0.0), strict=True
        ):
            np.testing.assert_allclose(gent, neo, rtol=150 / limit, atol=150 / limit)
        np.testing.assert_allclose(
            energies(dj.Gent(stretch_limit=limit), l1, l2),
            energies(dj.NeoHookean(), l1, l2),
            rtol=72 / limit,
            atol=1e-14,
        )


def test_neo_hookean_stress():
    l1, l2 = 1.7, 2.3
    s1, s2, s11, s12 = (float(v) for v in four(dj.NeoHookean(), l1, l2, 0.1))
    assert s1 == pytest.approx(l1 - l1**-3 * l2**-2 - 0.1 * l1 * l2**2, rel=1e-14)
    assert s2 == pytest.approx(l2 - l2**-3 * l1**-2 - 0.1 * l2 * l1**2, rel=1e-14)
    assert s11 == pytest.approx(1 + 3 * l1**-4 * l2**-2 - 0.1 * l2**2, rel=1e-14)
    assert s12 == pytest.approx(2 * l1**-3 * l2**-3 - 0.2 * l1 * l2, rel=1e-14)


def test_pull_in_of_a_free_film():
    """s1 = λ − λ⁻⁵ − q λ³ = 0 gives q = λ⁻² − λ⁻⁸, largest where λ⁶ = 4."""
    stretch = 4 ** (1 / 6)
    q = float(largest_load(dj.NeoHookean(), stretch))
    assert q == pytest.approx(4 ** (-1 / 3) - 4 ** (-4 / 3), rel=1e-14)
    assert math.sqrt(q) == pytest.approx(0.687365, abs=5e-7)
    slope = jax.jit(jax.grad(lambda lam: largest_load(dj.NeoHookean(), lam)))
    assert float(slope(stretch)) == pytest.approx(0.0, abs=1e-14)
    assert float(slope(stretch - 0.01)) > 1e-3 and float(slope(stretch + 0.01)) < -1e-3
    assert float(four(dj.NeoHookean(), stretch, stretch, q)[0]) == pytest.approx(0.0, abs=1e-15)


def test_balloon_maximum():
    """A thin sphere of radius R0 carries p R0/(μH) = 2 s1/λ² = 2 (1/λ − 1/λ⁷ − q λ)."""

    def pressure(lam, q):
        return 2 * dj.model.stresses(dj.NeoHookean(), lam, lam, q)[0] / lam**2

    stretch = 7 ** (1 / 6)
    pressure_and_slope = jax.jit(jax.value_and_grad(pressure))
    value, slope = pressure_and_slope(stretch, 0.0)
    assert float(value) == pytest.approx(2 * (stretch**-1 - stretch**-7), rel=1e-14)
    assert float(value) == pytest.approx(1.239463, abs=5e-7)
    assert float(slope) == pytest.approx(0.0, abs=1e-14)
    value, _ = pressure_and_slope(2.0, 0.03)
    assert float(value) == pytest.approx(2 * (1 / 2 - 1 / 2**7 - 0.06), rel=1e-14)


def langevin(b):
    """coth b − 1/b as Lambert's continued fraction b/(3 + b²/(5 + b²/(7 + …))), which cancels nothing."""
    tail = 0.0
    for k in range(2 * int(60 + 2 * b) + 1, 1, -2):
        tail = b * b / (k + tail)
    return tail / b


def test_the_continued_fraction_is_the_langevin_function():
    for b in (0.7, 3.0, 40.0):
        assert langevin(b) == pytest.approx(1 / math.tanh(b) - 1 / b, rel=1e-14)


@given(st.one_of(st.floats(1e-9, 0.995), st.floats(1e-6, 5e-3).map(lambda x: 1 - x)))
def test_inverse_langevin(x):
    beta = float(jax.jit(inverse_langevin)(x))
    # near x = 1 the inverse has condition number 1/(1 − x)
    assert langevin(beta) == pytest.approx(x, rel=1e-14)


def test_inverse_langevin_derivatives():
    """1/L′ and −L″/L′³ with the derivatives of the continued fraction taken by differences."""
    first, second = jax.jit(jax.grad(inverse_langevin)), jax.jit(jax.grad(jax.grad(inverse_langevin)))
    for x in (1e-3, 0.1, 0.155, 0.17, 0.5, 0.9):  # both sides of the change from series to closed form
        b = float(inverse_langevin(x))
        h = 2e-3 * (1 + b)
        slope = difference(langevin, b, h) if b > 6 * h else 1 / 3 - b**2 / 15 + 2 * b**4 / 189
        assert float(first(x)) == pytest.approx(1 / slope, rel=1e-9)
        h = 1e-3 * (1 - x)
        if x > 6 * h:
            assert float(second(x)) == pytest.approx(difference(lambda v: float(first(v)), x, h), rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("links", [25.0, 125.0])
def test_arruda_boyce_series(links):
    """The expansion Arruda and Boyce print: W = (I−3)/2 + (I²−9)/(20n) + 11(I³−27)/(1050n²) + …"""
    l1, l2 = 1.4, 0.9
    i = first_invariant_minus_3(l1, l2) + 3
    terms = [1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750]
    series = sum(c * (i**k - 3**k) / links ** (k - 1) for k, c in enumerate(terms, start=1))
    material = dj.ArrudaBoyce(chain_links=links)
    energy = float(energies(material, l1, l2)) - float(energies(material, 1.0, 1.0))
    # the next term is smaller than the last by about i/n
    assert energy == pytest.approx(series, abs=2 * abs(terms[-1]) * i**5 / links**4 * (i / links) + 1e-12)


def test_arruda_boyce_stress_in_closed_form():
    """s1 = W_I dI/dλ1 with W_I = β/(6 ρ), β from a bisection of coth β − 1/β."""
    links, l1, l2 = 125.0, 7.0, 5.0
    rho = math.sqrt((l1**2 + l2**2 + (l1 * l2) ** -2) / (3 * links))
    low, high = 1e-6, 1e4
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if langevin(middle) < rho else (low, middle)
    expected = low / (6 * rho) * 2 * (l1 - l1**-3 * l2**-2)
    assert float(four(dj.ArrudaBoyce(chain_links=links), l1, l2, 0.0)[0]) == pytest.approx(expected, rel=1e-13)


def test_arruda_boyce_with_long_chains_is_neo_hookean():
    material = dj.ArrudaBoyce(chain_links=1e9)
    for chain, neo in zip(four(material, 2.0, 1.5, 0.1), four(dj.NeoHookean(), 2.0, 1.5, 0.1), strict=True):
        assert float(chain) == pytest.approx(float(neo), rel=1e-8)


@pytest.mark.parametrize(
    "material", [dj.Gent(stretch_limit=270.0), dj.ArrudaBoyce(chain_links=125.0)], ids=["gent", "chain"]
)
def test_beyond_the_limit_everything_is_finite_and_flagged(material):
    edge = math.sqrt((limit_of(material) + 3) / 2)

    def all_of(l1, l2):
        value, slope = jax.value_and_grad(material.energy, argnums=(0, 1))(l1, l2)
        return value, *slope, *dj.model.stresses(material, l1, l2, 0.01), material.admissible(l1, l2)

    program = jax.jit(jax.vmap(all_of))
    *numbers, admissible = program(edge * jnp.array([0.9, 0.99, 1.01, 1.5, 10.0]), edge * jnp.ones(5))
    assert admissible.tolist() == [True, True, False, False, False]
    assert bool(jnp.isfinite(jnp.stack(numbers)).all())
    assert bool((jnp.diff(numbers[0]) > 0).all())
    by_limit = jax.jit(jax.grad(lambda m, lam: dj.model.stresses(m, lam, lam, 0.0)[0]))(material, 1.5 * edge)
    assert all(bool(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(by_limit))


def test_lock_up_stretch_of_the_window():
    """G = 0.01 for Gent, ρ = 0.995 for chains, twelve prestretches without a limit, the user's number."""
    stretch, locks = dj.Gent(stretch_limit=270.0).lock_up_stretch(1.0)
    assert locks and 1 - (2 * stretch**2 + stretch**-4 - 3) / 270 == pytest.approx(0.01, abs=1e-13)
    stretch, locks = dj.ArrudaBoyce(chain_links=125.0).lock_up_stretch(1.0)
    assert locks and math.sqrt((2 * stretch**2 + stretch**-4) / 375) == pytest.approx(0.995, abs=1e-14)
    assert dj.NeoHookean().lock_up_stretch(1.5) == (18.0, False)
    assert CUSTOM["mooney"].lock_up_stretch(1.0) == (8.0, False)


@given(st.floats(math.log(1e-6), math.log(1e15)))
def test_every_lock_up_stretch_is_the_root_of_its_limit(log_limit):
    """In J and n alike; 2λ² + λ⁻⁴ − 3 = (λ² − 1)² (2λ² + 1)/λ⁴, in rationals, where nothing cancels."""
    limit = math.exp(log_limit)
    links = limit + 0.995**-2 * (1 + 1e-6)
    for stretch, value in (
        (dj.Gent(stretch_limit=limit).lock_up_stretch(1.0)[0], 0.99 * limit),
        (dj.ArrudaBoyce(chain_links=links).lock_up_stretch(1.0)[0], 3 * (links * 0.995**2 - 1)),
    ):
        u = Fraction(stretch) ** 2
        slope = float(2 * (u - 1) * (u * u + u + 1) / u**3)
        wrong = float((u - 1) ** 2 * (2 * u + 1) / u**2 - Fraction(value))
        # two roundings of λ, and those of 1 + d and of the products in `value`
        assert stretch > 1 and abs(wrong) < 4e-16 * (2 * stretch**2 * slope) + 4e-16 * (value + 3)


def test_vhb_breakdown():
    law = dj.VHBBreakdown()
    assert float(law.field(1.0)) == pytest.approx(30.6 / FIELD_UNIT, rel=1e-12)
    assert float(law.field(3.0)) == pytest.approx(30.6 * 3**1.13 / FIELD_UNIT, rel=1e-12)
    crossover = (218 / 30.6) ** (1 / 1.13)
    assert crossover == pytest.approx(5.68372, abs=5e-6)
    below, above = (float(law.field(crossover * f)) for f in (1 - 1e-9, 1 + 1e-9))
    assert below == pytest.approx(above, rel=2e-9) and below < above
    np.testing.assert_allclose(law.field(jnp.array([5.7, 9.0])), 218 / FIELD_UNIT, rtol=1e-12)
    assert float(law.field(5.68)) < 218 / FIELD_UNIT


def test_a_breakdown_law_owns_its_unit_and_scale():
    law = dj.VHBBreakdown(scale=1.5, shear_modulus=68e3, relative_permittivity=4.0)
    unit = math.sqrt(68e3 / (4.0 * 8.854e-12)) / 1e6
    assert float(law.field(9.0)) == pytest.approx(1.5 * 218 / unit, rel=1e-13)
    assert float(dj.ConstantBreakdown(2.0, scale=0.5).field(jnp.asarray(3.0))) == 1.0


def test_a_user_s_breakdown_law():
    law = dj.model.CustomBreakdown(lambda lam: 1 + lam**2, scale=2.0)
    np.testing.assert_allclose(law.field(jnp.array([1.0, 3.0])), [4.0, 20.0], rtol=1e-15)
    state = dj.equilibrium(dj.Membrane(prestretch=2.0, breakdown=law), voltage=0.1, volume=0.0)
    assert state.breakdown_ratio == pytest.approx(0.1 * 4 / 10.0, rel=1e-14)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: dj.Gent(stretch_limit=0.0), "stretch_limit"),
        (lambda: dj.Gent(stretch_limit=float("nan")), "stretch_limit"),
        (lambda: dj.Gent(stretch_limit=float("inf")), "stretch_limit"),
        (lambda: dj.ArrudaBoyce(chain_links=1.0), "chain_links"),
        # ρ = 0.995 is reached without stretch at n = 0.995⁻² = 1.0100755: a shorter chain leaves no window
        *((lambda n=n: dj.ArrudaBoyce(chain_links=n), "chain_links") for n in (1.001, 1.01, 1.01007, 1.1e15, 1e308)),
        (lambda: CHAIN.replace(chain_links=1.005), "chain_links"),
        *((lambda j=j: dj.Gent(stretch_limit=j), "stretch_limit") for j in (5e-324, 1e-7, 1.1e15, 1e308)),
        (lambda: dj.Membrane(dj.NeoHookean(), prestretch=1e200), "prestretch"),
        (lambda: dj.ArrudaBoyce(chain_links=float("inf")), "chain_links"),
        (lambda: dj.ArrudaBoyce(chain_links=float("nan")), "chain_links"),
        (lambda: dj.CustomMaterial(mooney, largest_stretch=-1.0), "largest_stretch"),
        (lambda: dj.VHBBreakdown(scale=-1.0), "breakdown_field_scale"),
        (lambda: dj.VHBBreakdown(shear_modulus=0.0), "shear_modulus"),
        (lambda: dj.ConstantBreakdown(0.0), "breakdown"),
        (lambda: dj.ConstantBreakdown(1.0, scale=-1.0), "breakdown_field_scale"),
        (lambda: dj.model.CustomBreakdown(lambda lam: lam, scale=float("nan")), "breakdown_field_scale"),
    ],
)
def test_bad_constants_are_refused_by_name(build, name):
    with pytest.raises(ValueError, match=f"^`{name}` must be .*, but is .*\\.$"):
        build()
