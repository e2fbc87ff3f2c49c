"""What a control module says about itself beside the problem that it solves: what was left out, its record.

The problem that a control module solves, in words and formulas: the docstring with which the module begins.

What is minimised and over what, bounds and conditions, the discrete equations, both ends; nothing that a problem lacks.

Fields of the record of a control module that are there only where a user should know of something.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import sympy
from sympy import Dummy, Expr, Symbol, cos, expand, sin

from codegen.discretise import schemes
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.interval import at_nodes
from codegen.discretise.model.definitions import Model, expressions_of, prescribed
from codegen.discretise.model.smoothness import jumps, kinks, singular_at_guess
from codegen.discretise.program import ControlProgram, EndElement, Phase, Unknown
from codegen.emit.differentiation import ControlDerivatives
from codegen.emit.lower.control.kernels import sample_record
from codegen.emit.lower.control.layout import carries_right_hand_side, has_nonlinear_ends
from codegen.emit.lower.kernels import Kernel
from codegen.emit.lower.module import record_fields
from codegen.emit.lower.printer import readable
from codegen.emit.lower.tables import table_records
from codegen.runtime.record import ControlRecord, Form, Kind, Meaning, Method, Role, SegmentRecord, Sites
from codegen.symbolic.tables import TableData

_WIDTH = 110
_LONGEST_DENOMINATOR = 1000

Pairs = Sequence[tuple[str, Expr]]


def description(program: ControlProgram, kernels: Sequence[Kernel], tables: Sequence[str] = ()) -> list[str]:
    """The lines of the docstring below the title: the problem, its `tables`, then operation counts."""
    operations = [f"{k.name}: {k.operations_before} -> {k.operations_after}" for k in kernels]
    blocks = [
        *_problem(program),
        *_segments(program.model),
        *(_phases(program) if program.phases else _intervals(program)),
        *_balance(program),
        *_inner_times(program),
        *_end(program, "start", program.start, program.left_symbols),
        *_end(program, "end", program.end, program.right_symbols),
        *_couplings(program),
        *([_block("Tables, and what holds between and beyond their breakpoints:", tables)] if tables else []),
        _block("Operations per interval, before and after common subexpressions are shared:", operations),
    ]
    return [line for number, block in enumerate(blocks) for line in ([""] if number else []) + block]


def _problem(program: ControlProgram) -> Iterator[list[str]]:
    """What is least, over which unknowns, and what holds at every time."""
    model = program.model
    time = [f"duration = {sympy.sstr(model.duration)}"]
    bounds = _bounds(program.shared[program.own :])
    if not program.phases:
        bounds = [*_bounds((*program.node, *program.controls)), *bounds, *_conditions(model)]
    yield _block(f"Find {_unknowns(program)}{_objective(program)}, where", [*time, *bounds])


def _segments(model: Model) -> Iterator[list[str]]:
    """How a motion with delays was cut, and what was before it."""
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
    lines = {f"{d.quantity} = {sympy.sstr(d.history)} before t = 0": None for d in whole.delays}
    yield _block(lead, [*lines])


def _objective(program: ControlProgram) -> str:
    """The goal: the sum of the discrete cost and the costs at ends and switches, as far as there are any."""
    terms = []
    if any(cost != 0 for cost in [phase.regular.cost for phase in program.phases] or [program.cost]):
        terms.append("the sum of Cd over all intervals" + (" of all bodies" if program.bodies > 1 else ""))
    terms += ["the losses of all samples"] if program.sample else []
    switches = [i for i, phase in enumerate(program.phases) if dict(phase.switch_equations).get("cost")]
    terms += [f"the cost at switch {i}" for i in switches]
    if program.end.cost != 0:
        terms.append(f"{sympy.sstr(program.end.cost.xreplace(_plain(program, program.right_symbols)))} at the end")
    return f" that minimise {' plus '.join(terms)}" if terms else ""


def _unknowns(program: ControlProgram) -> str:
    """All unknowns that are no multipliers and no slacks, by where they live."""
    slacks = {program.node[i].name for end in (program.start, program.end) for i, _ in end.slacks}
    ends = [program.node[i] for i in program.only_at_ends if program.node[i].name not in slacks]
    inside = (*program.interval, *program.controls)
    regular = [phase.regular.lacking for phase in program.phases]
    at_switches = [u for i, u in enumerate(inside) if regular and all(i in lacking for lacking in regular)]
    shared = [
        u for u, symbol in zip(program.shared, program.shared_symbols, strict=True) if _is_stated(program, symbol)
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
    return f"for {program.bodies} bodies (body = 0, ..., {program.bodies - 1}) {text}" if program.bodies > 1 else text


def _is_stated(program: ControlProgram, symbol: Symbol) -> bool:
    """Whether a shared unknown is the author's, or occurs in what is written of the ends."""
    values = [value for end in (program.start, program.end) for _, value in end.conditions]
    free = [parameter.symbol for parameter in program.model.free_parameters]
    return symbol in free or any(value.has(symbol) for value in values)


def _quantity(unknown: Unknown) -> str:
    """What an unknown is called in mathematics; the velocity at one end may have another name in the module."""
    return unknown.meaning.of if unknown.kind is Kind.END_VELOCITY else unknown.name


def _bounds(unknowns: Sequence[Unknown]) -> list[str]:
    lines = []
    for u in unknowns:
        lower, upper = (None if value is None else _limit(value) for value in (u.lower, u.upper))
        if lower is not None and upper is not None:
            lines.append(f"{lower} <= {u.name} <= {upper}")
        elif lower is not None:
            lines.append(f"{u.name} >= {lower}")
        elif upper is not None:
            lines.append(f"{u.name} <= {upper}")
    return lines


def _limit(value: Expr) -> str:
    """A bound as its author wrote it: exact numbers with many digits were decimals."""
    if isinstance(value, sympy.Rational) and value.q > _LONGEST_DENOMINATOR:
        return f"{float(value):.15g}"
    return str(sympy.sstr(value))


def _intervals(program: ControlProgram) -> Iterator[list[str]]:
    """The equations of one interval."""
    length = "h = 1/N, in parts of the duration" if program.scaled_time else "h = duration/N"
    if program.inner.times:
        length = "with nodes at inner times"
    if program.inner.scales:
        (step, lasting), _ = program.inner.scales
        length = f"where h is a part of 1, the same between any two inner times, and lasts {lasting / step}*h"
    yield _block(
        f"On each of N intervals, from t_k to t_k1 = t_k + h, {length} (suffixes _k and _k1 mark its nodes):",
        _equations(program.equations),
    )


def _inner_times(program: ControlProgram) -> Iterator[list[str]]:
    """What nodes at inner times have, and where these are free, how time passes."""
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


def _phases(program: ControlProgram) -> Iterator[list[str]]:
    """The equations of an interval of every phase, and what happens at the switches."""
    lead = (
        "On each of N intervals of a phase, from t_k to t_k1 = t_k + h, h = 1/N (suffixes _k and _k1 mark its nodes), "
        "where t runs from the number of the phase, less one, to that number."
    )
    if any(element.lacking for phase in program.phases for element in phase.elements):
        lead += " An unknown x that an interval lacks vanishes by x^2/2 in its share of the Lagrangian."
    yield textwrap.wrap(lead, _WIDTH)
    for number, (phase, model) in enumerate(zip(program.phases, program.model.phases, strict=True), start=1):
        if phase.switch_equations:
            relations = [_relation(label, value) for label, value in phase.switch_equations]
            yield _block(f"At switch {number - 1}, where the left node has the values before it:", relations)
        yield _block(_heading(program, number, phase), _phase_lines(phase, model))


def _heading(program: ControlProgram, number: int, phase: Phase) -> str:
    lacking = {phase.inside[i].name for i in phase.regular.lacking}
    idle = [u.name for u in program.controls if u.name in lacking]
    without = f", without {', '.join(idle)}" if idle else ""
    return f"Phase {number}, of duration {sympy.sstr(phase.duration)}{without}:"


def _phase_lines(phase: Phase, model: Model) -> list[str]:
    lacking = {phase.inside[i].name for i in phase.regular.lacking}
    present = [u for u in (*phase.node, *phase.inside) if u.name not in lacking and u.kind.role is not Role.SLACK]
    return [*_bounds(present), *_conditions(model), *_equations(phase.equations)]


def _conditions(model: Model) -> list[str]:
    """What holds for the motion, beside what is said of its ends."""
    return [sentence for kind in CONDITIONS for sentence in kind.sentences(model)]


def _equations(equations: Pairs) -> list[str]:
    """Discrete equations; those of conditions at nodes have been written, and so has a cost that vanishes."""
    return [
        f"0 >= {sympy.sstr(value)}" if label.startswith("-") else f"{label.partition(' (')[0]} = {sympy.sstr(value)}"
        for label, value in equations
        if not label.startswith("0 at every node") and (label != "Cd" or value != 0)
    ]


def _balance(program: ControlProgram) -> Iterator[list[str]]:
    """What the variational method asks of the nodes."""
    if program.method != "variational":
        return
    forced = any(force != 0 for m in program.model.phases or (program.model,) for force in m.force)
    both = " + f+_{k-1} + f-_k" if forced else ""
    lead = f"{'Forced discrete' if forced else 'Discrete'} Euler-Lagrange equations at inner nodes"
    force = left = right = ""
    if kappa := ", ".join(u.name for u in program.node if u.kind is Kind.NORMAL_FORCE):
        lead += f", with G the derivative of the constraints and kappa of entries {kappa}"
        force, left, right = (f" {part} G(q_k)^T kappa_k" for part in ("+ h", "- h/2", "+ h/2"))
    lines = [f"0 = D2 Ld(q_{{k-1}}, q_k) + D1 Ld(q_k, q_{{k+1}}){both}{force}"]
    inner = [u.name for u in program.interval if u.kind is Kind.INNER_VALUE]
    equations = chain(program.equations, *(phase.equations for phase in program.phases))
    acting = {label for label, _ in equations}
    lines += [f"0 = dLd/d{name}" + f" + f_{name}" * (f"f_{name}" in acting) for name in inner]
    before = f"D2 Ld(q_{{k-1}}, q_k){' + f+_{k-1}' * forced}{right}"
    after = f"-D1 Ld(q_k, q_{{k+1}}){' - f-_k' * forced}{left}"
    switches = [pair for phase in program.phases for pair in phase.switch_equations]
    lines += [f"p at the start = {after}"] * _gives_momenta(program.start.conditions)
    lines += [f"p at the end = {before}"] * _gives_momenta(program.end.conditions)
    lines += [f"p before a switch = {before}", f"p after a switch = {after}"] * _gives_momenta(switches)
    if len(lines) > 1 + len(inner):
        lead += ", and momenta where they are given"
    yield _block(f"{lead}:", lines)


def _gives_momenta(conditions: Pairs) -> bool:
    return any(label.startswith("p_") for label, _ in conditions)


def _end(program: ControlProgram, where: str, end: EndElement, symbols: Sequence[Symbol]) -> Iterator[list[str]]:
    """Given values, momenta and conditions at one end, in the quantities there."""
    plain = _plain(program, symbols)
    given = [f"{v.quantity} = {sympy.sstr(v.value)}" for v in program.boundary_values if v.where == where]
    lasting = {c.name for c in program.model.path} | {f"{q} is periodic" for q, _ in program.model.periodic}
    relations = [
        _relation(label, value.xreplace(plain))
        for label, value in end.conditions
        if label.partition(" (")[2].removesuffix(")") not in lasting
    ]
    relations += [bound.condition for _, bound in end.bounds if bound.condition not in lasting]
    if given or relations:
        yield _block(f"At the {where}:", [*_side_by_side(given), *relations])


def _side_by_side(items: Sequence[str]) -> list[str]:
    """Short items on one line, long ones on a line each."""
    line = ", ".join(items)
    return [line] if items and len(line) < _WIDTH else list(items)


def _relation(label: str, value: Expr) -> str:
    """A condition as its author wrote it, or what a quantity is."""
    left, _, said = label.partition(" (")
    if said and any(sign in said for sign in (" = ", " <= ", " >= ")):
        return said.removesuffix(")")
    return f"{left} = {readable(value)}" + (f" ({said}" if said else "")


def _plain(program: ControlProgram, symbols: Sequence[Symbol]) -> Mapping[Symbol, Symbol]:
    """Quantities of an end, and the symbols of values that are given there, by their names alone."""
    names = {value.symbol: Symbol(value.quantity, real=True) for value in program.boundary_values}
    return names | {symbol: Symbol(_quantity(u), real=True) for symbol, u in zip(symbols, program.node, strict=True)}


def _couplings(program: ControlProgram) -> Iterator[list[str]]:
    if program.couplings:
        lines = [f"0 = {sympy.sstr(coupling.expression)}" for coupling in program.couplings]
        yield _block("At the end, between bodies (_0 marks the first):", lines)


def _block(lead: str, lines: Sequence[str]) -> list[str]:
    return [*textwrap.wrap(lead, _WIDTH, break_on_hyphens=False), "", *(f"    {line}" for line in lines)]


def notable(program: ControlProgram) -> dict[str, Any]:
    """The fields of a record that are empty for most programs."""
    model, redundant, inner = program.model, program.redundant_couplings, program.inner
    models = model.phases or (model,)
    segments = None
    if model.segments and model.segments.number > 1:
        names = {own: (whole, number) for own, whole, number in model.segments.names}
        segments = SegmentRecord(model.segments.number, names)
    ends = (("start", program.start), ("end", program.end))
    decided = dict.fromkeys((name, where) for where, end in ends for _, name in end.determined if name)
    return {
        "unseen_controls": _unseen_controls(program),
        "maximised": model.maximised,
        "history_jumps": _jumps_from_history(model.authored),
        "segments": segments,
        "integrals": _integral_multipliers(program),
        "inner_times": len(inner.times),
        "waypoints": inner.clock is not None,
        "inner_conditions": inner.multipliers,
        "kinks": _kinks(program),
        "discontinuities": _jumps(program),
        "singular_at_guess": tuple(dict.fromkeys(one for own in models for one in singular_at_guess(own))),
        "coupling_conditions": len(program.couplings) + len(redundant) if redundant else 0,
        "redundant_conditions": redundant,
        "dependent_values": tuple((name, where) for where, end in ends for name in end.dependent),
        "decided_conditions": tuple(decided),
    }


def _jumps_from_history(model: Model) -> tuple[tuple[str, str, str], ...]:
    """Quantities whose given value at the start is not where their history ends, with both values."""
    given, found = prescribed(model, "start"), {}
    for delay in model.delays:
        last = delay.history.xreplace({model.time: sympy.S.Zero})
        value = given.get(delay.quantity, last)
        if sympy.simplify(value - last) != 0:
            found[delay.quantity.name] = (sympy.sstr(value), sympy.sstr(last))
    return tuple((name, *values) for name, values in found.items())


def _integral_multipliers(program: ControlProgram) -> tuple[tuple[str, int], ...]:
    """The name of every condition on an integral, and the index of its multiplier among the unknowns of no node."""
    own, bodies = program.own, program.bodies
    found = []
    for index, integrals in [(0, program.integrals), *((i, p.integrals) for i, p in enumerate(program.phases, 1))]:
        for integral in integrals:
            j = program.shared_symbols.index(integral.multiplier)
            where = f" in phase {index}" if index else ""
            for body in range(bodies if j < own else 1):
                of_body = f" of body {body}" if bodies > 1 else ""
                found.append((f"{integral.condition.name}{where}{of_body}", body * own + j))
    return tuple(found)


def _kinks(program: ControlProgram) -> tuple[str, ...]:
    """Terms of the cost, of any phase, whose slope jumps where a motion may be."""
    models = program.model.phases or (program.model,)
    found: dict[str, None] = {}
    for model in models:
        moving = (*model.coordinates, *model.rates, *model.controls)
        for cost in (model.cost or sympy.S.Zero, model.terminal_cost):
            found |= dict.fromkeys(kinks(cost, moving))
    return tuple(found)


def _jumps(program: ControlProgram) -> tuple[str, ...]:
    """Borders at which the cost, the dynamics, forces or conditions of any phase jump."""
    found: dict[str, None] = {}
    for model in program.model.phases or (program.model,):
        moving = (*model.coordinates, *model.rates, *model.controls)
        found |= dict.fromkeys(border for part in expressions_of(model) for border in jumps(part, moving))
    return tuple(found)


def _unseen_controls(program: ControlProgram) -> tuple[str, ...]:
    """Nodal controls whose alternation the discrete cost does not see, because only sums of neighbours occur in it.

    `codegen check` decides with numbers what this finds by expanding.
    """
    if not program.nodal_controls or program.model.cost is None:
        return ()
    controls = [u for u in program.model.controls if program.model.cost.has(u)]
    left, right = at_nodes(controls, "_k"), at_nodes(controls, "_k1")
    total = Dummy("sum", real=True)
    alone = (expand(program.cost.xreplace({b: total - a})).has(a) for a, b in zip(left, right, strict=True))
    return tuple(u.name for u, is_seen in zip(controls, alone, strict=True) if not is_seen)


def left_out(program: ControlProgram, derivatives: ControlDerivatives) -> list[str]:
    """What the module does not hold, and why."""
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
        out.append("curvature of the boundary conditions: positions that they depend on are given")
    if not program.has_inequalities:
        out.append("interior point: there are no inequalities")
    if not program.shared:
        out.append("a border of the linear system: no unknown is shared by all intervals")
    if not carries_right_hand_side(program, derivatives):
        out.append("a right-hand side that takes part in the elimination: rows of element matrices have no room for it")
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
    """The record of the module, with the quantities that derivatives of solutions are by, if any are."""
    model, given = program.model, program.boundary_values
    own, common = program.shared[: program.own], program.shared[program.own :]
    shared = [
        f"{u.name} of body {body}" if program.bodies > 1 else u.name for body in range(program.bodies) for u in own
    ]
    shared += [u.name for u in common] + [c.multiplier.name for c in program.couplings]
    return ControlRecord(
        **record_fields(model),
        method=Method(program.method),
        scheme=program.scheme,
        order=schemes.find(program.scheme, program.method).order,
        form=Form(model.form),
        coordinates=tuple(s.name for s in model.coordinates),
        rates=tuple(s.name for s in model.rates),
        start=tuple(v.quantity for v in given if v.where == "start"),
        end=tuple(v.quantity for v in given if v.where == "end"),
        units=dict(model.units),
        tables=table_records(tables),
        operations={k.name: (k.operations_before, k.operations_after) for k in kernels},
        left_out=tuple(left_out(program, derivatives)),
        controls=Sites(program.controlled),
        bodies=program.bodies,
        phases=len(program.phases) or 1,
        control_names=tuple(s.name for s in model.controls),
        free_parameters=tuple(p.symbol.name for p in model.free_parameters),
        node=tuple(u.name for u in program.node),
        interval=tuple(u.name for u in (*program.interval, *program.controls, *program.slacks)),
        shared=tuple(shared),
        inequalities=program.has_inequalities,
        meanings=_meanings(program),
        slacks=_slacks(program),
        jumps=tuple(phase.broken for phase in program.phases[1:]),
        stages=_stages(program),
        stage_abscissae=_stage_abscissae(program) if program.controlled == "stages" else (),
        scale={x.name: size for x, size in model.scales},
        angles=_angles(model),
        observations=sample_record(program),
        sensitivities=sensitivities,
        **notable(program),
    )


def _stages(program: ControlProgram) -> dict[str, str]:
    """Names at stages, of states, controls and multipliers, with the names of the same quantity at nodes."""
    model = program.model
    quantities = {s.name for s in (*model.coordinates, *model.rates, *model.controls)}
    quantities |= {f"{prefix}_{name}" for name in quantities for prefix in ("mu", "lambda")}
    names = [u.name for u in (*program.interval, *program.controls)]
    return {name: of for name in names if name not in quantities and (of := name.rpartition("_stage")[0]) in quantities}


def _angles(model: Model) -> dict[str, float]:
    """Name -> one radian in the unit of a coordinate or control that is an argument of sines and cosines."""
    found: dict[str, float] = {}
    for part in model.phases or (model,):
        written = (part.function, *part.dynamics, *part.force, *((part.cost,) if part.cost is not None else ()))
        for call in set().union(*(expression.atoms(sin, cos) for expression in written)):
            for symbol in call.args[0].free_symbols & {*part.coordinates, *part.controls}:
                slope = call.args[0].diff(symbol)
                if slope.is_number and slope != 0:
                    found[symbol.name] = min(found.get(symbol.name, math.inf), abs(1.0 / float(slope)))
    return dict(sorted(found.items()))


def _stage_abscissae(program: ControlProgram) -> tuple[float, ...]:
    """The fractions of an interval at which its controls are."""
    scheme = schemes.find(program.scheme, program.method)
    points = scheme.discrete_lagrangian().points if scheme.variational else scheme.step().points
    return tuple(float(point.abscissa) for point in points)


def _slacks(program: ControlProgram) -> tuple[dict[str, Meaning], ...]:
    """What slacks are in each of several phases."""
    first = len(program.interval) + len(program.controls)
    found = tuple(
        {p.inside[i].name: p.inside[i].meaning for i in range(first, len(p.inside)) if i not in p.regular.lacking}
        for p in program.phases
    )
    return found if any(found) else ()


def _meanings(program: ControlProgram) -> dict[str, Meaning]:
    """What multipliers, slacks and forces of constraints are; the names of other unknowns say it."""
    unknowns = (*program.node, *program.interval, *program.slacks, *program.shared)
    named = [*unknowns, *(coupling.multiplier for coupling in program.couplings)]
    return {u.name: u.meaning for u in named if u.kind.role is not Role.VALUE or u.kind is Kind.NORMAL_FORCE}
