"""The journal beside a store: which sweep it belongs to, and which of its chunks are finished.

Lines of JSON: first the digest of the sweep and the shape of its chunks, then one for each chunk that is whole in the
store. A line is written after its chunk, so that what ends a sweep at any time loses only what was being solved; a
line that was cut off counts for nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.errors import ArgumentError
from codegen.files import refused, write_text
from codegen.sweeping.chunks import Chunks
from codegen.sweeping.statuses import Tally

ANOTHER = "choose another name, or give the problem, cases and options that it was begun with"


def journal_of(store: Path) -> Path:
    """The file beside a store."""
    return store.with_name(f"{store.name}.journal")


@dataclass(frozen=True)
class Journal:
    """The digest of a sweep, its chunks, and the tallies of those that are finished by their numbers."""

    path: Path
    digest: str
    chunks: Chunks
    finished: Mapping[int, Tally]

    def add(self, number: int, tally: Tally) -> None:
        """Note that a chunk is whole; FileError when the file system refuses."""
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write(json.dumps({"chunk": number, **tally.as_record()}) + "\n")
        except OSError as error:
            raise refused(error, self.path) from error


def begun(path: Path, digest: str, chunks: Chunks) -> Journal:
    """A new journal, in which no chunk is finished."""
    header = {"sweep": digest, "cases": chunks.shape, "chunk": chunks.block}
    write_text(path, json.dumps(header) + "\n")
    return Journal(path, digest, chunks, {})


def read(path: Path, digest: str) -> Journal:
    """The journal of a sweep that was begun; ArgumentError where it is that of another, or none."""
    header, *lines = _records(path)
    if header.get("sweep") != digest:
        raise ArgumentError(f"--resume: {path} tells of another sweep", ANOTHER)
    try:
        chunks = Chunks(tuple(map(int, header["cases"])), tuple(map(int, header["chunk"])))
        finished = {int(line["chunk"]): Tally.from_record(line) for line in lines}
    except (KeyError, TypeError, ValueError):
        raise _damaged(path) from None
    _cut(path)
    return Journal(path, digest, chunks, finished)


def _records(path: Path) -> list[dict[str, Any]]:
    """The lines that are whole, of which there is at least one."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError):
        raise ArgumentError(f"--resume: {path} cannot be read", ANOTHER) from None
    found = []
    for line in lines:
        if not line.endswith("\n"):
            break
        try:
            found.append(json.loads(line))
        except ValueError:
            raise _damaged(path) from None
    if not found or not all(isinstance(record, dict) for record in found):
        raise _damaged(path)
    return found


def _damaged(path: Path) -> ArgumentError:
    return ArgumentError(f"--resume: {path} is damaged", "begin anew under another name")


def _cut(path: Path) -> None:
    """Take away a line at the end that is not whole, so that the next one does not go on in it."""
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        os.truncate(path, whole)
