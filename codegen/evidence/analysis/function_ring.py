"""Exact arithmetic with elementary functions: sparse polynomials in variables and in the functions that occur.

A generator is adjoined for each sine, root, reciprocal and so on, with its derivatives and with what it satisfies,
such as sin^2 = 1 - cos^2 or w (2 - cos^2) = 1. Source: the structure theory of elementary functions as in Bronstein
(2005), Symbolic integration I, chapter 3.

Sparse polynomials in variables and adjoined functions, kept in normal form by rewriting.

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
from sympy import QQ, Dummy, Expr, Rational, Symbol
from sympy.polys.orderings import lex
from sympy.polys.rings import PolyRing

from codegen.errors import ExpressionError
from codegen.symbolic import checks as expressions

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


def angles_that_span(angles: Sequence[Expr]) -> tuple[Expr, ...]:
    """Some of the angles of which all are sums with integer coefficients, sums before single terms; or none."""
    simple = {_without_factor(angle) for angle in angles}
    longest = sorted(simple, key=lambda angle: (-len(angle.as_coefficients_dict()), sympy.count_ops(angle), str(angle)))
    terms = sorted({term for angle in simple for term in angle.as_coefficients_dict()}, key=str)
    rows = {angle: [angle.as_coefficients_dict()[term] for term in terms] for angle in longest}
    chosen: list[Expr] = []
    for angle in longest:
        if sympy.Matrix([rows[x] for x in (*chosen, angle)]).rank() > len(chosen):
            chosen.append(angle)
    basis = sympy.Matrix([rows[x] for x in chosen]).T
    for angle in longest:
        factors = weights(basis, rows[angle])
        if not all(weight.is_Integer for weight in factors):
            return ()
    return tuple(chosen)


def _without_factor(angle: Expr) -> Expr:
    numerators = [coefficient.p for coefficient in angle.as_coefficients_dict().values()]
    return sympy.expand(angle / sympy.igcd(0, *numerators))


def weights(basis: sympy.Matrix, row: Sequence[Expr]) -> list[Expr]:
    """The combination of the columns that makes up the row."""
    normal = basis.T * basis
    return list(normal.LUsolve(basis.T * sympy.Matrix(row)))


_SLOTS = 60
"""Generators that there is room for while the functions of a problem are collected."""
_KINKED = (sympy.Abs, sympy.sign, sympy.Min, sympy.Max, sympy.Piecewise, sympy.Heaviside)
_X = Dummy("x", real=True)


class FunctionRing(NormalForms):
    """Polynomials over the rationals in variables, constants and adjoined functions of them.

    `angles` are those by which all others are expressed; without them each term of an angle has its own sine and
    cosine. Raises ExpressionError where a function has a kink or no derivative that is elementary.
    """

    def __init__(
        self, variables: Sequence[Symbol], constants: Sequence[Symbol], slots: int = _SLOTS, angles: Sequence[Expr] = ()
    ) -> None:
        super().__init__(variables, constants, slots)
        self._angles: set[Expr] = set()
        self._basis = [self.function(angle, _X, self.zero) for angle in angles]

    def compressed(self, evaluate_again: Callable[[FunctionRing], object]) -> FunctionRing:
        """A ring without empty slots, in which what is evaluated again adjoins the same functions.

        Angles are expressed by some of them, so that sines and cosines of different angles are independent.
        """
        self.close()
        constants, angles = self._symbols[len(self.variables) :], angles_that_span(sorted(self._angles, key=str))
        roomy = FunctionRing(self.variables, constants, _SLOTS, angles)
        evaluate_again(roomy)
        roomy.close()
        smaller = FunctionRing(self.variables, constants, len(roomy._adjoined), angles)
        evaluate_again(smaller)
        smaller.close()
        return smaller

    def close(self) -> None:
        """Adjoin all derivatives, theirs, and so on."""
        for generator in self._adjoined:  # grows while it is being read
            self._derivatives(generator)

    # Functions

    def function(self, outer: Expr, x: Symbol, argument: Element) -> Element:
        """The value of an expression in one symbol, at an element."""
        if outer == x:
            return argument
        if not outer.has(x):
            return self._constant(outer)
        if isinstance(outer, (sympy.Add, sympy.Mul)):
            parts = [self.function(part, x, argument) for part in outer.args]
            total = parts[0]
            for part in parts[1:]:
                total = total + part if isinstance(outer, sympy.Add) else self.product(total, part)
            return total
        if isinstance(outer, sympy.Pow):
            return self._raised(self.function(outer.base, x, argument), outer.exp)
        return self._applied(outer.func, self.function(_only_argument(outer), x, argument))

    def _constant(self, value: Expr) -> Element:
        if value.is_Rational:
            return self.number(value)
        if value in self._index:
            return self.symbol(value)
        if isinstance(value, sympy.NumberSymbol):
            return self._adjoin(("number", value), value, lambda: (self.zero,) * len(self.variables))
        if isinstance(value, (sympy.Add, sympy.Mul)):
            parts = [self._constant(part) for part in value.args]
            return sum(parts, self.zero) if isinstance(value, sympy.Add) else self.reduced(sympy.prod(parts))
        if isinstance(value, sympy.Pow):
            return self._raised(self._constant(value.base), value.exp)
        return self._applied(value.func, self._constant(_only_argument(value)))

    def _raised(self, base: Element, exponent: Expr) -> Element:
        if exponent.is_Integer:
            whole = int(exponent)
            return self.power(base if whole >= 0 else self.reciprocal(base), abs(whole))
        if exponent.is_Rational:
            root = self._root(base, int(exponent.q))
            return self.power(root if exponent.p > 0 else self.reciprocal(root), abs(int(exponent.p)))
        factor = self._constant(exponent)
        key = ("power", base, factor)

        def derivatives() -> tuple[Element, ...]:
            slope = self.product(self.product(factor, self._elements[key]), self.reciprocal(base))
            return tuple(self.product(slope, d) for d in self.gradient(base))

        return self._adjoin(key, self.expression(base) ** exponent, derivatives)

    def reciprocal(self, base: Element) -> Element:
        """One over an element, as a product of the reciprocals of its factors."""
        if base == 0:
            raise ExpressionError("a denominator of the step vanishes at h = 0", "choose another scheme or form")
        coefficient, factors = base.factor_list()
        result = self.ring.ground_new(1 / coefficient)
        for factor, multiplicity in factors:
            result = self.product(result, self.power(self._reciprocal_of_factor(factor), multiplicity))
        return result

    def _reciprocal_of_factor(self, factor: Element) -> Element:
        for (kind, *details), element in self._elements.items():
            if kind == "root" and details[0] == factor:
                return self.power(self._reciprocal_of_factor(element), details[1])
            if kind == "reciprocal" and element == factor:
                return details[0]
        key = ("reciprocal", factor)
        if key not in self._elements:

            def derivatives() -> tuple[Element, ...]:
                square = self.power(self._elements[key], 2)
                return tuple(-self.product(square, d) for d in self.gradient(factor))

            element = self._adjoin(key, 1 / self.expression(factor), derivatives)
            self._reciprocals.append((self._slot(len(self._adjoined) - 1), factor))
            self._rewrite_product(element, factor)
            for (kind, *details), root in list(self._elements.items()):
                if kind == "root" and root == factor:
                    self._rewrite_product(element ** details[1], details[0])
        return self._elements[key]

    def _rewrite_product(self, reciprocal: Element, base: Element) -> None:
        """The rule reciprocal * base = 1, for the leading term of the base."""
        lead = base.leading_term()
        rest = base - lead
        self._rules.append((sparse((reciprocal * lead).LM), (self.one - reciprocal * rest) * (1 / lead.LC)))

    def _root(self, base: Element, degree: int) -> Element:
        content, primitive = base.primitive()
        if primitive == 1:
            return self._root_of_number(sympy.Rational(str(content)), degree)
        number = self._root_of_number(sympy.Rational(str(content)), degree)
        key = ("root", primitive, degree)
        if key not in self._elements:

            def derivatives() -> tuple[Element, ...]:
                slope = self.power(self.reciprocal(self._elements[key]), degree - 1) * QQ(1, degree)
                return tuple(self.product(slope, d) for d in self.gradient(primitive))

            element = self._adjoin(key, sympy.root(self.expression(primitive), degree), derivatives)
            self._rules.append((sparse((element**degree).LM), primitive))
        return self.product(number, self._elements[key])

    def _root_of_number(self, value: Rational, degree: int) -> Element:
        exact = sympy.root(value, degree)
        if exact.is_Rational:
            return self.number(exact)
        result = self.one
        for factor in sympy.Mul.make_args(exact):
            if factor.is_Rational:
                result = self.product(result, self.number(factor))
                continue
            base, exponent = factor.as_base_exp()
            root = sympy.root(base, int(exponent.q))
            key = ("root", self.number(base), int(exponent.q))
            if key not in self._elements:
                element = self._adjoin(key, root, lambda: (self.zero,) * len(self.variables))
                self._rules.append((sparse((element ** int(exponent.q)).LM), self.number(base)))
            positive = self._elements[key]
            chosen = positive if exponent.p > 0 else self.reciprocal(positive)
            result = self.product(result, self.power(chosen, abs(int(exponent.p))))
        return result

    def _applied(self, function: type[Expr], argument: Element) -> Element:
        if function in (sympy.sin, sympy.cos):
            sine, cosine = self._turned(argument)
            return sine if function is sympy.sin else cosine
        if function is sympy.exp:
            parts = [self._exponential(self.ring.from_dict({m: c})) for m, c in sorted(argument.items())]
            return self.reduced(sympy.prod(parts)) if parts else self.one
        value = function(self.expression(argument))
        if value.is_Rational:
            return self.number(value)
        slope = sympy.diff(function(_X), _X)

        def derivatives() -> tuple[Element, ...]:
            outer = self.function(slope, _X, argument)
            return tuple(self.product(outer, d) for d in self.gradient(argument))

        return self._adjoin((function.__name__, argument), value, derivatives)

    def _exponential(self, exponent: Element) -> Element:
        key = ("exp", exponent)

        def derivatives() -> tuple[Element, ...]:
            return tuple(self.product(self._elements[key], d) for d in self.gradient(exponent))

        return self._adjoin(key, sympy.exp(self.expression(exponent)), derivatives)

    def _turned(self, angle: Element) -> tuple[Element, Element]:
        """Sine and cosine of a sum, by the addition theorems from those of the basis, or else of its terms."""
        if angle != 0:
            self._angles.add(self.expression(angle))
        sine, cosine = self.zero, self.one
        for part, numerator in self._parts(angle):
            s, c = self._circle(part)
            s = s if numerator > 0 else -s
            for _ in range(abs(numerator)):
                sine, cosine = self.reduced(sine * c + cosine * s), self.reduced(cosine * c - sine * s)
        return sine, cosine

    def _parts(self, angle: Element) -> list[tuple[Element, int]]:
        """Angles with integer factors that add up to the given one."""
        if self._basis:
            terms = sorted({m for part in (*self._basis, angle) for m in part})
            columns = [[sympy.Rational(str(part.get(m, 0))) for part in self._basis] for m in terms]
            row = [sympy.Rational(str(angle.get(m, 0))) for m in terms]
            factors = weights(sympy.Matrix(columns), row)
            return [(part, int(n)) for part, n in zip(self._basis, factors, strict=True) if n]
        return [
            (self.ring.from_dict({m: QQ(1, int(c.denominator))}), int(c.numerator)) for m, c in sorted(angle.items())
        ]

    def _circle(self, angle: Element) -> tuple[Element, Element]:
        """Sine and cosine of one term, adjoined together."""
        keys = ("sin", angle), ("cos", angle)
        if keys[0] not in self._elements:
            written = self.expression(angle)

            def scaled(key: tuple[Any, ...], sign: int) -> Callable[[], tuple[Element, ...]]:
                return lambda: tuple(self.product(self._elements[key] * sign, d) for d in self.gradient(angle))

            cosine = self._adjoin(keys[1], sympy.cos(written), scaled(keys[0], -1))
            sine = self._adjoin(keys[0], sympy.sin(written), scaled(keys[1], 1))
            self._rules.append((sparse((sine**2).LM), self.one - cosine**2))
        return self._elements[keys[0]], self._elements[keys[1]]


def _only_argument(value: Expr) -> Expr:
    """The argument of a function of one argument that has derivatives of all orders."""
    if len(value.args) != 1 or isinstance(value, _KINKED):
        raise ExpressionError(f"{value.func.__name__} has no expansion in powers of h", "use smooth functions")
    return value.args[0]
