"""What checks read of a problem of several phases: each phase as if it were a problem of its own, in time."""

from __future__ import annotations

from dataclasses import replace

from sympy import Add, Expr

from codegen.checks.base import Context
from codegen.discretise import STEP
from codegen.model import Model
from codegen.transcribe.program import ControlProgram


def phase_contexts(context: Context) -> list[tuple[str, Context]]:
    """What to write before a subject, and the context of each phase; of a problem without phases its own context."""
    if not context.model.phases:
        return [("", context)]
    models = enumerate(context.model.phases)
    alone = [(model, phase_alone(context.control, context.model, index)) for index, model in models]
    return [
        (f"phase {number}: ", replace(context, model=model, program=program))
        for number, (model, program) in enumerate(alone, start=1)
    ]


def phase_alone(program: ControlProgram, chain: Model, index: int) -> ControlProgram:
    """The later intervals of a phase, with t and h as times of the whole problem again."""
    phase, durations = program.phases[index], [model.duration for model in chain.phases]
    begin, time = Add(*durations[:index]), chain.time
    scales = {STEP: STEP / durations[index], time: index + (time - begin) / durations[index]}

    def in_time(expression: Expr) -> Expr:
        return expression.xreplace(scales)

    return replace(
        program,
        model=chain.phases[index],
        element=in_time(phase.regular.element),
        cost=in_time(phase.regular.cost),
        equations=tuple((name, in_time(value)) for name, value in phase.equations),
        scaled_time=False,
        phases=(),
    )
