"""Damage to what is shared, coupled, bounded or given is found, and the finding names it."""

from __future__ import annotations

import re

import pytest
from evidence.test_damage import failures, line_with, negated, text_from

from codegen.evidence.checks import assembly

# ---- Conditions between bodies ----


def test_slope_of_a_coupling(prepared, damaged):
    context = prepared("hovercraft")
    line = line_with(context, "by a1", "coupling_0")
    found = failures("derivatives", damaged(context, line, negated(line)))
    assert [failure.subject for failure in found] == ["slopes of coupling_term"]
    # The first condition is the distance of the first two craft, coupling_0 the square of a difference.
    assert re.search(r"condition of nu_\d by [xy]_[12] differs", found[0].detail)


def test_curvature_of_a_coupling(prepared, damaged):
    context = prepared("hovercraft")
    line = line_with(context, "by a0 and a1", "coupling_0")
    (failure,) = failures("derivatives", damaged(context, line, negated(line)))
    assert failure.subject == "curvatures of coupling_term"
    assert re.search(r"condition of nu_\d by [xy]_\d and [xy]_\d differs", failure.detail)


def test_value_of_a_coupling(prepared, damaged):
    context = prepared("hovercraft")
    line = re.search(r"    return .*", text_from(context, "coupling_0"))[0]
    (failure,) = failures("derivatives", damaged(context, line, f"{line} + 1e-3"))
    assert failure.subject == "coupling_term"
    assert "condition of nu_" in failure.detail


def test_places_of_a_coupling(prepared, damaged):
    """One side of the polygon would connect craft 0 and 2 instead of 0 and 1."""
    context = prepared("hovercraft")
    damage = damaged(context, "COUPLING_INDICES = np.array([[0, 2]", "COUPLING_INDICES = np.array([[0, 4]")
    found = failures("derivatives", damage)
    assert {failure.subject for failure in found} > {"coupling_term", "slopes of coupling_term"}
    assert all("condition of nu_1" in failure.detail for failure in found)


def test_coupling_that_reads_beyond_the_shared_unknowns(prepared, damaged):
    context = prepared("hovercraft")
    damage = damaged(context, "COUPLING_INDICES = np.array([[0, 2]", "COUPLING_INDICES = np.array([[0, 6]")
    (failure,) = failures("layout", damage)
    assert "COUPLING_INDICES is" in failure.detail
    assert "below 6" in failure.detail


def test_coupling_that_is_told_too_few_unknowns(prepared, damaged):
    context = prepared("hovercraft")
    (failure,) = failures("layout", damaged(context, "COUPLING_COUNTS = np.array([2", "COUPLING_COUNTS = np.array([1"))
    assert "kernel coupling_0 fails (IndexError" in failure.detail


# ---- Shared unknowns ----


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("END_SHARED = np.array([0, 1]", "END_SHARED = np.array([1, 0]"),
        ("END_TIED = np.array([0, 1]", "END_TIED = np.array([0, 2]"),
        ("END_PINNED = np.array([0, 1, 2]", "END_PINNED = np.array([0, 2]"),
        ("OWN = 2", "OWN = 1"),
        ("SHARED = 2", "SHARED = 3"),
        ("ROOT = 12", "ROOT = 11"),
    ],
)
def test_shared_indices(prepared, damaged, old, new):
    (failure,) = failures("layout", damaged(prepared("hovercraft"), old, new))
    assert f"{old.partition(' ')[0]} is" in failure.detail


def test_unknown_that_does_not_follow_the_shared_one(prepared, damaged):
    context = prepared("hovercraft")
    line = re.search(r"    nodes\[:, -1, 1\] = own\[:, 1\]", text_from(context, "pin_values"))[0]
    (failure,) = failures("given values", damaged(context, line, line.replace("own[:, 1]", "own[:, 0]")))
    assert failure.subject == "pinned unknowns"
    assert "y at node 3 of body 0" in failure.detail


def test_gradient_by_shared_unknowns_that_is_lost(prepared, damaged):
    """The equations of motion of the last interval act on where a craft ends."""
    context = prepared("hovercraft")
    loop = re.search(
        r"( +)for i in range\(END_SHARED\.size\):\n +g\[linking\(body, END_SHARED\[i\], size\)\] \+=.*",
        text_from(context, "gradient_loop"),
    )
    found = failures("assembly", damaged(context, loop[0], loop[0].replace("+=", "-=")))
    assert found[0].subject == "gradient of the Lagrangian"
    assert re.search(r"by coupled_[xy] of body \d differs", found[0].detail)


def test_curvature_by_a_free_duration(prepared, damaged):
    context = prepared("double_integrator")
    line = line_with(context, "d2l/dT df_k", "interval_hessian")
    (failure,) = failures("derivatives", damaged(context, line, negated(line)))
    assert failure.subject == "interval_hessian"
    assert "d2l/dT df_k" in failure.detail


# ---- Ends ----


@pytest.mark.slow
def test_terminal_cost(prepared, damaged):
    context = prepared("low_thrust")
    line = re.search(r"    return .*", text_from(context, "end_gradient"))[0]
    (failure,) = failures("derivatives", damaged(context, line, f"{line}*1.001"))
    assert failure.subject == "end_gradient"
    assert "cost at the end differs" in failure.detail


@pytest.mark.slow
def test_condition_at_the_end(prepared, damaged):
    context = prepared("low_thrust")
    text = text_from(context, "end_hessian")
    line = re.search(r"^    hessian\[\d+\] = .*  # nu_1_k1, .*$", text, re.MULTILINE)[0]
    (failure,) = failures("derivatives", damaged(context, line, negated(line)))
    assert failure.subject == "end_hessian"
    assert "by nu_1_k1, " in failure.detail


def test_value_at_the_end(prepared, damaged):
    context = prepared("linear_pendulum")
    failure, *_ = failures("given values", damaged(context, '"end q": 0.4', '"end q": 0.5'))
    assert failure.subject == "boundary values"
    assert "end q of body 0 is" in failure.detail
    failure, *_ = failures("given values", damaged(context, "nodes[:, -1, 0] = end_q", "nodes[:, -1, 0] = start_q"))
    assert failure.subject == "pinned unknowns"
    assert "q at node 3 is given" in failure.detail


def test_value_of_one_body(prepared, damaged):
    context = prepared("hovercraft")
    line = re.search(r'        "start x": .*,', text_from(context, "make_grid"))[0]
    failure, *_ = failures("given values", damaged(context, line, line.replace("body", "(body + (body == 2))")))
    assert failure.subject == "boundary values"
    assert "start x of body 2 is 4" in failure.detail


# ---- Bounds ----


@pytest.mark.parametrize(
    ("problem", "group", "unknown"),
    [
        ("low_thrust", "lower_intervals", "s_1 on interval 0"),
        ("double_integrator", "upper_intervals", "f on interval 0"),
        ("double_integrator", "lower_common", "T"),
    ],
)
def test_bounds(prepared, damaged, problem, group, unknown):
    context = prepared(problem)
    line = re.search(rf"^    {group}\[.*\] = (.*)  # .*$", text_from(context, "variable_bounds"), re.MULTILINE)
    (failure,) = failures("given values", damaged(context, line[0], line[0].replace(line[1], f"{line[1]} - 1")))
    assert failure.subject == "bounds"
    assert f"the {group.partition('_')[0]} bound of {unknown} is" in failure.detail


def test_bound_that_is_left_out(prepared, damaged):
    context = prepared("double_integrator")
    line = re.search(r"^    upper_intervals\[.*$", text_from(context, "variable_bounds"), re.MULTILINE)[0]
    (failure,) = failures("given values", damaged(context, line, "    pass"))
    assert "the upper bound of f on interval 0 is inf, expected 1" in failure.detail


@pytest.mark.parametrize("table", ["SLACKS", "SLACK_MULTIPLIERS"])
def test_tables_of_slacks(prepared, damaged, table):
    context = prepared("low_thrust")
    (index,) = map(int, getattr(context.module, table))
    damage = damaged(context, f"{table} = np.array([{index}]", f"{table} = np.array([{index - 1}]")
    (failure,) = failures("layout", damage)
    assert f"{table} is [{index - 1}], expected [{index}]" in failure.detail


# ---- The linear system ----


def test_elimination(prepared, monkeypatch):
    """The elimination is common to all modules."""
    own = assembly.solve_kkt

    def solve(grid, system, gradient, step):
        own(grid, system, gradient, step)
        step[2] *= 1.0 + 1e-6

    monkeypatch.setattr(assembly, "solve_kkt", solve)
    (failure,) = failures("assembly", prepared("linear_pendulum"))
    assert failure.subject == "Newton step"
    assert "it leaves the row of" in failure.detail
