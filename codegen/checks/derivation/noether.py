"""Discrete Noether theorem: a cyclic coordinate's discrete momentum is conserved where no force acts on it.

Source: Marsden and West (2001), section 1.3.3. For a translation of q_i the infinitesimal symmetry of Ld is
D1 Ld + D2 Ld = 0 in that component, which is p_k = p_k1.
"""

from __future__ import annotations

from collections.abc import Iterator

import sympy
from sympy import Expr

from codegen.checks.base import Context, Finding, does_not_apply
from codegen.checks.derivation.one_step import without_forces
from codegen.checks.evaluation import vanishing
from codegen.discretise import one_step_interval, repeated, variational_interval
from codegen.model import Model, legendre
from codegen.schemes import Scheme


def check(context: Context) -> Iterator[Finding]:
    """Prove conservation for every coordinate that the Lagrangian or Hamiltonian does not hold."""
    model = context.model
    cyclic = [i for i, q in enumerate(model.coordinates) if not model.function.has(q)]
    if not cyclic:
        yield does_not_apply("discrete Noether", f"no coordinate is cyclic in the {model.form.capitalize()}")
    for i in cyclic:
        q = model.coordinates[i]
        change = momentum_change(model, context.scheme, i)
        known = vanishing(change)
        passed, detail = bool(known), f"{q} is cyclic, and without force its discrete momentum is conserved, {known}"
        if model.force[i] != 0:
            detail += f" (the force {sympy.sstr(model.force[i])} changes it)"
        if any(constraint.has(q) for constraint in model.holonomic):
            detail += " (the force of a constraint changes it)"
        if not passed:
            detail = f"{q} is cyclic, but its discrete momentum changes by {sympy.sstr(change)[:200]} in a step"
        yield Finding("discrete Noether", f"momentum of {q}", passed, detail)


def momentum_change(model: Model, scheme: Scheme, i: int) -> Expr:
    """The sum of all D_j Ld in one component, or what a one-step method adds to the momentum; forces left out.

    A composition conserves what its base does.
    """
    model = without_forces(model.with_free_ends)
    _, scheme = repeated(scheme)
    if scheme.variational:
        interval = variational_interval(legendre.lagrangian_form(model), scheme)
        inner = interval.inner[i :: len(model.coordinates)]
        positions = (interval.q.left[i], interval.q.right[i], *inner)
        return sum((sympy.diff(interval.lagrangian, q) for q in positions), sympy.S.Zero)
    step, dimension = one_step_interval(legendre.hamiltonian_form(model), scheme), len(model.coordinates)
    equations = step.equations if scheme.is_chain else step.equations[-2 * dimension :]
    return sum(equations[dimension + i :: 2 * dimension], sympy.S.Zero) - (step.p.right[i] - step.p.left[i])
