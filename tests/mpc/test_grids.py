"""Grids that controllers keep from one sampling time to the next, against those that a module makes anew."""

import numpy as np
import pytest
from horizon_problems import STEPS, carried, regulator

import codegen
from codegen.errors import NumericsError
from codegen.mpc.interface import Grids, interface_of


def require_same(module, grid, **values):
    """Compare a grid with one that is made anew."""
    anew = module.make_grid(STEPS, **values)
    for name in ("steps", "h", "nodes", "parameters", "is_multiplier"):
        np.testing.assert_array_equal(getattr(grid, name), getattr(anew, name))
    if grid.bounds:
        np.testing.assert_array_equal(grid.bounds, module.variable_bounds(anew))


@pytest.mark.parametrize("make", [lambda: regulator(True), carried])
def test_where_the_state_alone_is_another_one_the_grid_is_that_of_the_state(make):
    module = make()
    interface = interface_of(module)
    grids = Grids(module, interface, STEPS)
    first, *others = (np.array(state) for state in ([1.0, 0.5], [-0.25, 3.0], [0.0, 0.0]))
    kept, search = grids.at({}, first), grids.search
    for state in others:
        assert grids.at({}, state) is kept
        assert grids.search is search
        require_same(module, kept, start=dict(zip(interface.states, state, strict=True)))
    require_same(module, grids.at({}))
    require_same(module, grids.at({}, first), start=dict(zip(interface.states, first, strict=True)))


def test_where_a_bound_moves_bounds_and_search_are_others():
    module = regulator(True)
    grids, state = Grids(module, interface_of(module), STEPS), np.array([1.0, 0.5])
    searches = []
    for values in ({"limit": 2.0}, {"limit": 2.0, "place": 1.0}, {"limit": 0.5, "place": 1.0}):
        require_same(module, grids.at(values, state), start={"x": 1.0, "v": 0.5}, **values)
        searches.append(grids.search)
        np.testing.assert_array_equal(grids.search.bounds[-2:], grids.at(values, state).bounds)
    assert searches[0].work is searches[1].work is not searches[2].work
    grids.at({"limit": -1.0}, state)
    assert grids.search is None  # bounds contradict each other, which a search of its own will say


def test_unusable_values_leave_the_last_grid_as_it_was():
    module = regulator(True)
    grids, state = Grids(module, interface_of(module), STEPS), np.array([1.0, 0.5])
    kept = grids.at({"limit": 2.0}, state)
    with pytest.raises(NumericsError, match="must be finite"):
        grids.at({"limit": np.inf}, state)
    assert grids.at({"limit": 2.0}, state) is kept


def test_inputs_obey_a_limit_that_moves_and_a_failure_is_over_with_its_reason():
    module = regulator(True)
    controller = codegen.Controller(module, parameters={"limit": lambda t: 100.0 if t < 0.5 else 0.5 - t})
    assert abs(controller.step([2.0, 0.0], 0.0)[0]) > 1.0
    controller.step([2.0, 0.0], 0.6)
    assert controller.last.status == "infeasible"
    inputs = controller.step([2.0, 0.0], 0.6, {"limit": 0.25})
    np.testing.assert_allclose(inputs, [-0.25], atol=1e-7)
    whole = module.solve(STEPS, start={"x": 2.0, "v": 0.0}, limit=0.25)
    np.testing.assert_allclose(controller.plan()[2], whole.u, atol=1e-6)
