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
    assert dj.model.describe(dj.model.scene_of(dj.model.describe(scene))) == dj.model.describe(scene)
    ogden = dj.Scene(dj.Membrane(dj.Ogden(moduli=(1.0, 0.1), exponents=(2.0, 4.0))), dj.ConstantPressure(1.0))
    assert dj.model.describe(dj.model.scene_of(dj.model.describe(ogden))) == dj.model.describe(ogden)
    held = dj.Scene(dj.Membrane(dj.NeoHookean()), dj.ConstantPressure(1.5))
    assert dj.model.describe(dj.model.scene_of(dj.model.describe(held))) == dj.model.describe(held)


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
    data = dj.sweep(dj.model.scene_of({"pressure": 1.0}), prestretch=[1.0], pressure=[0.0], progress=False)
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
    text = text.replace("1600", '"18.225 l"').replace("2.42", '"27.5653125 ml"')
    spec.write_text(text + '[units]\nshear_modulus = 45e3\nthickness = "1 mm"\nrelative_permittivity = 4.7\n')
    scene, axes, options = dj.sweeps.read_specification(spec)
    assert scene.value_of("atmospheric_pressure") == 100e3
    data = dj.sweep(scene, *axes, **options, progress=False)
    assert data.shear_modulus.attrs["units"] == "Pa" and data.snap_voltage.attrs["units"] == "V"
    softer = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42, atmospheric_pressure=50 * 45 / 40))
    volts = [dj.Units(shear_modulus=modulus).to_si(1.0, "voltage") for modulus in (40e3, 45e3)]
    assert abs(float(data.snap_voltage[0, 0]) / (volts[0] * float(dj.snap_voltage(softer))) - 1) < 1e-9
    assert abs(float(data.snap_voltage[1, 0]) / (volts[1] * 0.0764953595449) - 1) < 1e-9


FILM = "[units]\nshear_modulus = 45e3\nthickness = 1e-3\nradius = 22.5e-3\npermittivity = 4.16138e-11\n"
AIR = "initial_volume = 2.42\n"
AIR_IN_SI = 'initial_volume = "27.5 ml"\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # with units a document is in SI
        (FILM + f"[scene]\n{AIR_IN_SI}[product]\nchamber_volume = [1600, 2000]", "`chamber_volume` must be in m³.* 0.018225 m³"),
        (FILM + "[scene]\nchamber_volume = 18e-3\ninitial_volume = 2.42", "`initial_volume` must be in m³"),
        (FILM + "[scene]\nchamber_volume = 18e-3\ninitial_pressure = 1.88", "`initial_pressure` must be in Pa"),
        (FILM + "[scene]\npressure = 1.5\n[product]\nthickness = [1e-3]", "`pressure` must be in Pa"),
        (FILM + f"[scene]\n{AIR_IN_SI}chamber_volume = 0.018\natmospheric_pressure = 50.0", "`atmospheric_pressure` must be (in|given in) Pa"),
        (FILM + "[scene]\npressure = 3000\nbreakdown = 6.6", "`constant_field` must be in V/m"),
        (FILM + f"[scene]\n{AIR_IN_SI}[zip.a]\nchamber_volume = [800, 1600]", "`chamber_volume`"),
        # without units two quantities must look like SI
        ("[scene]\nchamber_volume = 18e-3\ninitial_volume = 27.5e-6\natmospheric_pressure = 100e3", "looks like SI"),
        # and texts with units need them
        ('[scene]\nchamber_volume = "18 l"\ninitial_volume = 2.42', r"`chamber_volume` must be a number where there is no \[units\] table"),
        (FILM + '[scene]\nchamber_volume = "18 kV"\ninitial_volume = 27e-6', r"`chamber_volume` must be a number with a unit such as m³"),
    ],
)  # fmt: skip
def test_numbers_in_another_unit_are_refused_not_misread(tmp_path, text, said):
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ValueError, match=said):
        dj.sweeps.read_specification(tmp_path / "s.toml")


@pytest.mark.parametrize(
    "text",
    [
        FILM
        + f'[scene]\n{AIR_IN_SI}[product]\nchamber_volume = {{from = "9 l", to = 0.045, count = 3}}\nthickness = [0.5e-3, 2e-3]',
        FILM + '[scene]\npressure = "30 mbar"\nbreakdown = "80 MV/m"\n[product]\nradius = ["20 mm", "30 mm"]',
        f"[scene]\nchamber_volume = 0.02\n{AIR}atmospheric_pressure = 0",
        "[scene]\npressure = 1e-5",
    ],
)
def test_numbers_in_the_unit_of_the_document_are_read(tmp_path, text):
    (tmp_path / "s.toml").write_text(text)
    assert isinstance(dj.sweeps.read_specification(tmp_path / "s.toml")[0], dj.Scene)


def test_ranges_of_designs_are_in_the_unit_of_the_document(tmp_path):
    from dielectric_jax.apps.design_files import read_design_file

    (tmp_path / "s.toml").write_text(FILM + f"[scene]\n{AIR_IN_SI}[over]\nchamber_volume = [800, 25000]")
    with pytest.raises(ValueError, match="`chamber_volume` must be in m³"):
        read_design_file(str(tmp_path / "s.toml"), "optimise")
    (tmp_path / "s.toml").write_text(FILM + f'[scene]\n{AIR_IN_SI}[over]\nchamber_volume = ["9 l", 0.045]')
    scene, over, _ = read_design_file(str(tmp_path / "s.toml"), "optimise")
    assert over["chamber_volume"] == pytest.approx((0.009, 0.045), rel=1e-14)
    assert scene.value_of("chamber_volume") == pytest.approx(0.009, rel=1e-14)
