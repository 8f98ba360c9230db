"""How a run begins, and the phases of its protocol."""

import dataclasses
import functools
import math
import typing

import jax
import numpy as np

from ..diagram import MembraneKey, equilibrium
from ..model import (
    Chamber,
    ConstantPressure,
    LoadingCondition,
    Membrane,
    PrescribedVolume,
    Profile,
    Scene,
    State,
    other_loading,
    profile,
    spring_and_branches,
)
from ..numerics import Code, SceneError
from .balance import Grid, Shape
from .passages import Asking, Now, Setting
from .protocols import Linear, Phase
from .requests import Request
from .resolution import LEAP_SCALE, LOAD_SCALE
from .runs import at_start

__all__ = ["begun", "filling_of", "scale_of", "setting_of", "trial_of"]


def _filling(scene: Scene | Membrane, values: dict) -> tuple[str, float]:
    """What is given of the state from which a run starts: its volume or its pressure."""
    for name in ("volume", "pressure"):
        if name in values:
            return name, float(values[name])
    if not isinstance(scene, Scene):
        raise ValueError("`scene` must be a Scene unless volume or pressure is given, but is a Membrane.")
    name, value = filling_of(scene.loading)
    return name, float(value)


def filling_of(loading) -> tuple[str, typing.Any]:
    """Which of pressure and volume a loading gives at the start, and its value, which may be traced."""
    if isinstance(loading, ConstantPressure):
        return "pressure", loading.pressure
    if isinstance(loading, PrescribedVolume):
        return "volume", loading.volume
    if not isinstance(loading, Chamber):
        raise other_loading(loading, Chamber, ConstantPressure, PrescribedVolume)
    if loading.initial_volume is not None:
        return "volume", loading.initial_volume
    return "pressure", loading.initial_pressure


@functools.lru_cache(maxsize=256)
def _start_state(key: MembraneKey, name: str, value: float) -> tuple[State, Profile]:
    """The elastic state at zero voltage from which runs start, and its profile."""
    state = equilibrium(key.membrane, **{name: value})  # pyright: ignore[reportArgumentType]
    return state, profile(key.membrane, state)


def trial_of(prestretch: float, state: State, own: Profile, grid: Grid) -> Shape:
    """The shape of an equilibrium on a grid, nearly."""
    radius = np.sqrt(grid.s)
    a = np.interp(radius, own.radius, own.stretch_2)
    rise = np.interp(radius, own.radius, own.stretch_1 * np.sin(own.theta))
    coefficients = np.linalg.lstsq(grid.functions[0], a - prestretch, rcond=None)[0]
    return Shape(coefficients, rise / (2 * radius), float(state.pressure), 0.0)


def begun(setting: Setting, start: str, values: dict) -> Asking[tuple[Setting, Now]]:
    """Where a run starts: relaxed, the branches carry nothing; fresh, the dashpots have not moved yet."""
    branches = spring_and_branches(setting.membrane.material)[1]
    elastic = at_start(setting.membrane, start)
    state, own = _start_state(MembraneKey.of(elastic), *_filling(setting.scene, values))
    # a flat film has no volume that depends on its pressure
    given = "pressure" if state.pressure == 0 else "volume"
    held = {"voltage": Linear(0.0, 0.0, 0.0), given: Linear(float(getattr(state, given)), 0.0, 0.0)}
    x = np.zeros((len(branches), 2, len(setting.grid.s)))
    balance = setting.balance(held, flows=False, kappa=0.0)
    if start == "relaxed":
        balance = dataclasses.replace(balance, branches=())
    trial = trial_of(float(elastic.prestretch), state, own, setting.grid)
    shape, logs, good = yield Request("settle", setting.mesh, (balance, trial, x[: len(balance.branches)], 0.0))
    if not good:
        raise SceneError(Code.not_converged)
    condition = _condition(setting.scene, float(shape.pressure), state.volume)
    x = np.broadcast_to(logs, x.shape).copy() if start == "relaxed" else x
    return setting._replace(condition=condition), Now(shape, x)


def _condition(scene: Scene | Membrane, pressure: float, volume: float) -> LoadingCondition:
    """The condition of the loading, with the filling of a chamber at the start."""
    loading = scene.loading if isinstance(scene, Scene) else ConstantPressure(pressure)
    return jax.tree.map(float, loading.condition(*((pressure, volume) if isinstance(loading, Chamber) else ())))


def scale_of(setting: Setting, phase: Phase, moment: float) -> tuple[float, float]:
    """κ of a phase, and its unit of σ: the time in which something changes, by the way in which the volume goes."""
    name = setting.driven
    course = phase.courses[name]
    value = float(course(moment))
    if phase.kind == "leap":
        return math.copysign(LEAP_SCALE, abs(float(course(1.0))) - abs(float(course(0.0)))), LEAP_SCALE
    rate = float(course.rate) if isinstance(course, Linear) else float(jax.grad(course)(moment))
    if not rate:
        times = [float(b.relaxation_time) for b in spring_and_branches(setting.membrane.material)[1]]
        unit = max(times, default=1.0) / 2
        return (-unit if phase.falls else unit), unit
    unit = (LOAD_SCALE if name == "voltage" else LEAP_SCALE) / abs(rate)
    return math.copysign(unit, rate * (value or rate) if name == "voltage" else rate), unit


def setting_of(
    scene, legs: dict, protocol: dict, mesh: tuple[int, int], tolerance: float, again: typing.Any = None
) -> Setting:
    """What a run of these legs has throughout; without `again` it is not repeated on a finer mesh."""
    membrane = scene.membrane if isinstance(scene, Scene) else scene
    driven = next((n for n in ("volume", "pressure") if n in legs), "voltage")
    return Setting(scene, membrane, _condition(membrane, 1.0, 1.0), driven, mesh, tolerance, protocol, again)
