"""Shared by the tests: float64, the reference states, and diagrams that are computed once."""

import functools
import json
import os
import pathlib
import shutil
import tempfile

# One cache folder for each run: what one test traces or builds, other tests and processes of the run read. What XLA compiles
# stays for the next run, under a digest of the program, its options and XLA's version, unless JAX_COMPILATION_CACHE_DIR names
# another folder. Set before JAX is imported, and inherited by workers and by the scripts that tests start.
_OWN = None
_MOST_COMPILED = 3e9  # bytes


def _compiled_before() -> str:
    """The folder of compiled programs, without the oldest half where it has grown too large."""
    folder = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "dielectric_jax_tests"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime)
    if sum(file.stat().st_size for file in files) > _MOST_COMPILED:
        for file in files[: len(files) // 2]:
            file.unlink(missing_ok=True)
    return str(folder)


if "DIELECTRIC_JAX_TESTS" not in os.environ:
    _OWN = os.environ["DIELECTRIC_JAX_TESTS"] = tempfile.mkdtemp(prefix="dielectric_jax_tests_")
    os.environ["DIELECTRIC_JAX_CACHE"] = f"{_OWN}/kept"
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled_before()
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"

import hypothesis
import jax
import jax.numpy as jnp
import pytest

import dielectric_jax as dj

jax.config.update("jax_enable_x64", True)
dj.numerics.enable_compilation_cache()


def pytest_unconfigure():
    if _OWN is not None:
        shutil.rmtree(_OWN, ignore_errors=True)


@pytest.fixture(autouse=True)
def few_maps():
    """Discards compiled programs before the process reaches the system's limit of memory maps (65530 on Linux)."""
    yield
    maps = pathlib.Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 40_000:
        jax.clear_caches()


# drawn examples are the same in every run: a failure is a failure of the code
hypothesis.settings.register_profile("gate", deadline=None, derandomize=True, max_examples=60, database=None)
hypothesis.settings.load_profile("gate")


@pytest.fixture(scope="session")
def membrane():
    """The membrane of the paper: Gent with J = 270, not prestretched."""
    return dj.Membrane()


@pytest.fixture(scope="session")
def reference():
    """The reference states, a list of dictionaries; see tests/data/README.md."""
    return json.loads((pathlib.Path(__file__).parent / "data" / "equilibria.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def chamber():
    """`chamber(volume)`: the voltage–volume diagram of the paper's membrane on a chamber with V_0 = 2.42."""

    @functools.cache
    def build(volume, **options):
        return dj.voltage_volume(dj.Scene(dj.Membrane(), dj.Chamber(volume=volume, initial_volume=2.42)), **options)

    return build


@pytest.fixture(scope="session")
def held():
    """`held(pressure, prestretch=1.0)`: the voltage–volume diagram at constant pressure."""

    @functools.cache
    def build(pressure, prestretch=1.0):
        return dj.voltage_volume(dj.Scene(dj.Membrane(prestretch=prestretch), dj.ConstantPressure(pressure)))

    return build


@pytest.fixture(scope="session")
def curve():
    """`curve(voltage, prestretch=1.0)`: the pressure–volume diagram."""

    @functools.cache
    def build(voltage, prestretch=1.0):
        return dj.pressure_volume(dj.Membrane(prestretch=prestretch), voltage)

    return build


GAS = ("chamber_volume", "initial_volume", "atmospheric_pressure", "polytropic_exponent")


@pytest.fixture(scope="session")
def slope_by_differences():
    """`slope_by_differences(function, x, step)`: the fourth-order central difference."""

    def slope(function, x, step):
        near, far = (float(function(x + k * step)) - float(function(x - k * step)) for k in (1, 2))
        return (8 * near - far) / (12 * step)

    return slope


@pytest.fixture(scope="session")
def slopes_of_gas(membrane):
    """`slopes_of_gas(volume, chamber_volume)`: ∂p_gas/∂θ at given V for the parameters of a chamber with V_0 = 2.42.

    (24) is written out; the filling's p_0 moves with V_0 along the p–V curve.
    """
    start = dj.equilibrium(membrane, volume=2.42)
    surface = dj.Surface.build(membrane)

    def gas_pressure(values, filling_pressure, volume):
        v_c, v_0, p_atm, n = (values[name] for name in GAS)
        return (filling_pressure + p_atm) * ((v_0 + v_c) / (volume + v_c)) ** n - p_atm

    def line(apex):
        state = surface(apex, 0.0)
        return jnp.stack([state.pressure, state.volume])

    def slopes(volume, chamber_volume=1600.0):
        values = dict(zip(GAS, (chamber_volume, 2.42, 50.0, 1.0), strict=True))
        by_p, by_v = jax.jacfwd(line)(start.apex_stretch)
        found = jax.grad(gas_pressure)(values, start.pressure, volume)
        found["initial_volume"] += jax.grad(gas_pressure, 1)(values, start.pressure, volume) * by_p / by_v
        return {name: float(v) for name, v in found.items()}

    return slopes
