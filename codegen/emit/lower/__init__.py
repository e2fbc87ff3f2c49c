"""Lowering of derivatives to strings: stable forms, common subexpressions, printing, and counts of operations."""

from __future__ import annotations

from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.emit.differentiation import ControlDerivatives, ControlSensitivities, StepDerivatives
from codegen.emit.lower.control import lower_control
from codegen.emit.lower.module import Module
from codegen.emit.lower.particles import lower_particles
from codegen.emit.lower.simulate import lower_step
from codegen.emit.pairwise_derivatives import PairDerivatives


def lower(
    program: ControlProgram | StepProgram | PairwiseProgram,
    derivatives: ControlDerivatives | StepDerivatives | PairDerivatives,
    by_data: ControlSensitivities | None = None,
) -> Module:
    """Return a discretised problem and its derivatives as code; derivatives `by_data` add sensitivities."""
    if isinstance(program, PairwiseProgram):
        assert isinstance(derivatives, PairDerivatives)
        return lower_particles(program, derivatives)
    if isinstance(program, ControlProgram):
        assert isinstance(derivatives, ControlDerivatives)
        return lower_control(program, derivatives, by_data)
    assert isinstance(derivatives, StepDerivatives)
    return lower_step(program, derivatives)
