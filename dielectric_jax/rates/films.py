"""Homogeneous films in time: relaxation, loops of the stretch, creep under a dead load, and delayed pull-in."""

import dataclasses
import functools
import math
import typing
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray

from ..model import (
    FILM_MODES,
    AbstractMaterial,
    Film,
    FilmState,
    Maxwell,
    NeoHookean,
    Passed,
    Sampled,
    Units,
    Viscoelastic,
    film_of,
    film_states,
    is_concrete,
    pass_film,
    require_float64,
    spring_and_branches,
)
from ..numerics import Code, SceneError, cached_jit, check_between, check_positive, shown
from .protocols import Leg, Linear, Phase, legs_of, phases_of
from .resolution import FILM_POINTS, GRID_SIZES

__all__ = ["FilmEvent", "FilmRun", "PullIn", "film_stress", "follow_film", "pull_in", "vhb_hossain_2012"]

_STARTS = ("fresh", "relaxed")
_pass = cached_jit(pass_film)
_states = cached_jit(film_states)


@dataclasses.dataclass(frozen=True)
class FilmEvent:
    """Something that happens to a film: its kind, when, and the state there; `reason` says why a run ends."""

    kind: str
    time: float
    stretch: float
    transverse_stretch: float
    stress: float
    voltage: float
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class FilmRun:
    """A homogeneous film followed in time.

    The columns (n,) are `time`; `stretch` λ1 and `transverse_stretch` λ2; the nominal `stress` s1 = ∂w/∂λ1 at the voltage, in units of
    μ, which is the force for each undeformed cross-section; and `voltage` Φ. Where what is prescribed changes at once, a time stands
    twice, before and after. `dashpots` (n, K, 2) are the stretches ξ. `events` are start, pull_in, and end with a `reason`: "end of the
    protocol", "pull-in", or "not converged".
    """

    material: AbstractMaterial
    mode: str
    time: np.ndarray
    stretch: np.ndarray
    transverse_stretch: np.ndarray
    stress: np.ndarray
    voltage: np.ndarray
    dashpots: np.ndarray
    events: tuple[FilmEvent, ...]
    _again: "Callable[[], FilmRun]" = dataclasses.field(repr=False, compare=False)

    @property
    def reason(self) -> str:
        """Why the run ended."""
        return self.events[-1].reason

    @property
    def dataset(self) -> xarray.Dataset:
        """The columns by name."""
        names = ("time", "stretch", "transverse_stretch", "stress", "voltage")
        return xarray.Dataset({name: ("point", getattr(self, name)) for name in names})

    def event(self, kind: str) -> FilmEvent | None:
        """The first event of a kind, None where there is none."""
        return next((e for e in self.events if e.kind == kind), None)

    @functools.cached_property
    def error_estimate(self) -> float:
        """The largest relative difference of stretches and stresses, and of the events' times, from a run of a smaller tolerance.

        Infinite where its events are others.
        """
        finer = self._again()
        if [e.kind for e in finer.events] != [e.kind for e in self.events] or finer.reason != self.reason:
            return math.inf
        pairs = [(np.array([e.time for e in run.events]), run.stretch, run.stress) for run in (self, finer)]
        return max(float(np.max(np.abs(a - b) / np.maximum(np.abs(b), 1e-3))) for a, b in zip(*pairs, strict=True))


class _Setting(typing.NamedTuple):
    """What a run has throughout: the material, the mode, what is prescribed, whether there is a voltage, and the tolerance."""

    material: AbstractMaterial
    mode: str
    prescribed: str
    charged: bool
    tolerance: float
    times: np.ndarray | None

    def film(self, courses: dict, *, flows: bool, elastic: bool = False) -> Film:
        """The film under courses of what is prescribed."""
        material = spring_and_branches(self.material)[0] if elastic else self.material
        voltage = courses["voltage"] if self.charged else None
        course = courses[self.prescribed]
        return film_of(material, course, voltage, prescribed=self.prescribed, mode=self.mode, flows=flows)

    @property
    def times_of_branches(self) -> list[float]:
        """The relaxation times."""
        return [float(b.relaxation_time) for b in spring_and_branches(self.material)[1]]


class _Rows(typing.NamedTuple):
    """States (n, …) with the nominal stress and the voltage there."""

    states: FilmState
    stress: np.ndarray
    voltage: np.ndarray


@cached_jit
def _seen(film: Film, states: FilmState):
    """The nominal stress s1 and the voltage of states, (n,) each, and whether all springs are within their limits."""

    def one(state):
        stretches = jnp.exp(state.logs)
        fair = film.spring.admissible(*stretches)
        for branch, x in zip(film.branches, state.x, strict=True):
            fair = fair & branch.material.admissible(*jnp.exp(state.logs - x))
        voltage = jnp.zeros(()) if film.voltage is None else film.voltage(state.time)
        return film.stress(*state)[0] / stretches[0], voltage, fair

    return jax.vmap(one)(states)


def _rows(setting: _Setting, film: Film, states: FilmState) -> _Rows:
    """Rows of states; raises ValueError beyond the limits of a spring."""
    stress, voltage, fair = (np.asarray(v) for v in _seen(film, states))
    if not fair.all():
        worst = float(np.exp(np.asarray(states.logs)[np.flatnonzero(~fair)[0], 0]))
        raise ValueError(
            f"`{setting.prescribed}` must keep all springs of the material within their limits, but the stretch reaches {worst:.6g}."
        )
    return _Rows(FilmState(*(np.asarray(v) for v in states)), stress, voltage)


def _one(state: FilmState) -> FilmState:
    return FilmState(*(np.asarray(v)[None] for v in state))


def _leapt(setting: _Setting, courses: dict, state: FilmState, *, elastic: bool = False) -> Passed:
    """What is prescribed changes along m from 0 to 1 while the dashpots stay where they are."""
    film = setting.film(courses, flows=False, elastic=elastic)
    begin = FilmState(0.0, state.logs, state.x)
    found = _pass(film, begin, 1.0, 1.0, setting.tolerance)
    if found.good and not found.pulled and abs(float(found.state.time) - 1.0) > 1e-9:  # a fold just behind
        states, good = _states(film, begin, np.array([0.0, 1.0]), setting.tolerance)
        found = Passed(FilmState(*(v[-1] for v in states)), found.pulled, good)
    return found


def _begun(setting: _Setting, start: str, value: float) -> FilmState:
    """The state at zero voltage from which a run starts."""
    count = len(setting.times_of_branches)
    unloaded = FilmState(0.0, np.zeros(2), np.zeros((0 if start == "relaxed" else count, 2)))
    if setting.prescribed == "stretch":
        logs = math.log(value) * np.array([1.0, FILM_MODES[setting.mode].ratio])
    elif value == 0:
        logs = unloaded.logs
    else:
        courses = {setting.prescribed: Linear(0.0, value, 0.0), "voltage": Linear(0.0, 0.0, 0.0)}
        found = _leapt(setting, courses, unloaded, elastic=start == "relaxed")
        if not found.good or found.pulled:
            raise SceneError(Code.no_equilibrium, f"No film holds the {setting.prescribed} {value:.6g} at the start.")
        logs = np.asarray(found.state.logs)
    x = np.broadcast_to(logs, (count, 2)).copy() if start == "relaxed" else np.zeros((count, 2))
    return FilmState(0.0, logs, x)


def _shares(setting: _Setting, phase: Phase, pulls_in: bool) -> np.ndarray:
    """From 0 to 1, where in a phase the film is looked at: more often after its begin, and before a pull-in."""
    even = np.linspace(0.0, 1.0, FILM_POINTS)
    if pulls_in:
        return 1 - (1 - even[:-1]) ** 2  # near it the stretch changes as the root of the time that is left
    times = setting.times_of_branches
    if phase.kind != "hold" or not times:
        return even
    rise = math.log1p((phase.end - phase.begin) / min(times))
    return np.expm1(rise * even) / math.expm1(rise)


def _padded(times: np.ndarray) -> np.ndarray:
    """Times with others between them, to a length for which programs are compiled."""
    size = next((s for s in GRID_SIZES if s >= len(times)), len(times))
    while len(times) < size:
        widest = int(np.argmax(np.diff(times)))
        times = np.insert(times, widest + 1, (times[widest] + times[widest + 1]) / 2)
    return times


def _moments(setting: _Setting, phase: Phase, end: float, pulls_in: bool) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) of a phase up to `end`, and which of them are asked for."""
    if setting.times is None:
        asked = phase.begin + (end - phase.begin) * _shares(setting, phase, pulls_in)
    else:
        last = end if end >= setting.times[-1] else np.nextafter(end, -math.inf)
        asked = setting.times[(setting.times >= phase.begin) & (setting.times <= last)]
    # at a pull-in the rates are infinite: the integration in time ends before it
    ends = [phase.begin, max(asked[-1:], default=phase.begin)] if pulls_in else [phase.begin, end]
    moments = np.unique(np.concatenate([asked, ends]))
    if len(moments) < 2:
        moments = np.append(moments, (moments[0] + end) / 2)
    moments = _padded(moments)
    return moments, np.isin(moments, asked)


def _flown(setting: _Setting, phase: Phase, state: FilmState) -> tuple[_Rows, FilmState, str]:
    """A phase in time: its rows, its last state, and what ended it, "end", "pull_in" or "lost"."""
    film, end, event = setting.film(phase.courses, flows=True), phase.end, "end"
    last = None
    if setting.prescribed != "stretch":
        kappa = max(setting.times_of_branches, default=phase.end - phase.begin)
        begin = FilmState(phase.begin, state.logs, state.x)
        found = _pass(film, begin, phase.end, kappa, setting.tolerance)
        if not found.good:
            event = "lost"
        elif found.pulled:
            last, end, event = FilmState(*(np.asarray(v) for v in found.state)), float(found.state.time), "pull_in"
    moments, asked = _moments(setting, phase, end, last is not None)
    states, good = _states(film, FilmState(moments[0], state.logs, state.x), moments, setting.tolerance)
    states = FilmState(*(np.asarray(v) for v in states))
    final = FilmState(*(v[-1] for v in states)) if last is None else last
    kept = FilmState(*(v[asked] for v in states))
    if last is not None:
        kept = FilmState(*(np.concatenate([v, np.asarray(w)[None]]) for v, w in zip(kept, last, strict=True)))
    return _rows(setting, film, kept), final, event if good else "lost"


_REASONS = {"end": "end of the protocol", "pull_in": "pull-in", "lost": "not converged"}


def _event(kind: str, rows: _Rows, reason: str = "") -> FilmEvent:
    """An event at the last of some rows."""
    l1, l2 = np.exp(rows.states.logs[-1])
    time, stress, voltage = (float(v[-1]) for v in (rows.states.time, rows.stress, rows.voltage))
    return FilmEvent(kind, time, float(l1), float(l2), stress, voltage, reason)


def _at(rows: _Rows, time: float) -> _Rows:
    """Rows at a time, of a leap, in which the time stands."""
    return rows._replace(states=rows.states._replace(time=np.full(len(rows.stress), time)))


def _followed(setting: _Setting, legs: dict[str, list[Leg]], start: str) -> FilmRun:
    """The run, phase by phase."""
    state, event = _begun(setting, start, legs[setting.prescribed][0].at(0.0)), "end"
    zero = {n: Linear(own[0].at(0.0) if n != "voltage" else 0.0, 0.0, 0.0) for n, own in legs.items()}
    last = _rows(setting, setting.film(zero, flows=False), _one(state))
    events, found, time = [_event("start", last)], [], 0.0
    for phase in phases_of(legs, setting.prescribed):
        film = setting.film(phase.courses, flows=phase.kind != "leap")
        if phase.kind != "leap":
            rows, state, event = _flown(setting, phase, state)
            found.append(rows)
            time = float(state.time)
            last = _rows(setting, film, _one(state))
        elif film.explicit:
            state = FilmState(time, np.asarray(film.given_logs(1.0)), state.x)
        else:
            done = _leapt(setting, phase.courses, state)
            state = FilmState(*(np.asarray(v) for v in done.state))
            event = "lost" if not done.good else "pull_in" if done.pulled else "end"
            last = _at(_rows(setting, film, _one(state)), time)
            found += [last] if event == "pull_in" else []
        if event != "end":
            break
    events += [_event("pull_in", last)] if event == "pull_in" else []
    events.append(_event("end", last, _REASONS[event]))
    again = functools.partial(_followed, setting._replace(tolerance=setting.tolerance / 30), legs, start)
    return _run(setting, found, events, again)


def _run(setting: _Setting, found: list[_Rows], events: list[FilmEvent], again) -> FilmRun:
    """The record, without the rows that repeat the one before."""
    columns = [(r.states.time, *np.exp(r.states.logs.T), r.stress, r.voltage) for r in found]
    table = np.concatenate([np.stack(c, axis=1) for c in columns])
    dashpots = np.concatenate([np.exp(r.states.x) for r in found])
    new = np.ones(len(table), bool)
    new[1:] = np.any(np.abs(np.diff(table, axis=0)) > 1e-9 * np.abs(table[1:]), axis=1)
    time, stretch, transverse, stress, voltage = table[new].T
    return FilmRun(
        setting.material, setting.mode, time, stretch, transverse, stress, voltage, dashpots[new], tuple(events), again
    )


def follow_film(
    material: AbstractMaterial,
    *,
    stretch: typing.Any = None,
    force: typing.Any = None,
    pressure: typing.Any = None,
    voltage: typing.Any = 0.0,
    mode: str = "equal_biaxial",
    start: str = "fresh",
    duration: float | None = None,
    times: typing.Any = None,
    tolerance: float = 1e-8,
) -> FilmRun:
    """Follows a homogeneous film in time, balanced at every instant, from its state at zero voltage.

    With T_i = λ_i ∂w/∂λ_i of w = W(λ1, λ2) + Σ g_k W_k(λ1/ξ1k, λ2/ξ2k) − q e (λ1 λ2)²/2, q = Φ²,

        d ln ξ1/dt = (T1k − T2k/2)/(3τ_k),        d ln ξ2/dt = (T2k − T1k/2)/(3τ_k),

    and λ1 as prescribed, T1 = s λ1 under a dead load s, or T1 = p λ³/2 in a spherical balloon. A film under load pulls in where its
    stiffness at frozen dashpots is lost: the run ends there. Source: Hong, J. Mech. Phys. Solids 59 (2011) 637,
    doi 10.1016/j.jmps.2010.12.003.

    Everything is dimensionless, and times are in the unit of the relaxation times. Of `stretch`, `force` and `pressure` one is given.

    Args:
        material: a `Viscoelastic` or an elastic material.
        stretch: λ1: a `Ramp`, `Hold`, `Steps`, `Triangle`, a function of time written with jax.numpy, or a number that is held.
        force: likewise the dead load s, in units of μ on the undeformed cross-section.
        pressure: likewise the pressure of a spherical balloon, in units of μH/R with its undeformed radius R; equal-biaxial only.
        voltage: likewise Φ, in units of H√(μ/ε).
        mode: "equal_biaxial", λ2 = λ1; "uniaxial", no transverse stress; "pure_shear", λ2 = 1.
        start: "fresh", just stretched or loaded, the dashpots have not moved; "relaxed" after a long wait, the branches carry nothing.
        duration: when the run ends at the latest; needed where no protocol ends, unless `times` are given.
        times: times (n,) at which the film is looked at, rising, none negative; the last one ends the run, unless there is a
            duration. By default 65 in each leg.
        tolerance: of the integration, relative.

    Raises:
        ValueError: for bad input, and where a spring is stretched beyond its limit.
        SceneError: where the film holds no such load at the start.

    >>> from dielectric_jax.model import Maxwell, NeoHookean, Viscoelastic
    >>> rubber = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> run = follow_film(rubber, stretch=2.0, times=[0.0, 1.0])
    >>> [round(float(s), 6) for s in run.stress]  # 2 (λ − λ⁻⁵), and after a relaxation time
    [3.9375, 2.710311]
    """
    require_float64()
    given = {"stretch": stretch, "force": force, "pressure": pressure}
    named = [n for n, p in given.items() if p is not None]
    if len(named) != 1:
        said = " and ".join(f"`{n}`" for n in named) + (" are" if named else "none is")
        raise ValueError(f"One of `stretch`, `force` and `pressure` must be given, but {said}.")
    prescribed = named[0]
    _check_options(material, mode, start, prescribed)
    check_between("tolerance", tolerance, 1e-13, 1e-2)
    if duration is not None:
        check_positive("duration", float(duration))
    end = math.inf if duration is None else float(duration)
    if times is not None and duration is None:
        end = _asked(times, math.inf)[-1]
    legs = {n: legs_of(n, p, end) for n, p in ((prescribed, given[prescribed]), ("voltage", voltage))}
    last = min(own[-1].end for own in legs.values())
    if not math.isfinite(last):
        raise ValueError("`duration` or `times` must be given where no protocol ends, but are None.")
    _check_values(prescribed, legs[prescribed], last)
    charged = any(not isinstance(leg.course, Linear) or leg.course.value or leg.course.rate for leg in legs["voltage"])
    moments = None if times is None else _asked(times, last)
    return _followed(_Setting(material, mode, prescribed, charged, tolerance, moments), legs, start)


def _check_options(material, mode: str, start: str, prescribed: str) -> None:
    if not isinstance(material, AbstractMaterial):
        raise ValueError(f"`material` must be a material such as Viscoelastic(...), but is {shown(material)}.")
    if mode not in FILM_MODES:
        raise ValueError(f"`mode` must be one of {', '.join(FILM_MODES)}, but is {mode!r}.")
    if prescribed == "pressure" and mode != "equal_biaxial":
        raise ValueError(f'`mode` must be "equal_biaxial" for a balloon under `pressure`, but is {mode!r}.')
    if start not in _STARTS:
        raise ValueError(f'`start` must be "fresh" or "relaxed", but is {start!r}.')


def _check_values(name: str, legs: list[Leg], last: float) -> None:
    """Refuses stretches that are not positive, and negative loads, at the ends of the legs."""
    for leg in legs:
        for value in (leg.at(leg.begin), leg.at(min(leg.end, last))):
            check_positive(name, value, zero=name != "stretch")


def _asked(times, last: float) -> np.ndarray:
    moments = np.asarray(times, float)
    if moments.ndim != 1 or not moments.size or not np.all(np.diff(moments) > 0) or not np.isfinite(moments).all():
        raise ValueError(f"`times` must be finite numbers that rise, but are {shown(times)}.")
    if moments[0] < 0 or moments[-1] > last:
        raise ValueError(
            f"`times` must lie between 0 and the end, {last:.6g}, but are from {moments[0]:.6g} to {moments[-1]:.6g}."
        )
    return moments


@eqx.filter_jit
def _stress_of(material, time, stretch, mode, start, tolerance, adjoint):
    film = film_of(material, Sampled(time, stretch), None, prescribed="stretch", mode=mode)
    logs = film.given_logs(time[0])
    x = jnp.broadcast_to(logs if start == "relaxed" else 0.0, (len(film.branches), 2))
    states, good = film_states(film, FilmState(time[0], logs, x), time, tolerance, adjoint)
    stress = jax.vmap(lambda s: film.stress(*s)[0])(states) / stretch
    return jnp.where(good, stress, jnp.nan)


def film_stress(
    material: AbstractMaterial,
    time: typing.Any,
    stretch: typing.Any,
    *,
    mode: str = "equal_biaxial",
    start: str = "fresh",
    tolerance: typing.Any = 1e-8,
    adjoint: typing.Any = None,
) -> jax.Array:
    """The nominal stresses s1 (n,), in units of μ, of a film whose stretch λ1 passes samples, linearly between them.

    A function to transform with jax.jit, jax.vmap and jax.grad, of the material's constants too; the equations are those of
    `follow_film`, without a voltage.

    Args:
        material: a `Viscoelastic` or an elastic material.
        time: rising times (n,), two or more, in the unit of the relaxation times.
        stretch: λ1 at these times.
        mode: "equal_biaxial", "uniaxial" or "pure_shear".
        start: "fresh" or "relaxed" at the first sample.
        tolerance: of the integration, relative. Derivatives have one or two digits less than values: choose a smaller one for them.
        adjoint: how derivatives are taken, by an adjoint of diffrax: by default backwards, for jax.grad; diffrax.ForwardMode() for
            jax.jvp and jax.jacfwd.

    Raises:
        ValueError: for bad input that is known when the function is traced. Where the integration fails the stresses are NaN.

    >>> from dielectric_jax.model import Maxwell, NeoHookean, Viscoelastic
    >>> rubber = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> relaxed = film_stress(rubber, [0.0, 0.5, 1.0], [2.0, 2.0, 2.0])
    >>> round(float(relaxed[-1]), 6)
    2.710311
    """
    require_float64()
    _check_options(material, mode, start, "stretch")
    moments, stretches = jnp.asarray(time, float), jnp.asarray(stretch, float)
    if moments.ndim != 1 or len(moments) < 2 or moments.shape != stretches.shape:
        raise ValueError(
            f"`time` and `stretch` must be rows of as many numbers, two or more, but have shapes {moments.shape} and "
            f"{stretches.shape}."
        )
    return _stress_of(material, moments, stretches, mode, start, tolerance, adjoint)


class PullIn(typing.NamedTuple):
    """A delayed pull-in: its `time` after the loads, and the `stretch` at which the stiffness at frozen dashpots is lost."""

    time: typing.Any
    stretch: typing.Any


def _pull_in_of(setting: _Setting, loads, duration, start: str, adjoint) -> PullIn:
    """The pull-in, NaN where there is none; outside a transformation with the programs of `follow_film`."""
    run = _pass if adjoint is None else functools.partial(pass_film, adjoint=adjoint)
    times = [b.relaxation_time for b in spring_and_branches(setting.material)[1]]
    count, tolerance = len(times), setting.tolerance
    load, voltage = (jnp.asarray(v, float) for v in loads)
    none = jnp.zeros(())

    def film(course, charge, *, flows, elastic=False):
        courses = {setting.prescribed: Linear(*course), "voltage": Linear(*charge)}
        return setting.film(courses, flows=flows, elastic=elastic)

    state, x = FilmState(none, jnp.zeros(2), jnp.zeros((0, 2))), jnp.zeros((count, 2))
    fair, rise = jnp.asarray(True), (none, load, none)
    if start == "relaxed":
        rest = run(film(rise, (none,) * 3, flows=False, elastic=True), state, 1.0, 1.0, tolerance)
        fair, state, rise = rest.good & ~rest.pulled, rest.state, (load, none, none)
        x = jnp.broadcast_to(state.logs, (count, 2))
    leap = film(rise, (none, voltage, none), flows=False)
    reached = run(leap, FilmState(none, state.logs, x), 1.0, 1.0, tolerance)
    fair = fair & reached.good & (reached.pulled | (jnp.abs(reached.state.time - 1) < 1e-9))
    kappa = jnp.max(jnp.stack([jnp.asarray(t) for t in times])) if times else duration
    held = film((load, none, none), (voltage, none, none), flows=True)
    found = run(held, reached.state._replace(time=none), duration, kappa, tolerance)
    good = fair & (reached.pulled | (found.good & found.pulled))
    time = jnp.where(reached.pulled, 0.0, found.state.time)
    logs = jnp.where(reached.pulled, reached.state.logs[0], found.state.logs[0])
    return PullIn(jnp.where(good, time, jnp.nan), jnp.where(good, jnp.exp(logs), jnp.nan))


def pull_in(
    material: AbstractMaterial,
    *,
    voltage: typing.Any,
    force: typing.Any = None,
    pressure: typing.Any = None,
    duration: typing.Any,
    mode: str = "equal_biaxial",
    start: str = "fresh",
    tolerance: typing.Any = 1e-8,
    adjoint: typing.Any = None,
) -> PullIn:
    """When a film under a held voltage and a dead load pulls in, and at which stretch.

    There the stiffness at frozen dashpots, ∂(T1 − s λ1)/∂ln λ1 of an equal-biaxial film, vanishes; the time is 0 where the film
    cannot hold the voltage at all. A function to transform with jax.jit, jax.vmap and jax.grad; words as in `follow_film`.

    Args:
        material: a `Viscoelastic` material.
        voltage: Φ, held from time 0 on.
        force: the dead load s, or none.
        pressure: in place of it, the pressure of a spherical balloon.
        duration: the longest time that is looked at.
        mode: "equal_biaxial", "uniaxial" or "pure_shear".
        start: "fresh" or "relaxed" under the load at zero voltage.
        tolerance: of the integration, relative.
        adjoint: an adjoint of diffrax: by default backwards, for jax.grad; diffrax.ForwardMode() for jax.jvp.

    Raises:
        ValueError: for bad input.
        SceneError: where the film does not pull in within the duration. Inside a transformation time and stretch are NaN instead.

    >>> from dielectric_jax.model import Maxwell, NeoHookean, Viscoelastic
    >>> rubber = Viscoelastic(NeoHookean(), [Maxwell(NeoHookean(), modulus_ratio=1.0, relaxation_time=1.0)])
    >>> found = pull_in(rubber, voltage=0.4, force=1.0, duration=100.0)
    >>> round(float(found.time), 4)
    9.9744
    """
    require_float64()
    if force is not None and pressure is not None:
        raise ValueError("`force` or `pressure` must be given, at most one of the two, but both are.")
    prescribed = "force" if pressure is None else "pressure"
    _check_options(material, mode, start, prescribed)
    load = pressure if pressure is not None else 0.0 if force is None else force
    setting = _Setting(material, mode, prescribed, True, tolerance, None)
    found = _pull_in_of(setting, (load, voltage), jnp.asarray(duration, float), start, adjoint)
    if is_concrete(found.time) and not np.isfinite(found.time).all():
        raise SceneError(Code.no_fold, f"The film does not pull in within {float(duration):.6g}.")
    return found


def vhb_hossain_2012(*, thickness: float = 1e-3, radius: float = 22.5e-3) -> tuple[Viscoelastic, Units]:
    """VHB 4910 as a neo-Hookean spring and three branches, with relaxation times in seconds, and its units.

    μ∞ = 13.7 kPa beside (56.4 kPa, 0.82 s), (31.5 kPa, 10.7 s) and (19.8 kPa, 500 s): the fit of Hossain, Vu and Steinmann, Comput.
    Mater. Sci. 59 (2012) 65, to tests at 50 % deformation, as listed in the examples of the public code HyperFEM. There the branches flow
    by another law, which is that of `Maxwell` at small strains only. The unit of stress is μ∞; a film that has no time to relax is
    8.9 times as stiff.

    Args:
        thickness: undeformed thickness H in m.
        radius: undeformed radius A in m.

    >>> material, units = vhb_hossain_2012()
    >>> [round(float(b.modulus_ratio * units.shear_modulus / 1e3), 1) for b in material.branches]
    [56.4, 31.5, 19.8]
    """
    equilibrium = 13.7e3
    branches = [
        Maxwell(NeoHookean(), modulus_ratio=modulus / equilibrium, relaxation_time=time)
        for modulus, time in ((56.4e3, 0.82), (31.5e3, 10.7), (19.8e3, 500.0))
    ]
    return Viscoelastic(NeoHookean(), branches), Units(equilibrium, thickness, radius)
