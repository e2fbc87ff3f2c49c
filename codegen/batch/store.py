"""A sweep in a zarr store: laid out before anything is solved, filled chunk by chunk, gone on with after any end.

Every chunk of cases is one chunk of each array, so that several processes write side by side, and memory does not grow
with the number of cases.

Stores that are not full: one sweep fills one at a time, and if it ends it says how many cases are there. Another one
does the rest, with `--resume`.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.cases import Cases
from codegen.batch.executors.chunks import (
    Journal,
    Tally,
    damaged_journal,
    journal_of,
    new_journal,
    only_one,
    read_journal,
)
from codegen.batch.layout import RESERVED, Chunks, Layout
from codegen.batch.work import Rows
from codegen.errors import ArgumentError, ClusterError, ExtraError, FileError, Interrupted
from codegen.files import refused, replacing

if TYPE_CHECKING:
    from xarray import Dataset


ANOTHER = "choose another name, or give the problem, cases and options that it was begun with"


@dataclass(frozen=True)
class SweepJournal:
    """The chunks of a sweep, the tallies of those that are finished by their numbers, and the lines that tell it."""

    lines: Journal
    chunks: Chunks
    finished: Mapping[int, Tally]

    @property
    def digest(self) -> str:
        """What tells this sweep from others."""
        return str(self.lines.header["sweep"])

    def add(self, number: int, tally: Tally) -> None:
        """Note that a chunk is whole; FileError when the file system refuses."""
        self.lines.add([{"chunk": number, **tally.as_record()}])


def begun_journal(path: Path, digest: str, chunks: Chunks) -> SweepJournal:
    """A new journal, in which no chunk is finished."""
    header = {"sweep": digest, "cases": chunks.shape, "chunk": chunks.block}
    return SweepJournal(new_journal(path, header), chunks, {})


def read_sweep_journal(path: Path, digest: str) -> SweepJournal:
    """The journal of a sweep that was begun; ArgumentError where it is that of another, or none."""
    lines = read_journal(path, "sweep", digest, ANOTHER)
    try:
        chunks = Chunks(tuple(map(int, lines.header["cases"])), tuple(map(int, lines.header["chunk"])))
        finished = {int(record["chunk"]): Tally.from_record(record) for record in lines.records}
    except (KeyError, TypeError, ValueError):
        raise damaged_journal(path) from None
    return SweepJournal(lines, chunks, finished)


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
    noted = read_sweep_journal(begun.lines.path, begun.digest).finished.values()
    return f"{sum(tally.cases for tally in noted)} of {math.prod(begun.chunks.shape)} cases are in {out}"


def require_xarray() -> None:
    """Refuse to go on without xarray and zarr; ExtraError names the command that installs them."""
    for name in ("xarray", "zarr"):
        if find_spec(name) is None:  # they take long to import, and a command may need only one of them
            raise ExtraError(
                f"a sweep needs {name}, which is not installed", "pip install 'variational-codegen[sweep]'"
            )


@dataclass(frozen=True, eq=False)
class Frame:
    """What a data set is, but for its numbers: cases and arrays with their dimensions, and attributes."""

    cases: Cases
    layout: Layout
    attributes: Mapping[str, Any]

    @property
    def labels(self) -> dict[str, str]:
        """What varied quantities are called: those that have the name of a variable, with an underscore."""
        taken = {*RESERVED, *self.layout.numbers, *self.layout.dims}
        return {name: f"{name}_" if name in taken else name for name in self.cases.columns}

    @property
    def case_dims(self) -> tuple[str, ...]:
        """The dimensions of cases."""
        return tuple(self.labels.get(dim, dim) for dim in self.cases.dims)

    @property
    def coordinates(self) -> dict[str, tuple[tuple[str, ...], NDArray[Any]]]:
        """Varied quantities, and the names of columns: dimensions and values by name."""
        dims = self.case_dims
        varied = {
            self.labels[name]: ((dims[self.cases.axes[name]],), np.asarray(column))
            for name, column in self.cases.columns.items()
        }
        named = {dim: ((dim,), np.array(names, dtype=np.str_)) for dim, names in self.layout.names.items()}
        return {**varied, **named}

    @property
    def variables(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...], str]]:
        """Dimensions, shapes and kinds of numbers by name; words have the kind `str`."""
        dims, shape = self.case_dims, self.cases.shape
        found = {
            name: ((*dims, *self.layout.dims[name]), (*shape, *self.layout.shapes[name]), "f8")
            for name in self.layout.dims
        }
        found |= {name: (dims, shape, kind) for name, kind in self.layout.numbers.items()}
        return found | dict.fromkeys(self.layout.words, (dims, shape, "str"))

    def outlined(self) -> Dataset:
        """The data set without its numbers, which takes no memory."""
        import xarray

        fills: dict[str, Any] = {"str": "", "i4": 0, "f8": np.nan}
        empty = {
            name: (dims, np.broadcast_to(np.array(fills[kind]), shape))
            for name, (dims, shape, kind) in self.variables.items()
        }
        return xarray.Dataset(empty, self.coordinates, dict(self.attributes))


class Memory:
    """All rows of a sweep, in memory."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.arrays: Rows = {}
        for name, (_, shape, kind) in frame.variables.items():
            if kind == "str":
                self.arrays[name] = np.full(shape, "", object)
            else:
                self.arrays[name] = np.full(shape, -1 if kind == "i4" else np.nan, kind)

    def write(self, region: tuple[slice, ...], rows: Rows) -> None:
        """Put the rows of a chunk where they belong."""
        for name, array in rows.items():
            self.arrays[name][region] = array

    def dataset(self) -> Dataset:
        """The data set."""
        import xarray

        variables = {}
        for name, (dims, _, kind) in self.frame.variables.items():
            array = self.arrays[name]
            variables[name] = (dims, array.astype(np.str_) if kind == "str" else array)
        return xarray.Dataset(variables, self.frame.coordinates, dict(self.frame.attributes))


def write_netcdf(data: Dataset, path: Path) -> None:
    """Write a file of netCDF as a whole; FileError when the file system refuses."""
    with replacing(path) as temporary:
        data.to_netcdf(temporary)


DIGEST = "sweep"
"""The attribute that says which sweep a store belongs to."""
_CONFIG: Any = {"write_empty_chunks": True}
"""A chunk of cases that failed has its files as well, so that one which is missing was taken away."""
_INCOMPLETE = "delete the store, or choose another name"


@dataclass(frozen=True)
class Store:
    """The folder of a zarr store; it can be sent to other processes."""

    path: Path

    def write(self, region: tuple[slice, ...], rows: Rows) -> None:
        """Write the rows of a chunk; FileError when the file system refuses."""
        try:
            arrays = _opened(self.path, self.mark(), tuple(rows))
            for name, array in rows.items():
                arrays[name][region] = array
        except OSError as error:
            raise refused(error, self.path) from error

    def mark(self) -> tuple[int, ...]:
        """What tells this store from one that is elsewhere under the same name; nothing where there is none."""
        try:
            found = (self.path / "zarr.json").stat()
        except OSError:
            return ()
        return found.st_ino, found.st_mtime_ns, found.st_size

    def read(self, name: str) -> NDArray[Any]:
        """All numbers of a variable."""
        import zarr

        return np.asarray(zarr.open_group(self.path, mode="r", use_consolidated=False)[name][...])  # type: ignore[index]

    def dataset(self) -> Dataset:
        """The data set, whose numbers are read when they are asked for."""
        import xarray

        found: Dataset = xarray.open_zarr(self.path, chunks=None)
        return found


@lru_cache(maxsize=1)
def _opened(path: Path, mark: tuple[int, ...], names: tuple[str, ...]) -> dict[str, Any]:
    """The arrays of a store, which its `mark` tells from others: to open them takes a third of the time of writing."""
    import zarr

    group: Any = zarr.open_group(path, mode="r+", use_consolidated=False)
    return {name: group[name].with_config(_CONFIG) for name in names}


def begun(path: Path, frame: Frame, chunks: Chunks, digest: str) -> SweepJournal:
    """Lay out a store and its journal; the store has its name only when it is whole. FileError when that is refused."""
    try:
        folder = Path(tempfile.mkdtemp(dir=path.absolute().parent, prefix=f".{path.stem}.", suffix=path.suffix))
        try:
            _laid_out(folder, frame, chunks, digest)
            started = begun_journal(journal_of(path), digest, chunks)
            folder.chmod(0o755)
            folder.rename(path)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
    except OSError as error:
        raise refused(error, path) from error
    return started


def resumed(path: Path, frame: Frame, digest: str) -> SweepJournal:
    """The journal of a store that is there already.

    ArgumentError where it belongs to another sweep, is none, or lacks something that was written.
    """
    import zarr

    try:
        attributes = dict(zarr.open_group(path, mode="r", use_consolidated=False).attrs)
    except Exception:  # zarr has many ways to say that this is no store
        raise ArgumentError(f"--resume: {path} is no store of a sweep", "choose another name") from None
    if attributes.get(DIGEST) != digest:
        raise ArgumentError(f"--resume: {path} is the store of another sweep", ANOTHER)
    found = read_sweep_journal(journal_of(path), digest)
    # Refuse a store without arrays that it was laid out with, or without chunks that its journal says are whole.
    for name, (_, values) in frame.coordinates.items():
        _require_files(path, name, [(0,)] if values.size else [])
    places = [tuple(map(int, np.unravel_index(number, found.chunks.counts))) for number in sorted(found.finished)]
    for name, (_, shape, _) in frame.variables.items():
        inner = shape[len(found.chunks.block) :]
        _require_files(path, name, [(*place, *(0 for _ in inner)) for place in places] if 0 not in inner else [])
    return found


def _require_files(path: Path, name: str, places: list[tuple[int, ...]]) -> None:
    """Refuse a store that lacks an array, or its chunks at some places."""
    for file in ("zarr.json", *("/".join(map(str, ("c", *place))) for place in places)):
        if not (path / name / file).is_file():
            lacking = f"{name}/{file}" if (path / name).is_dir() else name
            raise ArgumentError(f"--resume: {path} lacks {lacking}, which was written", _INCOMPLETE)


def _laid_out(folder: Path, frame: Frame, chunks: Chunks, digest: str) -> None:
    """Write what a store holds but the numbers of the cases."""
    import zarr

    group = zarr.create_group(folder, overwrite=True, attributes={**frame.attributes, **_named(frame), DIGEST: digest})
    for name, (dims, values) in frame.coordinates.items():
        words = values.dtype.kind == "U"
        array = _array(group, name, dims, values.shape, values.shape, "str" if words else "f8")
        array[:] = values.astype(object) if words else values
    for name, (dims, shape, kind) in frame.variables.items():
        _array(group, name, dims, shape, (*chunks.block, *shape[len(chunks.block) :]), kind)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that other readers of the format need not know consolidated metadata
        zarr.consolidate_metadata(folder)


def _named(frame: Frame) -> dict[str, str]:
    beside = [name for name, (dims, _) in frame.coordinates.items() if dims != (name,)]
    return {"coordinates": " ".join(beside)} if beside else {}


def _array(
    group: Any, name: str, dims: tuple[str, ...], shape: tuple[int, ...], chunks: tuple[int, ...], kind: str
) -> Any:
    from zarr.codecs import BloscCodec

    fill: Any = {"str": "", "i4": -1}.get(kind, np.nan)
    # In files of the same size as those of zarr's own choice, and in half of its time.
    codec = BloscCodec(cname="lz4", clevel=1)
    return group.create_array(
        name,
        shape=shape,
        chunks=tuple(max(1, size) for size in chunks),
        dtype=str if kind == "str" else kind,
        fill_value=fill,
        compressors=codec,
        dimension_names=dims,
        config=_CONFIG,
    )
