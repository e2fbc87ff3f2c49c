"""Functions beyond the elementary ones: values and two derivatives of emitted code against mpmath."""

from __future__ import annotations

import interpreted
import mpmath
import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from codegen import Control, control, errors, state
from codegen.runtime.search import point
from codegen.runtime.special import polygamma, sinc_derivative
from codegen.solving.compiler import build
from codegen.symbolic.checks import checked
from codegen.symbolic.functions import sinc_derivative as exact_sinc_derivative

_y, _k = sympy.symbols("y k")

FUNCTIONS = {
    "erf": (sympy.erf, mpmath.erf),
    "erfc": (sympy.erfc, mpmath.erfc),
    "sinc": (sympy.sinc, mpmath.sinc),
    "sec": (sympy.sec, mpmath.sec),
    "csc": (sympy.csc, mpmath.csc),
    "cot": (sympy.cot, mpmath.cot),
    "asec": (lambda x: sympy.asec(x + 3), lambda x: mpmath.asec(x + 3)),
    "acsc": (lambda x: sympy.acsc(x + 3), lambda x: mpmath.acsc(x + 3)),
    "acot": (sympy.acot, mpmath.acot),
    "sech": (sympy.sech, mpmath.sech),
    "csch": (sympy.csch, mpmath.csch),
    "coth": (sympy.coth, mpmath.coth),
    "asech": (lambda x: sympy.asech(x / 9), lambda x: mpmath.asech(x / 9)),
    "acsch": (sympy.acsch, mpmath.acsch),
    "acoth": (lambda x: sympy.acoth(x + 3), lambda x: mpmath.acoth(x + 3)),
    "gamma": (sympy.gamma, mpmath.gamma),
    "loggamma": (sympy.loggamma, mpmath.loggamma),
    "digamma": (sympy.digamma, lambda x: mpmath.psi(0, x)),
    "polygamma": (lambda x: sympy.polygamma(2, x), lambda x: mpmath.psi(2, x)),
    "beta": (lambda x: sympy.beta(x, x + 2), lambda x: mpmath.beta(x, x + 2)),
    "real_root": (
        lambda x: sympy.real_root(x - 2, 3),
        lambda x: mpmath.sign(x - 2) * abs(x - 2) ** (mpmath.mpf(1) / 3),
    ),
    "sum": (lambda x: sympy.Sum(sympy.cos(_k * x), (_k, 1, 4)), lambda x: sum(mpmath.cos(k * x) for k in range(1, 5))),
    "product": (lambda x: sympy.Product(x + _k, (_k, 1, 3)), lambda x: (x + 1) * (x + 2) * (x + 3)),
    "integral": (
        lambda x: sympy.Integral(sympy.exp(-(_y**2)), (_y, 0, x)),
        lambda x: mpmath.sqrt(mpmath.pi) / 2 * mpmath.erf(x),
    ),
    "derivative": (lambda x: sympy.Derivative(sympy.sin(x), x), mpmath.cos),
}


def with_cost(function):
    """A motion whose cost is a function of x alone, so that every inner node has h f'(x), and h f''(x)/2, of it."""
    x, u = state("x"), control("u")
    return Control(dynamics={x: u}, cost=function(x), duration=1, steps=2, start={x: 1}, bounds={u: (-9, 9)})


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_two_derivatives(name):
    function, exact = FUNCTIONS[name]
    module = interpreted.without_compilation(interpreted.text_of(with_cost(function)))
    grid = module.make_grid(2)
    node = len(module.metadata.node)
    stride = node + len(module.metadata.interval)
    for at in (0.3, 0.9, 1.7, 6.5):
        with mpmath.workdps(30):
            expected = [float(mpmath.diff(exact, mpmath.mpf(at), order)) for order in range(3)]
        unknowns = np.zeros(grid.is_multiplier.size)
        unknowns[[0, stride, 2 * stride]] = at
        gradient = np.zeros(unknowns.size)
        gradient[module.primal_unknowns(grid)] = point.cost_gradient(grid, unknowns)
        rows, columns, values = point.hessian(grid, unknowns)
        inner = int(np.flatnonzero(module.primal_unknowns(grid) == stride)[0])
        second = values[(rows == inner) & (columns == inner)].sum()
        assert point.cost(grid, unknowns) == pytest.approx(expected[0], rel=1e-13)
        assert gradient[stride] == pytest.approx(expected[1] / 2, rel=1e-12)
        assert second == pytest.approx(expected[2] / 4, rel=1e-11)


@given(st.integers(0, 5), st.floats(-60, 60))
def test_derivatives_of_sinc_everywhere(order, x):
    assert sinc_derivative(order, x) == pytest.approx(float(exact_sinc_derivative(order, x)), rel=1e-13, abs=3e-15)


@pytest.mark.parametrize("x", [0.0, 1e-300, 1e-12, -1e-5, 0.03, 1.999, 2.001, 2.5, 4.999])
def test_derivatives_of_sinc_close_to_zero(x):
    """Taylor's series by hand: sin(x)/x = 1 - x^2/6 + x^4/120 - ..."""
    with mpmath.workdps(60):
        terms = [(-1) ** j * mpmath.mpf(x) ** (2 * j) / mpmath.factorial(2 * j + 1) for j in range(40)]
        slopes = [(-1) ** j * 2 * j * mpmath.mpf(x) ** (2 * j - 1) / mpmath.factorial(2 * j + 1) for j in range(1, 40)]
        curvatures = [
            (-1) ** j * 2 * j * (2 * j - 1) * mpmath.mpf(x) ** (2 * j - 2) / mpmath.factorial(2 * j + 1)
            for j in range(1, 40)
        ]
    for order, series in enumerate((terms, slopes, curvatures)):
        assert sinc_derivative(order, x) == pytest.approx(float(mpmath.fsum(series)), rel=4e-15, abs=1e-16)


@settings(max_examples=60)
@given(st.integers(0, 5), st.floats(1e-3, 1e6) | st.floats(-20.9, -0.1).filter(lambda x: abs(x - round(x)) > 0.05))
def test_polygamma_functions(order, x):
    with mpmath.workdps(30):
        exact = mpmath.psi(order, mpmath.mpf(x))
        terms = mpmath.factorial(order) * sum(1 / abs(mpmath.mpf(x) + k) ** (order + 1) for k in range(30))
    assert abs(polygamma(order, x) - float(exact)) <= 1e-14 * float(abs(exact) + terms)


def test_polygamma_at_poles_and_far_away():
    assert not np.isfinite(polygamma.py_func(1, -1e9))
    assert polygamma.py_func(0, float("inf")) == float("inf")


def test_a_module_of_them_solves(tmp_path):
    (tmp_path / "well.py").write_text(
        '"""Move along a potential of special functions (a test)."""\n'
        "from sympy import erf, gamma, loggamma, sec, sinc\nfrom codegen import *\n\n\n"
        "def problem():\n"
        '    x, dx = coordinate("x")\n'
        '    u = control("u")\n'
        "    t = time()\n"
        "    return Control(\n"
        "        lagrangian=dx**2 / 2 - sinc(x) - loggamma(x + 2) - gamma(x + 3) / 9, force={x: u * sec(x / 3)},\n"
        "        cost=u**2 + erf(x), duration=1, steps=10, start={x: 0, dx: 0}, end={x: 1, dx: 0},\n"
        "        guess={x: erf(2 * t) * sinc(t / 9)},\n"
        "    )\n"
    )
    text = build(tmp_path / "well.py").path.read_text(encoding="utf-8")
    assert text.count("from codegen.runtime.special import polygamma, sinc_derivative\n") == 1
    solution = interpreted.without_compilation(text).solve()
    assert solution.status == "solved"
    assert solution.residual < 1e-10


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("sign(x)", r"uses sign\(x\).*; a step has no derivative"),
        ("floor(2*x + 1)", r"uses floor\(2\*x\).*; a step"),
        ("besselj(0, x)", r"uses besselj\(0, x\).*; use elementary"),
        ("Integral(sin(sin(y)), (y, 0, x))", r"has Integral\(sin\(sin\(y\)\), \(y, 0, x\)\).*; make it a state"),
        ("Sum(1/k**x, (k, 1, oo))", r"has Sum\(.*; give it finite limits"),
        ("Function('f')(x)", r"uses f\(x\)"),
    ],
)
def test_what_is_refused_is_named_as_it_was_written(expression, said):
    with pytest.raises(errors.ExpressionError, match=f"cost {said}"):
        checked(sympy.sympify(expression, locals={"x": sympy.Symbol("x", real=True)}), "cost")


def test_modules_without_them_have_none_of_their_code():
    text = interpreted.text_of(with_cost(sympy.cos))
    assert "polygamma" not in text
    assert "sinc_derivative" not in text
