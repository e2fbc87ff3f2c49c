"""What a check is: findings from a context, which is what was derived, and the module on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from codegen.mangling import plain
from codegen.model import Model
from codegen.naming import Choices
from codegen.schemes import Scheme
from codegen.tasks import Home
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.step_program import StepProgram
from codegen.verify.control import guessed_points
from codegen.verify.execution import Text
from codegen.verify.points import GuessedPoints

_LEAST_STEPS = 8


@dataclass(frozen=True)
class Finding:
    """One piece of evidence: which check, about what, whether it holds, and the formula or number that says so.

    What does not apply to a problem, or could not be measured, has passed, but is no evidence; then `detail` says why.
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


class Findings(tuple[Finding, ...]):
    """The findings of all checks in their order, which a notebook shows as a table."""

    __slots__ = ()

    @property
    def passed(self) -> bool:
        """Whether no check has failed."""
        return all(finding.passed for finding in self)

    @property
    def failed(self) -> tuple[Finding, ...]:
        """Those that have."""
        return tuple(finding for finding in self if not finding.passed)

    def _repr_html_(self) -> str:
        return str(_HTML(self))


_HTML = Home("notebooks.solution", "findings_html")


@dataclass(frozen=True)
class Context:
    """What checks read: the author's model, its discretisation, and the generated module as it lies on disk."""

    choices: Choices
    model: Model
    program: ControlProgram | StepProgram
    scheme: Scheme
    module: Any

    @property
    def control(self) -> ControlProgram:
        """The program of a control problem."""
        assert isinstance(self.program, ControlProgram), "the task is not control"
        return self.program

    @cached_property
    def solution(self) -> Any:
        """What the module's solver finds on the default number of intervals, but on eight at least."""
        return self.module.solve(max(_LEAST_STEPS, len(self.model.inner_times) + 1, self.model.steps))

    @cached_property
    def guessed(self) -> GuessedPoints | None:
        """Points near the guess of the module; none where a damaged module makes no guess."""
        program = self.control
        try:
            return guessed_points(program, Text(Path(self.module.__file__).read_text(encoding="utf-8")))
        except Exception:  # a damaged module may fail in any way
            return None


@dataclass(frozen=True)
class Check:
    """A kind of evidence: its name, and what finds it, which yields at least one finding also where it does not apply.

    A check that `runs_the_module` calls compiled code, or trusts tables of the module; else it looks at expressions
    alone. One of equations may be made `of_each_phase`, as if that were a problem of its own. `without` says for tasks
    and forms of dynamics that lack what it is about what that is; such problems are not given to it.
    """

    name: str
    findings: Callable[[Context], Iterable[Finding]]
    runs_the_module: bool = True
    of_each_phase: bool = False
    without: Mapping[str, str] = field(default_factory=dict)


def does_not_apply(check: str, reason: str) -> Finding:
    """The finding of a check that has nothing to say about a problem."""
    return Finding(check, "the whole problem", True, f"does not apply: {reason}", applies=False)


def not_measured(check: str, subject: str, reason: str) -> Finding:
    """The finding of a check that needs what is not there, as a solution where the solver found none."""
    return Finding(check, subject, True, f"not measured: {reason}", applies=False)
