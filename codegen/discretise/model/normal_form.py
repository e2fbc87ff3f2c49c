"""The canonical form of a problem of one phase: collect expressions, check symbols, build the model, check numbers.

The expressions of a problem become entries: each is checked, and has a role and a name for messages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import sympy

from codegen import identifiers
from codegen.discretise import contact, degenerate
from codegen.discretise.conditions import CONDITIONS, SIMULATED
from codegen.discretise.conditions.measurements import measurements_of
from codegen.discretise.model import delays, events, scope, values
from codegen.discretise.model.definitions import Boundary, Bounds, Condition, EndValue, FreeParameter, Model
from codegen.discretise.model.delays import history_entries, in_segments
from codegen.discretise.model.relations import Entry, checked_mapping, checked_sequence, entry_of, text, value_entries
from codegen.discretise.model.scope import Kinds, kinds_of, require_keys, require_scope
from codegen.discretise.model.units import units_of
from codegen.discretise.model.values import with_regular_guesses
from codegen.errors import BoundaryError, ExpressionError, ProblemFileError, SymbolError, TableError, is_count
from codegen.problem import symbols
from codegen.problem.bodies import require_body
from codegen.problem.problem import FORMS, Control, Expression, Problem, Simulate, form_of
from codegen.problem.rotations import names_of, spheres_in
from codegen.problem.symbols import (
    Coordinate,
    Delayed,
    Momentum,
    Quantity,
    Time,
    Velocity,
    time,
)
from codegen.problem.tables import guess_entries
from codegen.symbolic import checks as expressions
from codegen.symbolic.functions import tables_of
from codegen.symbolic.tables import TableData
from codegen.symbolic.terms import value_counts


def written_entries(problem: Problem, form: str, jump: Sequence[Entry] = ()) -> list[Entry]:
    """Return the entries of a problem, of the jump before the phase, and of the free parameters."""
    entries = [*_entries(problem, form), *jump]
    if isinstance(problem, Control):
        # Tables and trajectories in the guess become functions of the same time symbol as in the other entries.
        present = list(dict.fromkeys(symbol for entry in entries for symbol in _symbols(entry)))
        instant = next((symbol for symbol in present if isinstance(symbol, Time)), None) or time()
        quantities = [symbol for symbol in present if isinstance(symbol, Quantity)]
        entries += value_entries("guess", guess_entries(problem.guess, quantities, instant))
    free = {symbol for entry in entries for symbol in _symbols(entry) if isinstance(symbol, symbols.FreeParameter)}
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
    used |= {symbol.partner for symbol in used if isinstance(symbol, (symbols.EndValue, Delayed))}
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


def normalise(problem: Problem, declared: Sequence[Quantity] = (), name: str = "problem", title: str = "") -> Model:
    """Return the checked canonical form of an author's problem of one phase.

    `declared` are all quantities that the author declared; the model lists the unused quantities. Raises a kind of
    CodegenError that names the symbol or expression and the remedy.
    """
    if not isinstance(problem, (Simulate, Control)):
        raise ProblemFileError(
            f"problem() returned {type(problem).__name__}", "return codegen.Simulate(...) or codegen.Control(...)"
        )
    form = form_of(problem)
    entries = written_entries(problem, form)
    used = used_quantities(entries)
    drawing = scope.checked_drawing(problem)
    scope.require_derived(drawing, used)
    require_unique_names([*used, *declared])
    drawn = scope.drawn_quantities(drawing)
    unused = tuple(symbol.name for symbol in declared if symbol not in used and symbol not in drawn)
    kinds = kinds_of(used, form)
    if isinstance(problem, Control):
        require_cost([problem], kinds)
    plain = plain_symbols(used, problem.task)
    model = checked_model(problem, entries, kinds, plain, name, title)
    values.require_agreement(model)
    events.require_agreement(model)
    model = with_positive_durations(replace(model, unused=unused, units=units_of(used, entries, plain)))
    model = contact.with_relaxation(scope.with_drawing(model, drawing, plain))
    return in_segments(with_regular_guesses(model))


def with_positive_durations(model: Model) -> Model:
    """Return a model in which free parameters that are durations have the lower bound zero, if they had none.

    A periodic motion gets no such bound, because the search could then end in a motion of length zero.
    """
    durations = {phase.duration for phase in model.phases or (model,) if not phase.periodic}
    free = tuple(
        replace(each, lower=sympy.S.Zero) if each.lower is None and each.symbol in durations else each
        for each in model.free_parameters
    )
    phases = tuple(replace(phase, free_parameters=free) for phase in model.phases)
    return replace(model, free_parameters=free, phases=phases)


def checked_model(
    problem: Simulate | Control,
    entries: Sequence[Entry],
    kinds: Kinds,
    plain: Mapping[Quantity, sympy.Symbol],
    name: str = "",
    title: str = "",
    elsewhere: Mapping[sympy.Symbol, float] | None = None,
) -> Model:
    """Return the checked model of one problem; `values.require_agreement` checks boundary values later.

    `elsewhere` has values, from earlier phases, of states that the problem does not prescribe.
    """
    form = form_of(problem)
    _require_fitting(problem, form, entries, kinds)
    require_keys(entries, kinds)
    require_scope(entries, kinds, form, isinstance(problem, Control))
    delays.require_history(entries, kinds.delayed)
    used = [plain[symbol] for symbol in used_quantities(entries)]
    entries = [in_plain_symbols(entry, plain) for entry in entries]
    model = _built(problem, form, entries, kinds, plain, name, title)
    values.require_values(model, _bounds_of(entries, used), values.sample_points(model, elsewhere))
    points = values.sample_points(model)
    if problem.task == "simulate" and form == "lagrangian" and degenerate.is_linear(model.function, model.rates):
        return degenerate.first_order_form(model, points)
    values.require_regular_lagrangian(model, points)
    for kind in CONDITIONS:
        kind.require_regular(model, points)
    events.require_regular(model, points)
    return model


def plain_symbols(used: Sequence[Quantity], task: str) -> dict[Quantity, sympy.Symbol]:
    """Return the symbol of the model for each quantity; names that generated code needs get a mark."""
    names = {symbol.name for symbol in used if not isinstance(symbol, symbols.EndValue)}
    plain: dict[Quantity, sympy.Symbol] = {}
    for symbol in used:
        moving = not isinstance(symbol, (symbols.Parameter, symbols.FreeParameter, symbols.EndValue))
        name = identifiers.marked(symbol.name, task, names, moving=moving)
        if isinstance(symbol, (symbols.Time, symbols.BodyNumber)):
            name = "t" if isinstance(symbol, symbols.Time) else "body"
        elif isinstance(symbol, symbols.EndValue) and symbol.name in names:
            name = symbol.name + identifiers.MARK
        elif isinstance(symbol, symbols.Delayed):
            name = delays.past_name(symbol, plain[symbol.partner].name)
        plain[symbol] = sympy.Symbol(name, real=True)
    return plain


def require_cost(problems: Sequence[Control], kinds: Kinds) -> None:
    """Raise ExpressionError for controls if no problem has a cost, or a condition in which controls may occur."""
    limits = [kind.argument for kind in CONDITIONS if symbols.ControlInput in kind.scope[kind.argument]]
    if not kinds.controls or any(getattr(problem, argument) for problem in problems for argument in limits):
        return
    if any(entry.expression != 0 for problem in problems for entry in written_costs(problem)):
        return
    roles = ("cost", "terminal_cost", "maximise", "terminal_maximise")
    if any(isinstance(getattr(problem, role), sympy.Expr) for problem in problems for role in roles):
        raise ExpressionError(
            "the cost is zero, whatever moves",
            "say what is to be least, as in cost=u**2; the rate of a control can be weighed where the control is a"
            " state and its rate a control",
        )
    raise ExpressionError("neither cost nor terminal_cost is given", "say what is to be least, as in cost=u**2")


def require_unique_names(quantities: Sequence[Quantity]) -> None:
    """Raise SymbolError for two quantities with the same name."""
    seen: dict[str, Quantity] = {}
    for symbol in quantities:
        if isinstance(symbol, symbols.EndValue):
            continue  # its name was not chosen by the author
        if seen.setdefault(symbol.name, symbol) != symbol:
            raise SymbolError(f"two symbols are called {names_of([symbol])[0]}", "give one of them another name")


def _require_fitting(problem: Problem, form: str, entries: Sequence[Entry], kinds: Kinds) -> None:
    """Raise an error for arguments that contradict each other, whatever the numbers are."""
    for what, number in [("steps", problem.steps), ("bodies", getattr(problem, "bodies", 1))]:
        if not is_count(number):
            raise ExpressionError(f"{what} is {number!r}", "give a positive integer")
    if isinstance(problem, Simulate):
        # Coordinates determine the velocities in which a Lagrangian is linear.
        lagrangian = next((entry.expression for entry in entries if entry.role == "lagrangian"), None)
        is_linear = lagrangian is not None and degenerate.is_linear(lagrangian, kinds.rates)
        rates = () if is_linear else kinds.rates
        missing = names_of(s for s in (*kinds.coordinates, *rates) if s not in problem.start)
        if missing:
            raise BoundaryError(f"start lacks {', '.join(missing)}", "a simulation needs the complete initial state")
        for simulated in SIMULATED:
            for entry in (entry for entry in entries if entry.role == simulated.argument):
                simulated.require_fitting(entry, problem, form)
        events.require_fitting(problem, form, entries)
    if form == "dynamics":
        missing = names_of(x for x in kinds.coordinates if x not in (problem.dynamics or {}))
        if missing:
            raise ExpressionError(f"dynamics lacks {', '.join(missing)}", "give the derivative of every state")
        if problem.force:
            raise ExpressionError("force beside dynamics", "add what acts on the system to its right-hand sides")
    if not isinstance(problem, Control):
        return
    for kind in CONDITIONS:
        for entry in (entry for entry in entries if entry.role == kind.argument):
            kind.require_fitting(entry, problem, form)
    for entry in entries:
        for count in value_counts(entry.expression) - {problem.bodies}:
            raise ExpressionError(
                f"{entry.what} has values of {count} bodies, and there are {problem.bodies}", "give one for each"
            )
    for value in kinds.end_values:
        coordinate, where = value.partner, f"{value.partner}.of({value.body})"
        require_body(value, problem.bodies)
        if coordinate in problem.end:
            finding = f"{where} is {coordinate} of body {value.body} at the end, and end fixes {coordinate}"
            raise BoundaryError(finding, "leave out one of the two")


def _built(
    problem: Simulate | Control,
    form: str,
    entries: Sequence[Entry],
    kinds: Kinds,
    plain: Mapping[Quantity, sympy.Symbol],
    name: str,
    title: str,
) -> Model:
    """Return the model of a problem whose entries are in plain symbols."""
    coordinates, rates, controls, parameters, free = (
        tuple(plain[symbol] for symbol in symbols)
        for symbols in (kinds.coordinates, kinds.rates, kinds.controls, kinds.parameters, kinds.free)
    )

    def value(role: str) -> sympy.Expr:
        return next((entry.expression for entry in entries if entry.role == role), sympy.S.Zero)

    def per_coordinate(role: str) -> tuple[sympy.Expr, ...]:
        components = dict(_pairs(entries, role))
        return tuple(components.get(x, sympy.S.Zero) for x in coordinates)

    def boundary(end: str) -> tuple[Boundary, tuple[Condition, ...]]:
        """Return the prescribed values at one end, and conditions for values that depend on free parameters."""
        fixed = dict(_pairs(entries, end))
        tied = {symbol: fixed.pop(symbol) for symbol in [s for s in fixed if fixed[s].free_symbols & set(free)]}
        conditions = tuple(Condition(f"{symbol} = {text(value)}", symbol - value) for symbol, value in tied.items())
        return Boundary(tuple(map(fixed.get, coordinates)), tuple(map(fixed.get, rates))), conditions

    start, start_conditions = boundary("start")
    end, end_conditions = boundary("end")
    time = plain[kinds.time] if kinds.time is not None else sympy.Symbol("t", real=True)
    guesses, lower, upper = (dict(_pairs(entries, role)) for role in ("first guess", "lower bound", "upper bound"))
    scales = tuple((symbol, float(size)) for symbol, size in _pairs(entries, "scale"))
    for symbol, size in scales:
        if not 0.0 < size < math.inf:
            raise ExpressionError(f"scale of {symbol} is {size:g}", "give its typical size, a positive number")
    is_control, is_first_order = isinstance(problem, Control), form == "dynamics"
    # In Lagrangian form velocities are no unknowns, so that their bounds become path conditions.
    velocity_bounds = _bounds_of(entries, rates if form == "lagrangian" else ())
    model = Model(
        task=problem.task,
        name=name,
        title=title,
        form=FORMS[form],
        coordinates=coordinates,
        rates=rates,
        controls=controls,
        parameters=parameters,
        defaults=tuple(p.value for p in kinds.parameters),
        time=time,
        function=value(form) if not is_first_order else sympy.S.Zero,
        force=per_coordinate("force") if not is_first_order else (),
        cost=value("cost") if is_control else None,
        duration=value("duration"),
        start=start,
        end=end if is_control else None,
        guess=_pairs(entries, "guess"),
        steps=int(problem.steps),
        delays=delays.delays_of(entries, kinds.delayed, plain, time),
        dynamics=per_coordinate("dynamics") if is_first_order else (),
        bounds=_bounds_of(entries, (*coordinates, *(rates if form == "hamiltonian" else ()), *controls)),
        path=tuple(condition for bound in velocity_bounds for condition in bound.conditions),
        start_conditions=start_conditions,
        end_conditions=end_conditions,
        terminal_cost=value("terminal_cost"),
        maximised=isinstance(problem, Control) and maximises(problem),
        free_parameters=tuple(FreeParameter(s, guesses[s], lower.get(s), upper.get(s)) for s in free),
        bodies=int(getattr(problem, "bodies", 1)),
        body=plain[kinds.body] if kinds.body is not None else None,
        end_values=tuple(
            EndValue(plain[value], kinds.coordinates.index(value.partner), value.body) for value in kinds.end_values
        ),
        scales=scales,
        rotations=tuple(
            tuple(plain[q] for q in sphere.coordinates)
            for sphere in spheres_in(*kinds.coordinates)
            if form == "lagrangian" and sphere.is_attitude
        ),
        attitudes=tuple(sphere.name for sphere in spheres_in(*kinds.coordinates) if sphere.is_attitude),
    )
    for kind in CONDITIONS:
        model = kind.added(model, entries)
    model = events.added(model, problem, entries) if isinstance(problem, Simulate) else model
    measured = measurements_of(problem) if isinstance(problem, Control) else ()
    return replace(model, measurements=tuple(m.data for m in measured), loss=measured[0].loss) if measured else model


def in_plain_symbols(entry: Entry, plain: Mapping[Quantity, sympy.Symbol]) -> Entry:
    """Return an entry in the symbols of a model, with decimal numbers as rationals."""
    expression = expressions.tidied(entry.expression.xreplace(plain))
    return replace(entry, expression=expression, key=plain[entry.key] if entry.key is not None else None)


def _bounds_of(entries: Sequence[Entry], symbols: Sequence[sympy.Symbol]) -> tuple[Bounds, ...]:
    """Return the bounds of the symbols that have a lower or an upper bound."""
    lower, upper = dict(_pairs(entries, "lower bound")), dict(_pairs(entries, "upper bound"))
    return tuple(Bounds(s, lower.get(s), upper.get(s)) for s in symbols if s in lower or s in upper)


def _pairs(entries: Sequence[Entry], role: str) -> tuple[tuple[sympy.Symbol, sympy.Expr], ...]:
    return tuple((entry.key, entry.expression) for entry in entries if entry.role == role and entry.key is not None)
