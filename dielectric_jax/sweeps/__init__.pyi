from .analysis import best_designs, compare_sweeps, count_sweep, export_sweep, plot_sweep, select_regime
from .axes import Axis, read_scenes, samples, zipped
from .engines import Engine
from .specification import read_specification
from .sweeps import open_sweep, sweep
from .variables import Answer

__all__ = [
    "Answer",
    "Axis",
    "Engine",
    "best_designs",
    "compare_sweeps",
    "count_sweep",
    "export_sweep",
    "open_sweep",
    "plot_sweep",
    "read_scenes",
    "read_specification",
    "samples",
    "select_regime",
    "sweep",
    "zipped",
]
