"""Regimes of designs, and the exact curves between them."""

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax import Regime


@pytest.fixture(scope="module")
def edges(scene, surface):
    return dj.design.regime_edges(scene, {"chamber_volume": (400.0, 2000.0)}, surface=surface)


@pytest.fixture(scope="module")
def small(scene, surface):
    """A map of 60 × 60 designs."""
    over = {"chamber_volume": (300.0, 25000.0), "initial_volume": (2.3, 2.9)}
    return dj.regime_map(scene, over, points=60, surface=surface)


def test_known_edges(edges):
    """The chambers at which the regime changes at V_0 = 2.42, from methods that share no code."""
    assert [e.below.name for e in edges] == ["breaks_in_snap", "returns", "no_snap", "returns"]
    assert edges[-1].above == Regime.stays
    known = [467.850181739, 484.04966, 551.39914, 1455.896262454]
    assert np.allclose([e.value for e in edges], known, rtol=[5e-12, 1e-8, 1e-8, 5e-12], atol=0)
    assert [e.kind for e in edges] == [
        "landing at breakdown",
        "two folds merge",
        "two folds merge",
        "snap-back at zero voltage",
    ]
    assert max(e.error for e in edges) < 1e-12


def test_known_filling(scene, surface):
    """At V_C = 25000 the membrane survives its snap only when filled beyond V_0 = 2.361001148."""
    (edge,) = dj.design.regime_edges(
        scene.replace(chamber_volume=25000.0), {"initial_volume": (2.3, 2.5)}, points=40, surface=surface
    )
    assert abs(edge.value / 2.361001148 - 1) < 2e-10 and edge.above == Regime.stays


def test_edges_by_shooting(scene, edges):
    """E/E_EB of the landing is 1 at its edge, by shooting, independent of any surface."""
    at = scene.replace(chamber_volume=edges[0].value)
    assert abs(dj.critical.landing_point(at).breakdown_ratio - 1) < 1e-10


def test_landings_leave_the_scanned_window(scene, surface):
    """The boundary of no_landing: there, by continuation, the landing's load is 0.9 of the largest at its stretch."""
    (edge,) = dj.design.regime_edges(scene, {"chamber_volume": (120.0, 200.0)}, points=20, surface=surface)
    assert (edge.below, edge.above) == (Regime.no_landing, Regime.breaks_in_snap)
    assert edge.kind == "landing leaves the window" and edge.error < 1e-9
    # a ten-millionth inside, where the landing still counts
    landing = dj.voltage_volume(scene.replace(chamber_volume=edge.value * (1 + 1e-7))).ramp()["landing"][0].state
    share = landing.voltage_squared / float(scene.membrane.largest_load(landing.apex_stretch))
    assert 0.9 - 1e-6 < share < 0.9
    regimes = [dj.regime_of(scene.replace(chamber_volume=edge.value * f)) for f in (1 - 1e-4, 1 + 1e-4)]
    assert regimes == [Regime.no_landing, Regime.breaks_in_snap]


def test_both_sides_of_every_curve(small, scene, surface):
    """A hundredth of a cell beside each point, across a row of the grid, the two regimes are those of the curve."""
    step, seen = np.log(25000 / 300) / 59, 0
    for curve in small.boundaries:
        inner = curve.points[(curve.error < 1e-9) & (curve.points[:, 0] > 301) & (curve.points[:, 0] < 24900)]
        # those on a row lie between two chambers of the same filling
        rows = np.abs(inner[:, 1][:, None] - small.values[1]).min(axis=1) < 1e-12
        places = inner[rows][:: max(1, rows.sum() // 4)]
        if not len(places) or not curve.kind:
            continue
        sides = []
        for factor in (-1e-2, 1e-2):
            moved = {"chamber_volume": places[:, 0] * np.exp(factor * step), "initial_volume": places[:, 1]}
            sides.append(dj.classify_designs(scene, moved, surface=surface, whole=False).regime)
        wanted = tuple(sorted(int(r) for r in curve.regimes))
        # where folds merge the surface leaves a sliver undecided, and some large chambers
        told = [tuple(sorted(pair)) for pair in zip(*sides, strict=True) if int(Regime.not_decided) not in pair]
        assert all(pair == wanted for pair in told)
        seen += len(told)
    assert seen >= 20


def test_whole_diagrams_agree(small, scene):
    """Random designs of the map, each by its own continuation and scan."""
    random = np.random.default_rng(5)
    for i, j in random.integers(0, 60, (3, 2)):
        x, y = small.values[0][j], small.values[1][i]
        assert dj.regime_of(scene.replace(chamber_volume=x, initial_volume=y)) == small.at(x, y)


def test_what_the_surface_does_not_decide(scene, surface):
    """No landing, or one far above breakdown, in agreement with whole diagrams."""
    found = dj.classify_designs(
        scene, {"chamber_volume": [100.0, 240.0, 25000.0], "initial_volume": [2.42, 2.42, 1.5]}, surface=surface
    )
    assert [Regime(int(r)).name for r in found.regime] == ["no_landing", "breaks_in_snap", "breaks_in_snap"]


def test_constant_pressure(surface):
    """p = 1.82 breaks down in the snap (section 5 of the article); above the peak p = 1.908684829414 no state is stable and small."""
    held = dj.Scene(dj.Membrane(), dj.ConstantPressure(1.8))
    found = dj.classify_designs(held, {"pressure": [1.82, 1.5]}, surface=surface)
    assert [Regime(int(r)).name for r in found.regime] == ["breaks_in_snap", "breaks_in_snap"]


def test_plot_of_a_map(small):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    _, ax = plt.subplots()
    assert small.plot(ax=ax, designs=[(1600.0, 2.42)]) is ax
    assert len(ax.lines) == len(small.boundaries) + 1 and ax.get_xscale() == "log"
    assert small.plot().figure is not ax.figure
    plt.close("all")


def test_refusals(scene):
    for over in ({"chamber_volume": (1.0, 2.0)}, {}):
        with pytest.raises(ValueError, match="`over` must name two parameters"):
            dj.regime_map(scene, over)
    with pytest.raises(ValueError, match="`chamber_volume` must range over two finite numbers"):
        dj.design.regime_edges(scene, {"chamber_volume": (2.0, 1.0)})
    with pytest.raises(ValueError, match="`colour` must be one of chamber_volume"):
        dj.design.regime_edges(scene, {"colour": (1.0, 2.0)})
    with pytest.raises(ValueError, match="`points`"):
        dj.regime_map(scene, {"chamber_volume": (1.0, 2.0), "initial_volume": (2.0, 3.0)}, points=2)
    with pytest.raises(ValueError, match="`loading` must be a Chamber"):
        dj.classify_designs(dj.Scene(dj.Membrane(), dj.ConstantVoltage(0.1)), {"prestretch": [1.0]})
