"""The data set of a sweep in memory, in a netCDF file, or in a zarr store that is written chunk by chunk.

All arrays of a store are created before the first solve. Every chunk of cases is one chunk of each array. So several
workers can write at the same time, and memory does not grow with the number of cases.

Only one sweep at a time writes to a store. A sweep that ends early reports the number of stored cases; `--resume`
solves the others.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.cases import Cases
from codegen.batch.executors import Tally
from codegen.batch.layout import RESERVED, Chunks, Layout, Rows
from codegen.errors import ArgumentError, ClusterError, DeviceError, FileError, Interrupted
from codegen.files import Journal, damaged_journal, journal_of, new_journal, read_journal, refused, replacing

if TYPE_CHECKING:
    from xarray import Dataset
    from zarr import Array, Group
    from zarr.core.array_spec import ArrayConfigParams

ANOTHER = "choose another name, or give the problem, cases and options that it was begun with"


@dataclass(frozen=True)
class SweepJournal:
    """The chunks of a sweep, the tallies of finished chunks by their numbers, and the file of the journal."""

    file: Journal
    chunks: Chunks
    finished: Mapping[int, Tally]

    def add(self, number: int, tally: Tally) -> None:
        """Append a finished chunk; raises FileError when the file system refuses."""
        self.file.add([{"chunk": number, **tally.as_record()}])


def read_sweep_journal(path: Path, digest: str) -> SweepJournal:
    """Return the journal of the sweep with this digest; raises ArgumentError for another sweep or a damaged journal."""
    file = read_journal(path, "sweep", digest, ANOTHER)
    try:
        chunks = Chunks(tuple(map(int, file.header["cases"])), tuple(map(int, file.header["chunk"])))
        finished = {int(record["chunk"]): Tally.from_record(record) for record in file.records}
    except (KeyError, TypeError, ValueError):
        raise damaged_journal(path) from None
    return SweepJournal(file, chunks, finished)


@contextmanager
def resumable(out: Path, journal: SweepJournal) -> Iterator[None]:
    """Add the number of stored cases to the message if an interrupt, a full disk, a lost cluster or a GPU ends it."""
    rest = "--resume does the rest"
    try:
        yield
    except (KeyboardInterrupt, ClusterError, DeviceError, FileError) as error:
        # Read the journal again: an interrupt may come just after a line was written.
        tallies = read_sweep_journal(journal.file.path, str(journal.file.header["sweep"])).finished.values()
        stored = f"{sum(tally.cases for tally in tallies)} of {math.prod(journal.chunks.shape)} cases are in {out}"
        if isinstance(error, KeyboardInterrupt):
            raise Interrupted(f"interrupted; {stored}; {rest}") from None
        remedy = error.remedy if "--resume" in error.remedy else f"{error.remedy}; {rest}"
        raise type(error)(f"{error.finding}, {stored}", remedy) from error


@dataclass(frozen=True, eq=False)
class Frame:
    """The structure of a data set without its results: cases, arrays with their dimensions, and attributes."""

    cases: Cases
    layout: Layout
    attributes: Mapping[str, str | int]

    @property
    def labels(self) -> dict[str, str]:
        """The variable name of each varied quantity: its name, with an underscore if the name is taken."""
        taken = {*RESERVED, *self.layout.numbers, *self.layout.dims}
        return {name: f"{name}_" if name in taken else name for name in self.cases.columns}

    @property
    def case_dims(self) -> tuple[str, ...]:
        """The names of the dimensions of cases."""
        return tuple(self.labels.get(dim, dim) for dim in self.cases.dims)

    @property
    def coordinates(self) -> dict[str, tuple[tuple[str, ...], NDArray[np.generic]]]:
        """The dimensions and values of the coordinates: varied quantities and names of columns."""
        dims = self.case_dims
        varied = {
            self.labels[name]: ((dims[self.cases.axes[name]],), np.asarray(column))
            for name, column in self.cases.columns.items()
        }
        named = {dim: ((dim,), np.array(names, dtype=np.str_)) for dim, names in self.layout.names.items()}
        return {**varied, **named}

    @property
    def variables(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...], str]]:
        """The dimensions, shape and type of each variable by name; texts have the type `str`."""
        dims, shape = self.case_dims, self.cases.shape
        layout = self.layout
        variables = {name: ((*dims, *layout.dims[name]), (*shape, *layout.shapes[name]), "f8") for name in layout.dims}
        variables |= {name: (dims, shape, kind) for name, kind in layout.numbers.items()}
        return variables | dict.fromkeys(layout.words, (dims, shape, "str"))

    def outlined(self) -> Dataset:
        """Return the data set without results; its arrays repeat one value and take no memory."""
        import xarray

        fills: dict[str, str | float] = {"str": "", "i4": 0, "f8": np.nan}
        empty = {
            name: (dims, np.broadcast_to(np.array(fills[kind]), shape))
            for name, (dims, shape, kind) in self.variables.items()
        }
        return xarray.Dataset(empty, self.coordinates, dict(self.attributes))


def write_netcdf(data: Dataset, path: Path) -> None:
    """Write or replace a netCDF file; raises FileError when the file system refuses."""
    with replacing(path) as temporary:
        data.to_netcdf(temporary)


DIGEST = "sweep"  # the attribute of a store that identifies its sweep
_CONFIG: ArrayConfigParams = {"write_empty_chunks": True}
"""Chunks without results are written as well, so a missing file of a finished chunk was deleted."""


@dataclass(frozen=True)
class Store:
    """A zarr store in a folder; the object can be pickled."""

    path: Path

    def write(self, region: tuple[slice, ...], rows: Rows) -> None:
        """Write the rows of a chunk; raises FileError when the file system refuses."""
        try:
            arrays = _opened(self.path, self.mark(), tuple(rows))
            for name, array in rows.items():
                arrays[name][region] = array
        except OSError as error:
            raise refused(error, self.path) from error

    def mark(self) -> tuple[int, ...]:
        """Return inode, time and size of the metadata file, which identify the store; empty without a store."""
        try:
            status = (self.path / "zarr.json").stat()
        except OSError:
            return ()
        return status.st_ino, status.st_mtime_ns, status.st_size

    def read(self, name: str) -> NDArray[np.float64]:
        """Return the numbers of a variable for all cases."""
        import zarr

        return np.asarray(zarr.open_group(self.path, mode="r", use_consolidated=False)[name][...])  # type: ignore[index]

    def dataset(self) -> Dataset:
        """Return the data set; its numbers are read on demand."""
        import xarray

        data: Dataset = xarray.open_zarr(self.path, chunks=None)
        return data


@lru_cache(maxsize=1)
def _opened(path: Path, mark: tuple[int, ...], names: tuple[str, ...]) -> dict[str, Array[Any]]:
    """Return the open arrays of the store with this `mark`; cached, as opening takes a third of the writing time."""
    import zarr

    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    arrays = {name: group[name] for name in names}
    return {name: array.with_config(_CONFIG) for name, array in arrays.items() if isinstance(array, zarr.Array)}


def begun(path: Path, frame: Frame, chunks: Chunks, digest: str) -> SweepJournal:
    """Create a store without results, rename it when complete, and return its journal; raises FileError if refused."""
    import zarr

    try:
        folder = Path(tempfile.mkdtemp(dir=path.absolute().parent, prefix=f".{path.stem}.", suffix=path.suffix))
        try:
            # xarray reads the names of coordinates that are no dimensions from the attribute "coordinates".
            beside = [name for name, (dims, _) in frame.coordinates.items() if dims != (name,)]
            named = {"coordinates": " ".join(beside)} if beside else {}
            group = zarr.create_group(folder, overwrite=True, attributes={**frame.attributes, **named, DIGEST: digest})
            for name, (dims, values) in frame.coordinates.items():
                words = values.dtype.kind == "U"
                array = _array(group, name, dims, values.shape, values.shape, "str" if words else "f8")
                array[:] = values.astype(object) if words else values
            for name, (dims, shape, kind) in frame.variables.items():
                _array(group, name, dims, shape, (*chunks.block, *shape[len(chunks.block) :]), kind)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # zarr warns that some readers do not support consolidated metadata
                zarr.consolidate_metadata(folder)
            header = {"sweep": digest, "cases": chunks.shape, "chunk": chunks.block}
            journal = SweepJournal(new_journal(journal_of(path), header), chunks, {})
            folder.chmod(0o755)
            folder.rename(path)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
    except OSError as error:
        raise refused(error, path) from error
    return journal


def resumed(path: Path, frame: Frame, digest: str) -> SweepJournal:
    """Return the journal of an existing store, after a check of the files of all finished chunks.

    Raises ArgumentError if the folder is no store, is the store of another sweep, or lacks files.
    """
    import zarr

    try:
        attributes = dict(zarr.open_group(path, mode="r", use_consolidated=False).attrs)
    except Exception:  # zarr raises errors of many types here
        raise ArgumentError(f"--resume: {path} is no store of a sweep", "choose another name") from None
    if attributes.get(DIGEST) != digest:
        raise ArgumentError(f"--resume: {path} is the store of another sweep", ANOTHER)
    journal = read_sweep_journal(journal_of(path), digest)
    for name, (_, values) in frame.coordinates.items():
        _require_files(path, name, [(0,)] if values.size else [])
    counts = journal.chunks.counts
    indices = [tuple(map(int, np.unravel_index(number, counts))) for number in sorted(journal.finished)]
    for name, (_, shape, _) in frame.variables.items():
        inner = shape[len(journal.chunks.block) :]
        _require_files(path, name, [(*index, *(0 for _ in inner)) for index in indices] if 0 not in inner else [])
    return journal


def _require_files(path: Path, name: str, indices: list[tuple[int, ...]]) -> None:
    """Raise ArgumentError if an array, or one of its chunks with these indices, has no file."""
    for file in ("zarr.json", *("/".join(map(str, ("c", *place))) for place in indices)):
        if not (path / name / file).is_file():
            lacking = f"{name}/{file}" if (path / name).is_dir() else name
            remedy = "delete the store, or choose another name"
            raise ArgumentError(f"--resume: {path} lacks {lacking}, which was written", remedy)


def _array(
    group: Group, name: str, dims: tuple[str, ...], shape: tuple[int, ...], chunks: tuple[int, ...], kind: str
) -> Array[Any]:
    from zarr.codecs import BloscCodec

    fill = {"str": "", "i4": -1}.get(kind, np.nan)
    # This codec needs half of the time of the default one, for files of the same size.
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
