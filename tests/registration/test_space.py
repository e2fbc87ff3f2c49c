"""Registration of points in space: kernels near their singularities, maps, alignments, errors, the proof of steps."""

import mpmath
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from codegen.errors import LandmarkError
from codegen.registration import leave_one_out, register
from codegen.registration.certificate import bound_of_steps, certify, in_provable_steps
from codegen.registration.grid import Grid
from codegen.registration.maps import in_steps
from codegen.registration.noise import choose_sigma, find_outliers
from codegen.registration.pairs import LandmarkPairs, align

pytestmark = pytest.mark.usefixtures("space_solver")
UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
GRID = Grid((64, 60, 40), (0.0, 0.0, 0.0), (1.0, 1.0, 1.5), UPRIGHT)


def waves(points):
    """A smooth displacement of about 3, whose derivative is small enough for a map without folds."""
    x, y, z = points.T
    return points + np.stack([3 * np.sin(y / 12), 2 * np.cos(z / 15), 2.5 * np.sin((x + z) / 18)], axis=1)


def scattered(count, seed=0, margin=0.1):
    share = np.random.default_rng(seed).uniform(margin, 1.0 - margin, (count, 3))
    return GRID.to_places(share * (np.array(GRID.size) - 1.0))


def wavy_pairs(count, seed=0):
    moving = scattered(count, seed)
    return LandmarkPairs(moving, waves(moving))


# ---- The kernel ----


def boggio(x, y):
    """The formula of 1905, with as many digits as mpmath is told to have."""
    x, y = (mpmath.matrix([mpmath.mpf(float(v)) for v in point]) for point in (x, y))
    distance = mpmath.sqrt(sum((a - b) ** 2 for a, b in zip(x, y)))
    a = mpmath.sqrt(1 + (1 - sum(v * v for v in x)) * (1 - sum(v * v for v in y)) / distance**2)
    return distance * (a + 1 / a - 2)


@pytest.mark.parametrize("distance", [0.5, 1e-3, 1e-8, 1e-15, 1e-60, 1e-120])
def test_the_kernel_is_boggios_where_points_nearly_meet(space_solver, distance):
    places = np.array([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]])
    assert kernel(space_solver, places) == pytest.approx(exactly(places, 400), rel=1e-15)


@pytest.mark.parametrize("far", [1e-2, 1e-5, 1e-9, 1e-13])
def test_the_kernel_is_boggios_near_the_rim(space_solver, far):
    """There it goes to zero as the square of the distance from the rim, where a difference would have no digits."""
    places = np.array([[0.6 * (1 - far), 0.8 * (1 - far), 0.0], [0.1, -0.2, 0.3]])
    assert kernel(space_solver, places) == pytest.approx(exactly(places, 60), rel=1e-14)
    shrunk = np.array([[0.0, 0.0, 1.0 - far], [0.1, -0.2, 0.3]])
    assert kernel(space_solver, shrunk) == pytest.approx(exactly(shrunk, 60), rel=1e-14)


def kernel(module, places):
    matrix = np.empty((2, 2))
    module.momentum_matrix(np.stack([places, np.zeros((2, 3))]), np.zeros((2, 0)), np.zeros(0), matrix)
    return matrix[0, 1]


def exactly(places, digits):
    with mpmath.workdps(digits):
        return float(boggio(*places))


def test_derivatives_of_the_kernel_have_the_bounds_of_the_proof():
    """Norms of first and second derivatives against 40 digits of Boggio's formula, over the ball."""
    generator = np.random.default_rng(0)
    for _ in range(60):
        x, q = generator.normal(size=(2, 3))
        x *= generator.uniform(0, 0.999) / np.linalg.norm(x)
        q *= generator.uniform(0, 0.8) / np.linalg.norm(q)
        with mpmath.workdps(40):
            step = mpmath.mpf(10) ** -12

            def shifted(a, b, i, j, x=x, q=q, step=step):
                moved = [mpmath.mpf(float(v)) for v in x]
                moved[i] += a * step
                moved[j] += b * step
                return exact_boggio(moved, q)

            gradient = [float((shifted(1, 0, i, i) - shifted(-1, 0, i, i)) / (2 * step)) for i in range(3)]
            second = [
                [
                    float(
                        (shifted(1, 1, i, j) - shifted(1, -1, i, j) - shifted(-1, 1, i, j) + shifted(-1, -1, i, j))
                        / (4 * step**2)
                    )
                    for j in range(3)
                ]
                for i in range(3)
            ]
        far, apart = np.linalg.norm(q), np.linalg.norm(x - q)
        assert np.linalg.norm(gradient) <= 2.0 + far
        values = np.linalg.eigvalsh(second)
        assert values[0] >= -2.0 / apart * (1 + 1e-9)
        assert values[-1] <= 2.0 * (1.0 + far) ** 2 / max(apart, 1.0 - far) * (1 + 1e-9)


def exact_boggio(x, q):
    q = [mpmath.mpf(float(v)) for v in q]
    distance = mpmath.sqrt(sum((a - b) ** 2 for a, b in zip(x, q)))
    a = mpmath.sqrt(1 + (1 - sum(v * v for v in x)) * (1 - sum(v * v for v in q)) / distance**2)
    return distance * (a + 1 / a - 2)


# ---- Maps ----


def test_landmarks_are_met_nothing_folds_and_all_comes_back():
    pairs = wavy_pairs(30)
    found = register(pairs, GRID)
    np.testing.assert_allclose(found.map_points(pairs.moving), pairs.fixed, atol=1e-7)
    points = scattered(400, 5, 0.02)
    np.testing.assert_allclose(found.map_points_inverse(found.map_points(points)), points, atol=1e-8)
    # Independent of the derivative that is carried along: differences, away from the kinks at landmarks.
    away = points[np.linalg.norm(points[:, None] - pairs.moving, axis=2).min(axis=1) > 2.0]
    columns = [(found.map_points(away + 1e-4 * e) - found.map_points(away - 1e-4 * e)) / 2e-4 for e in np.eye(3)]
    determinants = np.linalg.det(np.stack(columns, axis=2))
    assert determinants.min() > 0.0
    np.testing.assert_allclose(found.determinant(away), determinants, rtol=1e-5)
    np.testing.assert_allclose(found.leaving(away)[1], determinants, rtol=1e-5)
    there, factors = found.arriving(found.map_points(away))
    np.testing.assert_allclose(there, away, atol=1e-8)
    np.testing.assert_allclose(factors, determinants, rtol=1e-5)


def test_the_map_does_not_depend_on_how_volumes_lie_nor_on_the_unit():
    """Turned, shifted and in metres, everything moves along."""
    pairs, points = wavy_pairs(20), scattered(50, 3)
    found = register(pairs, GRID, align="none")
    turn = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    shift, size = np.array([-40.0, 17.0, 8.0]), 1e-3

    def placed(values):
        return size * (values @ turn.T + shift)

    grid = Grid(GRID.size, tuple(size * shift), tuple(size * s for s in GRID.spacing), tuple(map(tuple, turn)), "m")
    other = register(LandmarkPairs(placed(pairs.moving), placed(pairs.fixed)), grid, align="none")
    np.testing.assert_allclose(other.map_points(placed(points)), placed(found.map_points(points)), atol=1e-9 * size)
    assert (other.steps, other.matching.fixed_grid.unit) == (found.steps, "m")


def test_landmarks_in_the_plane_do_not_go_with_volumes():
    flat = LandmarkPairs([[1, 2]], [[2, 3]])
    with pytest.raises(LandmarkError, match="landmarks have x and y, and the images are volumes"):
        register(flat, GRID)
    with pytest.raises(LandmarkError, match="an image is flat"):
        register(LandmarkPairs([[1, 2, 3]], [[2, 3, 4]]), (20, 20))


CHANGING = np.array([[20.0, 30.0, 30.0], [24.0, 30.0, 30.0], [40.0, 40.0, 20.0], [12.0, 12.0, 12.0], [50.0, 15.0, 40]])


def test_landmarks_change_places_without_a_fold():
    pairs = LandmarkPairs(CHANGING, CHANGING[[1, 0, 2, 3, 4]])
    found = in_provable_steps(register(pairs, GRID, align="none"))
    np.testing.assert_allclose(found.map_points(CHANGING), pairs.fixed, atol=1e-6)
    assert certify(found).proved


def test_a_map_of_too_few_steps_names_the_landmark_that_it_misses():
    pairs = LandmarkPairs(CHANGING, CHANGING[[1, 0, 2, 3, 4]], ("left", "right", "c", "d", "e"))
    found = register(pairs, GRID, align="none", steps=1)
    assert found.status == "folded"
    assert "misses landmark left, at (20.0, 30.0, 30.0), by 6" in found.message
    assert not certify(found).passed


@pytest.mark.parametrize("apart", [1e-1, 1e-3, 1e-5, 1e-6, 1e-7, 1e-9, 1e-12])
def test_landmarks_that_are_nearly_one_are_solved(apart):
    moving = scattered(10)
    moving[1] = moving[0] + [apart, 0.0, 0.0]
    found = register(LandmarkPairs(moving, waves(moving)), GRID)
    np.testing.assert_allclose(found.map_points(moving), waves(moving), atol=1e-6)


@pytest.mark.parametrize("angle", [60, 120, 180])
def test_whole_turns_are_solved_without_an_alignment(angle):
    moving = scattered(20)
    middle = moving.mean(axis=0)
    turned = Rotation.from_rotvec(np.radians(angle) * np.array([0.0, 0.6, 0.8])).apply(moving - middle) + middle
    found = register(LandmarkPairs(moving, turned), GRID, align="none")
    np.testing.assert_allclose(found.map_points(moving), turned, atol=1e-6)
    assert certify(found).folded == 0


# ---- Alignments ----


def test_similarities_and_affine_maps_are_found_as_they_were_made():
    points = scattered(12)
    turn = Rotation.from_euler("xyz", [0.4, -0.3, 1.1])
    found = align(LandmarkPairs(points, 1.3 * turn.apply(points) + [4.0, -2.0, 9.0]), "similarity")
    np.testing.assert_allclose(found.matrix, 1.3 * turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.apply_inverse(found.apply(points)), points, atol=1e-10)
    assert found.determinant == pytest.approx(1.3**3)
    assert found.parameters == 7
    half = found.part(0.5, points.mean(axis=0))
    np.testing.assert_allclose(half.matrix @ half.matrix, found.matrix, atol=1e-12)
    matrix = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, -0.1], [0.1, 0.0, 1.2]])
    found = align(LandmarkPairs(points, points @ matrix.T + [1.0, 2.0, 3.0]), "affine")
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-12)
    assert found.parameters == 12
    noisy = 0.8 * turn.apply(points) + np.random.default_rng(1).normal(size=points.shape)
    fitted = align(LandmarkPairs(points, noisy), "similarity").matrix
    best = Rotation.align_vectors(noisy - noisy.mean(axis=0), points - points.mean(axis=0))[0].as_matrix()
    np.testing.assert_allclose(fitted / np.cbrt(np.linalg.det(fitted)), best, atol=1e-9)


def test_landmarks_that_do_not_determine_an_alignment_get_a_simpler_one():
    points = scattered(6)
    flat = points * [1.0, 1.0, 0.0]
    found = align(LandmarkPairs(flat, flat + np.array([0.0, 0.0, 3.0])), "affine")
    assert (found.kind, "four landmarks that are not in one plane" in found.message) == ("similarity", True)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert align(LandmarkPairs(line, line + 1.0), "similarity").kind == "translation"
    assert align(LandmarkPairs(points[:2], points[:2] + 1.0), "affine").kind == "translation"


def test_mirrored_landmarks_are_refused_at_once():
    points = scattered(10)
    with pytest.raises(LandmarkError, match="mirror the image"):
        register(LandmarkPairs(points, points * [-1.0, 1.0, 1.0] + [63.0, 0.0, 0.0]), GRID)


# ---- Errors of landmarks ----


def test_residuals_are_of_the_size_of_sigma():
    pairs = wavy_pairs(60)
    noise = np.random.default_rng(2).normal(size=(60, 3))
    noisy = LandmarkPairs(pairs.moving, pairs.fixed + 1.5 * noise)
    found = register(noisy, GRID, sigma=1.5)
    assert 0.75 < np.sqrt((found.residuals**2).mean() / 3.0) / 1.5 < 1.0  # the fit follows errors a little
    probe = scattered(200, 9)
    errors = [np.linalg.norm(r.map_points(probe) - waves(probe), axis=1).mean() for r in (found, register(noisy, GRID))]
    assert errors[0] < errors[1]
    assert choose_sigma(noisy, GRID) == pytest.approx(1.5, rel=0.5)


def test_a_landmark_out_of_place_is_named():
    pairs = wavy_pairs(30)
    fixed = pairs.fixed.copy()
    fixed[11] += [12.0, -9.0, 8.0]
    assert find_outliers(LandmarkPairs(pairs.moving, fixed), GRID).numbers == (11,)
    assert leave_one_out(LandmarkPairs(pairs.moving, fixed), GRID).ranking[0] == 11


# ---- Certificates ----


def test_steps_are_within_their_bounds():
    """|D Phi - I| of single steps at points of the ball, those beside landmarks among them."""
    flow = register(wavy_pairs(12), GRID, steps=6).flow
    bounds = bound_of_steps(flow, 4_000_000)
    generator = np.random.default_rng(0)
    for k in range(flow.steps):
        beside = flow.path[k, 0] + 1e-4 * generator.normal(size=flow.path[k, 0].shape)
        points = np.vstack([beside, 0.55 * generator.uniform(-1, 1, (2000, 3))])
        tangents = flow.carry_with_jacobian(points, k / flow.steps, (k + 1) / flow.steps)[1]
        assert np.linalg.norm(tangents - np.eye(3), ord=2, axis=(1, 2)).max() <= bounds[k] < 1.0


def test_the_certificate_is_proved_and_agrees_with_all_voxels():
    found = register(wavy_pairs(12), GRID)
    small = Grid((9, 7, 5), (10.0, 10.0, 10.0), (5.0, 6.0, 9.0), UPRIGHT)
    seen = certify(found, small)
    determinants = found.arriving(small.samples(99))[1]
    assert seen.proved
    assert (seen.det_min, seen.det_max) == (determinants.min(), determinants.max())
    assert seen.det_bounds[0] < seen.det_min < seen.det_max < seen.det_bounds[1]
    assert found.map_points_inverse([seen.det_min_at]).shape == (1, 3)


def test_more_steps_are_made_where_few_prove_nothing():
    moving = np.array([[20.0, 30.0, 30.0], [30.0, 30.0, 30.0], [40.0, 40.0, 20.0], [12.0, 12.0, 12.0]])
    strong = LandmarkPairs(moving, moving + np.array([[8.0, 0, 0], [-3.0, 4.0, 0], [0, 0, 5.0], [0, 0, 0]]))
    few = in_steps(register(strong, GRID, align="none").matching, 3)
    assert bound_of_steps(few.flow, 200_000) is None
    more = in_provable_steps(few)
    assert more.steps > 3
    assert certify(more).proved


@pytest.mark.parametrize("seed", [0, 1])
def test_landmarks_in_another_order_are_proved_not_to_fold(seed):
    """Landmarks that change places pull hard near each other, where small cells decide."""
    fixed = wavy_pairs(12).fixed
    found = register(LandmarkPairs(fixed[np.random.default_rng(seed).permutation(12)], fixed), GRID, align="none")
    found = in_provable_steps(found)
    assert certify(found).proved
    bounds = bound_of_steps(found.flow, 200_000)
    generator = np.random.default_rng(0)
    for k in range(0, found.steps, 4):
        places = found.flow.path[k, 0]
        points = np.vstack([places + scale * generator.normal(size=places.shape) for scale in (1e-4, 0.01, 0.1)])
        tangents = found.flow.carry_with_jacobian(points, k / found.steps, (k + 1) / found.steps)[1]
        assert np.linalg.norm(tangents - np.eye(3), ord=2, axis=(1, 2)).max() <= bounds[k] < 1.0


def test_voxels_are_evaluated_in_slabs_where_nothing_is_proved(monkeypatch):
    found = register(wavy_pairs(12), GRID)
    monkeypatch.setattr("codegen.registration.certificate.bound_of_steps", lambda flow, most: None)
    monkeypatch.setattr("codegen.registration.certificate.PORTION", 100)
    small = Grid((9, 7, 5), (10.0, 10.0, 10.0), (5.0, 6.0, 9.0), UPRIGHT)
    seen = certify(found, small)
    places = small.samples(99)
    determinants = found.arriving(places)[1]
    assert (seen.proved, seen.evaluated, seen.folded) == (False, 9 * 7 * 5, 0)
    assert (seen.det_min, seen.det_max) == (determinants.min(), determinants.max())
    assert seen.det_min_at == tuple(places[determinants.argmin()])
