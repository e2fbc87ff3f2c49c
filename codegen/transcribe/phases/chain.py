"""Control task of several phases -> ControlProgram: the phases' intervals in one chain.

Every phase is transcribed by itself. With P of them the chain's time runs from 0 to P, so that an interval's time tells
its phase, and in the share of phase i, which begins at t_i and lasts D_i, h -> D_i h and t -> t_i + D_i (t - i). All
intervals have the same unknowns, those that any phase has; x^2/2 makes the others vanish. Unknowns that are numbered
mean different things in different phases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Add, Expr, S, Symbol

from codegen.discretise import STEP
from codegen.model import Boundary, Model
from codegen.runtime.record import Meaning
from codegen.transcribe.conditions.integrals import end_share, own_unknowns, with_distinct_integral_names
from codegen.transcribe.names import symbols
from codegen.transcribe.phases.guesses import with_guesses
from codegen.transcribe.phases.renaming import at_end, at_start, only_at_ends, slack_pairs, with_common_names
from codegen.transcribe.phases.switches import Switch, shared_symbol, switch
from codegen.transcribe.program import ControlProgram, EndElement, IntervalElement, Phase, Unknown


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
