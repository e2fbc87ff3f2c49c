"""Intervals of different lengths, against closed forms and against the answer on equal intervals."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.runtime.search import point


def graded(steps, ratio=6.0):
    """Fractions that grow steadily, the last `ratio` times as long as the first."""
    lengths = ratio ** np.linspace(0.0, 1.0, steps)
    return lengths / lengths.sum()


@pytest.fixture(scope="module")
def effort(interpreted):
    return interpreted("double_integrator_effort")


@pytest.fixture(scope="module")
def fastest(interpreted):
    return interpreted("double_integrator")


@pytest.fixture(scope="module")
def ball(interpreted):
    return interpreted("bouncing_ball")


@pytest.fixture(scope="module")
def layer(interpreted):
    return interpreted("hypersensitive")


@pytest.mark.parametrize("name", ["orbital_transfer", "effort", "fastest", "ball"])
def test_equal_fractions_are_the_equal_grid_bit_for_bit(name, request):
    module = request.getfixturevalue(name)
    default = module.solve(24)
    same = module.solve(grid=np.full(24, 1.0 / 24.0))
    assert np.array_equal(same.unknowns, default.unknowns)
    assert np.array_equal(same.t, default.t)
    assert same.iterations == default.iterations


def test_node_times_follow_the_fractions(orbital_transfer):
    fractions = graded(17)
    solution = orbital_transfer.solve(grid=fractions)
    assert solution.status == "solved"
    np.testing.assert_allclose(np.diff(solution.t) / solution.t[-1], fractions, rtol=1e-12)
    assert solution.u.shape == (17, 1)


def test_converges_at_order_two_on_graded_grids(effort):
    # x = 3 t^2 - 2 t^3 from rest to rest in unit time; the integral of u^2 is 12.
    errors, misses = [], []
    for steps in (20, 40, 80, 160):
        solution = effort.solve(grid=graded(steps))
        t = solution.t
        misses.append(np.abs(solution.q[:, 0] - (3.0 * t**2 - 2.0 * t**3)).max())
        errors.append(abs(solution.cost - 12.0))
    for found in (errors, misses):
        orders = np.log2(np.array(found[:-1]) / found[1:])
        assert (np.abs(orders - 2.0) < 0.1).all(), orders


def test_a_layer_needs_few_intervals_that_are_short(layer):
    # Closed form of the problem's file for a long time, with x(0) = 3/2 and x(T) = 1.
    exact = (np.sqrt(2.0) * (1.5**2 + 1.0) + 1.0 - 1.5**2) / 2.0
    half = np.geomspace(1e-6, 0.5, 60)
    nodes = np.concatenate([[0.0], half, 1.0 - half[-2::-1], [1.0]])
    short = layer.solve(grid=np.diff(nodes), duration=1e4)
    equal = layer.solve(short.t.size - 1, duration=1e4)
    assert abs(short.cost - exact) < 0.01
    assert abs(equal.cost - exact) > 0.05


def test_controls_condensed_on_intervals_of_all_lengths_are_stationary(orbital_transfer):
    grid = orbital_transfer.make_grid(grid=graded(30, 20.0))
    solution = orbital_transfer.solve(grid=graded(30, 20.0))
    assert solution.status == "solved"
    assert np.abs(point.stationarity(grid, solution.unknowns)).max() < 1e-9
    assert np.abs(point.constraints(grid, solution.unknowns)).max() < 1e-9


def test_minimum_time_with_the_switch_at_a_node_is_exact(fastest):
    # Unit mass over unit length: T = 2, switching at half time.
    first = graded(9) / 2.0
    solution = fastest.solve(grid=np.concatenate([first, first]))
    assert solution.status == "solved"
    assert solution.t[-1] == pytest.approx(2.0, abs=1e-7)


def test_every_phase_has_a_grid(ball):
    fractions = np.array([graded(20), graded(20)[::-1]])
    solution = ball.solve(grid=fractions)
    assert solution.status == "solved"
    lengths = np.diff(solution.t)
    np.testing.assert_allclose(lengths[:20] / lengths[:20].sum(), fractions[0], rtol=1e-11)
    np.testing.assert_allclose(lengths[20:] / lengths[20:].sum(), fractions[1], rtol=1e-11)
    assert solution.cost == pytest.approx(ball.solve(200).cost, rel=2e-3)


@pytest.mark.parametrize(
    ("fractions", "message"),
    [
        ([0.5, 0.6], "sum is one"),
        ([1.5, -0.5], "sum is one"),
        ([0.5, np.nan], "sum is one"),
        ([], "shape"),
        ([[0.5, 0.5], [0.5, 0.5]], "shape"),
    ],
)
def test_fractions_that_are_none_are_refused(effort, fractions, message):
    with pytest.raises(ValueError, match=message):
        effort.solve(grid=fractions)
