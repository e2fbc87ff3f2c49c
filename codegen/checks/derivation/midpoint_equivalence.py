"""The midpoint rule is the discrete Hamiltonian map of Ld = h L(midpoint), forces included.

Source: Marsden and West (2001), Discrete mechanics and variational integrators, section 2.6.
"""

from __future__ import annotations

from collections.abc import Iterator

import sympy
from sympy import Expr, S, Symbol

from codegen import schemes
from codegen.checks.base import Context, Finding, does_not_apply
from codegen.checks.evaluation import vanishing
from codegen.discretise import STEP, at_nodes, one_step_interval, variational_interval
from codegen.discretise.polynomials import between
from codegen.errors import DegenerateError
from codegen.model import Model, legendre
from codegen.transcribe.simulation.phase_functions import phase_functions


def check(context: Context) -> Iterator[Finding]:
    """Put both discrete Legendre transforms into the implicit midpoint equations, which must then vanish."""
    if context.scheme.name != "midpoint":
        yield does_not_apply("midpoint equivalence", f"the scheme is {context.scheme.name}")
        return
    try:
        found = residuals(context.model)
    except DegenerateError:
        yield does_not_apply("midpoint equivalence", "the Legendre transform is degenerate: there is no Lagrangian")
        return
    for name, left_over in found:
        known = vanishing(left_over)
        passed, detail = bool(known), f"p_k = -D1 Ld - f-, p_k1 = D2 Ld + f+ satisfy it, {known}"
        if not passed:
            detail = f"the discrete Hamiltonian map leaves {sympy.sstr(left_over)[:200]}"
        yield Finding("midpoint equivalence", f"implicit midpoint rule of {name}", passed, detail)


def residuals(model: Model) -> list[tuple[str, Expr]]:
    """What the discrete Hamiltonian map leaves of the equations of the midpoint rule, by coordinate and momentum."""
    model = model.with_free_ends
    if phase_functions(model):
        return _with_velocities(model)
    phase = legendre.hamiltonian_form(model)
    map_ = schemes.METHODS["variational"]["midpoint"]
    rule = schemes.METHODS["hamiltonian"]["midpoint"]
    interval = variational_interval(legendre.lagrangian_form(model), map_)
    left, right = at_nodes(phase.rates, "_k"), at_nodes(phase.rates, "_k1")
    # Halves of sums of momenta are expanded first, where curvature terms cancel.
    momenta = dict(zip((*left, *right), (*interval.left_momentum, *interval.right_momentum), strict=True))
    means = {a / 2 + b / 2: sympy.expand((momenta[a] + momenta[b]) / 2) for a, b in zip(left, right, strict=True)}
    equations = one_step_interval(phase, rule).equations
    names = [symbol.name for symbol in (*phase.coordinates, *phase.rates)]
    return [(name, e.subs(means).xreplace(momenta)) for name, e in zip(names, equations, strict=True)]


def _with_velocities(model: Model) -> list[tuple[str, Expr]]:
    """The same where the Hamiltonian of a large system is not written out.

    The midpoint rule's v = dH/dp and p' = f - dH/dq at the midpoint are p = dL/dv and p' = f + dL/dq at the velocity
    v = (q_k1 - q_k)/h.
    """
    map_ = schemes.METHODS["variational"]["midpoint"]
    interval = variational_interval(model, map_)
    left, right = interval.left_momentum, interval.right_momentum
    ends = list(zip(interval.q.left, interval.q.right, strict=True))
    middle: dict[Symbol, Expr] = dict(zip(model.coordinates, (between(a, b, S.Half) for a, b in ends), strict=True))
    middle |= dict(zip(model.rates, ((b - a) / STEP for a, b in ends), strict=True))
    middle |= dict(zip(model.controls, interval.q.left_controls, strict=True)) | {model.time: model.time + STEP / 2}
    found = []
    for i, (q, v) in enumerate(zip(model.coordinates, model.rates, strict=True)):
        found.append((q.name, (left[i] + right[i]) / 2 - sympy.diff(model.function, v).xreplace(middle)))
        slope = (sympy.diff(model.function, q) + model.force[i]).xreplace(middle)
        found.append((f"p_{q.name}", right[i] - left[i] - STEP * slope))
    return found
