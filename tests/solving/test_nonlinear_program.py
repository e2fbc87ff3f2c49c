"""The nonlinear program of a module: derivatives against differences, optima against scipy called by hand."""

from __future__ import annotations

import sys
from itertools import pairwise

import numpy as np
import pytest
from control_variants import ANTIPHASE
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import Bounds, NonlinearConstraint, minimize
from scipy.sparse import coo_array

from codegen.solving.drivers.ipopt import _Callbacks
from codegen.solving.drivers.quiet import quiet_single_thread

PENDULUM = 4.546929903  # an independent program, N = 10; 4.530760981 in the limit
PROGRAMS = {
    "linear_pendulum": {},
    "orbital_transfer": {},
    "cart_pole": {},  # bounds
    "hovercraft": {},  # bodies, and conditions between them
    "drone_gates": {},  # a path condition, with slacks; inner times
    "goddard_rocket": {},  # a free duration
    "antiphase": {"text": ANTIPHASE},  # end values that equal linking variables
    "two_stage_rocket": {},  # phases
}


@pytest.fixture(scope="module", params=PROGRAMS)
def program(request, interpreted):
    return interpreted(request.param, **PROGRAMS[request.param]).nlp(4)


def slope(function, x, direction):
    """The derivative along a direction, by differences that are extrapolated to the sixth order."""
    steps = 2e-3 / np.array([1.0, 2.0, 4.0])
    quotients = [(function(x + s * direction) - function(x - s * direction)) / (2.0 * s) for s in steps]
    once = [(4.0 * b - a) / 3.0 for a, b in pairwise(quotients)]
    return (16.0 * once[1] - once[0]) / 15.0


def agree(found, expected, scale):
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8 * max(1.0, np.abs(scale).max(initial=0.0)))


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1))
def test_derivatives_are_those_of_cost_and_constraints(program, seed):
    generator = np.random.default_rng(seed)
    x = program.x0 + 0.02 * np.maximum(1.0, np.abs(program.x0)) * generator.uniform(-1.0, 1.0, program.x0.size)
    direction = np.maximum(0.1, np.abs(x)) * generator.uniform(-1.0, 1.0, x.size) / np.sqrt(x.size)
    multipliers, weight = generator.standard_normal(program.dual.size), generator.uniform(0.5, 2.0)
    with np.errstate(all="ignore"):
        gradient, jacobian = program.gradient(x), program.jacobian(x)
        agree(gradient @ direction, slope(program.cost, x, direction), gradient)
        agree(jacobian @ direction, slope(program.constraints, x, direction), jacobian.data)
        hessian = program.hessian(x, multipliers, weight)

        def lagrangian_gradient(y):
            return weight * program.gradient(y) + program.jacobian(y).T @ multipliers

        agree(hessian @ direction, slope(lagrangian_gradient, x, direction), hessian.data)
        np.testing.assert_allclose(
            program.stationarity(x, multipliers), gradient + jacobian.T @ multipliers, rtol=1e-9, atol=1e-9
        )
        np.testing.assert_allclose((hessian - hessian.T).toarray(), 0.0, atol=1e-12 * max(1.0, abs(hessian.data).max()))


def test_patterns_are_the_same_everywhere(program):
    x = program.x0 + np.random.default_rng(0).normal(scale=1e-2, size=program.x0.size)
    multipliers = np.ones(program.dual.size)
    with np.errstate(all="ignore"):
        pairs = [
            (program.jacobian(x), program.jacobian(program.x0)),
            (program.hessian(x, multipliers, 0.5), program.hessian(program.x0)),
        ]
    for here, there in pairs:
        assert here.format == "csr"
        assert here.has_canonical_format
        np.testing.assert_array_equal(here.indices, there.indices)
        np.testing.assert_array_equal(here.indptr, there.indptr)


def test_unknowns_and_sizes(program):
    n, m = program.x0.size, program.dual.size
    assert len(program.names) == n
    lower, upper = program.bounds
    assert lower.shape == upper.shape == (n,)
    assert (lower <= upper).all()
    for bound in program.constraint_bounds:
        np.testing.assert_array_equal(bound, np.zeros(m))
    motion = program.unpack(program.x0, np.arange(m))
    assert len(motion.t) == len(motion.q) == program.grid.steps + 1
    np.testing.assert_array_equal(motion.unknowns[program.primal], program.x0)
    np.testing.assert_array_equal(motion.unknowns[program.dual], np.arange(m))
    completed = program.unknowns(program.x0)
    np.testing.assert_array_equal(completed[program.dual], 0.0)


def test_names_say_what_and_where(interpreted):
    assert interpreted("linear_pendulum").nlp(2).names[0].startswith("f on interval 0 (t = 0)")
    assert "the slack of thrust at 1/2 of interval 0 (t = 0)" in interpreted("drone_gates").nlp(4).names


def test_arguments_are_those_of_a_solve(interpreted):
    module = interpreted("orbital_transfer")
    solution = module.solve(6, r1=5.5)
    program = module.nlp(6, r1=5.5, guess=solution.unknowns)
    assert program.cost(program.x0) == pytest.approx(solution.cost, rel=1e-9)
    assert np.abs(program.constraints(program.x0)).max() < 1e-9
    with pytest.raises(ValueError, match="guess has shape"):
        module.nlp(6, guess=np.zeros(3))


def optimum(program, method, **options):
    """What scipy finds; constraints and bounds are passed as they are."""
    with quiet_single_thread():
        return minimize(
            program.cost, program.x0, jac=program.gradient, bounds=Bounds(*program.bounds), method=method,
            constraints=NonlinearConstraint(
                program.constraints, *program.constraint_bounds,
                jac=program.jacobian if method != "SLSQP" else lambda x: program.jacobian(x).toarray(),
                hess=lambda x, multipliers: program.hessian(x, multipliers, 0.0),
            ),
            **({} if method == "SLSQP" else {"hess": program.hessian}), options=options,
        )  # fmt: skip


@pytest.mark.parametrize("method", ["SLSQP", "trust-constr"])
def test_linear_pendulum_costs_what_an_independent_program_found(interpreted, method):
    program = interpreted("linear_pendulum").nlp(10)
    options = {"maxiter": 500} | ({"ftol": 1e-14} if method == "SLSQP" else {"gtol": 1e-10})
    assert optimum(program, method, **options).fun == pytest.approx(PENDULUM, abs=1e-8)


@pytest.mark.parametrize("name", ["orbital_transfer", "cart_pole", "hovercraft"])
def test_optima_are_those_of_the_generated_solver(interpreted, name):
    """From its solution with all unknowns changed by up to one percent, as there are other optima."""
    module = interpreted(name)
    solution = module.solve(8)
    assert solution.status == "solved"
    exact = module.nlp(8, guess=solution.unknowns)
    assert np.abs(exact.constraints(exact.x0)).max() < 1e-8
    noise = 1e-2 * np.maximum(0.1, np.abs(solution.unknowns))
    noise *= np.random.default_rng(1).uniform(-1.0, 1.0, noise.size)
    program = module.nlp(8, guess=solution.unknowns + noise)
    # SLSQP needs equations of comparable size, which those of the transfer are not.
    method, options = ("SLSQP", {"ftol": 1e-13}) if name != "orbital_transfer" else ("trust-constr", {"gtol": 1e-10})
    found = optimum(program, method, maxiter=500, **options)
    assert found.success, found.message
    assert found.fun == pytest.approx(solution.cost, rel=1e-7)
    np.testing.assert_allclose(program.unpack(found.x).q, solution.q, atol=1e-3 * np.abs(solution.q).max())


def test_sparse_matrices_need_scipy(interpreted, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    program = interpreted("linear_pendulum").nlp(2)
    assert np.isfinite(program.cost(program.x0))
    with pytest.raises(ImportError, match="need scipy: pip install scipy"):
        program.jacobian(program.x0)


def test_ipopt_is_told_the_lower_triangle_and_both_patterns(program):
    callbacks = _Callbacks(program)
    x, multipliers, n = program.x0, np.ones(program.dual.size), program.x0.size
    with np.errstate(all="ignore"):
        lower = coo_array(
            (callbacks.hessian(x, multipliers, 0.5), callbacks.hessianstructure()), shape=(n, n)
        ).toarray()
        whole = program.hessian(x, multipliers, 0.5).toarray()
        np.testing.assert_array_equal(lower, np.tril(whole))
        jacobian = coo_array((callbacks.jacobian(x), callbacks.jacobianstructure()), shape=(multipliers.size, n))
        np.testing.assert_array_equal(jacobian.toarray(), program.jacobian(x).toarray())
    assert callbacks.objective(x) == program.cost(x)
