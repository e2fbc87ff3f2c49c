"""The motion inside an interval beside exact ones, and what a sample adds beside scipy's losses."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import sympy
from scipy.optimize import least_squares

from codegen import Control, Measurements, control, states, time
from codegen.discretise import schemes
from codegen.discretise.interval import FRACTION, STEP, one_step_interval, variational_interval
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes.base import FIRST_ORDER
from codegen.discretise.transcribe import transcribe


def measured(folder, **options) -> Measurements:
    """A state of the name x, measured at one time."""
    (folder / "m.csv").write_text("t,z\n0.5,0.3\n")
    return Measurements(folder / "m.csv", **options)


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        ("explicit-euler", 2),
        ("midpoint", 2),
        ("trapezoidal", 4),
        ("hermite-simpson", 4),
        ("gauss-4", 4),
        ("rk4", 4),
        ("suzuki-4", 4),
        ("gauss-6", 6),
    ],
)
def test_the_motion_inside_an_interval_has_the_order_of_its_scheme(folder, scheme, order):
    (x,), t = states("x"), time()
    observations = measured(folder, values={x: "z"})
    model = normalise(Control(dynamics={x: x * sympy.cos(t)}, duration=1, start={x: 1}, observations=observations))
    (inside,) = one_step_interval(model, schemes.find(scheme, FIRST_ORDER)).observed
    left, right = sympy.Symbol("x_k", real=True), sympy.Symbol("x_k1", real=True)
    value = sympy.lambdify([left, right, model.time, STEP, FRACTION], inside, "mpmath")

    def error(h: float) -> float:
        with mpmath.workdps(40):
            t_k, c = mpmath.mpf("0.4"), mpmath.mpf("0.3")
            exact = [mpmath.exp(mpmath.sin(t_k + part * h)) for part in (0, 1, c)]
            return float(abs(value(*exact[:2], t_k, h, c) - exact[2]))

    assert np.log2(error(2**-6) / error(2**-7)) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize(("scheme", "power"), [("gauss-4", 1), ("hermite-simpson", 2), ("gauss-6", 2)])
def test_controls_at_stages_are_polynomials(folder, scheme, power):
    (x,), u = states("x"), control("u")
    problem = Control(
        dynamics={x: u}, cost=u**2, duration=1, start={x: 0}, observations=measured(folder, values={x: "z"})
    )
    found = schemes.find(scheme, FIRST_ORDER)
    interval = one_step_interval(normalise(problem), found, "stages")
    h, c = sympy.Rational(1, 3), sympy.Rational(2, 7)
    given = {STEP: h, FRACTION: c, sympy.Symbol("x_k", real=True): 0}
    given[sympy.Symbol("x_k1", real=True)] = h ** (power + 1) / (power + 1)
    for stage, point in zip(interval.q.stage_controls, found.step().points, strict=True):
        given[stage[0]] = (h * point.abscissa) ** power
    exact = (h * c) ** (power + 1) / (power + 1)
    assert sympy.simplify(interval.observed[0].xreplace(given) - exact) == 0


def test_the_motion_of_a_discrete_lagrangian_is_its_polynomial(folder):
    from codegen import coordinate

    q, dq = coordinate("q")
    problem = Control(
        lagrangian=dq**2 / 2, duration=1, start={q: 0, dq: 1}, observations=measured(folder, values={q**2: "z"})
    )
    interval = variational_interval(normalise(problem), schemes.find("gauss-4", "variational"))
    nodes = [sympy.Symbol(name, real=True) for name in ("q_k", "q_stage1", "q_k1")]
    values = dict(zip(nodes, (1, 3, 4), strict=True))  # 1 + 5 c - 2 c^2
    at = interval.observed[0].xreplace(values)
    assert sympy.expand(at - (1 + 5 * FRACTION - 2 * FRACTION**2) ** 2) == 0


@pytest.mark.parametrize(("loss", "scipys"), [("squares", "linear"), ("huber", "huber"), ("soft-l1", "soft_l1")])
@pytest.mark.parametrize("error", [-3.0, -0.4, 0.0, 0.7, 2.5])
def test_losses_are_those_of_scipy(folder, loss, scipys, error):
    (x,) = states("x")
    options = {"values": {x: "z"}, "sigma": 0.5, "loss": loss}
    sample = transcribe(
        normalise(Control(dynamics={x: -x}, duration=1, start={x: 1}, observations=measured(folder, **options)))
    ).sample
    given = dict(zip(sample.symbols, (0, 0.3, 2.0), strict=True))
    found = sample.element.subs(given).subs(sympy.Symbol("x_k", real=True), 0.3 + error / 2)
    wanted = least_squares(lambda _: [error], [0.0], loss=scipys, max_nfev=1).cost
    assert float(found) == pytest.approx(2 * wanted, abs=1e-12)
