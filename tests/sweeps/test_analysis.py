"""Analysis of sweeps: counts, regimes, best designs, maps, comparisons, files."""

import csv

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr

import dielectric_jax as dj
from dielectric_jax.sweeps.axes import Design, axes_of
from dielectric_jax.sweeps.store import Memory
from dielectric_jax.sweeps.variables import empty_answer, variables_of

SCENE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
CHAMBERS, FILLINGS = np.geomspace(100, 10000, 5), np.linspace(1.0, 2.5, 4)


@pytest.fixture
def data():
    """A synthetic sweep: the strain is 10 log10(V_C) + V_0, the regime "returns" below V_C = 1000 and "stays" above."""
    design = Design(SCENE, axes_of({"chamber_volume": CHAMBERS, "initial_volume": FILLINGS}))
    memory = Memory(design, design.shape, variables_of(False))
    answer = empty_answer(design.count, False)
    columns = design.columns([slice(None), slice(None)])
    answer["outcome"][:] = int(dj.sweeps.Answer.breakdown_on_branch)
    answer["regime"][:] = np.where(columns["chamber_volume"] < 1000, int(dj.Regime.returns), int(dj.Regime.stays))
    answer["area_strain"][:] = 10 * np.log10(columns["chamber_volume"]) + columns["initial_volume"]
    answer["area_strain"][-1] = np.nan
    answer["landing_ratio"][:, 0] = columns["initial_volume"] / 2.5
    answer["ramp_error"][:] = 1e-10
    memory.write(0, answer)
    return memory.dataset({"title": "made up"})


def test_counts(data):
    told = dj.sweeps.count_sweep(data)
    assert told == {"scenes": 20, "outcome": {"breakdown_on_branch": 20}, "regime": {"stays": 12, "returns": 8}}


def test_selection_by_regime_keeps_every_parameter(data):
    some = dj.sweeps.select_regime(data, "returns")
    assert some.sizes["scene"] == 8 and (some.chamber_volume < 1000).all()
    assert np.allclose(some.area_strain, 10 * np.log10(some.chamber_volume) + some.initial_volume)
    assert dj.sweeps.select_regime(data, "returns", "stays").sizes["scene"] == 20
    with pytest.raises(ValueError, match="`regime` must be one of undetermined"):
        dj.sweeps.select_regime(data, "sings")


def test_best_designs_obey_what_is_asked(data):
    best = dj.sweeps.best_designs(data, count=3)
    # the largest is unknown; the next are those of the largest chamber in order of decreasing filling
    assert best.chamber_volume.values.tolist() == pytest.approx([10000] * 3)
    assert best.initial_volume.values.tolist() == pytest.approx([2.0, 1.5, 1.0])
    kept = dj.sweeps.best_designs(data, count=2, where=data.landing_ratio.isel(jump=0) <= 0.5)
    assert kept.initial_volume.values.tolist() == [1.0, 1.0] and kept.chamber_volume[0] > kept.chamber_volume[1]
    assert float(dj.sweeps.best_designs(data, lowest=True, count=1).area_strain[0]) == pytest.approx(21.0)
    assert dj.sweeps.best_designs(data, count=99).sizes["scene"] == 19
    for wrong, said in (
        ({"variable": "speed"}, "`speed`"),
        ({"variable": "snap_volume"}, "one value a scene"),
        ({"count": 0}, "`count`"),
    ):
        with pytest.raises(ValueError, match=said):
            dj.sweeps.best_designs(data, **wrong)


def test_a_comparison_tells_differences_beyond_errors(data):
    other = data.copy(deep=True)
    other["area_strain"][0, 0] *= 1 + 5e-10  # within ten times the error
    other["area_strain"][1, 1] *= 1 + 1e-8
    other["area_strain"][2, 2] = np.nan
    other["regime"][0, :2] = int(dj.Regime.no_snap)
    told = dj.sweeps.compare_sweeps(data, other)
    assert told["regime"] == {"differing": 2}
    strain = told["area_strain"]
    assert strain["differing"] == 2 and strain["one_only"] == 1 and strain["other_only"] == 0
    assert strain["beyond_errors"] == 1 and 9e-9 < strain["largest"] < 1.1e-8
    with pytest.raises(ValueError, match="`chamber_volume` differs"):
        dj.sweeps.compare_sweeps(data, data.isel(chamber_volume=[0, 1, 2, 3]))


def test_maps_over_two_parameters(data):
    ax = dj.sweeps.plot_sweep(data, "regime", x="chamber_volume", y="initial_volume")
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["stays", "returns"]
    assert ax.get_xscale() == "log" and ax.get_yscale() == "linear"
    assert ax.get_xlabel() == "Chamber volume / $A^3$"
    mesh = ax.collections[0]
    assert mesh.get_array().shape == (4, 5) and np.array_equal(mesh.get_array()[0], data.regime[:, 0])
    # cells of different regimes have different colours
    colours = mesh.cmap(mesh.norm(data.regime.values.T))
    assert len(np.unique(colours.reshape(-1, 4), axis=0)) == 2
    figure, own = plt.subplots()
    assert dj.sweeps.plot_sweep(data, "area_strain", x="initial_volume", y="chamber_volume", ax=own) is own
    assert own.collections[0].get_array().shape == (5, 4) and len(figure.axes) == 2
    points = dj.sweeps.plot_sweep(
        dj.sweeps.select_regime(data, "stays"), "area_strain", x="chamber_volume", y="initial_volume"
    )
    assert len(points.collections[0].get_offsets()) == 12
    with pytest.raises(ValueError, match="must vary along"):
        dj.sweeps.plot_sweep(data, "snap_volume", x="chamber_volume", y="initial_volume")
    plt.close("all")


def test_files_hold_the_same_numbers(data, tmp_path):
    dj.sweeps.export_sweep(data, tmp_path / "d.nc")
    with xr.open_dataset(tmp_path / "d.nc") as again:
        xr.testing.assert_identical(again.load(), data)
    dj.sweeps.export_sweep(data, tmp_path / "d.csv")
    with open(tmp_path / "d.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20 and rows[0]["regime"] == "returns" and rows[-1]["area_strain"] == ""
    strain = [float(row["area_strain"]) for row in rows[:-1]]
    assert strain == [10 * np.log10(float(r["chamber_volume"])) + float(r["initial_volume"]) for r in rows[:-1]]
    assert "snap_voltage_0" in rows[0] and "snap_voltage_1" in rows[0]
    dj.sweeps.export_sweep(data, tmp_path / "few.csv", variables=["area_strain"])
    assert (tmp_path / "few.csv").read_text().splitlines()[0] == "chamber_volume,initial_volume,area_strain"
    with pytest.raises(ValueError, match=r"`path` must end in \.nc or \.csv"):
        dj.sweeps.export_sweep(data, tmp_path / "d.txt")
