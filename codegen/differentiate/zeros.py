"""Which values vanish identically although their expressions do not show it."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import mpmath
import sympy
from sympy import Expr

from codegen.differentiate.graph import Call, Graph, Leaf, Product, Sum, argument

_DIGITS = 60
_NOTHING = mpmath.mpf(10) ** -40
_POINTS = 2
_ANALYTIC = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2, sympy.exp, sympy.log),
    *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.acosh, sympy.atanh, sympy.Pow),
    *(sympy.codegen.cfunctions.log1p, sympy.codegen.cfunctions.expm1),
)


def vanishing(graph: Graph, roots: Sequence[int]) -> set[int]:
    """Those of the nodes whose value is zero, to 40 digits, at random points; none where functions have branches.

    An analytic function that vanishes at random points vanishes everywhere, with probability one.
    """
    order = graph.reachable(roots)
    calls = [node for node in map(graph.nodes.__getitem__, order) if isinstance(node, Call)]
    if not all(isinstance(call.template, _ANALYTIC) for call in calls):
        return set()
    functions = {call.template: _function(call) for call in calls}
    generator, zeros = random.Random(1), set(roots)
    for _ in range(_POINTS):
        try:
            with mpmath.workdps(_DIGITS):
                values = _values(graph, order, functions, generator)
        except (ArithmeticError, ValueError):  # no value there: nothing is known
            return set()
        zeros = {root for root in zeros if abs(values[root]) < _NOTHING}
        if not zeros:
            break
    return zeros


def _function(call: Call) -> Callable[..., Any]:
    places = [argument(i) for i in range(len(call.arguments))]
    return sympy.lambdify(places, call.template, "mpmath")  # type: ignore[no-any-return]


def _values(
    graph: Graph, order: Sequence[int], functions: Mapping[Expr, Callable[..., Any]], generator: random.Random
) -> dict[int, Any]:
    values: dict[int, Any] = {}
    for number in order:
        node = graph.nodes[number]
        if isinstance(node, Leaf):
            symbolic = node.expression.is_Symbol
            values[number] = mpmath.mpf(generator.uniform(0.4, 1.6)) if symbolic else _constant(node.expression)
        elif isinstance(node, Sum):
            values[number] = mpmath.fsum([_number(node.constant), *(_number(c) * values[a] for a, c in node.terms)])
        elif isinstance(node, Product):
            values[number] = mpmath.fprod(values[a] ** _number(exponent) for a, exponent in node.factors)
        else:
            values[number] = functions[node.template](*(values[a] for a in node.arguments))
    return values


def _constant(expression: Expr) -> Any:
    return mpmath.mpmathify(expression.evalf(_DIGITS))


def _number(fraction: Fraction) -> Any:
    return mpmath.mpf(fraction.numerator) / fraction.denominator
