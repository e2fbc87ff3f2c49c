"""Where IPOPT ends without a solution, the reason is said that it gives, not the equation that is off most."""

from __future__ import annotations

import itertools
from dataclasses import replace
from importlib.util import find_spec

import pytest
from sympy import log, sin, sqrt

import codegen
from codegen import Control, control, controls, state, states

pytestmark = [
    pytest.mark.skipif(find_spec("cyipopt") is None, reason="cyipopt is an extra"),
    pytest.mark.usefixtures("uncompiled"),
]

x, y = states("x y")
a, b = controls("a b")


def test_a_slope_that_is_not_finite_at_the_guess():
    """Of a thrust's magnitude at no thrust, with equations that are off as well."""
    fuel = Control(
        dynamics={x: a, y: b}, cost=sqrt(a**2 + b**2), duration=1, start={x: 0, y: 0}, end={x: 1, y: 100}, steps=4
    )
    result = codegen.solve(fuel, "ipopt", time_limit=30)
    assert result.status == "non-finite"
    assert "the derivative of the Lagrangian by a on interval 0" in result.message
    assert "nan (kernel interval_gradient) at the guess; change the guess" in result.message
    assert "is off by" not in result.message


def test_a_logarithm_of_nothing_at_the_guess():
    cake, c = state("W"), control("c")
    eaten = Control(dynamics={cake: -c}, maximise=log(c), duration=6, start={cake: 100}, end={cake: 0}, steps=4)
    assert codegen.solve(eaten, "ipopt", time_limit=30).status == "solved"  # from one, since there is none at zero
    result = codegen.solve(replace(eaten, guess={c: 0}), "ipopt", time_limit=30)
    assert result.status == "non-finite"
    assert "by c on interval 0 (t = 0) is -inf" in result.message
    assert "is off by" not in result.message


def test_fewer_unknowns_than_equations():
    """4 steps of x' = a with three values of x, and one of y, which no control moves, at both ends."""
    closed = Control(dynamics={x: y, y: -x}, duration=1, start={x: 1, y: 0}, end={x: 1, y: 0}, steps=4)
    result = codegen.solve(closed, "ipopt", time_limit=30)
    assert result.status == "rank-deficient"
    assert "fewer unknowns than equations, 6 unknowns for 8 equations" in result.message
    assert "is off by" not in result.message


def test_a_time_limit_is_one_of_the_clock(monkeypatch):
    """Which shows a minute more whenever it is read; a limit of the processor's time let IPOPT go on under a load."""
    clock = itertools.count(step=60.0)
    monkeypatch.setattr("codegen.solving.drivers.ipopt.perf_counter", lambda: next(clock))
    far = Control(dynamics={x: y, y: a - sin(x)}, cost=a**2, duration=3, start={x: 0, y: 0}, end={x: 3, y: 0}, steps=4)
    assert codegen.solve(far, "ipopt").status == "solved"
    result = codegen.solve(far, "ipopt", time_limit=150)
    assert (result.status, result.iterations) == ("time limit", 2)
    assert "raise time_limit" in result.message
