"""What checks read of a problem of several phases: each phase as if it were a problem of its own, in time.

Switches from one phase to the next: the motion arrives as the earlier phase says, and leaves after the jump. At the
computed motion the values before the switch are put into the author's jump. Together with them the equations of the
later phase, as any of its intervals has them, must hold on the first one: those of a step, or the discrete Legendre
transform -D1 Ld - f- = p of the momentum after the jump.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import sympy
from sympy import Add, Expr, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model, prescribed
from codegen.discretise.program import ControlProgram
from codegen.evidence.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.evidence.checks.flat_vector import FlatVector, other_symbols
from codegen.evidence.checks.motion import free_values
from codegen.runtime.record import Kind
from codegen.symbolic import checks as expressions
from codegen.symbolic.functions import NUMPY


def phase_contexts(context: Context) -> list[tuple[str, Context]]:
    """What to write before a subject, and the context of each phase; of a problem without phases its own context."""
    if not context.model.phases:
        return [("", context)]
    models = enumerate(context.model.phases)
    alone = [(model, phase_alone(context.control, context.model, index)) for index, model in models]
    return [
        (f"phase {number}: ", replace(context, model=model, program=program))
        for number, (model, program) in enumerate(alone, start=1)
    ]


def phase_alone(program: ControlProgram, chain: Model, index: int) -> ControlProgram:
    """The later intervals of a phase, with t and h as times of the whole problem again."""
    phase, durations = program.phases[index], [model.duration for model in chain.phases]
    begin, time = Add(*durations[:index]), chain.time
    scales = {STEP: STEP / durations[index], time: index + (time - begin) / durations[index]}

    def in_time(expression: Expr) -> Expr:
        return expression.xreplace(scales)

    return replace(
        program,
        model=chain.phases[index],
        element=in_time(phase.regular.element),
        cost=in_time(phase.regular.cost),
        equations=tuple((name, in_time(value)) for name, value in phase.equations),
        scaled_time=False,
        phases=(),
    )


_HELD = 1e-8

Numbers = dict[Symbol, float]


def check_switches(context: Context) -> Iterator[Finding]:
    """Evaluate conditions before every switch, and the equations of the interval after it."""
    if not context.model.phases:
        yield does_not_apply("switches", "there is a single phase")
        return
    program, solution = context.control, context.solution
    if solution.status != "solved":
        yield not_measured("switches", "all switches", solution.message)
        return
    steps = (solution.t.size - 1) // len(program.phases)
    for number in range(1, len(program.phases)):
        before = _before(context, number, number * steps)
        yield _arrival(context.model.phases[number - 1], before, number)
        yield _departure(context, program, before, number, number * steps)


def _before(context: Context, number: int, node: int) -> Numbers:
    """Parameters, and what the author's coordinates and rates are at a switch before it."""
    chain, solution = context.model, context.solution
    model = chain.phases[number - 1].with_free_ends
    numbers: Numbers = dict(chain.default_values) | {chain.time: float(solution.t[node])}
    symbols = (parameter.symbol for parameter in chain.free_parameters)
    numbers |= dict(zip(symbols, map(float, free_values(context.module, solution)), strict=True))
    numbers |= dict(zip(model.coordinates, map(float, solution.q[node]), strict=True))
    momenta = map(float, solution.p[node][: len(model.rates)])
    if model.form != "lagrangian":
        return numbers | dict(zip(model.rates, momenta, strict=True))
    known = numbers | dict(zip(legendre.conjugate_symbols(model), momenta, strict=True))
    velocities = (_number(v, known) for v in legendre.velocity_of_momentum(model))
    return numbers | dict(zip(model.rates, velocities, strict=True))


def _arrival(model: Model, before: Numbers, number: int) -> Finding:
    """What a phase says of its end."""
    conditions = {
        f"{symbol} = {sympy.sstr(value)}": symbol - value for symbol, value in prescribed(model, "end").items()
    }
    conditions |= {c.name: c.expression for c in model.end_conditions if c.equality}
    errors = {name: abs(_number(value, before)) for name, value in conditions.items()}
    subject = f"switch {number}, before it"
    if not errors:
        return Finding("switches", subject, True, f"phase {number} says nothing of its end")
    worst = max(errors, key=lambda name: errors[name])
    passed = errors[worst] <= _HELD * max(1.0, *map(abs, before.values()))
    return Finding("switches", subject, passed, f"{', '.join(errors)}: up to {errors[worst]:.1g}")


def _departure(context: Context, program: ControlProgram, before: Numbers, number: int, node: int) -> Finding:
    """The equations of the later phase with the values after the jump."""
    chain, module, solution = context.model, context.module, context.solution
    after = before | {symbol: _number(value, before) for symbol, value in chain.jumps[number - 1]}
    model, alone = chain.phases[number], phase_alone(program, chain, number)
    momenta = dict[str, float]()
    if model.form == "lagrangian":
        slopes = [_number(sympy.diff(model.function, v), after) for v in model.rates]
        momenta = {f"p_{q}": slope for q, slope in zip(model.coordinates, slopes, strict=True)}
    values = {symbol.name: value for symbol, value in after.items()} | momenta
    flat = FlatVector(program, solution.t.size - 1)
    unknowns = solution.unknowns[flat.element(0, node)]
    for index, unknown in enumerate(program.node):
        if not unknown.multiplier:
            unknowns[index] = values.get(unknown.name, unknowns[index])
    step = float(solution.t[node + 1] - solution.t[node])
    given = module.make_grid((solution.t.size - 1) // len(program.phases)).parameters[0]
    others = [*given[: len(other_symbols(program)) - 2], float(solution.t[node]), step]
    momentum_of = [values[p] for p in _momentum_names(model)] if program.method == "variational" else []
    found = sympy.lambdify([*alone.element_symbols, *other_symbols(program)], _equations(alone), NUMPY)
    residuals = np.array(found(*unknowns, *others), dtype=float)
    residuals[: len(momentum_of)] += momentum_of
    error = float(np.abs(residuals).max())
    passed = error <= _HELD * max(1.0, float(np.abs(unknowns).max()))
    jump = ", ".join(f"{symbol} -> {sympy.sstr(value)}" for symbol, value in chain.jumps[number - 1]) or "no jump"
    detail = f"{jump}: the next interval begins with these values, up to {error:.1g}"
    if not passed:
        detail = f"{jump}: the equations of the next interval do not hold with these values, by {error:.2g}"
    return Finding("switches", f"switch {number}, after it", passed, detail)


def _momentum_names(model: Model) -> list[str]:
    return [rate.name if model.form == "hamiltonian" else f"p_{q}" for q, rate in zip(model.coordinates, model.rates)]


def _equations(program: ControlProgram) -> list[Expr]:
    """-p_k of an interval, or the equations of its step: what their multipliers multiply."""
    if program.method == "variational":
        size = len(program.model.coordinates)
        multipliers = program.left_symbols[size : 2 * size]
    else:
        pairs = zip(program.interval, program.interval_symbols, strict=True)
        multipliers = tuple(symbol for u, symbol in pairs if u.kind is Kind.STEP)
    return [sympy.diff(program.element, multiplier) for multiplier in multipliers]


def _number(expression: Expr, at: Mapping[Symbol, Any]) -> float:
    """A number that is infinite where the expression has no value."""
    value = expressions.rounded_at(expression, at)
    return float("inf") if value is None else value
