"""Two functions of which the difference that defines them would lose all digits, and where they occur.

For small x, both x - log(1 + x) and log(1 + x) - x/(1 + x) are about x^2/2. Kernels of plates, among others, are made
of them, and so are their derivatives.
"""

from __future__ import annotations

from typing import Any

import sympy
from sympy import Expr
from sympy.codegen.cfunctions import log1p
from sympy.core.random import seed


class x_minus_log1p(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """x - log(1 + x); the second argument is log(1 + x), so that it is shared with whoever else needs it."""

    nargs = 2

    def _eval_evalf(self, precision: int) -> Any:
        x, log = self.args
        return (x - log).evalf(sympy.core.evalf.prec_to_dps(precision) + 30)


class log1p_minus_ratio(sympy.Function):  # type: ignore[misc]
    """log(1 + x) - x/(1 + x); the second argument is log(1 + x)."""

    nargs = 2

    def _eval_evalf(self, precision: int) -> Any:
        x, log = self.args
        return (log - x / (1 + x)).evalf(sympy.core.evalf.prec_to_dps(precision) + 30)


def without_cancellation(expression: Expr) -> Expr:
    """The same value with rational parts over common denominators and the two differences taken out.

    Decides nothing where logarithms enter other than linearly.
    """
    logs = sorted(expression.atoms(sympy.log), key=sympy.default_sort_key)
    if not logs:
        # The expression or its factored form, whichever has fewer operations.
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
    """Factors over a common denominator.

    Wang's algorithm evaluates polynomials at random integers, and with some it does not come to an end for hours; with
    the same ones every time, a build takes the same way every time.
    """
    seed(0)
    return sympy.factor(sympy.together(expression))
