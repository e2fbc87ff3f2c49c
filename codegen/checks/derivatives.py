"""Every emitted kernel against the expression that it stands for, differentiated independently, at random points.

The references are differences in 120-digit arithmetic of the undifferentiated expression, and for the gradient also
complex steps (Squire and Trapp, 1998) of a plain numpy evaluation where the expression is analytic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mpmath  # type: ignore[import-untyped]
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import DIGITS, Point, function_of, gradient, hessian, random_points
from codegen.discretise import STEP
from codegen.transcribe.program import ControlProgram, EndElement, StepProgram

TOLERANCE = 1e-10
_ROUNDING = 1e-13
_COMPLEX_STEP = 1e-30
_NOT_ANALYTIC = (sympy.Abs, sympy.sign, sympy.Min, sympy.Max, sympy.Piecewise, sympy.Heaviside, sympy.atan2)


def check(context: Context) -> Iterator[Finding]:
    """Compare all kernels of the module with what was derived."""
    if isinstance(context.program, ControlProgram):
        yield from _interval(context, context.program)
        yield from _end(context, context.program, "start", context.program.start, context.program.left_symbols)
        yield from _end(context, context.program, "end", context.program.end, context.program.right_symbols)
    else:
        yield from _step(context, context.program)


@dataclass
class _Worst:
    """The largest relative error seen so far, and the name of its entry."""

    error: float = 0.0
    name: str = ""
    entries: int = 0

    def compare(self, names: Sequence[str], emitted: Any, exact: Sequence[Any]) -> None:
        """Errors count relative to the entry, above the rounding of the largest entry beside it."""
        assert len(names) == len(emitted) == len(exact)
        largest = max((abs(value) for value in exact), default=0)
        self.entries += len(names)
        for name, value, wanted in zip(names, emitted, exact, strict=True):
            excess = abs(mpmath.mpf(float(value)) - wanted) - _ROUNDING * largest
            error = float(excess / abs(wanted)) if wanted else float(excess > 0) * float("inf") if excess > 0 else 0.0
            if not error <= self.error:
                self.error, self.name = error if error == error else float("inf"), name

    def finding(self, subject: str, against: str) -> Finding:
        passed = self.error <= TOLERANCE
        detail = f"{self.entries} values agree with {against} to {TOLERANCE:g}"
        if not passed:
            detail = f"{self.name} differs from {against} by {self.error:.2g} of its value"
        return Finding("derivatives", subject, passed, detail)


def control_symbols(program: ControlProgram) -> tuple[list[Symbol], list[Symbol]]:
    """The unknowns of an interval, and the entries of the vector of parameters."""
    unknowns = [*program.left_symbols, *program.interval_symbols, *program.control_symbols, *program.right_symbols]
    return unknowns, [*program.model.parameters, *(value.symbol for value in program.boundary_values)]


def _interval(context: Context, program: ControlProgram) -> Iterator[Finding]:
    unknowns, parameters = control_symbols(program)
    symbols = [*unknowns, *parameters, program.model.time, STEP]
    scalar, places = function_of(symbols, [program.element]), range(len(unknowns))
    cost = function_of(symbols, [program.cost])
    first, second, steps, analytic = _Worst(), _Worst(), _Worst(), not program.element.has(*_NOT_ANALYTIC)
    module = context.module
    rows, columns = list(module.HESSIAN_ROWS), list(module.HESSIAN_COLUMNS)
    gradient_names = [f"dl/d{x}" for x in unknowns]
    for point in random_points([program.element, program.cost], symbols, program.model.default_values):
        numbers = [point[symbol] for symbol in symbols]
        arrays = _arrays(point, unknowns, parameters, program.model.time)
        alone, beside, entries = np.empty(len(unknowns)), np.empty(len(unknowns)), np.empty(len(rows))
        costs = [module.interval_gradient(*arrays, alone), module.interval_hessian(*arrays, beside, entries)]
        with mpmath.workdps(DIGITS):
            exact = gradient(scalar, numbers, places)
            for values in (alone, beside):
                first.compare(gradient_names, values, exact)
            first.compare(["Cd", "Cd beside the Hessian"], costs, cost(*map(mpmath.mpf, numbers)) * 2)
            full = hessian(scalar, numbers, places)
            wanted = [full[max(r, c)][min(r, c)] for r, c in zip(rows, columns, strict=True)]
            second.compare([f"d2l/d{unknowns[r]} d{unknowns[c]}" for r, c in zip(rows, columns)], entries, wanted)
        if analytic:
            steps.compare(gradient_names, alone, _complex_steps(program.element, symbols, numbers, len(unknowns)))
    yield first.finding("interval_gradient", "120-digit differences of l")
    if analytic:
        yield steps.finding("interval_gradient", "complex steps of l")
    yield second.finding("interval_hessian", "120-digit second differences of l")


def _complex_steps(scalar: Expr, symbols: Sequence[Symbol], numbers: Sequence[float], count: int) -> list[Any]:
    function = sympy.lambdify(list(symbols), scalar, modules="numpy")
    results = []
    for i in range(count):
        shifted = [complex(number) for number in numbers]
        shifted[i] += 1j * _COMPLEX_STEP
        results.append(mpmath.mpf(float(np.imag(function(*shifted))) / _COMPLEX_STEP))
    return results


def _arrays(
    point: Point, unknowns: Sequence[Symbol], parameters: Sequence[Symbol], instant: Symbol
) -> tuple[Any, float, float, Any]:
    """The arguments of an interval kernel."""
    vectors = [np.array([point[symbol] for symbol in group]) for group in (unknowns, parameters)]
    return vectors[0], point[instant], point[STEP], vectors[1]


def _end(
    context: Context, program: ControlProgram, name: str, end: EndElement, unknowns: Sequence[Symbol]
) -> Iterator[Finding]:
    """The end's own share of the Lagrangian; entries of pinned unknowns are not emitted."""
    _, parameters = control_symbols(program)
    symbols = [*unknowns, *parameters, program.model.time]
    scalar, places = function_of(symbols, [end.element]), range(len(unknowns))
    pinned = {i for i, _ in end.pins}
    free = [i for i in places if i not in pinned]
    module, first, second = context.module, _Worst(), _Worst()
    pattern = _end_pattern(module, name)
    for point in random_points([end.element], symbols, program.model.default_values):
        numbers = [point[symbol] for symbol in symbols]
        nodes, values = np.array(numbers[: len(unknowns)]), np.array(numbers[len(unknowns) : -1])
        emitted = np.zeros(len(unknowns))
        getattr(module, f"{name}_gradient")(nodes, numbers[-1], values, emitted)
        with mpmath.workdps(DIGITS):
            exact = gradient(scalar, numbers, places)
            first.compare([f"by {unknowns[i]}" for i in free], emitted[free], [exact[i] for i in free])
            full = hessian(scalar, numbers, free)
            pairs = [(r, c, full[r][c]) for r in range(len(free)) for c in range(r + 1)]
            entries = np.zeros(len(pattern))
            if pattern:
                getattr(module, f"{name}_hessian")(nodes, numbers[-1], values, entries)
            stored = dict(zip(pattern, entries, strict=True))
            names = [f"by {unknowns[free[r]]}, {unknowns[free[c]]}" for r, c, _ in pairs]
            second.compare(names, [stored.get((free[r], free[c]), 0.0) for r, c, _ in pairs], [e for *_, e in pairs])
    yield first.finding(f"{name}_gradient", "120-digit differences")
    if pattern or second.error > TOLERANCE:
        yield second.finding(f"{name}_hessian", "120-digit second differences")


def _end_pattern(module: Any, name: str) -> list[tuple[int, int]]:
    rows = getattr(module, f"{name.upper()}_HESSIAN_ROWS", ())
    columns = getattr(module, f"{name.upper()}_HESSIAN_COLUMNS", ())
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def _step(context: Context, program: StepProgram) -> Iterator[Finding]:
    """The scheme's equations and the energy as written; the elimination by the equations that a step makes vanish."""
    interval = [*program.stage_symbols, *program.right_symbols]
    base = [*program.left_symbols, program.model.time, STEP, *program.model.parameters]
    equations = function_of([*base, *interval], [value for _, value in program.equations])
    energy = function_of(base, [program.energy])
    written, closed, height = _Worst(), _Worst(), _Worst()
    names = [name for name, _ in program.equations]
    module, size = context.module, len(interval)
    for point in random_points([v for _, v in program.equations], [*base, *interval], program.model.default_values):
        arguments = _step_arguments(point, program)
        after = np.array([point[symbol] for symbol in interval])
        emitted = np.empty(size)
        module.step_equations(arguments[0], after, *arguments[1:], emitted)
        numbers = [mpmath.mpf(point[symbol]) for symbol in base]
        with mpmath.workdps(DIGITS):
            written.compare(names, emitted, equations(*numbers, *map(mpmath.mpf, after)))
            height.compare(["H"], [module.energy(arguments[0], *_time_and_parameters(arguments))], energy(*numbers))
            made = np.empty(size)
            work = module.allocate_work(arguments[2], arguments[3])
            outcome = module.advance(*arguments, work, made, 1e-14, 50)
            left_over = equations(*numbers, *map(mpmath.mpf, made)) if outcome >= 0 else [mpmath.inf] * size
            # One is added on both sides, so that what must vanish is measured on the scale of the state.
            closed.compare(
                [f"{name} after a step" for name in names], [1 + r for r in left_over], [mpmath.mpf(1)] * size
            )
    yield written.finding("step_equations", "the scheme's equations")
    yield height.finding("energy", "the Hamiltonian")
    yield closed.finding("one step", "the scheme's equations")
    if program.unknowns:
        yield from _implicit(context, program)


def _implicit(context: Context, program: StepProgram) -> Iterator[Finding]:
    base = [*program.left_symbols, program.model.time, STEP, *program.model.parameters]
    symbols = [*program.unknowns, *base]
    residual = [_expanded(value, program.before) for value in program.residual]
    functions, size = [function_of(symbols, [value]) for value in residual], len(program.unknowns)
    values_seen, entries_seen = _Worst(), _Worst()
    for point in random_points(residual, symbols, program.model.default_values):
        numbers = [point[symbol] for symbol in symbols]
        unknowns, arguments = np.array(numbers[:size]), _step_arguments(point, program)
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


def _expanded(value: Expr, assignments: Sequence[tuple[Symbol, Expr]]) -> Expr:
    for symbol, meaning in reversed(assignments):
        value = value.xreplace({symbol: meaning})
    return value


def _step_arguments(point: Point, program: StepProgram) -> tuple[Any, float, float, Any]:
    state = np.array([point[symbol] for symbol in program.left_symbols])
    parameters = np.array([point[symbol] for symbol in program.model.parameters])
    return state, point[program.model.time], point[STEP], parameters


def _time_and_parameters(arguments: tuple[Any, float, float, Any]) -> tuple[float, Any]:
    return arguments[1], arguments[3]
