"""What generated modules offer, as types: their public functions, by task, and what tells one kind from another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.record import ConnectRecord, ControlRecord, Task

Vector: TypeAlias = NDArray[np.float64]
Matrix: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]
Entries: TypeAlias = tuple[Indices, Indices, Vector]
"""A sparse matrix as (rows, columns, values), where duplicates add up."""


class Grid(Protocol):
    """N intervals of mean length h, the parameters of each body, and which unknowns are multipliers of equations.

    `nodes` (N + 1,) are the indices of all nodes in time, in mean lengths. Where there are inner times, `inner` are the
    numbers of their nodes.
    """

    steps: int
    h: float
    nodes: Vector
    parameters: Matrix
    is_multiplier: NDArray[np.bool_]
    sizes: Vector
    weight: float
    inner: tuple[int, ...]
    problem: Any


class ControlSolution(Protocol):
    """What `solve` of an optimal-control module returns; `log` has a row for every iterate, `scaled` first sizes."""

    status: str
    message: str
    cost: float
    residual: float
    stationarity: float
    iterations: int
    t: Vector
    q: Matrix
    p: Matrix
    u: Matrix
    multipliers: Matrix
    unknowns: Vector
    log: Matrix
    scaled: Grid


class Unpacked(NamedTuple):
    """A vector of unknowns as trajectories."""

    t: Vector
    q: Matrix
    p: Matrix
    u: Matrix
    multipliers: Matrix


class NonlinearProgram(Protocol):
    """Minimise a cost such that constraints are zero and unknowns within bounds: see `codegen.runtime.search.nlp`."""

    grid: Grid
    guess: Vector
    primal: Indices
    dual: Indices
    x0: Vector
    bounds: tuple[Vector, Vector]
    constraint_bounds: tuple[Vector, Vector]
    names: tuple[str, ...]

    cost: Callable[[Vector], float]
    gradient: Callable[[Vector], Vector]
    constraints: Callable[[Vector], Vector]
    stationarity: Callable[[Vector, Vector], Vector]
    jacobian: Callable[[Vector], Any]
    hessian: Callable[..., Any]
    unknowns: Callable[..., Vector]
    evaluate: Callable[..., Any]
    unpack: Callable[..., Any]


class ControlModule(Protocol):
    """The public functions of a generated module that solves an optimal-control problem.

    `variable_bounds` is there if `metadata.inequalities`. `problem` is the ControlProblem that all grids of the module
    carry; what else there is to ask of a grid, `codegen.runtime.search` answers. Views are of nodes and intervals,
    bodies first.
    """

    metadata: ControlRecord
    problem: Any

    solve: Callable[..., ControlSolution]
    make_grid: Callable[..., Grid]
    initial_guess: Callable[[Grid], Vector]
    with_pinned_values: Callable[[Grid, Vector], Vector]
    nlp: Callable[..., NonlinearProgram]
    primal_unknowns: Callable[[Grid], Indices]
    multiplier_unknowns: Callable[[Grid], Indices]
    evaluate: Callable[[Grid, Vector], Any]
    unpack: Callable[[Grid, Vector], Unpacked]
    views: Callable[[Grid, Vector], tuple[Matrix, Matrix]]
    variable_bounds: Callable[[Grid], tuple[Vector, Vector]]


class StepGrid(Protocol):
    """N steps of length h, the values of the parameters, and the initial state (q, p)."""

    steps: int
    h: float
    parameters: Vector
    start: Vector


class SimulateSolution(Protocol):
    """What `solve` of a simulation module returns; arrays run over the stored steps."""

    status: str
    message: str
    steps: int
    t: Vector
    q: Matrix
    p: Matrix
    energy: Vector
    residual: float
    iterations: int


class SimulateModule(Protocol):
    """The public functions of a generated module that follows a motion."""

    metadata: Any

    solve: Callable[..., SimulateSolution]
    make_grid: Callable[..., StepGrid]
    energy: Callable[[Vector, float, Vector], float]
    step: Callable[[StepGrid, Vector, float], Vector]
    path_residual: Callable[[StepGrid, Matrix], float]


class ImplicitModule(SimulateModule, Protocol):
    """A simulation whose scheme leaves equations to be solved in every step; unknowns are those that are left."""

    predict: Callable[[StepGrid, Vector, float], Vector]
    residual: Callable[[StepGrid, Vector, Vector, float], Vector]
    jacobian: Callable[[StepGrid, Vector, Vector, float], Matrix]
    complete: Callable[[StepGrid, Vector, Vector, float], Vector]


class ConnectModule(Protocol):
    """The public functions of a generated module that connects points; a case is what `make_case` returns.

    Those of the action are there if `metadata.method` is Method.ACTION.
    """

    metadata: ConnectRecord

    solve: Callable[..., Any]
    solve_case: Callable[..., Any]
    make_case: Callable[..., Any]
    first_momenta: Callable[[Any], Any]
    trajectory: Callable[[Any, Any], tuple[int, Any, Any]]
    residual: Callable[[Any, Vector], Vector]
    jacobian: Callable[[Any, Vector], Matrix]
    path_of: Callable[[Any, Vector], Any]
    path_cost: Callable[[Any, Any], float]
    path_errors: Callable[[Any, Any], tuple[Any, Vector]]
    first_unknowns: Callable[[Any], Vector]
    all_equations: Callable[[Any, Vector], Vector]
    all_equations_jacobian: Callable[[Any, Vector], Matrix]
    end_residual: Callable[[Any, Any, Any], Vector]
    preconditioner: Callable[[Any], Any]
    Linearised: Callable[..., Any]
    hamiltonian: Callable[..., float]
    hamiltonian_gradient: Callable[..., None]
    momentum_matrix: Callable[..., None]
    domain_margin: Callable[[Any], float]
    guessed_path: Callable[..., Any]
    momenta_of: Callable[..., Any]
    all_states: Callable[..., tuple[int, int, float]]
    action_start: Callable[[Any], Vector]
    action_path: Callable[[Any, Vector], Any]
    action_cost: Callable[[Any, Vector], float]
    action_cost_gradient: Callable[[Any, Vector], Vector]
    action_constraints: Callable[[Any, Vector], Vector]
    action_jacobian: Callable[[Any, Vector], Matrix]
    action_hessian: Callable[[Any, Vector, Vector], Matrix]
    BLOCKS: int
    POINTS: int


GeneratedModule: TypeAlias = ControlModule | SimulateModule | ConnectModule


def few_steps(module: Any, steps: int) -> int:
    """As many intervals of a control problem, or more where there are inner times."""
    return max(steps, int(module.metadata.inner_times) + 1)


def inner_places(module: Any) -> tuple[float, ...]:
    """Where inner times are, in parts of the duration, or of the whole chain where they are free; none, often."""
    if not module.metadata.inner_times:
        return ()
    grid = module.make_grid(few_steps(module, 1))
    return tuple(float(grid.nodes[number]) / grid.steps for number in grid.inner)


def time_grid(module: ControlModule, steps: int, fractions: Vector | None = None) -> Grid:
    """The grid of N equal intervals, N = `steps`, or of those that last `fractions` of the duration, or of each phase.

    Raises ValueError when fractions are not positive, or their sum is not one.
    """
    return module.make_grid(steps) if fractions is None else module.make_grid(steps, grid=fractions)


def is_control(module: GeneratedModule) -> TypeGuard[ControlModule]:
    """Whether a generated module solves an optimal-control problem."""
    return bool(module.metadata.task == Task.CONTROL)


def is_connect(module: GeneratedModule) -> TypeGuard[ConnectModule]:
    """Whether a generated module connects points."""
    return bool(module.metadata.task == Task.CONNECT)


def is_simulation(module: GeneratedModule) -> TypeGuard[SimulateModule]:
    """Whether a generated module follows a motion."""
    return bool(module.metadata.task == Task.SIMULATE)


def is_of_particles(module: GeneratedModule) -> bool:
    """Whether a generated module is about particles."""
    return bool(module.metadata.of_particles)


def is_implicit(module: SimulateModule) -> TypeGuard[ImplicitModule]:
    """Whether a simulation solves equations in every step."""
    return all(callable(getattr(module, name, None)) for name in ("predict", "residual", "jacobian", "complete"))
