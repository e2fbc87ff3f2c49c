"""Functions beyond the elementary ones: rewritten in those that numba has, or evaluated by code of this package.

`rewritten` takes what an author wrote. Two families have a derivative of every order, which modules evaluate
themselves: the derivatives of sin(x)/x, which have no quotient that fails at zero, and the polygamma functions.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr

from codegen.errors import ExpressionError

STEMS = ("polygamma", "sinc_derivative")
"""The families; `codegen.runtime.special` has a function for each."""


class OrderedBase(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """The member `order` of a family of functions of one variable, each the derivative of the one before."""

    nargs = 1
    stem = ""
    order = 0
    is_real = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """The next member of the family."""
        return member(self.stem, self.order + 1)(self.args[0])

    def _eval_evalf(self, precision: int) -> Any:
        at = self.args[0]._to_mpmath(precision)
        with mpmath.workprec(precision):
            return sympy.Expr._from_mpmath(value(self.stem, self.order, at), precision)

    def _sympystr(self, printer: Any) -> str:
        at = printer._print(self.args[0])
        return f"sinc({at})" if self.func == member("sinc_derivative", 0) else f"{self.stem}({self.order}, {at})"

    def _mpmathcode(self, printer: Any) -> str:
        at = printer._print(self.args[0])
        return f"psi({self.order}, {at})" if self.stem == "polygamma" else f"diff(sinc, {at}, {self.order})"

    def _numpycode(self, printer: Any) -> str:
        return f"{self.stem}({self.order}, {printer._print(self.args[0])})"


class gamma(sympy.Function):  # type: ignore[misc]
    """The gamma function, whose derivative is written with members of the family of polygamma functions."""

    nargs = 1
    is_real = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """Gamma times digamma."""
        return self * member("polygamma", 0)(self.args[0])

    def _eval_evalf(self, precision: int) -> Any:
        return sympy.gamma(self.args[0])._eval_evalf(precision)

    def _numpycode(self, printer: Any) -> str:
        return f"gamma({printer._print(self.args[0])})"


class lgamma(sympy.Function):  # type: ignore[misc]
    """The logarithm of the absolute value of the gamma function, whose derivative is digamma."""

    nargs = 1
    is_real = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """Digamma."""
        return member("polygamma", 0)(self.args[0])

    def _eval_evalf(self, precision: int) -> Any:
        return sympy.loggamma(self.args[0])._eval_evalf(precision)

    def _mpmathcode(self, printer: Any) -> str:
        return f"loggamma({printer._print(self.args[0])})"

    def _numpycode(self, printer: Any) -> str:
        return f"gammaln({printer._print(self.args[0])})"


@cache
def member(stem: str, order: int) -> Any:
    """The function of a family with a number: `polygamma_0`, `sinc_derivative_2`, ..."""
    return type(sympy.Function)(f"{stem}_{order}", (OrderedBase,), {"stem": stem, "order": order})


def by_name(name: str) -> Any:
    """The function that mpmath evaluates under a name of `math`, or of a member of a family."""
    stem, _, order = name.rpartition("_")
    if stem in STEMS:
        return lambda x: value(stem, int(order), x)
    return getattr(mpmath, {"lgamma": "loggamma"}.get(name, name))


def _sinc_of_arrays(order: int, x: Any) -> Any:
    return np.vectorize(lambda number: float(sinc_derivative(order, number)), otypes=[float])(x)


NUMPY: list[Any] = [{"sinc_derivative": _sinc_of_arrays}, "scipy", "numpy"]
"""Modules for lambdify that know all functions that can be printed."""


def value(stem: str, order: int, x: Any) -> Any:
    """A member of a family at a number of mpmath, to its digits."""
    return mpmath.psi(order, x) if stem == "polygamma" else sinc_derivative(order, x)


def sinc_derivative(order: int, x: Any) -> Any:
    """The derivative of sin(x)/x: its series near zero, elsewhere from x s_n = sin(x + n pi/2) - n s_(n-1)."""
    with mpmath.extradps(30 + 2 * order):
        x = mpmath.mpf(x)
        if abs(x) < 30:
            return mpmath.nsum(lambda k: _coefficient(int(k), order) * x ** (2 * int(k) + order % 2), [0, mpmath.inf])
        total = mpmath.sin(x) / x
        for n in range(1, order + 1):
            total = (mpmath.sin(x + n * mpmath.pi / 2) - n * total) / x
        return total


def _coefficient(k: int, order: int) -> Any:
    """That of x^(2k + order % 2) in the derivative of sum_j (-1)^j x^(2j)/(2j + 1)!."""
    j = k + (order + 1) // 2
    return mpmath.mpf(-1) ** j / ((2 * j + 1) * mpmath.factorial(2 * j - order))


def rewritten(expression: Expr, what: str) -> Expr:
    """The expression in functions that can be printed; ExpressionError where a sum or integral has no closed form."""
    for part in sorted(expression.atoms(sympy.Sum, sympy.Product, sympy.Integral, sympy.Derivative), key=str):
        if isinstance(part, sympy.Derivative) and not set(part.variables) <= part.expr.free_symbols:
            finding = f"{what} has {_short(part)}, which is zero: symbols depend on no other symbol"
            raise ExpressionError(finding, "write the rate itself, by the symbol that is declared for it")
        done = part.doit()
        if done.has(type(part)):
            raise ExpressionError(f"{what} has {_short(part)}, which has no closed form", _OPEN[type(part).__name__])
        expression = expression.xreplace({part: done})
    for function, form in _FORMS.items():
        if expression.has(function):
            expression = expression.replace(function, form)
    return expression.replace(_is_signed_root, _signed_root) if expression.has(sympy.sign) else expression


def refusal(part: Any, what: str) -> ExpressionError:
    """What is said of a function that no generated module can evaluate."""
    name = part.func.__name__
    remedy = _REMEDIES.get(name, "use elementary functions, erf, erfc, sinc, gamma, loggamma or polygamma")
    return ExpressionError(f"{what} uses {_short(part)}, which cannot be printed", remedy)


def _short(part: Any) -> str:
    text = str(sympy.sstr(part, full_prec=False))
    return text if len(text) <= 60 else f"{part.func.__name__}(...)"


def _is_signed_root(part: Expr) -> bool:
    return bool(part.is_Mul) and any(_root_beside(s, part) is not None for s in part.args if isinstance(s, sympy.sign))


def _root_beside(sign: Expr, product: Expr) -> Expr | None:
    """A factor |x|^r beside sign(x)."""
    roots = (f for f in product.args if f.is_Pow and f.base == sympy.Abs(sign.args[0]) and f.exp.is_positive)
    return next(roots, None)


def _signed_root(product: Expr) -> Expr:
    """Sign(x) |x|^r is x |x|^(r - 1), which is continuous like it, and whose derivatives are without steps."""
    sign = next(s for s in product.args if isinstance(s, sympy.sign) and _root_beside(s, product) is not None)
    root = _root_beside(sign, product)
    assert root is not None
    x = sign.args[0]
    return product / sign / root * x * sympy.Abs(x) ** (root.exp - 1)


def _polygamma(order: Expr, x: Expr) -> Expr:
    if not (order.is_Integer and order >= 0):
        return sympy.Function("polygamma")(order, x)
    return member("polygamma", int(order))(x)


_FORMS = {
    sympy.sec: lambda x: 1 / sympy.cos(x),
    sympy.csc: lambda x: 1 / sympy.sin(x),
    sympy.cot: lambda x: sympy.cos(x) / sympy.sin(x),
    sympy.asec: lambda x: sympy.acos(1 / x),
    sympy.acsc: lambda x: sympy.asin(1 / x),
    sympy.acot: lambda x: sympy.atan(1 / x),
    sympy.sech: lambda x: 1 / sympy.cosh(x),
    sympy.csch: lambda x: 1 / sympy.sinh(x),
    sympy.coth: lambda x: 1 / sympy.tanh(x),
    sympy.asech: lambda x: sympy.acosh(1 / x),
    sympy.acsch: lambda x: sympy.asinh(1 / x),
    sympy.acoth: lambda x: sympy.atanh(1 / x),
    sympy.sinc: lambda x: member("sinc_derivative", 0)(x),
    sympy.gamma: gamma,
    sympy.loggamma: lgamma,
    sympy.factorial: lambda x: gamma(x + 1),
    sympy.beta: lambda x, y: gamma(x) * gamma(y) / gamma(x + y),
    sympy.digamma: lambda x: member("polygamma", 0)(x),
    sympy.trigamma: lambda x: member("polygamma", 1)(x),
    sympy.polygamma: _polygamma,
    sympy.erf2: lambda x, y: sympy.erf(y) - sympy.erf(x),
}
_OPEN = {
    "Sum": "give it finite limits that are numbers",
    "Product": "give it finite limits that are numbers",
    "Integral": "make it a state, whose derivative is the integrand",
    "Derivative": "write the derivative itself",
}
_STEP = "a step has no derivative that optimisers see; use tanh(x/width), or phases"
_REMEDIES = {
    "sign": _STEP,
    "Heaviside": _STEP,
    "floor": _STEP,
    "ceiling": _STEP,
    "DiracDelta": "write an impulse as a jump between phases",
    "Mod": "use sin and cos of an angle instead of what it leaves",
    "LambertW": "make it a state or a control, with the equation that it solves as a path condition",
}
