"""Folds and breakdown in two parameters: their curves over a parameter and the control, and where folds merge.

A state is u = (λa, p, q), a parameter θ. A fold or breakdown is given by three equations F(u, θ) = 0 of `point_systems` in four
unknowns: the residual of the shot, the loading condition, and det ∂(r, g)/∂(λa, p) = 0, or E/E_EB = 1 at the apex. So it lies on a
curve, which pseudo-arclength continuation follows with exact Jacobians. Along a curve of folds θ turns

    together with the control        at a cusp: two folds merge, and beyond it neither exists;
    while the control is monotonic   at a merger: two branches touch, and beyond it they are joined differently, or a loop is gone.

Diagrams at several values of the parameter provide starting points; every fold of every diagram must lie on a curve, and every
crossing of a curve must appear in its diagram. Bracketed points are located by Brent's method along the curve.
"""

import dataclasses
import math
import typing

import numpy as np

from ..diagram import hermite, pressure_volume, voltage_volume
from ..model import SCALE, Chamber, ConstantPressure, ConstantVoltage, PointKind, Scene, other_loading, pair, plain
from ..numerics import SceneError
from ..plot import plot_fold_curves
from .fold_continuation import ConditionsOver, Followed, Lost, Place, System, follow
from .resolution import DRAWN, LARGEST_LOAD, SAME_POINT

__all__ = ["FoldCurve", "FoldCurves", "TwoParameterPoint", "fold_curves"]

_QUANTITIES = ("parameter", "apex_stretch", "pressure", "voltage", "volume", "breakdown_ratio", "error_estimate")


@dataclasses.dataclass(frozen=True)
class FoldCurve:
    """A curve of folds or of breakdown: arrays (points,), dimensionless or in SI of a scene with units, and why it ends on either side.

    `ends`: lower_bound, upper_bound (of the parameter), zero_voltage, largest_ratio, largest_load, closed, no_filling (no state
    of the first branch fills the chamber beyond), or step_too_small and too_many_points, which are reported as doubts.
    `error_estimate` is relative, of parameter and control. `line` (more, 4) is for figures: parameter, p, Φ and E/E_EB along
    the cubics between points.
    """

    kind: str
    parameter: np.ndarray
    apex_stretch: np.ndarray
    pressure: np.ndarray
    voltage: np.ndarray
    volume: np.ndarray
    breakdown_ratio: np.ndarray
    error_estimate: np.ndarray
    ends: tuple[str, str]
    line: np.ndarray


@dataclasses.dataclass(frozen=True)
class TwoParameterPoint:
    """A point of a curve of folds: `kind` is cusp, merger, fold_at_breakdown or zero_voltage; `curve` is its number."""

    kind: str
    curve: int
    parameter: float
    apex_stretch: float
    pressure: float
    voltage: float
    volume: float
    breakdown_ratio: float
    error_estimate: float


@dataclasses.dataclass(frozen=True)
class FoldCurves:
    """Curves of folds and breakdown of a scene over a parameter.

    `control` is the quantity that has the folds, "voltage" or "pressure". `complete` says whether curves and the diagrams at
    `sampled` agree, and `doubts` lists the disagreements in sentences.
    """

    scene: Scene
    parameter: str
    within: tuple[float, float]
    control: str
    curves: tuple[FoldCurve, ...]
    points: tuple[TwoParameterPoint, ...]
    sampled: tuple[float, ...]
    doubts: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether nothing is in doubt."""
        return not self.doubts

    def named(self, kind: str) -> list[TwoParameterPoint]:
        """The points of a kind, in order of the parameter."""
        return sorted((p for p in self.points if p.kind == kind), key=lambda p: p.parameter)

    def to_dict(self) -> dict:
        """The curves for JSON, as plain numbers and lists."""
        names = [f.name for f in dataclasses.fields(FoldCurve) if f.name != "line"]
        curves = [{name: getattr(c, name) for name in names} for c in self.curves]
        return plain(
            {
                "parameter": self.parameter,
                "within": self.within,
                "control": self.control,
                "curves": curves,
                "points": [dataclasses.asdict(p) for p in self.points],
                "sampled": self.sampled,
                "complete": self.complete,
                "doubts": self.doubts,
            }
        )

    def plot(self, *, ax=None, legend: bool = True):
        """Draws the curves; see `plot_fold_curves`."""
        return plot_fold_curves(self, ax=ax, legend=legend)


def _check(scene, parameter, within, samples, kinds, largest_ratio) -> tuple[float, float]:
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a Scene, but is a {type(scene).__name__}.")
    if not isinstance(scene.loading, (Chamber, ConstantPressure, ConstantVoltage)):
        raise other_loading(scene.loading, Chamber, ConstantPressure, ConstantVoltage)
    scene.check_varies(parameter)
    low, high = pair("within", scene.numbers_of(parameter, within))
    for value in (low, high):
        scene.replace(**{parameter: value})
    if not (isinstance(samples, int) and samples >= 2):
        raise ValueError(f"`samples` must be a whole number of at least 2, but is {samples!r}.")
    if not kinds or not set(kinds) <= {"fold", "breakdown"}:
        raise ValueError(f"`kinds` must hold 'fold' or 'breakdown' or both, but is {kinds!r}.")
    if not 0 < largest_ratio <= 2:
        raise ValueError(f"`largest_ratio` must lie between 0 and 2, but is {largest_ratio!r}.")
    return low, high


def fold_curves(
    scene: Scene,
    parameter: str,
    within: tuple[float, float],
    *,
    kinds: tuple[str, ...] = ("fold", "breakdown"),
    samples: int = 9,
    largest_ratio: float = 1.3,
) -> FoldCurves:
    """Folds and breakdown of a scene as a parameter goes through `within`, by continuation in (λa, p, q, parameter).

    Args:
        scene: the folds are those of the voltage on a Chamber or at ConstantPressure, and of the pressure at ConstantVoltage.
        parameter: the published name of a continuous parameter (`PARAMETERS`): "chamber_volume", "initial_volume",
            "pressure", "prestretch", "stretch_limit", …; wide ranges are followed in the logarithm.
        within: the lowest and highest value.
        kinds: "fold", "breakdown", or both.
        samples: number of diagrams, evenly spaced between the bounds, that provide starting points and check the result.
        largest_ratio: E/E_EB at the apex up to which folds are followed. They are also followed up to t = 0.9 only, because
            there are infinitely many towards the cone.

    Returns:
        `FoldCurves`: arrays of parameter, λa, p, Φ, V, E/E_EB and a relative error estimate (parameter and control) along
        each curve; cusps, mergers, folds at breakdown and at zero voltage.

    Raises:
        ValueError: if the scene does not have the parameter, or for bad bounds.

    >>> from dielectric_jax import Chamber, Membrane
    >>> scene = Scene(Membrane(), Chamber(volume=1600.0, initial_volume=2.42))
    >>> found = fold_curves(scene, "chamber_volume", (450.0, 600.0), kinds=("fold",), samples=3)
    >>> [round(point.parameter, 5) for point in found.named("cusp")]
    [484.04966, 551.39914]
    """
    low, high = _check(scene, parameter, within, samples, kinds, largest_ratio)
    if isinstance(scene.loading, ConstantVoltage):
        control, of = "pressure", {"fold": PointKind.pressure_fold, "breakdown": PointKind.breakdown}
    else:
        control, of = "voltage", {"fold": PointKind.fold, "breakdown": PointKind.breakdown}
    shares = np.linspace(0.0, 1.0, samples)
    plan = System(of["fold"], ConditionsOver(scene, parameter), (low, high))
    values = [plan.value(w) for w in shares]
    seeds, doubts = _seeds(scene, parameter, values, largest_ratio)
    windows = [scene.with_values(**{parameter: value}).limits()[0] for value in values]
    curves, points = [], []
    for kind in kinds:
        system = System(of[kind], ConditionsOver(scene, parameter), (low, high))
        own = [(i, np.append(u / SCALE, shares[i])) for i, k, u in seeds if k == kind]
        own = [seed for seed in own if control == "pressure" or seed[1][2] >= 0]
        found, words = _followed(system, shares, own, largest_ratio, windows)
        points += [
            _point(name, len(curves) + k, system, place) for k, one in enumerate(found) for name, place in one.points
        ]
        curves += [_curve(kind, system, one) for one in found]
        doubts += [f"At {parameter} = {system.value(z[3]):g}, λa = {z[0]:.6g}, a {kind}{text}" for z, text in words]
    curves, points = (tuple(_in_units(scene, one) for one in many) for many in (curves, points))
    return FoldCurves(scene, parameter, (low, high), control, curves, points, tuple(values), tuple(doubts))


def _in_units(scene: Scene, found: typing.Any) -> typing.Any:
    """A curve or a point with its pressures, volumes and voltages as the scene gives them."""
    changes = {n: scene.in_units(getattr(found, n), n) for n in ("pressure", "voltage", "volume")}
    if isinstance(found, FoldCurve):
        scales = [1.0, scene.in_units(1.0, "pressure"), scene.in_units(1.0, "voltage"), 1.0]
        changes["line"] = found.line * np.array(scales, float)
    return dataclasses.replace(found, **changes)


def _followed(system: System, shares, seeds: list, largest_ratio: float, windows) -> tuple[list[Followed], list]:
    """Every curve through seeds (sample, z), and the disagreements between curves and seeds: (z, description).

    A curve may leave the `windows`, the apex stretches of the diagrams at the samples, which show nothing beyond.
    """
    curves: list[Followed] = []
    doubts = []
    passed = [False] * len(seeds)
    for n, (i, z) in enumerate(seeds):
        if passed[n]:
            continue
        system.conditions.begin_anew()
        try:
            start = system.correct(z, np.array([0.0, 0.0, 0.0, 1.0]), np.ones(4))
        except (Lost, SceneError, ValueError):
            doubts.append((z, " of the diagram was not reached by Newton."))
            continue
        found = follow(system, start, shares, largest_ratio)
        curves.append(found)
        for end, place in zip(found.ends, (found.places[0], found.places[-1]), strict=True):
            if end in ("step_too_small", "too_many_points"):
                doubts.append((place.z, f" curve ends: {end}."))
        for j, place in [(i, start), *found.crossings]:
            near = [m for m, (k, other) in enumerate(seeds) if k == j and np.abs(other - place.z).max() < SAME_POINT]
            for m in near:
                passed[m] = True
            inside = place.ratio < 0.999 * largest_ratio and place.fraction < 0.999 * LARGEST_LOAD
            inside &= windows[j][0] < place.z[0] * SCALE[0] < windows[j][1] * (1 - 1e-6)
            if not near and inside and abs(place.z[2]) > 1e-9:
                doubts.append((place.z, " is on a curve but not in the diagram."))
    return curves, doubts


def _seeds(scene: Scene, parameter: str, values: list[float], largest_ratio: float):
    """Folds and breakdowns of diagrams within the limits, (sample, kind, u), and sentences on diagrams that do not exist."""
    seeds, doubts = [], []
    for i, value in enumerate(values):
        own = scene.with_values(**{parameter: value})
        try:
            if isinstance(own.loading, ConstantVoltage):
                found = pressure_volume(own.membrane, float(own.loading.voltage), window=own.window)
            else:
                found = voltage_volume(own)
        except SceneError as error:
            doubts.append(f"At {parameter} = {value:g} there is no diagram: {error}")
            continue
        for p in found.special_points:
            largest = LARGEST_LOAD * float(own.membrane.largest_load(p.apex_stretch))
            if p.breakdown_ratio <= largest_ratio and p.voltage_squared <= largest:
                seeds.append((i, p.kind, np.array([p.apex_stretch, p.pressure, p.voltage_squared])))
        if not found.complete:
            doubts.append(f"The diagram at {parameter} = {value:g} is not complete.")
    return seeds, doubts


def _numbers(system: System, place: Place) -> tuple[float, ...]:
    """The numbers of a place in the order of `_QUANTITIES`."""
    apex, p, q = (float(v) for v in place.z[:3] * SCALE)
    voltage = math.sqrt(max(q, 0.0))
    return system.value(place.z[3]), apex, p, voltage, place.volume, place.ratio, place.error


def _curve(kind: str, system: System, found: Followed) -> FoldCurve:
    columns = np.array([_numbers(system, place) for place in found.places]).T
    named = dict(zip(_QUANTITIES, columns, strict=True))
    return FoldCurve(kind, **named, ends=found.ends, line=_line(system, found.places, named["breakdown_ratio"]))


def _line(system: System, places: list[Place], ratio: np.ndarray) -> np.ndarray:
    """Parameter, p, Φ and E/E_EB on the cubics between places."""
    z, t = np.array([p.z for p in places]), np.array([p.tangent for p in places])
    # orient the tangents along the chords: from the start they point both ways
    chords = np.diff(z, axis=0)
    pieces = []
    for k, chord in enumerate(chords):
        length = float(np.linalg.norm(chord))
        if length == 0:
            continue
        t0, t1 = (t[i] * (-1.0 if t[i] @ chord < 0 else 1.0) for i in (k, k + 1))
        for share in np.linspace(0.0, 1.0, DRAWN, endpoint=False):
            at = hermite(z[k], z[k + 1], t0, t1, length, share)
            pieces.append([*at, ratio[k] + share * (ratio[k + 1] - ratio[k])])
    pieces.append([*z[-1], ratio[-1]])
    table = np.array(pieces)
    values = [system.value(w) for w in table[:, 3]]
    loads = np.sqrt(np.maximum(table[:, 2] * SCALE[2], 0.0))
    return np.column_stack([values, table[:, 1] * SCALE[1], loads, table[:, 4]])


def _point(kind: str, curve: int, system: System, place: Place) -> TwoParameterPoint:
    numbers = map(float, _numbers(system, place))
    return TwoParameterPoint(kind, curve, **dict(zip(_QUANTITIES, numbers, strict=True)))
