"""A line for each pair: what became of it, what it was made from and what it made, and the summary of all lines."""

from __future__ import annotations

import csv
import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from codegen import __version__
from codegen.engines.work import SOLVED, Tally
from codegen.errors import one_line
from codegen.files import replacing
from codegen.registration.fields import written_with
from codegen.registration.jobs import Job, Options

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
