"""Several different bodies in one problem, and the conversion of identical bodies to different bodies.

The numerics iterate over identical bodies whose motions are coupled only by conditions at the end. A path condition
between bodies, such as a least distance, couples the bodies at every time. Each body then gets its own coordinates and
controls, `x_0`, `x_1`, ..., and the problem has one large state. The module and its build time grow with the number of
bodies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from itertools import chain
from typing import Any

import sympy

from codegen.drawing import Item
from codegen.errors import BoundaryError, ExpressionError, ProblemFileError, SymbolError
from codegen.problem.problem import Control, Expression, Problem, Relation, Relations, Waypoint, form_of
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
    rolling: Sequence[Expression] = (),
    drawing: Sequence[Item] = (),
) -> Control:
    """Combine the control problems of several bodies, each with its own coordinates, into one problem.

    The bodies move at the same time, each by its own equations. Lagrangians or Hamiltonians, costs and terminal costs
    are added, and all conditions of all bodies hold. The other arguments couple the bodies.

    Parameters
    ----------
    *bodies : Control
        At least two problems, with the same duration and steps, and without common coordinates.
    interaction : expression
        Term that is added to the Lagrangian (minus a potential energy) or to the Hamiltonian.
    cost, terminal_cost, maximise, terminal_maximise : expression
        Costs in addition to the costs of the bodies.
    path, integral, at, waypoints, start_conditions, end_conditions, constraint, rolling
        Relations between quantities of several bodies, as for Control.
    drawing : sequence of Item
        Items of the drawing in addition to the drawings of the bodies.

    Returns
    -------
    Control
        One problem with the coordinates and controls of all bodies.

    Raises
    ------
    CodegenError
        If the bodies have different forms, durations or steps, or a common coordinate, or if there is only one body.

    Notes
    -----
    Many identical bodies that meet only at their ends are solved faster as one Control with `bodies=H`.
    """
    form = _common_form(bodies)

    def listed(name: str, further: Relations) -> list[Relation | tuple[str, Relation]]:
        each = [*(getattr(body, name) for body in bodies), further]
        return [*chain.from_iterable(one.items() if isinstance(one, Mapping) else one for one in each)]

    names = ("force", "start", "end", "bounds", "history", "guess", "scale")
    mappings: Any = {name: _merged(name, [getattr(body, name) for body in bodies]) for name in names}
    motion: Expression
    if form != "dynamics":
        motion = _sum(form, [*(getattr(body, form) for body in bodies), interaction])
    elif interaction != 0:
        raise ExpressionError("interaction beside dynamics", "add what acts between bodies to their dynamics")
    else:
        motion = _merged("dynamics", [body.dynamics for body in bodies])
    inner: dict[Expression, list[Relation | tuple[str, Relation]]] = {}
    for index, mapping in enumerate([*(body.at for body in bodies), at or {}]):
        _require_mapping("at", index, mapping, "{time: [relation, ...], ...}")
        for time, relations in mapping.items():
            inner.setdefault(time, []).extend(relations.items() if isinstance(relations, Mapping) else relations)
    periodic = [p if isinstance(p, Mapping) else dict.fromkeys(p, 0) for p in (body.periodic for body in bodies)]
    return Control(
        **{form: motion},
        cost=_sum("cost", [*(body.cost for body in bodies), cost]),
        terminal_cost=_sum("terminal_cost", [*(body.terminal_cost for body in bodies), terminal_cost]),
        maximise=_sum("maximise", [*(body.maximise for body in bodies), maximise]),
        terminal_maximise=_sum("terminal_maximise", [*(b.terminal_maximise for b in bodies), terminal_maximise]),
        duration=bodies[0].duration,
        steps=bodies[0].steps,
        **mappings,
        periodic=_merged("periodic", periodic),
        path=listed("path", path),
        integral=listed("integral", integral),
        at=inner,
        waypoints=waypoints,
        start_conditions=listed("start_conditions", start_conditions),
        end_conditions=listed("end_conditions", end_conditions),
        constraint=listed("constraint", constraint),
        rolling=listed("rolling", rolling),
        drawing=[*chain.from_iterable(body.drawing for body in bodies), *drawing],
    )


def _common_form(bodies: Sequence[Control]) -> str:
    """Return the name of the argument that defines the motion of every body, such as "lagrangian".

    Raise an error if the bodies do not fit to each other, for example if their durations differ.
    """
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
    for name in ("duration", "steps"):
        first = getattr(bodies[0], name)
        for index, body in enumerate(bodies):
            value = getattr(body, name)
            if expressions.checked(value, name) != expressions.checked(first, name):
                raise ExpressionError(
                    f"{name} is {first} for body 0 and {value} for body {index}", "let all bodies move at the same time"
                )
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
    for index, body in enumerate(bodies):
        if body.waypoints:
            raise ExpressionError(f"body {index} has waypoints", "give those of all bodies, in order, to together(...)")
    owners: dict[Quantity, int] = {}
    for index, body in enumerate(bodies):
        if forms[0] == "dynamics":
            moving = set(body.dynamics or {})
        else:
            symbols = expressions.checked(getattr(body, forms[0]), forms[0]).free_symbols
            moving = {symbol.partner for symbol in symbols if isinstance(symbol, (Velocity, Momentum))}
            moving |= {symbol for symbol in symbols if isinstance(symbol, Coordinate)}
        for symbol in sorted(moving, key=lambda symbol: symbol.declared):
            if owners.setdefault(symbol, index) != index:
                raise SymbolError(
                    f"bodies {owners[symbol]} and {index} both have {symbol}",
                    "declare coordinates of its own for each body, or write what both share as interaction",
                )
    return forms[0]


def _require_mapping(name: str, index: int, mapping: object, example: str) -> None:
    if not isinstance(mapping, Mapping):
        raise ExpressionError(f"{name} of body {index} is a {type(mapping).__name__}", f"write {name} as {example}")


def _merged(name: str, mappings: Sequence[Any]) -> dict[Quantity, Expression]:
    """Return the entries of all `mappings`, the argument `name` of each body, in one mapping.

    A control or parameter that several bodies share may occur repeatedly with the same value. Raise ExpressionError if
    its values differ.
    """
    merged: dict[Quantity, Expression] = {}
    for index, mapping in enumerate(mappings):
        _require_mapping(name, index, mapping, "{symbol: value, ...}")
        for key, value in mapping.items():
            if key in merged and merged[key] != value:
                raise ExpressionError(f"{name} of {key} is given twice: {merged[key]} and {value}", "give it once")
            merged[key] = value
    return merged


def _sum(name: str, terms: Sequence[Expression]) -> Expression:
    return sympy.Add(*(expressions.checked(term, name) for term in terms))


def require_body(value: EndValue, bodies: int) -> None:
    """Raise BoundaryError if a quantity such as `q.of(3)` belongs to a body that does not exist."""
    if value.body >= bodies:
        raise BoundaryError(
            f"{value.partner}.of({value.body}) is no body", f"number them 0 to {bodies - 1}, or raise bodies"
        )


def require_single_bodies(what: str, single: Iterable[sympy.Symbol], every: Iterable[sympy.Symbol]) -> None:
    """Raise ExpressionError if a condition between bodies also contains quantities without a body.

    `what` is the text of the condition. `single` are its quantities of one body, such as `q.of(0)`, and `every` are its
    quantities that exist for every body, such as `q`.
    """
    if mixed := sorted(map(str, every)):
        raise ExpressionError(
            f"{what} has {', '.join(mixed)} of every body beside {min(map(str, single))} of one",
            "write .of(...) for each coordinate; velocities, momenta and controls cannot be tied",
        )


def has_path_couplings(problem: object) -> bool:
    """Return True if conditions couple identical bodies at other times than the end, or by an inequality.

    Such bodies must be converted by `written_out`.
    """
    if not isinstance(problem, Control) or type(problem.bodies) is not int or problem.bodies < 2:
        return False
    inequalities = [
        e for e in _items(problem.end_conditions) if isinstance(e, (sympy.Le, sympy.Ge, sympy.Lt, sympy.Gt))
    ]
    return any(map(_of_bodies, (*_items(problem.path), *_items(problem.start_conditions), *inequalities)))


def written_out(problem: Control, declared: Sequence[Quantity]) -> tuple[Control, list[Quantity]]:
    """Return a problem in which identical bodies are replaced by separate bodies, and its declared quantities.

    The quantities are those in `declared` that were not replaced by copies for each body. Raise BoundaryError for a
    body that does not exist. Raise ExpressionError for a condition between bodies that also contains quantities without
    a body.
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


def _items(entries: object) -> Sequence[Relation]:
    return entries if isinstance(entries, (list, tuple)) else ()


def _of_bodies(entry: object) -> set[EndValue]:
    return {symbol for symbol in getattr(entry, "free_symbols", ()) if isinstance(symbol, EndValue)}


def _copies(own: Sequence[Quantity], number: int) -> dict[Quantity, Quantity]:
    """Return new symbols for one body, by the symbols that they replace; `number` is the number of the body."""
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


def _put(value: Any, substitution: Mapping[sympy.Symbol, sympy.Expr]) -> Any:
    """Return the argument `value` of a problem with all symbols in `substitution` replaced."""
    if isinstance(value, sympy.Basic):
        return value.xreplace(dict(substitution))
    if isinstance(value, Mapping):
        return {_put(key, substitution): _put(entry, substitution) for key, entry in value.items()}
    if isinstance(value, Item):
        return value.mapped(lambda part: _put(part, substitution))
    return type(value)(_put(entry, substitution) for entry in value) if type(value) in (list, tuple) else value


def symbols_of(value: object) -> Iterator[sympy.Symbol]:
    """Yield all symbols in a problem, in its arguments, or in a part of them; a symbol may occur repeatedly."""
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
