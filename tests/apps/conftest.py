"""The explorer's page in a process of its own, for tests of the page and of what a browser shows of it."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
# a shell's background jobs, and so their children, would ignore Ctrl-C
RUN = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from dielectric_jax.apps.cli import main
sys.exit(main())
"""


@pytest.fixture
def page(tmp_path):
    """The process of `dielectric-jax explore`, and the address that it printed."""
    pytest.importorskip("voila")
    command = [sys.executable, "-c", RUN, "explore", "--chamber-volume", "800", "--initial-volume", "2.42"]
    process = subprocess.Popen(
        [*command, "--no-browser"],
        env=os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    try:
        line = process.stdout.readline()
        yield process, re.search(r"http://127\.0\.0\.1:\d+/\?token=\w+", line)[0]
    finally:
        process.terminate()  # which also ends the kernel
        process.communicate(timeout=60)
