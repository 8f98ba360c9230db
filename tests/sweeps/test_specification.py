"""TOML specifications of sweeps: what they mean, and what is refused."""

import pathlib

import numpy as np
import pytest

import dielectric_jax as dj

EXAMPLE = pathlib.Path(__file__).parents[2] / "docs" / "example_sweep.toml"


def test_the_example_means_what_it_says():
    scene, axes, options = dj.sweeps.read_specification(EXAMPLE)
    assert options == {"engine": "surface", "resolve": False, "curves": False}
    assert [axis.dimension for axis in axes] == ["prestretch", "filling"]
    assert axes[0].columns["prestretch"].tolist() == [1.0, 1.25, 1.5]
    chambers, fillings = axes[1].columns["chamber_volume"], axes[1].columns["initial_volume"]
    assert 300 <= chambers.min() < 300.1 and 24000 < chambers.max() <= 25000
    assert abs(np.log(chambers).mean() - np.log(300 * 25000) / 2) < 0.01 and abs(fillings.mean() - 2.2) < 0.001
    assert float(scene.loading.atmospheric_pressure) == 50 and float(scene.membrane.material.stretch_limit) == 270


def test_modes_are_a_range_as_on_the_command_line(tmp_path):
    spec = tmp_path / "spec.toml"
    spec.write_text('engine = "continuation"\nmodes = "2:4"\n[scene]\npressure = 1.0\n[product]\nprestretch = [1, 2]\n')
    assert dj.sweeps.read_specification(spec)[2] == {"engine": "continuation", "modes": (2, 3, 4)}
    spec.write_text(spec.read_text().replace("2:4", "4:2"))
    with pytest.raises(ValueError, match="`modes` must be a whole number or a range such as 0:12"):
        dj.sweeps.read_specification(spec)


def test_a_described_scene_comes_back():
    scene = dj.Scene(
        dj.Membrane(dj.ArrudaBoyce(60.0), 1.5, dj.ConstantBreakdown(3.0)),
        dj.Chamber(volume=900.0, initial_pressure=1.2, atmospheric_pressure=20.0, polytropic_exponent=1.4),
    )
    assert dj.model.describe(dj.sweeps.scene_of(dj.model.describe(scene))) == dj.model.describe(scene)
    ogden = dj.Scene(dj.Membrane(dj.Ogden(moduli=(1.0, 0.1), exponents=(2.0, 4.0))), dj.ConstantPressure(1.0))
    assert dj.model.describe(dj.sweeps.scene_of(dj.model.describe(ogden))) == dj.model.describe(ogden)
    held = dj.Scene(dj.Membrane(dj.NeoHookean()), dj.ConstantPressure(1.5))
    assert dj.model.describe(dj.sweeps.scene_of(dj.model.describe(held))) == dj.model.describe(held)


def test_every_kind_of_axis(tmp_path):
    (tmp_path / "scenes.csv").write_text("breakdown_field_scale\n0.9\n1.0\n")
    spec = tmp_path / "spec.toml"
    spec.write_text(
        """
        tolerance = 1e-6
        [scene]
        pressure = 1.0
        [product]
        prestretch = [1, 2]
        [zip.case]
        stretch_limit = [100.0, 270.0]
        [samples.draw]
        count = 3
        method = "random"
        pressure = { distribution = "triangular", from = 1, to = 2, mode = 1.5 }
        [table.scene]
        file = "scenes.csv"
        """
    )
    _, axes, options = dj.sweeps.read_specification(spec)
    assert [(a.dimension, a.size) for a in axes] == [("prestretch", 2), ("case", 2), ("draw", 3), ("scene", 2)]
    assert options == {"tolerance": 1e-6}
    data = dj.sweep(dj.sweeps.scene_of({"pressure": 1.0}), prestretch=[1.0], pressure=[0.0], progress=False)
    # a flat film that is not stretched carries no tension: it is on no surface
    assert data.outcome.item() == dj.sweeps.Answer.unresolved


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[scene", "`SPEC` must be a file of TOML"),
        ("speed = 3", "`speed`"),
        ("block = 2.5", "`block`"),
        ("curves = 1", "`curves`"),
        ("[scene]\nmaterial = 'rubber'", "`material` in [scene] must be one of gent"),
        ("[scene]\nchamber_size = 3", "`chamber_size` in [scene]"),
        ("[scene]\nchamber_volume = 'big'", "`chamber_volume` in [scene] must be a number"),
        ("[scene]\nprestretch = 1.5", "`pressure` or `chamber_volume`"),
        ("[scene]\npressure = 1.0\ninitial_volume = 2.0", "without the parameters of a chamber"),
        ("[scene]\nmaterial = 'neo-hookean'\nstretch_limit = 3\npressure = 1.0", "`material`"),
        ("[scene]\npressure = 1.0\n[product]\nprestretch = {from = 1, to = 2}", "`count`"),
        (
            "[scene]\npressure = 1.0\n[product]\nprestretch = {from = 1, to = 2, count = 3, spacing = 'odd'}",
            "`spacing`",
        ),
        ("[scene]\npressure = 1.0\n[product]\nprestretch = {from = 0, to = 2, count = 3, spacing = 'log'}", "`from`"),
        ("[scene]\npressure = 1.0\n[samples.a]\nprestretch = {from = 1, to = 2}", "`count`"),
        ("[scene]\npressure = 1.0\n[samples.a]\ncount = 2\nprestretch = {from = 2, to = 1}", "uniform distribution"),
        ("[scene]\npressure = 1.0\n[samples.a]\ncount = 2\nprestretch = {distribution = 'odd'}", "`distribution`"),
        (
            "[scene]\npressure = 1.0\n[samples.a]\ncount = 2\nprestretch = {distribution = 'normal', mean = 2}",
            "`standard_deviation`",
        ),
        ("[scene]\npressure = 1.0\n[table.a]\nfile = 'none.csv'", "none.csv"),
        *(
            (
                f"[scene]\npressure = 1.0\n[samples.a]\ncount = 2\nseed = {seed}\nprestretch = {{from = 1, to = 2}}",
                "`seed`",
            )
            for seed in ("nan", "inf", "-1", "1.0", "true", "'1'")
        ),
        *(
            (f"[scene]\npressure = 1.0\n[{where}]\n{line}", "`count`")
            for where, line in (
                ("product", "prestretch = {from = 1, to = 2, count = 1000000000000}"),
                ("product", "prestretch = {from = 1, to = 2, count = true}"),
                ("samples.a", "count = 1000000000000\nprestretch = {from = 1, to = 2}"),
                ("samples.a", "count = true\nprestretch = {from = 1, to = 2}"),
            )
        ),
        (f"[scene]\npressure = {10**400}", "`pressure` in [scene] must be finite and at most 1e+50 in size"),
        (f"[scene]\npressure = 1.0\nstretch_window = [1, {10**400}]", "`stretch_window` in [scene]"),
        (f"[scene]\npressure = {'9' * 5000}", "`SPEC` must be a file of TOML"),
        ("[scene]\nmaterial = ['gent']\npressure = 1.0", "`material` in [scene] must be one of gent"),
        ("x = " + "[" * 5000, "`SPEC` must be a file of TOML"),
        ("[scene]\npressure = 1.0\n[product]\nprestretch = 2", "`prestretch` must be a table"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, said):
    spec = tmp_path / "spec.toml"
    spec.write_text(text)
    with pytest.raises(ValueError) as error:
        dj.sweeps.read_specification(spec)
    assert said in str(error.value)


def test_constants_in_si_vary(tmp_path):
    """A softer film under the same air: p_atm in its own units is larger by the ratio of the moduli, and so is the snap."""
    spec = tmp_path / "spec.toml"
    text = "[scene]\nchamber_volume = 1600\ninitial_volume = 2.42\n[product]\nshear_modulus = [40e3, 45e3]\n"
    spec.write_text(text)
    with pytest.raises(ValueError, match=r"`shear_modulus` must have a \[units\] table"):
        dj.sweeps.read_specification(spec)
    spec.write_text(text + "[units]\nshear_modulus = 45e3\nthickness = 1e-3\n")
    scene, axes, options = dj.sweeps.read_specification(spec)
    data = dj.sweep(scene, *axes, **options, progress=False)
    assert data.shear_modulus.attrs["units"] == "Pa"
    softer = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42, atmospheric_pressure=50 * 45 / 40))
    assert abs(float(data.snap_voltage[0, 0]) / float(dj.snap_voltage(softer)) - 1) < 1e-9
    assert abs(float(data.snap_voltage[1, 0]) / 0.0764953595449 - 1) < 1e-9


FILM = "[units]\nshear_modulus = 45e3\nthickness = 1e-3\nradius = 22.5e-3\npermittivity = 4.16138e-11\n"
AIR = "initial_volume = 2.42\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # the paper's chamber in m³ and Pa: 18.2 L and 27.5 ml of air at 100 kPa
        (FILM + "[scene]\ninitial_volume = 27.5e-6\natmospheric_pressure = 100e3\n[product]\nchamber_volume = [18e-3]", "`chamber_volume` .* would be 1580"),
        (FILM + "[scene]\nchamber_volume = 18e-3\ninitial_volume = 2.42", "`chamber_volume` .* would be 1580"),
        (FILM + "[scene]\nchamber_volume = 1600\ninitial_volume = 27.565e-6", "`initial_volume` .* m³ would be 2.41997"),
        (FILM + "[scene]\nchamber_volume = 1600\ninitial_pressure = 3773", "`initial_pressure` .* Pa would be 1.8865"),
        (FILM + "[scene]\npressure = 3773\n[product]\nthickness = [1e-3]", "`pressure` .* would be 1.8865"),
        (FILM + "[scene]\npressure = 1.5\nbreakdown = 218e6", "`breakdown` .* V/m would be 6.6293"),
        (FILM + f"[scene]\n{AIR}[samples.a]\ncount = 4\nchamber_volume = {{from = 9e-3, to = 45e-3}}", "`chamber_volume`"),
        # without units two quantities must look like SI
        ("[scene]\nchamber_volume = 18e-3\ninitial_volume = 27.5e-6\natmospheric_pressure = 100e3", "looks like SI"),
        # a pressure in units of films of several thicknesses is ambiguous
        (FILM + "[scene]\npressure = 1.0\n[product]\nthickness = [1e-3, 2e-3]\npressure = [1.0]", "`pressure` must not vary .* `thickness`"),
        (FILM + f"[scene]\n{AIR}[product]\nradius = [1e-2, 2e-2]\nchamber_volume = [800, 1600]", "`chamber_volume` must not vary"),
    ],
)  # fmt: skip
def test_numbers_in_si_are_refused_not_misread(tmp_path, text, said):
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ValueError, match=said):
        dj.sweeps.read_specification(tmp_path / "s.toml")


@pytest.mark.parametrize(
    "text",
    [
        FILM + f"[scene]\n{AIR}[product]\nchamber_volume = [1600.0]\nthickness = [0.5e-3, 1e-3, 2e-3]",
        f"[scene]\nchamber_volume = 0.02\n{AIR}atmospheric_pressure = 0",
        "[scene]\npressure = 1e-5",
    ],
)
def test_dimensionless_numbers_are_read(tmp_path, text):
    (tmp_path / "s.toml").write_text(text)
    assert isinstance(dj.sweeps.read_specification(tmp_path / "s.toml")[0], dj.Scene)


def test_ranges_of_designs_in_si_are_refused_too(tmp_path):
    from dielectric_jax.apps.design_files import read_design_file

    (tmp_path / "s.toml").write_text(FILM + f"[scene]\n{AIR}[over]\nchamber_volume = [9e-3, 45e-3]")
    with pytest.raises(ValueError, match="`chamber_volume` must be dimensionless"):
        read_design_file(str(tmp_path / "s.toml"), "optimise")
