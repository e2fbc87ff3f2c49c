"""Expressions as a graph in which equal values have one node (value numbering).

A tree repeats what occurs more than once, and its derivatives repeat it more often still. In the graph every value
has a number, its node; nodes are made from their arguments in a canonical form, so that an equal value made again is
found instead of stored. Canonical forms: a sum has its terms once, in order of their numbers, and no common factor;
a product has its factors once, in order, and no number; numbers are exact fractions. A node's arguments have lower
numbers than itself, hence the order of numbers is one in which values can be computed.

A graph as a straight-line program: short assignments in order, and values in terms of them.

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

import sympy
from sympy import Add, Expr, Mul, Pow, Rational, S, Symbol
from sympy.codegen.cfunctions import expm1, log1p

ZERO, ONE = Fraction(0), Fraction(1)


@dataclass(frozen=True, slots=True)
class Leaf:
    """A symbol, or a constant that is no fraction, such as pi."""

    expression: Expr


@dataclass(frozen=True, slots=True)
class Sum:
    """constant + sum of coefficient * node; a number has no terms."""

    constant: Fraction
    terms: tuple[tuple[int, Fraction], ...]


@dataclass(frozen=True, slots=True)
class Product:
    """The product of node ** exponent."""

    factors: tuple[tuple[int, Fraction], ...]


@dataclass(frozen=True, slots=True)
class Call:
    """A function of nodes: an expression in the symbols `argument(0)`, `argument(1)`, ..."""

    template: Expr
    arguments: tuple[int, ...]


Node = Leaf | Sum | Product | Call


def argument(index: int) -> Symbol:
    """The symbol that stands in a template for the argument at an index."""
    return Symbol(f"_{index}", real=True)


class Graph:
    """Nodes by number; `varies` tells of each whether it depends on an unknown."""

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
        """The number of a node that is in canonical form already."""
        number = self._numbers.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
            self.varies.append(any(self.varies[a] for a in arguments(node)))
        return number

    def number(self, value: Fraction) -> int:
        """The node of a number."""
        return self.add(Sum(value, ()))

    def sum(self, terms: Iterable[tuple[int, Fraction]], constant: Fraction = ZERO) -> int:
        """The node of constant + sum of coefficient * node."""
        total: dict[int, Fraction] = {}
        for node, coefficient in terms:
            factor, core = self.scaled(node)
            if core is None:
                constant += coefficient * factor
            else:
                total[core] = total.get(core, ZERO) + coefficient * factor
        items = tuple(sorted((node, coefficient) for node, coefficient in total.items() if coefficient))
        if constant:
            items, constant = self._with_expm1(items, constant)
        if len(items) + (constant != 0) <= 1:
            return items[0][0] if items and items[0][1] == 1 else self.add(Sum(constant, items))
        # The common factor of a sum: the size that most of its numbers have, with the sign of the first.
        numbers = [*(coefficient for _, coefficient in items), *([constant] if constant else [])]
        sizes = [abs(number) for number in numbers]
        content = max(sizes, key=sizes.count) * (1 if numbers[0] > 0 else -1)
        core = self.add(Sum(constant / content, tuple((node, c / content) for node, c in items)))
        return core if content == 1 else self.add(Sum(ZERO, ((core, content),)))

    def product(self, factors: Iterable[tuple[int, Fraction]], coefficient: Fraction = ONE) -> int:
        """The node of coefficient * product of node ** exponent."""
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
        """The node of a product of nodes."""
        return self.product([(node, ONE) for node in nodes])

    def call(self, template: Expr, indices: tuple[int, ...]) -> int:
        """The node of a function; the logarithm of 1 + x is written without loss of digits."""
        if len(set(indices)) < len(indices):  # equal arguments, such as in atan2(x, x), are one
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
        """The function that a node is, which it must be."""
        node = self.nodes[number]
        assert isinstance(node, Call), "leaves have no arguments"
        return node

    def scaled(self, node: int) -> tuple[Fraction, int | None]:
        """A value as a number times a node that is not; no node where the value is a number."""
        inner = self.nodes[node]
        if isinstance(inner, Sum):
            if not inner.terms:
                return inner.constant, None
            if len(inner.terms) == 1 and not inner.constant:
                return inner.terms[0][1], inner.terms[0][0]
        return ONE, node

    def of(self, expression: Expr, given: Mapping[Symbol, int] | None = None) -> int:
        """The node of an expression; `given` symbols stand for nodes."""
        known: dict[Expr, int] = self._of if given is None else dict(given)
        return self._converted(expression, known)

    def _converted(self, expression: Expr, known: dict[Expr, int]) -> int:
        if expression not in known:
            known[expression] = self._made(expression, known)
        return known[expression]

    def _made(self, expression: Expr, known: dict[Expr, int]) -> int:
        if expression.is_Rational:
            return self.number(_fraction(expression))
        if expression.is_Atom:
            return self.add(Leaf(expression))
        if expression.is_Add:
            return self.sum((self._converted(term, known), ONE) for term in expression.args)
        if expression.is_Mul:
            return self.product((self._converted(factor, known), ONE) for factor in expression.args)
        if expression.is_Pow and expression.exp.is_Rational:
            return self.product([(self._converted(expression.base, known), _fraction(expression.exp))])
        template, parts = _template(expression)
        return self.call(template, tuple(self._converted(part, known) for part in parts))

    def derivative(self, call: Call, *indices: int) -> int:
        """The node of the derivative of a function by the arguments at some indices; kinks have no derivative."""
        template = call.template
        for index in indices:
            key = template, index
            if key not in self._derivatives:
                slope = sympy.diff(template, argument(index))
                self._derivatives[key] = slope.replace(sympy.DiracDelta, lambda *_: S.Zero)
            template = self._derivatives[key]
        return self.of(template, {argument(i): node for i, node in enumerate(call.arguments)})

    def reachable(self, roots: Iterable[int]) -> list[int]:
        """All nodes that some nodes are computed from, themselves included, in order."""
        seen: set[int] = set()
        waiting = list(roots)
        while waiting:
            node = waiting.pop()
            if node not in seen:
                seen.add(node)
                waiting += arguments(self.nodes[node])
        return sorted(seen)

    def independent(self, roots: Iterable[int], of: Iterable[int]) -> bool:
        """Whether some nodes are computed without any of others."""
        return not set(of).intersection(self.reachable(roots))

    def _with_expm1(
        self, items: tuple[tuple[int, Fraction], ...], constant: Fraction
    ) -> tuple[tuple[tuple[int, Fraction], ...], Fraction]:
        """Write c exp(x) - c as c expm1(x), which keeps all digits."""
        for index, (node, coefficient) in enumerate(items):
            inner = self.nodes[node]
            if coefficient == -constant and isinstance(inner, Call) and inner.template == sympy.exp(argument(0)):
                shifted = self.add(Call(expm1(argument(0)), inner.arguments))
                return tuple(sorted([*items[:index], (shifted, coefficient), *items[index + 1 :]])), ZERO
        return items, constant


def arguments(node: Node) -> tuple[int, ...]:
    """The nodes that a node is computed from."""
    if isinstance(node, Sum):
        return tuple(term for term, _ in node.terms)
    if isinstance(node, Product):
        return tuple(factor for factor, _ in node.factors)
    return node.arguments if isinstance(node, Call) else ()


def _fraction(rational: Expr) -> Fraction:
    return Fraction(int(rational.p), int(rational.q))


def _template(expression: Expr) -> tuple[Expr, list[Expr]]:
    """A function with its arguments replaced by symbols, and what they stand for, each once."""
    parts: dict[Expr, Symbol] = {}

    def placed(part: Expr) -> Expr:
        if part in (sympy.true, sympy.false):
            return part
        if isinstance(part, _LOGICAL):
            return part.func(*map(placed, part.args))
        return parts.setdefault(part, argument(len(parts)))

    template = expression.func(*map(placed, expression.args))
    return template, list(parts)


_LOGICAL = (
    sympy.functions.elementary.piecewise.ExprCondPair,
    sympy.core.relational.Relational,
    sympy.And,
    sympy.Or,
    sympy.Not,
)


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
