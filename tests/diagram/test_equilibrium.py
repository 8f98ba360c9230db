"""Single states: every reference state at a voltage, found by its apex stretch and by its volume; what is refused."""

import json
import math
import pathlib

import numpy as np
import pytest

import dielectric_jax as dj

STATES = [
    ref
    for ref in json.loads((pathlib.Path(__file__).parents[1] / "data" / "equilibria.json").read_text(encoding="utf-8"))
    if ref["voltage_squared"] >= 0
]


def error(value, expected):
    """The measure of `error_estimate`: |error|/max(|value|, 1e-3)."""
    return abs(value - expected) / max(abs(expected), 1e-3)


def check(state, ref):
    """p, V, λa, q to 1e-9; height, charge and breakdown ratio to 1e-8; the index of prescribed pressure."""
    for name in ("pressure", "volume", "apex_stretch", "voltage_squared"):
        assert error(getattr(state, name), ref[name]) < 1e-9, name
    for name in ("height", "charge", "breakdown_ratio"):
        assert error(getattr(state, name), ref[name]) < 1e-8, name
    if "index_prescribed_pressure" in ref:
        assert state.index == ref["index_prescribed_pressure"]
    assert state.error_estimate <= 1e-9 and state.flags == ()


@pytest.mark.parametrize("ref", STATES, ids=lambda ref: ref["label"].replace(" ", "_"))
@pytest.mark.parametrize("name", ["apex_stretch", "volume"])
def test_reference_state(ref, name):
    membrane = dj.Membrane(prestretch=ref["prestretch"])
    found = dj.equilibrium(membrane, voltage=math.sqrt(ref["voltage_squared"]), all=True, **{name: ref[name]})
    check(min(found, key=lambda s: abs(s.apex_stretch - ref["apex_stretch"])), ref)
    if name == "apex_stretch":
        assert len(found) == 1  # (λa, q) is a chart


def test_all_states_at_a_pressure(membrane):
    """p = 1.82 at Φ = 0 has three, in order of volume; the first is the answer without `all`."""
    states = dj.equilibrium(membrane, pressure=1.82, all=True)
    assert [s.volume for s in states] == pytest.approx([2.01878174356, 5.0422739075, 210.518696044], rel=1e-9)
    assert [s.index for s in states] == [0, 1, 0]
    assert dj.equilibrium(membrane, pressure=1.82) == states[0]


@pytest.mark.parametrize("gap", [1e-4, 1e-6, 1e-8])
def test_states_next_to_a_fold(membrane, gap):
    """Just below the peak there are two states, half their distance √(gap/c); just above there is none."""
    peak, place = 1.908684829414, 2.9634068291

    def near(pressure):
        states = dj.equilibrium(membrane, pressure=pressure, all=True)
        return sorted(s.volume for s in states if s.volume < 10)

    def half_distance(gap):
        low, high = near(peak - gap)
        assert low < place < high
        return (high - low) / 2

    assert near(peak + gap) == []
    # the square-root law, extrapolated from a hundred times farther away, holds up to the cubic term, the gap itself
    assert half_distance(gap) == pytest.approx(half_distance(100 * gap) / 10, rel=max(2 * (100 * gap) ** 0.5, 1e-2))


def test_the_window_bounds_the_search(membrane):
    states = dj.equilibrium(membrane, pressure=1.82, all=True, window=dj.model.Window(apex_stretch=(1.0, 5.0)))
    assert [s.volume for s in states] == pytest.approx([2.01878174356, 5.0422739075], rel=1e-9)


def test_flat_films():
    flat = dj.equilibrium(dj.Membrane(prestretch=2.0), voltage=0.1, pressure=0.0)
    assert (flat.volume, flat.pressure, flat.apex_stretch, flat.height) == (0.0, 0.0, 2.0, 0.0)
    assert flat.charge == pytest.approx(math.pi * 0.1 * 16, rel=1e-14)
    for given in ({"volume": 0.0}, {"apex_stretch": 2.0}):
        assert dj.equilibrium(dj.Membrane(prestretch=2.0), voltage=0.1, **given) == flat
    with pytest.raises(dj.SceneError) as error:
        dj.equilibrium(dj.Membrane(), pressure=0.0)
    assert error.value.code is dj.numerics.Code.flat_unstretched
    # beyond q_max(λ0) = (λ0⁻² − λ0⁻⁸)/G the film is slack
    slack = math.sqrt((2**-2 - 2**-8) / (1 - (8 + 1 / 16 - 3) / 270))
    assert dj.equilibrium(dj.Membrane(prestretch=2.0), voltage=0.999999 * slack, volume=0.0).index == 0
    with pytest.raises(dj.SceneError) as error:
        dj.equilibrium(dj.Membrane(prestretch=2.0), voltage=1.000001 * slack, volume=0.0)
    assert error.value.code is dj.numerics.Code.no_equilibrium


@pytest.mark.parametrize("prestretch", [1.5, 2.7])
def test_small_pressures_give_the_linear_membrane_or_say_that_it_is_nearly_flat(prestretch):
    # a drum of tension s per reference length: V = π λ0⁵ p/(8 s)
    tension = float(dj.model.stresses(dj.Gent(), prestretch, prestretch, 0.0)[0])
    codes = []
    for pressure in 10.0 ** -np.arange(2.0, 12.0):
        linear = math.pi * prestretch**5 * pressure / (8 * tension)
        for given, loading in (
            ({"pressure": pressure}, dj.ConstantPressure(pressure)),
            ({"volume": linear}, dj.Chamber(volume=1600.0, initial_volume=linear)),
        ):
            try:
                state = dj.equilibrium(dj.Membrane(prestretch=prestretch), **given)
                assert state.volume / state.pressure == pytest.approx(linear / pressure, rel=max(1e-6, pressure**2))
                codes.append(dj.numerics.Code.ok)
            except dj.SceneError as error:
                codes.append(error.code)
                with pytest.raises(dj.SceneError) as same:
                    dj.voltage_volume(dj.Scene(dj.Membrane(prestretch=prestretch), loading))
                assert same.value.code is dj.numerics.Code.near_flat
    assert set(codes) <= {dj.numerics.Code.ok, dj.numerics.Code.near_flat} and codes[:6] == [dj.numerics.Code.ok] * 6


@pytest.mark.parametrize(
    "given",
    [
        {"pressure": 1.5, "voltage": 3.0},
        {"volume": 3.0, "voltage": 3.0},
        {"apex_stretch": 5.0, "voltage": 3.0},
        {"pressure": 1e4},
    ],
    ids=str,
)
def test_where_there_is_none_a_code_says_so(membrane, given):
    with pytest.raises(dj.SceneError) as error:
        dj.equilibrium(membrane, **given)
    assert error.value.code is dj.numerics.Code.no_equilibrium
    assert str(error.value).endswith(dj.numerics.Code.no_equilibrium.sentence)


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({}, "pressure"),
        ({"pressure": 1.0, "volume": 2.0}, "pressure"),
        ({"pressure": -1.0}, "pressure"),
        ({"pressure": float("nan")}, "pressure"),
        ({"volume": -1.0}, "volume"),
        ({"volume": float("inf")}, "volume"),
        ({"apex_stretch": 0.0}, "apex_stretch"),
        ({"apex_stretch": 0.5}, "apex_stretch"),
        ({"apex_stretch": 20.0}, "apex_stretch"),
        ({"apex_stretch": float("nan")}, "apex_stretch"),
        ({"volume": 1.0, "voltage": -0.1}, "voltage"),
        ({"volume": 1.0, "voltage": float("nan")}, "voltage"),
        ({"volume": 1.0, "tolerance": 0.0}, "tolerance"),
        ({"volume": 1.0, "tolerance": float("nan")}, "tolerance"),
    ],
    ids=str,
)
def test_bad_input_is_refused_by_name(membrane, given, name):
    with pytest.raises(ValueError, match=f"^`{name}`.* must .*, but .*\\.$") as error:
        dj.equilibrium(membrane, **given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: dj.Chamber(volume=-1.0, initial_volume=1.0), "chamber_volume"),
        (lambda: dj.Chamber(volume=float("nan"), initial_volume=1.0), "chamber_volume"),
        (lambda: dj.Chamber(volume=10.0, initial_volume=-1.0), "initial_volume"),
        (lambda: dj.Chamber(volume=10.0, initial_pressure=-1.0), "initial_pressure"),
        (lambda: dj.Chamber(volume=10.0), "initial_volume"),
        (lambda: dj.Chamber(volume=10.0, initial_volume=1.0, initial_pressure=1.0), "initial_volume"),
        (lambda: dj.Chamber(volume=10.0, initial_volume=1.0, atmospheric_pressure=-1.0), "atmospheric_pressure"),
        (lambda: dj.Chamber(volume=10.0, initial_volume=1.0, polytropic_exponent=0.0), "polytropic_exponent"),
        (lambda: dj.ConstantPressure(-0.1), "pressure"),
        (lambda: dj.ConstantVoltage(-0.1), "voltage"),
        (lambda: dj.model.Window(apex_stretch=(3.0, 2.0)), "stretch_window"),
        (lambda: dj.model.Window(apex_stretch=2.0), "stretch_window"),
        (lambda: dj.model.Window(load_fraction=(-1.0, 1.1)), "load_window"),
        (lambda: dj.model.Window(load_fraction=(0.95, 1.0)), "load_window"),
        (lambda: dj.Scene(dj.Membrane(), 1.2), "loading"),
        (lambda: dj.Scene(1.2, dj.ConstantPressure(1.0)), "membrane"),
        (lambda: dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0)).replace(colour=1.0), "colour"),
        (lambda: dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0)).replace(chamber_volume=1.0), "chamber_volume"),
        (lambda: dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0)).replace(prestretch=0.5), "prestretch"),
        (lambda: dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0)).replace(pressure=-0.5), "pressure"),
    ],
)
def test_bad_scenes_are_refused_by_name(build, name):
    with pytest.raises(ValueError, match=f"^`{name}`.* must .*, but .*\\.$"):
        build()


def test_replace_sets_one_side_of_a_filling():
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))
    other = scene.replace(chamber_volume=800.0, initial_pressure=1.5, stretch_limit=100.0, breakdown_field_scale=2.0)
    assert (float(other.loading.volume), float(other.loading.initial_pressure), other.loading.initial_volume) == (
        800.0,
        1.5,
        None,
    )
    assert float(other.membrane.material.stretch_limit) == 100.0 and float(other.membrane.breakdown.scale) == 2.0
    assert float(scene.loading.volume) == 1600.0


def test_float32_is_refused_with_the_line_to_add():
    import jax

    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match=r'jax.config.update\("jax_enable_x64", True\)'):
            dj.Membrane()
    finally:
        jax.config.update("jax_enable_x64", True)


def test_states_of_a_chamber_at_a_voltage(membrane):
    """Each obeys the equation of its gas; past the snap voltage the landed state is left."""
    chamber = dj.Scene(membrane, dj.Chamber(volume=1600.0, initial_volume=2.42, atmospheric_pressure=50.0))
    states = dj.equilibrium(chamber, voltage=0.05, all=True)
    assert [s.index for s in states] == [0, 1, 0] and states[0] == dj.equilibrium(chamber, voltage=0.05)
    for s in states:
        assert (s.pressure + 50) * (s.volume + 1600) == pytest.approx((1.886612680245 + 50) * 1602.42, rel=1e-10)
        alone = dj.equilibrium(membrane, voltage=0.05, volume=s.volume, all=True)
        assert min(error(s.pressure, other.pressure) for other in alone) < 1e-9
    landed = dj.equilibrium(chamber, voltage=0.0764953595449 + 1e-9, all=True)
    assert [s.index for s in landed] == [0] and landed[0].volume == pytest.approx(19.9533292542, rel=1e-6)
    for given, words in (
        ({"volume": 2.0}, "`volume` must be left out with a Scene"),
        ({"voltage": -1.0}, "`voltage` must"),
    ):
        with pytest.raises(ValueError, match=words):
            dj.equilibrium(chamber, **given)
    with pytest.raises(dj.SceneError):
        dj.equilibrium(chamber, voltage=5.0)
