"""One registration from files to files: images and landmarks in; warped image, field, report and a record out.

Whatever could be wrong with the input is found before anything is solved, and the warped image is written last, so that
where it stands everything stands. A map that folds, or that misses its round trip, writes no image.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from codegen.errors import ArgumentError, LandmarkError, PointsError, RegistrationError
from codegen.registration import fields
from codegen.registration.certificate import Certificate, certificate_of, in_provable_steps
from codegen.registration.choice import chosen_alignment
from codegen.registration.coarse import Positions
from codegen.registration.formats import Frames, read_landmarks
from codegen.registration.grid import Extent
from codegen.registration.images import Image, Limits, read_image, require_fitting, require_kind, write_image
from codegen.registration.images.spacing import Spacing
from codegen.registration.jobs import LARGE, MOST_LEFT_OUT, Job, Options, Result, out_of_place
from codegen.registration.leave_one_out import LeaveOneOut, leave_one_out
from codegen.registration.maps import Registration
from codegen.registration.matching import Matching
from codegen.registration.noise import estimate_sigma
from codegen.registration.outliers import Outliers, outliers_of
from codegen.registration.pair_report import write_report
from codegen.registration.pairs import LandmarkPairs, flipped
from codegen.registration.pixels import in_pixels, in_squares, square_grid
from codegen.registration.register import register
from codegen.registration.solver import registration_module
from codegen.registration.warp import sources, warp_reported
from codegen.solutions import output


def run(
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
    if job.field is not None and not job.field.name.endswith(fields.KINDS):
        raise ArgumentError(f"--field {job.field}: unknown kind of file", f"let it end in {', '.join(fields.KINDS)}")
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
        fields.write_field(job.field, fields.displacements(result.positions), direction)
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
