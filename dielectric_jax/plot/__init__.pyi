from .animation import animate_ramp, animate_run, plot_ramp, ramp_path
from .diagrams import (
    chamber_voltages,
    plot_chamber,
    plot_chamber_curves,
    plot_diagram,
    plot_pressure_volume,
    plot_voltage_volume,
)
from .drawing import (
    COLOURS,
    add_legend,
    columns,
    draw_line,
    event_entries,
    line_entries,
    line_entry,
    new_figure,
    point_entries,
    viewed,
    voltage_text,
)
from .loops import plot_courses, plot_follow, plot_runs, plot_snap_voltages
from .maps import plot_fold_curves, plot_regime_map
from .materials import balloon_pressure, plot_material, tension_curves
from .modes import plot_mode, plot_spectra
from .states import breakdown_latitudes, plot_cross_section, plot_distribution

__all__ = [
    "COLOURS",
    "add_legend",
    "animate_ramp",
    "animate_run",
    "balloon_pressure",
    "breakdown_latitudes",
    "chamber_voltages",
    "columns",
    "draw_line",
    "event_entries",
    "line_entries",
    "line_entry",
    "new_figure",
    "plot_chamber",
    "plot_chamber_curves",
    "plot_courses",
    "plot_cross_section",
    "plot_diagram",
    "plot_distribution",
    "plot_fold_curves",
    "plot_follow",
    "plot_material",
    "plot_mode",
    "plot_pressure_volume",
    "plot_ramp",
    "plot_regime_map",
    "plot_runs",
    "plot_snap_voltages",
    "plot_spectra",
    "plot_voltage_volume",
    "point_entries",
    "ramp_path",
    "tension_curves",
    "viewed",
    "voltage_text",
]
