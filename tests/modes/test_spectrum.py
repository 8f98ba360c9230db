"""The spectrum of modes against reference states, closed forms of flat films, and the axisymmetric index."""

import json
import pathlib

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import assoc_legendre_p_all, jn_zeros, jv, jvp

import dielectric_jax as dj
from dielectric_jax.model import State, stresses
from dielectric_jax.modes import ModeSpectrum, conjugate_points
from dielectric_jax.modes.second_variation import _Base, _integrand

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "modes.json").read_text(encoding="utf-8"))


def state_of(entry: dict) -> State:
    u = entry["voltage_squared"], entry["pressure"], entry["volume"], entry["apex_stretch"]
    return State(*u, np.nan, np.nan, entry["breakdown_ratio"], None, 1e-13)


def film_of(entry: dict) -> dj.Membrane:
    return dj.Membrane(dj.Gent(270.0), entry["prestretch"])


def difference(values, others):
    return np.abs(values - others) / np.maximum(np.abs(others), 1e-3)


@pytest.fixture(scope="module")
def spectra():
    """The spectra of the reference states, those of one prestretch side by side."""
    found: list[ModeSpectrum | None] = [None] * len(REFERENCE["states"])
    for stretch in sorted({s["prestretch"] for s in REFERENCE["states"]}):
        own = [k for k, s in enumerate(REFERENCE["states"]) if s["prestretch"] == stretch]
        states = [state_of(REFERENCE["states"][k]) for k in own]
        for k, spectrum in zip(
            own, dj.mode_spectrum(film_of(REFERENCE["states"][own[0]]), states, range(7)), strict=True
        ):
            found[k] = spectrum
    return found


def test_reference_eigenvalues_indices_and_hoop_tension(spectra):
    for entry, spectrum in zip(REFERENCE["states"], spectra, strict=True):
        known = np.array([entry["eigenvalues"][str(n)] for n in range(7)])
        # at a fold the reference itself is known to its digits only
        assert difference(spectrum.eigenvalues, known).max() < 10 * 10.0 ** -min(entry["digits"], 9), entry["label"]
        assert spectrum.error_estimate.max() < 1e-6
        for n, index in entry["index"].items():
            assert not spectrum.index.mask[int(n)] and spectrum.index[int(n)] == index, entry["label"]
        assert spectrum.hoop_tension == pytest.approx(entry["min_sigma2"], rel=1e-9)


def test_a_chamber_changes_axisymmetric_modes_only(spectra):
    for entry, free in zip(REFERENCE["states"], spectra, strict=True):
        if "eigenvalues_0_chamber" not in entry:
            continue
        scene = dj.Scene(film_of(entry), dj.Chamber(volume=entry["chamber_volume"], initial_volume=2.42))
        closed = dj.mode_spectrum(scene, state_of(entry), (0, 3))
        assert difference(closed.eigenvalues[0], np.array(entry["eigenvalues_0_chamber"])).max() < 1e-6
        assert closed.eigenvalues[1] == pytest.approx(free.eigenvalues[3], rel=1e-9)


@pytest.mark.parametrize("number", [0, 1, 2, 5, 12])
def test_flat_films_have_bessel_modes(number):
    """Out of plane Λ = T j²; in plane αβ J'(α) J'(β) = n² J(α) J(β), α² = Λ/w11, β² = Λ/C."""
    stretch, q = 2.0, 0.05
    film = dj.Membrane(dj.Gent(270.0), stretch)
    s1, _, w11, w12 = (float(v) for v in stresses(film.material, stretch, stretch, q))
    tension = s1 / stretch
    shear = (w11 - w12 + tension) / 2

    def in_plane(value):
        a, b = np.sqrt(value / w11), np.sqrt(value / shear)
        return a * b * jvp(number, a) * jvp(number, b) - number**2 * jv(number, a) * jv(number, b)

    grid = np.linspace(1e-3, 400.0, 40_001)
    signs = np.sign(in_plane(grid))
    roots = [brentq(in_plane, grid[i], grid[i + 1], xtol=1e-14) for i in np.flatnonzero(signs[1:] != signs[:-1])]
    if number == 0:  # J0' = −J1: the two factors, radial and twist
        roots = sorted([*(w11 * jn_zeros(1, 8) ** 2), *(shear * jn_zeros(1, 8) ** 2)])
    known = np.sort([*roots, *(tension * jn_zeros(number, 8) ** 2)])[:4]
    flat = State(q, 0.0, 0.0, stretch, 0.0, np.nan, 0.0, 0, 1e-13)
    spectrum = dj.mode_spectrum(film, flat, [number], count=4)
    assert spectrum.eigenvalues[0] == pytest.approx(known, rel=1e-10)
    assert spectrum.index.tolist() == [0] and spectrum.stable


MATERIALS = {
    "eight-chain": dj.ArrudaBoyce(50.0),
    "ogden": dj.Ogden(),
    "electrostrictive": dj.Electrostrictive(dj.Gent(270.0), stretch_coefficient=-0.02),
    "custom": dj.CustomMaterial(
        lambda l1, l2: 0.5 * (l1**2 + l2**2 + (l1 * l2) ** -2 - 3) + 1e-4 * (l1**2 + l2**2 + (l1 * l2) ** -2 - 3) ** 3,
        6.0,
    ),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_axisymmetric_modes_agree_with_the_index_of_states(name):
    film = dj.Membrane(MATERIALS[name], 1.2)
    states = dj.equilibrium(film, voltage=0.1, pressure=1.0, all=True)
    # the index of a loading that holds the volume or the charge is that of whatever state it is asked of
    charged = dj.ChargeControl(dj.ConstantPressure(1.0)), dj.ChargeControl(dj.PrescribedVolume(1.0))
    for loading in (None, dj.PrescribedVolume(1.0), *charged):
        what = film if loading is None else dj.Scene(film, loading)
        for state, spectrum in zip(states, dj.mode_spectrum(what, states, (0, 1, 2, 8)), strict=True):
            assert spectrum.index[0] == dj.model.stability_of(what, state).index
            assert spectrum.error_estimate.max() < 1e-6
            if loading is None:
                certified = [conjugate_points(film, state, n).index for n in (1, 2, 8)]
                assert spectrum.index[1:].tolist() == certified


def test_a_user_s_energy_gives_the_same_as_the_package_s(membrane):
    """λ1 = λ2 at the apex and nearly so around it: nothing cancels there whatever gives W."""
    mine = dj.CustomMaterial(lambda l1, l2: -135.0 * jnp.log1p(-(l1**2 + l2**2 + (l1 * l2) ** -2 - 3) / 270.0), 11.0)
    state = dj.equilibrium(membrane, voltage=0.05, pressure=1.5)
    own, other = (dj.mode_spectrum(m, state, range(3)) for m in (membrane, dj.Membrane(mine)))
    assert other.eigenvalues == pytest.approx(own.eigenvalues, rel=1e-9)


def test_shapes_are_normalised_and_clamped(membrane):
    state = dj.equilibrium(membrane, pressure=1.5)
    spectrum = dj.mode_spectrum(membrane, state, (0, 1, 4), count=2)
    for number in (0, 1, 4):
        shape = spectrum.shape(number, 1)
        whole = shape.radial**2 + shape.hoop**2 + shape.vertical**2
        assert np.trapezoid(whole * shape.radius, shape.radius) == pytest.approx(1.0, abs=1e-3)
        assert abs(shape.radial[-1]) + abs(shape.hoop[-1]) + abs(shape.vertical[-1]) < 1e-12
        assert max(np.abs(v).max() for v in (shape.radial, shape.hoop, shape.vertical)) == pytest.approx(
            max(v.max() for v in (shape.radial, shape.hoop, shape.vertical))
        )
    assert spectrum.shape(4).radial[0] == pytest.approx(0.0, abs=1e-12)
    ax = dj.plot.plot_mode(dj.profile(membrane, state), spectrum.shape(4), amplitude=0.2)
    assert ax.get_title().startswith("$n$ = 4, $Λ$ = ")
    (line, *_) = dj.plot.plot_spectra(spectrum).lines
    assert line.get_ydata().tolist() == spectrum.eigenvalues[:, 0].tolist()
    with pytest.raises(ValueError, match="`amplitude` must lie between 0 and 1"):
        dj.plot.plot_mode(dj.profile(membrane, state), spectrum.shape(4), amplitude=0.0)


def test_reference_frequencies():
    """Squared angular frequencies in μ/(ρA²); those of n = 0 are listed without the twist."""
    data = pathlib.Path(__file__).parents[1] / "data" / "frequencies.json"
    for entry in json.loads(data.read_text(encoding="utf-8"))["items"]:
        film = dj.Membrane(dj.Gent(270.0), entry["prestretch"])
        u = (entry[name]["value"] for name in ("pressure", "volume", "apex_stretch"))
        state = State(entry["voltage"] ** 2, *u, np.nan, np.nan, np.nan, None, 1e-12)
        loading = dj.ConstantPressure(state.pressure)
        if entry["chamber_volume"] is not None:
            loading = dj.Chamber(volume=entry["chamber_volume"], initial_volume=entry["initial_volume"])
        numbers = sorted({int(k[7]) for k in entry if k.startswith("omega_n")})
        what = dj.Scene(film, loading) if entry["chamber_volume"] is not None else film
        spectrum = dj.mode_spectrum(what, state, (0, *numbers), count=6)
        for name, known in entry.items():
            if name.startswith("omega"):
                row = 0 if name.startswith("omega_axisymmetric") else 1 + numbers.index(int(name[7]))
                near = np.abs(np.sqrt(spectrum.eigenvalues[row]) / known["value"] - 1).min()
                assert near < max(1e-9, 10.0 ** (1 - known["digits"])), (entry["voltage"], name)


def test_frequencies_in_hertz(membrane):
    state = dj.equilibrium(membrane, pressure=1.0)
    spectrum = dj.mode_spectrum(membrane, state, (1,), count=1)
    units = dj.Units(shear_modulus=45e3, radius=22.5e-3, density=1000.0)
    hertz = spectrum.frequency(units)
    assert hertz[0, 0] == pytest.approx(np.sqrt(spectrum.eigenvalues[0, 0]) * np.sqrt(45.0) / (2 * np.pi * 22.5e-3))
    document = spectrum.to_json(units)
    assert document["modes"][0]["frequency"] == [pytest.approx(hertz[0, 0])]
    with pytest.raises(ValueError, match="`units` must be Units with a density"):
        spectrum.frequency(dj.Units())


def test_bad_input_is_refused_in_a_sentence(membrane):
    state = dj.equilibrium(membrane, pressure=1.0)
    for arguments, words in (
        ((membrane, state, [-1]), "`numbers` must be whole numbers from 0"),
        ((membrane, state, []), "`numbers`"),
        ((membrane, state, [1.5]), "`numbers`"),
        ((membrane, state, [0], 0), "`count` must be a whole number from 1"),
        ((membrane, "state"), "`state` must be a State"),
        (("film", state), "`scene` must be a Scene or a Membrane"),
        ((dj.Membrane(dj.Gent(100.0), 1.5), state), "`state` must be an equilibrium"),
    ):
        with pytest.raises(ValueError, match=words):
            dj.mode_spectrum(*arguments)


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_form_of_a_sphere(degree, number):
    """δx = f Y e_r + g ∇Y on a full sphere of reference radius 1 and stretch λ; a = w11, b = w12, T = w1/λ, L = l(l + 1):

    Q = f² (2 (a + b) + T (L − 4)) − 2 f g L (a + b − T) + g² L (a L − a + b − T).
    """
    if number > degree:
        return
    stretch, q, material = 2.0, 0.02, dj.NeoHookean()
    w1, _, a, b = (float(v) for v in stresses(material, stretch, stretch, q))
    tension, size = w1 / stretch, degree * (degree + 1)
    known = np.array(
        [2 * (a + b) + tension * (size - 4), -size * (a + b - tension), size * (a * size - a + b - tension)]
    )
    nodes, weights = np.polynomial.legendre.leggauss(24)
    sine = np.sqrt(1 - nodes**2)  # of the angle S from the apex, the radius of the parallels of the reference
    values = assoc_legendre_p_all(degree, number, nodes, diff_n=2)[:, degree, number]
    y, slope, bend = values[0], -sine * values[1], sine**2 * values[2] - nodes * values[1]
    norm = np.sqrt(np.sum(weights * y**2) * (2 * np.pi if number == 0 else np.pi))
    y, slope, bend = y / norm, slope / norm, bend / norm
    cosine, per = nodes, 1 / sine
    # U cos nΘ e_r + V sin nΘ e_Θ + W cos nΘ e_z, z downward, and their derivatives, of the normal and of the tangential part
    normal = [y * sine, 0 * y, -y * cosine, slope * sine + y * cosine, 0 * y, -slope * cosine + y * sine]
    hoop = -number * y * per
    of_hoop = -number * (slope * per - y * cosine * per**2)
    along = [slope * cosine, hoop, slope * sine]
    along += [bend * cosine - slope * sine, of_hoop, bend * sine + slope * cosine]
    base = _Base(*(jnp.asarray(v)[:, None] for v in (sine, 0 * y + stretch, 0 * y + stretch, sine, cosine)))
    form = np.asarray(_integrand(material, base, 2 * tension / stretch, q))[..., 0]
    whole = form[0] + number * form[1] + number**2 * form[2]
    both = np.stack([normal, along])
    found = np.einsum("aig,ijg,bjg,g->ab", both, whole, both, weights * per) * (2 * np.pi if number == 0 else np.pi)
    assert [found[0, 0], found[0, 1], found[1, 1]] == pytest.approx(known.tolist(), abs=1e-10)
