"""The estimated error of the discretisation against the true one: closed forms, and Richardson's extrapolation."""

from __future__ import annotations

import json

import numpy as np
import pytest
from compiled_modules import compiled
from conftest import PROBLEMS
from interpreted import of_problem

from codegen import Control, Simulate, control, coordinates, free_parameter, states
from codegen.discretise import schemes
from codegen.errors import NumericsError
from codegen.solving import api
from codegen.solving.arcs import discretisation_error
from codegen.solving.compiler import build
from codegen.solving.results import output
from codegen.solving.results.result import UNKNOWN_ERROR, Result

FACTOR = 3.0
EFFORT, PENDULUM = 12.0, 4.530760981081599
"""The integral of u^2 from rest to rest along x = 3 t^2 - 2 t^3, and the least cost of the linear pendulum."""
SCHEMES = [
    ("variational", "midpoint", "interval"),
    ("variational", "trapezoidal", "interval"),
    ("variational", "gauss-4", "interval"),
    ("hamiltonian", "rk4", "interval"),
    ("hamiltonian", "hermite-simpson", "interval"),
    ("hamiltonian", "midpoint", "nodal"),
]


def within(estimate: float, truth: float) -> bool:
    """Whether an estimate is the truth but for a factor."""
    return truth / FACTOR <= estimate <= FACTOR * truth


@pytest.mark.parametrize("steps", [10, 21, 40])
@pytest.mark.parametrize(("method", "scheme", "controls"), SCHEMES)
def test_closed_forms(interpreted, method, scheme, controls, steps):
    choices = {"method": method, "scheme": scheme, "controls": controls}
    pendulum = api.solve(interpreted("linear_pendulum", **choices), steps=steps)
    assert within(pendulum.error.cost, abs(pendulum.cost - PENDULUM) / PENDULUM)
    effort = api.solve(interpreted("double_integrator_effort", **choices), steps=steps)
    assert within(effort.error.cost, abs(effort.cost - EFFORT) / EFFORT)
    exact = np.stack([3.0 * effort.t**2 - 2.0 * effort.t**3, 6.0 * effort.t - 6.0 * effort.t**2], axis=1)
    found = np.column_stack([effort.q, effort.p])
    errors = np.abs(found - exact).max(axis=0) / np.abs(found).max(axis=0)
    if errors.max() > 1e-9:  # some schemes have the states of this one exactly
        assert within(effort.error.states, errors.max())
    else:
        assert effort.error.states < 1e-9


@pytest.mark.parametrize("controls", ["stages", "linear"])
@pytest.mark.parametrize("steps", [6, 10])
def test_fourth_order_of_controls_that_vary_on_intervals(interpreted, steps, controls):
    module = interpreted("linear_pendulum", scheme="gauss-4", controls=controls)
    result = api.solve(module, steps=steps)
    assert within(result.error.cost, abs(result.cost - PENDULUM) / PENDULUM)


def damped(limit: float) -> Control:
    """A nonlinear system with a bounded control and a free parameter, without a closed form."""
    x, v = states("x v")
    u, a = control("u"), free_parameter("a", guess=1)
    return Control(
        dynamics={x: v, v: u - x**3 - a * v},
        cost=u**2 + x**2 + (a - 0.5) ** 2 / 2,
        duration=3,
        start={x: 1, v: 0},
        end={x: 0},
        bounds={u: (-limit, limit)},
        steps=20,
    )


@pytest.mark.parametrize("limit", [10.0, 0.35])
@pytest.mark.parametrize("scheme", ["midpoint", "gauss-4", "rk4", "hermite-simpson"])
def test_richardson(scheme, limit):
    module = of_problem(damped(limit), scheme=scheme)
    coarse, middle, fine = (api.solve(module, steps=steps) for steps in (20, 40, 80))
    truth = fine.cost + (fine.cost - middle.cost) / 3.0
    states = fine.q[::4] + (fine.q[::4] - middle.q[::2]) / 3.0
    errors = np.abs(coarse.q - states).max(axis=0) / np.abs(coarse.q).max(axis=0)
    parameter = abs(coarse.summary["a"] / (fine.summary["a"] + (fine.summary["a"] - middle.summary["a"]) / 3.0) - 1.0)
    assert within(coarse.error.cost, abs(coarse.cost / truth - 1.0))
    assert within(coarse.error.states, max(errors.max(), parameter))
    assert coarse.error.quantity in ("x", "v", "a")


@pytest.mark.parametrize("name", ["two_stage_rocket", "hovercraft", "brachistochrone"])
def test_phases_bodies_and_free_durations(interpreted, name):
    module = interpreted(name)
    coarse, middle, fine = (api.solve(module, steps=steps) for steps in (10, 20, 40))
    truth = fine.cost + (fine.cost - middle.cost) / 3.0
    assert within(middle.error.cost, abs(middle.cost / truth - 1.0))
    assert within(coarse.error.cost, abs(coarse.cost / truth - 1.0))


@pytest.fixture(scope="module")
def ethanol(cache_folder):
    return compiled(build(PROBLEMS / "published" / "ethanol.py").path)


@pytest.mark.parametrize("steps", [100, 200, 400])
def test_controls_that_chatter_are_noted(ethanol, steps):
    """Midpoints alternate along the singular arc, and with 400 intervals the optimum is another, of 18126."""
    result = api.solve(ethanol, steps=steps, parameters={"hours": 54})
    assert result.solved
    assert result.error.is_large
    (note,) = result.notes
    assert f"{100 * result.error.states:.2g} % of {result.error.quantity}" in note
    assert "take more --steps, or --accuracy" in note


def test_a_figure_is_small_where_the_error_is(interpreted):
    result = api.solve(interpreted("linear_pendulum"), steps=100)
    assert not result.error.is_large
    assert result.notes == ()


def test_the_estimate_is_shown(interpreted):
    result = api.solve(interpreted("linear_pendulum"), steps=10)
    record = json.loads(output.as_json(output.as_record(result, 0.0, 0.0)))
    assert record["summary"]["cost_error"] == result.error.cost
    assert record["summary"]["state_error"] == result.error.states
    assert result.label("state_error") == "relative error of states"


def test_no_estimate_is_noted(interpreted, monkeypatch):
    module = interpreted("linear_pendulum")
    result = api.solve(module, steps=10)
    monkeypatch.setattr("codegen.solving.arcs._carried_on", lambda *_: None)
    assert discretisation_error(module, result, lambda *_: None) is None
    monkeypatch.setattr("codegen.solving.api.discretisation_error", lambda *_, **__: None)
    assert api.solve(module, steps=10).notes == (UNKNOWN_ERROR,)


@pytest.mark.parametrize("steps", [40, 60, 80])
def test_active_slacks_that_are_small_stay_active_on_double_steps(steps):
    """The optimum on double steps violated the condition by its whole right side, which is small beside one."""
    (x, y), (v, w) = coordinates("x y")
    f, stretch = control("f"), y - x
    damping = 0.2 * (w - v)
    carts = Control(
        lagrangian=v**2 / 2 + w**2 / 4 - 2 * stretch**2, force={x: f + damping, y: -damping}, cost=f**2,
        duration=2.5, start={x: 0, v: 0, y: 0, w: 0}, end={x: 1, v: 0, y: 1, w: 0}, bounds={f: (-2, 2)},
        path=[stretch**2 <= 0.15**2], steps=steps,
    )  # fmt: skip
    result = api.solve(of_problem(carts))
    limit = 1.995451  # on 1600 intervals
    assert result.error.cost < 5.0 * abs(result.cost - limit) / limit


SIMULATED = [scheme.name for scheme in schemes.of_method(schemes.FIRST_ORDER) if not scheme.adaptive]


def turning(steps: int | None, accuracy: float | None = None, **choices) -> Result:
    """Return the motion of x'' = -x from rest at x = 1, which is the cosine."""
    x, v = states("x v")
    problem = Simulate(dynamics={x: v, v: -x}, start={x: 1, v: 0}, duration=6, steps=40)
    return api.solve(of_problem(problem, **choices), steps=steps, accuracy=accuracy)


@pytest.mark.parametrize("steps", [60, 61, 63])
@pytest.mark.parametrize("scheme", SIMULATED)
def test_simulations(scheme, steps):
    """These are compared with a half, the double and a third of their steps."""
    result = turning(steps, scheme=scheme)
    exact = np.stack([np.cos(result.t), -np.sin(result.t)], axis=1)
    truth = (np.abs(result.q - exact) / np.abs(result.q).max(axis=0)).max()
    assert within(result.error.states, truth) or truth < 1e-12
    assert result.error.cost is None
    assert "cost_error" not in result.summary
    assert bool(result.notes) == (result.error.states > 0.01)


def test_a_simulation_without_memory_for_more_steps_has_no_estimate(monkeypatch):
    """Of a prime number of steps there is no part."""

    def limited(numbers, steps):
        if steps > 41:
            raise NumericsError("too little memory", "take fewer steps")

    monkeypatch.setattr(api, "require_memory", limited)
    result = turning(41, scheme="midpoint")
    assert (result.status, result.error) == ("solved", None)
    refined = turning(None, accuracy=1e-9, scheme="midpoint")
    assert (refined.status, refined.steps) == ("accuracy not reached", 40)
    assert "too little memory" in refined.message


@pytest.mark.parametrize(("scheme", "request_"), [("midpoint", 1e-4), ("rk4", 1e-7), ("gauss-4", 1e-9)])
def test_simulations_reach_an_accuracy(scheme, request_):
    result = turning(None, accuracy=request_, scheme=scheme)
    exact = np.stack([np.cos(result.t), -np.sin(result.t)], axis=1)
    assert result.status == "solved", result.message
    assert np.abs(result.q - exact).max() <= FACTOR * request_
    assert result.accuracy.estimate <= request_
    assert [level.intervals for level in result.accuracy.levels] == sorted({40, result.steps})


def test_an_accuracy_below_rounding_errors_is_not_reached():
    result = turning(None, accuracy=1e-16, scheme="gauss-6")
    assert result.status == "accuracy not reached"
    assert "more steps change the motion no less" in result.message
    assert result.accuracy.estimate == min(level.error for level in result.accuracy.levels) < 1e-12
