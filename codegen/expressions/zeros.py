"""Which values vanish identically although their expressions do not show it: the one place where that is decided.

A value counts as zero only where that is proved, in exact arithmetic (`residues`), or where values with ever more
digits become smaller as fast as digits grow, at points of many magnitudes. How small a value is never matters.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import mpmath
import sympy
from sympy import Expr

from codegen.expressions.graph import Call, Graph, Leaf, Product, Sum, argument, arguments
from codegen.expressions.residues import Residues

_DRAWS = 2
"""Evaluations in finite fields that have to be zero; each is so by chance once in 1e15 times."""
_ATTEMPTS = 6
_DIGITS = (40, 80, 160, 320)
_POINTS, _NEEDED = 12, 4
_STABLE, _SHRUNK = 1e-6, 1e-20
_LARGEST = 1e9
"""Of arguments of exponentials and angles: beyond it high precision takes too long."""
_SATURATING = (sympy.tanh, sympy.coth, sympy.atan, sympy.acot, sympy.erf, sympy.erfc)
_GROWING = (sympy.exp, sympy.codegen.cfunctions.expm1, sympy.sin, sympy.cos, sympy.tan, sympy.sinh, sympy.cosh)
_ANALYTIC = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.cot, sympy.sec, sympy.csc, sympy.exp, sympy.log, sympy.Pow),
    *(sympy.asin, sympy.acos, sympy.atan, sympy.sinh, sympy.cosh, sympy.tanh, sympy.coth),
    *(sympy.asinh, sympy.acosh, sympy.atanh, sympy.codegen.cfunctions.log1p, sympy.codegen.cfunctions.expm1),
)


def identically_zero(expression: Expr) -> bool:
    """Whether an expression is proved to be zero everywhere; False also where that is not known."""
    if expression.has(sympy.DiracDelta):  # of kinks; zero almost everywhere, and emitted so
        expression = expression.replace(sympy.DiracDelta, lambda *_: sympy.S.Zero)
    if expression.is_Number or expression.is_Symbol:
        return bool(expression.is_zero)
    if expression.is_Mul:
        return any(map(identically_zero, expression.args))
    if expression.is_Pow:
        return bool(expression.exp.is_positive) and identically_zero(expression.base)
    graph = Graph()
    return bool(vanishing(graph, [graph.of(expression)]))


def vanishing(graph: Graph, roots: Iterable[int]) -> set[int]:
    """Those of the nodes whose values are proved to be zero, whatever their symbols are."""
    scaled = {root: graph.scaled(root) for root in roots}
    structural = {root for root, (factor, core) in scaled.items() if core is None and factor == 0}
    exact, doubtful = _by_residues(graph, {root for root, (_, core) in scaled.items() if core is not None})
    return structural | exact | _by_digits(graph, sorted(doubtful))


def _by_residues(graph: Graph, roots: set[int]) -> tuple[set[int], set[int]]:
    """Nodes that vanish in exact arithmetic, and those of which it does not know all laws."""
    zeros, doubtful, met = set(roots), set[int](), 0
    for seed in range(_ATTEMPTS):
        field = Residues(graph, seed + 1)
        try:
            values = field.evaluate(zeros)
        except ZeroDivisionError:  # a pole by chance, or everywhere
            continue
        met += 1
        doubtful |= {root for root in zeros if values[root] and not field.is_certain(root)}
        zeros = {root for root in zeros if not values[root]}
        if met == _DRAWS or not zeros:
            return zeros, doubtful
    return set(), doubtful


def _by_digits(graph: Graph, roots: Sequence[int]) -> set[int]:
    """Nodes whose values are nothing but rounding, at several points and with ever more digits.

    An analytic function that vanishes at random points vanishes everywhere; one with branches is not asked for. A point
    says nothing about a node that reads a sum in which a term was lost beside larger ones.
    """
    order = graph.reachable(roots)
    branched = _dependent(graph, order, lambda call: not isinstance(call.template, _ANALYTIC))
    candidates = {root: 0 for root in roots if root not in branched}
    generator = random.Random(1)
    for trial in range(_POINTS):
        left = [root for root, count in candidates.items() if count < _NEEDED]
        if not left:
            break
        verdicts = _verdicts(graph, left, generator, trial)
        candidates = {root: count for root, count in candidates.items() if verdicts.get(root, 0) >= 0}
        for root, verdict in verdicts.items():
            if root in candidates:
                candidates[root] += verdict
    return {root for root, count in candidates.items() if count >= _NEEDED}


def _verdicts(graph: Graph, roots: Sequence[int], generator: random.Random, trial: int) -> dict[int, int]:
    """For nodes: 1 where the value at a random point is rounding only, -1 where it is not or in doubt, else 0."""
    order, verdicts = graph.reachable(roots), dict[int, int]()
    symbols = [node.expression for node in map(graph.nodes.__getitem__, order) if isinstance(node, Leaf)]
    point = {symbol: _drawn(generator, trial) for symbol in symbols if symbol.is_Symbol}
    former: dict[int, Any] = {}
    for digits in _DIGITS:
        waiting = [root for root in roots if root not in verdicts]
        evaluation = _Evaluation(graph, point, digits)
        try:
            with mpmath.workdps(digits):
                values = evaluation.values(graph.reachable(waiting))
        except (ArithmeticError, ValueError, TypeError):  # no value there
            return verdicts
        for root in waiting if former else ():
            new, old = values[root], former[root]
            if abs(new - old) < _STABLE * abs(new):
                verdicts[root] = -1
            elif abs(new) <= _SHRUNK * abs(old):
                verdicts[root] = 0 if root in evaluation.absorbed else 1
        if len(verdicts) == len(roots):
            return verdicts
        former = {root: values[root] for root in waiting}
    return dict.fromkeys(roots, -1) | verdicts


def _drawn(generator: random.Random, trial: int) -> float:
    """Ordinary numbers first, then numbers of all magnitudes."""
    if trial % 3 == 0:
        return generator.uniform(0.4, 1.6)
    return generator.choice((-1, 1) if trial % 3 == 1 else (1,)) * 10 ** generator.uniform(-8, 8 if trial > 6 else 2)


class _Evaluation:
    """Values of nodes at a point.

    `absorbed` are those that lost a term of a sum beside larger ones, or what a saturated function differs from 1 by.
    """

    def __init__(self, graph: Graph, point: Mapping[Expr, float], digits: int) -> None:
        self.graph, self.point, self.digits = graph, point, digits
        self.absorbed: set[int] = set()
        self.functions: dict[Expr, Callable[..., Any]] = {}

    def values(self, order: Sequence[int]) -> dict[int, Any]:
        """Values of nodes in the order of computation; ValueError where one is not real or out of reach."""
        known: dict[int, Any] = {}
        for number in order:
            node = self.graph.nodes[number]
            if isinstance(node, Leaf):
                symbolic = node.expression in self.point
                value = mpmath.mpf(self.point[node.expression]) if symbolic else self._constant(node.expression)
            elif isinstance(node, Sum):
                terms = [precise(node.constant), *(precise(c) * known[a] for a, c in node.terms)]
                value = mpmath.fsum(terms)
                self._note(number, [abs(term) for term in terms if term])
            elif isinstance(node, Product):
                value = mpmath.fprod(known[a] ** precise(exponent) for a, exponent in node.factors)
            else:
                value = self._called(number, node, [known[a] for a in node.arguments])
            if not mpmath.isfinite(value) or isinstance(value, mpmath.mpc):
                raise ValueError("no real value")
            if any(a in self.absorbed for a in arguments(node)):
                self.absorbed.add(number)
            known[number] = value
        return known

    def _note(self, number: int, sizes: Sequence[Any]) -> None:
        if sizes and min(sizes) < max(sizes) * mpmath.mpf(10) ** (10 - self.digits):
            self.absorbed.add(number)

    def _called(self, number: int, call: Call, values: Sequence[Any]) -> Any:
        function = call.template.func
        if function in _GROWING + _SATURATING and abs(values[0]) > _LARGEST:
            raise ValueError("out of reach")
        if function in _SATURATING and abs(values[0]) > self.digits / 2:
            self.absorbed.add(number)
        if call.template not in self.functions:
            arguments = [argument(i) for i in range(len(call.arguments))]
            self.functions[call.template] = sympy.lambdify(arguments, call.template, "mpmath")
        return self.functions[call.template](*values)

    def _constant(self, expression: Expr) -> Any:
        return mpmath.mpmathify(expression.evalf(self.digits + 5))


def _dependent(graph: Graph, order: Sequence[int], chosen: Callable[[Call], bool]) -> set[int]:
    """The nodes that are computed from a function of a kind."""
    found: set[int] = set()
    for number in order:
        node = graph.nodes[number]
        if (isinstance(node, Call) and chosen(node)) or any(a in found for a in arguments(node)):
            found.add(number)
    return found


def precise(fraction: Fraction) -> Any:
    """A fraction as a number of mpmath."""
    return mpmath.mpf(fraction.numerator) / fraction.denominator
