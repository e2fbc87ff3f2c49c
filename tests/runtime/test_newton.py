"""The search on problems with known optima, and every way in which it can end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from dense_problem import INFINITY, Motion, assert_optimal, guess_of, solve, transcribe, variables, with_hessian
from known_optima import HOCK_SCHITTKOWSKI, POSITIVE, TRAJECTORIES, double_integrator, nlp, u, v, x, x1, x2, x3
from sympy import exp, log, sqrt, symbols

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.cascade import FROM_ANYWHERE, minimise
from codegen.runtime.search.descent import UNBOUNDED_BELOW
from codegen.runtime.search.grid import primal_unknowns
from codegen.runtime.search.iterates import FROM_GUESS, begin, search_on
from codegen.runtime.search.newton import restored
from codegen.runtime.search.point import constraints, jacobian
from codegen.runtime.search.solution import Log

KNOWN = {**HOCK_SCHITTKOWSKI, **TRAJECTORIES}


@pytest.mark.parametrize("name", KNOWN)
def test_known_optimum(name: str) -> None:
    optimum, of_ipopt, problem = KNOWN[name]
    grid = problem()
    status, point, iterations = solve(grid)
    assert status == "solved"
    assert iterations <= 1.3 * of_ipopt + 2
    if optimum is not None:
        assert point.cost == pytest.approx(optimum, rel=1e-6 if name in TRAJECTORIES else 1e-8, abs=1e-9)
    assert point.stationarity <= 1e-10
    assert_optimal(grid, point)


def test_bounds_hold_exactly_and_the_optimality_conditions_there() -> None:
    """With so steep a cost the move of 1e-12 onto the bound alone would leave a slope of 1e-7."""
    grid = nlp((2, 3), 5e4 * (x1 - x2) ** 2 + 1000 * x1, bounds={x1: (1, INFINITY)})
    status, point, _ = solve(grid)
    assert status == "solved"
    assert variables(grid, point) == pytest.approx([1, 1], rel=1e-12)
    assert_optimal(grid, point)
    assert point.stationarity <= 1e-10  # as told


def test_fewest_seconds_from_rest_to_rest() -> None:
    grid = transcribe(double_integrator(), 20)
    status, point, iterations = solve(grid)
    assert status == "solved"
    assert point.cost == pytest.approx(2.0, rel=1e-9)  # with an even number of intervals the switch lies on a node
    assert iterations <= 15
    assert_optimal(grid, point)


def test_path_inequality() -> None:
    """Bryson and Denham's problem: least effort below x = l, which is 4 / (9 l) for l <= 1/6."""
    costs = []
    for steps in (20, 40):
        bounds = {x1: (-INFINITY, 1 / 9)}
        motion = Motion([x1, v], [u], [v, u], 1.0, u**2 / 2, {x1: 0, v: 1}, {x1: 0, v: -1}, {}, bounds)
        status, point, _ = solve(transcribe(motion, steps))
        assert status == "solved"
        costs.append(point.cost)
    errors = [abs(cost - 4.0) for cost in costs]
    assert errors[1] < 0.4 * errors[0] < 0.02


def test_obstacle_in_the_way() -> None:
    """The shortest way past a disc: two tangents and an arc; the disc is kept clear of at midpoints."""
    w = symbols("w")
    start, end = {x1: 0, x2: 0}, {x1: 1, x2: 0}
    disc = [0.04 - (x1 - 0.5) ** 2 - (x2 + 0.05) ** 2]
    guess = {x1: (0.0, 1.0), x2: 0.1, u: 1.0}
    motion = Motion([x1, x2], [u, w], [u, w], 1.0, u**2 + w**2, start, end, guess, {}, disc)
    status, point, _ = solve(transcribe(motion, 40))
    assert status == "solved"
    distance, radius = np.hypot(0.5, 0.05), 0.2
    angle = np.pi - 2 * np.arctan(0.1) - 2 * np.arccos(radius / distance)
    length = 2 * np.sqrt(distance**2 - radius**2) + radius * angle
    assert point.cost == pytest.approx(length**2, rel=2e-3)


def test_counterexample_of_waechter_and_biegler() -> None:
    """Newton's steps, cut by the bounds, never become feasible here; restoration has to step in."""
    grid = nlp((-2, 3, 1), x1, [x1**2 - x2 - 1, x1 - x3 - 0.5], [], {x2: POSITIVE, x3: POSITIVE})
    status, point, _ = solve(grid)
    assert status == "solved"
    assert point.cost == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("equations", [[x1 + x2 + x3 - 1, 2 * (x1 + x2 + x3) - 2], [x1**2 + x2**2 - 1] * 2])
def test_redundant_equations(equations: list[Any]) -> None:
    grid = nlp((1, 1, 1), (x1 - 2) ** 2 + (x2 - 1) ** 2 + x3**2, equations, [], {x2: POSITIVE, x3: (0.1, INFINITY)})
    alone = nlp((1, 1, 1), (x1 - 2) ** 2 + (x2 - 1) ** 2 + x3**2, equations[:1], [],
                {x2: POSITIVE, x3: (0.1, INFINITY)})  # fmt: skip
    status, point, _ = solve(grid)
    assert status == "solved"
    assert point.cost == pytest.approx(solve(alone)[1].cost, rel=1e-8)


@pytest.mark.parametrize(("cost", "equations"), [(-x1 - x2, [x1 - x2]), (-(x1**2) + x2**2, [])])
def test_unbounded(cost: Any, equations: list[Any]) -> None:
    assert solve(nlp((1, 1), cost, equations, [], {x1: POSITIVE}))[0] == "unbounded"


@pytest.mark.parametrize(
    ("equations", "inequalities", "least"),
    [
        ([x1**2 + x2**2 + 1], [], 1.0),  # the Jacobian vanishes where the violation is least
        ([], [x1 + x2 + 1], 1.0),
        ([exp(x1) + x2], [], 1.0),  # only as x1 tends to its bound -3 ...
    ],
)
def test_infeasible_is_a_minimum_of_the_violation(equations: Any, inequalities: Any, least: float) -> None:
    bounds = {x1: (0 if inequalities else -3, 3), x2: POSITIVE}
    if equations and equations[0].has(exp):
        least = float(np.exp(-3.0))
    grid = nlp((1, 1), (x1 - 1) ** 2 + x2**2, equations, inequalities, bounds)
    status, point, _ = solve(grid)
    assert status == "infeasible"
    assert point.residual == pytest.approx(least, rel=1e-5)  # the barrier keeps a distance to the bound
    rows, columns, slopes = jacobian(grid, point.unknowns)
    found, primal = variables(grid, point), primal_unknowns(grid)
    pull = np.bincount(columns, slopes * constraints(grid, point.unknowns)[rows], found.size)
    lower, upper = bounds_of(grid)
    assert np.abs(found - np.clip(found - pull, lower[primal], upper[primal])).max() <= 1e-3


def test_non_finite() -> None:
    assert solve(nlp((-1, 1), log(x1) + x2**2, [x1 - x2]))[0] == "non-finite"


def test_iteration_limit() -> None:
    grid = HOCK_SCHITTKOWSKI["71"][2]()
    status, point, iterations = solve(grid, limit=3)
    assert (status, iterations) == ("iteration limit", 3)
    assert (point.unknowns >= bounds_of(grid)[0]).all()


def test_saddle_point_at_the_start_is_left() -> None:
    assert solve(nlp((0, 0), x1**2 + x2**2))[0] == "solved"
    status, point, _ = solve(nlp((0, 0), x1**2 - x2**2 + x2**4))
    assert status == "solved"
    assert point.cost == pytest.approx(-0.25)
    assert solve(nlp((0, 0), x1**2 - x2**2))[0] == "unbounded"
    status, point, _ = solve(nlp((0, 0.1), x1**2 - x2**2 + x2**4))
    assert status == "solved"
    assert point.cost == pytest.approx(-0.25)


def test_rank_deficient() -> None:
    """No shift of the Hessian helps where derivatives are infinite."""
    grid = nlp((1, 1), x1**2 + x2**2, [x1 - x2])
    assert solve(with_hessian(grid, lambda unknowns: np.full((3, 3), np.nan)))[0] == "rank-deficient"


def test_steps_that_are_short_in_turn_raise_the_shift_and_whole_ones_lower_it() -> None:
    """Far away the cost is all but linear, and Newton's steps lead beyond the optimum.

    Six steps in turn, of a quarter at most, raise the shift; after ten, full steps are tried, and taken back where they
    lead nowhere.
    """
    cost = sum(sqrt(1 + (2**i * x_i) ** 2) for i, x_i in enumerate(x))
    grid, iterates = nlp((3, -30, 50, 2, -9, 4, 1), cost), Log()
    status, point, _ = minimise(grid, guess_of(grid), 1e-10, 300, False, iterates)
    assert status == "solved"
    assert point.cost == pytest.approx(7.0, rel=1e-12)
    costs, _, _, shifts, lengths = iterates.table().T
    assert (shifts[:7] == 0.0).all()
    assert (lengths[1:11] <= 0.25).all()
    assert shifts[7:12] == pytest.approx(4e-5 * 4.0 ** np.arange(5))
    assert lengths[11:15].tolist() == [1.0, 1.0, 1.0, 0.0]  # the last takes the three before it back
    assert costs[14] == costs[10]
    whole = 16 + int(np.argmax(lengths[16:] == 1.0))
    assert shifts[whole + 1 :] == pytest.approx(shifts[whole] / 2.0 ** np.arange(1, shifts.size - whole))


def test_chattering_takes_no_more_than_half_as_many_iterations_again_as_ipopt() -> None:
    """Fuller's problem, where bounds are hardly active; IPOPT 3.11.9 takes 16 iterations to 1e-8."""
    motion = Motion([x1, v], [u], [v, u], 3.5, x1**2, {x1: 0, v: 1}, {x1: 0, v: 0}, {}, {u: (-1, 1)})
    grid = transcribe(motion, 120)
    status, point, iterations = solve(grid)
    assert status == "solved"
    assert iterations <= 24
    assert_optimal(grid, point)


def restoration(grid: Any, push: float, reduction: float) -> tuple[str, Any]:
    """Status and point of a restoration from the guess of a problem."""
    search = search_on(grid)
    iterate = begin(search, guess_of(grid), FROM_GUESS._replace(push=push))
    status, found = restored(search, iterate, reduction, FROM_ANYWHERE, Log())
    return status, found.point


def test_restoration_goes_no_farther_than_it_has_to() -> None:
    """The second equation is a millionth as steep as the first: all of it would take a step of 100."""
    grid = nlp((2, 0), x1**2 + x2**2, [1000 * (x1 - 1), 0.01 * (x2 - 100)], [], {x1: POSITIVE})
    status, point = restoration(grid, 1e-2, 0.9)
    first, second = variables(grid, point)
    assert status == "restored"
    assert abs(first - 1.0) < 0.1
    assert abs(second) < 1.0


def test_a_cost_that_falls_without_end_is_not_followed_to_infinity() -> None:
    """Other beginnings may lead to a local minimum: five searches take no more steps than one did to -1e20."""
    status, point, iterations = solve(nlp((1, 1), -x1 - x2, [x1 - x2], [], {x1: POSITIVE}))
    assert status == "unbounded"
    assert iterations <= 15
    assert point.cost < -UNBOUNDED_BELOW


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e12])
def test_restoration_where_a_bound_is_close_and_residuals_are_in_any_unit(unit: float) -> None:
    """The weight of the barrier and what damps steps are in units of squared residuals; beside a bound it is steep."""
    grid = nlp((1e-6, 30), x1, [unit * (x2**2 - 4), unit * (x1 * x2 - 6)], [], {x1: POSITIVE, x2: POSITIVE})
    status, point = restoration(grid, 1e-9, 1e-6)
    assert status == "restored"
    assert variables(grid, point) == pytest.approx([3.0, 2.0], rel=1e-3)


@pytest.mark.parametrize("name", ["7", "71", "cart-pole, tight", "Goddard"])
def test_a_search_that_returns_after_each_iteration_goes_on_as_if_it_had_not(name: str) -> None:
    """As one does that is watched; from the guess, and from a solution that is not quite one."""
    grid = KNOWN[name][2]()
    cold, warm = Log(), Log()
    _, point, _ = minimise(grid, guess_of(grid), 1e-10, 300, False, cold)
    beside = point.unknowns + 1e-7 * ~grid.is_multiplier
    minimise(grid, beside, 1e-10, 300, True, warm)
    for start, is_warm, whole in ((guess_of(grid), False, cold), (beside, True, warm)):
        watched = Log(watch=lambda number, row: None)
        minimise(grid, start, 1e-10, 300, is_warm, watched)
        np.testing.assert_array_equal(watched.table(), whole.table())
