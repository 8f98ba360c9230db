"""Makes `data/chambers.csv`: the special points of 256 chambers, and `data/pressure_volume.csv`: folds of p–V curves.

Nothing of the package is used. The equations are integrated in extended precision by the fixed grid of `truth.py`, which
gives the true pressure and volume at any apex stretch λa and load q = Φ²; the rest is root finding:

1. A march in λa (double precision, 120 values, all chambers side by side) solves the gas law for q(λa) from the filling at
   zero voltage on. Extremes, zeros, the crossing of the breakdown load, and the return to the load of a fold are read from
   quintic splines through it. These are guesses.
2. Every point is then solved in extended precision by the secant method. A fold is the extreme of the polynomial
   through q at eleven Chebyshev nodes about the guess; volume and pressure are read from the polynomials through theirs.
3. Everything is repeated with twice the steps and, at folds, three fifths of the width. The difference is the uncertainty
   of a point, in its last column: the largest of |ΔΦ| (|Δp| for a p–V fold) and |ΔV|/V.

    python -m benchmarks.truth.make_references [--steps 140] [--chambers 256]
"""

import argparse
import csv
import itertools
import pathlib
import sys

import numpy as np
from scipy.interpolate import make_interp_spline

from benchmarks import harness
from benchmarks.truth import extended_precision as truth

DATA = pathlib.Path(__file__).parent / "data"
LIMIT, RIM, FILLING, ATMOSPHERE = 270.0, 1.0, 2.42, 50.0
SMALLEST, LARGEST, COUNT = 300.0, 25000.0, 256
VOLTAGES = (0.0, 0.05)  # of the p–V curves
UNKNOWNS = ("chamber_volume", "kind", "apex_stretch", "pressure", "volume", "voltage_squared", "uncertainty")
FIELD = np.sqrt(45e3 / (4.7 * 8.854e-12)) / 1e6  # √(μ/ε) in MV/m
_NODES, _WIDTH = 11, 0.05
_LAST = 10.2  # λa, where the march ends
_PART = 1500  # points integrated at once


def breakdown_load(apex):
    """q at which E/E_EB = 1 at the apex: E_EB = 30.6 λ^1.13 MV/m, at most 218 MV/m."""
    return (np.minimum(30.6 * apex ** np.asarray(1.13, apex.dtype), 218.0) / FIELD / apex**2) ** 2


def pressure_and_volume(apex, pressure, q, steps):
    """p, V at (λa, q) from a guess of p; the arrays' own precision."""
    limit, rim = (np.full(apex.shape, v, apex.dtype) for v in (LIMIT, RIM))
    parts = []
    with np.errstate(all="ignore"):
        for i in range(0, len(apex), _PART):
            own = [v[i : i + _PART] for v in (apex, pressure, q, limit, rim)]
            parts.append(truth.shoot_on_fixed_grid(*own, steps)[:2])
    return np.concatenate([p for p, _ in parts]), np.concatenate([v for _, v in parts])


class Gas:
    """The gas law of chambers as a defect of p and V; at `chamber` None the pressure is held instead."""

    def __init__(self, chamber, filling_pressure):
        self.chamber, self.filling_pressure = chamber, filling_pressure

    def defect(self, p, v):
        amount = (self.filling_pressure + ATMOSPHERE) * (FILLING + self.chamber)
        return (p + ATMOSPHERE) * (v + self.chamber) / amount - 1

    def take(self, which):
        return Gas(self.chamber[which], self.filling_pressure)


def secant(line, defect, x, pressure, steps, first, tolerance, most=12):
    """Roots x of defect(p, V) along (λa, q) = line(x), lane by lane; x, p, V, and where it converged."""

    def value(x, pressure):
        p, v = pressure_and_volume(*[w if k != 1 else pressure for k, w in enumerate(spread(line(x)))], steps)
        return defect(p, v), p, v

    def spread(pair):
        return pair[0], None, pair[1]

    x0, x1 = x, x + first
    pressure = pressure_and_volume(*[w if k != 1 else pressure for k, w in enumerate(spread(line(x)))], steps)[0]
    f0, p, _ = value(x0, pressure)
    good = np.isfinite(p)
    f1, p, v = value(x1, np.where(good, p, pressure))
    moved = np.full(x.shape, np.inf)
    for _ in range(most):
        with np.errstate(all="ignore"):
            step = -f1 * (x1 - x0) / (f1 - f0)
        # a secant between equal values says nothing: such a lane rests, done if its last step was short
        step = np.where(np.isfinite(step), step, 0)
        moved = np.where(step == 0, np.abs(x1 - x0), np.abs(step))
        moved = np.where(np.isfinite(f1), moved, np.inf)
        if not np.any(moved > tolerance):
            break
        x0, f0, x1 = x1, f1, x1 + step
        f1, p, v = value(x1, p)
    return x1, p, v, moved <= tolerance


def start(steps, dtype):
    """λa and p of the filling at zero voltage."""
    zero = np.zeros(1, dtype)
    at = np.array([1.958], dtype), np.array([1.887], dtype)
    apex, p, _, good = secant(lambda x: (x, zero), lambda p, v: v - FILLING, *at, steps, 1e-4, 1e-13)
    assert good.all()
    return apex[0], p[0]


def march(chamber):
    """λa (n,), and q, p, V (n, chambers) of the contour through the filling; NaN from where it ends."""
    first, filling_pressure = start(60, float)
    gas = Gas(chamber, filling_pressure)
    apexes = np.concatenate([[first], np.linspace(first, _LAST, 120)[1:]])
    q = np.zeros((len(apexes), len(chamber)))
    p, v = np.full_like(q, filling_pressure), np.full_like(q, FILLING)
    for n, apex in enumerate(apexes[1:], 1):
        back = min(n, 4)
        weights = extrapolation(apexes[n - back : n], apex)
        guess, p_guess = weights @ q[n - back : n], np.exp(weights @ np.log(p[n - back : n]))
        at = np.full(len(chamber), apex)
        q[n], p[n], v[n], good = secant(lambda x, at=at: (at, x), gas.defect, guess, p_guess, 60, 1e-6, 1e-9)
        q[n, ~good] = p[n, ~good] = v[n, ~good] = np.nan
    return apexes, q, p, v


def extrapolation(nodes, at):
    """Weights of Lagrange's polynomial through the nodes."""
    return np.array([np.prod([(at - b) / (a - b) for b in nodes if b != a]) for a in nodes])


def guesses(apexes, q, p):
    """(kind, λa, q, p) of one chamber's special points, by rising λa, up to breakdown, and the landing of its snap."""
    good = np.isfinite(q)
    end = len(q) if good.all() else int(np.argmin(good))
    apexes, q, p = apexes[:end], q[:end], p[:end]
    curve, pressure = (make_interp_spline(apexes, w, k=5) for w in (q, p))
    excess = make_interp_spline(apexes, q - breakdown_load(apexes), k=5)
    broken = next(iter(roots(excess, apexes)), apexes[-1])
    found = [("breakdown", broken)] if broken < apexes[-1] else []
    folds = [x for x in roots(curve.derivative(), apexes) if x < broken]
    found += [("fold", x) for x in folds]
    # the state of the start is one of them
    found += [("zero_voltage", x) for x in [apexes[0], *roots(curve, apexes[1:])] if x < broken]
    if folds:
        level = float(curve(folds[0]))
        beyond = [x for x in roots(make_interp_spline(apexes, q - level, k=5), apexes) if x > folds[0] + 1e-3]
        # the first crossing after the snap's fold on which q rises again
        found += [("landing", x) for x in beyond if curve(x, 1) > 0][:1]
    return [(kind, x, float(curve(x)), float(pressure(x))) for kind, x in sorted(found, key=lambda f: f[1])]


def roots(curve, x):
    """The roots of a spline between the first and last of x."""
    fine = np.linspace(x[0], x[-1], 40 * len(x))
    values = curve(fine)
    found = []
    for i in np.flatnonzero(values[:-1] * values[1:] < 0):
        low, high = fine[i], fine[i + 1]
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if curve(middle) * curve(low) > 0 else (low, middle)
        found.append(low)
    return found


def extreme(x, *fields):
    """The extreme of the polynomials through fields[0] (nodes, lanes) at nodes x (nodes,), and all fields there."""
    at = np.zeros(fields[0].shape[1], x.dtype)
    coefficients = [np.stack([c for c in newton_form(x, f)]) for f in fields]
    for _ in range(50):
        _, slope, bend = horner(x, coefficients[0], at)
        move = -slope / bend
        at = at + np.clip(move, -0.2, 0.2)
    return at, [horner(x, c, at)[0] for c in coefficients]


def newton_form(x, values):
    """Divided differences."""
    c = values.copy()
    for k in range(1, len(x)):
        c[k:] = (c[k:] - c[k - 1 : -1]) / (x[k:] - x[:-k])[:, None]
    return c


def horner(x, coefficients, at):
    """Value, first and second derivative of Newton's form."""
    value, slope, bend = coefficients[-1], np.zeros_like(at), np.zeros_like(at)
    for node, c in zip(x[-2::-1], coefficients[-2::-1], strict=True):
        bend = bend * (at - node) + 2 * slope
        slope = slope * (at - node) + value
        value = value * (at - node) + c
    return value, slope, bend


def refine_folds(line, defect, guess, apex, pressure, width, steps):
    """Extremes of x(λa) solving defect = 0 on (λa, q) = line(λa, x): λa, x, p, V.

    For a p–V fold x is the pressure itself: `line` is then None and q is `guess`.
    """
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES).astype(truth.EXTENDED)
    count = len(apex)
    at = (apex + width * nodes[:, None]).ravel()
    guess, pressure = np.tile(guess, _NODES), np.tile(pressure, _NODES)
    if line is None:
        x = p = pressure
        for _ in range(4):
            p, v = pressure_and_volume(at, p, guess, steps)
        x = p
    else:
        x, p, v, good = secant(lambda x: line(at, x), defect, guess, pressure, steps, 1e-6, 1e-16)
        if not good.all():
            bad = np.flatnonzero(~good)
            print(at[bad], x[bad], p[bad], v[bad])
            raise ArithmeticError(f"{(~good).sum()} nodes of folds did not converge")
    place, (x, p, v) = extreme(nodes, *(w.reshape(_NODES, count) for w in (x, p, v)))
    return apex + width * place, x, p, v


def solve(chambers, listed, steps, width):
    """All special points in extended precision: a row (λa, p, V, q) for each of `listed` (lane, kind, λa, q, p)."""
    lanes = np.array([row[0] for row in listed])
    kinds = np.array([row[1] for row in listed])
    guess = np.array([row[2:] for row in listed], truth.EXTENDED)
    _, filling_pressure = start(steps, truth.EXTENDED)
    gas = Gas(chambers.astype(truth.EXTENDED)[lanes], filling_pressure)
    out = np.full((len(listed), 4), np.nan, truth.EXTENDED)

    fold = np.flatnonzero(kinds == "fold")
    part = gas.take(np.tile(fold, _NODES))
    apex, q, p, v = refine_folds(
        lambda at, x: (at, x), part.defect, guess[fold, 1], guess[fold, 0], guess[fold, 2], width, steps
    )
    out[fold] = np.stack([apex, p, v, q], axis=1)

    # the load of the snap: of the first fold
    snap = np.zeros(len(chambers), truth.EXTENDED)
    for row, load in reversed(list(zip(fold, q, strict=True))):
        snap[lanes[row]] = load
    lines = {
        "zero_voltage": lambda x, own: np.zeros_like(x),
        "breakdown": lambda x, own: breakdown_load(x),
        "landing": lambda x, own: snap[lanes[own]],
    }
    for kind, load in lines.items():
        own = np.flatnonzero(kinds == kind)
        apex, p, v, good = secant(
            lambda x, load=load, own=own: (x, load(x, own)),
            gas.take(own).defect,
            guess[own, 0],
            guess[own, 2],
            steps,
            1e-5,
            1e-15,
        )
        if not good.all():
            raise ArithmeticError(f"{(~good).sum()} points of kind {kind} did not converge")
        out[own] = np.stack([apex, p, v, load(apex, own)], axis=1)
    return out


def pressure_folds(steps, width):
    """Rows (Φ, λa, p, V, q) of the peak and the valley of p–V curves."""
    rows = []
    for voltage, apex in itertools.product(VOLTAGES, (2.2631, 8.2682)):
        q = np.array([voltage**2], truth.EXTENDED)
        at = np.array([apex], truth.EXTENDED)
        for _ in range(6):  # the guess is of Φ = 0: centre the nodes on the extreme
            at, _, p, v = refine_folds(None, None, q, at, np.array([1.6], truth.EXTENDED), width, steps)
        rows.append([voltage, at[0], p[0], v[0], q[0]])
    return rows


def write(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(UNKNOWNS)
        writer.writerows(rows)


def digits(value):
    return np.format_float_positional(value, precision=16, unique=False, fractional=False, trim="-")


def uncertainty(once, twice, main):
    """Of a point: its voltage or pressure (column `main`), and its volume."""

    def measure(row):
        return np.sqrt(np.abs(row[3])) if main == 3 else row[main]

    return float(max(abs(measure(once) - measure(twice)), abs(once[2] / twice[2] - 1)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=140, help="of the coarser grid")
    parser.add_argument("--chambers", type=int, default=COUNT, help="how many, for a trial")
    parser.add_argument("--output", type=pathlib.Path, default=DATA)
    options = parser.parse_args()
    options.output.mkdir(exist_ok=True)
    report = harness.Progress()
    grids = ((options.steps, _WIDTH), (2 * options.steps, 0.6 * _WIDTH))

    once, twice = (pressure_folds(*grid) for grid in grids)
    rows = []
    for a, b in zip(once, twice, strict=True):
        kind = f"fold at voltage {a[0]:g}"
        rows.append(["", kind, *map(digits, b[1:]), f"{uncertainty(a[1:], b[1:], 1):.1e}"])
    write(options.output / "pressure_volume.csv", rows)
    report("p–V folds")

    chambers = np.geomspace(SMALLEST, LARGEST, options.chambers)
    apexes, q, p, _ = march(chambers)
    report("marched")
    listed = [(k, *found) for k in range(len(chambers)) for found in guesses(apexes, q[:, k], p[:, k])]
    once, twice = (solve(chambers, listed, *grid) for grid in grids)
    rows = []
    for (lane, kind, *_), a, b in zip(listed, once, twice, strict=True):
        rows.append([repr(float(chambers[lane])), kind, *map(digits, b), f"{uncertainty(a, b, 3):.1e}"])
    write(options.output / "chambers.csv", rows)
    worst = max(float(r[-1]) for r in rows)
    report(f"{len(rows)} points, largest uncertainty {worst:.1e}")
    return 0 if worst < 1e-12 else 1


if __name__ == "__main__":
    sys.exit(main())
