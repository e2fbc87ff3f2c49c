"""Boundary values as symbols, so that they stay arguments of the generated module."""

from __future__ import annotations

from dataclasses import replace

from sympy import Expr, Symbol

from codegen.discretise.model.definitions import Boundary, Model
from codegen.discretise.program import BoundaryValue
from codegen.errors import SymbolError


def with_symbolic_boundaries(model: Model) -> tuple[Model, tuple[BoundaryValue, ...]]:
    """Replace each boundary value by a symbol (`start_r`, `end_dphi`, ...) and list the symbols with their values."""
    values: list[BoundaryValue] = []
    declared = (*model.coordinates, *model.rates, *model.controls, *model.parameters)
    taken = {symbol.name for symbol in (*declared, *(free.symbol for free in model.free_parameters))}

    def symbolic(where: str, boundary: Boundary) -> Boundary:
        def named(quantities: tuple[Symbol, ...], given: tuple[Expr | None, ...]) -> tuple[Expr | None, ...]:
            symbols: list[Expr | None] = []
            for quantity, value in zip(quantities, given, strict=True):
                symbol = None
                if value is not None:
                    symbol = Symbol(f"{where}_{quantity.name}", real=True)
                    if symbol.name in taken:
                        raise SymbolError(
                            f"{symbol} names the value of {quantity} at the {where}", "choose another name"
                        )
                    values.append(BoundaryValue(where, quantity.name, symbol, value))
                symbols.append(symbol)
            return tuple(symbols)

        return Boundary(named(model.coordinates, boundary.positions), named(model.rates, boundary.rates))

    start = symbolic("start", model.start)
    end = symbolic("end", model.end) if model.end is not None else None
    return replace(model, start=start, end=end), tuple(values)
