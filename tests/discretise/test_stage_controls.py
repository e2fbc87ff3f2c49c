"""Controls at the stages of a scheme: orders of optima, bounds, times, polynomials, checks, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from interpreted import text_of, without_compilation

from codegen import Control, Simulate, canonical_pair, control, coordinate, states, time
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes import find
from codegen.discretise.transcribe import transcribe
from codegen.emit.naming import Choices, choice_texts
from codegen.errors import ArgumentError
from codegen.evidence.checks import CHECKS
from codegen.evidence.checks.base import Context
from codegen.solving.results.result import Result

E = np.e
DRIFT = (2.0 * E - 2.0) ** 2 / (E**2 - 1.0)
"""Least integral of (u - t)^2/2 with x' = x + u from 1 to 0 in unit time: u - t = -c e^(1-t)."""


def drift() -> Control:
    x = states("x")[0]
    u, t = control("u"), time()
    return Control(dynamics={x: x + u}, cost=(u - t) ** 2 / 2, duration=1, start={x: 1}, end={x: 0})


def oscillator() -> Control:
    """From (1, 0) to rest at 0 in time 2 with x'' = -x + u: a linear system, whose least effort is a Gramian's."""
    x, v = coordinate("x")
    u = control("u")
    return Control(
        lagrangian=(v**2 - x**2) / 2, force={x: u}, cost=u**2 / 2, duration=2, start={x: 1, v: 0}, end={x: 0, v: 0}
    )


def least_effort_of_the_oscillator() -> float:
    """d' W^-1 d / 2 with the free motion's end d and W = int e^(As) B B' e^(A's) ds over the duration."""
    s, c = np.sin(2.0), np.cos(2.0)
    gramian = np.array([[1.0 - s * c / 2.0, s**2 / 2.0], [s**2 / 2.0, 1.0 + s * c / 2.0]])
    free = np.array([c, -s])
    return float(free @ np.linalg.solve(gramian, free) / 2.0)


def optimum(problem: Control, steps: int, **choices: str):
    module = without_compilation(text_of(problem, controls="stages", **choices))
    solution = module.solve(steps, tolerance=1e-13)
    assert solution.status == "solved", solution.message
    return module, solution


CASES = [
    ("one-step", "hermite-simpson", 4), ("one-step", "rk4", 4), ("one-step", "gauss-4", 4), ("one-step", "gauss-6", 6),
    ("one-step", "trapezoidal", 2),
    ("variational", "gauss-4", 4), ("variational", "lobatto-4", 4), ("variational", "gauss-6", 6),
    ("hamiltonian", "gauss-4", 4), ("hamiltonian", "lobatto-4", 4), ("hamiltonian", "gauss-6", 6),
]  # fmt: skip


@pytest.mark.parametrize(("method", "scheme", "order"), CASES)
def test_costs_converge_at_the_order_of_the_scheme(method, scheme, order):
    problem, exact = (drift(), DRIFT) if method == "one-step" else (oscillator(), least_effort_of_the_oscillator())
    errors = [
        abs(optimum(problem, steps, method=method, scheme=scheme)[1].cost - exact)
        for steps in ((4, 8) if order < 6 else (2, 4))
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


def test_the_midpoint_rule_has_one_stage():
    alone = without_compilation(text_of(drift())).solve(6)
    _, at_stage = optimum(drift(), 6)
    np.testing.assert_allclose(at_stage.cost, alone.cost, rtol=1e-13)
    np.testing.assert_allclose(at_stage.u, alone.u, rtol=1e-12)


def test_controls_have_a_row_for_each_stage_and_its_time():
    module, solution = optimum(drift(), 5, scheme="gauss-4")
    assert solution.u.shape == (10, 1)
    result = as_result(module, solution)
    offset = np.sqrt(3.0) / 6.0
    np.testing.assert_allclose(result.control_times[:2], 0.2 * np.array([0.5 - offset, 0.5 + offset]), rtol=1e-15)
    # u = t - c e^(1-t), to the order of what each stage's control is.
    c = (2.0 * E - 2.0) * 2.0 / (E**2 - 1.0)
    exact = result.control_times - c * np.exp(1.0 - result.control_times)
    np.testing.assert_allclose(result.u[:, 0], exact, atol=3e-3)


def as_result(module, solution) -> Result:
    empty = dict.fromkeys(("problem", "title", "task", "method", "scheme", "driver", "status", "message"), "")
    return Result(
        **empty, steps=5, residual=0.0, iterations=0, t=solution.t, q=solution.q, p=solution.p, u=solution.u,
        names={}, summary={}, stage_abscissae=module.metadata.stage_abscissae,
    )  # fmt: skip


@pytest.mark.parametrize("scheme", ["gauss-4", "gauss-6", "hermite-simpson", "rk4"])
def test_between_stages_controls_are_polynomials_through_them(scheme):
    module, solution = optimum(drift(), 4, scheme=scheme)
    result = as_result(module, solution)
    at_stages = result.controls_at(result.control_times - 1e-14)
    if scheme == "rk4":  # two stages in the middle of a step have one value there, their mean
        middle = result.u.reshape(4, 4)[:, 1:3].mean(axis=1)
        np.testing.assert_allclose(at_stages.reshape(4, 4)[:, 1], middle, rtol=1e-9)
    else:
        inner = (np.array(module.metadata.stage_abscissae * 4) > 0.0).nonzero()[0]
        np.testing.assert_allclose(at_stages[inner], result.u[inner], rtol=1e-9)


def test_bounds_hold_at_every_stage():
    problem = drift()
    u = next(s for s in problem.cost.free_symbols if s.name == "u")
    problem = replace(problem, bounds={u: (-2.0, None)})
    _, free = optimum(replace(problem, bounds={}), 8, scheme="gauss-4")
    _, bounded = optimum(problem, 8, scheme="gauss-4")
    assert free.u.min() < -2.2
    assert bounded.u.min() >= -2.0
    assert bounded.u.min() == pytest.approx(-2.0, abs=1e-8)
    assert bounded.cost > free.cost


@pytest.mark.parametrize(("method", "scheme"), [("one-step", "gauss-4"), ("variational", "lobatto-4")])
def test_checks_of_expressions_pass(method, scheme):
    model = normalise(drift() if method == "one-step" else oscillator())
    program = transcribe(model, scheme, method, "stages")
    context = Context(Choices(scheme, method, "stages"), model, program, find(scheme, method), None)
    for name in ("discrete equations", "null controls", "consistency"):
        findings = list(CHECKS[name].findings(context))
        assert findings
        assert all(finding.passed for finding in findings), findings


def test_refusals():
    q, p = canonical_pair("q", "p")
    motion = Simulate(hamiltonian=p**2 / 2, duration=1, start={q: 0, p: 1})
    with pytest.raises(ArgumentError, match="a simulation has no controls"):
        transcribe(normalise(motion), controls="stages")
    with pytest.raises(ArgumentError, match="use interval, stages, linear or nodal"):
        choice_texts(Choices(controls="points"))
