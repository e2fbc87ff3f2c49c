"""The midpoint rule is the discrete Hamiltonian map of Ld = h L(midpoint) (thesis 2.4.2-2.4.3), forces included."""

from __future__ import annotations

from collections.abc import Iterator

import sympy
from sympy import Expr

from codegen import legendre, schemes
from codegen.checks.base import Context, Finding, does_not_apply
from codegen.checks.evaluation import vanishing
from codegen.checks.one_step import without_boundaries
from codegen.discretise import at_nodes, one_step_interval, variational_interval
from codegen.model import Model


def check(context: Context) -> Iterator[Finding]:
    """Put both discrete Legendre transforms into the implicit midpoint equations, which must then vanish."""
    if context.scheme.name != "midpoint":
        yield does_not_apply("midpoint equivalence", f"the scheme is {context.scheme.name}")
        return
    if context.model.form == "first-order":
        yield does_not_apply("midpoint equivalence", "a first-order system has no discrete Lagrangian")
        return
    for name, left_over in residuals(context.model):
        known = vanishing(left_over)
        passed, detail = bool(known), f"p_k = -D1 Ld - f-, p_k1 = D2 Ld + f+ satisfy it, {known}"
        if not passed:
            detail = f"the discrete Hamiltonian map leaves {sympy.sstr(left_over)[:200]}"
        yield Finding("midpoint equivalence", f"implicit midpoint rule of {name}", passed, detail)


def residuals(model: Model) -> list[tuple[str, Expr]]:
    """What the discrete Hamiltonian map leaves of the equations of the midpoint rule, by coordinate and momentum."""
    model = without_boundaries(model)
    phase = legendre.hamiltonian_form(model)
    map_ = schemes.METHODS["variational"]["midpoint"]
    rule = schemes.METHODS["hamiltonian"]["midpoint"]
    assert isinstance(map_, schemes.DiscreteLagrangian)
    assert isinstance(rule, schemes.OneStep)
    interval = variational_interval(legendre.lagrangian_form(model), map_)
    left, right = at_nodes(phase.rates, "_k"), at_nodes(phase.rates, "_k1")
    # Halves of sums of momenta are expanded first, where curvature terms cancel.
    momenta = dict(zip((*left, *right), (*interval.left_momentum, *interval.right_momentum), strict=True))
    means = {a / 2 + b / 2: sympy.expand((momenta[a] + momenta[b]) / 2) for a, b in zip(left, right, strict=True)}
    equations = one_step_interval(phase, rule).equations
    names = [symbol.name for symbol in (*phase.coordinates, *phase.rates)]
    return [(name, e.subs(means).xreplace(momenta)) for name, e in zip(names, equations, strict=True)]
