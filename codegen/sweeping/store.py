"""A sweep in a zarr store: laid out before anything is solved, filled chunk by chunk, gone on with after any end.

Every chunk of cases is one chunk of each array, so that several processes write side by side, and memory does not grow
with the number of cases.
"""

from __future__ import annotations

import shutil
import tempfile
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.engines.journal import journal_of
from codegen.errors import ArgumentError
from codegen.files import refused
from codegen.sweeping import journal
from codegen.sweeping.chunks import Chunks
from codegen.sweeping.dataset import Frame
from codegen.sweeping.journal import SweepJournal
from codegen.sweeping.work import Rows

if TYPE_CHECKING:
    from xarray import Dataset

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
            started = journal.begun(journal_of(path), digest, chunks)
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
        raise ArgumentError(f"--resume: {path} is the store of another sweep", journal.ANOTHER)
    found = journal.read(journal_of(path), digest)
    _require_whole(path, frame, found)
    return found


def _require_whole(path: Path, frame: Frame, found: SweepJournal) -> None:
    """Refuse a store without arrays that it was laid out with, or without chunks that its journal says are whole."""
    for name, (_, values) in frame.coordinates.items():
        _require_files(path, name, [(0,)] if values.size else [])
    places = [tuple(map(int, np.unravel_index(number, found.chunks.counts))) for number in sorted(found.finished)]
    for name, (_, shape, _) in frame.variables.items():
        inner = shape[len(found.chunks.block) :]
        _require_files(path, name, [(*place, *(0 for _ in inner)) for place in places] if 0 not in inner else [])


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
    """The attribute by which readers tell coordinates that are not called like their dimension from variables."""
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
