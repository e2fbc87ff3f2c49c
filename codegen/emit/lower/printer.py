"""Printing of sympy expressions as Python code: scalar code for numba kernels, array code for numpy functions."""

from __future__ import annotations

import math
import re

import sympy
from sympy import Expr
from sympy.codegen.rewriting import expm1_opt, log1p_opt, optimize
from sympy.printing.pycode import PythonCodePrinter

from codegen.errors import ExpressionError
from codegen.symbolic import checks as expressions
from codegen.symbolic.tables import ORDERS

_SHORT_DENOMINATORS = 64
_STEEP = 16
"""Numerator or denominator inside exp(...) above which sympy's factorisation takes too long."""
_READABLE = 1000
"""Largest number of operations of an expression that a description shows."""
_FORMS = {
    "sign": "np.sign({})",
    "Heaviside": "(0.5 + 0.5*np.sign({}))",
    "Abs": "abs({})",
    "x_minus_log1p": "x_minus_log1p({}, {})",
    "log1p_minus_ratio": "log1p_minus_ratio({}, {})",
}
"""Format strings of functions that numbers and arrays have in common."""
_NUMPY_NAMES = {f"a{name}": f"arc{name}" for name in "sin cos tan sinh cosh tanh tan2".split()}


class ScalarPrinter(PythonCodePrinter):  # type: ignore[misc]  # sympy is untyped
    """A printer with functions of `math`; numba unrolls its integer and half-integer powers to products."""

    module = "math"

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": True, "standard": "python3", "precision": 17})

    def _print_Rational(self, expr: Expr) -> str:
        p, q = int(expr.p), int(expr.q)
        if q <= _SHORT_DENOMINATORS and q & (q - 1) == 0:
            return _decimal(expr)
        if abs(p) < 10**9 and q < 10**9 and (p / q) * q == p:
            decimal = repr(p / q)
            return decimal if len(decimal) <= 8 else f"({p}/{q})"
        return _decimal(expr)

    def parenthesize(self, item: Expr, level: int, strict: bool = False) -> str:
        """Return code in parentheses where necessary; a printed fraction has parentheses already."""
        text = str(super().parenthesize(item, level, strict))
        return text[1:-1] if text.startswith("((") and isinstance(item, sympy.Rational) else text

    def _print_Integer(self, expr: Expr) -> str:
        return str(int(expr)) if abs(int(expr)) < 2**53 else _decimal(expr)

    def _print_Float(self, expr: Expr) -> str:
        return _decimal(expr)

    def _print_Pow(self, expr: Expr, rational: bool = False) -> str:
        """Return negative powers as quotients: numba raises an error at 0.0**(-2), where 1/0.0**2 is infinite."""
        base, exponent = expr.base, expr.exp
        if base == sympy.E:
            return f"{self.module}.exp({self._print(exponent)})"
        if exponent.is_Rational and exponent.is_negative and exponent.q <= 2 and exponent != -1:
            return f"1/{self._print(sympy.Pow(base, -exponent, evaluate=False))}"
        if exponent.is_Rational and exponent.q == 2:
            root = f"{self.module}.sqrt({self._print(base)})"
            return root if exponent == sympy.Rational(1, 2) else f"{root}**({exponent.p})"
        return str(super()._print_Pow(expr, rational=rational))

    def _print_Piecewise(self, expr: Expr) -> str:
        """Return code that gives NaN if no condition holds, where sympy prints None."""
        text = str(super()._print_Piecewise(expr))
        return text.removesuffix("None)") + "math.nan)" if text.endswith(" else None)") else text

    def _print_in_form(self, expr: Expr) -> str:
        return _FORMS[type(expr).__name__].format(*map(self._print, expr.args))

    _print_sign = _print_Heaviside = _print_Abs = _print_x_minus_log1p = _print_log1p_minus_ratio = _print_in_form

    def _print_gamma(self, expr: Expr) -> str:
        return self._of_floats(f"math.{type(expr).__name__}", expr)

    _print_lgamma = _print_erf = _print_erfc = _print_gamma

    def _print_OrderedBase(self, expr: Expr) -> str:
        return self._of_floats(expr.stem, expr, f"{expr.order}, ")

    def _of_floats(self, function: str, expr: Expr, before: str = "") -> str:
        """Return a call of a function that takes numbers, but no arrays; the code `before` precedes its argument."""
        return f"{function}({before}{self._print(expr.args[0])})"

    def _print_Pi(self, expr: Expr) -> str:
        return f"{self.module}.pi"

    def _print_Exp1(self, expr: Expr) -> str:
        return f"{self.module}.e"


def _decimal(number: sympy.Number) -> str:
    """Return the digits of a number in double precision; raise ExpressionError if it overflows or underflows."""
    try:
        value = number.p / number.q if number.is_Rational else float(number)
    except OverflowError:
        value = math.inf
    if math.isinf(value) or (value == 0.0 and not number.is_zero):
        raise ExpressionError(
            f"the derived equations hold the number {sympy.N(number, 8)}, which double precision cannot hold",
            "choose units in which constants are of ordinary size",
        )
    return repr(float(value))


class ArrayPrinter(ScalarPrinter):
    """A printer with functions of numpy, for expressions whose symbols are arrays."""

    module = "np"

    def _print_Function(self, expr: Expr) -> str:
        name = type(expr).__name__
        arguments = ", ".join(self._print(argument) for argument in expr.args)
        return f"np.{_NUMPY_NAMES.get(name, name)}({arguments})"

    def _print_Piecewise(self, expr: Expr) -> str:
        text = "np.nan"
        for value, condition in reversed(expr.args):
            text = f"np.where({self._print(condition)}, {self._print(value)}, {text})"
        return text

    def _of_floats(self, function: str, expr: Expr, before: str = "") -> str:
        return super()._of_floats(f"np.vectorize({function})", expr, before)

    def _print_TableBase(self, expr: Expr) -> str:
        """Return a table's look-up at arrays, which only guesses need; all bodies have the same tables."""
        number, at = ORDERS[len(expr.args)].index(expr.order), ", ".join(map(self._print, expr.args))
        return f"along({expr.table.shape.lookup}_values, grid.parameters[0], {number}, {at})"

    def _print_EachBodyBase(self, expr: Expr) -> str:
        body, *values = map(self._print, expr.args)
        return f"np.array([{', '.join(values)}])[{body}]"

    def _print_Min(self, expr: Expr) -> str:
        function = "np.minimum" if isinstance(expr, sympy.Min) else "np.maximum"
        text = str(self._print(expr.args[0]))
        for argument in expr.args[1:]:
            text = f"{function}({text}, {self._print(argument)})"
        return text

    _print_Max = _print_Min


for _name in "sin cos tan sinh cosh tanh exp log asin acos atan asinh acosh atanh atan2 log1p expm1".split():
    setattr(ArrayPrinter, f"_print_{_name}", ArrayPrinter._print_Function)


def stabilised(expression: sympy.Expr) -> sympy.Expr:
    """Return an expression with log1p and expm1 instead of log(1 + x) and exp(x) - 1, and without Dirac deltas.

    A second derivative of |x|, Min or Max contains deltas. They are zero almost everywhere, and quadrature ignores
    them. Steps, whose first derivative is a delta, are refused in the author's expressions. Exponentials of steep
    arguments, as exp(1000 x), are masked: sympy factors them as polynomials of degree 1000, which takes minutes.
    """
    if expression.has(sympy.DiracDelta):
        expression = expression.replace(sympy.DiracDelta, lambda *_: sympy.S.Zero)
    if not expression.has(sympy.log, sympy.exp):
        return expression
    steep = {
        e.args[0]
        for e in expression.atoms(sympy.exp)
        if any(max(abs(r.p), r.q) > _STEEP for r in e.args[0].atoms(sympy.Rational))
    }
    names = {argument: sympy.Dummy(real=True) for argument in sorted(steep, key=sympy.default_sort_key)}
    expression = expression.xreplace({sympy.exp(argument): sympy.exp(name) for argument, name in names.items()})
    expression = optimize(expression, [log1p_opt])
    # Common factors may hide exp(x) - 1, as in y exp(x) - y, but only in sums that vanish if all exponents vanish.
    # Factoring other sums would take most of the time of a build.
    if any(_vanishes_with_exponents(part) for part in expression.atoms(sympy.Add) if part.has(sympy.exp)):
        expression = optimize(expression, [expm1_opt])
    else:
        expression = expm1_opt.cheapest(expression, expression.replace(expm1_opt.query, expm1_opt.value))
    return expression.xreplace({name: argument for argument, name in names.items()})


def _vanishes_with_exponents(total: sympy.Expr) -> bool:
    """Return True if a sum with all its exponentials replaced by one is zero, as tested at one point."""
    ones = dict.fromkeys(total.atoms(sympy.exp), sympy.S.One)
    symbols = sorted(total.free_symbols, key=sympy.default_sort_key)
    point = {symbol: 0.5 + (0.6180339887 * index) % 1.0 for index, symbol in enumerate(symbols, start=1)}
    terms = [expressions.rounded_at(term.xreplace(ones), point) for term in total.args]
    finite = [term for term in terms if term is not None]
    return len(finite) < len(terms) or abs(sum(finite)) <= 1e-9 * sum(map(abs, finite))


def with_decimal_roots(expression: sympy.Expr) -> sympy.Expr:
    """Return an expression with decimals instead of roots of numbers, so that they merge with other coefficients."""
    roots = [
        p for p in expression.atoms(sympy.Pow) if p.base.is_Rational and p.exp.is_Rational and not p.exp.is_Integer
    ]
    return expression.xreplace({root: sympy.N(root, 30) for root in roots}) if roots else expression


def scalar_code(expression: sympy.Expr) -> str:
    """Return Python code of an expression whose symbols are numbers."""
    return _without_needless_brackets(ScalarPrinter().doprint(expression))


def array_code(expression: sympy.Expr) -> str:
    """Return numpy code of an expression whose symbols may be arrays of the same length."""
    return _without_needless_brackets(ArrayPrinter().doprint(expression))


def _without_needless_brackets(code: str) -> str:
    """Return code with 0.5*x instead of (0.5)*x, which sympy prints for the fraction 1/2."""
    return re.sub(r"(?<![\w\]])\((\d+\.\d+)\)(?!\*\*)", r"\1", code)


def readable(value: sympy.Expr) -> str:
    """Return an expression as text for a description, or a phrase on its length if it is too long to read."""
    if expressions.longer_than(_READABLE, [value]):
        return f"an expression of more than {_READABLE} operations"
    return str(sympy.sstr(value))
