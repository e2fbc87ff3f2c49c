"""The interface of work that executors divide into chunks, the tally of its results, locks and journals.

Work is small and is pickled once for each worker. Chunks are numbered from zero; a worker receives the number of a
chunk, or a piece with its data.

A journal file lists the finished chunks of some work as lines of JSON: a header with the digest of the work, then one
line for each chunk. A line is written after the results of its chunk, so an interrupt loses only chunks in progress.
An incomplete last line is ignored.
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
from codegen.solving.compiler import cache_folder

if TYPE_CHECKING:
    from rich.table import Table

SOLVED = "solved"
LOST = "worker lost"  # status of a case whose chunk ended several worker processes


@dataclass(frozen=True)
class Tally:
    """The number of cases by status, the first message of each status, and the seconds of all solves.

    `improved` counts cases whose cost fell by a new solve from the better side of a jump of the cost. `jumps` counts
    cases on the worse side of a remaining jump.
    """

    counts: Mapping[str, int] = field(default_factory=dict)
    messages: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    improved: int = 0
    jumps: int = 0

    def __add__(self, other: Tally) -> Tally:
        """Return the sum of both tallies; messages of `self` take precedence."""
        counts = {key: self.counts.get(key, 0) + other.counts.get(key, 0) for key in {**self.counts, **other.counts}}
        sums = (self.seconds + other.seconds, self.improved + other.improved, self.jumps + other.jumps)
        return Tally(counts, {**other.messages, **self.messages}, *sums)

    @property
    def cases(self) -> int:
        """Number of cases."""
        return sum(self.counts.values())

    @property
    def solved(self) -> int:
        """Number of solved cases."""
        return self.counts.get(SOLVED, 0)

    @property
    def failed(self) -> dict[str, int]:
        """The number of unsolved cases by status, the most frequent status first."""
        rest = ((status, count) for status, count in self.counts.items() if status != SOLVED)
        return dict(sorted(rest, key=lambda pair: (-pair[1], pair[0])))

    def as_record(self) -> dict[str, object]:
        """Return the tally as a JSON object; `from_record` reads it."""
        return {"counts": dict(self.counts), "messages": dict(self.messages), "seconds": self.seconds, **self.won}

    @property
    def won(self) -> dict[str, int]:
        """The numbers of cases with a better optimum from a neighbour and of jumps between optima, if not zero."""
        named = {"improved": self.improved, "jumps": self.jumps}
        return {name: number for name, number in named.items() if number}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Tally:
        """Return the tally of a JSON object; raises KeyError, TypeError or ValueError for another object."""
        counts = {str(status): int(count) for status, count in dict(record["counts"]).items()}
        messages = {str(status): str(message) for status, message in dict(record["messages"]).items()}
        jumps = (int(record.get(name, 0)) for name in ("improved", "jumps"))
        return Tally(counts, messages, float(record["seconds"]), *jumps)


def counted(number: int, what: str) -> str:
    """Return a text with a number and its noun `what`, in the singular or the plural."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def table_of(tally: Tally) -> Table:
    """Return a table for the terminal, with a row for each status and an example of its messages."""
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
    """The exception of a worker whose result is no longer wanted."""


@dataclass(frozen=True)
class Done:
    """The result of a chunk: the tally, the rows if the worker did not store them, and notes for the user."""

    tally: Tally
    rows: Any = None
    notes: tuple[str, ...] = ()


class Work(Protocol):
    """The interface of work that executors can do."""

    @property
    def is_compiled(self) -> bool:
        """True if nearly all time is spent in compiled code, which holds no lock of the interpreter."""

    def loaded(self) -> Work:
        """Prepare this process for solves, for example load machine code, and return the work."""

    def piece(self, number: int) -> object:
        """Return the data of a chunk that a worker needs in addition to the work."""

    def solve(self, piece: Any, is_wanted: Callable[[], bool] = ...) -> Done:
        """Solve a chunk and store its results; raises Abandoned as soon as `is_wanted` returns False.

        A failed case is part of the result. An error that ends the whole work is raised.
        """

    def lost(self, number: int, reason: str) -> Done:
        """Return the result of a chunk whose workers were lost."""

    def parcel(self) -> Parcel:
        """Return the work for other machines, without its cases; raises ArgumentError if this is impossible."""

    def returned(self, number: int, done: Done) -> Done:
        """Store, in the client process, the rows that a remote worker could not store."""


class Parcel(Protocol):
    """Work on its way to another machine, without machine code, which depends on the processor."""

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """Return the work, ready to solve on this machine, and notes about the machine; raises CodegenError."""


@dataclass(frozen=True)
class Target:
    """The target of machine code: the processor, a digest of its features, and the versions of numba and Python."""

    processor: str
    features: str
    numba: str
    python: str

    def __str__(self) -> str:
        return f"{self.processor} with numba {self.numba}"


def target() -> Target:
    """Return the target of machine code for this machine."""
    import numba
    from llvmlite import binding

    settings: Any = numba.config
    processor = settings.CPU_NAME or binding.get_host_cpu_name()
    features = settings.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    if processor == "generic":  # numba then uses no features
        features = ""
    digest = hashlib.sha256(str(features).encode()).hexdigest()[:8]
    return Target(str(processor), digest, numba.__version__, platform.python_version())


def compiled_note(module: str, local: Target, origin: Target, work: str) -> str:
    """Return a note that a worker compiled a module; `work` names the task that began on the machine `origin`."""
    reason = "" if local == origin else f"; {work} was begun on {origin}"
    return f"{platform.node()}: compiled {module} for {local}{reason}"


def workers_folder() -> Path:
    """Return the cache folder that all worker processes of this machine share."""
    return cache_folder() / "workers"


@contextmanager
def alone(name: str) -> Iterator[None]:
    """Run a block when no other process of this machine has the lock `name`, if the system has file locks."""
    folder = workers_folder()
    try:
        with _lock_file(folder, name) as file:
            with suppress(ImportError, OSError):  # without locks all processes compile, with the same result
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except OSError as error:
        remedy = f"let CODEGEN_CACHE_DIR name a folder that may be written to on {platform.node()}"
        raise refused(error, folder, remedy) from error


@contextmanager
def only_one(name: str, taken: CodegenError) -> Iterator[None]:
    """Run a block with the lock `name`; raise `taken` if another process has the lock, which ends with its process."""
    try:
        file = _lock_file(workers_folder(), name)
    except OSError:  # without a cache folder there is no lock
        yield
        return
    with file:
        with suppress(ImportError):
            import fcntl

            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # forks do not inherit this kind of lock
            except OSError as error:
                if error.errno in (errno.EACCES, errno.EAGAIN):  # disks without locks raise other numbers
                    raise taken from None
        yield


def _lock_file(folder: Path, name: str) -> TextIO:
    folder.mkdir(parents=True, exist_ok=True)
    return (folder / f"{hashlib.sha256(name.encode()).hexdigest()[:20]}.lock").open("a")


def journal_of(path: Path) -> Path:
    """Return the path of the journal of a store or table."""
    return path.with_name(f"{path.name}.journal")


@dataclass(frozen=True)
class Journal:
    """A journal file, its header, and the records that the file had when it was opened."""

    path: Path
    header: Mapping[str, Any]
    records: tuple[dict[str, Any], ...] = ()

    def add(self, records: Iterable[Mapping[str, object]]) -> None:
        """Append records to the file; raises FileError when the file system refuses."""
        try:
            with self.path.open("a", encoding="utf-8", newline="\n") as file:
                file.write("".join(json.dumps(record) + "\n" for record in records))
        except OSError as error:
            raise refused(error, self.path) from error


def new_journal(path: Path, header: Mapping[str, object]) -> Journal:
    """Write and return a journal without records."""
    write_text(path, json.dumps(header) + "\n")
    return Journal(path, header)


def read_journal(path: Path, kind: str, digest: str, another: str) -> Journal:
    """Return the journal in a file whose header maps `kind` to `digest`, and truncate an incomplete last line.

    Raises ArgumentError for a damaged journal, and with the remedy `another` for the journal of other work.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError):
        raise ArgumentError(f"--resume: {path} cannot be read", another) from None
    try:
        complete = [json.loads(line) for line in lines if line.endswith("\n")]  # only the last line can be cut off
    except ValueError:
        raise damaged_journal(path) from None
    if not complete or not all(isinstance(record, dict) for record in complete):
        raise damaged_journal(path)
    header, *records = complete
    if header.get(kind) != digest:
        raise ArgumentError(f"--resume: {path} tells of another {kind}", another)
    data = path.read_bytes()
    complete_bytes = data.rfind(b"\n") + 1
    if complete_bytes < len(data):
        os.truncate(path, complete_bytes)
    return Journal(path, header, tuple(records))


def damaged_journal(path: Path) -> ArgumentError:
    """Return the error for a journal with invalid lines."""
    return ArgumentError(f"--resume: {path} is damaged", "begin anew under another name")
