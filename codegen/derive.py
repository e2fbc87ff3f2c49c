"""Program -> first and second derivatives, their exact sparsity, and what is provably constant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.transcribe.program import ControlProgram, EndElement, StepProgram

Entry = tuple[int, int, Expr]
"""Row, column and value of a structurally nonzero derivative."""


@dataclass(frozen=True)
class ElementDerivatives:
    """Gradient (dense) and Hessian (lower triangle, structural nonzeros) of a scalar in its local unknowns."""

    unknowns: tuple[Symbol, ...]
    gradient: tuple[Expr, ...]
    hessian: tuple[Entry, ...]


@dataclass(frozen=True)
class ControlDerivatives:
    """Everything that the structured Newton method of a control problem needs.

    `condensed` says that the controls' block of the Hessian is constant and regular, so that controls can be
    eliminated interval by interval; `linear_quadratic` that no Hessian entry depends on an unknown.
    """

    element: ElementDerivatives
    start: ElementDerivatives
    end: ElementDerivatives
    condensed: bool
    linear_quadratic: bool


@dataclass(frozen=True)
class StepDerivatives:
    """Jacobian (dense, row by row) of the residual of an implicit step; empty for an explicit one."""

    jacobian: tuple[tuple[Expr, ...], ...]
    constant: bool


def control_derivatives(program: ControlProgram) -> ControlDerivatives:
    """Differentiate the interval's scalar and both end elements twice."""
    unknowns = (*program.left_symbols, *program.interval_symbols, *program.control_symbols, *program.right_symbols)
    element = _element(program.element, unknowns)
    extra = len(program.start.extra)
    start = _end_element(program.start, (*program.start.extra_symbols, *program.left_symbols), extra)
    end = _end_element(program.end, (*program.right_symbols, *program.end.extra_symbols), 0)
    variables = set(unknowns) | set(start.unknowns) | set(end.unknowns)
    entries = (*element.hessian, *start.hessian, *end.hessian)
    return ControlDerivatives(
        element=element,
        start=start,
        end=end,
        condensed=_condensable(program, element, set(unknowns)),
        linear_quadratic=not any(value.free_symbols & variables for _, _, value in entries),
    )


def step_derivatives(program: StepProgram) -> StepDerivatives:
    """Differentiate the residual of a step by its unknowns, through the explicit assignments before it."""
    total = _total_residual(program)
    jacobian = tuple(tuple(sympy.diff(r, y) for y in program.unknowns) for r in total)
    constant = not any(entry.free_symbols & set(program.unknowns) for row in jacobian for entry in row)
    return StepDerivatives(jacobian, constant)


def _total_residual(program: StepProgram) -> list[Expr]:
    total = list(program.residual)
    for symbol, value in reversed(program.before):
        total = [r.subs(symbol, value) for r in total]
    return total


def _element(scalar: Expr, unknowns: Sequence[Symbol]) -> ElementDerivatives:
    gradient = tuple(sympy.diff(scalar, x) for x in unknowns)
    hessian: list[Entry] = []
    for row, first in enumerate(gradient):
        present = first.free_symbols
        for column, x in enumerate(unknowns[: row + 1]):
            if x not in present:
                continue
            second = sympy.diff(first, x)
            if not _vanishes(second):
                hessian.append((row, column, second))
    return ElementDerivatives(tuple(unknowns), gradient, tuple(hessian))


def _end_element(end: EndElement, unknowns: tuple[Symbol, ...], node: int) -> ElementDerivatives:
    """Derivatives of an end's share; what is pinned there is a number and not differentiated twice.

    `node` is the place of the node's first unknown among `unknowns`.
    """
    pinned = {node + i for i, _ in end.pins}
    full = _element(end.element, unknowns)
    hessian = tuple(entry for entry in full.hessian if not {entry[0], entry[1]} & pinned)
    return ElementDerivatives(full.unknowns, full.gradient, hessian)


def _vanishes(expression: Expr) -> bool:
    """Whether an expression is identically zero; costly simplification only where it is cheap and can matter."""
    if expression.is_zero:
        return True
    if expression.is_Add and expression.count_ops() < 200:
        return bool(sympy.expand(expression) == 0)
    return False


def _condensable(program: ControlProgram, element: ElementDerivatives, unknowns: set[Symbol]) -> bool:
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
    return bool(sympy.simplify(block.det()) != 0)
