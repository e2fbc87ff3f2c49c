"""Derivatives -> strings: rewriting for numerical stability, common subexpressions, printing, operation counts."""

from __future__ import annotations

from codegen.derive import ControlDerivatives, StepDerivatives
from codegen.derive.mixed import ControlSensitivities
from codegen.derive.pairwise import PairDerivatives
from codegen.lower.control.module import lower_control
from codegen.lower.module import Module
from codegen.lower.particles.module import lower_connect, lower_particles
from codegen.lower.simulate import lower_step
from codegen.transcribe.connect import PairwiseProgram
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.step_program import StepProgram


def lower(
    program: ControlProgram | StepProgram | PairwiseProgram,
    derivatives: ControlDerivatives | StepDerivatives | PairDerivatives,
    by_data: ControlSensitivities | None = None,
) -> Module:
    """Write a program and its derivatives as strings; with derivatives `by_data` the module makes sensitivities."""
    if isinstance(program, PairwiseProgram):
        assert isinstance(derivatives, PairDerivatives)
        return (lower_connect if program.model.connects else lower_particles)(program, derivatives)
    if isinstance(program, ControlProgram):
        assert isinstance(derivatives, ControlDerivatives)
        return lower_control(program, derivatives, by_data)
    assert isinstance(derivatives, StepDerivatives)
    return lower_step(program, derivatives)
