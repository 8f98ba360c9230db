"""Prescribed volume and charge control: diagrams, folds, ramps, against the explicit map, identities and closed forms."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj


@functools.cache
def diagram_of(held, charge=False, prestretch=1.0):
    """The diagram of "pressure 1.82", "chamber 1600" or "volume 2.42"."""
    name, value = held.split()
    loading = {
        "pressure": lambda v: dj.ConstantPressure(v),
        "chamber": lambda v: dj.Chamber(volume=v, initial_volume=2.42),
        "volume": lambda v: dj.PrescribedVolume(v),
    }[name](float(value))
    loading = dj.ChargeControl(loading) if charge else loading
    return dj.voltage_volume(dj.Scene(dj.Membrane(prestretch=prestretch), loading))


@jax.jit
def mapped(apex, q):
    """p, V, C of the paper's membrane by the explicit map, which shoots in another variable."""
    p, v, _, (_, charge, _) = dj.model.explicit_map(dj.Gent(), apex, q, 1.0, 160.0, outputs=True)
    return jnp.stack([p, v, charge])


def turning_point(condition, control, near, reach, load):
    """The extreme of `control(q, p, V, C)` where condition(p, V) = 0, from Chebyshev nodes in λa: λa and the control."""
    nodes = near + reach * np.cos(np.pi * (np.arange(10) + 0.5) / 10)
    before, q = np.full(10, 0.99 * load), np.full(10, 1.0 * load)
    wrong = condition(*mapped(nodes, before)[:2])
    for _ in range(7):  # the secant method, all nodes at once
        now = condition(*mapped(nodes, q)[:2])
        gap = now - wrong
        move = np.where(gap == 0, 0.0, -now * (q - before) / np.where(gap == 0, 1.0, gap))
        before, wrong, q = q, now, q + move
    assert np.abs(move).max() < 1e-13
    values = control(q, *mapped(nodes, q))
    fit = np.polynomial.Chebyshev.fit(nodes, values, 9, domain=(near - reach, near + reach))
    (root,) = [r.real for r in fit.deriv().roots() if abs(r.imag) < 1e-9 and abs(r.real - near) < reach]
    return root, fit(root)


FOLDS = {
    "charge at pressure 1.82": ("pressure 1.82", True, lambda p, v: p - 1.82),
    "charge in chamber 1600": ("chamber 1600", True, lambda p, v: (p + 50) * (v + 1600) / 51.886612680245 - 1602.42),
    "voltage at volume 2.42": ("volume 2.42", False, lambda p, v: v - 2.42),
    "charge at volume 2.42": ("volume 2.42", True, lambda p, v: v - 2.42),
}


@pytest.mark.parametrize("name", FOLDS)
def test_the_first_fold_is_where_the_explicit_map_turns(name):
    held, charge, condition = FOLDS[name]
    diagram = diagram_of(held, charge)
    fold = diagram.ramp()["snap"][0].state
    control = (lambda q, p, v, c: np.sqrt(q) * c) if charge else (lambda q, p, v, c: np.sqrt(q))
    apex, value = turning_point(condition, control, fold.apex_stretch + 0.003, 0.05, fold.voltage_squared)
    assert (fold.charge if charge else fold.voltage) == pytest.approx(value, rel=2e-9)
    assert fold.apex_stretch == pytest.approx(apex, rel=1e-6)
    assert fold.index is None and fold.error_estimate <= 1e-9


@pytest.mark.parametrize("held", ["pressure 1.82", "chamber 1600"])
def test_charge_control_draws_the_same_branches(held):
    """The same contour on the chart, so the same zero-voltage states, breakdown and loss of hoop tension, but other folds."""
    voltage, charge = diagram_of(held), diagram_of(held, True)
    assert voltage.complete and charge.complete and len(voltage.branches) == len(charge.branches)
    assert (voltage.control, charge.control) == ("voltage", "charge")

    def places(diagram, kinds):
        return [(p.voltage_squared, p.volume) for p in diagram.special_points if (p.kind == "fold") == kinds]

    np.testing.assert_allclose(places(voltage, False), places(charge, False), rtol=1e-9, atol=1e-12)
    folds = places(voltage, True), places(charge, True)
    assert len(folds[0]) == len(folds[1]) == 2
    # dQ = C dΦ + Φ dC with dC > 0: the charge turns later than the voltage
    assert all(b[1] > a[1] for a, b in zip(*folds, strict=True))


@pytest.mark.parametrize("held", ["pressure 1.82", "chamber 1600", "volume 2.42"])
def test_the_index_changes_at_the_folds_of_the_control_only(held):
    for charge in (False, True):
        diagram = diagram_of(held, charge)
        for number, branch in enumerate(diagram.branches):
            folds = sorted(p.position for p in diagram.special_points if p.branch == number and p.kind == "fold")
            changes = int(np.count_nonzero(np.diff(branch.index)))
            assert changes == len(folds)


def test_a_charge_ramp_averts_the_breakdown_of_the_snap():
    """At p = 1.82 the voltage's snap breaks down; at the charge of its fold the membrane lands near zero voltage."""
    diagram = diagram_of("pressure 1.82", True)
    up, down = diagram.ramp(), diagram.ramp("down")
    assert [e.event for e in up.events] == ["start", "snap", "landing", "breakdown"]
    snap, landing, end = (e.state for e in up.events[1:])
    assert landing.charge == pytest.approx(snap.charge, rel=1e-9) and landing.index == 0
    assert up.area_strain_reason == "breakdown on the branch"
    assert end.voltage == pytest.approx(0.060710571841, rel=1e-9)
    assert diagram_of("pressure 1.82").area_strain_reason == "breakdown in the snap"
    # halfway in charge, then to the snapped state at zero voltage
    assert down.events[0].state.charge == pytest.approx((landing.charge + end.charge) / 2, rel=1e-9)
    assert down.events[-1].state.volume == pytest.approx(210.518696044, rel=1e-9)
    again = diagram.ramp("down", start=landing)
    assert again.events[-1].state.volume == pytest.approx(210.518696044, rel=1e-9)


def test_a_chamber_that_snaps_by_voltage_does_not_by_charge(chamber):
    """V_C = 800: Q grows all along the branch, up to the breakdown that the voltage finds after its snap."""
    diagram = diagram_of("chamber 800", True)
    assert [e.event for e in diagram.ramp().events] == ["start", "breakdown"]
    assert diagram.ramp().events[-1].state.voltage == pytest.approx(0.115172761046, rel=1e-9)
    branch = diagram.branches[0]
    held = (branch.voltage_squared >= 0) & (branch.breakdown_ratio < 1)
    assert (branch.index[held] == 0).all() and chamber(800.0).branches[0].index.max() == 1
    document = diagram.to_json()
    assert document["control"] == document["scene"]["control"] == "charge"
    assert [e["charge"] for e in document["ramp"]] == [e.state.charge for e in diagram.events]
    assert not any(p["kind"] == "fold" for p in document["special_points"])


def test_a_prescribed_volume_is_kept():
    """V = 2.42 on every branch; at zero voltage p_0 is that of the model, λa 1.95822343926."""
    diagram = diagram_of("volume 2.42")
    start = diagram.ramp().events[0].state
    assert start.pressure == pytest.approx(1.886612680245, rel=1e-9)
    assert start.apex_stretch == pytest.approx(1.95822343926, rel=1e-9)
    assert all(np.abs(b.volume / 2.42 - 1).max() < 1e-9 for b in diagram.branches)
    assert [e.event for e in diagram.ramp().events] == ["start", "snap", "no_landing"]


def test_energy_at_a_held_volume_falls_by_the_charge():
    """dU = p dV − Q dΦ along a branch of constant V, by a polynomial through nine of its states."""
    diagram = diagram_of("volume 2.42")
    branch = diagram.branches[0]
    first = int(np.argmax(branch.voltage > 0.1))
    near = slice(first, first + 9)
    membrane = diagram.scene.membrane
    energies = [
        dj.model.energy(membrane, dj.profile(membrane, dj.equilibrium(membrane, voltage=v, apex_stretch=a)))
        for v, a in zip(branch.voltage[near], branch.apex_stretch[near], strict=True)
    ]
    fit = np.polynomial.Polynomial.fit(branch.voltage[near], energies, 8)
    assert fit.deriv()(branch.voltage[first + 4]) == pytest.approx(-branch.charge[first + 4], rel=1e-6)


def test_a_flat_film_is_charged_in_proportion():
    """p = 0 or V = 0, λ0 = 2: C = π λ0⁴, so the charge of breakdown is C E_EB/λ0², with no fold before."""
    film = dj.Membrane(prestretch=2.0)
    for held in (dj.ConstantPressure(0.0), dj.PrescribedVolume(0.0)):
        diagram = dj.voltage_volume(dj.Scene(film, dj.ChargeControl(held)))
        (branch,) = diagram.branches
        reached = branch.voltage_squared >= 0
        np.testing.assert_allclose(branch.charge[reached], 16 * math.pi * branch.voltage[reached], rtol=1e-13)
        assert [p.kind for p in diagram.special_points] == ["zero_voltage", "breakdown", "slack"] or [
            p.kind for p in diagram.special_points
        ] == ["zero_voltage", "slack"]
        assert diagram.to_json()["ramp"][0]["charge"] == 0.0
    with pytest.raises(dj.SceneError):
        dj.voltage_volume(dj.Scene(dj.Membrane(), dj.PrescribedVolume(0.0)))


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: dj.PrescribedVolume(-1.0), "`volume` must be"),
        (lambda: dj.ChargeControl(dj.ConstantVoltage(0.1)), "`loading` of a ChargeControl must be"),
        (lambda: dj.ChargeControl(dj.ChargeControl(dj.ConstantPressure(1.0))), "`loading` of a ChargeControl must be"),
        (lambda: dj.voltage_volume(dj.Scene(dj.Membrane(), dj.PrescribedVolume(600.0))), "`volume` must lie between"),
        (lambda: dj.continue_scenes([dj.Scene(dj.Membrane(), dj.PrescribedVolume(2.0))]), "`scenes` must be"),
        (
            lambda: dj.continue_scenes([dj.Scene(dj.Membrane(), dj.ChargeControl(dj.ConstantPressure(1.0)))]),
            "`scenes` must be",
        ),
        (
            lambda: dj.Scene(dj.Membrane(), dj.PrescribedVolume(2.0)).replace(chamber_volume=3.0),
            "`chamber_volume` must be a parameter of this scene",
        ),
        (
            lambda: dj.Scene(dj.Membrane(), dj.Chamber(9.0, initial_volume=1.0)).replace(volume=3.0),
            "`volume` must be a parameter of this scene",
        ),
    ],
)
def test_what_is_refused(build, said):
    with pytest.raises(ValueError, match=f"^{said}"):
        build()


def test_parameters_are_replaced_inside_charge_control():
    scene = dj.Scene(dj.Membrane(), dj.ChargeControl(dj.Chamber(volume=1600.0, initial_volume=2.42)))
    other = scene.replace(chamber_volume=800.0, initial_pressure=1.5)
    assert isinstance(other.loading, dj.ChargeControl)
    assert dj.model.describe(other)["chamber_volume"] == 800.0 and dj.model.describe(other)["control"] == "charge"
    assert "initial_volume" not in dj.model.describe(other)
    assert dj.model.describe(dj.Scene(dj.Membrane(), dj.PrescribedVolume(2.0)).replace(volume=3.0))["volume"] == 3.0
