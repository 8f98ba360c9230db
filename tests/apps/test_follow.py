"""The command `follow` against `dj.follow`, the reference numbers of tests/data/rates.json, and what it refuses."""

import json
import pathlib

import pytest

import dielectric_jax as dj
from dielectric_jax.apps.cli import main
from dielectric_jax.apps.follow_files import read_follow_file
from dielectric_jax.rates import requests

ROOT = pathlib.Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "follow_ramp.toml"
TEXT = EXAMPLE.read_text(encoding="utf-8")
REFERENCE = json.loads((ROOT / "tests" / "data" / "rates.json").read_text(encoding="utf-8"))["items"]


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("DIELECTRIC_JAX_CACHE", "off")


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The example, run once: the document, and the bytes of the figure."""
    folder = tmp_path_factory.mktemp("follow")
    assert main(["follow", str(EXAMPLE), "--json", str(folder / "f.json"), "--figure", str(folder / "f.png")]) == 0
    text = (folder / "f.json").read_text(encoding="utf-8")
    document = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    return document, (folder / "f.png").read_bytes()


def changed(tmp_path, *changes: tuple[str, str]) -> str:
    """The example with pieces of its text replaced, in a file."""
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "spec.toml").write_text(text, encoding="utf-8")
    return str(tmp_path / "spec.toml")


def test_the_document_of_the_contract(answered):
    document, figure = answered
    assert set(document) == {"scene", "units", "protocol", "snap", "events", "path"}
    assert document["units"] == "dimensionless" and document["scene"]["material"] == "viscoelastic"
    ramp = {"protocol": "ramp", "rate": 0.01, "start": 0.0, "stop": None}
    assert document["protocol"] == {"voltage": ramp, "start": "relaxed", "until": None, "tolerance": 1e-6}
    keys = "event time voltage pressure volume apex_stretch breakdown_ratio error_estimate reason"
    assert all(set(keys.split()) <= set(event) for event in document["events"])
    assert [e["event"] for e in document["events"]] == ["start", "instantaneous_fold", "landing", "breakdown", "end"]
    assert len({len(column) for column in document["path"].values()}) == 1
    assert figure.startswith(b"\x89PNG")


def test_the_numbers_are_those_of_the_reference(answered):
    """The jump and its landing, and errors that are at least a tenth of the true ones."""
    document, _ = answered
    (known,) = (
        item["result"]
        for item in REFERENCE
        if item["kind"] == "ramp"
        and item["scene"].get("chamber_volume") == 1600.0
        and item["scene"]["material"] == "M2"
        and item["scene"]["rate"] == 0.01
    )
    snap = document["snap"]
    assert snap["kind"] == "jump"
    for event, reference in ((snap["at"], known["fold"]), (snap["landing"], known["landing_frozen"])):
        assert 0 < event["error_estimate"] < 1e-5
        for name in ("voltage", "volume"):
            if name in reference:
                value = reference[name]["value"]
                assert abs(event[name] / value - 1) <= 10 * event["error_estimate"] + 10 ** -reference[name]["digits"]


def test_both_doors_give_the_same_run(answered):
    rubber = dj.Viscoelastic(dj.Gent(110.0), [dj.Maxwell(dj.Gent(55.0), 42 / 18, 1.0)])
    scene = dj.Scene(dj.Membrane(rubber), dj.Chamber(volume=1600.0, initial_volume=2.42))
    document, run = answered[0], dj.follow(scene, voltage=dj.Ramp(rate=0.01))
    mine = run.to_json(check=False)
    assert {n: mine[n] for n in ("scene", "protocol", "path")} == {
        n: document[n] for n in ("scene", "protocol", "path")
    }
    in_volts = run.to_json(dj.Units(), check=False)
    assert in_volts["unit_names"]["voltage"] == "V"
    # H√(μ/ε) = 32884 V
    assert in_volts["protocol"]["voltage"]["rate"] == pytest.approx(0.01 * dj.Units().to_si(1.0, "voltage"), rel=1e-14)
    assert in_volts["snap"]["at"]["voltage"] == pytest.approx(32884.22182 * run.snap.at.voltage, rel=1e-9)


def test_the_table_and_several_rates(capsys, monkeypatch, tmp_path):
    """In kV and ml, and JSON in SI, where the file has [units]; the kind of the snap is in the sentence. A run at a time compiles nothing new."""
    monkeypatch.setattr(requests, "RUNS_TOGETHER", 1)
    spec = changed(
        tmp_path,
        # 0.001 and 0.01 of H√(μ/ε) = 32884.22 V
        ("rate = 0.01 #", "rate = [32.88422182, 328.8422182] #"),
        (CHAMBER, 'chamber_volume = "18.225 l"\ninitial_volume = "27.5653125 ml"'),
        ("tolerance = 1e-6", "check = false"),
        ("[[scene", "[units]\nthickness = 1e-3\n[[scene"),
    )
    assert main(["follow", spec]) == 0
    slow, fast = capsys.readouterr().out.split("\n\nscene: ")
    assert "(creep_through)" in slow and "fastest" in slow and "voltage [kV]" in slow
    # 0.2026215665 of 32.88422182 kV, and 5.453573 of 11.390625 ml
    assert "jumps at t = 20.2622, Φ = 6.66305 kV, V = 62.1196 ml" in fast and "(jump)" in fast
    assert "voltage: ramp, rate 0.3288422182" in fast
    assert main(["follow", spec, "--json", "-"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [run["snap"]["kind"] for run in runs] == ["creep_through", "jump"]
    assert runs[1]["units"] == "SI" and runs[1]["events"][0]["error_estimate"] is None
    assert runs[1]["unit_names"]["volume"] == "m³" and runs[1]["protocol"]["voltage"]["rate"] == pytest.approx(328.8422)
    at = runs[1]["snap"]["at"]
    assert (at["voltage"], at["volume"]) == pytest.approx((6663.05, 62.1196e-6), rel=1e-5)


RATE = "rate = 0.01 # a list such as [0.001, 0.01, 0.1]: several runs, side by side"
VOLTAGE = (
    f'[voltage] # or [volume] or [pressure], then without a chamber or pressure in [scene]\nprotocol = "ramp"\n{RATE}'
)
CHAMBER = "chamber_volume = 1600.0\ninitial_volume = 2.42\natmospheric_pressure = 50.0"


def test_protocols_of_files(tmp_path):
    loop = '[volume]\nprotocol = "triangle"\nstart = 0.5\nturn = 8.0\nstop = 4.0\nrate = [0.1, 0.3]\n[voltage]\nprotocol = "hold"\nvalue = 0.05'
    asked = read_follow_file(changed(tmp_path, (VOLTAGE, loop), (CHAMBER, "prestretch = 1.2")))
    assert isinstance(asked.scene, dj.Membrane) and float(asked.scene.prestretch) == 1.2
    assert [p.to_json() for p in asked.protocols["volume"]] == [
        dj.Triangle(0.5, 8.0, 4.0, rate=rate).to_json() for rate in (0.1, 0.3)
    ]
    assert [p.to_json() for p in asked.protocols["voltage"]] == [dj.Hold(0.05).to_json()] * 2
    assert asked.labels == ["rate 0.1", "rate 0.3"] and asked.check
    steps = '[voltage]\nprotocol = "steps"\nsteps = [[0.1, 5.0], [0, 20]]'
    asked = read_follow_file(changed(tmp_path, (VOLTAGE, steps), ("# until = 100.0", "until = 100.0")))
    assert asked.protocols["voltage"][0].to_json() == dj.Steps([(0.1, 5.0), (0.0, 20.0)]).to_json()
    assert asked.options == {"start": "relaxed", "duration": 100.0, "tolerance": 1e-6}


BAD = [
    ((VOLTAGE, ""), "voltage, volume or pressure must be given", "none is"),
    (
        ("[voltage]", "[voltag]"),
        "voltag must be one of scene, units, voltage, volume, pressure, follow",
        "none of them",
    ),
    (('protocol = "ramp"\n', ""), "protocol must be given in [voltage]", "ramp, hold, steps, triangle"),
    (('"ramp"', '"saw"'), "protocol in [voltage] must be one of ramp, hold, steps, triangle", "'saw'"),
    ((RATE, "ratee = 0.01"), "ratee in [voltage] must be one of rate, start, stop", "none of them"),
    ((RATE, ""), "rate must be given for the protocol ramp in [voltage]", "is not"),
    ((RATE, "rate = 0.0"), "rate must not be zero", "0.0"),
    ((RATE, "rate = []"), "rate in [voltage] must be a number or a list of numbers", "empty"),
    ((RATE, "rate = [0.1, 'x']"), "rate in [voltage] must be a number", "'x'"),
    ((RATE, "rate = 0.01\nstop = -1.0"), "stop must lie ahead of the start", "-1.0"),
    ((VOLTAGE, '[voltage]\nprotocol = "steps"\nsteps = [0.1]'), "steps in [voltage] must be pairs", "[0.1]"),
    (("[voltage]", "[volume]"), "chamber_volume in [scene] must be left out where [volume] is given", "its place"),
    (("tolerance = 1e-6", "tolerance = 1.0"), "tolerance must", "1.0"),
    (("# until = 100.0", "until = -1"), "until in [follow] must be positive", "-1.0"),
    (('start = "relaxed"', 'start = "wet"'), "start in [follow] must be one of relaxed, fresh", "'wet'"),
    (
        ("tolerance = 1e-6", "tolerence = 1e-6"),
        "tolerence in [follow] must be one of start, until, tolerance, check",
        "",
    ),
    (("tolerance = 1e-6", "check = 1"), "check in [follow] must be true or false", "is 1"),
    (("relaxation_time = 1.0 ", "relaxation_time = 0.0 "), "relaxation_time must be positive and finite", "0.0"),
]


@pytest.mark.parametrize(("change", "allowed", "value"), BAD, ids=[b[1].split(" must")[0] + b[2] for b in BAD])
def test_bad_files_are_one_sentence(capsys, tmp_path, change, allowed, value):
    assert main(["follow", changed(tmp_path, change)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("dielectric-jax: ") and err.count("\n") == 1
    said = err.replace("`", "")
    assert allowed in said and value in said


def test_a_scene_without_a_start(capsys, tmp_path):
    assert main(["follow", changed(tmp_path, ("initial_volume = 2.42", "initial_volume = 0.0"))]) == 1
    assert capsys.readouterr().err.startswith("dielectric-jax: flat_unstretched: ")


HELD = """[scene]
material = "viscoelastic"
[[scene.branches]]
material = "gent"
modulus_ratio = 1.0
relaxation_time = 1.0
[volume]
protocol = "hold"
value = [2.0, 1e9]
[follow]
check = false
"""


def test_a_run_without_a_start_leaves_the_others_alone(capsys, tmp_path):
    (tmp_path / "held.toml").write_text(HELD, encoding="utf-8")
    assert main(["follow", str(tmp_path / "held.toml"), "--json", "-", "--figure", str(tmp_path / "f.png")]) == 0
    held, refused = json.loads(capsys.readouterr().out)["runs"]
    assert held["events"][-1]["volume"] == pytest.approx(2.0) and list(refused) == ["error"]
    assert refused["error"].startswith("`volume` must lie between")
    (tmp_path / "held.toml").write_text(HELD.replace("2.0, ", ""), encoding="utf-8")
    assert main(["follow", str(tmp_path / "held.toml")]) != 0
    assert capsys.readouterr().err.startswith("dielectric-jax: `volume` must lie between")
