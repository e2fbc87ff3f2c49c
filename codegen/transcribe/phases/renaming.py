"""Names of unknowns in a chain of phases: the same name where phases may share an index, others where they may not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from sympy import Expr, Symbol

from codegen.transcribe.names import Names, symbols
from codegen.transcribe.program import ControlProgram, EndElement, Unknown


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
