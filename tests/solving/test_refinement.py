"""Warm starts from other grids, and mesh sequences with their estimate of the error."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import PROBLEMS

from codegen.errors import ArgumentError, NumericsError
from codegen.solving import api
from codegen.solving.arcs import order_of_optima
from codegen.solving.results import output
from codegen.solving.warm_start import fitting, read_start, source_steps, transferred


def test_error_estimate_against_the_closed_form(interpreted):
    module = interpreted("double_integrator_effort")
    result = api.solve(module, steps=10, doublings=2)
    steps = 40
    assert result.cost == pytest.approx(12 * steps**2 / (steps**2 - 1), rel=1e-10)
    error = result.cost - 12.0
    assert result.summary["cost_error_estimate"] == pytest.approx(error, rel=0.05)
    assert result.summary["cost_extrapolated"] == pytest.approx(12.0, abs=0.05 * error)
    assert result.summary["observed_order"] == pytest.approx(2.0, abs=0.1)


def test_warm_start_from_a_coarser_grid(interpreted):
    module = interpreted("brachistochrone")
    coarse, cold = api.solve(module, steps=10), api.solve(module, steps=20)
    warm = api.solve(module, steps=20, warm=coarse.unknowns)
    assert warm.status == "solved"
    assert warm.cost == pytest.approx(cold.cost, rel=1e-9)
    assert warm.iterations < cold.iterations
    assert api.solve(module, steps=20, warm=coarse).iterations == warm.iterations


def test_transfer_to_the_same_grid_changes_nothing(interpreted):
    module = interpreted("hovercraft", arguments={"craft": "3"})
    unknowns = module.initial_guess(module.make_grid(4))
    assert source_steps(module, unknowns) == 4
    np.testing.assert_allclose(transferred(module, unknowns, 4), unknowns, atol=1e-14)


def test_start_of_another_problem_is_refused(interpreted):
    with pytest.raises(NumericsError, match="fit no number of steps"):
        api.solve(interpreted("brachistochrone"), steps=10, warm=np.zeros(17))


def test_simulations_are_not_refined(interpreted):
    with pytest.raises(ArgumentError, match="optimisation"):
        api.solve(interpreted("pendulum"), doublings=1)


def test_costs_are_extrapolated_by_the_order_of_optima(interpreted):
    """With a control that is constant on intervals the cost is of order 2, also by Gauss' method of order 4."""
    module = interpreted("double_integrator_effort", scheme="gauss-4")
    result = api.solve(module, steps=4, doublings=2)
    assert module.metadata.order == 4
    assert order_of_optima(module) == 2
    assert result.summary["observed_order"] == pytest.approx(2.0, abs=0.1)
    assert abs(result.summary["cost_extrapolated"] - 12.0) < 0.02 * abs(result.cost - 12.0)


class TestSavedStarts:
    """What --warm reads: the file of another problem is refused by its names, or by its size."""

    @pytest.fixture
    def saved(self, interpreted, tmp_path):
        def save(name, **choices):
            result = api.solve(interpreted(name, **choices), steps=4)
            output.save(result, output.as_record(result, 0.0, 0.0), tmp_path / "saved.npz")
            return read_start(tmp_path / "saved.npz")

        return save

    def test_of_the_same_problem(self, interpreted, saved):
        start = saved("double_integrator_effort")
        assert (start.names, start.nodes) == ({"q": ("x",), "u": ("f",)}, 5)
        np.testing.assert_array_equal(fitting(start, interpreted("double_integrator_effort")), start.unknowns)

    def test_of_other_names(self, interpreted, saved):
        text = (PROBLEMS / "double_integrator_effort.py").read_text()
        other = interpreted("renamed", text.replace('control("f")', 'control("push")'))
        with pytest.raises(ArgumentError, match=r"saved.npz: its controls are f, those of the problem push"):
            fitting(saved("double_integrator_effort"), other)

    @pytest.mark.parametrize("scheme", ["gauss-4", "gauss-6", "lobatto-4"])
    def test_of_another_layout(self, interpreted, saved, scheme):
        start = saved("double_integrator_effort", scheme=scheme)
        with pytest.raises(
            ArgumentError, match=r"--warm .*saved.npz: its \d+ unknowns .*same method, scheme and controls"
        ):
            fitting(start, interpreted("double_integrator_effort"))

    def test_of_no_names_but_the_right_size(self, interpreted, saved, tmp_path):
        unknowns = saved("double_integrator_effort").unknowns
        np.savez(tmp_path / "own.npz", unknowns=unknowns)
        assert fitting(read_start(tmp_path / "own.npz"), interpreted("double_integrator_effort")).size == unknowns.size

    @pytest.mark.parametrize(
        ("arrays", "fragment"),
        [
            ({"q": np.zeros(3)}, "holds no unknowns"),
            ({"unknowns": np.array([0.0, np.nan])}, "no vector of finite numbers"),
            ({"unknowns": np.array(["text"])}, "no vector of finite numbers"),
        ],
    )
    def test_files_without_a_solution(self, tmp_path, arrays, fragment):
        np.savez(tmp_path / "own.npz", **arrays)
        with pytest.raises(ArgumentError, match=fragment):
            read_start(tmp_path / "own.npz")

    def test_a_damaged_file(self, saved, tmp_path):
        saved("double_integrator_effort")
        data = bytearray((tmp_path / "saved.npz").read_bytes())
        data[40:400] = bytes(360)
        (tmp_path / "broken.npz").write_bytes(data)
        with pytest.raises(ArgumentError, match=r"broken.npz"):
            read_start(tmp_path / "broken.npz")
