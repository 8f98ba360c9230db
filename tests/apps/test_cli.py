"""The command line: what it refuses and how, and results compared with numbers from other methods.

The numbers are those of tests/README.md: a spectral-element Galerkin discretisation and shooting agree on them.
"""

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dielectric_jax.apps.cli import main

ROOT = Path(__file__).parents[2]
CHAMBER = ["voltage-volume", "--chamber-volume", "1600", "--initial-volume", "2.42"]
PNG = b"\x89PNG"


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", "off")


@pytest.fixture(scope="module")
def chamber(tmp_path_factory):
    """The README's main command, run once: the document and the figure's bytes."""
    folder = tmp_path_factory.mktemp("chamber")
    assert main([*CHAMBER, "--json", str(folder / "d.json"), "--figure", str(folder / "d.png")]) == 0
    return json.loads((folder / "d.json").read_text()), (folder / "d.png").read_bytes()


def answer(capsys, *argv):
    """The JSON document that a successful run prints."""
    assert main([*argv, "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def refusal(capsys, *argv, status=2):
    """The one sentence that a refused run prints."""
    assert main(list(argv)) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("dielectric-jax: ") and err.endswith(".\n")
    assert err.count("\n") == 1 and "Traceback" not in err and "usage" not in err
    return err.removeprefix("dielectric-jax: ").strip()


BAD = [
    (["equilibrium"], "--pressure, --volume, --apex-stretch", "none is"),
    (["equilibrium", "--volume"], "--volume", "one value"),
    (["equilibrium", "--volume", "-1e-3"], "--volume", "zero or a positive finite number, but is '-1e-3'"),
    (["equilibrium", "--volume", "-inf"], "--volume", "'-inf'"),
    (["equilibrium", "--volume", "nan"], "--volume", "'nan'"),
    (["equilibrium", "--volume", "two"], "--volume", "'two'"),
    (["equilibrium", "--volume", "1", "--pressure", "1"], "--pressure", "together with --volume"),
    (["equilibrium", "--volume", "1", "--points", "9"], "--points", "--figure"),
    (["equilibrium", "--volume", "1", "--voltage", "-0.1"], "--voltage", "'-0.1'"),
    (["equilibrium", "--volume", "1", "--prestretch", "0.9"], "--prestretch", "at least 1, but is '0.9'"),
    (["equilibrium", "--volume", "1", "--stretch-limit", "0"], "--stretch-limit", "positive"),
    (
        ["equilibrium", "--volume", "1", "--material", "rubber"],
        "--material",
        "gent, neo-hookean, arruda-boyce, mooney-rivlin or ogden",
    ),
    (["equilibrium", "--volume", "1", "--material", "neo-hookean", "--stretch-limit", "9"], "--stretch-limit", "gent"),
    (["equilibrium", "--volume", "1", "--chain-links", "9"], "--chain-links", "arruda-boyce"),
    (["equilibrium", "--volume", "1", "--breakdown", "air"], "--breakdown", "vhb or a positive field"),
    (["equilibrium", "--volume", "1", "--tolerance", "0"], "--tolerance", "positive"),
    (["pressure-volume", "--points", "1.5"], "--points", "whole number"),
    (["pressure-volume", "--points", "1"], "--points", "from 2"),
    (["pressure-volume", "--voltage", "0", "0.1", "nan"], "--voltage", "'nan'"),
    (["pressure-volume", "--stretch-window", "2", "1"], "--stretch-window", "A < B"),
    (["pressure-volume", "--load-window", "0.5"], "--load-window", "2 values"),
    (["pressure-volume", "--figure", "figure.doc"], "--figure", "png"),
    (["pressure-volume", "--figure", "/no/folder/figure.png"], "--figure", "folder"),
    (["pressure-volume", "--json", "/no/folder/d.json"], "--json", "folder"),
    (["pressure-volume", "--csv", "/no/folder/d.csv"], "--csv", "folder"),
    (["pressure-volume", "--csv", "-"], "--csv", "name of a file, but is '-'"),
    (["pressure-volume", "--csv", "d.x", "--json", "d.x"], "--csv", "another file than --json, but both name 'd.x'"),
    (["pressure-volume", "--csv", "d.csv", "--voltage", "0", "0.1"], "--csv", "one --voltage, but 2 are"),
    (["pressure-volume", "--all"], "'--all'", "--help"),
    (["pressure-volume", "--volt", "0.1"], "'--volt 0.1'", "--help"),
    (["voltage-volume"], "--pressure, --chamber-volume", "none is"),
    (["voltage-volume", "--chamber-volume", "1600"], "--initial-volume or --initial-pressure", "neither"),
    (["voltage-volume", "--chamber-volume", "-5", "--initial-volume", "1"], "--chamber-volume", "'-5'"),
    (["voltage-volume", "--chamber-volume", "5", "--initial-volume", "-1"], "--initial-volume", "'-1'"),
    ([*CHAMBER, "--initial-pressure", "1"], "--initial-pressure", "together with --initial-volume"),
    ([*CHAMBER, "--pressure", "1"], "--pressure", "together with --chamber-volume"),
    (["voltage-volume", "--pressure", "1", "--initial-volume", "1"], "--initial-volume", "--chamber-volume only"),
    (["voltage-volume", "--pressure", "1", "--polytropic-exponent", "1"], "--polytropic-exponent", "not with"),
    (["voltage-volume", "--volume", "-1"], "--volume", "'-1'"),
    (["voltage-volume", "--volume", "1", "--pressure", "1"], "--pressure", "together with --volume"),
    (["voltage-volume", "--volume", "1", "--initial-volume", "1"], "--initial-volume", "not with --volume"),
    ([*CHAMBER, "--control", "current"], "--control", "voltage or charge"),
    ([*CHAMBER, "--control", "charge", "--engine", "surface"], "--engine", "continuation with --control charge"),
    ([*CHAMBER, "--engine", "magic"], "--engine", "continuation"),
    ([*CHAMBER, "--modes", "1:3", "--engine", "surface"], "--engine", "continuation with --modes"),
    ([*CHAMBER, "--modes", "0:3"], "--modes", "from 1, but begins at 0"),
    ([*CHAMBER, "--modes", "3:1"], "--modes", "a range such as"),
    (["sweep"], "SPEC.toml, --output", "must be given"),
    (["sweep", "s.toml", "--output", "/no/folder/s.zarr"], "--output", "folder that exists"),
    (["sweep", "s.toml", "--output", "s.zarr", "--workers", "0"], "--workers", "from 1 to 10000, but is '0'"),
    (["sweep", "s.toml", "--output", "s.zarr", "--workers", "2", "--scheduler", "a"], "--scheduler", "with --workers"),
    (["sweep", "s.toml", "--output", "s.zarr", "--accept-versions"], "--accept-versions", "--resume"),
    (["sweep", "s.toml", "--output", "s.zarr", "--export", "s.txt"], "--export", ".nc or .csv"),
    (
        ["draw"],
        "COMMAND",
        "voltage-volume, modes, paper, sweep, calibrate, regimes, optimise, follow, explore or explain, but is 'draw'",
    ),
    (["explore", "--pressure", "1", "--initial-volume", "1"], "--initial-volume", "not with --pressure"),
    (["explore", "--initial-volume", "1"], "--initial-volume", "with --chamber-volume only."),
    (["explore", "--port", "0"], "--port", "from 1 to 65535, but is '0'"),
    (["explore", "--figure", "a.png"], "'--figure a.png'", "not known here"),
    (["calibrate"], "DATA.csv", "must be given"),
    (["calibrate", "none.csv"], "DATA.csv", "readable CSV file"),
    (["calibrate", "none.csv", "--level", "2"], "--level", "between 0 and 1"),
    (["calibrate", "none.csv", "--branch", "up"], "--branch", "loading, unloading or all, but is 'up'"),
    (["calibrate", "none.csv", "--columns", "1"], "--columns", "2 values"),
    ([], "COMMAND", "must be given"),
]


@pytest.mark.parametrize(("argv", "option", "allowed"), BAD, ids=[" ".join(b[0]) or "nothing" for b in BAD])
def test_bad_input_is_one_sentence(capsys, argv, option, allowed):
    sentence = refusal(capsys, *argv)
    assert sentence.startswith((option, f"One of {option}"))
    assert allowed in sentence


FROM_THE_LIBRARY = [
    (["sweep", "/no/file.toml", "--output", "s.zarr"], "SPEC.toml", "/no/file.toml"),
    (["equilibrium", "--si", "--volume", "0.03"], "--volume", "0 and 0.00518632 m³"),
    (["equilibrium", "--volume", "500"], "--volume", "500"),
    (["equilibrium", "--volume", "1", "--prestretch", "12"], "--prestretch", "11.6"),
    (["equilibrium", "--apex-stretch", "0.5"], "--apex-stretch", "0.5"),
    (["voltage-volume", "--chamber-volume", "1600", "--initial-volume", "500"], "--initial-volume", "500"),
    (["voltage-volume", "--volume", "500"], "--volume", "500"),
    (["pressure-volume", "--stretch-window", "0.2", "0.5"], "--stretch-window", "0.5"),
    (["pressure-volume", "--load-window", "-3", "9"], "--load-window", "9"),
    (["pressure-volume", "--material", "arruda-boyce", "--chain-links", "0.5"], "--chain-links", "above 1"),
]


@pytest.mark.parametrize(("argv", "option", "said"), FROM_THE_LIBRARY, ids=[" ".join(b[0]) for b in FROM_THE_LIBRARY])
def test_what_the_library_refuses_names_the_option(capsys, argv, option, said):
    sentence = refusal(capsys, *argv)
    assert option in sentence and said in sentence and "`" not in sentence


def test_the_engine_surface_gives_the_same_document(tmp_path):
    documents = {}
    for engine in ("continuation", "surface"):
        assert main([*CHAMBER, "--engine", engine, "--json", str(tmp_path / engine)]) == 0
        documents[engine] = json.loads((tmp_path / engine).read_text(encoding="utf-8"))
        assert documents[engine]["engine"] == engine
    ours, theirs = documents["surface"], documents["continuation"]
    assert ours.keys() == theirs.keys() and ours["complete"] and ours["scene"] == theirs["scene"]
    assert ours["area_strain"] == pytest.approx(theirs["area_strain"], rel=1e-8)
    assert [p["kind"] for p in ours["special_points"]] == [p["kind"] for p in theirs["special_points"]]
    for a, b in zip(ours["special_points"], theirs["special_points"], strict=True):
        assert a["voltage_squared"] == pytest.approx(b["voltage_squared"], rel=1e-8, abs=1e-11)


@pytest.mark.parametrize(
    ("argv", "code"),
    [
        (["equilibrium", "--pressure", "0"], "flat_unstretched"),
        (["equilibrium", "--pressure", "1.5", "--voltage", "3"], "no_equilibrium"),
        (["voltage-volume", "--chamber-volume", "100", "--initial-volume", "0"], "flat_unstretched"),
    ],
)
def test_a_scene_without_answer_says_why(capsys, argv, code):
    assert refusal(capsys, *argv, status=1).startswith(f"{code}: ")


@pytest.mark.parametrize("argv", [["--help"], ["equilibrium", "--help"], ["voltage-volume", "--help"], ["--version"]])
def test_help_and_version_succeed(capsys, argv):
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 0
    assert "dielectric-jax" in capsys.readouterr().out


UNITS = {"ascii": "sqrt(u/epsilon)", "latin-1": "sqrt(u/epsilon)", "cp1252": "sqrt(u/epsilon)", "utf-8": "√(μ/ε)"}


@pytest.mark.parametrize("errors", ["strict", "surrogateescape", "backslashreplace"])
@pytest.mark.parametrize("encoding", [*UNITS, "cp437", "cp850", "cp1251", "gbk"])
def test_streams_that_lack_characters_are_readable(monkeypatch, encoding, errors):
    """With PYTHONIOENCODING, a code page of Windows, or LC_ALL=C, characters that the encoding lacks are spelled out."""
    raw = {name: io.BytesIO() for name in ("stdout", "stderr")}
    for name, buffer in raw.items():
        monkeypatch.setattr(sys, name, io.TextIOWrapper(buffer, encoding=encoding, errors=errors))
    for command in ("equilibrium", "voltage-volume", "sweep", "calibrate", "explore", "paper"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
    assert main(["equilibrium", "--volume", "1", "--breakdown", "ψ\udcff"]) == 2
    said = {}
    for name, buffer in raw.items():
        stream = getattr(sys, name)
        assert stream.errors == errors  # as it was
        stream.flush()
        said[name] = buffer.getvalue().decode(encoding)
    text = said["stdout"] + said["stderr"]
    assert "?" not in text and "\\u" not in text.replace("\\udcff", "")
    assert f"in units of {UNITS.get(encoding, '')}" in said["stderr"] and "dielectric-jax sweep" in said["stdout"]


def test_bad_input_of_the_program_itself():
    command = [sys.executable, "-m", "dielectric_jax.apps.cli", "equilibrium", "--volume", "-1"]
    done = subprocess.run(command, cwd=ROOT, env=dict(os.environ), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "dielectric-jax: --volume must be zero or a positive finite number, but is '-1'.\n"


def test_equilibrium_at_a_volume(capsys):
    document = answer(capsys, "equilibrium", "--volume", "2.42")
    assert document["scene"]["material"] == "gent" and document["scene"]["stretch_limit"] == 270.0
    assert document["units"] == "dimensionless"
    (state,) = document["states"]
    assert state["pressure"] == pytest.approx(1.886612680245, rel=1e-10)
    assert state["apex_stretch"] == pytest.approx(1.95822343926, rel=1e-10)
    assert state["index"] == 0 and state["error_estimate"] <= 1e-9


def test_equilibrium_of_a_chamber(capsys):
    gas = ["--chamber-volume", "1600", "--initial-volume", "2.42", "--voltage", "0.0766"]
    document = answer(capsys, "equilibrium", *gas, "--all")
    assert document["scene"]["chamber_volume"] == 1600.0
    (state,) = document["states"]  # it has snapped
    assert (state["pressure"] + 50) * (state["volume"] + 1600) == pytest.approx(51.886612680245 * 1602.42, rel=1e-10)
    assert main(["equilibrium", *gas[:2]]) == 2
    assert "--initial-volume or --initial-pressure must be given" in capsys.readouterr().err


def test_equilibrium_all_and_smallest(capsys):
    states = answer(capsys, "equilibrium", "--pressure", "1.82", "--all")["states"]
    assert [s["volume"] for s in states] == pytest.approx([2.01878174356, 5.0422739075, 210.518696044], rel=1e-9)
    assert [s["index"] for s in states] == [0, 1, 0]
    assert answer(capsys, "equilibrium", "--pressure", "1.82")["states"] == states[:1]


def test_modes_of_a_state(capsys):
    document = answer(capsys, "modes", "--chamber-volume", "1600", "--initial-volume", "2.42", "--numbers", "0:1")
    assert [m["number"] for m in document["modes"]] == [0, 1] and document["state"]["volume"] == pytest.approx(2.42)
    assert [m["index"] for m in document["modes"]] == [0, 0] and len(document["modes"][0]["eigenvalues"]) == 3
    assert document["modes"][0]["frequency"] is None and document["hoop_tension"] > 0
    si = ["--si", "--density", "1000", "--pressure", "2000"]  # Pa: 1 in μH/A
    (mode,) = answer(capsys, "modes", *si, "--numbers", "1", "--count", "1")["modes"]
    # √(μ/ρ)/(2πA) = 47.45 Hz for μ = 45 kPa, A = 22.5 mm
    assert mode["frequency"] == [pytest.approx(47.4511 * mode["eigenvalues"][0] ** 0.5, rel=1e-5)]
    assert "--numbers" in refusal(capsys, "modes", "--pressure", "1", "--numbers", "3:1")
    assert "--si" in refusal(capsys, "modes", "--pressure", "1", "--density", "1000")


def test_material_options_reach_the_material(capsys):
    (state,) = answer(capsys, "equilibrium", "--volume", "2.796672", "--material", "neo-hookean", "--breakdown", "5.5")[
        "states"
    ]
    # the limit of Gent's material: 1.8791734763 at J = 1e9, and the difference falls like 1/J
    assert state["pressure"] == pytest.approx(1.8791734763 - 7.5364e-9, rel=1e-10)
    scene = answer(
        capsys, "equilibrium", "--volume", "1", "--material", "arruda-boyce", "--chain-links", "60", "--prestretch", "2"
    )["scene"]
    assert (scene["material"], scene["chain_links"], scene["prestretch"]) == ("arruda-boyce", 60.0, 2.0)


def test_pressure_volume_at_several_voltages(capsys):
    documents = answer(capsys, "pressure-volume", "--voltage", "0", "0.1", "--points", "64")["diagrams"]
    assert len(documents) == 2
    folds = sorted(p["pressure"] for p in documents[0]["special_points"] if p["kind"] == "fold")
    assert folds == pytest.approx([1.361703319141, 1.908684829414], rel=1e-10)
    for document, q in zip(documents, (0.0, 0.01), strict=True):
        assert document["ramp"] is None and document["area_strain"] is None
        for branch in document["branches"]:
            assert branch["voltage_squared"] == pytest.approx([q] * len(branch["volume"]), abs=1e-14)


def test_one_voltage_is_one_diagram_and_a_table(capsys, tmp_path):
    document = answer(capsys, "pressure-volume", "--points", "32", "--csv", str(tmp_path / "d.csv"), "--si")
    assert "diagrams" not in document and document["complete"] is True
    head, *lines = (tmp_path / "d.csv").read_text(encoding="utf-8").splitlines()
    assert "pressure [Pa],volume [m³]" in head
    assert [float(line.split(",")[3]) for line in lines] == [p for b in document["branches"] for p in b["pressure"]]


BRANCH_KEYS = (
    "voltage_squared pressure volume apex_stretch height charge breakdown_ratio index error_estimate start end flags"
)
POINT_KEYS = (
    "kind branch voltage_squared voltage pressure volume apex_stretch height charge breakdown_ratio index "
    "error_estimate flags"
)
EVENT_KEYS = "event direction voltage pressure volume apex_stretch breakdown_ratio error_estimate reason"


def test_chamber_document_has_the_contract_s_keys(chamber):
    document, _ = chamber
    expected = (
        "scene units engine window complete tolerance branches special_points ramp area_strain area_strain_reason"
    )
    assert set(document) == set(expected.split())
    assert set(document["window"]) == {"apex_stretch", "load_fraction", "scanned_load_fraction"}
    assert document["engine"] == "continuation" and document["tolerance"] == 1e-9
    assert all(set(b) == set(BRANCH_KEYS.split()) for b in document["branches"])
    assert all(set(p) == set(POINT_KEYS.split()) for p in document["special_points"])
    assert all(set(e) == set(EVENT_KEYS.split()) for e in document["ramp"])
    assert document["scene"]["chamber_volume"] == 1600.0 and document["scene"]["initial_volume"] == 2.42


def test_chamber_of_the_paper(chamber):
    document, _ = chamber
    assert document["complete"] is True
    up = [e for e in document["ramp"] if e["direction"] == "up"]
    assert [e["event"] for e in up] == ["start", "snap", "landing", "breakdown"]
    start, snap, landing, breakdown = up
    assert start["pressure"] == pytest.approx(1.886612680245, rel=1e-9)
    assert snap["voltage"] == pytest.approx(0.0764953595449, rel=1e-9)
    assert landing["volume"] == pytest.approx(19.9533292542, rel=1e-8)
    assert landing["breakdown_ratio"] == pytest.approx(0.568782, rel=1e-5)
    assert breakdown["voltage"] == pytest.approx(0.100970094106, rel=1e-9)
    assert breakdown["apex_stretch"] == pytest.approx(8.10285526922, rel=1e-9)
    assert breakdown["reason"] == document["area_strain_reason"] == "breakdown on the branch"
    assert document["area_strain"] == pytest.approx((8.10285526922 / 1.95822343926) ** 2 - 1, rel=1e-8)
    snapped = [p for p in document["special_points"] if p["kind"] == "zero_voltage"][-1]
    assert snapped["volume"] == pytest.approx(11.7561689651, rel=1e-8)


def test_chamber_figure_is_a_picture(chamber):
    _, figure = chamber
    assert figure.startswith(PNG) and len(figure) > 20_000


def test_curves_and_states_are_drawn(tmp_path):
    figures = [tmp_path / "a.png", tmp_path / "b.svg"]
    assert main(["equilibrium", "--volume", "2.42", "--points", "32", "--figure", str(figures[0])]) == 0
    assert main(["pressure-volume", "--voltage", "0", "0.1", "--points", "32", "--figure", str(figures[1])]) == 0
    assert figures[0].read_bytes().startswith(PNG)
    assert "<svg" in figures[1].read_text()


def test_summary_without_json_or_figure(capsys):
    assert main(["voltage-volume", "--chamber-volume", "1600", "--initial-volume", "2.42", "--points", "64"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert re.search(r"snap +up +0\.0764953595", out)
    assert re.search(r"fold +0 +0\.0764953595", out)
    assert "area strain: 16.12" in out and "breakdown on the branch" in out
    assert main(["equilibrium", "--volume", "2.42"]) == 0
    assert "1.88661268" in capsys.readouterr().out


def test_flat_film_is_an_answer(capsys):
    document = answer(capsys, "voltage-volume", "--pressure", "0", "--prestretch", "2", "--points", "32")
    (branch,) = document["branches"]
    assert branch["volume"] == pytest.approx([0.0] * len(branch["volume"]), abs=1e-12)
    slack = [p for p in document["special_points"] if p["kind"] == "slack"]
    # q_max(λ0) = (λ0⁻² − λ0⁻⁸)/G, with G = 1 − (2λ0² + λ0⁻⁴ − 3)/J
    q_max = (2.0**-2 - 2.0**-8) / (1 - (8 + 2.0**-4 - 3) / 270)
    assert [p["voltage_squared"] for p in slack] == pytest.approx([q_max], rel=1e-12)
