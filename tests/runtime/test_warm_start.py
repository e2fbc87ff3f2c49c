"""Searches that begin at the solution of a neighbour, with its multipliers."""

from __future__ import annotations

import numpy as np
import pytest
from dense_problem import INFINITY, guess_of, solve, transcribe
from known_optima import POSITIVE, double_integrator, nlp, v, x1, x2, x3
from sympy import exp

from codegen.runtime.search.cascade import begin_nearby, minimise
from codegen.runtime.search.grid import primal_unknowns
from codegen.runtime.search.iterates import FROM_NEIGHBOUR, Iterate, search_on
from codegen.runtime.search.newton import descend
from codegen.runtime.search.point import evaluate
from codegen.runtime.search.solution import Log


def test_warm_start_takes_fewer_iterations() -> None:
    motion = double_integrator()
    cold = solve(transcribe(motion, 20))
    neighbour = transcribe(motion._replace(end={x1: 1.02, v: 0}), 20)
    status, point, iterations = solve(neighbour, warm=True, guess=cold[1].unknowns)
    assert status == "solved"
    assert point.cost == pytest.approx(2.0 * np.sqrt(1.02), rel=1e-9)
    assert iterations < cold[2]


def test_a_solution_is_where_a_search_with_its_multipliers_ends() -> None:
    """Its own multipliers leave nothing to do, but to move unknowns back onto their bounds."""
    grid = transcribe(double_integrator(), 20)
    _, point, _ = solve(grid)
    status, same, iterations = solve(grid, warm=True, guess=point.unknowns)
    bare = np.where(grid.is_multiplier, 0.0, point.unknowns)
    assert status == "solved"
    assert iterations <= 1 < solve(grid, warm=True, guess=bare)[2]
    assert same.cost == pytest.approx(point.cost, rel=1e-9)


@pytest.mark.parametrize("bounds", [{}, {x1: POSITIVE}])
def test_steps_that_change_rounding_alone_end_a_search_that_is_warm(bounds) -> None:
    """Where the tolerance is out of reach; what is no rounding has to go."""
    grid = nlp((3, 3), (x1 - 1) ** 2 + exp(-x2), [exp(x1) * x2 - 1], [], bounds)
    _, point, _ = solve(grid)
    for away, most in ((0.0, 2), (1e-6, 4)):
        unknowns = point.unknowns + away * ~grid.is_multiplier
        status, found, iterations = minimise(grid, unknowns, 1e-30, 100, True, Log())
        assert status == "solved"
        assert iterations <= most
        assert found.error < 1e-14


@pytest.mark.parametrize(("complementarity", "rests"), [(0.9e-8, True), (2.5e-8, False)])
def test_a_bound_that_has_just_been_left_goes_on_moving(complementarity: float, rests: bool) -> None:
    """The optimum is at (0, 2), with duals 1 of the bound and 2 of the equation, but for the bound's distance."""
    grid = nlp((0, 2), x1 + (x2 - 3) ** 2, [x2 - 2], [], {x1: POSITIVE})
    unknowns = guess_of(grid)
    unknowns[grid.is_multiplier] = 2.0
    iterate = Iterate(evaluate(grid, unknowns), 1e-9, np.array([complementarity]), np.ones(1))
    status, _, iterations = descend(search_on(grid), iterate, FROM_NEIGHBOUR, 1e-8, 50, Log())
    assert status == "solved"
    assert (iterations == 0) == rests


def test_duals_of_a_neighbour_are_slopes_towards_bounds_that_are_closer() -> None:
    """min x1 + (x2 - 3)^2 with x1 >= 0 and x2 <= 2 has the slopes 1 and -2 at (0, 2), where x3 is free to be 5."""
    grid = nlp((0, 2, 5), x1 + (x2 - 3) ** 2 + (x3 - 5) ** 2, [x1 + x2 + x3 - 7], [], {
        x1: POSITIVE, x2: (-INFINITY, 2), x3: POSITIVE,
    })  # fmt: skip
    search = search_on(grid)
    unknowns = guess_of(grid)
    unknowns[grid.is_multiplier] = 1e-9  # of an equation that is not worth anything
    iterate = begin_nearby(search, unknowns, 1e-8)
    values = dict(zip(search.bounds.indices.tolist(), iterate.duals, strict=True))
    first, second, third = primal_unknowns(grid)
    assert values[first] == pytest.approx(1.0, abs=1e-6)
    assert values[second] == pytest.approx(2.0, abs=1e-6)
    assert values[third] == pytest.approx(1e-9 / 5.0, rel=1e-6)  # on the central path


def test_far_from_the_equations_a_search_begins_inside_the_bounds() -> None:
    """Beyond a residual of a tenth; with the multipliers of the neighbour, where there are any."""
    grid = transcribe(double_integrator(), 20)
    _, point, _ = solve(grid)
    search, primal = search_on(grid), primal_unknowns(grid)
    near = begin_nearby(search, point.unknowns, 1e-10)
    assert near.mu == pytest.approx(1e-11)
    assert near.distance.min() < 1e-7  # the control is at its bounds
    assert begin_nearby(search, np.where(grid.is_multiplier, 0.0, point.unknowns), 1e-10) is None
    away = point.unknowns.copy()
    away[primal[:4]] += 1.0
    far = begin_nearby(search, away, 1e-10)
    assert far.mu == 0.1
    assert far.distance.min() > 1e-2
    np.testing.assert_allclose(far.duals * far.distance, 0.1)
    np.testing.assert_array_equal(far.point.unknowns[grid.is_multiplier], point.unknowns[grid.is_multiplier])
    status, found, _ = solve(grid, warm=True, guess=away)
    assert status == "solved"
    assert found.cost == pytest.approx(point.cost, rel=1e-9)


def test_far_from_the_equations_a_search_without_bounds_estimates_multipliers() -> None:
    grid = nlp((3, 3), (x1 - 1) ** 2 + exp(-x2), [exp(x1) * x2 - 1])
    _, point, _ = solve(grid)
    search = search_on(grid)
    assert begin_nearby(search, point.unknowns, 1e-10) is not None
    assert begin_nearby(search, point.unknowns + 1.0 * ~grid.is_multiplier, 1e-10) is None
