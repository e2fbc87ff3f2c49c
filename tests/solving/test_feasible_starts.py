"""Where a search lowers the cost beyond what any motion can do, one among motions that obey finds the optimum."""

from __future__ import annotations

import math

import numpy as np
import pytest
from interpreted import of_problem
from sympy import Eq, sqrt

from codegen import Control, canonical_pair, control, free_parameter, state, states

FASTEST = math.atan2(2, 3) + math.acos(28 / (8 * math.sqrt(13))) + math.pi + math.pi / 3
"""Arcs of u = -1, 1, -1 around (u, 0), the middle one half a turn: Pontryagin et al. (1962), section 5 of chapter I."""


def oscillator() -> Control:
    """An undamped oscillator that a bounded force brings to rest from (2, 2) as soon as it can."""
    x, v = states("x v")
    u = control("u")
    duration = free_parameter("T", 6)
    ends = {"start": {x: 2, v: 2}, "end": {x: 0, v: 0}}
    limits = {"path": [u <= 1, u >= -1], "steps": 60}
    return Control(dynamics={x: v, v: u - x}, terminal_cost=duration, duration=duration, **ends, **limits)


def test_a_duration_that_fell_too_far():
    """The first steps bring T to 0.3, from where all searches end at 3.7, in motions that nearly obey."""
    result = of_problem(oscillator()).solve()
    assert result.status == "solved"
    assert abs(result.cost - FASTEST) <= 6e-3  # switches lie inside intervals of 0.08
    assert result.iterations <= 300


@pytest.mark.parametrize("guessed", [5, 8])
def test_a_duration_whose_violation_has_a_minimum_of_its_own(guessed):
    """From (3, 0) all leads to T = 3.03, where the violation is least nearby; with the guessed T motions do obey."""
    q, p = canonical_pair("q", "p")
    u, duration = control("u"), free_parameter("T", guessed)
    problem = Control(
        hamiltonian=p**2 / 2 + q**2 / 2,
        force={q: u},
        terminal_cost=duration,
        duration=duration,
        start={q: 3, p: 0},
        end={q: 0, p: 0},
        bounds={u: (-1, 1)},
        steps=60,
    )
    result = of_problem(problem).solve()
    assert result.status == "solved"
    assert abs(result.cost - (math.acos(31 / 32) + math.pi + math.acos(1 / 8))) <= 6e-3


ROPE, ANGLE = 1.2, 1.02673829
"""Length of an arc whose chord is 1, and half its angle: sin(a) / a = 1 / 1.2."""
AREA = (ANGLE - math.sin(ANGLE) * math.cos(ANGLE)) * (ROPE / (2 * ANGLE)) ** 2


def test_a_guess_on_which_a_condition_does_not_depend():
    """The length of a straight rope does not change, to first order: its violation is stationary, and greatest."""
    y, u = state("y"), control("u")
    ends = {"start": {y: 0}, "end": {y: 0}, "duration": 1, "steps": 30}
    problem = Control(dynamics={y: u}, maximise=y, integral=[Eq(sqrt(1 + u**2), ROPE)], **ends)
    result = of_problem(problem).solve()
    assert result.status == "solved"
    assert abs(-result.cost - AREA) <= 0.01 * AREA
    assert result.iterations <= 25, "the first shift of the Hessian alone says how far the first step goes: not far"
    assert np.ptp(np.sign(result.u[:15])) == 0
