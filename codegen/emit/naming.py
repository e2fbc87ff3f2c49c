"""The name and the origin of a module: the user's choices, versions, and the record in the header."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from codegen import __version__
from codegen.errors import ArgumentError
from codegen.problem.points import DataFile
from codegen.problem.sources import ProblemFile, Source, input_digest, source_of

if TYPE_CHECKING:
    from codegen.emit.lower.module import Origin

DEFAULT_SCHEME = "midpoint"


@dataclass(frozen=True)
class Choices:
    """The user's choices in addition to the problem; None stands for the default.

    `general` forces the general form, in which a module has all features, for measurements; no command has it. With
    `sensitivities` the module makes derivatives of solutions by parameters and boundary values. A `standalone` module
    contains the numerics that it uses.
    """

    scheme: str | None = None
    method: str | None = None
    controls: str = "interval"
    general: bool = False
    sensitivities: bool = False
    standalone: bool = False


def chosen(
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
    general: bool = False,
    sensitivities: bool = False,
) -> Choices:
    """Return the choices as a module records them: the default scheme has no name."""
    return Choices(None if scheme == DEFAULT_SCHEME else scheme, method, controls, general, sensitivities)


def origin_of(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, files: Iterable[DataFile] = ()
) -> Origin:
    """Return the header's record of a module's origin, without folders: all machines make the same text.

    `files` are the data files that the problem reads.
    """
    from codegen.emit.lower.module import Origin

    source = source_of(problem)
    inputs = input_digest(source, arguments, *choice_texts(choices), *versions())
    if not isinstance(source, ProblemFile):
        # The call that makes the module of an object again.
        named = {"name": source.name, **({"title": source.title} if source.title != source.name else {})}
        values = {field.name: getattr(choices, field.name) for field in fields(choices)}
        named |= {key: value for key, value in values.items() if value != getattr(Choices(), key)}
        command = f"codegen.compile({', '.join(['problem', *(f'{key}={value!r}' for key, value in named.items())])})"
        place = f"where {source.name} is defined"
        return Origin(f"{source.name}, an object", command, inputs, versions(), place=place)
    # The command that makes the module of a problem file again.
    reads = dict.fromkeys(f"{file.path}, sha256 {file.digest}" for file in files)
    file = source.path.name
    settings = (shlex.quote(f"{key}={value}") for key, value in sorted(arguments.items()))
    words = ["codegen build", shlex.quote(file), *(f"--set {setting}" for setting in settings)]
    for option in ("scheme", "method"):
        words += [f"--{option} {value}" for value in (getattr(choices, option),) if value]
    words += [f"--controls {choices.controls}"] if choices.controls != "interval" else []
    words += ["--sensitivities"] if choices.sensitivities else []
    words += ["(in the general form, for measurements)"] if choices.general else []
    return Origin(file, " ".join(words), inputs, versions(), tuple(reads), f"in the folder of {file}")


def module_name(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices) -> str:
    """Return the problem's name, followed by every choice that is not the default."""
    parts = [source_of(problem).name]
    if choices.method:
        parts.append(choices.method)
    if choices.scheme and choices.scheme != DEFAULT_SCHEME:
        parts.append(choices.scheme)
    if choices.controls != "interval":
        parts.append(f"{choices.controls}_controls")
    if choices.sensitivities:
        parts.append("sensitivities")
    if choices.general:
        parts.append("general_form")
    if choices.standalone:
        parts.append("standalone")
    parts += [f"{key}_{value}" for key, value in sorted(arguments.items())]
    name = "_".join(parts)
    plain = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    if plain == name.replace("-", "_"):
        return plain
    # Lost characters may have distinguished two modules.
    return f"{plain}_{hashlib.sha256(name.encode()).hexdigest()[:6]}"


@cache
def versions() -> tuple[str, ...]:
    """Return the versions that a generated text depends on; reading metadata takes longer than a solve."""
    return (f"codegen {__version__}", f"sympy {metadata.version('sympy')}")


def choice_texts(choices: Choices) -> tuple[str, ...]:
    """Return the choices for a digest; ArgumentError for an unknown place of controls."""
    if choices.controls not in ("interval", "nodal", "stages"):
        raise ArgumentError(f"controls is {choices.controls!r}", "use interval, stages or nodal")
    words = [word for word in ("general", "sensitivities", "standalone") if getattr(choices, word)]
    return (choices.scheme or "", choices.method or "", choices.controls, *words)
