"""Text of a module -> the same text, once its derivatives agree with an independent differentiation.

What the text says is executed by the interpreter and compared with the program's expressions, evaluated as they stand;
nothing is shared with the stages that made it but the expressions themselves.
"""

from __future__ import annotations

from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.emit.lower.control.layout import parameters
from codegen.emit.verify.execution import Text, verify_tables
from codegen.emit.verify.kernels import verify_control, verify_particles, verify_step
from codegen.emit.verify.shares import verify_couplings
from codegen.symbolic.table_functions import tables_of


def verify(program: ControlProgram | StepProgram | PairwiseProgram, text: str) -> None:
    """Raise VerificationError, naming the entry, where a kernel is not what its program says."""
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
