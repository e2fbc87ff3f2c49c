"""Shares of an interval in conditions on integrals, divided by h, tend to the integrands as h -> 0.

The discrete side is what the module was emitted from, the continuous side the author's integrand, in the quantities in
which the problem is discretised. Along a motion with a constant rate their difference must vanish like h.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mpmath
from sympy import Expr, Symbol

from codegen.checks.base import Context, Finding
from codegen.checks.derivation.discrete_equations import constant_controls, inner_motion
from codegen.checks.evaluation import DIGITS, function_of, random_points
from codegen.discretise import STEP, at_nodes, repeated
from codegen.model import legendre
from codegen.transcribe.forms import rewritten
from codegen.transcribe.program import ControlProgram

_STEP = mpmath.mpf(10) ** -22
_VANISHED = 1e-15


def check(context: Context) -> Iterator[Finding]:
    """One finding for each condition, at random states."""
    original = context.control.model  # that of a phase is as its author wrote it
    transform = legendre.lagrangian_form if context.control.method == "variational" else legendre.hamiltonian_form
    model = rewritten(original, transform(original.with_free_ends))
    program = replace(context.control, model=model)
    substitution, rates = _smooth_motion(context, program)
    symbols = [*model.coordinates, *model.rates, *rates, *model.controls, *model.parameters, model.time]
    symbols += [free.symbol for free in model.free_parameters]
    symbols += sorted({s for value in substitution.values() for s in value.free_symbols} - {*symbols, STEP}, key=str)
    symbols = list(dict.fromkeys(symbols))
    written = dict(program.equations)
    for number, integral in enumerate(model.integrals, start=1):
        integrand, quadrature = integral.expression, program.in_time(written[f"Gd_{number}"]).xreplace(substitution)
        share, limit = function_of([*symbols, STEP], [quadrature]), function_of(symbols, [integrand])
        gap = mpmath.mpf(0)
        with mpmath.workdps(DIGITS):
            for point in random_points([integrand], symbols, model):
                numbers = [mpmath.mpf(point[symbol]) for symbol in symbols]
                wanted = limit(*numbers)[0]
                gap = max(gap, abs(share(*numbers, _STEP)[0] / _STEP - wanted) / max(1, abs(wanted)))
        passed = gap < _VANISHED
        verb = "is" if passed else "differs from"
        detail = f"divided by h an interval's share {verb} the integrand, up to {float(gap):.1g} at h = 1e-22"
        yield Finding("integrals", str(integral), bool(passed), detail)


def _smooth_motion(context: Context, program: ControlProgram) -> tuple[dict[Symbol, Expr], list[Symbol]]:
    """Values of the unknowns of an interval on a motion with constant rates and controls, and the symbols of rates."""
    model, substitution = program.model, dict[Symbol, Expr]()
    if program.method == "variational":
        states, rates = model.coordinates, list(model.rates)
        substitution |= inner_motion(model, repeated(context.scheme)[1].discrete_lagrangian(), before=False)
    else:
        states = (*model.coordinates, *model.rates)
        rates = [Symbol(f"rate_{x}", real=True) for x in states]
        stages = {x.name: x for x in states}
        inner = [s for s in program.interval_symbols if "_stage" in s.name]
        substitution |= {s: stages[s.name.rpartition("_stage")[0]] for s in inner}
    substitution |= dict(zip(at_nodes(states, "_k"), states, strict=True))
    substitution |= {site: x + STEP * v for site, x, v in zip(at_nodes(states, "_k1"), states, rates, strict=True)}
    return substitution | constant_controls(program), rates
