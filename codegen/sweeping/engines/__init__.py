"""The registry of engines: who solves the chunks of a sweep. One file for each; another one is a file and a row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from codegen.sweeping.work import Done, Work

Solved: TypeAlias = "Iterator[tuple[int, Done]]"
"""Chunks by their numbers as they are finished, in any order."""
Engine: TypeAlias = "Callable[[Work, int], AbstractContextManager[Callable[[Sequence[int]], Solved]]]"
"""(work, workers) -> a context with workers that are ready, in which a function solves chunks by their numbers.

Each chunk comes exactly once. One whose workers are lost time and again comes as `work.lost` makes it.
"""


@dataclass(frozen=True)
class Row:
    """Name and summary of an engine; its file has a function `running` that is an Engine."""

    name: str
    summary: str

    @property
    def running(self) -> Engine:
        """The engine, imported when it is asked for."""
        return getattr(import_module(f"codegen.sweeping.engines.{self.name}"), "running")  # type: ignore[no-any-return]  # noqa: B009


ENGINES = {
    row.name: row
    for row in (
        Row("here", "one chunk after the other in this process"),
        Row("processes", "processes on this machine, each with one thread"),
    )
}
"""Every engine by name; tests run over this table."""


def engine_for(workers: int) -> Row:
    """The engine that so many workers of this machine need."""
    return ENGINES["here" if workers == 1 else "processes"]
