"""Derivatives of one expression along directions, which keep its structure.

Along a direction the speed of a body that many coordinates move has one derivative; accumulated in reverse, by every
coordinate, it would be multiplied out. Equal parts are differentiated once, which plain differentiation of a tree does
not do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import sympy
from sympy import Expr, Symbol

from codegen.expressions.adjoint import slopes_of_node
from codegen.expressions.graph import ONE, Graph, arguments
from codegen.expressions.straight_line import written_out

_LONG = 500
"""Operations from which on derivatives are found on a graph; shorter ones read better from plain derivatives."""


def gradient(function: Expr, symbols: Iterable[Symbol]) -> tuple[Expr, ...]:
    """The derivatives of a function by symbols, each written out as one expression."""
    ordered = tuple(symbols)
    if function.count_ops() < _LONG:
        return tuple(sympy.diff(function, symbol) for symbol in ordered)
    return _along(function, [{symbol: sympy.S.One} for symbol in ordered])


def variation(function: Expr, displacements: Mapping[Symbol, Expr]) -> Expr:
    """The derivative of a function along displacements of its symbols."""
    if function.count_ops() >= _LONG:
        return _along(function, [displacements])[0]
    amount = sympy.Dummy("amount", real=True)
    displaced = {symbol: symbol + amount * d for symbol, d in displacements.items()}
    return sympy.diff(function.xreplace(displaced), amount).xreplace({amount: sympy.S.Zero})


def _along(function: Expr, directions: Sequence[Mapping[Symbol, Expr]]) -> tuple[Expr, ...]:
    graph = Graph(sorted(set().union(*directions), key=lambda symbol: symbol.name))
    value = graph.of(function)
    order = [node for node in graph.reachable([value]) if graph.varies[node]]
    found = (
        _tangent(graph, order, value, {graph.of(symbol): graph.of(d) for symbol, d in direction.items()})
        for direction in directions
    )
    return written_out(graph, list(found))


def _tangent(graph: Graph, order: Sequence[int], value: int, direction: Mapping[int, int]) -> int:
    """The node of the derivative of a node along a direction, which is given by nodes for leaves."""
    tangents = dict(direction)
    for node in order:
        if node in tangents or tangents.keys().isdisjoint(arguments(graph.nodes[node])):
            continue
        terms = (
            (tangents[a] if slope is None else graph.times(slope, tangents[a]), factor)
            for a, slope, factor in slopes_of_node(graph, node)
            if a in tangents
        )
        tangents[node] = graph.sum(terms)
    return tangents.get(value, graph.number(ONE - ONE))
