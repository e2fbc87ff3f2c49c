"""Controllers: the gain of a linear regulator, warm and cold solves, limits of time and steps, failures, threads."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from horizon_problems import HORIZON, STEPS, carried, exactly, in_micrometres, regulator, walled
from scipy.linalg import solve_discrete_are

import codegen
from codegen.mpc import controller as controllers
from codegen.mpc.acceptance import BestIterate, better
from codegen.runtime.search import workspace
from codegen.runtime.search.iterates import search_on, stored
from codegen.runtime.search.point import Point
from codegen.runtime.search.scaling import scaled_grid

H = HORIZON / STEPS


def gain_and_weights():
    """The gain K of u = -K x and the weights P of the infinite horizon, by scipy, for the midpoint rule."""
    a, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    q, r = np.diag([1.0, 0.5]), np.array([[0.25]])
    left = np.linalg.inv(np.eye(2) - H / 2 * a)
    step, push = left @ (np.eye(2) + H / 2 * a), H * left @ b
    middle, pushed = (np.eye(2) + step) / 2, push / 2  # where the cost is taken
    weights, across = H * middle.T @ q @ middle, H * middle.T @ q @ pushed
    effort = H * (r + pushed.T @ q @ pushed)
    p = solve_discrete_are(step, push, weights, effort, s=across)
    return np.linalg.solve(effort + push.T @ p @ push, push.T @ p @ step + across.T), p


def infinite():
    """Terminal weights with which a horizon of any length is an infinite one."""
    _, p = gain_and_weights()
    return {"xx": p[0, 0], "xv": p[0, 1], "vv": p[1, 1]}


@pytest.mark.parametrize("steps", [2, 8])
@pytest.mark.parametrize("is_bounded", [False, True])
def test_a_linear_regulator_has_the_gain_of_the_riccati_equation(steps, is_bounded):
    gain, _ = gain_and_weights()
    parameters = {**infinite(), **({"limit": 100.0} if is_bounded else {})}
    controller = codegen.Controller(
        regulator(is_bounded), steps=steps, horizon=steps * H, parameters=parameters, tolerance=1e-12
    )
    for state in ([1.0, 0.0], [0.0, 1.0], [-0.3, 0.2]):
        np.testing.assert_allclose(controller.step(state), -gain @ state, atol=1e-9)
        assert controller.last.status == "solved"


def test_references_and_disturbances_are_run_time_values():
    """The regulator is the same about another place; a force that is known is an argument of the module's solve."""
    gain, _ = gain_and_weights()
    controller = codegen.Controller(regulator(), parameters={**infinite(), "place": lambda t: 2.0 * t})
    np.testing.assert_allclose(controller.step([3.0, 0.0], 1.0), -gain @ [1.0, 0.0], atol=1e-8)
    alone = controller.step([2.0, 0.0], 1.0, {"wind": 0.5})
    np.testing.assert_allclose(controller.step([2.0, 0.0], 1.0), [0.0], atol=1e-8)  # the wind was of that time alone
    grid = {**infinite(), "place": 2.0, "wind": 0.5}
    np.testing.assert_allclose(alone, regulator().solve(STEPS, start={"x": 2, "v": 0}, **grid).u[0], atol=1e-8)


@pytest.mark.parametrize("sample", [H, 0.3 * H, 2.5 * H])
@pytest.mark.parametrize("make", [lambda: regulator(True), carried])
def test_warm_steps_agree_with_solves_from_the_problems_own_guess(make, sample):
    module, generator = make(), np.random.default_rng(1)
    controller = codegen.Controller(module, sample=sample, tolerance=1e-10)
    state = np.array([1.0, 0.0])
    for k in range(6):
        inputs = controller.step(state, k * sample)
        whole = module.solve(STEPS, start=dict(zip(controller.states, state, strict=True)))
        assert (controller.last.status, whole.status) == ("solved", "solved")
        np.testing.assert_allclose(inputs, whole.u[0], atol=1e-7)
        assert controller.last.cost == pytest.approx(whole.cost, abs=1e-8)
        state = exactly(state, inputs, 0.0, sample) + 0.05 * generator.standard_normal(2)


def test_numbers_a_million_times_as_large_are_solved_in_parts_of_sizes():
    module = in_micrometres()
    grid = module.make_grid(STEPS)
    assert scaled_grid(grid, module.initial_guess(grid)).sizes.size, "the problem is chosen for them"
    controller, hurried = codegen.Controller(module), codegen.Controller(module, newton_steps=4)
    for state in ([1e6, 0.0], [0.8e6, -0.3e6], [0.7e6, -0.2e6]):
        inputs = controller.step(state)
        whole = module.solve(STEPS, start=dict(zip(controller.states, state, strict=True)))
        assert controller.last.status == "solved"
        np.testing.assert_allclose(inputs, whole.u[0], atol=1.0)  # of a million
        hurried.step(state)
    assert hurried.last.status in ("iteration limit", "solved")
    np.testing.assert_allclose(hurried.last.inputs, inputs, atol=1e4)


def test_a_plan_begins_with_the_measured_state_and_the_inputs():
    controller = codegen.Controller(regulator(True))
    inputs = controller.step({"v": 0.25, "x": -1.0}, 7.0)
    times, states, planned = controller.plan()
    np.testing.assert_allclose(times, 7.0 + H * np.arange(STEPS + 1))
    np.testing.assert_allclose(states[0], [-1.0, 0.25])
    np.testing.assert_array_equal(planned[0], inputs)
    assert inputs[0] == pytest.approx(1.0, abs=1e-5)  # the limit, but for what the barrier leaves


def test_the_state_that_the_problem_starts_from():
    np.testing.assert_array_equal(codegen.Controller(carried()).first_state(), [1.0, 0.0])


def test_one_newton_step_is_the_tangential_predictor():
    """From an exact plan it misses the solution for a state nearby by the square of their distance."""
    module, errors = carried(), []
    for distance in (0.1, 0.05):
        controller = codegen.Controller(module, sample=H, newton_steps=1)
        controller.step([1.0, 0.0])
        _, states, _ = controller.plan()
        state = np.array([states[1, 0] + distance, -0.2])
        inputs = controller.step(state)
        assert (controller.last.status, controller.last.iterations) == ("iteration limit", 1)
        assert not controller.last.fell_back
        whole = module.solve(STEPS, start=dict(zip(controller.states, state, strict=True)))
        errors.append(abs(inputs[0] - whole.u[0, 0]))
    assert errors[0] < 0.05  # of an input of about two
    controller = codegen.Controller(module, newton_steps=20)
    controller.step([1.0, 0.0])
    controller.step([0.9, -0.2])
    assert controller.last.status == "solved"


def test_where_there_is_no_time_the_plan_before_is_applied():
    module = carried()
    controller, hurried = codegen.Controller(module), codegen.Controller(module, deadline=1e-9)
    controller.step([1.0, 0.0])
    hurried._plan = controller._plan  # as if there had been time
    _, _, planned = controller.plan()
    for k in range(1, STEPS + 2):
        inputs = hurried.step([0.9, 0.0], k * H)
        np.testing.assert_array_equal(inputs, planned[min(k, STEPS - 1)])
        last = hurried.last
        assert (last.status, last.fell_back, last.in_time, last.iterations) == ("time limit", True, False, 0)
        assert "no time for an iteration; applied is the plan before, shifted" in last.message
        assert last.residual > 1e-3  # and it says by how much its equations fail to hold


def test_before_there_is_a_plan_that_from_the_problems_own_start_is_applied():
    module = carried()
    controller = codegen.Controller(module, deadline=1e-9)
    np.testing.assert_allclose(controller.step([0.9, 0.0]), module.solve(STEPS).u[0], rtol=1e-12)
    assert "applied is the plan from the problem's own start" in controller.last.message


def test_at_the_deadline_the_best_feasible_iterate_is_applied(monkeypatch):
    module, seen = carried(), []
    controller = codegen.Controller(module, deadline=1e3)
    controller.step([1.0, 0.0])
    own = BestIterate.extend

    def extend(log, search, rows):
        own(log, search, rows)
        seen.append(stored(search).point.residual)

    monkeypatch.setattr(BestIterate, "extend", extend)
    monkeypatch.setattr(BestIterate, "iterations_per_call", lambda *_: 1)
    monkeypatch.setattr(BestIterate, "is_late", lambda log: len(seen) > 1)
    inputs = controller.step([0.9, -0.5])
    last = controller.last
    assert (last.status, last.iterations, last.in_time, last.fell_back) == ("time limit", 2, True, False)
    assert seen[0] > 1e-4 >= last.residual == pytest.approx(seen[1])
    assert f"applied is the best feasible iterate, whose equations hold to {last.residual:.1e}" in last.message
    whole = module.solve(STEPS, start={"x": 0.9, "dx": -0.5})
    np.testing.assert_allclose(inputs, whole.u[0], atol=1e-3)


def test_of_all_iterates_the_cheapest_is_kept_whose_equations_hold():
    search = search_on(carried().make_grid(STEPS))
    logs = [BestIterate(limit, 1e-4) for limit in (1e9, np.inf)]
    for cost, residual in ((0.5, 1.0), (3.0, 1e-5), (2.0, 1e-6), (1.0, 1e-3), (2.5, 1e-12), (0.1, np.nan)):
        search.work.vectors[workspace.X] = cost
        search.work.reals[[workspace.COST, workspace.RESIDUAL]] = cost, residual
        for log in logs:
            log.extend(search, np.zeros((1, 6)))
    timed, other = logs
    assert (timed.best.unknowns == 2.0).all()
    assert not timed.is_late()
    assert other.best is None  # without a deadline nobody looks


def test_with_a_deadline_a_search_returns_ever_more_often():
    now, counts = 0.0, []
    log, search = BestIterate(100.0, 1e-4, lambda: now, expected=10.0), search_on(carried().make_grid(STEPS))
    while not log.is_late():
        counts.append(log.iterations_per_call(sum(counts), 100, 1000))
        search.work.integers[workspace.ITERATIONS] += counts[-1]
        now += 2.0 * counts[-1]  # quicker than was expected
        log.extend(search, np.zeros((counts[-1], 6)))
    assert counts[:2] == [6, 23]
    assert counts[-1] == 1
    assert counts[1:] == sorted(counts[1:], reverse=True)
    assert 100.0 < now <= 102.0
    assert BestIterate(np.inf, 1e-4).iterations_per_call(0, 100, 1000) == 100


def of(cost, residual):
    """A plan that costs so much and violates its equations so much."""
    return Point(np.zeros(1), np.zeros(1), cost, residual, residual, 0.0, residual)


@pytest.mark.parametrize(
    ("one", "other", "is_other"),
    [
        (of(1.0, 1e-9), of(0.5, 1e-2), False),  # feasible before cheap
        (of(1.0, 1e-2), of(5.0, 1e-9), True),
        (of(1.0, 1e-9), of(0.5, 1e-6), True),  # both are feasible
        (of(1.0, 1e-6), of(2.0, 1e-9), False),
        (of(1.0, 0.5), of(9.0, 0.1), True),  # neither is
        (of(1.0, np.nan), of(9.0, 0.1), True),
    ],
)
def test_which_of_two_plans_is_better(one, other, is_other):
    assert (better(one, other, 1e-4) is other) == is_other


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("deadline", [None, 1e3])
def test_a_measurement_that_is_not_finite_keeps_the_last_plan(value, deadline):
    controller = codegen.Controller(carried(), deadline=deadline)
    controller.step([1.0, 0.0])
    planned = controller.plan()[2]
    controller.prepare(H)
    np.testing.assert_array_equal(controller.step([0.9, value], H), planned[1])
    last = controller.last
    assert (last.status, last.fell_back, last.iterations) == ("non-finite", True, 0)
    assert last.message.startswith(
        f"non-finite: in the measured state dx is {value}; give finite numbers, for example an estimate; applied is "
        "the plan before, shifted"
    )
    assert np.isfinite(last.residual)
    np.testing.assert_array_equal(controller.step({"x": value, "dx": value}, 2 * H), planned[2])
    assert f"x is {value}, dx is {value};" in controller.last.message
    inputs = controller.step([0.8, -0.2], 3 * H)
    assert controller.last.status == "solved"
    other = codegen.Controller(carried())
    np.testing.assert_allclose(inputs, other.step([0.8, -0.2], 3 * H), atol=1e-6)


def test_a_first_measurement_that_is_not_finite_applies_the_plan_from_the_problems_own_start():
    module = carried()
    controller, other = codegen.Controller(module), codegen.Controller(module)
    np.testing.assert_allclose(controller.step([np.nan, 0.0]), module.solve(STEPS).u[0], rtol=1e-12)
    assert controller.last.status == "non-finite"
    assert "applied is the plan from the problem's own start" in controller.last.message
    np.testing.assert_array_equal(controller.step([0.9, 0.0]), other.step([0.9, 0.0]))
    assert controller.last.status == "solved"


@pytest.mark.parametrize("status", ["infeasible", "stalled", "non-finite"])
def test_a_solve_that_fails_falls_back_on_the_plan_before(status, monkeypatch):
    module = carried()
    controller = codegen.Controller(module)
    controller.step([1.0, 0.0])
    _, _, planned = controller.plan()

    def failing(grid, guess, *_, **_named):
        return status, module.evaluate(grid, guess), 1

    monkeypatch.setattr(controllers, "minimise", failing)
    np.testing.assert_array_equal(controller.step([0.9, -0.2], H), planned[1])
    assert (controller.last.status, controller.last.fell_back) == (status, True)
    assert controller.last.message.startswith(f"{status}: ")
    assert "; applied is the plan before, shifted, whose equations hold to " in controller.last.message
    monkeypatch.undo()
    assert controller.step([0.8, -0.2], 2 * H) is not None
    assert controller.last.status == "solved"


@pytest.mark.parametrize("status", ["time limit", "stalled", "infeasible"])
@pytest.mark.parametrize(("newton_steps", "most"), [(None, 200), (3, 200), (500, 500)])
def test_a_search_that_would_go_on_and_on_ends_with_what_it_has(status, newton_steps, most, monkeypatch):
    """Whatever a search that was told to end says of itself: it was the number of iterations and restorations."""
    module = carried()
    controller = codegen.Controller(module, newton_steps=newton_steps)
    controller.step([1.0, 0.0])
    nearly = module.solve(STEPS, start={"x": 0.9, "dx": -0.2}, tolerance=1e-3).unknowns

    def endless(grid, *given, **_named):
        log, turns = given[-1], 0
        while not log.is_late():
            turns += 1
        assert log.is_late()
        return status, module.evaluate(grid, nearly), turns - 40

    monkeypatch.setattr(controllers, "minimise", endless)
    controller.step([0.9, -0.2], H)
    last = controller.last
    assert (last.status, last.fell_back, last.iterations) == ("iteration limit", False, most - 40)
    start = f"iteration limit after {most - 40} iterations and 40 of restorations; applied is the best feasible iterate"
    assert last.message.startswith(start)
    np.testing.assert_array_equal(controller.plan()[2], module.unpack(module.make_grid(STEPS), nearly)[3])


def test_the_first_search_is_not_limited_so(monkeypatch):
    module, turns = carried(), []
    controller = codegen.Controller(module)
    own = controllers.minimise

    def long(grid, *given, **named):
        turns.append(sum(not given[-1].is_late() for _ in range(1000)))
        return own(grid, *given, **named)

    monkeypatch.setattr(controllers, "minimise", long)
    controller.step([1.0, 0.0])
    assert (turns, controller.last.status) == ([1000], "solved")


def test_a_claim_that_is_not_so_is_taken_back(monkeypatch):
    module = carried()
    controller = codegen.Controller(module)
    controller.step([1.0, 0.0])

    def lying(grid, guess, *_, **_named):
        return "solved", module.evaluate(grid, guess), 1

    monkeypatch.setattr(controllers, "minimise", lying)
    controller.step([0.5, 0.5])
    assert (controller.last.status, controller.last.fell_back) == ("inaccurate", True)
    assert "the solver reported success, but the equations have residual" in controller.last.message


def test_a_measured_state_may_be_beyond_a_bound_to_which_it_returns():
    """Solved once, such a problem is refused; a vehicle that was blown beyond a limit has to be led back."""
    controller = codegen.Controller(walled(), horizon=4.0)
    whole = walled().solve(STEPS, start={"x": 1.05, "v": -0.5})
    assert whole.status == "infeasible"
    inputs = controller.step([1.05, -0.5])
    assert controller.last.status == "solved"
    _, states, _ = controller.plan()
    assert states[0, 0] == 1.05
    assert states[1:, 0].max() <= 1.0 + 1e-7
    assert np.isfinite(inputs).all()


def test_reset_forgets_the_plan():
    controller = codegen.Controller(carried())
    first = controller.step([1.0, 0.0])
    controller.step([0.2, 0.5])
    controller.reset()
    assert controller.last is None
    np.testing.assert_array_equal(controller.step([1.0, 0.0]), first)


def test_threads_take_turns():
    """Every thread finds for its states what there is to be found, whatever others asked in between."""
    controller = codegen.Controller(carried(), tolerance=1e-10)
    states = [np.array([0.1 * k, 0.05 * k]) for k in range(1, 7)]
    alone = [codegen.Controller(carried(), tolerance=1e-10).step(state) for state in states]
    found, errors = {}, []

    def ask(number):
        try:
            for _ in range(3):
                found.setdefault(number, []).append(controller.step(states[number]))
        except Exception as error:  # a thread's own are not seen otherwise
            errors.append(error)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(len(states))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    for number, expected in enumerate(alone):
        for inputs in found[number]:
            np.testing.assert_allclose(inputs, expected, atol=1e-7)


def test_inputs_that_are_given_back_are_the_callers_own():
    controller = codegen.Controller(carried())
    inputs = controller.step([1.0, 0.0])
    kept = inputs.copy()
    inputs[:] = np.nan
    np.testing.assert_array_equal(controller.last.inputs, kept)
