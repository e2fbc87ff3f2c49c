"""Exact arithmetic with elementary functions: sparse polynomials in variables and in the functions that occur.

A generator is adjoined for each sine, root, reciprocal and so on, with its derivatives and with what it satisfies,
such as sin^2 = 1 - cos^2 or w (2 - cos^2) = 1. Source: the structure theory of elementary functions as in Bronstein
(2005), Symbolic integration I, chapter 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import sympy
from sympy import QQ, Dummy, Expr, Rational, Symbol

from codegen.analysis.normal_form import Element, NormalForms, sparse
from codegen.errors import ExpressionError


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
