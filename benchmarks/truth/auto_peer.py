"""Runs AUTO-07p on our equations of the membrane.

AUTO is taken from the environment variable AUTO_DIR, else from an `auto` on the path. `auto/membrane.f90` is ours and is
compiled by AUTO's own makefile. It gets one thread unless OMP_NUM_THREADS says otherwise.
"""

import dataclasses
import os
import pathlib
import re
import shutil
import subprocess

from benchmarks import harness

EQUATIONS = pathlib.Path(__file__).parent / "auto"
FOLD, STOP, MARK = 5, -4, 4  # AUTO's types of points: fold, user's point (−4, which ends the branch or not)


@dataclasses.dataclass
class Run:
    """One run: the seconds it prints, those of its process, and the points of its branch (type, numbers of the columns)."""

    seconds: float
    process_seconds: float
    points: list[tuple[int, list[float]]]

    def of_type(self, kind: int) -> list[list[float]]:
        return [values for own, values in self.points if own == kind]


def auto_directory() -> pathlib.Path | None:
    """Where AUTO-07p is installed, None where it is not."""
    found = os.environ.get("AUTO_DIR")
    if not found and (command := shutil.which("auto")):
        found = pathlib.Path(command).resolve().parent.parent
    return pathlib.Path(found) if found and (pathlib.Path(found) / "cmds" / "cmds.make").exists() else None


def compile_equations(auto: pathlib.Path, folder: str) -> str | None:
    """Compiles the equations in `folder` by AUTO's makefile; what the compiler said where that fails."""
    shutil.copy(EQUATIONS / "membrane.f90", folder)
    makefile = auto.resolve() / "cmds" / "cmds.make"
    try:
        done = subprocess.run(
            ["make", "-f", makefile, "EQUATION_NAME=membrane", "membrane.exe"],
            cwd=folder,
            env={**os.environ, "AUTO_DIR": str(auto.resolve())},
            capture_output=True,
            text=True,
            check=False,
        )
    except FileNotFoundError:
        return "there is no make"
    return None if (pathlib.Path(folder) / "membrane.exe").exists() else done.stdout + done.stderr


def prepare(folder: str) -> str | None:
    """Compiles the equations in `folder`; a sentence where AUTO cannot be run."""
    auto = auto_directory()
    if auto is None:
        return "AUTO-07p: not installed"
    error = compile_equations(auto, folder)
    return f"AUTO-07p: the equations were not compiled: {error}" if error else None


def threads() -> str:
    return os.environ.get("OMP_NUM_THREADS", "1")


def run(folder: str, constants: str, more: str) -> Run:
    """One continuation with the constants file `auto/c.{constants}` and the lines `more`."""
    text = (EQUATIONS / f"c.{constants}").read_text() + more + "\n"
    (pathlib.Path(folder) / "fort.2").write_text(text)
    branch = pathlib.Path(folder) / "fort.7"
    branch.unlink(missing_ok=True)
    process = harness.Stopwatch()
    with process:
        done = subprocess.run(
            [pathlib.Path(folder) / "membrane.exe"],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": threads()},
            capture_output=True,
            text=True,
            check=False,
        )
    printed = re.search(r"Total Time\s+(\S+)", done.stdout)
    # columns: branch, point, type, label, numbers; the header has branch 0
    rows = [line.split() for line in branch.read_text().splitlines()] if branch.exists() else []
    points = [(int(r[2]) % 10 if int(r[2]) > 0 else int(r[2]), [float(v) for v in r[4:]]) for r in rows if r[0] != "0"]
    return Run(float(printed[1]) if printed else float("nan"), process.seconds, points)
