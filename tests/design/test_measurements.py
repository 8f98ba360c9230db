"""Measurements in the formats that instruments and people write: they give the same numbers, or a line and a reason."""

import re

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.design.measurements import runs_of
from dielectric_jax.model import unit_size

# ml and kPa, rounded as a file would have them; below 1, about 1 and above 1000 in pascals
VOLUME = np.round(np.geomspace(3.4, 680.0, 25), 4)
PRESSURE = np.round(5.2 * np.tanh(VOLUME / 20) ** 2 - 0.8 * np.sin(VOLUME / 200) + VOLUME / 500, 4)


def rows(form="{v!r},{p!r}", *, v=1.0, p=1.0, end="\n"):
    """Lines of the curve, with the numbers multiplied."""
    pairs = zip(VOLUME.tolist(), PRESSURE.tolist(), strict=True)
    return (
        end.join(form.format(i=i, v=float(f"{a * v:.10g}"), p=float(f"{b * p:.10g}")) for i, (a, b) in enumerate(pairs))
        + end
    )


def comma(text):
    return text.replace(".", ",")


# every file holds the same curve: text or bytes, by the feature it tests
FILES = {
    "hash head": "# volume (mL), pressure (Bar)\n" + rows("{v:.9e},{p:.9e}", p=0.01),
    "preamble": "# a film\n# Operator, X\nSample;7\nVolume / ml;Pressure / kPa\n" + rows("{v};{p}"),
    "percent head": "% V [ml]\tp [kPa]\n" + rows("{v}\t{p}"),
    "words around": "Volume injected (mL),Film pressure (kPa)\n" + rows(),
    "slash": "p/kPa,V/ml\n" + rows("{p},{v}"),
    "underscores": "time_s,V_mL,pressure_gauge_kPa\n" + rows("{i},{v},{p}"),
    "in words": "Volume in millilitres;Pressure in kilopascals\n" + rows("{v};{p}"),
    "quoted heads": '"Volume, ml","Pressure, kPa"\n' + rows('"{v}","{p}"'),
    "head on two lines": '"Volume\n(ml)","Pressure\n(kPa)"\n' + rows(),
    "unit row": "volume,pressure\nml,kPa\n" + rows(),
    "symbols over a unit row": "V\tp\nml\tkPa\n" + rows("{v}\t{p}"),
    "unit row in brackets": "t;volume;pressure\n[s];[ml];[kPa]\n" + rows("{i};{v};{p}"),
    "two columns of V": "Voltage [V],V [ml],P [kPa],Power [W]\n" + rows("{i},{v},{p},{i}"),
    "other pressures": "p supply [kPa],pressure [kPa],chamber volume [L],volume [ml],volume flow [ml/min]\n"
    + rows("9,{p},7,{v},{i}"),
    "capitals": "VOLUME [ML],PRESSURE [KPA]\n" + rows(),
    "lower case": "volume [ul],pressure [kpa]\n" + rows(v=1000),
    "micro sign": "volume [µL],pressure [Pa]\n" + rows(v=1000, p=1000),
    "mm3": "volume [mm^3],pressure [MPa]\n" + rows(v=1000, p=0.001),
    "superscript": "volume [cm³],pressure [N/m²]\n" + rows(p=1000),
    "cubic words": "volume [cubic centimeters],pressure [mbarg]\n" + rows(p=10),
    "cc mmHg": "volume (cc),pressure (mm Hg)\n" + rows(p=1000 / 133.322387415),
    "l psi": "volume [l],pressure [psi]\n" + rows(v=0.001, p=1000 / 6894.757293168),
    "m3 hPa": "volume {m³};pressure {hPa}\n" + rows("{v};{p}", v=1e-6, p=10).replace("e-0", "E-0"),
    "semicolon, point": "volume [ml];pressure [kPa]\n" + rows("{v};{p}"),
    "semicolon, comma": "volume [ml];pressure [kPa]\n" + comma(rows("{v};{p}")),
    "tab, comma, crlf": ("volume [ml]\tpressure [kPa]\r\n" + comma(rows("{v}\t{p}", end="\r\n"))).encode(),
    "quoted commas": "volume [ml],pressure [kPa]\n" + comma(rows('"{v}"_"{p}"')).replace("_", ","),
    "sep line": "sep=;\nvolume [ml];pressure [kPa]\n" + rows("{v};{p}"),
    "bars": "volume [ml] | pressure [kPa]\n" + rows("{v} | {p}"),
    "blanks": "V [ml]   p [kPa]\n" + rows("   {v:10.4f}   {p:10.4f}"),
    "one blank": "Time [s] Volume [ml] Pressure [kPa]\n" + rows("{i} {v} {p}"),
    "head by commas, numbers by blanks": "# volume (mL), pressure (kPa)\n" + rows("{v} {p}"),
    "thousands": "volume [ml],pressure [Pa]\n" + rows('{v},"{p:,.1f}"', p=1000),
    "thousands, German": "volume [mm³];pressure [Pa]\n"
    + rows("{v:,.1f};{p:,.1f}", v=1000, p=1000).translate(str.maketrans(",.", ".,")),
    "thousands by blanks": "volume [ml];pressure [Pa]\n" + rows("{v};{p:,.1f}", p=1000).replace(",", "\u00a0"),
    "plus, minus, D": "volume [ml],pressure [kPa]\n" + rows("+{v:.8E},{p:.8E}").replace("E", "D"),
    "utf-8 mark": ("\ufeffvolume [µl],pressure [kPa]\n" + rows(v=1000)).encode(),
    "utf-16": ("volume [µl],pressure [kPa]\n" + rows(v=1000)).encode("utf-16"),
    "utf-16 without mark": ("volume [µl],pressure [kPa]\n" + rows(v=1000)).encode("utf-16-le"),
    "latin-1": ("Höhe [mm];Volume [µl];Pressure [kPa]\n" + rows("{i};{v};{p}", v=1000)).encode("latin-1"),
    "German": "Zeit (s);Volumen (cm³);Druck (mbar)\n" + comma(rows("{i};{v};{p}", p=10)),
    "gbk names beside": ("体积 volume [ml],压力 pressure [kPa]\n" + rows()).encode("gbk"),
    "gbk names": ("时间 (s),体积 (ml),压力 (kPa)\n" + rows("{i},{v},{p}")).encode("gbk"),
    "old Macintosh lines": "volume [ml],pressure [kPa]\r" + rows(end="\r"),
    "event rows": "t,pressure [kPa],volume [ml],event\n0,0,0,start\n" + rows("{i},{p},{v},") + "99,,,end\n",
    "blank cells": "volume [ml],pressure [kPa]\n12.5,\n,1.5\nNaN,2\n3,--\n" + rows(),
    "trailing separators": "volume [ml],pressure [kPa],\n" + rows("{v},{p},"),
    "zero first": "volume [ml],pressure [kPa]\n0,0\n0.000,-0.001\n" + rows(),
    "full-width": "体积（ml）,压力（kPa）\n" + rows(),
    "big5": ("體積 (ml),壓力 (kPa)\n" + rows()).encode("big5"),
    "text at the end": "volume [ml],pressure [kPa]\n" + rows() + "\nBurst in line 25, at the rim\nOperator: X\n",
    "beyond the range": "volume [ml],pressure [kPa]\n" + rows() + "800,OL\n",
    "scientific comma": "volume [ml];pressure [kPa]\n" + comma(rows("{v:.9E};{p:.9E}")),
    "instrument": "LabVIEW Measurement\t\nDecimal_Separator\t.\n***End_of_Header***\n\t\nX\tVolume (mL)\tPressure (kPa)\tComment\n"
    + rows("{i}\t{v}\t{p}"),
    "times and an index": ",datetime,volume_ml,pressure_kPa\n" + rows("{i},2024-05-01 10:00:{i:02d},{v},{p}"),
    "markdown": "| volume [ml] | pressure [kPa] |\n|---|---|\n" + rows("| {v} | {p} |"),
    "remarks between": "volume [ml],pressure [kPa]\n# pause\n" + rows() + "# end, 7\n",
}
# the accuracy of files whose numbers were rounded again
ROUNDED = {"thousands": 1e-3, "thousands, German": 1e-3, "thousands by blanks": 1e-3, "micro sign": 1e-12}


@pytest.mark.parametrize("name", FILES)
def test_the_same_curve_in_every_format(tmp_path, name):
    file, text = tmp_path / "curve.csv", FILES[name]
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    volume, pressure, in_si = found = dj.design.read_measurement(file)
    assert in_si
    np.testing.assert_allclose(volume, VOLUME * 1e-6, rtol=ROUNDED.get(name, 1e-8))
    np.testing.assert_allclose(pressure, PRESSURE * 1e3, rtol=ROUNDED.get(name, 1e-8))
    left = " ".join(found.notices)
    assert ("Left out: lines 2 to 5, without" in left) == (name == "blank cells")
    assert ("Left out: lines 2 to 3, where" in left or "Left out: line 2, where" in left) == (
        name in ("event rows", "zero first")
    )
    assert ("text such as" in left) == (name == "text at the end")
    assert ("not UTF-8" in left) == (
        name in ("latin-1", "gbk names", "gbk names beside", "utf-16", "utf-16 without mark", "big5")
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (rows("  {v}  {p}"), "begins with numbers; name them and their units"),
        (rows(), "begins with numbers"),
        ("", "has no numbers"),
        ("volume [ml],pressure [kPa]\n", "has no numbers"),
        ("diameter [mm],pressure [kPa]\n" + rows(), r"line 1 .* names 'diameter \[mm\],pressure \[kPa\]'; name"),
        ("volume,pressure\n" + rows("{v} ml,{p} kPa"), "must name units once, above the numbers, but line 2 .* remove"),
        ("volume [ml],3.4,5.6,7\npressure [kPa],1,2,3\n", "one point in each line, but line 1 .* exchange lines"),
        (
            "volume [ml],pressure [kPa],voltage\n" + rows("{v},{p},3"),
            "units of all columns or of none, .* none of the voltage",
        ),
        ("volume [ml],pressure [kPa]\n" + rows() + "Mean,3.9\n", "line 27 .* has 'Mean' as its volume"),
        ("volume,p\n1,2\n", "columns named volume and pressure"),
        ("V,p\n1,2\n", "columns named volume and pressure"),
        ("volume,pressure\n1,2\n1,x\n", "line 3"),
        ("volume [ml],force [N]\n" + rows(), "line 1 .* names"),
        ("volume [gal],pressure [kPa]\n" + rows(), "'gal'"),
        ("volume,pressure\ngal,kPa\n" + rows(), "'gal'"),
        ("volume, inches cubed,pressure, kPa\n" + rows(), "volume and pressure|units"),
        ("volume [ml],pressure [mpa]\n" + rows(), "may be MPa or mPa"),
        ("volume [ml],pressure\n" + rows(), "units of both columns"),
        ("volume [ml],pressure [kPa abs]\n" + rows(), "absolute ones; give `atmospheric_pressure`"),
        ("volume [ml],pressure (psia)\n" + rows(), "absolute ones"),
        ("volume [ml],pressure 1 [kPa],pressure 2 [kPa]\n" + rows("{v},{p},{p}"), "'pressure 1 .*' and 'pressure 2"),
        ("volume [ml],pressure [kPa]\n" + rows() + "12,x\n", "line 27 .* has 'x' as its pressure"),
        ("volume [ml],pressure [kPa]\n" + rows() + "volume [ml],pressure [kPa]\n", "line 27"),
        ("volume [ml],pressure [kPa]\n" + rows() + "7,inf\n", "line 27 .* 'inf'"),
        ("volume [ml],pressure [kPa]\n" + rows() + "7,1e400\n", "line 27"),
        ("volume [ml],pressure [kPa]\n3,4\n-50,2\n" + rows(), "line 3 .* has -5e-05"),
        ("volume [ml],pressure [kPa]\n3,4\n50,-8\n" + rows(), "line 3 .* has -8000"),
        ("volume [ml],pressure [Pa]\n1.5,1,095.8\n" + rows(), "line 2 .* has 3 cells under 2 headings"),
        ("volume [ml],pressure [kPa]\n" + comma(rows("{v}_{p}")).replace("_", ","), "line 2 .* 4 cells"),
        ("volume [ml];pressure [kPa]\n3.25;1\n3,5;2\n", "line 2 .* decimal point and line 3 a decimal comma"),
        ("volume [ml];pressure [kPa]\n3,250;1,125\n3,500;2,250\n", "the comma in line 2"),
        ("volume [ml];pressure [kPa]\n3,2,5;1,5\n", "line 2"),
        ("volume [ml],pressure [kPa]\n0,0\n", "volumes above zero|no line"),
        (b"PK\x03\x04\x00\x00", "spreadsheet"),
        (b"\x00\x01\x02\x00\x05\x00\x00\x00\xff", "not text|no numbers"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line(tmp_path, text, message):
    file = tmp_path / "curve.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message) as caught:
        dj.design.read_measurement(file)
    assert str(caught.value).startswith("`data` must") and str(caught.value).endswith(".")


def test_numbers_without_units_are_dimensionless(tmp_path):
    file = tmp_path / "curve.csv"
    for head in ("pressure,volume", "Pressure p A / (μH),Volume V / A³", "pressure [-],volume [-]"):
        file.write_text(f"{head}\n" + rows("{p},{v}"), encoding="utf-8")
        volume, pressure, in_si = dj.design.read_measurement(file)
        assert not in_si and (volume == VOLUME).all() and (pressure == PRESSURE).all()
    with pytest.raises(ValueError, match="readable CSV file"):
        dj.design.read_measurement(tmp_path / "none.csv")


def test_columns_and_units_may_be_given(tmp_path):
    file = tmp_path / "curve.txt"
    file.write_text(rows("{i} {p} {v}"))
    volume, pressure, in_si = dj.design.read_measurement(file, columns=(3, 2), column_units=("ml", "kPa"))
    assert in_si
    np.testing.assert_allclose(volume, VOLUME * 1e-6)
    np.testing.assert_allclose(pressure, PRESSURE * 1e3)
    assert not dj.design.read_measurement(file, columns=("3", "2")).in_si
    file.write_text("pressure 1 [kPa],pressure 2 [kPa],volume [ml]\n" + rows("7,{p},{v}"))
    # the unit of a chosen column counts, whatever its heading calls it
    file.write_text("Syringe (ml),Gauge 2 [kPa]\n" + rows("{v},{p}"))
    for columns in (("1", "2"), ("Syringe (ml)", "Gauge 2 [kPa]")):
        np.testing.assert_array_equal(dj.design.read_measurement(file, columns=columns).pressure, pressure)
    with pytest.raises(ValueError, match=r"must give the height in a unit such as m, cm, mm, µm, but .* says 'ml'"):
        dj.design.read_measurement(file, columns={"height": 1, "pressure": 2})
    file.write_text("pressure 1 [kPa],pressure 2 [kPa],volume [ml]\n" + rows("7,{p},{v}"))
    found = dj.design.read_measurement(file, columns=("volume [ml]", "pressure 2 [kPa]"))
    np.testing.assert_allclose(found.pressure, PRESSURE * 1e3)
    for columns, units, message in (
        ((1, 4), None, "`columns` must be positions from 1 to 3"),
        (("volume", "pressure"), None, "`columns` must be headings"),
        ((3, 1), ("gal", "kPa"), "'gal'"),
        ((3,), None, "`columns` must be two"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            dj.design.read_measurement(file, columns=columns, column_units=units)


def test_heights_and_voltages_are_read(tmp_path):
    """Heights where there is no volume; voltages beside either, without a sign; other voltages are no quantity of the film."""
    file = tmp_path / "curve.csv"
    file.write_text("Pole height (mm);pressure [kPa];U [kV];Sensor voltage [V]\n0;0;0;0\n" + rows("{v};{p};-3;1.2"))
    found = dj.design.read_measurement(file)
    assert found.volume is None and found.in_si
    np.testing.assert_allclose(np.asarray(found.height), VOLUME * 1e-3)
    np.testing.assert_allclose(np.asarray(found.voltage), 3000.0)
    assert found.notices[0].endswith("where the height is zero or less.") and "of voltages, 3000 V." in found.notices[1]
    file.write_text("height [mm],volume [ml],p [kPa],V [kV]\n" + rows("1,{v},{p},{i}"))
    found = dj.design.read_measurement(file)
    assert found.height is None
    np.testing.assert_allclose(np.asarray(found.volume), VOLUME * 1e-6)
    np.testing.assert_allclose(np.asarray(found.voltage), 1000.0 * np.arange(25))
    found = dj.design.read_measurement(file, columns={"pressure": "p [kPa]", "height": "height [mm]"})
    assert found.volume is None and found.voltage is None
    np.testing.assert_allclose(found.pressure, PRESSURE * 1e3)
    with pytest.raises(ValueError, match="`columns` must be two, of volume and pressure, or name their quantities"):
        dj.design.read_measurement(file, columns={"pressure": 3})


def test_absolute_pressures_are_made_gauge(tmp_path):
    file = tmp_path / "curve.csv"
    file.write_text(
        "volume [ml],absolute pressure [kPa]\n"
        + "".join(f"{v},{p + 101.325}\n" for v, p in zip(VOLUME, PRESSURE, strict=True))
    )
    found = dj.design.read_measurement(file, atmospheric_pressure=101325.0)
    np.testing.assert_allclose(found.pressure, PRESSURE * 1e3, atol=1e-6)


def test_loading_and_unloading_are_told_apart(tmp_path):
    file = tmp_path / "curve.csv"
    back = "".join(f"{v!r},{0.8 * p!r}\n" for v, p in zip(VOLUME.tolist()[::-1], PRESSURE.tolist()[::-1], strict=True))
    file.write_text("volume [ml],pressure [kPa]\n" + rows() + back)
    for branch, pressure in ((None, PRESSURE), ("loading", PRESSURE), ("unloading", 0.8 * PRESSURE[::-1])):
        found = dj.design.read_measurement(file, branch=branch)
        np.testing.assert_allclose(found.pressure, pressure * 1e3)
        assert "turns at line 27" in found.notices[0]
    assert len(dj.design.read_measurement(file, branch="all").volume) == 50
    with pytest.raises(ValueError, match="`branch` must be one of loading, unloading, all"):
        dj.design.read_measurement(file, branch="up")
    file.write_text("volume [ml],pressure [kPa]\n" + back)
    assert not dj.design.read_measurement(file).notices
    with pytest.raises(ValueError, match="the volume never rises"):
        dj.design.read_measurement(file, branch="loading")


def test_turns_are_no_noise():
    """Cycles of a volume with noise: the runs are its halves; unordered points form one run; a jump back is no unloading."""
    assert [rises for *_, rises in runs_of(np.tile(np.arange(1.0, 9.0), 3))] == [True] * 3
    random = np.random.default_rng(0)
    volume = 1 + 50 * (1 - np.cos(np.linspace(0, 6 * np.pi, 600))) + random.normal(size=600)
    found = runs_of(volume)
    assert [rises for *_, rises in found] == [True, False] * 3
    np.testing.assert_allclose([first for first, *_ in found], np.arange(6) * 100, atol=12)
    assert len(runs_of(random.permutation(volume))) == 1


def test_units_by_hand():
    known = {"volume": {"dl": 1e-4, "µl": 1e-9, "mm3": 1e-9, "in^3": 1.6387064e-5}}
    known["pressure"] = {
        "inH2O": 249.08891,
        "Torr": 133.32236842,
        "kN/m²": 1e3,
        "hPa(g)": 100.0,
        "µbar": 0.1,
        "atm": 101325.0,
    }
    for quantity, sizes in known.items():
        for unit, size in sizes.items():
            assert unit_size(unit, quantity) == pytest.approx(size, rel=1e-8)
    assert unit_size("kPa", "volume") is None and unit_size("", "pressure") is None
