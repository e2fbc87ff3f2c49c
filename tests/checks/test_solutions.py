"""What is wrong with a solution is found and named: drift, saddle points, minima that are not strict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from conftest import PROBLEMS
from failed_checks import failures

from codegen import checks


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
    left_out = context.module.metadata["left_out"]
    assert "derivatives of the dynamics by x: no right-hand side depends on x" in left_out


def test_rows_that_need_a_solution_are_not_measured_where_there_is_none(prepared):
    context = with_solution(prepared("spherical_pendulum"), status="stalled", message="stopped early")
    for name in ("second-order condition", "holonomic drift", "momentum matching"):
        found = [f for f in checks.apply(name, context) if "not measured" in f.detail]
        assert len(found) == 1
        assert found[0].passed
        assert not found[0].applies
        assert "stopped early" in found[0].detail
