"""What is wrong with a solution is found and named: drift, saddle points, minima that are not strict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from conftest import PROBLEMS
from failed_checks import failures

from codegen.evidence import checks
from codegen.evidence.checks.solution import is_determined


def with_solution(context, **changes):
    """The context with a solution that differs from the solver's."""
    changed = replace(context)
    changed.__dict__["solution"] = context.solution._replace(**changes)
    return changed


def test_motion_that_drifts_off_its_constraint(prepared):
    context = prepared("spherical_pendulum")
    q = context.solution.q.copy()
    q[7, 1] += 1e-6
    (failure,) = failures("holonomic drift", with_solution(context, q=q))
    assert "the motion leaves the constraint" in failure.detail
    assert "at node 7" in failure.detail


def test_the_solution_has_the_intervals_that_were_asked_for(prepared):
    """Also fewer than the default; small numbers, on which problems have no motion, become larger."""
    context = prepared("double_integrator_effort")
    for asked, taken in ((30, 30), (1, 8)):
        assert replace(context, steps=asked).solution.t.size == taken + 1


def test_saddle_point_is_no_minimum(prepared, tmp_path: Path):
    """Both ways round a hill of the cost are minima, and the straight way over it is a saddle point."""
    path = tmp_path / "hill.py"
    path.write_text(HILL)
    context = prepared(path)
    on_top = with_solution(context, status="solved", unknowns=0 * context.solution.unknowns)
    (failure,) = failures("second-order condition", on_top)
    assert "no minimum: the cost decreases to second order in " in failure.detail


HILL = '''"""Stay at zero, where the cost is greatest."""
from codegen import Control, control, coordinate
def problem() -> Control:
    q, dq = coordinate("q")
    u = control("u")
    return Control(lagrangian=dq**2 / 2, force={q: u}, cost=u**2 - 1000 * q**2 + q**4, duration=2,
                   start={q: 0, dq: 0}, end={q: 0, dq: 0}, steps=40)
'''


def test_duration_that_the_discretisation_does_not_see(prepared):
    context = prepared("double_integrator")
    assert failures("discrete equations", context) == []
    program = replace(context.program, scaled_time=False)
    (failure,) = failures("discrete equations", replace(context, program=program))
    assert failure.subject == "equation of motion of x"


def test_a_symmetry_leaves_a_minimum_that_is_not_isolated(prepared, tmp_path: Path):
    """The isoperimetric problem: every rotation of the circle is an optimum."""
    path = tmp_path / "area.py"
    text = (PROBLEMS / "published" / "isoperimetric_area.py").read_text(encoding="utf-8")
    assert "steps=2000" in text
    path.write_text(text.replace("steps=2000", "steps=16"))
    (finding,) = checks.apply("second-order condition", prepared(path))
    assert finding.passed
    assert "isolated or not" in finding.detail


FAR_FROM_LIMITS = '''"""A mass that is pushed; its path conditions are never met with equality."""
from codegen import Control, control, states
def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0},
                   path=[v + u <= 1000, v - x**2 <= 50], steps=20)
'''


def test_slacks_of_conditions_that_are_not_met_leave_a_minimum_strict(prepared, tmp_path: Path):
    path = tmp_path / "pushed.py"
    path.write_text(FAR_FROM_LIMITS)
    context = prepared(path)
    (finding,) = checks.apply("second-order condition", context)
    assert finding.passed
    assert "a strict local minimum" in finding.detail
    left_out = context.module.metadata.left_out
    assert "derivatives of the dynamics by x: no right-hand side depends on x" in left_out


PERIOD = '''"""The half period of a pendulum without a cost: as many equations as unknowns."""
from sympy import sin
from codegen import Control, free_parameter, states
def problem() -> Control:
    x, v = states("x v")
    T = free_parameter("T", 3.3, lower=0.5)
    return Control(dynamics={x: v, v: -sin(x)}, duration=T, start={x: 1, v: 0}, end={v: 0}, guess={x: 0, v: -1},
                   steps=20)
'''


def test_where_equations_determine_everything_there_is_nothing_to_minimise(prepared, tmp_path: Path):
    path = tmp_path / "period.py"
    path.write_text(PERIOD)
    context = prepared(path)
    (finding,) = checks.apply("second-order condition", context)
    assert not finding.applies
    assert "the equations alone determine the solution" in finding.detail
    assert context.solution.status == "solved"
    grid = context.module.make_grid(20)
    free = np.zeros(context.solution.unknowns.size)
    assert is_determined(context.module, grid, context.solution.unknowns, free)
    assert not is_determined(context.module, grid, np.zeros(free.size), free)  # at rest T means nothing


STEEP = '''"""A mass in a force of 1e9 times another one, so that second derivatives are large wherever it is."""
from sympy import exp
from codegen import Control, control, states
def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(dynamics={x: v, v: u - exp(20 * (x + 1))}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1},
                   steps=10)
'''


def test_the_newton_step_is_compared_whatever_the_units_of_the_hessian(prepared, tmp_path: Path):
    path = tmp_path / "steep.py"
    path.write_text(STEEP)
    found = {finding.subject: finding for finding in checks.apply("assembly", prepared(path))}
    assert found["Newton step"].passed, found["Newton step"].detail
    assert "it solves all" in found["Newton step"].detail


def test_rows_that_need_a_solution_are_not_measured_where_there_is_none(prepared):
    context = with_solution(prepared("spherical_pendulum"), status="stalled", message="stopped early")
    for name in ("second-order condition", "holonomic drift", "momentum matching"):
        found = [f for f in checks.apply(name, context) if "not measured" in f.detail]
        assert len(found) == 1
        assert found[0].passed
        assert not found[0].applies
        assert "stopped early" in found[0].detail


CONSTRAINED = '''"""A point on a circle passes its lowest point at a time of its choice."""
from sympy import Eq
from codegen import Control, controls, coordinates
def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    u, w = controls("u w")
    return Control(
        lagrangian=(dx**2 + dy**2) / 2 - y, force={x: u, y: w}, cost=u**2 + w**2, duration=1,
        constraint=[x**2 + y**2 - 1], start={x: -0.6, y: -0.8, dx: 0, dy: 0}, end={x: 0.6, y: -0.8, dx: 0, dy: 0},
        waypoints=[[Eq(y + 0 * x, -1)]], steps=8,
    )
'''


def test_constraint_forces_are_found_among_the_unknowns_of_a_clock(prepared, tmp_path: Path):
    path = tmp_path / "constrained.py"
    path.write_text(CONSTRAINED)
    context = prepared(path)
    assert [unknown.name for unknown in context.control.holonomic_multipliers] == ["kappa_1"]
    assert not failures("discrete equations", context)
