"""Program -> first and second derivatives, their exact sparsity, and what is provably constant.

Derivatives of the Lagrangian's shares by data, which sensitivities of a solution need, and mixed ones with unknowns.

Data are what is given when a problem is solved: parameters, boundary values, conditions at inner times, and where an
interval is in time.

The general form of a module: nothing is left out that the problem does not need, to measure what leaving out saves.
This is for measurements only, and no command offers it. A general step keeps all its unknowns for Newton's method,
though some of them, or all, could be had explicitly, or by one linear solve. A general optimal-control problem has one
free parameter more, which nothing reads, which is bounded, and whose square is part of the cost: it is zero at the
optimum, and it wants the interior point method, the border of the linear system and curved ends. Its controls stay in
the linear system, and zeros of the Hessian are stored and factored like other entries.

What symbolic derivation cannot but leave out, such as derivatives by cyclic coordinates and absent forces, stays out.
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
from codegen.symbolic.derivatives import jacobian as differentiated
from codegen.symbolic.derivatives import mixed_derivatives, second_derivatives
from codegen.symbolic.graph import Assignment
from codegen.symbolic.zeros import identically_zero

Entry = tuple[int, int, Expr]
"""Row, column and value of a structurally nonzero derivative."""


LONG = 200
"""Operations from which on a scalar is differentiated on its graph; shorter ones read better from plain derivatives."""
_LONG_STEP = 1000
"""The same for all equations of a step together."""


@dataclass(frozen=True)
class ElementDerivatives:
    """Gradient (dense) and Hessian (lower triangle, structural nonzeros) of a scalar in its local unknowns, and a cost.

    Those of a long scalar are straight-line programs: gradient and cost may read the symbols of one list of
    assignments, the Hessian those of the other. An entry that does not depend on unknowns reads no such symbol.
    """

    unknowns: tuple[Symbol, ...]
    gradient: tuple[Expr, ...]
    hessian: tuple[Entry, ...]
    cost: Expr = sympy.S.Zero
    gradient_assignments: tuple[Assignment, ...] = ()
    hessian_assignments: tuple[Assignment, ...] = ()

    @property
    def varying(self) -> set[Symbol]:
        """The symbols by which an entry of the Hessian depends on unknowns."""
        return {*self.unknowns, *(symbol for symbol, _ in self.hessian_assignments)}


@dataclass(frozen=True)
class ControlDerivatives:
    """Everything that the structured Newton method of a control problem needs.

    `condensed` is how many of an interval's last unknowns can be eliminated inside it: slacks always, because their
    barrier terms are positive, and controls when their block of the Hessian is constant and regular and there are no
    stages; `stages` is how many of its first unknowns are determined by the equations whose multipliers come next;
    `linear_quadratic` says that no Hessian entry depends on an unknown and one Newton step suffices (not so with nodal
    controls, which can make the system singular). `elements` are the shares of all kinds of intervals, of which there
    are several where there are phases; their Hessians have one pattern. That of a `sample` of measurements is a part of
    it.
    """

    elements: tuple[ElementDerivatives, ...]
    start: ElementDerivatives
    end: ElementDerivatives
    condensed: int
    stages: int
    linear_quadratic: bool
    sample: ElementDerivatives | None = None

    @property
    def element(self) -> ElementDerivatives:
        """The first of them, which is the only one where there are no phases."""
        return self.elements[0]


@dataclass(frozen=True)
class StepDerivatives:
    """Residual of an implicit step and its Jacobian (dense, row by row); empty for an explicit one.

    `constant` says that the Jacobian depends on parameters and the step's length only, so that it can be factored once.
    Those of a long residual are straight-line programs, and may read the symbols of `assignments`.
    """

    residual: tuple[Expr, ...]
    jacobian: tuple[tuple[Expr, ...], ...]
    constant: bool
    assignments: tuple[Assignment, ...] = ()


def control_derivatives(program: ControlProgram) -> ControlDerivatives:
    """Differentiate the interval's scalar and both end elements twice."""
    unknowns = program.element_symbols
    samples = [_element(s.element, unknowns, s.element) for s in (program.sample,) if s is not None]
    own = [_element(e.element, unknowns, e.cost) for e in program.interval_elements]
    elements = _with_one_pattern([*own, *samples])[: len(own)]
    start = _end_element(program.start, (*program.left_symbols, *program.shared_symbols))
    end = _end_element(program.end, (*program.right_symbols, *program.shared_symbols))
    shares = (*elements, *samples, start, end)
    stages = _stages(program, elements[0])
    variables = set[Symbol]().union(*(share.varying for share in shares))
    entries = [entry for share in shares for entry in share.hessian]
    return ControlDerivatives(
        elements=elements,
        start=start,
        end=end,
        condensed=len(program.slacks) if stages else _condensed(program, elements, samples),
        stages=stages,
        linear_quadratic=not program.nodal_controls
        and not program.has_inequalities
        and not program.couplings
        and not any(value.free_symbols & variables for _, _, value in entries),
        sample=next(iter(samples), None),
    )


def step_derivatives(program: StepProgram) -> StepDerivatives:
    """Differentiate the residual of a step by its unknowns, on which the assignments before it do not depend."""
    fixed = {*program.model.parameters, STEP}
    residual, assignments = program.residual, tuple[Assignment, ...]()
    if sum(int(r.count_ops()) for r in residual) < _LONG_STEP:
        jacobian = tuple(tuple(_tidy_derivative(r, y) for y in program.unknowns) for r in residual)
    else:
        found, indices = differentiated(residual, program.unknowns, fixed)
        residual, assignments = found.values[: len(residual)], found.assignments
        entries = dict(zip(indices, found.values[len(residual) :], strict=True))
        count = range(len(program.unknowns))
        jacobian = tuple(tuple(entries.get((i, j), sympy.S.Zero) for j in count) for i in range(len(residual)))
    constant = all(entry.free_symbols <= fixed for row in jacobian for entry in row)
    return StepDerivatives(residual, jacobian, constant, assignments)


def _tidy_derivative(expression: Expr, symbol: Symbol) -> Expr:
    """A derivative, written as zero where it is one."""
    derivative = sympy.diff(expression, symbol)
    return sympy.S.Zero if identically_zero(derivative) else derivative


def _element(scalar: Expr, unknowns: Sequence[Symbol], cost: Expr, given: Collection[int] = ()) -> ElementDerivatives:
    """Derivatives by the unknowns; those at the `given` indices are numbers, and nobody asks for their derivatives."""
    if scalar.count_ops() >= LONG:
        return _long_element(scalar, unknowns, cost, given)
    gradient = tuple(sympy.S.Zero if i in given else sympy.diff(scalar, x) for i, x in enumerate(unknowns))
    hessian: list[Entry] = []
    for row, first in enumerate(gradient):
        present = first.free_symbols
        for column, x in enumerate(unknowns[: row + 1]):
            if x not in present or column in given:
                continue
            second = sympy.diff(first, x)
            if not identically_zero(second):
                hessian.append((row, column, second))
    return ElementDerivatives(tuple(unknowns), gradient, tuple(hessian), cost)


def _long_element(scalar: Expr, unknowns: Sequence[Symbol], cost: Expr, given: Collection[int]) -> ElementDerivatives:
    free = [index for index in range(len(unknowns)) if index not in given]
    found = second_derivatives(scalar, [unknowns[index] for index in free], (cost,))
    *slopes, written_cost = found.gradient.values
    gradient = dict(zip(free, slopes, strict=True))
    entries = zip(found.indices, found.hessian.values, strict=True)
    return ElementDerivatives(
        unknowns=tuple(unknowns),
        gradient=tuple(gradient.get(index, sympy.S.Zero) for index in range(len(unknowns))),
        hessian=tuple((free[row], free[column], value) for (row, column), value in entries),
        cost=written_cost,
        gradient_assignments=found.gradient.assignments,
        hessian_assignments=found.hessian.assignments,
    )


def _with_one_pattern(shares: Sequence[ElementDerivatives]) -> tuple[ElementDerivatives, ...]:
    """The same derivatives, with zeros where another share has an entry of the Hessian."""
    if len(shares) == 1:
        return tuple(shares)
    pattern = sorted({(row, column) for share in shares for row, column, _ in share.hessian})
    values = [{(row, column): value for row, column, value in share.hessian} for share in shares]
    return tuple(
        replace(share, hessian=tuple((*index, own.get(index, sympy.S.Zero)) for index in pattern))
        for share, own in zip(shares, values, strict=True)
    )


def _end_element(end: EndElement, unknowns: tuple[Symbol, ...]) -> ElementDerivatives:
    """Derivatives of an end's share; what is pinned there is a number and not differentiated twice."""
    return _element(end.element, unknowns, end.cost, {i for i, _ in end.pins})


def _condensed(
    program: ControlProgram, elements: Sequence[ElementDerivatives], samples: Sequence[ElementDerivatives]
) -> int:
    slacks = len(program.slacks)
    if any(_curves_controls(program, sample) for sample in samples):
        return slacks
    if all(_constant_and_regular(program, element, element.varying) for element in elements):
        return slacks + len(program.control_symbols)
    return slacks


def _stages(program: ControlProgram, element: ElementDerivatives) -> int:
    """The number of stages that can be eliminated by their equations.

    Zero if some intervals lack stages, as in phases with states of their own. Zero if the Hessian has entries between
    stages and slacks, or between the equations of stages and other multipliers, as in modules with all entries.
    """
    multipliers = [unknown.multiplier for unknown in program.interval]
    count = multipliers.index(True) if True in multipliers else 0
    lacking = {*program.inner.lacking, *(index for part in program.interval_elements for index in part.lacking)}
    if lacking & {*range(2 * count)} or len(multipliers) < 2 * count or not all(multipliers[count : 2 * count]):
        return 0
    kinds = [*program.node, *program.interval, *program.controls, *program.slacks, *program.node, *program.shared]
    duals = {index for index, unknown in enumerate(kinds) if unknown.multiplier}
    first = len(program.node)
    equations, after = {*range(first + count, first + 2 * count)}, first + len(program.interval) + len(program.controls)
    staged, slacks = {*range(first, first + 2 * count)}, {*range(after, after + len(program.slacks))}
    for row, column, _ in element.hessian:
        for one, other in ((row, column), (column, row)):
            if (one in equations and other in duals) or (one in staged and other in slacks):
                return 0
    return count


def _curves_controls(program: ControlProgram, sample: ElementDerivatives) -> bool:
    """Whether a share has second derivatives by controls alone, which not all intervals have then."""
    first = len(program.left_symbols) + len(program.interval_symbols)
    controls = range(first, first + len(program.control_symbols))
    return any(row in controls and column in controls for row, column, _ in sample.hessian)


def _constant_and_regular(program: ControlProgram, element: ElementDerivatives, unknowns: set[Symbol]) -> bool:
    size = len(program.control_symbols)
    if size == 0:
        return False
    first = len(program.left_symbols) + len(program.interval_symbols)
    block = sympy.zeros(size, size)
    for row, column, value in element.hessian:
        if first <= row < first + size and first <= column < first + size:
            if value.free_symbols & (unknowns | {program.model.time}):
                return False
            block[row - first, column - first] = block[column - first, row - first] = value
    points = expressions.sample_points(block.free_symbols, {}, {})
    return expressions.null_direction(expressions.values_at(block, point) for point in points) is None


def derivatives(
    program: ControlProgram | StepProgram | PairwiseProgram,
) -> ControlDerivatives | StepDerivatives | PairDerivatives:
    """The derivatives that the solver of a program needs."""
    if isinstance(program, PairwiseProgram):
        return pair_derivatives(program.model)
    return control_derivatives(program) if isinstance(program, ControlProgram) else step_derivatives(program)


@dataclass(frozen=True)
class DataDerivatives:
    """First derivatives of a scalar by data (index, value), and second ones by an unknown and a datum (both indices).

    Only what is not identically zero is there; all may read the symbols of one list of assignments.
    """

    slopes: tuple[tuple[int, Expr], ...]
    mixed: tuple[Entry, ...]
    assignments: tuple[Assignment, ...] = ()


@dataclass(frozen=True)
class ControlSensitivities:
    """Derivatives by data of the shares of all kinds of intervals, whose mixed ones have one pattern, and of both ends.

    That of a `sample` of measurements is a part of the pattern.
    """

    elements: tuple[DataDerivatives, ...]
    start: DataDerivatives
    end: DataDerivatives
    sample: DataDerivatives | None = None


def require_sensitive(model: Model | PairwiseModel) -> None:
    """ArgumentError for a problem whose solutions have no sensitivities: samples lie at times, not in parts of any."""
    if model.task != "control":
        raise ArgumentError(f"a problem to {model.task} has no sensitivities", "leave them out: only optima have them")
    assert isinstance(model, Model), "particles are no optimisation"
    parts = model.phases or (model,)
    times = [part.duration for part in parts] + [
        i.time for part in parts for i in part.inner_times if i.time is not None
    ]
    if any(part.measurements for part in parts) and any(time.free_symbols & {*model.parameters} for time in times):
        finding = "sensitivities of measurements need times that follow no parameters"
        raise ArgumentError(finding, "give the duration and inner times as numbers, or leave sensitivities out")


def data_of(program: ControlProgram) -> tuple[Symbol, ...]:
    """Data in their order: what stands among the parameters, time and length of an interval, numbers of its left node.

    The numbers are those of conditions at inner times.
    """
    model, inner = program.model, program.inner
    given = (*model.parameters, *(value.symbol for value in program.boundary_values), *inner.parameters)
    return (*given, model.time, STEP, *inner.symbols)


def control_sensitivities(program: ControlProgram | StepProgram | PairwiseProgram) -> ControlSensitivities:
    """Differentiate the shares of intervals, samples and ends by data, and by unknowns and data."""
    assert isinstance(program, ControlProgram), "sensitivities are those of an optimisation"
    unknowns, data = program.element_symbols, data_of(program)
    own = [_derivatives(share.element, unknowns, data) for share in program.interval_elements]
    samples = [_derivatives(s.element, unknowns, data) for s in (program.sample,) if s is not None]
    return ControlSensitivities(
        elements=tuple(_with_one_mixed_pattern([*own, *samples])[: len(own)]),
        start=_of_end(program.start, (*program.left_symbols, *program.shared_symbols), data),
        end=_of_end(program.end, (*program.right_symbols, *program.shared_symbols), data),
        sample=next(iter(samples), None),
    )


def _of_end(end: EndElement, unknowns: Sequence[Symbol], data: Sequence[Symbol]) -> DataDerivatives:
    """Those of an end's share, where what is pinned counts as data behind all others, by its index in the node."""
    pinned = sorted({index for index, _ in end.pins})
    every = (*data, *(unknowns[index] for index in pinned))
    found = _derivatives(end.element, unknowns, every, pinned)
    places = [*range(len(data)), *(len(data) + index for index in pinned)]
    return replace(
        found,
        slopes=tuple((places[i], value) for i, value in found.slopes),
        mixed=tuple((row, places[column], value) for row, column, value in found.mixed),
    )


def _derivatives(
    scalar: Expr, unknowns: Sequence[Symbol], data: Sequence[Symbol], given: Collection[int] = ()
) -> DataDerivatives:
    free = [index for index in range(len(unknowns)) if index not in given]
    if scalar.count_ops() >= LONG:
        found = mixed_derivatives(scalar, [unknowns[index] for index in free], data)
        values = found.program.values
        slopes = tuple(zip(found.slopes, values[: len(found.slopes)], strict=True))
        entries = zip(found.entries, values[len(found.slopes) :], strict=True)
        mixed = tuple((free[row], column, value) for (row, column), value in entries)
        return DataDerivatives(slopes, mixed, found.program.assignments)
    slopes = tuple((i, sympy.diff(scalar, datum)) for i, datum in enumerate(data) if scalar.has(datum))
    pairs = [
        (row, i, sympy.diff(slope, unknowns[row])) for i, slope in slopes for row in free if slope.has(unknowns[row])
    ]
    return DataDerivatives(
        tuple(pair for pair in slopes if not identically_zero(pair[1])),
        tuple(sorted((pair for pair in pairs if not identically_zero(pair[2])), key=lambda pair: pair[:2])),
    )


def _with_one_mixed_pattern(shares: Sequence[DataDerivatives]) -> list[DataDerivatives]:
    """The same derivatives, with zeros where another share has a mixed one."""
    pattern = sorted({(row, column) for share in shares for row, column, _ in share.mixed})
    values = [{(row, column): value for row, column, value in share.mixed} for share in shares]
    return [
        replace(share, mixed=tuple((*pair, own.get(pair, sympy.S.Zero)) for pair in pattern))
        for share, own in zip(shares, values, strict=True)
    ]


IDLE = "idle"
"""The name of the free parameter that nothing reads."""


def general_form(
    model: Model | PairwiseModel, scheme: str | None, method: str | None, controls: str
) -> tuple[ControlProgram | StepProgram, ControlDerivatives | StepDerivatives]:
    """The program of a problem and its derivatives; ArgumentError for particles, which have no such form."""
    if not isinstance(model, Model):
        raise ArgumentError("particles have no general form", "measure another problem")
    program = transcribe(general_model(model), scheme, method, controls)
    if isinstance(program, ControlProgram):
        return program, general_derivatives(program, control_derivatives(program))
    # A step whose inner stages and right node are all unknowns of Newton's method, which starts from the left node.
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


def general_model(model: Model) -> Model:
    """An optimal-control problem with an idle free parameter; another problem, or one of several phases, as it is."""
    if model.task != "control" or model.phases:
        return model
    idle = Symbol(IDLE, real=True)
    free = FreeParameter(idle, sympy.S.Zero, -sympy.S.One, sympy.S.One)
    return replace(
        model, free_parameters=(*model.free_parameters, free), terminal_cost=model.terminal_cost + idle**2 / 2
    )


def _explicit_guess(program: StepProgram, unknown: Symbol) -> Expr:
    """An explicit Euler step to a right node, half of one to an inner stage."""
    left = program.left_symbols
    rates = rates_of_change(legendre.hamiltonian_form(program.model), left)
    stage = re.search(r"_stage\d+$", unknown.name)
    name = unknown.name[: stage.start()] if stage else unknown.name.removesuffix("_k1")
    index = [y.name for y in left].index(f"{name}_k")
    length = sum(program.lengths) if program.fractions else STEP
    return left[index] + (length / 2 if stage else length) * rates[index]


def general_derivatives(program: ControlProgram, derivatives: ControlDerivatives) -> ControlDerivatives:
    """Every entry of the Hessian, also those that are zero; only slacks are eliminated inside their interval."""
    return replace(
        derivatives,
        elements=tuple(_dense(element) for element in derivatives.elements),
        condensed=len(program.slacks),
        stages=0,
        linear_quadratic=False,
    )


def _dense(element: ElementDerivatives) -> ElementDerivatives:
    values = {(row, column): value for row, column, value in element.hessian}
    indices = [(row, column) for row in range(len(element.unknowns)) for column in range(row + 1)]
    return replace(element, hessian=tuple((*index, values.get(index, sympy.S.Zero)) for index in indices))
