"""The page's session without a page: pairs, history, what a browser sends, saved work, files for download."""

import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from codegen.errors import CodegenError, ImageError, LandmarkError, PointsError, RegistrationError
from codegen.registration import LandmarkPairs, certificate, register, warp
from codegen.registration.app import exports, reading, solving
from codegen.registration.app.autosave import MOST_WORKS, Store, new_token
from codegen.registration.app.history import History
from codegen.registration.app.picture import Picture
from codegen.registration.app.rows import Editions
from codegen.registration.app.session import Session
from codegen.registration.app.state import MOST_PAIRS, Settings, Work, pairs_of
from codegen.registration.formats import FORMATS, Frames, landmark_texts
from codegen.registration.images import read_image

SHAPE = (40, 60)
RNG = np.random.default_rng(5)


def picture(shape=SHAPE, dtype=np.uint8, name="a.png"):
    pixels = (RNG.random((*shape, 3)) * (255 if dtype == np.uint8 else 65535)).astype(dtype)
    out = io.BytesIO()
    if dtype == np.uint8:
        Image.fromarray(pixels).save(out, "PNG")
    return Picture(pixels, name, out.getvalue())


@pytest.fixture
def session():
    """A session, and for its tables what a page would remember of what it sent."""
    made = Session(picture(), picture((50, 70), name="b.png"))
    made.editions = {side: Editions(side) for side in ("moving", "fixed")}
    return made


def places(session, side):
    return [pair.at(side) for pair in session.work.pairs]


def test_a_click_adds_a_pair_and_a_click_in_the_other_image_places_its_partner(session):
    session.click("moving", (10.0, 20.0))
    # Without a registration the partner is expected at the same share of the image, counted from its edges.
    assert places(session, "fixed") == [((10.5 * 70 / 60) - 0.5, (20.5 * 50 / 40) - 0.5)]
    assert session.work.pairs[0].guessed == "fixed"
    session.click("fixed", (12.0, 22.0))
    assert (places(session, "moving"), places(session, "fixed")) == ([(10.0, 20.0)], [(12.0, 22.0)])
    session.click("fixed", (30.0, 30.0))
    assert len(session.work.pairs) == 2
    assert session.work.pairs[1].guessed == "moving"


def test_undo_and_redo_restore_every_state_in_order(session):
    session.click("moving", (10.0, 20.0))
    first = session.work.pairs[0].identity
    for x in (11.0, 12.0, 13.0):
        session.move(first, "moving", (x, 20.0), settled=False)
    session.settle()
    session.move(first, "moving", (14.0, 20.0))
    session.set(Settings(sigma=2.0))
    session.remove(first)
    seen = [session.work]
    while session.undo():
        seen.append(session.work)
    assert [len(work.pairs) for work in seen] == [0, 1, 1, 1, 1, 0]
    assert [work.pairs[0].moving[0] for work in seen[1:5]] == [14.0, 14.0, 13.0, 10.0]
    assert seen[1].settings.sigma == 2.0
    assert seen[2].settings.sigma == 0.0
    for work in reversed(seen[:-1]):
        assert session.redo()
        assert session.work == work
    assert not session.redo()


@given(st.lists(st.sampled_from(["change", "gesture", "settle", "undo", "redo"]), max_size=60))
def test_history_agrees_with_a_list_and_a_position(actions):
    history, states, at, gesture = History(0), [0], 0, None
    for count, action in enumerate(actions, 1):
        if action == "change" or (action == "gesture" and gesture != "drag"):
            states, at = [*states[: at + 1], count], at + 1
            gesture = "drag" if action == "gesture" else None
            history.change(count, gesture)
        elif action == "gesture":
            states = [*states[:at], count]
            history.change(count, "drag")
        else:
            gesture = None
            at = at - (action == "undo" and at > 0) + (action == "redo" and at + 1 < len(states))
            getattr(history, action)()
        assert history.present == states[at]
        assert (history.can_undo, history.can_redo) == (at > 0, at + 1 < len(states))


def rows(session, side, edition=None):
    """What a browser holds after it was shown a session."""
    edition = session.editions[side].publish(session.work) if edition is None else edition
    pairs = session.work.pairs
    return {
        "x": [p.at(side)[0] for p in pairs], "y": [p.at(side)[1] for p in pairs],
        "id": [p.identity for p in pairs], "edition": [edition] * len(pairs),
    }  # fmt: skip


def with_click(table, x, y):
    return {"x": [*table["x"], x], "y": [*table["y"], y], "id": [*table["id"], 0], "edition": [*table["edition"], None]}


def send(session, side, table):
    changes = session.editions[side].changes(table, session.work)
    session.follow(side, changes)
    return changes


def test_clicks_that_come_again_are_counted_once_and_may_be_dragged_meanwhile(session):
    session.click("moving", (10.0, 20.0))
    table = with_click(rows(session, "moving"), 30.0, 31.0)
    assert send(session, "moving", table).added == ((30.0, 31.0),)
    assert send(session, "moving", table).added == ()
    table["x"][-1] = 35.0
    send(session, "moving", with_click(table, 5.0, 6.0))
    assert places(session, "moving") == [(10.0, 20.0), (35.0, 31.0), (5.0, 6.0)]


def test_a_message_that_was_sent_before_the_last_answer_arrived_deletes_nothing(session):
    session.click("moving", (10.0, 20.0))
    old = rows(session, "fixed")
    session.click("moving", (30.0, 20.0))
    rows(session, "fixed")
    old["x"][0] = 40.0
    changes = send(session, "fixed", old)
    assert changes.removed == ()
    assert len(session.work.pairs) == 2
    assert session.work.pairs[0].fixed[0] == 40.0
    both = tuple(pair.identity for pair in session.work.pairs)
    assert send(session, "fixed", {name: [] for name in old}).removed == both


@pytest.mark.parametrize("bad", [None, "x", float("nan"), float("inf"), [1], {}])
def test_rows_that_are_no_points_are_ignored(session, bad):
    session.click("moving", (10.0, 20.0))
    send(session, "moving", with_click(rows(session, "moving"), bad, 3.0))
    assert len(session.work.pairs) == 1


def test_points_stay_within_the_image_and_their_number_within_bounds(session):
    session.click("moving", (-500.0, 1e9))
    assert places(session, "moving") == [(-0.5, 39.5)]
    crowd = np.random.default_rng(0).random((MOST_PAIRS + 1, 2))
    with pytest.raises(LandmarkError, match="501"):
        session.load(LandmarkPairs(crowd, crowd))
    session.load(LandmarkPairs(crowd[1:], crowd[1:]))
    with pytest.raises(LandmarkError, match="500"):
        session.click("moving", (3.0, 3.0))


def test_another_image_keeps_the_pairs_that_fit_into_it(session):
    for x in (10.0, 50.0):
        session.click("moving", (x, 20.0))
    session.open("moving", picture((40, 30)))
    assert places(session, "moving") == [(10.0, 20.0)]
    assert not session.history.can_undo
    session.open_alone(picture((20, 20)))
    assert session.work.pairs == ()
    assert session.picture("fixed") is session.moving


def test_saved_work_comes_back_and_nothing_else_is_ever_read(tmp_path, session):
    store, token = Store(tmp_path / "state"), new_token()
    session.click("moving", (10.25, 20.5))
    session.set(Settings("affine", 1.5, "midpoint", "cubic"))
    store.save(token, session.moving, session.fixed, session.work)
    saved = store.load(token)
    assert saved.work.settings == session.work.settings
    assert [p.moving for p in saved.work.pairs] == places(session, "moving")
    np.testing.assert_array_equal(saved.fixed.pixels, session.fixed.pixels)
    (tmp_path / "secret.json").write_text((store.folder / f"{token}.json").read_text())
    assert store.load("../secret") is None
    record = json.loads((store.folder / f"{token}.json").read_text())
    for damage in ({"moving": {"digest": "../secret.json", "name": "a"}}, {"pairs": [["a"]]}, {"settings": 3}):
        (store.folder / f"{token}.json").write_text(json.dumps(record | damage))
        assert store.load(token) is None
    (store.folder / f"{token}.json").write_text("{")
    assert store.load(token) is None


def test_old_works_are_deleted_with_their_images(tmp_path, session):
    store, shared = Store(tmp_path), session.fixed
    lone = picture((8, 8))
    store.save(new_token(), lone, shared, Work())
    for _ in range(MOST_WORKS):
        store.save(new_token(), session.moving, shared, Work())
    assert len(list(tmp_path.glob("*.json"))) == MOST_WORKS
    assert not (tmp_path / lone.digest).exists()
    assert (tmp_path / shared.digest).exists()


def test_names_of_files_never_become_paths():
    data = picture().source
    for name in ("../../etc/passwd.png", "C:\\x\\y.png", "/abs/z.png", "<b>&.png", "." * 300, ""):
        made = reading.picture_from(data, name)
        assert "/" not in made.name
        assert "\\" not in made.name
        assert made.stem
        assert all(c.isalnum() or c in "-_" for c in made.stem)


def test_what_is_too_large_is_refused_before_it_is_decoded(monkeypatch):
    header = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + (100_000).to_bytes(4, "big") * 2 + b"\x08\x02\x00\x00\x00"
    with pytest.raises(ImageError):
        reading.picture_from(header + b"\x00" * 100, "bomb.png")
    with pytest.raises(ImageError, match="bytes"):
        reading.picture_from(b"\x89PNG" + bytes(reading.LIMITS.bytes), "large.png")


PAIR = LandmarkPairs([[1.0, 2.0], [8.0, 9.0]], [[2.0, 4.0], [9.0, 7.0]])
TWO_FILES = [form for form in FORMATS.values() if form.files == 2]


@pytest.mark.parametrize("form", TWO_FILES, ids=lambda form: form.name)
@pytest.mark.parametrize(
    ("moving", "fixed", "turned", "why"),
    [("a", "b", False, "order"), ("moving", "fixed", False, "names"), ("moving", "fixed", True, "names"),
     ("a", "b_target", False, "names"), ("a", "b_target", True, "names"), ("x_source", "a", True, "names")],
)  # fmt: skip
def test_two_landmark_files_are_told_apart_by_name_or_else_by_order(form, moving, fixed, turned, why):
    texts = landmark_texts(PAIR, form.name)
    files = [(name + form.suffixes[0], text.encode()) for name, text in zip((moving, fixed), texts)]
    ordered, (remark,) = reading.in_order(files[::-1] if turned else files)
    found = reading.parse_landmarks(ordered)
    np.testing.assert_array_equal((found.moving, found.fixed), (PAIR.moving, PAIR.fixed))
    assert remark.startswith(f"{moving}{form.suffixes[0]} was taken for the moving image")
    assert why in remark


@pytest.mark.parametrize("form", FORMATS.values(), ids=lambda form: form.name)
def test_a_landmark_file_without_its_partner_is_refused_with_the_remedy(form):
    frames = Frames(SHAPE, SHAPE)
    single = [("points" + form.suffixes[0], landmark_texts(PAIR, form.name, frames)[0].encode())]
    if form.files == 2:
        with pytest.raises(PointsError, match=r"one image only; choose the moving and the fixed file together"):
            reading.in_order(single)
    else:
        assert reading.in_order(single) == (single, [])


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (513, 7), (1100, 300)])
def test_previews_are_small_and_their_pixels_lie_where_they_belong(shape):
    ramp = np.add.outer(np.zeros(shape[0]), np.arange(shape[1])).astype(np.float32)
    made = Picture(ramp)
    x, y = made.preview_places()
    assert made.preview.shape == (len(y), len(x))
    assert max(made.preview.shape) <= 512
    k = made.reduction
    # The mean of k columns lies halfway between them.
    np.testing.assert_allclose(x[: shape[1] // k], [np.arange(k * i, k * i + k).mean() for i in range(shape[1] // k)])


def test_the_example_is_complete():
    made = reading.example()
    assert len(made.work.pairs) >= 15
    assert all(made.picture(side).contains(pair.at(side)) for pair in made.work.pairs for side in ("moving", "fixed"))


@pytest.fixture
def solved(solver, session):
    """A session with five pairs that move by up to three pixels."""
    start = np.array([[10.0, 8.0], [50.0, 9.0], [12.0, 31.0], [48.0, 30.0], [30.0, 20.0]])
    target = start * 1.1 + np.random.default_rng(2).normal(size=start.shape) * 1.5
    session.load(LandmarkPairs(start, target))
    return session


def test_downloads_are_what_the_core_makes(solved):
    task = solved.task()
    solved.set(Settings(interpolation="cubic"))
    task = solved.task()
    pairs = task.work.landmarks()
    registration = register(pairs, SHAPE, fixed_shape=(50, 70), align="similarity")
    download = exports.warped_image(task)
    expected = warp(solved.moving.pixels, registration, interpolation="cubic")
    np.testing.assert_array_equal(read_image(download.data).pixels, expected)
    (landmarks,) = exports.landmarks(task, "csv")
    again = reading.parse_landmarks([(landmarks.name, landmarks.data)])
    np.testing.assert_array_equal(again.fixed, pairs.fixed)
    field = np.load(io.BytesIO(exports.field(task).data))
    assert str(field["direction"]) == "fixed to moving"
    name = next(n for n in field.files if field[n].ndim == 3)
    place = np.array([[33.0, 21.0]])
    np.testing.assert_allclose(place + field[name][21, 33], registration.map_points_inverse(place), atol=1e-9)
    gif = Image.open(io.BytesIO(exports.animation(task, with_grid=True).data))
    assert (gif.format, gif.size, gif.n_frames) == ("GIF", (70, 50), 2 * exports.FRAMES - 2)


def test_the_picture_on_the_screen_is_close_to_the_exact_one(solved):
    wanted = solving.Wanted(solved.task(), grid=True)
    shown = solving.shown(wanted, None)
    x, y = solving.sources(solved.fixed, shown.registration, 1.0)
    grid = np.stack(np.meshgrid(np.arange(70.0), np.arange(50.0)), axis=-1).reshape(-1, 2)
    exact = shown.registration.map_points_inverse(grid).reshape(50, 70, 2)
    assert np.abs(np.stack([x, y], axis=-1) - exact).max() < 1.0
    assert shown.image.shape == (50, 70, 4)
    again = solving.shown(solving.Wanted(solved.task(), hasty=True), shown.registration)
    assert again.registration.steps <= shown.registration.steps
    found = solving.certified(wanted, shown.registration, lambda: False)
    assert 0.0 < found.det_min < found.det_max
    assert found.folded == 0
    assert found.left_out.errors.shape == (5,)
    assert solving.certified(wanted, shown.registration, lambda: True) is None
    areas = shown.registration.determinant(shown.registration.map_points_inverse(grid[:1]))
    np.testing.assert_allclose(found.areas[0, 0], areas[0], rtol=1e-6)


def test_new_partners_are_where_the_registration_maps_them(solved):
    solved.registration = solving.shown(solving.Wanted(solved.task()), None).registration
    pair = solved.click("fixed", (40.0, 25.0))
    np.testing.assert_allclose(solved.registration.map_points(np.array([pair.moving])), [[40.0, 25.0]], atol=1e-6)
    before = solved.registration.residuals.max()
    assert before < 1e-6


def test_of_a_map_that_is_not_certified_neither_image_nor_field_is_handed_out(solved, monkeypatch):
    monkeypatch.setattr(certificate, "ROUND_TRIP", 0.0)
    for make in (exports.warped_image, exports.field):
        with pytest.raises(RegistrationError, match="come back"):
            make(solved.task())


def test_without_pairs_nothing_moves_and_nothing_can_be_downloaded(session):
    shown = solving.shown(solving.Wanted(Session(session.moving).task()), None)
    np.testing.assert_array_equal(shown.image[..., :3], session.moving.pixels)
    for make in (exports.warped_image, exports.field, exports.animation):
        with pytest.raises(CodegenError):
            make(session.task())
    assert pairs_of(LandmarkPairs([[0, 0]], [[1, 1]]), 7)[0].identity == 7
