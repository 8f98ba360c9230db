"""The tuned numbers of this package: grids, tolerances, sizes of compiled programs, and limits of what is modelled."""

import numpy as np

# --- materials and membranes ---

# limits J and chain links n whose window double precision resolves; above, the material is neo-Hookean to rounding
LEAST_LIMIT, LARGEST_LIMIT = 1e-6, 1e15
# ρ, the share of their full length to which chains are stretched at the end of an eight-chain material's window
LOCKED_CHAIN = 0.995
# apex stretch, in units of the prestretch, at which the window of a material without limit ends
UNLIMITED_STRETCH = 12.0
# terms of Ogden's energy that are summed one by one, which runs fastest; with more the compile time would grow
UNROLLED_TERMS = 6
# terms of Ogden's energy at most: a check of what a user gives
MOST_TERMS = 100
# largest exponent of Ogden's energy, and the inverse of the least: beyond, powers overflow in the window
LARGEST_EXPONENT = 1e3
# stretches below it are outside the states of a membrane in tension; powers of Ogden and Mooney–Rivlin are cut there
LEAST_STRETCH = 1e-2
# small-strain moduli (and permittivities) that count as about one in their unit; others are refused
MODULI = (0.1, 10.0)
# relative difference of W(λ1, λ2) and W(λ2, λ1) beyond which a user's energy is refused as not symmetric
ASYMMETRY = 1e-9
# slope of W at λ1 = λ2 = 1, relative to the modulus, beyond which a user's energy is refused as not stationary
STATIONARY = 1e-6
# (λ1, λ2) at which symmetry is checked, as shares of the largest stretch; three more than a wrong energy fits by chance
CHECKED_SHARES = np.array([[0.0, 0.0], [0.02, 0.1], [0.1, 0.3], [0.3, 0.02], [0.5, 0.2], [0.8, 0.4], [0.05, 0.9]])
# largest prestretch, far above any in use; p λ0³ of a film without limit is still resolved there
LARGEST_PRESTRETCH = 1e4
# pressure 2s/λ² of a balloon at which the default window ends; a Gent film at lock-up reaches 124 at most
STIFF_PRESSURE = 100.0
# (λ − 1) s'/s at which the default window ends; a Gent film at lock-up reaches 201
STIFF_SLOPE = 210.0
# stretches at which these two are looked at in one round of four; a violation between two of them is not seen
STIFFENING_NODES = 512

# --- shots ---

# scales of (λa, p, q) in which arclength, distances and Newton's moves are measured
SCALE = np.array([1.0, 0.2, 0.02])
# R, in units of A = min(R_c, 1), at which the apex series hands over; the error of the series is its fourth power
SERIES_RADIUS = 4e-4
# w of the graded grid; measured: 32 steps of Dopri8 leave 8e-11 for t < 0.5, 48 leave 3e-12 (benchmarks/speed/shots.py)
GRID_WIDTH = 0.12
# steps of a shot on the graded grid at most; what they do not resolve is left to adaptive steps
MOST_STEPS = 320
# adaptive steps at most; a shot that needs more is NaN
MOST_ADAPTIVE_STEPS = 2048
# rates of an integration up to which each is written by itself; XLA would compute them all in one loop without vectors
FEW_RATES = 6
# lanes of one call of a program of shots; one compiled program serves every number of points
CHUNK = 32
# steps of a trail that are searched together for extremes; only as many blocks as there are steps
TRAIL_BLOCK = 32
# steps of Newton on the quintic between steps, from the node, towards an extreme whose place one step of the solver corrects
LEAST_NEWTON = 5
# kinds of membranes whose compiling ahead is remembered
MOST_KINDS = 16

# --- corrector ---

# steps of Newton's grids, then of the residual's, by difficulty: easy; an inner layer near lock-up at a high load, thick; thin
# or a cone
GRIDS = (((12.0, 32.0), (44.0, 88.0, 176.0)), ((24.0, 64.0), (96.0, 192.0, 320.0)), ((80.0, 80.0), (160.0, 320.0)))
# the same of batches: steps of Newton and of the residual, in the order in which they are tried, Newton each time anew.
# Measured by benchmarks.speed.lane_profile and benchmarks.speed.batch_diagrams
GRIDS_ANEW = (
    ((12.0, 36.0), (24.0, 80.0), (48.0, 128.0)),
    ((24.0, 64.0), (64.0, 160.0), (160.0, 320.0)),
    ((80.0, 200.0), (160.0, 320.0)),
)
# steps of Newton in one call, and at folds, at most
NEWTON_ROUNDS = 2, 3
# calls on one grid, while Newton goes on
TURNS = 6
# largest move of one step of Newton, in scaled unknowns
LARGEST_MOVE = 0.5
# last move of Newton whose remainder a chord step on the finer grid removes
SETTLED = 3e-4
# last move of Newton by λa − λ0 and by p, where a single state has converged, by difficulty: what is left of it counts as an
# error of the grid; benchmarks/acceptance/hard_cases.py and agreement.py
SETTLED_SHARES = (1e-4, 1e-4, 1e-6)
# the largest last move at folds, where the secant converges more slowly
SETTLED_FOLD = 1e-4
# distance of points whose tangents show how fast q turns
TANGENTS_APART = 1e-5
# a tangent's error by that of the residual on the same grid
TANGENT_ERROR = 10
# relative error of V that comes of not knowing where on its branch an event lies
MOST_SPREAD = 1e-4
# times the tolerance: in a batch an error that no grid reduces, as beside a fold, is reported as it is
WORSE = 100
# so many lanes cost less in several small calls than in a large one
SPLIT = 96
# stretches of one call
STRETCHES_TOGETHER = 1024
# share of the lock-up stretch beyond which a high load forms an inner layer
LAYER_STRETCH = 0.72
# load fractions above which that layer needs the second and the third sequence of `GRIDS`
LAYER_LOADS = (0.7, 0.86)
# load fraction above which any other state is near the cone and needs the third sequence
CONE_LOAD = 0.93
# steps of a refined tangent, by difficulty
REFINED = (48.0, 144.0, 240.0)
# component of the tangent along the control below which a tangent is refined: the index turns on its sign
NEAR_FOLD = 1e-3
# share of a chord step that the next one would move, by difficulty: the error of Newton's Jacobian, measured
CONTRACTION = (2e-4, 3e-3, 1e-3)
# exponents of the tolerances of adaptive steps, tried in this order after the finest grid
ADAPTIVE = (10.0, 12.0, 13.0)
# error estimate on the finest grid beyond which adaptive steps are not tried
HOPELESS = 1e-3
# change from n/2 to n steps over the reported error: of order eight, 256 is expected; benchmarks/acceptance/error_honesty.py
SAFETY = 16.0
# error estimates are never below it
LEAST_ESTIMATE = 1e-13
# rounding error of a shot, relative to λa − λ0, p and V; measured (benchmarks/acceptance/error_honesty.py covers it)
ROUNDING = 5e-15
# rounding of the stretch itself, relative to λa and to √(1 − t): about one unit in the last place; hard_cases.py, case 10
FEW_ULPS = 2e-16

# --- chart and scan ---

# load fraction up to which the scan covers the chart; `complete` speaks of it (benchmarks/acceptance/agreement.py)
SCANNED_LOAD = 0.9
# ξ, in units of the smaller of 1 and its inner layer, at which the series of the explicit map hands over
MAP_START = 1e-3
# nodes of the scan along the stretch; along the load between `LOAD_PANELS`; along the stretch on the last of these panels
SCAN_NODES = (110, (16, 12, 16), 150)
# load fractions that part the panels of the scan
LOAD_PANELS = (0.45, 0.75)
# points of the interpolated grid per node of the scan, along each axis
REFINEMENT = 4
# steps of the explicit map in the scan: in general, where they leave 1e-6, and on the upper half of the stretch, which is stiffer
SCAN_STEPS = (28.0, 128.0)
# weight and width, as a share of the stretch, of the crowding of nodes about the cliff of p near lock-up
CLIFF = (6.0, 0.006)
# least −d log p/d share of a cliff: a gentler fall is sampled by nodes that stay
CLIFF_SLOPE = 20.0
# largest distance of the cliff's places from a smooth path: beyond it the place jumps, and nodes stay
CLIFF_STRAY = 0.02
# points of one call of the explicit map
MAP_CHUNK = 640
# scans of membranes that are kept in memory
MOST_SCANS = 16

# --- stability ---

# steps of the two shots of a state; an index on which they differ is not given (benchmarks/acceptance/stability.py)
STABILITY_GRIDS = (160.0, 320.0)
# times the change between these grids below which a determinant has no sign (benchmarks/acceptance/stability.py)
GRID_DOUBT = 20.0
# times the error of the state, relative to the terms of a determinant, below which that has no sign
STATE_DOUBT = 100.0
# largest defect at the rim of a state that counts as an equilibrium, relative to λa, or to p or q in these
EQUILIBRIUM = 1e-5
# each branch adds its own equations to every compiled program in time
MOST_BRANCHES = 8
# steps of a homogeneous film between events; at a tolerance of 1e-12 a creep to its pull-in takes about a thousand
MOST_FILM_STEPS = 16384

# --- films in SI ---

# a breakdown field is above this number of V/m (films fail at 1e7 to 1e9), and below it in units of √(μ/ε) (0.1 to 100)
LARGEST_FIELD = 1e4
# small-strain moduli [Pa] of films that may be VHB: a factor of four around the article's two fits of 45 and 68 kPa
VHB_MODULI = (10e3, 250e3)
# and their relative permittivities: a third around the article's 4.7
VHB_PERMITTIVITIES = (3.0, 6.2)

# --- documents ---

# values of a list in a document or an axis: each is held in memory, some of them for every scene at once; more are refused
MOST_VALUES = 10**7
