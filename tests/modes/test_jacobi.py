"""Conjugate points by integration of the modes' equations: an independent certificate of neutral loads.

Their indices are compared with those of spectra in test_spectrum.
"""

import json
import pathlib

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.modes import conjugate_points

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "modes.json").read_text(encoding="utf-8"))
AT_A_STRETCH = [
    c for c in REFERENCE["critical"] if c["kind"] == "mode neutral" and "apex stretch" in c["scene"] and c["n"] <= 16
]


@pytest.mark.parametrize("known", AT_A_STRETCH[::3], ids=lambda c: f"{c['scene']}, n = {c['n']}")
def test_neutral_loads_of_the_reference(known):
    film = dj.Membrane(dj.Gent(270.0), known["prestretch"])

    def at(load):
        state = dj.equilibrium(film, apex_stretch=known["apex_stretch"], voltage=float(np.sqrt(load)), tolerance=1e-11)
        return conjugate_points(film, state, known["n"]).determinant

    first, last = (known["voltage_squared"] * (1 + step) for step in (-1e-5, 1e-5))
    below, above = at(first), at(last)
    assert below * above < 0
    for _ in range(2):
        middle = last - above * (last - first) / (above - below)
        first, below, last, above = last, above, middle, at(middle)
    assert last == pytest.approx(known["voltage_squared"], rel=1e-10)


def test_bad_input_is_refused(membrane):
    state = dj.equilibrium(membrane, pressure=1.0)
    with pytest.raises(ValueError, match="`numbers` must be whole numbers from 1"):
        conjugate_points(membrane, state, 0)
    with pytest.raises(ValueError, match="`steps` must be a whole number from 300"):
        conjugate_points(membrane, state, 30, steps=100)
