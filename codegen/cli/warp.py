"""The command `codegen warp`: register images or volumes by landmarks."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from codegen.cli.options import positive
from codegen.errors import ArgumentError, one_line
from codegen.terminal import console, progress, working

if TYPE_CHECKING:
    from codegen.registration.job import Options

# Import codegen.registration only inside functions, because it imports numba.
EXAMPLES = (
    "codegen warp moving.png --landmarks pairs.csv --out warped.png --report report.html",
    "codegen warp folder --fixed atlas.png --landmarks pairs.csv --out warped --workers 4",
)


class Align(StrEnum):
    """Kind of the map that aligns the landmarks before the flow."""

    AUTO = "auto"
    NONE = "none"
    SIMILARITY = "similarity"
    AFFINE = "affine"


class Loss(StrEnum):
    """Loss function of landmark residuals; all except `linear` reduce the influence of outliers."""

    LINEAR = "linear"
    HUBER = "huber"
    CAUCHY = "cauchy"
    TUKEY = "tukey"


class Interpolation(StrEnum):
    """Interpolation between pixels."""

    NEAREST = "nearest"
    LINEAR = "linear"
    CUBIC = "cubic"


def warp(
    moving: Annotated[
        Path,
        typer.Argument(
            metavar="MOVING", help="The image or volume to be warped, a folder of them, or a table of pairs (.csv)."
        ),
    ],
    landmarks: Annotated[
        list[Path],
        typer.Option(metavar="FILE", help="Landmarks; elastix and Slicer: give it twice, first the moving file."),
    ] = [],  # noqa: B006  typer copies it
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="The warped image; for many pairs a folder.")] = None,
    fixed: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The image to which it is registered, in whose frame the result is."),
    ] = None,
    inverse: Annotated[
        bool, typer.Option("--inverse", help="Bring the fixed image into the frame of the moving one instead.")
    ] = False,
    sigma: Annotated[
        str, typer.Option(metavar="S", help="Standard deviation of landmarks' errors in pixels (volumes: mm), or auto.")
    ] = "0",
    loss: Annotated[Loss, typer.Option(help="With a sigma: robust ones let outliers pull less.")] = Loss.LINEAR,
    align: Annotated[
        Align, typer.Option(help="What is taken out before the flow; auto: by leaving landmarks out.")
    ] = Align.AUTO,
    flip: Annotated[bool, typer.Option("--flip", help="Mirror the moving image left to right first.")] = False,
    scheme: Annotated[str, typer.Option(help="The scheme that integrates the flow.")] = "rk4",
    steps: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Steps of the scheme. [default: as many as it needs]")
    ] = None,
    interpolation: Annotated[Interpolation, typer.Option(help="Between pixels.")] = Interpolation.LINEAR,
    field: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Save displacements: .npz, .nii.gz, .mha, .mhd or .nrrd; for many pairs a folder."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page about the pair; for many pairs a folder.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    coarse: Annotated[
        bool | None,
        typer.Option(
            "--coarse/--exact",
            help="Map a coarse grid and interpolate, with an estimated error below 0.01 pixel, or map each pixel. "
            "[default: coarse for more than 4 million pixels]",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(parser=positive, metavar="N", help="Processes for many pairs. [default: one for each processor]"),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="The scheduler of a cluster of dask for many pairs; or local, to begin one."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with many pairs, only if they were begun with the same options.")
    ] = False,
) -> None:
    """Warp images or volumes by landmarks. The map from moving to fixed is certified to be free of folds."""
    if len(landmarks) > 2:
        raise ArgumentError(
            f"--landmarks was given {len(landmarks)} times", "give one file, or a moving and a fixed one"
        )
    from codegen.registration import batch, job
    from codegen.registration.job import Job, Options
    from codegen.solving.results import output

    if loss is not Loss.LINEAR and sigma == "0":
        raise ArgumentError(f"--loss {loss.value} is for landmarks that may miss", "give a --sigma as well, or auto")
    try:
        deviation: float | Literal["auto"] = "auto" if sigma == "auto" else float(sigma)
    except ValueError:
        deviation = -1.0
    if not isinstance(deviation, str) and not 0.0 <= deviation < 1e6:
        raise ArgumentError(f"--sigma {sigma[:30]}", "give a distance in pixels, or auto")
    options = Options(
        inverse, deviation, align.value, scheme, steps, interpolation.value, coarse, loss.value, flip,
    )  # fmt: skip
    if moving.is_dir() or moving.suffix.lower() == ".csv":
        _many(moving, tuple(landmarks), out, fixed, field, report, options, json, workers, cluster, resume)
        return
    if workers is not None or cluster is not None or resume:
        option = "--workers" if workers is not None else "--cluster" if cluster is not None else "--resume"
        raise ArgumentError(f"{option} is for many pairs, and {moving} is none", "give a folder, or a table (.csv)")
    if out is None or not landmarks:
        missing = "--out" if out is None else "--landmarks"
        raise ArgumentError(f"{missing} is missing", "say where the landmarks are and where the image goes")
    with working("Registering") as status:
        wanted = Job(moving, tuple(landmarks), out, fixed, field, report)
        result = job.run(wanted, options, None if status is None else status.update)
    if json:
        typer.echo(output.as_json(result.record))
    else:
        console().print(batch.table(result.record))
    if result.record["summary"].get("sigma_message"):
        typer.echo(f"codegen: {result.record['summary']['sigma_message']}", err=True)
    if not result.passed:
        typer.echo(one_line(f"codegen: {result.record['message']}"), err=True)
        raise typer.Exit(1)


def _many(
    moving: Path, landmarks: tuple[Path, ...], out: Path | None, fixed: Path | None, field: Path | None,
    report: Path | None, options: Options, json: bool, workers: int | None, cluster: str | None, resume: bool,
) -> None:  # fmt: skip
    from codegen.batch.executors import team_size
    from codegen.registration import batch, batch_pairs
    from codegen.registration.batch import BatchRequest, outcome_of
    from codegen.solving.results import output

    processes = team_size(workers, cluster)
    places = batch_pairs.Places(out, field, report)
    if moving.is_dir():
        if out is None or out.resolve() == moving.resolve():
            raise ArgumentError(f"--out is missing, or is {moving} itself", "give a folder for the warped images")
        jobs, without = batch_pairs.jobs_in_folder(moving, places, fixed, landmarks)
        if without:
            names = ", ".join(path.name for path in without[:3]) + (", ..." if len(without) > 3 else "")
            typer.echo(f"codegen: {len(without)} images have no landmarks and are left out: {names}", err=True)
    elif landmarks:
        raise ArgumentError(f"{moving} names the landmarks of its pairs", "leave --landmarks out")
    else:
        jobs = batch_pairs.jobs_in_table(moving, places, fixed)
    for option, folder in (("--out", out), ("--field", field), ("--report", report)):
        if folder is not None:
            output.require_folder(folder, option, may_be_made=True)
    summary = (out / batch_pairs.SUMMARY) if out is not None else moving.with_suffix(".summary.csv")
    if report is not None:
        batch_pairs.require_free(jobs, report / batch.NAME)
    request = BatchRequest(jobs, options, places, summary, processes, cluster, resume)
    done = outcome_of(request, working, progress)
    if report is not None:
        batch.write_batch_report(report, done, [job.report for job in jobs])
    for line in done.notes:
        typer.echo(line, err=True)
    if json:
        typer.echo(output.as_json(batch.record(done, summary)))
    else:
        console().print(batch.overview(done, summary))
    for pair in done.failed:
        typer.echo(one_line(f"{pair['moving']}: {pair['status']}: {pair['message']}", 400), err=True)
    if done.failed:
        typer.echo(f"codegen: {len(done.failed)} of {len(done.lines)} pairs failed", err=True)
        raise typer.Exit(1)
