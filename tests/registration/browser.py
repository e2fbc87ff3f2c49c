"""A server of the page in a process of its own, and a browser whose figures can be clicked in pixels of the image."""

import base64
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

from codegen.registration.formats import write_landmarks
from codegen.registration.images import write_image
from codegen.registration.pairs import LandmarkPairs

START = np.array([[14.0, 10.0], [80.0, 12.0], [16.0, 60.0], [78.0, 58.0], [46.0, 36.0]])
"""Landmarks of the moving image of `with_smooth_images`."""
SHAPE = (72, 96)
"""Height and width of both images."""
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def free_port():
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


@contextmanager
def server(state, *images, with_process=False, port=None):
    """The address of a running `codegen app`, and its process if that is wanted."""
    port = port or free_port()
    command = [sys.executable, "-m", "codegen", "app", *map(str, images), "--port", str(port), "--no-browser"]
    environment = os.environ | {"CODEGEN_STATE_DIR": str(state), "OPENBLAS_NUM_THREADS": "1"}
    log = Path(state).with_name(f"{Path(state).name}-{port}.log")
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
        yield (address, process) if with_process else address
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


PIXELS = """(({ width, height, data }) => {
  let text = ""
  for (let k = 0; k < data.length; k += 8192) text += String.fromCharCode(...data.subarray(k, k + 8192))
  return [width, height, btoa(text)] })"""
"""A function of an ImageData, whose result `pixels_of` reads: lists of numbers take minutes on their way."""
_OF_A_LAYER = f"""([root, layer]) => {{
  const canvas = document.querySelector(`${{root}} canvas.${{layer}}`)
  return {PIXELS}(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)) }}"""


def pixels_of(found):
    """An image, RGBA, shape (h, w, 4)."""
    width, height, text = found
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)


class Visit:
    """One visitor's page."""

    def __init__(self, browser, address, width=1280, height=800, **values):
        viewport = {"width": width, "height": height}
        self.context = browser.new_context(viewport=viewport, accept_downloads=True, **values)
        self.problems, self.outside, self.refused = [], [], []
        self.page = self.tab(address)

    def tab(self, address):
        """Another tab of the same visitor."""
        page = self.context.new_page()
        page.set_default_timeout(60_000)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("console", self._said)
        page.on("request", lambda request: self._requested(request.url))
        page.goto(address)
        # The page's policy forbids what wait_for_function does.
        for _ in range(1200):
            if page.evaluate("Boolean(window.__page?.model.images && location.search)"):
                return page
            page.wait_for_timeout(50)
        pytest.fail("the page never showed its images")

    def _said(self, said):
        if said.type == "error":
            (self.refused if "the server responded with a status of 4" in said.text else self.problems).append(
                said.text
            )

    def _requested(self, url):
        if not url.startswith(("http://localhost:", "ws://localhost:", "blob:", "data:")):
            self.outside.append(url)

    def pairs(self, page=None):
        """What the page holds: identity, places, name of every pair in their order."""
        return (page or self.page).evaluate("""() => { const { model } = window.__page
          return model.order.map((id) => model.pairs.get(id)) }""")

    def points(self, side):
        return [pair[side] for pair in self.pairs()]

    def pixels(self, pane, layer):
        """What a layer of a view shows, RGBA, shape (h, w, 4)."""
        return pixels_of(self.page.evaluate(_OF_A_LAYER, [f"#pane-{pane}", layer]))

    def until(self, what, seconds=60.0):
        """Wait until a function of this visit is true."""
        end = time.monotonic() + seconds
        while not what(self):
            assert time.monotonic() < end, "nothing happened"
            self.page.wait_for_timeout(50)

    def screen(self, pane, place, page=None):
        """Where on the screen a place of an image is."""
        return (page or self.page).evaluate(
            """([name, place]) => {
          const pane = window.__page.panes.find(({ root }) => root.id === `pane-${name}`)
          const box = pane.stage.getBoundingClientRect(), [x, y] = pane.viewport.toScreen(place)
          return [box.left + x, box.top + y] }""",
            [pane, [float(value) for value in place]],
        )

    def click(self, pane, place):
        self.page.mouse.click(*self.screen(pane, place))

    def drag(self, pane, start, shift, moves=8, hold=0, seconds=0.0, before_release=None):
        """Drag what is at a place of an image by so many pixels of the screen."""
        x, y = self.screen(pane, start)
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.wait_for_timeout(hold)
        for k in range(1, moves + 1):
            self.page.mouse.move(x + shift[0] * k / moves, y + shift[1] * k / moves)
            self.page.wait_for_timeout(1000 * seconds / moves)
        if before_release is not None:
            before_release()
        self.page.mouse.up()

    def menu(self, name):
        """Open a menu."""
        self.page.locator("summary", has_text=name).click()

    def upload(self, name, path):
        self.menu("File")
        with self.page.expect_file_chooser() as waiting:
            self.page.get_by_role("button", name=name).click()
        waiting.value.set_files(path)

    def download(self, name, folder):
        self.menu("File")
        with self.page.expect_download() as waiting:
            self.page.get_by_role("button", name=name, exact=True).click()
        path = folder / waiting.value.suggested_filename
        waiting.value.save_as(path)
        return path

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def wait_for(self, text):
        self.page.get_by_text(text).first.wait_for()


@contextmanager
def visiting(chromium, address):
    """A page without pairs, which in the end has had no error and no other server."""
    made = Visit(chromium, address)
    yield made
    assert made.problems == []
    assert made.outside == []
    made.context.close()


def with_pairs(visit, files):
    """A page with the five pairs of `with_smooth_images`, registered."""
    visit.upload("Open landmarks …", files / "pairs.csv")
    visit.until(lambda v: len(v.pairs()) == 5)
    visit.wait_for("no folding")
    return visit


def with_smooth_images(folder):
    """The folder with two smooth images in colour and five pairs of landmarks."""
    y, x = np.indices(SHAPE)
    for name, phase in (("moving", 0.0), ("fixed", 0.7)):
        layers = [127 + 120 * np.sin(x / a + phase) * np.cos(y / b) for a, b in ((5, 9), (11, 6), (8, 13))]
        write_image(folder / f"{name}.png", np.stack(layers, axis=-1).astype(np.uint8))
    moved = START + np.random.default_rng(3).normal(size=START.shape) * 3.0
    write_landmarks(folder / "pairs.csv", pairs=LandmarkPairs(START, moved))
    return folder
