"""The command `codegen distances`: geodesic distances between specimens, and where they lie in two dimensions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.options import positive
from codegen.errors import ArgumentError, one_line
from codegen.terminal import progress, working

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
    """Tell how far specimens are from each other: the lengths of geodesics between their landmarks."""
    import numpy as np

    from codegen.batch.executors import team_size
    from codegen.registration.batches.distances import geodesic_distances, read_specimens, write_distances, write_mean
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
    found = geodesic_distances(read_specimens(specimens), team_size(workers, None), working, progress)
    write_distances(out, found)
    if mean is not None:
        write_mean(mean, found)
    known = np.isfinite(found.points[:, 0])
    left_out = [name for name, is_known in zip(found.names, known, strict=True) if not is_known]
    if plot is not None and known.any():
        from codegen.show.figures import save_specimens

        shown = [name for name in found.names if name not in left_out]
        save_specimens(found.points[known], shown, found.share, plot)
    count = len(found.names) * (len(found.names) - 1) // 2
    if json:
        record = {
            "problem": "image_registration", "task": "distances", "specimens": len(found.names), "pairs": count,
            "failed": list(found.failed), "status": "failed" if found.failed else "solved",
            "share": found.share if known.any() else None, "left_out": left_out, "out": str(out),
        }  # fmt: skip
        typer.echo(output.as_json(record))
    else:
        typer.echo(f"{count} distances between {len(found.names)} specimens; see {out}", err=True)
    for said in found.failed:
        typer.echo(one_line(f"codegen: {said}", 400), err=True)
    if left_out:
        typer.echo(f"codegen: not in the picture, for want of distances: {', '.join(left_out)}", err=True)
    if found.failed:
        raise typer.Exit(1)
