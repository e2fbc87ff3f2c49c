"""The interior point method on problems with known optima, and every way in which it can end.

The runtime's functions are handed problems with dense linear algebra in place of a generated module's.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import dense_problem
import numpy as np
import pytest
from dense_problem import INFINITY, Dense, Motion, Point, transcribe
from known_optima import HOCK_SCHITTKOWSKI, POSITIVE, TRAJECTORIES, T, nlp, u, v, x1, x2, x3
from sympy import exp, log, symbols

from codegen.runtime.kkt import refinement
from codegen.runtime.optimise import (
    barrier,
    bounded,
    cascade,
    exact_bounds,
    filter,
    line_search,
    negative_curvature,
    newton,
    newton_steps,
    restoration,
    saddle_points,
    unbounded,
    warm_start,
)
from codegen.runtime.optimise.iteration_log import Log

LINEAR_ALGEBRA = {
    "allocate_system", "evaluate", "factor_kkt", "free_unknowns", "is_at_rounding_level", "is_solved", "bounds_of",
    "linear_residual", "multiplier_unknowns", "sizes_of_terms", "solve_kkt", "views", "with_tied_values",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def dense_linear_algebra() -> Iterator[None]:
    """Give the runtime the functions of `dense_problem` where a generated module has its own."""
    with pytest.MonkeyPatch.context() as patch:
        loop = cascade, newton, newton_steps, line_search, restoration, warm_start
        others = barrier, bounded, unbounded, negative_curvature, exact_bounds, refinement, saddle_points
        for module in (*loop, *others):
            for name in set(vars(module)) & LINEAR_ALGEBRA:
                patch.setattr(module, name, getattr(dense_problem, name))
        patch.setattr(unbounded, "regularisation", lambda grid, up, down: np.where(grid.is_multiplier, -down, up))
        for module in (line_search, restoration, exact_bounds):
            patch.setattr(module, "moved", dense_problem.moved)
        for module in (line_search, restoration, newton_steps):
            patch.setattr(module, "step_along", dense_problem.step_along)
        for module in loop:
            patch.setattr(module, "INEQUALITIES", 1)
        for module in (cascade, newton_steps):
            patch.setattr(module, "UNBOUNDED", 0)
        yield


@pytest.fixture
def without_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop as a module has it where no unknown is bounded."""
    for module in (cascade, newton, newton_steps, line_search, restoration, warm_start):
        monkeypatch.setattr(module, "INEQUALITIES", 0)
        monkeypatch.setattr(module, "UNBOUNDED", 0, raising=False)  # no search from nearby, which the barrier has not
        for name in set(vars(module)) & set(vars(unbounded)) - LINEAR_ALGEBRA - {"np"}:
            monkeypatch.setattr(module, name, getattr(unbounded, name))


def solve(grid: Dense, limit: int = 300, warm: bool = False, guess: Any = None) -> tuple[str, Point, int]:
    unknowns = grid.guess.copy() if guess is None else guess
    status, point, iterations = cascade.minimise(grid, unknowns, 1e-10, limit, warm, Log())
    assert iterations <= limit + restoration.RESTORATION_STEPS
    return status, point, iterations


def assert_optimal(grid: Dense, point: Point) -> None:
    """First-order conditions from the definition: equations, bounds, and signs of the Lagrangian's own gradient."""
    unknowns = point.unknowns
    assert (unknowns >= grid.lower).all()
    assert (unknowns <= grid.upper).all()
    gradient = dense_problem.evaluate(grid, unknowns).gradient
    assert np.abs(gradient[grid.is_multiplier]).max(initial=0.0) <= 1e-10
    for i in np.flatnonzero(~grid.is_multiplier & grid.free):
        room = max(0.0, gradient[i]) * (unknowns[i] - grid.lower[i] if grid.lower[i] > -INFINITY else 1.0)
        room += max(0.0, -gradient[i]) * (grid.upper[i] - unknowns[i] if grid.upper[i] < INFINITY else 1.0)
        assert room <= 2e-10 * max(1.0, np.abs(unknowns).max())


KNOWN = {**HOCK_SCHITTKOWSKI, **TRAJECTORIES}
ITERATIONS: dict[str, int] = {}


@pytest.mark.parametrize("name", KNOWN)
def test_known_optimum(name: str) -> None:
    optimum, _, problem = KNOWN[name]
    grid = problem()
    status, point, ITERATIONS[name] = solve(grid)
    assert status == "solved"
    if optimum is not None:
        assert point.cost == pytest.approx(optimum, rel=1e-6 if name in TRAJECTORIES else 1e-8, abs=1e-9)
    assert point.stationarity <= 1e-10
    assert_optimal(grid, point)


def test_bounds_hold_exactly_and_the_optimality_conditions_there() -> None:
    """With so steep a cost the move of 1e-12 onto the bound alone would leave a slope of 1e-7."""
    grid = nlp((2, 3), 5e4 * (x1 - x2) ** 2 + 1000 * x1, bounds={x1: (1, INFINITY)})
    status, point, _ = solve(grid)
    assert status == "solved"
    assert point.unknowns[:2] == pytest.approx([1, 1], rel=1e-12)
    assert_optimal(grid, point)
    assert point.stationarity <= 1e-10  # as told


def double_integrator() -> Motion:
    """Least time from rest to rest over a distance of one with |u| <= 1, which is 2."""
    guess = {x1: (0.0, 1.0), T: 1.0}
    bounds = {u: (-1.0, 1.0), T: (0.1, 10.0)}
    return Motion([x1, v], [u], [v, u], T, 0, {x1: 0, v: 0}, {x1: 1, v: 0}, guess, bounds, [], T)


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
    jacobian = dense_problem.kkt_matrix(grid, point.unknowns)[np.ix_(grid.is_multiplier, ~grid.is_multiplier)]
    residual = dense_problem.evaluate(grid, point.unknowns).gradient[grid.is_multiplier]
    pull, found = jacobian.T @ residual, point.unknowns[~grid.is_multiplier]
    lower, upper = grid.lower[~grid.is_multiplier], grid.upper[~grid.is_multiplier]
    assert np.abs(found - np.clip(found - pull, lower, upper)).max() <= 1e-3


def test_non_finite() -> None:
    assert solve(nlp((-1, 1), log(x1) + x2**2, [x1 - x2]))[0] == "non-finite"


def test_iteration_limit() -> None:
    grid = HOCK_SCHITTKOWSKI["71"][2]()
    status, point, iterations = solve(grid, limit=3)
    assert (status, iterations) == ("iteration limit", 3)
    assert (point.unknowns >= grid.lower).all()


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
    broken = grid._replace(hessian=lambda unknowns: np.full((3, 3), np.nan))
    assert solve(broken)[0] == "rank-deficient"


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


def test_far_from_the_equations_a_search_estimates_multipliers() -> None:
    """Beyond a residual of a tenth, or where there are none, those of a neighbour are not used."""
    grid = transcribe(double_integrator(), 20)
    _, point, _ = solve(grid)
    search, primal = bounded.search_on(grid), np.flatnonzero(~grid.is_multiplier & grid.free)
    assert warm_start.begin_nearby(search, point.unknowns, 1e-10) is not None
    assert warm_start.begin_nearby(search, np.where(grid.is_multiplier, 0.0, point.unknowns), 1e-10) is None
    away = point.unknowns.copy()
    away[primal[:4]] += 1.0
    assert warm_start.begin_nearby(search, away, 1e-10) is None
    status, found, _ = solve(grid, warm=True, guess=away)
    assert status == "solved"
    assert found.cost == pytest.approx(point.cost, rel=1e-9)


def test_unknowns_stay_inside_in_spite_of_rounding() -> None:
    indices, side = np.array([0, 0]), np.array([1.0, -1.0])
    trial, distance = np.empty(1), np.empty(2)
    for step in (-1.0, 1.0):  # from 2 to either bound, 1 or 3
        barrier.move(np.array([2.0]), np.array([step]), 1.0, indices, side, np.ones(2), trial, distance)
        assert trial[0] == 2.0 + step
        assert (distance > 0.0).all()


def test_distances_are_finer_than_the_rounding_of_unknowns() -> None:
    """Half of the distance 1e-18 to the bound 1 remains where the unknown itself cannot be told from the bound."""
    trial, distance = np.empty(1), np.empty(1)
    barrier.move(np.ones(1), np.array([-1e-18]), 0.5, np.zeros(1, int), np.ones(1), np.array([1e-18]), trial, distance)
    assert (trial[0], distance[0]) == (1.0, 5e-19)


def test_start_is_pushed_inside() -> None:
    grid = nlp((-5, 9, 0.5), x1 + x2 + x3, [], [], {x1: (0, 1), x2: (-INFINITY, 4), x3: (0, 1)})
    pushed = barrier.push_inside(*dense_problem.bounds_of(grid), grid.guess, 1e-2)
    np.testing.assert_allclose(pushed, [0.01, 4 - 0.04, 0.5])


def test_steps_that_are_short_in_turn_raise_the_shift_until_one_is_whole() -> None:
    """Steps of a sixteenth, a few and then more in turn: only these count; a whole step lowers the shift again."""
    whole = bounded.Step(*[np.empty(0)] * 3, -1.0, False, 1.0, 1.0, bounded.InertiaCorrection(1e-3))
    assert line_search.damped(0.0, whole, 1 / 16, 1) == 0.0
    shifts = [0.0]
    for in_turn in (line_search.SHORT_IN_TURN, line_search.SHORT_IN_TURN + 1):
        shifts.append(line_search.damped(shifts[-1], whole, 1 / 16, in_turn))
    assert shifts == pytest.approx([0.0, 4e-3, 16e-3])
    assert line_search.damped(shifts[-1], whole, 1.0, 0) == pytest.approx(8e-3)
    assert line_search.damped(1e-6, whole, 1.0, 0) == 0.0


def test_chattering_takes_no_more_than_half_as_many_iterations_again_as_ipopt() -> None:
    """Fuller's problem, where bounds are hardly active; IPOPT 3.11.9 takes 16 iterations to 1e-8."""
    motion = Motion([x1, v], [u], [v, u], 3.5, x1**2, {x1: 0, v: 1}, {x1: 0, v: 0}, {}, {u: (-1, 1)})
    grid = transcribe(motion, 120)
    status, point, iterations = solve(grid)
    assert status == "solved"
    assert iterations <= 24
    assert_optimal(grid, point)


def test_restoration_goes_no_farther_than_it_has_to() -> None:
    """The second equation is a millionth as steep as the first: all of it would take a step of 100."""
    grid = nlp((2, 0), x1**2 + x2**2, [1000 * (x1 - 1), 0.01 * (x2 - 100)], [], {x1: POSITIVE})
    search = bounded.search_on(grid)
    iterate = bounded.begin(search, grid.guess, bounded.FROM_GUESS)
    status, found = restoration.restore(search, iterate, 0.9, filter.Filter(np.inf), lambda: False)
    first, second = found.point.unknowns[~grid.is_multiplier]
    assert status == "restored"
    assert abs(first - 1.0) < 0.1
    assert abs(second) < 1.0


def test_a_cost_that_falls_without_end_is_not_followed_to_infinity() -> None:
    """Other beginnings may lead to a local minimum: five searches take no more steps than one did to -1e20."""
    status, point, iterations = solve(nlp((1, 1), -x1 - x2, [x1 - x2], [], {x1: POSITIVE}))
    assert status == "unbounded"
    assert iterations <= 15
    assert point.cost < -newton.UNBOUNDED_BELOW


FREE_PROBLEMS = [
    nlp((-1.2, 1), 100 * (x2 - x1**2) ** 2 + (1 - x1) ** 2),
    nlp((2, 1, 0.5), x1**2 + x2**2 + x3**4, [x1 * x2 * x3 - 1, x1 - x2**2]),
    nlp((3, 3), (x1 - 1) ** 2 + exp(-x2), [exp(x1) * x2 - 1]),
    nlp((1, 1), x1**2 + x2**2, [x1**2 + x2**2 + 1]),
]


@pytest.mark.parametrize("grid", FREE_PROBLEMS)
def test_an_empty_barrier_leaves_the_iterates_as_they_are(grid: Dense, request: pytest.FixtureRequest) -> None:
    """Where no shift is needed, which each seeks in its own way, steps are the same with a barrier as without."""
    rows = []
    for fixture in ((), ("without_bounds",)):
        for name in fixture:
            request.getfixturevalue(name)
        log = Log()
        status, point, iterations = cascade.minimise(grid, grid.guess.copy(), 1e-10, 300, False, log)
        rows.append((status, iterations, point.cost, np.array([row[:5] for row in log.rows])))
    (status, iterations, cost, path), (other, others, least, other_path) = rows
    assert status == other
    assert iterations == others or status == "infeasible"  # an attempt with another weight is none without bounds
    assert cost == pytest.approx(least, rel=1e-12)
    shared = min(len(path), len(other_path))
    np.testing.assert_allclose(path[: shared // 2], other_path[: shared // 2], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e12])
def test_restoration_where_a_bound_is_close_and_residuals_are_in_any_unit(unit: float) -> None:
    """The weight of the barrier and what damps steps are in units of squared residuals; beside a bound it is steep."""
    grid = nlp((1e-6, 30), x1, [unit * (x2**2 - 4), unit * (x1 * x2 - 6)], [], {x1: POSITIVE, x2: POSITIVE})
    search = bounded.search_on(grid)
    iterate = bounded.begin(search, grid.guess, bounded.FROM_GUESS._replace(push=1e-9))
    status, found = newton.restored(search, iterate, 1e-6, filter.Filter(np.inf), Log())
    assert status == "restored"
    assert found.point.unknowns[~grid.is_multiplier][:2] == pytest.approx([3.0, 2.0], rel=1e-3)
