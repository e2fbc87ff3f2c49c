"""The expressions of a problem as entries: each is checked, and has a role and a name for messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import sympy

from codegen.discretise.conditions import CONDITIONS, SIMULATED
from codegen.discretise.model import events
from codegen.discretise.model.delays import history_entries
from codegen.discretise.model.relations import Entry, checked_mapping, checked_sequence, entry_of, value_entries
from codegen.errors import ExpressionError, SymbolError, TableError
from codegen.problem.problem import Control, Expression, Problem, Simulate
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
    """Return the entries of a problem, of the jump before the phase, and of the free parameters."""
    entries = [*_entries(problem, form), *jump]
    if isinstance(problem, Control):
        # Tables and trajectories in the guess become functions of the same time symbol as in the other entries.
        present = list(dict.fromkeys(symbol for entry in entries for symbol in _symbols(entry)))
        instant = next((symbol for symbol in present if isinstance(symbol, Time)), None) or time()
        quantities = [symbol for symbol in present if isinstance(symbol, Quantity)]
        entries += value_entries("guess", guess_entries(problem.guess, quantities, instant))
    free = {symbol for entry in entries for symbol in _symbols(entry) if isinstance(symbol, FreeParameter)}
    for symbol in sorted(free, key=lambda symbol: symbol.declared):
        entries.append(entry_of("first guess", f"guess of {symbol}", symbol.guess, symbol))
        entries += _limits(symbol, symbol.lower, symbol.upper)
        for role in ("lower bound", "upper bound"):
            if sum(entry.role == role and entry.key == symbol for entry in entries) > 1:
                raise ExpressionError(f"{symbol} has two {role}s", "give it in free_parameter(...) or in bounds")
    return entries


def jump_entries(jumps: object, switches: int) -> list[list[Entry]]:
    """Return the entries of the jumps between phases, one list for each switch, or [] if there are no jumps."""
    mappings = checked_sequence("jumps", jumps, "{state: value after the switch}")
    if mappings and len(mappings) != switches:
        raise ExpressionError(
            f"jumps has {len(mappings)} entries for {switches} switches",
            "give one mapping for each switch, {} for none",
        )
    named = [(f"jumps[{index}]", mapping) for index, mapping in enumerate(mappings)]
    return [
        [
            entry_of("jump", f"{what} of {key}", value, key)
            for key, value in checked_mapping(what, mapping, "state: value after the switch").items()
        ]
        for what, mapping in named
    ]


def used_quantities(entries: Iterable[Entry]) -> list[Quantity]:
    """Return the declared quantities in the entries and their partners, in the order of declaration.

    The partner of a coordinate is its velocity or momentum. Raises SymbolError for a symbol that was never declared,
    and TableError for two tables with the same name.
    """
    used: set[Quantity] = set()
    entries = list(entries)
    tables: dict[str, TableData] = {}
    for table in tables_of([entry.expression for entry in entries]):
        other = tables.setdefault(table.shape.name, table)
        if other != table:
            raise TableError(
                f"two tables are called {table.shape.name}, from {other.source} and {table.source}",
                'give one of them another name, as in Table(..., name="drag_2")',
            )
    for entry in entries:
        for symbol in _symbols(entry):
            if not isinstance(symbol, Quantity):
                raise _undeclared(symbol, entry, entries)
            used.add(symbol)
    used |= {symbol.partner for symbol in used if isinstance(symbol, (EndValue, Delayed))}
    used |= {symbol for value in used if isinstance(value, Delayed) for symbol in value.lag.free_symbols}
    used |= {symbol.partner for symbol in used if isinstance(symbol, (Coordinate, Velocity, Momentum))}
    return sorted(used, key=lambda symbol: symbol.declared)


def _undeclared(symbol: sympy.Symbol, entry: Entry, entries: Sequence[Entry]) -> SymbolError:
    """Return the error for a plain symbol of sympy, also if a declared quantity has the same name."""
    for quantity in (quantity for other in entries for quantity in _symbols(other)):
        if isinstance(quantity, Quantity) and quantity.name == symbol.name:
            finding = f"{symbol} in {entry.what} is a plain symbol of sympy, and not the declared {symbol}"
            return SymbolError(finding, f"use the symbol that the declaration of {symbol} returned")
    finding = f"{symbol} in {entry.what} was never declared"
    return SymbolError(finding, f'declare it, for example {symbol} = parameter("{symbol}", 1.0)')


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
    if isinstance(problem, Simulate):
        for simulated in SIMULATED:
            yield from simulated.written(problem)
        yield from events.written(problem)
    if control is None:
        return
    yield from history_entries(control)
    yield from value_entries("end", control.end)
    yield from value_entries("scale", control.scale)
    for key, pair in checked_mapping("bounds", control.bounds, "symbol: (lower, upper)").items():
        if not isinstance(pair, (list, tuple)) or len(pair) != 2:
            raise ExpressionError(
                f"bounds of {key} is {pair!r}", f"write {key}: (lower, upper), with None where there is no bound"
            )
        if pair[0] is None and pair[1] is None:
            raise ExpressionError(f"bounds of {key} has neither a lower nor an upper bound", f"leave {key} out")
        yield from _limits(key, *pair)
    for kind in CONDITIONS:
        yield from kind.written(control)


def maximises(control: Control) -> bool:
    """Return True if a problem asks for a maximum; raise ExpressionError if it also asks for a minimum."""

    def nonzero(*names: str) -> list[str]:
        values = [(name, getattr(control, name)) for name in names]
        return [name for name, value in values if not isinstance(value, (int, float, sympy.Basic)) or value != 0]

    minimised, maximised = nonzero("cost", "terminal_cost"), nonzero("maximise", "terminal_maximise")
    if minimised and maximised:
        finding = f"{maximised[0]} and {minimised[0]} in one problem"
        name = maximised[0].replace("terminal_maximise", "terminal_cost").replace("maximise", "cost")
        raise ExpressionError(finding, f"write {name}=-(...) in place of {maximised[0]}=...")
    return bool(maximised)


def written_costs(control: Control) -> Iterator[Entry]:
    """Yield running and terminal cost, which solvers minimise: negated if the author maximises."""
    is_maximised = maximises(control)
    for role in ("cost", "terminal_cost"):
        what = role.replace("cost", "maximise") if is_maximised else role
        written = entry_of(role, what, getattr(control, what))
        yield replace(written, expression=-written.expression) if is_maximised else written


def _limits(key: Quantity, lower: Expression, upper: Expression) -> Iterator[Entry]:
    """Yield the bounds of a quantity, without a lower bound of -oo and an upper bound of oo."""
    for role, value, infinity in (("lower bound", lower, -sympy.oo), ("upper bound", upper, sympy.oo)):
        if value is not None and not (isinstance(value, (float, sympy.Basic)) and value == infinity):
            yield entry_of(role, f"{role} of {key}", value, key)
