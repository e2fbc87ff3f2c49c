"""Where a problem comes from, a file or an object of Python: the one place in which both become the same.

All that follows asks a source: what the problem is called, what text identifies it in the build cache, and what its
author has written. Nothing here needs sympy until an object is described or a file is run.
"""

from __future__ import annotations

import hashlib
import keyword
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from codegen.errors import ArgumentError, clause
from codegen.problem import problem_file
from codegen.problem.base import AuthorObject

UNNAMED = "problem"
"""What an object is called that nobody gave a name."""


@dataclass(frozen=True)
class ProblemFile:
    """A problem file, which its text identifies; line endings do not matter."""

    path: Path

    @property
    def name(self) -> str:
        """What modules are named after."""
        return self.path.stem

    @property
    def location(self) -> str:
        """What messages call it."""
        return str(self.path)

    @property
    def folder(self) -> Path:
        """Where the files lie that it reads."""
        return self.path.parent

    @property
    def text(self) -> str:
        """What identifies it; ProblemFileError when the file cannot be read."""
        return problem_file.source_text(self.path)

    @property
    def arguments(self) -> tuple[str, ...]:
        """What `--set` may set."""
        return problem_file.argument_names(self.path)

    @property
    def point_arguments(self) -> set[str]:
        """Those of them that are files of points."""
        return problem_file.point_arguments(self.path)

    def written(self, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
        """The title, the author's object and the declared symbols; see `problem_file.written_problem`."""
        return problem_file.written_problem(self.path, arguments)


@dataclass(frozen=True)
class ProblemObject:
    """A problem that was made in Python, in a notebook for example; all that it says, as text, identifies it.

    That text does not depend on the process, on the hash seed, or on what else was declared.
    """

    name: str
    title: str
    text: str = field(repr=False)
    problem: Any = field(repr=False, compare=False)
    folder: Path = field(default=Path(), repr=False, compare=False)

    @property
    def location(self) -> str:
        """What messages call it."""
        return self.name

    @property
    def arguments(self) -> tuple[str, ...]:
        """What `--set` may set: nothing, since there is no problem() to be called again."""
        return ()

    @property
    def point_arguments(self) -> set[str]:
        """As there are none, none of them is a file of points."""
        return set()

    def written(self, arguments: Mapping[str, str]) -> tuple[str, Any, Any]:
        """The title, the object and the symbols in it; ArgumentError for arguments, of which there are none."""
        from codegen.problem.description import quantities_in

        for name in arguments:
            finding = f"{self.name}: no argument {clause(name)}, since the problem is an object"
            remedy = "give a value of a parameter by parameters={...}, or write a problem file with problem(...)"
            raise ArgumentError(finding, remedy)
        return self.title, self.problem, [symbol for symbol in quantities_in(self.problem) if symbol.own]


Source: TypeAlias = ProblemFile | ProblemObject


def source_of(problem: Any, name: str | None = None, title: str | None = None) -> Source:
    """The source of a problem: of the path of its file, or of a Control, Simulate, Phases or Connect, with its name.

    Raises ArgumentError for a name that is no identifier, for a name or title of a file, which has its own, and for
    what is no problem; ExpressionError for a part of an object that no problem may have.
    """
    if isinstance(problem, ProblemFile | ProblemObject | Path | str):
        if name is not None or title is not None:
            raise ArgumentError("a name or title beside a file", "leave it out; a file is named by itself")
        return problem if isinstance(problem, ProblemFile | ProblemObject) else ProblemFile(Path(problem))
    if not isinstance(problem, AuthorObject):
        remedy = "give the path of a problem file, or a Control, Simulate, Phases or Connect"
        raise ArgumentError(f"a problem is no {type(problem).__name__}", remedy)
    from codegen.problem.description import described

    name = UNNAMED if name is None else name
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise ArgumentError(f"name {clause(repr(name))} cannot name a module", "give a Python identifier")
    title = name if title is None else title
    if not isinstance(title, str) or not title.strip() or not title.isprintable():
        raise ArgumentError(f"title {clause(repr(title))}", "give one line of text")
    return ProblemObject(name, title.strip(), f"{title.strip()}\n{described(problem, name)}", problem, Path.cwd())


def input_digest(problem: Source | Path | str, arguments: Mapping[str, str], *extra: str) -> str:
    """The SHA-256, in hexadecimal, of a problem's text, its arguments in any order, and further strings.

    Files that a problem file imports or reads are not seen. Raises ProblemFileError when the file cannot be read.
    """
    pairs = [part for name in sorted(arguments) for part in (name, arguments[name])]
    digest = hashlib.sha256()
    for part in (source_of(problem).text, str(len(arguments)), *pairs, *extra):
        data = part.encode(errors="surrogateescape")
        # The length in front keeps ("ab", "c") and ("a", "bc") apart.
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


@dataclass(frozen=True)
class Settings(Mapping[str, str]):
    """The arguments that shape a module, as text, and beside them the file of points, if any, which a solve reads."""

    shaping: Mapping[str, str]
    points: str | None = None

    def __getitem__(self, name: str) -> str:
        return self.shaping[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.shaping)

    def __len__(self) -> int:
        return len(self.shaping)


def settings_of(problem: Source | Path | str, arguments: Mapping[str, object] | None) -> Settings:
    """What arguments of problem() say, as values or as the text that `--set` takes; settings are what they are.

    Raises ProblemFileError when the problem file cannot be read, and ArgumentError when two files of points are given.
    """
    if isinstance(arguments, Settings):
        return arguments
    arguments = arguments or {}
    names = source_of(problem).point_arguments
    given = [name for name in arguments if name in names]
    if len(given) > 1:
        raise ArgumentError(f"--set gives files of points as {' and '.join(given)}", "give one of them")
    others = {name: str(value) for name, value in arguments.items() if name not in names}
    return Settings(others, str(arguments[given[0]]) if given else None)
