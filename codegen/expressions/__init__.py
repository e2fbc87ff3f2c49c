"""Derivatives of long expressions, found on a graph of their values and written as straight-line programs.

Plain differentiation of a tree repeats common parts in every derivative, and finding them afterwards takes longer
than all the rest. Here common parts are found first (`graph`), derivatives are accumulated in reverse (`adjoint`), and
what has become common is found again (`sharing`); the time is proportional to the size of the result.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import count

from sympy import Expr, Symbol

from codegen.expressions.adjoint import accumulate, slopes
from codegen.expressions.graph import Graph, Leaf
from codegen.expressions.straight_line import Assignment, StraightLine, shared, straight_line
from codegen.expressions.zeros import vanishing

__all__ = [
    "Assignment",
    "MixedDerivatives",
    "SecondDerivatives",
    "StraightLine",
    "jacobian",
    "mixed_derivatives",
    "program_of",
    "second_derivatives",
    "values_of",
]


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
