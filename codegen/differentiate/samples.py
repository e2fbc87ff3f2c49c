"""Second derivatives as numbers at points, without their expressions, which of large systems are long."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.differentiate.adjoint import accumulate
from codegen.differentiate.graph import Graph
from codegen.differentiate.straight_line import straight_line
from codegen.differentiate.zeros import vanishing

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
    names = (sympy.Dummy() for _ in iter(int, 1))
    program = straight_line(graph, list(entries.values()), names)
    symbols = sorted(function.free_symbols, key=lambda symbol: symbol.name)
    evaluate = sympy.lambdify(
        symbols, list(program.values), modules=[_FUNCTIONS, "mpmath"], cse=lambda values: (program.assignments, values)
    )
    for point in points:
        with mpmath.workdps(_DIGITS):
            try:
                numbers = [float(value) for value in evaluate(*(mpmath.mpf(point[symbol]) for symbol in symbols))]
            except (TypeError, ValueError, ArithmeticError, KeyError):
                yield None
                continue
        matrix = np.zeros((len(variables), len(variables)))
        for (row, column), number in zip(entries, numbers, strict=True):
            matrix[row, column] = matrix[column, row] = number
        yield matrix if np.all(np.isfinite(matrix)) else None
