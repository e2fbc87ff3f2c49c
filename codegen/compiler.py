"""The story of a build: problem file -> model -> interval expressions -> program -> derivatives -> strings -> module.

    author            discretise           transcribe          derive              lower            render
    Problem   --->    interval exprs --->  Program     --->    derivatives  --->   Module    --->   text of one .py

Before the text is written, `verify` compares its derivatives with an independent differentiation of the program.

`build` runs it, or takes the text from the cache, whose key is everything that the text depends on; a hit needs no
sympy at all.
"""

from __future__ import annotations

import gc
import hashlib
import math
import os
import shlex
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING

from codegen import __version__, emit
from codegen.deadline import BUILD, Stages, described, extent
from codegen.errors import ArgumentError, FileError
from codegen.problem_file import input_digest, load_problem, split_points
from codegen.runtime.kept_code import remove_partial_bytecode

if TYPE_CHECKING:
    from codegen.lower.module import Module, Origin
    from codegen.model import Model
    from codegen.model.pairwise import PairwiseModel

DEFAULT_SCHEME = "midpoint"
GENERATED = Path("generated")
"""The folder, below the current one, in which modules are kept that someone wants to read."""


@dataclass(frozen=True)
class Choices:
    """What a user chooses beside the problem: None stands for the default.

    `general` forces the form of a module that leaves nothing out, to measure what leaving out saves; no command has it.
    """

    scheme: str | None = None
    method: str | None = None
    controls: str = "interval"
    general: bool = False


@dataclass(frozen=True)
class Build:
    """A generated module on disk, how long it took, and whether the cache had it."""

    path: Path
    name: str
    seconds: float
    cached: bool
    written: bool


def build(
    path: Path | str,
    arguments: Mapping[str, str] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
    general: bool = False,
    out: Path | str | None = None,
    time_limit: float = BUILD,
) -> Build:
    """Derive, emit and write the module of a problem file into the folder `out`.

    Without `out` the module stays in the user's cache, unless ./generated already holds the very same text: then that
    file is used, and with it the machine code that numba keeps beside it. A derivation may take `time_limit` seconds of
    processor time; what takes longer is a SizeError, which names the stage and what is large. Raises a kind of
    CodegenError when the problem or a choice is unusable; then nothing is written.
    """
    begin = time.perf_counter()
    path = Path(path)
    arguments = split_points(path, arguments or {})[0]
    for key, value in arguments.items():
        if not value.isprintable():
            raise ArgumentError(f"--set {key}={value!r} holds control characters", "leave them out")
    choices = chosen(scheme, method, controls, general)
    store = _store(path, arguments, choices)
    kept_text = _kept_text(store)
    name, cached, text = store.stem, bool(kept_text), kept_text or generate(path, arguments, choices, time_limit)
    if not cached:
        try:
            emit.write(store, text)
        except FileError as error:
            raise FileError(error.finding, "make room there, or let CODEGEN_CACHE_DIR name another folder") from error
    if out is None:
        kept = GENERATED / f"{name}.py"
        target = kept if kept.is_file() and kept.read_bytes() == text.encode() else store
        return Build(target, name, time.perf_counter() - begin, cached, not cached)
    target = Path(out) / f"{name}.py"
    written = emit.write(target, text)
    with suppress(OSError):  # where it may not be removed, Python may not have written it either
        remove_partial_bytecode(cache_from_source(target))  # type: ignore[no-untyped-call]
    return Build(target, name, time.perf_counter() - begin, cached, written)


def stored(path: Path, arguments: Mapping[str, str], *, scheme: str | None = None) -> Path:
    """Where the cache keeps the module of a problem file once it has been built."""
    return _store(path, arguments, chosen(scheme))


def chosen(
    scheme: str | None = None, method: str | None = None, controls: str = "interval", general: bool = False
) -> Choices:
    """What a user chooses, in the form in which a module records it: the default scheme needs no name."""
    return Choices(None if scheme == DEFAULT_SCHEME else scheme, method, controls, general)


def _store(path: Path, arguments: Mapping[str, str], choices: Choices) -> Path:
    digest = input_digest(path, arguments, *_choice_texts(choices), *versions(), _own_digest())
    return cache_folder() / digest[:20] / f"{module_name(path, arguments, choices)}.py"


def _kept_text(store: Path) -> str:
    """What the cache holds; nothing where it holds nothing, or what is not whole."""
    try:
        text = store.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    return text if emit.is_whole(text) else ""


def generate(path: Path, arguments: Mapping[str, str], choices: Choices, time_limit: float = BUILD) -> str:
    """The text of the module of a problem file, derived anew within so many seconds of processor time."""
    stages = Stages(time_limit)
    with _rare_collections(), stages.limited():
        model = load_problem(path, arguments)
        return generate_from_model(model, choices, origin_of(path, arguments, choices), stages)


@contextmanager
def _rare_collections() -> Iterator[None]:
    """Look for cyclic garbage less often: expressions leave little, and looking takes a sixth of the time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def generate_from_model(
    model: Model | PairwiseModel, choices: Choices, origin: Origin, stages: Stages | None = None
) -> str:
    """The pipeline itself, from a checked problem to the text of its module."""
    from codegen import derive, lower, transcribe, verify

    if choices.general:
        return emit.render(_general_module(model, choices), origin)
    stages = stages or Stages(math.inf)
    stages.begin("writing the equations of an interval", lambda: described(model))
    program = transcribe.transcribe(model, choices.scheme, choices.method, choices.controls)
    stages.begin("differentiating the equations of an interval", lambda: extent(program, described(model)))
    derivatives = derive.derivatives(program)
    stages.begin("writing the kernels of the derivatives")
    module = lower.lower(program, derivatives)
    text = emit.render(module, origin)
    stages.begin("verifying the kernels")
    verify.verify(program, text)
    return text


def _general_module(model: Model | PairwiseModel, choices: Choices) -> Module:
    """The same with nothing left out, for measurements; ArgumentError for particles, which have no such form."""
    from codegen import derive, general, lower, transcribe
    from codegen.model import Model
    from codegen.transcribe.program import ControlProgram

    if not isinstance(model, Model):
        raise ArgumentError("particles have no general form", "measure another problem")
    program = transcribe.transcribe(general.general_model(model), choices.scheme, choices.method, choices.controls)
    if isinstance(program, ControlProgram):
        return lower.lower(program, general.general_derivatives(program, derive.control_derivatives(program)))
    program = general.general_step(program)
    return lower.lower(program, derive.step_derivatives(program))


def origin_of(path: Path, arguments: Mapping[str, str], choices: Choices) -> Origin:
    """The header's record of where a module comes from; it names no folder, so that any machine makes the same text."""
    from codegen.lower.module import Origin

    settings = (shlex.quote(f"{key}={value}") for key, value in sorted(arguments.items()))
    words = ["codegen build", shlex.quote(path.name), *(f"--set {setting}" for setting in settings)]
    for option in ("scheme", "method"):
        words += [f"--{option} {value}" for value in (getattr(choices, option),) if value]
    words += ["--controls nodal"] if choices.controls == "nodal" else []
    words += ["(in the general form, for measurements)"] if choices.general else []
    inputs = input_digest(path, arguments, *_choice_texts(choices), *versions())
    return Origin(path.name, " ".join(words), inputs, versions())


def module_name(path: Path, arguments: Mapping[str, str], choices: Choices) -> str:
    """The problem's name, followed by every choice that is not the default."""
    parts = [path.stem]
    if choices.method:
        parts.append(choices.method)
    if choices.scheme and choices.scheme != DEFAULT_SCHEME:
        parts.append(choices.scheme)
    if choices.controls != "interval":
        parts.append(f"{choices.controls}_controls")
    if choices.general:
        parts.append("general_form")
    parts += [f"{key}_{value}" for key, value in sorted(arguments.items())]
    name = "_".join(parts)
    plain = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in name)
    if plain == name.replace("-", "_"):
        return plain
    # Characters were lost that may have told two modules apart.
    return f"{plain}_{hashlib.sha256(name.encode()).hexdigest()[:6]}"


def versions() -> tuple[str, ...]:
    """The versions that a generated text depends on."""
    return (f"codegen {__version__}", f"sympy {metadata.version('sympy')}")


def cache_folder() -> Path:
    """The build cache: $CODEGEN_CACHE_DIR, or a folder in the user's cache directory."""
    given = os.environ.get("CODEGEN_CACHE_DIR")
    if given:
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "variational-codegen"


def _choice_texts(choices: Choices) -> tuple[str, ...]:
    if choices.controls not in ("interval", "nodal"):
        raise ArgumentError(f"controls is {choices.controls!r}", "use interval or nodal")
    return (choices.scheme or "", choices.method or "", choices.controls, *(["general"] if choices.general else []))


_USERS = (
    "drivers", "plots", "registration", "report", "stress", "__main__.py", "app_command.py", "cli.py", "files.py",
    "notes.py", "output.py", "solve_options.py", "terminal.py",
)  # fmt: skip
"""Parts of this package on which no generated text depends."""


@cache
def _own_digest() -> str:
    """Hash of this package's sources, so that a changed generator never serves what an older one made.

    What only uses generated modules is left out.
    """
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for file in sorted([*folder.rglob("*.py"), *folder.rglob("*.j2")]):
        if file.relative_to(folder).parts[0] in _USERS:
            continue
        digest.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
