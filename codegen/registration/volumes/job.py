"""One registration of volumes from files to files: volumes and landmarks in; warped volume, field, report, record out.

As with pictures, whatever could be wrong with the input is found before anything is solved, and the warped volume is
written last. A map that folds, or that misses its round trip, writes no volume.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from codegen.errors import ArgumentError, PointsError
from codegen.registration.formats import Frames, read_landmarks
from codegen.registration.grid import Grid, place_text
from codegen.registration.job import heading, require_places, solve, timed
from codegen.registration.jobs import Job, Options
from codegen.registration.pair_report import RESIDUALS, write_page
from codegen.registration.pairs import LandmarkPairs, PointArray
from codegen.registration.solver import registration_module
from codegen.registration.volumes import fields, files, pictures
from codegen.registration.volumes.blocks import warped
from codegen.registration.volumes.files import Volume
from codegen.registration.volumes.nodes import Nodes
from codegen.registration.volumes.results import VolumeResult

NOTE = (
    f"Places and errors are in the coordinates of the files, LPS as a rule, x to the left of the patient. {RESIDUALS}"
)


def run(job: Job, options: Options, progress: Callable[[str], None] | None = None) -> VolumeResult:
    """Do a job; CodegenError for wrong input, and a result that has not passed where the numerics failed."""
    seconds: dict[str, float] = {}
    _require_writable(job, options)
    with timed(seconds, "read"):
        moving, fixed, pairs = _read(job)
        files.require_written(job.out, (fixed if options.inverse and fixed else moving).samples.dtype)
    with timed(seconds, "build"):
        registration_module(options.scheme, 3)
    record = heading(job, options, len(pairs), seconds)
    result = VolumeResult(record=record, pairs=pairs, moving=moving, fixed=fixed, inverse=options.inverse)
    solved = solve(job, options, pairs, moving.grid, (fixed or moving).grid, record, progress)
    if solved is not None:
        result = replace(
            result, registration=solved.registration, certificate=solved.certificate, left_out=solved.left_out,
            outliers=solved.outliers,
        )  # fmt: skip
        if solved.certificate.passed:
            with timed(seconds, "warp"):
                result = _warped(result, options, job.field is not None)
    if job.report is not None:
        with timed(seconds, "report"):
            write_page(job.report, result, pictures.of(result), NOTE)
    if result.passed:
        with timed(seconds, "write"):
            _write(job, result)
    return result


def _require_writable(job: Job, options: Options) -> None:
    if options.flip:
        raise ArgumentError("--flip mirrors pictures", "mirror the volume and its landmarks where they were made")
    files.require_written(job.out)
    if job.field is not None:
        fields.require_field(job.field)
    require_places(job, options)


def _read(job: Job) -> tuple[Volume, Volume | None, LandmarkPairs]:
    moving = files.read_volume(job.moving)
    fixed = files.read_volume(job.fixed) if job.fixed is not None else None
    other = (fixed or moving).grid
    if moving.grid.unit != other.unit:
        finding = f"{job.moving} is in {moving.grid.unit} and {job.fixed} in {other.unit}"
        raise ArgumentError(finding, "give volumes in the same unit")
    pairs = read_landmarks(*job.landmarks, frames=Frames(grids=(moving.grid, other)))
    for what, grid, points in (("moving", moving.grid, pairs.moving), ("fixed", other, pairs.fixed)):
        _require_inside(str(job.landmarks[0]), what, grid, points, pairs.names)
    return moving, fixed, pairs


def _require_inside(file: str, what: str, grid: Grid, points: PointArray, names: tuple[str, ...]) -> None:
    """Refuse landmarks outside their volume, with a guess at what is wrong with them."""
    outside = np.flatnonzero(~grid.contains(points, slack=0.5))
    if not outside.size:
        return
    remedy = "give coordinates in LPS, as the volume's header has them"
    if grid.unit != "mm":
        remedy = "give column, row and slice times the spacing"
    if grid.contains(points * [-1.0, -1.0, 1.0], slack=0.5).all():
        remedy = "turn the signs of x and y: they are RAS, and LPS is expected"
    elif grid.contains(grid.to_places(points), slack=0.5).all():
        remedy = "they look like indices of voxels: give coordinates in LPS"
    number, place = len(outside), place_text(points[outside[0]])
    others = f" and {number - 1} others" if number > 1 else ""
    raise PointsError(
        f"{file}: {what} landmark {names[outside[0]]} at {place}{others} lies outside the {what} volume", remedy
    )


def _warped(result: VolumeResult, options: Options, with_field: bool) -> VolumeResult:
    """The same with the source in the frame of the other volume."""
    found, inverse, summary = result.registration, options.inverse, result.record["summary"]
    assert found is not None
    function = found.map_points if inverse else found.map_points_inverse
    singular = found.pairs.moving if inverse else found.pairs.fixed
    nodes = Nodes.of(function, found.grid if inverse else found.fixed_grid, singular)
    made = warped(result.source, nodes, options.interpolation, with_field)
    summary |= {
        "spacing": list(nodes.steps), "spacing_bound": nodes.bound, "exact": nodes.exact, "outside": made.outside,
    }  # fmt: skip
    return replace(result, warped=made)


def _write(job: Job, result: VolumeResult) -> None:
    assert result.warped is not None
    assert result.registration is not None
    grid = result.registration.grid if result.inverse else result.registration.fixed_grid
    if job.field is not None and result.warped.field is not None:
        direction = "moving to fixed" if result.inverse else "fixed to moving"
        fields.write_field(job.field, result.warped.field, grid, direction)
    files.write_volume(job.out, result.warped.samples, grid)
