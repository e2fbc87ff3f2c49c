"""Expressions of an author in LaTeX: quantities by what they are, words apart from what they are multiplied with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy
from sympy.logic.boolalg import Boolean
from sympy.printing.latex import LatexPrinter

from codegen import lettering
from codegen.author.quantities import Delayed, Quantity
from codegen.author.symbols import Velocity


class Printer(LatexPrinter):  # type: ignore[misc]  # sympy is untyped
    """LaTeX of what stands in a problem with these quantities, between two ends of time that are called so.

    A velocity of its coordinate's name has a dot.

    Where a name is a word, factors stand apart.
    """

    def __init__(self, quantities: list[Quantity], first: str, last: str) -> None:
        has_words = any(_name(symbol).startswith(r"\mathrm") for symbol in quantities)
        super().__init__({"mul_symbol": r" \, "} if has_words else None)
        self.first, self.last = first, last

    def __call__(self, value: Any) -> str:
        """What an author gave as an expression, or the name of its type where that is no mathematics."""
        try:
            return str(self.doprint(sympy.sympify(value)))
        except (sympy.SympifyError, TypeError, ValueError, AttributeError):
            return rf"\text{{{type(value).__name__}}}"

    def relation(self, value: Any) -> str:
        """A relation, or an expression that is to vanish, as a symbol alone may be."""
        return self(value) if isinstance(value, Boolean) and not isinstance(value, Quantity) else f"{self(value)} = 0"

    def at(self, value: Any, time: str) -> str:
        """A quantity, or an expression of them, at a time."""
        return f"{self(value)}({time})" if isinstance(value, Quantity) else f"[{self(value)}]({time})"

    def between(self, written: str, limits: Sequence[Any]) -> str:
        """Something that is written so between a lower and an upper limit, each of which may be None."""
        low, high = limits
        lower = rf"{self(low)} \le " if low is not None else ""
        upper = rf" \le {self(high)}" if high is not None else ""
        return f"{lower}{written}{upper}"

    def rate(self, state: Any) -> str:
        """The derivative of a state by time."""
        return rf"\dot{{{self(state)}}}"

    def _print_Symbol(self, expr: sympy.Symbol, style: str = "plain") -> str:
        if isinstance(expr, Delayed):
            return rf"{_name(expr.partner)}\left(t - {self._print(expr.lag)}\right)"
        return _name(expr)


def _name(symbol: sympy.Symbol) -> str:
    if isinstance(symbol, Velocity) and symbol.name == f"d{symbol.partner.name}":
        return rf"\dot{{{_name(symbol.partner)}}}"
    return lettering.in_latex(symbol.name)
