"""The real page in a real browser, against a real server."""

import http.client
import socket
import urllib.error
import urllib.request
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import Visit, browser, server
from typer.testing import CliRunner

from codegen.cli import main
from codegen.registration import LandmarkPairs
from codegen.registration.app.reading import LIMITS
from codegen.registration.formats import read_landmarks, write_landmarks
from codegen.registration.images import read_image, write_image
from codegen.registration.noise import choose_sigma

pytest.importorskip("panel", reason="panel is not installed")
pytest.importorskip("bokeh", reason="bokeh is not installed")

START = np.array([[14.0, 10.0], [80.0, 12.0], [16.0, 60.0], [78.0, 58.0], [46.0, 36.0]])
SHAPE = (72, 96)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two smooth images in colour and five pairs of landmarks."""
    folder = tmp_path_factory.mktemp("page")
    y, x = np.indices(SHAPE)
    for name, phase in (("moving", 0.0), ("fixed", 0.7)):
        layers = [127 + 120 * np.sin(x / a + phase) * np.cos(y / b) for a, b in ((5, 9), (11, 6), (8, 13))]
        write_image(folder / f"{name}.png", np.stack(layers, axis=-1).astype(np.uint8))
    moved = START + np.random.default_rng(3).normal(size=START.shape) * 3.0
    write_landmarks(folder / "pairs.csv", pairs=LandmarkPairs(START, moved))
    return folder


@pytest.fixture(scope="module")
def address(solver, files):
    with server(files / "state", files / "moving.png", files / "fixed.png") as address:
        yield address


@pytest.fixture(scope="module")
def chromium():
    with browser() as started:
        yield started


def test_pairs_are_added_dragged_undone_saved_and_exported_as_the_command_line_does(chromium, address, files, tmp_path):
    visit = Visit(chromium, address)
    visit.wait_for("no pairs yet")
    visit.upload("Load landmarks", files / "pairs.csv")
    visit.until(lambda v: len(v.points("fixed")) == 5)
    visit.wait_for("no folding")

    visit.click("moving", 30.0, 24.0)
    visit.until(lambda v: len(v.points("fixed")) == 6 and v.points("moving")[5][2])
    guess = visit.points("fixed")[5]
    visit.click("fixed", guess[0] + 9.0, guess[1] - 7.0)
    visit.until(lambda v: v.points("fixed")[5][0] > guess[0] + 8.0 and v.points("fixed")[5][2])
    assert len(visit.points("moving")) == 6

    placed = visit.points("fixed")[5][:2]
    target = [guess[0] + 3.0, guess[1] + 2.0]
    seen = visit.page.locator("canvas").last
    still = seen.screenshot()
    moved = []
    visit.drag(
        "fixed", placed, target, before_release=lambda: moved.append(visit.until(lambda v: seen.screenshot() != still))
    )
    assert moved == [None]  # the warped image followed before the button was released
    visit.until(lambda v: np.hypot(*np.subtract(v.points("fixed")[5][:2], target)) < 1.0)
    dragged = visit.points("fixed")[5]

    visit.page.keyboard.press("Control+z")
    visit.until(lambda v: v.points("fixed")[5][:2] == placed)
    visit.page.keyboard.press("Control+Shift+z")
    visit.until(lambda v: v.points("fixed")[5][:2] == dragged[:2])
    visit.click("moving", START[0, 0], START[0, 1])
    visit.press("Delete pair")
    visit.until(lambda v: len(v.points("moving")) == 5)
    visit.press("Undo")
    visit.until(lambda v: len(v.points("moving")) == 6)
    visit.wait_for("no folding")

    visit.page.wait_for_timeout(300)
    assert "work=" in visit.page.url
    visit.page.reload()
    visit.until(lambda v: v.page.evaluate("!!Bokeh?.documents?.[0]?.is_idle") and len(v.points("fixed")) == 6)
    np.testing.assert_array_equal(visit.points("fixed")[5][:2], dragged[:2])
    visit.wait_for("no folding")

    result = visit.page.locator("canvas").last
    for mode in ("Blink", "Checkerboard", "Blend", "Areas"):
        still = result.screenshot()
        visit.press(mode)
        visit.until(lambda v, still=still: result.screenshot() != still)
    visit.press("Blink")
    visit.page.wait_for_timeout(300)
    still = result.screenshot()
    visit.until(lambda v: result.screenshot() != still)

    image, landmarks = visit.download("Warped image", tmp_path), visit.download("Landmarks", tmp_path)
    assert read_landmarks(landmarks).fixed[5] == pytest.approx(dragged[:2], abs=0)
    out = tmp_path / "by_command.png"
    command = ["warp", files / "moving.png", "--fixed", files / "fixed.png", "--landmarks", landmarks, "--out", out]
    command += ["--align", "similarity"]  # which is the page's own
    done = CliRunner().invoke(main, [str(word) for word in command])
    assert done.exit_code == 0, done.output
    assert image.read_bytes() == out.read_bytes()
    for kind, suffix in (("Field", ".npz"), ("Animated GIF", ".gif")):
        assert visit.download(kind, tmp_path).suffix == suffix
    assert visit.problems == []
    assert visit.outside == []  # the page needs no other server
    visit.context.close()


def test_what_is_shown_can_be_chosen_and_one_image_can_be_bent(chromium, address, files, tmp_path):
    visit = Visit(chromium, address)
    page, pairs = visit.page, read_landmarks(files / "pairs.csv")
    halves = [tmp_path / "fixed.pts", tmp_path / "moving.pts"]
    write_landmarks(*halves[::-1], pairs=pairs)
    visit.upload("Load landmarks", halves[:1])
    page.get_by_role("alert").get_by_text("together").wait_for()
    visit.upload("Load landmarks", halves)
    page.get_by_text("moving.pts was taken for the moving image").wait_for()
    np.testing.assert_array_equal([row[:2] for row in visit.points("moving")], pairs.moving)
    visit.wait_for("no folding")

    # At time 0 nothing has moved: the picture is the moving image itself, and dots stand where its landmarks are.
    warped = visit.image("result")
    slider = page.get_by_role("slider")
    slider.focus()
    slider.press("Home")
    expected = read_image((files / "moving.png").read_bytes()).pixels
    visit.until(lambda v: np.array_equal(v.image("result")[..., :3], expected))
    assert "Text" not in visit.drawn("result")
    slider.press("End")
    visit.until(lambda v: np.array_equal(v.image("result"), warped) and "Text" in v.drawn("result"))

    visit.box("Points").uncheck()
    visit.until(lambda v: "Text" not in v.drawn("result"))
    visit.box("Grid").uncheck()
    visit.until(lambda v: not v.columns("result", "xs")[0])  # drawn anew, and the points are still away
    assert "Text" not in visit.drawn("result")
    visit.box("Points").check()
    visit.until(lambda v: "Text" in v.drawn("result"))

    visit.press("Choose it")
    best = round(choose_sigma(pairs, SHAPE, fixed_shape=SHAPE), 3)
    visit.until(lambda v: float(v.page.locator("input.bk-input[type=text]").input_value()) == best)

    visit.upload("Bend one image", files / "moving.png")
    visit.until(lambda v: v.points("moving") == [])
    visit.until(lambda v: v.page.get_by_text("Fixed: ").is_hidden())
    visit.wait_for("no pairs yet")
    visit.until(lambda v: np.array_equal(v.image("result")[..., :3], expected))
    visit.click("moving", 40.0, 30.0)
    visit.wait_for("1 pair")
    visit.drag("result", visit.points("result")[0][:2], (50.0, 33.0))
    visit.until(lambda v: np.hypot(*np.subtract(v.points("result")[0][:2], (50.0, 33.0))) < 1.0)
    visit.until(lambda v: not np.array_equal(v.image("result")[..., :3], expected))
    np.testing.assert_allclose(visit.points("moving")[0][:2], (40.0, 30.0), atol=0.5)
    visit.upload("Open fixed image", files / "fixed.png")
    visit.until(lambda v: v.page.get_by_text("Fixed: ").is_visible())
    assert visit.problems == []
    visit.context.close()


def test_what_cannot_be_opened_is_refused_and_the_session_goes_on(chromium, address, files, tmp_path):
    visit = Visit(chromium, address, width=400, height=800)
    (tmp_path / "large.png").write_bytes(bytes(LIMITS.bytes + 1))
    (tmp_path / "cut.png").write_bytes((files / "moving.png").read_bytes()[:300])
    (tmp_path / "words.csv").write_text("one,two\nthree,four\n")
    (tmp_path / "<img src=x onerror=alert(1)>.png").write_bytes(b"no image")
    wrong = [
        ("Open moving image", "large.png"),
        ("Open fixed image", "cut.png"),
        ("Open moving image", "<img src=x onerror=alert(1)>.png"),
        ("Load landmarks", "words.csv"),
    ]
    for label, name in wrong:
        before = visit.page.get_by_role("alert").all_inner_texts()
        visit.upload(label, tmp_path / name)
        visit.until(lambda v, before=before: v.page.get_by_role("alert").all_inner_texts() not in ([], before))
    visit.upload("Load landmarks", files / "pairs.csv")
    visit.until(lambda v: len(v.points("fixed")) == 5)
    visit.until(lambda v: v.page.get_by_role("alert").count() == 0)
    assert visit.problems == []
    visit.upload("Bend one image", files / "fixed.png")
    visit.until(lambda v: v.points("moving") == [])
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= 400  # nothing sticks out of a narrow window
    assert visit.problems == []
    visit.context.close()


def test_visitors_at_the_same_time_stay_separate(chromium, address):
    visits = [Visit(chromium, address) for _ in range(2)]
    for k, visit in enumerate(visits):
        visit.click("moving", 10.0 + 5 * k, 30.0)
    for k, visit in enumerate(visits):
        visit.until(lambda v: [row[2] for row in v.points("fixed")] == [1])
        np.testing.assert_allclose(visit.points("moving"), [[10.0 + 5 * k, 30.0, 1]], atol=0.5)
    assert len({visit.page.url for visit in visits}) == 2
    for visit in visits:
        assert visit.problems == []
        visit.context.close()


@pytest.mark.parametrize(
    ("origin", "status"),
    [("{own}", 101), ("http://example.org", 403), ("http://localhost:1", 403), ("https://localhost.example.org", 403)],
)
def test_requests_of_other_origins_are_refused(address, origin, status):
    from bokeh.util.token import generate_jwt_token, generate_session_id

    where = urlsplit(address)
    connection = http.client.HTTPConnection(where.hostname, where.port, timeout=60)
    headers = {
        "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Origin": origin.format(own=address.rstrip("/")),
        "Sec-WebSocket-Protocol": f"bokeh, {generate_jwt_token(generate_session_id())}",
    }  # fmt: skip
    connection.request("GET", "/ws", headers=headers)
    answer = connection.getresponse()
    connection.close()
    answer.close()
    assert answer.status == status


def test_the_server_listens_on_this_machine_only_and_serves_no_other_files(address):
    port = urlsplit(address).port
    others = {entry[4][0] for entry in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)}
    for host in others - {"127.0.0.1", "127.0.1.1"}:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((host, port), timeout=5)
    for path in (
        "static/../../../../etc/passwd",
        "static/%2e%2e/%2e%2e/pyproject.toml",
        "components/../server.py",
        "moving.png",
    ):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(address + path, timeout=30)
        assert refused.value.code in (400, 403, 404)
        refused.value.close()
