"""Identical bodies that meet on the way, written out as so many different ones.

The numerics loop over identical bodies whose motions only conditions at the end tie together. A path condition between
bodies, such as a least distance, ties them at every time: then each body gets coordinates and controls of its own,
`x_0`, `x_1`, ..., and all move in one chain. The module, and the time to build it, grow with the number of bodies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

import sympy

from codegen.author.bodies import require_body, require_single_bodies, together
from codegen.author.problem import Control, Problem
from codegen.author.symbols import (
    BodyNumber,
    ControlInput,
    Coordinate,
    EndValue,
    Momentum,
    Quantity,
    State,
    Velocity,
    canonical_pair,
    control,
    coordinate,
    states,
)
from codegen.drawing import Item


def has_path_couplings(problem: Any) -> bool:
    """Whether conditions of several identical bodies tie them at other times than the end, or by an inequality."""
    if not isinstance(problem, Control) or type(problem.bodies) is not int or problem.bodies < 2:
        return False
    inequalities = [
        e for e in _items(problem.end_conditions) if isinstance(e, (sympy.Le, sympy.Ge, sympy.Lt, sympy.Gt))
    ]
    return any(map(_of_bodies, (*_items(problem.path), *_items(problem.start_conditions), *inequalities)))


def written_out(problem: Control, declared: Sequence[Quantity]) -> tuple[Control, list[Quantity]]:
    """The problem with every body by itself, and what is left of the declared quantities.

    Raises BoundaryError for a body that there is not, ExpressionError for a condition between bodies that has
    quantities of every body in it.
    """
    used = {symbol for symbol in symbols_of(problem) if isinstance(symbol, Quantity)}
    own = sorted((s for s in used if not isinstance(s, EndValue)), key=lambda symbol: symbol.declared)
    own = [s for s in own if isinstance(s, (Coordinate, State, Velocity, Momentum, ControlInput))]
    copies = [_copies(own, number) for number in range(problem.bodies)]
    values: dict[EndValue, Quantity] = {}
    for value in (symbol for symbol in used if isinstance(symbol, EndValue)):
        require_body(value, problem.bodies)
        values[value] = copies[value.body][value.partner]
    conditions: dict[str, Any] = {}
    parts = {part.name: getattr(problem, part.name) for part in fields(problem)}
    for what in ("path", "start_conditions", "end_conditions"):
        entries = _items(parts[what])
        between = [entry for entry in entries if _of_bodies(entry)]
        for entry in between:
            require_single_bodies(f"{what} {entry}", _of_bodies(entry), entry.free_symbols & set(own))
        conditions[what] = [entry.xreplace(values) for entry in between]
        parts[what] = [e for e in entries if not _of_bodies(e)]
    bodies = []
    for number, names in enumerate(copies):
        substitution = {**names, **{s: sympy.Integer(number) for s in used if isinstance(s, BodyNumber)}}
        bodies.append(Control(**{**_put(parts, substitution), "bodies": 1}))
    replaced = {*own, *values, *(s for s in used if isinstance(s, BodyNumber))}
    partners = {s.partner for s in own if isinstance(s, (Coordinate, Velocity, Momentum))}
    return together(*bodies, **conditions), [s for s in declared if s not in replaced | partners]


def _items(entries: Any) -> Sequence[Any]:
    """The entries of a list; anything else is refused later, where all problems are checked."""
    return entries if isinstance(entries, (list, tuple)) else ()


def _of_bodies(entry: Any) -> set[EndValue]:
    """The quantities of single bodies in an expression."""
    return {symbol for symbol in getattr(entry, "free_symbols", ()) if isinstance(symbol, EndValue)}


def _copies(own: Sequence[Quantity], number: int) -> dict[Quantity, Quantity]:
    """For every quantity that each body has that of one body."""
    found: dict[Quantity, Quantity] = {}
    for symbol in own:
        name = f"{symbol.name}_{number}"
        if isinstance(symbol, ControlInput):
            found[symbol] = control(name)
        elif isinstance(symbol, State):
            (found[symbol],) = states(name)
        elif isinstance(symbol, (Coordinate, Velocity, Momentum)) and symbol not in found:
            q = symbol if isinstance(symbol, Coordinate) else symbol.partner
            pair = coordinate if isinstance(q.partner, Velocity) else canonical_pair
            found[q], found[q.partner] = pair(f"{q.name}_{number}", f"{q.partner.name}_{number}")
    for symbol, copy in found.items():
        if hasattr(symbol, "unit"):
            copy.unit = symbol.unit
    return found


def _put(value: Any, substitution: Mapping[Any, Any]) -> Any:
    """An argument of a problem with quantities replaced; what is no expression stays as it is."""
    if isinstance(value, sympy.Basic):
        return value.xreplace(dict(substitution))
    if isinstance(value, Mapping):
        return {_put(key, substitution): _put(entry, substitution) for key, entry in value.items()}
    if isinstance(value, Item):
        return value.mapped(lambda part: _put(part, substitution))
    return type(value)(_put(entry, substitution) for entry in value) if type(value) in (list, tuple) else value


def symbols_of(value: Any) -> Iterator[Any]:
    """All symbols in the arguments of a problem."""
    if isinstance(value, Problem):
        for part in fields(value):
            yield from symbols_of(getattr(value, part.name))
    elif isinstance(value, sympy.Basic):
        yield from value.free_symbols
    elif isinstance(value, Mapping):
        yield from symbols_of([*value, *value.values()])
    elif isinstance(value, Item):
        yield from symbols_of([part for _, part in value.expressions()])
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from symbols_of(entry)
