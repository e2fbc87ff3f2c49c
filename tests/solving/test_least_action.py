"""Paths of least action: their gradient, the matrix that scales it, a closed form, and motions that need them."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.runtime.particles import cascade, least_action

START = np.array([[0.1, 0.2], [-0.4, 0.1], [0.3, -0.5]])
TARGET = START + np.array([[0.12, -0.05], [0.03, 0.1], [-0.08, 0.04]])
SIGMA = np.array([0.0, 0.3, 0.1])


@pytest.fixture
def made(interpreted):
    return interpreted("image_registration", arguments={}, scheme="rk4", method=None)


@pytest.fixture
def bent(made):
    case = made.make_case(START, TARGET, 4, sigma=SIGMA)
    positions = least_action.bent_path(case, 4, 0.3)
    positions[-1, SIGMA > 0.0] += 0.02
    return case, positions


@pytest.mark.slow
def test_the_gradient_of_the_action(made, bent):
    case, positions = bent
    gradient = least_action.action_of(case, positions)[1]
    for k in range(1, 5):
        for i in range(3):
            for a in range(2):
                step = np.zeros_like(positions)
                step[k, i, a] = 1e-5
                change = (
                    least_action.action_of(case, positions + step)[0]
                    - least_action.action_of(case, positions - step)[0]
                )
                expected = 0.0 if k == 4 and SIGMA[i] == 0.0 else change / 2e-5
                assert gradient[k, i, a] == pytest.approx(expected, abs=2e-8)


def test_elimination_solves_with_the_block_tridiagonal_matrix(made, bent):
    case, positions = bent
    inverses = least_action.action_of(case, positions)[3]
    forces = np.random.default_rng(0).normal(size=(4, 3, 2))
    forces[-1, 0] = 0.0  # the first landmark's target is met exactly
    moved = np.concatenate([np.zeros((1, 3, 2)), least_action.relaxed(*least_action.stiffness(case, inverses), forces)])
    pulls = 4.0 * np.einsum("kij,kja->kia", inverses, moved[1:] - moved[:-1])
    expected = pulls - np.concatenate([pulls[1:], np.zeros((1, 3, 2))])
    expected[-1, 1:] += moved[-1, 1:] / SIGMA[1:, None] ** 2
    expected[-1, 0] = 0.0
    np.testing.assert_allclose(expected, forces, atol=1e-9)
    assert (moved[-1, 0] == 0.0).all()


@pytest.mark.parametrize("sigma", [0.0, 0.2])
def test_a_landmark_on_a_hyperbolic_line(made, sigma):
    """H is kinetic energy on the Poincare disc, with G = 1/2 in the middle: p = 2 atanh(r) leads to the radius r.

    With a sigma, r + sigma^2 p/(1 - r^2) is the target's radius, for p (1 - r^2) is constant. The descent ends when the
    action changes by a millionth, that is, momenta by a thousandth.
    """
    r = 0.5
    momentum = 2.0 * np.arctanh(r)
    target = r + sigma**2 * momentum / (1.0 - r**2)
    case = made.make_case([[0.0, 0.0]], [[0.0, target]], 40, sigma=sigma)
    np.testing.assert_allclose(made.momenta_of_least_action(case), [[0.0, momentum]], atol=1e-3)
    solution = made.solve([[0.0, 0.0]], [[0.0, target]], 40, sigma=sigma)
    np.testing.assert_allclose(solution.p[0], [[0.0, momentum]], atol=1e-6)


@pytest.mark.parametrize("swapped", [(0, 1), (0, 1, 2, 3)])
def test_landmarks_that_change_positions(made, swapped):
    """On the straight way they would meet, where G has no inverse: a path of least action goes around."""
    start = np.array([[-0.3, 0.0], [0.3, 0.0], [0.0, 0.4], [0.0, -0.4]])[list(swapped)]
    target = start.reshape(-1, 2, 2)[:, ::-1].reshape(-1, 2)
    case = made.make_case(start, target, 8)
    with np.errstate(all="ignore"):  # interpreted code warns where compiled code does not
        solution = made.solve_case(case, made.momenta_of_least_action(case))
    assert solution.status == "solved", solution.message
    np.testing.assert_allclose(solution.q[-1], target, atol=1e-9)
    apart = np.linalg.norm(solution.q[:, 0] - solution.q[:, 1], axis=1)
    assert apart.min() > 0.1


def test_with_a_sigma_they_do_not_end_half_way(made):
    """The best inexact motion costs no more than the exact one, whose cost is its action alone."""
    start, target = START[:2], START[1::-1].copy()
    case = made.make_case(start, target, 8, sigma=0.05)
    with np.errstate(all="ignore"):  # interpreted code warns where compiled code does not
        exact, loose = made.solve(start, target, 8), made.solve_case(case)
    assert (exact.status, loose.status) == ("solved", "solved")
    assert made.penalised(case, loose.cost, loose.q[-1]) < 0.5 * exact.cost
    assert np.linalg.norm(loose.q[-1] - target, axis=1).max() < 0.05
    assert loose.attempts[-1].endswith("it costs less")


def test_of_too_many_particles_no_path_is_sought(made):
    """Five matrices of 1000 by 1000 numbers are as many as are worked with, and too few for a path."""
    angle, radius = np.linspace(0.0, 6.0, 1000), np.linspace(0.1, 0.8, 1000)
    many = radius[:, None] * np.stack([np.cos(40.0 * angle), np.sin(40.0 * angle)], axis=1)
    case = made.make_case(many, many[::-1].copy(), 4)
    assert np.isnan(made.momenta_of_least_action(case)).all()
    path, points = cascade.allocate_path(case)
    assert cascade.OUTCOMES[cascade.from_least_action(case, None, path, points, None)[0]].startswith("no guessed path")


def test_a_sigma_too_small_for_its_square_is_no_warning(made):
    """Swapped landmarks, which need the descent, with a sigma whose square is not a number that a computer holds."""
    case = made.make_case(START[:2], START[1::-1].copy(), 4, sigma=1e-170)
    assert made.momenta_of_least_action(case).shape == (2, 2)


SPRING = '''
"""Masses that springs join, each to every other."""

from codegen import *


def problem():
    i, j = particles("x", "p")
    return Connect(
        hamiltonian=Pairwise((i, j), self_term=i.p[0] ** 2 / 2, pair_term=(i.q[0] - j.q[0]) ** 2 / 2),
        points="none.csv", duration=1, steps=10,
    )
'''


def test_particles_with_a_potential_have_no_such_attempt(interpreted):
    """Two masses at the ends of a spring: their distance is a sum of sin and cos of sqrt(2) t."""
    spring = interpreted("spring", text=SPRING, arguments={}, scheme="rk4", method=None)
    solution = spring.solve([[0.0], [1.0]], [[0.5], [3.0]], 40)
    assert solution.status == "solved"
    w = np.sqrt(2.0)
    assert cascade.LEAST_ACTION not in cascade.attempts_of(spring.make_case([[0.0], [1.0]], [[0.5], [3.0]]), "stepping")
    rate = w * (2.5 - np.cos(w)) / np.sin(w)  # of the distance, from 1 to 2.5
    np.testing.assert_allclose(solution.p[0, 1] - solution.p[0, 0], rate, rtol=1e-6)
