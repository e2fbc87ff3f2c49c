"""Expressions as a graph in which equal values have one node (value numbering).

A tree repeats what occurs more than once, and its derivatives repeat it more often still. In the graph every value
has a number, its node; nodes are made from their arguments in a canonical form, so that an equal value made again is
found instead of stored. Canonical forms: a sum has its terms once, in order of their numbers, and no common factor;
a product has its factors once, in order, and no number; numbers are exact fractions. A node's arguments have lower
numbers than itself, hence the order of numbers is one in which values can be computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction

import sympy
from sympy import Expr, S, Symbol
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
