"""Numbers that were tuned: how finely branches, special points and ramps are resolved, and where answers become doubtful.

Each is used by one engine; the heading of a group names the benchmarks that measured or check its numbers.
"""

import numpy as np

from ..model import SCANNED_LOAD
from ..numerics import Steps

# Continuation of branches. Checked by benchmarks.acceptance.agreement (every branch of random scenes is found) and
# benchmarks.acceptance.hard_cases (towards the cone and lock-up).

# the step control of a trace: towards lock-up the rim condition is a wall: a small step of Newton may begin far beyond it
TRACE_CONTROL = Steps(
    first=0.05, largest=1.0, smallest=2e-5, most_turn=0.35, most_correction=0.2, tolerance=1e-4, most_residual=0.1
)
TRACE_STEPS = (10.0, 24.0, 48.0, 160.0)  # steps of the grids of the continuation; the last is the last resort
# load fractions up to which each grid is used, near lock-up (an inner layer forms) and elsewhere
TRACE_LOAD_LIMITS = ((0.7, 0.85), (0.82, 0.97), (2.0, 2.0), (2.0, 2.0))
LARGEST_LOAD_NEAR_LOCK_UP = 0.94  # load fraction beyond which no grid resolves the membrane near lock-up
FLAT_END = 0.01  # of λa − λ0: nearer to the flat state the smallest step is a hundredth of what it is elsewhere
LARGEST_RESTART = 0.1  # how far a finer grid may move a point of a coarser one
MOST_PARTS = 12  # of a trace, each as long as a compiled trace can be
NEAR_ON_SCAN = 0.2  # on the chart, in tenths of its extent: on one branch as the scan shows it
SAME_ON_SCAN = 0.03  # on the chart, in tenths of its extent: the same point
LARGEST_STEPS = (1.0, 0.2, 0.05)  # along a branch, in the rounds in which branches are looked for
CONTOUR_STRIDE = 3  # every third vertex of a contour is close enough to its neighbours
SCAN_MARGIN = 0.02  # of the scanned loads: what lies there may be an error of interpolation
COSTLY_LOAD = 0.6  # load fraction near lock-up from which continuation takes most of its time
MOST_TURN = 0.3  # of the tangent between neighbours, in radians
CONE_WEIGHT = 0.7  # of the change of log(1 − t) beside the distance, where mesh points are placed
THIN_LAYER_LOAD = 0.7  # load fraction from which an inner layer forms near lock-up
MOST_APPROACH = 0.15  # change of log(1 − t) between neighbours; folds near the cone are about 1.2 apart
ASTRAY = 0.1  # in scaled unknowns: a corrected point farther off lies on another branch
WIDEST_HOLE = 4  # mesh points lost in a row
LOST_LOAD = SCANNED_LOAD - 0.01  # a branch that ends below this load, inside its window, is looked for once more
MESH_POINTS = 256  # of a branch, at least: special points are sought between them
NEAR_TURN = 0.05  # of the larger end slope: a slope this small between two of one sign may hide a pair of turns

# Special points and states. Checked by benchmarks.acceptance.error_honesty (true error below the estimate) and
# benchmarks.acceptance.hard_cases (pairs of states and folds between nodes).
ROOT_ROUNDS = 16  # trials of a root of a test function
# change of the share of an interval at which the line through the last two trials takes a root the rest of the way
ROOT_CLOSE = 1e-6
ROOT_EXACT = 1e-10  # change of the share at which nothing is left to do
ROOT_SMALL = 2e-7  # change of the share at which the slopes of the neighbours do as well as a last trial
MOST_STATE_ERROR = 1e-3  # the loosest tolerance: what is farther off is no state
FLATTEST = 4e-11  # of λa − λ0, and of λ0 − 1: below it rounding leaves no digits of the tension
WRINKLED = 1e-9  # least hoop compression: where it begins its sign is not reported
NEAREST_CONE = 3e-4  # 1 − t up to which states are sought; folds towards the cone are a factor of 3.6 apart
NEAR_EXTREME = 1e-6  # of log p or log V: nearer to an extreme of a line the two states beside it have their own solve
MOST_JUMPS = 50  # of a ramp
SAME_STRETCH = 1e-3  # of the apex stretch: beside a fold it is the less exact

# Batches by continuation. Sizes are measured by benchmarks.speed.batch_diagrams and lane_profile, limits checked by
# benchmarks.acceptance.ensemble and benchmarks.acceptance.one_answer.

# the step control of a march
MARCH_CONTROL = Steps(
    first=0.2,
    largest=2.0,
    smallest=2e-5,
    most_turn=0.5,
    most_correction=0.2,
    tolerance=1e-4,
    most_residual=0.1,
    cubic=True,
)
BATCH_BLOCK = 512  # scenes that are held together
START_LINE = 40  # stretches of the line of states at zero voltage
BATCH_TRACE_STEPS = (7.0, 24.0)  # steps of the grids of a march
BATCH_LOAD_LIMITS = ((0.7, 0.85), (0.82, 0.97))  # load fractions up to which each is used, near lock-up and elsewhere
# smallest and largest step of a march, and how far its first point may be from the start
BATCH_LENGTHS = np.array([2e-5, 2.0, 1.0])
BATCH_MOST_POINTS = 120  # of a march
SAME_LANDING = 0.02  # of λa: a landing on the line and one that the scan shows
PASSES = 4  # steps of a march in one call
LOOKS = 5  # rounds in which lines are searched for hidden events
# of the smaller end slope: a dip of the slope that stays above it hides nothing; with 0.2 a pair of folds of an eight-chain film
# was missed in benchmarks.acceptance.one_answer
CLEAR_DIP = 0.5
LONG_INTERVAL = 0.3  # in scaled unknowns: in a shorter one the interpolant shows a pair of folds, or a slope near zero
EVENT_REACH = 0.6  # of the chord of its interval: how far an event may lie from where the interpolant shows it
AMBIGUOUS_ON_LINES = 1e-6  # of the breakdown load: a landing nearer to it is not decided
DENSE_POINTS = 6, 16, 200  # points on an interval of a line: closer where cells are left, as rows crowd towards lock-up
SCENES_TOGETHER = 32  # scenes whose scans are compared together, in the cache
OTHER_BRANCH_STRIDE = 3  # every third node of the scan is enough to see another branch

# What lies beyond breakdown, read from the scan. Checked by benchmarks.acceptance.one_answer.
SCAN_STRIDE = 2  # every second row of the scan is enough for contours
SCAN_NODES = 4  # of the polynomial along the load
SCAN_NOISE = 1e-5  # of the pressure: what the interpolated scan leaves unclear, at least
NOISE_BAND = 12  # rows whose error is measured together
NOISE_SAMPLES = 6  # states a panel at which it is measured
NOISE_SAFETY = 3.0  # factor of the measured error
ABOUT_BREAKDOWN = 0.02  # of the breakdown load: a landing nearer to it is settled by an exact state
LANES_TOGETHER = 64  # lanes that are compared together, in the cache
LANDING_TOLERANCE = 1e-9  # error estimate of an exact landing
EXACT_MAP_STEPS = 128.0  # of the explicit map, right to 1e-8
LANDING_REACH = 0.3  # in scaled unknowns, from where the scan shows a landing to the exact one
LEAP = 0.12  # of t between rows: farther apart two crossings are not on one contour
CHORDS = 3  # most chord steps to a crossing
ENOUGH_CHORDS = 1e-6  # a last step, in t, beyond which the next changes nothing that matters
SETTLED_CROSSING = 1e-4  # the last of them, in t
FALL = 1e-4  # of a load: a maximum by which it falls again is a fold
LOAD_PER_NOISE = 10.0  # relative error of the load by that of the pressure
CLOSE_ROWS = 1e-3  # of the stretch: nearer places show no slope
SLOW_RISE = 0.02  # of q/λa: a slope dq/dλa below it may hide two folds
TURNING = 0.2  # of the rise before: a contour that leaves the window more slowly may turn outside

# Diagrams and ramps on a surface. Errors are checked by benchmarks.acceptance.surface_error and one_answer, sizes
# measured by benchmarks.speed.sweep_throughput.
SURFACE_NEWTON = 8  # steps of Newton on the surface
SURFACE_MOVE = 0.3  # largest of them, in λa and t
SURFACE_CONVERGED = 1e-9  # size of the last move, in λa and t
CONTOUR_GRID = (320, 176)  # stretches and loads on which contours are drawn
CONTOUR_VERTICES = 200  # of a contour, at most
AT_EDGE = 1e-3  # of the surface's extent: a contour that ends nearer leaves it
SAME_ON_SURFACE = 0.1  # in scaled unknowns: a traced chord's distance from the branch, and more
LOADINGS_TOGETHER = 256  # loadings of one call
FEW_LOADINGS = 8  # loadings of one call where a single one is asked for
CORRECTED_FROM = 1e-9  # error from which on the events of a ramp are corrected on the surface itself
LARGEST_RAMP_ERROR = 1e-8  # of a ramp that is decided
FLAT_MAXIMUM = 1e-8  # of a pressure: nearer to its maximum no start is decided
CORRECTED_TOGETHER = 8  # ramps that are corrected together
MOST_ROW_ERROR = 1e-4  # between rows, of a ramp that is decided or corrected
AMBIGUOUS_ON_ROWS = 1e-8  # of the breakdown load: a snap or landing nearer to it is not decided
SOON = 20  # rows within which a rising branch may be back at a load
STENCIL = 14  # rows that a polynomial runs through; the error is what all but the outer two would change
EVENT_NEWTON = 6  # steps of Newton on that polynomial towards an event
BEND_NEWTON = 8  # steps of Newton on it towards the least slope between two rows
CLOSE_NEWTON = 2  # steps of Newton on the surface from an event between rows, which is right to MOST_ROW_ERROR
DIPS = 3  # of a slope between rows in which a fold may hide, at most
ALIKE_FOLDS = 1e-6  # two folds whose loads differ by less than this share are not told apart
STRETCH_WEIGHT = 0.2  # of the relative error of λa − λ0 at a fold beside that of its load
NEARLY_BROKEN = 0.9  # of q/q_b on the row after the last, by the two before
STILL = 1e-8  # of a slope, in the scale of q: what the surface's error may hide
MERGING_FOLDS = 2e-3  # a slope of q between rows below this share of the largest may hide two folds
MOST_PRESSURE_POINTS = 8  # folds, and places of breakdown, of a pressure–volume curve
GLANCE_NEWTON = 4  # steps of Newton from the spline's guess
GLANCE_REACH = 0.05  # of λa: how far Newton's method may go from the spline's guess

# ---- neutral modes
# points of a branch at which the lowest eigenvalues of modes are taken
MODE_SAMPLES = 41
# how near to zero, of its change over two samples, an eigenvalue that turns back is looked at on the whole mesh; a parabola that
# three samples bound goes on by at most an eighth
NEAR_NEUTRAL = 0.5
