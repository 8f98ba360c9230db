"""Pages of the site made from the notebooks of the repository, which are kept without outputs.

A notebook is executed when the site is built, so that its outputs are those of the code it stands beside; the result stays in the folder
`.cache` until the notebook or the package changes. With `DOCS_NOTEBOOKS=off` nothing is executed, and the pages show the code alone.
"""

import copy
import functools
import hashlib
import logging
import os
import pathlib
import re

import nbclient
import nbconvert
import nbformat
from mkdocs.structure.files import File
from traitlets.config import Config

ROOT = pathlib.Path(__file__).parents[1]
CACHE = ROOT / ".cache" / "notebooks"
ABOUT = "*This page is a notebook, executed when the site was built; [download it]({name}.ipynb).*"
UNEXECUTED = "*This page is a notebook, shown without its outputs; [download it]({name}.ipynb).*"


def executed(path: pathlib.Path, cache: pathlib.Path = CACHE) -> nbformat.NotebookNode:
    """The notebook with its outputs, from the cache if neither it nor the package has changed."""
    kept = cache / f"{path.stem}-{hashlib.sha256(path.read_bytes() + _package()).hexdigest()[:16]}.ipynb"
    if kept.exists():
        return nbformat.read(kept, as_version=4)
    logging.getLogger("mkdocs.hooks").info("Executing %s", path.name)
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources={}).execute()
    cache.mkdir(parents=True, exist_ok=True)
    for old in cache.glob(f"{path.stem}-*.ipynb"):
        old.unlink()
    nbformat.write(notebook, kept)
    return notebook


@functools.cache
def _package() -> bytes:
    """A digest of the sources of the package."""
    sources = sorted((ROOT / "dielectric_jax").rglob("*.py"))
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).digest()


def _speaks(output: nbformat.NotebookNode) -> bool:
    """Whether an output belongs on a page: no notice of compiling, no widget, no address of an object in memory."""
    data = output.get("data", {})
    silent = re.match(r"compiling …|\[?<[\w.]+", output.get("text", "") or data.get("text/plain", ""))
    return "image/png" in data or not (silent or any("widget-view" in kind for kind in data))


def as_markdown(notebook: nbformat.NotebookNode, name: str, about: str) -> tuple[str, dict[str, bytes]]:
    """The notebook as Markdown, and its pictures by their names."""
    config = Config(NbConvertBase={"display_data_priority": ["image/png", "text/markdown", "text/html", "text/plain"]})
    exporter = nbconvert.MarkdownExporter(config=config)
    notebook = copy.deepcopy(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if _speaks(output)]
    text, resources = exporter.from_notebook_node(notebook, {"unique_key": name, "output_files_dir": "."})
    title, rest = text.strip().split("\n", 1)
    return f"{title}\n\n{about.format(name=name)}\n{rest}\n", resources["outputs"]


def on_files(files, config):
    """Adds a page for each notebook, its pictures, and the notebook for download."""
    run = os.environ.get("DOCS_NOTEBOOKS") != "off"
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = executed(path) if run else nbformat.read(path, as_version=4)
        text, pictures = as_markdown(notebook, path.stem, ABOUT if run else UNEXECUTED)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        files.append(File.generated(config, f"notebooks/{path.name}", content=path.read_bytes()))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{pathlib.PurePosixPath(name)}", content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links to notebooks of the repository become links to their pages."""
    return re.sub(r"\]\(\.\./notebooks/(\w+)\.ipynb\)", r"](notebooks/\1.md)", markdown)
