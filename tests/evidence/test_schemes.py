"""What is claimed of schemes is proved for all of them, and a false claim is found."""

from __future__ import annotations

from dataclasses import replace

import pytest
import sympy

from codegen.discretise import schemes
from codegen.evidence import checks
from codegen.evidence.checks.one_step import area_factor, first_difference, momentum_change, residuals

ALL = [pytest.param(s, id=f"{method}-{s.name}") for method, table in schemes.METHODS.items() for s in table.values()]


@pytest.mark.parametrize(
    "scheme", [*ALL, schemes.find("alpha-1/2", "hamiltonian"), schemes.find("alpha-1/4", "hamiltonian")]
)
def test_claims(prepared, scheme):
    context = replace(prepared("orbital_transfer"), scheme=scheme)
    for name in ("consistency", "symplecticity", "discrete Noether"):
        assert [finding for finding in checks.apply(name, context) if not finding.passed] == []


@pytest.mark.parametrize(("name", "order"), [("midpoint", 1), ("midpoint", 3), ("trapezoidal", 1), ("rectangle", 2)])
def test_wrong_order(prepared, name, order):
    false = replace(schemes.find(name, "variational"), order=order)
    (finding,) = checks.apply("consistency", replace(prepared("linear_pendulum"), scheme=false))
    assert not finding.passed
    assert f"order {order} is claimed" in finding.detail


def test_leading_errors_of_adjoint_schemes_are_opposite():
    # Implicit Euler is the adjoint of explicit Euler, and of odd order, so their leading errors are opposite.
    agreement, difference = first_difference(schemes.find("explicit-euler", "hamiltonian"), 3)
    opposite = first_difference(schemes.find("implicit-euler", "hamiltonian"), 3)
    assert (agreement, opposite[0]) == (1, 1)
    assert difference == -opposite[1] != 0


@pytest.mark.parametrize("problem", ["pendulum", "orbital_transfer"])
@pytest.mark.parametrize("name", ["explicit-euler", "implicit-euler"])
def test_false_claim_of_symplecticity(prepared, problem, name):
    false = replace(schemes.find(name, "hamiltonian"), symplectic=True)
    (finding,) = checks.apply("symplecticity", replace(prepared(problem), scheme=false))
    assert not finding.passed


def test_symplecticity_that_is_not_claimed(prepared):
    modest = replace(schemes.find("midpoint", "hamiltonian"), symplectic=False)
    (finding,) = checks.apply("symplecticity", replace(prepared("pendulum"), scheme=modest))
    assert not finding.passed
    assert "flag it" in finding.detail


def test_false_claim_of_area_preservation(prepared, monkeypatch):
    false = replace(schemes.find("explicit-euler", "hamiltonian"), symplectic=True)
    monkeypatch.setitem(schemes.METHODS["hamiltonian"], "explicit-euler", false)
    failed = [f for f in checks.apply("area preservation", prepared("pendulum")) if not f.passed]
    assert [f.subject for f in failed] == ["explicit-euler (hamiltonian)"]


def test_areas_of_the_pendulum(prepared):
    # By hand: determinants of the linearised steps.
    model = prepared("pendulum").model
    h = sympy.Symbol("h", positive=True)
    before, after = sympy.symbols("q_k q_k1", real=True)
    expected = {
        "explicit-euler": 1 + h**2 * sympy.cos(before),
        "implicit-euler": 1 / (1 + h**2 * sympy.cos(after)),
        "symplectic-euler": 1,
    }
    for name, determinant in expected.items():
        assert sympy.simplify(area_factor(model, schemes.find(name, "hamiltonian")) - determinant) == 0


def test_midpoint_equivalence_fails_for_another_quadrature(prepared, monkeypatch):
    trapezoidal = schemes.METHODS["variational"]["trapezoidal"]
    monkeypatch.setitem(schemes.METHODS["variational"], "midpoint", trapezoidal)
    context = prepared("pendulum")
    assert any(sympy.simplify(left_over) != 0 for _, left_over in residuals(context.model))
    assert not all(finding.passed for finding in checks.apply("midpoint equivalence", context))


def test_momentum_of_a_coordinate_that_is_not_cyclic_changes(prepared):
    model = prepared("orbital_transfer").model
    for method in schemes.METHODS:
        assert sympy.simplify(momentum_change(model, schemes.find("midpoint", method), 0)) != 0


def test_noether_fails_where_a_scheme_breaks_the_symmetry(prepared, monkeypatch):
    from codegen.evidence.checks import one_step

    genuine = one_step.variational_interval

    def broken(*given):
        interval = genuine(*given)
        return replace(interval, lagrangian=interval.lagrangian + interval.q.left[1] ** 2)

    monkeypatch.setattr(one_step, "variational_interval", broken)
    (finding,) = checks.apply("discrete Noether", prepared("orbital_transfer"))
    assert not finding.passed
    assert "phi_k" in finding.detail
