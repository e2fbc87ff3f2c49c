"""Costs of the generated solver tend to the maximum principle's optimum, at least at the order of the scheme.

That is 2 at most, because controls that are constant on each interval, or averaged over it, are no better. Costs may
tend faster: where time reversal maps the problem to itself, odd powers of h cancel in the cost.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from codegen.analysis.exact_optimum import exact_optimum
from codegen.analysis.maximum_principle import beyond_maximum_principle
from codegen.analysis.reference_optimum import reference_optimum
from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.errors import CodegenError

_OF_CONTROLS = 2
"""The order of piecewise constant controls."""
_ALLOWED = 0.15
_ROUND_OFF = 1e-9
_LARGEST = 10_000
_TOLERANCE = 1e-9
_SECONDS = 30.0
"""Processor time for the optimum of the continuous problem."""


def check(context: Context) -> Iterator[Finding]:
    """Solve on N, 2N and 4N intervals, more if need be, and compare with the optimum of the continuous problem."""
    reason = beyond_maximum_principle(context.model)
    if reason:
        yield does_not_apply(
            "optimum", f"the maximum principle is derived here for plain problems, this one has {reason}"
        )
        return
    try:
        cost, source = optimal_cost(context)
    except CodegenError as error:
        yield not_measured("optimum", "convergence to the optimum", " ".join(str(error).split()))
        return
    yield _convergence(context, cost, source)


def optimal_cost(context: Context) -> tuple[float, str]:
    """The cost of the continuous optimum and where it comes from: in closed form, or by collocation nearby.

    Collocation starts from the discrete motion, so that it ends in the same one of several local optima, unless that
    motion cannot be trusted, as with controls on nodes.
    """
    model, solution = context.model, context.solution
    exact = exact_optimum(model)
    if exact is not None:
        return exact.cost_at(), "in closed form"
    guess = None
    if solution.status == "solved" and context.choices.controls == "interval":
        rates = solution.p if model.form == "hamiltonian" else np.gradient(solution.q, solution.t, axis=0)
        states = np.hstack([solution.q, rates])
        guess = solution.t, states, np.zeros_like(states)
    return reference_optimum(model, tolerance=_TOLERANCE, guess=guess, seconds=_SECONDS).cost, "by collocation"


def _convergence(context: Context, optimum: float, source: str) -> Finding:
    order, steps = min(context.scheme.order, _OF_CONTROLS), context.model.steps
    subject = "convergence to the optimum"
    errors: list[tuple[int, float]] = []
    while steps <= _LARGEST or len(errors) < 3:
        solution = context.module.solve(steps)
        if solution.status != "solved":
            return not_measured("optimum", subject, f"N = {steps}: {solution.message}")
        errors.append((steps, abs(solution.cost - optimum)))
        steps *= 2
        if len(errors) >= 3:
            rate = _rate(errors)
            if rate > order - _ALLOWED or errors[-1][1] < _ROUND_OFF * max(1.0, abs(optimum)):
                break
    listed = ", ".join(f"{error:.3g} (N = {n})" for n, error in errors[-3:])
    rate = _rate(errors)
    passed = rate > order - _ALLOWED or errors[-1][1] < _ROUND_OFF * max(1.0, abs(optimum))
    detail = f"J* = {optimum:.12g} {source}; errors {listed}; order {rate:.2f}, {order} is expected"
    return Finding("optimum", subject, passed, detail)


def _rate(errors: list[tuple[int, float]]) -> float:
    """The observed order from the two finest grids."""
    (_, coarse), (_, fine) = errors[-2:]
    return math.log2(coarse / fine) if coarse > 0.0 and fine > 0.0 else math.inf
