"""Events in time as differentiable numbers: the voltage of a jump, the delay until it, and the peak of the pressure."""

import functools
import math
import typing

import jax
import jax.numpy as jnp
import numpy as np

from ..model import Chamber, ConstantPressure, Membrane, Scene, is_concrete, other_loading
from ..numerics import Code, SceneError, check_between, check_positive
from .event_slopes import Given, Record, slopes_of_event
from .passages import Asking, Passed, passed
from .phases import begun, scale_of, setting_of
from .protocols import Hold, Ramp, legs_of, phases_of
from .requests import serve
from .resolution import MESHES, STEPS_OF_A_RECORD, TOLERANCE_SHARE

__all__ = ["delay", "peak_pressure", "snap_voltage"]


class _Asked(typing.NamedTuple):
    """What is asked: "snap", "delay" or "peak"; how the membrane starts, and the tolerance."""

    event: str
    start: str
    tolerance: float


def _legs(asked: _Asked, given: Given) -> dict:
    """The protocol of an event."""
    if asked.event == "peak":
        volume = Ramp(float(given.rate), start=float(given.value))
        return {"voltage": legs_of("voltage", 0.0), "volume": legs_of("volume", volume)}
    voltage = Ramp(float(given.rate)) if asked.event == "snap" else Hold(float(given.value))
    return {"voltage": legs_of("voltage", voltage)}


class _Followed(typing.NamedTuple):
    """How the way to an event ended, whether in the first leap of the voltage, and what was followed."""

    last: Passed
    leaping: bool
    record: Record


def _way(asked: _Asked, given: Given) -> Asking[_Followed]:
    """The run up to the first event."""
    for name in ("rate",) if asked.event != "delay" else ("value",):
        check_positive("voltage" if name == "value" else name, float(getattr(given, name)))
    scene = given.membrane if given.loading is None else Scene(given.membrane, given.loading)
    legs = _legs(asked, given)
    tolerance = TOLERANCE_SHARE * asked.tolerance ** (2 / 3)
    setting = setting_of(scene, legs, {}, MESHES[0], tolerance)
    setting, now = yield from begun(setting, asked.start, {n: own[0].at(0.0) for n, own in legs.items()})
    rest, x = now.shape, now.x
    leapt, found, phase, kappa = rest, None, None, 1.0
    for phase in phases_of(legs, setting.driven):
        kind = "rise" if asked.event == "peak" else phase.kind
        kappa, unit = scale_of(setting, phase, phase.begin)
        now.shape = now.shape._replace(moment=phase.begin)
        leapt = now.shape
        balance = setting.balance(phase.courses, flows=kind != "leap", kappa=kappa)
        found = yield from passed(setting, now, balance, phase.end, kind, unit)
        now.shape, now.x = found.instant.shape, found.instant.x
        if found.event != "end":
            break
    assert found is not None and phase is not None
    return _Followed(found, phase.kind == "leap", _record(found, rest, x, leapt, kappa))


def _record(found: Passed, rest, x, leapt, kappa: float) -> Record:
    begins = found.instants[:-1]
    steps = len(begins)
    size = STEPS_OF_A_RECORD * math.ceil(max(steps, 1) / STEPS_OF_A_RECORD)
    instants = [*begins, *[begins[-1] if steps else found.instant] * (size - steps)]
    stacked = jax.tree.map(lambda *v: np.stack(v), *instants)
    sigma = np.array([*found.sigma[1:], *[found.sigma[-1]] * (size - steps)])
    return Record(rest, x, leapt, kappa, stacked, sigma, steps)


_EVENTS = {"snap": "fold", "delay": "fold", "peak": "peak"}
_MISSED = {"snap": Code.no_jump, "delay": Code.no_jump, "peak": Code.no_pressure_fold}


def _value(asked: _Asked, given: Given, slopes: bool) -> tuple[float, list]:
    """The value of an event and, if asked, its derivatives by the leaves; raises SceneError where there is none."""
    way = serve([_way(asked, given)])[0]
    if way.last.event != _EVENTS[asked.event]:
        raise SceneError(_MISSED[asked.event], f"The run ends with {way.last.event!r}.")
    zeros = [np.zeros(np.shape(leaf)) for leaf in jax.tree.leaves(given)]
    if way.leaping:  # the voltage is too high from the beginning
        return 0.0, zeros
    of = "pressure" if asked.event == "peak" else "moment"
    if slopes:
        return slopes_of_event(given, way.record, MESHES[0], asked.start == "relaxed", of)
    return float(getattr(way.last.instant.shape, of)), zeros


def _on_host(asked: _Asked, tree, shapes: list[tuple], slopes: bool, *leaves) -> tuple:
    """Values and slopes for leaves with common leading axes; NaN where there is no event, or no scene."""
    arrays = [np.asarray(leaf, float) for leaf in leaves]
    leading = np.broadcast_shapes(*(a.shape[: a.ndim - len(s)] for a, s in zip(arrays, shapes, strict=True)))
    flat = [np.broadcast_to(a, (*leading, *s)).reshape(-1, *s) for a, s in zip(arrays, shapes, strict=True)]
    many = math.prod(leading)
    values, rows = np.full(many, np.nan), [np.full((many, *s), np.nan) for s in shapes]
    for i in range(many):
        try:
            values[i], own = _value(asked, jax.tree.unflatten(tree, [v[i] for v in flat]), slopes)
        except (ValueError, SceneError):
            continue
        for row, slope in zip(rows, own, strict=True):
            row[i] = slope
    return (values.reshape(leading), *(row.reshape((*leading, *s)) for row, s in zip(rows, shapes, strict=True)))


def _number(asked: _Asked, given: Given):
    """The value of an event: outside transformations it raises, inside it is NaN where it is not there."""
    leaves, tree = jax.tree.flatten(given)
    if all(is_concrete(leaf) for leaf in leaves):
        return jnp.asarray(_value(asked, given, slopes=False)[0])
    shapes = [np.shape(leaf) for leaf in leaves]
    results = [jax.ShapeDtypeStruct(shape, jnp.result_type(float)) for shape in ((), *shapes)]

    def asked_for(slopes: bool, leaves):
        host = functools.partial(_on_host, asked, tree, shapes, slopes)
        return jax.pure_callback(host, tuple(results), *leaves, vmap_method="broadcast_all")

    @jax.custom_jvp
    def value(*leaves):
        return asked_for(False, leaves)[0]

    @value.defjvp
    def _(primals, tangents):
        found, *slopes = asked_for(True, primals)
        return found, sum(jnp.sum(slope * tangent) for slope, tangent in zip(slopes, tangents, strict=True))

    return value(*(jnp.asarray(leaf, float) for leaf in leaves))


def _asked(event: str, start: str, tolerance: float) -> _Asked:
    if start not in ("relaxed", "fresh"):
        raise ValueError(f'`start` must be "relaxed" or "fresh", but is {start!r}.')
    check_between("tolerance", tolerance, 1e-10, 1e-2)
    return _Asked(event, start, tolerance)


def _given(scene: Scene, value, rate) -> Given:
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    if not isinstance(scene.loading, (Chamber, ConstantPressure)):
        raise other_loading(scene.loading, Chamber, ConstantPressure)
    value, rate = (scene.dimensionless(v, "voltage") for v in (value, rate))
    return Given(scene.membrane, scene.loading, value, rate)


def snap_voltage(scene: Scene, rate, *, start: str = "relaxed", tolerance: float = 1e-8):
    """The voltage of the first instantaneous fold on a ramp Φ = `rate` t: dimensionless, or in V on a scene with units.

    Differentiable by the rate and by every number of the scene, forwards and in reverse, once; under `jax.vmap` and `jax.jit`
    too. `follow` says what else happens on the way.

    Args:
        scene: a scene with a chamber or a constant pressure.
        rate: dΦ/dt, in the unit of time of the relaxation times; its voltage in V on a scene with units.
        start: "relaxed" or "fresh", as in `follow`.
        tolerance: about the relative error of the value; derivatives have a few times it.

    Raises:
        ValueError: for bad input.
        SceneError: where the membrane creeps through, or breaks down before it jumps; inside transformations the value is NaN.

    >>> import jax
    >>> from dielectric_jax.model import Gent, Maxwell, Viscoelastic
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> scene = Scene(Membrane(rubber), Chamber(volume=1600.0, initial_volume=2.42))
    >>> value, slope = jax.value_and_grad(lambda rate: snap_voltage(scene, rate))(0.01)
    >>> round(float(value), 6), round(float(slope), 4)
    (0.146391, 2.5062)
    """
    given = _given(scene, 0.0, rate)
    return rate * _number(_asked("snap", start, tolerance), given)


def delay(scene: Scene, voltage, *, start: str = "relaxed", tolerance: float = 1e-8):
    """The time for which a membrane creeps under a held voltage until it jumps; 0 where it jumps as the voltage is applied.

    Differentiable like `snap_voltage`, by the voltage too. `start` and `tolerance` are those of `snap_voltage`, and so is what
    is raised.

    >>> from dielectric_jax.model import Gent, Maxwell, Viscoelastic
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> round(float(delay(Scene(Membrane(rubber), ConstantPressure(1.82)), 0.2)), 4)
    2.874
    """
    return _number(_asked("delay", start, tolerance), _given(scene, voltage, 0.0))


def peak_pressure(
    membrane: Membrane, rate, *, initial_volume, start: str = "relaxed", tolerance: float = 1e-8
) -> typing.Any:
    """The greatest pressure as a membrane is inflated from `initial_volume` at dV/dt = `rate`, without voltage.

    Differentiable like `snap_voltage`. Raises SceneError where the pressure has no peak.

    >>> from dielectric_jax.model import Gent, Maxwell, Viscoelastic
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> round(float(peak_pressure(Membrane(rubber), 0.5, initial_volume=0.5)), 6)
    2.369197
    """
    if not isinstance(membrane, Membrane):
        raise ValueError(f"`membrane` must be a Membrane, but is a {type(membrane).__name__}.")
    return _number(_asked("peak", start, tolerance), Given(membrane, None, initial_volume, rate))
