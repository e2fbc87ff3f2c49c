"""The built site in Chromium: every page on a telephone, dark and light; search; links.

CODEGEN_SITE=docs/_build/html pytest tests/test_site_browser.py
"""

from __future__ import annotations

import json
import os
import re
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

import pytest
from conftest import PROBLEMS

SITE = (PROBLEMS.parent / os.environ["CODEGEN_SITE"]) if "CODEGEN_SITE" in os.environ else None
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(SITE is None, reason="CODEGEN_SITE names no built site")
PAGES = sorted(path.relative_to(SITE).as_posix() for path in SITE.rglob("*.html")) if SITE else []
READ = [page for page in PAGES if page not in ("search.html", "genindex.html")]


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with ThreadingHTTPServer(("localhost", 0), partial(Quiet, directory=str(SITE))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="module")
def chromium():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed: apt-get install chromium")
    with playwright.sync_playwright() as started:
        launched = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield launched
        launched.close()


class Visit:
    """A page, with what goes wrong on it and what it asks of elsewhere."""

    def __init__(self, chromium, address, width, scheme):
        self.page = chromium.new_page(viewport={"width": width, "height": 844}, color_scheme=scheme)
        self.errors, self.outside = [], []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self.page.on("request", lambda request: self._requested(address, request.url))

    def _requested(self, address, url):
        if not url.startswith((address, "data:")):
            self.outside.append(url)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_page_fits_a_telephone_without_errors_and_asks_nothing_of_elsewhere(chromium, address, scheme):
    visit = Visit(chromium, address, 390, scheme)
    colours = set()
    for page in READ:
        visit.page.goto(address + page)
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 390, page
        colours.add(visit.page.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert visit.page.evaluate("[...document.images].filter((i) => !i.alt).length") == 0, f"{page}: no alt"
        assert (visit.errors, visit.outside) == ([], []), page
    assert len(colours) == 1
    light = sum(int(part) for part in colours.pop().removeprefix("rgb(").rstrip(")").split(",")) > 384
    assert light is (scheme == "light")
    visit.page.close()


def test_search_finds_a_saddle_point(chromium, address):
    visit = Visit(chromium, address, 1280, "light")
    visit.page.goto(address + "index.html")
    visit.page.keyboard.press("/")
    visit.page.fill("input.sidebar-search", "saddle point")
    visit.page.keyboard.press("Enter")
    visit.page.wait_for_selector("#search-results li a")
    found = visit.page.eval_on_selector_all("#search-results li a", "links => links.map(link => link.href)")
    assert any("guide/statuses.html" in link for link in found), found
    visit.page.goto(next(link for link in found if "guide/statuses.html" in link))
    assert "The point is stationary but not a minimum" in visit.page.inner_text("article")
    assert (visit.errors, visit.outside) == ([], [])
    visit.page.close()


@pytest.mark.parametrize("motion", ["no-preference", "reduce"])
def test_films_can_be_closed_and_stand_still_where_readers_want_nothing_to_move(chromium, address, motion):
    page = chromium.new_page(reduced_motion=motion)
    page.goto(address + "gallery/cart_pole.html")
    page.wait_for_selector("details[open] > summary")
    page.focus("details > summary")  # images are loaded once they come into view
    moves, stands = page.locator("img.film"), page.locator("img.still")
    shown, hidden = (moves, stands) if motion == "no-preference" else (stands, moves)
    shown.wait_for(state="visible")
    assert not hidden.is_visible()
    assert moves.get_attribute("alt").startswith("Film from t = 0 to 2. ")
    page.keyboard.press("Enter")
    assert not moves.is_visible()
    assert not stands.is_visible()
    page.close()


class Links(HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self, page):
        super().__init__()
        self.links, self.anchors = [], set()
        self.feed((SITE / page).read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors |= {given[key] for key in ("id", "name") if given.get(key)}
        wanted = {"a": "href", "img": "src", "link": "href", "script": "src"}.get(tag)
        if wanted and given.get(wanted):
            self.links.append(given[wanted])


def test_downloaded_notebooks_are_code_between_plain_markdown():
    notebooks = sorted((SITE / "_downloads").rglob("*.ipynb"))
    assert len(notebooks) >= 9
    for path in notebooks:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        assert text.startswith("# ")
        assert not re.search(r"\{[\w-]+\}`|^```\{|\]\((?!https?:)", text, re.MULTILINE), path
        assert sum(cell["cell_type"] == "code" for cell in cells) >= 3


def test_formulas_are_no_raw_text():
    for page in PAGES:
        assert "$$" not in (SITE / page).read_text(encoding="utf-8"), page


def test_links_hold():
    pages = {page: Links(page) for page in PAGES}
    for page, found in pages.items():
        for link in found.links:
            if "://" in link or link.startswith(("data:", "mailto:")):
                continue
            file, _, anchor = link.partition("#")
            target = ((SITE / page).parent / unquote(file.partition("?")[0])).resolve() if file else SITE / page
            assert target.exists(), (page, link)
            name = Path(target).relative_to(SITE.resolve() if file else SITE).as_posix()
            if anchor and name in pages:
                assert unquote(anchor) in pages[name].anchors, (page, link)
