"""User-defined energies: what is refused and how, constants by name, and the window of a material that stiffens."""

import dataclasses
import inspect
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import dielectric_jax as dj
from dielectric_jax.apps.options import read_arguments
from dielectric_jax.diagram import tracing
from dielectric_jax.numerics.codes import Code


def rise(a, b):
    return a**2 + b**2 + (a * b) ** -2 - 3


REFUSED = {
    "pascal": (lambda a, b: 45e3 * rise(a, b) / 2, "it is 45000; divide by 45000"),
    "kilopascal": (lambda a, b: 45 * rise(a, b) / 2, "divide by 45"),
    "megapascal": (lambda a, b: 0.045 * rise(a, b) / 2, "divide by 0.045"),
    "one direction": (lambda a, b: rise(a, b) / 2 + 0.2 * (a**2 - 1) ** 2, "must be symmetric, W(λ1, λ2) = W(λ2, λ1)"),
    "one direction, a little": (lambda a, b: rise(a, b) / 2 + 1e-6 * (b**2 - 1) ** 4, "must be symmetric"),
    "stressed": (lambda a, b: (a**2 + b**2 - 2) / 2, "must be stationary at λ1 = λ2 = 1"),
    "upside down": (lambda a, b: -rise(a, b) / 2, "must be least at λ1 = λ2 = 1"),
    "nothing": (lambda a, b: 0.0 * a * b, "must be least at λ1 = λ2 = 1"),
    "root": (lambda a, b: jnp.sqrt(rise(a, b)), "finite with its first two derivatives"),
    "numpy": (lambda a, b: -50 * np.log(1 - rise(a, b) / 100), "jnp.log for np.log"),
    "math": (lambda a, b: math.exp(rise(a, b)), "jnp.log for np.log or math.log"),
    "branch": (lambda a, b: rise(a, b) if a > 1 else 0 * a, "jnp.where for if"),
    "number": (lambda a, b: 1.0, "one float64 for each pair"),
    "sum": (lambda a, b: jnp.sum(rise(a, b)), "one float64 for each pair"),
    "two": (lambda a, b: (rise(a, b), rise(a, b)), "returns a tuple"),
    "stack": (lambda a, b: jnp.stack([rise(a, b)] * 2), "returns an array float64[2, 7]"),
    "single precision": (lambda a, b: rise(a, b).astype(jnp.float32), "returns an array float32"),
    "forgotten return": (lambda a, b: None, "returns a NoneType"),
    "one stretch": (lambda a: rise(a, a), "takes 1 positional argument but 2 were given"),
    "none": (None, "must be a function of two stretches, but is None"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_energy_is_refused_in_a_sentence(name):
    function, said = REFUSED[name]
    with pytest.raises(ValueError) as error:
        dj.CustomMaterial(function, largest_stretch=8.0)
    assert str(error.value).startswith("`function` must ") and said in str(error.value)
    assert "\n" not in str(error.value)


def test_energies_of_membranes_are_taken():
    """A constant in W adds no stress, and a modulus near 1 is the user's choice; 1/45000 of an energy in pascal is accepted."""
    for function in (
        lambda a, b: 7 + rise(a, b) / 2,
        lambda a, b: 0.6 * rise(a, b),
        lambda a, b: 45e3 * rise(a, b) / 2 / 45000,
        lambda a, b: -50 * jnp.log1p(-rise(a, b) / 100),
    ):
        dj.CustomMaterial(function, largest_stretch=30.0)
    for bad in (1.0, math.nan, math.inf, "8", None):
        with pytest.raises(ValueError, match=r"^`largest_stretch` must be above 1 and finite, but is"):
            dj.CustomMaterial(lambda a, b: rise(a, b) / 2, largest_stretch=bad)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: dj.MooneyRivlin(c1=22500.0, c2=0.0), "`c1` and `c2` must be in units .* divide by 45000"),
        (lambda: dj.Ogden(moduli=45e3, exponents=2.0), "`moduli` must be in units .* divide by 45000"),
        (lambda: dj.model.CustomPermittivity(dj.Gent(), lambda a, b: 1 + 0.01 * a), "`function` must be symmetric, e"),
        (
            lambda: dj.model.CustomPermittivity(dj.Gent(), lambda a, b: 4.2e-11 + 0 * a),
            "`function` must be the permittivity",
        ),
        (lambda: dj.model.CustomPermittivity(dj.Gent(), lambda a, b: np.exp(-a * b)), "jnp.where for if"),
    ],
)
def test_constants_in_si_and_permittivities_of_one_direction_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_constants_of_a_function_are_not_differentiated():
    def tension(limit):
        material = dj.CustomMaterial(lambda a, b: -limit / 2 * jnp.log1p(-rise(a, b) / limit), largest_stretch=8.0)
        return dj.model.stresses(material, 2.0, 2.0, 0.0)[0]

    with pytest.raises(
        ValueError, match=r"^`function` must not hold numbers that JAX is tracing; .* AbstractMaterial\."
    ):
        jax.grad(tension)(270.0)


class Mine(dj.AbstractMaterial):
    """Gent's energy with a constant of another name."""

    limit: float = 270.0

    def energy(self, l1, l2):
        return -self.limit / 2 * jnp.log1p(-rise(l1, l2) / self.limit)

    def admissible(self, l1, l2):
        return rise(l1, l2) < self.limit

    def lock_up_stretch(self, prestretch):
        return dj.Gent(float(self.limit)).lock_up_stretch(prestretch)


class Thick(Mine):
    thickness: float = 1.0


def test_constants_of_a_user_s_material_are_parameters_of_a_scene():
    scene = dj.Scene(dj.Membrane(Mine()), dj.ConstantPressure(1.0))
    assert dj.model.describe(scene.replace(limit=100))["limit"] == 100.0
    coated = dj.Scene(dj.Membrane(dj.Electrostrictive(Mine(), 0.1)), dj.ConstantPressure(1.0)).replace(limit=99)
    assert dj.model.describe(coated)["limit"] == 99.0 and dj.model.describe(coated)["elastic"] == "Mine"
    for wrong in ("limitt", "energy", "largest_stretch"):
        with pytest.raises(ValueError, match=rf"`{wrong}` must be one of .*, limit, but is not a parameter"):
            scene.replace(**{wrong: 1.0})
    with pytest.raises(ValueError, match=r"^`limitt` must be one of chamber_volume"):
        dj.sweep(scene, limitt=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"^`thickness` must not be the name of a material's constant"):
        dj.Scene(dj.Membrane(Thick()), dj.ConstantPressure(1.0))
    with pytest.raises(ValueError, match=r"^The constants of a Mine must be numbers, .* but one is 'a'"):
        Mine(limit="a")

    def tension(limit):
        material = scene.replace(limit=limit).membrane.material
        assert all(leaf.shape == () for leaf in jax.tree.leaves(material))  # as an array, also from a plain number
        return dj.model.stresses(material, 3.0, 3.0, 0.0)[0]

    # s1 = (λ − λ⁻⁵)/(1 − I/J)
    slope = -(3 - 3.0**-5) * rise(3.0, 3.0) / 200.0**2 / (1 - rise(3.0, 3.0) / 200.0) ** 2
    assert float(jax.grad(tension)(200.0)) == pytest.approx(slope, rel=1e-12)


def end_of(material, prestretch=1.0):
    return dj.Membrane(material, prestretch).lock_up_stretch()


@pytest.mark.parametrize("exponent", [8.0, 12.0, 28.8, 300.0, -4.0, -8.0, -30.0])
def test_the_window_of_a_material_that_stiffens_ends_at_a_balloon_pressure(exponent):
    """One term, μ α = 2: s = μ (λ^(α − 1) − λ^(−2α − 1)), and the balloon's pressure is 2 s/λ²."""
    material = dj.Ogden(moduli=2 / exponent, exponents=exponent)

    def pressure(stretch):
        return 2 * 2 / exponent * (stretch ** (exponent - 3) - stretch ** (-2 * exponent - 3))

    end = brentq(lambda stretch: pressure(stretch) - 100, 1.001, 1 + 25 / abs(exponent), xtol=1e-14)
    assert end_of(material)[0] == pytest.approx(end, rel=1e-8) and not end_of(material)[1]
    assert end_of(material, 1 + 0.5 * (end - 1))[0] == pytest.approx(end, rel=1e-8)
    with pytest.raises(ValueError, match=f"`prestretch` must be below the material's largest stretch {end:.6g}"):
        dj.Membrane(material, end + 1e-3)


def test_other_windows_stay():
    """12 prestretches without lock-up; the user's own value; never beyond a pole, where (λ − 1) s'/s grows without bound."""
    for prestretch in (1.0, 2.0, 4.0):
        for material in (dj.NeoHookean(), dj.MooneyRivlin(), dj.MooneyRivlin(0.0, 0.5), dj.Ogden()):
            assert end_of(material, prestretch) == (12 * prestretch, False)
        assert end_of(dj.Electrostrictive(dj.Ogden(), 0.1), prestretch) == (12 * prestretch, False)
    for limit in (0.2, 5.0, 270.0, 1000.0):
        assert end_of(Mine(limit=limit)) == end_of(dj.Gent(limit))
    (claimed, _), pole = end_of(dj.Gent(270.0)), brentq(lambda s: 2 * s**2 + s**-4 - 3 - 270, 5, 20)
    careless = end_of(dj.CustomMaterial(lambda a, b: -135 * jnp.log1p(-rise(a, b) / 270), largest_stretch=50.0))
    assert claimed - 1e-9 < careless[0] < pole and not careless[1]
    # s = 1.5 (λ^0.4 − λ^−3.8) − 0.05 (λ⁴ − λ^−11) falls to zero; the modulus is 0.925
    lost = brentq(lambda s: 1.5 * (s**0.4 - s**-3.8) - 0.05 * (s**4 - s**-11), 1.5, 5, xtol=1e-14)
    assert end_of(dj.Ogden((1.5, -0.05), (1.4, 5.0)))[0] == pytest.approx(lost, rel=1e-8)


def ogden_shot(material, apex, pressure):
    """λ2(1) and V at zero voltage by SciPy's DOP853, with Ogden's stresses by hand, started by a spherical cap."""
    mu, al = np.array(material.moduli), np.array(material.exponents)

    def rates(radius, y):
        l1, l2, slope = y[0], y[1], y[2]
        l3 = 1 / (l1 * l2)
        s1, s2 = (float(np.sum(mu * (s**al - l3**al)) / s) for s in (l1, l2))
        s11 = float(np.sum(mu * ((al - 1) * l1**al + (al + 1) * l3**al)) / l1**2)
        s12 = float(np.sum(mu * al * l3**al) / (l1 * l2))
        lean = l1 * math.cos(slope) - l2
        turn = (pressure * l1 * l2 - s2 * math.sin(slope) / radius) / s1
        rate1 = (s2 * math.cos(slope) - s1 - s12 * lean) / (s11 * radius)
        return [rate1, lean / radius, turn, math.pi * (radius * l2) ** 2 * l1 * math.sin(slope)]

    tension = float(np.sum(mu * (apex**al - apex ** (-2 * al))) / apex)
    first = 1e-5
    start = [apex, apex, pressure * apex**2 / (2 * tension) * first, 0.0]
    end = solve_ivp(rates, (first, 1.0), start, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return end[1], end[3]


SILICONE = dj.Ogden(moduli=(1.3708, 8.0e-4, -0.02205), exponents=(1.4, 10.0, -3.3))
STEEP = dj.Ogden(moduli=(0.0694444, 0.0, 0.0), exponents=(28.8, 1.0, 2.0))
DOUBLED = dj.Ogden(moduli=(0.0, 0.0, -1.0), exponents=(1.0, 2.0, -2.0))  # Mooney–Rivlin, c2 = 1/2


@pytest.mark.parametrize(
    ("material", "prestretch"), [(SILICONE, 1.0), (STEEP, 1.0), (DOUBLED, 4.0)], ids=["silicone", "steep", "doubled"]
)
def test_the_whole_curve_of_a_stiff_material(material, prestretch):
    """One branch from p = 0 to the end of the window, on states of another integrator; `equilibrium` lies on it."""
    film = dj.Membrane(material, prestretch)
    curve = dj.pressure_volume(film)
    (branch,) = curve.branches
    end = film.lock_up_stretch()[0]
    assert curve.complete and {branch.start, branch.end} == {Code.window_stretch}
    assert branch.pressure[0] < 1e-2 and branch.apex_stretch[-1] == pytest.approx(end, rel=1e-2)
    assert np.diff(branch.apex_stretch).max() < 0.05 * (end - prestretch)
    middle = float(np.interp(prestretch + 0.2 * (end - prestretch), branch.apex_stretch, branch.volume))
    state = dj.equilibrium(film, volume=middle)
    on_curve = np.exp(np.interp(math.log(middle), np.log(branch.volume), np.log(branch.pressure)))
    assert state.pressure == pytest.approx(on_curve, rel=1e-2)
    rim, volume = ogden_shot(material, state.apex_stretch, state.pressure)
    assert rim == pytest.approx(prestretch, rel=1e-8) and volume == pytest.approx(middle, rel=1e-7)


def test_a_branch_that_is_not_followed_to_its_end_is_not_complete(monkeypatch):
    monkeypatch.setattr(tracing, "MOST_PARTS", 1)
    curve = dj.pressure_volume(dj.Membrane(DOUBLED, 4.0))
    assert any(Code.too_many_points in (b.start, b.end) for b in curve.branches) and not curve.complete


def test_the_advice_of_codes_names_what_there_is():
    """Names between backticks are parameters of something public, or public; windows and tolerances are options too."""
    known = set(dj.__all__)
    faces = [getattr(dj, name) for name in dj.__all__ if inspect.ismodule(getattr(dj, name))]
    for face in (dj, *faces):
        known |= set(face.__all__)
        for public in (getattr(face, name) for name in face.__all__):
            if inspect.isfunction(public) or dataclasses.is_dataclass(public):
                known |= set(inspect.signature(public).parameters)
    options = vars(read_arguments(["equilibrium", "--volume", "1"]))
    for code in Code:
        for name in re.findall(r"`(\w+)", code.sentence):
            assert name in known, (code, name)
        for words in re.findall(r"stretch window|load window|tolerance|voltage", code.sentence):
            assert words.replace(" ", "_") in options
        assert code.sentence[0].isupper() and code.sentence.endswith(".") and "\n" not in code.sentence
