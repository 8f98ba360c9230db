"""A room (module) of the package imports only rooms listed above it."""

import ast
import pathlib

import pytest

ROOMS = [
    "cache",
    "elementary",
    "locks",
    "kept",
    "results",
    "outcomes",
    "units",
    "tables",
    "records",
    "energies",
    "materials",
    "elastomers",
    "membrane",
    "loading",
    "scene",
    "shooting",
    "profiles",
    "programs",
    "stability",
    "equilibria",
    "chart",
    "elements",
    "sheet",
    "archive",
    "surface",
    "engines",
    "points",
    "trajectories",
    "family",
    "contours",
    "rows",
    "marks",
    "ramp_on_rows",
    "continuation",
    "tracing",
    "stations",
    "branches",
    "events",
    "critical",
    "states",
    "solved",
    "lanes",
    "crowd",
    "beyond",
    "ensemble",
    "polylines",
    "other_branches",
    "assembly",
    "batch",
    "ramp",
    "drawing",
    "plotting",
    "portraits",
    "material_page",
    "diagram",
    "leaves",
    "column_heads",
    "text_tables",
    "measurements",
    "constants",
    "curve_model",
    "fit_checks",
    "calibration",
    "searches",
    "load_lines",
    "critical_points",
    "turning_points",
    "animation",
    "paper_figures",
    "paper_statements",
    "paper",
    "regimes",
    "axes",
    "columns",
    "workers",
    "store",
    "executors",
    "sweeps",
    "documents",
    "specification",
    "reading",
    "designs",
    "far_states",
    "sheet_conditions",
    "boundaries",
    "grid_lines",
    "regime_plots",
    "fold_paths",
    "two_parameters",
    "regime_maps",
    "glances",
    "explorer",
    "scenarios",
    "design_points",
    "climbing",
    "objectives",
    "design",
    "design_files",
    "plain_text",
    "refusals",
    "arguments",
    "summaries",
    "cli",
]
PACKAGE = pathlib.Path(__file__).parent.parent / "dielectric_jax"


def imported_rooms(source):
    """The rooms that a module's source imports anywhere, also inside functions; "" is the package itself."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level == 0 and module.split(".")[0] != "dielectric_jax":
                continue
            room = module if node.level else module.partition(".")[2]
            yield from [room.split(".")[0]] if room else [a.name for a in node.names]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                package, _, room = alias.name.partition(".")
                if package == "dielectric_jax":
                    yield room.split(".")[0]


def test_every_module_is_a_room_in_the_order():
    assert {p.stem for p in PACKAGE.glob("*.py")} - {"__init__"} == set(ROOMS)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_above_it(room):
    above = ROOMS[: ROOMS.index(room)]
    # the command line stands on the package as a user sees it
    allowed = {*above, ""} if room == "cli" else set(above)
    source = (PACKAGE / f"{room}.py").read_text(encoding="utf-8")
    assert set(imported_rooms(source)) <= allowed


def test_the_reader_of_imports_sees_every_form():
    source = """
import numpy, dielectric_jax
import dielectric_jax.model.chart as c
from dielectric_jax.model import scene
from dielectric_jax.model.loading import Chamber
from . import records
def f():
    from .results import Code
    from jax import numpy
"""
    assert sorted(imported_rooms(source)) == ["", "chart", "loading", "records", "results", "scene"]
