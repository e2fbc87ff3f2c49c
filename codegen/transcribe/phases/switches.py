"""What happens at a switch from one phase to the next, as the share of the interval that follows it.

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
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, S, Symbol

from codegen.expressions.tangents import gradient
from codegen.expressions.zeros import identically_zero
from codegen.model import Condition, Model
from codegen.model.conditions.path import nodal_conditions
from codegen.model.definitions import prescribed
from codegen.runtime.record import Kind, Meaning
from codegen.transcribe.conditions.ends import Imposed, imposed
from codegen.transcribe.forms import occurring
from codegen.transcribe.guesses import coordinate_guess, momentum_guess
from codegen.transcribe.names import Names, symbols
from codegen.transcribe.phases.renaming import Slots
from codegen.transcribe.program import ControlProgram, Unknown


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
