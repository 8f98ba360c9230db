from .analysis import best_designs, compare_sweeps, count_sweep, export_sweep, plot_sweep, select_regime
from .axes import Axis, read_scenes, samples, zipped
from .documents import check_sizes, number, one_of, other_filling_left_out, read_toml, refuse, scene_of, table
from .engines import Engine
from .specification import read_specification
from .store import need
from .sweeps import open_sweep, sweep
from .variables import Answer

__all__ = [
    "Answer",
    "Axis",
    "Engine",
    "best_designs",
    "check_sizes",
    "compare_sweeps",
    "count_sweep",
    "export_sweep",
    "need",
    "number",
    "one_of",
    "open_sweep",
    "other_filling_left_out",
    "plot_sweep",
    "read_scenes",
    "read_specification",
    "read_toml",
    "refuse",
    "samples",
    "scene_of",
    "select_regime",
    "sweep",
    "table",
    "zipped",
]
