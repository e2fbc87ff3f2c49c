"""One registration from files to files: images and landmarks in; warped image, field, report and a record out.

Whatever could be wrong with the input is found before anything is solved, and the warped image is written last, so that
where it stands everything stands. A map that folds, or that misses its round trip, writes no image.

One registration of volumes from files to files: volumes and landmarks in; warped volume, field, report, record out. As
with pictures, whatever could be wrong with the input is found before anything is solved, and the warped volume is
written last. A map that folds, or that misses its round trip, writes no volume.

What a registration from files to files is asked, and what it finds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from codegen.errors import ArgumentError, LandmarkError, PointsError, RegistrationError
from codegen.registration import volume_pictures, volumes, warp
from codegen.registration.alignment import Kind
from codegen.registration.certificate import Certificate, certificate_of, in_provable_steps
from codegen.registration.formats import read_landmarks
from codegen.registration.formats.base import Frames
from codegen.registration.grid import Extent, Grid, place_text
from codegen.registration.images import Image, Limits, Spacing, read_image, require_fitting, require_kind, write_image
from codegen.registration.linear import chosen_alignment
from codegen.registration.maps import Registration, in_pixels, in_squares, square_grid
from codegen.registration.matching import Matching
from codegen.registration.noise import Loss, Outliers, estimate_sigma, outliers_of
from codegen.registration.pair_report import RESIDUALS, write_page, write_report
from codegen.registration.pairs import LandmarkPairs, PointArray, flipped
from codegen.registration.register import MOST_LEFT_OUT, LeaveOneOut, leave_one_out, out_of_place, register
from codegen.registration.solver import DEFAULT_SCHEME, registration_module
from codegen.registration.volumes import Nodes, Volume, Warped, is_volume, warped
from codegen.registration.warp import Interpolation, Positions, read_with, sources, warp_reported, written_with
from codegen.solving.results import output

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


@dataclass(frozen=True, eq=False, kw_only=True)
class VolumeResult(Outcome):
    """What a job found of volumes, with all that a report shows."""

    moving: Volume
    fixed: Volume | None
    inverse: bool = False
    warped: Warped | None = None

    @property
    def source(self) -> Volume:
        """The volume that is warped."""
        return self.fixed if self.inverse and self.fixed is not None else self.moving

    @property
    def target(self) -> Volume | None:
        """The volume in whose frame the result is, if there is one."""
        return self.moving if self.inverse else self.fixed


def run(job: Job, options: Options, progress: Callable[[str], None] | None = None) -> Outcome:
    """Do a job; CodegenError for wrong input, and an outcome that has not passed where the numerics failed."""
    if is_volume(job.moving):
        return run_volumes(job, job.own(options), progress)
    return run_pictures(job, job.own(options), progress=progress)


def dimension_of(job: Job) -> int:
    """3 for volumes, 2 for pictures and for what cannot be read."""
    return 3 if is_volume(job.moving) else 2


def run_pictures(
    job: Job, options: Options, limits: Limits | None = None, progress: Callable[[str], None] | None = None
) -> Result:
    """Do a job; CodegenError for wrong input, and a result that has not passed where the numerics failed.

    `progress` is told a line after each solve, where there are several.
    """
    seconds: dict[str, float] = {}
    require_writable(job, options)
    with timed(seconds, "read"):
        moving, fixed, pairs = _read(job, options, limits)
    with timed(seconds, "build"):
        registration_module(options.scheme)
    result = _solved(job, options, moving, fixed, pairs, seconds, progress)
    if job.report is not None:
        with timed(seconds, "report"):
            write_report(job.report, result)
    if result.passed:
        with timed(seconds, "write"):
            _write(job, options, result)
    return result


def require_writable(job: Job, options: Options) -> None:
    """Refuse outputs of unknown kinds, in folders that are not there, or in place of an input."""
    require_kind(job.out)
    if job.field is not None and not job.field.name.endswith(warp.KINDS):
        raise ArgumentError(f"--field {job.field}: unknown kind of file", f"let it end in {', '.join(warp.KINDS)}")
    require_places(job, options)


def require_places(job: Job, options: Options) -> None:
    """Refuse outputs in folders that are not there, or in place of an input, whatever they hold."""
    output.require_folder(job.out.absolute().parent, "--out")
    if job.field is not None:
        output.require_folder(job.field.absolute().parent, "--field")
    if job.report is not None:
        output.require_writable(job.report, (".html",), "--report")
    read = {path.resolve() for path in job.read}
    for path in job.written:
        if path.resolve() in read:
            raise ArgumentError(f"{path} is read and would be overwritten", "choose another name for the output")
        if path.is_dir():
            raise ArgumentError(f"{path} is a folder", "give the name of a file")
    if len({path.resolve() for path in job.written}) < len(job.written):
        raise ArgumentError(f"{job.out}: two outputs have the same name", "give each a name of its own")
    if options.inverse and job.fixed is None:
        raise ArgumentError("--inverse brings the fixed image into the frame of the moving one", "give it with --fixed")


def _read(job: Job, options: Options, limits: Limits | None) -> tuple[Image, Image | None, LandmarkPairs]:
    moving = read_image(job.moving, limits)
    fixed = read_image(job.fixed, limits) if job.fixed is not None else None
    frames = Frames(
        moving.shape, fixed.shape if fixed is not None else moving.shape, job.moving.name,
        job.fixed.name if job.fixed is not None else "",
    )  # fmt: skip
    pairs = read_landmarks(*job.landmarks, frames=frames)
    if options.flip:
        moving = replace(moving, pixels=np.ascontiguousarray(moving.pixels[:, ::-1]))
        pairs = flipped(pairs, moving.shape[1])
    require_fitting(job.out, (fixed if options.inverse and fixed is not None else moving).pixels)
    return moving, fixed, pairs


def _solved(
    job: Job, options: Options, moving: Image, fixed: Image | None, pairs: LandmarkPairs, seconds: dict[str, float],
    progress: Callable[[str], None] | None = None,
) -> Result:  # fmt: skip
    """Register, certify and warp; a result without an image where that fails."""
    record = heading(job, options, len(pairs), seconds)
    result = Result(record=record, pairs=pairs, moving=moving, fixed=fixed)
    other = fixed or moving
    grids = square_grid(moving.shape, moving.spacing), square_grid(other.shape, other.spacing)
    solved = solve(job, options, in_squares(pairs, *grids), *grids, record, progress)
    if solved is None:
        return result
    found, positions, summary, warped = solved.registration, solved.positions, record["summary"], None
    summary |= _lengths(other.spacing, found, solved.left_out)
    if solved.certificate.passed:
        with timed(seconds, "warp"):
            if options.coarse or positions is None:
                frame = found.shape if options.inverse else found.fixed_shape
                coarse = math.prod(frame) > LARGE if options.coarse is None else options.coarse
                positions = sources(found, frame, options.inverse, "auto" if coarse else None)
            source = fixed if options.inverse and fixed is not None else moving
            warped, how = warp_reported(
                source.pixels, found, interpolation=options.interpolation, inverse=options.inverse,
                positions=positions,
            )  # fmt: skip
        summary |= {"spacing": how.spacing, "spacing_bound": how.bound, "outside": how.outside}
    return replace(
        result, registration=found, certificate=solved.certificate, left_out=solved.left_out, warped=warped,
        outliers=solved.outliers, positions=positions,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Solved:
    """A map that was found, and what is known of it; where pixels come from if all had to be evaluated."""

    registration: Registration
    certificate: Certificate
    positions: Positions | None
    left_out: LeaveOneOut | None
    outliers: Outliers


def solve(
    job: Job, options: Options, pairs: LandmarkPairs, shape: Extent, fixed_shape: Extent, record: dict[str, Any],
    progress: Callable[[str], None] | None = None,
) -> Solved | None:  # fmt: skip
    """Register pictures or volumes and certify the map, and say so in the record; None where no map is found."""
    seconds, summary = record["seconds"], record["summary"]
    method: dict[str, Any] = {"fixed_shape": fixed_shape, "align": options.align, "scheme": options.scheme}
    try:
        with timed(seconds, "solve"):
            if options.align == "auto":
                choice = chosen_alignment(pairs, shape, fixed_shape=fixed_shape, scheme=options.scheme)
                method["align"], summary["alignment_choice"] = choice.kind, choice.text
            sigma = options.sigma
            if sigma == "auto":
                estimate = estimate_sigma(pairs, shape, **method)
                sigma, summary["sigma_message"] = estimate.sigma, estimate.message
            method |= {"steps": options.steps, "loss": options.loss}
            outliers = outliers_of(Matching.of(pairs, shape, fixed_shape=fixed_shape, align=method["align"]))
            found = register(pairs, shape, **method, sigma=sigma, progress=progress)
        with timed(seconds, "certify"):
            found = in_pixels(found)
            if pairs.dimension == 3 and options.steps is None:
                found = in_provable_steps(found)
            certificate, positions = certificate_of(found, inverse=options.inverse)
        with timed(seconds, "leave one out"):
            left_out = _left_out(found, shape, method)
    except RegistrationError as error:
        record |= {"status": "not converged", "message": str(error)}
        return None
    except LandmarkError as error:
        raise PointsError(f"{job.landmarks[0]}: {error.finding}", error.remedy) from error
    solved = Solved(found, certificate, positions, left_out, outliers)
    findings = _findings(found, certificate, left_out)
    summary |= findings.pop("summary") | {"sigma_chosen": options.sigma == "auto"}
    named = out_of_place(outliers, left_out)
    summary["outliers"] = [pairs.names[k] for k in named]
    record |= findings
    return solved


def _left_out(found: Registration, shape: Extent, method: dict[str, Any]) -> LeaveOneOut | None:
    """Errors of landmarks that are left out in turn; None where there are too few or too many."""
    if not 2 <= len(found.pairs) <= MOST_LEFT_OUT:
        return None
    return leave_one_out(found.matching.pairs, shape, start=found, sigma=found.sigma, **method)


def heading(job: Job, options: Options, count: int, seconds: dict[str, float]) -> dict[str, Any]:
    """A record before anything is solved."""
    direction = "fixed to moving" if options.inverse else "moving to fixed"
    return {
        "problem": "image_registration", "task": "warp", "direction": direction, "moving": str(job.moving),
        "fixed": str(job.fixed) if job.fixed is not None else None, "landmarks": [str(path) for path in job.landmarks],
        "out": str(job.out), "align": options.align, "scheme": options.scheme, "interpolation": options.interpolation,
        "sigma": None if options.sigma == "auto" else options.sigma, "steps": options.steps, "status": "",
        "message": "", "residual": None, "seconds": seconds, "summary": {"landmarks": count},
    }  # fmt: skip


def _findings(found: Registration, certificate: Certificate, left_out: LeaveOneOut | None) -> dict[str, Any]:
    """What the record says of a map; distances in pixels, or in the unit of volumes."""
    status = "solved" if certificate.passed else "folded" if certificate.folded else "inaccurate"
    summary: dict[str, Any] = {
        "landmarks": len(found.pairs), "names": list(found.pairs.names), "residuals": found.residuals.tolist(),
        "det_min": certificate.det_min, "det_max": certificate.det_max, "det_min_at": certificate.det_min_at,
        "folded": certificate.folded, "first_fold": certificate.first_fold, "round_trip": certificate.round_trip,
        "proved": certificate.proved,
        "scheme_error": found.error, "alignment": found.alignment.kind, "rung": found.rung,
        "deviation": float(np.sqrt((found.residuals**2).mean() / found.dimension)), "strength": found.matching.strength,
        "solves": found.solves, "unit": found.matching.unit,
    }  # fmt: skip
    if left_out is not None:
        summary["leave_one_out"] = left_out.errors.tolist()
    summary = {name: _strict(value) for name, value in summary.items()}
    return {
        "align": found.alignment.kind, "sigma": found.sigma, "steps": found.steps, "status": status,
        "message": certificate.message, "residual": _strict(certificate.residual_max), "summary": summary,
    }  # fmt: skip


def _lengths(spacing: Spacing | None, found: Registration, left_out: LeaveOneOut | None) -> dict[str, Any]:
    """Residuals and errors of landmarks that are left out in the unit that the fixed picture carries, if it does."""
    if spacing is None:
        return {}
    residuals = spacing.lengths(found.misses)
    lengths = {
        "length_unit": spacing.unit, "pixel_lengths": [spacing.x, spacing.y], "residual_lengths": residuals.tolist(),
        "deviation_length": float(np.sqrt((residuals**2).mean() / 2.0)),
    }  # fmt: skip
    if left_out is not None:
        lengths["leave_one_out_lengths"] = spacing.lengths(left_out.misses).tolist()
    return {name: _strict(value) for name, value in lengths.items()}


def _strict(value: Any) -> Any:
    """The value for strict JSON: no NaN and no infinity."""
    if isinstance(value, list | tuple):
        return [_strict(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def _write(job: Job, options: Options, result: Result) -> None:
    if job.field is not None and result.positions is not None:
        # The field that makes the image: from each of its pixels to where its value comes from.
        direction = "moving to fixed" if options.inverse else "fixed to moving"
        warp.write_field(job.field, warp.displacements(result.positions), direction)
    source = result.fixed if options.inverse and result.fixed is not None else result.moving
    write_image(job.out, result.warped, source.profile)


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Note how long the block takes."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = round(time.perf_counter() - begin, 6)


NOTE = (
    f"Places and errors are in the coordinates of the files, LPS as a rule, x to the left of the patient. {RESIDUALS}"
)


def run_volumes(job: Job, options: Options, progress: Callable[[str], None] | None = None) -> VolumeResult:
    """Do a job; CodegenError for wrong input, and a result that has not passed where the numerics failed."""
    seconds: dict[str, float] = {}
    if options.flip:
        raise ArgumentError("--flip mirrors pictures", "mirror the volume and its landmarks where they were made")
    volumes.require_written(job.out)
    if job.field is not None:
        volumes.require_field(job.field)
    require_places(job, options)
    with timed(seconds, "read"):
        moving, fixed, pairs = _read_volumes(job)
        volumes.require_written(job.out, (fixed if options.inverse and fixed else moving).samples.dtype)
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
                result = _warped_volume(result, options, job.field is not None)
    if job.report is not None:
        with timed(seconds, "report"):
            write_page(job.report, result, volume_pictures.of(result), NOTE)
    if result.passed:
        with timed(seconds, "write"):
            _write_volume(job, result)
    return result


def _read_volumes(job: Job) -> tuple[Volume, Volume | None, LandmarkPairs]:
    moving = volumes.read_volume(job.moving)
    fixed = volumes.read_volume(job.fixed) if job.fixed is not None else None
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


def _warped_volume(result: VolumeResult, options: Options, with_field: bool) -> VolumeResult:
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


def _write_volume(job: Job, result: VolumeResult) -> None:
    assert result.warped is not None
    assert result.registration is not None
    grid = result.registration.grid if result.inverse else result.registration.fixed_grid
    if job.field is not None and result.warped.field is not None:
        direction = "moving to fixed" if result.inverse else "fixed to moving"
        volumes.write_field(job.field, result.warped.field, grid, direction)
    volumes.write_volume(job.out, result.warped.samples, grid)
