"""The explorer in a browser: a headless Chromium, the notebook in JupyterLab and the page, a slider moved by the keyboard.

Skipped if no Chromium, no driver for it or no JupyterLab is found.
"""

import os
import pathlib
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

sync_api = pytest.importorskip("playwright.sync_api")
pytest.importorskip("jupyterlab")
pytest.importorskip("ipywidgets")

ROOT = pathlib.Path(__file__).parents[2]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
PATIENCE = 300e3  # milliseconds, for programs that are compiled on a busy machine

PIXELS = """async img => {
    const bytes = await (await fetch(img.src)).arrayBuffer();
    const digest = await crypto.subtle.digest("SHA-256", bytes);
    return Array.from(new Uint8Array(digest)).join(" ");
}"""
BEGUN = "() => !document.querySelector('.jp-CodeCell .jp-InputArea-prompt').textContent.includes('[ ]')"
IDLE = """() => {
    const prompts = [...document.querySelectorAll(".jp-CodeCell .jp-InputArea-prompt")].map(p => p.textContent);
    return prompts.length && prompts.every(text => /\\d/.test(text));
}"""


@pytest.fixture
def server(tmp_path):
    """The address of a Jupyter server with a copy of the notebook, and its token."""
    shutil.copy(ROOT / "notebooks" / "explorer.ipynb", tmp_path)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    token = secrets.token_hex(16)
    own = {f"JUPYTER_{name}_DIR": str(tmp_path / name) for name in ("CONFIG", "DATA", "RUNTIME")}
    environment = os.environ | own | {"PYTHONPATH": str(ROOT), "JUPYTER_TOKEN": token}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", "--ip=127.0.0.1", f"--port={port}"]
    command += ["--ServerApp.port_retries=0", f"--ServerApp.root_dir={tmp_path}"]
    command += [
        "--LabApp.extension_manager=readonly",
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate",
    ]
    with open(tmp_path / "server.log", "w", encoding="utf-8") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
        try:
            address = f"http://127.0.0.1:{port}"
            for _ in range(600):
                assert process.poll() is None, (tmp_path / "server.log").read_text(encoding="utf-8")
                try:
                    urllib.request.urlopen(f"{address}/api?token={token}", timeout=5).close()
                    break
                except (urllib.error.URLError, OSError):
                    time.sleep(0.2)
            yield address, token
        finally:
            process.terminate()
            process.wait(30)


def run_all(page):
    """Runs all cells from the menu, whose entry does nothing until the notebook is ready."""
    page.locator(".jp-MarkdownCell").first.click()
    for _ in range(60):
        time.sleep(1)
        page.get_by_role("menuitem", name="Run", exact=True).click()
        time.sleep(1)
        page.get_by_text("Run All Cells", exact=True).click()
        try:
            return page.wait_for_function(BEGUN, timeout=5000)
        except sync_api.TimeoutError:
            page.keyboard.press("Escape")
    raise AssertionError("the cells did not begin to run")


@pytest.fixture
def tab():
    """A tab of the browser, and the errors of its console."""
    complaints = []
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1200, "height": 1000})
        page.set_default_timeout(PATIENCE)
        # fonts from elsewhere are not asked for
        page.route(lambda url: "//127.0.0.1" not in url, lambda route: route.fulfill(body=""))
        page.on("console", lambda m: complaints.append(f"{m.text} ({m.location})") if m.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        yield page, complaints
        browser.close()


def screenshot(page, tmp_path, name):
    """Keeps a picture of the page for people, in a folder that they name."""
    folder = os.environ.get("DIELECTRIC_JAX_SCREENSHOTS", str(tmp_path))
    page.screenshot(path=f"{folder}/{name}.png", full_page=True)


def move_the_chamber(page):
    """Moves the slider of the chamber's volume by five keys; the story and the picture must follow."""
    picture = page.locator("img.widget-image").first
    picture.scroll_into_view_if_needed()
    story = page.locator(".widget-html").first
    handle = page.locator(".widget-slider:visible .noUi-handle").first
    before, source, told = picture.evaluate(PIXELS), picture.get_attribute("src"), story.inner_text()
    handle.focus()
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
    page.wait_for_function("old => document.querySelector('.widget-html').innerText !== old", arg=told)
    page.wait_for_function("old => document.querySelector('img.widget-image').src !== old", arg=source)
    assert picture.evaluate(PIXELS) != before
    return told


def test_a_slider_moved_by_the_keyboard_redraws_the_picture(server, tab, tmp_path):
    address, token = server
    page, complaints = tab
    page.goto(f"{address}/doc/tree/explorer.ipynb?token={token}")
    page.wait_for_selector(".jp-CodeCell")
    page.wait_for_selector('.jp-Notebook-ExecutionIndicator[data-status="idle"]', state="attached")
    run_all(page)
    page.wait_for_selector("img.widget-image", state="attached")
    page.wait_for_function(IDLE)
    assert page.locator('[data-mime-type="application/vnd.jupyter.stderr"]', has_text="Error").count() == 0
    assert "Snaps at Φ = 0.0765" in move_the_chamber(page)  # V_C = 1600, V_0 = 2.42, section 4 of the model
    screenshot(page, tmp_path, "notebook")
    assert not complaints


def test_the_page_answers_to_its_sliders_and_buttons(page, tab, tmp_path):
    (_, address), (tab, complaints) = page, tab
    tab.goto(address)
    tab.wait_for_selector("img.widget-image", state="attached")
    assert "Snaps at Φ = 0.0972" in move_the_chamber(tab)  # V_C = 800
    shape = tab.locator("img.widget-image").nth(2)
    source = shape.get_attribute("src")
    tab.get_by_role("button", name="landing", exact=True).click()
    tab.wait_for_function("old => document.querySelectorAll('img.widget-image')[2].src !== old", arg=source)
    tab.get_by_role("button", name="copy as code").click()
    tab.wait_for_function("() => document.querySelector('textarea').value.includes('scene = Scene(membrane, loading)')")
    screenshot(tab, tmp_path, "page")
    tab.get_by_role("button", name="reset").click()
    tab.wait_for_function("() => document.querySelector('.widget-html').innerText.includes('Φ = 0.0972')")
    tab.get_by_role("textbox", name="file").fill("seen.png")
    tab.get_by_role("button", name="save picture").click()
    tab.wait_for_function("() => document.querySelector('.widget-html').innerText.startsWith('Saved')")
    assert (tmp_path / "seen.png").read_bytes().startswith(b"\x89PNG")
    assert not complaints
