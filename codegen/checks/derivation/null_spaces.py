"""Null spaces: directions that the boundary conditions do not fix, and controls that cost nothing.

Rank of all discrete equations, boundary conditions included: none may be redundant or out of reach.

Where the Jacobian of the constraints lacks rank, its left null vectors say which equations of motion depend on each
other, and the boundary conditions that meet them are the ones of which one is too many. Conditions between bodies are
sorted into independent ones and redundant ones, which the module leaves out.

Controls that cost nothing: a mode of the discrete controls that the discrete cost does not see.

With controls on nodes and averages in the cost, u_k = (-1)^k a leaves the average of every interval unchanged. The
continuous cost does penalise it, so the discrete optimum may be arbitrarily wrong. Where the mode acts on
the motion, the optimiser moves the system with it, for nothing: what it then finds is no optimum of the problem, which
the integral of the cost over the controls that it found reveals.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Symbol

from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.checks.evaluation import vanishing
from codegen.checks.module.flat_vector import FlatVector, few_steps
from codegen.checks.solution.motion import free_values, integral_of_cost
from codegen.discretise import at_nodes
from codegen.expressions import checks as expressions
from codegen.runtime.search import callbacks
from codegen.runtime.search.callbacks import submatrix
from codegen.solutions.notes import shortened
from codegen.transcribe.program import ControlProgram, EndElement
from codegen.transcribe.redundancy.redundant_couplings import independent_couplings

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
    """Which conditions between bodies follow from others, and whether the solution satisfies these as well."""
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
    equations = dict.fromkeys(meanings[i].removeprefix("multiplier of ") for i in np.flatnonzero(weights > bound))
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
    """Whether the continuous cost depends on the control at all, beyond the way in which it is written."""
    return program.model.cost is not None and not vanishing(program.model.cost.diff(u))
