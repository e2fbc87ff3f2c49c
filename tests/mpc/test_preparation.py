"""What a controller does before a measurement comes: the same solutions, with a factorisation less after it."""

from __future__ import annotations

import numpy as np
import pytest
from horizon_problems import HORIZON, STEPS, carried, in_micrometres, regulator, walled

import codegen
from codegen.errors import NumericsError
from codegen.runtime.search.cascade import factor_nearby
from codegen.runtime.search.iterates import search_on
from codegen.runtime.search.workspace import FACTORISATIONS

H = HORIZON / STEPS


def factorisations(controller):
    """The number of factorisations of the last search of a controller."""
    return controller._grids.search.work.integers[FACTORISATIONS]


def planned(controller, module):
    """The state that is planned for the next sampling time; masses are one."""
    _, q, p, _, _ = module.unpack(module.make_grid(STEPS), controller._plan)
    return np.array([*q[1], *p[1]])[:2]


def states_of(controller, module, count=6):
    """States that a disturbed loop would measure, each beside the one that was planned, and the last one's inputs."""
    generator, state = np.random.default_rng(4), 0.2 * np.array(controller.first_state())
    for k in range(count):
        yield k * H, state
        state = planned(controller, module)
        state += 0.01 * np.abs(state).max() * generator.standard_normal(2)


@pytest.mark.parametrize("make", [lambda: regulator(True), carried, walled, in_micrometres, regulator])
def test_prepared_steps_agree_with_solves_from_the_problems_own_guess(make):
    module = make()
    controller = codegen.Controller(module, tolerance=1e-10)
    for t, state in states_of(controller, module):
        controller.prepare(t)
        inputs = controller.step(state, t)
        whole = module.solve(STEPS, start=dict(zip(controller.states, state, strict=True)), tolerance=1e-10)
        assert (controller.last.status, whole.status) == ("solved", "solved")
        np.testing.assert_allclose(inputs, whole.u[0], rtol=1e-7, atol=1e-7 * np.abs(whole.u).max())


@pytest.mark.parametrize("make", [lambda: regulator(True), carried])
def test_the_first_step_takes_the_factors_that_are_there(make):
    module = make()
    controller = codegen.Controller(module)
    for t, state in states_of(controller, module):
        controller.prepare(t)
        controller.step(state, t)
        if t > 0.0:
            assert 0 < controller.last.iterations < 8
            assert factorisations(controller) == controller.last.iterations - 1


def test_one_newton_step_with_the_matrix_of_the_plan_is_nearly_the_tangential_predictor():
    module, found = carried(), []
    for is_prepared in (True, False):
        controller = codegen.Controller(module, sample=H, newton_steps=1)
        controller.step([0.2, 0.0])
        state = planned(controller, module) + 0.01
        if is_prepared:
            controller.prepare(H)
        found.append(controller.step(state, H)[0])
        assert (controller.last.status, controller.last.iterations) == ("iteration limit", 1)
    whole = module.solve(STEPS, start=dict(zip(controller.states, state, strict=True)))
    prepared, predictor = np.abs(np.array(found) - whole.u[0, 0])
    assert predictor < prepared < 1e-3  # of an input of about two


@pytest.mark.parametrize(
    ("other", "reset"), [({"wind": 0.5}, False), (None, True)], ids=["other run-time values", "nothing planned"]
)
def test_what_is_prepared_for_something_else_is_not_used(other, reset):
    module = regulator(True)
    controllers = [codegen.Controller(module, parameters={"place": lambda t: 0.1 * t}) for _ in range(2)]
    for controller in controllers:
        controller.step([1.0, 0.0])
    controllers[0].prepare(H)
    for controller in controllers:
        if reset:
            controller.reset()
        controller.step([0.95, -0.3], H, other)
    one, two = (controller.last for controller in controllers)
    assert (one.iterations, one.cost, *one.inputs) == (two.iterations, two.cost, *two.inputs)


def test_far_from_the_plan_factors_are_those_of_the_state():
    """After a push the search begins inside its bounds, where the matrix is another one."""
    module = regulator(True)
    pair = [codegen.Controller(module) for _ in range(2)]
    for controller in pair:
        controller.step([1.0, 0.0])
    pair[0].prepare(H)
    for controller in pair:
        controller.step([1.0, 3.0], H)
        assert controller.last.status == "solved"
        assert factorisations(controller) >= controller.last.iterations
    np.testing.assert_array_equal(pair[0].last.inputs, pair[1].last.inputs)


@pytest.mark.parametrize("make", [lambda: regulator(True), carried])
def test_there_are_factors_near_the_equations_alone(make):
    module = make()
    grid, found = module.make_grid(STEPS), module.solve(STEPS).unknowns
    search = search_on(grid)
    assert factor_nearby(grid, found, 1e-8, search)
    primal = module.primal_unknowns(grid)
    far = found.copy()
    far[primal] += 0.5 * np.random.default_rng(2).standard_normal(primal.size)
    assert not factor_nearby(grid, far, 1e-8, search)
    assert not factor_nearby(grid, np.where(grid.is_multiplier, 0.0, found), 1e-8, search)


def test_run_time_values_are_those_of_the_time_that_is_prepared():
    seen = []
    controller = codegen.Controller(
        regulator(True), parameters={"place": lambda t: (seen.append(t), 0.1 * t)[1]}, delay=1
    )
    controller.prepare(0.0)
    controller.step([1.0, 0.0])
    seen.clear()
    controller.prepare(H)
    assert seen == [2 * H]  # plans begin after the delay
    controller.step([0.9, -0.3], H)
    assert controller.last.status == "solved"
    with pytest.raises(NumericsError, match="the time"):
        controller.prepare(float("nan"))
    with pytest.raises(NumericsError, match="wind"):
        controller.prepare(2 * H, {"wind": float("inf")})
    controller.step([0.8, -0.3], 2 * H)
    assert controller.last.status == "solved"
