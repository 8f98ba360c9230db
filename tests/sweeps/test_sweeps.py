"""Sweeps in memory: reference numbers, both engines, undecided scenes, and invalid scenes."""

import json

import numpy as np
import pytest
import xarray as xr

import dielectric_jax as dj
from dielectric_jax import Regime
from dielectric_jax.sweeps import Answer

SCENE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
CHAMBERS = [467.84, 500.0, 800.0, 1600.0, 25000.0]


@pytest.fixture(scope="module")
def swept():
    return dj.sweep(SCENE, chamber_volume=CHAMBERS, curves=True)


def test_reference_numbers_by_their_names(swept):
    one = swept.sel(chamber_volume=1600.0)
    assert abs(float(one.snap_voltage[0]) / 0.0764953595449 - 1) < 1e-10
    assert abs(float(one.landing_volume[0]) / 19.9533292542 - 1) < 1e-10
    assert abs(float(one.landing_ratio[0]) - 0.568782) < 1e-6
    assert abs(float(one.breakdown_voltage) / 0.100970094106 - 1) < 1e-10
    assert abs(float(one.area_strain) - 16.1218889) < 1e-7
    assert abs(float(one.rest_volume) / 11.7561689651 - 1) < 1e-9  # the snapped state at zero voltage
    assert abs(float(one.start_pressure) / 1.886612680245 - 1) < 1e-11
    back = swept.sel(chamber_volume=800.0)
    assert abs(float(back.snap_back_voltage[0]) / 0.0890347141691 - 1) < 1e-10


def test_regimes_exclude_each_other_as_the_references_say(swept):
    """Below 467.85 the membrane breaks down in the snap, between the cusps it does not snap, from 1455.896 on it stays."""
    names = [Regime(int(r)).name for r in swept.regime]
    assert names == ["breaks_in_snap", "no_snap", "returns", "stays", "stays"]
    assert (swept.answered_by == 0).all() and (swept.outcome.values[1:] == Answer.breakdown_on_branch).all()


def test_every_value_has_its_error_beside_it_and_codes_their_meanings(swept):
    for name, variable in swept.data_vars.items():
        if variable.dtype.kind == "f" and not name.endswith("_error") and name != "reach":
            error = swept[variable.attrs["ancillary_variables"]]
            there = np.isfinite(variable)
            assert there.any() or name.startswith(("snap_back", "landing_back"))
            assert (error.broadcast_like(variable).transpose(*variable.dims).values[there.values] < 1e-7).all(), name
            assert variable.attrs["units"] == "1" and variable.attrs["long_name"] and variable.attrs["counted_in"]
        if "flag_values" in variable.attrs:
            assert len(variable.attrs["flag_meanings"].split()) == len(variable.attrs["flag_values"])
    assert set(np.unique(swept.outcome)) <= set(swept.outcome.attrs["flag_values"])
    assert swept.chamber_volume.attrs["counted_in"] == "A^3"


def test_curves_obey_the_gas_and_hold_the_snap(swept):
    """(p + 50)(V + V_C) is that of the filling, and no state below the landing lies above the snap's voltage."""
    for chamber, one in zip(CHAMBERS, swept.transpose("chamber_volume", ...).curve_volume, strict=True):
        curve = swept.sel(chamber_volume=chamber)
        filled = (1.886612680245 + 50) * (2.42 + chamber)
        there = np.isfinite(one.values)
        assert there.sum() > 100
        gas = (curve.curve_pressure + 50) * (curve.curve_volume + chamber)
        assert np.allclose(gas.values[there], filled, rtol=1e-11)
    one = swept.sel(chamber_volume=1600.0)
    before = one.curve_volume < float(one.landing_volume[0])
    assert float(one.curve_voltage_squared.where(before).max()) <= float(one.snap_voltage[0]) ** 2 * (1 + 1e-9)


def test_continuation_agrees_and_decides_what_is_open(swept):
    """The other engine, which integrates and takes steps, and whole diagrams for scenes that it leaves open."""
    other = dj.sweep(SCENE, chamber_volume=CHAMBERS, engine="continuation", resolve=True, tolerance=1e-8)
    assert (other.answered_by > 0).all()
    told = dj.sweeps.compare_sweeps(swept, other)
    for name in ("outcome", "regime", "snaps"):
        assert told[name]["differing"] == 0
    for name in ("snap_voltage", "landing_volume", "breakdown_voltage", "breakdown_apex_stretch", "rest_volume"):
        assert told[name]["largest"] < 1e-8 and told[name]["one_only"] == told[name]["other_only"] == 0, name
    assert told["snap_voltage"]["beyond_errors"] == 0


def test_a_filling_by_pressure_is_that_by_volume(swept):
    filled = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_pressure=1.886612680245))
    data = dj.sweep(filled, chamber_volume=CHAMBERS[:4])
    assert np.allclose(data.start_volume, 2.42, rtol=1e-9)
    expected = swept.isel(chamber_volume=slice(0, 4))
    assert np.allclose(data.breakdown_voltage, expected.breakdown_voltage, rtol=1e-9, equal_nan=True)


def test_pressures_and_whole_diagrams():
    """p = 1.2 snaps to no unbroken state, as its diagram says; p = 0 is flat and unstretched, and has no answer."""
    held = dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0))
    data = dj.sweep(held, pressure=[0.0, 1.82], resolve=True)
    assert [Answer(int(o)).name for o in data.outcome] == ["no_answer", "breakdown_in_snap"]
    assert dj.numerics.Code(int(data.code[0])) is dj.numerics.Code.flat_unstretched
    assert abs(float(data.snap_voltage[1, 0]) - 0.114568360882) < 1e-11
    assert np.isnan(data.snap_voltage[0]).all()


def test_a_diagram_is_told_like_a_ramp(swept):
    """The variables of a whole diagram are those of the surface."""
    from dielectric_jax.sweeps.variables import answer_of_diagram

    for chamber in (800.0, 1600.0):
        told = answer_of_diagram(dj.voltage_volume(SCENE.replace(chamber_volume=chamber)))
        expected = swept.sel(chamber_volume=chamber)
        assert int(told["regime"][0]) == int(expected.regime) and int(told["outcome"][0]) == int(expected.outcome)
        for name, values in told.items():
            if values.dtype.kind == "f" and not name.endswith(("_error", "reach")):
                known = np.isfinite(expected[name].values)
                if name.startswith("breakdown_crossing") or name.startswith(("fold", "zero_voltage")):
                    known &= np.isfinite(values[0])  # the diagram follows the branch farther
                size = np.maximum(np.abs(expected[name].values[known]), 1e-3)
                # the position of a fold is known to the square root of the error of its load
                bound = 3e-5 if name.startswith(("fold", "snap")) and "voltage" not in name else 1e-8
                assert (np.abs(values[0][known] - expected[name].values[known]) < bound * size).all(), name


def test_modes_end_ramps_where_they_are_asked_for():
    """Of a large chamber mode 10 turns unstable first, of 20 L hoop tension is lost at 5.091 kV, of 30 nothing is lost."""
    film = dj.Membrane(breakdown=dj.VHBBreakdown(3.0))
    scene = dj.Scene(film, dj.Chamber(volume=25000.0, initial_volume=2.42))
    volumes = [30.0, 1755.8299039780522, 25000.0]
    data = dj.sweep(scene, chamber_volume=volumes, engine="continuation", modes=[10], progress=False)
    assert [dj.Regime(int(r)).name for r in data.regime] == ["no_landing", "wrinkles", "bulges"]
    assert [Answer(int(o)).name for o in data.outcome] == ["no_landing", "lost_axisymmetry", "lost_axisymmetry"]
    assert data.mode_number.values.tolist() == [0, 0, 10]
    voltage = data.axisymmetry_loss_voltage.values
    assert np.isnan(voltage[0]) and abs(dj.Units().read(voltage[1], "voltage") - 5.091) < 5e-4
    assert abs(voltage[2] - 0.116448455) < 1e-9  # by finite elements, `data/modes.json`
    assert dj.regime_of(scene.replace(chamber_volume=volumes[1]), modes=[10]) == dj.Regime.wrinkles
    assert json.loads(data.attrs["specification"])["modes"] == [10]


def test_modes_are_asked_of_continuation_only():
    with pytest.raises(ValueError, match="`engine` must be 'continuation' with `modes`"):
        dj.sweep(SCENE, chamber_volume=[800.0], modes=[2])
    with pytest.raises(ValueError, match="`modes` must be whole numbers from 1"):
        dj.sweep(SCENE, chamber_volume=[800.0], engine="continuation", modes=[0])


def test_a_scene_that_cannot_be_leaves_the_others_alone():
    """A prestretch of 12 is beyond the limiting stretch of J = 270, not of J = 400."""
    axis = dj.sweeps.zipped(prestretch=[1.0, 12.0], chamber_volume=[1600.0, 1600.0])
    data = dj.sweep(SCENE, axis)
    assert [Answer(int(o)).name for o in data.outcome] == ["breakdown_on_branch", "invalid_scene"]
    assert abs(float(data.snap_voltage[0, 0]) / 0.0764953595449 - 1) < 1e-10
    assert data.prestretch.values.tolist() == [1.0, 12.0] and data.scene.values.tolist() == [0, 1]


def test_an_error_in_a_block_is_that_of_its_scene(monkeypatch):
    from dielectric_jax.sweeps import blocks as workers

    def ramps(surface, chamber, *more, **options):
        if (chamber == 500.0).any():
            raise FloatingPointError
        return dj.diagram.chamber_ramps(surface, chamber, *more, **options)

    monkeypatch.setattr(workers, "chamber_ramps", ramps)
    data = dj.sweep(SCENE, chamber_volume=CHAMBERS)
    assert [Answer(int(o)).name for o in data.outcome] == [
        "breakdown_in_snap", "failed", "breakdown_on_branch", "breakdown_on_branch", "breakdown_on_branch"
    ]  # fmt: skip
    assert np.isfinite(data.breakdown_voltage.values[2:]).all() and np.isnan(data.breakdown_voltage.values[1])


def test_blocks_depend_on_the_sweep_alone():
    """It depends on the engine, the variables and the count: two runs of one sweep have the same layout of their stores."""
    from dielectric_jax.sweeps.blocks import Job, block_size

    counts = 1, 500, 10_000, 131_072, 10**7
    for job, expected in (
        (Job(SCENE, "surface"), [256, 256, 512, 8192, 8192]),
        (Job(SCENE, "surface", resolve=True), [256, 256, 512, 1024, 1024]),
        (Job(SCENE, "surface", curves=True), [256, 256, 512, 1024, 1024]),
        (Job(SCENE, "continuation"), [32, 32, 128, 128, 128]),
    ):
        assert [block_size(job, count) for count in counts] == expected


def test_sweeps_that_nothing_can_hold_are_refused():
    """A hundred million million scenes: in memory, as blocks of one, and with a name that the dataset has already."""
    chambers, fillings = np.linspace(300.0, 25000.0, 10**6), np.linspace(1.5, 2.9, 10**6)
    with pytest.raises(ValueError, match="`output` must name a store for 1000000000000 scenes"):
        dj.sweep(SCENE, chamber_volume=chambers, initial_volume=fillings, block=2**30)
    with pytest.raises(ValueError, match="`block` must be larger"):
        dj.sweep(SCENE, chamber_volume=chambers, initial_volume=[2.0, 2.4], block=1)
    for name in ("jump", "outcome", "block", "snap_voltage"):
        with pytest.raises(ValueError, match=f"`{name}` must not be the name of an axis"):
            dj.sweep(SCENE, dj.sweeps.zipped(name, chamber_volume=[800.0, 1600.0]))


def test_the_surfaces_of_a_family_are_used_from_nine_prestretches_on():
    from dielectric_jax.sweeps.axes import Design, axes_of
    from dielectric_jax.sweeps.sweeps import _job

    few, many = (
        _job(Design(SCENE, axes_of({"prestretch": np.linspace(1, 3, n)})), "surface", False, False, 1e-9)
        for n in (8, 9)
    )
    assert few.family is None and many.family == (1.0, 3.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"engine": "magic"}, "`engine`"),
        ({"curves": True, "engine": "continuation"}, "`curves`"),
        ({"block": 0}, "`block`"),
        ({"resume": True}, "`resume`"),
        ({"executor": 0}, "`executor`"),
        ({"executor": "nowhere:1"}, "`executor`"),
        ({"tolerance": 0.0}, "`tolerance`"),
        ({"speed": [1.0]}, "`speed`"),
    ],
)
def test_bad_input_is_one_sentence(options, said):
    if options.get("executor") == "nowhere:1":
        pytest.importorskip("distributed")
        options = {"executor": "tcp://127.0.0.1:1"}
    with pytest.raises(ValueError) as error:
        dj.sweep(SCENE, chamber_volume=[800.0], **options)
    assert said in str(error.value) and str(error.value).count(". ") == 0


def test_a_missing_extra_is_named(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError) as error:
        dj.sweep(SCENE, chamber_volume=[800.0])
    assert str(error.value) == '`xarray` must be installed for this, but is not: pip install "dielectric-jax[io]".'


def test_the_answer_is_an_ordinary_dataset(swept, tmp_path):
    assert isinstance(swept, xr.Dataset)
    swept.to_netcdf(tmp_path / "sweep.nc")
    with xr.open_dataset(tmp_path / "sweep.nc") as again:
        xr.testing.assert_identical(again.load(), swept)
