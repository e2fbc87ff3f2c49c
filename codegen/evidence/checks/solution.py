"""Checks of a computed solution: its motion, its optimality and its sensitivities.

Motion: holonomic constraints at all nodes, contact laws on all intervals, and the author's conditions at inner times.
Nodes, coordinates and rates come from the solution, not from tables or kernels of the module. A motion with delays is
integrated from its history by DOP853 under the controls of the solution. The integrated equations are the author's,
with delayed values; only the module divides the motion into segments. The distance between both motions must decrease
at the order of the scheme.

Optimum: the costs of the module must converge to the optimum of the maximum principle, at least at the order of the
scheme. The expected order is at most 2, because controls are constant on each interval or averaged over the interval.
Costs may converge faster: if time reversal maps the problem to itself, odd powers of h cancel in the cost.

Second-order condition: a solution is a minimum, not a saddle point, if the KKT matrix has the right inertia. At a
strict local minimum the Hessian of the Lagrangian is positive definite on the null space of the equations. Then the KKT
matrix has exactly one negative eigenvalue for every equation (Nocedal and Wright, 2006, theorem 16.3). A multiplier z
of an active bound adds z / distance to the diagonal.

Sensitivities: the derivatives of a solution with respect to data are compared with central differences of solutions
with changed data. Quantities change together in random proportions: first all independently, then parameters alone, on
which boundary values and the duration depend. Some changes leave no solution, for example beyond the range of a table.
Then quantities that cannot change alone stay fixed, and the finding names them. Differences with three increments,
halved each time, are extrapolated twice (Richardson). The distance of both results estimates the reference's error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
import sympy
from scipy.integrate import solve_ivp
from scipy.sparse import coo_array
from scipy.sparse.linalg import LinearOperator, onenormest, splu
from sympy import Expr, Symbol

from codegen.batch.request import Quantity, given_to, quantities
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Delay, Model
from codegen.errors import CodegenError
from codegen.evidence.analysis.maximum_principle import beyond_maximum_principle, exact_optimum, reference_optimum
from codegen.evidence.analysis.modified_equations import vector_field
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.runtime.search import point
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.stepping.motion import constraint_values
from codegen.solving.arcs import order_of_optima
from codegen.solving.drivers import find
from codegen.solving.loading import ControlSolution, Grid, Vector
from codegen.solving.results.control import control_result
from codegen.solving.results.result import Result, Run
from codegen.solving.results.segments import put_together, segments_of
from codegen.symbolic.functions import NUMPY


def free_values(module: ModuleType, solution: ControlSolution) -> Vector:
    """Return the values of the free parameters at a solution, in the order of their declaration."""
    count = len(module.metadata.free_parameters)
    end = solution.unknowns.size - module.problem.structure.couplings
    return np.asarray(solution.unknowns[end - count : end])


def data_at_solution(context: Context) -> dict[Symbol, float]:
    """Return the values of all parameters by symbol: the defaults, and the free parameters at the solution."""
    model = context.model
    if not model.free_parameters:
        return model.default_values
    free = map(float, free_values(context.module, context.solution))
    return model.default_values | dict(zip((p.symbol for p in model.free_parameters), free, strict=True))


def integral_of_cost(model: Model, module: ModuleType, solution: ControlSolution) -> float:
    """Return the integral of the running cost of all bodies for controls on nodes, by Simpson's rule.

    Between nodes coordinates, momenta and controls are linear functions of time, and velocities are constant.
    """
    free = [parameter.symbol for parameter in model.free_parameters]
    symbols = [*model.coordinates, *model.rates, *model.controls, model.time, *model.parameters, *free]
    function = sympy.lambdify(symbols, model.cost, modules=NUMPY, cse=True)
    constants = [*model.defaults, *free_values(module, solution)]
    h, total = np.diff(solution.t), 0.0

    def of_body(values: Vector, width: int, body: int) -> Vector:
        return values[:, body * width : (body + 1) * width]

    for body in range(model.bodies):
        q, u = (of_body(v, len(s), body) for v, s in ((solution.q, model.coordinates), (solution.u, model.controls)))
        slopes = np.diff(q, axis=0) / h[:, None]
        for weight, abscissa in ((1, 0.0), (4, 0.5), (1, 1.0)):
            q_at, u_at = ((1.0 - abscissa) * v[:-1] + abscissa * v[1:] for v in (q, u))
            rates = slopes if model.form == "lagrangian" else np.empty((h.size, 0))
            if model.form == "hamiltonian":
                p = of_body(solution.p, len(model.rates), body)
                rates = (1.0 - abscissa) * p[:-1] + abscissa * p[1:]
            values = function(*q_at.T, *rates.T, *u_at.T, solution.t[:-1] + abscissa * h, *constants)
            total += weight / 6.0 * float(np.sum(h * values))
    return total


def _with_size(expression: Expr, symbols: Sequence[Symbol]) -> Callable[..., tuple[Any, Any]]:
    """Return a function of the symbols for the value of an expression, and the sum of the moduli of its terms."""
    size = sympy.Add(*map(sympy.Abs, sympy.Add.make_args(expression)))
    return sympy.lambdify(symbols, [expression, size], modules=NUMPY, cse=True)  # type: ignore[no-any-return]


_HELD = 1e-9  # violation of a constraint relative to its terms


def check_holonomic_drift(context: Context) -> Iterator[Finding]:
    """Check that every holonomic constraint vanishes at all nodes of the solution, relative to its terms."""
    model, solution = context.model, context.solution
    data, width = data_at_solution(context), len(model.coordinates)
    for constraint in model.holonomic:
        function = _with_size(constraint, [*model.coordinates, model.time, *data])
        largest, size, node, body = 0.0, 1.0, 0, 0
        for b in range(model.bodies):
            q = solution.q[:, b * width : (b + 1) * width].T
            values, sizes = (np.broadcast_to(v, solution.t.shape) for v in function(*q, solution.t, *data.values()))
            if np.abs(values).max() >= largest:
                node, body = int(np.argmax(np.abs(values))), b
                largest, size = float(np.abs(values[node])), max(1.0, float(np.abs(sizes).max()))
        of_body = f" of body {body}" if model.bodies > 1 else ""
        right = f"|c| <= {largest:.1g} at all {solution.t.size} nodes, greatest at node {node}{of_body}"
        wrong = f"the motion leaves the constraint: |c| = {largest:.2g} at node {node}{of_body}"
        subject = f"c = {sympy.sstr(constraint)}"
        yield Finding.decided("holonomic drift", subject, largest <= _HELD * size, right, wrong)
    if model.task != "simulate":
        return
    grid = context.module.make_grid(1)
    states = zip(np.hstack([solution.q, solution.p]), solution.t, strict=True)
    rates = np.array([constraint_values(grid, *state)[:, 1] for state in states])
    for constraint, rate in zip(model.holonomic, rates.T, strict=False):
        largest, size = float(np.abs(rate).max()), max(1.0, float(np.abs(solution.p).max()))
        detail = f"|dc/dt| <= {largest:.1g} at all {solution.t.size} nodes"
        yield Finding("holonomic drift", f"rate of {sympy.sstr(constraint)}", largest <= _HELD * size, detail)


def check_rolling(context: Context) -> Iterator[Finding]:
    """Check the mean of every rolling constraint on each interval of the solution, and for simulations its value.

    The mean is the quadrature rule of the scheme for A v + b, with the differences of positions as velocities. Steps of
    a composition have inner nodes, which are not stored, and no means here.
    """
    model, solution, scheme = context.model, context.solution, context.scheme
    data, width, h = data_at_solution(context), len(model.coordinates), np.diff(solution.t)[:, None]
    symbols = [*model.coordinates, *model.rates, model.time, *data]
    for number, constraint in enumerate(model.rolling):
        function = _with_size(sympy.expand(constraint), symbols)
        largest = size = 0.0
        for b in range(model.bodies if not scheme.parts else 0):
            q = solution.q[:, b * width : (b + 1) * width]
            means, sizes = np.zeros(len(h)), np.zeros(len(h))
            for quadrature in scheme.discrete_lagrangian().points:
                weight, c = float(quadrature.weight), float(quadrature.abscissa)
                position, t = (1.0 - c) * q[:-1] + c * q[1:], solution.t[:-1] + c * h[:, 0]
                value, scale = function(*position.T, *(np.diff(q, axis=0) / h).T, t, *data.values())
                means, sizes = means + weight * value, sizes + weight * scale
            largest, size = max(largest, float(np.abs(means).max())), max(size, float(sizes.max()))
        subject = sympy.sstr(constraint)
        if not scheme.parts:
            detail = f"the mean on each interval is at most {largest:.1g}, with terms up to {size:.2g}"
            yield Finding("rolling constraints", f"mean of {subject}", largest <= _HELD * max(1.0, size), detail)
        if model.task == "simulate":
            grid = context.module.make_grid(1)
            states = zip(np.hstack([solution.q, solution.p]), solution.t, strict=True)
            values = [constraint_values(grid, *state)[len(model.holonomic) + number, 1:3] for state in states]
            worst, scale = np.abs(values).max(axis=0)
            detail = f"its value is at most {worst:.1g} at all {solution.t.size} nodes"
            yield Finding("rolling constraints", subject, worst <= _HELD * max(1.0, scale), detail)


_DISSOLVED = 1e-6  # product of a contact law, relative to the largest force times the largest gap or speed
_RELAXED = 2.0  # product of a force and a gap, relative to the default relaxation, at most: of gaps that never close


def check_contact(context: Context) -> Iterator[Finding]:
    """Check the contact laws at the solution: gaps at nodes, forces, and their products on each interval.

    Gaps are the author's at the nodes of the solution, and sliding velocities come from differences of positions.
    """
    model, solution = context.model, context.solution
    data, metadata = data_at_solution(context), context.module.metadata
    allowed = _RELAXED * float(metadata.parameters[metadata.relaxation])
    q, t, h = solution.q, solution.t, np.diff(solution.t)
    left = [*q[:-1].T, *(np.diff(q, axis=0) / h[:, None]).T, t[:-1], *data.values()]
    symbols = [*model.coordinates, *model.rates, model.time, *data]
    forces = dict(zip(model.controls, solution.u.T, strict=True))
    for contact in model.contacts:
        gap = sympy.lambdify([*model.coordinates, model.time, *data], contact.expression)(*q.T, t, *data.values())
        gaps, normal = gap * np.ones(t.size), forces[contact.normal]
        size, largest = max(1.0, float(np.abs(gaps).max())), float(normal.max())
        worst, least = float(gaps.min()), float(normal.min())
        detail = f"it is at least {worst:.1g} at all nodes"
        yield Finding("contact", f"gap {contact.name}", worst >= -_HELD * size, detail)
        product = float(np.abs(normal * gaps[1:]).max())
        detail = f"force times gap at the next node is at most {product:.1g}, with forces up to {largest:.2g}"
        passed = product <= max(_DISSOLVED * size * largest, allowed) and least >= -_HELD * max(1.0, largest)
        yield Finding("contact", f"normal force of {contact.name}", passed, detail)
        if not contact.slips:
            continue
        (mu,) = sympy.lambdify([*data], [contact.friction])(*data.values())
        speeds = [sympy.lambdify(symbols, slip)(*left) * np.ones(h.size) for slip in contact.slips]
        tangential = [forces[f] for f in contact.tangential]
        beyond = float((np.sum(np.abs(tangential), axis=0) - mu * normal).max())
        fastest = np.max(np.abs(speeds), axis=0)
        power = float(np.abs(np.sum(np.multiply(tangential, speeds), axis=0) + mu * normal * fastest).max())
        largest_power = max(float(fastest.max()) * mu * largest, 1e-300)
        detail = f"it exceeds the cone by {beyond:.1g}, and the greatest dissipation by {power:.1g}"
        passed = beyond <= _HELD * max(1.0, largest) and power <= _DISSOLVED * max(1.0, largest_power)
        yield Finding("contact", f"friction of {contact.name}", passed, detail)


_MET = 1e-7  # violation of a condition relative to its terms


def check_inner_times(context: Context) -> Iterator[Finding]:
    """Check every condition at its inner time, and the order and windows of the inner times, at the solution."""
    model, solution, numbers = context.model, context.solution, data_at_solution(context)

    def number(expression: Expr | None) -> float:
        return float(sympy.sympify(expression).subs(numbers))

    # The node nearest to every prescribed time, and for a free time the node on the module's grid.
    on_grid = context.module.make_grid(solution.t.size - 1).inner
    prescribed = [None if inner.time is None else number(inner.time) for inner in model.inner_times]
    pairs = zip(prescribed, on_grid, strict=True)
    nodes = [node if time is None else int(np.argmin(np.abs(solution.t - time))) for time, node in pairs]
    width, momenta, rates = len(model.coordinates), model.rates, dict[Symbol, Expr]()
    if model.inner_conditions and model.form == "lagrangian" and model.rates:
        momenta = legendre.conjugate_symbols(model)
        used = {s for c in model.inner_conditions for s in c.expression.free_symbols}
        if used & set(model.rates):
            rates = dict(zip(model.rates, legendre.velocity_of_momentum(model), strict=True))
    symbols = [*model.coordinates, *momenta, model.time, *numbers]
    for condition in model.inner_conditions:
        # Evaluate the condition relative to its own terms, for the body with the largest violation.
        node = nodes[condition.number]
        function, worst = _with_size(condition.expression.subs(rates, simultaneous=True), symbols), 0.0
        for body in range(model.bodies):
            columns = slice(body * width, (body + 1) * width)
            state = [*solution.q[node, columns], *(solution.p[node, columns] if model.rates else ())]
            value, scale = function(*state, solution.t[node], *numbers.values())
            excess = abs(value) if condition.equality else max(0.0, value)
            worst = max(worst, float(excess) / max(1.0, float(scale)))
        verb = "holds to" if worst <= _MET else "fails by"
        detail = f"at node {node}, t = {solution.t[node]:.6g}, it {verb} {worst:.1g}"
        yield Finding("inner times", str(condition), bool(worst <= _MET), detail)
    times = solution.t[np.array(nodes)]
    slack = _MET * max(1.0, float(np.abs(times).max()))
    wrong = []
    for index, (inner, time) in enumerate(zip(model.inner_times, times, strict=True), start=1):
        missed = [abs(time - number(inner.time))] if inner.time is not None else []
        missed += [number(inner.earliest) - time] if inner.earliest is not None else []
        missed += [time - number(inner.latest)] if inner.latest is not None else []
        if max(missed, default=0.0) > slack:
            wrong.append(f"time {index} is {time:.6g}, which misses what is given by {max(missed):.2g}")
    if (np.diff(times) < -slack).any():
        wrong.append("the times are not in order")
    listed = ", ".join(f"{time:.6g}" for time in times)
    yield Finding("inner times", "times", not wrong, wrong[0] if wrong else f"in order, as given: t = {listed}")


_LEAST_STEPS = 48  # least number of intervals of the coarser motion, in all segments together
_ORDER_ALLOWED = 0.5  # allowed deficit of the observed order, because the controls of both motions differ
_ROUND_OFF = 1e-10  # distance below which no order can be observed
_OF_STAGES = 2  # the expected order if the control on an interval is a polynomial through its values at stages


def check_delays(context: Context) -> Iterator[Finding]:
    """Check on N and 2N intervals that the motion approaches a motion by DOP853 at the order of the scheme."""
    whole = context.model.authored
    if not whole.delays:
        yield does_not_apply("delays", "there are no values of the past")
        return
    if whole.holonomic:
        yield does_not_apply("delays", "motions with holonomic constraints are not followed here")
        return
    module, distances = context.module, []
    segments = segments_of(module.metadata)
    number = segments.number if segments else 1
    steps = max(4, -(-_LEAST_STEPS // number))
    for run in (Run(steps), Run(2 * steps)):
        attempt = find("newton").function("control")(module, run)
        result = put_together(control_result(module, "newton", run, attempt), module.metadata)
        if not result.solved:
            yield not_measured("delays", "the motion from its history", result.message)
            return
        distances.append(_distance(whole, result))
    first, last = distances
    order = _OF_STAGES if context.choices.controls == "stages" else context.scheme.order
    observed = math.log2(first / last) if last > 0.0 else math.inf
    detail = (
        f"DOP853 with the controls that were found is {first:.1e} away on {steps * number} intervals and {last:.1e} on "
        f"{2 * steps * number}: order {observed:.2f}, at least {order} expected"
    )
    passed = last < _ROUND_OFF or observed > order - _ORDER_ALLOWED
    yield Finding("delays", "the motion from its history", passed, detail)


def _distance(whole: Model, result: Result) -> float:
    """Return the largest relative error of a motion against DOP853; `whole` is the problem before segmentation."""
    side = legendre.hamiltonian_form(whole.with_free_ends)
    states, numbers = (*side.coordinates, *side.rates), side.default_values
    t, pieces = result.t, list[Callable[[float], Vector]]()

    def function(expressions: Sequence[Expr], *arguments: Symbol | list[Symbol]) -> Callable[..., list[float]]:
        plugged = [sympy.sympify(e).xreplace(numbers) for e in expressions]
        return sympy.lambdify(arguments, plugged, NUMPY)  # type: ignore[no-any-return]

    symbols = [delay.symbol for delay in whole.delays]
    rates = function(vector_field(side), list(states), list(side.controls), side.time, symbols)
    velocities = function([side.function.diff(p) for p in side.rates], list(states), side.time)

    def controls(k: int, time: float) -> Vector:
        """Return the controls at a time in interval k."""
        margin = 1e-9 * (t[k + 1] - t[k])
        return np.asarray(result.controls_at(np.array([min(max(time, t[k] + margin), t[k + 1] - margin)]))[0])

    def delayed(delay: Delay) -> Callable[[int, float], float]:
        """Return a function (index of the interval, time) that gives the delayed value."""
        lag = float(delay.lag.xreplace(numbers))
        back = round(lag / float(whole.duration.xreplace(numbers)) * (t.size - 1))
        history = sympy.lambdify(whole.time, delay.history.xreplace(numbers), NUMPY)

        def value(k: int, time: float) -> float:
            k, time = k - back, time - lag
            if k < 0:
                return float(history(time))
            if delay.quantity in states:
                return float(pieces[k](time)[states.index(delay.quantity)])
            if delay.quantity in whole.controls:
                return float(controls(k, time)[whole.controls.index(delay.quantity)])
            return float(velocities(pieces[k](time), time)[whole.rates.index(delay.quantity)])

        return value

    past = [delayed(delay) for delay in whole.delays]
    motion = [np.concatenate([result.q[0], result.p[0]])]
    for k in range(t.size - 1):

        def rate(time: float, state: Vector, k: int = k) -> Sequence[float]:
            return rates(state, controls(k, time), time, [value(k, time) for value in past])

        piece = solve_ivp(rate, (t[k], t[k + 1]), motion[-1], "DOP853", rtol=1e-11, atol=1e-12, dense_output=True)
        pieces.append(piece.sol)
        motion.append(piece.y[:, -1])
    computed = np.column_stack([result.q, result.p])
    sizes = np.maximum(np.abs(computed).max(axis=0), 1e-12)
    return float((np.abs(np.array(motion) - computed) / sizes).max())


_COST_ALLOWED = 0.15  # deficit of the observed order
_COST_ROUNDING = 1e-9  # relative error below which no order can be observed
_LARGEST = 10_000  # intervals
_TOLERANCE = 1e-9
_SECONDS = 30.0  # processor time for the optimum of the continuous problem


def check_optimum(context: Context) -> Iterator[Finding]:
    """Check on N, 2N, 4N and if necessary more intervals that the cost converges to the continuous optimum."""
    reason = beyond_maximum_principle(context.model)
    if reason:
        yield does_not_apply(
            "optimum", f"the maximum principle is derived here for plain problems, this one has {reason}"
        )
        return
    subject = "convergence to the optimum"
    model, first = context.model, context.solution
    try:
        exact = exact_optimum(model)
        if exact is not None:
            optimum, source = exact.cost_at(), "in closed form"
        else:
            # From the discrete motion collocation converges to the same local optimum. A motion with nodal controls may
            # be a false optimum.
            guess = None
            if first.status == "solved" and context.choices.controls != "nodal":
                rates = first.p if model.form == "hamiltonian" else np.gradient(first.q, first.t, axis=0)
                states = np.hstack([first.q, rates])
                guess = first.t, states, np.zeros_like(states)
            reference = reference_optimum(model, tolerance=_TOLERANCE, guess=guess, seconds=_SECONDS)
            optimum, source = reference.cost, "by collocation"
    except CodegenError as error:
        yield not_measured("optimum", subject, " ".join(str(error).split()))
        return
    order, steps = order_of_optima(context.module), context.steps or context.model.steps
    errors: list[tuple[int, float]] = []
    rate, passed = 0.0, False
    while len(errors) < 3 or (steps <= _LARGEST and not passed):
        solution = context.module.solve(steps)
        if solution.status != "solved":
            yield not_measured("optimum", subject, f"N = {steps}: {solution.message}")
            return
        errors.append((steps, abs(solution.cost - optimum)))
        steps *= 2
        if len(errors) >= 3:
            coarse, fine = errors[-2][1], errors[-1][1]
            rate = math.log2(coarse / fine) if coarse > 0.0 and fine > 0.0 else math.inf
            passed = rate > order - _COST_ALLOWED or fine < _COST_ROUNDING * max(1.0, abs(optimum))
    listed = ", ".join(f"{error:.3g} (N = {n})" for n, error in errors[-3:])
    detail = f"J* = {optimum:.12g} {source}; errors {listed}; order {rate:.2f}, {order} is expected"
    yield Finding("optimum", subject, passed, detail)


_NOTHING = (1e-9, 1e-8, 1e-7)
"""A curvature below these fractions of the second derivatives may be a rounding error of the elimination."""
_ACTIVE, _FAST = 1.0, 1e12
"""A bound with multiplier z is active if z / distance exceeds the first number. The ratio of an inactive bound has the
size of the tolerance. The second number limits the ratio, which would be infinite at the bound."""
_REGULAR = 1e13  # largest condition number of a matrix that counts as regular


def check_second_order(context: Context) -> Iterator[Finding]:
    """Check that the KKT matrix has the inertia of a minimum, by an exact count of its negative eigenvalues."""
    module, solution = context.module, context.solution
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured("second-order condition", subject, solution.message)
        return
    program, unknowns = context.control, solution.unknowns
    grid = module.make_grid((solution.t.size - 1) // max(1, len(program.phases)))
    # The diagonal z / distance of the unknowns at bounds; z is the gradient of the Lagrangian.
    diagonal = np.zeros(unknowns.size)
    if module.metadata.inequalities:
        gradient = np.where(grid.is_multiplier, 0.0, module.evaluate(grid, unknowns).gradient)
        lower, upper = module.variable_bounds(grid)
        for z, distance in ((gradient, unknowns - lower), (-gradient, upper - unknowns)):
            pushes = np.isfinite(distance) & (z > 0.0)
            diagonal[pushes] += np.minimum(z[pushes] / np.maximum(distance[pushes], 1e-100), _FAST)

    # The size of the second derivatives of every unknown, or a typical size. Slacks follow from other unknowns.
    rows, _, values = point.hessian(grid, unknowns)
    primal, sizes = module.primal_unknowns(grid), np.zeros(unknowns.size)
    np.maximum.at(sizes, primal[rows], np.abs(values))
    present = sizes[sizes > 0.0]
    sizes[primal[sizes[primal] == 0.0]] = np.median(present) if present.size else 1.0
    nodes, intervals = module.views(grid, sizes)
    intervals[:, :, intervals.shape[2] - len(program.slacks) :] = 0.0
    for end in (program.start, program.end):
        nodes[:, :, [slack for slack, _ in end.slacks]] = 0.0

    equations, system = module.multiplier_unknowns(grid).size, allocate_system(grid)
    excess = factor_kkt(grid, unknowns, 1.0, diagonal, system)
    passed, detail = True, ""
    if excess == 0 and factor_kkt(grid, unknowns, 1.0, diagonal - _NOTHING[0] * sizes, system) == 0:
        detail = f"a strict local minimum: {equations} negative eigenvalues for {equations} equations"
    else:
        # If a symmetry maps an optimum to another optimum, the curvature along it is zero up to a rounding error.
        for part in _NOTHING:
            if factor_kkt(grid, unknowns, 1.0, diagonal + part * sizes, system) == 0:
                detail = f"a minimum, isolated or not: a curvature is zero up to rounding, above -{part:g} of its terms"
                break
    if not detail and excess is not None and excess > 0:
        passed = False
        detail = f"no minimum: the cost decreases to second order in {excess} or more independent directions"
    if not detail and is_determined(module, grid, unknowns, diagonal):
        yield does_not_apply("second-order condition", "the equations alone determine the solution, whatever it costs")
    elif not detail:
        yield not_measured("second-order condition", subject, "equations depend on each other at the solution")
    else:
        if module.metadata.inequalities:
            detail += f" ({np.count_nonzero(diagonal > _ACTIVE)} unknowns are held by bounds)"
        yield Finding("second-order condition", subject, passed, detail)


def is_determined(module: ModuleType, grid: Grid, unknowns: Vector, diagonal: Vector) -> bool:
    """Return True if there are as many equations as unknowns without active bounds, and their Jacobian is regular.

    Rows and columns of the Jacobian are scaled to one. `diagonal` has z / distance by unknown, large at active bounds.
    """
    free = diagonal[module.primal_unknowns(grid)] <= _ACTIVE
    rows, columns, values = point.jacobian(grid, unknowns)
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


_LENGTHS = (1e-2, 1e-3, 1e-4)  # increments of the central differences, relative to the quantities
_SENSITIVITY_ALLOWED, _ROUGH = 1e-6, 1e-5
"""Allowed error of sensitivities, and largest error of a useful reference, both relative to the largest entry."""
_KINK = 1e-3  # relative difference of the left and right derivatives from which a kink is assumed
_FLOOR = 1e-3  # derivatives below this fraction of the largest value are compared as if they were that large
_KINDS = ("cost", "q", "u", "multipliers")
_TOLERANCES = (1e-12, 1e-10)

Values = dict[str, Vector]
"""Cost, coordinates, controls and multipliers of a solution, or their derivatives, by the names in `_KINDS`."""


_Reference = tuple[Values, Values, dict[str, float]]
"""Central differences, the same with half the increments, and the gaps between left and right derivatives."""
_Change = tuple[Quantity, float | Vector, float]  # a quantity, its value, and its change


def check_sensitivities(context: Context) -> Iterator[Finding]:
    """Compare the module's sensitivities with differences of solutions, for all quantities and for parameters alone."""
    module, solution = context.module, context.solution
    if module.metadata.sensitivities is None:
        yield does_not_apply("sensitivities", "the module has none, unless it is built with --sensitivities")
        return
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured("sensitivities", subject, solution.message)
        return
    steps = (solution.t.size - 1) // max(1, len(context.control.phases))
    solution = _solved_nearby(module, steps, {}, solution.unknowns) or solution

    names, count, grid = module.QUANTITIES, len(module.metadata.parameters), module.make_grid(steps)
    columns = (*grid.parameters[:, : module.OWN_QUANTITIES].T, grid.steps * grid.h)[: len(names)]
    values = tuple(v if i >= count else float(np.max(v)) for i, v in enumerate(columns))
    sizes = np.array([max(float(np.abs(value).max()), 0.1) for value in columns])
    signs = np.random.default_rng(11).uniform(0.3, 1.0, len(names)) * np.where(np.arange(len(names)) % 2, 1.0, -1.0)
    varied = list(zip(quantities(names, module, ()), values, sizes * signs, strict=True))
    prescribed = tuple(names[count:])  # quantities that depend on no parameter
    yield _compared_sensitivities(module, steps, solution, "all quantities by themselves", varied, prescribed)
    if prescribed and count:
        yield _compared_sensitivities(module, steps, solution, "parameters, which others follow", varied[:count], ())


def _compared_sensitivities(
    module: ModuleType, steps: int, solution: ControlSolution, subject: str, varied: Sequence[_Change],
    prescribed: tuple[str, ...],
) -> Finding:  # fmt: skip
    grid, subject = module.make_grid(steps), f"{subject}, {steps} intervals"
    rates = module.sensitivities(grid, solution.unknowns, prescribed)
    if rates.failure:
        return not_measured("sensitivities", subject, rates.failure)
    if rates.doubtful.size:
        reason = f"strict complementarity fails for {rates.doubtful.size} unknowns"
        return not_measured("sensitivities", subject, reason)
    values, left_out = _values(solution), ""

    def moved(changes: Sequence[_Change], part: float) -> Values | None:
        data = given_to({quantity: value + part * change for quantity, value, change in changes})
        other = _solved_nearby(module, steps, data, solution.unknowns)
        return None if other is None else _values(other)

    def references_along(changes: Sequence[_Change]) -> list[_Reference]:
        """Return a reference for each length in `_LENGTHS`; an empty list if a changed problem is not solved."""
        references = []
        for length in _LENGTHS:
            reference = _reference(partial(moved, changes), values, length)
            if reference is None:
                return []
            references.append(reference)
        return references

    references = references_along(varied)
    if not references:
        resting = [(quantity, value, 0.0) for quantity, value, _ in varied]
        can = [
            all(moved([*resting[:i], one, *resting[i + 1 :]], side * _LENGTHS[0]) is not None for side in (1, -1))
            for i, one in enumerate(varied)
        ]
        if any(can) and not all(can):
            left_out = ", without " + ", ".join(one[0].name for one, is_possible in zip(varied, can) if not is_possible)
            varied = [one if is_possible else rest for one, rest, is_possible in zip(varied, resting, can)]
            references = references_along(varied)
    if not references:
        reason = f"the problem beside the solution is not solved{left_out}"
        return not_measured("sensitivities", subject, reason)
    subject += left_out
    is_kinked = False  # for a kink, the gap between left and right derivatives does not shrink with the increment
    (*_, longer), (_, fine, bend) = references[-2:]
    for kind in _KINDS:
        floor = _FLOOR * float(np.abs(values[kind]).max(initial=0.0))
        largest = max(float(np.abs(fine[kind]).max(initial=0.0)), floor)
        is_kinked = is_kinked or bend[kind] > max(0.3 * longer[kind], _KINK * largest)
    if is_kinked:
        reason = "derivatives to both sides differ, as where bounds begin to hold"
        return not_measured("sensitivities", subject, reason)

    along: dict[str, Vector] = {kind: np.zeros(()) for kind in _KINDS}
    for quantity, _, change in varied:
        i = module.QUANTITIES.index(quantity.name)
        _, q, _, u, multipliers = module.unpacked_rates(grid, solution.unknowns, rates, i)
        for kind, derivative in (("cost", rates.cost[i]), ("q", q), ("u", u), ("multipliers", multipliers)):
            along[kind] = along[kind] + change * derivative

    worst, beyond, rough, of = 0.0, 0.0, 0.0, ""
    for kind in _KINDS:
        if not values[kind].size:
            continue
        floor = _FLOOR * float(np.abs(values[kind]).max())
        errors = []
        for reference in references:
            coarse, exact = reference[0][kind], reference[1][kind]
            scale, difference = max(float(np.abs(exact).max()), floor, 1e-300), np.abs(along[kind] - exact)
            errors.append((float(np.abs(exact - coarse).max()) / scale, float(difference.max()) / scale))
        noise, error = min(errors)
        rough = max(rough, noise)
        worst = max(worst, error)
        if not error - 10.0 * noise <= max(beyond, _SENSITIVITY_ALLOWED):
            beyond, of = error - 10.0 * noise, kind
    if rough > _ROUGH:
        reason = f"differences do not converge, only to {rough:.0e}, as where bounds change"
        return not_measured("sensitivities", subject, reason)
    detail = f"differ by at most {worst:.1e} from central differences, which are good to {rough:.0e}"
    return Finding("sensitivities", subject, not of, f"those of {of} {detail}" if of else detail)


def _reference(moved: Callable[[float], Values | None], values: Values, length: float) -> _Reference | None:
    """Return differences with the increment `length`; None if `moved`, which solves after a change, does not solve."""
    differences, bend = [], dict[str, float]()
    for part in (length, 0.5 * length, 0.25 * length):
        above, below = moved(part), moved(-part)
        if above is None or below is None:
            return None
        if part == length:
            for kind in _KINDS:
                bend[kind] = float(np.abs(above[kind] + below[kind] - 2.0 * values[kind]).max(initial=0.0)) / length
        differences.append({kind: (above[kind] - below[kind]) / (2 * part) for kind in _KINDS})
    coarse, fine = (
        {kind: (4.0 * second[kind] - first[kind]) / 3.0 for kind in _KINDS} for first, second in pairwise(differences)
    )
    return coarse, fine, bend


def _values(solution: ControlSolution) -> Values:
    return {kind: np.asarray(getattr(solution, kind), dtype=float) for kind in _KINDS}


def _solved_nearby(module: ModuleType, steps: int, data: Mapping[str, object], start: Vector) -> ControlSolution | None:
    """Return the solution for `data` from the warm start `start`, to the smallest tolerance possible; else None."""
    for tolerance in _TOLERANCES:
        result: ControlSolution = module.solve(steps, **data, guess=start, warm=True, tolerance=tolerance)
        if result.status == "solved":
            return result
    return None
