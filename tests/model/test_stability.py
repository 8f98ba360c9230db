"""The index of states against eigenvalues of the energy's second variation, by Ritz elements independent of shooting."""

import functools
import json
import pathlib

import jax.numpy as jnp
import numpy as np
import pytest

import dielectric_jax as dj
from benchmarks.truth import extended_precision as truth
from benchmarks.truth import ritz
from benchmarks.truth.ritz import Ritz

REFERENCES = json.loads((pathlib.Path(__file__).parents[1] / "data" / "equilibria.json").read_text(encoding="utf-8"))
HELD = {
    "pressure": dj.ConstantPressure(1.0),
    "chamber": dj.Chamber(volume=1600.0, initial_volume=2.42),
    "volume": dj.PrescribedVolume(1.0),
}


def state_of(ref):
    """A reference as a state."""
    names = ("voltage_squared", "pressure", "volume", "apex_stretch", "height", "charge", "breakdown_ratio")
    return dj.model.State(**{n: ref[n] for n in names}, index=None, error_estimate=1e-12)


@functools.cache
def inflated(prestretch):
    """The reference states of a prestretch that are not folds, and the package's results under every loading."""
    own = [r for r in REFERENCES if r["prestretch"] == prestretch and "fold" not in r["label"]]
    states = [state_of(r) for r in own]
    membrane = dj.Membrane(prestretch=prestretch)
    told = {}
    for held, loading in HELD.items():
        for control in ("voltage", "charge"):
            scene = dj.Scene(membrane, dj.ChargeControl(loading) if control == "charge" else loading)
            told[held, control] = dj.model.stability_of(scene, states)
    return own, states, told


@pytest.mark.parametrize("prestretch", sorted({r["prestretch"] for r in REFERENCES}))
def test_reference_states_have_the_index_of_the_eigenvalues(prestretch):
    """Under three ways to hold the membrane and two controls; and the references' own indices."""
    own, states, told = inflated(prestretch)
    columns = (np.array([getattr(s, n) for s in states]) for n in ("apex_stretch", "pressure", "voltage_squared"))
    matrices = Ritz(*columns, np.full(len(states), 270.0))
    assert np.abs(matrices.rim - prestretch).max() < 1e-7
    stiffness = np.array([(s.pressure + 50.0) / (s.volume + 1600.0) for s in states])
    for (held, control), answers in told.items():
        index, least = matrices.index(
            stiffness=stiffness if held == "chamber" else None,
            held_volume=held == "volume",
            charged=control == "charge",
        )
        assert (least > 1e-9).all()
        assert [a.index for a in answers] == index.tolist(), (held, control)
        assert all(a.valid and a.reasons == () for a in answers)
    for ref, answer in zip(own, told["pressure", "voltage"], strict=True):
        if "index_prescribed_pressure" in ref:
            assert answer.index == ref["index_prescribed_pressure"], ref["label"]
        assert answer.hoop_tension == pytest.approx(ref["min_sigma2"], abs=1e-7)
        assert answer.meridional_tension == pytest.approx(ref["min_sigma1"], abs=1e-5) and answer.tangent_modulus > 0


def test_a_constraint_takes_at_most_one_from_the_index():
    """Index of the chamber and the held volume from that of the pressure, and of the charge from the voltage where q ≥ 0."""
    _, states, told = inflated(1.0)
    index = {name: np.array([a.index for a in answers]) for name, answers in told.items()}
    reached = np.array([s.voltage_squared >= 0 for s in states])
    for control in ("voltage", "charge"):
        taken = [index["pressure", control] - index[held, control] for held in ("chamber", "volume")]
        assert all(set(t) <= {0, 1} for t in taken) and (taken[0] <= taken[1]).all() and taken[1].any()
    for held in HELD:
        taken = index[held, "voltage"] - index[held, "charge"]
        assert set(taken[reached]) <= {0, 1}


def test_between_the_folds_of_voltage_and_charge_only_the_charge_holds_the_state(membrane):
    """At p = 1.82 and Φ = 0.1: V beyond the fold of Φ at 2.7028 but below that of Q at 3.7996."""
    state = dj.equilibrium(membrane, voltage=0.1, pressure=1.82, all=True)[1]
    assert 2.7028 < state.volume < 3.7996
    held = dj.ConstantPressure(1.82)
    scenes = dj.Scene(membrane, held), dj.Scene(membrane, dj.ChargeControl(held))
    assert [dj.model.stability_of(scene, state).index for scene in scenes] == [1, 0]


def test_where_hoop_tension_is_lost_and_how_deep(membrane):
    """V = 10 is wrinkled at Φ = 0.16: at the least of σ2 along a profile from equations written by hand."""
    state = dj.equilibrium(membrane, voltage=0.05, volume=2.42)
    assert not dj.model.stability_of(membrane, state).wrinkled and state.flags == ()
    wrinkled = dj.equilibrium(membrane, voltage=0.16, volume=10.0)
    assert wrinkled.flags == ("hoop_tension_lost",)
    told = dj.model.stability_of(membrane, wrinkled)
    here = told.hoop_tension_radius
    radius = np.concatenate([np.geomspace(1e-3, here - 2e-3, 200), np.linspace(here - 1e-3, min(here + 1e-3, 1.0), 41)])
    radius = np.append(radius, np.linspace(min(here + 2e-3, 1.0), 1.0, 50))[:, None]
    given = (np.array([v]) for v in (wrinkled.apex_stretch, wrinkled.pressure, wrinkled.voltage_squared, 270.0))
    apex, p, q, limit = given
    l1, l2, _ = ritz.profile(apex, p, q, limit, radius)
    hoop = (l2 * truth.gent(l1, l2, q, limit)[1])[:, 0]
    assert told.wrinkled and 0 < here < 1
    assert hoop.min() == pytest.approx(told.hoop_tension, rel=1e-5)
    assert radius[np.argmin(hoop), 0] == pytest.approx(here, abs=1e-4)


def test_beside_a_fold_the_index_changes_or_is_not_told(membrane):
    """A little below the peak of p the two states have indices 0 and 1; at the peak none is reported."""
    below = dj.equilibrium(membrane, pressure=1.908684829414 - 1e-6, all=True)[:2]
    assert [a.index for a in dj.model.stability_of(membrane, below)] == [0, 1]
    peak = next(r for r in REFERENCES if r["label"].startswith("lam0=1 Phi=0 fold_p"))
    told = dj.model.stability_of(membrane, state_of(peak))
    assert told.index is None and told.reasons == ("near_fold",) and told.stable is None
    # the fold of the pressure is not a fold at held volume
    assert dj.model.stability_of(dj.Scene(membrane, dj.PrescribedVolume(peak["volume"])), state_of(peak)).index == 0


def test_a_material_that_loses_ellipticity_has_no_index():
    """W = log(1 + (I − 3)/2) softens: ∂s1/∂λ1 < 0 at equal stretches of 3, where the tension is positive."""

    def energy(l1, l2):
        return jnp.log1p((l1**2 + l2**2 + 1 / (l1 * l2) ** 2 - 3) / 2)

    # with g = 1 + (I − 3)/2 and I_1 = 2λ − 2λ⁻⁵: s1 = I_1/(2g), ∂s1/∂λ1 = (1 + 3λ⁻⁶)/g − I_1²/(4g²)
    stretch = 3.0
    g = 1 + (2 * stretch**2 + stretch**-4 - 3) / 2
    slope = (1 + 3 * stretch**-6) / g - (2 * stretch - 2 * stretch**-5) ** 2 / (4 * g**2)
    film = dj.Membrane(dj.CustomMaterial(energy, largest_stretch=6.0), prestretch=stretch)
    told = dj.model.stability_of(film, dj.equilibrium(film, pressure=0.0))
    assert told.tangent_modulus == pytest.approx(slope, rel=1e-12)
    assert (told.index, told.reasons) == ((0, ()) if slope > 0 else (None, ("not_elliptic",)))


def test_what_is_no_state_is_refused(membrane):
    state = dj.equilibrium(membrane, volume=2.42)
    with pytest.raises(ValueError, match=r"^`what` must be a Scene or a Membrane, but is a float"):
        dj.model.stability_of(1.0, state)
    with pytest.raises(ValueError, match=r"^`state` must be a State or a sequence of them, but holds a float"):
        dj.model.stability_of(membrane, [1.0])
    with pytest.raises(ValueError, match=r"^`state` must be an equilibrium of the membrane, but is "):
        dj.model.stability_of(dj.Membrane(prestretch=1.5), state)
