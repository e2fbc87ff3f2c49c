"""The description of a control problem in words and formulas, and the metadata record of its module.

The description is the docstring of the module: the objective and the unknowns, bounds and conditions, the discrete
equations, both ends. It does not mention features that a problem lacks. The record holds names, units and metadata;
most of its fields matter only for features that a user should know of.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import sympy
from sympy import Dummy, Symbol, cos, expand, sin

from codegen.discretise import contact, schemes
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.interval import at_nodes
from codegen.discretise.model.definitions import Model, expressions_of, prescribed
from codegen.discretise.model.values import jumps, kinks, singular_at_guess
from codegen.discretise.program import ControlProgram, EndElement, Equation, Unknown
from codegen.emit.differentiation import ControlDerivatives
from codegen.emit.lower.control.kernels import sample_record
from codegen.emit.lower.control.layout import has_nonlinear_ends
from codegen.emit.lower.kernels import Kernel
from codegen.emit.lower.module import record_fields, system_fields
from codegen.emit.lower.printer import readable
from codegen.runtime.record import ControlRecord, Kind, Role, SegmentRecord, Sites
from codegen.symbolic.tables import TableData

_WIDTH = 110
_LONGEST_DENOMINATOR = 1000


def description(program: ControlProgram, kernels: Sequence[Kernel], tables: Sequence[str] = ()) -> list[str]:
    """Return the lines of the module's docstring: the problem, the description of `tables`, then operation counts."""
    blocks = [
        *_problem(program),
        *(_phases(program) if program.phases else _intervals(program)),
        *_balance(program),
        *_inner_times(program),
        *_end(program, "start", program.start, program.left_symbols),
        *_end(program, "end", program.end, program.right_symbols),
    ]
    if program.linking.couplings:
        lines = [f"0 = {sympy.sstr(coupling.expression)}" for coupling in program.linking.couplings]
        blocks.append(_block("At the end, between bodies (_0 marks the first):", lines))
    if tables:
        blocks.append(_block("Tables, and what holds between and beyond their breakpoints:", tables))
    operations = [f"{k.name}: {k.operations_before} -> {k.operations_after}" for k in kernels]
    lead = "Operations per interval, before and after common subexpressions are shared:"
    blocks.append(_block(lead, operations))
    return [line for number, block in enumerate(blocks) for line in ([""] if number else []) + block]


def _block(lead: str, lines: Sequence[str]) -> list[str]:
    return [*textwrap.wrap(lead, _WIDTH, break_on_hyphens=False), "", *(f"    {line}" for line in lines)]


def _problem(program: ControlProgram) -> Iterator[list[str]]:
    """Yield blocks of lines: objective, unknowns, and conditions at all times; then segments of a delayed motion."""
    model = program.model
    terms = []
    if any(cost != 0 for cost in [phase.regular.cost for phase in program.phases] or [program.cost]):
        terms.append("the sum of Cd over all intervals" + (" of all bodies" if program.model.bodies > 1 else ""))
    terms += ["the losses of all samples"] if program.sample else []
    switches = [i for i, phase in enumerate(program.phases) if any(e.left == "cost" for e in phase.switch_equations)]
    terms += [f"the cost at switch {i}" for i in switches]
    if program.end.cost != 0:
        terms.append(
            f"{sympy.sstr(program.end.cost.xreplace(_plain_names(program, program.right_symbols)))} at the end"
        )
    objective = f" that minimise {' plus '.join(terms)}" if terms else ""
    lines = [f"duration = {sympy.sstr(model.duration)}"]
    if not program.phases:
        lines += _bounds((*program.node, *program.controls))
    lines += _bounds(program.linking.common)
    if not program.phases:
        lines += _conditions(model)
    yield _block(f"Find {_unknowns(program)}{objective}, where", lines)
    segments, whole = model.segments, model.authored
    if segments is None:
        return
    past = [f"{delay.quantity}(t - {sympy.sstr(delay.lag)})" for delay in whole.delays]
    lead = f"This is the method of steps for {', '.join(past)}."
    if segments.number > 1:
        lead = (
            f"The motion of duration {sympy.sstr(whole.duration)} is cut into {segments.number} segments that run side "
            f"by side, each of which begins where the one before it ends: x_i is x in segment i, for every quantity x. "
            f"{lead} A node or interval k of segment i is k + (i - 1) N of the whole."
        )
    yield _block(lead, [*dict.fromkeys(f"{d.quantity} = {sympy.sstr(d.history)} before t = 0" for d in whole.delays)])


def _unknowns(program: ControlProgram) -> str:
    """Return a list, in words, of all unknowns except multipliers and slacks: at nodes, on intervals, and at ends."""
    slacks = {program.node[i].name for end in (program.start, program.end) for i, _ in end.slacks}
    ends = [program.node[i] for i in program.only_at_ends if program.node[i].name not in slacks]
    inside = (*program.interval, *program.controls)
    regular = [phase.regular.lacking for phase in program.phases]
    at_switches = [u for i, u in enumerate(inside) if regular and all(i in lacking for lacking in regular)]
    # Linking variables that are free parameters of the author or occur in the conditions at the ends.
    free = [parameter.symbol for parameter in program.model.free_parameters]
    values = [condition.value for end in (program.start, program.end) for condition in end.conditions]
    shared = [
        unknown
        for unknown, symbol in zip(program.linking.unknowns, program.linking.symbols, strict=True)
        if symbol in free or any(value.has(symbol) for value in values)
    ]
    groups = (
        ([u for i, u in enumerate(program.node) if i not in program.only_at_ends], " at the nodes"),
        ([u for u in inside if u not in at_switches], " on the intervals"),
        (at_switches, " at a switch"),
        (ends, " at an end"),
        (shared, ""),
    )
    named = [(list(dict.fromkeys(_quantity(u) for u in group if not u.multiplier)), where) for group, where in groups]
    parts = [", ".join(names) + where for names, where in named if names]
    text = " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts)
    return (
        f"for {program.model.bodies} bodies (body = 0, ..., {program.model.bodies - 1}) {text}"
        if program.model.bodies > 1
        else text
    )


def _quantity(unknown: Unknown) -> str:
    """Return the mathematical name of an unknown; the module may have another name for the velocity at an end."""
    return unknown.meaning.of if unknown.kind is Kind.END_VELOCITY else unknown.name


def _bounds(unknowns: Sequence[Unknown]) -> list[str]:
    lines = []
    for u in unknowns:
        limits = list[str | None]()
        for value in (u.lower, u.upper):
            if isinstance(value, sympy.Rational) and value.q > _LONGEST_DENOMINATOR:  # written as a decimal
                limits.append(f"{float(value):.15g}")
            else:
                limits.append(None if value is None else str(sympy.sstr(value)))
        lower, upper = limits
        if lower is not None and upper is not None:
            lines.append(f"{lower} <= {u.name} <= {upper}")
        elif lower is not None:
            lines.append(f"{u.name} >= {lower}")
        elif upper is not None:
            lines.append(f"{u.name} <= {upper}")
    return lines


def _conditions(model: Model) -> list[str]:
    """Return sentences for all conditions on the motion, except conditions at its ends."""
    return [sentence for kind in CONDITIONS for sentence in kind.sentences(model)]


def _equations(equations: Sequence[Equation]) -> list[str]:
    """Return the discrete equations as text, without a cost of zero; conditions at nodes appear as bounds instead."""
    return [
        f"{'0 >=' if e.slack else f'{e.left} ='} {sympy.sstr(e.value)}"
        for e in equations
        if not e.at_nodes and (e.left != "Cd" or e.value != 0)
    ]


def _intervals(program: ControlProgram) -> Iterator[list[str]]:
    """Yield the block of lines with the discrete equations of one interval."""
    length = "h = 1/N, relative to the duration" if program.scaled_time else "h = duration/N"
    if program.inner.times:
        length = "with nodes at inner times"
    if program.inner.scales:
        (step, lasting), _ = program.inner.scales
        lasts = f"the interval lasts {lasting / step}*h"
        length = f"where h is relative to the duration and the same between two inner times, and {lasts}"
    yield _block(
        f"On each of N intervals, from t_k to t_k1 = t_k + h, {length} (suffixes _k and _k1 mark its nodes):",
        _equations(program.equations),
    )


def _phases(program: ControlProgram) -> Iterator[list[str]]:
    """Yield blocks of lines with the equations of each phase's intervals, and with the relations at switches."""
    lead = (
        "On each of N intervals of a phase, from t_k to t_k1 = t_k + h, h = 1/N (suffixes _k and _k1 mark its nodes), "
        "where t runs from the number of the phase, less one, to that number."
    )
    if any(element.lacking for phase in program.phases for element in phase.elements):
        lead += " An unknown x that an interval lacks vanishes by x^2/2 in its share of the Lagrangian."
    yield textwrap.wrap(lead, _WIDTH)
    for number, (phase, model) in enumerate(zip(program.phases, program.model.phases, strict=True), start=1):
        if phase.switch_equations:
            relations = [_relation(equation) for equation in phase.switch_equations]
            yield _block(f"At switch {number - 1}, where the left node has the values before it:", relations)
        lacking = {phase.inside[i].name for i in phase.regular.lacking}
        idle = [u.name for u in program.controls if u.name in lacking]
        without = f", without {', '.join(idle)}" if idle else ""
        present = [u for u in (*phase.node, *phase.inside) if u.name not in lacking and u.kind.role is not Role.SLACK]
        yield _block(
            f"Phase {number}, of duration {sympy.sstr(phase.duration)}{without}:",
            [*_bounds(present), *_conditions(model), *_equations(phase.equations)],
        )


def _balance(program: ControlProgram) -> Iterator[list[str]]:
    """Yield the block of discrete Euler-Lagrange equations at nodes, for the variational method only."""
    if program.method != "variational":
        return
    forced = any(force != 0 for m in program.model.phases or (program.model,) for force in m.force)
    both = " + f+_{k-1} + f-_k" if forced else ""
    lead = f"{'Forced discrete' if forced else 'Discrete'} Euler-Lagrange equations at inner nodes"
    force = left = right = ""
    if kappa := ", ".join(u.name for u in program.node if u.kind is Kind.NORMAL_FORCE):
        lead += f", with G the derivative of the constraints and kappa of entries {kappa}"
        force, left, right = (f" {part} G(q_k)^T kappa_k" for part in ("+ h", "- h/2", "+ h/2"))
    impulses = zip(program.model.coordinates, contact.impulses(program.model), strict=True)
    acting_impulses = [f"c_{q} = {sympy.sstr(impulse)}" for q, impulse in impulses if impulse != 0]
    if acting_impulses:
        lead += ", with the impulses c_k of contact"
        force, left = " + c_k", " - c_k"
    if at_end := ", ".join(u.name for u in program.node if u.kind is Kind.END_IMPULSE):
        right = f" + c of {at_end}"
    lines = [f"0 = D2 Ld(q_{{k-1}}, q_k) + D1 Ld(q_k, q_{{k+1}}){both}{force}", *acting_impulses]
    inner = [u.name for u in program.interval if u.kind is Kind.INNER_VALUE]
    equations = chain(program.equations, *(phase.equations for phase in program.phases))
    acting = {equation.left for equation in equations}
    lines += [f"0 = dLd/d{name}" + f" + f_{name}" * (f"f_{name}" in acting) for name in inner]
    before = f"D2 Ld(q_{{k-1}}, q_k){' + f+_{k-1}' * forced}{right}"
    after = f"-D1 Ld(q_k, q_{{k+1}}){' - f-_k' * forced}{left}"
    lines += [f"p at the start = {after}"] * any(e.momentum for e in program.start.conditions)
    lines += [f"p at the end = {before}"] * any(e.momentum for e in program.end.conditions)
    switched = any(e.momentum for phase in program.phases for e in phase.switch_equations)
    lines += [f"p before a switch = {before}", f"p after a switch = {after}"] * switched
    if len(lines) > 1 + len(inner) + len(acting_impulses):
        lead += ", and prescribed momenta"
    yield _block(f"{lead}:", lines)


def _inner_times(program: ControlProgram) -> Iterator[list[str]]:
    """Yield blocks of lines: the unknowns of nodes at inner times, and the equations of time if these are free."""
    inner = program.inner
    if not inner.times:
        return
    names = ", ".join(program.node[i].name for i in inner.unknowns)
    lead = "At inner times, by multipliers nu and slacks s >= 0; at other nodes x^2/2 in l makes each of them vanish:"
    lines = [f"{names}, with numbers {', '.join(s.name for s in inner.symbols)} of these nodes, zero elsewhere"]
    yield _block(lead, lines)
    if inner.clock is not None:
        time, pace = (program.node[inner.clock + i].name for i in (0, 1))
        lines = [f"{time}_k1 = {time}_k + {pace}_k1*h", f"{pace}_k1 = {pace}_k, unless node k is at an inner time"]
        yield _block("Time passes at a pace of its own between any two inner times:", lines)


def _end(program: ControlProgram, where: str, end: EndElement, symbols: Sequence[Symbol]) -> Iterator[list[str]]:
    """Yield the block with the prescribed values, momenta and conditions at one end, if there are any."""
    names = _plain_names(program, symbols)
    values = [f"{v.quantity} = {sympy.sstr(v.value)}" for v in program.boundary_values if v.where == where]
    lasting = {c.name for c in program.model.path} | {f"{q} is periodic" for q, _ in program.model.periodic}
    relations = [
        _relation(replace(condition, value=condition.value.xreplace(names)))
        for condition in end.conditions
        if condition.condition not in lasting
    ]
    relations += [bound.condition for _, bound in end.bounds if bound.condition not in lasting]
    line = ", ".join(values)
    if values and len(line) < _WIDTH:
        values = [line]
    if values or relations:
        yield _block(f"At the {where}:", [*values, *relations])


def _relation(equation: Equation) -> str:
    """Return the text of a condition as the author wrote it, or else of the equation for a quantity."""
    if any(sign in equation.condition for sign in (" = ", " <= ", " >= ")):
        return equation.condition
    left = f"-{equation.slack}" if equation.slack else equation.left
    return f"{left} = {readable(equation.value)}" + (f" ({equation.condition})" if equation.condition else "")


def _plain_names(program: ControlProgram, symbols: Sequence[Symbol]) -> Mapping[Symbol, Symbol]:
    """Return a map from the symbols of an end node and of prescribed values to symbols without suffixes."""
    names = {value.symbol: Symbol(value.quantity, real=True) for value in program.boundary_values}
    return names | {symbol: Symbol(_quantity(u), real=True) for symbol, u in zip(symbols, program.node, strict=True)}


def left_out(program: ControlProgram, derivatives: ControlDerivatives) -> list[str]:
    """Return the features that the module lacks, each with the reason."""
    model = program.model
    models = model.phases or (model,)
    out = []
    if derivatives.linear_quadratic:
        out.append("globalisation and inertia correction: the problem is linear-quadratic, one Newton step solves it")
    if derivatives.condensed:
        kind = "controls" if derivatives.condensed > len(program.slacks) else "slacks"
        why = "" if program.has_inequalities or program.phases else "their Hessian block is constant, so "
        out.append(f"{kind} in the linear system: {why}each interval eliminates its own")
    if not has_nonlinear_ends(derivatives):
        out.append("curvature of the boundary conditions: positions that they depend on are prescribed")
    if not program.has_inequalities:
        out.append("interior point: there are no inequalities")
    if not program.linking.unknowns:
        out.append("a border of the linear system: no unknown is shared by all intervals")
    functions = tuple(f for m in models for f in (m.function, *m.force, *m.dynamics))
    absent = ", ".join(str(q) for q in model.coordinates if not any(f.has(q) for f in functions))
    if absent and model.form == "first-order":
        out.append(f"derivatives of the dynamics by {absent}: no right-hand side depends on {absent}")
    elif absent:
        out.append(f"derivatives of the {model.form.capitalize()} by {absent}: cyclic")
    forces = zip(*(m.force for m in models), strict=True)
    idle = [str(q) for q, f in zip(model.coordinates, forces, strict=False) if not any(f)]
    if idle:
        out.append(f"forces on {', '.join(idle)}: there are none")
    others = [e for m in models for e in (m.cost or sympy.S.Zero, *(c.expression for c in m.path))]
    if not any(e.has(model.time) for e in (*functions, *others)):
        out.append("time in the kernels: nothing depends on it explicitly")
    size = len(program.element_symbols)
    zeros = size * (size + 1) // 2 - len(derivatives.element.hessian)
    if zeros:
        out.append(f"{zeros} of {size * (size + 1) // 2} entries of the interval's Hessian: identically zero")
    return out


def record(
    program: ControlProgram,
    derivatives: ControlDerivatives,
    kernels: Sequence[Kernel],
    tables: Sequence[TableData],
    sensitivities: tuple[str, ...] | None,
) -> ControlRecord:
    """Return the module's metadata record; `sensitivities` name the quantities that a user may vary, if any."""
    model, values, inner = program.model, program.boundary_values, program.inner
    models, redundant = model.phases or (model,), program.linking.redundant
    own, common = program.linking.of_bodies, program.linking.common
    shared = [
        f"{u.name} of body {body}" if program.model.bodies > 1 else u.name
        for body in range(program.model.bodies)
        for u in own
    ]
    shared += [u.name for u in common] + [c.multiplier.name for c in program.linking.couplings]
    # Multipliers, slacks and constraint forces need meanings; other unknowns have names that suffice.
    unknowns = (*program.node, *program.interval, *program.slacks, *program.linking.unknowns)
    unknowns += tuple(coupling.multiplier for coupling in program.linking.couplings)
    meanings = {u.name: u.meaning for u in unknowns if u.kind.role is not Role.VALUE or u.kind is Kind.NORMAL_FORCE}
    first = len(program.interval) + len(program.controls)
    slacks = tuple(
        {p.inside[i].name: p.inside[i].meaning for i in range(first, len(p.inside)) if i not in p.regular.lacking}
        for p in program.phases
    )
    scheme = schemes.find(program.scheme, program.method)
    abscissae = tuple(map(float, scheme.point_times)) if program.controlled == "stages" else ()
    bends, discontinuities = dict[str, None](), dict[str, None]()
    for part in models:
        moving = (*part.coordinates, *part.rates, *part.controls)
        for cost in (part.cost or sympy.S.Zero, part.terminal_cost):
            bends |= dict.fromkeys(kinks(cost, moving))
        # A motion crosses the kinks of its states. But the optimal control often lies at a kink of its own.
        for rate in (*part.force, *part.dynamics):
            bends |= dict.fromkeys(kinks(rate, part.controls))
        discontinuities |= dict.fromkeys(border for e in expressions_of(part) for border in jumps(e, moving))
    segments = None
    if model.segments and model.segments.number > 1:
        names = {name: (whole, number) for name, whole, number in model.segments.names}
        segments = SegmentRecord(model.segments.number, names)
    ends = (("start", program.start), ("end", program.end))
    decided = dict.fromkeys((name, where) for where, end in ends for _, name in end.determined if name)
    # Quantities whose value at the start differs from the end of their history.
    initial, differing = prescribed(model.authored, "start"), {}
    for delay in model.authored.delays:
        last = delay.history.xreplace({model.authored.time: sympy.S.Zero})
        value = initial.get(delay.quantity, last)
        if sympy.simplify(value - last) != 0:
            differing[delay.quantity.name] = (sympy.sstr(value), sympy.sstr(last))
    # One radian in the unit of each coordinate or control that is an angle inside sines or cosines.
    radians: dict[str, float] = {}
    for part in model.phases or (model,):
        written = (part.function, *part.dynamics, *part.force, *((part.cost,) if part.cost is not None else ()))
        for call in set().union(*(expression.atoms(sin, cos) for expression in written)):
            for symbol in call.args[0].free_symbols & {*part.coordinates, *part.controls}:
                slope = call.args[0].diff(symbol)
                if slope.is_number and slope != 0:
                    radians[symbol.name] = min(radians.get(symbol.name, math.inf), abs(1.0 / float(slope)))
    return ControlRecord(
        **record_fields(program, scheme.order, kernels, left_out(program, derivatives)),
        **system_fields(model, tables),
        start=tuple(v.quantity for v in values if v.where == "start"),
        end=tuple(v.quantity for v in values if v.where == "end"),
        controls=Sites(program.controlled),
        bodies=program.model.bodies,
        phases=len(program.phases) or 1,
        control_names=tuple(s.name for s in model.controls),
        free_parameters=tuple(p.symbol.name for p in model.free_parameters),
        node=tuple(u.name for u in program.node),
        interval=tuple(u.name for u in (*program.interval, *program.controls, *program.slacks)),
        shared=tuple(shared),
        inequalities=program.has_inequalities,
        meanings=meanings,
        slacks=slacks if any(slacks) else (),
        jumps=tuple(phase.broken for phase in program.phases[1:]),
        stages=_stages(program),
        stage_abscissae=abscissae,
        scale={x.name: size for x, size in model.scales},
        angles=dict(sorted(radians.items())),
        observations=sample_record(program),
        sensitivities=sensitivities,
        unseen_controls=_unseen_controls(program),
        maximised=model.maximised,
        history_jumps=tuple((name, *values) for name, values in differing.items()),
        relaxation=model.relaxation.name if model.relaxation else "",
        end_impulses=tuple(u.name for u in program.node if u.kind is Kind.END_IMPULSE),
        contact_forces=tuple(f.name for each in model.contacts for f in each.forces),
        segments=segments,
        integrals=_integral_multipliers(program),
        inner_times=len(inner.times),
        waypoints=inner.clock is not None,
        inner_conditions=inner.multipliers,
        kinks=tuple(bends),
        discontinuities=tuple(discontinuities),
        singular_at_guess=tuple(dict.fromkeys(name for part in models for name in singular_at_guess(part))),
        coupling_conditions=len(program.linking.couplings) + len(redundant) if redundant else 0,
        redundant_conditions=redundant,
        dependent_values=tuple((name, where) for where, end in ends for name in end.dependent),
        decided_conditions=tuple(decided),
    )


def _stages(program: ControlProgram) -> dict[str, str]:
    """Return a map from the names of states, controls and multipliers at stages to names of these quantities."""
    model = program.model
    quantities = {s.name for s in (*model.coordinates, *model.rates, *model.controls)}
    quantities |= {f"{prefix}_{name}" for name in quantities for prefix in ("mu", "lambda")}
    names = [u.name for u in (*program.interval, *program.controls)]
    return {name: of for name in names if name not in quantities and (of := name.rpartition("_stage")[0]) in quantities}


def _unseen_controls(program: ControlProgram) -> tuple[str, ...]:
    """Return nodal controls that occur in the expanded discrete cost only as sums of neighbouring values.

    Their oscillations leave the cost unchanged. `codegen check` detects this numerically.
    """
    if not program.nodal_controls or program.model.cost is None:
        return ()
    controls = [u for u in program.model.controls if program.model.cost.has(u)]
    left, right = at_nodes(controls, "_k"), at_nodes(controls, "_k1")
    total = Dummy("sum", real=True)
    alone = (expand(program.cost.xreplace({b: total - a})).has(a) for a, b in zip(left, right, strict=True))
    return tuple(u.name for u, is_seen in zip(controls, alone, strict=True) if not is_seen)


def _integral_multipliers(program: ControlProgram) -> tuple[tuple[str, int], ...]:
    """Return each integral constraint's name, and its multiplier's index among the linking variables of all bodies."""
    own, bodies = program.linking.own, program.model.bodies
    multipliers = []
    for index, integrals in [(0, program.integrals), *((i, p.integrals) for i, p in enumerate(program.phases, 1))]:
        for integral in integrals:
            j = program.linking.symbols.index(integral.multiplier)
            where = f" in phase {index}" if index else ""
            for body in range(bodies if j < own else 1):
                of_body = f" of body {body}" if bodies > 1 else ""
                multipliers.append((f"{integral.condition.name}{where}{of_body}", body * own + j))
    return tuple(multipliers)
