"""Power series in h with coefficients in a FunctionRing, and expressions at such series."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy
from sympy import Expr, Symbol

from codegen.analysis.function_ring import FunctionRing
from codegen.analysis.normal_form import Element
from codegen.discretise import STEP

Series = list[Element]
"""Coefficients of h^0, h^1, ..., as many as are wanted."""


def padded(values: Sequence[Element], ring: FunctionRing, order: int) -> Series:
    """A series cut, or filled with zeros, to end at h^order."""
    return [*values[: order + 1], *[ring.zero] * (order + 1 - len(values))]


class Evaluation:
    """Expressions at series, by Taylor's formula on every function; parts that occur twice are evaluated once."""

    def __init__(self, ring: FunctionRing, values: Mapping[Symbol, Series], order: int) -> None:
        self._ring, self._order = ring, order
        self._known: dict[Expr, Series] = {symbol: padded(v, ring, order) for symbol, v in values.items()}

    def __call__(self, expression: Expr) -> Series:
        """The series of an expression."""
        if expression not in self._known:
            self._known[expression] = self._evaluated(expression)
        return self._known[expression]

    def _evaluated(self, expression: Expr) -> Series:
        ring = self._ring
        if not expression.free_symbols & self._known.keys():
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
            if exponent.free_symbols & self._known.keys():
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
        """Taylor's formula for an outer function around the inner series' first coefficient."""
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
