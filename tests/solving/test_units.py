"""Problems in other units have the same solution, and a reported cost is corrected by what residuals are worth."""

from __future__ import annotations

import numpy as np
import pytest
from gallery_units import GALLERY, UNITS, cost_factor, text_in_units
from interpreted import without_compilation

from codegen.runtime.search import point, solve
from codegen.runtime.search.scaling import digits_of, quantities_of, rounded, scaled_grid

OTHER_UNITS = [
    ("low_thrust", {"length_unit": 1e-6}),
    ("low_thrust", {"length_unit": 1e6}),
    ("low_thrust", {"time_unit": 1e-6}),
    ("hypersensitive", {"length_unit": 1e6}),
    ("acrobot", {"time_unit": 1e6}),
    ("cart_pendulum", {"mass_unit": 1e6}),
]


@pytest.mark.parametrize("name", ["orbital_transfer", "double_integrator", "linear_pendulum"])
def test_other_units_have_the_same_solution(name):
    module, steps = without_compilation(text_in_units(name)), GALLERY[name].steps
    own = module.solve(steps)
    assert own.status == "solved", own.message
    for unit in UNITS:
        for factor in (1e-6, 1e6):
            solution = module.solve(steps, **{unit: factor})
            assert solution.status == "solved", (unit, factor, solution.message)
            assert solution.cost == pytest.approx(own.cost * cost_factor(name, **{unit: factor}), rel=1e-8)
            assert solution.iterations <= 1.5 * own.iterations


@pytest.mark.parametrize(("name", "units"), OTHER_UNITS)
def test_solutions_are_found_as_quickly_in_other_units(name, units):
    """Sizes change by the units' factors, and nothing else but for rounding."""
    module, steps = without_compilation(text_in_units(name)), GALLERY[name].steps
    own, other = module.solve(steps), module.solve(steps, **units)
    assert (own.status, other.status) == ("solved", "solved"), other.message
    assert other.cost == pytest.approx(own.cost * cost_factor(name, **units), rel=1e-8)
    assert other.iterations <= 1.5 * own.iterations


@pytest.mark.parametrize("name", ["cart_pole", "brachistochrone", "quadrotor"])
def test_ordinary_numbers_stay_what_they_are(interpreted, name):
    module = interpreted(name)
    grid = module.make_grid(10)
    assert scaled_grid(grid, module.initial_guess(grid)).sizes.size == 0


def test_the_weight_of_a_cost_does_not_depend_on_the_number_of_intervals(interpreted):
    """An integral's share of one interval does: it is the smaller the more there are."""
    module = interpreted("quadrotor")
    weights = []
    for steps in (4, 400):
        grid = module.make_grid(steps, g=9.81e4)
        weights.append(scaled_grid(grid, module.initial_guess(grid)).weight)
    assert weights[0] == weights[1] != 1.0


def test_sizes_are_rounded_as_a_whole(interpreted):
    """To powers of a million where that makes all ordinary numbers, to powers of a thousand where it does not."""
    module = interpreted("brachistochrone")
    quantities = quantities_of(module.problem)
    size = np.where(np.arange(quantities.stated.size) % 2, 0.04, 700.0)
    for unit in (1e-6, 1.0, 1e6, 1e12):
        for digits, thousand in ((6.0, 1.0), (3.0, 1e3)):
            assert digits_of(quantities, unit * size) == digits
            assert rounded(unit * 0.04, digits, False) == pytest.approx(unit)
            assert rounded(unit * 700.0, digits, False) == pytest.approx(unit * thousand)
            size[0] = 2e3
        for value, expected in ((0.08, 1.0), (24.0, 1.0), (40.0, 100.0), (2e3, 100.0), (4e3, 1e4)):
            assert rounded(unit * value, 3.0, True) == pytest.approx(unit * expected)
        size[0] = 700.0
    assert rounded(0.0, 3.0, True) == rounded(np.inf, 6.0, False) == 1.0


def test_iterates_are_logged_in_the_problem_s_own_units():
    module, rows = without_compilation(text_in_units("brachistochrone")), {}
    for unit in (1.0, 1e6):
        watched = rows.setdefault(unit, [])
        module.solve(10, length_unit=unit, time_unit=unit, watch=lambda _, row, kept=watched: kept.append(row))
    for own, other in zip(rows[1.0][:10], rows[1e6][:10], strict=True):  # rounding decides which of the last is enough
        assert other[0] == pytest.approx(1e6 * own[0], rel=1e-6)
        assert other[4:] == pytest.approx(own[4:])


@pytest.mark.parametrize("failure", ["stalled", "unbounded"])
def test_where_factors_do_not_help_the_problem_s_own_units_are_tried(failure, monkeypatch):
    module = without_compilation(text_in_units("brachistochrone"))
    minimise = solve.minimise

    def fails_when_scaled(grid, unknowns, *arguments):
        if grid.sizes.size:
            return failure, module.evaluate(grid, unknowns), 3
        return minimise(grid, unknowns, *arguments)

    monkeypatch.setattr(solve, "minimise", fails_when_scaled)
    solution = module.solve(10, length_unit=100.0)
    assert solution.status == "solved"
    assert solution.iterations > 3
    assert not solution.scaled.sizes.size  # the result is judged in the units in which the search has succeeded


@pytest.mark.parametrize("arguments", [{"tolerance": 0.0}, {"tolerance": "tight"}, {"max_iterations": 0}])
def test_arguments_that_end_no_search_are_refused(interpreted, arguments):
    (name,) = arguments
    with pytest.raises(ValueError, match=f"^{name} is "):
        interpreted("brachistochrone").solve(10, **arguments)


def test_cost_is_right_to_second_order_in_the_residual(interpreted):
    """Even with a loose tolerance, which leaves an error in the discrete cost."""
    module = interpreted("orbital_transfer")
    right = 0.0487567009  # by CasADi and IPOPT, N = 50
    rough = module.solve(50, tolerance=1e-2)
    grid = module.make_grid(50)
    assert rough.cost == pytest.approx(right, abs=1e-9)
    assert abs(rough.cost - right) < abs(point.cost(grid, rough.unknowns) - right)


def test_what_a_message_says_of_the_equations_is_in_the_problem_s_own_units():
    module = without_compilation(text_in_units("brachistochrone"))
    solution = module.solve(10, length_unit=1e6, time_unit=1e6)
    assert solution.status == "solved"
    assert solution.residual > 1e-12
    assert float(solution.message.split()[-1]) >= 0.95 * solution.residual


def test_a_search_begins_once(interpreted):
    """Where a coordinate, the joint's height, is held at zero."""
    module = interpreted("cart_pendulum", arguments={"form": "holonomic"}, scheme="trapezoidal")
    solution = module.solve(20)
    assert solution.status == "solved", solution.message
    assert np.abs(solution.q[:, 1]).max() < 1e-14
    assert solution.scaled.sizes.size > 0
    assert all(row[4] > 0.0 for row in solution.log[1:]), "a search began anew"
    assert solution.cost == pytest.approx(148.0813, rel=1e-6)  # IPOPT 3.14, which relaxes bounds: 148.0813028


@pytest.mark.parametrize("name", ["bouncing_ball", "two_stage_rocket"])
def test_scaling_factors_and_iterates_do_not_depend_on_what_memory_held(interpreted, monkeypatch, name):
    """Durations and conditions between phases have second derivatives that no loop fills."""
    module, empty = interpreted(name), np.empty
    own = [module.solve()]  # compiled code is loaded before functions of numpy are exchanged

    def filled_with(value):
        def allocated(*arguments, **named):
            array = empty(*arguments, **named)
            array.fill(value)
            return array

        return allocated

    for value in (0, 10**30):
        with monkeypatch.context() as patch:
            patch.setattr(np, "empty", filled_with(value))
            own.append(module.solve())
    assert own[0].status == "solved"
    for other in own[1:]:
        np.testing.assert_array_equal(other.log, own[0].log)
