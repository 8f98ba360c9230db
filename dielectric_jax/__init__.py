"""Bifurcation diagrams of a dielectric-elastomer membrane on an air chamber, exact to nine digits, in JAX."""

import importlib
import typing

__version__ = "0.1.0"

_ROOMS = {
    "results": ("Code", "SceneError"),
    "units": ("VHB_4910", "Units"),
    "records": ("Branch", "Event", "Ramp", "SpecialPoint", "State"),
    "materials": (
        "AbstractMaterial",
        "ArrudaBoyce",
        "ConstantBreakdown",
        "CustomBreakdown",
        "CustomMaterial",
        "Gent",
        "NeoHookean",
        "VHBBreakdown",
        "stresses",
    ),
    "elastomers": ("CustomPermittivity", "Electrostrictive", "MooneyRivlin", "Ogden"),
    "membrane": ("Membrane", "Profile", "vhb_4910"),
    "loading": ("Chamber", "ChargeControl", "ConstantPressure", "ConstantVoltage", "PrescribedVolume"),
    "scene": ("PARAMETERS", "Scene", "Window", "describe"),
    "shooting": ("shoot",),
    "profiles": ("energy", "profile", "scaling_defect"),
    "stability": ("Stability", "stability_of"),
    "chart": ("explicit_map",),
    "continuation": ("Problem", "Steps", "Trace", "trace"),
    "surface": ("SheetState", "Surface"),
    "outcomes": ("FoldAhead", "Outcome", "Regime"),
    "ensemble": (
        "Curves",
        "Point",
        "Ramps",
        "chamber_curves",
        "chamber_ramps",
        "filling_volumes",
        "pressure_curves",
        "pressure_ramps",
    ),
    "family": ("SurfaceFamily",),
    "plotting": ("plot_chamber", "plot_diagram", "plot_pressure_volume", "plot_voltage_volume"),
    "portraits": ("breakdown_latitudes", "plot_cross_section", "plot_distribution"),
    "material_page": ("balloon_pressure", "plot_material", "tension_curves"),
    "animation": ("animate_ramp", "plot_ramp", "ramp_path"),
    "states": ("equilibrium",),
    "diagram": ("Diagram", "pressure_volume", "voltage_volume"),
    "paper_statements": ("Statement",),
    "paper": ("reproduce",),
    "batch": ("Batch", "continue_scenes"),
    "critical_points": (
        "CriticalPoint",
        "area_strain",
        "breakdown_point",
        "breakdown_voltage",
        "landing_point",
        "snap_back_point",
        "snap_back_voltage",
        "snap_point",
        "snap_voltage",
    ),
    "measurements": ("Measurement", "read_measurement"),
    "calibration": ("Calibration", "calibrate"),
    "axes": ("Axis", "read_scenes", "samples", "zipped"),
    "columns": ("Answer",),
    "sweeps": ("open_sweep", "sweep"),
    "documents": ("scene_of",),
    "specification": ("read_specification",),
    "reading": ("best_designs", "compare_sweeps", "count_sweep", "export_sweep", "plot_sweep", "select_regime"),
    "turning_points": (
        "bistability_onset",
        "bistability_point",
        "cusp",
        "pressure_cusp",
        "pressure_peak",
        "pressure_valley",
        "zero_voltage_point",
    ),
    "regimes": ("regime_of",),
    "designs": ("Designs", "classify_designs"),
    "regime_maps": ("Boundary", "RegimeEdge", "RegimeMap", "regime_edges", "regime_map"),
    "regime_plots": ("plot_fold_curves", "plot_regime_map"),
    "two_parameters": ("FoldCurve", "FoldCurves", "TwoParameterPoint", "fold_curves"),
    "glances": ("Glance", "glance"),
    "explorer": ("Explorer", "explore"),
    "objectives": ("Optimum", "maximise"),
    "design": ("Design", "maximise_area_strain"),
    "cache": ("enable_compilation_cache",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [*_HOME]

if typing.TYPE_CHECKING:
    from .animation import animate_ramp, plot_ramp, ramp_path
    from .axes import Axis, read_scenes, samples, zipped
    from .batch import Batch, continue_scenes
    from .cache import enable_compilation_cache
    from .calibration import Calibration, calibrate
    from .chart import explicit_map
    from .columns import Answer
    from .continuation import Problem, Steps, Trace, trace
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
    from .design import Design, maximise_area_strain
    from .designs import Designs, classify_designs
    from .diagram import Diagram, pressure_volume, voltage_volume
    from .documents import scene_of
    from .elastomers import CustomPermittivity, Electrostrictive, MooneyRivlin, Ogden
    from .ensemble import (
        Curves,
        Point,
        Ramps,
        chamber_curves,
        chamber_ramps,
        filling_volumes,
        pressure_curves,
        pressure_ramps,
    )
    from .explorer import Explorer, explore
    from .family import SurfaceFamily
    from .glances import Glance, glance
    from .loading import Chamber, ChargeControl, ConstantPressure, ConstantVoltage, PrescribedVolume
    from .material_page import balloon_pressure, plot_material, tension_curves
    from .materials import (
        AbstractMaterial,
        ArrudaBoyce,
        ConstantBreakdown,
        CustomBreakdown,
        CustomMaterial,
        Gent,
        NeoHookean,
        VHBBreakdown,
        stresses,
    )
    from .measurements import Measurement, read_measurement
    from .membrane import Membrane, Profile, vhb_4910
    from .objectives import Optimum, maximise
    from .outcomes import FoldAhead, Outcome, Regime
    from .paper import reproduce
    from .paper_statements import Statement
    from .plotting import plot_chamber, plot_diagram, plot_pressure_volume, plot_voltage_volume
    from .portraits import breakdown_latitudes, plot_cross_section, plot_distribution
    from .profiles import energy, profile, scaling_defect
    from .reading import best_designs, compare_sweeps, count_sweep, export_sweep, plot_sweep, select_regime
    from .records import Branch, Event, Ramp, SpecialPoint, State
    from .regime_maps import Boundary, RegimeEdge, RegimeMap, regime_edges, regime_map
    from .regime_plots import plot_fold_curves, plot_regime_map
    from .regimes import regime_of
    from .results import Code, SceneError
    from .scene import PARAMETERS, Scene, Window, describe
    from .shooting import shoot
    from .specification import read_specification
    from .stability import Stability, stability_of
    from .states import equilibrium
    from .surface import SheetState, Surface
    from .sweeps import open_sweep, sweep
    from .turning_points import (
        bistability_onset,
        bistability_point,
        cusp,
        pressure_cusp,
        pressure_peak,
        pressure_valley,
        zero_voltage_point,
    )
    from .two_parameters import FoldCurve, FoldCurves, TwoParameterPoint, fold_curves
    from .units import VHB_4910, Units


def __getattr__(name: str):
    # imported when first asked for, so that the command line answers bad input at once
    if name in _HOME:
        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
