"""The tuned numbers of this package."""

# the last change of Newton's method, of stretches, dashpots and of the pressure relative to its size: its square is the error left
NEWTON_STEP = 1e-8
# more steps than a good start needs
MOST_NEWTON_STEPS = 8
# the error of a step that failed: it is tried again, a fifth as long
FAILED_STEP = 1e3
# points from the apex to the rim at which hoop tension and breakdown are looked for
LOOK_POINTS = 65
# points of a profile, evenly spaced in R: a drawn balloon looks smooth
PROFILE_POINTS = 129
# the first step of a leg, as a share of its scale of σ
FIRST_STEP = 1e-3
# steps of one call of the compiled program; a longer leg takes several
STEPS_OF_A_CALL = 32
# dx/dm, in units of 1/(unit of time), below which nothing moves any more
STOPPED = 1e-9
# functions of the radius and Gauss points, of a run and of its estimate of the error
MESHES = ((24, 36), (32, 48))
# runs of one call, on a device that is no CPU
RUNS_TOGETHER = 8
# calls of a leg, jumps of a run, and steps with which an event is located
MOST_CALLS, MOST_JUMPS, MOST_LOCATING = 320, 50, 60
# the error of a step along a jump, on which every state is exact
LANDING_TOLERANCE = 1e-3
# changes of the voltage, of what leaps, and of the volume that count as large: κ and the units of σ
LOAD_SCALE, LEAP_SCALE, VOLUME_SCALE = 0.05, 0.2, 0.5
# golden sections of a step: to 1e-8 of it
MOST_SECTIONS = 38
# the error of a step by the embedded method, of order 3, beside tolerance^(2/3): by the ramps and loops of tests/data/rates.json
TOLERANCE_SHARE = 0.2
# k of the coordinate along the radius, which crowds points at the apex: by the folds and landings of tests/data/rates.json
CROWDING = 1.5
# steps of a run whose event is differentiated are padded to a multiple of this
STEPS_OF_A_RECORD = 64
# points of a leg at which a homogeneous film is looked at
FILM_POINTS = 65
# numbers of times for which programs of films are compiled
GRID_SIZES = 16, 65, 128, 256, 512, 1024
