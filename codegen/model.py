"""A problem in canonical form: checked, in plain sympy symbols, as tuples in the order of declaration.

`normalise` is the first stage of the pipeline. Everything after it may rely on: every symbol is a coordinate, a
velocity (or momentum), a control, a parameter or the time; names are unique; every expression is real, finite and
made of functions that can be printed; a Lagrangian is regular; boundary values are finite at the default parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sympy

from codegen import expressions
from codegen.errors import BoundaryError, DegenerateError, ExpressionError, ProblemFileError, SymbolError
from codegen.problem import Control, Problem, Simulate
from codegen.symbols import ControlInput, Coordinate, Momentum, Parameter, Quantity, Time, Velocity


@dataclass(frozen=True)
class Boundary:
    """Values of the coordinates and of their rates at one end of the time interval; None where an end is free."""

    positions: tuple[sympy.Expr | None, ...]
    rates: tuple[sympy.Expr | None, ...]


@dataclass(frozen=True)
class Model:
    """A mechanical problem in canonical form; `rates` are velocities of a Lagrangian, momenta of a Hamiltonian."""

    task: str
    name: str
    title: str
    form: str
    coordinates: tuple[sympy.Symbol, ...]
    rates: tuple[sympy.Symbol, ...]
    controls: tuple[sympy.Symbol, ...]
    parameters: tuple[sympy.Symbol, ...]
    defaults: tuple[float, ...]
    time: sympy.Symbol
    function: sympy.Expr
    force: tuple[sympy.Expr, ...]
    cost: sympy.Expr | None
    duration: sympy.Expr
    start: Boundary
    end: Boundary | None
    guess: tuple[tuple[sympy.Symbol, sympy.Expr], ...]
    steps: int

    @property
    def default_values(self) -> dict[sympy.Symbol, float]:
        """The parameters with their default values."""
        return dict(zip(self.parameters, self.defaults, strict=True))


def normalise(problem: Any, declared: Sequence[Quantity] = (), name: str = "problem", title: str = "") -> Model:
    """Check an author's problem and bring it into canonical form.

    `declared` are the quantities that were declared while the problem was made; each must be used. Raises a kind of
    CodegenError that names the symbol or expression and the remedy.
    """
    if not isinstance(problem, (Simulate, Control)):
        raise ProblemFileError(
            f"problem() returned {type(problem).__name__}", "return codegen.Simulate(...) or codegen.Control(...)"
        )
    if (problem.lagrangian is None) == (problem.hamiltonian is None):
        raise ExpressionError("a problem needs exactly one of lagrangian and hamiltonian", "give one of them")
    form = "lagrangian" if problem.hamiltonian is None else "hamiltonian"
    written = _written_expressions(problem, form)
    used = _used_quantities(written, _boundary_keys(problem))
    _require_unique_names([*used, *declared])
    _require_all_used(used, declared)
    return _canonical(problem, form, dict(written), used, name, title)


def _written_expressions(problem: Problem, form: str) -> list[tuple[str, sympy.Expr]]:
    """Every scalar expression of the problem with a name for messages, sympified and checked one by one."""
    mappings: list[tuple[str, Any]] = [("force", problem.force), ("start", problem.start)]
    pairs: list[tuple[str, Any]] = [(form, getattr(problem, form)), ("duration", problem.duration)]
    if isinstance(problem, Control):
        mappings += [("end", problem.end), ("guess", problem.guess)]
        pairs += [("cost", problem.cost)]
    for what, mapping in mappings:
        if not isinstance(mapping, Mapping):
            raise ExpressionError(f"{what} is a {type(mapping).__name__}", f"write {what} as {{symbol: value, ...}}")
        for key, value in mapping.items():
            if not isinstance(key, Quantity):
                raise SymbolError(
                    f"{what} has the key {key!r}, which was never declared",
                    "use the symbols that coordinates(...) or control(...) returned",
                )
            pairs.append((f"{what} of {key}", value))
    return [(what, expressions.checked(value, what)) for what, value in pairs]


def _boundary_keys(problem: Problem) -> list[Quantity]:
    keys = [*problem.force, *problem.start]
    if isinstance(problem, Control):
        keys += [*problem.end, *problem.guess]
    return keys


def _used_quantities(written: Iterable[tuple[str, sympy.Expr]], keys: Iterable[Quantity]) -> list[Quantity]:
    """All declared quantities of the expressions, partners included, in the order of declaration."""
    found: set[Quantity] = set(keys)
    for what, expression in written:
        for symbol in sorted(expression.free_symbols, key=str):
            if not isinstance(symbol, Quantity):
                raise SymbolError(
                    f"{symbol} in {what} was never declared",
                    f'declare it, for example {symbol} = parameter("{symbol}", 1.0)',
                )
            found.add(symbol)
    found |= {symbol.partner for symbol in found if isinstance(symbol, (Coordinate, Velocity, Momentum))}
    return sorted(found, key=lambda symbol: symbol.declared)


def _require_unique_names(quantities: Iterable[Quantity]) -> None:
    seen: dict[str, Quantity] = {}
    for symbol in quantities:
        if seen.setdefault(symbol.name, symbol) != symbol:
            raise SymbolError(f"two symbols are called {symbol.name}", "give one of them another name")


def _require_all_used(used: Sequence[Quantity], declared: Sequence[Quantity]) -> None:
    for symbol in declared:
        if symbol not in used:
            raise SymbolError(f"{symbol} is declared but never used", "remove it, or use it")


def _canonical(
    problem: Problem, form: str, written: dict[str, sympy.Expr], used: list[Quantity], name: str, title: str
) -> Model:
    rate_kind = Velocity if form == "lagrangian" else Momentum
    coordinates = _coordinates(used, rate_kind, form)
    rates = [q.partner for q in coordinates]
    controls = [symbol for symbol in used if isinstance(symbol, ControlInput)]
    parameters = [symbol for symbol in used if isinstance(symbol, Parameter)]
    times = [symbol for symbol in used if isinstance(symbol, Time)]
    if len(times) > 1:
        raise SymbolError(f"two times are declared ({times[0]}, {times[1]})", "use one")
    _require_scope(written, form, controls, isinstance(problem, Control))

    plain = {symbol: sympy.Symbol(symbol.name, real=True) for symbol in used}
    time = plain[times[0]] if times else sympy.Symbol("t", real=True)
    tidy = {what: expressions.tidied(expression.xreplace(plain)) for what, expression in written.items()}
    steps = problem.steps
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise ExpressionError(f"steps is {steps!r}", "give a positive integer")
    _require_keys(problem, coordinates, controls)

    def boundary(where: str, values: Mapping[Any, Any]) -> Boundary:
        _require_boundary_keys(where, values, coordinates, rates)
        return Boundary(
            tuple(tidy.get(f"{where} of {q}") for q in coordinates), tuple(tidy.get(f"{where} of {v}") for v in rates)
        )

    control = problem if isinstance(problem, Control) else None
    model = Model(
        task=problem.task,
        name=name,
        title=title,
        form=form,
        coordinates=tuple(plain[q] for q in coordinates),
        rates=tuple(plain[v] for v in rates),
        controls=tuple(plain[u] for u in controls),
        parameters=tuple(plain[p] for p in parameters),
        defaults=tuple(p.value for p in parameters),
        time=time,
        function=tidy[form],
        force=tuple(tidy.get(f"force of {q}", sympy.S.Zero) for q in coordinates),
        cost=tidy["cost"] if control else None,
        duration=tidy["duration"],
        start=boundary("start", problem.start),
        end=boundary("end", control.end) if control else None,
        guess=tuple((plain[s], tidy[f"guess of {s}"]) for s in control.guess) if control else (),
        steps=steps,
    )
    _require_complete_start(model)
    _require_finite_at_defaults(model)
    _require_values(model)
    _require_regular(model)
    return model


def _coordinates(used: list[Quantity], rate_kind: type[Quantity], form: str) -> list[Coordinate]:
    rates = {symbol for symbol in used if isinstance(symbol, (Velocity, Momentum))}
    for rate in sorted(rates, key=str):
        if not isinstance(rate, rate_kind):
            raise SymbolError(
                f"{rate} is a {type(rate).__name__.lower()}, but the problem is given by a {form}",
                "declare coordinates(...) for a Lagrangian, canonical_pairs(...) for a Hamiltonian",
            )
    coordinates = [symbol for symbol in used if isinstance(symbol, Coordinate)]
    if not coordinates:
        raise ExpressionError(f"the {form} has no coordinate", "declare coordinates(...) and use them")
    return coordinates


def _require_scope(
    written: Mapping[str, sympy.Expr], form: str, controls: Sequence[ControlInput], is_control: bool
) -> None:
    """Each expression may hold only the kinds of symbols that make sense in it."""
    forced = {u for what, e in written.items() if what.startswith("force of") for u in e.free_symbols}
    for what, expression in written.items():
        dynamic = what == form or what == "cost" or what.startswith("force of")
        for symbol in sorted(expression.free_symbols, key=str):
            if isinstance(symbol, ControlInput) and not is_control:
                raise SymbolError(f"control {symbol} in a simulation", "return codegen.Control, or make it a parameter")
            if isinstance(symbol, ControlInput) and what == form:
                raise SymbolError(f"control {symbol} in the {form}", "let controls act through force={...}")
            allowed = dynamic or isinstance(symbol, Parameter)
            if what.startswith("guess of") and isinstance(symbol, Time):
                allowed = True
            if not allowed:
                raise ExpressionError(f"{what} depends on {symbol}", "use parameters and numbers only")
    for u in controls:
        if u not in forced:
            raise SymbolError(f"control {u} is in no force, so it moves nothing", "add it to force={...}, or remove it")


def _require_keys(problem: Problem, coordinates: Sequence[Coordinate], controls: Sequence[ControlInput]) -> None:
    for key in problem.force:
        if key not in coordinates:
            raise SymbolError(f"force acts on {key}, which is no coordinate", "use a coordinate as key")
    for key in problem.guess if isinstance(problem, Control) else ():
        if key not in coordinates and key not in controls:
            raise SymbolError(f"guess gives {key}, which is no coordinate or control", "guess coordinates and controls")


def _require_boundary_keys(
    where: str, values: Mapping[Any, Any], coordinates: Sequence[Coordinate], rates: Sequence[Any]
) -> None:
    for key in values:
        if key not in coordinates and key not in rates:
            kind = "velocities" if isinstance(rates[0], Velocity) else "momenta"
            raise BoundaryError(f"{where} fixes {key}", f"fix coordinates and {kind} only")


def _require_complete_start(model: Model) -> None:
    if model.task != "simulate":
        return
    symbols = [*model.coordinates, *model.rates]
    missing = [
        str(s) for s, value in zip(symbols, [*model.start.positions, *model.start.rates], strict=True) if value is None
    ]
    if missing:
        raise BoundaryError(f"start lacks {', '.join(missing)}", "a simulation needs the complete initial state")


def _require_regular(model: Model) -> None:
    """Refuse a Lagrangian whose velocities cannot be recovered from the momenta (its Hessian in v is singular)."""
    if model.form != "lagrangian":
        return
    null = expressions.null_direction(sympy.hessian(model.function, model.rates), _trial_points(model))
    if null is not None:
        names = " ".join(str(v) for v, weight in zip(model.rates, null, strict=True) if abs(weight) > 1e-6)
        raise DegenerateError(
            f"the Lagrangian is degenerate in {names}", "give every coordinate a kinetic energy, or leave it out"
        )


def _require_values(model: Model) -> None:
    """Refuse dynamics, costs and guesses that have no real value at the default parameters, whatever the state."""
    named = [(f"the {model.form}", model.function), *((f"guess of {s}", value) for s, value in model.guess)]
    named += [(f"force of {q}", value) for q, value in zip(model.coordinates, model.force, strict=True)]
    named += [("cost", model.cost)] if model.cost is not None else []
    for what, expression in named:
        if all(expressions.number_at(expression, point) is None for point in _trial_points(model)):
            raise ExpressionError(
                f"{what} has no finite real value at the default parameters", "correct it, or the parameters"
            )


def _trial_points(model: Model) -> Iterator[dict[sympy.Symbol, float]]:
    """States, controls and times at which the expressions of a problem may be expected to have a value."""
    starts = zip([*model.coordinates, *model.rates], [*model.start.positions, *model.start.rates], strict=True)
    numbers = ((s, expressions.number_at(e, model.default_values)) for s, e in starts if e is not None)
    likely = {symbol: number for symbol, number in numbers if number is not None}
    symbols = [*model.coordinates, *model.rates, *model.controls, model.time]
    return expressions.trial_points(symbols, model.default_values, likely)


def _require_finite_at_defaults(model: Model) -> None:
    values = model.default_values
    ends = [("start", model.start)] + ([("end", model.end)] if model.end else [])
    named = [("duration", model.duration)]
    for where, boundary in ends:
        symbols = [*model.coordinates, *model.rates]
        for symbol, value in zip(symbols, [*boundary.positions, *boundary.rates], strict=True):
            if value is not None:
                named.append((f"{where} of {symbol}", value))
    for what, expression in named:
        number = expressions.number_at(expression, values)
        if number is None:
            raise ExpressionError(
                f"{what} is {expression}, which is no finite number at the default parameters", "correct the values"
            )
        if what == "duration" and number <= 0.0:
            raise ExpressionError(f"duration is {number:g}", "give a positive duration")
