from .critical_points import (
    CriticalPoint,
    area_strain,
    breakdown_point,
    breakdown_voltage,
    landing_point,
    snap_back_point,
    snap_back_voltage,
    snap_point,
    snap_voltage,
)
from .cusps import (
    bistability_onset,
    bistability_point,
    cusp,
    pressure_cusp,
    pressure_peak,
    pressure_valley,
    state_point,
    zero_voltage_point,
)
from .mode_points import mode_point
from .two_parameters import FoldCurve, FoldCurves, TwoParameterPoint, fold_curves

__all__ = [
    "CriticalPoint",
    "FoldCurve",
    "FoldCurves",
    "TwoParameterPoint",
    "area_strain",
    "bistability_onset",
    "bistability_point",
    "breakdown_point",
    "breakdown_voltage",
    "cusp",
    "fold_curves",
    "landing_point",
    "mode_point",
    "pressure_cusp",
    "pressure_peak",
    "pressure_valley",
    "snap_back_point",
    "snap_back_voltage",
    "snap_point",
    "snap_voltage",
    "state_point",
    "zero_voltage_point",
]
