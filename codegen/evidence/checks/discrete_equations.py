"""Checks of the discrete equations against the continuous problem: nodes, steps, integrals, momenta and switches.

Divided by h, the discrete equations must tend to the forced equations of motion as h -> 0. This fixes the signs of
forces and potentials. The discrete side is the source of the module. The continuous side is derived independently: the
Euler-Lagrange equations d/dt dL/dv - dL/dq = f + G^T y, Hamilton's equations, or x' = f. The constraint forces y act
along the normals of constraints. Along a smooth motion both sides differ by O(h). In the same way an interval's term of
an integral condition, divided by h, must tend to the author's integrand.

Momentum matching: the discrete Euler-Lagrange equation is p_k^+ = p_k^- (Marsden and West 2001, section 1.5). The
momenta are p_k^- = -D1 Ld(q_k, q_k1) - f- and p_k^+ = D2 Ld(q_k-1, q_k) + f+. The ends match prescribed momenta.

Switches: the solution must satisfy the end conditions of the earlier phase before a switch. The author's jump then
gives the values after the switch. The first interval of the later phase must satisfy the equations of a step with these
values. For a discrete Lagrangian these are the Legendre transforms -D1 Ld - f- = p of the momentum after the jump.

Rotations: the momenta of a step are the derivatives of the discrete action along rotations of one end in the frame of
the body. The action is evaluated from the author's L(q, dq), in 120 digits: the attitude moves between two quaternions
with the angular velocity of the retraction tan(angle/4) = |h w|/4. No formula of `discretise.rotations` is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import mpmath
import numpy as np
import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.forms import rewritten
from codegen.discretise.interval import STEP, at_nodes, repeated, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import CanonicalPairs, Model, prescribed
from codegen.discretise.program import ControlProgram, StepProgram, in_scales
from codegen.discretise.schemes.base import DiscreteLagrangian, Scheme, Step
from codegen.evidence.checks.base import (
    DIGITS,
    Agreement,
    Context,
    Finding,
    Point,
    does_not_apply,
    function_of,
    not_measured,
    random_points,
)
from codegen.evidence.checks.layout import FlatVector, other_symbols
from codegen.evidence.checks.solution import data_at_solution
from codegen.problem.rotations import conjugate, product
from codegen.runtime.record import Kind
from codegen.symbolic import checks as expressions
from codegen.symbolic.functions import NUMPY
from codegen.symbolic.zeros import identically_zero

_STEP = mpmath.mpf(10) ** -22
_VANISHED = 1e-15


def phase_contexts(context: Context) -> list[tuple[str, Context]]:
    """Return (prefix of subjects in findings, context) for each phase, as if the phase were a separate problem.

    A problem without phases has one context and an empty prefix.
    """
    if not context.model.phases:
        return [("", context)]
    return [
        (f"phase {i + 1}: ", replace(context, model=model, program=_phase_alone(context.control, context.model, i)))
        for i, model in enumerate(context.model.phases)
    ]


def _phase_alone(program: ControlProgram, chain: Model, index: int) -> ControlProgram:
    """Return the program of a phase for all intervals but its first, with t and h in physical time."""
    phase, durations = program.phases[index], [model.duration for model in chain.phases]
    begin, time = Add(*durations[:index]), chain.time
    scales = {STEP: STEP / durations[index], time: index + (time - begin) / durations[index]}
    return replace(
        program,
        model=chain.phases[index],
        element=phase.regular.element.xreplace(scales),
        cost=phase.regular.cost.xreplace(scales),
        equations=in_scales(phase.equations, scales),
        scaled_time=False,
        phases=(),
    )


def check_discrete_equations(context: Context) -> Iterator[Finding]:
    """Check at random states that each discrete equation, divided by h, tends to its continuous equation as h -> 0."""
    model, program = context.model.with_free_ends, context.program
    if isinstance(program, StepProgram) and model.rotations:
        reason = "those of rotations are in the frames of the bodies; `momentum matching` compares them"
        yield does_not_apply("discrete equations", reason)
        return
    if program.method == "variational":
        model = legendre.lagrangian_form(model)
        names = [f"equation of motion of {q}" for q in model.coordinates]
        discrete, continuous, rates = _node_sides(model, program, repeated(context.scheme)[1].discrete_lagrangian())
    else:
        model = legendre.hamiltonian_form(model)
        names = [f"step of {x}" for x in (*model.coordinates, *model.rates)]
        discrete, continuous, rates = _step_sides(model, program, context.scheme)
    free = [parameter.symbol for parameter in model.free_parameters]
    symbols = [*model.coordinates, *model.rates, *rates, *model.controls, *model.parameters, *free, model.time]
    symbols = list(dict.fromkeys(symbols))
    points = random_points(continuous, symbols, model)
    for name, at_h, limit in zip(names, discrete, continuous, strict=True):
        differences, sizes = zip(*_differences([at_h / STEP], limit, symbols, points, _STEP), strict=True)
        gap = max(differences) / max(sizes)
        right = f"divided by h it is the forced equation of motion, up to {float(gap):.1g} at h = 1e-22"
        wrong = f"divided by h it differs from the forced equation of motion by {float(gap):.2g} as h -> 0"
        yield Finding.decided("discrete equations", name, gap < _VANISHED, right, wrong)


def _differences(
    values: Sequence[Expr], limit: Expr, symbols: Sequence[Symbol], points: Sequence[Point], h: mpmath.mpf
) -> list[tuple[mpmath.mpf, mpmath.mpf]]:
    """Return for every point the largest difference of `values` at the step h from their limit, and its modulus."""
    function, exact, pairs = function_of([*symbols, STEP], values), function_of(symbols, [limit]), []
    with mpmath.workdps(DIGITS):
        for point in points:
            numbers = [mpmath.mpf(point[symbol]) for symbol in symbols]
            expected = exact(*numbers)[0]
            pairs.append((max(abs(value - expected) for value in function(*numbers, h)), abs(expected)))
    return pairs


_Sides = tuple[list[Expr], list[Expr], list[Symbol]]
"""The discrete sides of equations, their continuous limits, and the symbols of rates (x') of a smooth motion."""


def _node_sides(model: Model, program: ControlProgram | StepProgram, scheme: DiscreteLagrangian) -> _Sides:
    """Return both sides of the equations of a node at time t, along the motion q(t +- h) = q +- h v + h^2 a/2."""
    q, v = model.coordinates, model.rates
    a = [Symbol(f"acceleration_{x}", real=True) for x in q]
    forces = [Symbol(f"constraint_force_{i}", real=True) for i in range(len(_normals(model)))]

    def shifted(s: Expr) -> list[Expr]:
        return [x + s * w + s**2 * b / 2 for x, w, b in zip(q, v, a, strict=True)]

    # The interval after the node, and the interval before the node.
    sides = []
    for half, begin in zip(_node_equations(program), (S.Zero, -STEP), strict=True):
        motion = _constant_controls(program)
        for suffix in ("_k", "_k1"):
            motion |= dict(zip(_constraint_multipliers(program, suffix), forces, strict=True))
        instants = tuple(begin + c * STEP for c in scheme.nodes)
        motion |= _along(q, instants, shifted)
        motion[model.time] = model.time + begin
        sides.append([equation.xreplace(motion) for equation in half])

    # The weight (in units of h) of a node's equation in the equation of motion; inner points have the other weights.
    # The node is the first point of one interval and the last point of the other.
    def basis(node: Expr, c: Expr) -> Expr:
        return sympy.prod([(c - other) / (node - other) for other in scheme.nodes if other != node])

    shares = (basis(node, point.abscissa) * point.weight for point in scheme.points for node in (S.Zero, S.One))
    weight = sympy.expand(sympy.Add(*shares))
    discrete = [(after + before) / weight for after, before in zip(*sides, strict=True)]

    continuous = []
    for i, (x, w, f) in enumerate(zip(q, v, model.force, strict=True)):
        momentum = sympy.diff(model.function, w)
        rate = sympy.diff(momentum, model.time)
        rate += sum(sympy.diff(momentum, y) * z for y, z in zip((*q, *v), (*v, *a), strict=True))
        normal = sum((y * row[i] for y, row in zip(forces, _normals(model), strict=True)), S.Zero)
        normal += sum((force * row[i] for force, row in _contact_forces(model)), S.Zero)
        continuous.append(sympy.diff(model.function, x) - rate + f + normal)
    return discrete, continuous, [*v, *a, *forces]


def _node_equations(program: ControlProgram | StepProgram) -> tuple[list[Expr], list[Expr]]:
    """Return both terms of a node's discrete Euler-Lagrange equation: -p_k of the next interval, p_k1 of the previous.

    Both are in physical time, even if the program measures time in fractions of a free duration.
    """
    dimension = len(program.model.coordinates)
    if isinstance(program, ControlProgram):
        left = program.left_symbols[dimension : 2 * dimension]
        right = program.right_symbols[dimension : 2 * dimension]
        after, before = ([program.in_time(sympy.diff(program.element, m)) for m in side] for side in (left, right))
        return after, before
    # The last equations of a step are p - (momentum as a function of both positions).
    momenta = [*program.left_symbols[dimension:], *program.right_symbols[dimension:]]
    equations = program.equations[-len(momenta) :]
    values = [p - equation for p, (_, equation) in zip(momenta, equations, strict=True)]
    return [-value for value in values[:dimension]], values[dimension:]


def _contact_forces(model: Model) -> Iterator[tuple[Symbol, list[Expr]]]:
    """Yield pairs of a contact force and its direction: the gradient of a gap, or the coefficients of a velocity."""
    for contact in model.contacts:
        yield contact.normal, [sympy.diff(contact.expression, q) for q in model.coordinates]
        for friction, slip in zip(contact.tangential, contact.slips, strict=True):
            yield friction, [sympy.diff(slip, v) for v in model.rates]


def _normals(model: Model) -> list[list[Expr]]:
    """Return the row of each constraint along which its force acts: dc/dq, or the coefficients A of A v + b = 0."""
    rows = [[sympy.diff(c, q) for q in model.coordinates] for c in model.holonomic]
    return rows + [[sympy.diff(c, v).subs(dict.fromkeys(model.rates, 0)) for v in model.rates] for c in model.rolling]


def _constraint_multipliers(program: ControlProgram | StepProgram, suffix: str) -> list[Symbol]:
    """Return the symbols of the constraint forces at the left (`suffix` _k) or right node (_k1) of an interval."""
    return list(at_nodes([Symbol(unknown.name) for unknown in program.holonomic_multipliers], suffix))


def _along(
    symbols: Sequence[Symbol], abscissae: Sequence[Expr], at: Callable[[Expr], list[Expr]]
) -> dict[Symbol, Expr]:
    """Map each symbol at the left node, the stages and the right node to its value `at(c)` at the abscissa c there."""
    suffixes = ("_k", *(f"_stage{i}" for i in range(1, len(abscissae) - 1)), "_k1")
    pairs = zip(suffixes, abscissae, strict=True)
    return {site: x for suffix, c in pairs for site, x in zip(at_nodes(symbols, suffix), at(c), strict=True)}


def _straight(symbols: Sequence[Symbol], rates: Sequence[Symbol], c: Expr) -> list[Expr]:
    """Return the values x + c h x' of a straight motion, for each symbol x."""
    return [x + c * STEP * rate for x, rate in zip(symbols, rates, strict=True)]


def _constant_controls(program: ControlProgram | StepProgram) -> dict[Symbol, Expr]:
    """Map every symbol of a control at a node, interval or stage to the control itself, as a constant."""
    return {site: u for u in program.model.controls for site in program.controls_of(u)}


def _step_sides(model: Model, program: ControlProgram | StepProgram, scheme: Scheme) -> _Sides:
    """Return both sides of the equations of a step, for each state, along the motion x(t + s h) = x + s h x'.

    For a chain of substeps the discrete side is the sum over all substeps. For other schemes it is the sum over the
    updates from the left to the right node; a Runge-Kutta method has one. Substeps of a composition get equal lengths.
    """
    states, equal = (*model.coordinates, *model.rates), dict[Symbol, Expr]()
    rates = [Symbol(f"rate_{x}", real=True) for x in states]
    if isinstance(program, StepProgram):
        lengths, scheme = repeated(scheme)
        equal = {length: STEP / len(lengths) for length in lengths}
        equations = [equation for _, equation in program.equations]
    else:
        equations = [program.in_time(e.value) for e in program.equations if str(e) == "0"]
    size, step = len(states), scheme.step()
    if model.linear and model.linear.pairs:
        return _pairs_sides(states, rates, equations, step, model, model.linear.pairs, equal)
    motion: dict[Symbol, Expr] = _constant_controls(program)
    motion |= _along(states, (S.Zero, *step.abscissae), partial(_straight, states, rates))
    if scheme.is_chain:
        sums = [equations[i::size] for i in range(size)]
    else:
        kinds = [step.positions] * len(model.coordinates) + [step.momenta] * len(model.rates)
        written = [(n, i) for n in range(len(step.positions)) for i, kind in enumerate(kinds) if kind[n]]
        number, sums = {update: index for index, update in enumerate(written)}, list[list[Expr]]()
        for i, kind in enumerate(kinds):
            state, parts = len(kind), list[Expr]()
            while state and (update := kind[state - 1]):
                parts.append(equations[number[state - 1, i]])
                state = update.begin
            sums.append(parts)
    discrete = [sum(parts, S.Zero).xreplace(motion).xreplace(equal) for parts in sums]

    if model.form == "first-order":  # x' - f(x, u, t) = 0
        return discrete, [rate - f for rate, f in zip(rates, model.dynamics, strict=True)], rates
    half = len(model.coordinates)  # q' - dH/dp = 0 and p' + dH/dq - f = 0
    continuous = [rate - sympy.diff(model.function, p) for rate, p in zip(rates[:half], model.rates, strict=True)]
    pairs = zip(rates[half:], model.coordinates, model.force, strict=True)
    continuous += [rate + sympy.diff(model.function, q) - f for rate, q, f in pairs]
    return discrete, continuous, rates


def _pairs_sides(
    states: Sequence[Symbol],
    rates: list[Symbol],
    equations: Sequence[Expr],
    step: Step,
    model: Model,
    pairs: CanonicalPairs,
    equal: Mapping[Symbol, Expr],
) -> _Sides:
    """Return both sides of the last equations of a step in canonical pairs: x' - velocity, and dp/dt - slope."""
    instants = (S.Zero, *(point.abscissa for point in step.points), step.abscissae[-1])
    motion = _along(states, instants, partial(_straight, states, rates))
    limits = {}
    for x, velocity in zip(pairs.positions, pairs.velocities, strict=True):
        limits[x] = rates[states.index(x)] - velocity
    for y, p, slope in zip(pairs.partners, pairs.momenta, pairs.slopes, strict=True):
        along = Add(*(sympy.diff(p, x) * rate for x, rate in zip(states, rates, strict=True)))
        limits[y] = sympy.diff(p, model.time) + along - slope
    discrete = [e.xreplace(motion).xreplace(equal) for e in equations[-len(states) :]]
    return discrete, [limits[x] for x in states], rates


def check_integrals(context: Context) -> Iterator[Finding]:
    """Check at random states that an interval's term of each integral, divided by h, tends to the integrand."""
    original = context.control.model  # the model of a phase is as its author wrote it
    transform = legendre.lagrangian_form if context.control.method == "variational" else legendre.hamiltonian_form
    model = rewritten(original, transform(original.with_free_ends))
    program = replace(context.control, model=model)

    # The unknowns of an interval on a motion with constant rates and controls.
    motion = _constant_controls(program)
    if program.method == "variational":
        rates, nodes = list(model.rates), repeated(context.scheme)[1].discrete_lagrangian().nodes
        motion |= _along(model.coordinates, nodes, partial(_straight, model.coordinates, rates))
    else:
        states = (*model.coordinates, *model.rates)
        rates, by_name = [Symbol(f"rate_{x}", real=True) for x in states], {x.name: x for x in states}
        inner = [s for s in program.interval_symbols if "_stage" in s.name]
        motion |= {s: by_name[s.name.rpartition("_stage")[0]] for s in inner}
        motion |= _along(states, (S.Zero, S.One), partial(_straight, states, rates))
    symbols = [*model.coordinates, *model.rates, *rates, *model.controls, *model.parameters, model.time]
    symbols = list(dict.fromkeys([*symbols, *(free.symbol for free in model.free_parameters)]))
    equations = {equation.left: equation.value for equation in program.equations}
    for number, integral in enumerate(model.integrals, start=1):
        quadrature = program.in_time(equations[f"Gd_{number}"]).xreplace(motion)
        points = random_points([integral.expression], symbols, model)
        pairs = _differences([quadrature / STEP], integral.expression, symbols, points, _STEP)
        gap = max(difference / max(1, size) for difference, size in pairs)
        passed = gap < _VANISHED
        verb = "is" if passed else "differs from"
        detail = f"divided by h an interval's share {verb} the integrand, up to {float(gap):.1g} at h = 1e-22"
        yield Finding("integrals", str(integral), bool(passed), detail)


_MATCHED = 1e-9


def check_momentum_matching(context: Context) -> Iterator[Finding]:
    """Check p_k^+ = p_k^- symbolically, the signs of both momenta, and the momenta of the solution at both ends."""
    program = context.program
    if program.method != "variational":
        yield does_not_apply("momentum matching", f"the {program.method} method has no discrete Lagrangian")
        return
    if isinstance(program, StepProgram) and context.model.rotations:
        yield from check_rotating_momenta(context, program)
        return
    for phase, part in phase_contexts(context):
        for finding in _matching(part):
            yield replace(finding, subject=f"{phase}{finding.subject}")
    if not isinstance(program, ControlProgram):
        return
    # Compare momenta of the solution at its ends with dL/dv at the prescribed positions and velocities.
    model, solution, width = context.model, context.solution, len(context.model.coordinates)
    phases = model.phases or (model,)
    first = legendre.lagrangian_form(phases[0])
    last = legendre.lagrangian_form(replace(phases[-1], duration=model.duration))
    assert last.end is not None
    if solution.status != "solved":
        yield not_measured("momentum matching", "momenta at the ends", solution.message)
        return
    data = data_at_solution(context)
    for where, side, boundary, row in (("start", first, first.start, 0), ("end", last, last.end, -1)):
        instant, errors = 0.0 if where == "start" else float(solution.t[-1]), dict[str, float]()
        boundary_values = (*boundary.positions, *boundary.rates)
        for body in range(model.bodies):
            of_body = f" of body {body}" if model.bodies > 1 else ""
            values = data | ({model.body: body} if model.body is not None else {})
            pairs = zip((*side.coordinates, *side.rates), boundary_values, strict=True)
            states = {side.time: instant} | {s: value.subs(values) for s, value in pairs if value is not None}
            for i, (q, v) in enumerate(zip(side.coordinates, side.rates, strict=True)):
                momentum = sympy.diff(side.function, v).subs(states).subs(values)
                if boundary.rates[i] is not None and not momentum.free_symbols:
                    p = float(np.float64(momentum.evalf()))
                    errors[f"{q.name}{of_body}"] = abs(float(solution.p[row, body * width + i]) - p) / max(1.0, abs(p))
        if not errors:
            continue
        worst = max(errors, key=lambda name: errors[name])
        right = f"the solution's momenta are those of the prescribed velocities, up to {errors[worst]:.1g}"
        wrong = f"momentum of {worst} differs by {errors[worst]:.2g} from that of the prescribed velocity"
        passed = errors[worst] < _MATCHED
        yield Finding.decided("momentum matching", f"momenta at the {where}", passed, right, wrong)


def _matching(context: Context) -> Iterator[Finding]:
    """Compare node equations with the gradient of the action, and discrete momenta with dL/dv as h -> 0."""
    model = legendre.lagrangian_form(context.model.with_free_ends)
    interval = variational_interval(model, repeated(context.scheme)[1], context.choices.controls)
    after, before = _node_equations(context.program)
    # Impulses of constraints in half an interval: h/2 G^T kappa at the left and at the right node.
    impulses = []
    for suffix, instant in (("_k", model.time), ("_k1", model.time + STEP)):
        node = dict(zip(model.coordinates, at_nodes(model.coordinates, suffix), strict=True)) | {model.time: instant}
        pairs = list(zip(_constraint_multipliers(context.program, suffix), _normals(model), strict=True))
        count = range(len(model.coordinates))
        impulses.append([sum((STEP / 2 * y * row[i].xreplace(node) for y, row in pairs), S.Zero) for i in count])
        if suffix == "_k":  # contact impulses act at the left node
            node |= dict(zip(model.controls, at_nodes(model.controls, "_k"), strict=True))
            for force, row in _contact_forces(model):
                impulses[0] = [
                    p + (STEP * force * row[i]).xreplace(node) for p, i in zip(impulses[0], count, strict=True)
                ]
    for i, q in enumerate(model.coordinates):
        minus = -sympy.diff(interval.lagrangian, interval.q.left[i]) - interval.force_minus[i] - impulses[0][i]
        plus = sympy.diff(interval.lagrangian, interval.q.right[i]) + interval.force_plus[i] + impulses[1][i]
        passed = identically_zero(before[i] - plus) and identically_zero(after[i] + minus)
        right = "its discrete Euler-Lagrange equation is p_k^+ - p_k^- = 0, proved symbolically"
        wrong = "its emitted equation is not p_k^+ - p_k^- = 0 with p_k^- = -D1 Ld - f-, p_k^+ = D2 Ld + f+"
        yield Finding.decided("momentum matching", f"node equation of {q}", passed, right, wrong)

    # Both discrete momenta tend to dL/dv as h -> 0. A wrong sign is visible here.
    v = model.rates
    nodes = repeated(context.scheme)[1].discrete_lagrangian().nodes
    motion = _constant_controls(context.program)
    motion |= _along(model.coordinates, nodes, partial(_straight, model.coordinates, v))
    free = [parameter.symbol for parameter in model.free_parameters]
    forces = [s for suffix in ("_k", "_k1") for s in _constraint_multipliers(context.program, suffix)]
    symbols = [*model.coordinates, *v, *model.controls, *model.parameters, *free, *forces, model.time]
    for i, x in enumerate(model.coordinates):
        momentum = sympy.diff(model.function, v[i])
        points = random_points([momentum, *model.force], symbols, model, count=2)
        both = [e.xreplace(motion) for e in (-after[i], before[i])]
        gaps = _differences(both, momentum, symbols, points, mpmath.mpf(10) ** -20)
        worst = max(difference / (1 + modulus) for difference, modulus in gaps)
        right = f"-D1 Ld - f- and D2 Ld + f+ tend to dL/d{v[i]} as h -> 0"
        wrong = f"-D1 Ld - f- and D2 Ld + f+ do not both tend to dL/d{v[i]}: off by {float(worst):.2g}"
        yield Finding.decided("momentum matching", f"discrete momenta of {x}", worst < 1e-10, right, wrong)


_HELD = 1e-8

Numbers = dict[Symbol, float]


def check_switches(context: Context) -> Iterator[Finding]:
    """Check at the solution the end conditions before every switch, and the equations of the interval after it."""
    if not context.model.phases:
        yield does_not_apply("switches", "there is a single phase")
        return
    program, solution = context.control, context.solution
    if solution.status != "solved":
        yield not_measured("switches", "all switches", solution.message)
        return
    chain, steps = context.model, (solution.t.size - 1) // len(program.phases)
    flat, parameters = FlatVector(program, solution.t.size - 1), context.module.make_grid(steps).parameters[0]
    for number in range(1, len(program.phases)):
        # Parameters, and the author's coordinates and rates before the switch.
        node = number * steps
        earlier = chain.phases[number - 1].with_free_ends
        numbers: Numbers = data_at_solution(context) | {chain.time: float(solution.t[node])}
        numbers |= dict(zip(earlier.coordinates, map(float, solution.q[node]), strict=True))
        momenta = list(map(float, solution.p[node][: len(earlier.rates)]))
        if earlier.form != "lagrangian":
            before = numbers | dict(zip(earlier.rates, momenta, strict=True))
        else:
            phase_space = numbers | dict(zip(legendre.conjugate_symbols(earlier), momenta, strict=True))
            velocities = (_number(v, phase_space) for v in legendre.velocity_of_momentum(earlier))
            before = numbers | dict(zip(earlier.rates, velocities, strict=True))
        # Evaluate the conditions at the end of the earlier phase.
        ends = prescribed(chain.phases[number - 1], "end").items()
        conditions = {f"{symbol} = {sympy.sstr(value)}": symbol - value for symbol, value in ends}
        conditions |= {c.name: c.expression for c in chain.phases[number - 1].end_conditions if c.equality}
        errors = [abs(_number(value, before)) for value in conditions.values()]
        passed, detail = True, f"phase {number} says nothing of its end"
        if errors:
            passed = max(errors) <= _HELD * max(1.0, *map(abs, before.values()))
            detail = f"{', '.join(conditions)}: up to {max(errors):.1g}"
        yield Finding("switches", f"switch {number}, before it", passed, detail)
        # Evaluate the equations of the first interval of the later phase with the values after the jump.
        jumps = chain.jumps[number - 1]
        after = before | {symbol: _number(value, before) for symbol, value in jumps}
        model, alone = chain.phases[number], _phase_alone(program, chain, number)
        values = {symbol.name: value for symbol, value in after.items()}
        if model.form == "lagrangian":
            slopes = [_number(sympy.diff(model.function, v), after) for v in model.rates]
            values |= {f"p_{q}": slope for q, slope in zip(model.coordinates, slopes, strict=True)}
        unknowns = solution.unknowns[flat.element(0, node)]
        # Forces of constraints at the node, where the later phase has other ones than the earlier phase.
        size, lacking = len(program.node), program.phases[number].elements[0].lacking
        forces = {
            u.meaning.of: unknowns[size + i]
            for i, u in enumerate(program.interval)
            if u.kind is Kind.SWITCH_FORCE and i not in lacking
        }
        values |= {u.name: forces[u.meaning.of] for u in program.node if u.meaning.of in forces and not u.multiplier}
        for index, unknown in enumerate(program.node):
            if not unknown.multiplier:
                unknowns[index] = values.get(unknown.name, unknowns[index])
        step = float(solution.t[node + 1] - solution.t[node])
        others = [*parameters[: len(other_symbols(program)) - 2], float(solution.t[node]), step]
        # The factors of multipliers in the Lagrangian: -p_k of an interval, or the equations of a step.
        momenta = []
        if program.method == "variational":
            size = len(model.coordinates)
            multipliers = alone.left_symbols[size : 2 * size]
            names = [p.name for p in model.rates]
            if model.form != "hamiltonian":
                names = [f"p_{q}" for q in model.coordinates]
            momenta = [values[name] for name in names]
        else:
            kinds = zip(alone.interval, alone.interval_symbols, strict=True)
            multipliers = tuple(symbol for u, symbol in kinds if u.kind is Kind.STEP)
        equations = [sympy.diff(alone.element, multiplier) for multiplier in multipliers]
        function = sympy.lambdify([*alone.element_symbols, *other_symbols(program)], equations, NUMPY)
        residuals = np.array(function(*unknowns, *others), dtype=float)
        residuals[: len(momenta)] += momenta
        error = float(np.abs(residuals).max())
        passed = error <= _HELD * max(1.0, float(np.abs(unknowns).max()))
        jump = ", ".join(f"{symbol} -> {sympy.sstr(value)}" for symbol, value in jumps) or "no jump"
        right = f"{jump}: the next interval begins with these values, up to {error:.1g}"
        wrong = f"{jump}: the equations of the next interval do not hold with these values, by {error:.2g}"
        yield Finding.decided("switches", f"switch {number}, after it", passed, right, wrong)


def _number(expression: Expr, at: Mapping[Symbol, float]) -> float:
    """Return the value of an expression at the numbers `at`; infinity if it has no value."""
    value = expressions.rounded_at(expression, at)
    return float("inf") if value is None else value


# ---- Rotations ----

_INCREMENT = mpmath.mpf(10) ** -40
_POINTS = 3
_LENGTH, _TIME = mpmath.mpf("0.1"), mpmath.mpf("0.3")  # the step length h and the time at the left node
Node = Mapping[Symbol, mpmath.mpf]  # the numbers of all coordinates at a node
Quaternion = tuple[Symbol, ...]


def check_rotating_momenta(context: Context, program: StepProgram) -> Iterator[Finding]:
    """Compare the equations for momenta at both nodes with the derivatives of the discrete action."""
    model = legendre.lagrangian_form(context.model.with_free_ends)
    if any(model.force) or len(model.holonomic) > len(model.rotations):
        reason = "forces and joints are no part of the discrete action; `problem as written` compares the motion"
        yield does_not_apply("momentum matching", reason)
        return
    action = _Action(model, repeated(context.scheme)[1].discrete_lagrangian())
    symbols = [*program.left_symbols, *program.stage_symbols, *program.right_symbols, STEP, *program.lengths]
    symbols = list(dict.fromkeys([*symbols, model.time, *model.parameters]))
    equations = dict(program.equations)
    values = function_of(symbols, list(equations.values()))
    generator, agreement = np.random.default_rng(5), Agreement(check="momentum matching")
    for _ in range(_POINTS):
        with mpmath.workdps(DIGITS):
            left, right = _random_nodes(model, generator)
            # With all momenta zero, the equations are the negative momenta of the discrete action.
            at: dict[Symbol, mpmath.mpf] = dict.fromkeys(symbols, mpmath.mpf(0))
            at |= dict(zip(program.left_symbols, left.values(), strict=False))
            at |= dict(zip(program.right_symbols, right.values(), strict=False))
            # Forces of rolling constraints follow the rates, and are zero like the momenta.
            at |= dict(zip(program.stage_symbols, action.rates(left, right), strict=False))
            at |= dict(zip(model.parameters, action.parameters, strict=True)) | {model.time: _TIME}
            at |= dict.fromkeys((STEP, *program.lengths), _LENGTH)
            found = dict(zip(equations, values(*(at[s] for s in symbols)), strict=True))
            exact = dict(action.momenta(left, right, program.stage_symbols))
            agreement.compare(list(exact), [float(found[name]) for name in exact], list(exact.values()))
    yield agreement.finding("momenta of rotations", "derivatives of the discrete action along rotations")


def _random_nodes(model: Model, generator: np.random.Generator) -> tuple[Node, Node]:
    """Return two near nodes, whose quaternions have length one."""
    first, second = ([mpmath.mpf(float(x)) for x in generator.uniform(-1, 1, len(model.coordinates))] for _ in "01")
    left: dict[Symbol, mpmath.mpf] = dict(zip(model.coordinates, first, strict=True))
    right = {q: x + y / 4 for (q, x), y in zip(left.items(), second, strict=True)}
    for side in (left, right):
        for quaternion in model.rotations:
            side.update(zip(quaternion, _unit([side[q] for q in quaternion]), strict=True))
    return left, right


def _unit(vector: Sequence[mpmath.mpf]) -> list[mpmath.mpf]:
    length = mpmath.sqrt(sum(part**2 for part in vector))
    return [part / length for part in vector]


def _turn(quaternion: Quaternion, left: Node, right: Node) -> list[mpmath.mpf]:
    """Return b, tan(angle/4) times the axis of the rotation from the left to the right node."""
    c = product(conjugate([left[q] for q in quaternion]), [right[q] for q in quaternion])
    return [part / (1 + c[0]) for part in c[1:]]


class _Action:
    """The discrete Lagrangian as a function of two nodes."""

    def __init__(self, model: Model, rule: DiscreteLagrangian) -> None:
        self.model, self.rule = model, rule
        turning = {q for quaternion in model.rotations for q in quaternion}
        self.places = [x for x in model.coordinates if x not in turning]
        self.parameters = [mpmath.mpf(x) for x in model.defaults]
        symbols = [*model.coordinates, *model.rates, model.time, *model.parameters]
        self.lagrangian = function_of(symbols, [model.function])

    def rates(self, left: Node, right: Node) -> list[mpmath.mpf]:
        """Return the velocities of positions and the angular velocities of a step."""
        velocities = [(right[x] - left[x]) / _LENGTH for x in self.places]
        turns = (part for quaternion in self.model.rotations for part in _turn(quaternion, left, right))
        return [*velocities, *(4 * part / _LENGTH for part in turns)]

    def of(self, left: Node, right: Node) -> mpmath.mpf:
        """Return the discrete Lagrangian."""
        total = mpmath.mpf(0)
        for point in self.rule.points:
            c = mpmath.mpf(point.abscissa.p) / point.abscissa.q
            here = {x: left[x] + c * (right[x] - left[x]) for x in self.places}
            rates = {x: (right[x] - left[x]) / _LENGTH for x in self.places}
            for quaternion in self.model.rotations:
                b = _turn(quaternion, left, right)
                factor = {0: (1, 0, 0, 0), 1: (1 - sum(x**2 for x in b), *(2 * x for x in b))}.get(c, (1, *b))
                at = _unit(product([left[q] for q in quaternion], factor))
                moving = product(at, (0, *(2 * x / _LENGTH for x in b)))
                here |= dict(zip(quaternion, at, strict=True))
                rates |= dict(zip(quaternion, moving, strict=True))
            state = [*(here[q] for q in self.model.coordinates), *(rates[q] for q in self.model.coordinates)]
            weight = _LENGTH * point.weight.p / point.weight.q
            total += weight * self.lagrangian(*state, _TIME + c * _LENGTH, *self.parameters)[0]
        return total

    def momenta(self, left: Node, right: Node, stages: Sequence[Symbol]) -> Iterator[tuple[str, mpmath.mpf]]:
        """Yield the names of the equations for momenta, and the negative momenta."""

        def slope(end: int, moved: Callable[[mpmath.mpf], Node]) -> mpmath.mpf:
            """Return the derivative of the action as the left (`end` 0) or right node moves."""
            after, before = (
                self.of(moved(size), right) if end == 0 else self.of(left, moved(size))
                for size in (_INCREMENT, -_INCREMENT)
            )
            return (after - before) / (2 * _INCREMENT)

        def shifted(node: Node, x: Symbol, size: mpmath.mpf) -> Node:
            return {**node, x: node[x] + size}

        def turned(node: Node, quaternion: Quaternion, axis: int, angle: mpmath.mpf) -> Node:
            """Return a node after a small turn about an axis of the body."""
            change = [mpmath.mpf(i == axis) * angle / 2 for i in range(3)]
            at = _unit(product([node[q] for q in quaternion], (1, *change)))
            return {**node, **dict(zip(quaternion, at, strict=True))}

        for x in self.places:
            yield f"left momentum of {x}", slope(0, partial(shifted, left, x))
            yield f"right momentum of {x}", -slope(1, partial(shifted, right, x))
        rates = iter(stages[len(self.places) :])
        for quaternion in self.model.rotations:
            first, last = (
                [slope(end, partial(turned, node, quaternion, axis)) for axis in range(3)]
                for end, node in enumerate((left, right))
            )
            yield from ((f"left momentum of {next(rates)}", p) for p in first)
            momentum = product([right[q] for q in quaternion], (0, *last))
            yield from ((f"right momentum of {q}", -2 * p) for q, p in zip(quaternion, momentum, strict=True))
