"""Draws the figures of the gallery by running its lines: `python docs/gallery.py`."""

import io
import pathlib
import re

import matplotlib
import matplotlib.pyplot as plt
from PIL import Image

matplotlib.use("Agg")
DOCS = pathlib.Path(__file__).parent
PART = re.compile(r"^```py(?:thon)?\n(.*?)^```(?:\n\n!\[[^\]]*\]\((figures/\w+\.png)\))?", re.MULTILINE | re.DOTALL)


def write(figure, file: pathlib.Path) -> None:
    """The figure as a small file: 256 colours are enough for lines and text."""
    data = io.BytesIO()
    figure.savefig(data, dpi=90, bbox_inches="tight")
    Image.open(data).convert("RGB").quantize(256).save(file, optimize=True)


if __name__ == "__main__":
    names: dict = {}
    for lines, picture in PART.findall((DOCS / "gallery.md").read_text(encoding="utf-8")):
        exec(lines, names)
        if picture:
            write(plt.gcf(), DOCS / picture)
            plt.close("all")
            print(picture)
