"""The shifted plan: whole and broken numbers of intervals, beyond the end, and what only the ends have."""

from __future__ import annotations

import numpy as np
import pytest
from horizon_problems import carried, regulator

from codegen.mpc.interface import shift_by

STEPS = 8


@pytest.fixture(scope="module")
def of_states():
    """A module whose nodes have states alone."""
    return regulator()


@pytest.fixture(scope="module")
def with_ends():
    """A module of a Lagrangian, whose velocities only the ends have."""
    return carried()


def filled(module, grid, nodes, intervals):
    """Unknowns that are functions of the place, counted in intervals; those of intervals of the place of the middle."""
    unknowns = np.zeros(grid.is_multiplier.size)
    of_nodes, of_intervals = module.views(grid, unknowns)
    of_nodes[:] = nodes(np.arange(STEPS + 1.0))[:, None]
    of_intervals[:] = intervals(np.arange(STEPS) + 0.5)[:, None]
    return unknowns


@pytest.mark.parametrize("by", [0.25, 1.0, 1.5, 3.0, 8.0])
def test_what_is_linear_in_time_goes_on_as_it_was(of_states, by):
    grid = of_states.make_grid(STEPS)
    found = shift_by(of_states, grid, by)(filled(of_states, grid, lambda k: 3.0 - 2.0 * k, lambda k: 0.0 * k))
    nodes, _ = of_states.views(grid, found)
    np.testing.assert_allclose(nodes[0], np.repeat(3.0 - 2.0 * (np.arange(STEPS + 1.0) + by), nodes.shape[2]).reshape(
        nodes[0].shape
    ), atol=1e-12)  # fmt: skip


def test_inputs_move_by_one_interval_and_the_last_stays(of_states):
    grid = of_states.make_grid(STEPS)
    found = shift_by(of_states, grid, 1.0)(filled(of_states, grid, np.zeros_like, np.square))
    _, intervals = of_states.views(grid, found)
    expected = (np.minimum(np.arange(STEPS) + 1, STEPS - 1) + 0.5) ** 2
    np.testing.assert_array_equal(intervals[0, :, -1], expected)


def test_over_parts_of_two_intervals_inputs_are_their_mean(of_states):
    """What is constant on [k, k + 1] and on the next has, on [k + 1/4, k + 5/4], three quarters of one in the mean."""
    grid = of_states.make_grid(STEPS)
    found = shift_by(of_states, grid, 0.25)(filled(of_states, grid, np.zeros_like, lambda k: k - 0.5))
    _, intervals = of_states.views(grid, found)
    np.testing.assert_allclose(intervals[0, :-1, -1], 0.25 + np.arange(STEPS - 1), atol=1e-14)
    assert intervals[0, -1, -1] == STEPS - 1


def test_velocities_at_the_end_stay_there_and_are_zero_at_inner_nodes(with_ends):
    grid = with_ends.make_grid(STEPS)
    unknowns = np.zeros(grid.is_multiplier.size)
    nodes, _ = with_ends.views(grid, unknowns)
    only = list(with_ends.ONLY_AT_ENDS)
    assert only, "the problem is chosen for them"
    nodes[0, -1, only] = 7.0
    moved, _ = with_ends.views(grid, shift_by(with_ends, grid, 1.0)(unknowns))
    assert (moved[0, -1, only] == 7.0).all()
    assert (moved[0, 1:-1, only] == 0.0).all()


def test_a_shift_leaves_the_plan_as_it_was(of_states):
    grid = of_states.make_grid(STEPS)
    unknowns = filled(of_states, grid, np.sin, np.cos)
    before = unknowns.copy()
    shift_by(of_states, grid, 1.0)(unknowns)
    np.testing.assert_array_equal(unknowns, before)
