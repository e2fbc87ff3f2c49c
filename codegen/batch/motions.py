"""Motions of many cases of one simulation, by the compiled loop over cases or on a GPU."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from codegen.batch.request import STEPS, Quantity, given_to
from codegen.batch.results import UNUSABLE, Cases, Limits, errors_of_device, unusable_message
from codegen.errors import ArgumentError, DeviceError, NumericsError, clause, is_count
from codegen.runtime.search.stacks import LONGEST_STATUS, SOLVED
from codegen.runtime.stepping.ensembles import (
    Ensemble,
    Happened,
    are_motions_ready,
    energies_of,
    ensemble_of,
    follow_ensemble,
    followed_in,
    own_cases,
)
from codegen.runtime.stepping.events import STOPPED
from codegen.runtime.stepping.motion import MOST, EventLog, describe, stop_message
from codegen.runtime.stepping.problem import StepProblem
from codegen.runtime.stepping.steps import NON_FINITE, NOT_CONVERGED, SINGULAR
from codegen.solving.drivers.newton import TOLERANCE, simulate
from codegen.solving.loading import Matrix, SimulateModule, Vector, is_of_particles
from codegen.solving.request import with_values
from codegen.solving.results.display import Background
from codegen.solving.results.motions import (
    PENETRATION,
    ROUNDING,
    event_labels,
    event_tables,
    label_numbers,
    rounding_of,
    simulate_result,
)
from codegen.solving.results.result import Result, Run, component_names

if TYPE_CHECKING:
    from xarray import Dataset

NUMBERS = 1_000_000  # number of stored numbers of a block of cases, after each of which an interrupt is seen


class CaseEvents(NamedTuple):
    """The E events of many motions, motion after motion, and in each in the order of time.

    Attributes
    ----------
    case : ndarray of int, (E,)
        The case of each event.
    label : ndarray of int, (E,)
        The index of its name in `names["event_counts"]` of the motions.
    t : ndarray, (E,)
        Times.
    before, after : ndarray, (E, states)
        States before and after the events.
    """

    case: NDArray[np.intp]
    label: NDArray[np.intp]
    t: Vector
    before: Matrix
    after: Matrix


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
    h, ends : ndarray, (n,)
        Lengths of a step, and the time of the event that ended a motion; NaN without such an event.
    path : ndarray, (n, rows, states)
        The stored states: coordinates, then momenta. NaN after the end of a motion. With `on_device=True` this is an
        array in the memory of the GPU, with `__cuda_array_interface__`, as are `q` and `p`.
    parameters : dict of str to ndarray (n,)
        The numbers that differ from those of the problem.
    steps, every : int
        Number of steps. Every `every`-th state is stored, and the first and the last.
    module : module
        The generated module.
    limits : Limits
        The limit of iterations of a step, and the place: the processor or a GPU.
    messages : dict of int to str
        The messages of cases that failed, or that an event ended.
    numbers : tuple
        Lengths of a step, parameters and initial states of all cases.
    logs : dict of int to tuple
        Numbers of events of each case and all events of a block of cases, by the index of its first case.
    background : Background or None
        The module and the problem, for figures of single cases.
    """

    numbers_of_cases = ("residual", "iterations")
    status: NDArray[np.str_]
    made: NDArray[np.int64]
    iterations: NDArray[np.int64]
    residual: Vector
    h: Vector
    ends: Vector
    path: NDArray[np.float64]
    parameters: Mapping[str, Vector]
    steps: int
    every: int
    module: SimulateModule
    limits: Limits
    messages: dict[int, str]
    numbers: Ensemble
    logs: dict[int, tuple[NDArray[np.int64], EventLog]] = field(default_factory=dict)
    background: Background | None = None

    @property
    def is_ready(self) -> bool:
        """True if the machine code that `fill` needs is on the disk, or if a GPU follows the motions."""
        return self.limits.is_on_device or are_motions_ready(self.module.problem)

    def _block(self, number: int) -> int:
        return number if self.limits.is_on_device else max(1, NUMBERS // math.prod(self.path.shape[1:]))

    def _solve(self, own: slice, is_wanted: Callable[[], bool]) -> None:
        follow: Callable[..., tuple[Happened, EventLog] | None] = follow_ensemble
        if self.limits.is_on_device:
            from codegen.runtime.cuda import batches as of_device

            follow = partial(of_device.follow_ensemble, is_kept=self.limits.is_kept)
        followed = followed_in(self.path[own], self.every)
        happened = follow(
            self.module.problem, own_cases(self.numbers, own), self.steps, self.every, followed,
            most=self.limits.max_iterations or MOST,
        )  # fmt: skip
        made, _, iterations, outcome = followed.numbers.T
        self.made[own], self.iterations[own], self.residual[own] = made, iterations, followed.residual
        self._judge(own, outcome, *(happened or (None, None)))

    def _judge(self, own: slice, outcome: NDArray[np.int64], happened: Happened | None, log: EventLog | None) -> None:
        """Set the statuses of followed cases as `codegen.solve` does, and store their events."""
        usable, made, h = self.status[own] != UNUSABLE, self.made[own], self.h[own]
        metadata, last = self.module.metadata, h * made
        least: Vector | float = np.inf
        if happened is not None and log is not None:
            self.logs[own.start], self.ends[own], least = (happened.counts, log), happened.ends, happened.least
            last = np.where(outcome == STOPPED, happened.ends, last)
            names, ended = (*metadata.events, *metadata.gaps), np.cumsum(happened.counts) - 1
            for case in np.flatnonzero(usable & (outcome == STOPPED)).tolist():
                name = names[int(log.number[ended[case]])]
                self.messages[own.start + case] = stop_message(name, last[case], made[case], self.steps)
        self.status[own] = np.where(usable & (outcome >= 0), SOLVED, self.status[own])
        # Failures with an explanation that needs the states are followed once more.
        is_plain = np.isin(outcome, (NON_FINITE, SINGULAR, NOT_CONVERGED)) & (self.module.problem.constraints is None)
        for case in np.flatnonzero(usable & is_plain).tolist():
            index, times = own.start + case, (h[case] * made[case], h[case] * (made[case] + 1))
            iterations = int(self.iterations[index])
            self.status[index], self.messages[index] = describe(
                self.steps, times, int(made[case]), iterations, int(outcome[case])
            )
        with np.errstate(invalid="ignore"):
            # States on a device are not read: motions with larger residuals are followed once more.
            level = 0.0 if self.limits.is_kept else rounding_of(self.path[own], last / np.maximum(made, 1))
            is_accurate = (self.residual[own] <= np.maximum(TOLERANCE, level)) & (
                least > -PENETRATION / ROUNDING * level
            )
        is_doubtful = usable & ~np.where(outcome >= 0, is_accurate, is_plain)
        for index in (own.start + np.flatnonzero(is_doubtful)).tolist():
            alone = self[index]
            self.status[index], self.messages[index] = alone.status, alone.message

    @cached_property
    def message(self) -> NDArray[np.object_]:
        """The explanation (n,) of each status, as of `codegen.solve`."""
        kinds, of_case = np.unique(self.iterations, return_inverse=True)
        texts = [describe(self.steps, (), self.steps, int(iterations), 0)[1] for iterations in kinds]
        messages: NDArray[np.object_] = np.array(texts, object)[of_case]
        messages[list(self.messages)] = list(self.messages.values())
        return messages

    def fetched(self) -> Motions:
        """Return the motions with their states in the memory of the process; those without a GPU are there already."""
        if not self.limits.is_kept:
            return self
        from codegen.runtime.cuda.memory import fetched

        return replace(self, path=fetched(self.path), limits=replace(self.limits, is_kept=False))

    def to_dataset(self) -> Dataset:
        """Return the results as an xarray data set with the dimension `case`; raises ExtraError without xarray."""
        return self.fetched().to_dataset() if self.limits.is_kept else super().to_dataset()

    @cached_property
    def t(self) -> Matrix:
        """Times (n, rows) of the stored states; NaN after the end of a motion."""
        numbers, made = self.every * np.arange(self.path.shape[1]), self.made[:, None]
        times: Matrix = self.h[:, None] * np.minimum(numbers, made)
        if (self.made < self.steps).any():
            times[numbers - self.every >= made] = np.nan
        stopped = np.flatnonzero(~np.isnan(self.ends))
        times[stopped, -(-self.made[stopped] // self.every)] = self.ends[stopped]
        return times

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
        energies: Matrix = energies_of(self.module.problem, self.numbers, self.fetched().path, self.t)
        return energies

    @cached_property
    def events(self) -> CaseEvents | None:
        """The events of all motions; None for a problem without events."""
        if self.module.problem.events is None:
            return None
        counts, log = np.zeros(len(self), np.int64), [self.logs[first][1] for first in sorted(self.logs)]
        for first, (of_block, _) in self.logs.items():
            counts[first : first + of_block.size] = of_block
        number, action, t, before, after = (np.concatenate(parts) for parts in zip(*log, strict=True))
        label = label_numbers(self.module.metadata, number, action)
        return CaseEvents(np.repeat(np.arange(len(self)), counts), label, t, before, after)

    @property
    def event_counts(self) -> Matrix | None:
        """Numbers (n, names) of events of each name; None for a problem without events."""
        return None if self._event_tables is None else self._event_tables[0]

    @property
    def event_times(self) -> NDArray[np.float64] | None:
        """The first ten times (n, 10, names) of events of each name, and NaN; None for a problem without events."""
        return None if self._event_tables is None else self._event_tables[1]

    @cached_property
    def _event_tables(self) -> tuple[Matrix, NDArray[np.float64]] | None:
        if self.events is None:
            return None
        shape = len(self), len(event_labels(self.module.metadata))
        return event_tables(shape, self.events.case, self.events.label, self.events.t)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """The names of the columns of `q`, `p`, `event_counts` and `event_times`."""
        names, labels = component_names(self.module.metadata), event_labels(self.module.metadata)
        events = dict.fromkeys(("event_counts", "event_times") if labels else (), labels)
        return {key: tuple(names[key]) for key in ("q", "p")} | events

    def __getitem__(self, index: int) -> Result:
        """Return the Result of a case, which is followed once more; raises IndexError beyond the end."""
        values = self._values(index)
        module = with_values(self.module, values)
        run = Run(self.steps, every=self.every, max_iterations=self.limits.max_iterations)
        return self._in_background(simulate_result(module, "newton", run, simulate(module, run)), module, values)


def require_motions(module: SimulateModule, is_on_device: bool) -> None:
    """Raise an error for a module whose motions are not followed many at a time, or not on a GPU."""
    name = module.metadata.problem
    if is_of_particles(module):
        raise ArgumentError(clause(f"{name} is a simulation of particles"), "use codegen.sweep, which solves all")
    if not isinstance(module.problem, StepProblem):
        raise ArgumentError("a standalone module solves one case at a time", "build it without --standalone")
    if is_on_device and (module.problem.tables or module.problem.events):
        reason = f"{name} has tables" if module.problem.tables else f"the motions of {name} have events"
        raise DeviceError(clause(reason), 'use executor "threads"')


def empty_motions(
    module: SimulateModule, columns: Mapping[Quantity, Vector], steps: int, every: int, limits: Limits, number: int
) -> Motions:
    """Return Motions without results, with a message for each case with unusable numbers."""
    if not is_count(every):
        raise NumericsError(f"every {clause(repr(every))}", "give a positive integer")
    numbers, errors = ensemble_of(module, steps, given_to(columns), number)
    every = min(every, steps)
    status = np.full(number, "", LONGEST_STATUS)
    status[list(errors)] = UNUSABLE
    parameters = {own.name: column for own, column in columns.items() if own.kind != STEPS}
    messages = {
        case: unusable_message(error, {name: column[case] for name, column in parameters.items()})
        for case, error in errors.items()
    }
    shape = number, 1 - (-steps // every), module.problem.state
    try:
        if limits.is_kept:
            from codegen.runtime.cuda.memory import Columns

            with errors_of_device():
                path = Columns.without_numbers(shape).view
        else:
            path = np.full(shape, np.nan)
    except MemoryError:
        finding = f"the states of {number} cases at {shape[1]} times need {8e-9 * math.prod(shape):.3g} GB"
        raise NumericsError(finding, "store fewer by every=, or fewer cases at a time") from None
    made, iterations = np.zeros((2, number), np.int64)
    h = np.where(numbers.is_usable, numbers.h, np.nan)
    residual, ends = np.full((2, number), np.nan)
    return Motions(
        status, made, iterations, residual, h, ends, path, parameters, steps, every, module, limits, messages, numbers
    )
