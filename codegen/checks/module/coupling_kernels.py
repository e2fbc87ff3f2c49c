"""The conditions between bodies: kernels and tables of their terms against the conditions that the author wrote.

The module holds a few kinds of term and says where each occurs. Put together again, terms must give every condition,
its slopes and its curvatures.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
from sympy import Expr

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import DIGITS, NOTHING, function_of, gradient, random_points, second_differences
from codegen.checks.module.agreement import Agreement
from codegen.checks.module.kernel_arguments import parameter_vector
from codegen.model import Model
from codegen.solutions.fit import plain
from codegen.transcribe.program import ControlProgram
from codegen.verify.couplings import shared_symbols


def check_couplings(context: Context, program: ControlProgram) -> Iterator[Finding]:
    """Compare values, slopes and curvatures of all conditions with differences of what the author wrote."""
    if not program.couplings:
        return
    symbols = shared_symbols(program)
    conditions = _written_conditions(context.model, program)
    others = [s for s in (*program.model.parameters, *(v.symbol for v in program.boundary_values)) if s not in symbols]
    values, slopes, curvatures = Agreement(), Agreement(), Agreement()
    every = [*symbols, *others]
    functions = [function_of(every, [condition]) for condition in conditions]
    for point in random_points(conditions, every, program.model):
        numbers, row = [point[s] for s in every], dict.fromkeys(program.shared_symbols, 0.0) | point
        parts = _assembled(context.module, [point[s] for s in symbols], parameter_vector(row, program), len(conditions))
        for r, (coupling, function) in enumerate(zip(program.couplings, functions, strict=True)):
            name = f"condition of {coupling.multiplier.name}"
            read = [i for i, s in enumerate(symbols) if conditions[r].has(s) or parts[1][r][i] or parts[2][r][i].any()]
            pairs = [(i, j) for i in read for j in read]
            with mpmath.workdps(DIGITS):
                values.compare([name], [parts[0][r]], function(*map(mpmath.mpf, numbers)))
                first = gradient(function, numbers, read)
                slopes.compare([f"{name} by {symbols[i]}" for i in read], parts[1][r][read], first)
                # Where a condition is not curved at all, second differences are the rounding of its values.
                least = NOTHING * max(map(abs, first), default=0)
                second = [
                    value if abs(value) > least else mpmath.mpf(0)
                    for value in second_differences(function, numbers, pairs).values()
                ]
                called = [f"{name} by {symbols[i]} and {symbols[j]}" for i, j in pairs]
                curvatures.compare(called, [parts[2][r][pair] for pair in pairs], second)
    yield values.finding("coupling_term", "the author's conditions")
    yield slopes.finding("slopes of coupling_term", "120-digit differences of the author's conditions")
    yield curvatures.finding("curvatures of coupling_term", "120-digit second differences of the author's conditions")


def _written_conditions(model: Model, program: ControlProgram) -> list[Expr]:
    """The author's conditions whose multipliers the module has, as functions of the shared unknowns.

    A coordinate that is periodic and coupled is shared as it is at the start, without its shift.
    """
    shifts = dict(model.periodic)
    shifted = {v.symbol: v.symbol + shifts.get(model.coordinates[v.coordinate], 0) for v in model.end_values}
    written = {condition.name: condition.expression for condition in model.couplings}
    return [written[coupling.multiplier.meaning.of].xreplace(shifted) for coupling in program.couplings]


def _assembled(module: Any, shared: list[float], parameters: Any, count: int) -> tuple[Any, Any, Any]:
    """Values (conditions,), slopes (conditions, shared) and curvatures (conditions, shared, shared) from the terms."""
    values, size = np.array(shared), len(shared)
    total, slope, curvature = np.zeros(count), np.zeros((count, size)), np.zeros((count, size, size))
    for kind, row, read, indices in zip(
        module.COUPLING_KINDS, module.COUPLING_ROWS, module.COUPLING_COUNTS, module.COUPLING_INDICES, strict=True
    ):
        here = indices[:read]
        width = len(indices)
        first, second = np.zeros(width), np.zeros(width * width)
        inputs = np.zeros(width)
        inputs[:read] = values[here]
        total[row] += plain(getattr(module, f"coupling_{kind}"))(inputs, parameters, first, second)
        np.add.at(slope[row], here, first[:read])
        np.add.at(curvature[row], np.ix_(here, here), second[: read * read].reshape(read, read))
    return total, slope, curvature
