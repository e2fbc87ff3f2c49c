"""First and second derivatives of a discretised problem, with exact sparsity and provably constant entries.

The Lagrangian of a control problem is a sum of shares: contributions of intervals, samples and both ends. Sensitivities
of a solution also need derivatives of shares with respect to data, and mixed derivatives with respect to unknowns and
data. Data are parameters, boundary values, conditions at inner times, and the time and length of an interval.

The general form of a module has all features, also features that the problem does not need. It serves measurements of
the gain of leaving features out, and no command offers it. A general time step keeps all its unknowns for Newton's
method, even if they are explicit or follow from a linear solve. A general control problem has one more free parameter,
with bounds, which no equation reads and whose square is added to the cost. It is zero at the optimum, but requires the
interior-point method, linking variables and nonlinear ends. Controls stay in the linear system, and zeros of the
Hessian are stored and factored like other entries. Neither form has derivatives with respect to cyclic coordinates, or
absent forces.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import FreeParameter, Model
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, EndElement, StepProgram
from codegen.discretise.simulation import rates_of_change
from codegen.discretise.transcribe import transcribe
from codegen.emit.pairwise_derivatives import PairDerivatives, pair_derivatives
from codegen.errors import ArgumentError
from codegen.symbolic import checks as expressions
from codegen.symbolic.derivatives import first_derivatives, mixed_derivatives, second_derivatives
from codegen.symbolic.derivatives import jacobian as differentiated
from codegen.symbolic.graph import Assignment
from codegen.symbolic.parts import operations
from codegen.symbolic.terms import Family, are_many, families
from codegen.symbolic.zeros import identically_zero

Entry = tuple[int, int, Expr]
"""Row, column and value of a structurally nonzero derivative."""
LONG = 200
"""Number of operations from which a scalar is differentiated on its expression graph; plain results read better."""
_LONG_STEP = 1000
"""The same number for all equations of a time step together."""


@dataclass(frozen=True)
class ElementDerivatives:
    """Gradient (dense) and Hessian (lower triangle, structural nonzeros) of a contribution to the Lagrangian; its cost.

    For long expressions, gradient and cost may read symbols that `gradient_assignments` define, and the Hessian
    symbols of `hessian_assignments`. Entries that do not depend on unknowns read no such symbol.
    """

    unknowns: tuple[Symbol, ...]
    gradient: tuple[Expr, ...]
    hessian: tuple[Entry, ...]
    cost: Expr = sympy.S.Zero
    gradient_assignments: tuple[Assignment, ...] = ()
    hessian_assignments: tuple[Assignment, ...] = ()

    @property
    def varying(self) -> set[Symbol]:
        """The unknowns, and the symbols of `hessian_assignments`; constant entries of the Hessian read none of them."""
        return {*self.unknowns, *(symbol for symbol, _ in self.hessian_assignments)}


@dataclass(frozen=True)
class ShootingGradient:
    """The gradient of an interval's share if an explicit scheme computes the stages one after the other.

    `assignments` define the stages, then the multipliers of their equations from the last to the first: the derivatives
    of the share with respect to stages vanish. `gradient` (dense) and `cost` may read all symbols that they define.
    `dependent` are the indices of the stages and of these multipliers among the unknowns; their gradient is zero.
    """

    dependent: tuple[int, ...]
    gradient: tuple[Expr, ...]
    cost: Expr
    assignments: tuple[Assignment, ...]


@dataclass(frozen=True)
class ControlDerivatives:
    """All derivatives for the structured Newton method of a control problem.

    `elements` has one entry for each kind of interval; only several phases have several kinds. All their Hessians have
    one pattern, which contains the pattern of a `sample` of measurements. `condensed` counts the last unknowns of an
    interval that are eliminated inside it. Slacks always are, since their barrier terms are positive. Controls are if
    their block of the Hessian is constant and regular and there are no stages. `stages` counts the first unknowns of an
    interval that the equations of the next multipliers determine. `linear_quadratic` is True if no Hessian entry
    depends on an unknown and one Newton step suffices. Nodal controls can make this system singular and are excluded.
    `shooting` has one entry for each kind of interval if the scheme is explicit: then a search has no stages.
    """

    elements: tuple[ElementDerivatives, ...]
    start: ElementDerivatives
    end: ElementDerivatives
    condensed: int
    stages: int
    linear_quadratic: bool
    sample: ElementDerivatives | None = None
    shooting: tuple[ShootingGradient, ...] = ()

    @property
    def element(self) -> ElementDerivatives:
        """The derivatives of the first kind of interval, which is the only kind without phases."""
        return self.elements[0]


@dataclass(frozen=True)
class StepDerivatives:
    """Residual of an implicit time step and its Jacobian (dense, row by row); both are empty for an explicit step.

    `constant` is True if the Jacobian depends only on parameters and the step's length, so that one factorisation
    suffices. A long residual and its Jacobian may read the symbols that `assignments` define.
    """

    residual: tuple[Expr, ...]
    jacobian: tuple[tuple[Expr, ...], ...]
    constant: bool
    assignments: tuple[Assignment, ...] = ()


@dataclass(frozen=True)
class DataDerivatives:
    """Derivatives of a contribution to the Lagrangian with respect to data, and with respect to unknowns and data.

    Slopes are pairs (datum's index, value); mixed entries are (unknown's index, datum's index, value). Identically zero
    entries are left out. All values may read the symbols that `assignments` define.
    """

    slopes: tuple[tuple[int, Expr], ...]
    mixed: tuple[Entry, ...]
    assignments: tuple[Assignment, ...] = ()


@dataclass(frozen=True)
class ControlSensitivities:
    """Derivatives, with respect to data, of the contributions of intervals, ends and samples to the Lagrangian.

    The mixed derivatives of all intervals have one pattern, which contains the pattern of a `sample` of measurements.
    """

    elements: tuple[DataDerivatives, ...]
    start: DataDerivatives
    end: DataDerivatives
    sample: DataDerivatives | None = None


def derivatives(
    program: ControlProgram | StepProgram | PairwiseProgram,
) -> ControlDerivatives | StepDerivatives | PairDerivatives:
    """Return the derivatives that the solver of a discretised problem needs."""
    if isinstance(program, PairwiseProgram):
        return pair_derivatives(program.model)
    return control_derivatives(program) if isinstance(program, ControlProgram) else step_derivatives(program)


def control_derivatives(program: ControlProgram) -> ControlDerivatives:
    """Return first and second derivatives of the contributions of intervals, samples and ends to the Lagrangian."""
    unknowns = program.element_symbols
    samples = [_element(s.element, unknowns, s.element) for s in (program.sample,) if s is not None]
    shares = [_element(e.element, unknowns, e.cost) for e in program.interval_elements]
    hessians = _with_one_pattern([share.hessian for share in (*shares, *samples)])
    elements = tuple(replace(share, hessian=h) for share, h in zip(shares, hessians, strict=False))
    start, end = (
        _element(end.element, (*node, *program.linking.symbols), end.cost, {i for i, _ in end.pins})
        for end, node in ((program.start, program.left_symbols), (program.end, program.right_symbols))
    )
    stages, condensed = _stages(program, elements[0]), len(program.slacks)
    if not stages:
        first = len(program.left_symbols) + len(program.interval_symbols)
        controls = range(first, first + len(program.control_symbols))
        curved = any(row in controls and column in controls for s in samples for row, column, _ in s.hessian)
        if not curved and all(_has_regular_controls(program, element) for element in elements):
            condensed += len(controls)
    every = (*elements, *samples, start, end)
    varying = set[Symbol]().union(*(share.varying for share in every))
    linear_quadratic = (
        program.controlled != "nodal"
        and not program.has_inequalities
        and not program.linking.couplings
        and not any(value.free_symbols & varying for share in every for _, _, value in share.hessian)
    )
    return ControlDerivatives(
        elements=elements,
        start=start,
        end=end,
        condensed=condensed,
        stages=stages,
        linear_quadratic=linear_quadratic,
        sample=next(iter(samples), None),
        shooting=() if linear_quadratic else _shooting_gradients(program, stages, samples),
    )


def step_derivatives(program: StepProgram) -> StepDerivatives:
    """Return the residual of a step and its Jacobian; assignments before the step do not depend on its unknowns."""
    fixed = {*program.model.parameters, STEP}
    residual, assignments = program.residual, tuple[Assignment, ...]()
    found = families([[r] for r in residual], set(program.unknowns).__contains__)
    if are_many(found):
        jacobian = _jacobian_of(found, program.unknowns)
    elif sum(map(operations, residual)) < _LONG_STEP:
        slopes = [[sympy.diff(r, y) for y in program.unknowns] for r in residual]
        jacobian = tuple(tuple(sympy.S.Zero if identically_zero(s) else s for s in row) for row in slopes)
    else:
        written, indices = differentiated(residual, program.unknowns, fixed)
        residual, assignments = written.values[: len(residual)], written.assignments
        entries = dict(zip(indices, written.values[len(residual) :], strict=True))
        columns = range(len(program.unknowns))
        jacobian = tuple(tuple(entries.get((i, j), sympy.S.Zero) for j in columns) for i in range(len(residual)))
    constant = all(entry.free_symbols <= fixed for row in jacobian for entry in row)
    return StepDerivatives(residual, jacobian, constant, assignments)


def _jacobian_of(found: Sequence[Family], unknowns: Sequence[Symbol]) -> tuple[tuple[Expr, ...], ...]:
    """Return the Jacobian (dense, row by row) of the rows of families: one member of each family is differentiated."""
    places = {y: j for j, y in enumerate(unknowns)}
    rows = dict[int, tuple[Expr, ...]]()
    for family in found:
        (template,) = family.template
        slopes = dict[int, Expr]()
        for index, (slot, symbol) in enumerate(zip(family.slots, family.members[0].symbols, strict=True)):
            if symbol in places and not identically_zero(slope := sympy.diff(template, slot)):
                slopes[index] = slope
        for member in family.members:
            symbols = dict(zip(family.slots, member.symbols, strict=True))
            row = [sympy.S.Zero] * len(unknowns)
            for index, slope in slopes.items():
                row[places[member.symbols[index]]] = slope.xreplace(symbols)
            rows[member.row] = tuple(row)
    return tuple(row for _, row in sorted(rows.items()))


def _element(scalar: Expr, unknowns: Sequence[Symbol], cost: Expr, fixed: Collection[int] = ()) -> ElementDerivatives:
    """Return first and second derivatives of a scalar; the unknowns at the `fixed` indices count as constants."""
    if scalar.count_ops() >= LONG:
        free = [index for index in range(len(unknowns)) if index not in fixed]
        second = second_derivatives(scalar, [unknowns[index] for index in free], (cost,))
        *slopes, written_cost = second.gradient.values
        by_unknown = dict(zip(free, slopes, strict=True))
        entries = zip(second.indices, second.hessian.values, strict=True)
        return ElementDerivatives(
            unknowns=tuple(unknowns),
            gradient=tuple(by_unknown.get(index, sympy.S.Zero) for index in range(len(unknowns))),
            hessian=tuple((free[row], free[column], value) for (row, column), value in entries),
            cost=written_cost,
            gradient_assignments=second.gradient.assignments,
            hessian_assignments=second.hessian.assignments,
        )
    gradient = tuple(sympy.S.Zero if i in fixed else sympy.diff(scalar, x) for i, x in enumerate(unknowns))
    hessian: list[Entry] = []
    for row, slope in enumerate(gradient):
        present = slope.free_symbols
        for column, x in enumerate(unknowns[: row + 1]):
            if x in present and column not in fixed and not identically_zero(value := sympy.diff(slope, x)):
                hessian.append((row, column, value))
    return ElementDerivatives(tuple(unknowns), gradient, tuple(hessian), cost)


def _with_one_pattern(shares: Sequence[Sequence[Entry]]) -> list[tuple[Entry, ...]]:
    """Return the entries of several matrices in one pattern: zeros are added where only others have entries."""
    values = [{(row, column): value for row, column, value in entries} for entries in shares]
    pattern = sorted(set[tuple[int, int]]().union(*values))
    return [tuple((*index, entries.get(index, sympy.S.Zero)) for index in pattern) for entries in values]


def _stages(program: ControlProgram, element: ElementDerivatives) -> int:
    """Return the number of unknowns at stages of an interval that can be eliminated by their equations.

    Return zero if some intervals lack stages, as in phases with states of their own. Return zero, too, if the Hessian
    has entries between stages and slacks, or between stage equations and multipliers, as in the general form.
    """
    multipliers = [unknown.multiplier for unknown in program.interval]
    count = multipliers.index(True) if True in multipliers else 0
    lacking = {*program.inner.lacking, *(index for part in program.interval_elements for index in part.lacking)}
    if lacking & {*range(2 * count)} or len(multipliers) < 2 * count or not all(multipliers[count : 2 * count]):
        return 0
    kinds = [
        *program.node,
        *program.interval,
        *program.controls,
        *program.slacks,
        *program.node,
        *program.linking.unknowns,
    ]
    duals = {index for index, unknown in enumerate(kinds) if unknown.multiplier}
    first = len(program.node)
    equations, after = {*range(first + count, first + 2 * count)}, first + len(program.interval) + len(program.controls)
    staged, slacks = {*range(first, first + 2 * count)}, {*range(after, after + len(program.slacks))}
    for row, column, _ in element.hessian:
        for one, other in ((row, column), (column, row)):
            if (one in equations and other in duals) or (one in staged and other in slacks):
                return 0
    return count


def _shooting_gradients(
    program: ControlProgram, count: int, samples: Sequence[ElementDerivatives]
) -> tuple[ShootingGradient, ...]:
    """Return the gradients of all kinds of intervals, with `count` stages that an explicit scheme computes.

    Return nothing without stages, for an implicit scheme, or if samples of measurements depend on stages.
    """
    unknowns, first = program.element_symbols, len(program.node)
    stages, multipliers = unknowns[first : first + count], unknowns[first + count : first + 2 * count]
    dependent = range(first, first + 2 * count)
    if not count or any(sample.gradient[index] != 0 for sample in samples for index in dependent):
        return ()
    gradients = []
    for share in program.interval_elements:
        values = [sympy.diff(share.element, multiplier) for multiplier in multipliers]
        values = [stage - value for stage, value in zip(stages, values, strict=True)]
        if any(value.free_symbols & {*stages[i:]} for i, value in enumerate(values)):
            return ()
        others = share.element.xreplace(dict.fromkeys(multipliers, sympy.S.Zero))
        terms = (multiplier * value for multiplier, value in zip(multipliers, values, strict=True))
        written = first_derivatives(sympy.Add(others, *(-term for term in terms)), unknowns, (share.cost, *values))
        slopes, (cost, *values) = written.values[: len(unknowns)], written.values[len(unknowns) :]
        of_stages = [-slopes[index] for index in dependent[:count]]
        pairs = zip((*stages, *multipliers), (*values, *of_stages), strict=True)
        defined = dict((*written.assignments, *pairs))
        wanted = (*stages, *reversed(multipliers), *defined)
        # Each assignment follows the assignments that it reads.
        number = {symbol: i for i, symbol in enumerate(defined)}
        placed, waiting = dict[Symbol, Expr](), [*reversed(wanted)]
        while waiting:
            missing = defined[waiting[-1]].free_symbols & defined.keys() - placed.keys()
            if missing:
                waiting += sorted(missing, key=number.__getitem__, reverse=True)
            else:
                symbol = waiting.pop()
                placed[symbol] = defined[symbol]
        gradients.append(
            ShootingGradient(
                dependent=tuple(dependent),
                gradient=tuple(sympy.S.Zero if i in dependent else slope for i, slope in enumerate(slopes)),
                cost=cost,
                assignments=tuple(placed.items()),
            )
        )
    return tuple(gradients)


def _has_regular_controls(program: ControlProgram, element: ElementDerivatives) -> bool:
    """Return True if an interval has controls whose block of the Hessian is constant and regular."""
    size = len(program.control_symbols)
    if size == 0:
        return False
    first = len(program.left_symbols) + len(program.interval_symbols)
    block = sympy.zeros(size, size)
    for row, column, value in element.hessian:
        if first <= row < first + size and first <= column < first + size:
            if value.free_symbols & (element.varying | {program.model.time}):
                return False
            block[row - first, column - first] = block[column - first, row - first] = value
    points = expressions.sample_points(block.free_symbols, {}, {})
    return expressions.null_direction(expressions.values_at(block, point) for point in points) is None


def require_sensitive(model: Model | PairwiseModel) -> None:
    """Raise ArgumentError if sensitivities are not available for solutions of a problem.

    With measurements, the duration and inner times must not depend on parameters, since samples lie at fixed times.
    """
    if model.task != "control":
        raise ArgumentError(f"a problem to {model.task} has no sensitivities", "leave them out: only optima have them")
    assert isinstance(model, Model), "particles are no optimisation"
    if model.contacts:
        finding = "the sequence of contacts changes with the parameters, and sensitivities keep it"
        raise ArgumentError(finding, "leave sensitivities out, and solve again with other parameters")
    parts = model.phases or (model,)
    times = [part.duration for part in parts]
    times += [point.time for part in parts for point in part.inner_times if point.time is not None]
    if any(part.measurements for part in parts) and any(time.free_symbols & {*model.parameters} for time in times):
        finding = "sensitivities of measurements need times that follow no parameters"
        raise ArgumentError(finding, "give the duration and inner times as numbers, or leave sensitivities out")


def data_of(program: ControlProgram) -> tuple[Symbol, ...]:
    """Return the symbols of all data in the order of their indices.

    Parameters, boundary values and conditions at inner times come first, then the time and length of an interval. Last
    come numbers of its left node, which belong to conditions at inner times.
    """
    model, inner = program.model, program.inner
    prescribed = (*model.parameters, *(value.symbol for value in program.boundary_values), *inner.parameters)
    return (*prescribed, model.time, STEP, *inner.symbols)


def control_sensitivities(program: ControlProgram | StepProgram | PairwiseProgram) -> ControlSensitivities:
    """Return derivatives of all contributions to the Lagrangian with respect to data, and to unknowns and data."""
    assert isinstance(program, ControlProgram), "only optima have sensitivities"
    unknowns, data = program.element_symbols, data_of(program)
    shares = [_by_data(share.element, unknowns, data) for share in program.interval_elements]
    samples = [_by_data(s.element, unknowns, data) for s in (program.sample,) if s is not None]
    mixed = _with_one_pattern([share.mixed for share in (*shares, *samples)])
    return ControlSensitivities(
        elements=tuple(replace(share, mixed=entries) for share, entries in zip(shares, mixed, strict=False)),
        start=_end_by_data(program.start, (*program.left_symbols, *program.linking.symbols), data),
        end=_end_by_data(program.end, (*program.right_symbols, *program.linking.symbols), data),
        sample=next(iter(samples), None),
    )


def _end_by_data(end: EndElement, unknowns: Sequence[Symbol], data: Sequence[Symbol]) -> DataDerivatives:
    """Return an end's derivatives with respect to data, which include prescribed unknowns, numbered as in the node."""
    pinned = sorted({index for index, _ in end.pins})
    every = (*data, *(unknowns[index] for index in pinned))
    share = _by_data(end.element, unknowns, every, pinned)
    columns = [*range(len(data)), *(len(data) + index for index in pinned)]
    return replace(
        share,
        slopes=tuple((columns[i], value) for i, value in share.slopes),
        mixed=tuple((row, columns[i], value) for row, i, value in share.mixed),
    )


def _by_data(
    scalar: Expr, unknowns: Sequence[Symbol], data: Sequence[Symbol], fixed: Collection[int] = ()
) -> DataDerivatives:
    """Return a scalar's derivatives with respect to data, and to data and unknowns except at the `fixed` indices."""
    free = [index for index in range(len(unknowns)) if index not in fixed]
    if scalar.count_ops() >= LONG:
        second = mixed_derivatives(scalar, [unknowns[index] for index in free], data)
        values = second.program.values
        slopes = tuple(zip(second.slopes, values[: len(second.slopes)], strict=True))
        entries = zip(second.entries, values[len(second.slopes) :], strict=True)
        mixed = tuple((free[row], column, value) for (row, column), value in entries)
        return DataDerivatives(slopes, mixed, second.program.assignments)
    slopes = tuple((i, sympy.diff(scalar, datum)) for i, datum in enumerate(data) if scalar.has(datum))
    pairs = [
        (row, i, sympy.diff(slope, unknowns[row])) for i, slope in slopes for row in free if slope.has(unknowns[row])
    ]
    return DataDerivatives(
        tuple(pair for pair in slopes if not identically_zero(pair[1])),
        tuple(sorted((pair for pair in pairs if not identically_zero(pair[2])), key=lambda pair: pair[:2])),
    )


def general_form(
    model: Model | PairwiseModel, scheme: str | None, method: str | None, controls: str
) -> tuple[ControlProgram | StepProgram, ControlDerivatives | StepDerivatives]:
    """Return a problem discretised in the general form, and its derivatives; raise ArgumentError for particles."""
    if not isinstance(model, Model):
        raise ArgumentError("particles have no general form", "measure another problem")
    if model.task == "control" and not model.phases:
        idle = Symbol("idle", real=True)
        free = FreeParameter(idle, sympy.S.Zero, -sympy.S.One, sympy.S.One)
        cost = model.terminal_cost + idle**2 / 2
        model = replace(model, free_parameters=(*model.free_parameters, free), terminal_cost=cost)
    program = transcribe(model, scheme, method, controls)
    if isinstance(program, StepProgram):
        # Newton's method solves for inner stages and the right node; its initial guess is an explicit Euler step.
        unknowns = (*program.stage_symbols, *program.right_symbols)
        program = replace(
            program,
            before=(),
            unknowns=unknowns,
            guess=tuple(_explicit_guess(program, y) for y in unknowns),
            residual=tuple(equation for _, equation in program.equations),
            after=(),
            linear=False,
            velocities=(),
        )
        return program, step_derivatives(program)
    special = control_derivatives(program)
    elements = []
    for element in special.elements:
        values = {(row, column): value for row, column, value in element.hessian}
        indices = [(row, column) for row in range(len(element.unknowns)) for column in range(row + 1)]
        dense = tuple((*index, values.get(index, sympy.S.Zero)) for index in indices)
        elements.append(replace(element, hessian=dense))
    general = replace(
        special, elements=tuple(elements), condensed=len(program.slacks), stages=0, linear_quadratic=False, shooting=()
    )
    return program, general


def _explicit_guess(program: StepProgram, unknown: Symbol) -> Expr:
    """Return an initial guess of an unknown: an explicit Euler step to the right node, or half a step to a stage.

    Forces of constraints, and velocities at the right node, are zero.
    """
    left = program.left_symbols
    if program.constraints and unknown in program.stage_symbols:
        return sympy.S.Zero
    rates = rates_of_change(legendre.hamiltonian_form(program.model), left)
    stage = re.search(r"_stage\d+$", unknown.name)
    name = unknown.name[: stage.start()] if stage else unknown.name.removesuffix("_k1")
    index = [y.name for y in left].index(f"{name}_k")
    length = sum(program.lengths) if program.fractions else STEP
    return left[index] + (length / 2 if stage else length) * rates[index]
