"""MetaImage in two files: a header, `.mhd`, and beside it the samples that it names.

What is written names `stem.raw`, which holds bare numbers, not compressed, so that any program can read them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from codegen.files import replacing

SUFFIX = ".mhd"
_SAMPLES = ".raw"
_KEY = "ElementDataFile"
_NAMING = {SUFFIX: ("=", (_KEY,)), ".nhdr": (":", ("data file", "datafile"))}
"""Kinds of headers: what is between a key and its value, and the keys that name samples."""
_MOST = 1 << 16
"""Bytes of a header that are looked through."""


def written_with(path: Path) -> Path | None:
    """The file of samples that is written beside a header; None where a volume is one file."""
    return path.with_suffix(_SAMPLES) if path.suffix.lower() == SUFFIX else None


def read_with(path: Path) -> Path | None:
    """The file of samples that a header names, of NRRD as well; None where there is none, or it cannot be read."""
    separator, keys = _NAMING.get(path.suffix.lower(), ("", ()))
    if not keys:
        return None
    try:
        with path.open("rb") as file:
            lines = file.read(_MOST).decode("latin-1").splitlines()
    except OSError:
        return None  # whoever reads the volume says so
    parts = (line.partition(separator) for line in lines)
    named = [value.strip() for key, _, value in parts if key.strip() in keys]
    return path.parent / named[-1] if named and named[-1] not in ("", "LOCAL", "LIST") else None


@contextmanager
def replacing_volume(path: Path) -> Iterator[Path]:
    """As `codegen.files.replacing`, for whatever kind of volume SimpleITK writes; the header is replaced last."""
    samples = written_with(path)
    if samples is None:
        with replacing(path) as temporary:
            yield temporary
        return
    with replacing(path) as header, replacing(samples) as temporary:
        made = header.with_suffix(_SAMPLES)
        try:
            yield header
            made.replace(temporary)
            text = header.read_text(encoding="latin-1")
            header.write_text(text.replace(f"{_KEY} = {made.name}", f"{_KEY} = {samples.name}"), encoding="latin-1")
        finally:
            made.unlink(missing_ok=True)
