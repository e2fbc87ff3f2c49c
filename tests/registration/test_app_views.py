"""Views of the real page in a real browser: ways of comparing, zoom, the flow, and their share of the screen."""

import numpy as np
import pytest
from browser import PIXELS, SHAPE, Visit, browser, pixels_of, server, visiting, with_pairs, with_smooth_images

from codegen.registration.images import read_image

pytest.importorskip("tornado", reason="tornado is not installed")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return with_smooth_images(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def chromium():
    with browser() as started:
        yield started


@pytest.fixture(scope="module")
def address(chromium, solver, files):
    with server(files / "state", files / "moving.png", files / "fixed.png") as address:
        yield address


@pytest.fixture
def visit(chromium, address):
    with visiting(chromium, address) as made:
        yield made


@pytest.fixture
def loaded(visit, files):
    return with_pairs(visit, files)


def test_ways_of_comparing_show_what_they_say(loaded):
    visit, mode = loaded, loaded.page.get_by_label("What the fixed view shows")
    shown = visit.page.locator("#pane-fixed .stage")
    seen = []
    for choice in ("fixed", "warped", "overlay", "colours", "difference", "checkerboard", "areas"):
        mode.select_option(choice)
        if choice == "warped":
            visit.until(lambda v: v.pixels("fixed", "warped").any())
        visit.page.wait_for_timeout(300)
        seen.append(shown.screenshot())
    assert len(set(seen)) == len(seen)
    mode.select_option("flicker")
    still = shown.screenshot()
    visit.until(lambda v: shown.screenshot() != still)
    visit.until(lambda v: shown.screenshot() == still)
    # Half of the squares of the checkerboard are left to the image below.
    mode.select_option("warped")
    visit.until(lambda v: v.pixels("fixed", "warped")[..., 3].mean() > 100)
    full = visit.pixels("fixed", "warped")[..., 3].mean()
    mode.select_option("checkerboard")
    visit.until(lambda v: abs(v.pixels("fixed", "warped")[..., 3].mean() / full - 0.5) < 0.1)


def test_views_are_zoomed_and_linked_by_the_map_or_free(loaded):
    visit, page = loaded, loaded.page
    zoom = "window.__page.panes.map((pane) => pane.viewport.zoom)"
    whole = page.evaluate(zoom)
    pair = visit.pairs()[4]
    page.mouse.move(*visit.screen("moving", pair["moving"]))
    for _ in range(8):
        page.mouse.wheel(0, -100)
    visit.until(lambda v: v.page.evaluate(zoom)[0] > 5 * whole[0])
    before = visit.screen("moving", pair["moving"])
    page.get_by_label("Next landmark").click()  # the first one, which is centred in both
    for pane in ("moving", "fixed"):
        box = page.locator(f"#pane-{pane} .stage").bounding_box()
        place = visit.screen(pane, visit.points(pane)[0])
        np.testing.assert_allclose(place, [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2], atol=0.6)
    # Shifted by its own image, the other view shows where the map has the same place.
    page.keyboard.press("Escape")
    beside = visit.points("moving")[0] + np.array([2.0, 2.0])
    visit.drag("moving", beside, (-60.0, -30.0))
    page.wait_for_timeout(300)
    shown = """(() => { const { panes, model } = window.__page, here = panes[0].viewport.centre
      return [here, panes[1].viewport.centre, model.across("moving", here), Boolean(model.chart)] })()"""
    here, there, expected, charted = page.evaluate(shown)
    assert charted
    np.testing.assert_allclose(there, expected, atol=1e-6)
    assert np.hypot(*np.subtract(here, there)) > 0.5
    page.locator("#link").click()
    visit.drag("moving", beside, (-40.0, 0.0))
    page.wait_for_timeout(300)
    assert page.evaluate(shown)[1] == there != page.evaluate(shown)[0]
    page.get_by_role("button", name="Fit", exact=True).click()
    np.testing.assert_allclose(page.evaluate(zoom)[:2], whole[:2], rtol=0.02)
    assert visit.screen("moving", pair["moving"]) != before


def test_at_the_start_of_the_flow_the_warped_image_is_the_moving_one(loaded, files):
    page = loaded.page
    page.get_by_label("What the fixed view shows").select_option("warped")
    loaded.menu("View")
    slider = page.locator("#time")
    slider.focus()
    slider.press("Home")
    frame = "(window.__page.panes[1].frame ?? {}).time"
    loaded.until(lambda v: v.page.evaluate(frame) == 0)
    found = loaded.page.evaluate(f"""() => {{ const {{ bitmap }} = window.__page.panes[1].frame
      const canvas = new OffscreenCanvas(bitmap.width, bitmap.height), pen = canvas.getContext("2d")
      pen.drawImage(bitmap, 0, 0)
      return {PIXELS}(pen.getImageData(0, 0, bitmap.width, bitmap.height)) }}""")
    seen = pixels_of(found)[..., :3].astype(float)
    expected = read_image((files / "moving.png").read_bytes()).pixels
    rows, columns = (np.linspace(0, n, k, endpoint=False) + n / k / 2 - 0.5 for n, k in zip(SHAPE, seen.shape))
    exact = expected[np.ix_(rows.round().astype(int), columns.round().astype(int))]
    assert np.abs(seen - exact).mean() < 6.0  # interpolated there, nearest here


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (800, 600), (768, 1024), (1024, 768)])
def test_images_get_the_screen(chromium, address, width, height):
    """Of the window, both images have more than half; nothing has to be scrolled but the table."""
    visit = Visit(chromium, address, width, height, has_touch=width in (768, 1024))
    boxes = [visit.page.locator(f"#pane-{name} .stage").bounding_box() for name in ("moving", "fixed")]
    share = sum(box["width"] * box["height"] for box in boxes) / (width * height)
    assert share > 0.45 if height == 600 else share > 0.55
    assert visit.page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == [
        width, height,
    ]  # fmt: skip
    outside = visit.page.evaluate("""() => [...document.querySelectorAll(".bar button, .bar summary, .head button")]
      .filter((node) => node.checkVisibility()).filter((node) => {
        const box = node.getBoundingClientRect()
        return box.left < 0 || box.right > innerWidth || box.bottom > innerHeight }).map((node) => node.textContent)""")
    assert outside == []
    assert visit.problems == []
    visit.context.close()
