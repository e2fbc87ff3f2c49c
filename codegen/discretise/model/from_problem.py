"""The canonical model of a problem of one phase or of several phases.

A problem of several phases has a model for each phase, the quantities that are common to all phases, and the jumps at
the switches between them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import sympy

from codegen.discretise.conditions import CONDITIONS, holonomic
from codegen.discretise.model import delays, normal_form, scope, values
from codegen.discretise.model.definitions import FreeParameter, Model, prescribed
from codegen.discretise.model.normal_form import (
    jump_entries,
    maximises,
    used_quantities,
    written_costs,
    written_entries,
)
from codegen.discretise.model.pairwise import PairwiseModel, is_pairwise, normalise_pairwise
from codegen.discretise.model.relations import Entry, text
from codegen.discretise.model.scope import Kinds, kinds_of
from codegen.discretise.model.units import units_of
from codegen.errors import BoundaryError, CodegenError, ExpressionError, ProblemFileError, SymbolError
from codegen.problem.bodies import has_path_couplings, written_out
from codegen.problem.problem import Control, Phases, Problem, form_of
from codegen.problem.sources import Source, source_of, with_location
from codegen.problem.symbols import Quantity
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounding_of

_TRIALS, _ITERATIONS, _NEARLY = 3, 20, 1e-8
"""Random states, Newton iterations, and tolerance of the test whether a jump leads away from a constraint."""


def load_problem(problem: Source | Path | str, arguments: Mapping[str, str] = {}) -> Model | PairwiseModel:
    """Run `problem(...)` of a problem file with the given `--set` arguments, and return the checked model.

    The model has the name of the file, and the first line of the file's docstring as its title; a Source has both.
    Raises ProblemFileError when the file cannot be read, imported or called; ArgumentError when an argument does not
    fit `problem`; another CodegenError when the problem is not well posed. All errors name the file or the object.
    """
    source = source_of(problem)
    title, written, declared = source.written(arguments)
    try:
        if is_pairwise(written):
            return normalise_pairwise(written, declared, name=source.name, title=title)
        return normalise(written, declared, name=source.name, title=title)
    except CodegenError as error:
        raise with_location(error, source.location) from error


def normalise(
    problem: Problem | Phases, declared: Sequence[Quantity] = (), name: str = "problem", title: str = ""
) -> Model:
    """Return the checked canonical form of an author's problem, of one phase or several.

    `declared` are all quantities that the author declared. Raises a kind of CodegenError that names the symbol or
    expression and the remedy.
    """
    delays.require_supported(problem)
    if isinstance(problem, Control) and has_path_couplings(problem):
        problem, declared = written_out(problem, declared)
    if not isinstance(problem, Phases):
        return normal_form.normalise(problem, declared, name, title)
    form = _common_form(problem)
    jumps = jump_entries(problem.jumps, len(problem.phases) - 1) or [[]] * (len(problem.phases) - 1)
    written = list[list[Entry]]()
    for index, phase in enumerate(problem.phases):
        with _in_phase(index):
            if index and (phase.start or phase.start_conditions):
                remedy = f"a value in jumps[{index - 1}], or a condition in the end or end_conditions of phase {index}"
                raise BoundaryError("it says how it starts, but begins where the phase before ends", f"write {remedy}")
            for kind in CONDITIONS:
                if kind.not_in_phases and getattr(phase, kind.argument):
                    error, finding, remedy = kind.not_in_phases
                    raise error(finding, remedy)
            if phase.bodies != 1:
                raise ExpressionError(f"bodies is {phase.bodies!r}", "let one body move in problems of phases")
            if index and phase.drawing:
                raise ExpressionError(
                    "it has a drawing", "give the drawing to the first phase, whose it is in all of them"
                )
            written.append(written_entries(phase, form, jumps[index - 1] if index else ()))
    used = used_quantities(entry for entries in written for entry in entries)
    drawing = scope.checked_drawing(problem.phases[0])
    scope.require_derived(drawing, used)
    normal_form.require_unique_names([*used, *declared])
    drawn = scope.drawn_quantities(drawing)
    unused = tuple(symbol.name for symbol in declared if symbol not in used and symbol not in drawn)
    kinds = kinds_of(used, form)
    normal_form.require_cost(problem.phases, kinds)
    plain = normal_form.plain_symbols(used, "control")
    models = list[Model]()
    expected = dict[sympy.Symbol, float]()  # values at the end of the phases before
    for index, (phase, entries) in enumerate(zip(problem.phases, written, strict=True)):
        with _in_phase(index):
            models.append(_phase_model(phase, entries, kinds, plain, expected))
        expected |= values.expected_values(models[-1], 1.0)
    jumps = [[normal_form.in_plain_symbols(entry, plain) for entry in jump] for jump in jumps]
    chain = _chain(models, jumps, kinds, plain, name, title)
    # Jumps have values, bounds do not contradict each other, and end values satisfy the conditions.
    points = values.sample_points(chain)
    for entry in (entry for jump in jumps for entry in jump):
        if all(expressions.rounded_at(entry.expression, point) is None for point in points):
            raise ExpressionError(
                f"{entry.what} has no finite real value at the default parameters", "correct it, or the parameters"
            )
    for switch, (before, after) in enumerate(pairwise(chain.phases)):
        _require_common_values(switch, before, after, dict(chain.jumps[switch]))
        _require_constraints_after(switch, before, dict(chain.jumps[switch]))
    begin: sympy.Expr = sympy.S.Zero
    for index, model in enumerate(chain.phases):
        with _in_phase(index):
            # The time at the end of a phase counts from the start of the whole motion.
            values.require_agreement(replace(model, duration=begin + model.duration))
        begin += model.duration
    units = units_of(used, (entry for phase in written for entry in phase), plain)
    chain = normal_form.with_positive_durations(replace(chain, unused=unused, units=units))
    return scope.with_drawing(chain, drawing, plain)


@contextmanager
def _in_phase(index: int) -> Iterator[None]:
    """Add the number of the phase, from 1, to errors."""
    try:
        yield
    except CodegenError as error:
        raise type(error)(f"phase {index + 1}: {error.finding}", error.remedy) from error


def _common_form(problem: Phases) -> str:
    """Return "lagrangian", "hamiltonian" or "dynamics", the argument that must define the motion of every phase."""
    for index, phase in enumerate(problem.phases):
        if not isinstance(phase, Control):
            raise ProblemFileError(f"phase {index + 1} is a {type(phase).__name__}", "let every phase be a Control")
    if len(problem.phases) < 2:
        raise ProblemFileError("a single phase in Phases(...)", "give two or more, or return the Control itself")
    forms, maximised = list[str](), list[bool]()
    for index, phase in enumerate(problem.phases):
        with _in_phase(index):
            forms.append(form_of(phase))
            maximised.append(maximises(phase))
        if forms[-1] != forms[0]:
            raise ExpressionError(
                f"phase 1 is given by {forms[0]}, phase {index + 1} by {forms[-1]}", "give all phases in the same way"
            )
        if phase.steps != problem.phases[0].steps:
            raise ExpressionError(
                f"phase 1 has {problem.phases[0].steps} steps, phase {index + 1} has {phase.steps}",
                "give all phases the same number of steps; their lengths may differ",
            )
    for phase, is_maximised in zip(problem.phases, maximised, strict=True):
        if any(maximised) and not is_maximised and any(entry.expression != 0 for entry in written_costs(phase)):
            remedy = "give all phases the same, with its sign"
            raise ExpressionError("one phase has a cost, another one maximises", remedy)
    return forms[0]


def _phase_model(
    phase: Control,
    entries: Sequence[Entry],
    common: Kinds,
    plain: Mapping[Quantity, sympy.Symbol],
    expected: Mapping[sympy.Symbol, float],
) -> Model:
    """Return the checked model of one phase; `expected` are values of states at the end of the phase before."""
    kinds = kinds_of(used_quantities(entries), form_of(phase))
    missing = [q.name for q in common.coordinates if q not in kinds.coordinates]
    if missing:
        raise SymbolError(
            f"{' '.join(missing)} of another phase does not occur in it",
            "let all phases have the same coordinates or states; one that rests has the derivative 0",
        )
    if kinds.end_values or kinds.body is not None:
        symbol = f"{kinds.end_values[0].partner}.of(...)" if kinds.end_values else "body"
        raise SymbolError(f"{symbol} belongs to problems of several bodies", "leave it out of problems of phases")
    model = normal_form.checked_model(phase, entries, kinds, plain, elsewhere=expected)
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
    """Return the model of the problem; its phases have common parameters, time, name and title."""
    first, last = models[0], models[-1]
    for index, model in enumerate(models[1:], start=2):
        for argument, own, others in (
            ("constraint", model.holonomic, first.holonomic),
            ("rolling", model.rolling, first.rolling),
        ):
            if different := [c for c in (*own, *others) if (c in own) != (c in others)]:
                raise ExpressionError(
                    f"{argument} {text(different[0])} holds in one of the phases 1 and {index}",
                    "give all phases the same constraints, in the same order",
                )
    for entry in (entry for jump in jumps for entry in jump):
        if entry.expression == entry.key:
            raise ExpressionError(f"{entry.what} is its value before", "leave it out, it is continuous")
    common = {
        "name": name,
        "title": title,
        "parameters": tuple(plain[p] for p in kinds.parameters),
        "defaults": tuple(p.value for p in kinds.parameters),
        "free_parameters": tuple(_free_parameter(plain[p], models) for p in kinds.free),
        "time": plain[kinds.time] if kinds.time is not None else first.time,
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
        jumps=tuple(tuple((e.key, e.expression) for e in jump if e.key is not None) for jump in jumps),
        scales=tuple(pair for model in models for pair in model.scales),
    )


def _free_parameter(symbol: sympy.Symbol, models: Sequence[Model]) -> FreeParameter:
    """Return a free parameter with its bounds from all phases; raise ExpressionError if these differ."""
    in_phases = [free for model in models for free in model.free_parameters if free.symbol == symbol]
    limits = []
    for side in ("lower", "upper"):
        bounds = list(dict.fromkeys(getattr(f, side) for f in in_phases if getattr(f, side) is not None))
        if len(bounds) > 1:
            raise ExpressionError(f"{symbol} has two {side} bounds", "give it in one phase")
        limits.append(bounds[0] if bounds else None)
    return FreeParameter(symbol, in_phases[0].guess, *limits)


def _require_common_values(switch: int, before: Model, after: Model, jump: Mapping[sympy.Symbol, sympy.Expr]) -> None:
    """Raise BoundaryError if the bounds of two phases exclude a continuous quantity, or fix a free one, at a switch."""
    defaults, where = values.values_at_guess(before), f"at the switch from phase {switch + 1} to phase {switch + 2}"
    fixed = prescribed(before, "end")

    def numbers(at_switch: Sequence[sympy.Expr | None]) -> list[float]:
        rounded = [expressions.rounded_at(e, defaults) for e in at_switch if e is not None]
        return [number for number in rounded if number is not None]

    for symbol in (s for s in (*before.coordinates, *before.rates) if s not in jump):
        bounds = [bound for model in (before, after) for bound in model.bounds if bound.symbol == symbol]
        least = max(numbers([bound.lower for bound in bounds]), default=-math.inf)
        greatest = min(numbers([bound.upper for bound in bounds]), default=math.inf)
        for value in numbers([fixed.get(symbol)]):
            if value < least - rounding_of((value, least)) or value > greatest + rounding_of((value, greatest)):
                raise BoundaryError(
                    f"{symbol} is {value:g} {where}, outside its bounds {least:g} and {greatest:g}",
                    "correct one of them",
                )
        if symbol not in fixed and not least < greatest:
            raise BoundaryError(
                f"the bounds of {symbol} leave {'one value' if least == greatest else 'no value'} {where}",
                f"widen them, or give {symbol} a value in the end of phase {switch + 1}",
            )


def _require_constraints_after(switch: int, model: Model, jump: Mapping[sympy.Symbol, sympy.Expr]) -> None:
    """Raise BoundaryError if a jump leads away from a constraint: from a random state that satisfies all constraints.

    Newton's method moves coordinates, and then velocities, to the constraints.
    """
    if not jump or not (model.holonomic or model.rolling):
        return
    c = sympy.Matrix(model.holonomic)
    q, v = sympy.Matrix(model.coordinates), sympy.Matrix(model.rates)
    rates = sympy.Matrix([*(holonomic.rates(model) if model.holonomic else ()), *model.rolling])
    fixed = {**values.values_at_guess(model), model.time: 0.0}
    state = [*q, *v]
    numeric = {symbol: sympy.Float(number) for symbol, number in fixed.items() if symbol not in state}
    after = {symbol: jump.get(symbol, symbol) for symbol in state}
    parts = (c, c.jacobian(q), rates, rates.jacobian(v), c.subs(after, simultaneous=True))
    named = (*parts, rates.subs(after, simultaneous=True))
    functions = [sympy.lambdify([state], part.xreplace(numeric), "numpy") for part in named]
    random = np.random.default_rng(0)
    for _ in range(_TRIALS):
        x, n = random.uniform(0.3, 1.0, len(state)), len(model.coordinates)
        for _ in range(_ITERATIONS):
            if model.holonomic:
                x[:n] -= np.linalg.lstsq(functions[1](x), functions[0](x)[:, 0], rcond=None)[0]
            x[n:] -= np.linalg.lstsq(functions[3](x), functions[2](x)[:, 0], rcond=None)[0]
        if (
            not np.all(np.isfinite(x))
            or max(np.abs(f(x)).max(initial=0.0) for f in (functions[0], functions[2])) > _NEARLY
        ):
            continue  # no state was found; the solver tells
        excess = [*np.ravel(functions[4](x)), *np.ravel(functions[5](x))]
        names = [*model.holonomic, *(f"d/dt ({text(each)})" for each in model.holonomic), *model.rolling]
        for name, value in zip(names, excess, strict=True):
            if not abs(value) <= _NEARLY:
                written = name if isinstance(name, str) else text(name)
                raise BoundaryError(
                    f"after jumps[{switch}] the constraint {written} = 0 does not hold",
                    "correct the jump; of a rotation give the angular velocity, as in {omega: omega / 2}",
                )
