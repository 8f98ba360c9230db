"""Curves of folds and breakdown over a parameter: known cusps, the surface, and mergers as saddles of the manifold."""

import json

import jax
import matplotlib
import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.critical import fold_continuation

matplotlib.use("Agg")


def chamber(volume=1600.0):
    return dj.Scene(dj.Membrane(), dj.Chamber(volume=volume, initial_volume=2.42))


@pytest.fixture(scope="module")
def over_volume():
    return dj.fold_curves(chamber(), "chamber_volume", (400.0, 3000.0), samples=3)


@pytest.fixture(scope="module")
def over_pressure():
    scene = dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0))
    return dj.fold_curves(scene, "pressure", (1.3, 1.5), samples=3)


def test_cusps_and_the_onset_of_bistability(over_volume):
    assert over_volume.complete, over_volume.doubts
    cusps = [p for p in over_volume.named("cusp") if p.breakdown_ratio < 1]
    # as `cusp` finds them, by the second derivatives of the shot
    for found, known in zip(cusps, (484.049660366, 551.399141264), strict=True):
        assert abs(found.parameter / known - 1) < 1e-11
    (rest,) = over_volume.named("zero_voltage")
    assert rest.voltage == 0 and abs(rest.parameter / 1455.896262454 - 1) < 1e-11


def test_every_point_is_a_fold_or_a_breakdown_of_its_chamber(over_volume):
    """The ramp on the surface computes the folds and breakdowns of chambers by other means."""
    surface = dj.Surface.build(dj.Membrane())
    compared = 0
    for curve in over_volume.curves:
        ramps = dj.diagram.chamber_ramps(surface, curve.parameter, 2.42)
        points = ramps.folds if curve.kind == "fold" else ramps.breakdowns
        for k in range(len(curve.parameter)):
            away = np.nan_to_num(np.abs(points.apex_stretch[k] - curve.apex_stretch[k]), nan=np.inf)
            if curve.breakdown_ratio[k] > 1.1 or not away.min() < 1e-4:
                continue  # beyond what the rows hold, or two folds that merge
            near = int(np.argmin(away))
            compared += 1
            assert abs(points.voltage[k, near] ** 2 - curve.voltage[k] ** 2) < 1e-11
            assert abs(points.volume[k, near] / curve.volume[k] - 1) < 1e-7
    assert compared > 60
    assert max(curve.error_estimate.max() for curve in over_volume.curves) < 1e-9


def test_a_merger_is_a_stationary_point_of_the_pressure_on_the_sheet(over_pressure):
    """At constant pressure branches are contours of p(λa, q): they touch where both its derivatives vanish."""
    assert over_pressure.complete, over_pressure.doubts
    (merger,) = over_pressure.named("merger")
    surface = dj.Surface.build(dj.Membrane())
    at = merger.apex_stretch, merger.voltage**2
    assert abs(float(surface(*at).pressure) - merger.pressure) < 1e-11
    by_apex, by_load = jax.grad(lambda a, q: surface(a, q).pressure, (0, 1))(*at)
    assert abs(float(by_apex)) < 1e-7 and abs(float(by_load)) < 1e-5
    # a saddle: two branches cross there, and beyond it they are joined differently
    (aa, aq), (_, qq) = jax.hessian(lambda x: surface(x[0], x[1]).pressure)(np.array(at))
    assert aa * qq < aq**2
    # the valley of the p–V curve at zero voltage
    (rest,) = over_pressure.named("zero_voltage")
    assert abs(rest.pressure - 1.361703319141) < 2e-12 and abs(rest.parameter - rest.pressure) < 1e-14


def test_folds_of_the_pressure_over_the_prestretch():
    held = dj.Scene(dj.Membrane(), dj.ConstantVoltage(0.0))
    found = dj.fold_curves(held, "prestretch", (1.9, 2.2), samples=2)
    assert found.complete and found.control == "pressure"
    (cusp,) = found.named("cusp")
    assert abs(cusp.parameter - 2.110288) < 5e-7
    assert not [c for c in found.curves if c.kind == "breakdown"]


def test_one_cusp_in_two_planes():
    """Where peak and valley of p merge at a voltage, so do the folds of the voltage at that pressure: one state."""
    held = dj.Scene(dj.Membrane(), dj.ConstantPressure(1.0))
    found = dj.fold_curves(held, "prestretch", (2.1, 2.3), kinds=("fold",), samples=2)
    (cusp,) = found.named("cusp")
    other = dj.critical.pressure_cusp(dj.Membrane(), cusp.voltage, within=(2.0, 2.4))
    assert abs(float(other.parameter) / cusp.parameter - 1) < 1e-10
    assert abs(float(other.pressure) - 1) < 1e-10


def test_breakdown_turns_where_its_law_does():
    """The law of VHB has a kink at λ = 5.684; the curve of breakdown has a corner there, and continues."""
    found = dj.fold_curves(chamber(), "stretch_limit", (90.0, 100.0), kinds=("breakdown",), samples=2)
    (curve,) = found.curves
    assert found.complete and set(curve.ends) == {"lower_bound", "upper_bound"}
    assert curve.apex_stretch.min() < 5.684 < curve.apex_stretch.max()
    law = dj.VHBBreakdown()
    for apex, voltage in zip(curve.apex_stretch, curve.voltage, strict=True):
        assert abs(voltage * apex**2 / float(law.field(apex)) - 1) < 1e-12


def test_the_record_and_the_figure(over_volume):
    record = json.loads(json.dumps(over_volume.to_dict(), allow_nan=False))
    assert record["complete"] and {c["kind"] for c in record["curves"]} == {"fold", "breakdown"}
    ax = over_volume.plot()
    named = {text.get_text() for text in ax.get_legend().get_texts()}
    assert {"folds", "electric breakdown", "cusp", "fold at zero voltage"} <= named
    assert ax.get_xlim() == (400.0, 3000.0) and "Chamber volume" in ax.get_xlabel()
    matplotlib.pyplot.close(ax.figure)


def test_a_fold_at_breakdown_lies_on_both_curves(over_volume):
    (crossing,) = over_volume.named("fold_at_breakdown")
    law = dj.VHBBreakdown()
    assert abs(crossing.voltage * crossing.apex_stretch**2 / float(law.field(crossing.apex_stretch)) - 1) < 1e-9
    diagram = dj.voltage_volume(chamber(crossing.parameter))
    fold, broken = (
        min((p for p in diagram.special_points if p.kind == kind), key=lambda p: abs(p.volume - crossing.volume))
        for kind in ("fold", "breakdown")
    )
    for p in (fold, broken):
        assert abs(np.sqrt(p.voltage_squared) / crossing.voltage - 1) < 1e-9


def test_the_error_of_a_point_covers_its_parameter_and_its_load(over_pressure, monkeypatch):
    """Against shots of 320 steps everywhere."""
    monkeypatch.setattr(fold_continuation, "GRIDS", ((240.0, 320.0),) * 3)
    scene, within = over_pressure.scene, (1.45, 1.47)
    exact = dj.fold_curves(scene, "pressure", within, kinds=("fold",), samples=2)
    assert [p.kind for p in exact.points] == ["merger"]
    for other in exact.points:
        point = min(over_pressure.points, key=lambda p: abs(p.parameter - other.parameter))
        assert point.kind == other.kind and point.error_estimate < 1e-11
        assert abs(point.parameter / other.parameter - 1) < point.error_estimate
        assert abs((point.voltage / other.voltage) ** 2 - 1) < point.error_estimate


@pytest.mark.parametrize("steps", [12.0, 24.0])
def test_the_filling_is_of_the_grid_it_is_asked_for(steps):
    """So Newton's step from the coarser grid to the finer one includes the error of the filling on the coarser grid."""
    conditions = fold_continuation.ConditionsOver(chamber(), "chamber_volume")
    coarse, fine = (float(conditions.at(1600.0, s)[0].condition.initial_pressure) for s in (steps, 320.0))
    held = dj.equilibrium(dj.Membrane(), voltage=0.0, volume=2.42, tolerance=1e-12)
    assert abs(fine / float(held.pressure) - 1) < 1e-12
    assert 1e-13 < abs(coarse / fine - 1) < 1e-3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"parameter": "pressure"}, "`pressure` must be a parameter of this scene"),
        ({"within": (2.0, 1.0)}, "`within` must be finite, at most 1e\\+50 in size, with low < high, but is"),
        ({"within": 3.0}, "`within` must be a pair"),
        ({"within": (-5.0, 1.0)}, "must be positive"),
        ({"kinds": ("folds",)}, "`kinds` must hold"),
        ({"samples": 1}, "`samples` must be a whole number"),
        ({"largest_ratio": 3.0}, "`largest_ratio` must lie"),
    ],
)
def test_bad_input_is_told_in_one_sentence(changes, words):
    given = {"parameter": "chamber_volume", "within": (400.0, 800.0)} | changes
    with pytest.raises(ValueError, match=words):
        dj.fold_curves(chamber(), given.pop("parameter"), given.pop("within"), **given)


def test_a_loading_without_folds_of_voltage_or_pressure_is_refused():
    scene = dj.Scene(dj.Membrane(), dj.ChargeControl(dj.ConstantPressure(1.0)))
    with pytest.raises(ValueError, match="`loading` must be a Chamber, a ConstantPressure or a ConstantVoltage"):
        dj.fold_curves(scene, "prestretch", (1.0, 2.0))


def test_a_curve_ends_where_its_filling_does():
    """Up to the peak of p a chamber is filled by a state before it; at higher pressures by one near lock-up."""
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=500.0, initial_pressure=1.8))
    found = dj.fold_curves(scene, "initial_pressure", (1.905, 1.912), kinds=("breakdown",), samples=2)
    assert found.complete, found.doubts
    below, above = sorted(found.curves, key=lambda c: c.parameter.min())
    assert set(below.ends) == {"lower_bound", "no_filling"} and set(above.ends) == {"upper_bound", "no_filling"}
    for curve in (below, above):
        nearest = np.abs(curve.parameter - 1.908684829414).argmin()
        assert abs(curve.parameter[nearest] - 1.908684829414) < 1e-3


def test_folds_over_the_filling_pressure_are_as_exact_as_they_say():
    """The state that fills the chamber moves with p_0: its volume must be as exact as its pressure."""
    scene = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_pressure=1.5))
    found = dj.fold_curves(scene, "initial_pressure", (1.45, 1.5), kinds=("fold",), samples=2)
    curve = min(found.curves, key=lambda c: c.volume.min())
    for i in np.unique(np.linspace(0, len(curve.parameter) - 1, 5).astype(int)):
        own = scene.replace(initial_pressure=float(curve.parameter[i]))
        folds = [p for p in dj.voltage_volume(own, tolerance=1e-11).special_points if p.kind == "fold"]
        fold = min(folds, key=lambda p: abs(p.volume - curve.volume[i]))
        apart = abs(curve.voltage[i] ** 2 - fold.voltage_squared) / max(fold.voltage_squared, 1e-3)
        assert apart <= curve.error_estimate[i] + fold.error_estimate
        assert abs(curve.volume[i] / fold.volume - 1) < 1e-8
