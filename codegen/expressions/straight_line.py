"""A graph as a straight-line program: short assignments in order, and values in terms of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from sympy import Add, Expr, Mul, Pow, Rational, Symbol

from codegen.expressions.graph import Graph, Leaf, Product, Sum, argument, arguments

Assignment = tuple[Symbol, Expr]

_LONG = 6
"""Operations from which on a value gets a name even if it is read once only."""


@dataclass(frozen=True)
class StraightLine:
    """`values` may read the symbols of `assignments`, and each of these the ones before it.

    A value that does not depend on unknowns reads no assignment.
    """

    assignments: tuple[Assignment, ...] = ()
    values: tuple[Expr, ...] = ()


def straight_line(graph: Graph, roots: Sequence[int], names: Iterator[Symbol]) -> StraightLine:
    """Write the values of `roots`; what is read more than once, or is long, is assigned to the next of the names."""
    order = graph.reachable(root for root in roots if graph.varies[root])
    uses, outputs = _uses(graph, order, roots), set(roots)
    written: dict[int, Expr] = {}
    lengths: dict[int, int] = {}
    assignments: list[Assignment] = []
    for number in order:
        written[number] = _expression(graph, number, written)
        lengths[number] = _operations(graph, number) + sum(lengths[a] for a in arguments(graph.nodes[number]))
        read_once = uses[number] < 2 and (lengths[number] < _LONG or number in outputs)
        if not (read_once or lengths[number] == 0):
            symbol = next(names)
            assignments.append((symbol, written[number]))
            written[number], lengths[number] = symbol, 0
    constant = [root for root in roots if not graph.varies[root]]
    written |= dict(zip(constant, written_out(graph, constant), strict=True))
    values = tuple(written[root] for root in roots)
    return StraightLine(tuple(assignments), values)


def written_out(graph: Graph, roots: Sequence[int]) -> tuple[Expr, ...]:
    """Values as one expression each."""
    written: dict[int, Expr] = {}
    for number in graph.reachable(roots):
        written[number] = _expression(graph, number, written)
    return tuple(written[root] for root in roots)


def _expression(graph: Graph, number: int, written: Mapping[int, Expr]) -> Expr:
    node = graph.nodes[number]
    if isinstance(node, Leaf):
        return node.expression
    if isinstance(node, Sum):
        terms = [_scaled(_rational(coefficient), written[term]) for term, coefficient in node.terms]
        return Add(_rational(node.constant), *terms) if len(terms) != 1 or node.constant else terms[0]
    if isinstance(node, Product):
        return Mul(*(Pow(written[factor], _rational(exponent)) for factor, exponent in node.factors))
    return node.template.xreplace({argument(i): written[a] for i, a in enumerate(node.arguments)})


def _scaled(coefficient: Expr, value: Expr) -> Expr:
    """A multiple of a value; sympy would multiply out that of a sum."""
    return Mul(coefficient, value, evaluate=not value.is_Add or coefficient == 1)


def _rational(number: Fraction) -> Expr:
    return Rational(number.numerator, number.denominator)


def _uses(graph: Graph, order: Sequence[int], roots: Sequence[int]) -> Counter[int]:
    """How often each value is read; what is raised to a power counts twice, since sympy would multiply it out."""
    uses = Counter(roots)
    for number in order:
        node = graph.nodes[number]
        uses.update(arguments(node))
        if isinstance(node, Product):
            uses.update(factor for factor, exponent in node.factors if abs(exponent) != 1)
    return uses


def _operations(graph: Graph, number: int) -> int:
    """The operations of a node by itself; a change of sign is none."""
    node = graph.nodes[number]
    if isinstance(node, Leaf):
        return 0
    if isinstance(node, Sum):
        scaled = sum(abs(coefficient) != 1 for _, coefficient in node.terms)
        return scaled + max(0, len(node.terms) + (node.constant != 0) - 1)
    return max(1, len(arguments(node)) - 1)
