"""The name of a generated module and its origin: the user's options, versions, and the record in the header."""

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
    """The user's options for the generation of a module from a problem; None stands for the default.

    Values of `controls` belong to each "interval", to its "stages", or to nodes ("linear" or "nodal"). With `general` a
    module has all features, to measure the gain of leaving features out; no command offers this. With `sensitivities`
    it makes derivatives of solutions by parameters and boundary values. A `standalone` module runs without this
    package.
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
    """Return the options as a module records them: None instead of the name of the default scheme."""
    return Choices(None if scheme == DEFAULT_SCHEME else scheme, method, controls, general, sensitivities)


def origin_of(
    problem: Source | Path | str, arguments: Mapping[str, str], choices: Choices, files: Iterable[DataFile] = ()
) -> Origin:
    """Return the record of a module's origin for its header; it has no folders, so that all machines make equal text.

    `files` are the data files that the problem reads.
    """
    from codegen.emit.lower.module import Origin

    source = source_of(problem)
    inputs = input_digest(source, arguments, *choice_texts(choices), *versions())
    if not isinstance(source, ProblemFile):
        # The call that regenerates the module of a problem object.
        named = {"name": source.name, **({"title": source.title} if source.title != source.name else {})}
        values = {field.name: getattr(choices, field.name) for field in fields(choices)}
        named |= {key: value for key, value in values.items() if value != getattr(Choices(), key)}
        command = f"codegen.compile({', '.join(['problem', *(f'{key}={value!r}' for key, value in named.items())])})"
        place = f"where {source.name} is defined"
        return Origin(f"{source.name}, an object", command, inputs, versions(), place=place)
    # The command that regenerates the module of a problem file.
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
    """Return the problem's name, followed by every option that is not the default and by the problem's arguments."""
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
    # Two names may differ in replaced characters alone; the digest keeps them distinct.
    return f"{plain}_{hashlib.sha256(name.encode()).hexdigest()[:6]}"


@cache
def versions() -> tuple[str, ...]:
    """Return the versions of codegen and sympy, on which generated text depends; cached, as reading them is slow."""
    return (f"codegen {__version__}", f"sympy {metadata.version('sympy')}")


def choice_texts(choices: Choices) -> tuple[str, ...]:
    """Return the options as strings for a digest; raise ArgumentError if `controls` has an unknown value."""
    if choices.controls not in ("interval", "stages", "linear", "nodal"):
        raise ArgumentError(f"controls is {choices.controls!r}", "use interval, stages, linear or nodal")
    words = [word for word in ("general", "sensitivities", "standalone") if getattr(choices, word)]
    return (choices.scheme or "", choices.method or "", choices.controls, *words)
