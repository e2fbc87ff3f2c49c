"""One registration from files to files: images and landmarks in; warped image, field, report and a record out.

Whatever could be wrong with the input is found before anything is solved, and the warped image is written last, so that
where it stands everything stands. A map that folds, or that misses its round trip, writes no image.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from codegen.errors import ArgumentError, LandmarkError, PointsError, RegistrationError
from codegen.registration import fields
from codegen.registration.certificate import Certificate, certificate_of
from codegen.registration.choice import chosen_alignment
from codegen.registration.formats import Frames, read_landmarks
from codegen.registration.images import Image, Limits, read_image, require_fitting, require_kind, write_image
from codegen.registration.jobs import MOST_LEFT_OUT, Job, Options, Result
from codegen.registration.leave_one_out import LeaveOneOut, leave_one_out
from codegen.registration.maps import Registration
from codegen.registration.matching import Matching
from codegen.registration.noise import estimate_sigma
from codegen.registration.outliers import outliers_of
from codegen.registration.pair_report import write_report
from codegen.registration.pairs import LandmarkPairs, flipped
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
    with _timed(seconds, "read"):
        moving, fixed, pairs = _read(job, options, limits)
    with _timed(seconds, "build"):
        registration_module(options.scheme)
    result = _solved(job, options, moving, fixed, pairs, seconds, progress)
    if job.report is not None:
        with _timed(seconds, "report"):
            write_report(job.report, result)
    if result.passed:
        with _timed(seconds, "write"):
            _write(job, options, result)
    return result


def require_writable(job: Job, options: Options) -> None:
    """Refuse outputs of unknown kinds, in folders that are not there, or in place of an input."""
    require_kind(job.out)
    output.require_folder(job.out.absolute().parent, "--out")
    if job.field is not None:
        if not job.field.name.lower().endswith(fields.KINDS):
            raise ArgumentError(
                f"--field {job.field}: unknown kind of file", f"let it end in {', '.join(fields.KINDS)}"
            )
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
    record = _heading(job, options, len(pairs))
    record["seconds"] = seconds
    result = Result(record, pairs, moving, fixed)
    shape = moving.shape[:2]
    method: dict[str, Any] = {
        "fixed_shape": (fixed or moving).shape[:2], "align": options.align, "scheme": options.scheme,
    }  # fmt: skip
    summary = record["summary"]
    try:
        with _timed(seconds, "solve"):
            if options.align == "auto":
                choice = chosen_alignment(pairs, shape, fixed_shape=method["fixed_shape"], scheme=options.scheme)
                method["align"], summary["alignment_choice"] = choice.kind, choice.text
            sigma = options.sigma
            if sigma == "auto":
                estimate = estimate_sigma(pairs, shape, **method)
                sigma, summary["sigma_message"] = estimate.sigma, estimate.message
            method |= {"steps": options.steps, "loss": options.loss}
            outliers = outliers_of(Matching.of(pairs, shape, fixed_shape=method["fixed_shape"], align=method["align"]))
            found = register(pairs, shape, **method, sigma=sigma, progress=progress)
        with _timed(seconds, "certify"):
            certificate, positions = certificate_of(found, inverse=options.inverse)
        with _timed(seconds, "leave one out"):
            left_out = _left_out(found, method)
    except RegistrationError as error:
        record |= {"status": "not converged", "message": str(error)}
        return result
    except LandmarkError as error:
        raise PointsError(f"{job.landmarks[0]}: {error.finding}", error.remedy) from error
    warped = None
    result = Result(record, pairs, moving, fixed, found, certificate, left_out, None, outliers, positions)
    findings = _findings(found, certificate, left_out)
    summary |= findings.pop("summary") | {"sigma_chosen": options.sigma == "auto"}
    summary["outliers"] = [pairs.names[k] for k in result.out_of_place]
    record |= findings
    if certificate.passed:
        with _timed(seconds, "warp"):
            if options.coarse or positions is None:
                frame = found.shape if options.inverse else found.fixed_shape
                positions = sources(found, frame, options.inverse, "auto" if options.coarse else None)
            source = fixed if options.inverse and fixed is not None else moving
            warped, how = warp_reported(
                source.pixels, found, interpolation=options.interpolation, inverse=options.inverse,
                positions=positions,
            )  # fmt: skip
        summary |= {"spacing": how.spacing, "spacing_bound": how.bound, "outside": how.outside}
    return replace(result, warped=warped, positions=positions)


def _left_out(found: Registration, method: dict[str, Any]) -> LeaveOneOut | None:
    """Errors of landmarks that are left out in turn; None where there are too few or too many."""
    if not 2 <= len(found.pairs) <= MOST_LEFT_OUT:
        return None
    return leave_one_out(found.pairs, found.shape, start=found, sigma=found.sigma, **method)


def _heading(job: Job, options: Options, count: int) -> dict[str, Any]:
    direction = "fixed to moving" if options.inverse else "moving to fixed"
    return {
        "problem": "image_registration", "task": "warp", "direction": direction, "moving": str(job.moving),
        "fixed": str(job.fixed) if job.fixed is not None else None, "landmarks": [str(path) for path in job.landmarks],
        "out": str(job.out), "align": options.align, "scheme": options.scheme, "interpolation": options.interpolation,
        "sigma": None if options.sigma == "auto" else options.sigma, "steps": options.steps, "status": "",
        "message": "", "residual": None, "seconds": {}, "summary": {"landmarks": count},
    }  # fmt: skip


def _findings(found: Registration, certificate: Certificate, left_out: LeaveOneOut | None) -> dict[str, Any]:
    """What the record says of a map; distances in pixels."""
    status = "solved" if certificate.passed else "folded" if certificate.folded else "inaccurate"
    summary: dict[str, Any] = {
        "landmarks": len(found.pairs), "names": list(found.pairs.names), "residuals": found.residuals.tolist(),
        "det_min": certificate.det_min, "det_max": certificate.det_max, "det_min_at": certificate.det_min_at,
        "folded": certificate.folded, "first_fold": certificate.first_fold, "round_trip": certificate.round_trip,
        "proved": certificate.proved,
        "scheme_error": found.error, "alignment": found.alignment.kind, "rung": found.rung,
        "deviation": float(np.sqrt((found.residuals**2).mean() / 2.0)), "strength": found.matching.strength,
        "solves": found.solves,
    }  # fmt: skip
    if left_out is not None:
        summary["leave_one_out"] = left_out.errors.tolist()
    summary = {name: _strict(value) for name, value in summary.items()}
    return {
        "align": found.alignment.kind, "sigma": found.sigma, "steps": found.steps, "status": status,
        "message": certificate.message, "residual": _strict(certificate.residual_max), "summary": summary,
    }  # fmt: skip


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
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    begin = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = round(time.perf_counter() - begin, 6)
