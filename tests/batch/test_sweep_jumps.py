"""Jumps of the cost: where they are seen, where not, and what is made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from codegen.batch.jumps import Grid, improved, jumps_of

X = np.linspace(-1.0, 1.0, 41)
SMOOTH = {
    "line": 3.0 * X,
    "constant": np.full(41, 7.0),
    "cubic": X**3 - 0.4 * X,
    "waves": np.sin(9.0 * X),
    "steep": np.exp(12.0 * X),
    "pole": 1.0 / (X + 1.02),
    "kink of two branches": np.minimum(2.0 + 3.0 * X, 2.1 - X),
    "rounding": 5.0 + 1e-9 * np.cos(1e4 * X),
}
TRIED = {"pole": [(0, 1)]}
"""What costs a solve though it is smooth: towards an end it grows faster than what follows says, as a jump would."""


@pytest.mark.parametrize("name", SMOOTH)
def test_where_a_cost_is_smooth_nothing_is_suspected(name):
    assert jumps_of(SMOOTH[name], [X]) == TRIED.get(name, [])
    assert jumps_of(SMOOTH[name], [X], certain=True) == []


END = [71.890, 60.431, 51.622, 45.172, 41.987, 44.636]
"""Costs of a cart with a pole over its duration, the last of which has a better optimum, 34.554."""


@pytest.mark.parametrize("places", [np.linspace(1.0, 2.0, 6), np.geomspace(1.0, 1.2, 6)])
def test_at_an_end_a_cost_off_what_the_others_say_is_tried_and_not_told(places):
    costs = np.array(END)
    assert jumps_of(costs, [places]) == [(5, 4)]
    assert jumps_of(costs[::-1], [places[::-1]]) == [(0, 1)]
    assert jumps_of(costs[1:], [places[1:]]) == [(4, 3)]
    assert jumps_of(costs, [places], certain=True) == []
    costs[-1] = 34.554  # what is better than expected may be so for its neighbour
    assert (4, 5) in jumps_of(costs, [places])


def test_before_a_failure_a_line_ends():
    costs = np.array([np.nan, *END, np.nan, 3.0, 2.0, 1.0])
    assert jumps_of(costs, [np.arange(11.0)]) == [(6, 5)]


def test_what_is_off_inside_does_not_make_the_end_suspect():
    costs = np.linspace(0.0, 1.0, 8)
    costs[2] += 1.0
    assert jumps_of(costs, [np.arange(8.0)]) == [(2, 1), (2, 3)]


def test_a_kink_of_curved_branches_is_suspected_but_not_certain():
    """As that of a cart with a pole over the length of its rod: the steepest step lies just before the kink."""
    steps = [1.7675, 4.9448, 7.1538, 3.4709, 3.844, 4.6248, 5.5675, 6.6417, 7.8209, 9.0834]
    costs = 30.0 + np.concatenate([[0.0], np.cumsum(steps)])
    assert jumps_of(costs, [np.linspace(0.0, 1.0, 11)]) == [(3, 2)]
    assert jumps_of(costs, [np.linspace(0.0, 1.0, 11)], certain=True) == []


@pytest.mark.parametrize("certain", [False, True])
@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("place", [5, 17, 35])
def test_from_a_jump_on_cases_are_worse_and_the_first_of_them_is_named(name, place, certain):
    smooth = SMOOTH[name]
    jump = 3.0 * np.abs(np.diff(smooth)[place - 2 : place + 1]).max() + 0.01
    later = np.arange(41) >= place
    found = jumps_of(smooth + jump * later, [X], certain)
    assert (place, place - 1) in found
    ends = set() if certain else {worse for worse, _ in TRIED.get(name, [])}
    assert {worse for worse, _ in found} == {place} | ends
    assert {worse for worse, _ in jumps_of(smooth + jump * ~later, [X], certain)} == {place - 1} | ends


def test_a_single_case_is_worse_than_both_neighbours():
    costs = X**2
    costs[20] += 1.0
    assert jumps_of(costs, [X]) == [(20, 19), (20, 21)]


def test_along_both_dimensions_of_a_grid_and_not_across_failures():
    y = np.linspace(0.0, 1.0, 6)
    costs = y[:, None] + X**2
    costs[2, 20] += 1.0
    cell = 2 * 41 + 20
    assert jumps_of(costs, [y, X]) == [(cell, cell - 41), (cell, cell - 1), (cell, cell + 1), (cell, cell + 41)]
    costs[2, 20] = np.nan
    assert jumps_of(costs, [y, X]) == []
    assert jumps_of(costs[:3], [np.zeros(0), X]) == []


@dataclass(frozen=True)
class Found:
    branch: int
    cost: float
    is_start: bool = True


def test_what_is_improved_goes_on_until_the_branches_cross():
    """Two branches that cross at 0; the better one is not found before 0.5, and follows its neighbour."""
    branches = np.array([2.0 + X, 2.0 - X])
    outcomes = [Found(int(x > 0.5), float(branches[int(x > 0.5), k])) for k, x in enumerate(X)]
    starts = []

    def attempt(place, solution):
        starts.append(place)
        return Found(solution.branch, float(branches[solution.branch, place]))

    tried = improved(outcomes, Grid((41,), (X,)), attempt)
    best = [min((outcomes[k], *tried.get(k, ())), key=lambda found: found.cost).cost for k in range(41)]
    np.testing.assert_allclose(best, 2.0 - np.abs(X))
    assert 9 <= len(starts) <= 11  # one solve for each that is improved


def test_what_finds_nothing_better_is_tried_once():
    outcomes = [Found(0, float(x**2 + (x > 0.5))) for x in X]
    starts = []

    def attempt(place, solution):
        starts.append(place)
        return outcomes[place]

    tried = improved(outcomes, Grid((41,), (X,)), attempt)
    assert starts == [31] or starts == [30]
    assert list(tried) == starts


@pytest.mark.parametrize("end", [0, 40])
def test_a_worse_case_at_an_end_is_tried_once_and_mended(end):
    """By as much as a cell's step, in either direction along the line."""
    better = np.exp(X) + X**2
    outcomes = [Found(int(k == end), float(cost) + 0.1 * (k == end)) for k, cost in enumerate(better)]
    starts = []

    def attempt(place, solution):
        starts.append((place, solution.branch))
        return Found(0, float(better[place]))

    tried = improved(outcomes, Grid((41,), (X,)), attempt)
    assert starts == [(end, 0)]
    assert [found.cost for found in tried[end]] == [better[end]]


def test_an_end_follows_what_it_has_improved():
    """A search from the end of a line leads to a branch that is better there as well, by too little to see."""
    costs = 1.0 + 0.1 * X**2
    outcomes = [Found(0, float(cost) + (k == 1)) for k, cost in enumerate(costs)]

    def attempt(place, solution):
        return Found(1, float(costs[place]) - 1e-5)

    tried = improved(outcomes, Grid((41,), (X,)), attempt)
    assert tried[0][-1].cost == costs[0] - 1e-5


def test_what_lies_behind_an_improved_case_is_tried_until_nothing_is_won():
    """The better branch is so near that no jump is seen behind the first case, and ends at 20."""
    costs = 1.0 + 0.1 * X**2
    outcomes = [Found(int(k > 30), float(cost) + (k == 30) - 1e-5 * (k > 30)) for k, cost in enumerate(costs)]

    def attempt(place, solution):
        return Found(solution.branch, float(costs[place]) - 1e-5 * (solution.branch == 1 and place > 20))

    tried = improved(outcomes, Grid((41,), (X,)), attempt)
    assert sorted(tried) == list(range(20, 32))
    assert all(min(found.cost for found in tried[k]) == costs[k] - 1e-5 for k in range(21, 31))
