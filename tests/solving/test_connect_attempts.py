"""Uncertain targets, the ladder of attempts, and failures of the task connect."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import PROBLEMS
from few_landmarks import START, TARGET, few

from codegen.errors import ArgumentError, PointsError, SchemeError
from codegen.problem.points import PointSet, read_points
from codegen.runtime.particles import cascade, shooting
from codegen.runtime.particles.steps import follow
from codegen.solving import api
from codegen.solving.results.motions import connect_result
from codegen.solving.results.result import ConnectAttempt, Run


@pytest.fixture
def module(interpreted):
    def made(scheme, method=None, **arguments):
        return interpreted("image_registration", arguments=arguments, scheme=scheme, method=method)

    return made


def test_uncertain_targets_balance_cost_and_distance(module):
    """Stationarity of cost/2 + sum |q_N - target|^2/(2 sigma^2) by targets that are met exactly, and by differences."""
    made = module("midpoint")
    sigma = 0.2
    solution = made.solve(START, TARGET, 3, sigma=sigma)
    assert solution.status == "solved"

    def total(end):
        exact = made.solve(START, end, 3)
        return exact.cost / 2 + ((end - TARGET) ** 2).sum() / (2 * sigma**2)

    end = solution.q[-1]
    least = total(end)
    for direction in np.random.default_rng(1).normal(size=(3, 3, 2)):
        up, down = total(end + 1e-3 * direction), total(end - 1e-3 * direction)
        assert up > least
        assert down > least
        assert abs(up - down) < 1e-3 * (up + down - 2 * least) + 1e-9


def test_implicit_steps_begin_at_points_of_a_nearby_trajectory(module):
    """They take fewer iterations to the same states, and only as many as the accuracy that is asked for needs."""
    made = module("midpoint")
    case = made.make_case(START, TARGET, 4)
    first, momenta = made.first_momenta(case), 1.001 * made.first_momenta(case)
    _, path, points = made.trajectory(case, momenta)
    made_by = {}
    for near in (0.0, 1e-15, 1e-6):
        other, known = path.copy(), made.trajectory(case, first)[2]
        made_by[near] = follow(made.problem.pairs, case.duration / 4, case.own, case.parameters, other, known, near)
        np.testing.assert_allclose(other, path, rtol=0, atol=1e-13 if near < 1e-6 else 1e-5)
        np.testing.assert_allclose(known, points, rtol=0, atol=1e-13 if near < 1e-6 else 1e-5)
    assert 4 <= made_by[1e-6] < made_by[1e-15] < made_by[0.0]


def test_points_that_stay(module):
    solution = module("midpoint").solve(START, START, 3)
    assert solution.status == "solved"
    assert solution.cost == 0.0


ATTEMPTS = ("from_velocity", "from_least_action", "from_momenta", "by_continuation", "on_all_states", "by_steps")


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_every_attempt_finds_the_solution_by_itself(module, attempt, monkeypatch):
    made, attempts_of = module("explicit-euler"), cascade.attempts_of
    reference = made.solve(START, TARGET, 4)
    monkeypatch.setattr(
        cascade, "attempts_of", lambda *given: [a for a in attempts_of(*given) if a[1].__name__ == attempt]
    )
    solution = made.solve(START, TARGET, 4)
    assert solution.status == "solved", solution.message
    np.testing.assert_allclose(solution.q, reference.q, atol=1e-10)


def test_fewer_steps_are_taken_as_long_as_they_have_a_solution(module, monkeypatch):
    """Where steps below six never succeed, the attempt says so instead of handing over the solution with six."""
    made, original = module("explicit-euler"), cascade.shoot_at

    def shoot_at(case, *others):
        return original(case, *others) if case.steps >= 6 else (shooting.STALLED, 1, 0.1)

    monkeypatch.setattr(cascade, "shoot_at", shoot_at)
    monkeypatch.setattr(cascade, "attempts_of", lambda *_: cascade.LAST)
    solution = made.solve(START, TARGET, 4)
    assert solution.status == "not connected"
    assert solution.attempts[-1].endswith("residual 1.0e-01, with 5 steps, but solved with 6")
    assert made.solve(START, TARGET, 6).status == "solved"


def test_what_cannot_be_solved_is_not_called_solved(module):
    """Two neighbours change places in a single explicit step: their common velocity cannot tell them apart."""
    start = np.array([[0.0, 0.0], [1e-7, 0.0]])
    with np.errstate(all="ignore"):  # interpreted code warns where compiled code does not
        solution = module("midpoint").solve(start, np.array([[0.5, 0.0], [-0.5, 1e-9]]), 1, max_iterations=4)
    assert solution.status == "not connected"
    assert len(solution.attempts) == len(ATTEMPTS)
    assert "no attempt connects the points" in solution.message


def test_a_false_claim_of_success_is_downgraded(module):
    made = module("explicit-euler")
    solution = made.solve(START, TARGET, 3)
    path = np.stack([solution.q, solution.p], axis=1)
    path[2, 0, 0, 0] += 1e-6
    claim = ConnectAttempt("solved", "", 1, path, 1e-10)
    result = connect_result(made, "newton", Run(3, points=few()), claim)
    assert result.status == "inaccurate"


def test_what_does_not_fit_is_refused(module):
    with pytest.raises(ArgumentError, match="use --method action"):
        api.solve(module("midpoint"), "slsqp", points=few())
    row = np.stack([0.01 * np.arange(13), np.zeros(13)], axis=1)
    thirteen = PointSet(row, row + 0.1, np.zeros(13))
    with pytest.raises(ArgumentError, match="at most 24"):
        api.solve(module("explicit-euler"), "fmin", points=thirteen)
    with pytest.raises(PointsError, match="no points"):
        api.solve(module("midpoint"))
    with pytest.raises(SchemeError, match="no action belongs to it"):
        module("rk4", "action")
    with pytest.raises(SchemeError, match="chooses its own steps"):
        module("lsoda", "full")
    with pytest.raises(SchemeError, match="did you mean midpoint"):
        module("midpont")


def test_many_landmarks_by_broydens_method_agree_with_newtons(module):
    """Thirteen landmarks without a tangent; Newton's method from the result has nothing left to do."""
    points, made = read_points(PROBLEMS / "data" / "trilobite40.csv", 2), module("explicit-euler")
    start, target = points.start[::3][:13], points.target[::3][:13]
    solution = made.solve(start, target, 4)
    assert (solution.status, solution.tangents) == ("solved", 0), solution.message
    case = made.make_case(start, target, 4)
    matrix = made.jacobian(case, solution.p[0].ravel())
    correction = np.linalg.solve(matrix, made.residual(case, solution.p[0].ravel()))
    assert np.abs(correction).max() < 1e-9


def test_neighbours_that_turn_at_a_millionth(module):
    """Momenta of 1e5 leave residuals above the tolerance that are rounding; each place is met to 1e-8."""
    start, target = START.copy(), TARGET.copy()
    start[1], target[1] = start[0] + [1e-6, 0.0], target[0] + [0.0, 1e-6]
    result = api.solve(module("explicit-euler"), points=PointSet(start, target, np.zeros(3)), steps=10)
    assert result.status == "solved", result.message
    assert result.residual < 1e-8


@pytest.mark.parametrize(
    ("error", "noise", "outcome"), [(1e-9, 2e-9, "ROUNDED"), (2e-9, 1e-9, "STALLED"), (2e-8, 1e-6, "STALLED")]
)
def test_rounding_excuses_only_what_it_does(error, noise, outcome):
    assert shooting.without_progress(error, noise) == getattr(shooting, outcome)


def test_noise_of_the_arrival_grows_with_the_momenta(module):
    """A unit in the last place of momenta p moves places by about 1e-16 |p|; closer neighbours need larger ones."""
    made, noise = module("explicit-euler"), []
    for distance in (1e-1, 1e-3, 1e-5):
        start, target = np.array([[0.1, 0.2], [0.1 + distance, 0.2]]), np.array([[0.1, 0.2], [0.1, 0.2 + distance]])
        solution = made.solve(start, target, 4)
        noise.append(shooting.rounding(made.make_case(start, target, 4), np.stack([solution.q, solution.p], axis=1)))
    assert 1e-18 < noise[0] < 1e-14
    assert noise[0] < noise[1] < noise[2] < 1e-8
