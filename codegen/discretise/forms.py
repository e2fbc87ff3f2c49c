"""A model in the quantities in which it is transcribed: velocities, momenta or states, with symbolic boundary values.

The Legendre transforms rewrite dynamics, force, cost and boundary values. The functions of this module rewrite path
conditions, end conditions and terminal cost. A bound or prescribed value becomes a condition if in the other form its
quantity is no unknown, or its value is no number.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sympy import Expr, Symbol

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Boundary, Bounds, Condition, Model
from codegen.discretise.program import BoundaryValue
from codegen.errors import ExpressionError, SymbolError
from codegen.problem.symbols import Velocity


def in_velocities(model: Model) -> Model:
    """Return the model and its conditions in Lagrangian form; raise the errors of the Legendre transform.

    Bounds on momenta, which are no unknowns of that form, become path conditions.
    """
    kept, conditions = list[Bounds](), list[Condition]()
    for bounds in model.bounds:
        if bounds.symbol not in model.rates:
            kept.append(bounds)
            continue
        for condition in bounds.conditions:
            if model.body is not None and condition.expression.has(model.body):
                raise ExpressionError(
                    f"a bound on {bounds.symbol} depends on the body's number, and no unknown of the variational "
                    "method has it",
                    "give every body the same bound, or use --method hamiltonian",
                )
            conditions.append(condition)
    if conditions:
        model = replace(model, bounds=tuple(kept), path=(*model.path, *conditions))
    model = rewritten(model, legendre.lagrangian_form(model))
    # Velocities at the ends that depend on free parameters, such as p/m, become end conditions.
    free = {parameter.symbol for parameter in model.free_parameters}
    if not free or model.end is None:
        return model

    def split(boundary: Boundary) -> tuple[Boundary, tuple[Condition, ...]]:
        pairs = zip(model.rates, boundary.rates, strict=True)
        tied = {v: value for v, value in pairs if value is not None and value.free_symbols & free}
        fixed = tuple(None if v in tied else value for v, value in zip(model.rates, boundary.rates, strict=True))
        return replace(boundary, rates=fixed), tuple(Condition(f"{v} = {x}", v - x) for v, x in tied.items())

    (start, at_start), (end, at_end) = split(model.start), split(model.end)
    return replace(
        model,
        start=start,
        end=end,
        start_conditions=(*model.start_conditions, *at_start),
        end_conditions=(*model.end_conditions, *at_end),
    )


def in_momenta(model: Model) -> Model:
    """Return the model in Hamiltonian form, without boundary values, because these may be velocities."""
    return rewritten(model, legendre.hamiltonian_form(model.with_free_ends))


def rewritten(original: Model, transformed: Model) -> Model:
    """Return the transformed model with the original's conditions and terminal cost, in the new rates."""
    if original.form == transformed.form:
        return transformed
    kinds = [kind for kind in CONDITIONS if Velocity in kind.scope[kind.argument]]
    expressions = (original.terminal_cost, *(c.expression for kind in kinds for c in getattr(original, kind.field)))
    if not any(expression.has(*original.rates) for expression in expressions):
        return transformed
    rates = legendre.velocity_of_momentum if original.form == "lagrangian" else legendre.momentum_of_velocity
    values = dict(zip(original.rates, rates(original), strict=True))
    written: dict[str, Any] = {
        kind.field: tuple(replace(c, expression=c.expression.xreplace(values)) for c in getattr(original, kind.field))
        for kind in kinds
    }
    return replace(transformed, **written, terminal_cost=original.terminal_cost.xreplace(values))


def with_symbolic_boundaries(model: Model) -> tuple[Model, tuple[BoundaryValue, ...]]:
    """Return a model with a symbol (`start_r`, `end_dphi`, ...) for each boundary value, and the symbols with values.

    The symbols are arguments of the generated module. Raises SymbolError if the author uses such a name.
    """
    values: list[BoundaryValue] = []
    declared = (*model.coordinates, *model.rates, *model.controls, *model.parameters)
    taken = {symbol.name for symbol in (*declared, *(free.symbol for free in model.free_parameters))}

    def symbolic(where: str, end: Boundary) -> Boundary:
        symbols: list[Expr | None] = []
        quantities, prescribed = (*model.coordinates, *model.rates), (*end.positions, *end.rates)
        for quantity, value in zip(quantities, prescribed, strict=True):
            symbol = None
            if value is not None:
                symbol = Symbol(f"{where}_{quantity.name}", real=True)
                if symbol.name in taken:
                    raise SymbolError(f"{symbol} names the value of {quantity} at the {where}", "choose another name")
                values.append(BoundaryValue(where, quantity.name, symbol, value))
            symbols.append(symbol)
        count = len(model.coordinates)
        return Boundary(tuple(symbols[:count]), tuple(symbols[count:]))

    start = symbolic("start", model.start)
    end = symbolic("end", model.end) if model.end is not None else None
    return replace(model, start=start, end=end), tuple(values)
