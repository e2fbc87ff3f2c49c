"""What a registration from files to files is asked, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from codegen.registration.alignment import Kind
from codegen.registration.certificate import Certificate
from codegen.registration.fields import read_with, written_with
from codegen.registration.images import Image
from codegen.registration.leave_one_out import LeaveOneOut
from codegen.registration.maps import Registration
from codegen.registration.noise import Loss, Outliers
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.solver import DEFAULT_SCHEME
from codegen.registration.warp import Interpolation, Positions

MOST_LEFT_OUT = 100
"""Of more landmarks, none is left out in turn: it would take as many registrations."""

LARGE = 1 << 22
"""Pixels of an image from which on positions are interpolated, unless it is said otherwise."""


@dataclass(frozen=True)
class Options:
    """How pairs are registered and warped; `sigma` in pixels.

    Where pixels come from is interpolated from a `coarse` grid, or not; None: for more than `LARGE` pixels. With `flip`
    the moving image is mirrored left to right before anything else.
    """

    inverse: bool = False
    sigma: float | Literal["auto"] = 0.0
    align: Kind = "auto"
    scheme: str = DEFAULT_SCHEME
    steps: int | None = None
    interpolation: Interpolation = "linear"
    coarse: bool | None = None
    loss: Loss = "linear"
    flip: bool = False


def _absolute(path: Path) -> Path:
    return path.parent.resolve() / path.name  # whose name counts, even where it is that of a link


@dataclass(frozen=True)
class Job:
    """The files of one pair that are read and written; `landmarks` is one file, or a moving and a fixed one.

    `interpolation` is that of this pair alone, as for labels among other images; None: that of the options.
    """

    moving: Path
    landmarks: tuple[Path, ...]
    out: Path
    fixed: Path | None = None
    field: Path | None = None
    report: Path | None = None
    interpolation: Interpolation | None = None

    @property
    def read(self) -> tuple[Path, ...]:
        """All files that are read."""
        fixed = [self.fixed] if self.fixed is not None else []
        samples = [found for path in (self.moving, *fixed) if (found := read_with(path)) is not None]
        return (self.moving, *self.landmarks, *fixed, *samples)

    def absolute(self) -> Job:
        """The same files by names that mean the same in any process, and are the same however they were written."""
        fixed, field, report = (
            None if path is None else _absolute(path) for path in (self.fixed, self.field, self.report)
        )
        moving, landmarks, out = _absolute(self.moving), tuple(map(_absolute, self.landmarks)), _absolute(self.out)
        return replace(self, moving=moving, landmarks=landmarks, out=out, fixed=fixed, field=field, report=report)

    def own(self, options: Options) -> Options:
        """The options with what is this pair's own."""
        return options if self.interpolation is None else replace(options, interpolation=self.interpolation)

    @property
    def written(self) -> tuple[Path, ...]:
        """All files that are written, the image last."""
        named = tuple(path for path in (self.field, self.report, self.out) if path is not None)
        return (*(found for path in named if (found := written_with(path)) is not None), *named)


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """What a job found, of pictures or of volumes: the record for people and programs, the landmarks, the map."""

    record: dict[str, Any]
    pairs: LandmarkPairs
    registration: Registration | None = None
    certificate: Certificate | None = None
    left_out: LeaveOneOut | None = None
    outliers: Outliers | None = None

    @property
    def out_of_place(self) -> tuple[int, ...]:
        """The numbers of the landmarks that are named as outliers; of few landmarks, by leaving each out."""
        return out_of_place(self.outliers, self.left_out)

    @property
    def passed(self) -> bool:
        """Whether the image was warped by a map that does not fold."""
        return bool(self.record["status"] == "solved")


@dataclass(frozen=True, eq=False, kw_only=True)
class Result(Outcome):
    """What a job found of pictures, with all that a report shows."""

    moving: Image
    fixed: Image | None
    warped: Any = None
    positions: Positions | None = None  # where the pixels of the warped image come from


def out_of_place(outliers: Outliers | None, left_out: LeaveOneOut | None) -> tuple[int, ...]:
    """The numbers of the landmarks that are named as outliers; of few landmarks, by leaving each out."""
    if outliers is not None and not np.isnan(outliers.errors).all():
        return outliers.numbers
    return left_out.outliers if left_out is not None else ()
