"""The tuned numbers of this package: the elements of the spectrum, and when it counts as converged."""

# elements along the radius and their degree, coarse to fine; two that agree give the spectrum and its error. The first pair is
# right to 1e-8 for most states up to t = 0.9: benchmarks/acceptance/modes.py
ELEMENTS = ((1, 16), (1, 22), (2, 18), (4, 16), (8, 16))
# Gauss points of an element beyond its degree
MORE_POINTS = 2
# steps of the shot that gives the state along the radius; finer grids change the eigenvalues by less than 1e-9
PROFILE_STEPS = (48.0, 48.0, 96.0, 160.0, 240.0)
# states of one call of the compiled program
STATES_TOGETHER = (1, 16)
# numbers of one call
NUMBERS_TOGETHER = 8
# how many modes of a number the compiled programs give: few, or as many as may be asked for
COUNTS = (4, 12)
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
# points along the radius of a shape
SHAPE_POINTS = 201
# agreement of two meshes, |difference|/max(|Λ|, 1), where only the number of negative eigenvalues matters, and where a root is sought
SIGN_TOLERANCE, NEUTRAL_TOLERANCE = 0.05, 1e-8
