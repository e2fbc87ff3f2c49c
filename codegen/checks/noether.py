"""Discrete Noether theorem: a cyclic coordinate's discrete momentum is conserved where no force acts on it.

Source: Marsden and West (2001), section 1.3.3. For a translation of q_i the infinitesimal symmetry of Ld is
D1 Ld + D2 Ld = 0 in that component, which is p_k = p_k1.
"""

from __future__ import annotations

from collections.abc import Iterator

import sympy
from sympy import Expr

from codegen import legendre
from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import vanishes_symbolically
from codegen.checks.one_step import without_boundaries, without_forces
from codegen.discretise import one_step_interval, variational_interval
from codegen.model import Model
from codegen.schemes import DiscreteLagrangian, OneStep, Scheme


def check(context: Context) -> Iterator[Finding]:
    """Prove conservation for every coordinate that the Lagrangian or Hamiltonian does not hold."""
    for i, q in enumerate(context.model.coordinates):
        if context.model.function.has(q):
            continue
        change = momentum_change(context.model, context.scheme, i)
        passed = vanishes_symbolically(change)
        detail = f"{q} is cyclic, and without force its discrete momentum is conserved, proved symbolically"
        if context.model.force[i] != 0:
            detail += f" (the force {sympy.sstr(context.model.force[i])} changes it)"
        if not passed:
            detail = f"{q} is cyclic, but its discrete momentum changes by {sympy.sstr(change)[:200]} in a step"
        yield Finding("discrete Noether", f"momentum of {q}", passed, detail)


def momentum_change(model: Model, scheme: Scheme, i: int) -> Expr:
    """D1 Ld + D2 Ld in one component, or what a one-step method adds to the momentum; forces left out."""
    model = without_forces(without_boundaries(model))
    if isinstance(scheme, DiscreteLagrangian):
        interval = variational_interval(legendre.lagrangian_form(model), scheme)
        left, right = interval.q.left[i], interval.q.right[i]
        return sympy.diff(interval.lagrangian, left) + sympy.diff(interval.lagrangian, right)
    assert isinstance(scheme, OneStep)
    step = one_step_interval(legendre.hamiltonian_form(model), scheme)
    dimension = len(model.coordinates)
    momenta = step.equations[dimension + i :: 2 * dimension]
    return sum(momenta, sympy.S.Zero) - (step.p.right[i] - step.p.left[i])
