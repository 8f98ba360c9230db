"""Critical points on the manifold of equilibria: pressure peak and valley, zero-voltage states, bistability, and cusps.

As in `critical_points`, these are differentiable functions of every continuous parameter; a point that does not exist raises
outside transformations, and is NaN inside or with `throw=False`.
"""

import typing

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..diagram import filling
from ..model import (
    AbstractLoading,
    Chamber,
    ConstantPressure,
    ConstantVoltage,
    LoadingCondition,
    Membrane,
    PointKind,
    PrescribedVolume,
    Scene,
    as_scalar,
    is_concrete,
    other_loading,
)
from ..numerics import Code, SceneError, check_positive
from .critical_points import CriticalPoint, engine_of, find, point_of, start_of
from .fixed_load import chamber_cusps, leaf_of, none, onset, pressure_extremes, states_at, zero_states
from .fixed_load import pressure_cusp as find_pressure_cusp
from .point_systems import Conditions, attach, attach_free
from .resolution import TOLERANCE

__all__ = [
    "bistability_onset",
    "bistability_point",
    "cusp",
    "pressure_cusp",
    "pressure_peak",
    "pressure_valley",
    "state_point",
    "zero_voltage_point",
]


def _extreme(name: str, membrane: Membrane, voltage, throw: bool) -> CriticalPoint:
    if not isinstance(membrane, Membrane):
        raise ValueError(f"`membrane` must be a Membrane, but is a {type(membrane).__name__}.")
    scene = Scene(membrane, ConstantVoltage(voltage))
    load = scene.loading.voltage**2  # pyright: ignore[reportAttributeAccessIssue]

    def one(scene):
        return [pressure_extremes(scene.membrane, float(scene.loading.voltage) ** 2)[name]]

    found = find((name,), scene, None, one)[name]
    theta = Conditions(membrane, ConstantVoltage(0.0).condition(), load)
    return point_of(
        scene, found, attach(found.state, theta, PointKind.pressure_fold, engine_of(None, found.steps)), throw
    )


def pressure_peak(membrane: Membrane, voltage=0.0, *, throw: bool = True) -> CriticalPoint:
    """The first peak of the pressure along the pressure–volume curve at a voltage.

    >>> round(float(pressure_peak(Membrane()).pressure), 10)
    1.9086848294
    """
    return _extreme("peak", membrane, voltage, throw)


def pressure_valley(membrane: Membrane, voltage=0.0, *, throw: bool = True) -> CriticalPoint:
    """The first valley of the pressure after its first peak."""
    return _extreme("valley", membrane, voltage, throw)


def _filled(scene: Scene) -> tuple[float | None, float | None]:
    filled = filling(scene, TOLERANCE)
    if filled == (0.0, 0.0):
        raise SceneError(Code.flat_film)
    return filled


def _start(scene: Scene) -> tuple[np.ndarray, tuple]:
    """The start of a chamber's ramp, and its filling (p_0, V_0)."""
    filled = _filled(scene)
    states = zero_states(scene.membrane, scene.loading.condition(*filled))
    states = [row for row in states if row[5] == int(Code.ok)]
    if not states:
        raise SceneError(Code.no_zero_voltage_state)
    return min(states, key=lambda row: abs(row[3] - filled[1])), filled


def _check(scene, kinds) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    if not isinstance(scene.loading, kinds):
        raise other_loading(scene.loading, *kinds)


class AtVoltage(AbstractLoading):
    """A loading, and the voltage at which its states are asked for."""

    loading: AbstractLoading
    voltage: typing.Any = eqx.field(converter=as_scalar)

    def condition(self, initial_pressure=None, initial_volume=None) -> LoadingCondition:
        """That of the loading."""
        return self.loading.condition(initial_pressure, initial_volume)


def state_point(scene: Scene, voltage=0.0, number: int = 0, *, throw: bool = True) -> CriticalPoint:
    """The state at a voltage with the given `number` in order of volume, stable or not; −1 is the last.

    Differentiable by the voltage and every parameter of the scene, also under `jax.vmap`, as a likelihood needs it: on a
    `PrescribedVolume` it is p(V; θ). The voltage is in V on a scene with units; states are those in the window up to t = 0.9.

    Args:
        scene: a scene with a chamber, a constant pressure or a prescribed volume.
        voltage: the voltage.
        number: which of the states.
        throw: raise SceneError where there is none, outside transformations.

    >>> import jax
    >>> from dielectric_jax import Gent, PrescribedVolume
    >>> def pressure(limit, volume):
    ...     return state_point(Scene(Membrane(Gent(limit)), PrescribedVolume(volume))).pressure
    >>> value, slope = jax.value_and_grad(pressure)(270.0, 2.42)
    >>> round(float(value), 8), round(1e5 * float(slope), 3)
    (1.88661268, -7.535)
    """
    _check(scene, (Chamber, ConstantPressure, PrescribedVolume))
    if not isinstance(number, int):
        raise ValueError(f"`number` must be a whole number, but is {number!r}.")
    phi = scene.dimensionless(voltage, "voltage")
    if is_concrete(phi):
        check_positive("voltage", float(phi), zero=True)
    filled = isinstance(scene.loading, Chamber)

    def one(asked):
        own = Scene(asked.membrane, asked.loading.loading)
        start, condition = None, own.loading.condition()
        if filled:
            start, filling = _start(own)
            condition = own.loading.condition(*filling)
        states = [
            s for s in states_at(own.membrane, condition, float(asked.loading.voltage) ** 2) if s[5] == int(Code.ok)
        ]
        states.sort(key=lambda row: row[3])
        there = -len(states) <= number < len(states)
        state = states[number] if there else none(Code.no_such_state)
        return [state] if start is None else [start, state]

    asked = Scene(scene.membrane, AtVoltage(scene.loading, phi))
    found = find(("start", "state") if filled else ("state",), asked, None, one)
    of = found["state"]
    theta = (
        start_of(scene, found["start"], None)[1] if filled else Conditions(scene.membrane, scene.loading.condition())
    )
    theta = Conditions(theta.membrane, theta.condition, jnp.asarray(phi, float) ** 2)
    return point_of(scene, of, attach(of.state, theta, PointKind.load, engine_of(None, of.steps)), throw)


def zero_voltage_point(scene: Scene, number: int = 0, *, throw: bool = True) -> CriticalPoint:
    """The state at zero voltage with the given `number` in order of volume; see `state_point`.

    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> round(float(zero_voltage_point(scene, -1).volume), 9)
    11.756168965
    """
    return state_point(scene, 0.0, number, throw=throw)


def _of_chamber(scene: Scene, search: typing.Callable):
    """The start, the conditions, and the result of `search` for membrane, chamber and filling."""
    _check(scene, (Chamber,))

    def one(scene):
        filled = _filled(scene)
        theta = scene.loading.condition(*filled)
        start = min(zero_states(scene.membrane, theta), key=lambda row: abs(row[3] - filled[1]))
        return [start, search(scene.membrane, scene.loading, filled)]

    found = find(("start", "point"), scene, None, one)
    _, theta = start_of(scene, found["start"], None)
    return found["point"], theta, leaf_of(theta, "chamber_volume"), engine_of(None, found["point"].steps)


def bistability_point(scene: Scene, *, throw: bool = True) -> CriticalPoint:
    """Where a second stable state at zero voltage first appears as the chamber grows; `parameter` is that chamber's volume.

    It has a fold at zero voltage. The chamber volume of `scene` is ignored.
    """
    of, theta, free, engine = _of_chamber(scene, onset)
    state = attach(of.state, theta, PointKind.onset, engine, free)
    # the volume from first derivatives alone
    state = state._replace(free=attach_free(of.state.free, of.state, theta, engine, free))
    return point_of(scene, of, state, throw)


def bistability_onset(scene: Scene):
    """The smallest chamber volume with two stable states at zero voltage, in m³ on a scene with units; see `bistability_point`.

    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> round(float(bistability_onset(scene)), 6)
    1455.896262
    """
    point = bistability_point(scene)
    return scene.in_units(point.parameter, "chamber_volume")


def cusp(
    scene: Scene, number: int = 0, *, within: tuple[float, float] = (250.0, 1e5), throw: bool = True
) -> CriticalPoint:
    """A cusp, at which two folds of q merge as the chamber's volume changes: the one with this `number` among those `within`.

    `parameter` is the volume of the chamber. Cusps are numbered in order of volume.
    """

    def search(membrane, loading, filled):
        cusps = chamber_cusps(membrane, loading, filled, within)
        return cusps[number] if -len(cusps) <= number < len(cusps) else none(Code.no_cusp)

    of, theta, free, engine = _of_chamber(scene, search)
    return point_of(scene, of, attach(of.state, theta, PointKind.cusp, engine, free), throw)


def pressure_cusp(
    membrane: Membrane, voltage=0.0, *, within: tuple[float, float] = (1.0, 4.0), throw: bool = True
) -> CriticalPoint:
    """The point where peak and valley of the pressure merge as the prestretch grows; `parameter` is that prestretch.

    The prestretch of `membrane` is ignored.
    """
    scene = Scene(membrane, ConstantVoltage(voltage))
    load = scene.loading.voltage**2  # pyright: ignore[reportAttributeAccessIssue]

    def one(scene):
        return [find_pressure_cusp(scene.membrane, float(scene.loading.voltage) ** 2, within)]

    of = find(("cusp",), scene, None, one)["cusp"]
    theta = Conditions(membrane, ConstantVoltage(0.0).condition(), load)
    state = attach(of.state, theta, PointKind.pressure_cusp, engine_of(None, of.steps), leaf_of(theta, "prestretch"))
    return point_of(scene, of, state, throw)
