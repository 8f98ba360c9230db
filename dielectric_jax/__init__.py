"""Bifurcation diagrams of a dielectric-elastomer membrane on an air chamber, exact to nine digits, in JAX."""

import importlib
import typing

__version__ = "0.1.0"

_ROOMS = {
    "numerics.codes": ("Code", "SceneError"),
    "model.units": ("VHB_4910", "Units"),
    "model.records": ("Branch", "Event", "Ramp", "SpecialPoint", "State"),
    "model.materials": (
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
    "model.elastomers": ("CustomPermittivity", "Electrostrictive", "MooneyRivlin", "Ogden"),
    "model.membrane": ("Membrane", "Profile", "vhb_4910"),
    "model.loading": ("Chamber", "ChargeControl", "ConstantPressure", "ConstantVoltage", "PrescribedVolume"),
    "model.scene": ("PARAMETERS", "Scene", "Window", "describe"),
    "model.shooting": ("shoot",),
    "model.profiles": ("energy", "profile", "scaling_defect"),
    "model.stability": ("Stability", "stability_of"),
    "model.chart": ("explicit_map",),
    "numerics.continuation": ("Problem", "Steps", "Trace", "trace"),
    "surface.surface": ("SheetState", "Surface"),
    "model.outcomes": ("FoldAhead", "Outcome", "Regime"),
    "diagram.chambers": (
        "Curves",
        "Point",
        "Ramps",
        "chamber_curves",
        "chamber_ramps",
        "filling_volumes",
        "pressure_curves",
        "pressure_ramps",
    ),
    "surface.family": ("SurfaceFamily",),
    "plot.diagrams": ("plot_chamber", "plot_diagram", "plot_pressure_volume", "plot_voltage_volume"),
    "plot.states": ("breakdown_latitudes", "plot_cross_section", "plot_distribution"),
    "plot.materials": ("balloon_pressure", "plot_material", "tension_curves"),
    "plot.animation": ("animate_ramp", "plot_ramp", "ramp_path"),
    "diagram.states": ("equilibrium",),
    "diagram.diagrams": ("Diagram", "pressure_volume", "voltage_volume"),
    "apps.paper_statements": ("Statement",),
    "apps.paper": ("reproduce",),
    "diagram.batch": ("Batch", "continue_scenes"),
    "critical.critical_points": (
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
    "design.measurements": ("Measurement", "read_measurement"),
    "design.calibration": ("Calibration", "calibrate"),
    "sweeps.axes": ("Axis", "read_scenes", "samples", "zipped"),
    "sweeps.variables": ("Answer",),
    "sweeps.sweeps": ("open_sweep", "sweep"),
    "sweeps.documents": ("scene_of",),
    "sweeps.specification": ("read_specification",),
    "sweeps.analysis": ("best_designs", "compare_sweeps", "count_sweep", "export_sweep", "plot_sweep", "select_regime"),
    "critical.cusps": (
        "bistability_onset",
        "bistability_point",
        "cusp",
        "pressure_cusp",
        "pressure_peak",
        "pressure_valley",
        "zero_voltage_point",
    ),
    "diagram.regimes": ("regime_of",),
    "design.designs": ("Designs", "classify_designs"),
    "design.regime_maps": ("Boundary", "RegimeEdge", "RegimeMap", "regime_edges", "regime_map"),
    "plot.maps": ("plot_fold_curves", "plot_regime_map"),
    "critical.two_parameters": ("FoldCurve", "FoldCurves", "TwoParameterPoint", "fold_curves"),
    "diagram.glances": ("Glance", "glance"),
    "apps.explorer": ("Explorer", "explore"),
    "design.objectives": ("Optimum", "maximise"),
    "design.area_strain": ("Design", "maximise_area_strain"),
    "numerics.cache": ("enable_compilation_cache",),
}
_HOME = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [*_HOME]

if typing.TYPE_CHECKING:
    from .plot.animation import animate_ramp, plot_ramp, ramp_path
    from .sweeps.axes import Axis, read_scenes, samples, zipped
    from .diagram.batch import Batch, continue_scenes
    from .numerics.cache import enable_compilation_cache
    from .design.calibration import Calibration, calibrate
    from .model.chart import explicit_map
    from .sweeps.variables import Answer
    from .numerics.continuation import Problem, Steps, Trace, trace
    from .critical.critical_points import (
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
    from .design.area_strain import Design, maximise_area_strain
    from .design.designs import Designs, classify_designs
    from .diagram.diagrams import Diagram, pressure_volume, voltage_volume
    from .sweeps.documents import scene_of
    from .model.elastomers import CustomPermittivity, Electrostrictive, MooneyRivlin, Ogden
    from .diagram.chambers import (
        Curves,
        Point,
        Ramps,
        chamber_curves,
        chamber_ramps,
        filling_volumes,
        pressure_curves,
        pressure_ramps,
    )
    from .apps.explorer import Explorer, explore
    from .surface.family import SurfaceFamily
    from .diagram.glances import Glance, glance
    from .model.loading import Chamber, ChargeControl, ConstantPressure, ConstantVoltage, PrescribedVolume
    from .plot.materials import balloon_pressure, plot_material, tension_curves
    from .model.materials import (
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
    from .design.measurements import Measurement, read_measurement
    from .model.membrane import Membrane, Profile, vhb_4910
    from .design.objectives import Optimum, maximise
    from .model.outcomes import FoldAhead, Outcome, Regime
    from .apps.paper import reproduce
    from .apps.paper_statements import Statement
    from .plot.diagrams import plot_chamber, plot_diagram, plot_pressure_volume, plot_voltage_volume
    from .plot.states import breakdown_latitudes, plot_cross_section, plot_distribution
    from .model.profiles import energy, profile, scaling_defect
    from .sweeps.analysis import best_designs, compare_sweeps, count_sweep, export_sweep, plot_sweep, select_regime
    from .model.records import Branch, Event, Ramp, SpecialPoint, State
    from .design.regime_maps import Boundary, RegimeEdge, RegimeMap, regime_edges, regime_map
    from .plot.maps import plot_fold_curves, plot_regime_map
    from .diagram.regimes import regime_of
    from .numerics.codes import Code, SceneError
    from .model.scene import PARAMETERS, Scene, Window, describe
    from .model.shooting import shoot
    from .sweeps.specification import read_specification
    from .model.stability import Stability, stability_of
    from .diagram.states import equilibrium
    from .surface.surface import SheetState, Surface
    from .sweeps.sweeps import open_sweep, sweep
    from .critical.cusps import (
        bistability_onset,
        bistability_point,
        cusp,
        pressure_cusp,
        pressure_peak,
        pressure_valley,
        zero_voltage_point,
    )
    from .critical.two_parameters import FoldCurve, FoldCurves, TwoParameterPoint, fold_curves
    from .model.units import VHB_4910, Units


def __getattr__(name: str):
    # imported when first asked for, so that the command line answers bad input at once
    if name in _HOME:
        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
