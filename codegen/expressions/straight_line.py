"""A graph as a straight-line program: short assignments in order, and values in terms of them.

Common parts of sums and products: what occurs together more than once is computed once. The pair of factors, or of
terms, that most products, or sums, have in common becomes a node of its own, and so on until no pair occurs twice.
Source: Breuer (1969), Generation of optimal code for expressions via factorization, Communications of the ACM 12.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from sympy import Add, Expr, Mul, Pow, Rational, Symbol

from codegen.expressions.graph import ONE, ZERO, Call, Graph, Leaf, Product, Sum, argument, arguments

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


Parts = dict[int, Fraction]
"""Factors with exponents, or terms with coefficients."""
Pair = tuple[int, int, Fraction, Fraction]


def shared(graph: Graph, roots: Sequence[int]) -> tuple[Graph, dict[int, int]]:
    """A graph of the same values with common parts, and what the numbers of nodes become in it."""
    nodes = [(number, graph.nodes[number]) for number in graph.reachable(roots)]
    fresh = iter(range(len(graph.nodes), 2**62))
    products = {number: dict(node.factors) for number, node in nodes if isinstance(node, Product)}
    _name_powers(products, fresh)
    _Pairs(products, fresh, proportional=False).share()
    sums = {number: dict(node.terms) for number, node in nodes if isinstance(node, Sum)}
    constants = {number: node.constant for number, node in nodes if isinstance(node, Sum) and node.constant}
    _Pairs(sums, fresh, proportional=True, constants=constants).share()
    return _Rebuilt(graph, products, sums, constants).build(roots)


def _name_powers(products: dict[int, Parts], fresh: Iterator[int]) -> None:
    """Make a node of each power, such as 1/h, that occurs in more than one product."""
    counts = Counter(power for parts in products.values() for power in parts.items() if power[1] != 1)
    alone = {next(iter(parts.items())): number for number, parts in products.items() if len(parts) == 1}
    for power, count in sorted(counts.items()):
        if count < 2:
            continue
        name = alone[power] if power in alone else next(fresh)
        for number, parts in products.items():
            if number != name and parts.get(power[0]) == power[1]:
                del parts[power[0]]
                parts[name] = ONE
        products[name] = dict([power])


class _Pairs:
    """Which pairs of parts occur in which groups (sums or products), and how often.

    Terms with `proportional` coefficients are the same pair, so that 2 a + 2 b is twice a + b.
    """

    def __init__(
        self,
        groups: dict[int, Parts],
        fresh: Iterator[int],
        proportional: bool,
        constants: dict[int, Fraction] | None = None,
    ) -> None:
        self.groups = groups
        self.fresh = fresh
        self.proportional = proportional
        self.constants = constants or {}
        self.users: dict[Pair, set[int]] = {}
        for number, parts in groups.items():
            for pair in self._pairs(parts):
                self.users.setdefault(pair, set()).add(number)
        self.queue = [(-len(users), pair) for pair, users in self.users.items() if len(users) > 1]
        heapq.heapify(self.queue)

    def share(self) -> None:
        """Take out the pair that occurs most often, as long as one occurs twice."""
        while self.queue:
            count, pair = heapq.heappop(self.queue)
            users = self.users[pair]
            if len(users) == -count:
                self._take_out(pair, sorted(users))
            elif len(users) > 1:  # the count has changed since it was queued
                heapq.heappush(self.queue, (-len(users), pair))

    def _take_out(self, pair: Pair, users: list[int]) -> None:
        a, b, weight, other = pair
        alone = [
            n for n in users if len(self.groups[n]) == 2 and self.groups[n][a] == weight and n not in self.constants
        ]
        name = alone[0] if alone else next(self.fresh)
        for number in users:
            if number == name:
                continue
            parts = self.groups[number]
            for former in self._pairs_with((a, b, name), parts):
                self.users[former].discard(number)
            scale = parts[a] / weight if self.proportional else ONE
            del parts[a], parts[b]
            parts[name] = parts.get(name, ZERO) + scale
            if not parts[name]:
                del parts[name]
            for present in self._pairs_with((name,), parts):
                found = self.users.setdefault(present, set())
                found.add(number)
                if len(found) > 1:
                    heapq.heappush(self.queue, (-len(found), present))
        self.groups[name] = {a: weight, b: other}
        self.users[pair].add(name)

    def _pairs(self, parts: Parts) -> Iterator[Pair]:
        items = sorted(parts.items())
        for index, (a, weight) in enumerate(items):
            for b, other in items[index + 1 :]:
                yield self._pair(a, weight, b, other)

    def _pairs_with(self, chosen: Sequence[int], parts: Parts) -> Iterator[Pair]:
        """The pairs of which one at least is among the chosen parts, in no order; some of them twice."""
        for a in chosen:
            if a not in parts:
                continue
            weight = parts[a]
            for b, other in parts.items():
                if a < b:
                    yield self._pair(a, weight, b, other)
                elif b < a:
                    yield self._pair(b, other, a, weight)

    def _pair(self, a: int, weight: Fraction, b: int, other: Fraction) -> Pair:
        return (a, b, ONE, other / weight) if self.proportional else (a, b, weight, other)


class _Rebuilt:
    """The graph of rewritten products and sums; its numbers are again in an order of computation."""

    def __init__(
        self, graph: Graph, products: dict[int, Parts], sums: dict[int, Parts], constants: dict[int, Fraction]
    ) -> None:
        self.old, self.products, self.sums, self.constants = graph, products, sums, constants
        leaves = (node for node, varies in zip(graph.nodes, graph.varies, strict=True) if varies)
        self.new = Graph(leaf.expression for leaf in leaves if isinstance(leaf, Leaf))
        self.numbers: dict[int, int] = {}

    def build(self, roots: Sequence[int]) -> tuple[Graph, dict[int, int]]:
        waiting = list(reversed(roots))
        while waiting:
            missing = [part for part in self._parts(waiting[-1]) if part not in self.numbers]
            if missing and waiting[-1] not in self.numbers:
                waiting += reversed(missing)
                continue
            number = waiting.pop()
            if number not in self.numbers:
                self.numbers[number] = self._made(number)
        return self.new, self.numbers

    def _parts(self, number: int) -> Iterable[int]:
        if number in self.products or number in self.sums:
            return sorted((self.products if number in self.products else self.sums)[number])
        return arguments(self.old.nodes[number])

    def _made(self, number: int) -> int:
        if number in self.products:
            return self.new.add(Product(self._renumbered(self.products[number])))
        if number in self.sums:
            terms, constant = self._renumbered(self.sums[number]), self.constants.get(number, ZERO)
            alone = len(terms) == 1 and terms[0][1] == 1 and not constant
            return terms[0][0] if alone else self.new.add(Sum(constant, terms))
        node = self.old.nodes[number]
        if isinstance(node, Call):
            return self.new.add(Call(node.template, tuple(self.numbers[a] for a in node.arguments)))
        return self.new.add(node)

    def _renumbered(self, parts: Parts) -> tuple[tuple[int, Fraction], ...]:
        return tuple(sorted((self.numbers[part], weight) for part, weight in parts.items()))
