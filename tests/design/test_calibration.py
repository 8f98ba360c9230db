"""Calibration: known constants are recovered, with correct intervals; what cannot be fitted is refused."""

import dataclasses
import json
import re

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import dielectric_jax as dj
from dielectric_jax.apps.cli import main
from dielectric_jax.design.calibration import check_determined, check_intervals, check_optimal
from dielectric_jax.design.curve_model import CurveModel, Nodes
from dielectric_jax.design.material_constants import sought_constants
from dielectric_jax.model.chart import explicit_map
from dielectric_jax.model.materials import AbstractMaterial

VOLUME = np.geomspace(0.3, 60.0, 24)
UNITS = dj.Units()
TRUE = {"shear_modulus": 60e3, "stretch_limit": 120.0}


class Rubber(AbstractMaterial):
    """A user's material of plain numbers: neo-Hookean, and a term of I² that may be of either sign."""

    stiffness: float
    rise: float

    def energy(self, l1, l2):
        x = l1**2 + l2**2 + (l1 * l2) ** -2 - 3
        return self.stiffness * x / 2 + self.rise * x**2 / 100

    def admissible(self, l1, l2):
        return (l1 > 0) & (l2 > 0)

    def lock_up_stretch(self, prestretch):
        return 12 * prestretch, False


@pytest.fixture(scope="module")
def exact():
    """Pressures in Pa of the true film, by shooting, at volumes in m³."""
    film = dj.Membrane(dj.Gent(stretch_limit=TRUE["stretch_limit"]))
    p = np.array([dj.equilibrium(film, volume=v).pressure for v in VOLUME])
    scale = float(UNITS.scale("pressure")) * TRUE["shear_modulus"] / 45e3
    return VOLUME * float(UNITS.scale("volume")), p * scale


def test_exact_curves_give_their_constants_back(exact):
    """States found by shooting, fitted through the explicit map: two methods, so agreement to nine digits is not trivial."""
    found = dj.calibrate(*exact, units=UNITS)
    assert list(found.parameters) == ["shear_modulus", "stretch_limit"]
    for name, true in TRUE.items():
        assert abs(found.parameters[name] / true - 1) < 1e-7
        low, high = found.intervals[name]
        assert low < found.parameters[name] < high and high / low - 1 < 1e-6
    assert np.abs(found.residuals).max() < 1e-7 * exact[1].max()
    assert abs(float(found.units.shear_modulus) / 60e3 - 1) < 1e-7
    assert abs(float(found.membrane.material.stretch_limit) / 120 - 1) < 1e-7


def test_prestretch_under_voltage():
    """Dimensionless, at Φ = 0.05: prestretch and limiting stretch together."""
    film = dj.Membrane(dj.Gent(stretch_limit=150.0), prestretch=1.4)
    volume = np.geomspace(0.5, 60.0, 15)
    p = np.array([dj.equilibrium(film, voltage=0.05, volume=v).pressure for v in volume])
    start = dj.Membrane(prestretch=1.2)
    found = dj.calibrate(volume, p, membrane=start, over=("prestretch", "stretch_limit"), voltage=0.05)
    assert abs(found.parameters["prestretch"] - 1.4) < 1e-7
    assert abs(found.parameters["stretch_limit"] / 150 - 1) < 1e-6


def test_intervals_cover_the_truth(exact):
    """Of 200 noisy curves at least 90 % have each true constant inside its 95 % interval, and not nearly all of them."""
    random = np.random.default_rng(1)
    volume, pressure = exact
    noise = 0.01 * pressure.mean()
    hits = dict.fromkeys(TRUE, 0)
    noises, estimates = [], []
    for _ in range(200):
        found = dj.calibrate(volume, pressure + noise * random.normal(size=len(volume)), units=UNITS)
        noises.append(found.noise)
        estimates.append([found.parameters[n] for n in TRUE])
        for name, true in TRUE.items():
            low, high = found.intervals[name]
            hits[name] += low < true < high
    for count in hits.values():
        assert 180 <= count <= 199
    assert abs(np.mean(noises) / noise - 1) < 0.05
    # the reported correlation is that of the estimates
    assert abs(np.corrcoef(np.array(estimates).T)[0, 1] - found.correlation[0, 1]) < 0.15


def test_outliers_hardly_move_a_robust_fit(exact):
    random = np.random.default_rng(2)
    volume, pressure = exact
    noisy = pressure + 0.005 * pressure.mean() * random.normal(size=len(volume))
    wild = noisy.copy()
    wild[[4, 13, 20]] *= [1.6, 0.5, 1.5]
    clean = dj.calibrate(volume, noisy, units=UNITS)
    plain = dj.calibrate(volume, wild, units=UNITS)
    for loss in ("huber", "soft_l1"):
        robust = dj.calibrate(volume, wild, units=UNITS, loss=loss)
        for name, true in TRUE.items():
            width = clean.intervals[name][1] - clean.intervals[name][0]
            assert abs(robust.parameters[name] - clean.parameters[name]) < width
            assert abs(robust.parameters[name] - true) < 0.3 * abs(plain.parameters[name] - true)
            assert robust.intervals[name][0] < true < robust.intervals[name][1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"volume": [1.0, 2.0]}, "as long as the other"),
        ({"pressure": [1.0, -1.0, 1.0, 1.0]}, "`pressure` must be positive and finite, but is -1.0 at point 1"),
        (
            {"over": ("stiffness",)},
            "`over` must name some of stretch_limit, prestretch, pressure_offset, but holds 'stiffness'",
        ),
        ({"over": ()}, "one constant or more"),
        ({"volume": [0.001, 0.002, 0.003, 0.004]}, "must be that of an inflated film, but the largest is 0.004 A³"),
        ({"membrane": dj.Membrane(dj.Gent(1.5)), "over": ("prestretch",)}, "stretch_limit 1.5 it has states up to"),
        ({"loss": "cubic"}, "`loss` must be one of linear, huber, soft_l1, but is 'cubic'"),
        ({"level": 1.0}, "`level` must lie between 0 and 1"),
        ({"noise": 0.0}, "`noise`"),
        ({"voltage": -1.0}, "`voltage`"),
        ({"over": ("stretch_limit", "prestretch"), "volume": [1.0, 2.0], "pressure": [1.0, 1.0]}, "more points"),
    ],
)
def test_bad_input_is_refused(change, message):
    given = {"volume": [0.5, 1.0, 2.0, 3.0], "pressure": [1.3, 1.5, 1.8, 1.9]} | change
    with pytest.raises(ValueError, match=message):
        dj.calibrate(given.pop("volume"), given.pop("pressure"), **given)


def test_a_start_out_of_reach_is_raised(exact):
    """J = 20 locks at a tenth of the largest volume, and μ is wrong a hundredfold; a film without prestretch gives 1."""
    start = dj.Membrane(dj.Gent(stretch_limit=20.0))
    found = dj.calibrate(*exact, membrane=start, units=dj.Units(shear_modulus=4.5e6))
    for name, true in TRUE.items():
        assert abs(found.parameters[name] / true - 1) < 1e-7
    assert found.warnings == () and float(found.membrane.breakdown.shear_modulus) == found.parameters["shear_modulus"]
    noisy = exact[1] + 0.005 * exact[1].mean() * np.random.default_rng(5).normal(size=len(VOLUME))
    found = dj.calibrate(exact[0], noisy, units=UNITS, over=(*TRUE, "prestretch"))
    for name, true in (TRUE | {"prestretch": 1.0}).items():
        low, high = found.intervals[name]
        assert low <= true <= high and high < 1.05 * low


def test_constants_of_ones_own_material():
    """Plain numbers of a user's class, of either sign; the shear modulus stays, as their unit."""
    scale = float(UNITS.scale("pressure"))
    cases = [
        (Rubber(1.3, 0.4), Rubber(1, 1.0), {"stiffness": 1.3, "rise": 0.4}),
        (Rubber(1.3, -0.02), Rubber(1.0, 0.01), {"stiffness": 1.3, "rise": -0.02}),
    ]
    for true, start, wanted in cases:
        apex = np.geomspace(1.15, 4.0, 12)
        pressure, volume = (np.asarray(x) for x in explicit_map(true, apex, 0.0, 1.0, 96.0)[:2])
        found = dj.calibrate(
            volume * float(UNITS.scale("volume")), pressure * scale, membrane=dj.Membrane(start), units=UNITS
        )
        assert set(found.parameters) == set(wanted)
        for name, value in wanted.items():
            assert abs(found.parameters[name] / value - 1) < 1e-6


def test_names_of_constants():
    """Defaults omit constants that a curve cannot determine, and refused constants are named."""
    rubber = dj.Electrostrictive(dj.Gent(), thickness_coefficient=0.1)
    for material, wanted in (
        (dj.Gent(), ["shear_modulus", "stretch_limit"]),
        (dj.NeoHookean(), ["shear_modulus"]),
        (dj.MooneyRivlin(), ["c1", "c2"]),
        (dj.Ogden(), ["moduli[0]", "moduli[1]", "moduli[2]"]),
        (rubber, ["shear_modulus", "stretch_limit"]),
        (Rubber(1, 0.1), ["stiffness", "rise"]),
    ):
        assert sought_constants(material, None, True) == wanted
    assert sought_constants(dj.Ogden(), ("exponents", "moduli[1]"), True) == [
        *(f"exponents[{i}]" for i in range(3)),
        "moduli[1]",
    ]
    with pytest.raises(ValueError, match="of shear_modulus, c1, c2 the shear modulus is the unit"):
        sought_constants(dj.MooneyRivlin(), ("shear_modulus", "c1", "c2"), True)
    with pytest.raises(ValueError, match="of shear_modulus, c1 the shear modulus is the unit"):
        sought_constants(dj.MooneyRivlin(c2=0.0), ("shear_modulus", "c1"), True)


def test_constants_that_a_curve_does_not_determine_are_refused(exact):
    # volumes so small that there is no best limiting stretch
    below = VOLUME < 1.5
    noisy = exact[1] * (1 + 0.01 * np.random.default_rng(1).normal(size=len(VOLUME)))
    with pytest.raises(
        ValueError, match=r"the curve (depends on|determines), but .*stretch_limit.*leave it out of `over`"
    ):
        dj.calibrate(exact[0][below], noisy[below], units=UNITS)
    # synthetic Jacobians: c has no effect; c has the effect of a and b together
    a, b, pressure = np.linspace(1.0, 2.0, 9), np.linspace(1.0, 3.0, 9) ** 2, np.ones(9)
    names = dict.fromkeys("abc", 1.0)
    check_determined(names, names, np.column_stack([a, b, a * b]), pressure)
    with pytest.raises(ValueError, match="a change of c does not change the pressures"):
        check_determined(names, names, np.column_stack([a, b, 1e-12 * a]), pressure)
    with pytest.raises(ValueError, match="but a, b and c can change together"):
        check_determined(names, names, np.column_stack([a, b, a - 2 * b]), pressure)
    with pytest.raises(ValueError, match="the search stopped at a 1"):
        check_optimal(names, names, np.column_stack([a, b, a * b]), 0.1 * a, pressure, np.zeros(3, bool))
    # a parameter at its lower limit, which the residuals would push below
    check_optimal({"a": 1.0}, {"a": 1.0}, a[:, None], -0.1 * a, pressure, np.ones(1, bool))
    for ends in ((0.0, np.inf), (1.0, np.nan), (1e-5, 1e5)):
        with pytest.raises(ValueError, match="that the curve determines"):
            check_intervals({"a": ends}, {"a": 1.0}, 0.95)
    assert "hardly determines a" in check_intervals({"a": (0.1, 10.0)}, {"a": 1.0}, 0.95)[0]


def test_a_misfit_that_is_no_noise_is_said(exact):
    """Warnings about a wrong material, an offset, and absolute pressures, but not about noise or outliers."""
    volume, pressure = exact
    random = np.random.default_rng(7)
    noise = 0.01 * pressure.mean() * random.normal(size=len(volume))
    found = dj.calibrate(volume, pressure + noise, units=dj.Units(radius=17e-3))
    assert (
        "times the noise of the pressures" in found.warnings[0]
        and "fit more constants, such as the prestretch" in found.warnings[0]
    )
    found = dj.calibrate(volume, pressure + noise + 900.0, units=UNITS)
    assert "an offset of the pressures of " in found.warnings[0]
    assert abs(float(re.search(r"pressures of ([\d.]+) Pa", found.warnings[0])[1]) - 900) < 150
    assert found.to_json()["warnings"] == list(found.warnings)
    with pytest.raises(ValueError, match=r"looks absolute, and no fit matches it; subtract"):
        dj.calibrate(volume, pressure + noise + 101325.0, units=UNITS)
    both = np.concatenate([volume[::2], volume[::-2]]), np.concatenate([pressure[::2], 0.8 * pressure[::-2]])
    assert "The volume rises and falls" in dj.calibrate(*both, units=UNITS).warnings[0]


def test_many_points_are_as_good_as_fewer_states(exact):
    """40 000 points between those of the curve: splines through 256 states, every point with its own noise."""
    random = np.random.default_rng(8)
    volume = np.geomspace(0.3, 60.0, 40_000)
    curve = CurveModel(dj.Membrane(dj.Gent(120.0)), ("stretch_limit",), volume, 0.0, {})
    curve.reachable_start()
    pressure = curve(curve.free_of({"stretch_limit": 120.0}))[0]
    at = np.searchsorted(volume, VOLUME)[1:-1]
    true = np.array([dj.equilibrium(dj.Membrane(dj.Gent(120.0)), volume=volume[i]).pressure for i in at[::4]])
    np.testing.assert_allclose(pressure[at[::4]], true, rtol=1e-7)
    noise = 0.05 * pressure.mean()
    found = dj.calibrate(volume, pressure + noise * random.normal(size=len(volume)))
    low, high = found.intervals["stretch_limit"]
    assert low < 120 < high and high / low < 1.01
    assert abs(found.noise / noise - 1) < 0.02 and found.warnings == ()


def test_heights_of_the_pole(tmp_path, capsys):
    """Heights of states found by shooting give the constants back, from arrays and from a file with options."""
    film = dj.Membrane(dj.Gent(TRUE["stretch_limit"]))
    states = [dj.equilibrium(film, volume=v) for v in VOLUME]
    height = np.array([s.height for s in states]) * float(UNITS.radius)
    pressure = np.array([s.pressure for s in states]) * float(dj.Units(shear_modulus=60e3).scale("pressure"))
    found = dj.calibrate(height=height, pressure=pressure, units=UNITS)
    assert found.parameters == pytest.approx(TRUE, rel=1e-6)
    assert found.volume is None and found.to_json()["height"] == height.tolist()
    assert found.plot().axes[1].get_xlabel() == "Height / mm"
    rows = "".join(f"{1e3 * h:.9g};{p / 100:.9g}\n" for h, p in zip(height, pressure, strict=True))
    (tmp_path / "pole.csv").write_text("apex height [mm];pressure [mbar]\n" + rows)
    assert main(["calibrate", str(tmp_path / "pole.csv"), "--si", "--noise", "20"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"shear_modulus +60000 .* Pa\n", said) and re.search(r"stretch_limit +120 ", said)
    assert re.search(r"noise of one pressure: [\d.e-]+ Pa", said)
    with pytest.raises(ValueError, match="`height` must be that of an inflated film, but the largest is "):
        dj.calibrate(height=1e-6 * height, pressure=pressure, units=UNITS)
    with pytest.raises(ValueError, match="`volume` or `height` must be given, and not both"):
        dj.calibrate(height, pressure, height=height)


def test_several_voltages_determine_the_permittivity(exact):
    """States at 0, 3 and 6 kV by shooting: the permittivity and the gauge's offset as well, within their intervals.

    At 6 kV the starting film, softer and with a larger limiting stretch, has no state at some of the volumes.
    """
    units, film = dj.Units(shear_modulus=60e3), dj.Membrane(dj.Gent(TRUE["stretch_limit"]))
    volume, true = VOLUME[VOLUME < 45][::2], TRUE | {"relative_permittivity": 4.7, "pressure_offset": 700.0}
    voltage = np.repeat([0.0, 3e3, 6e3], len(volume))
    reduced = voltage / float(units.scale("voltage"))
    every = np.tile(volume, 3)
    pressure = [dj.equilibrium(film, volume=v, voltage=f).pressure for v, f in zip(every, reduced, strict=True)]
    exactly = np.array(pressure) * float(units.scale("pressure")) + 700.0
    at = every * float(UNITS.scale("volume"))
    start = dj.Units(permittivity=3 * 8.854e-12)
    found = dj.calibrate(at, exactly, voltage=voltage, units=start, over=tuple(true))
    assert found.parameters == pytest.approx(true, rel=1e-6)
    assert float(found.units.permittivity) == pytest.approx(4.7 * 8.854e-12, rel=1e-6)
    assert float(found.membrane.breakdown.relative_permittivity) == pytest.approx(4.7, rel=1e-6)
    assert [c[0] for c in found.curves] == pytest.approx([0.0, 3e3, 6e3])
    noisy = exactly + 20.0 * np.random.default_rng(3).normal(size=len(at))
    found = dj.calibrate(at, noisy, voltage=voltage, units=start, over=tuple(true), level=0.99)
    for name, value in true.items():
        low, high = found.intervals[name]
        assert low < value < high < 1.2 * low
    with pytest.raises(ValueError, match=r"`over` must name some of .*, but holds 'relative_permittivity'"):
        dj.calibrate(*exact, units=UNITS, over=("relative_permittivity",))
    with pytest.raises(ValueError, match=r"`voltage` must be one number, or one for each of the 24 points"):
        dj.calibrate(*exact, units=UNITS, voltage=[0.0, 1.0])


def test_points_of_many_voltages_are_joined():
    """Voltages of many points are interpolated each by its own spline; other points are nodes themselves."""
    random = np.random.default_rng(0)
    x, q = random.uniform(0.0, 2.0, 1000), np.repeat([0.0, 0.1, 0.3, 0.7], [400, 500, 50, 50])
    order = random.permutation(1000)
    nodes = Nodes(x[order], q[order])
    assert len(nodes.x) == 2 * 256 + 100
    values = np.sin(3 * nodes.x) + nodes.q
    np.testing.assert_allclose(nodes.at_points(values), (np.sin(3 * x) + q)[order], atol=1e-9)


def test_documents_have_no_infinities(exact):
    found = dj.calibrate(*exact, units=UNITS)
    found = dataclasses.replace(found, intervals={"shear_modulus": (0.0, np.inf)}, noise=np.nan)
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert document["intervals"]["shear_modulus"] == [0.0, None] and document["noise"] is None


def test_the_figure_shows_measurement_fit_and_residuals(exact):
    import matplotlib.pyplot as plt

    found = dj.calibrate(*exact, units=UNITS)
    figure = found.plot()
    upper, lower = figure.axes
    np.testing.assert_allclose(upper.lines[0].get_ydata(), exact[1] / 100)
    assert upper.get_ylabel() == "Pressure $p$ / mbar" and lower.get_xlabel() == "Volume $V$ / ml"
    # the fit is a smooth curve, here through exact points
    x, y = upper.lines[1].get_data()
    assert len(x) > 100 and x[[0, -1]] == pytest.approx(exact[0][[0, -1]] * 1e6)
    np.testing.assert_allclose(CubicSpline(np.log(x), y)(np.log(exact[0] * 1e6)), exact[1] / 100, rtol=1e-5)
    film = dj.Membrane(dj.Gent(TRUE["stretch_limit"]))
    scale = float(dj.Units(shear_modulus=60e3).scale("pressure"))
    for k in (30, 90):
        state = dj.equilibrium(film, volume=x[k] * 1e-6 / float(UNITS.scale("volume")))
        assert y[k] == pytest.approx(state.pressure * scale / 100, rel=1e-6)
    np.testing.assert_allclose(lower.lines[-1].get_ydata(), found.residuals / found.noise)
    plt.close(figure)
