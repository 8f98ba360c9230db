"""Calibration: constants put into curves come out again, with honest intervals; what cannot be fitted is refused."""

import numpy as np
import pytest

import dielectric_jax as dj

VOLUME = np.geomspace(0.3, 60.0, 24)
UNITS = dj.Units()
TRUE = {"shear_modulus": 60e3, "stretch_limit": 120.0}


@pytest.fixture(scope="module")
def exact():
    """Pressures in Pa of the true film, by shooting, at volumes in m³."""
    film = dj.Membrane(dj.Gent(stretch_limit=TRUE["stretch_limit"]))
    p = np.array([dj.equilibrium(film, volume=v).pressure for v in VOLUME])
    scale = float(UNITS.scale("pressure")) * TRUE["shear_modulus"] / 45e3
    return VOLUME * float(UNITS.scale("volume")), p * scale


def test_exact_curves_give_their_constants_back(exact):
    """States found by shooting, fitted through the explicit map: two methods, so nine digits are not a matter of course."""
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
    # the correlation told is that of the estimates
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


def test_files(tmp_path, exact):
    """Columns by name, units in the header, remarks."""
    file = tmp_path / "curve.csv"
    rows = [f"{i},{float(p) / 100!r},{float(v) * 1e6!r}" for i, (v, p) in enumerate(zip(*exact, strict=True))]
    file.write_text("\n".join(["# a film", "point, pressure [mbar], volume [ml]", *rows]) + "\n", encoding="utf-8")
    volume, pressure, si = dj.read_measurement(file)
    assert si
    np.testing.assert_allclose(volume, exact[0], rtol=1e-14)
    np.testing.assert_allclose(pressure, exact[1], rtol=1e-14)
    for text, message in (
        ("volume,p\n1,2\n", "columns named volume and pressure"),
        ("volume [ml],pressure\n1,2\n", "units of both columns"),
        ("volume [gal],pressure [Pa]\n1,2\n", "'gal'"),
        ("volume,pressure\n1,2\n1,x\n", "line 3"),
        ("", "columns named"),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=message):
            dj.read_measurement(file)
    with pytest.raises(ValueError, match="readable CSV file"):
        dj.read_measurement(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"volume": [1.0, 2.0]}, "as long as the other"),
        ({"pressure": [1.0, -1.0, 1.0, 1.0]}, "`pressure` must be positive and finite, but is -1.0 at point 1"),
        ({"over": ("stiffness",)}, "`over` must name some of stretch_limit, prestretch, but holds 'stiffness'"),
        ({"over": ()}, "one constant or more"),
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


def test_the_figure_shows_measurement_fit_and_residuals(exact):
    import matplotlib.pyplot as plt

    found = dj.calibrate(*exact, units=UNITS)
    figure = found.plot()
    upper, lower = figure.axes
    np.testing.assert_allclose(upper.lines[0].get_ydata(), exact[1] / 100)
    assert upper.get_ylabel() == "Pressure p / mbar" and lower.get_xlabel() == "Volume V / ml"
    np.testing.assert_allclose(lower.lines[-1].get_ydata(), found.residuals / found.noise)
    plt.close(figure)
