"""What executors share out: work in chunks, which are counted from zero and done in any process.

Work can be pickled, and is small: workers get it once, and then a piece, or a number, for each chunk.

What a worker's machine is to machine code, and how the processes of one machine wait for each other.

A journal: which work it belongs to, and what of that is whole.

Lines of JSON: first a header with the digest of the work, then one for each part that is where it belongs. A line is
written after its part, so that what ends the work at any time loses only what was being done; a line that was cut off
counts for nothing.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TextIO

from codegen.errors import ArgumentError, CodegenError, clause
from codegen.files import refused, write_text
from codegen.solving.cache import cache_folder

if TYPE_CHECKING:
    from rich.table import Table

SOLVED = "solved"
LOST = "worker lost"
"""The status of a case whose chunk has ended process after process."""


@dataclass(frozen=True)
class Tally:
    """How many cases ended in each status, the first message of each, and the seconds of all solves together.

    `improved` are those that were begun from beyond a jump of the cost and won by it; beside `jumps` one is left.
    """

    counts: Mapping[str, int] = field(default_factory=dict)
    messages: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    improved: int = 0
    jumps: int = 0

    def __add__(self, other: Tally) -> Tally:
        """Both together; messages of the first count."""
        counts = {key: self.counts.get(key, 0) + other.counts.get(key, 0) for key in {**self.counts, **other.counts}}
        sums = (self.seconds + other.seconds, self.improved + other.improved, self.jumps + other.jumps)
        return Tally(counts, {**other.messages, **self.messages}, *sums)

    @property
    def cases(self) -> int:
        """How many cases have been counted."""
        return sum(self.counts.values())

    @property
    def solved(self) -> int:
        """How many are solved."""
        return self.counts.get(SOLVED, 0)

    @property
    def failed(self) -> dict[str, int]:
        """How many are not, by status, the most frequent first."""
        rest = ((status, count) for status, count in self.counts.items() if status != SOLVED)
        return dict(sorted(rest, key=lambda pair: (-pair[1], pair[0])))

    def as_record(self) -> dict[str, Any]:
        """The tally as an object of JSON, which `from_record` reads."""
        return {"counts": dict(self.counts), "messages": dict(self.messages), "seconds": self.seconds, **self.won}

    @property
    def won(self) -> dict[str, int]:
        """What there is to say of jumps of the cost: nothing where there were none."""
        named = {"improved": self.improved, "jumps": self.jumps}
        return {name: number for name, number in named.items() if number}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Tally:
        """The tally that a record tells; KeyError, TypeError or ValueError where it tells none."""
        counts = {str(status): int(count) for status, count in dict(record["counts"]).items()}
        messages = {str(status): str(message) for status, message in dict(record["messages"]).items()}
        jumps = (int(record.get(name, 0)) for name in ("improved", "jumps"))
        return Tally(counts, messages, float(record["seconds"]), *jumps)


def counted(number: int, what: str) -> str:
    """A number and what is counted, in the singular or the plural."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def table_of(tally: Tally) -> Table:
    """A line for every status, with one of its messages."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("status", no_wrap=True)
    table.add_column("cases", justify="right")
    table.add_column("for example")
    for status, count in {SOLVED: tally.solved, **tally.failed}.items():
        style = "green" if status == SOLVED else "bold red"
        example = "" if status == SOLVED else escape(clause(tally.messages.get(status, "")))
        table.add_row(f"[{style}]{status}[/]", str(count), example)
    return table


class Abandoned(Exception):
    """Nobody wants the chunk any longer."""


@dataclass(frozen=True)
class Done:
    """A chunk that is finished: how its cases ended, what is to be handed over of them if anything is, and notes."""

    tally: Tally
    rows: Any = None
    notes: tuple[str, ...] = ()


class Work(Protocol):
    """All that doing any chunk needs."""

    def loaded(self) -> Work:
        """The same; what takes long once in a process, such as reading machine code, has been done in this one."""

    def piece(self, number: int) -> Any:
        """What a chunk needs beside the work; as small as the chunk."""

    def solve(self, piece: Any, is_wanted: Callable[[], bool] = ...) -> Done:
        """Do a chunk and leave what is to be left; raises Abandoned as soon as it is no longer wanted.

        What fails in a single case is part of the result; what ends everything is raised.
        """

    def lost(self, number: int, reason: str) -> Done:
        """A chunk of which nothing came."""

    def parcel(self) -> Parcel:
        """The work as it is sent to other machines, without its cases; ArgumentError where it cannot be sent."""

    def returned(self, number: int, done: Done) -> Done:
        """Keep, in the process that gave the orders, what a worker elsewhere could not leave where it belongs."""


class Parcel(Protocol):
    """Work on its way to another machine. Machine code belongs to a processor, and is never sent."""

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """The work, ready to do pieces here, and what is to be said of this machine; CodegenError if it cannot be."""


@dataclass(frozen=True)
class Target:
    """What machine code is made for: the processor, what it can do as a digest, and the versions."""

    processor: str
    features: str
    numba: str
    python: str

    def __str__(self) -> str:
        return f"{self.processor} with numba {self.numba}"


def target() -> Target:
    """That of this machine."""
    import numba
    from llvmlite import binding

    settings: Any = numba.config
    processor = settings.CPU_NAME or binding.get_host_cpu_name()
    features = settings.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    if processor == "generic":  # what numba then takes
        features = ""
    digest = hashlib.sha256(str(features).encode()).hexdigest()[:8]
    return Target(str(processor), digest, numba.__version__, platform.python_version())


def compiled_note(module: str, here: Target, origin: Target, work: str) -> str:
    """What is said where a worker had to compile a module; `work` is what was begun on another machine."""
    reason = "" if here == origin else f"; {work} was begun on {origin}"
    return f"{platform.node()}: compiled {module} for {here}{reason}"


def workers_folder() -> Path:
    """Where this machine keeps what its workers share."""
    return cache_folder() / "workers"


@contextmanager
def alone(name: str) -> Iterator[None]:
    """One process of this machine after the other, where the system can tell them to wait."""
    folder = workers_folder()
    try:
        with _lock_file(folder, name) as file:
            with suppress(ImportError, OSError):  # without it all compile, and find the same
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        remedy = f"let CODEGEN_CACHE_DIR name a folder that may be written to on {platform.node()}"
        raise refused(error, folder, remedy) from error


@contextmanager
def only_one(name: str, taken: CodegenError) -> Iterator[None]:
    """One process of this machine, and for others an error; whatever ends a process, its lock ends with it."""
    try:
        file = _lock_file(workers_folder(), name)
    except OSError:  # where nothing can be written to the cache, nobody can be told
        yield
        return
    with file:
        if _is_locked(file):
            raise taken
        yield


def _lock_file(folder: Path, name: str) -> TextIO:
    folder.mkdir(parents=True, exist_ok=True)
    return (folder / f"{hashlib.sha256(name.encode()).hexdigest()[:20]}.lock").open("a")


def _is_locked(file: TextIO) -> bool:
    """Whether another process has the file; else this one has it now, and its forks do not inherit it."""
    with suppress(ImportError):
        import fcntl

        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:  # others than these come from disks without locks
            return error.errno in (errno.EACCES, errno.EAGAIN)
    return False


def journal_of(path: Path) -> Path:
    """The file beside a store, or a table, that is filled part by part."""
    return path.with_name(f"{path.name}.journal")


@dataclass(frozen=True)
class Journal:
    """A file of lines, its header, and the lines that it had when it was opened."""

    path: Path
    header: Mapping[str, Any]
    records: tuple[dict[str, Any], ...] = ()

    def add(self, records: Iterable[Mapping[str, Any]]) -> None:
        """Note parts that are whole; FileError when the file system refuses."""
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write("".join(json.dumps(record) + "\n" for record in records))
        except OSError as error:
            raise refused(error, self.path) from error


def new_journal(path: Path, header: Mapping[str, Any]) -> Journal:
    """A new journal, in which nothing is noted."""
    write_text(path, json.dumps(header) + "\n")
    return Journal(path, header)


def read_journal(path: Path, kind: str, digest: str, another: str) -> Journal:
    """The journal of work of a kind that was begun; ArgumentError where it is that of another, or none.

    `another` is what to do in that case. A line at the end that is not whole is taken away, so that the next one does
    not go on in it.
    """
    # The lines that are whole, of which there is at least one.
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError):
        raise ArgumentError(f"--resume: {path} cannot be read", another) from None
    found = []
    for line in lines:
        if not line.endswith("\n"):
            break
        try:
            found.append(json.loads(line))
        except ValueError:
            raise damaged_journal(path) from None
    if not found or not all(isinstance(record, dict) for record in found):
        raise damaged_journal(path)
    header, *records = found
    if header.get(kind) != digest:
        raise ArgumentError(f"--resume: {path} tells of another {kind}", another)
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        os.truncate(path, whole)
    return Journal(path, header, tuple(records))


def damaged_journal(path: Path) -> ArgumentError:
    """The error of a journal whose lines are none of ours."""
    return ArgumentError(f"--resume: {path} is damaged", "begin anew under another name")
