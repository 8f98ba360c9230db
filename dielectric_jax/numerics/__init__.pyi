from .cache import cache_folder, enable_compilation_cache, enabled_folder, is_own, make_folder, say
from .codes import (
    Code,
    NamedCode,
    SceneError,
    StoreError,
    WorkersLost,
    check_between,
    check_positive,
    check_whole,
    shown,
    whole_range,
)
from .compiled import cached_jit, elementwise, of_this_package, source_digest
from .continuation import Fold, Problem, Steps, Trace, Walk, advance, begin, locate_folds, shorter, stepped, trace
from .eigen import Eigenpairs, Tridiagonal, lapack_alone, lowest_eigenpairs, number_below, tridiagonal
from .elementary import log1p, reciprocal, sine_cosine, softplus
from .extras import need
from .lanes import calls_of, cores, lanes_of_a_call, run_lanes, threads
from .locks import Locked, alone
from .newton import Root, SmallSystem, root_find, solve_small
from .readable import Readable
from .resolution import LARGEST

__all__ = [
    "LARGEST",
    "Code",
    "Eigenpairs",
    "Fold",
    "Locked",
    "NamedCode",
    "Problem",
    "Readable",
    "Root",
    "SceneError",
    "SmallSystem",
    "Steps",
    "StoreError",
    "Trace",
    "Tridiagonal",
    "Walk",
    "WorkersLost",
    "advance",
    "alone",
    "begin",
    "cache_folder",
    "cached_jit",
    "calls_of",
    "check_between",
    "check_positive",
    "check_whole",
    "cores",
    "elementwise",
    "enable_compilation_cache",
    "enabled_folder",
    "is_own",
    "lanes_of_a_call",
    "lapack_alone",
    "locate_folds",
    "log1p",
    "lowest_eigenpairs",
    "make_folder",
    "need",
    "number_below",
    "of_this_package",
    "reciprocal",
    "root_find",
    "run_lanes",
    "say",
    "shorter",
    "shown",
    "sine_cosine",
    "softplus",
    "solve_small",
    "source_digest",
    "stepped",
    "threads",
    "trace",
    "tridiagonal",
    "whole_range",
]
