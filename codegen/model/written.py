"""Every expression of a problem with its role and a name for messages, sympified and checked one by one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sympy

from codegen.author.problem import Control, Problem
from codegen.author.symbols import (
    ControlInput,
    Coordinate,
    EndValue,
    FreeParameter,
    Momentum,
    Quantity,
    State,
    Time,
    Velocity,
)
from codegen.errors import ExpressionError, SymbolError
from codegen.expressions import checks as expressions
from codegen.model.relations import integral_sides, relation, short

_MOVES = (Coordinate, Velocity, Momentum, State, ControlInput, Time)


@dataclass(frozen=True)
class Entry:
    """An expression: its `role` in the problem, `what` messages call it, the symbol that it is the value of, if any.

    Relations have a `name` and are either equalities (the expression vanishes) or not (it is not positive).
    """

    role: str
    what: str
    expression: sympy.Expr
    key: Quantity | None = None
    name: str = ""
    equality: bool = True


def written_entries(problem: Problem, form: str, jump: Sequence[Entry] = ()) -> list[Entry]:
    """All expressions of the problem, and of the jump before it, with those that declare its free parameters."""
    entries = [*_entries(problem, form), *jump]
    free = {symbol for entry in entries for symbol in _symbols(entry) if isinstance(symbol, FreeParameter)}
    for symbol in sorted(free, key=lambda symbol: symbol.declared):
        entries += _declared_values(symbol)
        for role in ("lower bound", "upper bound"):
            if sum(entry.role == role and entry.key == symbol for entry in entries) > 1:
                raise ExpressionError(f"{symbol} has two {role}s", "give it in free_parameter(...) or in bounds")
    return entries


def jump_entries(jumps: Any, switches: int) -> list[list[Entry]]:
    """The expressions of the jumps between phases, one list for each switch; none where there are no jumps at all."""
    given = _sequence("jumps", jumps, "{state: value after the switch}")
    if given and len(given) != switches:
        raise ExpressionError(
            f"jumps has {len(given)} entries for {switches} switches", "give one mapping for each switch, {} for none"
        )
    named = [(f"jumps[{place}]", mapping) for place, mapping in enumerate(given)]
    return [
        [
            _entry("jump", f"{what} of {key}", value, key)
            for key, value in _mapping(what, mapping, "state: value after the switch").items()
        ]
        for what, mapping in named
    ]


def used_quantities(entries: Iterable[Entry]) -> list[Quantity]:
    """All declared quantities of the expressions, partners included, in the order of declaration.

    Raises SymbolError for a symbol that was never declared.
    """
    found: set[Quantity] = set()
    for entry in entries:
        for symbol in _symbols(entry):
            if not isinstance(symbol, Quantity):
                raise SymbolError(
                    f"{symbol} in {entry.what} was never declared",
                    f'declare it, for example {symbol} = parameter("{symbol}", 1.0)',
                )
            found.add(symbol)
    found |= {symbol.partner for symbol in found if isinstance(symbol, EndValue)}
    found |= {symbol.partner for symbol in found if isinstance(symbol, (Coordinate, Velocity, Momentum))}
    return sorted(found, key=lambda symbol: symbol.declared)


def _symbols(entry: Entry) -> list[sympy.Symbol]:
    keys = [] if entry.key is None else [entry.key]
    return [*keys, *sorted(entry.expression.free_symbols, key=str)]


def _entries(problem: Problem, form: str) -> Iterator[Entry]:
    if form != "dynamics":
        yield _entry(form, form, getattr(problem, form))
    yield _entry("duration", "duration", problem.duration)
    control = problem if isinstance(problem, Control) else None
    if control is not None:
        yield from written_costs(control)
    if form == "dynamics":
        yield from _values("dynamics", problem.dynamics)
    yield from _values("force", problem.force)
    yield from _values("start", problem.start)
    if control is None:
        return
    yield from _values("end", control.end)
    yield from _values("guess", control.guess)
    yield from _values("scale", control.scale)
    yield from _bounds(control.bounds)
    yield from _periodic(control)
    yield from _relations("path", control.path)
    yield from _integrals(control.integral)
    yield from _relations("start_conditions", control.start_conditions)
    yield from _relations("end_conditions", control.end_conditions)
    yield from _relations("constraint", control.constraint)


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
        written = _entry(role, what, getattr(control, what))
        yield replace(written, expression=-written.expression) if greatest else written


def _entry(role: str, what: str, value: Any, key: Quantity | None = None) -> Entry:
    return Entry(role, what, expressions.checked(value, what), key)


def _mapping(what: str, mapping: Any, entry: str) -> Mapping[Quantity, Any]:
    if not isinstance(mapping, Mapping):
        raise ExpressionError(f"{what} is a {type(mapping).__name__}", f"write {what} as {{{entry}, ...}}")
    for key in mapping:
        _require_declared(what, "has the key", key)
    return mapping


def _require_declared(what: str, has: str, symbol: Any) -> None:
    if not isinstance(symbol, Quantity):
        raise SymbolError(
            f"{what} {has} {symbol!r}, which was never declared",
            "use the symbols that coordinates(...) or control(...) returned",
        )


def _sequence(what: str, values: Any, entry: str) -> Sequence[Any]:
    if not isinstance(values, (list, tuple)):
        raise ExpressionError(f"{what} is a {type(values).__name__}", f"write {what} as [{entry}, ...]")
    return values


def _values(what: str, mapping: Any) -> Iterator[Entry]:
    for key, value in _mapping(what, mapping, "symbol: value").items():
        yield _entry(what, f"{what} of {key}", value, key)


def _bounds(mapping: Any) -> Iterator[Entry]:
    for key, pair in _mapping("bounds", mapping, "symbol: (lower, upper)").items():
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
        yield _entry(role, f"{role} of {key}", value, key)


def _is_infinite(bound: Any, is_lower: bool) -> bool:
    """Whether a bound bounds nothing; ExpressionError where it is infinite on the side that leaves nothing."""
    return isinstance(bound, (float, sympy.Basic)) and bound == (-sympy.oo if is_lower else sympy.oo)


def _declared_values(symbol: FreeParameter) -> Iterator[Entry]:
    """The first guess and the bounds with which a free parameter was declared."""
    yield _entry("first guess", f"guess of {symbol}", symbol.guess, symbol)
    yield from _pair(symbol, symbol.lower, symbol.upper)


def _periodic(control: Control) -> Iterator[Entry]:
    """What is periodic; a value that one end gives is given at the other end as well, and periodic no more."""
    for entry in _shifts(control.periodic):
        symbol, shift = entry.key, entry.expression
        if symbol in control.start and symbol not in control.end:
            yield _entry("end", f"end of {symbol}", control.start[symbol] + shift, symbol)
        elif symbol in control.end and symbol not in control.start:
            yield _entry("start", f"start of {symbol}", control.end[symbol] - shift, symbol)
        else:
            yield entry


def _shifts(periodic: Any) -> Iterator[Entry]:
    if isinstance(periodic, Mapping):
        shifts = list(_mapping("periodic", periodic, "symbol: shift").items())
    else:
        shifts = [(symbol, 0) for symbol in _sequence("periodic", periodic, "symbol")]
    for place, (symbol, shift) in enumerate(shifts):
        _require_declared("periodic", "lists", symbol)
        if symbol in [other for other, _ in shifts[:place]]:
            raise ExpressionError(f"periodic lists {symbol} twice", "list it once")
        yield _entry("periodic", f"shift of {symbol}", shift, symbol)


def _relations(what: str, values: Any) -> Iterator[Entry]:
    seen, named = set[sympy.Expr](), set[str]()
    for place, (given_name, written) in enumerate(_named(what, values)):
        found = relation(written, f"{what}[{given_name or place!r}]")
        name = given_name or found.name
        if given_name in named:
            raise ExpressionError(f"{what} has two relations of the name {given_name!r}", "give each another name")
        named |= {given_name} if given_name else set()
        if found.expression in seen:
            raise ExpressionError(f"{what} lists {short(name)} twice", "list it once")
        seen.add(found.expression)
        yield Entry(what, f"{what} {short(name)}", found.expression, None, name, found.equality)


def _named(what: str, values: Any) -> Iterator[tuple[str, Any]]:
    """Relations, each after the name that its author gave it, or nothing."""
    for value in [*values.items()] if isinstance(values, Mapping) else _sequence(what, values, "relation"):
        # A pair is a relation with its name, as mappings have them.
        name, written = value if isinstance(value, tuple) and len(value) == 2 else ("", value)
        yield _given_name(what, name) if isinstance(value, tuple) else "", written


def _integrals(values: Any) -> Iterator[Entry]:
    """Conditions on integrals, each as an integrand and as the value that its integral has or does not exceed."""
    for entry, (_, written) in zip(_relations("integral", values), _named("integral", values), strict=True):
        integrand, limit = integral_sides(written, entry.what, _MOVES)
        yield replace(entry, expression=integrand)
        yield replace(entry, role="integral value", what=f"value of {entry.what}", expression=limit)


def _given_name(what: str, name: Any) -> str:
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        raise ExpressionError(f"{what} has the name {name!r}", f'write {what} as {{"name": relation, ...}}')
    return name.strip()
