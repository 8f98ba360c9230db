"""All methods agree: whole diagrams, batches, surfaces, `glance`, sweeps, and designs."""

import dataclasses

import jax
import numpy as np
import pytest

import dielectric_jax as dj
from benchmarks.acceptance.one_answer import OPEN, asked_in_every_way, disagree
from dielectric_jax.diagram import landings
from dielectric_jax.model.outcomes import FoldAhead

FILM = dj.Membrane()
WEAK = dj.Membrane(breakdown=dj.VHBBreakdown(scale=0.6))
LONG = dj.Membrane(dj.Gent(1000.0))
#: scenes of one membrane, and their regimes by whole diagrams whose scan and continuation agree
KNOWN = {
    "constant pressure (the article's p = 1.5 and 1.82)": (
        FILM,
        [dj.ConstantPressure(p) for p in (1.0, 1.5, 1.82)],
        "breaks_in_snap",
    ),
    "folds far beyond breakdown": (
        WEAK,
        [dj.Chamber(30.0, initial_volume=2.42), dj.Chamber(1600.0, initial_volume=1.0)],
        "breaks_before_snap",
    ),
    "no fold, out of the scanned window near lock-up": (
        FILM,
        [dj.Chamber(v, initial_volume=2.42) for v in (500.0, 540.0)],
        "no_snap",
    ),
    "one filling by its volume and by its pressure": (
        LONG,
        [dj.Chamber(1600.0, initial_volume=0.39341), dj.Chamber(1600.0, initial_pressure=0.16102)],
        "no_landing",
    ),
    "a landing far beyond breakdown at constant pressure": (
        dj.Membrane(dj.Gent(62.687503857134026), prestretch=1.0849328050268596),
        [dj.ConstantPressure(0.9752243273441074)],
        "breaks_in_snap",
    ),
    "a landing far beyond breakdown in thin air": (
        dj.Membrane(dj.Gent(715.7061), prestretch=1.4787481941835363),
        [
            dj.Chamber(
                97.82297287790955,
                initial_volume=5.537551738285317,
                atmospheric_pressure=2.6525559897607796,
                polytropic_exponent=1.2,
            )
        ],
        "breaks_in_snap",
    ),
    "a stiff chamber filled past the peak": (
        FILM,
        [dj.Chamber(0.02, initial_volume=3.3)],
        "no_landing",
    ),
    "a stiff chamber filled past the peak, whose snap ends beyond a gap of the window": (
        FILM,
        [dj.Chamber(0.02, initial_volume=3.8)],
        "breaks_in_snap",
    ),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_scenes(name):
    membrane, loadings, regime = KNOWN[name]
    for answers in asked_in_every_way([dj.Scene(membrane, x) for x in loadings], lambda _: True):
        told = {way: answer["regime"] for way, answer in answers.items()}
        assert set(told.values()) <= {regime, OPEN}, told
        assert not disagree(answers)
        # the methods that decide every scene here
        assert told["designs"] == told["batch"] == told["diagram"] == regime


def test_a_hole_in_the_scan_leaves_a_landing_undecided(monkeypatch):
    """Where the scan lacks states beyond the fold, "no landing" cannot be concluded from it."""
    scene = dj.Scene(FILM, dj.Chamber(0.02, initial_volume=3.3))
    assert dj.continue_scenes([scene]).ramps.regime[0] == dj.Regime.no_landing
    whole = landings.cached_scan

    def holed(*args):
        found = whole(*args)
        pressure = found.pressure.copy()
        pressure[np.abs(found.apex_stretch - 5.0) < 0.5] = np.nan
        return dataclasses.replace(found, pressure=pressure)

    monkeypatch.setattr(landings, "cached_scan", holed)
    assert dj.continue_scenes([scene]).ramps.regime[0] == dj.Regime.not_decided


def test_folds_ahead_at_the_edge_of_the_scanned_window():
    """Beyond breakdown q rises to t = 0.9 in one chamber; in the other it turns at (4.04913, 0.0766374), just below t = 0.9.

    The whole diagrams find no fold in the first and this one in the second. The scan may leave it undecided.
    """
    film = dj.Membrane(dj.MooneyRivlin(0.48657263734491984, 0.013427362655080164), prestretch=3.540484634974085)
    rises = dj.Chamber(2211.1113246424216, initial_volume=845.2864959398862, atmospheric_pressure=0.7439809064967118)
    turns = dj.Chamber(0.03664242222346344, initial_volume=13.25914356408783, atmospheric_pressure=411.1249344921527)
    # p_0 of each filling, and (λa, q) at breakdown
    for air, pressure, apex, load, known in (
        (rises, 1.704619351616183, 13.270896, 0.037641629**2, {FoldAhead.none}),
        (turns, 0.2716179262155624, 4.029230, 0.0766268942, {FoldAhead.fold, FoldAhead.unknown}),
    ):
        condition = jax.tree.map(np.atleast_1d, air.condition(pressure, air.initial_volume))
        found = landings.folds_ahead(film, condition, np.array([apex]), np.array([load]))
        assert FoldAhead(found[0]) in known


def test_a_start_held_by_a_stiff_chamber_and_a_fold_beyond_the_window():
    """V_0 = 3.857 lies past the peak of the pressure at V = 2.797; the closed air stabilises the membrane, which snaps at Φ = 0.18624058."""
    film = dj.Membrane(dj.MooneyRivlin(0.7102170416433428, 0.00034138315149295594))
    held = dj.Chamber(0.027916957086637915, initial_volume=3.856810870609954)
    wide = dj.Membrane(dj.MooneyRivlin(0.49547546028692446, 0.004524539713075538))
    air = dj.Chamber(3620.636095992601, initial_volume=4.229750153290371, atmospheric_pressure=192.54469712026233)
    ramps = dj.continue_scenes([dj.Scene(film, held), dj.Scene(wide, air)]).ramps
    assert dj.Regime(int(ramps.regime[0])) is dj.Regime.no_landing
    # a fold at λa = 12.97 lies beyond the window, which ends at 12
    assert dj.Regime(int(ramps.regime[1])) is dj.Regime.no_snap
    assert abs(ramps.snap.voltage[0, 0] - 0.18624058) < 1e-8
    # at constant pressure the same state is unstable
    pressure = float(ramps.start.pressure[0])
    state = dj.equilibrium(film, volume=3.856810870609954)
    assert abs(state.pressure / pressure - 1) < 1e-9
    assert dj.model.stability_of(dj.Scene(film, dj.ConstantPressure(pressure)), state).index == 1
    assert dj.model.stability_of(dj.Scene(film, held), state).index == 0
