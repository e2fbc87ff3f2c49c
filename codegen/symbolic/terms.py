"""Structure of terms: kinds of terms in conditions, pair terms as functions of few scalars, and values of bodies.

Terms that differ only in their quantities, such as the squared differences in the sides of a polygon, are instances of
one kind. Code for kinds does not grow with the number of bodies.

A pair term is a function of few scalars: squared distance, scalar products, distance from a boundary. The scalars are
polynomials in the coordinates and momenta of two particles, with short and exact derivatives; the outer function has
three or four variables. Each part is differentiated separately: the gradient is f_k dI_k, and the Hessian is
f_kl dI_k dI_l + f_k d2I_k. So no digits are lost if points nearly meet or are near a boundary.

Two functions replace differences that would lose all digits: for small x, both x - log(1 + x) and
log(1 + x) - x/(1 + x) are about x^2/2. For example, kernels of plates and their derivatives contain these differences.

A quantity that differs between many identical bodies is a function of the body's number.

Families of alike rows differ only in their symbols, such as the equations of a chain. The symbols of a row are in
natural order, in which x9 precedes x10. Two rows belong to one family if they are equal after the symbols of both, in
this order, are replaced by the same slots. So alike rows are found only if the names of their symbols are alike. Only
one row of a family is differentiated, or printed as code.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
import sympy
from sympy import Add, Dummy, Expr, Symbol
from sympy.codegen.cfunctions import log1p
from sympy.core.random import seed
from sympy.printing.printer import Printer

from codegen.symbolic import parts


@dataclass(frozen=True)
class Kind:
    """The common form of some terms: an expression of arguments a0, a1, ... that stand for an instance's quantities."""

    expression: Expr
    arguments: tuple[Symbol, ...]


@dataclass(frozen=True)
class Instance:
    """One term: its kind, the index of its condition (row), and the indices of its quantities."""

    kind: int
    row: int
    indices: tuple[int, ...]


def sorted_terms(
    conditions: Sequence[Expr], indices: Mapping[Symbol, int]
) -> tuple[tuple[Kind, ...], tuple[Instance, ...]]:
    """Return the kinds of terms in conditions, and all terms as instances; `indices` number the quantities."""
    symbols = set().union(*(condition.free_symbols for condition in conditions))
    taken = {symbol.name for symbol in symbols - indices.keys()}
    fresh = (Symbol(f"a{i}", real=True) for i in count() if f"a{i}" not in taken)
    arguments: list[Symbol] = []
    kinds: dict[Kind, int] = {}
    instances = []
    for row, condition in enumerate(conditions):
        for term in Add.make_args(condition):
            read = sorted(term.free_symbols & indices.keys(), key=lambda symbol: indices[symbol])
            arguments += [next(fresh) for _ in read[len(arguments) :]]
            general = _signed(term.xreplace(dict(zip(read, arguments, strict=False))))
            kind = kinds.setdefault(Kind(general, tuple(arguments[: len(read)])), len(kinds))
            instances.append(Instance(kind, row, tuple(indices[symbol] for symbol in read)))
    return tuple(kinds), tuple(instances)


def distinct(conditions: Sequence[Expr], quantities: Sequence[Symbol]) -> tuple[int, ...]:
    """Return the indices of the conditions that differ from every earlier condition in more than the quantities."""
    indices = {symbol: index for index, symbol in enumerate(quantities)}
    arguments = [Dummy(f"a{i}", real=True) for i in range(len(quantities))]
    first: dict[Expr, int] = {}
    for index, condition in enumerate(conditions):
        read = sorted(condition.free_symbols & indices.keys(), key=lambda symbol: indices[symbol])
        first.setdefault(_signed(condition.xreplace(dict(zip(read, arguments, strict=False)))), index)
    return tuple(first.values())


def _signed(expression: Expr) -> Expr:
    """Return an equal expression with (a - b)^2 in place of (b - a)^2, so that equal terms compare equal."""
    return expression.replace(
        lambda e: e.is_Pow and e.exp.is_even and e.base.could_extract_minus_sign(), lambda e: (-e.base) ** e.exp
    )


class x_minus_log1p(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """x - log(1 + x); the second argument is log(1 + x), which other expressions can reuse."""

    nargs = 2

    def _eval_evalf(self, precision: int) -> Expr:
        x, log = self.args
        return (x - log).evalf(sympy.core.evalf.prec_to_dps(precision) + 30)


class log1p_minus_ratio(sympy.Function):  # type: ignore[misc]
    """log(1 + x) - x/(1 + x); the second argument is log(1 + x)."""

    nargs = 2

    def _eval_evalf(self, precision: int) -> Expr:
        x, log = self.args
        return (log - x / (1 + x)).evalf(sympy.core.evalf.prec_to_dps(precision) + 30)


def without_cancellation(expression: Expr) -> Expr:
    """Return an equal expression with common denominators, `x_minus_log1p` and `log1p_minus_ratio`.

    Expressions that are nonlinear in logarithms are unchanged.
    """
    logs = sorted(expression.atoms(sympy.log), key=sympy.default_sort_key)
    if not logs:
        # Choose the form with the fewest operations.
        candidates = [expression, sympy.factor_terms(expression)]
        if not expression.has(sympy.Piecewise, sympy.Abs, sympy.Min, sympy.Max):
            candidates.append(_rational(expression))
        return min(candidates, key=lambda e: (e.count_ops(), len(str(e))))
    expanded = sympy.expand(expression, deep=False, mul=True, log=False, power_base=False)
    try:
        polynomial = sympy.Poly(expanded, *logs)
    except sympy.PolynomialError:
        return expression
    if polynomial.total_degree() > 1 or any(c.has(sympy.log) for c in polynomial.coeffs()):
        return expression
    rest = _rational(polynomial.coeff_monomial(1))
    total = sympy.S.Zero
    for log in logs:
        factor = _rational(polynomial.coeff_monomial(log))
        x = _rational(log.args[0] - 1)
        if _rational(rest + factor * x) == 0:
            total, rest = total - factor * x_minus_log1p(x, log1p(x)), sympy.S.Zero
        elif _rational(rest + factor * x / (1 + x)) == 0:
            total, rest = total + factor * log1p_minus_ratio(x, log1p(x)), sympy.S.Zero
        else:
            total += factor * log1p(x)
    return total + rest


def _rational(expression: Expr) -> Expr:
    """Return an equal expression as a product of factors over a common denominator.

    Wang's algorithm evaluates polynomials at random integers; some integers make it run for hours. A fixed seed makes
    all builds use the same integers.
    """
    seed(0)
    return sympy.factor(sympy.together(expression))


_SINGULAR = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


@dataclass(frozen=True)
class Invariants:
    """A pair term as a function `outer` of the scalars `symbols`, with the value of each scalar in `polynomials`.

    `first` and `second` are the coordinates and momenta of the two particles: the moving symbols.
    """

    first: tuple[Symbol, ...]
    second: tuple[Symbol, ...]
    symbols: tuple[Symbol, ...]
    polynomials: tuple[Expr, ...]
    outer: Expr

    @classmethod
    def of(cls, term: Expr, first: Sequence[Symbol], second: Sequence[Symbol] = ()) -> Invariants:
        """Return a term with its scalars: the longest sums that are polynomials in the moving symbols."""
        moving = {*first, *second}
        symbols: dict[Expr, Symbol] = {}

        def named(polynomial: Expr) -> Symbol:
            return symbols.setdefault(polynomial, Symbol(f"s{len(symbols)}", real=True))

        def replaced(part: Expr) -> Expr:
            if not part.free_symbols & moving:
                return part
            if part in moving:
                return named(part)
            if part.is_Add:
                short = [term for term in part.args if _is_quadratic(term, moving)]
                rest = [term for term in part.args if term not in short]
                if any(term.free_symbols & moving for term in rest):
                    numbers = [term for term in short if not term.free_symbols & moving]
                    rest, short = [*rest, *numbers], [term for term in short if term not in numbers]
                if not short:
                    return sympy.Add(*map(replaced, rest))
                content, primitive = sympy.Add(*short).primitive()
                # Without a constant term, scalars of opposite sign are one scalar.
                if primitive.as_coeff_Add()[0] == 0 and primitive.could_extract_minus_sign():
                    content, primitive = -content, -primitive
                return content * named(primitive) + sum(map(replaced, rest), sympy.S.Zero)
            return part.func(*map(replaced, part.args))

        outer = replaced(term)
        return cls(tuple(first), tuple(second), tuple(symbols.values()), tuple(symbols), outer)

    @property
    def moving(self) -> tuple[Symbol, ...]:
        """The coordinates and momenta of both particles."""
        return (*self.first, *self.second)

    @property
    def value(self) -> Expr:
        """The outer function, rewritten so that no digits cancel."""
        return without_cancellation(self.outer)

    def slope(self, k: int) -> Expr:
        """Return the derivative of the outer function with respect to scalar k."""
        return without_cancellation(sympy.diff(self.outer, self.symbols[k]))

    def curvature(self, k: int, m: int) -> Expr:
        """Return the second derivative of the outer function with respect to scalars k and m."""
        return without_cancellation(sympy.diff(self.outer, self.symbols[k], self.symbols[m]))

    def distances(self) -> tuple[int, ...]:
        """Return the indices of squared distances: nonnegative scalars that vanish where both particles meet."""
        found = []
        for k in self._vanishing():
            # Only a polynomial of degree two that is a sum of squares has one sign.
            own = [symbol for symbol in self.moving if symbol in self.polynomials[k].free_symbols]
            if own and sympy.Poly(self.polynomials[k], *own).total_degree() == 2:
                eigenvalues = np.linalg.eigvalsh(np.array(sympy.hessian(self.polynomials[k], own), float))
                if eigenvalues.min() >= -1e-12 * eigenvalues.max():
                    found.append(k)
        return tuple(found)

    def _vanishing(self) -> tuple[int, ...]:
        """Return the indices of scalars that vanish where both particles meet, such as a difference of coordinates."""
        if not self.second:
            return ()
        return tuple(
            k for k, polynomial in enumerate(self.polynomials) if sympy.expand(polynomial.xreplace(self._meeting)) == 0
        )

    @property
    def _meeting(self) -> dict[Symbol, Symbol]:
        half = len(self.first) // 2
        return dict(zip(self.second[:half], self.first[:half], strict=True))

    def coincidence(self) -> tuple[Expr | None, bool]:
        """Return the term's limit where both particles meet, and True if its gradient tends to the limit's gradient.

        The limit is None if it is not finite, or if more than one scalar vanishes. It is taken in the squared distance
        s from above. The gradient of s has the size of sqrt(s), so f_s sqrt(s) must tend to zero. A scalar of either
        sign, such as a difference of coordinates, is set to zero instead.
        """
        indices = self._vanishing()
        if len(indices) > 1:
            return None, False
        values = {s: p.xreplace(self._meeting) for s, p in zip(self.symbols, self.polynomials, strict=True)}
        if not indices:
            return self.outer.xreplace(values), True
        if not self.distances():
            values[self.symbols[indices[0]]] = sympy.S.Zero
            value, slope = self.outer.xreplace(values), self.slope(indices[0]).xreplace(values)
            return (None, False) if value.has(*_SINGULAR) else (value, not slope.has(*_SINGULAR))
        # Scalars with equal values at the meeting point have one symbol, positive as in the domain of the term.
        same = {value: Symbol(f"m{k}", positive=True) for k, value in enumerate(dict.fromkeys(values.values()))}
        positive = {s: same[values[s]] for s in self.symbols}
        distance, outer = positive[self.symbols[indices[0]]], self.outer.xreplace(positive)
        limit = _limit(outer, distance)
        if limit.has(*_SINGULAR):
            return None, False
        pull = _limit(sympy.diff(outer, distance) * sympy.sqrt(distance), distance)
        return limit.xreplace({symbol: value for value, symbol in same.items()}), bool(pull == 0)


def _limit(expression: Expr, distance: Symbol) -> Expr:
    """Return the limit of an expression for a distance that tends to zero from above.

    sympy has no series of Max and Min. Such an expression has its value at zero, which may be singular.
    """
    try:
        return sympy.limit(expression, distance, 0, "+")
    except NotImplementedError:
        return expression.subs(distance, 0)


def _is_quadratic(term: Expr, moving: set[Symbol]) -> bool:
    """Return True if a term is a polynomial of degree at most two in moving symbols, with numbers as coefficients."""
    if not term.is_polynomial(*moving) or term.free_symbols - moving:
        return False
    own = sorted(term.free_symbols & moving, key=str)
    return not own or int(sympy.Poly(term, *own).total_degree()) <= 2


class EachBodyBase(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """A number that differs between bodies: the arguments are the body's index, then the value for each body.

    The name ends in Base, so that printers of sympy look for methods of this class.
    """

    is_real = True

    @classmethod
    def eval(cls, body: Expr, *values: Expr) -> Expr | None:
        """Return the value if the body's number is known or all values are equal, otherwise None."""
        if body.is_number:
            number = int(body)
            return values[number] if 0 <= number < len(values) else sympy.nan
        return values[0] if len(set(values)) == 1 else None

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return zero, since the values of bodies are numbers."""
        return sympy.S.Zero

    def _sympystr(self, printer: Printer) -> str:
        return f"each_body({', '.join(map(printer._print, self.args[1:]))})"


def value_counts(expression: Expr) -> set[int]:
    """Return the set of value counts that the `EachBodyBase` functions in an expression have."""
    return {len(function.args) - 1 for function in expression.atoms(EachBodyBase)}


# Families of alike rows


@dataclass(frozen=True)
class Member:
    """The number of a row, and the symbols of the row in the order of the slots of its family."""

    row: int
    symbols: tuple[Symbol, ...]


@dataclass(frozen=True)
class Family:
    """Rows that are equal to a `template` with the symbols of a member in place of `slots`."""

    template: tuple[Expr, ...]
    slots: tuple[Symbol, ...]
    members: tuple[Member, ...]

    @property
    def is_large(self) -> bool:
        """True if one text for all members is worthwhile."""
        return len(self.members) >= _FEWEST


MANY = 40
"""Number of rows from which a program treats alike rows as one."""
_FEWEST = 4
"""Least number of members of a large family."""


def are_many(found: Sequence[Family]) -> bool:
    """Return True if there are many rows, and most of them belong to large families."""
    rows = sum(len(family.members) for family in found)
    return rows >= MANY and 2 * sum(len(family.members) for family in found if family.is_large) > rows


def families(rows: Sequence[Sequence[Expr]], kind: Callable[[Symbol], Hashable] = lambda _: None) -> list[Family]:
    """Return the families of rows, in the order of their first members.

    Symbols in the same slot have the same `kind`, such as the array in which a kernel finds them.
    """
    names = {symbol.name for row in rows for value in row for symbol in parts.symbols_of(value)}
    slots: list[Symbol] = []
    fresh = (Symbol(f"s{i}", real=True) for i in count() if f"s{i}" not in names)
    found: dict[Hashable, list[Member]] = {}
    templates: dict[Hashable, tuple[tuple[Expr, ...], int]] = {}
    for number, row in enumerate(rows):
        symbols = sorted(set[Symbol]().union(*map(parts.symbols_of, row)), key=_natural)
        while len(slots) < len(symbols):
            slots.append(next(fresh))
        places = dict(zip(symbols, slots, strict=False))
        template = tuple(parts.replaced(value, places) for value in row)
        key = template, tuple(map(kind, symbols))
        templates[key] = template, len(symbols)
        found.setdefault(key, []).append(Member(number, tuple(symbols)))
    return [Family(templates[key][0], tuple(slots[: templates[key][1]]), tuple(found[key])) for key in found]


def _natural(symbol: Symbol) -> tuple[tuple[str, int], ...]:
    """Return a key for the order of names in which digits count as numbers."""
    return tuple((text, int(digits or -1)) for text, digits in re.findall(r"(\D*)(\d*)", symbol.name))
