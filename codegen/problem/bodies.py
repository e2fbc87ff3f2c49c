"""Several different bodies in one problem: the problems of each, and what ties them together.

Identical bodies that meet on the way, written out as so many different ones. The numerics loop over identical bodies
whose motions only conditions at the end tie together. A path condition between bodies, such as a least distance, ties
them at every time: then each body gets coordinates and controls of its own, `x_0`, `x_1`, ..., and all move in one
chain. The module, and the time to build it, grow with the number of bodies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from itertools import chain
from typing import Any

import sympy

from codegen.drawing import Item
from codegen.errors import BoundaryError, ExpressionError, ProblemFileError, SymbolError
from codegen.problem.problem import Control, Expression, Problem, Relations, Waypoint, form_of
from codegen.problem.symbols import (
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
from codegen.symbolic import checks as expressions


def together(
    *bodies: Control,
    interaction: Expression = 0,
    cost: Expression = 0,
    terminal_cost: Expression = 0,
    maximise: Expression = 0,
    terminal_maximise: Expression = 0,
    path: Relations = (),
    integral: Relations = (),
    at: Mapping[Expression, Relations] | None = None,
    waypoints: Sequence[Relations | Waypoint] = (),
    start_conditions: Relations = (),
    end_conditions: Relations = (),
    constraint: Sequence[Expression] = (),
    drawing: Sequence[Item] = (),
) -> Control:
    """One control problem of several bodies, each given by a problem of its own with coordinates of its own.

    The bodies move at the same time, each by its own equations: Lagrangians or Hamiltonians, costs and terminal costs
    add up, and every condition of every body holds. What ties them together comes beside: `interaction`, which is
    added to the Lagrangian (minus a potential energy) or to the Hamiltonian, further costs, and relations between the
    quantities of several bodies, at every time (`path`, `constraint`), over it (`integral`), at inner times (`at`,
    `waypoints`) or at an end.

    Raises a kind of CodegenError when the bodies are not given in the same way, or differ in duration or steps, when
    two of them have a coordinate in common, or when there is only one. Many identical bodies that meet at their ends
    alone are solved faster as one Control with `bodies=H`.
    """
    form = _common_form(bodies)
    _require_fitting(bodies, form)

    def listed(what: str, further: Relations) -> list[Any]:
        given = [*(getattr(body, what) for body in bodies), further]
        return [*chain.from_iterable(each.items() if isinstance(each, Mapping) else each for each in given)]

    mappings = ("force", "start", "end", "bounds", "history", "guess", "scale")
    merged: Any = {what: _merged(what, [getattr(body, what) for body in bodies]) for what in mappings}
    return Control(
        **{form: _motion(bodies, form, interaction)},
        cost=_sum("cost", [*(body.cost for body in bodies), cost]),
        terminal_cost=_sum("terminal_cost", [*(body.terminal_cost for body in bodies), terminal_cost]),
        maximise=_sum("maximise", [*(body.maximise for body in bodies), maximise]),
        terminal_maximise=_sum("terminal_maximise", [*(b.terminal_maximise for b in bodies), terminal_maximise]),
        duration=bodies[0].duration,
        steps=bodies[0].steps,
        **merged,
        periodic=_merged("periodic", [_shifts(body.periodic) for body in bodies]),
        path=listed("path", path),
        integral=listed("integral", integral),
        at=_by_time([*(body.at for body in bodies), at or {}]),
        waypoints=waypoints,
        start_conditions=listed("start_conditions", start_conditions),
        end_conditions=listed("end_conditions", end_conditions),
        constraint=listed("constraint", constraint),
        drawing=[*chain.from_iterable(body.drawing for body in bodies), *drawing],
    )


def _common_form(bodies: Sequence[Any]) -> str:
    """Which argument says how every body moves."""
    for index, body in enumerate(bodies):
        if not isinstance(body, Control):
            raise ProblemFileError(f"body {index} is a {type(body).__name__}", "let every body be a Control")
    if len(bodies) < 2:
        raise ProblemFileError(f"together(...) has {len(bodies)} bodies", "give two or more, or return one as it is")
    forms = [form_of(body) for body in bodies]
    for index, form in enumerate(forms):
        if form != forms[0]:
            raise ExpressionError(
                f"body 0 is given by {forms[0]}, body {index} by {form}", "give all bodies in the same way"
            )
    return forms[0]


def _require_fitting(bodies: Sequence[Control], form: str) -> None:
    """Refuse bodies that cannot be put together."""
    _require_same("duration", [body.duration for body in bodies])
    _require_same("steps", [body.steps for body in bodies])
    _require_single(bodies)
    for index, body in enumerate(bodies):
        if body.waypoints:
            raise ExpressionError(f"body {index} has waypoints", "give those of all bodies, in order, to together(...)")
    _require_own_coordinates(bodies, form)


def _motion(bodies: Sequence[Control], form: str, interaction: Expression) -> Any:
    """What says how all bodies move, and act on each other."""
    if form != "dynamics":
        return _sum(form, [*(getattr(body, form) for body in bodies), interaction])
    if interaction != 0:
        raise ExpressionError("interaction beside dynamics", "add what acts between bodies to their dynamics")
    return _merged("dynamics", [body.dynamics for body in bodies])


def _require_same(what: str, values: Sequence[Any]) -> None:
    for index, value in enumerate(values):
        if expressions.checked(value, what) != expressions.checked(values[0], what):
            raise ExpressionError(
                f"{what} is {values[0]} for body 0 and {value} for body {index}", "let all bodies move at the same time"
            )


def _require_single(bodies: Sequence[Control]) -> None:
    """Refuse a body that stands for several, or that was measured."""
    for index, body in enumerate(bodies):
        if body.bodies != 1:
            raise ExpressionError(
                f"body {index} stands for {body.bodies!r} bodies",
                "give each of them a Control of its own, or use bodies alone",
            )
        if body.observations:
            raise ExpressionError(
                f"body {index} has observations beside other bodies",
                "write the states of all bodies into one Control, or use bodies alone, with conditions at the end",
            )


def _require_own_coordinates(bodies: Sequence[Control], form: str) -> None:
    """Refuse a coordinate or state that two bodies have: which of both moves it?"""
    owners: dict[Quantity, int] = {}
    for index, body in enumerate(bodies):
        for symbol in sorted(_moving(body, form), key=lambda symbol: symbol.declared):
            if owners.setdefault(symbol, index) != index:
                raise SymbolError(
                    f"bodies {owners[symbol]} and {index} both have {symbol}",
                    "declare coordinates of its own for each body, or write what both share as interaction",
                )


def _moving(body: Control, form: str) -> set[Quantity]:
    """The coordinates or states of a body."""
    if form == "dynamics":
        return set(body.dynamics or {})
    symbols = expressions.checked(getattr(body, form), form).free_symbols
    rates = {symbol.partner for symbol in symbols if isinstance(symbol, (Velocity, Momentum))}
    return rates | {symbol for symbol in symbols if isinstance(symbol, Coordinate)}


def _merged(what: str, mappings: Sequence[Any]) -> dict[Any, Any]:
    """All entries; a shared control or parameter may be said twice, if both times the same."""
    found: dict[Any, Any] = {}
    for index, mapping in enumerate(mappings):
        if not isinstance(mapping, Mapping):
            raise ExpressionError(
                f"{what} of body {index} is a {type(mapping).__name__}", f"write {what} as {{symbol: value, ...}}"
            )
        for key, value in mapping.items():
            if key in found and found[key] != value:
                raise ExpressionError(f"{what} of {key} is given twice: {found[key]} and {value}", "give it once")
            found[key] = value
    return found


def _by_time(mappings: Sequence[Any]) -> dict[Any, list[Any]]:
    """The conditions of all bodies at inner times, with those of equal times in one list."""
    found: dict[Any, list[Any]] = {}
    for index, mapping in enumerate(mappings):
        if not isinstance(mapping, Mapping):
            raise ExpressionError(
                f"at of body {index} is a {type(mapping).__name__}", "write at as {time: [relation, ...], ...}"
            )
        for time, relations in mapping.items():
            found.setdefault(time, []).extend(relations.items() if isinstance(relations, Mapping) else relations)
    return found


def _shifts(periodic: Any) -> Any:
    return periodic if isinstance(periodic, Mapping) else dict.fromkeys(periodic, 0)


def _sum(what: str, terms: Sequence[Expression]) -> Expression:
    return sympy.Add(*(expressions.checked(term, what) for term in terms))


def require_body(value: EndValue, bodies: int) -> None:
    """Raise BoundaryError unless there is the body that a quantity of a single one belongs to."""
    if value.body >= bodies:
        raise BoundaryError(
            f"{value.partner}.of({value.body}) is no body", f"number them 0 to {bodies - 1}, or raise bodies"
        )


def require_single_bodies(what: str, single: Iterable[sympy.Symbol], every: Iterable[sympy.Symbol]) -> None:
    """Raise ExpressionError when a condition between bodies, `what`, has quantities in it that every body has."""
    if mixed := sorted(map(str, every)):
        raise ExpressionError(
            f"{what} has {', '.join(mixed)} of every body beside {min(map(str, single))} of one",
            "write .of(...) for each coordinate; velocities, momenta and controls cannot be tied",
        )


def has_path_couplings(problem: Any) -> bool:
    """Return True if conditions tie identical bodies at other times than the end, or by an inequality."""
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
    return entries if isinstance(entries, (list, tuple)) else ()


def _of_bodies(entry: Any) -> set[EndValue]:
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
