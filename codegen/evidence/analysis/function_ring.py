"""Exact arithmetic with elementary functions: sparse polynomials in variables and functions, and power series of them.

Each sine, root, reciprocal and so on is adjoined to the polynomials as a new generator (symbol). A generator has
derivatives and satisfies a rule such as sin^2 = 1 - cos^2 or w (2 - cos^2) = 1. Rewriting by these rules keeps
polynomials in normal form. Source: the structure theory in Bronstein (2005), Symbolic integration I, chapter 3.

Sums and products are much faster than with sympy's expressions, and terms cancel at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import mpmath
import sympy
from sympy import QQ, Dummy, Expr, Rational, Symbol
from sympy.polys.orderings import lex
from sympy.polys.rings import PolyElement, PolyRing

from codegen.discretise.interval import STEP
from codegen.errors import ExpressionError
from codegen.symbolic import checks as expressions

Element: TypeAlias = PolyElement
Key: TypeAlias = tuple[Any, ...]
"""The kind of a function, and its elements and numbers, for example ("root", base, degree)."""
_DIGITS = 60
_ROUNDING = mpmath.mpf("1e-40")
_SLOTS = 60  # largest number of generators while the functions of a problem are collected
_KINKED = (sympy.Abs, sympy.sign, sympy.Min, sympy.Max, sympy.Piecewise, sympy.Heaviside)
_X = Dummy("x", real=True)


@dataclass
class Generator:
    """An adjoined function of `argument`: its expression, and its slope with respect to the argument.

    The derivatives with respect to all variables are None until they are first used.
    """

    expression: Expr
    slope: Callable[[], Element]
    argument: Element
    derivatives: tuple[Element, ...] | None = None


class FunctionRing:
    """Polynomials with rational coefficients in variables, constants and up to `slots` adjoined functions of them.

    `numbers` replace variables. `angles` are a basis of all angles. Without a basis each term of an angle has its own
    sine and cosine. Raises ExpressionError if a function has a kink or no elementary derivative.
    """

    def __init__(
        self, variables: Sequence[Symbol], constants: Sequence[Symbol],
        numbers: Mapping[Symbol, Rational] | None = None, slots: int = _SLOTS, angles: Sequence[Expr] = (),
    ) -> None:  # fmt: skip
        self.variables, self._numbers = tuple(variables), numbers or {}
        self._symbols = (*variables, *constants)
        self._size = slots + len(self._symbols)
        # Later generators are greater in the order of monomials, so that rewriting ends in earlier functions.
        self.ring = PolyRing([f"g{i}" for i in reversed(range(self._size))], QQ, lex)
        self._adjoined: list[Generator] = []
        self._elements: dict[Key, Element] = {}
        self._rules: list[tuple[tuple[tuple[int, int], ...], Element]] = []
        self._reciprocals: list[tuple[int, Element]] = []
        self._index = {symbol: self._size - 1 - i for i, symbol in enumerate(self._symbols)}
        self.zero, self.one = self.ring.zero, self.ring.one
        self._angles: set[Expr] = set()
        self._basis: list[Element] = []
        self._basis = [self.function(angle, _X, self.zero) for angle in angles]

    def symbol(self, symbol: Symbol) -> Element:
        """Return the element of a variable or a constant."""
        if symbol in self._numbers:
            return self.number(self._numbers[symbol])
        return self.ring.gens[self._index[symbol]]

    def number(self, value: Rational) -> Element:
        """Return the element of a rational number."""
        return self.ring.ground_new(QQ(int(value.p), int(value.q)))

    def product(self, a: Element, b: Element) -> Element:
        """Return the product in normal form."""
        return self.reduced(a * b)

    def power(self, base: Element, exponent: int) -> Element:
        """Return a power with a natural exponent."""
        result = self.one
        for _ in range(exponent):
            result = self.product(result, base)
        return result

    def reduced(self, element: Element) -> Element:
        """Return the normal form of an element, by the rules of the adjoined functions."""
        changed = True
        while changed:
            changed = False
            for lead, replacement in self._rules:
                hits = {m: c for m, c in element.items() if all(m[i] >= e for i, e in lead)}
                if not hits:
                    continue
                rest = {m: c for m, c in element.items() if m not in hits}
                divided = {}
                for monomial, coefficient in hits.items():
                    quotient = list(monomial)
                    for index, exponent in lead:
                        quotient[index] -= exponent
                    divided[tuple(quotient)] = coefficient
                element = self.ring.from_dict(rest) + self.ring.from_dict(divided) * replacement
                changed = True
        return element

    def gradient(self, element: Element) -> tuple[Element, ...]:
        """Return the derivatives of an element with respect to all variables."""
        total = [self.zero] * len(self.variables)
        for index in sorted({i for monomial in element for i, e in enumerate(monomial) if e}):
            outer, number = element.diff(self.ring.gens[index]), self._size - 1 - index - len(self._symbols)
            if number >= 0:
                slopes = self._derivatives(self._adjoined[number])
            else:
                symbol = self._symbols[self._size - 1 - index]
                slopes = tuple(self.one if symbol == variable else self.zero for variable in self.variables)
            for a, inner in enumerate(slopes):
                if inner:
                    total[a] += outer * inner
        return tuple(self.reduced(part) for part in total)

    def directions(self, field: Sequence[Element]) -> tuple[Element, ...]:
        """Return the derivatives of all symbols of the ring along a vector field with a component for each variable."""
        along = [self.zero] * self._size
        for symbol, component in zip(self.variables, field, strict=True):
            along[self._index[symbol]] = component
        for i, generator in enumerate(self._adjoined):
            pairs = zip(self._derivatives(generator), field, strict=True)
            along[self._slot(i)] = self.reduced(sum((d * f for d, f in pairs if d and f), self.zero))
        return tuple(along)

    def derivative(self, element: Element, directions: Sequence[Element]) -> Element:
        """Return the derivative of an element along a vector field, from the derivatives `directions` of symbols."""
        parts = (element.diff(x) * along for x, along in zip(self.ring.gens, directions, strict=True) if along)
        return self.reduced(sum(parts, self.zero))

    def vanishes(self, element: Element) -> bool:
        """Return True if an element is zero everywhere: in normal form over a common denominator, or at random points.

        Random points, with 60 digits, decide if functions depend on each other in a way that no rule expresses.
        """
        element = self.reduced(element)
        if element == 0:
            return True
        if not self._vanishes_at_points(element, 1):
            return False
        for index, base in reversed(self._reciprocals):
            degree = element.degree(self.ring.gens[index])
            if degree > 0:  # the element times base^degree, because the generator is one over the base
                total = self.zero
                for power in range(degree + 1):
                    part = {(*m[:index], 0, *m[index + 1 :]): c for m, c in element.items() if m[index] == power}
                    total += self.ring.from_dict(part) * base ** (degree - power)
                element = self.reduced(total)
        return element == 0 or self._vanishes_at_points(element, 3)

    def equals(self, element: Element, expression: Expr) -> bool:
        """Return True if an element and an expression of sympy agree to 40 digits at three random points."""
        with mpmath.workdps(_DIGITS):
            for point, values in itertools.islice(self._points(), 3):
                value = sympy.N(expression.xreplace(dict(point)), _DIGITS)
                terms = [_term(m, c, values) for m, c in element.items()]
                scale = mpmath.fsum(map(abs, terms)) + 1
                if not value.is_real or abs(mpmath.fsum(terms) - _number(value)) > _ROUNDING * scale:
                    return False
        return True

    def expression(self, element: Element) -> Expr:
        """Return the element as an expression of sympy."""
        factors = {self._index[symbol]: symbol for symbol in self._symbols}
        factors |= {self._slot(i): generator.expression for i, generator in enumerate(self._adjoined)}
        terms = (
            sympy.Mul(sympy.Rational(str(c)), *(factors[i] ** e for i, e in enumerate(m) if e))
            for m, c in element.items()
        )
        return sympy.Add(*terms)

    def _adjoin(self, key: Key, expression: Expr, slope: Callable[[], Element], argument: Element) -> Element:
        if key not in self._elements:
            if self._slot(len(self._adjoined)) < 0:
                raise ExpressionError("more elementary functions than can be expanded", "write a smaller problem")
            self._elements[key] = self.ring.gens[self._slot(len(self._adjoined))]
            self._adjoined.append(Generator(expression, slope, argument))
        return self._elements[key]

    def _slot(self, number: int) -> int:
        return self._size - 1 - len(self._symbols) - number

    def _derivatives(self, generator: Generator) -> tuple[Element, ...]:
        if generator.derivatives is None:
            slope = generator.slope()
            generator.derivatives = tuple(self.product(slope, d) for d in self.gradient(generator.argument))
        return generator.derivatives

    def _vanishes_at_points(self, element: Element, count: int) -> bool:
        points = 0
        with mpmath.workdps(_DIGITS):
            for _, values in itertools.islice(self._points(), count):
                terms = [_term(m, c, values) for m, c in element.items()]
                if abs(mpmath.fsum(terms)) > _ROUNDING * mpmath.fsum(map(abs, terms)):
                    return False
                points += 1
        return points == count

    def _points(self) -> Iterator[tuple[Mapping[Symbol, Rational], list[mpmath.mpf]]]:
        """Yield random points and the values of all generators there, which are mpmath numbers with _DIGITS digits."""
        for drawn in expressions.sample_points(self._symbols, {}, {}):
            point = {symbol: Rational(str(round(x, 6))) for symbol, x in drawn.items()}
            values = [mpmath.mpf(0)] * self._size
            for symbol, value in point.items():
                values[self._index[symbol]] = mpmath.mpf(int(value.p)) / int(value.q)
            for i, generator in enumerate(self._adjoined):
                value = sympy.N(generator.expression.xreplace(point), _DIGITS)
                if not (value.is_finite and value.is_real):
                    break
                values[self._slot(i)] = _number(value)
            else:
                yield point, values

    def compressed(self, evaluate_again: Callable[[FunctionRing], object]) -> FunctionRing:
        """Return a ring without unused slots. `evaluate_again(ring)` repeats the evaluation, to adjoin its functions.

        The ring has a basis of angles, so that sines and cosines of different angles are independent.
        """
        self.close()
        constants, angles = self._symbols[len(self.variables) :], angles_that_span(sorted(self._angles, key=str))
        ring, slots = self, _SLOTS
        for _ in range(2):  # with the basis of angles, then with as many slots as functions
            ring = FunctionRing(self.variables, constants, self._numbers, slots, angles)
            evaluate_again(ring)
            ring.close()
            slots = len(ring._adjoined)
        return ring

    def close(self) -> None:
        """Adjoin all functions in the derivatives of any order."""
        for generator in self._adjoined:  # grows during the loop
            self._derivatives(generator)

    def function(self, outer: Expr, x: Symbol, argument: Element) -> Element:
        """Return the element that the expression `outer` gives with the element `argument` in place of x."""
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
            return self._adjoin(("number", value), value, lambda: self.zero, self.zero)
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

        def slope() -> Element:
            return self.product(self.product(factor, self._elements[key]), self.reciprocal(base))

        return self._adjoin(key, self.expression(base) ** exponent, slope, base)

    def reciprocal(self, base: Element) -> Element:
        """Return one over an element, as the product of the reciprocals of its factors."""
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
            inverse = 1 / self.expression(factor)
            element = self._adjoin(key, inverse, lambda: -self.power(self._elements[key], 2), factor)
            self._reciprocals.append((self._slot(len(self._adjoined) - 1), factor))
            self._rewrite_product(element, factor)
            for (kind, *details), root in list(self._elements.items()):
                if kind == "root" and root == factor:
                    self._rewrite_product(element ** details[1], details[0])
        return self._elements[key]

    def _rewrite_product(self, reciprocal: Element, base: Element) -> None:
        """Add the rule reciprocal * base = 1 for the leading term of the base."""
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

            def slope() -> Element:
                return self.power(self.reciprocal(self._elements[key]), degree - 1) * QQ(1, degree)

            element = self._adjoin(key, sympy.root(self.expression(primitive), degree), slope, primitive)
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
                element = self._adjoin(key, root, lambda: self.zero, self.zero)
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
            total = self.one
            for part in (self.ring.from_dict({m: c}) for m, c in sorted(argument.items())):
                key = ("exp", part)
                slope = partial(self._elements.__getitem__, key)
                total = self.product(total, self._adjoin(key, sympy.exp(self.expression(part)), slope, part))
            return total
        value = function(self.expression(argument))
        if value.is_Rational:
            return self.number(value)
        slope = sympy.diff(function(_X), _X)
        key = (function.__name__, argument)
        return self._adjoin(key, value, lambda: self.function(slope, _X, argument), argument)

    def _turned(self, angle: Element) -> tuple[Element, Element]:
        """Return sine and cosine of an angle by the addition theorems, from the basis of angles or from its terms."""
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
        """Return (angle, integer factor) pairs whose products add up to `angle`."""
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
        """Return sine and cosine of an angle without addition theorems. Both are adjoined together."""
        keys = ("sin", angle), ("cos", angle)
        if keys[0] not in self._elements:
            expression = self.expression(angle)
            cosine = self._adjoin(keys[1], sympy.cos(expression), lambda: -self._elements[keys[0]], angle)
            sine = self._adjoin(keys[0], sympy.sin(expression), lambda: self._elements[keys[1]], angle)
            self._rules.append((sparse((sine**2).LM), self.one - cosine**2))
        return self._elements[keys[0]], self._elements[keys[1]]


def _term(monomial: tuple[int, ...], coefficient: Rational, values: Sequence[mpmath.mpf]) -> mpmath.mpf:
    """Return the value of one term of a polynomial, for the values of all symbols of the ring."""
    powers = mpmath.fprod(values[i] ** e for i, e in enumerate(monomial) if e)
    return powers * int(coefficient.numerator) / int(coefficient.denominator)


def _number(value: Expr) -> mpmath.mpf:
    return mpmath.mpf(sympy.Float(value, _DIGITS)._mpf_)


def sparse(monomial: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    """Return the pairs (index, exponent) of a monomial whose exponent is not zero."""
    return tuple((i, e) for i, e in enumerate(monomial) if e)


def angles_that_span(angles: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return some of the angles, preferably sums, whose integer combinations give all angles; empty if impossible."""
    simple = set[Expr]()
    for angle in angles:  # without its integer factor
        numerators = [coefficient.p for coefficient in angle.as_coefficients_dict().values()]
        simple.add(sympy.expand(angle / sympy.igcd(0, *numerators)))
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


def weights(basis: sympy.Matrix, row: Sequence[Expr]) -> list[Expr]:
    """Return the coefficients with which the columns of `basis` add up to the vector `row`."""
    normal = basis.T * basis
    return list(normal.LUsolve(basis.T * sympy.Matrix(row)))


def _only_argument(value: Expr) -> Expr:
    """Return the only argument of a function. Raise ExpressionError for kinks and for several arguments."""
    if len(value.args) != 1 or isinstance(value, _KINKED):
        raise ExpressionError(f"{value.func.__name__} has no expansion in powers of h", "use smooth functions")
    return value.args[0]


Series = list[Element]
"""The coefficients of h^0, h^1, ... in a power series, up to an order."""


def padded(values: Sequence[Element], ring: FunctionRing, order: int) -> Series:
    """Return the series with coefficients `values`, cut or filled with zeros to end at h^order."""
    return [*values[: order + 1], *[ring.zero] * (order + 1 - len(values))]


class Evaluation:
    """The evaluation of expressions whose symbols are power series, by Taylor's formula, each common part once."""

    def __init__(self, ring: FunctionRing, values: Mapping[Symbol, Series], order: int) -> None:
        self._ring, self._order = ring, order
        self._series: dict[Expr, Series] = {symbol: padded(v, ring, order) for symbol, v in values.items()}

    def __call__(self, expression: Expr) -> Series:
        """Return the series of an expression."""
        if expression not in self._series:
            self._series[expression] = self._evaluated(expression)
        return self._series[expression]

    def _evaluated(self, expression: Expr) -> Series:
        ring = self._ring
        if not expression.free_symbols & self._series.keys():
            return padded([ring.function(expression, STEP, ring.zero)], ring, self._order)
        if expression.is_Add:
            return [sum(parts, ring.zero) for parts in zip(*map(self, expression.args), strict=True)]
        if expression.is_Mul:
            result = self(expression.args[0])
            for factor in expression.args[1:]:
                result = self._product(result, self(factor))
            return result
        x = sympy.Dummy("x", real=True)
        if expression.is_Pow:
            base, exponent = expression.as_base_exp()
            if exponent.free_symbols & self._series.keys():
                return self(sympy.exp(exponent * sympy.log(base)))
            if exponent.is_Integer and exponent > 0:
                result = self(base)
                for _ in range(int(exponent) - 1):
                    result = self._product(result, self(base))
                return result
            return self._composed(x**exponent, x, self(base))
        if len(expression.args) != 1:
            return padded([ring.function(expression, x, ring.zero)], ring, self._order)
        return self._composed(expression.func(x), x, self(expression.args[0]))

    def _product(self, a: Series, b: Series) -> Series:
        ring = self._ring
        products = (
            sum((a[i] * b[n - i] for i in range(n + 1) if a[i] and b[n - i]), ring.zero) for n in range(self._order + 1)
        )
        return [ring.reduced(total) for total in products]

    def _composed(self, outer: Expr, x: Symbol, inner: Series) -> Series:
        """Return outer(inner), by Taylor's formula in x around the first coefficient of the inner series."""
        ring = self._ring
        change = [ring.zero, *inner[1:]]
        power = padded([ring.one], ring, self._order)
        result = padded([ring.function(outer, x, inner[0])], ring, self._order)
        if not any(change):
            return result
        for k in range(1, self._order + 1):
            outer, power = sympy.diff(outer, x) / k, self._product(power, change)
            factor = ring.function(outer, x, inner[0])
            result = [ring.reduced(r + factor * c) for r, c in zip(result, power, strict=True)]
        return result
