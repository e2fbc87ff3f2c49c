"""Derivatives of long expressions, found on a graph of their values and written as straight-line programs.

Plain differentiation of a tree repeats common parts in every derivative, and finding them afterwards takes longer
than all the rest. Here common parts are found first (`graph`), derivatives are accumulated in reverse (`adjoint`), and
what has become common is found again (`sharing`); the time is proportional to the size of the result.

Gradient and Hessian of a value on its graph, by reverse accumulation.

The gradient passes adjoints, the derivatives of the value by its nodes, from each node to its arguments. The Hessian
passes second derivatives by pairs of nodes in the same sweep; an entry exists only where the pair can be reached, so
the pattern of zeros is exact up to cancellation. The adjoint of a multiplier is its equation: what is linear is
differentiated once only. Source: Gower and Mello (2012), A new framework for the computation of Hessians,
Optimization Methods and Software 27 (edge pushing).

Derivatives of one expression along directions, which keep its structure.

Along a direction the speed of a body that many coordinates move has one derivative; accumulated in reverse, by every
coordinate, it would be multiplied out. Equal parts are differentiated once, which plain differentiation of a tree does
not do.

Second derivatives as numbers at points, without their expressions, which of large systems are long.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import count
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.symbolic.graph import (
    ONE,
    Graph,
    Leaf,
    Product,
    StraightLine,
    Sum,
    arguments,
    shared,
    straight_line,
    written_out,
)
from codegen.symbolic.zeros import precise, vanishing

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


@dataclass(frozen=True)
class SecondDerivatives:
    """Straight-line programs for a scalar's derivatives.

    The values of `gradient` are the derivatives by all unknowns, then those of further expressions; those of `hessian`
    are its lower triangle's entries at the `indices` (row, column).
    """

    gradient: StraightLine
    hessian: StraightLine
    indices: tuple[tuple[int, int], ...]


def second_derivatives(scalar: Expr, unknowns: Sequence[Symbol], beside: Sequence[Expr] = ()) -> SecondDerivatives:
    """Differentiate a scalar twice by its unknowns, leaving out second derivatives that are identically zero.

    The expressions `beside` are evaluated together with the gradient.
    """
    graph = Graph(unknowns)
    leaves = range(len(unknowns))
    value, further = graph.of(scalar), [graph.of(expression) for expression in beside]
    adjoints = accumulate(graph, value, leaves)
    zero = graph.sum(())
    first = [adjoints.first.get(leaf, zero) for leaf in leaves]
    entries = {(max(pair), min(pair)): node for pair, node in adjoints.second.items() if max(pair) < len(unknowns)}
    absent = vanishing(graph, list(entries.values()))
    indices = tuple(sorted(index for index, node in entries.items() if node not in absent))
    second = [entries[index] for index in indices]
    taken = {str(node.expression) for node in graph.nodes if isinstance(node, Leaf)}
    return SecondDerivatives(_written(graph, [*first, *further], taken), _written(graph, second, taken), indices)


@dataclass(frozen=True)
class MixedDerivatives:
    """A straight-line program for a scalar's derivatives by data, and for second ones by an unknown and a datum.

    Its values are those by the data of the indices `slopes`, then those at the `entries` (unknown, datum).
    """

    program: StraightLine
    slopes: tuple[int, ...]
    entries: tuple[tuple[int, int], ...]


def mixed_derivatives(scalar: Expr, unknowns: Sequence[Symbol], data: Sequence[Symbol]) -> MixedDerivatives:
    """Differentiate a scalar by data, and by unknowns and data, leaving out what is identically zero."""
    graph, count = Graph([*unknowns, *data]), len(unknowns)
    leaves = range(count + len(data))
    adjoints = accumulate(graph, graph.of(scalar), leaves)
    first = {leaf - count: adjoints.first[leaf] for leaf in leaves[count:] if leaf in adjoints.first}
    second = {
        (min(pair), max(pair) - count): node
        for pair, node in adjoints.second.items()
        if min(pair) < count <= max(pair) < len(leaves)
    }
    absent = vanishing(graph, [*first.values(), *second.values()])
    slopes = tuple(sorted(index for index, node in first.items() if node not in absent))
    entries = tuple(sorted(pair for pair, node in second.items() if node not in absent))
    roots = [*(first[index] for index in slopes), *(second[pair] for pair in entries)]
    return MixedDerivatives(program_of(graph, roots), slopes, entries)


def jacobian(
    values: Sequence[Expr], unknowns: Sequence[Symbol], constants: Collection[Symbol]
) -> tuple[StraightLine, tuple[tuple[int, int], ...]]:
    """A program for some values and their derivatives by unknowns, and the indices (row, column) of the latter.

    What depends on `constants` alone reads no assignment. Derivatives that are identically zero are left out.
    """
    varying = set[Symbol]().union(*(value.free_symbols for value in values)) - set(unknowns) - set(constants)
    graph = Graph([*unknowns, *sorted(varying, key=lambda symbol: symbol.name)])
    nodes = [graph.of(value) for value in values]
    rows = [slopes(graph, node, range(len(unknowns))) for node in nodes]
    entries = {(i, j): node for i, row in enumerate(rows) for j, node in sorted(row.items())}
    absent = vanishing(graph, list(entries.values()))
    indices = tuple(index for index, node in entries.items() if node not in absent)
    return program_of(graph, [*nodes, *(entries[index] for index in indices)]), indices


def values_of(values: Sequence[Expr]) -> StraightLine:
    """A program for some values, whose common parts are found on their graph."""
    symbols = set[Symbol]().union(*(value.free_symbols for value in values))
    graph = Graph(sorted(symbols, key=lambda symbol: symbol.name))
    return program_of(graph, [graph.of(value) for value in values])


def program_of(graph: Graph, roots: Sequence[int]) -> StraightLine:
    """A program for the values of some nodes, in names that no leaf of the graph has."""
    return _written(graph, roots, {str(node.expression) for node in graph.nodes if isinstance(node, Leaf)})


def _written(graph: Graph, roots: Sequence[int], taken: set[str]) -> StraightLine:
    """A program for some values, with its own common parts and names x0, x1, ..."""
    smaller, numbers = shared(graph, roots)
    fresh = (Symbol(f"x{i}", real=True) for i in count() if f"x{i}" not in taken)
    return straight_line(smaller, [numbers[root] for root in roots], fresh)


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
