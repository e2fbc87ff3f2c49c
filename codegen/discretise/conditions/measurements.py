"""Measurements that a motion fits: every sample adds the loss of its errors to the cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

from sympy import Add, Expr, Piecewise, Symbol, sqrt, sstr

from codegen.discretise.conditions.base import ConditionKind, Latex, Points, Remedies, Scope
from codegen.discretise.interval import FRACTION
from codegen.discretise.model.definitions import Model, Observed
from codegen.discretise.model.guesses import measured_guess
from codegen.discretise.model.relations import MOVING, STATIC, Entry, entry_of
from codegen.discretise.program import Names, SampleElement
from codegen.errors import ExpressionError, TableError
from codegen.identifiers import in_latex
from codegen.problem.problem import Control
from codegen.problem.symbols import ControlInput, FreeParameter, Time
from codegen.problem.tables import Measurements
from codegen.symbolic import checks as expressions
from codegen.symbolic.tables import LOSSES, require_within

_LISTED = 6
"""Greatest number of files that the docstring of a generated module lists."""


class Observations(ConditionKind):
    """Expressions in coordinates and rates whose values were measured."""

    argument, field, words = "observations", "observed", "measurements"
    check = "measurements"
    scope: ClassVar[Scope] = {"observations": (*MOVING, Time, *STATIC)}
    remedies: ClassVar[Remedies] = {ControlInput: "measure what moves; a control is constant on an interval"}
    not_in_phases = ExpressionError, "it has observations", "give measurements to problems of one phase"

    def written(self, control: Control) -> Iterator[Entry]:
        measured = measurements_of(control)
        for expression, column in measured[0].values.items() if measured else ():
            yield replace(entry_of(self.argument, f"what {column} measures", expression), name=column)

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        for what in ("maximise", "terminal_maximise"):
            if expressions.checked(getattr(control, what), what) != 0:
                raise ExpressionError(f"observations beside {what}", "write the cost negated, as what is to be least")
        if any(isinstance(s, FreeParameter) for s in expressions.checked(control.duration, "duration").free_symbols):
            raise ExpressionError("observations in a motion of free duration", "let it last until the last sample")

    def conditions(self, entries: Sequence[Entry]) -> tuple[Observed, ...]:
        return tuple(Observed(entry.name, entry.expression) for entry in entries if entry.role == self.argument)

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((f"what {observed.name} measures", observed.expression) for observed in model.observed)

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error for sample times outside the motion, and for columns of constant quantities."""
        for observed in model.observed:
            if not observed.expression.has(*model.coordinates, *model.rates):
                raise ExpressionError(
                    f"what {observed.name} measures is {sstr(observed.expression)}, which does not move",
                    "measure states, or expressions of them",
                )
        duration = expressions.number_at(model.duration, model.default_values)
        assert duration is not None or not model.measurements, "free durations were refused"
        for data in model.measurements:
            require_within(data, duration or 0.0)

    def sentences(self, model: Model) -> list[str]:
        if not model.observed:
            return []
        errors = []
        for observed, sigma in zip(model.observed, model.measurements[0].layout.sigmas, strict=True):
            error = f"{sstr(observed.expression)} - {observed.name}"
            errors.append(f"e = {error}" if sigma is None else f"e = ({error})/{sigma}")
        return [
            f"to the cost is added {LOSSES[model.loss]} of {', '.join(errors)}",
            *(f"    {data.summary}" for data in model.measurements[:_LISTED]),
            *([f"    and {len(model.measurements) - _LISTED} files more"] if model.measurements[_LISTED:] else []),
        ]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if model.observed:
            heading = f"Measurements, of whose errors e {LOSSES[model.loss]} is added to the cost"
            yield heading, tuple((observed.name.replace(" ", ""), observed.expression) for observed in model.observed)

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        yield from ()

    def costs(self, control: Control, latex: Latex) -> Iterator[str]:
        """Yield the sums of losses over all samples in LaTeX, with the names of the columns of measurements."""
        observations = control.observations
        for measured in [observations] if isinstance(observations, Measurements) else observations:
            form = r"\left({}\right)^2" if measured.loss == "squares" else rf"\text{{{measured.loss}}}\left({{}}\right)"
            for (value, column), sigma in zip(measured.values.items(), measured.data.layout.sigmas, strict=True):
                name = in_latex(f"{column}_i") if column.isidentifier() else r"\text{measured}_i"
                error = f"{latex.at(value, 't_i')} - {name}"
                error = rf"\frac{{{error}}}{{\sigma_i}}" if sigma is not None else error
                yield rf"\sum_i {form.replace('{}', error)}"


def measurements_of(control: Control) -> tuple[Measurements, ...]:
    """Return the measurements of each body; raise TableError for other objects, or for different layouts."""
    observations: object = control.observations
    listed = (observations,) if isinstance(observations, Measurements) else observations
    if not isinstance(listed, (list, tuple)) or not all(isinstance(one, Measurements) for one in listed):
        raise TableError(
            f"observations are {observations!r}", 'write observations=Measurements("data.csv", values={x: "z"})'
        )
    if listed and len(listed) != control.bodies:
        raise TableError(
            f"there are {len(listed)} measurements for bodies={control.bodies}",
            f"write bodies={len(listed)}, and one Measurements(...) for each body in their order",
        )
    for one in listed:
        if (one.values, one.loss, one.data.layout) != (listed[0].values, listed[0].loss, listed[0].data.layout):
            raise TableError(
                f"measurements {one.data.source} have other columns, or another sigma or loss, than "
                f"{listed[0].data.source}",
                "let all measure the same in the same way",
            )
    return tuple(listed)


def sample_element(model: Model, observed: Sequence[Expr], names: Names) -> SampleElement | None:
    """Return the loss of one sample, None without measurements; `observed` are the model's values at FRACTION."""
    if not observed:
        return None
    fraction = Symbol(names.numbered("fraction"), nonnegative=True)
    values = tuple(Symbol(names.numbered("measured"), real=True) for _ in observed)
    weights = tuple(Symbol(names.numbered("weight"), nonnegative=True) for _ in observed)
    at_sample = [value.xreplace({FRACTION: fraction}) for value in observed]
    errors = (w * (x - z) for w, x, z in zip(weights, at_sample, values, strict=True))
    return SampleElement(
        Add(*(_loss(model.loss, error) for error in errors)),
        tuple(at_sample),
        fraction,
        values,
        weights,
        measured_guess(model),
    )


def _loss(name: str, error: Expr) -> Expr:
    """Return the loss function `name` at a weighted error.

    Source: Huber (1964), Robust estimation of a location parameter, Annals of Mathematical Statistics 35.
    """
    if name == "huber":
        return Piecewise((2 * error - 1, error > 1), (-2 * error - 1, error < -1), (error**2, True))
    if name == "soft-l1":  # 2 (sqrt(1 + e^2) - 1), in a form in which no digits cancel
        return 2 * error**2 / (1 + sqrt(1 + error**2))
    return error**2
