"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from codegen.errors import ArgumentError

Value = TypeVar("Value")


def positive(text: str | int) -> int:
    """Return the positive integer in an option's text; typer also passes default values, which are integers."""
    if isinstance(text, int):
        return text
    if not (text.isascii() and text.isdigit() and len(text) < 13 and int(text) > 0):
        raise typer.BadParameter(f"{text!r} is not a positive integer")
    return int(text)


def once(option: str, pairs: Iterable[tuple[str, Value]]) -> dict[str, Value]:
    """Return the pairs (name, value) of an option as a dict; raises ArgumentError for a repeated name."""
    values: dict[str, Value] = {}
    for name, value in pairs:
        if name in values:
            raise ArgumentError(f"{option} gives {name} twice", "give it once")
        values[name] = value
    return values


class Controls(StrEnum):
    """Times at which controls are defined."""

    INTERVAL = "interval"
    STAGES = "stages"
    LINEAR = "linear"
    NODAL = "nodal"


class PictureStyles(StrEnum):
    """Uses of a picture."""

    PAGE = "page"
    PAPER = "paper"
    TALK = "talk"


Problem = Annotated[Path, typer.Argument(metavar="PROBLEM.py", help="The problem file.", show_default=False)]
Set = Annotated[list[str], typer.Option("--set", metavar="NAME=VALUE", help="An argument of problem(); repeatable.")]
Scheme = Annotated[str | None, typer.Option(help="Discretisation, such as midpoint or stormer-verlet.")]
Method = Annotated[
    str | None,
    typer.Option(help="Formulation: variational, hamiltonian or one-step; for particles stepping, full or action."),
]
ControlSites = Annotated[
    Controls, typer.Option(help="Times of the controls; linear joins values at nodes, nodal averages them.")
]
Steps = Annotated[
    int | None, typer.Option(parser=positive, metavar="N", help="Number of intervals. [default: the problem's own]")
]
Every = Annotated[int, typer.Option(parser=positive, metavar="N", help="Store every N-th step of a simulation.")]
Repeat = Annotated[int, typer.Option(parser=positive, metavar="N", help="Report the best time of N solves.")]
Log = Annotated[bool, typer.Option("--log", help="Print the iterates of the generated solver (newton).")]
PictureStyle = Annotated[
    PictureStyles, typer.Option(help="Use of the picture: a page, the two columns of a paper, or slides.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Out = Annotated[Path | None, typer.Option(help="Folder for the module. [default: generated if current, else a cache]")]
Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="Save a picture: .png, .pdf or .svg.")]

PAGE = "Statuses and errors"  # the title of the page about statuses, `docs/guide/statuses.md` in the sources


def on_statuses(*statuses: str) -> str:
    """Return the end of an error message: a reference to the documentation page that explains the statuses."""
    return f'; the guide explains {", ".join(statuses)}: see "{PAGE}"'
