"""Jumps of the cost among samples: where they are seen, where not, and what is made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import qmc

from codegen.batch.jumps import improved, scattered

SMOOTH = {
    "plane": lambda x: 1.0 + x @ np.arange(1.0, 1.0 + x.shape[1]),
    "constant": lambda x: np.full(len(x), 7.0),
    "bowl": lambda x: ((x - 0.2) ** 2).sum(axis=1),
    "saddle": lambda x: x[:, 0] * x[:, -1] - 0.4 * x[:, 0] ** 3,
    "hill": lambda x: 1.0 / (1.0 + 4.0 * (x**2).sum(axis=1)),
    "steep": lambda x: np.exp(6.0 * x.mean(axis=1)),
    "kink of two branches": lambda x: np.minimum(2.0 + 3.0 * x[:, 0], 2.1 - x[:, 0] + 0.3 * x[:, -1]),
    "rounding": lambda x: 5.0 + 1e-9 * np.cos(1e4 * x[:, 0]),
}
NUMBER = 300


def samples(quantities, seed=1, number=NUMBER):
    return 2.0 * qmc.LatinHypercube(quantities, rng=np.random.default_rng(seed)).random(number) - 1.0


def among(x, families=None, solved=None):
    """The neighbours among samples in (-1, 1)."""
    families = np.zeros(len(x), int) if families is None else families
    return scattered((x + 1.0) / 2.0, families, np.ones(len(x), bool) if solved is None else solved)


def beyond(x):
    """Those on one side of a plane."""
    return x[:, 0] + 0.5 * x[:, -1] > 0.3


def worse(pairs):
    return {case for case, _ in pairs}


@pytest.mark.parametrize("quantities", [1, 2, 3])
@pytest.mark.parametrize("name", SMOOTH)
def test_where_a_cost_is_smooth_hardly_anything_is_tried_and_nothing_told(name, quantities):
    x = samples(quantities)
    costs, neighbours = SMOOTH[name](x), among(x)
    tried = worse(neighbours.jumps(costs))
    # Of one quantity none is; of several the planes of cases at a kink go through both of its sides.
    assert len(tried) <= (0 if quantities == 1 else NUMBER // 10 if "kink" in name else NUMBER // 60)
    assert neighbours.jumps(costs, certain=True) == []


@pytest.mark.parametrize("quantities", [1, 2, 3])
@pytest.mark.parametrize("name", SMOOTH)
def test_a_jump_is_seen_and_its_worse_side_is_that_of_higher_costs(name, quantities):
    x = samples(quantities, number=1000)
    smooth, inside = SMOOTH[name](x), beyond(x)
    found = among(x).jumps(smooth + (0.3 * np.ptp(smooth) + 0.3) * inside)
    right = {case for case, other in found if inside[case] and not inside[other]}
    assert len(right) >= (1, 5, 20)[quantities - 1]
    assert len(worse(found) - right) <= len(right) / 3.0


def test_a_single_case_is_worse_than_its_neighbours():
    x = samples(2)
    costs = SMOOTH["bowl"](x)
    case = int(np.argmin((x**2).sum(axis=1)))
    costs[case] += 0.5
    assert worse(among(x).jumps(costs)) == {case}


def test_cases_that_are_not_solved_or_have_another_module_are_no_neighbours():
    x = samples(2)
    inside = beyond(x)
    costs = SMOOTH["bowl"](x) + inside
    assert worse(among(x).jumps(costs))
    assert among(x, families=inside.astype(int)).jumps(costs) == []
    costs[inside] = np.nan
    assert among(x, solved=~inside).jumps(costs) == []


def test_too_few_cases_and_none_that_vary_have_no_jumps():
    costs = np.array([1.0, 1.0, 9.0, 1.0, 1.0])
    assert among(samples(2, number=5)).jumps(costs) == []
    assert among(np.ones((5, 2))).jumps(costs) == []
    assert among(samples(1), solved=np.zeros(NUMBER, bool)).jumps(np.full(NUMBER, np.nan)) == []


def test_cases_that_are_there_several_times_and_quantities_that_vary_together():
    x = np.repeat(samples(1, number=60), 3, axis=0) * np.ones(2)
    costs = np.exp(x[:, 0])
    assert among(x).jumps(costs) == []
    inside = x[:, 0] > 0.3
    assert {bool(inside[case]) for case in worse(among(x).jumps(costs + inside))} == {True}


@dataclass(frozen=True)
class Found:
    branch: int
    cost: float
    is_start: bool = True


@pytest.mark.parametrize(("quantities", "least"), [(1, 1.0), (2, 0.9), (3, 0.7)])
def test_a_worse_branch_is_left_from_its_edge_on(quantities, least):
    """Two branches of a cost, the worse of which is found beyond a plane; starts follow their neighbour."""
    x = samples(quantities)
    inside, smooth = beyond(x), SMOOTH["bowl"](x)
    branches = np.array([smooth, smooth + 0.3 + 0.2 * x[:, 0]])
    outcomes = [Found(int(there), float(branches[int(there), k])) for k, there in enumerate(inside)]
    tried = []

    def attempt(place, solution):
        tried.append(place)
        return Found(solution.branch, float(branches[solution.branch, place]))

    found = improved(outcomes, among(x), attempt)
    won = {k for k, more in found.items() if min(one.cost for one in more) < outcomes[k].cost}
    assert won <= set(np.flatnonzero(inside))
    assert len(won) >= least * inside.sum()
    assert len(tried) <= 3 * inside.sum()
