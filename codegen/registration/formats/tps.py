"""TPS files of tpsDig, which hold a list of points, called a specimen, for each image.

A specimen is `LM=n`, n lines `x y`, and lines such as `IMAGE=`, `ID=` and `SCALE=`. The specimens of the moving and the
fixed image are found by their IMAGE= lines; otherwise they are the only two of the file. As y points up, the heights of
both images must be known. The origin is the centre of the lower-left pixel; the documentation of the format is
ambiguous by half a pixel. Coordinates are pixels; `SCALE=`, the size of a pixel, is not applied. A landmark NA in one
image is left out in both. Outlines (`CURVES=`, `POINTS=`) are left out. The format has no names of landmarks.
Source: F. J. Rohlf, tpsDig help, "Data files".
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import PureWindowsPath

import numpy as np

from codegen.errors import PointsError
from codegen.problem.points import finite_numbers
from codegen.registration.formats.base import Format, Frames, Source, made, require_count, text_of
from codegen.registration.pairs import LandmarkPairs, PointArray

REMEDY = "give LM=, as many lines x y, and IMAGE= for the moving and for the fixed image"


@dataclass
class Specimen:
    """The points of one image, as in the file, None for missing points, and the values of IMAGE= and ID=."""

    points: list[tuple[float, float] | None] = field(default_factory=list)
    image: str = ""
    identity: str = ""


def parse(sources: Sequence[Source], frames: Frames) -> LandmarkPairs:
    """Return the landmarks of two specimens; PointsError names the file and line, or the image of unknown height."""
    (source,) = sources
    if frames.grids is not None:
        finding = f"{source.name}: TPS files hold landmarks in the plane, and the images are volumes"
        raise PointsError(finding, "give landmarks in space, as plain CSV")
    specimens = list(specimens_of(source))
    # IMAGE= lines, ignoring folders and case, identify the specimens; otherwise there must be exactly two.
    named: list[Specimen | None] = []
    for name in (frames.moving_name, frames.fixed_name):
        image = PureWindowsPath(name).name.lower()
        same = [entry for entry in specimens if image and PureWindowsPath(entry.image).name.lower() == image]
        if len(same) > 1:
            finding = f"{source.name} has {len(same)} specimens with IMAGE={name}"
            raise PointsError(finding, "leave one of them in the file")
        named.append(same[0] if same else None)
    moving, fixed = named
    if moving is None or fixed is None or moving is fixed:
        if len(specimens) != 2:
            images = " and ".join(repr(name) for name in (frames.moving_name, frames.fixed_name) if name)
            raise PointsError(
                f"{source.name} holds {len(specimens)} specimens, and their IMAGE= lines do not name "
                f"{images or 'the images'}",
                "give two specimens, first the moving one, or name both images in IMAGE= lines",
            )
        is_reversed = moving is specimens[1] or fixed is specimens[0]
        moving, fixed = specimens[::-1] if is_reversed else specimens
    if len(moving.points) != len(fixed.points):
        finding = f"{source.name}: {len(moving.points)} moving landmarks, but {len(fixed.points)} fixed ones"
        raise PointsError(finding, "give every landmark in both images, NA where it is missing")
    both = [(before, after) for before, after in zip(moving.points, fixed.points) if before and after]
    heights = _heights(source.name, frames)
    before, after = (_turned(np.array([pair[side] for pair in both]), heights[side]) for side in (0, 1))
    names = [str(k) for k, pair in enumerate(zip(moving.points, fixed.points), 1) if all(pair)]
    return made(sources, before, after, names)


def specimens_of(source: Source) -> Iterator[Specimen]:
    """Yield the specimens of a file; PointsError for a line that belongs to no specimen."""
    text = source.text.replace("\r\n", "\n").replace("\r", "\n")
    lines = ((k, line.strip()) for k, line in enumerate(text.split("\n"), 1))
    specimen: Specimen | None = None
    for number, line in lines:
        if not line:
            continue
        key, equals, value = (part.strip() for part in line.partition("="))
        key = key.upper()
        if not equals:
            raise PointsError(f"{source.name}:{number}: {line[:40]!r} stands outside a list of points", REMEDY)
        if key == "LM3":
            raise PointsError(f"{source.name}:{number}: landmarks in space", "give landmarks in the plane, LM=")
        if key == "LM":
            if specimen is not None:
                yield specimen
            specimen = Specimen(list(_points(source, number, value, lines)))
        elif key == "POINTS":
            for _ in _points(source, number, value, lines):
                pass
        elif specimen is not None and key == "IMAGE":
            specimen.image = value
        elif specimen is not None and key == "ID":
            specimen.identity = value
    if specimen is not None:
        yield specimen


def _points(
    source: Source, number: int, count: str, lines: Iterator[tuple[int, str]]
) -> Iterator[tuple[float, float] | None]:
    """Yield `count` points from the following `lines`, None for missing points; `number` is the line of `count`."""
    if not (count.isdecimal() and len(count) < 10):
        raise PointsError(f"{source.name}:{number}: {count[:30]!r} is no number of points", REMEDY)
    require_count(source.name, int(count))
    for _ in range(int(count)):
        line, text = next(((k, text) for k, text in lines if text), (0, ""))
        if not text:
            raise PointsError(
                f"{source.name}: {count} points are announced in line {number}, and it ends before", REMEDY
            )
        words = text.split()
        if len(words) == 2 and "NA" in (word.upper() for word in words):
            yield None
        else:
            x, y = finite_numbers(source.name, line, words, "xy")
            yield x, y


def _heights(name: str, frames: Frames) -> tuple[int, int]:
    if frames.moving_shape is None or frames.fixed_shape is None:
        which = "moving" if frames.moving_shape is None else "fixed"
        finding = f"{name}: y points up in TPS files, and the height of the {which} image is not known"
        raise PointsError(finding, f"give the {which} image, or its shape")
    return frames.moving_shape[0], frames.fixed_shape[0]


def _turned(points: PointArray, height: int) -> PointArray:
    """Return points with y measured from the opposite edge: from the lower-left to the top-left pixel, or back."""
    return np.column_stack((points[:, 0], height - 1 - points[:, 1])) if len(points) else points


def compose(pairs: LandmarkPairs, frames: Frames) -> tuple[str, ...]:
    """Return the text of a file with two specimens, first the moving; PointsError if an image height is unknown."""
    heights = _heights("landmarks", frames)
    lines = []
    sides = zip((pairs.moving, pairs.fixed), heights, (frames.moving_name, frames.fixed_name))
    for k, (points, height, image) in enumerate(sides):
        lines.append(f"LM={len(points)}")
        lines += [" ".join(map(text_of, point)) for point in _turned(points, height)]
        lines += [f"IMAGE={' '.join(image.split())}"] if image else []
        lines.append(f"ID={k}")
    return ("\n".join([*lines, ""]),)


RECOGNISES = re.compile(r"\s*lm", re.IGNORECASE).match
FORMAT = Format("tps", "tpsDig TPS", (".tps",), 1, RECOGNISES, parse, compose, encoding="latin-1")
