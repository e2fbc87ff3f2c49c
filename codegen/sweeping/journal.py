"""The journal beside a store: which sweep it belongs to, the shape of its chunks, and which of these are finished."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from codegen.engines import journal
from codegen.engines.journal import damaged
from codegen.engines.tally import Tally
from codegen.sweeping.chunks import Chunks

ANOTHER = "choose another name, or give the problem, cases and options that it was begun with"


@dataclass(frozen=True)
class SweepJournal:
    """The chunks of a sweep, the tallies of those that are finished by their numbers, and the lines that tell it."""

    lines: journal.Journal
    chunks: Chunks
    finished: Mapping[int, Tally]

    @property
    def digest(self) -> str:
        """What tells this sweep from others."""
        return str(self.lines.header["sweep"])

    def add(self, number: int, tally: Tally) -> None:
        """Note that a chunk is whole; FileError when the file system refuses."""
        self.lines.add([{"chunk": number, **tally.as_record()}])


def begun(path: Path, digest: str, chunks: Chunks) -> SweepJournal:
    """A new journal, in which no chunk is finished."""
    header = {"sweep": digest, "cases": chunks.shape, "chunk": chunks.block}
    return SweepJournal(journal.begun(path, header), chunks, {})


def read(path: Path, digest: str) -> SweepJournal:
    """The journal of a sweep that was begun; ArgumentError where it is that of another, or none."""
    lines = journal.read(path, "sweep", digest, ANOTHER)
    try:
        chunks = Chunks(tuple(map(int, lines.header["cases"])), tuple(map(int, lines.header["chunk"])))
        finished = {int(record["chunk"]): Tally.from_record(record) for record in lines.records}
    except (KeyError, TypeError, ValueError):
        raise damaged(path) from None
    return SweepJournal(lines, chunks, finished)
