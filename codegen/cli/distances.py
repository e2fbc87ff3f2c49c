"""The command `codegen distances`: geodesic distances between specimens, and their map in two dimensions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.options import positive
from codegen.errors import ArgumentError, one_line
from codegen.terminal import progress, working

EXAMPLES = ("codegen distances specimens.tps --out distances.csv --plot map.png",)
KINDS = (".png", ".svg", ".pdf")


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
        int | None, typer.Option(parser=positive, metavar="N", help="Processes. [default: one for each processor]")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
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
