"""What the benchmarks share: the description of the machine, and results written so that nothing is lost."""

import json
import math
import os
import pathlib
import platform
import sys

import jax
import numpy as np


def machine() -> dict:
    """Processor, cores and versions."""
    name = platform.processor() or platform.machine()
    info = pathlib.Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        name = names[0] if names else name
    return {
        "processor": name,
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
    }


def plain(value):
    """The value as JSON has it, without NaN."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def write(document: dict, where: str | None, *, partial: bool = False) -> None:
    """The document to a file (replaced at once, so that it is whole at any time) or, for "-", to standard output.

    A `partial` document, written so that an interrupted run loses nothing, goes to a file only: standard output gets one.
    """
    if where is None or (partial and where == "-"):
        return
    text = json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if where == "-":
        sys.stdout.write(text)
        return
    path = pathlib.Path(where)
    half = path.with_name(path.name + ".part")
    half.write_text(text)
    half.replace(path)
