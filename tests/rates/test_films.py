"""Homogeneous films in time against closed forms, quadratures and reference numbers."""

import json
import pathlib
import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import dielectric_jax as dj
from dielectric_jax import rates
from dielectric_jax.model import Maxwell, NeoHookean, Viscoelastic

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "rates.json").read_text(encoding="utf-8"))
G, TAU = 42 / 18, 1.0
VHB = Viscoelastic(dj.Gent(110.0), [Maxwell(dj.Gent(55.0), G, TAU)])
RUBBER = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), modulus_ratio=1.0, relaxation_time=2.0)])
TOLERANCE = 1e-12


def pulled_in(run: rates.FilmRun) -> rates.FilmEvent:
    """The event at which a run has ended."""
    event = run.event("pull_in")
    assert event is not None and run.reason == "pull-in"
    assert run.events[-1].time == event.time
    return event


def items(kind: str) -> list[dict]:
    found = [item for item in REFERENCE["items"] if item["kind"] == kind]
    assert found
    return found


def check(found, known: dict) -> None:
    """A number to the digits of its reference less one."""
    assert found == pytest.approx(known["value"], rel=10 ** (1 - known["digits"]))


def gent(limit: float, stretch: float) -> float:
    """T of an equal-biaxial Gent film."""
    i1 = 2 * stretch**2 + stretch**-4 - 3
    return (stretch**2 - stretch**-4) / (1 - i1 / limit)


def relaxation(b: float) -> float:
    """F of F(b) − F(b0) = −t/(3τ), b = λe² of an equal-biaxial neo-Hookean branch."""
    return np.log(b - 1) / 3 - np.log(b * b + b + 1) / 6 + np.arctan((2 * b + 1) / np.sqrt(3)) / np.sqrt(3)


def root(function, low: float, high: float) -> float:
    """The root of a function between two numbers, to rounding."""
    return typing.cast(float, brentq(function, low, high, xtol=1e-15))


def relaxed_after(time: float) -> float:
    """b after a time in units of τ, at the held stretch 2."""
    return root(lambda v: relaxation(v) - relaxation(4.0) + time / 3, 1 + 1e-12, 4.0 + 1e-12)


def test_equal_biaxial_relaxation():
    """The closed form at six times, and the two numbers of one relaxation time."""
    times = np.array([0.0, 0.02, 0.2, 2.0, 8.0, 20.0])
    run = rates.follow_film(RUBBER, stretch=2.0, times=times, tolerance=TOLERANCE)
    b = (2.0 / run.dashpots[:, 0, 0]) ** 2
    assert b == pytest.approx([relaxed_after(t / 2) for t in times], rel=1e-10)
    assert b[3] == pytest.approx(1.79387544039, rel=1e-11)
    # beside the spring's λ² − λ⁻⁴
    assert 2 * run.stress[3] - (4 - 2**-4) == pytest.approx(1.48312236750, rel=1e-10)
    assert run.error_estimate < 1e-11
    assert run.reason == "end of the protocol"


def test_uniaxial_relaxation():
    """dλe/dt = −(λe³ − 1)/(3τ) by quadrature; the film is as thin as it is narrow."""
    times = [0.0, 0.3, 3.0]
    run = rates.follow_film(RUBBER, stretch=3.0, mode="uniaxial", times=times, tolerance=TOLERANCE)
    own = 3.0 / run.dashpots[:, 0, 0]
    assert [quad(lambda v: 6 / (v**3 - 1), e, 3.0, epsabs=1e-13)[0] for e in own] == pytest.approx(times, abs=1e-10)
    assert run.transverse_stretch == pytest.approx(3.0**-0.5, rel=1e-14)
    stress = (9 - 1 / 3 + own**2 - 1 / own) / 3
    assert run.stress == pytest.approx(stress, rel=1e-11)


def test_loops_of_the_stretch():
    """Loading and unloading in pure shear, with the equations written out, in another integrator; the loop takes energy."""
    run = rates.follow_film(RUBBER, stretch=rates.Triangle(1.0, 2.5, 1.2, rate=0.5), mode="pure_shear", tolerance=1e-10)

    def flow(t, x):
        stretch = min(1 + 0.5 * t, 4.0 - 0.5 * t)
        a, b = (stretch * np.exp(-x[0])) ** 2, np.exp(-2 * x[1])
        t1, t2 = a - 1 / (a * b), b - 1 / (a * b)
        return [(t1 - t2 / 2) / 6, (t2 - t1 / 2) / 6]

    x = np.zeros(2)
    for begin, end in ((0.0, 3.0), (3.0, 5.6)):
        x = solve_ivp(flow, (begin, end), x, rtol=1e-11, atol=1e-12).y[:, -1]
    assert run.time[-1] == pytest.approx(5.6, rel=1e-15)
    assert np.log(run.dashpots[-1, 0]) == pytest.approx(x, rel=1e-8)
    assert np.trapezoid(run.stress, run.stretch) > 0.5
    # a film that has no time to relax, and one that has
    assert (run.stress[1] / (run.stretch[1] - run.stretch[1] ** -3)) == pytest.approx(2.0, rel=0.01)


def creep_time(force: float, q: float, begin: float, end: float, power: int = 1, share: float = 1.0) -> float:
    """t = 6τ ∫ (d ln ξ/dλ)/T dλ of the film VHB, T = (s λ + q λ⁴ − T_eq)/g and λ/ξ its inverse."""

    def branch(stretch):
        return (share * force * stretch**power + q * stretch**4 - gent(110.0, stretch)) / G

    def own(stretch):
        t = branch(stretch)
        return root(lambda e: gent(55.0, e) - t, 1.0, 5.2)

    def speed(stretch):
        h = 1e-4 * stretch
        logs = [np.log((stretch + k * h) / own(stretch + k * h)) for k in (-2, -1, 1, 2)]
        return 6 * TAU * (logs[0] - 8 * logs[1] + 8 * logs[2] - logs[3]) / (12 * h) / branch(stretch)

    return quad(speed, begin, end, epsabs=1e-12, epsrel=1e-11)[0]


@pytest.mark.parametrize("item", items("film_creep"), ids=lambda i: str(i["scene"]))
def test_creep(item):
    """Stretches at once, after a time, and at rest, of films that hold the voltage."""
    known, given = item["result"], item["scene"]
    times = [0.0, known["time"]["value"], 300.0]
    run = rates.follow_film(VHB, force=given["dead_load"], voltage=given["voltage"], times=times, tolerance=TOLERANCE)
    check(run.stretch[0], known["stretch_0plus"])
    check(run.stretch[1], known["stretch"])
    check(run.stretch[2], known["stretch_equilibrium"])
    assert run.reason == "end of the protocol"


@pytest.mark.parametrize("item", items("film_delayed_pull_in"), ids=lambda i: str(i["scene"]))
def test_delayed_pull_in(item):
    """When a film under too high a voltage pulls in, and where; at rest it would be at a lower voltage."""
    known, force, voltage = item["result"], item["scene"]["dead_load"], item["scene"]["voltage"]
    run = rates.follow_film(VHB, force=force, voltage=voltage, duration=100.0, times=[0.0, 1.0], tolerance=TOLERANCE)
    event = pulled_in(run)
    assert run.time[-1] == event.time
    check(run.stretch[0], known["stretch_0plus"])
    check(event.stretch, known["instantaneous_fold_stretch"])
    check(event.time, known["delay"])
    alone = rates.pull_in(VHB, force=force, voltage=voltage, duration=100.0, tolerance=TOLERANCE)
    check(alone.time, known["delay"])
    at_rest = rates.follow_film(dj.Gent(110.0), force=force, voltage=1.0, duration=1.0, tolerance=TOLERANCE)
    assert (at_rest.reason, at_rest.events[-1].time) == ("pull-in", 0.0)
    check(pulled_in(at_rest).voltage, known["equilibrium_pull_in_voltage"])


def test_a_balloon():
    """Under a pressure and a voltage a balloon creeps to its instability, by the quadrature."""
    moments = [0.0, 1.0, 2.0]
    run = rates.follow_film(VHB, pressure=2.0, voltage=0.3, duration=50.0, times=moments, tolerance=TOLERANCE)
    begin, end = run.stretch[:2]
    assert creep_time(2.0, 0.09, begin, end, 3, 0.5) == pytest.approx(1.0, rel=1e-8)
    event = pulled_in(run)
    assert creep_time(2.0, 0.09, begin, event.stretch, 3, 0.5) == pytest.approx(event.time, rel=1e-8)
    assert 2 * event.stress / event.stretch**2 == pytest.approx(2.0, rel=1e-10)


def test_ramps_of_the_voltage():
    """The pull-in voltage rises with the rate of the ramp, from that at rest towards that of the stiff film."""
    found = []
    for rate in (0.001, 0.01, 0.1, 10.0):
        run = rates.follow_film(VHB, force=1.0, voltage=rates.Ramp(rate), duration=3 / rate, times=[0.0, 0.1])
        found.append(pulled_in(run).voltage)
    stretch = np.linspace(1.1, 2.5, 20001)
    stiff = np.sqrt(np.max((gent(110.0, stretch) + G * gent(55.0, stretch) - stretch) / stretch**4))
    assert [0.371806, *found, stiff] == sorted([0.371806, *found, stiff])
    assert (found[0], found[-1]) == (pytest.approx(0.371806, rel=0.1), pytest.approx(stiff, rel=0.02))


def test_recovery():
    """After the load is taken off the film shrinks at once, and at last to where it began."""
    steps = rates.Steps([(1.0, 5.0), (0.0, 200.0)])
    run = rates.follow_film(VHB, force=steps, voltage=0.1, times=[0.0, 4.999, 5.0, 205.0])
    assert run.stretch[1] > run.stretch[0] > 1.05
    assert 1.0 < run.stretch[2] < run.stretch[1] - 0.05
    held = rates.follow_film(VHB, force=0.0, voltage=0.1, times=[0.0, 200.0])
    assert run.stretch[3] == pytest.approx(held.stretch[1], rel=1e-7)


def test_a_relaxed_film_is_stiff_to_what_comes_next():
    """After a long wait at a stretch the branches carry nothing, and stay so."""
    run = rates.follow_film(RUBBER, stretch=2.0, start="relaxed", times=[0.0, 2.0])
    assert run.stress == pytest.approx(2 - 2**-5, rel=1e-12)


def test_derivatives_of_stresses():
    """By the relaxation time, backwards by jax.grad, against the closed form."""
    time, stretch = jnp.array([0.0, 1.0, 2.0]), jnp.full(3, 2.0)

    def last(tau):
        film = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), 1.0, tau)])
        return rates.film_stress(film, time, stretch, tolerance=1e-10)[-1]

    # t/τ alone matters: with b' = −(b³ − 1)/(3τ b²) of F', dT/dτ = −(t/τ) dT/dt
    b = relaxed_after(1.0)
    change = -(b**3 - 1) / (3 * 2.0 * b)
    slope = (1 + 2 * b**-3) * change / 2
    value, found = jax.value_and_grad(last)(2.0)
    assert value == pytest.approx((2 - 2**-5) + (b - b**-2) / 2, rel=1e-9)
    assert found == pytest.approx(-slope, rel=1e-7)


def test_constants_of_vhb():
    """The instantaneous modulus of the fit is that of all four springs."""
    material, units = rates.vhb_hossain_2012()
    assert float(units.shear_modulus) * (1 + sum(float(b.modulus_ratio) for b in material.branches)) == pytest.approx(
        121.4e3
    )
    assert [float(b.relaxation_time) for b in material.branches] == [0.82, 10.7, 500.0]


def test_bad_input():
    for words, call in (
        ("One of `stretch`, `force` and `pressure` must be given, but none is", lambda: rates.follow_film(VHB)),
        ("but `stretch` and `force` are", lambda: rates.follow_film(VHB, stretch=2.0, force=1.0)),
        ("`duration` or `times` must be given", lambda: rates.follow_film(VHB, stretch=2.0)),
        ("`times` must be finite numbers that rise", lambda: rates.follow_film(VHB, stretch=2.0, times=[1.0, 0.5])),
        (
            "`times` must lie between 0 and the end, 1,",
            lambda: rates.follow_film(VHB, stretch=2.0, duration=1.0, times=[2.0]),
        ),
        ("`mode` must be one of equal_biaxial, uniaxial", lambda: rates.follow_film(VHB, stretch=2.0, mode="biaxial")),
        ('`mode` must be "equal_biaxial" for a balloon', lambda: rates.follow_film(VHB, pressure=1.0, mode="uniaxial")),
        ('`start` must be "fresh"', lambda: rates.follow_film(VHB, stretch=2.0, duration=1.0, start="wet")),
        ("`stretch` must be positive", lambda: rates.follow_film(VHB, stretch=-1.0, duration=1.0)),
        ("`material` must be a material", lambda: rates.follow_film(typing.cast(typing.Any, 1), stretch=2.0)),
        ("`stretch` must keep all springs", lambda: rates.follow_film(RUBBER_LIMIT, stretch=4.0, times=[0.0, 1.0])),
        ("`time` and `stretch` must be rows", lambda: rates.film_stress(VHB, [0.0, 1.0], [1.0])),
        (
            "`force` or `pressure` must be given, at most",
            lambda: rates.pull_in(VHB, voltage=0.4, force=1.0, pressure=1.0, duration=1.0),
        ),
    ):
        with pytest.raises(ValueError, match=words):
            call()
    with pytest.raises(dj.numerics.SceneError, match="does not pull in within 3"):
        rates.pull_in(VHB, voltage=0.4, force=1.0, duration=3.0)


RUBBER_LIMIT = dj.Gent(10.0)
