"""Explicit elimination: what is left to Newton's method, and what may never happen on the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sympy
from interpreted import without_compilation
from simulation_systems import SYSTEMS, chain, coupled, model_of, module_of, rough_plane, text_of

from codegen.discretise.elimination import eliminate
from codegen.discretise.interval import STEP
from codegen.discretise.transcribe import transcribe
from codegen.emit.differentiation import derivatives
from codegen.emit.lower import lower

NEWTON_UNKNOWNS = {
    #                                    pendulum  double pendulum  Kepler  coupled
    ("variational", "rectangle"): (0, 2, 0, 0),
    ("variational", "midpoint"): (1, 2, 2, 1),
    ("variational", "trapezoidal"): (0, 2, 1, 0),
    ("hamiltonian", "explicit-euler"): (0, 0, 0, 0),
    ("hamiltonian", "implicit-euler"): (1, 4, 1, 1),
    ("hamiltonian", "symplectic-euler"): (0, 2, 0, 0),
    ("hamiltonian", "symplectic-euler-adjoint"): (0, 2, 0, 0),
    ("hamiltonian", "midpoint"): (1, 4, 1, 2),
    ("hamiltonian", "stormer-verlet"): (0, 4, 0, 0),
}


@pytest.mark.parametrize(("method", "scheme"), NEWTON_UNKNOWNS)
def test_newton_keeps_only_what_cannot_be_solved(method: str, scheme: str) -> None:
    systems = ("pendulum-hamiltonian", "double-pendulum", "kepler", "coupled")
    left = tuple(len(module_of(s, method, scheme).metadata.unknowns) for s in systems)
    assert left == NEWTON_UNKNOWNS[method, scheme]
    assert len(module_of("pendulum-lagrangian", method, scheme).metadata.unknowns) == left[0]


@pytest.mark.parametrize(("method", "scheme"), [c for c, n in NEWTON_UNKNOWNS.items() if n[0] == 0])
def test_an_explicit_module_holds_no_newton_method(method: str, scheme: str) -> None:
    text = text_of(model_of("pendulum-hamiltonian"), scheme, method)
    for word in ("jacobian", "def factor", "predict_step", "step_newton"):
        assert word not in text


def left_out(name: str, method: str) -> set[str]:
    """What a module leaves out, before the reasons."""
    program = transcribe(model_of(name), "midpoint", method)
    return {entry.partition(":")[0] for entry in lower(program, derivatives(program)).metadata.left_out}


def test_a_module_knows_what_it_leaves_out() -> None:
    named = {"linear algebra", "r_k1, phi_k1, pphi_k1 among the unknowns", "derivatives of the Hamiltonian by phi"}
    assert left_out("kepler", "hamiltonian") >= named | {"forces", "time in the kernels"}
    assert "forces on b" in left_out("coupled", "variational")
    assert "time in the kernels" not in left_out("driven", "variational")


@pytest.mark.parametrize("scheme", ["rectangle", "midpoint", "trapezoidal"])
def test_elimination_never_divides_by_a_parameter_that_may_vanish(scheme: str) -> None:
    module = without_compilation(text_of(coupled(), scheme, "variational"))
    without = without_compilation(text_of(coupled(friction=0.0), scheme, "variational"))
    state = SYSTEMS["coupled"].state
    expected = without.step(without.make_grid(10), state)
    np.testing.assert_allclose(module.step(module.make_grid(10, c=0.0), state), expected, rtol=1e-15)
    assert np.all(np.isfinite(expected))


def test_elimination_of_a_triangular_system_in_any_order() -> None:
    x, y, z, a = sympy.symbols("x y z a", real=True)
    result = eliminate((x - sympy.sin(y) - z, y * a - 3, z - y**2 * sympy.cos(a)), (x, y, z), (a,))
    assert result.unknowns == ()
    assert dict(result.before) == {y: 3 / a, z: y**2 * sympy.cos(a), x: sympy.sin(y) + z}
    assert [symbol for symbol, _ in result.before] == [y, z, x]


def test_elimination_solves_linear_systems_with_zero_diagonal() -> None:
    x, y = sympy.symbols("x y", real=True)
    result = eliminate((y - 2, 3 * x + y - 8), (x, y), ())
    assert result.unknowns == ()
    values: dict[Any, Any] = {}
    for symbol, value in result.before:
        values[symbol] = value.subs(values)
    assert values == {x: 2, y: 2}


def test_elimination_trusts_no_coefficient_that_depends_on_the_state() -> None:
    x, y, q, c = sympy.symbols("x y q c", real=True)
    result = eliminate((q * x + y - 1, x - STEP * c * sympy.sin(y)), (x, y), (c,))
    assert len(result.unknowns) == 1
    ((symbol, value),) = result.after
    assert symbol == (x if y in result.unknowns else y)
    assert not sympy.denom(sympy.together(value)).has(q, c)


@pytest.mark.parametrize(("count", "solver"), [(3, "explicit"), (6, "constant")])
def test_linear_systems_take_no_iteration(count: int, solver: str) -> None:
    module = without_compilation(text_of(chain(count), "midpoint", "variational"))
    assert module.metadata.solver == solver
    solution = module.solve(50)
    assert solution.status == "solved"
    # The midpoint rule of a linear system is the Cayley transform of its matrix.
    weights = np.array([[i + j for j in range(count)] for i in range(count)], dtype=float)
    np.fill_diagonal(weights, 0.0)
    stiffness = 0.7 * (np.diag(weights.sum(axis=1)) - weights)
    masses = np.arange(1.0, count + 1.0)
    zero, half = np.zeros((count, count)), 0.1 / 2
    field_matrix = np.block([[zero, np.diag(1 / masses)], [-stiffness, zero]])
    unit = np.eye(2 * count)
    cayley = np.linalg.solve(unit - half * field_matrix, unit + half * field_matrix)
    state = np.concatenate([np.sin(np.arange(1.0, count + 1.0)), np.zeros(count)])
    expected = np.linalg.matrix_power(cayley, 50) @ state
    np.testing.assert_allclose([*solution.q[-1], *solution.p[-1]], expected, atol=1e-11)
    assert np.ptp(solution.energy) < 1e-11


def test_linear_equations_with_a_variable_matrix_take_one_solve() -> None:
    module = without_compilation(text_of(rough_plane(), "rectangle", "variational"))
    assert module.metadata.solver == "linear"
    assert module.metadata.unknowns == ("da_k", "db_k")
    solution = module.solve(100)
    assert solution.iterations == 100
    assert solution.residual < 1e-13


def test_an_unknown_in_denominators_that_cancel_is_solved_for_without_a_pole():
    y, a, c, d = sympy.symbols("y a c d")
    result = eliminate([c * (d + 1) / y - c * d / y - c / y + y - a], [y], [a, c, d])
    assert result.before == ((y, a),)
    assert not result.unknowns
