"""The determinant of the one-step map of every scheme, for a system with one degree of freedom.

By implicit differentiation of the equations of a step: with E(z0, y) = 0, y the unknowns, Dy = -(dE/dy)^-1 dE/dz0.
Source: Hairer, Lubich and Wanner (2006), Geometric numerical integration, section VI.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import sympy
from sympy import Expr

from codegen.checks.base import Context, Finding, does_not_apply
from codegen.checks.derivation.one_step import jacobians, step_equations, without_forces
from codegen.checks.derivation.symplecticity import PRESERVED, defect_at_random_points
from codegen.errors import DegenerateError
from codegen.expressions.zeros import identically_zero
from codegen.model import Model
from codegen.schemes import METHODS, Scheme


def check(context: Context) -> Iterator[Finding]:
    """Derive the determinant for every registered scheme, forces left out, where there is one coordinate.

    Compositions are left out, whose determinant is a product of those of their base.
    """
    if len(context.model.coordinates) != 1:
        yield does_not_apply("area preservation", "there is more than one coordinate")
        return
    for method, table in METHODS.items():
        try:
            yield from _of_method(context.model, method, table.values())
        except DegenerateError:
            yield does_not_apply("area preservation", f"a degenerate Legendre transform rules out {method} schemes")


def _of_method(forced: Model, method: str, schemes: Iterable[Scheme]) -> Iterator[Finding]:
    """The rows of the schemes of a method; DegenerateError where the problem has no form for it."""
    model = without_forces(forced)
    curvature = sympy.hessian(model.function, [*model.coordinates, *model.rates])
    curved, linear = not identically_zero(curvature.det()), not curvature.has(*model.coordinates, *model.rates)
    for scheme in schemes:
        if scheme.parts:
            continue
        if scheme.is_chain:
            determinant = area_factor(model, scheme)
            preserved, found = determinant == 1, f"det = {sympy.sstr(determinant)}"
        else:
            # The determinant of a step with inner stages is a long expression; for two variables it is S^T J S.
            defect = defect_at_random_points(forced, step_equations(model, scheme))
            preserved, found = defect < PRESERVED, f"|det - 1| = {defect:.2g} at random points"
        # Where the potential or the kinetic energy is linear, any scheme may preserve areas by accident, and so do
        # symmetric ones where both are quadratic: the map is R(hA) with R(z) R(-z) = 1.
        accident = preserved and (not curved or (linear and scheme.symmetric))
        claim = "symplectic" if scheme.symplectic else "not symplectic"
        passed = preserved == scheme.symplectic or accident
        yield Finding("area preservation", f"{scheme.name} ({method})", passed, f"{found}, and the scheme is {claim}")


def area_factor(model: Model, scheme: Scheme) -> Expr:
    """The determinant of the derivative of the one-step map, simplified; a product over substeps.

    That of a composition is the factor of one step of its base, of any length.
    """
    factor = sympy.S.One
    for left, right, equations in step_equations(model, scheme).links():
        before, after = jacobians(left, right, equations)
        if len(right) == len(left):
            factor *= before.det() / after.det()
        else:
            factor *= (-after.LUsolve(before))[-len(left) :, :].det()
    factor = sympy.factor(sympy.simplify(factor))
    return factor if factor.count_ops() < sympy.expand(factor).count_ops() else sympy.expand(factor)
