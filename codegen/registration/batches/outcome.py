"""The way of a batch: what was done before, a first pair that is timed, chunks that an executor does, and the summary.

While a batch is being done, a journal beside the summary has the line of every pair as soon as its outputs are there,
so that whatever ends it loses only what was being done. A pair is left alone when its line tells that it was solved
from the same files with the same options, and its outputs are those that were written then.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from codegen.batch.executors import Progress, Team, Working, connected, silent
from codegen.batch.executors.chunks import LOST, SOLVED, Done, Journal, Tally, journal_of, new_journal, read_journal
from codegen.errors import ArgumentError
from codegen.files import remove_leftovers
from codegen.registration.batches.pairing import Places, make_folders
from codegen.registration.batches.work import (
    COLUMNS,
    BatchWork,
    Line,
    Pair,
    Place,
    Tried,
    options_digest,
    read_summary,
    tally_of,
    write_summary,
)
from codegen.registration.job import dimension_of, run
from codegen.registration.jobs import Job, Options
from codegen.registration.solver import registration_module

MOST = 64
"""The most pairs of a chunk."""
TRIALS = 3
"""How many pairs are tried for one that is solved and tells how long pairs take."""
SHARES = 4
"""Chunks that each worker gets at least, so that all of them end at about the same time."""
BATCH = "batch"
"""What a journal calls the digest of the options."""
ANOTHER = "leave --resume out to do all pairs anew, or give the options that it was begun with"


@dataclass(frozen=True)
class BatchRequest:
    """The pairs, their options, the folders to be made, where the summary goes, and who does it.

    `resume` insists that what was begun there had the same options; `cluster` is the address of a scheduler of dask, a
    client of one, "local", or None.
    """

    jobs: Sequence[Job]
    options: Options
    places: Places
    summary: Path
    workers: int = 1
    cluster: Any = None
    resume: bool = False


@dataclass(frozen=True)
class Batch:
    """What a batch did: a line for every pair, how many were whole before and left alone, and what workers say."""

    lines: tuple[Line, ...]
    unchanged: int
    said: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[Line, ...]:
        """The lines of pairs that were not solved."""
        return tuple(line for line in self.lines if line["status"] != SOLVED)


def outcome_of(
    request: BatchRequest,
    working: Working = nullcontext,
    progress: Progress = silent,
    run_one: Callable[[Job, Options], Any] = run,
    prepare: Callable[[str, int], Any] = registration_module,
) -> Batch:
    """Do all pairs that are not whole; one that fails leaves a line that says why, and never stops the others.

    What is wrong with the request is said before anything is written, by a CodegenError. So is what would fail for
    every pair: a scheme that cannot be used, a file system that refuses, a worker that does not see the files.
    `prepare` makes a solver ready, by the name of its scheme and its dimension.
    """
    digest, before = options_digest(request.options), read_summary(request.summary)
    path = journal_of(request.summary)
    if request.resume:
        _require_same(request.summary, before, path, digest)
    with connected(request.cluster) as cluster:
        dimensions = tuple(sorted({dimension_of(job) for job in request.jobs}))
        for dimension in dimensions:
            prepare(request.options.scheme, dimension)
        team = Team(request.workers, cluster, working, progress)
        make_folders(request.places)
        journal = _journal(path, digest)
        jobs = [job.absolute() for job in request.jobs]
        way = _Way(journal, jobs, dimensions, {line["out"]: line for line in (*before, *_noted(journal))}, {}, team)
        try:
            way.go(request.options, run_one)
            remove_leftovers(path for job in jobs for path in job.written)
        finally:
            write_summary(request.summary, way.lines())
            path.unlink(missing_ok=True)  # all that it holds is in the summary
        remove_leftovers([request.summary, path])
    return Batch(tuple(way.lines()), way.unchanged, tuple(team.notes))


def _require_same(summary: Path, before: Sequence[Line], path: Path, digest: str) -> None:
    """Refuse to go on with what was begun with other options, or by another version."""
    if any(line["options"] != digest for line in before):
        raise ArgumentError(f"--resume: {summary} is that of another batch", ANOTHER)
    if path.exists():
        read_journal(path, BATCH, digest, ANOTHER)


def _journal(path: Path, digest: str) -> Journal:
    """The journal of a batch with these options, in which nothing is noted where there was none."""
    try:
        return read_journal(path, BATCH, digest, ANOTHER)
    except ArgumentError:  # of other options or another version, or none of ours: then nothing of it is of use
        return new_journal(path, {BATCH: digest})


def _noted(journal: Journal) -> list[Line]:
    texts = (record for record in journal.records if set(record) == set(COLUMNS))
    return [{name: str(record[name]) for name in COLUMNS} for record in texts]


@dataclass
class _Way:
    """A batch that is being done: the lines of pairs by their numbers, those of before by their outputs."""

    journal: Journal
    jobs: Sequence[Job]
    dimensions: tuple[int, ...]
    known: Mapping[str, Line]
    tried: dict[int, Tried]
    team: Team

    @property
    def unchanged(self) -> int:
        """How many pairs were left alone."""
        return sum(not own.is_new for own in self.tried.values())

    def lines(self) -> list[Line]:
        """A line for every pair that has one, new or from before."""
        found = (
            self.tried[number].line if number in self.tried else self.known.get(str(job.out))
            for number, job in enumerate(self.jobs)
        )  # fmt: skip
        return [line for line in found if line is not None]

    def go(self, options: Options, run_one: Callable[[Job, Options], Any]) -> None:
        """Do pairs until all are done: a first one, chunks of them, and alone those whose chunks were lost."""
        pairs = [Pair(number, job, self.known.get(str(job.out), {})) for number, job in enumerate(self.jobs)]
        alone = self.team.workers == 1 and self.team.cluster is None
        threads = os.cpu_count() or 1 if alone else 1
        work = BatchWork(pairs, options, 1, threads, Place.of(self.journal.path), self.dimensions, run_one=run_one)
        first, here = 0, replace(self.team, workers=1, cluster=None, progress=silent)
        with self.team.working("Registering a first pair"):
            while first < min(TRIALS, len(pairs)) and not self._solved():
                here.do(work, [first], len(pairs), Tally(), self._keep)
                first += 1
        rest = pairs[first:]
        size = min(self._of_a_second(), max(1, len(rest) // (SHARES * self.team.workers)))
        self._do(replace(work, pairs=rest, size=size))
        left = [pair for pair in rest if pair.number not in self.tried]
        self._do(replace(work, pairs=left, size=1))

    def _do(self, work: BatchWork) -> None:
        before = tally_of(own.line for own in self.tried.values())
        self.team.do(work, work.chunks, len(self.jobs), before, self._keep, ("Warping", "pairs"))

    def _keep(self, number: int, done: Done) -> None:
        """Note what has been done; of pairs that were lost together one is to blame, and all are tried again."""
        if LOST in done.tally.counts and len(done.rows) > 1:
            return
        # Whoever interrupts in between has the lines in the summary, which takes the journal's place.
        self.tried |= {own.number: own for own in done.rows}
        self.journal.add(own.line for own in done.rows if own.is_new)

    def _solved(self) -> list[float]:
        lines = (own.line for own in self.tried.values())
        return [float(line["seconds"]) for line in lines if line["status"] == SOLVED]

    def _of_a_second(self) -> int:
        return max(1, min(MOST, int(1.0 / max(1e-3, max(self._solved(), default=0.1)))))
