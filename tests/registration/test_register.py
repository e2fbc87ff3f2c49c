"""The map and its inverse: an independent integrator, derivatives, steps chosen by themselves, what is refused."""

import re

import numpy as np
import pytest
from registered_images import SHAPE
from scipy.integrate import solve_ivp

from codegen.errors import ArgumentError, LandmarkError, RegistrationError
from codegen.registration import register
from codegen.registration.grid import coarse_grid
from codegen.registration.matching import Matching
from codegen.registration.pairs import LandmarkPairs

pytestmark = pytest.mark.usefixtures("solver")
PROBE = coarse_grid(SHAPE, 7)


def green(x, y):
    """The clamped plate's Green's function between points of the disc, shapes (m, 2) and (n, 2)."""
    s = ((x[:, None] - y[None]) ** 2).sum(-1)
    ab = (1 - (x**2).sum(-1))[:, None] * (1 - (y**2).sum(-1))[None]
    return ab / 2 - np.where(s > 0, s * np.log1p(ab / np.where(s > 0, s, 1.0)), 0.0) / 2


def slopes(q):
    """The derivative of `green(q, q)` by the first of each two points, shape (n, n, 2)."""
    d = q[:, None] - q[None]
    s, a = (d**2).sum(-1), 1 - (q**2).sum(-1)
    ab = a[:, None] * a[None]
    safe = np.where(s > 0, s, 1.0)
    by_s = np.where(s > 0, ab / (s + ab) - np.log1p(ab / safe), 0.0) / 2
    return 2 * by_s[..., None] * d - (a[None] * ab / (s + ab))[..., None] * q[:, None]


def integrated(registration, points):
    """Points of the disc carried from the fixed image by DOP853 with the momenta that the landmarks have there."""
    q, n = registration.flow.path[0, 0], len(registration.pairs)

    def field(_, y):
        q, p, x = np.split(y.reshape(-1, 2), [n, 2 * n])
        force = -((p @ p.T)[..., None] * slopes(q)).sum(1)
        return np.concatenate([green(q, q) @ p, force, green(x, q) @ p]).ravel()

    start = np.concatenate([q, registration.flow.path[0, 1], points]).ravel()
    found = solve_ivp(field, (0.0, 1.0), start, "DOP853", rtol=1e-11, atol=1e-12)
    return found.y[:, -1].reshape(-1, 2)[2 * n :]


def test_landmarks_arrive_and_points_return(registration):
    assert registration.status == "solved"
    assert registration.residuals.max() <= 1e-8
    assert registration.round_trip <= 1e-8
    assert registration.error <= 0.01
    back = registration.map_points_inverse(registration.map_points(PROBE))
    np.testing.assert_allclose(back, PROBE, atol=1e-8)


def test_the_map_is_the_one_that_an_adaptive_integrator_finds(pairs):
    fine = register(pairs, SHAPE, steps=160)
    carried = fine.matching.frame.to_pixels(integrated(fine, fine.matching.frame.to_disc(PROBE)))
    np.testing.assert_allclose(fine.map_points_inverse(PROBE), fine.alignment.apply_inverse(carried), atol=1e-7)


def test_the_estimated_error_of_the_map_is_right(registration, pairs):
    fine = register(pairs, SHAPE, steps=8 * registration.steps)
    points = np.vstack([coarse_grid(SHAPE), pairs.moving])
    error = np.linalg.norm(fine.map_points(points) - registration.map_points(points), axis=1).max()
    assert error == pytest.approx(registration.error, rel=0.2)
    finer = register(pairs, SHAPE, tolerance=registration.error / 10.0)
    assert finer.error <= registration.error / 10.0
    assert finer.steps == 2 * registration.steps


@pytest.mark.parametrize("inverse", [False, True])
def test_jacobians_are_difference_quotients(registration, inverse):
    function = registration.map_points_inverse if inverse else registration.map_points
    step = 1e-4
    columns = [(function(PROBE + d) - function(PROBE - d)) / (2 * step) for d in step * np.eye(2)]
    jacobians = registration.jacobian(PROBE, inverse)
    np.testing.assert_allclose(jacobians, np.stack(columns, axis=-1), atol=1e-6)
    np.testing.assert_allclose(registration.determinant(PROBE, inverse), np.linalg.det(jacobians), rtol=1e-12)


def test_times_lead_from_nowhere_to_the_map(registration):
    np.testing.assert_allclose(registration.positions(0.0, PROBE), PROBE, atol=1e-12)
    np.testing.assert_array_equal(registration.positions(1.0, PROBE), registration.map_points(PROBE))
    for time in (0.13, 0.5, 0.97):
        there = registration.positions(time, PROBE)
        np.testing.assert_allclose(registration.positions(time, there, inverse=True), PROBE, atol=1e-9)
    before, after = registration.positions(0.5 - 1e-6, PROBE), registration.positions(0.5 + 1e-6, PROBE)
    assert np.abs(after - before).max() < 1e-3
    with pytest.raises(LandmarkError, match="the time is"):
        registration.positions(1.5, PROBE)


def test_a_similarity_is_not_charged_to_the_flow(pairs):
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    found = register(LandmarkPairs(pairs.moving, 1.1 * pairs.moving @ turned.T + [60.0, 5.0]), SHAPE)
    assert np.abs(found.flow.path[0, 1]).max() < 1e-12
    np.testing.assert_allclose(found.map_points(PROBE), 1.1 * PROBE @ turned.T + [60.0, 5.0], atol=1e-10)
    np.testing.assert_allclose(found.determinant(PROBE), 1.21, rtol=1e-12)


def test_pixels_outside_the_disc_only_follow_the_alignment(registration):
    far = registration.alignment.apply_inverse(
        registration.matching.frame.to_pixels(np.array([[1.001, 0.0], [0.0, -3.0]]))
    )
    np.testing.assert_array_equal(registration.map_points(far), registration.alignment.apply(far))


def test_dragging_a_landmark_finds_what_a_fresh_start_finds(registration, pairs):
    fixed = pairs.fixed.copy()
    fixed[3] += [2.5, -1.5]
    moved = LandmarkPairs(pairs.moving, fixed)
    warm = register(moved, SHAPE, steps=10, start=registration)
    assert warm.rung == "shooting from a known registration"
    np.testing.assert_allclose(warm.map_points(PROBE), register(moved, SHAPE, steps=10).map_points(PROBE), atol=1e-8)


@pytest.mark.parametrize("sigma", [0.2, 1.0])
def test_a_sigma_lets_landmarks_miss_by_so_much(registration, pairs, sigma):
    loose = register(pairs, SHAPE, sigma=sigma, steps=registration.steps)
    assert np.sqrt((loose.residuals**2).mean() / 2.0) == pytest.approx(0.8 * sigma, rel=0.06)  # of eight landmarks
    scale = loose.matching.frame.radius
    misses = loose.alignment.apply(loose.map_points_inverse(pairs.fixed)) - loose.alignment.apply(pairs.moving)
    # The end condition q + strength sigma^2 p = target, in pixels of the fixed image.
    weight = loose.matching.strength * (sigma / scale) ** 2
    np.testing.assert_allclose(misses, -weight * loose.flow.path[-1, 1] * scale, atol=1e-7)


def test_a_sigma_beyond_the_residuals_of_the_alignment_leaves_the_alignment(pairs):
    loose = register(pairs, SHAPE, sigma=50.0)
    np.testing.assert_allclose(loose.map_points(PROBE), loose.alignment.apply(PROBE), atol=1e-2)


@pytest.fixture
def tangled(pairs):
    """Two more landmarks, very close together, that part and change places."""
    moving = np.vstack([pairs.moving, [[80.0, 60.0], [80.0 + 1e-7, 60.0]]])
    return LandmarkPairs(moving, np.vstack([pairs.fixed, [[110.0, 60.0], [50.0, 60.0]]]))


def test_landmarks_that_change_places_at_close_range_are_named(tangled):
    with pytest.raises(RegistrationError, match=r"hardest are landmarks 9 and 10, near \(80\.0, 60\.0\)"):
        register(tangled, SHAPE)


def test_a_map_that_misses_its_landmarks_is_not_called_solved(tangled):
    """Two steps bring both to nearly the same place, from where no way leads back."""
    found = register(tangled, SHAPE, steps=2)
    assert found.status == "folded"
    assert re.search(r"misses landmark (9|10), at \(80\.0, 60\.0\), by 60 pixels", found.message)


@pytest.mark.parametrize("arguments", [{"sigma": -1.0}, {"sigma": np.nan}, {"margin": 0.0}, {"steps": 0},
                                       {"tolerance": 0.0}, {"fixed_shape": (0, 5)}])  # fmt: skip
def test_unusable_arguments_are_refused(pairs, arguments):
    with pytest.raises(LandmarkError):
        register(pairs, SHAPE, **arguments)


@pytest.mark.parametrize("sigma", [1.0, 10.0, 30.0])
def test_landmarks_that_may_miss_do_not_meet_half_way(sigma):
    """The best inexact motion costs no more than the exact one, whose cost is its action alone."""
    swapped = LandmarkPairs([[200, 250], [300, 250]], [[300, 250], [200, 250]])
    flow, exact, _ = Matching.of(swapped, (512, 512), align="none").solve(32, quick=True)
    loose, solution, _ = Matching.of(swapped, (512, 512), align="none", sigma=sigma).solve(32, quick=True)
    penalised = flow.module.penalised
    assert penalised(flow.case, exact.cost, exact.q[-1]) == 0.5 * exact.cost
    assert penalised(loose.case, solution.cost, solution.q[-1]) < 0.5 * exact.cost


def test_a_quick_registration_without_steps_is_refused():
    pairs = LandmarkPairs([[10.0, 20.0], [80.0, 90.0]], [[12.0, 24.0], [90.0, 70.0]])
    with pytest.raises(ArgumentError, match=r"quick=True\) has no number of steps; give one, as in steps=16"):
        register(pairs, SHAPE, quick=True)
