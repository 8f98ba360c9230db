"""The tuned numbers of this package: the sizes of the basis, and when a spectrum counts as converged."""

# functions of each component, few to many; the first that is right to the tolerance is taken: benchmarks/acceptance/modes.py
SIZES = (14, 18, 26, 40, 64)
# Gauss points of each size: few values, as each is a program to compile
GAUSS_POINTS = (21, 21, 67, 67, 67)
# the length of the coordinate, of the radius of curvature of the apex; with 1 the median error of 14 functions is 4e-9, with 3 4e-11,
# with 8 1e-10: benchmarks/acceptance/modes.py
APEX_RADII = 3.0
# steps of the shot that gives the state along the radius; finer grids change the eigenvalues by less than 1e-9
PROFILE_STEPS = (48.0, 96.0, 160.0, 240.0, 240.0)
# the last functions of each component, and twice as many, whose shares of an eigenvalue give its error estimate: the true error was
# at most 0.33 of it; benchmarks/acceptance/modes.py
DROPPED = 2
# states of one call of the compiled programs, for each of the sizes: one, where most spectra end, and as many as a cache holds
STATES_TOGETHER = ((1, 16), (16,), (4,), (4,), (4,))
# numbers of one parity in one call: of a neutral point, and of a spectrum
NUMBERS_TOGETHER = (1, 7)
# how many modes of a number the compiled programs give: few, or as many as may be asked for
COUNTS = (3, 12)
# (λ1 − λ2)/(λ1 + λ2) below which (w1 − w2)/(λ1 − λ2) is the mean of a derivative, and the nodes of that mean
NEAR_EQUAL, MEAN_NODES = 0.05, 6
# rounding of an eigenvalue, and the share of a state's own error, in units of the first eigenvalue beyond those asked for
ROUNDING, STATE_ERROR = 1e-13, 10.0
# a radius that stands for the apex, where the equations are singular
NEAR_APEX = 1e-12
# how far from the rim condition a state may be, of λa
EQUILIBRIUM = 1e-5
# largest circumferential number
LARGEST_NUMBER = 400
# points along the radius of a shape, and at which the least hoop stress is looked for
SHAPE_POINTS, HOOP_POINTS = 201, 257
# the error of an eigenvalue whose sign is decided, of its value; and the error, of max(|Λ|, 1), where a root is sought
SIGN_SHARE, NEUTRAL_TOLERANCE = 0.1, 1e-8
# where the certificate starts, as its error there falls like R², and its steps in ln R: 1e-12 in the neutral loads of the reference
JACOBI_START, JACOBI_STEPS = 1e-6, 800
