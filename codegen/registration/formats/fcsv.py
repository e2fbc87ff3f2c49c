"""Point lists of older 3D Slicer (.fcsv), one for each image.

A table without a header, after lines that begin with #: id, x, y, z, four numbers of an orientation, whether the point
is visible, selected and locked, its label, and more that does not matter here. `# CoordinateSystem` names LPS or RAS,
of which older versions wrote 1 and 0; without it points are RAS. Where both lists use the same labels, each once,
points are matched by label, otherwise by order. Source: what `vtkMRMLMarkupsFiducialStorageNode` of Slicer reads and
writes.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from codegen.author.points import finite_numbers
from codegen.errors import PointsError
from codegen.registration.formats.base import Format, Frames, Source, require_order, rows, text_of
from codegen.registration.formats.slicer import SIGNS, matched
from codegen.registration.pairs import LandmarkPairs, PointArray

SYSTEMS = {"0": "RAS", "1": "LPS", "RAS": "RAS", "LPS": "LPS"}
LABEL = 11
COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
REMEDY = "save a point list of 3D Slicer as .fcsv or .mrk.json"


def recognises(text: str) -> bool:
    """Whether the text begins with a comment, as Slicer writes it."""
    return text.lstrip()[:1] == "#"


def parse(sources: Sequence[Source], frames: Frames) -> LandmarkPairs:
    """Read the moving and the fixed file; PointsError names the file and the line."""
    require_order(sources)
    return matched(sources, [_points(source) for source in sources], frames)


def _points(source: Source) -> tuple[list[str], list[tuple[float, ...] | None]]:
    """Labels and positions in LPS."""
    sign = SIGNS[_system(source)]
    labels: list[str] = []
    positions: list[tuple[float, ...] | None] = []
    for line, fields in rows(source):
        if fields[0].startswith("#"):
            continue
        if len(fields) < 4:
            raise PointsError(f"{source.name}:{line}: {','.join(fields)[:60]!r} is no point of Slicer", REMEDY)
        x, y, z = finite_numbers(source.name, line, fields[1:4], "xyz")
        positions.append((sign * x, sign * y, z))
        labels.append(fields[LABEL][:200] if len(fields) > LABEL else "")
    return labels, positions


def _system(source: Source) -> str:
    """LPS or RAS."""
    for line in source.text.splitlines():
        if not line.startswith("#"):
            break
        key, equals, value = line[1:].partition("=")
        if equals and key.strip() == "CoordinateSystem":
            found = SYSTEMS.get(value.strip().upper())
            if found is None:
                finding = f"{source.name}: the coordinate system is {value.strip()[:30]!r}"
                raise PointsError(finding, "use LPS or RAS")
            return found
    return "RAS"


def compose(pairs: LandmarkPairs, frames: Frames) -> tuple[str, ...]:
    """The moving and the fixed list, in LPS."""
    return _text(pairs.moving, pairs.names), _text(pairs.fixed, pairs.names)


def _text(points: PointArray, labels: Sequence[str]) -> str:
    file = io.StringIO(newline="")
    file.write(f"# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = {COLUMNS}\n")
    writer = csv.writer(file, lineterminator="\n")
    for k, (label, place) in enumerate(zip(labels, np.asarray(points)), 1):
        x, y, z = [*map(text_of, place), *["0.0"] * (3 - len(place))]
        writer.writerow([k, x, y, z, 0, 0, 0, 1, 1, 1, 0, label, "", ""])
    return file.getvalue()


FORMAT = Format("fcsv", "3D Slicer fiducials", (".fcsv",), 2, recognises, parse, compose)
