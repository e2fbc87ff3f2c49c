"""Mistakes in equations, controls and boundary conditions are found and named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from sympy import Symbol

from codegen import checks

DRIFTING = '''"""A cart that is pushed along r drifts along phi without force."""

from codegen import Control, control, coordinates


def problem() -> Control:
    (r, phi), (dr, dphi) = coordinates("r phi")
    u = control("u")
    return Control(
        lagrangian=(dr**2 + dphi**2) / 2 - r**2,
        force={r: u},
        cost=u**2,
        duration=1,
        start={r: 0, dr: 0, phi: 0, dphi: 1},
        end={r: 1, dr: 0, END},
    )
'''


def failures(name, context):
    return [finding for finding in checks.apply(name, context) if not finding.passed]


@pytest.mark.parametrize("problem", ["linear_pendulum", "orbital_transfer"])
@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_sign_of_the_force(prepared, problem, method):
    context = prepared(problem, {}, method=method)
    opposite = replace(context.model, force=tuple(-f for f in context.model.force))
    (failure,) = failures("discrete equations", replace(context, model=opposite))
    assert "differs from the forced equation of motion" in failure.detail


def test_lost_minus_sign_of_the_discrete_momentum(prepared):
    # Thesis 2.4: p_k = D1 Ld instead of -D1 Ld.
    context = prepared("linear_pendulum")
    multiplier = Symbol("lambda_q_k", real=True)
    program = replace(context.program, element=context.program.element.xreplace({multiplier: -multiplier}))
    found = failures("momentum matching", replace(context, program=program))
    assert [failure.subject for failure in found] == ["node equation of q", "discrete momenta of q"]


def test_momenta_at_the_ends(prepared):
    context = prepared("orbital_transfer")
    faster = replace(context.model.end, rates=tuple(2 * v + 1 for v in context.model.end.rates))
    (failure,) = failures("momentum matching", replace(context, model=replace(context.model, end=faster)))
    assert failure.subject == "momenta at the end"


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_alternating_control_is_named(prepared, method):
    (failure,) = failures("null controls", prepared("linear_pendulum", {}, method=method, controls="nodal"))
    assert "alternating nodal control f" in failure.detail
    assert "undetermined" in failure.detail


def test_alternating_control_that_acts(prepared):
    (failure,) = failures("null controls", prepared("orbital_transfer", {}, controls="nodal"))
    assert "alternating nodal control u" in failure.detail
    assert "acts on the motion" in failure.detail


def test_nodal_controls_are_harmless_with_the_trapezoidal_rule(prepared):
    context = prepared("linear_pendulum", {}, scheme="trapezoidal", controls="nodal")
    assert failures("null controls", context) == []


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_redundant_boundary_condition(prepared, tmp_path: Path, method):
    path = tmp_path / "drifting.py"
    path.write_text(DRIFTING.replace("END", "phi: 1, dphi: 1"), encoding="utf-8")
    # The drift decides both the last place and the last velocity.
    first, second = failures("boundary rank", prepared(path, {}, method=method))
    for failure in (first, second):
        assert "redundant or unreachable" in failure.detail
        assert "phi" in failure.detail
        assert " dr" not in failure.detail.partition("(")[0]
    assert "end dphi" in first.detail + second.detail


def test_end_that_is_left_free(prepared, tmp_path: Path):
    path = tmp_path / "drifting.py"
    path.write_text(DRIFTING.replace(", END", ""), encoding="utf-8")
    assert failures("boundary rank", prepared(path)) == []


def test_convergence_at_a_wrong_order(prepared):
    context = prepared("linear_pendulum")
    (failure,) = failures("optimum", replace(context, scheme=replace(context.scheme, order=3)))
    assert "order 2.00, the scheme's is 3" in failure.detail


def test_convergence_to_the_published_optimum(prepared):
    # Thesis, section 3.2.
    (finding,) = checks.apply("optimum", prepared("linear_pendulum"))
    assert "J* = 4.53076098108 " in finding.detail
