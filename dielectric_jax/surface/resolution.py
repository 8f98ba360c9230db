"""The tuned numbers of this package: nodes and cuts of the elements, their error bounds, and the rows."""

# --- elements ---

# Chebyshev nodes of an element along λa, t and the share s of the prestretch
NODES = (16, 20, 16)
# rounds of cutting at most; what is not resolved then is left out of the domain
ROUNDS = 7
# rounds in which a box across the edge of the states is cut; each more doubles the cost of an Ogden film (1.8 and 3 to 6)
EDGE_ROUNDS = 3
# rounds in which a box is cut that no step count resolves; each more costs four times the last (Mooney–Rivlin, λ0 = 3.5)
STIFF_ROUNDS = 4
# steps of a shot beyond which a smooth element that is still in error is cut instead
MOST_SHOT_STEPS = 160
# fresh states at which the error of an element of (λa, t) is measured (benchmarks/acceptance/surface_error.py)
FRESH = 12
# fresh states at which the error of an element of a family is measured (benchmarks/acceptance/surface_error.py --family)
FAMILY_FRESH = 48
# steps of the explicit map whose pressures only start the first shots
MAP_STEPS = 28.0
# where the stretch is cut to begin with, as shares of the window
COLUMNS = (0.0, 0.04, 0.12, 0.25, 0.4, 0.55, 0.7, 0.82, 0.91, 0.965, 1.0)
# where the load fraction is cut to begin with
LOAD_MARKS = (-0.3, 0.2, 0.55, 0.78)
# where s is cut to begin with: towards s = 1 the states change fastest
SHARE_MARKS = (0.5, 0.8)
# widening of the domain in s, so that rounding of s does not leave its edges
SHARE_MARGIN = 1e-9
# where the apex series of a family's trajectories hands over: its error in λ2 weighs most at small shares
TRAJECTORY_START = 1e-4

# --- surfaces and families ---

# least load fraction of the domain; states below it are left to shots
BOTTOM = -0.75
# load at the top of the domain, in units of that of breakdown at the apex
ABOVE_BREAKDOWN = 1.3
# error bound over the largest error at fresh states of an element; the true error was 1.4 times it at most (docs/benchmarks.md)
BOUND_FACTOR = 4.0
# least error bound: about the difference of independent methods (benchmarks/acceptance/surface_error.py)
LEAST_BOUND = 3e-12
# tolerances that a surface or family may be built to; below, rounding of the shots decides
TOLERANCES = (1e-11, 1e-3)
# edges and elements of a surface, and of a family, come in multiples of it, so that most share compiled programs
BLOCK, FAMILY_BLOCK = 128, 32
# points of a family that are evaluated together; the polynomials of one take 200 kB
FAMILY_LANES = 32

# --- rows (benchmarks/speed/sweep.py) ---

# rows of λa, even in y = √((λa − λ0)/(λ_end − λ0))
ROWS = 256
# y of the first row
LOWEST_ROW = 0.003
# where the loads of a row are cut into panels, as shares
ROW_PANELS = (0.0, 0.4, 0.7, 0.9, 1.0)
# terms of a polynomial on a panel; what is left of them is `Rows.error`
ROW_TERMS = 16
# brackets of a panel in which a crossing is looked for; two crossings in one bracket are not seen
ROW_BRACKETS = 6
# Newton steps from the secant of a bracket; a crossing whose last step exceeds 1e-7 is not reported
ROW_NEWTON = 3
# rows that are evaluated together
ROW_LANES = 32
# load at which a row ends, in units of that of breakdown at the apex; below `ABOVE_BREAKDOWN`, inside the domain
ROW_ABOVE_BREAKDOWN = 1.2
