"""The work of a batch: registering the pairs of a chunk, in whatever process, and what is said of each.

Images and landmarks travel as paths, and whoever does a pair writes its outputs: workers on other machines need the
file system of the one that began the batch.

Which files of a folder or of a table belong together, pictures or volumes, and where the outputs of each pair go.
"""

from __future__ import annotations

import csv
import hashlib
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

from codegen import __version__
from codegen.batch.executors.work import LOST, SOLVED, Abandoned, Done, Tally, Target, alone, compiled_note, target
from codegen.errors import ArgumentError, ClusterError, CodegenError, FileError, one_line
from codegen.files import refused, replacing
from codegen.registration.images import KINDS
from codegen.registration.job import Job, Options, run
from codegen.registration.solver import is_compiled, registration_module, threads_at_most
from codegen.registration.volumes import READ, ending, is_volume
from codegen.registration.warp import Interpolation, written_with
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


MOST_PAIRS = 100_000
_SINGLE, _DOUBLE = (".csv", ".tps"), (".pts", ".mrk.json", ".fcsv")
_TABLE = ("moving", "fixed", "landmarks", "out", "interpolation")
_HEADERS = {".nhdr": ".nrrd"}
"""Kinds of volumes that are read and not written, and what is written instead."""


@dataclass(frozen=True)
class Places:
    """Where the outputs of a batch go: folders, which are made where they are missing."""

    out: Path | None = None
    field: Path | None = None
    report: Path | None = None

    def job(
        self,
        moving: Path,
        landmarks: tuple[Path, ...],
        fixed: Path | None,
        out: Path | None = None,
        interpolation: Interpolation | None = None,
    ) -> Job:
        """The job of one pair; its outputs are named after the moving image unless `out` names the image.

        Fields of pictures are .npz, those of volumes .nii.gz.
        """
        out = out or (self.out or Path()) / f"{_stem(moving)}{_written(moving)}"
        kind = ".nii.gz" if self.field is not None and is_volume(moving) else ".npz"
        field = self.field / f"{_stem(out)}{kind}" if self.field is not None else None
        report = self.report / f"{_stem(out)}.html" if self.report is not None else None
        return Job(moving, landmarks, out, fixed, field, report, interpolation)


def _stem(image: Path) -> str:
    kind = ending(image, READ)
    return image.stem if kind is None else image.name[: -len(kind)]


def _written(image: Path) -> str:
    kind = image.name[len(_stem(image)) :]
    return _HEADERS.get(kind.lower(), kind)


def jobs_in_folder(
    folder: Path, places: Places, fixed: Path | None, landmarks: tuple[Path, ...]
) -> tuple[list[Job], list[Path]]:
    """The images and volumes of a folder with landmark files of the same stem, or with `landmarks` all of them.

    The second list are the images that are left out, because they have none.

    `a.png` or `a.nii.gz` belongs to `a.csv`, `a.tps`, `a.moving.pts` with `a.fixed.pts`, or the same with `.mrk.json`
    or `.fcsv`. `fixed` is one image for all, or a folder with images of the same names. Raises ArgumentError
    where there is no pair, or where it is not clear which files belong together.
    """
    kinds = (*(suffix for known in KINDS.values() for suffix in known), *READ)
    images = sorted(path for path in folder.iterdir() if path.name.lower().endswith(kinds) and path.is_file())
    jobs, without = [], []
    for image in images:
        own = landmarks or _landmarks_of(image)
        if fixed is not None and fixed.is_file() and fixed.samefile(image):
            continue
        if own:
            jobs.append(places.job(image, own, fixed / image.name if fixed is not None and fixed.is_dir() else fixed))
        else:
            without.append(image)
    if not jobs:
        finding = (
            f"{folder} holds {len(images)} image{'s' * (len(images) != 1)}, none with a landmark file of the same name"
        )
        raise ArgumentError(finding, "name landmarks like images, such as a.png and a.csv, or give --landmarks")
    return _distinct(jobs), without


def _landmarks_of(image: Path) -> tuple[Path, ...]:
    """The landmark files that belong to an image; none where there are none."""
    found = [(path,) for path in (image.with_name(_stem(image) + suffix) for suffix in _SINGLE) if path.is_file()]
    pairs = (
        tuple(image.with_name(f"{_stem(image)}.{side}{suffix}") for side in ("moving", "fixed")) for suffix in _DOUBLE
    )
    candidates: list[tuple[Path, ...]] = [*found, *(pair for pair in pairs if all(path.is_file() for path in pair))]
    if len(candidates) > 1:
        names = " and ".join(files[0].name for files in candidates)
        raise ArgumentError(f"{image.parent}: {names} both belong to {image.name}", "leave one of them in the folder")
    return candidates[0] if candidates else ()


def jobs_in_table(table: Path, places: Places, fixed: Path | None) -> list[Job]:
    """The pairs of a table with the columns moving and landmarks, and optionally fixed, out and interpolation.

    An interpolation is that of one pair alone, such as nearest for labels; empty: that of all.
    Names are relative to the table's folder; two landmark files of one pair are separated by a semicolon. Raises
    ArgumentError, naming the line, for what is no such table.
    """
    jobs = []
    for line, row in _rows(table):
        moving, names = row.get("moving", ""), [name for name in row.get("landmarks", "").split(";") if name.strip()]
        if not moving or len(names) not in (1, 2):
            raise ArgumentError(f"{table}:{line}: an image and its landmarks are missing", "fill moving and landmarks")
        out = table.parent / row["out"] if row.get("out") else None
        if out is None and places.out is None:
            raise ArgumentError(f"{table}:{line}: there is no place for the result", "fill out, or give --out FOLDER")
        other = table.parent / row["fixed"] if row.get("fixed") else fixed
        files = tuple(table.parent / name.strip() for name in names)
        jobs.append(places.job(table.parent / moving, files, other, out, _interpolation(table, line, row)))
    if not jobs:
        raise ArgumentError(f"{table} holds no pairs", "give one row for every pair")
    return _distinct(jobs)


def _interpolation(table: Path, line: int, row: dict[str, str]) -> Interpolation | None:
    named = row.get("interpolation", "")
    if not named:
        return None
    choices: tuple[Interpolation, ...] = get_args(Interpolation)
    known = next((own for own in choices if own == named), None)
    if known is None:
        raise ArgumentError(f"{table}:{line}: unknown interpolation {named!r}", f"fill in one of {', '.join(choices)}")
    return known


def _rows(table: Path) -> Iterable[tuple[int, dict[str, str]]]:
    """Lines of the table by their columns, with line numbers."""
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = set(reader.fieldnames or ())
            if not {"moving", "landmarks"} <= header <= set(_TABLE):
                finding = f"{table}: the columns are {','.join(map(str, reader.fieldnames or ()))[:100] or 'missing'}"
                raise ArgumentError(finding, f"name them {','.join(_TABLE)} in the first line")
            for row in reader:
                if None in row or None in row.values():
                    finding = f"{table}:{reader.line_num}: not as many values as columns"
                    raise ArgumentError(finding, f"give {','.join(_TABLE)}, empty where there is none")
                if reader.line_num > MOST_PAIRS:
                    raise ArgumentError(f"{table} holds more than {MOST_PAIRS} lines", "give several tables")
                yield reader.line_num, {name: value.strip() for name, value in row.items()}
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ArgumentError(f"{table} cannot be read ({one_line(str(error), 100)})", "give a table as text") from error


def _distinct(jobs: list[Job]) -> list[Job]:
    """Refuse pairs whose outputs have the same name: the later would replace the earlier."""
    seen: dict[Path, Job] = {}
    for job in jobs:
        for path in job.written:
            other = seen.setdefault(path.absolute(), job)
            if other is not job:
                finding = f"{other.moving} and {job.moving} would both be written to {path}"
                raise ArgumentError(finding, "give images different names, or an out for each in a table")
    return jobs


def require_free(jobs: Iterable[Job], path: Path) -> None:
    """Refuse a pair whose page would take the name of the page about all pairs."""
    for job in jobs:
        if path.absolute() in (place.absolute() for place in job.written):
            finding = f"{path} is the page about all pairs, and that of {job.moving}"
            raise ArgumentError(finding, "rename the image, or give it another out in a table")


def make_folders(places: Places) -> None:
    """Make the folders of the outputs; FileError where the file system refuses."""
    for folder in (places.out, places.field, places.report):
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise refused(error, folder) from error
