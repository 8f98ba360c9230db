"""The layering: packages import only the public names of packages on lower floors; no circular imports inside a package."""

import ast
import graphlib
import importlib
import pathlib
import re

import pytest

import dielectric_jax as dj

PACKAGE = pathlib.Path(__file__).parents[2] / "dielectric_jax"
FLOORS = {
    "numerics": 1,
    "model": 2,
    "surface": 3,
    "plot": 3,
    "diagram": 4,
    "modes": 3,
    "sweeps": 5,
    "critical": 5,
    "design": 5,
    "rates": 5,
    "apps": 6,
}


def imports_of(source: str, package: str) -> list[tuple[str, str]]:
    """(package, module) of every import from the project in a module of `package`, also inside functions.

    The module is "" if the package itself is imported; the package is "" for the project itself.
    """
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            parts = (node.module or "").split(".")
            if node.level == 0 and parts[0] != "dielectric_jax":
                continue
            parts = parts[1:] if node.level == 0 else [package, *filter(None, parts)] if node.level == 1 else parts
            names = [a.name for a in node.names]
            if node.level == 1 and not node.module:
                found += [(package, name) for name in names]
            elif not parts or not parts[0]:
                found += [(name, "") for name in names]
            else:
                found.append((parts[0], ".".join(parts[1:])))
        elif isinstance(node, ast.Import):
            for alias in node.names:
                parts = alias.name.split(".")
                if parts[0] == "dielectric_jax":
                    found.append((parts[1] if len(parts) > 1 else "", ".".join(parts[2:])))
    return found


def modules_of(package: str) -> list[pathlib.Path]:
    return sorted(p for p in (PACKAGE / package).glob("*.py") if p.name != "__init__.py")


def test_only_packages_stand_at_the_top():
    files = {p.name for p in PACKAGE.iterdir() if p.is_file()}
    assert files == {"__init__.py", "__init__.pyi", "__main__.py", "py.typed"}
    assert {p.name for p in PACKAGE.iterdir() if p.is_dir()} - {"__pycache__"} == set(FLOORS)


@pytest.mark.parametrize("package", FLOORS)
def test_a_package_imports_faces_of_lower_floors(package):
    for path in modules_of(package):
        for other, module in imports_of(path.read_text(encoding="utf-8"), package):
            if other == package:
                continue
            edge = f"{package}/{path.name} -> {other or 'dielectric_jax'}{'.' + module if module else ''}"
            # the command line uses the package as a user sees it
            allowed = other in FLOORS and FLOORS[other] < FLOORS[package] and not module
            assert allowed or (path.stem == "cli" and not other), edge


@pytest.mark.parametrize("package", FLOORS)
def test_there_are_no_circles_inside_a_package(package):
    graph = {
        path.stem: {m for other, m in imports_of(path.read_text(encoding="utf-8"), package) if other == package}
        for path in modules_of(package)
    }
    assert set().union(*graph.values()) <= set(graph)
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle


@pytest.mark.parametrize("package", FLOORS)
def test_a_face_lists_what_it_gives(package):
    face = importlib.import_module(f"dielectric_jax.{package}")
    assert face.__doc__
    assert sorted(face.__all__) == sorted(set(face.__all__))
    modules = {path.stem for path in modules_of(package)}
    assert not modules & set(face.__all__)  # a name that hides a module would be found by one form of import only
    assert all(hasattr(face, name) for name in face.__all__)


def is_large(function: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> bool:
    """More than 60 lines of code without docstring and comments, or more than 8 parameters.

    A public function may have additional keyword-only options.
    """
    doc = function.body[0].end_lineno if ast.get_docstring(function) else function.body[0].lineno - 1
    code = [line.strip() for line in lines[doc : function.end_lineno]]
    size = function.body[0].lineno - function.lineno + sum(bool(line) and not line.startswith("#") for line in code)
    given = function.args
    count = len(given.posonlyargs) + len(given.args)
    if function.name.startswith("_"):
        count += len(given.kwonlyargs)
    return size > 60 or count > 8


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_functions_are_short_and_take_few_parameters(path):
    text = path.read_text(encoding="utf-8")
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert [f.name for f in functions if is_large(f, text.splitlines())] == []


def test_few_names_stand_at_the_top():
    """The top level holds what a first script needs, and the packages."""
    assert set(FLOORS) < set(dir(dj)) == set(dj.__all__)
    assert len(dir(dj)) <= 60
    with pytest.raises(AttributeError, match="no_such_name"):
        dj.no_such_name  # noqa: B018


def test_the_reader_of_imports_sees_every_form():
    source = """
import numpy, dielectric_jax
import dielectric_jax.model.chart as c
from dielectric_jax import surface
from dielectric_jax.model.loading import Chamber
from ..numerics import Code
from . import records
def f():
    from .scene import Scene
    from ..plot.diagrams import plot_diagram
    from jax import numpy
"""
    assert sorted(imports_of(source, "model")) == [
        ("", ""),
        ("model", "chart"),
        ("model", "loading"),
        ("model", "records"),
        ("model", "scene"),
        ("numerics", ""),
        ("plot", "diagrams"),
        ("surface", ""),
    ]


@pytest.mark.parametrize("path", sorted(PACKAGE.glob("*/resolution.py")), ids=lambda p: p.parent.name)
def test_tuned_numbers_are_explained_and_used(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    others = "".join(p.read_text(encoding="utf-8") for p in PACKAGE.rglob("*.py") if p != path)
    for node in ast.parse("\n".join(lines)).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            if names == ["__all__"]:
                continue
            above, own = lines[node.lineno - 2], lines[node.lineno - 1 : node.end_lineno]
            assert above.startswith("#") or any("  # " in line for line in own), names
            used = others + "\n".join(lines[node.end_lineno :])
            assert all(re.search(rf"\b{name}\b", used) for name in names), names


def test_benchmarks_that_comments_name_exist():
    root = PACKAGE.parent
    for path in PACKAGE.rglob("*.py"):
        for package, script in re.findall(r"benchmarks[./](\w+)[./](\w+)", path.read_text(encoding="utf-8")):
            assert (root / "benchmarks" / package / f"{script}.py").exists(), f"{path.name}: {package}/{script}"
