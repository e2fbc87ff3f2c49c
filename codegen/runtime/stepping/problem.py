"""The definition of an initial value problem: the kernels of a step, names and numbers of a generated module."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from codegen.runtime.kernels import Kernel, Value, problem_of
from codegen.runtime.record import SimulationRecord
from codegen.runtime.stepping.steps import EQUAL, Scheme, follow, memory_for


@dataclass(frozen=True, eq=False)
class StepProblem:
    """An initial value problem: the kernels of one step, with names and numbers.

    A step of a composition method has several parts, each a step of the base scheme. Other steps have one part. A part
    has one or more lengths (durations), as many as `fractions` has columns. The interval of a part is the vector
    (stages + state,) of the values inside the part, then the state at its end. All kernels of a step take the state at
    the start of a part, the time there, the lengths of the part, and the parameters.

    Attributes
    ----------
    metadata : SimulationRecord
        Names of the quantities, and their meanings.
    state, stages, unknowns : int
        Numbers of values of a state (q, p), of values inside a step, and of unknowns of the equations of a step.
    equations : Kernel
        Fills the residual (stages + state,) of the equations of the scheme. Its arguments are (state, interval, t,
        lengths, parameters).
    energy : Value or None
        The Hamiltonian of (state, t, parameters); None for first-order dynamics.
    has_momenta : bool
        True if the second half of a state with an energy are momenta. A Lagrangian that is linear in the velocities has
        an energy, but no momenta.
    bands : tuple of int, or None
        Numbers of diagonals of the Jacobian under and over its main diagonal, if its other entries are zero.
    explicit : Kernel or None
        Fills the interval of an explicit scheme.
    all_steps : Kernel or None
        Makes all steps of an explicit scheme in one loop, with the step inlined; see `steps.follow_explicitly`.
    predict, residual, jacobian, complete : Kernel or None
        For implicit schemes. They fill the initial guess of the unknowns, the residual, the residual and the entries of
        its Jacobian that do not vanish, and the interval that follows from the unknowns.
    is_linear, is_constant : bool
        True if the equations of a step are linear, and if their matrix is the same for all steps.
    fractions : array (parts, lengths)
        Lengths of all parts of a step, relative to the length of the step.
    inputs : Kernel or None
        Fills the least and the greatest value (inputs, 2) of each input in a part of a step. An input is the argument
        of a tabulated function.
    ranges : array (inputs, 2)
        Indices of the parameters that are the first and the last breakpoint for each input.
    range_names : tuple of str
        Names of the inputs for messages.
    constraints : Kernel or None
        Fills an array (constraints, 3 + coordinates): value, rate, scale of the rate, and gradient of each
        constraint at a node. Its arguments are (state, t, parameters).
    events, jumps, normals : Kernel or None
        Fill values, rates and scales (events + gaps, 3) of events and gaps, states (changes, state) after events, and
        accelerations, restitutions, sizes of rates, normals and responses (gaps, 3 + 2 coordinates) of gaps. Their
        arguments are (state, t, parameters).
    rules : array (events + gaps, 3)
        Action, direction, and row in `jumps` or -1, of each event and gap.
    tables : mapping
        Breakpoints and values of each table, as one array for each name.
    """

    metadata: SimulationRecord
    state: int
    stages: int
    equations: Kernel
    energy: Value | None = None
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
    constraints: Kernel | None = None
    events: Kernel | None = None
    jumps: Kernel | None = None
    normals: Kernel | None = None
    rules: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    tables: Mapping[str, np.ndarray] = field(default_factory=dict)
    has_momenta: bool = True
    bands: tuple[int, int] | None = None

    def __reduce__(self):
        """Pickle the problem as the name of its module; another process imports the module."""
        return problem_of, (self.equations.__module__,)

    @property
    def positions(self):
        """The number of coordinates or states in front of the momenta."""
        return self.state // 2 if self.energy is not None and self.has_momenta else self.state

    @cached_property
    def scheme(self):
        """The Scheme of the problem: addresses, numbers and lengths for compiled code."""
        kernels = (
            self.explicit, self.predict, self.residual if self.is_constant else None, self.jacobian, self.complete,
            self.equations, self.inputs,
        )  # fmt: skip
        return Scheme(
            *(0 if kernel is None else kernel.address for kernel in kernels),
            self.state, self.stages, self.unknowns, int(not self.is_linear), int(self.is_constant),
            *self.fractions.shape, len(self.ranges), self.fractions.ctypes.data, self.ranges.ctypes.data,
            *(self.bands or (self.unknowns, self.unknowns)),
        )  # fmt: skip

    def follow(self, start, steps, h, parameters, tolerance, most, every, path, before, spans=EQUAL):
        """Make all steps from the state `start` (state,).

        Arguments and results are as in `steps.follow`.
        """
        scheme = self.scheme if spans.shape[0] == 0 else self.scheme._replace(is_constant=0)
        if self.all_steps is None or self.all_steps.is_interpreted or spans.shape[0] > 0:
            states = path, before
            return follow(
                scheme, memory_for(scheme), start, steps, h, parameters, tolerance, most, every, *states, spans
            )
        outcome, numbers = np.empty(4), np.array([steps, h, every], dtype=float)
        states = start.copy(), start.copy(), np.empty(self.stages + self.state)
        self.all_steps(*states, h * self.fractions, numbers, parameters, path, before, outcome)
        return tuple(map(int, outcome))

    def kernels(self):
        """Return the kernels that a solution calls, as a tuple without None."""
        every = (
            self.all_steps, self.jacobian, self.explicit, self.predict, self.residual if self.is_constant else None,
            self.complete, self.equations, self.inputs, self.energy, self.constraints, self.events, self.jumps,
            self.normals,
        )  # fmt: skip
        return tuple(kernel for kernel in every if kernel is not None)

    def compile(self):
        """Compile all kernels of the problem."""
        for kernel in self.kernels():
            kernel.address  # noqa: B018
