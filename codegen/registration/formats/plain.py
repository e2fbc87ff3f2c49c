"""The CSV table of this package, with the columns `moving_x,moving_y,fixed_x,fixed_y` and optionally `name`.

Coordinates are in pixels, with the origin at the centre of the top-left pixel, x to the right, y down. Landmarks of
volumes also have `moving_z` and `fixed_z`, and are in LPS and millimetres as in the files. Columns may have any order.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence

from codegen.errors import PointsError
from codegen.problem.points import finite_numbers
from codegen.registration.formats.base import Format, Frames, Source, made, rows, text_of
from codegen.registration.pairs import LandmarkPairs

COLUMNS = ("moving_x", "moving_y", "fixed_x", "fixed_y")


def columns(axes: str) -> tuple[str, ...]:
    """Return the names of the columns of coordinates for axes "xy" or "xyz"."""
    return tuple(f"{image}_{axis}" for image in ("moving", "fixed") for axis in axes)


def parse(sources: Sequence[Source], frames: Frames) -> LandmarkPairs:
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


def compose(pairs: LandmarkPairs, frames: Frames) -> tuple[str, ...]:
    """Return the text of the table; without a column of names if they are just 1, 2, ..."""
    named = pairs.names != tuple(str(k + 1) for k in range(len(pairs)))
    file = io.StringIO(newline="")
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*columns("xyz"[: pairs.dimension]), *(["name"] if named else [])])
    for before, after, name in zip(pairs.moving, pairs.fixed, pairs.names):
        writer.writerow([*map(text_of, (*before, *after)), *([name] if named else [])])
    return (file.getvalue(),)


RECOGNISES = re.compile(r"\s*[^\n]*(moving_|fixed_)", re.IGNORECASE).match
FORMAT = Format("csv", "plain CSV", (".csv", ".txt"), 1, RECOGNISES, parse, compose)
