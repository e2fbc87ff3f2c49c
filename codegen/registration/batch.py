"""The run of a batch of pairs of images, the HTML page of a batch, and its summaries for people and programs.

A batch reads the results of earlier runs, times a first pair and runs chunks of pairs on an executor. The summary has
one line for every pair. A journal next to the summary receives the line of a pair as soon as its outputs are written.
An interruption therefore loses only the pairs in progress. A pair is skipped if an earlier line shows that the pair was
solved from the same files with the same options, and if its outputs are unchanged.
"""

from __future__ import annotations

import math
import os
import urllib.parse
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.batch.executors import LOST, SOLVED, Done, Progress, Tally, Team, connected, silent
from codegen.errors import ArgumentError
from codegen.files import journal_of, new_journal, read_journal, remove_leftovers, rendered, write_text
from codegen.registration import batch_pairs
from codegen.registration.job import Job, Options, run
from codegen.registration.pair_report import Outcome, Record, facts, number
from codegen.registration.solver import registration_module
from codegen.registration.volumes import is_volume
from codegen.solving.progress import Working

if TYPE_CHECKING:
    from rich.table import Table

MOST_OF_A_CHUNK = 64  # largest number of pairs in a chunk
TRIALS = 3
"""Largest number of pairs that are tried, one by one, until a pair is solved. Its time determines the chunk size."""
SHARES = 4  # smallest number of chunks for each worker, so that all workers end at about the same time
BATCH = "batch"  # the key in the header of a journal under which the digest of the options is stored
ANOTHER = "leave --resume out to do all pairs anew, or give the options that it was begun with"

NAME = "index.html"
PAGE_COLUMNS = (
    "pair", "", "landmarks", "steps", "residual", "least det J", "largest det J", "round trip", "left out", "outliers",
    "seconds",
)  # fmt: skip
_NUMBERS = ("residual", "det_min", "det_max", "round_trip", "leave_one_out")


@dataclass(frozen=True)
class BatchRequest:
    """The pairs of a batch, their options, the output folders, the path of the summary, and the workers.

    `resume` continues an earlier run, which must have had the same options. `cluster` is the address of a dask
    scheduler, a dask client, "local" for a dask cluster on this machine, or None to work without dask.
    """

    jobs: Sequence[Job]
    options: Options
    places: batch_pairs.Places
    summary: Path
    workers: int = 1
    cluster: object = None
    resume: bool = False


@dataclass(frozen=True)
class Batch:
    """The result of a batch: a summary line for every pair, the number of skipped pairs, and the notes of workers."""

    lines: tuple[batch_pairs.Line, ...]
    unchanged: int
    notes: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[batch_pairs.Line, ...]:
        """The lines of pairs that were not solved."""
        return tuple(line for line in self.lines if line["status"] != SOLVED)


def outcome_of(
    request: BatchRequest,
    working: Working = nullcontext,
    progress: Progress = silent,
    run_one: Callable[[Job, Options], Outcome] = run,
    prepare: Callable[[str, int], object] = registration_module,
) -> Batch:
    """Register all pairs that are not up to date, write the summary and return the result.

    The line of a failed pair has the reason; the other pairs go on. `prepare` builds the solver for a scheme and a
    dimension. Raises CodegenError for a wrong request, before anything is written. Problems of every pair are raised,
    too: an unusable scheme, a refused write, or a worker that does not see the files.
    """
    digest, before = batch_pairs.options_digest(request.options), batch_pairs.read_summary(request.summary)
    path = journal_of(request.summary)
    if request.resume:
        if any(line["options"] != digest for line in before):
            raise ArgumentError(f"--resume: {request.summary} is that of another batch", ANOTHER)
        if path.exists():
            read_journal(path, BATCH, digest, ANOTHER)
    with connected(request.cluster) as cluster:
        dimensions = tuple(sorted({3 if is_volume(job.moving) else 2 for job in request.jobs}))
        for dimension in dimensions:
            prepare(request.options.scheme, dimension)
        team = Team(request.workers, cluster, working, progress)
        request.places.make()
        try:
            journal = read_journal(path, BATCH, digest, ANOTHER)
        except ArgumentError:  # no journal, or one with other options or of another version
            journal = new_journal(path, {BATCH: digest})
        noted = [
            {name: str(record[name]) for name in batch_pairs.COLUMNS}
            for record in journal.records
            if set(record) == set(batch_pairs.COLUMNS)
        ]
        jobs = [job.absolute() for job in request.jobs]
        earlier = {line["out"]: line for line in (*before, *noted)}
        pairs = [batch_pairs.Pair(number, job, earlier.get(str(job.out), {})) for number, job in enumerate(jobs)]
        tried: dict[int, batch_pairs.Tried] = {}

        def lines() -> list[batch_pairs.Line]:
            """Return the new or else the earlier line of every pair; pairs without a line are left out."""
            return [line for p in pairs if (line := tried[p.number].line if p.number in tried else p.earlier)]

        def keep(number: int, done: Done) -> None:
            """Record the lines of a chunk; skip a lost chunk of several pairs, which are tried again one by one."""
            if LOST in done.tally.counts and len(done.rows) > 1:
                return
            # In this order, an interruption between the two statements loses no line: the summary is made from `tried`.
            tried.update({entry.number: entry for entry in done.rows})
            journal.add(entry.line for entry in done.rows if entry.is_new)

        def seconds_of_solved() -> list[float]:
            solved = [entry.line for entry in tried.values() if entry.line["status"] == SOLVED]
            return [float(line["seconds"]) for line in solved]

        try:
            # First one pair, then chunks of pairs, and at last the pairs of lost chunks one by one.
            threads = os.cpu_count() or 1 if team.workers == 1 and cluster is None else 1
            shared = batch_pairs.SharedFile.of(path)
            work = batch_pairs.BatchWork(pairs, request.options, 1, threads, shared, dimensions, run_one=run_one)
            first, local = 0, replace(team, workers=1, cluster=None, progress=silent)
            with working("Registering a first pair"):
                while first < min(TRIALS, len(pairs)) and not seconds_of_solved():
                    local.do(work, [first], len(pairs), Tally(), keep)
                    first += 1
            rest, seconds = pairs[first:], max(seconds_of_solved(), default=0.1)
            of_a_second = max(1, min(MOST_OF_A_CHUNK, int(1.0 / max(1e-3, seconds))))
            size = min(of_a_second, max(1, len(rest) // (SHARES * team.workers)))
            for is_again in (False, True):
                left = [pair for pair in rest if pair.number not in tried]
                part = replace(work, pairs=left, size=1 if is_again else size)
                before_them = batch_pairs.tally_of(entry.line for entry in tried.values())
                team.do(part, part.chunks, len(pairs), before_them, keep, ("Warping", "pairs"))
            remove_leftovers(path for job in jobs for path in job.written)
        finally:
            batch_pairs.write_summary(request.summary, lines())
            path.unlink(missing_ok=True)  # the summary has all lines of the journal
        remove_leftovers([request.summary, path])
    unchanged = sum(not entry.is_new for entry in tried.values())
    return Batch(tuple(lines()), unchanged, tuple(team.notes))


def write_batch_report(folder: Path, batch: Batch, pages: Iterable[Path | None]) -> Path:
    """Write the page of the batch into `folder`, with links to `pages`, a path or None for each pair; return its path.

    Failed pairs come first, then the other pairs by their least det J.
    """
    rows = []
    for line, page in zip(batch.lines, pages, strict=True):
        values = [number(float(line[name])) if line[name] else "–" for name in _NUMBERS]
        outliers = str(len(line["outliers"].split(";")) if line["outliers"] else 0) if line["det_min"] else "–"
        cells = (line["count"], line["steps"], *values, outliers, number(float(line["seconds"] or 0)))
        solved = line["status"] == "solved"
        link = urllib.parse.quote(page.name) if page is not None and page.is_file() else ""
        row = {
            "name": Path(line["moving"]).name, "page": link, "status": line["status"],
            "text": "" if solved else line["message"], "cells": cells,
        }  # fmt: skip
        rows.append(((solved, float(line["det_min"] or math.inf)), row))
    rows.sort(key=lambda entry: entry[0])
    path, template = folder / NAME, Path(__file__).parent / "templates/batch.html.j2"
    title = f"{len(rows)} pairs, {len(batch.failed)} failed"
    write_text(path, rendered(template, title=title, columns=PAGE_COLUMNS, rows=[row for _, row in rows]))
    return path


def table(record: Record) -> Table:
    """Return a table of the results of one pair for the terminal."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=box.SIMPLE_HEAD, show_header=False)
    shown.add_column(style="cyan", no_wrap=True)
    shown.add_column(overflow="fold")
    style = "green" if record["status"] == "solved" else "bold red"
    shown.add_row("image", Text(f"{record['moving']} ({record['direction']})"))
    shown.add_row("status", Text(record["status"], style=style))
    shown.add_row("", Text(record["message"]))
    for name, text in facts(record):
        shown.add_row(name, Text(text))
    seconds = ", ".join(f"{name} {value:.3g} s" for name, value in record["seconds"].items())
    shown.add_row("time", Text(seconds))
    if record["status"] == "solved":
        shown.add_row("written", Text(record["out"]))
    return shown


def record(batch: Batch, summary: Path) -> dict[str, object]:
    """Return the result of a batch as an object for JSON; `summary` is the path of the summary."""
    failed = [{name: line[name] for name in ("moving", "out", "status", "message")} for line in batch.failed]
    return {
        "problem": "image_registration", "task": "warp", "pairs": len(batch.lines), "unchanged": batch.unchanged,
        "failed": failed, "status": "failed" if batch.failed else "solved", "message": _counts(batch),
        "summary": str(summary),
    }  # fmt: skip


def overview(batch: Batch, summary: Path) -> str:
    """Return the result of a batch in one line of text; `summary` is the path of the summary."""
    return f"{_counts(batch)}; see {summary}"


def _counts(batch: Batch) -> str:
    solved = len(batch.lines) - len(batch.failed) - batch.unchanged
    return f"{solved} pairs warped, {batch.unchanged} unchanged, {len(batch.failed)} failed"
