"""Tables as functions of sympy, with exact derivatives of every order.

To sympy such a function is opaque, so that nothing is known of it but that equal arguments have equal values; its
numbers are looked up where an expression is evaluated. What kernels call is written in `codegen/emit/lower/kernels.py`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import mpmath
import sympy
from sympy import Expr

from codegen.symbolic.latex import in_latex
from codegen.symbolic.tables import DEGREE, TableData, derivative


class TableBase(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """A table, or its derivative of an `order` by each of its inputs.

    Printers of sympy ask for a base class by its name if that ends in Base.
    """

    is_real = True
    table: TableData
    order: tuple[int, ...] = ()

    def fdiff(self, argindex: int = 1) -> Expr:
        """The derivative by an input; beyond the degree of the polynomials it is zero."""
        index = argindex - 1
        if self.order[index] == DEGREE:
            return sympy.S.Zero
        order = tuple(o + (i == index) for i, o in enumerate(self.order))
        return member(self.table, order)(*self.args)

    def _eval_evalf(self, precision: int) -> Any:
        at = [argument._to_mpmath(precision, allow_ints=False) for argument in self.args]
        with mpmath.workprec(precision):
            return sympy.Expr._from_mpmath(value(self.table, self.order, at), precision)

    def _sympystr(self, printer: Any) -> str:
        return f"{written(self.table, self.order)}({', '.join(map(printer._print, self.args))})"

    def _pretty(self, printer: Any) -> Any:
        return printer._print_Function(sympy.Function(written(self.table, self.order))(*self.args))

    def _latex(self, printer: Any, exp: str | None = None) -> str:
        by = [i for i, o in zip(self.table.shape.inputs, self.order, strict=True) for _ in range(o)]
        below = f"_{{{','.join(map(in_latex, by))}}}" if by else ""
        power = f"^{{{exp}}}" if exp else ""
        arguments = ", ".join(map(printer._print, self.args))
        return rf"{{{in_latex(self.table.shape.name)}}}{below}{power}\left({arguments}\right)"


def value(table: TableData, order: tuple[int, ...], at: Iterable[Any]) -> Any:
    """A derivative at numbers of mpmath or of Python, or at arrays, real or complex."""
    return derivative(table, order, list(at), _real)


def _real(number: Any) -> Any:
    return number.real if hasattr(number, "real") else number


def written(table: TableData, order: tuple[int, ...]) -> str:
    """A derivative as messages and descriptions have it: thrust, thrust_mach, thrust_mach_altitude."""
    by = [name for name, o in zip(table.shape.inputs, order, strict=True) for _ in range(o)]
    return "_".join((table.shape.name, *by))


@cache
def member(table: TableData, order: tuple[int, ...]) -> Any:
    """The function of a table of which it is the derivative of an order; the same one for equal tables."""

    def evaluated(*at: Any) -> Any:
        return value(table, order, at)

    # Functions of lambdify are found by the class, whose name no other function may have.
    name = f"table_{written(table, (0,) * len(order))}_{'_'.join(map(str, order))}"
    attributes = {"table": table, "order": order, "nargs": len(order), "_imp_": staticmethod(evaluated)}
    return type(sympy.Function)(name, (TableBase,), attributes)


def tables_of(*holders: Any) -> tuple[TableData, ...]:
    """The tables of which expressions are made, in the order of their names, however deep in dataclasses they stand."""
    found: dict[TableData, None] = {}
    waiting = list(holders)
    while waiting:
        part = waiting.pop()
        if isinstance(part, sympy.Basic):
            found |= dict.fromkeys(function.table for function in part.atoms(TableBase))
        elif is_dataclass(part):
            waiting += [getattr(part, field.name) for field in fields(part)]
        elif isinstance(part, (tuple, list)):
            waiting += part
    return tuple(sorted(found, key=lambda table: table.shape.name))


def numbers_of(*holders: Any) -> tuple[float, ...]:
    """The numbers of all tables of expressions, one table after the other, as modules have them behind parameters."""
    return tuple(number for table in tables_of(*holders) for number in table.numbers)
