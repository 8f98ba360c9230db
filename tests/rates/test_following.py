"""Membranes in time against reference numbers of other methods, exact limits, and closed forms."""

import json
import math
import pathlib

import numpy as np
import pytest
from PIL import Image
from scipy.interpolate import make_interp_spline

import dielectric_jax as dj
from dielectric_jax import rates
from dielectric_jax.model import Maxwell, Viscoelastic

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "rates.json").read_text(encoding="utf-8"))
FILMS = {
    "M1": Viscoelastic(dj.Gent(270.0), [Maxwell(dj.Gent(270.0), 1.0, 1.0)]),
    "M2": Viscoelastic(dj.Gent(110.0), [Maxwell(dj.Gent(55.0), 42 / 18, 1.0)]),
    "M3": Viscoelastic(dj.Gent(270.0), [Maxwell(dj.Gent(270.0), 0.6, 0.1), Maxwell(dj.Gent(270.0), 0.4, 10.0)]),
    "M4": Viscoelastic(dj.Gent(270.0), [Maxwell(dj.Gent(270.0), 0.1, 1.0)]),
    "M5": Viscoelastic(dj.Gent(200.0), [Maxwell(dj.Gent(120.0), 0.5, 1.0)]),
}


def scene_of(given: dict) -> dj.Scene | dj.Membrane:
    membrane = dj.Membrane(FILMS[given["material"]])
    if given.get("chamber_volume"):
        return dj.Scene(membrane, dj.Chamber(volume=given["chamber_volume"], initial_volume=given["initial_volume"]))
    return dj.Scene(membrane, dj.ConstantPressure(given["pressure"])) if given.get("pressure") else membrane


def items(kind: str) -> list[dict]:
    return [item for item in REFERENCE["items"] if item["kind"] == kind]


def check(found: float, known: dict) -> None:
    """A number to the digits of its reference less one, 3e-7 at best."""
    assert found == pytest.approx(known["value"], rel=max(10 ** (1 - known["digits"]), 3e-7))


def check_event(event, known: dict) -> None:
    for name in ("voltage", "volume", "pressure", "apex_stretch"):
        if name in known:
            check(getattr(event, name), known[name])


@pytest.fixture(scope="module")
def ramps():
    """All ramps of the reference, followed side by side."""
    given = items("ramp")
    protocols = [rates.Ramp(rate=item["scene"]["rate"]) for item in given]
    return list(
        zip(given, rates.follow([scene_of(i["scene"]) for i in given], voltage=protocols, tolerance=1e-8), strict=True)
    )


def test_ramps(ramps):
    """Instantaneous folds and landings at frozen dashpots, or the fastest point of a creep-through."""
    for item, run in ramps:
        known = item["result"]
        if "fold" in known:
            assert run.snap.kind == "jump"
            check_event(run.snap.at, known["fold"])
        else:
            assert run.snap.kind == "creep_through"
            check_event(run.snap.at, {k: known["fastest"][k] for k in ("voltage", "volume")})
        if "landing_frozen" in known:
            check_event(run.snap.landing, known["landing_frozen"])


def test_dense_output(ramps):
    """Between the steps, the voltage at which the volume passes round numbers."""
    for item, run in ramps:
        curve = run.dense(64)
        leg = slice(0, int(np.flatnonzero(np.isnan(curve.volume))[0]))  # up to the first jump
        for volume, known in item["result"].get("marks", {}).items():
            found = np.interp(float(volume), curve.volume[leg], curve.voltage[leg])
            assert found == pytest.approx(known["value"], rel=3e-5)


def test_pictures(ramps):
    """A line a run, a dotted one a jump, and two for the bounds; three panels over the time."""
    item, run = next((i, r) for i, r in ramps if i["scene"] == {"material": "M1", "pressure": 1.82, "rate": 0.01})
    bounds = rates.bounds(scene_of(item["scene"]))
    ax = dj.plot.plot_runs([run], bounds=bounds, labels=["0.01"])
    assert [line.get_linestyle() for line in ax.lines] == ["-", "-", ":", "-"]
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["at rest", "dashpots frozen", "0.01"]
    assert len(dj.plot.plot_courses(run).axes) == 3
    figure = dj.plot.plot_follow([run], bounds=bounds, units=dj.Units())
    assert figure.axes[0].get_xlabel() == "Volume $V$ / ml" and len(figure.axes) == 4


def test_the_picture_of_snaps_over_the_rate(ramps):
    """A full circle a jump, an open one a creep-through, at the voltage of the snap, between the lines of the bounds."""
    own = [(i, r) for i, r in ramps if i["scene"]["material"] == "M1" and i["scene"].get("pressure") == 1.82]
    assert len(own) > 2
    bounds = rates.bounds(scene_of(own[0][0]["scene"]))
    ax = dj.plot.plot_snap_voltages([r for _, r in own], bounds=bounds, units=dj.Units(), time_unit="s")
    kilovolts = dj.Units().read(1.0, "voltage")
    shown = {float(x): float(y) for line in ax.lines[:-2] for x, y in zip(*line.get_data(), strict=True)}
    for item, _ in own:
        known = item["result"].get("fold") or item["result"]["fastest"]
        assert shown[dj.Units().to_si(item["scene"]["rate"], "voltage")] == pytest.approx(
            kilovolts * known["voltage"]["value"], rel=1e-5
        )
    levels = [float(line.get_ydata()[0]) / kilovolts for line in ax.lines[-2:]]
    assert levels == pytest.approx([0.114568361, 0.281641022], rel=1e-7)
    assert levels[0] < min(shown.values()) / kilovolts and max(shown.values()) / kilovolts < levels[1]
    with pytest.raises(ValueError, match="`runs` must be ramps of the voltage"):
        dj.plot.plot_snap_voltages([bounds[1]])


def test_profiles(ramps):
    """R s1 sin θ = p r²/2 with the stresses of the branches, and the volume, height and E/E_EB of the steps; between two steps nearly."""
    for _, run in ramps[:3]:
        for step in (0, len(run.dataset.step) // 2, len(run.dataset.step) - 1):
            shape, known = run.profile(step), run.dataset.isel(step=step)
            assert np.abs(shape.first_integral_defect()).max() < 1e-6
            swept = np.pi * shape.r**2 * np.sin(shape.theta) * shape.stretch_1  # π r² dz/dR
            volume = make_interp_spline(shape.radius, swept, k=5)
            assert float(volume.integrate(0.0, 1.0)) == pytest.approx(float(known.volume), rel=1e-6)
            assert shape.z[-1] == pytest.approx(float(known.height), rel=1e-12)
            assert np.max(shape.breakdown_ratio) == pytest.approx(float(known.breakdown_ratio), abs=1e-4)
        assert np.abs(run.profile(2.5).first_integral_defect()).max() < 1e-4
    legs = np.flatnonzero(np.diff(run.dataset.leg.values))
    for step in (-1, len(run.dataset.step), *(float(k) + 0.5 for k in legs[:1])):
        with pytest.raises(ValueError, match="`step` must be from 0 to"):
            run.profile(step)


def test_the_film_of_a_run(ramps, tmp_path):
    """As many pictures as frames and jumps ask for; a wrong ending is refused."""
    run = next(r for i, r in ramps if i["scene"] == {"material": "M1", "pressure": 1.82, "rate": 0.01})
    path = dj.plot.animate_run(run, tmp_path / "run.gif", frames=3, seconds=1.0, time_unit="s")
    with Image.open(path) as film:
        assert 3 <= film.n_frames <= 3 + 2 * sum(e.kind == "landing" for e in run.events)
    with pytest.raises(ValueError, match=r"`path` must end in \.gif or \.mp4"):
        dj.plot.animate_run(run, tmp_path / "run.png")


def test_energy_is_balanced(ramps):
    """ΔU = ∫ p dV − ∫ Q dΦ − ∫ D dt, by the quadrature of the stages."""
    assert max(run.energy_defect for _, run in ramps) < 1e-6


def test_held_voltages():
    """The delay of the snap, and the volume at once after the voltage is applied."""
    given = items("hold")
    held = [rates.Hold(item["scene"]["voltage"]) for item in given]
    for item, run in zip(
        given, rates.follow([scene_of(i["scene"]) for i in given], voltage=held, tolerance=1e-8), strict=True
    ):
        check(run.snap.at.time, item["result"]["delay"])
        check(run.snap.at.volume, item["result"]["fold_volume"])
        leap = run.dataset.where(run.dataset.phase == "leap", drop=True)
        check(float(leap.volume[-1]), item["result"]["V_after_step"])


def test_loops():
    """Pressure against a volume that rises and falls, at several rates."""
    given = [item for item in items("loop") if item["scene"]["material"] != "M3"]
    loops = [rates.Triangle(0.5, 8.0, 4.0, rate=item["scene"]["rate"]) for item in given]
    for item, run in zip(
        given, rates.follow([scene_of(i["scene"]) for i in given], volume=loops, tolerance=1e-9), strict=True
    ):
        known, data = item["result"], run.dataset
        check(run.event("peak_pressure").pressure, known["peak_pressure"])
        check(float(data.pressure[int(np.argmax(data.volume.values))]), known["pressure_at_turn"])
        check(run.events[-1].pressure, known["pressure_at_end"])
        assert run.reason == "end of the protocol"


@pytest.mark.parametrize("item", items("limits")[:2], ids=lambda i: str(i["scene"]))
def test_bounds(item):
    """The fold at rest, and that at frozen dashpots."""
    slow, fast = rates.bounds(scene_of(item["scene"]))
    assert slow.ramp()["snap"][0].state.voltage == pytest.approx(
        item["result"]["equilibrium_fold"]["phi"]["value"], rel=1e-9
    )
    check_event(fast.event("instantaneous_fold"), item["result"]["instantaneous_fold"])


def test_a_fresh_film_is_a_stiffer_one():
    """With equal limits a film whose dashpots have not moved is the elastic one with p and q multiplied by 1 + Σ g."""
    membrane = dj.Membrane(FILMS["M1"])
    _, fast = rates.bounds(dj.Scene(membrane, dj.ConstantPressure(2 * 1.82)), start="fresh")
    elastic = next(i for i in items("limits") if i["scene"] == {"material": "M1", "pressure": 1.82})
    known = elastic["result"]["equilibrium_fold"]["phi"]["value"]
    assert fast.event("instantaneous_fold").voltage == pytest.approx(np.sqrt(2) * known, rel=1e-10)


def test_an_elastic_film_knows_no_rate():
    """Without branches the ramp is that of the diagram, at any rate."""
    elastic = dj.Scene(dj.Membrane(dj.Gent(270.0)), dj.Chamber(volume=1600.0, initial_volume=2.42))
    run = rates.follow(elastic, voltage=rates.Ramp(rate=0.3), tolerance=1e-8)
    ramp = dj.voltage_volume(elastic).ramp()
    assert [e.kind for e in run.events] == ["start", "instantaneous_fold", "landing", "breakdown", "end"]
    for kind, mine in (("snap", "instantaneous_fold"), ("landing", "landing")):
        state = ramp[kind][0].state
        assert run.event(mine).voltage == pytest.approx(state.voltage, rel=1e-10)
        assert run.event(mine).volume == pytest.approx(state.volume, rel=1e-9)


@pytest.mark.parametrize("volume", [475.0, 1600.0])
def test_the_way_back_of_an_elastic_film(volume):
    """Under a voltage that rises and falls the film snaps back, or stays, as the diagram says: both ways of asking."""
    elastic = dj.Scene(dj.Membrane(dj.Gent(270.0)), dj.Chamber(volume=volume, initial_volume=2.42))
    start, *down = (e for e in dj.voltage_volume(elastic).events if e.direction == "down")
    turn = rates.Triangle(0.0, start.state.voltage, 0.0, rate=1.0)
    run = rates.follow(elastic, voltage=turn, tolerance=1e-8)
    # the way up has a fold and a landing too
    mine = [e for e in run.events if e.kind in ("instantaneous_fold", "landing", "end")][2:]
    assert [e.kind for e in mine] == [{"snap_back": "instantaneous_fold"}.get(e.event.name, e.event.name) for e in down]
    assert (len(mine) == 3) == (volume == 475.0)
    for own, known in zip(mine, (e.state for e in down), strict=True):
        assert own.voltage == pytest.approx(known.voltage, rel=1e-9, abs=1e-9)
        assert own.volume == pytest.approx(known.volume, rel=1e-7)


def test_a_pressure_that_rises():
    """An elastic film jumps at the peak of its pressure."""
    film = dj.Membrane(dj.Gent(270.0))
    run = rates.follow(film, pressure=rates.Ramp(rate=0.1, start=0.5), tolerance=1e-8)
    assert run.snap.at.pressure == pytest.approx(1.908684829414, rel=1e-11)
    beyond = dj.equilibrium(film, pressure=run.snap.at.pressure * (1 + 1e-12), all=True)[-1]
    assert run.snap.landing.volume == pytest.approx(beyond.volume, rel=1e-6)


def test_alone_and_side_by_side(ramps):
    """A scene that is followed alone does what it does beside others."""
    item, beside = next((i, r) for i, r in ramps if i["scene"] == {"material": "M4", "pressure": 1.82, "rate": 0.1})
    alone = rates.follow(scene_of(item["scene"]), voltage=rates.Ramp(rate=0.1), tolerance=1e-8)
    assert [e.kind for e in alone.events] == [e.kind for e in beside.events]
    assert alone.snap.at.voltage == pytest.approx(beside.snap.at.voltage, rel=1e-12)
    assert alone.snap.landing.volume == pytest.approx(beside.snap.landing.volume, rel=1e-9)


def test_a_flat_film_goes_slack():
    """A fresh film, flat and prestretched, relaxes by a quadrature until its tension is that of the voltage."""
    strong = dj.Membrane(FILMS["M1"], 2.0, dj.ConstantBreakdown(100.0))
    flat = dj.Scene(strong, dj.ConstantPressure(0.0))
    run = rates.follow(flat, voltage=rates.Hold(0.58187184221641), start="fresh", tolerance=1e-9)
    assert run.reason == "hoop tension lost"
    assert run.events[-1].time == pytest.approx(1.062755884237999, rel=1e-8)


def test_error_estimates():
    """The estimate is from another mesh and tolerance; the true error of the fold is within ten times of it."""
    item = next(i for i in items("ramp") if i["scene"] == {"material": "M1", "pressure": 1.82, "rate": 0.01})
    run = rates.follow(scene_of(item["scene"]), voltage=rates.Ramp(rate=0.01), tolerance=1e-5)
    true = abs(run.snap.at.voltage / item["result"]["fold"]["voltage"]["value"] - 1)
    assert true <= 10 * run.error_estimate < 1e-3


def test_a_function_of_time_is_a_ramp():
    """The same course as a ramp and as a function, until the same time."""
    scene = scene_of({"material": "M4", "pressure": 1.82})
    ramp = rates.follow(scene, voltage=rates.Ramp(rate=0.1), duration=1.0, tolerance=1e-8)
    own = rates.follow(scene, voltage=lambda t: 0.1 * t, duration=1.0, tolerance=1e-8)
    for run in (ramp, own):
        assert (run.reason, run.events[-1].time) == ("end of the protocol", pytest.approx(1.0, abs=1e-12))
    assert own.events[-1].volume == pytest.approx(ramp.events[-1].volume, rel=1e-8)


def test_a_voltage_that_is_switched_off():
    """After a hold and a drop to zero the film recovers, at last to where it began."""
    scene = scene_of({"material": "M4", "chamber_volume": 1600.0, "initial_volume": 2.42})
    run = rates.follow(scene, voltage=rates.Steps([(0.06, 5.0), (0.0, 100.0)]), tolerance=1e-8)
    data = run.dataset
    assert run.reason == "at rest"
    assert float(data.volume.max()) > 2.6
    assert float(data.volume[-1]) == pytest.approx(2.42, rel=1e-6)


def test_bad_input():
    scene = scene_of({"material": "M1", "pressure": 1.82})
    charged = dj.Scene(scene.membrane, dj.ChargeControl(scene.loading))
    for words, call in (
        ("`rate` must not be zero", lambda: rates.Ramp(rate=0.0)),
        ("`start` must be", lambda: rates.follow(scene, voltage=0.1, start="wet")),
        ("`voltage` must be a Ramp", lambda: rates.follow(scene, voltage="high")),
        (
            "`loading` must be a Chamber, a ConstantPressure or a PrescribedVolume here",
            lambda: rates.follow(charged, voltage=0.1),
        ),
        ("`duration` must be positive", lambda: rates.follow(scene, voltage=0.1, duration=0.0)),
        ("`volume` or `pressure` must be given, at most one", lambda: rates.follow(scene, volume=1.0, pressure=1.0)),
        ("`scene` must be a Scene unless", lambda: rates.follow(scene.membrane, voltage=0.1)),
        ("`voltage` must be one protocol, or one a scene", lambda: rates.follow([scene], voltage=[0.1, 0.2])),
        ("`relaxation_time` must be positive", lambda: Maxwell(dj.Gent(), 1.0, 0.0)),
        ("`branches` must be Maxwell branches", lambda: Viscoelastic(dj.Gent(), [dj.Gent()])),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_a_scene_without_a_start_leaves_the_others_alone():
    scene = scene_of({"material": "M1", "pressure": 1.82})
    beyond = scene.replace(pressure=50.0)
    with pytest.raises((dj.SceneError, ValueError)):
        rates.follow(beyond, voltage=rates.Ramp(rate=0.01))
    alone = rates.follow(scene, voltage=rates.Ramp(rate=0.01))
    refused, run = rates.follow([beyond, scene], voltage=rates.Ramp(rate=0.01))
    assert isinstance(refused, (dj.SceneError, ValueError)) and str(refused)
    assert run.reason == alone.reason and run.snap.at.voltage == alone.snap.at.voltage
    assert math.isnan(rates.estimate_errors([refused])[0])


def test_parameters_of_a_viscoelastic_scene():
    """The spring's constants are parameters of the scene, and a description names the branches."""
    scene = scene_of({"material": "M5", "chamber_volume": 4000.0, "initial_volume": 2.2})
    stiffer = scene.replace(stretch_limit=150.0, chamber_volume=1600.0)
    assert float(stiffer.membrane.material.equilibrium.stretch_limit) == 150.0
    said = dj.model.describe(stiffer)
    assert (said["material"], said["elastic"], said["stretch_limit"]) == ("viscoelastic", "gent", 150.0)
    assert said["branches"] == [
        {"material": "gent", "stretch_limit": 120.0, "modulus_ratio": 0.5, "relaxation_time": 1.0}
    ]


@pytest.mark.parametrize("item", items("limits"), ids=lambda item: item["scene"]["material"])
def test_constants_of_slow_passage(item):
    known = item["result"]["equilibrium_fold"]
    law = rates.slow_passage(scene_of(item["scene"]))
    check(law.voltage, known["phi"])
    check(law.ramp_constant, known["k_ramp"])
    check(law.delay_constant, known["k_delay"])
