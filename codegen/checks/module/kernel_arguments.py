"""What the kernels of a control module are called with, and where their entries belong."""

from __future__ import annotations

from typing import Any

import numpy as np
from sympy import Symbol

from codegen.checks.evaluation import Point
from codegen.discretise import STEP
from codegen.expressions.table_functions import numbers_of
from codegen.lower.control.phases import named_elements
from codegen.transcribe.program import ControlProgram


def other_symbols(program: ControlProgram) -> list[Symbol]:
    """What the shares of the Lagrangian depend on beside unknowns: parameters, boundary values, time and step.

    Where there are inner times, numbers of the left node come before the time.
    """
    given = (*program.model.parameters, *(v.symbol for v in program.boundary_values))
    return [*given, *program.inner.symbols, program.model.time, STEP]


def kernel_stems(program: ControlProgram) -> list[str]:
    """The names of the kernels of an interval, without `_gradient` or `_hessian`, one for each of its elements."""
    return [stem for stem, _ in named_elements(program)]


def pattern_of(module: Any, share: str) -> list[tuple[int, int]]:
    """Rows and columns of the emitted Hessian of the interval, the start or the end; none where there is no kernel."""
    prefix = f"{share.upper()}_" if share in ("start", "end") else ""
    rows, columns = (getattr(module, f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def parameter_vector(point: Point, program: ControlProgram) -> Any:
    """A row of `grid.parameters`: parameters, boundary values, inner times, shared unknowns, and numbers of tables.

    The interval begins at the first of the inner times.
    """
    given = (*program.model.parameters, *(value.symbol for value in program.boundary_values))
    later, inner = range(1, len(program.inner.times)), list[float]()
    if program.inner.times:
        time, step = point[program.model.time], point[STEP]
        inner += [time, *(time + 2.0 * i * step for i in later)]
        inner += [value for s in program.inner.symbols for value in (point[s], *(0.0 for _ in later))]
    shared = [point[s] for s in program.shared_symbols]
    return np.array([*(point[s] for s in given), *inner, *shared, *numbers_of(program.model)])


def few_steps(program: ControlProgram, steps: int) -> int:
    """As many intervals, or, where there are inner times, one between any two of them."""
    return len(program.inner.times) + 1 if program.inner.times else steps
