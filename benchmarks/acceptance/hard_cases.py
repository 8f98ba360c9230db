"""Hard cases: what is asked, what is true and how it is known, what is answered. Is any answer wrong without saying so?

The truth comes from `truth.py` and `contour_truth.py` (extended precision, no code of the package), closed forms, series,
and reference numbers of other methods. A row is right where the true error is at most ten times the estimate, or the answer
carries a flag, a result code or an error that names the limit that it reached.

    python -m benchmarks.acceptance.hard_cases [--case NUMBER …] [--table FILE] [--json FILE|-] [--quick]
"""

import dataclasses
import math
import pathlib
import sys
from collections.abc import Callable, Iterator

import jax
import numpy as np

import dielectric_jax as dj
from benchmarks import harness
from benchmarks.truth import contours as contour_truth
from benchmarks.truth import extended_precision as truth
from dielectric_jax import SceneError
from dielectric_jax.model import Outcome
from dielectric_jax.numerics import Code

jax.config.update("jax_enable_x64", True)

ALLOWED = 10.0  # times the estimate
TOLERANCE = 1e-9
J, FILLING = 270.0, 2.42
# Φ = 0, λ0 = 1, J = 270, by `contour_truth` and, to the digits it has, by the potential energy on spectral elements
PEAK_PRESSURE, PEAK_STRETCH, PEAK_VOLUME = 1.908684829413843, 2.263105929447912, 2.9634068291
START_PRESSURE = 1.886612680244900  # at V_0 = 2.42
HENCKY = 0.96516290  # V = 0.96516290 (p/3)^⅓ of the plate without bending, ν = ½; its next term is smaller by (p/3)^⅔
CUSPS = (484.04966, 551.39914)  # V_C at V_0 = 2.42, between which nothing snaps
SPIRAL_30 = (0.25123405938, 0.24314276881, 0.24351880450)  # Φ of the first folds of V_C = 30


@dataclasses.dataclass
class Row:
    """One question: `error` beside `estimate`; `flag` names what the answer itself says of its limits."""

    asked: str
    true: str
    known: str
    answered: str
    error: float
    estimate: float = TOLERANCE
    flag: str = ""
    engine: str = "continuation"
    seconds: float = 0.0
    compile_seconds: float = 0.0
    counts: dict = dataclasses.field(default_factory=dict)
    case: str = ""

    @property
    def right(self) -> bool:
        return bool(self.flag) or bool(self.error <= ALLOWED * self.estimate)


CASES: dict[str, tuple[str, Callable]] = {}
compiled = harness.Compilations()


def case(number: str, title: str):
    """Registers the rows of a case, a function of `quick`; each row knows the seconds since the row before."""

    def register(function: Callable[[bool], Iterator[Row]]):
        def rows(quick: bool) -> Iterator[Row]:
            for row in function(quick):
                row.case = f"{number} {title}"
                yield row

        CASES[number] = (title, rows)
        return rows

    return register


@dataclasses.dataclass
class Answer:
    """What a call gave or raised, its seconds, and those of compiling."""

    value: object
    error: Exception | None
    seconds: float
    compile_seconds: float

    @property
    def said(self) -> str:
        """The refusal in short: the code of a scene without answer, or the sentence about bad input."""
        return getattr(getattr(self.error, "code", None), "name", None) or str(self.error)

    def row(self, asked, true, known, answered, error, estimate=TOLERANCE, flag="", **more) -> Row:
        spent = {"seconds": self.seconds, "compile_seconds": self.compile_seconds}
        return Row(asked, true, known, answered, float(error), float(estimate), flag, **spent, **more)


def ask(function: Callable, *args, **options) -> Answer:
    """The answer of a call; only refusals in words are caught."""
    watch, before = harness.Stopwatch(), compiled.seconds
    value = error = None
    try:
        value = watch.time(function, *args, **options)
    except (SceneError, ValueError) as refusal:
        error = refusal
    return Answer(value, error, watch.seconds, compiled.seconds - before)


def refused(answer: Answer, asked: str, true: str, known: str, expected: str, **more) -> Row:
    """The row of a question that must be refused in words with `expected` in them."""
    meant = answer.error is not None and expected in answer.said
    answered = answer.said if answer.error is not None else repr(answer.value)
    return answer.row(asked, true, known, answered, 0.0 if meant else math.inf, **more)


def judge(state, limit: float, rim: float) -> float:
    """The true error of a state at its λa, against the extended precision."""
    some = (state.apex_stretch, state.pressure, state.volume, state.voltage_squared)
    error, unsure = contour_truth.moderate(*([x] for x in some), limit, rim)
    return max(float(error[0]) - float(unsure[0]), 0.0) if np.isfinite(unsure[0]) else math.nan


def state_row(answer: Answer, asked: str, limit: float, rim: float, true: str, known: str, other: float = 0.0) -> Row:
    """The row of a single state, judged in extended precision; `other` is an error already known."""
    if answer.error is not None:
        return answer.row(asked, true, known, answer.said, math.inf)
    state = answer.value[0] if isinstance(answer.value, list) else answer.value
    error = max(judge(state, limit, rim), other)
    flag = ", ".join(state.flags)
    answered = f"p {state.pressure:.10g}, V {state.volume:.10g}, λa {state.apex_stretch:.10g}"
    return answer.row(asked, true, known, answered, error, state.error_estimate, flag)


def branches_row(answer: Answer, asked: str, limit: float, rim: float, count: int, window=(-math.inf, 0.9)) -> Row:
    """The row of all branches of a diagram: `count` states of each, the worst share of error and estimate."""
    true, known = "every point of a branch is a state", "extended precision"
    if answer.error is not None:
        return answer.row(asked, true, known, answer.said, math.inf)
    worst, seen, unsharp = (0.0, 1e-13, 0.0), 0, 0
    for branch in answer.value.branches:
        t = branch.voltage_squared / truth.largest_load(branch.apex_stretch, limit)
        inside = np.flatnonzero((t > window[0]) & (t <= window[1]))
        some = inside[np.unique(np.linspace(0, len(inside) - 1, count).astype(int))] if len(inside) else inside
        flagged = ~(branch.error_estimate[some] <= answer.value.tolerance)  # these say so themselves
        some, unsharp = some[~flagged], unsharp + int(flagged.sum())
        columns = [getattr(branch, n)[some] for n in ("apex_stretch", "pressure", "volume", "voltage_squared")]
        error, unsure = contour_truth.moderate(*columns, limit, rim)
        estimate = branch.error_estimate[some]
        fair = unsure < estimate
        seen, unsharp = seen + int(fair.sum()), unsharp + int((~fair).sum())
        if fair.any():
            k = np.flatnonzero(fair)[np.argmax((error / estimate)[fair])]
            worst = max(worst, (error[k] / estimate[k], estimate[k], error[k]))
    flags = sorted({f for b in answer.value.branches for f in b.flags if "lost" in f})
    flags += [] if answer.value.complete else ["complete=False"]
    answered = (
        f"{len(answer.value.branches)} branches; {seen} states compared, {unsharp} flagged or at the truth's own limit"
    )
    return answer.row(asked, true, known, answered, worst[2], worst[1], ", ".join(flags))


def voltage_volume(loading, membrane=None, **options) -> Answer:
    return ask(dj.voltage_volume, dj.Scene(membrane or dj.Membrane(), loading, **options))


def chamber(volume: float, filling: float = FILLING) -> dj.Chamber:
    return dj.Chamber(volume=volume, initial_volume=filling)


def folds_of(diagram, low: float, high: float) -> list:
    """The folds of a diagram between two stretches, by stretch."""
    found = [p for p in diagram.special_points if p.kind == "fold" and low < p.apex_stretch < high]
    return sorted(found, key=lambda p: p.apex_stretch)


def ramp_of(diagram) -> str:
    return " → ".join(e.event for e in diagram.ramp().events)


_SURFACES: dict = {}


def surface_of(membrane=None) -> dj.Surface:
    """The surface of the first membrane, built once."""
    if "first" not in _SURFACES:
        _SURFACES["first"] = dj.Surface.build(dj.Membrane(), cache=False)
    return _SURFACES["first"]


@case("1", "flat unstretched start")
def flat_start(quick: bool) -> Iterator[Row]:
    membrane = dj.Membrane()
    for pressure in (1e-2, 1e-8, 1e-15) if quick else (1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14, 1e-15, 1e-16):
        answer = ask(dj.equilibrium, membrane, pressure=pressure)
        k = pressure / 3
        asked = f"Φ = 0, p = {pressure:g}"
        true = f"V = {HENCKY * k ** (1 / 3):.8g} (1 + O({k ** (2 / 3):.0e}))"
        if pressure < 1e-14:  # λa − 1 is some ten thousand roundings
            yield refused(answer, asked, true, "Hencky's series", Code.near_flat.name)
            continue
        row = state_row(answer, asked, J, 1.0, true, "Hencky's series, and extended precision at the answered λa")
        if answer.error is None:
            volume = HENCKY * k ** (1 / 3)
            off = abs(answer.value.volume - volume) / max(volume, 1e-3)
            allowed = 0.6 * k ** (2 / 3) + ALLOWED * answer.value.error_estimate + 1e-8  # the digits of the constant
            if off > allowed:
                row.error = off
        yield row
    answer = ask(dj.equilibrium, membrane, apex_stretch=1 + 1e-12)
    yield refused(answer, "Φ = 0, λa = 1 + 1e-12", "a state of V ≈ 2e-6", "Hencky's series", Code.near_flat.name)
    answer = ask(dj.equilibrium, membrane, pressure=0.0)
    yield refused(answer, "Φ = 0, p = 0", "flat, without tension", "λ0 = 1", Code.flat_unstretched.name)


def _slope_by_load(apex: float) -> float:
    """∂p/∂q of the state at (λa, 0)."""
    step = 1e-3
    q = step * np.array([-2.0, -1.0, 1.0, 2.0])
    p = truth.states(np.full(4, apex), q, J, 1.0, steps=280)[0]
    return float((p[0] - 8 * p[1] + 8 * p[2] - p[3]) / (12 * step))


@case("2", "pressure at the peak")
def near_peak(quick: bool) -> Iterator[Row]:
    known = "Chebyshev interpolation of p(λa) in extended precision"
    slope = _slope_by_load(PEAK_STRETCH)
    for share in (1e-10, -1e-10) if quick else (1e-6, 1e-8, 1e-10, 1e-12, -1e-12, -1e-10, -1e-8):
        pressure = PEAK_PRESSURE * (1 - share)
        asked = f"Φ = 0, p = p_peak(1 {'−' if share > 0 else '+'} {abs(share):.0e})"
        true = "two states about V 2.96341, indices 0 and 1" if share > 0 else "no state below V 200"
        if abs(share) >= 1e-10:
            answer = ask(dj.equilibrium, dj.Membrane(), pressure=pressure, all=True)
            near = [s for s in answer.value if s.volume < 200]
            answered = ", ".join(f"V {s.volume:.8g} (index {s.index})" for s in near) or "none there"
            good = [s.index for s in near] == ([0, 1] if share > 0 else [])
            error = max((judge(s, J, 1.0) for s in near), default=0.0) if good else math.inf
            estimate = max((s.error_estimate for s in near), default=TOLERANCE)
            yield answer.row(asked, true, known, answered, error, estimate)
        answer = voltage_volume(dj.ConstantPressure(pressure))
        load = (PEAK_PRESSURE - pressure) / -slope
        events = answer.value.ramp().events
        lost = sorted({f for b in answer.value.branches for f in b.flags if "lost" in f})
        if share > 0:
            true = f"starts at V 2.9634, snaps at q {load:.6g}"
            expected = [e.event for e in events[:2]] == ["start", "snap"] and abs(
                events[0].state.volume / 2.9634 - 1
            ) < 0.01
            error = abs(events[1].state.voltage_squared - load) / 1e-3 if expected else math.inf
            answered = (
                f"start V {events[0].state.volume:.8g}, {events[1].event} q {events[1].state.voltage_squared:.6g}"
            )
        else:
            true = "starts at V 224.6"
            error = 0.0 if abs(events[0].state.volume / 224.576 - 1) < 1e-3 else math.inf
            answered = f"start V {events[0].state.volume:.8g}"
        by = known + ", ∂p/∂q by differences"
        yield answer.row(asked + ", ramp", true, by, answered, error, TOLERANCE, ", ".join(lost))
    answer = ask(dj.diagram.pressure_ramps, surface_of(), PEAK_PRESSURE * (1 - 1e-10))
    flag = "unresolved" if answer.value.outcome == Outcome.unresolved else ""
    answered = Outcome(int(answer.value.outcome)).name
    asked = "Φ = 0, p = p_peak(1 − 1e-10), ramp"
    yield answer.row(asked, "starts at V 2.9634", known, answered, math.inf, TOLERANCE, flag, engine="surface")


def _start_at_fold(volume: float) -> float:
    """The filling at which a chamber's start is at its fold: dp/dV = −(p + 50)/(V + V_C) at zero voltage."""

    def softening(apex):
        p, v, _ = truth.states(apex, 0.0, J, 1.0, steps=280)
        # log of the gas's constant turns where the gas and the membrane soften alike
        return np.log(p + 50) + np.log(v + truth.EXTENDED(volume))

    places = contour_truth.turning(softening, 2.5 if volume < 1e4 else 2.28, 0.2 if volume < 1e4 else 0.02)
    apex = places[0][0]
    return float(truth.states([apex], 0.0, J, 1.0, steps=280)[1][0])


@case("3", "volume at the peak")
def filling_at_peak(quick: bool) -> Iterator[Row]:
    known = "Chebyshev interpolation in extended precision"
    for share in (1e-8, -1e-8) if quick else (1e-6, 1e-8, -1e-8, -1e-6):
        answer = ask(dj.equilibrium, dj.Membrane(), volume=PEAK_VOLUME * (1 - share))
        asked = f"Φ = 0, V = V_peak(1 {'−' if share > 0 else '+'} {abs(share):.0e})"
        true = f"index {0 if share > 0 else 1} at dead pressure"
        row = state_row(answer, asked, J, 1.0, true, known)
        row.answered += f", index {answer.value.index}"
        if answer.value.index != (0 if share > 0 else 1):
            row.error = math.inf
        yield row
    for volume in (1600.0,) if quick else (1600.0, 25000.0):
        critical = _start_at_fold(volume)
        for share in (1e-8, -1e-8) if quick else (1e-4, 1e-6, 1e-8, -1e-8, -1e-6):
            answer = voltage_volume(chamber(volume, critical * (1 - share)))
            asked = f"V_C = {volume:g}, V_0 = V_fold(1 {'−' if share > 0 else '+'} {abs(share):.0e}), V_fold {critical:.10g}"
            true = "stable start, snaps at once" if share > 0 else "unstable start"
            up = answer.value.ramp()
            lost = sorted({f for b in answer.value.branches for f in b.flags if "lost" in f})
            if share > 0:
                good = [e.event for e in up.events[:2]] == ["start", "snap"]
                good = good and up.events[1].state.voltage_squared < max(share**2, 1e-12) * 10
            else:
                good = up.area_strain_reason == "start_unstable"
            answered = f"{ramp_of(answer.value)} ({up.area_strain_reason})"
            yield answer.row(asked, true, known, answered, 0.0 if good else math.inf, TOLERANCE, ", ".join(lost))
            ramps = ask(dj.diagram.chamber_ramps, surface_of(), volume, critical * (1 - share))
            outcome = Outcome(int(ramps.value.outcome))
            flag = "unresolved" if outcome is Outcome.unresolved else ""
            good = (outcome is Outcome.start_unstable) == (share < 0)
            yield ramps.row(
                asked, true, known, outcome.name, 0.0 if good else math.inf, TOLERANCE, flag, engine="surface"
            )


def fold_row(answer: Answer, asked: str, fold, gas, true_at: float, half: float) -> Row:
    """The row of a fold of a chamber or pressure: its q against the extreme of the true q(λa) about `true_at`."""
    places = contour_truth.turning(
        lambda a: contour_truth.loads(gas, a, fold.voltage_squared, J, 1.0)[0], true_at, half, 10
    )
    known = "q(λa) in extended precision, interpolated by Chebyshev polynomials"
    if not places:
        return answer.row(asked, "no fold there", known, f"q {fold.voltage_squared:.10g}", math.inf)
    place, load = min(places, key=lambda f: abs(f[0] - true_at))
    error = abs(fold.voltage_squared - load) / max(abs(load), 1e-3)
    answered = f"q {fold.voltage_squared:.12g}, λa {fold.apex_stretch:.8g}"
    true = f"q {load:.12g}, λa {place:.8g}"
    return answer.row(asked, true, known, answered, error, fold.error_estimate, ", ".join(fold.flags))


@case("4", "tiny and huge chambers")
def extreme_chambers(quick: bool) -> Iterator[Row]:
    for volume, expected in ((1e-3, ["start", "snap", "no_landing"]), (1e9, ["start", "snap", "landing", "breakdown"])):
        answer = voltage_volume(chamber(volume))
        events = [e.event for e in answer.value.ramp().events]
        fold = answer.value.ramp()["snap"][0].state
        gas = contour_truth.Gas(volume, FILLING, START_PRESSURE)
        row = fold_row(answer, f"V_C = {volume:g}, V_0 = 2.42: first snap", fold, gas, fold.apex_stretch, 0.04)
        if events != expected:
            row.error = math.inf
        yield row
        ramps = ask(dj.diagram.chamber_ramps, surface_of(), volume, FILLING)
        unresolved = bool(ramps.value.outcome == Outcome.unresolved)
        snap = float(ramps.value.snap.voltage[0])
        load = fold.voltage_squared if row.right else math.nan
        error = math.inf if unresolved else abs(snap**2 - load) / load
        answered = Outcome(int(ramps.value.outcome)).name + ("" if unresolved else f", snaps at q {snap**2:.12g}")
        flag = "unresolved" if unresolved else ""
        yield ramps.row(row.asked, row.true, row.known, answered, error, TOLERANCE, flag, engine="surface")
        yield branches_row(answer, f"V_C = {volume:g}: branches", J, 1.0, 8 if quick else 16)
        if volume > 1:
            # constant pressure is the limit: dq/d(1/V_C) is finite
            held = voltage_volume(dj.ConstantPressure(START_PRESSURE))
            other = held.value.ramp()["snap"][0].state.voltage_squared
            answered = f"differs by {abs(fold.voltage_squared - other):.2g} in q"
            far = abs(fold.voltage_squared - other) > 4.0 / volume
            asked = f"V_C = {volume:g} beside constant pressure"
            known = "the gas: p − p_0 = −(p_0 + 50)(V − V_0)/V_C"
            yield held.row(asked, "differs by less than 4/V_C in q", known, answered, math.inf if far else 0.0)


@case("5", "limiting stretch from 1 to 10⁶, and none")
def limiting_stretch(quick: bool) -> Iterator[Row]:
    for limit in (1.0, 1e6) if quick else (1.0, 2.0, 10.0, 1e3, 1e4, 1e5, 1e6, math.inf):
        material = dj.NeoHookean() if math.isinf(limit) else dj.Gent(limit)
        membrane = dj.Membrane(material)
        name = "neo-Hookean" if math.isinf(limit) else f"J = {limit:g}"
        answer = ask(dj.equilibrium, membrane, pressure=1.2)
        yield state_row(answer, f"{name}: Φ = 0, p = 1.2", limit, 1.0, "a state", "extended precision")
        if quick:
            continue
        answer = ask(dj.pressure_volume, membrane)
        asked = f"{name}: p–V curve"
        yield branches_row(answer, asked, limit, 1.0, 16)
        low = folds_of(answer.value, 2.0, 2.6)
        if limit >= 1e3:
            (_, peak), *_ = contour_truth.turning(
                lambda a, limit=limit: truth.states(a, 0.0, limit, 1.0, steps=280)[0], 2.2, 0.08
            )
            flag = "" if answer.value.complete else "complete=False"
            error = abs(low[0].pressure / peak - 1) if low else math.inf
            estimate = low[0].error_estimate if low else TOLERANCE
            answered = f"p {low[0].pressure:.12g}" if low else "none"
            known = "Chebyshev interpolation in extended precision"
            yield answer.row(f"{name}: peak", f"p {peak:.12g}", known, answered, error, estimate, flag)
        else:
            grid = np.linspace(1.01, truth.lock_up(limit), 300)
            turns = int((np.diff(truth.states(grid, 0.0, limit, 1.0)[0]) < 0).sum())
            folds = sum(p.kind == "fold" for p in answer.value.special_points)
            good = turns == folds == 0
            known = "a scan in extended precision"
            yield answer.row(f"{name}: peak", "none", known, f"{folds} folds", 0.0 if good else math.inf)


@case("6", "volume at lock-up")
def lock_up(quick: bool) -> Iterator[Row]:
    end = truth.lock_up(J)
    most = float(truth.states([end], 0.0, J, 1.0, steps=400)[1][0])
    known = "the window ends where G(λa, λa) = 0.01: λa by bisection, V in extended precision"
    answer = ask(dj.equilibrium, dj.Membrane(), volume=most * (1 - 1e-6))
    asked = "Φ = 0, V = V_end(1 − 1e-6)"
    yield state_row(answer, asked, J, 1.0, f"a state; V_end {most:.9g}", known)
    for volume, name in ((most * (1 + 1e-6), "V_end(1 + 1e-6)"), (468.911 * (1 - 1e-6), "468.911(1 − 1e-6)")):
        answer = ask(dj.equilibrium, dj.Membrane(), volume=volume)
        true = "none in the window"
        yield refused(answer, f"Φ = 0, V = {name}", true, known, f"{most:.6g}")
        answer = voltage_volume(chamber(1600.0, volume))
        yield refused(answer, f"V_C = 1600, V_0 = {name}", true, known, f"{most:.6g}")
    answer = ask(dj.diagram.chamber_ramps, surface_of(), 1600.0, 468.9)
    flag = "unresolved" if answer.value.outcome == Outcome.unresolved else ""
    asked = "V_C = 1600, V_0 = 468.9"
    yield answer.row(asked, "none in the window", known, flag, math.inf, TOLERANCE, flag, engine="surface")


@case("7", "high voltages and spirals")
def spirals(quick: bool) -> Iterator[Row]:
    known = "p(λa) scanned in extended precision on stretches graded towards the cones"
    for voltage in (0.3,) if quick else (0.15, 0.2, 0.3, 0.45, 0.6):
        answer = ask(dj.pressure_volume, dj.Membrane(), voltage)
        cone = 2e-2 if quick else 1e-3
        pieces = contour_truth.pressure_folds(voltage**2, J, 1.0, 70 if quick else 160, cone)
        ends = [(b.apex_stretch.min(), b.apex_stretch.max()) for b in answer.value.branches]
        for piece in pieces if not quick else pieces[:1]:
            low, high = piece["range"]
            reach = max((min(e[1], high) for e in ends if e[0] < high and e[1] > low), default=0.0)
            mine = folds_of(answer.value, low, min(reach, high))
            true = [f for f in piece["folds"] if f[0] < reach and f[2] > cone]
            mine = mine[: len(true)] if len(mine) > len(true) and _beyond(mine[len(true)], voltage, cone) else mine
            error, estimate = math.inf, TOLERANCE
            if len(mine) == len(true):
                pairs = [
                    (abs(a.pressure - b[1]) / max(abs(b[1]), 1e-3), a.error_estimate)
                    for a, b in zip(mine, true, strict=True)
                ]
                error, estimate = max(pairs, key=lambda e: e[0] / e[1], default=(0.0, TOLERANCE))
            asked = f"Φ = {voltage}: folds of p for λa {low:.4g} to {high:.4g}, 1 − t > {cone:g}"
            answered = f"{len(mine)} folds: p " + ", ".join(f"{f.pressure:.9g}" for f in mine[:4])
            text = f"{len(true)} folds: p " + ", ".join(f"{f[1]:.9g}" for f in true[:4])
            yield answer.row(asked, text, known, answered, error, estimate, counts={"folds": len(true)})
    answer = ask(dj.equilibrium, dj.Membrane(), voltage=0.3, pressure=1.2911981, all=True)
    near = [s for s in answer.value if s.apex_stretch < 3.4652]
    # between the folds of the row above p runs through this value six times up to λa 3.4652, and once at large volume
    good = sorted(s.index for s in near) == [0, 1, 2, 3, 4, 5]
    error = max(judge(s, J, 1.0) for s in near)
    estimate = max(s.error_estimate for s in near)
    answered = f"{len(near)} states, indices {sorted(s.index for s in near)}"
    known = "the folds of p: 1.37915, 1.28749, 1.291344, 1.291192, 1.29119832, 1.29119809"
    asked = "Φ = 0.3, p = 1.2911981, λa < 3.4652: all states"
    yield answer.row(asked, "6 states, indices 0 to 5", known, answered, error if good else math.inf, estimate)
    answer = voltage_volume(chamber(30.0))
    folds = folds_of(answer.value, 1.0, 9.0)[:3]
    error = max(abs(f.voltage / v - 1) for f, v in zip(folds, SPIRAL_30, strict=True))
    answered = "Φ " + ", ".join(f"{f.voltage:.11f}" for f in folds)
    known = "reference numbers on which two unrelated methods agree, in place of an estimate their last digit"
    true = "Φ " + ", ".join(map(str, SPIRAL_30))
    yield answer.row("V_C = 30: first three folds", true, known, answered, error, 1e-11)


def _beyond(fold, voltage: float, cone: float) -> bool:
    return 1 - voltage**2 / truth.largest_load(fold.apex_stretch, J) <= cone * 1.2


@case("8", "q far below zero")
def negative_loads(quick: bool) -> Iterator[Row]:
    for loading, name in ((chamber(1600.0), "V_C = 1600"), (dj.ConstantPressure(1.2), "p = 1.2")):
        for low in (-20.0,) if quick else (-1.0, -5.0, -20.0):
            answer = voltage_volume(loading, window=dj.model.Window(load_fraction=(low, 0.9)))
            row = branches_row(answer, f"{name}, load window from t = {low:g}", J, 1.0, 8 if quick else 20, (-21, 0.0))
            least = min(
                float((b.voltage_squared / truth.largest_load(b.apex_stretch, J)).min()) for b in answer.value.branches
            )
            row.answered += f"; t down to {least:.6g}"
            if name == "V_C = 1600" and abs(least / low - 1) > 1e-6:
                row.error = math.inf
            yield row
        if quick:
            break
    apex = np.array([1.5, 4.0, 8.0])
    for t in (-0.74, -0.76):
        q = t * truth.largest_load(apex, J)
        answer = ask(lambda q: surface_of()(apex, q), q)
        p = np.asarray(answer.value.pressure)
        bound = np.asarray(surface_of().error_bound(apex, q))
        true_p = truth.states(apex, q, J, 1.0, steps=280)[0]
        outside = bool(np.isnan(p).all() and np.isinf(bound).all())
        error = 0.0 if outside else float(np.abs(p / true_p - 1).max())
        asked = f"surface at t = {t}"
        answered = "NaN, bound ∞" if outside else f"p {p[1]:.10g} at λa 4"
        true = "beyond the domain" if t < -0.75 else f"p {float(true_p[1]):.10g} at λa 4"
        estimate = 1e-13 if outside else float(bound.max())
        if outside != (t < -0.75):
            error = math.inf
        yield answer.row(asked, true, "extended precision", answered, error, estimate, engine="surface")


@case("9", "prestretch 1 + 10⁻⁶ to 10")
def prestretches(quick: bool) -> Iterator[Row]:
    for rim in (1 + 1e-6, 10.0) if quick else (1 + 1e-6, 1 + 1e-4, 1.01, 3.0, 6.0, 10.0, 11.6):
        membrane = dj.Membrane(prestretch=rim)
        questions = [{"pressure": 0.5}, {"pressure": 1e-4}]
        for question in questions if quick else [*questions, {"volume": 1.0}, {"volume": 300.0}]:
            answer = ask(dj.equilibrium, membrane, **question, all=True)
            ((name, value),) = question.items()
            alone = answer.error is not None or len(answer.value) == 1
            asked = f"λ0 = {rim:.8g}: {name} {value:g}"
            if rim > 10 and value == 300.0:
                most = float(truth.states([truth.lock_up(J)], 0.0, J, rim, steps=400)[1][0])
                true, known = "none in the window", "V at G(λa, λa) = 0.01, in extended precision"
                yield refused(answer, asked, true, known, f"{most:.6g}")
                continue
            row = state_row(answer, asked, J, rim, "one state", "extended precision")
            if not alone:
                row.error, row.answered = math.inf, f"{len(answer.value)} states"
            yield row
            if value == 1e-4 and rim >= 3 and answer.error is None:
                tension = (1 - rim**-6) / (1 - (2 * rim**2 + rim**-4 - 3) / J)
                volume = math.pi * value * rim**4 / (8 * tension)
                off = abs(answer.value[0].volume / volume - 1)
                answered = f"V {answer.value[0].volume:.10g}"
                known = "a drum: V = π p λ0⁴/(8 σh), the next term p²"
                estimate = max(answer.value[0].error_estimate, 1e-7)
                flag = ", ".join(answer.value[0].flags)
                yield answer.row(asked, f"V {volume:.10g}", known, answered, off, estimate, flag)
        if not quick and rim <= 10:
            yield branches_row(ask(dj.pressure_volume, membrane), f"λ0 = {rim:.8g}: p–V curve", J, rim, 16)


@case("10", "beyond slack")
def beyond_slack(quick: bool) -> Iterator[Row]:
    rim = 3.0
    slack = math.sqrt(truth.largest_load(rim, J))
    membrane = dj.Membrane(prestretch=rim)
    known = "q_max(λ0) = (λ0⁻² − λ0⁻⁸)/G: beyond it no film near flat is tense"
    for voltage in (slack * (1 - 1e-6), slack * (1 + 1e-6), 0.4):
        answer = ask(dj.equilibrium, membrane, voltage=voltage, pressure=0.0)
        asked = f"λ0 = 3, Φ = {voltage:.8g}, p = 0"
        if voltage > slack:
            yield refused(answer, asked, f"none: slack from Φ = {slack:.8g}", known, Code.no_equilibrium.name)
        else:
            good = answer.error is None and answer.value.volume == 0
            answered = "flat" if good else answer.said
            yield answer.row(asked, "flat", known, answered, 0.0 if good else math.inf)
    answer = ask(dj.equilibrium, membrane, voltage=0.34, pressure=1e-4)
    yield state_row(answer, "λ0 = 3, Φ = 0.34 (t = 0.984), p = 1e-4", J, rim, "a state", "extended precision")
    for pressure in (1e-8,) if quick else (1e-8, 1e-6, 1e-4):
        answer = ask(dj.equilibrium, membrane, voltage=0.4, pressure=pressure)
        asked = f"λ0 = 3, Φ = 0.4, p = {pressure:g}"
        answered = answer.said if answer.error is not None else repr(answer.value)
        # near the cone of large λa there are states of every small pressure, where the tension of the apex vanishes
        refusal = getattr(answer.error, "code", None)
        good = refusal in (Code.no_equilibrium, Code.beyond_tolerance)
        yield answer.row(asked, "none near flat", known, answered, 0.0 if good else math.inf)
    diagram = ask(dj.voltage_volume, dj.Scene(membrane, dj.ConstantPressure(0.0)))
    marks = [p.voltage_squared for p in diagram.value.special_points if p.kind == "slack"]
    error = abs(marks[0] / slack**2 - 1) if len(marks) == 1 else math.inf
    answered = f"slack at q {marks[0]:.12g}" if marks else "none"
    yield diagram.row("λ0 = 3, p = 0: ramp", f"slack at q {slack**2:.12g}", known, answered, error, 1e-13)


def _cusp_prestretch() -> float:
    """λ0 at which the two folds of p at zero voltage meet: the least slope of p(λa) vanishes there."""

    def least(rim):
        return contour_truth.least_slope(lambda a: truth.states(a, 0.0, J, rim, steps=200)[0], 5.74, 0.5)[0]

    low, high = 2.1101, 2.1105
    a, b = least(low), least(high)
    for _ in range(3):
        middle = low - a * (high - low) / (b - a)
        low, high, a, b = high, middle, b, least(middle)
    return high


@case("11", "cusps")
def cusps(quick: bool) -> Iterator[Row]:
    critical = 2.110288 if quick else _cusp_prestretch()
    known = "the least slope of p(λa) in extended precision"
    for shift in (-1e-5, 1e-5) if quick else (-1e-4, -1e-6, 1e-6, 1e-4):
        answer = ask(dj.pressure_volume, dj.Membrane(prestretch=critical + shift))
        folds = [p for p in answer.value.special_points if p.kind == "fold"]
        asked = f"λ0 = {critical:.9g} {'−' if shift < 0 else '+'} {abs(shift):.0e}: folds of p at Φ = 0"
        error = 0.0 if len(folds) == (2 if shift < 0 else 0) else math.inf
        answered = ", ".join(f"p {f.pressure:.11g}" for f in folds) or "none"
        yield answer.row(asked, "two" if shift < 0 else "none", known, answered, error)
    shifts = np.array([-1e-2, -3e-3, -1e-3, 1e-3, 1e-2])
    around = ((5.3887, 0.1260424**2, 0.1), (3.4497, 0.1167794**2, 0.06))  # λa and q of the cusps, and a reach
    for critical, sign, (middle, load, half) in zip(CUSPS, (1, -1), around, strict=True):
        for shift in (-1e-2, 1e-2) if quick else shifts:
            volume = critical + sign * shift
            answer = voltage_volume(chamber(volume))
            asked = f"V_C = {critical} {'−' if sign * shift < 0 else '+'} {abs(shift):g}, V_0 = 2.42"
            snaps = len(answer.value.ramp()["snap"])
            gas = contour_truth.Gas(volume, FILLING, START_PRESSURE)
            slope = contour_truth.least_slope(
                lambda a, gas=gas, load=load: contour_truth.loads(gas, a, load, J, 1.0)[0], middle, half, 12
            )[0]
            expected = 1 if slope < 0 else 0
            answered = ramp_of(answer.value)
            known = f"the least slope of q(λa), {slope:.2g}, in extended precision"
            true = "snaps" if expected else "no snap"
            yield answer.row(asked, true, known, answered, 0.0 if snaps == expected else math.inf)
        ramps = ask(dj.diagram.chamber_ramps, surface_of(), critical + sign * shifts, FILLING)
        lost = ramps.value.outcome == Outcome.unresolved
        wrong = int((~lost & (ramps.value.snaps != (shifts < 0))).sum())
        answered = f"snaps {[('unresolved' if n else int(s)) for n, s in zip(lost, ramps.value.snaps, strict=True)]}"
        asked = f"V_C = {critical} + {(sign * shifts).tolist()}"
        known = "the sign of the least slope of q(λa), as in the rows above"
        true = f"snaps {(shifts < 0).astype(int).tolist()}"
        yield ramps.row(asked, true, known, answered, math.inf if wrong else 0.0, engine="surface")


@case("12", "several loads at one stretch")
def several_loads(quick: bool) -> Iterator[Row]:
    pressure = 1.2
    diagram = voltage_volume(dj.ConstantPressure(pressure))
    t = np.linspace(-0.9, 0.88, 60 if quick else 120)
    for apex in (9.0,) if quick else (7.0, 8.0, 9.0, 10.0, 10.5):
        p, *_ = truth.states(np.full(len(t), apex), t * truth.largest_load(apex, J), J, 1.0, steps=280)
        roots = []
        for i in np.flatnonzero((p[:-1] < pressure) != (p[1:] < pressure)):
            found = contour_truth.Held(pressure)
            start = float(np.interp(0.0, [float(p[i] - pressure), float(p[i + 1] - pressure)], t[i : i + 2]))
            start = (
                start if p[i] < p[i + 1] else float(t[i] + (t[i + 1] - t[i]) * (p[i] - pressure) / (p[i] - p[i + 1]))
            )
            q, _, vol = contour_truth.loads(found, np.array([apex]), start * truth.largest_load(apex, J), J, 1.0)
            roots.append((float(q[0]), float(vol[0])))
        mine = []
        for branch in diagram.value.branches:
            a, load = branch.apex_stretch, branch.voltage_squared
            mine += [
                float(load[i] + (load[i + 1] - load[i]) * (apex - a[i]) / (a[i + 1] - a[i]))
                for i in np.flatnonzero((a[:-1] - apex) * (a[1:] - apex) < 0)
            ]
        mine = sorted(x for x in mine if -0.9 < x / truth.largest_load(apex, J) < 0.88)
        roots.sort()
        error = math.inf
        if len(mine) == len(roots):
            states = [dj.equilibrium(dj.Membrane(), voltage=math.sqrt(q), apex_stretch=apex) for q, _ in roots if q > 0]
            at = [r for r in roots if r[0] > 0]
            # p and V of single states at the true loads; the diagram's points lie close by
            error = max((abs(s.pressure / pressure - 1) for s in states), default=0.0)
            error = max([error, *(abs(s.volume / r[1] - 1) for s, r in zip(states, at, strict=True))])
            if max((abs(a - b[0]) for a, b in zip(mine, roots, strict=True)), default=0.0) > 1e-3:
                error = math.inf
        asked = f"p = 1.2, λa = {apex:g}: loads with t from −0.9 to 0.88"
        true = f"{len(roots)}: q " + ", ".join(f"{q:.8g}" for q, _ in roots)
        answered = f"{len(mine)}: q " + ", ".join(f"{q:.4g}" for q in mine)
        yield diagram.row(asked, true, "p(t) scanned in extended precision", answered, error)
    answer = ask(dj.diagram.pressure_ramps, surface_of(), pressure)
    events = diagram.value.ramp()
    snap = events["snap"][0].state
    outcome = Outcome(int(answer.value.outcome))
    flag = "unresolved" if outcome is Outcome.unresolved else ""
    error = abs(float(answer.value.snap.voltage[0]) / math.sqrt(0.1266058554) - 1)
    asked, known = "p = 1.2: snap of the main branch", "spectral elements: q 0.1266058554"
    yield answer.row(asked, "q 0.1266058554", known, outcome.name, error, TOLERANCE, flag, engine="surface")
    error = abs(snap.voltage_squared / 0.1266058554 - 1)
    yield diagram.row(asked, "q 0.1266058554", known, f"q {snap.voltage_squared:.10g}", error)


@case("13", "mixed batches")
def mixed_batches(quick: bool) -> Iterator[Row]:
    surface = surface_of()
    chambers = np.array([1600.0, 1e-3, 800.0, 1e9, 30.0, 484.04866, 1600.0, 551.4, 25000.0, 10.0, 1600.0])
    fillings = np.array([2.42, 2.42, 2.42, 2.42, 2.42, 2.42, 468.9, 2.42, 2.9634068, 1e-9, 1e9])
    together = ask(dj.diagram.chamber_ramps, surface, chambers, fillings)
    worst = 0.0
    some = range(0, len(chambers), 5 if quick else 1)
    for i in some:
        alone = dj.diagram.chamber_ramps(surface, chambers[i], fillings[i])
        same = jax.tree.map(
            lambda a, b, i=i: bool(np.array_equal(np.asarray(a)[i], b, equal_nan=True)), together.value, alone
        )
        worst = max(worst, 0.0 if all(jax.tree.leaves(same)) else math.inf)
    answered = "bitwise the same" if worst == 0 else "different"
    asked = "chambers, easy and impossible, together and alone"
    known = "the same call with one lane"
    yield together.row(asked, "the same numbers", known, answered, worst, 1e-13, engine="surface")
    reference = (0.0764953595449, 0.0971990067469)
    error = max(abs(float(together.value.snap.voltage[i, 0]) / v - 1) for i, v in zip((0, 2), reference, strict=True))
    answered = f"Φ {float(together.value.snap.voltage[0, 0]):.12g}, {float(together.value.snap.voltage[2, 0]):.12g}"
    asked = "snaps of V_C = 1600 and 800 among them"
    known = "spectral elements"
    yield together.row(
        asked, "Φ " + ", ".join(map(str, reference)), known, answered, error, float(together.value.error[[0, 2]].max()),
        engine="surface",
    )  # fmt: skip
    impossible = together.value.outcome[[6, 10]]
    good = bool((impossible == Outcome.unresolved).all())
    asked, true = "fillings beyond lock-up among them", "none"
    answered = ", ".join(Outcome(int(o)).name for o in impossible)
    known = "the volume of lock-up, 455.3"
    yield together.row(asked, true, known, answered, 0.0 if good else math.inf, engine="surface")
    pressures = np.array([1.0, PEAK_PRESSURE * (1 - 1e-10), 1.82, 1e-9, 1.5, 50.0, 1e6])
    together = ask(dj.diagram.pressure_ramps, surface, pressures)
    worst = 0.0
    for i in (2,) if quick else range(len(pressures)):
        alone = dj.diagram.pressure_ramps(surface, pressures[i])
        same = jax.tree.map(
            lambda a, b, i=i: bool(np.array_equal(np.asarray(a)[i], b, equal_nan=True)), together.value, alone
        )
        worst = max(worst, 0.0 if all(jax.tree.leaves(same)) else math.inf)
    answered = "bitwise the same" if worst == 0 else "different"
    asked = "pressures, easy and impossible, together and alone"
    yield together.row(
        asked, "the same numbers", "the same call with one lane", answered, worst, 1e-13, engine="surface"
    )


def differences(function: Callable, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Second derivatives (n, n) by sixth-order central differences of a function of rows of points, in one call."""
    weights = {-3: -1.0, -2: 9.0, -1: -45.0, 1: 45.0, 2: -9.0, 3: 1.0}
    n = len(at)
    points, factors, owner = [], [], []
    for i in range(n):
        for j in range(i, n):
            for a, wa in weights.items():
                for b, wb in weights.items():
                    shift = np.zeros(n, truth.EXTENDED)
                    shift[i] += a * steps[i]
                    shift[j] += b * steps[j]
                    points.append(at + shift)
                    factors.append(truth.EXTENDED(wa * wb) / (truth.EXTENDED(3600) * steps[i] * steps[j]))
                    owner.append((i, j))
    values = function(np.array(points))
    out = np.zeros((n, n))
    for (i, j), factor, value in zip(owner, factors, values, strict=True):
        out[i, j] += float(factor * value)
        out[j, i] = out[i, j]
    return out


@case("14", "second derivatives")
def second_derivatives(quick: bool) -> Iterator[Row]:
    known = "sixth-order central differences in extended precision (a shot carries no estimate: 1e-8 is asked)"
    for point in ((2.0, 1.9, 0.0),) if quick else ((2.0, 1.9, 0.0), (5.0, 1.6, -0.01), (8.0, 1.2, 0.01)):
        at = np.array(point, truth.EXTENDED)

        def stretch_change(rows):
            apex, p, q = rows.T
            return truth.shoot(apex, p, q, truth.EXTENDED(J), 280)[1]

        true = differences(stretch_change, at, np.array([2e-3, 2e-3, 1e-4], truth.EXTENDED))
        answer = ask(
            jax.hessian(lambda x: dj.model.shoot(dj.Gent(J), x[0], x[1], x[2], steps=64.0).stretch_change),
            np.array(point, float),
        )
        mine = np.asarray(answer.value)
        scale = np.sqrt(np.abs(np.outer(np.diag(true), np.diag(true)))) + 1e-3
        error = float(np.max(np.abs(mine - true) / scale))
        asked = f"∂²(λ2(1) − λa) by λa, p, q at {point}: `jax.hessian` of `shoot` in 64 steps"
        answered, text = (f"∂²/∂λa² {m[0, 0]:.9g}, ∂²/∂λa∂q {m[0, 2]:.9g}" for m in (mine, true))
        yield answer.row(asked, text, known, answered, error, 1e-9)
    known = "sixth-order central differences in extended precision"
    surface = surface_of()
    for point in ((3.0, 0.004),) if quick else ((3.0, 0.004), (6.0, -0.01), (9.0, 0.005)):
        at = np.array(point)

        def pressure(rows):
            # lanes of `states` are doubles, and so are the points
            apex, q = np.asarray(rows, float).T
            guess = np.asarray(truth.states(apex, q, J, 1.0, steps=140)[0], float)
            return truth.exact(apex, guess, q, J, 1.0, steps=280)[0]

        # steps that doubles hold exactly
        true = differences(pressure, at, np.array([2.0**-8, 2.0**-13]))
        answer = ask(jax.hessian(lambda x: surface(x[0], x[1]).pressure), at)
        mine = np.asarray(answer.value)
        scale = np.sqrt(np.abs(np.outer(np.diag(true), np.diag(true)))) + 1e-3
        error = float(np.max(np.abs(mine - true) / scale))
        asked = f"∂²p by λa, q at {point}: `jax.hessian` of the surface"
        answered, text = (f"∂²/∂λa² {m[0, 0]:.9g}, ∂²/∂λa∂q {m[0, 1]:.9g}" for m in (mine, true))
        # Markov's inequality: a polynomial of degree n on an element that errs by ε may err by about n⁴ε in its bend
        bound = float(surface.error_bound(*point)) * 16**4 / 4
        yield answer.row(asked, text, known, answered, error, bound, engine="surface")


INTRODUCTION = """# Hard cases

Made by `python -m benchmarks.acceptance.hard_cases --table docs/hard_cases.md`; `tests/diagram/test_hard_cases.py` asks a part of it each time.

Each row gives the question, the true value and its source, the answer, and the error. No true value comes from the package: it is a closed
form, a series, a reference number of another method, or a value in extended precision from `benchmarks/truth/extended_precision.py`, which
shares no code with the package. There are two exceptions: batches are compared with single lanes, and the surface's snap of a tiny chamber
with that of continuation, which the row above it checks. The error is |error|/max(|value|, 1e-3), for states at the λa of the answer.
"—" means that the answer is a refusal, and ∞ that it is of another kind than the true value. A row is right where the error is at most ten
times the estimate, or where the answer names its limit (last column but one): a flag, a result code, the outcome `unresolved`, or an error
in words. Where the package gives no estimate (counts, shots, second derivatives, reference numbers of few digits) the column holds the
bound that is required. `benchmarks/acceptance/hard_scenes.py` counts random scenes.

Dimensionless; Gent with J = 270 and λ0 = 1 unless said; λa apex stretch, q = Φ², t = q/q_max(λa), p pressure, V volume,
V_C chamber, V_0 filling.
"""


def table(rows: list[Row]) -> str:
    """The rows as Markdown, one table a case."""
    parts = [INTRODUCTION]
    for number, (title, _) in CASES.items():
        own = [r for r in rows if r.case == f"{number} {title}"]
        if not own:
            continue
        parts.append(f"\n## {number}. {title if title.startswith('q ') else title[0].upper() + title[1:]}\n")
        parts.append("| asked | true | known by | answered | engine | error | estimate | says | right |")
        parts.append("|---|---|---|---|---|---|---|---|---|")
        for r in own:
            error = "∞" if math.isinf(r.error) else "—" if r.error == 0 else f"{r.error:.1e}"
            error = "—" if r.flag and math.isinf(r.error) else error
            cells = (r.asked, r.true, r.known, r.answered, r.engine, error, f"{r.estimate:.0e}", r.flag)
            parts.append("| " + " | ".join(c.replace("|", "\\|") for c in cells) + f" | {'yes' if r.right else 'NO'} |")
    return "\n".join(parts) + "\n"


def record(row: Row) -> dict:
    """The row as a record of the benchmarks."""
    return {
        "name": f"hard_cases: {row.case}",
        "engine": row.engine,
        "parameters": {"asked": row.asked},
        "true": row.true,
        "known_by": row.known,
        "answered": row.answered,
        "error": row.error,
        "estimate": row.estimate,
        "says": row.flag,
        "right": row.right,
        "seconds_per_diagram": row.seconds,
        "compile_seconds": row.compile_seconds,
        "counts": row.counts,
        "machine": harness.machine(),
    }


def main() -> int:
    parser = harness.arguments(__doc__, "fewer rows of each case")
    parser.add_argument("--case", nargs="+", choices=[*CASES], default=[*CASES], help="only these")
    parser.add_argument("--table", metavar="FILE", help="where the rows go as Markdown")
    options = parser.parse_args()
    report, rows = harness.Progress(), []
    for number in options.case:
        for row in CASES[number][1](options.quick):
            rows.append(row)
            mark = "right" if row.right else "WRONG"
            error = f"error {row.error:.1e} estimate {row.estimate:.0e} {row.flag}"
            text = f"{mark} {row.case}: {row.asked} ({row.engine}): {row.answered}; {error}"
            report(text)
    if options.table:
        pathlib.Path(options.table).write_text(table(rows), encoding="utf-8")
    wrong = sum(not r.right for r in rows)
    harness.say(f"{len(rows)} rows, {wrong} wrong without a flag")
    return harness.finish({"name": "hard_cases", "records": [record(r) for r in rows]}, options.json, wrong == 0)


if __name__ == "__main__":
    sys.exit(main())
