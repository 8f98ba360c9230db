"""The tuned numbers of this package: limits of memory, of compiled shapes, and of Newton's method in a continuation."""

# largest size of a number that a user gives: squares and products of several must not overflow
LARGEST = 1e50

# bits of the widest vectors that XLA may use on the CPU: all that the processor has; its default is half of them on many
VECTOR_WIDTH = 512
# whether XLA compiles for the CPU by its fusion emitters: with them a program takes 1.5 times as long to compile and twice the
# memory maps, and most run no faster; benchmarks/speed/first_diagram.py
FUSION_EMITTERS = False
# points of one call of an elementwise function; more points are more calls of the same program
LANES = 512
# lanes of a call on a device other than a CPU, in those of a call that fits a CPU's cache; not measured, limits the number of calls
DEVICE_LANES = 32
# bytes of live programs in XLA's own format, some forty times as much in memory; benchmarks/acceptance/memory.py
MOST_LIVE = 20e6
# programs that are made between two clearings of JAX's caches of traces, some 2 MB a program; benchmarks/acceptance/memory.py
MADE_TOGETHER = 32
# bytes of packed programs, some 0.3 MB each; beyond them the oldest are compiled again; benchmarks/acceptance/memory.py
MOST_SHELVED = 100e6

# ratio of successive Newton moves above which a step of a continuation is halved: Newton does not contract
MOST_CONTRACTION = 0.5
# further Newton iterations on a step of a continuation before it is halved
NEWTON_TRIES = 6
# the same at the first point, which has no step to halve: beyond them the walk ends with `step_too_small`
FIRST_TRIES = 20
# moves of Newton's method to a fold of a traced curve; it starts between the two neighbours
FOLD_STEPS = 30
# codes of a user's own margins begin here, above all of `Code`
OWN_CODES = 1000
# largest growth and least shrinkage of an accepted step
LEAST_GROWTH, MOST_GROWTH = 0.5, 2.0
# halvings of a bracket of an eigenvalue, and steps of inverse iteration from there; benchmarks/speed/eigenpairs.py
BISECTIONS, INVERSE_ITERATIONS = 40, 2
# rows of a Sturm sequence between two passes of a compiled loop; benchmarks/speed/eigenpairs.py
UNROLLED = 8
