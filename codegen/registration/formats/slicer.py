"""Point lists of 3D Slicer, one for each image: .mrk.json, and .fcsv of older versions.

If both lists have the same unique labels, points are matched by label, otherwise by order. LPS means that x, y and z
point to the left, the back and the head of the patient; RAS has the opposite signs of x and y.

.mrk.json: for an image file without spacing, Slicer places pixels 1 mm apart, at x = column and y = row in LPS. So LPS
positions are pixels. Positions in volumes follow from their spacing, origin and orientation. Points that are not set
(`positionStatus` other than `defined`) are left out. Source: markups-schema-v1.0.3.json of Slicer and its developer
guide, "Markups".

.fcsv: a table without a header, after lines that begin with #. Its columns are id, x, y, z, four numbers of an
orientation, the flags visible, selected and locked, the label, and others that are ignored. `# CoordinateSystem` is LPS
or RAS, in older versions 1 or 0; the default is RAS. Source: `vtkMRMLMarkupsFiducialStorageNode` of Slicer.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeAlias

from codegen.errors import PointsError
from codegen.problem.points import finite_numbers
from codegen.registration.formats import base
from codegen.registration.pairs import LandmarkPairs

SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
SIGNS = {"LPS": 1.0, "RAS": -1.0}
REMEDY = "save a point list of 3D Slicer as .mrk.json"
SYSTEMS = {"0": "RAS", "1": "LPS", "RAS": "RAS", "LPS": "LPS"}
LABEL = 11
COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
FCSV_REMEDY = "save a point list of 3D Slicer as .fcsv or .mrk.json"

Points: TypeAlias = tuple[list[str], list[tuple[float, ...] | None]]
"""The labels of points, and their positions in LPS, None for points that are not set."""


def parse(read: Callable[[base.Source], Points], sources: Sequence[base.Source], frames: base.Frames) -> LandmarkPairs:
    """Return the landmarks of the moving and the fixed file, each read by `read`, matched by label or by order.

    PointsError names the file and the point.
    """
    base.require_order(sources)
    (labels, moving), (others, fixed) = (read(source) for source in sources)
    if len(moving) != len(fixed):
        finding = f"{sources[0].name} holds {len(moving)} points and {sources[1].name} {len(fixed)}"
        raise PointsError(finding, "give every point in both images")
    if set(labels) == set(others) and len(set(labels)) == len(labels):
        fixed = [fixed[others.index(label)] for label in labels] if labels != others else fixed
    names, before, after = [], [], []
    for k, (label, one, other) in enumerate(zip(labels, moving, fixed, strict=True), 1):
        if one is not None and other is not None:
            names.append(label or str(k))
            before.append(one)
            after.append(other)
    sides = base.placed(sources[0].name, "moving", before, frames), base.placed(sources[1].name, "fixed", after, frames)
    return base.made(sources, *sides, names)


def read_json(source: base.Source) -> Points:
    """Return the points of a .mrk.json file, which must hold exactly one list."""
    try:
        content = json.loads(source.text)
    except json.JSONDecodeError as error:
        raise PointsError(f"{source.name}:{error.lineno}: no JSON ({error.msg})", REMEDY) from error
    except (ValueError, RecursionError) as error:
        raise PointsError(f"{source.name} cannot be read as JSON ({type(error).__name__})", REMEDY) from error
    markups = content.get("markups") if isinstance(content, dict) else None
    lists = [item for item in markups if isinstance(item, dict)] if isinstance(markups, list) else []
    lists = [item for item in lists if isinstance(item.get("controlPoints"), list)]
    if len(lists) != 1:
        raise PointsError(f"{source.name} holds {len(lists) or 'no'} point lists", f"{REMEDY}, one in a file")
    (markup,) = lists
    system = markup.get("coordinateSystem", "LPS")
    if not isinstance(system, str) or system not in SIGNS:
        raise PointsError(f"{source.name}: the coordinate system is {str(system)[:30]!r}", "use LPS or RAS")
    units = markup.get("coordinateUnits", "mm")
    if (units[0] if isinstance(units, list) and units else units) != "mm":
        raise PointsError(f"{source.name}: coordinates are in {str(units)[:30]}", "save them in mm, one for each pixel")
    controls = markup["controlPoints"]
    base.require_count(source.name, len(controls))
    labels: list[str] = []
    positions: list[tuple[float, ...] | None] = []
    for number, control in enumerate(controls, 1):
        if not isinstance(control, dict):
            raise PointsError(f"{source.name}: control point {number} is no object", REMEDY)
        labels.append(str(control.get("label", ""))[:200])
        position = control.get("position") if control.get("positionStatus", "defined") == "defined" else None
        if position is None:
            positions.append(None)
            continue
        good = isinstance(position, list) and len(position) == 3
        good = good and all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e300 for x in position)
        if not good or not all(map(math.isfinite, position)):
            finding = f"{source.name}: control point {number} is at {str(position)[:60]}"
            raise PointsError(finding, "give three finite numbers as its position")
        x, y, z = map(float, position)
        positions.append((SIGNS[system] * x, SIGNS[system] * y, z))
    return labels, positions


def compose_json(pairs: LandmarkPairs, frames: base.Frames) -> tuple[str, ...]:
    """Return the texts of a moving and a fixed .mrk.json file, in LPS."""
    texts = []
    for name, points in (("moving", pairs.moving), ("fixed", pairs.fixed)):
        controls = [
            {
                "id": str(k), "label": label, "position": [*map(float, place), *[0.0] * (3 - len(place))],
                "positionStatus": "defined",
            }
            for k, (label, place) in enumerate(zip(pairs.names, points), 1)
        ]  # fmt: skip
        markup = {
            "type": "Fiducial", "name": name, "coordinateSystem": "LPS", "coordinateUnits": "mm",
            "controlPoints": controls,
        }  # fmt: skip
        texts.append(json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=1) + "\n")
    return tuple(texts)


def read_fcsv(source: base.Source) -> Points:
    """Return the points of a .fcsv file."""
    system = "RAS"
    for line in itertools.takewhile(lambda line: line.startswith("#"), source.text.splitlines()):
        key, equals, value = line[1:].partition("=")
        if equals and key.strip() == "CoordinateSystem":
            if value.strip().upper() not in SYSTEMS:
                finding = f"{source.name}: the coordinate system is {value.strip()[:30]!r}"
                raise PointsError(finding, "use LPS or RAS")
            system = SYSTEMS[value.strip().upper()]
            break
    sign = SIGNS[system]
    labels: list[str] = []
    positions: list[tuple[float, ...] | None] = []
    for number, fields in base.rows(source):
        if fields[0].startswith("#"):
            continue
        if len(fields) < 4:
            raise PointsError(f"{source.name}:{number}: {','.join(fields)[:60]!r} is no point of Slicer", FCSV_REMEDY)
        x, y, z = finite_numbers(source.name, number, fields[1:4], "xyz")
        positions.append((sign * x, sign * y, z))
        labels.append(fields[LABEL][:200] if len(fields) > LABEL else "")
    return labels, positions


def compose_fcsv(pairs: LandmarkPairs, frames: base.Frames) -> tuple[str, ...]:
    """Return the texts of a moving and a fixed .fcsv file, in LPS."""
    texts = []
    for points in (pairs.moving, pairs.fixed):
        file = io.StringIO(newline="")
        file.write(f"# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = {COLUMNS}\n")
        writer = csv.writer(file, lineterminator="\n")
        for k, (label, place) in enumerate(zip(pairs.names, points), 1):
            x, y, z = [*map(base.text_of, place), *["0.0"] * (3 - len(place))]
            writer.writerow([k, x, y, z, 0, 0, 0, 1, 1, 1, 0, label, "", ""])
        texts.append(file.getvalue())
    return tuple(texts)


JSON, COMMENT = re.compile(r"\s*\{").match, re.compile(r"\s*#").match
LISTS = (".mrk.json", ".json")
FORMAT = base.Format("slicer", "3D Slicer point lists", LISTS, 2, JSON, partial(parse, read_json), compose_json)
FCSV = base.Format("fcsv", "3D Slicer fiducials", (".fcsv",), 2, COMMENT, partial(parse, read_fcsv), compose_fcsv)
