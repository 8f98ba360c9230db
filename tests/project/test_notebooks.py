"""Every notebook runs from top to bottom; each ends in an assert against a number known independently."""

import pathlib

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

ROOT = pathlib.Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def test_these_are_the_notebooks():
    assert [n.stem for n in NOTEBOOKS] == [
        "design",
        "explorer",
        "first_diagram",
        "how_slow_is_slow",
        "paper",
        "stability_and_regimes",
        "sweep",
        "your_own_material",
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, monkeypatch):
    # the kernel finds the package of this checkout even if it is not installed
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(path, as_version=4)
    assert notebook.cells[-1].cell_type == "code" and "assert" in notebook.cells[-1].source
    assert all(not cell.get("outputs") for cell in notebook.cells), "the notebook is kept without outputs"
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources={}).execute()
    drawn = [o for c in notebook.cells for o in c.get("outputs", []) if "image/png" in o.get("data", {})]
    assert drawn
