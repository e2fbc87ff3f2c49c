"""Transcription of a control problem of several phases: the intervals of all phases in one chain.

Every phase is transcribed by itself. The time of the chain runs from 0 to the number of phases, so that the time of an
interval gives its phase. In the expressions of phase i, which begins at t_i and lasts D_i, h is replaced by D_i h, and
t by t_i + D_i (t - i). All intervals have the unknowns of all phases. Where an interval does not need an unknown x, the
term x^2/2 makes x vanish. Unknowns with numbered names have different meanings in different phases.

A switch between two phases belongs to the interval after the switch, the first interval of the later phase. The node at
a switch has the values before the jump. This interval replaces them by the values after the jump. It also contains the
end conditions and the terminal cost of the earlier phase. The multipliers and slacks of these conditions are linking
variables, not unknowns of nodes. Often the length of the phase satisfies a condition: then the chain of intervals alone
is determined without these unknowns.

The variational method has no velocities or momenta at nodes. The equation of motion at a node says that the momentum of
the interval before equals the momentum of the interval after, which is correct where momenta are continuous. Elsewhere
the velocity (of a Hamiltonian: the momentum) w before the switch is an unknown that both sides match,

    D2 Ld(q_{k-1}, q_k) + f+_{k-1} = P(q_k, w),    -D1 Ld(q_k+, q_{k+1}) - f-_k = P+(q_k+, w+),

where q_k+ and w+ are the values after the jump, P and P+ the momenta of a velocity by the Lagrangian before and after
it (of a Hamiltonian: w itself). The first equation keeps the multiplier lambda_k of the node, the second has pi, an
unknown of the interval.

Constraints, holonomic or rolling, are the same in all phases. Where momenta are continuous, the constraint force
kappa_k of the node acts in both phases. Elsewhere each phase has its own force at the switch, because each must give
the momentum of the same velocity w. That velocity satisfies the constraint: dc/dt = 0, or A w + b = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.conditions.ends import imposed
from codegen.discretise.conditions.holonomic import Constraints
from codegen.discretise.conditions.integral import end_share, own_unknowns, with_distinct_integral_names
from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Boundary, Condition, Model, prescribed
from codegen.discretise.model.guesses import coordinate_guess, momentum_guess, with_guesses
from codegen.discretise.model.values import values_at_guess
from codegen.discretise.program import (
    ControlProgram,
    EndElement,
    Equation,
    IntervalElement,
    Names,
    Phase,
    Unknown,
    in_scales,
    occurring,
    symbols,
)
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.checks import rounded_at
from codegen.symbolic.derivatives import gradient
from codegen.symbolic.zeros import identically_zero


def chained(model: Model, transcribed: Callable[[Model], ControlProgram]) -> ControlProgram:
    """Return the program of a problem of several phases; `transcribed` returns the program of one phase."""
    model = with_guesses(model)
    last = len(model.phases) - 1
    free = Boundary((None,) * len(model.coordinates), (None,) * len(model.rates))
    programs = [
        transcribed(
            replace(
                phase,
                controls=model.controls,
                duration=model.duration,
                start=phase.start if index == 0 else free,
                end=phase.end if index == last else free,
                end_conditions=phase.end_conditions if index == last else (),
                terminal_cost=phase.terminal_cost if index == last else S.Zero,
            )
        )
        for index, phase in enumerate(model.phases)
    ]
    # Multipliers and slacks of path conditions get the same names in all phases. Unknowns of the end alone get other
    # names than unknowns of the start alone.
    initial, final = programs[0], programs[-1]
    from_start, from_end = _of_end(initial, initial.start), _of_end(final, final.end)
    names = Names(initial.model)
    names.reserve(unknown.name for unknown in (*from_start, *from_end))
    for program in programs:
        others = (*(program.node[i] for i in program.only_at_ends), *_path_multipliers(program))
        names.reserve(u.name for u in (*program.node, *program.interval) if u not in others)
    taken = {unknown.name for unknown in from_start}
    new = {u.name: names.named("end", Symbol(u.name)) for u in from_end if u.name in taken}
    slots, renamed = Slots(names), list[ControlProgram]()
    for program in (*programs[:-1], _renamed(final, new)):
        inequalities = {program.interval[i].name: slack for slack, i in _slack_pairs(program)}
        equalities = [u.name for u in _path_multipliers(program) if u.name not in inequalities]
        new = {name: slots.numbered("y", True, index) for index, name in enumerate(equalities)}
        for index, (name, slack) in enumerate(inequalities.items()):
            new |= {name: slots.numbered("y", False, index), slack.name: slots.numbered("s", False, index)}
        renamed.append(_renamed(program, new))
    programs = with_distinct_integral_names(renamed, slots.names)
    switches = [_switch(model, i, programs, slots) for i in range(1, len(programs))]
    return _Chain(model, programs, [None, *switches]).program()


class Slots:
    """Names of unknowns that have different meanings in different phases: `y_1` is the first multiplier in each."""

    def __init__(self, names: Names) -> None:
        """Take new names from `names`."""
        self.names = names
        self._numbered, self._named = dict[tuple[str, bool], list[str]](), dict[tuple[str, Symbol], str]()

    def numbered(self, stem: str, equality: bool, index: int) -> str:
        """Return the name `<stem>_<number>` for the equality, or inequality, with an index in an interval."""
        slots = self._numbered.setdefault((stem, equality), [])
        while len(slots) <= index:
            slots.append(self.names.numbered(stem))
        return slots[index]

    def named(self, stem: str, quantity: Symbol) -> str:
        """Return the name `<stem>_<quantity>` for an unknown of intervals."""
        if (stem, quantity) not in self._named:
            self._named[stem, quantity] = self.names.named(stem, quantity)
        return self._named[stem, quantity]


def _path_multipliers(program: ControlProgram) -> tuple[Unknown, ...]:
    """Return the multipliers of path conditions on intervals."""
    return program.interval[len(program.interval) - program.path_multipliers :]


def _of_end(program: ControlProgram, end: EndElement) -> list[Unknown]:
    """Return the unknowns that only the node at this end has."""
    pinned = {index for index, _ in end.pins}
    return [program.node[i] for i in program.only_at_ends if i not in pinned]


def _slack_pairs(program: ControlProgram) -> list[tuple[Unknown, int]]:
    """Return pairs (slack of an interval, index of its multiplier in the interval)."""
    return list(zip(program.slacks, program.slack_multipliers, strict=True))


def _renamed(program: ControlProgram, new: Mapping[str, str]) -> ControlProgram:
    """Return a program with new names of unknowns; `new` maps old names to new names."""
    pairs = [zip(symbols(new, end), symbols(new.values(), end), strict=True) for end in ("_k", "_k1")]
    substitution = {s: t for pair in pairs for s, t in pair}

    def unknowns(old: Iterable[Unknown]) -> tuple[Unknown, ...]:
        return tuple(replace(unknown, name=new.get(unknown.name, unknown.name)) for unknown in old)

    def written(old: Iterable[Equation]) -> tuple[Equation, ...]:
        return tuple(replace(e, slack=new.get(e.slack, e.slack)) for e in in_scales(old, substitution))

    def end(old: EndElement) -> EndElement:
        determined = tuple((new.get(name, name), condition) for name, condition in old.determined)
        conditions = written(old.conditions)
        return replace(old, element=old.element.xreplace(substitution), conditions=conditions, determined=determined)

    return replace(
        program,
        node=unknowns(program.node),
        interval=unknowns(program.interval),
        slacks=unknowns(program.slacks),
        interval_symbols=tuple(substitution.get(symbol, symbol) for symbol in program.interval_symbols),
        element=program.element.xreplace(substitution),
        equations=written(program.equations),
        start=end(program.start),
        end=end(program.end),
    )


@dataclass(frozen=True)
class Switch:
    """The difference between the first interval of a phase and the intervals that follow it.

    `values` replace symbols of its left node; `element` and `cost` are added. `unknowns` are further unknowns of the
    interval (primal unknowns first), and `shared` are linking variables. `jumping` names quantities of the node that
    change, `given` quantities with a prescribed value at the switch, and `broken` coordinates and momenta that may
    change. `guess` pairs names of unknowns with their initial guesses.
    """

    values: Mapping[Symbol, Expr]
    element: Expr = S.Zero
    cost: Expr = S.Zero
    unknowns: tuple[Unknown, ...] = ()
    shared: tuple[Unknown, ...] = ()
    jumping: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    broken: tuple[str, ...] = ()
    guess: tuple[tuple[str, Expr], ...] = ()
    equations: tuple[Equation, ...] = ()


class Transition:
    """Two consecutive phases: their models before transcription, their programs, and the jump between them."""

    def __init__(self, chain: Model, number: int, programs: Sequence[ControlProgram], slots: Slots) -> None:
        """Collect the conditions at the switch before phase `number`; `programs` are the programs of all phases."""
        self.before, self.after = chain.phases[number - 1], chain.phases[number]
        self.programs = programs[number - 1], programs[number]
        self.jump = dict(chain.jumps[number - 1])
        self.number = number
        self.slots, self.variational = slots, programs[0].method == "variational"
        self.left = dict(zip((u.name for u in programs[number].node), programs[number].left_symbols, strict=True))
        self.quantities = (*self.before.coordinates, *self.before.rates)
        self.constraints = Constraints(self.before, Names(self.before))
        fixed = prescribed(self.before, "end")
        implied = _implied(self.before, fixed)
        values = tuple(Condition(f"{s} = {value}", s - value) for s, value in fixed.items() if s not in implied)
        earlier = [g.expression for g in nodal_conditions(self.before, equality=False)]
        new = tuple(
            g
            for g in nodal_conditions(self.after, equality=False)
            if g.expression not in earlier
            and not g.expression.free_symbols & set(self.jump)
            and not g.expression.free_symbols & set(self.quantities) <= set(fixed)
        )
        self.conditions = (*values, *self.before.end_conditions, *new)
        self.matched = self._matched() if self.variational else set()
        if self.matched and self.before.end is not None:
            at_end = {value: value for value in fixed.values()}
            self.conditions += self.constraints.tangency(self.before.end, self.matched, at_end)
        substitution: dict[Symbol, Expr] = {q: self.left[q.name] for q in self.before.coordinates}
        for i, rate in enumerate(self.before.rates):
            if self.variational:
                if i in self.matched:
                    (substitution[rate],) = symbols([self.slots.named("switch", rate)], "_k")
            elif self.before.form == "hamiltonian":
                substitution[rate] = self.left[rate.name]
            else:
                phase = self.programs[0].model
                node = {s: self.left[s.name] for s in (*phase.coordinates, *phase.rates)}
                substitution[rate] = sympy.diff(phase.function, phase.rates[i]).subs(node, simultaneous=True)
        self.substitution = substitution

    def _matched(self) -> set[int]:
        """Return indices of momenta that change at the switch, or on whose velocity a term at the switch depends."""
        before = _momenta(self.before)
        after = [p.subs(self.jump, simultaneous=True) for p in _momenta(self.after)]
        rates = self.before.rates
        expressions = [c.expression for c in self.conditions] + [self.before.terminal_cost]
        expressions += [value for symbol, value in self.jump.items() if symbol not in rates]
        matched = occurring(rates, *expressions)
        matched |= {i for i, (p, q) in enumerate(zip(before, after, strict=True)) if not identically_zero(p - q)}
        while True:
            further = occurring(rates, *(p for i in matched for p in (before[i], after[i])))
            further |= {i for touched in self.constraints.touched if touched & matched for i in touched}
            if further <= matched:
                return matched
            matched |= further

    def at(self, expression: Expr) -> Expr:
        """Return an expression of coordinates and rates before the jump, written in symbols of the interval."""
        return expression.subs(self.substitution, simultaneous=True)

    def jumped(self, symbol: Symbol) -> Expr:
        """Return the value of a coordinate or rate after the jump."""
        return self.at(self.jump.get(symbol, symbol))

    def after_jump(self, expression: Expr) -> Expr:
        """Return an expression of coordinates and rates after the jump, written in symbols of the interval."""
        after = {s: self.jumped(s) for s in self.quantities if s in self.substitution}
        return expression.subs(after, simultaneous=True)


def _implied(model: Model, fixed: Mapping[Symbol, Expr]) -> set[Symbol]:
    """Return coordinates whose values at the end of a phase follow from its other values and the constraints.

    Each constraint on prescribed coordinates alone determines one of them: that with the largest slope.
    """
    at = values_at_guess(model) | {model.time: 0.0}
    numbers = {q: rounded_at(fixed[q], at) for q in model.coordinates if q in fixed}
    at |= {q: number for q, number in numbers.items() if number is not None}
    closed = [c for c in model.holonomic if c.free_symbols & {*model.coordinates} <= {*numbers}]
    slopes = np.array([[rounded_at(sympy.diff(c, q), at) or 0.0 for q in numbers] for c in closed])
    implied = set[Symbol]()
    for row in range(len(closed)):
        column = int(np.abs(slopes[row]).argmax())
        if slopes[row, column]:
            implied.add([*numbers][column])
            slopes[row + 1 :] -= np.outer(slopes[row + 1 :, column] / slopes[row, column], slopes[row])
    return implied


def _momenta(model: Model) -> list[Expr]:
    """Return the momenta dL/dv of a Lagrangian, or the symbols p of a Hamiltonian; [] for a first-order system."""
    if model.form == "lagrangian":
        return list(gradient(model.function, model.rates))
    return list(model.rates)


def _switch(chain: Model, number: int, programs: Sequence[ControlProgram], slots: Slots) -> Switch:
    """Return the switch before phase `number` of a chain."""
    transition = Transition(chain, number, programs, slots)
    motion = _matched_momenta(transition) if transition.variational else _replaced_states(transition)
    # Conditions and terminal cost of the phase before.
    cost = transition.at(transition.before.terminal_cost)
    shared, equations, element = list[Unknown](), list[Equation](), motion.element + cost
    for condition in transition.conditions:
        value, kind = transition.at(condition.expression), Kind.SWITCH_CONDITION
        unknowns, term, equation = imposed(condition, value, slots.names, kind, "", number, S.Zero)
        shared += unknowns
        element += term
        equations.append(equation)
    return replace(
        motion,
        element=element,
        cost=cost,
        shared=tuple(shared),
        given=tuple(s.name for s in prescribed(transition.before, "end") if s.name in transition.left),
        equations=(*equations, *motion.equations, *([Equation(cost, "cost")] if cost != 0 else [])),
    )


def _replaced_states(transition: Transition) -> Switch:
    """Return the switch for one-step methods: the states after the jump replace the states at the left node."""
    changed = {q.name: transition.jumped(q) for q in transition.before.coordinates if q in transition.jump}
    before = [transition.at(p) for p in _momenta(transition.before)]
    after = [transition.after_jump(p) for p in _momenta(transition.after)]
    for p, old, new in zip(transition.programs[1].model.rates, before, after, strict=True):
        if not identically_zero(new - old):
            changed[p.name] = new
    return Switch(
        {transition.left[name]: value for name, value in changed.items()},
        jumping=tuple(changed),
        broken=tuple(changed),
        equations=tuple(Equation(value, f"{name} after the switch") for name, value in changed.items()),
    )


def _matched_momenta(transition: Transition) -> Switch:
    """Return the switch for the variational method: replaced coordinates, and momenta that match the velocity."""
    model = transition.before
    jumping = [q for q in model.coordinates if q in transition.jump]
    values = {transition.left[q.name]: transition.jumped(q) for q in jumping}
    equations = [Equation(transition.jumped(q), f"{q} after the switch") for q in jumping]
    has_velocities = model.form == "lagrangian"
    kind = Kind.SWITCH_VELOCITY if has_velocities else Kind.SWITCH_MOMENTUM
    guesses = [sympy.diff(q, model.time) for q in coordinate_guess(model)] if has_velocities else momentum_guess(model)
    broken = [q.name for q in jumping]
    primal, multipliers, guess, element = list[Unknown](), list[Unknown](), list[tuple[str, Expr]](), S.Zero
    before, after = _momenta(model), _momenta(transition.after)
    for i in sorted(transition.matched):
        q, rate = model.coordinates[i], model.rates[i]
        node_multiplier = transition.left[f"lambda_{q}"]
        name, multiplier = transition.slots.named("switch", rate), transition.slots.named("pi", q)
        primal.append(Unknown(name, Meaning(kind, rate.name)))
        multipliers.append(Unknown(multiplier, Meaning(Kind.SWITCH_MATCH, q.name)))
        (pi,) = symbols([multiplier], "_k")
        values[node_multiplier] = pi
        arriving, leaving = transition.at(before[i]), transition.after_jump(after[i])
        element += pi * leaving - node_multiplier * arriving
        guess.append((name, guesses[i]))
        broken.append(f"p_{q}" if has_velocities else rate.name)
        equations.append(Equation(arriving, f"p_{q} before the switch", momentum=True))
        equations.append(Equation(leaving, f"p_{q} after the switch", momentum=True))
    for force, touched in zip(transition.constraints.kappa, transition.constraints.touched, strict=True):
        if touched & transition.matched:
            own = transition.slots.named("switch", Symbol(force.name, real=True))
            primal.append(Unknown(own, replace(force.meaning, kind=Kind.SWITCH_FORCE)))
            (values[transition.left[force.name]],) = symbols([own], "_k")
            guess.append((own, S.Zero))
    return Switch(
        values,
        element=element,
        unknowns=(*primal, *multipliers),
        jumping=tuple(q.name for q in jumping),
        broken=tuple(broken),
        guess=tuple(guess),
        equations=tuple(equations),
    )


class _Chain:
    """The programs of single phases, and the switch before each phase except the first.

    Every interval and every node has the unknowns of all phases and switches, each name once. Unknowns of the start and
    of the end alone, `from_start` and `from_end`, come last in a node.
    """

    def __init__(self, model: Model, programs: Sequence[ControlProgram], switches: Sequence[Switch | None]) -> None:
        self.model, self.programs, self.switches = model, programs, switches
        first, last = programs[0], programs[-1]
        self.from_start, self.from_end = _of_end(first, first.start), _of_end(last, last.end)
        base = [u for i, u in enumerate(first.node) if i not in first.only_at_ends]
        self.node = (*base, *self.from_start, *self.from_end)
        of_switches = [unknown for switch in switches if switch for unknown in switch.unknowns]
        self.interval = _union([u for p in programs for u in p.interval] + of_switches)
        self.slacks = _union([u for p in programs for u in p.slacks])
        self.inside = (*self.interval, *first.controls, *self.slacks)
        # The symbol of a stage is its name; the symbols of other unknowns have a suffix.
        usual = zip(self.inside, symbols([unknown.name for unknown in self.inside], "_k"), strict=True)
        pairs = [pair for p in programs for pair in zip(p.interval, p.interval_symbols, strict=True)]
        stages = {u.name: symbol for u, symbol in pairs if u.name == symbol.name}
        self.symbols = tuple(stages.get(u.name, symbol) for u, symbol in usual)

    def program(self) -> ControlProgram:
        """Return the program of the chain."""
        first, last = self.programs[0], self.programs[-1]
        phases = tuple(self._phase(i) for i in range(len(self.programs)))
        multipliers = {slack.name: p.interval[i].name for p in self.programs for slack, i in _slack_pairs(p)}
        # Linking variables of integrals and of switches come first, then free parameters.
        integrals = [own for program in self.programs for own in own_unknowns(program.integrals)]
        of_switches = [unknown for switch in self.switches if switch for unknown in switch.shared]
        common = first.linking
        shared = [
            *((own.unknown, own.symbol, own.guess) for own in integrals),
            *((unknown, Symbol(unknown.name, real=True), S.Zero) for unknown in of_switches),
            *list(zip(common.unknowns, common.symbols, common.guess, strict=True))[common.own :],
        ]
        earlier_integrals = Add(*(end_share(program.integrals).element for program in self.programs[:-1]))
        only_at_ends = len(self.from_start) + len(self.from_end)
        return replace(
            first,
            model=replace(
                first.model,
                end=last.model.end,
                end_conditions=last.model.end_conditions,
                terminal_cost=last.model.terminal_cost,
                phases=tuple(program.model for program in self.programs),
                jumps=self.model.jumps,
            ),
            node=self.node,
            interval=self.interval,
            slacks=self.slacks,
            slack_multipliers=tuple(_index(self.interval, multipliers[slack.name]) for slack in self.slacks),
            interval_symbols=self.symbols[: len(self.interval)],
            linking=replace(
                common,
                unknowns=tuple(unknown for unknown, _, _ in shared),
                symbols=tuple(symbol for _, symbol, _ in shared),
                guess=tuple(guess for _, _, guess in shared),
                own=0,
            ),
            integrals=(),
            element=phases[0].regular.element,
            cost=phases[0].regular.cost,
            equations=phases[0].equations,
            boundary_values=(*first.boundary_values, *last.boundary_values),
            only_at_ends=tuple(range(len(self.node) - only_at_ends, len(self.node))),
            start=self._end(0, first.start, _filling(self.from_start, "_k"), self.from_end),
            end=self._end(len(self.programs) - 1, last.end, earlier_integrals, self.from_start),
            scaled_time=True,
            phases=phases,
        )

    def _scales(self, index: int) -> dict[Symbol, Expr]:
        """Return the step and the time of a phase as functions of the step and the time of the chain."""
        durations = [phase.duration for phase in self.model.phases]
        begin, time = Add(*durations[:index]), self.model.time
        return {STEP: durations[index] * STEP, time: begin + durations[index] * (time - index)}

    def _phase(self, index: int) -> Phase:
        program, switch, model = self.programs[index], self.switches[index], self.model.phases[index]
        scales = self._scales(index)
        present = {u.name for u in (*program.interval, *program.slacks)} | {u.name for u in model.controls}
        element = program.element - _filling([program.node[i] for i in program.only_at_ends], "_k")
        element += _filling(self.from_end, "_k") + _filling(self.from_start, "_k1")

        def scaled(element: Expr, cost: Expr, present: set[str]) -> IntervalElement:
            absent = tuple(i for i, unknown in enumerate(self.inside) if unknown.name not in present)
            filling = Add(*(self.symbols[i] ** 2 / 2 for i in absent))
            return IntervalElement(element.xreplace(scales) + filling, cost.xreplace(scales), absent)

        at_switch = None
        if switch is not None and (switch.values or switch.element != 0):
            own = {unknown.name for unknown in switch.unknowns}
            first, cost = (part.xreplace(dict(switch.values)) for part in (element, program.cost))
            at_switch = scaled(first + switch.element, cost + switch.cost, present | own)
        unknowns = {u.name: u for u in (*program.node, *program.interval, *program.controls, *program.slacks)}
        guess = program.guess
        guesses = [*zip(program.interval, guess.stages, guess.stage_times, strict=False)]
        guesses += zip(program.controls, guess.controls, guess.control_times, strict=True)
        return Phase(
            duration=model.duration,
            regular=scaled(element, program.cost, present),
            switch=at_switch,
            node=tuple(unknowns.get(u.name, u) for u in self.node),
            inside=tuple(unknowns.get(u.name, u) for u in self.inside),
            jumping=() if switch is None else tuple(_index(self.node, name) for name in switch.jumping),
            given=() if switch is None else tuple(_index(self.node, name) for name in switch.given),
            broken=() if switch is None else switch.broken,
            node_guess=guess.node,
            inside_guess=tuple((_index(self.inside, u.name), v, c) for u, v, c in guesses if u.name in present),
            switch_guess=() if switch is None else tuple((_index(self.inside, n), value) for n, value in switch.guess),
            holding=tuple(
                replace(each, unknowns=tuple(_index(self.node, program.node[i].name) for i in each.unknowns))
                for each in guess.holding
            ),
            equations=in_scales(program.equations, scales),
            switch_equations=() if switch is None else in_scales(switch.equations, scales),
            integrals=program.integrals,
        )

    def _end(self, index: int, end: EndElement, added: Expr, foreign: Sequence[Unknown]) -> EndElement:
        """Return an end in the layout of the chain; unknowns of the other end alone (`foreign`) are zero."""
        names, scales = [u.name for u in self.node], self._scales(index)
        # Inequalities on coordinates add unknowns to the start or end of a single phase, which the chain lacks.
        moved = {i: names.index(u.name) for i, u in enumerate(self.programs[index].node) if u.name in names}
        pins = {moved[i]: value for i, value in end.pins if i in moved}
        pins |= {names.index(unknown.name): S.Zero for unknown in foreign}
        return replace(
            end,
            pins=tuple(pins.items()),
            element=(end.element + added).xreplace(scales),
            cost=end.cost.xreplace(scales),
            conditions=in_scales(end.conditions, scales),
            shared=tuple((moved[i], j, offset) for i, j, offset in end.shared),
            slacks=tuple((moved[i], moved[j]) for i, j in end.slacks),
            bounds=tuple((moved[i], bound) for i, bound in end.bounds),
        )


def _union(unknowns: Sequence[Unknown]) -> tuple[Unknown, ...]:
    """Return an unknown for every name, with all meanings of the name; primal unknowns come before multipliers."""
    meanings: dict[str, dict[Meaning, None]] = {}
    for unknown in unknowns:
        meanings.setdefault(unknown.name, {})[unknown.meaning] = None
    named = dict[str, Unknown]()
    for unknown in unknowns:
        first, *others = meanings[unknown.name]
        named[unknown.name] = replace(unknown, meaning=replace(first, others=tuple(others)))
    return tuple(sorted(named.values(), key=lambda unknown: unknown.multiplier))


def _index(unknowns: Sequence[Unknown], name: str) -> int:
    return next(i for i, unknown in enumerate(unknowns) if unknown.name == name)


def _filling(unknowns: Sequence[Unknown], suffix: str) -> Expr:
    """Return the sum of x^2/2 over the unknowns x of a node, which makes them vanish."""
    return Add(*(symbol**2 / 2 for symbol in symbols([u.name for u in unknowns], suffix)))
