"""Random points of checks lie where a problem is, so that its expressions have values there."""

from __future__ import annotations

import pytest
import sympy
from sympy import exp, log

import codegen
from codegen import Control, control, states
from codegen.discretise.model.from_problem import normalise
from codegen.evidence.checks import base
from codegen.evidence.checks.base import own_ranges, range_of

r, v = states("r v")
u = control("u")


def probe(radius: float = 6378145.0) -> Control:
    """A probe with air drag, metres from the Earth's centre: at a radius of one its density is exp(886)."""
    drag = 1e-4 * exp(-(r - radius) / 7200) * v**2
    return Control(
        dynamics={r: v, v: -3.986e14 / r**2 + drag + u},
        cost=u**2,
        duration=60,
        start={r: radius + 1e5, v: 0},
        end={v: -500},
        guess={r: radius + 9e4, v: -100},
        steps=8,
    )


def test_every_row_is_measured_where_numbers_of_size_one_overflow(uncompiled, interpreting):
    found = codegen.compile(probe(), name="probe").check()
    assert found.passed, found.failed
    for check in ("layout", "derivatives", "sparsity", "assembly", "discrete equations"):
        assert [one for one in found if one.check == check and one.applies], check


def test_points_are_drawn_at_nodes_and_stages_where_the_quantity_is():
    model = normalise(probe())
    ranges = own_ranges(model)
    symbols = [sympy.Symbol(f"r{where}", real=True) for where in ("", "_k", "_k1", "_stage2")]
    value = sum((exp(-(s - 6378145) / 7200) for s in symbols), sympy.S.Zero)
    for point in base.random_points([value], symbols, model):
        assert all(6.3e6 < point[s] < 6.6e6 for s in symbols)
    assert range_of(sympy.Symbol("u_k", real=True), ranges) is None
    assert range_of(sympy.Symbol("lambda_r_k", real=True), ranges) is None


def test_ordinary_sizes_are_drawn_about_one_as_ever():
    small = Control(dynamics={r: v, v: u}, cost=u**2, duration=1, start={r: 0, v: 0}, end={r: 3, v: 0}, steps=8)
    assert own_ranges(normalise(small)) == {}


def test_expressions_without_values_anywhere_are_not_measured_and_not_failed(monkeypatch, uncompiled, interpreting):
    """A radius beyond what any of the ranges holds: no row is called wrong for want of a point."""
    monkeypatch.setattr(base, "_ATTEMPTS", 0)
    found = codegen.compile(probe(), name="probe").check()
    assert found.passed, found.failed
    reasons = [one for one in found if "no real value at random points" in one.detail]
    assert {one.check for one in reasons} >= {"layout", "derivatives", "sparsity", "discrete equations"}
    assert all(one.detail.startswith("not measured: ") and not one.applies for one in reasons)


def test_no_point_is_an_error_that_names_the_remedy():
    with pytest.raises(base.NoPointError, match="bounds or a guess"):
        base.random_points([log(-(r**2))], [r], normalise(probe()))
