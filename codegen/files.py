"""Atomic writing of files, errors of the file system with a remedy, and HTML templates."""

from __future__ import annotations

import errno
import os
import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from codegen.errors import FileError

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
