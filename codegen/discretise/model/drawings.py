"""The drawing of a problem: what may occur in it, and the same drawing in plain symbols.

A drawing never changes what is derived: all that it depends on must occur in the problem without it, but for the time
and the body's number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import sympy

from codegen.discretise.model.definitions import Model
from codegen.drawing import Item
from codegen.errors import ExpressionError, SymbolError
from codegen.problem.problem import Problem
from codegen.problem.symbols import BodyNumber, Coordinate, Delayed, EndValue, Momentum, Quantity, State, Time, Velocity
from codegen.symbolic import checks as expressions

_REMEDY = "draw with coordinates or states, controls, parameters, time and the body's number"


def checked_drawing(problem: Problem) -> tuple[Item, ...]:
    """The author's items with every expression sympified.

    Raises ExpressionError for what is no item, for a point without two coordinates, and for rates and end values, whose
    courses a solution does not hold; SymbolError for symbols that were never declared.
    """
    if not isinstance(problem.drawing, (list, tuple)):
        raise ExpressionError(
            f"drawing is a {type(problem.drawing).__name__}",
            "write drawing=[...] with items of codegen.drawing",
        )
    return tuple(_checked(item, f"drawing[{index}]") for index, item in enumerate(problem.drawing))


def drawn_quantities(items: Sequence[Item]) -> set[Quantity]:
    """All quantities that occur in a drawing."""
    return {symbol for item in items for _, expression in item.expressions() for symbol in expression.free_symbols}


def require_derived(items: Sequence[Item], used: Sequence[Quantity]) -> None:
    """Refuse a drawing of quantities that the problem itself does not use; SymbolError names one."""
    times = [symbol for symbol in used if isinstance(symbol, Time)]
    for symbol in sorted(drawn_quantities(items) - set(used), key=lambda symbol: symbol.declared):
        if isinstance(symbol, Time) and times:
            raise SymbolError(f"two times are declared ({times[0]}, {symbol})", "use one")
        if not isinstance(symbol, (Time, BodyNumber)):
            remedy = "write a number" if not isinstance(symbol, (Coordinate, State)) else "remove it"
            raise SymbolError(f"{symbol} occurs in the drawing only", f"{remedy}, or let the problem depend on it")


def with_drawing(model: Model, items: Sequence[Item], plain: Mapping[Quantity, sympy.Symbol]) -> Model:
    """The model with its drawing in plain symbols; ExpressionError when a size is not positive."""
    symbols: dict[Quantity, sympy.Symbol] = {}
    for symbol in drawn_quantities(items):
        alone = model.time if isinstance(symbol, Time) else sympy.Symbol(symbol.name, real=True)
        symbols[symbol] = plain.get(symbol, alone)
    drawing = tuple(item.mapped(lambda expression: expression.xreplace(symbols)) for item in items)
    for index, item in enumerate(drawing):
        for name in ("radius", "width", "height"):
            size = expressions.rounded_at(getattr(item, name, sympy.S.One), model.default_values)
            if size is not None and size <= 0.0:
                raise ExpressionError(
                    f"{name} of drawing[{index}], a {type(item).__name__}, is {size:g}", "give a positive length"
                )
    return replace(model, drawing=drawing)


def _checked(item: Any, where: str) -> Item:
    if not isinstance(item, Item) or type(item) is Item:
        raise ExpressionError(f"{where} is a {type(item).__name__}", "use items of codegen.drawing, such as Rod")
    where = f"{where}, a {type(item).__name__},"
    if not isinstance(item.label, str):
        raise ExpressionError(f"{where} has the label {item.label!r}", "give text")
    points = {field.name for field in fields(item) if field.type == "Point"}
    changes = {name: _part(value, f"{where} {name}", name in points) for name, value in item.parts()}
    checked = replace(item, **changes)
    for name, expression in checked.expressions():
        _require_drawable(expression, f"{where} {name}")
    return checked


def _part(value: Any, what: str, is_point: bool) -> Any:
    if not is_point:
        return expressions.checked(value, what)
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise ExpressionError(f"{what} is {value!r}", "give two coordinates (x, y); project a point in space")
    return tuple(expressions.checked(part, what) for part in value)


def _require_drawable(expression: sympy.Expr, what: str) -> None:
    for symbol in sorted(expression.free_symbols, key=str):
        if not isinstance(symbol, Quantity):
            raise SymbolError(f"{symbol} in {what} was never declared", "declare it, or write a number")
        if isinstance(symbol, (Velocity, Momentum, EndValue, Delayed)):
            raise ExpressionError(f"{what} depends on {symbol}", _REMEDY)
