"""The kernels of a simulation against the scheme's equations, at random points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import mpmath
import numpy as np

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import DIGITS, Function, Point, function_of, gradient, random_points
from codegen.checks.module.agreement import Agreement
from codegen.expressions.table_functions import numbers_of
from codegen.runtime.stepping.steps import part_of_step
from codegen.transcribe.step_program import StepProgram

_SHORTER = (1.0, 0.1, 0.01, 1e-3)
"""Parts of a step's length that are tried in turn."""


def check_step(context: Context, program: StepProgram) -> Iterator[Finding]:
    """The scheme's equations and the energy as written; the elimination by the equations that a step makes vanish."""
    interval = [*program.stage_symbols, *program.right_symbols]
    base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
    equations = function_of([*base, *interval], [value for _, value in program.equations])
    energy = function_of(base, [program.energy], program.state_assignments)
    written, height = Agreement(), Agreement()
    names = [name for name, _ in program.equations]
    module, size = context.module, len(interval)
    points = random_points([v for _, v in program.equations], [*base, *interval], program.model)
    for point in points:
        arguments = _step_arguments(point, program)
        after = np.array([point[symbol] for symbol in interval], dtype=float)
        emitted = np.empty(size)
        module.step_equations(arguments[0], after, *arguments[1:], emitted)
        numbers = [mpmath.mpf(point[symbol]) for symbol in base]
        with mpmath.workdps(DIGITS):
            written.compare(names, emitted, equations(*numbers, *map(mpmath.mpf, after)))
            height.compare(["H"], [module.energy(arguments[0], arguments[1], arguments[3])], energy(*numbers))
    yield written.finding("step_equations", "the scheme's equations")
    yield height.finding("energy", "the Hamiltonian")
    yield _closed(context, program, points, equations)
    if program.unknowns:
        yield from _implicit(context, program)


def _closed(context: Context, program: StepProgram, points: Sequence[Point], equations: Function) -> Finding:
    """The equations after a step of the module."""
    names, found = [f"{name} after a step" for name, _ in program.equations], Agreement()
    for point in points:
        left_over = _after_a_step(context, program, point, equations) or [mpmath.inf] * len(names)
        # One is added on both sides, so that what must vanish is measured on the scale of the state.
        with mpmath.workdps(DIGITS):
            found.compare(names, [1 + r for r in left_over], [mpmath.mpf(1)] * len(names))
    return found.finding("one step", "the scheme's equations")


def _after_a_step(context: Context, program: StepProgram, point: Point, equations: Function) -> list[Any] | None:
    """What is left over of the equations, in parts of the largest value of the step, or of one if that is more.

    Nothing where the module makes no step, however short. A long step may have no solution, as where bodies happen to
    lie beside each other; a short one has.
    """
    module, made = context.module, np.empty(len(program.equations))
    for shorter in _SHORTER:
        shortened = {**point, **{h: shorter * point[h] for h in program.lengths}}
        arguments = _step_arguments(shortened, program)
        if part_of_step(module.problem.scheme, *arguments, 1e-14, 50, made) >= 0:
            base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
            scale = max(1.0, np.abs(arguments[0]).max(), np.abs(made).max())
            with mpmath.workdps(DIGITS):
                left_over = equations(*(mpmath.mpf(shortened[symbol]) for symbol in base), *map(mpmath.mpf, made))
                return [value / mpmath.mpf(scale) for value in left_over]
    return None


def _implicit(context: Context, program: StepProgram) -> Iterator[Finding]:
    base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
    symbols = [*program.unknowns, *base]
    functions = [function_of(symbols, [value], program.before) for value in program.residual]
    size = len(program.unknowns)
    values_seen, entries_seen = Agreement(), Agreement()
    for point in random_points(program.residual, symbols, program.model, assignments=program.before):
        numbers = [point[symbol] for symbol in symbols]
        unknowns, arguments = np.array(numbers[:size], dtype=float), _step_arguments(point, program)
        alone, beside, matrix = np.empty(size), np.empty(size), np.empty((size, size))
        context.module.step_residual(unknowns, *arguments, alone)
        context.module.step_jacobian(unknowns, *arguments, beside, matrix)
        with mpmath.workdps(DIGITS):
            for i, function in enumerate(functions):
                exact = function(*map(mpmath.mpf, numbers)) * 2
                values_seen.compare([f"residual {i}"] * 2, [alone[i], beside[i]], exact)
                names = [f"d residual {i}/d{y}" for y in program.unknowns]
                entries_seen.compare(names, matrix[i], gradient(function, numbers, range(size)))
    yield values_seen.finding("step_residual", "the reduced equations")
    yield entries_seen.finding("step_jacobian", "120-digit differences of the residual")


def _step_arguments(point: Point, program: StepProgram) -> tuple[Any, float, Any, Any]:
    state = np.array([point[symbol] for symbol in program.left_symbols], dtype=float)
    numbers = numbers_of(program.model)
    parameters = np.array([*(point[symbol] for symbol in program.model.parameters), *numbers], dtype=float)
    return state, point[program.model.time], step_lengths(point, program), parameters


def step_lengths(point: Point, program: StepProgram) -> Any:
    """The lengths that a kernel takes: several where a composition has them, else that of the step."""
    return np.array([point[h] for h in program.lengths], dtype=float)
