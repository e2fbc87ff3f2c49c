"""The general form of a module: nothing is left out that the problem does not need, to measure what leaving out saves.

This is for measurements only, and no command offers it. A general step keeps all its unknowns for Newton's method,
though some of them, or all, could be had explicitly, or by one linear solve. A general optimal-control problem has one
free parameter more, which nothing reads, which is bounded, and whose square is part of the cost: it is zero at the
optimum, and it wants the interior point method, the border of the linear system and curved ends. Its controls stay in
the linear system, and zeros of the Hessian are stored and factored like other entries.

What symbolic derivation cannot but leave out, such as derivatives by cyclic coordinates and absent forces, stays out.
"""

from __future__ import annotations

import re
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from codegen.derive import (
    ControlDerivatives,
    ElementDerivatives,
    StepDerivatives,
    control_derivatives,
    step_derivatives,
)
from codegen.discretise import STEP
from codegen.errors import ArgumentError
from codegen.model import Model, legendre
from codegen.model.definitions import FreeParameter
from codegen.model.pairwise import PairwiseModel
from codegen.transcribe import transcribe
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.simulation.simulate import rates_of_change
from codegen.transcribe.step_program import StepProgram

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
        linear_quadratic=False,
    )


def _dense(element: ElementDerivatives) -> ElementDerivatives:
    values = {(row, column): value for row, column, value in element.hessian}
    indices = [(row, column) for row in range(len(element.unknowns)) for column in range(row + 1)]
    return replace(element, hessian=tuple((*index, values.get(index, sympy.S.Zero)) for index in indices))
