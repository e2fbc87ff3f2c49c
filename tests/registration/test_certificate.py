"""What certificates say of known maps; predictions of landmarks that were left out."""

from types import SimpleNamespace

import numpy as np
import pytest
from registered_images import SHAPE

from codegen.errors import LandmarkError
from codegen.registration import leave_one_out, register
from codegen.registration.certificate import bound_of_steps, certify, certify_with_positions
from codegen.registration.grid import grid_of, pixel_grid
from codegen.registration.noise import choose_sigma
from codegen.registration.pairs import LandmarkPairs


def known_map(determinant, back=lambda p: p):
    """Something that has what `certify` asks for."""
    return SimpleNamespace(
        status="solved", message="", fixed_grid=grid_of((9, 11)), residuals=np.array([0.25, 0.5]),
        pairs=LandmarkPairs([[1, 1]], [[2, 2]]), arriving=lambda p: (p, determinant(p)), map_points=lambda p: p,
        map_points_inverse=back, alignment=SimpleNamespace(determinant=1.0),
        flow=SimpleNamespace(module=None),  # which carries no bounds
    )  # fmt: skip


def test_a_fold_is_found_counted_and_placed():
    found = certify(known_map(lambda p: (p[:, 0] - 3.0) ** 2 + (p[:, 1] - 2.0) ** 2 - 1.0))
    assert (found.folded, found.first_fold) == (5, (3.0, 1.0))
    assert (found.det_min, found.det_min_at) == (-1.0, (3.0, 2.0))
    assert found.det_max == 7.0**2 + 6.0**2 - 1.0
    assert not found.passed
    assert "5 pixels, the first at (3, 1)" in found.message


def test_what_is_no_number_is_a_fold():
    found = certify(known_map(lambda p: np.where(p[:, 0] == 10, np.nan, 1.0)))
    assert (found.folded, found.first_fold, found.passed) == (9, (10.0, 0.0), False)
    assert not certify(known_map(lambda p: np.full(len(p), np.nan))).passed


def test_an_area_that_grows_without_bound_is_a_fold():
    """There the derivative of the inverse map is singular."""
    found = certify(known_map(lambda p: np.where((p == [4, 5]).all(axis=1), np.inf, 1.0)))
    assert (found.folded, found.first_fold, found.det_max, found.passed) == (1, (4.0, 5.0), 1.0, False)


def test_portions_are_put_together(monkeypatch):
    monkeypatch.setattr("codegen.registration.certificate.PORTION", 7)
    found, positions = certify_with_positions(known_map(lambda p: 1.0 + p[:, 0] + 100.0 * p[:, 1]))
    assert (found.det_min, found.det_max) == (1.0, 811.0)
    np.testing.assert_array_equal(positions.places.reshape(-1, 2), pixel_grid((9, 11)))


@pytest.mark.parametrize(("far", "passed"), [(1e-7, False), (np.nan, False), (1e-9, True)])
def test_points_must_come_back(far, passed):
    found = certify(known_map(lambda p: np.ones(len(p)), lambda p: p + np.array([0.0, far])))
    assert found.passed is passed
    assert ("come back" in found.message) is not passed


def test_a_map_that_misses_its_landmarks_does_not_pass():
    missing = known_map(lambda p: np.ones(len(p)))
    missing.status, missing.message = "folded", "the map folds in 2 steps and misses landmark 1"
    found = certify(missing)
    assert not found.passed
    assert found.message == missing.message


def test_trilobites_do_not_fold(registration):
    found = certify(registration)
    arriving = registration.map_points_inverse(pixel_grid(SHAPE))
    determinants = registration.determinant(arriving)
    assert found.passed
    assert found.det_min == pytest.approx(determinants.min(), rel=1e-9)
    assert found.det_min > 0.3
    assert found.det_max == pytest.approx(determinants.max(), rel=1e-9)
    assert found.round_trip <= 1e-8
    assert found.residual_max == registration.residuals.max()


def test_the_inverse_is_certified_on_the_pixels_of_the_moving_image(registration):
    shape = (40, 50)
    found, positions = certify_with_positions(registration, shape, inverse=True)
    grid = pixel_grid(shape)
    determinants = registration.determinant(grid)
    assert found.passed
    assert (found.det_min, found.det_max) == (determinants.min(), determinants.max())
    np.testing.assert_allclose(positions.places.reshape(-1, 2), registration.map_points(grid), atol=1e-11)
    # Where the same pixels arrive, the inverse map has the inverse derivative.
    there, factors = registration.arriving(positions.places.reshape(-1, 2))
    np.testing.assert_allclose(there, grid, atol=1e-8)
    np.testing.assert_allclose(factors, determinants, rtol=1e-7)


def test_a_landmark_out_of_place_is_found(solver):
    x, y = np.meshgrid(np.linspace(20, 140, 5), np.linspace(15, 105, 4))
    moving = np.stack([x.ravel(), y.ravel()], axis=1)
    fixed = moving + np.stack([3 * np.sin(moving[:, 1] / 40), 2 * np.cos(moving[:, 0] / 50)], axis=1)
    fixed[7] += [9.0, -6.0]
    found = leave_one_out(LandmarkPairs(moving, fixed), SHAPE, steps=5)
    assert found.outliers[0] == found.ranking[0] == 7
    assert found.errors[7] == pytest.approx(np.hypot(9, 6), abs=1.5)
    rest = LandmarkPairs(moving, fixed).without(3)
    predicted = register(rest, SHAPE, steps=5).map_points(moving[3:4])
    assert found.errors[3] == pytest.approx(np.linalg.norm(predicted - fixed[3]), abs=1e-7)


def test_one_landmark_predicts_nothing(solver):
    assert np.isnan(leave_one_out(LandmarkPairs([[1, 1]], [[2, 2]]), SHAPE).errors).all()
    with pytest.raises(LandmarkError, match="2 landmarks"):
        choose_sigma(LandmarkPairs([[1, 1], [5, 5]], [[2, 2], [5, 6]]), SHAPE)


def test_landmarks_that_contradict_each_other_have_errors_and_exact_ones_do_not(solver):
    x, y = np.meshgrid([30.0, 80.0, 130.0], [35.0, 85.0])
    sites = np.stack([x.ravel(), y.ravel()], axis=1)
    moving = np.vstack([sites - np.array([1.0, 0.0]), sites + np.array([1.0, 0.0])])
    smooth = moving + np.stack([4 * np.sin(moving[:, 1] / 60), 3 * np.cos(moving[:, 0] / 70)], axis=1)
    twofold = smooth + np.repeat([[0.0, 1.5], [0.0, -1.5]], 6, axis=0)
    assert choose_sigma(LandmarkPairs(moving, smooth), SHAPE) < 0.1
    # Each of two neighbours is 1.5 pixels from their mean in y alone: 1.5 sqrt(n / 2n) in each coordinate, but for
    # the degrees of freedom that six sites take.
    assert 0.7 * 1.5 < choose_sigma(LandmarkPairs(moving, twofold), SHAPE) < 1.5 * 1.5


def test_what_is_proved_is_found_at_every_pixel(registration):
    """Bounds decide; the extremes, which are looked for from a coarse grid on, are those of all pixels."""
    found, every = certify(registration), certify_with_positions(registration)[0]
    assert (found.proved, every.proved) == (True, False)
    assert found.evaluated < every.evaluated == SHAPE[0] * SHAPE[1]
    assert (found.det_min, found.det_max) == pytest.approx((every.det_min, every.det_max), rel=1e-9)
    assert found.det_bounds[0] <= every.det_min <= every.det_max <= found.det_bounds[1]


def test_bounds_of_steps_hold_for_difference_quotients(registration):
    """|D Phi - I| of a step, by differences of carried points that are no nodes of any grid."""
    flow, generator, d = registration.flow, np.random.default_rng(3), 1e-6
    bounds = bound_of_steps(flow, 10**6)
    angle, radius = generator.uniform(0, 2 * np.pi, 4000), np.sqrt(generator.uniform(0, 1, 4000))
    points = np.vstack([np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), flow.path[0, 0] + 1e-9])
    for k in range(flow.steps):
        first, last = k / flow.steps, (k + 1) / flow.steps
        ends = [(flow.carry(points + e, first, last) - flow.carry(points - e, first, last)) / (2 * d)
                for e in d * np.eye(2)]  # fmt: skip
        changes = np.linalg.norm(np.stack(ends, axis=-1) - np.eye(2), ord=2, axis=(1, 2))
        assert changes.max() <= bounds[k] < 1.0


def test_too_few_steps_are_not_proved(pairs):
    """Where the landmarks' way is much too long for one step, no bound decides and every pixel is evaluated."""
    away = LandmarkPairs(pairs.moving, pairs.fixed + 60.0 * np.sin(pairs.moving[:, ::-1] / 25.0))
    found = certify(register(away, SHAPE, sigma=5.0, steps=2, align="none"))
    assert not found.proved
    assert found.evaluated == SHAPE[0] * SHAPE[1]
