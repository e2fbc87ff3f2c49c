"""Writing files as a whole or not at all, and saying what is to be done where the file system refuses."""

from __future__ import annotations

import errno
import os
import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from codegen.errors import FileError

_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "make room on that disk, or choose another folder"),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "choose a folder that may be written to"),
    errno.EFBIG: "raise the limit on the size of files, or choose another folder",
    errno.EIO: "look after that disk, or choose another folder",
}
"""What to do about errors that are the file system's own."""
_MARK = ".codegen-"
_TEMPORARY = re.compile(rf"\.(.*){re.escape(_MARK)}[a-z0-9_]{{8}}((?:\.nii)?(?:\.[^.]*)?)", re.DOTALL)
"""Names of temporary files: stem and suffix of the file that they are to become, and what tempfile puts between."""


def is_refusal(error: OSError) -> bool:
    """Whether the file system refused, which no program can help."""
    return error.errno in _REMEDIES


def refused(error: OSError, path: Path | str, remedy: str = "") -> FileError:
    """The error that names the file, the reason and the remedy."""
    place = f"{path}: {Path(error.filename).name}" if error.filename and Path(path).is_dir() else path
    found = remedy or _REMEDIES.get(error.errno or 0, "choose another folder")
    return FileError(f"{place} cannot be written ({error.strerror or error})", found)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file in the same folder that takes the name of `path` when the block ends without error.

    A reader sees the old file or the new one, and what is killed or fails leaves the old one. FileError when the file
    system refuses.
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
    """Stem and suffix; that of compressed NIfTI is .nii.gz, by which libraries know it."""
    whole = path.suffixes[-2:] == [".nii", ".gz"]
    return (path.stem.removesuffix(".nii"), ".nii.gz") if whole else (path.stem, path.suffix)


def remove_leftovers(paths: Iterable[Path]) -> None:
    """Remove what processes that were killed left beside files: temporary files of `replacing`.

    Nobody may be writing the files at this time.
    """
    names: dict[Path, set[tuple[str, str]]] = {}
    for path in paths:
        names.setdefault(path.absolute().parent, set()).add(_parts(path))
    for folder, known in names.items():
        with suppress(OSError):  # they are hidden and do no harm
            for entry in [*folder.iterdir()]:
                found = _TEMPORARY.fullmatch(entry.name)
                if found and (found[1], found[2]) in known:
                    entry.unlink()


def write_text(path: Path, text: str) -> None:
    """Replace a file as a whole; FileError when the file system refuses."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def rendered(template: Path, **values: Any) -> str:
    """The HTML of a jinja template; a name in it that has no value is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(template.parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template.name).render(values)
