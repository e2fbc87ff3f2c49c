"""Gradient and Hessian of a value on its graph, by reverse accumulation.

The gradient passes adjoints, the derivatives of the value by its nodes, from each node to its arguments. The Hessian
passes second derivatives by pairs of nodes in the same sweep; an entry exists only where the pair can be reached, so
the pattern of zeros is exact up to cancellation. The adjoint of a multiplier is its equation: what is linear is
differentiated once only. Source: Gower and Mello (2012), A new framework for the computation of Hessians,
Optimization Methods and Software 27 (edge pushing).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction

from codegen.expressions.graph import ONE, Graph, Product, Sum, arguments

Terms = list[tuple[int, Fraction]]
Slopes = list[tuple[int, int | None, Fraction]]
"""Derivatives of a node by its arguments: the argument, a node (None stands for 1), and a number that multiplies it."""


@dataclass
class Adjoints:
    """Nodes of the derivatives of one value: by every node, and by pairs of nodes (higher rank first)."""

    first: dict[int, int] = field(default_factory=dict)
    second: dict[tuple[int, int], int] = field(default_factory=dict)


def accumulate(graph: Graph, value: int, unknowns: Sequence[int]) -> Adjoints:
    """The first and second derivatives of a value by all nodes between it and the unknowns, and by these."""
    return _Sweep(graph, value, unknowns).run()


def slopes(graph: Graph, value: int, unknowns: Sequence[int]) -> dict[int, int]:
    """Nodes of the first derivatives of a value by those of the unknowns on which it depends."""
    wanted = set(unknowns)
    order = [node for node in graph.reachable([value]) if graph.varies[node]]
    depending = set[int]()
    for node in order:
        if node in wanted or not depending.isdisjoint(arguments(graph.nodes[node])):
            depending.add(node)
    sweep, found = _Sweep(graph, value, unknowns), dict[int, int]()
    for node in reversed(order):
        if node not in depending:
            continue
        adjoint = found[node] = graph.sum(sweep.first.pop(node, []))
        if node in wanted:
            continue
        for argument, slope, factor in slopes_of_node(graph, node):
            if argument in depending:
                sweep.first.setdefault(argument, []).append((sweep.times(adjoint, slope), factor))
    return {node: adjoint for node, adjoint in found.items() if node in wanted}


class _Sweep:
    """One reverse sweep; what is passed to a node or pair is collected as the terms of a sum."""

    def __init__(self, graph: Graph, value: int, unknowns: Sequence[int]) -> None:
        self.graph = graph
        self.unknowns = set(unknowns)
        varying = [node for node in graph.reachable([value]) if graph.varies[node]]
        affine = _affine(graph, varying, self.unknowns)
        # Sums and differences of unknowns, such as midpoints and velocities, come last: they are few, and each of
        # them would multiply the number of pairs by the number of its unknowns.
        self.order = sorted(varying, key=lambda node: (node not in affine, node), reverse=True)
        self.rank = {node: -index for index, node in enumerate(self.order)}
        self.first: dict[int, Terms] = {value: [(graph.number(ONE), ONE)]}
        self.second: dict[int, dict[int, Terms]] = {}
        self.zero = graph.number(ONE - ONE)

    def run(self) -> Adjoints:
        found = Adjoints()
        for node in self.order:
            adjoint = found.first[node] = self.graph.sum(self.first.pop(node, []))
            row = {other: self.graph.sum(terms) for other, terms in self.second.pop(node, {}).items()}
            row = {other: curvature for other, curvature in row.items() if curvature != self.zero}
            found.second |= {(node, other): curvature for other, curvature in row.items()}
            if node not in self.unknowns:
                self._push(node, adjoint, row)
        return found

    def _push(self, node: int, adjoint: int, row: dict[int, int]) -> None:
        slopes, curvatures = slopes_of_node(self.graph, node), self._curvatures(node)
        for argument, slope, factor in slopes:
            self.first.setdefault(argument, []).append((self.times(adjoint, slope), factor))
        for a, b, curvature in curvatures:
            self._add(a, b, self.graph.times(adjoint, curvature), ONE)
        for other, curvature in row.items():
            for i, (a, slope, factor) in enumerate(slopes):
                passed = self.times(curvature, slope)
                if other != node:
                    self._add(a, other, passed, factor * 2 if a == other else factor)
                    continue
                for b, second_slope, second_factor in slopes[: i + 1]:
                    self._add(a, b, self.times(passed, second_slope), factor * second_factor)

    def _add(self, a: int, b: int, node: int, factor: Fraction) -> None:
        if self.rank[a] < self.rank[b]:
            a, b = b, a
        self.second.setdefault(a, {}).setdefault(b, []).append((node, factor))

    def times(self, node: int, slope: int | None) -> int:
        return node if slope is None else self.graph.times(node, slope)

    def _curvatures(self, number: int) -> list[tuple[int, int, int]]:
        """The second derivatives of a node by pairs of its arguments, each pair once."""
        graph, found = self.graph, list[tuple[int, int, int]]()
        node, varies = graph.nodes[number], graph.varies
        if isinstance(node, Product):
            varying = [factor for factor, _ in node.factors if varies[factor]]
            found = [(a, b, _lowered(graph, node, a, b)) for i, a in enumerate(varying) for b in varying[: i + 1]]
        elif not isinstance(node, Sum):
            call = graph.call_at(number)
            indices = [(i, a) for i, a in enumerate(call.arguments) if varies[a]]
            found = [
                (a, b, graph.derivative(call, i, j)) for n, (i, a) in enumerate(indices) for j, b in indices[: n + 1]
            ]
        return [(a, b, curvature) for a, b, curvature in found if curvature != self.zero]


def slopes_of_node(graph: Graph, number: int) -> Slopes:
    """The first derivatives of a node by those of its arguments that vary."""
    node, varies = graph.nodes[number], graph.varies
    if isinstance(node, Sum):
        return [(term, None, coefficient) for term, coefficient in node.terms if varies[term]]
    if isinstance(node, Product):
        return [(factor, _lowered(graph, node, factor), ONE) for factor, _ in node.factors if varies[factor]]
    call = graph.call_at(number)
    return [(a, graph.derivative(call, i), ONE) for i, a in enumerate(call.arguments) if varies[a]]


def _lowered(graph: Graph, product: Product, *factors: int) -> int:
    """The derivative of a product by factors, one after the other."""
    exponents, coefficient = dict(product.factors), ONE
    for factor in factors:
        coefficient *= exponents[factor]
        exponents[factor] -= 1
    return graph.product(exponents.items(), coefficient)


def _affine(graph: Graph, varying: Sequence[int], unknowns: set[int]) -> set[int]:
    """The nodes that are linear in the unknowns, with coefficients that are free of them."""
    found = set(unknowns)
    for number in varying:
        node = graph.nodes[number]
        inside = [a for a in arguments(node) if graph.varies[a]]
        if not found.issuperset(inside):
            continue
        if isinstance(node, Sum) or (isinstance(node, Product) and [dict(node.factors)[a] for a in inside] == [ONE]):
            found.add(number)
    return found
