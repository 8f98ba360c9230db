"""Diagrams of the reference scenes: branches, special points and ramps, with nothing missed and nothing spurious."""

import json
import math
import types

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.diagram import diagrams
from dielectric_jax.model.chart import explicit_map

SCENES = {
    "VC=800": ("chamber", 800.0),
    "VC=1600": ("chamber", 1600.0),
    "p=1.2": ("held", 1.2, 1.0),
    "p=1.82": ("held", 1.82, 1.0),
    "lam0=2 p=1": ("held", 1.0, 2.0),
}
PV = {"lam0=1 Phi=0": (0.0, 1.0), "lam0=1 Phi=0.1": (0.1, 1.0), "lam0=2 Phi=0": (0.0, 2.0)}
LOADING = {
    "fold_Phi": "fold",
    "fold_negF": "fold",
    "fold_p": "fold",
    "breakdown": "breakdown",
    "sigma2=0": "hoop_tension_loss",
}


@pytest.fixture(scope="session")
def diagram(chamber, held, curve):
    """`diagram(name)` of `SCENES` or `PV`."""

    def build(name):
        if name in PV:
            return curve(*PV[name])
        kind, *values = SCENES[name]
        return (chamber if kind == "chamber" else held)(*values)

    return build


def of_scene(reference, name):
    """The reference states of a scene; "p=1" must not match those of "p=1.2"."""
    return [ref for ref in reference if ref["label"].startswith(name + " ")]


def kind_of(label):
    """The name in a diagram of a special point of the reference states, None for other states."""
    for word, kind in LOADING.items():
        if word in label and "landing" not in label and "same-Phi" not in label:
            return kind
    if label.endswith(" A") or "Phi=0#" in label or "Phi=0 state" in label:
        return "zero_voltage"
    return None


def error(value, expected):
    """The measure of `error_estimate`."""
    return abs(value - expected) / max(abs(expected), 1e-3)


def check(point, ref, *, located):
    """The located quantity to 1e-9; the position along the branch to the digits of the reference if they are fewer."""
    place = max(1e-9, 10 ** -ref["digits"])
    for name in ("voltage_squared", "pressure", "volume", "apex_stretch"):
        assert error(getattr(point, name), ref[name]) < (1e-9 if name in located else place), name
    for name in ("height", "charge", "breakdown_ratio"):
        if ref["voltage_squared"] >= 0:
            assert error(getattr(point, name), ref[name]) < 1e-8, name
    if ref["voltage_squared"] < 0:
        assert error(point.height, ref["height"]) < 1e-8
        assert math.isnan(point.voltage) and math.isnan(point.charge) and math.isnan(point.breakdown_ratio)
    if point.kind == "fold":
        assert point.index is None
    elif "index_chamber" in ref or ref["constant_pressure"] is not None:
        expected = ref.get("index_chamber", ref.get("index_prescribed_pressure"))
        assert expected is None or point.index == expected
    elif "index_prescribed_pressure" in ref:
        assert point.index == ref["index_prescribed_pressure"]
    assert point.error_estimate <= 1e-9 and point.flags == ()


def nearest(points, ref):
    return min(points, key=lambda p: abs(p.apex_stretch - ref["apex_stretch"]))


@pytest.mark.parametrize("name", [*SCENES, *PV])
def test_every_special_point_of_the_references(diagram, reference, name):
    found = diagram(name)
    count = 0
    for ref in of_scene(reference, name):
        kind = kind_of(ref["label"])
        if kind is None or (kind == "zero_voltage" and name in PV):
            continue
        candidates = [p for p in found.special_points if p.kind == kind]
        assert candidates, ref["label"]
        located = {"pressure_fold": ("pressure",)}.get(kind, ("pressure",) if name in PV else ("voltage_squared",))
        check(nearest(candidates, ref), ref, located=located)
        count += 1
    assert count >= 2


# kinds in order of their volume, starting with the branch of smallest volume; from the reference states and the model
EXPECTED = {
    "VC=800": [["zero_voltage", "fold", "fold", "breakdown"]],
    "VC=1600": [["zero_voltage", "fold", "zero_voltage", "fold", "zero_voltage", "breakdown"]],
    "p=1.82": [["zero_voltage", "fold", "zero_voltage", "fold", "zero_voltage", "breakdown"]],
    "lam0=2 p=1": [["zero_voltage", "fold", "fold", "breakdown"]],
}


@pytest.mark.parametrize("name", EXPECTED)
def test_nothing_is_invented(diagram, name):
    """Branches, and on each the events below the load at which hoop tension is lost."""
    found = diagram(name)
    assert found.complete and len(found.branches) == len(EXPECTED[name])
    for k, kinds in enumerate(EXPECTED[name]):
        own = sorted((p for p in found.special_points if p.branch == k), key=lambda p: p.volume)
        assert [p.kind for p in own if p.kind != "hoop_tension_loss"] == kinds


def test_pressure_1_2_has_a_main_and_an_isolated_branch(diagram):
    found = diagram("p=1.2")
    assert found.complete and len(found.branches) == 2
    main, isolated = sorted(found.branches, key=lambda b: b.volume.min())
    assert main.voltage_squared.min() < 0 < isolated.voltage_squared.min()
    own = [p for p in found.special_points if found.branches[p.branch] is isolated]
    assert sorted(p.kind for p in own) == ["breakdown", "breakdown", "fold", "hoop_tension_loss", "hoop_tension_loss"]
    (fold,) = [p for p in own if p.kind == "fold"]
    assert fold.voltage == pytest.approx(0.0752841325, abs=1e-10)
    # the main branch spirals: the loads of its folds alternate about that of the cone and converge to it
    spiral = [p.voltage_squared for p in found.special_points if p.branch != fold.branch and p.kind == "fold"]
    assert spiral[0] == pytest.approx(0.1266058554, rel=1e-9)
    assert len(spiral) >= 3
    steps = np.diff(spiral)
    assert (np.sign(steps[1:]) == -np.sign(steps[:-1])).all() and (np.abs(steps[1:]) < np.abs(steps[:-1])).all()


def test_states_of_the_references_between_special_points(diagram, reference):
    """Landings and other states at a given load, found on the branches by the diagram's own solver."""
    count = 0
    for name in SCENES:
        found = diagram(name)
        for ref in of_scene(reference, name):
            if kind_of(ref["label"]) is not None:
                continue
            # between two points of a branch that bracket it
            load = ref["voltage_squared"]
            at = [p for p in found.ramp().events if p.event == "landing"]
            at += [e for e in _way_down(found) if e.event == "landing"]
            states = [e.state for e in at]
            near = [
                s for s in states if error(s.voltage_squared, load) < 1e-8 and error(s.volume, ref["volume"]) < 1e-3
            ]
            for state in near:
                for key in ("voltage_squared", "pressure", "volume", "apex_stretch"):
                    assert error(getattr(state, key), ref[key]) < 1e-9, (ref["label"], key)
                assert state.breakdown_ratio == pytest.approx(ref["breakdown_ratio"], rel=1e-8)
                count += 1
    assert count >= 5


def _way_down(diagram):
    try:
        return diagram.ramp("down").events
    except ValueError:
        return ()


# ramps: events of the way up, area strain and its reason, way down
RAMPS = {
    "VC=800": (
        ["start", "snap", "landing", "breakdown"],
        "breakdown on the branch",
        ["start", "snap_back", "landing", "end"],
    ),
    "VC=1600": (["start", "snap", "landing", "breakdown"], "breakdown on the branch", ["start", "end"]),
    "p=1.2": (["start", "snap", "landing", "breakdown"], "breakdown in the snap", []),
    "p=1.82": (["start", "snap", "landing", "breakdown"], "breakdown in the snap", []),
    "lam0=2 p=1": (["start", "snap", "landing", "breakdown"], "breakdown in the snap", []),
}


@pytest.mark.parametrize("name", RAMPS)
def test_ramp(diagram, name):
    found = diagram(name)
    up, reason, down = RAMPS[name]
    assert [e.event for e in found.ramp().events] == up
    assert found.area_strain_reason == reason
    assert found.ramp().events[-1].reason == reason
    assert [e.event for e in _way_down(found)] == down
    events = found.ramp().events
    held = events[-1].state if reason == "breakdown on the branch" else events[1].state
    assert found.area_strain == pytest.approx((held.apex_stretch / events[0].state.apex_stretch) ** 2 - 1, rel=1e-12)
    if reason == "breakdown on the branch":
        assert held.breakdown_ratio == pytest.approx(1.0, abs=1e-9)
    else:
        assert events[2].state.breakdown_ratio >= 1


def test_numbers_of_the_ramps(diagram, chamber):
    """Loads, volumes and strains of section 4 of the model."""
    up = diagram("VC=1600").ramp()
    assert up["snap"][0].state.voltage == pytest.approx(0.0764953595449, rel=1e-9)
    assert up["landing"][0].state.volume == pytest.approx(19.9533292542, rel=1e-9)
    assert up["landing"][0].state.breakdown_ratio == pytest.approx(0.568782, abs=1e-6)
    assert up["breakdown"][0].state.voltage == pytest.approx(0.100970094106, rel=1e-10)
    assert diagram("VC=1600").area_strain == pytest.approx((8.10285526922 / 1.95822343926) ** 2 - 1, rel=1e-9)
    up = diagram("VC=800").ramp()
    assert up["snap"][0].state.voltage == pytest.approx(0.0971990067469, rel=1e-9)
    assert up["breakdown"][0].state.voltage == pytest.approx(0.115172761046, rel=1e-10)
    back = diagram("VC=800").ramp("down")["snap_back"][0].state
    assert back.voltage == pytest.approx(0.0890347141691, rel=1e-9)
    start = diagram("VC=800").ramp("down").events[0].state
    assert start.voltage == pytest.approx(
        (up["landing"][0].state.voltage + up["breakdown"][0].state.voltage) / 2, rel=1e-9
    )
    assert diagram("p=1.82").ramp()["snap"][0].state.voltage == pytest.approx(0.114568360882, rel=1e-9)
    assert chamber(25000.0).area_strain == pytest.approx(25.57, abs=0.005)
    assert diagram("VC=1600").area_strain == pytest.approx(16.12, abs=0.005)


def test_a_way_down_from_a_given_state(diagram):
    """From just after the landing of V_C = 800 the way back snaps at the same fold; a state on no branch is refused."""
    found = diagram("VC=800")
    landing = found.ramp()["landing"][0].state
    back = found.ramp("down", start=landing)
    assert [e.event for e in back.events] == ["start", "snap_back", "landing", "end"]
    assert back.events[1].state.voltage == pytest.approx(0.0890347141691, rel=1e-9)
    assert back.events[2].state.volume == pytest.approx(2.93800433802, rel=1e-9)
    assert back.events[-1].state.volume == pytest.approx(2.42, rel=1e-9) and back.events[-1].reason == "zero voltage"
    with pytest.raises(ValueError, match=r"^`start` must "):
        found.ramp("down", start=diagram("VC=1600").ramp()["landing"][0].state)
    with pytest.raises(ValueError, match=r"^`direction` must "):
        found.ramp("sideways")


def test_hysteresis_of_a_bistable_chamber(diagram):
    """V_C = 1600 stays snapped at zero voltage: V 11.7561689651, p 1.58605717915."""
    end = diagram("VC=1600").ramp("down").events[-1]
    assert (end.event, end.reason) == ("end", "zero voltage")
    assert end.state.volume == pytest.approx(11.7561689651, rel=1e-9)
    assert end.state.pressure == pytest.approx(1.58605717915, rel=1e-9)
    assert end.state.index == 0


def test_chamber_30_spirals_and_lands_nowhere(chamber):
    """Four folds to the digits that are known; past the second an ungraded mesh gives false ones."""
    found = chamber(30.0)
    assert found.complete
    folds = [p for p in found.special_points if p.kind == "fold" and p.volume < 2.73 and p.apex_stretch < 9]
    folds.sort(key=lambda p: p.apex_stretch)
    assert [p.voltage for p in folds[:3]] == pytest.approx([0.25123405938, 0.24314276881, 0.24351880450], abs=6e-12)
    # the fourth and fifth converge to 0.2435037
    for fold in folds[3:]:
        assert fold.voltage == pytest.approx(0.2435037, abs=1e-6)
    assert all(p.error_estimate <= 1e-9 for p in folds)
    loads = np.diff([p.voltage for p in folds])
    assert (np.sign(loads[1:]) == -np.sign(loads[:-1])).all() and (abs(loads[1:]) < abs(loads[:-1])).all()
    main = found.branches[folds[0].branch]
    assert {main.start.name, main.end.name} == {"window_load", "apex_cone"}
    assert [e.event for e in found.ramp().events] == ["start", "snap", "no_landing"]
    assert found.area_strain_reason == "no landing"
    assert found.ramp()["snap"][0].state.breakdown_ratio == pytest.approx(0.670, abs=1e-3)
    with pytest.raises(ValueError, match=r"^`direction` must be 'up' here"):
        found.ramp("down")


def test_chamber_25000(chamber):
    """Lands at E/E_EB 0.877 and breaks down on the branch; the dip to q = −0.0187 joins both sides."""
    found = chamber(25000.0)
    assert found.complete and len(found.branches) == 1
    assert [e.event for e in found.ramp().events] == ["start", "snap", "landing", "breakdown"]
    assert found.ramp()["landing"][0].state.breakdown_ratio == pytest.approx(0.877, abs=1e-3)
    dip = min(p.voltage_squared for p in found.special_points if p.kind == "fold")
    assert dip == pytest.approx(-0.0187, abs=6e-5)
    kinds = [p.kind for p in sorted(found.special_points, key=lambda p: p.volume) if p.kind != "hoop_tension_loss"]
    assert kinds == ["zero_voltage", "fold", "zero_voltage", "fold", "zero_voltage", "breakdown"]


@pytest.mark.parametrize("pressure", [0.8, 1.5])
def test_no_point_of_a_branch_is_passed_twice(held, pressure):
    """No special point is listed twice, and the arclength between points never turns back."""
    found = held(pressure)
    places = [(p.kind, round(p.voltage_squared, 9), round(p.apex_stretch, 7)) for p in found.special_points]
    assert len(set(places)) == len(places)
    for branch in found.branches:
        x = np.stack([branch.apex_stretch, branch.pressure / 0.2, branch.voltage_squared / 0.02], axis=1)
        way = np.diff(x, axis=0)
        length = np.linalg.norm(way, axis=1)
        assert length.min() > 0
        cosine = (way[1:] * way[:-1]).sum(axis=1) / (length[1:] * length[:-1])
        assert cosine.min() > 0.5


PV_FOLDS = {0.0: 2, 0.1: 2, 0.15: 4}


@pytest.mark.parametrize("voltage", PV_FOLDS)
def test_folds_of_pressure_curves(curve, voltage):
    found = curve(voltage)
    assert found.complete and len(found.branches) == 1
    folds = [p for p in found.special_points if p.kind == "fold"]
    assert len(folds) == PV_FOLDS[voltage]
    # neighbours along the branch are a maximum and a minimum in turn
    pressures = [p.pressure for p in sorted(folds, key=lambda p: p.apex_stretch)]
    steps = np.diff(pressures)
    assert (np.sign(steps[1:]) == -np.sign(steps[:-1])).all()
    assert found.ramp is not None and found.area_strain is None and found.to_json()["ramp"] is None
    with pytest.raises(ValueError, match=r"^`ramp` must be asked of"):
        found.ramp()


def test_two_branches_at_high_voltage(curve):
    """Above Φ = 0.170240892, the minimum of √q_max, no state has λa = 8.26: two branches, both ending at the cone."""
    found = curve(0.2)
    assert found.complete and len(found.branches) == 2
    low, high = sorted(found.branches, key=lambda b: b.volume.min())
    assert low.apex_stretch.max() < 8.26134 < high.apex_stretch.min()
    assert "apex_cone" in {low.start.name, low.end.name} and "apex_cone" in {high.start.name, high.end.name}
    folds = sorted(
        (p for p in found.special_points if p.kind == "fold" and p.apex_stretch < 8.26), key=lambda p: p.apex_stretch
    )
    gaps = np.abs(np.diff([p.pressure for p in folds]))
    assert len(folds) >= 3 and (gaps[1:] < gaps[:-1]).all()
    # the index grows by one a fold
    branch = found.branches[folds[0].branch]
    order = np.argsort(branch.volume) if branch.volume[0] > branch.volume[-1] else np.arange(len(branch))
    index = branch.index[::-1] if branch.apex_stretch[0] > branch.apex_stretch[-1] else branch.index
    assert len(order) == len(index)
    values = [k for n, k in enumerate(index) if n == 0 or k != index[n - 1]]
    assert values[: len(folds) + 1] == list(range(len(values)))[: len(folds) + 1]


def test_pressure_folds_of_prestretch_3_at_high_voltage(curve):
    """Φ = 0.2 at λ0 = 3 has folds at p 0.2951107880 and 0.2820257114; at Φ = 0.1 there is none."""
    folds = [p for p in curve(0.2, 3.0).special_points if p.kind == "fold"]
    outer = sorted(folds, key=lambda p: p.apex_stretch)
    for pressure in (0.2820257114, 0.2951107880):
        assert min(abs(p.pressure - pressure) for p in outer) < 1e-10
    assert len({round(p.apex_stretch, 6) for p in folds}) == len(folds)
    assert [p for p in curve(0.1, 3.0).special_points if p.kind == "fold"] == []


def test_points_lie_on_the_loading(diagram, chamber):
    """(p + 50)(V + V_C) is one number along a chamber's branch; p is held at constant pressure."""
    for volume in (800.0, 25000.0):
        branch = chamber(volume).branches[0]
        product = (branch.pressure + 50) * (branch.volume + volume)
        np.testing.assert_allclose(product, (1.886612680245 + 50) * (2.42 + volume), rtol=1e-11)
    for branch in diagram("p=1.2").branches:
        np.testing.assert_allclose(branch.pressure, 1.2, rtol=1e-12)


def test_a_filling_to_just_below_the_peak():
    """The state before the peak fills the chamber, √(gap/c) before it; above it only the inflated state near lock-up does."""
    peak, place = 1.908684829414, 2.9634068291

    def start(gap):
        scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_pressure=peak * (1 - gap)))
        up = [event for event in dj.voltage_volume(scene).events if event.direction == "up"]
        assert up[0].event == "start" and abs(up[0].state.pressure / peak - 1 + gap) < 1e-10
        return up[0].state.volume, up[1].event

    (far, one), (near, other) = start(1e-6), start(1e-8)
    assert one == other == "snap"
    assert (place - far) / (place - near) == pytest.approx(10.0, rel=3e-3)
    inflated, event = start(-1e-6)
    assert inflated > 200 and event == "breakdown"


def test_a_filling_by_pressure_is_the_filling_by_volume(chamber):
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_pressure=1.886612680245))
    other = dj.voltage_volume(scene)
    assert [p.kind for p in other.special_points] == [p.kind for p in chamber(1600.0).special_points]
    for a, b in zip(other.special_points, chamber(1600.0).special_points, strict=True):
        assert a.apex_stretch == pytest.approx(b.apex_stretch, rel=1e-8)


def test_polytropic_gas():
    """n = 1.4: the gas law along the branch; a stiffer gas snaps later than the isothermal one."""
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=800.0, initial_volume=2.42, polytropic_exponent=1.4))
    found = dj.voltage_volume(scene)
    branch = found.branches[0]
    law = (branch.pressure + 50) * (branch.volume + 800) ** 1.4
    np.testing.assert_allclose(law, (1.886612680245 + 50) * 802.42**1.4, rtol=1e-11)
    assert found.ramp()["snap"][0].state.voltage > 0.0971990067469


@pytest.mark.parametrize(
    "loading", [dj.Chamber(volume=100.0, initial_volume=0.0), dj.ConstantPressure(0.0)], ids=["chamber", "pressure"]
)
def test_flat_films(loading):
    """λ0 = 2: one flat branch to slack at q_max; λ0 = 1: there is no tension."""
    found = dj.voltage_volume(dj.Scene(dj.Membrane(prestretch=2.0), loading))
    assert found.complete and len(found.branches) == 1
    branch = found.branches[0]
    assert not branch.volume.any() and not branch.pressure.any() and (branch.apex_stretch == 2.0).all()
    q = branch.voltage_squared
    np.testing.assert_allclose(branch.charge[q >= 0], math.pi * np.sqrt(q[q >= 0]) * 16, rtol=1e-14)
    largest = (2**-2 - 2**-8) / (1 - (8 + 1 / 16 - 3) / 270)
    (slack,) = [p for p in found.special_points if p.kind == "slack"]
    assert slack.voltage_squared == pytest.approx(largest, rel=1e-12)
    assert q[-1] == pytest.approx(largest, rel=1e-12)
    # it would break down at Φ = E_EB(2)/4 = 0.5091 > √q_max = 0.5044
    assert [(e.event, e.reason) for e in found.ramp().events] == [("start", None), ("end", "slack")]
    assert [p.kind for p in found.special_points] == ["zero_voltage", "slack"]
    weaker = dj.voltage_volume(dj.Scene(dj.Membrane(prestretch=2.0, breakdown=dj.VHBBreakdown(scale=0.5)), loading))
    (broken,) = [p for p in weaker.special_points if p.kind == "breakdown"]
    assert broken.voltage == pytest.approx(0.5 * 30.6 * 2**1.13 / 32.88422182218 / 4, rel=1e-12)
    assert [e.event for e in weaker.ramp().events] == ["start", "breakdown"] and weaker.area_strain == 0.0
    json.dumps(found.to_json(), allow_nan=False)
    with pytest.raises(dj.SceneError) as refused:
        dj.voltage_volume(dj.Scene(dj.Membrane(prestretch=1.0), loading))
    assert refused.value.code is dj.numerics.Code.flat_unstretched


def test_an_unstable_start_is_one_event():
    """V_0 = 5 at constant volume of gas so large that the falling side of the peak is unstable."""
    found = dj.voltage_volume(dj.Scene(dj.Membrane(), dj.Chamber(volume=25000.0, initial_volume=5.0)))
    (only,) = found.events
    assert (only.event, only.reason, only.direction) == ("start", "start_unstable", "up")
    assert only.state.volume == pytest.approx(5.0, rel=1e-9) and only.state.index == 1
    assert found.area_strain is None and found.area_strain_reason == "start_unstable"


def test_constant_pressure_starts_at_the_smallest_stable_volume(diagram):
    start = diagram("p=1.82").ramp().events[0].state
    assert start.volume == pytest.approx(2.01878174356, rel=1e-10) and start.index == 0


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.Chamber(volume=1600.0, initial_volume=468.9))), "initial_volume"),
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.Chamber(volume=1600.0, initial_volume=500.0))), "initial_volume"),
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.Chamber(volume=1600.0, initial_pressure=1e5))), "initial_pressure"),
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.ConstantVoltage(0.1))), "loading"),
        (lambda m: dj.voltage_volume(m), "scene"),
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.ConstantPressure(1.0)), points=2), "points"),
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.ConstantPressure(1.0)), points=64.0), "points"),
        (lambda m: dj.voltage_volume(dj.Scene(m, dj.ConstantPressure(1.0)), tolerance=float("nan")), "tolerance"),
        (lambda m: dj.pressure_volume(m, voltage=-0.1), "voltage"),
        (lambda m: dj.pressure_volume(m, window=dj.model.Window(apex_stretch=(12.0, 13.0))), "stretch_window"),
    ],
)
def test_bad_input_is_refused_by_name(membrane, build, name):
    with pytest.raises(ValueError, match=f"^`{name}` must .*, but .*\\.$"):
        build(membrane)


def test_a_voltage_beyond_every_equilibrium_has_a_code():
    """λ0 = 1 at Φ = 0.6: q = 0.36 exceeds q_max below λa 1.6 and above; states remain only near lock-up beyond the window."""
    window = dj.model.Window(apex_stretch=(1.0, 5.0))
    with pytest.raises(dj.SceneError) as refused:
        dj.pressure_volume(dj.Membrane(), voltage=0.8, window=window)
    assert refused.value.code is dj.numerics.Code.no_equilibrium


DOCUMENT = {
    "scene",
    "units",
    "engine",
    "window",
    "complete",
    "tolerance",
    "branches",
    "special_points",
    "ramp",
    "area_strain",
    "area_strain_reason",
}
UNKNOWNS = "voltage_squared pressure volume apex_stretch height charge breakdown_ratio index error_estimate"
POINT = f"kind branch voltage {UNKNOWNS} flags"
EVENT = "event direction voltage pressure volume apex_stretch breakdown_ratio error_estimate reason"


@pytest.mark.parametrize("name", ["VC=1600", "p=1.2", "lam0=1 Phi=0.1"])
def test_json(diagram, name):
    document = json.loads(json.dumps(diagram(name).to_json(), allow_nan=False))
    assert set(document) >= DOCUMENT
    assert set(document["window"]) == {"apex_stretch", "load_fraction", "scanned_load_fraction"}
    assert (
        document["units"] == "dimensionless" and document["engine"] == "continuation" and document["complete"] is True
    )
    kinds = {"fold", "zero_voltage", "breakdown", "hoop_tension_loss", "slack"}
    events = {"start", "snap", "landing", "snap_back", "breakdown", "no_landing", "end"}
    for branch in document["branches"]:
        assert set(branch) >= {*UNKNOWNS.split(), "start", "end", "flags"}
        assert len({len(branch[c]) for c in UNKNOWNS.split()}) == 1
        assert all((c is None) == (q < 0) for c, q in zip(branch["charge"], branch["voltage_squared"], strict=True))
        assert all(
            (c is None) == (q < 0) for c, q in zip(branch["breakdown_ratio"], branch["voltage_squared"], strict=True)
        )
        assert all(isinstance(i, int) for i in branch["index"])
        assert max(branch["error_estimate"]) <= 1e-9 and min(branch["error_estimate"]) >= 1e-13
        assert {branch["start"], branch["end"]} <= {code.name for code in dj.numerics.Code}
    for point in document["special_points"]:
        assert set(point) >= set(POINT.split()) and point["kind"] in kinds
        assert (point["index"] is None) == (point["kind"] == "fold")
        for key in ("voltage", "charge", "breakdown_ratio"):
            assert (point[key] is None) == (point["voltage_squared"] < 0)
    if name.startswith("lam0"):
        assert document["ramp"] is None and document["area_strain"] is None
    else:
        for event in document["ramp"]:
            assert set(event) >= set(EVENT.split()) and event["event"] in events
        directions = [event["direction"] for event in document["ramp"]]
        assert directions == sorted(directions, reverse=True)  # up, then down
    assert document["scene"]["material"] == "gent" and document["scene"]["stretch_limit"] == 270.0


@pytest.mark.parametrize("name", ["VC=1600", "p=1.2", "lam0=1 Phi=0.1"])
def test_a_diagram_comes_back_from_its_document(diagram, name, tmp_path):
    """From a file, dimensionless to the bit, and in SI to rounding."""
    made = diagram(name)
    (tmp_path / "d.json").write_text(json.dumps(made.to_json()))
    read = dj.diagram.Diagram.from_json(tmp_path / "d.json")
    assert read.to_json() == made.to_json()
    branch = made.branches[0]
    assert read.gas_pressure(3.0) == (made.gas_pressure(3.0) if name == "VC=1600" else None)
    units = dj.Units(shear_modulus="0.3 MPa", thickness="0.2 mm")
    in_si = json.loads(json.dumps(made.to_json(units)))
    read = dj.diagram.Diagram.from_json(in_si)
    assert read.to_json(read.scene.units)["branches"][0].keys() == in_si["branches"][0].keys()
    for column in ("pressure", "volume", "charge", "apex_stretch"):
        np.testing.assert_allclose(getattr(read.branches[0], column), getattr(branch, column), rtol=1e-13)
    assert [p.kind for p in read.special_points] == [p.kind for p in made.special_points]
    if made.control == "voltage" and name != "lam0=1 Phi=0.1":
        up, known = read.ramp(), made.ramp()
        assert [e.event for e in up.events] == [e.event for e in known.events]
        assert up.area_strain == known.area_strain
        assert up.events[-1].state.voltage == pytest.approx(known.events[-1].state.voltage, rel=1e-13)
        assert read.states_at(0.01)[0].volume == pytest.approx(made.states_at(0.01)[0].volume, rel=1e-8)


def test_a_document_of_something_else_is_refused(diagram, tmp_path):
    read = dj.diagram.Diagram.from_json
    document = diagram("p=1.2").to_json()
    (tmp_path / "d.json").write_text("[1, 2")
    with pytest.raises(ValueError, match="`document` must be a file of JSON"):
        read(tmp_path / "d.json")
    with pytest.raises(ValueError, match='has no "branches"'):
        read({n: v for n, v in document.items() if n != "branches"})
    with pytest.raises(ValueError, match="one diagram"):
        read({"diagrams": [document]})
    with pytest.raises(ValueError, match="in SI or dimensionless, but its units are 'kV, ml, mbar'"):
        read(dj.Units().to_document(document, read=True))
    with pytest.raises(ValueError, match="`scene` must be a Scene, but is a int"):
        read(document, 5)
    lost = [{n: v for n, v in b.items() if n != "volume"} for b in document["branches"]]
    short = [b | {"pressure": b["pressure"][:3]} for b in document["branches"]]
    for name, broken in (("scene", 5), ("window", {}), ("branches", []), ("branches", lost), ("branches", short),
                         ("special_points", [{}]), ("ramp", [1])):  # fmt: skip
        with pytest.raises(ValueError, match=r"`document` must|`scene` must|columns of a branch"):
            read(document | {name: broken})
    with pytest.raises(ValueError, match="`scene` must be given with this document: `material`"):
        read(document | {"scene": document["scene"] | {"material": "custom"}})
    dense = dj.Scene.from_si(dj.Membrane(), dj.ConstantPressure(1500.0), dj.Units(density=960.0))
    described = dj.model.describe(dense)
    assert dj.model.describe(dj.model.described_scene(described)) == described
    again = read(document | {"scene": document["scene"] | {"material": "custom"}}, diagram("p=1.2").scene)
    assert again.to_json() == document


def test_the_points_of_all_branches_as_a_table(diagram, tmp_path):
    made, units = diagram("p=1.2"), dj.Units()
    table = made.to_dataframe(units)
    assert len(table) == sum(map(len, made.branches)) and list(table.branch.unique()) == [0, 1]
    second = table[table.branch == 1]
    np.testing.assert_allclose(second.volume, made.branches[1].volume * 22.5e-3**3, rtol=1e-14)
    assert table.attrs["units"]["volume"] == "m³"
    made.to_csv(tmp_path / "d.csv")
    head, *lines = (tmp_path / "d.csv").read_text().splitlines()
    assert head.startswith("branch,voltage,voltage_squared,pressure") and len(lines) == len(table)
    number, voltage, *values = lines[0].split(",")
    assert number == "0" and (voltage == "") == (made.branches[0].voltage_squared[0] < 0)
    assert float(values[1]) == made.branches[0].pressure[0]


def test_index_along_the_branches(diagram):
    """It changes at folds only: by one, and 0 before the first (the gas removes the unstable mode of the p–V peak)."""
    for name in ("VC=800", "VC=1600", "p=1.82"):
        found = diagram(name)
        branch = found.branches[0]
        folds = sorted(p.apex_stretch for p in found.special_points if p.kind == "fold")
        sections = np.searchsorted(folds, branch.apex_stretch)  # λa rises all along these branches
        below = branch.voltage_squared < 0.03
        for k in range(len(folds) + 1):
            assert set(branch.index[(sections == k) & below]) == {k % 2}


@pytest.mark.parametrize(
    ("prestretch", "limit", "pressure"),
    [(1.8781364210247276, 986.0181363515143, 0.7102687165892075), (2.8149978467522683, 476.63617826520533, 0.40611340)],
)
def test_the_wall_before_lock_up_is_followed(prestretch, limit, pressure):
    """Towards lock-up the rim condition rises like an exponential: a trace that steps beyond it loses the branch."""
    membrane = dj.Membrane(dj.Gent(limit), prestretch)
    diagram = dj.voltage_volume(dj.Scene(membrane, dj.ConstantPressure(pressure)))
    assert diagram.complete
    inflated = max(diagram.branches, key=lambda b: b.volume.max())
    # the branch reaches the lock-up or the loads that the scan leaves out
    fraction = inflated.voltage_squared[-1] / float(membrane.largest_load(inflated.apex_stretch[-1]))
    assert inflated.end is dj.numerics.Code.lock_up or fraction > 0.9
    assert "end_lost" not in inflated.flags
    # every state belongs to the explicit map
    inside = (inflated.voltage_squared / np.asarray(membrane.largest_load(inflated.apex_stretch))) < 0.85
    some = np.flatnonzero(inside)[::8]
    p, v, _ = explicit_map(
        membrane.material, inflated.apex_stretch[some], inflated.voltage_squared[some], prestretch, 319.0
    )
    assert np.allclose(p, pressure, rtol=1e-5) and np.allclose(v, inflated.volume[some], rtol=1e-5)


def test_flat_end_of_a_pressure_volume_curve(curve):
    branch = curve(0.0).branches[0]
    assert branch.start is dj.numerics.Code.window_stretch and branch.end is dj.numerics.Code.lock_up
    assert branch.volume[0] < 0.02 and (np.diff(branch.volume) > 0).all()


@pytest.mark.parametrize(
    ("prestretch", "limit", "loading", "stretch", "pressure"),
    [
        # a branch with a tongue that extends down to t = 0.887 at the cliff of the pressure
        (1.1875613993405114, 495.4295954252201, (27.596056266589027, 1.3123971815451052), 13.80991847, 0.68590719),
        # a branch that passes close to another one
        (2.9582343078895965, 556.676718357814, 0.4923181131294612, 13.69559259, 0.49231811),
        # and one on which a finer grid once switched to another branch
        (1.0433649474478353, 973.3212420954831, (101.50689913134966, 1.4154875689869317), 19.26652270, 1.24919879),
        # one whose first trace stops at t = 0.80, and whose points extend to 0.90
        (1.2987981894924407, 448.09374615143213, 0.913593481150794, 13.05, 0.91359348),
    ],
)
def test_branches_at_the_cliff_before_lock_up(prestretch, limit, loading, stretch, pressure):
    """States that SciPy's adaptive map, or shooting in long double, puts on the loading's contour lie on a branch."""
    held = dj.Chamber(loading[0], loading[1]) if isinstance(loading, tuple) else dj.ConstantPressure(loading)
    found = dj.voltage_volume(dj.Scene(dj.Membrane(dj.Gent(limit), prestretch), held))
    assert found.complete and len(found.branches) == 2
    (branch,) = [b for b in found.branches if b.apex_stretch.min() <= stretch <= b.apex_stretch.max()][-1:]
    away = np.hypot(branch.apex_stretch - stretch, (branch.pressure - pressure) / 0.2)
    assert away.min() < 0.1
    # nothing jumps: the turn from point to point is small
    x = np.stack([branch.apex_stretch, branch.pressure / 0.2, branch.voltage_squared / 0.02], axis=1)
    way = np.diff(x, axis=0)
    length = np.linalg.norm(way, axis=1)
    assert ((way[1:] * way[:-1]).sum(axis=1) / (length[1:] * length[:-1])).min() > 0.8


@pytest.mark.parametrize("voltage", [0.02, 0.05])
def test_small_voltages_shrink_everything_at_the_flat_end(curve, voltage):
    """Without prestretch the curve begins at a cone of λa − 1 ≈ Φ²/6, where q_max(λa) = 6 (λa − 1) vanishes."""
    found = curve(voltage)
    assert found.complete and len(found.branches) == 1
    branch = found.branches[0]
    assert branch.start is dj.numerics.Code.apex_cone and branch.end is dj.numerics.Code.lock_up
    fraction = branch.voltage_squared[0] / (6 * (branch.apex_stretch[0] - 1))
    assert 0.88 < fraction < 1


def test_branches_with_states_whose_index_is_not_valid(monkeypatch):
    """Such an index is -1 in the column and null in JSON."""
    known = dict.fromkeys(("voltage_squared", "pressure", "volume", "apex_stretch", "height", "charge"), 1.0)
    states = [dj.model.State(**known, breakdown_ratio=1.0, index=index, error_estimate=1e-12) for index in (0, None, 2)]
    monkeypatch.setattr(diagrams, "states_of", lambda points, tolerance: states)
    curve = types.SimpleNamespace(points=np.zeros(3), start=dj.numerics.Code.ok, end=dj.numerics.Code.ok, flags=())
    branch = diagrams._branch(curve, 1e-9, 256, ())
    assert branch.index.tolist() == [0, -1, 2]
    assert branch.to_json()["index"] == [0, None, 2]
