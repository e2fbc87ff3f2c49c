"""The pairs of a batch: the search for files that belong together, the registration of chunks, and the summary.

A folder or a table names the images: pictures or volumes. Workers receive images and landmarks as paths, and write the
outputs. Workers on other machines therefore need the file system of the machine that starts the batch.
"""

from __future__ import annotations

import csv
import hashlib
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import get_args

from codegen import __version__
from codegen.batch.executors import LOST, SOLVED, Abandoned, Done, Tally
from codegen.errors import ArgumentError, ClusterError, CodegenError, FileError, one_line
from codegen.files import alone, refused, replacing
from codegen.registration.formats import FORMATS
from codegen.registration.images import KINDS, VOLUMES
from codegen.registration.job import Job, Options, run
from codegen.registration.pair_report import Outcome, Record
from codegen.registration.solver import is_compiled, registration_module, threads_at_most
from codegen.registration.volumes import is_volume, suffix_of
from codegen.registration.warp import Interpolation, written_with
from codegen.solving import loading
from codegen.solving.compiler import workers_folder
from codegen.solving.machine_code.processes import Target, compiled_note, target

MOST_PAIRS = 100_000
_TABLE = ("moving", "fixed", "landmarks", "out", "interpolation")
_OUTPUT_SUFFIXES = {".nhdr": ".nrrd"}
"""Suffixes of volumes that can be read but not written, and the suffixes of their outputs."""

SUMMARY = "summary.csv"
COLUMNS = (
    "moving", "fixed", "landmarks", "out", "status", "message", "count", "align", "sigma", "steps", "interpolation",
    "unit", "residual", "residual_length", "length_unit",
    "det_min", "det_max", "folded", "round_trip", "leave_one_out", "outliers", "seconds", "options",
    "read", "written",
)  # fmt: skip
"""Columns of the summary. The last three hold digests: of options and version, of all inputs, and of each output."""
_DIGITS = 32

Line = dict[str, str]  # one line of the summary: a text for each name in COLUMNS


@dataclass(frozen=True)
class Places:
    """The folders of warped images, displacement fields and reports; None for unwanted fields or reports."""

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
        """Return the job of one pair, with its outputs named after `out`, or after the moving image if `out` is None.

        Displacement fields of pictures are .npz files, displacement fields of volumes are .nii.gz files.
        """
        if out is None:
            suffix = moving.name[len(_stem(moving)) :]
            out = (self.out or Path()) / f"{_stem(moving)}{_OUTPUT_SUFFIXES.get(suffix.lower(), suffix)}"
        kind = ".nii.gz" if self.field is not None and is_volume(moving) else ".npz"
        field = self.field / f"{_stem(out)}{kind}" if self.field is not None else None
        report = self.report / f"{_stem(out)}.html" if self.report is not None else None
        return Job(moving, landmarks, out, fixed, field, report, interpolation)

    def make(self) -> None:
        """Make the missing folders; raises FileError if the file system refuses."""
        for folder in (self.out, self.field, self.report):
            if folder is not None:
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise refused(error, folder) from error


def _stem(image: Path) -> str:
    suffix = suffix_of(image, VOLUMES)
    return image.stem if suffix is None else image.name[: -len(suffix)]


def jobs_in_folder(
    folder: Path, places: Places, fixed: Path | None, landmarks: tuple[Path, ...]
) -> tuple[list[Job], list[Path]]:
    """Return the jobs for the images of a folder, and the list of images without landmark files.

    Every image is paired with `landmarks`, or, if empty, with files of the same stem. `a.png` or `a.nii.gz` belongs to
    `a.csv`, to `a.tps`, or to `a.moving.pts` with `a.fixed.pts`; `.mrk.json` and `.fcsv` may replace `.pts`. `fixed` is
    the fixed image of all pairs, or a folder with fixed images of the same names. Raises ArgumentError if the folder
    has no pair, or if landmark files of two kinds belong to one image.
    """
    suffixes = (*(suffix for group in KINDS.values() for suffix in group), *VOLUMES)
    images = sorted(path for path in folder.iterdir() if path.name.lower().endswith(suffixes) and path.is_file())
    jobs, without = [], []
    for image in images:
        files, stem = landmarks, _stem(image)
        if not files:
            candidates = []
            for suffix, number in dict.fromkeys((form.suffixes[0], form.files) for form in FORMATS.values()):
                sides = ("",) if number == 1 else (".moving", ".fixed")
                paths = tuple(image.with_name(stem + side + suffix) for side in sides)
                candidates += [paths] if all(path.is_file() for path in paths) else []
            if len(candidates) > 1:
                finding = f"{folder}: {' and '.join(paths[0].name for paths in candidates)} both belong to {image.name}"
                raise ArgumentError(finding, "leave one of them in the folder")
            files = candidates[0] if candidates else ()
        if fixed is not None and fixed.is_file() and fixed.samefile(image):
            continue
        if files:
            jobs.append(places.job(image, files, fixed / image.name if fixed is not None and fixed.is_dir() else fixed))
        else:
            without.append(image)
    if not jobs:
        count = f"{len(images)} image{'s' * (len(images) != 1)}"
        finding = f"{folder} holds {count}, none with a landmark file of the same name"
        raise ArgumentError(finding, "name landmarks like images, such as a.png and a.csv, or give --landmarks")
    return _distinct(jobs), without


def jobs_in_table(table: Path, places: Places, fixed: Path | None) -> list[Job]:
    """Return the jobs of a CSV table with the columns moving and landmarks, and optionally fixed, out, interpolation.

    File names are relative to the folder of the table. A semicolon separates two landmark files of one pair. `fixed` is
    for rows without a fixed image. An interpolation holds for its row only. Raises ArgumentError, naming the line.
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
        name, choices = row.get("interpolation", ""), get_args(Interpolation)
        interpolation: Interpolation | None = next((choice for choice in choices if choice == name), None)
        if name and interpolation is None:
            finding = f"{table}:{line}: unknown interpolation {name!r}"
            raise ArgumentError(finding, f"fill in one of {', '.join(choices)}")
        jobs.append(places.job(table.parent / moving, files, other, out, interpolation))
    if not jobs:
        raise ArgumentError(f"{table} holds no pairs", "give one row for every pair")
    return _distinct(jobs)


def _rows(table: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the line number and the values, by column, of each row of a CSV table; ArgumentError if it is invalid."""
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
    """Return the jobs; raise ArgumentError if two of them would write the same file."""
    seen: dict[Path, Job] = {}
    for job in jobs:
        for path in job.written:
            other = seen.setdefault(path.absolute(), job)
            if other is not job:
                finding = f"{other.moving} and {job.moving} would both be written to {path}"
                raise ArgumentError(finding, "give images different names, or an out for each in a table")
    return jobs


def require_free(jobs: Iterable[Job], path: Path) -> None:
    """Raise ArgumentError if a job would write `path`, the page of the batch."""
    for job in jobs:
        if path.absolute() in (file.absolute() for file in job.written):
            finding = f"{path} is the page about all pairs, and that of {job.moving}"
            raise ArgumentError(finding, "rename the image, or give it another out in a table")


def options_digest(options: Options) -> str:
    """Return a digest of the options and of the version of this package."""
    return hashlib.sha256(repr((__version__, sorted(asdict(options).items()))).encode()).hexdigest()[:_DIGITS]


def _output_digests(job: Job) -> dict[str, str]:
    """Return the digest of each output file of a job, by kind of output; an empty text for a missing file."""
    samples = {f"{name}-samples": written_with(path) for name, path in (("out", job.out), ("field", job.field)) if path}
    files = {"out": job.out, "field": job.field, "report": job.report, **samples}
    return {kind: _digest(path) for kind, path in files.items() if path is not None}


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:_DIGITS]
    except OSError:
        return ""


def _line(record: Record, digests: Line) -> Line:
    """Return the summary line for the record of a job and the digests; missing numbers are empty texts."""
    values = {**record, **record["summary"]}
    errors = values.get("leave_one_out") or []
    texts: dict[str, object] = {name: values.get(name) for name in COLUMNS}
    texts |= {
        "landmarks": ";".join(record["landmarks"]),
        "message": one_line(record["message"], 300),
        "count": record["summary"].get("landmarks"),
        "residual_length": max(values["residual_lengths"]) if "length_unit" in values else None,
        "leave_one_out": sorted(errors)[len(errors) // 2] if errors and None not in errors else None,
        "outliers": ";".join(values.get("outliers") or []),
        "seconds": round(sum(record["seconds"].values()), 3),
        **digests,
    }
    return {name: "" if value is None else str(value) for name, value in texts.items()}


def _failed_line(job: Job, status: str, message: str, digests: Line) -> Line:
    """Return the summary line of a pair without a result."""
    record: Record = {
        "moving": str(job.moving), "fixed": str(job.fixed or ""), "out": str(job.out),
        "landmarks": [str(path) for path in job.landmarks], "status": status, "message": message, "summary": {},
        "seconds": {},
    }  # fmt: skip
    return _line(record, digests)


def tally_of(lines: Iterable[Line]) -> Tally:
    """Return the number of lines with each status, the first message of each status, and the total time."""
    rows = [(line["status"], line["message"], float(line["seconds"] or 0.0)) for line in lines]
    return Tally.of([row[0] for row in rows], [row[1] for row in rows], sum(row[2] for row in rows))


def read_summary(path: Path) -> list[Line]:
    """Return the lines of an earlier summary; an empty list if the file is missing or is no summary."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                return []
            return [line for line in reader if None not in line and None not in line.values()]
    except (OSError, UnicodeDecodeError, csv.Error):
        return []


def write_summary(path: Path, lines: Iterable[Line]) -> None:
    """Write the summary over an earlier one; raises FileError if the file system refuses."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS)
        writer.writeheader()
        writer.writerows(lines)


@dataclass(frozen=True)
class Pair:
    """A pair: its number in the batch, its files (absolute paths), and its line of an earlier run, or an empty dict."""

    number: int
    job: Job
    earlier: Line


@dataclass(frozen=True)
class Tried:
    """The summary line of a pair by its number; `is_new` is False if the pair was up to date and was skipped."""

    number: int
    line: Line
    is_new: bool


@dataclass(frozen=True)
class Piece:
    """The pairs of a chunk, and those input files that exist on the machine that started the batch."""

    pairs: tuple[Pair, ...]
    readable: frozenset[Path]


@dataclass(frozen=True)
class SharedFile:
    """A file by whose inode number a worker checks that it uses the file system of the batch."""

    path: Path
    inode: int

    @classmethod
    def of(cls, path: Path) -> SharedFile:
        """Return the path and the inode number of an existing file."""
        return cls(path, path.stat().st_ino)

    @property
    def is_visible(self) -> bool:
        """True if this process sees the same file."""
        try:
            return self.path.stat().st_ino == self.inode
        except OSError:
            return False


@dataclass(frozen=True, eq=False)
class BatchWork:
    """The pairs and options for the workers of an executor; a chunk has `size` pairs, each registered by `threads`.

    `dimensions` has 2 if there are pictures and 3 if there are volumes. Workers on other machines, where `is_remote` is
    True, must see the file `shared`. `run_one` registers one pair.
    """

    pairs: Sequence[Pair]
    options: Options
    size: int
    threads: int
    shared: SharedFile
    dimensions: tuple[int, ...] = (2,)
    is_remote: bool = False
    run_one: Callable[[Job, Options], Outcome] = run
    is_compiled = False  # images are read, warped and written by Python code

    @property
    def chunks(self) -> range:
        """The numbers of all chunks."""
        return range(-(-len(self.pairs) // self.size))

    def loaded(self) -> BatchWork:
        """Load the compiled solvers in this process, and return this work."""
        for dimension in self.dimensions:
            registration_module(self.options.scheme, dimension)
        return self

    def piece(self, number: int) -> Piece:
        """Return the pairs of the chunk with this number."""
        pairs = tuple(self.pairs[number * self.size : (number + 1) * self.size])
        return Piece(pairs, frozenset(path for pair in pairs for path in pair.job.read if path.is_file()))

    def solve(self, piece: Piece, is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """Register the pairs of a chunk that are not up to date, and return their summary lines.

        The line of a failed pair has the reason. Raises Abandoned as soon as `is_wanted` returns False, FileError if
        the file system refuses an output, and ClusterError if this machine does not see an input file.
        """
        tried = []
        with threads_at_most(self.threads):
            for pair in piece.pairs:
                if not is_wanted():
                    raise Abandoned
                if self.is_remote:
                    for path in pair.job.read:
                        if path in piece.readable and not path.is_file():
                            raise _unseen(path)
                tried.append(self._tried(pair))
        return _done(tried)

    def lost(self, number: int, reason: str) -> Done:
        """Return failed lines for a chunk whose worker processes ended repeatedly."""
        digests, pairs = {"options": options_digest(self.options)}, self.piece(number).pairs
        return _done([Tried(pair.number, _failed_line(pair.job, LOST, reason, digests), True) for pair in pairs])

    def returned(self, number: int, done: Done) -> Done:
        """Return the result of a worker unchanged: the worker has written the output files."""
        return done

    def parcel(self) -> BatchParcel:
        """Return the work without its pairs, to send it to another machine."""
        return BatchParcel(replace(self, pairs=()), self.digest_of_solvers(), target())

    def digest_of_solvers(self) -> str:
        """Return a digest of the source code of the generated solvers."""
        modules = [registration_module(self.options.scheme, dimension) for dimension in self.dimensions]
        return hashlib.sha256(b"".join(Path(module.__file__).read_bytes() for module in modules)).hexdigest()

    def _tried(self, pair: Pair) -> Tried:
        """Return the earlier line if the pair is up to date; otherwise register the pair and return a new line."""
        job, earlier = pair.job, pair.earlier
        # `read` is a digest of all input files and of the interpolation; empty if a file is not readable.
        files, read = [_digest(path) for path in job.read], ""
        if all(files):
            names = [path.name for path in job.read]  # TPS files contain names of images
            interpolation = [] if job.interpolation is None else [job.interpolation]
            read = hashlib.sha256(repr((files, names, *interpolation)).encode()).hexdigest()[:_DIGITS]
        digests = {"options": options_digest(self.options), "read": read}
        if (
            earlier.get("status") == SOLVED
            and read
            and (earlier["options"], earlier["read"]) == (digests["options"], read)
        ):
            # Only the outputs that are requested now are compared: others of the earlier run may be missing.
            before = dict(word.partition(":")[::2] for word in earlier.get("written", "").split())
            if all(before.get(kind) == digest for kind, digest in _output_digests(job).items()):
                return Tried(pair.number, earlier, False)
        try:
            record = self.run_one(job, self.options).record
            written = " ".join(f"{kind}:{digest}" for kind, digest in _output_digests(job).items())
            return Tried(pair.number, _line(record, digests | {"written": written}), True)
        except FileError:
            raise
        except CodegenError as error:
            status, message = "wrong input", str(error)
        except MemoryError:
            message = "there is not enough memory for this pair; give smaller images, or fewer workers"
            status = "out of memory"
        except Exception as error:  # the line reports the defect, and the other pairs go on
            message = f"{type(error).__name__}: {error}; this is a defect of codegen, please report it"
            status = "defect"
        return Tried(pair.number, _failed_line(job, status, message, digests), True)


@dataclass(frozen=True, eq=False)
class BatchParcel:
    """A batch for another machine; `digest` identifies the generated solvers, `origin` the machine of the batch."""

    work: BatchWork
    digest: str
    origin: Target

    def unpacked(self) -> tuple[BatchWork, tuple[str, ...]]:
        """Return the work, ready on this machine, and notes; ClusterError if files or solvers differ from the batch."""
        if not self.work.shared.is_visible:
            raise _unseen(self.work.shared.path)
        scheme, dimensions = self.work.options.scheme, self.work.dimensions
        with alone(workers_folder(), f"registration {scheme}"):
            were_compiled = all(is_compiled(scheme, dimension) for dimension in dimensions)
            modules = [registration_module(scheme, dimension) for dimension in dimensions]
        if self.work.digest_of_solvers() != self.digest:
            remedy = "install the same versions of variational-codegen and sympy for all workers"
            raise ClusterError(f"{platform.node()} derives another solver of registrations", remedy)
        notes: tuple[str, ...] = ()
        if not were_compiled or any(loading.machine_code_counts(module)[0] for module in modules):
            name = Path(modules[0].__file__).stem
            notes = (compiled_note(name, self.origin, "the batch"),)
        return replace(self.work, is_remote=True), notes


def _done(tried: Sequence[Tried]) -> Done:
    return Done(tally_of(pair.line for pair in tried), tuple(tried))


def _unseen(path: Path) -> ClusterError:
    finding = f"the worker on {platform.node()} does not see {path}"
    return ClusterError(finding, "images travel as paths: give all workers the file system of this machine")
