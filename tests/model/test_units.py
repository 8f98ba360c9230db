"""Conversion to SI and back: by hand for the paper's membrane, by scale-free laws, and on the command line."""

import dataclasses
import itertools
import json
import math

import jax
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.apps.cli import main
from dielectric_jax.plot.diagrams import plot_chamber, plot_pressure_volume

MU, H, A, EPSILON = 45e3, 1e-3, 22.5e-3, 4.7 * 8.854e-12  # the paper's membrane
PRESSURE, VOLUME, VOLTAGE = MU * H / A, A**3, H * math.sqrt(MU / EPSILON)
SNAP, BREAKDOWN = 0.0764953595449, 0.100970094106  # voltages of V_C = 1600 (section 4 of the model)


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", "off")


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("pressure", PRESSURE),
        ("atmospheric_pressure", PRESSURE),
        ("volume", VOLUME),
        ("chamber_volume", VOLUME),
        ("voltage", VOLTAGE),
        ("voltage_squared", VOLTAGE**2),
        ("field", VOLTAGE / H),
        ("charge", EPSILON * VOLTAGE / H * A**2),
        ("height", A),
        ("stress_1", MU),
        ("energy", MU * H * A**2),
    ],
)
def test_units_by_hand(name, unit):
    units = dj.Units()
    assert units.to_si(1.5, name) == pytest.approx(1.5 * unit, rel=1e-14)
    assert units.from_si(1.5 * unit, name) == pytest.approx(1.5, rel=1e-14)
    np.testing.assert_allclose(units.to_si(np.array([1.0, 2.0]), name), [unit, 2 * unit], rtol=1e-14)


def test_numbers_of_the_paper():
    """100 kPa is 50; 12 ml and 20 L; the unit of the field; p V, Q Φ and energies are measured in one unit."""
    units = dj.Units()
    assert units.from_si(100e3, "atmospheric_pressure") == pytest.approx(50, rel=1e-14)
    assert units.read(1.0, "field") == pytest.approx(32.88422182218, rel=1e-12)
    assert units.read(2.42, "volume") == pytest.approx(2.42 * 11.390625, rel=1e-14)
    assert (units.read_name("volume"), units.read_name("chamber_volume")) == ("ml", "L")
    other = dj.Units(shear_modulus=12e3, thickness=0.3e-3, radius=0.1, permittivity=3e-11)
    for one in (units, other):
        joule = one.to_si(1.0, "energy")
        assert one.to_si(1.0, "pressure") * one.to_si(1.0, "volume") == pytest.approx(joule, rel=1e-14)
        assert one.to_si(1.0, "charge") * one.to_si(1.0, "voltage") == pytest.approx(joule, rel=1e-14)


def test_presets():
    membrane, units = dj.model.vhb_4910()
    assert float(membrane.material.stretch_limit) == 270 and float(units.shear_modulus) == 45e3
    membrane, units = dj.model.vhb_4910("tension", thickness=0.5e-3)
    assert float(membrane.material.stretch_limit) == 372 and float(units.shear_modulus) == 68e3
    # the breakdown law is that of section 3 in MV/m, whatever the unit
    assert units.to_si(float(membrane.breakdown.field(2.0)), "field") == pytest.approx(30.6e6 * 2**1.13, rel=1e-13)
    with pytest.raises(ValueError, match=r"`model` must be gent for the inflation fit, but is 'arruda-boyce'"):
        dj.model.vhb_4910(model="arruda-boyce")
    with pytest.raises(ValueError, match="`fit` must be one of inflation, tension"):
        dj.model.vhb_4910("shear")


def scene(**changes):
    chamber = {"volume": 20e-3, "initial_volume": 12e-6, "atmospheric_pressure": 100e3}
    return dj.Scene.from_si(dj.Membrane(), dj.Chamber(**chamber | changes))


def test_a_scene_from_si():
    made = scene()
    assert float(made.loading.volume) == pytest.approx(20e-3 / VOLUME, rel=1e-14)
    assert float(made.loading.initial_volume) == pytest.approx(12e-6 / VOLUME, rel=1e-14)
    back = made.units.to_si(made.loading)
    assert (float(back.volume), float(back.atmospheric_pressure)) == pytest.approx((20e-3, 100e3), rel=1e-14)
    held = dj.Scene.from_si(dj.Membrane(), dj.ConstantPressure(2e3), dj.Units(thickness=2e-3))
    assert float(held.loading.pressure) == pytest.approx(2e3 / (2 * PRESSURE), rel=1e-14)
    assert dj.model.describe(held)["thickness"] == 2e-3


SILICONE = dj.Units(shear_modulus=0.3e6, thickness=0.2e-3, radius=12.5e-3, permittivity=2.8 * 8.854e-12)
AIR = dj.Chamber(volume=0.5e-3, initial_volume=8e-6, atmospheric_pressure=100e3)


def test_a_constant_field_is_in_volts_a_metre():
    """80 MV/m over √(μ/ε) = 110 MV/m, whichever way it is given; by its size nobody takes one for the other."""
    made = dj.Scene.from_si(dj.Membrane(dj.Gent(60.0), 1.2, dj.ConstantBreakdown(80e6)), AIR, SILICONE)
    field = 80e6 / math.sqrt(0.3e6 / (2.8 * 8.854e-12))
    assert float(made.membrane.breakdown.constant_field) == pytest.approx(field, rel=1e-12)
    assert made.units.to_si(field, "field") == pytest.approx(80e6, rel=1e-12)
    with pytest.raises(ValueError, match=r"`constant_field` must be in V/m for a scene in SI, .* but is 6\.6"):
        dj.Scene.from_si(dj.Membrane(breakdown=dj.ConstantBreakdown(6.6)), AIR)
    with pytest.raises(ValueError, match=r"must be in units of √\(μ/ε\), .* but is 8e\+07; Scene.from_si"):
        dj.Scene(dj.Membrane(breakdown=dj.ConstantBreakdown(80e6)), dj.ConstantPressure(1.0), units=dj.Units())


@pytest.mark.parametrize(
    "ask",
    [
        lambda made: dj.Scene.from_si(made.membrane, dj.Chamber(1600.0, 2.42, atmospheric_pressure=100e3)),
        lambda made: made.replace(chamber_volume=1600.0),
        lambda made: made.replace(atmospheric_pressure=50.0),
        lambda made: dj.sweep(made, chamber_volume=[800.0, 1600.0], progress=False),
        lambda made: dj.sweep(made, initial_volume=[2.42], engine="continuation", progress=False),
        lambda made: dj.classify_designs(made, {"atmospheric_pressure": [40.0, 50.0]}),
        lambda made: dj.regime_map(made, {"chamber_volume": (5e-3, 20e-3), "initial_volume": (1.0, 2.0)}),
        lambda made: dj.maximise_area_strain(made, over={"chamber_volume": (500.0, 2000.0)}),
        lambda made: dj.fold_curves(made, "initial_volume", (1.0, 2.0)),
        lambda made: dj.design.regime_edges(made, {"initial_pressure": (1.0, 1.8)}),
    ],
)
def test_a_number_that_looks_dimensionless_is_refused_everywhere(ask):
    with pytest.raises(
        ValueError, match=r"must be in (m³|Pa), because the scene carries units, but .* looks dimensionless"
    ):
        ask(scene())


def test_texts_with_units():
    made = scene().replace(chamber_volume="18.225 l", initial_volume="27.565 ml", atmospheric_pressure="1 bar")
    assert float(made.loading.volume) == pytest.approx(1600.0, rel=1e-13)
    assert made.value_of("atmospheric_pressure") == pytest.approx(100e3, rel=1e-14)
    thin = made.replace(thickness="0.5 mm", shear_modulus="68 kPa", permittivity="4.7 eps0")
    assert float(thin.units.thickness) == 0.5e-3 and float(thin.units.permittivity) == pytest.approx(EPSILON, rel=1e-14)
    assert thin.value_of("chamber_volume") == pytest.approx(18.225e-3, rel=1e-13)
    assert dj.Units(radius="22.5 mm", density="1 g/cm3").density == 1000.0
    for message, ask in [
        (r"`chamber_volume` must be a number with a unit such as m³, L, ml.*, but is '3 kV'", lambda: made.replace(chamber_volume="3 kV")),
        (r"`prestretch` must be a number, but is '1 mm'", lambda: made.replace(prestretch="1 mm")),
        (r"`chamber_volume` must be a number, because the scene carries no `units`", lambda: FREE.replace(chamber_volume="1 l")),
        (r"`thickness` must be a number with a unit such as m, cm, mm", lambda: dj.Units(thickness="0.2")),
        (r"`initial_pressure` must be a number with a unit .* but is '3 bar\(a\)'", lambda: made.replace(initial_pressure="3 bar(a)")),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match=message):
            ask()


FREE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


def test_a_scene_in_si_gives_the_same_answers_in_si():
    """Every verb, in m³, Pa and V, against the same question without units."""
    made = dj.Scene.from_si(dj.Membrane(), dj.Units().to_si(FREE.loading))
    volumes = np.array([800.0, 1600.0])
    assert made.value_of("chamber_volume") == pytest.approx(1600 * VOLUME, rel=1e-14)
    assert float(dj.snap_voltage(made)) == pytest.approx(SNAP * VOLTAGE, rel=1e-10)
    slope = jax.grad(lambda volume: dj.snap_voltage(made.replace(chamber_volume=volume)))(1600 * VOLUME)
    assert float(slope) == pytest.approx(-1.27029e-5 * VOLTAGE / VOLUME, rel=1e-6)
    assert float(dj.critical.breakdown_voltage(made)) == pytest.approx(BREAKDOWN * VOLTAGE, rel=1e-10)
    onset = float(dj.critical.bistability_onset(made))
    assert onset == pytest.approx(1455.896262 * VOLUME, rel=1e-9)
    for engine in ("surface", "continuation"):
        data = dj.sweep(made, chamber_volume=volumes * VOLUME, engine=engine, progress=False)
        assert data.snap_voltage[:, 0].values == pytest.approx(np.array([0.097199007, SNAP]) * VOLTAGE, rel=1e-8)
        assert data.start_volume.values == pytest.approx(2.42 * VOLUME, rel=1e-9)
        assert data.chamber_volume.attrs["units"] == data.start_volume.attrs["units"] == "m3"
        assert data.snap_voltage.attrs["units"] == "V" and "counted_in" not in data.snap_voltage.attrs
        assert data.snap_pressure.attrs["units"] == "Pa" and data.area_strain.attrs["units"] == "1"
    litres = [f"{1e3 * volume * VOLUME!r} l" for volume in (460.0, 475.0, 500.0, 1600.0)]
    found = dj.classify_designs(made, {"chamber_volume": litres})
    assert [dj.Regime(int(r)).name for r in found.regime] == ["breaks_in_snap", "returns", "no_snap", "stays"]
    edges = dj.design.regime_edges(made, {"chamber_volume": ("15 l", "20 l")}, points=40)
    assert [e.value for e in edges] == pytest.approx([onset], rel=1e-8)
    curves = dj.fold_curves(made, "chamber_volume", (450 * VOLUME, 600 * VOLUME), kinds=("fold",), samples=3)
    cusps = [p.parameter for p in curves.named("cusp")]
    assert cusps == pytest.approx([484.04966 * VOLUME, 551.39914 * VOLUME], rel=1e-6)
    assert curves.plot().get_xlabel() == r"Chamber volume $V_{\mathrm{C}}$ / L"
    state = dj.equilibrium(made, voltage="2 kV")
    assert state.volume == dj.equilibrium(made, voltage=2e3).volume
    assert state.volume == pytest.approx(dj.equilibrium(FREE, voltage=2e3 / VOLTAGE).volume, rel=1e-9)


def test_films_of_other_thickness_keep_what_is_given_in_si():
    """A sweep over thickness and chamber in SI: every scene is that of its own units."""
    made = dj.Scene.from_si(dj.Membrane(), dj.Units().to_si(FREE.loading))
    given = {"thickness": [0.8e-3, 1e-3], "chamber_volume": [0.012, 0.018]}
    data = dj.sweep(made, **given, progress=False)
    for thickness, volume in itertools.product(*given.values()):
        own = dj.Scene.from_si(
            dj.Membrane(), dj.Chamber(volume, 2.42 * VOLUME, atmospheric_pressure=100e3), dj.Units(thickness=thickness)
        )
        one = data.sel(thickness=thickness, chamber_volume=volume)
        assert float(one.snap_voltage[0]) == pytest.approx(float(dj.snap_voltage(own)), rel=1e-8)


def test_designs_in_si():
    made = dj.Scene.from_si(dj.Membrane(), dj.Units().to_si(FREE.loading))
    ranges = {"chamber_volume": (500.0, 25000.0)}
    one = dj.maximise_area_strain(FREE, ranges, survival_margin=0.2, compare=0)
    other = dj.maximise_area_strain(
        made, {"chamber_volume": ("5.6953125 l", "284.765625 l")}, survival_margin=0.2, compare=0
    )
    assert other.parameters["chamber_volume"] == pytest.approx(one.parameters["chamber_volume"] * VOLUME, rel=1e-8)
    assert other.area_strain == pytest.approx(one.area_strain, rel=1e-9) and other.active == one.active
    document = other.to_json()
    assert document["units"] == "SI" and document["scene"]["chamber_volume"] == pytest.approx(
        other.parameters["chamber_volume"], rel=1e-12
    )


def test_the_law_of_vhb_is_doubted_for_other_films():
    with pytest.warns(UserWarning, match="law of VHB 4910, which a film with a shear modulus of 3e\\+05 Pa is hardly"):
        dj.Scene.from_si(dj.Membrane(), AIR, SILICONE)
    with pytest.warns(UserWarning, match="relative permittivity of 12"):
        dj.Scene.from_si(dj.Membrane(), AIR, dj.Units(permittivity=12 * 8.854e-12))
    for law in (dj.VHBBreakdown(scale=0.5), dj.ConstantBreakdown(80e6)):  # these were chosen
        dj.Scene.from_si(dj.Membrane(breakdown=law), AIR, SILICONE)
    for fit in ("inflation", "tension"):
        film, units = dj.model.vhb_4910(fit)
        dj.Scene.from_si(film, AIR, units)


def test_other_constants_keep_the_apparatus():
    """Quantities in SI and the breakdown field in MV/m stay fixed; derivatives follow (p_atm A/(μH) falls as 1/H)."""
    before = scene()
    after = before.replace(shear_modulus=68e3, thickness=0.5e-3, radius=0.03, permittivity=3e-11)
    old, new = before.units.to_si(before.loading), after.units.to_si(after.loading)
    for name in ("volume", "initial_volume", "atmospheric_pressure"):
        assert float(getattr(new, name)) == pytest.approx(float(getattr(old, name)), rel=1e-13)
    law = after.membrane.breakdown
    assert after.units.to_si(float(law.field(3.0)), "field") == pytest.approx(30.6e6 * 3**1.13, rel=1e-13)
    constant = dj.Scene(dj.Membrane(breakdown=dj.ConstantBreakdown(2.0)), dj.ConstantPressure(1.0), units=dj.Units())
    stiffer = constant.replace(shear_modulus=4 * MU)
    assert float(stiffer.membrane.breakdown.constant_field) == pytest.approx(1.0, rel=1e-14)
    assert float(stiffer.loading.pressure) == pytest.approx(0.25, rel=1e-14)
    slope = jax.grad(lambda h: before.replace(thickness=h).loading.atmospheric_pressure)(H)
    assert float(slope) == pytest.approx(-50 / H, rel=1e-13)


def test_refusals():
    units = dj.Units()
    for message, call in [
        ("`thickness` must be positive and finite, but is 0.0", lambda: dj.Units(thickness=0.0)),
        ("`name` must be given with a number", lambda: units.to_si(1.0)),
        ("`name` must be one of .*pressure, .* but is 'colour'", lambda: units.to_si(1.0, "colour")),
        ("`atmospheric_pressure` must be given in Pa", lambda: units.from_si(dj.Chamber(1.0, 1.0))),
        ("A Scene must be converted part by part", lambda: units.to_si(scene())),
        (
            "`thickness` must be a parameter of this scene, but it carries no `units`",
            lambda: bare().replace(thickness=1),
        ),
        ("`shear_modulus` of the breakdown law must be that of the units, 68000", lambda: bare(dj.Units(68e3))),
        ("`units` must be a Units, but is a float", lambda: bare(1.0)),
    ]:
        with pytest.raises(ValueError, match=message):
            call()
    custom = dj.Membrane(breakdown=dj.model.CustomBreakdown(lambda stretch: stretch))
    with pytest.raises(ValueError, match="`breakdown` must be a VHBBreakdown or ConstantBreakdown where units change"):
        dj.Scene(custom, dj.ConstantPressure(1.0), units=units).replace(thickness=1e-3)


def bare(units=None):
    return dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0), units=units)


def test_records_there_and_back(chamber):
    units, diagram = dj.Units(), chamber(1600.0)
    (snap,), (breakdown,) = diagram.ramp()["snap"], units.read(diagram.ramp())["breakdown"]
    assert units.to_si(snap.state).voltage == pytest.approx(SNAP * VOLTAGE, rel=1e-9)
    assert breakdown.state.voltage == pytest.approx(BREAKDOWN * VOLTAGE / 1e3, rel=1e-9)
    assert breakdown.state.apex_stretch == pytest.approx(8.10285526922, rel=1e-9)
    for record in (snap, diagram.branches[0], diagram.ramp(), dj.profile(diagram.scene.membrane, snap.state)):
        there = units.to_si(record)
        assert type(there) is type(record)
        for name in (f.name for f in dataclasses.fields(record)):
            np.testing.assert_equal(np.shape(getattr(there, name)), np.shape(getattr(record, name)), err_msg=name)
    document = diagram.to_json()
    in_si = diagram.to_json(units)
    assert in_si["units"] == "SI" and in_si["unit_names"]["volume"] == "m³" and in_si["scene"]["radius"] == A
    assert in_si["ramp"][1]["voltage"] == pytest.approx(SNAP * VOLTAGE, rel=1e-9)
    assert in_si["window"] == document["window"] and in_si["area_strain"] == document["area_strain"]
    again = units.reduce(in_si)
    for name in ("pressure", "volume", "voltage_squared", "charge", "height"):
        columns = (np.array(d["branches"][0][name], float) for d in (again, document))
        np.testing.assert_allclose(*columns, rtol=1e-13)
    # dU = p dV in joules along the branch at Φ = 0 is p dV in the unit of energy: the two units are one
    first = in_si["branches"][0]
    assert first["pressure"][0] * first["volume"][0] == pytest.approx(
        document["branches"][0]["pressure"][0] * document["branches"][0]["volume"][0] * MU * H * A**2, rel=1e-12
    )


def test_ensembles_convert_too():
    point = dj.diagram.States(*(np.array([v]) for v in (2.0, 1.0, 0.01, 3.0, 1e-12)))
    there = dj.Units().to_si(point)
    assert there.pressure[0] == pytest.approx(PRESSURE) and there.voltage[0] == pytest.approx(0.1 * VOLTAGE)
    assert there.apex_stretch[0] == 2.0 and there.error[0] == 1e-12


def test_the_order_of_parameters_does_not_matter():
    chamber = dj.Chamber(volume=0.018, initial_volume=27e-6, atmospheric_pressure=100e3)
    scene = dj.Scene.from_si(dj.Membrane(), chamber, dj.Units())
    new = {"shear_modulus": 90e3, "chamber_volume": 0.02, "atmospheric_pressure": 80e3}
    for names in itertools.permutations(new):
        found = scene.replace(**{name: new[name] for name in names})
        assert found.units.shear_modulus == 90e3
        # counted in the new modulus; the filling in SI is as before
        assert found.loading.volume * A**3 == pytest.approx(0.02, rel=1e-14)
        assert found.loading.atmospheric_pressure * 2 * PRESSURE == pytest.approx(80e3, rel=1e-14)
        assert found.loading.initial_volume * A**3 == pytest.approx(27e-6, rel=1e-14)


def test_figures_in_units(chamber, curve):
    diagram = chamber(1600.0)
    figure = plot_chamber(diagram, [curve(0.0)], units=dj.Units())
    left, right = figure.axes
    assert left.get_ylabel() == "Pressure $p$ / mbar" and right.get_ylabel() == "Voltage $Φ$ / kV"
    assert right.get_xlabel() == "Volume $V$ / ml"
    (snap,) = [line for line in right.lines if len(line.get_xdata()) == 60]
    assert snap.get_ydata()[0] == pytest.approx(SNAP * VOLTAGE / 1e3, rel=1e-9)
    assert "$Φ$ = 0 kV" in [text.get_text() for text in left.get_legend().get_texts()]
    # the line of the air ends at the right limit, 24 mbar or so below its start: Boyle's law in SI by hand
    air = max(left.lines, key=lambda line: len(line.get_xdata()) == 400)
    volume, pressure = np.asarray(air.get_xdata()) * 1e-6, np.asarray(air.get_ydata()) * 100
    gas = (pressure + 100e3) * (volume + 1600 * VOLUME)
    np.testing.assert_allclose(gas, (1.886612680245 * PRESSURE + 100e3) * (2.42 + 1600) * VOLUME, rtol=1e-9)
    carried = dataclasses.replace(
        diagram, scene=dj.Scene(diagram.scene.membrane, diagram.scene.loading, units=dj.Units())
    )
    assert carried.plot().axes[0].get_ylabel() == "Voltage $Φ$ / kV"
    assert plot_pressure_volume(curve(0.0)).get_ylabel() == "Pressure $p$ / ($μH/A$)"


def answer(capsys, *argv):
    assert main([*argv, "--json", "-"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_command_line_in_si(capsys):
    document = answer(capsys, "equilibrium", "--si", "--volume", "12e-6")
    (state,) = document["states"]
    assert document["units"] == "SI" and document["unit_names"]["pressure"] == "Pa"
    assert state["pressure"] == pytest.approx(1.1417 * PRESSURE, rel=5e-5)  # 22.8 mbar
    assert state["volume"] == pytest.approx(12e-6, rel=1e-9)
    # twice as thick and stiff, four times the radius: the same dimensionless state
    more = ["--shear-modulus", "90e3", "--thickness", "2e-3", "--radius", "0.09", "--relative-permittivity", "9.4"]
    (other,) = answer(capsys, "equilibrium", "--si", *more, "--volume", str(12e-6 * 64), "--voltage", "0")["states"]
    assert other["apex_stretch"] == pytest.approx(state["apex_stretch"], rel=1e-9)
    assert other["pressure"] == pytest.approx(state["pressure"], rel=1e-9)


def test_the_command_line_reads_in_mbar(capsys):
    assert main(["equilibrium", "--si", "--volume", "12e-6"]) == 0
    out = capsys.readouterr().out
    assert "pressure [mbar]" in out and "22.834" in out and "shear_modulus 45000 Pa" in out


def test_the_command_line_asks_for_si(capsys):
    assert main(["equilibrium", "--volume", "1", "--radius", "0.02"]) == 2
    assert capsys.readouterr().err == "dielectric-jax: --radius must be given with --si only.\n"
    assert main(["equilibrium", "--si", "--volume", "1"]) == 2
    assert "between 0 and 0.00518632 m³" in capsys.readouterr().err  # 455.315 of 22.5³ mm³
    assert main(["equilibrium", "--si", "--apex-stretch", "0.5"]) == 2
    assert "These numbers are dimensionless" in capsys.readouterr().err


def test_a_breakdown_field_in_si(capsys):
    film = [
        "--stretch-limit",
        "60",
        "--prestretch",
        "1.2",
        "--shear-modulus",
        "0.3e6",
        "--relative-permittivity",
        "2.8",
    ]
    asked = ["equilibrium", "--si", *film, "--voltage", "1e3", "--volume", "8e-6"]
    document = answer(capsys, *asked, "--breakdown", "80e6")
    assert document["scene"]["breakdown"] == pytest.approx(80e6, rel=1e-12)
    assert main([*asked, "--breakdown", "3"]) == 2
    assert "--breakdown must be in V/m with --si, at least 10000, but is 3." in capsys.readouterr().err
    assert main(["equilibrium", "--volume", "2.42", "--breakdown", "80e6"]) == 2
    assert "in units of √(μ/ε) without --si, at most 10000, but is 8e+07." in capsys.readouterr().err
    assert main(asked) == 0
    assert "--breakdown is the law of VHB 4910, which a film with a shear modulus" in capsys.readouterr().err


def test_a_chamber_in_si(capsys):
    """V_C = 1600 and V_0 = 2.42 in litres and millilitres; the atmospheric pressure is 100 kPa by default."""
    filled = ["voltage-volume", "--si", "--chamber-volume", str(1600 * VOLUME), "--initial-volume", str(2.42 * VOLUME)]
    document = answer(capsys, *filled)
    ramp = {event["event"]: event for event in document["ramp"] if event["direction"] == "up"}
    assert ramp["snap"]["voltage"] == pytest.approx(SNAP * VOLTAGE, rel=1e-9)
    assert ramp["breakdown"]["voltage"] == pytest.approx(BREAKDOWN * VOLTAGE, rel=1e-9)
    assert document["scene"]["atmospheric_pressure"] == pytest.approx(100e3)
    assert document["scene"]["chamber_volume"] == pytest.approx(1600 * VOLUME)


def test_quantities_with_units_on_the_command_line(capsys):
    """They imply --si, the opening gives the radius, and a plain number beside them is refused."""
    state = ["equilibrium", "--volume", "27.5653125 ml", "--voltage", "1.6 kV"]
    ring = ["--prestretch", "1.5", "--opening-radius", "33.75 mm", "--thickness", "1 mm", "--shear-modulus", "45 kPa"]
    (found,) = answer(capsys, *state, *ring)["states"]
    membrane = dj.Membrane(prestretch=1.5)
    known = dj.equilibrium(membrane, volume=2.42, voltage=1.6e3 / VOLTAGE)
    assert found["pressure"] == pytest.approx(known.pressure * PRESSURE, rel=1e-9)
    assert found["volume"] == pytest.approx(2.42 * VOLUME, rel=1e-9)
    for words, said in [
        (
            ["equilibrium", "--volume", "8 ml", "--voltage", "0.1"],
            "--voltage must be given with a unit, as --volume is",
        ),
        (["equilibrium", "--volume", "8 kV"], "--volume must be a number with a unit such as m³, L, ml"),
        (
            ["equilibrium", "--volume", "1 ml", "--radius", "2 cm", "--opening-radius", "3 cm"],
            "--opening-radius must not be",
        ),
        (["equilibrium", "--volume", "1 ml", "--breakdown", "80"], "--breakdown must be given with a unit"),
        (["voltage-volume", "--pressure", "1", "--shapes"], "--shapes must be given with --figure only"),
    ]:
        assert main(words) == 2
        assert said in capsys.readouterr().err


def test_words_are_explained_on_the_command_line(capsys):
    assert main(["explain", "breaks_in_snap"]) == 0
    assert capsys.readouterr().out.startswith("The membrane snaps, and the state that it would land on")
    assert main(["explain", "fold", "breakdown ratio"]) == 0
    assert capsys.readouterr().out.count("\n") == 2
    assert main(["explain"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(dj.model.GLOSSARY)
    assert main(["explain", "retruns"]) == 2
    assert "WORD must be a word of the glossary, but 'retruns' resembles returns" in capsys.readouterr().err
