"""What a module is called and where it comes from: the user's choices, versions, and the record in its header."""

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
    """What a user chooses beside the problem: None stands for the default.

    `general` forces the form of a module that leaves nothing out, to measure what leaving out saves; no command has it.
    With `sensitivities` the module makes derivatives of solutions by parameters and boundary values. A `standalone`
    module holds the numerics that it uses.
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
    """What a user chooses, in the form in which a module records it: the default scheme needs no name."""
    return Choices(None if scheme == DEFAULT_SCHEME else scheme, method, controls, general, sensitivities)


def origin_of(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, files: Iterable[DataFile] = ()
) -> Origin:
    """The header's record of where a module comes from; it names no folder, so that any machine makes the same text.

    `files` are those that the problem file has read.
    """
    from codegen.emit.lower.module import Origin

    source = source_of(problem)
    inputs = input_digest(source, arguments, *choice_texts(choices), *versions())
    if not isinstance(source, ProblemFile):
        place, command = f"where {source.name} is defined", _call(source.name, source.title, choices)
        return Origin(f"{source.name}, an object", command, inputs, versions(), place=place)
    reads = dict.fromkeys(f"{file.path}, sha256 {file.digest}" for file in files)
    file = source.path.name
    command = _command(file, arguments, choices)
    return Origin(file, command, inputs, versions(), tuple(reads), f"in the folder of {file}")


def _call(name: str, title: str, choices: Choices) -> str:
    """The call that makes the module of an object again."""
    named = {"name": name, **({"title": title} if title != name else {})}
    own = {field.name: getattr(choices, field.name) for field in fields(choices)}
    named |= {key: value for key, value in own.items() if value != getattr(Choices(), key)}
    return f"codegen.compile({', '.join(['problem', *(f'{key}={value!r}' for key, value in named.items())])})"


def _command(file: str, arguments: Mapping[str, str], choices: Choices) -> str:
    """The command that makes the module of a problem file again."""
    settings = (shlex.quote(f"{key}={value}") for key, value in sorted(arguments.items()))
    words = ["codegen build", shlex.quote(file), *(f"--set {setting}" for setting in settings)]
    for option in ("scheme", "method"):
        words += [f"--{option} {value}" for value in (getattr(choices, option),) if value]
    words += [f"--controls {choices.controls}"] if choices.controls != "interval" else []
    words += ["--sensitivities"] if choices.sensitivities else []
    words += ["(in the general form, for measurements)"] if choices.general else []
    return " ".join(words)


def module_name(problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices) -> str:
    """The problem's name, followed by every choice that is not the default."""
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
    # Characters were lost that may have told two modules apart.
    return f"{plain}_{hashlib.sha256(name.encode()).hexdigest()[:6]}"


def versions() -> tuple[str, ...]:
    """The versions that a generated text depends on."""
    return (f"codegen {__version__}", f"sympy {_version_of('sympy')}")


@cache
def _version_of(library: str) -> str:
    """The version of an installed library, which its metadata tell, whose reading takes longer than a solve."""
    return metadata.version(library)


def choice_texts(choices: Choices) -> tuple[str, ...]:
    """The choices as a digest takes them; ArgumentError where controls live nowhere."""
    if choices.controls not in ("interval", "nodal", "stages"):
        raise ArgumentError(f"controls is {choices.controls!r}", "use interval, stages or nodal")
    words = [word for word in ("general", "sensitivities", "standalone") if getattr(choices, word)]
    return (choices.scheme or "", choices.method or "", choices.controls, *words)
