"""The explorer as a page of its own: Voilà serves its widgets, and nothing of Jupyter is seen."""

from __future__ import annotations

import json
import os
import secrets
import socket
import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..model import Scene
from ..numerics import need, say
from .scene_code import code_of

__all__ = ["page_of", "serve"]

_HOST = "127.0.0.1"  # no other machine sees the page
_PING = 30_000  # milliseconds until a browser that does not answer is given up: as long as between two questions
_SHOWN = """\
try:
    shown = dj.apps.explore(scene)
except (ValueError, dj.numerics.SceneError) as error:
    shown = str(error)
shown"""


def page_of(scene: Scene, folder: str) -> dict[str, Any]:
    """The notebook of one cell that shows the explorer of a scene; pictures are saved relative to `folder`.

    >>> from dielectric_jax import ConstantPressure, Membrane
    >>> page = page_of(Scene(Membrane(), ConstantPressure(1.5)), "/tmp")
    >>> "loading = ConstantPressure(pressure=1.5)" in page["cells"][0]["source"]
    True
    """
    lines = ["import os", "", f"os.chdir({folder!r})", code_of(scene, diagram=False), _SHOWN]
    cell = {"cell_type": "code", "id": "explorer", "metadata": {}, "execution_count": None, "outputs": []}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {
        "cells": [cell | {"source": "\n".join(lines)}],
        "metadata": {"kernelspec": kernel, "title": "dielectric_jax explorer"},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def serve(scene: Scene, *, port: int | None = None, browser: bool = True) -> None:
    """Serves the explorer of a scene to this machine until Ctrl-C, and opens it in a browser.

    Only who has the address, which contains a secret, sees the page. Needs the extra `interactive`.

    Raises:
        ValueError: if another program listens on the port, or for a scene that cannot be written as code.
        ImportError: if Voilà is not installed.
    """
    app = need("voila.app", "interactive")
    port, token = _free_port(port), secrets.token_hex(16)
    with tempfile.TemporaryDirectory(prefix="dielectric_jax_") as folder:
        notebook = Path(folder) / "explorer.ipynb"
        notebook.write_text(json.dumps(page_of(scene, os.getcwd())), encoding="utf-8")
        options = {"Voila.ip": _HOST, "Voila.port": port, "Voila.port_retries": 0, "Voila.token": token}
        options |= {"Voila.open_browser": False, "Voila.log_level": "ERROR"}
        server = app.Voila()
        server.initialize([str(notebook), *(f"--{name}={value}" for name, value in options.items())])
        server.tornado_settings = {"ws_ping_timeout": _PING}
        address = f"http://{_HOST}:{port}/?token={token}"
        _when_it_listens(lambda: _announce(address, browser))
        server.start()
    say("stopped")


def _free_port(port: int | None) -> int:
    """The port, or a free one for None."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_HOST, port or 0))
        except OSError as error:
            raise ValueError(f"`port` must be free, but {port} is not: {error.strerror}.") from None
        return probe.getsockname()[1]


def _when_it_listens(act: Callable[[], None]) -> None:
    """Calls `act` as soon as the loop of the server runs."""
    from tornado.ioloop import IOLoop

    IOLoop.current().add_callback(act)


def _announce(address: str, browser: bool) -> None:
    print(f"The explorer is at {address} until Ctrl-C.", flush=True)
    if browser:
        webbrowser.open(address)
