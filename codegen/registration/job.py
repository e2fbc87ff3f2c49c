"""Registration of one pair of images from files to files.

The inputs are images and landmarks; the outputs are the warped image, the displacement field, the report and the
record. All input is checked before anything is solved. The warped image is written last, so that its presence means
that all outputs are complete. No image is written if the map folds, or if its round trip is inaccurate.
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
from codegen.registration import volumes
from codegen.registration.certificate import certificate_of, in_provable_steps
from codegen.registration.formats import read_landmarks
from codegen.registration.formats.base import Frames
from codegen.registration.grid import Grid, place_text
from codegen.registration.images import read_image, require_fitting, require_kind, write_image
from codegen.registration.linear import chosen_alignment
from codegen.registration.maps import in_pixels, in_squares, square_grid
from codegen.registration.matching import Matching
from codegen.registration.noise import Loss, estimate_sigma, outliers_of
from codegen.registration.pair_report import (
    NOTE,
    VOLUME_NOTE,
    Outcome,
    Record,
    pictures_of,
    volume_pictures,
    write_page,
)
from codegen.registration.pairs import Kind, LandmarkPairs, flipped
from codegen.registration.register import MOST_LEFT_OUT, leave_one_out, register
from codegen.registration.solver import DEFAULT_SCHEME, registration_module
from codegen.registration.volumes import Nodes, is_volume, read_volume, warped
from codegen.registration.warp import (
    FIELD_KINDS,
    Interpolation,
    Positions,
    displacements,
    read_with,
    sources,
    warp_reported,
    write_field,
    written_with,
)
from codegen.solving.results import output

LARGE = 1 << 22  # number of pixels above which, by default, positions are interpolated from a coarse grid

Progress = Callable[[str], None]
_DIRECTIONS = ("moving to fixed", "fixed to moving")
"""The direction in which the image is warped, indexed by `inverse`; displacement fields have the other direction."""


@dataclass(frozen=True)
class Options:
    """Options of the registration and the warp of pairs: arguments of `register` and `warp`, and three others.

    `inverse` warps the fixed image to the moving one. `flip` first mirrors the moving image left to right. `coarse`
    interpolates positions from a coarse grid; None means True for more than `LARGE` pixels. `sigma` is in pixels.
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


@dataclass(frozen=True)
class Job:
    """The input and output files of one pair.

    `landmarks` is one file, or a moving and a fixed file. `interpolation` replaces the option of the same name for this
    pair, for instance if its images are labels.
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
        """All input files, including files of samples that the headers of images name."""
        fixed = [self.fixed] if self.fixed is not None else []
        samples = [file for path in (self.moving, *fixed) if (file := read_with(path)) is not None]
        return (self.moving, *self.landmarks, *fixed, *samples)

    @property
    def written(self) -> tuple[Path, ...]:
        """All output files, the warped image last."""
        files = tuple(path for path in (self.field, self.report, self.out) if path is not None)
        return (*(samples for path in files if (samples := written_with(path)) is not None), *files)

    def absolute(self) -> Job:
        """Return the job with absolute paths, which are unique and valid in any process."""

        def absolute(path: Path) -> Path:
            return path.parent.resolve() / path.name  # a symbolic link is not followed

        fixed, field, report = (path and absolute(path) for path in (self.fixed, self.field, self.report))
        moving, landmarks, out = absolute(self.moving), tuple(map(absolute, self.landmarks)), absolute(self.out)
        return replace(self, moving=moving, landmarks=landmarks, out=out, fixed=fixed, field=field, report=report)


def run(job: Job, options: Options, progress: Progress | None = None) -> Outcome:
    """Register one pair of pictures or volumes, write its files and return the outcome.

    `progress` receives a line of text after each solve if there are several. Raises CodegenError for wrong input. If
    the numerics fail, nothing is raised, and `passed` of the outcome is False.
    """
    if job.interpolation is not None:
        options = replace(options, interpolation=job.interpolation)
    return (run_volumes if is_volume(job.moving) else run_pictures)(job, options, progress)


def run_pictures(job: Job, options: Options, progress: Progress | None = None) -> Outcome:
    """Register one pair of pictures as `run` does."""
    seconds: dict[str, float] = {}
    require_kind(job.out)
    if job.field is not None and not job.field.name.endswith(FIELD_KINDS):
        raise ArgumentError(f"--field {job.field}: unknown kind of file", f"let it end in {', '.join(FIELD_KINDS)}")
    _require_outputs(job, options)
    with _timed(seconds, "read"):
        moving = read_image(job.moving)
        fixed = read_image(job.fixed) if job.fixed is not None else None
        names = job.moving.name, job.fixed.name if job.fixed is not None else ""
        frames = Frames(moving.shape, (fixed or moving).shape, *names)
        pairs = read_landmarks(*job.landmarks, frames=frames)
        if options.flip:
            moving = replace(moving, pixels=np.ascontiguousarray(moving.pixels[:, ::-1]))
            pairs = flipped(pairs, moving.shape[1])
        source = fixed if options.inverse and fixed is not None else moving
        require_fitting(job.out, source.pixels)
    target = fixed or moving
    grids = square_grid(moving.shape, moving.spacing), square_grid(target.shape, target.spacing)
    result, positions = _registered(job, options, pairs, grids, seconds, progress)
    registration, certificate, left_out = result.registration, result.certificate, result.left_out
    summary = result.record["summary"]
    if registration is not None and certificate is not None:
        if target.spacing is not None:
            residuals = target.spacing.lengths(registration.misses)
            lengths = {
                "length_unit": target.spacing.unit, "pixel_lengths": [target.spacing.x, target.spacing.y],
                "residual_lengths": residuals.tolist(),
                "deviation_length": float(np.sqrt((residuals**2).mean() / 2.0)),
            }  # fmt: skip
            if left_out is not None:
                lengths["leave_one_out_lengths"] = target.spacing.lengths(left_out.misses).tolist()
            summary |= _strict(lengths)
        if certificate.passed:
            with _timed(seconds, "warp"):
                if options.coarse or positions is None:
                    shape = (registration.grid if options.inverse else registration.fixed_grid).shape
                    coarse = math.prod(shape) > LARGE if options.coarse is None else options.coarse
                    positions = sources(registration, shape, options.inverse, "auto" if coarse else None)
                pixels, report = warp_reported(
                    source.pixels, registration, interpolation=options.interpolation, positions=positions
                )
            summary |= {"spacing": report.spacing, "spacing_bound": report.bound, "outside": report.outside}
            result = replace(result, warped=pixels)
    if job.report is not None:
        with _timed(seconds, "report"):
            write_page(job.report, result, pictures_of(result, moving, fixed), NOTE)
    if result.passed and result.warped is not None:
        with _timed(seconds, "write"):
            if job.field is not None and positions is not None:
                # The field leads from each pixel of the warped image to the position of its value in the source.
                write_field(job.field, displacements(positions), _DIRECTIONS[not options.inverse])
            write_image(job.out, result.warped, source.profile)
    return result


def run_volumes(job: Job, options: Options, progress: Progress | None = None) -> Outcome:
    """Register one pair of volumes as `run` does."""
    seconds: dict[str, float] = {}
    if options.flip:
        raise ArgumentError("--flip mirrors pictures", "mirror the volume and its landmarks where they were made")
    volumes.require_written(job.out)
    if job.field is not None:
        volumes.require_field(job.field)
    _require_outputs(job, options)
    with _timed(seconds, "read"):
        moving = read_volume(job.moving)
        fixed = read_volume(job.fixed) if job.fixed is not None else None
        grids = moving.grid, (fixed or moving).grid
        if grids[0].unit != grids[1].unit:
            finding = f"{job.moving} is in {grids[0].unit} and {job.fixed} in {grids[1].unit}"
            raise ArgumentError(finding, "give volumes in the same unit")
        pairs = read_landmarks(*job.landmarks, frames=Frames(grids=grids))
        for side, grid, points in zip(("moving", "fixed"), grids, (pairs.moving, pairs.fixed), strict=True):
            outside = np.flatnonzero(~grid.contains(points, slack=0.5))
            if not outside.size:
                continue
            if grid.contains(points * [-1.0, -1.0, 1.0], slack=0.5).all():
                remedy = "turn the signs of x and y: they are RAS, and LPS is expected"
            elif grid.contains(grid.to_places(points), slack=0.5).all():
                remedy = "they look like indices of voxels: give coordinates in LPS"
            elif grid.unit != "mm":
                remedy = "give column, row and slice times the spacing"
            else:
                remedy = "give coordinates in LPS, as the volume's header has them"
            first, others = outside[0], f" and {len(outside) - 1} others" if len(outside) > 1 else ""
            finding = f"{side} landmark {pairs.names[first]} at {place_text(points[first])}{others} lies outside"
            raise PointsError(f"{job.landmarks[0]}: {finding} the {side} volume", remedy)
        source, target = (fixed, grids[0]) if options.inverse and fixed is not None else (moving, grids[1])
        volumes.require_written(job.out, source.samples.dtype)
    result, _ = _registered(job, options, pairs, grids, seconds, progress)
    registration, certificate, field = result.registration, result.certificate, None
    if registration is not None and certificate is not None and certificate.passed:
        with _timed(seconds, "warp"):
            function = registration.map_points if options.inverse else registration.map_points_inverse
            nodes = Nodes.of(
                function, target, registration.pairs.moving if options.inverse else registration.pairs.fixed
            )
            made = warped(source, nodes, options.interpolation, job.field is not None)
            result.record["summary"] |= {
                "spacing": list(nodes.steps), "spacing_bound": nodes.bound, "exact": nodes.exact,
                "outside": made.outside,
            }  # fmt: skip
            result, field = replace(result, warped=made.samples), made.field
    if job.report is not None:
        with _timed(seconds, "report"):
            write_page(job.report, result, volume_pictures(result, moving, fixed), VOLUME_NOTE)
    if result.passed and result.warped is not None:
        with _timed(seconds, "write"):
            if job.field is not None and field is not None:
                volumes.write_field(job.field, field, target, _DIRECTIONS[not options.inverse])
            volumes.write_volume(job.out, result.warped, target)
    return result


def _require_outputs(job: Job, options: Options) -> None:
    """Raise ArgumentError for outputs in missing folders, over an input or a folder, or of the same name."""
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


def _registered(
    job: Job, options: Options, pairs: LandmarkPairs, grids: tuple[Grid, Grid], seconds: dict[str, float],
    progress: Progress | None,
) -> tuple[Outcome, Positions | None]:  # fmt: skip
    """Return the outcome of the registration of a pair, without a warped image, and the positions of all pixels.

    `pairs` are in pixels for pictures, and in the coordinates of the two `grids` for volumes. `seconds` receives the
    times. The positions are None unless the certificate needed them. Without a map, the record has the reason.
    """
    with _timed(seconds, "build"):
        registration_module(options.scheme, pairs.dimension)
    summary: Record = {"landmarks": len(pairs)}
    record: Record = {
        "problem": "image_registration", "task": "warp", "direction": _DIRECTIONS[options.inverse],
        "moving": str(job.moving), "fixed": str(job.fixed) if job.fixed is not None else None,
        "landmarks": [str(path) for path in job.landmarks], "out": str(job.out), "align": options.align,
        "scheme": options.scheme, "interpolation": options.interpolation,
        "sigma": None if options.sigma == "auto" else options.sigma, "steps": options.steps, "status": "",
        "message": "", "residual": None, "seconds": seconds, "summary": summary,
    }  # fmt: skip
    result, (shape, fixed_shape) = Outcome(record=record, pairs=pairs), grids
    if pairs.dimension == 2:
        pairs = in_squares(pairs, *grids)
    method: Record = {"fixed_shape": fixed_shape, "align": options.align, "scheme": options.scheme}
    try:
        with _timed(seconds, "solve"):
            if options.align == "auto":
                choice = chosen_alignment(pairs, shape, fixed_shape=fixed_shape, scheme=options.scheme)
                method["align"], summary["alignment_choice"] = choice.kind, choice.text
            sigma = options.sigma
            if sigma == "auto":
                estimate = estimate_sigma(pairs, shape, **method)
                sigma, summary["sigma_message"] = estimate.sigma, estimate.message
            method |= {"steps": options.steps, "loss": options.loss}
            outliers = outliers_of(Matching.of(pairs, shape, fixed_shape=fixed_shape, align=method["align"]))
            registration = register(pairs, shape, **method, sigma=sigma, progress=progress)
        with _timed(seconds, "certify"):
            registration = in_pixels(registration)
            if pairs.dimension == 3 and options.steps is None:
                registration = in_provable_steps(registration)
            certificate, positions = certificate_of(registration, inverse=options.inverse)
        with _timed(seconds, "leave one out"):
            left_out = None
            if 2 <= len(pairs) <= MOST_LEFT_OUT:
                known = registration.matching.pairs
                left_out = leave_one_out(known, shape, start=registration, sigma=registration.sigma, **method)
    except RegistrationError as error:
        record |= {"status": "not converged", "message": str(error)}
        return result, None
    except LandmarkError as error:
        raise PointsError(f"{job.landmarks[0]}: {error.finding}", error.remedy) from error
    result = replace(result, registration=registration, certificate=certificate, left_out=left_out, outliers=outliers)
    status = "solved" if certificate.passed else "folded" if certificate.folded else "inaccurate"
    record |= {
        "align": registration.alignment.kind, "sigma": registration.sigma, "steps": registration.steps,
        "status": status, "message": certificate.message, "residual": _strict(certificate.residual_max),
    }  # fmt: skip
    residuals = registration.residuals
    findings: Record = {
        "landmarks": len(pairs), "names": list(registration.pairs.names), "residuals": residuals.tolist(),
        "det_min": certificate.det_min, "det_max": certificate.det_max, "det_min_at": certificate.det_min_at,
        "folded": certificate.folded, "first_fold": certificate.first_fold, "round_trip": certificate.round_trip,
        "proved": certificate.proved, "scheme_error": registration.error, "alignment": registration.alignment.kind,
        "rung": registration.rung, "deviation": float(np.sqrt((residuals**2).mean() / pairs.dimension)),
        "strength": registration.matching.strength, "solves": registration.solves,
        "unit": registration.matching.fixed_grid.unit,
    }  # fmt: skip
    if left_out is not None:
        findings["leave_one_out"] = left_out.errors.tolist()
    summary |= _strict(findings)
    summary["sigma_chosen"] = options.sigma == "auto"
    summary["outliers"] = [pairs.names[k] for k in result.out_of_place]
    return result, positions


def _strict(value: object) -> Any:
    """Return the value with None for NaN and infinity, which strict JSON does not allow."""
    if isinstance(value, dict):
        return {name: _strict(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Store the time of the block in `seconds`, under `name`."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = round(time.perf_counter() - begin, 6)
