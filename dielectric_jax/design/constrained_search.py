"""The constrained search for a best design by SciPy's SLSQP: objective and constraints with exact values and gradients.

Both are measures of the events of a ramp on the surface, functions of the design by the implicit function theorem. The
unknowns of a ramp with n snaps: the start λs, for each snap its fold (λ1, q1) and landing λ2, breakdown λb, and where the way down matters the fold (λf, qf) from which the snap-back starts. They solve F(u; θ) = 0, so that du/dθ = −F_u⁻¹ F_θ.
"""

import dataclasses
import functools
import typing

import jax.numpy as jnp
import numpy as np
import scipy.optimize

from ..diagram import Ramps
from ..model import Outcome, Regime, Scene
from ..numerics import check_between
from .conditions import System, solve_on_surface
from .designs import classify_designs
from .regime_maps import check_range, even
from .resolution import ACTIVE, AT_END, LOST_STRAIN, NEARLY_ACTIVE, TANGENT_REACH
from .scenarios import Scenario

__all__ = [
    "Axis",
    "Climb",
    "Kind",
    "Measures",
    "Requirements",
    "axis_of",
    "begin_of",
    "inwards",
    "measure",
    "scan_designs",
]


class Kind(typing.NamedTuple):
    """The shape of a ramp: how many snaps, and whether its way down has a fold that matters."""

    snaps: int
    back: bool


class Measures(typing.NamedTuple):
    """What an optimisation needs of designs: numbers (n,) and their derivatives (n, parameters), in pairs.

    `growth` is 2 log(λb/λs); `start` the slope c′ at the start, positive where it is stable; for each snap `fold`, log (E/E_EB)²
    at it, `landing`, the same where it lands, `sharpness`, −c″ at it, zero where it merges with another; `back` the q of the
    snap-back. `rates` are the derivatives of the `unknowns`.
    """

    names: tuple
    values: np.ndarray
    slopes: np.ndarray
    unknowns: np.ndarray
    rates: np.ndarray
    fair: np.ndarray


def measures_of(kind: Kind) -> tuple:
    """The names of the measures of ramps of a kind."""
    names = ["growth", "start"]
    for k in range(kind.snaps):
        names += [f"fold_{k}", f"landing_{k}", f"sharpness_{k}"]
    return (*names, "back") if kind.back else tuple(names)


def begin_of(kind: Kind, ramps: Ramps, which: np.ndarray) -> np.ndarray:
    """The unknowns (n, …) from ramps; NaN where a ramp is of another kind."""
    columns = [ramps.start.apex_stretch[which]]
    for k in range(kind.snaps):
        snap = ramps.snap
        columns += [snap.apex_stretch[which, k], snap.voltage_squared[which, k], ramps.landing.apex_stretch[which, k]]
    broken = ramps.breakdown.apex_stretch[which]
    last = ramps.landing.apex_stretch[which, kind.snaps - 1] if kind.snaps else broken
    columns.append(np.where(np.isfinite(broken), broken, last))
    columns.append(np.nan_to_num(ramps.breakdown.voltage_squared[which], nan=0.01))
    if kind.back:
        # the last minimum of q below the landing, also where q is negative there
        folds, loads = ramps.folds.apex_stretch[which], ramps.folds.voltage_squared[which]
        below = np.where(folds < columns[3 * kind.snaps][:, None], folds, -np.inf)
        place = np.argmax(below, axis=1)
        rows = np.arange(len(place))
        columns += [np.where(np.isfinite(below[rows, place]), folds[rows, place], np.nan)]
        columns += [loads[rows, place]]
    return np.stack(columns, axis=1)


def _points(kind: Kind) -> tuple:
    """The points of the surface that the equations use."""
    points: list = [(0, -1)]
    for k in range(kind.snaps):
        points += [(1 + 3 * k, 2 + 3 * k), (3 + 3 * k, 2 + 3 * k)]
    end = 1 + 3 * kind.snaps
    points.append((end, end + 1))
    return (*points, (end + 2, end + 3)) if kind.back else tuple(points)


def _equations(kind: Kind, on, u):
    end = 1 + 3 * kind.snaps
    rows = [on.filled]
    measured = [2 * jnp.log(u[end] / u[0]), on.slope(0, u[0], 0.0)]
    for k in range(kind.snaps):
        fold, q, landing = u[1 + 3 * k], u[2 + 3 * k], u[3 + 3 * k]
        rows += [on.excess(1 + 2 * k, fold, q), on.slope(1 + 2 * k, fold, q), on.excess(2 + 2 * k, landing, q)]
        measured += [on.field(fold, q), on.field(landing, q), -on.bend(1 + 2 * k, fold, q)]
    last = 1 + 2 * kind.snaps
    rows += [on.excess(last, u[end], u[end + 1]), on.field(u[end], u[end + 1])]
    if kind.back:
        rows += [on.excess(last + 1, u[end + 2], u[end + 3]), on.slope(last + 1, u[end + 2], u[end + 3])]
        measured.append(u[end + 3])
    return rows, measured


_EQUATIONS = {
    Kind(snaps, back): functools.partial(_equations, Kind(snaps, back)) for snaps in (0, 1, 2) for back in (False, True)
}


def measure(kind: Kind, names: tuple, surface, scene: Scene, theta, guess) -> Measures:
    """Measures of designs θ (n, parameters) from guesses of their unknowns (n, …); `fair` says where Newton converged."""
    theta, guess = np.atleast_2d(theta), np.atleast_2d(guess)
    found = solve_on_surface(System(_EQUATIONS[kind], _points(kind), surface, scene, names), guess, theta)
    with np.errstate(invalid="ignore"):
        fair = (found.size < 1e-8) & np.isfinite(found.slopes).all(axis=(1, 2))
    return Measures(measures_of(kind), found.measures, found.slopes, found.unknowns, found.rates, fair)


@dataclasses.dataclass(frozen=True)
class Requirements:
    """The requirements on a design."""

    survival_margin: float
    operating_margin: float
    must_snap: bool
    way_down: str | None

    def __post_init__(self):
        for name in ("survival_margin", "operating_margin"):
            value = getattr(self, name)
            check_between(name, value, 0.0, 0.99)
        if self.way_down not in (None, "stays", "returns"):
            raise ValueError(f"`way_down` must be 'stays', 'returns' or None, but is {self.way_down!r}.")

    @property
    def landing_limit(self) -> float:
        """The largest log (E/E_EB)² of a landing, where E_EB is the operating field."""
        return 2 * np.log(min(1.0, (1 - self.survival_margin) / (1 - self.operating_margin)))

    @property
    def landing_name(self) -> str:
        """The margin that limits landings."""
        return "survival_margin" if self.survival_margin >= self.operating_margin else "operating_margin"


@dataclasses.dataclass(frozen=True)
class Axis:
    """A design parameter and its range; the unit coordinate is logarithmic over wide ranges."""

    name: str
    low: float
    high: float
    logarithmic: bool

    def value(self, z: float) -> tuple[float, float]:
        """The parameter at z from 0 to 1, and its derivative."""
        if z <= 0 or z >= 1:  # the exact ends
            x = self.low if z <= 0 else self.high
        else:
            x = self.low * (self.high / self.low) ** z if self.logarithmic else self.low + z * (self.high - self.low)
        return x, x * np.log(self.high / self.low) if self.logarithmic else self.high - self.low


def axis_of(name: str, limits, scene: Scene) -> Axis:
    """The axis of a scene's parameter over a range; raises ValueError for invalid ones."""
    low, high = check_range(name, limits, scene)
    values = even(name, (low, high), 3)
    return Axis(name, low, high, bool(abs(values[1] - (low + high) / 2) > 1e-9 * high))


def scan_designs(scenes: list[Scenario], names: tuple, values: np.ndarray, required: Requirements, share: float = 0.0):
    """Area strains of designs (n, parameters), NaN where one does not satisfy the requirements, and the nominal designs.

    With several scenarios the strain is the worst, or, if a `share` of them may fail or fall short, the quantile.
    """
    strains, every = [], []
    for scenario in scenes:
        given = dict(zip(names, (values * scenario.factors).T, strict=True))
        found = classify_designs(scenario.scene, given, surface=scenario.surface, whole=False)
        every.append(found)
        ramps = found.ramps
        with np.errstate(invalid="ignore"):
            landed = np.where(np.isnan(ramps.landing_ratio), -np.inf, ramps.landing_ratio).max(axis=-1)
            good = (ramps.outcome == Outcome.breakdown_on_branch) & (landed <= np.exp(required.landing_limit / 2))
        if required.must_snap or required.way_down:
            good &= ramps.snaps > 0
        if required.way_down:
            good &= found.regime == int(Regime[required.way_down])
        strains.append(np.where(good, ramps.area_strain, np.nan))
    table = np.sort(np.nan_to_num(np.stack(strains), nan=-1.0), axis=0)
    worst = table[int(np.floor(share * len(table)))]
    return np.where(worst > -1, worst, np.nan), every[0]


class Climb:
    """The optimisation for one structure of ramp, over all scenarios, in unit coordinates of the ranges."""

    def __init__(self, kind: Kind, scenes: list[Scenario], axes: list, required: Requirements, weights):
        self.kind, self.scenes, self.axes, self.required = kind, scenes, axes, required
        self.names = tuple(a.name for a in axes)
        self.held = weights  # which scenarios must satisfy the constraints
        self.known: list = []
        self.evaluations = 0
        self.feasible: tuple | None = None

    def place(self, z):
        """Parameters and their derivatives by the unit coordinates."""
        pairs = [a.value(v) for a, v in zip(self.axes, z, strict=True)]
        return np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])

    def seed(self, z, begin: list) -> bool:
        """Starts at z from unknowns of every scenario; whether Newton converges."""
        found = self._measured(z, begin)
        if found is not None:
            self.known.append((np.array(z), found))
        return found is not None

    def _measured(self, z, begin):
        x = self.place(z)[0]
        self.evaluations += 1
        found = []
        for scenario, guess in zip(self.scenes, begin, strict=True):
            m = measure(self.kind, self.names, scenario.surface, scenario.scene, x * scenario.factors, guess)
            if not m.fair[0]:
                return None
            found.append(m)
        return found

    def at(self, z, halvings: int = 5):
        """Measures at z, starting from the nearest known design, with intermediate designs if Newton does not converge."""
        z = np.array(z, float)
        near = min(self.known, key=lambda k: np.abs(k[0] - z).max())
        if np.array_equal(near[0], z):
            return near[1]
        found = self._measured(z, self._ahead(near, z))
        if found is None and halvings:
            if self.at((near[0] + z) / 2, 0 if halvings == 1 else halvings - 1) is None:
                return None
            near = min(self.known, key=lambda k: np.abs(k[0] - z).max())
            found = self._measured(z, self._ahead(near, z))
        if found is not None:
            self.known.append((z, found))
        return found

    def _ahead(self, near: tuple, z) -> list[np.ndarray]:
        """The unknowns at z extrapolated along the tangents of a known design, or its own unknowns if they change too much."""
        place, found = near
        step = self.place(z)[0] - self.place(place)[0]
        guesses = []
        for m, scenario in zip(found, self.scenes, strict=True):
            here, move = m.unknowns[0], m.rates[0] @ (step * scenario.factors)
            guesses.append(here + move * bool((np.abs(move) < TANGENT_REACH * np.abs(here)).all()))
        return guesses

    def unknowns(self, z) -> list[np.ndarray]:
        """The unknowns of every scenario at a design that `at` has computed."""
        z = np.array(z, float)
        found = next(found for place, found in self.known if np.array_equal(place, z))
        return [m.unknowns[0] for m in found]

    def rows(self, z):
        """Growth (scenarios,) and its derivatives by z, and for every constraint: name, scenario, value ≥ 0, derivative."""
        found = self.at(z)
        if found is None:
            return None
        rate = self.place(z)[1]
        growth, by_z, limits = [], [], []
        wish = self.required
        for j, (m, scenario) in enumerate(zip(found, self.scenes, strict=True)):
            value = dict(zip(m.names, m.values[0], strict=True))
            slope = dict(zip(m.names, m.slopes[0] * scenario.factors * rate, strict=True))
            growth.append(value["growth"])
            by_z.append(slope["growth"])
            mine = [("start_stable", value["start"], slope["start"])]
            for k in range(self.kind.snaps):
                landing, fold, sharp = f"landing_{k}", f"fold_{k}", f"sharpness_{k}"
                mine.append((wish.landing_name, wish.landing_limit - value[landing], -slope[landing]))
                mine.append(("snap_before_breakdown", -value[fold], -slope[fold]))
                mine.append(("snap_exists", value[sharp], slope[sharp]))
            if self.kind.back:
                sign = -100.0 if wish.way_down == "stays" else 100.0
                mine.append((typing.cast(str, wish.way_down), sign * value["back"], sign * slope["back"]))
            limits += [(name, j, v, s) for name, v, s in mine]
        return np.array(growth), np.array(by_z), limits

    def run(self, z) -> tuple | None:
        """Runs SLSQP from z; returns the best feasible design that was computed: z and objective."""
        count, scenes = len(z), len(self.scenes)
        rows = self.rows(z)
        if rows is None:
            return None
        many = scenes > 1
        held = np.flatnonzero(self.held)
        start = np.append(z, rows[0][held].min()) if many else np.array(z, float)
        width = sum(self.held[j] for _, j, _, _ in rows[2])

        def objective(v):
            if many:
                return -v[-1], np.append(np.zeros(count), -1.0)
            rows = self.rows(v)
            return (LOST_STRAIN, np.zeros(count)) if rows is None else (-rows[0][0], -rows[1][0])

        def constraints(v):
            rows = self.rows(v[:count])
            if rows is None:
                size = width + len(held) * many
                return np.full(size, -LOST_STRAIN), np.zeros((size, len(v)))
            growth, by_z, limits = rows
            own = [(value, slope) for _, j, value, slope in limits if self.held[j]]
            g, dg = np.array([o[0] for o in own]), np.array([o[1] for o in own])
            if many:
                g = np.append(g, growth[held] - v[-1])
                dg = np.concatenate([dg, by_z[held]])
                dg = np.concatenate([dg, np.append(np.zeros(width), -np.ones(len(held)))[:, None]], axis=1)
            if g.min() > -1e-9 or (many and g[:width].min() > -1e-9):
                reached = growth[held].min()
                if self.feasible is None or reached > self.feasible[1]:
                    self.feasible = np.array(v[:count]), reached
            return g, dg

        bounds = [(0.0, 1.0)] * count + [(None, None)] * many
        with np.errstate(all="ignore"):
            scipy.optimize.minimize(
                lambda v: objective(v)[0],
                start,
                jac=lambda v: objective(v)[1],
                method="SLSQP",
                bounds=bounds,
                constraints={
                    "type": "ineq",
                    "fun": lambda v: constraints(v)[0],
                    "jac": lambda v: constraints(v)[1],
                },
                options={"ftol": 1e-13, "maxiter": 80},
            )
        return None if self.feasible is None else self._corrected(*self.feasible)

    def _corrected(self, z: np.ndarray, reached: float) -> tuple:
        """The design moved by Newton onto its nearly active constraints, if it stays close and feasible."""
        place = np.where(z < AT_END, 0.0, np.where(z > 1 - AT_END, 1.0, z))
        for _ in range(3):
            rows = self.rows(place)
            if rows is None:
                return z, reached
            near = [(v, s) for _, j, v, s in rows[2] if self.held[j] and abs(v) < NEARLY_ACTIVE]
            free = (place > 0) & (place < 1)
            if not near:
                break
            if len(near) > free.sum():
                return z, reached
            slopes = np.array([s for _, s in near]) * free
            move = np.linalg.lstsq(slopes, -np.array([v for v, _ in near]), rcond=None)[0]
            place = np.clip(place + move, 0.0, 1.0)
        rows = self.rows(place)
        if rows is None or np.abs(place - z).max() > 1e-4:
            return z, reached
        least = min(v for _, j, v, _ in rows[2] if self.held[j])
        return (place, float(rows[0][self.held].min())) if least > -1e-12 else (z, reached)


def inwards(climb: Climb, z: np.ndarray) -> np.ndarray:
    """A step away from every active constraint, including bounds."""
    rows = climb.rows(z)
    active = (
        [s / (np.linalg.norm(s) + 1e-300) for _, j, v, s in rows[2] if climb.held[j] and v < ACTIVE] if rows else []
    )
    normals = [*active, *(np.eye(len(z))[z <= 0]), *(-np.eye(len(z))[z >= 1])]
    if not normals:
        return np.zeros(len(z))
    step = np.linalg.lstsq(np.array(normals), np.ones(len(normals)), rcond=None)[0]
    return step / max(1.0, float(np.abs(step).max()))
