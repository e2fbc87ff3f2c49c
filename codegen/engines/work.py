"""What engines share out: work in chunks, which are counted from zero and done in any process.

Work can be pickled, and is small: workers get it once, and then a piece, or a number, for each chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from codegen.engines.tally import Tally


class Abandoned(Exception):
    """Nobody wants the chunk any longer."""


@dataclass(frozen=True)
class Done:
    """A chunk that is finished: how its cases ended, what is to be handed over of them if anything is, and notes."""

    tally: Tally
    rows: Any = None
    notes: tuple[str, ...] = ()


class Work(Protocol):
    """All that doing any chunk needs."""

    def loaded(self) -> Work:
        """The same; what takes long once in a process, such as reading machine code, has been done in this one."""

    def piece(self, number: int) -> Any:
        """What a chunk needs beside the work; as small as the chunk."""

    def solve(self, piece: Any, is_wanted: Callable[[], bool] = ...) -> Done:
        """Do a chunk and leave what is to be left; raises Abandoned as soon as it is no longer wanted.

        What fails in a single case is part of the result; what ends everything is raised.
        """

    def lost(self, number: int, reason: str) -> Done:
        """A chunk of which nothing came."""

    def parcel(self) -> Parcel:
        """The work as it is sent to other machines, without its cases; ArgumentError where it cannot be sent."""

    def returned(self, number: int, done: Done) -> Done:
        """Keep, in the process that gave the orders, what a worker elsewhere could not leave where it belongs."""


class Parcel(Protocol):
    """Work on its way to another machine. Machine code belongs to a processor, and is never sent."""

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """The work, ready to do pieces here, and what is to be said of this machine; CodegenError if it cannot be."""
