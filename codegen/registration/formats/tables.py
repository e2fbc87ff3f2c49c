"""Landmarks as tables of text: the CSV tables of this package and of BigWarp, and the point files of elastix.

The table of this package has the columns `moving_x,moving_y,fixed_x,fixed_y` and optionally `name`, in any order.
Coordinates are in pixels, with the origin at the centre of the top-left pixel, x to the right, y down. Landmarks of
volumes also have `moving_z` and `fixed_z`, and are in LPS and millimetres as in the files.

BigWarp writes no header. A row has a name, an active flag, the moving and the fixed point: 6 fields for pictures and 8
for volumes, all in quotation marks. A point that was not set is Infinity, and its row is not active. Coordinates are in
the units of the images, or in pixels if the images have no units. The origin is the centre of the top-left pixel, and y
points down, as in this package. Coordinates of volumes are column, row and slice times the spacing: BigWarp ignores the
origin and orientation of a file, and this module applies them. Source: `LandmarkTableModel` of BigWarp 9.4
(github.com/saalfeldlab/bigwarp).

elastix has one point file for each image: `point` or `index`, the number of points, then one point per line. After
`index`, points are indices of pixels. After `point`, they are in the coordinates of the image file: LPS in millimetres
for volumes. For PNG, JPEG and plain TIFF files, elastix has spacing 1 and origin 0, that is pixels. Without a keyword
points are indices, as before elastix 3.5. Sources: elastix manual, section 4.2 (option -def), and
`TransformixInputPointFileReader` of elastix.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

import numpy as np

from codegen.errors import PointsError
from codegen.problem.points import finite_numbers
from codegen.registration.formats.base import (
    Format,
    Frames,
    Source,
    is_missing,
    made,
    placed,
    require_count,
    require_order,
    rows,
    text_of,
)
from codegen.registration.pairs import LandmarkPairs


def columns(axes: str) -> tuple[str, ...]:
    """Return the names of the columns of coordinates for axes "xy" or "xyz"."""
    return tuple(f"{image}_{axis}" for image in ("moving", "fixed") for axis in axes)


def parse_plain(sources: Sequence[Source], frames: Frames) -> LandmarkPairs:
    """Return the landmarks of the table; PointsError names the file and the line."""
    (source,) = sources
    table = rows(source)
    header = next((fields for _, fields in table), [])
    wanted, dimension = columns(frames.axes), len(frames.axes)
    if sorted(set(header) - {"name"}) != sorted(wanted) or len(set(header)) < len(header):
        finding = f"{source.name}: the columns are {','.join(header)[:100] or 'missing'}"
        raise PointsError(finding, f"name the columns {','.join(wanted)} in the first line")
    positions = [header.index(name) for name in wanted]
    points, names = [], []
    for line, fields in table:
        if len(fields) != len(header):
            finding = f"{source.name}:{line}: {len(fields)} values for {len(header)} columns"
            raise PointsError(finding, f"give {','.join(header)} in every row")
        points.append(finite_numbers(source.name, line, [fields[k] for k in positions], wanted))
        names += [fields[header.index("name")]] if "name" in header else []
    return made(sources, [row[:dimension] for row in points], [row[dimension:] for row in points], names)


def compose_plain(pairs: LandmarkPairs, frames: Frames) -> tuple[str, ...]:
    """Return the text of the table; without a column of names if they are just 1, 2, ..."""
    named = pairs.names != tuple(str(k + 1) for k in range(len(pairs)))
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*columns("xyz"[: pairs.dimension]), *(["name"] if named else [])])
    for before, after, name in zip(pairs.moving, pairs.fixed, pairs.names):
        writer.writerow([*map(text_of, (*before, *after)), *([name] if named else [])])
    return (file.getvalue(),)


RECOGNISES = re.compile(r"\s*[^\n]*(moving_|fixed_)", re.IGNORECASE).match
PLAIN = Format("csv", "plain CSV", (".csv", ".txt"), 1, RECOGNISES, parse_plain, compose_plain)

AXES = {6: "xy", 8: "xyz"}


def recognises_bigwarp(text: str) -> bool:
    """Return True if the second field of the first line is the word true or false."""
    try:
        fields = next(csv.reader([text.lstrip().split("\n", 1)[0][:1000]]), [])
    except csv.Error:
        return False
    return len(fields) > 1 and fields[1].strip().lower() in ("true", "false")


def parse_bigwarp(sources: Sequence[Source], frames: Frames) -> LandmarkPairs:
    """Return the landmarks of the active rows; PointsError names the file and the line."""
    (source,) = sources
    moving, fixed, names, inactive = [], [], [], 0
    for line, fields in rows(source):
        if len(fields) not in AXES or fields[1].lower() not in ("true", "false"):
            finding = f"{source.name}:{line}: {','.join(fields)[:60]!r} is no row of BigWarp"
            raise PointsError(finding, "give a name, true or false, the moving point and the fixed point in every row")
        if fields[1].lower() == "false" or all(map(is_missing, fields[2:])):
            inactive += 1
            continue
        axes = AXES[len(fields)]
        numbers = finite_numbers(source.name, line, fields[2:], columns(axes))
        moving.append(numbers[: len(axes)])
        fixed.append(numbers[len(axes) :])
        names.append(fields[0])
    if not moving and inactive:
        raise PointsError(f"{source.name}: none of its {inactive} landmarks is active", "set both points of some")
    before, after = placed(source.name, "moving", moving, frames), placed(source.name, "fixed", fixed, frames)
    if frames.grids is not None and names:
        moving_places, fixed_places = (
            np.array(points) @ np.array(grid.direction).T + grid.origin
            for points, grid in zip((before, after), frames.grids, strict=True)
        )
        return made(sources, moving_places, fixed_places, names)
    return made(sources, before, after, names)


def compose_bigwarp(pairs: LandmarkPairs, frames: Frames) -> tuple[str, ...]:
    """Return the text of a table with active rows only; PointsError for volumes without grids in `frames`."""
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n", quoting=csv.QUOTE_ALL)
    moving, fixed = pairs.moving, pairs.fixed
    if pairs.dimension == 3:
        if frames.grids is None:
            raise PointsError("BigWarp leaves origin and orientation aside, and they are not known", "give both grids")
        moving, fixed = (
            (points - grid.origin) @ np.array(grid.direction)
            for points, grid in zip((moving, fixed), frames.grids, strict=True)
        )
    for before, after, name in zip(moving, fixed, pairs.names):
        writer.writerow([name, "true", *map(text_of, (*before, *after))])
    return (file.getvalue(),)


BIGWARP = Format("bigwarp", "BigWarp CSV", (".csv",), 1, recognises_bigwarp, parse_bigwarp, compose_bigwarp)

_ELASTIX_REMEDY = "give point or index, the number of points, then two coordinates in each line, or three for volumes"


def parse_elastix(sources: Sequence[Source], frames: Frames) -> LandmarkPairs:
    """Return the landmarks of the moving and the fixed file; PointsError names the file and the line."""
    require_order(sources)
    moving, fixed = (_elastix_points(source, side, frames) for side, source in enumerate(sources))
    return made(sources, moving, fixed)


def _elastix_points(source: Source, side: int, frames: Frames) -> list[tuple[float, ...]]:
    are_indices = True
    lines = [(number, line.split()) for number, line in enumerate(source.text.split("\n"), 1) if line.strip()]
    if lines and lines[0][1][0].lower() in ("point", "index"):
        number, words = lines.pop(0)
        are_indices = words[0].lower() == "index"
        if len(words) > 1:
            lines.insert(0, (number, words[1:]))
    if not lines or len(lines[0][1]) != 1 or not lines[0][1][0].isdecimal() or len(lines[0][1][0]) > 9:
        line = lines[0][0] if lines else 1
        raise PointsError(f"{source.name}:{line}: there is no number of points", _ELASTIX_REMEDY)
    count = int(lines.pop(0)[1][0])
    require_count(source.name, count)
    if len(lines) != count:
        raise PointsError(f"{source.name} says {count} points and holds {len(lines)}", "correct the number of points")
    dimension = len(lines[0][1]) if lines else 2
    if dimension not in (2, 3):
        raise PointsError(f"{source.name}:{lines[0][0]}: a point has {dimension} coordinates", _ELASTIX_REMEDY)
    points = [finite_numbers(source.name, line, words, "xyz"[:dimension]) for line, words in lines]
    positions = placed(source.name, ("moving", "fixed")[side], points, frames)
    if are_indices and positions and frames.grids is not None:
        return list(map(tuple, frames.grids[side].to_places(np.array(positions)).tolist()))
    return positions


def compose_elastix(pairs: LandmarkPairs, frames: Frames) -> tuple[str, ...]:
    """Return the texts of the moving and the fixed file, without names of landmarks."""
    texts = []
    for points in (pairs.moving, pairs.fixed):
        lines = [" ".join(map(text_of, point)) for point in points]
        texts.append("\n".join(["point", str(len(lines)), *lines, ""]))
    return tuple(texts)


_RECOGNISES_ELASTIX = re.compile(r"\s*(point|index|\d+)(\s|$)", re.IGNORECASE).match
ELASTIX = Format("elastix", "elastix points", (".pts", ".txt"), 2, _RECOGNISES_ELASTIX, parse_elastix, compose_elastix)
