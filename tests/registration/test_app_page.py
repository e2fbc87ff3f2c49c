"""The real page in a real browser, against a real server."""

import numpy as np
import pytest
from browser import SHAPE, START, Visit, browser, free_port, server, visiting, with_pairs, with_smooth_images
from typer.testing import CliRunner

from codegen.cli import main
from codegen.registration.app.reading import LIMITS
from codegen.registration.formats import read_landmarks, write_landmarks
from codegen.registration.noise import choose_sigma
from codegen.registration.pairs import LandmarkPairs

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


@pytest.mark.parametrize(
    "how", [{"moves": 1}, {"moves": 20, "seconds": 1.0}, {"moves": 1, "hold": 500}], ids=["at once", "slowly", "held"]
)
def test_a_point_follows_the_pointer_from_the_first_pixel_at_any_speed(loaded, how):
    seen = {}
    for pixels in (1, 2, 5, 20):
        for pane in ("moving", "fixed"):
            x, y = loaded.screen(pane, loaded.points(pane)[4])
            loaded.drag(pane, loaded.points(pane)[4], (pixels, -pixels), **how)
            seen[pane] = loaded.screen(pane, loaded.points(pane)[4])
            np.testing.assert_allclose(seen[pane], [x + pixels, y - pixels], atol=0.05)
        # The server has the same place, and so has a page that is loaded again, which shows it where it was.
        kept = loaded.points("fixed")[4]
        loaded.until(lambda v: v.page.evaluate("window.__page.link.unsaved") == 0)
        loaded.page.reload()
        loaded.until(lambda v: v.page.evaluate("!!window.__page?.model.images") and len(v.pairs()) == 5)
        assert loaded.points("fixed")[4] == kept
        loaded.until(lambda v: all(np.allclose(v.screen(p, v.points(p)[4]), seen[p], atol=0.05) for p in seen))


def test_pairs_are_added_dragged_undone_saved_and_exported_as_the_command_line_does(loaded, files, tmp_path):
    visit, page = loaded, loaded.page
    visit.click("moving", (30.0, 24.0))
    visit.until(lambda v: len(v.pairs()) == 6)
    assert visit.pairs()[5]["guessed"] == "fixed"
    guess = visit.points("fixed")[5]
    visit.click("fixed", (guess[0] + 9.0, guess[1] - 7.0))
    visit.until(lambda v: v.pairs()[5]["guessed"] is None)
    assert len(visit.pairs()) == 6
    np.testing.assert_allclose(visit.points("fixed")[5], [guess[0] + 9.0, guess[1] - 7.0], atol=0.2)

    page.get_by_label("What the fixed view shows").select_option("warped")
    visit.until(lambda v: v.pixels("fixed", "warped").any())
    placed, still = visit.points("fixed")[5], visit.pixels("fixed", "warped")
    followed = []
    visit.drag(
        "fixed", placed, (-40.0, 50.0), seconds=0.5,
        before_release=lambda: followed.append(
            visit.until(lambda v: not np.array_equal(v.pixels("fixed", "warped"), still))
        ),
    )  # fmt: skip
    assert followed == [None]  # the warped image followed before the button was released
    dragged = visit.points("fixed")[5]
    page.keyboard.press("Control+z")
    visit.until(lambda v: v.points("fixed")[5] == placed)
    page.keyboard.press("Control+Shift+z")
    visit.until(lambda v: v.points("fixed")[5] == dragged)
    visit.click("moving", START[0])
    page.keyboard.press("Delete")
    visit.until(lambda v: len(v.pairs()) == 5)
    visit.press("Undo")
    visit.until(lambda v: len(v.pairs()) == 6)
    visit.wait_for("no folding")

    image, landmarks = visit.download("Save warped image", tmp_path), visit.download("Save landmarks", tmp_path)
    assert read_landmarks(landmarks).fixed[5] == pytest.approx(dragged, abs=0)
    out = tmp_path / "by_command.png"
    command = ["warp", files / "moving.png", "--fixed", files / "fixed.png", "--landmarks", landmarks, "--out", out]
    done = CliRunner().invoke(main, [str(word) for word in command])
    assert done.exit_code == 0, done.output
    assert image.read_bytes() == out.read_bytes()
    for kind, suffix in (("Save displacement field", ".npz"), ("Save animated GIF", ".gif")):
        assert visit.download(kind, tmp_path).suffix == suffix


def test_the_whole_work_is_done_with_keys(visit, files, tmp_path):
    page, press = visit.page, visit.page.keyboard.press

    def reach(name):
        """Go on with Tab until a control of that name has the focus."""
        for _ in range(60):
            named = "document.activeElement.getAttribute('aria-label') ?? document.activeElement.textContent.trim()"
            if page.evaluate(named).startswith(name):
                return
            press("Tab")
        pytest.fail(f"Tab never came to {name}")

    for k in range(3):
        reach("Moving image")
        press("Escape")
        for _ in range(4 * k + 2):
            press("ArrowRight" if k else "ArrowLeft")
            press("ArrowDown")
        press("Enter")
        visit.until(lambda v, k=k: len(v.pairs()) == k + 1)
        press("o")
        before = visit.points("fixed")[k]
        for key in ("ArrowRight", "ArrowRight", "ArrowUp", "Shift+ArrowUp"):
            press(key)
        np.testing.assert_allclose(visit.points("fixed")[k], [before[0] + 2.0, before[1] - 1.1], atol=1e-9)
    visit.wait_for("no folding")
    press("n")
    press("d")
    visit.until(lambda v: [pair["active"] for pair in v.pairs()] == [False, True, True])
    press("d")
    visit.until(lambda v: all(pair["active"] for pair in v.pairs()))
    press("n")
    press("Delete")
    visit.until(lambda v: len(v.pairs()) == 2)
    press("Control+z")
    visit.until(lambda v: len(v.pairs()) == 3)
    for key, mode in (("2", "warped"), ("6", "difference"), ("1", "fixed")):
        press(key)
        visit.until(lambda v, mode=mode: v.page.locator("#pane-fixed .mode").input_value() == mode)
    # Tab goes through the table and leaves it.
    press("f")
    assert page.evaluate("document.activeElement.id") == "search"
    for _ in range(20):
        press("Tab")
        if page.evaluate("!document.querySelector('#drawer').contains(document.activeElement)"):
            break
    else:
        pytest.fail("Tab never left the table")
    # The browser's own controls come next; from the top, the menus.
    page.evaluate("document.activeElement.blur()")
    reach("File")
    press("Enter")
    reach("Save landmarks")
    with page.expect_download() as waiting:
        press("Enter")
    waiting.value.save_as(tmp_path / "by_keys.csv")
    assert len(read_landmarks(tmp_path / "by_keys.csv")) == 3


def test_every_control_image_and_layer_has_a_name(loaded):
    unnamed = loaded.page.evaluate("""() => [...document.querySelectorAll(
        "button, input, select, summary, [tabindex], [role=application], table, section")].filter((node) => {
      const label = node.labels?.[0]?.textContent.trim() || node.getAttribute("aria-label") || node.textContent.trim()
      return !label && node.id !== "chooser" }).map((node) => node.outerHTML)""")
    assert unnamed == []
    # Layers are drawings of what the named image shows, and no part of the tree that is read aloud.
    assert loaded.page.evaluate("[...document.querySelectorAll('canvas')].every((c) => c.ariaHidden === 'true')")
    assert "5 landmarks" in loaded.page.locator("#pane-moving .stage").get_attribute("aria-label")


def test_the_table_edits_names_and_places_finds_deactivates_and_deletes(loaded):
    visit, page = loaded, loaded.page
    page.get_by_label("Name of landmark 3").fill("<b>eye</b> & fin")
    page.keyboard.press("Enter")
    visit.until(lambda v: v.pairs()[2]["name"] == "<b>eye</b> & fin")
    field = page.get_by_label("moving x of landmark <b>eye</b> & fin")
    field.fill("17.25")
    field.press("Enter")
    visit.until(lambda v: v.points("moving")[2] == [17.25, 60.0])
    field = page.get_by_label("moving x of landmark 4")
    field.fill("nonsense")
    field.press("Enter")
    page.get_by_role("alert").get_by_text("is no number").wait_for()
    assert visit.points("moving")[3] == [78.0, 58.0]
    page.locator("#search").fill("EYE")
    visit.until(lambda v: v.page.locator("#drawer tbody tr:not(.spacer)").count() == 1)
    page.locator("#search").press("Enter")
    visit.until(lambda v: v.page.evaluate("window.__page.model.selected") == v.pairs()[2]["id"])
    page.get_by_label("Active: <b>eye</b> & fin").uncheck()
    visit.until(lambda v: not v.pairs()[2]["active"])
    visit.until(lambda v: "4 pairs" in v.page.locator("#state").inner_text())
    page.get_by_label("Delete landmark <b>eye</b> & fin").click()
    visit.until(lambda v: len(v.pairs()) == 4)
    assert page.locator("#drawer tbody b").count() == 0  # a name is never markup


def test_thousands_of_pairs_are_shown_and_found(visit, tmp_path):
    rng = np.random.default_rng(0)
    places = rng.random((1200, 2)) * [90.0, 66.0]
    names = tuple(f"mark {k}" for k in range(1200))
    write_landmarks(tmp_path / "many.csv", pairs=LandmarkPairs(places, places, names))
    visit.upload("Open landmarks …", tmp_path / "many.csv")
    visit.until(lambda v: len(v.pairs()) == 1200)
    assert visit.page.locator("#drawer tbody tr").count() < 100
    visit.page.locator("#search").fill("mark 1177")
    visit.page.locator("#search").press("Enter")
    visit.until(lambda v: v.page.evaluate("window.__page.model.selected") == v.pairs()[1177]["id"])
    visit.press("Undo")
    visit.until(lambda v: v.pairs() == [])


def test_two_tabs_on_one_work_never_lose_an_edit(loaded):
    other = loaded.tab(loaded.page.url)
    loaded.until(lambda v: len(v.pairs(other)) == 5)
    box = loaded.screen("fixed", loaded.points("fixed")[0])
    loaded.page.mouse.move(*box)
    loaded.page.mouse.down()
    loaded.page.mouse.move(box[0] + 15, box[1] + 5)
    # While one tab drags a point, the other drags another and renames a third.
    x, y = loaded.screen("fixed", loaded.points("fixed")[1], other)
    other.mouse.move(x, y)
    other.mouse.down()
    other.mouse.move(x - 9, y + 4)
    other.mouse.up()
    other.get_by_label("Name of landmark 3").fill("third")
    other.get_by_label("Name of landmark 3").press("Enter")
    loaded.page.mouse.move(box[0] + 30, box[1] + 10)
    loaded.page.mouse.up()
    loaded.until(lambda v: v.pairs()[2]["name"] == "third" and v.pairs() == v.pairs(other))
    np.testing.assert_allclose(loaded.screen("fixed", loaded.points("fixed")[0]), [box[0] + 30, box[1] + 10], atol=0.05)
    np.testing.assert_allclose(loaded.screen("fixed", loaded.points("fixed")[1], other), [x - 9, y + 4], atol=0.05)
    other.close()


def test_edits_without_a_server_are_sent_when_there_is_one_again(chromium, solver, files, tmp_path):
    """The server is killed while the page is used, and another one takes its place."""
    port, images = free_port(), (files / "moving.png", files / "fixed.png")
    with server(tmp_path / "state", *images, port=port, with_process=True) as (address, process):
        visit = Visit(chromium, address)
        visit.click("moving", (20.0, 20.0))
        visit.until(lambda v: len(v.pairs()) == 1 and v.page.evaluate("window.__page.link.unsaved") == 0)
        process.kill()
        visit.until(lambda v: "no connection" in v.page.locator("#saved").inner_text())
        visit.drag("fixed", visit.points("fixed")[0], (11.0, 7.0))
        put = visit.points("fixed")[0]
        visit.click("moving", (60.0, 40.0))
        visit.until(lambda v: "2 edits wait" in v.page.locator("#saved").inner_text())
    with server(tmp_path / "state", *images, port=port):
        visit.until(lambda v: v.page.locator("#saved").inner_text() == "saved" and len(v.pairs()) == 2)
        other = visit.tab(visit.page.url)
        visit.until(lambda v: v.pairs(other) == v.pairs())
        assert visit.points("fixed")[0] == put
        visit.context.close()


def test_what_is_shown_can_be_chosen_and_one_image_can_be_bent(visit, files, tmp_path):
    page, pairs = visit.page, read_landmarks(files / "pairs.csv")
    halves = [tmp_path / "fixed.pts", tmp_path / "moving.pts"]
    write_landmarks(*halves[::-1], pairs=pairs)
    visit.upload("Open landmarks …", halves[:1])
    page.get_by_role("alert").get_by_text("together").wait_for()
    visit.upload("Open landmarks …", halves)
    page.get_by_text("moving.pts was taken for the moving image").wait_for()
    np.testing.assert_array_equal(visit.points("moving"), pairs.moving)
    visit.wait_for("no folding")
    visit.menu("Registration")
    visit.press("Estimate sigma")
    best = round(choose_sigma(pairs, SHAPE, fixed_shape=SHAPE), 3)
    visit.until(lambda v: float(v.page.locator("#sigma").input_value()) == best)

    visit.upload("Bend one image …", files / "moving.png")
    visit.until(lambda v: v.pairs() == [] and v.page.locator("#pane-fixed").is_hidden())
    visit.until(lambda v: v.pixels("result", "warped").any())
    still = visit.pixels("result", "warped")
    visit.click("moving", (40.0, 30.0))
    visit.until(lambda v: len(v.pairs()) == 1)
    visit.drag("result", visit.points("fixed")[0], (60.0, 20.0))
    visit.until(lambda v: not np.array_equal(v.pixels("result", "warped"), still))
    np.testing.assert_allclose(visit.points("moving")[0], (40.0, 30.0), atol=0.3)
    visit.upload("Open fixed image …", files / "fixed.png")
    visit.until(lambda v: v.page.locator("#pane-fixed").is_visible())


def test_what_cannot_be_opened_is_refused_and_the_session_goes_on(chromium, address, files, tmp_path):
    visit = Visit(chromium, address, width=400, height=800)
    (tmp_path / "large.png").write_bytes(bytes(LIMITS.bytes + 1))
    (tmp_path / "cut.png").write_bytes((files / "moving.png").read_bytes()[:300])
    (tmp_path / "words.csv").write_text("one,two\nthree,four\n")
    (tmp_path / "<img src=x onerror=alert(1)>.png").write_bytes(b"no image")
    wrong = [
        ("Open moving image …", "large.png"),
        ("Open fixed image …", "cut.png"),
        ("Open moving image …", "<img src=x onerror=alert(1)>.png"),
        ("Open landmarks …", "words.csv"),
    ]
    said = visit.page.locator("#alert span")
    for label, name in wrong:
        before = said.inner_text() if said.is_visible() else ""
        visit.upload(label, tmp_path / name)
        visit.until(lambda v, before=before: said.is_visible() and said.inner_text() not in ("", before))
    assert visit.page.locator("img").count() == 0
    visit.upload("Open landmarks …", files / "pairs.csv")
    visit.until(lambda v: len(v.pairs()) == 5)
    visit.until(lambda v: v.page.get_by_role("alert").count() == 0)
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= 400  # nothing sticks out of a narrow window
    assert visit.problems == []
    assert len(visit.refused) == 3  # the browser's own note on each answer; the large file is not even sent
    visit.context.close()
