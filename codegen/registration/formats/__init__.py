"""Reading and writing of landmark files, in the formats of this package and of other programs.

A format has functions in a file of this folder, and an entry in FORMATS. LandmarkPairs are always in pixels, with the
origin at the centre of the top-left pixel, x to the right and y down. Landmarks of volumes are in the coordinates of
their grids.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from codegen.errors import PointsError
from codegen.files import replacing
from codegen.registration.formats import slicer, tables, tps
from codegen.registration.formats.base import MOST_BYTES, Format, Frames, Source
from codegen.registration.pairs import LandmarkPairs

FORMATS: dict[str, Format] = {
    form.name: form for form in (tables.PLAIN, tables.BIGWARP, tables.ELASTIX, tps.FORMAT, slicer.FORMAT, slicer.FCSV)
}

__all__ = [
    "FORMATS", "Format", "Frames", "Source", "landmark_texts", "parse_landmarks", "read_landmarks", "write_landmarks",
]  # fmt: skip


def read_landmarks(*paths: Path, frames: Frames | None = None, name: str | None = None) -> LandmarkPairs:
    """Return the pairs of a landmark file, or of a moving and a fixed file for formats of one image (elastix, Slicer).

    `name` is a key of FORMATS; by default the suffix and the beginning of the text determine the format. `frames`
    describes the images; TPS files need the shapes of both. Raises PointsError, with file and line, for invalid files,
    and for files of more than 8 MB or 10 000 landmarks.
    """
    contents = []
    for path in map(Path, paths):
        try:
            with path.open("rb") as file:
                contents.append((str(path), file.read(MOST_BYTES + 1)))
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise PointsError(f"{path} cannot be read ({reason})", "give a landmark file") from error
    return parse_landmarks(contents, frames=frames, name=name)


def parse_landmarks(
    contents: Sequence[tuple[str, bytes]], *, frames: Frames | None = None, name: str | None = None
) -> LandmarkPairs:
    """Return the pairs of `contents`: the file name and data of one file, or of a moving and then a fixed file."""
    if not contents:
        raise PointsError("there is no landmark file", "give one, or a moving and a fixed one")
    for file, data in contents:
        if len(data) > MOST_BYTES:
            raise PointsError(f"{file} is larger than {MOST_BYTES >> 20} MB", "give a file of landmarks alone")
    if name is not None:
        form = _format(name)
    else:
        # Use the format that fits the suffix and the beginning of the text, or else the only format of the suffix.
        file, data = contents[0]
        candidates = _of_suffix(file)
        if not data.strip():
            raise PointsError(f"{file} is empty", "give at least one landmark")
        begin = data[:2000].decode("utf-8-sig", errors="replace")
        recognised = [form for form in candidates if form.recognises(begin)]
        if not recognised and len(candidates) > 1:
            titles = " nor ".join(form.title for form in candidates)
            remedy = f"name the columns {','.join(tables.columns((frames or Frames()).axes))} in the first line"
            raise PointsError(f"{file}:1: it begins neither like {titles}", remedy)
        form = (recognised or candidates)[0]
    sources = []
    for file, data in contents:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            if form.encoding is None or b"\0" in data:
                line = data[: error.start].count(b"\n") + 1
                raise PointsError(f"{file}:{line} is no text in UTF-8", "save it as text in UTF-8") from error
            text = data.decode(form.encoding)
        sources.append(Source(file, text))
    if len(sources) != form.files:
        finding, remedy = "is complete", f"give one file of {form.title}"
        if form.files == 2:
            finding, remedy = "is one of a pair of files", "give the moving and then the fixed file"
        raise PointsError(f"{sources[0].name} {finding}, and {len(sources)} were given", remedy)
    return form.parse(sources, frames or Frames())


def write_landmarks(*paths: Path, pairs: LandmarkPairs, frames: Frames | None = None, name: str | None = None) -> None:
    """Write a landmark file, or a moving and a fixed file, in the format `name` or the format of the suffix.

    Existing files are unchanged if writing fails. Raises PointsError for a wrong number of paths, and if the format
    needs the shapes of the images (TPS) or the grids of volumes (BigWarp).
    """
    form = _format(name) if name is not None else _of_suffix(str(paths[0]))[0]
    texts = form.compose(pairs, frames or Frames())
    if len(paths) != len(texts):
        raise PointsError(f"{form.title} takes {len(texts)} files, and {len(paths)} were given", "name as many")
    for path, text in zip(paths, texts):
        with replacing(Path(path)) as temporary:
            temporary.write_bytes(text.encode("utf-8"))


def landmark_texts(pairs: LandmarkPairs, name: str, frames: Frames | None = None) -> tuple[str, ...]:
    """Return the text of a file in the format `name`, or the texts of a moving and a fixed file."""
    return _format(name).compose(pairs, frames or Frames())


def _format(name: str) -> Format:
    if name not in FORMATS:
        raise PointsError(f"{name[:40]!r} is no landmark format", f"use {', '.join(FORMATS)}")
    return FORMATS[name]


def _of_suffix(file: str) -> list[Format]:
    forms = [form for form in FORMATS.values() if Path(file).suffix.lower() in form.suffixes]
    if not forms:
        known = ", ".join(sorted({suffix for form in FORMATS.values() for suffix in form.suffixes}))
        raise PointsError(f"{file}: unknown kind of landmark file", f"let its name end in one of {known}")
    return forms
