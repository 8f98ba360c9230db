from .batch import Batch, MembraneKey, condition_of, continue_scenes, stacked, starts
from .diagrams import Diagram, equilibrium, pressure_volume, voltage_volume
from .glances import Glance, glance
from .mesh import hermite
from .mode_points import NOT_DECIDED
from .neutral import neutral_modes
from .ramp import ENDS, LOSSES, NOT_LOCATED
from .ramps import APEX, ERROR, LISTED, LOAD, PRESSURE, SLOTS, VOLUME, RampArrays, Ramps, Slot, States, ramps_of
from .regimes import regime_of, regime_of_diagram
from .reports import Report, report, report_of
from .states import check_request, filling
from .surface_ramps import (
    Curves,
    chamber_curves,
    chamber_ramps,
    curves_and_ramps,
    filling_volumes,
    first_folds_on,
    landings_on,
    largest_start,
    loading_arrays,
    pressure_curves,
    pressure_ramps,
)
from .tracing import TraceGrid, branch_problem

__all__ = [
    "APEX",
    "ENDS",
    "ERROR",
    "LISTED",
    "LOAD",
    "LOSSES",
    "NOT_DECIDED",
    "NOT_LOCATED",
    "PRESSURE",
    "SLOTS",
    "VOLUME",
    "Batch",
    "Curves",
    "Diagram",
    "Glance",
    "MembraneKey",
    "RampArrays",
    "Ramps",
    "Report",
    "Slot",
    "States",
    "TraceGrid",
    "branch_problem",
    "chamber_curves",
    "chamber_ramps",
    "check_request",
    "condition_of",
    "continue_scenes",
    "curves_and_ramps",
    "equilibrium",
    "filling",
    "filling_volumes",
    "first_folds_on",
    "glance",
    "hermite",
    "landings_on",
    "largest_start",
    "loading_arrays",
    "neutral_modes",
    "pressure_curves",
    "pressure_ramps",
    "pressure_volume",
    "ramps_of",
    "regime_of",
    "regime_of_diagram",
    "report",
    "report_of",
    "stacked",
    "starts",
    "voltage_volume",
]
