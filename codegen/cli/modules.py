"""The module that a command is about: built, or taken from the cache, and compiled."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from codegen.cli.options import Controls
from codegen.deadline import BUILD

if TYPE_CHECKING:
    from codegen.compiler import Build


def build_module(
    problem: Path,
    set_: list[str],
    scheme: str | None,
    method: str | None,
    controls: Controls,
    out: Path | None,
    time_limit: float = BUILD,
) -> Build:
    """Derive a module with the options of a command, or take it from the cache; raises a kind of CodegenError."""
    from codegen import compiler
    from codegen.author.problem_file import parse_arguments

    arguments = parse_arguments(set_, problem)
    return compiler.build(
        problem, arguments, scheme=scheme, method=method, controls=controls.value, out=out, time_limit=time_limit
    )


def compiled(made: Build) -> Path:
    """The path of a module, compiled by the processes that are quick at it, not function by function when called."""
    from codegen.cli import machine_code
    from codegen.loading import load

    machine_code.require(made, load(made.path))
    return made.path
