"""Drivers on optimal-control problems: they agree with each other, and none is believed without evidence."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from codegen.errors import ArgumentError, NumericsError
from codegen.runtime.search.nlp import NonlinearProgram
from codegen.solving import api, drivers
from codegen.solving.drivers import quiet
from codegen.solving.drivers.newton import control as newton
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.drivers.shared import ScaledProblem
from codegen.solving.results.control import control_result
from codegen.solving.results.result import STATUSES, Run

MISSING = () if find_spec("cyipopt") else ("ipopt",)  # an extra
CONTROL_DRIVERS = [n for n, driver in drivers.DRIVERS.items() if "control" in driver.tasks and n not in MISSING]
# From an independent program (CasADi with IPOPT on the same discretisation).
COST_50 = 0.0487567009


@pytest.fixture(scope="module")
def reference(orbital_transfer):
    return {steps: api.solve(orbital_transfer, steps=steps) for steps in (20, 50)}


@pytest.mark.parametrize("steps", [20, 50])
@pytest.mark.parametrize("name", CONTROL_DRIVERS)
def test_drivers_agree_from_the_linear_guess(orbital_transfer, reference, name, steps):
    result = api.solve(orbital_transfer, name, steps=steps)
    assert result.status == "solved"
    assert result.cost == pytest.approx(reference[steps].cost, abs=1e-9)
    assert result.residual <= 1e-9
    np.testing.assert_allclose(result.q, reference[steps].q, atol=1e-4)
    np.testing.assert_allclose(result.u, reference[steps].u, atol=1e-6)


@pytest.mark.parametrize("name", CONTROL_DRIVERS)
def test_cost_is_that_of_an_independent_program(orbital_transfer, name):
    assert api.solve(orbital_transfer, name, steps=50).cost == pytest.approx(COST_50, abs=1e-9)


@pytest.mark.parametrize("name", CONTROL_DRIVERS)
def test_multipliers_are_those_of_the_unscaled_problem(orbital_transfer, reference, name):
    result = api.solve(orbital_transfer, name, steps=20)
    expected = reference[20].multipliers
    np.testing.assert_allclose(result.multipliers, expected, atol=1e-4 * np.abs(expected).max())
    assert result.stationarity < 1e-5


@pytest.mark.parametrize("name", CONTROL_DRIVERS)
def test_shapes_and_summary(orbital_transfer, name):
    result = api.solve(orbital_transfer, name, steps=20)
    assert result.t.shape == (21,)
    assert result.q.shape == result.p.shape == result.multipliers.shape == (21, 2)
    assert result.u.shape == (20, 1)
    # A Hohmann-like arc: half a period of each circle for one revolution.
    assert result.summary["duration"] == pytest.approx(np.pi * (np.sqrt(125) + np.sqrt(216)) / np.sqrt(0.40038))
    assert result.summary["final_state_miss"] < 1e-9
    assert result.summary["largest_control"] == np.abs(result.u).max()


def test_best_of_repeated_runs_is_timed(orbital_transfer):
    result = api.solve(orbital_transfer, steps=20, repeat=3)
    assert 0.0 < result.seconds_solve < 1.0


class TestFalseClaims:
    """A driver that says "solved" must have solved the equations of the module."""

    @pytest.fixture
    def attempt(self, orbital_transfer):
        return newton(orbital_transfer, Run(20))

    def assess(self, module, attempt, unknowns):
        return control_result(module, "newton", Run(20), replace(attempt, unknowns=unknowns))

    def test_truth_is_accepted(self, orbital_transfer, attempt):
        assert self.assess(orbital_transfer, attempt, attempt.unknowns).status == "solved"

    @pytest.mark.parametrize("kind", ["primal_unknowns", "multiplier_unknowns"])
    def test_wrong_unknown(self, orbital_transfer, attempt, kind):
        grid = orbital_transfer.make_grid(20)
        unknowns = attempt.unknowns.copy()
        unknowns[getattr(orbital_transfer, kind)(grid)[7]] += 1e-5
        result = self.assess(orbital_transfer, attempt, unknowns)
        assert result.status == "inaccurate"
        assert "residual" in result.message

    def test_wrong_boundary_value(self, orbital_transfer, attempt):
        unknowns = attempt.unknowns.copy()
        unknowns[0] += 1e-3
        result = self.assess(orbital_transfer, attempt, unknowns)
        assert result.status == "inaccurate"
        assert result.residual >= 1e-3

    def test_not_a_number(self, orbital_transfer, attempt):
        unknowns = attempt.unknowns.copy()
        unknowns[25] = np.nan
        result = self.assess(orbital_transfer, attempt, unknowns)
        assert result.status == "inaccurate"
        assert result.residual == np.inf

    def test_failure_stays_failure(self, orbital_transfer, attempt):
        result = control_result(orbital_transfer, "newton", Run(20), replace(attempt, status="stalled"))
        assert result.status == "stalled"


def test_optimality_conditions_are_relative_to_large_multipliers(interpreted):
    """Multipliers of 470 on average make 4.7 times the tolerance of 1e-10, and ten times that is let pass."""
    module, request = interpreted("two_stage_rocket"), Run(5, scaling="none")
    attempt = newton(module, request)
    index = module.multiplier_unknowns(module.make_grid(5))[10]

    def with_multiplier_off_by(change):
        unknowns = attempt.unknowns.copy()
        unknowns[index] += change
        return control_result(module, "newton", request, replace(attempt, unknowns=unknowns))

    slope = with_multiplier_off_by(1.0).stationarity
    assert with_multiplier_off_by(0.0).status == "solved"
    assert with_multiplier_off_by(3e-9 / slope).status == "solved"
    assert with_multiplier_off_by(3e-8 / slope).status == "inaccurate"


@pytest.mark.parametrize("name", CONTROL_DRIVERS)
def test_infeasible_problem_is_not_solved(orbital_transfer, name):
    """One interval leaves the end conditions four equations in one control."""
    result = api.solve(orbital_transfer, name, steps=1)
    assert result.status in STATUSES
    assert result.status != "solved"


@pytest.mark.parametrize("name", ["slsqp", "fsolve"])
def test_dense_drivers_refuse_large_problems(orbital_transfer, name):
    with pytest.raises(ArgumentError, match="dense"):
        api.solve(orbital_transfer, name, steps=5000)


@pytest.mark.parametrize("name", ["slsqp", "trust-constr", "fsolve"])
def test_blas_runs_on_one_thread(orbital_transfer, name, monkeypatch):
    """Whatever it runs on elsewhere."""
    seen = set()

    def constraints(self, x, original=NonlinearProgram.constraints):
        seen.update(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return original(self, x)

    monkeypatch.setattr(NonlinearProgram, "constraints", constraints)
    with threadpool_limits(2, "blas"):
        assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {2}
        api.solve(orbital_transfer, name, steps=10)
    assert seen == {1}


def test_scaled_derivatives_against_differences(orbital_transfer):
    problem = ScaledProblem.on_grid(orbital_transfer, Run(5))
    generator = np.random.default_rng(1)
    start = problem.program.x0
    x = start + 0.1 * generator.standard_normal(start.size)
    nu = generator.standard_normal(problem.program.dual.size)
    step = 1e-6 * generator.standard_normal(x.size)

    def lagrangian(y):
        return problem.cost(y) + nu @ problem.constraints(y)

    assert lagrangian(x + step) - lagrangian(x - step) == pytest.approx(
        2 * problem.stationarity(x, nu) @ step, rel=1e-6
    )
    np.testing.assert_allclose(
        problem.constraints(x + step) - problem.constraints(x - step), 2 * problem.jacobian(x) @ step, atol=1e-12
    )
    np.testing.assert_allclose(
        problem.stationarity(x + step, nu) - problem.stationarity(x - step, nu),
        2 * problem.hessian(x, nu) @ step,
        atol=1e-12,
    )


def test_threads_that_use_scipy_at_once_leave_warnings_and_blas_as_they_were(monkeypatch):
    """Whichever thread ends first."""
    limits = [4]

    class Libraries:
        @contextmanager
        def limit(self, limits: int, threads=limits):
            before, threads[0] = threads[0], limits
            yield
            threads[0] = before

    monkeypatch.setattr(quiet, "_blas", Libraries)
    filters = list(warnings.filters)
    first, second = quiet_single_thread(), quiet_single_thread()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert (limits, warnings.filters[0][0]) == ([1], "ignore")
    second.__exit__(None, None, None)
    assert (limits, warnings.filters) == ([4], filters)


def test_unknown_driver_is_refused(orbital_transfer):
    with pytest.raises(ArgumentError, match="did you mean trust-constr"):
        api.solve(orbital_transfer, "trust-const")


@pytest.mark.parametrize("option", ["steps", "repeat", "every"])
@pytest.mark.parametrize("value", [0, -3, 2.5, True])
def test_counts_are_checked(orbital_transfer, option, value):
    with pytest.raises(NumericsError, match=option):
        api.solve(orbital_transfer, **{option: value})


@pytest.mark.parametrize("driver", ["newton", "slsqp", "trust-constr"])
def test_iterations_can_be_limited(interpreted, driver):
    module = interpreted("brachistochrone")
    result = api.solve(module, driver, steps=6, max_iterations=2)
    assert (result.status, result.iterations) == ("iteration limit", 2)


@pytest.mark.parametrize("name", ["slsqp", "trust-constr", "fsolve"])
def test_other_values_of_parameters_reach_every_driver(orbital_transfer, name):
    given = {"r1": 5.9}
    reference = api.solve(orbital_transfer, steps=10, parameters=given)
    result = api.solve(orbital_transfer, name, steps=10, parameters=given)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(reference.cost, rel=1e-8)
    assert reference.cost == pytest.approx(0.0411138940489, rel=1e-9)  # by SLSQP of version 0.2, to its tolerance
