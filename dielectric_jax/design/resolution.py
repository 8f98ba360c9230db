"""The tuned numbers of designs: scans and climbs, Newton's method on the surface, regime maps, and calibration."""

__all__ = [
    "ACCURATE",
    "ACTIVE",
    "AT_END",
    "BELOW_ZERO",
    "BISECTIONS",
    "BLOCKS_OF_POINTS",
    "COARSE",
    "DENSE",
    "ENDLESS",
    "EVEN_IN_LOG",
    "EXACT_FIT",
    "FARTHEST_START",
    "FAR_ITERATIONS",
    "FAR_SETTLED",
    "FAR_STEPS",
    "FELT",
    "FEW_BISECTIONS",
    "FILM_TOLERANCE",
    "FLATTEST",
    "HUBER",
    "INDEPENDENT",
    "INWARD",
    "ISLAND",
    "ITERATIONS",
    "LANES",
    "LARGEST_STRAIN",
    "LEAST_LARGEST",
    "LEAST_VOLUME",
    "LONGEST_HEAD",
    "LOST_OBJECTIVE",
    "LOST_STRAIN",
    "MANY_EDGES",
    "MAP_PASSES",
    "MAP_POINTS",
    "MAP_POINTS_WITH_SURFACES",
    "MODEL_SIZES",
    "MODEL_STEPS",
    "MODULI",
    "MOST_BUILT",
    "MOST_FIT_STEPS",
    "MOST_LARGEST",
    "MOST_LOADS",
    "MOST_POINTS",
    "MOST_SAMPLES",
    "MOST_SECTIONS",
    "MOST_SOUGHT",
    "MOST_UNCERTAIN",
    "NEARLY_ACTIVE",
    "NODES",
    "NOISE_OF_VOLUME",
    "OBJECTIVE_SCAN",
    "OPTIMAL",
    "ROUNDS",
    "ROUNDS_OF_SCALE",
    "SAMPLES",
    "SEEDS",
    "SHORTEST_RUN",
    "STARTS",
    "STRAIN_SCAN",
    "TANGENT_REACH",
    "TURN",
    "TYPICAL_STRETCH",
    "VAGUE",
    "VISIBLE_MISFIT",
    "WIDE",
]

# ---- scans and climbs (`benchmarks/acceptance/design_problems.py`: no scan of 10⁵ designs is better, a climb takes 0.2 to 1.1 s)

#: designs along each parameter of the scan that begins a climb of the area strain, by the number of parameters; beyond, 7 each
STRAIN_SCAN = {1: (256,), 2: (24, 24), 3: (12, 12, 12)}
#: parameters that may be sought at once: the scan of more would take too many designs
MOST_SOUGHT = 6
#: regions of the scan from whose best designs a climb starts; the optimum of a lower one is not sought
SEEDS = 5
#: the same of `maximise`, by the number of parameters; beyond, 4 each
OBJECTIVE_SCAN = {1: 64, 2: 12, 3: 6}
#: designs of the scan of `maximise` from which a climb starts
STARTS = 4
#: a constraint this near to its limit holds with equality
ACTIVE = 1e-6
#: constraints this near to their limit are made to hold with equality in the end
NEARLY_ACTIVE = 1e-5
#: of a range: a parameter this near to an end of it is at the end
AT_END = 1e-9
#: of a range: the answer is checked this far from the edges, on which two regimes meet
INWARD = 1e-7
#: of the unknowns: the tangents of a known design are followed no farther
TANGENT_REACH = 0.2
#: minus log(1 + area strain), and the violation of every constraint, at a design whose ramp has another shape
LOST_STRAIN = 1e2
#: minus the objective of a design without one in `maximise`, in units of the largest of the scan
LOST_OBJECTIVE = 1e3
#: uncertain parameters whose corners are taken: 257 scenarios; more are refused
MOST_UNCERTAIN = 8
#: even samples of the box of uncertain parameters, where a quantile is asked for
SAMPLES = 32
#: surfaces of sections of families, or of one membrane under several breakdown laws, that are kept, those used last; 2 MB each
MOST_SECTIONS = 64
#: surfaces built for designs that are kept, those used last; 2 MB each
MOST_BUILT = 32
#: a stretch at which the breakdown laws of several designs are compared
TYPICAL_STRETCH = 5.0

# ---- Newton's method on the surface

#: points of the surface that one compiled call reads: few, and many
BLOCKS_OF_POINTS = 8, 32
#: iterations of Newton's method for designs
ITERATIONS = 14
#: designs of a block that share a compiled program where boundaries are located
LANES = 64
#: steps of the shots beyond the surface; their results differ by the coarser one's error
FAR_STEPS = 160.0, 320.0
#: iterations of Newton's method for p of those shots, and its last move as a share of p, whose square is left
FAR_ITERATIONS, FAR_SETTLED = 12, 1e-8

# ---- regime maps (400 × 400 designs with their curves take 28 s warm, `docs/benchmarks.md`)

#: designs along a parameter of a map
MAP_POINTS = 400
#: the same along a parameter each of whose values needs a surface of its own
MAP_POINTS_WITH_SURFACES = 25
#: designs along a parameter of a map; more are refused
MOST_POINTS = 10_000
#: grid cells between designs that are classified first; a regime narrower than that which touches no other change is missed
COARSE = 8
#: passes on into cells that turn out to hold a change, on each grid
MAP_PASSES = 12
#: designs: a patch no larger, all of it undecided by any engine, takes the regime about it
ISLAND = 6
#: grid cells that a boundary may lie beyond two designs of which the surface did not decide one
VAGUE = 3.0
#: halvings between two designs where no equations hold: the place is then known to 5e-7 of their distance
BISECTIONS = 20
#: the edges from which there are fewer halvings, for each classifies all of them, and how many
MANY_EDGES, FEW_BISECTIONS = 64, 7
#: a range of more decades is divided evenly in the logarithm
EVEN_IN_LOG = 1.2

# ---- the model of a measured curve

#: nodes of the table of states over log(λa − λ0), from which Newton's method for the measured volumes begins
NODES = 64
#: iterations of Newton's method for the measured volumes
ROUNDS = 15
#: steps of the explicit map, tried in this order; the first do, but far beyond the peak of unlimited materials
MODEL_STEPS = 24.0, 48.0, 96.0, 192.0
#: relative change of volumes and pressures under twice the steps, above which more steps are taken
ACCURATE = 1e-6
#: λa − λ0 below which the explicit map loses its digits
FLATTEST = 1e-8
#: the volume there, in A³: pressures below are none that a gauge could read
LEAST_VOLUME = 5e-4
#: numbers of volumes for which programs are compiled; the pressures of more points are interpolated between the last
MODEL_SIZES = 32, 64, 128, 256
#: voltages of a measurement for which the table of states is computed; more are put into so many bins, evenly in Φ²
MOST_LOADS = 9
#: points of the drawn curve, evenly in the volume, and as many evenly in its logarithm
DENSE = 64
#: the factor up to which a starting value is raised so that the largest volume is reached
FARTHEST_START = 2.0**14

# ---- calibration (`tests/design/test_calibration.py`: the 95 % intervals of 200 noisy curves hold the constants in 90 % or more)

#: evaluations of one least-squares fit
MOST_FIT_STEPS = 200
#: fits with a robust loss, each at the scale of the residuals of the one before
ROUNDS_OF_SCALE = 12
#: Huber's constant, in units of the noise: 95 % as efficient as least squares where the noise is normal
HUBER = 1.345
#: Pa, the shear moduli of gels to hard rubbers; others are doubted in words
MODULI = 1e2, 1e9
#: A³, the largest measured volume is between; at the least the film is deflected by 1 % of its radius
LEAST_LARGEST, MOST_LARGEST = 0.02, 1e5
#: least singular value of the Jacobian's scaled columns over the largest: below, constants can change together
INDEPENDENT = 1e-7
#: change of the pressures by a constant over the pressures: below, the curve does not depend on it
FELT = 1e-9
#: cosine between the residuals and what a constant can change: above, the fit has stopped early
OPTIMAL = 1e-3
#: residuals over pressures: below they are rounding
EXACT_FIT = 1e-7
#: an interval's upper end over its lower one: said in a warning, and refused
WIDE, ENDLESS = 10.0, 1e6
#: misfit over the range of pressures: a smaller one is not mentioned
VISIBLE_MISFIT = 2e-3

#: of the integration of films in time: residuals and their derivatives are then exact to 1e-6 of the stresses
FILM_TOLERANCE = 1e-8
#: samples of one test of a film that are fitted; of more, so many are taken
MOST_SAMPLES = 256

# ---- measurements

#: of the largest volume: smaller reversals are noise of the volume
TURN = 0.1
#: points that a run has at least on average, where the points are in the order of time
SHORTEST_RUN = 4
#: of the largest pressure: pressures down to minus that are noise
BELOW_ZERO = 0.25
#: of the largest volume: volumes down to minus that are noise about the flat membrane
NOISE_OF_VOLUME = 0.01
#: engineering strains beyond which no rubber goes: they are in per cent
LARGEST_STRAIN = 20.0
#: letters of a head of a column; longer lines are prose
LONGEST_HEAD = 200
