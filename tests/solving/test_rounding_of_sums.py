"""What is summed over all intervals may err by more than one rounding of its terms: beside exact fractions."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import sympy
from interpreted import text_of, without_compilation

from codegen import Control, control, states
from codegen.runtime.search import point
from codegen.solving.results.control import MANY_TERMS, _rounding_level

AREA = 0.1


@pytest.fixture(scope="module")
def module():
    """A mass that encloses an area with the axis of time."""
    (x, v), u = states("x v"), control("u")
    problem = Control(
        dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 0, v: 0}, integral=[sympy.Eq(x, AREA)]
    )
    return without_compilation(text_of(problem, scheme="midpoint"))


@pytest.mark.parametrize(("steps", "exceeds"), [(MANY_TERMS // 2, False), (5000, True)])
def test_excused_is_what_summation_errs_by(module, steps, exceeds):
    """The area is off by several roundings where many intervals are summed, and that is excused; little more is."""
    grid = module.make_grid(steps)
    guess = module.initial_guess(grid)
    unknowns = guess + np.random.default_rng(1).uniform(size=guess.size)
    nodes = module.unpack(grid, unknowns)[1][:, 0].tolist()
    exact = sum((Fraction(one) + Fraction(other)) / 2 for one, other in itertools.pairwise(nodes)) / steps
    row = module.multiplier_unknowns(grid)[-1]
    found = point.constraints(grid, unknowns)[-1]
    weights = np.zeros(unknowns.size)
    weights[row] = 1.0
    terms = float(np.finfo(float).eps * exact)
    error, excused = abs(found - float(exact - Fraction(AREA))), _rounding_level(module, grid, unknowns, weights)
    assert error <= excused <= 2.0 * np.sqrt(steps) * terms
    assert (error > terms) == exceeds
