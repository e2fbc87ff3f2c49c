"""Kinks of a cost are told, and only those at which its slope jumps."""

from __future__ import annotations

import pytest
from made_records import control_record
from sympy import Abs, Max, Min, Symbol, cos

from codegen.discretise.model.values import kinks
from codegen.solving.results.output import notes

u, x, m = Symbol("u", real=True), Symbol("x", real=True), Symbol("m", real=True)


@pytest.mark.parametrize(
    ("cost", "expected"),
    [
        (Abs(u), ("Abs(u)",)),
        (u**2 + 3 * Abs(x - 1), ("Abs(x - 1)",)),
        (Max(x, 1), ("Max(1, x)",)),
        (Min(x, u), ("Min(u, x)",)),
        (u * Abs(u), ()),
        (Max(x, 0) ** 2, ()),
        (Abs(u) ** 3, ()),
        (Abs(m) * u**2, ()),
        (cos(x) + u**2, ()),
    ],
    ids=str,
)
def test_kinks(cost, expected):
    assert kinks(cost, (u, x)) == expected


def test_note():
    (note,) = notes(control_record(kinks=("Abs(u)",)))
    assert "Abs(u) has a kink" in note
    assert "a + b" in note
