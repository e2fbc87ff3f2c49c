"""Derivatives of the Lagrangian's shares by data, which sensitivities of a solution need, and mixed ones with unknowns.

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

from codegen.derive import (
    LONG,
    ControlDerivatives,
    ElementDerivatives,
    Entry,
    StepDerivatives,
    control_derivatives,
    step_derivatives,
)
from codegen.discretise import STEP
from codegen.errors import ArgumentError
from codegen.expressions import Assignment, mixed_derivatives
from codegen.expressions.zeros import identically_zero
from codegen.model import Model, legendre
from codegen.model.definitions import FreeParameter
from codegen.model.pairwise import PairwiseModel
from codegen.tasks import TASKS
from codegen.transcribe import transcribe
from codegen.transcribe.connect import PairwiseProgram
from codegen.transcribe.program import ControlProgram, EndElement
from codegen.transcribe.simulation.simulate import rates_of_change
from codegen.transcribe.step_program import StepProgram


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
        noun = TASKS[model.task].noun
        raise ArgumentError(f"sensitivities are those of an optimisation, not of {noun}", "leave them out")
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
        elements=tuple(_with_one_pattern([*own, *samples])[: len(own)]),
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


def _with_one_pattern(shares: Sequence[DataDerivatives]) -> list[DataDerivatives]:
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
