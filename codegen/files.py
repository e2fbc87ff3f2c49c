"""Atomic writing of files, errors of the file system with a remedy, locks, journals and HTML templates.

A journal file lists the finished chunks of some work as lines of JSON: a header with the digest of the work, then one
line for each chunk. A line is written after the results of its chunk, so an interrupt loses only chunks in progress.
An incomplete last line is ignored.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from codegen.errors import ArgumentError, CodegenError, FileError

_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "make room on that disk, or choose another folder"),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "choose a folder that may be written to"),
    errno.EFBIG: "raise the limit on the size of files, or choose another folder",
    errno.EIO: "look after that disk, or choose another folder",
}
"""Remedies for errors of the file system, by their numbers."""
_MARK = ".codegen-"
"""A part of the names of all temporary files."""
_TEMPORARY = re.compile(rf"\.(.*){re.escape(_MARK)}[a-z0-9_]{{8}}((?:\.nii)?(?:\.[^.]*)?)", re.DOTALL)
"""Pattern of the names of temporary files; its groups are the stem and the suffix of the target file."""


def is_refusal(error: OSError) -> bool:
    """Return True if an error is a refusal of the file system, such as a full disk, and no other failure."""
    return error.errno in _REMEDIES


def refused(error: OSError, path: Path | str, remedy: str = "") -> FileError:
    """Return the error for a file that cannot be written, with its path, the reason and the remedy.

    By default the remedy depends on the reason.
    """
    name = f"{path}: {Path(error.filename).name}" if error.filename and Path(path).is_dir() else path
    remedy = remedy or _REMEDIES.get(error.errno or 0, "choose another folder")
    return FileError(f"{name} cannot be written ({error.strerror or error})", remedy)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a temporary file in the same folder, which replaces `path` at the end of the with block.

    Other processes see the old file or the complete new file. After an error in the block the old file remains. Raise
    FileError if the file cannot be written.
    """
    try:
        stem, suffix = _parts(path)
        handle, name = tempfile.mkstemp(dir=path.absolute().parent, prefix=f".{stem}{_MARK}", suffix=suffix)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            temporary.chmod(0o644)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise refused(error, path) from error


def _parts(path: Path) -> tuple[str, str]:
    """Return the stem and the suffix of a file name; `.nii.gz` is one suffix."""
    whole = path.suffixes[-2:] == [".nii", ".gz"]
    return (path.stem.removesuffix(".nii"), ".nii.gz") if whole else (path.stem, path.suffix)


def remove_leftovers(paths: Iterable[Path]) -> None:
    """Remove temporary files of `replacing` for these `paths`, which killed processes have left.

    No other process may write these files at the same time.
    """
    names: dict[Path, set[tuple[str, str]]] = {}
    for path in paths:
        names.setdefault(path.absolute().parent, set()).add(_parts(path))
    for folder, targets in names.items():
        with suppress(OSError):  # remaining temporary files are hidden and harmless
            for entry in [*folder.iterdir()]:
                match = _TEMPORARY.fullmatch(entry.name)
                if match and (match[1], match[2]) in targets:
                    entry.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text to a file, which is replaced atomically; raise FileError if the file cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def rendered(template: Path, **values: object) -> str:
    """Return the HTML of the jinja template in a file; raise an error if the template uses a name without a value."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(template.parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template.name).render(values)


@contextmanager
def alone(folder: Path, name: str) -> Iterator[None]:
    """Run a block when no other process has the lock `name` of a folder, if the system has file locks."""
    try:
        with _lock_file(folder, name) as file:
            with suppress(ImportError, OSError):  # without locks all processes compile, with the same result
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        remedy = f"let CODEGEN_CACHE_DIR name a folder that may be written to on {platform.node()}"
        raise refused(error, folder, remedy) from error


@contextmanager
def only_one(folder: Path, name: str, taken: CodegenError) -> Iterator[None]:
    """Run a block with the lock `name` of a folder; raise `taken` if another process has the lock.

    The lock ends with its process.
    """
    try:
        file = _lock_file(folder, name)
    except OSError:  # without a cache folder there is no lock
        yield
        return
    with file:
        with suppress(ImportError):
            import fcntl

            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # forks do not inherit this kind of lock
            except OSError as error:
                if error.errno in (errno.EACCES, errno.EAGAIN):  # disks without locks raise other numbers
                    raise taken from None
        yield


def _lock_file(folder: Path, name: str) -> TextIO:
    folder.mkdir(parents=True, exist_ok=True)
    return (folder / f"{hashlib.sha256(name.encode()).hexdigest()[:20]}.lock").open("a")


def journal_of(path: Path) -> Path:
    """Return the path of the journal of a store or table."""
    return path.with_name(f"{path.name}.journal")


@dataclass(frozen=True)
class Journal:
    """A journal file, its header, and the records that the file had when it was opened."""

    path: Path
    header: Mapping[str, Any]
    records: tuple[dict[str, Any], ...] = ()

    def add(self, records: Iterable[Mapping[str, object]]) -> None:
        """Append records to the file; raises FileError when the file system refuses."""
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write("".join(json.dumps(record) + "\n" for record in records))
        except OSError as error:
            raise refused(error, self.path) from error


def new_journal(path: Path, header: Mapping[str, object]) -> Journal:
    """Write and return a journal without records."""
    write_text(path, json.dumps(header) + "\n")
    return Journal(path, header)


def read_journal(path: Path, kind: str, digest: str, another: str) -> Journal:
    """Return the journal in a file whose header maps `kind` to `digest`, and truncate an incomplete last line.

    Raises ArgumentError for a damaged journal, and with the remedy `another` for the journal of other work.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError):
        raise ArgumentError(f"--resume: {path} cannot be read", another) from None
    try:
        complete = [json.loads(line) for line in lines if line.endswith("\n")]  # only the last line can be cut off
    except ValueError:
        raise damaged_journal(path) from None
    if not complete or not all(isinstance(record, dict) for record in complete):
        raise damaged_journal(path)
    header, *records = complete
    if header.get(kind) != digest:
        raise ArgumentError(f"--resume: {path} tells of another {kind}", another)
    data = path.read_bytes()
    complete_bytes = data.rfind(b"\n") + 1
    if complete_bytes < len(data):
        os.truncate(path, complete_bytes)
    return Journal(path, header, tuple(records))


def damaged_journal(path: Path) -> ArgumentError:
    """Return the error for a journal with invalid lines."""
    return ArgumentError(f"--resume: {path} is damaged", "begin anew under another name")
