"""The registry of engines: who does the chunks of some work. One file for each; another one is a file and a row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeAlias

from codegen.errors import ExtraError

if TYPE_CHECKING:
    from codegen.batch.executors.work import Done, Work

Solved: TypeAlias = "Iterator[tuple[int, Done]]"
"""Chunks by their numbers as they are finished, in any order."""
Engine: TypeAlias = "Callable[[Work, int], AbstractContextManager[Callable[[Sequence[int]], Solved]]]"
"""(work, workers) -> a context with workers that are ready, in which a function solves chunks by their numbers.

Each chunk comes exactly once. One whose workers are lost time and again comes as `work.lost` makes it.
"""


@dataclass(frozen=True)
class Row:
    """Name and summary of an engine; its file has a function `running` that is an Engine."""

    name: str
    summary: str

    @property
    def running(self) -> Engine:
        """The engine, imported when it is asked for."""
        return getattr(import_module(f"codegen.batch.executors.{self.name}"), "running")  # type: ignore[no-any-return]  # noqa: B009


LOCAL = "local"
"""The word for a cluster that is begun for the work, on this machine."""
ENGINES = {
    row.name: row
    for row in (
        Row("serial", "one chunk after the other in this process"),
        Row("processes", "processes on this machine, each with one thread"),
        Row("dask", "workers of a cluster of dask, on any machines"),
    )
}
"""Every engine by name; tests run over this table."""


def engine_for(workers: int, cluster: Any = None) -> Engine:
    """The engine of a cluster, if there is one, or the one that so many workers of this machine need."""
    if cluster is not None:
        running: Any = ENGINES["dask"].running
        return partial(running, cluster=cluster)
    return ENGINES["serial" if workers == 1 else "processes"].running


def connected(cluster: Any) -> AbstractContextManager[Any]:
    """A client of the cluster that is asked for, or None where none is; it is looked for before anything takes long.

    Raises ExtraError without dask, ClusterError when nothing answers or nobody works there, and ArgumentError for what
    is no cluster.
    """
    if cluster is None:
        return nullcontext()
    if find_spec("distributed") is None:
        raise ExtraError("a cluster needs dask, which is not installed", "pip install 'variational-codegen[cluster]'")
    made: AbstractContextManager[Any] = import_module("codegen.batch.executors.dask").connected(cluster)
    return made
