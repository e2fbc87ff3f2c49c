"""Sweeps over guesses: each is that of several guesses of a solve, and none begins from another's solution."""

from __future__ import annotations

import numpy as np
import pytest
from golden import ROOT
from interpreted import all_uncompiled

import codegen
from codegen.errors import ArgumentError, NumericsError

CART_POLE = ROOT / "problems" / "cart_pole.py"


@pytest.fixture(scope="module")
def swept():
    with all_uncompiled():
        return codegen.sweep(CART_POLE, {"T": [2.0, 3.0], "guess": [1, 2, 6]}, workers=1)


def test_guesses_are_those_of_a_solve_with_several(swept, uncompiled):
    alone = codegen.solve(CART_POLE, parameters={"T": 3.0}, guesses=6)
    costs = [float(line.rsplit("cost ", 1)[1]) for line in alone.attempts]
    np.testing.assert_allclose(swept.cost.sel(T=3.0), [costs[0], costs[1], costs[5]], rtol=1e-8)
    assert alone.cost == pytest.approx(float(swept.cost.sel(T=3.0).min("guess")), rel=1e-8)


def test_optima_of_different_guesses_are_no_jumps_and_stay_as_they_are(swept):
    assert "jump" not in swept
    assert len({f"{cost:.3f}" for cost in swept.cost.sel(T=3.0).values}) == 3


def test_more_time_costs_no_more_where_the_best_of_the_guesses_is_taken(swept):
    """The cart may wait at rest, so that the least cost cannot rise with the duration."""
    best = swept.cost.min("guess")
    assert float(best.sel(T=3.0)) <= float(best.sel(T=2.0))
    assert float(swept.cost.sel(T=3.0, guess=6)) > float(best.sel(T=2.0))


@pytest.mark.parametrize("values", [[0, 1], [1.5], [-2, 1]])
def test_numbers_of_guesses_are_positive_integers(values):
    with pytest.raises(NumericsError, match="guess has values that are no positive integers"):
        codegen.sweep(CART_POLE, {"guess": values})


def test_a_simulation_has_no_guesses():
    with pytest.raises(ArgumentError, match="guess is nothing that can be varied"):
        codegen.sweep(ROOT / "problems" / "pendulum.py", {"guess": [1, 2]})
