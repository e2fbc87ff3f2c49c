"""Symplecticity of the one-step map: S^T J S = J for its derivative S, or a violation where it is not claimed.

With dE/dz0 = A and dE/dz1 = B in the equations E(z0, z1) = 0 of a step, S = -B^-1 A, and the identity is equivalent to
A J A^T = B J B^T, which holds no inverse and is decided symbolically where it can be. Source: Hairer, Lubich and
Wanner (2006), Geometric numerical integration, section VI.2.
"""

from __future__ import annotations

from collections.abc import Iterator

import mpmath
import sympy

from codegen.checks.base import Context, Finding
from codegen.checks.derivation.one_step import (
    StepEquations,
    generic_model,
    jacobians,
    solved_step,
    step_equations,
    symplectic_form,
    without_forces,
)
from codegen.checks.evaluation import function_of, random_points, symbols_of
from codegen.errors import NumericsError
from codegen.expressions.zeros import identically_zero
from codegen.model import Model
from codegen.schemes.step import Tableau

_DIGITS = 50
PRESERVED = 1e-35
"""A defect in 50-digit arithmetic that is rounding."""
_VIOLATED = 1e-20
_LARGEST_SYSTEM = 8
_SHORTER = 6
"""How often a step of random length is made shorter where its equations have no solution nearby."""


def check(context: Context) -> Iterator[Finding]:
    """Prove or refute the identity for the chosen scheme, forces left out."""
    scheme = context.scheme
    if not scheme.symplectic:
        defect = defect_at_random_points(generic_model_without_forces(), scheme_step(context, generic=True))
        detail = f"not claimed, and violated by a generic system: |S^T J S - J| = {defect:.2g}"
        if not defect > _VIOLATED:
            detail = f"not claimed, but |S^T J S - J| = {defect:.2g} for a generic system; flag it as symplectic"
        yield Finding("symplecticity", scheme.name, defect > _VIOLATED, detail)
        return
    if not (scheme.variational or scheme.is_chain):
        passed = has_symplectic_table(scheme.step().tableau)
        detail = "b_i a_ij + b_j a_ji = b_i b_j, exactly" if passed else "b_i a_ij + b_j a_ji = b_i b_j does not hold"
        yield Finding("symplecticity", scheme.name, passed, f"{detail} (a_ij of the momenta, a_ji of the coordinates)")
        return
    step = scheme_step(context, generic=False)
    if len(step.left) <= _LARGEST_SYSTEM and is_proved(step):
        yield Finding("symplecticity", scheme.name, True, "S^T J S = J, proved symbolically")
        return
    defect = defect_at_random_points(context.model, step)
    detail = f"|S^T J S - J| = {defect:.2g} at random points in {_DIGITS}-digit arithmetic"
    yield Finding("symplecticity", scheme.name, defect < PRESERVED, detail)


def scheme_step(context: Context, generic: bool) -> StepEquations:
    """One unforced step of the problem, or of the generic system."""
    model = generic_model_without_forces() if generic else without_forces(context.model)
    return step_equations(model, context.scheme)


def generic_model_without_forces() -> Model:
    """The conservative part of the generic system."""
    return without_forces(generic_model())


def has_symplectic_table(table: Tableau) -> bool:
    """Whether a table satisfies the condition for partitioned methods (HLW, theorem VI.4.6)."""
    b, a, c = table.weights, table.positions, table.momenta
    indices = range(len(b))
    return all(sympy.expand(b[i] * c[i][j] + b[j] * a[j][i] - b[i] * b[j]) == 0 for i in indices for j in indices)


def is_proved(step: StepEquations) -> bool:
    """Whether A J A^T = B J B^T holds symbolically in every link of the chain that makes up the step."""
    for left, right, equations in step.links():
        if len(left) != len(right):
            return False
        before, after = jacobians(left, right, equations)
        form = symplectic_form(len(left))
        difference = before * form * before.T - after * form * after.T
        if not all(identically_zero(entry) for entry in difference):
            return False
    return True


def defect_at_random_points(model: Model, step: StepEquations) -> float:
    """The largest entry of S^T J S - J where the equations of a step hold, solved in 50-digit arithmetic."""
    symbols = symbols_of(step.equations, step.left, step.unknowns)
    known = [symbol for symbol in symbols if symbol not in step.unknowns]
    order = [*known, *step.unknowns]
    residual = function_of(order, step.equations)
    before, after = (function_of(order, list(m)) for m in jacobians(step.left, step.unknowns, step.equations))
    form = mpmath.matrix(symplectic_form(len(step.left)).tolist())
    largest = 0.0
    with mpmath.workdps(_DIGITS):
        for point in random_points(step.equations, symbols, model, count=2):
            size = len(step.left)
            start = [point[step.left[i % size]] for i in range(-len(step.unknowns), 0)]
            for attempt in range(1, _SHORTER + 1):
                given = [mpmath.mpf(point[symbol]) / (4**attempt if symbol in step.lengths else 1) for symbol in known]
                try:
                    y = solved_step(residual, after, given, start)
                    break
                except NumericsError:  # bodies that meet, for instance
                    if attempt == _SHORTER:
                        raise
            columns, rows = len(step.left), len(step.unknowns)
            a = mpmath.matrix(rows, columns)
            b = mpmath.matrix(rows, rows)
            a[:, :], b[:, :] = _shaped(before(*given, *y), columns), _shaped(after(*given, *y), rows)
            derivative = -(b**-1) * a
            derivative = derivative[rows - columns :, :]
            difference = derivative.T * form * derivative - form
            largest = max(largest, float(max(abs(entry) for entry in difference)))
    return largest


def _shaped(entries: list[mpmath.mpf], columns: int) -> mpmath.matrix:
    return mpmath.matrix([entries[i : i + columns] for i in range(0, len(entries), columns)])
