"""Kinks of a cost: where its slope jumps, which is where a minimum is drawn to and Newton's method cannot follow."""

from __future__ import annotations

from collections.abc import Iterable

import sympy
from sympy import Dummy, Expr, Symbol


def kinks(expression: Expr, unknowns: Iterable[Symbol]) -> tuple[str, ...]:
    """Terms with Abs, Max or Min at whose kink the slope of an expression jumps, as the author wrote them.

    Only what depends on the `unknowns` counts. u |u| has none, nor has max(x, 0)^2: their slopes are zero there.
    """
    moving = set(unknowns)
    found: dict[str, None] = {}
    for bend in sorted(expression.atoms(sympy.Abs, sympy.Max, sympy.Min), key=sympy.default_sort_key):
        if not bend.free_symbols & moving:
            continue
        value = Dummy()
        slope = expression.xreplace({bend: value}).diff(value)
        if not _vanishes(slope, value, bend):
            found[str(bend)] = None
    return tuple(found)


def _vanishes(slope: Expr, value: Symbol, bend: Expr) -> bool:
    """Whether the slope of an expression by the value of Abs, Max or Min is zero where that has its kink."""
    numbers = [argument for argument in bend.args if argument.is_number] or [sympy.S.Zero]
    others = [argument for argument in bend.args if not argument.is_number]
    if len(others) > 1:
        return False
    return bool(slope.subs({value: numbers[0]}).subs(others[0], numbers[0]) == 0)
