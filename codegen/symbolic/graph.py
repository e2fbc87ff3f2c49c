"""Expressions as a graph in which equal values have one node (value numbering), and as straight-line programs.

A tree repeats common parts, and its derivatives repeat them more often still. In the graph every value is a node with a
number. Nodes have a canonical form. A sum has each term once, in order of their node numbers, and no common factor. A
product has each factor once, in order, and no numerical factor. Numbers are exact fractions. So equal values are stored
once. Arguments have lower numbers than their node, so values can be computed in the order of numbers.

A straight-line program has short assignments in order, and values in terms of their symbols. Common parts of sums and
of products are computed once. The most frequent pair of factors (in products) or terms (in sums) becomes a node, until
no pair occurs twice. Source: Breuer (1969), Generation of optimal code for expressions via factorization,
Communications of the ACM 12.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations

import sympy
from sympy import Add, Expr, Mul, Pow, Rational, S, Symbol
from sympy.codegen.cfunctions import expm1, log1p

ZERO, ONE = Fraction(0), Fraction(1)


@dataclass(frozen=True, slots=True)
class Leaf:
    """A symbol, or a constant such as pi that is not a fraction."""

    expression: Expr


@dataclass(frozen=True, slots=True)
class Sum:
    """constant + sum of coefficient * node for the pairs `terms`; a plain number has no terms."""

    constant: Fraction
    terms: tuple[tuple[int, Fraction], ...]


@dataclass(frozen=True, slots=True)
class Product:
    """The product of node ** exponent for the pairs `factors`."""

    factors: tuple[tuple[int, Fraction], ...]


@dataclass(frozen=True, slots=True)
class Call:
    """A function of the nodes `arguments`: a template in the symbols `argument(0)`, `argument(1)`, ..."""

    template: Expr
    arguments: tuple[int, ...]


Node = Leaf | Sum | Product | Call


def argument(index: int) -> Symbol:
    """Return the symbol that stands for argument number `index` in a template."""
    return Symbol(f"_{index}", real=True)


class Graph:
    """Expressions as numbered nodes; `varies[n]` is True if node n depends on an unknown."""

    def __init__(self, unknowns: Iterable[Expr] = ()) -> None:
        self.nodes: list[Node] = []
        self.varies: list[bool] = []
        self._numbers: dict[Node, int] = {}
        self._of: dict[Expr, int] = {}
        self._derivatives: dict[tuple[Expr, int], Expr] = {}
        for unknown in unknowns:
            self.add(Leaf(unknown))
        self.varies = [True] * len(self.nodes)

    def add(self, node: Node) -> int:
        """Return the number of a node in canonical form; a new node is stored."""
        number = self._numbers.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
            self.varies.append(any(self.varies[a] for a in arguments(node)))
        return number

    def number(self, value: Fraction) -> int:
        """Return the node of a numerical constant."""
        return self.add(Sum(value, ()))

    def sum(self, terms: Iterable[tuple[int, Fraction]], constant: Fraction = ZERO) -> int:
        """Return the node of constant + sum of coefficient * node for pairs (node, coefficient)."""
        total: dict[int, Fraction] = {}
        for node, coefficient in terms:
            factor, core = self.scaled(node)
            if core is None:
                constant += coefficient * factor
            else:
                total[core] = total.get(core, ZERO) + coefficient * factor
        items = tuple(sorted((node, coefficient) for node, coefficient in total.items() if coefficient))
        for index, (node, coefficient) in enumerate(items if constant else ()):
            inner = self.nodes[node]
            if coefficient == -constant and isinstance(inner, Call) and inner.template == sympy.exp(argument(0)):
                # c exp(x) - c is written as c expm1(x), which keeps all digits.
                shifted = self.add(Call(expm1(argument(0)), inner.arguments))
                items = tuple(sorted([*items[:index], (shifted, coefficient), *items[index + 1 :]]))
                constant = ZERO
                break
        if len(items) + (constant != 0) <= 1:
            return items[0][0] if items and items[0][1] == 1 else self.add(Sum(constant, items))
        # The common factor of a sum: the most frequent absolute value of its numbers, with the sign of the first.
        numbers = [*(coefficient for _, coefficient in items), *([constant] if constant else [])]
        sizes = [abs(number) for number in numbers]
        content = max(sizes, key=sizes.count) * (1 if numbers[0] > 0 else -1)
        core = self.add(Sum(constant / content, tuple((node, c / content) for node, c in items)))
        return core if content == 1 else self.add(Sum(ZERO, ((core, content),)))

    def product(self, factors: Iterable[tuple[int, Fraction]], coefficient: Fraction = ONE) -> int:
        """Return the node of coefficient * product of node ** exponent for pairs (node, exponent)."""
        total: dict[int, Fraction] = {}
        for node, exponent in factors:
            if exponent.denominator == 1:
                number, core = self.scaled(node)
                coefficient *= number ** int(exponent)
                inner = self.nodes[core] if core is not None else Product(())
                powers = inner.factors if isinstance(inner, Product) else ((core, ONE),)
            else:
                powers = ((node, ONE),)
            for base, power in powers:
                assert base is not None, "a number has no core and no factors"
                total[base] = total.get(base, ZERO) + power * exponent
        items = tuple(sorted((node, exponent) for node, exponent in total.items() if exponent))
        if coefficient == 0 or not items:
            return self.number(coefficient)
        core = items[0][0] if len(items) == 1 and items[0][1] == 1 else self.add(Product(items))
        return self.sum([(core, coefficient)])

    def times(self, *nodes: int) -> int:
        """Return the node of a product of nodes."""
        return self.product([(node, ONE) for node in nodes])

    def call(self, template: Expr, indices: tuple[int, ...]) -> int:
        """Return the node of a template with nodes `indices` as arguments; log(1 + x) becomes the accurate log1p(x)."""
        if len(set(indices)) < len(indices):  # merge equal arguments, such as in atan2(x, x)
            once = {argument(i): argument(indices.index(node)) for i, node in enumerate(indices)}
            return self.of(template.xreplace(once), {argument(i): node for i, node in enumerate(indices)})
        if template == sympy.log(argument(0)):
            factor, core = self.scaled(indices[0])
            inner = self.nodes[core] if core is not None else None
            if isinstance(inner, Sum) and inner.constant * factor == 1:
                terms = [(node, c * factor) for node, c in inner.terms]
                return self.add(Call(log1p(argument(0)), (self.sum(terms),)))
        return self.add(Call(template, indices))

    def call_at(self, number: int) -> Call:
        """Return the node with a number, which must be a function call."""
        node = self.nodes[number]
        assert isinstance(node, Call), "leaves have no arguments"
        return node

    def scaled(self, node: int) -> tuple[Fraction, int | None]:
        """Return the numerical factor of a node and the node without it; a constant has None as second value."""
        inner = self.nodes[node]
        if isinstance(inner, Sum):
            if not inner.terms:
                return inner.constant, None
            if len(inner.terms) == 1 and not inner.constant:
                return inner.terms[0][1], inner.terms[0][0]
        return ONE, node

    def of(self, expression: Expr, symbols: Mapping[Symbol, int] | None = None) -> int:
        """Return the node of an expression; `symbols` assigns existing nodes to symbols."""
        nodes: dict[Expr, int] = self._of if symbols is None else dict(symbols)

        def node_of(part: Expr) -> int:
            if part not in nodes:
                nodes[part] = made(part)
            return nodes[part]

        def made(part: Expr) -> int:
            if part.is_Rational:
                return self.number(_fraction(part))
            if part.is_Atom:
                return self.add(Leaf(part))
            if part.is_Add:
                return self.sum((node_of(term), ONE) for term in part.args)
            if part.is_Mul:
                return self.product((node_of(factor), ONE) for factor in part.args)
            if part.is_Pow and part.exp.is_Rational:
                return self.product([(node_of(part.base), _fraction(part.exp))])
            # Make the template: the function with symbols in place of its distinct arguments.
            operands: dict[Expr, Symbol] = {}

            def placed(operand: Expr) -> Expr:
                if operand in (sympy.true, sympy.false):
                    return operand
                if isinstance(operand, _LOGICAL):
                    return operand.func(*map(placed, operand.args))
                return operands.setdefault(operand, argument(len(operands)))

            template = part.func(*map(placed, part.args))
            return self.call(template, tuple(node_of(operand) for operand in operands))

        return node_of(expression)

    def derivative(self, call: Call, *indices: int) -> int:
        """Return the node of a call's derivative with respect to arguments `indices`; kinks give no delta functions."""
        template = call.template
        for index in indices:
            key = template, index
            if key not in self._derivatives:
                slope = sympy.diff(template, argument(index))
                self._derivatives[key] = slope.replace(sympy.DiracDelta, lambda *_: S.Zero)
            template = self._derivatives[key]
        return self.of(template, {argument(i): node for i, node in enumerate(call.arguments)})

    def reachable(self, roots: Iterable[int]) -> list[int]:
        """Return the roots and all nodes that they depend on, in increasing order."""
        seen: set[int] = set()
        waiting = list(roots)
        while waiting:
            node = waiting.pop()
            if node not in seen:
                seen.add(node)
                waiting += arguments(self.nodes[node])
        return sorted(seen)

    def independent(self, roots: Iterable[int], of: Iterable[int]) -> bool:
        """Return True if the roots depend on no node in `of`, and none of them is in `of`."""
        return not set(of).intersection(self.reachable(roots))


def arguments(node: Node) -> tuple[int, ...]:
    """Return the nodes from which a node is computed directly."""
    if isinstance(node, Sum):
        return tuple(term for term, _ in node.terms)
    if isinstance(node, Product):
        return tuple(factor for factor, _ in node.factors)
    return node.arguments if isinstance(node, Call) else ()


def _fraction(rational: Expr) -> Fraction:
    return Fraction(int(rational.p), int(rational.q))


_LOGICAL = (
    sympy.functions.elementary.piecewise.ExprCondPair,
    sympy.core.relational.Relational,
    sympy.And,
    sympy.Or,
    sympy.Not,
)


Assignment = tuple[Symbol, Expr]

_LONG = 6
"""Number of operations from which a value gets a name, even if it is read only once."""


@dataclass(frozen=True)
class StraightLine:
    """A program: assignments that may read the symbols of earlier assignments, and values that may read all symbols.

    A value that does not depend on unknowns reads no assignment.
    """

    assignments: tuple[Assignment, ...] = ()
    values: tuple[Expr, ...] = ()


def straight_line(graph: Graph, roots: Sequence[int], names: Iterator[Symbol]) -> StraightLine:
    """Return a program for the values of `roots`; long values and values read repeatedly get symbols from `names`."""
    order = graph.reachable(root for root in roots if graph.varies[root])
    outputs = set(roots)
    # Count the reads of each value. A base of a power counts twice, since sympy would multiply the power out.
    uses = Counter(roots)
    for number in order:
        node = graph.nodes[number]
        uses.update(arguments(node))
        if isinstance(node, Product):
            uses.update(factor for factor, exponent in node.factors if abs(exponent) != 1)
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
    """Return the value of each root as one expression."""
    written: dict[int, Expr] = {}
    for number in graph.reachable(roots):
        written[number] = _expression(graph, number, written)
    return tuple(written[root] for root in roots)


def _expression(graph: Graph, number: int, written: Mapping[int, Expr]) -> Expr:
    """Return the expression of a node; `written` has the expressions of its arguments."""
    node = graph.nodes[number]
    if isinstance(node, Leaf):
        return node.expression
    if isinstance(node, Sum):
        scaled = [(_rational(coefficient), written[term]) for term, coefficient in node.terms]
        # sympy would multiply out a multiple of a sum.
        terms = [Mul(c, value, evaluate=not value.is_Add or c == 1) for c, value in scaled]
        return Add(_rational(node.constant), *terms) if len(terms) != 1 or node.constant else terms[0]
    if isinstance(node, Product):
        return Mul(*(Pow(written[factor], _rational(exponent)) for factor, exponent in node.factors))
    return node.template.xreplace({argument(i): written[a] for i, a in enumerate(node.arguments)})


def _rational(number: Fraction) -> Expr:
    return Rational(number.numerator, number.denominator)


def _operations(graph: Graph, number: int) -> int:
    """Return the number of operations of a node, without those inside its arguments; a change of sign counts 0."""
    node = graph.nodes[number]
    if isinstance(node, Leaf):
        return 0
    if isinstance(node, Sum):
        scaled = sum(abs(coefficient) != 1 for _, coefficient in node.terms)
        return scaled + max(0, len(node.terms) + (node.constant != 0) - 1)
    return max(1, len(arguments(node)) - 1)


Parts = dict[int, Fraction]
"""Nodes: the factors of a product with their exponents, or the terms of a sum with their coefficients."""
Pair = tuple[int, int, Fraction, Fraction]


def shared(graph: Graph, roots: Sequence[int]) -> tuple[Graph, dict[int, int]]:
    """Return a graph with common parts of sums and products as nodes, and its node number for each old number."""
    nodes = [(number, graph.nodes[number]) for number in graph.reachable(roots)]
    fresh = iter(range(len(graph.nodes), 2**62))
    products = {number: dict(node.factors) for number, node in nodes if isinstance(node, Product)}
    # A power, such as 1/h, that occurs in more than one product becomes a node.
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
    _take_out_pairs(products, fresh, proportional=False, constants={})
    sums = {number: dict(node.terms) for number, node in nodes if isinstance(node, Sum)}
    constants = {number: node.constant for number, node in nodes if isinstance(node, Sum) and node.constant}
    _take_out_pairs(sums, fresh, proportional=True, constants=constants)
    # Build the graph of rewritten products and sums, with numbers in an order of computation.
    leaves = (node for node, varies in zip(graph.nodes, graph.varies, strict=True) if varies)
    new = Graph(leaf.expression for leaf in leaves if isinstance(leaf, Leaf))
    numbers: dict[int, int] = {}
    waiting = list(reversed(roots))
    while waiting:
        number = waiting[-1]
        group = products.get(number, sums.get(number))
        parts_of_node = arguments(graph.nodes[number]) if group is None else sorted(group)
        missing = [part for part in parts_of_node if part not in numbers]
        if missing and number not in numbers:
            waiting += reversed(missing)
            continue
        waiting.pop()
        if number in numbers:
            continue
        terms = tuple(sorted((numbers[part], weight) for part, weight in (group or {}).items()))
        if number in products:
            numbers[number] = new.add(Product(terms))
        elif number in sums:
            constant = constants.get(number, ZERO)
            is_single = len(terms) == 1 and terms[0][1] == 1 and not constant
            numbers[number] = terms[0][0] if is_single else new.add(Sum(constant, terms))
        else:
            node = graph.nodes[number]
            if isinstance(node, Call):
                node = Call(node.template, tuple(numbers[a] for a in node.arguments))
            numbers[number] = new.add(node)
    return new, numbers


def _take_out_pairs(
    groups: dict[int, Parts], fresh: Iterator[int], proportional: bool, constants: Mapping[int, Fraction]
) -> None:
    """Replace the most frequent pair of parts in the groups (sums or products) by a node, until no pair occurs twice.

    If `proportional`, pairs are equal up to a factor, so that 2 a + 2 b is twice a + b. New nodes have the numbers
    `fresh`. `constants` are the constants of the sums that have one.
    """

    def pair_of(a: int, weight: Fraction, b: int, other: Fraction) -> Pair:
        return (a, b, ONE, other / weight) if proportional else (a, b, weight, other)

    def pairs_with(chosen: Sequence[int], parts: Parts) -> Iterator[Pair]:
        """Yield the pairs with at least one of the chosen parts, some of them twice."""
        for a in chosen:
            if a not in parts:
                continue
            weight = parts[a]
            for b, other in parts.items():
                if a < b:
                    yield pair_of(a, weight, b, other)
                elif b < a:
                    yield pair_of(b, other, a, weight)

    users: dict[Pair, set[int]] = {}  # the numbers of the groups that contain each pair
    for number, parts in groups.items():
        for (a, weight), (b, other) in combinations(sorted(parts.items()), 2):
            users.setdefault(pair_of(a, weight, b, other), set()).add(number)
    queue = [(-len(numbers), pair) for pair, numbers in users.items() if len(numbers) > 1]
    heapq.heapify(queue)
    while queue:
        count, pair = heapq.heappop(queue)
        if len(users[pair]) != -count:  # the count has changed since it was queued
            if len(users[pair]) > 1:
                heapq.heappush(queue, (-len(users[pair]), pair))
            continue
        a, b, weight, other = pair
        numbers = sorted(users[pair])
        alone = [n for n in numbers if len(groups[n]) == 2 and groups[n][a] == weight and n not in constants]
        name = alone[0] if alone else next(fresh)
        for number in numbers:
            if number == name:
                continue
            parts = groups[number]
            for former in pairs_with((a, b, name), parts):
                users[former].discard(number)
            scale = parts[a] / weight if proportional else ONE
            del parts[a], parts[b]
            parts[name] = parts.get(name, ZERO) + scale
            if not parts[name]:
                del parts[name]
            for present in pairs_with((name,), parts):
                users_of_pair = users.setdefault(present, set())
                users_of_pair.add(number)
                if len(users_of_pair) > 1:
                    heapq.heappush(queue, (-len(users_of_pair), present))
        groups[name] = {a: weight, b: other}
        users[pair].add(name)
