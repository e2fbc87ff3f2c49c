"""Values of the past, `x.delayed(tau)`, and what they were before t = 0: what is read, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import sympy

from codegen.discretise.model.definitions import Delay
from codegen.discretise.model.relations import Entry, entry_of, value_entries
from codegen.errors import BoundaryError, ExpressionError, SymbolError
from codegen.problem.bodies import symbols_of
from codegen.problem.problem import Control, Phases
from codegen.problem.symbols import ControlInput, Coordinate, Delayed, Momentum, Quantity, State, Time, Velocity


def delayed_values(problem: Any) -> list[Delayed]:
    """The values of the past that a problem reads, of any phase, in the order of declaration."""
    parts = problem.phases if isinstance(problem, Phases) else (problem,)
    found = {symbol for part in parts for symbol in symbols_of(part) if isinstance(symbol, Delayed)}
    return sorted(found, key=lambda symbol: symbol.declared)


def require_supported(problem: Any) -> None:
    """Refuse values of the past where there are phases, several bodies in one, or a motion that is followed."""
    delayed = delayed_values(problem)
    if isinstance(problem, Phases) and any(getattr(phase, "history", None) for phase in problem.phases):
        raise ExpressionError("history in a problem of phases", "say by start how the first phase begins")
    if not delayed:
        return
    first = delayed[0]
    if isinstance(problem, Phases):
        raise ExpressionError(
            f"{first} in a problem of phases", "write one Control, with what changes as a function of t"
        )
    if not isinstance(problem, Control):
        remedy = "return codegen.Control(...) with the whole start and no cost, which has the same motion"
        raise ExpressionError(f"{first} in a simulation", remedy)
    if problem.bodies != 1:
        raise ExpressionError(
            f"{first} beside bodies={problem.bodies}", "give each body a Control of its own in together(...)"
        )
    if problem.periodic:
        raise BoundaryError(f"{first} in a periodic motion", "give start and end conditions, and a history")


def history_entries(control: Control) -> Iterator[Entry]:
    """What was before t = 0, and from it the values at the start of which nothing else is said."""
    entries = list(value_entries("history", control.history))
    yield from entries
    tied = {symbol for condition in _conditions(control) for symbol in getattr(condition, "free_symbols", ())}
    given = {*control.start, *control.history, *tied}
    for entry in entries:
        x, before = entry.key, entry.expression
        times = [symbol for symbol in before.free_symbols if isinstance(symbol, Time)]
        values = {x: before} if isinstance(x, (Coordinate, State, Momentum, Velocity)) else {}
        if isinstance(x, Coordinate) and isinstance(x.partner, Velocity) and x.partner not in given:
            values[x.partner] = sympy.diff(before, times[0]) if times else sympy.S.Zero
        for symbol, value in values.items():
            if symbol not in control.start and symbol not in tied:
                yield entry_of("start", f"start of {symbol}", value.subs(dict.fromkeys(times, 0)), symbol)


def _conditions(control: Control) -> Sequence[Any]:
    given = control.start_conditions
    return [*given.values()] if isinstance(given, Mapping) else given if isinstance(given, (list, tuple)) else ()


def require_history(entries: Sequence[Entry], delayed: Sequence[Delayed]) -> None:
    """Every value of the past needs a history; that of a control which nothing reads is a mistake."""
    given = [entry.key for entry in entries if entry.role == "history"]
    for value in delayed:
        x = _with_history(value.partner, given)
        if x is None:
            name = value.partner.partner if isinstance(value.partner, Velocity) else value.partner
            raise BoundaryError(
                f"{value} reaches before t = 0, and {name} has no history",
                f"say what it was for t <= 0, as in history={{{name}: 1}}",
            )
    read = {value.partner for value in delayed}
    for x in given:
        if isinstance(x, ControlInput) and x not in read:
            raise SymbolError(f"history gives {x}, which is never delayed", "leave it out, or write .delayed(...)")


def _with_history(x: Quantity, given: Sequence[Any]) -> Quantity | None:
    """The quantity whose history is that of another: its own, or a velocity's that of its coordinate."""
    if x in given:
        return x
    return x.partner if isinstance(x, Velocity) and x.partner in given else None


def delays_of(
    entries: Sequence[Entry], delayed: Sequence[Delayed], plain: Mapping[Quantity, sympy.Symbol], time: sympy.Symbol
) -> tuple[Delay, ...]:
    """The values of the past in the symbols of a model."""
    histories = {entry.key: entry.expression for entry in entries if entry.role == "history"}
    found = []
    for value in delayed:
        x, lag = plain[value.partner], value.lag.xreplace(plain)
        history = histories.get(x)
        if history is None:
            assert isinstance(value.partner, Velocity), "histories are there"
            history = sympy.diff(histories[plain[value.partner.partner]], time)
        found.append(Delay(plain[value], x, lag, history))
    return tuple(found)


def past_name(symbol: Delayed, quantity: str) -> str:
    """How a value of the past is called in a model, as notation reads it."""
    return f"{quantity}@t-{symbol.lag}" if not symbol.lag.is_Add else f"{quantity}@t-({symbol.lag})"
