"""Momentum matching: the discrete Euler-Lagrange equation says p_k^+ = p_k^-, and the ends match prescribed momenta.

With p_k^- = -D1 Ld(q_k, q_k1) - f- and p_k^+ = D2 Ld(q_k-1, q_k) + f+ (Marsden and West 2001, section 1.5).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.checks.derivation.discrete_equations import constant_controls, constraint_multipliers, node_equations
from codegen.checks.derivation.phases import phase_contexts
from codegen.checks.evaluation import DIGITS, function_of, random_points, vanishing
from codegen.checks.solution.solutions import free_values
from codegen.discretise import STEP, at_nodes, repeated, variational_interval
from codegen.model import Boundary, Model, legendre
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.step_program import StepProgram

_MATCHED = 1e-9


def check(context: Context) -> Iterator[Finding]:
    """Check the symbolic identity, the sign of the transforms, and momenta of a computed motion at both ends."""
    program = context.program
    if program.method != "variational":
        yield does_not_apply("momentum matching", f"the {program.method} method has no discrete Lagrangian")
        return
    for phase, own in phase_contexts(context):
        model = legendre.lagrangian_form(own.model.with_free_ends)
        for finding in (*_matching(own, model), *_limits(own, model)):
            yield replace(finding, subject=f"{phase}{finding.subject}")
    if isinstance(program, ControlProgram):
        yield from _ends(context)


def _matching(context: Context, model: Model) -> Iterator[Finding]:
    """The emitted equation of a node against the gradient of the action of its two intervals."""
    _, scheme = repeated(context.scheme)
    interval = variational_interval(model, scheme, context.choices.controls)
    after, before = node_equations(context.program)
    left, right = _constraint_impulses(context.program, model)
    for i, q in enumerate(model.coordinates):
        minus = -sympy.diff(interval.lagrangian, interval.q.left[i]) - interval.force_minus[i]
        plus = sympy.diff(interval.lagrangian, interval.q.right[i]) + interval.force_plus[i]
        minus, plus = minus - left[i], plus + right[i]
        known = [vanishing(before[i] - plus), vanishing(after[i] + minus)]
        passed = all(known)
        detail = f"its discrete Euler-Lagrange equation is p_k^+ - p_k^- = 0, {max(known, key=len)}"
        if not passed:
            detail = "its emitted equation is not p_k^+ - p_k^- = 0 with p_k^- = -D1 Ld - f-, p_k^+ = D2 Ld + f+"
        yield Finding("momentum matching", f"node equation of {q}", passed, detail)


def _constraint_impulses(program: ControlProgram | StepProgram, model: Model) -> tuple[list[Expr], list[Expr]]:
    """What holonomic constraints add in half an interval: h/2 G^T kappa at its left and at its right node."""
    impulses = []
    for suffix, instant in (("_k", model.time), ("_k1", model.time + STEP)):
        here = at_nodes(model.coordinates, suffix)
        substitution = dict(zip(model.coordinates, here, strict=True)) | {model.time: instant}
        pairs = list(zip(constraint_multipliers(program, suffix), model.holonomic, strict=True))
        impulses.append(
            [
                sum((STEP / 2 * y * sympy.diff(c, q).xreplace(substitution) for y, c in pairs), sympy.S.Zero)
                for q in model.coordinates
            ]
        )
    return impulses[0], impulses[1]


def _limits(context: Context, model: Model) -> Iterator[Finding]:
    """Both discrete momenta tend to dL/dv as h -> 0; a lost sign would show here."""
    after, before = node_equations(context.program)
    q, v = model.coordinates, model.rates
    sites = [Symbol(f"{x}_k", real=True) for x in q], [Symbol(f"{x}_k1", real=True) for x in q]
    arrival: dict[Symbol, Expr] = dict(zip(sites[0], q, strict=True))
    arrival |= {site: x + STEP * w for site, x, w in zip(sites[1], q, v, strict=True)}
    nodes = repeated(context.scheme)[1].discrete_lagrangian().nodes
    for i, c in enumerate(nodes[1:-1], start=1):
        arrival |= {site: x + c * STEP * w for site, x, w in zip(at_nodes(q, f"_stage{i}"), q, v, strict=True)}
    arrival |= constant_controls(context.program)
    free = [parameter.symbol for parameter in model.free_parameters]
    forces = [s for suffix in ("_k", "_k1") for s in constraint_multipliers(context.program, suffix)]
    symbols = [*q, *v, *model.controls, *model.parameters, *free, *forces, model.time]
    for i, x in enumerate(q):
        momentum = sympy.diff(model.function, v[i])
        function = function_of([*symbols, STEP], [e.xreplace(arrival) for e in (-after[i], before[i])])
        limit, worst = function_of(symbols, [momentum]), mpmath.mpf(0)
        with mpmath.workdps(DIGITS):
            for point in random_points([momentum, *model.force], symbols, model, count=2):
                numbers = [mpmath.mpf(point[symbol]) for symbol in symbols]
                exact = limit(*numbers)[0]
                both = function(*numbers, mpmath.mpf(10) ** -20)
                worst = max(worst, *(abs(value - exact) / (1 + abs(exact)) for value in both))
        passed = bool(worst < 1e-10)
        detail = f"-D1 Ld - f- and D2 Ld + f+ tend to dL/d{v[i]} as h -> 0"
        if not passed:
            detail = f"-D1 Ld - f- and D2 Ld + f+ do not both tend to dL/d{v[i]}: off by {float(worst):.2g}"
        yield Finding("momentum matching", f"discrete momenta of {x}", passed, detail)


def _ends(context: Context) -> Iterator[Finding]:
    """Momenta of the generated solution at its ends against D2 L(q, v) of the prescribed positions and velocities."""
    phases = context.model.phases or (context.model,)
    first, last = (
        legendre.lagrangian_form(model) for model in (phases[0], replace(phases[-1], duration=context.model.duration))
    )
    assert last.end is not None
    model = context.model
    solution, module, width = context.solution, context.module, len(model.coordinates)
    if solution.status != "solved":
        yield not_measured("momentum matching", "momenta at the ends", solution.message)
        return
    values: dict[Symbol, Any] = dict(model.default_values)
    values |= dict(zip((p.symbol for p in model.free_parameters), free_values(module, solution), strict=True))
    for where, own, boundary, row in (("start", first, first.start, 0), ("end", last, last.end, -1)):
        instant = 0.0 if where == "start" else float(solution.t[-1])
        errors: dict[str, float] = {}
        for body in range(model.bodies):
            known = values | ({model.body: body} if model.body is not None else {})
            of_body = f" of body {body}" if model.bodies > 1 else ""
            for i, (name, p) in _prescribed(own, boundary, known, instant).items():
                found = float(solution.p[row, body * width + i])
                errors[f"{name}{of_body}"] = abs(found - p) / max(1.0, abs(p))
        if not errors:
            continue
        worst = max(errors, key=lambda name: errors[name])
        passed = errors[worst] < _MATCHED
        detail = f"the solution's momenta are those of the prescribed velocities, up to {errors[worst]:.1g}"
        if not passed:
            detail = f"momentum of {worst} differs by {errors[worst]:.2g} from that of the prescribed velocity"
        yield Finding("momentum matching", f"momenta at the {where}", passed, detail)


def _prescribed(
    model: Model, boundary: Boundary, values: dict[Symbol, Any], instant: float
) -> dict[int, tuple[str, float]]:
    """Index, name and value of every momentum that the prescribed values of an end determine."""
    symbols: Sequence[Symbol] = (*model.coordinates, *model.rates)
    given = zip(symbols, (*boundary.positions, *boundary.rates), strict=True)
    known = {model.time: instant} | {symbol: value.subs(values) for symbol, value in given if value is not None}
    found = {}
    for i, (q, v) in enumerate(zip(model.coordinates, model.rates, strict=True)):
        momentum = sympy.diff(model.function, v).subs(known).subs(values)
        if boundary.rates[i] is not None and not momentum.free_symbols:
            found[i] = (q.name, float(np.float64(momentum.evalf())))
    return found
