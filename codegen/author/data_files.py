"""Files that a problem file reads: where they lie, and that they were read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

_folder: ContextVar[Path | None] = ContextVar("folder of the problem file", default=None)
_recorder: ContextVar[list[DataFile] | None] = ContextVar("files that were read", default=None)


@dataclass(frozen=True)
class DataFile:
    """A file as the author wrote its path, and the SHA-256 of what is in it, in hexadecimal."""

    path: str
    digest: str


def data_file(path: Path) -> Path:
    """The path of a file that a problem file reads, relative to its folder; what it holds is recorded."""
    folder = _folder.get()
    found = path if folder is None else folder / path
    recorded = _recorder.get()
    if recorded is not None and found.is_file():
        recorded.append(DataFile(path.as_posix(), digest_of(found)))
    return found


def digest_of(path: Path) -> str:
    """The SHA-256 of a file, nothing of one that cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


@contextmanager
def beside(folder: Path) -> Iterator[None]:
    """Take relative paths from a folder, inside the block."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


@contextmanager
def recorded_files() -> Iterator[list[DataFile]]:
    """Record the files that are read inside the block."""
    files: list[DataFile] = []
    token = _recorder.set(files)
    try:
        yield files
    finally:
        _recorder.reset(token)
