"""The page's session without a page: pairs, history, what a browser sends, saved work, files for download."""

import io
import json

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from codegen.errors import CodegenError, ImageError, LandmarkError, PointsError, RegistrationError
from codegen.registration import LandmarkPairs, certificate, register, warp
from codegen.registration.app import exports, reading, solving
from codegen.registration.app.autosave import MOST_WORKS, OtherWriterError, Saved, Store, new_token
from codegen.registration.app.history import History
from codegen.registration.app.picture import Picture
from codegen.registration.app.session import Session
from codegen.registration.app.state import MOST_PAIRS, Settings, Work, pairs_of
from codegen.registration.app.tiles import SIDE, tile
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
    return Session(picture(), picture((50, 70), name="b.png"))


def places(session, side):
    return [pair.at(side) for pair in session.work.pairs]


def test_a_click_adds_a_pair_and_a_click_in_the_other_image_places_its_partner(session):
    pair = session.add("moving", (10.0, 20.0))
    # Without a registration the partner is expected at the same share of the image, counted from its edges.
    assert places(session, "fixed") == [((10.5 * 70 / 60) - 0.5, (20.5 * 50 / 40) - 0.5)]
    assert session.work.pairs[0].guessed == "fixed"
    session.add("fixed", (12.0, 22.0), awaiting=pair.identity)
    assert (places(session, "moving"), places(session, "fixed")) == ([(10.0, 20.0)], [(12.0, 22.0)])
    session.add("fixed", (30.0, 30.0), awaiting=pair.identity)
    assert len(session.work.pairs) == 2
    assert session.work.pairs[1].guessed == "moving"


def test_undo_and_redo_restore_every_state_in_order(session):
    session.add("moving", (10.0, 20.0))
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


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_places_that_are_no_numbers_are_refused(session, bad):
    pair = session.add("moving", (10.0, 20.0))
    for act in (lambda: session.add("moving", (bad, 3.0)), lambda: session.move(pair.identity, "fixed", (3.0, bad))):
        with pytest.raises(LandmarkError, match="finite"):
            act()
    assert session.work.pairs == (pair,)


def test_names_and_activity_are_edited_and_undone(session):
    first, second = (session.add("moving", (x, 20.0)) for x in (10.0, 30.0))
    session.rename(first.identity, "  left \n eye ")
    session.activate([second.identity], False)
    assert [(pair.name, pair.active) for pair in session.work.pairs] == [("left eye", True), ("", False)]
    assert session.work.landmarks().names == ("left eye",)
    assert session.task().work.active == (session.work.pairs[0],)
    session.undo()
    session.undo()
    assert [(pair.name, pair.active) for pair in session.work.pairs] == [("", True), ("", True)]
    session.activate([first.identity], False)
    assert session.work.landmarks().names == ("2",)  # its number among all pairs, which the table shows


def test_points_stay_within_the_image_and_their_number_within_bounds(session):
    session.add("moving", (-500.0, 1e9))
    assert places(session, "moving") == [(-0.5, 39.5)]
    crowd = np.random.default_rng(0).random((MOST_PAIRS + 1, 2))
    with pytest.raises(LandmarkError, match=str(MOST_PAIRS + 1)):
        session.load(LandmarkPairs(crowd, crowd))
    session.load(LandmarkPairs(crowd[1:], crowd[1:]))
    with pytest.raises(LandmarkError, match=str(MOST_PAIRS)):
        session.add("moving", (3.0, 3.0))


def test_another_image_keeps_the_pairs_that_fit_into_it(session):
    for x in (10.0, 50.0):
        session.add("moving", (x, 20.0))
    session.open("moving", picture((40, 30)))
    assert places(session, "moving") == [(10.0, 20.0)]
    assert not session.history.can_undo
    session.open_alone(picture((20, 20)))
    assert session.work.pairs == ()
    assert session.picture("fixed") is session.moving


def kept(session, work=None, heard=None, edition=""):
    return Saved(session.moving, session.fixed, session.work if work is None else work, heard or {}, edition)


def test_saved_work_comes_back_and_nothing_else_is_ever_read(tmp_path, session):
    store, token = Store(tmp_path / "state"), new_token()
    store.require_writable()
    first = session.add("moving", (10.25, 20.5))
    session.add("fixed", (30.0, 20.0))
    session.remove(first.identity)
    session.activate([2], False)
    session.set(Settings("affine", 1.5, "midpoint", "cubic"))
    store.save(token, kept(session, heard={"tab": 7}))
    saved = store.load(token)
    assert saved.work == session.work
    assert saved.heard == {"tab": 7}
    np.testing.assert_array_equal(saved.fixed.pixels, session.fixed.pixels)
    (tmp_path / "secret.json").write_text((store.folder / f"{token}.json").read_text())
    assert store.load("../secret") is None
    record = json.loads((store.folder / f"{token}.json").read_text())
    twice = record["pairs"] * 2
    for damage in ({"moving": {"digest": "../secret.json", "name": "a"}}, {"pairs": [["a"]]}, {"settings": 3},
                   {"heard": 3}, {"pairs": twice}):  # fmt: skip
        (store.folder / f"{token}.json").write_text(json.dumps(record | damage))
        assert store.load(token) is None
    (store.folder / f"{token}.json").write_text("{")
    assert store.load(token) is None


def test_a_work_that_somebody_else_has_written_is_not_written_over(tmp_path, session):
    store, token = Store(tmp_path), new_token()
    mine = store.save(token, kept(session))
    session.add("moving", (10.0, 20.0))
    theirs = store.save(token, kept(session, edition=mine.edition))
    with pytest.raises(OtherWriterError):
        store.save(token, kept(session, Work(), edition=mine.edition))
    assert store.load(token).work == session.work
    assert store.load(token).edition == theirs.edition


def test_old_works_are_deleted_with_their_images(tmp_path, session):
    store, shared = Store(tmp_path), session.fixed
    lone = picture((8, 8))
    store.save(new_token(), Saved(lone, shared, Work(), {}, ""))
    for _ in range(MOST_WORKS):
        store.save(new_token(), kept(session, Work()))
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


@pytest.mark.parametrize("channels", [(), (2,), (3,), (4,)])
def test_tiles_put_together_are_the_levels_of_the_image(channels):
    made = Picture(RNG.integers(0, 255, (700, 1100, *channels)).astype(np.uint8))
    for number, level in enumerate(made.levels):
        rows = []
        for row in range(-(-level.shape[0] // SIDE)):
            parts = [tile(made, number, column, row) for column in range(-(-level.shape[1] // SIDE))]
            rows.append(np.concatenate([np.asarray(Image.open(io.BytesIO(part))) for part in parts], axis=1))
        np.testing.assert_array_equal(np.concatenate(rows), level)
    assert max(made.levels[-1].shape[:2]) <= 256
    for number, column, row in ((-1, 0, 0), (9, 0, 0), (0, 3, 0), (0, 0, 2), (0, -1, 0)):
        assert tile(made, number, column, row) is None


def test_samples_of_many_bits_are_stretched_without_the_few_at_the_ends():
    pixels = np.tile(np.linspace(1000.0, 2000.0, 1000).astype(np.uint16), (200, 1))
    pixels[0, :5] = 65535
    seen = Picture(pixels).levels[0][1:]
    np.testing.assert_allclose(seen[0], np.linspace(0, 255, 1000), atol=1.5)


def test_the_spacing_of_tiff_files_is_read_where_it_means_something():
    pixels = np.zeros((4, 5), np.uint16)

    def spacing(**values):
        out = io.BytesIO()
        tifffile.imwrite(out, pixels, **values)
        return reading.picture_from(out.getvalue(), "a.tif").spacing

    found = spacing(imagej=True, resolution=(2.0, 4.0), metadata={"unit": "um"})
    assert (found.x, found.y, found.unit) == (0.5, 0.25, "µm")
    sizes = {"axes": "YX", "PhysicalSizeX": 0.5, "PhysicalSizeXUnit": "nm", "PhysicalSizeY": 0.25}
    found = spacing(ome=True, metadata=sizes)
    assert (found.x, found.y, found.unit) == (0.5, 0.25, "nm")
    found = spacing(resolution=(100.0, 50.0), resolutionunit=3)
    assert (found.x, found.y, found.unit) == (0.1, 0.2, "mm")
    assert spacing() is None
    assert spacing(resolution=(72.0, 72.0), resolutionunit=2) is None  # what programs write that know nothing
    assert picture().spacing is None


@pytest.mark.parametrize("smooth", [True, False])
def test_a_window_shows_what_the_whole_shows_there(session, smooth):
    """Without landmarks the warped image is the moving one: each pixel of a window has the colour of its place."""
    pixels = np.add.outer(3.0 * np.arange(40), 2.0 * np.arange(60)).astype(np.uint8)
    task = Session(Picture(pixels)).task()
    image = solving.frame(task, None, 1.0, solving.Window(10.0, 5.0, 30.0, 25.0, 80, 80), smooth)
    place = np.arange(80) / 4 - 0.375 if smooth else np.arange(40) / 2 - 0.25  # in blocks of two by two
    exact = np.add.outer(3.0 * (5.0 + place), 2.0 * (10.0 + place))
    np.testing.assert_allclose(image[..., 0], exact, atol=1.0 if smooth else 2.6)  # nearest: half a pixel
    assert (image[..., 3] == 255).all()
    outside = solving.frame(task, None, 1.0, solving.Window(70.0, 0.0, 90.0, 20.0, 8, 8), smooth)
    assert not outside.any()


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
    wanted, window = solving.Wanted(solved.task()), solving.Window(0.0, 0.0, 70.0, 50.0, 70, 50)
    looks = {"tab": solving.Look(window, grid=True)}
    shown = solving.shown(wanted, looks, None)
    x, y = solving.sources(window, shown.registration, 1.0)
    grid = np.stack(np.meshgrid(np.arange(70.0), np.arange(50.0)), axis=-1).reshape(-1, 2)
    exact = shown.registration.map_points_inverse(grid).reshape(50, 70, 2)
    assert np.abs(np.stack([x, y], axis=-1) - exact).max() < 1.0
    assert shown.seen["tab"].image.shape == (50, 70, 4)
    corner = shown.registration.map_points_inverse([[-0.5, -0.5], [69.5, 49.5]])
    np.testing.assert_allclose(shown.chart.fixed[[0, -1], [0, -1]], corner, atol=1e-9)
    again = solving.shown(solving.Wanted(solved.task(), hasty=True), looks, shown.registration)
    assert again.chart is None
    assert again.registration.steps <= shown.registration.steps
    found = solving.certified(wanted, shown.registration, lambda: False)
    assert 0.0 < found.det_min < found.det_max
    assert found.folded == 0
    assert found.left_out.errors.shape == (5,)
    assert solving.certified(wanted, shown.registration, lambda: True) is None
    areas = shown.registration.determinant(shown.registration.map_points_inverse(grid[:1]))
    np.testing.assert_allclose(found.areas[0, 0], areas[0], rtol=1e-6)


def test_new_partners_are_where_the_registration_maps_them(solved):
    solved.registration = solving.shown(solving.Wanted(solved.task()), {}, None).registration
    pair = solved.add("fixed", (40.0, 25.0))
    np.testing.assert_allclose(solved.registration.map_points(np.array([pair.moving])), [[40.0, 25.0]], atol=1e-6)
    before = solved.registration.residuals.max()
    assert before < 1e-6


def test_of_a_map_that_is_not_certified_neither_image_nor_field_is_handed_out(solved, monkeypatch):
    monkeypatch.setattr(certificate, "ROUND_TRIP", 0.0)
    for make in (exports.warped_image, exports.field):
        with pytest.raises(RegistrationError, match="come back"):
            make(solved.task())


def test_without_pairs_nothing_moves_and_nothing_can_be_downloaded(session):
    task = Session(session.moving).task()
    looks = {"tab": solving.Look(solving.whole(session.moving))}
    shown = solving.shown(solving.Wanted(task), looks, None)
    np.testing.assert_array_equal(shown.seen["tab"].image[..., :3], session.moving.pixels)
    for make in (exports.warped_image, exports.field, exports.animation):
        with pytest.raises(CodegenError):
            make(session.task())
    assert pairs_of(LandmarkPairs([[0, 0]], [[1, 1]]), 7)[0].identity == 7
