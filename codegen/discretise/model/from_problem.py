"""Problems of one phase or of several: the phases' models, what is common to them, and the jumps between them.

From a problem file, or an object, to a checked model, or to one line that says what is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import sympy

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model import delays, normal_form, scope, smoothness, values
from codegen.discretise.model.definitions import FreeParameter, Model, prescribed
from codegen.discretise.model.pairwise import PairwiseModel, is_pairwise, normalise_pairwise
from codegen.discretise.model.relations import Entry
from codegen.discretise.model.scope import Kinds, kinds_of
from codegen.discretise.model.units import units_of
from codegen.discretise.model.written import jump_entries, maximises, used_quantities, written_costs, written_entries
from codegen.errors import BoundaryError, CodegenError, ExpressionError, ProblemFileError, SymbolError
from codegen.problem.bodies import has_path_couplings, written_out
from codegen.problem.problem import Control, Phases, form_of
from codegen.problem.problem_file import with_location
from codegen.problem.sources import Source, source_of
from codegen.problem.symbols import Quantity
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounding_of

Jump = tuple[tuple[sympy.Symbol, sympy.Expr], ...]


def normalise(problem: Any, declared: Sequence[Quantity] = (), name: str = "problem", title: str = "") -> Model:
    """Check an author's problem, of one phase or several, and bring it into canonical form.

    `declared` are the quantities that were declared while the problem was made; each must be used. Raises a kind of
    CodegenError that names the symbol or expression and the remedy.
    """
    delays.require_supported(problem)
    if has_path_couplings(problem):
        problem, declared = written_out(problem, declared)
    if not isinstance(problem, Phases):
        return normal_form.normalise(problem, declared, name, title)
    form = _common_form(problem)
    jumps = jump_entries(problem.jumps, len(problem.phases) - 1) or [[]] * (len(problem.phases) - 1)
    written = [_written(index, phase, form, jumps) for index, phase in enumerate(problem.phases)]
    used = used_quantities(entry for entries in written for entry in entries)
    drawing = scope.checked_drawing(problem.phases[0])
    scope.require_derived(drawing, used)
    normal_form.require_unique_names([*used, *declared])
    unused = normal_form.unused_names([*used, *scope.drawn_quantities(drawing)], declared)
    kinds = kinds_of(used, form)
    normal_form.require_cost(problem.phases, kinds)
    plain = normal_form.plain_symbols(used, "control")
    models = _models(problem.phases, written, kinds, plain)
    entries = [[normal_form.in_plain_symbols(entry, plain) for entry in jump] for jump in jumps]
    chain = _chain(models, entries, kinds, plain, name, title)
    _require_values(chain, entries)
    units = units_of(used, (entry for phase in written for entry in phase), plain)
    chain = normal_form.with_positive_durations(replace(chain, unused=unused, units=units))
    return scope.with_drawing(chain, drawing, plain)


@contextmanager
def _in_phase(index: int) -> Iterator[None]:
    """Let errors name the phase, counted from one."""
    try:
        yield
    except CodegenError as error:
        raise type(error)(f"phase {index + 1}: {error.finding}", error.remedy) from error


def _common_form(problem: Phases) -> str:
    """Which argument says how every phase moves."""
    for index, phase in enumerate(problem.phases):
        if not isinstance(phase, Control):
            raise ProblemFileError(f"phase {index + 1} is a {type(phase).__name__}", "let every phase be a Control")
    if len(problem.phases) < 2:
        raise ProblemFileError("a single phase in Phases(...)", "give two or more, or return the Control itself")
    forms, greatest = list[str](), list[bool]()
    for index, phase in enumerate(problem.phases):
        with _in_phase(index):
            forms.append(form_of(phase))
            greatest.append(maximises(phase))
        if forms[-1] != forms[0]:
            raise ExpressionError(
                f"phase 1 is given by {forms[0]}, phase {index + 1} by {forms[-1]}", "give all phases in the same way"
            )
        if phase.steps != problem.phases[0].steps:
            raise ExpressionError(
                f"phase 1 has {problem.phases[0].steps} steps, phase {index + 1} has {phase.steps}",
                "give all phases the same number of steps; their lengths may differ",
            )
    if any(greatest) and not all(greatest[i] or not _has_cost(phase) for i, phase in enumerate(problem.phases)):
        raise ExpressionError("one phase has a cost, another one maximises", "give all phases the same, with its sign")
    return forms[0]


def _has_cost(phase: Control) -> bool:
    return any(entry.expression != 0 for entry in written_costs(phase))


def _written(index: int, phase: Control, form: str, jumps: Sequence[Sequence[Entry]]) -> list[Entry]:
    with _in_phase(index):
        _require_supported(index, phase)
        return written_entries(phase, form, jumps[index - 1] if index else ())


def _require_supported(index: int, phase: Control) -> None:
    """Refuse what a phase cannot have, or what has no meaning between two others."""
    if index and (phase.start or phase.start_conditions):
        raise BoundaryError(
            "it says how it starts, but begins where the phase before ends",
            f"write a value in jumps[{index - 1}], or a condition in the end or end_conditions of phase {index}",
        )
    for kind in CONDITIONS:
        if kind.not_in_phases and getattr(phase, kind.argument):
            error, finding, remedy = kind.not_in_phases
            raise error(finding, remedy)
    if phase.bodies != 1:
        raise ExpressionError(f"bodies is {phase.bodies!r}", "let one body move in problems of phases")
    if index and phase.drawing:
        raise ExpressionError("it has a drawing", "give the drawing to the first phase, whose it is in all of them")


def _models(
    phases: Sequence[Control], written: Sequence[Sequence[Entry]], kinds: Kinds, plain: Mapping[Quantity, sympy.Symbol]
) -> list[Model]:
    """The model of every phase; what one leaves open is expected to be near where the phases before it end."""
    models: list[Model] = []
    elsewhere: dict[sympy.Symbol, float] = {}
    for index, (phase, entries) in enumerate(zip(phases, written, strict=True)):
        models.append(_phase(index, phase, entries, kinds, plain, elsewhere))
        elsewhere |= smoothness.expected_values(models[-1], 1.0)
    return models


def _phase(
    index: int,
    phase: Control,
    entries: Sequence[Entry],
    common: Kinds,
    plain: Mapping[Quantity, sympy.Symbol],
    elsewhere: Mapping[sympy.Symbol, float],
) -> Model:
    """The model of one phase, checked by itself."""
    with _in_phase(index):
        kinds = kinds_of(used_quantities(entries), form_of(phase))
        lacking = [q.name for q in common.coordinates if q not in kinds.coordinates]
        if lacking:
            raise SymbolError(
                f"{' '.join(lacking)} of another phase does not occur in it",
                "let all phases have the same coordinates or states; one that rests has the derivative 0",
            )
        if kinds.end_values or kinds.body is not None:
            symbol = f"{kinds.end_values[0].partner}.of(...)" if kinds.end_values else "body"
            raise SymbolError(f"{symbol} belongs to problems of several bodies", "leave it out of problems of phases")
        model = normal_form.checked_model(phase, entries, kinds, plain, elsewhere=elsewhere)
        for condition in model.path:
            if condition.equality and not condition.expression.free_symbols & {*model.rates, *model.controls}:
                raise BoundaryError(
                    f"path {condition} fixes coordinates at every time, and no other phase can",
                    "replace it by its derivative, with a condition at the end of a phase",
                )
        return model


def _chain(
    models: Sequence[Model],
    jumps: Sequence[Sequence[Entry]],
    kinds: Kinds,
    plain: Mapping[Quantity, sympy.Symbol],
    name: str,
    title: str,
) -> Model:
    """The model of all phases, in which each phase knows the parameters and the time of all."""
    first, last = models[0], models[-1]
    time = plain[kinds.time] if kinds.time is not None else first.time
    common = {
        "name": name,
        "title": title,
        "parameters": tuple(plain[p] for p in kinds.parameters),
        "defaults": tuple(p.value for p in kinds.parameters),
        "free_parameters": tuple(_free_parameter(plain[p], models) for p in kinds.free),
        "time": time,
    }
    return replace(
        first,
        **common,
        controls=tuple(plain[u] for u in kinds.controls),
        duration=sympy.Add(*(model.duration for model in models)),
        end=last.end,
        end_conditions=last.end_conditions,
        terminal_cost=last.terminal_cost,
        maximised=any(model.maximised for model in models),
        phases=tuple(replace(model, **common) for model in models),
        jumps=tuple(_jump(entries) for entries in jumps),
        scales=tuple(pair for model in models for pair in model.scales),
    )


def _free_parameter(symbol: sympy.Symbol, models: Sequence[Model]) -> FreeParameter:
    """A free parameter with the bounds that any phase gives it."""
    found = [free for model in models for free in model.free_parameters if free.symbol == symbol]
    limits = []
    for side in ("lower", "upper"):
        given = list(dict.fromkeys(getattr(f, side) for f in found if getattr(f, side) is not None))
        if len(given) > 1:
            raise ExpressionError(f"{symbol} has two {side} bounds", "give it in one phase")
        limits.append(given[0] if given else None)
    return FreeParameter(symbol, found[0].guess, *limits)


def _jump(entries: Sequence[Entry]) -> Jump:
    pairs = []
    for entry in entries:
        assert entry.key is not None, "a jump has a key"
        if entry.expression == entry.key:
            raise ExpressionError(f"{entry.what} is its value before", "leave it out, it is continuous")
        pairs.append((entry.key, entry.expression))
    return tuple(pairs)


def _require_values(chain: Model, jumps: Sequence[Sequence[Entry]]) -> None:
    """Refuse jumps without a value, bounds that do not meet, and values at the ends that violate conditions."""
    points = smoothness.sample_points(chain)
    for entry in (entry for jump in jumps for entry in jump):
        if all(expressions.rounded_at(entry.expression, point) is None for point in points):
            raise ExpressionError(
                f"{entry.what} has no finite real value at the default parameters", "correct it, or the parameters"
            )
    for switch, (before, after) in enumerate(pairwise(chain.phases)):
        _require_common_values(switch, before, after, dict(chain.jumps[switch]))
    begin: sympy.Expr = sympy.S.Zero
    for index, model in enumerate(chain.phases):
        with _in_phase(index):
            # The time at which a phase ends is that of the whole problem.
            values.require_agreement(replace(model, duration=begin + model.duration))
        begin += model.duration


def _require_common_values(switch: int, before: Model, after: Model, jump: Mapping[sympy.Symbol, Any]) -> None:
    """What does not jump has to satisfy the bounds of both phases, with room between them unless it is given."""
    numbers, where = values.values_at_guess(before), f"at the switch from phase {switch + 1} to phase {switch + 2}"
    given = prescribed(before, "end")
    for symbol in (s for s in (*before.coordinates, *before.rates) if s not in jump):
        both = [bound for model in (before, after) for bound in model.bounds if bound.symbol == symbol]
        least = max(_numbers([bound.lower for bound in both], numbers), default=-math.inf)
        greatest = min(_numbers([bound.upper for bound in both], numbers), default=math.inf)
        for value in _numbers([given.get(symbol)], numbers):
            if value < least - rounding_of((value, least)) or value > greatest + rounding_of((value, greatest)):
                raise BoundaryError(
                    f"{symbol} is {value:g} {where}, outside its bounds {least:g} and {greatest:g}",
                    "correct one of them",
                )
        if symbol not in given and not least < greatest:
            raise BoundaryError(
                f"the bounds of {symbol} leave {'one value' if least == greatest else 'no value'} {where}",
                f"widen them, or give {symbol} a value in the end of phase {switch + 1}",
            )


def _numbers(given: Sequence[sympy.Expr | None], at: Mapping[sympy.Symbol, float]) -> list[float]:
    """The values of those expressions that there are."""
    found = [expressions.rounded_at(expression, at) for expression in given if expression is not None]
    return [value for value in found if value is not None]


def load_problem(problem: Source | Path | str, arguments: Mapping[str, str] = {}) -> Model | PairwiseModel:
    """Run a problem file's `problem(...)` with the given `--set` arguments, and check and normalise what it returns.

    The model is named after the file and titled by the first line of its docstring; of an object its source has both.
    Raises ProblemFileError when the file cannot be read, imported or called; ArgumentError when an argument does not
    fit `problem`; another CodegenError when the problem is not well posed. All name the file or the object, in one
    line.
    """
    source = source_of(problem)
    title, written, declared = source.written(arguments)
    try:
        if is_pairwise(written):
            return normalise_pairwise(written, declared, name=source.name, title=title)
        return normalise(written, declared, name=source.name, title=title)
    except CodegenError as error:
        raise with_location(error, source.location) from error
