"""Controllers whose inputs act later than the measurement: what is predicted, when values hold, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from horizon_problems import HORIZON, STEPS, carried, exactly, regulator
from interpreted import of_problem
from scipy.integrate import solve_ivp
from sympy import Eq, cos

import codegen
from codegen import Control, control, coordinates, free_parameter, parameters, states
from codegen.errors import ArgumentError, NumericsError
from codegen.mpc.interface import Motion, interface_of

H = HORIZON / STEPS


@pytest.mark.parametrize("sample", [H, 0.4 * H, 2.0 * H, 2.5 * H])
@pytest.mark.parametrize("delay", [1, 2])
def test_without_disturbances_the_loop_is_that_without_a_delay_so_much_later(sample, delay):
    """From where the first inputs, which are no controller's, have led to: the midpoint rule is exact for the plant."""
    start, before = np.array([1.0, -0.25]), [0.5]
    delayed = codegen.close_loop(
        codegen.Controller(regulator(True), sample=sample, delay=delay, tolerance=1e-10),
        exactly, samples=12, start=start, inputs=before,
    )  # fmt: skip
    later = exactly(start, before, 0.0, delay * sample)
    undelayed = codegen.close_loop(
        codegen.Controller(regulator(True), sample=sample, tolerance=1e-10), exactly, samples=12 - delay, start=later
    )
    assert delayed.counts == {"solved": 12}
    np.testing.assert_allclose(delayed.states[delay:], undelayed.states, atol=1e-6)
    np.testing.assert_allclose(delayed.inputs[delay:], undelayed.inputs, atol=1e-5)
    assert np.abs(delayed.inputs[delay:]).max() > 0.5  # of a limit of one


def test_a_delay_that_the_controller_does_not_know_of_makes_another_loop():
    """So that the test above could fail."""
    start, controller = np.array([1.0, -0.25]), codegen.Controller(regulator(True))
    ignored = codegen.close_loop(controller, exactly, samples=12, start=start, delay=1, inputs=[0.5])
    later = exactly(start, [0.5], 0.0, H)
    undelayed = codegen.close_loop(controller, exactly, samples=11, start=later)
    assert np.abs(ignored.states[1:] - undelayed.states).max() > 0.05


def cart(**given):
    """A cart with a pole and a known force on the bob, of which nothing but the model matters here."""
    (x, theta), (dx, dtheta) = coordinates("x theta")
    u = control("u")
    mass, push = parameters(mass=0.4, push=0.0)
    kinetic = (1 + mass) / 2 * dx**2 + mass / 2 * cos(theta) * dx * dtheta + mass / 8 * dtheta**2
    options = {"scheme": given.pop("scheme", None), "method": given.pop("method", None)}
    changes = {name: change(x, theta, u) for name, change in given.items()}
    problem = Control(
        lagrangian=kinetic - mass * 9.81 / 2 * cos(theta), force={x: u + push, theta: push / 2 * cos(theta)},
        start={x: 0, theta: 0, dx: 0, dtheta: 0}, cost=x**2 + theta**2 + u**2, duration=0.4, steps=20, **changes,
    )  # fmt: skip
    return of_problem(problem, **{name: option for name, option in options.items() if option})


def cart_motion(_, state, u, push, mass=0.4):
    """Its equations of motion, by hand."""
    _, theta, dx, dtheta = state
    matrix = np.array([[1 + mass, mass / 2 * np.cos(theta)], [mass / 2 * np.cos(theta), mass / 4]])
    right = np.array([u + push + mass / 2 * np.sin(theta) * dtheta**2, np.sin(theta) * mass * 9.81 / 2])
    return [dx, dtheta, *np.linalg.solve(matrix, right + np.array([0.0, push / 2 * np.cos(theta)]))]


MODULES = [
    ({}, 1e-3),
    ({"scheme": "gauss-4"}, 1e-6),
    ({"scheme": "gauss-6"}, 1e-9),
    ({"scheme": "gauss-4", "end": lambda x, theta, u: {x: 0, theta: 0}}, 1e-6),  # the prediction is not to end there
    ({"scheme": "gauss-4", "bounds": lambda x, theta, u: {x: (-0.1, 0.1), u: (-1, 1)}}, 1e-6),
    ({"scheme": "gauss-4", "path": lambda x, theta, u: [x + u <= 1, theta >= -1]}, 1e-6),
    ({"method": "hamiltonian"}, 1e-3),
    ({"method": "hamiltonian", "scheme": "gauss-4"}, 1e-6),
]


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "tolerance"), MODULES)
@pytest.mark.parametrize("intervals", [1.0, 2.5])
def test_what_is_predicted_is_what_scipy_integrates(changes, tolerance, intervals):
    """Places and velocities, under inputs beyond bounds as well: they act already, whatever the plan may do."""
    module = cart(**changes)
    interface = interface_of(module)
    motion = Motion(module, interface, 0.02 * intervals, intervals)
    state, run_time = np.array([0.3, 0.8, -1.0, 2.0]), {"push": 3.0}
    found = motion(state, np.array([5.0]), run_time, run_time)
    exact = solve_ivp(
        cart_motion, (0.0, 0.02 * intervals), state, args=(5.0, 3.0), rtol=1e-12, atol=1e-13, method="DOP853"
    ).y[:, -1]
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=tolerance)
    assert np.abs(found - state).max() > 0.05


def test_values_are_those_of_the_times_at_which_they_hold():
    """A wind that changes: that of now leads to where the plan starts, and the plan has that of the time by then."""
    module = regulator()
    controller = codegen.Controller(module, delay=1, parameters={"wind": lambda t: t, "place": lambda t: 2.0 * t})
    controller.reset({"u": 0.25})
    inputs = controller.step([3.0, 0.5], 1.0)
    later = exactly([3.0, 0.5], [0.25 + 1.0], 0.0, H)
    times, planned, _ = controller.plan()
    np.testing.assert_allclose(times[:2], [1.0 + H, 1.0 + 2 * H])
    np.testing.assert_allclose(planned[0], later, atol=1e-9)
    given = {"start": dict(zip("xv", later, strict=True)), "wind": 1.0 + H, "place": 2.0 * (1.0 + H)}
    np.testing.assert_allclose(inputs, module.solve(STEPS, **given).u[0], atol=1e-7)
    controller.step([2.5, 0.5], 1.0 + H, {"wind": 4.0})  # for this step alone, on the way and in the plan
    later = exactly([2.5, 0.5], inputs + 4.0, 0.0, H)
    np.testing.assert_allclose(controller.plan()[1][0], later, atol=1e-9)
    given = {"start": dict(zip("xv", later, strict=True)), "wind": 4.0, "place": 2.0 * (1.0 + 2 * H)}
    np.testing.assert_allclose(controller.last.inputs, module.solve(STEPS, **given).u[0], atol=1e-7)


def test_where_there_is_no_time_the_plan_before_goes_on_its_way():
    controller = codegen.Controller(regulator(True), delay=1, deadline=1e-9)
    first = controller.step([1.0, 0.0])
    second = controller.step([1.0, 0.0], H)
    assert (controller.last.status, controller.last.fell_back) == ("time limit", True)
    np.testing.assert_array_equal(second, controller.plan()[2][0])
    np.testing.assert_allclose(controller.plan()[1][0], exactly([1.0, 0.0], first, 0.0, H), atol=1e-9)


def running_away():
    """A state that grows by its square: from two on no step of half a second has a solution."""
    (x,) = states("x")
    u = control("u")
    return of_problem(Control(dynamics={x: x**2 + u}, cost=x**2 + u**2, duration=2, start={x: 0}, steps=4))


def test_where_the_motion_cannot_be_followed_the_plan_before_is_applied():
    controller = codegen.Controller(running_away(), delay=1)
    controller.step([0.1])
    planned = controller.plan()[2]
    np.testing.assert_array_equal(controller.step([3.0], 0.5), planned[1])
    last = controller.last
    assert (last.status, last.fell_back, last.iterations) == ("newton failed", True, 0)
    assert last.message.startswith(
        "newton failed: the motion under the inputs on their way cannot be followed; applied is the plan before"
    )
    controller.step([0.1], 1.0)
    assert controller.last.status == "solved"


def test_a_refused_step_sends_nothing_on_its_way():
    controllers = [codegen.Controller(carried(), delay=1) for _ in range(2)]
    for controller in controllers:
        controller.step([1.0, 0.0])
    with pytest.raises(NumericsError):
        controllers[0].step([1.0], H)
    one, other = (controller.step([0.9, -0.2], H) for controller in controllers)
    np.testing.assert_array_equal(one, other)


def test_a_measurement_that_is_not_finite_needs_no_prediction():
    controller = codegen.Controller(carried(), delay=1)
    controller.step([1.0, 0.0])
    planned = controller.plan()[2]
    np.testing.assert_array_equal(controller.step([np.nan, 0.0], H), planned[1])
    assert (controller.last.status, controller.last.fell_back) == ("non-finite", True)
    inputs = controller.step([0.9, -0.2], 2 * H)
    assert controller.last.status == "solved"
    controller.reset(planned[1])  # the inputs of the step without a measurement are on their way
    np.testing.assert_allclose(controller.step([0.9, -0.2], 2 * H), inputs, atol=1e-6)


def test_a_loop_has_the_delay_of_its_controller_or_a_longer_one():
    controller = codegen.Controller(regulator(), delay=2)
    loop = codegen.close_loop(controller, exactly, samples=4, inputs={"u": 0.5})
    np.testing.assert_array_equal(loop.inputs[:2], [[0.5], [0.5]])
    assert loop.inputs[2] != 0.5
    loop = codegen.close_loop(controller, exactly, samples=4, delay=3, inputs=[0.5])
    np.testing.assert_array_equal(loop.inputs[:3], [[0.5], [0.5], [0.5]])
    with pytest.raises(ArgumentError) as refused:
        codegen.close_loop(controller, exactly, delay=1)
    assert str(refused.value) == (
        "the controller plans for a delay of 2, and the loop has one of 1; leave delay out here, or give the "
        "controller no longer one"
    )


def held():
    """A bead on a ring, whose constraint forces no equations of a step determine."""
    (q, r), (dq, dr) = coordinates("q r")
    u = control("u")
    return of_problem(
        Control(
            lagrangian=(dq**2 + dr**2) / 2 - r, force={q: u}, cost=u**2, constraint=[q**2 + r**2 - 1], duration=1,
            start={q: 0, r: -1, dq: 0, dr: 0}, steps=4,
        )
    )  # fmt: skip


def led(**changes):
    """A unit mass with more conditions, or another free value."""
    x, v = states("x v")
    u = control("u")
    w = free_parameter("w", 1)
    given = {name: change(x, v, u, w) for name, change in changes.items()}
    return of_problem(Control(cost=u**2 + w**2, duration=1, steps=4, **{"start": {x: 1, v: 0}, **given}))


REFUSED = [
    held,
    lambda: led(dynamics=lambda x, v, u, w: {x: v, v: u + w}),
    lambda: led(dynamics=lambda x, v, u, w: {x: v, v: u}, start=lambda x, v, u, w: {x: 1}),
    lambda: led(dynamics=lambda x, v, u, w: {x: v, v: u}, path=lambda x, v, u, w: [Eq(u, x + w)]),
]


@pytest.mark.parametrize("make", REFUSED)
def test_problems_whose_state_does_not_follow_from_start_and_inputs(make):
    with pytest.raises(ArgumentError) as refused:
        codegen.Controller(make(), delay=1)
    assert str(refused.value) == (
        "the state of problem does not follow from its start and inputs alone; leave delay out, and give step the "
        "state that inputs on their way lead to"
    )


@pytest.mark.parametrize("delay", [-1, 0.5, True, "one"])
def test_delays_that_are_no_number_of_sampling_times(delay):
    with pytest.raises(NumericsError, match=r"^delay is .*; give a whole number that is not negative$"):
        codegen.Controller(regulator(), delay=delay)


def test_inputs_on_their_way_to_a_controller_without_a_delay():
    with pytest.raises(ArgumentError, match=r"inputs on their way to a controller without a delay; leave them out"):
        codegen.Controller(regulator()).reset([1.0])
    with pytest.raises(NumericsError, match=r"the array of inputs has shape \(2,\), expected \(1,\)"):
        codegen.Controller(regulator(), delay=1).reset([1.0, 2.0])
