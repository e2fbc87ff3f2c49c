"""Checks of the motion of a solution: holonomic constraints, conditions at inner times, delayed values.

A motion with delays, followed from its history by another integrator under the controls that were found. The equations
are those of the whole problem, with its values of the past, as their author wrote them: neither segments nor what joins
them is known to DOP853. The distance from the motion of the module falls at the order of the scheme.

Conditions at inner times along the computed motion, as the author wrote them, and the times themselves. Node,
coordinates and rates are read off the solution: nothing of the module's own tables or kernels takes part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from sympy import Expr

from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import InnerCondition, Model
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.solving.drivers import find
from codegen.solving.loading import Vector
from codegen.solving.results.control import control_result
from codegen.solving.results.result import Result, Run
from codegen.solving.results.segments import put_together, segments_of
from codegen.symbolic.functions import NUMPY


def free_values(module: Any, solution: Any) -> NDArray[np.float64]:
    """The free parameters at a solution, in the order in which they were declared."""
    count = len(module.metadata.free_parameters)
    end = solution.unknowns.size - module.problem.structure.couplings
    return np.asarray(solution.unknowns[end - count : end])


def integral_of_cost(model: Model, module: Any, solution: Any) -> float:
    """The integral of the running cost of all bodies along a solution with controls on nodes, by Simpson's rule.

    Between nodes coordinates, momenta and controls are linear functions of time, and velocities are constant.
    """
    free = [parameter.symbol for parameter in model.free_parameters]
    symbols = [*model.coordinates, *model.rates, *model.controls, model.time, *model.parameters, *free]
    function = sympy.lambdify(symbols, model.cost, modules=NUMPY, cse=True)
    constants = [*model.defaults, *free_values(module, solution)]
    h, total = np.diff(solution.t), 0.0

    def of_body(values: NDArray[np.float64], width: int, body: int) -> NDArray[np.float64]:
        return values[:, body * width : (body + 1) * width]

    for body in range(model.bodies):
        q, u = (of_body(v, len(s), body) for v, s in ((solution.q, model.coordinates), (solution.u, model.controls)))
        slopes = np.diff(q, axis=0) / h[:, None]
        for weight, abscissa in ((1, 0.0), (4, 0.5), (1, 1.0)):
            q_here, u_here = ((1.0 - abscissa) * v[:-1] + abscissa * v[1:] for v in (q, u))
            rates = slopes if model.form == "lagrangian" else np.empty((h.size, 0))
            if model.form == "hamiltonian":
                p = of_body(solution.p, len(model.rates), body)
                rates = (1.0 - abscissa) * p[:-1] + abscissa * p[1:]
            values = function(*q_here.T, *rates.T, *u_here.T, solution.t[:-1] + abscissa * h, *constants)
            total += weight / 6.0 * float(np.sum(h * values))
    return total


_HELD = 1e-9


def check_holonomic_drift(context: Context) -> Iterator[Finding]:
    """Evaluate every constraint at all nodes of the solution, in units of its own terms."""
    model = context.model
    solution = context.solution
    if solution.status != "solved":
        yield not_measured("holonomic drift", "all constraints", solution.message)
        return
    numbers = [*model.defaults, *free_values(context.module, solution)]
    symbols = [*model.coordinates, model.time, *model.parameters, *(p.symbol for p in model.free_parameters)]
    width = len(model.coordinates)
    for constraint in model.holonomic:
        terms = sympy.Add.make_args(constraint)
        function = sympy.lambdify(symbols, [constraint, sum(map(sympy.Abs, terms), sympy.S.Zero)], cse=True)
        largest, size, node, body = 0.0, 1.0, 0, 0
        for b in range(model.bodies):
            q = solution.q[:, b * width : (b + 1) * width].T
            values, sizes = (np.broadcast_to(v, solution.t.shape) for v in function(*q, solution.t, *numbers))
            if np.abs(values).max() >= largest:
                node, body = int(np.argmax(np.abs(values))), b
                largest, size = float(np.abs(values[node])), max(1.0, float(np.abs(sizes).max()))
        passed = largest <= _HELD * size
        of_body = f" of body {body}" if model.bodies > 1 else ""
        detail = f"|c| <= {largest:.1g} at all {solution.t.size} nodes, greatest at node {node}{of_body}"
        if not passed:
            detail = f"the motion leaves the constraint: |c| = {largest:.2g} at node {node}{of_body}"
        yield Finding("holonomic drift", f"c = {sympy.sstr(constraint)}", passed, detail)


_NAME = "inner times"
_MET = 1e-7


def check_inner_times(context: Context) -> Iterator[Finding]:
    """One finding for each condition, and one for the times."""
    model = context.model
    solution = context.solution
    if solution.status != "solved":
        yield not_measured(_NAME, "all conditions", solution.message)
        return
    free = [p.symbol for p in model.free_parameters]
    numbers = dict(zip(model.parameters, model.defaults, strict=True))
    numbers |= dict(zip(free, free_values(context.module, solution), strict=True))
    nodes = _nodes(context, numbers)
    for condition in model.inner_conditions:
        yield _held(context, condition, nodes[condition.number], numbers)
    # Whether times are those that are given, or inside their windows, and in order.
    found = solution.t[nodes]
    slack = _MET * max(1.0, float(np.abs(found).max()))
    wrong = []
    for number, (inner, time) in enumerate(zip(model.inner_times, found, strict=True), start=1):
        missed = [abs(time - _number(inner.time, numbers))] if inner.time is not None else []
        missed += [_number(inner.earliest, numbers) - time] if inner.earliest is not None else []
        missed += [time - _number(inner.latest, numbers)] if inner.latest is not None else []
        if max(missed, default=0.0) > slack:
            wrong.append(f"time {number} is {time:.6g}, which misses what is given by {max(missed):.2g}")
    if (np.diff(found) < -slack).any():
        wrong.append("the times are not in order")
    listed = ", ".join(f"{time:.6g}" for time in found)
    yield Finding(_NAME, "times", not wrong, wrong[0] if wrong else f"in order, as given: t = {listed}")


def _nodes(context: Context, numbers: dict[sympy.Symbol, float]) -> NDArray[np.int64]:
    """The node nearest to every given time, and of free ones that which the module's grid tells."""
    t, model = context.solution.t, context.model
    kept = context.module.make_grid(t.size - 1).inner
    given = [None if inner.time is None else _number(inner.time, numbers) for inner in model.inner_times]
    pairs = zip(given, kept, strict=True)
    return np.array([node if time is None else int(np.argmin(np.abs(t - time))) for time, node in pairs])


def _held(context: Context, condition: InnerCondition, node: int, numbers: dict[sympy.Symbol, float]) -> Finding:
    """How far a condition is from holding, in units of its own terms, for the body that is farthest."""
    model, solution, width = context.model, context.solution, len(context.model.coordinates)
    rates, worst = dict(zip(model.rates, _rates(context), strict=True)), 0.0
    symbols = [*model.coordinates, *_momenta(context), model.time, *numbers]
    expression = condition.expression.subs(rates, simultaneous=True)
    size = sympy.Add(*map(sympy.Abs, sympy.Add.make_args(expression)))
    function = sympy.lambdify(symbols, [expression, size], modules=NUMPY, cse=True)
    for body in range(model.bodies):
        here = slice(body * width, (body + 1) * width)
        own = [*solution.q[node, here], *(solution.p[node, here] if model.rates else ())]
        value, scale = function(*own, solution.t[node], *numbers.values())
        excess = abs(value) if condition.equality else max(0.0, value)
        worst = max(worst, float(excess) / max(1.0, float(scale)))
    detail = f"at node {node}, t = {solution.t[node]:.6g}, it {'holds to' if worst <= _MET else 'fails by'} {worst:.1g}"
    return Finding(_NAME, str(condition), bool(worst <= _MET), detail)


def _momenta(context: Context) -> tuple[sympy.Symbol, ...]:
    model = context.model
    return model.rates if model.form == "hamiltonian" or not model.rates else legendre.conjugate_symbols(model)


def _rates(context: Context) -> tuple[Expr, ...]:
    """The author's rates in these symbols."""
    model: Any = context.model
    if model.form != "lagrangian":
        return tuple(model.rates)
    used = {s for c in model.inner_conditions for s in c.expression.free_symbols}
    return legendre.velocity_of_momentum(model) if used & set(model.rates) else tuple(model.rates)


def _number(expression: Expr | None, numbers: dict[sympy.Symbol, float]) -> float:
    return float(sympy.sympify(expression).subs(numbers))


_LEAST_STEPS = 48
"""Intervals of the coarser motion, of all segments together."""
_ALLOWED = 0.5
"""By how much the observed order may be smaller: the controls of both motions differ."""
_ROUND_OFF = 1e-10
_OF_STAGES = 2
"""The order that is asked for where the control in between is a polynomial through values at stages."""


def check_delays(context: Context) -> Iterator[Finding]:
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
