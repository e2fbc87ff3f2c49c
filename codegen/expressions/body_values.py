"""A number for each of many identical bodies, as a function of the body's number."""

from __future__ import annotations

from typing import Any

import sympy
from sympy import Expr


class EachBodyBase(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """The value of body 0, 1, ... among those that follow the body's number.

    Printers of sympy ask for a base class by its name if that ends in Base.
    """

    is_real = True

    @classmethod
    def eval(cls, body: Expr, *values: Expr) -> Expr | None:
        """The value itself where the number is known, or where all are the same."""
        if body.is_number:
            number = int(body)
            return values[number] if 0 <= number < len(values) else sympy.nan
        return values[0] if len(set(values)) == 1 else None

    def fdiff(self, argindex: int = 1) -> Expr:
        """Nothing is differentiated by a body's number."""
        return sympy.S.Zero

    def _sympystr(self, printer: Any) -> str:
        return f"each_body({', '.join(map(printer._print, self.args[1:]))})"


def value_counts(expression: Expr) -> set[int]:
    """For how many bodies an expression has values of their own."""
    return {len(function.args) - 1 for function in expression.atoms(EachBodyBase)}
