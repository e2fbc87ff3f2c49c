"""Null spaces: redundant equations, controls without cost, and conditions that hold at nodes alone.

Boundary rank: no discrete equation or boundary condition may be redundant or unreachable. If the Jacobian of the
constraints is rank-deficient, its left null vectors name the dependent equations of motion. The boundary conditions
that these vectors meet are the candidates for removal. Conditions between bodies are sorted into independent conditions
and redundant conditions, which the module leaves out.

Null controls: the discrete cost may ignore a mode of the controls. With nodal controls and averages in the cost,
u_k = (-1)^k a leaves the average of every interval unchanged. The continuous cost does penalise this mode, so the
discrete optimum may be arbitrarily wrong. If the mode acts on the motion, the optimiser moves the system at no cost.
The integral of the cost over the resulting controls reveals such a false optimum.

Path between nodes: a condition on states that holds at nodes alone permits a spurious mode. Nodes that alternate
between two sides of a forbidden region meet the condition, but cost and dynamics are evaluated inside the region. A
condition that is imposed at these points, or follows there from both nodes, has no such mode. For other conditions the
violation of the solution is measured. On shorter intervals it decreases for a smooth motion, not for a spurious mode.

On a coarse grid a motion may also pass through a thin obstacle, or jump from one branch of an equality or holonomic
constraint to another. So the motion of the solution is sampled inside intervals as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import sympy
from sympy import Expr, S, Symbol

from codegen.discretise.assembly import scaled_in_time
from codegen.discretise.conditions.linking import independent_couplings
from codegen.discretise.conditions.path import is_convex, nodal_conditions
from codegen.discretise.interval import STEP, at_nodes, one_step_interval, variational_interval
from codegen.discretise.model.definitions import Condition
from codegen.discretise.program import ControlProgram
from codegen.discretise.schemes.base import Scheme
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.evidence.checks.layout import FlatVector, few_steps
from codegen.evidence.checks.solution import data_at_solution, integral_of_cost
from codegen.runtime.record import phrase
from codegen.runtime.search import point
from codegen.runtime.search.point import submatrix
from codegen.solving.loading import ControlSolution, Entries, Indices, Vector
from codegen.solving.results.between_nodes import Excursion, excursions, sampled_conditions
from codegen.solving.results.output import shortened
from codegen.symbolic import checks as expressions
from codegen.symbolic.zeros import identically_zero

_INTERVALS = 8
_MOST_INTERVALS = 64
_SINGULAR = 1e-11  # relative to the largest singular value
_TAKES_PART = 1e-6  # relative to the largest entry of a null vector
_HOLDS = 1e-6  # violation of a redundant condition at the solution


def check_boundary_rank(context: Context) -> Iterator[Finding]:
    """Check that all equations have full rank, and that conditions between bodies do not contradict each other.

    The rank is the larger rank of the scaled Jacobian at the guess and at a perturbed guess.
    """
    program, module = context.control, context.module
    intervals = few_steps(program, _INTERVALS)
    grid = module.make_grid(intervals)
    # Take at least as many unknowns as equations. One control of many masses needs more intervals.
    while intervals < _MOST_INTERVALS and module.primal_unknowns(grid).size < module.multiplier_unknowns(grid).size:
        intervals *= 2
        grid = module.make_grid(intervals)
    guess, generator = module.initial_guess(grid), np.random.default_rng(11)
    columns, rows = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    free = np.concatenate([columns, rows])

    def dense(entries: Entries, width: int) -> Vector:
        matrix = np.zeros((rows.size, width))
        np.add.at(matrix, (entries[0], entries[1]), entries[2])
        return matrix

    decompositions = []
    for amount in (0.0, 0.05):
        unknowns = guess.copy()
        unknowns[free] += amount * generator.uniform(-1, 1, free.size) * (1 + np.abs(unknowns[free]))
        unknowns = module.with_pinned_values(grid, unknowns)
        matrix = dense(point.jacobian(grid, unknowns), columns.size)
        if not np.isfinite(matrix).all():
            continue
        # The left null vectors of the scaled Jacobian (columns), and their products with all columns (rows).
        row_scale = np.abs(matrix).max(axis=1, initial=0.0)
        row_scale[row_scale == 0.0] = 1.0
        scaled = matrix / row_scale[:, None]
        column_scale = np.abs(scaled).max(axis=0, initial=0.0)
        column_scale[column_scale == 0.0] = 1.0
        left, singular, _ = np.linalg.svd(scaled / column_scale, full_matrices=True)
        nulls = left[:, int(np.sum(singular > _SINGULAR * singular.max(initial=0.0))) :]
        every = np.flatnonzero(~grid.is_multiplier)
        full = dense(submatrix(grid, unknowns, rows, every, False), every.size)
        touched = np.zeros((nulls.shape[1], unknowns.size))
        touched[:, every] = np.abs(nulls.T @ (full / row_scale[:, None]))
        decompositions.append((nulls, touched))
    if not decompositions:
        reason = "their Jacobian is not finite at the guess nor beside it"
        yield not_measured("boundary rank", "all equations", reason)
    else:
        nulls, touched = min(decompositions, key=lambda pair: pair[0].shape[1])
        if not nulls.shape[1]:
            conditions = [f"{v.where} {v.quantity}" for v in program.boundary_values]
            further = [*program.start.conditions, *program.end.conditions]
            further += [equation for phase in program.phases for equation in phase.switch_equations]
            conditions += [equation.condition for equation in further if equation.condition]
            detail = f"{rows.size} equations in {columns.size} unknowns have full rank (N = {intervals})"
            detail += f": {', '.join(conditions) or 'no conditions'}"
            yield Finding("boundary rank", "all equations", True, detail)
        for null, row in zip(nulls.T, touched, strict=True):
            detail = _dependent_equations(program, intervals, null, rows, row)
            yield Finding("boundary rank", "all equations", False, detail)
    if not context.model.couplings:
        return
    # Name redundant conditions between bodies, and evaluate them at the solution.
    model, solution = context.model, context.solution
    result = independent_couplings(model)
    names = [condition.name for condition in model.couplings]
    subject = "conditions between bodies"
    if not result.consistent:
        violated = shortened(result.violated)
        detail = f"they contradict each other: no configuration was found where {violated} holds as well"
        yield Finding("boundary rank", subject, False, detail)
        return
    kept = f"{len(result.kept)} of {len(names)} are independent" + ("" if result.dropped else ", none is redundant")
    yield Finding("boundary rank", subject, True, kept)
    for index, others in result.dropped:
        sources = "; ".join(map(shortened, others))
        detail = f"redundant, and left out: it follows from {sources}" if others else "redundant: it says nothing"
        values, width = data_at_solution(context), len(model.coordinates)
        values |= {v.symbol: float(solution.q[-1, v.body * width + v.coordinate]) for v in model.end_values}
        residual = expressions.rounded_at(model.couplings[index].expression, values)
        violation = abs(residual) if residual is not None else float("inf")
        passed = solution.status != "solved" or violation <= _HOLDS
        if not passed:
            detail = f"left out as redundant, but the solution violates it by {violation:.2g}"
            detail += "; start from a better guess"
        name = shortened(names[index])
        # Shortened names may begin alike.
        subject = name if name == names[index] else f"number {index + 1}, {name}"
        yield Finding("boundary rank", subject, passed, detail)


def _dependent_equations(program: ControlProgram, intervals: int, null: Vector, rows: Indices, touched: Vector) -> str:
    """Return a text that names the equations in a dependent combination, and the boundary conditions involved.

    `null` is a left null vector of the Jacobian, `rows` are the unknowns (multipliers) of its entries, and `touched` is
    its product with all columns. A prescribed position or momentum takes part if its entry of `touched` is not zero. A
    prescribed velocity takes part if `null` contains its equation.
    """
    flat = FlatVector.on_grid(program, intervals)
    weights = np.zeros(flat.size)
    weights[rows] = np.abs(null)
    bound = _TAKES_PART * weights.max()
    meanings = flat.meanings()
    equations = dict.fromkeys(phrase(meanings[i], role=False) for i in np.flatnonzero(weights > bound))
    values, conditions = {value.symbol: value for value in program.boundary_values}, dict[str, None]()
    for body in range(program.model.bodies):
        for where, end, k, symbols in (
            ("start", program.start, 0, program.left_symbols),
            ("end", program.end, flat.steps, program.right_symbols),
        ):
            indices = flat.node(body, k)
            for index, value in end.pins:
                if value in values and touched[indices[index]] > bound:
                    conditions[f"{where} {values[value].quantity}"] = None
            for index, unknown in enumerate(program.node):
                if unknown.multiplier and weights[indices[index]] > bound:
                    read = end.element.diff(symbols[index]).free_symbols
                    conditions |= {f"{where} {values[s].quantity}": None for s in values if s in read}
    listed, involved = ", ".join(conditions) or "no boundary condition", "; ".join(equations)
    return f"redundant or unreachable: one of {listed} ({involved} depend on each other); leave one of them free"


_ALLOWED = 0.1
"""Relative difference between the discrete cost and its integral that the order of the scheme may explain."""


def check_null_controls(context: Context) -> Iterator[Finding]:
    """Check that no mode of a control is free of cost: alternating values at nodes, or any value in an interval."""
    program = context.control
    if not program.model.controls:
        yield does_not_apply("null controls", "there are no controls")
        return

    def is_penalised(u: Symbol) -> bool:
        return program.model.cost is not None and not identically_zero(program.model.cost.diff(u))

    if not program.nodal_controls:
        # Every interval or stage has separate controls, so that a mode without cost would lie in one interval.
        where = "stage" if program.controlled == "stages" else "interval"
        for u in program.model.controls:
            unseen = [site for site in program.controls_of(u) if identically_zero(program.cost.diff(site))]
            passed, detail = True, f"none: the discrete cost sees the control of every {where}"
            if not is_penalised(u):
                detail = "none of the discretisation: the problem's own cost does not hold it"
            elif unseen:
                passed, detail = False, f"{unseen[0]} costs nothing"
            yield Finding("null controls", f"{where} control {u}", passed, detail)
        return

    any_acts = False
    for u in program.model.controls:
        # The mode changes an interval to u_k + a, u_k1 - a. The sign of a alternates between intervals.
        (left,), (right,) = at_nodes([u], "_k"), at_nodes([u], "_k1")
        amplitude = sympy.Dummy("a", real=True)
        mode = {left: left + amplitude, right: right - amplitude}
        change = program.cost.subs(mode, simultaneous=True).diff(amplitude)
        name = f"{program.controlled} control {u}"
        if not identically_zero(change):
            yield Finding("null controls", name, True, "the alternating control is seen by the cost")
            continue
        # The force of the mode vanishes if forces are averaged and do not depend on the position.
        force = (program.element - program.cost).subs(mode, simultaneous=True).diff(amplitude)
        acts = not identically_zero(force)
        if acts and not is_penalised(u):
            detail = "none of the discretisation: the motion sees the alternating control, the problem's cost does not"
            yield Finding("null controls", name, True, detail)
            continue
        any_acts = any_acts or acts
        effect = "yet acts on the motion" if acts else "and does nothing either, so that it is undetermined"
        detail = f"alternating {name}: {u}_k = (-1)^k a costs nothing, {effect}; use controls on intervals"
        yield Finding("null controls", name, False, detail)

    model, solution = context.model, context.solution if any_acts else None
    if solution is None or solution.status != "solved" or model.terminal_cost != 0:
        return
    discrete, integral = float(solution.cost), integral_of_cost(model, context.module, solution)
    detail = f"discrete cost {discrete:.6g}, integral of the cost over the same controls {integral:.6g}"
    detail += f" (N = {solution.t.size - 1})"
    passed = abs(integral - discrete) <= _ALLOWED * max(abs(integral), abs(discrete))
    if not passed:
        detail = f"a false optimum, which the alternating controls pay for: {detail}"
    yield Finding("null controls", "optimum with nodal controls", passed, detail)


_NAME = "path between nodes"
_NOTHING = 1e-6  # a violation below this number counts as zero
_FALLS = 0.75  # largest ratio of the violations on halved and on original intervals that counts as a decrease


def check_path_modes(context: Context) -> Iterator[Finding]:
    """Check that conditions on states also hold between nodes, by derivation or by the violations of two solutions."""
    program = context.control
    model, conditions = program.model, list[Condition]()
    if not program.phases:  # path conditions, and bounds on quantities at nodes
        conditions += [*nodal_conditions(model, equality=True), *nodal_conditions(model, equality=False)]
        for bound in model.bounds:
            x, lower, upper = bound.symbol, bound.lower, bound.upper
            if x in (*model.coordinates, *model.rates):
                if lower is not None:
                    conditions.append(Condition(f"{x} >= {lower}", lower - x, equality=False))
                if upper is not None:
                    conditions.append(Condition(f"{x} <= {upper}", x - upper, equality=False))
    sampled = sampled_conditions(context.module)
    if not (conditions or sampled):
        yield does_not_apply(_NAME, "there are no conditions on states alone")
        return
    # The violations inside intervals by the name of the condition; None without a solution.
    worst: dict[str, Excursion] | None = {}
    if sampled and context.solution.status != "solved":
        worst = None
    elif sampled:
        steps = (context.solution.t.size - 1) // context.module.metadata.phases
        violations = excursions(context.module, context.solution.unknowns, steps, None)
        worst = {excursion.condition: excursion for excursion in violations}
    open_values = {c: _open_values(program, context.scheme, c) for c in conditions}
    solutions: tuple[ControlSolution, ...] = ()
    if any(open_values.values()):
        solutions = context.solution, context.module.solve(2 * (context.solution.t.size - 1))
    for condition, values in open_values.items():
        detail = "it holds, or follows from both nodes, wherever the scheme evaluates cost and dynamics"
        finding = Finding(_NAME, condition.name, True, detail)
        if values:
            finding = _measured(context, program, condition, values, solutions)
        yield _with_excursion(finding, condition.name, worst) if condition.name in sampled else finding
    names = {condition.name for condition in conditions}
    for name in sampled:
        if name in names:
            continue
        if worst is None:
            yield not_measured(_NAME, name, context.solution.message)
        else:
            yield _with_excursion(Finding(_NAME, name, True, "it holds at nodes"), name, worst)


def _with_excursion(finding: Finding, condition: str, worst: Mapping[str, Excursion] | None) -> Finding:
    """Return a finding with the violation inside intervals (`worst`, by condition), which fails if it is gross."""
    if worst is None:
        return replace(finding, detail=f"{finding.detail}; not measured along a motion: none was found")
    excursion = worst.get(condition)
    if excursion is None:
        return replace(finding, detail=f"{finding.detail}; sampled inside intervals, the motion does not violate it")
    if excursion.is_gross and finding.passed:
        return replace(finding, passed=False, detail=excursion.note)
    within = f"sampled inside intervals, the motion violates it by {excursion.figures} at most"
    return replace(finding, detail=f"{finding.detail}; {within}")


def _open_values(program: ControlProgram, scheme: Scheme, condition: Condition) -> list[Expr]:
    """Return the values of a condition at evaluation points where it is neither imposed nor implied by both nodes."""
    model = program.model

    def in_time(value: Expr) -> Expr:
        if program.inner.scales:
            return value.xreplace(dict(program.inner.scales))
        return scaled_in_time(model, value) if program.scaled_time else value

    # The imposed values: path conditions without slacks, bounds of stages, and the condition at both nodes.
    first = len(program.interval) - program.path_multipliers
    slacks = dict.fromkeys(program.slack_symbols, S.Zero)
    imposed = {sympy.diff(program.element, symbol).xreplace(slacks) for symbol in program.interval_symbols[first:]}
    for unknown, symbol in zip(program.interval[:first], program.interval_symbols, strict=False):
        imposed |= {unknown.lower - symbol} if unknown.lower is not None else set()
        imposed |= {symbol - unknown.upper} if unknown.upper is not None else set()
    for right, symbols in enumerate((program.left_symbols, program.right_symbols)):
        names = {unknown.name: symbol for unknown, symbol in zip(program.node, symbols, strict=True)}
        node = {q: names[q.name] for q in (*model.coordinates, *model.rates) if q.name in names}
        instant = in_time(model.time + right * STEP)
        imposed.add(condition.expression.xreplace(node).xreplace({model.time: instant}))

    alone = replace(model, path=(condition,))
    if scheme.variational:
        path = variational_interval(alone, scheme, program.controlled).path
    else:
        path = one_step_interval(alone, scheme, program.controlled).path
    values = [value for point in path if (value := in_time(point.value)) not in imposed]
    convex = is_convex(model, condition) and (
        not condition.equality or is_convex(model, replace(condition, expression=-condition.expression))
    )
    if not convex:
        return values
    nodes = {*program.left_symbols, *program.right_symbols, *program.linking.symbols}
    nodes |= {model.time, STEP, *model.parameters, *(value.symbol for value in program.boundary_values)}
    values = [value for value in values if not value.free_symbols <= nodes]
    return [value for value in values if not _is_mean(value, imposed, program.element_symbols)]


def _is_mean(value: Expr, imposed: set[Expr], symbols: Sequence[Symbol]) -> bool:
    """Return True if a value of a condition is a weighted mean of imposed values, with positive weights."""
    present = value.free_symbols & set(symbols)
    slopes = [sympy.diff(value, x) for x in present]
    if not (all(slope.is_positive for slope in slopes) or all(slope.is_negative for slope in slopes)):
        return False
    values = {sympy.expand(value.xreplace(dict.fromkeys(present, x))) for x in present}
    return values <= {sympy.expand(v) for v in imposed}


def _measured(
    context: Context,
    program: ControlProgram,
    condition: Condition,
    values: Sequence[Expr],
    solutions: Sequence[ControlSolution],
) -> Finding:
    """Return a finding that passes if the largest of `values` decreases from N to 2N intervals (two `solutions`)."""
    unsolved = [solution for solution in solutions if solution.status != "solved"]
    if unsolved:
        return Finding(_NAME, condition.name, True, f"not measured: {unsolved[0].message}")
    others = [*program.model.parameters, *(value.symbol for value in program.boundary_values)]
    symbols = [*program.element_symbols, program.model.time, STEP, *others]
    functions = [sympy.lambdify(symbols, value, modules="numpy", cse=True) for value in values]
    violations = []
    for solution in solutions:
        steps, worst = solution.t.size - 1, 0.0
        grid, flat = context.module.make_grid(steps), FlatVector.on_grid(program, steps)
        times = grid.nodes * grid.h
        for body in range(program.model.bodies):
            for k in range(steps):
                point = solution.unknowns[flat.element(body, k)]
                numbers = times[k], times[k + 1] - times[k], *grid.parameters[body][: len(others)]
                for function in functions:
                    value = float(function(*point, *numbers))
                    worst = max(worst, abs(value) if condition.equality else value)
        violations.append(worst)
    coarse, fine = violations
    figures = f"{coarse:.2g} (N = {solutions[0].t.size - 1}) and {fine:.2g} (N = {solutions[1].t.size - 1})"
    if fine <= max(_NOTHING, _FALLS * coarse):
        return Finding(_NAME, condition.name, True, f"it holds at nodes, and is violated between them by {figures}")
    detail = (
        f"it holds at nodes only, and between them, where cost and dynamics are taken, it is violated by {figures}, "
        "which does not fall with the interval: nodes that alternate pay for a false optimum; use a scheme that "
        "evaluates at nodes, such as trapezoidal, or fewer unknowns"
    )
    return Finding(_NAME, condition.name, False, detail)
