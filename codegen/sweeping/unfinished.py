"""Stores that are not full: one sweep fills one at a time, and if it ends it says how many cases are there.

Another one does the rest, with `--resume`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from codegen.engines.machines import only_one
from codegen.errors import ArgumentError, ClusterError, FileError, Interrupted
from codegen.sweeping import journal
from codegen.sweeping.journal import SweepJournal

_REST = "--resume does the rest"


def only_sweep(out: Path) -> AbstractContextManager[None]:
    """Refuse, as an ArgumentError, a store that another process of this machine fills at this time."""
    remedy = "wait until it ends, or choose another name"
    return only_one(str(out.resolve()), ArgumentError(f"--out {out}: another process is at work on it", remedy))


@contextmanager
def resumable(out: Path, begun: SweepJournal) -> Iterator[None]:
    """Have an interrupt, a disk that refuses and a cluster that is lost say how many cases are in the store by then."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {_kept(out, begun)}; {_REST}") from None
    except (ClusterError, FileError) as error:
        remedy = error.remedy if "--resume" in error.remedy else f"{error.remedy}; {_REST}"
        raise type(error)(f"{error.finding}, {_kept(out, begun)}", remedy) from error


def _kept(out: Path, begun: SweepJournal) -> str:
    """How many cases the journal has by now; an interrupt may have come just after it was written to."""
    noted = journal.read(begun.lines.path, begun.digest).finished.values()
    return f"{sum(tally.cases for tally in noted)} of {math.prod(begun.chunks.shape)} cases are in {out}"
