"""Control task of several phases -> ControlProgram: the phases' intervals in one chain.

Every phase is transcribed by itself. With P of them the chain's time runs from 0 to P, so that an interval's time tells
its phase, and in the share of phase i, which begins at t_i and lasts D_i, h -> D_i h and t -> t_i + D_i (t - i). All
intervals have the same unknowns, those that any phase has; x^2/2 makes the others vanish. Unknowns that are numbered
mean different things in different phases.

What happens at a switch from one phase to the next, as the share of the interval that follows it.

The node at a switch holds the values before it. In the first interval of the later phase they are replaced by those
after the jump; its share also imposes what the earlier phase says of its end, and has the earlier phase's terminal
cost. The multipliers and slacks of these conditions are shared unknowns, which no node owns, because a chain of
intervals may well be determined without them: it is often the length of the phase that makes a condition hold.

The variational method has no velocities or momenta at nodes, where the equation of motion says that the momentum of
the interval before equals that of the interval after. That is what holds where momenta do not change. Where they
change, the velocity (of a Hamiltonian: the momentum) w before the switch is an unknown, and both sides match it,

    D2 Ld(q_{k-1}, q_k) + f+_{k-1} = P(q_k, w),    -D1 Ld(q_k+, q_{k+1}) - f-_k = P+(q_k+, w+),

where q_k+ and w+ are the values after the jump, P and P+ the momenta of a velocity by the Lagrangian before and after
it (of a Hamiltonian: w itself). The first equation keeps the multiplier lambda_k of the node, the second has pi, an
unknown of the interval.

Names of unknowns in a chain of phases: the same name where phases may share an index, others where they may not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.conditions.ends import Imposed, imposed
from codegen.discretise.conditions.integral import end_share, own_unknowns, with_distinct_integral_names
from codegen.discretise.conditions.path import nodal_conditions
from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Boundary, Condition, Model, prescribed
from codegen.discretise.model.guesses import coordinate_guess, momentum_guess, with_guesses
from codegen.discretise.program import (
    ControlProgram,
    EndElement,
    IntervalElement,
    Names,
    Phase,
    Unknown,
    occurring,
    symbols,
)
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic.derivatives import gradient
from codegen.symbolic.zeros import identically_zero


class Slots:
    """Names of unknowns that different intervals may use for different things: `y_1` is the first of each."""

    def __init__(self, names: Names) -> None:
        """Take names from those that are free."""
        self.names = names
        self._numbered, self._named = dict[tuple[str, bool], list[str]](), dict[tuple[str, Symbol], str]()

    def numbered(self, stem: str, equality: bool, index: int) -> str:
        """The name that belongs to equality, or inequality, number `index` of an interval."""
        found = self._numbered.setdefault((stem, equality), [])
        while len(found) <= index:
            found.append(self.names.numbered(stem))
        return found[index]

    def named(self, stem: str, quantity: Symbol) -> str:
        """The name of an interval's unknown that belongs to a quantity."""
        if (stem, quantity) not in self._named:
            self._named[stem, quantity] = self.names.named(stem, quantity)
        return self._named[stem, quantity]


def with_common_names(programs: Sequence[ControlProgram]) -> tuple[list[ControlProgram], Slots]:
    """The programs of all phases with names that fit together, and a source of further ones.

    Path conditions of different phases have multipliers and slacks of the same names. Unknowns that only the end has
    are not called like those that only the start has.
    """
    names = _names(programs)
    last = _renamed(programs[-1], _new_end_names(programs, names))
    slots = Slots(names)
    return [_renamed(program, _numbered(program, slots)) for program in (*programs[:-1], last)], slots


def _names(programs: Sequence[ControlProgram]) -> Names:
    """Names that no node, stage or multiplier of a step has."""
    names = Names(programs[0].model)
    names.reserve(unknown.name for unknown in (*at_start(programs[0]), *at_end(programs[-1])))
    for program in programs:
        others = (*only_at_ends(program), *_numbered_multipliers(program))
        names.reserve(u.name for u in (*program.node, *program.interval) if u not in others)
    return names


def _numbered_multipliers(program: ControlProgram) -> list[Unknown]:
    """The multipliers of path conditions on intervals."""
    return list(program.interval[len(program.interval) - program.path_multipliers :])


def only_at_ends(program: ControlProgram) -> list[Unknown]:
    """The unknowns of a node that only the first or the last one has."""
    return [program.node[i] for i in program.only_at_ends]


def at_start(program: ControlProgram) -> list[Unknown]:
    """Those that the first node has."""
    pinned = {index for index, _ in program.start.pins}
    return [program.node[i] for i in program.only_at_ends if i not in pinned]


def at_end(program: ControlProgram) -> list[Unknown]:
    """Those that the last node has."""
    pinned = {index for index, _ in program.end.pins}
    return [program.node[i] for i in program.only_at_ends if i not in pinned]


def _new_end_names(programs: Sequence[ControlProgram], names: Names) -> dict[str, str]:
    """Other names for those unknowns of the end that are called like unknowns of the start."""
    taken = {unknown.name for unknown in at_start(programs[0])}
    return {
        unknown.name: names.named("end", Symbol(unknown.name))
        for unknown in at_end(programs[-1])
        if unknown.name in taken
    }


def _numbered(program: ControlProgram, slots: Slots) -> dict[str, str]:
    """Names for the multipliers and slacks of path conditions, the same in all phases."""
    inequalities = {program.interval[index].name: slack for slack, index in slack_pairs(program)}
    equalities = [u.name for u in _numbered_multipliers(program) if u.name not in inequalities]
    new = {name: slots.numbered("y", True, index) for index, name in enumerate(equalities)}
    for index, (name, slack) in enumerate(inequalities.items()):
        new |= {name: slots.numbered("y", False, index), slack.name: slots.numbered("s", False, index)}
    return new


def slack_pairs(program: ControlProgram) -> list[tuple[Unknown, int]]:
    """Slacks of intervals with the indices of their multipliers."""
    return list(zip(program.slacks, program.slack_multipliers, strict=True))


def _renamed(program: ControlProgram, new: Mapping[str, str]) -> ControlProgram:
    """The program with other names for some unknowns."""
    pairs = [zip(symbols(new, end), symbols(new.values(), end), strict=True) for end in ("_k", "_k1")]
    substitution = {s: t for pair in pairs for s, t in pair}

    def unknowns(old: Iterable[Unknown]) -> tuple[Unknown, ...]:
        return tuple(replace(unknown, name=new.get(unknown.name, unknown.name)) for unknown in old)

    def put(old: Iterable[Symbol]) -> tuple[Symbol, ...]:
        return tuple(substitution.get(symbol, symbol) for symbol in old)

    def written(old: Iterable[tuple[str, Expr]]) -> tuple[tuple[str, Expr], ...]:
        # The left side of an inequality names its slack.
        names = {f"-{slack}": f"-{name}" for slack, name in new.items()}
        parts = [(left.partition(" "), value) for left, value in old]
        return tuple((names.get(a, a) + blank + rest, v.xreplace(substitution)) for (a, blank, rest), v in parts)

    def end(old: EndElement) -> EndElement:
        decided = tuple((new.get(name, name), condition) for name, condition in old.determined)
        conditions = written(old.conditions)
        return replace(old, element=old.element.xreplace(substitution), conditions=conditions, determined=decided)

    return replace(
        program,
        node=unknowns(program.node),
        interval=unknowns(program.interval),
        slacks=unknowns(program.slacks),
        left_symbols=put(program.left_symbols),
        right_symbols=put(program.right_symbols),
        interval_symbols=put(program.interval_symbols),
        slack_symbols=put(program.slack_symbols),
        element=program.element.xreplace(substitution),
        equations=written(program.equations),
        start=end(program.start),
        end=end(program.end),
    )


@dataclass(frozen=True)
class Switch:
    """What the first interval of a phase has beside those that follow it.

    `values` take the place of symbols of its left node, `element` and `cost` are added; `unknowns` are those of the
    interval (primal ones first), `shared` those that no node owns. `jumping` names what changes in the node, `given`
    what has a prescribed value there, `broken` coordinates and momenta that change or may do so; `guess` gives values
    to unknowns by name.
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
    equations: tuple[tuple[str, Expr], ...] = ()

    @property
    def is_idle(self) -> bool:
        """Whether the first interval is like any other."""
        return not self.values and self.element == 0


class Transition:
    """Two models that follow each other, as their author wrote them, with the program of each."""

    def __init__(self, chain: Model, number: int, programs: Sequence[ControlProgram], slots: Slots) -> None:
        """The switch before phase `number`, whose programs are those of all phases by themselves."""
        self.before, self.after = chain.phases[number - 1], chain.phases[number]
        self.programs = programs[number - 1], programs[number]
        self.jump = dict(chain.jumps[number - 1])
        self.number = number
        self.slots, self.variational = slots, programs[0].method == "variational"
        self.left = dict(zip((u.name for u in programs[number].node), programs[number].left_symbols, strict=True))
        self.quantities = (*self.before.coordinates, *self.before.rates)
        self.matched = self._matched() if self.variational else set()
        self.substitution = self._substitution()

    def conditions(self) -> tuple[Condition, ...]:
        """What holds before the jump: values, conditions, and inequalities of the later phase that are new here."""
        given = prescribed(self.before, "end")
        values = tuple(Condition(f"{symbol} = {value}", symbol - value) for symbol, value in given.items())
        known = [g.expression for g in nodal_conditions(self.before, equality=False)]
        changed = set(self.jump)
        begun = tuple(
            g
            for g in nodal_conditions(self.after, equality=False)
            if g.expression not in known
            and not g.expression.free_symbols & changed
            and not g.expression.free_symbols & set(self.quantities) <= set(given)
        )
        return (*values, *self.before.end_conditions, *begun)

    def _matched(self) -> set[int]:
        """Indices of the momenta that differ before and after, or that something at the switch depends on."""
        before = momenta(self.before)
        after = [p.subs(self.jump, simultaneous=True) for p in momenta(self.after)]
        rates = self.before.rates
        expressions = [c.expression for c in self.conditions()] + [self.before.terminal_cost]
        expressions += [value for symbol, value in self.jump.items() if symbol not in rates]
        matched = occurring(rates, *expressions)
        matched |= {i for i, (p, q) in enumerate(zip(before, after, strict=True)) if not identically_zero(p - q)}
        while True:
            further = occurring(rates, *(p for i in matched for p in (before[i], after[i])))
            if further <= matched:
                return matched
            matched |= further

    def _substitution(self) -> dict[Symbol, Expr]:
        """Where coordinates and rates before the jump are found in the interval."""
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
        return substitution

    def at(self, expression: Expr) -> Expr:
        """An expression in coordinates and rates before the jump."""
        return expression.subs(self.substitution, simultaneous=True)

    def jumped(self, symbol: Symbol) -> Expr:
        """A coordinate or rate after the jump."""
        return self.at(self.jump.get(symbol, symbol))

    def after_jump(self, expression: Expr) -> Expr:
        """An expression in coordinates and rates after the jump."""
        after = {s: self.jumped(s) for s in self.quantities if s in self.substitution}
        return expression.subs(after, simultaneous=True)


def momenta(model: Model) -> list[Expr]:
    """The momenta of velocities, or the momenta of a Hamiltonian themselves; a first-order system has none."""
    if model.form == "lagrangian":
        return list(gradient(model.function, model.rates))
    return list(model.rates)


def switch(chain: Model, number: int, programs: Sequence[ControlProgram], slots: Slots) -> Switch:
    """The switch before phase `number` of a chain, whose phases all have guesses."""
    transition = Transition(chain, number, programs, slots)
    motion = _matched_momenta(transition) if transition.variational else _replaced_states(transition)
    return _conditioned(transition, motion, slots.names)


def _replaced_states(transition: Transition) -> Switch:
    """One-step methods: the states at the left node are those after the jump."""
    changed = {q.name: transition.jumped(q) for q in transition.before.coordinates if q in transition.jump}
    before = [transition.at(p) for p in momenta(transition.before)]
    after = [transition.after_jump(p) for p in momenta(transition.after)]
    for p, old, new in zip(transition.programs[1].model.rates, before, after, strict=True):
        if not identically_zero(new - old):
            changed[p.name] = new
    return Switch(
        {transition.left[name]: value for name, value in changed.items()},
        jumping=tuple(changed),
        broken=tuple(changed),
        equations=tuple((f"{name} after the switch", value) for name, value in changed.items()),
    )


def _matched_momenta(transition: Transition) -> Switch:
    """The variational method: coordinates after the jump, and momenta that match the velocity before and after it."""
    jumping = [q for q in transition.before.coordinates if q in transition.jump]
    values = {transition.left[q.name]: transition.jumped(q) for q in jumping}
    equations = [(f"{q} after the switch", transition.jumped(q)) for q in jumping]
    velocities = transition.before.form == "lagrangian"
    kind = Kind.SWITCH_VELOCITY if velocities else Kind.SWITCH_MOMENTUM
    broken = [q.name for q in jumping]
    primal, multipliers, guess, element = list[Unknown](), list[Unknown](), list[tuple[str, Expr]](), S.Zero
    before, after = momenta(transition.before), momenta(transition.after)
    for i in sorted(transition.matched):
        q, rate = transition.before.coordinates[i], transition.before.rates[i]
        node_multiplier = transition.left[f"lambda_{q}"]
        name, multiplier = transition.slots.named("switch", rate), transition.slots.named("pi", q)
        primal.append(Unknown(name, Meaning(kind, rate.name)))
        multipliers.append(Unknown(multiplier, Meaning(Kind.SWITCH_MATCH, q.name)))
        (pi,) = symbols([multiplier], "_k")
        values[node_multiplier] = pi
        arriving, leaving = transition.at(before[i]), transition.after_jump(after[i])
        element += pi * leaving - node_multiplier * arriving
        guess.append((name, _rate_guess(transition.before, i)))
        broken.append(f"p_{q}" if velocities else rate.name)
        equations += [(f"p_{q} before the switch", arriving), (f"p_{q} after the switch", leaving)]
    return Switch(
        values,
        element=element,
        unknowns=(*primal, *multipliers),
        jumping=tuple(q.name for q in jumping),
        broken=tuple(broken),
        guess=tuple(guess),
        equations=tuple(equations),
    )


def _rate_guess(model: Model, index: int) -> Expr:
    """A velocity along the guessed motion, or the guess of a momentum."""
    if model.form == "lagrangian":
        return sympy.diff(coordinate_guess(model)[index], model.time)
    return momentum_guess(model)[index]


def _conditioned(transition: Transition, motion: Switch, names: Names) -> Switch:
    """Add the conditions and the terminal cost of the phase before."""
    cost = transition.at(transition.before.terminal_cost)
    shared, equations, element = list[Unknown](), list[tuple[str, Expr]](), motion.element + cost
    for condition in transition.conditions():
        how = Imposed("nu", Kind.SWITCH_CONDITION, "", transition.number)
        unknowns, term, equation = imposed(condition, transition.at(condition.expression), how, names, S.Zero)
        shared += unknowns
        element += term
        equations.append(equation)
    return replace(
        motion,
        element=element,
        cost=cost,
        shared=tuple(shared),
        given=tuple(s.name for s in prescribed(transition.before, "end") if s.name in transition.left),
        equations=(*equations, *motion.equations, *([("cost", cost)] if cost != 0 else [])),
    )


def shared_symbol(name: str) -> Symbol:
    """The symbol of a shared unknown."""
    return Symbol(name, real=True)


def chained(model: Model, transcribed: Callable[[Model], ControlProgram]) -> ControlProgram:
    """Transcribe every phase by `transcribed` and put them into one chain; raises what that raises."""
    model = with_guesses(model)
    programs = [transcribed(_alone(model, i)) for i in range(len(model.phases))]
    programs, slots = with_common_names(programs)
    programs = with_distinct_integral_names(programs, slots.names)
    switches = [switch(model, i, programs, slots) for i in range(1, len(programs))]
    chain = _Chain(model, programs, [None, *switches])
    return chain.program()


def _alone(model: Model, index: int) -> Model:
    """A phase with free ends where other phases follow, in the time and with the controls of the whole problem."""
    phase, last = model.phases[index], len(model.phases) - 1
    free = Boundary((None,) * len(phase.coordinates), (None,) * len(phase.rates))
    return replace(
        phase,
        controls=model.controls,
        duration=model.duration,
        start=phase.start if index == 0 else free,
        end=phase.end if index == last else free,
        end_conditions=phase.end_conditions if index == last else (),
        terminal_cost=phase.terminal_cost if index == last else S.Zero,
    )


@dataclass(frozen=True)
class _Layout:
    """The unknowns of a chain: those of any phase and of any switch, each name once.

    `shared` are those of conditions at switches; `from_start` and `from_end` come last in a node.
    """

    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    controls: tuple[Unknown, ...]
    slacks: tuple[tuple[Unknown, str], ...]
    shared: tuple[Unknown, ...]
    from_start: tuple[Unknown, ...]
    from_end: tuple[Unknown, ...]
    stages: Mapping[str, Symbol]

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The symbols of the unknowns of an interval; those of stages are called like them."""
        usual = symbols([unknown.name for unknown in self.inside], "_k")
        return tuple(self.stages.get(u.name, symbol) for u, symbol in zip(self.inside, usual, strict=True))

    @property
    def inside(self) -> tuple[Unknown, ...]:
        """The unknowns of an interval in their order."""
        return (*self.interval, *self.controls, *(slack for slack, _ in self.slacks))

    def lacking(self, present: set[str]) -> tuple[int, ...]:
        """The indices inside an interval of what is not present there."""
        return tuple(i for i, unknown in enumerate(self.inside) if unknown.name not in present)


class _Chain:
    """Phases that were transcribed by themselves, and the switch before each but the first."""

    def __init__(self, model: Model, programs: Sequence[ControlProgram], switches: Sequence[Switch | None]) -> None:
        self.model, self.programs, self.switches = model, programs, switches
        self.layout = _laid_out(programs, [switch for switch in switches if switch is not None])

    def program(self) -> ControlProgram:
        """The program of the chain."""
        first, last, layout = self.programs[0], self.programs[-1], self.layout
        phases = tuple(self._phase(i) for i in range(len(self.programs)))
        shared = self._shared()
        base = len(layout.node) - len(layout.from_start) - len(layout.from_end)
        return replace(
            first,
            model=self._model(),
            node=layout.node,
            interval=layout.interval,
            slacks=tuple(slack for slack, _ in layout.slacks),
            slack_multipliers=tuple(_index(layout.interval, name) for _, name in layout.slacks),
            left_symbols=symbols([u.name for u in layout.node], "_k"),
            right_symbols=symbols([u.name for u in layout.node], "_k1"),
            interval_symbols=layout.symbols[: len(layout.interval)],
            slack_symbols=layout.symbols[len(layout.inside) - len(layout.slacks) :],
            shared=tuple(unknown for unknown, _, _ in shared),
            shared_symbols=tuple(symbol for _, symbol, _ in shared),
            shared_guess=tuple(guess for _, _, guess in shared),
            own=0,
            integrals=(),
            element=phases[0].regular.element,
            cost=phases[0].regular.cost,
            equations=phases[0].equations,
            boundary_values=(*first.boundary_values, *last.boundary_values),
            only_at_ends=tuple(range(base, len(layout.node))),
            start=self._end(0, first.start, -_filling(layout.from_start, "_k"), layout.from_end),
            end=self._end(-1, last.end, -self._earlier_integrals(), layout.from_start),
            scaled_time=True,
            phases=phases,
        )

    def _shared(self) -> list[tuple[Unknown, Symbol, Expr]]:
        """Shared unknowns, their symbols and guesses: those of integrals and of switches, then free parameters."""
        first = self.programs[0]
        integrals = [own for program in self.programs for own in own_unknowns(program.integrals)]
        free = zip(first.shared, first.shared_symbols, first.shared_guess, strict=True)
        return [
            *((own.unknown, own.symbol, own.guess) for own in integrals),
            *((unknown, shared_symbol(unknown.name), S.Zero) for unknown in self.layout.shared),
            *list(free)[first.own :],
        ]

    def _model(self) -> Model:
        """The model of the chain in the quantities in which it was transcribed."""
        first, last = self.programs[0].model, self.programs[-1].model
        return replace(
            first,
            end=last.end,
            end_conditions=last.end_conditions,
            terminal_cost=last.terminal_cost,
            phases=tuple(program.model for program in self.programs),
            jumps=self.model.jumps,
        )

    def _earlier_integrals(self) -> Expr:
        """What conditions on integrals over all phases but the last add to the end, which the last one alone has."""
        return Add(*(end_share(program.integrals).element for program in self.programs[:-1]))

    def _scales(self, index: int) -> dict[Symbol, Expr]:
        """How step and time of the chain give those of a phase."""
        durations = [phase.duration for phase in self.model.phases]
        index %= len(durations)
        begin, time = Add(*durations[:index]), self.model.time
        return {STEP: durations[index] * STEP, time: begin + durations[index] * (time - index)}

    def _phase(self, index: int) -> Phase:
        raw, switch, model = self.programs[index], self.switches[index], self.model.phases[index]
        controls = {u.name for u in model.controls}
        present = {u.name for u in (*raw.interval, *raw.slacks)} | controls
        element = raw.element - _filling(only_at_ends(raw), "_k")
        element += _filling(self.layout.from_end, "_k") + _filling(self.layout.from_start, "_k1")
        scales = self._scales(index)
        own_unknowns = {u.name: u for u in (*raw.node, *raw.interval, *raw.controls, *raw.slacks)}
        guesses = [(u.name, value) for u, value in zip(raw.interval, raw.stage_guess, strict=False)]
        guesses += [(u.name, value) for u, value in zip(raw.controls, raw.control_guess, strict=True)]
        return Phase(
            duration=model.duration,
            regular=self._element(element, raw.cost, present, scales),
            switch=None if switch is None or switch.is_idle else self._switch(switch, element, raw, present, scales),
            node=tuple(own_unknowns.get(u.name, u) for u in self.layout.node),
            inside=tuple(own_unknowns.get(u.name, u) for u in self.layout.inside),
            jumping=() if switch is None else tuple(_index(self.layout.node, name) for name in switch.jumping),
            given=() if switch is None else tuple(_index(self.layout.node, name) for name in switch.given),
            broken=() if switch is None else switch.broken,
            node_guess=raw.node_guess,
            inside_guess=self._placed((name, value) for name, value in guesses if name in present),
            switch_guess=() if switch is None else self._placed(switch.guess),
            equations=_written(raw.equations, scales),
            switch_equations=() if switch is None else _written(switch.equations, scales),
            integrals=raw.integrals,
        )

    def _placed(self, guesses: Iterable[tuple[str, Expr]]) -> tuple[tuple[int, Expr], ...]:
        return tuple((_index(self.layout.inside, name), value) for name, value in guesses)

    def _element(self, element: Expr, cost: Expr, present: set[str], scales: Mapping[Symbol, Expr]) -> IntervalElement:
        lacking = self.layout.lacking(present)
        filling = Add(*(self.layout.symbols[i] ** 2 / 2 for i in lacking))
        return IntervalElement(element.xreplace(scales) + filling, cost.xreplace(scales), lacking)

    def _switch(
        self, switch: Switch, element: Expr, raw: ControlProgram, present: set[str], scales: Mapping[Symbol, Expr]
    ) -> IntervalElement:
        own = {unknown.name for unknown in switch.unknowns}
        element, cost = (part.xreplace(dict(switch.values)) for part in (element, raw.cost))
        return self._element(element + switch.element, cost + switch.cost, present | own, scales)

    def _end(self, index: int, end: EndElement, filling: Expr, foreign: Sequence[Unknown]) -> EndElement:
        """An end in the layout of the chain; what only the other end has is pinned, and no filling is taken back."""
        names, scales = [u.name for u in self.layout.node], self._scales(index)
        # An inequality on coordinates gives a phase unknowns at a start or end that it does not have in the chain.
        moved = {i: names.index(u.name) for i, u in enumerate(self.programs[index].node) if u.name in names}
        pins = {moved[i]: value for i, value in end.pins if i in moved}
        pins |= {names.index(unknown.name): S.Zero for unknown in foreign}
        return replace(
            end,
            pins=tuple(pins.items()),
            element=(end.element - filling).xreplace(scales),
            cost=end.cost.xreplace(scales),
            conditions=_written(end.conditions, scales),
            shared=tuple((moved[i], j, offset) for i, j, offset in end.shared),
            slacks=tuple((moved[i], moved[j]) for i, j in end.slacks),
            bounds=tuple((moved[i], bound) for i, bound in end.bounds),
        )


def _laid_out(programs: Sequence[ControlProgram], switches: Sequence[Switch]) -> _Layout:
    first = programs[0]
    base = [u for i, u in enumerate(first.node) if i not in first.only_at_ends]
    from_start, from_end = tuple(at_start(first)), tuple(at_end(programs[-1]))
    added = [unknown for switch in switches for unknown in switch.unknowns]
    interval = _union([u for p in programs for u in p.interval], added)
    pairs = {slack.name: program.interval[i].name for program in programs for slack, i in slack_pairs(program)}
    return _Layout(
        (*base, *from_start, *from_end),
        interval,
        first.controls,
        tuple((slack, pairs[slack.name]) for slack in _union([u for p in programs for u in p.slacks], [])),
        tuple(unknown for switch in switches for unknown in switch.shared),
        from_start,
        from_end,
        {u.name: s for p in programs for u, s in zip(p.interval, p.interval_symbols, strict=True) if u.name == s.name},
    )


def _union(unknowns: Sequence[Unknown], added: Sequence[Unknown]) -> tuple[Unknown, ...]:
    """Every name once, primal unknowns before multipliers; numbered ones mean several things."""
    meanings: dict[str, dict[Meaning, None]] = {}
    for unknown in (*unknowns, *added):
        meanings.setdefault(unknown.name, {})[unknown.meaning] = None
    named = dict[str, Unknown]()
    for unknown in (*unknowns, *added):
        first, *others = meanings[unknown.name]
        named[unknown.name] = replace(unknown, meaning=replace(first, others=tuple(others)))
    return tuple(sorted(named.values(), key=lambda unknown: unknown.multiplier))


def _index(unknowns: Sequence[Unknown], name: str) -> int:
    return next(i for i, unknown in enumerate(unknowns) if unknown.name == name)


def _filling(unknowns: Sequence[Unknown], suffix: str) -> Expr:
    """A share that makes unknowns vanish."""
    return Add(*(symbol**2 / 2 for symbol in symbols([u.name for u in unknowns], suffix)))


def _written(pairs: Iterable[tuple[str, Expr]], scales: Mapping[Symbol, Expr]) -> tuple[tuple[str, Expr], ...]:
    return tuple((name, value.xreplace(scales)) for name, value in pairs)
