"""Cross-sections, distributions, material pages, ramps as loops and animations, tables in notebooks."""

import dataclasses

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib import animation
from matplotlib.collections import LineCollection
from PIL import Image

import dielectric_jax as dj


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def balloon(membrane):
    """The profile of a charged balloon."""
    return dj.profile(membrane, dj.equilibrium(membrane, volume=20.0, voltage=0.09))


def test_a_cross_section(balloon):
    figure, ax = plt.subplots()
    assert dj.plot.plot_cross_section(balloon, ax=ax, units=dj.Units()) is ax
    (lines,) = (c for c in ax.collections if isinstance(c, LineCollection))
    points = np.concatenate(lines.get_segments())
    millimetre = 22.5
    np.testing.assert_allclose(points[:, 0].max(), millimetre * balloon.r.max(), rtol=1e-12)
    np.testing.assert_allclose(points[:, 1].max(), millimetre * balloon.z[-1], rtol=1e-12)
    np.testing.assert_allclose(points[:, 0], -points[::-1, 0], atol=1e-12)
    ratio = balloon.breakdown_ratio
    assert lines.get_clim() == (ratio.min(), ratio.max())
    assert [ax.get_xlabel(), ax.get_ylabel()] == ["Radius $r$ / mm", "Height / mm"]
    assert f"{millimetre * balloon.z[-1]:.3g} mm" in [t.get_text() for t in ax.texts]
    assert figure.axes[1].get_ylabel() == r"Breakdown ratio $E/E_{\mathrm{EB}}$"
    alone = dj.plot.plot_cross_section(balloon, colour_by=None, reference=False, dimensions=False)
    assert len(alone.lines) == 1 and not alone.collections
    with pytest.raises(ValueError, match=r"`quantity` must be one of radius, r, .* but is 'colour'"):
        dj.plot.plot_cross_section(balloon, colour_by="colour")


def test_the_latitude_of_breakdown(balloon):
    assert dj.plot.breakdown_latitudes(balloon) == []
    ratio = 1.5 - balloon.radius**2  # equals one at R = √½
    broken = dataclasses.replace(balloon, breakdown_ratio=ratio)
    (latitude,) = dj.plot.breakdown_latitudes(broken)
    assert latitude == pytest.approx(0.5**0.5, abs=1e-4)
    ax = dj.plot.plot_cross_section(broken, reference=False)
    dashed = [line for line in ax.lines if line.get_linestyle() == "--"]
    height = balloon.z[-1] - np.interp(latitude, balloon.radius, balloon.z)
    np.testing.assert_allclose(dashed[0].get_ydata(), height, rtol=1e-12)


def test_distributions(balloon):
    _, ax = plt.subplots()
    assert dj.plot.plot_distribution(balloon, ax=ax) is ax
    one, two = ax.lines
    np.testing.assert_array_equal(one.get_ydata(), balloon.stretch_1)
    np.testing.assert_array_equal(two.get_ydata(), balloon.stretch_2)
    assert one.get_linestyle() != two.get_linestyle() and ax.get_ylabel() == "Stretch $λ$"
    ax = dj.plot.plot_distribution([balloon, balloon], "stress_1", units=dj.Units(), labels=["a", "b"])
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 45 * balloon.stress_1, rtol=1e-12)
    assert ax.get_ylabel() == "Meridional stress $σ_1$ / kPa"
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["a", "b"]
    with pytest.raises(ValueError, match="`labels` must be one for each of 1 profiles, but are 2"):
        dj.plot.plot_distribution(balloon, labels=["a", "b"])


def test_a_material_s_page():
    """Neo-Hookean: λ − λ⁻², λ − λ⁻³, λ − λ⁻⁵ by hand; the balloon's largest pressure; the film's pull-in."""
    figure = dj.plot.plot_material(dj.NeoHookean(), units=dj.Units(), largest_stretch=6.0)
    tension, balloon, film, *_ = figure.axes
    for line, power in zip(tension.lines, (-2, -3, -5), strict=True):
        s = np.asarray(line.get_xdata())
        np.testing.assert_allclose(line.get_ydata(), 45 * (s - s**power), rtol=1e-9)
    assert max(balloon.lines[0].get_ydata()) == pytest.approx(1.239463, abs=1e-4)
    unit = 32.88422182218  # kV for H = 1 mm
    assert max(film.lines[0].get_ydata()) == pytest.approx(0.687365 * unit, abs=1e-3 * unit)
    s = np.asarray(film.lines[1].get_xdata())
    at = np.searchsorted(s, 2.0)
    assert film.lines[1].get_ydata()[at] == pytest.approx(30.6 * s[at] ** 1.13 / s[at] ** 2, rel=1e-12)
    locked = dj.plot.tension_curves(dj.Gent(), [11.0, 20.0])["equal-biaxial"]
    assert np.isfinite(locked[0]) and np.isnan(locked[1])


def test_the_path_of_a_ramp(chamber):
    """V_C = 800: up in two legs with the jump left out, down in two; every state lies on the line of the air."""
    diagram = chamber(800.0)
    up, down = dj.plot.ramp_path(diagram), dj.plot.ramp_path(diagram, "down")
    for path, start, end in ((up, 0.0, 0.115172761046), (down, None, 0.0)):
        q = path["voltage_squared"]
        assert set(path["leg"]) == {0, 1} and np.all(np.diff(path["leg"]) >= 0)
        sign = 1 if path is up else -1
        for leg in (0, 1):
            assert np.all(sign * np.diff(q[path["leg"] == leg]) >= 0)
        assert start is None or q[0] == start
        assert q[-1] == pytest.approx(end**2, abs=1e-10)
        gas = (path["pressure"] + 50) * (path["volume"] + 800)
        np.testing.assert_allclose(gas, (1.886612680245 + 50) * 802.42, rtol=1e-8)
    snap, landing = (np.flatnonzero(np.diff(up["leg"]))[0] + k for k in (0, 1))
    assert up["volume"][snap] == pytest.approx(3.56458915, rel=1e-8)
    assert up["volume"][landing] == pytest.approx(9.07429967742, rel=1e-9)


def test_a_loop_and_a_film(chamber, tmp_path):
    diagram = chamber(800.0)
    _, ax = plt.subplots()
    assert dj.plot.plot_ramp(diagram, ax=ax, units=dj.Units()) is ax
    assert ax.get_ylabel() == "Voltage $Φ$ / kV"
    assert max(max(line.get_ydata()) for line in ax.lines) == pytest.approx(0.115172761046 * 32.88422182218, rel=1e-8)
    film = dj.plot.animate_ramp(diagram, tmp_path / "ramp.gif", frames=3)
    with Image.open(film) as picture:
        assert 3 <= picture.n_frames <= 5
    for path, message in [("ramp.avi", "must end in .gif or .mp4"), ("ramp.mp4", "where ffmpeg is not installed")]:
        if path == "ramp.mp4" and animation.writers.is_available("ffmpeg"):
            continue
        with pytest.raises(ValueError, match=message):
            dj.plot.animate_ramp(diagram, tmp_path / path)
    with pytest.raises(ValueError, match="`frames` must be at least 2"):
        dj.plot.animate_ramp(diagram, tmp_path / "ramp.gif", frames=1)


def test_tables_in_notebooks(chamber):
    diagram = chamber(800.0)
    shown = diagram._repr_html_()
    assert shown.count("<table>") == shown.count("</table>") == 2
    assert "<td>snap</td><td>up</td><td>0.097199</td>" in shown
    scene = dj.Scene(diagram.scene.membrane, diagram.scene.loading, units=dj.Units())
    assert "<th>voltage / kV</th>" in dataclasses.replace(diagram, scene=scene)._repr_html_()
    assert "area strain" in diagram.ramp()._repr_html_()
    state = diagram.ramp()["snap"][0].state
    assert "<td>0.097199</td>" in state._repr_html_() and isinstance(state._repr_html_(), str)
