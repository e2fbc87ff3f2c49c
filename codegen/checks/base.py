"""What a check is: a function from a context (what was derived, and the module on disk) to findings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

from codegen.compiler import Choices
from codegen.mangling import plain
from codegen.model import Model
from codegen.schemes import Scheme
from codegen.transcribe.program import ControlProgram, StepProgram

_LEAST_STEPS = 8


@dataclass(frozen=True)
class Finding:
    """One piece of evidence: which check, about what, whether it holds, and the formula or number that says so.

    What does not apply to a problem has passed, but is no evidence; then `detail` says why it does not apply.
    """

    check: str
    subject: str
    passed: bool
    detail: str
    applies: bool = True

    def __post_init__(self) -> None:
        """Say names as the problem's author wrote them."""
        object.__setattr__(self, "subject", plain(self.subject))
        object.__setattr__(self, "detail", plain(self.detail))


@dataclass(frozen=True)
class Context:
    """What checks read: the author's model, its discretisation, and the generated module as it lies on disk."""

    choices: Choices
    model: Model
    program: ControlProgram | StepProgram
    scheme: Scheme
    module: Any

    @cached_property
    def solution(self) -> Any:
        """What the module's solver finds on the default number of intervals, but on eight at least."""
        return self.module.solve(max(_LEAST_STEPS, self.model.steps))


Check: TypeAlias = Callable[[Context], Iterable[Finding]]
"""A check yields at least one finding, also where it does not apply."""


def does_not_apply(check: str, reason: str) -> Finding:
    """The finding of a check that has nothing to say about a problem."""
    return Finding(check, "the whole problem", True, f"does not apply: {reason}", applies=False)
