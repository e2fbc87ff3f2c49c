"""Lengths in the page, in the unit that images carry: landmarks and errors; and what is refused there."""

import numpy as np
import pytest
from browser import START, Visit, browser, server

from codegen.registration import leave_one_out
from codegen.registration.formats import read_landmarks, write_landmarks
from codegen.registration.grid import Grid
from codegen.registration.images import write_image
from codegen.registration.linear import chosen_alignment
from codegen.registration.pairs import LandmarkPairs

pytest.importorskip("tornado", reason="tornado is not installed")
itk = pytest.importorskip("SimpleITK")

SIZES = {"moving": (0.5, 0.25), "fixed": (0.02, 0.02)}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two slices with pixels of known size, a volume, and five pairs of landmarks."""
    folder = tmp_path_factory.mktemp("units")
    y, x = np.indices((72, 96))
    for name, kind in (("moving", "nii.gz"), ("fixed", "nrrd")):
        image = itk.GetImageFromArray((1000 + 900 * np.sin(x / 7) * np.cos(y / 9)).astype(np.int16))
        image.SetSpacing(SIZES[name])
        itk.WriteImage(image, str(folder / f"{name}.{kind}"))
    placed = itk.GetImageFromArray(np.full((1, 72, 96), 7, np.int16))
    placed.SetDirection([1, 0, 0, 0, -1, 0, 0, 0, -1])
    itk.WriteImage(placed, str(folder / "placed.nii.gz"))
    itk.WriteImage(itk.GetImageFromArray(np.zeros((6, 8, 9), np.uint8)), str(folder / "brain.mha"))
    write_image(folder / "plain.png", np.zeros((72, 96), np.uint8))
    moved = START + np.random.default_rng(3).normal(size=START.shape) * 3.0
    write_landmarks(folder / "pairs.csv", pairs=LandmarkPairs(START, moved))
    return folder


@pytest.fixture(scope="module")
def chromium():
    with browser() as started:
        yield started


@pytest.fixture
def visit(chromium, solver, files):
    with server(files / "state", files / "moving.nii.gz", files / "fixed.nrrd") as address:
        made = Visit(chromium, address)
        made.upload("Open landmarks …", files / "pairs.csv")
        made.until(lambda v: len(v.pairs()) == 5)
        made.wait_for("no folding")
        yield made
        assert made.problems == []
        made.context.close()


def cells(visit, kind):
    """What the table shows, as numbers: of an image x and y, of errors the column."""
    script = (
        f"[...document.querySelectorAll('tbody tr[data-id] .{kind}')].map((cell) => cell.value ?? cell.textContent)"
    )
    return np.array([float(text or "nan") for text in visit.page.evaluate(script)])


def heads(visit):
    script = "['residual', 'left_out'].map((kind) => document.querySelector(`th [data-by=${kind}]`).textContent)"
    return visit.page.evaluate(script)


def in_units(visit, chosen):
    visit.menu("View")
    visit.page.locator("#units").set_checked(chosen)
    visit.menu("View")


def test_the_table_has_lengths_and_errors_of_slices_in_their_unit(visit, files):
    visit.until(lambda v: np.isfinite(cells(v, "left_out")).all())
    pixels, errors = {side: cells(visit, f"{side} input") for side in SIZES}, cells(visit, "left_out")
    assert heads(visit) == ["residual", "left out"]
    in_units(visit, chosen=True)
    for side, size in SIZES.items():
        lengths = cells(visit, f"{side} input").reshape(-1, 2)
        np.testing.assert_allclose(lengths, pixels[side].reshape(-1, 2) * size, atol=0.006)
    assert heads(visit) == ["residual mm", "left out mm"]
    np.testing.assert_allclose(cells(visit, "left_out"), 0.02 * errors, atol=2e-4)
    assert visit.page.locator("#unit").text_content() == "mm"
    # A landmark that is typed in millimetres goes where it was meant to go.
    place = visit.page.locator("tbody tr[data-id] .fixed input").first
    place.fill("0.5")
    place.press("Enter")
    visit.until(lambda v: v.points("fixed")[0][0] == pytest.approx(25.0))


def test_errors_have_a_unit_where_pixels_are_not_square(visit, files):
    visit.upload("Open fixed image …", files / "moving.nii.gz")
    visit.until(lambda v: v.page.evaluate("window.__page.model.images.fixed.name") == "moving.nii.gz")
    visit.until(lambda v: np.isfinite(cells(v, "left_out")).all())
    in_units(visit, chosen=True)
    assert heads(visit) == ["residual mm", "left out mm"]
    pairs, size = read_landmarks(files / "pairs.csv"), SIZES["moving"]
    pairs = LandmarkPairs(pairs.moving * size, pairs.fixed * size)
    grid = Grid((96, 72), (0.0, 0.0), size, ((1.0, 0.0), (0.0, 1.0)), "mm")
    align = chosen_alignment(pairs, grid).kind
    errors = leave_one_out(pairs, grid, align=align).errors
    np.testing.assert_allclose(cells(visit, "left_out"), errors, atol=0.02)


def test_a_volume_is_refused_in_one_line_and_the_session_goes_on(visit, files):
    visit.upload("Open fixed image …", files / "brain.mha")
    visit.wait_for("brain.mha is a volume (9 x 8 x 6 voxels), and the page is for pictures")
    assert len(visit.pairs()) == 5
    visit.upload("Open fixed image …", files / "plain.png")
    visit.until(lambda v: v.page.evaluate("window.__page.model.images.fixed.name") == "plain.png")


def test_edges_of_slices_are_named_by_the_side_of_the_patient(visit, files):
    letters = "[...document.querySelectorAll('#pane-fixed .edge')].map((edge) => edge.textContent)"
    assert visit.page.evaluate(letters) == ["", "", "", ""]
    visit.upload("Open fixed image …", files / "placed.nii.gz")
    visit.until(lambda v: v.page.evaluate(letters) == ["R", "L", "P", "A"])
    said = "Shown as stored: left edge right, right edge left, upper edge posterior, lower edge anterior"
    assert visit.page.locator("#pane-fixed .orientation").text_content() == said
    assert visit.page.locator("#pane-moving .orientation").text_content() == ""
