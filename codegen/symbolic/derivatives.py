"""Derivatives of long expressions: on a graph of their values, as straight-line programs or as numbers.

Plain differentiation of a tree repeats common parts in every derivative, and the later search for them would take most
of the time. Here common parts are found first, derivatives are accumulated in reverse, and new common parts are found
again. The time is proportional to the size of the result.

The reverse sweep passes adjoints, the derivatives of the value with respect to nodes, from each node to its arguments.
For the Hessian it also passes second derivatives with respect to pairs of nodes. An entry exists only if the sweep
reaches the pair, so the pattern of zeros is exact up to cancellation. The adjoint of a multiplier is its equation:
linear parts are differentiated only once. Source: Gower and Mello (2012), A new framework for the computation of
Hessians, Optimization Methods and Software 27 (edge pushing).

Derivatives along directions keep the structure of an expression. For example, the speed of a body that many coordinates
move has one derivative along a direction. A reverse sweep would differentiate it with respect to every coordinate.

Second derivatives as numbers need no expressions, which are long for large systems.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import count

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
"""Derivatives of a node as triples: argument, a node (None for 1), and a number; the derivative is their product."""


@dataclass
class Adjoints:
    """Nodes of a value's derivatives with respect to nodes, and to pairs of nodes (the node nearer the value first)."""

    first: dict[int, int] = field(default_factory=dict)
    second: dict[tuple[int, int], int] = field(default_factory=dict)


def accumulate(graph: Graph, value: int, unknowns: Sequence[int]) -> Adjoints:
    """Return first and second derivatives of a value with respect to all varying nodes that it depends on.

    `unknowns` are the nodes at which the reverse sweep ends. Contributions to a node or pair become terms of a sum.
    """
    wanted, affine = set(unknowns), set(unknowns)
    varying = [node for node in graph.reachable([value]) if graph.varies[node]]
    for number in varying:  # find the nodes that are linear in the unknowns, with constant coefficients
        part = graph.nodes[number]
        inside = [a for a in arguments(part) if graph.varies[a]]
        is_linear = isinstance(part, Sum) or (
            isinstance(part, Product) and [dict(part.factors)[a] for a in inside] == [ONE]
        )
        if is_linear and affine.issuperset(inside):
            affine.add(number)
    # Sums and differences of unknowns, such as midpoints and velocities, are few and come last. Each of them
    # would multiply the number of pairs by the number of its unknowns.
    order = sorted(varying, key=lambda node: (node not in affine, node), reverse=True)
    rank = {node: -index for index, node in enumerate(order)}
    first: dict[int, Terms] = {value: [(graph.number(ONE), ONE)]}
    second: dict[int, dict[int, Terms]] = {}
    zero, adjoints = graph.number(ONE - ONE), Adjoints()

    def add(a: int, b: int, node: int, factor: Fraction) -> None:
        if rank[a] < rank[b]:
            a, b = b, a
        second.setdefault(a, {}).setdefault(b, []).append((node, factor))

    for node in order:
        adjoint = adjoints.first[node] = graph.sum(first.pop(node, []))
        row = {other: graph.sum(terms) for other, terms in second.pop(node, {}).items()}
        row = {other: curvature for other, curvature in row.items() if curvature != zero}
        adjoints.second |= {(node, other): curvature for other, curvature in row.items()}
        if node in wanted:
            continue
        # Pass the derivatives with respect to the node on to its arguments.
        by_arguments, curvatures = slopes_of_node(graph, node), _curvatures(graph, node)
        for argument, slope, factor in by_arguments:
            first.setdefault(argument, []).append((_times(graph, adjoint, slope), factor))
        for a, b, curvature in curvatures:
            if curvature != zero:
                add(a, b, graph.times(adjoint, curvature), ONE)
        for other, curvature in row.items():
            for i, (a, slope, factor) in enumerate(by_arguments):
                passed = _times(graph, curvature, slope)
                if other != node:
                    add(a, other, passed, factor * 2 if a == other else factor)
                    continue
                for b, second_slope, second_factor in by_arguments[: i + 1]:
                    add(a, b, _times(graph, passed, second_slope), factor * second_factor)
    return adjoints


def _times(graph: Graph, node: int, slope: int | None) -> int:
    return node if slope is None else graph.times(node, slope)


def _curvatures(graph: Graph, number: int) -> list[tuple[int, int, int]]:
    """Return the second derivatives (a, b, node) with respect to pairs of varying arguments a and b, each pair once."""
    node, varies = graph.nodes[number], graph.varies
    if isinstance(node, Sum):
        return []
    if isinstance(node, Product):
        varying = [factor for factor, _ in node.factors if varies[factor]]
        return [(a, b, _lowered(graph, node, a, b)) for i, a in enumerate(varying) for b in varying[: i + 1]]
    call = graph.call_at(number)
    indices = [(i, a) for i, a in enumerate(call.arguments) if varies[a]]
    return [(a, b, graph.derivative(call, i, j)) for n, (i, a) in enumerate(indices) for j, b in indices[: n + 1]]


def slopes(graph: Graph, value: int, unknowns: Sequence[int]) -> dict[int, int]:
    """Return the first derivative of a value, as a node, for each unknown on which the value depends."""
    wanted = set(unknowns)
    order = [node for node in graph.reachable([value]) if graph.varies[node]]
    depending = set[int]()
    for node in order:
        if node in wanted or not depending.isdisjoint(arguments(graph.nodes[node])):
            depending.add(node)
    contributions: dict[int, Terms] = {value: [(graph.number(ONE), ONE)]}
    adjoints: dict[int, int] = {}
    for node in reversed(order):
        if node not in depending:
            continue
        adjoint = adjoints[node] = graph.sum(contributions.pop(node, []))
        if node in wanted:
            continue
        for argument, slope, factor in slopes_of_node(graph, node):
            if argument in depending:
                contributions.setdefault(argument, []).append((_times(graph, adjoint, slope), factor))
    return {node: adjoint for node, adjoint in adjoints.items() if node in wanted}


def slopes_of_node(graph: Graph, number: int) -> Slopes:
    """Return the first derivatives of a node with respect to its varying arguments, as `Slopes`."""
    node, varies = graph.nodes[number], graph.varies
    if isinstance(node, Sum):
        return [(term, None, coefficient) for term, coefficient in node.terms if varies[term]]
    if isinstance(node, Product):
        return [(factor, _lowered(graph, node, factor), ONE) for factor, _ in node.factors if varies[factor]]
    call = graph.call_at(number)
    return [(a, graph.derivative(call, i), ONE) for i, a in enumerate(call.arguments) if varies[a]]


def _lowered(graph: Graph, product: Product, *factors: int) -> int:
    """Return the node of the derivative of a product with respect to `factors`, one after the other."""
    exponents, coefficient = dict(product.factors), ONE
    for factor in factors:
        coefficient *= exponents[factor]
        exponents[factor] -= 1
    return graph.product(exponents.items(), coefficient)


@dataclass(frozen=True)
class SecondDerivatives:
    """Straight-line programs for the derivatives of a scalar.

    The values of `gradient` are the derivatives with respect to all unknowns, then further expressions. The values
    of `hessian` are the entries of its lower triangle at the `indices` (row, column).
    """

    gradient: StraightLine
    hessian: StraightLine
    indices: tuple[tuple[int, int], ...]


def second_derivatives(scalar: Expr, unknowns: Sequence[Symbol], further: Sequence[Expr] = ()) -> SecondDerivatives:
    """Return programs for the gradient and Hessian of a scalar, without Hessian entries that are identically zero.

    The expressions `further` become more values of the gradient's program.
    """
    graph = Graph(unknowns)
    leaves = range(len(unknowns))
    value, others = graph.of(scalar), [graph.of(expression) for expression in further]
    adjoints = accumulate(graph, value, leaves)
    zero = graph.sum(())
    first = [adjoints.first.get(leaf, zero) for leaf in leaves]
    entries = {(max(pair), min(pair)): node for pair, node in adjoints.second.items() if max(pair) < len(unknowns)}
    absent = vanishing(graph, list(entries.values()))
    indices = tuple(sorted(index for index, node in entries.items() if node not in absent))
    second = [entries[index] for index in indices]
    return SecondDerivatives(program_of(graph, [*first, *others]), program_of(graph, second), indices)


def first_derivatives(scalar: Expr, unknowns: Sequence[Symbol], further: Sequence[Expr] = ()) -> StraightLine:
    """Return a program for the gradient of a scalar; the expressions `further` become more values."""
    graph = Graph(unknowns)
    by_unknown = slopes(graph, graph.of(scalar), range(len(unknowns)))
    zero = graph.sum(())
    roots = [*(by_unknown.get(leaf, zero) for leaf in range(len(unknowns))), *map(graph.of, further)]
    return program_of(graph, roots)


@dataclass(frozen=True)
class MixedDerivatives:
    """A straight-line program for derivatives of a scalar with respect to data, and to unknowns and data.

    Its values are first derivatives at the indices `slopes` of data, then second ones at `entries` (unknown, datum).
    """

    program: StraightLine
    slopes: tuple[int, ...]
    entries: tuple[tuple[int, int], ...]


def mixed_derivatives(scalar: Expr, unknowns: Sequence[Symbol], data: Sequence[Symbol]) -> MixedDerivatives:
    """Return a program as in `MixedDerivatives`, without derivatives that are identically zero."""
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
    """Return a program for values and their Jacobian, and the indices (row, column) of the Jacobian's entries.

    Values that depend on `constants` alone read no assignment. Entries that are identically zero are left out.
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
    """Return a program for expressions, which computes their common parts once."""
    symbols = set[Symbol]().union(*(value.free_symbols for value in values))
    graph = Graph(sorted(symbols, key=lambda symbol: symbol.name))
    return program_of(graph, [graph.of(value) for value in values])


def program_of(graph: Graph, roots: Sequence[int]) -> StraightLine:
    """Return a program for the values of nodes; its symbols x0, x1, ... skip the names of the graph's leaves."""
    taken = {str(node.expression) for node in graph.nodes if isinstance(node, Leaf)}
    smaller, numbers = shared(graph, roots)
    fresh = (Symbol(f"x{i}", real=True) for i in count() if f"x{i}" not in taken)
    return straight_line(smaller, [numbers[root] for root in roots], fresh)


_LONG = 500
"""Number of operations from which derivatives are computed on a graph; sympy.diff reads better for shorter ones."""


def gradient(function: Expr, symbols: Iterable[Symbol]) -> tuple[Expr, ...]:
    """Return the derivatives of a function with respect to symbols, each as one expression."""
    ordered = tuple(symbols)
    if function.count_ops() < _LONG:
        slopes = partials(function, ordered)
        return tuple(slopes.get(symbol, sympy.S.Zero) for symbol in ordered)
    return _along(function, [{symbol: sympy.S.One} for symbol in ordered])


def partials(function: Expr, symbols: Iterable[Symbol]) -> dict[Symbol, Expr]:
    """Return the derivatives with respect to those symbols that occur; a sum is differentiated term by term.

    Each term is differentiated with respect to its own symbols. The time is proportional to the length of a sum whose
    terms have few symbols.
    """
    wanted = dict.fromkeys(symbols)
    terms: dict[Symbol, list[Expr]] = {}
    for term in sympy.Add.make_args(function):
        for symbol in term.free_symbols & wanted.keys():
            terms.setdefault(symbol, []).append(term)
    return {s: sympy.Add(*(sympy.diff(term, s) for term in terms[s])) for s in wanted if s in terms}


def variation(function: Expr, displacements: Mapping[Symbol, Expr]) -> Expr:
    """Return the derivative of a function in the direction in which its symbols have the given displacements."""
    if function.count_ops() >= _LONG:
        return _along(function, [displacements])[0]
    amount = sympy.Dummy("amount", real=True)
    displaced = {symbol: symbol + amount * d for symbol, d in displacements.items()}
    return sympy.diff(function.xreplace(displaced), amount).xreplace({amount: sympy.S.Zero})


def _along(function: Expr, directions: Sequence[Mapping[Symbol, Expr]]) -> tuple[Expr, ...]:
    """Return the derivatives of a function along directions, which map symbols to displacements."""
    graph = Graph(sorted(set().union(*directions), key=lambda symbol: symbol.name))
    value = graph.of(function)
    order = [node for node in graph.reachable([value]) if graph.varies[node]]
    readers: dict[int, list[int]] = {}
    for node in order:
        for argument in arguments(graph.nodes[node]):
            readers.setdefault(argument, []).append(node)
    derivatives = []
    for direction in directions:
        tangents = {graph.of(symbol): graph.of(displacement) for symbol, displacement in direction.items()}
        depending, waiting = set[int](), list(tangents)
        while waiting:
            new = [node for node in readers.get(waiting.pop(), ()) if node not in depending]
            depending.update(new)
            waiting += new
        for node in sorted(depending):
            if node in tangents:
                continue
            tangents[node] = graph.sum(
                (tangents[a] if slope is None else graph.times(slope, tangents[a]), factor)
                for a, slope, factor in slopes_of_node(graph, node)
                if a in tangents
            )
        derivatives.append(tangents.get(value, graph.number(ONE - ONE)))
    return written_out(graph, derivatives)


_DIGITS = 100
_FUNCTIONS = {"Heaviside": lambda x: (1 + mpmath.sign(x)) / 2, "DiracDelta": lambda *_: mpmath.mpf(0)}


def hessian_samples(
    function: Expr, variables: Sequence[Symbol], points: Iterable[Mapping[Symbol, float]]
) -> Iterator[np.ndarray | None]:
    """Yield the Hessian matrix of a function at each point, shape (n, n) for n variables.

    None replaces the matrix if an entry is not a finite real number.
    """
    graph = Graph(variables)
    second = accumulate(graph, graph.of(function), range(len(variables))).second
    inside = {pair: node for pair, node in second.items() if max(pair) < len(variables)}
    absent = vanishing(graph, inside.values())
    entries = {pair: node for pair, node in inside.items() if node not in absent}
    order = graph.reachable(entries.values())
    functions: dict[Expr, Callable[..., mpmath.mpf]] = {}
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


def _values(
    graph: Graph, order: Sequence[int], point: Mapping[Symbol, float], functions: dict[Expr, Callable[..., mpmath.mpf]]
) -> dict[int, mpmath.mpf]:
    """Return the values of the nodes `order`; `functions` caches templates. ArithmeticError if a node has no value."""
    values: dict[int, mpmath.mpf] = {}
    for number in order:
        node = graph.nodes[number]
        if isinstance(node, Leaf):
            leaf = point[node.expression] if node.expression.is_Symbol else node.expression.evalf(_DIGITS + 5)
            values[number] = mpmath.mpmathify(leaf)
        elif isinstance(node, Sum):
            values[number] = precise(node.constant) + sum(precise(c) * values[a] for a, c in node.terms)
        elif isinstance(node, Product):
            values[number] = mpmath.fprod(values[a] ** precise(exponent) for a, exponent in node.factors)
        else:
            if node.template not in functions:
                symbols = sorted(node.template.free_symbols, key=lambda symbol: int(symbol.name[1:]))
                functions[node.template] = sympy.lambdify(symbols, node.template, modules=[_FUNCTIONS, "mpmath"])
            values[number] = functions[node.template](*(values[a] for a in node.arguments))
    return values
