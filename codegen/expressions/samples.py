"""Second derivatives as numbers at points, without their expressions, which of large systems are long."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.expressions.adjoint import accumulate
from codegen.expressions.graph import Graph, Leaf, Product, Sum
from codegen.expressions.zeros import precise, vanishing

_DIGITS = 100
_FUNCTIONS = {"Heaviside": lambda x: (1 + mpmath.sign(x)) / 2, "DiracDelta": lambda *_: mpmath.mpf(0)}


def hessian_samples(
    function: Expr, variables: Sequence[Symbol], points: Iterable[Mapping[Symbol, float]]
) -> Iterator[np.ndarray | None]:
    """The matrix of second derivatives at each point, of shape (variables, variables).

    None where an entry is not a finite real number.
    """
    graph = Graph(variables)
    found = accumulate(graph, graph.of(function), range(len(variables))).second
    inside = {pair: node for pair, node in found.items() if max(pair) < len(variables)}
    absent = vanishing(graph, inside.values())
    entries = {pair: node for pair, node in inside.items() if node not in absent}
    order, functions = graph.reachable(entries.values()), _Functions()
    for point in points:
        with mpmath.workdps(_DIGITS):
            try:
                values = _values(graph, order, point, functions)
                numbers = [float(values[node]) for node in entries.values()]
            except (TypeError, ValueError, ArithmeticError, KeyError):
                yield None
                continue
        matrix = np.zeros((len(variables), len(variables)))
        for (row, column), number in zip(entries, numbers, strict=True):
            matrix[row, column] = matrix[column, row] = number
        yield matrix if np.all(np.isfinite(matrix)) else None


class _Functions(dict[Expr, Callable[..., Any]]):
    """The functions of nodes with many digits, by their templates, each made once."""

    def __missing__(self, template: Expr) -> Callable[..., Any]:
        arguments = sorted(template.free_symbols, key=lambda symbol: int(symbol.name[1:]))
        self[template] = sympy.lambdify(arguments, template, modules=[_FUNCTIONS, "mpmath"])
        return self[template]


def _values(
    graph: Graph, order: Sequence[int], point: Mapping[Symbol, float], functions: Mapping[Expr, Callable[..., Any]]
) -> dict[int, Any]:
    """The values of nodes in the order of computation; a kind of ArithmeticError where one has none."""
    known: dict[int, Any] = {}
    for number in order:
        node = graph.nodes[number]
        if isinstance(node, Leaf):
            given = point[node.expression] if node.expression.is_Symbol else node.expression.evalf(_DIGITS + 5)
            known[number] = mpmath.mpmathify(given)
        elif isinstance(node, Sum):
            known[number] = precise(node.constant) + sum(precise(c) * known[a] for a, c in node.terms)
        elif isinstance(node, Product):
            known[number] = mpmath.fprod(known[a] ** precise(exponent) for a, exponent in node.factors)
        else:
            known[number] = functions[node.template](*(known[a] for a in node.arguments))
    return known
