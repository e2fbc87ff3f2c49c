"""A journal: which work it belongs to, and what of that is whole.

Lines of JSON: first a header with the digest of the work, then one for each part that is where it belongs. A line is
written after its part, so that what ends the work at any time loses only what was being done; a line that was cut off
counts for nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.errors import ArgumentError
from codegen.files import refused, write_text


def journal_of(path: Path) -> Path:
    """The file beside a store, or a table, that is filled part by part."""
    return path.with_name(f"{path.name}.journal")


@dataclass(frozen=True)
class Journal:
    """A file of lines, its header, and the lines that it had when it was opened."""

    path: Path
    header: Mapping[str, Any]
    records: tuple[dict[str, Any], ...] = ()

    def add(self, records: Iterable[Mapping[str, Any]]) -> None:
        """Note parts that are whole; FileError when the file system refuses."""
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write("".join(json.dumps(record) + "\n" for record in records))
        except OSError as error:
            raise refused(error, self.path) from error


def begun(path: Path, header: Mapping[str, Any]) -> Journal:
    """A new journal, in which nothing is noted."""
    write_text(path, json.dumps(header) + "\n")
    return Journal(path, header)


def read(path: Path, kind: str, digest: str, another: str) -> Journal:
    """The journal of work of a kind that was begun; ArgumentError where it is that of another, or none.

    `another` is what to do in that case. A line at the end that is not whole is taken away, so that the next one does
    not go on in it.
    """
    # The lines that are whole, of which there is at least one.
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError):
        raise ArgumentError(f"--resume: {path} cannot be read", another) from None
    found = []
    for line in lines:
        if not line.endswith("\n"):
            break
        try:
            found.append(json.loads(line))
        except ValueError:
            raise damaged(path) from None
    if not found or not all(isinstance(record, dict) for record in found):
        raise damaged(path)
    header, *records = found
    if header.get(kind) != digest:
        raise ArgumentError(f"--resume: {path} tells of another {kind}", another)
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        os.truncate(path, whole)
    return Journal(path, header, tuple(records))


def damaged(path: Path) -> ArgumentError:
    """The error of a journal whose lines are none of ours."""
    return ArgumentError(f"--resume: {path} is damaged", "begin anew under another name")
