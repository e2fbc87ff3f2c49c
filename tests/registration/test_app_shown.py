"""What the page shows, and what can be downloaded: previews, tiles and windows of pictures, warped ones, fields."""

import io

import numpy as np
import pytest
from PIL import Image
from small_pictures import SHAPE, two_pictures

from codegen.errors import CodegenError, RegistrationError
from codegen.registration import certificate, register, warp
from codegen.registration.app import reading, solving
from codegen.registration.app.session import SIDE, Picture, Session, Settings, pairs_of, tile
from codegen.registration.images import read_image
from codegen.registration.linear import chosen_alignment
from codegen.registration.pairs import LandmarkPairs

RNG = np.random.default_rng(5)


@pytest.fixture
def session():
    return two_pictures()


@pytest.fixture
def solved(solver, session):
    """A session with five pairs that move by up to three pixels."""
    start = np.array([[10.0, 8.0], [50.0, 9.0], [12.0, 31.0], [48.0, 30.0], [30.0, 20.0]])
    target = start * 1.1 + np.random.default_rng(2).normal(size=start.shape) * 1.5
    session.load(LandmarkPairs(start, target))
    return session


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


def test_downloads_are_what_the_core_makes(solved):
    task = solved.task()
    solved.set(Settings(interpolation="cubic"))
    task = solved.task()
    pairs = task.work.landmarks()
    registration = register(pairs, SHAPE, fixed_shape=(50, 70))
    download = solving.warped_image(task)
    expected = warp(solved.moving.pixels, registration, interpolation="cubic")
    np.testing.assert_array_equal(read_image(download.data).pixels, expected)
    (landmarks,) = solving.landmarks(task, "csv")
    again = reading.parse_landmarks([(landmarks.name, landmarks.data)])
    np.testing.assert_array_equal(again.fixed, pairs.fixed)
    field = np.load(io.BytesIO(solving.field(task).data))
    assert str(field["direction"]) == "fixed to moving"
    name = next(n for n in field.files if field[n].ndim == 3)
    place = np.array([[33.0, 21.0]])
    np.testing.assert_allclose(place + field[name][21, 33], registration.map_points_inverse(place), atol=1e-9)
    gif = Image.open(io.BytesIO(solving.animation(task, with_grid=True).data))
    assert (gif.format, gif.size, gif.n_frames) == ("GIF", (70, 50), 2 * solving.FRAMES - 2)


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
    np.testing.assert_allclose(shown.chart["fixed"][[0, -1], [0, -1]], corner, atol=1e-9)
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


def test_landmarks_are_aligned_and_judged_as_by_the_command(solver):
    """Of the example, which is right, none stands out; one that is moved does."""
    session = reading.example()
    for named in ((), (3,)):
        for k in named:
            session.move(session.work.pairs[k].identity, "fixed", (300.0, 350.0), True)
        wanted = solving.Wanted(session.task())
        given, registration = solving.arguments(wanted.task)[0], solving.found(wanted, None)
        assert registration.alignment.kind == chosen_alignment(**given).kind
        assert solving.certified(wanted, registration, lambda: False).outliers == named
    hasty = solving.found(solving.Wanted(session.task(), hasty=True), registration)
    assert hasty.alignment.kind == registration.alignment.kind


def test_new_partners_are_where_the_registration_maps_them(solved):
    solved.registration = solving.shown(solving.Wanted(solved.task()), {}, None).registration
    pair = solved.add("fixed", (40.0, 25.0))
    np.testing.assert_allclose(solved.registration.map_points(np.array([pair.moving])), [[40.0, 25.0]], atol=1e-6)
    before = solved.registration.residuals.max()
    assert before < 1e-6


def test_of_a_map_that_is_not_certified_neither_image_nor_field_is_handed_out(solved, monkeypatch):
    monkeypatch.setattr(certificate, "ROUND_TRIP", 0.0)
    for make in (solving.warped_image, solving.field):
        with pytest.raises(RegistrationError, match="come back"):
            make(solved.task())


def test_without_pairs_nothing_moves_and_nothing_can_be_downloaded(session):
    task = Session(session.moving).task()
    height, width = session.moving.shape
    looks = {"tab": solving.Look(solving.Window(0.0, 0.0, width, height, width, height))}
    shown = solving.shown(solving.Wanted(task), looks, None)
    np.testing.assert_array_equal(shown.seen["tab"].image[..., :3], session.moving.pixels)
    for make in (solving.warped_image, solving.field, solving.animation):
        with pytest.raises(CodegenError):
            make(session.task())
    assert pairs_of(LandmarkPairs([[0, 0]], [[1, 1]]), 7)[0].identity == 7
