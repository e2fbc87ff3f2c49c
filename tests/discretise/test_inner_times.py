"""Conditions at inner times, and waypoints: splines, closed forms, grids, refusals, a planted defect."""

from __future__ import annotations

from dataclasses import replace
from math import cosh, sinh

import numpy as np
import pytest
import sympy
from interpreted import text_of, without_compilation
from scipy.interpolate import CubicSpline
from sympy import Eq
from written_objects import unit_mass

from codegen import (
    Control,
    Waypoint,
    body_number,
    control,
    free_parameter,
    parameter,
    states,
    together,
)
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes import find
from codegen.discretise.schemes.base import FIRST_ORDER
from codegen.discretise.transcribe import transcribe
from codegen.emit.naming import Choices
from codegen.errors import BoundaryError
from codegen.evidence.checks import CHECKS
from codegen.evidence.checks.base import Context

TIMES, HEIGHTS = (1.0, 1.5, 3.0), (1.0, -0.5, 2.0)
FORMS = ["lagrangian", "hamiltonian", "dynamics"]


def spline(times=TIMES, heights=HEIGHTS, duration=4.0) -> tuple[CubicSpline, float]:
    """The motion of least integral of x''^2 from rest at 0 to rest at 0 through given heights, and that integral."""
    motion = CubicSpline([0.0, *times, duration], [0.0, *heights, 0.0], bc_type="clamped")
    second = motion.derivative(2)
    # x'' is linear on each piece, where Simpson's rule is exact for its square.
    pieces = [(a, (a + b) / 2, b) for a, b in zip(motion.x[:-1], motion.x[1:], strict=True)]
    return motion, sum((c - a) / 6 * (second(a) ** 2 + 4 * second(b) ** 2 + second(c) ** 2) for a, b, c in pieces)


def through(form: str = "dynamics", at=None, **others) -> Control:
    """A unit mass, at rest at 0 at both ends, that passes given heights."""
    x, v, u, motion = unit_mass(form)
    given = {time: [Eq(x, height)] for time, height in zip(TIMES, HEIGHTS, strict=True)} if at is None else at(x, v)
    rest = {x: 0, v: 0}
    return Control(**{**motion, "cost": u**2, "duration": 4, "start": rest, "end": rest, "at": given, **others})


def loaded(problem: Control, **choices: str):
    return without_compilation(text_of(problem, **choices))


def solved(module, steps: int, **given):
    solution = module.solve(steps, **given)
    assert solution.status == "solved", solution.message
    return solution


def multiplier(module, solution, number: int = 0) -> float:
    _, time, index = module.metadata.inner_conditions[number]
    grid = module.make_grid(solution.t.size - 1)
    return float(module.views(grid, solution.unknowns)[0][0, grid.inner[time], index])


@pytest.mark.parametrize("form", FORMS)
def test_least_effort_through_given_heights_is_a_cubic_spline(form):
    """Cost and motion converge with order 2 to scipy's clamped spline."""
    motion, effort = spline()
    module, errors = loaded(through(form)), []
    for steps in (16, 32):
        solution = solved(module, steps)
        x = solution.q[:, 0]
        errors.append((abs(solution.cost / effort - 1), np.abs(x - motion(solution.t)).max()))
        np.testing.assert_allclose(np.interp(TIMES, solution.t, x), HEIGHTS, atol=1e-10)
    for coarse, fine in zip(*errors, strict=True):
        assert fine < 0.06
        assert coarse / fine == pytest.approx(4.0, rel=0.25)


def test_the_scheme_keeps_its_order():
    """Between inner times the control is linear, which two stages represent."""
    solution = solved(loaded(through(), scheme="gauss-4", controls="stages"), 7)
    motion, effort = spline()
    assert solution.cost == pytest.approx(effort, rel=1e-10)
    np.testing.assert_allclose(solution.q[:, 0], motion(solution.t), atol=1e-10)


def test_interior_point():
    """PSOPT's example: hyperbolic functions on either side."""

    def least(a: float, b: float, duration: float) -> float:
        return ((a**2 + b**2) * cosh(duration) - 2 * a * b) / sinh(duration)

    (x,), u = states("x,"), control("u")
    problem = Control(
        dynamics={x: u}, cost=x**2 + u**2, duration=1, start={x: 1}, end={x: 0.75}, at={0.75: [Eq(x, 0.9)]}
    )
    optimum = least(1, 0.9, 0.75) + least(0.9, 0.75, 0.25)
    assert optimum == pytest.approx(0.9205314415, abs=1e-10)  # as PSOPT publishes it
    assert solved(loaded(problem, scheme="gauss-4", controls="stages"), 40).cost == pytest.approx(optimum, rel=1e-9)


@pytest.mark.slow
def test_velocities_are_those_of_the_discrete_momentum():
    """Both ends of an interval tell the same momentum, so that midpoint rules of all forms have one optimum."""
    costs = []
    for form in FORMS:
        problem = through(form, at=lambda x, v: {1.5: [Eq(v, 0.7), x >= 1], 3: [Eq(x + v, -1)]})
        costs.append(solved(loaded(problem), 16).cost)
    assert max(costs) - min(costs) < 1e-9 * max(costs)
    assert min(costs) > 1.0


def test_times_and_values_are_arguments():
    tau, height = parameter("tau", 1.0), parameter("height", 1.0)
    module = loaded(through(at=lambda x, v: {tau: [Eq(x, height)], 3: [Eq(x, 2)]}), scheme="gauss-4", controls="stages")
    for given in ({}, {"tau": 2.25, "height": -1.0}):
        _, effort = spline((given.get("tau", 1.0), 3.0), (given.get("height", 1.0), 2.0))
        assert solved(module, 9, **given).cost == pytest.approx(effort, rel=1e-9)
    with pytest.raises(ValueError, match="ascend"):
        module.solve(9, tau=3.5)


def test_intervals_are_shared_out_and_given_grids_have_the_times():
    module = loaded(through())
    for steps, counts in ((4, (1, 1, 1, 1)), (8, (2, 1, 3, 2)), (9, (3, 1, 3, 2)), (80, (20, 10, 30, 20))):
        grid = module.make_grid(steps)
        times = grid.nodes * grid.h
        np.testing.assert_allclose(times[list(grid.inner)], TIMES, rtol=1e-14)
        assert tuple(np.diff([0, *grid.inner, steps])) == counts
    assert module.make_grid(80).is_uniform
    with pytest.raises(ValueError, match="steps must be at least 4"):
        module.make_grid(3)
    assert module.make_grid(grid=[0.25, 0.125, 0.25, 0.125, 0.25]).inner == (1, 2, 4)
    with pytest.raises(ValueError, match=r"grid must have a node at the inner time 1\.5"):
        module.make_grid(grid=[0.25, 0.25, 0.25, 0.25])


def test_code_does_not_grow_with_the_number_of_times():
    def kernels(count: int) -> str:
        times = np.linspace(0, 4, count + 2)[1:-1]
        text = text_of(through(at=lambda x, v: {t: [Eq(x, t**2), v >= t] for t in times}))
        return text[text.index("def interval_gradient") : text.index("def start_gradient")].replace(f", {count}, ", "")

    assert kernels(2) == kernels(12)


def test_different_conditions_share_their_multipliers():
    problem = through(at=lambda x, v: {1: [Eq(x, 1)], 2: [Eq(x**3, 1), v <= 3], 3: [Eq(x * v, 0.5), x >= 0]})
    program = transcribe(normalise(problem))
    names = [unknown.name for unknown in program.node]
    assert names == ["x", "v", "nu_1", "nu_2", "s_1"]
    assert program.inner.present == ((True, False, False), (True, True, True), (True, True, True))


@pytest.mark.slow
def test_an_inequality_that_is_active_is_an_equation_and_one_that_is_not_changes_nothing():
    equation = solved(loaded(through(at=lambda x, v: {2: [Eq(x, 1)]})), 8)
    for relation in (lambda x: x >= 1, lambda x: -x <= -1):
        module = loaded(through(at=lambda x, v, relation=relation: {2: [relation(x)]}))
        assert solved(module, 8).cost == pytest.approx(equation.cost, rel=1e-7)
    idle = loaded(through(at=lambda x, v: {2: [Eq(x, 1), v <= 5], 3: [x <= 7]}))
    assert solved(idle, 8).cost == pytest.approx(equation.cost, rel=1e-7)


def test_the_multiplier_is_the_slope_of_the_cost():
    height = parameter("height", 1.0)
    module = loaded(through(at=lambda x, v: {2: [Eq(x, height)]}))
    more, less = (solved(module, 8, height=1.0 + d).cost for d in (1e-3, -1e-3))
    assert multiplier(module, solved(module, 8)) == pytest.approx(-(more - less) / 2e-3, rel=1e-8)


@pytest.mark.slow
def test_a_value_may_lie_on_a_bound_and_on_a_path_condition():
    problem = through(at=lambda x, v: {2: [Eq(x, 1)]})
    (x, v), cost = problem.dynamics, solved(loaded(problem), 8).cost
    for limits in ({"bounds": {x: (-1, 1)}}, {"path": [x <= 1]}, {"path": [x - v / 100 <= 1.02]}):
        assert solved(loaded(replace(problem, **limits)), 8).cost == pytest.approx(cost, rel=1e-7)
    with pytest.raises(BoundaryError, match="inner time 2 violates x <= 1/2"):
        transcribe(normalise(replace(problem, bounds={x: (-1, 0.5)})))
    decided = replace(problem, at={2: [Eq(x, 1), x <= 2]})
    with pytest.raises(BoundaryError, match="the equations there decide x <= 2"):
        transcribe(normalise(decided))


def test_conditions_need_no_value_at_other_nodes():
    """A distance has no slope where the motion begins, and a logarithm no value; the same conditions without them."""
    costs = []
    plain = (lambda a, b: a**2 + b**2 - 4, lambda a: a - 1)
    for distance, height in (plain, (lambda a, b: sympy.sqrt(a**2 + b**2) - 2, sympy.log)):
        x, y, v, w = states("x y v w")
        a, b = control("a"), control("b")
        problem = Control(
            dynamics={x: v, y: w, v: a, w: b},
            cost=a**2 + b**2,
            duration=4,
            start={x: 0, y: 0, v: 0, w: 0},
            end={x: 0, y: 0, v: 0, w: 0},
            at={1: [Eq(height(x), 0)], 2: [distance(x, y)], 3: [distance(x, 2 * y)]},
            guess={x: 1, y: 1},
        )
        costs.append(solved(loaded(problem), 8).cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_several_bodies_meet_the_conditions_each_for_itself():
    problem = through(at=lambda x, v: {2: [Eq(x, 1)]}, start={}, end={})
    x, v = problem.dynamics
    problem = replace(problem, bodies=3, start={x: body_number(), v: 0}, end={x: body_number(), v: 0})
    solution = solved(loaded(problem, scheme="gauss-4", controls="stages"), 8)
    np.testing.assert_allclose(solution.q[4, [0, 2, 4]], 1.0, atol=1e-12)
    costs = [spline((2.0,), (1.0 - start,))[1] for start in range(3)]
    assert solution.cost == pytest.approx(sum(costs), rel=1e-9)


def test_different_bodies_have_the_times_of_both():
    first = through(at=lambda x, v: {1: [Eq(x, 1)]})
    y, w = states("y w")
    u = control("f")
    rest = {y: 0, w: 0}
    second = Control(
        dynamics={y: w, w: u}, cost=u**2, duration=4, start=rest, end=rest, at={1: [Eq(y, 2)], 3: [Eq(y, 1)]}
    )
    solution = solved(loaded(together(first, second), scheme="gauss-4", controls="stages"), 8)
    efforts = spline((1.0,), (1.0,))[1], spline((1.0, 3.0), (2.0, 1.0))[1]
    assert solution.cost == pytest.approx(sum(efforts), rel=1e-9)


def there_and_back(**others) -> Control:
    """A unit mass with |u| <= 1 that passes x = 1 and is at rest at 0 again after the least time, which is 4."""
    x, v = states("x v")
    u, duration = control("u"), free_parameter("T", 5, lower=0.5)
    rest = {x: 0, v: 0}
    given = {"waypoints": [[Eq(x, 1)]], **others}
    motion = {"dynamics": {x: v, v: u}, "bounds": {u: (-1, 1)}, "start": rest, "end": rest}
    return Control(**{**motion, "terminal_cost": duration, "duration": duration, **given})


def test_a_free_waypoint_in_least_time():
    """Full thrust for 1, back for 2, and again for 1: x = 1 is reached at rest, at t = 2."""
    module = loaded(there_and_back())
    solution = solved(module, 8)
    assert solution.cost == pytest.approx(4.0, rel=1e-8)
    np.testing.assert_allclose(solution.t, np.linspace(0, 4, 9), atol=1e-4)
    assert multiplier(module, solution) == pytest.approx(-2.0, rel=1e-3)  # T = 4 sqrt(height)


@pytest.mark.slow
def test_windows_and_given_times_of_a_free_duration_agree():
    """A window that is active, one without length, and a given time beside a free duration are one problem."""
    problem = there_and_back()
    (x, _) = problem.dynamics
    condition = [Eq(x, 1)]
    variants = [
        {"waypoints": [Waypoint(condition, window=(None, 1.8))]},
        {"waypoints": [Waypoint(condition, window=(1.8, 1.8))]},
        {"waypoints": (), "at": {1.8: condition}},
    ]
    solutions = [solved(loaded(replace(problem, **variant)), 8) for variant in variants]
    for solution in solutions:
        assert solution.t[4] == pytest.approx(1.8, abs=1e-7)
        assert solution.cost == pytest.approx(solutions[0].cost, rel=1e-7)
    assert solutions[0].cost > 4.001


GATES = ((1, 1), (2, -1), (3, 1))
LEAST_TIME = {20: 9.939914293428}
"""Through the gates, by CasADi 3.8.2 and IPOPT on the same program, a phase for each gate (benchmarks/waypoints.py)."""


@pytest.mark.slow
def test_least_time_through_gates():
    x, y, v, w = states("x y v w")
    a, b, duration = control("a"), control("b"), free_parameter("T", 8, lower=0.1)
    problem = Control(
        dynamics={x: v, y: w, v: a, w: b},
        terminal_cost=duration,
        duration=duration,
        start={x: 0, y: 0, v: 0, w: 0},
        end={x: 4, y: 0, v: 0, w: 0},
        path=[a**2 + b**2 <= 1],
        waypoints=[[Eq(x, gate[0]), Eq(y, gate[1])] for gate in GATES],
    )
    for steps, optimum in LEAST_TIME.items():
        assert solved(loaded(problem), steps).cost == pytest.approx(optimum, rel=1e-8)


@pytest.mark.parametrize("form", FORMS)
def test_waypoints_in_every_form(form):
    """Of all passing times those of least effort: a search over splines finds no better ones."""
    problem = through(form, at=lambda x, v: {})
    x = sympy.Symbol("x")
    x = next(s for s in {**problem.start} if s.name == "x")
    problem = replace(problem, waypoints=[[Eq(x, 1)], [Eq(x, -0.5)]])
    solution = solved(loaded(problem), 48)
    found = solution.t[[16, 32]]
    effort = spline(tuple(found), (1.0, -0.5))[1]
    assert solution.cost == pytest.approx(effort, rel=0.02)
    for moved in ((0.05, 0.0), (-0.05, 0.0), (0.0, 0.05), (0.0, -0.05)):
        assert spline(tuple(found + moved), (1.0, -0.5))[1] > effort * (1 - 1e-4)


def test_a_changed_condition_is_found_by_the_check():
    problem = through()
    model, text = normalise(problem), text_of(problem)
    contexts = [
        Context(Choices(), model, transcribe(model), find("midpoint", FIRST_ORDER), without_compilation(variant))
        for variant in (text, text.replace("at_1*(at_2 + x_k)", "at_1*(at_2 + x_k + 0.01)"))
    ]
    assert contexts[0].module.__dict__.keys() == contexts[1].module.__dict__.keys()
    sound, damaged = ([f.passed for f in CHECKS["inner times"].findings(context)] for context in contexts)
    assert sound == [True] * 4
    assert damaged == [False] * 3 + [True]
