"""Warm starts from other grids, and mesh sequences with their estimate of the error."""

from __future__ import annotations

import numpy as np
import pytest

from codegen import drivers
from codegen.drivers.refinement import order_of_optima, source_steps, transferred
from codegen.errors import ArgumentError, NumericsError


def test_error_estimate_against_the_closed_form(interpreted):
    module = interpreted("double_integrator_effort")
    result = drivers.solve(module, steps=10, doublings=2)
    steps = 40
    assert result.cost == pytest.approx(12 * steps**2 / (steps**2 - 1), rel=1e-10)
    error = result.cost - 12.0
    assert result.summary["cost_error_estimate"] == pytest.approx(error, rel=0.05)
    assert result.summary["cost_extrapolated"] == pytest.approx(12.0, abs=0.05 * error)
    assert result.summary["observed_order"] == pytest.approx(2.0, abs=0.1)


def test_warm_start_from_a_coarser_grid(interpreted):
    module = interpreted("brachistochrone")
    coarse, cold = drivers.solve(module, steps=10), drivers.solve(module, steps=20)
    warm = drivers.solve(module, steps=20, warm=coarse.unknowns)
    assert warm.status == "solved"
    assert warm.cost == pytest.approx(cold.cost, rel=1e-9)
    assert warm.iterations < cold.iterations


def test_transfer_to_the_same_grid_changes_nothing(interpreted):
    module = interpreted("hovercraft", arguments={"craft": "3"})
    unknowns = module.initial_guess(module.make_grid(4))
    assert source_steps(module, unknowns) == 4
    np.testing.assert_allclose(transferred(module, unknowns, 4), unknowns, atol=1e-14)


def test_start_of_another_problem_is_refused(interpreted):
    with pytest.raises(NumericsError, match="fit no number of steps"):
        drivers.solve(interpreted("brachistochrone"), steps=10, warm=np.zeros(17))


def test_simulations_are_not_refined(pendulum):
    with pytest.raises(ArgumentError, match="optimisation"):
        drivers.solve(pendulum, doublings=1)


def test_costs_are_extrapolated_by_the_order_of_optima(interpreted):
    """With a control that is constant on intervals the cost is of order 2, also by Gauss' method of order 4."""
    module = interpreted("double_integrator_effort", scheme="gauss-4")
    result = drivers.solve(module, steps=4, doublings=2)
    assert module.metadata["order"] == 4
    assert order_of_optima(module) == 2
    assert result.summary["observed_order"] == pytest.approx(2.0, abs=0.1)
    assert abs(result.summary["cost_extrapolated"] - 12.0) < 0.02 * abs(result.cost - 12.0)
