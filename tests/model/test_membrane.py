"""Identities that hold along equilibria, and limits in closed form."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

import dielectric_jax as dj

STEPS = 300  # of a profile: the splines that integrate it leave 5e-12 at 192


def drawn_states():
    """Membranes, voltages and volumes drawn with a fixed seed: (label, membrane, Φ, V)."""
    rng = np.random.default_rng(20130611)
    out = []
    for k in range(6):
        prestretch = 1.0 if k < 2 else rng.uniform(1.0, 3.0)
        material = dj.Gent(stretch_limit=math.exp(rng.uniform(math.log(50), math.log(1000))))
        out.append(
            (dj.Membrane(material=material, prestretch=prestretch), rng.uniform(0.02, 0.1), rng.uniform(0.8, 30.0))
        )
    # below the first stretch of lock-up, with their own limits
    out.append((dj.Membrane(material=dj.ArrudaBoyce(chain_links=rng.uniform(60, 200)), prestretch=1.4), 0.08, 12.0))
    out.append((dj.Membrane(material=dj.NeoHookean(), prestretch=2.0), 0.05, 8.0))
    return [(f"{type(m.material).__name__}-{m.prestretch:.3f}-{phi:.4f}-{v:.3f}", m, phi, v) for m, phi, v in out]


DRAWN = drawn_states()
each_state = pytest.mark.parametrize(("membrane", "phi", "volume"), [d[1:] for d in DRAWN], ids=[d[0] for d in DRAWN])


def state_and_energy(membrane, phi, volume):
    state = dj.equilibrium(membrane, voltage=phi, volume=volume)
    return state, dj.model.energy(membrane, dj.profile(membrane, state, steps=STEPS))


def difference(values, h):
    """Fourth-order central difference from values at −2h, −h, h, 2h."""
    return (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)


@each_state
def test_identities(membrane, phi, volume):
    """First integral (13), scaling identity, dU = p dV, ∂U/∂Φ|V = −Q, and ∂p/∂Φ|V = −∂Q/∂V|Φ (Maxwell)."""
    state = dj.equilibrium(membrane, voltage=phi, volume=volume)
    shape = dj.profile(membrane, state, steps=STEPS)
    assert abs(shape.first_integral_defect()).max() < 1e-11 * max(state.pressure * shape.r[-1] ** 2, 1)
    energy = dj.model.energy(membrane, shape)
    assert abs(dj.model.scaling_defect(membrane, shape)) < 1e-10 * max(abs(energy), 1)

    h = 0.01 * volume
    at = [state_and_energy(membrane, phi, volume + k * h) for k in (-2, -1, 1, 2)]
    size = max(abs(energy), state.pressure * volume)
    # left over: h⁴ U⁗/30, and the rounding of U over h
    assert difference([u for _, u in at], h) == pytest.approx(state.pressure, abs=3e-8 * size / volume)
    charge_by_volume = difference([s.charge for s, _ in at], h)

    h = 0.005 * phi
    at = [state_and_energy(membrane, phi + k * h, volume) for k in (-2, -1, 1, 2)]
    assert difference([u for _, u in at], h) == pytest.approx(-state.charge, rel=1e-7)
    pressure_by_voltage = difference([s.pressure for s, _ in at], h)
    assert pressure_by_voltage == pytest.approx(-charge_by_volume, rel=2e-6)


def nearest(states, volume):
    return min(states, key=lambda s: abs(s.volume - volume))


def test_maxwell_at_prescribed_pressure(membrane):
    """∂V/∂Φ|p = ∂Q/∂p|Φ, on the rising and on the falling side of the peak."""
    phi, pressure = 0.1, 1.5
    h, k = 1e-3, 5e-3
    for volume in (1.6, 8.0):

        def ask(phi, pressure, volume=volume):
            return nearest(dj.equilibrium(membrane, voltage=phi, pressure=pressure, all=True), volume)

        by_voltage = difference([ask(phi + i * h, pressure).volume for i in (-2, -1, 1, 2)], h)
        by_pressure = difference([ask(phi, pressure + i * k).charge for i in (-2, -1, 1, 2)], k)
        assert by_voltage == pytest.approx(by_pressure, rel=1e-6)


@pytest.mark.parametrize("prestretch", [1.3, 2.0, 3.0])
@pytest.mark.parametrize("phi", [0.0, 0.1])
def test_a_stretched_film_under_little_pressure_is_a_drum(prestretch, phi):
    """Height p λ0²/(4 σh) and V = π p λ0⁴/(8 σh) as p → 0, with σh = s1(λ0, λ0)/λ0 by hand; the next term is p²."""
    membrane = dj.Membrane(prestretch=prestretch)
    stretch = prestretch
    tension = ((stretch - stretch**-5) / (1 - (2 * stretch**2 + stretch**-4 - 3) / 270) - phi**2 * stretch**3) / stretch
    heights, volumes, charges = [], [], []
    for p in (0.01, 0.005):
        state = dj.equilibrium(membrane, voltage=phi, pressure=p)
        heights.append(state.height / (p * stretch**2 / (4 * tension)))
        volumes.append(state.volume / (math.pi * p * stretch**4 / (8 * tension)))
        charges.append(state.charge)
    for coarse, fine in (heights, volumes):
        assert abs(coarse - 1) < 1e-4
        assert (4 * fine - coarse) / 3 == pytest.approx(1.0, abs=5e-9)
    flat = dj.equilibrium(membrane, voltage=phi, pressure=0.0)
    assert flat.charge == pytest.approx(math.pi * phi * stretch**4, rel=1e-14)
    assert (4 * charges[1] - charges[0]) / 3 == pytest.approx(flat.charge, rel=5e-9, abs=1e-15)
    assert (flat.volume, flat.height, flat.apex_stretch, flat.index) == (0.0, 0.0, stretch, 0)


def test_an_unstretched_film_under_little_pressure_is_hencky_s(membrane):
    """ν = 1/2, E = 3μ, k = p/3: height → 0.59487903 k^⅓, V → 0.96516290 k^⅓; the next term is k^⅔."""
    heights, volumes = [], []
    for p in (1e-5, 1e-6):
        state = dj.equilibrium(membrane, pressure=p)
        heights.append(state.height / (p / 3) ** (1 / 3))
        volumes.append(state.volume / (p / 3) ** (1 / 3))
    for (coarse, fine), limit in ((heights, 0.59487903), (volumes, 0.96516290)):
        assert fine == pytest.approx(limit, rel=3e-5)
        ratio = 10 ** (2 / 3)
        # the constants carry eight digits, and k^(4/3) leaves 3e-9
        assert (ratio * fine - coarse) / (ratio - 1) == pytest.approx(limit, rel=2e-8)


@pytest.mark.parametrize("prestretch", [1.5, 3.0])
@pytest.mark.parametrize("pressure", [1e-3, 1e-4, 1e-6])
def test_tiny_pressures_have_states_too(prestretch, pressure):
    stretch = prestretch
    tension = (1 - stretch**-6) / (1 - (2 * stretch**2 + stretch**-4 - 3) / 270)
    state = dj.equilibrium(dj.Membrane(prestretch=stretch), pressure=pressure)
    assert state.volume == pytest.approx(math.pi * pressure * stretch**4 / (8 * tension), rel=1e-6)
    assert state.pressure == pytest.approx(pressure, rel=1e-9)


def neo_hookean_pressure(apex_stretch):
    """p of the unstretched neo-Hookean membrane by SciPy's DOP853 and bisection, with stresses written by hand."""

    def stress(l1, l2):
        return l1 - l1**-3 * l2**-2

    def rates(radius, y, p):
        l1, l2, theta = y
        s1, s2 = stress(l1, l2), stress(l2, l1)
        s11, s12 = 1 + 3 * l1**-4 * l2**-2, 2 * l1**-3 * l2**-3
        lean = l1 * math.cos(theta) - l2
        return [
            (s2 * math.cos(theta) - s1 - s12 * lean) / (radius * s11),
            lean / radius,
            -(s2 / s1) * math.sin(theta) / radius + p * l1 * l2 / s1,
        ]

    def rim(p):
        a, s0 = apex_stretch, stress(apex_stretch, apex_stretch)
        s11, s12 = 1 + 3 * a**-6, 2 * a**-6
        kappa = p * a**2 / (2 * s0)
        curve1, curve2 = np.linalg.solve(
            [[1, -3], [3 * s11 - s12, 3 * s12 - s11]], [a * kappa**2 / 2, -s0 * kappa**2 / 2]
        )
        first = 1e-3
        l1, l2 = a + curve1 * first**2, a + curve2 * first**2
        start = [l1, l2, math.asin(p * first * l2**2 / (2 * stress(l1, l2)))]
        return solve_ivp(rates, (first, 1), start, args=(p,), method="DOP853", rtol=1e-13, atol=1e-14).y[1, -1] - 1

    return brentq(rim, 1.87, 1.89, xtol=1e-14)


def test_neo_hookean_peak():
    peak = next(p for p in dj.pressure_volume(dj.Membrane(material=dj.NeoHookean())).special_points if p.kind == "fold")
    assert peak.volume == pytest.approx(2.796672, abs=6e-7)
    assert peak.apex_stretch == pytest.approx(2.195945, abs=6e-7)
    # at a peak the place does not matter to first order
    assert peak.pressure == pytest.approx(neo_hookean_pressure(2.195945), rel=2e-11)
    # the commonly quoted number 1.8791734763 is that of Gent with J = 1e9
    gent = dj.Membrane(material=dj.Gent(stretch_limit=1e9))
    state = dj.equilibrium(gent, apex_stretch=2.195945, window=dj.model.Window(apex_stretch=(1.0, 20.0)))
    assert state.pressure == pytest.approx(1.8791734763, rel=3e-11)


def test_gent_peak_and_valley(curve):
    folds = sorted((p for p in curve(0.0).special_points if p.kind == "fold"), key=lambda p: p.volume)
    assert [p.pressure for p in folds] == pytest.approx([1.908684829414, 1.361703319141], rel=1e-11)
    assert [p.volume for p in folds] == pytest.approx([2.9634068291, 59.066473804], rel=1e-9)
    assert [p.apex_stretch for p in folds] == pytest.approx([2.26310592942, 8.2681508078], rel=1e-9)


@pytest.mark.parametrize(("prestretch", "volume"), [(1.0, 468.911), (2.0, 553.884), (3.0, 647.575)])
def test_the_volume_saturates_at_the_limiting_stretch(prestretch, volume):
    """As p → ∞ the Gent membrane is inextensible at J; 1/p extrapolates the volume there."""
    membrane = dj.Membrane(prestretch=prestretch)
    states = [dj.equilibrium(membrane, volume=share * volume) for share in (0.95, 0.965)]
    assert all(s.volume < volume for s in states)
    # p (V∞ − V) tends to a constant
    (p1, v1), (p2, v2) = ((s.pressure, s.volume) for s in states)
    assert (p2 * v2 - p1 * v1) / (p2 - p1) == pytest.approx(volume, rel=2e-3)


def test_profile_of_a_state(membrane):
    """Boundary values, the equations z' = λ1 sin θ and r' = λ1 cos θ, the volume and the charge as integrals."""
    state = dj.equilibrium(membrane, voltage=0.1, volume=20.0)
    shape = dj.profile(membrane, state, steps=STEPS)
    assert (shape.radius[0], shape.r[0], shape.z[0], shape.theta[0]) == (0.0, 0.0, 0.0, 0.0)
    assert shape.stretch_1[0] == shape.stretch_2[0] == state.apex_stretch
    assert shape.radius[-1] == pytest.approx(1.0, abs=1e-14) and shape.r[-1] == pytest.approx(1.0, abs=1e-10)
    assert shape.z[-1] == pytest.approx(state.height, rel=1e-9)

    def spline(values):
        return make_interp_spline(shape.radius, values, k=7)

    inner = shape.radius > 0.01  # towards the apex the points are dense and differences of neighbours cancel
    for values, rate in (
        (shape.r, shape.stretch_1 * np.cos(shape.theta)),
        (shape.z, shape.stretch_1 * np.sin(shape.theta)),
    ):
        assert abs(spline(values).derivative()(shape.radius) - rate)[inner].max() < 1e-7
    volume = spline(np.pi * shape.r**2 * shape.stretch_1 * np.sin(shape.theta)).integrate(0, 1)
    assert volume == pytest.approx(20.0, rel=1e-9)
    area = (shape.stretch_1 * shape.stretch_2) ** 2
    assert spline(2 * np.pi * 0.1 * area * shape.radius).integrate(0, 1) == pytest.approx(state.charge, rel=1e-9)
    assert shape.breakdown_ratio.max() == pytest.approx(state.breakdown_ratio, rel=1e-8)
    np.testing.assert_allclose(shape.field, 0.1 * shape.stretch_1 * shape.stretch_2, rtol=1e-14)


def test_interior_minimum_of_the_hoop_stress(reference):
    """The references' σ2 = 0 states: min over R of σ2 is zero to their ten digits, in the interior and at the rim."""
    found = 0
    for ref in reference:
        if "sigma2=0" in ref["label"]:
            membrane = dj.Membrane(prestretch=ref["prestretch"])
            state = dj.equilibrium(membrane, voltage=ref["voltage"], apex_stretch=ref["apex_stretch"])
            shape = dj.profile(membrane, state, steps=STEPS)
            fine = make_interp_spline(shape.radius, shape.stress_2, k=7)(np.linspace(0, 1, 200001))
            assert fine.min() == pytest.approx(0.0, abs=2e-9)
            found += 1
    assert found == 3


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: dj.Membrane(prestretch=0.99), "prestretch"),
        (lambda: dj.Membrane(prestretch=float("nan")), "prestretch"),
        (lambda: dj.Membrane(prestretch=float("inf")), "prestretch"),
        (lambda: dj.Membrane(prestretch=11.7), "prestretch"),
        (lambda: dj.Membrane(material=dj.NeoHookean(), prestretch=float("inf")), "prestretch"),
        (lambda: dj.Membrane(material=270.0), "material"),
        (lambda: dj.Membrane(breakdown=2.0), "breakdown"),
    ],
)
def test_bad_membranes_are_refused_by_name(build, name):
    with pytest.raises(ValueError, match=f"^`{name}` must be .*, but is .*\\.$"):
        build()
