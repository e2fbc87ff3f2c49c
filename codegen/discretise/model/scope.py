"""The scope of symbols: where each kind may occur, and which symbols may be fixed, bounded, guessed or forced.

A drawing never changes the derivation: its symbols must occur elsewhere in the problem. Exceptions are the time and the
number of a body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import sympy

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model import events
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.relations import MOVING, STATIC, Entry
from codegen.drawing import Item
from codegen.errors import BoundaryError, ExpressionError, SymbolError
from codegen.problem.problem import Expression, Problem
from codegen.problem.rotations import names_of, spheres_in
from codegen.problem.symbols import (
    BodyNumber,
    ControlInput,
    Coordinate,
    Delayed,
    EndValue,
    FreeParameter,
    Momentum,
    Parameter,
    Quantity,
    State,
    Time,
    Velocity,
)
from codegen.symbolic import checks as expressions
from codegen.symbolic.functions import tables_of

_ALLOWED: dict[str, tuple[type[Quantity], ...]] = {
    "lagrangian": (*MOVING, Time, *STATIC),
    "hamiltonian": (*MOVING, Time, *STATIC),
    "dynamics": (*MOVING, Delayed, ControlInput, Time, *STATIC),
    "force": (*MOVING, Delayed, ControlInput, Time, *STATIC),
    "cost": (*MOVING, Delayed, ControlInput, Time, *STATIC),
    "terminal_cost": (*MOVING, *STATIC),
    "duration": STATIC,
    "start": (*STATIC, BodyNumber),
    "end": (*STATIC, BodyNumber),
    "history": (Time, *STATIC),
    "guess": (Time, *STATIC, BodyNumber),
    "lower bound": (Parameter, BodyNumber),
    "upper bound": (Parameter, BodyNumber),
    "first guess": (Parameter,),
    "scale": (),
    "jump": (*MOVING, *STATIC),
    **events.SCOPE,
    **{role: kinds for kind in CONDITIONS for role, kinds in kind.scope.items()},
}

_WORDS: tuple[tuple[tuple[type[Quantity], ...], str], ...] = (
    ((Coordinate, State), "coordinates"),
    ((Velocity, Momentum), "velocities or momenta"),
    ((ControlInput,), "controls"),
    ((Time,), "time"),
    ((BodyNumber,), "the body's number"),
    ((Parameter,), "parameters"),
)


_CONSTANT = (
    "duration",
    "start",
    "end",
    "lower bound",
    "upper bound",
    "first guess",
    "scale",
    "periodic",
    "restitution",
    "friction",
)
"""Roles whose values are computed before tables are available, so that tables must not occur."""


@dataclass(frozen=True)
class Kinds:
    """The quantities of a problem by kind, in the order of declaration; `rates` are velocities or momenta."""

    coordinates: tuple[Coordinate | State, ...]
    rates: tuple[Velocity | Momentum, ...]
    controls: tuple[ControlInput, ...]
    parameters: tuple[Parameter, ...]
    free: tuple[FreeParameter, ...]
    end_values: tuple[EndValue, ...]
    delayed: tuple[Delayed, ...]
    time: Time | None
    body: BodyNumber | None


def kinds_of(used: Sequence[Quantity], form: str) -> Kinds:
    """Return the `used` quantities by kind; raise SymbolError for quantities that do not belong to the form."""
    moving_kinds: dict[str, tuple[type[Quantity], ...]] = {
        "lagrangian": (Coordinate, Velocity),
        "hamiltonian": (Coordinate, Momentum),
        "dynamics": (State,),
    }
    moving = [symbol for symbol in used if isinstance(symbol, MOVING)]
    # Rates first: the class of a coordinate does not distinguish Lagrangian and Hamiltonian problems.
    for symbol in sorted(moving, key=lambda symbol: (isinstance(symbol, Coordinate), symbol.name)):
        if not isinstance(symbol, moving_kinds[form]):
            article = "" if form == "dynamics" else "a "
            if spheres := spheres_in(symbol):
                what = (
                    "an attitude of first-order dynamics" if isinstance(symbol, State) else "declared for a Lagrangian"
                )
                remedy = "give a Lagrangian"
                if form == "dynamics" and spheres[0].is_attitude:
                    remedy = f'declare the attitude by attitude("{spheres[0].name}"), or give a Lagrangian'
                raise SymbolError(f"{spheres[0].name} is {what}, but the problem is given by {article}{form}", remedy)
            raise SymbolError(
                f"{symbol} is a {type(symbol).__name__.lower()}, but the problem is given by {article}{form}",
                "declare coordinates(...) for a Lagrangian, canonical_pairs(...) for a Hamiltonian, states(...) for "
                "dynamics",
            )
    coordinates = tuple(symbol for symbol in used if isinstance(symbol, (Coordinate, State)))
    if not coordinates:
        if form == "dynamics":
            raise ExpressionError("dynamics gives no state", "declare states(...) and write dynamics={x: ...}")
        raise ExpressionError(f"the {form} has no coordinate", "declare coordinates(...) and use them")
    times = [symbol for symbol in used if isinstance(symbol, Time)]
    if len(times) > 1:
        raise SymbolError(f"two times are declared ({times[0]}, {times[1]})", "use one")
    end_values = [symbol for symbol in used if isinstance(symbol, EndValue)]
    return Kinds(
        coordinates,
        tuple(q.partner for q in coordinates if isinstance(q, Coordinate)),
        tuple(symbol for symbol in used if isinstance(symbol, ControlInput)),
        tuple(symbol for symbol in used if isinstance(symbol, Parameter)),
        tuple(symbol for symbol in used if isinstance(symbol, FreeParameter)),
        tuple(sorted(end_values, key=lambda symbol: (symbol.body, symbol.partner.declared))),
        tuple(symbol for symbol in used if isinstance(symbol, Delayed)),
        times[0] if times else None,
        next((symbol for symbol in used if isinstance(symbol, BodyNumber)), None),
    )


def require_scope(entries: Sequence[Entry], kinds: Kinds, form: str, is_control: bool) -> None:
    """Raise an error for symbols outside their scope, and for controls and free parameters without effect."""
    for symbol in (s for e in entries for s in sorted(e.expression.free_symbols, key=str) if not is_control):
        if isinstance(symbol, ControlInput):
            raise SymbolError(f"control {symbol} in a simulation", "return codegen.Control, or make it a parameter")
        if isinstance(symbol, FreeParameter):
            remedy = "return codegen.Control, or declare a parameter"
            raise SymbolError(f"free parameter {symbol} in a simulation", remedy)
        if isinstance(symbol, (BodyNumber, EndValue)):
            raise SymbolError(f"{symbol} in a simulation, which has one body", "return codegen.Control")
    for entry in entries:
        for symbol in sorted(entry.expression.free_symbols, key=str):
            if not isinstance(symbol, _ALLOWED[entry.role]):
                raise _out_of_scope(symbol, entry, form)
        # Expressions that are common to all bodies must not depend on the number of the body.
        if any(isinstance(symbol, BodyNumber) for symbol in entry.expression.free_symbols):
            if isinstance(entry.key, (Velocity, FreeParameter)) and entry.role.endswith("bound"):
                kind = "velocity" if isinstance(entry.key, Velocity) else "free parameter"
                raise ExpressionError(f"{entry.what} depends on body", f"give a {kind} the same bounds for all bodies")
            unknown = [str(symbol) for symbol in entry.expression.free_symbols if isinstance(symbol, FreeParameter)]
            if unknown and entry.role != "guess":  # there the parameter has its initial guess
                finding = f"{entry.what} depends on body and on the free parameter {min(unknown)}"
                raise ExpressionError(finding, "let it depend on one of them")
        for table in tables_of(entry.expression):
            name = table.shape.name
            if entry.role in _CONSTANT:
                raise ExpressionError(f"{entry.what} reads table {name}", "make it a number or a parameter")
            if table.shape.kind == "steps" and entry.role != "guess":
                remedy = "give the table another kind; steps, which have no slope, are for guesses"
                raise ExpressionError(f"{entry.what} reads table {name} of steps", remedy)
    acting = {s for e in entries if e.role in ("force", "dynamics", "path") for s in e.expression.free_symbols}
    acting |= {symbol.partner for symbol in acting if isinstance(symbol, Delayed)}
    for u in kinds.controls:
        if u not in acting:
            where = "right-hand side of the dynamics" if form == "dynamics" else "force"
            remedy = "add it to dynamics={...}" if form == "dynamics" else "add it to force={...}"
            raise SymbolError(f"control {u} is in no {where}, so it moves nothing", f"{remedy}, or remove it")
    present = {s for e in entries for s in e.expression.free_symbols}
    for free in kinds.free:
        if free not in present:
            raise SymbolError(f"free parameter {free} occurs in no expression", "remove it, or use it")


def _out_of_scope(symbol: sympy.Symbol, entry: Entry, form: str) -> SymbolError | ExpressionError:
    """Return the error, with a remedy, for a symbol that may not occur in an expression."""
    if isinstance(symbol, ControlInput) and entry.role in ("lagrangian", "hamiltonian"):
        return SymbolError(f"control {symbol} in the {form}", "let controls act through force={...}")
    finding = f"{entry.what} depends on {names_of([symbol])[0]}"
    if isinstance(symbol, Delayed):
        where = "force, cost, path or integral" if form != "dynamics" else "dynamics, cost, path or integral"
        return ExpressionError(finding, f"let values of the past act through {where}")
    if isinstance(symbol, EndValue):
        return ExpressionError(finding, f"use {symbol.partner}.of({symbol.body}) in end_conditions and path only")
    if isinstance(symbol, FreeParameter):
        return ExpressionError(finding, "a free parameter has no value there, use parameters and numbers only")
    if isinstance(symbol, Time) and entry.role == "terminal_cost":
        return ExpressionError(finding, "time is the duration there, so write its expression")
    for kind in CONDITIONS:
        if entry.role == kind.argument and type(symbol) in kind.remedies:
            return ExpressionError(finding, kind.remedies[type(symbol)])
    allowed = _ALLOWED[entry.role]
    words = [word for kinds, word in _WORDS if any(kind in allowed for kind in kinds)]
    return ExpressionError(finding, f"use {', '.join(words)} and numbers only")


def require_keys(entries: Sequence[Entry], kinds: Kinds) -> None:
    """Raise an error for a value, bound, guess, force or shift of a quantity that cannot have one."""
    rates = "momenta" if any(isinstance(v, Momentum) for v in kinds.rates) else "velocities"
    moving = f"coordinates and {rates}" if kinds.rates else "states"
    position = "coordinate" if kinds.rates else "state"
    for entry in entries:
        key, role = entry.key, entry.role
        is_position, is_control = key in kinds.coordinates, key in kinds.controls
        is_moving = is_position or key in kinds.rates
        if role == "force" and not is_position:
            raise SymbolError(f"force acts on {key}, which is no {position}", "use a coordinate as key")
        if role == "dynamics" and not is_position:
            raise SymbolError(f"dynamics gives {key}, which is no state", "use states as keys")
        if role == "guess" and not (is_position or is_control):
            remedy = f"guess {position}s and controls"
            if isinstance(key, FreeParameter):
                remedy = f'write its guess into the declaration, as in free_parameter("{key}", 3)'
            raise SymbolError(f"guess gives {key}, which is no {position} or control", remedy)
        if role == "scale" and not (is_position or isinstance(key, (Momentum, ControlInput, FreeParameter))):
            remedy = f"scale {position}s, controls, free parameters"
            raise SymbolError(f"scale gives {key}, which is no unknown", remedy)
        if role in ("start", "end") and not is_moving:
            raise BoundaryError(f"{role} fixes {key}", f"fix {moving} only")
        if role == "history" and not (is_moving or is_control):
            raise SymbolError(f"history gives {key}, which does not move", f"give that of {moving} and controls")
        if role == "periodic" and not is_moving:
            raise BoundaryError(f"periodic lists {key}", f"list {moving} only")
        if role == "jump" and not is_moving:
            raise BoundaryError(f"{entry.what} at a switch", f"let {moving} jump only")
        if role == "event change" and not is_moving:
            raise BoundaryError(f"{entry.what} is no part of the state", f"let {moving} change only")
        if role.endswith("bound") and not (is_moving or isinstance(key, (ControlInput, FreeParameter))):
            remedy = f"bound {moving}, controls, free parameters"
            raise SymbolError(f"bounds gives {key}, which cannot be bounded", remedy)


def checked_drawing(problem: Problem) -> tuple[Item, ...]:
    """Return the items of the author's drawing with every expression converted to sympy.

    Raises ExpressionError for other objects, for points without two coordinates, and for rates and end values: a
    solution does not contain these at every time. Raises SymbolError for symbols that were never declared.
    """
    if not isinstance(problem.drawing, (list, tuple)):
        raise ExpressionError(
            f"drawing is a {type(problem.drawing).__name__}",
            "write drawing=[...] with items of codegen.drawing",
        )
    return tuple(_checked_item(item, f"drawing[{index}]") for index, item in enumerate(problem.drawing))


def drawn_quantities(items: Sequence[Item]) -> set[Quantity]:
    """Return all quantities that occur in a drawing."""
    return {symbol for item in items for _, expression in item.expressions() for symbol in expression.free_symbols}


def require_derived(items: Sequence[Item], used: Sequence[Quantity]) -> None:
    """Raise SymbolError for a quantity of a drawing that does not occur elsewhere in the problem."""
    times = [symbol for symbol in used if isinstance(symbol, Time)]
    for symbol in sorted(drawn_quantities(items) - set(used), key=lambda symbol: symbol.declared):
        if isinstance(symbol, Time) and times:
            raise SymbolError(f"two times are declared ({times[0]}, {symbol})", "use one")
        if not isinstance(symbol, (Time, BodyNumber)):
            remedy = "write a number" if not isinstance(symbol, (Coordinate, State)) else "remove it"
            raise SymbolError(f"{symbol} occurs in the drawing only", f"{remedy}, or let the problem depend on it")


def with_drawing(model: Model, items: Sequence[Item], plain: Mapping[Quantity, sympy.Symbol]) -> Model:
    """Return the model with its drawing in plain symbols; raise ExpressionError for a size that is not positive."""
    symbols: dict[Quantity, sympy.Symbol] = {}
    for symbol in drawn_quantities(items):
        alone = model.time if isinstance(symbol, Time) else sympy.Symbol(symbol.name, real=True)
        symbols[symbol] = plain.get(symbol, alone)
    drawing = tuple(item.mapped(lambda expression: expression.xreplace(symbols)) for item in items)
    for index, item in enumerate(drawing):
        for name in ("radius", "width", "height"):
            size = expressions.rounded_at(getattr(item, name, sympy.S.One), model.default_values)
            if size is not None and size <= 0.0:
                raise ExpressionError(
                    f"{name} of drawing[{index}], a {type(item).__name__}, is {size:g}", "give a positive length"
                )
    return replace(model, drawing=drawing)


def _checked_item(item: object, where: str) -> Item:
    if not isinstance(item, Item) or type(item) is Item:
        raise ExpressionError(f"{where} is a {type(item).__name__}", "use items of codegen.drawing, such as Rod")
    where = f"{where}, a {type(item).__name__},"
    if not isinstance(item.label, str):
        raise ExpressionError(f"{where} has the label {item.label!r}", "give text")
    points = {field.name for field in fields(item) if field.type == "Point"}
    changes = dict[str, Expression]()
    for name, value in item.parts():
        what = f"{where} {name}"
        if name not in points:
            changes[name] = expressions.checked(value, what)
            continue
        if not isinstance(value, (list, tuple)) or len(value) != 2:
            raise ExpressionError(f"{what} is {value!r}", "give two coordinates (x, y), or three in space (x, y, z)")
        changes[name] = tuple(expressions.checked(part, what) for part in value)
    checked = replace(item, **changes)
    for name, expression in checked.expressions():
        for symbol in sorted(expression.free_symbols, key=str):
            if not isinstance(symbol, Quantity):
                raise SymbolError(f"{symbol} in {where} {name} was never declared", "declare it, or write a number")
            if isinstance(symbol, (Velocity, Momentum, EndValue, Delayed)):
                remedy = "draw with coordinates or states, controls, parameters, time and the body's number"
                raise ExpressionError(f"{where} {name} depends on {symbol}", remedy)
    return checked
