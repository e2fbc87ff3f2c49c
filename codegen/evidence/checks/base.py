"""What a check is: findings from a context, which is what was derived, and the module on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.discretise.model.definitions import Model
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.discretise.schemes.base import Scheme
from codegen.emit.naming import Choices
from codegen.emit.verify.comparison import GuessedPoints
from codegen.emit.verify.execution import Text
from codegen.emit.verify.kernels import guessed_points
from codegen.identifiers import plain

if TYPE_CHECKING:
    from rich.table import Table

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
        return findings_html(self)


def findings_table(findings: Sequence[Finding]) -> Table:
    """What was checked, of what, and with what outcome."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    silent = [finding for finding in findings if not finding.applies]
    unmeasured = sum(map(_is_unmeasured, silent))
    failed = sum(not finding.passed for finding in findings)
    passed = len(findings) - len(silent) - failed
    caption = f"{passed} passed, {failed} failed, {len(silent) - unmeasured} do not apply"
    caption += f", {unmeasured} not measured" if unmeasured else ""
    table = Table(box=box.SIMPLE_HEAD, caption=caption, caption_justify="left")
    for heading in ("check", "subject", "", "detail"):
        table.add_column(heading)
    for finding in findings:
        detail = finding.detail
        for words in () if finding.applies else ("does not apply: ", "not measured: "):
            detail = detail.removeprefix(words)
        table.add_row(escape(finding.check), escape(finding.subject), _verdict(finding), escape(detail))
    return table


def findings_html(findings: Sequence[Finding]) -> str:
    """Return the findings as a table in HTML, with the outcomes in words and not in colours alone."""
    from codegen.show.notebook import table as html_table

    silent = sum(not finding.applies for finding in findings)
    failed = sum(not finding.passed for finding in findings)
    outcomes = {(True, True): "passed", (True, False): "FAILED"}
    rows = [(f.check, f.subject, outcomes.get((f.applies, f.passed), "does not apply"), f.detail) for f in findings]
    caption = f"{len(findings) - silent - failed} passed, {failed} failed, {silent} do not apply"
    return html_table(rows, ("check", "subject", "outcome", "detail"), caption)


def _is_unmeasured(finding: Finding) -> bool:
    return not finding.applies and finding.detail.startswith("not measured")


def _verdict(finding: Finding) -> str:
    """A check that says nothing about a problem has not passed."""
    if not finding.applies:
        return "[dim]not measured[/]" if _is_unmeasured(finding) else "[dim]does not apply[/]"
    return "[green]passed[/]" if finding.passed else "[bold red]FAILED[/]"


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
