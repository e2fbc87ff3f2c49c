"""What Newton's equations of the barrier are given, moves that stay inside of bounds, and the longest steps."""

import numpy as np
import pytest
from dense_problem import INFINITY, guess_of
from known_optima import nlp, x1, x2, x3

from codegen.runtime.search.direction import fill_newton_system, lower_barrier, measure_step, move
from codegen.runtime.search.first_iterate import push_inside
from codegen.runtime.search.grid import primal_unknowns
from codegen.runtime.search.iterates import search_on


def test_residuals_of_rounding_size_lead_nowhere():
    """Only those of equations: a slope stays however small it is, and so does the residual of a large error."""
    gradient, is_multiplier = np.array([3e-16, -3e-16, 2e-14, 1.0]), np.array([False, True, True, True])
    bounds = np.array([0]), np.array([1.0]), np.array([1.0])
    right, diagonal = np.empty(4), np.empty(4)
    fill_newton_system.py_func(
        (0, 0.0, 0, 0, is_multiplier), bounds, gradient, np.array([2.0]), np.array([4.0]), 1e-20, 0.5, 0.25, right,
        diagonal,
    )  # fmt: skip
    assert right == pytest.approx([3e-16, 0.0, 2e-14, 1.0], rel=1e-4, abs=1e-30)
    assert diagonal == pytest.approx([0.5 + 4.0 / 2.0, -0.25, -0.25, -0.25])


def moved(x, step, length, indices, side, distance):
    """Unknowns and distances after part of a step."""
    trial, new, m = np.empty(x.size), np.empty(distance.size), distance.size
    bounds = indices, side, np.ones(m)
    move.py_func(
        bounds, x, step, length, distance, np.ones(m), np.zeros(m), 1.0, 1e-8, trial, new, np.empty(m)
    )  # fmt: skip
    return trial, new


def test_unknowns_stay_inside_in_spite_of_rounding() -> None:
    indices, side = np.array([0, 0]), np.array([1.0, -1.0])
    for step in (-1.0, 1.0):  # from 2 to either bound, 1 or 3
        trial, distance = moved(np.array([2.0]), np.array([step]), 1.0, indices, side, np.ones(2))
        assert trial[0] == 2.0 + step
        assert (distance > 0.0).all()


@pytest.mark.parametrize(("step", "expected"), [(-1.9, 1.0 / 1.9), (-0.5, 1.0), (30.0, 1.0)])
def test_a_step_takes_at_most_half_of_a_free_duration(step, expected):
    """From 2, with the lower bound 0; without the rule, 0.99 of the duration could go in one step."""
    grid = (0,) * 4 + (np.zeros(1, bool),) + (0,) * 6 + (np.zeros(1, int),)
    bounds, numbers = (np.zeros(1, int), np.ones(1)), (np.array([2.0]), np.array([-1.0]), np.array([step]))
    *_, longest, _ = measure_step.py_func(grid, bounds, *numbers, np.array([2.0]), np.ones(1), 1e-8, np.empty(1))
    assert longest == pytest.approx(expected, rel=1e-7)


def test_distances_are_finer_than_the_rounding_of_unknowns() -> None:
    """Half of the distance 1e-18 to the bound 1 remains where the unknown itself cannot be told from the bound."""
    trial, distance = moved(np.ones(1), np.array([-1e-18]), 0.5, np.zeros(1, int), np.ones(1), np.array([1e-18]))
    assert (trial[0], distance[0]) == (1.0, 5e-19)


def test_start_is_pushed_inside() -> None:
    grid = nlp((-5, 9, 0.5), x1 + x2 + x3, [], [], {x1: (0, 1), x2: (-INFINITY, 4), x3: (0, 1)})
    pushed, arguments = guess_of(grid).copy(), search_on(grid).arguments
    push_inside(arguments[1], arguments[3], 1e-2, pushed)
    np.testing.assert_allclose(pushed[primal_unknowns(grid)], [0.01, 4 - 0.04, 0.5])


@pytest.mark.parametrize(
    ("mu", "error", "products", "expected"),
    [
        (0.1, 2.0, (0.1, 0.1), 0.1),  # the barrier problem is not solved: 2 > 10 mu
        (0.1, 0.5, (0.02, 0.1), 0.02),  # 0.2 mu is less than mu^1.5; then the error is too large
        (0.1, 0.5, (0.1, 2.0), 0.1),  # a product of a distance and its dual is far from mu
        (1e-4, 0.0, (1e-4, 1e-4), 1e-6),  # mu^1.5 is less than 0.2 mu; then the products are too large
        (1e-9, 0.0, (0.0, 0.0), 1e-10),  # not below the least parameter
    ],
)
def test_the_barrier_parameter_follows_the_rule_of_waechter_and_biegler(mu, error, products, expected):
    assert lower_barrier.py_func(mu, 1e-10, error, 1.0, *products) == pytest.approx(expected, rel=1e-12)
