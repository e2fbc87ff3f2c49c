"""The derived discrete equations, divided by h, tend to the forced equations of motion as h -> 0.

This settles the signs of forces and potentials. The discrete side is what the module was emitted from; the continuous
side is d/dt dL/dv - dL/dq = f + G^T y with constraint forces y along the normals of holonomic constraints, Hamilton's
equations, or x' = f, put together here. Along a smooth motion their difference must vanish like h.

Shares of an interval in conditions on integrals, divided by h, tend to the integrands as h -> 0. The discrete side is
what the module was emitted from, the continuous side the author's integrand, in the quantities in which the problem is
discretised. Along a motion with a constant rate their difference must vanish like h.

Momentum matching: the discrete Euler-Lagrange equation says p_k^+ = p_k^-, and the ends match prescribed momenta. With
p_k^- = -D1 Ld(q_k, q_k1) - f- and p_k^+ = D2 Ld(q_k-1, q_k) + f+ (Marsden and West 2001, section 1.5).

What checks read of a problem of several phases: each phase as if it were a problem of its own, in time.

Switches from one phase to the next: the motion arrives as the earlier phase says, and leaves after the jump. At the
computed motion the values before the switch are put into the author's jump. Together with them the equations of the
later phase, as any of its intervals has them, must hold on the first one: those of a step, or the discrete Legendre
transform -D1 Ld - f- = p of the momentum after the jump.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.forms import rewritten
from codegen.discretise.interval import STEP, at_nodes, repeated, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Boundary, Model, prescribed
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.discretise.schemes.base import DiscreteLagrangian, Scheme, Step
from codegen.evidence.checks.base import (
    DIGITS,
    Context,
    Finding,
    does_not_apply,
    function_of,
    not_measured,
    random_points,
    vanishing,
)
from codegen.evidence.checks.layout import FlatVector, other_symbols
from codegen.evidence.checks.solution import free_values
from codegen.runtime.record import Kind
from codegen.symbolic import checks as expressions
from codegen.symbolic.special_functions import NUMPY


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


_STEPS = (mpmath.mpf(10) ** -20, mpmath.mpf(10) ** -22)
_VANISHED = 1e-15


def check_discrete_equations(context: Context) -> Iterator[Finding]:
    """Compare both sides at random states, one finding for each equation."""
    model, program = context.model.with_free_ends, context.program
    forces: list[Symbol] = []
    if program.method == "variational":
        model = legendre.lagrangian_form(model)
        names = [f"equation of motion of {q}" for q in model.coordinates]
        forces = [Symbol(f"constraint_force_{i}", real=True) for i in range(len(model.holonomic))]
        scheme = repeated(context.scheme)[1].discrete_lagrangian()
        share = weight_of_node(scheme)
        discrete = [e / share for e in _nodal(model, node_equations(program), program, forces, scheme)]
        continuous = _euler_lagrange(model, forces)
        rates: list[Symbol] = [*model.rates, *_accelerations(model), *forces]
    else:
        model = legendre.hamiltonian_form(model)
        names = [f"step of {x}" for x in (*model.coordinates, *model.rates)]
        rates = [Symbol(f"rate_{x}", real=True) for x in (*model.coordinates, *model.rates)]
        discrete = _stepwise(model, program, rates, context.scheme)
        continuous = _flow(model, rates)
    free = [parameter.symbol for parameter in model.free_parameters]
    symbols = [*model.coordinates, *model.rates, *rates, *model.controls, *model.parameters, *free, model.time]
    symbols = list(dict.fromkeys(symbols))
    points = random_points(continuous, symbols, model)
    for name, scheme_side, exact in zip(names, discrete, continuous, strict=True):
        at_h, limit = function_of([*symbols, STEP], [scheme_side]), function_of(symbols, [exact])
        gaps = []
        with mpmath.workdps(DIGITS):
            for step in _STEPS:
                differences, sizes = [], []
                for point in points:
                    numbers = [mpmath.mpf(point[symbol]) for symbol in symbols]
                    wanted = limit(*numbers)[0]
                    differences.append(abs(at_h(*numbers, step)[0] / step - wanted))
                    sizes.append(abs(wanted))
                gaps.append(max(differences) / max(sizes))
        passed = gaps[-1] < _VANISHED
        detail = f"divided by h it is the forced equation of motion, up to {float(gaps[-1]):.1g} at h = 1e-22"
        if not passed:
            detail = f"divided by h it differs from the forced equation of motion by {float(gaps[-1]):.2g} as h -> 0"
        yield Finding("discrete equations", name, bool(passed), detail)


def node_equations(program: ControlProgram | StepProgram) -> tuple[list[Expr], list[Expr]]:
    """Halves of a node's discrete Euler-Lagrange equation: -p_k of the interval after it, p_k1 of the one before it.

    In time, also where the program measures it in fractions of a free duration.
    """
    dimension = len(program.model.coordinates)
    if isinstance(program, ControlProgram):
        left = program.left_symbols[dimension : 2 * dimension]
        right = program.right_symbols[dimension : 2 * dimension]
        after, before = ([program.in_time(sympy.diff(program.element, m)) for m in side] for side in (left, right))
        return after, before
    # The last of the step's equations are p - (momentum as a function of both positions).
    momenta = [*program.left_symbols[dimension:], *program.right_symbols[dimension:]]
    equations = program.equations[-len(momenta) :]
    values = [p - equation for p, (_, equation) in zip(momenta, equations, strict=True)]
    return [-value for value in values[:dimension]], values[dimension:]


def constraint_multipliers(program: ControlProgram | StepProgram, suffix: str) -> list[Symbol]:
    """The forces along the normals of holonomic constraints at a node."""
    return list(at_nodes([Symbol(unknown.name) for unknown in program.holonomic_multipliers], suffix))


def weight_of_node(scheme: DiscreteLagrangian) -> Expr:
    """The part of the equation of motion, in units of h, that a node's equation holds; inner points hold the rest.

    It comes from the interval after the node, of which this is the first point, and the one before, of which it is the
    last.
    """

    def basis(own: Expr, c: Expr) -> Expr:
        return sympy.prod([(c - node) / (own - node) for node in scheme.nodes if node != own])

    shares = (basis(own, point.abscissa) * point.weight for point in scheme.points for own in (S.Zero, S.One))
    return sympy.expand(sympy.Add(*shares))


def inner_motion(model: Model, scheme: DiscreteLagrangian, before: bool) -> dict[Symbol, Expr]:
    """Inner points of the interval after a node at time t, or before it, on q(t + s) = q + s v + s^2 a/2."""
    substitution: dict[Symbol, Expr] = {}
    for i, c in enumerate(scheme.nodes[1:-1], start=1):
        s = STEP * (c - 1 if before else c)
        motion = zip(model.coordinates, model.rates, _accelerations(model), strict=True)
        substitution |= {
            site: x + s * w + s**2 * b / 2
            for site, (x, w, b) in zip(at_nodes(model.coordinates, f"_stage{i}"), motion, strict=True)
        }
    return substitution


def _nodal(
    model: Model,
    halves: tuple[list[Expr], list[Expr]],
    program: ControlProgram | StepProgram,
    forces: Sequence[Symbol],
    scheme: DiscreteLagrangian,
) -> list[Expr]:
    """The equations of a node on the motion q(t +- h) = q +- h v + h^2 a/2, with the node at time t."""
    after, before = halves
    q, v, a = model.coordinates, model.rates, _accelerations(model)
    left, right = at_nodes(q, "_k"), at_nodes(q, "_k1")
    earlier = [x - STEP * w + STEP**2 * b / 2 for x, w, b in zip(q, v, a, strict=True)]
    later = [x + STEP * w + STEP**2 * b / 2 for x, w, b in zip(q, v, a, strict=True)]
    controls = constant_controls(program)
    controls |= {
        site: force
        for suffix in ("_k", "_k1")
        for site, force in zip(constraint_multipliers(program, suffix), forces, strict=True)
    }
    going = {**dict(zip(left, q, strict=True)), **dict(zip(right, later, strict=True)), **controls}
    coming = {**dict(zip(left, earlier, strict=True)), **dict(zip(right, q, strict=True)), **controls}
    coming[model.time] = model.time - STEP
    going |= inner_motion(model, scheme, before=False)
    coming |= inner_motion(model, scheme, before=True)
    return [e.xreplace(going) + f.xreplace(coming) for e, f in zip(after, before, strict=True)]


def _euler_lagrange(model: Model, forces: Sequence[Symbol]) -> list[Expr]:
    """L_q - d/dt L_v + f, and the forces of holonomic constraints along their normals."""
    function, q, v, a = model.function, model.coordinates, model.rates, _accelerations(model)
    equations = []
    for x, w, f in zip(q, v, model.force, strict=True):
        momentum = sympy.diff(function, w)
        rate = sympy.diff(momentum, model.time)
        rate += sum(sympy.diff(momentum, y) * z for y, z in zip((*q, *v), (*v, *a), strict=True))
        normal = sum((y * sympy.diff(c, x) for y, c in zip(forces, model.holonomic, strict=True)), sympy.S.Zero)
        equations.append(sympy.diff(function, x) - rate + f + normal)
    return equations


def _stepwise(
    model: Model, program: ControlProgram | StepProgram, rates: Sequence[Symbol], scheme: Scheme
) -> list[Expr]:
    """What leads from the left to the right node on the motion x(t + s h) = x + s h x', for each state.

    That is the sum over the substeps of a chain; else over the updates by which the right node follows from the left
    one, of which a Runge-Kutta method has one. The substeps of a composition that is stepped are made equal.
    """
    states, equal = (*model.coordinates, *model.rates), dict[Symbol, Expr]()
    if isinstance(program, StepProgram):
        lengths, scheme = repeated(scheme)
        equal = {length: STEP / len(lengths) for length in lengths}
        equations = [equation for _, equation in program.equations]
    else:
        equations = [program.in_time(equation) for name, equation in program.equations if name == "0"]
    size, abscissae = len(states), scheme.step().abscissae
    substitution: dict[Symbol, Expr] = constant_controls(program)
    suffixes = ("_k", *(f"_stage{n}" for n in range(1, len(abscissae))), "_k1")
    for suffix, c in zip(suffixes, (S.Zero, *abscissae), strict=True):
        sites = zip(at_nodes(states, suffix), states, rates, strict=True)
        substitution |= {site: x + c * STEP * rate for site, x, rate in sites}
    leading = (
        [equations[i::size] for i in range(size)] if scheme.is_chain else _updates(scheme.step(), model, equations)
    )
    return [sum(parts, S.Zero).xreplace(substitution).xreplace(equal) for parts in leading]


def _updates(step: Step, model: Model, equations: Sequence[Expr]) -> list[list[Expr]]:
    """For each state, the equations of the updates that lead to the right node from the left one."""
    kinds = [step.positions] * len(model.coordinates) + [step.momenta] * len(model.rates)
    written = [(n, i) for n in range(len(step.positions)) for i, kind in enumerate(kinds) if kind[n]]
    number, found = {place: index for index, place in enumerate(written)}, list[list[Expr]]()
    for i, kind in enumerate(kinds):
        state, parts = len(kind), list[Expr]()
        while state and (update := kind[state - 1]):
            parts.append(equations[number[state - 1, i]])
            state = update.begin
        found.append(parts)
    return found


def _flow(model: Model, rates: Sequence[Symbol]) -> list[Expr]:
    """The left sides of q' - dH/dp = 0 and p' + dH/dq - f = 0, or of x' - f(x, u, t) = 0."""
    if model.form == "first-order":
        return [rate - f for rate, f in zip(rates, model.dynamics, strict=True)]
    half = len(model.coordinates)
    first = [rate - sympy.diff(model.function, p) for rate, p in zip(rates[:half], model.rates, strict=True)]
    pairs = zip(rates[half:], model.coordinates, model.force, strict=True)
    return first + [rate + sympy.diff(model.function, q) - f for rate, q, f in pairs]


def _accelerations(model: Model) -> list[Symbol]:
    return [Symbol(f"acceleration_{q}", real=True) for q in model.coordinates]


def constant_controls(program: ControlProgram | StepProgram) -> dict[Symbol, Expr]:
    """Constant controls, wherever they live."""
    return {site: u for u in program.model.controls for site in program.controls_of(u)}


_STEP = mpmath.mpf(10) ** -22


def check_integrals(context: Context) -> Iterator[Finding]:
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


_MATCHED = 1e-9


def check_momentum_matching(context: Context) -> Iterator[Finding]:
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
    """Impulses of holonomic constraints in half an interval: h/2 G^T kappa at its left and at its right node."""
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
