"""Null spaces: directions that the boundary conditions do not fix, and controls that cost nothing.

Rank of all discrete equations, boundary conditions included: none may be redundant or out of reach. Where the Jacobian
of the constraints lacks rank, its left null vectors say which equations of motion depend on each other, and the
boundary conditions that meet them are the ones of which one is too many. Conditions between bodies are sorted into
independent ones and redundant ones, which the module leaves out.

Controls that cost nothing: a mode of the discrete controls that the discrete cost does not see. With controls on nodes
and averages in the cost, u_k = (-1)^k a leaves the average of every interval unchanged. The continuous cost does
penalise it, so the discrete optimum may be arbitrarily wrong. Where the mode acts on the motion, the optimiser moves
the system with it, for nothing: what it then finds is no optimum of the problem, which the integral of the cost over
the controls that it found reveals.

What motions do between nodes: conditions on states at the points where the scheme evaluates cost and dynamics. A
condition at nodes alone leaves a mode to the discrete problem: nodes that alternate between two sides of a forbidden
region, or along a curve, meet it, while the points at which the cost and the dynamics are taken lie where the motion
must not be. What is imposed at these points, or follows there from both nodes, has no such mode. Of the rest the
solution is measured: along a smooth motion what is violated between nodes falls with the interval, in a mode it stays.

Whatever is imposed, a motion on a coarse grid may pass through what is thin, or jump from one branch of an equality or
a holonomic constraint to another. So the motion of the solution is sampled inside intervals as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, S, Symbol

from codegen.discretise.assembly import scaled_in_time
from codegen.discretise.conditions.path import is_convex, nodal_conditions
from codegen.discretise.interval import STEP, PathValue, at_nodes, one_step_interval, variational_interval
from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.program import ControlProgram, EndElement
from codegen.discretise.redundant_couplings import independent_couplings
from codegen.discretise.schemes.base import Scheme
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured, vanishing
from codegen.evidence.checks.layout import FlatVector, few_steps
from codegen.evidence.checks.solution import free_values, integral_of_cost
from codegen.runtime.record import phrase
from codegen.runtime.search import callbacks
from codegen.runtime.search.callbacks import submatrix
from codegen.solving.results.between_nodes import Excursion, excursions, sampled_conditions
from codegen.solving.results.output import shortened
from codegen.symbolic import checks as expressions

_INTERVALS = 8
_MOST_INTERVALS = 64
_SINGULAR = 1e-11
_TAKES_PART = 1e-6
_HOLDS = 1e-6


def check_boundary_rank(context: Context) -> Iterator[Finding]:
    """Decompose the scaled Jacobian at the guess and beside it; the larger rank counts. Then look at couplings."""
    program = context.control
    yield from _rank(context, program)
    if context.model.couplings:
        yield from _couplings(context)


def _rank(context: Context, program: ControlProgram) -> Iterator[Finding]:
    module = context.module
    intervals = _enough_intervals(module, few_steps(program, _INTERVALS))
    grid = module.make_grid(intervals)
    guess = module.initial_guess(grid)
    best: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None
    generator = np.random.default_rng(11)
    free = np.concatenate([module.primal_unknowns(grid), module.multiplier_unknowns(grid)])
    for amount in (0.0, 0.05):
        unknowns = guess.copy()
        unknowns[free] += amount * generator.uniform(-1, 1, free.size) * (1 + np.abs(unknowns[free]))
        found = _decomposed(module, grid, module.with_pinned_values(grid, unknowns))
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    rows = module.multiplier_unknowns(grid)
    free_count = module.primal_unknowns(grid).size
    if best is None:
        reason = "their Jacobian is not finite at the guess nor beside it"
        yield not_measured("boundary rank", "all equations", reason)
        return
    lacking, nulls, touched = best
    if lacking == 0:
        conditions = [f"{v.where} {v.quantity}" for v in program.boundary_values]
        further = [*program.start.conditions, *program.end.conditions]
        further += [equation for phase in program.phases for equation in phase.switch_equations]
        conditions += [name.partition("(")[2].removesuffix(")") for name, _ in further if "(" in name]
        detail = f"{rows.size} equations in {free_count} unknowns have full rank (N = {intervals})"
        yield Finding("boundary rank", "all equations", True, f"{detail}: {', '.join(conditions) or 'no conditions'}")
        return
    for null in range(lacking):
        detail = _named(program, intervals, nulls[:, null], rows, touched[null])
        yield Finding("boundary rank", "all equations", False, detail)


def _enough_intervals(module: Any, intervals: int) -> int:
    """As many as are given, or more where these have fewer unknowns than equations: one control for many masses."""
    while intervals < _MOST_INTERVALS:
        grid = module.make_grid(intervals)
        if module.primal_unknowns(grid).size >= module.multiplier_unknowns(grid).size:
            break
        intervals *= 2
    return intervals


def _couplings(context: Context) -> Iterator[Finding]:
    """Conditions between bodies that follow from others, and their residuals at the solution."""
    model, solution = context.model, context.solution
    found = independent_couplings(model)
    names = [condition.name for condition in model.couplings]
    subject = "conditions between bodies"
    if not found.consistent:
        violated = shortened(found.violated)
        detail = f"they contradict each other: no configuration was found where {violated} holds as well"
        yield Finding("boundary rank", subject, False, detail)
        return
    kept = f"{len(found.kept)} of {len(names)} are independent" + ("" if found.dropped else ", none is redundant")
    yield Finding("boundary rank", subject, True, kept)
    for index, others in found.dropped:
        sources = "; ".join(map(shortened, others))
        detail = f"redundant, and left out: it follows from {sources}" if others else "redundant: it says nothing"
        missed = _missed(context, index)
        passed = solution.status != "solved" or missed <= _HOLDS
        if not passed:
            detail = f"left out as redundant, but the solution violates it by {missed:.2g}; start from a better guess"
        name = shortened(names[index])
        subject = name if name == names[index] else f"number {index + 1}, {name}"  # the beginning may be that of others
        yield Finding("boundary rank", subject, passed, detail)


def _missed(context: Context, index: int) -> float:
    """By how much the solution violates a condition between bodies."""
    model, solution = context.model, context.solution
    free = dict(zip((p.symbol for p in model.free_parameters), free_values(context.module, solution), strict=True))
    width = len(model.coordinates)
    values = model.default_values | free
    values |= {v.symbol: float(solution.q[-1, v.body * width + v.coordinate]) for v in model.end_values}
    number = expressions.rounded_at(model.couplings[index].expression, values)
    return abs(number) if number is not None else float("inf")


def _decomposed(module: Any, grid: Any, unknowns: Any) -> tuple[int, NDArray[np.float64], NDArray[np.float64]] | None:
    """How much rank is missing, the left null vectors (columns), and what of every unknown they meet (rows).

    None where the Jacobian is not finite.
    """
    rows, columns = module.multiplier_unknowns(grid), module.primal_unknowns(grid)
    matrix = _dense(callbacks.jacobian(grid, unknowns), (rows.size, columns.size))
    if not np.isfinite(matrix).all():
        return None
    row_scale = np.abs(matrix).max(axis=1, initial=0.0)
    row_scale[row_scale == 0.0] = 1.0
    scaled = matrix / row_scale[:, None]
    column_scale = np.abs(scaled).max(axis=0, initial=0.0)
    column_scale[column_scale == 0.0] = 1.0
    left, singular, _ = np.linalg.svd(scaled / column_scale, full_matrices=True)
    rank = int(np.sum(singular > _SINGULAR * singular.max(initial=0.0)))
    nulls = left[:, rank:]
    every = np.flatnonzero(~grid.is_multiplier)
    full = _dense(submatrix(grid, unknowns, rows, every, False), (rows.size, every.size))
    share = nulls.T @ (full / row_scale[:, None])
    touched = np.zeros((nulls.shape[1], unknowns.size))
    touched[:, every] = np.abs(share)
    return rows.size - rank, nulls, touched


def _dense(entries: Any, shape: tuple[int, int]) -> NDArray[np.float64]:
    matrix = np.zeros(shape)
    np.add.at(matrix, (entries[0], entries[1]), entries[2])
    return matrix


def _named(program: ControlProgram, intervals: int, null: Any, rows: Any, touched: Any) -> str:
    """Which equations depend on each other, and which boundary conditions take part."""
    flat = FlatVector.on_grid(program, intervals)
    weights = np.zeros(flat.size)
    weights[rows] = np.abs(null)
    bound = _TAKES_PART * weights.max()
    meanings = flat.meanings()
    equations = dict.fromkeys(phrase(meanings[i], role=False) for i in np.flatnonzero(weights > bound))
    conditions = dict[str, None]()
    for body in range(program.bodies):
        for where, end, k in (("start", program.start, 0), ("end", program.end, flat.steps)):
            indices = flat.node(body, k)
            conditions |= _conditions(program, where, end, weights[indices] > bound, touched[indices] > bound)
    listed = ", ".join(conditions) or "no boundary condition"
    involved = "; ".join(equations)
    return f"redundant or unreachable: one of {listed} ({involved} depend on each other); leave one of them free"


def _conditions(program: ControlProgram, where: str, end: EndElement, takes_part: Any, touched: Any) -> dict[str, None]:
    """Prescribed positions (or momenta) whose column a null vector meets, and velocities whose equation it holds."""
    values = {value.symbol: value for value in program.boundary_values}
    found = dict[str, None]()
    for index, value in end.pins:
        if value in values and touched[index]:
            found[f"{where} {values[value].quantity}"] = None
    symbols = program.left_symbols if where == "start" else program.right_symbols
    for index, unknown in enumerate(program.node):
        if unknown.multiplier and takes_part[index]:
            condition = end.element.diff(symbols[index])
            found |= {f"{where} {values[s].quantity}": None for s in values if s in condition.free_symbols}
    return found


_ALLOWED = 0.1
"""Relative difference between both costs that the order of the scheme may explain."""


def check_null_controls(context: Context) -> Iterator[Finding]:
    """Look for the alternating mode of nodal controls, and for free modes of interval controls, control by control."""
    program = context.control
    if not program.model.controls:
        yield does_not_apply("null controls", "there are no controls")
        return
    if not program.nodal_controls:
        yield from (_interval(program, u) for u in program.model.controls)
        return
    acting = False
    for u in program.model.controls:
        finding, acts = _nodal(program, u)
        acting = acting or acts
        yield finding
    if acting:
        yield from _false_optimum(context)


def _false_optimum(context: Context) -> Iterator[Finding]:
    """The discrete cost of what the solver finds, against the integral of the cost over the controls found."""
    model, solution = context.model, context.solution
    if solution.status != "solved" or model.terminal_cost != 0:
        return
    claimed, true = float(solution.cost), integral_of_cost(model, context.module, solution)
    numbers = f"discrete cost {claimed:.6g}, integral of the cost over the same controls {true:.6g}"
    passed = abs(true - claimed) <= _ALLOWED * max(abs(true), abs(claimed))
    detail = f"{numbers} (N = {solution.t.size - 1})"
    if not passed:
        detail = f"a false optimum, which the alternating controls pay for: {detail}"
    yield Finding("null controls", "optimum with nodal controls", passed, detail)


def _nodal(program: ControlProgram, u: Symbol) -> tuple[Finding, bool]:
    """Whether the mode costs nothing, and whether it then acts.

    It is the cost of an interval under u_k + a, u_k1 - a; both signs of a occur in turn.
    """
    (left,), (right,) = at_nodes([u], "_k"), at_nodes([u], "_k1")
    amplitude = sympy.Dummy("a", real=True)
    mode = {left: left + amplitude, right: right - amplitude}
    change = program.cost.subs(mode, simultaneous=True).diff(amplitude)
    if not vanishing(change) or not _is_penalised(program, u):
        return Finding(
            "null controls", f"nodal control {u}", True, "the alternating control is seen by the cost"
        ), False
    # What the mode adds to the equations of motion; it vanishes where forces are averaged and do not depend on place.
    force = (program.element - program.cost).subs(mode, simultaneous=True).diff(amplitude)
    acts = not vanishing(force)
    effect = "yet acts on the motion" if acts else "and does nothing either, so that it is undetermined"
    detail = f"alternating nodal control {u}: {u}_k = (-1)^k a costs nothing, {effect}; use controls on intervals"
    return Finding("null controls", f"nodal control {u}", False, detail), acts


def _interval(program: ControlProgram, u: Symbol) -> Finding:
    """With controls of its own for each interval, or stage, a free mode would have to be free within one."""
    unseen = [site for site in program.controls_of(u) if vanishing(program.cost.diff(site))]
    passed = not (unseen and _is_penalised(program, u))
    where = "stage" if program.controlled == "stages" else "interval"
    detail = f"none: the discrete cost sees the control of every {where}" if passed else f"{unseen[0]} costs nothing"
    if passed and not _is_penalised(program, u):
        detail = "none of the discretisation: the problem's own cost does not hold it"
    return Finding("null controls", f"{where} control {u}", passed, detail)


def _is_penalised(program: ControlProgram, u: Symbol) -> bool:
    return program.model.cost is not None and not vanishing(program.model.cost.diff(u))


_NAME = "path between nodes"
_NOTHING = 1e-6
"""A violation below it is none."""
_FALLS = 0.75
"""Part of a violation that is left, at most, on intervals of half the length."""


def check_path_modes(context: Context) -> Iterator[Finding]:
    """Say for every condition on states where it holds; where it need not hold, measure it at two solutions."""
    program = context.control
    conditions = () if program.phases else _path_conditions(program.model)
    sampled = sampled_conditions(context.module)
    if not (conditions or sampled):
        yield does_not_apply(_NAME, "there are no conditions on states alone")
        return
    excursion = _excursions(context) if sampled else {}
    open_values = {c: _open_values(program, context.scheme, c) for c in conditions}
    solutions: tuple[Any, ...] = ()
    if any(open_values.values()):
        solutions = context.solution, context.module.solve(2 * (context.solution.t.size - 1))
    for condition, values in open_values.items():
        if not values:
            detail = "it holds, or follows from both nodes, wherever the scheme evaluates cost and dynamics"
            finding = Finding(_NAME, condition.name, True, detail)
        else:
            finding = _measured(context, program, condition, values, solutions)
        yield _with_excursion(finding, condition.name, sampled, excursion)
    known = {condition.name for condition in conditions}
    for name in sampled:
        if name in known:
            continue
        if excursion is None:
            yield not_measured(_NAME, name, context.solution.message)
        else:
            yield _with_excursion(Finding(_NAME, name, True, "it holds at nodes"), name, sampled, excursion)


def _excursions(context: Context) -> dict[str, Excursion] | None:
    """What the solution violates inside intervals, by the names of conditions; None without a solution."""
    solution, phases = context.solution, context.module.metadata.phases
    if solution.status != "solved":
        return None
    found = excursions(context.module, solution.unknowns, (solution.t.size - 1) // phases, None)
    return {one.condition: one for one in found}


def _with_excursion(
    finding: Finding, name: str, sampled: Sequence[str], found: Mapping[str, Excursion] | None
) -> Finding:
    """A finding, with what the motion of the solution does inside intervals; the gross is a failure."""
    if name not in sampled:
        return finding
    if found is None:
        return replace(finding, detail=f"{finding.detail}; not measured along a motion: none was found")
    if name not in found:
        return replace(finding, detail=f"{finding.detail}; sampled inside intervals, the motion does not violate it")
    worst = found[name]
    if worst.is_gross and finding.passed:
        return replace(finding, passed=False, detail=worst.note)
    within = f"sampled inside intervals, the motion violates it by {worst.figures} at most"
    return replace(finding, detail=f"{finding.detail}; {within}")


def _path_conditions(model: Model) -> list[Condition]:
    """Path conditions and bounds on quantities that nodes have."""
    found = [*nodal_conditions(model, equality=True), *nodal_conditions(model, equality=False)]
    for bound in model.bounds:
        if bound.symbol in (*model.coordinates, *model.rates):
            if bound.lower is not None:
                found.append(Condition(f"{bound.symbol} >= {bound.lower}", bound.lower - bound.symbol, equality=False))
            if bound.upper is not None:
                found.append(Condition(f"{bound.symbol} <= {bound.upper}", bound.symbol - bound.upper, equality=False))
    return found


def _open_values(program: ControlProgram, scheme: Scheme, condition: Condition) -> list[Expr]:
    """The values of a condition at points of evaluation at which it is neither imposed nor follows from both nodes."""
    model = program.model
    ends = [_at_end(program, condition, symbols) for symbols in (program.left_symbols, program.right_symbols)]
    instants = [_in_time(program, model.time + right * STEP) for right in (0, 1)]
    at_ends = [value.xreplace({model.time: t}) for value, t in zip(ends, instants, strict=True)]
    imposed = {*_imposed(program), *at_ends}
    nodes = {*program.left_symbols, *program.right_symbols, *program.shared_symbols}
    nodes |= {model.time, STEP, *model.parameters, *(value.symbol for value in program.boundary_values)}
    convex = is_convex(model, condition) and (
        not condition.equality or is_convex(model, replace(condition, expression=-condition.expression))
    )
    values = [_in_time(program, v.value) for v in _values(program, scheme, condition)]
    open_values = [v for v in values if v not in imposed and not (convex and v.free_symbols <= nodes)]
    return [v for v in open_values if not (convex and _is_mean(v, imposed, program.element_symbols))]


def _is_mean(value: Expr, imposed: set[Expr], symbols: Sequence[Symbol]) -> bool:
    """Tell if a value of a condition is a weighted mean of imposed values, with positive weights."""
    present = value.free_symbols & set(symbols)
    slopes = [sympy.diff(value, x) for x in present]
    if not (all(slope.is_positive for slope in slopes) or all(slope.is_negative for slope in slopes)):
        return False
    values = [sympy.expand(value.xreplace(dict.fromkeys(present, x))) for x in present]
    return {sympy.expand(v) for v in values} <= {sympy.expand(v) for v in imposed}


def _values(program: ControlProgram, scheme: Scheme, condition: Condition) -> Sequence[PathValue]:
    model = replace(program.model, path=(condition,))
    if scheme.variational:
        return variational_interval(model, scheme, program.controlled).path
    return one_step_interval(model, scheme, program.controlled).path


def _imposed(program: ControlProgram) -> Iterator[Expr]:
    """The left sides of the path conditions of an interval, without slacks, and bounds of its stages."""
    first = len(program.interval) - program.path_multipliers
    slacks = dict.fromkeys(program.slack_symbols, S.Zero)
    for symbol in program.interval_symbols[first:]:
        yield sympy.diff(program.element, symbol).xreplace(slacks)
    for unknown, symbol in zip(program.interval[:first], program.interval_symbols, strict=False):
        if unknown.lower is not None:
            yield unknown.lower - symbol
        if unknown.upper is not None:
            yield symbol - unknown.upper


def _at_end(program: ControlProgram, condition: Condition, symbols: Sequence[Symbol]) -> Expr:
    """A condition in the symbols of a node."""
    names = {unknown.name: symbol for unknown, symbol in zip(program.node, symbols, strict=True)}
    quantities = (*program.model.coordinates, *program.model.rates)
    return condition.expression.xreplace({q: names[q.name] for q in quantities if q.name in names})


def _in_time(program: ControlProgram, value: Expr) -> Expr:
    if program.inner.scales:
        return value.xreplace(dict(program.inner.scales))
    return scaled_in_time(program.model, value) if program.scaled_time else value


def _measured(
    context: Context, program: ControlProgram, condition: Condition, values: Sequence[Expr], solutions: Sequence[Any]
) -> Finding:
    """Compare what is violated between nodes on N and on 2 N intervals."""
    unsolved = [solution for solution in solutions if solution.status != "solved"]
    if unsolved:
        return Finding(_NAME, condition.name, True, f"not measured: {unsolved[0].message}")
    coarse, fine = (_violation(context.module, program, condition, values, solution) for solution in solutions)
    numbers = f"{coarse:.2g} (N = {solutions[0].t.size - 1}) and {fine:.2g} (N = {solutions[1].t.size - 1})"
    if fine <= max(_NOTHING, _FALLS * coarse):
        return Finding(_NAME, condition.name, True, f"it holds at nodes, and is violated between them by {numbers}")
    detail = (
        f"it holds at nodes only, and between them, where cost and dynamics are taken, it is violated by {numbers}, "
        "which does not fall with the interval: nodes that alternate pay for a false optimum; use a scheme that "
        "evaluates at nodes, such as trapezoidal, or fewer unknowns"
    )
    return Finding(_NAME, condition.name, False, detail)


def _violation(
    module: Any, program: ControlProgram, condition: Condition, values: Sequence[Expr], solution: Any
) -> float:
    """The largest violation of any of the values in any interval."""
    steps = solution.t.size - 1
    grid, flat = module.make_grid(steps), FlatVector.on_grid(program, steps)
    others = [*program.model.parameters, *(value.symbol for value in program.boundary_values)]
    known = [*program.element_symbols, program.model.time, STEP, *others]
    functions = [sympy.lambdify(known, value, modules="numpy", cse=True) for value in values]
    worst, times = 0.0, grid.nodes * grid.h
    for body in range(program.bodies):
        numbers = grid.parameters[body][: len(others)]
        for k in range(steps):
            point = solution.unknowns[flat.element(body, k)]
            for function in functions:
                value = float(function(*point, times[k], times[k + 1] - times[k], *numbers))
                worst = max(worst, abs(value) if condition.equality else value)
    return float(np.max([worst, 0.0]))
