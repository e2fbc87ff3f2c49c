"""Every emitted kernel against the expression that it stands for, differentiated independently, at random points.

The references are differences in 120-digit arithmetic of the undifferentiated expression, and for the gradient also
complex steps (Squire and Trapp, 1998) of a plain numpy evaluation where the expression is analytic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import (
    DIGITS,
    curved_beyond,
    function_of,
    gradient,
    random_points,
    second_differences,
)
from codegen.checks.module.agreement import TOLERANCE, Agreement
from codegen.checks.module.coupling_kernels import check_couplings
from codegen.checks.module.kernel_arguments import kernel_stems, other_symbols, parameter_vector, pattern_of
from codegen.checks.module.step_kernels import check_step
from codegen.checks.solution.ranges import near_end, near_interval
from codegen.discretise import STEP
from codegen.solutions.fit import plain
from codegen.transcribe.program import ControlProgram, EndElement, IntervalElement
from codegen.verify.arithmetic import CONTINUED

_COMPLEX_STEP = 1e-30
_NOT_ANALYTIC = (sympy.Abs, sympy.sign, sympy.Min, sympy.Max, sympy.Piecewise, sympy.Heaviside, sympy.atan2)


def check(context: Context) -> Iterator[Finding]:
    """Compare all kernels of the module with what was derived."""
    program = context.program
    if not isinstance(program, ControlProgram):
        yield from check_step(context, program)
        return
    for stem, share in zip(kernel_stems(program), program.interval_elements, strict=True):
        yield from _interval(context, program, stem, share)
    yield from _end(context, program, "start", program.start, program.left_symbols)
    yield from _end(context, program, "end", program.end, program.right_symbols)
    yield from check_couplings(context, program)


def _interval(context: Context, program: ControlProgram, stem: str, share: IntervalElement) -> Iterator[Finding]:
    unknowns = program.element_symbols
    symbols = [*unknowns, *other_symbols(program)]
    scalar, indices = function_of(symbols, [share.element]), range(len(unknowns))
    cost = function_of(symbols, [share.cost])
    first, second, steps = Agreement(), Agreement(), Agreement()
    analytic = not share.element.has(*_NOT_ANALYTIC)
    module, pattern = context.module, pattern_of(context.module, "interval")
    names = [f"dl/d{x}" for x in unknowns]
    local = unknowns[: len(unknowns) - len(program.shared)]
    likely = near_interval(context, program, stem)
    for point in random_points([share.element, share.cost], symbols, program.model, likely=likely):
        numbers = [point[symbol] for symbol in symbols]
        x, parameters = np.array([point[s] for s in local]), parameter_vector(point, program)
        t, h = point[program.model.time], point[STEP]
        emitted, entries = np.empty(len(unknowns)), np.empty(len(pattern))
        found = plain(getattr(module, f"{stem}_gradient"))(x, t, h, parameters, emitted)
        plain(getattr(module, f"{stem}_hessian"))(x, t, h, parameters, entries)
        with mpmath.workdps(DIGITS):
            first.compare(names, emitted, gradient(scalar, numbers, indices))
            first.compare(["Cd"], [found], cost(*map(mpmath.mpf, numbers)))
            exact = second_differences(scalar, numbers, pattern)
            wanted = [exact[pair] for pair in pattern]
            second.compare([f"d2l/d{unknowns[r]} d{unknowns[c]}" for r, c in pattern], entries, wanted)
        if analytic:
            steps.compare(names, emitted, _complex_steps(share.element, symbols, numbers, len(unknowns)))
    yield first.finding(f"{stem}_gradient", "120-digit differences of l")
    if analytic:
        yield steps.finding(f"{stem}_gradient", "complex steps of l")
    yield second.finding(f"{stem}_hessian", "120-digit second differences of l")


def _complex_steps(scalar: Expr, symbols: Sequence[Symbol], numbers: Sequence[float], count: int) -> list[Any]:
    function = sympy.lambdify(list(symbols), scalar, modules=[CONTINUED, "numpy"], cse=True)
    results = []
    for i in range(count):
        shifted = [complex(number) for number in numbers]
        shifted[i] += 1j * _COMPLEX_STEP
        results.append(mpmath.mpf(float(np.imag(function(*shifted))) / _COMPLEX_STEP))
    return results


def _end(
    context: Context, program: ControlProgram, name: str, end: EndElement, node: Sequence[Symbol]
) -> Iterator[Finding]:
    """The end's own share of the Lagrangian and its cost; entries of pinned unknowns are not emitted."""
    unknowns = [*node, *program.shared_symbols]
    symbols = [*unknowns, *other_symbols(program)]
    scalar, cost = function_of(symbols, [end.element]), function_of(symbols, [end.cost])
    pinned = {i for i, _ in end.pins}
    free = [i for i in range(len(unknowns)) if i not in pinned]
    module, first, second = context.module, Agreement(), Agreement()
    pattern = pattern_of(module, name)
    likely = near_end(context, program, name)
    for point in random_points([end.element], symbols, program.model, likely=likely):
        numbers = [point[symbol] for symbol in symbols]
        x, t, parameters = np.array(numbers[: len(node)]), point[program.model.time], parameter_vector(point, program)
        emitted, entries = np.zeros(len(unknowns)), np.zeros(len(pattern))
        found = plain(getattr(module, f"{name}_gradient"))(x, t, parameters, emitted)
        if pattern:
            plain(getattr(module, f"{name}_hessian"))(x, t, parameters, entries)
        with mpmath.workdps(DIGITS):
            exact = gradient(scalar, numbers, free)
            first.compare([f"by {unknowns[i]}" for i in free], emitted[free], exact)
            first.compare([f"cost at the {name}"], [found], cost(*map(mpmath.mpf, numbers)))
            lost = sorted(curved_beyond(scalar, numbers, free, pattern))
            pairs = [*pattern, *lost]
            wanted = second_differences(scalar, numbers, pairs)
            names = [f"by {unknowns[r]}, {unknowns[c]}" for r, c in pairs]
            second.compare(names, [*entries, *np.zeros(len(lost))], [wanted[pair] for pair in pairs])
    yield first.finding(f"{name}_gradient", "120-digit differences")
    if pattern or second.error > TOLERANCE:
        yield second.finding(f"{name}_hessian", "120-digit second differences")
