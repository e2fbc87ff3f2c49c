"""A sweep as an xarray.Dataset: its dimensions, coordinates, variables and attributes, and files of netCDF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ExtraError
from codegen.files import replacing
from codegen.sweeping.cases import Cases
from codegen.sweeping.layout import RESERVED, Layout
from codegen.sweeping.work import Rows

if TYPE_CHECKING:
    from xarray import Dataset


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
