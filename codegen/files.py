"""Atomic writes of files, errors of the file system with a remedy, and HTML templates."""

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
"""Remedies for errors of the file system."""
_MARK = ".codegen-"
_TEMPORARY = re.compile(rf"\.(.*){re.escape(_MARK)}[a-z0-9_]{{8}}((?:\.nii)?(?:\.[^.]*)?)", re.DOTALL)
"""Names of temporary files: the stem and the suffix of the target, and the part that tempfile adds."""


def is_refusal(error: OSError) -> bool:
    """Return True if the file system refused the operation."""
    return error.errno in _REMEDIES


def refused(error: OSError, path: Path | str, remedy: str = "") -> FileError:
    """Return the error that names the file, the reason and the remedy."""
    name = f"{path}: {Path(error.filename).name}" if error.filename and Path(path).is_dir() else path
    remedy = remedy or _REMEDIES.get(error.errno or 0, "choose another folder")
    return FileError(f"{name} cannot be written ({error.strerror or error})", remedy)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file in the same folder, which replaces `path` when the block ends without an error.

    A reader sees the old file or the new one; after an error the old file remains. Raises FileError when the file
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
    """Return stem and suffix; .nii.gz is one suffix."""
    whole = path.suffixes[-2:] == [".nii", ".gz"]
    return (path.stem.removesuffix(".nii"), ".nii.gz") if whole else (path.stem, path.suffix)


def remove_leftovers(paths: Iterable[Path]) -> None:
    """Remove temporary files of `replacing` that killed processes left beside files.

    No process may be writing these files.
    """
    names: dict[Path, set[tuple[str, str]]] = {}
    for path in paths:
        names.setdefault(path.absolute().parent, set()).add(_parts(path))
    for folder, targets in names.items():
        with suppress(OSError):  # leftovers are hidden and harmless
            for entry in [*folder.iterdir()]:
                match = _TEMPORARY.fullmatch(entry.name)
                if match and (match[1], match[2]) in targets:
                    entry.unlink()


def write_text(path: Path, text: str) -> None:
    """Replace the text of a file; raises FileError when the file system refuses."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def rendered(template: Path, **values: Any) -> str:
    """Return the HTML of a jinja template; a name without a value is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(template.parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template.name).render(values)
