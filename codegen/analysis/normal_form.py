"""Sparse polynomials in variables and adjoined functions, kept in normal form by rewriting.

Sums and products of such polynomials are much faster than those of sympy's expressions, and terms that cancel do so
at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mpmath
import sympy
from sympy import QQ, Expr, Rational, Symbol
from sympy.polys.orderings import lex
from sympy.polys.rings import PolyRing

from codegen.errors import ExpressionError
from codegen.expressions import checks as expressions

Element = Any
"""A polynomial of the ring (sympy's PolyElement)."""
_DIGITS = 60
_ROUNDING = mpmath.mpf("1e-40")


@dataclass
class Generator:
    """A function that has been adjoined: how it is written, and its derivatives once they are known."""

    expression: Expr
    derivatives: Callable[[], tuple[Element, ...]]
    known: tuple[Element, ...] | None = None


class NormalForms:
    """Polynomials over the rationals in variables, constants and generators, which satisfy rules such as s^2 = 1 - c^2.

    There is room for as many generators as there are `slots`.
    """

    def __init__(self, variables: Sequence[Symbol], constants: Sequence[Symbol], slots: int) -> None:
        self.variables = tuple(variables)
        self._symbols = (*variables, *constants)
        self._size = slots + len(self._symbols)
        # What is adjoined later is greater, so that rewriting ends in functions that were there before.
        self.ring = PolyRing([f"g{i}" for i in reversed(range(self._size))], QQ, lex)
        self._adjoined: list[Generator] = []
        self._elements: dict[tuple[Any, ...], Element] = {}
        self._rules: list[tuple[tuple[tuple[int, int], ...], Element]] = []
        self._reciprocals: list[tuple[int, Element]] = []
        self._index = {symbol: self._size - 1 - i for i, symbol in enumerate(self._symbols)}
        self.zero, self.one = self.ring.zero, self.ring.one

    def symbol(self, symbol: Symbol) -> Element:
        """The element that a variable or a constant is."""
        return self.ring.gens[self._index[symbol]]

    def number(self, value: Rational) -> Element:
        """A rational number."""
        return self.ring.ground_new(QQ(int(value.p), int(value.q)))

    def product(self, a: Element, b: Element) -> Element:
        """The product in normal form."""
        return self.reduced(a * b)

    def power(self, base: Element, exponent: int) -> Element:
        """A power with a natural exponent."""
        result = self.one
        for _ in range(exponent):
            result = self.product(result, base)
        return result

    def reduced(self, element: Element) -> Element:
        """Rewrite by the rules of the adjoined functions until none applies."""
        changed = True
        while changed:
            changed = False
            for lead, replacement in self._rules:
                hits = {m: c for m, c in element.items() if all(m[i] >= e for i, e in lead)}
                if not hits:
                    continue
                rest = {m: c for m, c in element.items() if m not in hits}
                divided = {_divided(m, lead): c for m, c in hits.items()}
                element = self.ring.from_dict(rest) + self.ring.from_dict(divided) * replacement
                changed = True
        return element

    def gradient(self, element: Element) -> tuple[Element, ...]:
        """Derivatives by all variables."""
        total = [self.zero] * len(self.variables)
        for index in sorted({i for monomial in element for i, e in enumerate(monomial) if e}):
            outer = element.diff(self.ring.gens[index])
            for a, inner in enumerate(self._slopes(index)):
                if inner:
                    total[a] += outer * inner
        return tuple(self.reduced(part) for part in total)

    def directions(self, field: Sequence[Element]) -> tuple[Element, ...]:
        """The derivative of each generator along a vector field, which has one element for each variable."""
        along = [self.zero] * self._size
        for symbol, component in zip(self.variables, field, strict=True):
            along[self._index[symbol]] = component
        for i, generator in enumerate(self._adjoined):
            pairs = zip(self._derivatives(generator), field, strict=True)
            along[self._slot(i)] = self.reduced(sum((d * f for d, f in pairs if d and f), self.zero))
        return tuple(along)

    def derivative(self, element: Element, directions: Sequence[Element]) -> Element:
        """The derivative of an element when its generators change as `directions` says."""
        parts = (element.diff(x) * along for x, along in zip(self.ring.gens, directions, strict=True) if along)
        return self.reduced(sum(parts, self.zero))

    def vanishes(self, element: Element) -> bool:
        """Whether an element is zero everywhere: in normal form over a common denominator, else at random points.

        Numbers decide, with 60 digits, where functions depend on each other in a way that no rule knows.
        """
        element = self.reduced(element)
        if element == 0:
            return True
        if not self._vanishes_at_points(element, 1):
            return False
        for index, base in reversed(self._reciprocals):
            degree = element.degree(self.ring.gens[index])
            if degree > 0:
                element = self._cleared(element, index, base, degree)
        return element == 0 or self._vanishes_at_points(element, 3)

    def equals(self, element: Element, expression: Expr) -> bool:
        """Whether an element and an expression of sympy have the same value, to 40 digits, at three random points."""
        with mpmath.workdps(_DIGITS):
            for point, values in itertools.islice(self._points(), 3):
                value = sympy.N(expression.xreplace(dict(point)), _DIGITS)
                terms = [_term(m, c, values) for m, c in element.items()]
                scale = mpmath.fsum(map(abs, terms)) + 1
                if not value.is_real or abs(mpmath.fsum(terms) - _number(value)) > _ROUNDING * scale:
                    return False
        return True

    def expression(self, element: Element) -> Expr:
        """The element as an expression of sympy."""
        written = {self._index[symbol]: symbol for symbol in self._symbols}
        written |= {self._slot(i): generator.expression for i, generator in enumerate(self._adjoined)}
        terms = (
            sympy.Mul(sympy.Rational(str(c)), *(written[i] ** e for i, e in enumerate(m) if e))
            for m, c in element.items()
        )
        return sympy.Add(*terms)

    def _adjoin(self, key: tuple[Any, ...], expression: Expr, derivatives: Callable[[], Any]) -> Element:
        if key not in self._elements:
            if self._slot(len(self._adjoined)) < 0:
                raise ExpressionError("more elementary functions than can be expanded", "write a smaller problem")
            self._elements[key] = self.ring.gens[self._slot(len(self._adjoined))]
            self._adjoined.append(Generator(expression, derivatives))
        return self._elements[key]

    def _slot(self, number: int) -> int:
        return self._size - 1 - len(self._symbols) - number

    def _derivatives(self, generator: Generator) -> tuple[Element, ...]:
        if generator.known is None:
            generator.known = generator.derivatives()
        return generator.known

    def _slopes(self, index: int) -> Sequence[Element]:
        """Derivatives of the generator at an index."""
        number = self._size - 1 - index - len(self._symbols)
        if number >= 0:
            return self._derivatives(self._adjoined[number])
        symbol = self._symbols[self._size - 1 - index]
        return [self.one if symbol == variable else self.zero for variable in self.variables]

    def _cleared(self, element: Element, index: int, base: Element, degree: int) -> Element:
        """The element times base^degree, where the generator at `index` is one over the base."""
        total = self.zero
        for power in range(degree + 1):
            part = {(*m[:index], 0, *m[index + 1 :]): c for m, c in element.items() if m[index] == power}
            total += self.ring.from_dict(part) * base ** (degree - power)
        return self.reduced(total)

    def _vanishes_at_points(self, element: Element, count: int) -> bool:
        met = 0
        with mpmath.workdps(_DIGITS):
            for _, values in itertools.islice(self._points(), count):
                terms = [_term(m, c, values) for m, c in element.items()]
                if abs(mpmath.fsum(terms)) > _ROUNDING * mpmath.fsum(map(abs, terms)):
                    return False
                met += 1
        return met == count

    def _points(self) -> Iterator[tuple[Mapping[Symbol, Rational], list[mpmath.mpf]]]:
        """Points at which all generators have values, and these; to be read with _DIGITS digits."""
        for drawn in expressions.sample_points(self._symbols, {}, {}):
            point = {symbol: Rational(str(round(x, 6))) for symbol, x in drawn.items()}
            values = self._values_at(point)
            if values is not None:
                yield point, values

    def _values_at(self, point: Mapping[Symbol, Rational]) -> list[mpmath.mpf] | None:
        """The values of all generators, None where one of them is not a finite real number."""
        values = [mpmath.mpf(0)] * self._size
        for symbol, value in point.items():
            values[self._index[symbol]] = mpmath.mpf(int(value.p)) / int(value.q)
        for i, generator in enumerate(self._adjoined):
            value = sympy.N(generator.expression.xreplace(dict(point)), _DIGITS)
            if not (value.is_finite and value.is_real):
                return None
            values[self._slot(i)] = _number(value)
        return values


def _term(monomial: tuple[int, ...], coefficient: Any, values: Sequence[mpmath.mpf]) -> mpmath.mpf:
    """The value of one term of a polynomial."""
    powers = mpmath.fprod(values[i] ** e for i, e in enumerate(monomial) if e)
    return powers * int(coefficient.numerator) / int(coefficient.denominator)


def _number(value: Expr) -> mpmath.mpf:
    return mpmath.mpf(sympy.Float(value, _DIGITS)._mpf_)


def _divided(monomial: tuple[int, ...], lead: tuple[tuple[int, int], ...]) -> tuple[int, ...]:
    quotient = list(monomial)
    for index, exponent in lead:
        quotient[index] -= exponent
    return tuple(quotient)


def sparse(monomial: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    """The indices and exponents that are not zero."""
    return tuple((i, e) for i, e in enumerate(monomial) if e)
