"""What the kernels of a control module are called with, and where their entries belong."""

from __future__ import annotations

from typing import Any

import numpy as np
from sympy import Symbol

from codegen.checks.evaluation import Point
from codegen.discretise import STEP
from codegen.expressions.table_functions import numbers_of
from codegen.lower.phases import named_elements
from codegen.transcribe.program import ControlProgram


def other_symbols(program: ControlProgram) -> list[Symbol]:
    """What the shares of the Lagrangian depend on beside unknowns: parameters, boundary values, time and step."""
    return [*program.model.parameters, *(v.symbol for v in program.boundary_values), program.model.time, STEP]


def kernel_stems(program: ControlProgram) -> list[str]:
    """The names of the kernels of an interval, without `_gradient` or `_hessian`, one for each of its elements."""
    return [stem for stem, _ in named_elements(program)]


def pattern_of(module: Any, share: str) -> list[tuple[int, int]]:
    """Rows and columns of the emitted Hessian of the interval, the start or the end; none where there is no kernel."""
    prefix = f"{share.upper()}_" if share in ("start", "end") else ""
    rows, columns = (getattr(module, f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def parameter_vector(point: Point, program: ControlProgram) -> Any:
    """A row of `grid.parameters`: parameters, boundary values, shared unknowns, and behind them numbers of tables."""
    boundary = [value.symbol for value in program.boundary_values]
    symbols = (*program.model.parameters, *boundary, *program.shared_symbols)
    return np.array([*(point[s] for s in symbols), *numbers_of(program.model)])
