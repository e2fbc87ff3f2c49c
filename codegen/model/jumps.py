"""Jumps of a Piecewise where a motion may cross them: derivatives do not see them, and no optimum is right there."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from itertools import pairwise

import sympy
from sympy import Dummy, Expr, Symbol

from codegen.expressions.zeros import identically_zero


def jumps(expression: Expr, unknowns: Iterable[Symbol]) -> tuple[str, ...]:
    """Conditions of Piecewise at whose border an expression jumps, as the author wrote them.

    Only borders that depend on the `unknowns` count, and that can be solved for one of them: time passes its borders
    when everybody knows. A slope that jumps is none, as in Piecewise((0, x < 0), (x**2, True)).
    """
    moving = set(unknowns)
    found: dict[str, None] = {}
    for piecewise in sorted(expression.atoms(sympy.Piecewise), key=sympy.default_sort_key):
        value = Dummy("value", real=True)
        outer = expression.xreplace({piecewise: value})
        for (before, condition), (after, _) in pairwise(piecewise.args):
            for border in _borders(condition, moving):
                difference = outer.xreplace({value: before}) - outer.xreplace({value: after})
                if any(not identically_zero(difference.subs(symbol, at)) for symbol, at in _solved(border, moving)):
                    found[str(border)] = None
    return tuple(found)


def _borders(condition: sympy.Basic, moving: Collection[Symbol]) -> Iterator[sympy.core.relational.Relational]:
    """The inequalities in a condition that depend on what moves."""
    for border in sorted(condition.atoms(sympy.core.relational.Relational), key=sympy.default_sort_key):
        if border.free_symbols & set(moving):
            yield border


def _solved(border: sympy.core.relational.Relational, moving: Collection[Symbol]) -> Iterator[tuple[Symbol, Expr]]:
    """A moving symbol that the border is linear in, and its value there; nothing if there is none."""
    distance = border.lhs - border.rhs
    for symbol in sorted(border.free_symbols & set(moving), key=str):
        slope = sympy.diff(distance, symbol)
        if symbol not in slope.free_symbols and not identically_zero(slope):
            yield symbol, symbol - distance / slope
            return
