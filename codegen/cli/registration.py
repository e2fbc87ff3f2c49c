"""The commands `warp`, `distances` and `app`: registration of images, volumes and specimens by landmarks."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from codegen.cli import options
from codegen.errors import ArgumentError, one_line
from codegen.terminal import console, progress, working

if TYPE_CHECKING:
    from codegen.registration.job import Options

# Import codegen.registration only inside functions, because it imports numba.
EXAMPLES = {
    "warp": (
        "codegen warp moving.png --landmarks pairs.csv --out warped.png --report report.html",
        "codegen warp folder --fixed atlas.png --landmarks pairs.csv --out warped --workers 4",
    ),
    "distances": ("codegen distances specimens.tps --out distances.csv --plot map.png",),
    "app": ("codegen app", "codegen app moving.png fixed.png --port 5010"),
}
KINDS = (".png", ".svg", ".pdf")


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
    json: options.Json = False,
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
        typer.Option(
            parser=options.positive, metavar="N", help="Processes for many pairs. [default: one for each processor]"
        ),
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
    choices = Options(
        inverse, deviation, align.value, scheme, steps, interpolation.value, coarse, loss.value, flip,
    )  # fmt: skip
    if moving.is_dir() or moving.suffix.lower() == ".csv":
        _many(moving, tuple(landmarks), out, fixed, field, report, choices, json, workers, cluster, resume)
        return
    if workers is not None or cluster is not None or resume:
        option = "--workers" if workers is not None else "--cluster" if cluster is not None else "--resume"
        raise ArgumentError(f"{option} is for many pairs, and {moving} is none", "give a folder, or a table (.csv)")
    if out is None or not landmarks:
        missing = "--out" if out is None else "--landmarks"
        raise ArgumentError(f"{missing} is missing", "say where the landmarks are and where the image goes")
    with working("Registering") as status:
        wanted = Job(moving, tuple(landmarks), out, fixed, field, report)
        result = job.run(wanted, choices, None if status is None else status.update)
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
    report: Path | None, choices: Options, json: bool, workers: int | None, cluster: str | None, resume: bool,
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
    request = BatchRequest(jobs, choices, places, summary, processes, cluster, resume)
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


def distances(
    specimens: Annotated[
        Path, typer.Argument(metavar="SPECIMENS", help="Landmarks of all: .tps, or .csv with specimen,x,y.")
    ],
    out: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="The table of distances.")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the specimens in two dimensions: .png, .svg, .pdf.")
    ] = None,
    mean: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="The mean shape.")] = None,
    workers: Annotated[
        int | None,
        typer.Option(parser=options.positive, metavar="N", help="Processes. [default: one for each processor]"),
    ] = None,
    json: options.Json = False,
) -> None:
    """Compute the distances of specimens. They are the lengths of geodesics between their landmarks."""
    import numpy as np

    from codegen.batch.executors import team_size
    from codegen.registration.distances import geodesic_distances, read_specimens, write_distances, write_mean
    from codegen.solving.results import output

    if out is None:
        raise ArgumentError("--out is missing", "say where the table goes, such as --out distances.csv")
    output.require_writable(out, (".csv",), "--out")
    if mean is not None:
        output.require_writable(mean, (".csv",), "--mean")
    for path in (out, *([mean] if mean is not None else [])):
        if path.resolve() == specimens.resolve():
            raise ArgumentError(f"{path} is read and would be overwritten", "choose another name for the output")
    if plot is not None:
        output.require_writable(plot, KINDS, "--plot")
    result = geodesic_distances(read_specimens(specimens), team_size(workers, None), working, progress)
    write_distances(out, result)
    if mean is not None:
        write_mean(mean, result)
    is_placed = np.isfinite(result.points[:, 0])
    left_out = [name for name, placed in zip(result.names, is_placed, strict=True) if not placed]
    if plot is not None and is_placed.any():
        from codegen.show.figures import save_specimens

        shown = [name for name in result.names if name not in left_out]
        save_specimens(result.points[is_placed], shown, result.share, plot)
    count = len(result.names) * (len(result.names) - 1) // 2
    if json:
        record = {
            "problem": "image_registration", "task": "distances", "specimens": len(result.names), "pairs": count,
            "failed": list(result.failed), "status": "failed" if result.failed else "solved",
            "share": result.share if is_placed.any() else None, "left_out": left_out, "out": str(out),
        }  # fmt: skip
        typer.echo(output.as_json(record))
    else:
        typer.echo(f"{count} distances between {len(result.names)} specimens; see {out}", err=True)
    for failure in result.failed:
        typer.echo(one_line(f"codegen: {failure}", 400), err=True)
    if left_out:
        typer.echo(f"codegen: not in the picture, for want of distances: {', '.join(left_out)}", err=True)
    if result.failed:
        raise typer.Exit(1)


def app(
    images: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[IMAGE]...", help="A moving and a fixed image, or one to be bent. [default: an example]"
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=1024, max=65535, help="Port on localhost.")] = 5006,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Open no browser; print the address.")] = False,
    state: Annotated[
        Path | None,
        typer.Option("--state", metavar="FOLDER", help="Folder for saved work. [default: $CODEGEN_STATE_DIR]"),
    ] = None,
) -> None:
    """Register images in the browser. Click pairs of points, drag them, and see the warp; Ctrl+C ends it."""
    from codegen.registration import app as page  # imports numba

    page.prepare(images or [], state)
    typer.echo(f"http://localhost:{port} (Ctrl+C ends it)")
    page.serve(images or [], port, show=not no_browser, state=state)
