"""Verification of a module's text: its derivatives must agree with an independent differentiation.

Python executes the text without compilation. The results are compared with the expressions of the discretised problem,
evaluated unchanged. The comparison has only these expressions in common with the stages that made the text.
"""

from __future__ import annotations

from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.emit.lower.control.layout import parameters
from codegen.emit.verify.execution import Text, verify_tables
from codegen.emit.verify.kernels import verify_control, verify_particles, verify_step
from codegen.emit.verify.shares import verify_couplings
from codegen.symbolic.functions import tables_of


def verify(program: ControlProgram | StepProgram | PairwiseProgram, text: str) -> None:
    """Raise VerificationError, with the name of the entry, if a kernel in the text differs from the problem."""
    tables = () if isinstance(program, PairwiseProgram) else tables_of(program.model)
    parts = Text(text, tables)
    verify_tables(
        tables, len(parameters(program) if isinstance(program, ControlProgram) else program.model.parameters), parts
    )
    if isinstance(program, ControlProgram):
        verify_control(program, parts)
        verify_couplings(program, parts)
    elif isinstance(program, StepProgram):
        verify_step(program, parts)
    else:
        verify_particles(program, parts)
