"""The work of a batch: registering the pairs of a chunk, in whatever process, and what is said of each.

Images and landmarks travel as paths, and whoever does a pair writes its outputs: workers on other machines need the
file system of the one that began the batch.
"""

from __future__ import annotations

import csv
import hashlib
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from codegen import __version__
from codegen.batch.executors.chunks import LOST, SOLVED, Abandoned, Done, Tally, Target, alone, compiled_note, target
from codegen.errors import ClusterError, CodegenError, FileError, one_line
from codegen.files import replacing
from codegen.registration.fields import written_with
from codegen.registration.job import run
from codegen.registration.jobs import Job, Options
from codegen.registration.solver import is_compiled, registration_module, threads_at_most
from codegen.solving import loading

SUMMARY = "summary.csv"
COLUMNS = (
    "moving", "fixed", "landmarks", "out", "status", "message", "count", "align", "sigma", "steps", "interpolation",
    "unit", "residual", "residual_length", "length_unit",
    "det_min", "det_max", "folded", "round_trip", "leave_one_out", "outliers", "seconds", "options",
    "read", "written",
)  # fmt: skip
"""The last ones are digests: of the options and versions, of all that was read, and of each file that was written."""
_DIGITS = 32

Line = dict[str, str]
"""One line of the summary: texts under COLUMNS."""


@dataclass(frozen=True)
class Digests:
    """What a line holds to tell later whether its pair is whole: digests by their columns, empty if there is none."""

    options: str = ""
    read: str = ""
    written: str = ""


def line_of(record: Mapping[str, Any], digests: Digests) -> Line:
    """The line for the record of a job; empty where a pair has no such number."""
    seen = {**record, **record["summary"]}
    errors = seen.get("leave_one_out") or []
    values: dict[str, Any] = {name: seen.get(name) for name in COLUMNS}
    values |= {
        "landmarks": ";".join(record["landmarks"]),
        "message": one_line(record["message"], 300),
        "count": record["summary"].get("landmarks"),
        "residual_length": max(seen["residual_lengths"]) if "length_unit" in seen else None,
        "leave_one_out": sorted(errors)[len(errors) // 2] if errors and None not in errors else None,
        "outliers": ";".join(seen.get("outliers") or []),
        "seconds": round(sum(record["seconds"].values()), 3),
        **asdict(digests),
    }
    return {name: "" if value is None else str(value) for name, value in values.items()}


def failed_line(job: Job, status: str, message: str, digests: Digests) -> Line:
    """The line of a pair of which nothing came."""
    named = {"moving": str(job.moving), "fixed": str(job.fixed or ""), "out": str(job.out)}
    files = {"landmarks": [str(path) for path in job.landmarks]}
    return line_of({**named, **files, "status": status, "message": message, "summary": {}, "seconds": {}}, digests)


def is_whole(line: Line, job: Job, now: Digests) -> bool:
    """Whether a line tells that a pair was solved from what it is made from now, and all that it made is still there.

    Outputs that were written then and are no longer asked for may be missing.
    """
    if line.get("status") != SOLVED or not now.read or (line["options"], line["read"]) != (now.options, now.read):
        return False
    then = dict(word.partition(":")[::2] for word in line.get("written", "").split())
    return all(then.get(kind) == digest for kind, digest in _digests(job).items())


def read_by(job: Job) -> str:
    """A digest of everything that is read, which outputs depend on beside options; empty where a file cannot be."""
    digests = [_digest(path) for path in job.read]
    if not all(digests):
        return ""
    names = [path.name for path in job.read]  # TPS files name images
    own = [] if job.interpolation is None else [job.interpolation]
    return hashlib.sha256(repr((digests, names, *own)).encode()).hexdigest()[:_DIGITS]


def options_digest(options: Options) -> str:
    """What tells a batch from one with other options, or by another version."""
    return hashlib.sha256(repr((__version__, sorted(asdict(options).items()))).encode()).hexdigest()[:_DIGITS]


def written_by(job: Job) -> str:
    """The outputs of a job by their kinds, with digests: the column `written`."""
    return " ".join(f"{kind}:{digest}" for kind, digest in _digests(job).items())


def _digests(job: Job) -> dict[str, str]:
    """A digest of every output that a job has; empty for what is missing, which no line tells."""
    samples = {f"{name}-samples": written_with(path) for name, path in (("out", job.out), ("field", job.field)) if path}
    places = {"out": job.out, "field": job.field, "report": job.report, **samples}
    return {kind: _digest(path) for kind, path in places.items() if path is not None}


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:_DIGITS]
    except OSError:
        return ""


def tally_of(lines: Iterable[Line]) -> Tally:
    """How pairs ended, with a message for each way."""
    lines = [*lines]
    messages = {line["status"]: line["message"] for line in reversed(lines)}  # the first of each
    seconds = sum(float(line["seconds"] or 0.0) for line in lines)
    return Tally(Counter(line["status"] for line in lines), messages, seconds)


def read_summary(path: Path) -> list[Line]:
    """The lines of an earlier run; none where the file is not one of ours."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                return []
            return [line for line in reader if None not in line and None not in line.values()]
    except (OSError, UnicodeDecodeError, csv.Error):
        return []


def write_summary(path: Path, lines: Iterable[Line]) -> None:
    """Replace the table as a whole; FileError when the file system refuses."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS)
        writer.writeheader()
        writer.writerows(lines)


@dataclass(frozen=True)
class Pair:
    """The files of a pair, with absolute names, and the line that it left before, empty if there is none."""

    number: int
    job: Job
    earlier: Line


@dataclass(frozen=True)
class Tried:
    """The line of a pair, and whether it is a new one: what was solved before is left alone where it is whole."""

    number: int
    line: Line
    is_new: bool


@dataclass(frozen=True)
class Piece:
    """The pairs of a chunk, and which of their files could be read where the batch was begun."""

    pairs: tuple[Pair, ...]
    readable: frozenset[Path]


@dataclass(frozen=True)
class Place:
    """A file of the batch, by which a worker finds out whether it sees the same file system."""

    path: Path
    mark: int

    @classmethod
    def of(cls, path: Path) -> Place:
        """That of a file which is there."""
        return cls(path, path.stat().st_ino)

    @property
    def is_here(self) -> bool:
        """Whether it is the same file in this process."""
        try:
            return self.path.stat().st_ino == self.mark
        except OSError:
            return False


@dataclass(frozen=True, eq=False)
class BatchWork:
    """All that registering any pair needs; `size` pairs are a chunk, and `threads` carry the pixels of one.

    `dimensions` are those of the pairs, `place` is a file that workers elsewhere must see, and `is_elsewhere` tells
    that this is one of them.
    """

    pairs: Sequence[Pair]
    options: Options
    size: int
    threads: int
    place: Place
    dimensions: tuple[int, ...] = (2,)
    is_elsewhere: bool = False
    run_one: Callable[[Job, Options], Any] = run

    @property
    def digest(self) -> str:
        """That of the options."""
        return options_digest(self.options)

    @property
    def chunks(self) -> range:
        """The numbers of all chunks."""
        return range(-(-len(self.pairs) // self.size))

    def loaded(self) -> BatchWork:
        """The same; the solvers are loaded in this process."""
        for dimension in self.dimensions:
            registration_module(self.options.scheme, dimension)
        return self

    def piece(self, number: int) -> Piece:
        """The pairs of a chunk."""
        pairs = tuple(self.pairs[number * self.size : (number + 1) * self.size])
        return Piece(pairs, frozenset(path for pair in pairs for path in pair.job.read if path.is_file()))

    def solve(self, piece: Piece, is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """Register the pairs of a chunk that are not whole; a pair that fails leaves a line that says why.

        Raises Abandoned as soon as it is no longer wanted, FileError where the file system refuses outputs, which it
        would do for all pairs, and ClusterError where this machine does not see a file that it should.
        """
        tried = []
        with threads_at_most(self.threads):
            for pair in piece.pairs:
                if not is_wanted():
                    raise Abandoned
                if self.is_elsewhere:
                    _require_seen(pair.job, piece.readable)
                tried.append(self._tried(pair))
        return _finished(tried)

    def lost(self, number: int, reason: str) -> Done:
        """A chunk whose processes ended, one after the other."""
        pairs = self.pairs[number * self.size : (number + 1) * self.size]
        digests = Digests(self.digest)
        return _finished([Tried(own.number, failed_line(own.job, LOST, reason, digests), True) for own in pairs])

    def returned(self, number: int, done: Done) -> Done:
        """What a worker has done is where it belongs."""
        return done

    def parcel(self) -> BatchParcel:
        """The work without its pairs."""
        return BatchParcel(replace(self, pairs=()), self.digest_of_solvers(), target())

    def digest_of_solvers(self) -> str:
        """That of the texts of all solvers."""
        modules: list[Any] = [registration_module(self.options.scheme, dimension) for dimension in self.dimensions]
        return hashlib.sha256(b"".join(Path(module.__file__).read_bytes() for module in modules)).hexdigest()

    def _tried(self, pair: Pair) -> Tried:
        job, now = pair.job, Digests(self.digest, read_by(pair.job))
        if is_whole(pair.earlier, job, now):
            return Tried(pair.number, pair.earlier, False)
        try:
            record = self.run_one(job, self.options).record
            return Tried(pair.number, line_of(record, replace(now, written=written_by(job))), True)
        except FileError:
            raise
        except CodegenError as error:
            status, message = "wrong input", str(error)
        except MemoryError:
            message = "there is not enough memory for this pair; give smaller images, or fewer workers"
            status = "out of memory"
        except Exception as error:  # one pair must not end a night's work; it is reported and the exit status is 1
            message = f"{type(error).__name__}: {error}; this is a defect of codegen, please report it"
            status = "defect"
        return Tried(pair.number, failed_line(job, status, message, now), True)


@dataclass(frozen=True, eq=False)
class BatchParcel:
    """A batch on its way to another machine, which derives the solver by itself: the digest of its text, and whence."""

    work: BatchWork
    digest: str
    origin: Target

    def unpacked(self) -> tuple[BatchWork, tuple[str, ...]]:
        """The work, ready to do pieces here; ClusterError where files or versions are not those of the batch."""
        if not self.work.place.is_here:
            raise _unseen(self.work.place.path)
        scheme, dimensions = self.work.options.scheme, self.work.dimensions
        with alone(f"registration {scheme}"):
            were_compiled = all(is_compiled(scheme, dimension) for dimension in dimensions)
            modules: list[Any] = [registration_module(scheme, dimension) for dimension in dimensions]
        if self.work.digest_of_solvers() != self.digest:
            remedy = "install the same versions of variational-codegen and sympy for all workers"
            raise ClusterError(f"{platform.node()} derives another solver of registrations", remedy)
        notes: tuple[str, ...] = ()
        if not were_compiled or any(loading.machine_code_counts(module)[0] for module in modules):
            name = Path(modules[0].__file__).stem
            notes = (compiled_note(name, target(), self.origin, "the batch"),)
        return replace(self.work, is_elsewhere=True), notes


def _finished(tried: Sequence[Tried]) -> Done:
    return Done(tally_of(own.line for own in tried), tuple(tried))


def _require_seen(job: Job, readable: frozenset[Path]) -> None:
    """Refuse to go on where a file is missing that is there for the process which gave the orders."""
    for path in job.read:
        if path in readable and not path.is_file():
            raise _unseen(path)


def _unseen(path: Path) -> ClusterError:
    finding = f"the worker on {platform.node()} does not see {path}"
    return ClusterError(finding, "images travel as paths: give all workers the file system of this machine")
