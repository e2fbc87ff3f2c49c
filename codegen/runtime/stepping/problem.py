"""The definition of an initial value problem: the kernels of a step, names and numbers, from its generated module."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from codegen.runtime.kernels import Kernel, Value, problem_of
from codegen.runtime.record import SimulationRecord
from codegen.runtime.stepping.steps import Scheme, follow, memory_for


@dataclass(frozen=True, eq=False)
class StepProblem:
    """An initial value problem: the kernels of one step, and names and numbers.

    A step has one part, or several parts that are steps of another scheme. Each part has as many lengths as
    `fractions` has columns. All kernels take the state at the start of a part, the time there, and the lengths.

    Attributes
    ----------
    metadata : Record
        Names and meanings.
    state, stages, unknowns : int
        Numbers of values of a state (q, p), of values inside a step, and of unknowns of the equations of a step.
    equations : Kernel
        Fills the residual (stages + state,) of the scheme's equations: (state, interval, t, lengths, parameters).
    energy : Value
        The Hamiltonian: (state, t, parameters).
    explicit : Kernel or None
        Fills the interval (stages + state,), inner stages and the state at the end, of an explicit scheme.
    all_steps : Kernel or None
        Makes all steps of an explicit scheme in one loop, into which a step is inlined; see `steps.follow_explicitly`.
    predict, residual, jacobian, complete : Kernel or None
        For implicit steps: fill the initial guess of unknowns, residual, residual and Jacobian, and the interval.
    is_linear, is_constant : bool
        True if the equations of a step are linear, and if their matrix is the same for all steps.
    fractions : array
        Lengths (parts, lengths) of all parts of a step, relative to the step.
    inputs : Kernel or None
        Fills the least and greatest inputs (inputs, 2) of tables with the ranges `ranges`, named `range_names`.
    """

    metadata: SimulationRecord
    state: int
    stages: int
    equations: Kernel
    energy: Value
    unknowns: int = 0
    explicit: Kernel | None = None
    all_steps: Kernel | None = None
    predict: Kernel | None = None
    residual: Kernel | None = None
    jacobian: Kernel | None = None
    complete: Kernel | None = None
    is_linear: bool = False
    is_constant: bool = False
    fractions: np.ndarray = field(default_factory=lambda: np.ones((1, 1)))
    inputs: Kernel | None = None
    ranges: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    range_names: tuple[str, ...] = ()
    tables: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __reduce__(self):
        """Pickle the problem as the name of its module, which another process imports."""
        return problem_of, (self.energy.__module__,)

    @cached_property
    def scheme(self):
        """Addresses, numbers and lengths of the problem for compiled code."""
        kernels = (
            self.explicit, self.predict, self.residual if self.is_constant else None, self.jacobian, self.complete,
            self.equations, self.inputs,
        )  # fmt: skip
        return Scheme(
            *(0 if kernel is None else kernel.address for kernel in kernels),
            self.state, self.stages, self.unknowns, int(not self.is_linear), int(self.is_constant),
            *self.fractions.shape, len(self.ranges), self.fractions.ctypes.data, self.ranges.ctypes.data,
        )  # fmt: skip

    def follow(self, start, steps, h, parameters, tolerance, most, every, path, before):
        """Make all steps from a state (state,); see `steps.follow`."""
        if self.all_steps is None or self.all_steps.is_interpreted:
            accuracy = tolerance, most
            return follow(
                self.scheme, memory_for(self.scheme), start, steps, h, parameters, *accuracy, every, path, before
            )
        outcome, numbers = np.empty(4), np.array([steps, h, every], dtype=float)
        states = start.copy(), start.copy(), np.empty(self.stages + self.state)
        self.all_steps(*states, h * self.fractions, numbers, parameters, path, before, outcome)
        return tuple(map(int, outcome))

    def kernels(self):
        """Return the kernels that a solution calls."""
        every = (
            self.all_steps, self.jacobian, self.explicit, self.predict, self.residual if self.is_constant else None,
            self.complete, self.equations, self.inputs, self.energy,
        )  # fmt: skip
        return tuple(kernel for kernel in every if kernel is not None)

    def compile(self):
        """Compile all kernels of the problem."""
        for kernel in self.kernels():
            kernel.address  # noqa: B018
