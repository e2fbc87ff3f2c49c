"""What motions do between nodes: conditions on states at the points where the scheme evaluates cost and dynamics.

A condition at nodes alone leaves a mode to the discrete problem: nodes that alternate between two sides of a forbidden
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
from sympy import Expr, S, Symbol

from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.checks.module.flat_vector import FlatVector
from codegen.discretise import STEP, PathValue, one_step_interval, variational_interval
from codegen.model import Condition, Model
from codegen.model.conditions.path import nodal_conditions
from codegen.schemes import Scheme
from codegen.solutions.between_nodes import Excursion, excursions, sampled_conditions
from codegen.transcribe.assembly import scaled_in_time
from codegen.transcribe.conditions.path_conditions import is_convex
from codegen.transcribe.program import ControlProgram

_NAME = "path between nodes"
_NOTHING = 1e-6
"""A violation below it is none."""
_FALLS = 0.75
"""Part of a violation that is left, at most, on intervals of half the length."""


def check(context: Context) -> Iterator[Finding]:
    """Say for every condition on states where it holds; where it need not hold, measure it at two solutions."""
    program = context.control
    conditions = () if program.phases else _conditions(program.model)
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


def _conditions(model: Model) -> list[Condition]:
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
