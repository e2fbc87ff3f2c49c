"""Pixels that are not square: the same scene on other pixels has the same map, and a turn needs no bending."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from codegen.cli import main
from codegen.registration import register, warp
from codegen.registration.app.reading import session_of
from codegen.registration.app.solving import Wanted, certified, estimated_sigma, field, found
from codegen.registration.certificate import certify, certify_with_positions
from codegen.registration.images import Spacing
from codegen.registration.maps import in_pixels, in_squares, square_grid
from codegen.registration.noise import estimate_sigma
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.register import leave_one_out
from codegen.registration.warp import displacement_field

tifffile = pytest.importorskip("tifffile")
pytestmark = pytest.mark.usefixtures("solver")
SHAPE, FIXED_SHAPE = (60, 80), (64, 70)
WIDE = 4.0
"""How many times as high as wide pixels are."""


def scene(count=14):
    generator = np.random.default_rng(4)
    fixed = generator.uniform(0.15, 0.85, (count, 2)) * FIXED_SHAPE[::-1]
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    bent = 2.0 * np.sin(fixed[:, ::-1] / 11.0) + generator.normal(size=fixed.shape)
    return LandmarkPairs((fixed - [35, 32]) @ turn + [40, 30] + bent, fixed)


def finer(points):
    """Pixels of the same scene whose columns are divided: edges stay where they are."""
    return (points + 0.5) * [WIDE, 1.0] - 0.5


def coarser(points):
    return (points + 0.5) / [WIDE, 1.0] - 0.5


def wide(shape):
    return shape[0], int(shape[1] * WIDE)


def registered(pairs, shape, fixed_shape, spacing, fixed_spacing, **options):
    grids = square_grid(shape, spacing), square_grid(fixed_shape, fixed_spacing)
    return in_pixels(register(in_squares(pairs, *grids), grids[0], fixed_shape=grids[1], **options))


@pytest.fixture(params=["none", "similarity", "affine", "auto"])
def both(request):
    """The map of a scene on square pixels, and that of the same on narrow ones."""
    pairs = scene()
    narrow = LandmarkPairs(finer(pairs.moving), finer(pairs.fixed))
    plain = register(pairs, SHAPE, fixed_shape=FIXED_SHAPE, align=request.param, steps=8)
    spacing = Spacing(0.1, 0.1 * WIDE, "mm")
    made = registered(narrow, wide(SHAPE), wide(FIXED_SHAPE), spacing, spacing, align=request.param, steps=8)
    return plain, made


def test_the_same_scene_on_other_pixels_has_the_same_map(both):
    plain, made = both
    points = np.random.default_rng(0).uniform(0.0, 1.0, (300, 2)) * [69, 63]
    assert made.grid.is_plain
    assert not made.matching.grid.is_plain
    assert made.alignment.kind == plain.alignment.kind
    np.testing.assert_allclose(coarser(made.map_points(finer(points))), plain.map_points(points), atol=1e-8)
    np.testing.assert_allclose(
        coarser(made.map_points_inverse(finer(points))), plain.map_points_inverse(points), atol=1e-8
    )
    for own, other in ((made.arriving, plain.arriving), (made.leaving, plain.leaving)):
        (places, factors), (expected, areas) = own(finer(points)), other(points)
        np.testing.assert_allclose(coarser(places), expected, atol=1e-8)
        np.testing.assert_allclose(factors, areas, rtol=1e-8)
    np.testing.assert_allclose(made.determinant(finer(points)), plain.determinant(points), rtol=1e-8)
    for time in (0.0, 0.3, 1.0):
        went = made.positions(time, finer(points))
        np.testing.assert_allclose(coarser(went), plain.positions(time, points), atol=1e-8)
        np.testing.assert_allclose(made.positions(time, went, inverse=True), finer(points), atol=1e-7)
    np.testing.assert_allclose(made.pairs.moving, finer(plain.pairs.moving), rtol=1e-12)


def test_derivatives_are_those_of_pixels(both):
    _, made = both
    points, step = np.random.default_rng(1).uniform(5.0, 55.0, (20, 2)), 1e-4
    for function, inverse in ((made.map_points, False), (made.map_points_inverse, True)):
        columns = [(function(points + step * e) - function(points - step * e)) / (2 * step) for e in np.eye(2)]
        np.testing.assert_allclose(made.jacobian(points, inverse), np.stack(columns, axis=2), atol=1e-5)


def test_certificates_places_and_fields_are_in_pixels(both):
    plain, made = both
    certificate, (every, positions) = certify(made), certify_with_positions(made)
    assert certificate.passed
    assert every.passed
    assert every.det_min == pytest.approx(certificate.det_min, rel=1e-9)
    at = np.rint(certificate.det_min_at).astype(int)
    (least,) = plain.arriving([coarser(at)])[1]
    assert certificate.det_min == pytest.approx(least, rel=1e-8)
    field = displacement_field(made, inverse=True)
    assert field.shape == (*wide(FIXED_SHAPE), 2)
    came = made.map_points_inverse([at.astype(float)])[0]
    np.testing.assert_allclose(field[at[1], at[0]] + at, came, atol=1e-9)
    np.testing.assert_allclose(positions.places[at[1], at[0]], came, atol=1e-9)
    assert made.determinant([came])[0] == pytest.approx(certificate.det_min, rel=1e-9)
    ramp = np.tile(np.arange(80.0 * WIDE), (60, 1))
    place = made.map_points_inverse([[100.0, 30.0]])[0]
    assert warp(ramp, made)[30, 100] == pytest.approx(place[0], abs=1e-9)


def test_a_turn_of_narrow_pixels_is_a_similarity_and_nothing_bends():
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    fixed = np.random.default_rng(0).uniform(10.0, 50.0, (9, 2))
    moving = (fixed - 30.0) @ turn.T + 30.0
    pairs, sides, shape = LandmarkPairs(moving * [4.0, 1.0], fixed * [4.0, 1.0]), Spacing(1.0, 4.0, "mm"), (60, 240)
    made = registered(pairs, shape, shape, sides, sides, align="similarity")
    assert made.distance < 1e-9
    assert register(pairs, shape, align="similarity").distance > 0.1  # as though pixels were square


def test_sigma_and_errors_are_in_sides_of_a_square_of_the_same_area():
    pairs, spacing = scene(30), Spacing(0.1, 0.1 * WIDE, "mm")
    narrow = LandmarkPairs(finer(pairs.moving), finer(pairs.fixed))
    grids = square_grid(wide(SHAPE), spacing), square_grid(wide(FIXED_SHAPE), spacing)
    squares, times = in_squares(narrow, *grids), np.sqrt(WIDE)  # a pixel of the plain scene is four narrow ones
    estimate = estimate_sigma(squares, grids[0], fixed_shape=grids[1]).sigma
    assert estimate == pytest.approx(times * estimate_sigma(pairs, SHAPE, fixed_shape=FIXED_SHAPE).sigma, rel=1e-6)
    plain = register(pairs, SHAPE, fixed_shape=FIXED_SHAPE, align="similarity", sigma=1.0)
    made = in_pixels(register(squares, grids[0], fixed_shape=grids[1], align="similarity", sigma=times))
    np.testing.assert_allclose(made.residuals, times * plain.residuals, rtol=1e-3)
    np.testing.assert_allclose(spacing.lengths(made.misses), 0.4 * plain.residuals, rtol=1e-3)
    left = leave_one_out(squares, grids[0], fixed_shape=grids[1], align="similarity", steps=4)
    expected = leave_one_out(pairs, SHAPE, fixed_shape=FIXED_SHAPE, align="similarity", steps=4)
    np.testing.assert_allclose(left.errors, times * expected.errors, rtol=1e-6)


@pytest.fixture
def narrow_files(tmp_path):
    """Two pictures of the same scene as TIFF, on square and on narrow pixels, with landmarks in pixels of each."""
    for kind, times in (("plain", 1), ("narrow", int(WIDE))):
        for side, shape in (("moving", SHAPE), ("fixed", FIXED_SHAPE)):
            y, x = np.mgrid[: shape[0], : shape[1] * times]
            shade = 120 + 60 * np.sin((x + 0.5) / times / 6.0) * np.cos(y / 7.0)
            resolution, form = (2.0 * times, 2.0), {"unit": "um"}
            path = tmp_path / f"{side}_{kind}.tif"
            tifffile.imwrite(path, shade.astype(np.uint8), imagej=True, resolution=resolution, metadata=form)
        pairs, to = scene(), finer if times > 1 else lambda points: points
        rows = np.hstack([to(pairs.moving), to(pairs.fixed)])
        lines = ["moving_x,moving_y,fixed_x,fixed_y", *(",".join(map(repr, map(float, row))) for row in rows)]
        (tmp_path / f"{kind}.csv").write_text("\n".join(lines))
    return tmp_path


def test_the_command_tells_of_narrow_pixels_what_it_tells_of_square_ones(narrow_files):
    records, fields = {}, {}
    for kind in ("plain", "narrow"):
        moving, fixed, landmarks, out, table = (
            str(narrow_files / name.format(kind))
            for name in ("moving_{}.tif", "fixed_{}.tif", "{}.csv", "out_{}.tif", "field_{}.npz")
        )
        words = ["warp", moving, "--landmarks", landmarks, "--fixed", fixed, "--out", out, "--field", table]
        done = CliRunner().invoke(main, [*words, "--sigma", "auto", "--steps", "8", "--json"])
        assert done.exit_code == 0, done.output
        records[kind], fields[kind] = json.loads(done.stdout), np.load(table)["displacement"]
    (plain, narrow) = (records[kind]["summary"] for kind in ("plain", "narrow"))
    assert narrow["alignment"] == plain["alignment"]
    for name in ("residual_lengths", "leave_one_out_lengths", "deviation_length"):
        np.testing.assert_allclose(narrow[name], plain[name], rtol=1e-3)
    assert records["narrow"]["sigma"] == pytest.approx(records["plain"]["sigma"] * np.sqrt(WIDE), rel=1e-4)
    assert fields["narrow"].shape == (*wide(FIXED_SHAPE), 2)
    between = 0.5 * (fields["narrow"][:, 1::4] + fields["narrow"][:, 2::4])  # about the centres of square pixels
    np.testing.assert_allclose(between / [WIDE, 1.0], fields["plain"], atol=0.02)


def test_the_page_registers_narrow_pixels_as_the_command_does(narrow_files):
    session = session_of([narrow_files / "moving_narrow.tif", narrow_files / "fixed_narrow.tif"])
    session.load(LandmarkPairs(finer(scene().moving), finer(scene().fixed)))
    wanted = Wanted(session.task())
    registration = found(wanted, None)
    plain = register(scene(), SHAPE, fixed_shape=FIXED_SHAPE)
    points = np.random.default_rng(0).uniform(0.0, 1.0, (50, 2)) * [69, 63]
    made = coarser(registration.map_points(finer(points)))
    np.testing.assert_allclose(made, plain.map_points(points), atol=0.02)  # both to within a hundredth of a pixel
    hasty = found(replace(wanted, hasty=True), registration)
    np.testing.assert_allclose(coarser(hasty.map_points(finer(points))), plain.map_points(points), atol=0.1)
    told = certified(wanted, registration, lambda: False)
    assert told.folded == 0
    assert len(told.left_out.errors) == len(scene())
    estimate = estimate_sigma(scene(), SHAPE, fixed_shape=FIXED_SHAPE).sigma
    assert estimated_sigma(session.task()).sigma == pytest.approx(estimate * np.sqrt(WIDE), rel=1e-6)
    assert field(session.task()).data[:2] == b"PK"
