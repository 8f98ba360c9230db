"""The diagram of a chamber by SciPy: shooting with DOP853, or collocation with `solve_bvp`; plain NumPy, no JAX.

Unknowns are x = (λa, p, q). A solver meets the rim and the gas law on a plane in x; `follow` steps along the branch with it,
either at given apex stretches (natural: they never fold here) or on planes across the tangent (arclength), and locates
folds, zero-voltage states, breakdown, and the landing.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import brentq

from benchmarks.truth import chambers

SCALE = np.array([1.0, 0.2, 4e-3])  # of λa, p, q: units in which arclength is measured
START = np.array([1.958223439255927, 1.8866126802449, 0.0])  # V = 2.42 at zero voltage
FIRST = 2e-4  # R of the apex series; what it leaves is below 1e-13
_NODES = 9  # through which the extreme at a fold is taken


def stresses(l1, l2, q):
    """s1, s2, ∂s1/∂λ1, ∂s1/∂λ2 of the Gent material; numbers or arrays."""
    c = 1 / (l1 * l2) ** 2
    g = 1 - (l1 * l1 + l2 * l2 + c - 3) / chambers.STRETCH_LIMIT
    a1, a2 = l1 - c / l1, l2 - c / l2
    return (
        a1 / g - q * l1 * l2 * l2,
        a2 / g - q * l1 * l1 * l2,
        (1 + 3 * c / (l1 * l1)) / g + 2 * a1 * a1 / (chambers.STRETCH_LIMIT * g * g) - q * l2 * l2,
        2 * c / (l1 * l2) / g + 2 * a1 * a2 / (chambers.STRETCH_LIMIT * g * g) - 2 * q * l1 * l2,
    )


def series(x):
    """λ2, θ, λ1, V at R = `FIRST`."""
    apex, p, q = x
    s, _, s11, s12 = stresses(apex, apex, q)
    kappa = p * apex**2 / (2 * s)
    b = -(s + apex * (3 * s11 - s12)) * kappa**2 / (16 * s11)
    l2, l1 = apex + b * FIRST**2, apex + (3 * b + apex * kappa**2 / 2) * FIRST**2
    theta = math.asin(p * l2 * l2 * FIRST / (2 * stresses(l1, l2, q)[0]))
    return [l2, theta, l1, math.pi / 4 * apex**3 * kappa * FIRST**4]


def slopes(radius, l2, theta, l1, p, q, sin=math.sin, cos=math.cos):
    """d(λ2, θ, λ1, V)/dR."""
    s1, s2, s11, s12 = stresses(l1, l2, q)
    sine, cosine = sin(theta), cos(theta)
    lean = l1 * cosine - l2
    return (
        lean / radius,
        -s2 / s1 * sine / radius + p * l1 * l2 / s1,
        (s2 * cosine - s1 - s12 * lean) / (radius * s11),
        math.pi * (l2 * radius) ** 2 * l1 * sine,
    )


class Gas:
    """The gas law (p + 50)(V + V_C) = const, as p + 50 − const/(V + V_C)."""

    def __init__(self, chamber: float):
        self.chamber = chamber
        self.amount = (START[1] + chambers.ATMOSPHERE) * (chambers.INITIAL_VOLUME + chamber)

    def defect(self, x, v):
        return x[1] + chambers.ATMOSPHERE - self.amount / (v + self.chamber)

    def slopes(self, v):
        """By x, and by V."""
        return np.array([0.0, 1.0, 0.0]), self.amount / (v + self.chamber) ** 2


class Voltage:
    """A voltage that is held."""

    def __init__(self, voltage: float):
        self.load = voltage**2

    def defect(self, x, v):
        return x[2] - self.load

    def slopes(self, v):
        """By x, and by V."""
        return np.array([0.0, 0.0, 1.0]), 0.0


class Shooting:
    """Newton on the rim's stretch and the loading's condition by shots with DOP853.

    The shot carries two neighbours, moved in λa and in q, on the same steps: differences of these are the Jacobian. That of
    p is free: a scaling of R changes p alone.
    """

    def __init__(self, condition: Gas | Voltage, tolerance: float):
        self.condition, self.tolerance = condition, tolerance
        self.solves = 0

    def shoot(self, x):
        """Defects of rim and condition, their Jacobian, V, and its derivatives at free (λa, p, q)."""
        self.solves += 1
        moves = np.array([[0, 0, 0], [1e-6 * x[0], 0, 0], [0, 0, 1e-7]])
        lanes = [tuple(x + m) for m in moves]

        def rates(radius, y):
            y = y.tolist()
            out = []
            for k, (_, p, q) in enumerate(lanes):
                out += slopes(radius, *y[4 * k : 4 * k + 3], p, q)
            return out

        start = np.concatenate([series(lane) for lane in lanes])
        with np.errstate(all="ignore"):
            done = solve_ivp(
                rates, (FIRST, 1.0), start, method="DOP853", rtol=self.tolerance, atol=1e-3 * self.tolerance
            )
        if not done.success:
            raise ArithmeticError(done.message)
        end = done.y[:, -1].reshape(3, 4)
        rate = np.array(slopes(1.0, *end[0, :3], x[1], x[2]))
        by_apex, by_q = (end[1] - end[0]) / moves[1, 0], (end[2] - end[0]) / moves[2, 2]
        by_p = np.array([rate[0], 0, 0, rate[3] - 3 * end[0, 3]]) / x[1]
        columns = np.stack([by_apex, by_p, by_q], axis=1)
        v = end[0, 3]
        by_x, by_v = self.condition.slopes(v)
        jacobian = np.stack([columns[0], by_v * columns[3] + by_x])
        return np.array([end[0, 0] - 1.0, self.condition.defect(x, v)]), jacobian, v, columns[3]

    def point(self, guess, normal, near=None):
        """x, V on the plane through `guess`; the unit tangent, scaled."""
        x = guess.copy()
        for _ in range(8):
            value, jacobian, v, volume_slopes = self.shoot(x)
            bordered = np.vstack([jacobian * SCALE, normal])
            step = -np.linalg.solve(bordered, [*value, normal @ ((x - guess) / SCALE)])
            x = x + SCALE * step
            if (size := np.abs(step).max()) < max(3e-5, math.sqrt(self.tolerance) / 10):
                # Newton is quadratic: what is left is about the square
                tangent = np.linalg.solve(bordered, [0.0, 0.0, 1.0])
                return Point(x, v + volume_slopes @ (SCALE * step), tangent / np.linalg.norm(tangent))
            if not size < 2:
                break
        raise ArithmeticError("Newton did not converge")


class Collocation:
    """`solve_bvp` with λa, p, q as its unknown parameters, over log R: over R the division by R spoils its residuals."""

    def __init__(self, condition: Gas | Voltage, tolerance: float):
        self.condition, self.tolerance = condition, tolerance
        self.solves = 0

    def point(self, guess, normal, near=None):
        """x and V on the plane through `guess`, the mesh from the point `near`; no tangent."""
        self.solves += 1

        def rates(log, y, x):
            radius = np.exp(log)
            return radius * np.stack(slopes(radius, *y[:3], x[1], x[2], np.sin, np.cos))

        def conditions(y0, y1, x):
            on_plane = normal @ ((x - guess) / SCALE)
            return np.array([*(y0 - series(x)), y1[0] - 1.0, self.condition.defect(x, y1[3]), on_plane])

        mesh, y = near.solution if near is not None else self._first()
        with np.errstate(all="ignore"):
            done = solve_bvp(rates, conditions, mesh, y, p=guess, tol=self.tolerance, max_nodes=20_000)
        if not done.success or np.abs((done.p - guess) / SCALE).max() > 1:
            raise ArithmeticError(done.message)
        return Point(done.p, done.y[3, -1], None, (done.x, done.y))

    def _first(self):
        mesh = np.concatenate([np.geomspace(FIRST, 0.1, 12)[:-1], np.linspace(0.1, 1.0, 12)])

        def rates(radius, y):
            return slopes(radius, *y[:3], START[1], START[2])

        y = solve_ivp(rates, (FIRST, 1.0), series(START), method="DOP853", rtol=1e-8, atol=1e-12, t_eval=mesh).y
        return np.log(mesh), y


@dataclasses.dataclass
class Point:
    """A point of the branch: x = (λa, p, q), V, and what its solver knows of it."""

    x: np.ndarray
    volume: float
    tangent: np.ndarray | None = None
    solution: tuple | None = None

    @property
    def q(self) -> float:
        return float(self.x[2])

    @property
    def pressure(self) -> float:
        return float(self.x[1])

    @property
    def excess(self) -> float:
        """Positive beyond breakdown."""
        return float(self.x[2] - chambers.breakdown_load(self.x[0]))


def follow(solver, first, natural: bool, largest: float, stop: Callable[[list[Point]], bool]) -> list[Point]:
    """Points of the branch from the filling on, first in the direction `first`, until `stop` of the points."""
    across = np.array([1.0, 0.0, 0.0])
    # the variable that the condition leaves free
    points = [solver.point(START.copy(), np.eye(3)[np.argmax(first)])]
    step = 0.05
    while not stop(points) and len(points) < 1000:
        here = points[-1]
        ahead = _direction(points, step, first, across if natural else None)
        try:
            found = solver.point(
                here.x + step * ahead * SCALE, across if natural else ahead / np.linalg.norm(ahead), here
            )
            turn = _turn(here, found, ahead)
            # without a tangent the turn cannot fall below that of the last chord
            if turn > (0.3 if here.tangent is not None or step > 0.1 else 0.9):
                raise ArithmeticError("the step turns too far")
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            step /= 2
            if step < 1e-5:
                break
            continue
        points.append(found)
        if turn < 0.1:
            step = min(1.5 * step, largest)
    return points


def _direction(points, step, first, across):
    """The scaled tangent of the last point, or the chord's on a parabola; of unit λa where steps are natural."""
    last = points[-1]
    if last.tangent is not None:
        ahead = last.tangent
        back = (last.x - points[-2].x) / SCALE if len(points) > 1 else first
        ahead = ahead if ahead @ back > 0 else -ahead
    elif len(points) > 1:
        ways = [(b.x - a.x) / SCALE for a, b in itertools.pairwise(points[-3:])]
        sizes = [np.linalg.norm(way) for way in ways]
        ahead = ways[-1] / sizes[-1]
        if len(ways) > 1:
            bend = (ahead - ways[0] / sizes[0]) / sum(sizes)
            ahead = ahead + bend * (sizes[1] + min(step, 2 * sizes[1]))
            ahead = ahead / np.linalg.norm(ahead)
    else:
        ahead = first / np.linalg.norm(first)
    return ahead if across is None else ahead / (ahead @ across)


def _turn(here, found, ahead) -> float:
    """The angle between prediction and way."""
    way = (found.x - here.x) / SCALE
    cosine = way @ ahead / np.linalg.norm(way) / np.linalg.norm(ahead)
    return math.acos(min(1.0, max(-1.0, cosine)))


def between(solver, a: Point, b: Point, natural: bool):
    """The branch between two points as a function of a share of the way."""
    chord = (b.x - a.x) / SCALE
    normal = np.array([1.0, 0.0, 0.0]) if natural else chord / np.linalg.norm(chord)
    return lambda share: solver.point(a.x + share * (b.x - a.x), normal, b)


def extreme(solver, a: Point, b: Point, natural: bool, field: Callable) -> tuple[float, float]:
    """The extreme of a field between two points, and V there, by the polynomials through Chebyshev nodes."""
    along = between(solver, a, b, natural)
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    found = [along((1 + node) / 2) for node in nodes]
    fields = [[field(p) for p in found], [p.volume for p in found]]
    value, v = (np.polynomial.Chebyshev.fit(nodes, f, _NODES - 1, domain=[-1, 1]) for f in fields)
    roots = value.deriv().roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) <= 1)]
    if not len(real):
        raise ArithmeticError("the extreme was lost")
    place = real[np.argmin(np.abs(real))]
    return float(value(place)), float(v(place))


def crossing(solver, a: Point, b: Point, natural: bool, value: Callable[[Point], float]) -> Point:
    """The point between two at which `value` vanishes."""
    along = between(solver, a, b, natural)
    ends = {0.0: a, 1.0: b}

    def at(share):
        if share not in ends:
            ends[share] = along(share)
        return value(ends[share])

    root = brentq(at, 0.0, 1.0, xtol=1e-11, rtol=1e-11)
    at(root)
    return ends[root]


def peaks(values: list[float]) -> list[int]:
    """Where a list of numbers turns."""
    return [i for i in range(1, len(values) - 1) if (values[i] - values[i - 1]) * (values[i + 1] - values[i]) < 0]


def diagram(solver, natural: bool, largest: float = 0.4) -> tuple[chambers.Found, dict]:
    """The special points of a chamber, and counts of the work."""

    def load(point):
        return point.q

    def stop(points):
        if points[-1].excess < 0:
            return points[-1].x[0] > 10.5
        # past breakdown: on to the landing of the snap, if there is one
        q = [p.q for p in points]
        turns = peaks(q)
        return not turns or q[-1] > max(q[i] for i in turns) or points[-1].x[0] > 10.2

    points = follow(solver, np.array([0.25, 0.0, 1.0]), natural, largest, stop)
    signs = np.sign([p.excess for p in points])
    over = int(np.argmax(signs > 0)) if (signs > 0).any() else None
    last = over if over is not None else len(points) - 1
    turns = [i for i in peaks([p.q for p in points]) if i <= last]
    folds = [extreme(solver, points[i - 1], points[i + 1], natural, load) for i in turns]
    broken = crossing(solver, points[over - 1], points[over], natural, lambda p: p.excess) if over else None
    zeros = []
    for a, b in itertools.pairwise(points[1 : last + 1]):
        if a.q * b.q < 0:
            zeros.append(crossing(solver, a, b, natural, load).volume)
    landing = chambers.NAN
    if folds:
        snap = folds[0][0]
        for a, b in itertools.pairwise(points[turns[0] + 1 :]):
            if a.q < snap <= b.q:
                landing = crossing(solver, a, b, natural, lambda p: p.q - snap).volume
                break
    found = chambers.Found(folds, zeros, broken.q if broken else chambers.NAN, landing)
    return found, {"points": len(points), "solves": solver.solves}


def pressure_volume(solver, natural: bool, volume: float, largest: float = 0.6) -> tuple[list[float], dict]:
    """The pressures of the folds of a p–V curve from V = 2.42 to `volume`, and counts of the work."""
    points = follow(solver, np.array([1.0, 0.0, 0.0]), natural, largest, lambda points: points[-1].volume > volume)
    turns = peaks([p.pressure for p in points])
    folds = [extreme(solver, points[i - 1], points[i + 1], natural, lambda p: p.pressure)[0] for i in turns]
    return folds, {"points": len(points), "solves": solver.solves}
