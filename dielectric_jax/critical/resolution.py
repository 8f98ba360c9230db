"""The tuned numbers of critical points: grids of shots and lines, steps along curves, and tolerances."""

import numpy as np

from ..model import SCANNED_LOAD
from ..numerics import Steps

__all__ = [
    "AGREED",
    "CLIMB_GRIDS",
    "CLIMB_STEPS",
    "CURVE_STEPS",
    "DRAWN",
    "EXPLICIT_STEPS",
    "FINE",
    "GRIDS",
    "HIDDEN_FOLDS",
    "LARGEST_LOAD",
    "LEAP",
    "LEAST_ERROR",
    "LEAST_ERROR_ON_CURVE",
    "LINE_LOAD",
    "LOG_FROM",
    "MANY",
    "MOST_LINES",
    "NODES",
    "ON_LEVEL",
    "OVER_CORNER",
    "PRESTRETCH_SPACING",
    "ROOT",
    "SAFETY",
    "SAME_POINT",
    "SETTLED",
    "STEPS",
    "TOLERANCE",
]

# ---- shots

#: steps of shots for Newton and for its last move, whose size is the coarser grid's error; by the difficulty of the state
GRIDS = ((48.0, 96.0), (144.0, 240.0), (240.0, 320.0))
#: steps of shots for derivatives, by the difficulty of the state
STEPS = np.array([coarse for coarse, _ in GRIDS])
#: of states and fillings that a search begins from, as the diagrams' default
TOLERANCE = 1e-9
#: what the last move is divided by to estimate the error, at most; an eighth-order method promises 255 for twice the steps, 9 for 240 and 320
SAFETY = 16.0
#: no error of a point on a line is reported below it: rounding
LEAST_ERROR = 1e-13
#: no error of a point of a curve in two parameters is reported below it: rounding, and that of its tangent
LEAST_ERROR_ON_CURVE = 1e-12

# ---- the first fold of a ramp

#: steps of the climb to the first fold, in scaled unknowns; a fold is bracketed by one step, then corrected on `GRIDS`
CLIMB_STEPS = Steps(
    first=0.05,
    largest=0.6,
    smallest=2e-5,
    most_turn=0.35,
    most_correction=0.2,
    tolerance=1e-4,
    most_residual=0.1,
    cubic=True,
)
#: steps of shots, tried in this order, and the t up to which each serves near lock-up and elsewhere (`docs/benchmarks.md`: 5 or 6 cost more)
CLIMB_GRIDS = (7.0, (0.7, 0.85)), (24.0, (0.82, 0.97)), (48.0, (2.0, 2.0))
#: of the larger slope of q: an interval on which q rises more slowly may hide a pair of folds, which the diagram decides
HIDDEN_FOLDS = 0.02
#: scenes from which they are searched as a batch; fewer one after another
MANY = 8

# ---- lines at one load

#: nodes of a line over λa; features narrower than a few of them are missed
NODES = 200
#: steps of the explicit map on a line; what it misses is left to Newton's method on shots
EXPLICIT_STEPS = 96.0
#: of t: a line ends there, for further on folds crowd towards the cone
LINE_LOAD = 0.95
#: points between two nodes at which a line's functions are looked at for changes of sign
FINE = 12
#: between the prestretches on which the cusp of the pressure is sought, as long as they are 5 to 25
PRESTRETCH_SPACING = 0.125
#: lines that are kept, those used last, for chambers share them
MOST_LINES = 512

# ---- curves in two parameters (`benchmarks/acceptance/fold_curves.py`: about 50 points a curve)

#: steps along a curve, in scaled unknowns; its tolerance leaves so little to Newton that the finer grid shows the coarser one's error
CURVE_STEPS = Steps(
    first=0.02, largest=0.3, smallest=1e-5, most_turn=0.25, most_correction=0.1, tolerance=1e-10, most_points=2000
)
#: of the step over a corner of a curve of breakdown, where its law has a kink
OVER_CORNER = 4e-5
#: Newton's last moves on the coarser grid and on the finer, in scaled unknowns; above the latter a finer pair is taken
SETTLED, AGREED = 1e-6, 1e-7
#: of λa of the filling from one point to the next: a larger change means the filling of another branch
LEAP = 0.05
#: a point this near to a level is on it, in scaled unknowns
ON_LEVEL = 1e-9
#: tolerance of Brent's method between two points of a curve, as a share of the way
ROOT = 1e-12
#: of t: a curve ends there, for beyond folds crowd towards the cone without end; the edge of the scan
LARGEST_LOAD = SCANNED_LOAD
#: the ratio of a parameter's bounds from which it is followed in its logarithm
LOG_FROM = 4.0
#: a crossing of a curve and a fold of a diagram nearer than this are one point, in scaled unknowns
SAME_POINT = 1e-5
#: points of a drawn line between two of a curve
DRAWN = 8
