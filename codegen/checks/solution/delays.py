"""A motion with delays, followed from its history by another integrator under the controls that were found.

The equations are those of the whole problem, with its values of the past, as their author wrote them: neither segments
nor what joins them is known to DOP853. The distance from the motion of the module falls at the order of the scheme.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy
from scipy.integrate import solve_ivp

from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.drivers import find
from codegen.expressions.special_functions import NUMPY
from codegen.interfaces import Vector
from codegen.model import Model, legendre
from codegen.solutions.control import control_result
from codegen.solutions.result import Result, Run
from codegen.solutions.segments import put_together, segments_of

_LEAST_STEPS = 48
"""Intervals of the coarser motion, of all segments together."""
_ALLOWED = 0.5
"""By how much the observed order may be smaller: the controls of both motions differ."""
_ROUND_OFF = 1e-10
_OF_STAGES = 2
"""The order that is asked for where the control in between is a polynomial through values at stages."""


def check(context: Context) -> Iterator[Finding]:
    """Follow the motions on N and 2 N intervals."""
    whole = context.model.authored
    if not whole.delays:
        yield does_not_apply("delays", "there are no values of the past")
        return
    if whole.holonomic:
        yield does_not_apply("delays", "motions with holonomic constraints are not followed here")
        return
    segments = segments_of(context.module.metadata)
    number = segments.number if segments else 1
    steps = max(4, -(-_LEAST_STEPS // number))
    results = [_solved(context, n) for n in (steps, 2 * steps)]
    if not all(result.solved for result in results):
        reason = next(result.message for result in results if not result.solved)
        yield not_measured("delays", "the motion from its history", reason)
        return
    yield _finding(context, [_distance(whole, result) for result in results], steps * number)


def _solved(context: Context, steps: int) -> Result:
    """The author's result on so many intervals of each segment."""
    run, module = Run(steps), context.module
    attempt = find("newton").function("control")(module, run)
    return put_together(control_result(module, "newton", run, attempt), module.metadata)


def _finding(context: Context, distances: Sequence[float], steps: int) -> Finding:
    first, last = distances
    order = _OF_STAGES if context.choices.controls == "stages" else context.scheme.order
    seen = math.log2(first / last) if last > 0.0 else math.inf
    detail = (
        f"DOP853 with the controls that were found is {first:.1e} away on {steps} intervals and {last:.1e} on "
        f"{2 * steps}: order {seen:.2f}, at least {order} expected"
    )
    passed = last < _ROUND_OFF or seen > order - _ALLOWED
    return Finding("delays", "the motion from its history", passed, detail)


@dataclass(frozen=True)
class _Motion:
    """Equations of the whole problem as functions of numbers, and the pieces of the motion that are known so far."""

    result: Result
    rates: Callable[..., Sequence[float]]
    velocities: Callable[..., Sequence[float]]
    past: tuple[tuple[int, str, int, Callable[[float], float], float], ...]
    pieces: list[Callable[[float], Vector]] = field(default_factory=list)

    def follow(self) -> Vector:
        """The states at all nodes, a row for each."""
        t, x = self.result.t, np.concatenate([self.result.q[0], self.result.p[0]])
        states = [x]
        for k in range(t.size - 1):

            def rate(time: float, state: Vector, k: int = k) -> Sequence[float]:
                return self.rates(state, self._controls(k, time), time, self._values(k, time))

            piece = solve_ivp(rate, (t[k], t[k + 1]), x, "DOP853", rtol=1e-11, atol=1e-12, dense_output=True)
            self.pieces.append(piece.sol)
            x = piece.y[:, -1]
            states.append(x)
        return np.array(states)

    def _controls(self, k: int, time: float) -> Vector:
        """The controls at a time in interval k."""
        left, right = self.result.t[k], self.result.t[k + 1]
        inside = min(max(time, left + 1e-9 * (right - left)), right - 1e-9 * (right - left))
        return np.asarray(self.result.controls_at(np.array([inside]))[0])

    def _values(self, k: int, time: float) -> list[float]:
        """The values of the past at a time in interval k."""
        return [self._value(k - back, time - lag, kind, i, before) for back, kind, i, before, lag in self.past]

    def _value(self, k: int, time: float, kind: str, i: int, before: Callable[[float], float]) -> float:
        if k < 0:
            return float(before(time))
        if kind == "control":
            return float(self._controls(k, time)[i])
        state = self.pieces[k](time)
        return float(self.velocities(state, time)[i] if kind == "velocity" else state[i])


def _distance(whole: Model, result: Result) -> float:
    """How far the motion of a result is from the one that is followed, in parts of the largest value of each state."""
    side = legendre.hamiltonian_form(whole.with_free_ends)
    states, numbers = (*side.coordinates, *side.rates), side.default_values
    past = [delay.symbol for delay in whole.delays]
    names = [list(group) for group in (states, side.controls, past)]
    q_rates = [side.function.diff(p) for p in side.rates]
    slopes = [f - side.function.diff(q) for q, f in zip(side.coordinates, side.force, strict=False)]
    field_ = side.dynamics if side.form == "first-order" else (*q_rates, *slopes)

    def function(expressions: Sequence[sympy.Expr], *arguments: Any) -> Callable[..., Any]:
        plugged = [sympy.sympify(e).xreplace(numbers) for e in expressions]
        return sympy.lambdify(arguments, plugged, NUMPY)  # type: ignore[no-any-return]

    motion = _Motion(
        result,
        function(field_, names[0], names[1], side.time, names[2]),
        function(q_rates, names[0], side.time),
        tuple(_looked_up(whole, side, delay, result.t.size - 1, numbers) for delay in whole.delays),
    )
    found = np.column_stack([result.q, result.p])
    sizes = np.maximum(np.abs(found).max(axis=0), 1e-12)
    return float((np.abs(motion.follow() - found) / sizes).max())


def _looked_up(
    whole: Model, side: Model, delay: Any, steps: int, numbers: dict[sympy.Symbol, float]
) -> tuple[int, str, int, Callable[[float], float], float]:
    """Where a value of the past is found: intervals back, what it is, its index, its history, and the delay."""
    lag = float(delay.lag.xreplace(numbers))
    back = round(lag / float(whole.duration.xreplace(numbers)) * steps)
    history = sympy.lambdify(whole.time, delay.history.xreplace(numbers), NUMPY)
    states = (*side.coordinates, *side.rates)
    if delay.quantity in states:
        return back, "state", states.index(delay.quantity), history, lag
    if delay.quantity in whole.controls:
        return back, "control", whole.controls.index(delay.quantity), history, lag
    return back, "velocity", whole.rates.index(delay.quantity), history, lag
