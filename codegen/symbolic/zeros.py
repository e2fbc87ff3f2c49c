"""Proof that values vanish identically although their expressions do not show it.

A value counts as zero after a proof by exact arithmetic in finite fields. A second test accepts a value that shrinks as
fast as the number of digits grows, at points of many magnitudes. The size of a value itself never matters.

In a finite field a value is zero only if its expression is zero, except with a probability of 1e-15. Symbols have
random values; sums, products and fractions are exact. A function becomes a random map with its algebraic laws: exp(a)
is the power of a random element whose order is a prime s, with `a` evaluated modulo s. So exp(a + b) is exp(a) exp(b),
and exp(a/2)^2 is exp(a). Sines and cosines are made of such powers with the square root of -1; tan, sinh, cosh and tanh
follow. The root of u is an element whose square is u, with a random sign. Any other function has one law only: equal
arguments have equal values. Sources: Schwartz (1980), Fast probabilistic algorithms for verification of polynomial
identities, JACM 27; Gonnet (1984), Determining equivalence of expressions in random polynomial time, STOC; Monagan and
Gonnet (1994), Signature functions for algebraic numbers, ISSAC.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from functools import cache

import mpmath
import sympy
from sympy import Expr
from sympy.codegen.cfunctions import expm1, log1p
from sympy.ntheory import sqrt_mod

from codegen.symbolic.graph import Call, Graph, Leaf, Node, Product, Sum, argument, arguments

PRIMES = (936163401400647582669834523849, 22851088688748476436971161, 5146641596564972170489, 2305843009213697209)
"""Each prime divides its predecessor minus 1, and modulo each prime -1, 2, 3, 5, 7, 11 and 13 are squares.

Arguments of exponentials and angles are evaluated modulo the next prime, and so on for nested arguments.
"""
_ARGUMENT = argument(0)


class Residues:
    """One random evaluation of the nodes of a graph in finite fields; a pole raises ZeroDivisionError.

    Level k computes modulo PRIMES[k]. `uncertain[k]` are nodes whose nonzero values prove nothing, because the laws of
    a function are missing.
    """

    def __init__(self, graph: Graph, seed: int) -> None:
        levels = range(len(PRIMES))
        self.graph = graph
        self.generator = random.Random(seed)
        self.values: list[dict[int, int]] = [{} for _ in levels]
        self.uncertain: list[set[int]] = [set() for _ in levels]
        self._opaque: dict[tuple[object, ...], int] = {}
        self._radicands: list[set[int]] = [set() for _ in levels]
        self._fractions: dict[tuple[Fraction, int], int] = {}
        self._imaginary = [int(sqrt_mod(prime - 1, prime)) for prime in PRIMES]
        self._steps = [self._in_subgroup(level) for level in levels], [self._in_subgroup(level) for level in levels]

    def evaluate(self, roots: Iterable[int], level: int = 0) -> Mapping[int, int]:
        """Return the values modulo PRIMES[level] of the nodes `roots` and of all nodes that they depend on."""
        values = self.values[level]
        waiting, missing = list(roots), set[int]()
        while waiting:
            number = waiting.pop()
            if number not in missing and number not in values:
                missing.add(number)
                waiting += arguments(self.graph.nodes[number])
        for number in sorted(missing):
            node = self.graph.nodes[number]
            values[number] = self._value(number, node, level)
            if any(a in self.uncertain[level] for a in arguments(node)):
                self.uncertain[level].add(number)
        return values

    def _value(self, number: int, node: Node, level: int) -> int:
        prime, values = PRIMES[level], self.values[level]
        if isinstance(node, Sum):
            total = self._fraction(node.constant, level) if node.constant else 0
            for term, coefficient in node.terms:
                total += values[term] * self._fraction(coefficient, level)
            return total % prime
        if isinstance(node, Product):
            result = 1
            for factor, exponent in node.factors:
                result = result * self._power(number, values[factor], exponent, level) % prime
            return result
        if isinstance(node, Call):
            return self._call(number, node, level)
        expression = node.expression
        if expression.is_Float:
            return self._fraction(Fraction(*map(int, sympy.Rational(expression).as_numer_denom())), level)
        if expression == sympy.E and level + 1 < len(PRIMES):
            return self._steps[0][level]
        if not (expression.is_Symbol or expression == sympy.pi):
            self.uncertain[level].add(number)
        return self._drawn(("leaf", expression), level, self._in_subgroup)

    def _fraction(self, value: Fraction, level: int) -> int:
        if value.denominator == 1:
            return value.numerator
        key = value, level
        if key not in self._fractions:
            self._fractions[key] = value.numerator * _inverse(value.denominator, PRIMES[level]) % PRIMES[level]
        return self._fractions[key]

    def _call(self, number: int, call: Call, level: int) -> int:
        prime, function, arguments = PRIMES[level], call.template.func, call.template.args
        if arguments == (_ARGUMENT,) and level + 1 < len(PRIMES) and function in _EXPONENTIAL:
            argument_node = call.arguments[0]
            exponent = self.evaluate([argument_node], level + 1)[argument_node]
            if argument_node in self.uncertain[level + 1]:
                self.uncertain[level].add(number)
            circular, value = _EXPONENTIAL[function]
            power = pow(self._steps[circular][level], exponent, prime)
            return value(power, _inverse(power, prime), self._imaginary[level], prime) % prime
        values = tuple(self.values[level][a] for a in call.arguments)
        if call.template == sympy.Pow(_ARGUMENT, argument(1)) and level + 1 < len(PRIMES):
            # The laws of powers hold if base^(next prime) = 1, as for symbols.
            exponent = call.arguments[1]
            if pow(values[0], PRIMES[level + 1], prime) == 1:
                if exponent in self.uncertain[level + 1]:
                    self.uncertain[level].add(number)
                return pow(values[0], self.evaluate([exponent], level + 1)[exponent], prime)
            self.uncertain[level].add(number)
            return self._drawn(("power", *values), level)
        self.uncertain[level].add(number)
        if call.template == log1p(_ARGUMENT):
            return self._drawn((sympy.log(_ARGUMENT), (values[0] + 1) % prime), level)
        return self._drawn((call.template, *values), level)

    def _power(self, number: int, value: int, exponent: Fraction, level: int) -> int:
        prime = PRIMES[level]
        if exponent.denominator == 1:
            if exponent < 0 and value == 0:
                raise ZeroDivisionError
            return value if exponent == 1 else pow(value, int(exponent), prime)
        if value == 0:
            if exponent < 0:
                raise ZeroDivisionError
            return 0
        # Roots of several radicands may depend on each other, for example the roots of x, y and x y.
        self._radicands[level].add(value)
        if len(self._radicands[level]) > 1:
            self.uncertain[level].add(number)
        return pow(self._root(number, value, exponent.denominator, level), exponent.numerator, prime)

    def _root(self, number: int, value: int, degree: int, level: int) -> int:
        """Return a root of `value`, the same for equal values; a random element if the field has no such root."""
        prime = PRIMES[level]
        if degree & (degree - 1) == 0:
            if degree > 2:
                value = self._root(number, value, degree // 2, level)
            key = "root", level, value
            if key not in self._opaque:
                root = sqrt_mod(value, prime)
                if root is not None:
                    self._opaque[key] = int(root) * self.generator.choice((-1, 1)) % prime
            if key in self._opaque:
                return self._opaque[key]
        elif level + 1 < len(PRIMES) and pow(value, PRIMES[level + 1], prime) == 1:
            return pow(value, _inverse(degree, PRIMES[level + 1]), prime)
        self.uncertain[level].add(number)
        return self._drawn(("root", value, degree), level)

    def _drawn(self, key: tuple[object, ...], level: int, draw: Callable[[int], int] | None = None) -> int:
        """Return the random element of a key, drawn at the first call and kept for later calls."""
        key = (level, *key)
        if key not in self._opaque:
            self._opaque[key] = draw(level) if draw else self.generator.randrange(2, PRIMES[level])
        return self._opaque[key]

    def _in_subgroup(self, level: int) -> int:
        """Return a random element whose order is the prime of the next level; at the last level any element."""
        element = self.generator.randrange(2, PRIMES[level])
        if level + 1 == len(PRIMES):
            return element
        return pow(element, (PRIMES[level] - 1) // PRIMES[level + 1], PRIMES[level])


def _inverse(value: int, prime: int) -> int:
    if value % prime == 0:
        raise ZeroDivisionError
    return pow(value, -1, prime)


_EXPONENTIAL: dict[type[Expr], tuple[int, Callable[[int, int, int, int], int]]] = {
    sympy.exp: (0, lambda e, f, i, p: e),
    expm1: (0, lambda e, f, i, p: e - 1),
    sympy.sinh: (0, lambda e, f, i, p: (e - f) * _inverse(2, p)),
    sympy.cosh: (0, lambda e, f, i, p: (e + f) * _inverse(2, p)),
    sympy.tanh: (0, lambda e, f, i, p: (e - f) * _inverse(e + f, p)),
    sympy.coth: (0, lambda e, f, i, p: (e + f) * _inverse(e - f, p)),
    sympy.sin: (1, lambda e, f, i, p: (e - f) * _inverse(2 * i, p)),
    sympy.cos: (1, lambda e, f, i, p: (e + f) * _inverse(2, p)),
    sympy.tan: (1, lambda e, f, i, p: (e - f) * _inverse(i * (e + f), p)),
    sympy.cot: (1, lambda e, f, i, p: i * (e + f) * _inverse(e - f, p)),
    sympy.sec: (1, lambda e, f, i, p: 2 * _inverse(e + f, p)),
    sympy.csc: (1, lambda e, f, i, p: 2 * i * _inverse(e - f, p)),
}
"""Functions of a: 0 with e = exp(a), or 1 with e = exp(i a); then the formula in e, f = 1/e, i and the prime p."""


_DRAWS = 2
"""Number of evaluations in finite fields that must be zero; one is zero by chance with probability 1e-15."""
_ATTEMPTS = 6
_DIGITS = (40, 80, 160, 320)
_POINTS, _NEEDED = 12, 4
_STABLE, _SHRUNK = 1e-6, 1e-20
_LARGEST = 1e9
"""Largest argument of exponentials and angles; beyond it high precision takes too long."""
_SATURATING = (sympy.tanh, sympy.coth, sympy.atan, sympy.acot, sympy.erf, sympy.erfc)
_GROWING = (sympy.exp, sympy.codegen.cfunctions.expm1, sympy.sin, sympy.cos, sympy.tan, sympy.sinh, sympy.cosh)
_ANALYTIC = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.cot, sympy.sec, sympy.csc, sympy.exp, sympy.log, sympy.Pow),
    *(sympy.asin, sympy.acos, sympy.atan, sympy.sinh, sympy.cosh, sympy.tanh, sympy.coth),
    *(sympy.asinh, sympy.acosh, sympy.atanh, sympy.codegen.cfunctions.log1p, sympy.codegen.cfunctions.expm1),
)


def identically_zero(expression: Expr) -> bool:
    """Return True if an expression is proved to be zero everywhere, and False if it is nonzero or undecided."""
    if expression.has(sympy.DiracDelta):  # from kinks; zero almost everywhere, also in generated code
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
    """Return the nodes among `roots` whose values are proved to be zero for all values of the symbols."""
    scaled = {root: graph.scaled(root) for root in roots}
    structural = {root for root, (factor, core) in scaled.items() if core is None and factor == 0}
    # Doubtful nodes are nonzero in a finite field, but contain functions whose laws are missing.
    zeros, doubtful, evaluations = {root for root, (_, core) in scaled.items() if core is not None}, set[int](), 0
    for seed in range(_ATTEMPTS):
        field = Residues(graph, seed + 1)
        try:
            values = field.evaluate(zeros)
        except ZeroDivisionError:  # a pole by chance, or everywhere
            continue
        evaluations += 1
        doubtful |= {root for root in zeros if values[root] and root in field.uncertain[0]}
        zeros = {root for root in zeros if not values[root]}
        if evaluations == _DRAWS or not zeros:
            break
    else:
        zeros = set()
    return structural | zeros | _by_digits(graph, sorted(doubtful))


def _by_digits(graph: Graph, roots: Sequence[int]) -> set[int]:
    """Return the nodes whose values are only rounding errors at several points, with more and more digits.

    An analytic function that vanishes at random points vanishes everywhere; functions with branches are left out. A
    point decides nothing about a node that depends on a sum whose larger terms absorbed a small term.
    """
    branched = set[int]()  # nodes that depend on a function with branches
    for number in graph.reachable(roots):
        node = graph.nodes[number]
        is_branched = isinstance(node, Call) and not isinstance(node.template, _ANALYTIC)
        if is_branched or any(a in branched for a in arguments(node)):
            branched.add(number)
    candidates = {root: 0 for root in roots if root not in branched}
    generator = random.Random(1)
    for trial in range(_POINTS):
        undecided = [root for root, count in candidates.items() if count < _NEEDED]
        if not undecided:
            break
        verdicts = _verdicts(graph, undecided, generator, trial)
        candidates = {root: count for root, count in candidates.items() if verdicts.get(root, 0) >= 0}
        for root, verdict in verdicts.items():
            if root in candidates:
                candidates[root] += verdict
    return {root for root, count in candidates.items() if count >= _NEEDED}


def _verdicts(graph: Graph, roots: Sequence[int], generator: random.Random, trial: int) -> dict[int, int]:
    """Return verdicts on nodes at a random point: 1 if only rounding error, 0 or none if undecided, -1 otherwise."""
    order, verdicts = graph.reachable(roots), dict[int, int]()
    symbols = [node.expression for node in map(graph.nodes.__getitem__, order) if isinstance(node, Leaf)]
    point = {symbol: _drawn(generator, trial) for symbol in symbols if symbol.is_Symbol}
    former: dict[int, mpmath.mpf] = {}
    for digits in _DIGITS:
        waiting = [root for root in roots if root not in verdicts]
        try:
            with mpmath.workdps(digits):
                values, absorbed = _evaluated(graph, graph.reachable(waiting), point, digits)
        except (ArithmeticError, ValueError, TypeError):  # no value at the point
            return verdicts
        for root in waiting if former else ():
            new, old = values[root], former[root]
            if abs(new - old) < _STABLE * abs(new):
                verdicts[root] = -1
            elif abs(new) <= _SHRUNK * abs(old):
                verdicts[root] = 0 if root in absorbed else 1
        if len(verdicts) == len(roots):
            return verdicts
        former = {root: values[root] for root in waiting}
    return dict.fromkeys(roots, -1) | verdicts


def _drawn(generator: random.Random, trial: int) -> float:
    """Return a random number: in every third trial of ordinary size, otherwise of any magnitude."""
    if trial % 3 == 0:
        return generator.uniform(0.4, 1.6)
    return generator.choice((-1, 1) if trial % 3 == 1 else (1,)) * 10 ** generator.uniform(-8, 8 if trial > 6 else 2)


def _evaluated(
    graph: Graph, order: Sequence[int], point: Mapping[Expr, float], digits: int
) -> tuple[dict[int, mpmath.mpf], set[int]]:
    """Return the values of the nodes `order`, and the nodes whose values lack digits.

    Digits are missing if larger terms absorbed a term, or if a function such as tanh is too close to 1. ValueError if
    a value is not real, or if its computation would take too long.
    """
    values: dict[int, mpmath.mpf] = {}
    absorbed: set[int] = set()
    for number in order:
        node = graph.nodes[number]
        if isinstance(node, Leaf):
            if node.expression in point:
                value = mpmath.mpf(point[node.expression])
            else:
                value = mpmath.mpmathify(node.expression.evalf(digits + 5))
        elif isinstance(node, Sum):
            terms = [precise(node.constant), *(precise(c) * values[a] for a, c in node.terms)]
            value = mpmath.fsum(terms)
            sizes = [abs(term) for term in terms if term]
            if sizes and min(sizes) < max(sizes) * mpmath.mpf(10) ** (10 - digits):
                absorbed.add(number)
        elif isinstance(node, Product):
            value = mpmath.fprod(values[a] ** precise(exponent) for a, exponent in node.factors)
        else:
            operands, function = [values[a] for a in node.arguments], node.template.func
            if function in _GROWING + _SATURATING and abs(operands[0]) > _LARGEST:
                raise ValueError("out of reach")
            if function in _SATURATING and abs(operands[0]) > digits / 2:
                absorbed.add(number)
            value = _of_mpmath(node.template, len(operands))(*operands)
        if not mpmath.isfinite(value) or isinstance(value, mpmath.mpc):
            raise ValueError("no real value")
        if any(a in absorbed for a in arguments(node)):
            absorbed.add(number)
        values[number] = value
    return values, absorbed


@cache
def _of_mpmath(template: Expr, count: int) -> Callable[..., mpmath.mpf]:
    """Return a template with `count` arguments as a function of mpmath numbers."""
    return sympy.lambdify([argument(i) for i in range(count)], template, "mpmath")  # type: ignore[no-any-return]


def precise(fraction: Fraction) -> mpmath.mpf:
    """Return a fraction as a number of mpmath."""
    return mpmath.mpf(fraction.numerator) / fraction.denominator
