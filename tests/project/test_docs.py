"""The Python in the pages of the documentation runs, each page from top to bottom."""

import pathlib
import re

import matplotlib
import matplotlib.pyplot
import pytest

DOCS = pathlib.Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if BLOCK.search(page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(DOCS)) for page in PAGES])
def test_the_blocks_of_a_page_run(page, monkeypatch, tmp_path):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    text = page.read_text(encoding="utf-8")
    blocks = list(BLOCK.finditer(text))
    for block in blocks:
        line = text.count("\n", 0, block.start(1))
        exec(compile("\n" * line + block[1], str(page), "exec"), names)  # errors name the line of the page
    CHECKS.get(page.name, lambda names: None)(names)
    matplotlib.pyplot.close("all")


def test_the_other_lines_of_the_gallery_run_on_other_pages():
    """What takes long runs once: the blocks of the gallery marked `py` repeat lines of another page."""
    gallery = (DOCS / "gallery.md").read_text(encoding="utf-8")
    repeated = re.findall(r"^```py\n(.*?)^```", gallery, re.MULTILINE | re.DOTALL)
    run = {
        line
        for page in PAGES
        for block in BLOCK.findall(page.read_text(encoding="utf-8"))
        for line in block.splitlines()
    }
    assert len(repeated) == 5 and set("".join(repeated).splitlines()) <= run
    pictures = re.findall(r"figures/gallery_\w+\.png", gallery)
    assert {picture.name for picture in (DOCS / "figures").glob("gallery_*")} == {
        pathlib.Path(p).name for p in pictures
    }


def sweeps_page(names):
    """Checks of the statements on the page about its examples."""
    assert names["data"].regime.sizes == {"chamber_volume": 40, "initial_volume": 3}
    assert abs(float(names["small"].area_strain[1]) - 16.1218889) < 1e-7
    assert names["opened"].attrs["blocks_done"] == names["opened"].attrs["blocks"]
    assert names["stored"].area_strain.values.tobytes() == names["large"].area_strain.values.tobytes()
    best = names["best"]
    assert best.sizes["scene"] == 5 and (best.landing_ratio[:, 0] <= 0.8).all()
    assert (names["returning"].regime == 8).all()
    compared = names["compared"]["snap_voltage"]
    assert compared["beyond_errors"] == 0 and compared["differing"] > 0 and compared["largest"] < 1e-9


def calibration_page(names):
    """The true constants on the page lie within the fitted intervals."""
    found = names["found"]
    for name, true in (("shear_modulus", 60e3), ("stretch_limit", 120.0)):
        low, high = found.intervals[name]
        assert low < true < high and high / low < 1.2
    assert names["in_si"]
    low, high = names["charged"].intervals["relative_permittivity"]
    assert low < 4.7 < high < 1.1 * low
    tension, true = names["tension"], (*names["moduli"], *names["exponents"])
    for (low, high), value in zip(tension.intervals.values(), true, strict=True):
        assert low < value < high
    assert tension.warnings == names["charged"].warnings == ()


def rates_page(names):
    """Checks of the statements on the page about its films."""
    assert names["relaxed"].stress == pytest.approx([3.9375, 2.710311], rel=1e-6)
    event = names["creep"].event("pull_in")
    assert (event.time, event.stretch) == (pytest.approx(9.9744, abs=1e-4), pytest.approx(2.0631, abs=1e-4))
    found = names["found"]
    for name, value in (("modulus_ratio", 2.0), ("relaxation_time", 5.0)):
        low, high = found.intervals[name]
        assert low < value < high and found.parameters[name] == pytest.approx(value, rel=0.1)
    assert found.warnings == ()


CHECKS = {"sweeps.md": sweeps_page, "calibration.md": calibration_page, "rates.md": rates_page}
