"""Point files of elastix, one for each image: `point` or `index`, the number of points, then one point per line.

After `index`, points are indices of pixels. After `point`, they are in the coordinates of the image file: LPS in
millimetres for volumes. For PNG, JPEG and plain TIFF files, elastix has spacing 1 and origin 0, that is pixels.
Without a keyword points are indices, as before elastix 3.5. Sources: elastix manual, section 4.2 (option -def), and
`TransformixInputPointFileReader` of elastix.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from codegen.errors import PointsError
from codegen.problem.points import finite_numbers
from codegen.registration.formats import base
from codegen.registration.pairs import LandmarkPairs

REMEDY = "give point or index, the number of points, then two coordinates in each line, or three for volumes"


def parse(sources: Sequence[base.Source], frames: base.Frames) -> LandmarkPairs:
    """Return the landmarks of the moving and the fixed file; PointsError names the file and the line."""
    base.require_order(sources)
    moving, fixed = (_points(source, side, frames) for side, source in enumerate(sources))
    return base.made(sources, moving, fixed)


def _points(source: base.Source, side: int, frames: base.Frames) -> list[tuple[float, ...]]:
    are_indices = True
    lines = [(number, line.split()) for number, line in enumerate(source.text.split("\n"), 1) if line.strip()]
    if lines and lines[0][1][0].lower() in ("point", "index"):
        number, words = lines.pop(0)
        are_indices = words[0].lower() == "index"
        if len(words) > 1:
            lines.insert(0, (number, words[1:]))
    if not lines or len(lines[0][1]) != 1 or not lines[0][1][0].isdecimal() or len(lines[0][1][0]) > 9:
        line = lines[0][0] if lines else 1
        raise PointsError(f"{source.name}:{line}: there is no number of points", REMEDY)
    count = int(lines.pop(0)[1][0])
    base.require_count(source.name, count)
    if len(lines) != count:
        raise PointsError(f"{source.name} says {count} points and holds {len(lines)}", "correct the number of points")
    dimension = len(lines[0][1]) if lines else 2
    if dimension not in (2, 3):
        raise PointsError(f"{source.name}:{lines[0][0]}: a point has {dimension} coordinates", REMEDY)
    points = [finite_numbers(source.name, line, words, "xyz"[:dimension]) for line, words in lines]
    positions = base.placed(source.name, ("moving", "fixed")[side], points, frames)
    if are_indices and positions and frames.grids is not None:
        return list(map(tuple, frames.grids[side].to_places(np.array(positions)).tolist()))
    return positions


def compose(pairs: LandmarkPairs, frames: base.Frames) -> tuple[str, ...]:
    """Return the texts of the moving and the fixed file, without names of landmarks."""
    texts = []
    for points in (pairs.moving, pairs.fixed):
        lines = [" ".join(map(base.text_of, point)) for point in points]
        texts.append("\n".join(["point", str(len(lines)), *lines, ""]))
    return tuple(texts)


RECOGNISES = re.compile(r"\s*(point|index|\d+)(\s|$)", re.IGNORECASE).match
FORMAT = base.Format("elastix", "elastix points", (".pts", ".txt"), 2, RECOGNISES, parse, compose)
