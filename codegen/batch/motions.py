"""Motions of many cases of one simulation, by the compiled loop over cases or on a GPU."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors.chunks import Abandoned
from codegen.batch.optima import errors_of_device
from codegen.errors import ArgumentError, DeviceError, ExtraError, NumericsError, clause, one_line
from codegen.runtime.search.batch import LONGEST_STATUS, SOLVED
from codegen.runtime.stepping.ensembles import (
    Ensemble,
    Followed,
    energies_of,
    ensemble_of,
    follow_ensemble,
    followed_in,
    own_cases,
)
from codegen.runtime.stepping.motion import describe
from codegen.runtime.stepping.problem import StepProblem
from codegen.runtime.stepping.steps import LEFT_TABLE
from codegen.solving.drivers.newton import TOLERANCE, simulate
from codegen.solving.loading import Matrix, SimulateModule, Vector, is_of_particles
from codegen.solving.request import with_values
from codegen.solving.results.motions import rounding_of, simulate_result
from codegen.solving.results.result import Result, Run, component_names

if TYPE_CHECKING:
    from xarray import Dataset

UNUSABLE = "unusable"
"""The status of a case with whose numbers no grid exists."""
NUMBERS = 1_000_000
"""Number of stored numbers of a block of cases, after each of which an interrupt is seen."""


class Cases(ABC):
    """Base class of the results of many cases: their statuses, and the parameters of each case."""

    status: NDArray[np.str_]
    parameters: Mapping[str, Vector]
    module: Any

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

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        varied = ", ".join(self.parameters)
        name = type(self).__name__
        return f"{name} of {len(self)} cases of {self.module.metadata.problem} ({varied}): {counts}"


@dataclass(frozen=True, eq=False, repr=False)
class Motions(Cases):
    """The motions of n cases; `motions[i]` is the Result of case i, which is followed once more.

    Attributes
    ----------
    status : ndarray of str, (n,)
        The status, such as "solved", as of `codegen.solve`. It is "unusable" for a case whose numbers have no motion,
        such as a negative duration.
    made, iterations : ndarray of int, (n,)
        Numbers of steps made, and of linear systems solved.
    residual : ndarray, (n,)
        Max-norms of the equations of the scheme, which are evaluated again for the step to each stored state.
    h : ndarray, (n,)
        Lengths of a step.
    path : ndarray, (n, rows, states)
        The stored states: coordinates, then momenta. NaN after the end of a motion.
    parameters : dict of str to ndarray (n,)
        The numbers that differ from those of the problem.
    steps, every : int
        Number of steps. Every `every`-th state is stored, and the first and the last.
    module : module
        The generated module.
    messages : dict of int to str
        The messages of cases that are not solved.
    numbers : tuple
        Lengths of a step, parameters and initial states of all cases.
    """

    status: NDArray[np.str_]
    made: NDArray[np.int64]
    iterations: NDArray[np.int64]
    residual: Vector
    h: Vector
    path: NDArray[np.float64]
    parameters: Mapping[str, Vector]
    steps: int
    every: int
    module: SimulateModule
    messages: dict[int, str]
    numbers: Ensemble

    @cached_property
    def message(self) -> NDArray[np.object_]:
        """The explanation (n,) of each status."""
        return np.array([self.messages.get(i, f"all {self.steps} steps were made") for i in range(len(self))], object)

    @property
    def t(self) -> Matrix:
        """Times (n, rows) of the stored states."""
        return self.h[:, None] * np.minimum(self.every * np.arange(self.path.shape[1]), self.steps)

    @property
    def q(self) -> NDArray[np.float64]:
        """Coordinates or states, (n, rows, coordinates)."""
        return self.path[:, :, : self.module.problem.positions]

    @property
    def p(self) -> NDArray[np.float64]:
        """Momenta, (n, rows, coordinates); without columns for first-order dynamics."""
        return self.path[:, :, self.module.problem.positions :]

    @cached_property
    def energy(self) -> Matrix | None:
        """The Hamiltonian (n, rows); None for first-order dynamics."""
        if self.module.problem.energy is None:
            return None
        energies: Matrix = energies_of(self.module.problem, self.numbers, self.path, self.t)
        return energies

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """The names of the columns of `q` and `p`."""
        names = component_names(self.module.metadata)
        return {key: tuple(names[key]) for key in ("q", "p")}

    def __getitem__(self, index: int) -> Result:
        """Return the Result of a case, which is followed once more; raises IndexError beyond the end."""
        module = with_values(self.module, self._values(index))
        run = Run(self.steps, every=self.every)
        return simulate_result(module, "newton", run, simulate(module, run))

    def to_dataset(self) -> Dataset:
        """Return the motions as an xarray data set with the dimension `case`; raises ExtraError without xarray."""
        try:
            import xarray
        except ImportError:
            raise ExtraError("to_dataset needs xarray, which is not installed", "pip install xarray") from None
        data: dict[str, Any] = {name: ("case", getattr(self, name)) for name in ("status", "residual", "iterations")}
        data["message"] = ("case", self.message.astype(np.str_))
        coordinates: dict[str, Any] = {name: ("case", values) for name, values in self.parameters.items()}
        for name, dim in (("q", "coordinate"), ("p", "momentum")):
            if self.names[name]:
                data[name] = (("case", "node", dim), getattr(self, name))
                coordinates[dim] = (dim, list(self.names[name]))
        if self.energy is not None:
            data["energy"] = (("case", "node"), self.energy)
        coordinates["t"] = (("case", "node"), self.t)
        return xarray.Dataset(data, coordinates, {"problem": self.module.metadata.problem, "steps": self.steps})


def require_motions(module: Any, is_on_device: bool) -> None:
    """Raise an error for a module whose motions are not followed many at a time."""
    if is_of_particles(module):
        raise ArgumentError(
            clause(f"{module.metadata.problem} is a simulation of particles"), "use codegen.sweep, which solves all"
        )
    if not isinstance(module.problem, StepProblem):
        raise ArgumentError("a standalone module solves one case at a time", "build it without --standalone")
    if module.problem.events is not None:
        raise ArgumentError(
            clause(f"the motions of {module.metadata.problem} have events"), "use codegen.sweep, which solves all"
        )
    if is_on_device and module.problem.tables:
        raise DeviceError(clause(f"{module.metadata.problem} has tables"), 'use executor "threads"')


def empty_motions(
    module: SimulateModule, columns: dict[str, Vector], arguments: Mapping[str, Any], steps: int, every: int,
    number: int,
) -> Motions:  # fmt: skip
    """Return Motions without results, with a message for each case with unusable numbers."""
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise NumericsError(f"every {clause(repr(every))}", "give a positive integer")
    try:
        numbers, errors = ensemble_of(module, steps, arguments, number)
    except ValueError as error:
        raise NumericsError(f"{module.metadata.problem}: {error}", "give other values") from error
    every = min(every, steps)
    status = np.full(number, "", LONGEST_STATUS)
    status[list(errors)] = UNUSABLE
    messages = {case: f"{UNUSABLE}: {one_line(str(error))}" for case, error in errors.items()}
    shape = number, 1 - (-steps // every), module.problem.state
    try:
        path = np.full(shape, np.nan)
    except MemoryError:
        finding = f"the states of {number} cases at {shape[1]} times need {8e-9 * math.prod(shape):.3g} GB"
        raise NumericsError(finding, "store fewer by every=, or fewer cases at a time") from None
    made, iterations = np.zeros((2, number), np.int64)
    h = np.where(numbers.is_usable, numbers.h, np.nan)
    residual = np.full(number, np.nan)
    return Motions(status, made, iterations, residual, h, path, columns, steps, every, module, messages, numbers)


def follow_motions(motions: Motions, part: slice, is_on_device: bool, is_wanted: Callable[[], bool]) -> None:
    """Follow the motions of a part of the cases, block by block; raises Abandoned once `is_wanted` returns False."""
    problem, (_, rows, state) = motions.module.problem, motions.path.shape
    size = max(1, NUMBERS // (rows * state))
    follow: Callable[..., None] = follow_ensemble
    if is_on_device:
        from codegen.runtime.cuda import motions as of_device

        size, follow = part.stop - part.start, of_device.follow_ensemble
    for first in range(part.start, part.stop, size):
        if not is_wanted():
            raise Abandoned
        own = slice(first, min(part.stop, first + size))
        numbers = own_cases(motions.numbers, own)
        followed = followed_in(motions.path[own], motions.every)
        with errors_of_device() if is_on_device else nullcontext():
            follow(problem, numbers, motions.steps, motions.every, followed)
        _put(motions, own, followed)


def _put(motions: Motions, own: slice, followed: Followed) -> None:
    """Write the numbers of followed cases, and judge each of them as `codegen.solve` does."""
    made, _, iterations, outcome = followed.numbers.T
    usable = motions.status[own] != UNUSABLE
    motions.made[own], motions.iterations[own], motions.residual[own] = made, iterations, followed.residual
    motions.status[own] = np.where(usable & (outcome == 0), SOLVED, motions.status[own])
    for case in np.flatnonzero(usable & (outcome < 0) & (outcome != LEFT_TABLE)).tolist():
        index, h = own.start + case, float(motions.h[own.start + case])
        times = h * made[case], h * (made[case] + 1)
        motions.status[index], motions.messages[index] = describe(
            motions.steps, times, int(made[case]), int(iterations[case]), int(outcome[case])
        )
    with np.errstate(invalid="ignore"):
        level = np.maximum(TOLERANCE, rounding_of(motions.path[own], motions.h[own]))
        is_doubtful = usable & (((outcome == 0) & ~(followed.residual <= level)) | (outcome == LEFT_TABLE))
    for index in (own.start + np.flatnonzero(is_doubtful)).tolist():
        alone = motions[index]
        motions.status[index], motions.messages[index] = alone.status, alone.message
