"""Jumps of a Piecewise are told, and slopes that jump are none."""

from __future__ import annotations

import pytest
from made_records import control_record
from sympy import And, Piecewise, Symbol, exp

from codegen.discretise.model.values import jumps
from codegen.solving.results.output import notes

u, x, t, a = (Symbol(name, real=True) for name in ("u", "x", "t", "a"))


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (Piecewise((1, x < 1), (2, True)), ("x < 1",)),
        (u**2 + Piecewise((a, 2 * x + u <= 3), (0, True)), ("u + 2*x <= 3",)),
        (Piecewise((0, x < 0), (1, And(x < 2, u > 1)), (x, True)), ("x < 0", "u > 1", "x < 2")),
        (exp(Piecewise((0, x < 0), (x, True))), ()),
        (Piecewise((0, x < 1), ((x - 1) ** 2, True)), ()),
        (x * Piecewise((0, x < 0), (1, True)), ()),
        (Piecewise((0, t < 1), (1, True)), ()),
        (Piecewise((x, x < a), (a, True)), ()),
        (u**2 + x, ()),
    ],
    ids=str,
)
def test_jumps(expression, expected):
    assert set(jumps(expression, (u, x))) == set(expected)


def test_note():
    (note,) = notes(control_record(discontinuities=("x < 1",)))
    assert "jumps where x < 1 changes" in note
