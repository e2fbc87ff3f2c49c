"""What a check is: a function from a context (what was derived, and the module on disk) to findings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

from codegen.compiler import Choices
from codegen.model import Model
from codegen.schemes import Scheme
from codegen.transcribe.program import ControlProgram, StepProgram


@dataclass(frozen=True)
class Finding:
    """One piece of evidence: which check, about what, whether it holds, and the formula or number that says so."""

    check: str
    subject: str
    passed: bool
    detail: str


@dataclass(frozen=True)
class Context:
    """What checks read: the author's model, its discretisation, and the generated module as it lies on disk."""

    choices: Choices
    model: Model
    program: ControlProgram | StepProgram
    scheme: Scheme
    module: Any


Check: TypeAlias = Callable[[Context], Iterable[Finding]]
"""A check yields nothing where it does not apply."""
