"""Constants of exponentials that no computer can represent by themselves, and numbers that none can at all."""

from __future__ import annotations

import interpreted
import mpmath
import pytest
import sympy

from codegen import Control, control, errors, parameters, state
from codegen.symbolic.checks import checked

x = sympy.Symbol("x", real=True)


@pytest.mark.parametrize("rate", [885.85, -885.85, 300.123456789, 8000.3, 1234.5678901234])
@pytest.mark.parametrize("factor", [1, 3, -0.25])
def test_exponents_stay_together(rate, factor):
    """sympy makes 6.4e384 exp(-885.85 x) of them; near 1 the value is that of the exponential as it was written."""
    kept = sympy.lambdify(x, checked(factor * sympy.exp(-(x - 1) * rate), "cost"), "math")
    for place in (1.0, 1.01, 0.99):
        with mpmath.workdps(30):
            exact = factor * mpmath.exp(-(mpmath.mpf(place) - 1) * mpmath.mpf(str(rate)))
        assert kept(place) == pytest.approx(float(exact), rel=4 * abs(rate) * 2.3e-16 + 1e-15)


@pytest.mark.parametrize("wrap", [lambda e: 1 / (1 + e), lambda e: e**2 + x, lambda e: sympy.tanh(x * e)])
def test_they_do_inside_other_functions(wrap):
    expression = checked(wrap(sympy.exp(-(x - 1) * 885.85)), "cost")
    assert all(1e-100 < abs(number) < 1e100 for number in expression.atoms(sympy.Float))
    assert float(expression.subs(x, 1)) == pytest.approx(float(wrap(sympy.S.One).subs(x, 1)))


@pytest.mark.parametrize("scheme", ["midpoint", pytest.param("hermite-simpson", marks=pytest.mark.slow)])
def test_an_atmosphere_with_numbers_solves_as_with_parameters(scheme):
    """Density falls by exp(-885.85 (r - 1)), as in the reentry of Betts with radii in units of the Earth's."""

    def problem(rate):
        r, v, u = state("r"), state("v"), control("u")
        drag = v**2 * sympy.exp(-(r - 1) * rate)
        return Control(
            dynamics={r: v / 100, v: u - drag}, cost=u**2, duration=1, steps=6,
            start={r: 1.001, v: 0.5}, end={r: 1.004, v: 0.3},
        )  # fmt: skip

    (rate,) = parameters(k=885.85)
    numbers, symbols = (interpreted.of_problem(problem(k), scheme=scheme).solve() for k in (885.85, rate))
    assert numbers.status == symbols.status == "solved"
    assert numbers.cost == pytest.approx(symbols.cost, rel=1e-11)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (sympy.Float("6.42544015007536e384"), r"6\.42544015007536e\+384"),
        (sympy.Integer(10) ** 400, r"1\.00000000000000e\+400"),
        (sympy.Float("1.5e-400"), r"1\.50000000000000e-400"),
        (sympy.oo, "oo"),
    ],
    ids=str,
)
def test_other_numbers_are_refused_as_they_are(number, said):
    with pytest.raises(errors.ExpressionError, match=f"(?i)cost contains {said}, which no double"):
        checked(sympy.Mul(number, x, evaluate=False), "cost")
