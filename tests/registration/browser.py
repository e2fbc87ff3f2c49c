"""A server of the page in a process of its own, and a browser whose figures can be clicked in pixels of the image."""

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

_MODEL = "const model = Bokeh.documents[0].get_model_by_name(name), view = Bokeh.index.find_one(model);"
_SCREEN = f"""([name, x, y]) => {{ {_MODEL}
  const frame = view.frame, box = view.el.getBoundingClientRect();
  return [box.left + frame.x_scale.compute(x), box.top + frame.y_scale.compute(y)] }}"""
_POINTS = f"""(name) => {{ {_MODEL}
  const get = (data, key) => Array.from(data.get ? data.get(key) : data[key]);
  const data = model.renderers.map((r) => r.data_source.data).find((d) => d.edition ?? d.get?.("edition"));
  return get(data, "x").map((x, k) => [x, get(data, "y")[k], get(data, "id")[k]]) }}"""


def free_port():
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


@contextmanager
def server(state, *images):
    """The address of a running `codegen app`."""
    port = free_port()
    command = [sys.executable, "-m", "codegen", "app", *map(str, images), "--port", str(port), "--no-browser"]
    environment = os.environ | {"CODEGEN_STATE_DIR": str(state), "OPENBLAS_NUM_THREADS": "1"}
    log = Path(state).with_suffix(".log")
    with log.open("w") as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
    address = f"http://localhost:{port}/"
    try:
        for _ in range(600):
            assert process.poll() is None, log.read_text()
            try:
                urllib.request.urlopen(address, timeout=30).close()
                break
            except OSError:
                time.sleep(0.2)
        yield address
    finally:
        process.terminate()
        process.wait(timeout=30)


@contextmanager
def browser():
    """A headless Chromium; skips where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    with playwright.sync_playwright() as started:
        launched = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield launched
        launched.close()


_IMAGE = f"""(name) => {{ {_MODEL}
  const source = model.renderers[0].data_source, image = source.get_column("image")[0]
  return [image.shape, Array.from(new Uint8Array(image.buffer, image.byteOffset, 4 * image.length))] }}"""
_COLUMN = f"""([name, column]) => {{ {_MODEL}
  return Array.from(model.renderers[0].data_source.get_column(column)).map((values) => Array.from(values)) }}"""
_DRAWN = f"(name) => {{ {_MODEL} return model.renderers.filter((r) => r.visible).map((r) => r.glyph.type) }}"


class Visit:
    """One visitor's page."""

    def __init__(self, browser, address, width=1280, height=800):
        self.context = browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True)
        self.page = self.context.new_page()
        self.page.set_default_timeout(60_000)
        self.problems, self.outside = [], []
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("console", lambda said: self.problems.append(said.text) if said.type == "error" else None)
        self.page.on("request", lambda request: self._requested(request.url))
        self.page.goto(address)
        self.page.wait_for_function("Bokeh?.documents?.[0]?.is_idle")

    def _requested(self, url):
        if not url.startswith(("http://localhost:", "ws://localhost:", "blob:", "data:")):
            self.outside.append(url)

    def points(self, figure):
        return self.page.evaluate(_POINTS, figure)

    def image(self, figure):
        """The image that a figure shows, RGBA, shape (h, w, 4)."""
        shape, values = self.page.evaluate(_IMAGE, figure)
        return np.array(values, np.uint8).reshape(*shape, 4)

    def columns(self, figure, name):
        """A column of the table behind a figure's image."""
        return self.page.evaluate(_COLUMN, [figure, name])

    def drawn(self, figure):
        """What a figure draws, from back to front: kinds of glyphs that are visible."""
        return self.page.evaluate(_DRAWN, figure)

    def until(self, what, seconds=60.0):
        """Wait until a function of this visit is true."""
        from playwright.sync_api import Error

        def seen():
            try:
                return what(self)
            except Error:  # figures are being replaced
                return False

        end = time.monotonic() + seconds
        while not seen():
            assert time.monotonic() < end, "nothing happened"
            self.page.wait_for_timeout(50)

    def screen(self, figure, x, y):
        """Where on the screen a point of a figure is, once the page's layout stands still."""
        before, place = None, self.page.evaluate(_SCREEN, [figure, x, y])
        while place != before:
            self.page.wait_for_timeout(100)
            before, place = place, self.page.evaluate(_SCREEN, [figure, x, y])
        return place

    def click(self, figure, x, y):
        self.page.mouse.click(*self.screen(figure, x, y))

    def drag(self, figure, start, stop, moves=8, before_release=None):
        (x0, y0), (x1, y1) = self.screen(figure, *start), self.screen(figure, *stop)
        self.page.mouse.move(x0, y0)
        self.page.mouse.down()
        for k in range(1, moves + 1):
            self.page.mouse.move(x0 + (x1 - x0) * k / moves, y0 + (y1 - y0) * k / moves)
            self.page.wait_for_timeout(60)
        if before_release is not None:
            before_release()
        self.page.mouse.up()

    def upload(self, label, path):
        self.page.locator(f'input[type=file][aria-label="{label}"]').set_input_files(path)

    def download(self, name, folder):
        with self.page.expect_download() as waiting:
            self.page.get_by_role("button", name=name, exact=True).click()
        path = folder / waiting.value.suggested_filename
        waiting.value.save_as(path)
        return path

    def box(self, label):
        """A checkbox."""
        return self.page.locator(f'input[type=checkbox]:has(+ :text-is("{label}"))')

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def wait_for(self, text):
        self.page.get_by_text(text).first.wait_for()
