"""Checks of the motion of a solution: holonomic constraints, conditions at inner times, delayed values.

A motion with delays, followed from its history by another integrator under the controls that were found. The equations
are those of the whole problem, with its values of the past, as their author wrote them: neither segments nor what joins
them is known to DOP853. The distance from the motion of the module falls at the order of the scheme.

Conditions at inner times along the computed motion, as the author wrote them, and the times themselves. Node,
coordinates and rates are read off the solution: nothing of the module's own tables or kernels takes part.

Costs of the generated solver tend to the maximum principle's optimum, at least at the order of the scheme.

That is 2 at most, because controls that are constant on each interval, or averaged over it, are no better. Costs may
tend faster: where time reversal maps the problem to itself, odd powers of h cancel in the cost.

The second-order condition: a solution is a minimum, and no saddle point, where the KKT matrix has the right inertia. At
a strict local minimum the Hessian of the Lagrangian is positive definite on the null space of the equations, and then
the KKT matrix has exactly one negative eigenvalue for every equation (Nocedal and Wright, 2006, theorem 16.3). An
unknown at its bound is held there by a multiplier z, which adds z / distance to the diagonal.

Sensitivities of a solution against central differences of the problem solved again, with other data. All quantities
change at once, in proportions drawn at random: first by themselves, then parameters alone, which boundary values and
the duration follow. Where that leaves no solution, as beyond the range of a table or a bound on a prescribed value,
those that cannot change even alone stay as they are, and are named. Differences with three lengths, halved each time,
are extrapolated twice (Richardson): the two results differ by what the reference may be off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.sparse import coo_array
from scipy.sparse.linalg import LinearOperator, onenormest, splu
from sympy import Expr

from codegen.batch.quantities import Quantity, given_to, quantities
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import InnerCondition, Model
from codegen.discretise.program import ControlProgram
from codegen.errors import CodegenError
from codegen.evidence.analysis.maximum_principle import beyond_maximum_principle, exact_optimum, reference_optimum
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.runtime.search import callbacks
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.solving.drivers import find
from codegen.solving.interfaces import Vector
from codegen.solving.results.control import control_result
from codegen.solving.results.result import Result, Run
from codegen.solving.results.segments import put_together, segments_of
from codegen.symbolic.special_functions import NUMPY


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


_OF_CONTROLS = 2
"""The order of piecewise constant controls."""
_COST_ALLOWED = 0.15
_COST_ROUNDING = 1e-9
_LARGEST = 10_000
_TOLERANCE = 1e-9
_SECONDS = 30.0
"""Processor time for the optimum of the continuous problem."""


def check_optimum(context: Context) -> Iterator[Finding]:
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
            if rate > order - _COST_ALLOWED or errors[-1][1] < _COST_ROUNDING * max(1.0, abs(optimum)):
                break
    listed = ", ".join(f"{error:.3g} (N = {n})" for n, error in errors[-3:])
    rate = _rate(errors)
    passed = rate > order - _COST_ALLOWED or errors[-1][1] < _COST_ROUNDING * max(1.0, abs(optimum))
    detail = f"J* = {optimum:.12g} {source}; errors {listed}; order {rate:.2f}, {order} is expected"
    return Finding("optimum", subject, passed, detail)


def _rate(errors: list[tuple[int, float]]) -> float:
    (_, coarse), (_, fine) = errors[-2:]
    return math.log2(coarse / fine) if coarse > 0.0 and fine > 0.0 else math.inf


_NOTHING = (1e-9, 1e-8, 1e-7)
"""Parts of the second derivatives below which a curvature may be rounding of the elimination."""
_ACTIVE, _FAST = 1.0, 1e12
"""From the first on z / distance counts as holding an unknown (inside the bounds it is as small as the tolerance); no
more than the second is needed to hold it fast, and it would be infinite on the bound itself."""
_REGULAR = 1e13
"""Condition numbers below it are those of regular matrices."""


def check_second_order(context: Context) -> Iterator[Finding]:
    """Count the negative eigenvalues at the solution by a symmetric elimination, which is exact."""
    module, solution = context.module, context.solution
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured("second-order condition", subject, solution.message)
        return
    grid = module.make_grid((solution.t.size - 1) // max(1, len(context.control.phases)))
    diagonal = held_by_bounds(module, grid, solution.unknowns)
    sizes = sizes_of_curvature(module, grid, solution.unknowns)
    sizes[slacks(context.control, module, grid)] = 0.0  # they follow from other unknowns
    judged = _judged(module, grid, solution.unknowns, diagonal, sizes)
    if judged is None and is_determined(module, grid, solution.unknowns, diagonal):
        yield does_not_apply("second-order condition", "the equations alone determine the solution, whatever it costs")
        return
    if judged is None:
        yield not_measured("second-order condition", subject, "equations depend on each other at the solution")
        return
    passed, detail = judged
    if module.metadata.inequalities:
        detail += f" ({np.count_nonzero(diagonal > _ACTIVE)} unknowns are held by bounds)"
    yield Finding("second-order condition", subject, passed, detail)


def is_determined(module: Any, grid: Any, unknowns: NDArray[np.float64], diagonal: NDArray[np.float64]) -> bool:
    """Whether there are as many equations as unknowns that no bound holds, and their Jacobian is regular.

    Regular to rounding, that is, after rows and columns are brought to sizes of one.
    """
    free = diagonal[module.primal_unknowns(grid)] <= _ACTIVE
    rows, columns, values = callbacks.jacobian(grid, unknowns)
    shape = (module.multiplier_unknowns(grid).size, free.size)
    matrix = coo_array((values, (rows, columns)), shape=shape).tocsc()[:, free]
    if matrix.shape[0] != matrix.shape[1]:
        return False
    for axis in (1, 0):  # rows, then columns
        largest = abs(matrix).max(axis=axis).toarray()
        if not largest.all():
            return False
        matrix = matrix.multiply(1.0 / (largest[:, None] if axis == 1 else largest)).tocsc()
    try:
        factors = splu(matrix)
    except RuntimeError:  # exactly singular
        return False
    inverse = LinearOperator(matrix.shape, factors.solve, rmatvec=lambda vector: factors.solve(vector, "T"))
    return bool(onenormest(matrix) * onenormest(inverse) < _REGULAR)


def held_by_bounds(module: Any, grid: Any, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The diagonal z / distance of the unknowns that push against a bound; z is the gradient of the Lagrangian."""
    diagonal = np.zeros(unknowns.size)
    if not module.metadata.inequalities:
        return diagonal
    gradient = np.where(grid.is_multiplier, 0.0, module.evaluate(grid, unknowns).gradient)
    lower, upper = module.variable_bounds(grid)
    for z, distance in ((gradient, unknowns - lower), (-gradient, upper - unknowns)):
        pushes = np.isfinite(distance) & (z > 0.0)
        diagonal[pushes] += np.minimum(z[pushes] / np.maximum(distance[pushes], 1e-100), _FAST)
    return diagonal


def slacks(program: ControlProgram, module: Any, grid: Any) -> NDArray[np.bool_]:
    """Which unknowns of nodes and intervals are slacks of inequalities."""
    marked = np.zeros(grid.is_multiplier.size)
    nodes, intervals = module.views(grid, marked)
    of_interval = intervals.shape[2] - len(program.slacks)
    intervals[:, :, of_interval:] = 1.0
    for end in (program.start, program.end):
        nodes[:, :, [slack for slack, _ in end.slacks]] = 1.0
    return marked > 0.0


def _judged(
    module: Any, grid: Any, unknowns: NDArray[np.float64], diagonal: NDArray[np.float64], sizes: NDArray[np.float64]
) -> tuple[bool, str] | None:
    """Whether it is a minimum, and how that is known; None where the KKT matrix is singular whatever the curvature."""
    equations, system = module.multiplier_unknowns(grid).size, allocate_system(grid)
    excess = factor_kkt(grid, unknowns, 1.0, diagonal, system)
    if excess == 0 and factor_kkt(grid, unknowns, 1.0, diagonal - _NOTHING[0] * sizes, system) == 0:
        return True, f"a strict local minimum: {equations} negative eigenvalues for {equations} equations"
    # Where a symmetry moves an optimum to another one, the curvature is zero along it, and its sign is rounding.
    for part in _NOTHING:
        if factor_kkt(grid, unknowns, 1.0, diagonal + part * sizes, system) == 0:
            return (
                True,
                f"a minimum, isolated or not: a curvature is zero up to rounding, above -{part:g} of its terms",
            )
    if excess is not None and excess > 0:
        return False, f"no minimum: the cost decreases to second order in {excess} or more independent directions"
    return None


def sizes_of_curvature(module: Any, grid: Any, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    """For every unknown but multipliers the size of its second derivatives, or of a typical one if it has none."""
    rows, _, values = callbacks.hessian(grid, unknowns)
    free, sizes = module.primal_unknowns(grid), np.zeros(unknowns.size)
    np.maximum.at(sizes, free[rows], np.abs(values))
    present = sizes[sizes > 0.0]
    sizes[free[sizes[free] == 0.0]] = np.median(present) if present.size else 1.0
    return sizes


_SENSITIVITIES = "sensitivities"
_LENGTHS = (1e-2, 1e-3, 1e-4)
"""Of changes to both sides, in parts of quantities."""
_SENSITIVITY_ALLOWED, _ROUGH = 1e-6, 1e-5
"""Parts of the largest entry that differences may be; and that references may be off, beyond which they say nothing."""
_KINK = 1e-3
"""Parts of a derivative by which those to both sides differ where there is none."""
_FLOOR = 1e-3
"""Parts of the largest value below which its derivatives are compared as if they were that large."""
_KINDS = ("cost", "q", "u", "multipliers")
_TOLERANCES = (1e-12, 1e-10)


@dataclass(frozen=True)
class _Direction:
    """Quantities that change, their values, and by how much they do."""

    subject: str
    varied: tuple[Quantity, ...]
    values: tuple[Any, ...]
    changes: Any
    given: tuple[str, ...]


def check_sensitivities(context: Context) -> Iterator[Finding]:
    """Compare along two directions."""
    module, solution = context.module, context.solution
    if module.metadata.sensitivities is None:
        yield does_not_apply(_SENSITIVITIES, "the module has none, unless it is built with --sensitivities")
        return
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured(_SENSITIVITIES, subject, solution.message)
        return
    steps = (solution.t.size - 1) // max(1, len(context.control.phases))
    solution = _solved_nearby(module, steps, {}, solution.unknowns) or solution
    for direction in _directions(module, module.make_grid(steps)):
        yield _compared(module, steps, solution, direction)


def _directions(module: Any, grid: Any) -> Iterator[_Direction]:
    """Changes of everything by itself, and of parameters, which all else follows."""
    names, count = module.QUANTITIES, len(module.metadata.parameters)
    values = (*grid.parameters[:, : module.OWN_QUANTITIES].T, grid.steps * grid.h)[: len(names)]
    own = tuple(v if i >= count else float(np.max(v)) for i, v in enumerate(values))
    sizes = np.array([max(float(np.abs(value).max()), 0.1) for value in own])
    signs = np.random.default_rng(11).uniform(0.3, 1.0, len(names)) * np.where(np.arange(len(names)) % 2, 1.0, -1.0)
    known = quantities(names, module, ())
    given = tuple(names[count:])
    yield _Direction("all quantities by themselves", known, own, sizes * signs, given)
    if given and count:
        yield _Direction("parameters, which others follow", known[:count], own[:count], (sizes * signs)[:count], ())


def _compared(module: Any, steps: int, solution: Any, direction: _Direction) -> Finding:
    grid, subject = module.make_grid(steps), f"{direction.subject}, {steps} intervals"
    found = module.sensitivities(grid, solution.unknowns, direction.given)
    if found.failure:
        return not_measured(_SENSITIVITIES, subject, found.failure)
    if found.doubtful.size:
        return not_measured(_SENSITIVITIES, subject, f"strict complementarity fails for {found.doubtful.size} unknowns")
    direction, references, left_out = _references(module, steps, solution, direction)
    if not references:
        return not_measured(_SENSITIVITIES, subject, f"the problem beside the solution is not solved{left_out}")
    subject += left_out
    pairs = [pair[:2] for pair in references]
    if any(_bends(references, kind, _array(solution, kind)) for kind in _KINDS):
        return not_measured(_SENSITIVITIES, subject, "derivatives to both sides differ, as where bounds begin to hold")
    said = _along(module, grid, solution, found, direction)
    worst, beyond, rough, of = 0.0, 0.0, 0.0, ""
    for kind in _KINDS:
        at = np.asarray(getattr(solution, kind), dtype=float)
        if not at.size:
            continue
        floor = _FLOOR * float(np.abs(at).max())
        errors = []
        for coarse, fine in pairs:
            scale = max(float(np.abs(fine[kind]).max()), floor, 1e-300)
            noise = float(np.abs(fine[kind] - coarse[kind]).max()) / scale
            errors.append((noise, float(np.abs(said[kind] - fine[kind]).max()) / scale))
        noise, error = min(errors)
        rough = max(rough, noise)
        worst = max(worst, error)
        if not error - 10.0 * noise <= max(beyond, _SENSITIVITY_ALLOWED):
            beyond, of = error - 10.0 * noise, kind
    if rough > _ROUGH:
        return not_measured(
            _SENSITIVITIES, subject, f"differences do not converge, only to {rough:.0e}, as where bounds change"
        )
    detail = f"differ by at most {worst:.1e} from central differences, which are good to {rough:.0e}"
    return Finding(_SENSITIVITIES, subject, not of, f"those of {of} {detail}" if of else detail)


def _along(module: Any, grid: Any, solution: Any, found: Any, direction: _Direction) -> dict[str, Any]:
    """The derivatives along a direction by those that were found."""
    total: dict[str, Any] = dict.fromkeys(_KINDS, 0.0)
    for quantity, change in zip(direction.varied, direction.changes, strict=True):
        i = module.QUANTITIES.index(quantity.name)
        _, q, _, u, multipliers = module.unpacked_rates(grid, solution.unknowns, found, i)
        for kind, own in (("cost", found.cost[i]), ("q", q), ("u", u), ("multipliers", multipliers)):
            total[kind] = total[kind] + change * own
    return total


def _references(
    module: Any, steps: int, solution: Any, direction: _Direction
) -> tuple[_Direction, list[tuple[dict[str, Any], ...]], str]:
    """The direction along which there are references of all lengths, these, and words for what it leaves out.

    There are none where the problem is not solved beside the solution, though every quantity can change alone.
    """
    found = [_reference(module, steps, solution, direction, length) for length in _LENGTHS]
    references = [pair for pair in found if pair is not None]
    if len(references) == len(found):
        return direction, references, ""
    count = len(direction.varied)
    can = np.array([_can_change(module, steps, solution, direction, np.arange(count) == i) for i in range(count)])
    if can.all() or not can.any():
        return direction, [], ""
    left_out = ", ".join(direction.varied[i].name for i in np.flatnonzero(~can))
    direction = _part(direction, can)
    found = [_reference(module, steps, solution, direction, length) for length in _LENGTHS]
    references = [pair for pair in found if pair is not None]
    return direction, references if len(references) == len(found) else [], f", without {left_out}"


def _can_change(module: Any, steps: int, solution: Any, direction: _Direction, which: Any) -> bool:
    """Whether there are solutions to both sides of some quantities' values, as far as the longest differences go."""
    alone = _part(direction, which)
    return all(_moved(module, steps, solution, alone, side * _LENGTHS[0]) is not None for side in (1, -1))


def _part(direction: _Direction, which: Any) -> _Direction:
    return replace(direction, changes=np.where(which, direction.changes, 0.0))


def _reference(
    module: Any, steps: int, solution: Any, direction: _Direction, length: float
) -> tuple[dict[str, Any], ...] | None:
    """Extrapolated differences with a length and its half, with its half and quarter, and what both sides differ by."""
    differences, bend = [], dict[str, Any]()
    for part in (length, 0.5 * length, 0.25 * length):
        ends = [_moved(module, steps, solution, direction, side * part) for side in (1, -1)]
        if ends[0] is None or ends[1] is None:
            return None
        above, below = ends
        if part == length:
            for kind in _KINDS:
                sides = _array(above, kind) + _array(below, kind) - 2.0 * _array(solution, kind)
                bend[kind] = float(np.abs(sides).max(initial=0.0)) / length
        differences.append({kind: (_array(above, kind) - _array(below, kind)) / (2 * part) for kind in _KINDS})
    return _extrapolated(differences[:2]), _extrapolated(differences[1:]), bend


def _extrapolated(differences: Sequence[dict[str, Any]]) -> dict[str, Any]:
    coarse, fine = differences
    return {kind: (4.0 * fine[kind] - coarse[kind]) / 3.0 for kind in _KINDS}


def _bends(references: Sequence[tuple[dict[str, Any], ...]], kind: str, values: Any) -> bool:
    """Whether derivatives to both sides differ by more than curvature makes them, which is in proportion to lengths."""
    _, _, longer = references[-2]
    _, fine, bend = references[-1]
    largest = max(float(np.abs(fine[kind]).max(initial=0.0)), _FLOOR * float(np.abs(values).max(initial=0.0)))
    return bool(bend[kind] > max(0.3 * longer[kind], _KINK * largest))


def _array(solution: Any, kind: str) -> Any:
    return np.asarray(getattr(solution, kind), dtype=float)


def _moved(module: Any, steps: int, solution: Any, direction: _Direction, part: float) -> Any:
    """The solution with other data, or None."""
    moved = zip(direction.varied, direction.values, direction.changes, strict=True)
    return _solved_nearby(module, steps, given_to({q: v + part * change for q, v, change in moved}), solution.unknowns)


def _solved_nearby(module: Any, steps: int, values: dict[str, Any], start: Any) -> Any:
    """What is found near a solution, to the least tolerance that is reached; None where none is."""
    for tolerance in _TOLERANCES:
        found = module.solve(steps, **values, guess=start, warm=True, tolerance=tolerance)
        if found.status == "solved":
            return found
    return None
