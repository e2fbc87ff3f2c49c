"""Functions beyond the elementary ones, with exact derivatives of every order: special functions and tables.

`rewritten` turns an author's expression into functions that numba has, or that this package evaluates. Two families
have a derivative of every order, which modules evaluate themselves: the derivatives of sin(x)/x, without a quotient
that fails at zero, and the polygamma functions.

A table is an opaque function to sympy: equal arguments have equal values, and nothing else is assumed. Numerical
evaluation interpolates the table. `codegen/emit/lower/kernels.py` writes the generated functions that do the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from functools import cache

import mpmath
import numpy as np
import sympy
from sympy import Expr
from sympy.printing.pretty.stringpict import prettyForm
from sympy.printing.printer import Printer

from codegen.errors import ExpressionError
from codegen.identifiers import in_latex
from codegen.symbolic.parts import parts
from codegen.symbolic.tables import DEGREE, Number, TableData, derivative

STEMS = ("polygamma", "sinc_derivative")
"""Names of the families; `codegen.runtime.special` has a function for each family."""


class OrderedBase(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """A function of one variable: member `order` of the family `stem`, whose derivative is the next member."""

    nargs = 1
    stem = ""
    order = 0
    is_real = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return the next member of the family."""
        return member(self.stem, self.order + 1)(self.args[0])

    def _eval_evalf(self, precision: int) -> Expr:
        at = self.args[0]._to_mpmath(precision)
        with mpmath.workprec(precision):
            return sympy.Expr._from_mpmath(value(self.stem, self.order, at), precision)

    def _sympystr(self, printer: Printer) -> str:
        at = printer._print(self.args[0])
        return f"sinc({at})" if self.func == member("sinc_derivative", 0) else f"{self.stem}({self.order}, {at})"

    def _mpmathcode(self, printer: Printer) -> str:
        at = printer._print(self.args[0])
        return f"psi({self.order}, {at})" if self.stem == "polygamma" else f"diff(sinc, {at}, {self.order})"

    def _numpycode(self, printer: Printer) -> str:
        return f"{self.stem}({self.order}, {printer._print(self.args[0])})"


class gamma(sympy.Function):  # type: ignore[misc]
    """The gamma function, whose derivative is written with the polygamma family of this module."""

    nargs = 1
    is_real = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return gamma times digamma."""
        return self * member("polygamma", 0)(self.args[0])

    def _eval_evalf(self, precision: int) -> Expr:
        return sympy.gamma(self.args[0])._eval_evalf(precision)

    def _numpycode(self, printer: Printer) -> str:
        return f"gamma({printer._print(self.args[0])})"


class lgamma(sympy.Function):  # type: ignore[misc]
    """The logarithm of the absolute value of the gamma function, whose derivative is digamma."""

    nargs = 1
    is_real = True

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return digamma."""
        return member("polygamma", 0)(self.args[0])

    def _eval_evalf(self, precision: int) -> Expr:
        return sympy.loggamma(self.args[0])._eval_evalf(precision)

    def _mpmathcode(self, printer: Printer) -> str:
        return f"loggamma({printer._print(self.args[0])})"

    def _numpycode(self, printer: Printer) -> str:
        return f"gammaln({printer._print(self.args[0])})"


@cache
def member(stem: str, order: int) -> type[Expr]:
    """Return a member of a family as a sympy function, named `polygamma_0`, `sinc_derivative_2`, ..."""
    function: type[Expr] = type(sympy.Function)(f"{stem}_{order}", (OrderedBase,), {"stem": stem, "order": order})
    return function


def by_name(name: str) -> Callable[..., mpmath.mpf]:
    """Return the mpmath function for a name of the module `math`, or for a family member such as `polygamma_0`."""
    stem, _, order = name.rpartition("_")
    if stem in STEMS:
        return lambda x: value(stem, int(order), x)
    function: Callable[..., mpmath.mpf] = getattr(mpmath, {"lgamma": "loggamma"}.get(name, name))
    return function


_SINC = np.vectorize(lambda order, x: float(sinc_derivative(int(order), x)), otypes=[float])
NUMPY = [{"sinc_derivative": _SINC}, "scipy", "numpy"]
"""Modules for sympy.lambdify that together have all functions of checked expressions."""


def value(stem: str, order: int, x: mpmath.mpf) -> mpmath.mpf:
    """Return member `order` of the family `stem` at `x`, to the working precision of mpmath."""
    return mpmath.psi(order, x) if stem == "polygamma" else sinc_derivative(order, x)


def sinc_derivative(order: int, x: mpmath.mpf | float) -> mpmath.mpf:
    """Return a derivative s_n of sin(x)/x: a series if |x| < 30, else x s_n = sin(x + n pi/2) - n s_(n-1)."""
    with mpmath.extradps(30 + 2 * order):
        x = mpmath.mpf(x)
        if abs(x) < 30:

            def term(k: mpmath.mpf) -> mpmath.mpf:
                """Return the k-th term of the derivative of sum_j (-1)^j x^(2j)/(2j + 1)!."""
                j = int(k) + (order + 1) // 2
                coefficient = mpmath.mpf(-1) ** j / ((2 * j + 1) * mpmath.factorial(2 * j - order))
                return coefficient * x ** (2 * int(k) + order % 2)

            return mpmath.nsum(term, [0, mpmath.inf])
        total = mpmath.sin(x) / x
        for n in range(1, order + 1):
            total = (mpmath.sin(x + n * mpmath.pi / 2) - n * total) / x
        return total


def rewritten(expression: Expr, what: str) -> Expr:
    """Return an expression in printable functions; ExpressionError about `what` if it has a sum without closed form."""
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
    if expression.has(sympy.sign):
        expression = expression.replace(lambda part: bool(part.is_Mul), _signed_root)
    return expression


def refusal(part: Expr, what: str) -> ExpressionError:
    """Return the error for a function that modules cannot evaluate; `what` names its expression."""
    name = part.func.__name__
    remedy = _REMEDIES.get(name, "use elementary functions, erf, erfc, sinc, gamma, loggamma or polygamma")
    return ExpressionError(f"{what} uses {_short(part)}, which cannot be printed", remedy)


def _short(part: Expr) -> str:
    text = str(sympy.sstr(part, full_prec=False))
    return text if len(text) <= 60 else f"{part.func.__name__}(...)"


def _signed_root(product: Expr) -> Expr:
    """Return a product with sign(x) |x|^r rewritten as x |x|^(r - 1), whose derivatives have no jumps."""
    for sign in (factor for factor in product.args if isinstance(factor, sympy.sign)):
        x = sign.args[0]
        for root in product.args:
            if root.is_Pow and root.base == sympy.Abs(x) and root.exp.is_positive:
                return product / sign / root * x * sympy.Abs(x) ** (root.exp - 1)
    return product


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
    sympy.polygamma: lambda n, x: (
        member("polygamma", int(n))(x) if n.is_Integer and n >= 0 else sympy.Function("polygamma")(n, x)
    ),
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


class TableBase(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """A table as a sympy function, or its partial derivative: `order` counts the derivatives for each input.

    The name ends in Base, so that printers of sympy look for methods of this class.
    """

    is_real = True
    table: TableData
    order: tuple[int, ...] = ()

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return the derivative with respect to an input, which is zero above the degree of the polynomials."""
        index = argindex - 1
        if self.order[index] == DEGREE:
            return sympy.S.Zero
        order = tuple(o + (i == index) for i, o in enumerate(self.order))
        return table_function(self.table, order)(*self.args)

    def _eval_evalf(self, precision: int) -> Expr:
        at = [argument._to_mpmath(precision, allow_ints=False) for argument in self.args]
        with mpmath.workprec(precision):
            return sympy.Expr._from_mpmath(table_value(self.table, self.order, at), precision)

    def _sympystr(self, printer: Printer) -> str:
        return f"{table_name(self.table, self.order)}({', '.join(map(printer._print, self.args))})"

    def _pretty(self, printer: Printer) -> prettyForm:
        return printer._print_Function(sympy.Function(table_name(self.table, self.order))(*self.args))

    def _latex(self, printer: Printer, exp: str | None = None) -> str:
        by = [i for i, o in zip(self.table.shape.inputs, self.order, strict=True) for _ in range(o)]
        below = f"_{{{','.join(map(in_latex, by))}}}" if by else ""
        power = f"^{{{exp}}}" if exp else ""
        arguments = ", ".join(map(printer._print, self.args))
        return rf"{{{in_latex(self.table.shape.name)}}}{below}{power}\left({arguments}\right)"


def table_value(table: TableData, order: tuple[int, ...], at: Iterable[Number]) -> Number:
    """Return a partial derivative at the inputs `at`: numbers of mpmath or Python, or arrays, real or complex."""
    return derivative(table, order, list(at), lambda number: getattr(number, "real", number))


def table_name(table: TableData, order: tuple[int, ...]) -> str:
    """Return the name of a table or derivative in messages: thrust, thrust_mach, thrust_mach_altitude."""
    by = [name for name, o in zip(table.shape.inputs, order, strict=True) for _ in range(o)]
    return "_".join((table.shape.name, *by))


@cache
def table_function(table: TableData, order: tuple[int, ...]) -> type[Expr]:
    """Return a partial derivative of a table as a sympy function; equal tables have the same function."""

    def evaluated(*at: Number) -> Number:
        return table_value(table, order, at)

    # lambdify finds `_imp_` by the name of the class, so the name must be unique.
    name = f"table_{table_name(table, (0,) * len(order))}_{'_'.join(map(str, order))}"
    attributes = {"table": table, "order": order, "nargs": len(order), "_imp_": staticmethod(evaluated)}
    function: type[Expr] = type(sympy.Function)(name, (TableBase,), attributes)
    return function


def tables_of(*holders: object) -> tuple[TableData, ...]:
    """Return the tables in expressions, sorted by name; expressions may be nested in dataclasses, lists and tuples."""
    tables: dict[TableData, None] = {}
    waiting: list[object] = list(holders)
    while waiting:
        part = waiting.pop()
        if isinstance(part, sympy.Basic):
            tables |= dict.fromkeys(each.table for each in parts(part) if isinstance(each, TableBase))
        elif is_dataclass(part):
            waiting += [getattr(part, field.name) for field in fields(part)]
        elif isinstance(part, (tuple, list)):
            waiting += part
    return tuple(sorted(tables, key=lambda table: table.shape.name))


def numbers_of(*holders: object) -> tuple[float, ...]:
    """Return the numbers of all tables in expressions as one tuple, in the order in which modules store them."""
    return tuple(number for table in tables_of(*holders) for number in table.numbers)
