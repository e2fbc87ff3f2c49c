"""Conditions at inner times along the computed motion, as the author wrote them, and the times themselves.

Node, coordinates and rates are read off the solution: nothing of the module's own tables or kernels takes part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr

from codegen.checks.base import Context, Finding, not_measured
from codegen.checks.solution.solutions import free_values
from codegen.expressions.special_functions import NUMPY
from codegen.model import InnerCondition, Model, legendre

_NAME = "inner times"
_HELD = 1e-7


def check(context: Context) -> Iterator[Finding]:
    """One finding for each condition, and one for the times."""
    model = context.model
    solution = context.solution
    if solution.status != "solved":
        yield not_measured(_NAME, "all conditions", solution.message)
        return
    free = [p.symbol for p in model.free_parameters]
    numbers = dict(zip(model.parameters, model.defaults, strict=True))
    numbers |= dict(zip(free, free_values(context.module, solution), strict=True))
    nodes = _nodes(context, numbers)
    for condition in model.inner_conditions:
        yield _held(context, condition, nodes[condition.number], numbers)
    yield _times(model, solution.t[nodes], numbers)


def _nodes(context: Context, numbers: dict[sympy.Symbol, float]) -> NDArray[np.int64]:
    """The node nearest to every given time, and of free ones that which the module's grid tells."""
    t, model = context.solution.t, context.model
    kept = context.module.make_grid(t.size - 1).inner
    given = [None if inner.time is None else _number(inner.time, numbers) for inner in model.inner_times]
    pairs = zip(given, kept, strict=True)
    return np.array([node if time is None else int(np.argmin(np.abs(t - time))) for time, node in pairs])


def _held(context: Context, condition: InnerCondition, node: int, numbers: dict[sympy.Symbol, float]) -> Finding:
    """How far a condition is from holding, in units of its own terms, for the body that is farthest."""
    model, solution, width = context.model, context.solution, len(context.model.coordinates)
    rates, worst = dict(zip(model.rates, _rates(context), strict=True)), 0.0
    symbols = [*model.coordinates, *_momenta(context), model.time, *numbers]
    expression = condition.expression.subs(rates, simultaneous=True)
    size = sympy.Add(*map(sympy.Abs, sympy.Add.make_args(expression)))
    function = sympy.lambdify(symbols, [expression, size], modules=NUMPY, cse=True)
    for body in range(model.bodies):
        here = slice(body * width, (body + 1) * width)
        own = [*solution.q[node, here], *(solution.p[node, here] if model.rates else ())]
        value, scale = function(*own, solution.t[node], *numbers.values())
        excess = abs(value) if condition.equality else max(0.0, value)
        worst = max(worst, float(excess) / max(1.0, float(scale)))
    detail = (
        f"at node {node}, t = {solution.t[node]:.6g}, it {'holds to' if worst <= _HELD else 'fails by'} {worst:.1g}"
    )
    return Finding(_NAME, str(condition), bool(worst <= _HELD), detail)


def _momenta(context: Context) -> tuple[sympy.Symbol, ...]:
    """The symbols of what a solution has beside coordinates."""
    model = context.model
    return model.rates if model.form == "hamiltonian" or not model.rates else legendre.conjugate_symbols(model)


def _rates(context: Context) -> tuple[Expr, ...]:
    """The author's rates in these symbols."""
    model: Any = context.model
    if model.form != "lagrangian":
        return tuple(model.rates)
    used = {s for c in model.inner_conditions for s in c.expression.free_symbols}
    return legendre.velocity_of_momentum(model) if used & set(model.rates) else tuple(model.rates)


def _times(model: Model, found: NDArray[np.float64], numbers: dict[sympy.Symbol, float]) -> Finding:
    """Whether times are those that are given, or inside their windows, and in order."""
    slack = _HELD * max(1.0, float(np.abs(found).max()))
    wrong = []
    for number, (inner, time) in enumerate(zip(model.inner_times, found, strict=True), start=1):
        missed = [abs(time - _number(inner.time, numbers))] if inner.time is not None else []
        missed += [_number(inner.earliest, numbers) - time] if inner.earliest is not None else []
        missed += [time - _number(inner.latest, numbers)] if inner.latest is not None else []
        if max(missed, default=0.0) > slack:
            wrong.append(f"time {number} is {time:.6g}, which misses what is given by {max(missed):.2g}")
    if (np.diff(found) < -slack).any():
        wrong.append("the times are not in order")
    listed = ", ".join(f"{time:.6g}" for time in found)
    return Finding(_NAME, "times", not wrong, wrong[0] if wrong else f"in order, as given: t = {listed}")


def _number(expression: Expr | None, numbers: dict[sympy.Symbol, float]) -> float:
    return float(sympy.sympify(expression).subs(numbers))
