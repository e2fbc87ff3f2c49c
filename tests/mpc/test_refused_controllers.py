"""What a controller and a closed loop refuse, in one line that names what is wrong and what to do."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import PROBLEMS
from horizon_problems import carried, exactly, regulator
from interpreted import of_problem

import codegen
from codegen import Control, Phases, Simulate, control, coordinate, free_parameter, parameters, states
from codegen.errors import ArgumentError, NumericsError


def simulation(**forces):
    """A unit mass that moves by itself."""
    x, dx = coordinate("x")
    return of_problem(Simulate(lagrangian=dx**2 / 2 - x**2 / 2, duration=1, start={x: 0, dx: 0}, **forces))


def varied(scheme=None, controls="interval", **changes):
    """A problem of a unit mass that no controller takes."""
    x, v = states("x v")
    u = control("u")
    problem = {
        "dynamics": {x: v, v: u}, "cost": x**2 + u**2, "duration": 1, "start": {x: 1, v: 0}, "steps": 4,
    }  # fmt: skip
    own = Control(**{**problem, **{name: change(x, v, u) for name, change in changes.items()}})
    return of_problem(own, controls=controls, **({} if scheme is None else {"scheme": scheme}))


def phases():
    """Two phases."""
    x, v = states("x v")
    u = control("u")
    one = Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 1, v: 0}, steps=2)
    return of_problem(Phases(one, Control(dynamics={x: v, v: 2 * u}, cost=u**2, duration=1, end={x: 0}, steps=2)))


PROBLEM_TABLE = [
    (lambda: 3, "a solve begins with a problem, not with this int; give the path of a problem file"),
    (lambda: "nowhere.py", "nowhere.py: no such file"),
    (simulation, "problem is a simulate problem, and a controller needs an optimisation"),
    (phases, "problem has several phases, which a controller cannot shift in time; give a problem of one phase"),
    (
        lambda: varied(duration=lambda *_: free_parameter("T", 1, lower=0.5)),
        "problem has a free duration, which a controller cannot shift in time; give duration= a number",
    ),
    (
        lambda: varied(at=lambda x, v, u: {0.5: [x <= 2]}),
        "problem has conditions at inner times, which a controller cannot shift in time; write them as path=",
    ),
    (
        lambda: varied(start=lambda *_: {}, end=lambda x, v, u: {x: 1, v: 0}),
        "problem prescribes nothing at the start; write the state that is measured into start={...}",
    ),
    (
        lambda: varied(start=lambda x, v, u: {x: codegen.each_body(1, 2), v: 0}, bodies=lambda *_: 2),
        "problem has several bodies, which a controller cannot shift in time; write each as states and controls",
    ),
    (
        lambda: varied(dynamics=lambda x, v, u: {x: v, v: -x}, cost=lambda x, v, u: x**2),
        "problem has no controls; give a problem with codegen.control(...)",
    ),
    (
        lambda: varied(scheme="gauss-4", controls="stages"),
        "problem has controls at stages, which a controller cannot shift in time; build it with controls='interval'",
    ),
    (
        lambda: varied(scheme="rk4", controls="linear"),
        "problem has controls at nodes, which a controller cannot shift in time; build it with controls='interval'",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("make", "message"), PROBLEM_TABLE)
def test_problems_that_no_controller_takes(make, message):
    with pytest.raises(codegen.CodegenError) as refused:
        codegen.Controller(make())
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


OPTION_TABLE = [
    ({"steps": 0}, NumericsError, "steps is 0; give a positive integer"),
    ({"steps": True}, NumericsError, "steps is True; give a positive integer"),
    ({"newton_steps": 1.5}, NumericsError, "newton_steps is 1.5; give a positive integer"),
    ({"horizon": -1.0}, NumericsError, "horizon is -1.0; give a positive number of seconds"),
    ({"sample": "fast"}, NumericsError, "sample is 'fast'; give a positive number of seconds"),
    ({"sample": 3.0}, NumericsError, "the sampling time 3 is longer than the horizon 2; give a shorter sample"),
    ({"deadline": 0.0}, NumericsError, "deadline is 0.0; give a positive number of seconds"),
    ({"deadline": float("nan")}, NumericsError, "deadline is nan; give a positive number of seconds"),
    ({"tolerance": 0.0}, ArgumentError, "tolerance is 0.0; give a number between 0 and 1"),
    ({"scaling": "best"}, ArgumentError, "scaling is 'best'; use one of auto, none"),
    ({"parameters": {"plce": 1.0}}, ArgumentError, "the problem has no parameter 'plce'; did you mean place?"),
    ({"parameters": {"end.x": 1.0}}, ArgumentError, "the problem has no parameter 'end.x'; use one of T, place"),
    ({"parameters": {"place": np.inf}}, NumericsError, "parameter place is inf; give a finite number"),
    ({"parameters": {"place": lambda t: "x"}}, NumericsError, "parameter place at t = 0 is 'x'; give a finite number"),
    ({"parameters": [1]}, ArgumentError, "run-time values of the problem are [1]; give names and values"),
    ({"arguments": {"form": "x"}}, ArgumentError, "--set is a choice of a build"),
    ({"scheme": "midpoint"}, ArgumentError, "--scheme is a choice of a build"),
]


@pytest.mark.parametrize(("options", "kind", "message"), OPTION_TABLE)
def test_options_that_mean_nothing(options, kind, message):
    with pytest.raises(kind) as refused:
        codegen.Controller(regulator(), **options)
    assert str(refused.value).startswith(message)


STEP_TABLE = [
    (([1.0],), NumericsError, "the state has shape (1,), expected (2,); give x, v, in this order or by name"),
    (([[1.0, 2.0]],), NumericsError, "the state has shape (1, 2), expected (2,)"),
    (("now",), NumericsError, "the state is 'now'; give x, v, in this order or by name"),
    (({"x": 1.0},), NumericsError, "the state lacks v; give x, v, in this order or by name"),
    (({"x": 1.0, "v": 0.0, "w": 0.0},), NumericsError, "the state has no w; give x, v, in this order or by name"),
    (([1.0, 0.0], np.nan), NumericsError, "the time is nan; give a finite number"),
    (([1.0, 0.0], "now"), NumericsError, "the time is 'now'; give a finite number"),
    (([1.0, 0.0], 0.0, {"wnd": 1.0}), ArgumentError, "the problem has no parameter 'wnd'; did you mean wind?"),
    (([1.0, 0.0], 0.0, {"wind": None}), NumericsError, "parameter wind is None; give a finite number"),
]


@pytest.mark.parametrize(("given", "kind", "message"), STEP_TABLE)
def test_steps_with_what_is_no_state_time_or_value(given, kind, message):
    controller = codegen.Controller(regulator())
    expected = controller.step([0.5, 0.0])
    before = controller.last
    with pytest.raises(kind) as refused:
        controller.step(*given)
    assert str(refused.value).startswith(message)
    assert controller.last is before  # and it goes on as if nobody had asked
    np.testing.assert_allclose(controller.step([0.5, 0.0]), expected, atol=1e-8)


def test_a_plan_before_the_first_step():
    with pytest.raises(ArgumentError, match="there is no plan yet; call step first"):
        codegen.Controller(regulator()).plan()


def free_mass(**names):
    """A plant with an input of some name."""
    x, v = states("x v")
    (u,) = parameters(**names)
    return of_problem(Control(dynamics={x: v, v: u}, duration=1, start={x: 0, v: 0}, steps=2))


LOOP_TABLE = [
    ({"plant": regulator}, "problem is no plant: it has controls, or particles; give a Simulate"),
    ({"plant": simulation}, "the plant starts from x, dx, the controller from x, v; give both the same names"),
    ({"plant": lambda: free_mass(w=0)}, "the plant has no parameter u, which is an input of the controller"),
    ({"plant": lambda: free_mass(u=0), "disturbances": {"drag": 1.0}}, "the plant has no parameter 'drag'"),
    ({"plant": lambda: free_mass(u=0), "disturbances": {"u": 1.0}}, "u is an input of the plant; disturb another"),
    ({"disturbances": {"drag": 1.0}}, "disturbances beside a plant that is a function"),
    ({"samples": 0}, "samples is 0; give a positive integer"),
    ({"delay": -1}, "delay is -1; give a whole number that is not negative"),
    ({"delay": 0.5}, "delay is 0.5; give a whole number that is not negative"),
    ({"noise": -1.0}, "noise has a negative standard deviation; give numbers that are not negative"),
    ({"noise": {"y": 1.0}}, "noise of 'y', which is no state; use x, v"),
    ({"noise": [1.0]}, "noise has shape (1,), expected (2,)"),
    ({"start": [1.0, np.inf]}, "the start is not finite: v is inf"),
    ({"inputs": [1.0, 2.0]}, "the array of inputs has shape (2,), expected (1,)"),
    ({"plant": lambda: lambda *_: [1.0]}, "the plant returned an array of shape (1,), expected (2,); return x, v"),
    ({"plant": lambda: lambda *_: "there"}, "the plant returned 'there'; return x, v"),
    ({"inputs": [1.0, np.nan]}, "the array of inputs has shape (2,)"),
    ({"plant": lambda: PROBLEMS / "nowhere.py"}, f"{PROBLEMS / 'nowhere.py'}: no such file"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "message"), LOOP_TABLE)
def test_loops_that_cannot_be_closed(options, message):
    options = dict(options)
    plant = options.pop("plant", lambda: exactly)()
    with pytest.raises(codegen.CodegenError) as refused:
        codegen.close_loop(codegen.Controller(regulator()), plant, **options)
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


def test_a_loop_of_what_is_no_controller():
    with pytest.raises(ArgumentError, match=r"close_loop of a module; give a codegen\.Controller and a plant"):
        codegen.close_loop(carried(), exactly)


def test_a_reference_of_what_there_is_not(tmp_path):
    loop = codegen.close_loop(codegen.Controller(regulator()), exactly, samples=1)
    with pytest.raises(ArgumentError, match="a reference of 'y'; use x, v, u"):
        loop.plot(tmp_path / "loop.png", references={"y": lambda t: t})
