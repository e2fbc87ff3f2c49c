"""The results of many cases of one module: what optima and motions share, and the place where cases are solved."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors import Abandoned
from codegen.batch.layout import COLUMNS
from codegen.errors import ArgumentError, DeviceError, ExtraError, NumericsError, clause, one_line
from codegen.runtime.search.stacks import SOLVED
from codegen.solving.loading import ControlModule, GeneratedModule, Matrix, SimulateModule, Vector
from codegen.solving.results.display import Background
from codegen.solving.results.result import Result

if TYPE_CHECKING:
    from xarray import Dataset

UNUSABLE = "unusable"  # the status of a case with whose numbers no grid exists


@dataclass(frozen=True)
class Limits:
    """The options of the searches of all cases: see `codegen.solve`; None stands for the default.

    `is_on_device` is True for cases that a GPU solves, and `is_kept` if the states of motions stay in its memory.
    """

    tolerance: float | None = None
    max_iterations: int | None = None
    time_limit: float = math.inf
    scaling: str = "auto"
    is_warm: bool = False
    is_on_device: bool = False
    is_kept: bool = False


THREADS, CUDA = "threads", "cuda"
PLACES = (THREADS, CUDA)
"""Executors of many cases: the threads of this machine, and its GPU."""


def require_place(executor: object) -> bool:
    """Return True for the GPU; raises ArgumentError for an unknown name, and DeviceError without a GPU."""
    if executor not in PLACES:
        raise ArgumentError(f"executor {clause(repr(executor))}", f"use one of {', '.join(PLACES)}")
    if executor == CUDA:
        from codegen.runtime.cuda.memory import NoDevice, require_device

        try:
            require_device()
        except NoDevice as error:
            reason = str(error).removeprefix("Error at driver init: ").partition(". ")[0]
            raise DeviceError(
                clause(f"numba finds no GPU that it can use: {reason}"),
                'use executor "threads", or install a driver of NVIDIA and codegen[cuda]',
            ) from None
    return executor == CUDA


@contextmanager
def errors_of_device() -> Iterator[None]:
    """Raise DeviceError for errors of the GPU: too little memory, functions that it cannot run, or a failed call."""
    from numba.core.errors import NumbaError
    from numba.cuda.cudadrv.driver import CudaAPIError

    from codegen.runtime.cuda.batches import Full

    try:
        yield
    except Full as error:
        raise DeviceError(f"the memory of the GPU does not suffice: {error}", "solve with fewer steps") from None
    except CudaAPIError as error:  # also if other processes have taken the memory since it was measured
        finding = f"the GPU reports an error: {one_line(str(error), 150)}"
        raise DeviceError(clause(finding), 'end other work on the GPU, or use executor "threads"') from None
    except NumbaError as error:
        text = next(iter(str(error).strip().splitlines()[::-1]), "")
        raise DeviceError(clause(f"the GPU cannot run this problem: {text}"), 'use executor "threads"') from None


class Cases(ABC):
    """Base class of the results of many cases: their statuses, and the parameters of each case."""

    status: NDArray[np.str_]
    parameters: Mapping[str, Vector]
    module: ControlModule | SimulateModule
    steps: int
    limits: Limits
    background: Background | None
    numbers_of_cases: ClassVar[tuple[str, ...]]

    @property
    @abstractmethod
    def is_ready(self) -> bool:
        """True if the machine code that `fill` needs is on the disk, or if a GPU solves the cases."""

    def fill(self, part: slice, is_wanted: Callable[[], bool]) -> None:
        """Solve the cases of a part, block by block; raises Abandoned once `is_wanted` returns False."""
        size = self._block(part.stop - part.start)
        for first in range(part.start, part.stop, size):
            if not is_wanted():
                raise Abandoned
            with errors_of_device() if self.limits.is_on_device else nullcontext():
                self._solve(slice(first, min(part.stop, first + size)), is_wanted)

    @abstractmethod
    def _block(self, number: int) -> int:
        """Return the number of cases of a block, for a part of `number` cases."""

    @abstractmethod
    def _solve(self, own: slice, is_wanted: Callable[[], bool]) -> None:
        """Solve a block of cases."""

    @property
    @abstractmethod
    def message(self) -> NDArray[np.object_]:
        """The explanation (n,) of each status."""

    @property
    @abstractmethod
    def names(self) -> dict[str, tuple[str, ...]]:
        """The names of the columns of arrays."""

    @property
    def solved(self) -> NDArray[np.bool_]:
        """A mask (n,) of the solved cases."""
        return np.asarray(self.status == SOLVED)

    @property
    def counts(self) -> dict[str, int]:
        """The number of cases of each status, the most frequent first."""
        return dict(Counter(self.status.tolist()).most_common())

    def __len__(self) -> int:
        return int(self.status.size)

    @abstractmethod
    def __getitem__(self, index: int) -> Result:
        """Return the Result of a case; raises IndexError beyond the end."""

    def __iter__(self) -> Iterator[Result]:
        return (self[i] for i in range(len(self)))

    def _values(self, index: int) -> dict[str, float]:
        """Return the numbers of a case by name; raises IndexError, or NumericsError for an unusable case."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"case {index} of {len(self)}")
        if self.status[index] == UNUSABLE:
            raise NumericsError(clause(f"case {index} has unusable numbers"), "look at `status` and `message` before")
        return {name: float(values[index]) for name, values in self.parameters.items()}

    def _in_background(self, result: Result, module: GeneratedModule, values: Mapping[str, float]) -> Result:
        """Return the result of a case with its numbers and its module, which figures and angular velocities need."""
        background = None if self.background is None else replace(self.background, module=module)
        return replace(result, parameters=dict(values), background=background)

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        varied = ", ".join(self.parameters)
        name = type(self).__name__
        return f"{name} of {len(self)} cases of {self.module.metadata.problem} ({varied}): {counts}"

    def to_dataset(self) -> Dataset:
        """Return the results as an xarray data set with the dimension `case`; raises ExtraError without xarray."""
        try:
            import xarray
        except ImportError:
            raise ExtraError("to_dataset needs xarray, which is not installed", "pip install xarray") from None
        data: dict[str, object] = {name: ("case", getattr(self, name)) for name in ("status", *self.numbers_of_cases)}
        data["message"] = ("case", self.message.astype(np.str_))
        data |= {name: ("case", values) for name, values in getattr(self, "free", {}).items()}
        coordinates: dict[str, object] = {name: ("case", values) for name, values in self.parameters.items()}
        times: Matrix = getattr(self, "t")  # noqa: B009
        coordinates["t"] = (("case", "node"), times)
        rows = {times.shape[1]: "node", times.shape[1] - 1: "interval"}
        for name in (*COLUMNS, "energy"):
            array = getattr(self, name, None)
            if array is None or not array.size:
                continue
            column = (COLUMNS[name],) if name in COLUMNS else ()
            row = (rows.get(array.shape[1], f"{name} row"),) if array.ndim > 1 + len(column) else ()
            data[name] = (("case", *(("occurrence",) if name == "event_times" else row), *column), array)
            if name in self.names:
                coordinates[COLUMNS[name]] = (COLUMNS[name], list(self.names[name]))
        return xarray.Dataset(data, coordinates, {"problem": self.module.metadata.problem, "steps": self.steps})


def unusable_message(error: Exception, values: Mapping[str, float]) -> str:
    """Return the message of a case whose numbers raise an error."""
    reason = error.args[-1] if error.args else type(error).__name__
    return one_line(f"{UNUSABLE}: {reason} ({', '.join(f'{name} = {value:g}' for name, value in values.items())})")
