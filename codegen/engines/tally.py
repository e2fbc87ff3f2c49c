"""How the cases of some work ended, counted by status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from codegen.errors import clause

if TYPE_CHECKING:
    from rich.table import Table

SOLVED = "solved"
LOST = "worker lost"
"""The status of a case whose chunk has ended process after process."""


@dataclass(frozen=True)
class Tally:
    """How many cases ended in each status, the first message of each, and the seconds of all solves together.

    `improved` are those that were begun from beyond a jump of the cost and won by it; beside `jumps` one is left.
    """

    counts: Mapping[str, int] = field(default_factory=dict)
    messages: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    improved: int = 0
    jumps: int = 0

    def __add__(self, other: Tally) -> Tally:
        """Both together; messages of the first count."""
        counts = {key: self.counts.get(key, 0) + other.counts.get(key, 0) for key in {**self.counts, **other.counts}}
        sums = (self.seconds + other.seconds, self.improved + other.improved, self.jumps + other.jumps)
        return Tally(counts, {**other.messages, **self.messages}, *sums)

    @property
    def cases(self) -> int:
        """How many cases have been counted."""
        return sum(self.counts.values())

    @property
    def solved(self) -> int:
        """How many are solved."""
        return self.counts.get(SOLVED, 0)

    @property
    def failed(self) -> dict[str, int]:
        """How many are not, by status, the most frequent first."""
        rest = ((status, count) for status, count in self.counts.items() if status != SOLVED)
        return dict(sorted(rest, key=lambda pair: (-pair[1], pair[0])))

    def as_record(self) -> dict[str, Any]:
        """The tally as an object of JSON, which `from_record` reads."""
        return {"counts": dict(self.counts), "messages": dict(self.messages), "seconds": self.seconds, **self.won}

    @property
    def won(self) -> dict[str, int]:
        """What there is to say of jumps of the cost: nothing where there were none."""
        named = {"improved": self.improved, "jumps": self.jumps}
        return {name: number for name, number in named.items() if number}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Tally:
        """The tally that a record tells; KeyError, TypeError or ValueError where it tells none."""
        counts = {str(status): int(count) for status, count in dict(record["counts"]).items()}
        messages = {str(status): str(message) for status, message in dict(record["messages"]).items()}
        jumps = (int(record.get(name, 0)) for name in ("improved", "jumps"))
        return Tally(counts, messages, float(record["seconds"]), *jumps)


def counted(number: int, what: str) -> str:
    """A number and what is counted, in the singular or the plural."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def table_of(tally: Tally) -> Table:
    """A line for every status, with one of its messages."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("status", no_wrap=True)
    table.add_column("cases", justify="right")
    table.add_column("for example")
    for status, count in {SOLVED: tally.solved, **tally.failed}.items():
        style = "green" if status == SOLVED else "bold red"
        example = "" if status == SOLVED else escape(clause(tally.messages.get(status, "")))
        table.add_row(f"[{style}]{status}[/]", str(count), example)
    return table
