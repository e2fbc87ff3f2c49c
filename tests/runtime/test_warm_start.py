"""Searches that begin at the solution of a neighbour, with its multipliers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from dense_problem import INFINITY, transcribe
from dense_runtime import dense_linear_algebra, leave_out_bounds, solve
from known_optima import POSITIVE, double_integrator, nlp, v, x1, x2, x3
from sympy import exp

from codegen.runtime.optimise import bounded, newton, unbounded, warm_start


@pytest.fixture(scope="module", autouse=True)
def dense() -> Iterator[None]:
    with dense_linear_algebra():
        yield


@pytest.fixture
def without_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_bounds(monkeypatch)


def test_warm_start_takes_fewer_iterations() -> None:
    motion = double_integrator()
    cold = solve(transcribe(motion, 20))
    neighbour = transcribe(motion._replace(end={x1: 1.02, v: 0}), 20)
    guess = np.where(neighbour.free, cold[1].unknowns, neighbour.guess)
    status, point, iterations = solve(neighbour, warm=True, guess=guess)
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


@pytest.mark.usefixtures("without_bounds")
def test_steps_that_change_rounding_alone_end_a_search_that_is_warm() -> None:
    """Where the tolerance is out of reach; half of an error is progress, and what is no rounding has to go."""
    grid = nlp((3, 3), (x1 - 1) ** 2 + exp(-x2), [exp(x1) * x2 - 1])
    _, point, _ = solve(grid)
    search = unbounded.search_on(grid)

    def rests(stationarity: float, before: float) -> bool:
        found = point._replace(residual=0.0, stationarity=stationarity, error=stationarity)
        return newton.is_at_rest(search, unbounded.Iterate(found), before, 1e-30)

    assert rests(1e-15, 1.5e-15)
    assert not rests(1e-15, 1e-14)
    assert not rests(1e-6, 1.5e-6)


@pytest.mark.parametrize(("complementarity", "rests"), [(0.9e-8, True), (2.5e-8, False)])
def test_a_bound_that_has_just_been_left_goes_on_moving(complementarity: float, rests: bool) -> None:
    """Its complementarity is above the tolerance, although the sum over all bounds is below one for each."""
    grid = nlp((1, 2, 5), (x1 - 1) ** 2 + (x2 - 2) ** 2 + (x3 - 5) ** 2, [x1 + x2 + x3 - 8], [], {
        x1: POSITIVE, x2: POSITIVE, x3: POSITIVE,
    })  # fmt: skip
    search = bounded.search_on(grid)
    begun = bounded.measured_iterate(search, bounded.begin(search, grid.guess, bounded.FROM_NEIGHBOUR))
    point = begun.point._replace(residual=0.0, stationarity=1e-15, error=1e-15)
    iterate = begun._replace(
        point=point, measured=begun.measured._replace(highest=complementarity, gap=complementarity)
    )
    assert newton.is_at_rest(search, iterate, 1.5e-15, 1e-8) == rests


def test_duals_of_a_neighbour_are_slopes_towards_bounds_that_are_closer() -> None:
    """min x1 + (x2 - 3)^2 with x1 >= 0 and x2 <= 2 has the slopes 1 and -2 at (0, 2), where x3 is free to be 5."""
    grid = nlp((0, 2, 5), x1 + (x2 - 3) ** 2 + (x3 - 5) ** 2, [x1 + x2 + x3 - 7], [], {
        x1: POSITIVE, x2: (-INFINITY, 2), x3: POSITIVE,
    })  # fmt: skip
    search = bounded.search_on(grid)
    unknowns = grid.guess.copy()
    unknowns[grid.is_multiplier] = 1e-9  # of an equation that is not worth anything
    iterate = warm_start.begin_nearby(search, unknowns, 1e-8)
    values = dict(zip(search.bounds.indices.tolist(), iterate.duals, strict=True))
    first, second, third = np.flatnonzero(~grid.is_multiplier)[:3]
    assert values[first] == pytest.approx(1.0, abs=1e-6)
    assert values[second] == pytest.approx(2.0, abs=1e-6)
    assert values[third] == pytest.approx(1e-9 / 5.0, rel=1e-6)  # on the central path


def test_far_from_the_equations_a_search_begins_inside_the_bounds() -> None:
    """Beyond a residual of a tenth; with the multipliers of the neighbour, where there are any."""
    grid = transcribe(double_integrator(), 20)
    _, point, _ = solve(grid)
    search, primal = bounded.search_on(grid), np.flatnonzero(~grid.is_multiplier & grid.free)
    near = warm_start.begin_nearby(search, point.unknowns, 1e-10)
    assert near.mu == pytest.approx(1e-11)
    assert near.distance.min() < 1e-7  # the control is at its bounds
    assert warm_start.begin_nearby(search, np.where(grid.is_multiplier, 0.0, point.unknowns), 1e-10) is None
    away = point.unknowns.copy()
    away[primal[:4]] += 1.0
    far = warm_start.begin_nearby(search, away, 1e-10)
    assert far.mu == 0.1
    assert far.distance.min() > 1e-2
    np.testing.assert_allclose(far.duals * far.distance, 0.1)
    np.testing.assert_array_equal(far.point.unknowns[grid.is_multiplier], point.unknowns[grid.is_multiplier])
    status, found, _ = solve(grid, warm=True, guess=away)
    assert status == "solved"
    assert found.cost == pytest.approx(point.cost, rel=1e-9)


@pytest.mark.usefixtures("without_bounds")
def test_far_from_the_equations_a_search_without_bounds_estimates_multipliers() -> None:
    grid = nlp((3, 3), (x1 - 1) ** 2 + exp(-x2), [exp(x1) * x2 - 1])
    _, point, _ = solve(grid)
    search = unbounded.search_on(grid)
    assert warm_start.begin_nearby(search, point.unknowns, 1e-10) is not None
    assert warm_start.begin_nearby(search, point.unknowns + 1.0, 1e-10) is None
