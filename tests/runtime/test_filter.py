"""The filter of the line search: which trials it takes, what it keeps and when it forgets."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.runtime.search import descent, workspace


class Filter:
    """A filter whose first pair is the largest violation that is allowed."""

    def __init__(self, largest: float) -> None:
        self.storage, self.integers = np.empty((100, 2)), np.zeros(workspace.INTEGERS, np.int64)
        self.storage[0], self.integers[workspace.PAIRS] = (largest, -np.inf), 1

    @property
    def pairs(self) -> list[tuple[float, float]]:
        return [tuple(pair) for pair in self.storage[1 : self.integers[workspace.PAIRS]]]

    def add(self, violation: float, objective: float) -> None:
        self.storage[self.integers[workspace.PAIRS]] = violation, objective
        self.integers[workspace.PAIRS] += 1

    def lets_pass(self, violation: float, objective: float) -> bool:
        return descent.lets_pass.py_func(self.storage, self.integers[workspace.PAIRS], violation, objective)

    def accepts(self, *trial: float) -> bool:
        """Violation and objective, the same of the trial, slope, length, and the violation that is small."""
        return descent.accepts.py_func(self.storage, self.integers, *trial)


def envelope(violation: float, objective: float) -> tuple[float, float]:
    """(18) with the constants of Waechter and Biegler."""
    return pytest.approx(((1.0 - 1e-5) * violation, objective - 1e-8 * violation), rel=1e-15)


def test_filter() -> None:
    kept = Filter(10.0)
    kept.add(2.0, 4.0)
    assert kept.lets_pass(1.0, 5.0)
    assert kept.lets_pass(3.0, 3.0)
    assert not kept.lets_pass(2.0, 4.0)
    assert not kept.lets_pass(10.0, 3.0)
    kept = Filter(10.0)
    assert not kept.accepts(1.0, 2.0, 1.0, 2.0, -1.0, 1.0, 1e-4)
    assert kept.accepts(1.0, 2.0, 0.5, 9.0, -1.0, 1.0, 1e-4)
    assert kept.pairs == [envelope(1.0, 2.0)]
    # nearly feasible, the cost must fall as the slope promises, and the filter does not grow
    assert not kept.accepts(0.0, 2.0, 0.0, 2.1, -1.0, 1.0, 1e-4)
    assert kept.accepts(0.0, 0.0, 0.0, -0.5, -1.0, 0.5, 1e-4)
    assert len(kept.pairs) == 1


def test_pairs_that_a_new_one_makes_superfluous_go() -> None:
    pairs = np.empty((10, 2))
    pairs[:4] = [(10.0, -np.inf), (5.0, 1.0), (1.0, 7.0), (4.0, 2.0)]
    assert descent.add_pair.py_func(pairs, 4, 3.0, 0.5) == 3
    assert pairs[0].tolist() == [10.0, -np.inf]
    assert pairs[1].tolist() == [1.0, 7.0]
    assert tuple(pairs[2]) == envelope(3.0, 0.5)


def test_a_cost_that_fell_as_promised_leaves_no_pair_behind() -> None:
    """However far from feasible (step A-7): the pair would bar the way back to the equations."""
    kept = Filter(1e4)
    assert kept.accepts(1.3, -140.0, 435.0, -142.4, -3.8, 0.8, 1e-4)
    assert kept.pairs == []


def test_a_filter_that_alone_shortens_five_steps_in_turn_is_emptied() -> None:
    kept = Filter(1e4)
    kept.add(1.0, 0.0)
    for i in range(descent.MISLED):
        assert (1.0, 0.0) in kept.pairs
        violation = 100.0 - i
        assert not kept.accepts(violation, -1.0, violation - 0.5, 1.0, 1.0, 1.0, 1e-4)  # better, but for the pair
        assert kept.accepts(violation, -1.0, violation - 0.1, -1.0, 1.0, 0.5, 1e-4)
    assert kept.pairs == [envelope(violation, -1.0)]
