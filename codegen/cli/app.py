"""The command `codegen app`: the web page for image registration, served to this machine only."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLES = ("codegen app", "codegen app moving.png fixed.png --port 5010")


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
