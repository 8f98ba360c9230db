"""The membrane in time: legs of a protocol, jumps at instantaneous folds, and what happens."""

import math
import typing
from collections.abc import Sequence

from ..diagram import Diagram, voltage_volume
from ..model import Membrane, Scene, as_scalar
from ..numerics import check_between, shown
from .passages import Asking, Now, Passed, Setting, passed
from .phases import begun, scale_of, setting_of
from .programs import Seen
from .protocols import Linear, Phase, document_of, legs_of, phases_of
from .requests import serve
from .resolution import LANDING_TOLERANCE, MESHES, MOST_JUMPS, TOLERANCE_SHARE, VOLUME_SCALE
from .runs import Run, at_rest, converted, dataset_of, event_of, slopes_of

__all__ = ["bounds", "follow"]

_STARTS = ("relaxed", "fresh")
_REASONS = {
    "end": "end of the protocol",
    "at_rest": "at rest",
    "hoop_tension_loss": "hoop tension lost",
    "breakdown": "breakdown on the branch",
    "lost": "not converged",
    "unfinished": "too many steps",
}


def _jumped(setting: Setting, now: Now, phase: Phase, moment: float) -> Asking[Passed]:
    """From an instantaneous fold to the state at the same voltage (or pressure) and dashpots on which the jump lands.

    At the fold κ dV/dσ = 1: the volume goes the way that the sign of κ says. There q(V) turns back to its value from below if it
    rises, from above if it falls.
    """
    driver = "pressure" if setting.driven == "pressure" else "voltage"
    sense = math.copysign(1.0, scale_of(setting, phase, moment)[0])
    level = sense * float(phase.courses[driver](moment)) ** (2 if driver == "voltage" else 1)
    frozen = {name: Linear(float(course(moment)), 0.0, 0.0) for name, course in phase.courses.items()}
    start = Now(now.shape._replace(moment=level), now.x)
    return (yield from passed(setting, start, setting.free(frozen, driver, sense), level, "jump", VOLUME_SCALE))


def _snapped(
    setting: Setting, now: Now, phase: Phase, at: tuple[float, float], seen: Seen, jumps: int
) -> Asking[tuple[str, Seen]]:
    """Notes an instantaneous fold at (m, time) and jumps from it.

    Returns why the run ends there, or nothing where it goes on, and what is seen last.
    """
    moment, time = at
    now.events.append(event_of("instantaneous_fold", seen, time))
    if setting.driven == "volume":
        return "fold at a prescribed volume", seen
    if jumps > MOST_JUMPS:
        return "too many jumps", seen
    landed = yield from _jumped(setting, now, phase, moment)
    if landed.event != "end":
        return "landing not found", seen
    now.events.append(event_of("landing", landed.seen, time))
    now.shape = landed.instant.shape
    if landed.seen.breakdown_ratio >= 1:
        now.events.append(event_of("breakdown", landed.seen, time))
        return "breakdown in the snap", landed.seen
    if landed.seen.hoop_tension <= 0:
        now.events.append(event_of("hoop_tension_loss", landed.seen, time))
        return "hoop tension lost", landed.seen
    return "", landed.seen


def _followed(setting: Setting, legs: dict, start: str) -> Asking[Run]:
    """A run, as a generator of requests."""
    setting, now = yield from begun(setting, start, {n: own[0].at(0.0) for n, own in legs.items()})
    time, jumps, seen, reason = 0.0, 0, None, ""
    for phase in phases_of(legs, setting.driven):
        moment = phase.begin
        while True:
            kappa, unit = scale_of(setting, phase, moment)
            balance = setting.balance(phase.courses, flows=phase.kind != "leap", kappa=kappa)
            now.shape = now.shape._replace(moment=moment)
            found = yield from passed(setting, now, balance, phase.end, phase.kind, unit)
            if not now.rows:
                now.events.append(event_of("start", found.rows[0], 0.0))
            now.note(phase.kind, found, time if phase.kind == "leap" else None)
            now.shape, now.x, seen = found.instant.shape, found.instant.x, found.seen
            moment = float(found.instant.shape.moment)
            time = time if phase.kind == "leap" else moment
            if found.event != "fold":
                break
            jumps += 1
            reason, seen = yield from _snapped(setting, now, phase, (moment, time), seen, jumps)
            if reason:
                return _run(setting, now, seen, time, reason)
        reason = _REASONS[found.event]
        if found.event in ("breakdown", "hoop_tension_loss"):
            now.events.append(event_of(found.event, seen, time))
        if found.event != "end":
            break
    return _run(setting, now, seen, time, reason)


def _run(setting: Setting, now: Now, seen: Seen | None, time: float, reason: str) -> Run:
    assert seen is not None
    order = {"start": 0, "end": 2}
    events = sorted(now.events, key=lambda e: (order.get(e.kind, 1), e.time))
    end = event_of("end", seen, time, reason)
    return Run(
        setting.scene,
        (*events, end),
        dataset_of(now.rows),
        max(now.defects, default=0.0),
        setting.protocol,
        slopes_of(now.rows),
        tuple(row.instant for row in now.rows),
        setting.again,
    )


def _frozen(setting: Setting, start: str) -> Asking[Run]:
    """The equilibria with the dashpots where they are at the start, by rising volume, up to breakdown or the loss of hoop tension."""
    setting, now = yield from begun(setting, start, {})
    balance = setting.free({}, "voltage", 1.0)
    found = yield from passed(setting, now, balance, math.inf, "frozen", VOLUME_SCALE)
    now.events.insert(0, event_of("start", found.rows[0], 0.0))
    now.note("leap", found, 0.0)
    return _run(setting, now, found.seen, 0.0, _REASONS[found.event])


def follow(
    scene: Scene | Membrane | Sequence[Scene | Membrane],
    *,
    voltage: typing.Any = 0.0,
    volume: typing.Any = None,
    pressure: typing.Any = None,
    start: str = "relaxed",
    duration: float | None = None,
    tolerance: float = 1e-6,
) -> typing.Any:
    """Follows a viscoelastic membrane in time, balanced at every instant, from its state at zero voltage.

    On a scene with units what is prescribed is in SI (V, m³, Pa). The run that comes back holds dimensionless numbers; `run.to_json(units)`
    and the plots convert them. Times are in the unit of the relaxation times.

    Args:
        scene: the scene, or the membrane alone where its volume or pressure is prescribed; or a sequence, followed side by side.
        voltage: a `Ramp`, `Hold`, `Steps`, `Triangle`, a function of time written with jax.numpy, or a number that is held; or a
            sequence of these, one a scene. Where it changes at once the dashpots are frozen meanwhile.
        volume: likewise, in place of the scene's loading; the pressure is what the membrane needs.
        pressure: likewise, in place of the scene's loading.
        start: "relaxed" after a long wait at the start, the branches carry nothing; "fresh", just stretched, the dashpots have not moved.
        duration: when a run ends at the latest; None lets it go on until the protocol ends or something happens.
        tolerance: about the relative error of events.

    Returns:
        A `Run`, or a list of them, in which the error of a scene without a start stands in place of its run. At an instantaneous fold the film jumps at frozen dashpots; a jump is an event with its landing,
        never silent. A run ends with a reason: "end of the protocol", "at rest", "breakdown on the branch", "breakdown in the snap",
        "hoop tension lost", "landing not found", "not converged" and others that say what could not be followed.

    Raises:
        ValueError: for bad input.
        SceneError: where a single scene has no start.

    >>> from dielectric_jax.model import ConstantPressure, Gent, Maxwell, Viscoelastic
    >>> from dielectric_jax.rates import Ramp
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> scene = Scene(Membrane(rubber), ConstantPressure(1.82))
    >>> run = follow(scene, voltage=Ramp(rate=0.01))
    >>> run.snap.kind, round(run.snap.at.voltage, 6), run.reason
    ('jump', 0.183281, 'breakdown in the snap')
    """
    if start not in _STARTS:
        raise ValueError(f'`start` must be "relaxed" or "fresh", but is {start!r}.')
    check_between("tolerance", tolerance, 1e-10, 1e-2)
    end = math.inf if duration is None else float(as_scalar(duration))
    if not end > 0:
        raise ValueError(f"`duration` must be positive, but is {end!r}.")
    protocols = {n: p for n, p in (("voltage", voltage), ("volume", volume), ("pressure", pressure)) if p is not None}
    if "volume" in protocols and "pressure" in protocols:
        raise ValueError("`volume` or `pressure` must be given, at most one of the two, but both are.")
    one = isinstance(scene, (Scene, Membrane))
    scenes = [scene] if one else list(typing.cast(Sequence, scene))
    given = []
    for name, own in protocols.items():
        many = isinstance(own, (list, tuple))
        if many and len(own) != len(scenes):
            raise ValueError(f"`{name}` must be one protocol, or one a scene, {len(scenes)}, but are {len(own)}.")
        each = own if many else [own] * len(scenes)
        given.append([(name, legs_of(name, p, end), document_of(p)) for p in each])
    for own in scenes:
        if not isinstance(own, (Scene, Membrane)):
            raise ValueError(f"`scene` must be a Scene, a Membrane or a sequence of them, but is {shown(own)}.")
    asked = {"start": start, "until": duration, "tolerance": tolerance}
    runs = []
    for own, named in zip(scenes, zip(*given, strict=True), strict=True):
        named = [_dimensionless(own, *row) for row in named]
        protocol = {name: said for name, _, said in named} | asked
        runs.append(_run_of(own, {name: legs for name, legs, _ in named}, protocol, MESHES[0], tolerance))
    found = serve(runs, keep_errors=not one)
    return found[0] if one else found


def _dimensionless(scene: Scene | Membrane, name: str, legs: list, document: dict) -> tuple[str, list, dict]:
    """Legs and document of a protocol that is given as the scene takes it."""
    if not isinstance(scene, Scene) or scene.units is None:
        return name, legs, document
    factor = 1 / float(scene.units.scale(name))
    made = [leg._replace(course=leg.course.times(factor)) for leg in legs]
    return name, made, converted(document, lambda value: value * factor)


def _run_of(scene, legs: dict, protocol: dict, mesh: tuple[int, int], tolerance: float) -> Asking[Run]:
    """The generator of one run."""

    def again() -> Asking[Run]:
        return _run_of(scene, legs, protocol, MESHES[1], tolerance / 30)

    setting = setting_of(scene, legs, protocol, mesh, TOLERANCE_SHARE * tolerance ** (2 / 3), again)
    return _followed(setting, legs, protocol["start"])


def bounds(scene: Scene, *, start: str = "relaxed") -> tuple[Diagram, Run]:
    """The two limits of a ramp of the voltage: infinitely slow, the diagram at rest, and infinitely fast, at frozen dashpots.

    The first is `voltage_volume` of the equilibrium spring. The second is a `Run` by rising volume at time 0, whose voltages are those of
    equilibria with the dashpots where they are at the start; its events "instantaneous_fold" are where an infinitely fast ramp snaps.
    Raises ValueError for bad input, and SceneError where there is no start.

    >>> from dielectric_jax.model import ConstantPressure, Gent, Maxwell, Viscoelastic
    >>> rubber = Viscoelastic(Gent(270.0), [Maxwell(Gent(270.0), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> slow, fast = bounds(Scene(Membrane(rubber), ConstantPressure(1.82)))
    >>> round(slow.ramp()["snap"][0].state.voltage, 6), round(fast.event("instantaneous_fold").voltage, 6)
    (0.114568, 0.281641)
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    if start not in _STARTS:
        raise ValueError(f'`start` must be "relaxed" or "fresh", but is {start!r}.')
    fast = serve([_run_frozen(scene, start, MESHES[0], LANDING_TOLERANCE)])[0]
    return voltage_volume(at_rest(scene)), fast


def _run_frozen(scene: Scene, start: str, mesh: tuple[int, int], tolerance: float) -> Asking[Run]:
    """The generator of the infinitely fast limit."""

    def again() -> Asking[Run]:
        return _run_frozen(scene, start, MESHES[1], tolerance / 30)

    return _frozen(setting_of(scene, {}, {"start": start}, mesh, tolerance, again), start)
