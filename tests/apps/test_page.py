"""The explorer as a page: the command serves it, the explorer runs in its kernel, and Ctrl-C ends all of it."""

import re
import signal
import socket
import sys
import urllib.request

import pytest

import dielectric_jax as dj
from dielectric_jax.apps import explorer_page
from dielectric_jax.apps.cli import main


def test_the_page_shows_the_widgets_of_a_kernel_and_ends_with_ctrl_c(page, tmp_path):
    process, address = page
    with urllib.request.urlopen(address, timeout=300) as answer:
        text = answer.read().decode()
    (view,) = re.findall(r'"application/vnd.jupyter.widget-view\+json": \{"model_id": "(\w+)"', text)
    assert view and "Traceback" not in text
    with urllib.request.urlopen(address.partition("?")[0], timeout=60) as answer:  # without the secret
        assert "/login" in answer.url and view not in answer.read().decode()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0 and "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_the_page_begins_with_the_scene():
    scene = dj.Scene(dj.Membrane(dj.Gent(90.0)), dj.Chamber(volume=800.0, initial_volume=2.0))
    (cell,) = explorer_page.page_of(scene, "/folder")["cells"]
    lines = cell["source"].splitlines()
    assert "os.chdir('/folder')" in lines and "loading = Chamber(volume=800.0, initial_volume=2.0)" in lines


@pytest.mark.parametrize(
    ("argv", "loading"),
    [
        ([], dj.Chamber(volume=1600.0, initial_volume=2.42)),
        (["--pressure", "1.5"], dj.ConstantPressure(1.5)),
        (["--chamber-volume", "9", "--initial-pressure", "1"], dj.Chamber(volume=9.0, initial_pressure=1.0)),
        (["--si", "--pressure", "1500"], dj.ConstantPressure(0.75)),
    ],
)
def test_the_options_are_where_the_sliders_begin(monkeypatch, argv, loading):
    served = []
    monkeypatch.setattr(explorer_page, "serve", lambda scene, **options: served.append((scene, options)))
    assert main(["explore", *argv, "--stretch-limit", "90", "--port", "8000"]) == 0
    ((scene, options),) = served
    assert repr(scene.loading) == repr(loading) and float(scene.membrane.material.stretch_limit) == 90.0
    assert options == {"port": 8000, "browser": True} and (scene.units is not None) == ("--si" in argv)


def test_a_port_in_use_is_refused(capsys):
    pytest.importorskip("voila")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert main(["explore", "--port", str(port)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"dielectric-jax: --port must be free, but {port} is not") and said.count("\n") == 1


def test_without_voila_one_sentence_names_the_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "voila.app", None)
    assert main(["explore"]) == 2
    assert (
        '`voila` must be installed for this, but is not: pip install "dielectric-jax[interactive]"'
        in capsys.readouterr().err
    )
