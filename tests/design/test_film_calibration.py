"""Calibration from tests in time: known constants are recovered, with correct intervals; what is not determined is refused."""

import json

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.apps.cli import main
from dielectric_jax.design import calibrate_film, film_calibration, read_film_measurement
from dielectric_jax.model import Maxwell, NeoHookean, Viscoelastic

MODE = "uniaxial"


def rubber(*branches: tuple[float, float]) -> Viscoelastic:
    """A neo-Hookean film with branches of modulus ratios and relaxation times."""
    return Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), g, tau) for g, tau in branches])


def relaxed(stretch: float, rate: float, duration: float, count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """A ramp to a stretch that is then held."""
    top = (stretch - 1) / rate
    time = np.concatenate([np.linspace(0.0, top, 15), top + np.geomspace(0.2, duration, count - 15)])
    return time, np.minimum(1 + rate * time, stretch)


def loop(stretch: float, rate: float, count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Loading and most of the unloading."""
    top = (stretch - 1) / rate
    time = np.linspace(0.0, 1.9 * top, count)
    return time, 1 + rate * np.where(time < top, time, 2 * top - time)


def stresses(film, tests) -> list[np.ndarray]:
    return [np.asarray(dj.rates.film_stress(film, t, s, mode=MODE)) for t, s in tests]


@pytest.fixture(scope="module")
def vhb():
    """Relaxation to two stretches and loops at two rates of the fit to VHB 4910: times, stretches, stresses in Pa."""
    film, units = dj.rates.vhb_hossain_2012()
    tests = [relaxed(2.0, 0.25, 1500.0), relaxed(3.0, 0.25, 1500.0), loop(2.0, 0.01), loop(3.0, 0.05)]
    stress = [float(units.shear_modulus) * s for s in stresses(film, tests)]
    return [t for t, _ in tests], [s for _, s in tests], stress


def test_three_branches(vhb):
    """Seven constants: exactly from exact stresses, and within their intervals from noisy ones."""
    time, stretch, exact = vhb
    begin = rubber((3.0, 1.0), (3.0, 20.0), (3.0, 300.0))
    true = {"shear_modulus": 13.7e3}
    for k, (modulus, tau) in enumerate(((56.4, 0.82), (31.5, 10.7), (19.8, 500.0))):
        true |= {
            f"material.branches[{k}].modulus_ratio": modulus / 13.7,
            f"material.branches[{k}].relaxation_time": tau,
        }
    found = calibrate_film(time, stretch, exact, material=begin, units=dj.Units())
    assert found.parameters == pytest.approx(true, rel=1e-6)
    assert found.units is not None and float(found.units.shear_modulus) == found.parameters["shear_modulus"]
    random = np.random.default_rng(2)
    noise = 0.01 * np.concatenate(exact).mean()
    noisy = [s + noise * random.normal(size=len(s)) for s in exact]
    found = calibrate_film(time, stretch, noisy, material=begin, units=dj.Units(), level=0.999)
    for name, value in true.items():
        low, high = found.intervals[name]
        assert low < value < high < 2 * low
    assert found.noise == pytest.approx(noise, rel=0.15)
    assert found.warnings == ()
    document = found.to_json()
    assert json.loads(json.dumps(document, allow_nan=False))["parameters"] == found.parameters
    assert [len(row) for row in document["residuals"]] == [50, 50, 50, 50]


def test_intervals_cover_the_truth():
    """Of 40 noisy relaxations with a loop nearly all have each constant inside its 90 % interval, and not all."""
    tests = [relaxed(2.0, 0.25, 40.0), loop(2.5, 0.1)]
    film, true = rubber((2.0, 5.0)), {"modulus_ratio": 2.0, "relaxation_time": 5.0}
    exact = stresses(film, tests)
    random = np.random.default_rng(3)
    hits = dict.fromkeys(true, 0)
    for _ in range(40):
        noisy = [s + 0.02 * random.normal(size=len(s)) for s in exact]
        found = calibrate_film([t for t, _ in tests], [s for _, s in tests], noisy, level=0.9)
        for name, value in true.items():
            hits[name] += found.intervals[name][0] < value < found.intervals[name][1]
    assert all(31 <= n < 40 for n in hits.values()), hits


def test_many_samples_are_thinned(monkeypatch):
    """Of thirty thousand samples some are fitted, chosen by the stretch and evenly in the logarithm of the time."""
    monkeypatch.setattr(film_calibration, "MOST_SAMPLES", 60)
    time = np.linspace(0.0, 40.0, 30_000)
    stretch = np.minimum(1 + 0.25 * time, 2.0)
    few, held = relaxed(2.0, 0.25, 36.0)
    (stress,) = stresses(rubber((2.0, 5.0)), [(few, held)])
    found = calibrate_film(time, stretch, np.interp(time, few, stress))
    assert 40 < len(found.time[0]) <= 60 and found.time[0][-1] == 40.0
    assert np.sum(found.time[0] < 0.1) > 5
    assert found.parameters == pytest.approx({"modulus_ratio": 2.0, "relaxation_time": 5.0}, rel=2e-2)


def test_a_test_shorter_than_the_relaxation_time():
    """It does not see whether the branch relaxes: refused, or with intervals that are wide and hold the truth."""
    time, stretch = relaxed(2.0, 0.25, 50.0)
    film, _ = dj.rates.vhb_hossain_2012()
    (exact,) = stresses(film, [(time, stretch)])
    begin = rubber((3.0, 1.0), (3.0, 20.0), (3.0, 300.0))
    random = np.random.default_rng(4)
    noisy = 13.7e3 * exact * (1 + 0.01 * random.normal(size=len(exact)))
    with pytest.raises(
        ValueError, match=r"the 95 % interval of .* is .*; leave it out of `over`, or measure for several"
    ):
        calibrate_film(time, stretch, noisy, material=begin, units=dj.Units())
    # one branch alone, ten times slower than the test is long
    (slow,) = stresses(rubber((2.0, 500.0)), [(time, stretch)])
    found = calibrate_film(time, stretch, slow * (1 + 0.002 * random.normal(size=len(slow))))
    low, high = found.intervals["relaxation_time"]
    assert low < 500.0 < high
    assert any("longer than the longest test" in said for said in found.warnings)


def test_a_spring_with_a_limit():
    """Raised until it reaches the largest stretch; one that is held is refused."""
    time, stretch = loop(3.0, 0.1)
    film = Viscoelastic(dj.Gent(20.0), [Maxwell(NeoHookean(), 1.0, 5.0)])
    (stress,) = stresses(film, [(time, stretch)])
    begin = Viscoelastic(dj.Gent(5.0), [Maxwell(NeoHookean(), 1.0, 1.0)])
    found = calibrate_film(time, stretch, stress, material=begin)
    assert found.parameters == pytest.approx(
        {"stretch_limit": 20.0, "modulus_ratio": 1.0, "relaxation_time": 5.0}, rel=1e-5
    )
    with pytest.raises(ValueError, match=r"`material` must reach the largest measured stretch, 2\.98"):
        calibrate_film(time, stretch, stress, material=begin, over=["modulus_ratio"])


def test_what_does_not_fit_is_said():
    """An elastic film has no relaxation time, and stresses of another kind are refused."""
    time, stretch = loop(2.5, 0.1)
    elastic = stretch - stretch**-2
    random = np.random.default_rng(5)
    with pytest.raises(ValueError, match="`over` must name constants that the curve"):
        calibrate_film(
            time, stretch, elastic + 0.01 * random.normal(size=50), over=["modulus_ratio", "relaxation_time"]
        )
    with pytest.raises(ValueError, match="`stress` must be a curve that the material can follow"):
        calibrate_film(time, stretch, 2 + np.sin(3 * time), over=["modulus_ratio"])


# Ogden's three terms for Treloar's rubber, (kPa, exponent); by mode the exponent of λ in the third stretch, and the largest stretch
TRELOAR = ((630.0, 1.3), (1.2, 5.0), (-10.0, -2.0))
TRANSVERSE = {"uniaxial": (-0.5, 7.5), "equal_biaxial": (-2.0, 4.5), "pure_shear": (-1.0, 5.0)}


def test_an_elastic_film_in_three_modes():
    """Six constants of Ogden's closed form, exactly, and with noise within their intervals; one mode does not determine them."""
    stretch = [np.linspace(1.05, most, 22) for _, most in TRANSVERSE.values()]
    exact = [
        1e3 * sum(mu * (s ** (a - 1) - s ** (r * a - 1)) for mu, a in TRELOAR)
        for s, (r, _) in zip(stretch, TRANSVERSE.values(), strict=True)
    ]
    true = {f"moduli[{k}]": mu / 400 for k, (mu, _) in enumerate(TRELOAR)}
    true |= {f"exponents[{k}]": a for k, (_, a) in enumerate(TRELOAR)}
    asked = {
        "material": dj.Ogden(moduli=(1.0, 0.01, -0.05), exponents=(1.5, 4.5, -1.5)),
        "over": ["moduli", "exponents"],
        "units": dj.Units(shear_modulus=400e3),
    }
    found = calibrate_film(None, stretch, exact, mode=list(TRANSVERSE), **asked)
    assert found.parameters == pytest.approx(true, rel=1e-8)
    assert found.time == () and found.modes == tuple(TRANSVERSE) and found.to_json()["noise_unit"] == "Pa"
    random = np.random.default_rng(1)
    noisy = [s + 5e3 * random.normal(size=22) for s in exact]
    found = calibrate_film(None, stretch, noisy, mode=list(TRANSVERSE), level=0.99, **asked)
    for name, value in true.items():
        low, high = found.intervals[name]
        assert low < value < high and high - low < 0.4 * abs(value)
    assert found.noise == pytest.approx(5e3, rel=0.2) and found.warnings == ()
    upper, lower = found.plot().axes
    assert len(upper.lines[1].get_xdata()) >= 128 and "kPa" in lower.get_ylabel()
    with pytest.raises(
        ValueError, match=r"moduli\[0\] and moduli\[2\] can change together without changing the stresses"
    ):
        calibrate_film(None, stretch[0], noisy[0], **asked)


def test_tables_of_strains_and_true_stresses(tmp_path, capsys):
    """Files of two modes, one of engineering strains in %, one of true stresses, are fitted together on the command line."""
    a = np.linspace(0.7, 3.0, 20)
    limit = {"u": a**2 + 2 / a - 3, "b": 2 * a**2 + a**-4 - 3}
    nominal = {"u": 60 * (a - a**-2) / (1 - limit["u"] / 90), "b": 60 * (a - a**-5) / (1 - limit["b"] / 90)}
    texts = {
        "u": "time,Engineering strain [%],Stress [kPa]\n"
        + "".join(f"x,{100 * (v - 1):.9g},{s:.9g}\n" for v, s in zip(a, nominal["u"], strict=True)),
        "b": "stretch;true stress (MPa)\n"
        + "".join(f"{v:.9g};{v * s / 1e3:.9g}\n" for v, s in zip(a, nominal["b"], strict=True)).replace(".", ","),
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.csv").write_text(text, encoding="utf-8")
    files = [str(tmp_path / f"{name}.csv") for name in texts]
    argv = ["calibrate", *files, "--si", "--mode", "uniaxial", "equal_biaxial", "--json", "-"]
    assert main([*argv, "--columns", "1", "2"]) == 2
    assert "--mode must be left out with --columns" in capsys.readouterr().err
    texts["u"] = texts["u"].replace("time,", "").replace("x,", "")
    (tmp_path / "u.csv").write_text(texts["u"], encoding="utf-8")
    assert main(argv) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["parameters"] == pytest.approx({"shear_modulus": 60e3, "stretch_limit": 90.0}, rel=1e-6)
    for more, words in (
        (["--relaxation-times", "3"], "--relaxation-times must be left out for a test without times"),
        (["--mode", "uniaxial", "uniaxial", "uniaxial"], "--mode must be one for all tests, or one for each of the 2"),
    ):
        assert main([*argv, *more]) == 2
        assert words in capsys.readouterr().err


def test_pictures():
    """Two panels, a measurement and a fit for each test."""
    tests = [relaxed(2.0, 0.25, 40.0), loop(2.5, 0.1)]
    stress = stresses(rubber((2.0, 5.0)), tests)
    found = calibrate_film([t for t, _ in tests], [s for _, s in tests], stress)
    figure = found.plot()
    assert [len(ax.lines) for ax in figure.axes] == [4, 4]
    again = found.plot(axes=figure.axes)
    assert again is figure and [len(ax.lines) for ax in figure.axes] == [8, 8]


def test_bad_input():
    time, stretch = loop(2.5, 0.1)
    stress = stretch - stretch**-2
    for words, call in (
        ("`mode` must be one of", lambda: calibrate_film(time, stretch, stress, mode="shear")),
        ("`start` must be", lambda: calibrate_film(time, stretch, stress, start="wet")),
        ("`time` must be given with a start that is", lambda: calibrate_film(None, stretch, stress, start="relaxed")),
        (
            "`time` must be given with a material",
            lambda: calibrate_film(None, stretch, stress, material=rubber((1, 1))),
        ),
        ("`stretch` must hold more samples", lambda: calibrate_film(None, stretch[:2], stress[:2], units=dj.Units())),
        ("`stretch` must be one row of numbers, two or more", lambda: calibrate_film(None, stretch[:1], stress[:1])),
        ("`loss` must be one of", lambda: calibrate_film(time, stretch, stress, loss="cubic")),
        ("`time` must rise, but is", lambda: calibrate_film(time[::-1], stretch, stress)),
        ("`stretch` must be positive and finite, but is -1", lambda: calibrate_film(time, -stretch, stress)),
        ("`stress` must be one row of numbers", lambda: calibrate_film(time, stretch, stress[:-1])),
        ("must hold as many tests, but hold 2 and 1 and 1", lambda: calibrate_film([time, time], stretch, stress)),
        (
            "holds 'prestretch', which a film has not",
            lambda: calibrate_film(time, stretch, stress, over=["prestretch"]),
        ),
        ("`over` must name some of", lambda: calibrate_film(time, stretch, stress, over=["viscosity"])),
        ("`time` must hold more samples", lambda: calibrate_film(time[:2], stretch[:2], stress[:2])),
    ):
        with pytest.raises(ValueError, match=words):
            call()


@pytest.mark.parametrize(
    ("head", "size", "in_si"),
    [
        ("time [s],stretch,stress [kPa]", (1.0, 1.0, 1e3), True),
        ("Time (min),λ [-],Nominal stress / MPa", (60.0, 1.0, 1e6), True),
        ("t,λ,s", (1.0, 1.0, 1.0), False),
        ("# temperature,Zeit [h],Stretch,Spannung [N/mm²]", (3600.0, 1.0, 1e6), True),
    ],
)
def test_files(tmp_path, head, size, in_si):
    """Headings and units of tests in time; other columns and incomplete lines are left out."""
    rows = ["0,1,0", "1,1.5,0.5", "2,1.5,", "3,1.5,0.4"]
    if "temperature" in head:
        rows = [f"20,{row}" for row in rows]
    path = tmp_path / "test.csv"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    found = read_film_measurement(path)
    assert found.time == pytest.approx(np.array([0.0, 1.0, 3.0]) * size[0])
    assert found.stretch == pytest.approx([1.0, 1.5, 1.5])
    assert found.stress == pytest.approx(np.array([0.0, 0.5, 0.4]) * size[2])
    assert found.in_si == in_si
    assert found.notices == ("Left out: line 4, without a time or a stretch or a stress.",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "time,true strain,stress\n0,0,0\n1,1,1\n",
            "`data` must have columns named time, stretch and stress, but line 1",
        ),
        ("time,stretch,stress\n0,1,0\n0,1,1\n", "`data` must hold rising times, but line 3 of .* has 0"),
        ("time,stretch,stress\n0,1,0\n1,-1,1\n", "`data` must hold stretches above zero, but line 3 of .* has -1"),
        ("time [kg],stretch,stress\n0,1,0\n1,1,1\n", "`data` must give the time in a unit such as s, ms, min, h"),
        ("time,stretch,shear stress\n0,1,0\n1,1,1\n", "`data` must have columns named time, stretch and stress"),
        ("λ,σ [kPa]\n1,1\n3,2\n", "names 'λ,σ .*; σ may be the nominal or the true stress"),
        (
            "strain,stress\n0,1\n300,2\n",
            r"must hold strains of rubber \(those in per cent need the unit %\), but line 3 of .* has 300",
        ),
        ("time,stretch,stress\n0,1,0\n", "`data` must hold two samples or more"),
    ],
)
def test_files_that_are_none(tmp_path, text, words):
    path = tmp_path / "test.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=words):
        read_film_measurement(path)


def test_command_line(tmp_path, capsys):
    """A file in time is fitted with one branch, or with those asked for; options that would be ignored are refused."""
    time, stretch = relaxed(2.0, 0.25, 40.0)
    (stress,) = stresses(rubber((2.0, 5.0)), [(time, stretch)])
    path = tmp_path / "test.csv"
    rows = "".join(f"{t:.12g},{s:.12g},{60 * p:.12g}\n" for t, s, p in zip(time, stretch, stress, strict=True))
    path.write_text(f"time [s],stretch,stress [kPa]\n{rows}", encoding="utf-8")
    argv = ["calibrate", str(path), "--si", "--material", "neo-hookean"]
    assert main([*argv, "--relaxation-times", "3", "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    true = {"shear_modulus": 60e3, "modulus_ratio": 2.0, "relaxation_time": 5.0}
    assert document["parameters"] == pytest.approx(true, rel=1e-6)
    assert document["scene"]["branches"][0]["relaxation_time"] == document["parameters"]["relaxation_time"]
    for more, words in (
        (["--voltage", "100"], "--voltage must be left out for a test of time, stretch and stress"),
        (["--columns", "1", "2", "--mode", "uniaxial"], "--mode must be left out with --columns"),
    ):
        assert main([*argv, *more]) == 2
        assert words in capsys.readouterr().err
