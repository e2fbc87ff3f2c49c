"""Every expression of a problem with its role and a name for messages, sympified and checked one by one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import sympy

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model.delays import history_entries
from codegen.discretise.model.relations import Entry, checked_mapping, checked_sequence, entry_of, value_entries
from codegen.errors import ExpressionError, SymbolError, TableError
from codegen.problem.problem import Control, Problem
from codegen.problem.symbols import (
    Coordinate,
    Delayed,
    EndValue,
    FreeParameter,
    Momentum,
    Quantity,
    Time,
    Velocity,
    time,
)
from codegen.problem.tables import guess_entries
from codegen.symbolic.functions import tables_of
from codegen.symbolic.tables import TableData


def written_entries(problem: Problem, form: str, jump: Sequence[Entry] = ()) -> list[Entry]:
    """All expressions of the problem, and of the jump before it, with those that declare its free parameters."""
    entries = [*_entries(problem, form), *jump]
    if isinstance(problem, Control):
        entries += _guesses(problem, entries)
    free = {symbol for entry in entries for symbol in _symbols(entry) if isinstance(symbol, FreeParameter)}
    for symbol in sorted(free, key=lambda symbol: symbol.declared):
        entries += _declared_values(symbol)
        for role in ("lower bound", "upper bound"):
            if sum(entry.role == role and entry.key == symbol for entry in entries) > 1:
                raise ExpressionError(f"{symbol} has two {role}s", "give it in free_parameter(...) or in bounds")
    return entries


def jump_entries(jumps: Any, switches: int) -> list[list[Entry]]:
    """The expressions of the jumps between phases, one list for each switch; none where there are no jumps at all."""
    given = checked_sequence("jumps", jumps, "{state: value after the switch}")
    if given and len(given) != switches:
        raise ExpressionError(
            f"jumps has {len(given)} entries for {switches} switches", "give one mapping for each switch, {} for none"
        )
    named = [(f"jumps[{index}]", mapping) for index, mapping in enumerate(given)]
    return [
        [
            entry_of("jump", f"{what} of {key}", value, key)
            for key, value in checked_mapping(what, mapping, "state: value after the switch").items()
        ]
        for what, mapping in named
    ]


def require_one_table_a_name(entries: Iterable[Entry]) -> None:
    """Refuse different tables of the same name."""
    seen: dict[str, TableData] = {}
    for table in tables_of([entry.expression for entry in entries]):
        other = seen.setdefault(table.shape.name, table)
        if other != table:
            raise TableError(
                f"two tables are called {table.shape.name}, from {other.source} and {table.source}",
                'give one of them another name, as in Table(..., name="drag_2")',
            )


def used_quantities(entries: Iterable[Entry]) -> list[Quantity]:
    """All declared quantities of the expressions, partners included, in the order of declaration.

    Raises SymbolError for a symbol that was never declared, and TableError for two tables of one name.
    """
    found: set[Quantity] = set()
    entries = list(entries)
    require_one_table_a_name(entries)
    for entry in entries:
        for symbol in _symbols(entry):
            if not isinstance(symbol, Quantity):
                raise SymbolError(
                    f"{symbol} in {entry.what} was never declared",
                    f'declare it, for example {symbol} = parameter("{symbol}", 1.0)',
                )
            found.add(symbol)
    found |= {symbol.partner for symbol in found if isinstance(symbol, (EndValue, Delayed))}
    found |= {symbol for value in found if isinstance(value, Delayed) for symbol in value.lag.free_symbols}
    found |= {symbol.partner for symbol in found if isinstance(symbol, (Coordinate, Velocity, Momentum))}
    return sorted(found, key=lambda symbol: symbol.declared)


def _symbols(entry: Entry) -> list[sympy.Symbol]:
    keys = [] if entry.key is None else [entry.key]
    return [*keys, *sorted(entry.expression.free_symbols, key=str)]


def _entries(problem: Problem, form: str) -> Iterator[Entry]:
    if form != "dynamics":
        yield entry_of(form, form, getattr(problem, form))
    yield entry_of("duration", "duration", problem.duration)
    control = problem if isinstance(problem, Control) else None
    if control is not None:
        yield from written_costs(control)
    if form == "dynamics":
        yield from value_entries("dynamics", problem.dynamics)
    yield from value_entries("force", problem.force)
    yield from value_entries("start", problem.start)
    if control is None:
        return
    yield from history_entries(control)
    yield from value_entries("end", control.end)
    yield from value_entries("scale", control.scale)
    yield from _bounds(control.bounds)
    for kind in CONDITIONS:
        yield from kind.written(control)


def _guesses(control: Control, entries: Sequence[Entry]) -> Iterator[Entry]:
    """The guess, whose tables and trajectories are functions of the time that the other entries know."""
    present = list(dict.fromkeys(symbol for entry in entries for symbol in _symbols(entry)))
    instant = next((symbol for symbol in present if isinstance(symbol, Time)), None) or time()
    quantities = [symbol for symbol in present if isinstance(symbol, Quantity)]
    yield from value_entries("guess", guess_entries(control.guess, quantities, instant))


def maximises(control: Control) -> bool:
    """Whether a problem asks for the greatest value; ExpressionError when it asks for a least one as well."""
    given = [name for name in ("cost", "terminal_cost") if _is_given(getattr(control, name))]
    wanted = [name for name in ("maximise", "terminal_maximise") if _is_given(getattr(control, name))]
    if given and wanted:
        raise ExpressionError(f"{wanted[0]} beside {given[0]}", f"write all in one of them, with {given[0]} negated")
    return bool(wanted)


def _is_given(value: Any) -> bool:
    return not (isinstance(value, (int, float, sympy.Basic)) and value == 0)


def written_costs(control: Control) -> Iterator[Entry]:
    """What is to be least, in the form in which solvers minimise it."""
    greatest = maximises(control)
    for role in ("cost", "terminal_cost"):
        what = role.replace("cost", "maximise") if greatest else role
        written = entry_of(role, what, getattr(control, what))
        yield replace(written, expression=-written.expression) if greatest else written


def _bounds(mapping: Any) -> Iterator[Entry]:
    for key, pair in checked_mapping("bounds", mapping, "symbol: (lower, upper)").items():
        if not isinstance(pair, (list, tuple)) or len(pair) != 2:
            raise ExpressionError(
                f"bounds of {key} is {pair!r}", f"write {key}: (lower, upper), with None where there is no bound"
            )
        if pair[0] is None and pair[1] is None:
            raise ExpressionError(f"bounds of {key} has neither a lower nor an upper bound", f"leave {key} out")
        yield from _pair(key, *pair)


def _pair(key: Quantity, lower: Any, upper: Any) -> Iterator[Entry]:
    for role, value in (("lower bound", lower), ("upper bound", upper)):
        if value is None or _is_infinite(value, role == "lower bound"):
            continue
        yield entry_of(role, f"{role} of {key}", value, key)


def _is_infinite(bound: Any, is_lower: bool) -> bool:
    """Whether a bound bounds nothing; ExpressionError where it is infinite on the side that leaves nothing."""
    return isinstance(bound, (float, sympy.Basic)) and bound == (-sympy.oo if is_lower else sympy.oo)


def _declared_values(symbol: FreeParameter) -> Iterator[Entry]:
    """The first guess and the bounds with which a free parameter was declared."""
    yield entry_of("first guess", f"guess of {symbol}", symbol.guess, symbol)
    yield from _pair(symbol, symbol.lower, symbol.upper)
